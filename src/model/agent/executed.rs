//! What was executed since the last act, as tokens.

use super::{Agent, AgentError, Episode, Executed, Observation, episode::Planned, finite, known};
use crate::model::trajectory::Token;

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
        if observation.executed.is_empty() {
            let count = planned.map_or(0, |planned| planned.actions().len());
            return (0..count).map(|j| self.executed_token(planned, j, &Executed::default())).collect();
        }
        observation.executed.iter().enumerate().map(|(j, step)| self.executed_token(planned, j, step)).collect()
    }

    /// Step `j` of what was executed. What is missing is known from the last act, or masked if training hid it now and then; else a reward
    /// is taken to be the mean one, which harms least (Point-Wind-S: -21.3, masked -44.7, told -21.1), and the rest is refused.
    fn executed_token(&self, planned: Option<&Planned>, j: usize, step: &Executed) -> Result<Token, AgentError> {
        let (layout, normalizer, trained) = (self.config().layout, &self.config().units.normalizer, self.config().trained.missing);
        let field = |name: &str| format!("executed[{j}].{name}");
        let missing = |name: &str, trained: bool, why: &str| match trained {
            true => Ok(None),
            false => Err(AgentError::InvalidObservation { field: field(name), reason: format!("is missing, {why}") }),
        };
        let untrained = "and this checkpoint was not trained without: report the state in which each action was executed";
        let state = match (&step.state, planned) {
            (Some(state), _) => Some(self.state(&field("state"), state)?),
            (None, Some(planned)) if j == 0 => Some(planned.state().to_vec()),
            (None, _) => missing("state", trained.state, untrained)?,
        };
        let action = match (&step.action, planned.and_then(|planned| planned.actions().get(j))) {
            (Some(action), _) => Some(self.config().units.normalize_action(&self.checked(&field("action"), action, layout.action_dim)?)),
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
