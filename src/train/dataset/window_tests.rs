//! Every number of a batch says where it comes from, so what is cut, hidden and shown can be read off.

use super::*;
use crate::model::method::Schedule;

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

fn row_of(standing: &Standing) -> usize {
    match standing {
        Standing::Row(row) => *row,
        Standing::Levels(_) => panic!("a row"),
    }
}

fn rows(tensor: &Tensor) -> Vec<Vec<Vec<f32>>> {
    tensor.to_vec3().unwrap()
}

#[test]
fn blocks_run_into_an_episode_and_never_out_of_it() {
    let episodes = episodes();
    let shape = BlockShape {
        batch: 200,
        len: 8,
        looks: Looks::Block(3),
        latent_dim: 2,
        stays: false,
        context: None,
        show_action: 0.5,
        show_reward: 0.5,
        hide: Hide::NOTHING,
    };
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
        horizon: 4,
        looks: Looks::Block(3),
        obs_horizon: 3,
        table: Table::new(Schedule::Ladder, 4, 2, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![3],
        ready_fraction: 0.5,
        hide: Hide::NOTHING,
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
        horizon: 4,
        looks: Looks::Block(3),
        obs_horizon: 3,
        table: Table::new(Schedule::Ladder, 4, 1, 8).unwrap(),
        levels: Levels::Schedule,
        action_horizons: vec![1, 2],
        ready_fraction: 0.5,
        hide,
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
    let (episodes, uniform) = (episodes(), Table::new(Schedule::Uniform { steps: 5 }, 4, 1, 8).unwrap());
    let shape = |table, levels| WindowShape {
        batch: 300,
        horizon: 4,
        looks: Looks::Block(3),
        obs_horizon: 1,
        table,
        levels,
        action_horizons: vec![1, 2],
        ready_fraction: 0.5,
        hide: Hide::NOTHING,
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
