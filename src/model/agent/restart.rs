//! Whether the window that an act left is still good: a little surprise is noised away, a great one or another
//! belief of the latent starts anew.

use super::{Start, chain::Chain, types::are_finite};
use crate::model::{
    config::{ModelConfig, Restart},
    diffusion::descent::Window,
    latent::GaussianRef,
};
use serde::{Deserialize, Serialize};

/// The window that an act leaves for the next one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Stored {
    window: Window,
    /// See [`Self::anchor`]: a chain of one, empty for a model without latents.
    anchor: Chain,
}

impl Stored {
    pub(super) fn new(window: Window, anchor: Chain) -> Self {
        Self { window, anchor }
    }

    /// Its beliefs are part of it.
    pub(super) fn anchor_is_whole(&self, dim: usize) -> bool {
        self.anchor.is_whole(1, dim)
    }

    /// Whether all its numbers are.
    pub(super) fn is_finite(&self) -> bool {
        let Window { x, row: _, predicted_state } = &self.window;
        are_finite(x) && are_finite(predicted_state) && self.anchor.is_finite()
    }

    pub(super) fn window(&self) -> &Window {
        &self.window
    }

    /// Belief of position 0 under which the window was last denoised from cold.
    pub(super) fn anchor(&self) -> GaussianRef<'_> {
        self.anchor.get(0)
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
        (x.capacity() + predicted_state.capacity()) * size_of::<f32>() + self.anchor.size_bytes()
    }
}

/// How an act starts for which a window is stored; `belief` is that of position 0 now, `rung` the rows of a rung.
pub(super) fn choose_start(stored: &Stored, state: &[f32], belief: GaussianRef, rung: usize, config: &ModelConfig) -> Start {
    let (restart, distance, horizon) = (&config.defaults.restart, stored.surprise(state), config.method.plan.horizon);
    let rungs = (horizon / 4).clamp(1, horizon.saturating_sub(1).max(1));
    if distance >= restart.cold_distance || has_moved(belief, stored.anchor(), config) {
        Start::Cold
    } else if distance >= restart.renoise_distance && horizon > 1 {
        Start::Renoised(rungs.min(stored.row() / rung) as u32)
    } else {
        Start::Warm
    }
}

/// Whether a belief is another one than the anchor: its mean has moved by too many spreads of the data, or it diverges by too many nats. Without
/// latents none has.
fn has_moved(belief: GaussianRef, anchor: GaussianRef, config: &ModelConfig) -> bool {
    let Restart { latent_jump, latent_kl, .. } = config.defaults.restart;
    let spreads = norm(belief.mean, anchor.mean) / config.units.latent_spread.max(f32::MIN_POSITIVE);
    spreads > latent_jump || belief.kl(anchor) > latent_kl
}

fn norm(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{method::Backbone, trajectory::Layout};

    fn belief<'a>(mean: &'a [f32; 2], log_var: &'a [f32; 2]) -> GaussianRef<'a> {
        GaussianRef { mean, log_var }
    }

    /// A window that nothing speaks against but what is believed now.
    fn stored(anchor: GaussianRef) -> Stored {
        let mut chain = Chain::new(1, 2);
        chain.set(0, anchor);
        Stored::new(Window { x: vec![0.0; 16], row: 7, predicted_state: vec![0.0] }, chain)
    }

    fn start(now: GaussianRef, anchor: GaussianRef, restart: Restart) -> Start {
        let mut config = ModelConfig::plain(Layout { state_dim: 1, action_dim: 1 }, None, Backbone::Unet { widths: vec![8] });
        (config.defaults.restart, config.units.latent_spread) = (restart, 0.5);
        choose_start(&stored(anchor), &[0.0], now, 1, &config)
    }

    /// The threshold is KL(now || anchor) in nats, here by hand: the mean moves, the belief sharpens, it widens, and the same step of the mean
    /// means more to a sharp belief than to a wide one.
    #[test]
    fn a_divergence_of_so_many_nats_starts_anew() {
        let (wide, origin) = ([0.0, 0.0], [0.0, 0.0]);
        let e = f32::exp;
        for (mean, log_var, anchor_log_var, nats) in [
            ([2.0, 0.0], wide, wide, 2.0),
            (origin, [-4.0, 0.0], wide, 0.5 * (3.0 + e(-4.0))),
            (origin, [0.0, 2.0], wide, 0.5 * (e(2.0) - 3.0)),
            ([0.2, 0.0], wide, wide, 0.02),
            ([0.2, 0.0], [-4.0, 0.0], [-4.0, 0.0], 0.02 * e(4.0)),
        ] {
            let at = |latent_kl| {
                let restart = Restart { latent_jump: f32::INFINITY, latent_kl, ..Restart::default() };
                start(belief(&mean, &log_var), belief(&origin, &anchor_log_var), restart)
            };
            assert_eq!([at(0.99 * nats), at(1.01 * nats)], [Start::Cold, Start::Warm], "{mean:?} {log_var:?}");
            assert_eq!(at(f32::INFINITY), Start::Warm, "never");
        }
        let same = belief(&[0.3, -1.0], &[0.1, -2.0]);
        assert_eq!(start(same, same, Restart { latent_kl: 0.0, ..Restart::default() }), Start::Warm, "nothing has moved");
    }

    /// Each measure starts anew by itself, and a jump sees means alone: 0.8 is 1.6 spreads, and 0.32 nats.
    #[test]
    fn a_jump_is_what_it_was() {
        let (origin, wide) = ([0.0, 0.0], [0.0, 0.0]);
        let at = |mean, log_var, latent_jump, latent_kl| {
            start(belief(&mean, &log_var), belief(&origin, &wide), Restart { latent_jump, latent_kl, ..Restart::default() })
        };
        let (never, moved, sharper) = (f32::INFINITY, [0.0, 0.8], [-8.0, -8.0]);
        assert_eq!([1.5, 1.7].map(|jump| at(moved, wide, jump, never)), [Start::Cold, Start::Warm]);
        assert_eq!([0.3, 0.4].map(|nats| at(moved, wide, 1.7, nats)), [Start::Cold, Start::Warm]);
        assert_eq!([at(moved, wide, 1.5, 0.4), at(origin, sharper, 0.1, never)], [Start::Cold, Start::Warm]);
    }

    /// The window, the state it was built for, and both numbers of each column of the anchor.
    #[test]
    fn all_that_is_kept_is_counted() {
        assert_eq!(stored(belief(&[0.0; 2], &[0.0; 2])).size_bytes(), (16 + 1 + 2 * 2) * size_of::<f32>());
    }
}
