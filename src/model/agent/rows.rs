//! From acts to the rows of a batch, and back: only the acts that `which` takes, in their order.

use super::Act;
use crate::model::{
    config::ModelConfig,
    diffusion::descent::Walk,
    latent::{Evidence, Gaussian, GaussianRef, Tokens},
    nn::{Activations, Buffer},
    trajectory::TokenRef,
};
use candle_core::Result;

/// `(B, steps, width)`, each row written by its act.
pub(super) fn gather(
    acts: &[Act],
    which: impl Fn(&Act) -> bool,
    [steps, width]: [usize; 2],
    write: &dyn Fn(&Act, &mut [f32]),
) -> Result<Buffer> {
    let rows = || acts.iter().filter(|act| which(act));
    Buffer::generate([rows().count(), steps, width], |out| {
        rows().zip(out.chunks_exact_mut((steps * width).max(1))).for_each(|(act, out)| write(act, out));
    })
}

/// Sets the latent at `position` of each act, from a batch of these rows.
pub(super) fn set_latents(latents: &Gaussian<Buffer>, acts: &mut [Act], which: impl Fn(&Act) -> bool, position: usize) {
    let dim = latents.mean.len() / latents.mean.shape().map_or(1, |[batch, ..]| batch.max(1));
    let rows = latents.mean.chunks_exact(dim).zip(latents.log_var.chunks_exact(dim));
    for (act, (mean, log_var)) in acts.iter_mut().filter(|act| which(act)).zip(rows) {
        act.latents_mut().set(position, GaussianRef { mean, log_var });
    }
}

/// What the encoder sees of each act: the last tokens of its past, wholly absent ones in front where there are fewer, and the evidence
/// behind them. Beside a baseline, with what came before each; nothing is known of what came before a block, in training as here.
pub(super) fn blocks<'a>(
    acts: &'a [Act],
    which: impl Fn(&Act) -> bool,
    evidence: Evidence,
    config: &ModelConfig,
    walk: Walk<'a>,
) -> Result<Tokens<Buffer>> {
    let block_len = config.method.latent.block_len();
    let ahead = evidence.ahead_within(config.method.plan.horizon);
    let rows = acts.iter().filter(|act| which(act));
    let last = |act: &'a Act| if block_len > 0 { TokenRef::default() } else { act.past(0, walk).unwrap_or_default() };
    let first = config.method.latent.baseline().map(|_| &last as &dyn Fn(&'a Act) -> TokenRef<'a>);
    Tokens::pack(config.layout, rows, block_len + ahead.len(), first, |act, position| match position.checked_sub(block_len) {
        None => act.past(block_len - 1 - position, walk).unwrap_or_default(),
        Some(i) => act.ahead(i, evidence, walk).only(ahead[i]),
    })
}

/// The oldest token that each act's GRU has not read, `(B, 1)`.
pub(super) fn unread<'a>(acts: &'a [Act], which: impl Fn(&Act) -> bool, config: &ModelConfig) -> Result<Tokens<Buffer>> {
    let last = |act: &'a Act| act.last_read().unwrap_or_default();
    let first = config.method.latent.baseline().map(|_| &last as &dyn Fn(&'a Act) -> TokenRef<'a>);
    Tokens::pack(config.layout, acts.iter().filter(|act| which(act)), 1, first, |act, _| act.unread().unwrap_or_default())
}

/// The last `steps` real steps (state, action) of each act, oldest first, zeros where unknown: `(B, 1, steps * D)`.
pub(super) fn observed(acts: &[Act], which: impl Fn(&Act) -> bool, steps: usize, walk: Walk) -> Result<Buffer> {
    let columns = walk.columns;
    gather(acts, which, [1, steps * columns.width()], &|act, out| {
        for (step, out) in out.chunks_exact_mut(columns.width()).enumerate() {
            let TokenRef { state, action, .. } = act.past(steps - 1 - step, walk).unwrap_or_default();
            state.into_iter().for_each(|known| out[columns.state.clone()].copy_from_slice(known));
            action.into_iter().for_each(|known| out[columns.action.clone()].copy_from_slice(known));
        }
    })
}
