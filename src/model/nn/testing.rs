//! What the layers' tests share: seeded tensors, central differences, bit equality over instruction sets and batches.

use super::kernels::testing::with_each_isa;
use crate::model::noise::Philox;
use candle_core::{Device, Result, Shape, Tensor, Var};

/// Seeded Gaussian values.
pub(in crate::model) fn gaussian(seed: u64, shape: impl Into<Shape>) -> Tensor {
    let (shape, mut noise) = (shape.into(), Philox::new(seed));
    let values: Vec<f32> = (0..shape.elem_count()).map(|_| noise.normal()).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// All values in order.
pub(in crate::model) fn flat(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// All bits in order.
pub(in crate::model) fn bits(x: &Tensor) -> Vec<u32> {
    flat(x).into_iter().map(f32::to_bits).collect()
}

/// The largest difference, relative to the larger of 1 and the largest value.
pub(in crate::model) fn distance(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let scale = b.iter().fold(1.0_f32, |top, x| top.max(x.abs()));
    a.iter().zip(b).map(|(a, b)| if (a - b).is_nan() { f32::INFINITY } else { (a - b).abs() }).fold(0.0, f32::max) / scale
}

/// Backward of the scalar `sum(f(inputs) * weights)` with fixed random weights, for every input.
pub(super) fn gradients(inputs: &[Tensor], f: &dyn Fn(&[Tensor]) -> Result<Tensor>) -> Vec<Tensor> {
    let vars: Vec<Var> = inputs.iter().map(|input| Var::from_tensor(input).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
    let y = f(&tensors).unwrap();
    let grads = (&y * gaussian(99, y.shape())).unwrap().sum_all().unwrap().backward().unwrap();
    tensors.iter().map(|tensor| grads.get(tensor).expect("an input got no gradient").clone()).collect()
}

/// Backward agrees with central differences in every entry of every input, and is the same bits with every instruction set.
pub(super) fn check_gradients(inputs: &[Tensor], f: &dyn Fn(&[Tensor]) -> Result<Tensor>) {
    let step = 1e-2_f32;
    let y = f(inputs).unwrap();
    let weights = flat(&gaussian(99, y.shape()));
    let loss =
        |inputs: &[Tensor]| -> f64 { flat(&f(inputs).unwrap()).iter().zip(&weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum() };
    let grads = gradients(inputs, f);
    for (which, grad) in grads.iter().enumerate() {
        let values = flat(&inputs[which]);
        let moved = |i: usize, by: f32| {
            let (mut inputs, mut values) = (inputs.to_vec(), values.clone());
            values[i] += by;
            inputs[which] = Tensor::from_vec(values, inputs[which].shape(), &Device::Cpu).unwrap();
            loss(&inputs)
        };
        let slopes: Vec<f32> = (0..values.len()).map(|i| ((moved(i, step) - moved(i, -step)) / (2.0 * f64::from(step))) as f32).collect();
        let error = distance(&flat(grad), &slopes);
        assert!(error < 2e-3, "input {which}: {error} off the central differences");
    }
    let all = with_each_isa(|_| {
        let mut all = bits(&f(inputs).unwrap());
        gradients(inputs, f).iter().for_each(|grad| all.extend(bits(grad)));
        all
    });
    assert!(all.iter().all(|bits| *bits == all[0]), "instruction sets differ");
}

/// Row `i` of `f` over a batch has the bits of `f` over row `i` alone.
pub(super) fn check_rows(inputs: &[Tensor], f: &dyn Fn(&[Tensor]) -> Result<Tensor>) {
    let whole = f(inputs).unwrap();
    for i in 0..whole.dim(0).unwrap() {
        let alone: Vec<Tensor> = inputs.iter().map(|input| input.narrow(0, i, 1).unwrap()).collect();
        assert_eq!(bits(&whole.narrow(0, i, 1).unwrap()), bits(&f(&alone).unwrap()), "row {i}");
    }
}

/// `x` with two dimensions exchanged in memory: the same values, not contiguous.
pub(super) fn scrambled(x: &Tensor, a: usize, b: usize) -> Tensor {
    let scrambled = x.transpose(a, b).unwrap().contiguous().unwrap().transpose(a, b).unwrap();
    assert!(!scrambled.is_contiguous());
    scrambled
}
