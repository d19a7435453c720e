//! ActStream as a WebSocket: text messages in, text messages out. The client's close, or its disappearance, drops the acts that are not answered
//! yet. Who is silent is pinged; who does not answer that, does not take his answers, or asks nothing for long, loses the socket.

use super::{
    Gate, State,
    answer::ResultAnswer,
    body::{heading, parse},
    json::ActBody,
};
use crate::serve::{
    config::ConnectionConfig,
    error::ServiceError,
    idle::Idle,
    request::{ActRequest, ActResult},
    service::Service,
};
use axum::{
    body::Bytes,
    extract::ws::{CloseFrame, Message, WebSocket, close_code},
};
use futures_util::{SinkExt, Stream, StreamExt, future, stream, stream::SplitSink};
use parking_lot::Mutex;
use std::{
    error::Error,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    task::Poll,
    time::Duration,
};
use tokio::time::{Instant, Interval, interval, timeout};
use tokio_util::sync::CancellationToken;
use tungstenite::error::{CapacityError, Error as Failure, ProtocolError};

/// A code of [`close_code`], and the reason in words.
type Ending = (u16, String);

/// Serves one socket until its client leaves, or the server drains and the last act is answered.
pub async fn serve(socket: WebSocket, state: State, session_id: String, gate: Gate) {
    let (answers, messages) = socket.split();
    let service = state.service;
    let connection = &service.config().connection;
    let ear = Arc::new(Ear::new(session_id, gate.client()));
    let mut mouth = Mouth { answers, patience: Duration::from_millis(connection.write_timeout_ms) };
    let talk = async {
        let ending = talk(messages, &service, &ear, &mut mouth).await;
        if let Some((code, reason)) = ending {
            // Its messages may still be coming in, and are not read any more.
            gate.linger();
            mouth.say(Message::Close(Some(CloseFrame { code, reason: reason.into() }))).await;
        }
    };
    gate.until_hard_end(talk).await;
}

/// How it ends, if there is still somebody to be told.
async fn talk(
    messages: impl Stream<Item = Result<Message, axum::Error>> + Send,
    service: &Arc<Service>,
    ear: &Arc<Ear>,
    mouth: &mut Mouth,
) -> Option<Ending> {
    let left = CancellationToken::new();
    let leave = left.clone();
    let acts = acts(messages, ear.clone()).chain(stream::poll_fn(move |_| {
        leave.cancel();
        Poll::Ready(None)
    }));
    let mut results = pin!(service.clone().act_stream(acts).take_until(left.cancelled()));
    let mut pulse = Pulse::new(&service.config().connection);
    let width = service.config().limits.stream_acts_max;
    loop {
        let message = tokio::select! {
            result = results.next() => match result {
                Some(Ok(result)) => {
                    ear.in_work.fetch_sub(1, Ordering::Relaxed);
                    text(result)
                }
                Some(Err(Idle)) => return Some((close_code::AWAY, "idle".to_owned())),
                None => break,
            },
            _ = pulse.looks.tick() => {
                if ear.in_work.load(Ordering::Relaxed) >= width || service.draining().is_cancelled() {
                    // Nobody listens just now: silence says nothing.
                    ear.hear();
                }
                match pulse.feel(ear.silence()) {
                    Sign::Alive => continue,
                    Sign::Silent => Message::Ping(Bytes::new()),
                    Sign::Gone => {
                        metrics::counter!("ada_connections_timed_out_total").increment(1);
                        return None;
                    }
                }
            }
        };
        if !mouth.say(message).await {
            return None;
        }
    }
    let failure = ear.failure.lock().take();
    match failure {
        Some(failure) => {
            let limit = service.config().limits.message_bytes_max;
            let ending = ending(&failure, limit)?;
            if ending.0 == close_code::SIZE {
                metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
                let error = ServiceError::TooLarge { what: "bytes of a message", limit };
                mouth.say(text(ActResult { session_id: ear.session_id.clone(), step: 0, result: Err(error) })).await;
            }
            Some(ending)
        }
        None if service.draining().is_cancelled() => Some((close_code::AWAY, "draining".to_owned())),
        None => Some((close_code::NORMAL, String::new())),
    }
}

fn text(result: ActResult) -> Message {
    let text = serde_json::to_string(&ResultAnswer::from(result)).expect("an answer is plain data, or it is a bug");
    Message::Text(text.into())
}

/// What to close with after messages that cannot be read (RFC 6455, 7.4.1); None: the client is gone.
fn ending(failure: &axum::Error, limit: usize) -> Option<Ending> {
    match failure.source()?.downcast_ref::<Failure>()? {
        Failure::Capacity(CapacityError::MessageTooLong { .. }) => {
            Some((close_code::SIZE, format!("a message exceeds limits.message_bytes_max = {limit} bytes")))
        }
        Failure::Utf8(_) => Some((close_code::INVALID, "a text message is not UTF-8".to_owned())),
        Failure::Protocol(ProtocolError::ResetWithoutClosingHandshake) => None,
        Failure::Protocol(_) => Some((close_code::PROTOCOL, "a frame is not of RFC 6455".to_owned())),
        _ => None,
    }
}

/// What is heard of the client.
struct Ear {
    /// That of the path, for messages that name none.
    session_id: String,
    client: u64,
    last: Mutex<Instant>,
    /// Acts that are not answered yet.
    in_work: AtomicUsize,
    /// Why no more can be read.
    failure: Mutex<Option<axum::Error>>,
}

impl Ear {
    fn new(session_id: String, client: u64) -> Self {
        Self { session_id, client, last: Mutex::new(Instant::now()), in_work: AtomicUsize::new(0), failure: Mutex::new(None) }
    }

    fn hear(&self) {
        *self.last.lock() = Instant::now();
    }

    fn silence(&self) -> Duration {
        self.last.lock().elapsed()
    }

    /// The act that this message is, if it is one.
    fn act(&self, message: &Message) -> Option<Result<ActRequest, ActResult>> {
        let bytes = match message {
            Message::Text(text) => text.as_bytes(),
            Message::Binary(bytes) => bytes,
            Message::Ping(_) | Message::Pong(_) | Message::Close(_) => return None,
        };
        self.in_work.fetch_add(1, Ordering::Relaxed);
        let session_of = |named: Option<String>| named.unwrap_or_else(|| self.session_id.clone());
        Some(match parse::<ActBody>(bytes) {
            Ok(mut body) => {
                let session_id = session_of(body.session_id.take());
                Ok(body.into_request(session_id, self.client))
            }
            Err(error) => {
                let heading = heading(bytes);
                Err(ActResult { session_id: session_of(heading.session_id), step: heading.step, result: Err(error) })
            }
        })
    }
}

/// The acts among the messages; they end with the client's close or a broken connection.
fn acts(messages: impl Stream<Item = Result<Message, axum::Error>>, ear: Arc<Ear>) -> impl Stream<Item = Result<ActRequest, ActResult>> {
    let listener = ear.clone();
    let open = messages.scan((), move |(), message| {
        listener.hear();
        future::ready(match message {
            Ok(Message::Close(_)) => None,
            Ok(message) => Some(message),
            Err(failure) => {
                *listener.failure.lock() = Some(failure);
                None
            }
        })
    });
    open.filter_map(move |message| future::ready(ear.act(&message)))
}

/// What is said to the client.
struct Mouth {
    answers: SplitSink<WebSocket, Message>,
    patience: Duration,
}

impl Mouth {
    /// Whether it was taken, and in time.
    async fn say(&mut self, message: Message) -> bool {
        match timeout(self.patience, self.answers.send(message)).await {
            Ok(said) => said.is_ok(),
            Err(_) => {
                metrics::counter!("ada_connections_timed_out_total").increment(1);
                false
            }
        }
    }
}

/// Whether there is still somebody: a peer that lost its network says nothing, and no error tells.
struct Pulse {
    looks: Interval,
    keepalive_interval: Duration,
    keepalive_timeout: Duration,
    /// How long it had been silent when it was pinged.
    asked: Option<Duration>,
}

/// What silence means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sign {
    /// Nothing.
    Alive,
    /// It is to be pinged.
    Silent,
    /// The ping is not answered.
    Gone,
}

impl Pulse {
    fn new(config: &ConnectionConfig) -> Self {
        let shortest = config.keepalive_interval_ms.min(config.keepalive_timeout_ms);
        Self {
            looks: interval(Duration::from_millis((shortest / 4).clamp(20, 5_000))),
            keepalive_interval: Duration::from_millis(config.keepalive_interval_ms),
            keepalive_timeout: Duration::from_millis(config.keepalive_timeout_ms),
            asked: None,
        }
    }

    fn feel(&mut self, silence: Duration) -> Sign {
        self.asked = self.asked.filter(|asked| silence >= *asked);
        match self.asked {
            None if silence < self.keepalive_interval => Sign::Alive,
            None => {
                self.asked = Some(silence);
                Sign::Silent
            }
            Some(asked) if silence >= asked + self.keepalive_timeout => Sign::Gone,
            Some(_) => Sign::Alive,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn silence_is_asked_once_and_then_ends() {
        let config = ConnectionConfig { keepalive_interval_ms: 100, keepalive_timeout_ms: 50, ..ConnectionConfig::default() };
        let mut pulse = Pulse::new(&config);
        let (alive, silent, gone) = (Sign::Alive, Sign::Silent, Sign::Gone);
        let felt = [0, 99, 100, 120, 149, 10, 110, 159, 160].map(|ms| pulse.feel(Duration::from_millis(ms)));
        assert_eq!(felt, [alive, alive, silent, alive, alive, alive, silent, alive, gone]);
        // One who looks late asks all the same before it judges.
        assert_eq!([0, 500, 549, 550].map(|ms| pulse.feel(Duration::from_millis(ms))), [alive, silent, alive, gone]);
    }
}
