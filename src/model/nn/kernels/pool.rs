//! Memory for activations and scratch: buffers of this thread that are used again and again, so that steady work allocates nothing.

use super::lane::{LANE, Lane, flat, flat_mut};
use std::{
    cell::RefCell,
    ops::{Deref, DerefMut},
};

/// Number of sizes: powers of two, in lanes.
const CLASSES: usize = 32;

thread_local! { static FREE: RefCell<[Vec<Vec<Lane>>; CLASSES]> = const { RefCell::new([const { Vec::new() }; CLASSES]) }; }

/// A slice of `len` numbers, on cache lines of its own, that goes back to the thread's pool when it is dropped. What stands in it at
/// first is left over from earlier work.
#[derive(Debug)]
pub struct Pooled {
    /// Always of the full length of its class, so that nothing is ever cleared to be given out.
    lanes: Vec<Lane>,
    len: usize,
}

impl Pooled {
    /// A buffer of `len` numbers with any content.
    pub fn take(len: usize) -> Self {
        let class = class_of(len.div_ceil(LANE));
        let used = FREE.with_borrow_mut(|free| free[class].pop());
        Self { lanes: used.unwrap_or_else(|| vec![Lane::default(); 1 << class]), len }
    }

    /// A buffer of `len` zeros.
    pub fn zeros(len: usize) -> Self {
        let mut zeros = Self::take(len);
        zeros.fill(0.0);
        zeros
    }

    /// A buffer of these numbers.
    pub fn copy_of(values: &[f32]) -> Self {
        let mut copy = Self::take(values.len());
        copy.copy_from_slice(values);
        copy
    }

    /// The lanes that hold it.
    pub(super) fn lanes(&self) -> &[Lane] {
        &self.lanes[..self.len.div_ceil(LANE)]
    }

    /// See [`Self::lanes`].
    pub(super) fn lanes_mut(&mut self) -> &mut [Lane] {
        &mut self.lanes[..self.len.div_ceil(LANE)]
    }
}

fn class_of(lanes: usize) -> usize {
    lanes.next_power_of_two().trailing_zeros() as usize
}

impl Deref for Pooled {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &flat(&self.lanes)[..self.len]
    }
}

impl DerefMut for Pooled {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut flat_mut(&mut self.lanes)[..self.len]
    }
}

impl Clone for Pooled {
    fn clone(&self) -> Self {
        Self::copy_of(self)
    }
}

impl Drop for Pooled {
    fn drop(&mut self) {
        let lanes = std::mem::take(&mut self.lanes);
        // At the end of a thread the pool may be gone already: then the memory goes back to the system.
        let _ = FREE.try_with(|free| free.borrow_mut()[class_of(lanes.len())].push(lanes));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_given_back_is_given_out_again() {
        let first = Pooled::take(100);
        let place = first.as_ptr();
        drop(first);
        assert_eq!(Pooled::take(128).as_ptr(), place, "the same class");
        let held = Pooled::take(65);
        let other = Pooled::take(70);
        assert_ne!(held.as_ptr(), other.as_ptr());
        assert_eq!((held.len(), Pooled::zeros(3).to_vec()), (65, vec![0.0; 3]));
    }
}
