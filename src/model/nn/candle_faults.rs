//! What candle 0.11 gets wrong on the CPU and the layers go around. When one of these assertions fails after an upgrade, candle has
//! mended that fault, and the way around it may go.

use super::testing::{distance, flat, gaussian, scrambled};
use candle_core::{D, Device, IndexOp, Tensor, Var};

/// The gradient of the kernel of `Tensor::conv1d` is wrong for batch > 1 with more than one output channel.
#[test]
fn conv1d_kernel_gradient() {
    let (x, kernel) = (gaussian(1, (2, 3, 7)), Var::from_tensor(&gaussian(2, (4, 3, 3))).unwrap());
    let r = gaussian(3, (2, 4, 7));
    let grad = |x: &Tensor, r: &Tensor| {
        let loss = (x.conv1d(&kernel, 1, 1, 1, 1).unwrap() * r).unwrap().sum_all().unwrap();
        loss.backward().unwrap().get(&kernel).unwrap().clone()
    };
    let rows: Vec<Tensor> = (0..2).map(|i| grad(&x.narrow(0, i, 1).unwrap(), &r.narrow(0, i, 1).unwrap())).collect();
    let by_row = (&rows[0] + &rows[1]).unwrap();
    assert!(distance(&flat(&grad(&x, &r)), &flat(&by_row)) > 0.1, "candle's conv1d kernel gradient is right now");
}

/// `candle_nn::Linear` on a transposed input of three dimensions gives other numbers than on its contiguous copy.
#[test]
fn linear_on_a_transposed_input() {
    let layer = candle_nn::Linear::new(gaussian(1, (4, 3)), None);
    let x = scrambled(&gaussian(2, (2, 5, 3)), 1, 2);
    let (strided, straight) = (candle_nn::Module::forward(&layer, &x), candle_nn::Module::forward(&layer, &x.contiguous().unwrap()));
    assert!(distance(&flat(&strided.unwrap()), &flat(&straight.unwrap())) > 0.1, "candle's Linear takes transposed input now");
}

/// Layer norm and softmax over the last dimension pass no gradient and say nothing.
#[test]
fn layer_norm_and_softmax_without_gradient() {
    let x = Var::from_tensor(&gaussian(1, (2, 5))).unwrap();
    let (weight, bias) = (gaussian(2, 5), gaussian(3, 5));
    for y in [candle_nn::ops::layer_norm(&x, &weight, &bias, 1e-5), candle_nn::ops::softmax_last_dim(&x)] {
        let grads = y.unwrap().sqr().unwrap().sum_all().unwrap().backward().unwrap();
        assert!(grads.get(&x).is_none(), "candle passes a gradient now");
    }
    let y = candle_nn::ops::softmax(&x, D::Minus1).unwrap();
    assert!(y.sqr().unwrap().sum_all().unwrap().backward().unwrap().get(&x).is_some());
}

/// The transposed convolution has no backward, and its forward without padding is wrong for batch > 1.
#[test]
fn conv_transpose1d() {
    let (x, kernel) = (Var::from_tensor(&gaussian(1, (2, 3, 5))).unwrap(), gaussian(2, (3, 4, 4)));
    let y = x.conv_transpose1d(&kernel, 1, 0, 2, 1, 1).unwrap();
    assert!(y.sum_all().unwrap().backward().is_err(), "candle's conv_transpose1d has a backward now");
    let y = x.conv_transpose1d(&kernel, 0, 0, 2, 1, 1).unwrap();
    let alone = x.narrow(0, 1, 1).unwrap().contiguous().unwrap().conv_transpose1d(&kernel, 0, 0, 2, 1, 1).unwrap();
    assert!(distance(&flat(&y.i(1).unwrap()), &flat(&alone)) > 0.1, "candle's conv_transpose1d is right for a batch now");
}

/// Mish has a gradient of NaN far out.
#[test]
fn mish_gradient_far_out() {
    let x = Var::from_tensor(&Tensor::new(&[100.0_f32], &Device::Cpu).unwrap()).unwrap();
    let grads = candle_nn::ops::mish(&x).unwrap().sum_all().unwrap().backward().unwrap();
    assert!(flat(grads.get(&x).unwrap())[0].is_nan(), "candle's mish has a gradient far out now");
}
