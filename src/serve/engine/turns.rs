//! Time shared between clients: whoever holds much of a batch lets the others go ahead, until each of them has had as much time.
//!
//! A batch of many acts takes many times as long as one act, so whoever rides along with a client that asks for a hundred at once would wait for
//! all of them. While no client holds more than a quarter of the batch everyone takes part in every evaluation, and that is the usual case.

use std::time::Duration;

/// A client that holds more than this share of a batch, counted in rows, is a heavy one.
const HEAVY_SHARE: usize = 4;

/// Who takes part in a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// Everyone.
    All,
    /// All but the heavy ones.
    Light,
}

/// The clients of a worker's batch.
#[derive(Debug)]
pub(super) struct Turns {
    /// Rows of each client.
    rows: Vec<(u64, usize)>,
    /// Rows above which a client is heavy.
    heavy: usize,
    has_heavy: bool,
    /// Seconds that each light client has had more than each heavy one.
    lead: f64,
}

impl Turns {
    /// For batches of up to so many rows.
    pub fn new(batch_len_max: usize) -> Self {
        Self { rows: Vec::with_capacity(batch_len_max), heavy: batch_len_max / HEAVY_SHARE, has_heavy: false, lead: 0.0 }
    }

    /// Takes note of who holds what: of each act the client and its rows.
    pub fn count(&mut self, acts: impl Iterator<Item = (u64, usize)>) {
        self.rows.clear();
        for (client, rows) in acts {
            match self.rows.iter_mut().find(|(known, _)| *known == client) {
                Some((_, sum)) => *sum += rows,
                None => self.rows.push((client, rows)),
            }
        }
        self.has_heavy = self.rows.iter().any(|(_, rows)| *rows > self.heavy);
    }

    /// Places beyond the batch that are kept for light clients while a heavy one fills it.
    pub fn reserve(&self) -> usize {
        if self.has_heavy { self.heavy } else { 0 }
    }

    /// Whether a client holds more than its share.
    pub fn is_heavy(&self, client: u64) -> bool {
        self.has_heavy && self.rows.iter().any(|(known, rows)| *known == client && *rows > self.heavy)
    }

    /// Who takes part in the next tick. The light ones may be ahead by `credit` at most.
    pub fn part(&self, credit: Duration) -> Part {
        let (heavy, light) = self.clients();
        if heavy > 0 && light > 0 && self.lead < credit.as_secs_f64() { Part::Light } else { Part::All }
    }

    /// Takes note of a tick.
    pub fn took(&mut self, part: Part, time: Duration) {
        let ((heavy, light), time) = (self.clients(), time.as_secs_f64());
        self.lead = match part {
            Part::Light => self.lead + time / light.max(1) as f64,
            Part::All => (self.lead - time / heavy.max(1) as f64).max(0.0),
        };
    }

    /// Heavy ones, and light ones.
    fn clients(&self) -> (usize, usize) {
        let heavy = self.rows.iter().filter(|(_, rows)| *rows > self.heavy).count();
        (heavy, self.rows.len() - heavy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alike_clients_share_every_tick() {
        let mut turns = Turns::new(8);
        for clients in [vec![], vec![1; 8], vec![1, 1, 2, 2, 3, 3], vec![1, 1, 1, 2, 2, 2]] {
            turns.count(clients.iter().map(|client| (*client, 1)));
            assert_eq!(turns.part(Duration::from_millis(5)), Part::All, "{clients:?}");
        }
    }

    /// One act beside eight of another client goes ahead, and in the long run both have as much time.
    #[test]
    fn the_heavy_one_lets_the_others_go_ahead() {
        let (mut turns, [short, long]) = (Turns::new(8), [1, 10].map(Duration::from_millis));
        turns.count([(7, 1); 8].into_iter().chain([(9, 1)]));
        assert!(turns.is_heavy(7) && !turns.is_heavy(9) && turns.reserve() == 2);
        let (mut of_light, mut of_heavy) = (Duration::ZERO, Duration::ZERO);
        for tick in 0..1000 {
            let part = turns.part(long);
            assert!(tick >= 10 || part == Part::Light, "it has credit for a whole act");
            let time = if part == Part::Light { short } else { long };
            turns.took(part, time);
            *(if part == Part::Light { &mut of_light } else { &mut of_heavy }) += time;
        }
        let share = of_light.as_secs_f64() / (of_light + of_heavy).as_secs_f64();
        assert!((share - 0.5).abs() < 0.02, "{share}");
        turns.count([(7, 1); 8].into_iter());
        (0..9).for_each(|_| turns.took(Part::All, long));
        assert_eq!(turns.lead, 0.0, "nothing is saved up");
    }

    /// One act of many candidates takes as long as many acts.
    #[test]
    fn an_act_of_many_rows_is_heavy() {
        let mut turns = Turns::new(8);
        turns.count([(7, 3), (9, 1)].into_iter());
        assert!(turns.is_heavy(7) && !turns.is_heavy(9) && turns.reserve() == 2);
        assert_eq!(turns.part(Duration::from_millis(5)), Part::Light);
    }
}
