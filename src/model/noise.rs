//! Counter-based noise: the only randomness of the model (same seed, same observations, same bytes).
//!
//! A value of noise is a function of a key and a counter (Philox 4x32-10; Salmon et al. 2011, "Parallel random numbers: as easy as
//! 1, 2, 3"), never of how many draws came before elsewhere. The sampler keys by (seed, absolute time, level, slot), so an act gives
//! the same chunk whatever shares its batch, and a restart continues the same stream.

const MULTIPLIERS: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const ROUNDS: usize = 10;

/// Ten rounds of Philox 4x32.
fn philox(key: [u32; 2], counter: [u32; 4]) -> [u32; 4] {
    let (mut k, mut c) = (key, counter);
    for _ in 0..ROUNDS {
        let products = [u64::from(MULTIPLIERS[0]) * u64::from(c[0]), u64::from(MULTIPLIERS[1]) * u64::from(c[2])];
        let (high, low) = (products.map(|p| (p >> 32) as u32), products.map(|p| p as u32));
        c = [high[1] ^ c[1] ^ k[0], low[1], high[0] ^ c[3] ^ k[1], low[0]];
        k = [k[0].wrapping_add(WEYL[0]), k[1].wrapping_add(WEYL[1])];
    }
    c
}

/// What a draw is for; the fourth word of the counter, so that streams never meet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Slot {
    /// A new position of the window, at pure noise.
    Window = 1,
    /// The step noise of a reverse jump.
    Jump = 2,
    /// The forward jump that re-noises a window.
    Renoise = 3,
    /// The epsilon of a latent.
    Latent = 4,
    /// Inverse dynamics: an action at pure noise, and its way down.
    Inverse = 6,
    /// The choice among candidates.
    Choice = 7,
    /// A future of Monte Carlo guidance.
    Future = 8,
    /// Anything drawn in sequence from one key: parameter initialisation, batches.
    Sequence = 5,
}

/// A stateless source keyed by a session's seed: `eps ~ N(0, I)` at (time, level, slot).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Noise {
    seed: u64,
}

impl Noise {
    /// The noise of this seed.
    pub fn new(seed: u64) -> Self {
        Self { seed }
    }

    /// The noise of one of several windows that are sampled side by side; the first has that of a window alone.
    pub fn of_candidate(self, index: usize) -> Self {
        Self { seed: self.seed ^ (index as u64).wrapping_mul(0xD1B5_4A32_D192_ED03) }
    }

    /// A number in [0, 1) of absolute environment time `time`.
    pub fn uniform(&self, time: u64, slot: Slot) -> f32 {
        let words = philox(self.key(time), [0, 0, time as u32, slot as u32]);
        (words[0] >> 8) as f32 / (1 << 24) as f32
    }

    fn key(&self, time: u64) -> [u32; 2] {
        split(self.seed ^ (time >> 32).wrapping_mul(0x9E37_79B9_7F4A_7C15))
    }

    /// Fills `out` with standard Gaussian noise of absolute environment time `time`, fine level `level`, purpose `slot`.
    pub fn fill(&self, time: u64, level: u32, slot: Slot, out: &mut [f32]) {
        let key = self.key(time);
        for (block, four) in out.chunks_mut(4).enumerate() {
            let words = philox(key, [block as u32, level, time as u32, slot as u32]);
            let normals = gaussians(words);
            four.copy_from_slice(&normals[..four.len()]);
        }
    }
}

/// A sequential stream over the same generator, for what is drawn once in order (initial weights, training batches).
/// Its state is its position, so a stopped run can take it up again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Philox {
    seed: u64,
    position: u64,
    ready: Vec<u32>,
}

impl Philox {
    /// The stream of this seed, from its start.
    pub fn new(seed: u64) -> Self {
        Self::at(seed, 0)
    }

    /// The stream of this seed from block `position` on.
    pub fn at(seed: u64, position: u64) -> Self {
        Self { seed, position, ready: Vec::new() }
    }

    /// The stream of this seed and name: streams of different names are independent.
    pub fn named(seed: u64, name: &str) -> Self {
        let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
        Self::new(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ hash)
    }

    /// The next 32 random bits.
    pub fn bits(&mut self) -> u32 {
        if self.ready.is_empty() {
            let counter = [self.position as u32, (self.position >> 32) as u32, 0, Slot::Sequence as u32];
            self.ready = philox(split(self.seed), counter).to_vec();
            self.position += 1;
        }
        self.ready.pop().expect("the block was just filled: is a bug")
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        (self.bits() >> 8) as f32 / (1 << 24) as f32
    }

    /// Uniform in `0..bound`; the bias is below `bound / 2^32`.
    pub fn below(&mut self, bound: usize) -> usize {
        ((u64::from(self.bits()) * bound as u64) >> 32) as usize
    }

    /// Standard Gaussian.
    pub fn normal(&mut self) -> f32 {
        box_muller(self.bits(), self.bits())[0]
    }
}

fn split(seed: u64) -> [u32; 2] {
    [seed as u32, (seed >> 32) as u32]
}

fn gaussians(words: [u32; 4]) -> [f32; 4] {
    let ([a, b], [c, d]) = (box_muller(words[0], words[1]), box_muller(words[2], words[3]));
    [a, b, c, d]
}

/// Two independent standard Gaussians from 64 random bits (Box and Muller 1958), in f64 so that the tail reaches 6 sigma.
fn box_muller(a: u32, b: u32) -> [f32; 2] {
    let radius = (-2.0 * ((f64::from(a) + 0.5) / 4_294_967_296.0).ln()).sqrt();
    let angle = std::f64::consts::TAU * f64::from(b) / 4_294_967_296.0;
    [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Known answers of the reference implementation (Random123, `kat_vectors`, philox4x32 10).
    #[test]
    fn known_answers() {
        assert_eq!(philox([0, 0], [0; 4]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
        assert_eq!(philox([u32::MAX; 2], [u32::MAX; 4]), [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]);
    }

    #[test]
    fn gaussian_moments() {
        let mut values = vec![0.0; 40_000];
        Noise::new(7).fill(3, 2, Slot::Jump, &mut values);
        let mean = values.iter().sum::<f32>() / 40_000.0;
        let var = values.iter().map(|v| v * v).sum::<f32>() / 40_000.0;
        assert!(mean.abs() < 0.02 && (var - 1.0).abs() < 0.03, "mean {mean}, variance {var}");
    }

    #[test]
    fn keys_separate_streams() {
        let draw = |seed, time, level, slot| {
            let mut out = [0.0; 6];
            Noise::new(seed).fill(time, level, slot, &mut out);
            out
        };
        let base = draw(1, 2, 3, Slot::Jump);
        assert_eq!(base, draw(1, 2, 3, Slot::Jump));
        let mut beside = [0.0; 6];
        Noise::new(1).of_candidate(1).fill(2, 3, Slot::Jump, &mut beside);
        assert!(beside != base && Noise::new(1).of_candidate(0) == Noise::new(1));
        let drawn: Vec<f32> = (0..1000).map(|time| Noise::new(5).uniform(time, Slot::Choice)).collect();
        assert!((drawn.iter().sum::<f32>() / 1000.0 - 0.5).abs() < 0.03 && drawn.iter().all(|u| (0.0..1.0).contains(u)));
        for other in [draw(2, 2, 3, Slot::Jump), draw(1, 1 << 40, 3, Slot::Jump), draw(1, 2, 4, Slot::Jump), draw(1, 2, 3, Slot::Latent)] {
            assert_ne!(base, other);
        }
    }
}
