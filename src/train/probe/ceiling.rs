//! The ceiling of the probe: how much of the context ridge regression finds in the raw tokens themselves.
//!
//! Two steps, so that it stays tractable for wide states: quadratic features of one transition (s, a, r, s') give an estimate of the
//! context at its time, then a linear filter over the estimates of a block, or of the whole past in a few averages. Each data set is read
//! once, and what is kept does not grow with its episodes.
//!
//! Each with actions and without any: an expert acts on the context that it sees, so its actions tell it, which those of an agent do not
//! (they follow from what it believes). What an agent can know lies between the two or beyond: without actions nobody knows the own push
//! either, behind which an expert may hide the context altogether, and the states that its actions led to are still there.

use super::{
    Features, Place, Score, Source, Subjects,
    past::Past,
    places,
    score::{self, score},
    state::told_by_state,
    steps, stride,
};
use crate::{
    model::{latent::Evidence, method::Looks},
    train::{
        dataset::{Episode, rows::pieces},
        ridge::{Ridge, Table},
    },
};
use anyhow::Result;
use std::{io, ops::RangeInclusive};

/// Penalties of the two steps; the first has about a thousand features.
const LAMBDA: (f64, f64) = (1e-3, 1e-6);
/// Rows on which the first step is fitted.
const FIT_ROWS: usize = 12_000;
/// The same where a sentence wants to know, and steps of the episodes that are then read.
const HELD_ROWS: (usize, usize) = (4_000, 100_000);
/// Transitions whose features are made at once.
const CHUNK: usize = 4096;
/// Estimates that the filter over the whole past has one by one, at the least.
const LAGS_MIN: usize = 10;

/// What the two ceilings look at.
const SOURCES: [Source; 2] = [Source::Ceiling, Source::CeilingWithoutActions];

/// Ceilings of blocks of these lengths and of the whole past, without the successor and with its state (a whole successor token adds an
/// action that tells of its own step, so it has no ceiling), at t; and up to `ahead` steps later of what a decision has. The whole past is
/// measured where the model's `own` block is whole, so that the two compare.
///
/// # Errors
/// If an episode cannot be read.
pub fn ceiling(subjects: &Subjects, own: Looks, block_lens: &[usize], ahead: usize) -> Result<Vec<Score>> {
    let lags = block_lens.iter().copied().max().unwrap_or(0).max(LAGS_MIN);
    let looks: Vec<Looks> = block_lens.iter().copied().map(Looks::Block).chain([Looks::Running]).collect();
    let mut scores = Vec::new();
    for source in SOURCES {
        let filter = Filter::new(subjects, source, (FIT_ROWS, lags))?;
        for looks in &looks {
            for evidence in [Evidence::Filter, Evidence::SuccessorState] {
                let last = if evidence == Evidence::Filter { ahead } else { 0 };
                scores.extend(filter.scores((*looks, own), evidence, 0..=last)?);
            }
        }
    }
    Ok(scores)
}

/// What the raw tokens hold of the context for a decision, actions among them: standardised errors on held-out episodes, where a block lies
/// whole in the episode.
#[derive(Clone, Copy, Debug)]
pub struct Held {
    /// Over as many tokens as the model looks at.
    pub looked_at: f64,
    /// Over the whole past of the episode.
    pub whole_past: f64,
    /// By the state at that moment alone.
    pub state: f64,
}

/// The ceilings that a sentence names: from fewer places and, of a large data set, some of its episodes, so that it takes seconds.
///
/// # Errors
/// If an episode cannot be read.
pub fn held(subjects: &Subjects, looks: Looks) -> io::Result<Held> {
    let (train, held_out) = (some(subjects.train, HELD_ROWS.1), some(subjects.held_out, HELD_ROWS.1));
    let subjects = Subjects { train: &train, held_out: &held_out, rows_max: subjects.rows_max };
    let filter = Filter::new(&subjects, Source::Ceiling, (HELD_ROWS.0, looks.block_len().max(LAGS_MIN)))?;
    let error = |past| -> io::Result<f64> { Ok(filter.scores((past, looks), Evidence::Filter, 0..=0)?[0].errors.whole) };
    let state = told_by_state(&subjects, HELD_ROWS.0)?;
    Ok(Held { looked_at: error(looks)?, whole_past: error(Looks::Running)?, state })
}

/// Episodes evenly among these, of about so many steps together at most.
fn some(episodes: &[Episode], steps_max: usize) -> Vec<Episode> {
    episodes.iter().step_by(stride(episodes, steps_max)).cloned().collect()
}

/// Estimates of the context from single transitions, and features of the past of them at the places of both sides.
struct Filter<'a> {
    source: Source,
    dim: usize,
    lags: usize,
    fit: Features<'a>,
    test: Features<'a>,
}

impl<'a> Filter<'a> {
    /// The first step fitted on so many rows, the second with so many single estimates.
    fn new(subjects: &Subjects<'a>, source: Source, (fit_rows, lags): (usize, usize)) -> io::Result<Self> {
        let (fit_on, truth) = transitions(source, subjects.train, &places(subjects.train, fit_rows))?;
        let ridge = Ridge::fit(&fit_on, &truth, LAMBDA.0);
        let of = |episodes| filtered(&ridge, source, episodes, (subjects.rows_max, lags));
        Ok(Self { source, dim: truth.width, lags, fit: of(subjects.train)?, test: of(subjects.held_out)? })
    }

    /// Errors of the context at t and later, by a block or, where the model's `own` is whole, by the whole past.
    fn scores(&self, (looks, own): (Looks, Looks), evidence: Evidence, ahead: RangeInclusive<usize>) -> io::Result<Vec<Score>> {
        let (block, from) = match looks {
            Looks::Block(len) => (Some(len), len),
            Looks::Running => (None, own.block_len()),
        };
        let columns = Past::columns(self.dim, self.lags, block, evidence != Evidence::Filter);
        let (fit, test) = (self.fit.columns(columns.clone()), self.test.columns(columns));
        let line = |ahead: usize| {
            let shift = ahead as i32;
            let errors = score(&fit, &test, shift, from, LAMBDA.1)?;
            Ok(Score { source: self.source, evidence, looks, ahead, shift, errors })
        };
        ahead.map(line).collect()
    }
}

/// Features of the past at the places of these episodes, each read once from its start; a long one's transitions would not fit into memory.
fn filtered<'a>(ridge: &Ridge, source: Source, episodes: &'a [Episode], size: (usize, usize)) -> io::Result<Features<'a>> {
    let (rows_max, lags) = size;
    let (places, dim) = (places(episodes, rows_max), ridge.offset().len());
    let mut table = Table::new(Past::width(dim, lags));
    for places in places.chunk_by(|a, b| a.0 == b.0) {
        let (index, mut wanted) = (places[0].0, places.iter().map(|(_, t)| *t).peekable());
        let mut past = Past::new(dim, lags);
        for piece in pieces(0..steps(&episodes[index]), CHUNK) {
            let at: Vec<Place> = piece.clone().map(|t| (index, t)).collect();
            let mut estimates = ridge.predict(&transitions(source, episodes, &at)?.0);
            for (t, estimate) in piece.zip(estimates.values.chunks_mut(dim)) {
                estimate.iter_mut().zip(ridge.offset()).for_each(|(estimate, known)| *estimate -= known);
                if wanted.next_if_eq(&t).is_some() {
                    past.features(estimate, &mut table.values);
                }
                past.push(estimate);
            }
        }
    }
    Ok(score::Features { episodes, places, table })
}

/// Quadratic features of the transitions at these places, and the context there.
fn transitions(source: Source, episodes: &[Episode], places: &[Place]) -> io::Result<(Table, Table)> {
    let dim = episodes.first().map_or(0, |episode| episode.context_dim);
    let (mut features, mut truth) = (Table::new(0), Table::new(dim));
    for (episode, t) in places {
        let episode = &episodes[*episode];
        let (state, action, reward, next) = (episode.state(*t)?, episode.action(*t)?, episode.reward(*t)?, episode.state(t + 1)?);
        let action: &[f32] = if source == Source::CeilingWithoutActions { &[] } else { &action };
        let parts = [&*state, action, &[reward], &*next];
        features.push_quadratic(&parts.into_iter().flatten().map(|value| f64::from(*value)).collect::<Vec<_>>());
        truth.values.extend(episode.context(*t)?.iter().map(|value| f64::from(*value)));
    }
    Ok((features, truth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{noise::Philox, trajectory::Layout};

    /// s' = s / 2 + a + c with a context c drawn anew at each step: a transition tells all of it, the past nothing.
    fn sudden(rng: &mut Philox) -> Episode {
        let mut noise = || (0..40).map(|_| rng.normal()).collect::<Vec<f32>>();
        let (actions, context, rewards) = (noise(), noise(), vec![0.0; 40]);
        let mut states = vec![0.0];
        for t in 0..39 {
            states.push(0.5 * states[t] + actions[t] + context[t]);
        }
        Episode::of(LAYOUT, [states, actions, rewards, context])
    }

    /// A context that stays, of variance 1, and an action that is it; states are noise, so that nothing else tells.
    fn leaking(rng: &mut Philox) -> Episode {
        let context = vec![rng.normal(); 40];
        let states = (0..40).map(|_| rng.normal()).collect();
        Episode::of(LAYOUT, [states, context.clone(), vec![0.0; 40], context])
    }

    /// A context that stays, of variance 1, and rewards that are it with noise of variance 100.
    fn faint(rng: &mut Philox) -> Episode {
        let context = rng.normal();
        let mut noise = || (0..400).map(|_| rng.normal()).collect::<Vec<f32>>();
        let (states, actions, rewards) = (noise(), noise(), noise());
        let rewards = rewards.iter().map(|noise| context + 10.0 * noise).collect();
        Episode::of(LAYOUT, [states, actions, rewards, vec![context; 400]])
    }

    const LAYOUT: Layout = Layout { state_dim: 1, action_dim: 1 };

    fn episodes(count: usize, seed: u64, of: impl Fn(&mut Philox) -> Episode) -> Vec<Episode> {
        let mut rng = Philox::new(seed);
        (0..count).map(|_| of(&mut rng)).collect()
    }

    fn ceilings(of: impl Fn(&mut Philox) -> Episode, counts: (usize, usize), ahead: usize) -> Vec<Score> {
        let (train, held_out) = (episodes(counts.0, 1, &of), episodes(counts.1, 2, &of));
        ceiling(&Subjects { train: &train, held_out: &held_out, rows_max: 100_000 }, Looks::Running, &[1, 3], ahead).unwrap()
    }

    #[test]
    fn knows_what_a_transition_tells_and_no_more() {
        for score in ceilings(sudden, (40, 10), 1).into_iter().filter(|score| score.source == Source::Ceiling) {
            let tells = score.evidence == Evidence::SuccessorState;
            assert!(if tells { score.errors.whole < 0.01 } else { score.errors.whole > 0.9 }, "{score:?}");
        }
    }

    /// An action that is the context: the past tells it exactly with actions, and nothing of it without.
    #[test]
    fn what_actions_leak_is_told_apart() {
        let scores = ceilings(leaking, (200, 200), 2);
        assert_eq!(scores.len(), 2 * 3 * (1 + 2 + 1));
        for score in scores {
            let Score { source, looks, errors, .. } = score;
            match source {
                Source::Ceiling if looks == Looks::Running => assert!(errors.ages[1] < 0.01 && errors.ages[2] < 0.01, "{score:?}"),
                Source::Ceiling => assert!(errors.whole < 1e-3, "{score:?}"),
                Source::CeilingWithoutActions | Source::Latent | Source::State | Source::LatentAndState => {
                    assert!(errors.whole > 0.9 && errors.ages[1] > 0.9, "{score:?}")
                }
            }
        }
    }

    /// A longer look is never worse where both can look.
    #[test]
    fn the_whole_past_compares_with_the_block() {
        let (train, held_out) = (episodes(200, 1, leaking), episodes(200, 2, leaking));
        let subjects = Subjects { train: &train, held_out: &held_out, rows_max: 100_000 };
        let both = held(&subjects, Looks::Block(3)).unwrap();
        assert!(both.looked_at < 1e-3 && both.whole_past < 2e-3, "{both:?}");
        let all = held(&subjects, Looks::Running).unwrap();
        assert!(all.whole_past > 0.01, "at the first step nothing is known: {all:?}");
    }

    /// Of n rewards a Gaussian's posterior leaves 1 / (1 + n / 100), which no block of ten comes near.
    #[test]
    fn the_whole_past_is_remembered() {
        let scores = ceilings(faint, (400, 400), 0);
        let of = |looks| {
            let found =
                scores.iter().find(|score| (score.source, score.evidence, score.looks) == (Source::Ceiling, Evidence::Filter, looks));
            found.unwrap().errors
        };
        let left = |ages: std::ops::Range<usize>| ages.clone().map(|n| 1.0 / (1.0 + n as f64 / 100.0)).sum::<f64>() / ages.len() as f64;
        let whole = of(Looks::Running);
        for (error, expected) in whole.ages.into_iter().zip([left(0..10), left(10..30), left(30..80), left(80..399)]) {
            assert!((error - expected).abs() < 0.08, "{error}, not {expected}: {whole:?}");
        }
        assert!((whole.whole - left(0..399)).abs() < 0.06, "{whole:?}, not {}", left(0..399));
        assert!(of(Looks::Block(3)).whole > 0.9, "{:?}", of(Looks::Block(3)));
    }
}
