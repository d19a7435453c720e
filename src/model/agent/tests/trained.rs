//! What a checkpoint was not trained for is imputed or refused, and what it was trained for is masked.

use super::*;
use crate::model::config::Missing;

/// An agent whose checkpoint says that nothing of a history was ever hidden.
fn whole_histories_only() -> Agent {
    let mut agent = agent(true, 1, unet());
    agent.config.trained.missing = Missing::default();
    agent
}

fn second(agent: &Agent, executed: Vec<Executed>) -> Result<Chunk, AgentError> {
    let mut stream = Philox::new(5);
    let (episode, _) = agent.act(&agent.open(1, &options()).unwrap(), &observation(&mut stream)).unwrap();
    agent.act(&episode, &Observation { executed, ..observation(&mut stream) }).map(|(_, chunk)| chunk)
}

/// A bare `act(state)` left a mask where training had always seen a reward: Point-Wind-S fell from -21.1 to -44.7. The mean reward,
/// marked present, costs .2.
#[test]
fn a_reward_that_was_never_missing_is_taken_as_the_mean() {
    let reported = |reward| vec![Executed { reward, ..Executed::default() }];
    let mut agent = whole_histories_only();
    agent.config.units.normalizer.reward = Affine { mean: vec![3.0], std: vec![2.0] };
    let mean = second(&agent, reported(Some(3.0))).unwrap();
    assert_eq!(second(&agent, Vec::new()).unwrap(), mean);
    assert_eq!(second(&agent, reported(None)).unwrap(), mean);
    agent.config.trained.missing.reward = true;
    assert_ne!(second(&agent, Vec::new()).unwrap(), mean, "masked, as it was in training");
}

#[test]
fn other_gaps_are_refused_unless_trained() {
    let steps = |states: [Option<Vec<f32>>; 2], actions: [Option<Vec<f32>>; 2]| {
        let step = |(state, action)| Executed { state, action, reward: None };
        states.into_iter().zip(actions).map(step).collect::<Vec<_>>()
    };
    let (state, action) = (Some(vec![0.0; 3]), Some(vec![0.0; 2]));
    let no_state = steps([None, None], [None, action.clone()]);
    let no_action = steps([None, state.clone()], [None, None]);
    let field = |agent: &Agent, executed| match second(agent, executed) {
        Err(AgentError::InvalidObservation { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    let mut agent = whole_histories_only();
    assert_eq!(field(&agent, no_state.clone()), "executed[1].state");
    assert_eq!(field(&agent, no_action.clone()), "executed[1].action");
    agent.config.trained.missing = Missing { state: true, action: true, reward: false };
    assert!(second(&agent, no_state).is_ok() && second(&agent, no_action).is_ok());
}

/// A chunk of two actions from a checkpoint trained for one fell from -20.3 to -32.6, in silence.
#[test]
fn a_chunk_length_that_was_not_trained_is_refused() {
    let mut agent = agent(true, 1, unet());
    agent.config.trained.action_horizons = vec![1, 4];
    let open = |action_horizon| agent.open(1, &SamplerOptions { action_horizon, ..options() });
    assert!(open(1).is_ok() && open(4).is_ok());
    let error = open(2).unwrap_err().to_string();
    assert_eq!(error, "options.action_horizon: this checkpoint was trained for chunks of [1, 4] actions, not 2");
}

/// The planned states began with the state in which the chunk's last action was executed, one step before what they are said to be.
#[test]
fn planned_states_follow_the_last_action() {
    for (obs_horizon, action_horizon) in [(1, 1), (1, 3), (3, 2)] {
        let agent = agent(true, obs_horizon, unet());
        let options = SamplerOptions { action_horizon, ..options() };
        for chunk in run(&agent, 3, &options, 3) {
            assert_eq!(chunk.planned_states.len(), HORIZON - 1);
            assert_eq!(chunk.planned_states[0], chunk.predicted_state);
        }
        let mut stream = Philox::new(99);
        let (episode, _) = agent.act(&agent.open(3, &options).unwrap(), &observation(&mut stream)).unwrap();
        let mut cut = agent.begin(&episode, &observation(&mut stream)).unwrap();
        assert!(agent.cut_short(&mut cut));
        let (_, chunk) = agent.finish(cut).unwrap();
        assert_eq!((chunk.planned_states.len(), chunk.degraded), (HORIZON - 1, true));
        assert_eq!(chunk.planned_states[0], chunk.predicted_state);
    }
}

/// What was executed is held within the bounds of the data, as in training: a broken reading is no evidence.
#[test]
fn executed_actions_are_held_within_their_bounds() {
    let agent = agent(true, 1, unet());
    let executed = |value| vec![Executed { action: Some(vec![value, -value]), ..Executed::default() }];
    assert_eq!(second(&agent, executed(1e6)).unwrap(), second(&agent, executed(1.0)).unwrap());
    assert_ne!(second(&agent, executed(0.9)).unwrap(), second(&agent, executed(1.0)).unwrap());
}
