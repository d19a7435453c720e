//! A worker's batch and its tick: one network evaluation shared by all acts that use the same model.

use super::{
    EngineOptions, Failure, Finished, Job, Patience, Question, Ticket,
    cost::{Costs, Slowness, Tariff},
    turns::{Part, Turns},
};
use crate::model::agent::{Act, Agent, AgentError, Chunk, Episode};
use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    time::{Duration, Instant},
};

/// The acts in progress of one worker, by model.
pub(super) struct Batch<T> {
    options: EngineOptions,
    groups: Vec<Group<T>>,
    slowness: Slowness,
    turns: Turns,
}

/// Acts of one model; `acts[i]` belongs to `riders[i]`.
struct Group<T> {
    agent: Arc<Agent>,
    /// None for a model without warm-up: its acts are never hurried.
    costs: Option<Arc<Costs>>,
    acts: Vec<Act>,
    riders: Vec<Rider<T>>,
}

/// What an act in a hurry must know beside its batch.
#[derive(Clone, Copy)]
struct Pace {
    /// A tick of the other models' acts, which stand between two of its own.
    others: Duration,
    /// Time kept for what follows the last evaluation.
    margin: Duration,
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
    pub fn new(options: EngineOptions) -> Self {
        Self { options, groups: Vec::new(), slowness: Slowness::default(), turns: Turns::new(options.batch_len_max) }
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

    /// Takes an act into a batch that will have this length; it takes part from the next tick on. One that would come too late is not begun.
    pub fn admit(&mut self, job: Job<T>, len: usize, tariff: &Tariff) {
        let Job { agent, question, act, ticket, submitted, turn_by: _, client } = job;
        if !ticket.is_wanted() {
            return;
        }
        let (slowness, margin, idle) = (self.slowness.get(), self.options.deadline_margin, self.len() == 0);
        let group = self.group(agent, tariff);
        if let Some(costs) = &group.costs {
            let needs = costs.act(act.evaluations_left(), len).mul_f64(slowness);
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
        self.turns.count(self.groups.iter().flat_map(|group| &group.riders).map(|rider| rider.client));
        &self.turns
    }

    /// One evaluation for every act whose client has its turn; those that are done leave.
    pub fn tick(&mut self) {
        let expected: Duration = self.groups.iter().map(Group::expected).sum();
        let (margin, len_max) = (self.options.deadline_margin, self.options.batch_len_max);
        let full = |group: &Group<T>| group.costs.as_ref().map(|costs| costs.tick(len_max, 0));
        let credit = self.groups.iter().filter_map(full).max().unwrap_or_default();
        let (part, begin) = (self.turns().part(credit), Instant::now());
        for group in &mut self.groups {
            let others = expected.saturating_sub(group.expected());
            let pace = Pace { others, margin };
            group.tick(&mut self.slowness, pace, len_max, |client| match (self.turns.is_heavy(client), part) {
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
                drop(catch_unwind(AssertUnwindSafe(|| drop(rider))));
            }
        }
    }

    /// The end: whoever is left fails.
    pub fn stop(self) {
        for group in self.groups {
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
    fn tick(&mut self, slowness: &mut Slowness, pace: Pace, rows_max: usize, order: impl Fn(u64) -> Option<Order>) {
        self.drop_unwanted();
        self.hurry(slowness, pace);
        self.harvest();
        let len = self.line_up(rows_max, order);
        if len == 0 {
            return;
        }
        let (begin, expected) = (Instant::now(), self.expected_of(len));
        if advance(&self.agent, &mut self.acts[..len]).is_err() {
            // Whose fault it was is unknown, and the acts may be half advanced: each act starts again, alone.
            self.acts.drain(..len).for_each(|act| count_waste(&act));
            for rider in self.riders.drain(..len) {
                rider.ride_alone(&self.agent, self.costs.as_deref(), pace);
            }
            return;
        }
        if self.costs.is_some() {
            slowness.note(begin.elapsed(), expected);
        }
        self.harvest();
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

    /// What a tick of everyone would have taken at warm-up.
    fn expected(&self) -> Duration {
        self.expected_of(self.riders.len())
    }

    /// The same of the first ones.
    fn expected_of(&self, len: usize) -> Duration {
        let rows = |fresh: bool| self.acts[..len].iter().filter(|act| !fresh || act.evaluations() == 0).map(Act::rows).sum();
        self.costs.as_ref().map_or(Duration::ZERO, |costs| costs.tick(rows(false), rows(true)))
    }

    /// Tells acts in a hurry how many evaluations they have time for; one that has time for none gives out what it has.
    fn hurry(&mut self, slowness: &mut Slowness, pace: Pace) {
        let Some(costs) = &self.costs else { return };
        for i in (0..self.riders.len()).rev() {
            let batch = (costs.as_ref(), self.riders.len(), slowness.get());
            match self.riders[i].hurry(&self.agent, &mut self.acts[i], batch, pace) {
                Ok(Hurry::Cut) => slowness.forget(),
                Ok(Hurry::Goes) => {}
                Ok(Hurry::Late) => {
                    count_waste(&self.acts.swap_remove(i));
                    self.riders.swap_remove(i).ticket.settle(Err(Failure::Late));
                }
                Err(_) => {
                    count_waste(&self.acts.swap_remove(i));
                    self.riders.swap_remove(i).ride_alone(&self.agent, None, pace);
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

    fn harvest(&mut self) {
        for i in (0..self.riders.len()).rev() {
            if self.acts[i].is_done() {
                let act = self.acts.swap_remove(i);
                self.riders.swap_remove(i).settle(finish(&self.agent, act));
            }
        }
    }
}

impl<T: Ticket> Rider<T> {
    /// See [`Group::hurry`]; the batch is its costs, length and slowness.
    fn hurry(&self, agent: &Agent, act: &mut Act, batch: (&Costs, usize, f64), pace: Pace) -> Result<Hurry, Failure> {
        let (patience, (costs, len, slowness)) = (self.ticket.patience(), batch);
        let Some(due) = patience.due else {
            act.allow(None);
            // In the best case; what was computed already is lost with it.
            let needs = costs.tick(len, 0) * act.evaluations_left() as u32;
            return Ok(if is_late(patience, needs, Duration::ZERO) { Hurry::Late } else { Hurry::Goes });
        };
        let left = due.saturating_duration_since(Instant::now()).saturating_sub(pace.margin);
        let ticks = costs.ticks_within(left, (len, act.evaluations() > 0), pace.others, slowness);
        if ticks == 0 && guarded(|| Ok(agent.cut_short(act)))? {
            return Ok(Hurry::Cut);
        }
        act.allow(Some(ticks));
        Ok(Hurry::Goes)
    }

    /// The whole act without batch mates, from the beginning: the result is the same, for noise does not depend on the batch.
    fn ride_alone(self, agent: &Agent, costs: Option<&Costs>, pace: Pace) {
        let mut act = match guarded(|| self.question.begin(agent)) {
            Ok(act) => act,
            Err(failure) => return self.ticket.settle(Err(failure)),
        };
        while !act.is_done() {
            if !self.ticket.is_wanted() {
                return count_waste(&act);
            }
            let hurried = costs.map_or(Ok(Hurry::Goes), |costs| self.hurry(agent, &mut act, (costs, 1, 1.0), pace));
            let advanced = hurried.and_then(|hurry| match hurry {
                Hurry::Goes => advance(agent, std::slice::from_mut(&mut act)),
                Hurry::Cut => Ok(()),
                Hurry::Late => Err(Failure::Late),
            });
            if let Err(failure) = advanced {
                count_waste(&act);
                return self.ticket.settle(Err(failure));
            }
        }
        self.settle(finish(agent, act));
    }

    fn settle(self, finished: Result<(Episode, Chunk), Failure>) {
        let (at, queue) = (Instant::now(), self.started - self.submitted);
        let compute = at - self.started;
        if finished.as_ref().is_ok_and(|(_, chunk)| chunk.degraded) {
            metrics::counter!("ada_degraded_total").increment(1);
        }
        self.ticket.settle(finished.map(|(episode, chunk)| Finished { episode, chunk, queue, compute, at }));
    }
}

/// One evaluation of a batch. Every evaluation is counted here, and once more where it ends: with an act that was computed, or as waste.
fn advance(agent: &Agent, acts: &mut [Act]) -> Result<(), Failure> {
    guarded(|| agent.advance(acts))?;
    metrics::counter!("ada_batches_total").increment(1);
    metrics::histogram!("ada_batch_size").record(acts.iter().map(Act::rows).sum::<usize>() as f64);
    Ok(())
}

fn finish(agent: &Agent, act: Act) -> Result<(Episode, Chunk), Failure> {
    let evaluations = act.evaluations();
    guarded(|| agent.finish(act)).inspect_err(|_| waste(evaluations))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{agent::Observation, checkpoint};
    use std::{path::Path, sync::mpsc};

    #[test]
    fn rows_bound_a_tick() {
        assert!(has_room(0, 1, 2) && has_room(1, 1, 2) && !has_room(2, 1, 2));
        assert!(!has_room(1, 2, 2) && has_room(0, 64, 2), "too many for any tick is not for ever");
    }

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
            };
            let (mut batch, tariff) = (Batch::new(options), Tariff::default());
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
            };
            let act = question.begin(&self.agent).unwrap();
            let needs = self.tariff.of(&self.agent).unwrap().act(act.evaluations_left(), 1);
            let now = Instant::now();
            let ticket = Waits(now + patience.unwrap_or(2 * needs + Duration::from_micros(200)), self.told.clone());
            let job = Job { agent: self.agent.clone(), question, act, ticket, submitted: now, turn_by: now, client: 0 };
            self.batch.admit(job, 1, &self.tariff);
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
}
