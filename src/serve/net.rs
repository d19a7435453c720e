//! What the server needs of a network: TCP has it, and so has one that is simulated (`examples/simulate`).

use std::{future::Future, io, net::SocketAddr};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::{TcpListener, TcpStream},
};

/// Where connections come from.
pub trait Listener: Send + 'static {
    /// One of them.
    type Stream: Stream;

    /// The next one, and from where it comes.
    ///
    /// # Errors
    /// If there is none for now (too many open files, mostly).
    fn accept(&self) -> impl Future<Output = io::Result<(Self::Stream, SocketAddr)>> + Send;
}

/// A connection.
pub trait Stream: AsyncRead + AsyncWrite + Unpin + Send + 'static {
    /// Waits for bytes and leaves them where they are; says how many it has copied, 0 at the end.
    ///
    /// # Errors
    /// If the peer is gone.
    fn peek(&mut self, bytes: &mut [u8]) -> impl Future<Output = io::Result<usize>> + Send;

    /// Small pieces are sent at once.
    ///
    /// # Errors
    /// If the system does not know how.
    fn send_at_once(&self) -> io::Result<()>;
}

impl Listener for TcpListener {
    type Stream = TcpStream;

    async fn accept(&self) -> io::Result<(TcpStream, SocketAddr)> {
        Self::accept(self).await
    }
}

impl Stream for TcpStream {
    async fn peek(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        Self::peek(self, bytes).await
    }

    fn send_at_once(&self) -> io::Result<()> {
        self.set_nodelay(true)
    }
}
