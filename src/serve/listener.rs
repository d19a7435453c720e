//! The one accept loop: both faces on one port, every connection bounded in time, and an end that comes.

use crate::serve::{
    config::{Config, ConnectionConfig},
    connections::{Activity, Asked, Given, Held, Kind, Places, Verdict, look_interval},
    gate::Gate,
    grpc::{self, endless},
    guard::Guard,
    http::Problem,
    net::{Listener, Stream},
    session::Untold,
    wire::{Bounds, Watched, Wire},
};
use axum::{
    Router,
    body::Body,
    extract::MatchedPath,
    http::{HeaderName, HeaderValue, Request, Response, StatusCode, Version, header},
    response::IntoResponse,
};
use futures_util::FutureExt;
use hyper::{body::Incoming, service::service_fn};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::conn::auto,
};
use std::{convert::Infallible, error::Error, io, panic::AssertUnwindSafe, pin::pin, sync::Arc, time::Duration};
use tokio::{
    io::{AsyncWriteExt, copy, sink},
    time::{Instant, interval, sleep, timeout},
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tower::ServiceExt;
use tracing::Instrument;
use uuid::Uuid;

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Bytes of requests that an HTTP/2 connection may send before they are read. A megabyte, the stock value, times all connections is too much.
const HTTP2_WINDOW: u32 = 128 << 10;
/// Bytes of an HTTP/2 answer that wait for the socket. The stock value lets the 128 streams of a connection hold 50 MB.
const HTTP2_SEND_BUFFER: usize = 64 << 10;
const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// What one connection too many is told to wait.
const RETRY_AFTER_FULL_MS: u64 = 1_000;
/// After a failed accept (too many open files, mostly): the condition does not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// What tasks get to notice the hard end.
const HARD_END_PATIENCE: Duration = Duration::from_millis(200);

/// The two faces as routers.
#[derive(Clone)]
pub struct Faces {
    /// For `content-type: application/grpc`.
    pub grpc: Router,
    /// For everything else.
    pub http: Router,
    /// Before both.
    pub guard: Guard,
}

/// Serves both faces until `leave` is cancelled, then lets every request in flight end, for `server.drain_timeout_ms` at most.
pub async fn serve(listener: impl Listener, faces: Faces, config: Arc<Config>, leave: CancellationToken) {
    let (tracker, hard_end) = (TaskTracker::new(), CancellationToken::new());
    let (places, held) = (Places::new(&config.server), Held::new(&config.server));
    loop {
        let accepted = tokio::select! {
            () = leave.cancelled() => break,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok((stream, peer)) => match places.take(peer.ip()) {
                Some(place) => {
                    let activity = held.begin(place.address(), Instant::now());
                    let (place, client) = ((place, tracker.token()), activity.number);
                    let (leave, hard_end) = (leave.clone(), hard_end.clone());
                    let gate = Gate::new(place, client, leave, hard_end);
                    tokio::spawn(connection(stream, faces.clone(), config.clone(), gate, activity));
                }
                None => turn_away(stream),
            },
            Err(error) => {
                tracing::warn!(%error, "accept failed");
                sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    drop(listener);
    tracker.close();
    if timeout(Duration::from_millis(config.server.drain_timeout_ms), tracker.wait()).await.is_err() {
        tracing::warn!(connections = tracker.len(), "drain timeout: connections are cut");
        hard_end.cancel();
        let _cut = timeout(HARD_END_PATIENCE, tracker.wait()).await;
    }
}

/// One connection too many: REST clients understand the answer, gRPC clients see UNAVAILABLE.
fn turn_away(mut stream: impl Stream) {
    metrics::counter!("ada_connections_refused_total").increment(1);
    let full = Problem::new(StatusCode::SERVICE_UNAVAILABLE, "CONNECTIONS_FULL", "there is no place for another connection");
    let answer = full.after(RETRY_AFTER_FULL_MS).into_http1();
    let tell = async move {
        stream.write_all(&answer).await?;
        stream.shutdown().await?;
        // Closing on a request that is not read would cost the peer the answer.
        copy(&mut stream, &mut sink()).await
    };
    tokio::spawn(timeout(ACCEPT_PAUSE, tell));
}

async fn connection(mut stream: impl Stream, faces: Faces, config: Arc<Config>, gate: Gate, activity: Arc<Activity>) {
    metrics::gauge!("ada_connections").increment(1.0);
    let patience = Duration::from_millis(config.connection.preface_timeout_ms);
    let greeted = tokio::select! {
        greeted = timeout(patience, has_spoken(&mut stream)) => greeted,
        () = gate.leave().cancelled() => Ok(false),
    };
    match greeted {
        Ok(true) => gate.until_hard_end(talk(stream, faces, &config, &gate, &activity)).await,
        Ok(false) => {}
        Err(_) => metrics::counter!("ada_connections_timed_out_total").increment(1),
    }
    metrics::gauge!("ada_connections").decrement(1.0);
}

/// Waits until the first bytes decide between HTTP/1 and HTTP/2; false if the peer leaves before. The stock builder would wait for them for ever.
async fn has_spoken(stream: &mut impl Stream) -> bool {
    let mut seen = [0; PREFACE.len()];
    loop {
        match stream.peek(&mut seen).await {
            Ok(0) | Err(_) => return false,
            Ok(len) if len < PREFACE.len() && PREFACE.starts_with(&seen[..len]) => sleep(Duration::from_millis(5)).await,
            Ok(_) => return true,
        }
    }
}

async fn talk(stream: impl Stream, faces: Faces, config: &Config, gate: &Gate, activity: &Arc<Activity>) {
    if let Err(error) = stream.send_at_once() {
        tracing::debug!(%error, "no TCP_NODELAY");
    }
    let ms = Duration::from_millis;
    let patience = Patience { body: ms(config.connection.body_read_timeout_ms), write: ms(config.connection.write_timeout_ms) };
    let answer = service_fn(|request| answer(request, faces.clone(), gate.clone(), activity.clone(), patience));
    let builder = builder(config);
    let wire = Wire::new(stream, gate.clone(), Bounds::new(config));
    let mut connection = pin!(builder.serve_connection_with_upgrades(TokioIo::new(wire), answer));
    let (mut looks, mut is_leaving, mut is_old) = (interval(look_interval(config)), false, false);
    let mut of_age = pin!(sleep(age_max(&config.connection, activity.number)));
    let [idle_max, leave_max] = [config.connection.idle_timeout_ms, config.connection.keepalive_timeout_ms].map(Duration::from_millis);
    let ended = loop {
        tokio::select! {
            ended = connection.as_mut() => break ended,
            () = gate.leave().cancelled(), if !is_leaving => {
                is_leaving = true;
                connection.as_mut().graceful_shutdown();
            }
            () = of_age.as_mut(), if !is_leaving && !is_old => {
                is_old = true;
                // To close between two requests is to cross the next one on its way, which HTTP/1 clients take for a lost answer.
                if gate.speaks_http1() {
                    gate.ages();
                } else {
                    is_leaving = true;
                    connection.as_mut().graceful_shutdown();
                }
            }
            () = activity.cut.cancelled() => break Ok(()),
            // One that was asked to leave and has nothing in hand need not stay for as long as others.
            _ = looks.tick() => match activity.verdict(if is_leaving { leave_max } else { idle_max }, Instant::now()) {
                Verdict::Leave if !is_leaving => {
                    is_leaving = true;
                    metrics::counter!("ada_connections_timed_out_total").increment(1);
                    connection.as_mut().graceful_shutdown();
                }
                // One that was asked and does not go holds its place for nothing.
                Verdict::Leave if !gate.leave().is_cancelled() => break Ok(()),
                Verdict::Cut => {
                    metrics::counter!("ada_connections_timed_out_total").increment(1);
                    break Ok(());
                }
                Verdict::Leave | Verdict::Stay => {}
            },
        }
    };
    if let Err(error) = ended {
        if is_late(&*error) {
            metrics::counter!("ada_connections_timed_out_total").increment(1);
        }
        tracing::debug!(%error, "connection ended");
    }
}

/// How old a connection may be: those that began together do not leave together.
fn age_max(config: &ConnectionConfig, number: u64) -> Duration {
    let scattered = number.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    Duration::from_millis(config.age_max_ms).mul_f64(0.9 + 0.2 * scattered as f64 / f64::from(u32::MAX))
}

/// Whether a piece of an answer was not taken in time.
fn is_late(error: &(dyn Error + 'static)) -> bool {
    let is_cause = error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == io::ErrorKind::TimedOut);
    is_cause || error.source().is_some_and(is_late)
}

/// How long the server waits for a client.
#[derive(Clone, Copy)]
struct Patience {
    /// For a gRPC request, or a message of a stream, to be complete.
    body: Duration,
    /// For an answer to be taken: for each piece that the system does not take at once, and for all of it from its head on.
    write: Duration,
}

fn builder(config: &Config) -> auto::Builder<TokioExecutor> {
    let config = &config.connection;
    let mut builder = auto::Builder::new(TokioExecutor::new());
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_millis(config.header_read_timeout_ms))
        .max_headers(config.headers_max)
        .max_buf_size(config.header_bytes_max as usize);
    builder
        .http2()
        .timer(TokioTimer::new())
        .max_concurrent_streams(config.streams_max)
        .max_pending_accept_reset_streams(config.pending_resets_max)
        .max_header_list_size(config.header_bytes_max)
        .initial_stream_window_size(HTTP2_WINDOW)
        .initial_connection_window_size(HTTP2_WINDOW)
        .max_send_buf_size(HTTP2_SEND_BUFFER)
        .keep_alive_interval(Duration::from_millis(config.keepalive_interval_ms))
        .keep_alive_timeout(Duration::from_millis(config.keepalive_timeout_ms));
    builder
}

/// One request of either face: its id, its log span, its metrics, and a last net for panics.
async fn answer(
    request: Request<Incoming>,
    faces: Faces,
    gate: Gate,
    activity: Arc<Activity>,
    patience: Patience,
) -> Result<Response<Body>, Infallible> {
    let open = activity.open();
    let begin = Instant::now();
    let is_grpc = grpc::is_grpc(request.headers());
    let (face, router) = if is_grpc { ("grpc", faces.grpc) } else { ("http", faces.http) };
    let (id, path) = (request_id(&request), request.uri().path().to_owned());
    let span = tracing::info_span!("request", %id, face, method = %request.method());
    let is_stream = is_grpc && grpc::is_stream(&path);
    let is_http1 = request.version() < Version::HTTP_2;
    gate.speaks(is_http1);
    let leave = (is_grpc && endless::is_endless(&path)).then(|| gate.leave().clone());
    let kind = match (is_grpc, is_stream) {
        (true, true) => Kind::Messages,
        (true, false) => Kind::Message,
        (false, _) => Kind::Plain,
    };
    let mut request = request.map(|body| {
        let body = if is_http1 { Body::new(Watched::new(body, gate.clone())) } else { Body::new(body) };
        Body::new(Asked::new(body, kind, patience.body, open.clone()))
    });
    if let Some(leave) = &leave {
        request = request.map(|body| endless::requests(body, leave));
    }
    request.extensions_mut().insert(gate.clone());
    let refused = faces.guard.refuses(&request);
    let work = async move {
        match refused {
            Some(problem) => Ok(problem.into_response()),
            None => router.oneshot(request).await,
        }
    };
    let work = AssertUnwindSafe(work.instrument(span.clone())).catch_unwind();
    let mut response = match work.await {
        Ok(Ok(response)) => response,
        Ok(Err(never)) => match never {},
        Err(_) => span.in_scope(|| {
            tracing::error!("a handler panicked");
            Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "INTERNAL", "internal error").into_response()
        }),
    };
    let route = route(&response, is_grpc, path);
    let status = response.status().as_u16().to_string();
    span.in_scope(|| tracing::debug!(route, status, us = begin.elapsed().as_micros() as u64, "answered"));
    metrics::counter!("ada_http_requests_total", "face" => face, "route" => route, "status" => status).increment(1);
    metrics::histogram!("ada_http_request_duration_seconds", "face" => face).record(begin.elapsed().as_secs_f64());
    if let Ok(id) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    let is_last = gate.is_old() && response.status() != StatusCode::SWITCHING_PROTOCOLS;
    if is_http1 && (is_last || gate.lingers() && response.status() == StatusCode::PAYLOAD_TOO_LARGE) {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    if let Some(leave) = &leave {
        response = response.map(|body| endless::answers(body, leave));
    }
    let until = (!is_stream).then(|| Instant::now() + patience.write);
    let untold = response.extensions_mut().remove::<Arc<Untold>>();
    Ok(response.map(|body| Body::new(Given::new(body, until, open, untold))))
}

/// The route as a label: never a path that a client made up.
fn route(response: &Response<Body>, is_grpc: bool, path: String) -> String {
    const UNIMPLEMENTED: &str = "12";
    let unknown = || "unknown".to_owned();
    if is_grpc {
        let known = response.headers().get("grpc-status").is_none_or(|status| status != UNIMPLEMENTED);
        return if known { path } else { unknown() };
    }
    response.extensions().get::<MatchedPath>().map_or_else(unknown, |route| route.as_str().to_owned())
}

/// The client's `x-request-id` if it is a plain one, else a new one.
fn request_id(request: &Request<Incoming>) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    let given = request.headers().get(REQUEST_ID).and_then(|id| id.to_str().ok());
    let given = given.filter(|id| (1..=64).contains(&id.len()) && id.chars().all(plain));
    given.map_or_else(|| Uuid::new_v4().to_string(), str::to_owned)
}
