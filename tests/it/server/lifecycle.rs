//! Start and end: probes, refusals at the start, drains that end, the binary itself.

use super::*;
use ada_diffuser::serve::{grpc, http, service::Service, telemetry};
use axum::{Router, http::Request};
use std::{process::Command, sync::Arc, time::Instant};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tower::ServiceExt;

async fn ask(router: &Router, method: &str, path: &str, body: &str) -> u16 {
    let request =
        Request::builder().method(method).uri(path).header("content-type", "application/json").body(Body::from(body.to_owned())).unwrap();
    router.clone().oneshot(request).await.unwrap().status().as_u16()
}

#[tokio::test(flavor = "multi_thread")]
async fn without_models_it_is_not_ready() {
    let service = Arc::new(Service::start(config().validated().unwrap()).unwrap());
    let http = http::router(http::State { service: service.clone(), metrics: telemetry::install_metrics() });
    assert_eq!(ask(&http, "POST", "/v1/sessions", "{}").await, 503);
    assert_eq!((ask(&http, "GET", "/readyz", "").await, ask(&http, "GET", "/livez", "").await), (503, 200));
    let (grpc, _) = grpc::router(service).unwrap();
    let status = AgentClient::new(grpc).open_session(pb::OpenSessionRequest::default()).await.unwrap_err();
    assert_eq!(failure(&status), (Code::Unavailable, "NOT_READY".into()));
    assert!(trailer(&status, "grpc-retry-pushback-ms").is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drain_tells_everyone_and_ends() {
    let mut server = start(|config| config.server.drain_notice_ms = 1500).await;
    let id = server.open(json!({})).await;
    let committed = server.act(&id, 1, &STATE).await.json();
    let mut agent = server.agent().await;
    let mut health = HealthClient::new(server.channel().await);
    let mut serving = async || {
        let request = HealthCheckRequest { service: "ada_diffuser.v1.Agent".into() };
        health.check(request).await.unwrap().into_inner().status
    };
    assert_eq!(serving().await, 1, "SERVING");
    server.stop.cancel();
    while server.get("/readyz").await.status == 200 {}
    assert_eq!(serving().await, 2, "NOT_SERVING");
    assert_eq!(server.get("/livez").await.status, 200, "draining is not being dead");
    // An answer that was lost can still be had; it was a refusal, and the act was lost with it.
    let again = server.act(&id, 1, &STATE).await.json();
    assert_eq!((&again["actions"], &again["replayed"]), (&committed["actions"], &json!(true)));
    let grpc = agent.act(act(&id, 2, &STATE)).await.unwrap_err();
    let http = server.act(&id, 2, &STATE).await;
    assert_eq!((failure(&grpc), http.status, http.reason().as_str()), ((Code::Unavailable, "DRAINING".into()), 503, "DRAINING"));
    assert!(http.headers.contains_key("retry-after") && trailer(&grpc, "grpc-retry-pushback-ms").is_some());
    assert_eq!(server.post("/v1/sessions", &json!({})).await.reason(), "DRAINING");
    timeout(Duration::from_secs(5), &mut server.done).await.expect("it did not end").unwrap().unwrap();
}

/// An act in flight is let end if it ends in time; one that does not, a silent HTTP/2 connection and a stalled request are cut.
#[tokio::test(flavor = "multi_thread")]
async fn a_drain_ends_in_bounded_time_whatever_the_clients_do() {
    use tokio::io::AsyncWriteExt;
    let mut server = start(|config| config.server.drain_timeout_ms = 700).await;
    let slow = server.open(json!({"model": "slow"})).await;
    let blocked = server.start_slow(&slow).await;
    let mut silent = TcpStream::connect(server.address).await.unwrap();
    silent.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
    let mut stalled = TcpStream::connect(server.address).await.unwrap();
    stalled
        .write_all(b"POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 9\r\n\r\n{")
        .await
        .unwrap();
    tokio::time::sleep(Duration::from_millis(50)).await;
    let begin = Instant::now();
    server.stop.cancel();
    timeout(Duration::from_secs(5), &mut server.done).await.expect("it did not end").unwrap().unwrap();
    let took = begin.elapsed();
    assert!((Duration::from_millis(700)..Duration::from_secs(3)).contains(&took), "{took:?}");
    assert!(blocked.await.unwrap().is_err());
}

/// Somebody who watched the server's health, or had asked reflection and kept the stream, made each drain last for all of
/// `server.drain_timeout_ms`.
#[tokio::test(flavor = "multi_thread")]
async fn who_watches_does_not_hold_a_drain() {
    use futures_util::{StreamExt, stream};
    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient, server_reflection_request::MessageRequest,
    };
    let mut server = start(|_| {}).await;
    let watch = HealthClient::new(server.channel().await).watch(HealthCheckRequest { service: String::new() }).await;
    let mut watch = watch.unwrap().into_inner();
    assert_eq!(watch.message().await.unwrap().unwrap().status, 1, "SERVING");
    let list = ServerReflectionRequest { host: String::new(), message_request: Some(MessageRequest::ListServices(String::new())) };
    let questions = stream::iter([list]).chain(stream::pending());
    let mut reflection = ServerReflectionClient::new(server.channel().await).server_reflection_info(questions).await.unwrap().into_inner();
    assert!(reflection.message().await.unwrap().is_some());
    let acts = server.agent().await.act_stream(stream::pending::<pb::ActRequest>()).await.unwrap();
    let begin = Instant::now();
    server.stop.cancel();
    assert_eq!(watch.message().await.unwrap().unwrap().status, 2, "NOT_SERVING, and then the end");
    assert_eq!(watch.message().await.unwrap_err().code(), Code::Unavailable);
    assert_eq!(reflection.message().await.unwrap_err().code(), Code::Unavailable);
    timeout(Duration::from_secs(5), &mut server.done).await.expect("it did not end").unwrap().unwrap();
    assert!(begin.elapsed() < Duration::from_secs(2), "{:?}", begin.elapsed());
    drop(acts);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_act_in_flight_survives_a_drain() {
    let mut server = start(|config| config.engine.deadline_margin_ms = 200).await;
    let id = server.open(json!({"model": "slow"})).await;
    let mut agent = server.agent().await;
    let request = pb::ActRequest { deadline_ms: Some(800), ..act(&id, 1, &STATE) };
    let in_flight = tokio::spawn(async move { agent.act(request).await });
    server.until(&id, |session| session["busy"] == true).await;
    server.stop.cancel();
    let answer = in_flight.await.unwrap().unwrap().into_inner();
    assert!(answer.degraded && answer.step == 1, "it had its time: {answer:?}");
    timeout(Duration::from_secs(3), &mut server.done).await.expect("it did not end").unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_served_is_named() {
    let refused = async |adjust: fn(&mut Config)| {
        let mut config = config();
        adjust(&mut config);
        let server = Server::bind(config.validated().unwrap()).await.unwrap();
        let run = timeout(Duration::from_secs(10), server.run(std::future::pending()));
        run.await.expect("it serves").unwrap_err().to_string()
    };
    let message = refused(|config| config.models.default = "torn".into()).await;
    assert_eq!(message, r#"models.default "torn" is not loaded; there are: exploding, slow, tiny"#);
    assert!(refused(|config| config.models.dir = "/nowhere".into()).await.starts_with("models.dir /nowhere: "));
    assert!(refused(|config| config.models.dir = std::env::temp_dir().join("..")).await.contains("no checkpoint"));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_faces_describe_themselves() {
    let server = start(|_| {}).await;
    let api = server.get("/openapi.json").await.json();
    let paths: Vec<_> = api["paths"].as_object().unwrap().keys().map(String::as_str).collect();
    let expected = [
        "/livez",
        "/metrics",
        "/readyz",
        "/v1/act:batch",
        "/v1/models",
        "/v1/models/{name}",
        "/v1/sessions",
        "/v1/sessions/{id}",
        "/v1/sessions/{id}/act",
        "/v1/sessions/{id}/export",
        "/v1/sessions/{id}/fork",
        "/v1/sessions/{id}/reset",
        "/v1/sessions/{id}/seal",
        "/v1/sessions/{id}/stream",
        "/v1/sessions:import",
        "/v1/sessions:resume",
    ];
    assert_eq!(paths, expected);
    assert!(api["components"]["schemas"]["ActBody"]["properties"]["observation"].is_object());
    for (path, methods) in api["paths"].as_object().unwrap() {
        for (method, operation) in methods.as_object().unwrap() {
            for (status, response) in operation["responses"].as_object().unwrap() {
                let described = response["description"].as_str().is_some_and(|text| !text.is_empty());
                let errors = status != "default" || response["content"]["application/problem+json"].is_object();
                assert!(described && errors, "{method} {path} {status}: {response}");
            }
        }
    }
    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient, server_reflection_request::MessageRequest,
    };
    let list = ServerReflectionRequest { host: String::new(), message_request: Some(MessageRequest::ListServices(String::new())) };
    let mut reflection = ServerReflectionClient::new(server.channel().await);
    let mut answers = reflection.server_reflection_info(tokio_stream::iter([list])).await.unwrap().into_inner();
    let text = format!("{:?}", answers.message().await.unwrap().unwrap());
    for name in ["ada_diffuser.v1.Agent", "ada_diffuser.v1.Models", "grpc.health.v1.Health"] {
        assert!(text.contains(name), "{name}: {text}");
    }
    let own = server.get("/readyz").await.headers["x-request-id"].to_str().unwrap().to_owned();
    assert_eq!(own.len(), 36);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_binary_ends_well_on_a_signal() {
    for signal in ["TERM", "INT"] {
        let (mut process, server) = start_process(&["server.drain_notice_ms=0"]).await;
        let environment = std::fs::read(format!("/proc/{}/environ", process.0.id())).unwrap();
        let environment = String::from_utf8_lossy(&environment).into_owned();
        assert!(environment.contains("RAYON_NUM_THREADS=1") && environment.contains("CANDLE_NUM_THREADS=1"));
        let id = server.open(json!({})).await;
        assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
        let begin = Instant::now();
        assert!(Command::new("kill").args([&format!("-{signal}"), &process.0.id().to_string()]).status().unwrap().success());
        let status = process.0.wait().unwrap();
        assert!(status.success() && begin.elapsed() < Duration::from_secs(3), "{signal}: {status} after {:?}", begin.elapsed());
    }
}

#[test]
fn the_binary_names_what_is_wrong() {
    let run = |arguments: &[&str], environment: &[(&str, &str)]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ada-server"));
        let output = command.args(arguments).envs(environment.iter().copied()).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(run(&["--set", "engine.nothing=1"], &[]).contains("nothing"));
    assert!(run(&[], &[("ADA__ENGINE__QUEUE_LEN_MAX", "0")]).contains("engine.queue_len_max: must be at least 1"));
    assert!(run(&["--config", "/nowhere.toml"], &[]).contains("/nowhere.toml"));
    let models = models_dir().to_str().unwrap();
    assert!(run(&["--listen", "127.0.0.1:0", "--models", models, "--default-model", "x"], &[]).contains("models.default"));
}

/// `--listen localhost:7777` was "invalid socket address syntax". Of the name's addresses it is the one that examples and clients use.
#[tokio::test(flavor = "multi_thread")]
async fn it_listens_on_a_name() {
    let server = start(|config| config.server.listen = "localhost:0".to_owned()).await;
    assert!(server.address.ip().is_loopback() && server.address.is_ipv4(), "{}", server.address);
    let mut config = config();
    config.server.listen = "nobody.invalid:7777".to_owned();
    let error = Server::bind(config.validated().unwrap()).await.map(|_| ()).unwrap_err().to_string();
    assert!(error.starts_with("server.listen nobody.invalid:7777: "), "{error}");
    let flags = ["--listen", "localhost:0", "--set", "engine.anytime=no"];
    let output = Command::new(env!("CARGO_BIN_EXE_ada-server")).args(flags).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("engine.anytime") && !text.contains("listen"), "{text}");
}
