//! Writes a checkpoint with seeded random weights, of any size: to measure a server with, not to act with.
//!
//!     cargo run --release --example make_random -- --out out/models/wide --widths 32,64,128,256
//!     cargo run --release --example make_random -- --out out/models/dit --net dit --width 256 --depth 2 --heads 8
//!     cargo run --release --example make_random -- --out out/models/led --guide-widths 32,64 --told-return
//!     cargo run --release --example make_random -- --out out/models/idql --net idql --latent-dim 0

#[path = "shared/random_weights.rs"]
mod random_weights;

use ada_diffuser::model::{
    checkpoint,
    config::{Defaults, ModelConfig, Restart},
    method::{AlphaBar, Backbone, Diffused, GruLatent, Guide, Looks, Schedule, Target, Told},
    normalizer::Affine,
    options::SamplerOptions,
    trajectory::Layout,
};
use clap::{Parser, ValueEnum};
use std::path::PathBuf;

/// Writes a checkpoint with seeded random weights. The default sizes are HalfCheetah's with the narrow U-Net.
///
/// Its sessions stream, and no jump of state or latent starts a window anew: so an act costs one network evaluation from the second on,
/// whatever is observed. Put the directory among a server's models (`ada-server --models out/models`).
#[derive(Parser)]
struct Flags {
    /// Directory of the checkpoint; its name is the model's.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Backbone of the denoiser.
    #[arg(long, value_enum, default_value_t = Net::Unet)]
    net: Net,
    /// U-Net: channels of each depth; the horizon must be divisible by 2^(depths - 1).
    #[arg(long, value_delimiter = ',', default_value = "32,64,64,64", value_name = "N,N,..")]
    widths: Vec<usize>,
    /// DiT: width of a token.
    #[arg(long, default_value_t = 256)]
    width: usize,
    /// DiT: number of blocks.
    #[arg(long, default_value_t = 2)]
    depth: usize,
    /// DiT: attention heads.
    #[arg(long, default_value_t = 8)]
    heads: usize,
    /// Values of a state.
    #[arg(long, default_value_t = 17)]
    state_dim: usize,
    /// Values of an action.
    #[arg(long, default_value_t = 6)]
    action_dim: usize,
    /// Positions that the planner generates (T).
    #[arg(long, default_value_t = 16)]
    plan_horizon: usize,
    /// Real steps that the latent looks back on (T_x).
    #[arg(long, default_value_t = 10)]
    block_len: usize,
    /// Width of the latent; 0: a model without latents.
    #[arg(long, default_value_t = 20)]
    latent_dim: usize,
    /// Hidden size of the latent's GRU.
    #[arg(long, default_value_t = 64)]
    hidden: usize,
    /// Number of diffusion levels (K).
    #[arg(long, default_value_t = 150)]
    level_max: usize,
    /// Channels of each depth of a value network, so that sessions may ask for guidance and for candidates; without it there is none.
    #[arg(long, value_delimiter = ',', value_name = "N,N,..")]
    guide_widths: Option<Vec<usize>>,
    /// Whether sessions may tell a return.
    #[arg(long)]
    told_return: bool,
    /// Seed of the weights.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Net {
    /// Temporal U-Net.
    Unet,
    /// Diffusion transformer.
    Dit,
    /// The actor of IDQL, one action at a time, with critics that choose among 64: of the original's sizes.
    Idql,
}

impl Flags {
    fn config(&self) -> ModelConfig {
        let backbone = match self.net {
            Net::Unet => Backbone::Unet { widths: self.widths.clone() },
            Net::Dit => Backbone::dit(self.width, self.depth, self.heads),
            Net::Idql => Backbone::Mlp { width: 256, depth: 3, dropout: 0.1 },
        };
        let looks = Looks::Block(self.block_len);
        let latent = (self.latent_dim > 0).then_some(GruLatent::plain(self.latent_dim, self.hidden, looks));
        let layout = Layout { state_dim: self.state_dim, action_dim: self.action_dim };
        let mut config = ModelConfig::plain(layout, latent, backbone);
        (config.method.plan.horizon, config.method.plan.level_max) = (self.plan_horizon, self.level_max);
        config.method.guide = self.guide_widths.clone().map(|widths| Guide::Value { widths });
        config.method.told = self.told_return.then_some(Told::Return).into_iter().collect();
        config.defaults = Defaults {
            sampler: SamplerOptions { temperature: 0.0, ..SamplerOptions::default() },
            // Finite, since JSON has no infinity, and out of reach.
            restart: Restart { renoise_distance: 1e6, cold_distance: 1e7, latent_jump: 1e30, ..Restart::default() },
        };
        if matches!(self.net, Net::Idql) {
            choosing(&mut config);
        }
        config.units.returns = config.method.asks_for_returns().then(|| Affine::identity(1));
        config
    }
}

/// One action in five evaluations, and critics that choose.
fn choosing(config: &mut ModelConfig) {
    let plan = &mut config.method.plan;
    (plan.diffused, plan.horizon, plan.level_max) = (Diffused::Action, 1, 5);
    (plan.alpha, plan.target, plan.schedule) = (AlphaBar::VpLinear, Target::Eps, Schedule::Uniform { steps: 5 });
    config.method.guide = Some(Guide::Critic { width: 256 });
    (config.trained.action_horizons, config.trained.refined) = (vec![1], false);
    config.defaults.sampler =
        SamplerOptions { candidates: 64, eta: 1.0, temperature: 1.0, kappa: 0.0, streaming: false, ..SamplerOptions::default() };
}

fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    random_weights::save(&flags.out, &flags.config(), flags.seed)?;
    checkpoint::load(&flags.out)?;
    println!("wrote {}", flags.out.display());
    Ok(())
}
