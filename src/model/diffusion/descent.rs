//! A window on its way down the table of levels, one row an evaluation (sections 4.3 and 4.4 of the paper): arithmetic on one window.
//! It knows of no episode, latent or network.

use super::{picard::Picard, process::Process, schedule::Table};
use crate::model::{
    columns::{Bounds, Columns},
    noise::{Noise, Slot},
};
use serde::{Deserialize, Serialize};

/// What all windows of a model go by.
#[derive(Clone, Copy)]
pub struct Walk<'a> {
    /// alpha-bar and the jumps between levels.
    pub process: &'a Process,
    /// Columns of a position.
    pub columns: &'a Columns,
    /// Their bounds.
    pub bounds: &'a Bounds,
}

/// How one window is sampled.
#[derive(Clone, Copy, Debug)]
pub struct Sampling {
    /// Its rows.
    pub table: Table,
    /// Actions to be given out (T_a).
    pub actions: usize,
    /// 0 is DDIM, 1 is DDPM.
    pub eta: f32,
    /// Factor on the standard deviation of all noise.
    pub temperature: f32,
    /// Where noise comes from.
    pub noise: Noise,
    /// Environment time of position 0.
    pub time: u64,
    /// Rows of the table that are evaluated at once, and how far one may move from pass to pass to be accepted; see [`super::picard`].
    pub at_once: (usize, f32),
}

/// A window between two acts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// `T * D` values, normalized units.
    pub x: Vec<f32>,
    /// Row of the table: READY, or above it after an act that a deadline cut short.
    pub row: usize,
    /// The state it was built for, normalized; empty where actions alone are diffused.
    pub predicted_state: Vec<f32>,
}

/// A window on its way. All its memory is taken when it is made; going down allocates nothing.
#[derive(Debug)]
pub struct Descent {
    sampling: Sampling,
    /// s_tau, normalized: what is known of position 0 until an action has been given out.
    pub(super) known: Vec<f32>,
    pub(super) x: Vec<f32>,
    /// The network's last estimate of the clean window, `T * D` values.
    pub(super) x0: Vec<f32>,
    /// Positions given out since that estimate: position `i` of `x` is position `i + dropped` of `x0`.
    dropped: usize,
    pub(super) row: usize,
    /// Positions given out, `D` values each.
    given: Vec<f32>,
    predicted_state: Vec<f32>,
    /// Noise of one position.
    pub(super) eps: Vec<f32>,
    pub(super) evaluations: u32,
    /// Forwards that it took part in: fewer than evaluations, where several rows are evaluated at once.
    pub(super) passes: u32,
    /// Guesses of the rows below, where several are evaluated at once.
    pub(super) picard: Picard,
    /// Passes that it may still take.
    pub(super) allowance: Option<usize>,
    pub(super) degraded: bool,
    failed: bool,
}

impl Descent {
    /// A window of `horizon` positions that has not begun; `known` is the real state.
    pub fn new(sampling: Sampling, known: Vec<f32>, horizon: usize, columns: &Columns) -> Self {
        let width = columns.width();
        Self {
            x: vec![0.0; horizon * width],
            x0: vec![0.0; horizon * width],
            dropped: 0,
            row: 0,
            given: Vec::with_capacity(sampling.actions * width),
            predicted_state: vec![0.0; columns.state.len()],
            eps: vec![0.0; width],
            evaluations: 0,
            passes: 0,
            picard: Picard::new(sampling.at_once, horizon * width),
            allowance: None,
            degraded: false,
            failed: false,
            sampling,
            known,
        }
    }

    /// Begins at pure noise.
    pub fn begin_cold(&mut self, walk: Walk) {
        self.row = 0;
        (0..self.horizon()).for_each(|position| self.draw_position(position));
        self.write_known(walk);
        self.guess_anew();
    }

    /// Goes on with a window, `rows` rows above where it stands: its positions are noised again up to there.
    pub fn begin_with(&mut self, window: &Window, rows: usize, walk: Walk) {
        self.x.copy_from_slice(&window.x);
        self.row = window.row - rows;
        if rows > 0 {
            self.renoise(window.row, walk);
        }
        self.write_known(walk);
        self.guess_anew();
    }

    /// Is that which an act before arrived at, and nothing is left to be evaluated.
    pub fn hold(&mut self, given: &[f32]) {
        self.given.extend_from_slice(given);
    }

    /// What is known of the present turns into NaN, in the window too.
    pub fn spoil(&mut self) {
        self.known.fill(f32::NAN);
        self.x.fill(f32::NAN);
    }

    /// Whether nothing is left to be evaluated.
    pub fn is_done(&self) -> bool {
        self.failed || self.actions_left() == 0
    }

    /// Whether an estimate was not finite: there is no answer.
    pub fn has_failed(&self) -> bool {
        self.failed
    }

    /// Network evaluations spent so far.
    pub fn evaluations(&self) -> u32 {
        self.evaluations
    }

    /// Forwards that it took part in so far.
    pub fn passes(&self) -> u32 {
        self.passes
    }

    /// Whether a deadline made it take larger jumps, or end before its time.
    pub fn is_degraded(&self) -> bool {
        self.degraded
    }

    /// Whether position 0 stands where it is refined.
    pub fn is_ready(&self) -> bool {
        self.table().ready() == Some(self.row)
    }

    /// Windows that are to be evaluated at once: itself, and guesses of the rows below it.
    pub fn slots(&self) -> usize {
        self.picard.slots(self.rows_to_border())
    }

    /// The window of a slot, `T * D` values.
    pub fn x(&self, slot: usize) -> &[f32] {
        match slot.checked_sub(1) {
            None => &self.x,
            Some(below) => self.picard.guess(below),
        }
    }

    /// One position of it.
    pub fn position(&self, position: usize) -> &[f32] {
        &self.x[position * self.width()..][..self.width()]
    }

    /// Standard deviation of the noise at a position.
    pub fn sigma(&self, position: usize, walk: Walk) -> f32 {
        walk.process.sigma(self.table().level(self.table().fine(self.row, position)))
    }

    /// Level of a position of the window of a slot.
    pub fn level(&self, slot: usize, position: usize) -> usize {
        self.table().level(self.table().fine(self.row + slot, position))
    }

    /// Levels of the window of a slot, one a position.
    pub fn write_levels(&self, slot: usize, out: &mut [f32]) {
        out.iter_mut().enumerate().for_each(|(position, out)| *out = self.level(slot, position) as f32);
    }

    /// Positions given out: how many, and one of them, `D` values.
    pub fn given_len(&self) -> usize {
        self.given.len() / self.width().max(1)
    }

    /// See [`Self::given_len`].
    pub fn given(&self, position: usize) -> &[f32] {
        &self.given[position * self.width()..][..self.width()]
    }

    /// Environment time of position 0.
    pub fn time(&self) -> u64 {
        self.sampling.time + self.given_len() as u64
    }

    /// Estimates of the positions behind those that were given out; without any, the window itself, but for its last, fresh position.
    pub fn planned(&self) -> &[f32] {
        if self.evaluations > 0 { &self.x0[self.dropped * self.width()..] } else { &self.x[..self.x.len() - self.width()] }
    }

    /// Estimate of the state after the last action that was given out; empty where actions alone are diffused.
    pub fn predicted_state(&self) -> &[f32] {
        &self.predicted_state
    }

    /// What is known of position 0: the real state, normalized.
    pub fn known(&self) -> &[f32] {
        &self.known
    }

    /// Where its noise comes from.
    pub fn noise(&self) -> Noise {
        self.sampling.noise
    }

    /// Rows that each further action takes.
    pub fn rung(&self) -> usize {
        self.table().rung()
    }

    /// What is left for the next act.
    pub fn into_window(self) -> Window {
        Window { x: self.x, row: self.row, predicted_state: self.predicted_state }
    }

    /// Resident size in bytes, beside its own.
    pub fn size_bytes(&self) -> usize {
        let floats = [&self.known, &self.x, &self.x0, &self.given, &self.predicted_state, &self.eps];
        floats.iter().map(|values| values.capacity() * size_of::<f32>()).sum::<usize>() + self.picard.size_bytes()
    }

    /// Takes the network's estimates of the clean window, `T * D` values for each slot, and goes down: one row, or as many as the allowance asks
    /// for or the guesses bear out.
    pub fn step_down(&mut self, x0: &[f32], walk: Walk) {
        let slots = self.slots();
        self.evaluations += slots as u32;
        self.passes += 1;
        if x0.iter().any(|value| !value.is_finite()) {
            self.failed = true;
            return;
        }
        if slots > 1 {
            self.land_at_once(x0, slots, walk);
        } else {
            self.take(x0, walk);
            let rows = self.rows_at_once();
            self.degraded |= rows > 1;
            self.jump_rows(rows, walk);
            self.write_known(walk);
        }
        self.allowance = self.allowance.map(|left| left.saturating_sub(1).max(1));
        if self.rows_to_border() == 0 || self.table().ready() == Some(self.row) {
            self.guess_anew();
        }
        if self.row == self.table().emit() {
            self.emit(walk);
        }
    }

    /// An estimate of the clean window, held within bounds.
    pub(super) fn take(&mut self, x0: &[f32], walk: Walk) {
        self.x0.copy_from_slice(x0);
        self.dropped = 0;
        self.x0.chunks_mut(self.eps.len().max(1)).for_each(|position| walk.bounds.hold(position));
    }

    /// Rows to the next one at which something else happens than a jump: READY, where the latent is refined, or the last.
    pub(super) fn rows_to_border(&self) -> usize {
        let border = self.table().ready().filter(|ready| self.row < *ready).unwrap_or(self.table().emit());
        border - self.row
    }

    #[cfg(test)]
    pub(in crate::model) fn row(&self) -> usize {
        self.row
    }

    #[cfg(test)]
    pub(in crate::model) fn stand_at(&mut self, row: usize, x: &[f32], given: &[f32]) {
        self.row = row;
        self.x.copy_from_slice(x);
        self.given = given.to_vec();
        self.guess_anew();
    }

    #[cfg(test)]
    pub(in crate::model) fn ready_row(&self) -> Option<usize> {
        self.table().ready()
    }

    #[cfg(test)]
    pub(in crate::model) fn x0(&self) -> &[f32] {
        &self.x0
    }

    pub(super) fn table(&self) -> &Table {
        &self.sampling.table
    }

    pub(super) fn actions_left(&self) -> usize {
        self.sampling.actions - self.given_len()
    }

    pub(super) fn sampling(&self) -> &Sampling {
        &self.sampling
    }

    pub(super) fn width(&self) -> usize {
        self.eps.len()
    }

    pub(super) fn horizon(&self) -> usize {
        self.x.len() / self.width().max(1)
    }

    /// Position 0 of the first action holds the real state; later ones hold what the model imagines.
    pub(super) fn write_known(&mut self, walk: Walk) {
        let columns = walk.columns.known(0, self.given.is_empty());
        self.x[columns.clone()].copy_from_slice(&self.known[..columns.len()]);
    }

    /// Forward jump of every position from row `from` up to the current one.
    fn renoise(&mut self, from: usize, walk: Walk) {
        let (width, temperature) = (self.width(), self.sampling.temperature);
        for position in 0..self.horizon() {
            let [from, to] = [from, self.row].map(|row| self.table().fine(row, position));
            let (keep, add) = walk.process.renoise(self.table().level(from), self.table().level(to));
            // The window's own time joins the level: a position may be noised to the same level again at a later act.
            let (noise, time) = (self.sampling.noise, self.time() + position as u64);
            noise.fill(time, noise_key(to, position), Slot::Renoise, &mut self.eps);
            let add = add * temperature;
            self.x[position * width..][..width].iter_mut().zip(&self.eps).for_each(|(x, eps)| *x = keep * *x + add * eps);
        }
    }

    /// A new position of the window, at pure noise.
    fn draw_position(&mut self, position: usize) {
        let (width, temperature) = (self.width(), self.sampling.temperature);
        let (noise, time) = (self.sampling.noise, self.time() + position as u64);
        let x = &mut self.x[position * width..][..width];
        noise.fill(time, u32::MAX, Slot::Window, x);
        x.iter_mut().for_each(|x| *x *= temperature);
    }

    /// Reverse jump of every position, by the last estimate, to its level so many rows below.
    pub(super) fn jump_rows(&mut self, rows: usize, walk: Walk) {
        (0..self.horizon()).for_each(|position| self.jump(position, rows, walk));
        self.row += rows;
    }

    /// From here on guesses are made anew: the rows below look like this one.
    pub(super) fn guess_anew(&mut self) {
        self.picard.begin(&self.x);
    }

    fn jump(&mut self, position: usize, rows: usize, walk: Walk) {
        let [from, to] = [self.row, self.row + rows].map(|row| self.table().level(self.table().fine(row, position)));
        if from == to {
            return;
        }
        let scale = self.draw_jump(position, rows, walk);
        let (width, jump) = (self.width(), walk.process.jump(from, to, self.sampling.eta));
        let estimate = (position + self.dropped).min(self.horizon() - 1);
        let columns = self.x[position * width..][..width].iter_mut().zip(&self.x0[estimate * width..][..width]);
        for ((x, x0), noise) in columns.zip(&self.eps) {
            *x = jump.x0 * x0 + jump.eps * walk.process.eps(from, *x, *x0) + scale * noise;
        }
    }

    /// Draws the noise of a position's jump so many rows down, and its scale.
    pub(super) fn draw_jump(&mut self, position: usize, rows: usize, walk: Walk) -> f32 {
        let fine = [self.row, self.row + rows].map(|row| self.table().fine(row, position));
        let [from, to] = fine.map(|fine| self.table().level(fine));
        let (sampling, noise) = (self.sampling, walk.process.jump(from, to, self.sampling.eta).noise);
        if from != to && noise > 0.0 {
            // The position joins the level, as in `renoise`: a later act may walk the same levels again.
            let time = self.time() + position as u64;
            sampling.noise.fill(time, noise_key(fine[1], position), Slot::Jump, &mut self.eps);
            noise * sampling.temperature
        } else {
            self.eps.fill(0.0);
            0.0
        }
    }

    /// Clean positions are given out: where they come clean one after the other, position 0 alone, which makes room for a fresh one at the
    /// far end; else as many as are asked for.
    pub(super) fn emit(&mut self, walk: Walk) {
        let (width, last) = (self.width(), self.horizon() - 1);
        let begin = self.given.len();
        let count = if self.table().ready().is_some() { 1 } else { self.actions_left() };
        self.given.extend_from_slice(&self.x[..count * width]);
        // A clean position is within bounds already.
        self.given[begin..].chunks_mut(self.eps.len().max(1)).for_each(|position| walk.bounds.hold(position));
        // What comes next: its estimate, or what stands there if nothing was estimated in this act.
        let next = if self.evaluations > 0 { &self.x0[self.dropped * width..] } else { &self.x };
        let state = walk.columns.state.clone();
        let next = next.get(count * width..(count + 1) * width).unwrap_or(&self.x[..width]);
        self.predicted_state.copy_from_slice(&next[state]);
        self.dropped += count;
        if let Some(ready) = self.table().ready() {
            self.x.copy_within(width.., 0);
            self.draw_position(last);
            self.row = ready;
        }
    }
}

/// Noise key of a fine level (20 bits) at a position (10 bits), a number of its own for each pair; the bounds are those of
/// [`crate::model::config::ModelConfig::check`].
fn noise_key(level: usize, position: usize) -> u32 {
    (level & 0xFFFF | position << 16 | (level >> 16) << 26) as u32
}

#[cfg(test)]
mod tests {
    use super::noise_key;
    use std::collections::HashSet;

    /// Levels from 65,536 on shared their noise with the next position.
    #[test]
    fn each_level_of_each_position_has_its_own_noise() {
        let levels = (0..1 << 20).step_by(4093).chain([65_535, 65_536, 65_537, 1 << 20]);
        let keys: HashSet<u32> = levels.clone().flat_map(|level| (0..1024).map(move |position| noise_key(level, position))).collect();
        assert_eq!(keys.len(), levels.collect::<HashSet<_>>().len() * 1024);
        assert_eq!(noise_key(7, 3), 7 | 3 << 16, "as it always was");
    }
}
