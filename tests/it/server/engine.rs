//! The engine by itself: a poisoned batch, and the end.

use super::{methods::fresh, models_dir};
use ada_diffuser::{
    model::{
        agent::{Agent, Observation},
        checkpoint,
        config::ModelConfig,
        method::{Diffused, Head, Inverse},
        normalizer::Affine,
        options::SamplerOptions,
    },
    serve::{
        engine::{Engine, EngineOptions, Failure, Finished, Job, Patience, Question, Refusal, Ticket},
        fault::Faults,
    },
};
use std::{
    panic::panic_any,
    sync::{Arc, mpsc},
    time::Duration,
};
use tokio::time::Instant;

pub type Outcome = Result<Finished, Failure>;

/// A ticket that can hold up the worker when its act is taken from the queue.
pub struct Seat {
    outcome: mpsc::Sender<Outcome>,
    gate: Option<mpsc::Receiver<()>>,
    patience: Patience,
    /// What it panics with when its act is taken.
    pub panics: Option<Bomb>,
}

/// A panic that goes off again so many times where it is caught.
#[derive(Clone, Copy)]
pub struct Bomb(pub u32);

/// What is thrown: it was copied here, for a drop is what sets it off.
struct Thrown(Bomb);

impl Drop for Thrown {
    fn drop(&mut self) {
        if let Some(left) = self.0.0.checked_sub(1) {
            panic_any(Thrown(Bomb(left)));
        }
    }
}

impl Ticket for Seat {
    fn is_wanted(&self) -> bool {
        true
    }

    fn start(&self) {
        if let Some(bomb) = self.panics {
            // As a log line once did, when nobody read the log.
            panic_any(Thrown(bomb));
        }
        if let Some(gate) = &self.gate {
            gate.recv().unwrap();
        }
    }

    fn patience(&self) -> Patience {
        self.patience
    }

    fn settle(self, outcome: Outcome) {
        // A test that has seen enough does not listen any more.
        let _unheard = self.outcome.send(outcome);
    }
}

pub fn agent(name: &str) -> Arc<Agent> {
    Arc::new(checkpoint::load(&models_dir().join(name)).unwrap())
}

pub fn fresh_agent(adjust: impl FnOnce(&mut ModelConfig)) -> Arc<Agent> {
    Arc::new(checkpoint::load(&fresh(adjust).path().join("fresh")).unwrap())
}

/// Of states with one value less than the others take.
fn narrow(config: &mut ModelConfig) {
    config.layout.state_dim -= 1;
    config.units.normalizer.state = Affine::identity(config.layout.state_dim);
    config.units.normalizer.state_change_std.pop();
}

/// A plan of states, whose actions are found afterwards.
fn inverse(config: &mut ModelConfig) {
    config.method.plan.diffused = Diffused::State;
    config.method.head = Head::Inverse { network: Inverse::Mlp { width: 8 }, latent: true };
    config.trained.action_horizons.retain(|actions| *actions < 8);
}

/// An act of `asked` that is run on `run_on`.
pub fn job(asked: &Agent, run_on: &Arc<Agent>, seed: u64) -> (Job<Seat>, mpsc::Receiver<Outcome>) {
    job_with(asked, run_on, seed, &asked.spec().sampler)
}

fn job_with(asked: &Agent, run_on: &Arc<Agent>, seed: u64, options: &SamplerOptions) -> (Job<Seat>, mpsc::Receiver<Outcome>) {
    let episode = Arc::new(asked.open(seed, options).unwrap());
    let observation = Observation { state: vec![0.1; asked.spec().layout.state_dim], ..Observation::default() };
    let question = Question { episode, observation, haste: None };
    let act = question.begin(asked).unwrap();
    let (outcome, receiver) = mpsc::channel();
    let ticket = Seat { outcome, gate: None, patience: Patience::default(), panics: None };
    let now = Instant::now();
    (Job { agent: run_on.clone(), question, act, ticket, submitted: now, turn_by: now, client: seed }, receiver)
}

fn one_worker(batch_len_max: usize) -> Engine<Seat> {
    engine(1, batch_len_max, Faults::default())
}

pub fn engine(workers: usize, batch_len_max: usize, faults: Faults) -> Engine<Seat> {
    let silence_max = Duration::from_millis(400);
    engine_of(workers, batch_len_max, silence_max, faults)
}

pub fn engine_of(workers: usize, batch_len_max: usize, silence_max: Duration, faults: Faults) -> Engine<Seat> {
    let options = EngineOptions {
        workers,
        queue_len_max: 64,
        queue_bytes_max: 1 << 20,
        batch_len_max,
        deadline_margin: Duration::ZERO,
        wait_max: Duration::from_secs(60),
        silence_max,
    };
    Engine::start(options, faults).unwrap()
}

/// An act of another model makes the shared forward fail; its batch mates are answered as if it had not been there.
#[test]
fn a_poisoned_act_fails_alone() {
    let (tiny, narrow) = (agent("tiny"), fresh_agent(narrow));
    let engine = one_worker(64);
    let (open_gate, gate) = mpsc::channel();
    let mut gate = Some(gate);
    let (mut outcomes, mut expected) = (Vec::new(), Vec::new());
    for seed in 0..6 {
        let (mut job, outcome) = job(&tiny, &tiny, seed);
        expected.push(tiny.act(&job.question.episode, &job.question.observation).unwrap().1);
        job.ticket.gate = gate.take();
        assert!(engine.submit(job).is_ok());
        outcomes.push(outcome);
    }
    let (poison, poisoned) = job(&narrow, &tiny, 1);
    assert!(engine.submit(poison).is_ok());
    open_gate.send(()).unwrap();
    for (outcome, expected) in outcomes.into_iter().zip(expected) {
        assert_eq!(outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk, expected);
    }
    let failed = poisoned.recv_timeout(Duration::from_secs(20)).unwrap();
    assert!(matches!(failed, Err(Failure::Panic | Failure::Agent(_))), "{failed:?}");
    assert!(engine.heartbeat_age() < Duration::from_secs(2), "the worker lives");
}

/// Whatever panics outside of the model took the thread with it, and after as many acts as there are threads the engine was gone for good,
/// with every probe green. It costs the acts of that batch, and they are told.
#[test]
fn a_panic_outside_of_the_model_costs_its_batch_alone() {
    let tiny = agent("tiny");
    let engine = one_worker(8);
    engine.warm_up(&tiny).unwrap();
    for seed in 0..3 {
        let (mut bad, given_up) = job(&tiny, &tiny, seed);
        bad.ticket.panics = Some(Bomb(0));
        assert!(engine.submit(bad).is_ok());
        assert!(given_up.recv_timeout(Duration::from_secs(20)).is_err(), "its ticket was dropped");
        let (good, outcome) = job(&tiny, &tiny, seed);
        let expected = tiny.act(&good.question.episode, &good.question.observation).unwrap().1;
        assert!(engine.submit(good).is_ok());
        assert_eq!(outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk, expected);
    }
    while engine.load() != (0, 0) {
        std::thread::yield_now();
    }
    assert!(engine.heartbeat_age() < Duration::from_secs(2));
}

#[test]
fn the_end_fails_what_is_left_and_refuses_what_comes() {
    let slow = agent("slow");
    let engine = one_worker(1);
    let (first, running) = job(&slow, &slow, 1);
    let (second, waiting) = job(&slow, &slow, 2);
    assert!(engine.submit(first).is_ok() && engine.submit(second).is_ok());
    while engine.load() != (1, 1) {
        std::thread::yield_now();
    }
    let begin = Instant::now();
    engine.stop(Duration::from_secs(5));
    assert!(begin.elapsed() < Duration::from_secs(2));
    for outcome in [running, waiting] {
        assert!(matches!(outcome.recv().unwrap(), Err(Failure::Stopped)));
    }
    let (late, _outcome) = job(&slow, &slow, 3);
    assert!(matches!(engine.submit(late), Err((Refusal::Closed, _))));
}

/// An act in a hurry takes what its time allows, and says so; one with time enough is as if it had no deadline.
#[test]
fn a_deadline_makes_larger_jumps() {
    let (slow, tiny) = (agent("slow"), agent("tiny"));
    let engine = one_worker(8);
    engine.warm_up(&slow).unwrap();
    engine.warm_up(&tiny).unwrap();
    let act = |mut job: Job<Seat>, outcome: mpsc::Receiver<Outcome>, due: Instant| {
        job.ticket.patience.due = Some(due);
        assert!(engine.submit(job).is_ok());
        outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap()
    };
    let (hasty, outcome) = job(&slow, &slow, 1);
    let finished = act(hasty, outcome, Instant::now() + Duration::from_millis(400));
    assert!(finished.chunk.degraded && finished.compute < Duration::from_secs(10));
    let (late, outcome) = job(&slow, &slow, 1);
    let finished = act(late, outcome, Instant::now());
    assert_eq!((finished.chunk.degraded, finished.chunk.evaluations), (true, 1), "nothing to give out before the first evaluation");
    let (mut next, outcome) = job(&slow, &slow, 1);
    next.question.episode = Arc::new(finished.episode);
    next.act = next.question.begin(&slow).unwrap();
    let finished = act(next, outcome, Instant::now());
    assert_eq!((finished.chunk.degraded, finished.chunk.evaluations), (true, 0), "the window of the act before");
    let (calm, outcome) = job(&tiny, &tiny, 3);
    let expected = tiny.act(&calm.question.episode, &calm.question.observation).unwrap().1;
    assert_eq!(act(calm, outcome, Instant::now() + Duration::from_secs(3600)).chunk, expected);
}

/// An act of more rows than a batch holds has a tick for itself, and those of fewer go on together; all are answered as if they were alone.
#[test]
fn acts_of_many_rows_are_served_among_others() {
    let (tiny, engine) = (agent("tiny"), one_worker(2));
    engine.warm_up(&tiny).unwrap();
    let windows = [8, 1, 2, 1, 8, 1];
    let acts = windows.into_iter().enumerate().map(|(seed, picard_window)| {
        let options = SamplerOptions { picard_window, streaming: false, ..tiny.spec().sampler.clone() };
        let (job, outcome) = job_with(&tiny, &tiny, seed as u64, &options);
        let expected = tiny.act(&job.question.episode, &job.question.observation).unwrap().1;
        assert!(engine.submit(job).is_ok());
        (outcome, expected)
    });
    for (outcome, expected) in acts.collect::<Vec<_>>() {
        assert_eq!(outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk, expected);
    }
}

/// A plan that a deadline cut short still asks for the actions between its states: in a batch, and alone after a batch that failed.
#[test]
fn a_plan_that_is_cut_short_gets_its_actions() {
    let (planner, poison) = (fresh_agent(inverse), fresh_agent(|config| (narrow(config), inverse(config)).0));
    for is_poisoned in [false, true] {
        let engine = one_worker(8);
        engine.warm_up(&planner).unwrap();
        let (first, outcome) = job(&planner, &planner, 1);
        assert!(engine.submit(first).is_ok());
        let before = outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap();
        let (mut late, outcome) = job(&planner, &planner, 1);
        late.question.episode = Arc::new(before.episode);
        late.act = late.question.begin(&planner).unwrap();
        late.ticket.patience.due = Some(Instant::now());
        let (open_gate, gate) = mpsc::channel();
        late.ticket.gate = Some(gate);
        let (bad, poisoned) = job(&poison, &planner, 2);
        assert!(engine.submit(late).is_ok());
        assert!(!is_poisoned || engine.submit(bad).is_ok());
        open_gate.send(()).unwrap();
        let chunk = outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk;
        assert_eq!((chunk.degraded, chunk.evaluations, chunk.actions.len()), (true, 0, 1), "poisoned: {is_poisoned}");
        assert!(!is_poisoned || poisoned.recv_timeout(Duration::from_secs(20)).unwrap().is_err());
    }
}

/// A model that nobody warmed up is served all the same; only, its acts are never hurried.
#[test]
fn without_warm_up_nobody_hurries() {
    let (tiny, engine) = (agent("tiny"), one_worker(8));
    let (mut late, outcome) = job(&tiny, &tiny, 3);
    late.ticket.patience = Patience { due: Some(Instant::now()), ends: Some(Instant::now()) };
    let expected = tiny.act(&late.question.episode, &late.question.observation).unwrap().1;
    assert!(engine.submit(late).is_ok());
    assert_eq!(outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk, expected);
}

/// What nobody will wait for is not computed: it is refused when it comes, if that is known then, and else dropped when it has its turn.
#[test]
fn late_acts_are_not_computed() {
    let (slow, tiny) = (agent("slow"), agent("tiny"));
    let engine = one_worker(1);
    engine.warm_up(&slow).unwrap();
    engine.warm_up(&tiny).unwrap();
    let after = |ms| Some(Instant::now() + Duration::from_millis(ms));
    let (mut hopeless, _) = job(&slow, &slow, 1);
    hopeless.ticket.patience.ends = after(500);
    assert!(matches!(engine.submit(hopeless), Err((Refusal::Late, _))), "an act of minutes");
    let (mut first, _running) = job(&tiny, &tiny, 2);
    let (open_gate, gate) = mpsc::channel();
    first.ticket.gate = Some(gate);
    assert!(engine.submit(first).is_ok());
    let (mut waits, outcome) = job(&tiny, &tiny, 3);
    waits.ticket.patience.ends = after(300);
    assert!(engine.submit(waits).is_ok(), "it had time enough when it came");
    std::thread::sleep(Duration::from_millis(400));
    open_gate.send(()).unwrap();
    assert!(matches!(outcome.recv_timeout(Duration::from_secs(20)).unwrap(), Err(Failure::Late)));
}

#[test]
fn an_ended_engine_does_not_warm_up() {
    let engine = one_worker(2);
    engine.stop(Duration::from_secs(5));
    assert!(matches!(engine.warm_up(&agent("tiny")), Err(Failure::Stopped)));
}
