//! An act that was in a hurry is done again as it was, by what is noted of it.

use super::*;
use crate::model::method::Guide;

/// Whatever told it to hurry, when and how much, and wherever it was cut: the haste that is noted makes the same act of it, in company too, whatever
/// it is told meanwhile. So it is with latents, chunks, sub-steps, rows that are evaluated at once, and candidates of which others are chosen.
#[test]
fn a_hurried_act_is_done_again() {
    let agent = agent_with(true, 1, unet(), |config| {
        config.method.guide = Some(Guide::Value { widths: vec![8, 16] });
        config.units.returns = Some(Affine { mean: vec![-1.0], std: vec![0.5] });
    });
    let (mut degraded, mut cut, mut unnoticed) = (0, 0, 0);
    for seed in 0..400 {
        let mut stream = Philox::new(1000 + seed);
        let mut draw = |below: u64| (stream.normal().abs() * 1e4) as u64 % below;
        let streaming = draw(3) > 0;
        let options = SamplerOptions {
            streaming,
            // A window that is kept is one alone.
            candidates: if streaming { 1 } else { 1 + draw(3) as usize },
            action_horizon: 1 + draw(3) as usize,
            sub_steps: 1 + draw(4) as usize,
            picard_window: 1 + draw(2) as usize * 2,
            eta: 0.7,
            latent: LatentMode::Sample,
            ..options()
        };
        let mut see = Philox::new(seed);
        let (episode, _) = agent.act(&agent.open(seed, &options).unwrap(), &observation(&mut see)).unwrap();
        let seen = observation(&mut see);
        let mut acts = [agent.begin(&episode, &seen).unwrap()];
        while !acts[0].is_done() {
            match draw(8) {
                0 if agent.cut_short(&mut acts[0]) => cut += 1,
                turn => acts[0].allow((turn < 6).then(|| draw(12) as usize)),
            }
            // What is cut may still ask for its choice.
            if !acts[0].is_done() {
                agent.advance(&mut acts).unwrap();
            }
        }
        let [mut act] = acts;
        let haste = act.take_haste();
        let expected = agent.finish(act).unwrap();
        degraded += u32::from(expected.1.degraded);
        unnoticed += u32::from(!expected.1.degraded && !haste.is_none());
        if haste.is_none() {
            assert_eq!(expected, agent.act(&episode, &seen).unwrap(), "nothing was made of it");
        }
        let again = |haste: &Haste| {
            let mut act = agent.begin(&episode, &seen).unwrap();
            act.repeat(haste.clone());
            act
        };
        let other = agent.begin(&agent.open(9, &options).unwrap(), &seen).unwrap();
        let mut acts = vec![again(&haste), other];
        while !acts[0].is_done() {
            acts.iter_mut().for_each(|act| act.allow((draw(2) == 0).then_some(1)));
            agent.advance(&mut acts).unwrap();
            acts.truncate(if acts[1..].iter().any(Act::is_done) { 1 } else { 2 });
        }
        let mut act = acts.swap_remove(0);
        assert_eq!(act.take_haste(), haste, "{options:?}");
        assert_eq!(agent.finish(act).unwrap(), expected, "{options:?} {haste:?}");
    }
    assert!(degraded > 100 && cut > 50 && unnoticed > 0, "{degraded} {cut} {unnoticed}");
}
