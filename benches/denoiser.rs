//! Time of a denoiser forward, of a value and its gradient, of an act, and of a training step, on one thread.
//!
//!     RAYON_NUM_THREADS=1 CANDLE_NUM_THREADS=1 cargo bench --bench denoiser

use ada_diffuser::model::{
    Networks,
    agent::{Agent, Observation},
    config::{ModelConfig, Restart},
    critic::{Sizes, Value},
    denoiser::Given,
    diffusion::refine::{LatentRouting, RefineOptions, Standing, WindowBatch},
    latent::Tokens,
    method::{Actions, Backbone, Baseline, Future, GruLatent, LatentSource, Looks},
    nn::{Activations, Buffer, Params, Traced, gradient},
    noise::Philox,
    options::SamplerOptions,
    trajectory::{Layout, TokenRef},
};
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;

const T: usize = 16;
const STATE: usize = 17;
const ACTION: usize = 6;

fn config(backbone: Backbone) -> ModelConfig {
    let latent = GruLatent::plain(20, 64, Looks::Block(10));
    let mut config = ModelConfig::plain(Layout { state_dim: STATE, action_dim: ACTION }, Some(latent), backbone);
    (config.method.plan.horizon, config.method.plan.level_max) = (T, 150);
    config.defaults.restart = Restart { renoise_distance: 1e6, cold_distance: 1e7, latent_jump: f32::INFINITY, ..Restart::default() };
    config
}

fn nets() -> [(&'static str, Backbone); 3] {
    [
        ("unet-narrow", Backbone::Unet { widths: vec![32, 64, 64, 64] }),
        ("unet-wide", Backbone::Unet { widths: vec![32, 64, 128, 256] }),
        ("dit-48x2", Backbone::dit(48, 2, 4)),
    ]
}

/// The same networks as a server has them: weights constant and packed once.
fn frozen(config: &ModelConfig) -> Networks {
    constant(|params| Networks::new(config.layout, &config.method, params).expect("sizes fit"))
}

fn constant<N>(build: impl Fn(&Params) -> N) -> N {
    let fresh = Params::fresh(0);
    build(&fresh);
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().copy().expect("copies"))).collect();
    build(&Params::loaded(tensors))
}

fn random<V: Activations>(shape: [usize; 3]) -> V {
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
            let condition = Given { latents: Some(&latents), ..Given::levels(&levels) };
            c.bench_function(&format!("forward/{name}/batch-{batch}"), |b| {
                b.iter(|| black_box(networks.denoiser.predict(&x, &condition).expect("predicts")))
            });
        }
    }
}

/// A value, and with its gradient to the window.
fn value(c: &mut Criterion) {
    let sizes = Sizes { columns: STATE + ACTION, latent_dim: 20, horizon: T, widths: &[32, 64, 64] };
    let network = constant(|params| Value::new(sizes, 150, &params.with_way_back()).expect("sizes fit"));
    for batch in [1, 64] {
        let (x, latents): (Buffer, Buffer) = (random([batch, T, STATE + ACTION]), random([batch, T, 20]));
        let levels: Vec<f32> = (0..batch * T).map(|i| (i * 7 % 150) as f32).collect();
        c.bench_function(&format!("value/forward/batch-{batch}"), |b| {
            let given = Given { latents: Some(&latents), ..Given::levels(&levels) };
            b.iter(|| black_box(network.predict(&x, &given).expect("predicts")))
        });
        c.bench_function(&format!("value/gradient/batch-{batch}"), |b| {
            b.iter(|| {
                let run = |[x]: [Traced; 1]| {
                    let latents = Traced::constant(latents.clone())?;
                    network.predict(&x, &Given { latents: Some(&latents), ..Given::levels(&levels) })
                };
                black_box(gradient([x.clone()], run, |_, grad| grad.fill(1.0)).expect("has a way back"))
            })
        });
    }
}

fn act(c: &mut Criterion) {
    for (name, net) in nets() {
        let config = config(net);
        let agent = Agent::new(config.clone(), frozen(&config), "bench".into());
        for streaming in [true, false] {
            let episode = agent.open(1, &SamplerOptions { streaming, ..config.defaults.sampler.clone() }).expect("opens");
            let observation = Observation { state: vec![0.1; STATE], ..Observation::default() };
            let (episode, _) = agent.act(&episode, &observation).expect("acts");
            let kind = if streaming { "streaming" } else { "cold" };
            c.bench_function(&format!("act/{name}/{kind}"), |b| b.iter(|| black_box(agent.act(&episode, &observation).expect("acts"))));
        }
    }
}

/// What latents cost over the same network without them, and the zig-zag over latents alone.
fn overhead(c: &mut Criterion) {
    let latent = LatentSource::Gru(GruLatent::plain(8, 64, Looks::Block(10)));
    for (name, net) in nets() {
        for (what, latent, kappa) in
            [("without", LatentSource::None, 0.0), ("latents", latent.clone(), 0.0), ("latents-and-zigzag", latent.clone(), 0.1)]
        {
            let mut config = config(net.clone());
            (config.method.latent, config.trained.refined) = (latent, kappa > 0.0);
            config.defaults.sampler.kappa = kappa;
            let agent = Agent::new(config.clone(), frozen(&config), "bench".into());
            for (kind, streaming) in [("streaming", true), ("cold", false)] {
                let options = SamplerOptions { streaming, ..config.defaults.sampler.clone() };
                let observation = Observation { state: vec![0.1; STATE], ..Observation::default() };
                let (episode, _) = agent.act(&agent.open(1, &options).expect("opens"), &observation).expect("acts");
                c.bench_function(&format!("act/overhead/{name}/{kind}/{what}"), |b| {
                    b.iter(|| black_box(agent.act(&episode, &observation).expect("acts")))
                });
            }
        }
    }
}

/// What a latent costs an act that streams: a block looked at anew, a GRU that runs on, and the same beside a baseline, without and with a look
/// at actions.
fn latents(c: &mut Criterion) {
    let plain = |looks, future| GruLatent { future, ..GruLatent::plain(8, 64, looks) };
    let running = || plain(Looks::Running, Future::Held);
    let baseline = Some(Baseline { width: 256 });
    for (name, latent) in [
        ("block", plain(Looks::Block(10), Future::Prior)),
        ("running", running()),
        ("surprises", GruLatent { baseline, actions: Actions::Unseen, ..running() }),
        ("surprises-of-actions", GruLatent { baseline, ..running() }),
    ] {
        let mut config = config(Backbone::Unet { widths: vec![32, 64, 64, 64] });
        (config.method.latent, config.trained.refined) = (LatentSource::Gru(latent), false);
        config.defaults.sampler.kappa = 0.0;
        let agent = Agent::new(config.clone(), frozen(&config), "bench".into());
        let episode = agent.open(1, &SamplerOptions { streaming: true, ..config.defaults.sampler.clone() }).expect("opens");
        let observation = Observation { state: vec![0.1; STATE], ..Observation::default() };
        let (episode, _) = agent.act(&episode, &observation).expect("acts");
        c.bench_function(&format!("act/latent/{name}"), |b| b.iter(|| black_box(agent.act(&episode, &observation).expect("acts"))));
    }
}

fn train_step(c: &mut Criterion) {
    let batch_size = 64;
    for (name, net) in nets() {
        let config = config(net);
        let params = Params::fresh(0);
        let networks = Networks::new(config.layout, &config.method, &params).expect("sizes fit");
        let token = TokenRef { state: Some(&[0.1; STATE]), action: Some(&[0.1; ACTION]), reward: Some(0.1), noise: 0.0 };
        let batch = WindowBatch {
            history: Tokens::pack(config.layout, 0..batch_size, 10, None, |_, _| token).expect("packs"),
            history_lens: None,
            window: random([batch_size, T, STATE + ACTION]),
            observed: None,
            at: (0..batch_size).map(|i| Standing::Row(i % T)).collect(),
            imagined: vec![0; batch_size],
            noise: random([batch_size, T, STATE + ACTION]),
            told: None,
            truth: None,
            segments: None,
            returns: None,
            chance: None,
        };
        let options = RefineOptions { routing: LatentRouting::Matched, first_action_weight: 10.0, sub_steps: 1, moves_latents: true };
        c.bench_function(&format!("train-step/{name}/batch-{batch_size}"), |b| {
            b.iter(|| {
                networks.refine_loss(&config.method.plan, &batch, &options).expect("computes").loss.backward().expect("differentiates")
            })
        });
    }
}

criterion_group! { name = all; config = Criterion::default().sample_size(20).warm_up_time(std::time::Duration::from_millis(500)).measurement_time(std::time::Duration::from_secs(2)); targets = forward, value, act, overhead, latents, train_step }
criterion_main!(all);
