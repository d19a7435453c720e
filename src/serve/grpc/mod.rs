//! The gRPC face: messages in, messages out; the service does the rest.

mod convert;
pub mod endless;
mod status;

/// Code that the build makes from `proto/`.
#[allow(missing_docs, clippy::all, clippy::pedantic, clippy::too_many_lines)]
pub mod pb {
    tonic::include_proto!("ada_diffuser.v1");
    /// The protos themselves, for reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}

use crate::serve::{
    error::{ServiceError, Stage},
    gate::Gate,
    idle::Idle,
    request::{ActResult, Opened},
    service::Service,
};
use axum::{http::HeaderMap, middleware, response::Response as HttpResponse};
use futures_util::{Stream, StreamExt};
use pb::{agent_server, models_server};
use status::status;
use std::{pin::Pin, sync::Arc, time::Duration};
use tonic::{Code, Request, Response, Status, Streaming, metadata::MetadataMap, service::Routes};
use tonic_health::server::HealthReporter;

type Answer<T> = Result<Response<T>, Status>;

/// Both services over the one core.
#[derive(Clone)]
struct Face(Arc<Service>);

/// Why reflection could not be set up: a defect of the build.
pub use tonic_reflection::server::Error as ReflectionError;

/// The face as a router, and the reporter that sets its health.
///
/// # Errors
/// If the descriptors of the build are broken.
pub fn router(service: Arc<Service>) -> Result<(axum::Router, HealthReporter), ReflectionError> {
    let limit = service.config().limits.message_bytes_max;
    let face = Face(service);
    let (reporter, health) = tonic_health::server::health_reporter();
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pb::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let routes = Routes::new(agent_server::AgentServer::new(face.clone()).max_decoding_message_size(limit))
        .add_service(models_server::ModelsServer::new(face).max_decoding_message_size(limit))
        .add_service(health)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?);
    let router = routes.prepare().into_axum_router().layer(middleware::map_response(move |response| async move { ours(response, limit) }));
    Ok((router, reporter))
}

/// Sets the health of all services.
pub async fn report(reporter: &HealthReporter, serving: bool) {
    let status = if serving { tonic_health::ServingStatus::Serving } else { tonic_health::ServingStatus::NotServing };
    for name in ["", agent_server::SERVICE_NAME, models_server::SERVICE_NAME] {
        reporter.set_service_status(name, status).await;
    }
}

/// The stock server's own answers to unreadable messages, in the words of our table: OUT_OF_RANGE for an oversized one, INTERNAL for a malformed one.
fn ours(response: HttpResponse, limit: usize) -> HttpResponse {
    let text = |name: &str| response.headers().get(name).and_then(|value| value.to_str().ok());
    match text("grpc-status").and_then(|code| code.parse().ok()).map(Code::from_i32) {
        Some(code @ (Code::OutOfRange | Code::Internal)) if text("ada-reason").is_none() => status(&unreadable(code, limit)).into_http(),
        _ => response,
    }
}

fn unreadable(code: Code, limit: usize) -> ServiceError {
    match code {
        Code::OutOfRange => {
            metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
            ServiceError::TooLarge { what: "bytes of a message", limit }
        }
        Code::DeadlineExceeded => LATE,
        _ => ServiceError::invalid("message", "is not the protobuf message that belongs here"),
    }
}

const LATE: ServiceError = ServiceError::Deadline { stage: Stage::Admission };

/// What becomes of a request that is not complete in time.
pub fn late() -> Status {
    refuse(LATE)
}

fn refuse(error: ServiceError) -> Status {
    status(&error)
}

/// The call's own timeout, `grpc-timeout`: up to eight digits and a unit. When it is over the caller has hung up, whether or not we hear of it.
fn timeout(metadata: &MetadataMap) -> Option<Duration> {
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let value: u64 = (1..=8).contains(&digits.len()).then(|| digits.parse().ok())??;
    match unit {
        "H" => Some(Duration::from_secs(value * 3600)),
        "M" => Some(Duration::from_secs(value * 60)),
        "S" => Some(Duration::from_secs(value)),
        "m" => Some(Duration::from_millis(value)),
        "u" => Some(Duration::from_micros(value)),
        "n" => Some(Duration::from_nanos(value)),
        _ => None,
    }
}

fn opened(opened: Result<Opened, ServiceError>) -> Answer<pb::OpenSessionResponse> {
    let Opened { session, model, untold } = opened.map_err(refuse)?;
    let answer = pb::OpenSessionResponse { session: Some(convert::session(session)), model: Some(convert::model(&model)) };
    let mut response = Response::new(answer);
    untold.map(|untold| response.extensions_mut().insert(untold));
    Ok(response)
}

/// The connection that a request came by.
fn client<T>(request: &Request<T>) -> u64 {
    request.extensions().get::<Gate>().map_or(0, Gate::client)
}

#[tonic::async_trait]
impl agent_server::Agent for Face {
    type ActStreamStream = Pin<Box<dyn Stream<Item = Result<pb::ActResult, Status>> + Send>>;

    async fn open_session(&self, request: Request<pb::OpenSessionRequest>) -> Answer<pb::OpenSessionResponse> {
        let request = convert::open_request(request.into_inner()).map_err(refuse)?;
        opened(self.0.open(request).await)
    }

    async fn export_session(&self, request: Request<pb::ExportSessionRequest>) -> Answer<pb::ExportSessionResponse> {
        let pb::ExportSessionRequest { session_id } = request.into_inner();
        let record = self.0.export(&session_id).await.map_err(refuse)?;
        Ok(Response::new(pb::ExportSessionResponse { record }))
    }

    async fn import_session(&self, request: Request<pb::ImportSessionRequest>) -> Answer<pb::OpenSessionResponse> {
        opened(self.0.import(convert::import_request(request.into_inner())).await)
    }

    async fn fork_session(&self, request: Request<pb::ForkSessionRequest>) -> Answer<pb::OpenSessionResponse> {
        opened(self.0.fork(convert::fork_request(request.into_inner())).await)
    }

    async fn seal_session(&self, request: Request<pb::SealSessionRequest>) -> Answer<pb::SealSessionResponse> {
        let pb::SealSessionRequest { session_id } = request.into_inner();
        let (token, expires_in_ms) = self.0.seal(&session_id).await.map_err(refuse)?;
        Ok(Response::new(pb::SealSessionResponse { token, expires_in_ms }))
    }

    async fn resume_session(&self, request: Request<pb::ResumeSessionRequest>) -> Answer<pb::OpenSessionResponse> {
        opened(self.0.resume(&request.into_inner().token).await)
    }

    async fn act(&self, request: Request<pb::ActRequest>) -> Answer<pb::ActResponse> {
        let (timeout, client) = (timeout(request.metadata()), client(&request));
        let result = match convert::act_request(request.into_inner(), timeout, client) {
            Ok(act) => self.0.act(act).await,
            Err(misread) => misread.result,
        };
        Ok(Response::new(convert::act_response(&result.map_err(refuse)?)))
    }

    async fn act_stream(&self, request: Request<Streaming<pb::ActRequest>>) -> Answer<Self::ActStreamStream> {
        self.0.accepts().map_err(refuse)?;
        let (timeout, client) = (timeout(request.metadata()), client(&request));
        let limit = self.0.config().limits.message_bytes_max;
        let acts = request.into_inner().map(move |act| match act {
            Ok(act) => convert::act_request(act, timeout, client),
            Err(status) => Err(ActResult { session_id: String::new(), step: 0, result: Err(unreadable(status.code(), limit)) }),
        });
        let idle = |Idle| Status::unavailable("no act for connection.idle_timeout_ms: open another stream");
        let results = self.0.clone().act_stream(acts).map(move |result| result.map(convert::act_result).map_err(idle));
        Ok(Response::new(Box::pin(results)))
    }

    async fn act_batch(&self, request: Request<pb::ActBatchRequest>) -> Answer<pb::ActBatchResponse> {
        let (timeout, client) = (timeout(request.metadata()), client(&request));
        if timeout.is_some_and(|timeout| timeout.is_zero()) {
            return Err(refuse(ServiceError::Deadline { stage: Stage::Admission }));
        }
        let acts = request.into_inner().acts.into_iter().map(|act| convert::act_request(act, timeout, client));
        let results = self.0.act_batch(acts.collect()).await.map_err(refuse)?;
        Ok(Response::new(pb::ActBatchResponse { results: results.into_iter().map(convert::act_result).collect() }))
    }

    async fn reset_session(&self, request: Request<pb::ResetSessionRequest>) -> Answer<pb::ResetSessionResponse> {
        let session = self.0.reset(convert::reset_request(request.into_inner())).await.map_err(refuse)?;
        Ok(Response::new(pb::ResetSessionResponse { session: Some(convert::session(session)) }))
    }

    async fn get_session(&self, request: Request<pb::GetSessionRequest>) -> Answer<pb::GetSessionResponse> {
        let pb::GetSessionRequest { session_id } = request.into_inner();
        let session = self.0.get(&session_id).await.map_err(refuse)?;
        Ok(Response::new(pb::GetSessionResponse { session: Some(convert::session(session)) }))
    }

    async fn list_sessions(&self, request: Request<pb::ListSessionsRequest>) -> Answer<pb::ListSessionsResponse> {
        let page = self.0.list(&convert::list_request(request.into_inner()).map_err(refuse)?).await.map_err(refuse)?;
        let sessions = page.sessions.into_iter().map(convert::session).collect();
        Ok(Response::new(pb::ListSessionsResponse { sessions, next_page_token: page.next_page_token }))
    }

    async fn close_session(&self, request: Request<pb::CloseSessionRequest>) -> Answer<pb::CloseSessionResponse> {
        let pb::CloseSessionRequest { session_id } = request.into_inner();
        self.0.close(&session_id).await.map_err(refuse)?;
        Ok(Response::new(pb::CloseSessionResponse {}))
    }
}

#[tonic::async_trait]
impl models_server::Models for Face {
    async fn list(&self, request: Request<pb::ListModelsRequest>) -> Answer<pb::ListModelsResponse> {
        let pb::ListModelsRequest {} = request.into_inner();
        let models = self.0.models().map_err(refuse)?;
        Ok(Response::new(pb::ListModelsResponse { models: models.iter().map(convert::model).collect() }))
    }

    async fn get(&self, request: Request<pb::GetModelRequest>) -> Answer<pb::GetModelResponse> {
        let pb::GetModelRequest { model } = request.into_inner();
        let model = self.0.model(&model).map_err(refuse)?;
        Ok(Response::new(pb::GetModelResponse { model: Some(convert::model(&model)) }))
    }
}

/// Whether a method of this face is a stream, of requests or of answers.
pub fn is_stream(path: &str) -> bool {
    path.ends_with("/ActStream") || endless::is_endless(path)
}

/// Whether a request is meant for this face.
pub fn is_grpc(headers: &HeaderMap) -> bool {
    let kind = headers.get("content-type").map(axum::http::HeaderValue::as_bytes);
    kind.is_some_and(|kind| kind.starts_with(b"application/grpc"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts() {
        let parsed = |text: &str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", text.parse().unwrap());
            timeout(&metadata)
        };
        assert_eq!(parsed("2H"), Some(Duration::from_secs(7200)));
        assert_eq!(parsed("3M"), Some(Duration::from_secs(180)));
        assert_eq!(parsed("4S"), Some(Duration::from_secs(4)));
        assert_eq!(parsed("99999999m"), Some(Duration::from_millis(99_999_999)));
        assert_eq!(parsed("5u"), Some(Duration::from_micros(5)));
        assert_eq!(parsed("6n"), Some(Duration::from_nanos(6)));
        for wrong in ["", "m", "5", "5x", "-5m", "123456789m", "1.5S"] {
            assert_eq!(parsed(wrong), None, "{wrong}");
        }
    }
}
