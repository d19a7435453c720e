//! The clients of one connection, by face.

use super::{
    flags::{Face, Flags},
    pace::Pace,
    session::{Agent, Failure, Outcome, Session, outcome},
    tally::Tally,
};
use ada_diffuser::serve::grpc::pb::{ActBatchRequest, ActRequest, ActResult};
use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::{
    sync::mpsc::{Sender, UnboundedReceiver, UnboundedSender, channel, unbounded_channel},
    task::JoinSet,
    time::timeout,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;

/// The sessions on one connection, in the hands of one who paces each, or all of them together ([`Face::Batch`]).
pub struct Group {
    /// The connection.
    pub agent: Agent,
    /// Their sessions.
    pub sessions: Vec<Session>,
    /// One for each session; for a batch one alone.
    pub paces: Vec<Pace>,
}

/// Where a client sends its acts.
enum Line {
    Unary { agent: Agent, patience: Option<Duration> },
    Stream { acts: Sender<ActRequest>, results: UnboundedReceiver<ActResult> },
}

impl Line {
    async fn ask(&mut self, act: ActRequest) -> Outcome {
        let ended = || Failure::new("STREAM_ENDED");
        match self {
            Self::Unary { agent, patience: None } => Ok(agent.act(act).await?.into_inner()),
            Self::Unary { agent, patience: Some(patience) } => match timeout(*patience, agent.act(act)).await {
                Ok(answer) => Ok(answer?.into_inner()),
                Err(_) => Err(Failure::new("GAVE_UP")),
            },
            Self::Stream { acts, results } => {
                acts.send(act).await.map_err(|_| ended())?;
                outcome(results.recv().await.ok_or_else(ended)?)
            }
        }
    }
}

/// Starts the clients of a group; each task gives its sessions back at the end.
///
/// # Errors
/// If the stream cannot be opened.
pub async fn start(group: Group, flags: &Flags, tally: &Arc<Tally>, clients: &mut JoinSet<Vec<Session>>) -> Result<(), Failure> {
    let Group { agent, sessions, mut paces } = group;
    let patience = flags.give_up_ms.map(Duration::from_millis);
    let lines = match flags.face {
        Face::Unary => sessions.iter().map(|_| Line::Unary { agent: agent.clone(), patience }).collect(),
        Face::Stream => open_stream(agent, &sessions).await?,
        Face::Batch => {
            let pace = paces.pop().ok_or_else(|| Failure::new("NO_PACE"))?;
            clients.spawn(drive_batch(agent, sessions, pace, tally.clone()));
            return Ok(());
        }
    };
    for ((session, line), pace) in sessions.into_iter().zip(lines).zip(paces) {
        clients.spawn(drive(session, line, pace, tally.clone()));
    }
    Ok(())
}

async fn drive(mut session: Session, mut line: Line, mut pace: Pace, tally: Arc<Tally>) -> Vec<Session> {
    while let Some(due) = pace.next(&tally).await {
        let sent = Instant::now();
        let outcome = line.ask(session.request()).await;
        tally.record(due, sent, &outcome);
        session.settle(&outcome);
        if let Err(failure) = outcome {
            pace.pause(failure.retry_after).await;
        }
    }
    vec![session]
}

async fn drive_batch(mut agent: Agent, mut sessions: Vec<Session>, mut pace: Pace, tally: Arc<Tally>) -> Vec<Session> {
    while let Some(due) = pace.next(&tally).await {
        let sent = Instant::now();
        let acts = sessions.iter().map(Session::request).collect();
        let outcomes: Vec<Outcome> = match agent.act_batch(ActBatchRequest { acts }).await {
            Ok(answer) => answer.into_inner().results.into_iter().map(outcome).collect(),
            Err(status) => vec![Err(status.into()); sessions.len()],
        };
        for (session, outcome) in sessions.iter_mut().zip(&outcomes) {
            tally.record(due, sent, outcome);
            session.settle(outcome);
        }
        if let Some(failure) = outcomes.into_iter().find_map(Result::err) {
            pace.pause(failure.retry_after).await;
        }
    }
    sessions
}

/// One stream for all these sessions, and a task that hands out its answers.
async fn open_stream(mut agent: Agent, sessions: &[Session]) -> Result<Vec<Line>, Failure> {
    let (acts, receiver) = channel(sessions.len());
    let results = agent.act_stream(ReceiverStream::new(receiver)).await?.into_inner();
    let (mut sinks, mut lines) = (HashMap::new(), Vec::new());
    for session in sessions {
        let (sink, results) = unbounded_channel();
        sinks.insert(session.id.clone(), sink);
        lines.push(Line::Stream { acts: acts.clone(), results });
    }
    tokio::spawn(hand_out(results, sinks));
    Ok(lines)
}

/// Until the stream ends; then every client finds its line closed.
async fn hand_out(mut results: Streaming<ActResult>, sinks: HashMap<String, UnboundedSender<ActResult>>) {
    while let Ok(Some(result)) = results.message().await {
        if let Some(sink) = sinks.get(&result.session_id) {
            // A client that has gone wants no answer.
            let _unwanted = sink.send(result);
        }
    }
}
