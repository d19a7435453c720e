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

    /// Mean and standard deviation of each of `dim` columns of row-major `rows`; a constant column keeps scale 1.
    pub fn fit(rows: &[f32], dim: usize) -> Self {
        let count = (rows.len() / dim.max(1)).max(1) as f64;
        let column = |j: usize| rows.iter().skip(j).step_by(dim.max(1)).map(|v| f64::from(*v));
        let mean: Vec<f64> = (0..dim).map(|j| column(j).sum::<f64>() / count).collect();
        let std = (0..dim).map(|j| (column(j).map(|v| (v - mean[j]).powi(2)).sum::<f64>() / count).sqrt());
        let std = std.map(|s| if s < 1e-6 { 1.0 } else { s as f32 }).collect();
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
    /// Actions: identity for data already in [-1, 1].
    pub action: Affine,
    /// Reward: Gaussian, one column.
    pub reward: Affine,
    /// Standard deviation of the one-step state change in *normalized* state units: the scale of the decoder's residuals.
    pub state_change_std: Vec<f32>,
}
