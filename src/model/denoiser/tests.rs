//! The denoiser on both kinds of values, by row, and against PyTorch's.

use super::*;
use crate::model::{
    config::ModelConfig,
    golden::Golden,
    method::{Diffused, GruLatent, Looks, Told},
    nn::{Buffer, Precision, kernels::testing::with_each_isa, testing::gaussian},
    noise::Philox,
    trajectory::Layout,
};
use candle_core::Tensor;
use proptest::prelude::*;

mod traced;

const LAYOUT: Layout = Layout { state_dim: 3, action_dim: 2 };
const LATENT: usize = 4;
const LEN: usize = 8;
const OBSERVED: usize = 10;

fn config(backbone: Backbone) -> ModelConfig {
    let latent = GruLatent::plain(LATENT, 8, Looks::Block(4));
    let mut config = ModelConfig::plain(LAYOUT, Some(latent), backbone);
    config.method.plan.obs_horizon = 3;
    config
}

fn backbones() -> [Backbone; 5] {
    let unet = Backbone::Unet { widths: vec![24, 40, 72] };
    let mlp = Backbone::Mlp { width: 20, depth: 2, dropout: 0.3 };
    [unet, Backbone::dit(36, 2, 3), with_tokens(36, 2, 3), encoder_decoder([36, 3], [1, 2]), mlp]
}

/// Width and heads, blocks of encoder and decoder.
fn encoder_decoder([width, heads]: [usize; 2], [encoder_depth, depth]: [usize; 2]) -> Backbone {
    Backbone::EncoderDecoder { width, depth, heads, encoder_depth, dropout: 0.3 }
}

/// A transformer that is told the real steps as tokens.
fn with_tokens(width: usize, depth: usize, heads: usize) -> Backbone {
    Backbone::Dit { width, depth, heads, history: History::Tokens }
}

/// The network, jogged so that no gate is closed and no norm plain, with weights packed once.
fn denoiser(backbone: Backbone, precision: Precision) -> Denoiser {
    let config = config(backbone);
    let fresh = Params::fresh(1);
    Denoiser::new(LAYOUT, &config.method, &fresh).unwrap();
    let jog = |(name, var): (String, candle_core::Var)| {
        let mut stream = Philox::named(2, &name);
        let noise: Vec<f32> = (0..var.elem_count()).map(|_| 0.1 * stream.normal()).collect();
        (name, (var.as_tensor() + Tensor::from_vec(noise, var.shape(), var.device()).unwrap()).unwrap())
    };
    Denoiser::new(LAYOUT, &config.method, &Params::loaded_as(fresh.vars().into_iter().map(jog).collect(), precision)).unwrap()
}

/// Inputs of one window, drawn.
#[derive(Clone)]
struct Window {
    x: Vec<f32>,
    latents: Vec<f32>,
    levels: Vec<f32>,
    observed: Vec<f32>,
}

fn window(seed: u64) -> Window {
    let mut stream = Philox::new(seed);
    let mut draw = |count: usize| (0..count).map(|_| stream.normal()).collect::<Vec<f32>>();
    let (x, latents, observed) = (draw(LEN * 5), draw(LEN * LATENT), draw(OBSERVED));
    Window { x, latents, observed, levels: (0..LEN).map(|_| stream.below(41) as f32).collect() }
}

fn predict<V: Activations>(denoiser: &Denoiser, windows: &[Window]) -> V {
    let join = |shape: [usize; 2], part: fn(&Window) -> &Vec<f32>| {
        let rows: Vec<f32> = windows.iter().flat_map(|window| part(window).iter().copied()).collect();
        V::generate([windows.len(), shape[0], shape[1]], |out| out.copy_from_slice(&rows)).unwrap()
    };
    let (x, latents) = (join([LEN, 5], |window| &window.x), join([LEN, LATENT], |window| &window.latents));
    let observed = join([1, OBSERVED], |window| &window.observed);
    let levels: Vec<f32> = windows.iter().flat_map(|window| window.levels.iter().copied()).collect();
    denoiser.predict(&x, &Given { latents: Some(&latents), observed: Some(&observed), ..Given::levels(&levels) }).unwrap()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// Tensors with a way back and plain buffers are two ways through the same arithmetic.
#[test]
fn tensors_and_buffers_give_the_same_bits() {
    for backbone in backbones() {
        let denoiser = denoiser(backbone, Precision::F32);
        let windows: Vec<Window> = (0..7).map(window).collect();
        let tensors = predict::<Tensor>(&denoiser, &windows).flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(tensors.iter().any(|value| value.abs() > 0.1));
        assert_eq!(bits(&tensors), bits(&predict::<Buffer>(&denoiser, &windows)));
    }
}

/// Weights of half the bits move the estimate by about a bfloat16 rounding, 2^-9, not more and not less.
#[test]
fn bf16_weights_are_near() {
    for backbone in backbones() {
        let windows: Vec<Window> = (0..3).map(window).collect();
        let full = predict::<Buffer>(&denoiser(backbone.clone(), Precision::F32), &windows);
        let half = predict::<Buffer>(&denoiser(backbone, Precision::Bf16), &windows);
        let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|value| value * value).sum::<f32>().sqrt();
        let share = norm(&mut full.iter().zip(half.iter()).map(|(a, b)| a - b)) / norm(&mut full.iter().copied());
        assert!((1e-4..2e-2).contains(&share), "{share}");
    }
}

/// What the network of a golden case is.
fn golden_config(case: &str) -> ModelConfig {
    let (unet, dit) =
        (|widths: &[usize]| Backbone::Unet { widths: widths.to_vec() }, |width, depth, heads| Backbone::dit(width, depth, heads));
    let (backbone, dim, obs_horizon) = match case {
        "unet" => (unet(&[5, 16, 3]), 4, 3),
        "unet_observed" => (unet(&[4, 4]), 0, 2),
        "unet_latents" => (unet(&[3, 7]), 3, 1),
        "unet_plain" => (unet(&[6]), 0, 1),
        "dit" => (dit(12, 2, 3), 4, 3),
        "dit_observed" => (dit(10, 1, 1), 0, 2),
        "dit_latents" => (dit(6, 3, 3), 3, 1),
        _ => (dit(4, 0, 2), 0, 1),
    };
    let latent = (dim > 0).then_some(GruLatent::plain(dim, 8, Looks::Block(4)));
    let mut config = ModelConfig::plain(LAYOUT, latent, backbone);
    config.method.plan.obs_horizon = obs_horizon;
    config
}

/// The whole network of both backbones, with latents and real steps, either, and none: results and all gradients.
#[test]
fn networks_against_pytorch() {
    for case in ["unet", "unet_observed", "unet_latents", "unet_plain", "dit", "dit_observed", "dit_latents", "dit_plain"] {
        let (golden, config) = (Golden::of(case), golden_config(case));
        let levels = golden.flat("in.levels");
        golden.check_training(|given, params| {
            let condition = Given { latents: given.get("latents"), observed: given.get("observed"), ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &config.method, params)?.predict(&given["x"], &condition)?)])
        });
        golden.check_serving(|params| {
            let latents: Option<Buffer> = config.method.latent.gru().is_some().then(|| golden.value("in.latents"));
            let observed: Option<Buffer> = (config.method.plan.obs_horizon > 1).then(|| golden.value("in.observed"));
            let condition = Given { latents: latents.as_ref(), observed: observed.as_ref(), ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &config.method, params)?.predict(&golden.value("in.x"), &condition)?)])
        });
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// A row's bits are its own, whatever the batch, its place there, the processor's instructions, and how weights are held.
    #[test]
    fn a_row_does_not_depend_on_its_batch(seeds in proptest::collection::vec(0_u64..1000, 1..40), which in 0_usize..5, half: bool) {
        let denoiser = denoiser(backbones()[which].clone(), if half { Precision::Bf16 } else { Precision::F32 });
        let windows: Vec<Window> = seeds.into_iter().map(window).collect();
        let together = predict::<Buffer>(&denoiser, &windows);
        // Alone, and with every instruction set.
        for (window, row) in windows.iter().zip(together.chunks_exact(LEN * 5)) {
            for alone in with_each_isa(|_| predict::<Buffer>(&denoiser, std::slice::from_ref(window))) {
                prop_assert_eq!(bits(&alone), bits(row));
            }
        }
    }
}

/// A transformer with real steps as tokens, that is told what is wanted.
#[test]
fn tokens_and_wishes_against_pytorch() {
    let (golden, mut config) = (Golden::of("dit_told"), config(with_tokens(12, 2, 3)));
    config.method.told = vec![Told::Goal { columns: vec![0, 1] }];
    let levels = golden.flat("in.levels");
    golden.check_training(|given, params| {
        let [latents, observed, told] = ["latents", "observed", "told"].map(|name| given.get(name));
        let condition = Given { latents, observed, told, ..Given::levels(&levels) };
        Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &config.method, params)?.predict(&given["x"], &condition)?)])
    });
    let [x, latents, observed, told]: [Buffer; 4] = ["x", "latents", "observed", "told"].map(|name| golden.value(&format!("in.{name}")));
    golden.check_serving(|params| {
        let condition = Given { latents: Some(&latents), observed: Some(&observed), told: Some(&told), ..Given::levels(&levels) };
        Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &config.method, params)?.predict(&x, &condition)?)])
    });
}

/// Policies of encoder and decoder: with latents, wishes and several real steps, with none of them, and with nothing to read but the level.
#[test]
fn policies_against_pytorch() {
    for (case, horizon, steps, latent, backbone) in [
        ("policy", 7, 3, 4, encoder_decoder([12, 3], [2, 2])),
        ("policy_each", 5, 1, 0, encoder_decoder([10, 1], [0, 1])),
        ("policy_alone", 3, 0, 3, encoder_decoder([6, 3], [0, 2])),
    ] {
        let (golden, latent) = (Golden::of(case), (latent > 0).then_some(GruLatent::plain(latent, 8, Looks::Block(4))));
        let mut method = ModelConfig::plain(LAYOUT, latent, backbone).method;
        (method.plan.horizon, method.plan.obs_horizon) = (horizon, steps.max(1));
        method.plan.diffused = if steps > 0 { Diffused::Action } else { Diffused::StateAction };
        method.told = if case == "policy" { vec![Told::Goal { columns: vec![0, 1] }] } else { Vec::new() };
        let levels = golden.flat("in.levels");
        golden.check_training(|given, params| {
            let [latents, observed, told] = ["latents", "observed", "told"].map(|name| given.get(name));
            let condition = Given { latents, observed, told, ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &method, params)?.predict(&given["x"], &condition)?)])
        });
        golden.check_serving(|params| {
            let has = [method.latent.dim() > 0, steps > 0, !method.told.is_empty()];
            let value = |(name, has): (&str, bool)| has.then(|| golden.value::<Buffer>(&format!("in.{name}")));
            let [latents, observed, told] = [("latents", has[0]), ("observed", has[1]), ("told", has[2])].map(value);
            let condition = Given { latents: latents.as_ref(), observed: observed.as_ref(), told: told.as_ref(), ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &method, params)?.predict(&golden.value("in.x"), &condition)?)])
        });
    }
}

/// Actors of residual blocks: one action with a latent, and three without.
#[test]
fn actors_against_pytorch() {
    for (case, horizon, steps, latent, width) in [("actor", 1, 2, 4, 12), ("actor_plain", 3, 1, 0, 7)] {
        let (golden, latents) = (Golden::of(case), (latent > 0).then_some(GruLatent::plain(latent, 8, Looks::Block(4))));
        let mut method = ModelConfig::plain(LAYOUT, latents, Backbone::Mlp { width, depth: 2, dropout: 0.1 }).method;
        (method.plan.horizon, method.plan.obs_horizon, method.plan.diffused) = (horizon, steps, Diffused::Action);
        let levels = golden.flat("in.levels");
        golden.check_training(|given, params| {
            let condition = Given { latents: given.get("latents"), observed: given.get("observed"), ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &method, params)?.predict(&given["x"], &condition)?)])
        });
        golden.check_serving(|params| {
            let latents: Option<Buffer> = (latent > 0).then(|| golden.value("in.latents"));
            let observed: Buffer = golden.value("in.observed");
            let condition = Given { latents: latents.as_ref(), observed: Some(&observed), ..Given::levels(&levels) };
            Ok(vec![("x0".into(), Denoiser::new(LAYOUT, &method, params)?.predict(&golden.value("in.x"), &condition)?)])
        });
    }
}

/// A position looks at itself and those before it: what comes later in the window is nothing to it.
#[test]
fn later_positions_are_not_looked_at() {
    let denoiser = denoiser(encoder_decoder([36, 3], [1, 2]), Precision::F32);
    let one = window(3);
    let mut other = one.clone();
    other.x[5 * 5..].iter_mut().for_each(|value| *value += 1.0);
    let [as_is, later] = [one, other].map(|window| predict::<Buffer>(&denoiser, &[window]).to_vec());
    assert_eq!(bits(&as_is[..5 * 5]), bits(&later[..5 * 5]));
    assert!(as_is[5 * 5..] != later[5 * 5..]);
}

/// By chance of one seed always the same numbers are dropped, of another other ones, and without chance none.
#[test]
fn training_drops_numbers_by_chance() {
    let denoiser = denoiser(encoder_decoder([36, 3], [1, 2]), Precision::F32);
    let said = |chance: Option<&Chance>| {
        let (x, latents, observed) = (gaussian(1, (2, LEN, 5)), gaussian(2, (2, LEN, LATENT)), gaussian(3, (2, 1, OBSERVED)));
        let levels = vec![7.0; 2 * LEN];
        let given = Given { latents: Some(&latents), observed: Some(&observed), chance, ..Given::levels(&levels) };
        denoiser.predict(&x, &given).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    let by = |seed| said(Some(&Chance::new(seed)));
    assert!(by(1) == by(1) && by(1) != by(2) && by(1) != said(None));
}

/// Real steps that are tokens are attended to, each at its own place; a window without any is refused, in a recipe and in a forward.
#[test]
fn real_steps_as_tokens() {
    let denoiser = denoiser(with_tokens(12, 2, 3), Precision::F32);
    let one = window(3);
    let told = |observed: Vec<f32>| predict::<Buffer>(&denoiser, &[Window { observed, ..one.clone() }]).to_vec();
    let swapped = [&one.observed[5..], &one.observed[..5]].concat();
    let [as_is, turned, none] = [one.observed.clone(), swapped, vec![0.0; OBSERVED]].map(told);
    assert!(as_is != turned && as_is != none);
    let mut config = config(with_tokens(12, 2, 3));
    config.check().unwrap();
    config.method.plan.obs_horizon = 1;
    assert_eq!(config.check().unwrap_err().field, "method.plan.backbone.history");
    let (x, levels) = (gaussian(1, (1, LEN, 5)), vec![1.0; LEN]);
    let latents = gaussian(2, (1, LEN, LATENT));
    assert!(denoiser.predict(&x, &Given { latents: Some(&latents), ..Given::levels(&levels) }).is_err());
}
