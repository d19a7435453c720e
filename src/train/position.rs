//! How far a run is.

use crate::model::noise::Philox;
use serde::{Deserialize, Serialize};

/// The stations of a run, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Latent identification.
    Latent,
    /// Denoise and refine.
    Refine,
    /// Nothing is left to train.
    Done,
}

impl Stage {
    /// As it stands in logs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Latent => "stage1",
            Self::Refine => "stage2",
            Self::Done => "done",
        }
    }

    /// The opposite of [`Self::name`].
    pub fn named(name: &str) -> Option<Self> {
        [Self::Latent, Self::Refine, Self::Done].into_iter().find(|stage| stage.name() == name)
    }
}

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Position {
    /// Where.
    pub stage: Stage,
    /// How often stage 1 was restarted from another seed.
    pub attempt: usize,
    /// Steps of this stage that are done.
    pub step: usize,
    /// Steps that were done in earlier stages and attempts.
    #[serde(default)]
    pub before: usize,
}

impl Position {
    /// All steps of the run so far; never falls, whatever stage 1 is tried again.
    pub fn total(&self) -> usize {
        self.before + self.step
    }

    /// The start of another stage or attempt after this one.
    pub fn then(&self, stage: Stage, attempt: usize) -> Self {
        Self { stage, attempt, step: 0, before: self.total() }
    }

    /// The randomness of the step to come: a stream of its own.
    pub fn stream(&self, seed: u64) -> Philox {
        Philox::named(seed, &format!("{}.{}.{}", self.stage.name(), self.attempt, self.step))
    }
}
