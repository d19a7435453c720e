//! The ELBO against a computation by hand and central differences.

use super::*;
use crate::model::{
    method::{Actions, Baseline, Future, GruLatent, Looks},
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
    ElboOptions {
        kl_weight: 0.3,
        state_change_std: vec![0.5, 1.0, 2.0],
        state_weight: 1.0,
        reward_weight: 0.7,
        action_weight: 0.6,
        free_bits: 0.0,
        context_weight: 0.9,
        ahead: Ahead::default(),
    }
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
        tokens: Tokens::pack(layout(), rows.iter(), LEN, None, |row, position| row[position].view()).unwrap(),
        valid: tensor(valid, 1).squeeze(2).unwrap(),
        history_shown: Tensor::from_vec(shown, (BATCH, LEN, 3), &Device::Cpu).unwrap(),
        successor_shown: tensor(present, 3),
        eps: tensor(draw(BATCH * (LEN - 1) * DIM), DIM),
        context: None,
        believed: None,
    }
}

/// The beliefs of steps 1, 2 and 0 have to explain the rows.
fn batch_that_stays() -> ElboBatch {
    let chosen = [1, 2, 0].iter().flat_map(|at| (0..LEN - 1).map(move |step| f32::from(step == *at))).collect();
    ElboBatch { believed: Some(Tensor::from_vec(chosen, (BATCH, 1, LEN - 1), &Device::Cpu).unwrap()), ..batch() }
}

fn model_of(future: Future, params: &Params) -> LatentModel {
    beside(None, future, params)
}

fn beside(baseline: Option<Baseline>, future: Future, params: &Params) -> LatentModel {
    LatentModel::new(&GruLatent { future, baseline, ..GruLatent::plain(DIM, 7, Looks::Block(4)) }, layout(), params).unwrap()
}

fn model(params: &Params) -> LatentModel {
    model_of(Future::Prior, params)
}

fn staying(stays: usize, baseline: Option<Baseline>, future: Future, params: &Params) -> LatentModel {
    let latent = GruLatent { stays, future, baseline, ..GruLatent::plain(DIM, 7, Looks::Block(4)) };
    LatentModel::new(&latent, layout(), params).unwrap()
}

/// Gradient of every parameter along a random direction.
#[test]
fn gradient_is_the_central_difference() {
    [Future::Prior, Future::Held].into_iter().for_each(|future| {
        let params = Params::fresh(2);
        check_gradient(&params, &model_of(future, &params), &batch(), &options());
    });
}

/// The same where columns stay: one of two, beside one that moves, and all of them.
#[test]
fn gradient_of_what_stays() {
    for (stays, baseline, future) in
        [(1, None, Future::Prior), (1, Some(Baseline { width: 5 }), Future::Prior), (1, None, Future::Held), (DIM, None, Future::Held)]
    {
        let params = Params::fresh(2);
        check_gradient(&params, &staying(stays, baseline, future, &params), &batch_that_stays(), &options());
    }
}

/// What the latent has to explain are the surprises themselves, so a baseline gets no gradient from there; all others do.
#[test]
fn gradient_beside_a_baseline() {
    [Future::Prior, Future::Held].into_iter().for_each(|future| {
        let params = Params::fresh(2);
        check_gradient(&params, &beside(Some(Baseline { width: 5 }), future, &params), &batch(), &options());
    });
}

/// The same of steps ahead, of which a block has fewer than were asked for.
#[test]
fn gradient_of_steps_ahead() {
    let options = ElboOptions { ahead: Ahead { steps: 9, weight: 0.5 }, ..options() };
    for future in [Future::Prior, Future::Held] {
        let params = Params::fresh(2);
        check_gradient(&params, &model_of(future, &params), &batch(), &options);
    }
}

/// The same of a recorded context that is told, in the step itself and in later ones.
#[test]
fn gradient_of_a_told_context() {
    let options = ElboOptions { ahead: Ahead { steps: 2, weight: 0.5 }, ..options() };
    let latent = GruLatent { tells: 2, ..GruLatent::plain(DIM, 7, Looks::Block(4)) };
    let params = Params::fresh(2);
    let model = LatentModel::new(&latent, layout(), &params).unwrap();
    let numbers = (0..BATCH * (LEN - 1) * 2).map(|i| (i as f32).sin()).collect();
    let context = Some(Tensor::from_vec(numbers, (BATCH, LEN - 1, 2), &Device::Cpu).unwrap());
    let terms = model.elbo(&ElboBatch { context: context.clone(), ..batch() }, &options).unwrap();
    assert!(terms.context_error.unwrap().to_scalar::<f32>().unwrap() > 0.1);
    check_gradient(&params, &model, &ElboBatch { context, ..batch() }, &options);
}

fn check_gradient(params: &Params, model: &LatentModel, batch: &ElboBatch, options: &ElboOptions) {
    let loss = || f64::from(model.elbo(batch, options).unwrap().loss.to_scalar::<f32>().unwrap());
    let grads = model.elbo(batch, options).unwrap().loss.backward().unwrap();
    for (name, var) in params.vars().into_iter().filter(|(name, _)| !name.starts_with("baseline.")) {
        let start = var.as_tensor().copy().unwrap();
        let mut stream = Philox::named(9, &name);
        let mut agrees = || {
            let direction: Vec<f32> = (0..var.elem_count()).map(|_| stream.normal()).collect();
            let direction = Tensor::from_vec(direction, var.shape().clone(), &Device::Cpu).unwrap();
            let at = |step: f64| {
                var.set(&(&start + direction.affine(step, 0.0).unwrap()).unwrap()).unwrap();
                loss()
            };
            let slopes = [3e-3, 1e-3, 3e-4, 1e-4].map(|step| (at(step) - at(-step)) / (2.0 * step));
            var.set(&start).unwrap();
            let analytic = grads.get(&var).map_or(0.0, |grad| (grad * &direction).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap());
            // The best of four steps: a large one crosses kinks of the ReLUs, a small one drowns in rounding.
            let error = slopes.map(|slope| (slope - f64::from(analytic)).abs()).into_iter().fold(f64::INFINITY, f64::min);
            (error < 5e-4 + 0.04 * f64::from(analytic.abs()), analytic, slopes)
        };
        // Most directions have a step that is neither.
        let tries: Vec<_> = (0..9).map(|_| agrees()).collect();
        assert!(tries.iter().filter(|(agrees, ..)| *agrees).count() >= 5, "{name}: {tries:?}");
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

/// Without surprises (they are worth nothing, as units of infinity) nothing but the KL is left, and each weight counts its own part.
#[test]
fn each_part_has_its_weight() {
    let params = Params::fresh(2);
    let model = beside(Some(Baseline { width: 5 }), Future::Prior, &params);
    let terms = |change: &dyn Fn(&mut ElboOptions)| {
        let mut options = ElboOptions { state_weight: 0.0, reward_weight: 0.0, action_weight: 0.0, kl_weight: 0.0, ..options() };
        change(&mut options);
        let terms = model.elbo(&batch(), &options).unwrap();
        let number = |tensor: &Tensor| f64::from(tensor.to_scalar::<f32>().unwrap());
        let action = number(terms.action_error.as_ref().unwrap());
        (number(&terms.loss), [number(&terms.state_error), number(&terms.reward_error), action, number(&terms.kl)])
    };
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-5 * b.abs().max(1.0), "{a} {b}");
    let (loss, [state, reward, action, kl]) = terms(&|_| ());
    close(loss, 0.0);
    close(terms(&|options| options.state_weight = 2.0).0, 2.0 * state * 3.0 / 2.0);
    close(terms(&|options| options.reward_weight = 2.0).0, 2.0 * reward / 2.0);
    close(terms(&|options| options.action_weight = 2.0).0, 2.0 * action * 2.0 / 2.0);
    close(terms(&|options| options.kl_weight = 2.0).0, 2.0 * kl);
    close(terms(&|options| (options.kl_weight, options.free_bits) = (1.0, 1e6)).0, 1e6);
}

/// How far a token is from what was expected, written out token by token; where it cannot be told, the encoder is shown a vector of its own.
#[test]
fn surprises_by_hand() {
    let params = Params::fresh(2);
    let model = beside(Some(Baseline { width: 5 }), Future::Prior, &params);
    let whitener = Tensor::new(&[[0.5f32, 0.0, 0.0], [0.3, 2.0, 0.0], [-1.0, 0.4, 1.0]], &Device::Cpu).unwrap();
    params.vars()["baseline.surprise.state.weight"].set(&whitener).unwrap();
    let (tokens, baseline) = (batch().tokens, model.baseline.as_ref().unwrap());
    let followed = tokens.clone().following(None).unwrap();
    let surprises = baseline.surprises(&followed, true).unwrap();
    for t in 1..LEN {
        let [change, ..] = baseline.residuals(&tokens.narrow(t - 1, 2).unwrap()).unwrap();
        let expected = change.broadcast_matmul(&whitener.t().unwrap()).unwrap();
        let error = (surprises.state.narrow(1, t, 1).unwrap() - expected.clamp(-10.0, 10.0).unwrap()).unwrap();
        assert!(error.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-5);
    }
    // Row 1 begins before its episode: two absent tokens; nothing is told of them, nor of the arrival at the first real one.
    let told = followed.before.unwrap().told.get(1).unwrap().to_vec2::<f32>().unwrap();
    assert_eq!(told, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]);
    // Looked at from the middle on, with the token in front, the rest is the same.
    let rest = tokens.narrow(2, 3).unwrap().following(Some(&tokens.at(&[Some(1); BATCH]).unwrap())).unwrap();
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(
        flat(&baseline.surprises(&rest, true).unwrap().state),
        flat(&surprises.state.narrow(1, 2, 3).unwrap().contiguous().unwrap())
    );
    assert!(baseline.surprises(&tokens, true).is_err(), "nobody said what came before");
}

/// At many places of an episode that is read once, and at each after its own history: the same beliefs.
#[test]
fn places_of_one_episode() {
    let params = Params::fresh(2);
    let model = beside(Some(Baseline { width: 5 }), Future::Prior, &params);
    let episode = batch().tokens.map(|column| column.narrow(0, 0, 1)).unwrap();
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let at = [0, 2, 3];
    let ahead = episode.pick(&at.map(Some)).unwrap();
    let together = model.infer_within(&episode, &at, &ahead).unwrap();
    for (row, t) in at.into_iter().enumerate() {
        let alone = model.infer_after(&model.past(&episode, Some(&[t])).unwrap(), &episode.narrow(t, 1).unwrap()).unwrap();
        assert_eq!(flat(&together.mean.narrow(0, row, 1).unwrap()), flat(&alone.mean), "{t}");
    }
}

/// What stays is one number for a whole row, drawn from the belief of one step, and its KL is paid once: by hand, from the posteriors.
#[test]
fn what_stays_by_hand() {
    let params = Params::fresh(2);
    let model = staying(1, None, Future::Prior, &params);
    let batch = batch_that_stays();
    let q = model.posteriors(&batch.tokens, &batch.history_shown, &batch.successor_shown).unwrap();
    let [mean, log_var] = [&q.mean, &q.log_var].map(|values| values.to_vec3::<f32>().unwrap());
    let (latent, belief) = model.drawn(&q, &batch, 0).unwrap();
    let (latent, eps) = (latent.to_vec3::<f32>().unwrap(), batch.eps.to_vec3::<f32>().unwrap());
    let draw = |row: usize, step: usize, column: usize, eps: f32| mean[row][step][column] + (log_var[row][step][column] / 2.0).exp() * eps;
    let mut once = 0.0;
    for (row, at) in [1, 2, 0].into_iter().enumerate() {
        for step in 0..LEN - 1 {
            assert!((latent[row][step][0] - draw(row, at, 0, eps[row][0][0])).abs() < 1e-5);
            assert!((latent[row][step][1] - draw(row, step, 1, eps[row][step][1])).abs() < 1e-5);
        }
        let (mean, log_var) = (mean[row][at][0], log_var[row][at][0]);
        once += 0.5 * (log_var.exp() + mean * mean - 1.0 - log_var);
    }
    let kl = |stays: Option<&Gaussian>| model.block_kl(&q, stays, &batch.valid, 0.0).unwrap().to_scalar::<f32>().unwrap();
    let steps = batch.valid.sum_all().unwrap().to_scalar::<f32>().unwrap();
    assert!((kl(belief.as_ref()) - kl(None) - once / steps).abs() < 1e-5, "{} {} {once}", kl(belief.as_ref()), kl(None));
}

/// The prior leaves alone what stays, however far it looks.
#[test]
fn the_prior_moves_what_moves() {
    let model = staying(1, None, Future::Prior, &Params::fresh(2));
    let start = model.infer(&batch().tokens, None).unwrap();
    let flat = |tensor: &Tensor, column: usize| tensor.narrow(2, column, 1).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    model
        .roll_out(start.clone(), 3, |next| {
            assert_eq!(flat(&next.mean, 0), flat(&start.mean, 0));
            assert_eq!(flat(&next.log_var, 0), flat(&start.log_var, 0));
            assert_ne!(flat(&next.mean, 1), flat(&start.mean, 1));
            Ok(())
        })
        .unwrap();
}

/// Actions that are unseen move no belief by themselves: none without a baseline, with one only through what a state was to be after them.
#[test]
fn unseen_actions() {
    for baseline in [None, Some(Baseline { width: 5 })] {
        let latent = GruLatent { actions: Actions::Unseen, baseline, ..GruLatent::plain(DIM, 7, Looks::Block(4)) };
        let model = LatentModel::new(&latent, layout(), &Params::fresh(2)).unwrap();
        let flat = |tokens: &Tokens| {
            let tokens = if baseline.is_some() { tokens.clone().following(None).unwrap() } else { tokens.clone() };
            model.infer(&tokens, None).unwrap().mean.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let (clean, mut moved) = (batch().tokens, batch().tokens);
        // The last action has no successor that could tell of it; beside a baseline its reward has, which is hidden.
        let keep = Tensor::new(&[1f32, 1.0, 0.0], &Device::Cpu).unwrap();
        let hide = |tokens: &Tokens| Tokens { present: tokens.present.broadcast_mul(&keep).unwrap(), ..tokens.clone() };
        let last =
            Tensor::from_vec((0..BATCH * LEN * 2).map(|i| f32::from(i / 2 % LEN == LEN - 1)).collect(), (BATCH, LEN, 2), &Device::Cpu);
        moved.action = (&moved.action + last.unwrap()).unwrap();
        assert_eq!(flat(&hide(&clean)), flat(&hide(&moved)), "{baseline:?}");
        let seen = LatentModel::new(&GruLatent { actions: Actions::Evidence, ..latent }, layout(), &Params::fresh(2)).unwrap();
        let infer = |tokens: &Tokens| {
            let tokens = hide(tokens).following(None).unwrap();
            seen.infer(&tokens, None).unwrap().mean.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        assert_ne!(infer(&clean), infer(&moved));
    }
}

/// Steps ahead, row by row and step by step: the prior's means from each posterior, one and two steps on, against what happened there.
#[test]
fn steps_ahead_by_hand() {
    let model = model(&Params::fresh(2));
    let batch = batch();
    let options = ElboOptions { ahead: Ahead { steps: 2, weight: 0.5 }, ..options() };
    let q = model.posteriors(&batch.tokens, &batch.history_shown, &batch.successor_shown).unwrap();
    let prior = model.prior.as_ref().unwrap();
    let state = batch.tokens.state.to_vec3::<f32>().unwrap();
    let reward = batch.tokens.reward.to_vec3::<f32>().unwrap();
    let (mut expected, mut next) = (0.0, q);
    for d in 1..=2 {
        next = prior.predict(&next).unwrap();
        let (mut sum, mut count) = ([0.0, 0.0], 0.0);
        for row in 0..BATCH {
            for t in (0..LEN - 1 - d).filter(|t| row != 1 || *t >= 2) {
                let at = |tensor: &Tensor, t: usize| tensor.narrow(0, row, 1).unwrap().narrow(1, t, 1).unwrap().contiguous().unwrap();
                let told =
                    model.decoder.predict(&at(&batch.tokens.state, t + d), &at(&batch.tokens.action, t + d), &at(&next.mean, t)).unwrap();
                let told_state = told.state.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                for column in 0..3 {
                    let change = (state[row][t + d + 1][column] - state[row][t + d][column]) / options.state_change_std[column];
                    sum[0] += (told_state[column] - change).powi(2) / 3.0;
                }
                sum[1] += (told.reward.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0] - reward[row][t + d][0]).powi(2);
                count += 1.0;
            }
        }
        expected += (sum[0] + 0.7 * sum[1]) / count / 2.0;
    }
    let terms = model.elbo(&batch, &options).unwrap();
    let number = |tensor: &Tensor| tensor.to_scalar::<f32>().unwrap();
    assert!((number(terms.ahead.as_ref().unwrap()) - expected).abs() < 1e-4 * expected, "{expected}");
    let without = model.elbo(&batch, &ElboOptions { ahead: Ahead::default(), ..options }).unwrap();
    assert!((number(&terms.loss) - number(&without.loss) - 0.5 * expected).abs() < 1e-4 * expected && without.ahead.is_none());
}
