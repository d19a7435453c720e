//! Time of a denoiser forward, of an act, and of a training step, on one thread.
//!
//!     RAYON_NUM_THREADS=1 CANDLE_NUM_THREADS=1 cargo bench --bench denoiser

use ada_diffuser::model::{
    Networks,
    agent::{Agent, Observation, SamplerOptions},
    config::{ModelConfig, Restart},
    denoiser::{Condition, DenoiserConfig},
    diffusion::refine::{LatentRouting, RefineOptions, WindowBatch},
    latent::{LatentConfig, Tokens},
    nn::{Buffer, Params, Value},
    noise::Philox,
    trajectory::{Layout, TokenRef},
};
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;

const T: usize = 16;
const STATE: usize = 17;
const ACTION: usize = 6;

fn config(denoiser: DenoiserConfig) -> ModelConfig {
    let plain = ModelConfig::plain(Layout { state_dim: STATE, action_dim: ACTION }, Some(LatentConfig { dim: 20, hidden: 64 }), denoiser);
    let never = Restart { renoise_distance: 1e6, cold_distance: 1e7, latent_jump: f32::INFINITY };
    ModelConfig { plan_horizon: T, block_len: 10, level_max: 150, restart: never, ..plain }
}

fn nets() -> [(&'static str, DenoiserConfig); 3] {
    [
        ("unet-narrow", DenoiserConfig::Unet { widths: vec![32, 64, 64, 64] }),
        ("unet-wide", DenoiserConfig::Unet { widths: vec![32, 64, 128, 256] }),
        ("dit-48x2", DenoiserConfig::Dit { width: 48, depth: 2, heads: 4 }),
    ]
}

/// The same networks as a server has them: weights constant and packed once.
fn frozen(config: &ModelConfig) -> Networks {
    let fresh = Params::fresh(0);
    Networks::new(config, &fresh).expect("sizes fit");
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().copy().expect("copies"))).collect();
    Networks::new(config, &Params::loaded(tensors)).expect("same names")
}

fn random<V: Value>(shape: [usize; 3]) -> V {
    let mut stream = Philox::new(1);
    V::generate(shape, |out| out.iter_mut().for_each(|value| *value = stream.normal())).expect("count fits")
}

fn forward(c: &mut Criterion) {
    for (name, net) in nets() {
        let config = config(net);
        let networks = frozen(&config);
        for batch in [1, 32] {
            let (x, latents): (Buffer, Buffer) = (random([batch, T, STATE + ACTION]), random([batch, T, 20]));
            let levels: Vec<f32> = (0..batch * T).map(|i| (i * 7 % 150) as f32).collect();
            let condition = Condition { levels: &levels, latents: Some(&latents), observed: None };
            c.bench_function(&format!("forward/{name}/batch-{batch}"), |b| {
                b.iter(|| black_box(networks.denoiser.predict(&x, &condition).expect("predicts")))
            });
        }
    }
}

fn act(c: &mut Criterion) {
    for (name, net) in nets() {
        let config = config(net);
        let agent = Agent::new(config.clone(), frozen(&config), "bench".into());
        for streaming in [true, false] {
            let episode = agent.open(1, &SamplerOptions { streaming, ..config.sampler.clone() }).expect("opens");
            let observation = Observation { state: vec![0.1; STATE], ..Observation::default() };
            let (episode, _) = agent.act(&episode, &observation).expect("acts");
            let kind = if streaming { "streaming" } else { "cold" };
            c.bench_function(&format!("act/{name}/{kind}"), |b| b.iter(|| black_box(agent.act(&episode, &observation).expect("acts"))));
        }
    }
}

fn train_step(c: &mut Criterion) {
    let batch_size = 64;
    for (name, net) in nets() {
        let config = config(net);
        let params = Params::fresh(0);
        let networks = Networks::new(&config, &params).expect("sizes fit");
        let token = TokenRef { state: Some(&[0.1; STATE]), action: Some(&[0.1; ACTION]), reward: Some(0.1), noise: 0.0 };
        let batch = WindowBatch {
            history: Tokens::pack(config.layout, 0..batch_size, 10, |_, _| token).expect("packs"),
            window: random([batch_size, T, STATE + ACTION]),
            observed: None,
            rows: (0..batch_size).map(|i| i % T).collect(),
            inpaint: vec![true; batch_size],
            noise: random([batch_size, T, STATE + ACTION]),
        };
        let options = RefineOptions { routing: LatentRouting::Matched, first_action_weight: 10.0, sub_steps: 1 };
        c.bench_function(&format!("train-step/{name}/batch-{batch_size}"), |b| {
            b.iter(|| networks.refine_loss(&config, &batch, &options).expect("computes").loss.backward().expect("differentiates"))
        });
    }
}

criterion_group! { name = all; config = Criterion::default().sample_size(20).warm_up_time(std::time::Duration::from_millis(500)).measurement_time(std::time::Duration::from_secs(2)); targets = forward, act, train_step }
criterion_main!(all);
