//! The autoencoder of skills against PyTorch, and the decoder that serves against the one that is trained.

use super::*;
use crate::model::{
    config::ModelConfig,
    golden::Golden,
    method::{Backbone, Diffused, Schedule},
    nn::testing::gaussian,
};

const LAYOUT: Layout = Layout { state_dim: 3, action_dim: 2 };

fn method(dim: usize, width: usize, layers: usize, action: Decoding) -> Method {
    let mut method = ModelConfig::plain(LAYOUT, None, Backbone::Mlp { width: 4, depth: 1, dropout: 0.0 }).method;
    (method.plan.diffused, method.plan.horizon) = (Diffused::Code { dim, steps: 5 }, 1);
    (method.plan.schedule, method.head) = (Schedule::Uniform { steps: 4 }, Head::Skill { width, layers, action });
    method
}

fn build(method: &Method, params: &Params) -> Result<Skills> {
    Skills::new(LAYOUT, method, params).map(Option::unwrap)
}

/// Errors and all gradients, of either decoder, with one layer and with two.
#[test]
fn skills_against_pytorch() {
    for (case, method) in [("skill", method(3, 6, 2, Decoding::Autoregressive)), ("skill_normal", method(2, 5, 1, Decoding::Normal))] {
        Golden::of(case).check_training(|given, params| {
            let segments = Segments { steps: given["x"].clone(), eps: given["eps"].clone() };
            let SkillTerms { loss, nll, kl } = build(&method, params)?.errors(&segments, 0.3)?;
            Ok([("loss", loss), ("nll", nll), ("kl", kl)].map(|(name, value)| (name.to_owned(), value)).into())
        });
    }
}

/// An action that is served is the mean that training knows, given the columns before it as they were served.
#[test]
fn what_is_served_is_what_was_trained() {
    for action in [Decoding::Autoregressive, Decoding::Normal] {
        let (method, fresh) = (method(4, 8, 1, action), Params::fresh(2));
        let trained = build(&method, &fresh).unwrap();
        let loaded = Params::loaded(fresh.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect());
        let serves = build(&method, &loaded).unwrap();
        let (state, code) = (gaussian(1, (5, 1, 3)), gaussian(2, (5, 1, 4)));
        let flat = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let buffer = |tensor: &Tensor| {
            let (rows, steps, width) = tensor.dims3().unwrap();
            Buffer::generate([rows, steps, width], |out| out.copy_from_slice(&flat(tensor))).unwrap()
        };
        let served = serves.act(&buffer(&state), &buffer(&code)).unwrap();
        let served = Tensor::from_slice(&served, (5, 1, 2), &Device::Cpu).unwrap();
        let told = trained.told(&state, &code, |column| served.narrow(2, 0, column)?.contiguous()).unwrap();
        for (served, mean) in flat(&served).into_iter().zip(flat(&told.mean)) {
            assert!((served - mean).abs() < 1e-6, "{served} {mean}");
        }
        let alone = serves.act(&buffer(&state.narrow(0, 3, 1).unwrap()), &buffer(&code.narrow(0, 3, 1).unwrap()));
        assert_eq!(alone.unwrap().to_vec(), flat(&served)[6..8], "a row is its own");
    }
}
