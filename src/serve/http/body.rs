//! Reading a JSON body: bounded in bytes and in time, in depth by serde_json itself, strict in its fields.

use super::strict::Strict;
use crate::serve::{
    config::Config,
    error::{ServiceError, Stage},
};
use axum::body::{Body, HttpBody, to_bytes};
use http_body_util::LengthLimitError;
use serde::de::{DeserializeOwned, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::{Value, error::Category};
use std::{error::Error, fmt, time::Duration};
use tokio::time::timeout;

/// The bytes of a body.
///
/// # Errors
/// `TooLarge`; `Deadline` if it does not arrive in time; `Invalid` if it breaks off, or its chunks are none.
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
        Ok(Err(error)) if error.source().is_some_and(|cause| cause.is::<LengthLimitError>()) => Err(too_large()),
        Ok(Err(_)) => Err(ServiceError::invalid("body", "breaks off, or its chunks are not of HTTP")),
        Err(_) => Err(ServiceError::Deadline { stage: Stage::Admission }),
    }
}

/// A body as `T`.
///
/// # Errors
/// `Invalid` with the path of the field; what is no JSON at all, or is nested deeper than serde_json reads, is a wrong `body`.
pub fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, ServiceError> {
    let mut json = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(Strict(&mut json)).map_err(|error| misread(bytes, &error))?;
    json.end().map_err(not_json)?;
    Ok(value)
}

/// Whom a message is for, as far as it says so before it becomes unreadable.
#[derive(Debug, Default, PartialEq)]
pub struct Heading {
    /// `session_id`.
    pub session_id: Option<String>,
    /// `step`; 0: it does not say.
    pub step: u64,
}

/// What can be read of the heading of a message that [`parse`] refuses: its error is to bear the step it belongs to.
pub fn heading(bytes: &[u8]) -> Heading {
    struct Reader<'a>(&'a mut Heading);
    impl<'de> Visitor<'de> for Reader<'_> {
        type Value = ();

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("an object")
        }

        fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
            while let Some(name) = map.next_key::<String>()? {
                match name.as_str() {
                    "session_id" => self.0.session_id = map.next_value::<Value>()?.as_str().map(str::to_owned),
                    "step" => self.0.step = map.next_value::<Value>()?.as_u64().unwrap_or_default(),
                    _ => drop(map.next_value::<IgnoredAny>()?),
                }
            }
            Ok(())
        }
    }
    let mut heading = Heading::default();
    // What was read before it failed stands.
    let _unreadable = serde_json::Deserializer::from_slice(bytes).deserialize_map(Reader(&mut heading));
    heading
}

fn misread(bytes: &[u8], error: &serde_path_to_error::Error<serde_json::Error>) -> ServiceError {
    let (path, error) = (error.path().to_string(), error.inner());
    let message = error.to_string();
    if error.classify() == Category::Data {
        let place = format!(" at line {} column {}", error.line(), error.column());
        return unfitting(&path, message.strip_suffix(&place).unwrap_or(&message));
    }
    if message.starts_with("number out of range") || stops_at_word(bytes, error) {
        return unfitting(&path, "is not a finite number");
    }
    not_json(error)
}

/// Whether the reader stopped at a number as other writers of JSON spell it: `NaN`, `Infinity`, `-Infinity` (behind the sign).
fn stops_at_word(bytes: &[u8], error: &serde_json::Error) -> bool {
    let line = bytes.split(|byte| *byte == b'\n').nth(error.line().saturating_sub(1));
    let rest = line.and_then(|line| line.get(error.column().saturating_sub(1)..));
    rest.is_some_and(|rest| rest.starts_with(b"NaN") || rest.starts_with(b"Infinity"))
}

fn not_json(error: impl std::fmt::Display) -> ServiceError {
    ServiceError::invalid("body", format!("is not JSON: {error}"))
}

/// Serde's complaint about what stands at `path`. A name that the path says, or is to say, is not said again.
pub fn unfitting(path: &str, message: &str) -> ServiceError {
    // "?" stands for a place that has no name yet.
    let path = path.trim_end_matches(['.', '?']);
    let named = |prefix: &str| message.strip_prefix(prefix)?.split_once('`');
    let inside = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
    if let Some((name, _)) = named("missing field `") {
        return ServiceError::invalid(inside(name), "is missing");
    }
    if let Some((name, _)) = named("duplicate field `") {
        return ServiceError::invalid(inside(name), "is there twice");
    }
    let reason = named("unknown field `").map_or_else(|| message.to_owned(), |(_, known)| format!("is no field here{known}"));
    ServiceError::invalid(if path.is_empty() { "body" } else { path }, reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings() {
        let deep = format!(r#"{{"session_id": "a", "goal": {}"#, "[".repeat(100_000));
        for (text, session_id, step) in [
            (r#"{"step": 7, "goal": [1, {"step": 3}], "session_id": "a"}"#, Some("a"), 7),
            (r#"{"step": 7, "observation": {"state": [NaN]}, "session_id": "a"}"#, None, 7),
            (r#"{"observation": {"state": [1e999]}, "step": 7"#, None, 7),
            (r#"{"observation": {"state": [NaN]}, "step": 7}"#, None, 0),
            (r#"{"step": "7", "session_id": 1}"#, None, 0),
            (r#"{"step": -7, "session_id": "a"}"#, Some("a"), 0),
            (&deep, Some("a"), 0),
            ("[7]", None, 0),
            ("no JSON", None, 0),
            ("", None, 0),
        ] {
            assert_eq!(heading(text.as_bytes()), Heading { session_id: session_id.map(str::to_owned), step }, "{text}");
        }
    }
}
