//! Times one denoiser in the words of `benches/peers/torch_denoisers.py`, so that a comparison can be made in one run:
//!
//!     cargo run --release --example time_denoisers -- --net unet --widths 32,64,64,64 --batch 32 --threads 2 --what forward
//!
//! Prints one JSON line with the median milliseconds. More threads share a batch as the workers of a server do, each taking whole rows.

use ada_diffuser::model::{
    Networks,
    config::ModelConfig,
    denoiser::{Denoiser, Given},
    method::{Backbone, Diffused, Diffusion, GruLatent, Looks},
    nn::{Activations, Buffer, Form, Layer, Params, Precision},
    noise::Philox,
    trajectory::Layout,
};
use ada_diffuser::restart;
use ada_diffuser::train::{optimizer::Adam, parallel::side_by_side};
use candle_core::{Result, Tensor, backprop::GradStore};
use clap::{Parser, ValueEnum};
use std::{sync::Barrier, time::Instant};

/// Noisy window of HalfCheetah: 17 states and 6 actions, with 20 latents beside.
const LAYOUT: Layout = Layout { state_dim: 17, action_dim: 6 };
const LATENT: usize = 20;
const LEVELS: usize = 150;

/// Times one denoiser of HalfCheetah's sizes.
#[derive(Parser)]
struct Flags {
    /// Which backbone.
    #[arg(long, value_enum, default_value = "unet")]
    net: Net,
    /// Widths of the U-Net, by depth.
    #[arg(long, value_delimiter = ',', default_value = "32,64,64,64")]
    widths: Vec<usize>,
    /// Width of the transformers; their heads are 32 wide.
    #[arg(long, default_value_t = 256)]
    width: usize,
    /// Blocks of the transformers.
    #[arg(long, default_value_t = 2)]
    depth: usize,
    /// Positions of a window.
    #[arg(long, default_value_t = 16)]
    len: usize,
    /// Windows.
    #[arg(long, default_value_t = 1)]
    batch: usize,
    /// Threads that share them.
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// What is timed.
    #[arg(long, value_enum, default_value = "forward")]
    what: What,
    /// How weights are held (forward and bound).
    #[arg(long, value_enum, default_value = "f32")]
    weights: Weights,
    /// For so long.
    #[arg(long, default_value_t = 2.0)]
    seconds: f64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Net {
    Unet,
    Dit,
    /// A policy of actions alone: encoder and decoder, with one real step to read.
    Dp,
}

#[derive(Clone, Copy, ValueEnum)]
enum Weights {
    F32,
    Bf16,
}

#[derive(Clone, Copy, ValueEnum)]
enum What {
    /// One evaluation of all windows.
    Forward,
    /// The matrix products of an evaluation alone, as the kernels run them (with padding and what lies side by side copied), without all
    /// that stands between them.
    Bound,
    /// One training step: mean square error, its gradient, Adam.
    Train,
}

fn main() -> anyhow::Result<()> {
    let flags = Flags::parse();
    let shared = flags.threads > 0 && flags.batch > 0 && flags.batch.is_multiple_of(flags.threads);
    anyhow::ensure!(shared, "--batch {} cannot be shared by --threads {}", flags.batch, flags.threads);
    // As the trainer does.
    restart::with_environment(&[&restart::ONE_THREAD_EACH[..], &restart::KEEP_MEMORY].concat())?;
    let config = config(&flags);
    let ms = match flags.what {
        What::Forward => forward::<Buffer>(&flags, &config)?,
        What::Bound => forward::<Bare>(&flags, &config)?,
        What::Train => train(&flags, &config)?,
    };
    let what = match flags.what {
        What::Forward => "forward",
        What::Bound => "bound",
        What::Train => "train",
    };
    let net = match flags.net {
        Net::Unet => "unet",
        Net::Dit => "dit",
        Net::Dp => "dp",
    };
    let widths = flags.widths.iter().map(usize::to_string).collect::<Vec<_>>().join(",");
    println!(
        r#"{{"what":"{what}","net":"{net}","widths":"{widths}","len":{},"batch":{},"threads":{},"ms":{ms:.4}}}"#,
        flags.len, flags.batch, flags.threads
    );
    Ok(())
}

fn config(flags: &Flags) -> ModelConfig {
    let backbone = match flags.net {
        Net::Unet => Backbone::Unet { widths: flags.widths.clone() },
        Net::Dit => Backbone::dit(flags.width, flags.depth, flags.width / 32),
        Net::Dp => {
            Backbone::EncoderDecoder { width: flags.width, depth: flags.depth, heads: flags.width / 32, encoder_depth: 0, dropout: 0.0 }
        }
    };
    let latent = GruLatent::plain(LATENT, 64, Looks::Block(4));
    let mut config = ModelConfig::plain(LAYOUT, Some(latent), backbone);
    (config.method.plan.horizon, config.method.plan.level_max) = (flags.len, LEVELS);
    if matches!(flags.net, Net::Dp) {
        config.method.plan.diffused = Diffused::Action;
    }
    config
}

/// The networks as a server has them: weights constant and packed once.
fn frozen(config: &ModelConfig, weights: Weights) -> anyhow::Result<Networks> {
    let fresh = Params::fresh(0);
    Networks::new(config.layout, &config.method, &fresh)?;
    let tensors = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    let precision = if matches!(weights, Weights::Bf16) { Precision::Bf16 } else { Precision::F32 };
    Ok(Networks::new(config.layout, &config.method, &Params::loaded_as(tensors, precision))?)
}

fn forward<V: Activations>(flags: &Flags, config: &ModelConfig) -> anyhow::Result<f64> {
    let networks = frozen(config, flags.weights)?;
    let shape = (flags.batch.div_ceil(flags.threads), flags.len);
    let (plan, net) = (&config.method.plan, &networks.denoiser);
    let alone = median(rounds::<V>((net, plan), shape, &Barrier::new(1), 10)?);
    let (count, meet) = ((flags.seconds * 1e3 / alone) as usize + 10, Barrier::new(flags.threads));
    std::thread::scope(|scope| {
        let meet = &meet;
        let others: Vec<_> = (1..flags.threads).map(|_| scope.spawn(move || rounds::<V>((net, plan), shape, meet, count))).collect();
        let times = rounds::<V>((net, plan), shape, meet, count);
        for other in others {
            other.join().map_err(|_| anyhow::anyhow!("a thread ended by panic"))??;
        }
        times.map(median)
    })
}

/// Milliseconds of each round, from the moment all threads meet until each has evaluated its windows.
fn rounds<V: Activations>(
    (net, plan): (&Denoiser, &Diffusion),
    (batch, len): (usize, usize),
    meet: &Barrier,
    count: usize,
) -> anyhow::Result<Vec<f64>> {
    let (x, latents): (V, V) = (normals([batch, len, plan.width(LAYOUT.widths())])?, normals([batch, len, LATENT])?);
    let observed = observed(plan, batch)?;
    let levels: Vec<f32> = (0..batch * len).map(|i| (i * 7 % LEVELS) as f32).collect();
    let round = |_| {
        meet.wait();
        let begin = Instant::now();
        net.predict(&x, &Given { latents: Some(&latents), observed: observed.as_ref(), ..Given::levels(&levels) })?;
        meet.wait();
        Ok(begin.elapsed().as_secs_f64() * 1e3)
    };
    (0..count).map(round).collect()
}

/// A buffer on which only matrix products do any work: what would be done in place is left out.
#[derive(Clone)]
struct Bare(Buffer);

impl Activations for Bare {
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        Buffer::generate(shape, write).map(Self)
    }

    fn shape(&self) -> Result<[usize; 3]> {
        self.0.shape()
    }

    fn run(&self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        match others {
            _ if layer.op().form() != Form::Anew => Ok(self.clone()),
            [] => self.0.run(layer, &[]).map(Self),
            [a] => self.0.run(layer, &[&a.0]).map(Self),
            [a, b] => self.0.run(layer, &[&a.0, &b.0]).map(Self),
            _ => candle_core::bail!("the denoiser puts two or three side by side"),
        }
    }

    fn run_in_place(self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        if layer.op().form() == Form::Anew { self.run(layer, others) } else { Ok(self) }
    }
}

fn train(flags: &Flags, config: &ModelConfig) -> anyhow::Result<f64> {
    let params = Params::fresh(0);
    let networks = Networks::new(config.layout, &config.method, &params)?;
    let vars = params.vars();
    let mut adam = Adam::new(&vars, |_| Some(0), 0.0, f64::INFINITY);
    let (plan, share) = (&config.method.plan, flags.batch / flags.threads);
    let observed: Option<Tensor> = observed(plan, share)?;
    let shards: Vec<(Tensor, Tensor, Tensor)> = (0..flags.threads)
        .map(|_| {
            let (shape, width) = (|width| [share, flags.len, width], plan.width(LAYOUT.widths()));
            Ok((normals(shape(width))?, normals(shape(LATENT))?, normals(shape(width))?))
        })
        .collect::<anyhow::Result<_>>()?;
    let gradient = |(x, latents, target): &(Tensor, Tensor, Tensor)| -> anyhow::Result<GradStore> {
        let levels: Vec<f32> = (0..x.dim(0)? * flags.len).map(|i| (i * 7 % LEVELS) as f32).collect();
        let given = Given { latents: Some(latents), observed: observed.as_ref(), ..Given::levels(&levels) };
        let y = networks.denoiser.predict(x, &given)?;
        Ok((y - target)?.sqr()?.mean_all()?.affine(1.0 / flags.threads as f64, 0.0)?.backward()?)
    };
    let gradient = &gradient;
    let mut times = Vec::new();
    let begin = Instant::now();
    while begin.elapsed().as_secs_f64() < flags.seconds || times.len() < 10 {
        let begin = Instant::now();
        let grads = side_by_side(shards.iter().map(|shard| move || gradient(shard)).collect());
        adam.step(&grads.into_iter().collect::<anyhow::Result<Vec<_>>>()?, &[3e-4])?;
        times.push(begin.elapsed().as_secs_f64() * 1e3);
    }
    Ok(median(times))
}

/// The real steps that a policy reads.
fn observed<V: Activations>(plan: &Diffusion, batch: usize) -> anyhow::Result<Option<V>> {
    let [steps, width] = plan.observed(LAYOUT.widths());
    (steps > 0).then(|| normals([batch, 1, steps * width])).transpose()
}

fn normals<V: Activations>(shape: [usize; 3]) -> anyhow::Result<V> {
    let mut stream = Philox::new(1);
    Ok(V::generate(shape, |out| out.iter_mut().for_each(|value| *value = stream.normal()))?)
}

fn median(mut times: Vec<f64>) -> f64 {
    let warm = times.len() / 10;
    let times = &mut times[warm..];
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
