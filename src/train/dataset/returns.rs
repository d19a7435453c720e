//! What a step of an episode is worth: the discounted mean of the rewards from it on to the episode's end, `sum g^i r_{t+i} / sum g^i`. A mean, not
//! a sum, so that the last steps of an episode that was cut off are not worth less for it.

use super::Episode;
use crate::model::{config::Units, normalizer::Affine};
use std::io;

/// Rewards of less weight than this are left out.
const WEIGHT_MIN: f64 = 1e-4;

/// Returns in the units of the networks.
#[derive(Clone, Debug)]
pub struct Returns {
    discount: f32,
    /// Units of the rewards that episodes hold.
    reward: Affine,
    /// Units of returns.
    units: Affine,
}

impl Returns {
    /// Of a model that has units of returns; none of others.
    pub fn of(discount: f32, units: &Units) -> Option<Self> {
        let reward = units.normalizer.reward.clone();
        units.returns.clone().map(|units| Self { discount, reward, units })
    }

    /// That of step t, standard deviations of the data's returns.
    ///
    /// # Errors
    /// If rows are kept in a file and it cannot be read.
    pub fn at(&self, episode: &Episode, t: usize) -> io::Result<f32> {
        let raw = self.reward.mean[0] + self.reward.std[0] * mean(episode, t, self.discount)?;
        Ok((raw - self.units.mean[0]) / self.units.std[0])
    }
}

/// Discounted mean of the rewards from t on, in the units that the episode holds.
fn mean(episode: &Episode, t: usize, discount: f32) -> io::Result<f32> {
    let (mut sum, mut weights, mut weight) = (0.0, 0.0, 1.0);
    for step in t..episode.len() {
        sum += weight * f64::from(episode.reward(step)?);
        weights += weight;
        weight *= f64::from(discount);
        if weight < WEIGHT_MIN {
            break;
        }
    }
    Ok((sum / weights) as f32)
}

/// Mean and standard deviation of the returns of all steps of these episodes, units of the data.
///
/// # Errors
/// If rows are kept in a file and it cannot be read.
pub fn fit(episodes: &[Episode], discount: f32, reward: &Affine) -> io::Result<Affine> {
    Affine::fit(1, |visit| scan(episodes, discount, reward, &mut |value| visit(&[value])))
}

/// The return that a tenth of all steps of these episodes exceed, units of the data.
///
/// # Errors
/// As [`fit`].
pub fn high(episodes: &[Episode], discount: f32, reward: &Affine) -> io::Result<f32> {
    let mut all = Vec::new();
    scan(episodes, discount, reward, &mut |value| all.push(value))?;
    all.sort_unstable_by(f32::total_cmp);
    Ok(all.get(all.len() * 9 / 10).copied().unwrap_or(0.0))
}

/// Shows the returns of all steps, units of the data.
fn scan(episodes: &[Episode], discount: f32, reward: &Affine, visit: &mut dyn FnMut(f32)) -> io::Result<()> {
    for episode in episodes {
        // From the end on, so that each reward is read once.
        let (mut sum, mut weights) = (0.0, 0.0);
        for t in (0..episode.len()).rev() {
            let raw = reward.mean[0] + reward.std[0] * episode.reward(t)?;
            sum = f64::from(raw) + f64::from(discount) * sum;
            weights = 1.0 + f64::from(discount) * weights;
            visit((sum / weights) as f32);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::trajectory::Layout;

    /// Three rewards 1, 2, 4 in units of 10 with mean 3: by hand, at each step, and in units fitted on them.
    #[test]
    fn returns_by_hand() {
        let layout = Layout { state_dim: 1, action_dim: 1 };
        let episode = Episode::of(layout, [vec![0.0; 3], vec![0.0; 3], vec![1.0, 2.0, 4.0], Vec::new()]);
        let reward = Affine { mean: vec![3.0], std: vec![10.0] };
        let means = [(1.0 + 0.5 * 2.0 + 0.25 * 4.0) / 1.75, (2.0 + 0.5 * 4.0) / 1.5, 4.0].map(|mean| 3.0 + 10.0 * mean);
        let units = fit(std::slice::from_ref(&episode), 0.5, &reward).unwrap();
        let average = means.iter().sum::<f32>() / 3.0;
        assert!((units.mean[0] - average).abs() < 1e-4);
        let mut all = Units::plain(layout);
        (all.normalizer.reward, all.returns) = (reward, Some(units.clone()));
        let returns = Returns::of(0.5, &all).unwrap();
        for (t, mean) in means.into_iter().enumerate() {
            let expected = (mean - units.mean[0]) / units.std[0];
            assert!((returns.at(&episode, t).unwrap() - expected).abs() < 1e-5, "step {t}");
        }
        let highest = means.iter().fold(f32::MIN, |most, mean| most.max(*mean));
        assert!((high(std::slice::from_ref(&episode), 0.5, &all.normalizer.reward).unwrap() - highest).abs() < 1e-4);
        all.returns = None;
        assert!(Returns::of(0.5, &all).is_none());
    }
}
