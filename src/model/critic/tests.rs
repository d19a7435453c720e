//! Values on all kinds of activations, against PyTorch's, and what is no value network.

use super::*;
use crate::model::{
    golden::Golden,
    gradients::{Network, check},
    nn::{Activations, Buffer, Params, Traced, gradient, testing::gaussian},
    trajectory::Layout,
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

/// Both critics of an action and that of the state, the errors and their gradients, with latents.
#[test]
fn critics_against_pytorch() {
    let (golden, layout) = (Golden::of("critic"), Layout { state_dim: 3, action_dim: 2 });
    golden.check_training(|given, params| {
        let critic = Critic::new(
            Judged { state_dim: layout.state_dim, choice_dim: layout.action_dim, latent_dim: 4, state_alone: true },
            9,
            params,
        )?;
        let of = Transitions {
            state: &given["state"],
            action: &given["action"],
            latent: given.get("latents"),
            next_state: &given["next_state"],
            next_latent: given.get("next_latents"),
            reward: &given["gain"],
            end_worth: -0.4,
            ended: &given["ended"],
        };
        let [q1, q2] = critic.q(of.state, of.action, of.latent)?;
        let v = critic.v(of.state, of.latent)?;
        let CriticTerms { loss, q, v: of_v } = critic.errors(&critic, &of, (0.9, 0.7))?;
        let named = [("q1", q1), ("q2", q2), ("v", v), ("loss", loss), ("loss_q", q), ("loss_v", of_v)];
        Ok(named.map(|(name, value)| (name.to_owned(), value)).into())
    });
}

/// What V is drawn to: of a fair coin's 0 and 1 the expectile tau is tau itself, where the error has no slope.
#[test]
fn an_expectile_is_where_the_error_is_flat() {
    let coin = Tensor::new(&[0.0_f32, 1.0], &candle_core::Device::Cpu).unwrap().reshape((2, 1, 1)).unwrap();
    for tau in [0.5, 0.7, 0.9] {
        let slope = |v: f64| {
            let v = candle_core::Var::from_tensor(&Tensor::full(v as f32, (2, 1, 1), &candle_core::Device::Cpu).unwrap()).unwrap();
            let error = twin::expectile_error(&(&coin - v.as_tensor()).unwrap(), tau).unwrap();
            error.backward().unwrap().get(&v).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap()
        };
        assert!(slope(tau).abs() < 1e-6 && slope(tau - 0.05) < -1e-3 && slope(tau + 0.05) > 1e-3, "{tau}");
    }
}
