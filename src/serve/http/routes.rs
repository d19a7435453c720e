//! The routes and their handlers; `/openapi.json` is made from them.

use super::{
    Gate, State,
    answer::{ActAnswer, BatchAnswer, ExportAnswer, ManyModels, ManySessions, OneModel, OneSession, OpenAnswer, SealAnswer},
    body::{bytes, parse, unfitting},
    json::{ActBody, BatchBody, ForkBody, ImportBody, ListQuery, OpenBody, ResetBody, ResumeBody, View},
    problem::Problem,
    stream,
};
use crate::serve::{
    error::ServiceError,
    guard,
    request::{ActResult, ListRequest, Opened},
};
use axum::{
    Extension, Json, Router,
    body::Body,
    extract::{
        FromRequestParts, MatchedPath, Path, Query, Request, State as Shared, WebSocketUpgrade, rejection::QueryRejection,
        ws::rejection::WebSocketUpgradeRejection,
    },
    http::{HeaderValue, StatusCode, header, request::Parts},
    middleware::{self, Next},
    response::{IntoResponse, Response},
    routing,
};
use hyper::body::Body as _;
use serde::de::DeserializeOwned;
use utoipa::OpenApi;
use utoipa_axum::{router::OpenApiRouter, routes};

/// Bytes that a WebSocket reads at a time; larger messages come in several.
const READ_BUFFER_LEN: usize = 8 << 10;

type Answer<T> = Result<Json<T>, Problem>;

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Ada-Diffuser",
        description = "The verbs of an episode; see clients/http/README.md. Errors are application/problem+json."
    ),
    components(schemas(Problem))
)]
struct Api;

fn documented() -> OpenApiRouter<State> {
    OpenApiRouter::with_openapi(Api::openapi())
        .routes(routes!(open_session, list_sessions))
        .routes(routes!(get_session, close_session))
        .routes(routes!(reset_session))
        .routes(routes!(export_session))
        .routes(routes!(import_session))
        .routes(routes!(fork_session))
        .routes(routes!(seal_session))
        .routes(routes!(resume_session))
        .routes(routes!(act))
        .routes(routes!(act_stream))
        .routes(routes!(act_batch))
        .routes(routes!(list_models))
        .routes(routes!(get_model))
        .routes(routes!(livez))
        .routes(routes!(readyz))
        .routes(routes!(metrics))
}

/// The description of the face, as `/openapi.json` gives it.
pub fn openapi() -> utoipa::openapi::OpenApi {
    documented().into_openapi()
}

/// The face as a router.
pub fn router(state: State) -> Router {
    let (router, api) = documented().split_for_parts();
    router
        .route("/openapi.json", routing::get(move || async move { Json(api) }))
        .fallback(|| async { Problem::new(StatusCode::NOT_FOUND, "NOT_FOUND", "no such path; see /openapi.json") })
        .method_not_allowed_fallback(|| async {
            Problem::new(StatusCode::METHOD_NOT_ALLOWED, "METHOD_NOT_ALLOWED", "this path takes other methods; see /openapi.json")
        })
        .layer(middleware::from_fn(refuse_other_bodies))
        .layer(middleware::from_fn(name_route))
        .with_state(state)
}

/// Hands the matched route up to the listener, as a label for its metrics.
async fn name_route(route: Option<MatchedPath>, request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    if let Some(route) = route {
        response.extensions_mut().insert(route);
    }
    response
}

/// Bodies are JSON and say so, which a page cannot do unasked (see [`guard`]); they are read as they come, and one that is compressed is refused
/// with the one encoding that is understood (RFC 9110, 15.5.16).
async fn refuse_other_bodies(request: Request, next: Next) -> Response {
    const IDENTITY: HeaderValue = HeaderValue::from_static("identity");
    let headers = request.headers();
    if !headers.get_all(header::CONTENT_ENCODING).iter().all(|encoding| encoding.is_empty() || encoding == IDENTITY) {
        let problem = Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "ENCODING_UNSUPPORTED", "send the body without content-encoding");
        return ([(header::ACCEPT_ENCODING, IDENTITY)], problem).into_response();
    }
    let is_empty = request.body().is_end_stream() || request.body().size_hint().exact() == Some(0);
    if is_empty || guard::is_json(headers) {
        return next.run(request).await;
    }
    Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "MEDIA_TYPE_UNSUPPORTED", "send JSON, with content-type: application/json")
        .into_response()
}

/// The name in a path; what is not even text is refused like any other wrong field.
struct Named(String);

impl<S: Send + Sync> FromRequestParts<S> for Named {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let Path(name) = Path::from_request_parts(parts, state).await.map_err(|error| ServiceError::invalid("path", error.body_text()))?;
        Ok(Self(name))
    }
}

/// Names the parameter at fault, which axum keeps inside.
fn misread_query(rejection: &QueryRejection) -> ServiceError {
    type AtParameter = serde_path_to_error::Error<serde::de::value::Error>;
    let mut causes = std::iter::successors(std::error::Error::source(rejection), |cause| cause.source());
    match causes.find_map(|cause| cause.downcast_ref::<AtParameter>()) {
        Some(error) => unfitting(&error.path().to_string(), &error.inner().to_string()),
        None => ServiceError::invalid("query", rejection.body_text()),
    }
}

async fn read<T: DeserializeOwned>(body: Body, state: &State) -> Result<T, Problem> {
    Ok(parse(&bytes(body, state.service.config()).await?)?)
}

/// A body that may be left out.
async fn read_if_any<T: DeserializeOwned + Default>(body: Body, state: &State) -> Result<T, Problem> {
    let bytes = bytes(body, state.service.config()).await?;
    if bytes.is_empty() { Ok(T::default()) } else { Ok(parse(&bytes)?) }
}

/// OpenSession
#[utoipa::path(post, path = "/v1/sessions", request_body = OpenBody, responses((status = 201, description = "The session and its model", body = OpenAnswer), Problem))]
async fn open_session(Shared(state): Shared<State>, body: Body) -> Result<Response, Problem> {
    let request: OpenBody = read(body, &state).await?;
    Ok(opened(state.service.open(request.into()).await?))
}

fn opened(Opened { session, model, untold }: Opened) -> Response {
    let answer = (StatusCode::CREATED, Json(OpenAnswer { session: session.into(), model: (&model).into() }));
    (untold.map(Extension), answer).into_response()
}

/// ExportSession
#[utoipa::path(get, path = "/v1/sessions/{id}/export", params(("id" = String, Path)),
    responses((status = 200, description = "The session as bytes; a body for ImportSession as it is", body = ExportAnswer), Problem))]
async fn export_session(Shared(state): Shared<State>, Named(id): Named) -> Answer<ExportAnswer> {
    Ok(Json(ExportAnswer::of(&state.service.export(&id).await?)))
}

/// ImportSession
#[utoipa::path(post, path = "/v1/sessions:import", request_body = ImportBody, responses((status = 201, description = "The session, and its model", body = OpenAnswer), Problem))]
async fn import_session(Shared(state): Shared<State>, body: Body) -> Result<Response, Problem> {
    let request: ImportBody = read(body, &state).await?;
    Ok(opened(state.service.import(request.try_into()?).await?))
}

/// SealSession
#[utoipa::path(post, path = "/v1/sessions/{id}/seal", params(("id" = String, Path)),
    responses((status = 200, description = "A token to resume it from, and for how long", body = SealAnswer), Problem))]
async fn seal_session(Shared(state): Shared<State>, Named(id): Named) -> Answer<SealAnswer> {
    Ok(Json(SealAnswer::of(state.service.seal(&id).await?)))
}

/// ResumeSession
#[utoipa::path(post, path = "/v1/sessions:resume", request_body = ResumeBody, responses((status = 201, description = "The session, and its model", body = OpenAnswer), Problem))]
async fn resume_session(Shared(state): Shared<State>, body: Body) -> Result<Response, Problem> {
    let body: ResumeBody = read(body, &state).await?;
    Ok(opened(state.service.resume(&body.into_token()?).await?))
}

/// ForkSession
#[utoipa::path(post, path = "/v1/sessions/{id}/fork", params(("id" = String, Path)), request_body = ForkBody,
    responses((status = 201, description = "The new session, and its model", body = OpenAnswer), Problem))]
async fn fork_session(Shared(state): Shared<State>, Named(id): Named, body: Body) -> Result<Response, Problem> {
    let body: ForkBody = read_if_any(body, &state).await?;
    Ok(opened(state.service.fork(body.into_request(id)).await?))
}

/// ListSessions
#[utoipa::path(get, path = "/v1/sessions", params(ListQuery), responses((status = 200, description = "A page of sessions, by handle", body = ManySessions), Problem))]
async fn list_sessions(Shared(state): Shared<State>, query: Result<Query<ListQuery>, QueryRejection>) -> Answer<ManySessions> {
    let Query(query) = query.map_err(|error| misread_query(&error))?;
    let ListQuery { page_size, page_token, model, view } = query;
    let page = state.service.list(&ListRequest { page_size, page_token, model, in_full: view == View::Full }).await?;
    let sessions = page.sessions.into_iter().map(Into::into).collect();
    Ok(Json(ManySessions { sessions, next_page_token: page.next_page_token }))
}

/// GetSession
#[utoipa::path(get, path = "/v1/sessions/{id}", params(("id" = String, Path)), responses((status = 200, description = "The session", body = OneSession), Problem))]
async fn get_session(Shared(state): Shared<State>, Named(id): Named) -> Answer<OneSession> {
    Ok(Json(OneSession { session: state.service.get(&id).await?.into() }))
}

/// CloseSession
#[utoipa::path(delete, path = "/v1/sessions/{id}", params(("id" = String, Path)), responses((status = 204, description = "It is closed"), Problem))]
async fn close_session(Shared(state): Shared<State>, Named(id): Named) -> Result<StatusCode, Problem> {
    state.service.close(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// ResetSession
#[utoipa::path(post, path = "/v1/sessions/{id}/reset", params(("id" = String, Path)), request_body = ResetBody,
    responses((status = 200, description = "The session", body = OneSession), Problem))]
async fn reset_session(Shared(state): Shared<State>, Named(id): Named, body: Body) -> Answer<OneSession> {
    let body: ResetBody = read_if_any(body, &state).await?;
    let session = state.service.reset(body.into_request(id)).await?;
    Ok(Json(OneSession { session: session.into() }))
}

/// Act
#[utoipa::path(post, path = "/v1/sessions/{id}/act", params(("id" = String, Path)), request_body = ActBody,
    responses((status = 200, description = "The action chunk, and what is known about it", body = ActAnswer), Problem))]
async fn act(Shared(state): Shared<State>, Named(id): Named, Extension(gate): Extension<Gate>, body: Body) -> Answer<ActAnswer> {
    let body: ActBody = read(body, &state).await?;
    if body.session_id.as_ref().is_some_and(|other| *other != id) {
        return Err(ServiceError::invalid("session_id", "differs from the path").into());
    }
    Ok(Json((&state.service.act(body.into_request(id, gate.client())).await?).into()))
}

/// ActStream, a WebSocket: each text message is an act, each answer a result
#[utoipa::path(get, path = "/v1/sessions/{id}/stream", params(("id" = String, Path)), responses((status = 101, description = "A WebSocket"), Problem))]
async fn act_stream(
    Shared(state): Shared<State>,
    Named(id): Named,
    Extension(gate): Extension<Gate>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|error| ServiceError::invalid("headers", error.body_text()))?;
    state.service.accepts()?;
    state.service.get(&id).await?;
    let limit = state.service.config().limits.message_bytes_max;
    // The stock buffer is allocated at once, 128 KiB for each socket, whether or not it ever says a word.
    let upgrade = upgrade.max_message_size(limit).max_frame_size(limit).read_buffer_size(READ_BUFFER_LEN);
    Ok(upgrade.on_upgrade(move |socket| stream::serve(socket, state, id, gate)))
}

/// ActBatch
#[utoipa::path(post, path = "/v1/act:batch", request_body = BatchBody, responses((status = 200, description = "An answer or an error for each act, in their order", body = BatchAnswer), Problem))]
async fn act_batch(Shared(state): Shared<State>, Extension(gate): Extension<Gate>, body: Body) -> Answer<BatchAnswer> {
    let body: BatchBody = read(body, &state).await?;
    let acts = body.acts.into_iter().map(|mut act| {
        let session_id = act.session_id.take();
        let act = act.into_request(session_id.clone().unwrap_or_default(), gate.client());
        let missing = || ServiceError::invalid("session_id", "is missing");
        if session_id.is_some() { Ok(act) } else { Err(ActResult { session_id: String::new(), step: act.step, result: Err(missing()) }) }
    });
    let results = state.service.act_batch(acts.collect()).await?;
    Ok(Json(BatchAnswer { results: results.into_iter().map(Into::into).collect() }))
}

/// Models.List
#[utoipa::path(get, path = "/v1/models", responses((status = 200, description = "All models, by name", body = ManyModels), Problem))]
async fn list_models(Shared(state): Shared<State>) -> Answer<ManyModels> {
    Ok(Json(ManyModels { models: state.service.models()?.iter().map(Into::into).collect() }))
}

/// Models.Get
#[utoipa::path(get, path = "/v1/models/{name}", params(("name" = String, Path, description = "name or name@digest")),
    responses((status = 200, description = "The model", body = OneModel), Problem))]
async fn get_model(Shared(state): Shared<State>, Named(name): Named) -> Answer<OneModel> {
    Ok(Json(OneModel { model: (&state.service.model(&name)?).into() }))
}

/// Whether the process works: its engine shows signs of life
#[utoipa::path(get, path = "/livez", responses((status = 200, description = "It works", body = String), (status = 503, description = "The engine is silent", body = String)))]
async fn livez(Shared(state): Shared<State>) -> Response {
    if state.service.is_alive() { "ok\n".into_response() } else { (StatusCode::SERVICE_UNAVAILABLE, "engine is silent\n").into_response() }
}

/// Whether it takes work: models loaded, not draining
#[utoipa::path(get, path = "/readyz", responses((status = 200, description = "It takes work", body = String), (status = 503, description = "Why not", body = String)))]
async fn readyz(Shared(state): Shared<State>) -> Response {
    match state.service.ready() {
        Ok(()) => "ok\n".into_response(),
        Err(error) => (StatusCode::SERVICE_UNAVAILABLE, format!("{error}\n")).into_response(),
    }
}

/// Metrics as Prometheus text
#[utoipa::path(get, path = "/metrics", responses((status = 200, description = "The text format of Prometheus", body = String)))]
async fn metrics(Shared(state): Shared<State>) -> Response {
    state.service.refresh_gauges();
    ([("content-type", "text/plain; version=0.0.4")], state.metrics.render()).into_response()
}
