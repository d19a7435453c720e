//! Many acts on one stream: gRPC and WebSocket.

use super::*;
use futures_util::{SinkExt, StreamExt};
use std::collections::HashMap;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_tungstenite::{connect_async, tungstenite::Message};

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
