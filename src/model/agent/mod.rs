//! An agent: a trained model and the rules by which one episode turns observations into action chunks (section 4.4 of the paper; algorithm 3).
//!
//! `act` is a function `(Episode, Observation) -> (Episode, Chunk)`. An act in progress is an [`Act`], which asks; each [`Agent::advance`]
//! answers all that is asked, with one denoiser forward shared by all acts given to it, whatever rungs they stand on.
mod act;
mod adopted;
mod answers;
mod ask;
mod candidate;
mod chain;
mod choice;
mod episode;
mod executed;
mod guide;
mod pace;
mod restart;
mod rows;
mod types;

#[cfg(test)]
mod tests;

pub use act::Act;
pub use ask::Ask;
pub use episode::Episode;
use types::Known;
pub use types::{AgentError, Chunk, Executed, Haste, Observation, Place, Spec, Start};

use crate::model::{
    Networks,
    columns::{Bounds, Columns},
    config::ModelConfig,
    diffusion::{descent::Walk, guidance::Judge, process::Process, schedule::Table},
    method::{GruLatent, Method, Told, TrueFuture},
    options::SamplerOptions,
};

/// Largest state or reward that is taken, in standard deviations of the data.
const FAR_MAX: f32 = 1e6;

/// A loaded model.
pub struct Agent {
    config: ModelConfig,
    networks: Networks,
    process: Process,
    /// Of inverse dynamics that are a diffusion.
    inverse: Option<Process>,
    columns: Columns,
    bounds: Bounds,
    action_bounds: Bounds,
    spec: Spec,
}

impl Agent {
    /// An agent of these networks; `digest` identifies the checkpoint.
    pub fn new(config: ModelConfig, networks: Networks, digest: String) -> Self {
        let spec = Spec {
            layout: config.layout,
            plan_horizon: config.method.plan.horizon,
            block_len: config.method.latent.block_len(),
            obs_horizon: config.method.plan.obs_horizon,
            latent_dim: config.method.latent.dim(),
            level_max: config.method.plan.level_max,
            action_low: config.units.action_low.clone(),
            action_high: config.units.action_high.clone(),
            sampler: config.defaults.sampler.clone(),
            trained: config.trained.clone(),
            told: config.method.told.clone(),
            returns: config.units.returns.as_ref().map(|returns| [returns.mean[0], returns.std[0]]),
            guide: config.method.guide.is_some(),
            context: config.method.latent.truth(),
            digest,
        };
        let plan = &config.method.plan;
        let columns = Columns::new(plan.diffused, config.layout);
        let (bounds, action_bounds) = (Bounds::new(&columns, plan.clip, &config.units), Bounds::of_actions(&config.units));
        let inverse = config.method.head.level_max().map(Process::cosine);
        Self { process: Process::new(plan.alpha, plan.level_max), inverse, columns, bounds, action_bounds, config, networks, spec }
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
        self.check_options(options)?;
        let memory = self.config.method.latent.gru().map_or(0, GruLatent::memory_len);
        Ok(Episode::new(seed, options.clone(), memory))
    }

    fn check_options(&self, options: &SamplerOptions) -> Result<(), AgentError> {
        self.config.check_options(options).map_err(|(field, reason)| AgentError::InvalidOptions { field, reason })
    }

    /// A new episode with the options of an old one. With `keep_history` the latent goes on looking back on the old one's last steps,
    /// as a context that outlasts episodes needs.
    ///
    /// # Errors
    /// [`AgentError::HistoryNotKept`] if `keep_history` asks for what training never saw.
    pub fn reset(&self, episode: &Episode, seed: u64, keep_history: bool) -> Result<Episode, AgentError> {
        if keep_history {
            self.check_keeps_history("keep_history")?;
        }
        Ok(episode.reset(seed, keep_history))
    }

    /// A fresh episode whose latent looks back on steps that were lived before it, oldest first: the warm-start transitions of MetaDiffuser
    /// (Ni et al. 2023). It is the episode that [`Agent::reset`] with `keep_history` gives a session that has lived them, its border included.
    /// Nobody planned them here, so that what they do not tell is unknown; a step that tells nothing is the border between two of the
    /// episodes that they come from. Without a history it is the episode that [`Agent::open`] gives.
    ///
    /// # Errors
    /// Those of [`Agent::open`]; [`AgentError::InvalidHistory`] naming the step, or where no network looks back so far that it would see any;
    /// [`AgentError::HistoryNotKept`] where training never saw a history cross into another episode.
    pub fn recall(&self, seed: u64, options: &SamplerOptions, history: &[Executed]) -> Result<Episode, AgentError> {
        let mut lived = self.open(seed, options)?;
        if history.is_empty() {
            return Ok(lived);
        }
        self.check_looks_back()?;
        self.check_keeps_history("history")?;
        lived.commit(self.history_tokens(history)?, self.kept_len());
        Ok(lived.reset(seed, true))
    }

    /// That a network sees more of the past than the border which a history ends with.
    fn check_looks_back(&self) -> Result<(), AgentError> {
        let Method { latent, plan, .. } = &self.config.method;
        let runs_on = latent.gru().is_some_and(|gru| gru.memory_len() > 0);
        if runs_on || latent.block_len().max(plan.obs_horizon - 1) > 1 {
            return Ok(());
        }
        let reason = "would change nothing: no network of this checkpoint looks back into another episode; leave the field out".into();
        Err(AgentError::InvalidHistory { field: "history".into(), reason })
    }

    fn check_keeps_history(&self, field: &'static str) -> Result<(), AgentError> {
        if self.config.trained.sessions { Ok(()) } else { Err(AgentError::HistoryNotKept { field }) }
    }

    /// Checks the observation and begins an act on a copy of the episode; no network evaluation yet.
    ///
    /// # Errors
    /// [`AgentError::InvalidObservation`] naming the field.
    pub fn begin(&self, episode: &Episode, observation: &Observation) -> Result<Act, AgentError> {
        let state = self.state("state", &observation.state)?;
        let mut episode = episode.clone();
        let executed = self.executed_tokens(&episode, observation)?;
        let (options, plan) = (episode.options(), &self.config.method.plan);
        let known = Known {
            state,
            told: self.told(options),
            truth: self.truth(observation.context.as_deref(), options.action_horizon)?,
            aligned: executed.len() == options.action_horizon,
        };
        let table = Table::of(plan, options.sub_steps);
        let table = table.map_err(|reason| AgentError::InvalidOptions { field: "sub_steps", reason })?;
        episode.commit(executed, self.kept_len());
        Ok(Act::new(episode, known, table, &self.config))
    }

    /// Tokens of the past that an episode keeps, beside those that a GRU has yet to read.
    fn kept_len(&self) -> usize {
        self.config.method.latent.block_len().max(self.config.method.plan.obs_horizon)
    }

    /// What is told of what is wanted, normalized, and 1; zeros where nothing is.
    fn told(&self, options: &SamplerOptions) -> Vec<f32> {
        let method = &self.config.method;
        let width = if method.told.is_empty() { 0 } else { method.told_width() + 1 };
        if !options.tells() {
            return vec![0.0; width];
        }
        let mut told = Vec::with_capacity(width);
        for kind in &method.told {
            match kind {
                Told::Return => {
                    let units = self.config.units.returns.as_ref();
                    told.extend(options.told_return.iter().zip(units).map(|(value, units)| (value - units.mean[0]) / units.std[0]));
                }
                Told::Goal { columns } => {
                    let units = &self.config.units.normalizer.state;
                    let values = options.told_goal.iter().flatten().zip(columns);
                    told.extend(values.map(|(value, column)| (value - units.mean[*column]) / units.std[*column]));
                }
            }
        }
        told.push(1.0);
        told
    }

    /// The true context of an oracle's positions, normalized, one after the other; of others nothing, and nothing is taken. What is told last holds
    /// for what comes then.
    fn truth(&self, context: Option<&[Vec<f32>]>, actions: usize) -> Result<Vec<f32>, AgentError> {
        let invalid = |reason: String| AgentError::InvalidObservation { field: "context".into(), reason };
        let (Some((dim, future)), Some(units)) = (self.config.method.latent.truth(), &self.config.units.context) else {
            let untaken = || invalid("this checkpoint finds out by itself, or knows nothing of it: leave the field out".into());
            return if context.is_none() { Ok(Vec::new()) } else { Err(untaken()) };
        };
        let rows = context.unwrap_or_default();
        let positions = self.config.method.plan.horizon + actions - 1;
        let most = match future {
            TrueFuture::Held => 1,
            TrueFuture::Known => positions,
        };
        if !(1..=most).contains(&rows.len()) {
            let wanted = if most == 1 { "one row, the context of now".into() } else { format!("1 to {most} rows, from that of now on") };
            return Err(invalid(format!("has {} rows; this checkpoint is an oracle and takes {wanted}, of {dim} values each", rows.len())));
        }
        let mut truth = Vec::with_capacity(positions * dim);
        for (index, row) in rows.iter().enumerate() {
            let field = format!("context[{index}]");
            let normalized = units.normalize(&self.checked(&field, row, dim)?);
            let far = |(column, value): (usize, &f32)| known(&format!("{field}[{column}]"), row[column], *value);
            normalized.iter().enumerate().try_for_each(far)?;
            truth.extend(normalized);
        }
        let last = truth[truth.len() - dim..].to_vec();
        (rows.len()..positions).for_each(|_| truth.extend_from_slice(&last));
        Ok(truth)
    }

    /// One denoiser forward shared by all these acts, none of which is done; acts do not influence each other.
    ///
    /// # Errors
    /// [`AgentError::Tensor`] for a defect; an act whose output is not finite fails alone, at [`Agent::finish`].
    pub fn advance(&self, acts: &mut [Act]) -> Result<(), AgentError> {
        acts.iter_mut().for_each(|act| act.cut_again(&self.config, self.walk()));
        Ok(Ask::ORDER.into_iter().try_for_each(|ask| self.answer(ask, acts))?)
    }

    /// For an act that has no time for another evaluation: gives out what there is, and says whether there was anything: positions of the
    /// last estimate or, if there is none yet, of the window that the act before left, as it is. Then the act is done, and its chunk
    /// marked degraded.
    pub fn cut_short(&self, act: &mut Act) -> bool {
        act.cut_short(&self.config, self.walk())
    }

    /// The new episode and the chunk of an act that is done.
    ///
    /// # Errors
    /// [`AgentError::NonFinite`] if the network gave NaN or infinity.
    pub fn finish(&self, act: Act) -> Result<(Episode, Chunk), AgentError> {
        act.finish(&self.config, self.walk())
    }

    /// A whole act on its own: begin, advance until done, finish.
    ///
    /// # Errors
    /// As those three.
    pub fn act(&self, episode: &Episode, observation: &Observation) -> Result<(Episode, Chunk), AgentError> {
        let mut acts = [self.begin(episode, observation)?];
        while !acts[0].is_done() {
            self.advance(&mut acts)?;
        }
        let [act] = acts;
        self.finish(act)
    }

    /// The levels of inverse dynamics that are a diffusion.
    fn inverse_process(&self) -> Option<&Process> {
        self.inverse.as_ref()
    }

    /// Where an action is held, units of the networks.
    fn action_bounds(&self) -> &Bounds {
        &self.action_bounds
    }

    fn judge(&self) -> Judge<'_> {
        Judge { networks: &self.networks, config: &self.config, walk: self.walk() }
    }

    fn walk(&self) -> Walk<'_> {
        Walk { process: &self.process, columns: &self.columns, bounds: &self.bounds }
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
        let normalized = self.config.units.normalizer.state.normalize(&self.checked(field, raw, self.config.layout.state_dim)?);
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
