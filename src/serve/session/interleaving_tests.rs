//! One session and all who may come to it at the same time, in one order after the other.

use super::{lock::interleaved::check, *};
use crate::{
    model::{agent::Observation, checkpoint},
    serve::{
        config::SessionsConfig,
        store::{Change, Version, Write},
    },
};
use futures_util::FutureExt;
use parking_lot::Mutex;
use shuttle::thread;
use std::{path::Path, sync::LazyLock};

/// An act, computed once, and not by one of the scheduler's threads: what is tried is who comes when.
struct Act {
    agent: Arc<Agent>,
    begun: Arc<Episode>,
    after: Arc<Episode>,
    chunk: Arc<Chunk>,
    key: Key,
}

static ACT: LazyLock<Act> = LazyLock::new(|| {
    let agent = Arc::new(checkpoint::load(Path::new("models/tiny")).unwrap());
    let begun = agent.open(1, &agent.config().defaults.sampler).unwrap();
    let seen = Observation { state: vec![0.1; 4], ..Observation::default() };
    let (after, chunk) = agent.act(&begun, &seen).unwrap();
    Act { agent, begun: Arc::new(begun), after: Arc::new(after), chunk: Arc::new(chunk), key: key_of(&seen) }
});

/// A session and what its store has of it: where it stands, and how often its first act was kept.
#[derive(Clone)]
struct World {
    sessions: Arc<Sessions>,
    session: Arc<Session>,
    store: Option<Arc<Mutex<(Version, usize)>>>,
}

impl World {
    fn new(has_store: bool) -> Self {
        let sessions = Sessions::new(SessionsConfig::default(), None);
        let (ttl, request_id) = (Duration::from_secs(60), String::new());
        let (agent, episode, standing) = (ACT.agent.clone(), ACT.begun.clone(), Standing::default());
        let opening = Opening { model: "tiny".into(), agent, episode, standing, ttl, request_id, known: None };
        let session = sessions.open(opening, Instant::now()).unwrap();
        let version = Version::at(&session.agent.spec().digest, 0, 0);
        Self { sessions: Arc::new(sessions), session, store: has_store.then(|| Arc::new(Mutex::new((version, 0)))) }
    }

    /// Of one server that writes all there is, nothing is ever refused.
    fn keeps(&self, write: &Write) {
        let Change::Keep { from, bytes, .. } = &write.change else { panic!("nothing is freed here") };
        let mut kept = self.store.as_ref().unwrap().lock();
        assert_eq!(*from, Some(kept.0), "memory and store have parted");
        kept.0 = Version::of(bytes).unwrap();
        kept.1 += usize::from((kept.0.episode, kept.0.step) == (0, 1));
    }

    /// What the engine and the store do with an act.
    fn compute(&self, flight: &Arc<Flight>) {
        if !flight.is_wanted() {
            return;
        }
        let (id, model, model_digest) = (self.session.id, self.session.model.clone(), String::new());
        let answer = Answer { session: id, step: 1, chunk: ACT.chunk.clone(), timings: Timings::default(), model, model_digest };
        if self.store.is_some() {
            match self.session.about_to_commit(flight, &ACT.after, &answer).unwrap() {
                Some(write) => self.keeps(&write),
                None => return self.session.fail(flight, ServiceError::SessionNotFound),
            }
        }
        self.session.commit(flight, ACT.after.clone(), Arc::new(answer), None);
    }

    /// Somebody asks for the first act, and has no time to wait; says what it is told.
    fn ask(&self) -> Option<Arc<Answer>> {
        match self.session.enter((Some(0), 1), ACT.key, Instant::now(), Default::default()) {
            Ok(Entry::Replay(answer)) => Some(answer),
            Ok(Entry::Join(waiter)) => waiter.give_up(),
            Ok(Entry::Lead(waiter, _)) => {
                let (its, flight) = (self.clone(), waiter.flight().clone());
                let engine = thread::spawn(move || its.compute(&flight));
                let told = waiter.give_up();
                engine.join().unwrap();
                told
            }
            Err(ServiceError::SessionBusy { .. } | ServiceError::EpisodeOver { .. }) => None,
            Err(error) => panic!("{error}"),
        }
    }

    /// Somebody asks for it and waits for as long as it takes; None: there is another episode by now.
    fn wait(&self) -> Option<Arc<Answer>> {
        let (waiter, engine) = loop {
            match self.session.enter((Some(0), 1), ACT.key, Instant::now(), Default::default()) {
                Ok(Entry::Replay(answer)) => return Some(answer),
                Ok(Entry::Join(waiter)) => break (waiter, None),
                Ok(Entry::Lead(waiter, _)) => {
                    let (its, flight) = (self.clone(), waiter.flight().clone());
                    break (waiter, Some(thread::spawn(move || its.compute(&flight))));
                }
                Err(ServiceError::EpisodeOver { .. }) => return None,
                Err(ServiceError::SessionBusy { .. }) => thread::yield_now(),
                Err(error) => panic!("{error}"),
            }
        };
        let outcome = loop {
            match waiter.outcome().now_or_never() {
                Some(outcome) => break outcome,
                None => thread::yield_now(),
            }
        };
        engine.into_iter().for_each(|engine| engine.join().unwrap());
        Some(outcome.expect("whoever waits is answered, whoever leaves"))
    }

    /// A new episode, if nothing is in the way.
    fn reset(&self) {
        let renewal = Renewal { seed: 2, keep_history: false };
        match self.session.begin_reset(renewal, None, "again".into(), Instant::now()) {
            Ok(Some(reset)) => {
                if self.store.is_some() {
                    self.keeps(&self.session.about_to_reset(&reset).unwrap());
                }
                self.session.finish_reset(Some(reset), None);
            }
            Ok(None) => panic!("nobody else resets it"),
            Err(ServiceError::SessionBusy { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }

    /// In the end memory is as the store is, what it holds is counted, and the session goes on.
    fn settle(&self) -> (u64, u64) {
        let (episode, standing) = self.session.standing((None, None)).unwrap();
        let at = (standing.resets, standing.step);
        if let Some(store) = &self.store {
            let (version, count) = *store.lock();
            assert_eq!((version.episode, version.step), at, "memory and store have parted");
            assert!(count <= 1, "the act was kept {count} times");
        }
        assert_eq!(self.sessions.bytes(), episode.size_bytes(), "of each episode once");
        let next = self.session.enter((Some(at.0), at.1 + 1), ACT.key, Instant::now(), Default::default());
        assert!(matches!(next, Ok(Entry::Lead(..))), "it is stuck");
        at
    }
}

/// An act that was committed while its caller's time ran out was answered with a deadline and "nothing was changed".
#[test]
fn a_deadline_at_the_commit_is_told_the_truth() {
    let (told, silent) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let counts = (told.clone(), silent.clone());
    LazyLock::force(&ACT);
    check(1_000, move || {
        let world = World::new(false);
        let is_told = world.ask().is_some();
        assert_eq!(world.settle().1 == 1, is_told);
        (if is_told { &told } else { &silent }).fetch_add(1, Ordering::Relaxed);
    });
    let counts = (counts.0.load(Ordering::Relaxed), counts.1.load(Ordering::Relaxed));
    assert!(counts.0 > 0 && counts.1 > 0, "both orders occur: {counts:?}");
}

/// One who asks and leaves, one who waits, their engines, and one who resets, with a store and without: whatever overtakes whatever, an act is kept once,
/// who waits is answered, those who were told of it were told the truth, and memory and store do not part.
#[test]
fn whoever_comes_first_memory_and_store_agree() {
    LazyLock::force(&ACT);
    for has_store in [true, false] {
        check(3_000, move || {
            let world = World::new(has_store);
            let [asks, waits, resets] = [0; 3].map(|_| world.clone());
            let callers = [thread::spawn(move || asks.ask()), thread::spawn(move || waits.wait())];
            let resets = thread::spawn(move || resets.reset());
            let told = callers.map(|caller| caller.join().unwrap().is_some());
            resets.join().unwrap();
            let at = world.settle();
            if told.contains(&true) {
                assert!(at == (0, 1) || at.0 == 1, "what was told is there, or was reset: {at:?}");
                assert!(world.store.is_none_or(|store| store.lock().1 == 1), "what was told was kept");
            }
        });
    }
}
