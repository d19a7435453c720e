//! The crasher: real servers that are killed as hard as it goes while sessions act, and a check that no act is lost and none given twice.
//!
//!     cargo build --release --bins
//!     cargo run --release --example chaos -- --kills 100
//!     cargo run --release --example chaos -- --help

mod flags;
#[path = "../shared/life.rs"]
mod life;
mod process;
#[path = "../shared/tally.rs"]
mod tally;
mod verdicts;

use ada_diffuser::model::{checkpoint, noise::Philox};
use anyhow::Context;
use clap::Parser;
pub use flags::{Control, Flags};
use futures_util::FutureExt;
use indicatif::{ProgressBar, ProgressStyle};
use life::{Client, Dial, Life, Lot};
use process::{Death, Place, Process};
use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};
use tally::Tally;
use tokio::{task::JoinSet, time::timeout};
use tokio_util::sync::CancellationToken;
pub use verdicts::Verdicts;

/// A server that is not ready by then is broken.
const READY_MAX: Duration = Duration::from_secs(60);
/// A call that is not answered by then is made again.
const CALL_MAX: Duration = Duration::from_secs(10);
/// So long the sessions have to end what they are at, once the last server is up.
const END_MAX: Duration = Duration::from_secs(60);

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    let verdicts = run(&flags).await?;
    if flags.json {
        println!("{}", serde_json::to_string(&verdicts)?);
    } else {
        print!("{verdicts}");
    }
    // A control is there to be found out.
    let found = verdicts.sum.found() > 0;
    if found == (flags.control != Control::None) { Ok(()) } else { anyhow::bail!(flags.control.disappointment()) }
}

/// Kills and looks, as the flags say.
///
/// # Errors
/// If a server does not start, or the sessions come to no end.
pub async fn run(flags: &Flags) -> anyhow::Result<Verdicts> {
    let agent = checkpoint::load(&flags.models.join(&flags.model)).with_context(|| format!("{}", flags.models.display()))?;
    let (agent, tally, stop) = (Arc::new(agent), Arc::new(Tally::default()), CancellationToken::new());
    let place = Place::new(flags)?;
    let (mut dice, bar) = (Philox::named(flags.seed, "chaos.kills"), bar(flags));
    let mut death = Death::draw(0, &mut dice);
    let (mut process, mut ready) = (start(&place, &death, &tally).await?.0, Vec::new());
    let mut lives = JoinSet::new();
    for number in 0..flags.sessions {
        let (agent, noise_is_wrong) = (agent.clone(), flags.control == Control::Noise);
        let lot = Lot { agent, model: flags.model.clone(), seed: flags.seed, number, call_max: CALL_MAX, noise_is_wrong };
        lives.spawn(Life::new(lot, dial(place.address), tally.clone()).live(stop.clone()));
    }
    for kill in 0..flags.kills {
        if process.die(&death).await? {
            tally.troubled(death.word());
        }
        place.meddle(flags.control, kill)?;
        // The last one has to live until all have come to an end.
        death = if kill + 1 < flags.kills { Death::draw(kill + 1, &mut dice) } else { Death::Killed(Duration::ZERO) };
        let started = start(&place, &death, &tally).await?;
        process = started.0;
        ready.push(started.1);
        bar.inc(1);
        bar.set_message(Verdicts::new(kill + 1, tally.sum(), &[]).to_string().lines().last().unwrap_or_default().to_owned());
    }
    stop.cancel();
    let lives = timeout(END_MAX, lives.join_all()).await.context("the sessions came to no end")?;
    process.kill().await?;
    let (process, _) = start(&place, &Death::Killed(Duration::ZERO), &tally).await?;
    let (mut live, mut listed) = (0, None);
    for mut life in lives {
        life.audit().await;
        live += 1;
        listed = life.listed().await;
    }
    tally.listed(listed.context("the sessions cannot be listed")?, live);
    process.kill().await?;
    bar.finish_and_clear();
    Ok(Verdicts::new(flags.kills, tally.sum(), &ready))
}

fn dial(address: SocketAddr) -> Dial {
    Arc::new(move || Client::connect(format!("http://{address}")).map(Result::ok).boxed())
}

/// A server that is ready, and how long that took. One that does not start over what it finds is counted, and another one starts over what was there before.
async fn start(place: &Place, death: &Death, tally: &Tally) -> anyhow::Result<(Process, Duration)> {
    let begin = Instant::now();
    let started = timeout(READY_MAX, Process::start(place, death)).await.context("the server did not become ready")?;
    let process = match started {
        Ok(process) => process,
        Err(error) => {
            tally.corrupt(&error.to_string());
            place.begin_anew()?;
            Process::start(place, death).await?
        }
    };
    Ok((process, begin.elapsed()))
}

fn bar(flags: &Flags) -> ProgressBar {
    if flags.json || flags.quiet {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{wide_bar} {pos} of {len} kills, {elapsed}, about {eta} left; {msg}");
    ProgressBar::new(flags.kills.into()).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}
