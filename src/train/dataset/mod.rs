//! Offline trajectories: read, checked, split by episodes, brought to the units of the networks.
pub mod hdf5;
pub mod window;

use crate::model::{
    noise::Philox,
    normalizer::{Affine, Normalizer},
    trajectory::Layout,
};

/// One episode in this many is held out.
const HELD_OUT_EVERY: usize = 10;
/// Seed of the split: the same for all training seeds, so that their held-out numbers can be compared.
const SPLIT_SEED: u64 = 0x5EED;

/// Why a data set cannot be trained on.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// Not a file, or not HDF5.
    #[error("data set {path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// What the system or the reader said.
        reason: String,
    },
    /// An array is not what it has to be.
    #[error("data set {path}: `{field}`: {reason}")]
    Invalid {
        /// The file.
        path: String,
        /// The array.
        field: String,
        /// What is wrong and what is expected.
        reason: String,
    },
    /// An episode is shorter than what the recipe asks for.
    #[error("data set {path}: episode {episode} has {len} steps, but {why} needs at least {needed}")]
    TooShort {
        /// The file.
        path: String,
        /// Index of the first such episode.
        episode: usize,
        /// Its length.
        len: usize,
        /// The least length.
        needed: usize,
        /// The recipe's keys behind it.
        why: String,
    },
    /// Nothing to hold out.
    #[error("data set {path}: {episodes} episode(s), but training and held-out episodes need at least 2")]
    TooFew {
        /// The file.
        path: String,
        /// How many there are.
        episodes: usize,
    },
}

/// One episode: row-major columns, all of the same number of steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    /// Widths of states and actions.
    pub layout: Layout,
    /// Width of the context; 0 where the file has none.
    pub context_dim: usize,
    /// `(N, state_dim)`.
    pub states: Vec<f32>,
    /// `(N, action_dim)`.
    pub actions: Vec<f32>,
    /// `(N,)`: reward of executing a_t in s_t.
    pub rewards: Vec<f32>,
    /// `(N, context_dim)`: the hidden truth while a_t is executed; seen by the probe alone, never by training.
    pub context: Vec<f32>,
}

impl Episode {
    /// Number of steps.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Whether there are no steps.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// s_t.
    pub fn state(&self, t: usize) -> &[f32] {
        &self.states[t * self.layout.state_dim..][..self.layout.state_dim]
    }

    /// a_t.
    pub fn action(&self, t: usize) -> &[f32] {
        &self.actions[t * self.layout.action_dim..][..self.layout.action_dim]
    }

    /// The context at t.
    pub fn context(&self, t: usize) -> &[f32] {
        &self.context[t * self.context_dim..][..self.context_dim]
    }

    fn normalized(&self, normalizer: &Normalizer) -> Self {
        Self {
            states: normalizer.state.normalize(&self.states),
            actions: normalizer.action.normalize(&self.actions),
            rewards: normalizer.reward.normalize(&self.rewards),
            ..self.clone()
        }
    }
}

/// A data set, raw units.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Where it was read from.
    pub path: String,
    /// SHA-256 of the file, hex.
    pub digest: String,
    /// Widths of states and actions.
    pub layout: Layout,
    /// Width of the context; 0 where the file has none.
    pub context_dim: usize,
    /// In the order of the file.
    pub episodes: Vec<Episode>,
}

/// A data set ready for training, normalized units, with the map to them.
pub struct Split {
    /// Episodes to train on.
    pub train: Vec<Episode>,
    /// Episodes to measure on.
    pub held_out: Vec<Episode>,
    /// Fitted on the training episodes.
    pub normalizer: Normalizer,
    /// Bounds of each action column, raw units.
    pub action_bounds: (Vec<f32>, Vec<f32>),
}

impl Dataset {
    /// Checks that every episode has at least `needed` steps; `why` names the recipe's keys that ask for it.
    ///
    /// # Errors
    /// If one has not, or there are fewer than two episodes.
    pub fn require_len(&self, needed: usize, why: &str) -> Result<(), DatasetError> {
        if self.episodes.len() < 2 {
            return Err(DatasetError::TooFew { path: self.path.clone(), episodes: self.episodes.len() });
        }
        match self.episodes.iter().position(|episode| episode.len() < needed) {
            None => Ok(()),
            Some(episode) => {
                let len = self.episodes[episode].len();
                Err(DatasetError::TooShort { path: self.path.clone(), episode, len, needed, why: why.into() })
            }
        }
    }

    /// Splits by episodes, drawn once and for all seeds alike, and normalizes by what the training part says, or by `normalizer`.
    pub fn split(&self, normalizer: Option<&Normalizer>) -> Split {
        let mut order: Vec<usize> = (0..self.episodes.len()).collect();
        let mut rng = Philox::new(SPLIT_SEED);
        for last in (1..order.len()).rev() {
            order.swap(last, rng.below(last + 1));
        }
        let (held_out, train) = order.split_at(self.episodes.len().div_ceil(HELD_OUT_EVERY));
        let mut train = train.to_vec();
        train.sort_unstable();
        let action_bounds = self.action_bounds();
        let normalizer = normalizer.cloned().unwrap_or_else(|| fit(train.iter().map(|i| &self.episodes[*i]), self.layout, &action_bounds));
        let normalized = |indices: &[usize]| indices.iter().map(|i| self.episodes[*i].normalized(&normalizer)).collect();
        Split { train: normalized(&train), held_out: normalized(held_out), action_bounds, normalizer }
    }

    /// -1 and 1 for a column within them, else the extremes of the data.
    fn action_bounds(&self) -> (Vec<f32>, Vec<f32>) {
        let dim = self.layout.action_dim;
        let column = |j: usize| self.episodes.iter().flat_map(move |episode| episode.actions.iter().skip(j).step_by(dim).copied());
        let low = (0..dim).map(|j| column(j).fold(-1.0, f32::min)).collect();
        let high = (0..dim).map(|j| column(j).fold(1.0, f32::max)).collect();
        (low, high)
    }
}

/// Gaussian maps for states and rewards; actions are mapped from their bounds to [-1, 1], so data within [-1, 1] stay as they are.
fn fit<'a>(episodes: impl Iterator<Item = &'a Episode> + Clone, layout: Layout, (low, high): &(Vec<f32>, Vec<f32>)) -> Normalizer {
    let states: Vec<f32> = episodes.clone().flat_map(|episode| episode.states.iter().copied()).collect();
    let rewards: Vec<f32> = episodes.clone().flat_map(|episode| episode.rewards.iter().copied()).collect();
    let (state, reward) = (Affine::fit(&states, layout.state_dim), Affine::fit(&rewards, 1));
    let changes: Vec<f32> = episodes
        .flat_map(|episode| {
            (1..episode.len()).flat_map(move |t| episode.state(t).iter().zip(episode.state(t - 1)).map(|(next, now)| next - now))
        })
        .collect();
    let change = Affine::fit(&changes, layout.state_dim);
    let state_change_std = change.std.iter().zip(&state.std).map(|(change, state)| change / state).collect();
    let bounds = low.iter().zip(high);
    let action = Affine {
        mean: bounds.clone().map(|(low, high)| 0.5 * (low + high)).collect(),
        std: bounds.map(|(low, high)| 0.5 * (high - low)).collect(),
    };
    Normalizer { state, action, reward, state_change_std }
}
