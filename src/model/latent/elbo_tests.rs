//! The ELBO against a computation by hand and central differences.

use super::*;
use crate::model::{
    method::{Future, GruLatent, Looks},
    nn::params::Params,
    noise::Philox,
    trajectory::{Layout, Token},
};
use candle_core::Device;

const BATCH: usize = 3;
const LEN: usize = 5;
const DIM: usize = 2;

fn layout() -> Layout {
    Layout { state_dim: 3, action_dim: 2 }
}

fn options() -> ElboOptions {
    ElboOptions { kl_weight: 0.3, state_change_std: vec![0.5, 1.0, 2.0], reward_weight: 0.7 }
}

/// The second row begins before its episode: two absent tokens.
fn batch() -> ElboBatch {
    // Numbers that lie away from the kinks of the ReLUs, where a central difference means nothing.
    let mut stream = Philox::new(21);
    let mut draw = |n: usize| (0..n).map(|_| stream.normal()).collect::<Vec<f32>>();
    let absent = |row: usize, t: usize| row == 1 && t < 2;
    let rows: Vec<Vec<Token>> = (0..BATCH)
        .map(|row| {
            let token = |t| match absent(row, t) {
                true => Token::default(),
                false => Token { state: Some(draw(3)), action: Some(draw(2)), reward: Some(draw(1)[0]), noise: 0.0 },
            };
            (0..LEN).map(token).collect()
        })
        .collect();
    let valid = (0..BATCH).flat_map(|row| (0..LEN - 1).map(move |t| f32::from(!absent(row, t)))).collect::<Vec<_>>();
    let present = (0..BATCH * (LEN - 1)).flat_map(|i| [1.0, f32::from(i % 2 == 0), f32::from(i % 4 == 0)]).collect::<Vec<_>>();
    // The last row hides its rewards, and every other state.
    let shown = (0..BATCH * LEN).flat_map(|i| if i / LEN == 2 { [f32::from(i % 2 == 0), 1.0, 0.0] } else { [1.0; 3] }).collect::<Vec<_>>();
    let tensor = |values: Vec<f32>, width| Tensor::from_vec(values, (BATCH, LEN - 1, width), &Device::Cpu).unwrap();
    ElboBatch {
        tokens: Tokens::pack(layout(), rows.iter(), LEN, |row, position| row[position].view()).unwrap(),
        valid: tensor(valid, 1).squeeze(2).unwrap(),
        history_shown: Tensor::from_vec(shown, (BATCH, LEN, 3), &Device::Cpu).unwrap(),
        successor_shown: tensor(present, 3),
        eps: tensor(draw(BATCH * (LEN - 1) * DIM), DIM),
    }
}

fn model_of(future: Future, params: &Params) -> LatentModel {
    LatentModel::new(&GruLatent { dim: DIM, hidden: 7, looks: Looks::Block(4), future }, layout(), params).unwrap()
}

fn model(params: &Params) -> LatentModel {
    model_of(Future::Prior, params)
}

fn loss(model: &LatentModel) -> f64 {
    f64::from(model.elbo(&batch(), &options()).unwrap().loss.to_scalar::<f32>().unwrap())
}

/// Gradient of every parameter along a random direction.
#[test]
fn gradient_is_the_central_difference() {
    [Future::Prior, Future::Held].into_iter().for_each(check_gradient);
}

fn check_gradient(future: Future) {
    let params = Params::fresh(2);
    let model = model_of(future, &params);
    let grads = model.elbo(&batch(), &options()).unwrap().loss.backward().unwrap();
    for (name, var) in params.vars() {
        let mut stream = Philox::named(9, &name);
        let direction: Vec<f32> = (0..var.elem_count()).map(|_| stream.normal()).collect();
        let direction = Tensor::from_vec(direction, var.shape().clone(), &Device::Cpu).unwrap();
        let start = var.as_tensor().copy().unwrap();
        let at = |step: f64| {
            var.set(&(&start + direction.affine(step, 0.0).unwrap()).unwrap()).unwrap();
            loss(&model)
        };
        let slopes = [3e-3, 1e-3, 3e-4, 1e-4].map(|step| (at(step) - at(-step)) / (2.0 * step));
        var.set(&start).unwrap();
        let analytic = grads.get(&var).map_or(0.0, |grad| (grad * &direction).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap());
        // The best of four steps: a large one may cross kinks of the ReLUs, a small one drowns in rounding.
        let error = slopes.map(|slope| (slope - f64::from(analytic)).abs()).into_iter().fold(f64::INFINITY, f64::min);
        assert!(error < 5e-4 + 0.02 * f64::from(analytic.abs()), "{name}: {analytic} against {slopes:?}");
    }
}

/// What an absent token holds does not matter, nor what a successor's masked parts hold.
#[test]
fn absent_values_are_not_seen() {
    let model = model(&Params::fresh(2));
    let terms = |batch: &ElboBatch| model.elbo(batch, &options()).unwrap().kl.to_scalar::<f32>().unwrap();
    let clean = batch();
    let mut dirty = batch();
    let noise = Tensor::ones_like(&dirty.tokens.action).unwrap();
    let absent = dirty.tokens.present.narrow(2, 1, 1).unwrap().affine(-1.0, 1.0).unwrap();
    dirty.tokens.action = (&dirty.tokens.action + noise.broadcast_mul(&absent).unwrap()).unwrap();
    assert_eq!(terms(&clean), terms(&dirty));
}

/// The posterior of c_t with a successor of which only the state is seen is what the sampler's filter infers.
#[test]
fn posteriors_agree_with_infer() {
    let model = model(&Params::fresh(2));
    let batch = batch();
    let state_only = Tensor::new(&[1f32, 0.0, 0.0], &Device::Cpu).unwrap().broadcast_as((BATCH, LEN - 1, 3)).unwrap().contiguous().unwrap();
    let posteriors = model.posteriors(&batch.tokens, &batch.history_shown, &state_only).unwrap();
    let mut block = batch.tokens.clone();
    let last = (block.present.narrow(1, LEN - 1, 1).unwrap() * state_only.narrow(1, 0, 1).unwrap()).unwrap();
    let history = (block.present.narrow(1, 0, LEN - 1).unwrap() * batch.history_shown.narrow(1, 0, LEN - 1).unwrap()).unwrap();
    block.present = Tensor::cat(&[history, last], 1).unwrap();
    let filter = model.infer(&block, None).unwrap();
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(flat(&posteriors.mean.narrow(1, LEN - 2, 1).unwrap()), flat(&filter.mean));
}

/// A hidden field of the history does not move the posterior, and is still what the decoder has to explain.
#[test]
fn hidden_fields_are_explained_but_not_seen() {
    let model = model(&Params::fresh(2));
    let (clean, mut dirty) = (batch(), batch());
    let row = Tensor::from_vec(vec![0f32, 0.0, 5.0], (BATCH, 1, 1), &Device::Cpu).unwrap();
    dirty.tokens.reward = dirty.tokens.reward.broadcast_add(&row).unwrap();
    // The successor's reward is another door: it stays shut here.
    let shut = Tensor::new(&[1f32, 1.0, 0.0], &Device::Cpu).unwrap();
    let terms = |mut batch: ElboBatch| {
        batch.successor_shown = batch.successor_shown.broadcast_mul(&shut).unwrap();
        let terms = model.elbo(&batch, &options()).unwrap();
        [terms.kl, terms.state_error, terms.reward_error].map(|term| term.to_scalar::<f32>().unwrap())
    };
    let (clean, dirty) = (terms(clean), terms(dirty));
    assert_eq!(clean[..2], dirty[..2]);
    assert!((clean[2] - dirty[2]).abs() > 0.1, "{clean:?} {dirty:?}");
}

/// A held belief of step t knows nothing of what the step does: its action, its reward and its successor are for the decoder alone. Changed in
/// the last step that is explained, they leave the KL as it is.
#[test]
fn a_held_belief_does_not_see_what_it_explains() {
    let model = model_of(Future::Held, &Params::fresh(2));
    let terms = |batch: &ElboBatch| {
        let terms = model.elbo(batch, &options()).unwrap();
        [terms.kl, terms.state_error].map(|term| term.to_scalar::<f32>().unwrap())
    };
    let (clean, mut moved) = (batch(), batch());
    let last = |tensor: &Tensor, steps: usize| {
        let count = tensor.dims3().unwrap().2;
        let mask = (0..BATCH * LEN * count).map(|i| f32::from(i / count % LEN >= LEN - steps)).collect();
        (tensor + Tensor::from_vec(mask, tensor.shape(), &Device::Cpu).unwrap()).unwrap()
    };
    moved.tokens.action = last(&moved.tokens.action, 2);
    moved.tokens.reward = last(&moved.tokens.reward, 2);
    moved.tokens.state = last(&moved.tokens.state, 1);
    let (clean, moved) = (terms(&clean), terms(&moved));
    assert!(clean[0] == moved[0] && (clean[1] - moved[1]).abs() > 0.01, "{clean:?} {moved:?}");
}
