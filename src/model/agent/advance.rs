//! One network evaluation for many descents: gather rows, infer and refine latents, predict, scatter. It works on pooled buffers and
//! allocates nothing once a batch of this size has been seen.

use super::{Agent, AgentError, Descent, descent::Walk};
use crate::model::{
    denoiser::Condition,
    latent::{Gaussian, GaussianRef, LatentModel, Tokens, hold_within},
    nn::{Buffer, Value},
    trajectory::{Layout, TokenRef},
};
use candle_core::Result;

impl Agent {
    /// One denoiser forward shared by all these descents, none of which is done; rows do not influence each other.
    ///
    /// # Errors
    /// [`AgentError::Tensor`] for a defect; a row whose output is not finite fails alone, at [`Agent::finish`].
    pub fn advance(&self, descents: &mut [Descent]) -> std::result::Result<(), AgentError> {
        if descents.is_empty() {
            return Ok(());
        }
        self.start_rows(descents)?;
        self.refine_rows(descents)?;
        let x0 = self.predict_rows(descents)?;
        let size = x0.len() / descents.len();
        descents.iter_mut().zip(x0.chunks_exact(size)).for_each(|(descent, x0)| descent.step_down(x0, self.walk()));
        Ok(())
    }

    pub(super) fn walk(&self) -> Walk<'_> {
        Walk { config: &self.config, process: &self.process }
    }

    /// The filter: latents of rows that have not started, from real history and the current state; then their windows.
    fn start_rows(&self, descents: &mut [Descent]) -> Result<()> {
        let fresh = |descent: &Descent| !descent.has_started();
        let count = descents.iter().filter(|descent| fresh(descent)).count();
        if count == 0 {
            return Ok(());
        }
        if let Some(latent) = &self.networks.latent {
            let filter = latent.infer(&self.blocks(descents, fresh, 1)?)?;
            roll_out(latent, filter, descents, fresh, 0)?;
        }
        descents.iter_mut().filter(|descent| fresh(descent)).for_each(|descent| descent.start(self.walk()));
        Ok(())
    }

    /// Zig-zag: at READY the latent of position 0 is the posterior given the noised positions 0 and 1, held in a trust region around the
    /// filter's, and the chain is rolled out anew from it.
    fn refine_rows(&self, descents: &mut [Descent]) -> Result<()> {
        let wants = |descent: &Descent| descent.wants_refinement();
        let (Some(latent), true) = (&self.networks.latent, descents.iter().any(wants)) else { return Ok(()) };
        let posterior = latent.infer(&self.blocks(descents, wants, self.config.plan_horizon.min(2))?)?;
        let [count, _, dim] = posterior.mean.shape()?;
        let mut log_var = Buffer::generate([count, 1, dim], |out| out.copy_from_slice(&posterior.log_var))?;
        let mean = Buffer::generate([count, 1, dim], |mean| {
            mean.copy_from_slice(&posterior.mean);
            let rows = mean.chunks_exact_mut(dim).zip(log_var.chunks_exact_mut(dim));
            for ((mean, log_var), descent) in rows.zip(descents.iter().filter(|descent| wants(descent))) {
                hold_within(mean, log_var, descent.chain.get(0), descent.episode.options.kappa);
            }
        })?;
        let head = Gaussian { mean, log_var };
        set_chain(&head, descents, wants, 0);
        roll_out(latent, head, descents, wants, 1)
    }

    /// The last `block_len` tokens of each row that `which` takes, wholly absent ones in front where there are fewer, and behind them the
    /// current state (of a row that has not started), or the first `ahead` noised positions.
    fn blocks(&self, descents: &[Descent], which: impl Fn(&Descent) -> bool, ahead: usize) -> Result<Tokens<Buffer>> {
        let rows = descents.iter().filter(|descent| which(descent));
        Tokens::pack(self.config.layout, rows, self.config.block_len + ahead, |descent, position| self.block_token(descent, position))
    }

    fn block_token<'a>(&'a self, descent: &'a Descent, position: usize) -> TokenRef<'a> {
        let len = self.config.block_len;
        match position.checked_sub(len) {
            None => match (descent.past() + position).checked_sub(len) {
                Some(index) => descent.past_token(index, self.walk()),
                None => TokenRef::default(),
            },
            Some(_) if !descent.has_started() => descent.current_token(),
            Some(ahead) => descent.noisy_token(ahead, self.walk()),
        }
    }

    fn predict_rows(&self, descents: &[Descent]) -> Result<Buffer> {
        let (batch, horizon, layout) = (descents.len(), self.config.plan_horizon, self.config.layout);
        let by_row = |width: usize, write: &dyn Fn(&Descent, &mut [f32])| {
            Buffer::generate([batch, horizon, width], |out| {
                descents.iter().zip(out.chunks_exact_mut(horizon * width)).for_each(|(descent, out)| write(descent, out));
            })
        };
        let x = by_row(layout.dim(), &|descent, out| out.copy_from_slice(&descent.x))?;
        let levels = by_row(1, &Descent::write_levels)?;
        let latents = self.config.latent.as_ref().map(|latent| by_row(latent.dim, &Descent::write_latents)).transpose()?;
        let observed = if self.config.obs_horizon > 1 { Some(self.observed(descents)?) } else { None };
        let condition = Condition { levels: &levels, latents: latents.as_ref(), observed: observed.as_ref() };
        self.networks.denoiser.predict(&x, &condition)
    }

    /// The last `obs_horizon - 1` real steps (state, action) of each row, oldest first, zeros where unknown.
    fn observed(&self, descents: &[Descent]) -> Result<Buffer> {
        let (Layout { state_dim, .. }, dim, steps) = (self.config.layout, self.config.layout.dim(), self.config.obs_horizon - 1);
        let walk = self.walk();
        Buffer::generate([descents.len(), 1, steps * dim], |out| {
            for (descent, out) in descents.iter().zip(out.chunks_exact_mut(steps * dim)) {
                for (step, out) in out.chunks_exact_mut(dim).enumerate() {
                    let Some(index) = (descent.past() + step).checked_sub(steps) else { continue };
                    let (token, (state, action)) = (descent.past_token(index, walk), out.split_at_mut(state_dim));
                    token.state.into_iter().for_each(|known| state.copy_from_slice(known));
                    token.action.into_iter().for_each(|known| action.copy_from_slice(known));
                }
            }
        })
    }
}

/// Sets the latent at `position` of each row that `which` takes, from a batch of these rows.
fn set_chain(latents: &Gaussian<Buffer>, descents: &mut [Descent], which: impl Fn(&Descent) -> bool, position: usize) {
    let dim = latents.mean.len() / latents.mean.shape().map_or(1, |[batch, ..]| batch.max(1));
    let rows = latents.mean.chunks_exact(dim).zip(latents.log_var.chunks_exact(dim));
    for (descent, (mean, log_var)) in descents.iter_mut().filter(|descent| which(descent)).zip(rows) {
        descent.chain.set(position, GaussianRef { mean, log_var });
    }
}

/// The prior chain of each row that `which` takes, from `start` on, into the rows' latents from `position` on.
fn roll_out(
    latent: &LatentModel,
    start: Gaussian<Buffer>,
    descents: &mut [Descent],
    which: impl Fn(&Descent) -> bool,
    mut position: usize,
) -> Result<()> {
    let end = descents.iter().filter(|descent| which(descent)).map(|descent| descent.chain.len()).max().unwrap_or(0);
    latent.roll_out(start, end.saturating_sub(position), |next| {
        set_chain(next, descents, &which, position);
        position += 1;
        Ok(())
    })
}
