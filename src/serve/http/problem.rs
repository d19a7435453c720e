//! The error table of the REST face: RFC 9457 problems.

use crate::serve::error::ServiceError;
use axum::{
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use std::collections::BTreeMap;
use utoipa::{
    IntoResponses, ToSchema,
    openapi::{ContentBuilder, Ref, RefOr, ResponseBuilder, ResponsesBuilder},
};

const CONTENT_TYPE: &str = "application/problem+json";

/// An error as `application/problem+json`.
#[derive(Clone, Debug, Serialize, ToSchema)]
pub struct Problem {
    /// Always `about:blank`.
    r#type: &'static str,
    /// The status in words.
    title: &'static str,
    /// The HTTP status.
    status: u16,
    /// A fixed word to act on.
    reason: &'static str,
    /// For people.
    detail: String,
    /// Path of the offending field.
    #[serde(skip_serializing_if = "Option::is_none")]
    field: Option<String>,
    /// Where the session stands.
    #[serde(skip_serializing_if = "Option::is_none")]
    committed_step: Option<u64>,
    /// The episode that runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    episode: Option<u64>,
    /// Try the same again after this time.
    #[serde(skip_serializing_if = "Option::is_none")]
    retry_after_ms: Option<u64>,
    /// To find an internal error in the server's log.
    #[serde(skip_serializing_if = "Option::is_none")]
    error_id: Option<String>,
}

/// Status of an error.
pub fn status(error: &ServiceError) -> StatusCode {
    match error {
        ServiceError::Invalid { .. } => StatusCode::BAD_REQUEST,
        ServiceError::StepOutOfOrder { .. }
        | ServiceError::SessionBusy { .. }
        | ServiceError::EpisodeOver { .. }
        | ServiceError::TokenStale { .. } => StatusCode::CONFLICT,
        ServiceError::StepPayloadMismatch { .. } | ServiceError::PoisonStep { .. } => StatusCode::UNPROCESSABLE_ENTITY,
        ServiceError::SessionNotFound | ServiceError::ModelNotFound { .. } => StatusCode::NOT_FOUND,
        ServiceError::SessionExpired | ServiceError::SessionEvicted | ServiceError::TokenExpired | ServiceError::ModelGone { .. } => {
            StatusCode::GONE
        }
        ServiceError::TooLarge { .. } => StatusCode::PAYLOAD_TOO_LARGE,
        ServiceError::QueueFull { .. } | ServiceError::Quota { .. } => StatusCode::TOO_MANY_REQUESTS,
        ServiceError::Deadline { .. } => StatusCode::GATEWAY_TIMEOUT,
        ServiceError::StoreFull => StatusCode::INSUFFICIENT_STORAGE,
        ServiceError::Draining { .. } | ServiceError::NotReady { .. } | ServiceError::StoreUnavailable { .. } => {
            StatusCode::SERVICE_UNAVAILABLE
        }
        ServiceError::NonFiniteOutput { .. }
        | ServiceError::EnginePanic { .. }
        | ServiceError::Internal { .. }
        | ServiceError::StateCorrupt { .. } => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

impl Problem {
    /// A problem of the face itself.
    pub fn new(status: StatusCode, reason: &'static str, detail: &str) -> Self {
        Self {
            r#type: "about:blank",
            title: status.canonical_reason().unwrap_or("Error"),
            status: status.as_u16(),
            reason,
            detail: detail.to_owned(),
            field: None,
            committed_step: None,
            episode: None,
            retry_after_ms: None,
            error_id: None,
        }
    }

    /// One that passes by itself.
    pub fn after(self, retry_after_ms: u64) -> Self {
        Self { retry_after_ms: Some(retry_after_ms), ..self }
    }

    /// The whole answer in the text of HTTP/1.1, for whoever cannot have it by way of a request. It is the last on its connection.
    pub fn into_http1(self) -> Vec<u8> {
        let body = serde_json::to_string(&self).expect("a problem is plain data, or it is a bug");
        let retry_after = self.retry_after_s().map_or_else(String::new, |seconds| format!("retry-after: {seconds}\r\n"));
        let (status, title, len) = (self.status, self.title, body.len());
        let head = format!("HTTP/1.1 {status} {title}\r\ncontent-type: {CONTENT_TYPE}\r\ncontent-length: {len}\r\n{retry_after}");
        format!("{head}connection: close\r\n\r\n{body}").into_bytes()
    }

    fn retry_after_s(&self) -> Option<u64> {
        self.retry_after_ms.map(|ms| ms.div_ceil(1000))
    }
}

impl From<&ServiceError> for Problem {
    fn from(error: &ServiceError) -> Self {
        Self {
            field: error.field().map(str::to_owned),
            committed_step: error.committed_step(),
            episode: error.episode(),
            retry_after_ms: error.retry_after_ms(),
            error_id: error.error_id().map(|id| id.to_string()),
            ..Self::new(status(error), error.reason(), &error.to_string())
        }
    }
}

impl From<ServiceError> for Problem {
    fn from(error: ServiceError) -> Self {
        Self::from(&error)
    }
}

/// How every route announces it.
impl IntoResponses for Problem {
    fn responses() -> BTreeMap<String, RefOr<utoipa::openapi::Response>> {
        let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
        let response = ResponseBuilder::new().description("What went wrong; see the table of reasons").content(CONTENT_TYPE, content);
        ResponsesBuilder::new().response("default", response).build().into()
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let retry_after_s = self.retry_after_s();
        let mut response = (status, axum::Json(self)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(CONTENT_TYPE));
        if let Some(seconds) = retry_after_s {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_the_table() {
        for (error, _, http, reason) in ServiceError::table() {
            let problem = serde_json::to_value(Problem::from(&error)).unwrap();
            assert_eq!((problem["status"].as_u64(), problem["reason"].as_str()), (Some(http.into()), Some(reason)), "{error:?}");
            assert_eq!(problem["field"].as_str(), error.field(), "{error:?}");
            assert_eq!(problem["committed_step"].as_u64(), error.committed_step(), "{error:?}");
            assert_eq!(problem["episode"].as_u64(), error.episode(), "{error:?}");
            assert_eq!(problem.get("error_id").is_some(), http == 500 || reason == "POISON_STEP", "{error:?}");
            let response = Problem::from(&error).into_response();
            assert_eq!(response.status().as_u16(), http);
            assert_eq!(response.headers()["content-type"], "application/problem+json");
            let retry = response.headers().get("retry-after").map(|value| value.to_str().unwrap().to_owned());
            assert_eq!(retry, error.retry_after_ms().map(|_| "2".to_owned()), "seconds, rounded up: {error:?}");
        }
    }
}
