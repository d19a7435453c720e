//! Element by element: activations and their derivatives.

use super::{math, per_isa};

/// A non-linearity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    /// `x tanh(softplus(x))`.
    Mish,
    /// `x sigmoid(x)`.
    Silu,
    /// GELU by its hyperbolic tangent.
    GeluTanh,
    /// `max(x, 0)`.
    Relu,
    /// Held between bounds, the lower first.
    Clamp(f32, f32),
}

per_isa! {
    /// `x[i] = f(x[i])`.
    pub fn in_place(kind: Activation, x: &mut [f32]) {
        match kind {
            Activation::Mish => x.iter_mut().for_each(|x| *x = math::mish(*x)),
            Activation::Silu => x.iter_mut().for_each(|x| *x = math::silu(*x)),
            Activation::GeluTanh => x.iter_mut().for_each(|x| *x = math::gelu(*x)),
            Activation::Relu => x.iter_mut().for_each(|x| *x = if *x < 0.0 { 0.0 } else { *x }),
            Activation::Clamp(low, high) => x.iter_mut().for_each(|x| *x = x.clamp(low, high)),
        }
    }
}

per_isa! {
    /// `grad[i] *= f'(x[i])`: the gradient to the result becomes the gradient to the argument.
    pub fn backward(kind: Activation, x: &[f32], grad: &mut [f32]) {
        match kind {
            Activation::Mish => grad.iter_mut().zip(x).for_each(|(grad, &x)| *grad *= math::mish_derivative(x)),
            Activation::Silu => grad.iter_mut().zip(x).for_each(|(grad, &x)| *grad *= math::silu_derivative(x)),
            Activation::GeluTanh => grad.iter_mut().zip(x).for_each(|(grad, &x)| *grad *= math::gelu_derivative(x)),
            Activation::Relu => grad.iter_mut().zip(x).for_each(|(grad, &x)| *grad = if x > 0.0 { *grad } else { 0.0 }),
            Activation::Clamp(low, high) => grad.iter_mut().zip(x).for_each(|(grad, &x)| *grad *= between(x, low, high)),
        }
    }
}

/// 1 inside of the bounds, 0 outside, and a half on them, between the slopes of both sides.
#[inline(always)]
fn between(x: f32, low: f32, high: f32) -> f32 {
    0.5 * (f32::from(x > low) + f32::from(x >= low)) * 0.5 * (f32::from(x < high) + f32::from(x <= high))
}
