//! Adam with decoupled weight decay (Loshchilov and Hutter 2019), clipping, learning-rate schedules and EMA.
//!
//! In place on plain slices: candle's own AdamW makes about ten temporaries for each parameter and has neither of the others.

use super::parallel::side_by_side;
use crate::model::nn::{
    host::values,
    kernels::{
        join,
        optimizer::{AdamStep, adam, square_sum, toward},
    },
};
use anyhow::{Context, Result};
use candle_core::{CpuStorage, InplaceOp1, Layout, Tensor, Var, backprop::GradStore};
use serde::{Deserialize, Serialize};
use std::{cell::RefCell, collections::BTreeMap};

const BETA: (f64, f64) = (0.9, 0.999);
const EPSILON: f64 = 1e-8;
/// Exponent of the EMA's warm-up (diffusion policy: decay = 1 - (1 + step)^-3/4).
const EMA_POWER: f64 = 0.75;

/// How a learning rate falls after its warm-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decay {
    /// Along half a cosine.
    Cosine,
    /// Along a line.
    Linear,
}

/// Learning rate as a function of the step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearningRate {
    /// Reached at the end of the warm-up.
    pub peak: f64,
    /// Reached at the last step.
    pub end: f64,
    /// Steps of the linear warm-up from zero.
    pub warm_up: usize,
    /// The way from peak to end.
    pub decay: Decay,
}

impl LearningRate {
    /// The rate of step `step` (from 0) of `steps`.
    pub fn at(&self, step: usize, steps: usize) -> f64 {
        if step < self.warm_up {
            return self.peak * (step + 1) as f64 / self.warm_up as f64;
        }
        let progress = (step - self.warm_up) as f64 / (steps.saturating_sub(self.warm_up + 1)).max(1) as f64;
        let share = match self.decay {
            Decay::Cosine => 0.5 * (1.0 + (std::f64::consts::PI * progress).cos()),
            Decay::Linear => 1.0 - progress,
        };
        self.end + (self.peak - self.end) * share
    }
}

/// A variable, its two moments, and its gradient of this step.
struct Slot {
    name: String,
    var: Var,
    group: usize,
    moments: [Vec<f32>; 2],
    grad: Vec<f32>,
    /// Whether the loss reached it in this step.
    reached: bool,
}

impl Slot {
    /// Sums up the gradients to the variable, in order; the sum of their squares.
    fn gather(&mut self, grads: &[GradStore]) -> Result<f64> {
        self.reached = false;
        for grad in grads.iter().filter_map(|grads| grads.get(self.var.as_tensor())) {
            let grad = grad.contiguous()?;
            let grad = values(&grad)?;
            if self.reached {
                join::add(&mut self.grad, &grad);
            } else {
                self.grad.clear();
                self.grad.extend_from_slice(&grad);
                self.reached = true;
            }
        }
        Ok(if self.reached { square_sum(&self.grad) } else { 0.0 })
    }
}

/// Adam over named variables in groups, each group with its own learning rate.
pub struct Adam {
    /// In the order of names.
    slots: Vec<Slot>,
    steps: u64,
    weight_decay: f64,
    clip_norm: f64,
}

impl Adam {
    /// Zero moments; `group` sorts names into groups, those of none are not trained. Matrices and kernels decay, vectors do not.
    pub fn new(vars: &BTreeMap<String, Var>, group: impl Fn(&str) -> Option<usize>, weight_decay: f64, clip_norm: f64) -> Self {
        let slot = |(name, var): (&String, &Var)| {
            let zeros = || vec![0.0; var.elem_count()];
            let group = group(name)?;
            Some(Slot { name: name.clone(), var: var.clone(), group, moments: [zeros(), zeros()], grad: zeros(), reached: false })
        };
        Self { slots: vars.iter().filter_map(slot).collect(), steps: 0, weight_decay, clip_norm }
    }

    /// One step on the sum of these gradients; variables that no loss reaches stay as they are. `rates` holds a learning rate for each
    /// group. Returns the norm of the gradient before clipping; when that is not finite, nothing is changed.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn step(&mut self, grads: &[GradStore], rates: &[f64]) -> Result<f64> {
        let squares = each_slot(&mut self.slots, |slot| slot.gather(grads))?;
        let norm = squares.iter().sum::<f64>().sqrt();
        if !norm.is_finite() {
            return Ok(norm);
        }
        self.steps += 1;
        let scale = if norm > self.clip_norm { (self.clip_norm / norm) as f32 } else { 1.0 };
        let (weight_decay, correction) = (self.weight_decay, [BETA.0, BETA.1].map(|beta| 1.0 - beta.powf(self.steps as f64)));
        // Biases, scales and other vectors are where they have to be, not as small as can be.
        let step = |rate: f64, weight_decay: f64| AdamStep {
            scale,
            beta: (BETA.0 as f32, BETA.1 as f32),
            complement: ((1.0 - BETA.0) as f32, (1.0 - BETA.1) as f32),
            keep: (1.0 - rate * weight_decay) as f32,
            rate: (rate / correction[0]) as f32,
            root: (1.0 / correction[1].sqrt()) as f32,
            epsilon: EPSILON as f32,
        };
        each_slot(&mut self.slots, |slot| {
            let Slot { var, moments, grad, reached: true, group, .. } = slot else { return Ok(()) };
            let step = step(rates[*group], if var.rank() > 1 { weight_decay } else { 0.0 });
            Ok(var.as_tensor().inplace_op1(&Step { step, grad, moments: RefCell::new(moments) })?)
        })?;
        Ok(norm)
    }

    /// Number of steps and moments, for the training state: `m.NAME` and `v.NAME`.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn save(&self, tensors: &mut BTreeMap<String, Tensor>) -> Result<u64> {
        for slot in &self.slots {
            for (prefix, values) in ["m", "v"].iter().zip(&slot.moments) {
                tensors.insert(format!("{prefix}.{}", slot.name), Tensor::from_slice(values, slot.var.shape(), slot.var.device())?);
            }
        }
        Ok(self.steps)
    }

    /// The opposite of [`Self::save`].
    ///
    /// # Errors
    /// If a moment is missing.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, steps: u64) -> Result<()> {
        for slot in &mut self.slots {
            let moment = |prefix: &str| -> Result<Vec<f32>> {
                let name = format!("{prefix}.{}", slot.name);
                let tensor = tensors.get(&name).with_context(|| format!("the training state lacks {name}"))?;
                Ok(tensor.flatten_all()?.to_vec1()?)
            };
            slot.moments = [moment("m")?, moment("v")?];
        }
        self.steps = steps;
        Ok(())
    }
}

/// What `work` gives for each slot, in order; halves of the parameters side by side, for what is done here waits for the memory.
fn each_slot<R: Send>(slots: &mut [Slot], work: impl Fn(&mut Slot) -> Result<R> + Sync) -> Result<Vec<R>> {
    let total: usize = slots.iter().map(|slot| slot.grad.len()).sum();
    let mut sum = 0;
    let half = slots.iter().take_while(|slot| {
        sum += slot.grad.len();
        sum <= total / 2
    });
    let half = half.count();
    let (low, high) = slots.split_at_mut(half);
    let work = &work;
    let jobs = [low, high].into_iter().map(|slots| move || slots.iter_mut().map(work).collect::<Result<Vec<R>>>()).collect();
    let results: Result<Vec<Vec<R>>> = side_by_side(jobs).into_iter().collect();
    Ok(results?.into_iter().flatten().collect())
}

/// Adam on one variable, as an operation on its storage.
struct Step<'a> {
    step: AdamStep,
    grad: &'a [f32],
    moments: RefCell<&'a mut [Vec<f32>; 2]>,
}

impl InplaceOp1 for Step<'_> {
    fn name(&self) -> &'static str {
        "adam"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> candle_core::Result<()> {
        let (CpuStorage::F32(values), Some((from, to))) = (storage, layout.contiguous_offsets()) else {
            candle_core::bail!("a variable is a contiguous f32 tensor: is a bug");
        };
        let [first, second] = &mut **self.moments.borrow_mut();
        adam(self.step, &mut values[from..to], self.grad, first, second);
        Ok(())
    }
}

/// Exponential moving average of all variables; what is shipped.
pub struct Ema {
    values: BTreeMap<String, Vec<f32>>,
    decay_max: f64,
}

impl Ema {
    /// Starts at the variables as they are.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn new(vars: &BTreeMap<String, Var>, decay_max: f64) -> Result<Self> {
        let copy = |(name, var): (&String, &Var)| Ok((name.clone(), var.flatten_all()?.to_vec1()?));
        Ok(Self { values: vars.iter().map(copy).collect::<Result<_>>()?, decay_max })
    }

    /// Decay after `step` steps (from 0): `min(decay_max, 1 - (1 + step)^-3/4)`.
    pub fn decay(&self, step: usize) -> f64 {
        self.decay_max.min(1.0 - (1.0 + step as f64).powf(-EMA_POWER))
    }

    /// Moves the average towards the variables.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn update(&mut self, vars: &BTreeMap<String, Var>, step: usize) -> Result<()> {
        let share = (1.0 - self.decay(step)) as f32;
        for (name, average) in &mut self.values {
            toward(average, &values(vars[name].as_tensor())?, share);
        }
        Ok(())
    }

    /// The average as tensors, by name.
    ///
    /// # Errors
    /// If a tensor operation fails.
    pub fn tensors(&self, vars: &BTreeMap<String, Var>) -> Result<BTreeMap<String, Tensor>> {
        self.tensors_of("", vars)
    }

    /// Of the variables whose names begin so.
    ///
    /// # Errors
    /// As of [`Self::tensors`].
    pub fn tensors_of(&self, prefix: &str, vars: &BTreeMap<String, Var>) -> Result<BTreeMap<String, Tensor>> {
        let tensor = |(name, values): (&String, &Vec<f32>)| {
            let var = &vars[name];
            Ok((name.clone(), Tensor::from_slice(values, var.shape(), var.device())?))
        };
        self.values.iter().filter(|(name, _)| name.starts_with(prefix)).map(tensor).collect()
    }

    /// Takes the average from the training state: `ema.NAME`.
    ///
    /// # Errors
    /// If one is missing.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
        for (name, average) in &mut self.values {
            let name = format!("ema.{name}");
            *average = tensors.get(&name).with_context(|| format!("the training state lacks {name}"))?.flatten_all()?.to_vec1()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    fn var(values: &[f32]) -> Var {
        Var::from_slice(values, values.len(), &Device::Cpu).unwrap()
    }

    fn quadratic(var: &Var, factor: f64) -> GradStore {
        var.as_tensor().sqr().unwrap().sum_all().unwrap().affine(factor, 0.0).unwrap().backward().unwrap()
    }

    /// Two steps of `torch.optim.AdamW(lr=.1, weight_decay=.5)` written out in f64: a matrix decays, a vector does not.
    #[test]
    fn adamw_by_hand() {
        for decay in [0.5, 0.0] {
            let shape = if decay > 0.0 { vec![1, 2] } else { vec![2] };
            adamw_against(Var::from_slice(&[1.0_f32, -2.0], shape, &Device::Cpu).unwrap(), decay);
        }
    }

    fn adamw_against(var: Var, decay: f64) {
        let vars = BTreeMap::from([("w".to_string(), var.clone())]);
        let mut adam = Adam::new(&vars, |_| Some(0), 0.5, f64::INFINITY);
        let mut expected = [1.0_f64, -2.0];
        let mut moments = [[0.0_f64; 2]; 2];
        for step in 1..=2 {
            adam.step(&[quadratic(&var, 0.125), quadratic(&var, 0.125)], &[0.1]).unwrap();
            for i in 0..2 {
                let grad = 0.5 * expected[i];
                moments[0][i] = 0.9 * moments[0][i] + 0.1 * grad;
                moments[1][i] = 0.999 * moments[1][i] + 0.001 * grad * grad;
                let (m, v) = (moments[0][i] / (1.0 - 0.9_f64.powi(step)), moments[1][i] / (1.0 - 0.999_f64.powi(step)));
                expected[i] = expected[i] * (1.0 - 0.1 * decay) - 0.1 * m / (v.sqrt() + 1e-8);
            }
        }
        let got: Vec<f32> = var.flatten_all().unwrap().to_vec1().unwrap();
        for (got, expected) in got.iter().zip(expected) {
            assert!((f64::from(*got) - expected).abs() < 1e-6, "{got} {expected}");
        }
    }

    #[test]
    fn clips_by_the_global_norm_and_ignores_what_is_not_finite() {
        let (a, b) = (var(&[3.0]), var(&[4.0]));
        let vars = BTreeMap::from([("a".to_string(), a.clone()), ("b".to_string(), b.clone())]);
        let mut adam = Adam::new(&vars, |name| Some(usize::from(name == "b")), 0.0, 1.0);
        let loss = (a.sqr().unwrap() + b.sqr().unwrap()).unwrap().sum_all().unwrap().affine(0.5, 0.0).unwrap();
        let norm = adam.step(&[loss.backward().unwrap()], &[0.1, 0.0]).unwrap();
        assert!((norm - 5.0).abs() < 1e-6);
        let first = adam.slots[0].moments[0][0];
        assert!((first - 0.1 * 0.6).abs() < 1e-6, "the clipped gradient of a is .6, its first moment {first}");
        assert_eq!(b.to_vec1::<f32>().unwrap(), [4.0], "group 1 has learning rate 0");
        let before = a.to_vec1::<f32>().unwrap();
        let norm = adam.step(&[quadratic(&a, f64::NAN)], &[0.1, 0.1]).unwrap();
        assert!(norm.is_nan());
        assert_eq!(a.to_vec1::<f32>().unwrap(), before);
    }

    #[test]
    fn learning_rate_hits_its_corners() {
        let rate = LearningRate { peak: 1.0, end: 0.1, warm_up: 4, decay: Decay::Cosine };
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
        close(rate.at(0, 104), 0.25);
        close(rate.at(4, 104), 1.0);
        close(rate.at(103, 104), 0.1);
        let linear = LearningRate { decay: Decay::Linear, warm_up: 0, ..rate };
        close(linear.at(50, 101), 0.55);
    }

    #[test]
    fn ema_starts_as_a_copy_and_slows_down() {
        let weights = var(&[2.0]);
        let vars = BTreeMap::from([("w".to_string(), weights.clone())]);
        let mut ema = Ema::new(&vars, 0.5).unwrap();
        weights.set(&var(&[4.0])).unwrap();
        assert!(ema.decay(0).abs() < 1e-12 && (ema.decay(1_000_000) - 0.5).abs() < 1e-12);
        ema.update(&vars, 1_000_000).unwrap();
        assert_eq!(ema.tensors(&vars).unwrap()["w"].to_vec1::<f32>().unwrap(), [3.0]);
        ema.update(&vars, 0).unwrap();
        assert_eq!(ema.tensors(&vars).unwrap()["w"].to_vec1::<f32>().unwrap(), [4.0]);
    }
}
