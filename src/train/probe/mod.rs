//! What the latent knows of the hidden context: a linear probe from its mean to the truth in the data (section 5 of the paper), beside what
//! the raw tokens hold of it. docs/identification.md says how to read it.
mod ages;
mod answer;
mod ceiling;
mod latent;
mod past;
mod score;
mod state;

pub use ages::{AGES, Age};
pub use answer::{Answer, Labels, Question, Row, probe};
pub use ceiling::{Held, ceiling, held};
pub use latent::{latent_means, latent_probe, prior_probe};
pub use score::{Features, score};
pub use state::beside_state;

use super::{dataset::Episode, ridge::Table};
use crate::model::{
    latent::{Evidence, LatentModel},
    method::Looks,
};

/// The evidence that a probe looks at, least first.
const PROBED: [Evidence; 3] = [Evidence::Filter, Evidence::SuccessorState, Evidence::Successor];

/// Those that it looks at in this model: a belief that is held does not wait for a successor.
pub fn probed(latent: &LatentModel) -> &'static [Evidence] {
    if latent.prior.is_some() { &PROBED } else { &PROBED[..1] }
}

/// Where features were taken: (episode, t).
pub type Place = (usize, usize);

/// Steps of an episode at which something can be probed: all that have a successor.
fn steps(episode: &Episode) -> usize {
    episode.len().saturating_sub(1)
}

/// Every how many steps a place is taken, for at most about `rows_max`.
fn stride(episodes: &[Episode], rows_max: usize) -> usize {
    episodes.iter().map(steps).sum::<usize>().div_ceil(rows_max.max(1)).max(1)
}

/// Every `stride`-th place of each episode that has a successor, `stride` chosen for at most about `rows_max` places.
pub fn places(episodes: &[Episode], rows_max: usize) -> Vec<Place> {
    let of = |(index, episode): (usize, &Episode)| (0..steps(episode)).map(move |t| (index, t)).collect::<Vec<_>>();
    episodes.iter().enumerate().flat_map(of).step_by(stride(episodes, rows_max)).collect()
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

/// Training and held-out episodes of a probe, and how many places of each are used.
pub struct Subjects<'a> {
    /// The probe is fitted on these.
    pub train: &'a [Episode],
    /// And measured on these.
    pub held_out: &'a [Episode],
    /// At most about this many places of each.
    pub rows_max: usize,
}

/// What an estimate of the context is made from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The latent's mean.
    Latent,
    /// The raw tokens, by ridge regression.
    Ceiling,
    /// The raw tokens but for their actions: an expert's action tells what the expert sees.
    CeilingWithoutActions,
    /// The state at that moment, by ridge regression.
    State,
    /// Both the latent's mean and that.
    LatentAndState,
}

/// One line of the probe's table.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// What the estimate is made from.
    pub source: Source,
    /// What it saw.
    pub evidence: Evidence,
    /// How far back it looked.
    pub looks: Looks,
    /// So many steps beyond t the prior was rolled out, or the ceiling asked for; the estimate is held against `context[t + ahead]`.
    pub ahead: usize,
    /// The estimate is held against `context[t + shift]`; that of a roll-out is where it belongs.
    pub shift: i32,
    /// What was measured.
    pub errors: Errors,
}

/// Standardised mean squared errors (1 - R2) on held-out episodes: 0 is exactly, 1 not at all; NaN where the context does not vary.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// By one map for all ages, where the whole block lies in the episode.
    pub whole: f64,
    /// At each of [`AGES`], by a map of its own; the first steps of an episode are among them.
    pub ages: [f64; AGES.len()],
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{noise::Philox, trajectory::Layout},
        train::dataset::Episode,
    };

    #[test]
    fn places_are_spread_evenly() {
        let mut rng = Philox::new(3);
        let mut noise = |len: usize| (0..len).map(|_| rng.normal()).collect::<Vec<f32>>();
        let mut episode = || Episode::of(Layout { state_dim: 1, action_dim: 1 }, [noise(40), noise(40), noise(40), noise(40)]);
        let episodes: Vec<_> = (0..10).map(|_| episode()).collect();
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
