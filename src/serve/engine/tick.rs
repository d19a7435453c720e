//! A worker's batch and its tick: one network evaluation shared by all acts that use the same model.

use super::{
    EngineOptions, Failure, Finished, Job, Patience, Question, Ticket, caught,
    cost::{Costs, Load, Slowness, Tariff},
    guarded,
    pulse::Pulse,
    turns::{Part, Turns},
};
use crate::{
    model::agent::{Act, Agent, Chunk, Episode, Haste},
    serve::fault::{Faults, Harm, Point},
};
use std::{sync::Arc, time::Duration};
use tokio::time::Instant;

/// The acts in progress of one worker, by model.
pub(super) struct Batch<T> {
    options: EngineOptions,
    groups: Vec<Group<T>>,
    slowness: Slowness,
    turns: Turns,
    pulse: Arc<Pulse>,
    faults: Faults,
}

/// Acts of one model; `acts[i]` belongs to `riders[i]`.
struct Group<T> {
    agent: Arc<Agent>,
    /// None for a model without warm-up: its acts are never hurried.
    costs: Option<Arc<Costs>>,
    acts: Vec<Act>,
    riders: Vec<Rider<T>>,
}

/// What an act must know beside its batch: one in a hurry what stands between it and its end, all of them whom to tell before an evaluation.
#[derive(Clone, Copy)]
struct Pace<'a> {
    /// A tick of the other models' acts, which stand between two of its own.
    others: Duration,
    /// Time kept for what follows the last evaluation.
    margin: Duration,
    /// Rows of a tick.
    rows_max: usize,
    pulse: &'a Pulse,
    faults: &'a Faults,
}

/// In which order acts find room in a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    First,
    Then,
}

/// What becomes of an act before the next tick.
enum Hurry {
    /// It takes part.
    Goes,
    /// It gave out what it had.
    Cut,
    /// Its answer would come too late.
    Late,
}

struct Rider<T> {
    question: Question,
    ticket: T,
    client: u64,
    submitted: Instant,
    started: Instant,
}

impl<T: Ticket> Batch<T> {
    /// Of a worker with this pulse.
    pub fn new(options: EngineOptions, pulse: Arc<Pulse>, faults: Faults) -> Self {
        let turns = Turns::new(options.batch_len_max);
        Self { options, groups: Vec::new(), slowness: Slowness::default(), turns, pulse, faults }
    }

    /// Acts in it.
    pub fn len(&self) -> usize {
        self.groups.iter().map(|group| group.riders.len()).sum()
    }

    /// Rows of these acts.
    pub fn rows(&self) -> usize {
        self.groups.iter().flat_map(|group| &group.acts).map(Act::rows).sum()
    }

    /// Gets ready for a model; see [`Costs::measure`].
    pub fn warm_up(&self, agent: &Arc<Agent>, tariff: &Tariff, go_on: impl FnMut() -> bool) -> Result<(), Failure> {
        tariff.note(agent, guarded(|| Costs::measure(agent, self.options.batch_len_max, go_on))?);
        Ok(())
    }

    /// Takes an act into a batch that will hold so many acts and rows; it takes part from the next tick on. One that would come too late is not
    /// begun. A panic of its ticket is its own.
    pub fn admit(&mut self, job: Job<T>, held: Load, tariff: &Tariff) {
        apart(|| self.let_in(job, held, tariff));
    }

    fn let_in(&mut self, job: Job<T>, held: Load, tariff: &Tariff) {
        let Job { agent, question, act, ticket, submitted, turn_by: _, client } = job;
        if !ticket.is_wanted() {
            return;
        }
        let (slowness, margin, idle) = (self.slowness.get(), self.options.deadline_margin, self.len() == 0);
        let load = held.within(self.options.batch_len_max, act.rows());
        let group = self.group(agent, tariff);
        if let Some(costs) = &group.costs {
            let needs = costs.act(question.forwards_left(&act), load).mul_f64(slowness);
            if is_late(ticket.patience(), needs, margin) {
                // It tells nothing about the machine, and if nobody else is computed nothing would. While others are, they tell: to forget
                // for each of a crowd that is late would let the next ones in that are late too.
                if idle {
                    self.slowness.forget();
                }
                return ticket.settle(Err(Failure::Late));
            }
        }
        ticket.start();
        group.acts.push(act);
        group.riders.push(Rider { question, ticket, client, submitted, started: Instant::now() });
    }

    /// Clients that hold much of it, and places beyond it that are kept for the others.
    pub fn turns(&mut self) -> &Turns {
        let acts = self.groups.iter().flat_map(|group| group.riders.iter().zip(&group.acts));
        self.turns.count(acts.map(|(rider, act)| (rider.client, act.rows())));
        &self.turns
    }

    /// One evaluation for every act whose client has its turn; those that are done leave.
    pub fn tick(&mut self) {
        let (margin, rows_max) = (self.options.deadline_margin, self.options.batch_len_max);
        let expected: Duration = self.groups.iter().map(|group| group.expected(rows_max)).sum();
        let full = |group: &Group<T>| group.costs.as_ref().map(|costs| costs.tick(rows_max, 0));
        let credit = self.groups.iter().filter_map(full).max().unwrap_or_default();
        let (part, begin) = (self.turns().part(credit), Instant::now());
        for group in &mut self.groups {
            let others = expected.saturating_sub(group.expected(rows_max));
            let pace = Pace { others, margin, rows_max, pulse: &self.pulse, faults: &self.faults };
            group.tick(&mut self.slowness, pace, |client| match (self.turns.is_heavy(client), part) {
                (false, _) => Some(Order::First),
                (true, Part::All) => Some(Order::Then),
                (true, Part::Light) => None,
            });
        }
        self.turns.took(part, begin.elapsed());
        self.groups.retain(|group| !group.riders.is_empty());
    }

    /// Drops all acts, half done as they are; their tickets know what to do. What was measured stays.
    pub fn abandon(&mut self) {
        for group in self.groups.drain(..) {
            group.acts.iter().for_each(count_waste);
            for rider in group.riders {
                // The one that panicked may do so again when it is dropped.
                apart(|| drop(rider));
            }
        }
    }

    /// The end: whoever is left fails.
    pub fn stop(&mut self) {
        for group in self.groups.drain(..) {
            group.acts.iter().for_each(count_waste);
            group.riders.into_iter().for_each(|rider| rider.ticket.settle(Err(Failure::Stopped)));
        }
    }

    fn group(&mut self, agent: Arc<Agent>, tariff: &Tariff) -> &mut Group<T> {
        let index = self.groups.iter().position(|group| Arc::ptr_eq(&group.agent, &agent));
        let index = index.unwrap_or_else(|| {
            let costs = tariff.of(&agent);
            self.groups.push(Group { agent, costs, acts: Vec::new(), riders: Vec::new() });
            self.groups.len() - 1
        });
        &mut self.groups[index]
    }
}

impl<T: Ticket> Group<T> {
    fn tick(&mut self, slowness: &mut Slowness, pace: Pace, order: impl Fn(u64) -> Option<Order>) {
        self.drop_unwanted();
        self.hurry(slowness, pace);
        self.harvest(pace);
        let len = self.line_up(pace.rows_max, order);
        if len == 0 {
            return;
        }
        let (begin, expected) = (Instant::now(), self.expected_of(len, pace.rows_max));
        pace.pulse.evaluates(self.costs.as_ref().map(|_| expected));
        let questions = self.riders[..len].iter().map(|rider| &rider.question);
        if advance(&self.agent, &mut self.acts[..len], questions, pace.faults).is_err() {
            // Whose fault it was is unknown, and the acts may be half advanced: each act starts again, alone.
            self.acts.drain(..len).for_each(|act| count_waste(&act));
            for rider in self.riders.drain(..len) {
                apart(|| rider.ride_alone(&self.agent, self.costs.as_deref(), pace));
            }
            return;
        }
        if self.costs.is_some() {
            slowness.note(begin.elapsed(), expected);
        }
        self.harvest(pace);
    }

    /// Brings those that take part to the front, as many as have room in so many rows; how many they are.
    fn line_up(&mut self, rows_max: usize, order: impl Fn(u64) -> Option<Order>) -> usize {
        let (mut len, mut rows) = (0, 0);
        for turn in [Order::First, Order::Then] {
            let first = len;
            for i in first..self.riders.len() {
                if has_room(rows, self.acts[i].rows(), rows_max) && order(self.riders[i].client) == Some(turn) {
                    self.riders.swap(len, i);
                    self.acts.swap(len, i);
                    rows += self.acts[len].rows();
                    len += 1;
                }
            }
        }
        len
    }

    /// What a tick of everyone who has room would have taken at warm-up.
    fn expected(&self, rows_max: usize) -> Duration {
        self.expected_of(self.riders.len(), rows_max)
    }

    /// The same of the first ones.
    fn expected_of(&self, len: usize, rows_max: usize) -> Duration {
        let acts = &self.acts[..len];
        let fresh = acts.iter().filter(|act| act.evaluations() == 0).count();
        self.costs.as_ref().map_or(Duration::ZERO, |costs| costs.tick(Load::of(acts, rows_max).rows, fresh))
    }

    /// Tells acts in a hurry how many evaluations they have time for; one that has time for none gives out what it has.
    fn hurry(&mut self, slowness: &mut Slowness, pace: Pace) {
        let Some(costs) = &self.costs else { return };
        let load = Load::of(&self.acts, pace.rows_max);
        for i in (0..self.riders.len()).rev() {
            let batch = (costs.as_ref(), load, slowness.get());
            match self.riders[i].hurry(&self.agent, &mut self.acts[i], batch, pace) {
                Ok(Hurry::Cut) => slowness.forget(),
                Ok(Hurry::Goes) => {}
                Ok(Hurry::Late) => {
                    count_waste(&self.acts.swap_remove(i));
                    self.riders.swap_remove(i).ticket.settle(Err(Failure::Late));
                }
                Err(_) => {
                    count_waste(&self.acts.swap_remove(i));
                    let rider = self.riders.swap_remove(i);
                    apart(|| rider.ride_alone(&self.agent, None, pace));
                }
            }
        }
    }

    fn drop_unwanted(&mut self) {
        for i in (0..self.riders.len()).rev() {
            if !self.riders[i].ticket.is_wanted() {
                self.riders.swap_remove(i);
                count_waste(&self.acts.swap_remove(i));
            }
        }
    }

    fn harvest(&mut self, pace: Pace) {
        for i in (0..self.riders.len()).rev() {
            if self.acts[i].is_done() {
                let (act, rider) = (self.acts.swap_remove(i), self.riders.swap_remove(i));
                apart(|| match finish(&self.agent, act) {
                    Err(Failure::Panic) => rider.ride_alone(&self.agent, self.costs.as_deref(), pace),
                    finished => rider.settle(finished),
                });
            }
        }
    }
}

impl<T: Ticket> Rider<T> {
    /// See [`Group::hurry`]; the batch is its costs, what is in it, and its slowness.
    fn hurry(&self, agent: &Agent, act: &mut Act, batch: (&Costs, Load, f64), pace: Pace) -> Result<Hurry, Failure> {
        let (patience, (costs, load, slowness)) = (self.ticket.patience(), batch);
        let Some(due) = patience.due else {
            act.allow(None);
            // In the best case; what was computed already is lost with it.
            let needs = costs.ticks(self.question.forwards_left(act), load.rows);
            return Ok(if is_late(patience, needs, Duration::ZERO) { Hurry::Late } else { Hurry::Goes });
        };
        let left = due.saturating_duration_since(Instant::now()).saturating_sub(pace.margin);
        let ticks = costs.ticks_within(left, (load, act.evaluations() > 0), pace.others, slowness);
        if ticks == 0 && guarded(|| Ok(agent.cut_short(act)))? {
            return Ok(Hurry::Cut);
        }
        act.allow(Some(ticks));
        Ok(Hurry::Goes)
    }

    /// The whole act without batch mates, from the beginning: the result is the same, for noise does not depend on the batch. It is its second try
    /// after a panic, and its last.
    fn ride_alone(self, agent: &Agent, costs: Option<&Costs>, pace: Pace) {
        let mut act = match self.question.begin(agent) {
            Ok(act) => act,
            Err(failure) => return self.ticket.settle(Err(failure)),
        };
        while !act.is_done() {
            if !self.ticket.is_wanted() {
                return count_waste(&act);
            }
            let load = Load { acts: 1, rows: act.rows() };
            let hurried = costs.map_or(Ok(Hurry::Goes), |costs| self.hurry(agent, &mut act, (costs, load, 1.0), pace));
            pace.pulse.evaluates(costs.map(|costs| costs.tick(act.rows(), usize::from(act.evaluations() == 0))));
            let question = std::iter::once(&self.question);
            let advanced = hurried.and_then(|hurry| match hurry {
                Hurry::Late => Err(Failure::Late),
                Hurry::Cut if act.is_done() => Ok(()),
                // A plan that was cut short may still ask for its actions, or to be chosen: that is answered, and brings it to its end.
                Hurry::Cut | Hurry::Goes => advance(agent, std::slice::from_mut(&mut act), question, pace.faults),
            });
            if let Err(failure) = advanced {
                count_waste(&act);
                return self.ticket.settle(Err(failure));
            }
        }
        self.settle(finish(agent, act));
    }

    fn settle(self, finished: Result<(Episode, Chunk, Haste), Failure>) {
        let (at, queue) = (Instant::now(), self.started - self.submitted);
        let compute = at - self.started;
        if finished.as_ref().is_ok_and(|(_, chunk, _)| chunk.degraded) {
            metrics::counter!("ada_degraded_total").increment(1);
        }
        let observation = self.question.observation;
        self.ticket.settle(finished.map(|(episode, chunk, haste)| Finished { episode, chunk, observation, haste, queue, compute, at }));
    }
}

/// One evaluation of a batch. Every evaluation is counted here, and once more where it ends: with an act that was computed, or as waste.
fn advance<'a>(agent: &Agent, acts: &mut [Act], questions: impl Iterator<Item = &'a Question>, faults: &Faults) -> Result<(), Failure> {
    guarded(|| {
        if faults.are_armed() {
            harm(acts, questions, faults);
        }
        agent.advance(acts)
    })?;
    metrics::counter!("ada_batches_total").increment(1);
    metrics::histogram!("ada_batch_size").record(acts.iter().map(Act::rows).sum::<usize>() as f64);
    Ok(())
}

/// What faults say becomes of this evaluation.
fn harm<'a>(acts: &mut [Act], questions: impl Iterator<Item = &'a Question>, faults: &Faults) {
    for (act, question) in acts.iter_mut().zip(questions) {
        match faults.at(Point::Evaluating, question.first()) {
            Some(Harm::Nonfinite) => act.spoil(),
            Some(harm) => harm.strike(Point::Evaluating),
            None => {}
        }
    }
}

fn finish(agent: &Agent, mut act: Act) -> Result<(Episode, Chunk, Haste), Failure> {
    let (evaluations, haste) = (act.evaluations(), act.take_haste());
    let finished = guarded(|| agent.finish(act)).inspect_err(|_| waste(evaluations));
    finished.map(|(episode, chunk)| (episode, chunk, haste))
}

fn count_waste(act: &Act) {
    waste(act.evaluations());
}

fn waste(evaluations: u32) {
    metrics::counter!("ada_wasted_network_evaluations_total").increment(evaluations.into());
}

/// Whether an act finds room in a tick; one of more rows than there can be has a tick for itself.
fn has_room(taken: usize, rows: usize, rows_max: usize) -> bool {
    taken == 0 || taken + rows <= rows_max
}

/// Whether nobody will wait for an answer that takes so much more time.
fn is_late(patience: Patience, needs: Duration, margin: Duration) -> bool {
    patience.due.is_none() && patience.ends.is_some_and(|ends| Instant::now() + needs + margin > ends)
}

/// Does what concerns one act. If that panics (a ticket that commits, a log line), the act's ticket is dropped on the way, and tells whoever waits;
/// its batch mates hear nothing of it.
fn apart(work: impl FnOnce()) {
    if caught(work).is_none() {
        tracing::error!("an inference thread panicked outside of the model; the act is given up");
    }
}

#[cfg(test)]
#[path = "tick_tests.rs"]
mod tests;
