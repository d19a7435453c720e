//! A session as bytes: it goes on elsewhere, after a restart, or twice, with the same answers; over both faces alike.

use super::{
    bytes::{bits, bits_json},
    methods::{alike, fresh, serve},
    *,
};
use base64::{Engine, prelude::BASE64_STANDARD};

const NOISY: (f32, f32) = (0.7, 1.0);

/// What is seen at a step.
fn seen(step: u64) -> Vec<f32> {
    (0..4).map(|i| ((step * 5 + i) as f32 * 0.37).sin()).collect()
}

fn asked(id: &str, step: u64) -> pb::ActRequest {
    pb::ActRequest { want_planned_states: true, ..act(id, step, &seen(step)) }
}

async fn answer(server: &Running, id: &str, step: u64) -> pb::ActResponse {
    server.agent().await.act(asked(id, step)).await.unwrap().into_inner()
}

async fn answer_rest(server: &Running, id: &str, step: u64) -> Value {
    let body = json!({"step": step, "observation": {"state": seen(step)}, "want_planned_states": true});
    let reply = server.post(&format!("/v1/sessions/{id}/act"), &body).await;
    assert_eq!(reply.status, 200, "{reply:?}");
    reply.json()
}

async fn answers(server: &Running, id: &str, steps: std::ops::RangeInclusive<u64>) -> Vec<Vec<u32>> {
    let mut all = Vec::new();
    for step in steps {
        all.push(bits(&answer(server, id, step).await));
    }
    all
}

/// A session with all noise there is that has been reset once, and has acted three times since.
async fn lived(server: &Running) -> String {
    let options = pb::SamplerOptions { eta: Some(NOISY.0), temperature: Some(NOISY.1), ..Default::default() };
    let request = pb::OpenSessionRequest { seed: Some(3), options: Some(options), ttl_ms: Some(50_000), ..Default::default() };
    let mut agent = server.agent().await;
    let id = agent.open_session(request).await.unwrap().into_inner().session.unwrap().session_id;
    answer(server, &id, 1).await;
    let reset = pb::ResetSessionRequest { session_id: id.clone(), seed: Some(4), request_id: "once".into(), ..Default::default() };
    agent.reset_session(reset).await.unwrap();
    answers(server, &id, 1..=3).await;
    id
}

async fn export(server: &Running, id: &str) -> Vec<u8> {
    let request = pb::ExportSessionRequest { session_id: id.to_owned() };
    server.agent().await.export_session(request).await.unwrap().into_inner().record
}

async fn import(server: &Running, record: &[u8]) -> Result<pb::Session, Status> {
    let request = pb::ImportSessionRequest { record: record.to_vec(), ..Default::default() };
    Ok(server.agent().await.import_session(request).await?.into_inner().session.unwrap())
}

/// On the same server and on another one, over either face, the imported session is what the exported one was: where it stands, the answer that somebody
/// may have lost, and its whole future. The one that was exported goes on too.
#[tokio::test(flavor = "multi_thread")]
async fn an_exported_session_goes_on_elsewhere() {
    let (here, there) = (start(|_| {}).await, start(|config| config.engine.workers = 1).await);
    let id = lived(&here).await;
    let (record, last) = (export(&here, &id).await, answer(&here, &id, 3).await);
    let summary =
        here.agent().await.get_session(pb::GetSessionRequest { session_id: id.clone() }).await.unwrap().into_inner().session.unwrap();
    let exported = here.get(&format!("/v1/sessions/{id}/export")).await;
    assert_eq!(BASE64_STANDARD.decode(exported.json()["record"].as_str().unwrap()).unwrap(), record, "both faces");
    let expected = answers(&here, &id, 4..=8).await;
    for server in [&here, &there] {
        let session = import(server, &record).await.unwrap();
        assert_ne!(session.session_id, id);
        let same = |session: &pb::Session| (session.committed_step, session.episode, session.seed, session.ttl_ms, session.options.clone());
        assert_eq!(same(&session), same(&summary));
        assert_eq!((session.committed_step, session.episode, session.seed), (3, 1, 4));
        let replayed = answer(server, &session.session_id, 3).await;
        assert!(replayed.replayed && bits(&replayed) == bits(&last) && replayed.session_id == session.session_id, "{replayed:?}");
        assert_eq!((&replayed.timings, &replayed.model_digest), (&last.timings, &last.model_digest));
        assert_eq!(answers(server, &session.session_id, 4..=8).await, expected);
        // A reset of the session that comes once more resets nothing here either.
        let mut agent = server.agent().await;
        let late = pb::ResetSessionRequest { session_id: session.session_id.clone(), request_id: "once".into(), ..Default::default() };
        assert_eq!(agent.reset_session(late).await.unwrap().into_inner().session.unwrap().committed_step, 8);
        // The answer of the export is the body of an import.
        let opened = server.http("POST", "/v1/sessions:import", &exported.text).await;
        assert_eq!(opened.status, 201, "{opened:?}");
        let id = opened.json()["session"]["session_id"].as_str().unwrap().to_owned();
        assert_eq!(opened.json()["model"]["digest"], last.model_digest);
        for (step, expected) in (4..=8).zip(&expected) {
            assert_eq!(bits_json(&answer_rest(server, &id, step).await), *expected);
        }
    }
}

/// A fork has the same future or another one, and neither of the two hears of the other.
#[tokio::test(flavor = "multi_thread")]
async fn a_fork_has_a_future_of_its_own() {
    let server = start(|_| {}).await;
    let id = lived(&server).await;
    let mut agent = server.agent().await;
    let fork = |seed| pb::ForkSessionRequest { session_id: id.clone(), seed, ..Default::default() };
    let same = agent.fork_session(fork(None)).await.unwrap().into_inner();
    let other = agent.fork_session(fork(Some(99))).await.unwrap().into_inner().session.unwrap();
    let reply = server.http("POST", &format!("/v1/sessions/{id}/fork"), "").await;
    assert_eq!(reply.status, 201, "{reply:?}");
    let rest = reply.json()["session"]["session_id"].as_str().unwrap().to_owned();
    let (model, same) = (same.model.unwrap(), same.session.unwrap());
    assert_eq!((model.name.as_str(), model.is_default), ("tiny", true));
    assert_eq!((same.seed, other.seed, other.committed_step, other.episode, other.ttl_ms), (4, 99, 3, 1, 50_000));
    let last = answer(&server, &id, 3).await;
    for fork in [&same.session_id, &other.session_id, &rest] {
        let replayed = answer(&server, fork, 3).await;
        assert!(replayed.replayed && bits(&replayed) == bits(&last), "the past is shared");
    }
    let expected = answers(&server, &id, 4..=8).await;
    assert_eq!(answers(&server, &same.session_id, 4..=8).await, expected);
    assert_eq!(answers(&server, &rest, 4..=8).await, expected);
    let otherwise = answers(&server, &other.session_id, 4..=8).await;
    assert!(otherwise.iter().zip(&expected).all(|(a, b)| a != b), "another seed");
    // Where it stands can be asked for; a name stands for one fork.
    let at = |step, episode, request_id: &str| pb::ForkSessionRequest { step, episode, request_id: request_id.into(), ..fork(None) };
    let status = agent.fork_session(at(Some(7), None, "")).await.unwrap_err();
    assert_eq!(failure(&status), (Code::Aborted, "STEP_OUT_OF_ORDER".into()));
    assert_eq!(trailer(&status, "ada-committed-step").as_deref(), Some("8"));
    let status = agent.fork_session(at(Some(8), Some(0), "")).await.unwrap_err();
    assert_eq!(failure(&status), (Code::Aborted, "EPISODE_OVER".into()));
    let reply = server.post(&format!("/v1/sessions/{id}/fork"), &json!({"step": 7})).await;
    assert_eq!((reply.status, reply.reason().as_str()), (409, "STEP_OUT_OF_ORDER"));
    let named = |agent: &AgentClient<Channel>| {
        let (mut agent, request) = (agent.clone(), at(Some(8), Some(1), "twin"));
        async move { agent.fork_session(request).await.unwrap().into_inner().session.unwrap().session_id }
    };
    let twin = named(&agent).await;
    assert_eq!(named(&agent).await, twin);
    // The parent's end is not theirs.
    agent.close_session(pb::CloseSessionRequest { session_id: id.clone() }).await.unwrap();
    answer(&server, &twin, 9).await;
    assert_eq!(agent.fork_session(fork(None)).await.map_err(|status| failure(&status)).unwrap_err().1, "SESSION_NOT_FOUND");
    let gone = pb::ExportSessionRequest { session_id: id };
    assert_eq!(failure(&agent.export_session(gone).await.unwrap_err()), (Code::NotFound, "SESSION_NOT_FOUND".into()));
}

/// What is no record, was damaged, or is of a model that is not there, is refused by name; and no session comes of it.
#[tokio::test(flavor = "multi_thread")]
async fn a_record_that_cannot_go_on_says_why() {
    let server = start(|_| {}).await;
    let id = lived(&server).await;
    let record = export(&server, &id).await;
    let mut flipped = record.clone();
    flipped[record.len() / 2] ^= 4;
    let newer = [b"ADAS\x63", &record[5..]].concat();
    for (record, reason) in [
        (&b""[..], "is no session that was exported"),
        (&record[..record.len() - 1], "is damaged"),
        (&flipped, "is damaged"),
        (&newer, "is of format 99"),
    ] {
        let grpc = import(&server, record).await.unwrap_err();
        let http = server.post("/v1/sessions:import", &json!({"record": BASE64_STANDARD.encode(record)})).await;
        let (field, why) = alike(&grpc, &http, "REQUEST_INVALID");
        assert!(field == "record" && why.contains(reason), "{field}: {why}");
    }
    for (body, field) in [(json!({"record": "%"}), "record"), (json!({}), "record"), (json!({"record": "", "seed": 1}), "seed")] {
        let reply = server.post("/v1/sessions:import", &body).await;
        assert_eq!((reply.status, reply.json()["field"].as_str()), (400, Some(field)), "{reply:?}");
    }
    // Of a model of other weights: its digest is unknown here.
    let other = serve(&fresh(|_| {})).await;
    let grpc = import(&other, &record).await.unwrap_err();
    let http = other.post("/v1/sessions:import", &json!({"record": BASE64_STANDARD.encode(&record)})).await;
    assert_eq!((failure(&grpc), http.status, http.reason().as_str()), ((Code::NotFound, "MODEL_GONE".into()), 410, "MODEL_GONE"));
    assert!(grpc.message().contains("tiny@") && grpc.message().contains("there are: fresh"), "{grpc:?}");
    assert_eq!(http.json()["detail"], grpc.message());
    assert_eq!(other.get("/v1/sessions").await.json()["sessions"], json!([]), "none was opened");
}

/// The same weights under another name will do; and a session that outlived its server is taken up by the next one.
#[tokio::test(flavor = "multi_thread")]
async fn a_session_outlives_its_server() {
    let (process, first) = start_process(&[]).await;
    let id = lived(&first).await;
    let (record, last) = (export(&first, &id).await, answer(&first, &id, 3).await);
    let expected = answers(&first, &id, 4..=6).await;
    drop(process);
    let dir = tempfile::tempdir().unwrap();
    copy(&models_dir().join("tiny"), &dir.path().join("renamed"));
    let second = start(|config| {
        config.models.dir = dir.path().to_owned();
        config.models.default = "renamed".to_owned();
    })
    .await;
    let session = import(&second, &record).await.unwrap();
    assert_eq!(session.model, "renamed");
    assert_eq!(bits(&answer(&second, &session.session_id, 3).await), bits(&last));
    assert_eq!(answers(&second, &session.session_id, 4..=6).await, expected);
}
