//! Two answers, bit by bit.

use crate::serve::{recording::format::Answer, session::Handle};
use serde::Serialize;
use std::fmt;

/// The first thing that is not as it was recorded.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// Name of the session in the recording.
    pub session: Handle,
    /// How often it had been reset.
    pub episode: u64,
    /// The act.
    pub step: u64,
    /// Where it is in the answer, e.g. `actions[0][2]`; `act` where there is none.
    pub field: String,
    /// What was recorded.
    pub expected: String,
    /// What was found.
    pub found: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { session, episode, step, field, expected, found } = self;
        write!(f, "session {session}, episode {episode}, step {step}: {field} was {expected}, and is {found}")
    }
}

/// The first field that differs, with both values.
pub(super) fn first_difference(expected: &Answer, found: &Answer) -> Option<(String, String, String)> {
    if expected == found && bits(expected) == bits(found) {
        return None;
    }
    let Answer {
        actions,
        latent_mean,
        latent_log_var,
        predicted_state,
        evaluations,
        passes,
        value,
        value_spread,
        start,
        degraded,
        planned_len,
        planned_digest,
    } = expected;
    let told = |field: &str, expected: &dyn fmt::Debug, found: &dyn fmt::Debug| {
        let (expected, found) = (format!("{expected:?}"), format!("{found:?}"));
        (expected != found).then(|| (field.to_owned(), expected, found))
    };
    let list = |field: &str, expected: &[f32], found: &[f32]| {
        let length = told(&format!("{field}.len"), &expected.len(), &found.len());
        length.or_else(|| {
            let differs = |i: &usize| expected[*i].to_bits() != found[*i].to_bits();
            let i = (0..expected.len()).find(differs)?;
            Some((format!("{field}[{i}]"), number(expected[i]), number(found[i])))
        })
    };
    let rows = || {
        let length = told("actions.len", &actions.len(), &found.actions.len());
        let row = |(i, (expected, found)): (usize, (&Vec<f32>, &Vec<f32>))| list(&format!("actions[{i}]"), expected, found);
        length.or_else(|| actions.iter().zip(&found.actions).enumerate().find_map(row))
    };
    let optional = |field: &str, expected: &Option<f32>, found: &Option<f32>| {
        let text = |value: &Option<f32>| value.map_or_else(|| "none".to_owned(), number);
        let (expected, found) = (text(expected), text(found));
        (expected != found).then(|| (field.to_owned(), expected, found))
    };
    rows()
        .or_else(|| told("degraded", degraded, &found.degraded))
        .or_else(|| told("start", start, &found.start))
        .or_else(|| told("evaluations", evaluations, &found.evaluations))
        .or_else(|| told("passes", passes, &found.passes))
        .or_else(|| list("latent_mean", latent_mean, &found.latent_mean))
        .or_else(|| list("latent_log_var", latent_log_var, &found.latent_log_var))
        .or_else(|| list("predicted_state", predicted_state, &found.predicted_state))
        .or_else(|| optional("value", value, &found.value))
        .or_else(|| optional("value_spread", value_spread, &found.value_spread))
        .or_else(|| told("planned_states.len", planned_len, &found.planned_len))
        .or_else(|| told("planned_states (digest)", planned_digest, &found.planned_digest))
}

/// All its numbers: to `==` 0 and -0 are the same.
fn bits(answer: &Answer) -> Vec<u32> {
    let Answer { actions, latent_mean, latent_log_var, predicted_state, value, value_spread, .. } = answer;
    let rows = actions.iter().chain([latent_mean, latent_log_var, predicted_state]).flatten();
    rows.chain(value).chain(value_spread).map(|value| value.to_bits()).collect()
}

/// With its bits: two numbers that differ in the last one may look alike.
fn number(value: f32) -> String {
    format!("{value:?} (0x{:08x})", value.to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{model::agent::Start, serve::recording::format::Bytes};

    fn answer() -> Answer {
        Answer {
            actions: vec![vec![0.5, 0.0], vec![1.0, 2.0]],
            latent_mean: vec![0.25],
            latent_log_var: vec![-1.0],
            predicted_state: vec![3.0, 4.0],
            evaluations: 8,
            passes: 8,
            value: Some(1.5),
            value_spread: None,
            start: Start::Cold,
            degraded: false,
            planned_len: 7,
            planned_digest: Bytes(vec![1, 2]),
        }
    }

    /// Whatever differs is named; a zero of the other sign, and a number in its last bit, too.
    #[test]
    fn every_difference_is_named() {
        assert_eq!(first_difference(&answer(), &answer()), None);
        let named = |change: fn(&mut Answer)| {
            let mut changed = answer();
            change(&mut changed);
            first_difference(&answer(), &changed).unwrap().0
        };
        type Change = (fn(&mut Answer), &'static str);
        let changes: [Change; 15] = [
            (|answer| answer.actions[0][1] = -0.0, "actions[0][1]"),
            (|answer| answer.actions[1][1] = f32::from_bits(2f32.to_bits() + 1), "actions[1][1]"),
            (|answer| drop(answer.actions.pop()), "actions.len"),
            (|answer| answer.actions[0].push(0.0), "actions[0].len"),
            (|answer| answer.latent_mean[0] = 0.0, "latent_mean[0]"),
            (|answer| answer.latent_log_var[0] = 0.0, "latent_log_var[0]"),
            (|answer| answer.predicted_state[1] = 0.0, "predicted_state[1]"),
            (|answer| answer.evaluations = 7, "evaluations"),
            (|answer| answer.passes = 7, "passes"),
            (|answer| answer.value = None, "value"),
            (|answer| answer.value_spread = Some(0.0), "value_spread"),
            (|answer| answer.start = Start::Warm, "start"),
            (|answer| answer.degraded = true, "degraded"),
            (|answer| answer.planned_len = 6, "planned_states.len"),
            (|answer| answer.planned_digest = Bytes(vec![1, 3]), "planned_states (digest)"),
        ];
        for (change, name) in changes {
            assert_eq!(named(change), name);
        }
    }
}
