//! Blocks for the ELBO, cut from episodes at drawn places.

use super::{
    Episode,
    hidden::Hide,
    places::{Places, drawn},
    tokens::TokenRows,
};
use crate::model::{latent::elbo::ElboBatch, method::Looks, noise::Philox, normalizer::Affine, trajectory::Seen};
use candle_core::{Device, Result, Tensor};

/// What a batch of blocks for the ELBO looks like.
#[derive(Clone, Debug)]
pub struct BlockShape {
    /// Blocks in a batch.
    pub batch: usize,
    /// Tokens in a block: `block_len + 1 + length`.
    pub len: usize,
    /// How far the encoder looks back: a block may begin so many steps (T_x) before an episode's start; that of a GRU which runs on begins
    /// there, or in the episode that it follows.
    pub looks: Looks,
    /// Width of the latent.
    pub latent_dim: usize,
    /// Whether columns of it stay, so that one belief has to explain a block.
    pub stays: bool,
    /// Units of the recorded context, of a latent that tells it.
    pub context: Option<Affine>,
    /// Probability that the posterior sees the successor's action.
    pub show_action: f32,
    /// Probability that it sees the successor's reward, given that it sees the action.
    pub show_reward: f32,
    /// Probability that it does not see the successor's state, given that it sees the action: a window of actions has none for it.
    pub mask_state: f32,
    /// What is hidden of the history.
    pub hide: Hide,
}

impl BlockShape {
    /// Where a block may begin.
    pub fn places(&self, episodes: &[Episode]) -> Places {
        match self.looks {
            Looks::Block(before) => Places::new(episodes, before, self.len),
            Looks::Running => Places::starts(episodes, self.len),
        }
    }
}

/// Draws a batch of blocks; `places` must be made for this shape.
///
/// # Errors
/// If an episode cannot be read.
pub fn blocks(episodes: &[Episode], places: &Places, shape: &BlockShape, rng: &mut Philox) -> Result<ElboBatch> {
    let steps = shape.len - 1;
    let mut rows = TokenRows::new(&episodes[0]);
    let (mut valid, mut history) = (Vec::with_capacity(shape.batch * steps), Vec::with_capacity(shape.batch * shape.len * 3));
    let (mut successor, mut context) = (Vec::with_capacity(shape.batch * steps * 3), Vec::new());
    for _ in 0..shape.batch {
        let (episode, start) = drawn(episodes, places, rng);
        // Nobody waits for a first episode: the memory of a GRU that runs on begins with it.
        let start = if shape.looks == Looks::Running && episode.reach() == 0 { start.max(0) } else { start };
        let hidden = shape.hide.draw(rng);
        for t in start..start + shape.len as isize {
            rows.push(&episode, t, Seen::ALL)?;
            history.extend(hidden.step(rng).flags());
        }
        for t in start..start + steps as isize {
            let action = rng.uniform() < shape.show_action;
            let reward = rng.uniform() < shape.show_reward && action;
            valid.push(f32::from(t >= 0));
            if let Some(units) = &shape.context {
                let mut row = episode.context(usize::try_from(t).unwrap_or(0))?.into_owned();
                units.normalize_in_place(&mut row);
                context.extend(row);
            }
            let ever = hidden.ever();
            let masked = shape.mask_state > 0.0 && action && rng.uniform() < shape.mask_state;
            successor.extend([f32::from(!masked), f32::from(action && ever.action), f32::from(reward && ever.reward)]);
        }
    }
    let eps = (0..shape.batch * steps * shape.latent_dim).map(|_| rng.normal()).collect();
    let tells = |units: &Affine| Tensor::from_vec(std::mem::take(&mut context), (shape.batch, steps, units.dim()), &Device::Cpu);
    let believed = shape.stays.then(|| believed(&valid, steps, rng));
    Ok(ElboBatch {
        context: shape.context.as_ref().map(tells).transpose()?,
        believed: believed.map(|chosen| Tensor::from_vec(chosen, (shape.batch, 1, steps), &Device::Cpu)).transpose()?,
        tokens: rows.tokens(shape.batch, shape.len)?,
        valid: Tensor::from_vec(valid, (shape.batch, steps), &Device::Cpu)?,
        history_shown: Tensor::from_vec(history, (shape.batch, shape.len, 3), &Device::Cpu)?,
        successor_shown: Tensor::from_vec(successor, (shape.batch, steps, 3), &Device::Cpu)?,
        eps: Tensor::from_vec::<_, f32>(eps, (shape.batch, steps, shape.latent_dim), &Device::Cpu)?,
    })
}

/// Of each row 1 at one of its valid steps but the last, each equally likely.
fn believed(valid: &[f32], steps: usize, rng: &mut Philox) -> Vec<f32> {
    let mut chosen = vec![0.0; valid.len()];
    for (row, valid) in chosen.chunks_exact_mut(steps).zip(valid.chunks_exact(steps)) {
        let first = valid.iter().position(|valid| *valid == 1.0).unwrap_or(0);
        row[first + rng.below((steps - 1).saturating_sub(first).max(1))] = 1.0;
    }
    chosen
}
