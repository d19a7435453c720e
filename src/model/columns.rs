//! Which columns of a window are what, what of it is known beforehand, and what bounds it.

use crate::model::{config::Units, trajectory::Layout};
use std::ops::Range;

/// Columns of one position of a window (type (i) planner, section 4.1 of the paper).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Columns {
    /// s_t.
    pub state: Range<usize>,
    /// a_t.
    pub action: Range<usize>,
}

impl Columns {
    /// State and action side by side.
    pub fn state_action(layout: Layout) -> Self {
        let Layout { state_dim, action_dim } = layout;
        Self { state: 0..state_dim, action: state_dim..state_dim + action_dim }
    }

    /// Columns of a position (D).
    pub fn width(&self) -> usize {
        self.state.len() + self.action.len()
    }

    /// What is known of a position before anything is denoised: of the first one the state, where it is `real` and not imagined. It is
    /// written in before each evaluation, and training asks no loss for it.
    pub fn known(&self, position: usize, real: bool) -> Range<usize> {
        if position == 0 && real { self.state.clone() } else { 0..0 }
    }
}

/// Bounds of each column of a denoised position, normalized units.
#[derive(Clone, Debug, PartialEq)]
pub struct Bounds {
    low: Vec<f32>,
    high: Vec<f32>,
}

impl Bounds {
    /// States within `clip` standard deviations, actions within their own bounds.
    pub fn new(columns: &Columns, clip: f32, units: &Units) -> Self {
        let (mut low, mut high) = (vec![-clip; columns.width()], vec![clip; columns.width()]);
        let (action_low, action_high) = units.action_bounds();
        low[columns.action.clone()].copy_from_slice(&action_low);
        high[columns.action.clone()].copy_from_slice(&action_high);
        Self { low, high }
    }

    /// Holds one position within its bounds.
    pub fn hold(&self, position: &mut [f32]) {
        let bounds = self.low.iter().zip(&self.high);
        position.iter_mut().zip(bounds).for_each(|(value, (low, high))| *value = value.clamp(*low, *high));
    }
}
