//! What a linear filter sees of an episode's past: the last estimates one by one, and all of them in a few averages, so that its memory is
//! bounded however long the episode.

use std::ops::Range;

/// Weights of nothing in running means, in steps: of n estimates, their sum over n + this. An estimate of a context that stays is worth the
/// more the older it is, and how soon, the ridge decides between these.
const DOUBTS: [f64; 2] = [10.0, 100.0];
/// Weights of the newest estimate in exponential averages, for contexts that wander.
const RATES: [f64; 2] = [0.1, 0.03];

/// Estimates of an episode up to some step, of `dim` numbers each, as differences from what is known without any: 0 stands for no estimate.
pub struct Past {
    dim: usize,
    /// The last ones, newest first.
    lags: Vec<f64>,
    sum: Vec<f64>,
    count: f64,
    averages: [Vec<f64>; RATES.len()],
}

impl Past {
    /// Before the first step, with room for so many single estimates.
    pub fn new(dim: usize, lags: usize) -> Self {
        let zeros = || vec![0.0; dim];
        Self { dim, lags: vec![0.0; dim * lags], sum: zeros(), count: 0.0, averages: RATES.map(|_| zeros()) }
    }

    /// Numbers in a row of features.
    pub fn width(dim: usize, lags: usize) -> usize {
        dim * (1 + lags + DOUBTS.len() + RATES.len())
    }

    /// The columns of the last `block` estimates, or of the whole past; the newest of all, that of the step itself, among them or not.
    pub fn columns(dim: usize, lags: usize, block: Option<usize>, newest: bool) -> Range<usize> {
        let first = if newest { 0 } else { dim };
        first..block.map_or_else(|| Self::width(dim, lags), |block| dim * (1 + block.min(lags)))
    }

    /// Features at a step: the estimate at it, those before it from the newest back, their means and averages.
    pub fn features(&self, now: &[f64], out: &mut Vec<f64>) {
        out.extend(now);
        out.extend(&self.lags);
        DOUBTS.iter().for_each(|doubt| out.extend(self.sum.iter().map(|sum| sum / (self.count + doubt))));
        self.averages.iter().for_each(|average| out.extend(average));
    }

    /// One estimate more.
    pub fn push(&mut self, estimate: &[f64]) {
        let dim = self.dim.min(self.lags.len());
        self.lags.rotate_right(dim);
        self.lags.iter_mut().zip(estimate).for_each(|(lag, new)| *lag = *new);
        self.sum.iter_mut().zip(estimate).for_each(|(sum, new)| *sum += new);
        self.count += 1.0;
        for (average, rate) in self.averages.iter_mut().zip(RATES) {
            average.iter_mut().zip(estimate).for_each(|(average, new)| *average += rate * (new - *average));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_past_is_told_newest_first() {
        let mut past = Past::new(2, 2);
        for t in 1..=3 {
            past.push(&[f64::from(t), 10.0 * f64::from(t)]);
        }
        let mut row = Vec::new();
        past.features(&[4.0, 40.0], &mut row);
        assert_eq!(row.len(), Past::width(2, 2));
        assert_eq!(row[..6], [4.0, 40.0, 3.0, 30.0, 2.0, 20.0]);
        assert_eq!(row[6..10], [6.0 / 13.0, 60.0 / 13.0, 6.0 / 103.0, 60.0 / 103.0]);
        assert!((row[10] - (0.1 * (0.9 * 0.9 + 0.9 * 2.0 + 3.0))).abs() < 1e-12);
        assert_eq!(Past::columns(2, 2, Some(1), false), 2..4);
        assert_eq!(Past::columns(2, 2, Some(2), true), 0..6);
        assert_eq!(Past::columns(2, 2, None, false), 2..14);
    }
}
