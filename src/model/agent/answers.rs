//! What the networks answer, one function for each [`Ask`]: gather the rows of all acts that ask it, one forward, hand the rows back. It
//! works on pooled buffers and allocates nothing once a batch of this size has been seen.

use super::{Act, Agent, Ask, rows};
use crate::model::{
    denoiser::Given,
    latent::{Evidence, Gaussian, LatentModel, hold_within},
    method::GruLatent,
    nn::{Activations, Buffer},
};
use candle_core::Result;

impl Agent {
    /// Answers what these acts ask, none of which is done: one evaluation of the denoiser for all of them. Acts do not influence each other.
    pub(super) fn answer(&self, ask: Ask, acts: &mut [Act]) -> Result<()> {
        if !acts.iter().any(|act| act.asks(ask)) {
            return Ok(());
        }
        match ask {
            Ask::Filter => self.filter(acts),
            Ask::Refine => self.refine(acts),
            Ask::Denoise => self.denoise(acts),
        }
    }

    /// The filter: latents from real history and the current state; then the windows start.
    fn filter(&self, acts: &mut [Act]) -> Result<()> {
        let fresh = |act: &Act| act.asks(Ask::Filter);
        if let Some(latent) = &self.networks().latent {
            let block = rows::blocks(acts, fresh, Evidence::Filter, self.config(), self.walk())?;
            let filter = latent.infer(&block, self.read_on(latent, acts)?.as_ref())?;
            roll_out(latent, filter, acts, fresh, 0)?;
        }
        acts.iter_mut().filter(|act| fresh(act)).for_each(|act| act.start(self.config(), self.walk()));
        Ok(())
    }

    /// Where a GRU runs on over the episode: its states after all that was executed, `(B, 1, hidden)` for the acts that ask the filter. Each
    /// token is read once, and rows read as many as they have.
    fn read_on(&self, latent: &LatentModel, acts: &mut [Act]) -> Result<Option<Buffer>> {
        let reads = |act: &Act| act.asks(Ask::Filter) && act.unread().is_some();
        while acts.iter().any(reads) {
            let tokens = rows::unread(acts, reads, self.config())?;
            let after = latent.read(&tokens, self.memories(acts, &reads)?.as_ref())?;
            let [_, _, width] = after.shape()?;
            let keep = self.config().method.plan.obs_horizon;
            acts.iter_mut().filter(|act| reads(act)).zip(after.chunks_exact(width)).for_each(|(act, state)| act.remember(state, keep));
        }
        self.memories(acts, &|act| act.asks(Ask::Filter))
    }

    /// States of a GRU that runs on, of the acts that `which` takes; none where each looks anew.
    fn memories(&self, acts: &[Act], which: &dyn Fn(&Act) -> bool) -> Result<Option<Buffer>> {
        let width = self.config().method.latent.gru().map_or(0, GruLatent::memory_len);
        let states = || rows::gather(acts, which, [1, width], &|act, out| out.copy_from_slice(act.memory()));
        (width > 0).then(states).transpose()
    }

    /// Zig-zag: at READY the latent of position 0 is the posterior given the noised positions 0 and 1, held in a trust region around the
    /// filter's, and the others are rolled out anew from it.
    fn refine(&self, acts: &mut [Act]) -> Result<()> {
        let wants = |act: &Act| act.asks(Ask::Refine);
        let Some(latent) = &self.networks().latent else { return Ok(()) };
        let block = rows::blocks(acts, wants, Evidence::Refinement, self.config(), self.walk())?;
        let posterior = latent.infer(&block, self.memories(acts, &wants)?.as_ref())?;
        let [count, _, dim] = posterior.mean.shape()?;
        let mut log_var = Buffer::generate([count, 1, dim], |out| out.copy_from_slice(&posterior.log_var))?;
        let mean = Buffer::generate([count, 1, dim], |mean| {
            mean.copy_from_slice(&posterior.mean);
            let rows = mean.chunks_exact_mut(dim).zip(log_var.chunks_exact_mut(dim));
            for ((mean, log_var), act) in rows.zip(acts.iter().filter(|act| wants(act))) {
                hold_within(mean, log_var, act.latents().get(0), act.kappa());
            }
        })?;
        let head = Gaussian { mean, log_var };
        rows::set_latents(&head, acts, wants, 0);
        roll_out(latent, head, acts, wants, 1)
    }

    /// The clean windows, and one row down.
    fn denoise(&self, acts: &mut [Act]) -> Result<()> {
        let wants = |act: &Act| act.asks(Ask::Denoise);
        let inputs = self.inputs(acts, wants)?;
        let Inputs { x, levels, latents, observed } = &inputs;
        let given = Given { levels, latents: latents.as_ref(), observed: observed.as_ref() };
        let x0 = self.networks().denoiser.predict(x, &given)?;
        let size = self.config().method.plan.horizon * self.walk().columns.width();
        acts.iter_mut().filter(|act| wants(act)).zip(x0.chunks_exact(size)).for_each(|(act, x0)| act.step_down(x0, self.walk()));
        Ok(())
    }

    fn inputs(&self, acts: &[Act], which: impl Fn(&Act) -> bool) -> Result<Inputs> {
        let plan = &self.config().method.plan;
        let by_row = |width: usize, write: &dyn Fn(&Act, &mut [f32])| rows::gather(acts, &which, [plan.horizon, width], write);
        Ok(Inputs {
            x: by_row(self.walk().columns.width(), &|act, out| out.copy_from_slice(act.descent().x()))?,
            levels: by_row(1, &|act, out| act.descent().write_levels(out))?,
            latents: self.config().method.latent.gru().map(|latent| by_row(latent.dim, &Act::write_latents)).transpose()?,
            observed: (plan.obs_horizon > 1).then(|| rows::observed(acts, &which, plan.obs_horizon - 1, self.walk())).transpose()?,
        })
    }

    /// What the denoiser reads of an act whose window stands in `row`, where it is `x`, after it stood at READY, where it was `x_ready`, and
    /// after these positions were given out: x, levels, latents and real steps.
    #[cfg(test)]
    pub(crate) fn read_in_serving(&self, act: Act, row: usize, [x, x_ready, given]: [&[f32]; 3]) -> Result<[Vec<f32>; 4]> {
        let mut acts = [act];
        self.answer(Ask::Filter, &mut acts)?;
        let ready = acts[0].descent().ready_row().unwrap_or(row);
        acts[0].descent_mut().stand_at(ready.min(row), x_ready, given);
        self.answer(Ask::Refine, &mut acts)?;
        acts[0].descent_mut().stand_at(row, x, given);
        let Inputs { x, levels, latents, observed } = self.inputs(&acts, |_| true)?;
        let numbers = |buffer: Option<Buffer>| buffer.map_or(Vec::new(), |buffer| buffer.to_vec());
        Ok([numbers(Some(x)), numbers(Some(levels)), numbers(latents), numbers(observed)])
    }
}

/// What the denoiser reads of a batch; see [`Given`].
struct Inputs {
    x: Buffer,
    levels: Buffer,
    latents: Option<Buffer>,
    observed: Option<Buffer>,
}

/// The prior chain of each row that `which` takes, from `start` on, into the rows' latents from `position` on.
fn roll_out(
    latent: &LatentModel,
    start: Gaussian<Buffer>,
    acts: &mut [Act],
    which: impl Fn(&Act) -> bool,
    mut position: usize,
) -> Result<()> {
    let end = acts.iter().filter(|act| which(act)).map(|act| act.latents().len()).max().unwrap_or(0);
    latent.roll_out(start, end.saturating_sub(position), |next| {
        rows::set_latents(next, acts, &which, position);
        position += 1;
        Ok(())
    })
}
