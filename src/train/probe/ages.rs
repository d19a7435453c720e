//! Steps since an episode began: little is known at first, and how soon more is tells what a longer look is worth.

use std::fmt;

/// A band of ages, `start..end`; without an end up to the end of the episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Age {
    /// First step, from 0.
    pub start: usize,
    /// First step that is not in it any more.
    pub end: Option<usize>,
}

/// The bands, which together are all ages.
pub const AGES: [Age; 4] =
    [Age { start: 0, end: Some(10) }, Age { start: 10, end: Some(30) }, Age { start: 30, end: Some(80) }, Age { start: 80, end: None }];

impl Age {
    /// Whether step t of an episode is in it.
    pub fn holds(self, t: usize) -> bool {
        t >= self.start && self.end.is_none_or(|end| t < end)
    }
}

impl fmt::Display for Age {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.end {
            Some(end) => write!(f, "[{},{end})", self.start),
            None => write!(f, "[{},end)", self.start),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_has_one_age() {
        for (t, at) in [(0, 0), (9, 0), (10, 1), (29, 1), (30, 2), (79, 2), (80, 3), (1_000_000, 3)] {
            let of: Vec<_> = (0..AGES.len()).filter(|index| AGES[*index].holds(t)).collect();
            assert_eq!(of, [at], "step {t}");
        }
    }
}
