//! A connection as the library that speaks HTTP sees it, for two things that it does not do.
//!
//! What is no request it answers by itself, with a bare status: here that becomes a problem like all others. (HTTP/1 alone; of a head that is too
//! large HTTP/2 tells its status and nothing else.) And when it closes while the peer is still sending, the system cuts the connection, and the
//! peer may lose the answer that says why: so what still comes is read and dropped, for a while.

use crate::serve::{config::Config, error::ServiceError, gate::Gate, http::Problem, net::Stream};
use axum::{
    body::{Bytes, HttpBody},
    http::StatusCode,
};
use hyper::body::{Frame, Incoming, SizeHint};
use std::{
    io,
    pin::Pin,
    task::{Context, Poll, ready},
    time::Duration,
};
use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf},
    runtime::Handle,
    time::timeout,
};
use tokio_io_timeout::TimeoutStream;

/// Of a peer that is told to send less so many times the bytes of the largest message are read and dropped.
const DROPPED_MESSAGES: usize = 16;
/// A peer that sends nothing for so long has heard the answer, or does not want it.
const SILENCE_MAX: Duration = Duration::from_secs(1);
/// Names every answer of ours, and none of the library's.
const OURS: &[u8] = b"x-request-id";

/// See the module.
pub struct Wire<S: Stream> {
    /// None once it is dropped.
    stream: Option<Pin<Box<TimeoutStream<S>>>>,
    /// What is being written in the place of a bare answer.
    instead: Vec<u8>,
    has_ended: bool,
    bounds: Bounds,
    gate: Gate,
}

/// What a connection may cost beyond its end, and what its heads may hold.
#[derive(Clone, Copy)]
pub struct Bounds {
    linger: Duration,
    dropped_bytes_max: usize,
    header_bytes_max: u32,
    headers_max: usize,
    write: Duration,
}

impl Bounds {
    /// As the settings have them.
    pub fn new(config: &Config) -> Self {
        let connection = &config.connection;
        Self {
            linger: Duration::from_millis(connection.body_read_timeout_ms),
            dropped_bytes_max: config.limits.message_bytes_max.saturating_mul(DROPPED_MESSAGES),
            header_bytes_max: connection.header_bytes_max,
            headers_max: connection.headers_max,
            write: Duration::from_millis(connection.write_timeout_ms),
        }
    }
}

impl<S: Stream> Wire<S> {
    /// Of this connection.
    pub fn new(stream: S, gate: Gate, bounds: Bounds) -> Self {
        let mut stream = TimeoutStream::new(stream);
        stream.set_write_timeout(Some(bounds.write));
        Self { stream: Some(Box::pin(stream)), instead: Vec::new(), has_ended: false, bounds, gate }
    }

    fn stream(&mut self) -> Pin<&mut TimeoutStream<S>> {
        self.stream.as_mut().expect("it is there until it is dropped, or it is a bug").as_mut()
    }

    fn problem(&self, status: StatusCode) -> Problem {
        let Bounds { headers_max, header_bytes_max, .. } = self.bounds;
        let too_large = |detail: &str| {
            metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
            Problem::new(status, "TOO_LARGE", detail)
        };
        match status {
            StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE => {
                too_large(&format!("the head has more than {headers_max} headers, or exceeds {header_bytes_max} bytes"))
            }
            StatusCode::URI_TOO_LONG => too_large("the path is too long"),
            _ => ServiceError::invalid("head", "is not that of a request of HTTP/1.1").into(),
        }
    }
}

/// The status of an answer that is the library's own.
fn bare_status(bytes: &[u8]) -> Option<StatusCode> {
    let status = bytes.strip_prefix(b"HTTP/1.1 ")?.get(..3)?;
    let is_bare = status.starts_with(b"4") && bytes.ends_with(b"\r\n\r\n") && !bytes.windows(OURS.len()).any(|part| part == OURS);
    if is_bare { StatusCode::from_bytes(status).ok() } else { None }
}

impl<S: Stream> AsyncRead for Wire<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let (before, has_room) = (buffer.filled().len(), buffer.remaining() > 0);
        ready!(self.stream().poll_read(cx, buffer))?;
        self.has_ended |= has_room && buffer.filled().len() == before;
        Poll::Ready(Ok(()))
    }
}

impl<S: Stream> AsyncWrite for Wire<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if self.instead.is_empty() {
            let Some(status) = bare_status(bytes) else { return self.stream().poll_write(cx, bytes) };
            self.instead = self.problem(status).into_http1();
            self.gate.linger();
        }
        while !self.instead.is_empty() {
            let Self { stream: Some(stream), instead, .. } = &mut *self else { break };
            match ready!(stream.as_mut().poll_write(cx, instead))? {
                0 => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                written => drop(instead.drain(..written)),
            }
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_write_vectored(mut self: Pin<&mut Self>, cx: &mut Context<'_>, parts: &[io::IoSlice<'_>]) -> Poll<io::Result<usize>> {
        match parts.split_first() {
            Some((head, rest)) if rest.iter().all(|part| part.is_empty()) && bare_status(head).is_some() => self.poll_write(cx, head),
            _ => self.stream().poll_write_vectored(cx, parts),
        }
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.as_ref().is_some_and(|stream| stream.is_write_vectored())
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream().poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream().poll_shutdown(cx)
    }
}

impl<S: Stream> Drop for Wire<S> {
    fn drop(&mut self) {
        let (Some(stream), false, true) = (self.stream.take(), self.has_ended, self.gate.lingers()) else { return };
        // Without a runtime the process ends, and all connections with it.
        if let Ok(runtime) = Handle::try_current() {
            runtime.spawn(linger(stream, self.gate.clone(), self.bounds));
        }
    }
}

/// Reads and drops what a peer still sends, so that it can read the answer; meanwhile the connection keeps its place.
async fn linger(mut stream: Pin<Box<TimeoutStream<impl Stream>>>, gate: Gate, bounds: Bounds) {
    let drop_all = async {
        let (mut dropped, mut left) = ([0; 16_384], bounds.dropped_bytes_max);
        let _gone = tokio::io::AsyncWriteExt::shutdown(&mut stream).await;
        while let Ok(Ok(len @ 1..)) = timeout(SILENCE_MAX, stream.read(&mut dropped)).await {
            left = left.saturating_sub(len);
            if left == 0 {
                return;
            }
        }
    };
    let _over = gate.until_hard_end(async { drop(timeout(bounds.linger, drop_all).await) }).await;
}

/// The body of a request of HTTP/1: if nobody reads it to its end, the connection closes while it comes.
pub struct Watched {
    body: Incoming,
    has_ended: bool,
    gate: Gate,
}

impl Watched {
    /// Of a request on this connection.
    pub fn new(body: Incoming, gate: Gate) -> Self {
        Self { body, has_ended: false, gate }
    }
}

impl HttpBody for Watched {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(cx));
        self.has_ended |= frame.is_none();
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        if !self.has_ended && !self.body.is_end_stream() {
            self.gate.linger();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_ours_is_known() {
        let bare = "HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\ncontent-length: 0\r\n\r\n";
        assert_eq!(bare_status(bare.as_bytes()), Some(StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE));
        let ours = bare.replace("connection: close", "x-request-id: 7");
        let good = bare.replace("431", "204");
        for other in [ours.as_str(), &good, &bare[..20], "HTTP/1.1 4", "", "\r\n\r\n"] {
            assert_eq!(bare_status(other.as_bytes()), None, "{other}");
        }
    }
}
