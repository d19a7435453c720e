//! Guides: gradients against central differences, what they lead to, and the choice among candidates.

use super::*;
use crate::model::{
    diffusion::guidance::{Futures, Seat, lead},
    method::{Guide, Schedule, Target},
    nn::{Activations, Buffer},
};

fn guided(latents: bool, guide: Guide, target: Target) -> Agent {
    agent_with(latents, 1, Backbone::Unet { widths: vec![8, 16] }, |config| {
        config.method.guide = Some(guide);
        config.method.plan.target = target;
        config.units.returns = Some(Affine { mean: vec![-1.0], std: vec![0.5] });
    })
}

fn value() -> Guide {
    Guide::Value { widths: vec![8, 16] }
}

fn buffer(shape: [usize; 3], seed: u64) -> Buffer {
    let mut rng = Philox::new(seed);
    Buffer::generate(shape, |out| out.iter_mut().for_each(|out| *out = rng.normal())).unwrap()
}

/// Three windows at levels of a row, with latents, and a future of each in which two entries are known.
fn seat(agent: &Agent) -> (Seat, Futures) {
    let (batch, width, latent_dim) = (3, 5, agent.config().method.latent.dim());
    let levels = |out: &mut [f32]| out.iter_mut().enumerate().for_each(|(i, out)| *out = [5.0, 15.0, 30.0][i % 3]);
    let seat = Seat {
        x: buffer([batch, HORIZON, width], 1),
        estimate: buffer([batch, HORIZON, width], 2),
        levels: Buffer::generate([batch, HORIZON, 1], levels).unwrap(),
        latents: (latent_dim > 0).then(|| buffer([batch, HORIZON, latent_dim], 3)),
    };
    let known = Buffer::generate([batch, HORIZON, width], |out| out[..2].fill(1.0)).unwrap();
    (seat, Futures { noise: buffer([batch, HORIZON, width], 4), known, observed: None, told: None })
}

/// The gradient through noise, denoiser and guide, whatever the target, is the slope of what it is the gradient of.
#[test]
fn gradients_in_the_future_are_slopes() {
    for (latents, guide, target) in [
        (true, value(), Target::X0),
        (true, Guide::DecoderReturn, Target::V),
        (true, Guide::Dual { discrepancy: 0.7 }, Target::X0),
        (false, value(), Target::Eps),
    ] {
        let agent = guided(latents, guide, target);
        let (seat, futures) = seat(&agent);
        let gradient = agent.judge().gradient_in_future(&seat, &futures).unwrap();
        let again = |estimate: Buffer| {
            let seat = Seat { x: seat.x.clone(), estimate, levels: seat.levels.clone(), latents: seat.latents.clone() };
            f64::from(agent.judge().future_worth(&seat, &futures).unwrap().iter().sum::<f32>())
        };
        let (mut off, mut size) = (0.0, 0.0);
        for i in (0..gradient.len()).step_by(5) {
            let step = 1e-2_f32;
            let [above, below] = [step, -step].map(|by| {
                let mut moved = seat.estimate.clone();
                moved[i] += by;
                again(moved)
            });
            let slope = ((above - below) / (2.0 * f64::from(step))) as f32;
            (off, size) = (off + (gradient[i] - slope).powi(2), size + gradient[i].powi(2));
        }
        // The decoder has kinks, which a difference steps over.
        assert!(size > 1e-4 && (off / size).sqrt() < 0.03, "{target:?}: {} of {}", off.sqrt(), size.sqrt());
    }
}

/// Dual guidance holds a window to be worth its return less the mean square of how its states differ from what the decoder tells of the steps before,
/// in the units of the state's change.
#[test]
fn what_is_wrong_with_a_window_is_taken_off() {
    let change_std = vec![0.5, 2.0, 4.0];
    let agent = |guide: Guide| {
        agent_with(true, 1, Backbone::Unet { widths: vec![8, 16] }, |config| {
            config.method.guide = Some(guide);
            config.units.returns = Some(Affine { mean: vec![-1.0], std: vec![0.5] });
            config.units.normalizer.state_change_std.clone_from(&change_std);
        })
    };
    let (plain, dual) = (agent(Guide::DecoderReturn), agent(Guide::Dual { discrepancy: 0.7 }));
    let (Seat { estimate: x, latents, .. }, _) = seat(&dual);
    let [plain, worth] = [&plain, &dual].map(|agent| agent.judge().worth(&x, latents.as_ref()).unwrap().to_vec());
    let decoder = &dual.networks().latent.as_ref().unwrap().decoder;
    let told = decoder.predict(&x.channels(0, 3).unwrap(), &x.channels(3, 2).unwrap(), latents.as_ref().unwrap()).unwrap();
    for row in 0..3 {
        let mut squares = 0.0;
        for (step, column) in (0..HORIZON - 1).flat_map(|step| (0..3).map(move |column| (step, column))) {
            let at = |step: usize| x[(row * HORIZON + step) * 5 + column];
            let change = (at(step + 1) - at(step)) / change_std[column];
            squares += (change - told.state[(row * HORIZON + step) * 3 + column]).powi(2);
        }
        let expected = plain[row] - 0.7 * squares / (3 * (HORIZON - 1)) as f32;
        assert!((worth[row] - expected).abs() < 1e-4 * expected.abs().max(1.0), "{} {expected}", worth[row]);
    }
}

/// `x0 += omega sigma^2 g`, and no position's gradient is longer than 1.
#[test]
fn estimates_are_led_by_hand() {
    let agent = guided(false, value(), Target::X0);
    let mut estimate = vec![1.0; 2 * 5];
    let gradient = [[3.0, 0.0, 4.0, 0.0, 0.0], [0.1, 0.0, 0.0, -0.2, 0.0]].concat();
    lead(&mut estimate, &gradient, (2.0, agent.walk()), |position| [40, 10][position]);
    let noise = |level| agent.walk().process.sigma(level).powi(2);
    let expected = [
        [3.0 / 5.0, 0.0, 4.0 / 5.0, 0.0, 0.0].map(|value| 1.0 + 2.0 * noise(40) * value),
        [0.1, 0.0, 0.0, -0.2, 0.0].map(|value| 1.0 + 2.0 * noise(10) * value),
    ]
    .concat();
    assert!(estimate.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{estimate:?}");
}

/// The farther a window is led, the more its guide holds it to be worth; 0 leads nowhere, and costs nothing.
#[test]
fn guided_windows_are_worth_more() {
    for (guide, target) in [(value(), Target::X0), (Guide::DecoderReturn, Target::X0), (Guide::Dual { discrepancy: 0.1 }, Target::X0)] {
        // A step as long as that leads beyond the best of a square.
        let lasts = !matches!(guide, Guide::Dual { .. });
        let agent = guided(true, guide, target);
        let worth = |scale: f32, samples: usize| -> f32 {
            let options = SamplerOptions { guidance_scale: scale, guidance_samples: samples, temperature: 1.0, ..options() };
            let chunks = (0..12).map(|seed| run(&agent, seed, &options, 1).remove(0));
            chunks.map(|chunk| chunk.value.unwrap()).sum::<f32>() / 12.0
        };
        let none = worth(1e-6, 0);
        assert!(worth(3.0, 0) > none + 0.003, "{} and {none}", worth(3.0, 0));
        assert!(!lasts || worth(30.0, 0) > worth(3.0, 0));
        assert_ne!(worth(3.0, 2), worth(3.0, 0), "the gradient in the future is another one");
        let plain = run(&agent, 1, &options(), 1).remove(0);
        assert_eq!((plain.value, plain.value_spread), (None, None));
    }
}

/// Guided or not, in the future or now, one window or several: rows do not influence each other.
#[test]
fn a_guided_batch_is_its_rows() {
    for (latents, guide, target) in [
        (true, value(), Target::V),
        (true, Guide::DecoderReturn, Target::X0),
        (true, Guide::Dual { discrepancy: 0.7 }, Target::X0),
        (false, value(), Target::X0),
    ] {
        let agent = guided(latents, guide, target);
        let vary = |i: u64| SamplerOptions {
            guidance_scale: [0.0, 1.5, 3.0, 1.0][i as usize % 4],
            guidance_samples: [0, 0, 2, 1][i as usize % 4],
            candidates: [1, 3, 2][i as usize % 3],
            pick_temperature: [0.0, 1.0][i as usize % 2],
            picard_window: [1, 3][i as usize % 2],
            action_horizon: 1 + i as usize % 2,
            streaming: false,
            eta: 1.0,
            ..options()
        };
        let mut stream = Philox::new(4);
        let observations: Vec<Observation> = (0..8).map(|_| observation(&mut stream)).collect();
        let episodes: Vec<Episode> = (0..8).map(|i| agent.open(i, &vary(i)).unwrap()).collect();
        let [alone, together] = alone_and_together(&agent, &episodes, &observations);
        assert_eq!(together, alone);
    }
}

/// Of several candidates the one of the highest value is given out, the first of them being the window of an act without others; by chance, each
/// sometimes.
#[test]
fn the_best_candidate_is_chosen() {
    let agent = guided(true, value(), Target::X0);
    let several = |pick_temperature| SamplerOptions { candidates: 6, streaming: false, pick_temperature, temperature: 1.0, ..options() };
    let mut stream = Philox::new(9);
    let (mut winners, mut by_chance) = (std::collections::BTreeSet::new(), 0);
    for seed in 0..12 {
        let observation = observation(&mut stream);
        let mut acts = [agent.begin(&agent.open(seed, &several(0.0)).unwrap(), &observation).unwrap()];
        while !acts[0].is_done() {
            agent.advance(&mut acts).unwrap();
        }
        let worth: Vec<f32> = acts[0]
            .candidates()
            .iter()
            .map(|window| {
                let x = Buffer::generate([1, HORIZON, 5], |out| window.write_plan(out)).unwrap();
                let latents = Buffer::generate([1, HORIZON, 5], |out| window.latents().write_means(out)).unwrap();
                agent.judge().worth(&x, Some(&latents)).unwrap()[0]
            })
            .collect();
        let best = (0..6).fold(0, |best, i| if worth[i] > worth[best] { i } else { best });
        let [first, action] = [0, best].map(|i| acts[0].candidates()[i].action(0).to_vec());
        let [act] = acts;
        let (episode, chunk) = agent.finish(act).unwrap();
        assert_eq!((chunk.actions[0].clone(), chunk.value), (action, Some(-1.0 + 0.5 * worth[best])));
        assert!(chunk.value_spread.unwrap() > 0.0 && episode.stored().is_none());
        let alone = agent.act(&agent.open(seed, &SamplerOptions { candidates: 1, ..several(0.0) }).unwrap(), &observation).unwrap().1;
        assert_eq!(alone.actions[0], first, "the first candidate is the window of an act without others");
        winners.insert(best);
        let drawn = agent.act(&agent.open(seed, &several(10.0)).unwrap(), &observation).unwrap().1;
        by_chance += usize::from(drawn.actions != chunk.actions);
    }
    assert!(winners.len() > 2 && (4..=12).contains(&by_chance), "{winners:?} {by_chance}");
}

/// Without a ladder too, and where states alone are planned.
#[test]
fn other_plans_are_guided() {
    let agent = agent_with(false, 1, unet(), |config| {
        config.method.guide = Some(value());
        config.method.plan.schedule = Schedule::Uniform { steps: 5 };
        config.units.returns = Some(Affine::identity(1));
        (config.defaults.sampler.streaming, config.trained.sub_steps) = (false, vec![1]);
    });
    let cold = SamplerOptions { streaming: false, candidates: 2, guidance_scale: 1.5, action_horizon: 2, ..options() };
    let chunk = run(&agent, 1, &cold, 1).remove(0);
    assert_eq!((chunk.actions.len(), chunk.evaluations, chunk.passes), (2, 10, 5));
}
