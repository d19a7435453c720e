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

/// A diagonal Gaussian of one row as plain numbers: what an episode remembers and the trust region works on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlainGaussian {
    /// Mean.
    pub mean: Vec<f32>,
    /// Logarithm of the variance.
    pub log_var: Vec<f32>,
}

/// Halvings of the search for the trust region's border: 2^-20 of the way.
const SHRINK_STEPS: u32 = 20;

impl PlainGaussian {
    /// KL(self || other) in nats.
    pub fn kl(&self, other: &Self) -> f32 {
        let terms = self.mean.iter().zip(&self.log_var).zip(other.mean.iter().zip(&other.log_var));
        terms.map(|((mq, vq), (mp, vp))| 0.5 * (vp - vq - 1.0 + (vq.exp() + (mq - mp).powi(2)) / vp.exp())).sum()
    }

    /// The farthest Gaussian on the way from `center` to self with KL(it || center) <= kappa: mean and log-variance move in proportion.
    /// 0 gives the center, infinity self.
    pub fn within(&self, center: &Self, kappa: f32) -> Self {
        if self.kl(center) <= kappa {
            return self.clone();
        }
        let (mut inside, mut outside) = (0.0_f32, 1.0_f32);
        for _ in 0..SHRINK_STEPS {
            let middle = 0.5 * (inside + outside);
            if center.toward(self, middle).kl(center) <= kappa { inside = middle } else { outside = middle }
        }
        center.toward(self, inside)
    }

    fn toward(&self, other: &Self, share: f32) -> Self {
        let mix = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect();
        Self { mean: mix(&self.mean, &other.mean), log_var: mix(&self.log_var, &other.log_var) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(mean: &[f32], log_var: &[f32]) -> PlainGaussian {
        PlainGaussian { mean: mean.to_vec(), log_var: log_var.to_vec() }
    }

    /// Closed form for equal variances: half the squared distance of the means in units of the standard deviation.
    #[test]
    fn kl_of_shifted_means() {
        let (q, p) = (plain(&[1.0, 2.0], &[0.5, 0.5]), plain(&[0.0, 0.0], &[0.5, 0.5]));
        assert!((q.kl(&p) - 2.5 / 0.5_f32.exp()).abs() < 1e-5);
        assert_eq!(p.kl(&p), 0.0);
    }

    #[test]
    fn trust_region_holds_and_is_used_up() {
        let (q, p) = (plain(&[3.0, -1.0], &[-2.0, 1.0]), plain(&[0.0, 0.5], &[0.0, 0.2]));
        for kappa in [0.01, 0.1, 1.0] {
            let kl = q.within(&p, kappa).kl(&p);
            assert!(kl <= kappa && kl > 0.99 * kappa, "kappa {kappa}: {kl}");
        }
        assert_eq!(q.within(&p, f32::INFINITY), q);
        assert!(q.within(&p, 0.0).kl(&p) < 1e-9);
    }

    /// The batched closed form is the plain one, row by row.
    #[test]
    fn batched_kl_is_the_plain_one() -> Result<()> {
        let device = &candle_core::Device::Cpu;
        let tensor = |values: &[f32]| Tensor::from_slice(values, (2, 2), device);
        let q = Gaussian { mean: tensor(&[1.0, 2.0, -0.5, 0.0])?, log_var: tensor(&[0.1, -1.0, 0.4, 0.3])? };
        let p = Gaussian { mean: tensor(&[0.0, 1.5, 0.5, 0.2])?, log_var: tensor(&[0.0, 0.5, -0.4, 0.3])? };
        let first = plain(&[1.0, 2.0], &[0.1, -1.0]).kl(&plain(&[0.0, 1.5], &[0.0, 0.5]));
        let second = plain(&[-0.5, 0.0], &[0.4, 0.3]).kl(&plain(&[0.5, 0.2], &[-0.4, 0.3]));
        let batched = q.kl(&p)?.to_vec1::<f32>()?;
        assert!((batched[0] - first).abs() < 1e-5 && (batched[1] - second).abs() < 1e-5);
        Ok(())
    }
}
