//! A load generator: how does a running ada-server answer many sessions?
//!
//!     cargo run --release --example load -- --clients 32 --seconds 10
//!     cargo run --release --example load -- --help

mod beside;
mod drive;
mod flags;
mod histogram;
mod pace;
mod report;
mod server;
mod session;
mod tally;

use anyhow::{Context, anyhow};
use beside::{churn, close, idle, open};
use clap::Parser;
use drive::Group;
pub use flags::{Face, Flags};
use indicatif::{ProgressBar, ProgressStyle};
use pace::Pace;
pub use report::{Memory, Report};
use server::{Batches, Server};
use session::{Agent, Opening, Session};
use std::{sync::Arc, time::Duration};
use tally::{Tally, Window};
use tokio::{
    task::{JoinHandle, JoinSet},
    time::{sleep, sleep_until, timeout},
};

/// How long after the end an answer is waited for.
const PATIENCE: Duration = Duration::from_secs(60);

/// On one thread: the server needs the others, and threads that wake each other are slower than one that never sleeps.
#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    let report = run(&flags).await?;
    if flags.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{report}");
    }
    Ok(())
}

/// Measures as the flags say. Every session that it opens is closed again.
///
/// # Errors
/// If the server is not there or refuses the sessions; acts that fail are counted, not errors.
pub async fn run(flags: &Flags) -> anyhow::Result<Report> {
    let server = Server::new(&flags.url, flags.server_pid)?;
    let model = server.model(&flags.model).await?;
    let name = format!("{}@{}", model.name, model.digest);
    let (options, state_dim) = (flags.options()?, model.state_dim as usize);
    let opening = Opening { model: name.clone(), state_dim, options, seed: flags.seed, deadline_ms: flags.deadline_ms };
    let (opening, bar, aside) = (Arc::new(opening), bar(flags), server.connect().await?);
    let before = server.memory_mb()?;
    let resting = idle(&aside, &opening, flags.idle_sessions, &bar).await?;
    let at_rest = server.memory_mb()?;
    let groups = gather(flags, &server, &opening).await?;
    let (sessions, mut report) = measure(flags, &server, groups, Aside { opening, agent: aside.clone(), bar, name }).await?;
    let all = before.zip(at_rest).zip(server.memory_mb()?);
    report.memory_mb = all.map(|((before, idle), after)| Memory { before, idle, after });
    close(&aside, sessions.into_iter().chain(resting).collect()).await;
    Ok(report)
}

/// What a run has beside its clients.
struct Aside {
    opening: Arc<Opening>,
    agent: Agent,
    bar: ProgressBar,
    name: String,
}

fn bar(flags: &Flags) -> ProgressBar {
    if flags.json {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {elapsed}");
    ProgressBar::new(0).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// A connection and its sessions, for each connection.
async fn gather(flags: &Flags, server: &Server, opening: &Arc<Opening>) -> anyhow::Result<Vec<(Agent, Vec<Session>)>> {
    let (clients, connections) = (flags.clients as u64, flags.connections() as u64);
    let mut groups = Vec::new();
    for i in 0..connections {
        let agent = server.connect().await?;
        let sessions = open(&agent, opening, i * clients / connections..(i + 1) * clients / connections).await?;
        groups.push((agent, sessions));
    }
    Ok(groups)
}

async fn measure(
    flags: &Flags,
    server: &Server,
    groups: Vec<(Agent, Vec<Session>)>,
    aside: Aside,
) -> anyhow::Result<(Vec<Session>, Report)> {
    let window = Window::from_now(flags.warm_up, flags.seconds);
    let tally = Arc::new(Tally::new(window));
    let mut paces = paces(flags, &groups, window);
    let mut clients = JoinSet::new();
    for (agent, sessions) in groups {
        let own = if flags.face == Face::Batch { 1 } else { sessions.len() };
        let group = Group { agent, sessions, paces: paces.split_off(paces.len() - own) };
        let started = drive::start(group, flags, &tally, &mut clients).await;
        started.map_err(|failure| anyhow!("the stream was refused: {}", failure.reason))?;
    }
    let coming_and_going = tokio::spawn(churn(aside.agent, aside.opening, flags.churn, tally.clone()));
    let batches = watch(server.clone(), window);
    show(&aside.bar, &tally).await;
    let sessions = timeout(PATIENCE, clients.join_all()).await.context("some acts were not answered within a minute")?;
    timeout(PATIENCE, coming_and_going).await.context("the sessions that come and go did not end within a minute")??;
    let batch_size = batches.await?;
    let report = Report { batch_size, ..Report::new(flags, aside.name, &window, &tally.counts()) };
    Ok((sessions.into_iter().flatten().collect(), report))
}

/// One for each client; with batches one for each connection.
fn paces(flags: &Flags, groups: &[(Agent, Vec<Session>)], window: Window) -> Vec<Pace> {
    let len = if flags.face == Face::Batch { groups.len() } else { flags.clients };
    match flags.rate {
        Some(rate) => pace::open(len, flags.clients as f64 / rate, flags.arrivals, flags.seed, window),
        None => (0..len).map(|_| Pace::Closed).collect(),
    }
}

/// Mean batch size over the measured time, once that is over.
fn watch(server: Server, window: Window) -> JoinHandle<Option<f64>> {
    tokio::spawn(async move {
        sleep_until(window.begin.into()).await;
        let before: Option<Batches> = server.batches().await;
        sleep_until(window.end.into()).await;
        server.batches().await?.mean_since(before.unwrap_or_default())
    })
}

/// Moves the bar until the measured time is over.
async fn show(bar: &ProgressBar, tally: &Tally) {
    let Window { start, end, .. } = tally.window;
    bar.set_length((end - start).as_millis() as u64);
    while start.elapsed() < end - start {
        bar.set_message(format!("{} acts, ms", tally.answered()));
        bar.set_position(start.elapsed().as_millis() as u64);
        sleep(Duration::from_millis(100).min(end.saturating_duration_since(std::time::Instant::now()))).await;
    }
    bar.finish_and_clear();
}
