//! What the encoder sees of the time from a decision on, behind the real past: written once, for the sampler, the losses and the probe.

use crate::model::trajectory::Seen;
use serde::Serialize;

/// What the latent at t is inferred from, beside the tokens before t.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Evidence {
    /// s_t, and then the prior: what a decision has ("without the future token").
    Filter,
    /// Positions 0 and 1 of a window at the levels at which they stand: what the refinement has (zig-zag, section 4.3 of the paper).
    Refinement,
    /// x_t and the successor state s_{t+1}.
    SuccessorState,
    /// x_t and the whole successor token x_{t+1}.
    Successor,
}

impl Evidence {
    /// What is seen of the tokens t, t + 1, ..
    pub fn ahead(self) -> &'static [Seen] {
        match self {
            Self::Filter => &[Seen::STATE],
            Self::Refinement => &[Seen::GENERATED, Seen::GENERATED],
            Self::SuccessorState => &[Seen::ALL, Seen::STATE],
            Self::Successor => &[Seen::ALL, Seen::ALL],
        }
    }

    /// The same of a window that ends after `horizon` positions.
    pub fn ahead_within(self, horizon: usize) -> &'static [Seen] {
        &self.ahead()[..self.ahead().len().min(horizon)]
    }
}
