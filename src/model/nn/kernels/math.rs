//! Elementary functions as short polynomials, in one form that the compiler vectorises for each instruction set.
//!
//! Only additions, multiplications, divisions, fused multiply-adds and comparisons: all exactly rounded, so all sets give the same
//! bits. NaN passes through. Bounds (held by the tests below): `exp` within 2 ulp on [-87, 88] and clamped outside, `sigmoid` within
//! 4 ulp on [-87, 88], `tanh` within 4 ulp, `mish` and its derivative within 2e-6 relative to `max(1, |x|)`.

/// Below this argument `exp` would leave the normal numbers.
const EXP_LOW: f32 = -87.0;
/// Above this argument `exp` would overflow.
const EXP_HIGH: f32 = 88.0;
/// 1.5 * 2^23: adding it rounds a small number to the nearest integer and leaves that integer in the low bits.
const ROUND: f32 = 12_582_912.0;

/// `x` held between `low` and `high`; NaN stays NaN.
#[inline(always)]
fn clamp(x: f32, low: f32, high: f32) -> f32 {
    let x = if x < low { low } else { x };
    if x > high { high } else { x }
}

/// The value of a polynomial, highest power first, by Horner's rule.
#[inline(always)]
fn polynomial<const N: usize>(x: f32, coefficients: [f32; N]) -> f32 {
    let mut value = coefficients[0];
    for &coefficient in &coefficients[1..] {
        value = value.mul_add(x, coefficient);
    }
    value
}

/// `e^x`, with `x` clamped to [-87, 88].
///
/// `x = n ln 2 + r` with `|r| <= ln 2 / 2`; `e^r` by a polynomial (coefficients: Moshier, Cephes `expf`).
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = clamp(x, EXP_LOW, EXP_HIGH);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    let tail = polynomial(r, [1.987_569_1e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5]);
    let power = f32::from_bits(shifted.to_bits().wrapping_add(127) << 23);
    let value = (r * r).mul_add(tail, r) + 1.0;
    if x.is_nan() { x } else { value * power }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Hyperbolic tangent: a polynomial near zero (coefficients: Moshier, Cephes `tanhf`), else by `e^2|x|`.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let (size, square) = (x.abs(), x * x);
    let series = polynomial(square, [-5.704_988_7e-3, 2.063_909e-2, -5.373_971_6e-2, 1.333_144_2e-1, -3.333_328e-1]);
    let near = (square * x).mul_add(series, x);
    let far = (1.0 - 2.0 / (exp(2.0 * size) + 1.0)).copysign(x);
    if size < 0.625 { near } else { far }
}

/// `(tanh(softplus(x)), its derivative)`, from `e^x` alone: with `n = e^x (e^x + 2)`, `tanh(ln(1 + e^x)) = n / (n + 2)`.
#[inline(always)]
fn tanh_softplus(x: f32) -> (f32, f32) {
    // Beyond 20 the value is 1 in f32 and the derivative below 1e-16; the clamp keeps the squares finite.
    let e = exp(if x > 20.0 { 20.0 } else { x });
    let n = e * (e + 2.0);
    let inverse = 1.0 / (n + 2.0);
    (n * inverse, 4.0 * e * (e + 1.0) * inverse * inverse)
}

/// `x tanh(softplus(x))` (Misra 2019).
#[inline(always)]
pub fn mish(x: f32) -> f32 {
    x * tanh_softplus(x).0
}

/// Derivative of [`mish`].
#[inline(always)]
pub fn mish_derivative(x: f32) -> f32 {
    let (value, derivative) = tanh_softplus(x);
    // Beyond 20 the clamped derivative no longer falls, but x grows on.
    if x > 20.0 { 1.0 } else { x.mul_add(derivative, value) }
}

/// `x sigmoid(x)`.
#[inline(always)]
pub fn silu(x: f32) -> f32 {
    x * sigmoid(x)
}

/// Derivative of [`silu`].
#[inline(always)]
pub fn silu_derivative(x: f32) -> f32 {
    let s = sigmoid(x);
    s * x.mul_add(1.0 - s, 1.0)
}

/// Twice the argument of the hyperbolic tangent in GELU: `2 sqrt(2/pi) (x + 0.044715 x^3)`.
#[inline(always)]
fn gelu_argument(x: f32) -> f32 {
    1.595_769 * (x * x * x).mul_add(0.044_715, x)
}

/// GELU by its hyperbolic tangent, `x/2 (1 + tanh u) = x sigmoid(2u)` (Hendrycks and Gimpel 2016; PyTorch `approximate="tanh"`).
#[inline(always)]
pub fn gelu(x: f32) -> f32 {
    x * sigmoid(gelu_argument(x))
}

/// Derivative of [`gelu`].
#[inline(always)]
pub fn gelu_derivative(x: f32) -> f32 {
    let s = sigmoid(gelu_argument(x));
    let slope = 1.595_769 * (x * x).mul_add(0.134_145, 1.0);
    (x * slope * (1.0 - s)).mul_add(s, s)
}

/// How many partial sums [`sum`] and its kin keep; a fixed number, so that the order of addition is one for all processors.
pub const LANES: usize = 16;

/// The sum of `value(i)` over `0..count`: lane `i % 16` adds up in ascending order, then the lanes fold by halves.
#[inline(always)]
pub fn sum(count: usize, value: impl Fn(usize) -> f32) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    let whole = count - count % LANES;
    for start in (0..whole).step_by(LANES) {
        for (lane, total) in lanes.iter_mut().enumerate() {
            *total += value(start + lane);
        }
    }
    for i in whole..count {
        lanes[i - whole] += value(i);
    }
    for half in [8, 4, 2, 1] {
        for lane in 0..half {
            lanes[lane] += lanes[lane + half];
        }
    }
    lanes[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(low: f32, high: f32) -> impl Iterator<Item = f32> {
        (0..=400_000).map(move |i| low + (high - low) * (i as f32 / 400_000.0))
    }

    /// Distance in units of the last place of the f32 nearest to the truth.
    fn ulps(value: f32, truth: f64) -> f64 {
        let nearest = truth as f32;
        let place = f64::from(f32::from_bits(nearest.abs().to_bits() + 1)) - f64::from(nearest.abs());
        (f64::from(value) - truth).abs() / place
    }

    fn worst(low: f32, high: f32, ours: fn(f32) -> f32, truth: fn(f64) -> f64) -> f64 {
        grid(low, high).map(|x| ulps(ours(x), truth(f64::from(x)))).fold(0.0, f64::max)
    }

    fn mish64(x: f64) -> f64 {
        x * x.exp().ln_1p().tanh()
    }

    #[test]
    fn bounds_in_ulps() {
        let sigmoid64: fn(f64) -> f64 = |x| 1.0 / (1.0 + (-x).exp());
        let found = [
            worst(-87.0, 88.0, exp, f64::exp),
            worst(-1.0, 1.0, exp, f64::exp),
            worst(-87.0, 88.0, sigmoid, sigmoid64),
            worst(-10.0, 10.0, tanh, f64::tanh),
            worst(-0.7, 0.7, tanh, f64::tanh),
        ];
        for (found, bound) in found.iter().zip([2.0, 2.0, 4.0, 4.0, 4.0]) {
            assert!(found <= &bound, "{found} ulp, bound {bound}");
        }
    }

    #[test]
    fn mish_and_its_derivative() {
        for x in grid(-30.0, 30.0) {
            let (wide, scale) = (f64::from(x), f64::from(x.abs()).max(1.0));
            let slope = (mish64(wide + 1e-5) - mish64(wide - 1e-5)) / 2e-5;
            assert!((f64::from(mish(x)) - mish64(wide)).abs() <= 2e-6 * scale, "mish({x})");
            assert!((f64::from(mish_derivative(x)) - slope).abs() <= 2e-6 * scale, "mish'({x}) is {} not {slope}", mish_derivative(x));
        }
    }

    #[test]
    fn finite_far_out_and_nan_through() {
        for f in [mish, mish_derivative, silu, silu_derivative, gelu, gelu_derivative, tanh, sigmoid, exp] {
            for x in [-1e4_f32, -500.0, -89.0, 89.0, 500.0, 1e4] {
                assert!(f(x).is_finite(), "{x}");
            }
            assert!(f(f32::NAN).is_nan());
        }
    }

    #[test]
    fn sum_counts_every_value_once() {
        for count in [0, 1, 15, 16, 17, 64, 101] {
            assert_eq!(sum(count, |i| i as f32), (0..count).sum::<usize>() as f32);
        }
    }
}
