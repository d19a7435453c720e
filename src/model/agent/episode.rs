//! What one episode remembers between acts.

use super::restart::Stored;
use crate::model::{
    options::SamplerOptions,
    trajectory::{Token, TokenRef},
};
use std::collections::VecDeque;

/// Tokens whose memory is not given back: the usual chunks are read without a change of it.
const SPARE: usize = 16;

/// One episode as a value: what it remembers of the past, and its partly denoised window. Cloned, never changed in place by an act that
/// has not finished.
#[derive(Clone, Debug, PartialEq)]
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
#[derive(Clone, Debug, PartialEq)]
struct Skill {
    /// What stands for it.
    code: Vec<f32>,
    /// When it is over: the environment time of the next one's first decision.
    end: u64,
}

/// What the last act saw and answered, normalized units.
#[derive(Clone, Debug, PartialEq)]
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

    /// The same with another skill under way, for so many steps from now on.
    pub(super) fn with_skill(self, code: Vec<f32>, steps: u64) -> Self {
        Self { skill: Some(Skill { code, end: self.time + steps }), ..self }
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
