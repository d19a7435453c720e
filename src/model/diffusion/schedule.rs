//! The table of noise levels that a window walks down (section 4.1 of the paper, `k_i = i K / T`): a row for each network evaluation, a
//! level for each position. A new schedule is an arm in the functions of this file.
//!
//! It is told, not stored: a fine ladder over a long window would take `n T^2` numbers.
//!
//! *Ladder.* Row m, position i sits at fine level `f_i(m) = clip(G + n i - m, 0, G)` with `G = n T`: positions fall one after the other,
//! and at row `READY = n (T - 1)` the window is the paper's (k_1, ..., k_T). From there n rows take position 0 to clean; a window that then
//! drops it and takes in a fresh position at pure noise is at READY again, so streaming and cold starts walk the same table.
//!
//! Where position 0 is wholly known (states alone), it stands clean in every row, and position 1 is the first that falls: the same ladder over
//! `T - 1` positions (algorithm 3 of the paper, type (ii)).
//!
//! *Uniform.* All positions fall together, as in Diffuser (Janner et al. 2022), and are clean together: `f_i(m) = G - m`.

use crate::model::method::{Diffusion, RungMap, Schedule};

/// Levels of every position in every row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table {
    schedule: Schedule,
    horizon: usize,
    /// The first position that falls; those before it stand clean.
    first_free: usize,
    sub_steps: usize,
    level_max: usize,
}

impl Table {
    /// The table of a plan with `sub_steps` a rung (n).
    ///
    /// # Errors
    /// A message if a size is zero or levels would repeat.
    pub fn of(plan: &Diffusion, sub_steps: usize) -> Result<Self, String> {
        Self::new(plan.schedule, [plan.diffused.first_free(), plan.horizon], sub_steps, plan.level_max)
    }

    /// The table for positions `first_free..horizon` (T), `sub_steps` a rung (n), `level_max` levels (K).
    ///
    /// # Errors
    /// As of [`Self::of`].
    pub fn new(schedule: Schedule, [first_free, horizon]: [usize; 2], sub_steps: usize, level_max: usize) -> Result<Self, String> {
        let table = Self { schedule, horizon, first_free, sub_steps, level_max };
        let free = horizon.saturating_sub(first_free);
        if free == 0 {
            return Err(format!("needs a horizon above {first_free}, got {horizon}"));
        }
        match schedule {
            Schedule::Ladder { .. } => {
                if sub_steps == 0 || sub_steps.checked_mul(free).is_none_or(|rows| rows > level_max) {
                    return Err(format!("needs 1 <= sub_steps * positions <= level_max, got {sub_steps} * {free} and {level_max}"));
                }
            }
            Schedule::Uniform { steps } => {
                if sub_steps != 1 || !(1..=level_max).contains(&steps) {
                    return Err(format!(
                        "needs 1 sub-step and 1 <= steps <= level_max of a uniform schedule, got {sub_steps}, {steps} and {level_max}"
                    ));
                }
            }
        }
        Ok(table)
    }

    /// Positions that fall.
    fn free(&self) -> usize {
        self.horizon - self.first_free
    }

    /// Number of fine levels (G).
    pub fn fine_max(&self) -> usize {
        match self.schedule {
            Schedule::Ladder { .. } => self.free() * self.sub_steps,
            Schedule::Uniform { steps } => steps,
        }
    }

    /// Row at which the first position that falls is clean, and an action is there: so many evaluations lead there from pure noise, one in each
    /// row above.
    pub fn emit(&self) -> usize {
        self.fine_max()
    }

    /// Row at which position 0 is refined, and at which the window stands again when that position has been given out; none where all
    /// positions are clean at once.
    pub fn ready(&self) -> Option<usize> {
        match self.schedule {
            Schedule::Ladder { .. } => Some(self.sub_steps * (self.free() - 1)),
            Schedule::Uniform { .. } => None,
        }
    }

    /// Rows from READY to the next clean position (n): what each further action of a chunk costs.
    pub fn rung(&self) -> usize {
        match self.schedule {
            Schedule::Ladder { .. } => self.sub_steps,
            Schedule::Uniform { .. } => 0,
        }
    }

    /// Fine level of position `i` in row `m`.
    pub fn fine(&self, m: usize, i: usize) -> usize {
        let Some(place) = i.checked_sub(self.first_free) else { return 0 };
        let late = match self.schedule {
            Schedule::Ladder { .. } => self.sub_steps * place,
            Schedule::Uniform { .. } => 0,
        };
        (self.fine_max() + late).saturating_sub(m).min(self.fine_max())
    }

    /// Diffusion level of a fine level, 0 ..= level_max.
    pub fn level(&self, fine: usize) -> usize {
        let (max, level_max) = (self.fine_max(), self.level_max);
        let curved = |steepness: f64| {
            let level = (level_max as f64 * s_curve(fine as f64 / max as f64, steepness)).round() as usize;
            // At the flat ends as steep as whole levels can be.
            level.max(fine).min(level_max - (max - fine))
        };
        match self.schedule {
            Schedule::Ladder { map: RungMap::Linear } | Schedule::Uniform { .. } => (2 * fine * level_max + max) / (2 * max),
            Schedule::Ladder { map: RungMap::Logistic } => curved(6.0),
            Schedule::Ladder { map: RungMap::Sigmoid } => curved(3.0),
        }
    }

    /// Diffusion levels of row `m`, one a position.
    pub fn row(&self, m: usize) -> Vec<usize> {
        (0..self.horizon).map(|i| self.level(self.fine(m, i))).collect()
    }
}

/// From 0 to 1 over `u` from 0 to 1 by the logistic function on `-a..a`.
fn s_curve(u: f64, a: f64) -> f64 {
    let logistic = |x: f64| 1.0 / (1.0 + (-x).exp());
    (logistic(a * (2.0 * u - 1.0)) - logistic(-a)) / (logistic(a) - logistic(-a))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ladder(horizon: usize, sub_steps: usize, level_max: usize) -> Result<Table, String> {
        Table::new(Schedule::LADDER, [0, horizon], sub_steps, level_max)
    }

    fn end(table: &Table) -> usize {
        table.emit() + table.rung() * (table.horizon - 1)
    }

    #[test]
    fn four_positions_one_sub_step() {
        let ladder = super::tests::ladder(4, 1, 4).unwrap();
        let rows: Vec<_> = (0..=end(&ladder)).map(|m| ladder.row(m)).collect();
        let expected = [[4, 4, 4, 4], [3, 4, 4, 4], [2, 3, 4, 4], [1, 2, 3, 4], [0, 1, 2, 3], [0, 0, 1, 2], [0, 0, 0, 1], [0, 0, 0, 0]];
        assert_eq!(rows, expected.map(|row| row.to_vec()));
        assert_eq!((ladder.ready().unwrap(), ladder.emit()), (3, 4));
    }

    /// With one sub-step a level, the ladder is the pyramid of diffusion forcing (Chen et al. 2024): a matrix of
    /// `K + (T - 1) u + 1` rows in which position i starts `i u` rows late, with `u = K / T`.
    #[test]
    fn full_resolution_is_the_pyramid() {
        let (horizon, level_max, delay) = (4, 20, 5);
        let ladder = super::tests::ladder(horizon, delay, level_max).unwrap();
        assert_eq!(end(&ladder) + 1, level_max + (horizon - 1) * delay + 1);
        for m in 0..=end(&ladder) {
            let pyramid: Vec<i64> = (0..4).map(|i| (20 + i * 5 - m as i64).clamp(0, 20)).collect();
            assert_eq!(ladder.row(m), pyramid.into_iter().map(|level| level as usize).collect::<Vec<_>>());
        }
    }

    #[test]
    fn too_few_levels_are_refused() {
        assert!(ladder(16, 2, 31).is_err());
        assert!(ladder(16, 2, 32).is_ok());
    }

    /// (2^61 + 1) sub-steps of 8 positions wrapped around to 8 rows and were taken.
    #[test]
    fn sizes_do_not_wrap_around() {
        assert!(ladder(8, (1 << 61) + 1, 8).is_err());
    }

    proptest! {
        /// Levels never rise on the way down, never fall along the window, and after READY one position comes clean every n rows.
        #[test]
        fn monotone(horizon in 1_usize..20, sub_steps in 1_usize..5, extra in 0_usize..100) {
            let ladder = super::tests::ladder(horizon, sub_steps, horizon * sub_steps + extra).unwrap();
            let clean = |m| ladder.row(m).iter().filter(|level| **level == 0).count();
            for m in 0..end(&ladder) {
                let (now, next) = (ladder.row(m), ladder.row(m + 1));
                prop_assert!(now.iter().zip(&next).all(|(a, b)| a >= b));
                prop_assert!(now.windows(2).all(|pair| pair[0] <= pair[1]));
                prop_assert_eq!(clean(m), m.saturating_sub(ladder.ready().unwrap()) / sub_steps);
            }
            prop_assert_eq!(clean(end(&ladder)), horizon);
        }

        /// A window at `emit`, shifted by one with a fresh position at the top, is at READY: the streaming invariant.
        #[test]
        fn shift_is_ready(horizon in 1_usize..20, sub_steps in 1_usize..5) {
            let ladder = super::tests::ladder(horizon, sub_steps, 3 * horizon * sub_steps).unwrap();
            let mut shifted = ladder.row(ladder.emit()).split_off(1);
            shifted.push(ladder.level_max);
            prop_assert_eq!(shifted, ladder.row(ladder.ready().unwrap()));
        }
    }

    /// Of states alone position 0 is known: it stands clean, and the others are the ladder of one position fewer; shifted, they stand at READY.
    #[test]
    fn a_known_position_stands_clean() {
        let table = Table::new(Schedule::LADDER, [1, 4], 1, 3).unwrap();
        let rows: Vec<_> = (0..=table.emit()).map(|row| table.row(row)).collect();
        assert_eq!(rows, [[0, 3, 3, 3], [0, 2, 3, 3], [0, 1, 2, 3], [0, 0, 1, 2]].map(|row| row.to_vec()));
        assert_eq!(table.ready(), Some(2));
        let mut shifted = table.row(table.emit()).split_off(1);
        shifted.push(3);
        assert_eq!(shifted, table.row(2));
        assert!(Table::new(Schedule::LADDER, [1, 1], 1, 3).is_err());
        let uniform = Table::new(Schedule::Uniform { steps: 2 }, [1, 3], 1, 20).unwrap();
        assert_eq!([0, 1, 2].map(|row| uniform.row(row)), [[0, 20, 20], [0, 10, 10], [0, 0, 0]].map(|row| row.to_vec()));
    }

    /// The rungs of the S-curves by the formula of the paper's appendix, and that no two fine levels share a level, however fine.
    #[test]
    fn s_curves_rise_with_every_rung() {
        let rungs = |map, horizon: usize, level_max| {
            let table = Table::new(Schedule::Ladder { map }, [0, horizon], 1, level_max).unwrap();
            (0..=horizon).map(|rung| table.level(rung)).collect::<Vec<_>>()
        };
        assert_eq!(rungs(RungMap::Sigmoid, 8, 40), [0, 2, 6, 12, 20, 28, 34, 38, 40]);
        assert_eq!(rungs(RungMap::Logistic, 8, 40), [0, 1, 2, 7, 20, 33, 38, 39, 40]);
        for map in [RungMap::Logistic, RungMap::Sigmoid, RungMap::Linear] {
            for (horizon, level_max) in [(16, 150), (7, 7), (20, 23), (31, 1000)] {
                let levels = rungs(map, horizon, level_max);
                assert!(levels.windows(2).all(|pair| pair[0] < pair[1]), "{map:?} {levels:?}");
                assert_eq!((levels[0], levels[horizon]), (0, level_max));
            }
        }
    }

    /// All positions fall together; after the last row all of them are clean, and nothing is refined on the way.
    #[test]
    fn uniform_rows_are_level() {
        let table = Table::new(Schedule::Uniform { steps: 4 }, [0, 3], 1, 20).unwrap();
        let rows: Vec<_> = (0..=table.emit()).map(|row| table.row(row)).collect();
        assert_eq!(rows, [20, 15, 10, 5, 0].map(|level| vec![level; 3]));
        assert_eq!((table.ready(), table.rung()), (None, 0));
    }

    #[test]
    fn uniform_steps_that_repeat_levels_are_refused() {
        let refused = |steps, sub_steps| Table::new(Schedule::Uniform { steps }, [0, 3], sub_steps, 20).is_err();
        assert!(refused(0, 1) && refused(21, 1) && refused(4, 2) && !refused(20, 1));
    }
}
