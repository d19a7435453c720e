//! An episode that was written down, taken up again: by this process, by another one, or from somebody who may have changed it.

use super::{Agent, AgentError, Episode, episode::Sizes};
use crate::model::diffusion::schedule::Table;

impl Agent {
    /// Whether this model could have left the episode: all sizes are its own, all numbers finite, the options such as a session may have. It goes on
    /// as it would have where it comes from; a number in it that was changed to another finite one is not noticed, and does no harm but to
    /// its own acts.
    ///
    /// # Errors
    /// [`AgentError::InvalidEpisode`] naming the part; those of [`Agent::open`] for the options.
    pub fn adopt(&self, episode: &Episode) -> Result<(), AgentError> {
        let options = episode.options();
        self.check_options(options)?;
        let table = Table::of(&self.config().method.plan, options.sub_steps);
        let table = table.map_err(|reason| AgentError::InvalidOptions { field: "sub_steps", reason })?;
        let row_max = table.ready().filter(|_| options.streaming);
        match episode.misfit(&Sizes::new(self.config(), self.walk().columns, self.kept_len(), row_max)) {
            None => Ok(()),
            Some((field, reason)) => Err(AgentError::InvalidEpisode { field, reason }),
        }
    }
}
