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

    /// Mean and standard deviation of each of `dim` columns; a column that is constant, but for the rounding of f32, keeps scale 1, whatever
    /// its unit. `scan` shows all rows in order, some at a time, and is called twice.
    ///
    /// # Errors
    /// If `scan` fails.
    pub fn fit<E>(dim: usize, scan: impl Fn(&mut dyn FnMut(&[f32])) -> Result<(), E>) -> Result<Self, E> {
        let mean_of = |value: &dyn Fn(usize, f64) -> f64| {
            // From -0, as `Iterator::sum` does: a column of nothing but -0 keeps its sign.
            let (mut sums, mut count) = (vec![-0.0; dim], 0_usize);
            scan(&mut |rows| {
                count += rows.len() / dim.max(1);
                rows.chunks_exact(dim.max(1)).for_each(|row| (0..dim).for_each(|j| sums[j] += value(j, f64::from(row[j]))));
            })?;
            Ok(sums.into_iter().map(|sum| sum / count.max(1) as f64).collect::<Vec<f64>>())
        };
        let mean = mean_of(&|_, value| value)?;
        let var = mean_of(&|j, value| (value - mean[j]).powi(2))?;
        let constant = |s: f64, mean: f64| s <= f64::from(f32::EPSILON) * mean.abs() || !(s as f32).is_normal();
        let std = var.into_iter().map(f64::sqrt).zip(&mean).map(|(s, mean)| if constant(s, *mean) { 1.0 } else { s as f32 }).collect();
        Ok(Self { mean: mean.into_iter().map(|m| m as f32).collect(), std })
    }

    /// Number of columns.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// Raw to normalized; `raw` may hold several rows.
    pub fn normalize(&self, raw: &[f32]) -> Vec<f32> {
        let mut normalized = raw.to_vec();
        self.normalize_in_place(&mut normalized);
        normalized
    }

    /// [`Self::normalize`] of rows where they are.
    pub fn normalize_in_place(&self, rows: &mut [f32]) {
        rows.iter_mut().enumerate().for_each(|(i, v)| *v = (*v - self.mean[i % self.dim()]) / self.std[i % self.dim()]);
    }

    /// Raw to normalized, each column first held within its bounds, raw units.
    pub fn normalize_within(&self, raw: &[f32], low: &[f32], high: &[f32]) -> Vec<f32> {
        let mut held = raw.to_vec();
        hold_within(&mut held, low, high);
        self.normalize_in_place(&mut held);
        held
    }

    /// Normalized to raw; `normalized` may hold several rows.
    pub fn denormalize(&self, normalized: &[f32]) -> Vec<f32> {
        normalized.iter().enumerate().map(|(i, v)| v * self.std[i % self.dim()] + self.mean[i % self.dim()]).collect()
    }
}

/// Holds each column of `rows` within its bounds.
pub fn hold_within(rows: &mut [f32], low: &[f32], high: &[f32]) {
    rows.iter_mut().enumerate().for_each(|(i, value)| *value = value.clamp(low[i % low.len()], high[i % high.len()]));
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
            let affine = Affine::fit(2, |visit| {
                visit(&rows);
                Ok::<_, ()>(())
            })
            .unwrap();
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
