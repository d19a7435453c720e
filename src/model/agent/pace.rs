//! How an act in a hurry goes, and the memory of it: what its deadline made of it depends on the clock, so it is written down, and an act that is
//! told what was written goes the same way, whatever the clock says.

use super::Haste;

/// Changes of mind that are noted. The act keeps to the last one noted where the clock would change it more often: memory for them is taken when
/// the act begins, and what was not noted could not be done again. The last place is kept for the end of all hurry: somebody with time may join late.
const BOUNDS_MAX: usize = 32;

/// See the module.
#[derive(Debug)]
pub(super) struct Pace {
    /// What was made of it so far.
    haste: Haste,
    /// What is to be made of it again.
    script: Option<Haste>,
    /// The bound on the next forward, as the last one noted has it.
    standing: Option<u32>,
}

impl Pace {
    pub(super) fn new() -> Self {
        Self { haste: Haste { bounds: Vec::with_capacity(BOUNDS_MAX), cut: None }, script: None, standing: None }
    }

    /// To go as one went before.
    pub(super) fn repeat(&mut self, haste: Haste) {
        self.script = Some(haste);
    }

    /// Takes note of the bound on the forward of this number (None: of one that changes nothing), and says which one holds: see
    /// [`crate::model::diffusion::descent::Descent::allow`].
    pub(super) fn settle(&mut self, forward: u32, bound: Option<u32>) -> Option<u32> {
        let bound = match &self.script {
            Some(script) => script.bounds.iter().find(|(at, _)| *at == forward).map_or(self.standing, |(_, left)| *left),
            None if self.haste.bounds.len() + usize::from(bound.is_some()) >= BOUNDS_MAX => self.standing,
            None => bound,
        };
        if bound != self.standing {
            self.haste.bounds.push((forward, bound));
        }
        self.standing = bound.map(|left| left.saturating_sub(1).max(1));
        bound
    }

    /// It gave out what it had before the forward of this number.
    pub(super) fn cut(&mut self, forward: u32) {
        self.haste.cut = Some(forward);
    }

    /// Whether it is to give out what it has before the forward of this number.
    pub(super) fn is_to_be_cut(&self, forward: u32) -> bool {
        self.haste.cut.is_none() && self.script.as_ref().is_some_and(|script| script.cut == Some(forward))
    }

    /// What was made of it.
    pub(super) fn take_haste(&mut self) -> Haste {
        std::mem::take(&mut self.haste)
    }

    pub(super) fn size_bytes(&self) -> usize {
        let scripted = self.script.as_ref().map_or(0, |script| script.bounds.capacity());
        (self.haste.bounds.capacity() + scripted) * size_of::<(u32, Option<u32>)>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is said again each time is noted once, and counted down; only so many changes of mind are followed.
    #[test]
    fn a_change_is_noted_once() {
        let mut pace = Pace::new();
        assert_eq!([None, Some(3), Some(2), Some(1)].map(|bound| pace.settle(4, bound)), [None, Some(3), Some(2), Some(1)]);
        assert_eq!(pace.haste.bounds, [(4, Some(3))]);
        let mut fickle = Pace::new();
        let followed = (0..100).filter(|forward| fickle.settle(*forward, Some(50 + forward % 2 * 7)) == Some(50 + forward % 2 * 7)).count();
        assert!(fickle.haste.bounds.len() == BOUNDS_MAX - 1 && followed < 40, "{followed}");
        assert_eq!([None, Some(3)].map(|bound| fickle.settle(100, bound)), [None, None], "one who has time joins, and decides");
        let (mut again, script) = (Pace::new(), fickle.haste.clone());
        again.repeat(script);
        assert!((0..=100).filter_map(|forward| again.settle(forward, None)).all(|left| left <= 57));
        assert_eq!(again.take_haste(), fickle.haste);
    }
}
