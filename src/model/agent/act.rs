//! An act in progress: a small program that asks networks, one question after the other, until its chunk is there (algorithm 3 of the
//! paper). It works on a copy of the episode: dropping it leaves the old one standing.

use super::{
    AgentError, Ask, Chunk, Episode, Haste, Start,
    candidate::Candidate,
    chain::Chain,
    choice::Choice,
    episode::Planned,
    pace::Pace,
    restart::{Stored, choose_start},
    types::{Known, Place},
};
use crate::model::{
    columns::Columns,
    config::ModelConfig,
    diffusion::{
        descent::{Descent, Sampling, Walk},
        schedule::Table,
    },
    latent::{Evidence, GaussianRef},
    noise::{Noise, Slot},
    options::{LatentMode, SamplerOptions},
    trajectory::TokenRef,
};

/// An act in progress. All its memory is taken when it begins, and bounded where acts wait; its way down allocates nothing.
#[derive(Debug)]
pub struct Act {
    episode: Episode,
    /// See [`Known::aligned`].
    aligned: bool,
    started: bool,
    /// Whether the latents behind position 0 are known.
    rolled_out: bool,
    start: Start,
    /// Belief of position 0 at the last cold start: a chain of one.
    anchor: Chain,
    told: Vec<f32>,
    truth: Vec<f32>,
    candidates: Vec<Candidate>,
    choice: Choice,
    pace: Pace,
}

impl Act {
    /// An act on `episode`, which has taken note of what was executed.
    pub(super) fn new(episode: Episode, known: Known, table: Table, config: &ModelConfig) -> Self {
        let (options, method) = (episode.options(), &config.method);
        let columns = Columns::new(method.plan.diffused, config.layout);
        let latents = Chain::new(method.plan.horizon + options.action_horizon - 1, method.latent.dim());
        let sampling = |index| Sampling {
            table,
            actions: options.action_horizon,
            eta: options.eta,
            temperature: options.temperature,
            noise: Noise::new(episode.seed()).of_candidate(index),
            time: episode.time(),
            at_once: (options.picard_window, options.picard_tolerance),
        };
        let candidate = |index| {
            Candidate::new(
                Descent::new(sampling(index), known.state.clone(), method.plan.horizon, &columns),
                latents.clone(),
                [options.action_horizon, config.layout.action_dim],
            )
        };
        let Known { told, truth, aligned, .. } = &known;
        // Of a skill under way there is nothing to choose.
        let held = episode.code().is_some();
        let candidates = if held { 1 } else { options.candidates };
        Self {
            aligned: *aligned,
            started: false,
            rolled_out: latents.len() <= 1,
            start: Start::Cold,
            anchor: Chain::new(1, method.latent.dim()),
            told: told.clone(),
            truth: truth.clone(),
            candidates: (0..candidates).map(candidate).collect(),
            choice: Choice::new(held || options.candidates == 1 && options.guidance_scale == 0.0),
            pace: Pace::new(),
            episode,
        }
    }

    /// Whether it asks this of the networks now, of itself or of one of its windows.
    pub(super) fn asks(&self, ask: Ask) -> bool {
        match ask {
            Ask::Filter => !self.started,
            Ask::RollOut => self.started && !self.rolled_out && !self.asks(Ask::Refine),
            Ask::Choose => self.started && !self.choice.is_made() && self.candidates.iter().all(Candidate::is_done) && !self.has_failed(),
            Ask::Refine | Ask::Denoise | Ask::Decode => {
                self.started && self.candidates.iter().any(|window| window.asks(ask, self.options()))
            }
        }
    }

    /// Whether the chunk is ready to be taken by [`super::Agent::finish`].
    pub fn is_done(&self) -> bool {
        self.has_failed() || self.choice.is_made() && self.candidates.iter().all(Candidate::is_done)
    }

    fn has_failed(&self) -> bool {
        self.candidates.iter().any(|window| window.descent().has_failed())
    }

    /// Network evaluations spent so far, of all its windows.
    pub fn evaluations(&self) -> u32 {
        let each = 1 + u32::from(self.options().doubts());
        each * self.candidates.iter().map(|window| window.descent().evaluations()).sum::<u32>()
    }

    /// Forwards that it took part in so far.
    fn passes(&self) -> u32 {
        self.candidates.iter().map(|window| window.descent().passes()).max().unwrap_or(0)
    }

    /// Rows that it has in the next network evaluation: what an engine bounds. One window an act; candidates, rows of the table that are
    /// evaluated at once, and each of them without what is told (classifier-free guidance) are more.
    pub fn rows(&self) -> usize {
        let slots = |window: &Candidate| if window.descent().is_done() { 0 } else { window.descent().slots() };
        let windows: usize = self.candidates.iter().map(slots).sum();
        windows.max(1) * (1 + usize::from(self.options().doubts()))
    }

    /// Forwards that it still asks for; of one that has not started those of a warm start, if there may be one.
    pub fn evaluations_left(&self) -> usize {
        if self.episode.code().is_some() {
            return 0;
        }
        let left = |window: &Candidate| match self.stored().filter(|_| !self.started) {
            Some(stored) => window.descent().rows_left(stored.row()),
            None => window.descent().evaluations_left(),
        };
        self.candidates.iter().map(left).max().unwrap_or(0)
    }

    /// See [`Descent::allow`].
    pub fn allow(&mut self, evaluations: Option<usize>) {
        self.candidates.iter_mut().for_each(|window| window.allow(evaluations));
    }

    /// To be hurried as an act was that is done again, whatever the clock says and [`Self::allow`] is told: same episode, same observation, same
    /// haste, same answer.
    pub fn repeat(&mut self, haste: Haste) {
        self.pace.repeat(haste);
    }

    /// What its deadline made of it; asked once, when it is done.
    pub fn take_haste(&mut self) -> Haste {
        self.pace.take_haste()
    }

    /// The pace of the forward that comes: what a deadline makes of it is noted, or done as it was noted.
    pub(super) fn keep_pace(&mut self) {
        let left = self.candidates.iter().find(|window| !window.descent().is_done()).and_then(|window| window.descent().allowance());
        let hurries = self.candidates.iter().any(|window| window.descent().is_hurried());
        let bound = left.filter(|_| hurries).map(|left| u32::try_from(left).unwrap_or(u32::MAX));
        let kept = self.pace.settle(self.passes(), bound);
        if kept != bound {
            self.allow(kept.map(|left| left as usize));
        }
    }

    /// Gives out what it has, if an act did so here that it is to repeat.
    pub(super) fn cut_again(&mut self, config: &ModelConfig, walk: Walk) {
        if self.pace.is_to_be_cut(self.passes()) {
            self.cut_short(config, walk);
        }
    }

    /// Resident size in bytes, beside its own: the copy of the episode, and the working memory.
    pub fn size_bytes(&self) -> usize {
        let floats = (self.told.capacity() + self.truth.capacity()) * size_of::<f32>();
        let windows =
            self.candidates.capacity() * size_of::<Candidate>() + self.candidates.iter().map(Candidate::size_bytes).sum::<usize>();
        self.episode.size_bytes() + floats + windows + self.anchor.size_bytes() + self.pace.size_bytes()
    }

    /// Turns what it knows of the present into NaN, as a broken sum within a layer would: a drill, which ends in [`AgentError::NonFinite`].
    pub fn spoil(&mut self) {
        self.candidates.iter_mut().for_each(Candidate::spoil);
    }

    /// How its chunk is sampled.
    pub(super) fn options(&self) -> &SamplerOptions {
        self.episode.options()
    }

    /// Its windows.
    pub(super) fn candidates(&self) -> &[Candidate] {
        &self.candidates
    }

    /// The windows that ask this.
    pub(super) fn asking_mut(&mut self, ask: Ask) -> impl Iterator<Item = &mut Candidate> {
        let Self { candidates, episode, .. } = self;
        candidates.iter_mut().filter(move |window| window.asks(ask, episode.options()))
    }

    #[cfg(test)]
    pub(super) fn first_mut(&mut self) -> &mut Candidate {
        &mut self.candidates[0]
    }

    /// The window of one that has a single one, and of all before they go ways of their own.
    fn first(&self) -> &Candidate {
        &self.candidates[0]
    }

    /// The latent at a position, of all its windows: they have not begun.
    pub(super) fn set_latent(&mut self, position: usize, latent: GaussianRef) {
        self.candidates.iter_mut().for_each(|window| window.set_latent(position, latent));
    }

    /// The latents of all positions have been set.
    pub(super) fn set_rolled_out(&mut self) {
        self.rolled_out = true;
    }

    /// Latents of an oracle: what it was told, as sure as a latent can be.
    pub(super) fn set_truth(&mut self) {
        let Self { candidates, truth, .. } = self;
        candidates.iter_mut().for_each(|window| window.set_truth(truth));
        self.rolled_out = true;
    }

    /// What is told of what is wanted, and 1; zeros where nothing is, or the window is to be denoised without it.
    pub(super) fn write_told(&self, told: bool, out: &mut [f32]) {
        if told {
            out.copy_from_slice(&self.told);
        }
    }

    /// Chooses between the stored window and a cold start, and fills the windows.
    pub(super) fn start(&mut self, config: &ModelConfig, walk: Walk) {
        self.started = true;
        if let Some(code) = self.episode.code() {
            self.start = Start::Warm;
            self.candidates.iter_mut().for_each(|window| window.hold(code));
            return;
        }
        let (belief, rung) = (self.first().latents().get(0), self.first().descent().rung());
        let known = self.first().descent().known();
        self.start = self.stored().map_or(Start::Cold, |stored| choose_start(stored, known, belief, rung, config));
        match (self.start, self.episode.take_stored()) {
            (Start::Cold, _) | (_, None) => {
                self.anchor.set(0, self.candidates[0].latents().get(0));
                self.candidates.iter_mut().for_each(|window| window.begin_cold(walk));
            }
            (Start::Warm, Some(stored)) => self.resume(&stored, 0, walk),
            (Start::Renoised(rungs), Some(stored)) => self.resume(&stored, rungs as usize * rung, walk),
        }
    }

    fn resume(&mut self, stored: &Stored, rows: usize, walk: Walk) {
        self.anchor.set(0, stored.anchor());
        self.candidates.iter_mut().for_each(|window| window.begin_with(stored.window(), rows, walk));
    }

    /// The window that the act before left for this time, if there is one.
    fn stored(&self) -> Option<&Stored> {
        self.episode.stored().filter(|_| self.aligned && self.options().streaming)
    }

    /// See [`super::Agent::cut_short`].
    pub(super) fn cut_short(&mut self, config: &ModelConfig, walk: Walk) -> bool {
        if self.started {
            let empty = |window: &Candidate| window.descent().evaluations() == 0 || window.descent().is_done();
            if self.candidates.iter().all(empty) {
                return false;
            }
            self.pace.cut(self.passes());
            self.candidates.iter_mut().for_each(|window| window.cut_short(walk));
            return true;
        }
        let near = |stored: &&Stored| stored.surprise(self.first().descent().known()) < config.defaults.restart.cold_distance;
        if self.stored().filter(near).is_none() {
            return false;
        }
        let Some(stored) = self.episode.take_stored() else { return false };
        self.pace.cut(0);
        (self.started, self.rolled_out, self.start) = (true, true, Start::Warm);
        self.anchor.set(0, stored.anchor());
        for window in &mut self.candidates {
            // Nobody was asked for the latents of now.
            window.believe(stored.anchor());
            window.give_as_it_is(stored.window(), walk);
        }
        true
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

    /// Writes the latents of a window from position 0 on: means, or draws by the noise of each position's absolute time.
    pub(super) fn write_latents(&self, window: &Candidate, out: &mut [f32]) {
        for (position, out) in out.chunks_exact_mut(window.latents().dim().max(1)).enumerate() {
            let latent = window.latents().get(position);
            match self.options().latent {
                LatentMode::Mean => out.copy_from_slice(latent.mean),
                LatentMode::Sample => {
                    let (noise, time) = (Noise::new(self.episode.seed()), window.descent().time() + position as u64);
                    noise.fill(time, 0, Slot::Latent, out);
                    let columns = out.iter_mut().zip(latent.mean.iter().zip(latent.log_var));
                    columns.for_each(|(out, (mean, log_var))| *out = mean + (log_var / 2.0).exp() * *out);
                }
            }
        }
    }

    /// The past of position 0 of a window, the last token first: imagined ones, after the first action of a chunk, and real ones behind them.
    pub(super) fn past<'a>(&'a self, window: &'a Candidate, back: usize, walk: Walk) -> Option<TokenRef<'a>> {
        let imagined = window.descent().given_len();
        match back.checked_sub(imagined) {
            Some(back) => self.episode.past(back),
            None => Some(window.imagined(imagined - 1 - back, walk)),
        }
    }

    /// The real past of now, the last token first.
    pub(super) fn real_past(&self, back: usize) -> Option<TokenRef<'_>> {
        self.episode.past(back)
    }

    /// Token `position` of a window from the current one on: the real state, or what the window has there. Of a future that has not come an act
    /// has nothing.
    pub(super) fn ahead<'a>(&self, window: &'a Candidate, position: usize, evidence: Evidence, walk: Walk) -> TokenRef<'a> {
        match evidence {
            Evidence::Filter => TokenRef { state: Some(window.descent().known()), ..TokenRef::default() },
            Evidence::Refinement => window.token(position, walk),
            Evidence::SuccessorState | Evidence::Successor => TokenRef::default(),
        }
    }

    /// Takes note of what the candidates are worth, and chooses one.
    pub(super) fn choose(&mut self, values: &[f32]) {
        let (noise, time) = (Noise::new(self.episode.seed()), self.episode.time());
        self.choice = Choice::among(values, self.options().pick_temperature, || noise.uniform(time, Slot::Choice));
    }

    pub(super) fn finish(self, config: &ModelConfig, walk: Walk) -> Result<(Episode, Chunk), AgentError> {
        if self.has_failed() {
            return Err(AgentError::NonFinite { place: Place::Denoiser });
        }
        let (evaluations, passes) = (self.evaluations(), self.passes());
        let Self { mut candidates, episode, anchor, start, choice, .. } = self;
        let chosen = candidates.swap_remove(choice.index());
        let (normalizer, descent) = (&config.units.normalizer, chosen.descent());
        let actions: Vec<Vec<f32>> = (0..chosen.actions_len()).map(|index| chosen.action(index).to_vec()).collect();
        let positions = descent.planned().chunks(walk.columns.width()).filter(|_| !walk.columns.state.is_empty());
        let states = positions.map(|position| &position[walk.columns.state.clone()]);
        // An act that never asked the network has no latent of its own.
        let latent = match episode.latent().filter(|_| descent.evaluations() == 0) {
            Some((mean, log_var)) => (mean.to_vec(), log_var.to_vec()),
            None => chosen.latents().of_first_step(),
        };
        let returns = config.units.returns.as_ref();
        let raw = |value: f32| returns.map_or(value, |returns| returns.mean[0] + returns.std[0] * value);
        let chunk = Chunk {
            actions: actions.iter().map(|action| normalizer.action.denormalize(action)).collect(),
            planned_states: states.map(|state| normalizer.state.denormalize(state)).collect(),
            latent_mean: latent.0.clone(),
            latent_log_var: latent.1.clone(),
            predicted_state: normalizer.state.denormalize(descent.predicted_state()),
            evaluations,
            passes,
            value: choice.worth().map(|(value, _)| raw(value)),
            value_spread: choice.worth().map(|(_, spread)| raw(spread) - raw(0.0)),
            start,
            degraded: descent.is_degraded(),
        };
        chunk.check()?;
        let begun = if episode.code().is_none() { chosen.skill_begun(config) } else { None };
        let planned = Planned::new(descent.known().to_vec(), actions);
        let stored = Stored::new(chosen.into_window(), anchor);
        let after = episode.after(planned, stored, latent);
        let after = if let Some((code, steps)) = begun { after.with_skill(code, steps) } else { after };
        // What this act does not show the next one would: the noised window that is kept, the belief of its cold start.
        if after.is_finite() { Ok((after, chunk)) } else { Err(AgentError::NonFinite { place: Place::Episode }) }
    }
}
