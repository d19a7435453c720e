//! What was executed, since the last act or before the episode, as tokens.

use super::{Agent, AgentError, Episode, Executed, Observation, finite, known};
use crate::model::trajectory::{Token, TokenRef};

impl Agent {
    /// What was executed since the last act as tokens, normalized; see [`Observation::executed`] for what may be missing.
    pub(super) fn executed_tokens(&self, episode: &Episode, observation: &Observation) -> Result<Vec<Token>, AgentError> {
        let planned = episode.planned();
        if observation.nothing_executed {
            return match observation.executed.len() {
                0 => Ok(Vec::new()),
                steps => Err(AgentError::InvalidObservation {
                    field: "nothing_executed".into(),
                    reason: format!("is set, but `executed` holds {steps} step(s): leave one of the two out"),
                }),
            };
        }
        let returned = |j: usize| TokenRef {
            state: planned.filter(|_| j == 0).map(|planned| planned.state()),
            action: planned.and_then(|planned| planned.actions().get(j)).map(Vec::as_slice),
            ..TokenRef::default()
        };
        let token = |j: usize, step: &Executed| self.executed_token(("executed", j), step, returned(j));
        if observation.executed.is_empty() {
            let count = planned.map_or(0, |planned| planned.actions().len());
            return (0..count).map(|j| token(j, &Executed::default())).collect();
        }
        observation.executed.iter().enumerate().map(|(j, step)| token(j, step)).collect()
    }

    /// Steps lived before the episode as tokens, normalized; see [`Agent::recall`]. A step that tells nothing is a border, whether or not
    /// training hid parts of steps; at the end there is one without it, and who told it there may have forgotten what to tell.
    pub(super) fn history_tokens(&self, history: &[Executed]) -> Result<Vec<Token>, AgentError> {
        let tells_nothing = |step: &Executed| *step == Executed::default();
        if history.last().is_some_and(tells_nothing) {
            let reason = "tells nothing: the border before the new episode is there without it, so end with a step that tells something";
            return Err(AgentError::InvalidHistory { field: format!("history[{}]", history.len() - 1), reason: reason.into() });
        }
        let token = |(j, step): (usize, &Executed)| match tells_nothing(step) {
            true => Ok(Token::default()),
            false => self.executed_token(("history", j), step, TokenRef::default()).map_err(of_history),
        };
        history.iter().enumerate().map(token).collect()
    }

    /// Step `j` of a list of what was executed. What is missing is `returned`, if the last act knows of it, or masked if training hid it now
    /// and then; else a reward is taken to be the mean one, which harms least (Point-Wind-S: -21.3, masked -44.7, told -21.1), and the rest is
    /// refused.
    fn executed_token(&self, (list, j): (&str, usize), step: &Executed, returned: TokenRef) -> Result<Token, AgentError> {
        let (layout, normalizer, trained) = (self.config().layout, &self.config().units.normalizer, self.config().trained.missing);
        let field = |name: &str| format!("{list}[{j}].{name}");
        let missing = |name: &str, trained: bool, why: &str| match trained {
            true => Ok(None),
            false => Err(AgentError::InvalidObservation { field: field(name), reason: format!("is missing, {why}") }),
        };
        let untrained = "and this checkpoint was not trained without: report the state in which each action was executed";
        let state = match (&step.state, returned.state) {
            (Some(state), _) => Some(self.state(&field("state"), state)?),
            (None, Some(seen)) => Some(seen.to_vec()),
            (None, None) => missing("state", trained.state, untrained)?,
        };
        let action = match (&step.action, returned.action) {
            (Some(action), _) => Some(self.config().units.normalize_action(&self.checked(&field("action"), action, layout.action_dim)?)),
            (None, Some(returned)) => Some(returned.to_vec()),
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

/// The same complaint, of a step that no observation holds.
fn of_history(error: AgentError) -> AgentError {
    match error {
        AgentError::InvalidObservation { field, reason } => AgentError::InvalidHistory { field, reason },
        other => other,
    }
}
