//! Writes `models/tiny`: a small model with seeded random weights and plain units, for tests and for trying the service.
//!
//!     cargo run --release --example make_tiny

#[path = "shared/random_weights.rs"]
mod random_weights;

use ada_diffuser::model::{
    config::ModelConfig,
    method::{Backbone, GruLatent, Looks},
    trajectory::Layout,
};
use std::path::Path;

const SEED: u64 = 7;

fn main() -> anyhow::Result<()> {
    let layout = Layout { state_dim: 4, action_dim: 2 };
    let (latent, backbone) = (GruLatent::plain(6, 32, Looks::Block(4)), Backbone::Unet { widths: vec![8, 16, 16] });
    let mut config = ModelConfig::plain(layout, Some(latent), backbone);
    config.method.plan.clip = 10.0;
    config.trained.sub_steps = vec![1, 2, 3, 5];
    random_weights::save(Path::new("models/tiny"), &config, SEED)?;
    println!("wrote models/tiny");
    Ok(())
}
