//! From acts to the rows of a batch, and back: only those that ask, in their order.

use super::{Act, Ask, candidate::Candidate};
use crate::model::{
    columns::Columns,
    config::ModelConfig,
    diffusion::descent::Walk,
    latent::{Evidence, Gaussian, GaussianRef, Tokens},
    nn::{Activations, Buffer},
    trajectory::TokenRef,
};
use candle_core::Result;

/// One of the windows of an act that ask something.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    act: &'a Act,
    window: &'a Candidate,
    slot: usize,
    told: bool,
}

impl<'a> Row<'a> {
    /// The window itself, with what is told.
    pub(super) fn of(act: &'a Act, window: &'a Candidate) -> Self {
        Self { act, window, slot: 0, told: true }
    }

    /// What it is part of.
    pub(super) fn act(&self) -> &'a Act {
        self.act
    }

    /// The window.
    pub(super) fn window(&self) -> &'a Candidate {
        self.window
    }

    /// Which of the rows of the table that are evaluated at once; see [`crate::model::diffusion::picard`].
    pub(super) fn slot(&self) -> usize {
        self.slot
    }

    /// Whether it is evaluated with what is told.
    pub(super) fn is_told(&self) -> bool {
        self.told
    }
}

/// The windows that ask this.
pub(super) fn asking(acts: &[Act], ask: Ask) -> impl Iterator<Item = Row<'_>> + Clone {
    acts.iter().flat_map(move |act| {
        let windows = act.candidates().iter().filter(move |window| window.asks(ask, act.options()));
        windows.map(move |window| Row::of(act, window))
    })
}

/// The windows that ask this, to be told something.
pub(super) fn asking_mut(acts: &mut [Act], ask: Ask) -> impl Iterator<Item = &mut Candidate> {
    acts.iter_mut().flat_map(move |act| act.asking_mut(ask))
}

/// What is evaluated of the windows that ask for it: each of its slots, and each of these with what is told and, where it is doubted, without.
pub(super) fn evaluated(acts: &[Act]) -> impl Iterator<Item = Row<'_>> + Clone {
    asking(acts, Ask::Denoise).flat_map(|row| {
        let doubts = usize::from(row.act.options().doubts());
        (0..row.window.descent().slots()).flat_map(move |slot| (0..=doubts).map(move |null| Row { slot, told: null == 0, ..row }))
    })
}

/// `(rows, steps, width)`, each written by its row.
pub(super) fn gather<'a, R>(
    rows: impl Iterator<Item = R> + Clone + 'a,
    [steps, width]: [usize; 2],
    write: impl Fn(R, &mut [f32]),
) -> Result<Buffer> {
    Buffer::generate([rows.clone().count(), steps, width], |out| {
        rows.zip(out.chunks_exact_mut((steps * width).max(1))).for_each(|(row, out)| write(row, out));
    })
}

/// Rows of a batch of latents.
pub(super) fn latents(latents: &Gaussian<Buffer>) -> impl Iterator<Item = GaussianRef<'_>> {
    let dim = latents.mean.len() / latents.mean.shape().map_or(1, |[batch, ..]| batch.max(1));
    let rows = latents.mean.chunks_exact(dim.max(1)).zip(latents.log_var.chunks_exact(dim.max(1)));
    rows.map(|(mean, log_var)| GaussianRef { mean, log_var })
}

/// What the encoder sees of each window: the last tokens of its past, wholly absent ones in front where there are fewer, and the evidence
/// behind them. Beside a baseline, with what came before each; nothing is known of what came before a block, in training as here.
pub(super) fn blocks<'a>(
    rows: impl Iterator<Item = Row<'a>> + Clone + 'a,
    evidence: Evidence,
    config: &ModelConfig,
    walk: Walk<'a>,
) -> Result<Tokens<Buffer>> {
    let block_len = config.method.latent.block_len();
    let ahead = evidence.ahead_within(config.method.plan.horizon);
    let past = move |row: Row<'a>, back: usize| row.act.past(row.window, back, walk).unwrap_or_default();
    let last = |row: Row<'a>| if block_len > 0 { TokenRef::default() } else { past(row, 0) };
    let first = config.method.latent.baseline().map(|_| &last as &dyn Fn(Row<'a>) -> TokenRef<'a>);
    Tokens::pack(config.layout, rows, block_len + ahead.len(), first, |row, position| match position.checked_sub(block_len) {
        None => past(row, block_len - 1 - position),
        Some(i) => row.act.ahead(row.window, i, evidence, walk).only(ahead[i]),
    })
}

/// The oldest token that the GRU of each of these acts has not read, `(B, 1)`.
pub(super) fn unread<'a>(acts: impl Iterator<Item = &'a Act> + Clone, config: &ModelConfig) -> Result<Tokens<Buffer>> {
    let last = |act: &'a Act| act.last_read().unwrap_or_default();
    let first = config.method.latent.baseline().map(|_| &last as &dyn Fn(&'a Act) -> TokenRef<'a>);
    Tokens::pack(config.layout, acts, 1, first, |act, _| act.unread().unwrap_or_default())
}

/// The real steps that the denoiser is given with each window ([`Diffusion::observed`]), oldest first, zeros where unknown: `(B, 1, steps * width)`;
/// none of a model that takes none.
///
/// [`Diffusion::observed`]: crate::model::method::Diffusion::observed
pub(super) fn observed<'a>(rows: impl Iterator<Item = Row<'a>> + Clone + 'a, config: &ModelConfig, walk: Walk) -> Result<Option<Buffer>> {
    let (plan, columns) = (&config.method.plan, Columns::state_action(config.layout));
    let [steps, width] = plan.observed(config.layout.widths());
    let policy = !plan.diffused.has_states();
    let write = |row: Row<'a>, out: &mut [f32]| {
        for (step, out) in out.chunks_exact_mut(width).enumerate() {
            let TokenRef { state, action, .. } = match (policy, steps - 1 - step) {
                (false, back) => row.act.past(row.window, back, walk).unwrap_or_default(),
                (true, 0) => TokenRef { state: Some(row.window.descent().known()), ..TokenRef::default() },
                (true, back) => row.act.real_past(back - 1).unwrap_or_default(),
            };
            state.into_iter().for_each(|known| out[columns.state.clone()].copy_from_slice(known));
            action.into_iter().for_each(|known| out[columns.action.clone()].copy_from_slice(known));
            if policy {
                out[columns.width()] = plan.age(steps - 1 - step + row.window.descent().given_len());
            }
        }
    };
    (steps > 0).then(|| gather(rows, [1, steps * width], write)).transpose()
}
