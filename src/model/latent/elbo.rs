//! Evidence lower bound over a block (equation of section 4.2; appendix A.4).

use super::{Gaussian, LatentModel, Tokens};
use crate::model::trajectory::Seen;
use candle_core::{Device, Result, Tensor};

/// One batch of blocks.
pub struct ElboBatch {
    /// `(B, L)` real tokens; positions before an episode's start are wholly absent.
    pub tokens: Tokens,
    /// `(B, L - 1)`: 1 where both position t and t + 1 are real.
    pub valid: Tensor,
    /// `(B, L, 3)`: which parts of a token are shown while it is history; a hidden part is still what the decoder has to explain.
    pub history_shown: Tensor,
    /// `(B, L - 1, 3)`: which parts of the successor x_{t+1} the posterior of c_t may see; the state always, action and reward now and then,
    /// so that one network serves the filter (state alone) and the refinement (state and action).
    pub successor_shown: Tensor,
    /// `(B, L - 1, dim)` Gaussian draws of the latents.
    pub eps: Tensor,
}

/// Settings of the loss.
#[derive(Clone, Debug)]
pub struct ElboOptions {
    /// Weight of the KL term.
    pub kl_weight: f64,
    /// Standard deviation of the state change in normalized units, `state_dim` values.
    pub state_change_std: Vec<f32>,
    /// Weight of the reward's squared error against the mean over the state's columns.
    pub reward_weight: f64,
}

/// Scalars of one evaluation.
pub struct ElboTerms {
    /// What is minimised.
    pub loss: Tensor,
    /// Mean squared residual of states, in units of the state change's variance.
    pub state_error: Tensor,
    /// Mean squared residual of rewards, normalized units.
    pub reward_error: Tensor,
    /// KL(q || p), summed over latent dimensions, mean over positions.
    pub kl: Tensor,
}

impl LatentModel {
    /// Posteriors q(c_t) for t = 0 .. L-2, from the GRU state after x_t and a throw-away step on what is shown of x_{t+1}:
    /// Gaussians of `(B, L - 1, dim)`. `history_shown` and `successor_shown` as in [`ElboBatch`].
    ///
    /// # Errors
    /// If widths differ.
    pub fn posteriors(&self, tokens: &Tokens, history_shown: &Tensor, successor_shown: &Tensor) -> Result<Gaussian> {
        let (batch, len) = tokens.batch_len()?;
        let (mut history, mut successors) = (tokens.narrow(0, len - 1)?, tokens.narrow(1, len - 1)?);
        history.present = history.present.mul(&history_shown.narrow(1, 0, len - 1)?)?;
        successors.present = successors.present.mul(successor_shown)?;
        let states = self.encoder.states(&history, None)?;
        let rows = batch * (len - 1);
        let flat = |t: &Tensor| t.reshape((rows, 1, ()));
        let successors = Tokens {
            state: flat(&successors.state)?,
            action: flat(&successors.action)?,
            reward: flat(&successors.reward)?,
            present: flat(&successors.present)?,
            noise: flat(&successors.noise)?,
        };
        let after = self.encoder.states(&successors, Some(&states.reshape((rows, 1, ()))?))?;
        self.encoder.posterior(&after.reshape((batch, len - 1, ()))?)
    }

    /// The negative ELBO of a batch. The prior of c_t sees the posterior of c_{t-1} with its gradient; the first position
    /// has no predecessor in the block and only trains the decoder.
    ///
    /// State residuals are in units of the standard deviation of the state *change*: in units of the state the part that a hidden context
    /// explains is too small to pay for its KL (measured on Point-Wind-S: the wind is not identified). A likelihood with fitted variances
    /// does worse still: where two columns share one noise (position and velocity) it pays without bound to code that noise (measured:
    /// probe error .99).
    ///
    /// # Errors
    /// If shapes differ.
    pub fn elbo(&self, batch: &ElboBatch, options: &ElboOptions) -> Result<ElboTerms> {
        let (_, len) = batch.tokens.batch_len()?;
        let Explained { q, from } = self.explained(batch)?;
        let (steps, valid) = (len - 1 - from, batch.valid.narrow(1, from, len - 1 - from)?);
        let latent = q.sample(&batch.eps.narrow(1, from, steps)?)?;
        let (now, next) = (batch.tokens.narrow(from, steps)?, batch.tokens.narrow(from + 1, steps)?);
        let (change, reward) = self.decoder.predict(&now.state, &now.action, &latent)?;
        let std = Tensor::new(options.state_change_std.as_slice(), change.device())?;
        let target = (&next.state - &now.state)?.broadcast_div(&std)?;
        let count = valid.sum_all()?;
        let column_error = |residual: Tensor| -> Result<Tensor> {
            residual.sqr()?.broadcast_mul(&valid.unsqueeze(2)?)?.sum((0, 1))?.broadcast_div(&count)
        };
        let (state_error, reward_error) = (column_error((change - target)?)?, column_error((reward - &now.reward)?)?);
        let (state_error, reward_error) = (state_error.mean_all()?, reward_error.mean_all()?);
        let kl = self.block_kl(&q, &valid)?;
        let rec = (&state_error + reward_error.affine(options.reward_weight, 0.0)?)?;
        let loss = (rec + kl.affine(options.kl_weight, 0.0)?)?;
        Ok(ElboTerms { loss, state_error, reward_error, kl })
    }

    /// The latents that explain the steps of a block, and the first step that has one: c_t of a model with a prior waits for what is shown of
    /// x_{t+1}, from the first step on; a belief that is held is all that is known before the step, from the second step on.
    fn explained(&self, batch: &ElboBatch) -> Result<Explained> {
        if self.prior.is_some() {
            return Ok(Explained { q: self.posteriors(&batch.tokens, &batch.history_shown, &batch.successor_shown)?, from: 0 });
        }
        let state = Tensor::new(&Seen::STATE.flags(), &Device::Cpu)?;
        let shown = state.broadcast_as(batch.successor_shown.shape())?.contiguous()?;
        let beliefs = self.posteriors(&batch.tokens, &batch.history_shown, &shown)?;
        let steps = beliefs.mean.dim(1)? - 1;
        Ok(Explained { q: beliefs.narrow(0, steps)?, from: 1 })
    }

    /// KL to the prior of each step but the first, or of a held belief to N(0, I).
    fn block_kl(&self, q: &Gaussian, valid: &Tensor) -> Result<Tensor> {
        let Some(prior) = &self.prior else {
            let standard = Gaussian { mean: q.mean.zeros_like()?, log_var: q.mean.zeros_like()? };
            return (q.kl(&standard)? * valid)?.sum_all()? / valid.sum_all()?;
        };
        let steps = q.mean.dim(1)?;
        let prior = prior.predict(&q.narrow(0, steps - 1)?)?;
        let valid = valid.narrow(1, 1, steps - 1)?;
        let kl = (q.narrow(1, steps - 1)?.kl(&prior)? * &valid)?.sum_all()?;
        kl / valid.sum_all()?
    }
}

/// See [`LatentModel::explained`].
struct Explained {
    /// `(B, L - 1 - from, dim)`.
    q: Gaussian,
    from: usize,
}

#[cfg(test)]
#[path = "elbo_tests.rs"]
mod tests;
