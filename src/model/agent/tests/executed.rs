//! What an act may tell of the time since the one before: all of its chunk, none of it, or more than it held.

use super::*;

fn seen(state: [f32; 3], executed: Vec<Executed>) -> Observation {
    Observation { state: state.to_vec(), executed, ..Observation::default() }
}

fn step(state: Option<[f32; 3]>, action: [f32; 2]) -> Executed {
    Executed { state: state.map(Vec::from), action: Some(action.to_vec()), reward: Some(0.5) }
}

/// "Nothing was executed" could not be said: an empty list meant the whole chunk, and whoever planned anew before the first step told the
/// model of steps that never were. An act in the place of another leaves no trace of it: not in time, history or latent, nor in the window.
#[test]
fn an_act_in_the_place_of_another_leaves_no_trace() {
    let agent = agent(true, 1, unet());
    let (there, here) = ([0.4, 0.1, -0.2], [0.1, 0.2, 0.3]);
    for streaming in [true, false] {
        let fresh = agent.open(1, &SamplerOptions { streaming, action_horizon: 3, ..options() }).unwrap();
        let start = agent.act(&fresh, &seen([0.0; 3], vec![])).unwrap().0;
        let (given_up, _) = agent.act(&start, &seen(there, vec![])).unwrap();
        let again = Observation { nothing_executed: true, ..seen(here, vec![]) };
        let (episode, chunk) = agent.act(&given_up, &again).unwrap();
        assert_eq!((episode.time(), chunk.start, chunk.degraded), (3, Start::Cold, false));
        // The same without the act that was given up, and without the window that it used up.
        let mut cold = start;
        cold.take_stored();
        assert_eq!((episode.clone(), chunk), agent.act(&cold, &seen(here, vec![])).unwrap());
        // What follows goes on from the act that counts: its state, its actions.
        let (next, _) = agent.act(&episode, &seen(there, vec![])).unwrap();
        let state = agent.config.units.normalizer.state.normalize(&here);
        let first_step = &next.history()[next.history().len() - 3];
        assert_eq!((next.time(), first_step.state.as_deref()), (6, Some(&state[..])));
    }
}

/// At the first act there is nothing that could have been executed: it says the same as saying nothing.
#[test]
fn at_the_first_act_nothing_was_executed_anyway() {
    let agent = agent(true, 1, unet());
    let fresh = agent.open(1, &options()).unwrap();
    let said = Observation { nothing_executed: true, ..seen([0.1; 3], vec![]) };
    assert_eq!(agent.act(&fresh, &said).unwrap(), agent.act(&fresh, &seen([0.1; 3], vec![])).unwrap());
}

/// A hurried act has the window of the act before, which stands for a later time: with nothing executed there is nothing to give out.
#[test]
fn nothing_executed_cannot_be_cut_short() {
    let agent = agent(true, 1, unet());
    let (episode, _) = agent.act(&agent.open(1, &options()).unwrap(), &seen([0.0; 3], vec![])).unwrap();
    let mut descent = agent.begin(&episode, &Observation { nothing_executed: true, ..seen([0.0; 3], vec![]) }).unwrap();
    assert!(!agent.cut_short(&mut descent) && !descent.is_done());
}

/// After a break somebody else has driven on: more steps than the chunk had are history like any other, if they say their actions.
#[test]
fn more_steps_than_were_returned_catch_up() {
    let mut agent = agent(true, 1, unet());
    agent.config.trained.missing.action = false;
    let (episode, chunk) = agent.act(&agent.open(1, &options()).unwrap(), &seen([0.1, 0.2, 0.3], vec![])).unwrap();
    let driven = |first: Option<[f32; 3]>| {
        let others = (1..5).map(|i| step(Some([i as f32 / 10.0; 3]), [0.1, -0.1 * i as f32]));
        std::iter::once(step(first, [0.0, 0.0])).chain(others).collect::<Vec<_>>()
    };
    let (caught_up, after) = agent.act(&episode, &seen([0.5; 3], driven(None))).unwrap();
    assert_eq!((caught_up.time(), after.start, chunk.actions.len()), (5, Start::Cold, 1));
    // The same past told to a fresh session, which does not know the first state, primes it.
    let primed = agent.act(&agent.open(1, &options()).unwrap(), &seen([0.5; 3], driven(Some([0.1, 0.2, 0.3])))).unwrap();
    assert_eq!(primed, (caught_up, after));
    let mut silent = driven(None);
    silent[3].action = None;
    match agent.begin(&episode, &seen([0.5; 3], silent)) {
        Err(AgentError::InvalidObservation { field, reason }) => {
            assert_eq!(field, "executed[3].action");
            assert!(reason.contains("no action was returned for this step"), "{reason}");
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn nothing_executed_excludes_what_was_executed() {
    let agent = agent(true, 1, unet());
    let (episode, _) = agent.act(&agent.open(1, &options()).unwrap(), &seen([0.0; 3], vec![])).unwrap();
    let both = Observation { nothing_executed: true, ..seen([0.0; 3], vec![Executed::default()]) };
    match agent.begin(&episode, &both) {
        Err(AgentError::InvalidObservation { field, reason }) => {
            assert_eq!(field, "nothing_executed");
            assert!(reason.contains("`executed` holds 1 step"), "{reason}");
        }
        other => panic!("{other:?}"),
    }
}

/// The past of an episode that began elsewhere may be told at once: what matters is what happened, not how many acts told it.
#[test]
fn a_primed_session_goes_on_as_the_one_that_lived_it() {
    let agent = agent(true, 3, unet());
    let open = || agent.open(5, &SamplerOptions { streaming: false, eta: 0.7, ..options() }).unwrap();
    let state = |t: usize| [0.1 * t as f32, 0.2, -0.1 * t as f32];
    let action = |t: usize| [0.3 - 0.1 * t as f32, 0.5];
    let mut lived = agent.act(&open(), &seen(state(0), vec![])).unwrap();
    for t in 1..6 {
        lived = agent.act(&lived.0, &seen(state(t), vec![step(None, action(t - 1))])).unwrap();
    }
    let told = (0..5).map(|t| step(Some(state(t)), action(t))).collect();
    assert_eq!(agent.act(&open(), &seen(state(5), told)).unwrap(), lived);
}

/// An act that is told of thousands of steps keeps what its model looks back on, and counts what it keeps: a session once kept 4.8 MB, and was
/// counted as 872 bytes.
#[test]
fn a_long_past_leaves_no_memory() {
    let agent = agent(true, 1, unet());
    let fresh = agent.open(1, &options()).unwrap();
    let long: Vec<_> = (0..5000).map(|t| step(Some([t as f32 / 1e4; 3]), [0.1, 0.2])).collect();
    let last = long[long.len() - 4..].to_vec();
    let (episode, chunk) = agent.act(&fresh, &seen([0.1; 3], long)).unwrap();
    assert_eq!((episode.history().len(), episode.time()), (4, 5000));
    assert!(episode.history().capacity() <= 8, "{}", episode.history().capacity());
    let (short, same) = agent.act(&fresh.at(4996), &seen([0.1; 3], last)).unwrap();
    assert!(chunk == same && episode.history() == short.history());
    assert!(episode.size_bytes() <= short.size_bytes() + 8 * size_of_val(&episode.history()[0]));
}
