//! The simulated network as server and clients need it.

use super::life::{Client, Dial};
use ada_diffuser::serve::net::{Listener, Stream};
use futures_util::FutureExt;
use hyper_util::rt::TokioIo;
use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tonic::transport::Endpoint;
use tower::service_fn;
use turmoil::net::{TcpListener, TcpStream};

/// Where the server is.
pub const SERVER: &str = "server";
/// Its port.
pub const PORT: u16 = 50_051;

/// Where its connections come from.
pub struct Port(TcpListener);

/// A connection.
pub struct Link(TcpStream);

impl Port {
    /// Of the server on this host.
    ///
    /// # Errors
    /// If it is taken.
    pub async fn open() -> io::Result<Self> {
        Ok(Self(TcpListener::bind(("0.0.0.0", PORT)).await?))
    }
}

impl Listener for Port {
    type Stream = Link;

    async fn accept(&self) -> io::Result<(Link, SocketAddr)> {
        let (stream, peer) = self.0.accept().await?;
        Ok((Link(stream), peer))
    }
}

impl Stream for Link {
    async fn peek(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.0.peek(bytes).await
    }

    fn send_at_once(&self) -> io::Result<()> {
        self.0.set_nodelay(true)
    }
}

impl AsyncRead for Link {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Link {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_shutdown(cx)
    }
}

/// How clients come to the server.
pub fn dial() -> Dial {
    let connect = || async { io::Result::Ok(TokioIo::new(Link(TcpStream::connect((SERVER, PORT)).await?))) };
    Arc::new(move || {
        let endpoint = Endpoint::from_static("http://server:50051");
        async move { endpoint.connect_with_connector(service_fn(move |_| connect())).await.ok().map(Client::new) }.boxed()
    })
}
