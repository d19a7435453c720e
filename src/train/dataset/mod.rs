//! Offline trajectories: read, checked, split by episodes, brought to the units of the networks.
pub mod hdf5;
pub mod hidden;
pub mod units;
pub mod window;

use units::{ActionColumn, ActionsConfig};

use crate::model::{
    config::ModelConfig,
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

    fn normalized(&self, units: &Units) -> Self {
        Self {
            states: units.normalizer.state.normalize(&self.states),
            actions: units.normalizer.action.normalize_within(&self.actions, &units.action_low, &units.action_high),
            rewards: units.normalizer.reward.normalize(&self.rewards),
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
    /// Their units, fitted on the training episodes.
    pub units: Units,
}

/// The units that a data set is brought to.
#[derive(Clone, Debug)]
pub struct Units {
    /// The map to them.
    pub normalizer: Normalizer,
    /// Lower bound of each action column, raw units; what lies outside is held within.
    pub action_low: Vec<f32>,
    /// Upper bounds.
    pub action_high: Vec<f32>,
}

/// Where units come from.
pub enum UnitsFrom<'a> {
    /// The data, with these wishes for actions.
    Data(&'a ActionsConfig),
    /// A checkpoint.
    Checkpoint(&'a ModelConfig),
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

    /// Splits by episodes, drawn once and for all seeds alike, and brings them to units. What was chosen for the columns of actions is
    /// told beside it; with the units of a checkpoint nothing is chosen.
    ///
    /// # Errors
    /// If the bounds wished for do not fit the columns.
    pub fn split(&self, from: UnitsFrom) -> Result<(Split, Vec<ActionColumn>), DatasetError> {
        let mut order: Vec<usize> = (0..self.episodes.len()).collect();
        let mut rng = Philox::new(SPLIT_SEED);
        for last in (1..order.len()).rev() {
            order.swap(last, rng.below(last + 1));
        }
        let (held_out, train) = order.split_at(self.episodes.len().div_ceil(HELD_OUT_EVERY));
        let mut train = train.to_vec();
        train.sort_unstable();
        let (units, columns) = match from {
            UnitsFrom::Data(wishes) => self.fit(train.iter().map(|i| &self.episodes[*i]), wishes)?,
            UnitsFrom::Checkpoint(config) => {
                let (action_low, action_high) = (config.action_low.clone(), config.action_high.clone());
                (Units { normalizer: config.normalizer.clone(), action_low, action_high }, Vec::new())
            }
        };
        let normalized = |indices: &[usize]| indices.iter().map(|i| self.episodes[*i].normalized(&units)).collect();
        Ok((Split { train: normalized(&train), held_out: normalized(held_out), units }, columns))
    }

    /// Gaussian maps for states and rewards, those of [`units`] for actions.
    fn fit<'a>(
        &self,
        episodes: impl Iterator<Item = &'a Episode> + Clone,
        wishes: &ActionsConfig,
    ) -> Result<(Units, Vec<ActionColumn>), DatasetError> {
        let layout = self.layout;
        let rows = episodes.clone().flat_map(|episode| episode.actions.chunks_exact(layout.action_dim.max(1)));
        let columns = units::fit(wishes, &self.path, layout.action_dim, rows)?;
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
        let normalizer = Normalizer { state, action: units::affine_of(&columns), reward, state_change_std };
        let bounds = |of: fn(&ActionColumn) -> f32| columns.iter().map(of).collect();
        Ok((Units { normalizer, action_low: bounds(|column| column.low), action_high: bounds(|column| column.high) }, columns))
    }
}
