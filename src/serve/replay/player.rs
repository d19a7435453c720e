//! One file on an engine: acts of one session after each other, those of many sessions together.

use super::{
    FileReport, Plan, ReplayError, Why,
    compare::{Difference, first_difference},
};
use crate::{
    model::{
        agent::{Agent, AgentError, Episode},
        options::SamplerOptions,
    },
    serve::{
        engine::{Engine, EngineOptions, Failure, Finished, Job, Patience, Question, Ticket},
        fault::Faults,
        recording::{
            Piece,
            format::{Act, Answer, Answered, Entry, Lost, Reset, Seen, Stands},
        },
        registry::Registry,
        session::{Handle, Record},
    },
};
use std::{
    collections::{HashMap, VecDeque},
    sync::{Arc, mpsc},
    time::Duration,
};
use tokio::time::Instant;

/// Entries that wait for their sessions, beyond what the engine can work on: a file whose sessions take turns is read no further ahead.
const AHEAD: usize = 4_096;

/// See the module.
pub(super) struct Player<'a> {
    registry: &'a Registry,
    engine: Engine<Seat>,
    sessions: HashMap<Handle, Playing>,
    told: mpsc::Sender<(Handle, Outcome)>,
    outcomes: mpsc::Receiver<(Handle, Outcome)>,
    /// Acts in the engine, and entries that wait for one of them.
    flying: usize,
    waiting: usize,
    /// Where in the file the first difference is.
    first: u64,
    read: u64,
    report: FileReport,
}

type Outcome = Result<Finished, Failure>;

/// A session that is being replayed.
struct Playing {
    /// Of its acts in the engine.
    number: u64,
    /// Where it stands; or why it cannot go on.
    stands: Result<Standing, Why>,
    /// Its act in the engine, and where in the file it is.
    flying: Option<(u64, Box<Act>)>,
    /// What comes then.
    waiting: VecDeque<(u64, Entry)>,
}

struct Standing {
    agent: Arc<Agent>,
    episode: Arc<Episode>,
    /// Resets, and acts since.
    at: (u64, u64),
}

/// Brings an outcome back.
struct Seat {
    session: Handle,
    told: mpsc::Sender<(Handle, Outcome)>,
}

impl Ticket for Seat {
    fn is_wanted(&self) -> bool {
        true
    }

    fn start(&self) {}

    fn patience(&self) -> Patience {
        Patience::default()
    }

    fn settle(self, outcome: Outcome) {
        // Nobody listens any more where the replay has ended.
        let _gone = self.told.send((self.session, outcome));
    }
}

impl<'a> Player<'a> {
    pub(super) fn new(registry: &'a Registry, plan: &Plan, report: FileReport) -> Result<Self, ReplayError> {
        let options = EngineOptions {
            workers: plan.workers,
            queue_len_max: usize::MAX,
            queue_bytes_max: usize::MAX,
            batch_len_max: plan.batch,
            deadline_margin: Duration::ZERO,
            wait_max: Duration::MAX,
            // Nobody asks whether it lives.
            silence_max: Duration::MAX,
        };
        let (told, outcomes) = mpsc::channel();
        Ok(Self {
            registry,
            engine: Engine::start(options, Faults::default()).map_err(ReplayError::Engine)?,
            sessions: HashMap::new(),
            told,
            outcomes,
            flying: 0,
            waiting: 0,
            first: u64::MAX,
            read: 0,
            report,
        })
    }

    /// The next piece of the file.
    pub(super) fn play(&mut self, piece: Piece) {
        self.read += 1;
        match piece {
            Piece::Entry(entry) => self.read(entry),
            Piece::Damaged => self.report.damaged += 1,
            Piece::Cut => self.report.cut = true,
            Piece::Broken => self.report.broken = true,
        }
        while self.flying + self.waiting > AHEAD {
            self.land();
        }
    }

    /// Whatever is under way comes to its end.
    pub(super) fn finish(mut self) -> FileReport {
        while self.flying > 0 {
            self.land();
        }
        self.report.sessions = self.sessions.len();
        self.report
    }

    fn read(&mut self, entry: Entry) {
        let session = match &entry {
            Entry::Header(_) => return,
            Entry::Lost(Lost { entries }) => return self.report.lost += entries,
            Entry::Stands(stands) => stands.session,
            Entry::Act(act) => act.session,
            Entry::Reset(reset) => reset.session,
        };
        match &entry {
            Entry::Act(act) => {
                self.report.acts += 1;
                self.report.degraded += u64::from(is_degraded(act));
            }
            Entry::Reset(_) => self.report.resets += 1,
            Entry::Header(_) | Entry::Lost(_) | Entry::Stands(_) => {}
        }
        let number = self.sessions.len() as u64;
        let fresh = || Playing { number, stands: Err(Why::Gap), flying: None, waiting: VecDeque::new() };
        self.sessions.entry(session).or_insert_with(fresh).waiting.push_back((self.read, entry));
        self.waiting += 1;
        self.go_on(session);
    }

    /// One act ends. Its session goes on.
    fn land(&mut self) {
        let Ok((session, outcome)) = self.outcomes.recv() else { return };
        let Some(playing) = self.sessions.get_mut(&session) else { return };
        let (Some((at, act)), Ok(standing)) = (playing.flying.take(), &mut playing.stands) else { return };
        self.flying -= 1;
        let difference = match outcome {
            Ok(Finished { episode, chunk, .. }) => {
                (standing.episode, standing.at) = (Arc::new(episode), (act.episode, act.step));
                match &act.answer {
                    Answered::Answer(expected) => first_difference(expected, &Answer::of(&chunk)),
                    Answered::Outline(_) => None,
                }
            }
            Err(failure) => Some(("act".to_owned(), "answered".to_owned(), reason(&failure))),
        };
        if difference.is_some() {
            playing.stands = Err(Why::AfterDifference);
        }
        self.compared(at, &act, difference);
        self.go_on(session);
    }

    fn compared(&mut self, at: u64, act: &Act, difference: Option<(String, String, String)>) {
        let Some((field, expected, found)) = difference else {
            self.report.equal += 1;
            return;
        };
        self.report.different += 1;
        if at < self.first {
            let Act { session, episode, step, .. } = *act;
            (self.first, self.report.first) = (at, Some(Difference { session, episode, step, field, expected, found }));
        }
    }

    /// What waits for a session, up to its next act.
    fn go_on(&mut self, session: Handle) {
        while let Some(playing) = self.sessions.get_mut(&session).filter(|playing| playing.flying.is_none())
            && let Some((at, entry)) = playing.waiting.pop_front()
        {
            self.waiting -= 1;
            match entry {
                Entry::Stands(stands) => {
                    let taken_up = self.take_up(&stands);
                    if let Some(playing) = self.sessions.get_mut(&session) {
                        playing.stands = taken_up;
                    }
                }
                Entry::Reset(reset) => playing.reset(&reset),
                Entry::Act(act) => self.act(session, at, act),
                Entry::Header(_) | Entry::Lost(_) => {}
            }
        }
    }

    fn take_up(&mut self, stands: &Stands) -> Result<Standing, Why> {
        let Stands { model, model_digest, seed, options, episode, step, record, .. } = stands;
        if !self.report.header.observations {
            return Err(Why::Withheld);
        }
        let Ok(found) = self.registry.pinned(model, model_digest) else {
            let name = format!("{model}@{model_digest}");
            if !self.report.missing_models.contains(&name) {
                self.report.missing_models.push(name);
            }
            return Err(Why::NoModel);
        };
        let agent = found.agent.clone();
        let taken_up = match record {
            Some(bytes) => Record::read(&bytes.0).ok().and_then(|record| record.standing(&agent).ok()).map(|(episode, _)| episode),
            None => agent.open(*seed, &options.clone().onto(&SamplerOptions::default())).ok().map(Arc::new),
        };
        Ok(Standing { agent, episode: taken_up.ok_or(Why::BadSession)?, at: (*episode, *step) })
    }

    fn act(&mut self, session: Handle, at: u64, act: Box<Act>) {
        let Some(playing) = self.sessions.get_mut(&session) else { return };
        let next = |standing: &Standing| (standing.at.0, standing.at.1 + 1) == (act.episode, act.step);
        let standing = match &playing.stands {
            Ok(standing) if next(standing) => standing,
            Ok(_) => return self.pass_over(session, Why::Gap),
            Err(why) => {
                let why = *why;
                return self.pass_over(session, why);
            }
        };
        let Seen::Observation(observation) = &act.seen else { return self.pass_over(session, Why::Withheld) };
        let question = Question { episode: standing.episode.clone(), observation: observation.clone(), haste: act.haste.clone() };
        let (agent, number, now) = (standing.agent.clone(), playing.number, Instant::now());
        let difference = match question.begin(&agent) {
            Ok(begun) => {
                let ticket = Seat { session, told: self.told.clone() };
                let job = Job { agent, question, act: begun, ticket, submitted: now, turn_by: now, client: number };
                match self.engine.submit(job) {
                    Ok(_waiting) => {
                        playing.flying = Some((at, act));
                        self.flying += 1;
                        return;
                    }
                    Err((refusal, _)) => format!("{refusal:?}"),
                }
            }
            Err(failure) => reason(&failure),
        };
        playing.stands = Err(Why::AfterDifference);
        self.compared(at, &act, Some(("act".to_owned(), "answered".to_owned(), difference)));
    }

    /// An act that cannot be compared; so it is with those that follow, until its session is written down anew.
    fn pass_over(&mut self, session: Handle, why: Why) {
        if let Some(playing) = self.sessions.get_mut(&session) {
            playing.stands = Err(why);
        }
        *self.report.not_compared.entry(why).or_default() += 1;
    }
}

impl Playing {
    fn reset(&mut self, reset: &Reset) {
        let Reset { session: _, episode, seed, keep_history } = *reset;
        let Ok(standing) = &mut self.stands else { return };
        if standing.at.0 + 1 != episode {
            self.stands = Err(Why::Gap);
            return;
        }
        match standing.agent.reset(&standing.episode, seed, keep_history) {
            Ok(renewed) => (standing.episode, standing.at) = (Arc::new(renewed), (episode, 0)),
            Err(_) => self.stands = Err(Why::BadSession),
        }
    }
}

fn is_degraded(act: &Act) -> bool {
    match &act.answer {
        Answered::Answer(answer) => answer.degraded,
        Answered::Outline(outline) => outline.degraded,
    }
}

fn reason(failure: &Failure) -> String {
    match failure {
        Failure::Agent(error) => AgentError::to_string(error),
        Failure::Panic => "a panic of the model".to_owned(),
        Failure::Late | Failure::Displaced | Failure::Stopped => format!("{failure:?}"),
    }
}
