//! Several rows of the table at once (Picard iteration; Shih et al. 2023, "Parallel sampling of diffusion models"): the rows below a window are
//! guessed, all of them evaluated in one forward, and each guess replaced by what the jumps from above add up to. A row is accepted when the guess
//! that it was evaluated at had hardly moved. The first one always is, for it was evaluated at the window itself: so it never takes more passes
//! than the walk row by row, and with a tolerance of 0 it arrives where that does.
//!
//! It walks from border to border: latents are refined at READY, and a position is given out at the last row. It saves forwards, not evaluations.

/// Guesses of the rows below a window.
#[derive(Debug)]
pub struct Picard {
    /// Rows that are evaluated at once (p); 1 is off.
    window: usize,
    /// Largest movement of a guess that is borne out, standard deviations of its step's noise.
    tolerance: f32,
    /// Numbers of a window.
    size: usize,
    /// Of the `p - 1` rows below the window, one after the other.
    guesses: Vec<f32>,
    /// Where a pass leads, from the row below the window on: `p` rows.
    landed: Vec<f32>,
}

impl Picard {
    pub(super) fn new((window, tolerance): (usize, f32), size: usize) -> Self {
        let rows = |rows: usize| vec![0.0; rows * size];
        Self { window, tolerance, size, guesses: rows(window - 1), landed: rows(if window > 1 { window } else { 0 }) }
    }

    /// Rows to evaluate where so many are left.
    pub(super) fn slots(&self, rows_left: usize) -> usize {
        rows_left.clamp(1, self.window)
    }

    pub(super) fn guess(&self, below: usize) -> &[f32] {
        &self.guesses[below * self.size..][..self.size]
    }

    /// All rows below look like `x`.
    pub(super) fn begin(&mut self, x: &[f32]) {
        self.guesses.chunks_exact_mut(x.len().max(1)).for_each(|guess| guess.copy_from_slice(x));
    }

    pub(super) fn size_bytes(&self) -> usize {
        (self.guesses.capacity() + self.landed.capacity()) * size_of::<f32>()
    }

    /// Where a pass leads, in the row of this number below the first.
    pub(super) fn landed(&self, row: usize) -> &[f32] {
        &self.landed[row * self.size..][..self.size]
    }

    /// See [`Self::landed`].
    pub(super) fn landed_mut(&mut self, row: usize) -> &mut [f32] {
        &mut self.landed[row * self.size..][..self.size]
    }

    /// Whether a guess that was so far off is borne out.
    pub(super) fn bears(&self, movement: f32) -> bool {
        movement <= self.tolerance
    }

    /// So many rows were accepted, of `slots`: what the pass says of those below is the next guess.
    pub(super) fn advance(&mut self, accepted: usize, slots: usize) {
        let Self { size, guesses, landed, .. } = self;
        for (below, guess) in guesses.chunks_exact_mut((*size).max(1)).enumerate() {
            let from = (accepted + below).min(slots - 1);
            guess.copy_from_slice(&landed[from * *size..][..*size]);
        }
    }
}
