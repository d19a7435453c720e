//! Activations of inference: plain numbers in memory that is used again and again. No way back, and no allocation once every size has
//! been seen.

use super::{
    conv1d::ConvLayer,
    gru::Gru,
    host::values,
    kernels::{
        activation::{self, Activation},
        attention::Attention,
        join,
        pool::Pooled,
    },
    norm::{GroupNormMish, LayerNorm},
    value::Value,
};
use candle_core::{Result, Tensor, bail};
use std::ops::{Deref, DerefMut};

/// `(batch, steps, channels)` numbers.
#[derive(Clone, Debug)]
pub struct Buffer {
    values: Pooled,
    shape: [usize; 3],
}

impl Buffer {
    /// With any content.
    fn take(shape: [usize; 3]) -> Self {
        Self { values: Pooled::take(shape.iter().product()), shape }
    }

    fn width(&self) -> usize {
        self.shape[2]
    }

    fn expect(&self, shape: [usize; 3]) -> Result<()> {
        if self.shape != shape {
            bail!("expected {shape:?}, got {:?}", self.shape);
        }
        Ok(())
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }
}

impl Value for Buffer {
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        let mut values = Pooled::zeros(shape.iter().product());
        write(&mut values);
        Ok(Self { values, shape })
    }

    fn shape(&self) -> Result<[usize; 3]> {
        Ok(self.shape)
    }

    fn conv(&self, layer: &ConvLayer) -> Result<Self> {
        let mut out = Self::take(layer.result_shape(self.shape)?);
        layer.run(self, self.shape, &mut out.values)?;
        Ok(out)
    }

    fn gru(&self, layer: &Gru, before: Option<&Self>) -> Result<Self> {
        let ([batch, steps, _], hidden) = (self.shape, layer.hidden());
        let zeros;
        let before = if let Some(before) = before {
            before.expect([batch, 1, hidden])?;
            &before.values
        } else {
            zeros = Pooled::zeros(batch * hidden);
            &zeros
        };
        let (projected, mut out) = (self.conv(&layer.inputs)?, Self::take([batch, steps, hidden]));
        layer.run(&projected, before, batch, &mut out.values)?;
        Ok(out)
    }

    fn attention(&self, heads: usize) -> Result<Self> {
        let [batch, steps, width] = self.shape;
        if heads == 0 || !width.is_multiple_of(3 * heads) {
            bail!("{width} channels are not q, k, v of {heads} heads");
        }
        let mut out = Self::take([batch, steps, width / 3]);
        Attention { batch, steps, heads, head_dim: width / (3 * heads) }.forward(self, &mut out.values);
        Ok(out)
    }

    fn layer_norm(&self, layer: &LayerNorm) -> Result<Self> {
        let mut out = self.clone();
        layer.run(&mut out.values, self.width())?;
        Ok(out)
    }

    fn group_norm_mish(mut self, layer: &GroupNormMish) -> Result<Self> {
        let [_, steps, channels] = self.shape;
        layer.run(&mut self.values, steps, channels)?;
        Ok(self)
    }

    fn activated(mut self, activation: Activation) -> Result<Self> {
        activation::in_place(activation, &mut self.values);
        Ok(self)
    }

    fn plus(mut self, other: &Self) -> Result<Self> {
        other.expect(self.shape)?;
        join::add(&mut self.values, other);
        Ok(self)
    }

    fn plus_at_each_step(mut self, e: &Self) -> Result<Self> {
        let [batch, steps, channels] = self.shape;
        e.expect([batch, 1, channels])?;
        let items = self.values.chunks_exact_mut((steps * channels).max(1)).zip(e.chunks_exact(channels.max(1)));
        items.for_each(|(item, e)| join::add_to_rows(e, item));
        Ok(self)
    }

    fn modulated(mut self, ada: &Self) -> Result<Self> {
        let [batch, steps, channels] = self.shape;
        ada.expect([batch, steps, 2 * channels])?;
        join::modulate(&mut self.values, ada, channels);
        Ok(self)
    }

    fn plus_gated(mut self, h: &Self, gate: &Self) -> Result<Self> {
        h.expect(self.shape)?;
        gate.expect(self.shape)?;
        join::add_gated(&mut self.values, h, gate);
        Ok(self)
    }

    fn beside(parts: &[&Self]) -> Result<Self> {
        let Some(first) = parts.first() else { bail!("nothing to put side by side") };
        let [batch, steps, _] = first.shape;
        if let Some(other) = parts.iter().find(|part| part.shape[..2] != [batch, steps]) {
            bail!("cannot put {:?} and {:?} side by side", first.shape, other.shape);
        }
        let width = parts.iter().map(|part| part.width()).sum();
        let (mut out, mut start) = (Self::take([batch, steps, width]), 0);
        for part in parts {
            join::copy_columns(part, part.width(), (&mut out.values[start..], width), part.width());
            start += part.width();
        }
        Ok(out)
    }

    fn channels(&self, start: usize, len: usize) -> Result<Self> {
        if start + len > self.width() {
            bail!("{:?} has no channels {start}..{}", self.shape, start + len);
        }
        let mut out = Self::take([self.shape[0], self.shape[1], len]);
        join::copy_columns(&self.values[start.min(self.values.len())..], self.width(), (&mut out.values, len), len);
        Ok(out)
    }

    fn step(&self, index: usize) -> Result<Self> {
        let [batch, steps, channels] = self.shape;
        if index >= steps {
            bail!("{:?} has no step {index}", self.shape);
        }
        let mut out = Self::take([batch, 1, channels]);
        join::copy_columns(&self.values[index * channels..], steps * channels, (&mut out.values, channels), channels);
        Ok(out)
    }

    fn or_absent(mut self, present: &Self, absent: &Tensor) -> Result<Self> {
        present.expect([self.shape[0], self.shape[1], 1])?;
        let (absent, width) = (values(absent)?, self.width());
        if absent.len() != width {
            bail!("an absent part of {} channels for {:?}", absent.len(), self.shape);
        }
        let rows = self.values.chunks_exact_mut(width.max(1)).zip(present.values.iter());
        for (row, &present) in rows {
            row.iter_mut().zip(absent.iter()).for_each(|(x, absent)| *x = *x * present + (1.0 - present) * absent);
        }
        Ok(self)
    }

    fn clamped(mut self, low: f32, high: f32) -> Result<Self> {
        self.values.iter_mut().for_each(|x| *x = x.clamp(low, high));
        Ok(self)
    }
}
