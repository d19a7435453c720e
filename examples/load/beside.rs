//! Sessions beside those that are measured.

use super::{
    session::{Agent, Failure, Opening, Session},
    tally::Tally,
};
use anyhow::anyhow;
use futures_util::{StreamExt, TryStreamExt, stream};
use indicatif::ProgressBar;
use std::{sync::Arc, time::Duration};
use tokio::{task::JoinSet, time::sleep_until};

/// Calls at a time; a server lets 128 run on one connection.
const AT_A_TIME: usize = 64;
/// Numbers of these sessions, far from those of the clients.
const IDLE: u64 = 1 << 32;
const CHURN: u64 = 1 << 33;

/// Opens this many sessions, numbered from `first` on.
///
/// # Errors
/// If one cannot be opened.
pub async fn open(agent: &Agent, opening: &Arc<Opening>, numbers: std::ops::Range<u64>) -> anyhow::Result<Vec<Session>> {
    let one = |number| {
        let (mut agent, opening) = (agent.clone(), opening.clone());
        async move { Session::open(&mut agent, opening, number).await }
    };
    let opened = stream::iter(numbers).map(one).buffered(AT_A_TIME).try_collect().await;
    opened.map_err(|failure: Failure| anyhow!("a session could not be opened: {}", failure.reason))
}

/// Opens this many sessions and acts once in each.
///
/// # Errors
/// If one of them fails.
pub async fn idle(agent: &Agent, opening: &Arc<Opening>, count: usize, bar: &ProgressBar) -> anyhow::Result<Vec<Session>> {
    bar.set_message("idle sessions");
    bar.set_length(count as u64);
    let one = |number| {
        let (mut agent, opening, bar) = (agent.clone(), opening.clone(), bar.clone());
        async move {
            let mut session = Session::open(&mut agent, opening, IDLE + number).await?;
            session.act(&mut agent).await?;
            bar.inc(1);
            Ok(session)
        }
    };
    let opened = stream::iter(0..count as u64).map(one).buffer_unordered(AT_A_TIME).try_collect().await;
    opened.map_err(|failure: Failure| anyhow!("an idle session: {}", failure.reason))
}

/// Over the measured time, evenly: opens a session, acts once, closes it.
pub async fn churn(agent: Agent, opening: Arc<Opening>, count: usize, tally: Arc<Tally>) {
    let mut visits = JoinSet::new();
    for number in 0..count {
        let at = tally.window.begin + Duration::from_secs_f64(tally.window.seconds() * number as f64 / count as f64);
        sleep_until(at.into()).await;
        let (agent, opening, tally) = (agent.clone(), opening.clone(), tally.clone());
        visits.spawn(async move { tally.churn(visit(agent, opening, CHURN + number as u64).await) });
    }
    visits.join_all().await;
}

async fn visit(mut agent: Agent, opening: Arc<Opening>, number: u64) -> Result<(), Failure> {
    let mut session = Session::open(&mut agent, opening, number).await?;
    let acted = session.act(&mut agent).await;
    session.close(&mut agent).await?;
    acted
}

/// Ends sessions; one that has ended already is no failure.
pub async fn close(agent: &Agent, sessions: Vec<Session>) {
    let one = |session: Session| {
        let mut agent = agent.clone();
        async move { drop(session.close(&mut agent).await) }
    };
    stream::iter(sessions).for_each_concurrent(AT_A_TIME, one).await;
}
