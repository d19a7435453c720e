//! The step protocol: replay, joining, cancelling, resetting; many sessions at once; the other verbs.

use super::*;
use std::collections::HashSet;

fn same_but_for_replayed(a: &pb::ActResponse, b: &pb::ActResponse) -> bool {
    pb::ActResponse { replayed: false, ..a.clone() } == pb::ActResponse { replayed: false, ..b.clone() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_repeated_step_gives_the_same_bytes_and_spends_nothing() {
    let server = start(|_| {}).await;
    let id = server.open(json!({"seed": 5})).await;
    let mut agent = server.agent().await;
    let first = agent.act(act(&id, 1, &STATE)).await.unwrap().into_inner();
    assert!(!first.replayed && first.evaluations > 0 && first.step == 1);
    let again = agent.act(act(&id, 1, &STATE)).await.unwrap().into_inner();
    assert!(again.replayed && same_but_for_replayed(&first, &again), "{first:?} {again:?}");
    let rest = server.act(&id, 1, &STATE).await.json();
    assert_eq!(rest["replayed"], true, "the other face replays it too");
    assert_eq!(rest["timings"]["total_us"], first.timings.unwrap().total_us);
    let wish = pb::ActRequest { want_planned_states: true, ..act(&id, 1, &STATE) };
    let planned = agent.act(wish).await.unwrap().into_inner();
    let matrix = planned.planned_states.expect("a replay may ask for more");
    assert_eq!((matrix.rows, matrix.columns, matrix.values.len()), (7, 4, 28));
    let second = agent.act(act(&id, 2, &STATE)).await.unwrap().into_inner();
    assert!(!second.replayed && second.actions != first.actions);
}

#[tokio::test(flavor = "multi_thread")]
async fn parallel_equal_acts_are_computed_once() {
    let (_process, server) = start_process(&["engine.workers=1", "engine.batch_len_max=8"]).await;
    let slow = server.open(json!({"model": "slow"})).await;
    let blocker = server.start_slow(&slow).await;
    for round in 1..=10 {
        let id = server.open(json!({"options": {"sub_steps": 5, "action_horizon": 8}})).await;
        let (before, agent) = (server.metric("ada_replays_total").await, server.agent().await);
        let calls = (0..8).map(|_| {
            let (mut agent, request) = (agent.clone(), act(&id, 1, &STATE));
            tokio::spawn(async move { agent.act(request).await.unwrap().into_inner() })
        });
        let mut answers = Vec::new();
        for call in calls.collect::<Vec<_>>() {
            answers.push(call.await.unwrap());
        }
        assert!(answers.iter().all(|answer| same_but_for_replayed(answer, &answers[0])));
        assert_eq!(answers.iter().filter(|answer| !answer.replayed).count(), 1, "round {round}: one computes, seven join or replay");
        assert_eq!(server.metric("ada_replays_total").await, before + 7.0);
    }
    blocker.abort();
}

/// The act goes on for the second caller when the first one leaves.
#[tokio::test(flavor = "multi_thread")]
async fn one_who_joined_is_served_after_the_first_has_left() {
    let (_process, server) = start_process(&["engine.workers=1"]).await;
    let (slow, id) = (server.open(json!({"model": "slow"})).await, server.open(json!({})).await);
    let blocker = server.start_slow(&slow).await;
    let first = server.start_slow(&id).await;
    let (mut agent, request) = (server.agent().await, act(&id, 1, &STATE));
    let joined = server.metric("ada_replays_total").await;
    let second = tokio::spawn(async move { agent.act(request).await.unwrap().into_inner() });
    while server.metric("ada_replays_total").await == joined {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    first.abort();
    blocker.abort();
    let answer = timeout(Duration::from_secs(10), second).await.expect("the act was dropped with its first caller").unwrap();
    assert!(answer.replayed && answer.step == 1);
}

/// The most patient of those who wait decides whether an act is hurried; once that one had left, nobody was, and the hasty got no answer.
#[tokio::test(flavor = "multi_thread")]
async fn the_hasty_are_served_in_time_when_the_patient_have_left() {
    let (_process, server) = start_process(&["engine.workers=1", "engine.deadline_margin_ms=300"]).await;
    let id = server.open(json!({"model": "slow"})).await;
    let patient = server.start_slow(&id).await;
    let request = pb::ActRequest { deadline_ms: Some(2000), ..act(&id, 1, &STATE) };
    let (mut agent, joined) = (server.agent().await, server.metric("ada_replays_total").await);
    let hasty = tokio::spawn(async move { agent.act(request).await });
    while server.metric("ada_replays_total").await == joined {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    patient.abort();
    let answer = timeout(Duration::from_secs(10), hasty).await.unwrap().unwrap().expect("it had the time it asked for").into_inner();
    assert!(answer.degraded);
}

/// An act without deadline waited behind all that came later and had one, for up to half a minute.
#[tokio::test(flavor = "multi_thread")]
async fn the_patient_have_their_turn() {
    let (_process, server) = start_process(&["engine.workers=1", "engine.deadline_margin_ms=300"]).await;
    let (first, quick) = (server.open(json!({"model": "slow"})).await, server.open(json!({})).await);
    let blocker = server.start_slow(&first).await;
    let patient = server.start_slow(&quick).await;
    // Longer than `engine.turn_ms_max`.
    tokio::time::sleep(Duration::from_millis(400)).await;
    let mut hasty = Vec::new();
    // Each takes all the time it has, so the next one must have more to be let in.
    for deadline_ms in [3_000, 10_000, 30_000] {
        let id = server.open(json!({"model": "slow"})).await;
        let request = pb::ActRequest { deadline_ms: Some(deadline_ms), ..act(&id, 1, &STATE) };
        let mut agent = server.agent().await;
        hasty.push(tokio::spawn(async move { agent.act(request).await }));
    }
    while server.metric("ada_queue_depth").await < 4.0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    blocker.abort();
    timeout(Duration::from_secs(10), patient).await.expect("the patient had no turn").unwrap().unwrap();
    assert!(hasty.iter().all(|act| !act.is_finished()), "who came later and in a hurry was served before");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancelled_act_leaves_the_session_unharmed() {
    let (_process, server) = start_process(&[]).await;
    let reference = server.open(json!({"seed": 3, "options": {"sub_steps": 5}})).await;
    let mut agent = server.agent().await;
    let mut expected = Vec::new();
    for step in 1..=3 {
        expected.push(agent.act(act(&reference, step, &STATE)).await.unwrap().into_inner().actions);
    }
    let id = server.open(json!({"seed": 3, "options": {"sub_steps": 5}})).await;
    for step in 1..=3 {
        for cut_us in [0, 50, 100, 200, 400, 800, 1600, 3200] {
            let call = agent.act(act(&id, step, &STATE));
            let _cut_or_done = timeout(Duration::from_micros(cut_us), call).await;
        }
        let answer = agent.act(act(&id, step, &STATE)).await.unwrap().into_inner();
        assert_eq!(Some(&answer.actions), expected.get(step as usize - 1), "step {step}");
    }
    let slow = server.open(json!({"model": "slow"})).await;
    server.start_slow(&slow).await.abort();
    server.until(&slow, |session| session["busy"] == false && session["committed_step"] == 0).await;
    let running = || async { server.metric("ada_inflight_acts").await };
    timeout(Duration::from_secs(5), async { while running().await > 0.0 {} }).await.expect("the engine still works on it");
}

/// A REST client that hangs up is a cancel too.
#[tokio::test(flavor = "multi_thread")]
async fn a_hung_up_rest_act_leaves_the_engine() {
    let server = start(|_| {}).await;
    let slow = server.open(json!({"model": "slow"})).await;
    {
        use tokio::io::AsyncWriteExt;
        let body = json!({"step": 1, "observation": {"state": STATE}}).to_string();
        let head = format!(
            "POST /v1/sessions/{slow}/act HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
            body.len()
        );
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all((head + &body).as_bytes()).await.unwrap();
        server.until(&slow, |session| session["busy"] == true).await;
    }
    server.until(&slow, |session| session["busy"] == false).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn many_sessions_at_once_do_not_disturb_each_other() {
    let server = start(|_| {}).await;
    let agent = server.agent().await;
    let run = |seed: u64| {
        let (mut agent, state) = (agent.clone(), [seed as f32 / 40.0, 0.0, -0.5, 0.25]);
        async move {
            let open = pb::OpenSessionRequest { seed: Some(seed), ..Default::default() };
            let session = agent.open_session(open).await.unwrap().into_inner().session.unwrap();
            let mut chunks = Vec::new();
            for step in 1..=5 {
                chunks.push(agent.act(act(&session.session_id, step, &state)).await.unwrap().into_inner().actions.unwrap().values);
            }
            chunks
        }
    };
    let together: Vec<_> = (0..40).map(|seed| tokio::spawn(run(seed))).collect();
    let mut seen = HashSet::new();
    for (seed, task) in together.into_iter().enumerate() {
        let chunks = task.await.unwrap();
        assert_eq!(chunks, run(seed as u64).await, "seed {seed} alone");
        seen.insert(format!("{chunks:?}"));
    }
    assert_eq!(seen.len(), 40, "every seed has its own actions");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_batch_holds_good_and_bad_acts() {
    let server = start(|_| {}).await;
    let (a, b) = (server.open(json!({"seed": 1})).await, server.open(json!({"seed": 2})).await);
    let missing = pb::ActRequest { observation: None, ..act(&b, 1, &STATE) };
    let acts = vec![act(&a, 1, &STATE), act(&b, 7, &STATE), act("no id", 1, &STATE), missing, act(&b, 1, &STATE[..2]), act(&b, 1, &STATE)];
    let ids: Vec<_> = acts.iter().map(|act| (act.session_id.clone(), act.step)).collect();
    let results = server.agent().await.act_batch(pb::ActBatchRequest { acts }).await.unwrap().into_inner().results;
    assert_eq!(ids, results.iter().map(|result| (result.session_id.clone(), result.step)).collect::<Vec<_>>());
    let word = |result: &pb::ActResult| match result.result.as_ref().unwrap() {
        pb::act_result::Result::Response(_) => "OK".to_owned(),
        pb::act_result::Result::Error(error) => error.reason.clone(),
    };
    let words: Vec<_> = results.iter().map(word).collect();
    assert_eq!(words[..4], ["OK", "STEP_OUT_OF_ORDER", "SESSION_NOT_FOUND", "OBSERVATION_INVALID"]);
    // The last two are the same step of the same session with different observations: the wrong one fails in either order.
    assert!(["OBSERVATION_INVALID", "STEP_PAYLOAD_MISMATCH"].contains(&&*words[4]), "{words:?}");
    assert!(["OK", "STEP_PAYLOAD_MISMATCH"].contains(&&*words[5]), "{words:?}");
    let body = json!({"acts": [
        {"session_id": a, "step": 2, "observation": {"state": STATE, "executed": [{"reward": 0.5}]}},
        {"session_id": a, "step": 9, "observation": {"state": STATE}},
        {"step": 1, "observation": {"state": STATE}},
    ]});
    let results = server.post("/v1/act:batch", &body).await.json()["results"].clone();
    assert_eq!(results[0]["response"]["step"], 2);
    assert!(results[0].get("error").is_none() && results[1].get("response").is_none());
    assert!(["STEP_OUT_OF_ORDER", "SESSION_BUSY"].contains(&results[1]["error"]["reason"].as_str().unwrap()));
    assert_eq!((&results[2]["error"]["reason"], &results[2]["error"]["field"]), (&json!("REQUEST_INVALID"), &json!("session_id")));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reset_begins_again() {
    let server = start(|_| {}).await;
    let id = server.open(json!({"seed": 11})).await;
    let first = server.act(&id, 1, &STATE).await.json();
    server.act(&id, 2, &STATE).await;
    let session = server.post(&format!("/v1/sessions/{id}/reset"), &json!({"seed": 11})).await.json()["session"].clone();
    assert_eq!((&session["committed_step"], &session["episode"], &session["seed"]), (&json!(0), &json!(1), &json!(11)));
    let again = server.act(&id, 1, &STATE).await.json();
    assert_eq!((&again["actions"], &again["replayed"]), (&first["actions"], &json!(false)));
    let drawn = server.http("POST", &format!("/v1/sessions/{id}/reset"), "").await.json()["session"]["seed"].as_u64().unwrap();
    assert!(drawn != 11 && drawn < 1 << 53);
    let reset = pb::ResetSessionRequest { session_id: id.clone(), seed: Some(11), keep_history: true, ..Default::default() };
    let kept = server.agent().await.reset_session(reset).await.unwrap().into_inner().session.unwrap();
    assert_eq!((kept.committed_step, kept.episode, kept.seed), (0, 3, 11));
    let slow = server.open(json!({"model": "slow"})).await;
    let blocker = server.start_slow(&slow).await;
    let reply = server.http("POST", &format!("/v1/sessions/{slow}/reset"), "").await;
    assert_eq!((reply.status, reply.reason().as_str()), (409, "SESSION_BUSY"));
    assert_eq!(server.http("DELETE", &format!("/v1/sessions/{slow}"), "").await.status, 204);
    let gone = blocker.await.unwrap().unwrap_err();
    assert_eq!(failure(&gone), (Code::NotFound, "SESSION_NOT_FOUND".into()), "closing drops the act in flight");
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_are_listed_and_closed() {
    let server = start(|_| {}).await;
    let (mut ids, mut handles) = (HashSet::new(), HashSet::new());
    for _ in 0..7 {
        let id = server.open(json!({})).await;
        let session = server.get(&format!("/v1/sessions/{id}")).await.json()["session"].clone();
        handles.insert(session["handle"].as_str().unwrap().to_owned());
        ids.insert(id);
    }
    assert!(handles.len() == 7 && handles.is_disjoint(&ids));
    let other = server.open(json!({"model": "slow"})).await;
    let (mut seen, mut token, mut pages) = (HashSet::new(), String::new(), 0);
    loop {
        let page = server.get(&format!("/v1/sessions?page_size=3&model=tiny&page_token={token}")).await.json();
        assert!(ids.iter().all(|id| !page.to_string().contains(id)), "a list tells an id: {page}");
        seen.extend(page["sessions"].as_array().unwrap().iter().map(|session| session["handle"].as_str().unwrap().to_owned()));
        token = page["next_page_token"].as_str().unwrap().to_owned();
        pages += 1;
        if token.is_empty() {
            break;
        }
    }
    assert_eq!((seen, pages), (handles.clone(), 3));
    let all = server.agent().await.list_sessions(pb::ListSessionsRequest::default()).await.unwrap().into_inner();
    assert_eq!((all.sessions.len(), all.next_page_token.as_str()), (8, ""));
    assert!(all.sessions.iter().all(|session| session.session_id.is_empty() && !session.handle.is_empty()));
    let mut agent = server.agent().await;
    agent.close_session(pb::CloseSessionRequest { session_id: other.clone() }).await.unwrap();
    let gone = agent.get_session(pb::GetSessionRequest { session_id: other }).await.unwrap_err();
    assert_eq!(failure(&gone), (Code::NotFound, "SESSION_NOT_FOUND".into()));
}

/// Knowing a session's id is the right to use it, and every list told all ids.
#[tokio::test(flavor = "multi_thread")]
async fn a_handle_is_no_right_to_anything() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let listed = server.get("/v1/sessions?view=full").await.json()["sessions"][0].clone();
    let handle = listed["handle"].as_str().unwrap();
    let grpc = server.agent().await.act(act(handle, 1, &STATE)).await.unwrap_err();
    assert_eq!(failure(&grpc), (Code::NotFound, "SESSION_NOT_FOUND".into()));
    for (method, verb) in [("GET", ""), ("DELETE", ""), ("POST", "/reset"), ("POST", "/act")] {
        let body = if verb == "/act" { json!({"step": 1, "observation": {"state": STATE}}).to_string() } else { String::new() };
        let reply = server.http(method, &format!("/v1/sessions/{handle}{verb}"), &body).await;
        assert_eq!((reply.status, reply.reason().as_str()), (404, "SESSION_NOT_FOUND"), "{method} {verb}");
    }
    assert_eq!(server.act(&id, 1, &STATE).await.json()["step"], 1);
}

/// A list is short unless asked, over both faces.
#[tokio::test(flavor = "multi_thread")]
async fn a_list_is_short_unless_asked() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
    let mut own = server.get(&format!("/v1/sessions/{id}")).await.json()["session"].clone();
    let long = ["model_digest", "seed", "options", "latent_mean", "latent_log_var"];
    let rest = async |query: &str| server.get(&format!("/v1/sessions{query}")).await.json()["sessions"][0].clone();
    for short in [rest("").await, rest("?view=basic").await] {
        assert!(long.iter().all(|field| short.get(field).is_none()), "{short}");
        assert_eq!((&short["committed_step"], &short["model"], &short["handle"]), (&json!(1), &json!("tiny"), &own["handle"]));
    }
    let mut full = rest("?view=full").await;
    for session in [&mut own, &mut full] {
        let fields = session.as_object_mut().unwrap();
        ["session_id", "age_ms", "idle_ms"].iter().for_each(|field| drop(fields.remove(*field)));
    }
    assert_eq!(full, own);
    assert_eq!(server.get("/v1/sessions?view=long").await.reason(), "REQUEST_INVALID");
    let mut agent = server.agent().await;
    let mut grpc = async |view: i32| agent.list_sessions(pb::ListSessionsRequest { view, ..Default::default() }).await;
    let short = grpc(0).await.unwrap().into_inner().sessions.remove(0);
    assert!(short.options.is_none() && short.latent_mean.is_empty() && short.model_digest.is_empty() && short.seed == 0);
    let full = grpc(2).await.unwrap().into_inner().sessions.remove(0);
    assert!(full.options.is_some() && full.latent_mean.len() == 6 && full.session_id.is_empty() && full.handle == short.handle);
    assert_eq!(grpc(3).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test(flavor = "multi_thread")]
async fn models_say_what_a_client_must_know() {
    let server = start(|_| {}).await;
    let listed = server.models().await.list(pb::ListModelsRequest {}).await.unwrap().into_inner().models;
    let names: Vec<_> = listed.iter().map(|model| model.name.as_str()).collect();
    assert_eq!(names, ["exploding", "slow", "tiny"], "torn is refused, the others serve");
    let tiny = &listed[2];
    assert!(tiny.is_default && !listed[0].is_default);
    assert_eq!((tiny.state_dim, tiny.action_dim, tiny.plan_horizon, tiny.latent_dim), (4, 2, 8, 6));
    let json = server.get(&format!("/v1/models/tiny@{}", &tiny.digest[..8])).await.json()["model"].clone();
    assert_eq!((json["digest"].as_str().unwrap(), json["sampler"]["latent"].as_str().unwrap()), (tiny.digest.as_str(), "mean"));
    let trained = json["trained"].clone();
    assert_eq!(trained["missing"], json!({"state": true, "action": true, "reward": true}));
    let told = tiny.trained.clone().unwrap();
    assert_eq!(trained["action_horizons"], json!(told.action_horizons));
    assert!(told.missing.unwrap().reward && told.sub_steps.contains(&1));
    for action_horizon in 1..=9 {
        let body = json!({"model": "tiny", "options": {"action_horizon": action_horizon}});
        let is_taken = server.post("/v1/sessions", &body).await.status == 201;
        assert_eq!(is_taken, told.action_horizons.contains(&action_horizon), "what is said is what is taken: {action_horizon}");
    }
    for wrong in ["tiny@ffffffffff", "tiny@", "nothing"] {
        let reply = server.get(&format!("/v1/models/{wrong}")).await;
        assert_eq!((reply.status, reply.reason().as_str()), (404, "MODEL_NOT_FOUND"), "{wrong}");
    }
    let pinned = server.open(json!({"model": format!("tiny@{}", tiny.digest), "options": {"kappa": "infinity", "latent": "sample"}})).await;
    let options = server.get(&format!("/v1/sessions/{pinned}")).await.json()["session"]["options"].clone();
    assert_eq!((&options["kappa"], &options["latent"], &options["sub_steps"]), (&json!("infinity"), &json!("sample"), &json!(1)));
}
