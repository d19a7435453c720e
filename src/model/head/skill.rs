//! Skills: a code that stands for what is done in several steps (LDCQ, Venkatraman et al. 2024, section 4.1; after OPAL, Ajay et al. 2021).
//!
//! A variational autoencoder of the actions of H steps. The encoder reads all of them, forwards and backwards; the decoder tells each action from
//! the state it is taken in, so that a skill goes on reacting; the prior of a code sees the first state alone.

use crate::model::{
    method::{Decoding, Head, Method},
    nn::{
        Activation::Relu,
        Activations, Buffer, Gru, Linear, Mlp,
        gaussian::{Gaussian, LOG_VAR},
        params::Params,
    },
    trajectory::Layout,
};
use candle_core::{Device, Result, Tensor};

/// What was done in some steps in a row, normalized units.
pub struct Segments {
    /// `(B, H, state_dim + action_dim)`.
    pub steps: Tensor,
    /// `(B, 1, code_dim)` Gaussian draws of their codes.
    pub eps: Tensor,
}

/// Errors of a batch.
pub struct SkillTerms {
    /// What is minimised: `nll + beta kl`.
    pub loss: Tensor,
    /// Negative log-likelihood of an action given its state and the code, but for a constant; the mean over steps.
    pub nll: Tensor,
    /// KL of what the steps say of the code to what the first state does, a share for each step.
    pub kl: Tensor,
}

/// See the module.
pub struct Skills {
    embed: Linear,
    /// A GRU in either direction, layer on layer.
    layers: Vec<[Gru; 2]>,
    posterior: Linear,
    prior: Mlp,
    /// One for all columns of an action, or one each.
    decoder: Vec<Mlp>,
    layout: Layout,
    dim: usize,
}

impl Segments {
    /// Rows `start..start + len` alone.
    ///
    /// # Errors
    /// If there are not so many.
    pub fn narrow(&self, start: usize, len: usize) -> Result<Self> {
        let cut = |tensor: &Tensor| tensor.narrow(0, start, len)?.contiguous();
        Ok(Self { steps: cut(&self.steps)?, eps: cut(&self.eps)? })
    }
}

impl Skills {
    /// Networks under `params`' scope; none where the plan is no code.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(layout: Layout, method: &Method, params: &Params) -> Result<Option<Self>> {
        let Head::Skill { width, layers, action, .. } = method.head else { return Ok(None) };
        let (dim, given) = (method.plan.diffused.code_dim(), layout.state_dim + method.plan.diffused.code_dim());
        let layer = |index: usize| {
            let (d_in, params) = (if index == 0 { width } else { 2 * width }, params.scope("encoder").scope(index));
            Ok([Gru::new(d_in, width, &params.scope("forwards"))?, Gru::new(d_in, width, &params.scope("backwards"))?])
        };
        let decoder = |column: usize, told: usize| Mlp::new(given + column, width, 2 * told, &params.scope("decoder").scope(column));
        Ok(Some(Self {
            embed: Linear::new(layout.dim(), width, &params.scope("embed"))?,
            layers: (0..layers).map(layer).collect::<Result<_>>()?,
            posterior: Linear::new(2 * width, 2 * dim, &params.scope("posterior"))?,
            prior: Mlp::new(layout.state_dim, width, 2 * dim, &params.scope("prior"))?,
            decoder: match action {
                Decoding::Normal => vec![decoder(0, layout.action_dim)?],
                Decoding::Autoregressive => (0..layout.action_dim).map(|column| decoder(column, 1)).collect::<Result<_>>()?,
            },
            layout,
            dim,
        }))
    }

    /// The codes of segments, `(B, 1, code_dim)`: a draw of what their steps say, cut off from the gradient.
    ///
    /// # Errors
    /// If a shape differs.
    pub fn codes(&self, segments: &Segments) -> Result<Tensor> {
        Ok(self.encode(&segments.steps)?.sample(&segments.eps)?.detach())
    }

    /// The errors of the autoencoder; `beta` is the weight of the KL, 1 in the evidence lower bound.
    ///
    /// # Errors
    /// If a shape differs.
    pub fn errors(&self, segments: &Segments, beta: f64) -> Result<SkillTerms> {
        let (steps, Layout { state_dim, action_dim }) = (&segments.steps, self.layout);
        let (rows, len, _) = steps.dims3()?;
        let posterior = self.encode(steps)?;
        let code = posterior.sample(&segments.eps)?.broadcast_as((rows, len, self.dim))?.contiguous()?;
        let (state, action) = (steps.narrow(2, 0, state_dim)?.contiguous()?, steps.narrow(2, state_dim, action_dim)?.contiguous()?);
        let Gaussian { mean, log_var } = self.told(&state, &code, |column| action.narrow(2, 0, column)?.contiguous())?;
        let squares = ((&action - mean)?.sqr()? * log_var.neg()?.exp()?)?;
        let nll = (log_var + squares)?.affine(0.5, 0.0)?.sum(2)?.mean_all()?;
        let first = state.narrow(1, 0, 1)?.contiguous()?;
        let kl = posterior.kl(&gaussian(&self.prior.forward(&first)?, self.dim)?)?.mean_all()?.affine(1.0 / len as f64, 0.0)?;
        Ok(SkillTerms { loss: (&nll + kl.affine(beta, 0.0)?)?, nll, kl })
    }

    /// Actions `(B, 1, action_dim)` in states `(B, 1, state_dim)` by codes `(B, 1, code_dim)`: means. What the code leaves open of the data's actions
    /// is their noise, and who imitates that earns less.
    ///
    /// # Errors
    /// If a shape differs.
    pub fn act(&self, state: &Buffer, code: &Buffer) -> Result<Buffer> {
        let ([rows, ..], width) = (state.shape()?, self.layout.action_dim);
        let mut action = Buffer::generate([rows, 1, width], |_| {})?;
        for (first, network) in self.decoder.iter().enumerate() {
            let before = (first > 0).then(|| action.channels(0, first)).transpose()?;
            let mean = self.told_by(network, state, code, before.as_ref())?.mean;
            let [.., told] = mean.shape()?;
            mean.iter().enumerate().for_each(|(i, mean)| action[i / told * width + first + i % told] = *mean);
        }
        Ok(action)
    }

    /// What is told of all columns; `before(column)` are those before it.
    fn told(&self, state: &Tensor, code: &Tensor, before: impl Fn(usize) -> Result<Tensor>) -> Result<Gaussian> {
        let of = |(column, network): (usize, &Mlp)| {
            self.told_by(network, state, code, (column > 0).then(|| before(column)).transpose()?.as_ref())
        };
        let told = self.decoder.iter().enumerate().map(of).collect::<Result<Vec<_>>>()?;
        let beside = |part: fn(&Gaussian) -> &Tensor| Tensor::cat(&told.iter().map(part).collect::<Vec<_>>(), 2);
        Ok(Gaussian { mean: beside(|told| &told.mean)?, log_var: beside(|told| &told.log_var)? })
    }

    /// What one network of the decoder tells of its columns, given those before them.
    fn told_by<V: Activations>(&self, network: &Mlp, state: &V, code: &V, before: Option<&V>) -> Result<Gaussian<V>> {
        let told = network.forward(&match before {
            Some(before) => V::beside(&[state, code, before])?,
            None => V::beside(&[state, code])?,
        })?;
        let [.., width] = told.shape()?;
        gaussian(&told, width / 2)
    }

    /// What steps say of their code, `(B, H, state_dim + action_dim)` to Gaussians of `(B, 1, code_dim)`: either direction has the last word once.
    fn encode(&self, steps: &Tensor) -> Result<Gaussian> {
        let len = steps.dim(1)?;
        let backwards = Tensor::from_vec((0..len as u32).rev().collect::<Vec<_>>(), len, &Device::Cpu)?;
        let turned = |x: &Tensor| x.index_select(&backwards, 1)?.contiguous();
        let mut x = self.embed.forward(steps)?.activated(Relu)?;
        for [forth, back] in &self.layers {
            x = Tensor::cat(&[forth.forward(&x, None)?, turned(&back.forward(&turned(&x)?, None)?)?], 2)?;
        }
        let half = x.dim(2)? / 2;
        let ends = [x.narrow(1, len - 1, 1)?.narrow(2, 0, half)?, x.narrow(1, 0, 1)?.narrow(2, half, half)?];
        gaussian(&self.posterior.forward(&Tensor::cat(&ends, 2)?)?, self.dim)
    }
}

/// Means and log-variances side by side.
fn gaussian<V: Activations>(both: &V, dim: usize) -> Result<Gaussian<V>> {
    Ok(Gaussian { mean: both.channels(0, dim)?, log_var: both.channels(dim, dim)?.clamped(LOG_VAR.0, LOG_VAR.1)? })
}

#[cfg(test)]
#[path = "skill_tests.rs"]
mod tests;
