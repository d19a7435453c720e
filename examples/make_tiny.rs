//! Writes `models/tiny`: a small model with seeded random weights and plain units, for tests and for trying the service.
//!
//!     cargo run --release --example make_tiny

#[path = "shared/random_weights.rs"]
mod random_weights;

use ada_diffuser::model::{config::ModelConfig, denoiser::DenoiserConfig, latent::LatentConfig, trajectory::Layout};
use std::path::Path;

const SEED: u64 = 7;

fn main() -> anyhow::Result<()> {
    let layout = Layout { state_dim: 4, action_dim: 2 };
    let (latent, denoiser) = (LatentConfig { dim: 6, hidden: 32 }, DenoiserConfig::Unet { widths: vec![8, 16, 16] });
    let plain = ModelConfig::plain(layout, Some(latent), denoiser);
    let config = ModelConfig { state_clip: 10.0, sub_steps_trained: vec![2, 3, 5], ..plain };
    random_weights::save(Path::new("models/tiny"), &config, SEED)?;
    println!("wrote models/tiny");
    Ok(())
}
