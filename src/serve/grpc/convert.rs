//! Messages <-> domain. Every message is destructured in full, so that a new field cannot be forgotten here.

use super::pb;
use crate::{
    model::{
        agent::{Chunk, Executed, Observation, Spec, Start},
        config::{Missing, Trained},
        method::{Told, TrueFuture},
        options::{LatentMode, SamplerOptions},
    },
    serve::{
        error::ServiceError,
        options::OptionsPatch,
        registry::Model,
        request::{ActRequest, ActResult, Acted, Caller, Face, ForkRequest, ImportRequest, ListRequest, OpenRequest, ResetRequest},
        session::{Answer, Detail, Summary, Timings},
    },
};
use std::time::Duration;

type Checked<T> = Result<T, ServiceError>;

pub fn open_request(request: pb::OpenSessionRequest) -> Checked<OpenRequest> {
    let pb::OpenSessionRequest { model, seed, options, ttl_ms, request_id, history } = request;
    let options = options.map_or(Ok(OptionsPatch::default()), options_patch)?;
    Ok(OpenRequest { model, seed, options, ttl_ms, request_id, history: steps(history) })
}

pub fn import_request(request: pb::ImportSessionRequest) -> ImportRequest {
    let pb::ImportSessionRequest { record, ttl_ms, request_id } = request;
    ImportRequest { record, ttl_ms, request_id }
}

pub fn fork_request(request: pb::ForkSessionRequest) -> ForkRequest {
    let pb::ForkSessionRequest { session_id, seed, ttl_ms, request_id, step, episode } = request;
    ForkRequest { session_id, seed, ttl_ms, request_id, step, episode }
}

pub fn reset_request(request: pb::ResetSessionRequest) -> ResetRequest {
    let pb::ResetSessionRequest { session_id, seed, keep_history, request_id, episode } = request;
    ResetRequest { session_id, seed, keep_history, request_id, episode }
}

fn options_patch(options: pb::SamplerOptions) -> Checked<OptionsPatch> {
    let pb::SamplerOptions {
        streaming,
        action_horizon,
        sub_steps,
        eta,
        temperature,
        kappa,
        latent,
        guidance_scale,
        guidance_samples,
        free_guidance_scale,
        told_return,
        told_goal,
        candidates,
        pick_temperature,
        picard_window,
        picard_tolerance,
    } = options;
    let size = |value: Option<u32>| value.map(|value| value as usize);
    Ok(OptionsPatch {
        streaming,
        action_horizon: size(action_horizon),
        sub_steps: size(sub_steps),
        eta,
        temperature,
        kappa: kappa.map(Into::into),
        latent: latent.map(latent_mode).transpose()?,
        guidance_scale,
        guidance_samples: size(guidance_samples),
        free_guidance_scale,
        told_return,
        told_goal: told_goal.map(vector),
        candidates: size(candidates),
        pick_temperature,
        picard_window: size(picard_window),
        picard_tolerance,
    })
}

impl From<OptionsPatch> for pb::SamplerOptions {
    fn from(options: OptionsPatch) -> Self {
        let OptionsPatch {
            streaming,
            action_horizon,
            sub_steps,
            eta,
            temperature,
            kappa,
            latent,
            guidance_scale,
            guidance_samples,
            free_guidance_scale,
            told_return,
            told_goal,
            candidates,
            pick_temperature,
            picard_window,
            picard_tolerance,
        } = options;
        let count = |value: Option<usize>| value.map(|value| u32::try_from(value).unwrap_or(u32::MAX));
        Self {
            streaming,
            action_horizon: count(action_horizon),
            sub_steps: count(sub_steps),
            eta,
            temperature,
            kappa: kappa.map(Into::into),
            latent: latent.map(|mode| latent_word(mode).into()),
            guidance_scale,
            guidance_samples: count(guidance_samples),
            free_guidance_scale,
            told_return,
            told_goal: told_goal.map(|values| pb::Vector { values }),
            candidates: count(candidates),
            pick_temperature,
            picard_window: count(picard_window),
            picard_tolerance,
        }
    }
}

fn sampler_options(options: &SamplerOptions) -> pb::SamplerOptions {
    OptionsPatch::of(options).into()
}

fn latent_word(mode: LatentMode) -> pb::LatentMode {
    match mode {
        LatentMode::Mean => pb::LatentMode::Mean,
        LatentMode::Sample => pb::LatentMode::Sample,
    }
}

fn latent_mode(mode: i32) -> Checked<LatentMode> {
    match pb::LatentMode::try_from(mode) {
        Ok(pb::LatentMode::Mean) => Ok(LatentMode::Mean),
        Ok(pb::LatentMode::Sample) => Ok(LatentMode::Sample),
        Ok(pb::LatentMode::Unspecified) | Err(_) => {
            Err(ServiceError::invalid("options.latent", format!("{mode} is neither LATENT_MODE_MEAN nor LATENT_MODE_SAMPLE")))
        }
    }
}

/// `timeout`: the call's own.
pub fn act_request(request: pb::ActRequest, timeout: Option<Duration>, client: u64) -> Result<ActRequest, ActResult> {
    let pb::ActRequest { session_id, step, observation, deadline_ms, want_planned_states, episode } = request;
    let deadline = deadline_ms.map(|ms| Duration::from_millis(ms.into()));
    let missing = || ServiceError::invalid("observation", "is missing");
    match observation.ok_or_else(missing).and_then(self::observation) {
        Ok(observation) => {
            let caller = Caller { face: Face::Grpc, client };
            Ok(ActRequest { session_id, step, episode, observation, deadline, timeout, want_planned_states, caller })
        }
        Err(error) => Err(ActResult { session_id, step, result: Err(error) }),
    }
}

fn observation(observation: pb::Observation) -> Checked<Observation> {
    let pb::Observation { state, executed, nothing_executed, context } = observation;
    let context = context.map(|context| rows("observation.context", &context)).transpose()?;
    Ok(Observation { state, executed: steps(executed), nothing_executed, context })
}

fn steps(steps: Vec<pb::Executed>) -> Vec<Executed> {
    let step = |pb::Executed { state, action, reward }| Executed { state: state.map(vector), action: action.map(vector), reward };
    steps.into_iter().map(step).collect()
}

fn vector(pb::Vector { values }: pb::Vector) -> Vec<f32> {
    values
}

/// The rows of a matrix that holds what it says.
fn rows(field: &str, matrix: &pb::Matrix) -> Checked<Vec<Vec<f32>>> {
    let pb::Matrix { values, rows, columns } = matrix;
    let holds = u64::from(*rows) * u64::from(*columns) == values.len() as u64 && (*columns > 0 || *rows == 0);
    let wrong = || ServiceError::invalid(field, format!("has {} values in {rows} rows of {columns}", values.len()));
    if holds { Ok(values.chunks((*columns as usize).max(1)).map(<[f32]>::to_vec).collect()) } else { Err(wrong()) }
}

pub fn list_request(request: pb::ListSessionsRequest) -> Checked<ListRequest> {
    let pb::ListSessionsRequest { page_size, page_token, model, view } = request;
    let in_full = match pb::SessionView::try_from(view) {
        Ok(pb::SessionView::Unspecified | pb::SessionView::Basic) => false,
        Ok(pb::SessionView::Full) => true,
        Err(_) => return Err(ServiceError::invalid("view", format!("{view} is neither SESSION_VIEW_BASIC nor SESSION_VIEW_FULL"))),
    };
    Ok(ListRequest { page_size: page_size as usize, page_token, model, in_full })
}

pub fn act_response(acted: &Acted) -> pb::ActResponse {
    let Acted { answer, replayed, want_planned_states } = acted;
    let Answer { session, step, chunk, timings, model, model_digest } = &**answer;
    let Chunk {
        actions,
        planned_states,
        latent_mean,
        latent_log_var,
        predicted_state,
        evaluations,
        passes,
        value,
        value_spread,
        start,
        degraded,
    } = &**chunk;
    let (start, renoised_rungs) = self::start(*start);
    pb::ActResponse {
        session_id: session.to_string(),
        step: *step,
        replayed: *replayed,
        actions: Some(matrix(actions)),
        planned_states: want_planned_states.then(|| matrix(planned_states)),
        latent_mean: latent_mean.clone(),
        latent_log_var: latent_log_var.clone(),
        predicted_state: predicted_state.clone(),
        evaluations: *evaluations,
        start: start.into(),
        renoised_rungs,
        timings: Some(self::timings(timings)),
        model: model.to_string(),
        model_digest: model_digest.clone(),
        degraded: *degraded,
        passes: *passes,
        value: *value,
        value_spread: *value_spread,
    }
}

fn start(start: Start) -> (pb::Start, u32) {
    match start {
        Start::Cold => (pb::Start::Cold, 0),
        Start::Warm => (pb::Start::Warm, 0),
        Start::Renoised(rungs) => (pb::Start::Renoised, rungs),
    }
}

fn matrix(rows: &[Vec<f32>]) -> pb::Matrix {
    let columns = rows.first().map_or(0, Vec::len);
    pb::Matrix { values: rows.concat(), rows: rows.len() as u32, columns: columns as u32 }
}

fn timings(timings: &Timings) -> pb::Timings {
    let Timings { queue, compute, commit, total } = timings;
    let us = |time: &Duration| time.as_micros() as u64;
    pb::Timings { queue_us: us(queue), compute_us: us(compute), commit_us: us(commit), total_us: us(total) }
}

pub fn act_result(result: ActResult) -> pb::ActResult {
    let ActResult { session_id, step, result } = result;
    let result = match result {
        Ok(acted) => pb::act_result::Result::Response(act_response(&acted)),
        Err(error) => pb::act_result::Result::Error(self::error(&error)),
    };
    pb::ActResult { session_id, step, result: Some(result) }
}

fn error(error: &ServiceError) -> pb::Error {
    pb::Error {
        code: super::status::code(error).into(),
        reason: error.reason().to_owned(),
        message: error.to_string(),
        field: error.field().unwrap_or_default().to_owned(),
        committed_step: error.committed_step(),
        retry_after_ms: error.retry_after_ms(),
        error_id: error.error_id().map(|id| id.to_string()).unwrap_or_default(),
        episode: error.episode(),
    }
}

pub fn session(summary: Summary) -> pb::Session {
    let Summary { id, handle, model, committed_step, episode, detail, age, idle, ttl, state_bytes, busy } = summary;
    let (model_digest, seed, options, latent) = match detail {
        Some(Detail { model_digest, seed, options, latent }) => (model_digest, seed, Some(sampler_options(&options)), latent),
        None => Default::default(),
    };
    let (latent_mean, latent_log_var) = latent.unwrap_or_default();
    let ms = |time: Duration| time.as_millis() as u64;
    pb::Session {
        session_id: id.map(|id| id.to_string()).unwrap_or_default(),
        model: model.to_string(),
        model_digest,
        seed,
        committed_step,
        episode,
        options,
        latent_mean,
        latent_log_var,
        age_ms: ms(age),
        idle_ms: ms(idle),
        ttl_ms: ms(ttl),
        state_bytes: state_bytes as u64,
        busy,
        handle: handle.to_string(),
    }
}

pub fn model(model: &Model) -> pb::Model {
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
    } = agent.spec();
    pb::Model {
        name: name.to_string(),
        digest: digest.clone(),
        is_default: *is_default,
        state_dim: layout.state_dim as u32,
        action_dim: layout.action_dim as u32,
        plan_horizon: *plan_horizon as u32,
        block_len: *block_len as u32,
        obs_horizon: *obs_horizon as u32,
        latent_dim: *latent_dim as u32,
        level_max: *level_max as u32,
        action_low: action_low.clone(),
        action_high: action_high.clone(),
        sampler: Some(sampler_options(sampler)),
        refined: trained.refined,
        trained: Some(self::trained(trained)),
        told: told.iter().map(self::told).collect(),
        returns: returns.map(|[mean, std]| pb::Returns { mean, std }),
        guide: *guide,
        context: context.map(true_context),
    }
}

fn told(told: &Told) -> pb::Told {
    match told {
        Told::Return => pb::Told { kind: pb::ToldKind::Return.into(), columns: Vec::new() },
        Told::Goal { columns } => {
            pb::Told { kind: pb::ToldKind::Goal.into(), columns: columns.iter().map(|column| *column as u32).collect() }
        }
    }
}

fn true_context((dim, future): (usize, TrueFuture)) -> pb::TrueContext {
    let future = match future {
        TrueFuture::Held => pb::TrueFuture::Held,
        TrueFuture::Known => pb::TrueFuture::Known,
    };
    pb::TrueContext { dim: dim as u32, future: future.into() }
}

fn trained(trained: &Trained) -> pb::Trained {
    let Trained { action_horizons, sub_steps, missing: Missing { state, action, reward }, refined: _, sessions } = trained;
    let lengths = |lengths: &[usize]| lengths.iter().map(|length| *length as u32).collect();
    pb::Trained {
        action_horizons: lengths(action_horizons),
        sub_steps: lengths(sub_steps),
        missing: Some(pb::Missing { state: *state, action: *action, reward: *reward }),
        sessions: *sessions,
    }
}
