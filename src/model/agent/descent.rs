//! An act in progress: a window on its way down the ladder, one row an evaluation (sections 4.3 and 4.4 of the paper).

use super::{
    AgentError, Chunk, Episode, LatentMode, Start,
    chain::Chain,
    episode::{Planned, Window},
};
use crate::model::{
    config::ModelConfig,
    diffusion::{ladder::Ladder, process::Process},
    noise::{Noise, Slot},
    trajectory::TokenRef,
};

/// An act in progress. It works on a copy of the episode: dropping it leaves the old one standing. All its memory is taken when it
/// begins; going down allocates nothing.
#[derive(Debug)]
pub struct Descent {
    pub(super) episode: Episode,
    /// s_tau, normalized.
    pub(super) state: Vec<f32>,
    pub(super) ladder: Ladder,
    /// Whether the stored window begins at this time.
    aligned: bool,
    pub(super) started: bool,
    /// `T * D` values.
    pub(super) x: Vec<f32>,
    /// The network's last estimate of the clean window, `T * D` values.
    x0: Vec<f32>,
    /// Positions dropped since that estimate: position `i` of `x` is position `i + dropped` of `x0`.
    dropped: usize,
    /// Row of the ladder.
    pub(super) row: usize,
    pub(super) chain: Chain,
    /// Mean of the prior latent of position 0 at the last cold start.
    anchor: Vec<f32>,
    /// Positions given out, `D` values each; the tokens that latents of later positions look back on, and which do not outlive the act.
    emitted: Vec<f32>,
    predicted_state: Vec<f32>,
    /// Noise of one position.
    eps: Vec<f32>,
    pub(super) evaluations: u32,
    /// Evaluations that it may still take.
    pub(super) allowance: Option<usize>,
    pub(super) degraded: bool,
    pub(super) start: Start,
    failed: bool,
}

/// The tables that a descent walks.
#[derive(Clone, Copy)]
pub(super) struct Walk<'a> {
    pub(super) config: &'a ModelConfig,
    pub(super) process: &'a Process,
}

impl Descent {
    pub(super) fn new(episode: Episode, state: Vec<f32>, ladder: Ladder, aligned: bool, config: &ModelConfig) -> Self {
        let (dim, len, actions) = (config.layout.dim(), config.plan_horizon, episode.options.action_horizon);
        let latent_dim = config.latent.as_ref().map_or(0, |latent| latent.dim);
        Self {
            episode,
            state,
            ladder,
            aligned,
            started: false,
            x: vec![0.0; len * dim],
            x0: vec![0.0; len * dim],
            dropped: 0,
            row: 0,
            chain: Chain::new(len + actions - 1, latent_dim),
            anchor: vec![0.0; latent_dim],
            emitted: Vec::with_capacity(actions * dim),
            predicted_state: vec![0.0; config.layout.state_dim],
            eps: vec![0.0; dim],
            evaluations: 0,
            allowance: None,
            degraded: false,
            start: Start::Cold,
            failed: false,
        }
    }

    /// Whether the chunk is ready to be taken by [`super::Agent::finish`].
    pub fn is_done(&self) -> bool {
        self.failed || self.actions_left() == 0
    }

    /// Network evaluations spent so far.
    pub fn evaluations(&self) -> u32 {
        self.evaluations
    }

    /// Evaluations that its ladder still asks for; of one that has not started those of a warm start, if there may be one.
    pub fn evaluations_left(&self) -> usize {
        let stored = self.stored_window().filter(|_| !self.started).map(|window| window.row);
        let others = self.actions_left().saturating_sub(1) * self.ladder.rung();
        self.ladder.emit().saturating_sub(stored.unwrap_or(self.row)) + others
    }

    /// Resident size in bytes, beside its own: the copy of the episode, and the working memory.
    pub fn size_bytes(&self) -> usize {
        let floats = [&self.state, &self.x, &self.x0, &self.anchor, &self.emitted, &self.predicted_state, &self.eps];
        self.episode.size_bytes()
            + self.chain.size_bytes()
            + floats.iter().map(|values| values.capacity() * size_of::<f32>()).sum::<usize>()
    }

    pub(super) fn has_started(&self) -> bool {
        self.started
    }

    #[cfg(test)]
    pub(super) fn x0(&self) -> &[f32] {
        &self.x0
    }

    fn action_horizon(&self) -> usize {
        self.episode.options.action_horizon
    }

    /// Positions given out.
    pub(super) fn emitted(&self) -> usize {
        self.emitted.len() / self.eps.len().max(1)
    }

    pub(super) fn actions_left(&self) -> usize {
        self.action_horizon() - self.emitted()
    }

    fn noise(&self) -> Noise {
        Noise::new(self.episode.seed)
    }

    /// Environment time of position 0.
    fn time(&self) -> u64 {
        self.episode.time + self.emitted() as u64
    }

    /// Chooses between the stored window and a cold start, and fills the window (the stored one was built for
    /// a predicted state and an older latent; a little surprise is noised away, a great one or a jump of the latent starts anew).
    pub(super) fn start(&mut self, walk: Walk) {
        self.started = true;
        self.start = self.choose_start(walk.config);
        match (self.start, self.episode.window.as_ref().map(|window| window.row)) {
            (Start::Warm, Some(row)) => self.resume(row),
            (Start::Renoised(rungs), Some(row)) => {
                self.resume(row.saturating_sub(rungs as usize * self.ladder.rung()));
                self.renoise(row, walk);
            }
            (Start::Cold, _) | (_, None) => {
                self.row = 0;
                if !self.chain.is_empty() {
                    self.anchor.copy_from_slice(self.chain.get(0).mean);
                }
                (0..walk.config.plan_horizon).for_each(|position| self.draw_position(position));
            }
        }
        self.inpaint();
    }

    /// The window that the act before left for this time, if there is one.
    pub(super) fn stored_window(&self) -> Option<&Window> {
        self.episode.window.as_ref().filter(|_| self.aligned && self.episode.options.streaming)
    }

    /// Distance between the real state and the one that a window was built for.
    pub(super) fn surprise(&self, window: &Window) -> f32 {
        rms(&self.state, &window.predicted_state)
    }

    fn choose_start(&self, config: &ModelConfig) -> Start {
        let Some(window) = self.stored_window() else { return Start::Cold };
        let (restart, distance) = (&config.restart, self.surprise(window));
        let moved = if self.chain.is_empty() { 0.0 } else { norm(self.chain.get(0).mean, &window.anchor) };
        let rungs = (config.plan_horizon / 4).clamp(1, config.plan_horizon.saturating_sub(1).max(1));
        if distance >= restart.cold_distance || moved / config.latent_spread.max(f32::MIN_POSITIVE) > restart.latent_jump {
            Start::Cold
        } else if distance >= restart.renoise_distance && config.plan_horizon > 1 {
            Start::Renoised(rungs.min(window.row / self.ladder.rung()) as u32)
        } else {
            Start::Warm
        }
    }

    /// Takes the stored window, to go on at `row`.
    pub(super) fn resume(&mut self, row: usize) {
        if let Some(window) = self.episode.window.take() {
            self.x.copy_from_slice(&window.x);
            self.anchor.copy_from_slice(&window.anchor);
        }
        self.row = row;
    }

    /// Forward jump of every position from row `from` up to the current one.
    fn renoise(&mut self, from: usize, walk: Walk) {
        let (dim, temperature) = (self.eps.len(), self.episode.options.temperature);
        for position in 0..walk.config.plan_horizon {
            let [from, to] = [from, self.row].map(|row| self.ladder.fine(row, position));
            let (keep, add) = walk.process.renoise(self.ladder.level(from), self.ladder.level(to));
            // The act's own offset joins the level: a position may be noised to the same level again at a later act.
            let (noise, time) = (self.noise(), self.time() + position as u64);
            noise.fill(time, noise_key(to, position), Slot::Renoise, &mut self.eps);
            let add = add * temperature;
            self.x[position * dim..][..dim].iter_mut().zip(&self.eps).for_each(|(x, eps)| *x = keep * *x + add * eps);
        }
    }

    /// A new position of the window, at pure noise.
    fn draw_position(&mut self, position: usize) {
        let (dim, temperature) = (self.eps.len(), self.episode.options.temperature);
        let (noise, time) = (self.noise(), self.time() + position as u64);
        let x = &mut self.x[position * dim..][..dim];
        noise.fill(time, u32::MAX, Slot::Window, x);
        x.iter_mut().for_each(|x| *x *= temperature);
    }

    /// Position 0 of the first action holds the real state; later ones hold what the model imagines.
    pub(super) fn inpaint(&mut self) {
        if self.emitted.is_empty() {
            self.x[..self.state.len()].copy_from_slice(&self.state);
        }
    }

    /// Whether position 0 is to be refined before the next evaluation.
    pub(super) fn wants_refinement(&self) -> bool {
        self.row == self.ladder.ready() && self.episode.options.kappa > 0.0 && !self.chain.is_empty()
    }

    /// Writes the latents of the window, `T * latent_dim` values: means, or draws by the noise of each position's absolute time.
    pub(super) fn write_latents(&self, out: &mut [f32]) {
        for (position, out) in out.chunks_exact_mut(self.chain.dim().max(1)).enumerate() {
            let latent = self.chain.get(position);
            match self.episode.options.latent {
                LatentMode::Mean => out.copy_from_slice(latent.mean),
                LatentMode::Sample => {
                    self.noise().fill(self.time() + position as u64, 0, Slot::Latent, out);
                    let columns = out.iter_mut().zip(latent.mean.iter().zip(latent.log_var));
                    columns.for_each(|(out, (mean, log_var))| *out = mean + (log_var / 2.0).exp() * *out);
                }
            }
        }
    }

    /// Levels of the window, one a position.
    pub(super) fn write_levels(&self, out: &mut [f32]) {
        for (position, out) in out.iter_mut().enumerate() {
            *out = self.ladder.level(self.ladder.fine(self.row, position)) as f32;
        }
    }

    /// Number of tokens before position 0: real ones and, after the first action of a chunk, imagined ones.
    pub(super) fn past(&self) -> usize {
        self.episode.history.len() + self.emitted()
    }

    /// Token `index` of the past, oldest first.
    pub(super) fn past_token(&self, index: usize, walk: Walk) -> TokenRef<'_> {
        match self.episode.history.get(index) {
            Some(token) => token.view(),
            None => {
                let dim = self.eps.len();
                let position = &self.emitted[(index - self.episode.history.len()) * dim..][..dim];
                let (state, action) = position.split_at(walk.config.layout.state_dim);
                TokenRef { state: Some(state), action: Some(action), ..TokenRef::default() }
            }
        }
    }

    /// The current state as a token: what the filter has of x_tau.
    pub(super) fn current_token(&self) -> TokenRef<'_> {
        TokenRef { state: Some(&self.state), ..TokenRef::default() }
    }

    /// Token of a noised position, for the refinement; the reward is never generated.
    pub(super) fn noisy_token(&self, position: usize, walk: Walk) -> TokenRef<'_> {
        let layout = walk.config.layout;
        let (state, action) = self.x[position * layout.dim()..][..layout.dim()].split_at(layout.state_dim);
        let noise = walk.process.sigma(self.ladder.level(self.ladder.fine(self.row, position)));
        TokenRef { state: Some(state), action: Some(action), reward: None, noise }
    }

    /// Takes the network's estimate of the clean window and goes down: one row, or as many as the allowance asks for.
    pub(super) fn step_down(&mut self, x0: &[f32], walk: Walk) {
        self.evaluations += 1;
        if x0.iter().any(|value| !value.is_finite()) {
            self.failed = true;
            return;
        }
        self.x0.copy_from_slice(x0);
        self.dropped = 0;
        self.x0.chunks_mut(walk.config.layout.dim()).for_each(|position| walk.config.clip(position));
        let rows = self.rows_at_once();
        self.degraded |= rows > 1;
        self.allowance = self.allowance.map(|left| left.saturating_sub(1).max(1));
        self.jump_rows(rows, walk);
        self.inpaint();
        if self.row == self.ladder.emit() {
            self.emit(walk);
        }
    }

    /// Reverse jump of every position, by the last estimate, to its level so many rows below.
    pub(super) fn jump_rows(&mut self, rows: usize, walk: Walk) {
        (0..walk.config.plan_horizon).for_each(|position| self.jump(position, rows, walk));
        self.row += rows;
    }

    fn jump(&mut self, position: usize, rows: usize, walk: Walk) {
        let levels = [self.row, self.row + rows].map(|row| self.ladder.fine(row, position));
        let [from, to] = levels.map(|fine| self.ladder.level(fine));
        if from == to {
            return;
        }
        let (dim, options) = (self.eps.len(), &self.episode.options);
        let jump = walk.process.jump(from, to, options.eta);
        let scale = jump.noise * options.temperature;
        if jump.noise > 0.0 {
            // The position joins the level, as in `renoise`: a later act may walk the same levels again.
            let (noise, time) = (self.noise(), self.time() + position as u64);
            noise.fill(time, noise_key(levels[1], position), Slot::Jump, &mut self.eps);
        } else {
            self.eps.fill(0.0);
        }
        let estimate = (position + self.dropped).min(walk.config.plan_horizon - 1);
        let columns = self.x[position * dim..][..dim].iter_mut().zip(&self.x0[estimate * dim..][..dim]);
        for ((x, x0), noise) in columns.zip(&self.eps) {
            *x = jump.x0 * x0 + jump.eps * walk.process.eps(from, *x, *x0) + scale * noise;
        }
    }

    /// Position 0 is clean: give its action out, drop it, and let a fresh position in at the far end.
    pub(super) fn emit(&mut self, walk: Walk) {
        let (dim, state_dim, last) = (self.eps.len(), walk.config.layout.state_dim, walk.config.plan_horizon - 1);
        let begin = self.emitted.len();
        self.emitted.extend_from_slice(&self.x[..dim]);
        // A clean position is within bounds already.
        walk.config.clip(&mut self.emitted[begin..]);
        // What comes next: the estimate of position 1, or what stands there if nothing was estimated in this act.
        let next = if self.evaluations > 0 { &self.x0[self.dropped * dim..] } else { &self.x };
        self.predicted_state.copy_from_slice(next.get(dim..dim + state_dim).unwrap_or(&self.x[..state_dim]));
        self.dropped += 1;
        if !self.chain.is_empty() {
            self.chain.advance();
        }
        self.x.copy_within(dim.., 0);
        self.draw_position(last);
        self.row = self.ladder.ready();
    }

    pub(super) fn finish(self, config: &ModelConfig) -> Result<(Episode, Chunk), AgentError> {
        if self.failed {
            return Err(AgentError::NonFinite);
        }
        let (normalizer, layout) = (&config.normalizer, config.layout);
        let actions: Vec<Vec<f32>> = self.emitted.chunks(layout.dim()).map(|position| position[layout.state_dim..].to_vec()).collect();
        // Behind the positions given out since the last estimate; without any, the window itself, but for its last, fresh position.
        let (dim, len) = (layout.dim(), self.x.len());
        let planned = if self.evaluations > 0 { &self.x0[self.dropped * dim..] } else { &self.x[..len - dim] };
        let planned_states = planned.chunks(dim).map(|row| normalizer.state.denormalize(&row[..layout.state_dim]));
        // An act that never asked the network has no latent of its own.
        let inferred = self.chain.of_first_step();
        let latent = if self.evaluations == 0 { self.episode.latent.clone().unwrap_or(inferred) } else { inferred };
        let chunk = Chunk {
            actions: actions.iter().map(|action| normalizer.action.denormalize(action)).collect(),
            planned_states: planned_states.collect(),
            latent_mean: latent.0.clone(),
            latent_log_var: latent.1.clone(),
            predicted_state: normalizer.state.denormalize(&self.predicted_state),
            evaluations: self.evaluations,
            start: self.start,
            degraded: self.degraded,
        };
        let mut episode = self.episode;
        let window = Window { x: self.x, row: self.row, predicted_state: self.predicted_state, anchor: self.anchor };
        episode.window = episode.options.streaming.then_some(window);
        episode.planned = Some(Planned { state: self.state, actions });
        episode.latent = (!latent.0.is_empty()).then_some(latent);
        Ok((episode, chunk))
    }
}

/// Noise key of a fine level (20 bits) at a position (10 bits), a number of its own for each pair; the bounds are those of
/// [`ModelConfig::check`].
fn noise_key(level: usize, position: usize) -> u32 {
    (level & 0xFFFF | position << 16 | (level >> 16) << 26) as u32
}

fn norm(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

fn rms(a: &[f32], b: &[f32]) -> f32 {
    norm(a, b) / (a.len().max(1) as f32).sqrt()
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
