//! An act in progress: a small program that asks networks, one question after the other, until its chunk is there (algorithm 3 of the
//! paper). It works on a copy of the episode: dropping it leaves the old one standing.

use super::{
    AgentError, Chunk, Episode, Start,
    chain::Chain,
    episode::Planned,
    restart::{Stored, choose_start},
};
use crate::model::{
    config::ModelConfig,
    diffusion::{
        descent::{Descent, Sampling, Walk},
        schedule::Table,
    },
    latent::Evidence,
    noise::{Noise, Slot},
    options::LatentMode,
    trajectory::TokenRef,
};

/// What an act asks of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// The latents of its window, from what was really seen; then it starts.
    Filter,
    /// The latent of position 0 anew, with the noised positions 0 and 1 (zig-zag).
    Refine,
    /// The clean window.
    Denoise,
}

impl Ask {
    /// In this order they are answered in one tick: an act that has its latents can be denoised at once.
    pub const ORDER: [Self; 3] = [Self::Filter, Self::Refine, Self::Denoise];
}

/// An act in progress. All its memory is taken when it begins; its way down allocates nothing.
#[derive(Debug)]
pub struct Act {
    episode: Episode,
    /// Whether the stored window begins at this time.
    aligned: bool,
    started: bool,
    start: Start,
    latents: Chain,
    /// Belief of position 0 at the last cold start: a chain of one.
    anchor: Chain,
    descent: Descent,
}

impl Act {
    /// An act on `episode`, which has taken note of what was executed; `state` is s_tau, normalized.
    pub(super) fn new(episode: Episode, state: Vec<f32>, table: Table, aligned: bool, config: &ModelConfig) -> Self {
        let (options, plan, dim) = (episode.options(), &config.method.plan, config.method.latent.dim());
        let sampling = Sampling {
            table,
            actions: options.action_horizon,
            eta: options.eta,
            temperature: options.temperature,
            noise: Noise::new(episode.seed()),
            time: episode.time(),
        };
        Self {
            aligned,
            started: false,
            start: Start::Cold,
            latents: Chain::new(plan.horizon + options.action_horizon - 1, dim),
            anchor: Chain::new(1, dim),
            descent: Descent::new(sampling, state, [plan.horizon, config.layout.dim()]),
            episode,
        }
    }

    /// Whether it asks this of the networks now.
    pub(super) fn asks(&self, ask: Ask) -> bool {
        match ask {
            Ask::Filter => !self.started,
            Ask::Refine => self.started && self.descent.is_ready() && self.episode.options().kappa > 0.0 && !self.latents.is_empty(),
            Ask::Denoise => self.started && !self.is_done(),
        }
    }

    /// Whether the chunk is ready to be taken by [`super::Agent::finish`].
    pub fn is_done(&self) -> bool {
        self.descent.is_done()
    }

    /// Network evaluations spent so far.
    pub fn evaluations(&self) -> u32 {
        self.descent.evaluations()
    }

    /// Windows that it holds, each a row of every network evaluation it takes part in: what an engine bounds. One window an act; candidates
    /// and a second, unconditioned window (classifier-free guidance) would be more.
    pub fn rows(&self) -> usize {
        1
    }

    /// Evaluations that it still asks for; of one that has not started those of a warm start, if there may be one.
    pub fn evaluations_left(&self) -> usize {
        match self.stored().filter(|_| !self.started) {
            Some(stored) => self.descent.evaluations_left_from(stored.row()),
            None => self.descent.evaluations_left(),
        }
    }

    /// See [`Descent::allow`].
    pub fn allow(&mut self, evaluations: Option<usize>) {
        self.descent.allow(evaluations);
    }

    /// Resident size in bytes, beside its own: the copy of the episode, and the working memory.
    pub fn size_bytes(&self) -> usize {
        self.episode.size_bytes() + self.latents.size_bytes() + self.descent.size_bytes() + self.anchor.size_bytes()
    }

    /// Chooses between the stored window and a cold start, and fills the window.
    pub(super) fn start(&mut self, config: &ModelConfig, walk: Walk) {
        self.started = true;
        let belief = self.latents.get(0);
        let rung = self.descent.rung();
        self.start = self.stored().map_or(Start::Cold, |stored| choose_start(stored, self.descent.known(), belief, rung, config));
        match (self.start, self.episode.take_stored()) {
            (Start::Cold, _) | (_, None) => {
                self.anchor.set(0, belief);
                self.descent.begin_cold(walk);
            }
            (Start::Warm, Some(stored)) => self.resume(&stored, 0, walk),
            (Start::Renoised(rungs), Some(stored)) => self.resume(&stored, rungs as usize * rung, walk),
        }
    }

    fn resume(&mut self, stored: &Stored, rows: usize, walk: Walk) {
        self.anchor.set(0, stored.anchor());
        self.descent.begin_with(stored.window(), rows, walk);
    }

    /// The window that the act before left for this time, if there is one.
    fn stored(&self) -> Option<&Stored> {
        self.episode.stored().filter(|_| self.aligned && self.episode.options().streaming)
    }

    /// See [`super::Agent::cut_short`].
    pub(super) fn cut_short(&mut self, config: &ModelConfig, walk: Walk) -> bool {
        if self.started {
            if self.descent.evaluations() == 0 {
                return false;
            }
            self.descent.cut_short(walk);
            return true;
        }
        let near = |stored: &&Stored| stored.surprise(self.descent.known()) < config.defaults.restart.cold_distance;
        if self.stored().filter(near).is_none() {
            return false;
        }
        let Some(stored) = self.episode.take_stored() else { return false };
        (self.started, self.start) = (true, Start::Warm);
        self.anchor.set(0, stored.anchor());
        self.descent.give_as_it_is(stored.window(), walk);
        true
    }

    /// The latents of the window, the first of them that of its position 0.
    pub(super) fn latents(&self) -> &Chain {
        &self.latents
    }

    /// See [`Self::latents`].
    pub(super) fn latents_mut(&mut self) -> &mut Chain {
        &mut self.latents
    }

    /// State of the GRU that runs on over the episode.
    pub(super) fn memory(&self) -> &[f32] {
        self.episode.memory()
    }

    /// What it has to read before this act can be answered, the oldest token first.
    pub(super) fn unread(&self) -> Option<TokenRef<'_>> {
        self.episode.unread()
    }

    /// The token before [`Self::unread`].
    pub(super) fn last_read(&self) -> Option<TokenRef<'_>> {
        self.episode.last_read()
    }

    /// See [`Episode::remember`].
    pub(super) fn remember(&mut self, state: &[f32], keep: usize) {
        self.episode.remember(state, keep);
    }

    /// Trust region of the refinement, nats.
    pub(super) fn kappa(&self) -> f32 {
        self.episode.options().kappa
    }

    /// The window on its way.
    pub(super) fn descent(&self) -> &Descent {
        &self.descent
    }

    #[cfg(test)]
    pub(super) fn descent_mut(&mut self) -> &mut Descent {
        &mut self.descent
    }

    /// Writes the latents of the window, `T * latent_dim` values: means, or draws by the noise of each position's absolute time.
    pub(super) fn write_latents(&self, out: &mut [f32]) {
        for (position, out) in out.chunks_exact_mut(self.latents.dim().max(1)).enumerate() {
            let latent = self.latents.get(position);
            match self.episode.options().latent {
                LatentMode::Mean => out.copy_from_slice(latent.mean),
                LatentMode::Sample => {
                    let (noise, time) = (Noise::new(self.episode.seed()), self.descent.time() + position as u64);
                    noise.fill(time, 0, Slot::Latent, out);
                    let columns = out.iter_mut().zip(latent.mean.iter().zip(latent.log_var));
                    columns.for_each(|(out, (mean, log_var))| *out = mean + (log_var / 2.0).exp() * *out);
                }
            }
        }
    }

    /// The past of position 0, the last token first: imagined ones, after the first action of a chunk, and real ones behind them.
    pub(super) fn past(&self, back: usize, walk: Walk) -> Option<TokenRef<'_>> {
        let imagined = self.descent.given_len();
        match back.checked_sub(imagined) {
            Some(back) => self.episode.past(back),
            None => Some(window_token(self.descent.given(imagined - 1 - back), walk)),
        }
    }

    /// Token `position` from the current one on: the real state, or what the window has there. Of a future that has not come an act has
    /// nothing.
    pub(super) fn ahead(&self, position: usize, evidence: Evidence, walk: Walk) -> TokenRef<'_> {
        match evidence {
            Evidence::Filter => TokenRef { state: Some(self.descent.known()), ..TokenRef::default() },
            Evidence::Refinement => {
                TokenRef { noise: self.descent.sigma(position, walk), ..window_token(self.descent.position(position), walk) }
            }
            Evidence::SuccessorState | Evidence::Successor => TokenRef::default(),
        }
    }

    /// Takes the network's estimate of the clean window.
    pub(super) fn step_down(&mut self, x0: &[f32], walk: Walk) {
        let given = self.descent.given_len();
        self.descent.step_down(x0, walk);
        self.latents.advance(self.descent.given_len() - given);
    }

    pub(super) fn finish(self, config: &ModelConfig, walk: Walk) -> Result<(Episode, Chunk), AgentError> {
        if self.descent.has_failed() {
            return Err(AgentError::NonFinite);
        }
        let (normalizer, descent) = (&config.units.normalizer, &self.descent);
        let action = |position| descent.given(position)[walk.columns.action.clone()].to_vec();
        let actions: Vec<Vec<f32>> = (0..descent.given_len()).map(action).collect();
        let states = descent.planned().chunks(walk.columns.width()).map(|position| &position[walk.columns.state.clone()]);
        // An act that never asked the network has no latent of its own.
        let latent = match self.episode.latent().filter(|_| descent.evaluations() == 0) {
            Some((mean, log_var)) => (mean.to_vec(), log_var.to_vec()),
            None => self.latents.of_first_step(),
        };
        let chunk = Chunk {
            actions: actions.iter().map(|action| normalizer.action.denormalize(action)).collect(),
            planned_states: states.map(|state| normalizer.state.denormalize(state)).collect(),
            latent_mean: latent.0.clone(),
            latent_log_var: latent.1.clone(),
            predicted_state: normalizer.state.denormalize(descent.predicted_state()),
            evaluations: descent.evaluations(),
            start: self.start,
            degraded: descent.is_degraded(),
        };
        let planned = Planned::new(descent.known().to_vec(), actions);
        let stored = Stored::new(self.descent.into_window(), self.anchor);
        Ok((self.episode.after(planned, stored, latent), chunk))
    }
}

/// A position of a window as a token.
fn window_token<'a>(position: &'a [f32], walk: Walk) -> TokenRef<'a> {
    let columns = walk.columns;
    TokenRef { state: Some(&position[columns.state.clone()]), action: Some(&position[columns.action.clone()]), ..TokenRef::default() }
}
