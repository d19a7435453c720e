//! One network evaluation for many descents: gather rows, infer and refine latents, predict, scatter.

use super::{Agent, AgentError, Descent, descent::Walk};
use crate::model::{
    denoiser::Condition,
    diffusion::ladder::Ladder,
    latent::{Gaussian, LatentModel, PlainGaussian},
    trajectory::{Token, Tokens},
};
use candle_core::{Device, Result, Tensor};

impl Agent {
    /// One denoiser forward shared by all these descents, none of which is done; rows do not influence each other.
    ///
    /// # Errors
    /// [`AgentError::Tensor`] for a defect; a row whose output is not finite fails alone, at [`Agent::finish`].
    pub fn advance(&self, descents: &mut [Descent]) -> std::result::Result<(), AgentError> {
        let walks = descents.iter().map(|descent| self.walk(descent)).collect::<std::result::Result<Vec<_>, _>>()?;
        self.start_rows(descents, &walks)?;
        self.refine_rows(descents, &walks)?;
        let x0 = self.predict_rows(descents, &walks)?;
        for ((descent, walk), x0) in descents.iter_mut().zip(&walks).zip(x0) {
            descent.step_down(x0, walk);
        }
        Ok(())
    }

    fn walk(&self, descent: &Descent) -> std::result::Result<Walk<'_>, AgentError> {
        let sub_steps = descent.episode.options.sub_steps;
        let ladder = Ladder::new(self.config.plan_horizon, sub_steps, self.config.level_max);
        let ladder = ladder.map_err(|reason| AgentError::InvalidOptions { field: "sub_steps", reason })?;
        Ok(Walk { config: &self.config, process: &self.process, ladder })
    }

    /// The filter: latents of rows that have not started, from real history and the current state; then their windows.
    fn start_rows(&self, descents: &mut [Descent], walks: &[Walk]) -> Result<()> {
        let mut rows: Vec<(&mut Descent, &Walk)> = descents.iter_mut().zip(walks).filter(|(descent, _)| !descent.has_started()).collect();
        if let Some(latent) = self.networks.latent.as_ref().filter(|_| !rows.is_empty()) {
            let blocks = rows.iter().map(|(descent, _)| {
                let current = Token { state: Some(descent.state.clone()), ..Token::default() };
                self.block(descent, [current])
            });
            let filter = latent.infer(&Tokens::pack(self.config.layout, &blocks.collect::<Vec<_>>())?)?;
            let len = rows.iter().map(|(descent, _)| self.chain_len(descent)).max().unwrap_or(0);
            let chains = unstack(&latent.roll_out(&filter, len)?)?;
            for ((descent, _), chain) in rows.iter_mut().zip(chains) {
                let len = self.chain_len(descent);
                descent.set_chain(chain.into_iter().take(len).collect());
            }
        }
        rows.iter_mut().for_each(|(descent, walk)| descent.start(walk));
        Ok(())
    }

    /// Zig-zag: at READY the latent of position 0 is the posterior given the noised positions 0 and 1, held in a trust region around the
    /// filter's, and the chain is rolled out anew from it.
    fn refine_rows(&self, descents: &mut [Descent], walks: &[Walk]) -> Result<()> {
        let Some(latent) = &self.networks.latent else { return Ok(()) };
        let rows = descents.iter_mut().zip(walks).filter(|(descent, walk)| descent.wants_refinement(&walk.ladder));
        let mut rows: Vec<(&mut Descent, &Walk)> = rows.collect();
        if rows.is_empty() {
            return Ok(());
        }
        let refined = self.refine(latent, &rows)?;
        let len = rows.iter().map(|(descent, _)| descent.chain.len()).max().unwrap_or(0);
        let start = stack(&refined)?;
        let tails = unstack(&latent.roll_out(&start, len - 1)?)?;
        for (((descent, _), head), tail) in rows.iter_mut().zip(refined).zip(tails) {
            let len = descent.chain.len();
            descent.set_chain(std::iter::once(head).chain(tail).take(len).collect());
        }
        Ok(())
    }

    /// The refined latent of position 0 of each row, inside its trust region.
    fn refine(&self, latent: &LatentModel, rows: &[(&mut Descent, &Walk)]) -> Result<Vec<PlainGaussian>> {
        let successors = self.config.plan_horizon.min(2);
        let blocks = rows.iter().map(|(descent, walk)| {
            let noisy: Vec<Token> = (0..successors).map(|position| descent.noisy_token(position, walk)).collect();
            self.block(descent, noisy)
        });
        let posterior = latent.infer(&Tokens::pack(self.config.layout, &blocks.collect::<Vec<_>>())?)?;
        let posteriors = unstack(&[posterior])?.into_iter().map(|mut row| row.remove(0));
        let trusted = rows.iter().zip(posteriors).map(|((descent, _), q)| q.within(&descent.chain[0], descent.episode.options.kappa));
        Ok(trusted.collect())
    }

    /// The last `block_len` tokens of a row, wholly absent ones in front where there are fewer, and the given ones behind.
    fn block(&self, descent: &Descent, last: impl IntoIterator<Item = Token>) -> Vec<Token> {
        let kept = descent.block.len().min(self.config.block_len);
        let absent = std::iter::repeat_n(Token::default(), self.config.block_len - kept);
        absent.chain(descent.block[descent.block.len() - kept..].iter().cloned()).chain(last).collect()
    }

    /// Latents a row needs from position 0 on, for all positions that its chunk will let in.
    fn chain_len(&self, descent: &Descent) -> usize {
        self.config.plan_horizon + descent.episode.options.action_horizon - 1
    }

    fn predict_rows(&self, descents: &[Descent], walks: &[Walk]) -> Result<Vec<Vec<f32>>> {
        let (batch, horizon, dim) = (descents.len(), self.config.plan_horizon, self.config.layout.dim());
        let tensor = |values: Vec<f32>, shape: (usize, usize, usize)| Tensor::from_vec(values, shape, &Device::Cpu);
        let x = tensor(descents.iter().flat_map(|descent| descent.x.iter().copied()).collect(), (batch, horizon, dim))?;
        let levels = descents.iter().zip(walks).flat_map(|(descent, walk)| walk.ladder.row(descent.row));
        let levels = tensor(levels.map(|level| level as f32).collect(), (batch, horizon, 1))?.squeeze(2)?;
        let latents = self
            .config
            .latent
            .as_ref()
            .map(|latent| tensor(descents.iter().flat_map(|descent| descent.latents(horizon)).collect(), (batch, horizon, latent.dim)));
        let observed = (self.config.obs_horizon > 1).then(|| {
            let rows: Vec<f32> = descents.iter().flat_map(|descent| self.observed(descent)).collect();
            let width = rows.len() / batch;
            Tensor::from_vec(rows, (batch, width), &Device::Cpu)
        });
        let (latents, observed) = (latents.transpose()?, observed.transpose()?);
        let condition = Condition { levels: &levels, latents: latents.as_ref(), observed: observed.as_ref() };
        self.networks.denoiser.predict(&x, &condition)?.flatten_from(1)?.to_vec2()
    }

    /// The last `obs_horizon - 1` real steps (state, action), oldest first, zeros where unknown.
    fn observed(&self, descent: &Descent) -> Vec<f32> {
        let (layout, steps) = (self.config.layout, self.config.obs_horizon - 1);
        let known = descent.block.len().min(steps);
        let mut row = vec![0.0; (steps - known) * layout.dim()];
        for token in &descent.block[descent.block.len() - known..] {
            let part = |values: &Option<Vec<f32>>, len| values.clone().unwrap_or_else(|| vec![0.0; len]);
            row.extend(part(&token.state, layout.state_dim));
            row.extend(part(&token.action, layout.action_dim));
        }
        row
    }
}

/// Rows of plain Gaussians as one batch.
fn stack(rows: &[PlainGaussian]) -> Result<Gaussian> {
    let (batch, dim) = (rows.len(), rows.first().map_or(0, |row| row.mean.len()));
    let tensor = |part: fn(&PlainGaussian) -> &Vec<f32>| {
        Tensor::from_vec(rows.iter().flat_map(|row| part(row).iter().copied()).collect::<Vec<_>>(), (batch, dim), &Device::Cpu)
    };
    Ok(Gaussian { mean: tensor(|row| &row.mean)?, log_var: tensor(|row| &row.log_var)? })
}

/// A chain of batches as one chain a row.
fn unstack(chain: &[Gaussian]) -> Result<Vec<Vec<PlainGaussian>>> {
    let mut rows: Vec<Vec<PlainGaussian>> = Vec::new();
    for step in chain {
        let (means, log_vars) = (step.mean.to_vec2::<f32>()?, step.log_var.to_vec2::<f32>()?);
        rows.resize(means.len(), Vec::new());
        for (row, (mean, log_var)) in rows.iter_mut().zip(means.into_iter().zip(log_vars)) {
            row.push(PlainGaussian { mean, log_var });
        }
    }
    Ok(rows)
}
