//! Activations with a way back while serving: the gradient of a network to its inputs, on the memory that [`Buffer`]s use.
//!
//! [`gradient`] runs a network on handles, [`Traced`]. What it does is noted on a tape of this thread, which is then gone back, last
//! things first, through [`Op::backward`]: no gradient is computed to parameters, nor to what no input leads to. The tape and what stands
//! on it are used again, so that nothing is allocated once every size has been seen. A row's gradient, as its result, does not depend on
//! the batch around it.

use super::{
    activations::Activations,
    buffer::{Buffer, INPUTS_MAX},
    kernels::join,
    layer::Layer,
    op::{Form, Op, Past, Slot, View},
};
use candle_core::{Result, bail};
use std::{cell::RefCell, marker::PhantomData, ops::Range};

thread_local! { static TAPE: RefCell<Tape> = const { RefCell::new(Tape { nodes: Vec::new(), edges: Vec::new(), call: 0, open: false }) }; }

/// A value `(batch, steps, channels)` on the tape of this thread, within one call of [`gradient`].
#[derive(Clone, Copy, Debug)]
pub struct Traced {
    at: usize,
    call: u64,
    /// Whether it comes of an input, so that a gradient goes to it.
    led: bool,
    /// Its tape is that of one thread.
    thread: PhantomData<*const ()>,
}

/// A result, and the gradient of `sum(seed(result) * result)` to each of the inputs, of its shape; zeros to those that the result does not
/// depend on. `run` makes the result of the inputs; `seed` is given its numbers and writes the gradient to them, over zeros.
///
/// # Errors
/// Those of `run`; if it is within another call; if a gradient would go to a mask, or through a layer that has no way back
/// ([`super::Params::with_way_back`]). Whatever happens, the tape is then empty.
pub fn gradient<const N: usize>(
    inputs: [Buffer; N],
    run: impl FnOnce([Traced; N]) -> Result<Traced>,
    seed: impl FnOnce(&[f32], &mut [f32]),
) -> Result<(Buffer, [Buffer; N])> {
    let _open = Open::new()?;
    let inputs = TAPE.with_borrow_mut(|tape| inputs.map(|input| tape.note(input, None, true)));
    let end = run(inputs)?;
    let result = TAPE.with_borrow(|tape| tape.value(end).cloned())?;
    let mut grad = zeros_like(&result)?;
    seed(&result, &mut grad);
    TAPE.with_borrow_mut(|tape| tape.go_back(end, grad)).map(|grads| (result, grads))
}

impl Traced {
    /// A value that is what it is: no gradient is computed to it, nor to what comes of constants alone.
    ///
    /// # Errors
    /// Outside of a call of [`gradient`].
    pub fn constant(value: Buffer) -> Result<Self> {
        TAPE.with_borrow_mut(|tape| if tape.open { Ok(tape.note(value, None, false)) } else { bail!("there is no gradient to be traced") })
    }
}

impl Activations for Traced {
    /// A constant.
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        Self::constant(Buffer::generate(shape, write)?)
    }

    fn shape(&self) -> Result<[usize; 3]> {
        TAPE.with_borrow(|tape| tape.value(*self)?.shape())
    }

    fn detached(self) -> Self {
        Self { led: false, ..self }
    }

    fn run(&self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        TAPE.with_borrow_mut(|tape| tape.run(layer, *self, others))
    }
}

/// What was done in a call, in order; empty between calls.
struct Tape {
    nodes: Vec<Node>,
    /// What each was made of.
    edges: Vec<Traced>,
    call: u64,
    open: bool,
}

struct Node {
    value: Buffer,
    grad: Option<Buffer>,
    /// What made it of which of the edges, if a gradient goes there.
    made: Option<(Layer, Range<usize>)>,
}

/// A tape in use; gone, the tape is empty again.
struct Open;

impl Open {
    fn new() -> Result<Self> {
        TAPE.with_borrow_mut(|tape| {
            if tape.open {
                bail!("a gradient within a gradient");
            }
            (tape.open, tape.call) = (true, tape.call + 1);
            Ok(Self)
        })
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        TAPE.with_borrow_mut(|tape| {
            tape.nodes.clear();
            tape.edges.clear();
            tape.open = false;
        });
    }
}

impl Tape {
    fn note(&mut self, value: Buffer, made: Option<(Layer, Range<usize>)>, led: bool) -> Traced {
        self.nodes.push(Node { value, grad: None, made });
        Traced { at: self.nodes.len() - 1, call: self.call, led, thread: PhantomData }
    }

    fn value(&self, of: Traced) -> Result<&Buffer> {
        match self.nodes.get(of.at) {
            Some(node) if self.open && of.call == self.call => Ok(&node.value),
            _ => bail!("a traced value outlived its gradient"),
        }
    }

    fn run(&mut self, layer: &Layer, x: Traced, others: &[&Traced]) -> Result<Traced> {
        let first = self.value(x)?;
        let mut held = [first; INPUTS_MAX - 1];
        if others.len() > held.len() {
            bail!("{} inputs, at most {INPUTS_MAX}", 1 + others.len());
        }
        for (held, other) in held.iter_mut().zip(others) {
            *held = self.value(**other)?;
        }
        let value = first.run(layer, &held[..others.len()])?;
        if !x.led && others.iter().all(|other| !other.led) {
            return Ok(self.note(value, None, false));
        }
        let start = self.edges.len();
        self.edges.push(x);
        self.edges.extend(others.iter().map(|other| **other));
        let edges = start..self.edges.len();
        Ok(self.note(value, Some((layer.clone(), edges)), true))
    }

    /// The gradients to the inputs, which stand first, from that to the end.
    fn go_back<const N: usize>(&mut self, end: Traced, grad: Buffer) -> Result<[Buffer; N]> {
        self.nodes[end.at].grad = end.led.then_some(grad);
        while self.nodes.len() > N {
            let Some(Node { value, grad, made }) = self.nodes.pop() else { break };
            if let (Some(grad), Some((layer, edges))) = (grad, made) {
                step_back((&layer, &self.edges[edges]), (&value, &grad), &mut self.nodes)?;
            }
        }
        let mut grads = self.nodes.drain(..).map(|node| node.grad.map_or_else(|| zeros_like(&node.value), Ok));
        let mut inputs = [const { None }; N];
        for input in &mut inputs {
            *input = grads.next().transpose()?;
        }
        Ok(inputs.map(|input| input.expect("the tape begins with as many inputs: is a bug")))
    }
}

/// From the gradient to a result to those to what a layer made it of, each added to what is there.
fn step_back((layer, edges): (&Layer, &[Traced]), (result, grad): (&Buffer, &Buffer), nodes: &mut [Node]) -> Result<()> {
    let mut grads: [Option<Buffer>; INPUTS_MAX] = Default::default();
    for (i, (slot, edge)) in grads.iter_mut().zip(edges).enumerate().filter(|(_, (_, edge))| edge.led) {
        *slot = Some(if goes_on(layer.op, i) { grad.clone() } else { zeros_like(&nodes[edge.at].value)? });
    }
    let mut inputs = [result.view(); INPUTS_MAX];
    inputs.iter_mut().zip(edges).for_each(|(input, edge)| *input = nodes[edge.at].value.view());
    let mut to: [Slot; INPUTS_MAX + 2] = Default::default();
    to.iter_mut().zip(&mut grads).for_each(|(to, grad)| *to = grad.as_deref_mut());
    let inputs: &[View] = &inputs[..edges.len()];
    layer.weights.with(|weights| layer.op.backward(&Past { inputs, weights, result, grad }, &mut to[..edges.len() + 2]))?;
    for (grad, edge) in grads.into_iter().zip(edges) {
        match (grad, &mut nodes[edge.at].grad) {
            (Some(grad), Some(sum)) => join::add(sum, &grad),
            (Some(grad), none) => *none = Some(grad),
            (None, _) => {}
        }
    }
    Ok(())
}

/// Whether the slot of an input holds the gradient to the result at first; see [`Op::backward`].
fn goes_on(op: Op, input: usize) -> bool {
    match op.form() {
        Form::Anew => false,
        Form::InPlace => input == 0,
        Form::Sum(count) => input < count,
    }
}

fn zeros_like(buffer: &Buffer) -> Result<Buffer> {
    Buffer::generate(buffer.shape()?, |_| ())
}

#[cfg(test)]
mod tests;
