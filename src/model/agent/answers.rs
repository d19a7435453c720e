//! What the networks answer, one function for each [`Ask`]: gather the rows of all acts that ask it, one forward, hand the rows back. It
//! works on pooled buffers and allocates nothing once a batch of this size has been seen.

use super::{
    Act, Agent, Ask,
    chain::Chain,
    rows::{self, Row, asking, asking_mut, evaluated},
};
use crate::model::{
    denoiser::Given,
    head::{InverseDynamics, Skills},
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
            Ask::RollOut => self.roll_out(acts),
            Ask::Refine => self.refine(acts),
            Ask::Denoise => self.denoise(acts),
            Ask::Decode => self.decode(acts),
            Ask::Choose => self.choose(acts),
        }
    }

    /// The filter: the latent of now from real history and the current state; then the windows start.
    fn filter(&self, acts: &mut [Act]) -> Result<()> {
        let fresh = |act: &Act| act.asks(Ask::Filter);
        if let Some(latent) = &self.networks().latent {
            let memories = self.read_on(latent, acts)?;
            let rows = acts.iter().filter(|act| fresh(act)).map(|act| Row::of(act, &act.candidates()[0]));
            let block = rows::blocks(rows, Evidence::Filter, self.config(), self.walk())?;
            let now = latent.coming(latent.infer(&block, memories.as_ref())?)?;
            acts.iter_mut().filter(|act| fresh(act)).zip(rows::latents(&now)).for_each(|(act, latent)| act.set_latent(0, latent));
        }
        let told = self.config().method.latent.truth().is_some();
        for act in acts.iter_mut().filter(|act| fresh(act)) {
            if told {
                act.set_truth();
            }
            act.start(self.config(), self.walk());
        }
        Ok(())
    }

    /// The prior from the latent of now on, one row an act: candidates have the same latents.
    fn roll_out(&self, acts: &mut [Act]) -> Result<()> {
        let Some(latent) = &self.networks().latent else { return Ok(()) };
        let waits = |act: &Act| act.asks(Ask::RollOut);
        let chains = || acts.iter().filter(|act| waits(act)).map(|act| act.candidates()[0].latents());
        let shape = [1, self.config().method.latent.dim()];
        let now = Gaussian {
            mean: rows::gather(chains(), shape, |chain, out| out.copy_from_slice(chain.get(0).mean))?,
            log_var: rows::gather(chains(), shape, |chain, out| out.copy_from_slice(chain.get(0).log_var))?,
        };
        let later = chains().map(Chain::len).max().unwrap_or(1) - 1;
        let mut position = 1;
        latent.roll_out(now, later, |next| {
            let rows = acts.iter_mut().filter(|act| waits(act)).zip(rows::latents(next));
            rows.for_each(|(act, latent)| act.set_latent(position, latent));
            position += 1;
            Ok(())
        })?;
        acts.iter_mut().filter(|act| waits(act)).for_each(Act::set_rolled_out);
        Ok(())
    }

    /// Where a GRU runs on over the episode: its states after all that was executed, `(B, 1, hidden)` for the acts that ask the filter. Each
    /// token is read once, and rows read as many as they have.
    fn read_on(&self, latent: &LatentModel, acts: &mut [Act]) -> Result<Option<Buffer>> {
        let fresh = |act: &&Act| act.asks(Ask::Filter);
        let reads = |act: &Act| act.asks(Ask::Filter) && act.unread().is_some();
        while acts.iter().any(reads) {
            let reading = acts.iter().filter(|act| reads(act));
            let tokens = rows::unread(reading.clone(), self.config())?;
            let after = latent.read(&tokens, self.memories(reading)?.as_ref())?;
            let [_, _, width] = after.shape()?;
            let keep = self.config().method.plan.obs_horizon;
            acts.iter_mut().filter(|act| reads(act)).zip(after.chunks_exact(width)).for_each(|(act, state)| act.remember(state, keep));
        }
        self.memories(acts.iter().filter(fresh))
    }

    /// States of a GRU that runs on, of these acts; none where each looks anew.
    fn memories<'a>(&self, acts: impl Iterator<Item = &'a Act> + Clone + 'a) -> Result<Option<Buffer>> {
        let width = self.config().method.latent.gru().map_or(0, GruLatent::memory_len);
        (width > 0).then(|| rows::gather(acts, [1, width], |act, out| out.copy_from_slice(act.memory()))).transpose()
    }

    /// Zig-zag: at READY the latent of position 0 is the posterior given the noised positions 0 and 1, held in a trust region around the
    /// filter's, and the others are rolled out anew from it.
    fn refine(&self, acts: &mut [Act]) -> Result<()> {
        let Some(latent) = &self.networks().latent else { return Ok(()) };
        let block = rows::blocks(asking(acts, Ask::Refine), Evidence::Refinement, self.config(), self.walk())?;
        let posterior = latent.infer(&block, self.memories(asking(acts, Ask::Refine).map(|row| row.act()))?.as_ref())?;
        let [count, _, dim] = posterior.mean.shape()?;
        let mut log_var = Buffer::generate([count, 1, dim], |out| out.copy_from_slice(&posterior.log_var))?;
        let mean = Buffer::generate([count, 1, dim], |mean| {
            mean.copy_from_slice(&posterior.mean);
            let rows = mean.chunks_exact_mut(dim).zip(log_var.chunks_exact_mut(dim));
            for ((mean, log_var), row) in rows.zip(asking(acts, Ask::Refine)) {
                hold_within(mean, log_var, row.window().latents().get(0), row.act().options().kappa);
            }
        })?;
        let head = Gaussian { mean, log_var };
        set_refined(acts, &head, 0);
        let end = asking(acts, Ask::Refine).map(|row| row.window().latents().len()).max().unwrap_or(0);
        let mut position = 1;
        latent.roll_out(head, end.saturating_sub(position), |next| {
            set_refined(acts, next, position);
            position += 1;
            Ok(())
        })?;
        acts.iter_mut().filter(|act| act.asks(Ask::Refine)).for_each(Act::set_rolled_out);
        Ok(())
    }

    /// The clean windows, and one row down, or several.
    fn denoise(&self, acts: &mut [Act]) -> Result<()> {
        acts.iter_mut().filter(|act| act.asks(Ask::Denoise)).for_each(Act::keep_pace);
        let inputs = self.inputs(acts)?;
        let Inputs { x, levels, latents, observed, told } = &inputs;
        let given = Given { latents: latents.as_ref(), observed: observed.as_ref(), told: told.as_ref(), ..Given::levels(levels) };
        let mut estimates = self.networks().denoiser.predict(x, &given)?;
        self.estimate(acts, x, &mut estimates);
        self.guide(acts, &mut estimates)?;
        let size = self.window_len();
        let mut rest = &estimates[..];
        for window in asking_mut(acts, Ask::Denoise) {
            let (x0, after) = rest.split_at(window.descent().slots() * size);
            window.step_down(x0, self.walk());
            rest = after;
        }
        Ok(())
    }

    /// From what the denoiser says to the clean estimate of each window, one after the other: what is told is driven home (classifier-free
    /// guidance, `u + w (c - u)`), and the target is turned into x0.
    fn estimate(&self, acts: &[Act], x: &[f32], out: &mut [f32]) {
        let (size, width, target) = (self.window_len(), self.walk().columns.width(), self.config().method.plan.target);
        let (mut from, mut to) = (0, 0);
        for row in evaluated(acts).filter(|row| row.is_told()) {
            let doubts = row.act().options().doubts();
            let scale = row.act().options().free_guidance_scale;
            for i in 0..size {
                let said = out[from + i];
                let said = if doubts { out[from + size + i] + scale * (said - out[from + size + i]) } else { said };
                let level = row.window().descent().level(row.slot(), i / width);
                out[to + i] = self.walk().process.x0(target, level, x[from + i], said);
            }
            (from, to) = (from + size * (1 + usize::from(doubts)), to + size);
        }
    }

    /// The next action of each plan that has none itself.
    fn decode(&self, acts: &mut [Act]) -> Result<()> {
        let mut actions = match (&self.networks().inverse, &self.networks().skill) {
            (Some(inverse), _) => self.between_states(inverse, acts)?,
            (None, Some(skill)) => self.by_codes(skill, acts)?,
            (None, None) => candle_core::bail!("nothing makes actions of these plans: is a bug"),
        };
        for (window, action) in asking_mut(acts, Ask::Decode).zip(actions.chunks_exact_mut(self.config().layout.action_dim)) {
            self.action_bounds().hold(action);
            window.push_action(action);
        }
        Ok(())
    }

    /// The actions that lead from state to state.
    fn between_states(&self, inverse: &InverseDynamics, acts: &[Act]) -> Result<Buffer> {
        let (layout, rows) = (self.config().layout, || asking(acts, Ask::Decode));
        let states = rows::gather(rows(), [1, 2 * layout.state_dim], |row, out| {
            let [now, next] = row.window().states_around(self.walk());
            out[..layout.state_dim].copy_from_slice(now);
            out[layout.state_dim..].copy_from_slice(next);
        })?;
        let dim = self.config().method.latent.dim();
        let latent = |row: Row, out: &mut [f32]| out.copy_from_slice(row.window().latents().mean_of_step(row.window().actions_len()));
        let latents = inverse.sees_latent().then(|| rows::gather(rows(), [1, dim], latent)).transpose()?;
        let draw = |level: u32, scale: f32, out: &mut [f32]| {
            let rows = rows().zip(out.chunks_exact_mut(layout.action_dim));
            rows.for_each(|(row, out)| row.window().draw_inverse(level, scale, row.act().options().temperature, out));
        };
        inverse.sample(self.inverse_process(), (&states, latents.as_ref()), layout.action_dim, draw)
    }

    /// What codes say is to be done in the states of now.
    fn by_codes(&self, skill: &Skills, acts: &[Act]) -> Result<Buffer> {
        let gather = |width: usize, write: &dyn Fn(Row, &mut [f32])| rows::gather(asking(acts, Ask::Decode), [1, width], write);
        let state = gather(self.config().layout.state_dim, &|row, out| out.copy_from_slice(row.window().descent().known()))?;
        let code = gather(self.walk().columns.width(), &|row, out| out.copy_from_slice(row.window().descent().given(0)))?;
        skill.act(&state, &code)
    }

    /// Numbers of a window.
    pub(super) fn window_len(&self) -> usize {
        self.config().method.plan.horizon * self.walk().columns.width()
    }

    fn inputs(&self, acts: &[Act]) -> Result<Inputs> {
        let plan = &self.config().method.plan;
        let by_row = |width: usize, write: &dyn Fn(Row, &mut [f32])| rows::gather(evaluated(acts), [plan.horizon, width], write);
        let (latent_dim, told) = (self.config().method.latent.dim(), self.config().method.told_width());
        let tell = |row: Row, out: &mut [f32]| row.act().write_told(row.is_told(), out);
        Ok(Inputs {
            x: by_row(self.walk().columns.width(), &|row, out| out.copy_from_slice(row.window().descent().x(row.slot())))?,
            levels: by_row(1, &|row, out| row.window().descent().write_levels(row.slot(), out))?,
            latents: (latent_dim > 0).then(|| by_row(latent_dim, &|row, out| row.act().write_latents(row.window(), out))).transpose()?,
            observed: rows::observed(evaluated(acts), self.config(), self.walk())?,
            told: (told > 0).then(|| rows::gather(evaluated(acts), [1, told + 1], tell)).transpose()?,
        })
    }

    /// What the denoiser reads of an act whose window stands in `row`, where it is `x`, after it stood at READY, where it was `x_ready`, and
    /// after these positions were given out, with these actions: x, levels, latents, real steps and what is told.
    #[cfg(test)]
    pub(crate) fn read_in_serving(&self, act: Act, row: usize, [x, x_ready, given, actions]: [&[f32]; 4]) -> Result<[Vec<f32>; 5]> {
        let mut acts = [act];
        self.answer(Ask::Filter, &mut acts)?;
        self.answer(Ask::RollOut, &mut acts)?;
        let ready = acts[0].first_mut().descent_mut().ready_row().unwrap_or(row);
        acts[0].first_mut().stand_at(ready.min(row), x_ready, given, actions);
        self.answer(Ask::Refine, &mut acts)?;
        acts[0].first_mut().stand_at(row, x, given, actions);
        let Inputs { x, levels, latents, observed, told } = self.inputs(&acts)?;
        let numbers = |buffer: Option<Buffer>| buffer.map_or(Vec::new(), |buffer| buffer.to_vec());
        Ok([numbers(Some(x)), numbers(Some(levels)), numbers(latents), numbers(observed), numbers(told)])
    }
}

/// Latents of a position of the windows that are refined.
fn set_refined(acts: &mut [Act], next: &Gaussian<Buffer>, position: usize) {
    let windows = asking_mut(acts, Ask::Refine).zip(rows::latents(next));
    windows.for_each(|(window, latent)| window.set_latent(position, latent));
}

/// What the denoiser reads of a batch; see [`Given`].
struct Inputs {
    x: Buffer,
    levels: Buffer,
    latents: Option<Buffer>,
    observed: Option<Buffer>,
    told: Option<Buffer>,
}
