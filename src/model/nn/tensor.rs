//! Values of training: candle's tensors. Every operation goes through one shell, which candle calls on the way forth and on the way back.

use super::{
    activations::Activations,
    host::{output, slice, values},
    layer::Layer,
    op::{Form, Op, Past, Slot, View},
    weights::{Constants, Weights, WeightsRef},
};
use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Device, Layout, Result, Shape, Tensor, bail};
use std::{ops::Deref, sync::Arc};

impl Activations for Tensor {
    fn generate(shape: [usize; 3], write: impl FnOnce(&mut [f32])) -> Result<Self> {
        let mut values = vec![0.0; shape.iter().product()];
        write(&mut values);
        Tensor::from_vec(values, shape.as_slice(), &Device::Cpu)
    }

    fn shape(&self) -> Result<[usize; 3]> {
        dims(Tensor::shape(self))
    }

    fn detached(self) -> Self {
        self.detach()
    }

    fn run(&self, layer: &Layer, others: &[&Self]) -> Result<Self> {
        let mut args = std::iter::once(&self).chain(others).map(|arg| arg.contiguous()).collect::<Result<Vec<_>>>()?;
        let mut shell = Shell { op: layer.op, inputs: args.len(), weight_len: 0, constants: None };
        match &layer.weights {
            Weights::None => {}
            Weights::Constant(constants) => shell.constants = Some(constants.clone()),
            Weights::Variable { weight, bias } => {
                shell.weight_len = weight.elem_count();
                args.push(weight.clone());
                args.extend(bias.clone());
            }
        }
        if args.len() > 3 {
            // candle's operations take three tensors, so weight and bias go as one, in a line.
            let line = args.drain(shell.inputs..).map(|parameter| parameter.flatten_all()).collect::<Result<Vec<_>>>()?;
            args.push(Tensor::cat(&line, 0)?);
        }
        match &args[..] {
            [x] => x.apply_op1(shell),
            [x, y] => x.apply_op2(y, shell),
            [x, y, z] => x.apply_op3(y, z, shell),
            _ => bail!("candle's operations take three tensors, {:?} got {}", layer.op, args.len()),
        }
    }

    /// Two at a time, so that any number of them fits candle's operations.
    fn beside(parts: &[&Self]) -> Result<Self> {
        let [first, others @ ..] = parts else { bail!("nothing to put side by side") };
        others.iter().try_fold((*first).clone(), |joined, next| joined.run(&Layer::plain(Op::Beside), &[next]))
    }
}

fn dims(shape: &Shape) -> Result<[usize; 3]> {
    shape.dims3().map(|(batch, steps, channels)| [batch, steps, channels])
}

/// An operation on so many inputs, then its parameters: weight and bias, or both in one line, or none where they are constants.
struct Shell {
    op: Op,
    inputs: usize,
    /// Where the bias begins in a line.
    weight_len: usize,
    constants: Option<Arc<Constants>>,
}

impl Shell {
    fn weights<'a>(&'a self, parameters: &[&'a [f32]]) -> WeightsRef<'a> {
        let (weight, bias) = match (parameters, &self.constants) {
            ([], None) => return WeightsRef::NONE,
            ([], Some(constants)) => return constants.view(),
            ([line], _) => line.split_at(self.weight_len),
            ([weight, bias, ..], _) => (*weight, *bias),
        };
        WeightsRef::variable(weight, bias)
    }

    fn views<'a>(&self, args: &[&'a [f32]], shapes: impl Iterator<Item = &'a Shape>) -> Result<Vec<View<'a>>> {
        args.iter().zip(shapes).take(self.inputs).map(|(values, shape)| Ok(View { values, shape: dims(shape)? })).collect()
    }

    fn forth(&self, args: &[(&CpuStorage, &Layout)]) -> Result<(CpuStorage, Shape)> {
        let slices = args.iter().map(|(storage, layout)| slice(storage, layout)).collect::<Result<Vec<_>>>()?;
        let inputs = self.views(&slices, args.iter().map(|(_, layout)| layout.shape()))?;
        let shape = self.op.shape(&inputs)?;
        let mut out = match self.op.form() {
            Form::Anew => vec![0.0; shape.iter().product()],
            Form::InPlace | Form::Sum(_) => slices[0].to_vec(),
        };
        self.op.forward(&inputs, self.weights(&slices[self.inputs..]), &mut out)?;
        output(out, shape.as_slice())
    }

    /// A gradient for each argument that leads to a variable.
    fn back(&self, args: &[&Tensor], result: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let grad = grad.contiguous()?;
        let passed = match self.op.form() {
            Form::Sum(count) => count,
            Form::Anew | Form::InPlace => 0,
        };
        let mut grads = Vec::with_capacity(args.len());
        for (i, arg) in args.iter().enumerate() {
            grads.push(match self.op.form() {
                _ if i < passed || !arg.track_op() => None,
                Form::InPlace if i == 0 => Some(values(&grad)?.to_vec()),
                Form::Anew | Form::InPlace | Form::Sum(_) => Some(vec![0.0; arg.elem_count()]),
            });
        }
        self.fill(args, result, &grad, &mut grads)?;
        let tensor = |(i, (values, arg)): (usize, (Option<Vec<f32>>, &&Tensor))| match values {
            Some(values) => Tensor::from_vec(values, Tensor::shape(arg), &Device::Cpu).map(Some),
            None => Ok((i < passed && arg.track_op()).then(|| grad.clone())),
        };
        grads.into_iter().zip(args).enumerate().map(tensor).collect()
    }

    fn fill(&self, args: &[&Tensor], result: &Tensor, grad: &Tensor, grads: &mut [Option<Vec<f32>>]) -> Result<()> {
        let held = args.iter().map(|arg| values(arg)).collect::<Result<Vec<_>>>()?;
        let slices: Vec<&[f32]> = held.iter().map(Deref::deref).collect();
        let inputs = self.views(&slices, args.iter().map(|arg| Tensor::shape(arg)))?;
        let (result, grad) = (values(result)?, values(grad)?);
        let past = Past { inputs: &inputs, weights: self.weights(&slices[self.inputs..]), result: &result, grad: &grad };
        let (of_inputs, of_parameters) = grads.split_at_mut(self.inputs);
        let mut to: Vec<Slot> = of_inputs.iter_mut().map(|grad| grad.as_deref_mut()).collect();
        match of_parameters {
            [] => to.extend([None, None]),
            [line] => {
                let parts = line.as_deref_mut().map(|line| line.split_at_mut(self.weight_len)).unzip();
                to.extend([parts.0, parts.1]);
            }
            [weight, bias, ..] => to.extend([weight.as_deref_mut(), bias.as_deref_mut()]),
        }
        self.op.backward(&past, &mut to)
    }
}

/// Gradients of an operation on `N` tensors.
fn each<const N: usize>(grads: Vec<Option<Tensor>>) -> Result<[Option<Tensor>; N]> {
    grads.try_into().map_err(|_| candle_core::Error::Msg("a gradient for each argument: is a bug".into()))
}

impl CustomOp1 for Shell {
    fn name(&self) -> &'static str {
        "op"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forth(&[(s, l)])
    }

    fn bwd(&self, x: &Tensor, result: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        each(self.back(&[x], result, grad)?).map(|[dx]| dx)
    }
}

impl CustomOp2 for Shell {
    fn name(&self) -> &'static str {
        "op"
    }

    fn cpu_fwd(&self, s1: &CpuStorage, l1: &Layout, s2: &CpuStorage, l2: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forth(&[(s1, l1), (s2, l2)])
    }

    fn bwd(&self, x: &Tensor, y: &Tensor, result: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        each(self.back(&[x, y], result, grad)?).map(|[dx, dy]| (dx, dy))
    }
}

impl CustomOp3 for Shell {
    fn name(&self) -> &'static str {
        "op"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forth(&[(s1, l1), (s2, l2), (s3, l3)])
    }

    fn bwd(
        &self,
        x: &Tensor,
        y: &Tensor,
        z: &Tensor,
        result: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        each(self.back(&[x, y, z], result, grad)?).map(|[dx, dy, dz]| (dx, dy, dz))
    }
}
