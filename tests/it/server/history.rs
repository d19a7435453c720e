//! A session that is opened with steps which it has not lived: what it answers, what is refused, and what it costs, over both faces alike.

use super::{
    bytes::{bits, bits_json},
    methods::{alike, fresh, serve},
    *,
};
use ada_diffuser::model::method::{Future, GruLatent, LatentSource, Looks};

const SEED: u64 = 9;

/// A step that was recorded, some of them with gaps.
fn step(t: usize) -> pb::Executed {
    let wave = |i: usize| (0.7 * (t * 7 + i) as f32).sin();
    let vector = |from: usize, len: usize| pb::Vector { values: (from..from + len).map(wave).collect() };
    let state = (t == 0 || !t.is_multiple_of(3)).then(|| vector(0, 4));
    pb::Executed { state, action: (!t.is_multiple_of(4)).then(|| vector(4, 2)), reward: (!t.is_multiple_of(5)).then(|| wave(6)) }
}

fn to_json(steps: &[pb::Executed]) -> Vec<Value> {
    let numbers = |vector: &Option<pb::Vector>| vector.as_ref().map(|vector| vector.values.clone());
    steps.iter().map(|step| json!({"state": numbers(&step.state), "action": numbers(&step.action), "reward": step.reward})).collect()
}

fn options() -> pb::SamplerOptions {
    pb::SamplerOptions { eta: Some(0.7), temperature: Some(1.0), latent: Some(pb::LatentMode::Sample.into()), ..Default::default() }
}

fn opening(history: Vec<pb::Executed>) -> pb::OpenSessionRequest {
    pb::OpenSessionRequest { seed: Some(SEED), options: Some(options()), history, ..Default::default() }
}

async fn open(server: &Running, history: Vec<pb::Executed>) -> pb::Session {
    server.agent().await.open_session(opening(history)).await.unwrap().into_inner().session.unwrap()
}

async fn open_rest(server: &Running, history: &[pb::Executed]) -> String {
    let options = json!({"eta": 0.7, "temperature": 1, "latent": "sample"});
    server.open(json!({"seed": SEED, "options": options, "history": to_json(history)})).await
}

/// Two acts of a session, the second of which tells what came of the first.
fn asked(id: &str, step: u64) -> pb::ActRequest {
    let executed = if step == 1 { vec![] } else { vec![self::step(1)] };
    let observation = pb::Observation { state: STATE.to_vec(), executed, ..Default::default() };
    pb::ActRequest { session_id: id.to_owned(), step, observation: Some(observation), want_planned_states: true, ..Default::default() }
}

async fn answers(server: &Running, id: &str) -> Vec<Vec<u32>> {
    let (mut agent, mut all) = (server.agent().await, Vec::new());
    for step in 1..=2 {
        all.push(bits(&agent.act(asked(id, step)).await.unwrap().into_inner()));
    }
    all
}

async fn answers_rest(server: &Running, id: &str) -> Vec<Vec<u32>> {
    let mut all = Vec::new();
    for step in 1..=2_u64 {
        let executed = if step == 1 { vec![] } else { to_json(&[self::step(1)]) };
        let observation = json!({"state": STATE, "executed": executed});
        let body = json!({"step": step, "observation": observation, "want_planned_states": true});
        all.push(bits_json(&server.post(&format!("/v1/sessions/{id}/act"), &body).await.json()));
    }
    all
}

/// The session that lived these steps, and went over into another episode.
async fn lived(server: &Running, history: &[pb::Executed]) -> String {
    let id = open(server, vec![]).await.session_id;
    let observation = pb::Observation { state: vec![0.5; 4], executed: history.to_vec(), ..Default::default() };
    let mut agent = server.agent().await;
    agent.act(pb::ActRequest { observation: Some(observation), ..act(&id, 1, &STATE) }).await.unwrap();
    let reset = pb::ResetSessionRequest { session_id: id.clone(), seed: Some(SEED), keep_history: true, ..Default::default() };
    agent.reset_session(reset).await.unwrap();
    id
}

fn running() -> tempfile::TempDir {
    fresh(|config| {
        config.method.latent = LatentSource::Gru(GruLatent { future: Future::Held, ..GruLatent::plain(6, 16, Looks::Running) });
        (config.trained.refined, config.defaults.sampler.kappa) = (false, 0.0);
    })
}

/// What a session answers that is handed a history is what one answers that lived it and kept it over a reset: the same bytes.
#[tokio::test(flavor = "multi_thread")]
async fn a_history_that_is_brought_along_is_one_that_was_lived() {
    let dir = running();
    for server in [start(|_| {}).await, serve(&dir).await] {
        let history: Vec<_> = (0..11).map(step).collect();
        let expected = answers(&server, &lived(&server, &history).await).await;
        let told = open(&server, history.clone()).await;
        assert_eq!((told.committed_step, told.episode, told.latent_mean.len()), (0, 0, 0));
        assert_eq!(answers(&server, &told.session_id).await, expected);
        assert_eq!(answers_rest(&server, &open_rest(&server, &history).await).await, expected);
        // None is none, by either face; and a history matters.
        let none = answers(&server, &open(&server, vec![]).await.session_id).await;
        assert_eq!(answers_rest(&server, &open_rest(&server, &[]).await).await, none);
        assert_eq!(
            answers(&server, &server.open(json!({"seed": SEED, "options": {"eta": 0.7, "temperature": 1, "latent": "sample"}})).await)
                .await,
            none
        );
        assert_ne!(none, expected);
        // It is forgotten as what was lived is.
        let id = open(&server, history).await.session_id;
        server.post(&format!("/v1/sessions/{id}/reset"), &json!({"seed": SEED})).await;
        assert_eq!(answers(&server, &id).await, none);
    }
}

/// Field and reason of a history that both faces refuse.
async fn refused(server: &Running, history: Vec<pb::Executed>) -> (String, String) {
    let http = server.post("/v1/sessions", &json!({"history": to_json(&history)})).await;
    let grpc = server.agent().await.open_session(opening(history)).await.unwrap_err();
    alike(&grpc, &http, "REQUEST_INVALID")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_history_that_does_not_fit_is_named() {
    let server = start(|config| config.limits.executed_len_max = 5).await;
    let vector = |values: &[f32]| Some(pb::Vector { values: values.to_vec() });
    let after = |wrong: pb::Executed| vec![step(1), step(2), step(3), wrong];
    let none = pb::Executed::default;
    for (history, field, reason) in [
        (after(pb::Executed { state: vector(&[0.0; 3]), ..none() }), "history[3].state", "has 3 values, the model takes 4"),
        (after(pb::Executed { action: vector(&[0.0]), ..none() }), "history[3].action", "has 1 values, the model takes 2"),
        (after(pb::Executed { state: vector(&[0.0, 0.0, 1e30, 0.0]), ..none() }), "history[3].state[2]", "standard deviations"),
        (after(pb::Executed { reward: Some(1e30), ..none() }), "history[3].reward", "standard deviations"),
        (after(none()), "history[3]", "tells nothing"),
    ] {
        let (at, why) = refused(&server, history).await;
        assert!(at == field && why.contains(reason), "{at}: {why}");
    }
    // JSON cannot say this one.
    let nan = after(pb::Executed { action: vector(&[0.0, f32::NAN]), ..none() });
    let grpc = server.agent().await.open_session(opening(nan)).await.unwrap_err();
    assert_eq!((failure(&grpc).1.as_str(), trailer(&grpc, "ada-field").as_deref()), ("REQUEST_INVALID", Some("history[3].action[1]")));
    for (body, field) in [
        (r#"{"history":[{"state":[0,0,0,0]},{"states":[0,0,0,0]}]}"#, "history[1].states"),
        (r#"{"history":[{"state":[0,0,null,0]}]}"#, "history[0].state[2]"),
        (r#"{"history":[{"state":[0,0,NaN,0]}]}"#, "history[0].state[2]"),
        (r#"{"history":[[[0,0,0,0]]]}"#, "history[0]"),
        (r#"{"history":{"state":[0,0,0,0]}}"#, "history"),
    ] {
        let reply = server.http("POST", "/v1/sessions", body).await;
        assert_eq!(
            (reply.status, reply.reason().as_str(), reply.json()["field"].as_str()),
            (400, "REQUEST_INVALID", Some(field)),
            "{body}"
        );
    }
    let many = vec![step(1); 6];
    let http = server.post("/v1/sessions", &json!({"history": to_json(&many)})).await;
    let grpc = server.agent().await.open_session(opening(many)).await.unwrap_err();
    assert_eq!((failure(&grpc), http.status, http.reason()), ((Code::ResourceExhausted, "TOO_LARGE".into()), 413, "TOO_LARGE".into()));
    assert!(grpc.message() == "number of steps of the history exceeds 5" && http.json()["detail"] == grpc.message(), "{grpc:?}");
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"], json!([]), "none was opened");
    open(&server, vec![step(1); 5]).await;
}

/// Of a model that was trained on episodes one by one, and of one that would not see it.
#[tokio::test(flavor = "multi_thread")]
async fn a_model_says_why_it_takes_no_history() {
    let alone = fresh(|config| config.trained.sessions = false);
    let blind = fresh(|config| {
        config.method.latent = LatentSource::None;
        (config.trained.refined, config.defaults.sampler.kappa) = (false, 0.0);
    });
    for (dir, reason) in [(&alone, "train on a data set with `infos/session`"), (&blind, "would change nothing")] {
        let server = serve(dir).await;
        let (field, why) = refused(&server, vec![step(1), step(2)]).await;
        assert!(field == "history" && why.contains(reason), "{field}: {why}");
        open(&server, vec![]).await;
        let id = open_rest(&server, &[]).await;
        let reset = server.post(&format!("/v1/sessions/{id}/reset"), &json!({"keep_history": true})).await;
        assert_eq!(
            (reset.status, reset.json()["field"].as_str()),
            if dir.path() == alone.path() { (400, Some("keep_history")) } else { (200, None) }
        );
    }
}

/// The name of a request stands for one session, whatever it is sent with again; and what a session was handed counts against the bound on memory.
#[tokio::test(flavor = "multi_thread")]
async fn a_history_is_opened_once_and_counted() {
    let dir = running();
    let server = serve(&dir).await;
    let history: Vec<_> = (0..200).map(step).collect();
    let named = |history| pb::OpenSessionRequest { request_id: "warm".into(), ..opening(history) };
    let mut agent = server.agent().await;
    let first = agent.open_session(named(history.clone())).await.unwrap().into_inner().session.unwrap();
    for again in [history.clone(), vec![], vec![step(7)]] {
        let same = agent.open_session(named(again)).await.unwrap().into_inner().session.unwrap();
        assert_eq!((same.session_id, same.state_bytes), (first.session_id.clone(), first.state_bytes));
    }
    assert_eq!(answers(&server, &first.session_id).await, answers(&server, &open(&server, history.clone()).await.session_id).await);
    let fresh = open(&server, vec![]).await.state_bytes;
    let floats: u64 =
        history.iter().flat_map(|step| [&step.state, &step.action]).flatten().map(|vector| 4 * vector.values.len() as u64).sum();
    assert!(first.state_bytes > fresh + floats + 200 * 64, "{} against {fresh} without", first.state_bytes);
    let small = start(|config| {
        (config.models.dir, config.models.default) = (dir.path().to_owned(), "fresh".to_owned());
        config.sessions.bytes_max = (fresh + floats) as usize;
    })
    .await;
    let full = small.agent().await.open_session(opening(history)).await.unwrap_err();
    assert_eq!(failure(&full), (Code::ResourceExhausted, "QUOTA".into()));
    open(&small, vec![]).await;
}
