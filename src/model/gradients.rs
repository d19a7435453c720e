//! Whole networks that are run with a way back while serving: results, gradients to the inputs and bits, against every other way there is.

use crate::model::nn::{
    Activations, Buffer, Params, Precision, Traced, gradient,
    kernels::testing::with_each_isa,
    testing::{bits, distance, flat, gaussian},
};
use candle_core::{DType, Result, Tensor, Var};
use std::{collections::BTreeMap, ops::Range};

/// A network over any values; its inputs are `(batch, steps, channels)`.
pub trait Network {
    /// With its parameters.
    type Built;

    /// Its layers.
    fn build(&self, params: &Params) -> Result<Self::Built>;

    /// Its result on these rows of the batch.
    fn run<V: Activations>(&self, built: &Self::Built, inputs: &[V], rows: Range<usize>) -> Result<V>;
}

/// Variables, jogged so that no gate is closed and no norm plain.
fn jogged(network: &impl Network) -> Params {
    let params = Params::fresh(1);
    network.build(&params).unwrap();
    for (i, var) in params.vars().values().enumerate() {
        var.set(&(var.as_tensor() + (gaussian(50 + i as u64, var.shape()) * 0.1).unwrap()).unwrap()).unwrap();
    }
    params
}

/// The same as constants with a way back.
fn constants(params: &Params, precision: Precision) -> Params {
    let constant = |(name, var): (String, Var)| (name, var.as_tensor().copy().unwrap());
    Params::loaded_as(params.vars().into_iter().map(constant).collect::<BTreeMap<_, _>>(), precision).with_way_back()
}

fn buffer(tensor: &Tensor) -> Buffer {
    let (batch, steps, channels) = tensor.dims3().unwrap();
    Buffer::generate([batch, steps, channels], |out| out.copy_from_slice(&flat(tensor))).unwrap()
}

/// Some rows of a batch, and of the gradient to its results.
fn cut<const N: usize>(inputs: &[Tensor; N], weights: &[f32], rows: &Range<usize>) -> ([Buffer; N], Vec<f32>) {
    let size = weights.len() / inputs[0].dim(0).unwrap();
    let part = |input: &Tensor| buffer(&input.narrow(0, rows.start, rows.len()).unwrap());
    (inputs.each_ref().map(part), weights[rows.start * size..rows.end * size].to_vec())
}

/// The result and each gradient, of some rows.
fn traced<T: Network, const N: usize>(
    network: &T,
    built: &T::Built,
    (inputs, weights): ([Buffer; N], Vec<f32>),
    rows: Range<usize>,
) -> Vec<Buffer> {
    let run = |inputs: [Traced; N]| network.run(built, &inputs, rows);
    let (result, grads) = gradient(inputs, run, |_, grad| grad.copy_from_slice(&weights)).unwrap();
    std::iter::once(result).chain(grads).collect()
}

fn bits_of(buffers: &[Buffer]) -> Vec<Vec<u32>> {
    buffers.iter().map(|buffer| buffer.iter().map(|value| value.to_bits()).collect()).collect()
}

/// Forward as on tensors and buffers, bit for bit; gradients as by candle and as by central differences; and whatever is the batch around a
/// row, the instruction set or the thread, its bits are the same.
pub fn check<T: Network<Built: Sync> + Sync, const N: usize>(network: &T, inputs: &[Tensor; N]) {
    let (batch, variables) = (inputs[0].dim(0).unwrap(), jogged(network));
    let (served, trained) = (network.build(&constants(&variables, Precision::F32)).unwrap(), network.build(&variables).unwrap());
    let vars = inputs.each_ref().map(|input| Var::from_tensor(input).unwrap());
    let y = network.run(&trained, &vars.each_ref().map(|var| var.as_tensor().clone()), 0..batch).unwrap();
    let weights = gaussian(99, y.shape());
    let whole = || cut(inputs, &flat(&weights), &(0..batch));
    let found = traced(network, &served, whole(), 0..batch);
    let plain = |inputs: &[Buffer; N]| network.run(&served, inputs, 0..batch).unwrap();
    assert_eq!(bits_of(&[plain(&whole().0), found[0].clone()]), [bits(&y), bits(&y)]);
    let grads = (&y * &weights).unwrap().sum_all().unwrap().backward().unwrap();
    for (which, (var, found)) in vars.iter().zip(&found[1..]).enumerate() {
        let error = off(found, &flat(grads.get(var).unwrap()));
        assert!(error < 2e-6, "input {which}: {error} off candle's");
        let error = off(found, &slopes(&whole().0, which, &|inputs| inner(&plain(inputs), &flat(&weights))));
        assert!(error < 2e-3, "input {which}: {error} off the central differences");
    }
    for row in 0..batch {
        let own: Vec<_> = bits_of(&found).iter().map(|bits| bits.chunks_exact(bits.len() / batch).nth(row).unwrap().to_vec()).collect();
        let alone = || bits_of(&traced(network, &served, cut(inputs, &flat(&weights), &(row..row + 1)), row..row + 1));
        with_each_isa(|isa| assert_eq!(alone(), own, "row {row}, {isa:?}"));
        assert_eq!(std::thread::scope(|scope| scope.spawn(alone).join().unwrap()), own, "row {row}");
    }
    check_half(network, &variables, whole);
}

/// With weights of half the bits, those of a network whose weights were rounded before.
fn check_half<T: Network, const N: usize>(network: &T, variables: &Params, whole: impl Fn() -> ([Buffer; N], Vec<f32>)) {
    let batch = whole().0[0].shape().unwrap()[0];
    let half = network.build(&constants(variables, Precision::Bf16)).unwrap();
    for var in variables.vars().values().filter(|var| var.rank() > 1) {
        var.set(&var.to_dtype(DType::BF16).unwrap().to_dtype(DType::F32).unwrap()).unwrap();
    }
    let rounded = network.build(&constants(variables, Precision::F32)).unwrap();
    let [half, rounded] = [half, rounded].map(|built| bits_of(&traced(network, &built, whole(), 0..batch)));
    assert_eq!(half, rounded);
}

/// The largest difference in units of the largest value.
fn off(found: &[f32], expected: &[f32]) -> f32 {
    let top = expected.iter().fold(f32::MIN_POSITIVE, |top, x| top.max(x.abs()));
    let in_units = |values: &[f32]| values.iter().map(|value| value / top).collect::<Vec<_>>();
    distance(&in_units(found), &in_units(expected))
}

fn inner(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

/// Central differences in one of the inputs.
fn slopes<const N: usize>(inputs: &[Buffer; N], which: usize, loss: &dyn Fn(&[Buffer; N]) -> f64) -> Vec<f32> {
    let step = 1e-2_f32;
    let moved = |i: usize, by: f32| {
        let mut inputs = inputs.clone();
        inputs[which][i] += by;
        loss(&inputs)
    };
    (0..inputs[which].len()).map(|i| ((moved(i, step) - moved(i, -step)) / (2.0 * f64::from(step))) as f32).collect()
}
