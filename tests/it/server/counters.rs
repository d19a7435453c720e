//! What is counted adds up, whatever clients do.

use super::*;

/// An act that was cancelled was in no total, and one evaluation in twenty in no counter. Acts of every kind at once, over both faces: answered,
/// repeated, out of order, in a hurry, hung up on at any moment, and of a session that is closed under them.
#[tokio::test(flavor = "multi_thread")]
async fn every_act_and_every_evaluation_is_counted_once() {
    let (_process, server) = start_process(&["engine.workers=2", "engine.batch_len_max=4"]).await;
    // One is hung up on in the middle, so that something is in vain.
    let slow = server.open(json!({"model": "slow"})).await;
    let in_vain = server.start_slow(&slow).await;
    while server.metric("ada_batches_total").await < 1.0 {}
    in_vain.abort();
    let (mut told, mut sent) = (0, 1);
    let mut clients = tokio::task::JoinSet::new();
    for client in 0..12_u64 {
        let id = server.open(json!({"seed": client, "options": {"sub_steps": 5}})).await;
        clients.spawn(mixed(server.agent().await, server.address, id, client));
    }
    for (answers, acts) in clients.join_all().await {
        (told, sent) = (told + answers, sent + acts);
    }
    let settled = async {
        while server.metric("ada_inflight_acts").await + server.metric("ada_queue_depth").await > 0.0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    timeout(Duration::from_secs(10), settled).await.expect("something is left in the engine");
    let count = async |name: &str| server.metric(name).await as u64;
    let acts = count("ada_acts_total").await;
    assert!((told..=sent).contains(&acts), "{told} answers, {acts} counted, {sent} sent");
    let cancelled = server.get("/metrics").await.text.lines().any(|line| line.starts_with("ada_acts_total") && line.contains("CANCELLED"));
    assert!(cancelled, "some of them were hung up on in time");
    let spent = count("ada_batch_size_sum").await;
    let (useful, wasted) = (count("ada_network_evaluations_total").await, count("ada_wasted_network_evaluations_total").await);
    assert!(spent > 0 && wasted > 0, "{spent} {wasted}");
    assert_eq!(useful + wasted, spent, "evaluations of acts, and in vain");
    let (created, ended) = (count("ada_sessions_created_total").await, count("ada_sessions_ended_total").await);
    assert_eq!(created - ended, count("ada_sessions").await);
}

/// An act that is hung up on while it is computed is one more in the total.
#[tokio::test(flavor = "multi_thread")]
async fn a_cancelled_act_is_counted() {
    let (_process, server) = start_process(&[]).await;
    let slow = server.open(json!({"model": "slow"})).await;
    server.start_slow(&slow).await.abort();
    let counted = async { while server.metric("ada_acts_total").await < 1.0 {} };
    timeout(Duration::from_secs(5), counted).await.expect("it is in no total");
    let text = server.get("/metrics").await.text;
    assert!(text.lines().any(|line| line.starts_with("ada_acts_total") && line.contains("CANCELLED") && line.ends_with(" 1")), "{text}");
}

/// Everything that can become of an act, at once: each that was received is answered, shed, cancelled or failed, once, and what is counted apart agrees
/// with that.
#[tokio::test(flavor = "multi_thread")]
async fn acts_are_conserved_whatever_befalls_them() {
    let faults =
        ["evaluating=panic@state=7", "evaluating=nonfinite@state=8", "computed=panic@state=9", "evaluating=panic@40", "admitted=panic@30"];
    let settings = ["engine.workers=2", "engine.batch_len_max=4", "engine.queue_len_max=6"];
    let (_process, server) = start_armed(&faults, &settings).await;
    let mut clients = tokio::task::JoinSet::new();
    for client in 0..16_u64 {
        let id = server.open(json!({"seed": client, "options": {"sub_steps": 5}})).await;
        let (agent, address, first) = (server.agent().await, server.address, [0.1, 7.0, 0.1, 8.0, 0.1, 9.0, 0.1, 0.1][client as usize % 8]);
        clients.spawn(async move {
            let mut bad = agent.clone();
            for step in 1..=8 {
                // Nobody asks whether it is told.
                let _told = bad.act(act(&id, step, &[first, 0.2, 0.3, 0.4])).await;
            }
            mixed(agent, address, id, client).await
        });
    }
    clients.join_all().await;
    let left = async || server.metric("ada_inflight_acts").await + server.metric("ada_queue_depth").await;
    let ends = async { while left().await > 0.0 {} };
    timeout(Duration::from_secs(10), ends).await.expect("something is left in the engine");
    let text = server.get("/metrics").await.text;
    let count = |name: &str, labels: &[&str]| -> f64 {
        let of = |line: &&str| {
            line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' ']) && labels.iter().all(|label| rest.contains(label)))
        };
        text.lines().filter(of).map(|line| line.rsplit(' ').next().unwrap().parse::<f64>().unwrap()).sum()
    };
    let acts = |codes: &[&str]| -> f64 { codes.iter().map(|code| count("ada_acts_total", &[&format!("code=\"{code}\"")])).sum() };
    let (ok, cancelled) = (acts(&["OK"]), acts(&["CANCELLED"]));
    let shed = acts(&["QUEUE_FULL", "DEADLINE_ADMISSION", "DEADLINE_QUEUE"]);
    let failed = acts(&["POISON_STEP", "NONFINITE_OUTPUT", "ENGINE_PANIC", "INTERNAL", "DEADLINE_COMPUTE"]);
    let refused = acts(&["STEP_OUT_OF_ORDER", "STEP_PAYLOAD_MISMATCH", "SESSION_BUSY", "SESSION_NOT_FOUND"]);
    let received = count("ada_acts_received_total", &[]);
    assert_eq!(received, ok + shed + cancelled + failed + refused, "{text}");
    for (kind, sum) in [("ok", ok), ("cancelled", cancelled), ("shed", shed), ("refused", refused)] {
        assert!(sum > 0.0, "{kind}: {text}");
    }
    for code in ["POISON_STEP", "NONFINITE_OUTPUT", "ENGINE_PANIC", "INTERNAL"] {
        assert!(acts(&[code]) > 0.0, "{code}: {text}");
    }
    let shed_apart =
        ["QUEUE_FULL", "DEADLINE_ADMISSION", "DEADLINE_QUEUE"].map(|reason| count("ada_shed_total", &[&format!("reason=\"{reason}\"")]));
    assert_eq!(shed_apart.iter().sum::<f64>(), shed);
    assert_eq!(count("ada_nonfinite_total", &[]), acts(&["NONFINITE_OUTPUT"]), "each has one caller");
    assert_eq!(count("ada_act_duration_seconds_count", &[]), ok);
    let (useful, wasted) = (count("ada_network_evaluations_total", &[]), count("ada_wasted_network_evaluations_total", &[]));
    assert_eq!(useful + wasted, count("ada_batch_size_sum", &[]), "evaluations of acts, and in vain");
    let (created, ended) = (count("ada_sessions_created_total", &[]), count("ada_sessions_ended_total", &[]));
    assert_eq!(created - ended, count("ada_sessions", &[]));
}

/// What a client does: how many of its acts were answered, well or not, and how many it sent.
async fn mixed(mut agent: AgentClient<Channel>, address: SocketAddr, id: String, client: u64) -> (u64, u64) {
    let server = Running::elsewhere(address);
    let (mut told, mut sent, mut step) = (0, 0, 1);
    for turn in 0..40_u64 {
        sent += 1;
        let request = match (turn + client) % 6 {
            0 => act(&id, step + 5, &STATE),
            1 => pb::ActRequest { deadline_ms: Some(1 + (turn % 3) as u32), ..act(&id, step, &STATE) },
            _ => act(&id, step, &STATE),
        };
        if (turn + client) % 6 == 2 {
            let cut = Duration::from_micros(200 * (turn % 12));
            if timeout(cut, agent.act(request)).await.is_ok() {
                told += 1;
            }
            continue;
        }
        if (turn + client) % 6 == 3 {
            let reply = server.act(&id, step, &STATE).await;
            told += 1;
            step += u64::from(reply.status == 200);
            continue;
        }
        told += 1;
        step = match agent.act(request).await {
            Ok(answer) => answer.into_inner().step + 1,
            Err(status) => trailer(&status, "ada-committed-step").map_or(step, |committed| committed.parse::<u64>().unwrap() + 1),
        };
    }
    if client.is_multiple_of(4) {
        server.http("DELETE", &format!("/v1/sessions/{id}"), "").await;
    }
    (told, sent)
}
