//! What the latent knows of the hidden context: a linear probe from its mean to the truth in the data (section 5 of the paper).

use super::{
    dataset::{
        Episode,
        window::{TokenRows, histories},
    },
    ridge::{Ridge, Table, standardised_error},
};
use crate::model::{
    latent::{Evidence, LatentModel},
    method::Looks,
    trajectory::Seen,
};
use anyhow::{Result, ensure};
use serde::Serialize;
use std::io;

/// Rows of one forward.
const CHUNK: usize = 512;
/// Penalty of the probe; its few latents do not need more than numerical safety.
const LAMBDA: f64 = 1e-6;

/// The evidence that a probe looks at, least first.
const PROBED: [Evidence; 3] = [Evidence::Filter, Evidence::SuccessorState, Evidence::Successor];

/// Those that it looks at in this model: a belief that is held does not wait for a successor.
pub fn probed(latent: &LatentModel) -> &'static [Evidence] {
    if latent.prior.is_some() { &PROBED } else { &PROBED[..1] }
}

/// Where features were taken: (episode, t).
pub type Place = (usize, usize);

/// Every `stride`-th place of each episode that has a successor, `stride` chosen for at most about `rows_max` places.
pub fn places(episodes: &[Episode], rows_max: usize) -> Vec<Place> {
    let total: usize = episodes.iter().map(|episode| episode.len().saturating_sub(1)).sum();
    let stride = total.div_ceil(rows_max.max(1)).max(1);
    let of = |(index, episode): (usize, &Episode)| (0..episode.len().saturating_sub(1)).map(move |t| (index, t)).collect::<Vec<_>>();
    episodes.iter().enumerate().flat_map(of).step_by(stride).collect()
}

/// Latent means of c_t at these places: `(places, dim)`.
///
/// # Errors
/// If a tensor operation fails.
pub fn latent_means(latent: &LatentModel, episodes: &[Episode], places: &[Place], evidence: Evidence, looks: Looks) -> Result<Table> {
    let mut out = Table::new(0);
    // A GRU that runs on reads each episode once.
    let together = |a: &Place, b: &Place| looks != Looks::Running || a.0 == b.0;
    for chunk in places.chunk_by(together).flat_map(|places| places.chunks(CHUNK)) {
        let pasts: Vec<_> = chunk.iter().map(|(episode, t)| (&episodes[*episode], *t as isize)).collect();
        let mut ahead = TokenRows::new(pasts[0].0.layout);
        for (episode, t) in &pasts {
            evidence.ahead().iter().zip(*t..).try_for_each(|(seen, at)| ahead.push(episode, at, *seen))?;
        }
        let ahead = ahead.tokens(pasts.len(), evidence.ahead().len())?;
        let posterior = match looks {
            Looks::Block(_) => latent.infer_after(&latent.past(&histories(&pasts, looks, |_, _| Seen::ALL)?.0, None)?, &ahead)?,
            Looks::Running => {
                let (episode, at) = (pasts[0].0, chunk.iter().map(|(_, t)| *t).collect::<Vec<_>>());
                let mut whole = TokenRows::new(episode.layout);
                (0..episode.len()).try_for_each(|t| whole.push(episode, t as isize, Seen::ALL))?;
                latent.infer_within(&whole.tokens(1, episode.len())?, &at, &ahead)?
            }
        };
        let gaussian = if evidence == Evidence::Filter { latent.coming(posterior)? } else { posterior };
        out.width = gaussian.mean.dim(candle_core::D::Minus1)?;
        out.values.extend(gaussian.mean.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from));
    }
    Ok(out)
}

/// Root of the summed variances of all columns: the spread of the latent, the yardstick of a jump.
pub fn spread(means: &Table) -> f64 {
    let count = means.rows().max(1) as f64;
    let column = |j: usize| means.values.iter().skip(j).step_by(means.width).copied();
    let variance = |j: usize| {
        let mean = column(j).sum::<f64>() / count;
        column(j).map(|v| (v - mean).powi(2)).sum::<f64>() / count
    };
    (0..means.width).map(variance).sum::<f64>().sqrt()
}

/// One line of the probe's table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// What the estimate is made from: a latent, or ridge on the raw tokens (the ceiling).
    pub source: &'static str,
    /// What it saw.
    pub evidence: Evidence,
    /// Whole tokens before t; 0: all of the episode's.
    pub block_len: usize,
    /// The estimate at t is held against `context[t + shift]`.
    pub shift: i32,
    /// Standardised mean squared error on held-out episodes, where the whole block lies in the episode.
    pub error: f64,
    /// 1 - error.
    pub r2: f64,
    /// The same error over all steps, the first ones of an episode included.
    pub error_all: f64,
}

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
    /// Rows for which `context[t + shift]` exists and t is at least `from`, with that context.
    fn aligned(&self, shift: i32, from: usize) -> io::Result<(Table, Table)> {
        let dim = self.episodes.first().map_or(0, |episode| episode.context_dim);
        let (mut rows, mut truth) = (Vec::new(), Table::new(dim));
        for (row, (episode, t)) in self.places.iter().enumerate() {
            let at = *t as i64 + i64::from(shift);
            let inside = usize::try_from(at).ok().filter(|at| *at < self.episodes[*episode].len());
            if let Some(at) = inside.filter(|_| *t >= from) {
                rows.push(row);
                truth.values.extend(self.episodes[*episode].context(at)?.iter().map(|value| f64::from(*value)));
            }
        }
        Ok((self.table.select(&rows), truth))
    }
}

/// Fits on `fit`, where the block is whole, and measures on `test`: (error where the block is whole, error over all steps).
///
/// # Errors
/// If an episode cannot be read.
pub fn score(fit: &Features, test: &Features, shift: i32, from: usize, lambda: f64) -> io::Result<(f64, f64)> {
    let (x, y) = fit.aligned(shift, from)?;
    let ridge = Ridge::fit(&x, &y, lambda);
    let error = |from: usize| -> io::Result<f64> {
        let (x, y) = test.aligned(shift, from)?;
        Ok(standardised_error(&ridge.predict(&x), &y))
    };
    Ok((error(from)?, error(0)?))
}

/// Training and held-out episodes of a probe, and how many places of each are used.
pub struct Subjects<'a> {
    /// The probe is fitted on these.
    pub train: &'a [Episode],
    /// And measured on these.
    pub held_out: &'a [Episode],
    /// At most about this many places of each.
    pub rows_max: usize,
}

/// The linear probe of a latent model that looks back so far, with this evidence, over shifts.
///
/// # Errors
/// If the data have no context, or a tensor operation fails.
pub fn latent_probe(latent: &LatentModel, subjects: &Subjects, evidence: Evidence, looks: Looks, shifts: &[i32]) -> Result<Vec<Score>> {
    let context_dim = subjects.train.first().map_or(0, |episode| episode.context_dim);
    ensure!(context_dim > 0, "the data set has no `infos/context`, so there is no truth to probe for");
    let features = |episodes| -> Result<Features> {
        let places = places(episodes, subjects.rows_max);
        let table = latent_means(latent, episodes, &places, evidence, looks)?;
        Ok(Features { episodes, places, table })
    };
    let (fit, test) = (features(subjects.train)?, features(subjects.held_out)?);
    let block_len = looks.block_len();
    let line = |shift: &i32| {
        let (error, error_all) = score(&fit, &test, *shift, block_len, LAMBDA)?;
        Ok(Score { source: "latent", evidence, block_len, shift: *shift, error, r2: 1.0 - error, error_all })
    };
    shifts.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{noise::Philox, trajectory::Layout};

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

    /// Features that are the context of the step before, mixed and shifted: known exactly at shift -1, not at all at others.
    fn lagged(episodes: &[Episode]) -> Features<'_> {
        let places = places(episodes, usize::MAX);
        let mut table = Table::new(2);
        for (episode, t) in &places {
            let context = t.checked_sub(1).map_or([9.0, 9.0].as_slice().into(), |before| episodes[*episode].context(before).unwrap());
            let (a, b) = (f64::from(context[0]), f64::from(context[1]));
            table.values.extend([2.0 * a - b + 1.0, a + b]);
        }
        Features { episodes, places, table }
    }

    #[test]
    fn the_probe_finds_the_shift() {
        let (train, held_out) = (episodes(60, 1), episodes(20, 2));
        let (fit, test) = (lagged(&train), lagged(&held_out));
        let errors = [-1, 0, 1].map(|shift| score(&fit, &test, shift, 1, LAMBDA).unwrap().0);
        assert!(errors[0] < 1e-6 && errors[1] > 0.9 && errors[2] > 0.9, "{errors:?}");
        let (settled, all) = score(&fit, &test, 0, 5, LAMBDA).unwrap();
        assert!(settled != all, "the first steps count in the second number only");
    }

    #[test]
    fn places_are_spread_evenly() {
        let episodes = episodes(10, 3);
        assert_eq!(places(&episodes, usize::MAX).len(), 10 * 39);
        let some = places(&episodes, 100);
        assert!(some.len() <= 100 && some.len() > 90);
        assert_eq!(some.last().unwrap().0, 9);
    }

    #[test]
    fn spread_pools_the_dimensions() {
        let table = Table { width: 2, values: vec![1.0, 0.0, -1.0, 0.0, 1.0, 4.0, -1.0, 4.0] };
        assert!((spread(&table) - 5.0_f64.sqrt()).abs() < 1e-12);
    }
}
