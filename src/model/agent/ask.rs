//! The questions of an act.

/// What an act asks of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ask {
    /// The latent of now, from what was really seen; then its windows start.
    Filter,
    /// The latents of later positions, each told from the one before; not of windows that are refined first, which brings them too.
    RollOut,
    /// The latent of position 0 anew, with the noised positions 0 and 1 (zig-zag).
    Refine,
    /// The clean window.
    Denoise,
    /// The action of a step, where a plan has none: that which leads from one of its states to the next, or does what a code says.
    Decode,
    /// What the plans are worth, to choose among them.
    Choose,
}

impl Ask {
    /// In this order they are answered in one tick: an act that has its latents can be denoised at once.
    pub const ORDER: [Self; 6] = [Self::Filter, Self::RollOut, Self::Refine, Self::Denoise, Self::Decode, Self::Choose];
}
