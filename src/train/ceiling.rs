//! The ceiling of the probe: how much of the context ridge regression finds in the raw tokens themselves.
//!
//! Two steps, so that it stays tractable for wide states: quadratic features of one transition (s, a, r, s') give an estimate of the
//! context at its time, then a linear filter over the estimates of a block.

use super::{
    dataset::{Episode, rows::pieces},
    probe::{Features, Place, Score, Subjects, places, score},
    ridge::{Ridge, Table},
};
use crate::model::latent::Evidence;
use anyhow::Result;
use std::io;

/// Penalties of the two steps; the first has about a thousand features.
const LAMBDA: (f64, f64) = (1e-3, 1e-6);
/// Rows on which the first step is fitted.
const FIT_ROWS: usize = 12_000;
/// Transitions whose features are made at once.
const CHUNK: usize = 4096;
/// Transitions with more columns than this get linear features only.
const QUADRATIC_COLUMNS_MAX: usize = 64;

/// Ceilings at shift 0 without the successor and with its state; a whole successor token adds an action that may leak what the
/// data's expert knew, so it has no ceiling.
///
/// # Errors
/// If an episode cannot be read.
pub fn ceiling(subjects: &Subjects, block_lens: &[usize]) -> Result<Vec<Score>> {
    let (fit_on, truth) = transitions(subjects.train, &places(subjects.train, FIT_ROWS))?;
    let (ridge, dim) = (Ridge::fit(&fit_on, &truth, LAMBDA.0), truth.width);
    let estimates = |episodes: &[Episode]| -> io::Result<Vec<Table>> {
        (0..episodes.len()).map(|index| estimates(&ridge, dim, episodes, index)).collect()
    };
    let (train, held_out) = (estimates(subjects.train)?, estimates(subjects.held_out)?);
    let mut scores = Vec::new();
    for block_len in block_lens {
        for evidence in [Evidence::Filter, Evidence::SuccessorState] {
            let features = |episodes, estimates: &[Table]| filter_features(episodes, estimates, (evidence, *block_len), subjects.rows_max);
            let (fit, test) = (features(subjects.train, &train), features(subjects.held_out, &held_out));
            let (error, error_all) = score(&fit, &test, 0, *block_len, LAMBDA.1)?;
            scores.push(Score { source: "ceiling", evidence, block_len: *block_len, shift: 0, error, r2: 1.0 - error, error_all });
        }
    }
    Ok(scores)
}

/// Estimates of the context at each transition of one episode, `dim` columns; a long episode's features would not fit into memory.
fn estimates(ridge: &Ridge, dim: usize, episodes: &[Episode], index: usize) -> io::Result<Table> {
    let mut table = Table::new(dim);
    for piece in pieces(0..episodes[index].len() - 1, CHUNK) {
        let places: Vec<Place> = piece.map(|t| (index, t)).collect();
        table.values.extend(ridge.predict(&transitions(episodes, &places)?.0).values);
    }
    Ok(table)
}

/// Estimates of the transitions of a block, latest first: from t - 1 back without the successor, from t back with it; 0 before the start.
fn filter_features<'a>(episodes: &'a [Episode], estimates: &[Table], seen: (Evidence, usize), rows_max: usize) -> Features<'a> {
    let (evidence, block_len) = seen;
    let newest = if evidence == Evidence::Filter { 1 } else { 0 };
    let dim = estimates.first().map_or(0, |table| table.width);
    let places = places(episodes, rows_max);
    let mut table = Table::new(dim * (block_len + 1 - newest));
    for (episode, t) in &places {
        for back in newest..=block_len {
            match t.checked_sub(back) {
                Some(at) => table.values.extend(estimates[*episode].row(at)),
                None => table.values.extend(std::iter::repeat_n(0.0, dim)),
            }
        }
    }
    Features { episodes, places, table }
}

/// Quadratic features of the transitions at these places, and the context there.
fn transitions(episodes: &[Episode], places: &[Place]) -> io::Result<(Table, Table)> {
    let dim = episodes.first().map_or(0, |episode| episode.context_dim);
    let (mut features, mut truth) = (Table::new(0), Table::new(dim));
    for (episode, t) in places {
        let episode = &episodes[*episode];
        let (state, action, reward, next) = (episode.state(*t)?, episode.action(*t)?, episode.reward(*t)?, episode.state(t + 1)?);
        let parts = [&*state, &*action, &[reward], &*next];
        let columns: Vec<f64> = parts.into_iter().flatten().map(|value| f64::from(*value)).collect();
        features.values.extend(&columns);
        features.width = columns.len();
        if columns.len() <= QUADRATIC_COLUMNS_MAX {
            for (i, a) in columns.iter().enumerate() {
                features.values.extend(columns[i..].iter().map(|b| a * b));
            }
            features.width += columns.len() * (columns.len() + 1) / 2;
        }
        truth.values.extend(episode.context(*t)?.iter().map(|value| f64::from(*value)));
    }
    Ok((features, truth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{noise::Philox, trajectory::Layout};

    /// s' = s / 2 + a + c with a context c drawn anew at each step: a transition tells all of it, the past nothing.
    fn episodes(count: usize, seed: u64) -> Vec<Episode> {
        let mut rng = Philox::new(seed);
        let mut episode = || {
            let mut noise = || (0..40).map(|_| rng.normal()).collect::<Vec<f32>>();
            let (actions, context, rewards) = (noise(), noise(), vec![0.0; 40]);
            let mut states = vec![0.0];
            for t in 0..39 {
                states.push(0.5 * states[t] + actions[t] + context[t]);
            }
            Episode::of(Layout { state_dim: 1, action_dim: 1 }, [states, actions, rewards, context])
        };
        (0..count).map(|_| episode()).collect()
    }

    #[test]
    fn knows_what_a_transition_tells_and_no_more() {
        let (train, held_out) = (episodes(40, 1), episodes(10, 2));
        let subjects = Subjects { train: &train, held_out: &held_out, rows_max: 5000 };
        for score in ceiling(&subjects, &[1, 3]).unwrap() {
            match score.evidence {
                Evidence::Filter => assert!(score.error > 0.9, "{score:?}"),
                Evidence::Refinement | Evidence::SuccessorState | Evidence::Successor => assert!(score.error < 0.01, "{score:?}"),
            }
        }
    }
}
