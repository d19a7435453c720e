//! What networks are made of: one closed list of operations, each with its shape, its way forth and its way back, on plain slices.
//!
//! Every kind of [`super::Activations`] runs this list. A new operation is an arm in each function here, over a kernel.

mod conv;
mod gru;
mod norm;

use super::{
    kernels::{
        activation::{self, Activation},
        attention::{Attention, Grads, Looks},
        join,
    },
    weights::{Weight, WeightsRef},
};
use candle_core::{Result, bail};

pub use conv::Conv;
pub use norm::NormKind;

/// An operation on `x` `(batch, steps, channels)` and perhaps others, of the same batch. What it needs to know is here, but for its
/// parameters, a weight and a bias, which a layer holds.
#[derive(Clone, Copy, Debug)]
pub enum Op {
    /// Convolution, transposed convolution or linear layer; weight and bias.
    Conv(Conv),
    /// All states `(batch, steps, hidden)` of a GRU from projected inputs `(batch, steps, 3 hidden)` and the states before
    /// `(batch, 1, hidden)`; recurrent weight and bias.
    Gru {
        /// Size of the state.
        hidden: usize,
    },
    /// Group norm with Mish, or layer norm; scale and shift.
    Norm(NormKind),
    /// Multi-head self-attention (Vaswani et al. 2017, equation 1): `softmax(q k^T / sqrt(head_dim)) v` by head, from q, k, v side by side,
    /// `(batch, steps, 3 width)`, to `(batch, steps, width)`.
    Attention {
        /// They share the width.
        heads: usize,
        /// Whether a step looks only at itself and those before it.
        causal: bool,
    },
    /// The same of q, `(batch, steps, width)`, on the k, v of others, side by side, `(batch, others, 2 width)`.
    Cross {
        /// They share the width.
        heads: usize,
    },
    /// Element by element.
    Activation(Activation),
    /// The sum with another of the same shape.
    Add,
    /// `x[b, t, c] + e[b, 0, c]`.
    AddAtEachStep,
    /// `x (1 + scale) + shift`; the other holds shift and scale side by side.
    Modulate,
    /// `x + gate h` on (x, h, gate).
    AddGated,
    /// Any number of them side by side along the channels.
    Beside,
    /// Some of the channels, one after the other.
    Channels {
        /// The first.
        start: usize,
        /// How many.
        len: usize,
    },
    /// One step alone, `(batch, 1, channels)`.
    Step(usize),
    /// All steps as the channels of one: `(batch, 1, steps channels)`.
    Flatten,
    /// The way back: `(batch, 1, steps channels)` as so many steps.
    Unflatten {
        /// Of the result.
        steps: usize,
    },
    /// `x - other`.
    Subtract,
    /// `x * other`, element by element.
    Times,
    /// Rows where the other, `(batch, steps, 1)`, is 1; the weight, a vector, where it is 0. The mask gets no gradient.
    OrAbsent {
        /// Channels.
        width: usize,
    },
}

/// What becomes of the first input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// It is read, and so it is on the way back.
    Anew,
    /// It becomes the result; on the way back the gradient to the result becomes the gradient to it.
    InPlace,
    /// It becomes the result; on the way back the gradient goes on as it is to so many of the inputs.
    Sum(usize),
}

/// Numbers of this shape.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// In order of (batch, steps, channels).
    pub values: &'a [f32],
    /// `[batch, steps, channels]`.
    pub shape: [usize; 3],
}

/// An operation that has been, and the gradient to its result.
#[derive(Clone, Copy, Debug)]
pub struct Past<'a> {
    /// What it was done on.
    pub inputs: &'a [View<'a>],
    /// With these parameters.
    pub weights: WeightsRef<'a>,
    /// What came out.
    pub result: &'a [f32],
    /// The gradient to it.
    pub grad: &'a [f32],
}

/// Where a gradient goes, if anybody wants it.
pub type Slot<'a> = Option<&'a mut [f32]>;

impl Op {
    /// What becomes of the first input.
    pub fn form(&self) -> Form {
        match self {
            Self::Conv(_) | Self::Gru { .. } | Self::Attention { .. } | Self::Cross { .. } | Self::Beside => Form::Anew,
            Self::Channels { .. } | Self::Step(_) | Self::Flatten | Self::Unflatten { .. } => Form::Anew,
            Self::Norm(_) | Self::Activation(_) | Self::Modulate | Self::Subtract | Self::Times | Self::OrAbsent { .. } => Form::InPlace,
            Self::AddAtEachStep | Self::AddGated => Form::Sum(1),
            Self::Add => Form::Sum(2),
        }
    }

    /// Shape of the result; of inputs, the shapes alone are looked at.
    ///
    /// # Errors
    /// If shapes do not fit the operation and each other.
    pub fn shape(&self, inputs: &[View]) -> Result<[usize; 3]> {
        let Some((first, others)) = inputs.split_first() else { bail!("{self:?} of nothing") };
        let (x, [batch, steps, channels]) = (first.shape, first.shape);
        let beside =
            |wanted: &[[usize; 3]], sound: bool, result| (sound && others.iter().map(|other| &other.shape).eq(wanted)).then_some(result);
        let result = match *self {
            Self::Conv(conv) => beside(&[], true, conv.shape(x)?),
            Self::Gru { hidden } => beside(&[[batch, 1, hidden]], channels == 3 * hidden, [batch, steps, hidden]),
            Self::Norm(norm) => beside(&[], channels == norm.channels, x),
            Self::Attention { heads, .. } => beside(&[], heads > 0 && channels.is_multiple_of(3 * heads), [batch, steps, channels / 3]),
            Self::Cross { heads } => {
                let keys = others.first().map_or(0, |other| other.shape[1]);
                beside(&[[batch, keys, 2 * channels]], keys > 0 && heads > 0 && channels.is_multiple_of(heads), x)
            }
            Self::Activation(_) => beside(&[], true, x),
            Self::Add => beside(&[x], true, x),
            Self::AddAtEachStep => beside(&[[batch, 1, channels]], true, x),
            Self::Modulate => beside(&[[batch, steps, 2 * channels]], true, x),
            Self::AddGated => beside(&[x, x], true, x),
            Self::Beside => {
                let width = inputs.iter().map(|input| input.shape[2]).sum();
                others.iter().all(|other| other.shape[..2] == x[..2]).then_some([batch, steps, width])
            }
            Self::Channels { start, len } => beside(&[], start + len <= channels, [batch, steps, len]),
            Self::Step(index) => beside(&[], index < steps, [batch, 1, channels]),
            Self::Flatten => beside(&[], true, [batch, 1, steps * channels]),
            Self::Unflatten { steps: into } => {
                let fits = steps == 1 && into > 0 && channels.is_multiple_of(into);
                beside(&[], fits, [batch, into, channels / into.max(1)])
            }
            Self::Subtract | Self::Times => beside(&[x], true, x),
            Self::OrAbsent { width } => beside(&[[batch, steps, 1]], channels == width, x),
        };
        let shapes = || inputs.iter().map(|input| input.shape).collect::<Vec<_>>();
        result.ok_or_else(|| candle_core::Error::Msg(format!("{self:?} does not take {:?}", shapes())))
    }

    /// The weight in the form that the way forth takes where it is constant.
    pub(super) fn pack(&self, weight: &[f32]) -> Weight {
        match self {
            Self::Conv(conv) => conv.pack(weight),
            Self::Gru { hidden } => Weight::Packed(gru::pack(weight, *hidden)),
            // Vectors; most have none at all.
            _ => Weight::Plain(weight.to_vec()),
        }
    }

    /// The weight in the form that the way back to the inputs takes, if that is another one.
    pub(super) fn pack_back(&self, weight: &[f32]) -> Option<Weight> {
        match self {
            Self::Conv(conv) => Some(conv.pack_back(weight)),
            Self::Gru { hidden } => Some(Weight::Packed(gru::pack_back(weight, *hidden))),
            _ => None,
        }
    }

    /// The result into `out`. It holds the first input where that becomes the result (see [`Form`]), whose values are then not read from
    /// `inputs`; else anything. Shapes are those that [`Self::shape`] takes and gives.
    ///
    /// # Errors
    /// If shapes or parameters are others.
    pub fn forward(&self, inputs: &[View], weights: WeightsRef, out: &mut [f32]) -> Result<()> {
        let (View { values: x, shape }, other) = (inputs[0], |i: usize| inputs[i].values);
        let [_, steps, channels] = shape;
        match *self {
            Self::Conv(conv) => conv.forward(inputs[0], weights, out)?,
            Self::Gru { hidden } => gru::forward(hidden, inputs, weights, out)?,
            Self::Norm(norm) => norm.forward(steps, weights, out)?,
            Self::Attention { heads, causal } => {
                attention(shape, heads, causal).forward(&Looks::together(x, channels / 3), out);
            }
            Self::Cross { heads } => cross(shape, inputs[1].shape, heads).forward(&Looks::apart(x, other(1), channels), out),
            Self::Activation(kind) => activation::in_place(kind, out),
            Self::Add => join::add(out, other(1)),
            Self::AddAtEachStep => {
                let items = out.chunks_exact_mut((steps * channels).max(1)).zip(other(1).chunks_exact(channels.max(1)));
                items.for_each(|(item, e)| join::add_to_rows(e, item));
            }
            Self::Modulate => join::modulate(out, other(1), channels),
            Self::AddGated => join::add_gated(out, other(1), other(2)),
            Self::Beside => {
                for (View { values, shape: [.., part] }, start, width) in parts(inputs) {
                    join::copy_columns((values, *part, 0), (out, width, start), *part);
                }
            }
            Self::Channels { start, len } => join::copy_columns((x, channels, start), (out, len, 0), len),
            Self::Step(index) => join::copy_columns((x, steps * channels, index * channels), (out, channels, 0), channels),
            Self::Flatten | Self::Unflatten { .. } => out.copy_from_slice(x),
            Self::Subtract => join::subtract(out, other(1)),
            Self::Times => join::multiply(out, other(1)),
            Self::OrAbsent { .. } => join::or_absent(out, other(1), weights.plain()?),
        }
        Ok(())
    }

    /// The gradients to the inputs, the weight and the bias, in this order, each into its slot, which holds zeros. But the slot of a
    /// first input that became the result ([`Form::InPlace`]) holds the gradient to that, and inputs to which the gradient goes on as it
    /// is ([`Form::Sum`]) have their slot left alone.
    ///
    /// # Errors
    /// If a gradient is wanted for a mask, or one that needs the weight where it is packed for the way forth alone.
    ///
    /// # Panics
    /// If there are not as many slots as inputs, and two.
    pub fn backward(&self, past: &Past, to: &mut [Slot]) -> Result<()> {
        let (Past { inputs, grad, .. }, [_, steps, channels]) = (*past, past.inputs[0].shape);
        let (x, other) = (inputs[0].values, |i: usize| inputs[i].values);
        match *self {
            Self::Conv(conv) => conv.backward(past, to)?,
            Self::Gru { hidden } => gru::backward(hidden, past, to)?,
            Self::Norm(norm) => norm.backward(past, to)?,
            Self::Attention { heads, causal } => fill(&mut to[0], |dx| {
                let of = Looks::together(x, channels / 3);
                attention(inputs[0].shape, heads, causal).backward(&of, grad, &mut Grads::Together(dx));
            }),
            Self::Cross { heads } => {
                let [queries, pairs, ..] = to else { bail!("slots for q, and k with v: is a bug") };
                let mut to = Grads::Apart(queries.as_deref_mut(), pairs.as_deref_mut());
                cross(inputs[0].shape, inputs[1].shape, heads).backward(&Looks::apart(x, other(1), channels), grad, &mut to);
            }
            Self::Activation(kind) => fill(&mut to[0], |dx| activation::backward(kind, x, dx)),
            Self::Add => {}
            Self::AddAtEachStep => fill(&mut to[1], |de| {
                let items = grad.chunks_exact((steps * channels).max(1)).zip(de.chunks_exact_mut(channels.max(1)));
                items.for_each(|(item, de)| join::add_rows(item, channels, de));
            }),
            Self::Modulate => {
                fill(&mut to[0], |dx| join::modulate_back(dx, other(1), channels));
                fill(&mut to[1], |d_ada| join::modulate_grad(x, grad, d_ada, channels));
            }
            Self::AddGated => {
                fill(&mut to[1], |dh| join::products(grad, other(2), dh));
                fill(&mut to[2], |d_gate| join::products(grad, other(1), d_gate));
            }
            Self::Beside => {
                for ((View { shape: [.., part], .. }, start, width), slot) in parts(inputs).zip(to) {
                    fill(slot, |part_grad| join::copy_columns((grad, width, start), (part_grad, *part, 0), *part));
                }
            }
            Self::Channels { start, len } => fill(&mut to[0], |dx| join::copy_columns((grad, len, 0), (dx, channels, start), len)),
            Self::Step(index) => {
                fill(&mut to[0], |dx| join::copy_columns((grad, channels, 0), (dx, steps * channels, index * channels), channels));
            }
            Self::Flatten | Self::Unflatten { .. } => fill(&mut to[0], |dx| dx.copy_from_slice(grad)),
            // The slot of `x` holds its gradient already.
            Self::Subtract => fill(&mut to[1], |dy| dy.iter_mut().zip(grad).for_each(|(dy, grad)| *dy = -grad)),
            Self::Times => {
                fill(&mut to[0], |dx| join::multiply(dx, other(1)));
                fill(&mut to[1], |dy| join::products(grad, x, dy));
            }
            Self::OrAbsent { .. } => {
                if to[1].is_some() {
                    bail!("a mask gets no gradient");
                }
                fill(&mut to[0], |dx| join::where_present(dx, other(1)));
                fill(&mut to[2], |absent| join::add_rows_where_absent(grad, other(1), absent));
            }
        }
        Ok(())
    }
}

/// Writes a gradient, if anybody wants it.
pub(super) fn fill(slot: &mut Slot, write: impl FnOnce(&mut [f32])) {
    if let Some(slot) = slot {
        write(slot);
    }
}

fn attention([batch, steps, width]: [usize; 3], heads: usize, causal: bool) -> Attention {
    Attention { batch, queries: steps, keys: steps, heads, head_dim: width / (3 * heads), causal }
}

fn cross([batch, queries, width]: [usize; 3], [_, keys, _]: [usize; 3], heads: usize) -> Attention {
    Attention { batch, queries, keys, heads, head_dim: width / heads, causal: false }
}

/// Inputs that lie side by side, each with its first column, and the width of all.
fn parts<'a>(inputs: &'a [View<'a>]) -> impl Iterator<Item = (&'a View<'a>, usize, usize)> {
    let width = inputs.iter().map(|input| input.shape[2]).sum();
    let mut end = 0;
    inputs.iter().map(move |input| {
        end += input.shape[2];
        (input, end - input.shape[2], width)
    })
}
