//! The latent networks on both kinds of values, and against PyTorch's.

use super::{
    elbo::{Ahead, ElboBatch, ElboOptions, ElboTerms},
    *,
};
use crate::model::{
    golden::Golden,
    method::{GruLatent, Looks},
    nn::{Buffer, Precision},
    noise::Philox,
    trajectory::Token,
};
use candle_core::Tensor;
use std::collections::BTreeMap;

mod baseline;

const LAYOUT: Layout = Layout { state_dim: 3, action_dim: 2 };
const LEN: usize = 5;
const CHANGE_STD: [f32; 3] = [0.5, 1.0, 2.0];

fn model() -> LatentModel {
    let (config, fresh) = (GruLatent::plain(6, 24, Looks::Block(4)), Params::fresh(4));
    LatentModel::new(&config, LAYOUT, &fresh).unwrap();
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    LatentModel::new(&config, LAYOUT, &Params::loaded_as(tensors, Precision::F32)).unwrap()
}

/// Tokens of which this and that is missing.
fn rows() -> Vec<Vec<Token>> {
    let mut stream = Philox::new(8);
    let mut token = |i: usize| Token {
        state: (!i.is_multiple_of(3)).then(|| (0..3).map(|_| stream.normal()).collect()),
        action: i.is_multiple_of(2).then(|| vec![0.3, -0.1 * i as f32]),
        reward: (i % 5 > 1).then_some(0.2 * i as f32),
        noise: 0.1 * (i % 4) as f32,
    };
    (0..7).map(|row| (0..LEN).map(|position| token(row * 3 + position)).collect()).collect()
}

/// Posterior, and mean and log-variance of the prior chain after it.
fn chain<V: Activations>(model: &LatentModel, rows: &[Vec<Token>], numbers: impl Fn(&V) -> Vec<f32>) -> Vec<u32> {
    let tokens = Tokens::<V>::pack(LAYOUT, rows.iter(), LEN, None, |row, position| row[position].view()).unwrap();
    let posterior = model.infer(&tokens, None).unwrap();
    let mut all = [numbers(&posterior.mean), numbers(&posterior.log_var)].concat();
    let keep = |next: &Gaussian<V>| {
        all.extend([numbers(&next.mean), numbers(&next.log_var)].concat());
        Ok(())
    };
    model.roll_out(posterior, 3, keep).unwrap();
    all.into_iter().map(f32::to_bits).collect()
}

fn on_buffers(model: &LatentModel, rows: &[Vec<Token>]) -> Vec<u32> {
    chain(model, rows, |buffer: &Buffer| buffer.to_vec())
}

#[test]
fn tensors_and_buffers_give_the_same_bits() {
    let (model, rows) = (model(), rows());
    let tensors = chain(&model, &rows, |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1().unwrap());
    assert_eq!(tensors, on_buffers(&model, &rows));
}

#[test]
fn a_row_does_not_depend_on_its_batch() {
    let (model, rows) = (model(), rows());
    let together = on_buffers(&model, &rows);
    for (i, row) in rows.iter().enumerate() {
        let alone = on_buffers(&model, std::slice::from_ref(row));
        let parts = together.chunks_exact(rows.len() * 6).flat_map(|part| part[i * 6..][..6].iter().copied());
        assert_eq!(alone, parts.collect::<Vec<_>>(), "row {i}");
    }
}

fn golden_latent(dim: usize, hidden: usize) -> GruLatent {
    GruLatent::plain(dim, hidden, Looks::Block(LEN))
}

/// Posteriors, the prior after the last of them, and what the decoder makes of their means: the results of the golden case, by name.
fn everything<V: Activations>(tokens: &Tokens<V>, params: &Params) -> candle_core::Result<Vec<(String, V)>> {
    let model = LatentModel::new(&golden_latent(3, 9), LAYOUT, params)?;
    let posteriors = model.encoder.posterior(&model.states(tokens, None)?)?;
    let Told { state: change, reward, .. } = model.decoder.predict(&tokens.state, &tokens.action, &posteriors.mean)?;
    let mut named = vec![("change".into(), change), ("reward".into(), reward)];
    let mut tell = |name: &str, gaussian: &Gaussian<V>| {
        named.push((format!("mean{name}"), gaussian.mean.clone()));
        named.push((format!("log_var{name}"), gaussian.log_var.clone()));
    };
    tell("", &posteriors);
    let mut step = 0;
    model.roll_out(model.infer(tokens, None)?, 3, |next| {
        step += 1;
        tell(&step.to_string(), next);
        Ok(())
    })?;
    Ok(named)
}

#[test]
fn networks_against_pytorch() {
    let golden = Golden::of("latent");
    golden.check_training(|given, params| everything(&tokens_of(|name| given[name].clone()), params));
    golden.check_serving(|params| everything(&tokens_of::<Buffer>(|name| golden.value(&format!("in.{name}"))), params));
}

fn elbo_options() -> ElboOptions {
    ElboOptions {
        kl_weight: 0.3,
        state_change_std: CHANGE_STD.to_vec(),
        state_weight: 1.0,
        reward_weight: 0.7,
        action_weight: 0.6,
        free_bits: 0.0,
        context_weight: 0.0,
        ahead: Ahead::default(),
    }
}

/// A batch of the inputs of a golden case.
fn elbo_batch(given: &BTreeMap<String, Tensor>) -> ElboBatch {
    let [valid, history_shown, successor_shown, eps] = ["valid", "history_shown", "successor_shown", "eps"].map(|name| given[name].clone());
    let tokens = tokens_of(|name| given[name].clone());
    ElboBatch { tokens, valid, history_shown, successor_shown, eps, context: None, believed: given.get("believed").cloned() }
}

/// The ELBO and its gradients.
#[test]
fn elbo_against_pytorch() {
    Golden::of("elbo").check_training(|given, params| {
        let terms = LatentModel::new(&golden_latent(2, 7), LAYOUT, params)?.elbo(&elbo_batch(given), &elbo_options())?;
        let named = [("loss", terms.loss), ("state_error", terms.state_error), ("reward_error", terms.reward_error), ("kl", terms.kl)];
        Ok(named.map(|(name, term)| (name.into(), term)).into())
    });
}

fn tokens_of<V>(value: impl Fn(&str) -> V) -> Tokens<V> {
    let [state, action, reward, present, noise] = ["state", "action", "reward", "present", "noise"].map(value);
    Tokens { state, action, reward, present, noise, before: None, surprises: None }
}
