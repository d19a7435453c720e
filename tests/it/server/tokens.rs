//! Resume tokens: a session goes on elsewhere under its own id, with no store, and nothing that was committed is taken back.

use super::{bytes::bits, *};
use base64::{Engine, prelude::BASE64_STANDARD};
use std::os::unix::fs::PermissionsExt;

/// What is seen at a step.
fn seen(step: u64) -> Vec<f32> {
    (0..4).map(|i| ((step * 5 + i) as f32 * 0.37).sin()).collect()
}

async fn answer(server: &Running, id: &str, step: u64) -> pb::ActResponse {
    let asked = pb::ActRequest { want_planned_states: true, ..act(id, step, &seen(step)) };
    server.agent().await.act(asked).await.unwrap().into_inner()
}

async fn open(server: &Running) -> String {
    let options = pb::SamplerOptions { eta: Some(0.7), temperature: Some(1.0), ..Default::default() };
    let request = pb::OpenSessionRequest { seed: Some(3), options: Some(options), request_id: "once".into(), ..Default::default() };
    server.agent().await.open_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

async fn token(server: &Running, id: &str) -> Vec<u8> {
    server.agent().await.seal_session(pb::SealSessionRequest { session_id: id.to_owned() }).await.unwrap().into_inner().token
}

async fn resume(server: &Running, token: &[u8]) -> Result<pb::Session, Status> {
    let request = pb::ResumeSessionRequest { token: token.to_vec() };
    Ok(server.agent().await.resume_session(request).await?.into_inner().session.unwrap())
}

fn reason(status: &Status) -> &str {
    status.metadata().get("ada-reason").unwrap().to_str().unwrap()
}

/// A file of these keys.
fn keys(dir: &Path, of: &[u8]) -> PathBuf {
    let path = dir.join(format!("keys{of:?}"));
    let lines: Vec<String> = of.iter().map(|key| BASE64_STANDARD.encode([*key; 32])).collect();
    fs::write(&path, lines.join("\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    path
}

async fn with_keys(dir: &Path, of: &[u8], adjust: impl FnOnce(&mut Config)) -> Running {
    let path = keys(dir, of);
    start(|config| {
        config.tokens.key_file = path;
        adjust(config);
    })
    .await
}

/// From server to server with a key in common and back again, over both faces: the same id, the same answers as if nothing had been between, the last one
/// given again.
#[tokio::test(flavor = "multi_thread")]
async fn a_session_goes_on_wherever_the_key_is() {
    let dir = tempfile::tempdir().unwrap();
    let (plain, here) = (start(|_| {}).await, with_keys(dir.path(), &[1], |_| {}).await);
    let there = with_keys(dir.path(), &[2, 1], |config| config.engine.workers = 1).await;
    let undisturbed = open(&plain).await;
    let mut expected = Vec::new();
    for step in 1..=8 {
        expected.push(bits(&answer(&plain, &undisturbed, step).await));
    }
    let id = open(&here).await;
    for step in 1..=3 {
        assert_eq!(bits(&answer(&here, &id, step).await), expected[step as usize - 1]);
    }
    let sealed = token(&here, &id).await;
    let session = resume(&there, &sealed).await.unwrap();
    assert_eq!((session.session_id.as_str(), session.committed_step, session.episode, session.seed), (id.as_str(), 3, 0, 3));
    let again = answer(&there, &id, 3).await;
    assert!(again.replayed && bits(&again) == expected[2], "{again:?}");
    // The name of the open is remembered, so that a retry of it opens nothing.
    assert_eq!(open(&there).await, id);
    for step in 4..=6 {
        assert_eq!(bits(&answer(&there, &id, step).await), expected[step as usize - 1]);
    }
    // Back to where it is known as it was at step 3, over JSON; that server has not the newer key, but `there` can seal with the old one alone.
    let back = with_keys(dir.path(), &[1], |_| {}).await;
    assert_eq!(resume(&back, &sealed).await.unwrap().committed_step, 3);
    let reply = there.http("POST", &format!("/v1/sessions/{id}/seal"), "").await;
    assert_eq!((reply.status, reply.json()["expires_in_ms"].as_u64()), (200, Some(86_400_000)), "{reply:?}");
    let newer = json!({"token": reply.json()["token"]});
    let refused = back.post("/v1/sessions:resume", &newer).await;
    assert_eq!((refused.status, refused.json()["field"].as_str()), (400, Some("token")), "another key: {refused:?}");
    let third = with_keys(dir.path(), &[1, 2], |_| {}).await;
    assert_eq!(resume(&third, &sealed).await.unwrap().committed_step, 3, "an older state");
    let reply = third.post("/v1/sessions:resume", &newer).await;
    assert_eq!(
        (reply.status, reply.json()["session"]["committed_step"].as_u64()),
        (201, Some(6)),
        "makes room for the newer one: {reply:?}"
    );
    for step in 7..=8 {
        assert_eq!(bits(&answer(&third, &id, step).await), expected[step as usize - 1]);
    }
}

/// An old token does not take back what was committed since, nor a reset; with a store, not after a restart either.
#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_rolled_back() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store");
    let key_file = format!("tokens.key_file={}", keys(dir.path(), &[1]).display());
    let settings = [format!("store.dir={}", store.display()), key_file];
    let settings = settings.each_ref().map(String::as_str);
    let (process, server) = start_process(&settings).await;
    let id = open(&server).await;
    answer(&server, &id, 1).await;
    let first = token(&server, &id).await;
    assert_eq!(resume(&server, &first).await.unwrap().committed_step, 1, "the same state is no rollback");
    let second = answer(&server, &id, 2).await;
    drop(process);
    let (_process, server) = start_process(&settings).await;
    let stale = resume(&server, &first).await.unwrap_err();
    let trailer = |name: &str| stale.metadata().get(name).map(|value| value.to_str().unwrap().to_owned());
    assert_eq!(
        (stale.code(), reason(&stale), trailer("ada-committed-step").as_deref()),
        (Code::Aborted, "TOKEN_STALE", Some("2")),
        "{stale:?}"
    );
    let again = answer(&server, &id, 2).await;
    assert!(again.replayed && bits(&again) == bits(&second));
    let newer = token(&server, &id).await;
    let reset = pb::ResetSessionRequest { session_id: id.clone(), seed: Some(5), ..Default::default() };
    server.agent().await.reset_session(reset).await.unwrap();
    let reply = server.post("/v1/sessions:resume", &json!({"token": BASE64_STANDARD.encode(&newer)})).await;
    let told = reply.json();
    assert_eq!((reply.status, told["reason"].as_str(), told["episode"].as_u64()), (409, Some("TOKEN_STALE"), Some(1)), "{reply:?}");
}

/// What a store has lost, or cannot read any more, a token brings back; and then the store has it.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_store_is_made_up_for() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store");
    let key_file = format!("tokens.key_file={}", keys(dir.path(), &[1]).display());
    let settings = [format!("store.dir={}", store.display()), key_file];
    let settings = settings.each_ref().map(String::as_str);
    let (process, server) = start_process(&settings).await;
    let id = open(&server).await;
    answer(&server, &id, 1).await;
    let sealed = token(&server, &id).await;
    drop(process);
    fs::remove_dir_all(&store).unwrap();
    let (process, server) = start_process(&settings).await;
    let gone = server.agent().await.act(act(&id, 2, &seen(2))).await.unwrap_err();
    assert_eq!(reason(&gone), "SESSION_NOT_FOUND");
    assert_eq!(resume(&server, &sealed).await.unwrap().committed_step, 1);
    let second = answer(&server, &id, 2).await;
    drop(process);
    let (_process, server) = start_process(&settings).await;
    let again = answer(&server, &id, 2).await;
    assert!(again.replayed && bits(&again) == bits(&second), "it is in the store as any other");
}

/// Each way in which a token is none is told by its word.
#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_token_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let server = with_keys(dir.path(), &[1], |_| {}).await;
    let id = open(&server).await;
    let sealed = token(&server, &id).await;
    let plain = start(|_| {}).await;
    let other = open(&plain).await;
    let without = plain.agent().await.seal_session(pb::SealSessionRequest { session_id: other }).await.unwrap_err();
    assert!(without.code() == Code::InvalidArgument && without.message().contains("tokens.key_file"), "{without:?}");
    let without = resume(&plain, &sealed).await.unwrap_err();
    assert!(without.code() == Code::InvalidArgument && without.message().contains("tokens.key_file"), "{without:?}");
    let mut changed = sealed.clone();
    *changed.last_mut().unwrap() ^= 1;
    for token in [&changed[..], b"", b"ADAT", &sealed[..40]] {
        let refused = resume(&server, token).await.unwrap_err();
        assert_eq!((refused.code(), reason(&refused)), (Code::InvalidArgument, "REQUEST_INVALID"), "{refused:?}");
    }
    let reply = server.post("/v1/sessions:resume", &json!({"token": "?"})).await;
    assert_eq!((reply.status, reply.json()["field"].as_str()), (400, Some("token")), "{reply:?}");
    let unknown =
        server.agent().await.seal_session(pb::SealSessionRequest { session_id: uuid::Uuid::new_v4().to_string() }).await.unwrap_err();
    assert_eq!(reason(&unknown), "SESSION_NOT_FOUND");
    // A closed session is one that nobody knows: its token is all there is of it.
    server.agent().await.close_session(pb::CloseSessionRequest { session_id: id.clone() }).await.unwrap();
    assert_eq!(resume(&server, &sealed).await.unwrap().session_id, id);
}
