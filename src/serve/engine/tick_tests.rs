use super::*;
use crate::model::{agent::Observation, checkpoint, options::SamplerOptions};
use std::{path::Path, sync::mpsc};

#[test]
fn rows_bound_a_tick() {
    assert!(has_room(0, 1, 2) && has_room(1, 1, 2) && !has_room(2, 1, 2));
    assert!(!has_room(1, 2, 2) && has_room(0, 64, 2), "too many for any tick is not for ever");
}

const ALONE: Load = Load { acts: 1, rows: 1 };

/// Waits until the time is over, and says what came of it.
struct Waits(Instant, mpsc::Sender<Result<Finished, Failure>>);

impl Ticket for Waits {
    fn is_wanted(&self) -> bool {
        true
    }

    fn start(&self) {}

    fn patience(&self) -> Patience {
        Patience { due: None, ends: Some(self.0) }
    }

    fn settle(self, outcome: Result<Finished, Failure>) {
        self.1.send(outcome).unwrap();
    }
}

/// A worker that was four times as slow as at warm-up, and what became of acts offered to it.
struct Slow {
    agent: Arc<Agent>,
    batch: Batch<Waits>,
    tariff: Tariff,
    told: mpsc::Sender<Result<Finished, Failure>>,
    outcomes: mpsc::Receiver<Result<Finished, Failure>>,
}

impl Slow {
    fn new() -> Self {
        let agent = Arc::new(checkpoint::load(Path::new("models/tiny")).unwrap());
        let options = EngineOptions {
            workers: 1,
            queue_len_max: 1,
            queue_bytes_max: 1,
            batch_len_max: 2,
            deadline_margin: Duration::ZERO,
            wait_max: Duration::ZERO,
            silence_max: Duration::from_secs(10),
        };
        let pulse = Arc::new(Pulse::new(options.silence_max));
        let (mut batch, tariff) = (Batch::new(options, pulse, Faults::default()), Tariff::default());
        batch.warm_up(&agent, &tariff, || true).unwrap();
        (0..100).for_each(|_| batch.slowness.note(Duration::from_secs(1), Duration::from_millis(1)));
        let (told, outcomes) = mpsc::channel();
        Self { agent, batch, tariff, told, outcomes }
    }

    /// Offers an act whose caller waits so long, or for twice what it takes, and so half of what it would take at this slowness.
    fn offer(&mut self, patience: Option<Duration>) {
        let question = Question {
            episode: Arc::new(self.agent.open(1, &self.agent.spec().sampler).unwrap()),
            observation: Observation { state: vec![0.1; 4], ..Observation::default() },
            haste: None,
        };
        let act = question.begin(&self.agent).unwrap();
        let needs = self.tariff.of(&self.agent).unwrap().act(act.evaluations_left(), ALONE);
        let now = Instant::now();
        let ticket = Waits(now + patience.unwrap_or(2 * needs + Duration::from_micros(200)), self.told.clone());
        let job = Job { agent: self.agent.clone(), question, act, ticket, submitted: now, turn_by: now, client: 0 };
        self.batch.admit(job, ALONE, &self.tariff);
    }

    /// Acts that were too late since it was last asked.
    fn late(&self) -> usize {
        self.outcomes.try_iter().filter(|outcome| matches!(outcome, Err(Failure::Late))).count()
    }
}

/// A worker that was slow for a while refuses a few acts for it, and then tries again: what it does not compute it cannot measure.
#[test]
fn a_slow_time_does_not_refuse_for_ever() {
    let (mut slow, mut late) = (Slow::new(), 0);
    while slow.batch.len() == 0 {
        slow.offer(None);
        late += slow.late();
        assert!(late < 1000, "it never tries again");
    }
}

/// While somebody is computed, a crowd that is too late tells nothing: each of them made the worker believe that it is faster, so it let in
/// the next ones, too late as well (goodput at twice the capacity fell from .73 to .08).
#[test]
fn a_late_crowd_does_not_make_it_fast() {
    let mut slow = Slow::new();
    slow.offer(Some(Duration::from_secs(3600)));
    assert_eq!(slow.batch.len(), 1);
    let before = slow.batch.slowness.get();
    (0..50).for_each(|_| slow.offer(Some(Duration::ZERO)));
    assert_eq!((slow.late(), slow.batch.len()), (50, 1));
    assert!(slow.batch.slowness.get() == before, "{before} became {}", slow.batch.slowness.get());
}

/// What is held of so many rows, and in the best case every guess of an act that evaluates several at once is borne out.
#[test]
fn rows_and_forwards_are_counted() {
    let agent = checkpoint::load(Path::new("models/tiny")).unwrap();
    let options = SamplerOptions { picard_window: 4, streaming: false, ..agent.spec().sampler.clone() };
    let act = |options: &SamplerOptions| {
        let episode = Arc::new(agent.open(1, options).unwrap());
        let observation = Observation { state: vec![0.1; 4], ..Observation::default() };
        let question = Question { episode, observation, haste: None };
        (question.begin(&agent).unwrap(), question)
    };
    let (wide, question) = act(&options);
    assert_eq!((wide.rows(), wide.evaluations_left(), question.forwards_left(&wide)), (4, 8, 2));
    let acts = [wide, act(&agent.spec().sampler).0, act(&options).0];
    assert_eq!(Load::of(&acts, 64), Load { acts: 3, rows: 9 });
    assert_eq!(Load::of(&acts, 6), Load { acts: 3, rows: 6 });
    assert_eq!(Load::of(&acts, 2), Load { acts: 2, rows: 4 }, "the largest has a tick for itself");
    assert_eq!(Load::of(&[], 2), Load { acts: 0, rows: 0 });
}
