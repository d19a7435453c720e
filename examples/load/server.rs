//! The server from outside: connections, its models, its metrics, its memory.

use super::session::Agent;
use ada_diffuser::serve::grpc::pb::{GetModelRequest, Model, models_client::ModelsClient};
use anyhow::{Context, anyhow};
use axum::body::{Body, to_bytes};
use hyper_util::rt::TokioIo;
use std::fs;
use tokio::net::TcpStream;
use tonic::transport::{Channel, Endpoint, Uri};

/// One running server.
#[derive(Clone, Debug)]
pub struct Server {
    uri: Uri,
    pid: Option<u32>,
}

/// Network evaluations of whole batches, and the acts in them, since the server started.
#[derive(Clone, Copy, Debug, Default)]
pub struct Batches {
    count: f64,
    acts: f64,
}

impl Batches {
    /// Acts that shared one network evaluation since `before`, on average.
    pub fn mean_since(self, before: Self) -> Option<f64> {
        let count = self.count - before.count;
        (count > 0.0).then(|| (self.acts - before.acts) / count)
    }
}

impl Server {
    /// The server at this address.
    ///
    /// # Errors
    /// If the address is none.
    pub fn new(url: &str, pid: Option<u32>) -> anyhow::Result<Self> {
        let uri: Uri = url.parse().with_context(|| format!("--url {url}"))?;
        anyhow::ensure!(uri.scheme_str() == Some("http") && uri.host().is_some(), "--url {url}: expected http://host:port");
        Ok(Self { uri, pid })
    }

    /// A connection.
    ///
    /// # Errors
    /// If nobody answers there.
    pub async fn connect(&self) -> anyhow::Result<Agent> {
        Ok(Agent::new(self.channel().await?))
    }

    /// A model by its name; empty: the default.
    ///
    /// # Errors
    /// If the server has no such model.
    pub async fn model(&self, name: &str) -> anyhow::Result<Model> {
        let answer = ModelsClient::new(self.channel().await?).get(GetModelRequest { model: name.to_owned() }).await;
        answer.map_err(|status| anyhow!("{}", status.message()))?.into_inner().model.context("an answer without a model")
    }

    async fn channel(&self) -> anyhow::Result<Channel> {
        let endpoint = Endpoint::from(self.uri.clone()).tcp_nodelay(true);
        endpoint
            .connect()
            .await
            .with_context(|| format!("no server at {}: start one with `make serve`, or name another with --url", self.uri))
    }

    /// What the metrics say of batches; none if they cannot be read.
    pub async fn batches(&self) -> Option<Batches> {
        let text = self.get("/metrics").await.ok()?;
        let sum = |name: &str| {
            let of_it = |line: &&str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(['{', ' ']));
            let values = text.lines().filter(of_it).filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok());
            values.reduce(|a, b| a + b)
        };
        Some(Batches { count: sum("ada_batch_size_count")?, acts: sum("ada_batch_size_sum")? })
    }

    async fn get(&self, path: &str) -> anyhow::Result<String> {
        let authority = self.uri.authority().context("no address")?;
        let stream = TcpStream::connect((authority.host(), authority.port_u16().unwrap_or(80))).await?;
        let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
        let driver = tokio::spawn(connection);
        let request = hyper::Request::builder().uri(path).header("host", authority.as_str()).body(Body::empty())?;
        let bytes = to_bytes(Body::new(sender.send_request(request).await?.into_body()), usize::MAX).await?;
        driver.abort();
        Ok(String::from_utf8(bytes.to_vec())?)
    }

    /// Resident memory of the server's process in MB (1e6 bytes); none if no process was named.
    ///
    /// # Errors
    /// If the system does not say.
    pub fn memory_mb(&self) -> anyhow::Result<Option<f64>> {
        let Some(pid) = self.pid else { return Ok(None) };
        let path = format!("/proc/{pid}/status");
        let text = fs::read_to_string(&path).with_context(|| format!("--server-pid: {path}"))?;
        let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).with_context(|| format!("{path} has no VmRSS"))?;
        let kib: f64 = line.trim().trim_end_matches(" kB").parse().with_context(|| format!("{path}: VmRSS:{line}"))?;
        Ok(Some(kib * 1024.0 / 1e6))
    }
}
