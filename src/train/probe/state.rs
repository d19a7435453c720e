//! What the state at that moment tells of the context by itself, and the latent beside it. Whoever acts on a latent reads the state too, and a
//! baseline has read off it what it tells: of a strong wind that lasts, say, the speed of what it blows. The latent is then asked for the rest
//! alone, and its own probe says little of what a decision knows.

use super::{
    Features, Place, Score, Source, Subjects, latent_means, places,
    score::{self, score},
};
use crate::{
    model::{
        latent::{Evidence, LatentModel},
        method::Looks,
    },
    train::{
        dataset::Episode,
        ridge::{Ridge, Table, standardised_error},
    },
};
use anyhow::Result;
use std::io;

/// Penalty; there may be some hundred features.
const LAMBDA: f64 = 1e-3;

/// Errors of both at t, of what a decision has.
///
/// # Errors
/// If an episode cannot be read, or a tensor operation fails.
pub fn beside_state(latent: &LatentModel, subjects: &Subjects, looks: Looks) -> Result<Vec<Score>> {
    let of = |episodes| -> Result<[Features; 2]> {
        let places = places(episodes, subjects.rows_max);
        let states = states(episodes, &places)?;
        let both = latent_means(latent, episodes, &places, Evidence::Filter, looks)?.beside(&states);
        Ok([states, both].map(|table| score::Features { episodes, places: places.clone(), table }))
    };
    let (fit, test) = (of(subjects.train)?, of(subjects.held_out)?);
    let line = |((source, fit), test): ((Source, &Features), &Features)| {
        let errors = score(fit, test, 0, looks.block_len(), LAMBDA)?;
        Ok(Score { source, evidence: Evidence::Filter, looks, ahead: 0, shift: 0, errors })
    };
    [Source::State, Source::LatentAndState].into_iter().zip(&fit).zip(&test).map(line).collect()
}

/// Quadratic features of s_t at these places.
fn states(episodes: &[Episode], places: &[Place]) -> io::Result<Table> {
    let mut features = Table::new(0);
    for (episode, t) in places {
        let state: Vec<f64> = episodes[*episode].state(*t)?.iter().map(|value| f64::from(*value)).collect();
        features.push_quadratic(&state);
    }
    Ok(features)
}

/// Error of the state alone at so many places of each side, of any age.
///
/// # Errors
/// If an episode cannot be read.
pub fn told_by_state(subjects: &Subjects, rows_max: usize) -> io::Result<f64> {
    let of = |episodes: &[Episode]| -> io::Result<(Table, Table)> {
        let places = places(episodes, rows_max);
        let mut truth = Table::new(episodes.first().map_or(0, |episode| episode.context_dim));
        for (episode, t) in &places {
            truth.values.extend(episodes[*episode].context(*t)?.iter().map(|value| f64::from(*value)));
        }
        Ok((states(episodes, &places)?, truth))
    };
    let ((x, y), (seen, truth)) = (of(subjects.train)?, of(subjects.held_out)?);
    Ok(standardised_error(&Ridge::fit(&x, &y, LAMBDA).predict(&seen), &truth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{method::GruLatent, nn::params::Params, noise::Philox, trajectory::Layout};

    const LAYOUT: Layout = Layout { state_dim: 2, action_dim: 1 };

    /// A context that is the product of two columns of the state, which no latent of fresh weights tells.
    fn episodes(count: usize, seed: u64) -> Vec<Episode> {
        let mut rng = Philox::new(seed);
        let mut episode = || {
            let states: Vec<f32> = (0..80).map(|_| rng.normal()).collect();
            let context = states.chunks(2).map(|state| state[0] * state[1]).collect();
            Episode::of(LAYOUT, [states, vec![0.0; 40], vec![0.0; 40], context])
        };
        (0..count).map(|_| episode()).collect()
    }

    #[test]
    fn what_the_state_tells_is_told_beside_the_latent() {
        let (train, held_out) = (episodes(30, 1), episodes(10, 2));
        let subjects = Subjects { train: &train, held_out: &held_out, rows_max: 10_000 };
        let model = LatentModel::new(&GruLatent::plain(3, 8, Looks::Block(4)), LAYOUT, &Params::fresh(4)).unwrap();
        let scores = beside_state(&model, &subjects, Looks::Block(4)).unwrap();
        assert_eq!(scores.iter().map(|score| score.source).collect::<Vec<_>>(), [Source::State, Source::LatentAndState]);
        assert!(scores.iter().all(|score| score.errors.whole < 1e-3 && score.errors.ages[1] < 1e-2), "{scores:?}");
        assert!(told_by_state(&subjects, 1000).unwrap() < 1e-3);
    }
}
