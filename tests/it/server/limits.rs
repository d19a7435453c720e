//! Bounds of connections, and that the I/O threads stay free while the engine works.

use super::*;
use std::time::Instant;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

async fn answer_of(stream: &mut TcpStream) -> String {
    let mut text = Vec::new();
    let _reset_counts_as_end =
        timeout(Duration::from_secs(30), stream.read_to_end(&mut text)).await.expect("the server keeps the connection");
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

/// An answer in the text of HTTP/1.1.
fn reply_of(answer: &str) -> Reply {
    let (head, text) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("{answer:?}"));
    let mut lines = head.lines();
    let status = lines.next().unwrap()["HTTP/1.1 ".len()..][..3].parse().unwrap();
    let pairs = lines.map(|line| line.split_once(": ").unwrap());
    let headers = pairs.map(|(name, value)| (name.parse::<hyper::header::HeaderName>().unwrap(), value.parse().unwrap())).collect();
    Reply { status, headers, text: text.to_owned() }
}

/// The answer to bytes that were all taken, and the end of the connection.
async fn answer_to(server: &Running, request: &[u8]) -> Reply {
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    stream.write_all(request).await.expect("the server hangs up while it is spoken to");
    let mut text = String::new();
    timeout(Duration::from_secs(5), stream.read_to_string(&mut text)).await.expect("it keeps the connection").expect("it is cut");
    reply_of(&text)
}

/// The number of headers and their bytes are bounded. The answer had no body, and what came behind the bound cut it off.
#[tokio::test(flavor = "multi_thread")]
async fn headers_are_bounded() {
    let server = start(|_| {}).await;
    for (count, len) in [(100, 1), (1, 40_000), (4, 400_000)] {
        let headers: String = (0..count).map(|i| format!("x-{i}: {}\r\n", "y".repeat(len))).collect();
        let reply = answer_to(&server, format!("GET /readyz HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n").as_bytes()).await;
        assert_eq!((reply.status, reply.reason().as_str()), (431, "TOO_LARGE"), "{count} headers of {len}");
    }
    let path = "y".repeat(70_000);
    let reply = answer_to(&server, format!("GET /{path} HTTP/1.1\r\nhost: localhost\r\n\r\n").as_bytes()).await;
    assert!([414, 431].contains(&reply.status) && reply.reason() == "TOO_LARGE", "{reply:?}");
    assert_eq!(server.get("/readyz").await.status, 200);
}

/// What is no HTTP was answered with a bare status, and broken chunks with TOO_LARGE.
#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_http_is_told_so() {
    let server = start(|_| {}).await;
    for head in ["G@T / HTTP/1.1", "GET / HTTP/1.7", "GET /a b HTTP/1.1", "GET / HTTP/1.1\r\nno header"] {
        let reply = answer_to(&server, format!("{head}\r\nhost: localhost\r\n\r\n").as_bytes()).await;
        assert_eq!(
            (reply.status, reply.reason().as_str(), reply.json()["field"].as_str()),
            (400, "REQUEST_INVALID", Some("head")),
            "{head}"
        );
    }
    let head = "POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json";
    for body in ["transfer-encoding: chunked\r\n\r\nzz\r\n{}\r\n0\r\n\r\n", "transfer-encoding: chunked\r\n\r\n1\r\n{}0\r\n\r\n"] {
        let reply = answer_to(&server, format!("{head}\r\n{body}").as_bytes()).await;
        assert_eq!(
            (reply.status, reply.reason().as_str(), reply.json()["field"].as_str()),
            (400, "REQUEST_INVALID", Some("body")),
            "{body}"
        );
    }
}

/// The server answered 413 and hung up on a client that was still sending: the system cut the connection, and the answer was lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_body_that_is_too_large_is_heard_out() {
    let server = start(|_| {}).await;
    let body = "0".repeat(12 << 20);
    for framing in [
        format!("content-length: {}\r\n\r\n{body}", body.len()),
        format!("transfer-encoding: chunked\r\n\r\nc00000\r\n{body}\r\n0\r\n\r\n"),
    ] {
        let head = "POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n";
        let reply = answer_to(&server, format!("{head}{framing}").as_bytes()).await;
        assert_eq!((reply.status, reply.reason().as_str(), reply.headers["connection"].as_bytes()), (413, "TOO_LARGE", &b"close"[..]));
    }
    // Whoever asks first need not send it.
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    let head = "POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\nexpect: 100-continue\r\ncontent-length:";
    stream.write_all(format!("{head} 9999999\r\n\r\n").as_bytes()).await.unwrap();
    assert_eq!(reply_of(&answer_of(&mut stream).await).reason(), "TOO_LARGE");
}

/// It is heard out to a bound in bytes and in time: what is more is cut.
#[tokio::test(flavor = "multi_thread")]
async fn nobody_is_heard_for_ever() {
    let server = start(|config| {
        config.limits.message_bytes_max = 2048;
        config.connection.body_read_timeout_ms = 600;
    })
    .await;
    let begun = async || {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let head = "POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 999999999\r\n\r\n";
        stream.write_all(head.as_bytes()).await.unwrap();
        stream
    };
    let mut fast = begun().await;
    let all = async { while fast.write_all(&[b'0'; 65_536]).await.is_ok() {} };
    timeout(Duration::from_secs(5), all).await.expect("it reads for ever");
    let mut slow = begun().await;
    let all = async {
        while slow.write_all(b"0").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(Duration::from_secs(5), all).await.expect("it waits for ever");
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

/// Connections that only answered pings held their places for ever: 4,096 of them locked everyone out. So did streams that said nothing.
#[tokio::test(flavor = "multi_thread")]
async fn idle_connections_leave_and_streams_that_work_stay() {
    let server = start(|config| config.connection.idle_timeout_ms = 300).await;
    let (sender, ended) = http2(server.address).await;
    let (mut silent, mut working) = (server.agent().await, server.agent().await);
    let mut nothing = silent.act_stream(futures_util::stream::pending::<pb::ActRequest>()).await.unwrap().into_inner();
    let slow = server.open(json!({"model": "slow"})).await;
    let acts = futures_util::StreamExt::chain(futures_util::stream::iter([act(&slow, 1, &STATE)]), futures_util::stream::pending());
    let _results = working.act_stream(acts).await.unwrap();
    timeout(Duration::from_secs(5), ended).await.expect("it holds its place").unwrap();
    drop(sender);
    let idle = timeout(Duration::from_secs(5), nothing.message()).await.expect("it holds its place").unwrap_err();
    assert_eq!((idle.code(), idle.message().contains("idle_timeout_ms")), (Code::Unavailable, true), "{idle:?}");
    tokio::time::sleep(Duration::from_millis(600)).await;
    let session = server.get(&format!("/v1/sessions/{slow}")).await.json()["session"].clone();
    assert_eq!(session["busy"], true, "an act in work is not idle");
    let id = server.open(json!({})).await;
    assert_eq!(working.act(act(&id, 1, &STATE)).await.unwrap().into_inner().step, 1, "the stream keeps its connection");
}

/// Whoever asks and does not take the answers makes the server keep them.
#[tokio::test(flavor = "multi_thread")]
async fn answers_that_are_not_taken_cut_the_connection() {
    let server = start(|config| config.connection.write_timeout_ms = 300).await;
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    let some = "GET /openapi.json HTTP/1.1\r\nhost: localhost\r\n\r\n".repeat(100);
    // Until more waits than the sockets on the way hold, and the server gives up.
    let asking = async { while stream.write_all(some.as_bytes()).await.is_ok() {} };
    timeout(Duration::from_secs(20), asking).await.expect("it keeps the answers for ever");
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
    // One that is refused while it writes may be reset before it has read why.
    let mut told = String::new();
    for refused in &mut held[8..] {
        told = answer_of(refused).await;
        if !told.is_empty() {
            break;
        }
    }
    let told = reply_of(&told);
    assert_eq!((told.status, told.reason().as_str(), told.headers["retry-after"].as_bytes()), (503, "CONNECTIONS_FULL", &b"1"[..]));
}
