//! Units of actions: from those of the data to those of the networks, column by column.
//!
//! A denoiser's noise has standard deviation 1, so an action that moves by .01, or around 101, drowns in it: the same task copied its
//! expert with an error of .006 in units of [-1, 1], .59 with actions a hundred times smaller, .47 with actions shifted by 101.

use super::{DatasetError, unreadable};
use crate::model::normalizer::{Affine, hold_within};
use serde::{Deserialize, Serialize};
use std::io;

/// Of this many values one may lie on either side of what counts as usual; never fewer than one.
const UNUSUAL_EVERY: usize = 1000;
/// Values this share of the usual range beyond it are still taken as they are.
const FENCE: f32 = 0.5;
/// A column that is stretched or shrunk by more than this is worth a word.
const NOTABLE_SCALE: f32 = 10.0;

/// How actions come to the units of the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionUnits {
    /// Each column's bounds become -1 and 1.
    #[default]
    Limits,
    /// Each column's mean becomes 0, its standard deviation 1.
    Gaussian,
    /// As they are.
    AsIs,
}

/// The recipe's `[actions]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActionsConfig {
    /// Units of the networks.
    pub units: ActionUnits,
    /// Lower bound of each column, units of the data; empty: the least of the data.
    pub low: Vec<f32>,
    /// Upper bound of each column; empty: the greatest of the data.
    pub high: Vec<f32>,
}

/// What was chosen for one column of actions; goes into the log and the checkpoint's manifest.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActionColumn {
    /// Bounds of what the policy answers, units of the data.
    pub low: f32,
    /// See `low`.
    pub high: f32,
    /// Least value in the data.
    pub data_low: f32,
    /// Greatest value in the data.
    pub data_high: f32,
    /// Values outside the bounds; training holds them within.
    pub outside: usize,
    /// `network = (data - mean) / scale`.
    pub mean: f32,
    /// See `mean`.
    pub scale: f32,
}

impl ActionColumn {
    /// Whether a person should look at it, and why.
    pub fn notable(&self) -> Option<String> {
        let mut words = Vec::new();
        if self.low == self.high {
            words.push("never changes".to_string());
        } else if self.scale > NOTABLE_SCALE || self.scale < 1.0 / NOTABLE_SCALE {
            words.push(format!("is scaled by {:.3}", 1.0 / self.scale));
        }
        if self.outside > 0 {
            let (low, high) = (self.data_low, self.data_high);
            words.push(format!("reaches from {low} to {high} in the data: {} value(s) are held within the bounds", self.outside));
        }
        (!words.is_empty()).then(|| words.join(", and "))
    }
}

/// Shows all rows of a field in order, some at a time.
type Visit<'a> = &'a mut dyn FnMut(&[f32]);

/// Chooses bounds and map of every one of `dim` columns. Bounds are those of the recipe, else the data's, outliers apart. `scan` shows
/// raw rows, and is called several times.
///
/// # Errors
/// If the recipe's bounds are not one for each column, or in the wrong order, or rows cannot be read.
pub fn fit(
    config: &ActionsConfig,
    path: &str,
    dim: usize,
    scan: impl Fn(Visit) -> io::Result<()>,
) -> Result<Vec<ActionColumn>, DatasetError> {
    let invalid = |reason: String| DatasetError::Invalid { path: path.into(), field: "actions".into(), reason };
    for (key, given) in [("low", &config.low), ("high", &config.high)] {
        if !given.is_empty() && given.len() != dim {
            return Err(invalid(format!("{dim} column(s), but the recipe's `actions.{key}` has {} value(s)", given.len())));
        }
    }
    let limits = limits(dim, &scan).map_err(|error| unreadable(path, &error))?;
    let low: Vec<f32> = limits.iter().enumerate().map(|(j, limits)| config.low.get(j).copied().unwrap_or(limits.low)).collect();
    let high: Vec<f32> = limits.iter().enumerate().map(|(j, limits)| config.high.get(j).copied().unwrap_or(limits.high)).collect();
    for (j, (low, high)) in low.iter().zip(&high).enumerate() {
        if low > high || !low.is_finite() || !high.is_finite() {
            return Err(invalid(format!("column {j}: the recipe's bounds leave nothing between {low} and {high}")));
        }
    }
    let within = Within { low, high };
    let (affine, outside) = within.measure(config.units, &scan).map_err(|error| unreadable(path, &error))?;
    let Within { low, high } = within;
    let column = |(j, limits): (usize, Limits)| ActionColumn {
        low: low[j],
        high: high[j],
        data_low: limits.least,
        data_high: limits.greatest,
        outside: outside[j],
        mean: affine.mean[j],
        scale: affine.std[j],
    };
    Ok(limits.into_iter().enumerate().map(column).collect())
}

/// Bounds of all columns.
struct Within {
    low: Vec<f32>,
    high: Vec<f32>,
}

impl Within {
    /// The map of each column, and how many of its values lie outside the bounds. A column that never changes keeps its scale.
    fn measure(&self, units: ActionUnits, scan: &impl Fn(Visit) -> io::Result<()>) -> io::Result<(Affine, Vec<usize>)> {
        let mut outside = vec![0; self.low.len()];
        scan(&mut |rows| {
            for (i, value) in rows.iter().enumerate() {
                let j = i % self.low.len();
                outside[j] += usize::from(!(self.low[j]..=self.high[j]).contains(value));
            }
        })?;
        let bounds = || self.low.iter().zip(&self.high);
        let affine = match units {
            ActionUnits::AsIs => Affine::identity(self.low.len()),
            ActionUnits::Limits => Affine {
                mean: bounds().map(|(low, high)| 0.5 * (low + high)).collect(),
                std: bounds().map(|(low, high)| 0.5 * (high - low)).map(|scale| if scale.is_normal() { scale } else { 1.0 }).collect(),
            },
            ActionUnits::Gaussian => Affine::fit(self.low.len(), |visit| {
                scan(&mut |rows| {
                    let mut held = rows.to_vec();
                    hold_within(&mut held, &self.low, &self.high);
                    visit(&held);
                })
            })?,
        };
        Ok((affine, outside))
    }
}

/// A line for the log: what the bounds are, and whose units the networks see.
pub fn summary(config: &ActionsConfig, columns: &[ActionColumn]) -> String {
    let bounds = |of: fn(&ActionColumn) -> f32| columns.iter().map(of).collect::<Vec<f32>>();
    let (low, high) = (bounds(|column| column.low), bounds(|column| column.high));
    let units = match config.units {
        ActionUnits::Limits => "to -1 .. 1",
        ActionUnits::Gaussian => "to mean 0 and standard deviation 1",
        ActionUnits::AsIs => "as they are",
    };
    format!("bounds {low:?} .. {high:?}, {units}")
}

/// The maps of all columns.
pub fn affine_of(columns: &[ActionColumn]) -> Affine {
    Affine { mean: columns.iter().map(|column| column.mean).collect(), std: columns.iter().map(|column| column.scale).collect() }
}

/// What the values of a column span.
struct Limits {
    least: f32,
    greatest: f32,
    low: f32,
    high: f32,
}

fn limits(dim: usize, scan: &impl Fn(Visit) -> io::Result<()>) -> io::Result<Vec<Limits>> {
    let mut count = 0;
    scan(&mut |rows| count += rows.len() / dim.max(1))?;
    let keep = (count / UNUSUAL_EVERY).max(1) + 1;
    let mut tails: Vec<[Tail; 2]> =
        (0..dim).map(|_| [Tail::new(keep, |a, b| a.total_cmp(b)), Tail::new(keep, |a, b| b.total_cmp(a))]).collect();
    scan(&mut |rows| {
        for (i, value) in rows.iter().enumerate() {
            tails[i % dim].iter_mut().for_each(|tail| tail.push(*value));
        }
    })?;
    Ok(tails.into_iter().map(|[lowest, highest]| usual(&lowest.sorted(), &highest.sorted())).collect())
}

/// Least and greatest of the values, and the same but for those that lie far outside the range of nearly all: one broken reading must not
/// squeeze everything else into a corner. Where nearly all are equal, the rare others are what the column says, and all count. `lowest`
/// and `highest` are the least and the greatest values, the outermost first.
fn usual(lowest: &[f32], highest: &[f32]) -> Limits {
    let edge = |tail: &[f32]| [tail.first(), tail.last()].map(|value| value.copied().unwrap_or(0.0));
    let ([least, low], [greatest, high]) = (edge(lowest), edge(highest));
    if high <= low {
        return Limits { least, greatest, low: least, high: greatest };
    }
    let (bottom, top) = (low - FENCE * (high - low), high + FENCE * (high - low));
    let first = |tail: &[f32], otherwise| tail.iter().copied().find(|value| (bottom..=top).contains(value)).unwrap_or(otherwise);
    Limits { least, greatest, low: first(lowest, low), high: first(highest, high) }
}

/// The first so many values of a sequence in some order.
struct Tail {
    keep: usize,
    order: fn(&f32, &f32) -> std::cmp::Ordering,
    values: Vec<f32>,
}

impl Tail {
    fn new(keep: usize, order: fn(&f32, &f32) -> std::cmp::Ordering) -> Self {
        Self { keep, order, values: Vec::with_capacity(2 * keep) }
    }

    fn push(&mut self, value: f32) {
        if self.values.len() == 2 * self.keep {
            self.values.select_nth_unstable_by(self.keep - 1, self.order);
            self.values.truncate(self.keep);
        }
        self.values.push(value);
    }

    fn sorted(mut self) -> Vec<f32> {
        self.values.sort_unstable_by(self.order);
        self.values.truncate(self.keep);
        self.values
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::noise::Philox;

    /// A scan of a few rows at a time.
    fn shown(values: &[f32]) -> impl Fn(Visit) -> io::Result<()> {
        |visit| {
            values.chunks(7).for_each(visit);
            Ok(())
        }
    }

    fn columns(config: &ActionsConfig, values: &[f32]) -> ActionColumn {
        fit(config, "test", 1, shown(values)).unwrap().remove(0)
    }

    fn uniform(count: usize, low: f32, high: f32) -> Vec<f32> {
        let mut stream = Philox::new(3);
        (0..count).map(|_| low + (high - low) * stream.uniform()).collect()
    }

    /// Bounds began at -1 and 1 and only grew: a gripper of 0 .. .08 kept a scale of 1, and a throttle of 0 .. 1 was answered -1.
    #[test]
    fn limits_are_those_of_the_data() {
        for (low, high) in [(-1.0, 1.0), (0.0, 0.08), (100.0, 102.0), (0.0, 1.0), (-3000.0, -1000.0), (-1e-6, 1e-6)] {
            let mut values = uniform(500, low, high);
            values.extend([low, high]);
            let column = columns(&ActionsConfig::default(), &values);
            assert_eq!((column.low, column.high, column.outside), (low, high, 0));
            let network = |value: f32| (value - column.mean) / column.scale;
            assert!((network(low) + 1.0).abs() < 1e-5 && (network(high) - 1.0).abs() < 1e-5, "{column:?}");
        }
        let unit = columns(&ActionsConfig::default(), &[-1.0, 0.3, 1.0]);
        assert_eq!((unit.mean, unit.scale), (0.0, 1.0), "what is within [-1, 1] already stays bit for bit");
    }

    #[test]
    fn one_broken_reading_does_not_squeeze_the_others() {
        for outlier in [1e6, -1e6, 40.0] {
            for count in [50, 5000] {
                let mut values = uniform(count, -1.0, 1.0);
                values[7] = outlier;
                let column = columns(&ActionsConfig::default(), &values);
                assert!(column.low >= -1.0 && column.high <= 1.0 && column.scale > 0.9, "{column:?}");
                assert_eq!(column.outside, 1);
                assert!(column.notable().unwrap().contains("1 value"));
            }
        }
        let rare: Vec<f32> = (0..5000).map(|i| f32::from(i == 77)).collect();
        let column = columns(&ActionsConfig::default(), &rare);
        assert_eq!((column.low, column.high, column.outside), (0.0, 1.0, 0), "a gripper that closes once");
    }

    #[test]
    fn the_recipe_may_know_better() {
        let config = ActionsConfig { low: vec![-2.0], high: vec![2.0], ..ActionsConfig::default() };
        let column = columns(&config, &[-3.0, 0.0, 1.0]);
        assert_eq!((column.low, column.high, column.outside, column.scale), (-2.0, 2.0, 1, 2.0));
        let as_is = columns(&ActionsConfig { units: ActionUnits::AsIs, ..ActionsConfig::default() }, &uniform(100, 5.0, 6.0));
        assert_eq!((as_is.mean, as_is.scale), (0.0, 1.0));
        let gaussian = columns(&ActionsConfig { units: ActionUnits::Gaussian, ..ActionsConfig::default() }, &uniform(10_000, 0.0, 0.12));
        assert!((gaussian.mean - 0.06).abs() < 1e-3 && (gaussian.scale - 0.12 / 12_f32.sqrt()).abs() < 1e-3, "{gaussian:?}");
        let wrong = ActionsConfig { low: vec![0.0, 1.0], ..ActionsConfig::default() };
        assert!(fit(&wrong, "test", 1, shown(&[1.0])).unwrap_err().to_string().contains("`actions.low` has 2 value(s)"));
    }

    #[test]
    fn a_column_that_never_changes_is_answered_as_it_is() {
        for units in [ActionUnits::Limits, ActionUnits::Gaussian] {
            let column = columns(&ActionsConfig { units, ..ActionsConfig::default() }, &[101.0; 30]);
            assert_eq!((column.low, column.high, column.mean, column.scale), (101.0, 101.0, 101.0, 1.0));
            assert_eq!(column.notable().unwrap(), "never changes");
        }
    }
}
