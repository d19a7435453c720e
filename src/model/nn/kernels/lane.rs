//! Numbers in lanes of sixteen, each on its own cache line.

/// Numbers of one lane.
pub(super) const LANE: usize = 16;

/// Sixteen numbers on a cache line of their own.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Lane(pub(super) [f32; LANE]);

/// The numbers of lanes, one after the other.
pub(super) fn flat(lanes: &[Lane]) -> &[f32] {
    // SAFETY: a lane is 16 f32 without a gap, and its alignment is a multiple of theirs.
    unsafe { std::slice::from_raw_parts(lanes.as_ptr().cast(), lanes.len() * LANE) }
}

/// See [`flat`].
pub(super) fn flat_mut(lanes: &mut [Lane]) -> &mut [f32] {
    // SAFETY: as above, and the borrow is unique.
    unsafe { std::slice::from_raw_parts_mut(lanes.as_mut_ptr().cast(), lanes.len() * LANE) }
}
