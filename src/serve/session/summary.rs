//! A session in numbers.

use super::{Handle, Session};
use crate::{model::options::SamplerOptions, serve::store::unix_ms};
use std::{sync::Arc, time::Duration};
use tokio::time::Instant;
use uuid::Uuid;

/// A session in numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Its id, for those who know it: no list tells it.
    pub id: Option<Uuid>,
    /// Its name in lists.
    pub handle: Handle,
    /// Name of the model.
    pub model: Arc<str>,
    /// Acts committed in the running episode.
    pub committed_step: u64,
    /// How often it was reset.
    pub episode: u64,
    /// What a short list leaves out.
    pub detail: Option<Detail>,
    /// Since it was opened.
    pub age: Duration,
    /// Since it was touched.
    pub idle: Duration,
    /// When idle for so long it expires.
    pub ttl: Duration,
    /// Memory of its episode.
    pub state_bytes: usize,
    /// Whether an act is in flight.
    pub busy: bool,
}

/// What takes room in a summary.
#[derive(Clone, Debug, PartialEq)]
pub struct Detail {
    /// Digest of the model.
    pub model_digest: String,
    /// Seed of the running episode.
    pub seed: u64,
    /// Options in force.
    pub options: SamplerOptions,
    /// Latent mean and log-variance after the last act.
    pub latent: Option<(Vec<f32>, Vec<f32>)>,
}

impl Session {
    /// The session in numbers, for whoever knows its id.
    pub fn summary(&self, now: Instant) -> Summary {
        Summary { id: Some(self.id), ..self.listed(true, now) }
    }

    /// The session in numbers, for everyone.
    pub fn listed(&self, in_full: bool, now: Instant) -> Summary {
        let slot = self.slot.lock();
        let episode = &slot.committed.episode;
        let detail = || Detail {
            model_digest: self.agent.spec().digest.clone(),
            seed: episode.seed(),
            options: self.options.clone(),
            latent: episode.latent().map(|(mean, log_var)| (mean.to_vec(), log_var.to_vec())),
        };
        Summary {
            id: None,
            handle: self.handle,
            model: self.model.clone(),
            committed_step: slot.committed.step,
            episode: slot.resets,
            detail: in_full.then(detail),
            age: Duration::from_millis(unix_ms().saturating_sub(self.opened)),
            idle: now.saturating_duration_since(slot.touched),
            ttl: self.ttl,
            state_bytes: episode.size_bytes(),
            busy: slot.flight.as_ref().is_some_and(|flight| flight.is_busy()),
        }
    }
}
