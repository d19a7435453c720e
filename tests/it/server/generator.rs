//! The load generator (`examples/load`) against a server: every face, both loops, sessions beside.

use super::*;
use clap::Parser;
use load::{Flags, Report};

#[allow(dead_code)]
#[path = "../../../examples/load/main.rs"]
mod load;

/// A short run; the session table is empty again afterwards.
async fn measure(words: &str) -> Report {
    // An act that comes too late is to fail here.
    let server = start(|config| config.engine.anytime = false).await;
    let fixed = format!("load --url http://{} --seconds 0.3 --warm-up 0.05 --json", server.address);
    let flags = Flags::parse_from(fixed.split(' ').chain(words.split_whitespace()));
    let report = load::run(&flags).await.unwrap();
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"], json!([]), "{words}");
    report
}

#[tokio::test(flavor = "multi_thread")]
async fn every_face_answers() {
    for face in ["unary", "stream", "batch"] {
        let report = measure(&format!("--clients 5 --connections 2 --face {face}")).await;
        assert!(report.acts >= 5 && report.errors.is_empty() && report.replayed == 0, "{report:?}");
        assert_eq!((report.face, report.arrivals, report.clients, report.connections), (face, "closed", 5, 2));
        let latency = report.latency_ms;
        assert!(0.0 < latency.p50 && latency.p50 <= latency.p99 && latency.p99 <= latency.max, "{report:?}");
        assert!(report.server_ms.compute > 0.0 && report.server_ms.compute <= report.server_ms.total, "{report:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cold_act_costs_its_ladder() {
    let report = measure("--set streaming=false --set temperature=0").await;
    assert_eq!(report.evaluations_per_act, 8.0);
    let text = report.to_string();
    assert!(text.contains("evaluations an act    8.00") && text.contains("ms"), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_open_loop_keeps_its_own_time() {
    for (face, arrivals) in [("unary", "even"), ("stream", "poisson"), ("batch", "even")] {
        let report = measure(&format!("--clients 4 --rate 200 --face {face} --arrivals {arrivals}")).await;
        assert!(report.acts > 0 && report.acts_per_s < 1000.0 && report.errors.is_empty(), "{report:?}");
        assert_eq!((report.arrivals, report.rate), (arrivals, Some(200.0)));
        assert!(report.waited_ms.is_some_and(|waited| waited <= report.latency_ms.max), "{report:?}");
    }
}

/// More is asked for than any machine can answer: what was due and never sent counts with the time that it waited.
#[tokio::test(flavor = "multi_thread")]
async fn an_open_loop_hides_no_backlog() {
    let report = measure("--model slow --rate 1000 --give-up-ms 40").await;
    assert!(report.unsent > 100 && report.latency_ms.p50 > 100.0, "{report:?}");
    assert!(report.errors.keys().all(|reason| reason == "GAVE_UP"), "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn failures_are_counted_by_reason() {
    let report = measure("--model slow --deadline-ms 20").await;
    assert_eq!((report.acts, report.errors.keys().map(String::as_str).collect::<Vec<_>>()), (0, vec!["DEADLINE_ADMISSION"]));
}

#[tokio::test(flavor = "multi_thread")]
async fn others_rest_and_come_and_go() {
    let pid = std::process::id();
    let report = measure(&format!("--clients 2 --idle-sessions 50 --churn 20 --server-pid {pid}")).await;
    assert!((report.idle_sessions, report.churned) == (50, 20) && report.errors.is_empty(), "{report:?}");
    assert!(report.memory_mb.is_some_and(|memory| memory.before > 1.0 && memory.idle > 1.0 && memory.after > 1.0));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_run_says_why() {
    let server = start(|_| {}).await;
    let url = format!("http://{}", server.address);
    for (words, part) in [
        (["--url", &url, "--model", "absent"], "absent"),
        (["--url", &url, "--set", "colour=1"], "colour"),
        (["--url", &url, "--set", "eta=7"], "OPTIONS_INVALID"),
        (["--url", "http://127.0.0.1:1", "--seed", "0"], "make serve"),
        (["--url", "nowhere", "--seed", "0"], "--url nowhere"),
    ] {
        let error = load::run(&Flags::parse_from([&["load"], &words[..]].concat())).await.unwrap_err();
        assert!(format!("{error:#}").contains(part), "{error:#}");
    }
}
