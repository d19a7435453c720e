//! Whether the window that an act left is still good: a little surprise is noised away, a great one or a jump of the latent starts anew.

use super::Start;
use crate::model::{config::ModelConfig, diffusion::descent::Window};

/// The window that an act leaves for the next one.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Stored {
    window: Window,
    /// Mean of the prior latent of position 0 at the last cold start.
    anchor: Vec<f32>,
}

impl Stored {
    pub(super) fn new(window: Window, anchor: Vec<f32>) -> Self {
        Self { window, anchor }
    }

    pub(super) fn window(&self) -> &Window {
        &self.window
    }

    pub(super) fn anchor(&self) -> &[f32] {
        &self.anchor
    }

    /// Row of the table at which it stands.
    pub(super) fn row(&self) -> usize {
        self.window.row
    }

    /// Distance between the real state and the one that it was built for.
    pub(super) fn surprise(&self, state: &[f32]) -> f32 {
        norm(state, &self.window.predicted_state) / (state.len().max(1) as f32).sqrt()
    }

    pub(super) fn size_bytes(&self) -> usize {
        let Window { x, row: _, predicted_state } = &self.window;
        [x, predicted_state, &self.anchor].iter().map(|values| values.capacity() * size_of::<f32>()).sum()
    }
}

/// How an act starts for which a window is stored; `latent` is the mean of position 0's, `rung` the rows of a rung.
pub(super) fn choose_start(stored: &Stored, state: &[f32], latent: Option<&[f32]>, rung: usize, config: &ModelConfig) -> Start {
    let (restart, distance, horizon) = (&config.defaults.restart, stored.surprise(state), config.method.plan.horizon);
    let moved = latent.map_or(0.0, |latent| norm(latent, &stored.anchor));
    let rungs = (horizon / 4).clamp(1, horizon.saturating_sub(1).max(1));
    if distance >= restart.cold_distance || moved / config.units.latent_spread.max(f32::MIN_POSITIVE) > restart.latent_jump {
        Start::Cold
    } else if distance >= restart.renoise_distance && horizon > 1 {
        Start::Renoised(rungs.min(stored.row() / rung) as u32)
    } else {
        Start::Warm
    }
}

fn norm(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}
