//! Faults that were asked for (`--fault`), and what the server does about them: an act's own costs that act alone, a process that is killed loses none,
//! a worker that hangs is seen.

use super::{bytes::bits, *};
use std::{os::unix::process::ExitStatusExt, process::ExitStatus, time::Instant};

/// What the faults here are for.
const POISON: [f32; 4] = [7.0, -0.2, 0.3, 0.4];
/// What holds a worker up until the others have come.
const HOLD: [f32; 4] = [8.0, 0.2, 0.3, 0.4];

fn asked(id: &str, step: u64, state: &[f32]) -> pb::ActRequest {
    pb::ActRequest { want_planned_states: true, ..act(id, step, state) }
}

async fn open(server: &Running, seed: u64) -> String {
    server.open(json!({"seed": seed, "request_id": format!("seed-{seed}"), "options": {"eta": 0.7, "temperature": 1.0}})).await
}

async fn ask(server: &Running, id: &str, step: u64, state: &[f32]) -> Result<pb::ActResponse, Status> {
    let mut agent = server.agent().await;
    let told = timeout(Duration::from_secs(20), agent.act(asked(id, step, state))).await;
    told.expect("nobody tells").map(tonic::Response::into_inner)
}

/// The first acts of these seeds on a server that nothing befalls.
async fn undisturbed(seeds: std::ops::Range<u64>, state: &[f32]) -> Vec<Vec<u32>> {
    let server = start(|_| {}).await;
    let mut all = Vec::new();
    for seed in seeds {
        let id = open(&server, seed).await;
        all.push(bits(&ask(&server, &id, 1, state).await.unwrap()));
    }
    all
}

/// The way of a process out.
async fn ended(process: &mut Process) -> ExitStatus {
    let wait = async {
        loop {
            match process.0.try_wait().unwrap() {
                Some(status) => break status,
                None => tokio::time::sleep(Duration::from_millis(5)).await,
            }
        }
    };
    timeout(Duration::from_secs(10), wait).await.expect("the process goes on")
}

fn terminate(process: &Process) {
    assert!(Command::new("kill").arg(process.0.id().to_string()).status().unwrap().success());
}

/// Sends one bad act and its mates into one batch, and holds the mates against a server without it; how the bad one ended.
async fn among_mates(server: &Running, bad: &str) -> Status {
    let expected = undisturbed(10..14, &STATE).await;
    let hold = open(server, 1).await;
    let mut holds = (server.agent().await, asked(&hold, 1, &HOLD));
    let holder = tokio::spawn(async move { holds.0.act(holds.1).await });
    while server.metric("ada_inflight_acts").await < 1.0 {}
    let mut asked_by = Vec::new();
    for (index, seed) in (10..14).enumerate() {
        // The bad one is in the middle.
        if index == 2 {
            asked_by.push((server.agent().await, asked(bad, 1, &POISON)));
        }
        asked_by.push((server.agent().await, asked(&open(server, seed).await, 1, &STATE)));
    }
    let asking = asked_by.into_iter().map(|(mut agent, request)| tokio::spawn(async move { agent.act(request).await }));
    let mut asking: Vec<_> = asking.collect();
    while server.metric("ada_queue_depth").await < 5.0 {
        assert!(!holder.is_finished(), "they did not come in time to share its batch");
    }
    let failed = asking.remove(2).await.unwrap().expect_err("it was poisoned");
    for (answer, expected) in asking.into_iter().zip(&expected) {
        assert_eq!(&bits(&answer.await.unwrap().unwrap().into_inner()), expected, "beside the bad one");
    }
    holder.await.unwrap().unwrap();
    failed
}

const ONE_BATCH: [&str; 2] = ["engine.workers=1", "engine.batch_len_max=8"];
const HELD: &str = "evaluating=hang:1000@1";

/// A question over which the model panics is tried twice, then refused, and refused at once from then on; another one, or a reset, is welcome.
#[tokio::test(flavor = "multi_thread")]
async fn a_poison_costs_itself_alone() {
    let (_process, server) = start_armed(&[HELD, "evaluating=panic@state=7"], &ONE_BATCH).await;
    let bad = open(&server, 2).await;
    let failed = among_mates(&server, &bad).await;
    assert_eq!(failure(&failed), (Code::FailedPrecondition, "POISON_STEP".into()));
    assert!(trailer(&failed, "ada-error-id").is_some() && trailer(&failed, "grpc-retry-pushback-ms").is_none(), "{failed:?}");
    let panics = async || server.metric("ada_engine_panics_total").await;
    assert_eq!(panics().await, 2.0, "once with its mates, once alone");
    assert_eq!(server.get(&format!("/v1/sessions/{bad}")).await.json()["session"]["committed_step"], 0);

    let again = ask(&server, &bad, 1, &POISON).await.unwrap_err();
    assert_eq!((failure(&again), trailer(&again, "ada-error-id")), (failure(&failed), trailer(&failed, "ada-error-id")));
    let http = server.act(&bad, 1, &POISON).await;
    assert_eq!((http.status, http.reason().as_str()), (422, "POISON_STEP"));
    assert_eq!(Some(http.json()["error_id"].as_str().unwrap().to_owned()), trailer(&failed, "ada-error-id"));
    assert_eq!((panics().await, server.metric("ada_poison_steps_total").await), (2.0, 3.0), "it is not tried again");
    let other = ask(&server, &bad, 1, &STATE).await.unwrap();
    assert_eq!(bits(&other), undisturbed(2..3, &STATE).await[0]);
    assert_eq!(failure(&ask(&server, &bad, 2, &POISON).await.unwrap_err()).1, "POISON_STEP");
    assert_eq!(panics().await, 4.0, "it is another step");

    assert_eq!(server.post(&format!("/v1/sessions/{bad}/reset"), &json!({"seed": 2})).await.status, 200);
    assert_eq!(ask(&server, &bad, 1, &POISON).await.unwrap_err().code(), Code::FailedPrecondition);
    assert_eq!(panics().await, 6.0, "the new episode tries it");
    assert_eq!(bits(&ask(&server, &bad, 1, &STATE).await.unwrap()), bits(&other));
}

/// One that is not finite is no poison: its mates are as without it, and it is computed again when it is asked again.
#[tokio::test(flavor = "multi_thread")]
async fn nothing_that_is_not_finite_leaves_the_engine() {
    let (_process, server) = start_armed(&[HELD, "evaluating=nonfinite@state=7"], &ONE_BATCH).await;
    let bad = open(&server, 2).await;
    for turn in 1..=2 {
        let failed = if turn == 1 { among_mates(&server, &bad).await } else { ask(&server, &bad, 1, &POISON).await.unwrap_err() };
        assert_eq!(failure(&failed), (Code::Internal, "NONFINITE_OUTPUT".into()));
        let text = server.get("/metrics").await.text;
        assert!(text.contains(&format!("ada_nonfinite_total{{where=\"denoiser\"}} {turn}\n")), "{text}");
    }
    assert_eq!(server.metric("ada_engine_panics_total").await, 0.0);
    assert_eq!(bits(&ask(&server, &bad, 1, &STATE).await.unwrap()), undisturbed(2..3, &STATE).await[0]);
}

/// A panic on the way home from the engine, in the thread that all share, cost the whole batch.
#[tokio::test(flavor = "multi_thread")]
async fn a_panic_over_an_answer_costs_that_answer() {
    let (_process, server) = start_armed(&[HELD, "computed=panic@state=7"], &ONE_BATCH).await;
    let bad = open(&server, 2).await;
    assert_eq!(failure(&among_mates(&server, &bad).await), (Code::Internal, "ENGINE_PANIC".into()));
}

/// What panics once is tried again, and nobody hears of it.
#[tokio::test(flavor = "multi_thread")]
async fn a_panic_by_chance_is_tried_again() {
    let expected = &undisturbed(3..4, &STATE).await[0];
    for nth in [1, 2, 3] {
        let (_process, server) = start_armed(&[&format!("evaluating=panic@{nth}")], &ONE_BATCH).await;
        let id = open(&server, 3).await;
        assert_eq!(&bits(&ask(&server, &id, 1, &STATE).await.unwrap()), expected, "evaluation {nth}");
        assert_eq!(server.metric("ada_engine_panics_total").await, 1.0);
    }
}

/// Wherever it panics, its caller is told at once, or answered; the same act again is the one act, and the others go on. With a store a panic after the
/// commit took the store's thread along, and with it every commit after that.
#[tokio::test(flavor = "multi_thread")]
async fn a_panic_at_any_point_costs_one_try() {
    let expected = &undisturbed(4..5, &STATE).await[0];
    for (point, first, with_store, replayed) in [
        ("admitted", Some("INTERNAL"), true, false),
        ("computed", Some("ENGINE_PANIC"), true, false),
        ("stored", Some("ENGINE_PANIC"), false, false),
        ("stored", Some("ENGINE_PANIC"), true, true),
        ("told", None, true, true),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let server = start(|config| {
            config.faults = ada_diffuser::serve::fault::Faults::new(&[format!("{point}=panic@1").parse().unwrap()]);
            if with_store {
                config.store.dir = dir.path().to_owned();
            }
        })
        .await;
        let id = open(&server, 4).await;
        let told = ask(&server, &id, 1, &STATE).await;
        assert_eq!(told.err().map(|error| failure(&error)), first.map(|reason| (Code::Internal, reason.to_owned())), "{point}");
        let again = ask(&server, &id, 1, &STATE).await.unwrap();
        assert_eq!((&bits(&again), again.replayed), (expected, replayed), "{point}, store: {with_store}");
        ask(&server, &id, 2, &STATE).await.unwrap();
        let other = open(&server, 5).await;
        ask(&server, &other, 1, &STATE).await.unwrap();
        assert_eq!(server.get("/readyz").await.status, 200);
    }
}

/// Killed at each point by itself, the server goes on as if it had not been: what was committed is answered again, what was not is computed.
#[tokio::test(flavor = "multi_thread")]
async fn killed_at_any_point_it_goes_on() {
    let expected = &undisturbed(6..7, &STATE).await[0];
    for (point, committed) in [("admitted", false), ("evaluating", false), ("computed", false), ("stored", true), ("told", true)] {
        let dir = tempfile::tempdir().unwrap();
        let store = format!("store.dir={}", dir.path().display());
        let (mut process, server) = start_armed(&[&format!("{point}=kill@1")], &[&store]).await;
        let id = open(&server, 6).await;
        let told = ask(&server, &id, 1, &STATE).await;
        assert_eq!(ended(&mut process).await.signal(), Some(6), "{point}");
        assert!(point == "told" || told.is_err(), "{point}: nothing is told before it is committed");
        let (_process, server) = start_process(&[&store]).await;
        let again = ask(&server, &id, 1, &STATE).await.unwrap();
        assert_eq!((&bits(&again), again.replayed), (expected, committed), "{point}");
    }
    let (mut process, _server) = start_armed(&["draining=kill"], &[]).await;
    terminate(&process);
    assert_eq!(ended(&mut process).await.signal(), Some(6));
}

/// The drain that hangs ends with the second signal.
#[tokio::test(flavor = "multi_thread")]
async fn a_drain_that_hangs_ends_at_the_second_signal() {
    let (mut process, server) = start_armed(&["draining=hang"], &[]).await;
    terminate(&process);
    let draining = async { while server.get("/readyz").await.status == 200 {} };
    timeout(Duration::from_secs(5), draining).await.expect("it does not drain");
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(process.0.try_wait().unwrap().is_none());
    terminate(&process);
    assert_eq!(ended(&mut process).await.code(), Some(0));
}

/// A worker that hangs for ever: both probes say so, its act has its deadline, the others are served by the one that takes its place, and the drain ends.
#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_hangs_is_seen_and_the_others_are_served() {
    let expected = undisturbed(20..24, &STATE).await;
    let settings = ["engine.workers=1", "engine.heartbeat_age_ms_max=1000", "sessions.reap_interval_ms=100"];
    let (mut process, server) = start_armed(&["evaluating=hang@state=7"], &settings).await;
    let bad = open(&server, 2).await;
    let hurried = pb::ActRequest { deadline_ms: Some(2000), ..asked(&bad, 1, &POISON) };
    let (mut agent, begin) = (server.agent().await, Instant::now());
    let hung = tokio::spawn(async move { agent.act(hurried).await });
    server.until(&bad, |session| session["busy"] == true).await;
    assert_eq!((server.get("/livez").await.status, server.get("/readyz").await.status), (200, 200), "it may be busy");
    for (seed, expected) in (20..24).zip(&expected) {
        let id = open(&server, seed).await;
        assert_eq!(&bits(&ask(&server, &id, 1, &STATE).await.unwrap()), expected);
    }
    assert!(begin.elapsed() > Duration::from_secs(1), "there is only one");
    assert_eq!(failure(&hung.await.unwrap().unwrap_err()), (Code::DeadlineExceeded, "DEADLINE_COMPUTE".into()));
    assert_eq!((server.get("/livez").await.status, server.get("/readyz").await.status), (503, 503));
    assert_eq!(server.metric("ada_engine_workers_replaced_total").await, 1.0);
    assert_eq!(server.metric("ada_engine_workers_silent").await, 1.0);
    assert!(server.metric("ada_engine_heartbeat_age_seconds").await > 1.0);
    terminate(&process);
    assert_eq!(ended(&mut process).await.code(), Some(0));
}

/// One that comes back answers its act, if that is still waited for, and the probes are content.
#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_comes_back_answers() {
    let expected = &undisturbed(2..3, &POISON).await[0];
    let settings = ["engine.workers=1", "engine.heartbeat_age_ms_max=600", "sessions.reap_interval_ms=100"];
    let (_process, server) = start_armed(&["evaluating=hang:2500@1"], &settings).await;
    let bad = open(&server, 2).await;
    let (mut agent, request) = (server.agent().await, asked(&bad, 1, &POISON));
    let hung = tokio::spawn(async move { agent.act(request).await });
    let becomes = async |status: u16| while server.get("/livez").await.status != status {};
    timeout(Duration::from_secs(5), becomes(503)).await.expect("nobody sees it");
    let answer = timeout(Duration::from_secs(10), hung).await.expect("it is not answered").unwrap().unwrap().into_inner();
    assert_eq!(&bits(&answer), expected);
    timeout(Duration::from_secs(5), becomes(200)).await.expect("it has come back");
}

/// A process that stood still as a whole goes on with the threads that it has: each of them looks silent at first.
#[tokio::test(flavor = "multi_thread")]
async fn a_process_that_stood_still_does_not_hang() {
    let settings = ["engine.workers=2", "engine.heartbeat_age_ms_max=1000", "sessions.reap_interval_ms=2"];
    let (process, server) = start_process(&settings).await;
    let signal = |signal: &str| Command::new("kill").args([signal, &process.0.id().to_string()]).status().unwrap().success();
    let slow = server.open(json!({"model": "slow"})).await;
    let busy = server.start_slow(&slow).await;
    assert!(signal("-STOP"));
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert!(signal("-CONT"));
    let id = open(&server, 2).await;
    ask(&server, &id, 1, &STATE).await.unwrap();
    tokio::time::sleep(Duration::from_millis(700)).await;
    assert_eq!(server.metric("ada_engine_workers_replaced_total").await, 0.0);
    assert_eq!((server.get("/livez").await.status, busy.is_finished()), (200, false));
    busy.abort();
}

/// A fault that nobody can mean is refused at the start, and those that are meant are not in the help.
#[test]
fn a_wrong_fault_is_refused() {
    let run = |word: &[&str]| binary(&[]).args(word).output().unwrap();
    let wrong = run(&["--fault", "evaluating=tickle"]);
    let said = String::from_utf8_lossy(&wrong.stderr).into_owned();
    assert!(!wrong.status.success() && said.contains("there are kill, panic, hang, leak, nonfinite"), "{said}");
    assert!(!String::from_utf8_lossy(&run(&["--help"]).stdout).contains("--fault"));
}
