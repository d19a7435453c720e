//! The engine by itself: a poisoned batch, and the end.

use super::models_dir;
use ada_diffuser::{
    model::{
        agent::{Agent, Observation},
        checkpoint,
    },
    serve::engine::{Engine, Failure, Finished, Job, Question, Refusal, Ticket},
};
use std::{
    sync::{Arc, mpsc},
    time::{Duration, Instant},
};

type Outcome = Result<Finished, Failure>;

struct Seat(mpsc::Sender<Outcome>);

impl Ticket for Seat {
    fn is_wanted(&self) -> bool {
        true
    }

    fn start(&self) {}

    fn settle(self, outcome: Outcome) {
        // A test that has seen enough does not listen any more.
        let _unheard = self.0.send(outcome);
    }
}

fn agent(name: &str) -> Arc<Agent> {
    Arc::new(checkpoint::load(&models_dir().join(name)).unwrap())
}

/// An act of `asked` that is run on `run_on`.
fn job(asked: &Agent, run_on: &Arc<Agent>, seed: u64) -> (Job<Seat>, mpsc::Receiver<Outcome>) {
    let episode = Arc::new(asked.open(seed, &asked.spec().sampler).unwrap());
    let observation = Observation { state: vec![0.1, 0.2, 0.3, 0.4], executed: vec![] };
    let question = Question { episode, observation };
    let descent = question.begin(asked).unwrap();
    let (sender, receiver) = mpsc::channel();
    (Job { agent: run_on.clone(), question, descent, ticket: Seat(sender), submitted: Instant::now() }, receiver)
}

/// An act whose ladder the model does not have makes the shared forward fail or panic; its batch mates are answered as if it had not been there.
#[test]
fn a_poisoned_act_fails_alone() {
    let (tiny, slow) = (agent("tiny"), agent("slow"));
    let engine = Engine::start(1, 64, 64).unwrap();
    let (good, expected): (Vec<_>, Vec<_>) = (0..6)
        .map(|seed| {
            let (job, outcome) = job(&tiny, &tiny, seed);
            let expected = tiny.act(&job.question.episode, &job.question.observation).unwrap().1;
            ((job, outcome), expected)
        })
        .unzip();
    let (poison, poisoned) = job(&slow, &tiny, 1);
    let mut outcomes = Vec::new();
    let mut poison = Some(poison);
    for (i, (job, outcome)) in good.into_iter().enumerate() {
        assert!(engine.submit(job).is_ok());
        outcomes.push(outcome);
        if i == 2 {
            assert!(engine.submit(poison.take().unwrap()).is_ok());
        }
    }
    for (outcome, expected) in outcomes.into_iter().zip(expected) {
        assert_eq!(outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().chunk, expected);
    }
    let failed = poisoned.recv_timeout(Duration::from_secs(20)).unwrap();
    assert!(matches!(failed, Err(Failure::Panic | Failure::Agent(_))), "{failed:?}");
    assert!(engine.heartbeat_age() < Duration::from_secs(2), "the worker lives");
}

#[test]
fn the_end_fails_what_is_left_and_refuses_what_comes() {
    let slow = agent("slow");
    let engine = Engine::start(1, 64, 1).unwrap();
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
