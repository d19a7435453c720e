//! Sinusoids of a noise level (Vaswani et al. 2017, section 3.5; sizes as in Diffuser's U-Net).

use candle_core::Result;

/// Whole numbers above this are computed anew at each call.
const TABLE_MAX: usize = 4096;

/// `sin(level f_j)` for `j < dim/2`, then `cos(level f_j)`, with `f_j = exp(-ln(10^4) j / (dim/2 - 1))`. Angles are taken in f64: a level
/// of 1000 keeps its last digits. Whole levels are looked up, as sines would cost a tenth of a small network's time.
#[derive(Clone, Debug)]
pub struct Sinusoid {
    frequencies: Vec<f64>,
    /// Rows of `dim` for the levels 0, 1, ...
    table: Vec<f32>,
}

impl Sinusoid {
    /// Ready for levels up to `level_max`.
    ///
    /// # Errors
    /// If `dim` is odd or below 4.
    pub fn new(dim: usize, level_max: usize) -> Result<Self> {
        if dim < 4 || !dim.is_multiple_of(2) {
            candle_core::bail!("a sinusoid needs an even dimension of at least 4, got {dim}");
        }
        let half = dim / 2;
        let rate = -1e4_f64.ln() / (half - 1) as f64;
        let mut sinusoid = Self { frequencies: (0..half).map(|j| (rate * j as f64).exp()).collect(), table: Vec::new() };
        let mut table = vec![0.0; (level_max.min(TABLE_MAX) + 1) * dim];
        table.chunks_exact_mut(dim).enumerate().for_each(|(level, row)| sinusoid.compute(level as f32, row));
        sinusoid.table = table;
        Ok(sinusoid)
    }

    /// Width of an embedding.
    pub fn dim(&self) -> usize {
        2 * self.frequencies.len()
    }

    /// The embedding of a level, `dim` values.
    pub fn write(&self, level: f32, out: &mut [f32]) {
        let row = level as usize * self.dim();
        match self.table.get(row..row + self.dim()) {
            Some(known) if level >= 0.0 && level.fract() == 0.0 => out.copy_from_slice(known),
            _ => self.compute(level, out),
        }
    }

    fn compute(&self, level: f32, out: &mut [f32]) {
        let (sines, cosines) = out.split_at_mut(self.frequencies.len());
        for ((sine, cosine), frequency) in sines.iter_mut().zip(cosines).zip(&self.frequencies) {
            let (s, c) = (f64::from(level) * frequency).sin_cos();
            (*sine, *cosine) = (s as f32, c as f32);
        }
    }
}
