//! A real server on a free port, and a client for each face.

mod bytes;
mod counters;
mod crew;
mod ends;
mod engine;
mod errors;
mod faults;
mod frames;
mod generator;
mod history;
mod hold;
mod kills;
mod late;
mod lifecycle;
mod limits;
mod methods;
mod recordings;
mod records;
mod steps;
mod store;
mod stories;
mod streams;
mod tokens;

use ada_diffuser::{
    model::{checkpoint, config::ModelConfig},
    serve::{
        Server, ServerError,
        config::Config,
        grpc::pb::{self, agent_client::AgentClient, models_client::ModelsClient},
    },
};
use axum::body::{Body, to_bytes};
use hyper_util::rt::TokioIo;
use safetensors::SafeTensors;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::{
    fs,
    io::{BufRead, BufReader},
    net::SocketAddr,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::OnceLock,
    time::Duration,
};
use tokio::{net::TcpStream, task::JoinHandle, time::timeout};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status, transport::Channel};

/// A state that every test model takes.
pub const STATE: [f32; 4] = [0.1, -0.2, 0.3, 0.4];
/// A state, rare but possible, for which the output of the model `exploding` is not finite.
pub const EXPLODING_STATE: [f32; 4] = [1e5, -1e5, 1e5, 1e5];
/// What leads from the input straight to the output.
const SKIP: &str = "denoiser.input_skip.weight";
/// Steps per rung with which the model `slow` takes minutes for an act.
const SLOW_SUB_STEPS: usize = 25_000;

/// A directory of models: `tiny`, `slow` (an act takes minutes), `exploding` (its output is not finite for
/// [`EXPLODING_STATE`]) and `torn` (refused).
pub fn models_dir() -> &'static Path {
    static DIR: OnceLock<tempfile::TempDir> = OnceLock::new();
    DIR.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let tiny = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/tiny");
        let config: ModelConfig = serde_json::from_slice(&fs::read(tiny.join("config.json")).unwrap()).unwrap();
        copy(&tiny, &dir.path().join("tiny"));
        let mut slow = config.clone();
        slow.method.plan.level_max = SLOW_SUB_STEPS * slow.method.plan.horizon;
        slow.defaults.sampler.sub_steps = SLOW_SUB_STEPS;
        slow.trained.sub_steps = vec![SLOW_SUB_STEPS];
        alter(&dir.path().join("slow"), &slow, 1.0);
        alter(&dir.path().join("exploding"), &config, 1e34);
        copy(&tiny, &dir.path().join("torn"));
        let weights = dir.path().join("torn/model.safetensors");
        let mut bytes = fs::read(&weights).unwrap();
        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        fs::write(&weights, bytes).unwrap();
        dir
    })
    .path()
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir(to).unwrap();
    for file in fs::read_dir(from).unwrap().map(Result::unwrap) {
        fs::copy(file.path(), to.join(file.file_name())).unwrap();
    }
}

/// `tiny` with another configuration and a factor on its input skip, written by hand: the program tries an act of what it writes.
fn alter(dir: &Path, config: &ModelConfig, skip: f32) {
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models/tiny"), dir);
    let (mut manifest, _) = checkpoint::load_manifest(dir).unwrap();
    let mut weights = fs::read(dir.join("model.safetensors")).unwrap();
    let tensor = SafeTensors::deserialize(&weights).unwrap().tensor(SKIP).unwrap().data().as_ptr_range();
    let base = weights.as_ptr() as usize;
    let skip_bytes = &mut weights[tensor.start as usize - base..tensor.end as usize - base];
    for value in skip_bytes.as_chunks_mut().0 {
        *value = (f32::from_le_bytes(*value) * skip).to_le_bytes();
    }
    manifest.tensors.get_mut(SKIP).unwrap().sha256 = sha256(skip_bytes);
    for (name, bytes) in [("config.json", serde_json::to_vec(config).unwrap()), ("model.safetensors", weights)] {
        manifest.files.insert(name.to_owned(), sha256(&bytes));
        fs::write(dir.join(name), bytes).unwrap();
    }
    fs::write(dir.join("manifest.json"), serde_json::to_vec(&manifest).unwrap()).unwrap();
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A running server; dropping it drains it.
pub struct Running {
    pub address: SocketAddr,
    pub stop: CancellationToken,
    pub done: JoinHandle<Result<(), ServerError>>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// The test settings: all models, `tiny` by default, two workers.
pub fn config() -> Config {
    let mut config = Config::default();
    config.server.listen = "127.0.0.1:0".to_owned();
    config.server.drain_notice_ms = 0;
    config.engine.workers = 2;
    // An act of the model `slow` is not to be refused because it takes minutes.
    (config.limits.act_deadline_ms, config.limits.act_deadline_ms_max) = (3_600_000, 3_600_000);
    config.models.dir = PathBuf::from(models_dir());
    config.models.default = "tiny".to_owned();
    config
}

/// A server that is ready.
pub async fn start(adjust: impl FnOnce(&mut Config)) -> Running {
    let mut config = config();
    adjust(&mut config);
    let server = Server::bind(config.validated().unwrap()).await.unwrap();
    let address = server.address().unwrap();
    let stop = CancellationToken::new();
    let done = tokio::spawn(server.run(stop.clone().cancelled_owned()));
    let running = Running { address, stop, done };
    running.ready().await;
    running
}

/// A process that ends with its test.
pub struct Process(pub Child);

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already. Whoever starts another one over the same files needs this one gone.
        let _ended = self.0.kill().and_then(|()| self.0.wait());
    }
}

/// `ada-server` as a user starts it, on a free port, ready. Its metrics are its own, while servers of one process share theirs.
pub async fn start_process(settings: &[&str]) -> (Process, Running) {
    start_armed(&[], settings).await
}

/// The same with faults.
pub async fn start_armed(faults: &[&str], settings: &[&str]) -> (Process, Running) {
    let mut command = binary(settings);
    command.args(faults.iter().flat_map(|fault| ["--fault", fault]));
    start_command(command).await
}

/// The same of a command that ends as `ada-server` does.
async fn start_command(mut command: Command) -> (Process, Running) {
    command.args(["--listen", "127.0.0.1:0"]);
    let mut process = Process(command.stderr(Stdio::piped()).spawn().unwrap());
    let mut lines = BufReader::new(process.0.stderr.take().unwrap()).lines();
    let line = lines.by_ref().map(Result::unwrap).find(|line| line.contains("\"listening\"")).expect("it ended before it listened");
    std::thread::spawn(move || lines.for_each(drop));
    let event: Value = serde_json::from_str(&line).unwrap();
    let running = Running::elsewhere(event["address"].as_str().unwrap().parse().unwrap());
    running.ready().await;
    (process, running)
}

/// `ada-server` over the test models, with warm-up of one batch length alone.
fn binary(settings: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ada-server"));
    command.args(["--default-model", "tiny", "--set", "telemetry.format=json", "--models"]).arg(models_dir());
    command.args(settings.iter().flat_map(|setting| ["--set", setting]));
    // As in `config`: the model `slow` takes minutes for an act.
    command.env("ADA__LIMITS__ACT_DEADLINE_MS", "3600000").env("ADA__LIMITS__ACT_DEADLINE_MS_MAX", "3600000");
    command.env("ADA__ENGINE__BATCH_LEN_MAX", "1").env_remove("RAYON_NUM_THREADS").env_remove("CANDLE_NUM_THREADS");
    command
}

/// An HTTP answer.
#[derive(Debug, Default)]
pub struct Reply {
    pub status: u16,
    pub headers: hyper::HeaderMap,
    pub text: String,
}

impl Reply {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.text).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    pub fn reason(&self) -> String {
        assert_eq!(self.headers["content-type"], "application/problem+json", "{self:?}");
        assert_eq!(self.json()["status"], self.status);
        self.json()["reason"].as_str().unwrap().to_owned()
    }
}

impl Running {
    /// A server of another process.
    fn elsewhere(address: SocketAddr) -> Self {
        Self { address, stop: CancellationToken::new(), done: tokio::spawn(async { Ok(()) }) }
    }

    async fn ready(&self) {
        for _ in 0..500 {
            if self.get("/readyz").await.status == 200 {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("the server did not become ready")
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(format!("http://{}", self.address)).unwrap().connect().await.unwrap()
    }

    pub async fn agent(&self) -> AgentClient<Channel> {
        AgentClient::new(self.channel().await)
    }

    pub async fn models(&self) -> ModelsClient<Channel> {
        ModelsClient::new(self.channel().await)
    }

    pub async fn http(&self, method: &str, path: &str, body: &str) -> Reply {
        let stream = TcpStream::connect(self.address).await.unwrap();
        let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.unwrap();
        let driver = tokio::spawn(connection);
        let request = hyper::Request::builder()
            .method(method)
            .uri(path)
            .header("host", "localhost")
            .header("content-type", "application/json")
            .body(Body::from(body.to_owned()));
        let response = sender.send_request(request.unwrap()).await.unwrap();
        let (parts, body) = response.into_parts();
        let bytes = to_bytes(Body::new(body), usize::MAX).await.unwrap();
        driver.abort();
        Reply { status: parts.status.as_u16(), headers: parts.headers, text: String::from_utf8(bytes.to_vec()).unwrap() }
    }

    pub async fn get(&self, path: &str) -> Reply {
        self.http("GET", path, "").await
    }

    pub async fn post(&self, path: &str, body: &Value) -> Reply {
        self.http("POST", path, &body.to_string()).await
    }

    /// A session over REST with this body; its id.
    pub async fn open(&self, body: Value) -> String {
        let reply = self.post("/v1/sessions", &body).await;
        assert_eq!(reply.status, 201, "{reply:?}");
        reply.json()["session"]["session_id"].as_str().unwrap().to_owned()
    }

    /// An act over REST.
    pub async fn act(&self, id: &str, step: u64, state: &[f32]) -> Reply {
        self.post(&format!("/v1/sessions/{id}/act"), &json!({"step": step, "observation": {"state": state}})).await
    }

    /// Starts an act over gRPC that takes minutes, on a client of its own, and waits until it is in flight.
    pub async fn start_slow(&self, id: &str) -> JoinHandle<Result<pb::ActResponse, Status>> {
        let (mut agent, request) = (self.agent().await, act(id, 1, &STATE));
        let task = tokio::spawn(async move { agent.act(request).await.map(tonic::Response::into_inner) });
        self.until(id, |session| session["busy"] == true).await;
        task
    }

    /// Waits until the summary of the session is as wanted.
    pub async fn until(&self, id: &str, wanted: impl Fn(&Value) -> bool) {
        let wait = async {
            while !wanted(&self.get(&format!("/v1/sessions/{id}")).await.json()["session"]) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        timeout(Duration::from_secs(10), wait).await.expect("the session did not get there");
    }

    /// Value of a metric, all labels together.
    pub async fn metric(&self, name: &str) -> f64 {
        let text = self.get("/metrics").await.text;
        let is_it = |line: &&str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' ']));
        text.lines().filter(is_it).map(|line| line.rsplit(' ').next().unwrap().parse::<f64>().unwrap()).sum()
    }
}

/// An act over gRPC.
pub fn act(id: &str, step: u64, state: &[f32]) -> pb::ActRequest {
    let observation = pb::Observation { state: state.to_vec(), ..Default::default() };
    pb::ActRequest { session_id: id.to_owned(), step, observation: Some(observation), ..Default::default() }
}

/// Code and reason of a gRPC error.
pub fn failure(status: &Status) -> (Code, String) {
    (status.code(), trailer(status, "ada-reason").unwrap_or_default())
}

pub fn trailer(status: &Status, name: &str) -> Option<String> {
    status.metadata().get(name).map(|value| value.to_str().unwrap().to_owned())
}
