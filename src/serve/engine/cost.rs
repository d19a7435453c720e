//! What a tick costs: measured at warm-up for every batch length, so that an act with a deadline can be told how many it may still take.

use crate::model::agent::{Act, Agent, AgentError, Observation};
use parking_lot::RwLock;
use std::{
    sync::{Arc, Weak},
    time::{Duration, Instant},
};

/// Acts of each length that are timed, and their ticks; the fastest counts, for the first ones find no memory yet.
const ROUNDS: usize = 3;
/// A tick that takes this long is timed once: its memory is the least of it, and a large model must get ready in time too.
const LONG: Duration = Duration::from_millis(20);
/// Weight of the newest tick in what the worker knows of its slowness.
const NEWEST: f64 = 0.1;
/// One tick counts as no slower than this: a hiccup of the machine is no reason to hurry for long.
const SLOWEST: f64 = 4.0;

/// The costs of every model, as the worker that measured it last found them.
#[derive(Debug, Default)]
pub(super) struct Tariff(RwLock<Vec<(Weak<Agent>, Arc<Costs>)>>);

impl Tariff {
    /// Takes note of what was measured; models that are gone are forgotten.
    pub fn note(&self, agent: &Arc<Agent>, costs: Costs) {
        let mut known = self.0.write();
        known.retain(|(known, _)| known.strong_count() > 0 && known.as_ptr() != Arc::as_ptr(agent));
        known.push((Arc::downgrade(agent), Arc::new(costs)));
    }

    /// Costs of a model; None: it was never measured.
    pub fn of(&self, agent: &Arc<Agent>) -> Option<Arc<Costs>> {
        self.0.read().iter().find(|(known, _)| known.as_ptr() == Arc::as_ptr(agent)).map(|(_, costs)| costs.clone())
    }
}

/// Costs of one model on one worker.
#[derive(Debug)]
pub(super) struct Costs {
    /// A tick of acts on their way, by rows from 1.
    ticks: Vec<Duration>,
    /// What the first tick costs more: latents and their prior chain.
    starts: Vec<Duration>,
}

impl Costs {
    /// Ticks of every number of rows up to `len_max`; afterwards this thread's memory for them is there. `go_on` is asked between lengths.
    pub fn measure(agent: &Agent, len_max: usize, mut go_on: impl FnMut() -> bool) -> Result<Self, AgentError> {
        let mut costs = Self { ticks: Vec::with_capacity(len_max), starts: Vec::with_capacity(len_max) };
        for len in (1..=len_max).take_while(|_| go_on()) {
            let (mut tick, mut start) = (Duration::MAX, Duration::MAX);
            for _ in 0..ROUNDS {
                let mut acts = acts(agent, len)?;
                start = start.min(timed(|| agent.advance(&mut acts))?);
                // One that is done after a single evaluation has failed, or is a whole act.
                let done = acts.extract_if(.., |act| act.is_done());
                done.map(|act| agent.finish(act)).try_for_each(|acted| acted.map(drop))?;
                // Where one evaluation makes a whole act, every tick is a first one.
                tick = if acts.len() == len { tick.min(timed(|| agent.advance(&mut acts))?) } else { start };
                if tick > LONG {
                    break;
                }
            }
            costs.ticks.push(tick);
            costs.starts.push(start.saturating_sub(tick));
        }
        Ok(costs)
    }

    /// A tick of `len` rows, with the start of `fresh` among them.
    pub fn tick(&self, len: usize, fresh: usize) -> Duration {
        of(&self.ticks, len) + if fresh > 0 { of(&self.starts, fresh) } else { Duration::ZERO }
    }

    /// A whole act of so many evaluations in a batch of `len`.
    pub fn act(&self, evaluations: usize, len: usize) -> Duration {
        self.tick(len, 0) * u32::try_from(evaluations).unwrap_or(u32::MAX) + of(&self.starts, len)
    }

    /// What of a worker's time an act of so many evaluations takes when its batch is full.
    pub fn share(&self, evaluations: usize) -> Duration {
        let len = self.ticks.len().max(1);
        self.act(evaluations, len) / len as u32
    }

    /// Ticks of `len` acts that fit into `left` for one that has started or not, if each waits for `others` too and everything takes
    /// `slowness` times as long as it did at warm-up.
    pub fn ticks_within(&self, left: Duration, (len, started): (usize, bool), others: Duration, slowness: f64) -> usize {
        let start = if started { Duration::ZERO } else { of(&self.starts, len) };
        let tick = (self.tick(len, 0) + others).as_secs_f64();
        let left = left.as_secs_f64() - slowness * start.as_secs_f64();
        (left / (slowness * tick).max(1e-9)).max(0.0) as usize
    }
}

/// How much slower ticks are than they were at warm-up: a running mean, at least 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slowness(f64);

impl Default for Slowness {
    fn default() -> Self {
        Self(1.0)
    }
}

impl Slowness {
    pub fn get(self) -> f64 {
        self.0
    }

    /// Takes note of a tick that was to take `expected`.
    pub fn note(&mut self, took: Duration, expected: Duration) {
        self.lean(took.as_secs_f64() / expected.as_secs_f64().max(1e-9));
    }

    /// An act was cut short and told nothing about the machine: without this, acts that are never computed would keep the mean up.
    pub fn forget(&mut self) {
        self.lean(1.0);
    }

    fn lean(&mut self, ratio: f64) {
        self.0 = (self.0 + NEWEST * (ratio.min(SLOWEST) - self.0)).max(1.0);
    }
}

fn of(costs: &[Duration], len: usize) -> Duration {
    costs.get(len.max(1) - 1).or(costs.last()).copied().unwrap_or(Duration::ZERO)
}

fn timed(work: impl FnOnce() -> Result<(), AgentError>) -> Result<Duration, AgentError> {
    let begin = Instant::now();
    work()?;
    Ok(begin.elapsed())
}

/// First acts of as many sessions, within what the model knows: one standard deviation off the mean.
fn acts(agent: &Agent, len: usize) -> Result<Vec<Act>, AgentError> {
    let known = &agent.config().units.normalizer.state;
    let observation = Observation { state: known.denormalize(&vec![1.0; known.mean.len()]), ..Observation::default() };
    let begin = |seed| agent.begin(&agent.open(seed, &agent.spec().sampler)?, &observation);
    (0..len as u64).map(begin).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn ticks_that_fit() {
        let costs = Costs { ticks: vec![ms(2), ms(3)], starts: vec![ms(4), ms(5)] };
        let within = |left, len, started, others, slowness| costs.ticks_within(ms(left), (len, started), ms(others), slowness);
        assert_eq!(within(9, 1, true, 0, 1.0), 4);
        assert_eq!(within(9, 1, false, 0, 1.0), 2);
        assert_eq!(within(9, 1, true, 0, 2.0), 2);
        assert_eq!(within(9, 1, true, 2, 1.0), 2);
        assert_eq!(within(10, 7, true, 0, 1.0), 3, "the longest that was measured");
        assert_eq!(within(3, 1, false, 0, 1.0), 0);
        assert_eq!(costs.tick(2, 1), ms(7));
        assert_eq!((costs.act(3, 1), costs.act(3, 9)), (ms(10), ms(14)));
        assert_eq!(costs.share(3), ms(7), "of a full batch");
    }

    #[test]
    fn slowness_follows_and_comes_back() {
        let mut slowness = Slowness::default();
        (0..100).for_each(|_| slowness.note(ms(30), ms(10)));
        assert!((slowness.get() - 3.0).abs() < 0.01);
        slowness.note(ms(60_000), ms(10));
        assert!(slowness.get() < 3.2, "one hiccup is no more than that");
        (0..100).for_each(|_| slowness.forget());
        assert!(slowness.get() < 1.01);
        (0..100).for_each(|_| slowness.note(ms(1), ms(10)));
        assert!((slowness.get() - 1.0).abs() < 1e-9);
    }
}
