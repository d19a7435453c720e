//! Bodies on their way in and out, counted as they are held.

use super::activity::{Hold, Open};
use crate::serve::{grpc, session::Untold};
use axum::body::{Body, Bytes, HttpBody};
use futures_util::FutureExt;
use http_body_util::BodyExt;
use hyper::body::{Frame, SizeHint};
use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};
use tokio::time::{Instant, Sleep, sleep};

type Polled = Poll<Option<Result<Frame<Bytes>, axum::Error>>>;

/// What a body on its way in is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One request, of REST: who reads it bounds the time.
    Plain,
    /// One request, of gRPC: it must be there in time.
    Message,
    /// Any number of messages: each must be whole in time once it has begun.
    Messages,
}

/// A request's body: counted while it is held, and not waited for in vain.
pub struct Asked {
    body: Body,
    kind: Kind,
    patience: Duration,
    late: Option<Pin<Box<Sleep>>>,
    message: Message,
    hold: Hold,
}

impl Asked {
    /// Of this request.
    pub fn new(body: Body, kind: Kind, patience: Duration, open: Arc<Open>) -> Self {
        let late = (kind == Kind::Message).then(|| Box::pin(sleep(patience)));
        Self { body, kind, patience, late, message: Message::default(), hold: Hold::new(open, 0) }
    }

    fn count(&mut self, piece: &[u8]) {
        if self.kind != Kind::Messages {
            return self.hold.set(self.hold.bytes() + piece.len());
        }
        // Whole messages have been handed on by the time that the next piece is asked for.
        let was_whole = self.message.held == 0;
        let completes = self.message.feed(piece);
        self.hold.set(self.message.held);
        if self.message.held == 0 {
            self.late = None;
        } else if was_whole || completes {
            self.late = Some(Box::pin(sleep(self.patience)));
        }
    }
}

impl HttpBody for Asked {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Polled {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(piece) = frame.data_ref() {
                    self.count(piece);
                }
            }
            Poll::Ready(_) => self.late = None,
            Poll::Pending if self.late.as_mut().is_some_and(|late| late.as_mut().poll(context).is_ready()) => {
                self.late = None;
                return Poll::Ready(Some(Err(axum::Error::new(grpc::late()))));
            }
            Poll::Pending => {}
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// How much of a gRPC message is there: five bytes that tell its length, and then so many.
#[derive(Default)]
struct Message {
    head: [u8; Self::HEAD_LEN],
    head_len: usize,
    missing: usize,
    /// Bytes of the message that is not whole.
    held: usize,
}

impl Message {
    const HEAD_LEN: usize = 5;

    /// Takes the next bytes; says whether a message was completed.
    fn feed(&mut self, mut piece: &[u8]) -> bool {
        let mut completes = false;
        while !piece.is_empty() {
            let in_head = self.head_len < Self::HEAD_LEN;
            let len = if in_head { Self::HEAD_LEN - self.head_len } else { self.missing }.min(piece.len());
            let (taken, rest) = piece.split_at(len);
            piece = rest;
            self.held += len;
            if in_head {
                self.head[self.head_len..][..len].copy_from_slice(taken);
                self.head_len += len;
                let [_compressed, a, b, c, d] = self.head;
                self.missing = u32::from_be_bytes([a, b, c, d]) as usize;
            } else {
                self.missing -= len;
            }
            if self.head_len == Self::HEAD_LEN && self.missing == 0 {
                *self = Self::default();
                completes = true;
            }
        }
        completes
    }
}

/// An answer's body: its request is open, and its bytes are counted, until the last of them has left. What is made of it at once is made at
/// once, so that bytes are held and not the messages that they are made of.
pub struct Given {
    body: Body,
    first: Option<Result<Frame<Bytes>, axum::Error>>,
    open: Arc<Open>,
    untold: Option<Arc<Untold>>,
}

impl Given {
    /// An answer that must be taken until then; a stream has its time.
    pub fn new(mut body: Body, until: Option<Instant>, open: Arc<Open>, untold: Option<Arc<Untold>>) -> Self {
        let first = if until.is_some() && !body.is_end_stream() { body.frame().now_or_never().flatten() } else { None };
        open.must_be_taken(until);
        let mut given = Self { body, first: None, open, untold };
        given.first = first.map(|first| first.map(|frame| given.counted(frame)));
        given
    }

    fn counted(&self, frame: Frame<Bytes>) -> Frame<Bytes> {
        match frame.into_data() {
            Ok(bytes) => Frame::data(Bytes::from_owner(Piece { _hold: Hold::new(self.open.clone(), bytes.len()), bytes })),
            Err(other) => other,
        }
    }
}

impl HttpBody for Given {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Polled {
        let frame = match self.first.take() {
            Some(first) => Some(first),
            None => ready!(Pin::new(&mut self.body).poll_frame(context)).map(|frame| frame.map(|frame| self.counted(frame))),
        };
        let is_last = match &frame {
            Some(Ok(frame)) => frame.is_trailers() || self.body.is_end_stream(),
            Some(Err(_)) => false,
            None => true,
        };
        if is_last && let Some(untold) = self.untold.take() {
            untold.tell();
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.first.is_none() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let first = self.first.as_ref().and_then(|first| first.as_ref().ok()?.data_ref()).map_or(0, |bytes| bytes.len() as u64);
        let rest = self.body.size_hint();
        let mut hint = SizeHint::new();
        hint.set_lower(rest.lower() + first);
        if let Some(upper) = rest.upper() {
            hint.set_upper(upper + first);
        }
        hint
    }
}

/// A piece of an answer on its way to the socket.
struct Piece {
    bytes: Bytes,
    _hold: Hold,
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// However the bytes are cut, what is held is what the unfinished message has.
    #[test]
    fn messages_are_counted_however_they_come() {
        let stream: Vec<u8> = [3_u8, 0, 300_u16.to_be_bytes()[1]]
            .into_iter()
            .flat_map(|len| [0, 0, 0, 0, len].into_iter().chain(std::iter::repeat_n(7, len.into())))
            .collect();
        for cut in 0..=stream.len() {
            let mut message = Message::default();
            message.feed(&stream[..cut]);
            let whole = [0, 8, 13, stream.len()].into_iter().filter(|end| *end <= cut).max().unwrap();
            assert_eq!(message.held, cut - whole, "{cut}");
            message.feed(&stream[cut..]);
            assert_eq!(message.held, 0, "{cut}");
        }
    }
}
