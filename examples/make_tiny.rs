//! Writes `models/tiny`: a small model with seeded random weights and plain units, for tests and for trying the service.
//!
//!     cargo run --release --example make_tiny

use ada_diffuser::model::{
    Networks,
    agent::{LatentMode, SamplerOptions},
    checkpoint::{self, Provenance},
    config::{ModelConfig, Restart},
    denoiser::DenoiserConfig,
    latent::LatentConfig,
    nn::params::Params,
    normalizer::{Affine, Normalizer},
    trajectory::Layout,
};
use std::path::Path;

const SEED: u64 = 7;

fn main() -> anyhow::Result<()> {
    let (state_dim, action_dim) = (4, 2);
    let config = ModelConfig {
        layout: Layout { state_dim, action_dim },
        plan_horizon: 8,
        block_len: 4,
        obs_horizon: 1,
        level_max: 40,
        latent: Some(LatentConfig { dim: 6, hidden: 32 }),
        denoiser: DenoiserConfig::Unet { widths: vec![8, 16, 16] },
        state_clip: 10.0,
        action_low: vec![-1.0; action_dim],
        action_high: vec![1.0; action_dim],
        normalizer: Normalizer {
            state: Affine::identity(state_dim),
            action: Affine::identity(action_dim),
            reward: Affine::identity(1),
            state_change_std: vec![1.0; state_dim],
        },
        sub_steps_trained: vec![2, 3, 5],
        refined: true,
        latent_spread: 1.0,
        restart: Restart::default(),
        sampler: SamplerOptions {
            streaming: true,
            action_horizon: 1,
            sub_steps: 1,
            eta: 0.0,
            temperature: 0.5,
            kappa: 0.1,
            latent: LatentMode::Mean,
        },
    };
    let params = Params::fresh(SEED);
    Networks::new(&config, &params)?;
    let tensors = params.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    let provenance = Provenance { dataset: "none: random weights".into(), seed: SEED, ..Provenance::default() };
    checkpoint::save(Path::new("models/tiny"), &config, &tensors, &provenance)?;
    println!("wrote models/tiny");
    Ok(())
}
