//! What networks over windows have in common: what they are told, how a position's level stands beside it, and the blocks of the temporal
//! U-Net.
mod blocks;

use crate::model::nn::{Activations, Chance, time_embedding::Sinusoid};
use candle_core::Result;

pub(in crate::model) use blocks::{ConvBlock, Down, EMB, MeanLevel, ResBlock, check_widths, through};

/// Channels of the sinusoidal embedding of a position's level.
pub(in crate::model) const LEVEL_CHANNELS: usize = 16;

/// What a network knows beside the noisy window.
pub struct Given<'a, V> {
    /// `B * T` levels, one a position, 0 ..= level_max.
    pub levels: &'a [f32],
    /// `(B, T, latent_dim)`, for models with latents.
    pub latents: Option<&'a V>,
    /// `(B, 1, steps * width)` real steps, for models that take some: [`crate::model::method::Diffusion::observed`].
    pub observed: Option<&'a V>,
    /// `(B, 1, told_width + 1)` what is told of what is wanted, normalized, and 1; zeros where nothing is told. For models that take it.
    pub told: Option<&'a V>,
    /// Where a training's chance comes from, for networks that drop numbers by it; none in use.
    pub chance: Option<&'a Chance>,
}

impl<'a, V> Given<'a, V> {
    /// The levels, and nothing else.
    pub fn levels(levels: &'a [f32]) -> Self {
        Self { levels, latents: None, observed: None, told: None, chance: None }
    }
}

/// The level of each position, as channels of it.
pub(in crate::model) struct Levels(Sinusoid);

impl Levels {
    /// Ready for whole levels up to `level_max`.
    pub(in crate::model) fn new(level_max: usize) -> Result<Self> {
        Sinusoid::new(LEVEL_CHANNELS, level_max).map(Self)
    }

    /// `(B, T, D + latent_dim + LEVEL_CHANNELS)`: window, latents, and the embedding of each position's level, side by side.
    ///
    /// # Errors
    /// If there is not a level for each position, or the latents are those of other windows.
    pub(in crate::model) fn beside<V: Activations>(&self, x: &V, given: &Given<V>) -> Result<V> {
        let [batch, len, _] = x.shape()?;
        if given.levels.len() != batch * len {
            candle_core::bail!("{} levels for {batch} windows of {len}", given.levels.len());
        }
        let embedded = V::generate([batch, len, LEVEL_CHANNELS], |out| {
            let rows = given.levels.iter().zip(out.chunks_exact_mut(LEVEL_CHANNELS));
            rows.for_each(|(level, out)| self.0.write(*level, out));
        })?;
        match given.latents {
            Some(latents) => V::beside(&[x, latents, &embedded]),
            None => V::beside(&[x, &embedded]),
        }
    }
}
