//! Every layer against central differences, on odd shapes, on strided input, by row, and with every instruction set.

use super::{
    Activation::{Clamp, GeluTanh, Mish, Relu, Silu},
    testing::*,
    *,
};
use candle_core::{Result, Tensor};
use std::collections::BTreeMap;

type Function = Box<dyn Fn(&Tensor, &Params) -> Result<Tensor>>;

/// A layer's result as a function of its input and its parameters: `inputs[0]` is `x`, the rest stand in the order of names.
fn as_function(layer: Function, names: Vec<String>) -> impl Fn(&[Tensor]) -> Result<Tensor> {
    move |inputs| {
        let named: BTreeMap<String, Tensor> = names.iter().cloned().zip(inputs[1..].iter().cloned()).collect();
        layer(&inputs[0], &Params::given(named))
    }
}

fn layers() -> Vec<(&'static str, Tensor, Function)> {
    let conv = |c_in, c_out, kernel, stride, padding| ConvShape { c_in, c_out, kernel, stride, padding };
    let convolution = |shape| -> Function { Box::new(move |x, p| Conv1d::new(shape, p)?.forward(x)) };
    let transpose = |shape| -> Function { Box::new(move |x, p| ConvTranspose1d::new(shape, p)?.forward(x)) };
    let group_norm = |groups, channels| -> Function { Box::new(move |x, p| GroupNormMish::new(groups, channels, p)?.forward(x.clone())) };
    let layer_norm = |affine| -> Function { Box::new(move |x, p| LayerNorm::new(19, affine, 1e-6, p)?.forward(x)) };
    vec![
        ("linear", gaussian(1, (7, 1, 5)), Box::new(|x, p| Linear::new(5, 67, p)?.forward(x))),
        (
            "linear in parts",
            gaussian(15, (7, 2, 5)),
            Box::new(|x, p| {
                let [a, b] = Linear::parts(5, [3, 18], Init::FanIn(5), p)?;
                Tensor::cat(&[b.forward(x)?, a.forward(x)?], 2)
            }),
        ),
        ("linear, three dimensions", gaussian(2, (3, 2, 18)), Box::new(|x, p| Linear::new(18, 3, p)?.forward(x))),
        ("convolution", gaussian(3, (3, 7, 4)), convolution(conv(4, 18, 5, 1, 2))),
        ("convolution without padding", gaussian(4, (2, 6, 3)), convolution(conv(3, 5, 3, 1, 0))),
        ("convolution, more padding than taps", gaussian(14, (2, 4, 3)), convolution(conv(3, 2, 2, 1, 2))),
        ("convolution of stride 2, even", gaussian(5, (2, 8, 3)), convolution(conv(3, 4, 3, 2, 1))),
        ("convolution of stride 2, odd", gaussian(6, (2, 7, 3)), convolution(conv(3, 4, 4, 2, 1))),
        ("pointwise convolution", gaussian(7, (2, 5, 3)), convolution(conv(3, 33, 1, 1, 0))),
        ("transposed convolution", gaussian(8, (3, 4, 3)), transpose(conv(3, 5, 4, 2, 1))),
        ("transposed convolution of stride 3", gaussian(9, (2, 3, 4)), transpose(conv(4, 2, 3, 3, 0))),
        ("group norm and mish", gaussian(10, (3, 5, 12)), group_norm(4, 12)),
        ("group norm and mish, wide groups", gaussian(11, (2, 3, 40)), group_norm(2, 40)),
        ("layer norm", gaussian(12, (2, 4, 19)), layer_norm(true)),
        ("layer norm, plain", gaussian(13, (2, 4, 19)), layer_norm(false)),
    ]
}

/// Fresh parameters, jogged so that weights of 1 and biases of 0 hide nothing.
fn parameters(x: &Tensor, layer: &Function) -> (Vec<String>, Vec<Tensor>) {
    let params = Params::fresh(5);
    layer(x, &params).unwrap();
    let jog = |(i, tensor): (usize, Tensor)| (&tensor + (gaussian(50 + i as u64, tensor.shape()) * 0.3).unwrap()).unwrap();
    let vars = params.vars();
    let values = vars.values().map(|var| var.as_tensor().copy().unwrap()).enumerate().map(jog);
    (vars.keys().cloned().collect(), values.collect())
}

#[test]
fn layers_against_central_differences() {
    for (name, x, layer) in layers() {
        println!("{name}");
        let (names, values) = parameters(&x, &layer);
        let inputs: Vec<Tensor> = std::iter::once(x).chain(values).collect();
        check_gradients(&inputs, &as_function(layer, names));
    }
}

#[test]
fn strided_input_and_rows_alone() {
    for (name, x, layer) in layers() {
        println!("{name}");
        let params = Params::fresh(5);
        let y = layer(&x, &params).unwrap();
        let strided = scrambled(&x, 0, x.rank() - 1);
        assert_eq!(bits(&layer(&strided, &params).unwrap()), bits(&y));
        let through = |inputs: &[Tensor]| layer(&inputs[0].transpose(0, inputs[0].rank() - 1)?, &params);
        let straight = gradients(std::slice::from_ref(&x), &|inputs| layer(&inputs[0], &params));
        let back = gradients(&[x.transpose(0, x.rank() - 1).unwrap().contiguous().unwrap()], &through);
        assert_eq!(bits(&back[0].transpose(0, x.rank() - 1).unwrap()), bits(&straight[0]));
        check_rows(&[x], &|inputs| layer(&inputs[0], &params));
    }
}

/// The parameters of a fresh store as constants.
fn frozen(fresh: &Params, precision: Precision) -> Params {
    let constant = |(name, var): (String, candle_core::Var)| (name, var.as_tensor().copy().unwrap());
    Params::loaded_as(fresh.vars().into_iter().map(constant).collect(), precision)
}

/// Packing once at construction and packing at each call are one and the same, on the way back too.
#[test]
fn frozen_weights_give_the_same_bits() {
    for (name, x, layer) in layers() {
        let fresh = Params::fresh(5);
        let y = layer(&x, &fresh).unwrap();
        let frozen = frozen(&fresh, Precision::F32);
        assert_eq!(bits(&layer(&x, &frozen).unwrap()), bits(&y), "{name}");
        assert!(frozen.unused().is_empty());
        let to_x = |params: &Params| gradients(std::slice::from_ref(&x), &|inputs| layer(&inputs[0], params)).remove(0);
        assert_eq!(bits(&to_x(&frozen.with_way_back())), bits(&to_x(&fresh)), "{name}");
    }
}

/// Half the bits, the same weights on both ways: those of layers whose weights were rounded before.
#[test]
fn the_way_back_is_as_precise_as_the_way_forth() {
    for (name, x, layer) in layers() {
        let fresh = Params::fresh(5);
        layer(&x, &fresh).unwrap();
        let half = frozen(&fresh, Precision::Bf16).with_way_back();
        for var in fresh.vars().values().filter(|var| var.rank() > 1) {
            var.set(&var.to_dtype(candle_core::DType::BF16).unwrap().to_dtype(candle_core::DType::F32).unwrap()).unwrap();
        }
        let to_x = |params: &Params| gradients(std::slice::from_ref(&x), &|inputs| layer(&inputs[0], params)).remove(0);
        assert_eq!(bits(&to_x(&half)), bits(&to_x(&fresh)), "{name}");
    }
}

/// Constant weights are packed for the way forth and not held otherwise, unless that was asked for: what would need them says so.
#[test]
fn packed_weights_have_no_way_back() {
    let fresh = Params::fresh(5);
    Linear::new(3, 2, &fresh).unwrap();
    Gru::new(3, 2, &fresh).unwrap();
    let frozen = frozen(&fresh, Precision::F32);
    let x = candle_core::Var::from_tensor(&gaussian(1, (2, 4, 3))).unwrap();
    for y in [Linear::new(3, 2, &frozen).unwrap().forward(x.as_tensor()), Gru::new(3, 2, &frozen).unwrap().forward(x.as_tensor(), None)] {
        let error = y.unwrap().sum_all().unwrap().backward().unwrap_err();
        assert!(plain(&error).contains("has no way back"), "{error}");
    }
}

/// GRU inputs: x, h0, then parameters by name.
fn gru(inputs: &[Tensor]) -> Result<Tensor> {
    let names = ["bias_hh_l0", "bias_ih_l0", "weight_hh_l0", "weight_ih_l0"];
    let named = names.iter().map(|name| (*name).to_owned()).zip(inputs[2..].iter().cloned()).collect();
    Gru::new(3, 5, &Params::given(named))?.forward(&inputs[0], Some(&inputs[1]))
}

#[test]
fn gru_against_central_differences() {
    let inputs =
        [gaussian(1, (3, 4, 3)), gaussian(2, (3, 1, 5)), gaussian(3, 15), gaussian(4, 15), gaussian(5, (15, 5)), gaussian(6, (15, 3))];
    check_gradients(&inputs, &gru);
    check_rows(&inputs[..2], &|rows| gru(&[rows, &inputs[2..]].concat()));
    let strided = [&[scrambled(&inputs[0], 0, 1), scrambled(&inputs[1], 0, 2)], &inputs[2..]].concat();
    assert_eq!(bits(&gru(&strided).unwrap()), bits(&gru(&inputs).unwrap()));
}

#[test]
fn gru_packed_once_gives_the_same_bits() {
    let (inputs, fresh) = ([gaussian(1, (2, 3, 4)), gaussian(2, (2, 1, 20))], Params::fresh(5));
    let run = |inputs: &[Tensor], params: &Params| Gru::new(4, 20, params)?.forward(&inputs[0], Some(&inputs[1]));
    let y = run(&inputs, &fresh).unwrap();
    let frozen = frozen(&fresh, Precision::F32);
    assert_eq!(bits(&run(&inputs, &frozen).unwrap()), bits(&y));
    let (straight, frozen) = (gradients(&inputs, &|inputs| run(inputs, &fresh)), frozen.with_way_back());
    for (back, straight) in gradients(&inputs, &|inputs| run(inputs, &frozen)).iter().zip(&straight) {
        assert_eq!(bits(back), bits(straight));
    }
}

#[test]
fn attention_against_central_differences() {
    for (batch, steps, heads, head_dim) in [(2, 3, 2, 4), (2, 17, 1, 3), (1, 2, 3, 17)] {
        let qkv = gaussian(1, (batch, steps, 3 * heads * head_dim));
        check_gradients(std::slice::from_ref(&qkv), &|inputs| inputs[0].attention(heads));
        check_rows(std::slice::from_ref(&qkv), &|inputs| inputs[0].attention(heads));
        assert_eq!(bits(&scrambled(&qkv, 1, 2).attention(heads).unwrap()), bits(&qkv.attention(heads).unwrap()));
        check_gradients(std::slice::from_ref(&qkv), &|inputs| inputs[0].causal_attention(heads));
        check_rows(std::slice::from_ref(&qkv), &|inputs| inputs[0].causal_attention(heads));
    }
}

/// Each step sees what it would see if the later ones were not there.
#[test]
fn causal_attention_is_that_of_the_steps_so_far() {
    let qkv = gaussian(1, (2, 19, 18));
    let all = qkv.causal_attention(2).unwrap();
    for len in [1, 2, 8, 19] {
        let so_far = qkv.narrow(1, 0, len).unwrap().contiguous().unwrap().attention(2).unwrap();
        let (last, expected) = (all.narrow(1, len - 1, 1).unwrap(), so_far.narrow(1, len - 1, 1).unwrap());
        assert!(distance(&flat(&last), &flat(&expected)) < 1e-6, "{len}");
    }
}

#[test]
fn attention_on_others_against_central_differences() {
    for (batch, queries, keys, heads, head_dim) in [(2, 3, 5, 2, 4), (2, 17, 2, 1, 3), (1, 1, 18, 3, 17)] {
        let width = heads * head_dim;
        let inputs = [gaussian(1, (batch, queries, width)), gaussian(2, (batch, keys, 2 * width))];
        check_gradients(&inputs, &|inputs| inputs[0].attending(&inputs[1], heads));
        check_rows(&inputs, &|inputs| inputs[0].attending(&inputs[1], heads));
    }
    // On themselves it is self-attention.
    let qkv = gaussian(3, (2, 7, 24));
    let [q, kv] = [(0, 8), (8, 16)].map(|(start, len)| qkv.narrow(2, start, len).unwrap().contiguous().unwrap());
    assert_eq!(bits(&q.attending(&kv, 2).unwrap()), bits(&qkv.attention(2).unwrap()));
}

#[test]
fn joins_against_central_differences() {
    let (x, e, y) = (gaussian(1, (2, 3, 5)), gaussian(2, (2, 1, 5)), gaussian(3, (2, 3, 4)));
    let (h, ada) = (gaussian(4, (2, 3, 5)), gaussian(5, (2, 3, 10)));
    check_gradients(&[x.clone(), e.clone()], &|inputs| inputs[0].clone().plus_at_each_step(&inputs[1]));
    check_gradients(&[x.clone(), ada.clone()], &|inputs| inputs[0].clone().modulated(&inputs[1]));
    check_gradients(&[x.clone(), h.clone(), (h * 0.7).unwrap()], &|inputs| inputs[0].clone().plus_gated(&inputs[1], &inputs[2]));
    check_gradients(&[x.clone(), y.clone()], &|inputs| Tensor::beside(&[&inputs[0], &inputs[1], &inputs[0]]));
    check_gradients(&[x.clone(), ada.narrow(2, 2, 5).unwrap().contiguous().unwrap()], &|inputs| inputs[0].clone().plus(&inputs[1]));
    let expected = Tensor::cat(&[&x, &y], 2).unwrap();
    assert_eq!(bits(&Tensor::beside(&[&x, &y]).unwrap()), bits(&expected));
    let expected = x.broadcast_add(&e).unwrap();
    assert_eq!(bits(&scrambled(&x, 0, 2).plus_at_each_step(&e).unwrap()), bits(&expected));
}

#[test]
fn cuts_against_central_differences() {
    let x = gaussian(1, (2, 3, 5));
    check_gradients(std::slice::from_ref(&x), &|inputs| inputs[0].channels(1, 3));
    check_gradients(std::slice::from_ref(&x), &|inputs| inputs[0].step(1));
    check_gradients(std::slice::from_ref(&x), &|inputs| inputs[0].flattened());
    assert_eq!(bits(&x.channels(1, 3).unwrap()), bits(&x.narrow(2, 1, 3).unwrap()));
    assert_eq!(bits(&x.step(2).unwrap()), bits(&x.narrow(1, 2, 1).unwrap()));
    let flattened = scrambled(&x, 1, 2).flattened().unwrap();
    assert_eq!((flattened.dims(), bits(&flattened)), (&[2, 1, 15][..], bits(&x)));
}

/// The mask parts rows between the value and the vector, and gets no gradient itself.
#[test]
fn what_is_absent_against_central_differences() {
    let (x, absent) = (gaussian(1, (2, 3, 5)), gaussian(2, 5));
    let present = Tensor::new(&[1.0_f32, 0.0, 0.0, 1.0, 0.0, 1.0], &candle_core::Device::Cpu).unwrap().reshape((2, 3, 1)).unwrap();
    let mask = present.clone();
    let function = move |inputs: &[Tensor]| {
        let layer = Absent::new(5, Init::Const(0.0), &Params::given(BTreeMap::from([("absent".into(), inputs[1].clone())])))?;
        inputs[0].clone().or_absent(&mask, &layer)
    };
    check_gradients(&[x.clone(), absent.clone()], &function);
    let rows = flat(&function(&[x.clone(), absent.clone()]).unwrap());
    assert_eq!((&rows[..5], &rows[5..10]), (&flat(&x)[..5], &flat(&absent)[..]));
    let mask = candle_core::Var::from_tensor(&present).unwrap();
    let layer = Absent::new(5, Init::Const(0.0), &Params::fresh(1)).unwrap();
    assert!(x.or_absent(&mask, &layer).unwrap().sum_all().unwrap().backward().is_err());
}

#[test]
fn differences_against_central_differences() {
    let (x, y) = (gaussian(1, (2, 3, 5)), gaussian(2, (2, 3, 5)));
    let function = |inputs: &[Tensor]| inputs[0].clone().minus(&inputs[1]);
    check_gradients(&[x.clone(), y.clone()], &function);
    assert_eq!(bits(&function(&[x.clone(), y.clone()]).unwrap()), bits(&(&x - &y).unwrap()));
    assert!(x.minus(&gaussian(2, (2, 3, 4))).is_err());
}

#[test]
fn element_products_against_central_differences() {
    let (x, y) = (gaussian(1, (2, 3, 5)), gaussian(2, (2, 3, 5)));
    let function = |inputs: &[Tensor]| inputs[0].clone().times(&inputs[1]);
    check_gradients(&[x.clone(), y.clone()], &function);
    assert_eq!(bits(&function(&[x.clone(), y.clone()]).unwrap()), bits(&(&x * &y).unwrap()));
}

#[test]
fn activations_against_central_differences() {
    for activation in [Mish, Silu, GeluTanh, Relu, Clamp(-2.0, 0.0)] {
        // No value within a step of a corner.
        let x = gaussian(1, (3, 1, 11));
        let away = x.abs().unwrap().ge(0.02).unwrap().where_cond(&x, &x.ones_like().unwrap()).unwrap();
        check_gradients(std::slice::from_ref(&away), &|inputs| inputs[0].clone().activated(activation));
        check_rows(&[away], &|inputs| inputs[0].clone().activated(activation));
    }
}

/// On a bound the slope is between those of both sides, as candle has it (and a central difference).
#[test]
fn bounds_have_half_a_slope() {
    let x = Tensor::new(&[[[-3.0_f32, -2.0, 0.5, 1.0, 4.0]]], &candle_core::Device::Cpu).unwrap();
    for clamp in
        [&(|inputs: &[Tensor]| inputs[0].clone().clamped(-2.0, 1.0)) as &dyn Fn(&[Tensor]) -> _, &|inputs| inputs[0].clamp(-2.0, 1.0)]
    {
        let grad = gradients(std::slice::from_ref(&x), &|inputs| clamp(inputs)?.affine(1.0, 0.0));
        let weights = flat(&gaussian(99, x.shape()));
        assert_eq!(flat(&grad[0]), [0.0, 0.5 * weights[1], weights[2], 0.5 * weights[3], 0.0]);
    }
}

/// candle's own Mish has a gradient of NaN from x = 89 on.
#[test]
fn gradients_far_out_are_finite() {
    let x = Tensor::new(&[[[-1e4_f32, -89.0, -20.5, 20.5, 89.0, 1e4]]], &candle_core::Device::Cpu).unwrap();
    for activation in [Mish, Silu, GeluTanh, Relu, Clamp(-89.0, 3.0)] {
        let grad = gradients(std::slice::from_ref(&x), &|inputs| inputs[0].clone().activated(activation));
        assert!(flat(&grad[0]).iter().all(|grad| grad.is_finite()));
    }
}

#[test]
fn wrong_shapes_are_errors() {
    let p = Params::fresh(1);
    let shape = ConvShape { c_in: 3, c_out: 2, kernel: 5, stride: 1, padding: 0 };
    assert!(Linear::new(3, 2, &p).unwrap().forward(&gaussian(1, (2, 1, 4))).is_err());
    assert!(Linear::new(3, 2, &p).unwrap().forward(&gaussian(1, (2, 3))).is_err(), "the steps are missing");
    assert!(Conv1d::new(shape, &p.scope("conv")).unwrap().forward(&gaussian(1, (2, 4, 3))).is_err());
    assert!(Conv1d::new(shape, &p.scope("conv")).unwrap().forward(&gaussian(1, (8, 3))).is_err());
    assert!(GroupNormMish::new(3, 8, &p).is_err());
    assert!(LayerNorm::new(8, true, 1e-5, &p.scope("norm")).unwrap().forward(&gaussian(1, (2, 1, 4))).is_err());
    assert!(gaussian(1, (2, 4, 8)).attention(2).is_err());
    assert!(gaussian(1, (2, 4, 8)).attending(&gaussian(1, (2, 3, 8)), 2).is_err());
    assert!(gaussian(1, (2, 4, 8)).attending(&gaussian(1, (1, 3, 16)), 2).is_err());
    assert!(gaussian(1, (2, 4, 8)).attending(&gaussian(1, (2, 3, 16)), 3).is_err());
    assert!(gaussian(1, (2, 4, 8)).times(&gaussian(1, (2, 4, 7))).is_err());
    assert!(Tensor::beside(&[&gaussian(1, (2, 4, 8)), &gaussian(1, (2, 3, 8))]).is_err());
    assert!(gaussian(1, (2, 4, 8)).plus_at_each_step(&gaussian(1, (2, 1, 7))).is_err());
    assert!(gaussian(1, (2, 4, 8)).channels(6, 3).is_err());
    assert!(gaussian(1, (2, 4, 8)).step(4).is_err());
    assert!(gaussian(1, (2, 4, 8)).plus(&gaussian(1, (2, 4, 7))).is_err());
    assert!(Gru::new(8, 5, &p.scope("gru")).unwrap().forward(&gaussian(1, (2, 4, 8)), Some(&gaussian(1, (2, 1, 4)))).is_err());
    assert!(gaussian(1, (2, 4, 8)).modulated(&gaussian(1, (2, 4, 8))).is_err());
}

/// `tests/golden/make_nn.py` tells how PyTorch made these numbers, in float64.
#[test]
fn layers_against_pytorch() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/nn.safetensors");
    let golden = candle_core::safetensors::load(path, &candle_core::Device::Cpu).unwrap();
    let conv = |c_out, kernel, stride, padding| ConvShape { c_in: 6, c_out, kernel, stride, padding };
    let activation = |kind| -> Function { Box::new(move |x, _| x.unsqueeze(1)?.activated(kind)?.squeeze(1)) };
    let cases: Vec<(&str, Function)> = vec![
        ("linear", Box::new(|x, p| Linear::new(7, 35, p)?.forward(x))),
        ("conv", Box::new(move |x, p| Conv1d::new(conv(20, 5, 1, 2), p)?.forward(x))),
        ("conv_stride", Box::new(move |x, p| Conv1d::new(conv(10, 3, 2, 1), p)?.forward(x))),
        ("conv_transpose", Box::new(move |x, p| ConvTranspose1d::new(conv(10, 4, 2, 1), p)?.forward(x))),
        ("group_norm_mish", Box::new(|x, p| GroupNormMish::new(4, 20, p)?.forward(x.clone()))),
        ("layer_norm", Box::new(|x, p| LayerNorm::new(21, true, 1e-5, p)?.forward(x))),
        ("layer_norm_plain", Box::new(|x, p| LayerNorm::new(21, false, 1e-6, p)?.forward(x))),
        ("attention", Box::new(|x, _| x.attention(2))),
        ("mish", activation(Mish)),
        ("silu", activation(Silu)),
        ("gelu_tanh", activation(GeluTanh)),
        ("relu", activation(Relu)),
    ];
    for (name, layer) in cases {
        compare(&golden, name, &["x"], &|inputs, p| layer(&inputs[0], p));
    }
    compare(&golden, "gru", &["x", "h0"], &|inputs, p| Gru::new(6, 9, p)?.forward(&inputs[0], Some(&inputs[1].unsqueeze(1)?)));
    let sinusoid = time_embedding::Sinusoid::new(32, 100).unwrap();
    let mut rows = vec![0.0; golden["sinusoid.y"].elem_count()];
    flat(&golden["sinusoid.x"]).iter().zip(rows.chunks_exact_mut(32)).for_each(|(level, row)| sinusoid.write(*level, row));
    assert!(distance(&rows, &flat(&golden["sinusoid.y"])) < 1e-6);
}

/// Result and every gradient of one golden case, within a few roundings.
fn compare(
    golden: &std::collections::HashMap<String, Tensor>,
    name: &str,
    inputs: &[&str],
    layer: &dyn Fn(&[Tensor], &Params) -> Result<Tensor>,
) {
    let prefix = format!("{name}.p.");
    let parameters: BTreeMap<String, Tensor> =
        golden.iter().filter_map(|(key, value)| Some((key.strip_prefix(&prefix)?.to_owned(), value.clone()))).collect();
    let vars = |named: Vec<(String, Tensor)>| -> Vec<(String, candle_core::Var)> {
        named.into_iter().map(|(key, value)| (key, candle_core::Var::from_tensor(&value).unwrap())).collect()
    };
    let inputs = vars(inputs.iter().map(|key| ((*key).to_owned(), golden[&format!("{name}.{key}")].clone())).collect());
    let parameters = vars(parameters.into_iter().collect());
    let store = parameters.iter().map(|(key, var)| (key.clone(), var.as_tensor().clone())).collect();
    let tensors: Vec<Tensor> = inputs.iter().map(|(_, var)| var.as_tensor().clone()).collect();
    let y = layer(&tensors, &Params::given(store)).unwrap();
    assert!(distance(&flat(&y), &flat(&golden[&format!("{name}.y")])) < 2e-6, "{name}: result");
    let grads = (&y * &golden[&format!("{name}.r")]).unwrap().sum_all().unwrap().backward().unwrap();
    let named = inputs.iter().map(|(key, var)| (format!("{name}.d{key}"), var));
    for (key, var) in named.chain(parameters.iter().map(|(key, var)| (format!("{name}.dp.{key}"), var))) {
        let error = distance(&flat(grads.get(var).expect("a gradient")), &flat(&golden[&key]));
        assert!(error < 4e-6, "{key}: {error}");
    }
}
