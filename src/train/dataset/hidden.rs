//! What of a history is hidden in training, so that an act may come without it.
//!
//! A network that always saw rewards takes their absence for news: on Point-Wind-S a policy trained with whole histories fell from -21.1
//! to -44.7 when its client reported none, though the reward says nothing there.

use crate::model::{config::Missing, noise::Philox, trajectory::Seen};
use serde::{Deserialize, Serialize};

/// The recipe's `[hide]`: how often a field of the history is hidden, in the blocks of the ELBO and in windows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Hide {
    /// States before the current one, as in a chunk of several actions whose client reports none in between.
    pub state: f32,
    /// Actions, as when somebody else acted.
    pub action: f32,
    /// Rewards.
    pub reward: f32,
}

impl Default for Hide {
    fn default() -> Self {
        Self { state: 0.1, action: 0.1, reward: 0.2 }
    }
}

impl Hide {
    /// Nothing: for what is measured on whole histories.
    pub const NOTHING: Self = Self { state: 0.0, action: 0.0, reward: 0.0 };

    /// Which fields of a history may be missing at an act.
    pub fn trained(&self) -> Missing {
        Missing { state: self.state > 0.0, action: self.action > 0.0, reward: self.reward > 0.0 }
    }

    /// What one sequence hides.
    pub fn draw(&self, rng: &mut Philox) -> Hidden {
        Hidden { state: Gaps::draw(self.state, rng), action: Gaps::draw(self.action, rng), reward: Gaps::draw(self.reward, rng) }
    }
}

/// What one sequence hides of its history.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hidden {
    state: Gaps,
    action: Gaps,
    reward: Gaps,
}

impl Hidden {
    /// What is seen of one step of the history.
    pub fn step(&self, rng: &mut Philox) -> Seen {
        Seen { state: self.state.seen(rng), action: self.action.seen(rng), reward: self.reward.seen(rng) }
    }

    /// What a step may show whose fields come one at a time: all but what is hidden at every step.
    pub fn ever(&self) -> Seen {
        let ever = |gaps| gaps != Gaps::Everywhere;
        Seen { state: ever(self.state), action: ever(self.action), reward: ever(self.reward) }
    }
}

/// Where a field is missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Gaps {
    Nowhere,
    /// At half of the steps, each drawn by itself: a report now and then.
    Here,
    Everywhere,
}

impl Gaps {
    /// Half of the sequences with gaps lack the field altogether.
    fn draw(probability: f32, rng: &mut Philox) -> Self {
        match rng.uniform() / probability {
            share if share < 0.5 => Self::Everywhere,
            share if share < 1.0 => Self::Here,
            _ => Self::Nowhere,
        }
    }

    fn seen(self, rng: &mut Philox) -> bool {
        let coin = rng.uniform() < 0.5;
        match self {
            Self::Nowhere => true,
            Self::Here => coin,
            Self::Everywhere => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_hidden_as_often_as_asked() {
        let (hide, mut rng) = (Hide { state: 0.0, action: 0.2, reward: 1.0 }, Philox::new(5));
        let (mut steps, mut whole) = ([0; 3], [0; 3]);
        for _ in 0..2000 {
            let hidden = hide.draw(&mut rng);
            let seen: Vec<Seen> = (0..10).map(|_| hidden.step(&mut rng)).collect();
            let fields: [fn(&Seen) -> bool; 3] = [|seen| seen.state, |seen| seen.action, |seen| seen.reward];
            for (field, get) in fields.iter().enumerate() {
                let missing = seen.iter().filter(|seen| !get(seen)).count();
                steps[field] += missing;
                whole[field] += usize::from(missing == 10);
                assert!(get(&hidden.ever()) || missing == 10);
            }
        }
        assert_eq!((steps[0], whole[0]), (0, 0));
        let near = |found: usize, expected: f32| (found as f32 - expected).abs() < 0.15 * expected;
        assert!(near(whole[1], 200.0) && near(steps[1], 3000.0), "{whole:?} {steps:?}");
        assert!(near(whole[2], 1000.0) && near(steps[2], 15_000.0), "{whole:?} {steps:?}");
    }
}
