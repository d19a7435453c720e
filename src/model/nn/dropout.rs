//! Dropout (Srivastava et al. 2014): numbers that are zeroed by chance in training.

use super::activations::Activations;
use crate::model::noise::Philox;
use candle_core::Result;
use std::cell::RefCell;

/// Where chance comes from: a stream of its own for each evaluation of a loss, drawn on in the order in which a network asks.
#[derive(Debug)]
pub struct Chance(RefCell<Philox>);

impl Chance {
    /// The stream of this seed.
    pub fn new(seed: u64) -> Self {
        Self(RefCell::new(Philox::new(seed)))
    }

    /// Zeroes each number with probability `share`, and scales the others by `1 / (1 - share)`, so that their mean stays.
    ///
    /// # Errors
    /// If candle says so.
    pub fn drop<V: Activations>(&self, x: V, share: f32) -> Result<V> {
        let (mut stream, kept) = (self.0.borrow_mut(), 1.0 / (1.0 - share));
        let mask =
            V::generate(x.shape()?, |mask| mask.iter_mut().for_each(|kind| *kind = if stream.uniform() < share { 0.0 } else { kept }))?;
        x.times(&mask)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::nn::testing::*;
    use candle_core::Tensor;

    /// As many as were asked for, the mean as it was, the same for the same seed, others for another; and the gradient goes where the value went.
    #[test]
    fn a_share_is_dropped_and_the_mean_stays() {
        let ones = Tensor::ones((50, 20, 40), candle_core::DType::F32, &candle_core::Device::Cpu).unwrap();
        let drop = |seed| flat(&Chance::new(seed).drop(ones.clone(), 0.25).unwrap());
        let dropped = drop(3);
        let zeros = dropped.iter().filter(|value| **value == 0.0).count() as f32 / dropped.len() as f32;
        assert!((zeros - 0.25).abs() < 0.01, "{zeros}");
        assert!(dropped.iter().all(|value| *value == 0.0 || (*value - 4.0 / 3.0).abs() < 1e-6));
        assert!((dropped.iter().sum::<f32>() / dropped.len() as f32 - 1.0).abs() < 0.01);
        assert!(drop(3) == dropped && drop(4) != dropped);
        check_gradients(&[gaussian(1, (2, 3, 5))], &|inputs| Chance::new(7).drop(inputs[0].clone(), 0.5));
    }
}
