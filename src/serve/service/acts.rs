//! Acts: one, many, a stream of them.

use super::Service;
use crate::serve::{
    count::Count,
    engine::{Failure, Job, Patience, Question, Refusal, Ticket},
    error::{ServiceError, Stage},
    fault::Point,
    idle::{Idle, until_idle},
    request::{ActRequest, ActResult, Acted},
    seat::{RETRY_AFTER_RESTART_MS, Seat},
    session::{Answer, Entry, Session, Waiter, key_of},
};
use futures_util::{FutureExt, Stream, StreamExt, future::join_all};
use std::{
    panic::AssertUnwindSafe,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::{Instant, sleep, timeout_at};

/// From the moment at which a face has an answer to that at which it is on its way, about.
const TELLING: Duration = Duration::from_millis(2);

impl Service {
    /// Act.
    ///
    /// # Errors
    /// Every row of the error table; the session is as before, but see `Deadline`.
    pub async fn act(&self, request: ActRequest) -> Result<Acted, ServiceError> {
        let (mut count, first) = (Count::new(request.caller), request.observation.state.first().copied());
        let session = match self.registry() {
            Ok(_) => self.session(&request.session_id).await,
            Err(error) => Err(error),
        };
        if let Err(ServiceError::Draining { .. }) = &session
            && let Some(acted) = self.committed(&request).await
        {
            return count.told(Ok(acted));
        }
        let result = match session {
            Ok(session) => {
                count.of(&session.model);
                // In a batch or on a stream a panic would cost the acts of all.
                let acting = AssertUnwindSafe(self.act_on(&session, request, count.arrived())).catch_unwind().await;
                acting.unwrap_or_else(|_| Err(ServiceError::internal(&"the way of an act to the engine panicked")))
            }
            Err(error) => Err(error),
        };
        if result.is_ok() {
            self.tells(first);
        }
        count.told(result)
    }

    /// For faults: the answer of such an act is about to be on its way.
    fn tells(&self, first: Option<f32>) {
        if let Some(harm) = self.config.faults.at(Point::Told, first) {
            tokio::spawn(async move {
                sleep(TELLING).await;
                harm.strike(Point::Told);
            });
        }
    }

    /// ActBatch: each act has its own answer or error, in the order of the acts.
    ///
    /// # Errors
    /// `TooLarge` if there are too many.
    pub async fn act_batch(&self, acts: Vec<Result<ActRequest, ActResult>>) -> Result<Vec<ActResult>, ServiceError> {
        let limit = self.config.limits.act_batch_len_max;
        if acts.len() > limit {
            metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
            return Err(ServiceError::TooLarge { what: "number of acts", limit });
        }
        Ok(join_all(acts.into_iter().map(|act| self.act_result(act))).await)
    }

    /// ActStream: answers as they are ready, at most `limits.stream_acts_max` in work; ends when the acts end, or draining begins and the last one is
    /// answered, or with [`Idle`]. An act that could not be read (`Err`) is answered with its error, here as in a batch.
    pub fn act_stream(
        self: Arc<Self>,
        acts: impl Stream<Item = Result<ActRequest, ActResult>>,
    ) -> impl Stream<Item = Result<ActResult, Idle>> {
        let (width, idle_max) = (self.config.limits.stream_acts_max, Duration::from_millis(self.config.connection.idle_timeout_ms));
        let draining = self.draining.clone().cancelled_owned();
        let in_work = Arc::new(AtomicUsize::new(0));
        let begun = in_work.clone();
        let answer = move |act| {
            begun.fetch_add(1, Ordering::Relaxed);
            let service = self.clone();
            async move { service.act_result(act).await }
        };
        until_idle(acts.take_until(draining).map(answer).buffer_unordered(width), in_work, idle_max)
    }

    /// While draining, the answer of a step that is committed already: whoever lost it is not to lose the act.
    async fn committed(&self, request: &ActRequest) -> Option<Acted> {
        let session = self.session(&request.session_id).await.ok()?;
        let answer = session.replay((request.episode, request.step), key_of(&request.observation))?;
        metrics::counter!("ada_replays_total", "source" => "memory").increment(1);
        Some(Acted { answer, replayed: true, want_planned_states: request.want_planned_states })
    }

    async fn act_result(&self, act: Result<ActRequest, ActResult>) -> ActResult {
        match act {
            Ok(act) => {
                let (session_id, step) = (act.session_id.clone(), act.step);
                ActResult { session_id, step, result: self.act(act).await }
            }
            Err(misread) => misread,
        }
    }

    async fn act_on(&self, session: &Arc<Session>, request: ActRequest, arrived: Instant) -> Result<Acted, ServiceError> {
        let ActRequest { step, episode, observation, deadline, timeout, want_planned_states, caller, .. } = request;
        self.check_steps_told(observation.executed.len(), "number of executed steps")?;
        let limits = &self.config.limits;
        let longest = Duration::from_millis(limits.act_deadline_ms_max);
        let usual = Duration::from_millis(limits.act_deadline_ms);
        let patience = deadline.unwrap_or(usual).min(longest);
        let stays = timeout.map_or(patience, |timeout| timeout.min(patience));
        if stays.is_zero() {
            return Err(ServiceError::Deadline { stage: Stage::Admission });
        }
        let acted = |answer, replayed| Acted { answer, replayed, want_planned_states };
        let due = deadline.filter(|_| self.config.engine.anytime).map(|_| arrived + patience);
        let waits = Patience { due, ends: Some(arrived + stays) };
        let (waiter, replayed) = match session.enter((episode, step), key_of(&observation), arrived, waits)? {
            Entry::Replay(answer) => {
                metrics::counter!("ada_replays_total", "source" => "memory").increment(1);
                return Ok(acted(answer, true));
            }
            Entry::Join(waiter) => {
                metrics::counter!("ada_replays_total", "source" => "inflight").increment(1);
                (waiter, true)
            }
            Entry::Lead(waiter, episode) => {
                // Whoever is patient, or names no deadline, has a turn after a while all the same, before those who are in a hurry and came later.
                let turn_by = arrived + patience.min(Duration::from_millis(self.config.engine.turn_ms_max));
                let retry_after_ms = self.config.engine.retry_after_ms;
                let (flight, store, recorder) = (waiter.flight().clone(), self.keeper.store(), self.keeper.recorder());
                let question = Question { episode, observation, haste: None };
                let (faults, first) = (self.config.faults.clone(), question.first());
                let seat = Seat { session: session.clone(), flight, store, recorder, retry_after_ms, faults, first };
                self.submit(seat, question, turn_by, caller.client);
                (waiter, false)
            }
        };
        wait(waiter, arrived + stays).await.map(|answer| acted(answer, replayed))
    }

    /// Checks the question and hands it to the engine; a refusal goes to everyone who waits for it.
    fn submit(&self, seat: Seat, question: Question, turn_by: Instant, client: u64) {
        let agent = seat.session.agent.clone();
        let begun = match question.begin(&agent) {
            Err(Failure::Panic) => question.begin(&agent),
            begun => begun,
        };
        let act = match begun {
            Ok(act) => act,
            Err(failure) => return seat.settle(Err(failure)),
        };
        self.config.faults.reach(Point::Admitted, question.first());
        let job = Job { agent, question, act, ticket: seat, submitted: Instant::now(), turn_by, client };
        let flight = job.ticket.flight.clone();
        let (refusal, job) = match self.engine.submit(job) {
            Ok(waiting) => return flight.waits(|| waiting.leave()),
            Err(refused) => refused,
        };
        let retry_after_ms = self.config.engine.retry_after_ms;
        let error = match refusal {
            Refusal::Full => ServiceError::QueueFull { retry_after_ms },
            Refusal::Slow(excess) => ServiceError::QueueFull { retry_after_ms: retry_after_ms.max(excess.as_millis() as u64) },
            Refusal::Late => ServiceError::Deadline { stage: Stage::Admission },
            Refusal::Closed => ServiceError::Draining { retry_after_ms: RETRY_AFTER_RESTART_MS },
        };
        job.ticket.session.fail(&job.ticket.flight, error);
    }
}

/// The outcome, also one that comes at the very moment of the deadline: what is committed is told.
async fn wait(waiter: Waiter, deadline: Instant) -> Result<Arc<Answer>, ServiceError> {
    if let Ok(outcome) = timeout_at(deadline, waiter.outcome()).await {
        return outcome;
    }
    let stage = waiter.flight().stage();
    waiter.give_up().ok_or(ServiceError::Deadline { stage })
}
