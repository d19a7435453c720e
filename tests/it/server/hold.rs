//! Clients that take places and memory and give nothing for them, beside an honest one that must not notice.

use super::{frames::Raw, *};
use futures_util::{StreamExt, stream};
use prost::Message;
use std::time::Instant;

/// Opens a session, acts and closes, again and again, until told to stop; how often.
fn honest(server: &Running) -> (CancellationToken, JoinHandle<u32>) {
    let (stop, address) = (CancellationToken::new(), server.address);
    let is_over = stop.clone();
    let work = async move {
        let channel = Channel::from_shared(format!("http://{address}")).unwrap().connect().await.unwrap();
        let (agent, mut rounds) = (AgentClient::new(channel), 0);
        while !is_over.is_cancelled() {
            let open = || {
                let mut agent = agent.clone();
                async move { agent.open_session(pb::OpenSessionRequest::default()).await }
            };
            let id = sent(open).await.expect("an honest open is refused").into_inner().session.unwrap().session_id;
            for step in 1..=3 {
                let act = || {
                    let (mut agent, request) = (agent.clone(), act(&id, step, &STATE));
                    async move { agent.act(request).await }
                };
                sent(act).await.expect("an honest act is refused");
            }
            let close = || {
                let (mut agent, request) = (agent.clone(), pb::CloseSessionRequest { session_id: id.clone() });
                async move { agent.close_session(request).await }
            };
            let closed = sent(close).await;
            // The first of two may have done it.
            assert!(closed.as_ref().err().is_none_or(|status| status.code() == Code::NotFound), "{closed:?}");
            rounds += 1;
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        rounds
    };
    (stop, tokio::spawn(work))
}

/// A call, once more if its connection ended under it, as clients do: this one does not by itself when a connection is asked to leave between
/// two calls.
async fn sent<T, F: Future<Output = Result<T, Status>>>(call: impl Fn() -> F) -> Result<T, Status> {
    match call().await {
        Err(status) if matches!(status.code(), Code::Cancelled | Code::Unavailable | Code::Internal | Code::Unknown) => call().await,
        other => other,
    }
}

/// OpenSession followed by a reset of its stream took all 10,000 places in five seconds: nobody ever knew the ids.
#[tokio::test(flavor = "multi_thread")]
async fn an_open_whose_caller_is_gone_is_undone() {
    let server = start(|config| config.sessions.unused_idle_ms = 600_000).await;
    let (stop, work) = honest(&server);
    const CONNECTIONS: usize = 60;
    const OPENS: usize = 50;
    for _ in 0..CONNECTIONS {
        let mut raw = Raw::connect(server.address, 1 << 16).await;
        let opens: Vec<u8> = (0..OPENS).flat_map(|_| raw.call("OpenSession", &[], true)).collect();
        raw.send(&opens).await;
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    stop.cancel();
    assert!(work.await.unwrap() > 10);
    let left = server.get("/v1/sessions").await.json()["sessions"].as_array().unwrap().len();
    // A reset that comes after the answer was handed on is too late; see the next test.
    assert!(left < 100, "{left} of {} are left", CONNECTIONS * OPENS);
    // One that has a name stays: its client may ask again.
    let mut raw = Raw::connect(server.address, 1 << 16).await;
    let named = pb::OpenSessionRequest { request_id: "mine".into(), seed: Some(5), ..Default::default() };
    let open = raw.call("OpenSession", &named.encode_to_vec(), true);
    raw.send(&open).await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    let again = pb::OpenSessionRequest { request_id: "mine".into(), seed: Some(6), ..Default::default() };
    let again = server.agent().await.open_session(again).await.unwrap().into_inner();
    assert_eq!(again.session.unwrap().seed, 5);
}

/// Whoever opens without end, and takes the answers, or names the requests, takes the places of nobody but its own like.
#[tokio::test(flavor = "multi_thread")]
async fn sessions_that_nobody_asks_for_give_their_places() {
    let server = start(|config| {
        config.sessions.len_max = 1000;
        config.sessions.unused_idle_ms = 50;
    })
    .await;
    let (stop, work) = honest(&server);
    let (mut agent, mut opened) = (server.agent().await, 0);
    while opened < 3000 {
        let request = |i: usize| pb::OpenSessionRequest { request_id: format!("r{i}"), ..Default::default() };
        let opens = (opened..opened + 20).map(|i| {
            let mut agent = agent.clone();
            async move { agent.open_session(request(i)).await.is_ok() }
        });
        let taken = futures_util::future::join_all(opens).await;
        assert!(taken.iter().all(|taken| *taken), "there is always one to give its place");
        opened += 20;
    }
    stop.cancel();
    assert!(work.await.unwrap() > 10);
    let full = pb::ListSessionsRequest { page_size: 1, ..Default::default() };
    assert_eq!(agent.list_sessions(full).await.unwrap().into_inner().sessions.len(), 1);
}

/// A connection of age is asked to leave, and who works on it does not notice.
#[tokio::test(flavor = "multi_thread")]
async fn connections_of_age_leave_unnoticed() {
    let server = start(|config| (config.connection.age_max_ms, config.connection.keepalive_timeout_ms) = (300, 400)).await;
    let (stop, work) = honest(&server);
    let id = server.open(json!({})).await;
    let (questions, answers) = tokio::sync::mpsc::channel(1);
    let mut agent = server.agent().await;
    let stream = agent.act_stream(tokio_stream::wrappers::ReceiverStream::new(answers)).await.unwrap();
    let mut stream = stream.into_inner();
    let mut young = Raw::connect(server.address, 1 << 16).await;
    let call = young.call("GetSession", &pb::GetSessionRequest { session_id: id.clone() }.encode_to_vec(), false);
    young.send(&call).await;
    let begin = Instant::now();
    timeout(Duration::from_secs(5), young.ended()).await.expect("it stays for ever");
    assert!(begin.elapsed() >= Duration::from_millis(250), "{:?}", begin.elapsed());
    tokio::time::sleep(Duration::from_millis(1200)).await;
    questions.send(act(&id, 1, &STATE)).await.unwrap();
    let result = stream.message().await.unwrap().expect("a stream goes on");
    assert!(matches!(result.result, Some(pb::act_result::Result::Response(_))), "{result:?}");
    stop.cancel();
    assert!(work.await.expect("the honest one was disturbed") > 10);
}

/// Over HTTP/1 a connection that closed between two requests crossed the next one: a client that does not send again lost it.
#[tokio::test(flavor = "multi_thread")]
async fn an_old_connection_says_with_an_answer_that_it_is_the_last() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let server = start(|config| config.connection.age_max_ms = 100).await;
    let (begin, mut answers, mut connections) = (Instant::now(), 0, 0);
    while begin.elapsed() < Duration::from_millis(1500) {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        connections += 1;
        while begin.elapsed() < Duration::from_secs(3) {
            stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").await.unwrap();
            let mut answer = vec![0; 4096];
            let len = stream.read(&mut answer).await.unwrap();
            assert!(len > 0, "it closed on a request, after {answers} answers");
            answers += 1;
            let is_last = String::from_utf8_lossy(&answer[..len]).contains("connection: close");
            if is_last {
                assert_eq!(stream.read(&mut answer).await.unwrap(), 0, "and then it closes");
                break;
            }
            // Longer than it takes to be closed in between.
            tokio::time::sleep(Duration::from_millis(15)).await;
        }
    }
    assert!((3..=40).contains(&connections) && answers > connections, "{connections} {answers}");
}

/// Memory of a process, in KiB.
fn resident(process: &Process) -> u64 {
    let status = fs::read_to_string(format!("/proc/{}/status", process.0.id())).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

/// What held connections may cost, in KiB.
const HELD_KIB_MAX: u64 = 32 << 10;

/// Six connections that ask for lists and take no byte of the answers made the server hold 317 MB.
#[tokio::test(flavor = "multi_thread")]
async fn lists_that_nobody_takes_cost_little_and_end() {
    let (process, server) = start_process(&["connection.write_timeout_ms=1500"]).await;
    for _ in 0..100 {
        let id = server.open(json!({})).await;
        assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
    }
    let (stop, work) = honest(&server);
    for window in [0, 1] {
        let (before, mut held) = (resident(&process), Vec::new());
        for _ in 0..6 {
            let mut raw = Raw::connect(server.address, window).await;
            let full = pb::ListSessionsRequest { view: pb::SessionView::Full.into(), ..Default::default() }.encode_to_vec();
            let lists: Vec<u8> = (0..128).flat_map(|_| raw.call("ListSessions", &full, false)).collect();
            raw.send(&lists).await;
            held.push(raw);
        }
        tokio::time::sleep(Duration::from_millis(700)).await;
        let (grown, counted) = (resident(&process).saturating_sub(before), server.metric("ada_held_bytes").await);
        assert!(grown < HELD_KIB_MAX, "window {window}: {grown} KiB");
        assert!((1e5..17e6).contains(&counted), "window {window}: {counted}");
        let ends = futures_util::future::join_all(held.into_iter().map(Raw::ended));
        timeout(Duration::from_secs(5), ends).await.expect("they are held for ever");
    }
    stop.cancel();
    assert!(work.await.unwrap() > 10);
    assert!(server.metric("ada_held_bytes").await < 1000.0);
}

/// Requests that stop on the way, a megabyte each, made it hold 783 MB.
#[tokio::test(flavor = "multi_thread")]
async fn requests_that_never_end_cost_little() {
    let (process, server) = start_process(&["connection.body_read_timeout_ms=3000"]).await;
    let (stop, work) = honest(&server);
    tokio::time::sleep(Duration::from_millis(200)).await;
    for method in ["Act", "ActStream"] {
        let (before, mut ends) = (resident(&process), Vec::new());
        for _ in 0..6 {
            let socket = TcpStream::connect(server.address).await.unwrap();
            let executor = hyper_util::rt::TokioExecutor::new();
            let (sender, connection) = hyper::client::conn::http2::handshake(executor, TokioIo::new(socket)).await.unwrap();
            ends.push(tokio::spawn(async move { drop(connection.await) }));
            for _ in 0..128 {
                let begun = stream::iter([Ok::<_, std::io::Error>([&[0, 0, 0x0f, 0xff, 0xff][..], &[0; 1_000_000]].concat())]);
                let body = Body::from_stream(begun.chain(stream::pending()));
                let request = hyper::Request::post(format!("http://{}/ada_diffuser.v1.Agent/{method}", server.address));
                let request = request.header("content-type", "application/grpc").header("te", "trailers").body(body).unwrap();
                let mut sender = sender.clone();
                tokio::spawn(async move { drop(sender.send_request(request).await) });
            }
        }
        let mut most = 0;
        for _ in 0..20 {
            tokio::time::sleep(Duration::from_millis(50)).await;
            most = most.max(resident(&process).saturating_sub(before));
        }
        assert!(most < HELD_KIB_MAX, "{method}: {most} KiB");
        ends.into_iter().for_each(|end| end.abort());
    }
    stop.cancel();
    assert!(work.await.unwrap() > 10, "the honest one is from the same address, and is not cut");
    assert!(server.metric("ada_shed_total").await >= 1.0);
    tokio::time::sleep(Duration::from_millis(500)).await;
    assert!(server.metric("ada_held_bytes").await < 1000.0);
}
