//! Streams without an end of their own: a health watch and reflection. Whoever watches a server's health never hangs up, so one such stream made
//! every drain as long as `server.drain_timeout_ms`: here they end when connections are asked to leave, after all that they had to say.

use axum::{
    body::{Body, Bytes, HttpBody},
    http::{HeaderMap, HeaderValue},
};
use hyper::body::Frame;
use std::{
    pin::Pin,
    task::{Context, Poll},
};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

/// Whether a method of this face goes on for as long as its client likes, and has nothing to lose.
pub fn is_endless(path: &str) -> bool {
    ["/Watch", "/ServerReflectionInfo"].iter().any(|method| path.ends_with(method))
}

/// The requests of such a stream, until it is time to leave.
pub fn requests(body: Body, leave: &CancellationToken) -> Body {
    Body::new(UntilLeave { body, leave: Box::pin(leave.clone().cancelled_owned()), farewell: None, ended: false })
}

/// Its answers, until then: what is known by then is told (NOT_SERVING), and the rest is UNAVAILABLE, which clients take for "elsewhere, or later".
pub fn answers(body: Body, leave: &CancellationToken) -> Body {
    const UNAVAILABLE: HeaderValue = HeaderValue::from_static("14");
    let mut farewell = HeaderMap::new();
    farewell.insert("grpc-status", UNAVAILABLE);
    farewell.insert("grpc-message", HeaderValue::from_static("the server is shutting down"));
    Body::new(UntilLeave { body, leave: Box::pin(leave.clone().cancelled_owned()), farewell: Some(farewell), ended: false })
}

struct UntilLeave {
    body: Body,
    leave: Pin<Box<WaitForCancellationFutureOwned>>,
    farewell: Option<HeaderMap>,
    ended: bool,
}

impl HttpBody for UntilLeave {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if self.ended {
            return Poll::Ready(None);
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        // A stream may end by itself in the same moment, since what it watches ends too: the farewell is the same then.
        let says_more = matches!(&frame, Poll::Ready(Some(Ok(frame))) if frame.is_data());
        if !says_more && self.leave.as_mut().poll(context).is_ready() {
            self.ended = true;
            // What it holds (a task of reflection waits for the next question) is let go.
            self.body = Body::empty();
            return Poll::Ready(self.farewell.take().map(|trailers| Ok(Frame::trailers(trailers))));
        }
        frame
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::poll_fn;

    /// What a health watch looks at may end in the moment in which it is time to leave: its stream then ended with OK, as if all were well.
    #[tokio::test]
    async fn a_stream_that_ends_while_leaving_says_farewell() {
        let leave = CancellationToken::new();
        leave.cancel();
        let mut leaving = answers(Body::empty(), &leave);
        let frame = poll_fn(|context| Pin::new(&mut leaving).poll_frame(context)).await.unwrap().unwrap();
        assert_eq!(frame.trailers_ref().unwrap()["grpc-status"], "14");
        assert!(poll_fn(|context| Pin::new(&mut leaving).poll_frame(context)).await.is_none());
        // What it still has to say comes first, and at any other time its end is its own.
        let mut talking = answers(Body::from("NOT_SERVING"), &leave);
        assert!(poll_fn(|context| Pin::new(&mut talking).poll_frame(context)).await.unwrap().unwrap().is_data());
        let mut staying = answers(Body::empty(), &CancellationToken::new());
        assert!(poll_fn(|context| Pin::new(&mut staying).poll_frame(context)).await.is_none());
    }
}
