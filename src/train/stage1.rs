//! Stage 1: latent identification (section 4.2 of the paper), gated by the probe.
//!
//! Now and then a run codes the state change instead of the context, or loses one axis of it (the ELBO is not
//! identifying from every initialisation), so the probe decides whether it counts; if not, it starts anew from another seed.

use super::{
    Task,
    dataset::{
        HELD_OUT_SEED,
        window::{BlockShape, Places, blocks},
    },
    learner::{Learner, Scalars},
    probe::{Subjects, latent_probe, places, probed},
    recipe::{Gate, Stage1},
    ridge::Table,
};
use crate::model::Networks;
use crate::model::{
    latent::{
        Evidence, LatentModel,
        elbo::{ElboBatch, ElboOptions},
    },
    noise::Philox,
};
use anyhow::{Context, Result};
use candle_core::Tensor;
use serde::Serialize;

/// Places of each side that the gate's probe uses.
const GATE_ROWS: usize = 6000;
/// Blocks of the held-out loss.
const HELD_OUT_BLOCKS: usize = 256;

/// Draws blocks and evaluates the ELBO; stage 2 keeps it on.
pub struct ElboTask<'a> {
    task: &'a Task,
    stage: &'a Stage1,
    shape: BlockShape,
    places: Places,
}

impl<'a> ElboTask<'a> {
    /// None for recipes without latents.
    pub fn new(task: &'a Task) -> Option<Self> {
        let (stage, latent) = (task.recipe.stage1.as_ref()?, task.config.method.latent.gru()?);
        let block_len = latent.block_len();
        let shape = BlockShape {
            batch: stage.batch,
            len: block_len + 1 + stage.length,
            looks: latent.looks,
            latent_dim: latent.dim,
            show_action: stage.show_action,
            show_reward: stage.show_reward,
            hide: task.recipe.hide,
        };
        Some(Self { task, stage, places: shape.places(&task.split.train), shape })
    }

    /// The batch of this step.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn batch(&self, rng: &mut Philox) -> Result<ElboBatch> {
        Ok(blocks(&self.task.split.train, &self.places, &self.shape, rng)?)
    }

    /// The loss of a batch, and its parts.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn loss(&self, networks: &Networks, batch: &ElboBatch, kl_weight: f64) -> Result<(Tensor, Scalars)> {
        let options = ElboOptions {
            kl_weight,
            state_change_std: self.task.config.units.normalizer.state_change_std.clone(),
            reward_weight: self.stage.reward_weight,
        };
        let latent = networks.latent.as_ref().context("stage 1 needs a latent model: is a bug")?;
        let terms = latent.elbo(batch, &options)?;
        let scalar = |tensor: &Tensor| -> Result<f64> { Ok(f64::from(tensor.to_scalar::<f32>()?)) };
        let scalars = vec![
            ("elbo", scalar(&terms.loss)?),
            ("state_error", scalar(&terms.state_error)?),
            ("reward_error", scalar(&terms.reward_error)?),
            ("kl", scalar(&terms.kl)?),
        ];
        Ok((terms.loss, scalars))
    }

    /// The ELBO of held-out blocks, always the same ones, with the last weight of the KL; none where no held-out episode has room for one.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn held_out_loss(&self, networks: &Networks) -> Result<Option<f64>> {
        let (episodes, shape) = (&self.task.split.held_out, BlockShape { batch: HELD_OUT_BLOCKS, ..self.shape.clone() });
        let places = shape.places(episodes);
        if places.is_empty() {
            return Ok(None);
        }
        let batch = blocks(episodes, &places, &shape, &mut Philox::new(HELD_OUT_SEED))?;
        let (loss, _) = self.loss(networks, &batch, self.stage.kl_weight.end)?;
        Ok(Some(f64::from(loss.to_scalar::<f32>()?)))
    }

    /// One optimizer step of stage 1.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn step(&self, learner: &mut Learner) -> Result<Scalars> {
        let step = learner.position.step;
        let batch = self.batch(&mut learner.position.stream(self.task.recipe.seed))?;
        let (loss, mut scalars) = self.loss(&learner.networks, &batch, self.stage.kl_weight.at(step))?;
        let rate = self.stage.learning_rate.at(step, self.stage.steps);
        let norm = learner.adam.step(&[loss.backward()?], &[rate, 0.0])?;
        scalars.extend([("grad_norm", norm), ("learning_rate", rate)]);
        Ok(scalars)
    }
}

/// What the gate saw.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct GateResult {
    /// Standardised error without the successor.
    pub filter: f64,
    /// Standardised error with the successor's state; none of a belief that is held, for it does not wait for one.
    pub successor_state: Option<f64>,
}

impl GateResult {
    /// Whether both errors are within the bounds.
    pub fn passes(&self, gate: &Gate) -> bool {
        self.filter <= gate.filter && self.successor_state.is_none_or(|error| error <= gate.successor_state)
    }
}

/// Probes the latent model at the recipe's block length.
///
/// # Errors
/// If the data have no context, or a tensor operation fails.
pub fn gate(task: &Task, latent: &LatentModel) -> Result<GateResult> {
    let subjects = Subjects { train: &task.split.train, held_out: &task.split.held_out, rows_max: GATE_ROWS };
    let error = |evidence| -> Result<f64> { Ok(latent_probe(latent, &subjects, evidence, task.looks(), &[0])?[0].error) };
    let successor_state = probed(latent).contains(&Evidence::SuccessorState).then(|| error(Evidence::SuccessorState)).transpose()?;
    Ok(GateResult { filter: error(Evidence::Filter)?, successor_state })
}

/// Whether the contexts that the gate holds the latent against differ at all: an error in units of their variance needs one.
///
/// # Errors
/// If rows are kept in a file and it cannot be read.
pub fn contexts_vary(task: &Task) -> Result<bool> {
    let episodes = &task.split.held_out;
    let mut truth = Table::new(episodes.first().map_or(0, |episode| episode.context_dim));
    for (episode, t) in places(episodes, GATE_ROWS).into_iter().filter(|(_, t)| *t >= task.config.method.latent.block_len()) {
        truth.values.extend(episodes[episode].context(t)?.iter().map(|value| f64::from(*value)));
    }
    Ok(truth.varies())
}
