//! Features of places, and how much of the context a linear map finds in them.

use super::{AGES, Errors, Place};
use crate::train::{
    dataset::Episode,
    ridge::{Ridge, Table, standardised_error},
};
use std::io;

/// Features of the places of a set of episodes.
pub struct Features<'a> {
    /// The episodes.
    pub episodes: &'a [Episode],
    /// Where.
    pub places: Vec<Place>,
    /// One row for each place.
    pub table: Table,
}

impl Features<'_> {
    /// The same places with some of the columns.
    pub fn columns(&self, columns: std::ops::Range<usize>) -> Self {
        Self { episodes: self.episodes, places: self.places.clone(), table: self.table.columns(columns) }
    }

    /// Rows for which `context[t + shift]` exists and t is wanted, with that context.
    fn aligned(&self, shift: i32, wanted: impl Fn(usize) -> bool) -> io::Result<(Table, Table)> {
        let dim = self.episodes.first().map_or(0, |episode| episode.context_dim);
        let (mut rows, mut truth) = (Vec::new(), Table::new(dim));
        for (row, (episode, t)) in self.places.iter().enumerate() {
            let at = *t as i64 + i64::from(shift);
            let inside = usize::try_from(at).ok().filter(|at| *at < self.episodes[*episode].len());
            if let Some(at) = inside.filter(|_| wanted(*t)) {
                rows.push(row);
                truth.values.extend(self.episodes[*episode].context(at)?.iter().map(|value| f64::from(*value)));
            }
        }
        Ok((self.table.select(&rows), truth))
    }
}

/// Fits on `fit` and measures on `test`: by one map where t is at least `from` (the whole block lies in the episode), and by a map of its own
/// at each age.
///
/// # Errors
/// If an episode cannot be read.
pub fn score(fit: &Features, test: &Features, shift: i32, from: usize, lambda: f64) -> io::Result<Errors> {
    let error = |wanted: &dyn Fn(usize) -> bool| -> io::Result<f64> {
        let ((x, y), (seen, truth)) = (fit.aligned(shift, wanted)?, test.aligned(shift, wanted)?);
        if x.rows() == 0 || truth.rows() == 0 {
            return Ok(f64::NAN);
        }
        Ok(standardised_error(&Ridge::fit(&x, &y, lambda).predict(&seen), &truth))
    };
    let mut errors = Errors { whole: error(&|t| t >= from)?, ages: [f64::NAN; AGES.len()] };
    for (at, age) in errors.ages.iter_mut().zip(AGES) {
        *at = error(&|t| age.holds(t))?;
    }
    Ok(errors)
}

#[cfg(test)]
mod tests {
    use super::{super::places, *};
    use crate::model::{noise::Philox, trajectory::Layout};

    const LAMBDA: f64 = 1e-6;

    /// Episodes whose context is white noise, so that no shift helps another.
    fn episodes(count: usize, seed: u64) -> Vec<Episode> {
        let mut rng = Philox::new(seed);
        let layout = Layout { state_dim: 1, action_dim: 1 };
        let mut noise = |len: usize| (0..len).map(|_| rng.normal()).collect::<Vec<f32>>();
        let mut episode = || {
            let (states, actions, rewards, context) = (noise(40), noise(40), noise(40), noise(80));
            Episode::of(layout, [states, actions, rewards, context])
        };
        (0..count).map(|_| episode()).collect()
    }

    /// Features that are the context of the step before, mixed and shifted: known exactly at shift -1, not at all at others. Before `from`
    /// they are another number altogether.
    fn lagged(episodes: &[Episode], from: usize) -> Features<'_> {
        let places = places(episodes, usize::MAX);
        let mut table = Table::new(2);
        for (episode, t) in &places {
            let before = t.checked_sub(1).filter(|before| *before >= from);
            let context = before.map_or([9.0, 9.0].as_slice().into(), |before| episodes[*episode].context(before).unwrap());
            let (a, b) = (f64::from(context[0]), f64::from(context[1]));
            table.values.extend([2.0 * a - b + 1.0, a + b]);
        }
        Features { episodes, places, table }
    }

    #[test]
    fn the_probe_finds_the_shift() {
        let (train, held_out) = (episodes(60, 1), episodes(20, 2));
        let (fit, test) = (lagged(&train, 0), lagged(&held_out, 0));
        let errors = [-1, 0, 1].map(|shift| score(&fit, &test, shift, 1, LAMBDA).unwrap().whole);
        assert!(errors[0] < 1e-6 && errors[1] > 0.9 && errors[2] > 0.9, "{errors:?}");
    }

    /// A context that is known from step 11 on: not at all at the first age, exactly at the second, and no step is as old as the last.
    #[test]
    fn ages_are_told_apart() {
        let (train, held_out) = (episodes(60, 1), episodes(20, 2));
        let (fit, test) = (lagged(&train, 9), lagged(&held_out, 9));
        let errors = score(&fit, &test, -1, 10, LAMBDA).unwrap();
        let [young, later, late, last] = errors.ages;
        assert!((0.95..1.1).contains(&young) && later < 1e-6 && late < 1e-6 && last.is_nan(), "{errors:?}");
        assert!(errors.whole < 1e-6, "{errors:?}");
        let all = score(&fit, &test, -1, 0, LAMBDA).unwrap().whole;
        assert!(all > 0.2, "the first steps count where no block is left out: {all}");
    }
}
