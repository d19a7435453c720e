//! What one episode remembers between acts.

use super::{Agent, AgentError, Executed, Observation, SamplerOptions, finite, known};
use crate::model::trajectory::Token;
use std::collections::VecDeque;

/// One episode as a value: what it remembers of the past, and its partly denoised window. Cloned, never changed in place by an act that
/// has not finished.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    pub(super) seed: u64,
    pub(super) options: SamplerOptions,
    /// Steps executed so far: the environment time of the next decision.
    pub(super) time: u64,
    /// The last real tokens, oldest first, normalized units.
    pub(super) history: VecDeque<Token>,
    /// What the last act saw and answered.
    pub(super) planned: Option<Planned>,
    /// The window on its way down, if the last act left one (streaming).
    pub(super) window: Option<Window>,
    /// Mean and log-variance of the latent of the last chunk's first step.
    pub(super) latent: Option<(Vec<f32>, Vec<f32>)>,
}

/// What the last act saw and answered, normalized units.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Planned {
    pub(super) state: Vec<f32>,
    pub(super) actions: Vec<Vec<f32>>,
}

/// A window at READY, position i at rung i + 1; above it only after an act that a deadline cut short.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Window {
    /// `T * D` values, normalized units.
    pub(super) x: Vec<f32>,
    /// Row of the ladder.
    pub(super) row: usize,
    /// The state it was built for.
    pub(super) predicted_state: Vec<f32>,
    /// Mean of the prior latent of position 0 at the last cold start.
    pub(super) anchor: Vec<f32>,
}

impl Episode {
    pub(super) fn new(seed: u64, options: SamplerOptions) -> Self {
        Self { seed, options, time: 0, history: VecDeque::new(), planned: None, window: None, latent: None }
    }

    pub(super) fn reset(&self, seed: u64, keep_history: bool) -> Self {
        let mut fresh = Self::new(seed, self.options.clone());
        if keep_history {
            fresh.history.clone_from(&self.history);
        }
        fresh
    }

    /// Appends executed tokens; keeps the last `keep`, and memory for no more.
    pub(super) fn commit(&mut self, executed: Vec<Token>, keep: usize) {
        self.time += executed.len() as u64;
        let surplus = (self.history.len() + executed.len()).saturating_sub(keep);
        self.history.drain(..surplus.min(self.history.len()));
        self.history.extend(executed.into_iter().rev().take(keep).rev());
        self.history.shrink_to(keep);
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
        let window = self.window.as_ref().map_or(0, |w| [&w.x, &w.predicted_state, &w.anchor].map(|v| floats(Some(v))).iter().sum());
        let latent = self.latent.as_ref().map_or(0, |(mean, log_var)| floats(Some(mean)) + floats(Some(log_var)));
        size_of::<Self>() + history + planned + window + latent
    }
}

impl Agent {
    /// What was executed since the last act as tokens, normalized; see [`Observation::executed`] for what may be missing.
    pub(super) fn executed_tokens(&self, episode: &Episode, observation: &Observation) -> Result<Vec<Token>, AgentError> {
        let planned = episode.planned.as_ref();
        if observation.nothing_executed {
            return match observation.executed.len() {
                0 => Ok(Vec::new()),
                steps => Err(AgentError::InvalidObservation {
                    field: "nothing_executed".into(),
                    reason: format!("is set, but `executed` holds {steps} step(s): leave one of the two out"),
                }),
            };
        }
        if observation.executed.is_empty() {
            let count = planned.map_or(0, |planned| planned.actions.len());
            return (0..count).map(|j| self.executed_token(planned, j, &Executed::default())).collect();
        }
        observation.executed.iter().enumerate().map(|(j, step)| self.executed_token(planned, j, step)).collect()
    }

    /// Step `j` of what was executed. What is missing is known from the last act, or masked if training hid it now and then; else a reward
    /// is taken to be the mean one, which harms least (Point-Wind-S: -21.3, masked -44.7, told -21.1), and the rest is refused.
    fn executed_token(&self, planned: Option<&Planned>, j: usize, step: &Executed) -> Result<Token, AgentError> {
        let (layout, normalizer, trained) = (self.config.layout, &self.config.normalizer, self.config.missing_trained);
        let field = |name: &str| format!("executed[{j}].{name}");
        let missing = |name: &str, trained: bool, why: &str| match trained {
            true => Ok(None),
            false => Err(AgentError::InvalidObservation { field: field(name), reason: format!("is missing, {why}") }),
        };
        let untrained = "and this checkpoint was not trained without: report the state in which each action was executed";
        let state = match (&step.state, planned) {
            (Some(state), _) => Some(self.state(&field("state"), state)?),
            (None, Some(planned)) if j == 0 => Some(planned.state.clone()),
            (None, _) => missing("state", trained.state, untrained)?,
        };
        let action = match (&step.action, planned.and_then(|planned| planned.actions.get(j))) {
            (Some(action), _) => Some(self.config.normalize_action(&self.checked(&field("action"), action, layout.action_dim)?)),
            (None, Some(returned)) => Some(returned.clone()),
            (None, None) => missing("action", trained.action, "and no action was returned for this step")?,
        };
        let reward = match step.reward {
            Some(raw) => {
                let reward = normalizer.reward.normalize(&[finite(&field("reward"), raw)?])[0];
                known(&field("reward"), raw, reward)?;
                Some(reward)
            }
            None => (!trained.reward).then_some(0.0),
        };
        Ok(Token { state, action, reward, noise: 0.0 })
    }
}
