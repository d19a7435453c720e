//! Every row of the error table that a client can bring about, on both faces. (The rest, row by row, stands in the unit tests of the two tables.)

use super::*;
use ada_diffuser::serve::{grpc, http, registry::Registry, service::Service, telemetry};
use std::sync::Arc;

/// The same failure on both faces; the gRPC side first.
fn both(grpc: &Status, http: &Reply, expected: (Code, u16, &str)) {
    assert_eq!(
        (failure(grpc), (http.status, http.reason().as_str())),
        ((expected.0, expected.2.into()), (expected.1, expected.2)),
        "{grpc:?}"
    );
}

/// The same act on both faces, both refused.
async fn refused(server: &Running, id: &str, step: u64, state: &[f32], expected: (Code, u16, &str)) -> (Status, Reply) {
    let grpc = server.agent().await.act(act(id, step, state)).await.unwrap_err();
    let http = server.act(id, step, state).await;
    both(&grpc, &http, expected);
    (grpc, http)
}

#[tokio::test(flavor = "multi_thread")]
async fn steps() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    for step in [0, 2, 3, u64::MAX] {
        let (grpc, http) = refused(&server, &id, step, &STATE, (Code::Aborted, 409, "STEP_OUT_OF_ORDER")).await;
        assert_eq!((trailer(&grpc, "ada-committed-step").as_deref(), &http.json()["committed_step"]), (Some("0"), &json!(0)));
    }
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
    refused(&server, &id, 0, &STATE, (Code::Aborted, 409, "STEP_OUT_OF_ORDER")).await;
    let (_, http) = refused(&server, &id, 1, &[0.0; 4], (Code::FailedPrecondition, 422, "STEP_PAYLOAD_MISMATCH")).await;
    assert_eq!(http.json()["committed_step"], 1);
    assert_eq!(server.act(&id, 2, &STATE).await.status, 200, "nothing is lost");
    let slow = server.open(json!({"model": "slow"})).await;
    let blocker = server.start_slow(&slow).await;
    refused(&server, &slow, 2, &STATE, (Code::Aborted, 409, "SESSION_BUSY")).await;
    refused(&server, &slow, 1, &[0.0; 4], (Code::FailedPrecondition, 422, "STEP_PAYLOAD_MISMATCH")).await;
    blocker.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn unknown_sessions_and_models() {
    let server = start(|_| {}).await;
    for id in ["7b1f2c5e-3c55-4a3e-9c33-0f3f6f9d8a11", "junk"] {
        refused(&server, id, 1, &STATE, (Code::NotFound, 404, "SESSION_NOT_FOUND")).await;
        let grpc = server.agent().await.get_session(pb::GetSessionRequest { session_id: id.into() }).await.unwrap_err();
        both(&grpc, &server.get(&format!("/v1/sessions/{id}")).await, (Code::NotFound, 404, "SESSION_NOT_FOUND"));
        let grpc = server.agent().await.close_session(pb::CloseSessionRequest { session_id: id.into() }).await.unwrap_err();
        both(&grpc, &server.http("DELETE", &format!("/v1/sessions/{id}"), "").await, (Code::NotFound, 404, "SESSION_NOT_FOUND"));
    }
    let grpc = server.agent().await.open_session(pb::OpenSessionRequest { model: "x".into(), ..Default::default() }).await.unwrap_err();
    both(&grpc, &server.post("/v1/sessions", &json!({"model": "x"})).await, (Code::NotFound, 404, "MODEL_NOT_FOUND"));
    let grpc = server.models().await.get(pb::GetModelRequest { model: "x".into() }).await.unwrap_err();
    let http = server.get("/v1/models/x").await;
    both(&grpc, &http, (Code::NotFound, 404, "MODEL_NOT_FOUND"));
    let expected = r#"no model "x"; there are: exploding, slow, tiny"#;
    assert_eq!((grpc.message(), http.json()["detail"].as_str()), (expected, Some(expected)));
    let other = server.get("/v1/models/tiny@00000000").await.json()["detail"].as_str().unwrap().to_owned();
    assert!(other.contains("the digest of tiny is "), "{other}");
}

/// A compressed body was read as if it were JSON, and called a wrong observation.
#[tokio::test(flavor = "multi_thread")]
async fn bodies_come_uncompressed() {
    use tower::ServiceExt;
    let service = Arc::new(Service::start(config().validated().unwrap()).unwrap());
    let state = http::State { service, metrics: telemetry::install_metrics() };
    for (encoding, expected) in [("gzip", 415), ("br", 415), ("identity", 503), ("", 503)] {
        let request = hyper::Request::builder().method("POST").uri("/v1/sessions").header("content-encoding", encoding);
        let request = request.header("content-type", "application/json");
        let response = http::router(state.clone()).oneshot(request.body(Body::from("{}")).unwrap()).await.unwrap();
        assert_eq!(response.status().as_u16(), expected, "{encoding}");
        let accepted = response.headers().get("accept-encoding").map(|value| value.to_str().unwrap());
        assert_eq!(accepted, (expected == 415).then_some("identity"));
        assert_eq!(response.headers()["content-type"], "application/problem+json");
    }
}

/// Any page that a developer had open could open sessions and act: a body of text/plain needs no leave of the server, nor does a WebSocket.
#[tokio::test(flavor = "multi_thread")]
async fn pages_are_refused_unless_listed() {
    let server = start(|config| config.server.origins = vec!["https://lab.example".to_owned()]).await;
    let ask = async |method: &str, path: &str, headers: &[(&str, &str)], body: &str| {
        let stream = TcpStream::connect(server.address).await.unwrap();
        let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.unwrap();
        tokio::spawn(connection.with_upgrades());
        let request = headers.iter().fold(hyper::Request::builder().method(method).uri(path), |request, (k, v)| request.header(*k, *v));
        let (parts, body) = sender.send_request(request.body(Body::from(body.to_owned())).unwrap()).await.unwrap().into_parts();
        let text = if parts.status == 101 {
            String::new()
        } else {
            String::from_utf8(to_bytes(Body::new(body), 9999).await.unwrap().into()).unwrap()
        };
        Reply { status: parts.status.as_u16(), headers: parts.headers, text }
    };
    let (host, json) = (("host", "localhost:7777"), ("content-type", "application/json"));
    for kind in ["text/plain", "application/x-www-form-urlencoded", ""] {
        let reply = ask("POST", "/v1/sessions", &[host, ("content-type", kind)], "{}").await;
        assert_eq!((reply.status, reply.reason().as_str()), (415, "MEDIA_TYPE_UNSUPPORTED"), "{kind}");
    }
    let reply = ask("POST", "/v1/sessions", &[("host", "rebound.example"), json], "{}").await;
    assert_eq!((reply.status, reply.reason().as_str()), (421, "HOST_FORBIDDEN"));
    for page in ["https://evil.example", "null", "http://localhost:7777"] {
        let reply = ask("POST", "/v1/sessions", &[host, json, ("origin", page)], "{}").await;
        assert_eq!((reply.status, reply.reason().as_str()), (403, "ORIGIN_FORBIDDEN"), "{page}");
    }
    let lab = ("origin", "https://lab.example");
    let reply = ask("POST", "/v1/sessions", &[host, json, lab], "{}").await;
    assert_eq!((reply.status, reply.headers["access-control-allow-origin"].as_bytes()), (201, b"https://lab.example".as_slice()));
    let wish = [host, lab, ("access-control-request-method", "POST"), ("access-control-request-headers", "content-type")];
    let reply = ask("OPTIONS", "/v1/sessions", &wish, "").await;
    assert_eq!((reply.status, reply.headers["access-control-allow-headers"].as_bytes()), (200, b"content-type,x-request-id".as_slice()));
    let id = server.open(json!({})).await;
    let socket = [host, ("connection", "upgrade"), ("upgrade", "websocket"), ("sec-websocket-version", "13")];
    let upgrade = async |page: &str| {
        let headers = [socket.as_slice(), &[("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="), ("origin", page)]].concat();
        ask("GET", &format!("/v1/sessions/{id}/stream"), &headers, "").await.status
    };
    assert_eq!((upgrade("https://evil.example").await, upgrade("https://lab.example").await), (403, 101));
    // gRPC goes through the same door.
    let reply = ask("POST", "/ada_diffuser.v1.Models/List", &[host, ("content-type", "application/grpc"), ("origin", "null")], "").await;
    assert_eq!(reply.status, 403);
}

#[tokio::test(flavor = "multi_thread")]
async fn expired_and_evicted_sessions() {
    let server = start(|config| {
        config.sessions.len_max = 2;
        config.sessions.evict_idle_ms = 0;
    })
    .await;
    let short = server.open(json!({"ttl_ms": 1})).await;
    tokio::time::sleep(Duration::from_millis(20)).await;
    refused(&server, &short, 1, &STATE, (Code::NotFound, 410, "SESSION_EXPIRED")).await;
    let slow = server.open(json!({"model": "slow"})).await;
    let blocker = server.start_slow(&slow).await;
    let idle = server.open(json!({})).await;
    let newer = server.open(json!({})).await;
    refused(&server, &idle, 1, &STATE, (Code::NotFound, 410, "SESSION_EVICTED")).await;
    assert_eq!(server.get(&format!("/v1/sessions/{slow}")).await.json()["session"]["busy"], true, "the one in flight is never evicted");
    assert_eq!(server.act(&newer, 1, &STATE).await.status, 200);
    blocker.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn no_room_for_a_session() {
    let server = start(|config| config.sessions.len_max = 1).await;
    let id = server.open(json!({})).await;
    let grpc = server.agent().await.open_session(pb::OpenSessionRequest::default()).await.unwrap_err();
    let http = server.post("/v1/sessions", &json!({})).await;
    both(&grpc, &http, (Code::ResourceExhausted, 429, "QUOTA"));
    assert!(trailer(&grpc, "grpc-retry-pushback-ms").is_some() && http.headers.contains_key("retry-after"));
    assert_eq!(server.http("DELETE", &format!("/v1/sessions/{id}"), "").await.status, 204);
    server.open(json!({})).await;
    let small = start(|config| config.sessions.bytes_max = 1).await;
    assert_eq!(small.post("/v1/sessions", &json!({})).await.reason(), "QUOTA", "the bound on memory");
}

#[tokio::test(flavor = "multi_thread")]
async fn observations_that_do_not_fit() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    for state in [&[][..], &[0.0; 3], &[0.0; 5]] {
        let (grpc, http) = refused(&server, &id, 1, state, (Code::InvalidArgument, 400, "OBSERVATION_INVALID")).await;
        assert_eq!(
            (trailer(&grpc, "ada-field").as_deref(), &http.json()["field"]),
            (Some("observation.state"), &json!("observation.state"))
        );
    }
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let grpc = server.agent().await.act(act(&id, 1, &[0.0, value, 0.0, 0.0])).await.unwrap_err();
        assert_eq!(failure(&grpc), (Code::InvalidArgument, "OBSERVATION_INVALID".into()));
        assert_eq!(trailer(&grpc, "ada-field").as_deref(), Some("observation.state[1]"));
    }
    let with = |executed: pb::Executed| {
        let observation = pb::Observation { state: STATE.to_vec(), executed: vec![executed], ..Default::default() };
        pb::ActRequest { observation: Some(observation), ..act(&id, 1, &STATE) }
    };
    let vector = |values: &[f32]| Some(pb::Vector { values: values.to_vec() });
    for executed in [
        pb::Executed { action: vector(&[0.0]), ..Default::default() },
        pb::Executed { state: vector(&[0.0]), ..Default::default() },
        pb::Executed { action: vector(&[0.0, f32::NAN]), ..Default::default() },
        pb::Executed { reward: Some(f32::NAN), ..Default::default() },
    ] {
        let grpc = server.agent().await.act(with(executed)).await.unwrap_err();
        assert_eq!(failure(&grpc), (Code::InvalidArgument, "OBSERVATION_INVALID".into()));
        assert!(trailer(&grpc, "ada-field").unwrap().starts_with("observation.executed[0]."), "{grpc:?}");
    }
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200, "nothing is lost");
}

/// An array stood for an object, its values in the order of the server's fields, and an object for a word.
#[tokio::test(flavor = "multi_thread")]
async fn json_that_does_not_fit() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let brackets = "[".repeat(100_000);
    let deep = format!(r#"{{"step":1,"observation":{{"state":{brackets}"#);
    let (request, observation) = ("REQUEST_INVALID", "OBSERVATION_INVALID");
    for (body, reason, field) in [
        ("", request, "body"),
        ("{", request, "body"),
        ("[]", request, "body"),
        ("null", request, "body"),
        (r#"[1,{"state":[0,0,0,0]}]"#, request, "body"),
        (r#"{"step":1,"observation":[[0,0,0,0]]}"#, observation, "observation"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0],"executed":[[null,[0,0],0.5]]}}"#, observation, "observation.executed[0]"),
        (r#"{"step":1,"observation":{"state":{"0":0}}}"#, observation, "observation.state"),
        (r#"{"step":1}"#, observation, "observation"),
        (r#"{"observation":{"state":[0,0,0,0]}}"#, request, "step"),
        (r#"{"step":1,"observation":{}}"#, observation, "observation.state"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0]}} x"#, request, "body"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0"#, request, "body"),
        (r#"{"step":1,"observation":{"state":[0,0,0,x]}}"#, request, "body"),
        (r#"{"step":-1,"observation":{"state":[0,0,0,0]}}"#, request, "step"),
        (r#"{"step":1.5,"observation":{"state":[0,0,0,0]}}"#, request, "step"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0]},"deadline_ms":12.5}"#, request, "deadline_ms"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0]},"goal":1}"#, request, "goal"),
        (r#"{"step":1,"observation":{"state":[0,0,0,"NaN"]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,null]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,1e999]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,1e39]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,NaN]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,-Infinity]}}"#, observation, "observation.state[3]"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0],"goal":1}}"#, observation, "observation.goal"),
        (r#"{"step":1,"step":1,"observation":{"state":[0,0,0,0]}}"#, request, "step"),
        (r#"{"step":1,"observation":{"state":[0,0,0,0],"executed":[{"actions":[0,0]}]}}"#, observation, "observation.executed[0].actions"),
        (brackets.as_str(), request, "body"),
        (deep.as_str(), observation, "observation.state[0]"),
    ] {
        let reply = server.http("POST", &format!("/v1/sessions/{id}/act"), body).await;
        assert_eq!((reply.status, reply.reason().as_str()), (400, reason), "{body}");
        assert_eq!(reply.json()["field"], field, "{body}: {}", reply.text);
        let detail = reply.json()["detail"].as_str().unwrap().to_owned();
        assert!(detail.starts_with(&format!("{field}: ")) && !detail[field.len()..].contains(field), "named once: {detail}");
    }
    let reply = server.http("POST", &format!("/v1/sessions/{id}/act"), r#"{"session_id":"x","step":1,"observation":{"state":[]}}"#).await;
    assert_eq!((reply.status, reply.json()["field"].as_str().unwrap()), (400, "session_id"));
    let (reset, batch) = (format!("/v1/sessions/{id}/reset"), "/v1/act:batch");
    for (path, body, field) in [
        ("/v1/sessions", r#"{"sed":1}"#, "sed"),
        ("/v1/sessions", "", "body"),
        ("/v1/sessions", r#"["tiny"]"#, "body"),
        (&reset, r#"{"seed":-1}"#, "seed"),
        (&reset, "[3]", "body"),
        (batch, r#"[[{"session_id":"a","step":1}]]"#, "body"),
        (batch, r#"{"acts":[["a",1,{"state":[0,0,0,0]}]]}"#, "acts[0]"),
        ("/v1/sessions", &format!(r#"{{"options":{{"kappa":{brackets}"#), "body"),
    ] {
        let reply = server.http("POST", path, body).await;
        assert_eq!((reply.status, reply.reason().as_str()), (400, "REQUEST_INVALID"), "{path} {body}");
        assert_eq!(reply.json()["field"], field, "{path} {body}");
    }
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200, "nothing is lost");
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_and_options_that_do_not_fit() {
    let server = start(|_| {}).await;
    let options = |options: pb::SamplerOptions| pb::OpenSessionRequest { options: Some(options), ..Default::default() };
    let none = pb::SamplerOptions::default;
    for (grpc, http, field) in [
        (pb::SamplerOptions { action_horizon: Some(0), ..none() }, json!({"action_horizon": 0}), "options.action_horizon"),
        (pb::SamplerOptions { action_horizon: Some(9), ..none() }, json!({"action_horizon": 9}), "options.action_horizon"),
        (pb::SamplerOptions { sub_steps: Some(0), ..none() }, json!({"sub_steps": 0}), "options.sub_steps"),
        (pb::SamplerOptions { eta: Some(2.0), ..none() }, json!({"eta": 2}), "options.eta"),
        (pb::SamplerOptions { kappa: Some(-1.0), ..none() }, json!({"kappa": -1}), "options.kappa"),
    ] {
        let grpc = server.agent().await.open_session(options(grpc)).await.unwrap_err();
        let http = server.post("/v1/sessions", &json!({"options": http})).await;
        both(&grpc, &http, (Code::InvalidArgument, 400, "OPTIONS_INVALID"));
        assert_eq!((trailer(&grpc, "ada-field").as_deref(), http.json()["field"].as_str()), (Some(field), Some(field)));
    }
    let grpc = server.agent().await.open_session(options(pb::SamplerOptions { latent: Some(9), ..none() })).await.unwrap_err();
    assert_eq!(failure(&grpc), (Code::InvalidArgument, "OPTIONS_INVALID".into()));
    for ttl_ms in [0, u64::MAX] {
        let grpc =
            server.agent().await.open_session(pb::OpenSessionRequest { ttl_ms: Some(ttl_ms), ..Default::default() }).await.unwrap_err();
        let http = server.post("/v1/sessions", &json!({"ttl_ms": ttl_ms})).await;
        both(&grpc, &http, (Code::InvalidArgument, 400, "REQUEST_INVALID"));
    }
    let token = pb::ListSessionsRequest { page_token: "x".into(), ..Default::default() };
    let grpc = server.agent().await.list_sessions(token).await.unwrap_err();
    both(&grpc, &server.get("/v1/sessions?page_token=x").await, (Code::InvalidArgument, 400, "REQUEST_INVALID"));
    for (method, path, field) in [
        ("GET", "/v1/sessions?page=1", "page"),
        ("GET", "/v1/sessions?page_size=many", "page_size"),
        ("GET", "/v1/sessions?page_size=1&page_size=2", "page_size"),
        ("GET", "/v1/sessions/%ff", "path"),
        ("DELETE", "/v1/sessions/%ff", "path"),
        ("POST", "/v1/sessions/%ff/act", "path"),
        ("POST", "/v1/sessions/%ff/reset", "path"),
        ("GET", "/v1/sessions/%ff/stream", "path"),
        ("GET", "/v1/models/%ff", "path"),
    ] {
        let reply = server.http(method, path, "").await;
        assert_eq!((reply.reason().as_str(), reply.json()["field"].as_str()), ("REQUEST_INVALID", Some(field)), "{path}: {reply:?}");
    }
    for (body, field) in [
        (r#"{"options":{"latent":"median"}}"#, "options.latent"),
        (r#"{"options":{"sub_steps":-1}}"#, "options.sub_steps"),
        (r#"{"options":{"kappa":1e39}}"#, "options.kappa"),
        (r#"{"options":{"kappa":"much"}}"#, "options.kappa"),
        (r#"{"options":{"kapa":1}}"#, "options.kapa"),
        (r#"{"options":[true,2]}"#, "options"),
        (r#"{"options":{"latent":{"mean":null}}}"#, "options.latent"),
        (r#"{"options":{"kappa":{"infinity":null}}}"#, "options.kappa"),
    ] {
        let reply = server.http("POST", "/v1/sessions", body).await;
        assert_eq!((reply.reason().as_str(), reply.json()["field"].as_str()), ("OPTIONS_INVALID", Some(field)), "{body}: {reply:?}");
    }
    assert_eq!(server.get("/v1/nothing").await.status, 404);
    assert_eq!(server.get("/v1/act:batch").await.reason(), "METHOD_NOT_ALLOWED");
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_that_are_too_large_or_none() {
    let server = start(|config| {
        config.limits.message_bytes_max = 2048;
        config.limits.act_batch_len_max = 2;
    })
    .await;
    let id = server.open(json!({})).await;
    refused(&server, &id, 1, &[0.123_456_7; 1000], (Code::ResourceExhausted, 413, "TOO_LARGE")).await;
    let body = json!({"acts": vec![json!({"session_id": id, "step": 1, "observation": {"state": STATE}}); 3]});
    let grpc = server.agent().await.act_batch(pb::ActBatchRequest { acts: vec![act(&id, 1, &STATE); 3] }).await.unwrap_err();
    both(&grpc, &server.post("/v1/act:batch", &body).await, (Code::ResourceExhausted, 413, "TOO_LARGE"));
    let path = format!("/v1/sessions/{id}/act");
    let fits = r#"{"step":1,"observation":{"state":[0,0,0,0]}}"#;
    assert_eq!(server.http("POST", &path, &format!("{fits:2049}")).await.reason(), "TOO_LARGE", "one byte too many");
    assert_eq!(server.http("POST", &path, &format!("{fits:2048}")).await.status, 200, "as many as may be");
    let mut raw = tonic::client::Grpc::new(server.channel().await);
    raw.ready().await.unwrap();
    let codec = tonic_prost::ProstCodec::<pb::Vector, pb::ActResponse>::default();
    let path = "/ada_diffuser.v1.Agent/Act".parse().unwrap();
    let malformed = raw.unary(tonic::Request::new(pb::Vector { values: vec![1.0; 3] }), path, codec).await.unwrap_err();
    assert_eq!(failure(&malformed), (Code::InvalidArgument, "REQUEST_INVALID".into()));
}

/// What is told of the past is bounded in number: an act of 74,000 empty steps took 8 MB while it waited, and kept 5 for the session's life.
#[tokio::test(flavor = "multi_thread")]
async fn a_long_past_is_refused_and_a_permitted_one_leaves_no_memory() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let told = |steps: usize| {
        let executed = vec![pb::Executed { reward: Some(0.5), action: Some(pb::Vector { values: vec![0.0; 2] }), state: None }; steps];
        let mut request = act(&id, 1, &STATE);
        request.observation.as_mut().unwrap().executed = executed;
        request
    };
    let grpc = server.agent().await.act(told(4097)).await.unwrap_err();
    let body = json!({"step": 1, "observation": {"state": STATE, "executed": vec![json!({"reward": 0.5, "action": [0, 0]}); 4097]}});
    let http = server.post(&format!("/v1/sessions/{id}/act"), &body).await;
    both(&grpc, &http, (Code::ResourceExhausted, 413, "TOO_LARGE"));
    assert_eq!(server.agent().await.act(told(4096)).await.unwrap().into_inner().step, 1, "nothing was lost");
    let session = server.get(&format!("/v1/sessions/{id}")).await.json()["session"].clone();
    assert!(session["state_bytes"].as_u64().unwrap() < 10_000, "{session}");
}

/// A value far from all data is a wrong unit or a broken sensor, and its name is told; once the network was asked, and the answer was a 500.
#[tokio::test(flavor = "multi_thread")]
async fn values_far_from_the_data_are_refused_by_name() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let (grpc, http) = refused(&server, &id, 1, &[0.0, 1e30, 0.0, 0.0], (Code::InvalidArgument, 400, "OBSERVATION_INVALID")).await;
    assert!(grpc.message().contains("standard deviations") && http.json()["field"] == "observation.state[1]", "{http:?}");
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_and_passed_deadlines() {
    let (_process, server) = start_process(&["engine.workers=1", "engine.queue_len_max=1", "engine.anytime=false"]).await;
    let (running, waiting, third) =
        (server.open(json!({"model": "slow"})).await, server.open(json!({})).await, server.open(json!({})).await);
    let hasty = |id: &str, ms| pb::ActRequest { deadline_ms: Some(ms), ..act(id, 1, &STATE) };
    let hasty_http = |ms: u32| json!({"step": 1, "observation": {"state": STATE}, "deadline_ms": ms});
    // With none left, and with less than the act takes.
    for ms in [0, 300] {
        let grpc = server.agent().await.act(hasty(&running, ms)).await.unwrap_err();
        let http = server.post(&format!("/v1/sessions/{running}/act"), &hasty_http(ms)).await;
        both(&grpc, &http, (Code::DeadlineExceeded, 504, "DEADLINE_ADMISSION"));
    }
    let blocker = server.start_slow(&running).await;
    // The acts before may still be on their way out of the batch.
    while server.metric("ada_inflight_acts").await < 1.0 || server.metric("ada_queue_depth").await > 0.0 {}
    let grpc = server.agent().await.act(hasty(&waiting, 50)).await.unwrap_err();
    let http = server.post(&format!("/v1/sessions/{waiting}/act"), &hasty_http(50)).await;
    both(&grpc, &http, (Code::DeadlineExceeded, 504, "DEADLINE_QUEUE"));
    let queued = server.start_slow(&waiting).await;
    let (grpc, http) = refused(&server, &third, 1, &STATE, (Code::ResourceExhausted, 429, "QUEUE_FULL")).await;
    assert!(trailer(&grpc, "grpc-retry-pushback-ms").is_some() && http.headers.contains_key("retry-after"));
    blocker.abort();
    assert_eq!(queued.await.unwrap().unwrap().step, 1, "the next one has the worker at once");
    assert_eq!(server.act(&third, 1, &STATE).await.status, 200, "nothing is lost");
}

/// A timeout of the call means the same on both faces: when it is over, the caller has hung up. Once gRPC's was taken for a `deadline_ms`, and a
/// client with a short one got degraded answers that it had not asked for. (Without a socket: a stock client would end the call by itself at the
/// same moment.)
#[tokio::test(flavor = "multi_thread")]
async fn a_timeout_of_a_call_is_no_deadline() {
    let mut config = config().validated().unwrap();
    // Tests of deadlines keep time for a machine that does other things too.
    config.engine.deadline_margin_ms = 200;
    let registry = Registry::load(&config.models).unwrap();
    let service = Arc::new(Service::start(config).unwrap());
    service.set_registry(service.warm_up(registry).unwrap());
    let (router, _) = grpc::router(service).unwrap();
    let mut agent = AgentClient::new(router);
    // Named, so that it is not undone where no listener takes the answer.
    let open = pb::OpenSessionRequest { model: "slow".into(), request_id: "one".into(), ..Default::default() };
    let id = agent.open_session(open).await.unwrap().into_inner().session.unwrap().session_id;
    let mut ask = async |deadline_ms, grpc_timeout: &str| {
        let mut request = tonic::Request::new(pb::ActRequest { deadline_ms, ..act(&id, 1, &STATE) });
        request.metadata_mut().insert("grpc-timeout", grpc_timeout.parse().unwrap());
        timeout(Duration::from_secs(10), agent.act(request)).await.expect("it was not heard").map(tonic::Response::into_inner)
    };
    let (early, compute) = ("DEADLINE_ADMISSION", "DEADLINE_COMPUTE");
    for (deadline_ms, grpc_timeout, stage) in [(None, "300m", early), (Some(60_000), "300m", compute), (None, "0n", early)] {
        let late = ask(deadline_ms, grpc_timeout).await.unwrap_err();
        assert_eq!(failure(&late), (Code::DeadlineExceeded, stage.into()), "{deadline_ms:?}");
    }
    assert!(ask(Some(800), "60S").await.unwrap().degraded, "it asked for that");
}

/// Rather than nothing, an act with a deadline gets a coarser answer in time, which says so and is repeated like any other.
#[tokio::test(flavor = "multi_thread")]
async fn a_deadline_gets_a_degraded_answer() {
    let server = start(|config| config.engine.deadline_margin_ms = 200).await;
    let body = json!({"step": 1, "observation": {"state": STATE}, "deadline_ms": 500});
    let id = server.open(json!({"model": "slow"})).await;
    let answer = server.post(&format!("/v1/sessions/{id}/act"), &body).await;
    assert_eq!((answer.status, answer.json()["degraded"].as_bool()), (200, Some(true)));
    let again = server.post(&format!("/v1/sessions/{id}/act"), &body).await.json();
    assert_eq!((&again["actions"], &again["degraded"], &again["replayed"]), (&answer.json()["actions"], &json!(true), &json!(true)));
    assert!(server.metric("ada_degraded_total").await >= 1.0);
    let id = server.open(json!({"model": "slow"})).await;
    let grpc = server.agent().await.act(pb::ActRequest { deadline_ms: Some(500), ..act(&id, 1, &STATE) }).await.unwrap().into_inner();
    assert!(grpc.degraded);
    // One who joins and has time decides for all who wait.
    let id = server.open(json!({"model": "slow"})).await;
    let (mut agent, request) = (server.agent().await, pb::ActRequest { deadline_ms: Some(5_000), ..act(&id, 1, &STATE) });
    let hasty = tokio::spawn(async move { agent.act(request).await });
    server.until(&id, |session| session["busy"] == true).await;
    let patient = server.start_slow(&id).await;
    assert_eq!(failure(&hasty.await.unwrap().unwrap_err()), (Code::DeadlineExceeded, "DEADLINE_COMPUTE".into()));
    patient.abort();
    let id = server.open(json!({"model": "tiny"})).await;
    let grpc = server.agent().await.act(pb::ActRequest { deadline_ms: Some(20_000), ..act(&id, 1, &STATE) }).await.unwrap().into_inner();
    assert!(!grpc.degraded);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_output_that_is_not_finite() {
    let server = start(|_| {}).await;
    let (bad, good) = (server.open(json!({"model": "exploding"})).await, server.open(json!({})).await);
    let (grpc, http) = refused(&server, &bad, 1, &EXPLODING_STATE, (Code::Internal, 500, "NONFINITE_OUTPUT")).await;
    assert!(trailer(&grpc, "ada-error-id").is_some() && http.json()["error_id"].is_string());
    assert_eq!(server.get(&format!("/v1/sessions/{bad}")).await.json()["session"]["committed_step"], 0);
    assert_eq!(server.act(&good, 1, &STATE).await.status, 200);
}
