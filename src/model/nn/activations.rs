//! What networks compute on: a network is written once, over any [`Activations`].
//!
//! Training runs it on candle's tensors, which record the way back; inference on [`super::Buffer`]s, plain numbers in pooled memory;
//! guidance on [`super::Traced`], which are such numbers and record the way back to the inputs. All go through the same operations ([`Op`])
//! and give the same bits.

use super::{Absent, kernels::activation::Activation, layer::Layer, op::Op};
use candle_core::{Result, bail};

/// Activations `(batch, steps, channels)`. Every operation is an error where shapes do not fit each other.
pub trait Activations: Clone {
    /// A value of this shape, filled by `write`, which finds zeros.
    ///
    /// # Errors
    /// If candle says so; so for all operations.
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self>;

    /// `[batch, steps, channels]`.
    ///
    /// # Errors
    /// For a tensor of another rank.
    fn shape(&self) -> Result<[usize; 3]>;

    /// The same numbers as a fact: no gradient goes through them.
    fn detached(self) -> Self {
        self
    }

    /// The layer's operation on this value and others.
    ///
    /// # Errors
    /// If their number or shapes do not fit it.
    fn run(&self, layer: &Layer, others: &[&Self]) -> Result<Self>;

    /// The same for a value that nobody needs any more: its memory may become the result's.
    ///
    /// # Errors
    /// As [`Self::run`].
    fn run_in_place(self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        self.run(layer, others)
    }

    /// Multi-head self-attention of q, k, v side by side: `(batch, steps, 3 width)` to `(batch, steps, width)`.
    ///
    /// # Errors
    /// If the channels are not q, k, v of `heads` heads.
    fn attention(&self, heads: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Attention { heads, causal: false }), &[])
    }

    /// The same, where a step looks only at itself and those before it.
    ///
    /// # Errors
    /// As of [`Self::attention`].
    fn causal_attention(&self, heads: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Attention { heads, causal: true }), &[])
    }

    /// Multi-head attention of these queries, `(batch, steps, width)`, on others' k, v side by side, `(batch, others, 2 width)`.
    ///
    /// # Errors
    /// If the heads do not divide the width, or the widths do not fit each other.
    fn attending(&self, others: &Self, heads: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Cross { heads }), &[others])
    }

    /// An activation, element by element.
    ///
    /// # Errors
    /// If candle says so.
    fn activated(self, activation: Activation) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::Activation(activation)), &[])
    }

    /// The sum of two values of one shape.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus(self, other: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::Add), &[other])
    }

    /// Adds `(batch, 1, channels)` to every step.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus_at_each_step(self, e: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::AddAtEachStep), &[e])
    }

    /// `self (1 + scale) + shift`, where `ada`, twice as wide as `self`, holds shift and scale side by side.
    ///
    /// # Errors
    /// If shapes differ.
    fn modulated(self, ada: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::Modulate), &[ada])
    }

    /// `self + gate h`.
    ///
    /// # Errors
    /// If shapes differ.
    fn plus_gated(self, h: &Self, gate: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::AddGated), &[h, gate])
    }

    /// Side by side along the channels.
    ///
    /// # Errors
    /// If the other dimensions differ.
    fn beside(parts: &[&Self]) -> Result<Self> {
        let [first, others @ ..] = parts else { bail!("nothing to put side by side") };
        first.run(&Layer::plain(Op::Beside), others)
    }

    /// Channels `start..start + len`.
    ///
    /// # Errors
    /// If there are not so many.
    fn channels(&self, start: usize, len: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Channels { start, len }), &[])
    }

    /// Step `index` alone: `(batch, 1, channels)`.
    ///
    /// # Errors
    /// If there are not so many.
    fn step(&self, index: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Step(index)), &[])
    }

    /// All steps as the channels of one: `(batch, 1, steps channels)`.
    ///
    /// # Errors
    /// If candle says so.
    fn flattened(&self) -> Result<Self> {
        self.run(&Layer::plain(Op::Flatten), &[])
    }

    /// One step of many channels as so many steps: `(batch, 1, steps channels)` to `(batch, steps, channels)`.
    ///
    /// # Errors
    /// If there are several steps, or the channels cannot be parted so.
    fn unflattened(&self, steps: usize) -> Result<Self> {
        self.run(&Layer::plain(Op::Unflatten { steps }), &[])
    }

    /// The steps of `self`, and those of `later` behind them.
    ///
    /// # Errors
    /// If the other dimensions differ.
    fn followed_by(&self, later: &Self) -> Result<Self> {
        let ([_, first, _], [_, second, _]) = (self.shape()?, later.shape()?);
        Self::beside(&[&self.flattened()?, &later.flattened()?])?.unflattened(first + second)
    }

    /// The last `len` steps.
    ///
    /// # Errors
    /// If there are not so many.
    fn last_steps(&self, len: usize) -> Result<Self> {
        let [_, steps, channels] = self.shape()?;
        let Some(before) = steps.checked_sub(len) else { bail!("{len} steps of {steps}") };
        self.flattened()?.channels(before * channels, len * channels)?.unflattened(len)
    }

    /// `self - other`.
    ///
    /// # Errors
    /// If shapes differ.
    fn minus(self, other: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::Subtract), &[other])
    }

    /// `self * other`, element by element.
    ///
    /// # Errors
    /// If shapes differ.
    fn times(self, other: &Self) -> Result<Self> {
        self.run_in_place(&Layer::plain(Op::Times), &[other])
    }

    /// Rows where `present` (`(batch, steps, 1)`) is 1, the learned vector where it is 0.
    ///
    /// # Errors
    /// If shapes differ.
    fn or_absent(self, present: &Self, absent: &Absent) -> Result<Self> {
        self.run_in_place(&absent.0, &[present])
    }

    /// Every element held between bounds.
    ///
    /// # Errors
    /// If candle says so.
    fn clamped(self, low: f32, high: f32) -> Result<Self> {
        self.activated(Activation::Clamp(low, high))
    }
}
