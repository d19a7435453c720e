//! Double Q-learning over skills (van Hasselt et al. 2016; LDCQ, Venkatraman et al. 2024): what can be done next are skills that the prior draws
//! in the next state, so that the critics are asked of nothing that the data do not show.

use super::Critic;
use candle_core::{Result, Tensor};

/// What came of skills, normalized units: `(B, 1, ..)`.
pub struct SkillTransitions<'a> {
    /// s_t.
    pub state: &'a Tensor,
    /// The code of what was done from t on.
    pub code: &'a Tensor,
    /// The share of its own steps in what it is worth: `(1 - g) sum g^i w_{t+i}` over the H steps, of worths of rewards.
    pub reward: &'a Tensor,
    /// s_{t+H}.
    pub next_state: &'a Tensor,
    /// `(B, N, code_dim)` what can be done there.
    pub next_codes: &'a Tensor,
    /// 1 where the episode ended with the skill by what happened, else 0.
    pub ended: &'a Tensor,
    /// What the time after an end is worth.
    pub end_worth: f64,
    /// How much each counts: 1, or less for what is drawn more often than others (Schaul et al. 2016).
    pub weight: &'a Tensor,
}

impl Critic {
    /// The weighted squared error of both critics, their sum, and for each row how far off they are, in the mean, from what the row shows: the
    /// reward, and `keeps` (g^H) of what the best skill is worth there: the best to these critics, worth what it is to `target`, a slow copy.
    /// Everywhere the lesser of two counts.
    ///
    /// # Errors
    /// If shapes differ.
    pub fn double_errors(&self, target: &Self, of: &SkillTransitions, keeps: f64) -> Result<(Tensor, Vec<f32>)> {
        let (rows, choices, _) = of.next_codes.dims3()?;
        let there = of.next_state.broadcast_as((rows, choices, of.next_state.dim(2)?))?.contiguous()?;
        let best = self.lesser(&there, of.next_codes)?.argmax_keepdim(1)?;
        let later = target.lesser(&there, of.next_codes)?.gather(&best, 1)?.detach();
        let later = ((later * of.ended.affine(-1.0, 1.0)?)? + of.ended.affine(of.end_worth, 0.0)?)?;
        let aim = (of.reward + later.affine(keeps, 0.0)?)?;
        let off = self.q(of.state, of.code, None)?.map(|q| q - &aim);
        let [first, second] = off;
        let (first, second) = (first?, second?);
        let squares = (first.sqr()? + second.sqr()?)?;
        let distances = (first.abs()? + second.abs()?)?.affine(0.5, 0.0)?.flatten_all()?.to_vec1()?;
        Ok(((squares * of.weight)?.mean_all()?, distances))
    }

    fn lesser(&self, state: &Tensor, code: &Tensor) -> Result<Tensor> {
        let [first, second] = self.q(state, code, None)?;
        first.minimum(&second)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Judged;
    use super::*;
    use crate::model::nn::{Params, testing::gaussian};
    use candle_core::Device;

    /// Each row by hand, from what single questions are answered.
    #[test]
    fn errors_by_hand() {
        let judged = Judged { state_dim: 2, choice_dim: 3, latent_dim: 0, state_alone: false };
        let [critic, slow] = [1, 2].map(|seed| Critic::new(judged, 9, &Params::fresh(seed)).unwrap());
        let (rows, choices, keeps) = (3, 5, 0.7);
        let (state, code, next_state) = (gaussian(1, (rows, 1, 2)), gaussian(2, (rows, 1, 3)), gaussian(3, (rows, 1, 2)));
        let (next_codes, reward) = (gaussian(4, (rows, choices, 3)), gaussian(5, (rows, 1, 1)));
        let column = |values: [f32; 3]| Tensor::from_slice(&values, (rows, 1, 1), &Device::Cpu).unwrap();
        let (ended, weight) = (column([0.0, 1.0, 0.0]), column([1.0, 0.5, 0.25]));
        let of = SkillTransitions {
            state: &state,
            code: &code,
            reward: &reward,
            next_state: &next_state,
            next_codes: &next_codes,
            ended: &ended,
            end_worth: -2.0,
            weight: &weight,
        };
        let (loss, distances) = critic.double_errors(&slow, &of, keeps).unwrap();
        let one = |tensor: &Tensor, row: usize, at: usize| tensor.narrow(0, row, 1).unwrap().narrow(1, at, 1).unwrap();
        let pair = |critic: &Critic, state: &Tensor, code: &Tensor| {
            critic.q(state, code, None).unwrap().map(|q| f64::from(q.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0]))
        };
        let number = |tensor: &Tensor, row: usize| f64::from(tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap()[row]);
        let (mut expected, mut differ) = (0.0, false);
        for (row, distance) in distances.iter().enumerate() {
            let lesser = |critic: &Critic, at: usize| {
                let [a, b] = pair(critic, &one(&next_state, row, 0), &one(&next_codes, row, at));
                a.min(b)
            };
            let best = |critic: &Critic| (0..choices).max_by(|a, b| lesser(critic, *a).total_cmp(&lesser(critic, *b))).unwrap();
            differ |= best(&critic) != best(&slow);
            let later = if row == 1 { -2.0 } else { lesser(&slow, best(&critic)) };
            let aim = number(&reward, row) + keeps * later;
            let off = pair(&critic, &one(&state, row, 0), &one(&code, row, 0)).map(|q| q - aim);
            expected += number(&weight, row) * off.iter().map(|off| off * off).sum::<f64>() / rows as f64;
            assert!((f64::from(*distance) - (off[0].abs() + off[1].abs()) / 2.0).abs() < 1e-5);
        }
        assert!((f64::from(loss.to_scalar::<f32>().unwrap()) - expected).abs() < 1e-5);
        assert!(differ, "the best to one copy is not the best to the other, or the test tells nothing");
    }
}
