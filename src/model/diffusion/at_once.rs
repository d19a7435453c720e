//! A window whose rows below are evaluated with it: see [`super::picard`].

use super::descent::{Descent, Walk};

impl Descent {
    /// Takes estimates of the clean window in each slot, `T * D` values each, and goes down as many rows as the guesses bear out; in a hurry at
    /// least as many as the allowance asks for.
    pub(super) fn land_at_once(&mut self, x0: &[f32], slots: usize, walk: Walk) {
        let (size, top) = (self.x.len(), self.row);
        let mut accepted = None;
        for (slot, x0) in x0.chunks_exact(size).take(slots).enumerate() {
            self.take(x0, walk);
            self.row = top + slot;
            self.land(slot, walk);
            if accepted.is_none() && slot + 1 < slots && !self.picard.bears(self.movement(slot, walk)) {
                accepted = Some(slot + 1);
            }
        }
        let borne_out = accepted.unwrap_or(slots);
        let needed = self.rows_needed(top, slots);
        self.degraded |= needed > borne_out;
        let accepted = borne_out.max(needed);
        // The estimate from which the window came to where it stands now.
        self.take(&x0[(accepted - 1) * size..][..size], walk);
        self.x.copy_from_slice(self.picard.landed(accepted - 1));
        self.picard.advance(accepted, slots);
        self.row = top + accepted;
    }

    /// Where the window of a slot jumps to by its estimate: the first one as it would by itself, each other by the same jump from where the one
    /// above it landed.
    fn land(&mut self, slot: usize, walk: Walk) {
        let width = self.width();
        for position in 0..self.horizon() {
            let (from, to) = (self.level(0, position), self.level(1, position));
            let noise = self.draw_jump(position, 1, walk);
            let jump = walk.process.jump(from, to, self.sampling().eta);
            for column in 0..width {
                let i = position * width + column;
                let here = self.x(slot)[i];
                let next = match from == to {
                    true => here,
                    false => jump.x0 * self.x0[i] + jump.eps * walk.process.eps(from, here, self.x0[i]),
                };
                let landed = if slot == 0 { next } else { self.picard.landed(slot - 1)[i] + (next - here) };
                self.picard.landed_mut(slot)[i] = landed + noise * self.eps[column];
            }
        }
        let columns = walk.columns.known(0, self.given_len() == 0);
        let Self { picard, known, .. } = self;
        picard.landed_mut(slot)[columns.clone()].copy_from_slice(&known[..columns.len()]);
    }

    /// How far the guess of the row below a slot was from where the slot landed: root mean square over the positions on their way, in standard
    /// deviations of the step's noise (those of DDPM, whatever eta).
    fn movement(&self, slot: usize, walk: Walk) -> f32 {
        let (width, mut sum, mut count) = (self.width(), 0.0, 0_usize);
        let moved = self.picard.landed(slot).iter().zip(self.picard.guess(slot));
        let moved = moved.map(|(now, before)| (now - before).powi(2)).enumerate();
        for (i, square) in moved {
            let (from, to) = (self.level(0, i / width), self.level(1, i / width));
            let variance = if from == to { 0.0 } else { walk.process.jump(from, to, 1.0).noise.powi(2) };
            if variance > 0.0 {
                (sum, count) = (sum + square / variance, count + 1);
            }
        }
        (sum / count.max(1) as f32).sqrt()
    }
}
