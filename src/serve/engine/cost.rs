//! What a tick costs: measured at warm-up for every batch length, so that an act with a deadline can be told how many it may still take. More rows
//! than were measured cost in proportion.

use crate::model::{
    agent::{Act, Agent, AgentError, Observation},
    normalizer::Affine,
    options::SamplerOptions,
};
use parking_lot::RwLock;
use std::{
    sync::{Arc, Weak},
    time::Duration,
};
use tokio::time::Instant;

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

/// What takes part in a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Load {
    /// Acts.
    pub acts: usize,
    /// Their rows together ([`Act::rows`]).
    pub rows: usize,
}

impl Load {
    /// These acts, or as many of them as have room in so many rows.
    pub fn of(acts: &[Act], rows_max: usize) -> Self {
        let rows = acts.iter().map(Act::rows);
        let largest = rows.clone().max().unwrap_or(0);
        Self { acts: acts.len(), rows: rows.sum() }.within(rows_max, largest)
    }

    /// As much of it as has room in so many rows, or in those of an act that has more.
    pub fn within(self, rows_max: usize, largest: usize) -> Self {
        Self { acts: self.acts.min(rows_max), rows: self.rows.min(rows_max.max(largest)) }
    }
}

/// Costs of one model on one worker.
#[derive(Debug)]
pub(super) struct Costs {
    /// A tick of acts on their way, by rows from 1.
    ticks: Vec<Duration>,
    /// What the first tick costs more, by acts from 1: latents and their prior chain, which all rows of an act share.
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

    /// A tick of so many rows, with the start of `fresh` acts among them.
    pub fn tick(&self, rows: usize, fresh: usize) -> Duration {
        of(&self.ticks, rows) + if fresh > 0 { of(&self.starts, fresh) } else { Duration::ZERO }
    }

    /// So many ticks of these rows.
    pub fn ticks(&self, ticks: usize, rows: usize) -> Duration {
        self.tick(rows, 0) * u32::try_from(ticks).unwrap_or(u32::MAX)
    }

    /// A whole act of so many forwards in this company, which is its own too.
    pub fn act(&self, forwards: usize, load: Load) -> Duration {
        self.ticks(forwards, load.rows) + of(&self.starts, load.acts)
    }

    /// What of a worker's time an act of so many forwards and rows takes when its batch is full.
    pub fn share(&self, forwards: usize, rows: usize) -> Duration {
        let len = self.ticks.len().max(1);
        (self.ticks(forwards, len) * u32::try_from(rows).unwrap_or(u32::MAX) + of(&self.starts, len)) / len as u32
    }

    /// Ticks in this company that fit into `left` for one that has started or not, if each waits for `others` too and everything takes
    /// `slowness` times as long as it did at warm-up.
    pub fn ticks_within(&self, left: Duration, (load, started): (Load, bool), others: Duration, slowness: f64) -> usize {
        let start = if started { Duration::ZERO } else { of(&self.starts, load.acts) };
        let tick = (self.tick(load.rows, 0) + others).as_secs_f64();
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

/// What so many cost: as measured, and in proportion beyond the most that were.
fn of(costs: &[Duration], len: usize) -> Duration {
    let beyond = || costs.last().map_or(Duration::ZERO, |last| last.mul_f64(len as f64 / costs.len() as f64));
    costs.get(len.max(1) - 1).copied().unwrap_or_else(beyond)
}

fn timed(work: impl FnOnce() -> Result<(), AgentError>) -> Result<Duration, AgentError> {
    let begin = Instant::now();
    work()?;
    Ok(begin.elapsed())
}

/// First acts of as many sessions, of one row each, within what the model knows: one standard deviation off the mean.
fn acts(agent: &Agent, len: usize) -> Result<Vec<Act>, AgentError> {
    let (units, options) = (&agent.config().units, of_one_row(&agent.spec().sampler));
    let off = |known: &Affine| known.denormalize(&vec![1.0; known.dim()]);
    let context = units.context.as_ref().map(|context| vec![off(context)]);
    let observation = Observation { state: off(&units.normalizer.state), context, ..Observation::default() };
    let begin = |seed| agent.begin(&agent.open(seed, &options)?, &observation);
    (0..len as u64).map(begin).collect()
}

/// These options, but for what makes an act of several rows, or lets a guide lead it: then rows are acts, whatever a checkpoint's defaults are.
fn of_one_row(options: &SamplerOptions) -> SamplerOptions {
    SamplerOptions {
        guidance_scale: 0.0,
        guidance_samples: 0,
        free_guidance_scale: 1.0,
        candidates: 1,
        picard_window: 1,
        ..options.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::checkpoint;
    use std::path::Path;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn ticks_that_fit() {
        let costs = Costs { ticks: vec![ms(2), ms(3)], starts: vec![ms(4), ms(5)] };
        let alike = |len| Load { acts: len, rows: len };
        let within = |left, len, started, others, slowness| costs.ticks_within(ms(left), (alike(len), started), ms(others), slowness);
        assert_eq!(within(9, 1, true, 0, 1.0), 4);
        assert_eq!(within(9, 1, false, 0, 1.0), 2);
        assert_eq!(within(9, 1, true, 0, 2.0), 2);
        assert_eq!(within(9, 1, true, 2, 1.0), 2);
        assert_eq!(within(3, 1, false, 0, 1.0), 0);
        assert_eq!(costs.tick(2, 1), ms(7));
        assert_eq!((costs.act(3, alike(1)), costs.act(3, alike(2))), (ms(10), ms(14)));
        assert_eq!(costs.share(3, 1), ms(7), "of a full batch");
    }

    /// An act of 64 candidates in a batch of two was taken to cost as much as one of two.
    #[test]
    fn more_rows_than_were_measured_cost_in_proportion() {
        let costs = Costs { ticks: vec![ms(2), ms(3)], starts: vec![ms(4), ms(5)] };
        let wide = Load { acts: 1, rows: 64 };
        assert_eq!((costs.tick(64, 0), costs.tick(64, 1)), (ms(96), ms(100)), "its latents are inferred once");
        assert_eq!((costs.act(3, wide), costs.ticks(3, 64)), (ms(292), ms(288)));
        assert_eq!(costs.ticks_within(ms(293), (wide, false), Duration::ZERO, 1.0), 3);
        assert_eq!(costs.ticks_within(ms(291), (wide, false), Duration::ZERO, 1.0), 2);
        assert_eq!(costs.share(4, 64), ms(6) * 64 + ms(5) / 2);
        assert_eq!(Costs { ticks: vec![], starts: vec![] }.act(3, wide), Duration::ZERO, "nothing was measured");
    }

    /// Whatever a checkpoint's defaults are, a row is measured as a row.
    #[test]
    fn warm_up_measures_acts_of_one_row() {
        let agent = checkpoint::load(Path::new("models/tiny")).unwrap();
        let mut config = agent.config().clone();
        config.defaults.sampler.picard_window = 4;
        let out = tempfile::tempdir().unwrap();
        checkpoint::copy_with(Path::new("models/tiny"), out.path(), &config).unwrap();
        let agent = checkpoint::load(out.path()).unwrap();
        assert_eq!(agent.spec().sampler.picard_window, 4);
        assert!(acts(&agent, 3).unwrap().iter().all(|act| act.rows() == 1));
        let wild = SamplerOptions {
            guidance_scale: 2.0,
            guidance_samples: 3,
            free_guidance_scale: 1.5,
            candidates: 9,
            ..agent.spec().sampler.clone()
        };
        assert_eq!((of_one_row(&wild).rows_max(), of_one_row(&wild).guidance_scale), (1, 0.0));
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
