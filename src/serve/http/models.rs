//! What clients get to know of a model: the protos' answer under the same names.

use crate::{
    model::{
        agent::Spec,
        config::{Missing, Trained},
        method::{Told, TrueFuture},
    },
    serve::{options::OptionsPatch, registry::Model},
};
use serde::Serialize;
use utoipa::ToSchema;

/// A model: what a client must know of it.
#[derive(Debug, Serialize, ToSchema)]
pub struct ModelAnswer {
    name: String,
    digest: String,
    is_default: bool,
    state_dim: usize,
    action_dim: usize,
    plan_horizon: usize,
    block_len: usize,
    obs_horizon: usize,
    latent_dim: usize,
    level_max: usize,
    action_low: Vec<f32>,
    action_high: Vec<f32>,
    sampler: OptionsPatch,
    refined: bool,
    trained: TrainedAnswer,
    /// What a session may tell of what it wants: all of it, or nothing.
    told: Vec<ToldAnswer>,
    /// How large the data's returns are, where the model knows of them.
    #[serde(skip_serializing_if = "Option::is_none")]
    returns: Option<ReturnsAnswer>,
    /// Whether it has a guide, which leads windows and chooses among candidates, and then says what the plan is worth.
    guide: bool,
    /// Of an oracle: what an observation's `context` has to tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    context: Option<ContextAnswer>,
}

/// Something that a session may tell of what it wants.
#[derive(Debug, Serialize, ToSchema)]
pub struct ToldAnswer {
    /// `return` or `goal`.
    kind: &'static str,
    /// With `goal`: the columns of the state that are meant.
    columns: Vec<usize>,
}

/// Returns of the data: discounted means of the rewards to come.
#[derive(Debug, Serialize, ToSchema)]
pub struct ReturnsAnswer {
    mean: f32,
    std: f32,
}

/// The true context, as an oracle has to be told it.
#[derive(Debug, Serialize, ToSchema)]
pub struct ContextAnswer {
    /// Values of each row.
    dim: usize,
    /// `held`: one row, that of now; `known`: those of the steps to come as well, 1 to `plan_horizon + action_horizon - 1` rows.
    future: &'static str,
}

impl From<&Told> for ToldAnswer {
    fn from(told: &Told) -> Self {
        match told {
            Told::Return => Self { kind: "return", columns: Vec::new() },
            Told::Goal { columns } => Self { kind: "goal", columns: columns.clone() },
        }
    }
}

impl From<(usize, TrueFuture)> for ContextAnswer {
    fn from((dim, future): (usize, TrueFuture)) -> Self {
        let future = match future {
            TrueFuture::Held => "held",
            TrueFuture::Known => "known",
        };
        Self { dim, future }
    }
}

/// What a session may ask for and leave out, because training did so too.
#[derive(Debug, Serialize, ToSchema)]
pub struct TrainedAnswer {
    action_horizons: Vec<usize>,
    sub_steps: Vec<usize>,
    missing: MissingAnswer,
    /// Whether histories crossed from one episode into the next, so that a reset may keep one, and an open bring one.
    sessions: bool,
}

/// Parts of an executed step that may be missing without being guessed.
#[derive(Debug, Serialize, ToSchema)]
pub struct MissingAnswer {
    state: bool,
    action: bool,
    reward: bool,
}

impl From<Trained> for TrainedAnswer {
    fn from(trained: Trained) -> Self {
        let Trained { action_horizons, sub_steps, missing: Missing { state, action, reward }, refined: _, sessions } = trained;
        Self { action_horizons, sub_steps, missing: MissingAnswer { state, action, reward }, sessions }
    }
}

impl From<&Model> for ModelAnswer {
    fn from(model: &Model) -> Self {
        let Model { name, agent, is_default } = model;
        let Spec {
            layout,
            plan_horizon,
            block_len,
            obs_horizon,
            latent_dim,
            level_max,
            action_low,
            action_high,
            sampler,
            trained,
            told,
            returns,
            guide,
            context,
            digest,
        } = agent.spec().clone();
        Self {
            name: name.to_string(),
            digest,
            is_default: *is_default,
            state_dim: layout.state_dim,
            action_dim: layout.action_dim,
            plan_horizon,
            block_len,
            obs_horizon,
            latent_dim,
            level_max,
            action_low,
            action_high,
            sampler: OptionsPatch::of(&sampler),
            refined: trained.refined,
            trained: trained.into(),
            told: told.iter().map(Into::into).collect(),
            returns: returns.map(|[mean, std]| ReturnsAnswer { mean, std }),
            guide,
            context: context.map(Into::into),
        }
    }
}
