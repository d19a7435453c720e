//! Whole networks against PyTorch's numbers; `tests/golden/make_networks.py` and `make_baseline.py` tell how they were made,
//! in float64.

use crate::model::nn::{Activations, Buffer, Params};
use candle_core::{DType, Device, Result, Tensor, Var};
use std::{collections::BTreeMap, path::Path};

/// Where cases are, in `tests/golden`.
const FILES: [&str; 2] = ["networks.safetensors", "baseline.safetensors"];
/// Largest error of a result, in units of its largest value, or of 0.1.
const RESULT_ERROR: f32 = 1e-5;
/// The same of a gradient; of a bias in units of the largest gradient of its layer: before a norm its own is zero but for the rounding of
/// what cancels.
const GRADIENT_ERROR: f32 = 5e-5;

/// The numbers of one case, by their names within it: `in.*`, `y.*`, `r.*`, `p.*`, `d.*`, `dp.*`.
pub struct Golden {
    case: &'static str,
    numbers: BTreeMap<String, Tensor>,
}

impl Golden {
    /// Those of a case, in whichever of the files it is.
    pub fn of(case: &'static str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
        let all = FILES.into_iter().flat_map(|file| candle_core::safetensors::load(folder.join(file), &Device::Cpu).unwrap());
        let ours = |(name, number): (String, Tensor)| {
            Some((name.strip_prefix(case)?.strip_prefix('.')?.to_owned(), number.to_dtype(DType::F32).unwrap()))
        };
        let numbers: BTreeMap<_, _> = all.filter_map(ours).collect();
        assert!(!numbers.is_empty(), "no case {case}");
        Self { case, numbers }
    }

    /// All values of one of them.
    pub fn flat(&self, name: &str) -> Vec<f32> {
        flat(&self.numbers[name])
    }

    /// One of them as an input of three dimensions.
    pub fn value<V: Activations>(&self, name: &str) -> V {
        let number = &self.numbers[name];
        let (batch, steps, channels) = number.dims3().unwrap();
        V::generate([batch, steps, channels], |out| out.copy_from_slice(&flat(number))).unwrap()
    }

    /// Names below `kind`, in order.
    fn names(&self, kind: &str) -> Vec<String> {
        self.numbers.keys().filter_map(|name| name.strip_prefix(kind)?.strip_prefix('.').map(str::to_owned)).collect()
    }

    /// A network of training gives these results and these gradients; `run` makes the results by name, of inputs by name.
    pub fn check_training(&self, run: impl Fn(&BTreeMap<String, Tensor>, &Params) -> Result<Vec<(String, Tensor)>>) {
        // Inputs without a gradient in the golden file are no variables: masks get none.
        let variable = |name: String| (name.clone(), Var::from_tensor(&self.numbers[&format!("in.{name}")]).unwrap());
        let inputs: BTreeMap<String, Var> = self.names("d").into_iter().map(variable).collect();
        let tensor = |name: String| match inputs.get(&name) {
            Some(var) => (name, var.as_tensor().clone()),
            None => (name.clone(), self.numbers[&format!("in.{name}")].clone()),
        };
        let tensors = self.names("in").into_iter().map(tensor).collect();
        let params = Params::fresh(1);
        run(&tensors, &params).unwrap();
        let vars = params.vars();
        assert_eq!(vars.keys().cloned().collect::<Vec<_>>(), self.names("p"), "{}: parameters", self.case);
        vars.iter().for_each(|(name, var)| var.set(&self.numbers[&format!("p.{name}")]).unwrap());
        let mut loss = Tensor::new(0f32, &Device::Cpu).unwrap();
        for (name, y) in self.checked(run(&tensors, &params).unwrap(), flat) {
            loss = (loss + (y * &self.numbers[&format!("r.{name}")]).unwrap().sum_all().unwrap()).unwrap();
        }
        let grads = loss.backward().unwrap();
        let inputs = self.names("d").into_iter().map(|name| (format!("d.{name}"), &inputs[&name]));
        for (name, var) in inputs.chain(vars.iter().map(|(name, var)| (format!("dp.{name}"), var))) {
            // What no result depends on gets none, and is a zero in the golden file.
            let grad = grads.get(var).map_or_else(|| vec![0.0; var.elem_count()], flat);
            self.expect(&name, &grad, GRADIENT_ERROR);
        }
    }

    /// A network that serves gives these results.
    pub fn check_serving(&self, run: impl Fn(&Params) -> Result<Vec<(String, Buffer)>>) {
        let params = self.constants();
        self.checked(run(&params).unwrap(), |y| y.to_vec());
        assert_eq!(params.unused(), Vec::<String>::new(), "{}: parameters", self.case);
    }

    /// A network that guides gives these gradients to its inputs; `run` makes them by name.
    pub fn check_guiding(&self, run: impl Fn(&Params) -> Result<Vec<(String, Buffer)>>) {
        let grads = run(&self.constants().with_way_back()).unwrap();
        assert_eq!(grads.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>(), self.names("d"), "{}: gradients", self.case);
        grads.iter().for_each(|(name, grad)| self.expect(&format!("d.{name}"), grad, GRADIENT_ERROR));
    }

    /// All parameters, as a server has them.
    fn constants(&self) -> Params {
        let named = self.names("p").into_iter().map(|name| (name.clone(), self.numbers[&format!("p.{name}")].clone()));
        Params::loaded(named.collect())
    }

    /// All results, each as it should be.
    fn checked<V>(&self, results: Vec<(String, V)>, numbers: impl Fn(&V) -> Vec<f32>) -> Vec<(String, V)> {
        let mut names: Vec<_> = results.iter().map(|(name, _)| name.clone()).collect();
        names.sort();
        assert_eq!(names, self.names("y"), "{}: results", self.case);
        results.iter().for_each(|(name, y)| self.expect(&format!("y.{name}"), &numbers(y), RESULT_ERROR));
        results
    }

    fn expect(&self, name: &str, found: &[f32], error_max: f32) {
        let expected = self.flat(name);
        assert_eq!(found.len(), expected.len(), "{}: {name}", self.case);
        let weight = name.strip_suffix(".bias").and_then(|layer| self.numbers.get(&format!("{layer}.weight"))).map(flat);
        let scale = expected.iter().chain(weight.iter().flatten()).fold(0.1_f32, |top, x| top.max(x.abs()));
        let errors = found.iter().zip(&expected).map(|(a, b)| if (a - b).is_nan() { f32::INFINITY } else { (a - b).abs() });
        let error = errors.fold(0.0, f32::max) / scale;
        assert!(error <= error_max, "{}: {name} is {error:e} of its largest value off", self.case);
    }
}

fn flat(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}
