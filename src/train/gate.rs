//! What the latent must have found before a run goes on.
//!
//! Now and then a run codes the state change instead of the context, or loses one axis of it (the ELBO is not
//! identifying from every initialisation), so the probe decides whether it counts; if not, it starts anew from another seed.

use super::{
    Task,
    dataset::Sides,
    probe::{Held, Subjects, held, latent_probe, places, probed},
    recipe::stages::Gate,
    ridge::Table,
};
use crate::model::latent::{Evidence, LatentModel};
use anyhow::{Result, anyhow};
use serde::Serialize;

/// Places of each side that the gate's probe uses.
const ROWS: usize = 6000;

/// What the gate saw.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Probed {
    /// Standardised error without the successor.
    pub filter: f64,
    /// Standardised error with the successor's state; none of a belief that is held, for it does not wait for one.
    pub successor_state: Option<f64>,
}

impl Probed {
    /// Whether both errors are within the bounds.
    pub fn passes(&self, gate: &Gate) -> bool {
        self.filter <= gate.filter && self.successor_state.is_none_or(|error| error <= gate.successor_state)
    }
}

/// Probes the latent model at the recipe's block length.
///
/// # Errors
/// If the data have no context, or a tensor operation fails.
pub fn probe(task: &Task, latent: &LatentModel) -> Result<Probed> {
    let episodes = episodes(task);
    let subjects = subjects(&episodes);
    let error = |evidence| -> Result<f64> { Ok(latent_probe(latent, &subjects, evidence, task.looks(), &[0])?[0].errors.whole) };
    let successor_state = probed(latent).contains(&Evidence::SuccessorState).then(|| error(Evidence::SuccessorState)).transpose()?;
    Ok(Probed { filter: error(Evidence::Filter)?, successor_state })
}

/// What there is to find for a model that looks back so far: the raw tokens' own errors at the probe's places.
///
/// # Errors
/// If an episode cannot be read.
pub fn held_by_tokens(task: &Task) -> Result<Held> {
    Ok(held(&subjects(&episodes(task)), task.looks())?)
}

/// What the latent is learned from is what it is judged on.
fn episodes(task: &Task) -> Sides {
    task.split.episodes.only(task.recipe.losses.elbo.as_ref().map(|loss| loss.episodes).unwrap_or_default())
}

fn subjects(Sides { train, held_out }: &Sides) -> Subjects<'_> {
    Subjects { train, held_out, rows_max: ROWS }
}

/// Whether the contexts that the gate holds the latent against differ at all: an error in units of their variance needs one.
///
/// # Errors
/// If rows are kept in a file and it cannot be read.
pub fn contexts_vary(task: &Task) -> Result<bool> {
    let episodes = &episodes(task).held_out;
    let mut truth = Table::new(episodes.first().map_or(0, |episode| episode.context_dim));
    for (episode, t) in places(episodes, ROWS).into_iter().filter(|(_, t)| *t >= task.config.method.latent.block_len()) {
        truth.values.extend(episodes[episode].context(t)?.iter().map(|value| f64::from(*value)));
    }
    Ok(truth.varies())
}

/// What a user reads when no try has passed.
pub fn failure(stage: &str, gate: &Gate, probes: &[serde_json::Value]) -> anyhow::Error {
    anyhow!(
        "stage {stage} did not pass its gate (filter {}, successor_state {}) in {} tries: {}; more data or steps, or a wider gate, may help",
        gate.filter,
        gate.successor_state,
        gate.tries,
        serde_json::Value::from(probes)
    )
}
