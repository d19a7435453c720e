//! Sessions that outlive the process: a real server is killed as hard as it can be, and another one goes on where it stood.

use super::{bytes::bits, *};

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

async fn open(server: &Running, request_id: &str) -> pb::Session {
    let options = pb::SamplerOptions { eta: Some(0.7), temperature: Some(1.0), ..Default::default() };
    let request = pb::OpenSessionRequest { seed: Some(3), options: Some(options), request_id: request_id.into(), ..Default::default() };
    server.agent().await.open_session(request).await.unwrap().into_inner().session.unwrap()
}

async fn get(server: &Running, id: &str) -> Result<pb::Session, Status> {
    let request = pb::GetSessionRequest { session_id: id.to_owned() };
    Ok(server.agent().await.get_session(request).await?.into_inner().session.unwrap())
}

/// A server with a store in this directory, which is killed when it is dropped.
async fn start_with(dir: &Path, settings: &[&str]) -> (Process, Running) {
    let store = format!("store.dir={}", dir.display());
    start_process(&[&[store.as_str()], settings].concat()).await
}

/// Ends a server as a user does.
fn end(mut process: Process) {
    let pid = process.0.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    process.0.wait().unwrap();
}

/// The future of a session of its own that nobody disturbs.
async fn undisturbed(steps: u64) -> Vec<Vec<u32>> {
    let server = start(|_| {}).await;
    let id = open(&server, "").await.session_id;
    let mut all = Vec::new();
    for step in 1..=steps {
        all.push(bits(&answer(&server, &id, step).await));
    }
    all
}

/// Killed after each act, at both levels, the server loses none and gives none twice: the answer that went out is given again, the next step is the next one,
/// and the whole is what one server would have said.
#[tokio::test(flavor = "multi_thread")]
async fn killed_after_each_act_it_goes_on() {
    let expected = undisturbed(5).await;
    for durability in ["store.durability=process", "store.durability=power"] {
        let dir = tempfile::tempdir().unwrap();
        let mut id = String::new();
        let mut last: Option<pb::ActResponse> = None;
        for step in 1..=5 {
            let (process, server) = start_with(dir.path(), &[durability]).await;
            if step == 1 {
                id = open(&server, "once").await.session_id;
            }
            if let Some(last) = &last {
                let again = answer(&server, &id, step - 1).await;
                assert!(again.replayed, "{durability}");
                assert_eq!(pb::ActResponse { replayed: false, ..again }, *last, "{durability}");
            }
            let next = answer(&server, &id, step).await;
            assert!(!next.replayed && bits(&next) == expected[step as usize - 1], "{durability}, step {step}");
            last = Some(next);
            drop(process);
        }
    }
}

/// What fences late copies outlives the process too: names of opens and resets, the number of the episode, what was closed and what has expired.
#[tokio::test(flavor = "multi_thread")]
async fn what_a_session_was_called_is_remembered() {
    let dir = tempfile::tempdir().unwrap();
    let (process, server) = start_with(dir.path(), &[]).await;
    let (first, closed, short) = (open(&server, "a").await, open(&server, "b").await, open(&server, "").await);
    let mut agent = server.agent().await;
    answer(&server, &first.session_id, 1).await;
    let reset =
        pb::ResetSessionRequest { session_id: first.session_id.clone(), seed: Some(9), request_id: "r".into(), ..Default::default() };
    agent.reset_session(reset.clone()).await.unwrap();
    answer(&server, &first.session_id, 1).await;
    agent.close_session(pb::CloseSessionRequest { session_id: closed.session_id.clone() }).await.unwrap();
    let listed = server.get("/v1/sessions?view=full").await.json();
    drop(process);

    let (process, server) = start_with(dir.path(), &[]).await;
    let mut agent = server.agent().await;
    let sessions = |list: &Value| -> Vec<Value> {
        let keep = ["handle", "model", "model_digest", "seed", "committed_step", "episode", "options", "latent_mean", "ttl_ms", "busy"];
        let of = |session: &Value| keep.iter().map(|key| session[*key].clone()).collect();
        list["sessions"].as_array().unwrap().iter().map(of).collect()
    };
    assert_eq!(sessions(&server.get("/v1/sessions?view=full").await.json()), sessions(&listed), "lists tell of what is not in memory");
    assert_eq!(open(&server, "a").await.session_id, first.session_id, "a name stands for one session");
    assert_ne!(open(&server, "b").await.session_id, closed.session_id, "that of a closed one is free");
    assert_eq!(failure(&get(&server, &closed.session_id).await.unwrap_err()), (Code::NotFound, "SESSION_NOT_FOUND".into()));
    let session = agent.reset_session(reset).await.unwrap().into_inner().session.unwrap();
    assert_eq!((session.committed_step, session.episode, session.seed), (1, 1, 9), "a late copy resets nothing");
    let late = pb::ActRequest { episode: Some(0), ..asked(&first.session_id, 2) };
    assert_eq!(failure(&agent.act(late).await.unwrap_err()), (Code::Aborted, "EPISODE_OVER".into()));
    let other =
        pb::ActRequest { observation: Some(pb::Observation { state: vec![9.0; 4], ..Default::default() }), ..asked(&first.session_id, 1) };
    assert_eq!(failure(&agent.act(other).await.unwrap_err()), (Code::FailedPrecondition, "STEP_PAYLOAD_MISMATCH".into()));
    assert!(server.metric("ada_sessions_revived_total").await >= 1.0);
    drop(process);
    let _unasked = short;
}

/// Where memory is short, idle sessions leave it, and come back on their next act as they were.
#[tokio::test(flavor = "multi_thread")]
async fn idle_sessions_leave_memory_and_come_back() {
    let expected = undisturbed(2).await;
    let dir = tempfile::tempdir().unwrap();
    let spare = ["sessions.len_max=4", "sessions.evict_idle_ms=0", "sessions.unused_idle_ms=0"];
    let (_process, server) = start_with(dir.path(), &spare).await;
    let mut ids = Vec::new();
    for _ in 0..12 {
        ids.push(open(&server, "").await.session_id);
    }
    for step in 1..=2 {
        for id in &ids {
            assert_eq!(bits(&answer(&server, id, step).await), expected[step as usize - 1]);
        }
    }
    assert!(server.metric("ada_sessions").await <= 4.0 && server.metric("ada_sessions_spilled_total").await >= 8.0);
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"].as_array().unwrap().len(), 12);
    let pages = server.get("/v1/sessions?page_size=5").await.json();
    let token = pages["next_page_token"].as_str().unwrap().to_owned();
    assert_eq!(pages["sessions"].as_array().unwrap().len(), 5);
    assert_eq!(server.get(&format!("/v1/sessions?page_size=100&page_token={token}")).await.json()["sessions"].as_array().unwrap().len(), 7);
}

/// Many at once, each touched again a moment after it was filed: none of them is refused for want of memory.
#[tokio::test(flavor = "multi_thread")]
async fn many_more_than_memory_holds_come_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let (_process, server) = start_with(dir.path(), &["sessions.len_max=150"]).await;
    let agent = server.agent().await;
    let mut clients = tokio::task::JoinSet::new();
    for client in 0..64_u64 {
        let mut agent = agent.clone();
        clients.spawn(async move {
            for turn in 0..12 {
                let request = pb::OpenSessionRequest { seed: Some(client * 100 + turn), ..Default::default() };
                let id = agent.open_session(request).await.unwrap().into_inner().session.unwrap().session_id;
                for step in 1..=2 {
                    agent.act(asked(&id, step)).await.unwrap();
                }
            }
        });
    }
    clients.join_all().await;
    assert!(server.metric("ada_sessions").await <= 150.0);
    // The store is asked how much it holds now and then.
    let counted = async { while server.metric("ada_store_sessions").await < 768.0 {} };
    timeout(Duration::from_secs(10), counted).await.expect("all of them are kept");
}

/// Time to live goes on behind memory; a restart gives everyone the whole of it again, and an ending is remembered.
#[tokio::test(flavor = "multi_thread")]
async fn what_has_expired_stays_so() {
    let dir = tempfile::tempdir().unwrap();
    let settings = ["sessions.ttl_ms=400", "sessions.reap_interval_ms=50"];
    let (process, server) = start_with(dir.path(), &settings).await;
    let id = open(&server, "").await.session_id;
    drop(process);
    tokio::time::sleep(Duration::from_millis(600)).await;
    let (process, server) = start_with(dir.path(), &settings).await;
    assert_eq!(get(&server, &id).await.unwrap().committed_step, 0, "nobody could reach it meanwhile");
    tokio::time::sleep(Duration::from_millis(900)).await;
    assert_eq!(failure(&get(&server, &id).await.unwrap_err()), (Code::NotFound, "SESSION_EXPIRED".into()));
    drop(process);
    let (_process, server) = start_with(dir.path(), &settings).await;
    assert_eq!(failure(&get(&server, &id).await.unwrap_err()), (Code::NotFound, "SESSION_EXPIRED".into()));
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"], json!([]));
}

/// A session is of its checkpoint: where that is gone it says so, and goes on once it is back. Two servers do not share a store.
#[tokio::test(flavor = "multi_thread")]
async fn a_checkpoint_that_is_gone_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let (process, server) = start_with(dir.path(), &[]).await;
    let id = open(&server, "").await.session_id;
    let taken = binary(&["server.listen=127.0.0.1:0", &format!("store.dir={}", dir.path().display())]).output().unwrap();
    let said = String::from_utf8_lossy(&taken.stderr).into_owned();
    assert!(!taken.status.success() && said.contains("store.dir") && said.contains("already open"), "{said}");
    drop(process);
    let others = super::methods::fresh(|_| {});
    let other = start(|config| {
        config.models.dir = others.path().to_owned();
        config.models.default = "fresh".to_owned();
        config.store.dir = dir.path().to_owned();
    })
    .await;
    let gone = get(&other, &id).await.unwrap_err();
    assert_eq!(failure(&gone), (Code::NotFound, "MODEL_GONE".into()));
    assert!(gone.message().contains("tiny@"), "{gone:?}");
    other.stop.cancel();
    tokio::time::sleep(Duration::from_secs(1)).await;
    drop(other);
    let (_process, server) = start_with(dir.path(), &[]).await;
    answer(&server, &id, 1).await;
}

/// A record that is damaged costs its own session: that one says so, whoever asks, and can be closed; all others go on.
#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_record_costs_its_own_session() {
    let expected = undisturbed(2).await;
    let dir = tempfile::tempdir().unwrap();
    let (process, server) = start_with(dir.path(), &[]).await;
    let (damaged, sound) = (open(&server, "").await.session_id, open(&server, "").await.session_id);
    for id in [&damaged, &sound] {
        answer(&server, id, 1).await;
    }
    end(process);
    let file = dir.path().join("sessions.redb");
    let mut bytes = fs::read(&file).unwrap();
    let id = *uuid::Uuid::parse_str(&damaged).unwrap().as_bytes();
    let places: Vec<_> = bytes.windows(id.len()).enumerate().filter(|(_, window)| *window == id).map(|(at, _)| at).collect();
    assert!(!places.is_empty());
    places.iter().for_each(|at| bytes[at + 40] ^= 1);
    fs::write(&file, bytes).unwrap();

    let (_process, server) = start_with(dir.path(), &[]).await;
    let refused = server.agent().await.act(asked(&damaged, 2)).await.unwrap_err();
    assert_eq!(failure(&refused), (Code::DataLoss, "STATE_CORRUPT".into()), "{refused:?}");
    let reply = server.get(&format!("/v1/sessions/{damaged}")).await;
    assert_eq!((reply.status, reply.reason().as_str()), (500, "STATE_CORRUPT"), "{reply:?}");
    assert_eq!(bits(&answer(&server, &sound, 2).await), expected[1]);
    assert_eq!(server.get("/readyz").await.status, 200);
    let close = || async { server.agent().await.close_session(pb::CloseSessionRequest { session_id: damaged.clone() }).await };
    close().await.unwrap();
    assert_eq!(failure(&close().await.unwrap_err()).1, "SESSION_NOT_FOUND");
}

/// A store that is full takes no session more; those that are there go on, and one that is closed makes room.
#[tokio::test(flavor = "multi_thread")]
async fn a_full_store_takes_no_session_more() {
    let dir = tempfile::tempdir().unwrap();
    let (_process, server) = start_with(dir.path(), &["store.len_max=2"]).await;
    let ids = [open(&server, "").await.session_id, open(&server, "").await.session_id];
    let refused = server.agent().await.open_session(pb::OpenSessionRequest::default()).await.unwrap_err();
    assert_eq!(failure(&refused), (Code::ResourceExhausted, "STORE_FULL".into()));
    let reply = server.post("/v1/sessions", &json!({})).await;
    assert_eq!((reply.status, reply.reason().as_str()), (507, "STORE_FULL"));
    for id in &ids {
        answer(&server, id, 1).await;
    }
    server.agent().await.close_session(pb::CloseSessionRequest { session_id: ids[0].clone() }).await.unwrap();
    open(&server, "").await;
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"].as_array().unwrap().len(), 2);
}
