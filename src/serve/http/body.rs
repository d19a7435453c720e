//! Reading a JSON body: bounded in bytes, in time and in depth, strict in its fields.

use crate::serve::{
    config::Config,
    error::{Part, ServiceError, Stage},
};
use axum::body::{Body, HttpBody, to_bytes};
use serde::de::DeserializeOwned;
use std::time::Duration;
use tokio::time::timeout;

/// The bytes of a body.
///
/// # Errors
/// `TooLarge`, or `Deadline` if it does not arrive in time.
pub async fn bytes(body: Body, config: &Config) -> Result<axum::body::Bytes, ServiceError> {
    let limit = config.limits.message_bytes_max;
    let too_large = || {
        metrics::counter!("ada_shed_total", "reason" => "TOO_LARGE").increment(1);
        ServiceError::TooLarge { what: "bytes of a message", limit }
    };
    if body.size_hint().lower() > limit as u64 {
        return Err(too_large());
    }
    let patience = Duration::from_millis(config.connection.body_read_timeout_ms);
    match timeout(patience, to_bytes(body, limit)).await {
        Ok(Ok(bytes)) => Ok(bytes),
        // The other cause, a connection that breaks, leaves nobody to answer.
        Ok(Err(_)) => Err(too_large()),
        Err(_) => Err(ServiceError::Deadline { stage: Stage::Admission }),
    }
}

/// A body as `T`.
///
/// # Errors
/// `Invalid` with the path of the field.
pub fn parse<T: DeserializeOwned>(bytes: &[u8], part: Part, config: &Config) -> Result<T, ServiceError> {
    let depth_max = config.limits.json_depth_max;
    if depth(bytes) > depth_max {
        return Err(ServiceError::invalid(part, "body", format!("is nested deeper than {depth_max}")));
    }
    let mut json = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(&mut json).map_err(|error| {
        let path = error.path().to_string();
        // "?" stands for a place that has no name yet.
        let field = path.trim_end_matches(['.', '?']);
        ServiceError::invalid(part, if field.is_empty() { "body" } else { field }, error.inner().to_string())
    })?;
    json.end().map_err(|error| ServiceError::invalid(part, "body", error.to_string()))?;
    Ok(value)
}

/// Deepest nesting of brackets outside of strings.
fn depth(bytes: &[u8]) -> usize {
    let (mut depth, mut deepest, mut in_string, mut escaped) = (0_usize, 0, false, false);
    for byte in bytes {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if in_string => escaped = true,
            b'"' => in_string = !in_string,
            b'[' | b'{' if !in_string => {
                depth += 1;
                deepest = deepest.max(depth);
            }
            b']' | b'}' if !in_string => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    deepest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths() {
        for (text, expected) in [("", 0), ("1", 0), ("[1,[2],{}]", 2), (r#"{"[[[":"\"[[["}"#, 1), ("]]]][", 1), (r#""\\"[["#, 2)] {
            assert_eq!(depth(text.as_bytes()), expected, "{text}");
        }
    }
}
