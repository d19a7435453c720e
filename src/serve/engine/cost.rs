//! What a tick costs: measured at warm-up for every batch length, so that an act with a deadline can be told how many it may still take.

use crate::model::agent::{Agent, AgentError, Descent, Observation};
use std::time::{Duration, Instant};

/// Ticks of each length that are timed; the fastest counts.
const ROUNDS: usize = 3;
/// Weight of the newest tick in what the worker knows of its slowness.
const NEWEST: f64 = 0.1;

/// Costs of one model on one worker.
#[derive(Debug)]
pub(super) struct Costs {
    /// A tick of descents on their way, by batch length from 1.
    ticks: Vec<Duration>,
    /// What the first tick costs more: latents and their prior chain.
    starts: Vec<Duration>,
}

impl Costs {
    /// Ticks of every length up to `len_max`; afterwards this thread's memory for them is there.
    pub fn measure(agent: &Agent, len_max: usize) -> Result<Self, AgentError> {
        let mut costs = Self { ticks: Vec::with_capacity(len_max), starts: Vec::with_capacity(len_max) };
        for len in 1..=len_max {
            let mut descents = descents(agent, len)?;
            let start = timed(|| agent.advance(&mut descents))?;
            let mut tick = start;
            for _ in 0..ROUNDS {
                descents.retain(|descent| !descent.is_done());
                if descents.len() == len {
                    tick = tick.min(timed(|| agent.advance(&mut descents))?);
                }
            }
            costs.ticks.push(tick);
            costs.starts.push(start - tick);
        }
        Ok(costs)
    }

    /// A tick of `len` descents on their way.
    pub fn tick(&self, len: usize) -> Duration {
        of(&self.ticks, len)
    }

    /// Ticks of `len` descents that fit into `left`, if everything takes `slowness` times as long as it did at warm-up.
    pub fn ticks_within(&self, left: Duration, len: usize, has_started: bool, slowness: f64) -> usize {
        let start = if has_started { Duration::ZERO } else { of(&self.starts, len) };
        let left = left.as_secs_f64() - slowness * start.as_secs_f64();
        (left / (slowness * self.tick(len).as_secs_f64()).max(1e-9)).max(0.0) as usize
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
        let ratio = took.as_secs_f64() / expected.as_secs_f64().max(1e-9);
        self.0 = (self.0 + NEWEST * (ratio - self.0)).max(1.0);
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

/// First acts of as many sessions, in the middle of what the model knows.
fn descents(agent: &Agent, len: usize) -> Result<Vec<Descent>, AgentError> {
    let observation = Observation { state: agent.config().normalizer.state.mean.clone(), executed: Vec::new() };
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
        assert_eq!(costs.ticks_within(ms(9), 1, true, 1.0), 4);
        assert_eq!(costs.ticks_within(ms(9), 1, false, 1.0), 2);
        assert_eq!(costs.ticks_within(ms(9), 1, true, 2.0), 2);
        assert_eq!(costs.ticks_within(ms(10), 7, true, 1.0), 3, "the longest that was measured");
        assert_eq!(costs.ticks_within(ms(3), 1, false, 1.0), 0);
    }

    #[test]
    fn slowness_follows_and_never_falls_below_one() {
        let mut slowness = Slowness::default();
        (0..100).for_each(|_| slowness.note(ms(30), ms(10)));
        assert!((slowness.get() - 3.0).abs() < 0.01);
        (0..100).for_each(|_| slowness.note(ms(1), ms(10)));
        assert!((slowness.get() - 1.0).abs() < 1e-9);
    }
}
