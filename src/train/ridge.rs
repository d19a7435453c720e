//! Ridge regression in f64: the measuring stick of the probe.

use std::ops::Range;

/// What has more columns than this gets linear features only.
const QUADRATIC_COLUMNS_MAX: usize = 64;

/// Row-major numbers, `width` columns.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Columns.
    pub width: usize,
    /// `(rows, width)`.
    pub values: Vec<f64>,
}

impl Table {
    /// Whether any column varies; without one, [`standardised_error`] is no number.
    pub fn varies(&self) -> bool {
        self.rows() > 0 && self.moments().1.iter().any(|var| *var > VARIANCE_MIN)
    }

    /// No rows yet.
    pub fn new(width: usize) -> Self {
        Self { width, values: Vec::new() }
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.values.len() / self.width.max(1)
    }

    /// One row.
    pub fn row(&self, index: usize) -> &[f64] {
        &self.values[index * self.width..][..self.width]
    }

    /// The rows at these indices.
    pub fn select(&self, rows: &[usize]) -> Self {
        Self { width: self.width, values: rows.iter().flat_map(|row| self.row(*row)).copied().collect() }
    }

    /// Some of the columns of all rows.
    pub fn columns(&self, columns: Range<usize>) -> Self {
        let rows = self.values.chunks(self.width.max(1));
        Self { width: columns.len(), values: rows.flat_map(|row| &row[columns.clone()]).copied().collect() }
    }

    /// Appends a row of these columns, and of their products unless they are too many.
    pub fn push_quadratic(&mut self, columns: &[f64]) {
        self.values.extend(columns);
        self.width = columns.len();
        if columns.len() <= QUADRATIC_COLUMNS_MAX {
            for (i, a) in columns.iter().enumerate() {
                self.values.extend(columns[i..].iter().map(|b| a * b));
            }
            self.width += columns.len() * (columns.len() + 1) / 2;
        }
    }

    /// Rows of both, side by side.
    pub fn beside(&self, other: &Self) -> Self {
        let rows = (0..self.rows()).flat_map(|row| self.row(row).iter().chain(other.row(row)));
        Self { width: self.width + other.width, values: rows.copied().collect() }
    }

    fn moments(&self) -> (Vec<f64>, Vec<f64>) {
        let count = self.rows().max(1) as f64;
        let mut mean = vec![0.0; self.width];
        self.values.chunks(self.width).for_each(|row| mean.iter_mut().zip(row).for_each(|(mean, v)| *mean += v / count));
        let mut var = vec![0.0; self.width];
        for row in self.values.chunks(self.width) {
            var.iter_mut().zip(row.iter().zip(&mean)).for_each(|(var, (v, mean))| *var += (v - mean).powi(2) / count);
        }
        (mean, var)
    }
}

/// A fitted linear map from standardised features to targets.
pub struct Ridge {
    mean: Vec<f64>,
    scale: Vec<f64>,
    offset: Vec<f64>,
    /// `(features, targets)`.
    weights: Vec<f64>,
}

impl Ridge {
    /// Least squares with penalty `lambda` per row on standardised features; constant features get no weight.
    pub fn fit(features: &Table, targets: &Table, lambda: f64) -> Self {
        let (mean, var) = features.moments();
        let scale: Vec<f64> = var.iter().map(|v| if *v > 1e-12 { 1.0 / v.sqrt() } else { 0.0 }).collect();
        let (offset, _) = targets.moments();
        let (width, outputs) = (features.width, targets.width);
        let count = features.rows().max(1) as f64;
        let (mut gram, mut cross) = (vec![0.0; width * width], vec![0.0; width * outputs]);
        let mut x = vec![0.0; width];
        for row in 0..features.rows() {
            standardise(features.row(row), &mean, &scale, &mut x);
            for (i, xi) in x.iter().enumerate() {
                gram[i * width..][..=i].iter_mut().zip(&x).for_each(|(g, xj)| *g += xi * xj);
                let targets = targets.row(row).iter().zip(&offset);
                cross[i * outputs..][..outputs].iter_mut().zip(targets).for_each(|(c, (y, mean))| *c += xi * (y - mean));
            }
        }
        gram.iter_mut().for_each(|g| *g /= count);
        cross.iter_mut().for_each(|c| *c /= count);
        (0..width).for_each(|i| gram[i * width + i] += lambda);
        solve(&mut gram, &mut cross, width, outputs);
        Self { mean, scale, offset, weights: cross }
    }

    /// What is predicted where nothing is known: the targets' mean.
    pub fn offset(&self) -> &[f64] {
        &self.offset
    }

    /// Predictions `(rows, targets)`.
    pub fn predict(&self, features: &Table) -> Table {
        let outputs = self.offset.len();
        let mut out = Table::new(outputs);
        let mut x = vec![0.0; features.width];
        for row in 0..features.rows() {
            standardise(features.row(row), &self.mean, &self.scale, &mut x);
            let mut y = self.offset.clone();
            for (xi, weights) in x.iter().zip(self.weights.chunks(outputs)) {
                y.iter_mut().zip(weights).for_each(|(y, w)| *y += xi * w);
            }
            out.values.extend(y);
        }
        out
    }
}

fn standardise(row: &[f64], mean: &[f64], scale: &[f64], out: &mut [f64]) {
    out.iter_mut().zip(row.iter().zip(mean).zip(scale)).for_each(|(out, ((v, mean), scale))| *out = (v - mean) * scale);
}

/// The Cholesky factor of a positive definite matrix, in place on its lower triangle.
fn factor(a: &mut [f64], n: usize) {
    for i in 0..n {
        for j in 0..=i {
            let (head, tail) = a.split_at(i * n);
            let row_j = if j < i { &head[j * n..][..j] } else { &tail[..j] };
            let dot: f64 = tail[..j].iter().zip(row_j).map(|(x, y)| x * y).sum();
            let rest = tail[j] - dot;
            a[i * n + j] = if i == j { rest.max(1e-300).sqrt() } else { rest / a[j * n + j] };
        }
    }
}

/// The inverse of the Cholesky factor of a positive definite `(n, n)` matrix of second moments: rows that have these come out uncorrelated
/// and of variance 1.
pub fn inverse_factor(moments: &[f64], n: usize) -> Vec<f64> {
    let (mut lower, mut inverse) = (moments.to_vec(), vec![0.0; n * n]);
    factor(&mut lower, n);
    for column in 0..n {
        for i in column..n {
            let unit = f64::from(u8::from(i == column));
            let known: f64 = (column..i).map(|j| lower[i * n + j] * inverse[j * n + column]).sum();
            inverse[i * n + column] = (unit - known) / lower[i * n + i];
        }
    }
    inverse
}

/// Solves by Cholesky; `b` becomes the solution, `a` its factor.
fn solve(a: &mut [f64], b: &mut [f64], n: usize, outputs: usize) {
    factor(a, n);
    for column in 0..outputs {
        for i in 0..n {
            let dot: f64 = (0..i).map(|j| a[i * n + j] * b[j * outputs + column]).sum();
            b[i * outputs + column] = (b[i * outputs + column] - dot) / a[i * n + i];
        }
        for i in (0..n).rev() {
            let dot: f64 = (i + 1..n).map(|j| a[j * n + i] * b[j * outputs + column]).sum();
            b[i * outputs + column] = (b[i * outputs + column] - dot) / a[i * n + i];
        }
    }
}

/// A column that varies less counts as constant.
const VARIANCE_MIN: f64 = 1e-12;

/// Standardised mean squared error: squared error over the variance of the truth, averaged over columns that vary; 1 - R2.
pub fn standardised_error(predicted: &Table, truth: &Table) -> f64 {
    let (_, var) = truth.moments();
    let mut error = vec![0.0; truth.width];
    for (p, y) in predicted.values.chunks(truth.width).zip(truth.values.chunks(truth.width)) {
        error.iter_mut().zip(p.iter().zip(y)).for_each(|(error, (p, y))| *error += (p - y).powi(2));
    }
    let count = truth.rows() as f64;
    let varying: Vec<f64> =
        error.iter().zip(&var).filter(|(_, var)| **var > VARIANCE_MIN).map(|(error, var)| error / count / var).collect();
    if varying.is_empty() { f64::NAN } else { varying.iter().sum::<f64>() / varying.len() as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::noise::Philox;

    fn normal(rows: usize, width: usize, seed: u64) -> Table {
        let mut rng = Philox::new(seed);
        Table { width, values: (0..rows * width).map(|_| f64::from(rng.normal())).collect() }
    }

    /// y = 3 x0 - 2 x1 + 5 + noise of variance .25: the weights are found and the standardised error is .25 / 13.25.
    /// Mixed columns: what is whitened has the second moments of white noise.
    #[test]
    fn whitens() {
        let mixed: Vec<f64> = normal(400, 3, 1).values.chunks(3).flat_map(|x| [x[0], 0.9 * x[0] + 0.1 * x[1], x[1] - 4.0 * x[2]]).collect();
        let moments = |rows: &[f64]| -> Vec<f64> {
            let product = |at: usize| rows.chunks(3).map(|row| row[at / 3] * row[at % 3]).sum::<f64>() / 400.0;
            (0..9).map(product).collect()
        };
        let inverse = inverse_factor(&moments(&mixed), 3);
        let white: Vec<f64> = mixed
            .chunks(3)
            .flat_map(|row| (0..3).map(|i| (0..3).map(|j| inverse[3 * i + j] * row[j]).sum::<f64>()).collect::<Vec<_>>())
            .collect();
        let white = moments(&white);
        let error = white.iter().enumerate().map(|(at, value)| (value - f64::from(u8::from(at % 4 == 0))).abs());
        assert!(error.fold(0.0, f64::max) < 1e-9, "{white:?}");
    }

    #[test]
    fn finds_a_known_line() {
        let (x, noise) = (normal(4000, 3, 1), normal(4000, 1, 2));
        let y: Vec<f64> = (0..4000).map(|i| 3.0 * x.row(i)[0] - 2.0 * x.row(i)[1] + 5.0 + 0.5 * noise.values[i]).collect();
        let y = Table { width: 1, values: y };
        let ridge = Ridge::fit(&x, &y, 1e-9);
        let at = |row: [f64; 3]| ridge.predict(&Table { width: 3, values: row.to_vec() }).values[0];
        let origin = at([0.0; 3]);
        assert!((origin - 5.0).abs() < 0.05, "{origin}");
        for (column, slope) in [3.0, -2.0, 0.0].into_iter().enumerate() {
            let mut row = [0.0; 3];
            row[column] = 1.0;
            assert!((at(row) - origin - slope).abs() < 0.05);
        }
        let error = standardised_error(&ridge.predict(&x), &y);
        assert!((error - 0.25 / 13.25).abs() < 0.002, "{error}");
    }

    #[test]
    fn constant_columns_neither_break_nor_count() {
        let x = Table { width: 2, values: (0..100).flat_map(|i| [f64::from(i), 7.0]).collect() };
        let y = Table { width: 2, values: (0..100).flat_map(|i| [2.0 * f64::from(i), 1.0]).collect() };
        let error = standardised_error(&Ridge::fit(&x, &y, 1e-9).predict(&x), &y);
        assert!(error < 1e-9, "{error}");
    }
}
