//! One window of an act on its way down, with its latents and the actions that have come of it. Most acts have one; several are candidates, and
//! the guide chooses among them.

use super::{ask::Ask, chain::Chain};
use crate::model::{
    config::ModelConfig,
    diffusion::descent::{Descent, Walk, Window},
    latent::GaussianRef,
    noise::Slot,
    options::SamplerOptions,
    trajectory::TokenRef,
};

/// See the module.
#[derive(Debug)]
pub(super) struct Candidate {
    /// The window.
    descent: Descent,
    /// Its latents, the first of them that of position 0.
    latents: Chain,
    /// Actions given out, `action_dim` values each, normalized.
    actions: Vec<f32>,
    action_dim: usize,
}

impl Candidate {
    pub(super) fn new(descent: Descent, latents: Chain, [chunk, action_dim]: [usize; 2]) -> Self {
        Self { descent, latents, actions: Vec::with_capacity(chunk * action_dim), action_dim }
    }

    /// The window on its way.
    pub(super) fn descent(&self) -> &Descent {
        &self.descent
    }

    /// Its latents, the first of them that of position 0.
    pub(super) fn latents(&self) -> &Chain {
        &self.latents
    }

    /// The latent at a position.
    pub(super) fn set_latent(&mut self, position: usize, latent: GaussianRef) {
        self.latents.set(position, latent);
    }

    /// Latents that somebody tells, as sure as a latent can be.
    pub(super) fn set_truth(&mut self, truth: &[f32]) {
        self.latents.set_certain(truth);
    }

    /// One belief of all positions.
    pub(super) fn believe(&mut self, latent: GaussianRef) {
        (0..self.latents.len()).for_each(|position| self.latents.set(position, latent));
    }

    /// See [`Descent::allow`].
    pub(super) fn allow(&mut self, evaluations: Option<usize>) {
        self.descent.allow(evaluations);
    }

    /// See [`super::Act::spoil`].
    pub(super) fn spoil(&mut self) {
        self.descent.spoil();
    }

    /// See [`Descent::begin_cold`].
    pub(super) fn begin_cold(&mut self, walk: Walk) {
        self.descent.begin_cold(walk);
    }

    /// See [`Descent::begin_with`].
    pub(super) fn begin_with(&mut self, window: &Window, rows: usize, walk: Walk) {
        self.descent.begin_with(window, rows, walk);
    }

    /// See [`Descent::hold`].
    pub(super) fn hold(&mut self, code: &[f32]) {
        self.descent.hold(code);
    }

    /// What critics judge of it: the first action, or the code of a skill.
    pub(super) fn choice(&self, walk: Walk) -> &[f32] {
        if walk.columns.code.is_empty() { self.action(0) } else { self.descent.given(0) }
    }

    /// What is left for the next act.
    pub(super) fn into_window(self) -> Window {
        self.descent.into_window()
    }

    #[cfg(test)]
    pub(super) fn descent_mut(&mut self) -> &mut Descent {
        &mut self.descent
    }

    /// Whether it asks this of the networks now.
    pub(super) fn asks(&self, ask: Ask, options: &SamplerOptions) -> bool {
        match ask {
            Ask::Filter | Ask::RollOut | Ask::Choose => false,
            Ask::Refine => self.waits() && self.descent.is_ready() && options.kappa > 0.0 && !self.latents.is_empty(),
            Ask::Denoise => self.waits() && !self.descent.is_done(),
            Ask::Decode => !self.descent.has_failed() && !self.waits(),
        }
    }

    /// Whether all positions that were given out have their actions, so that it can go on.
    fn waits(&self) -> bool {
        self.actions_len() == self.descent.given_len()
    }

    /// Whether there is nothing left to be asked of it.
    pub(super) fn is_done(&self) -> bool {
        self.descent.has_failed() || self.descent.is_done() && self.waits()
    }

    /// Actions that have come of it.
    pub(super) fn actions_len(&self) -> usize {
        self.actions.len() / self.action_dim
    }

    /// One of them.
    pub(super) fn action(&self, index: usize) -> &[f32] {
        &self.actions[index * self.action_dim..][..self.action_dim]
    }

    /// The next action.
    pub(super) fn push_action(&mut self, action: &[f32]) {
        self.actions.extend_from_slice(action);
    }

    /// Takes the network's estimates of the clean window, one a slot.
    pub(super) fn step_down(&mut self, x0: &[f32], walk: Walk) {
        let given = self.descent.given_len();
        self.descent.step_down(x0, walk);
        self.latents.advance(self.descent.given_len() - given);
        self.take_actions(walk);
    }

    /// Actions that are part of what was given out.
    fn take_actions(&mut self, walk: Walk) {
        if walk.columns.action.is_empty() {
            return;
        }
        for index in self.actions_len()..self.descent.given_len() {
            let action = &self.descent.given(index)[walk.columns.action.clone()];
            self.actions.extend_from_slice(action);
        }
    }

    /// See [`Descent::cut_short`].
    pub(super) fn cut_short(&mut self, walk: Walk) {
        let given = self.descent.given_len();
        self.descent.cut_short(walk);
        self.latents.advance(self.descent.given_len() - given);
        self.take_actions(walk);
    }

    /// See [`Descent::give_as_it_is`].
    pub(super) fn give_as_it_is(&mut self, window: &Window, walk: Walk) {
        self.descent.give_as_it_is(window, walk);
        self.take_actions(walk);
    }

    /// The states between which the next action leads, of a plan of states.
    pub(super) fn states_around(&self, walk: Walk) -> [&[f32]; 2] {
        let (index, state) = (self.actions_len(), walk.columns.state.clone());
        let next = if index + 1 < self.descent.given_len() {
            &self.descent.given(index + 1)[state.clone()]
        } else {
            self.descent.predicted_state()
        };
        [&self.descent.given(index)[state], next]
    }

    /// Environment time of the next action.
    fn action_time(&self) -> u64 {
        self.descent.time() - (self.descent.given_len() - self.actions_len()) as u64
    }

    /// Noise of the next action at a level of inverse dynamics, of this standard deviation.
    pub(super) fn draw_inverse(&self, level: u32, scale: f32, temperature: f32, out: &mut [f32]) {
        self.descent.noise().fill(self.action_time(), level, Slot::Inverse, out);
        out.iter_mut().for_each(|out| *out *= scale * temperature);
    }

    #[cfg(test)]
    pub(super) fn stand_at(&mut self, row: usize, x: &[f32], given: &[f32], actions: &[f32]) {
        self.descent.stand_at(row, x, given);
        self.actions = actions.to_vec();
    }

    /// An imagined step: state and action. Where actions alone are diffused, of the first one the real state, and of later ones none.
    pub(super) fn imagined(&self, index: usize, walk: Walk) -> TokenRef<'_> {
        let state = self.state_of(&self.descent.given(index)[walk.columns.state.clone()], index);
        TokenRef { state, action: (index < self.actions_len()).then(|| self.action(index)), ..TokenRef::default() }
    }

    /// The state so many steps after the real one, which stands here in the window, if states are diffused.
    fn state_of<'a>(&'a self, here: &'a [f32], steps: usize) -> Option<&'a [f32]> {
        match (here.is_empty(), steps) {
            (false, _) => Some(here),
            (true, 0) => Some(self.descent.known()),
            (true, _) => None,
        }
    }

    /// A position of the window as a token.
    pub(super) fn token(&self, position: usize, walk: Walk) -> TokenRef<'_> {
        let (columns, x) = (walk.columns, self.descent.position(position));
        let action = (!columns.action.is_empty()).then(|| &x[columns.action.clone()]);
        let state = self.state_of(&x[columns.state.clone()], self.descent.given_len() + position);
        TokenRef { state, action, noise: self.descent.sigma(position, walk), ..TokenRef::default() }
    }

    /// The plan as it was when its first action was given out, `T * D` values: what was given out, and the last estimate of what comes then.
    pub(super) fn write_plan(&self, out: &mut [f32]) {
        let mut filled = 0;
        let given = (0..self.descent.given_len()).map(|index| self.descent.given(index));
        for part in given.chain(std::iter::once(self.descent.planned())) {
            let len = part.len().min(out.len() - filled);
            out[filled..filled + len].copy_from_slice(&part[..len]);
            filled += len;
        }
    }

    /// The code of the skill that it begins, and for how many steps, of a model that has skills. One that a deadline cut short is done once, and no longer.
    pub(super) fn skill_begun(&self, config: &ModelConfig) -> Option<(Vec<f32>, u64)> {
        let steps = config.method.plan.diffused.code_steps()?;
        let lasts = if self.descent.is_degraded() { 1 } else { steps as u64 };
        Some((self.descent.given(0).to_vec(), lasts))
    }

    pub(super) fn size_bytes(&self) -> usize {
        self.descent.size_bytes() + self.latents.size_bytes() + self.actions.capacity() * size_of::<f32>()
    }
}
