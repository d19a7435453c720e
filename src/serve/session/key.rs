//! What "the same observation" means for a repeated step.

use crate::model::agent::{Executed, Observation};
use sha2::{Digest, Sha256};

/// SHA-256 of an observation.
pub type Key = [u8; 32];

/// Key of an observation: every value by its bits, every absence by a mark, every list by its length.
pub fn key_of(observation: &Observation) -> Key {
    let Observation { state, executed, nothing_executed, context } = observation;
    let mut hash = Sha256::new();
    hash.update([u8::from(*nothing_executed), u8::from(context.is_some())]);
    hash.update((executed.len() as u64).to_le_bytes());
    let mut put = |values: Option<&[f32]>| {
        hash.update(values.map_or(u64::MAX, |values| values.len() as u64).to_le_bytes());
        for value in values.into_iter().flatten() {
            hash.update(value.to_bits().to_le_bytes());
        }
    };
    put(Some(state));
    for Executed { state, action, reward } in executed {
        put(state.as_deref());
        put(action.as_deref());
        put(reward.as_ref().map(std::slice::from_ref));
    }
    context.iter().flatten().for_each(|row| put(Some(row)));
    hash.finalize().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whatever differs in meaning differs in key, also where the flat list of numbers is the same.
    #[test]
    fn keys_tell_observations_apart() {
        let step = |state: Option<&[f32]>, action: Option<&[f32]>, reward| Executed {
            state: state.map(<[f32]>::to_vec),
            action: action.map(<[f32]>::to_vec),
            reward,
        };
        let told = |executed| Observation { state: vec![1.0], executed, ..Observation::default() };
        let truth = |context: &[&[f32]]| {
            let context = Some(context.iter().map(|row| row.to_vec()).collect());
            Observation { state: vec![1.0], context, ..Observation::default() }
        };
        let observations = [
            truth(&[]),
            truth(&[&[2.0]]),
            truth(&[&[2.0], &[2.0]]),
            truth(&[&[2.0, 2.0]]),
            Observation { state: vec![1.0, 2.0], ..Observation::default() },
            Observation { state: vec![1.0], ..Observation::default() },
            Observation { state: vec![1.0], nothing_executed: true, ..Observation::default() },
            told(vec![step(Some(&[2.0]), None, None)]),
            told(vec![step(None, Some(&[2.0]), None)]),
            told(vec![step(None, None, Some(2.0))]),
            told(vec![step(None, None, None)]),
            told(vec![step(Some(&[]), None, None)]),
            told(vec![step(None, None, None), step(None, None, None)]),
            Observation { state: vec![0.0], ..Observation::default() },
            Observation { state: vec![-0.0], ..Observation::default() },
        ];
        for (i, a) in observations.iter().enumerate() {
            assert_eq!(key_of(a), key_of(&a.clone()));
            for b in &observations[..i] {
                assert_ne!(key_of(a), key_of(b), "{a:?} {b:?}");
            }
        }
    }
}
