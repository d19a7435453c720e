//! The table of noise levels that a window walks down (section 4.1 of the paper, `k_i = i K / T`): a row for each network evaluation, a
//! level for each position. A new schedule is an arm in the functions of this file.
//!
//! It is told, not stored: a fine ladder over a long window would take `n T^2` numbers.
//!
//! *Ladder.* Row m, position i sits at fine level `f_i(m) = clip(G + n i - m, 0, G)` with `G = n T`: positions fall one after the other,
//! and at row `READY = n (T - 1)` the window is the paper's (k_1, ..., k_T). From there n rows take position 0 to clean; a window that then
//! drops it and takes in a fresh position at pure noise is at READY again, so streaming and cold starts walk the same table.
//!
//! *Uniform.* All positions fall together, as in Diffuser (Janner et al. 2022), and are clean together: `f_i(m) = G - m`.

use crate::model::method::Schedule;

/// Levels of every position in every row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table {
    schedule: Schedule,
    horizon: usize,
    sub_steps: usize,
    level_max: usize,
}

impl Table {
    /// The table for `horizon` positions (T), `sub_steps` a rung (n), `level_max` levels (K).
    ///
    /// # Errors
    /// A message if a size is zero or levels would repeat.
    pub fn new(schedule: Schedule, horizon: usize, sub_steps: usize, level_max: usize) -> Result<Self, String> {
        let table = Self { schedule, horizon, sub_steps, level_max };
        match schedule {
            Schedule::Ladder => {
                if horizon == 0 || sub_steps == 0 || sub_steps.checked_mul(horizon).is_none_or(|rows| rows > level_max) {
                    return Err(format!("needs 1 <= sub_steps * horizon <= level_max, got {sub_steps} * {horizon} and {level_max}"));
                }
            }
            Schedule::Uniform { steps } => {
                if horizon == 0 || sub_steps != 1 || !(1..=level_max).contains(&steps) {
                    return Err(format!(
                        "needs 1 sub-step and 1 <= steps <= level_max of a uniform schedule, got {sub_steps}, {steps} and {level_max}"
                    ));
                }
            }
        }
        Ok(table)
    }

    /// Number of fine levels (G).
    pub fn fine_max(&self) -> usize {
        match self.schedule {
            Schedule::Ladder => self.horizon * self.sub_steps,
            Schedule::Uniform { steps } => steps,
        }
    }

    /// Row at which position 0 is clean: so many evaluations lead there from pure noise, one in each row above.
    pub fn emit(&self) -> usize {
        self.fine_max()
    }

    /// Row at which position 0 is refined, and at which the window stands again when that position has been given out; none where all
    /// positions are clean at once.
    pub fn ready(&self) -> Option<usize> {
        match self.schedule {
            Schedule::Ladder => Some(self.sub_steps * (self.horizon - 1)),
            Schedule::Uniform { .. } => None,
        }
    }

    /// Rows from READY to the next clean position (n): what each further action of a chunk costs.
    pub fn rung(&self) -> usize {
        match self.schedule {
            Schedule::Ladder => self.sub_steps,
            Schedule::Uniform { .. } => 0,
        }
    }

    /// Fine level of position `i` in row `m`.
    pub fn fine(&self, m: usize, i: usize) -> usize {
        let late = match self.schedule {
            Schedule::Ladder => self.sub_steps * i,
            Schedule::Uniform { .. } => 0,
        };
        (self.fine_max() + late).saturating_sub(m).min(self.fine_max())
    }

    /// Diffusion level of a fine level, 0 ..= level_max.
    pub fn level(&self, fine: usize) -> usize {
        let max = self.fine_max();
        (2 * fine * self.level_max + max) / (2 * max)
    }

    /// Diffusion levels of row `m`, one a position.
    pub fn row(&self, m: usize) -> Vec<usize> {
        (0..self.horizon).map(|i| self.level(self.fine(m, i))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ladder(horizon: usize, sub_steps: usize, level_max: usize) -> Result<Table, String> {
        Table::new(Schedule::Ladder, horizon, sub_steps, level_max)
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

    /// All positions fall together; after the last row all of them are clean, and nothing is refined on the way.
    #[test]
    fn uniform_rows_are_level() {
        let table = Table::new(Schedule::Uniform { steps: 4 }, 3, 1, 20).unwrap();
        let rows: Vec<_> = (0..=table.emit()).map(|row| table.row(row)).collect();
        assert_eq!(rows, [20, 15, 10, 5, 0].map(|level| vec![level; 3]));
        assert_eq!((table.ready(), table.rung()), (None, 0));
    }

    #[test]
    fn uniform_steps_that_repeat_levels_are_refused() {
        let refused = |steps, sub_steps| Table::new(Schedule::Uniform { steps }, 3, sub_steps, 20).is_err();
        assert!(refused(0, 1) && refused(21, 1) && refused(4, 2) && !refused(20, 1));
    }
}
