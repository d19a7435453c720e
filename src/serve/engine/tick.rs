//! A worker's batch and its tick: one network evaluation shared by all acts that use the same model.

use super::{
    EngineOptions, Failure, Finished, Job, Question, Ticket,
    cost::{Costs, Slowness},
};
use crate::model::agent::{Agent, AgentError, Chunk, Descent, Episode};
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Weak},
    time::Instant,
};

/// The acts in progress of one worker, by model.
pub(super) struct Batch<T> {
    options: EngineOptions,
    groups: Vec<Group<T>>,
    /// What this worker has measured.
    costs: Vec<(Weak<Agent>, Arc<Costs>)>,
    slowness: Slowness,
}

/// Acts of one model; `descents[i]` belongs to `riders[i]`.
struct Group<T> {
    agent: Arc<Agent>,
    /// None for a model without warm-up: its acts are never hurried.
    costs: Option<Arc<Costs>>,
    descents: Vec<Descent>,
    riders: Vec<Rider<T>>,
}

struct Rider<T> {
    question: Question,
    ticket: T,
    submitted: Instant,
    started: Instant,
    /// When its last evaluation must be over, if it is in a hurry.
    due: Option<Instant>,
    /// Evaluations spent on it, to count what is wasted if it is dropped.
    evaluations: u64,
}

impl<T: Ticket> Batch<T> {
    pub fn new(options: EngineOptions) -> Self {
        Self { options, groups: Vec::new(), costs: Vec::new(), slowness: Slowness::default() }
    }

    /// Acts in it.
    pub fn len(&self) -> usize {
        self.groups.iter().map(|group| group.riders.len()).sum()
    }

    /// Gets ready for a model; see [`Costs::measure`].
    pub fn warm_up(&mut self, agent: &Arc<Agent>) -> Result<(), Failure> {
        let costs = guarded(|| Costs::measure(agent, self.options.batch_len_max))?;
        self.costs.retain(|(known, _)| known.strong_count() > 0);
        self.costs.push((Arc::downgrade(agent), Arc::new(costs)));
        Ok(())
    }

    /// Takes an act in; it takes part from the next tick on.
    pub fn admit(&mut self, job: Job<T>) {
        let Job { agent, question, descent, ticket, submitted, due, .. } = job;
        if !ticket.is_wanted() {
            return;
        }
        ticket.start();
        let margin = self.options.deadline_margin;
        let due = due.map(|due| due.checked_sub(margin).unwrap_or(due));
        let group = self.group(agent);
        group.descents.push(descent);
        group.riders.push(Rider { question, ticket, submitted, started: Instant::now(), due, evaluations: 0 });
    }

    /// One evaluation for every act; those that are done leave.
    pub fn tick(&mut self) {
        for group in &mut self.groups {
            group.tick(&mut self.slowness);
        }
        self.groups.retain(|group| !group.riders.is_empty());
    }

    /// The end: whoever is left fails.
    pub fn stop(self) {
        let riders = self.groups.into_iter().flat_map(|group| group.riders);
        riders.for_each(|rider| rider.ticket.settle(Err(Failure::Stopped)));
    }

    fn group(&mut self, agent: Arc<Agent>) -> &mut Group<T> {
        let index = self.groups.iter().position(|group| Arc::ptr_eq(&group.agent, &agent));
        let index = index.unwrap_or_else(|| {
            let costs = self.costs.iter().find(|(known, _)| known.as_ptr() == Arc::as_ptr(&agent));
            let costs = costs.map(|(_, costs)| costs.clone());
            self.groups.push(Group { agent, costs, descents: Vec::new(), riders: Vec::new() });
            self.groups.len() - 1
        });
        &mut self.groups[index]
    }
}

impl<T: Ticket> Group<T> {
    fn tick(&mut self, slowness: &mut Slowness) {
        self.drop_unwanted();
        self.hurry(slowness.get());
        self.harvest();
        if self.riders.is_empty() {
            return;
        }
        metrics::counter!("ada_batches_total").increment(1);
        metrics::histogram!("ada_batch_size").record(self.riders.len() as f64);
        let (begin, on_their_way) = (Instant::now(), self.descents.iter().all(|descent| descent.evaluations() > 0));
        if guarded(|| self.agent.advance(&mut self.descents)).is_err() {
            // Whose fault it was is unknown, and the descents may be half advanced: each act starts again, alone.
            self.descents.clear();
            for rider in self.riders.drain(..) {
                rider.ride_alone(&self.agent);
            }
            return;
        }
        if let Some(costs) = self.costs.as_ref().filter(|_| on_their_way) {
            slowness.note(begin.elapsed(), costs.tick(self.riders.len()));
        }
        for rider in &mut self.riders {
            rider.evaluations += 1;
        }
        self.harvest();
    }

    /// Tells acts in a hurry how many evaluations they have time for; one that has time for none gives out what it has.
    fn hurry(&mut self, slowness: f64) {
        let (Some(costs), len) = (&self.costs, self.riders.len()) else { return };
        let now = Instant::now();
        for (descent, rider) in self.descents.iter_mut().zip(&self.riders) {
            let Some(due) = rider.due else { continue };
            let ticks = costs.ticks_within(due.saturating_duration_since(now), len, descent.evaluations() > 0, slowness);
            if ticks == 0 && self.agent.cut_short(descent) {
                continue;
            }
            descent.allow(Some(ticks));
        }
    }

    fn drop_unwanted(&mut self) {
        for i in (0..self.riders.len()).rev() {
            if !self.riders[i].ticket.is_wanted() {
                self.descents.swap_remove(i);
                self.riders.swap_remove(i).count_waste();
            }
        }
    }

    fn harvest(&mut self) {
        for i in (0..self.riders.len()).rev() {
            if self.descents[i].is_done() {
                let descent = self.descents.swap_remove(i);
                let finished = guarded(|| self.agent.finish(descent));
                self.riders.swap_remove(i).settle(finished);
            }
        }
    }
}

impl<T: Ticket> Rider<T> {
    /// The whole act without batch mates, from the beginning: the result is the same, for noise does not depend on the batch.
    fn ride_alone(mut self, agent: &Agent) {
        let mut descent = match guarded(|| self.question.begin(agent)) {
            Ok(descent) => descent,
            Err(failure) => return self.ticket.settle(Err(failure)),
        };
        while !descent.is_done() {
            if !self.ticket.is_wanted() {
                return self.count_waste();
            }
            if let Err(failure) = guarded(|| agent.advance(std::slice::from_mut(&mut descent))) {
                return self.ticket.settle(Err(failure));
            }
            self.evaluations += 1;
        }
        self.settle(guarded(|| agent.finish(descent)));
    }

    fn settle(self, finished: Result<(Episode, Chunk), Failure>) {
        let (at, queue) = (Instant::now(), self.started - self.submitted);
        let compute = at - self.started;
        if finished.as_ref().is_ok_and(|(_, chunk)| chunk.degraded) {
            metrics::counter!("ada_degraded_total").increment(1);
        }
        self.ticket.settle(finished.map(|(episode, chunk)| Finished { episode, chunk, queue, compute, at }));
    }

    fn count_waste(self) {
        metrics::counter!("ada_wasted_network_evaluations_total").increment(self.evaluations);
    }
}

/// Runs a piece of the model; a panic is a failure of the act, not of the thread. What it touched is dropped, so no broken state is seen again.
fn guarded<R>(work: impl FnOnce() -> Result<R, AgentError>) -> Result<R, Failure> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(result) => result.map_err(Failure::Agent),
        Err(_) => {
            metrics::counter!("ada_engine_panics_total").increment(1);
            Err(Failure::Panic)
        }
    }
}
