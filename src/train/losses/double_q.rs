//! The errors of critics of skills on what came of them (LDCQ, Venkatraman et al. 2024): double Q-learning among skills that the prior offers,
//! drawn by how far off they were (prioritised replay, Schaul et al. 2016). What the prior offers does not change any more, so it is asked once,
//! before the stage. The slow copy is the average of the stage, which is what a checkpoint holds.

use super::{Job, Mean, Part, critic::Worth, denoise::window_shape, skill::NO_SKILL};
use crate::model::{
    Networks,
    columns::{Bounds, Columns},
    critic::{Critic, SkillTransitions},
    diffusion::{descent::Walk, draw::Draw, process::Process},
    nn::{Activations, Buffer},
    noise::{Noise, Philox},
};
use crate::train::{
    Task,
    dataset::{
        Episode, HELD_OUT_SEED,
        hidden::Hide,
        window::{SkillBatch, WindowShape, given_after, skill_places, skills},
    },
    parallel::side_by_side,
    recipe::losses::{DoubleQConfig, Loss},
};
use anyhow::{Context, Result};
use candle_core::{Device, Tensor};

/// Places in training episodes, and in held-out ones, that are looked at: of more, every so many-th, since what is offered at each is kept in memory.
const PLACES_MAX: usize = 1 << 14;
const HELD_OUT_PLACES: usize = 256;
/// Places whose offers are drawn together.
const PLACES_AT_ONCE: usize = 64;
/// What keeps a place from never being drawn again, standard deviations of the data's returns.
const LEAST_PRIORITY: f32 = 1e-2;

/// Draws skills and evaluates the loss. Those of play are drawn too: they show what comes of actions.
pub struct DoubleQLoss<'a> {
    task: &'a Task,
    config: &'a DoubleQConfig,
    /// In the sum that the stage minimizes.
    weight: f64,
    shape: WindowShape,
    train: Offers<'a>,
    held_out: Offers<'a>,
}

/// Places, and what the prior offers where the skill at each of them leads to.
struct Offers<'a> {
    episodes: &'a [Episode],
    places: Vec<(usize, usize)>,
    /// `(places, candidates, code_dim)`.
    codes: Vec<f32>,
}

/// Some of the places, as a step looks at them.
struct Replay {
    /// Which.
    drawn: Vec<usize>,
    batch: SkillBatch,
    /// How much each counts.
    weights: Vec<f32>,
    /// `(places, candidates, code_dim)` what is offered after each.
    next_codes: Vec<f32>,
}

impl<'a> Offers<'a> {
    fn new(episodes: &'a [Episode], steps: usize, most: usize) -> Self {
        let all = skill_places(episodes, steps);
        let every = all.len().div_ceil(most).max(1);
        Self { episodes, places: all.into_iter().step_by(every).collect(), codes: Vec::new() }
    }
}

impl<'a> DoubleQLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::DoubleQ);
        let config = task.recipe.losses.double_q.as_ref().filter(|_| weight > 0.0)?;
        let shape = WindowShape { hide: Hide::NOTHING, ..window_shape(task, config.batch) };
        let (steps, episodes) = (task.config.method.plan.diffused.code_steps()?, &task.split.episodes);
        let (train, held_out) = (Offers::new(&episodes.train, steps, PLACES_MAX), Offers::new(&episodes.held_out, steps, HELD_OUT_PLACES));
        Some(Self { task, config, weight, shape, train, held_out })
    }

    /// Asks the prior what it has to offer at all places.
    ///
    /// # Errors
    /// If an episode cannot be read, or a tensor operation fails.
    pub(super) fn look_for_offers(&mut self, networks: &Networks) -> Result<()> {
        self.train.codes = self.offered(networks, &self.train, self.task.recipe.seed)?;
        self.held_out.codes = self.offered(networks, &self.held_out, HELD_OUT_SEED)?;
        Ok(())
    }

    fn offered(&self, networks: &Networks, offers: &Offers, seed: u64) -> Result<Vec<f32>> {
        let job = |(index, places): (usize, &'_ [(usize, usize)])| {
            let (first, places) = (index * PLACES_AT_ONCE, places.to_vec());
            move || self.offered_at(networks, offers.episodes, &places, (first, seed))
        };
        let jobs = offers.places.chunks(PLACES_AT_ONCE).enumerate().map(job).collect();
        let parts = side_by_side(jobs).into_iter().collect::<Result<Vec<_>>>()?;
        Ok(parts.concat())
    }

    /// At some of the places, of which the first has this index.
    fn offered_at(
        &self,
        networks: &Networks,
        episodes: &[Episode],
        places: &[(usize, usize)],
        (first, seed): (usize, u64),
    ) -> Result<Vec<f32>> {
        let (plan, units, each) = (&self.task.config.method.plan, &self.task.config.units, self.config.candidates);
        let columns = Columns::new(plan.diffused, self.task.config.layout);
        let walk = Walk {
            process: &Process::new(plan.alpha, plan.level_max),
            columns: &columns,
            bounds: &Bounds::new(&columns, plan.clip, units),
        };
        let given = given_after(episodes, places, &self.shape, &mut Philox::new(seed))?;
        let (rows, observed) = (places.len() * each, given.observed.context("a code is drawn beside the real steps: is a bug")?);
        let (values, width) = (observed.flatten_all()?.to_vec1::<f32>()?, observed.dim(2)?);
        let repeated = Buffer::generate([rows, 1, width], |out| {
            let out = out.chunks_exact_mut(each * width).zip(values.chunks_exact(width));
            out.for_each(|(out, row)| out.chunks_exact_mut(width).for_each(|out| out.copy_from_slice(row)));
        })?;
        let draw = Draw { plan, walk, options: &self.task.recipe.sampler, noise: Noise::new(seed), first: (first * each) as u64 };
        Ok(draw.windows(&networks.denoiser, Some(&repeated), rows)?)
    }

    /// What nobody has looked at yet comes first.
    pub(super) fn first_priorities(&self) -> Vec<f32> {
        vec![1.0; self.train.places.len()]
    }

    /// Draws the batch of a step by these priorities; `target` is the slow copy.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, target: &'b Critic, priorities: &[f32], rng: &mut Philox) -> Result<Job<'b>> {
        let (drawn, weights) = replayed(priorities, self.config, rng);
        let replay = self.look_at(&self.train, drawn, weights, rng)?;
        Ok(Box::new(move || {
            let (loss, off) = self.errors(networks, target, &replay)?;
            let off = replay.drawn.iter().zip(off).map(|(index, off)| (*index, off + LEAST_PRIORITY)).collect();
            Ok(Part { off, ..Part::of(&loss, self.weight, vec![Mean::of("double_q", &loss)?])? })
        }))
    }

    /// The error on held-out places, by the critics alone.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let all = self.held_out.places.len();
        let replay = self.look_at(&self.held_out, (0..all).collect(), vec![1.0; all], &mut Philox::new(HELD_OUT_SEED))?;
        let (loss, _) = self.errors(networks, networks.critic.as_ref().context(NO_CRITIC)?, &replay)?;
        Ok(f64::from(loss.to_scalar::<f32>()?))
    }

    fn look_at(&self, offers: &Offers, drawn: Vec<usize>, weights: Vec<f32>, rng: &mut Philox) -> Result<Replay> {
        let places: Vec<_> = drawn.iter().map(|index| offers.places[*index]).collect();
        let (steps, dim) = (self.shape.plan.diffused.code_steps().unwrap_or(1), self.shape.plan.diffused.code_dim());
        let size = self.config.candidates * dim;
        let next_codes = drawn.iter().flat_map(|index| &offers.codes[index * size..][..size]).copied().collect();
        Ok(Replay { batch: skills(offers.episodes, &places, [steps, dim], rng)?, drawn, weights, next_codes })
    }

    fn errors(&self, networks: &Networks, target: &Critic, replay: &Replay) -> Result<(Tensor, Vec<f32>)> {
        let (critic, skill) = (networks.critic.as_ref().context(NO_CRITIC)?, networks.skill.as_ref().context(NO_SKILL)?);
        let Replay { drawn, batch, weights, next_codes } = replay;
        let (rows, dim, each) = (drawn.len(), self.task.config.method.plan.diffused.code_dim(), self.config.candidates);
        let column = |values: Vec<f32>| Tensor::from_vec(values, (rows, 1, 1), &Device::Cpu);
        let (worth, discount) = (Worth::of(self.task), f64::from(self.task.config.method.discount));
        let steps = batch.rewards.len() / rows.max(1);
        let own = |rewards: &[f32]| own_share(rewards.iter().map(|reward| worth.of_reward(*reward)), discount) as f32;
        let of = SkillTransitions {
            state: &batch.segments.steps.narrow(1, 0, 1)?.narrow(2, 0, self.task.config.layout.state_dim)?.contiguous()?,
            code: &skill.codes(&batch.segments)?,
            reward: &column(batch.rewards.chunks_exact(steps).map(own).collect())?,
            next_state: &batch.next_state,
            next_codes: &Tensor::from_slice(next_codes, (rows, each, dim), &Device::Cpu)?,
            ended: &column(batch.ended.iter().map(|ended| f32::from(*ended)).collect())?,
            end_worth: worth.of_raw(0.0),
            weight: &column(weights.to_vec())?,
        };
        Ok(critic.double_errors(target, &of, discount.powi(steps as i32))?)
    }
}

const NO_CRITIC: &str = "a model without critics has no error of them: is a bug";

/// The share of a skill's own steps in what it is worth, `(1 - g) sum g^i w_i`: of what comes after them it is `g^H`, and of both together 1.
fn own_share(worths: impl Iterator<Item = f64>, discount: f64) -> f64 {
    worths.enumerate().map(|(i, worth)| (1.0 - discount) * discount.powi(i as i32) * worth).sum()
}

/// Places drawn by their priorities, and how much each counts: the less, the more often it is drawn; the least drawn of them wholly.
fn replayed(priorities: &[f32], config: &DoubleQConfig, rng: &mut Philox) -> (Vec<usize>, Vec<f32>) {
    let mut sums = Vec::with_capacity(priorities.len());
    let mut all = 0.0;
    for priority in priorities {
        all += f64::from(*priority).powf(config.priority);
        sums.push(all);
    }
    let drawn: Vec<f64> = (0..config.batch).map(|_| f64::from(rng.uniform()) * all).collect();
    let drawn: Vec<usize> = drawn.into_iter().map(|at| sums.partition_point(|sum| *sum <= at).min(priorities.len() - 1)).collect();
    let often = |index: &usize| f64::from(priorities[*index]).powf(config.priority);
    let least = drawn.iter().map(often).fold(f64::INFINITY, f64::min);
    let weights = drawn.iter().map(|index| (least / often(index)).powf(config.importance) as f32).collect();
    (drawn, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half of the first, a quarter of the second, an eighth of the third; who earns 1 for ever is worth 1.
    #[test]
    fn a_skill_is_worth_its_share() {
        assert_eq!(own_share([1.0, 2.0, 4.0].into_iter(), 0.5), 1.5);
        assert!((own_share([1.0; 7].into_iter(), 0.9) + 0.9_f64.powi(7) - 1.0).abs() < 1e-12);
    }

    /// Drawn as often as the power of the priority says, and what that does to the mean is taken back.
    #[test]
    fn places_are_replayed_by_their_priorities() {
        let config = DoubleQConfig { batch: 40_000, candidates: 1, priority: 0.5, importance: 1.0 };
        let priorities = [1.0, 4.0, 0.0, 16.0];
        let (drawn, weights) = replayed(&priorities, &config, &mut Philox::new(1));
        let share = |index: usize| drawn.iter().filter(|drawn| **drawn == index).count() as f64 / 40_000.0;
        for (index, expected) in [1.0 / 7.0, 2.0 / 7.0, 0.0, 4.0 / 7.0].into_iter().enumerate() {
            assert!((share(index) - expected).abs() < 0.01, "{index}: {}", share(index));
        }
        let weight = |index: usize| weights[drawn.iter().position(|drawn| *drawn == index).unwrap()];
        assert_eq!([weight(0), weight(1), weight(3)], [1.0, 0.5, 0.25]);
    }
}
