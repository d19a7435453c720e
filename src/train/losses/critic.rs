//! The errors of critics on drawn transitions (implicit Q-learning, Kostrikov et al. 2022), with latents as an act has them. The slow copy that they
//! are drawn to is the average of the stage, which is what a checkpoint holds.

use super::{
    Job, Mean, Part,
    denoise::{refine_options, window_shape},
};
use crate::model::{
    Networks,
    critic::{Critic, CriticTerms, Transitions},
    diffusion::refine::{RefineOptions, WindowBatch},
    method::Diffusion,
    noise::Philox,
};
use crate::train::{
    Task,
    dataset::{
        HELD_OUT_SEED, Sides,
        hidden::Hide,
        places::Places,
        window::{TransitionBatch, WindowShape, transitions},
    },
    recipe::losses::{CriticConfig, Loss},
};
use anyhow::{Context, Result};
use candle_core::{Device, Tensor};

/// Held-out transitions.
const HELD_OUT_TRANSITIONS: usize = 1024;

/// Draws transitions and evaluates the loss. Play is drawn too: it shows what comes of actions.
pub struct CriticLoss<'a> {
    task: &'a Task,
    config: &'a CriticConfig,
    /// In the sum that the stage minimizes.
    weight: f64,
    shape: WindowShape,
    episodes: Sides,
    places: Places,
    options: RefineOptions,
}

impl<'a> CriticLoss<'a> {
    /// As the stage with this index has it; none where it does not.
    pub fn of_stage(task: &'a Task, stage: usize) -> Option<Self> {
        let weight = task.recipe.stages.get(stage)?.weight_there(Loss::Critic);
        let config = task.recipe.losses.critic.as_ref().filter(|_| weight > 0.0)?;
        let shape = window_shape(task, config.batch);
        let shape = WindowShape { plan: Diffusion { horizon: 1, ..shape.plan.clone() }, ..shape };
        let episodes = task.split.episodes.clone();
        Some(Self {
            task,
            config,
            weight,
            places: Places::of_transitions(&episodes.train),
            shape,
            episodes,
            options: refine_options(task, false),
        })
    }

    /// Draws from these episodes, which are the task's own and may tell more.
    pub(super) fn look_at(&mut self, episodes: &Sides) {
        self.episodes = episodes.clone();
    }

    /// Draws the batch of a step; `target` is the slow copy.
    ///
    /// # Errors
    /// If an episode cannot be read.
    pub(super) fn job<'b>(&'b self, networks: &'b Networks, target: &'b Critic, rng: &mut Philox) -> Result<Job<'b>> {
        let batch = transitions(&self.episodes.train, &self.places, &self.shape, rng)?;
        Ok(Box::new(move || {
            let CriticTerms { loss, q, v } = self.errors(networks, target, &batch)?;
            Part::of(&loss, self.weight, vec![Mean::of("q", &q)?, Mean::of("v", &v)?])
        }))
    }

    /// The sum of both errors on held-out transitions, by the critics alone.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out(&self, networks: &Networks) -> Result<f64> {
        let shape = WindowShape { batch: HELD_OUT_TRANSITIONS, hide: Hide::NOTHING, ..self.shape.clone() };
        let episodes = &self.episodes.held_out;
        let batch = transitions(episodes, &Places::of_transitions(episodes), &shape, &mut Philox::new(HELD_OUT_SEED))?;
        let critic = networks.critic.as_ref().context(NO_CRITIC)?;
        Ok(f64::from(self.errors(networks, critic, &batch)?.loss.to_scalar::<f32>()?))
    }

    fn errors(&self, networks: &Networks, target: &Critic, batch: &TransitionBatch) -> Result<CriticTerms> {
        let critic = networks.critic.as_ref().context(NO_CRITIC)?;
        let layout = self.task.config.layout;
        let latent = |windows: &WindowBatch| networks.latents_of(&self.shape.plan, windows, &self.options);
        let part = |windows: &WindowBatch, start, len| windows.window.narrow(2, start, len)?.contiguous();
        let column = |values: Vec<f32>| Tensor::from_vec(values, (batch.rewards.len(), 1, 1), &Device::Cpu);
        let worth = Worth::of(self.task);
        let discount = f64::from(self.task.config.method.discount);
        let latents = [latent(&batch.now)?, latent(&batch.next)?];
        let of = Transitions {
            state: &part(&batch.now, 0, layout.state_dim)?,
            action: &part(&batch.now, layout.state_dim, layout.action_dim)?,
            latent: latents[0].as_ref(),
            next_state: &part(&batch.next, 0, layout.state_dim)?,
            next_latent: latents[1].as_ref(),
            reward: &column(batch.rewards.iter().map(|reward| ((1.0 - discount) * worth.of_reward(*reward)) as f32).collect())?,
            end_worth: worth.of_raw(0.0),
            ended: &column(batch.ended.iter().map(|ended| f32::from(*ended)).collect())?,
        };
        Ok(critic.errors(target, &of, (discount, self.config.expectile))?)
    }
}

const NO_CRITIC: &str = "a model without critics has no error of them: is a bug";

/// From rewards to what having them for ever is worth, standard deviations of the data's returns.
pub(super) struct Worth {
    reward: [f64; 2],
    returns: [f64; 2],
}

impl Worth {
    pub(super) fn of(task: &Task) -> Self {
        let units = &task.config.units;
        let reward = &units.normalizer.reward;
        let returns = units.returns.as_ref().map_or([0.0, 1.0], |returns| [returns.mean[0], returns.std[0]]);
        Self { reward: [reward.mean[0], reward.std[0]].map(f64::from), returns: returns.map(f64::from) }
    }

    /// Of a reward as episodes hold it.
    pub(super) fn of_reward(&self, reward: f32) -> f64 {
        self.of_raw(self.reward[0] + self.reward[1] * f64::from(reward))
    }

    /// Of one in units of the data: after an end there is none, which is 0.
    pub(super) fn of_raw(&self, reward: f64) -> f64 {
        (reward - self.returns[0]) / self.returns[1]
    }
}

#[cfg(test)]
mod tests {
    use crate::model::{
        critic::{Critic, Judged, Transitions},
        nn::params::Params,
    };
    use crate::train::optimizer::{Adam, Ema};
    use candle_core::{Device, Tensor};

    use super::Worth;

    const DISCOUNT: f64 = 0.8;
    const TAU: f64 = 0.75;
    const END: f64 = -0.5;

    fn column(values: &[f32], width: usize) -> Tensor {
        Tensor::from_slice(values, (values.len() / width, 1, width), &Device::Cpu).unwrap()
    }

    /// Units of 10 with mean 3 for rewards, of 4 with mean 2 for returns: half a reward's unit is 8, which for ever is 1.5 of a return's; nothing, after
    /// an end, is half of one below the mean.
    #[test]
    fn rewards_are_worth_what_returns_are() {
        let worth = Worth { reward: [3.0, 10.0], returns: [2.0, 4.0] };
        assert_eq!([worth.of_reward(0.5), worth.of_raw(0.0)], [1.5, -0.5]);
    }

    /// A world of two states and two actions whose worths can be written down: in state 0 to stay pays .5 and to go pays nothing; in state 1 to
    /// go back pays nothing, and to go on pays 1 and ends. V is `tau` of the better action and the rest of the other, Q is the reward and V
    /// of what comes, found by going round.
    fn expected() -> ([[f64; 2]; 2], [f64; 2]) {
        let mut q = [[0.0_f64; 2]; 2];
        for _ in 0..500 {
            let v = q.map(|[a, b]| TAU * a.max(b) + (1.0 - TAU) * a.min(b));
            q = [[0.5 + DISCOUNT * v[0], DISCOUNT * v[1]], [DISCOUNT * v[0], 1.0 + DISCOUNT * END]];
        }
        (q, q.map(|[a, b]| TAU * a.max(b) + (1.0 - TAU) * a.min(b)))
    }

    /// Critics that learn from all four transitions, each as often, with the average of their weights as the slow copy, find those worths.
    #[test]
    fn critics_of_a_small_world_find_its_worths() {
        let judged = Judged { state_dim: 2, choice_dim: 1, latent_dim: 0, state_alone: true };
        let params = Params::fresh(3);
        let critic = Critic::new(judged, 24, &params).unwrap();
        let vars = params.vars();
        let (mut adam, mut ema) = (Adam::new(&vars, |_| Some(0), 0.0, f64::INFINITY), Ema::new(&vars, 0.98).unwrap());
        let (zero, one) = ([1.0, 0.0], [0.0, 1.0]);
        let state = column(&[zero, zero, one, one].concat(), 2);
        let next_state = column(&[zero, one, zero, one].concat(), 2);
        let action = column(&[-1.0, 1.0, -1.0, 1.0], 1);
        let (reward, ended) = (column(&[0.5, 0.0, 0.0, 1.0], 1), column(&[0.0, 0.0, 0.0, 1.0], 1));
        let of = Transitions {
            state: &state,
            action: &action,
            latent: None,
            next_state: &next_state,
            next_latent: None,
            reward: &reward,
            end_worth: END,
            ended: &ended,
        };
        for step in 0..2500 {
            let slow = Critic::new(judged, 24, &Params::loaded(ema.tensors(&vars).unwrap())).unwrap();
            let loss = critic.errors(&slow, &of, (DISCOUNT, TAU)).unwrap().loss;
            adam.step(&[loss.backward().unwrap()], &[3e-3]).unwrap();
            ema.update(&vars, step).unwrap();
        }
        let numbers = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (q, v) = expected();
        for found in critic.q(&state, &action, None).unwrap() {
            for (found, expected) in numbers(found).into_iter().zip(q.as_flattened()) {
                assert!((f64::from(found) - expected).abs() < 0.02, "{found} {expected}");
            }
        }
        for (found, expected) in numbers(critic.v(&state, None).unwrap()).into_iter().zip([v[0], v[0], v[1], v[1]]) {
            assert!((f64::from(found) - expected).abs() < 0.02, "{found} {expected}");
        }
    }
}
