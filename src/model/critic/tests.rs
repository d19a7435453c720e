//! Values on all kinds of activations, against PyTorch's, and what is no value network.

use super::*;
use crate::model::{
    golden::Golden,
    gradients::{Network, check},
    nn::{Activations, Buffer, Params, Traced, gradient, testing::gaussian},
};
use candle_core::{Result, Tensor};
use std::ops::Range;

const LEVEL_MAX: usize = 40;

/// Levels of a window, from nearly clean to noise; whole ones and some between.
fn levels(batch: usize, len: usize) -> Vec<f32> {
    (0..batch * len).map(|i| (i * 7 % 41) as f32 + if i % 3 == 1 { 0.5 } else { 0.0 }).map(|level| level.min(40.0)).collect()
}

struct Valued {
    sizes: Sizes<'static>,
    levels: Vec<f32>,
}

impl Network for Valued {
    type Built = Value;

    fn build(&self, params: &Params) -> Result<Value> {
        Value::new(self.sizes, LEVEL_MAX, params)
    }

    fn run<V: Activations>(&self, value: &Value, inputs: &[V], rows: Range<usize>) -> Result<V> {
        let len = self.sizes.horizon;
        let levels = &self.levels[rows.start * len..rows.end * len];
        value.predict(&inputs[0], &Given { latents: inputs.get(1), ..Given::levels(levels) })
    }
}

/// Horizons that halve evenly or not at all, with latents and without.
#[test]
fn values_and_their_gradients() {
    for (latent_dim, horizon, widths) in [(4, 5, &[5, 16, 3][..]), (0, 8, &[8, 24]), (3, 7, &[6])] {
        let network = Valued { sizes: Sizes { columns: 5, latent_dim, horizon, widths }, levels: levels(7, horizon) };
        let x = gaussian(1, (7, horizon, 5));
        match latent_dim {
            0 => check(&network, &[x]),
            dim => check(&network, &[x, gaussian(2, (7, horizon, dim))]),
        }
    }
}

#[test]
fn values_against_pytorch() {
    for (case, latent_dim, horizon, widths) in [("value", 4, 7, &[5, 16, 3][..]), ("value_plain", 0, 5, &[6])] {
        let (golden, sizes) = (Golden::of(case), Sizes { columns: 5, latent_dim, horizon, widths });
        let levels = golden.flat("in.levels");
        golden.check_training(|given, params| {
            let condition = Given { latents: given.get("latents"), ..Given::levels(&levels) };
            Ok(vec![("value".into(), Value::new(sizes, LEVEL_MAX, params)?.predict(&given["x"], &condition)?)])
        });
        let (x, latents): (Buffer, Option<Buffer>) = (golden.value("in.x"), (latent_dim > 0).then(|| golden.value("in.latents")));
        golden.check_serving(|params| {
            let condition = Given { latents: latents.as_ref(), ..Given::levels(&levels) };
            Ok(vec![("value".into(), Value::new(sizes, LEVEL_MAX, params)?.predict(&x, &condition)?)])
        });
        golden.check_guiding(|params| {
            let (value, given) = (Value::new(sizes, LEVEL_MAX, params)?, [latents.clone().unwrap_or_else(|| x.clone()), x.clone()]);
            let run = |[latents, x]: [Traced; 2]| {
                value.predict(&x, &Given { latents: (latent_dim > 0).then_some(&latents), ..Given::levels(&levels) })
            };
            let (_, [to_latents, to_x]) = gradient(given, run, |_, grad| grad.copy_from_slice(&golden.flat("r.value")))?;
            let to_latents = (latent_dim > 0).then(|| ("latents".into(), to_latents));
            Ok(to_latents.into_iter().chain([("x".into(), to_x)]).collect())
        });
    }
}

#[test]
fn wrong_sizes_are_errors() {
    let params = Params::fresh(1);
    let sizes = Sizes { columns: 2, latent_dim: 3, horizon: 4, widths: &[8] };
    assert!(Value::new(Sizes { widths: &[], ..sizes }, LEVEL_MAX, &params).is_err());
    let value = Value::new(sizes, LEVEL_MAX, &params).unwrap();
    let predict = |[len, columns]: [usize; 2], levels: usize, latents: Option<&Tensor>| {
        let (x, levels) = (gaussian(1, (1, len, columns)), vec![0.0; levels]);
        value.predict(&x, &Given { latents, ..Given::levels(&levels) }).map_err(|error| error.to_string())
    };
    let latents = gaussian(2, (1, 4, 3));
    assert_eq!(predict([4, 2], 4, Some(&latents)).unwrap().dims(), [1, 1, 1]);
    assert!(predict([5, 2], 5, Some(&gaussian(2, (1, 5, 3)))).unwrap_err().contains("4 positions and 2 columns got 5 and 2"));
    assert!(predict([4, 3], 4, Some(&latents)).unwrap_err().contains("got 4 and 3"));
    assert!(predict([4, 2], 3, Some(&latents)).unwrap_err().contains("3 levels"));
    assert!(predict([4, 2], 4, None).is_err() && predict([4, 2], 4, Some(&gaussian(2, (1, 4, 2)))).is_err());
}

#[test]
fn widths_that_do_not_fit_are_named() {
    let reason = |widths: &[usize], horizon| check_value(widths, horizon).map_err(|error| error.to_string());
    for (widths, horizon) in [(&[8][..], 1), (&[7, 3], 2), (&[8, 16, 24], 3), (&[32, 64, 64, 64], 5)] {
        assert_eq!(reason(widths, horizon), Ok(()));
    }
    let field = |reason: &str| Err(format!("method.guide.widths: {reason}"));
    assert_eq!(reason(&[], 8), field("must name at least one width"));
    assert_eq!(reason(&[8, 0], 8), field("is 0, must lie in 1..=8192"));
    assert_eq!(reason(&[12], 8), field("12 must be below 8 or a multiple of it"));
    assert_eq!(reason(&[8, 8], 1), field("the horizon 1 cannot be halved 1 times, once between two widths"));
    assert_eq!(reason(&[8; 4], 4), field("the horizon 4 cannot be halved 3 times, once between two widths"));
    assert_eq!(reason(&[8; 4], 0), field("the horizon 0 cannot be halved 3 times, once between two widths"));
}
