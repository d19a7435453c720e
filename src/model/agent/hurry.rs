//! An act in a hurry: larger jumps down the same ladder, or what there is.

use super::{Descent, Start, descent::Walk};

impl Descent {
    /// Bounds the evaluations that it may still take, at least one: if the ladder asks for more, the coming rows are taken in larger
    /// jumps, and the chunk is marked degraded. Rows are those of training, whatever the jump, and READY, where the latent is refined, is
    /// left out only by an act that has one evaluation. `None` lifts the bound.
    pub fn allow(&mut self, evaluations: Option<usize>) {
        self.allowance = evaluations.map(|evaluations| evaluations.max(1));
    }

    /// See [`super::Agent::cut_short`].
    pub(super) fn cut_short(&mut self, walk: Walk) -> bool {
        if !self.started {
            let Some(window) = self.stored_window().filter(|window| self.surprise(window) < walk.config.restart.cold_distance) else {
                return false;
            };
            // As it is: noised again it would only be farther from an action.
            let row = window.row;
            (self.started, self.start) = (true, Start::Warm);
            self.resume(row);
            self.inpaint();
        } else if self.evaluations == 0 {
            return false;
        }
        self.degraded = true;
        while !self.is_done() {
            if self.evaluations > 0 {
                self.jump_rows(self.ladder.emit() - self.row, walk);
                self.emit(walk);
            } else {
                // Nothing goes down: what was at rung 2 is at position 0 then.
                let row = self.row;
                self.emit(walk);
                self.row = row.saturating_sub(self.ladder.rung());
            }
        }
        true
    }

    /// Rows to the next evaluation; never beyond the one where position 0 comes clean, nor beyond READY, where it is refined, unless there
    /// is no evaluation left for that.
    pub(super) fn rows_at_once(&self) -> usize {
        let Some(allowance) = self.allowance else { return 1 };
        let (ready, emit) = (self.ladder.ready(), self.ladder.emit());
        let (above, below) = (ready.saturating_sub(self.row), emit - self.row.max(ready));
        // The least jump with which this position and those behind it come clean in time.
        let needed = |rows: usize| {
            let others = (self.actions_left() - 1) * self.ladder.rung().div_ceil(rows);
            above.div_ceil(rows) + below.div_ceil(rows) + others
        };
        let least = (above + below).div_ceil(allowance);
        match (least..=above.max(below)).find(|&rows| needed(rows) <= allowance) {
            Some(rows) => rows.min(if above > 0 { above } else { below }),
            None => above + below,
        }
    }
}
