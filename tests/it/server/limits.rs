//! Bounds of connections, and that the I/O threads stay free while the engine works.

use super::*;
use std::time::Instant;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

async fn answer_of(stream: &mut TcpStream) -> String {
    let mut text = Vec::new();
    let _reset_counts_as_end =
        timeout(Duration::from_secs(5), stream.read_to_end(&mut text)).await.expect("the server keeps the connection");
    String::from_utf8_lossy(&text).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_and_slow_connections_are_closed() {
    let server = start(|config| {
        config.connection.preface_timeout_ms = 200;
        config.connection.header_read_timeout_ms = 300;
        config.connection.body_read_timeout_ms = 200;
    })
    .await;
    for said in ["", "PRI", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r", "GET /readyz HTTP/1.1\r\nhost: localhost\r\nslow"] {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(said.as_bytes()).await.unwrap();
        let begin = Instant::now();
        answer_of(&mut stream).await;
        assert!(begin.elapsed() < Duration::from_secs(2), "{said:?} took {:?}", begin.elapsed());
    }
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    stream
        .write_all(b"POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 9\r\n\r\n{")
        .await
        .unwrap();
    assert!(answer_of(&mut stream).await.starts_with("HTTP/1.1 504"), "a body that does not come");
    assert!(server.metric("ada_connections_timed_out_total").await >= 3.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn one_connection_too_many_is_turned_away() {
    let server = start(|config| config.server.connections_max = 2).await;
    let mut held = Vec::new();
    // The connection that saw the server ready may still hold a place at first.
    let until_full = async {
        while held.len() <= 2 {
            let mut stream = TcpStream::connect(server.address).await.unwrap();
            stream.write_all(b"GET ").await.unwrap();
            match timeout(Duration::from_millis(200), answer_of(&mut stream)).await {
                Ok(answer) => {
                    assert!(answer.starts_with("HTTP/1.1 503") || answer.is_empty(), "{answer}");
                    if held.len() == 2 {
                        return;
                    }
                }
                Err(_) => held.push(stream),
            }
        }
    };
    timeout(Duration::from_secs(5), until_full).await.expect("nobody was turned away");
    assert_eq!(held.len(), 2);
    drop(held);
    let until_free = async {
        loop {
            let mut stream = TcpStream::connect(server.address).await.unwrap();
            stream.write_all(b"GET /readyz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await.unwrap();
            if answer_of(&mut stream).await.starts_with("HTTP/1.1 200") {
                break;
            }
        }
    };
    timeout(Duration::from_secs(5), until_free).await.expect("the places were not given back");
}

/// The number of headers and their bytes are bounded.
#[tokio::test(flavor = "multi_thread")]
async fn headers_are_bounded() {
    let server = start(|_| {}).await;
    for (count, len) in [(100, 1), (1, 40_000)] {
        let headers: String = (0..count).map(|i| format!("x-{i}: {}\r\n", "y".repeat(len))).collect();
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let request = format!("GET /readyz HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n");
        // The server may answer and close before it has read everything.
        let _closed_early = stream.write_all(request.as_bytes()).await;
        assert!(!answer_of(&mut stream).await.starts_with("HTTP/1.1 200"), "{count} headers of {len}");
    }
    assert_eq!(server.get("/readyz").await.status, 200);
}

/// A client that cancels a lot is honest: its connection lives on.
#[tokio::test(flavor = "multi_thread")]
async fn many_cancels_do_not_cost_the_connection() {
    let server = start(|_| {}).await;
    let slow = server.open(json!({"model": "slow"})).await;
    let id = server.open(json!({})).await;
    let mut agent = server.agent().await;
    for _ in 0..300 {
        let _cut = timeout(Duration::from_millis(1), agent.act(act(&slow, 1, &STATE))).await;
    }
    assert_eq!(agent.act(act(&id, 1, &STATE)).await.unwrap().into_inner().step, 1);
}

/// While both workers are busy for minutes, everybody else is answered at once.
#[tokio::test(flavor = "multi_thread")]
async fn the_io_threads_stay_free() {
    let server = start(|_| {}).await;
    let mut busy = Vec::new();
    for _ in 0..4 {
        let slow = server.open(json!({"model": "slow"})).await;
        busy.push(server.start_slow(&slow).await);
    }
    let mut worst = Duration::ZERO;
    for _ in 0..50 {
        let begin = Instant::now();
        assert_eq!(server.get("/livez").await.status, 200);
        worst = worst.max(begin.elapsed());
    }
    assert!(worst < Duration::from_millis(500), "{worst:?}");
    assert!(busy.iter().all(|task| !task.is_finished()));
}

/// Every metric is in the catalogue, and acts are conserved.
#[tokio::test(flavor = "multi_thread")]
async fn metrics_are_documented() {
    let server = start(|_| {}).await;
    let id = server.open(json!({})).await;
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
    let text = server.get("/metrics").await.text;
    let catalogue = ada_diffuser::serve::telemetry::CATALOGUE.map(|(name, ..)| name);
    let mut seen = 0;
    for line in text.lines().filter(|line| line.starts_with("# TYPE ")) {
        let name = line.split(' ').nth(2).unwrap();
        assert!(catalogue.contains(&name), "{name} is not in the catalogue");
        seen += 1;
    }
    assert!(seen >= 15, "{text}");
    assert!(text.contains("# HELP ada_acts_total") && text.contains(r#"face="http""#));
    assert!(!text.contains(&id), "no session id is ever a label");
}

/// An HTTP/2 connection, and the end of it.
async fn http2(address: SocketAddr) -> (hyper::client::conn::http2::SendRequest<Body>, JoinHandle<()>) {
    let stream = TcpStream::connect(address).await.unwrap();
    let executor = hyper_util::rt::TokioExecutor::new();
    let (sender, connection) = hyper::client::conn::http2::handshake(executor, TokioIo::new(stream)).await.unwrap();
    // Whether it ends well or badly is not the question here.
    (sender, tokio::spawn(async move { drop(connection.await) }))
}

/// Connections that only answered pings held their places for ever: 4,096 of them locked everyone out.
#[tokio::test(flavor = "multi_thread")]
async fn idle_connections_leave_and_streams_stay() {
    let server = start(|config| config.connection.idle_timeout_ms = 300).await;
    let (sender, ended) = http2(server.address).await;
    let mut agent = server.agent().await;
    let stream = agent.act_stream(futures_util::stream::pending::<pb::ActRequest>()).await.unwrap();
    timeout(Duration::from_secs(5), ended).await.expect("it holds its place").unwrap();
    drop(sender);
    tokio::time::sleep(Duration::from_millis(600)).await;
    let id = server.open(json!({})).await;
    assert_eq!(agent.act(act(&id, 1, &STATE)).await.unwrap().into_inner().step, 1, "the stream keeps its connection");
    drop(stream);
}

/// Whoever asks and does not take the answers makes the server keep them.
#[tokio::test(flavor = "multi_thread")]
async fn answers_that_are_not_taken_cut_the_connection() {
    let server = start(|config| config.connection.write_timeout_ms = 300).await;
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    // More than the sockets on the way hold.
    const ASKED: usize = 2_000;
    let asking = stream.write_all("GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n\r\n".repeat(ASKED).into_bytes().leak());
    let _not_all_is_taken = timeout(Duration::from_secs(2), asking).await;
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let taken = answer_of(&mut stream).await.matches("HTTP/1.1 200").count();
    assert!((1..ASKED).contains(&taken), "{taken}");
    assert!(server.metric("ada_connections_timed_out_total").await >= 1.0);
}

/// A gRPC request whose body stops on the way waited for ever, and one that comes byte by byte did so after that was mended. A message of a
/// stream that has begun must come too; between messages a stream may be silent.
#[tokio::test(flavor = "multi_thread")]
async fn unfinished_grpc_requests_end() {
    use futures_util::{StreamExt, stream};
    let server = start(|config| config.connection.body_read_timeout_ms = 300).await;
    let (sender, _connection) = http2(server.address).await;
    let call = async |method: &str, body: Body| {
        let request = hyper::Request::post(format!("http://{}/ada_diffuser.v1.Agent/{method}", server.address));
        let request = request.header("content-type", "application/grpc").header("te", "trailers").body(body).unwrap();
        let response = timeout(Duration::from_secs(5), sender.clone().send_request(request)).await.expect("it waits for ever").unwrap();
        let (parts, body) = response.into_parts();
        let body = Body::new(body);
        (parts.headers, timeout(Duration::from_secs(5), to_bytes(body, usize::MAX)).await.expect("it waits for ever").unwrap())
    };
    let begun = || stream::iter([Ok::<_, std::io::Error>(vec![0_u8, 0, 0, 0, 99])]);
    let trickle = stream::unfold((), async |()| {
        tokio::time::sleep(Duration::from_millis(50)).await;
        Some((Ok(vec![1]), ()))
    });
    for body in [Body::from_stream(begun().chain(stream::pending())), Body::from_stream(begun().chain(Box::pin(trickle)))] {
        let (headers, _) = call("Act", body).await;
        assert_eq!((&headers["grpc-status"], &headers["ada-reason"]), (&"4".parse().unwrap(), &"DEADLINE_ADMISSION".parse().unwrap()));
    }
    let (_, results) = call("ActStream", Body::from_stream(begun().chain(stream::pending()))).await;
    assert!(String::from_utf8_lossy(&results).contains("DEADLINE_ADMISSION"), "{results:?}");
}

/// One address has its share of the places, and another finds one all the same.
#[tokio::test(flavor = "multi_thread")]
async fn one_address_does_not_take_all_places() {
    let server = start(|config| config.server.connections_per_address_max = 8).await;
    let from = async |address: &str| {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.bind(format!("{address}:0").parse().unwrap()).unwrap();
        let mut stream = socket.connect(server.address).await.unwrap();
        stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n").await.unwrap();
        stream
    };
    let mut held = Vec::new();
    for _ in 0..12 {
        held.push(from("127.0.0.1").await);
    }
    let mut newcomer = from("127.0.0.2").await;
    newcomer.write_all(b"connection: close\r\n\r\n").await.unwrap();
    assert!(answer_of(&mut newcomer).await.starts_with("HTTP/1.1 200"));
    let mut last = held.pop().unwrap();
    assert!(answer_of(&mut last).await.starts_with("HTTP/1.1 503"));
}
