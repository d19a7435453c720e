//! What becomes of the server when something around it is broken: the reader of its log, the disk that the log is on, a thread, a model.

use super::*;
use ada_diffuser::model::method::{GruLatent, LatentSource, Looks};
use std::{fs::File, net::TcpListener, time::Instant};

/// The process on an address that is told to it, for its log will not tell; its stderr is `log`.
async fn start_with_log(log: Stdio, settings: &[&str]) -> (Process, Running) {
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut command = binary(settings);
    let process = Process(command.args(["--listen", &address.to_string()]).stderr(log).spawn().unwrap());
    for _ in 0..500 {
        if TcpStream::connect(address).await.is_ok() {
            break;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let running = Running::elsewhere(address);
    running.ready().await;
    (process, running)
}

/// Acts that fail and are logged, then others; probes tell the truth; the drain ends as usual, with exit status 0.
async fn serves_and_ends(mut process: Process, server: &Running) {
    for _ in 0..4 {
        let bad = server.open(json!({"model": "exploding"})).await;
        assert_eq!(server.act(&bad, 1, &EXPLODING_STATE).await.reason(), "NONFINITE_OUTPUT");
    }
    let good = server.open(json!({})).await;
    for step in 1..=20 {
        assert_eq!(server.act(&good, step, &STATE).await.status, 200);
    }
    assert_eq!((server.get("/livez").await.status, server.get("/readyz").await.status), (200, 200));
    Command::new("kill").arg(process.0.id().to_string()).status().unwrap();
    let begin = Instant::now();
    let status = loop {
        match process.0.try_wait().unwrap() {
            Some(status) => break status,
            None => assert!(begin.elapsed() < Duration::from_secs(8), "the drain does not end"),
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert_eq!(status.code(), Some(0));
}

/// A log line in an inference thread panicked when the log's reader had gone: two acts, and the engine was gone for good.
#[tokio::test(flavor = "multi_thread")]
async fn a_log_whose_reader_has_gone_costs_its_lines() {
    let (mut process, server) = start_with_log(Stdio::piped(), &["telemetry.log=debug"]).await;
    drop(process.0.stderr.take());
    serves_and_ends(process, &server).await;
}

/// A pipe that is full held up whoever logged, for ever.
#[tokio::test(flavor = "multi_thread")]
async fn a_log_that_nobody_reads_costs_its_lines() {
    let (mut process, server) = start_with_log(Stdio::piped(), &["telemetry.log=debug"]).await;
    let _unread = process.0.stderr.take();
    // Each request is a line of some 200 bytes, and a pipe holds 64 KiB.
    for _ in 0..600 {
        assert_eq!(server.get("/livez").await.status, 200);
    }
    serves_and_ends(process, &server).await;
}

/// A full disk ended the start, the accept loop and the drain.
#[tokio::test(flavor = "multi_thread")]
async fn a_log_on_a_full_disk_costs_its_lines() {
    let full = File::options().write(true).open("/dev/full").unwrap();
    let (process, server) = start_with_log(full.into(), &["telemetry.log=debug"]).await;
    let metrics = server.get("/metrics").await.text;
    let line = metrics.lines().find(|line| line.starts_with("ada_log_lines_left_out_total{reason=\"unwritten\"}")).unwrap();
    assert!(!line.ends_with(" 0"), "{line}");
    serves_and_ends(process, &server).await;
}

/// Readiness looks at the engine: it was green with every inference thread gone.
#[tokio::test(flavor = "multi_thread")]
async fn a_silent_engine_is_not_ready() {
    // A worker without work shows itself every 250 ms, which is too seldom here.
    let (_process, server) = start_process(&["engine.heartbeat_age_ms_max=20"]).await;
    let mut said = Reply::default();
    for _ in 0..200 {
        said = server.get("/readyz").await;
        if said.status != 200 {
            break;
        }
    }
    assert_eq!((said.status, said.text.as_str()), (503, "a worker of the engine is silent\n"));
}

/// Broken models beside a good one cost themselves alone. One number too large ended the process; a pipe held up the start for ever; a model
/// that cannot act was served.
#[tokio::test(flavor = "multi_thread")]
async fn broken_models_cost_themselves() {
    let dir = tempfile::tempdir().unwrap();
    let tiny: ModelConfig = serde_json::from_slice(&fs::read("models/tiny/config.json").unwrap()).unwrap();
    alter(&dir.path().join("tiny"), &tiny, 1.0);
    let mut noisy = tiny.clone();
    noisy.defaults.sampler.temperature = 10.0;
    // Its output is not finite for any state.
    alter(&dir.path().join("never-finite"), &noisy, 3e38);
    type Change = fn(&mut ModelConfig);
    let absurd: [(&str, Change); 6] = [
        ("levels", |config| config.method.plan.level_max = 1_000_000_000_000),
        ("block", |config| config.method.latent = LatentSource::Gru(GruLatent::plain(6, 32, Looks::Block(1 << 62)))),
        ("horizon", |config| config.method.plan.horizon = usize::MAX / 2),
        ("sub-steps", |config| config.defaults.sampler.sub_steps = (1 << 61) + 1),
        ("clip", |config| config.method.plan.clip = f32::INFINITY),
        ("bounds", |config| config.units.action_low[0] = f32::NEG_INFINITY),
    ];
    for (name, change) in absurd {
        let mut config = tiny.clone();
        change(&mut config);
        alter(&dir.path().join(name), &config, 1.0);
    }
    for file in ["config.json", "manifest.json", "model.safetensors"] {
        let pipe = dir.path().join(format!("pipe-{}", &file[..5]));
        alter(&pipe, &tiny, 1.0);
        fs::remove_file(pipe.join(file)).unwrap();
        assert!(Command::new("mkfifo").arg(pipe.join(file)).status().unwrap().success());
    }
    let server = start(|config| config.models.dir = dir.path().into()).await;
    let listed = server.get("/v1/models").await.json()["models"].clone();
    let names: Vec<_> = listed.as_array().unwrap().iter().map(|model| model["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["tiny"]);
    let id = server.open(json!({})).await;
    assert_eq!(server.act(&id, 1, &STATE).await.status, 200);
}
