//! The engine's threads: one that is gone or hangs has its place taken, one that is busy has not.

use super::engine::{Bomb, Outcome, Seat, agent, engine, engine_of, fresh_agent, job};
use ada_diffuser::{
    model::{agent::Agent, method::Backbone},
    serve::{
        engine::{Engine, Job},
        fault::Faults,
    },
};
use std::{
    sync::{Arc, mpsc::Receiver},
    thread::sleep,
    time::{Duration, Instant},
};

/// An act that is known to faults by this value.
fn marked(agent: &Arc<Agent>, seed: u64, first: f32) -> (Job<Seat>, Receiver<Outcome>) {
    let (mut job, outcome) = job(agent, agent, seed);
    job.question.observation.state[0] = first;
    (job, outcome)
}

fn faults(texts: &[&str]) -> Faults {
    Faults::new(&texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<_>>())
}

/// Whether an act is computed, as it should be, while somebody watches.
fn serves(engine: &Engine<Seat>, agent: &Arc<Agent>, patience: Duration) -> bool {
    let (job, outcome) = job(agent, agent, 5);
    let expected = agent.act(&job.question.episode, &job.question.observation).unwrap().1;
    assert!(engine.submit(job).is_ok());
    let end = Instant::now() + patience;
    while Instant::now() < end {
        engine.watch();
        if let Ok(answered) = outcome.recv_timeout(Duration::from_millis(20)) {
            assert_eq!(answered.unwrap().chunk, expected);
            return true;
        }
    }
    false
}

/// What goes off again wherever it is caught takes the thread along. Its place is taken, and those who wait are served.
#[test]
fn a_thread_that_is_gone_is_replaced() {
    let tiny = agent("tiny");
    let engine = engine(1, 8, Faults::default());
    engine.warm_up(&tiny).unwrap();
    // Caught around the ticket, then around the worker, and nobody catches it any more.
    let (mut bad, given_up) = job(&tiny, &tiny, 1);
    bad.ticket.panics = Some(Bomb(2));
    assert!(engine.submit(bad).is_ok());
    assert!(given_up.recv_timeout(Duration::from_secs(20)).is_err(), "its ticket was dropped");
    let (next, outcome) = job(&tiny, &tiny, 2);
    assert!(engine.submit(next).is_ok());
    assert!(outcome.recv_timeout(Duration::from_millis(600)).is_err(), "nobody is there");
    engine.watch();
    outcome.recv_timeout(Duration::from_secs(20)).unwrap().unwrap();
    assert_eq!(engine.silent(), 0);
    assert!(serves(&engine, &tiny, Duration::from_secs(20)));
}

/// Whoever hangs is seen, what waits is computed by others, and no more threads are made than there are places; who comes back ends what it holds.
#[test]
fn one_that_hangs_is_relieved() {
    let tiny = agent("tiny");
    let engine = engine(2, 1, faults(&["evaluating=hang@state=7", "evaluating=hang:1500@state=8"]));
    engine.warm_up(&tiny).unwrap();
    let hang = |first: f32| {
        let silent = engine.silent();
        let (job, outcome) = marked(&tiny, 3, first);
        assert!(engine.submit(job).is_ok());
        let begin = Instant::now();
        while engine.silent() == silent {
            assert!(begin.elapsed() < Duration::from_secs(10), "nobody sees it");
            sleep(Duration::from_millis(5));
        }
        assert!(begin.elapsed() >= Duration::from_millis(390), "{:?}", begin.elapsed());
        outcome
    };
    let back = hang(8.0);
    assert!(serves(&engine, &tiny, Duration::from_secs(20)));
    back.recv_timeout(Duration::from_secs(20)).unwrap().unwrap();
    while engine.silent() > 0 {
        sleep(Duration::from_millis(5));
    }
    for lost in 1..=3 {
        let _unanswered = hang(7.0);
        assert!(serves(&engine, &tiny, Duration::from_secs(20)), "{lost} hang");
        assert_eq!(engine.silent(), lost);
    }
    let _unanswered = hang(7.0);
    assert!(!serves(&engine, &tiny, Duration::from_secs(1)), "two were relieved, and two hang in the places of those");
    assert!(engine.heartbeat_age() > Duration::from_secs(1));
    let begin = Instant::now();
    engine.stop(Duration::from_millis(200));
    assert!(begin.elapsed() < Duration::from_secs(1));
}

/// A model whose evaluations take much longer than a worker may be silent: nobody takes its worker for lost, at warm-up or at work.
#[test]
fn one_that_is_busy_is_not() {
    let large = fresh_agent(|config| config.method.plan.backbone = Backbone::Unet { widths: vec![192, 384, 384] });
    let silence_max = Duration::from_millis(20);
    let engine = Arc::new(engine_of(1, 8, silence_max, Faults::default()));
    let (warm, its_own) = (engine.clone(), large.clone());
    let warming = std::thread::spawn(move || warm.warm_up(&its_own).unwrap());
    // It may have idled before.
    sleep(Duration::from_millis(300));
    let mut oldest = Duration::ZERO;
    // The test's machine may let it wait between two evaluations, and an idle one shows itself more seldom than this: who is silent has a moment.
    let mut look = |is_over: &dyn Fn() -> bool| {
        oldest = oldest.max(engine.heartbeat_age());
        if engine.silent() > 0 {
            sleep(Duration::from_millis(100));
            assert!(engine.silent() == 0 || is_over(), "it is taken for lost");
        }
        sleep(Duration::from_millis(1));
    };
    while !warming.is_finished() {
        look(&|| warming.is_finished());
    }
    warming.join().unwrap();
    let outcomes: Vec<_> = (0..8)
        .map(|seed| {
            let (job, outcome) = job(&large, &large, seed);
            assert!(engine.submit(job).is_ok());
            outcome
        })
        .collect();
    while engine.load().1 == 0 {}
    while engine.load() != (0, 0) {
        look(&|| engine.load() == (0, 0));
    }
    outcomes.into_iter().for_each(|outcome| drop(outcome.recv().unwrap().unwrap()));
    assert!(oldest > 2 * silence_max, "it was never busy: {oldest:?}");
}
