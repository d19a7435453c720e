//! The way back on the tape is that of candle's tensors, bit for bit, by row, and leaves nothing behind.
#![allow(clippy::clone_on_copy, reason = "tensors are not Copy, and both kinds of values go through the same lines")]

use super::*;
use crate::model::nn::{
    Absent,
    Activation::{Clamp, GeluTanh, Mish, Relu, Silu},
    Conv1d, ConvShape, ConvTranspose1d, GroupNormMish, Gru, Init, LayerNorm, Linear, Params,
    kernels::testing::with_each_isa,
    plain,
    testing::{bits, flat, gaussian, gradients},
};
use candle_core::Tensor;
use std::{cell::Cell, panic};

type Function<'a, V> = &'a dyn Fn(&[V], &Params) -> Result<V>;

fn buffer(tensor: &Tensor) -> Buffer {
    let (batch, steps, channels) = tensor.dims3().unwrap();
    Buffer::generate([batch, steps, channels], |out| out.copy_from_slice(&flat(tensor))).unwrap()
}

/// The same weights as [`gradients`] has.
fn seed(shape: [usize; 3]) -> Vec<f32> {
    flat(&gaussian(99, (shape[0], shape[1], shape[2])))
}

/// Bits but for the sign of a zero: candle adds every gradient to zeros.
fn unsigned(bits: &[u32]) -> Vec<u32> {
    bits.iter().map(|bits| (f32::from_bits(*bits) + 0.0).to_bits()).collect()
}

/// Bits of the result and of each gradient.
fn traced<const N: usize>(inputs: [Buffer; N], weights: &[f32], run: impl FnOnce([Traced; N]) -> Result<Traced>) -> Vec<Vec<u32>> {
    let (result, grads) = gradient(inputs, run, |_, grad| grad.copy_from_slice(weights)).unwrap();
    std::iter::once(&result).chain(&grads).map(|buffer| buffer.iter().map(|value| value.to_bits()).collect()).collect()
}

/// Results and gradients of a batch are those on tensors with variables, and each row's are its own, with all instruction sets.
fn check<const N: usize>(name: &str, inputs: [Tensor; N], on_tensors: Function<Tensor>, on_the_tape: Function<Traced>) {
    let fresh = Params::fresh(5);
    let y = on_tensors(&inputs, &fresh).unwrap();
    let straight = gradients(&inputs, &|inputs| on_tensors(inputs, &fresh));
    let expected: Vec<Vec<u32>> = std::iter::once(&y).chain(&straight).map(|tensor| unsigned(&bits(tensor))).collect();
    let constants = fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().copy().unwrap())).collect();
    let frozen = Params::loaded(constants).with_way_back();
    let (batch, steps, channels) = y.dims3().unwrap();
    let weights = seed([batch, steps, channels]);
    let together = traced(inputs.each_ref().map(buffer), &weights, |inputs| on_the_tape(&inputs, &frozen));
    for params in [&fresh, &frozen] {
        for found in with_each_isa(|_| traced(inputs.each_ref().map(buffer), &weights, |inputs| on_the_tape(&inputs, params))) {
            assert_eq!(found.iter().map(|bits| unsigned(bits)).collect::<Vec<_>>(), expected, "{name}");
            assert_eq!(found, together, "{name}");
        }
    }
    for row in 0..batch {
        let cut = inputs.each_ref().map(|input| buffer(&input.narrow(0, row, 1).unwrap()));
        let size = weights.len() / batch;
        let alone = traced(cut, &weights[row * size..][..size], |inputs| on_the_tape(&inputs, &frozen));
        let own = together.iter().map(|whole| whole[row * (whole.len() / batch)..][..whole.len() / batch].to_vec());
        assert_eq!(alone, own.collect::<Vec<_>>(), "{name}, row {row}");
    }
}

/// The same network over both kinds of values.
macro_rules! both {
    ($name:expr, $inputs:expr, |$x:pat_param, $p:pat_param| $body:expr) => {
        check($name, $inputs, &|$x: &[Tensor], $p: &Params| $body, &|$x: &[Traced], $p: &Params| $body)
    };
}

#[test]
fn layers_as_on_tensors() {
    let conv = |c_in, c_out, kernel, stride, padding| ConvShape { c_in, c_out, kernel, stride, padding };
    let x = |steps: usize, channels: usize| [gaussian(3, (7, steps, channels))];
    both!("linear", x(3, 5), |x, p| Linear::new(5, 67, p)?.forward(&x[0]));
    both!("linear in parts", x(2, 5), |x, p| {
        let [a, b] = Linear::parts(5, [3, 18], Init::FanIn(5), p)?;
        Activations::beside(&[&b.forward(&x[0])?, &a.forward(&x[0])?])
    });
    for (shape, steps) in [
        (conv(4, 18, 5, 1, 2), 7),
        (conv(3, 5, 3, 1, 0), 6),
        (conv(3, 2, 2, 1, 2), 4),
        (conv(3, 4, 3, 2, 1), 8),
        (conv(3, 4, 4, 2, 1), 7),
        (conv(3, 33, 1, 1, 0), 5),
        (conv(2, 70, 5, 1, 2), 2),
    ] {
        both!(&format!("{shape:?}"), x(steps, shape.c_in), |x, p| Conv1d::new(shape, p)?.forward(&x[0]));
    }
    for (shape, steps) in [(conv(3, 5, 4, 2, 1), 4), (conv(4, 2, 3, 3, 0), 3)] {
        both!(&format!("transposed {shape:?}"), x(steps, shape.c_in), |x, p| ConvTranspose1d::new(shape, p)?.forward(&x[0]));
    }
    both!("group norm and mish", x(5, 12), |x, p| GroupNormMish::new(4, 12, p)?.forward(x[0].clone()));
    both!("layer norm", x(4, 19), |x, p| LayerNorm::new(19, true, 1e-6, p)?.forward(&x[0]));
    let before = gaussian(4, (7, 1, 9));
    both!("gru", [gaussian(3, (7, 4, 3)), before], |x, p| Gru::new(3, 9, p)?.forward(&x[0], Some(&x[1])));
    both!("gru from nothing", x(4, 3), |x, p| Gru::new(3, 9, p)?.forward(&x[0], None));
}

#[test]
fn joins_as_on_tensors() {
    let value = |seed: u64, steps: usize, channels: usize| gaussian(seed, (7, steps, channels));
    let x = || value(1, 3, 5);
    for kind in [Mish, Silu, GeluTanh, Relu, Clamp(-0.5, 0.7)] {
        both!(&format!("{kind:?}"), [x()], |x, _| x[0].clone().activated(kind));
    }
    both!("attention", [value(1, 5, 18)], |x, _| x[0].attention(2));
    both!("plus", [x(), value(2, 3, 5)], |x, _| x[0].clone().plus(&x[1])?.plus(&x[0]));
    both!("at each step", [x(), value(2, 1, 5)], |x, _| x[0].clone().plus_at_each_step(&x[1]));
    both!("modulated", [x(), value(2, 3, 10)], |x, _| x[0].clone().modulated(&x[1]));
    both!("gated", [x(), value(2, 3, 5), value(3, 3, 5)], |x, _| x[0].clone().plus_gated(&x[1], &x[2]));
    both!("beside", [x(), value(2, 3, 4), value(3, 3, 1)], |x, _| Activations::beside(&[&x[0], &x[1], &x[2]]));
    both!("channels", [x()], |x, _| x[0].channels(1, 3));
    both!("flattened", [x()], |x, _| x[0].flattened());
    both!("step", [x()], |x, _| x[0].step(1));
    both!("minus", [x(), value(2, 3, 5)], |x, _| x[0].clone().minus(&x[1]));
    both!("itself", [x()], |x, _| x[0].clone().minus(&x[0].clone().activated(Mish)?));
    both!("nothing at all", [x()], |x, _| Ok(x[0].clone()));
    both!("absent", [x()], |x, p| {
        let [batch, steps, _] = Activations::shape(&x[0])?;
        // Of each row the first step.
        let present = Activations::generate([batch, steps, 1], |out| out.iter_mut().step_by(steps).for_each(|out| *out = 1.0))?;
        x[0].clone().or_absent(&present, &Absent::new(5, Init::Normal(1.0), p)?)
    });
}

/// What is detached, constant, or not used at all gets no gradient.
#[test]
fn facts_get_no_gradient() {
    let [x, y, z] = [1, 2, 3].map(|seed| buffer(&gaussian(seed, (2, 3, 5))));
    let run = |[a, b, _]: [Traced; 3]| {
        let fact = Traced::constant(z.clone())?.plus(&Traced::generate([2, 3, 5], |out| out.fill(1.0))?)?;
        TAPE.with_borrow(|tape| assert!(tape.edges.is_empty(), "nothing goes back to constants"));
        a.activated(Silu)?.plus(&b.detached())?.plus(&fact)
    };
    let (result, grads) = gradient([x.clone(), y.clone(), z.clone()], run, |_, grad| grad.fill(1.0)).unwrap();
    for i in 0..x.len() {
        let s = 1.0 / (1.0 + (-x[i]).exp());
        assert!((result[i] - (x[i] * s + y[i] + z[i] + 1.0)).abs() < 1e-5);
        assert!((grads[0][i] - (s + x[i] * s * (1.0 - s))).abs() < 1e-5);
    }
    assert!(grads[1].iter().chain(grads[2].iter()).all(|grad| *grad == 0.0));
    let (_, grads) = gradient([x], |[x]| Ok(x.detached()), |_, grad| grad.fill(1.0)).unwrap();
    assert!(grads[0].iter().all(|grad| *grad == 0.0), "all of it is a fact");
}

fn input() -> Buffer {
    buffer(&gaussian(1, (2, 3, 5)))
}

fn slope() -> Result<Vec<u32>> {
    let (_, [grad]) = gradient([input()], |[x]| x.activated(Silu), |_, grad| grad.fill(1.0))?;
    Ok(grad.iter().map(|value| value.to_bits()).collect())
}

fn message<T>(result: Result<T>) -> String {
    result.err().map(|error| plain(&error)).unwrap_or_default()
}

/// Errors, panics, calls within calls and handles that were kept: the next call has a tape of its own.
#[test]
fn a_tape_is_of_one_call() {
    let expected = slope().unwrap();
    let kept = Cell::new(None);
    let keep = |[x]: [Traced; 1]| {
        kept.set(Some(x));
        Ok(x)
    };
    let within = Cell::new(None);
    assert!(message(gradient([input()], |[x]| slope().map(|_| x), |_, _| ())).contains("within a gradient"));
    assert!(gradient([input()], keep, |_, _| within.set(Some(message(slope())))).is_ok());
    assert!(within.take().unwrap().contains("within a gradient"), "nor while the seed is made");
    let kept = kept.get().unwrap();
    assert!(message(kept.shape()).contains("outlived"));
    assert!(message(gradient([input()], |_| kept.activated(Silu), |_, _| ())).contains("outlived"));
    assert!(message(gradient([input()], |_| Ok(kept), |_, _| ())).contains("outlived"));
    assert!(message(Traced::constant(input())).contains("no gradient"));
    assert!(panic::catch_unwind(|| gradient([input()], |_| panic!("on the way forth"), |_, _| ())).is_err());
    assert!(panic::catch_unwind(|| gradient([input()], |[x]| Ok(x), |_, _| panic!("in the seed"))).is_err());
    TAPE.with_borrow(|tape| assert!(tape.nodes.is_empty() && tape.edges.is_empty() && !tape.open));
    assert_eq!(slope().unwrap(), expected);
    assert_eq!(std::thread::spawn(|| slope().unwrap()).join().unwrap(), expected, "another thread has another tape");
}

#[test]
fn what_has_no_way_back_says_so() {
    let fresh = Params::fresh(5);
    let build = |p: &Params| -> Result<(Linear, Gru)> { Ok((Linear::new(5, 4, &p.scope("linear"))?, Gru::new(5, 4, &p.scope("gru"))?)) };
    build(&fresh).unwrap();
    let frozen = Params::loaded(fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().copy().unwrap())).collect());
    let (linear, gru) = build(&frozen).unwrap();
    assert!(message(gradient([input()], |[x]| linear.forward(&x), |_, _| ())).contains("has no way back"));
    assert!(message(gradient([input()], |[x]| gru.forward(&x, None), |_, _| ())).contains("has no way back"));
    assert!(gradient([input()], |[x]| linear.forward(&x.detached())?.plus(&x.channels(0, 4)?), |_, _| ()).is_ok(), "none is asked for");
    let absent = Absent::new(5, Init::Const(0.0), &Params::fresh(1)).unwrap();
    let masked = |[x]: [Traced; 1]| x.or_absent(&x.channels(0, 1)?, &absent);
    assert!(message(gradient([input()], masked, |_, _| ())).contains("a mask gets no gradient"));
    assert!(message(gradient([input()], |[x]| x.step(3), |_, _| ())).contains("does not take"));
    TAPE.with_borrow(|tape| assert!(tape.nodes.is_empty()));
}
