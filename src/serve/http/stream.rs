//! ActStream as a WebSocket: text messages in, text messages out. The client's close, or its disappearance, drops the acts that are not answered yet.

use super::{Gate, State, answer::ResultAnswer, body::parse, json::ActBody};
use crate::serve::{
    request::{ActRequest, ActResult},
    service::Service,
};
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use futures_util::{SinkExt, Stream, StreamExt, future, stream};
use std::{pin::pin, sync::Arc, task::Poll};
use tokio_util::sync::CancellationToken;

/// Serves one socket until its client leaves, or the server drains and the last act is answered.
pub async fn serve(socket: WebSocket, state: State, session_id: String, gate: Gate) {
    let (mut answers, messages) = socket.split();
    let left = CancellationToken::new();
    let leave = left.clone();
    let acts = acts(messages, state.service.clone(), session_id, gate.client()).chain(stream::poll_fn(move |_| {
        leave.cancel();
        Poll::Ready(None)
    }));
    let mut results = pin!(state.service.clone().act_stream(acts).take_until(left.cancelled()));
    let talk = async {
        while let Some(result) = results.next().await {
            let text = serde_json::to_string(&ResultAnswer::from(result)).expect("an answer is plain data, or it is a bug");
            if answers.send(Message::Text(text.into())).await.is_err() {
                return;
            }
        }
        let (code, reason) =
            if state.service.draining().is_cancelled() { (close_code::AWAY, "draining") } else { (close_code::NORMAL, "") };
        // The client may be gone already; then there is nobody to tell.
        let _gone = answers.send(Message::Close(Some(CloseFrame { code, reason: reason.into() }))).await;
    };
    gate.until_hard_end(talk).await;
}

/// The acts among the messages; they end with the client's close or a broken connection.
fn acts(
    messages: impl Stream<Item = Result<Message, axum::Error>>,
    service: Arc<Service>,
    session_id: String,
    client: u64,
) -> impl Stream<Item = Result<ActRequest, ActResult>> {
    let read = move |bytes: &[u8]| match parse::<ActBody>(bytes, service.config()) {
        Ok(mut body) => {
            let session_id = body.session_id.take().unwrap_or_else(|| session_id.clone());
            Ok(body.into_request(session_id, client))
        }
        Err(error) => Err(ActResult { session_id: session_id.clone(), step: 0, result: Err(error) }),
    };
    let open = messages.take_while(|message| future::ready(!matches!(message, Err(_) | Ok(Message::Close(_)))));
    open.filter_map(move |message| {
        future::ready(match message {
            Ok(Message::Text(text)) => Some(read(text.as_bytes())),
            Ok(Message::Binary(bytes)) => Some(read(&bytes)),
            Ok(Message::Ping(_) | Message::Pong(_) | Message::Close(_)) | Err(_) => None,
        })
    })
}
