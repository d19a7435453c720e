//! Diagonal Gaussians as pairs of values, and the trust region.

use candle_core::{Result, Tensor};

/// Bounds of a latent's log-variance.
pub const LOG_VAR: (f32, f32) = (-8.0, 2.0);

/// A diagonal Gaussian; both values have the same shape, the last dimension being the latent's.
#[derive(Clone, Debug)]
pub struct Gaussian<V = Tensor> {
    /// Mean.
    pub mean: V,
    /// Logarithm of the variance.
    pub log_var: V,
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

    /// Columns `start..start + len` of the latent.
    ///
    /// # Errors
    /// If there are not as many.
    pub fn columns(&self, start: usize, len: usize) -> Result<Self> {
        let cut = |values: &Tensor| values.narrow(candle_core::D::Minus1, start, len)?.contiguous();
        Ok(Self { mean: cut(&self.mean)?, log_var: cut(&self.log_var)? })
    }

    /// The same shape, mean 0 and variance 1.
    ///
    /// # Errors
    /// If candle says so.
    pub fn standard(&self) -> Result<Self> {
        Ok(Self { mean: self.mean.zeros_like()?, log_var: self.log_var.zeros_like()? })
    }

    /// The same numbers, cut off from the gradient.
    pub fn detach(&self) -> Self {
        Self { mean: self.mean.detach(), log_var: self.log_var.detach() }
    }
}

/// A diagonal Gaussian of one row, held elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianRef<'a> {
    /// Mean.
    pub mean: &'a [f32],
    /// Logarithm of the variance.
    pub log_var: &'a [f32],
}

/// Halvings of the search for the trust region's border: 2^-20 of the way.
const SHRINK_STEPS: u32 = 20;

impl GaussianRef<'_> {
    /// KL(self || other) in nats.
    pub fn kl(self, other: GaussianRef) -> f32 {
        kl_on_the_way(other, self, 1.0)
    }
}

/// KL(it || center) of the Gaussian that lies this share of the way from `center` to `goal`.
fn kl_on_the_way(center: GaussianRef, goal: GaussianRef, share: f32) -> f32 {
    let columns = goal.mean.iter().zip(goal.log_var).zip(center.mean.iter().zip(center.log_var));
    let terms = columns.map(|((goal_mean, goal_var), (mp, vp))| {
        let (mq, vq) = (between(*mp, *goal_mean, share), between(*vp, *goal_var, share));
        0.5 * (vp - vq - 1.0 + (vq.exp() + (mq - mp).powi(2)) / vp.exp())
    });
    terms.sum()
}

fn between(from: f32, to: f32, share: f32) -> f32 {
    if share == 1.0 { to } else { from + share * (to - from) }
}

/// Moves the Gaussian `(mean, log_var)` toward `center` as far as KL(it || center) <= kappa demands: mean and log-variance move in
/// proportion. With kappa 0 it becomes the center, with infinity it stays.
pub fn hold_within(mean: &mut [f32], log_var: &mut [f32], center: GaussianRef, kappa: f32) {
    let goal = GaussianRef { mean, log_var };
    if goal.kl(center) <= kappa {
        return;
    }
    let (mut inside, mut outside) = (0.0_f32, 1.0_f32);
    for _ in 0..SHRINK_STEPS {
        let middle = 0.5 * (inside + outside);
        if kl_on_the_way(center, goal, middle) <= kappa { inside = middle } else { outside = middle }
    }
    mean.iter_mut().zip(center.mean).for_each(|(mean, from)| *mean = between(*from, *mean, inside));
    log_var.iter_mut().zip(center.log_var).for_each(|(log_var, from)| *log_var = between(*from, *log_var, inside));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain<'a>(mean: &'a [f32], log_var: &'a [f32]) -> GaussianRef<'a> {
        GaussianRef { mean, log_var }
    }

    /// Closed form for equal variances: half the squared distance of the means in units of the standard deviation.
    #[test]
    fn kl_of_shifted_means() {
        let (q, p) = (plain(&[1.0, 2.0], &[0.5, 0.5]), plain(&[0.0, 0.0], &[0.5, 0.5]));
        assert!((q.kl(p) - 2.5 / 0.5_f32.exp()).abs() < 1e-5);
        assert_eq!(p.kl(p), 0.0);
    }

    #[test]
    fn trust_region_holds_and_is_used_up() {
        let (mean, log_var, center) = ([3.0, -1.0], [-2.0, 1.0], plain(&[0.0, 0.5], &[0.0, 0.2]));
        let held = |kappa| {
            let (mut mean, mut log_var) = (mean, log_var);
            hold_within(&mut mean, &mut log_var, center, kappa);
            (mean, log_var)
        };
        for kappa in [0.01, 0.1, 1.0] {
            let (mean, log_var) = held(kappa);
            let kl = plain(&mean, &log_var).kl(center);
            assert!(kl <= kappa && kl > 0.99 * kappa, "kappa {kappa}: {kl}");
        }
        assert_eq!(held(f32::INFINITY), (mean, log_var));
        let (mean, log_var) = held(0.0);
        assert!(plain(&mean, &log_var).kl(center) < 1e-9);
    }

    /// The batched closed form is the plain one, row by row.
    #[test]
    fn batched_kl_is_the_plain_one() -> Result<()> {
        let device = &candle_core::Device::Cpu;
        let tensor = |values: &[f32]| Tensor::from_slice(values, (2, 2), device);
        let q = Gaussian { mean: tensor(&[1.0, 2.0, -0.5, 0.0])?, log_var: tensor(&[0.1, -1.0, 0.4, 0.3])? };
        let p = Gaussian { mean: tensor(&[0.0, 1.5, 0.5, 0.2])?, log_var: tensor(&[0.0, 0.5, -0.4, 0.3])? };
        let first = plain(&[1.0, 2.0], &[0.1, -1.0]).kl(plain(&[0.0, 1.5], &[0.0, 0.5]));
        let second = plain(&[-0.5, 0.0], &[0.4, 0.3]).kl(plain(&[0.5, 0.2], &[-0.4, 0.3]));
        let batched = q.kl(&p)?.to_vec1::<f32>()?;
        assert!((batched[0] - first).abs() < 1e-5 && (batched[1] - second).abs() < 1e-5);
        Ok(())
    }
}
