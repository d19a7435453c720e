//! Per-column affine maps between the units of the data and those of the networks; they travel inside the checkpoint.

use serde::{Deserialize, Serialize};

/// `normalized = (raw - mean) / std`, column by column.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Affine {
    /// Offset of each column, raw units.
    pub mean: Vec<f32>,
    /// Scale of each column, raw units; never 0.
    pub std: Vec<f32>,
}

impl Affine {
    /// The map that changes nothing.
    pub fn identity(dim: usize) -> Self {
        Self { mean: vec![0.0; dim], std: vec![1.0; dim] }
    }

    /// Mean and standard deviation of each of `dim` columns of row-major `rows`; a column that is constant, but for the rounding of f32,
    /// keeps scale 1, whatever its unit.
    pub fn fit(rows: &[f32], dim: usize) -> Self {
        let count = (rows.len() / dim.max(1)).max(1) as f64;
        let column = |j: usize| rows.iter().skip(j).step_by(dim.max(1)).map(|v| f64::from(*v));
        let mean: Vec<f64> = (0..dim).map(|j| column(j).sum::<f64>() / count).collect();
        let std = (0..dim).map(|j| (column(j).map(|v| (v - mean[j]).powi(2)).sum::<f64>() / count).sqrt());
        let constant = |s: f64, mean: f64| s <= f64::from(f32::EPSILON) * mean.abs() || !(s as f32).is_normal();
        let std = std.zip(&mean).map(|(s, mean)| if constant(s, *mean) { 1.0 } else { s as f32 }).collect();
        Self { mean: mean.into_iter().map(|m| m as f32).collect(), std }
    }

    /// Number of columns.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// Raw to normalized; `raw` may hold several rows.
    pub fn normalize(&self, raw: &[f32]) -> Vec<f32> {
        raw.iter().enumerate().map(|(i, v)| (v - self.mean[i % self.dim()]) / self.std[i % self.dim()]).collect()
    }

    /// Raw to normalized, each column first held within its bounds, raw units.
    pub fn normalize_within(&self, raw: &[f32], low: &[f32], high: &[f32]) -> Vec<f32> {
        let within = |(i, v): (usize, &f32)| v.clamp(low[i % self.dim()], high[i % self.dim()]);
        self.normalize(&raw.iter().enumerate().map(within).collect::<Vec<f32>>())
    }

    /// Normalized to raw; `normalized` may hold several rows.
    pub fn denormalize(&self, normalized: &[f32]) -> Vec<f32> {
        normalized.iter().enumerate().map(|(i, v)| v * self.std[i % self.dim()] + self.mean[i % self.dim()]).collect()
    }
}

/// The maps of everything a trajectory holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalizer {
    /// States: Gaussian.
    pub state: Affine,
    /// Actions: from their bounds to [-1, 1], or as the recipe wants it.
    pub action: Affine,
    /// Reward: Gaussian, one column.
    pub reward: Affine,
    /// Standard deviation of the one-step state change in *normalized* state units: the scale of the decoder's residuals.
    pub state_change_std: Vec<f32>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A column in metres of a micrometre's move counted as constant, and kept scale 1.
    #[test]
    fn scale_does_not_depend_on_the_unit() {
        for unit in [1e-9, 1e-3, 1.0, 1e6] {
            let rows: Vec<f32> = (0..100).flat_map(|i| [unit * (i % 7) as f32, 5.0 * unit]).collect();
            let affine = Affine::fit(&rows, 2);
            assert!((affine.std[0] / unit - 2.0).abs() < 0.1, "{affine:?}");
            assert_eq!(affine.std[1], 1.0);
            let normalized = affine.normalize(&rows);
            assert!(normalized.iter().skip(1).step_by(2).all(|value| value.abs() < 1e-6));
        }
    }

    #[test]
    fn what_lies_outside_is_held_within() {
        let affine = Affine { mean: vec![1.0, 0.0], std: vec![1.0, 2.0] };
        assert_eq!(affine.normalize_within(&[9.0, -9.0, 0.5, 1.0], &[0.0, -2.0], &[2.0, 2.0]), [1.0, -1.0, -0.5, 0.5]);
    }
}
