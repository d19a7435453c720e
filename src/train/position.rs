//! How far a run is.

use crate::model::noise::Philox;
use serde::{Deserialize, Serialize};

/// How far a run is; positions are in the order in which a run comes to them, stage by stage within an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Position {
    /// Index of the stage in the recipe.
    pub stage: usize,
    /// How often the run began anew from another seed, for a gate.
    pub attempt: usize,
    /// Steps of this stage that are done.
    pub step: usize,
    /// Steps that were done in earlier stages and attempts.
    #[serde(default)]
    pub before: usize,
}

impl Position {
    /// Where every run begins.
    pub const START: Self = Self { stage: 0, attempt: 0, step: 0, before: 0 };

    /// All steps of the run so far; never falls, however often it begins anew.
    pub fn total(&self) -> usize {
        self.before + self.step
    }

    /// The start of the next stage.
    pub fn next_stage(&self) -> Self {
        Self { stage: self.stage + 1, step: 0, before: self.total(), ..*self }
    }

    /// The start of the next attempt.
    pub fn next_attempt(&self) -> Self {
        Self { stage: 0, attempt: self.attempt + 1, step: 0, before: self.total() }
    }

    /// The randomness of the step to come: a stream of its own.
    pub fn stream(&self, seed: u64) -> Philox {
        Philox::named(seed, &format!("stage{}.{}.{}", self.stage + 1, self.attempt, self.step))
    }
}
