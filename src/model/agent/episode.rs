//! What one episode remembers between acts.

use super::{restart::Stored, types::are_finite};
use crate::model::{
    columns::Columns,
    config::ModelConfig,
    diffusion::descent::Window,
    method::{GruLatent, Method},
    options::SamplerOptions,
    trajectory::{Layout, Token, TokenRef},
};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Later than any episode comes, and exact in every reader's numbers.
const TIME_MAX: u64 = 1 << 53;
/// Tokens whose memory is not given back: the usual chunks are read without a change of it.
const SPARE: usize = 16;

/// One episode as a value: what it remembers of the past, and its partly denoised window. Cloned, never changed in place by an act that
/// has not finished.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Episode {
    seed: u64,
    options: SamplerOptions,
    /// Steps executed so far: the environment time of the next decision.
    time: u64,
    /// The last real tokens, oldest first, normalized units.
    history: VecDeque<Token>,
    /// State of a GRU that runs on over the episode; empty where each act looks anew.
    memory: Vec<f32>,
    /// Tokens at the end of the history that it has not read.
    unread: usize,
    /// What the last act saw and answered.
    planned: Option<Planned>,
    /// The window on its way down, if the last act left one (streaming).
    window: Option<Stored>,
    /// Mean and log-variance of the latent of the last chunk's first step.
    latent: Option<(Vec<f32>, Vec<f32>)>,
    /// The skill that was last begun.
    skill: Option<Skill>,
}

/// A skill under way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Skill {
    /// What stands for it.
    code: Vec<f32>,
    /// When it is over: the environment time of the next one's first decision.
    end: u64,
}

/// Sizes of all that an episode of a model holds.
pub(super) struct Sizes<'a> {
    layout: Layout,
    /// Width of the latent.
    latent: usize,
    /// Width of a GRU that runs on; 0 where none does.
    memory: usize,
    /// Tokens that are kept beside those to be read.
    kept: usize,
    /// Positions of the window.
    horizon: usize,
    columns: &'a Columns,
    /// The lowest row at which a window may wait; None where none does.
    row_max: Option<usize>,
}

impl<'a> Sizes<'a> {
    pub(super) fn new(config: &ModelConfig, columns: &'a Columns, kept: usize, row_max: Option<usize>) -> Self {
        let Method { latent, plan, .. } = &config.method;
        let memory = latent.gru().map_or(0, GruLatent::memory_len);
        Self { layout: config.layout, latent: latent.dim(), memory, kept, horizon: plan.horizon, columns, row_max }
    }
}

/// What the last act saw and answered, normalized units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Planned {
    state: Vec<f32>,
    actions: Vec<Vec<f32>>,
}

impl Planned {
    pub(super) fn new(state: Vec<f32>, actions: Vec<Vec<f32>>) -> Self {
        Self { state, actions }
    }

    pub(super) fn state(&self) -> &[f32] {
        &self.state
    }

    pub(super) fn actions(&self) -> &[Vec<f32>] {
        &self.actions
    }

    fn fits(&self, [state, action]: [usize; 2], horizon: usize) -> bool {
        are(&self.state, state) && self.actions.len() <= horizon && self.actions.iter().all(|values| are(values, action))
    }
}

impl Episode {
    /// A fresh one; `memory` is the width of a GRU that runs on, or 0.
    pub(super) fn new(seed: u64, options: SamplerOptions, memory: usize) -> Self {
        let (history, memory) = (VecDeque::new(), vec![0.0; memory]);
        Self { seed, options, time: 0, history, memory, unread: 0, planned: None, window: None, latent: None, skill: None }
    }

    /// See [`super::Agent::reset`]. A token of which nothing is known stands between the old episode and the new one: from the last state of
    /// the one nobody arrives at the first of the other. What came of the old one's last act nobody has told.
    pub(super) fn reset(&self, seed: u64, keep_history: bool) -> Self {
        let mut fresh = Self::new(seed, self.options.clone(), self.memory.len());
        if keep_history {
            // Room for the border too: what grows by one takes twice as much, and a history that waits to be read may be long.
            fresh.history.reserve_exact(self.history.len() + 1);
            fresh.history.extend(self.history.iter().cloned());
            fresh.memory.clone_from(&self.memory);
            fresh.unread = self.unread;
            // Where nothing was lived there is no border, however often it is reset.
            if self.time > 0 {
                fresh.history.push_back(Token::default());
                fresh.unread += usize::from(!fresh.memory.is_empty());
            }
        }
        fresh
    }

    /// Appends executed tokens; keeps the last `keep` and those that are to be read, and memory for no more.
    pub(super) fn commit(&mut self, executed: Vec<Token>, keep: usize) {
        self.time += executed.len() as u64;
        if !self.memory.is_empty() {
            self.unread += executed.len();
        }
        // The one before the first that is to be read is looked at too.
        let keep = if self.unread > 0 { keep.max(self.unread + 1) } else { keep };
        let surplus = (self.history.len() + executed.len()).saturating_sub(keep);
        self.history.drain(..surplus.min(self.history.len()));
        self.history.extend(executed.into_iter().rev().take(keep).rev());
        self.history.shrink_to(keep);
    }

    /// State of a GRU that runs on; empty where each act looks anew.
    pub(super) fn memory(&self) -> &[f32] {
        &self.memory
    }

    /// The oldest token that it has not read.
    pub(super) fn unread(&self) -> Option<TokenRef<'_>> {
        self.past(self.unread.checked_sub(1)?)
    }

    /// The token before that one.
    pub(super) fn last_read(&self) -> Option<TokenRef<'_>> {
        self.past(self.unread)
    }

    /// It has read that token. When all are read, the last `keep` are kept.
    pub(super) fn remember(&mut self, state: &[f32], keep: usize) {
        self.memory.copy_from_slice(state);
        self.unread = self.unread.saturating_sub(1);
        if self.unread == 0 && self.history.len() > keep {
            self.history.drain(..self.history.len() - keep);
            self.history.shrink_to(keep.max(SPARE));
        }
    }

    /// The real past, the last token first.
    pub(super) fn past(&self, back: usize) -> Option<TokenRef<'_>> {
        let index = self.history.len().checked_sub(back + 1)?;
        self.history.get(index).map(Token::view)
    }

    #[cfg(test)]
    pub(super) fn at(self, time: u64) -> Self {
        Self { time, ..self }
    }

    #[cfg(test)]
    pub(super) fn history(&self) -> &VecDeque<Token> {
        &self.history
    }

    /// What the last act saw and answered.
    pub(super) fn planned(&self) -> Option<&Planned> {
        self.planned.as_ref()
    }

    /// The window that the last act left, if it did.
    pub(super) fn stored(&self) -> Option<&Stored> {
        self.window.as_ref()
    }

    /// Hands it out: an act walks on with it.
    pub(super) fn take_stored(&mut self) -> Option<Stored> {
        self.window.take()
    }

    /// The code of the skill under way, if there is one.
    pub(super) fn code(&self) -> Option<&[f32]> {
        self.skill.as_ref().filter(|skill| self.time < skill.end).map(|skill| skill.code.as_slice())
    }

    /// The episode after an act; the window is kept for the next one where acts stream.
    pub(super) fn after(self, planned: Planned, window: Stored, latent: (Vec<f32>, Vec<f32>)) -> Self {
        let window = self.options.streaming.then_some(window);
        let latent = (!latent.0.is_empty()).then_some(latent);
        Self { planned: Some(planned), window, latent, ..self }
    }

    /// Whether all that an act has written into it is: the rest was checked when it came.
    pub(super) fn is_finite(&self) -> bool {
        let Self { memory, planned, window, latent, skill, seed: _, options: _, time: _, history: _, unread: _ } = self;
        let planned = planned.iter().flat_map(|planned| planned.actions.iter().chain([&planned.state]));
        let latent = latent.iter().flat_map(|(mean, log_var)| [mean, log_var]);
        let rows = planned.chain(latent).chain(skill.iter().map(|skill| &skill.code)).chain([memory]);
        rows.into_iter().all(|row| are_finite(row)) && window.iter().all(Stored::is_finite)
    }

    /// The same with another skill under way, for so many steps from now on.
    pub(super) fn with_skill(self, code: Vec<f32>, steps: u64) -> Self {
        Self { skill: Some(Skill { code, end: self.time + steps }), ..self }
    }

    /// What of it is none of a model of these sizes, and why; None: it may be one of its episodes.
    pub(super) fn misfit(&self, sizes: &Sizes) -> Option<(&'static str, String)> {
        let [state, action] = [sizes.layout.state_dim, sizes.layout.action_dim];
        let latents = self.latent.iter().flat_map(|(mean, log_var)| [mean, log_var]);
        let code = self.skill.as_ref().map_or(0, |skill| skill.end);
        let checks = [
            ("time", self.time.max(code) > TIME_MAX),
            (
                "history",
                self.history.len() > sizes.kept.max(self.unread) + 1 || !self.history.iter().all(|token| fits(token, sizes.layout)),
            ),
            ("memory", !are(&self.memory, sizes.memory)),
            ("unread", self.unread > self.history.len() || self.unread > 0 && sizes.memory == 0),
            ("planned", !self.planned.iter().all(|planned| planned.fits([state, action], sizes.horizon))),
            ("window", !self.window.iter().all(|window| window_fits(window, sizes))),
            ("latent", !latents.into_iter().all(|values| sizes.latent > 0 && are(values, sizes.latent))),
            ("skill", !self.skill.iter().all(|skill| !skill.code.is_empty() && are(&skill.code, sizes.columns.code.len()))),
        ];
        let (field, _) = checks.into_iter().find(|(_, wrong)| *wrong)?;
        Some((field, "is none of this model: another size, or a number that is not finite".into()))
    }

    /// Tokens that a GRU which runs on has yet to read.
    pub fn unread_len(&self) -> usize {
        self.unread
    }

    /// The same with the noise of another seed from now on.
    #[must_use]
    pub fn with_seed(self, seed: u64) -> Self {
        Self { seed, ..self }
    }

    /// Noise seed of the episode.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// How its chunks are sampled.
    pub fn options(&self) -> &SamplerOptions {
        &self.options
    }

    /// Steps executed so far.
    pub fn time(&self) -> u64 {
        self.time
    }

    /// Latent mean and log-variance after the last act, if there was one and the model has latents.
    pub fn latent(&self) -> Option<(&[f32], &[f32])> {
        self.latent.as_ref().map(|(mean, log_var)| (mean.as_slice(), log_var.as_slice()))
    }

    /// Resident size in bytes, for the session cap.
    pub fn size_bytes(&self) -> usize {
        let floats = |values: Option<&Vec<f32>>| values.map_or(0, |values| values.capacity() * size_of::<f32>());
        let token = |token: &Token| floats(token.state.as_ref()) + floats(token.action.as_ref());
        let history = self.history.capacity() * size_of::<Token>() + self.history.iter().map(token).sum::<usize>();
        let planned = self.planned.as_ref();
        let planned: usize = planned.map_or(0, |p| floats(Some(&p.state)) + p.actions.iter().map(|a| 24 + floats(Some(a))).sum::<usize>());
        let window = self.window.as_ref().map_or(0, Stored::size_bytes);
        let latent = self.latent.as_ref().map_or(0, |(mean, log_var)| floats(Some(mean)) + floats(Some(log_var)));
        let memory = self.memory.capacity() * size_of::<f32>();
        let skill = floats(self.skill.as_ref().map(|skill| &skill.code));
        size_of::<Self>() + history + memory + planned + window + latent + skill
    }
}

/// So many numbers, all finite.
fn are(values: &[f32], count: usize) -> bool {
    values.len() == count && are_finite(values)
}

fn fits(token: &Token, layout: Layout) -> bool {
    let Token { state, action, reward, noise } = token;
    let parts = [(state, layout.state_dim), (action, layout.action_dim)];
    let numbers = reward.iter().chain([noise]).all(|value| value.is_finite());
    numbers && parts.into_iter().all(|(part, count)| part.as_ref().is_none_or(|values| are(values, count)))
}

fn window_fits(stored: &Stored, sizes: &Sizes) -> bool {
    let Window { x, row, predicted_state } = stored.window();
    let columns = sizes.columns;
    let is_low = sizes.row_max.is_some_and(|row_max| *row <= row_max);
    let values = are(x, sizes.horizon * columns.width()) && are(predicted_state, columns.state.len());
    is_low && values && stored.anchor_is_whole(sizes.latent)
}
