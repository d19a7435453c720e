//! Diagonal Gaussians as pairs of tensors.

use candle_core::{Result, Tensor};

/// A diagonal Gaussian; both tensors have the same shape, the last dimension being the latent's.
#[derive(Clone, Debug)]
pub struct Gaussian {
    /// Mean.
    pub mean: Tensor,
    /// Logarithm of the variance.
    pub log_var: Tensor,
}

impl Gaussian {
    /// `mean + exp(log_var / 2) * eps`.
    ///
    /// # Errors
    /// If shapes differ.
    pub fn sample(&self, eps: &Tensor) -> Result<Tensor> {
        &self.mean + (self.log_var.affine(0.5, 0.0)?.exp()? * eps)?
    }

    /// KL(self || other), closed form, summed over the last dimension (appendix A.4 of the paper).
    ///
    /// # Errors
    /// If shapes differ.
    pub fn kl(&self, other: &Self) -> Result<Tensor> {
        let square = ((&self.mean - &other.mean)?.sqr()? + self.log_var.exp()?)?;
        let ratio = (square * other.log_var.neg()?.exp()?)?;
        ((&other.log_var - &self.log_var)? + ratio)?.affine(0.5, -0.5)?.sum(candle_core::D::Minus1)
    }

    /// Positions `start..start + len` of dimension 1.
    ///
    /// # Errors
    /// If the range leaves the sequence.
    pub fn narrow(&self, start: usize, len: usize) -> Result<Self> {
        Ok(Self { mean: self.mean.narrow(1, start, len)?.contiguous()?, log_var: self.log_var.narrow(1, start, len)?.contiguous()? })
    }

    /// The same numbers, cut off from the gradient.
    pub fn detach(&self) -> Self {
        Self { mean: self.mean.detach(), log_var: self.log_var.detach() }
    }
}

/// KL(q || p) of plain rows, in nats; the trust region of the sampler asks for it row by row.
pub fn kl_row(q: (&[f32], &[f32]), p: (&[f32], &[f32])) -> f32 {
    let terms = q.0.iter().zip(q.1).zip(p.0.iter().zip(p.1));
    terms.map(|((mq, vq), (mp, vp))| 0.5 * (vp - vq - 1.0 + (vq.exp() + (mq - mp).powi(2)) / vp.exp())).sum()
}
