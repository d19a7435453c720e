//! Denoisers with a way back while serving.

use super::*;
use crate::model::{
    gradients::{Network, check},
    nn::testing::gaussian,
};
use candle_core::Result;
use std::ops::Range;

struct Denoised {
    config: ModelConfig,
    len: usize,
    levels: Vec<f32>,
}

impl Network for Denoised {
    type Built = Denoiser;

    fn build(&self, params: &Params) -> Result<Denoiser> {
        Denoiser::new(LAYOUT, &self.config.method, params)
    }

    fn run<V: Activations>(&self, denoiser: &Denoiser, inputs: &[V], rows: Range<usize>) -> Result<V> {
        let levels = &self.levels[rows.start * self.len..rows.end * self.len];
        denoiser.predict(&inputs[0], &Given { latents: inputs.get(1), observed: inputs.get(2), ..Given::levels(levels) })
    }
}

/// Each backbone, to the window, several latents and the real steps, with an odd horizon where it may be.
#[test]
fn denoisers_and_their_gradients() {
    let [unet, dit, with_tokens, encoder_decoder, mlp] = backbones();
    for (backbone, len) in [(unet, 8), (dit, 5), (with_tokens, 5), (encoder_decoder, 8), (mlp, 8)] {
        let levels = (0..7 * len).map(|i| (i * 7 % 41) as f32).collect();
        let inputs = [gaussian(1, (7, len, 5)), gaussian(2, (7, len, LATENT)), gaussian(3, (7, 1, OBSERVED))];
        check(&Denoised { config: config(backbone), len, levels }, &inputs);
    }
}
