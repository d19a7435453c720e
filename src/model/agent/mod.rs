//! An agent: a trained model and the rules by which one episode turns observations into action chunks (section 4.4 of the paper; algorithm 3).
//!
//! `act` is a function `(Episode, Observation) -> (Episode, Chunk)`. An act in progress is a [`Descent`]; each [`Agent::advance`] costs one
//! denoiser forward, shared by all descents given to it, whatever rungs they stand on.
mod advance;
mod chain;
mod descent;
mod episode;
mod hurry;
mod types;

#[cfg(test)]
mod tests;

pub use descent::Descent;
pub use episode::Episode;
pub(in crate::model) use types::infinity_as_null;
pub use types::{AgentError, Chunk, Executed, LatentMode, Observation, SamplerOptions, Spec, Start};

use crate::model::{Networks, config::ModelConfig, diffusion::ladder::Ladder, diffusion::process::Process};

/// Largest state or reward that is taken, in standard deviations of the data.
const FAR_MAX: f32 = 1e6;

/// A loaded model.
pub struct Agent {
    config: ModelConfig,
    networks: Networks,
    process: Process,
    spec: Spec,
}

impl Agent {
    /// An agent of these networks; `digest` identifies the checkpoint.
    pub fn new(config: ModelConfig, networks: Networks, digest: String) -> Self {
        let spec = Spec {
            layout: config.layout,
            plan_horizon: config.plan_horizon,
            block_len: config.block_len,
            obs_horizon: config.obs_horizon,
            latent_dim: config.latent.as_ref().map_or(0, |latent| latent.dim),
            level_max: config.level_max,
            action_low: config.action_low.clone(),
            action_high: config.action_high.clone(),
            sampler: config.sampler.clone(),
            refined: config.refined,
            trained: config.trained(),
            digest,
        };
        Self { process: Process::cosine(config.level_max), config, networks, spec }
    }

    /// What a client must know of it.
    pub fn spec(&self) -> &Spec {
        &self.spec
    }

    /// Architecture, units and defaults.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// The networks, for probes and held-out losses.
    pub fn networks(&self) -> &Networks {
        &self.networks
    }

    /// A fresh episode.
    ///
    /// # Errors
    /// [`AgentError::InvalidOptions`] if an option does not fit the model.
    pub fn open(&self, seed: u64, options: &SamplerOptions) -> Result<Episode, AgentError> {
        self.config.check_options(options).map_err(|(field, reason)| AgentError::InvalidOptions { field, reason })?;
        Ok(Episode::new(seed, options.clone()))
    }

    /// A new episode with the options of an old one. With `keep_history` the latent goes on looking back on the old one's last steps,
    /// as a context that outlasts episodes needs.
    pub fn reset(&self, episode: &Episode, seed: u64, keep_history: bool) -> Episode {
        episode.reset(seed, keep_history)
    }

    /// Checks the observation and starts an act on a copy of the episode; no network evaluation yet.
    ///
    /// # Errors
    /// [`AgentError::InvalidObservation`] naming the field.
    pub fn begin(&self, episode: &Episode, observation: &Observation) -> Result<Descent, AgentError> {
        let state = self.state("state", &observation.state)?;
        let mut episode = episode.clone();
        let executed = self.executed_tokens(&episode, observation)?;
        let aligned = executed.len() == episode.options.action_horizon;
        episode.commit(executed, self.config.block_len.max(self.config.obs_horizon));
        let ladder = Ladder::new(self.config.plan_horizon, episode.options.sub_steps, self.config.level_max);
        let ladder = ladder.map_err(|reason| AgentError::InvalidOptions { field: "sub_steps", reason })?;
        Ok(Descent::new(episode, state, ladder, aligned, &self.config))
    }

    /// For an act that has no time for another evaluation: gives out what there is, and says whether there was anything: positions of the
    /// last estimate or, if there is none yet, of the window that the act before left, as it is. Then the descent is done, and its chunk
    /// marked degraded.
    pub fn cut_short(&self, descent: &mut Descent) -> bool {
        descent.cut_short(self.walk())
    }

    /// The new episode and the chunk of a descent that is done.
    ///
    /// # Errors
    /// [`AgentError::NonFinite`] if the network gave NaN or infinity.
    pub fn finish(&self, descent: Descent) -> Result<(Episode, Chunk), AgentError> {
        descent.finish(&self.config)
    }

    /// A whole act on its own: begin, advance until done, finish.
    ///
    /// # Errors
    /// As those three.
    pub fn act(&self, episode: &Episode, observation: &Observation) -> Result<(Episode, Chunk), AgentError> {
        let mut descents = [self.begin(episode, observation)?];
        while !descents[0].is_done() {
            self.advance(&mut descents)?;
        }
        let [descent] = descents;
        self.finish(descent)
    }

    /// Values of the right number, all finite.
    fn checked(&self, field: &str, values: &[f32], len: usize) -> Result<Vec<f32>, AgentError> {
        let invalid = |field: String, reason: String| Err(AgentError::InvalidObservation { field, reason });
        if values.len() != len {
            return invalid(field.into(), format!("has {} values, the model takes {len}", values.len()));
        }
        values.iter().enumerate().map(|(index, value)| finite(&format!("{field}[{index}]"), *value)).collect()
    }

    /// A state, normalized.
    fn state(&self, field: &str, raw: &[f32]) -> Result<Vec<f32>, AgentError> {
        let normalized = self.config.normalizer.state.normalize(&self.checked(field, raw, self.config.layout.state_dim)?);
        let far = |(index, value): (usize, &f32)| known(&format!("{field}[{index}]"), raw[index], *value);
        normalized.iter().enumerate().try_for_each(far)?;
        Ok(normalized)
    }
}

/// Whether a value lies anywhere near the data: one that does not is in other units, or the reading of a broken sensor, and a network that
/// is given it answers nonsense or infinity.
fn known(field: &str, raw: f32, normalized: f32) -> Result<(), AgentError> {
    let reason = || format!("is {raw}, {normalized:.0e} standard deviations from the mean of the data; at most {FAR_MAX:.0e} are taken");
    if normalized.abs() <= FAR_MAX { Ok(()) } else { Err(AgentError::InvalidObservation { field: field.into(), reason: reason() }) }
}

fn finite(field: &str, value: f32) -> Result<f32, AgentError> {
    let invalid = || AgentError::InvalidObservation { field: field.into(), reason: "is not a finite number".into() };
    if value.is_finite() { Ok(value) } else { Err(invalid()) }
}
