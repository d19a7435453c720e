//! A latent beside a baseline against PyTorch's: `tests/golden/make_baseline.py` has the same formulas, written out position by position.

use super::*;
use crate::model::{
    method::{Baseline as Sizes, Future},
    trajectory::TokenRef,
};

const WIDTH: usize = 5;

fn baseline(params: &Params) -> candle_core::Result<Baseline> {
    Baseline::new(WIDTH, LAYOUT, &params.scope("baseline"))
}

/// Surprises, and where they mean something: the results of the golden case, by name.
fn surprises<V: Activations>(tokens: &Tokens<V>, params: &Params) -> candle_core::Result<Vec<(String, V)>> {
    let Surprises { state, action, reward } = baseline(params)?.surprises(tokens, true)?;
    let told = tokens.before.as_ref().unwrap().told.clone();
    Ok([("state", state), ("action", action.expect("is asked for")), ("reward", reward), ("told", told)]
        .map(|(name, value)| (name.into(), value))
        .into())
}

/// The tokens of the golden case as an act packs them: what is absent is not there at all.
fn packed(golden: &Golden) -> Tokens<Buffer> {
    let [state, action, reward, present, noise] =
        ["state", "action", "reward", "present", "noise"].map(|name| golden.flat(&format!("in.{name}")));
    let rows = 3;
    let len = noise.len() / rows;
    let part =
        |values: &[f32], at: usize, width: usize, i: usize| (present[3 * at + i] > 0.5).then(|| values[width * at..][..width].to_vec());
    let tokens: Vec<Token> = (0..rows * len)
        .map(|at| Token {
            state: part(&state, at, LAYOUT.state_dim, 0),
            action: part(&action, at, LAYOUT.action_dim, 1),
            reward: part(&reward, at, 1, 2).map(|reward| reward[0]),
            noise: noise[at],
        })
        .collect();
    let nothing = |_: &[Token]| TokenRef::default();
    Tokens::pack(LAYOUT, tokens.chunks_exact(len), len, Some(&nothing), |row, position| row[position].view()).unwrap()
}

/// Of tokens of which this and that is missing, with surprises beyond their bounds; they move no baseline.
#[test]
fn surprises_against_pytorch() {
    let golden = Golden::of("surprises");
    golden.check_training(|given, params| surprises(&tokens_of(|name| given[name].clone()).following(None)?, params));
    golden.check_serving(|params| surprises(&packed(&golden), params));
}

/// What needs no context, its three errors and their gradients.
#[test]
fn context_free_loss_against_pytorch() {
    Golden::of("context_free").check_training(|given, params| {
        let terms = baseline(params)?.loss(&tokens_of(|name| given[name].clone()), &CHANGE_STD)?;
        let ContextFreeTerms { loss, state_error, action_error, reward_error } = terms;
        let named = [("loss", loss), ("state_error", state_error), ("action_error", action_error), ("reward_error", reward_error)];
        Ok(named.map(|(name, term)| (name.into(), term)).into())
    });
}

/// All terms of the ELBO beside a baseline, with one column that stays, and their gradients, which reach no baseline.
fn check_elbo(case: &'static str, latent: &GruLatent, free_bits: f64) {
    let latent = GruLatent { stays: 1, baseline: Some(Sizes { width: WIDTH }), ..latent.clone() };
    let options = ElboOptions { state_weight: 0.8, free_bits, ahead: Ahead { steps: 2, weight: 0.5 }, ..elbo_options() };
    Golden::of(case).check_training(|given, params| {
        let ElboTerms { loss, state_error, reward_error, action_error, context_error: _, ahead, kl } =
            LatentModel::new(&latent, LAYOUT, params)?.elbo(&elbo_batch(given), &options)?;
        let named = [("loss", loss), ("state_error", state_error), ("reward_error", reward_error), ("kl", kl)];
        let beside = [("action_error", action_error.unwrap()), ("ahead", ahead.unwrap())];
        Ok(named.into_iter().chain(beside).map(|(name, term)| (name.into(), term)).collect())
    });
}

#[test]
fn elbo_of_surprises_against_pytorch() {
    check_elbo("elbo_surprises", &golden_latent(3, 7), 0.0);
}

/// A belief that is held, and free bits, which some steps stay below.
#[test]
fn elbo_of_a_held_belief_against_pytorch() {
    check_elbo("elbo_held", &GruLatent { future: Future::Held, ..golden_latent(2, 5) }, 1.5);
}
