//! What leads windows on their way down, and what chooses among them: the guide at work on the rows of a batch.

use super::{
    Act, Agent, Ask,
    rows::{self, Row, evaluated},
};
use crate::model::{
    critic::{Critic, Judged},
    diffusion::guidance::{Futures, Seat, lead},
    nn::{Activations, Buffer},
    noise::Slot,
};
use candle_core::Result;

/// A window that is led, and which of the estimates is its own.
#[derive(Clone, Copy)]
struct Led<'a> {
    row: Row<'a>,
    index: usize,
}

/// The windows that are led, and have at least so many futures.
fn led(acts: &[Act], futures: usize) -> impl Iterator<Item = Led<'_>> + Clone {
    let rows = evaluated(acts).filter(|row| row.is_told()).enumerate().map(|(index, row)| Led { row, index });
    rows.filter(move |Led { row, .. }| {
        let options = row.act().options();
        options.guidance_scale > 0.0 && options.guidance_samples >= futures
    })
}

impl Agent {
    /// Leads the clean estimates of windows, `T * D` values each, up the gradient of what they are worth.
    pub(super) fn guide(&self, acts: &[Act], estimates: &mut [f32]) -> Result<()> {
        let most = led(acts, 0).map(|led| led.row.act().options().guidance_samples).max();
        let Some(most) = most else { return Ok(()) };
        let size = self.window_len();
        // Rows that are averaged over futures have their sum here, row by row of the estimates.
        let mut sums = Buffer::generate([1, 1, estimates.len()], |_| {})?;
        let here = |led: &Led| led.row.act().options().guidance_samples == 0;
        if led(acts, 0).any(|led| here(&led)) {
            let gradients = self.gradients(led(acts, 0).filter(here), estimates, None)?;
            add(led(acts, 0).filter(here), &gradients, size, &mut sums);
        }
        for future in 0..most {
            let gradients = self.gradients(led(acts, future + 1), estimates, Some(future))?;
            add(led(acts, future + 1), &gradients, size, &mut sums);
        }
        for Led { row, index } in led(acts, 0) {
            let (range, count) = (index * size..(index + 1) * size, row.act().options().guidance_samples.max(1));
            let gradient = &mut sums[range.clone()];
            gradient.iter_mut().for_each(|gradient| *gradient /= count as f32);
            let known = self.walk().columns.known(0, row.window().descent().given_len() == 0);
            gradient[known].fill(0.0);
            let levels = |position| row.window().descent().level(row.slot(), position);
            lead(&mut estimates[range], gradient, (row.act().options().guidance_scale, self.walk()), levels);
        }
        Ok(())
    }

    /// Gradients to these estimates of what the windows are worth: at the windows themselves, or in a future of theirs.
    fn gradients<'a>(&self, rows: impl Iterator<Item = Led<'a>> + Clone + 'a, estimates: &[f32], future: Option<usize>) -> Result<Buffer> {
        let (horizon, width, size) = (self.config().method.plan.horizon, self.walk().columns.width(), self.window_len());
        let gather =
            |width: usize, write: &dyn Fn(Led, &mut [f32])| rows::gather(rows.clone(), [horizon, width], |led, out| write(led, out));
        let latent_dim = self.config().method.latent.dim();
        let write_latents = |led: Led, out: &mut [f32]| led.row.act().write_latents(led.row.window(), out);
        let seat = Seat {
            x: gather(width, &|led, out| out.copy_from_slice(led.row.window().descent().x(led.row.slot())))?,
            estimate: gather(width, &|led, out| out.copy_from_slice(&estimates[led.index * size..][..size]))?,
            levels: gather(1, &|led, out| led.row.window().descent().write_levels(led.row.slot(), out))?,
            latents: (latent_dim > 0).then(|| gather(latent_dim, &write_latents)).transpose()?,
        };
        let Some(future) = future else { return self.judge().gradient(&seat) };
        let told = self.config().method.told_width();
        let noise = gather(width, &|led, out| {
            let (descent, time) = (&led.row.window().descent(), led.row.window().descent().time());
            for (position, out) in out.chunks_exact_mut(width).enumerate() {
                let key = descent.level(led.row.slot(), position) as u32;
                descent.noise().of_candidate(future).fill(time + position as u64, key, Slot::Future, out);
            }
        })?;
        let known = gather(width, &|led, out| {
            let columns = self.walk().columns.known(0, led.row.window().descent().given_len() == 0);
            out[columns].fill(1.0);
        })?;
        let tell = || rows::gather(rows.clone(), [1, told + 1], |led, out| led.row.act().write_told(true, out));
        let futures = Futures {
            noise,
            known,
            observed: rows::observed(rows.clone().map(|led| led.row), self.config(), self.walk())?,
            told: (told > 0).then(tell).transpose()?,
        };
        self.judge().gradient_in_future(&seat, &futures)
    }

    /// What each candidate is worth; each act then chooses.
    pub(super) fn choose(&self, acts: &mut [Act]) -> Result<()> {
        let values = match &self.networks().critic {
            Some(critic) => self.worth_of_actions(critic, candidates(acts))?,
            None => self.worth_of_plans(candidates(acts))?,
        };
        let mut rest = &values[..];
        for act in acts.iter_mut().filter(|act| act.asks(Ask::Choose)) {
            let (of_act, after) = rest.split_at(act.candidates().len());
            act.choose(of_act);
            rest = after;
        }
        Ok(())
    }
}

impl Agent {
    /// By the guide, of whole plans.
    fn worth_of_plans<'a>(&self, plans: impl Iterator<Item = Row<'a>> + Clone + 'a) -> Result<Buffer> {
        let (horizon, width) = (self.config().method.plan.horizon, self.walk().columns.width());
        let latent_dim = self.config().method.latent.dim();
        let latent = |row: Row, out: &mut [f32]| row.window().latents().write_means(out);
        let x = rows::gather(plans.clone(), [horizon, width], |row, out| row.window().write_plan(out))?;
        let latents = (latent_dim > 0).then(|| rows::gather(plans, [horizon, latent_dim], latent)).transpose()?;
        self.judge().worth(&x, latents.as_ref())
    }

    /// By the lesser of two critics, of the first actions, or of codes, in the state of now.
    fn worth_of_actions<'a>(&self, critic: &Critic, candidates: impl Iterator<Item = Row<'a>> + Clone + 'a) -> Result<Buffer> {
        let (layout, dim, walk) = (self.config().layout, self.config().method.latent.dim(), self.walk());
        let gather = |width: usize, write: &dyn Fn(Row<'a>) -> &'a [f32]| {
            rows::gather(candidates.clone(), [1, width], |row, out| out.copy_from_slice(write(row)))
        };
        let state = gather(layout.state_dim, &|row| row.window().descent().known())?;
        let choice = gather(Judged::of(layout, &self.config().method).choice_dim, &|row| row.window().choice(walk))?;
        let latent = (dim > 0).then(|| gather(dim, &|row| row.window().latents().mean_of_step(0))).transpose()?;
        let [mut worth, other] = critic.q(&state, &choice, latent.as_ref())?;
        worth.iter_mut().zip(other.iter()).for_each(|(worth, other)| *worth = worth.min(*other));
        Ok(worth)
    }
}

/// The candidates of all acts that choose.
fn candidates(acts: &[Act]) -> impl Iterator<Item = Row<'_>> + Clone {
    let acts = acts.iter().filter(|act| act.asks(Ask::Choose));
    acts.flat_map(|act| act.candidates().iter().map(move |window| Row::of(act, window)))
}

/// Adds gradients, one after the other, to the sums of the estimates that they belong to.
fn add<'a>(rows: impl Iterator<Item = Led<'a>>, gradients: &[f32], size: usize, sums: &mut [f32]) {
    for (Led { index, .. }, gradient) in rows.zip(gradients.chunks_exact(size)) {
        sums[index * size..][..size].iter_mut().zip(gradient).for_each(|(sum, gradient)| *sum += gradient);
    }
}
