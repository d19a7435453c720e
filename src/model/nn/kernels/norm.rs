//! Normalisation to mean 0 and variance 1, then scale and shift, then (optionally) Mish.
//!
//! One kernel for two layers: group norm with Mish takes its statistics over (channels in the group x time) of an item, layer norm
//! is the case of one step and one group.

use super::{math, per_isa, pool::Pooled};

/// Which values share a mean and a variance, and what follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Norm {
    /// Time steps of an item; statistics run over all of them.
    pub steps: usize,
    /// Channels of a step.
    pub channels: usize,
    /// Groups that the channels are split in.
    pub groups: usize,
    /// Added to the variance.
    pub eps: f32,
    /// Whether Mish follows.
    pub mish: bool,
}

/// Where backward writes.
pub struct NormGrads<'a> {
    /// Holds the gradient to the result; becomes that to `x`.
    pub x: &'a mut [f32],
    /// Gradient to the scale, by channel, if wanted; added up.
    pub weight: Option<&'a mut [f32]>,
    /// Gradient to the shift, by channel, if wanted; added up.
    pub bias: Option<&'a mut [f32]>,
}

/// Scratch by channel: the group's mean and inverse standard deviation spread over its channels, two sums, and their group means.
struct Scratch {
    mean: Pooled,
    rstd: Pooled,
    first: Pooled,
    second: Pooled,
    even: Pooled,
    odd: Pooled,
}

impl Scratch {
    fn new(channels: usize) -> Self {
        let take = || Pooled::take(channels);
        Self { mean: take(), rstd: take(), first: take(), second: take(), even: take(), odd: take() }
    }
}

/// `finish` of the mean of each group over channels and time, from sums over time by channel, spread over the group's channels.
#[inline(always)]
fn fold_groups(norm: Norm, sums: impl Fn(usize) -> f32, out: &mut [f32], finish: impl Fn(f32) -> f32) {
    let width = norm.channels / norm.groups;
    let inverse = 1.0 / (norm.steps * width) as f32;
    if width >= math::LANES {
        for (group, out) in out.chunks_exact_mut(width).enumerate() {
            let value = finish(math::sum(width, |i| sums(group * width + i)) * inverse);
            out.fill(value);
        }
        return;
    }
    // Narrow groups: all at once, each in ascending order, as one chain after the other would only wait. The total of a group
    // builds up in its first channel.
    for first in (0..norm.channels).step_by(width) {
        out[first] = sums(first);
    }
    for i in 1..width {
        for first in (0..norm.channels).step_by(width) {
            out[first] += sums(first + i);
        }
    }
    for out in out.chunks_exact_mut(width) {
        let value = finish(out[0] * inverse);
        out.fill(value);
    }
}

/// Two passes over an item `x` of `(steps, channels)`: means, then variances about them.
#[inline(always)]
fn statistics(norm: Norm, x: &[f32], scratch: &mut Scratch) {
    let Scratch { mean, rstd, first, .. } = scratch;
    first.fill(0.0);
    for row in x.chunks_exact(norm.channels) {
        first.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
    }
    fold_groups(norm, |c| first[c], mean, |mean| mean);
    first.fill(0.0);
    for row in x.chunks_exact(norm.channels) {
        for ((sum, x), mean) in first.iter_mut().zip(row).zip(mean.iter()) {
            let deviation = x - mean;
            *sum = deviation.mul_add(deviation, *sum);
        }
    }
    fold_groups(norm, |c| first[c], rstd, |variance| 1.0 / (variance + norm.eps).sqrt());
}

/// Applies `f(z)` to the normalised, scaled and shifted values of an item, in place.
#[inline(always)]
fn apply(item: &mut [f32], scratch: &Scratch, weight: &[f32], bias: &[f32], f: impl Fn(f32) -> f32) {
    for x in item.chunks_exact_mut(weight.len()) {
        let columns = scratch.mean.iter().zip(scratch.rstd.iter()).zip(weight.iter().zip(bias));
        for (x, ((mean, rstd), (weight, bias))) in x.iter_mut().zip(columns) {
            *x = f(((*x - mean) * rstd).mul_add(*weight, *bias));
        }
    }
}

per_isa! {
    /// Normalises items of `(steps, channels)`; `weight` and `bias` are by channel.
    pub fn in_place(norm: Norm, x: &mut [f32], weight: &[f32], bias: &[f32]) {
        let mut scratch = Scratch::new(norm.channels);
        for item in x.chunks_exact_mut(norm.steps * norm.channels) {
            statistics(norm, item, &mut scratch);
            if norm.mish {
                apply(item, &scratch, weight, bias, math::mish);
            } else {
                apply(item, &scratch, weight, bias, |z| z);
            }
        }
    }
}

/// Multiplies the gradient of an item by Mish's derivative at the values before it.
#[inline(always)]
fn through_mish(x: &[f32], dz: &mut [f32], scratch: &Scratch, weight: &[f32], bias: &[f32]) {
    let channels = weight.len();
    for (x, dz) in x.chunks_exact(channels).zip(dz.chunks_exact_mut(channels)) {
        let columns = scratch.mean.iter().zip(scratch.rstd.iter()).zip(weight.iter().zip(bias));
        for ((dz, x), ((mean, rstd), (weight, bias))) in dz.iter_mut().zip(x).zip(columns) {
            *dz *= math::mish_derivative(((x - mean) * rstd).mul_add(*weight, *bias));
        }
    }
}

/// From the gradient `dz` to the scaled values of an item to the gradient to `x`, in place. The item's sums of `dz` and
/// `dz * normalised` are left in `scratch.first` and `scratch.second`.
#[inline(always)]
fn through_statistics(norm: Norm, x: &[f32], dz: &mut [f32], weight: &[f32], scratch: &mut Scratch) {
    let Scratch { mean, rstd, first, second, even, odd } = scratch;
    let channels = norm.channels;
    first.fill(0.0);
    second.fill(0.0);
    for (x, dz) in x.chunks_exact(channels).zip(dz.chunks_exact(channels)) {
        let sums = first.iter_mut().zip(second.iter_mut());
        for (((first, second), (mean, rstd)), (x, dz)) in sums.zip(mean.iter().zip(rstd.iter())).zip(x.iter().zip(dz)) {
            *first += dz;
            *second = dz.mul_add((x - mean) * rstd, *second);
        }
    }
    fold_groups(norm, |c| first[c] * weight[c], even, |mean| mean);
    fold_groups(norm, |c| second[c] * weight[c], odd, |mean| mean);
    for (x, dz) in x.chunks_exact(channels).zip(dz.chunks_exact_mut(channels)) {
        let columns = mean.iter().zip(rstd.iter()).zip(weight.iter().zip(even.iter().zip(odd.iter())));
        for ((dz, x), ((mean, rstd), (weight, (even, odd)))) in dz.iter_mut().zip(x).zip(columns) {
            let normalised = (x - mean) * rstd;
            *dz = rstd * (-normalised).mul_add(*odd, dz.mul_add(*weight, -even));
        }
    }
}

per_isa! {
    /// Gradients of [`in_place`]; `affine` is (weight, bias).
    pub fn backward(norm: Norm, x: &[f32], affine: (&[f32], &[f32]), grads: NormGrads) {
        let NormGrads { x: dz, weight: mut d_weight, bias: mut d_bias } = grads;
        let mut scratch = Scratch::new(norm.channels);
        let size = norm.steps * norm.channels;
        for (x, dz) in x.chunks_exact(size).zip(dz.chunks_exact_mut(size)) {
            statistics(norm, x, &mut scratch);
            if norm.mish {
                through_mish(x, dz, &scratch, affine.0, affine.1);
            }
            through_statistics(norm, x, dz, affine.0, &mut scratch);
            for (total, sums) in [(&mut d_bias, &scratch.first), (&mut d_weight, &scratch.second)] {
                if let Some(total) = total {
                    total.iter_mut().zip(sums.iter()).for_each(|(total, sum)| *total += sum);
                }
            }
        }
    }
}
