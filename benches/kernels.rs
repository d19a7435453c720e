//! The kernels that training and inference spend their time in, on one core, in floating-point operations a second where that says
//! more than time. Sizes are those of the U-Net of widths 32, 64, 64, 64 on 16 steps.

use ada_diffuser::model::nn::kernels::{
    activation::{self, Activation},
    attention::{Attention, Grads, Looks},
    convolution::{ConvShape, Convolution},
    norm::{self, Norm, NormGrads},
};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use std::hint::black_box;

const BATCHES: [usize; 2] = [1, 64];

fn values(count: usize) -> Vec<f32> {
    (0..count).map(|i| (i % 97) as f32 / 48.0 - 1.0).collect()
}

/// Kernel 5, 64 to 64 channels, 8 steps: forward and both gradients, each with its packing where training packs.
fn convolution(c: &mut Criterion) {
    let shape = ConvShape { c_in: 64, c_out: 64, kernel: 5, stride: 1, padding: 2 };
    let weight = values(64 * 64 * 5);
    let (forward, back, mut dw) = (shape.pack_gather(&weight), shape.pack_spread(&weight), weight.clone());
    let mut group = c.benchmark_group("convolution");
    for batch in BATCHES {
        let plan = Convolution { shape, batch, wide_steps: 8, narrow_steps: 8 };
        let (x, dy) = (values(batch * 8 * 64), values(batch * 8 * 64));
        let mut out = x.clone();
        group.throughput(Throughput::Elements(2 * (batch * 8 * 64 * 64 * 5) as u64));
        group.bench_function(format!("forward, batch {batch}"), |b| b.iter(|| plan.gather(black_box(&x), &forward, None, &mut out)));
        group.bench_function(format!("input gradient, batch {batch}"), |b| b.iter(|| plan.spread(black_box(&dy), &back, None, &mut out)));
        group.bench_function(format!("weight gradient, batch {batch}"), |b| b.iter(|| plan.weight_grad(black_box(&x), &dy, &mut dw)));
    }
    group.throughput(Throughput::Elements(weight.len() as u64));
    group.bench_function("pack for forward", |b| b.iter(|| shape.pack_gather(black_box(&weight))));
    group.bench_function("pack for the input gradient", |b| b.iter(|| shape.pack_spread(black_box(&weight))));
    group.finish();
}

/// The linear layers of the DiT, 256 to 1024 channels on 32 windows of 42 tokens.
fn linear(c: &mut Criterion) {
    let shape = ConvShape { c_in: 256, c_out: 1024, kernel: 1, stride: 1, padding: 0 };
    let (weight, rows) = (values(256 * 1024), 32 * 42);
    let (forward, back) = (shape.pack_gather(&weight), shape.pack_spread(&weight));
    let plan = Convolution { shape, batch: 1, wide_steps: rows, narrow_steps: rows };
    let (x, dy) = (values(rows * 256), values(rows * 1024));
    let (mut y, mut dx, mut dw) = (dy.clone(), x.clone(), weight.clone());
    let mut group = c.benchmark_group("linear");
    group.throughput(Throughput::Elements(2 * (rows * 256 * 1024) as u64));
    group.bench_function("forward", |b| b.iter(|| plan.gather(black_box(&x), &forward, None, &mut y)));
    group.bench_function("input gradient", |b| b.iter(|| plan.spread(black_box(&dy), &back, None, &mut dx)));
    group.bench_function("weight gradient", |b| b.iter(|| plan.weight_grad(black_box(&x), &dy, &mut dw)));
    group.finish();
}

fn normalisation(c: &mut Criterion) {
    let mut group = c.benchmark_group("group norm and mish");
    let norm = Norm { steps: 8, channels: 64, groups: 8, eps: 1e-5, mish: true };
    let (weight, bias) = (values(64), values(64));
    for batch in BATCHES {
        let x = values(batch * 8 * 64);
        let (mut out, mut dx, mut d_weight, mut d_bias) = (x.clone(), x.clone(), weight.clone(), bias.clone());
        group.throughput(Throughput::Elements(x.len() as u64));
        group.bench_function(format!("forward, batch {batch}"), |b| b.iter(|| norm::in_place(norm, black_box(&mut out), &weight, &bias)));
        group.bench_function(format!("backward, batch {batch}"), |b| {
            b.iter(|| {
                dx.copy_from_slice(&x);
                let grads = NormGrads { x: &mut dx, weight: Some(&mut d_weight), bias: Some(&mut d_bias) };
                norm::backward(norm, black_box(&x), (&weight, &bias), grads);
            })
        });
    }
    group.finish();
}

fn elementwise(c: &mut Criterion) {
    let mut group = c.benchmark_group("activation");
    let mut out = values(1 << 14);
    group.throughput(Throughput::Elements(out.len() as u64));
    for kind in [Activation::Mish, Activation::Silu, Activation::GeluTanh, Activation::Relu] {
        group.bench_function(format!("{kind:?}"), |b| b.iter(|| activation::in_place(kind, black_box(&mut out))));
    }
    group.finish();
}

/// 42 tokens, 8 heads of 32: the DiT's.
fn attention(c: &mut Criterion) {
    let mut group = c.benchmark_group("attention");
    let plan = Attention { batch: 1, queries: 42, keys: 42, heads: 8, head_dim: 32, causal: false };
    let (qkv, grad) = (values(42 * 768), values(42 * 256));
    let (mut out, mut dqkv) = (grad.clone(), qkv.clone());
    group.bench_function("forward", |b| b.iter(|| plan.forward(&Looks::together(black_box(&qkv), 256), &mut out)));
    group.bench_function("backward", |b| {
        b.iter(|| plan.backward(&Looks::together(black_box(&qkv), 256), &grad, &mut Grads::Together(&mut dqkv)));
    });
    group.finish();
}

criterion_group!(kernels, convolution, linear, normalisation, elementwise, attention);
criterion_main!(kernels);
