//! Places in episodes, drawn.

use super::Episode;
use crate::model::noise::Philox;

/// All places where a piece may begin: (episode, first step), equally likely.
pub struct Places {
    /// Places up to and with each episode.
    ends: Vec<usize>,
    /// How many steps before its own first a piece may begin, in each episode.
    before: Vec<usize>,
}

impl Places {
    /// From `before` steps before each episode's start up to the last place where `len` steps still fit.
    pub fn new(episodes: &[Episode], before: usize, len: usize) -> Self {
        Self::counted(episodes.iter().map(|episode| (before, (episode.len() + before + 1).saturating_sub(len))))
    }

    /// Only the start of each episode that has room for `len` steps; where it follows another, also up to half of these before it.
    pub fn starts(episodes: &[Episode], len: usize) -> Self {
        Self::counted(episodes.iter().map(|episode| {
            let before = episode.reach().min(len / 2);
            (before, if episode.len() >= len { before + 1 } else { 0 })
        }))
    }

    /// Where a transition may begin: at each step but the last, and at that one too where something ended the episode.
    pub fn of_transitions(episodes: &[Episode]) -> Self {
        Self::counted(episodes.iter().map(|episode| (0, episode.len() - usize::from(!episode.ended))))
    }

    /// Of each episode, how many steps before its first the first place lies, and how many places there are.
    fn counted(of: impl Iterator<Item = (usize, usize)>) -> Self {
        let (mut ends, mut before, mut sum) = (Vec::new(), Vec::new(), 0);
        for (steps, count) in of {
            sum += count;
            ends.push(sum);
            before.push(steps);
        }
        Self { ends, before }
    }

    /// Whether no episode has room for the piece.
    pub fn is_empty(&self) -> bool {
        self.ends.last().is_none_or(|all| *all == 0)
    }

    /// One of them.
    pub fn draw(&self, rng: &mut Philox) -> (usize, isize) {
        let drawn = rng.below(self.ends.last().copied().unwrap_or(0));
        let episode = self.ends.partition_point(|end| *end <= drawn);
        let first = episode.checked_sub(1).map_or(0, |before| self.ends[before]);
        (episode, (drawn - first) as isize - self.before[episode] as isize)
    }
}

/// An episode and a place in it. One that follows another is half of the time taken for the first of its session: not every client keeps its
/// history.
pub(super) fn drawn(episodes: &[Episode], places: &Places, rng: &mut Philox) -> (Episode, isize) {
    let (index, start) = places.draw(rng);
    let episode = &episodes[index];
    let forgets = episode.reach() > 0 && rng.uniform() < 0.5;
    (if forgets { episode.alone() } else { episode.clone() }, start)
}
