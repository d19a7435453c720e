//! One server after the other, on the same port and the same store.

use super::flags::{Control, Flags};
use ada_diffuser::model::noise::Philox;
use anyhow::{Context, bail};
use std::{
    fs,
    net::{SocketAddr, TcpListener},
    path::PathBuf,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};
use tempfile::TempDir;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    task::spawn_blocking,
    time::sleep,
};

/// How often a server is asked whether it is ready.
const POLL: Duration = Duration::from_millis(2);
/// Bytes that damage changes.
const DAMAGE_LEN: usize = 64;

/// How a server ends.
#[derive(Clone, Debug)]
pub enum Death {
    /// By SIGKILL, after so long.
    Killed(Duration),
    /// By its own hand at a named state (`ada-server --fault`), the n-th time that it comes there.
    At(&'static str, usize),
}

/// States at which a server ends. The last one is reached by SIGTERM, the others by acts.
const STATES: [&str; 6] = ["admitted", "evaluating", "computed", "stored", "told", "draining"];
/// A server that does not come to the named state by then is killed.
const STATE_MAX: Duration = Duration::from_secs(2);
/// Longest time between a server's readiness and its death. Most of it is spent in acts.
const LIFE_MS: usize = 120;
/// Times that a state is reached before the one that ends it.
const NTH_MAX: usize = 60;

impl Death {
    /// Every second one at a named state, each of them in turn.
    pub fn draw(kill: u32, dice: &mut Philox) -> Self {
        let life = Duration::from_millis(dice.below(LIFE_MS) as u64);
        match STATES[kill as usize / 2 % STATES.len()] {
            _ if kill.is_multiple_of(2) => Self::Killed(life),
            "draining" => Self::At("draining", 1),
            state => Self::At(state, 1 + dice.below(NTH_MAX)),
        }
    }

    /// The word in the sum.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Killed(_) => "killed",
            Self::At(state, _) => state,
        }
    }

    fn flags(&self) -> Vec<String> {
        match self {
            Self::Killed(_) => Vec::new(),
            Self::At(state, nth) => vec!["--fault".to_owned(), format!("{state}=kill@{nth}")],
        }
    }
}

/// Where servers run.
pub struct Place {
    /// Of all of them.
    pub address: SocketAddr,
    flags: Flags,
    dir: TempDir,
}

impl Place {
    /// A directory of its own, and a port that was free a moment ago.
    ///
    /// # Errors
    /// If there is none.
    pub fn new(flags: &Flags) -> anyhow::Result<Self> {
        let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
        let place = Self { address, flags: flags.clone(), dir: TempDir::new()? };
        // Alone, so that a start is not that of others.
        let (from, to) = (flags.models.join(&flags.model), place.models().join(&flags.model));
        fs::create_dir_all(&to)?;
        for file in fs::read_dir(&from).with_context(|| format!("{}", from.display()))? {
            let file = file?;
            fs::copy(file.path(), to.join(file.file_name()))?;
        }
        Ok(place)
    }

    fn models(&self) -> PathBuf {
        self.dir.path().join("models")
    }

    fn store(&self) -> PathBuf {
        self.dir.path().join("store")
    }

    fn file(&self) -> PathBuf {
        self.store().join("sessions.redb")
    }

    fn earlier(&self) -> PathBuf {
        self.dir.path().join("earlier.redb")
    }

    fn command(&self) -> Command {
        let Flags { server, model, durability, control, .. } = &self.flags;
        let mut command = Command::new(server);
        command.arg("--listen").arg(self.address.to_string()).arg("--models").arg(self.models()).args(["--default-model", model]);
        // A batch length is warmed up at each start.
        command.args(["--set", "engine.batch_len_max=8", "--set", "telemetry.log=warn", "--set", "sessions.unused_idle_ms=60000"]);
        if *control != Control::Forgetful {
            command.arg("--store").arg(self.store()).args(["--set", &format!("store.durability={}", durability.word())]);
        }
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    }

    /// Does what the control says, between two servers.
    ///
    /// # Errors
    /// If a file cannot be read or written.
    pub fn meddle(&self, control: Control, kill: u32) -> anyhow::Result<()> {
        match control {
            Control::None | Control::Forgetful | Control::Noise => {}
            Control::Rollback if kill % 3 == 2 => drop(fs::copy(self.earlier(), self.file())?),
            Control::Rollback => drop(fs::copy(self.file(), self.earlier())?),
            Control::Damage if kill % 3 == 2 => {
                fs::copy(self.file(), self.earlier())?;
                let mut bytes = fs::read(self.file())?;
                let stride = bytes.len() / DAMAGE_LEN;
                (0..DAMAGE_LEN).for_each(|i| bytes[i * stride + 4_097 % stride] ^= 0x10);
                fs::write(self.file(), bytes)?;
            }
            Control::Damage => {}
        }
        Ok(())
    }

    /// After a server that would not start: as it was before the damage, or as if nothing had been.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn begin_anew(&self) -> anyhow::Result<()> {
        if self.flags.control == Control::Damage {
            fs::copy(self.earlier(), self.file())?;
        } else if self.file().exists() {
            fs::rename(self.file(), self.dir.path().join("unreadable.redb"))?;
        }
        Ok(())
    }
}

/// A server that is ready.
pub struct Process {
    child: Child,
    address: SocketAddr,
}

impl Process {
    /// Starts one.
    ///
    /// # Errors
    /// If it ends before it is ready, with what it said.
    pub async fn start(place: &Place, death: &Death) -> anyhow::Result<Self> {
        let mut command = place.command();
        command.args(death.flags());
        let child = command.spawn().with_context(|| format!("{}", place.flags.server.display()))?;
        let mut process = Self { child, address: place.address };
        while !process.is_ready().await {
            match process.child.try_wait()? {
                None => {}
                // Sessions that waited for it brought it to the named state between two looks: it was ready, and died as it was to.
                Some(status) if matches!(death, Death::At(..)) && status.code().is_none() => return Ok(process),
                Some(status) => bail!("the server ended at its start ({status}): {}", process.said()),
            }
            sleep(POLL).await;
        }
        Ok(process)
    }

    async fn is_ready(&self) -> bool {
        let asked = async {
            let mut stream = TcpStream::connect(self.address).await?;
            stream.write_all(b"GET /readyz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await?;
            let mut head = [0; 12];
            stream.read_exact(&mut head).await?;
            Ok::<_, std::io::Error>(head)
        };
        asked.await.is_ok_and(|head| head == *b"HTTP/1.1 200")
    }

    fn said(&mut self) -> String {
        let mut said = String::new();
        if let Some(stderr) = &mut self.child.stderr {
            // What it did not say is not told.
            let _unread = std::io::Read::read_to_string(stderr, &mut said);
        }
        said
    }

    /// Waits for its death; says whether that came as it was meant to.
    ///
    /// # Errors
    /// If the system refuses.
    pub async fn die(mut self, death: &Death) -> anyhow::Result<bool> {
        match death {
            Death::Killed(life) => sleep(*life).await,
            Death::At(state, _) => {
                if *state == "draining" {
                    sleep(Duration::from_millis(LIFE_MS as u64 / 2)).await;
                    Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status()?;
                }
                let end = Instant::now() + STATE_MAX;
                while Instant::now() < end {
                    if let Some(status) = self.child.try_wait()? {
                        return Ok(status.code().is_none());
                    }
                    sleep(POLL).await;
                }
            }
        }
        let by_hand = matches!(death, Death::Killed(_));
        self.kill().await?;
        Ok(by_hand)
    }

    /// SIGKILL.
    ///
    /// # Errors
    /// If the system refuses.
    pub async fn kill(mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        spawn_blocking(move || self.child.wait()).await??;
        Ok(())
    }
}
