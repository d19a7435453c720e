//! Offline trajectories: read, checked, split by episodes, brought to the units of the networks.
pub mod beside;
pub mod blocks;
pub mod hdf5;
pub mod hidden;
pub mod places;
pub mod returns;
pub mod room;
pub mod rows;
pub mod surprises;
pub mod tokens;
pub mod units;
pub mod window;

use units::{ActionColumn, ActionsConfig};

use crate::model::{
    config::Units,
    noise::Philox,
    normalizer::{Affine, Normalizer},
    trajectory::Layout,
};
pub use rows::Episode;
use rows::Fields;
use serde::{Deserialize, Serialize};
use std::{fmt, io, ops::Range, sync::Arc};

/// One session in this many is held out.
const HELD_OUT_EVERY: usize = 10;
/// Seed of the split: the same for all training seeds, so that their held-out numbers can be compared.
const SPLIT_SEED: u64 = 0x5EED;

/// Seed of the held-out batches: the same for all runs, so that their errors can be compared.
pub const HELD_OUT_SEED: u64 = 0xE7A1;

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
    /// Too few episodes are long enough.
    #[error(
        "data set {path}: {kept} of {episodes} episode(s) have the {needed} steps that {why} asks for, the longest has {longest}; training \
         and held-out episodes need at least 2"
    )]
    TooFew {
        /// The file.
        path: String,
        /// How many are long enough.
        kept: usize,
        /// How many there are.
        episodes: usize,
        /// The least length.
        needed: usize,
        /// The recipe's keys behind it.
        why: String,
        /// Steps of the longest episode.
        longest: usize,
    },
}

/// A data set, raw units.
#[derive(Debug)]
pub struct Dataset {
    /// Where it was read from.
    pub path: String,
    /// SHA-256 of the file, hex.
    pub digest: String,
    /// All rows.
    pub fields: Fields,
    /// The episodes, in the order of the file.
    pub episodes: Vec<Span>,
    /// What a person should know about it; goes into the log.
    pub notes: Vec<String>,
}

/// Where an episode lies, and what it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Span {
    /// Its rows.
    pub rows: Range<usize>,
    /// Whether it shows what comes of actions and is nothing to imitate.
    pub play: bool,
    /// Whether it ended by what happened (`terminals`), and not because time was up.
    pub ended: bool,
    /// The rows of the episode that it follows in its session, if there is one, but the last: a session is never told what came of an
    /// episode's last act.
    pub before: Option<Range<usize>>,
}

/// Which episodes are meant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Which {
    /// All of them.
    #[default]
    All,
    /// Those to imitate: all but play.
    Demonstrations,
    /// Those that show what comes of actions which say nothing of the context (`infos/play`).
    Play,
}

impl fmt::Display for Which {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::All => "all episodes",
            Self::Demonstrations => "the episodes to imitate",
            Self::Play => "the episodes of play",
        })
    }
}

impl Which {
    fn holds(self, play: bool) -> bool {
        match self {
            Self::All => true,
            Self::Demonstrations => !play,
            Self::Play => play,
        }
    }
}

/// Episodes to train on, and others to measure on.
#[derive(Clone, Debug)]
pub struct Sides {
    /// To train on.
    pub train: Vec<Episode>,
    /// To measure on.
    pub held_out: Vec<Episode>,
}

impl Sides {
    /// Those of them that are meant.
    pub fn only(&self, which: Which) -> Self {
        let meant = |episodes: &[Episode]| episodes.iter().filter(|episode| which.holds(episode.play)).cloned().collect();
        Self { train: meant(&self.train), held_out: meant(&self.held_out) }
    }
}

/// A data set ready for training, normalized units, with the map to them.
pub struct Split {
    /// All episodes.
    pub episodes: Sides,
    /// Their units, fitted on the training episodes; the latent's spread is told by training.
    pub units: Units,
}

/// Where units come from.
pub enum UnitsFrom<'a> {
    /// The data, with these wishes for actions.
    Data(&'a ActionsConfig),
    /// A checkpoint.
    Checkpoint(&'a Units),
}

impl Dataset {
    /// Widths of states and actions.
    pub fn layout(&self) -> Layout {
        self.fields.layout()
    }

    /// Width of the context; 0 where the file has none.
    pub fn context_dim(&self) -> usize {
        self.fields.context.width()
    }

    /// Leaves out episodes of fewer than `needed` steps and notes how many; `why` names the recipe's keys that ask for it.
    ///
    /// # Errors
    /// If fewer than two are left.
    pub fn leave_out_shorter(&mut self, needed: usize, why: &str) -> Result<(), DatasetError> {
        let (episodes, longest) = (self.episodes.len(), self.episodes.iter().map(|span| span.rows.len()).max().unwrap_or(0));
        self.episodes.retain(|span| span.rows.len() >= needed);
        let kept = self.episodes.len();
        if kept < 2 {
            return Err(DatasetError::TooFew { path: self.path.clone(), kept, episodes, needed, why: why.into(), longest });
        }
        if kept < episodes {
            self.notes.push(format!(
                "{}: left out {} of {episodes} episodes shorter than {needed} steps ({why})",
                self.path,
                episodes - kept
            ));
        }
        Ok(())
    }

    /// Splits by sessions, mostly of one episode, drawn once and for all seeds alike, and brings them to units. What was chosen for the
    /// columns of actions is told beside it; with the units of a checkpoint nothing is chosen.
    ///
    /// # Errors
    /// If all episodes are of one session, the bounds wished for do not fit the columns, or rows are kept in a file and it cannot be read.
    pub fn split(self, from: UnitsFrom) -> Result<(Split, Vec<ActionColumn>), DatasetError> {
        let mut order: Vec<&[Span]> = self.episodes.chunk_by(|_, next| next.before.is_some()).collect();
        if order.len() < 2 {
            let reason = "all episodes are of one session, and sessions are held out as a whole: two are needed at least".into();
            return Err(DatasetError::Invalid { path: self.path.clone(), field: "infos/session".into(), reason });
        }
        let mut rng = Philox::new(SPLIT_SEED);
        for last in (1..order.len()).rev() {
            order.swap(last, rng.below(last + 1));
        }
        let (held_out, train) = order.split_at(order.len().div_ceil(HELD_OUT_EVERY));
        let (mut train, held_out) = (train.concat(), held_out.concat());
        train.sort_unstable_by_key(|span| span.rows.start);
        let (units, columns) = match from {
            UnitsFrom::Data(wishes) => self.fit(&train, wishes)?,
            UnitsFrom::Checkpoint(units) => (units.clone(), Vec::new()),
        };
        let Fields { states, actions, rewards, context } = self.fields;
        let bounds = (units.action_low.clone(), units.action_high.clone());
        let fields = Arc::new(Fields {
            states: states.normalized(units.normalizer.state.clone(), None),
            actions: actions.normalized(units.normalizer.action.clone(), Some(bounds)),
            rewards: rewards.normalized(units.normalizer.reward.clone(), None),
            context,
        });
        let episodes = |spans: Vec<Span>| spans.into_iter().map(|span| Episode::new(&fields, span)).collect();
        Ok((Split { episodes: Sides { train: episodes(train), held_out: episodes(held_out) }, units }, columns))
    }

    /// Gaussian maps for states and rewards, those of [`units`] for actions; fitted on these episodes.
    fn fit(&self, train: &[Span], wishes: &ActionsConfig) -> Result<(Units, Vec<ActionColumn>), DatasetError> {
        let (fields, spans) = (&self.fields, || train.iter().map(|span| span.rows.clone()));
        let columns = units::fit(wishes, &self.path, fields.actions.width(), |visit| fields.actions.scan(spans(), visit))?;
        let maps = || -> io::Result<_> {
            let state = Affine::fit(fields.states.width(), |visit| fields.states.scan(spans(), visit))?;
            let reward = Affine::fit(1, |visit| fields.rewards.scan(spans(), visit))?;
            let change = Affine::fit(fields.states.width(), |visit| fields.states.scan_changes(spans(), visit))?;
            Ok((state, reward, change))
        };
        let (state, reward, change) = maps().map_err(|error| unreadable(&self.path, &error))?;
        let state_change_std = change.std.iter().zip(&state.std).map(|(change, state)| change / state).collect();
        let normalizer = Normalizer { state, action: units::affine_of(&columns), reward, state_change_std };
        let bounds = |of: fn(&ActionColumn) -> f32| columns.iter().map(of).collect();
        let (action_low, action_high) = (bounds(|column| column.low), bounds(|column| column.high));
        Ok((Units { normalizer, action_low, action_high, latent_spread: 1.0, returns: None, context: None }, columns))
    }
}

fn unreadable(path: &str, error: &io::Error) -> DatasetError {
    DatasetError::Unreadable { path: path.into(), reason: error.to_string() }
}
