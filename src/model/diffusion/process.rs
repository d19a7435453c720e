//! The diffusion process: alpha-bar, q_sample, and jumps between levels (section 3 of the paper).

use crate::model::method::{AlphaBar, Target};

/// Betas of the variance-preserving process at its ends.
const VP_BETAS: [f64; 2] = [0.1, 10.0];
/// Largest beta of the cosine schedule.
const BETA_MAX: f64 = 0.999;

/// A table of cumulative alpha-bar; level 0 is clean, level `level_max` pure noise.
#[derive(Clone, Debug, PartialEq)]
pub struct Process {
    alpha_bar: Vec<f64>,
}

/// Coefficients of one reverse jump: `x' = x0 * x0_hat + eps * eps_hat + noise * z`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jump {
    /// On the clean estimate.
    pub x0: f32,
    /// On the noise estimate.
    pub eps: f32,
    /// On fresh noise.
    pub noise: f32,
}

impl Process {
    /// With `level_max` levels (K).
    pub fn new(alpha: AlphaBar, level_max: usize) -> Self {
        match alpha {
            AlphaBar::Cosine => Self::cosine(level_max),
            AlphaBar::VpLinear => Self::vp_linear(level_max),
        }
    }

    /// `alpha-bar(u) = exp(-b0 u - (b1 - b0) u^2 / 2)` at `u = k / K` (Song et al. 2021, equation 33).
    fn vp_linear(level_max: usize) -> Self {
        let [low, high] = VP_BETAS;
        let alpha_bar = |k: usize| {
            let u = k as f64 / level_max as f64;
            (-low * u - (high - low) * u * u / 2.0).exp()
        };
        Self { alpha_bar: (0..=level_max).map(alpha_bar).collect() }
    }

    /// The cosine schedule with `level_max` levels (K).
    pub fn cosine(level_max: usize) -> Self {
        let f = |u: f64| (((u + 0.008) / 1.008) * std::f64::consts::FRAC_PI_2).cos().powi(2);
        let mut alpha_bar = vec![1.0];
        for k in 1..=level_max {
            let step = (f(k as f64 / level_max as f64) / f((k - 1) as f64 / level_max as f64)).max(1.0 - BETA_MAX);
            alpha_bar.push(alpha_bar[k - 1] * step);
        }
        Self { alpha_bar }
    }

    /// alpha-bar at a level.
    pub fn alpha_bar(&self, level: usize) -> f64 {
        self.alpha_bar[level]
    }

    /// Number of levels (K).
    pub fn level_max(&self) -> usize {
        self.alpha_bar.len() - 1
    }

    /// sqrt(alpha-bar) and sqrt(1 - alpha-bar): q_sample is `x^k = a x0 + b eps`.
    pub fn q_sample(&self, level: usize) -> (f32, f32) {
        let abar = self.alpha_bar[level];
        (abar.sqrt() as f32, (1.0 - abar).sqrt() as f32)
    }

    /// Standard deviation of the noise at a level.
    pub fn sigma(&self, level: usize) -> f32 {
        self.q_sample(level).1
    }

    /// The forward jump from level `from` to a noisier `to`: `x^to = a x^from + b eps`.
    pub fn renoise(&self, from: usize, to: usize) -> (f32, f32) {
        let ratio = self.alpha_bar[to] / self.alpha_bar[from];
        (ratio.sqrt() as f32, (1.0 - ratio).max(0.0).sqrt() as f32)
    }

    /// The clean estimate from a sample `x` at `level` and what a denoiser of this target says of it; at level 0 that is the sample itself.
    pub fn x0(&self, target: Target, level: usize, x: f32, out: f32) -> f32 {
        let (signal, noise) = self.q_sample(level);
        match target {
            Target::X0 => out,
            Target::Eps if level == 0 => x,
            Target::Eps => (x - noise * out) / signal,
            Target::V => signal * x - noise * out,
        }
    }

    /// What a denoiser of this target should say of a sample at `level`, of this clean value and noise.
    pub fn aim(&self, target: Target, level: usize, x0: f32, eps: f32) -> f32 {
        let (signal, noise) = self.q_sample(level);
        match target {
            Target::X0 => x0,
            Target::Eps => eps,
            Target::V => signal * eps - noise * x0,
        }
    }

    /// eps_hat from a sample at `level` and the clean estimate.
    pub fn eps(&self, level: usize, x: f32, x0: f32) -> f32 {
        let (signal, noise) = self.q_sample(level);
        (x - signal * x0) / noise
    }

    /// The reverse jump from `from` to a cleaner `to`; `eta` 0 is DDIM (Song et al. 2021), 1 the DDPM posterior, over any gap.
    pub fn jump(&self, from: usize, to: usize, eta: f32) -> Jump {
        let (a, b) = (self.alpha_bar[from], self.alpha_bar[to]);
        let noise = f64::from(eta) * ((1.0 - b) / (1.0 - a)).sqrt() * (1.0 - a / b).max(0.0).sqrt();
        Jump { x0: b.sqrt() as f32, eps: (1.0 - b - noise * noise).max(0.0).sqrt() as f32, noise: noise as f32 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::golden::Golden;

    /// The table of Nichol and Dhariwal, DDIM's jumps, and the DDPM posterior over several levels at once, as PyTorch computes them.
    #[test]
    fn process_against_pytorch() {
        let golden = Golden::of("process");
        for level_max in [40, 150] {
            let process = Process::cosine(level_max);
            let expected = golden.flat(&format!("alphas{level_max}"));
            assert_eq!(expected.len(), level_max + 1);
            for (level, expected) in expected.into_iter().map(f64::from).enumerate() {
                assert!((process.alpha_bar(level) / expected - 1.0).abs() < 2e-7, "level {level} of {level_max}");
            }
        }
        for row in golden.flat("jumps").chunks_exact(6) {
            let Jump { x0, eps, noise } = Process::cosine(40).jump(row[0] as usize, row[1] as usize, row[2]);
            let errors = [x0 - row[3], eps - row[4], noise - row[5]];
            assert!(errors.iter().all(|error| error.abs() < 2e-7), "{row:?}: {errors:?}");
        }
    }

    #[test]
    fn alpha_bar_falls_from_one_to_nothing() {
        let process = Process::cosine(150);
        assert_eq!(process.alpha_bar(0), 1.0);
        assert!((1..=150).all(|k| process.alpha_bar(k) < process.alpha_bar(k - 1)));
        assert!(process.alpha_bar(150) < 1e-4, "{}", process.alpha_bar(150));
    }

    /// The DDPM posterior between adjacent levels in its textbook form (Ho et al. 2020, equation 7).
    #[test]
    fn adjacent_jump_with_eta_one_is_the_ddpm_posterior() {
        let process = Process::cosine(40);
        for k in 2..=39 {
            let (now, before) = (process.alpha_bar(k), process.alpha_bar(k - 1));
            let beta = 1.0 - now / before;
            let (x, x0) = (0.7_f32, -0.3_f32);
            let mean =
                before.sqrt() * beta / (1.0 - now) * f64::from(x0) + (1.0 - beta).sqrt() * (1.0 - before) / (1.0 - now) * f64::from(x);
            let variance = beta * (1.0 - before) / (1.0 - now);
            let jump = process.jump(k, k - 1, 1.0);
            let got = jump.x0 * x0 + jump.eps * process.eps(k, x, x0);
            assert!((f64::from(got) - mean).abs() < 1e-5, "level {k}: {got} against {mean}");
            assert!((f64::from(jump.noise).powi(2) - variance).abs() < 1e-6);
        }
    }

    /// Whatever a denoiser is trained to say, the clean value comes back from it, up to rounding that noise makes large.
    #[test]
    fn targets_are_one_another() {
        let process = Process::cosine(40);
        let (x0, eps) = (0.7_f32, -1.3_f32);
        for target in [Target::X0, Target::Eps, Target::V] {
            for level in 0..40 {
                let (signal, noise) = process.q_sample(level);
                let x = signal * x0 + noise * eps;
                let back = process.x0(target, level, x, process.aim(target, level, x0, eps));
                assert!((back - x0).abs() < 1e-5 / signal, "{target:?} at {level}: {back}");
            }
        }
    }

    /// Noising in two jumps has the mean and variance of noising at once.
    #[test]
    fn renoise_composes() {
        let process = Process::cosine(40);
        let ((a1, b1), (a2, b2), (a, b)) = (process.renoise(3, 10), process.renoise(10, 30), process.renoise(3, 30));
        assert!((a1 * a2 - a).abs() < 1e-6 && ((a2 * b1).powi(2) + b2 * b2 - b * b).abs() < 1e-6);
    }

    /// The five levels of IDQL by its betas: `beta_t = 1 - exp(-b0 / T - (b1 - b0) (2 t - 1) / (2 T^2))`.
    #[test]
    fn five_levels_of_the_variance_preserving_process() {
        let process = Process::new(AlphaBar::VpLinear, 5);
        let mut product = 1.0;
        for t in 1..=5 {
            let beta = 1.0 - (-0.1 / 5.0 - 0.5 * 9.9 * (2.0 * f64::from(t) - 1.0) / 25.0).exp();
            product *= 1.0 - beta;
            assert!((process.alpha_bar(t as usize) - product).abs() < 1e-12, "level {t}");
        }
        assert!(process.alpha_bar(0) == 1.0 && process.alpha_bar(5) < 0.0065);
        assert_eq!(Process::new(AlphaBar::Cosine, 40), Process::cosine(40));
    }

    /// With the true x0, a DDIM jump lands on the same noise at the new level.
    #[test]
    fn ddim_keeps_the_noise() {
        let process = Process::cosine(64);
        let (x0, eps) = (0.4_f32, -1.3_f32);
        let (signal, noise) = process.q_sample(50);
        let x = signal * x0 + noise * eps;
        let jump = process.jump(50, 20, 0.0);
        let (signal, noise) = process.q_sample(20);
        assert!((jump.x0 * x0 + jump.eps * process.eps(50, x, x0) - (signal * x0 + noise * eps)).abs() < 1e-5);
    }
}
