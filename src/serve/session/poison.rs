//! Questions that make the engine fail: each was tried twice, and is not tried again while its session stands where it stood.

use super::{Flight, Key, Session};
use crate::serve::error::ServiceError;
use std::{collections::VecDeque, sync::Arc};
use uuid::Uuid;

/// Questions of one step that are known; of more the first is forgotten, and may be tried once more.
const POISONS_MAX: usize = 16;

/// The questions that failed at the step where the session stands, with what names each in the log.
#[derive(Debug, Default)]
pub(super) struct Poisons(VecDeque<(Key, Uuid)>);

impl Poisons {
    fn remember(&mut self, key: Key, id: Uuid) {
        if self.0.len() >= POISONS_MAX {
            self.0.pop_front();
        }
        self.0.push_back((key, id));
    }

    /// The session goes on: what failed at the step before is of no use any more.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Refuses a question that is among them.
    ///
    /// # Errors
    /// `PoisonStep`.
    pub fn check(&self, step: u64, key: Key) -> Result<(), ServiceError> {
        let Some((_, id)) = self.0.iter().find(|(known, _)| *known == key) else { return Ok(()) };
        metrics::counter!("ada_poison_steps_total", "outcome" => "refused").increment(1);
        Err(ServiceError::PoisonStep { step, id: *id })
    }
}

impl Session {
    /// Ends a flight whose question has made the engine fail twice. The session stands where it stood, and refuses that question from now on.
    pub fn poison(&self, flight: &Arc<Flight>, id: Uuid) {
        {
            let mut slot = self.slot.lock();
            if slot.release(flight) {
                slot.poisons.remember(flight.key, id);
            }
        }
        metrics::counter!("ada_poison_steps_total", "outcome" => "found").increment(1);
        flight.settle(Err(ServiceError::PoisonStep { step: flight.step, id }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn so_many_are_known() {
        let (mut poisons, key) = (Poisons::default(), |index: usize| [index as u8; 32]);
        (0..=POISONS_MAX).for_each(|index| poisons.remember(key(index), Uuid::from_u128(index as u128)));
        assert_eq!(poisons.check(3, key(1)), Err(ServiceError::PoisonStep { step: 3, id: Uuid::from_u128(1) }));
        assert_eq!((poisons.check(3, key(0)), poisons.check(3, key(99))), (Ok(()), Ok(())), "the first is forgotten, others are welcome");
        poisons.clear();
        assert_eq!(poisons.check(3, key(1)), Ok(()));
    }
}
