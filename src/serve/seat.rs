//! The engine's ticket: it brings the outcome of an act home to its session.

use crate::{
    model::agent::Episode,
    serve::{
        engine::{Failure, Finished, Patience, Ticket},
        error::{ServiceError, Stage},
        fault::{Faults, Point},
        recording::Recorder,
        session::{Answer, Flight, Session, Taken, Timings},
        store::{Refused, Store},
    },
};
use std::sync::Arc;
use tokio::time::Instant;
use uuid::Uuid;

/// What a client is told to wait when the server is ending.
pub(super) const RETRY_AFTER_RESTART_MS: u64 = 1_000;
/// What a client is told to wait when the server is starting: it is ready in less than a second, and everybody stands still until then.
pub(super) const RETRY_AFTER_LOADING_MS: u64 = 100;

/// See the module.
pub(super) struct Seat {
    pub session: Arc<Session>,
    pub flight: Arc<Flight>,
    /// Where commits go first; None: they are in memory alone.
    pub store: Option<Arc<Store>>,
    /// Where it is recorded, if it is.
    pub recorder: Option<Arc<Recorder>>,
    /// What its caller is told to wait if it has to leave a full queue.
    pub retry_after_ms: u64,
    /// What is to go wrong on its way.
    pub faults: Faults,
    /// What they know it by.
    pub first: Option<f32>,
}

impl Ticket for Seat {
    fn is_wanted(&self) -> bool {
        self.flight.is_wanted()
    }

    fn start(&self) {
        self.flight.start();
    }

    fn patience(&self) -> Patience {
        self.flight.patience()
    }

    fn settle(self, outcome: Result<Finished, Failure>) {
        let Self { session, flight, store: _, recorder, retry_after_ms, .. } = &self;
        match outcome {
            Ok(Finished { episode, chunk, observation, haste, queue, compute, at }) => {
                let (now, evaluations) = (Instant::now(), chunk.evaluations.into());
                metrics::counter!("ada_network_evaluations_total", "model" => session.model.to_string()).increment(evaluations);
                self.reaches(Point::Computed);
                let timings = Timings { queue, compute, commit: now - at, total: now - flight.arrived };
                let (model, model_digest) = (session.model.clone(), session.agent.spec().digest.clone());
                let answer = Answer { session: session.id, step: flight.step, chunk: Arc::new(chunk), timings, model, model_digest };
                let taken = recorder.clone().map(|recorder| Taken { recorder, observation, haste });
                self.commit(Arc::new(episode), Arc::new(answer), taken);
            }
            Err(Failure::Agent(error)) => session.fail(flight, ServiceError::from_agent(error)),
            Err(Failure::Panic) => self.poisons(),
            Err(Failure::Late) => session.fail(flight, ServiceError::Deadline { stage: Stage::Queue }),
            Err(Failure::Displaced) => session.fail(flight, ServiceError::QueueFull { retry_after_ms: *retry_after_ms }),
            Err(Failure::Stopped) => session.fail(flight, ServiceError::Draining { retry_after_ms: RETRY_AFTER_RESTART_MS }),
        }
    }
}

impl Seat {
    /// Commits before anybody is told: in memory, or, where there is a store, there first.
    fn commit(mut self, episode: Arc<Episode>, answer: Arc<Answer>, taken: Option<Taken>) {
        // Taken: what waits in the store must not hold the store.
        let Some(store) = self.store.take() else { return self.stored(episode, answer, taken) };
        match self.session.about_to_commit(&self.flight, &episode, &answer) {
            Ok(Some(write)) => store.submit(write, move |outcome| match outcome {
                Ok(Ok(())) => self.stored(episode, answer, taken),
                Ok(Err(refused)) => self.session.lose(&self.flight, ServiceError::from_refused(refused), refused),
                Err(error) => self.session.fail(&self.flight, ServiceError::from_store(&error)),
            }),
            Ok(None) => self.session.fail(&self.flight, ServiceError::SessionNotFound),
            Err(error) => self.session.fail(&self.flight, error),
        }
    }

    /// The store has it, where there is one.
    fn stored(&self, episode: Arc<Episode>, answer: Arc<Answer>, taken: Option<Taken>) {
        self.reaches(Point::Stored);
        self.session.commit(&self.flight, episode, answer, taken);
    }

    fn reaches(&self, point: Point) {
        self.faults.reach(point, self.first);
    }

    /// The model panicked over it, and once more when it was alone.
    fn poisons(&self) {
        let id = Uuid::new_v4();
        tracing::error!(%id, model = %self.session.model, step = self.flight.step, "the model panicked twice over an act");
        self.session.poison(&self.flight, id);
    }
}

/// An act that was given up half done tells so to whoever waits for it; one that is settled has told already. If it was on its way into the store,
/// nobody here knows whether it came there: the session leaves memory, so that who asks next finds it as it is kept.
impl Drop for Seat {
    fn drop(&mut self) {
        if !self.flight.is_busy() {
            return;
        }
        let (id, is_storing) = (Uuid::new_v4(), self.flight.is_storing());
        let (model, step) = (&self.session.model, self.flight.step);
        tracing::error!(%id, %model, step, is_storing, "an act was given up, for a defect of the server");
        let error = ServiceError::EnginePanic { id };
        if is_storing {
            self.session.lose(&self.flight, error, Refused::Conflict);
        } else {
            self.session.fail(&self.flight, error);
        }
    }
}
