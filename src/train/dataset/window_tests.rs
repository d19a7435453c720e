//! Every number of a batch says where it comes from, so what is cut, hidden and shown can be read off.

use super::*;
use crate::{
    model::{
        config::ModelConfig,
        method::{Backbone, Schedule},
        trajectory::Layout,
    },
    train::dataset::{
        Sides, Span, Which,
        blocks::{BlockShape, blocks},
    },
};

const LAYOUT: Layout = Layout { state_dim: 2, action_dim: 1 };

/// Every number says where it comes from: states 100 e + t and its negative, actions t / 10, rewards -t.
fn episodes() -> Vec<Episode> {
    let episode = |index: usize, len: usize| {
        let states = (0..len).flat_map(|t| [(100 * index + t) as f32, -((100 * index + t) as f32)]).collect();
        let (actions, rewards) = ((0..len).map(|t| t as f32 / 10.0).collect(), (0..len).map(|t| -(t as f32)).collect());
        Episode::of(LAYOUT, [states, actions, rewards, Vec::new()])
    };
    vec![episode(1, 9), episode(2, 12)]
}

/// Of eight tokens, nothing hidden.
fn block_shape(batch: usize, looks: Looks) -> BlockShape {
    BlockShape {
        batch,
        len: 8,
        looks,
        latent_dim: 2,
        stays: false,
        context: None,
        show_action: 0.5,
        show_reward: 0.5,
        mask_state: 0.0,
        hide: Hide::NOTHING,
    }
}

/// Of four positions, beside so many real steps.
fn plan(obs_horizon: usize) -> Diffusion {
    let plan = ModelConfig::plain(LAYOUT, None, Backbone::Unet { widths: vec![8] }).method.plan;
    Diffusion { horizon: 4, obs_horizon, ..plan }
}

fn row_of(standing: &Standing) -> usize {
    match standing {
        Standing::Row(row) => *row,
        Standing::Levels(_) | Standing::Clean => panic!("a row"),
    }
}

fn rows(tensor: &Tensor) -> Vec<Vec<Vec<f32>>> {
    tensor.to_vec3().unwrap()
}

#[test]
fn blocks_run_into_an_episode_and_never_out_of_it() {
    let episodes = episodes();
    let shape = block_shape(200, Looks::Block(3));
    let places = shape.places(&episodes);
    let batch = blocks(&episodes, &places, &shape, &mut Philox::new(1)).unwrap();
    let (states, present) = (rows(&batch.tokens.state), rows(&batch.tokens.present));
    let (valid, shown) = (batch.valid.to_vec2::<f32>().unwrap(), rows(&batch.successor_shown));
    let mut absent_fronts = [0; 4];
    for row in 0..shape.batch {
        let front = present[row].iter().take_while(|flags| flags[0] == 0.0).count();
        absent_fronts[front] += 1;
        for t in 0..shape.len {
            let real = t >= front;
            assert_eq!(present[row][t], [f32::from(real); 3]);
            assert!(real || states[row][t] == [0.0, 0.0]);
            if real && t > front {
                assert_eq!(states[row][t][0], states[row][t - 1][0] + 1.0);
            }
            if t + 1 < shape.len {
                assert_eq!(valid[row][t], f32::from(real));
            }
        }
        if front > 0 {
            assert_eq!(states[row][front][0] % 100.0, 0.0, "after absent tokens comes the first step of an episode");
        }
    }
    assert!(absent_fronts.iter().all(|count| *count > 0), "{absent_fronts:?}");
    let flags: Vec<&Vec<f32>> = shown.iter().flatten().collect();
    let share = |part: usize| flags.iter().map(|flags| flags[part]).sum::<f32>() / flags.len() as f32;
    assert!(share(0) == 1.0 && (share(1) - 0.5).abs() < 0.05 && (share(2) - 0.25).abs() < 0.05);
    assert!(flags.iter().all(|flags| flags[2] <= flags[1]), "a reward is shown with its action only");
}

#[test]
fn windows_follow_their_history() {
    let episodes = episodes();
    let shape = WindowShape {
        batch: 300,
        looks: Looks::Block(3),
        plan: plan(3),
        table: Table::new(Schedule::LADDER, [0, 4], 2, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![3],
        ready_fraction: 0.5,
        hide: Hide::NOTHING,
        beside: Beside::default(),
    };
    let batch = windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(2)).unwrap();
    let (window, history) = (rows(&batch.window), rows(&batch.history.state));
    let (present, observed) = (rows(&batch.history.present), batch.observed.unwrap().squeeze(1).unwrap().to_vec2::<f32>().unwrap());
    let mut imagined_counts = [0; 3];
    for row in 0..shape.batch {
        let first = window[row][0][0];
        let t = first as usize % 100;
        for (position, step) in window[row].iter().enumerate() {
            let at = first + position as f32;
            assert_eq!(*step, [at, -at, (t + position) as f32 / 10.0]);
        }
        for back in 1..=3_usize {
            let real = t >= back;
            assert_eq!(present[row][3 - back][..2], [f32::from(real); 2]);
            assert_eq!(history[row][3 - back][0], if real { first - back as f32 } else { 0.0 });
            if back <= 2 {
                let seen = observed[row][(2 - back) * 3];
                assert_eq!(seen, if real { first - back as f32 } else { 0.0 });
            }
        }
        let with_reward = (1..=3).take_while(|back| t >= *back && present[row][3 - back][2] == 0.0).count();
        let at = row_of(&batch.at[row]);
        assert!(at < 8);
        if at < shape.table.ready().unwrap() {
            assert!(batch.imagined[row] == 0 && with_reward == 0, "only a window at READY has imagined steps behind it");
        }
        if t >= 3 {
            assert_eq!(batch.imagined[row] == 0, with_reward == 0);
            imagined_counts[with_reward] += 1;
        }
    }
    assert!(imagined_counts.iter().all(|count| *count > 0), "{imagined_counts:?}");
    let ready = batch.at.iter().filter(|at| row_of(at) >= shape.table.ready().unwrap()).count();
    assert!((ready as f32 / 300.0 - 0.625).abs() < 0.1, "half, and a quarter of the rest: {ready}");
    let fixed = windows(&episodes, &shape.places(&episodes), &shape, Some(7), &mut Philox::new(2)).unwrap();
    assert!(fixed.at == vec![Standing::Row(7); 300] && fixed.imagined == [0; 300]);
}

/// Fields of the history go missing in training as they do at an act, for the latent and the denoiser alike; what a block has to
/// explain stays whole.
#[test]
fn hidden_fields_are_hidden_from_both_networks() {
    let (episodes, hide) = (episodes(), Hide { state: 0.5, action: 0.5, reward: 0.5 });
    let shape = WindowShape {
        batch: 400,
        looks: Looks::Block(3),
        plan: plan(3),
        table: Table::new(Schedule::LADDER, [0, 4], 1, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![1, 2],
        ready_fraction: 0.5,
        hide,
        beside: Beside::default(),
    };
    let batch = windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(2)).unwrap();
    let (present, state) = (rows(&batch.history.present), rows(&batch.history.state));
    let observed = batch.observed.unwrap().squeeze(1).unwrap().to_vec2::<f32>().unwrap();
    let (window, mut missing) = (rows(&batch.window), [0; 3]);
    for row in 0..shape.batch {
        let steps = window[row][0][0] as usize % 100;
        for back in 1..=steps.min(3) {
            let flags = &present[row][3 - back];
            (0..3).for_each(|part| missing[part] += usize::from(flags[part] == 0.0));
            assert_eq!(state[row][3 - back][0], flags[0] * (window[row][0][0] - back as f32));
            if back <= 2 {
                let seen = &observed[row][(2 - back) * 3..][..3];
                assert_eq!((seen[0], seen[2]), (state[row][3 - back][0], flags[1] * (steps - back) as f32 / 10.0));
            }
            if batch.imagined[row] > 0 && back == 1 {
                assert_eq!(flags[..], [1.0, 1.0, 0.0], "an imagined step is the sampler's own");
            }
        }
        assert!(window[row].iter().all(|step| step[0] != 0.0));
    }
    assert!(missing.iter().all(|count| *count > 100), "{missing:?}");
    let shape = BlockShape {
        batch: 200,
        len: 8,
        looks: Looks::Block(0),
        latent_dim: 2,
        stays: false,
        context: None,
        show_action: 1.0,
        show_reward: 1.0,
        mask_state: 0.0,
        hide,
    };
    let batch = blocks(&episodes, &Places::new(&episodes, 0, 8), &shape, &mut Philox::new(1)).unwrap();
    assert!(rows(&batch.tokens.present).iter().flatten().flatten().all(|flag| *flag == 1.0));
    let (history, successor) = (rows(&batch.history_shown), rows(&batch.successor_shown));
    let hidden = |part: usize| history.iter().filter(|block| block.iter().all(|step| step[part] == 0.0)).count();
    assert!((0..3).all(|part| (30..80).contains(&hidden(part))), "a quarter of the blocks lacks a field altogether");
    assert!(successor.iter().flatten().all(|step| step[0] == 1.0), "the newest state is always there");
    let never = |steps: &[Vec<f32>]| steps.iter().all(|step| step[2] == 0.0);
    let told = history.iter().zip(&successor).filter(|(history, successor)| never(history) && !never(successor)).count();
    assert!(told < 5, "a reward that is never told is not told of the successor, but for all of eight coins: {told}");
}

/// Levels of its own for each position, all of 0 ..= K, whatever row a sampler walks; and a uniform schedule has no READY, so nothing is imagined.
#[test]
fn levels_may_be_drawn_one_by_one() {
    let (episodes, uniform) = (episodes(), Table::new(Schedule::Uniform { steps: 5 }, [0, 4], 1, 8).unwrap());
    let shape = |table, levels| WindowShape {
        batch: 300,
        looks: Looks::Block(3),
        plan: plan(1),
        table,
        levels,
        action_horizons: vec![1, 2],
        ready_fraction: 0.5,
        hide: Hide::NOTHING,
        beside: Beside::default(),
    };
    let draw = |shape: WindowShape| windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(4)).unwrap();
    let mut seen = [0; 9];
    for standing in draw(shape(uniform, Levels::Independent { level_max: 8 })).at {
        let Standing::Levels(levels) = standing else { panic!("{standing:?}") };
        assert_eq!(levels.len(), 4);
        levels.into_iter().for_each(|level| seen[level] += 1);
    }
    assert!(seen.iter().all(|count| (80..190).contains(count)), "{seen:?}");
    let batch = draw(shape(uniform, Levels::Schedule));
    assert!(batch.at.iter().all(|at| row_of(at) < 5) && batch.imagined == [0; 300]);
}

/// The second of two episodes of 5 and 12 steps, numbers as in [`episodes`]: t / 10 of the first, 100 + t / 10 of the second.
fn following() -> Episode {
    following_as(false)
}

fn following_as(play: bool) -> Episode {
    let states = (0..17).flat_map(|row| if row < 5 { [row as f32, 0.0] } else { [(95 + row) as f32, 0.0] }).collect();
    Episode::among(
        LAYOUT,
        [states, vec![0.5; 17], vec![0.25; 17], Vec::new()],
        Span { rows: 5..17, play, ended: false, before: Some(0..4) },
    )
}

#[test]
fn before_an_episode_lies_a_border_and_the_one_that_it_follows() {
    let episode = following();
    assert_eq!((episode.len(), episode.reach(), episode.alone().reach()), (12, 5, 0));
    let state = |episode: &Episode, t| episode.step(t).unwrap().map(|step| step.state[0]);
    let expected = [None, Some(0.0), Some(1.0), Some(2.0), Some(3.0), None, Some(100.0), Some(101.0)];
    assert_eq!((-6..2).map(|t| state(&episode, t)).collect::<Vec<_>>(), expected);
    assert_eq!((state(&episode, 11), state(&episode, 12)), (Some(111.0), None));
    assert_eq!((-6..2).filter_map(|t| state(&episode.alone(), t)).collect::<Vec<_>>(), [100.0, 101.0]);
}

/// Half of the blocks of an episode that follows another look back into it, as far as they reach, and half do not; what is explained lies in
/// the episode itself.
#[test]
fn blocks_cross_the_border() {
    let episodes = vec![following()];
    for looks in [Looks::Block(3), Looks::Running] {
        let shape = block_shape(400, looks);
        let batch = blocks(&episodes, &shape.places(&episodes), &shape, &mut Philox::new(1)).unwrap();
        let (states, present, valid) = (rows(&batch.tokens.state), rows(&batch.tokens.present), batch.valid.to_vec2::<f32>().unwrap());
        let mut crossed = 0;
        for row in 0..shape.batch {
            let own = (0..shape.len).position(|t| states[row][t][0] >= 100.0).unwrap();
            assert!((0..shape.len - 1).all(|t| valid[row][t] == f32::from(t >= own)), "steps of another episode are explained");
            let earlier: Vec<f32> = (0..own).filter(|t| present[row][*t][0] == 1.0).map(|t| states[row][t][0]).collect();
            if !earlier.is_empty() {
                crossed += 1;
                assert!(own >= 2 && present[row][own - 1] == [0.0; 3], "the border");
                assert_eq!((earlier[earlier.len() - 1], states[row][own][0]), (3.0, 100.0), "what lies on both of its sides");
            }
        }
        assert!((30..340).contains(&crossed), "{looks:?}: {crossed}");
    }
}

/// So do windows, with all that a GRU that runs on has read, and with what the denoiser sees.
#[test]
fn windows_cross_the_border() {
    let (episodes, table) = (vec![following()], Table::new(Schedule::LADDER, [0, 4], 1, 8).unwrap());
    let shape = WindowShape {
        batch: 400,
        looks: Looks::Running,
        plan: plan(3),
        table,
        levels: Levels::Schedule,
        action_horizons: vec![1],
        ready_fraction: 0.5,
        hide: Hide::NOTHING,
        beside: Beside::default(),
    };
    let batch = windows(&episodes, &shape.places(&episodes), &shape, None, &mut Philox::new(1)).unwrap();
    let (window, states, lens) = (rows(&batch.window), rows(&batch.history.state), batch.history_lens.unwrap());
    let observed = rows(&batch.observed.unwrap());
    let mut crossed = 0;
    for row in 0..shape.batch {
        let t = window[row][0][0] as usize - 100;
        let follows = lens[row] == t + 5;
        crossed += usize::from(follows);
        assert!(follows || lens[row] == t);
        assert!(!follows || (0..4).all(|back| states[row][back][0] == back as f32), "from the start of the episode before on");
        // (s, a) of two steps, of which the border is none.
        let last = if t > 0 { 99.0 + t as f32 } else { 0.0 };
        assert_eq!(observed[row][0][3], last);
        assert_eq!(
            observed[row][0][0],
            if t > 1 {
                98.0 + t as f32
            } else if t == 0 && follows {
                3.0
            } else {
                0.0
            }
        );
    }
    assert!((150..250).contains(&crossed), "{crossed}");
}

/// What is meant by a loss is what it draws from.
#[test]
fn play_is_told_from_demonstrations() {
    let sides = Sides { train: [true, false, true].map(following_as).to_vec(), held_out: vec![following_as(false)] };
    let count = |which| (sides.only(which).train.len(), sides.only(which).held_out.len());
    assert_eq!([Which::All, Which::Play, Which::Demonstrations].map(count), [(3, 1), (2, 0), (1, 1)]);
}

/// Each step but the last of an episode, and that one too where something ended it; the next window is that of the step after, whose history has
/// the step itself, or where there is none, the same again.
#[test]
fn transitions_follow_one_another() {
    let whole = episodes();
    let mut ending = whole[1].clone();
    ending.ended = true;
    let episodes = vec![whole[0].clone(), ending];
    let shape = WindowShape {
        batch: 400,
        looks: Looks::Block(3),
        plan: Diffusion { horizon: 1, diffused: Diffused::Action, ..plan(1) },
        table: Table::new(Schedule::Uniform { steps: 5 }, [0, 1], 1, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![1],
        ready_fraction: 0.0,
        hide: Hide::NOTHING,
        beside: Beside::default(),
    };
    let batch = transitions(&episodes, &Places::of_transitions(&episodes), &shape, &mut Philox::new(2)).unwrap();
    let [now, next] = [&batch.now, &batch.next].map(|windows| rows(&windows.window));
    let last = |windows: &WindowBatch| rows(&windows.history.state).into_iter().map(|row| row[2][0]).collect::<Vec<_>>();
    let (before_now, before_next) = (last(&batch.now), last(&batch.next));
    let mut seen = std::collections::BTreeSet::new();
    for row in 0..400 {
        let (state, later) = (now[row][0][0], next[row][0][0]);
        seen.insert(state as usize);
        assert_eq!(batch.rewards[row], -(state % 100.0));
        assert_eq!(batch.ended[row], state == 211.0);
        if batch.ended[row] {
            assert_eq!((later, before_next[row]), (state, before_now[row]));
        } else {
            assert_eq!((later, before_next[row]), (state + 1.0, state));
        }
    }
    assert_eq!(seen, (100..108).chain(200..212).collect());
}

/// What came of skills of three steps: what was done, what it paid, where it led to, and what an act there is given; where something ended the
/// episode with it, the last step's.
#[test]
fn skills_lead_somewhere() {
    let whole = episodes();
    let mut ending = whole[1].clone();
    ending.ended = true;
    let episodes = vec![whole[0].clone(), ending];
    let places = skill_places(&episodes, 3);
    assert_eq!(places, (0..6).map(|t| (0, t)).chain((0..10).map(|t| (1, t))).collect::<Vec<_>>());
    let shape = WindowShape {
        batch: 1,
        looks: Looks::Block(0),
        plan: Diffusion { horizon: 1, diffused: Diffused::Code { dim: 4, steps: 3 }, ..plan(2) },
        table: Table::new(Schedule::Uniform { steps: 5 }, [0, 1], 1, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![1],
        ready_fraction: 0.0,
        hide: Hide::NOTHING,
        beside: Beside::default(),
    };
    let batch = skills(&episodes, &places, [3, 4], &mut Philox::new(2)).unwrap();
    let given = given_after(&episodes, &places, &shape, &mut Philox::new(3)).unwrap();
    let (steps, next, observed) = (rows(&batch.segments.steps), rows(&batch.next_state), rows(&given.observed.unwrap()));
    assert_eq!(batch.segments.eps.dims(), [16, 1, 4]);
    for (row, (episode, start)) in places.into_iter().enumerate() {
        let state = |t: usize| (100 * (episode + 1) + t) as f32;
        let done: Vec<_> = (start..start + 3).map(|t| vec![state(t), -state(t), t as f32 / 10.0]).collect();
        assert_eq!(steps[row], done);
        assert_eq!(batch.rewards[3 * row..3 * row + 3], [0, 1, 2].map(|i| -((start + i) as f32)));
        let ends = (episode, start) == (1, 9);
        assert_eq!(batch.ended[row], ends);
        let led_to = if ends { 11 } else { start + 3 };
        assert_eq!(next[row][0], [state(led_to), -state(led_to)]);
        // The step before it, one of as many as a window has positions ago; then the state of now, without an action.
        let before = [state(led_to - 1), -state(led_to - 1), (led_to - 1) as f32 / 10.0, 1.0];
        assert_eq!(observed[row][0], [before, [state(led_to), -state(led_to), 0.0, 0.0]].concat());
    }
}
