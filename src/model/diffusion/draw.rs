//! Windows drawn for themselves, without an act: what a prior has to offer.

use super::{
    descent::{Descent, Sampling, Walk},
    schedule::Table,
};
use crate::model::{
    denoiser::{Denoiser, Given},
    method::Diffusion,
    nn::{Activations, Buffer},
    noise::Noise,
    options::SamplerOptions,
};
use candle_core::Result;

/// What is drawn, and how.
pub struct Draw<'a> {
    /// What a window is, and the way down to it.
    pub plan: &'a Diffusion,
    /// Columns, levels and bounds.
    pub walk: Walk<'a>,
    /// As an act would be sampled.
    pub options: &'a SamplerOptions,
    /// Where noise comes from; that of a row is keyed by `first` and its place.
    pub noise: Noise,
    /// Place of the first row among all that are ever drawn.
    pub first: u64,
}

impl Draw<'_> {
    /// One window for each row of the real steps that the denoiser is given, `(rows, T * D)` values: of models without latents that are told nothing.
    ///
    /// # Errors
    /// If a shape differs from the configuration, or the network's output is not finite.
    pub fn windows(&self, denoiser: &Denoiser, observed: Option<&Buffer>, rows: usize) -> Result<Vec<f32>> {
        let (horizon, width, walk) = (self.plan.horizon, self.walk.columns.width(), self.walk);
        let table = Table::of(self.plan, self.options.sub_steps).map_err(candle_core::Error::Msg)?;
        let descent = |row: usize| {
            let sampling = Sampling {
                table,
                actions: horizon,
                eta: self.options.eta,
                temperature: self.options.temperature,
                noise: self.noise,
                time: self.first + row as u64,
                at_once: (1, 0.0),
            };
            let mut descent = Descent::new(sampling, Vec::new(), horizon, walk.columns);
            descent.begin_cold(walk);
            descent
        };
        let mut descents: Vec<Descent> = (0..rows).map(descent).collect();
        while descents.iter().any(|descent| !descent.is_done()) {
            let gather = |width: usize, write: &dyn Fn(&Descent, &mut [f32])| {
                Buffer::generate([rows, horizon, width], |out| {
                    descents.iter().zip(out.chunks_exact_mut(horizon * width)).for_each(|(descent, out)| write(descent, out));
                })
            };
            let x = gather(width, &|descent, out| out.copy_from_slice(descent.x(0)))?;
            let levels = gather(1, &|descent, out| descent.write_levels(0, out))?;
            let mut said = denoiser.predict(&x, &Given { observed, ..Given::levels(&levels) })?;
            for (i, said) in said.iter_mut().enumerate() {
                *said = walk.process.x0(self.plan.target, levels[i / width] as usize, x[i], *said);
            }
            descents.iter_mut().zip(said.chunks_exact(horizon * width)).for_each(|(descent, x0)| descent.step_down(x0, walk));
        }
        if descents.iter().any(Descent::has_failed) {
            candle_core::bail!("the denoiser's output is not finite");
        }
        Ok(descents.iter().flat_map(|descent| (0..horizon).flat_map(|position| descent.given(position))).copied().collect())
    }
}
