//! The leak, held shut: training latents depend on nothing that the sampler does not have.

use super::*;
use crate::model::{
    config::ModelConfig,
    method::{Backbone, GruLatent, Looks},
    method::{LatentSource, Schedule},
    nn::params::Params,
    noise::Philox,
    trajectory::Layout,
    trajectory::Token,
};

const BATCH: usize = 6;
const LEN: usize = 4;
const DIM: usize = 5;
const STATE: usize = 3;

fn config() -> ModelConfig {
    let layout = Layout { state_dim: STATE, action_dim: DIM - STATE };
    let latent = GruLatent::plain(4, 8, Looks::Block(3));
    let mut config = ModelConfig::plain(layout, Some(latent), Backbone::dit(16, 1, 2));
    (config.method.plan.horizon, config.method.plan.level_max) = (LEN, 20);
    config
}

fn options(routing: LatentRouting) -> RefineOptions {
    RefineOptions { routing, first_action_weight: 10.0, sub_steps: 1, moves_latents: true }
}

fn values(seed: u64) -> Vec<f32> {
    let mut stream = Philox::new(seed);
    (0..BATCH * LEN * DIM).map(|_| stream.normal()).collect()
}

fn batch(window: Vec<f32>, noise: Vec<f32>, row: usize) -> WindowBatch {
    let token = |i: usize| Token {
        state: Some(vec![i as f32 * 0.1; STATE]),
        action: Some(vec![0.3, -0.1 * i as f32]),
        reward: Some(0.2),
        noise: 0.0,
    };
    let history: Vec<Vec<Token>> = (0..BATCH).map(|b| (0..3).map(|i| token(b + i)).collect()).collect();
    let tensor = |values| Tensor::from_vec(values, (BATCH, LEN, DIM), &Device::Cpu).unwrap();
    WindowBatch {
        history: Tokens::pack(config().layout, history.iter(), 3, None, |row, position| row[position].view()).unwrap(),
        history_lens: None,
        window: tensor(window),
        observed: None,
        at: vec![Standing::Row(row); BATCH],
        imagined: vec![0; BATCH],
        noise: tensor(noise),
        told: None,
        truth: None,
        segments: None,
        returns: None,
        chance: None,
    }
}

/// The latents of the first (or only) routing of a batch.
fn latents(networks: &Networks, batch: &WindowBatch, routing: LatentRouting) -> Vec<f32> {
    let noised = Noised::new(&config().method.plan, batch, &options(routing)).unwrap();
    let routed = networks.route(batch, &noised, routing).unwrap().remove(0);
    routed.latents.unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Another clean window with the same current state, and noise chosen so that at `row` the first `kept` positions look the same.
fn perturbed(window: &[f32], noise: &[f32], row: usize, kept: usize) -> (Vec<f32>, Vec<f32>) {
    let (other, process) = (values(77), Process::cosine(20));
    let levels = Table::new(Schedule::LADDER, [0, LEN], 1, 20).unwrap().row(row);
    let (mut window, mut noise) = (window.to_vec(), noise.to_vec());
    for index in 0..window.len() {
        let (position, column) = (index / DIM % LEN, index % DIM);
        if position == 0 && column < STATE {
            continue;
        }
        let (signal, sigma) = process.q_sample(levels[position]);
        if position < kept {
            noise[index] -= signal * other[index] / sigma;
        }
        window[index] += other[index];
    }
    (window, noise)
}

#[test]
fn matched_latents_see_only_what_the_sampler_has() {
    let networks = Networks::new(config().layout, &config().method, &Params::fresh(1)).unwrap();
    let (window, noise) = (values(1), values(2));
    for row in 0..LEN {
        // Above READY the window is unseen; at READY its first two positions are seen as noised.
        let kept = if row == LEN - 1 { 2 } else { 0 };
        let (other_window, other_noise) = perturbed(&window, &noise, row, kept);
        let (a, b) = (batch(window.clone(), noise.clone(), row), batch(other_window, other_noise, row));
        let distance = |routing| {
            let (a, b) = (latents(&networks, &a, routing), latents(&networks, &b, routing));
            a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(distance(LatentRouting::Matched) < 1e-5, "row {row}");
        assert_eq!(distance(LatentRouting::PriorOnly), 0.0, "row {row}");
        assert!(distance(LatentRouting::Literal) > 1e-3, "the literal reading should leak, or this test sees nothing (row {row})");
    }
}

/// At READY the refined latent does look at the noised positions 0 and 1: the zig-zag has something to work on.
#[test]
fn refined_latents_see_the_noised_positions() {
    let networks = Networks::new(config().layout, &config().method, &Params::fresh(1)).unwrap();
    let at = |row, noise| latents(&networks, &batch(values(1), noise, row), LatentRouting::Matched);
    assert_ne!(at(LEN - 1, values(2)), at(LEN - 1, values(3)));
    assert_eq!(at(0, values(2)), at(0, values(3)));
}

/// The loss against one computed by hand: weights 10 on the first action, none on the inpainted state, 1 elsewhere.
#[test]
fn loss_is_the_weighted_mean_square() {
    let mut config = config();
    config.method.latent = LatentSource::None;
    let networks = Networks::new(config.layout, &config.method, &Params::fresh(1)).unwrap();
    let batch = batch(values(1), values(2), 2);
    let options = options(LatentRouting::Matched);
    let noised = Noised::new(&config.method.plan, &batch, &options).unwrap();
    let condition = Given::levels(&noised.levels);
    let x0: Vec<f32> = networks.denoiser.predict(&noised.x, &condition).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    let (mut sum, mut weight) = (0.0, 0.0);
    for (index, (x0, clean)) in x0.iter().zip(values(1)).enumerate() {
        let w = match (index / DIM % LEN, index % DIM < STATE) {
            (0, true) => 0.0,
            (0, false) => 10.0,
            _ => 1.0,
        };
        sum += w * (x0 - clean).powi(2);
        weight += w;
    }
    let terms = networks.refine_loss(&config.method.plan, &batch, &options).unwrap();
    let loss: f32 = terms.loss.to_scalar().unwrap();
    assert!((loss - sum / weight).abs() < 1e-4 * loss, "{loss} against {}", sum / weight);
    assert_eq!((terms.prior.1, terms.posterior.1), (BATCH, 0));
}

/// Gradients of the matched loss reach all three networks; the posterior's only where there are READY rows.
#[test]
fn gradients_reach_latents_and_denoiser() {
    let params = Params::fresh(1);
    let networks = Networks::new(config().layout, &config().method, &params).unwrap();
    let reached_if = |row, moves_latents| {
        let options = RefineOptions { moves_latents, ..options(LatentRouting::Matched) };
        let terms = networks.refine_loss(&config().method.plan, &batch(values(1), values(2), row), &options).unwrap();
        let grads = terms.loss.backward().unwrap();
        let reached = params
            .vars()
            .into_iter()
            .filter(|(_, var)| grads.get(var).is_some_and(|grad| grad.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap() > 0.0));
        reached.map(|(name, _)| name).collect::<Vec<_>>()
    };
    // The output layer starts at zero, so at first only it and the input skip move; the skip sees the latents.
    for row in [0, LEN - 1] {
        let names = reached_if(row, true);
        let facts = reached_if(row, false);
        assert!(facts.iter().all(|name| !name.starts_with("latent.")) && !facts.is_empty(), "{facts:?}");
        for needed in ["denoiser.input_skip.weight", "latent.encoder.gru.weight_hh_l0", "latent.prior.0.weight"] {
            assert!(names.iter().any(|name| name == needed), "{needed} is not reached from row {row}: {names:?}");
        }
    }
}
