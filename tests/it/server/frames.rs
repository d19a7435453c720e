//! HTTP/2 by hand, for what no library's client would do.

use super::*;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const ACK: u8 = 1;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const INITIAL_WINDOW_SIZE: u16 = 4;
const CANCEL: u32 = 8;

/// A connection that says what it is told to, and listens to nobody.
pub struct Raw {
    pub socket: TcpStream,
    stream: u32,
}

impl Raw {
    /// A connection whose streams take so many bytes of their answers.
    pub async fn connect(address: SocketAddr, window: u32) -> Self {
        let mut socket = TcpStream::connect(address).await.unwrap();
        socket.set_nodelay(true).unwrap();
        let setting: Vec<u8> = INITIAL_WINDOW_SIZE.to_be_bytes().into_iter().chain(window.to_be_bytes()).collect();
        let hello = [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(), frame(SETTINGS, 0, 0, &setting), frame(SETTINGS, ACK, 0, &[])];
        socket.write_all(&hello.concat()).await.unwrap();
        Self { socket, stream: 1 }
    }

    /// A call of this method with this message, and then, if so wanted, its end by the client, all at once.
    pub fn call(&mut self, method: &str, message: &[u8], is_reset: bool) -> Vec<u8> {
        let stream = self.stream;
        self.stream += 2;
        let body = [&[0], &u32::try_from(message.len()).unwrap().to_be_bytes()[..], message].concat();
        let end = if is_reset { frame(RST_STREAM, 0, stream, &CANCEL.to_be_bytes()) } else { Vec::new() };
        let head = frame(HEADERS, END_HEADERS, stream, &headers(&format!("/ada_diffuser.v1.Agent/{method}")));
        [head, frame(DATA, END_STREAM, stream, &body), end].concat()
    }

    /// Sends; whether the server has closed the connection is not the question here.
    pub async fn send(&mut self, frames: &[u8]) {
        let _closed = self.socket.write_all(frames).await;
    }

    /// Reads until the server closes.
    pub async fn ended(mut self) {
        let mut ignored = vec![0; 1 << 16];
        while self.socket.read(&mut ignored).await.is_ok_and(|len| len > 0) {}
    }
}

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let len = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&len[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// HPACK without Huffman codes and without the dynamic table (RFC 7541, appendix A has the numbers).
fn headers(path: &str) -> Vec<u8> {
    const POST: u8 = 0x83;
    const HTTP: u8 = 0x86;
    let text = |name: &[u8], value: &str| [name, &[u8::try_from(value.len()).unwrap()], value.as_bytes()].concat();
    let (named_path, named_authority, named_content_type) = ([0x04], [0x01], [0x0f, 0x10]);
    let te = [&[0, 2][..], b"te"].concat();
    let parts = [
        vec![POST, HTTP],
        text(&named_path, path),
        text(&named_authority, "localhost"),
        text(&named_content_type, "application/grpc"),
        text(&te, "trailers"),
    ];
    parts.concat()
}
