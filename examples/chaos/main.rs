//! The crasher: real servers that are killed as hard as it goes while sessions act, and a check that no act is lost and none given twice.
//!
//!     cargo build --release --bins
//!     cargo run --release --example chaos -- --kills 100
//!     cargo run --release --example chaos -- --help

mod flags;
mod life;
mod process;
mod tally;

use ada_diffuser::model::{checkpoint, noise::Philox};
use anyhow::Context;
use clap::Parser;
pub use flags::{Control, Flags};
use indicatif::{ProgressBar, ProgressStyle};
use life::Life;
use process::{Death, Place, Process};
use std::{sync::Arc, time::Duration};
use tally::Tally;
pub use tally::Verdicts;
use tokio::{task::JoinSet, time::timeout};
use tokio_util::sync::CancellationToken;

/// A server that is not ready by then is broken.
const READY_MAX: Duration = Duration::from_secs(60);
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
    let found = verdicts.found() > 0;
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
    let mut process = start(&place, &death, &tally, false).await?;
    let mut lives = JoinSet::new();
    for number in 0..flags.sessions {
        let life = Life::new((agent.clone(), flags.model.clone()), (flags, number), place.address, tally.clone());
        lives.spawn(life.live(stop.clone()));
    }
    for kill in 0..flags.kills {
        if process.die(&death).await? {
            tally.died(death.word());
        }
        place.meddle(flags.control, kill)?;
        // The last one has to live until all have come to an end.
        death = if kill + 1 < flags.kills { Death::draw(kill + 1, &mut dice) } else { Death::Killed(Duration::ZERO) };
        process = start(&place, &death, &tally, true).await?;
        bar.inc(1);
        bar.set_message(tally.verdicts(kill + 1).to_string().lines().last().unwrap_or_default().to_owned());
    }
    stop.cancel();
    let lives = timeout(END_MAX, lives.join_all()).await.context("the sessions came to no end")?;
    process.kill().await?;
    let mut process = start(&place, &Death::Killed(Duration::ZERO), &tally, true).await?;
    let mut live = 0;
    for mut life in lives {
        life.audit().await;
        live += 1;
    }
    tally.listed(process.sessions().await?, live);
    process.kill().await?;
    bar.finish_and_clear();
    Ok(tally.verdicts(flags.kills))
}

/// A server that is ready. One that does not start over what it finds is counted, and another one starts over what was there before.
async fn start(place: &Place, death: &Death, tally: &Tally, again: bool) -> anyhow::Result<Process> {
    let begin = std::time::Instant::now();
    match timeout(READY_MAX, Process::start(place, death)).await.context("the server did not become ready")? {
        Ok(process) => {
            if again {
                tally.ready(begin.elapsed());
            }
            Ok(process)
        }
        Err(error) => {
            tally.corrupt(&error.to_string());
            place.begin_anew()?;
            Process::start(place, death).await
        }
    }
}

fn bar(flags: &Flags) -> ProgressBar {
    if flags.json || flags.quiet {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{wide_bar} {pos} of {len} kills, {elapsed}, about {eta} left; {msg}");
    ProgressBar::new(flags.kills.into()).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}
