//! What an optimizer does to every parameter.

use super::per_isa;

/// Lanes of a sum in f64; a fixed number, so that the order of addition is one for all processors.
const LANES: usize = 8;

per_isa! {
    /// Sum of squares, in f64.
    pub fn square_sum(values: &[f32]) -> f64 {
        let mut lanes = [0.0_f64; LANES];
        let (whole, rest) = values.split_at(values.len() - values.len() % LANES);
        for eight in whole.chunks_exact(LANES) {
            lanes.iter_mut().zip(eight).for_each(|(sum, value)| *sum += f64::from(*value) * f64::from(*value));
        }
        lanes.iter_mut().zip(rest).for_each(|(sum, value)| *sum += f64::from(*value) * f64::from(*value));
        lanes.iter().sum()
    }
}

/// One step of Adam with decoupled weight decay, the same for all parameters of a group.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep {
    /// Factor on the gradient: clipping.
    pub scale: f32,
    /// Decay rates of the moments.
    pub beta: (f32, f32),
    /// `1 - beta`, taken in f64: 1 - .999 in f32 is off by 5e-5 of itself.
    pub complement: (f32, f32),
    /// What is left of a parameter by weight decay.
    pub keep: f32,
    /// Learning rate over the first moment's bias correction.
    pub rate: f32,
    /// Inverse root of the second moment's bias correction.
    pub root: f32,
    /// Added to the denominator.
    pub epsilon: f32,
}

per_isa! {
    /// Moves parameters and moments.
    pub fn adam(step: AdamStep, values: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32]) {
        let moments = first.iter_mut().zip(second.iter_mut());
        for ((value, grad), (m, v)) in values.iter_mut().zip(grads).zip(moments) {
            let grad = grad * step.scale;
            *m = step.beta.0 * *m + step.complement.0 * grad;
            *v = step.beta.1 * *v + step.complement.1 * grad * grad;
            *value = step.keep * *value - step.rate * *m / (v.sqrt() * step.root + step.epsilon);
        }
    }
}

per_isa! {
    /// Moves an average towards values by a share of the way.
    pub fn toward(average: &mut [f32], values: &[f32], share: f32) {
        average.iter_mut().zip(values).for_each(|(average, value)| *average += share * (value - *average));
    }
}
