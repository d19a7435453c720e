//! The error table of the gRPC face: code and trailers.

use crate::serve::error::ServiceError;
use tonic::{
    Code, Status,
    metadata::{MetadataMap, MetadataValue},
};

/// Code of an error.
pub fn code(error: &ServiceError) -> Code {
    match error {
        ServiceError::Invalid { .. } => Code::InvalidArgument,
        ServiceError::StepOutOfOrder { .. }
        | ServiceError::SessionBusy { .. }
        | ServiceError::EpisodeOver { .. }
        | ServiceError::TokenStale { .. } => Code::Aborted,
        ServiceError::StepPayloadMismatch { .. } | ServiceError::PoisonStep { .. } | ServiceError::TokenExpired => Code::FailedPrecondition,
        ServiceError::SessionNotFound
        | ServiceError::SessionExpired
        | ServiceError::SessionEvicted
        | ServiceError::ModelNotFound { .. }
        | ServiceError::ModelGone { .. } => Code::NotFound,
        ServiceError::TooLarge { .. } | ServiceError::QueueFull { .. } | ServiceError::Quota { .. } | ServiceError::StoreFull => {
            Code::ResourceExhausted
        }
        ServiceError::StateCorrupt { .. } => Code::DataLoss,
        ServiceError::Deadline { .. } => Code::DeadlineExceeded,
        ServiceError::Draining { .. } | ServiceError::NotReady { .. } | ServiceError::StoreUnavailable { .. } => Code::Unavailable,
        ServiceError::NonFiniteOutput { .. } | ServiceError::EnginePanic { .. } | ServiceError::Internal { .. } => Code::Internal,
    }
}

/// The whole status: code, message, and what a program acts on as trailers.
pub fn status(error: &ServiceError) -> Status {
    let mut trailers = MetadataMap::new();
    trailers.insert("ada-reason", MetadataValue::from_static(error.reason()));
    let mut put = |key: &'static str, value: Option<String>| {
        // A field path may echo what a client sent; what is no header value is left out.
        if let Some(value) = value.and_then(|value| MetadataValue::try_from(value).ok()) {
            trailers.insert(key, value);
        }
    };
    put("ada-field", error.field().map(str::to_owned));
    put("ada-committed-step", error.committed_step().map(|step| step.to_string()));
    put("ada-episode", error.episode().map(|episode| episode.to_string()));
    put("grpc-retry-pushback-ms", error.retry_after_ms().map(|ms| ms.to_string()));
    put("ada-error-id", error.error_id().map(|id| id.to_string()));
    Status::with_metadata(code(error), error.to_string(), trailers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_the_table() {
        for (error, grpc, _, reason) in ServiceError::table() {
            let status = status(&error);
            let trailer = |name: &str| status.metadata().get(name).map(|value| value.to_str().unwrap().to_owned());
            assert_eq!((i32::from(status.code()), trailer("ada-reason").as_deref()), (grpc, Some(reason)), "{error:?}");
            assert_eq!(trailer("ada-field").as_deref(), error.field(), "{error:?}");
            assert_eq!(trailer("ada-committed-step"), error.committed_step().map(|_| "3".to_owned()), "{error:?}");
            assert_eq!(trailer("ada-episode"), error.episode().map(|_| "2".to_owned()), "{error:?}");
            assert_eq!(trailer("grpc-retry-pushback-ms"), error.retry_after_ms().map(|_| "1500".to_owned()), "{error:?}");
            assert_eq!(trailer("ada-error-id").is_some(), [13, 15].contains(&grpc) || reason == "POISON_STEP", "{error:?}");
        }
    }
}
