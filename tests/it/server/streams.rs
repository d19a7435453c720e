//! Many acts on one stream: gRPC and WebSocket.

use super::*;
use futures_util::{SinkExt, StreamExt};
use std::collections::HashMap;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_tungstenite::{
    MaybeTlsStream, WebSocketStream, connect_async,
    tungstenite::{Message, protocol::frame::coding::CloseCode},
};

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

async fn socket_of(server: &Running, id: &str) -> Socket {
    connect_async(format!("ws://{}/v1/sessions/{id}/stream", server.address)).await.unwrap().0
}

/// The next message that is no ping.
async fn heard(socket: &mut Socket) -> Message {
    loop {
        match timeout(Duration::from_secs(5), socket.next()).await.expect("nothing comes").unwrap().unwrap() {
            Message::Ping(_) => {}
            message => return message,
        }
    }
}

fn read(message: Message) -> Value {
    match message {
        Message::Text(text) => serde_json::from_str(&text).unwrap(),
        message => panic!("{message:?}"),
    }
}

fn closing(message: Message) -> (CloseCode, String) {
    match message {
        Message::Close(Some(frame)) => (frame.code, frame.reason.to_string()),
        message => panic!("{message:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn many_sessions_on_one_grpc_stream() {
    let server = start(|_| {}).await;
    let mut agent = server.agent().await;
    let (acts, receiver) = mpsc::channel(64);
    let mut results = agent.act_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    let mut expected = HashMap::new();
    for seed in 0..8 {
        let (id, twin) = (server.open(json!({"seed": seed})).await, server.open(json!({"seed": seed})).await);
        expected.insert(id.clone(), agent.act(act(&twin, 1, &STATE)).await.unwrap().into_inner().actions);
        acts.send(act(&id, 1, &STATE)).await.unwrap();
    }
    let wrong = act("none", 4, &STATE);
    acts.send(wrong).await.unwrap();
    for _ in 0..9 {
        let result = results.next().await.unwrap().unwrap();
        match result.result.unwrap() {
            pb::act_result::Result::Response(answer) => assert_eq!(Some(answer.actions), expected.remove(&result.session_id)),
            pb::act_result::Result::Error(error) => {
                assert_eq!((result.session_id.as_str(), result.step), ("none", 4));
                assert_eq!((error.code, error.reason.as_str()), (5, "SESSION_NOT_FOUND"));
            }
        }
    }
    assert!(expected.is_empty(), "an error does not end the stream");
    drop(acts);
    assert!(results.next().await.is_none(), "it ends with the client's end");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_web_socket_speaks_the_same() {
    let server = start(|_| {}).await;
    let (id, other) = (server.open(json!({"seed": 1})).await, server.open(json!({"seed": 1})).await);
    let (mut socket, _) = connect_async(format!("ws://{}/v1/sessions/{id}/stream", server.address)).await.unwrap();
    let mut say = async |text: String| {
        socket.send(Message::text(text)).await.unwrap();
        match socket.next().await.unwrap().unwrap() {
            Message::Text(text) => serde_json::from_str::<Value>(&text).unwrap(),
            message => panic!("{message:?}"),
        }
    };
    let first = say(json!({"step": 1, "observation": {"state": STATE}}).to_string()).await;
    assert_eq!((&first["session_id"], &first["step"], &first["response"]["replayed"]), (&json!(id), &json!(1), &json!(false)));
    let same_seed = say(json!({"session_id": other, "step": 1, "observation": {"state": STATE}}).to_string()).await;
    assert_eq!((&same_seed["session_id"], &same_seed["response"]["actions"]), (&json!(other), &first["response"]["actions"]));
    let again = say(json!({"step": 1, "observation": {"state": STATE}}).to_string()).await;
    assert_eq!(again["response"]["replayed"], true);
    let broken = say("{".into()).await;
    assert_eq!((&broken["error"]["reason"], &broken["session_id"]), (&json!("REQUEST_INVALID"), &json!(id)));
    let early = say(json!({"step": 9, "observation": {"state": STATE}}).to_string()).await;
    assert_eq!((&early["error"]["reason"], &early["error"]["committed_step"]), (&json!("STEP_OUT_OF_ORDER"), &json!(1)));
    let next = say(json!({"step": 2, "observation": {"state": STATE}}).to_string()).await;
    assert_eq!(next["response"]["step"], 2, "an error does not end the stream");
    socket.close(None).await.unwrap();
    let plain = server.get(&format!("/v1/sessions/{id}/stream")).await;
    assert_eq!((plain.status, plain.reason().as_str()), (400, "REQUEST_INVALID"), "without an upgrade");
    assert!(connect_async(format!("ws://{}/v1/sessions/none/stream", server.address)).await.is_err());
}

/// A client that leaves its stream leaves no work behind.
#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_stream_cancels_its_acts() {
    let server = start(|_| {}).await;
    let slow = server.open(json!({"model": "slow"})).await;
    let (mut socket, _) = connect_async(format!("ws://{}/v1/sessions/{slow}/stream", server.address)).await.unwrap();
    socket.send(Message::text(json!({"step": 1, "observation": {"state": STATE}}).to_string())).await.unwrap();
    server.until(&slow, |session| session["busy"] == true).await;
    drop(socket);
    server.until(&slow, |session| session["busy"] == false).await;
    let mut agent = server.agent().await;
    let (acts, receiver) = mpsc::channel(1);
    let results = agent.act_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    acts.send(act(&slow, 1, &STATE)).await.unwrap();
    server.until(&slow, |session| session["busy"] == true).await;
    drop((results, acts, agent));
    server.until(&slow, |session| session["busy"] == false).await;
}

/// Draining ends idle streams, so that they do not hold up the end.
#[tokio::test(flavor = "multi_thread")]
async fn a_drain_ends_idle_streams() {
    let mut server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let (mut socket, _) = connect_async(format!("ws://{}/v1/sessions/{id}/stream", server.address)).await.unwrap();
    let mut agent = server.agent().await;
    let (_acts, receiver) = mpsc::channel(1);
    let mut results = agent.act_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    server.stop.cancel();
    assert!(matches!(socket.next().await, Some(Ok(Message::Close(Some(_))))), "going away");
    assert!(results.next().await.is_none());
    timeout(Duration::from_secs(3), &mut server.done).await.expect("the streams held up the end").unwrap().unwrap();
}

/// The answer to a message that could not be read was for step 0, whatever it said.
#[tokio::test(flavor = "multi_thread")]
async fn an_unreadable_message_is_answered_for_its_step() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    let mut socket = socket_of(&server, &id).await;
    for (text, session_id, step, field) in [
        (r#"{"step":7,"goal":1,"session_id":"other"}"#, "other", 7, "goal"),
        (r#"{"step":7,"observation":{"state":[NaN]}}"#, id.as_str(), 7, "observation.state[0]"),
        (r#"{"step":7,"observation":[[0,0,0,0]]}"#, &id, 7, "observation"),
        (r#"[7,{"state":[0,0,0,0]}]"#, &id, 0, "body"),
        ("no JSON", &id, 0, "body"),
    ] {
        socket.send(Message::text(text)).await.unwrap();
        let answer = read(heard(&mut socket).await);
        assert_eq!((&answer["session_id"], &answer["step"]), (&json!(session_id), &json!(step)), "{text}");
        assert_eq!(answer["error"]["field"], field, "{text}: {answer}");
    }
}

/// A socket just ended when a message was too large, and its client did not learn why.
#[tokio::test(flavor = "multi_thread")]
async fn a_message_that_is_too_large_is_told_and_ends_the_socket() {
    let server = start(|config| config.limits.message_bytes_max = 2048).await;
    let id = server.open(json!({})).await;
    for len in [2049, 20_000] {
        let mut socket = socket_of(&server, &id).await;
        socket.send(Message::text("0".repeat(len))).await.unwrap();
        let told = read(heard(&mut socket).await);
        assert_eq!((&told["error"]["reason"], &told["error"]["status"]), (&json!("TOO_LARGE"), &json!(413)), "{len}");
        let (code, reason) = closing(heard(&mut socket).await);
        assert_eq!((code, reason.contains("limits.message_bytes_max = 2048")), (CloseCode::Size, true), "{len}: {reason}");
        assert!(!matches!(socket.next().await, Some(Ok(_))), "it is over");
    }
    let mut socket = socket_of(&server, &id).await;
    socket.send(Message::text(json!({"step": 1, "observation": {"state": STATE}}).to_string())).await.unwrap();
    assert_eq!(read(heard(&mut socket).await)["response"]["step"], 1);
}

/// A socket whose client had lost its network, or only said nothing, held its place for ever.
#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_answers_no_ping_is_cut() {
    let server = start(|config| {
        config.connection.keepalive_interval_ms = 200;
        config.connection.keepalive_timeout_ms = 200;
    })
    .await;
    let id = server.open(json!({})).await;
    let (mut dead, mut alive) = (socket_of(&server, &id).await, socket_of(&server, &id).await);
    // Who reads answers pings.
    assert!(timeout(Duration::from_millis(1500), async { while let Some(Ok(Message::Ping(_))) = alive.next().await {} }).await.is_err());
    let left = async { while let Some(Ok(_)) = dead.next().await {} };
    timeout(Duration::from_millis(100), left).await.expect("it is still served");
    alive.send(Message::text(json!({"step": 1, "observation": {"state": STATE}}).to_string())).await.unwrap();
    assert_eq!(read(heard(&mut alive).await)["response"]["step"], 1);
}

/// Pings keep a socket open, not its place: of whom nothing is asked for long it is taken. An act in work is something.
#[tokio::test(flavor = "multi_thread")]
async fn a_socket_without_acts_leaves() {
    let server = start(|config| config.connection.idle_timeout_ms = 300).await;
    let (id, slow) = (server.open(json!({})).await, server.open(json!({"model": "slow"})).await);
    let (mut idle, mut working) = (socket_of(&server, &id).await, socket_of(&server, &slow).await);
    working.send(Message::text(json!({"step": 1, "observation": {"state": STATE}}).to_string())).await.unwrap();
    let begin = std::time::Instant::now();
    for step in 1..=4 {
        tokio::time::sleep(Duration::from_millis(150)).await;
        idle.send(Message::text(json!({"step": step, "observation": {"state": STATE}}).to_string())).await.unwrap();
        assert_eq!(read(heard(&mut idle).await)["response"]["step"], step, "whoever acts now and then stays");
    }
    assert_eq!(closing(heard(&mut idle).await), (CloseCode::Away, "idle".to_owned()));
    assert!(begin.elapsed() >= Duration::from_millis(900), "{:?}", begin.elapsed());
    assert!(timeout(Duration::from_millis(400), working.next()).await.is_err(), "an act in work is not idle");
}

/// A client that asks and does not read makes the server keep the answers.
#[tokio::test(flavor = "multi_thread")]
async fn a_socket_that_nobody_reads_is_cut() {
    let server = start(|config| config.connection.write_timeout_ms = 300).await;
    let id = server.open(json!({})).await;
    let mut socket = socket_of(&server, &id).await;
    let asking = async { while socket.send(Message::text("x")).await.is_ok() {} };
    timeout(Duration::from_secs(30), asking).await.expect("it is served for ever");
}
