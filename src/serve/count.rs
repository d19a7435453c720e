//! Acts in the metrics: each is counted once, whatever becomes of it.

use crate::serve::{
    error::{ServiceError, Stage},
    request::{Acted, Caller},
    session::Answer,
};
use tokio::time::Instant;

/// An act on its way through the metrics: whatever becomes of it is counted once, and also that nobody waited for it any more.
pub(super) struct Count {
    arrived: Instant,
    caller: Caller,
    model: String,
    is_told: bool,
}

impl Count {
    /// An act has come.
    pub fn new(caller: Caller) -> Self {
        metrics::counter!("ada_acts_received_total", "face" => caller.face.word()).increment(1);
        Self { arrived: Instant::now(), caller, model: "unknown".to_owned(), is_told: false }
    }

    /// When it came.
    pub fn arrived(&self) -> Instant {
        self.arrived
    }

    /// It is of this model.
    pub fn of(&mut self, model: &str) {
        model.clone_into(&mut self.model);
    }

    /// What its caller is told.
    pub fn told(mut self, result: Result<Acted, ServiceError>) -> Result<Acted, ServiceError> {
        self.is_told = true;
        self.count(result.as_ref().map_or_else(ServiceError::reason, |_| "OK"));
        match &result {
            Ok(acted) => self.answered(acted),
            Err(error) => {
                if error.committed_step().is_some() {
                    metrics::counter!("ada_step_conflicts_total", "reason" => error.reason()).increment(1);
                }
                if matches!(error, ServiceError::QueueFull { .. } | ServiceError::Deadline { stage: Stage::Admission | Stage::Queue }) {
                    metrics::counter!("ada_shed_total", "reason" => error.reason()).increment(1);
                }
                tracing::debug!(reason = error.reason(), %error, "act refused");
            }
        }
        result
    }

    fn answered(&self, Acted { answer, replayed, .. }: &Acted) {
        metrics::histogram!("ada_act_duration_seconds", "model" => self.model.clone()).record(self.arrived.elapsed().as_secs_f64());
        if !replayed {
            let Answer { chunk, timings, .. } = &**answer;
            metrics::histogram!("ada_act_queue_seconds").record(timings.queue.as_secs_f64());
            metrics::histogram!("ada_act_compute_seconds").record(timings.compute.as_secs_f64());
            metrics::histogram!("ada_act_commit_seconds").record(timings.commit.as_secs_f64());
            metrics::histogram!("ada_act_network_evaluations").record(f64::from(chunk.evaluations));
        }
    }

    fn count(&self, code: &'static str) {
        let (model, face) = (self.model.clone(), self.caller.face.word());
        metrics::counter!("ada_acts_total", "model" => model, "face" => face, "code" => code).increment(1);
    }
}

impl Drop for Count {
    fn drop(&mut self) {
        if !self.is_told {
            self.count("CANCELLED");
        }
    }
}
