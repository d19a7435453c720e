//! The REST face: JSON in, JSON out; the service does the rest.

mod answer;
mod body;
mod json;
mod models;
mod problem;
mod routes;
mod stream;
mod strict;

pub use crate::serve::gate::Gate;
pub use problem::Problem;
pub use routes::{openapi, router};

use crate::serve::service::Service;
use metrics_exporter_prometheus::PrometheusHandle;
use std::sync::Arc;

/// What the handlers stand on.
#[derive(Clone)]
pub struct State {
    /// The core.
    pub service: Arc<Service>,
    /// Renders `/metrics`.
    pub metrics: PrometheusHandle,
}
