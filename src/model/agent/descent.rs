//! An act in progress: a window on its way down the ladder, one row an evaluation (sections 4.3 and 4.4 of the paper).

use super::{
    AgentError, Chunk, Episode, LatentMode, Start,
    episode::{Planned, Window},
};
use crate::model::{
    config::ModelConfig,
    diffusion::{ladder::Ladder, process::Process},
    latent::PlainGaussian,
    noise::{Noise, Slot},
    trajectory::Token,
};
use std::ops::Range;

/// An act in progress. It works on a copy of the episode: dropping it leaves the old one standing.
#[derive(Debug)]
pub struct Descent {
    pub(super) episode: Episode,
    /// s_tau, normalized.
    pub(super) state: Vec<f32>,
    /// Whether the stored window begins at this time.
    aligned: bool,
    /// `T * D` values; empty until the window has started.
    pub(super) x: Vec<f32>,
    /// The network's last estimate of the clean window.
    x0: Vec<f32>,
    /// Row of the ladder.
    pub(super) row: usize,
    /// Distribution of the latent at each position, `T + action_horizon - 1` at first; empty for a model without latents.
    pub(super) chain: Vec<PlainGaussian>,
    /// Mean of the prior latent of position 0 at the last cold start.
    anchor: Vec<f32>,
    /// Real tokens and, after the first action of a chunk, imagined ones, which do not outlive the act.
    pub(super) block: Vec<Token>,
    actions: Vec<Vec<f32>>,
    predicted_state: Vec<f32>,
    first_latent: Option<PlainGaussian>,
    evaluations: u32,
    start: Start,
    failed: bool,
}

/// The tables that a descent walks; one for all rows of a forward with the same sub-steps.
pub(super) struct Walk<'a> {
    pub(super) config: &'a ModelConfig,
    pub(super) process: &'a Process,
    pub(super) ladder: Ladder,
}

impl Descent {
    pub(super) fn new(episode: Episode, state: Vec<f32>, aligned: bool) -> Self {
        Self {
            block: episode.history.iter().cloned().collect(),
            episode,
            state,
            aligned,
            x: Vec::new(),
            x0: Vec::new(),
            row: 0,
            chain: Vec::new(),
            anchor: Vec::new(),
            actions: Vec::new(),
            predicted_state: Vec::new(),
            first_latent: None,
            evaluations: 0,
            start: Start::Cold,
            failed: false,
        }
    }

    /// Whether the chunk is ready to be taken by [`super::Agent::finish`].
    pub fn is_done(&self) -> bool {
        self.failed || self.actions.len() == self.episode.options.action_horizon
    }

    /// Network evaluations spent so far.
    pub fn evaluations(&self) -> u32 {
        self.evaluations
    }

    pub(super) fn has_started(&self) -> bool {
        !self.x.is_empty()
    }

    fn noise(&self) -> Noise {
        Noise::new(self.episode.seed)
    }

    /// Environment time of position 0.
    fn time(&self) -> u64 {
        self.episode.time + self.actions.len() as u64
    }

    /// Chooses between the stored window and a cold start, and fills the window (the stored one was built for
    /// a predicted state and an older latent; a little surprise is noised away, a great one or a jump of the latent starts anew).
    pub(super) fn start(&mut self, walk: &Walk) {
        let stored = self.episode.window.take().filter(|_| self.aligned && self.episode.options.streaming);
        self.start = stored.as_ref().map_or(Start::Cold, |window| self.choose_start(window, walk.config));
        match (stored, self.start) {
            (Some(window), Start::Warm) => self.resume(window, walk.ladder.ready()),
            (Some(window), Start::Renoised(rungs)) => {
                let row = walk.ladder.ready() - rungs as usize * self.episode.options.sub_steps;
                self.resume(window, row);
                self.renoise(walk);
            }
            (None, _) | (_, Start::Cold) => {
                self.row = 0;
                self.anchor = self.chain.first().map_or_else(Vec::new, |latent| latent.mean.clone());
                self.x = Vec::new();
                (0..walk.config.plan_horizon).for_each(|position| self.append_noise(position, walk.config.layout.dim()));
            }
        }
        self.inpaint();
    }

    fn choose_start(&self, window: &Window, config: &ModelConfig) -> Start {
        let restart = &config.restart;
        let distance = rms(&self.state, &window.predicted_state);
        let moved =
            self.chain.first().map_or(0.0, |latent| norm(&latent.mean, &window.anchor) / config.latent_spread.max(f32::MIN_POSITIVE));
        let rungs = (config.plan_horizon / 4).clamp(1, config.plan_horizon.saturating_sub(1).max(1));
        if distance >= restart.cold_distance || moved > restart.latent_jump {
            Start::Cold
        } else if distance >= restart.renoise_distance && config.plan_horizon > 1 {
            Start::Renoised(rungs as u32)
        } else {
            Start::Warm
        }
    }

    fn resume(&mut self, window: Window, row: usize) {
        (self.x, self.anchor, self.row) = (window.x, window.anchor, row);
    }

    /// Forward jump of every position from READY up to the current row.
    fn renoise(&mut self, walk: &Walk) {
        let (dim, ready) = (walk.config.layout.dim(), walk.ladder.ready());
        for position in 0..walk.config.plan_horizon {
            let (from, to) = (walk.ladder.fine(ready, position), walk.ladder.fine(self.row, position));
            let (keep, add) = walk.process.renoise(walk.ladder.level(from), walk.ladder.level(to));
            let mut eps = vec![0.0; dim];
            // The act's own offset joins the level: a position may be noised to the same level again at a later act.
            self.noise().fill(self.time() + position as u64, (to | position << 16) as u32, Slot::Renoise, &mut eps);
            let add = add * self.episode.options.temperature;
            self.x[position * dim..][..dim].iter_mut().zip(eps).for_each(|(x, eps)| *x = keep * *x + add * eps);
        }
    }

    fn append_noise(&mut self, position: usize, dim: usize) {
        let mut eps = vec![0.0; dim];
        self.noise().fill(self.time() + position as u64, u32::MAX, Slot::Window, &mut eps);
        let temperature = self.episode.options.temperature;
        self.x.extend(eps.into_iter().map(|eps| temperature * eps));
    }

    /// Position 0 of the first action holds the real state; later ones hold what the model imagines.
    fn inpaint(&mut self) {
        if self.actions.is_empty() {
            self.x[..self.state.len()].copy_from_slice(&self.state);
        }
    }

    /// Takes the distribution of every latent from position 0 on.
    pub(super) fn set_chain(&mut self, chain: Vec<PlainGaussian>) {
        self.chain = chain;
    }

    /// Whether position 0 is to be refined before the next evaluation.
    pub(super) fn wants_refinement(&self, ladder: &Ladder) -> bool {
        self.row == ladder.ready() && self.episode.options.kappa > 0.0 && !self.chain.is_empty()
    }

    /// Latents of the window, `T * latent_dim` values: means, or draws by the noise of each position's absolute time.
    pub(super) fn latents(&self, horizon: usize) -> Vec<f32> {
        let positions = self.chain.iter().take(horizon).enumerate();
        let draw = |(position, latent): (usize, &PlainGaussian)| match self.episode.options.latent {
            LatentMode::Mean => latent.mean.clone(),
            LatentMode::Sample => {
                let mut eps = vec![0.0; latent.mean.len()];
                self.noise().fill(self.time() + position as u64, 0, Slot::Latent, &mut eps);
                latent.mean.iter().zip(&latent.log_var).zip(eps).map(|((mean, log_var), eps)| mean + (log_var / 2.0).exp() * eps).collect()
            }
        };
        positions.flat_map(draw).collect()
    }

    /// Token of a noised position, for the refinement; the reward is never generated.
    pub(super) fn noisy_token(&self, position: usize, walk: &Walk) -> Token {
        let layout = walk.config.layout;
        let x = &self.x[position * layout.dim()..][..layout.dim()];
        let level = walk.ladder.level(walk.ladder.fine(self.row, position));
        let (state, action) = x.split_at(layout.state_dim);
        Token { state: Some(state.to_vec()), action: Some(action.to_vec()), reward: None, noise: walk.process.sigma(level) }
    }

    /// Takes the network's estimate of the clean window and goes one row down.
    pub(super) fn step_down(&mut self, mut x0: Vec<f32>, walk: &Walk) {
        self.evaluations += 1;
        if x0.iter().any(|value| !value.is_finite()) {
            self.failed = true;
            return;
        }
        let dim = walk.config.layout.dim();
        x0.chunks_mut(dim).for_each(|position| walk.config.clip(position));
        for position in 0..walk.config.plan_horizon {
            self.jump(position, &x0[position * dim..][..dim], walk);
        }
        self.x0 = x0;
        self.row += 1;
        self.inpaint();
        if self.row == walk.ladder.emit() {
            self.emit(walk);
        }
    }

    /// Reverse jump of one position to its level in the next row.
    fn jump(&mut self, position: usize, x0: &[f32], walk: &Walk) {
        let levels = [self.row, self.row + 1].map(|row| walk.ladder.fine(row, position));
        let [from, to] = levels.map(|fine| walk.ladder.level(fine));
        if from == to {
            return;
        }
        let options = &self.episode.options;
        let jump = walk.process.jump(from, to, options.eta);
        let mut noise = vec![0.0; x0.len()];
        if jump.noise > 0.0 {
            // The position joins the level, as in `renoise`: a later act may walk the same levels again.
            self.noise().fill(self.time() + position as u64, (levels[1] | position << 16) as u32, Slot::Jump, &mut noise);
        }
        let scale = jump.noise * options.temperature;
        let x = &mut self.x[position * x0.len()..][..x0.len()];
        for ((x, x0), noise) in x.iter_mut().zip(x0).zip(noise) {
            *x = jump.x0 * x0 + jump.eps * walk.process.eps(from, *x, *x0) + scale * noise;
        }
    }

    /// Position 0 is clean: give its action out, drop it, and let a fresh position in at the far end.
    fn emit(&mut self, walk: &Walk) {
        let layout = walk.config.layout;
        let rest = self.x.split_off(layout.dim());
        let emitted = std::mem::replace(&mut self.x, rest);
        let (state, action) = emitted.split_at(layout.state_dim);
        self.predicted_state = self.x0.get(Self::next_state(walk.config)).unwrap_or(state).to_vec();
        if self.first_latent.is_none() {
            self.first_latent = self.chain.first().cloned();
        }
        if !self.chain.is_empty() {
            self.chain.remove(0);
        }
        self.block.push(Token { state: Some(state.to_vec()), action: Some(action.to_vec()), reward: None, noise: 0.0 });
        self.actions.push(action.to_vec());
        self.append_noise(walk.config.plan_horizon - 1, layout.dim());
        self.row = walk.ladder.ready();
    }

    fn next_state(config: &ModelConfig) -> Range<usize> {
        config.layout.dim()..config.layout.dim() + config.layout.state_dim
    }

    pub(super) fn finish(self, config: &ModelConfig) -> Result<(Episode, Chunk), AgentError> {
        if self.failed {
            return Err(AgentError::NonFinite);
        }
        let (normalizer, dim) = (&config.normalizer, config.layout.dim());
        let latent = self.first_latent.clone().unwrap_or_default();
        let planned_states = self.x0.chunks(dim).map(|row| normalizer.state.denormalize(&row[..config.layout.state_dim]));
        let chunk = Chunk {
            actions: self.actions.iter().map(|action| normalizer.action.denormalize(action)).collect(),
            planned_states: planned_states.collect(),
            latent_mean: latent.mean,
            latent_log_var: latent.log_var,
            predicted_state: normalizer.state.denormalize(&self.predicted_state),
            evaluations: self.evaluations,
            start: self.start,
        };
        let streaming = self.episode.options.streaming;
        let window = Window { x: self.x, predicted_state: self.predicted_state, anchor: self.anchor };
        let mut episode = self.episode;
        episode.planned = Some(Planned { state: self.state, actions: self.actions });
        episode.window = streaming.then_some(window);
        episode.latent = self.first_latent;
        Ok((episode, chunk))
    }
}

fn norm(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

fn rms(a: &[f32], b: &[f32]) -> f32 {
    norm(a, b) / (a.len().max(1) as f32).sqrt()
}
