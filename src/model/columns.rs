//! Which columns of a window are what, what of it is known beforehand, and what bounds it.

use crate::model::{config::Units, method::Diffused, trajectory::Layout};
use std::ops::Range;

/// Columns of one position of a window (section 4.1 of the paper: type (i) has both, type (ii) states alone; a policy actions alone).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Columns {
    /// s_t; none where actions alone are diffused.
    pub state: Range<usize>,
    /// a_t; none where states alone are diffused.
    pub action: Range<usize>,
    /// The code of a skill, where that is diffused in place of steps.
    pub code: Range<usize>,
    /// Which columns of a whole step, state and action side by side, these are; of a code none.
    pub of_step: Range<usize>,
}

impl Columns {
    /// Of a window of this kind.
    pub fn new(diffused: Diffused, layout: Layout) -> Self {
        let Layout { state_dim, action_dim } = layout;
        let (states, actions, first) = match diffused {
            Diffused::StateAction => (state_dim, action_dim, 0),
            Diffused::State => (state_dim, 0, 0),
            Diffused::Action => (0, action_dim, state_dim),
            Diffused::Code { .. } => (0, 0, 0),
        };
        let steps = states + actions;
        Self { state: 0..states, action: states..steps, code: steps..steps + diffused.code_dim(), of_step: first..first + steps }
    }

    /// State and action side by side.
    pub fn state_action(layout: Layout) -> Self {
        Self::new(Diffused::StateAction, layout)
    }

    /// Columns of a position (D).
    pub fn width(&self) -> usize {
        self.state.len() + self.action.len() + self.code.len()
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
    /// States within `clip` standard deviations, codes within as many units, actions within their own bounds.
    pub fn new(columns: &Columns, clip: f32, units: &Units) -> Self {
        let (mut low, mut high) = (vec![-clip; columns.width()], vec![clip; columns.width()]);
        let (action_low, action_high) = units.action_bounds();
        let actions = columns.action.len();
        low[columns.action.clone()].copy_from_slice(&action_low[..actions]);
        high[columns.action.clone()].copy_from_slice(&action_high[..actions]);
        Self { low, high }
    }

    /// Of an action alone.
    pub fn of_actions(units: &Units) -> Self {
        let (low, high) = units.action_bounds();
        Self { low, high }
    }

    /// Holds one position within its bounds.
    pub fn hold(&self, position: &mut [f32]) {
        let bounds = self.low.iter().zip(&self.high);
        position.iter_mut().zip(bounds).for_each(|(value, (low, high))| *value = value.clamp(*low, *high));
    }
}
