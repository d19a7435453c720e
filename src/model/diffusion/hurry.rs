//! A window in a hurry: larger jumps down the same table, or what there is.

use super::descent::{Descent, Walk, Window};

impl Descent {
    /// Bounds the evaluations that it may still take, at least one: if the table asks for more, the coming rows are taken in larger
    /// jumps, and the answer is marked degraded. Rows are those of training, whatever the jump, and READY, where the latent is refined, is
    /// left out only by a window that has one evaluation. `None` lifts the bound.
    pub fn allow(&mut self, evaluations: Option<usize>) {
        self.allowance = evaluations.map(|evaluations| evaluations.max(1));
    }

    /// Forwards that it may still take, the coming one included.
    pub fn allowance(&self) -> Option<usize> {
        self.allowance
    }

    /// Whether that bound makes the coming forward go farther than it would without.
    pub fn is_hurried(&self) -> bool {
        let farther = |slots: usize| if slots > 1 { self.rows_needed(self.row, slots) > 1 } else { self.rows_at_once() > 1 };
        !self.is_done() && self.allowance.is_some() && farther(self.slots())
    }

    /// Rows that a forward from this one has to go down, of `slots` that are evaluated at once.
    pub(super) fn rows_needed(&self, row: usize, slots: usize) -> usize {
        self.allowance.map_or(1, |passes| self.rows_left(row).div_ceil(passes)).min(slots)
    }

    /// Forwards that the table still asks for, if no guess is borne out.
    pub fn evaluations_left(&self) -> usize {
        self.rows_left(self.row)
    }

    /// Forwards that a window in this row would need.
    pub fn rows_left(&self, row: usize) -> usize {
        let others = self.actions_left().saturating_sub(1) * self.table().rung();
        self.table().emit().saturating_sub(row) + others
    }

    /// Gives out what there is, without another evaluation: positions of the last estimate.
    pub fn cut_short(&mut self, walk: Walk) {
        self.degraded = true;
        while !self.is_done() {
            self.jump_rows(self.table().emit() - self.row, walk);
            self.emit(walk);
        }
    }

    /// Gives out positions of a window as it is, before any evaluation: noised again it would only be farther from an action.
    pub fn give_as_it_is(&mut self, window: &Window, walk: Walk) {
        self.begin_with(window, 0, walk);
        self.degraded = true;
        while !self.is_done() {
            // Nothing goes down: what was at rung 2 is at position 0 then.
            let row = self.row;
            self.emit(walk);
            self.row = row.saturating_sub(self.table().rung());
        }
    }

    /// Rows to the next evaluation; never beyond the one where position 0 comes clean, nor beyond READY, where it is refined, unless there
    /// is no evaluation left for that.
    pub(super) fn rows_at_once(&self) -> usize {
        let Some(allowance) = self.allowance else { return 1 };
        let (ready, emit) = (self.table().ready().unwrap_or(0), self.table().emit());
        let (above, below) = (ready.saturating_sub(self.row), emit - self.row.max(ready));
        // The least jump with which this position and those behind it come clean in time.
        let needed = |rows: usize| {
            let others = (self.actions_left() - 1) * self.table().rung().div_ceil(rows);
            above.div_ceil(rows) + below.div_ceil(rows) + others
        };
        let least = (above + below).div_ceil(allowance);
        match (least..=above.max(below)).find(|&rows| needed(rows) <= allowance) {
            Some(rows) => rows.min(if above > 0 { above } else { below }),
            None => above + below,
        }
    }
}
