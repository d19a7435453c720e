//! Which candidate it is.

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Choice {
    /// Whether there is nothing left to choose.
    made: bool,
    index: usize,
    /// Its value and the spread of all, standard deviations of the data's returns.
    worth: Option<(f32, f32)>,
}

impl Choice {
    /// The first one, until another is chosen.
    pub(super) fn new(made: bool) -> Self {
        Self { made, index: 0, worth: None }
    }

    /// The best, of those that are as good the first; or by chance, each with probability `exp(value / temperature)`.
    pub(super) fn among(values: &[f32], temperature: f32, uniform: impl FnOnce() -> f32) -> Self {
        let best = (0..values.len()).fold(0, |best, index| if values[index] > values[best] { index } else { best });
        let weight = |value: f32| ((value - values[best]) / temperature).exp();
        let index = if temperature > 0.0 {
            let all: f32 = values.iter().map(|value| weight(*value)).sum();
            let mut left = all * uniform();
            let passed = |value: &f32| {
                left -= weight(*value);
                left < 0.0
            };
            values.iter().position(passed).unwrap_or(best)
        } else {
            best
        };
        let count = values.len() as f32;
        let mean = values.iter().sum::<f32>() / count;
        let spread = (values.iter().map(|value| (value - mean).powi(2)).sum::<f32>() / count).sqrt();
        Self { made: true, index, worth: Some((values[index], spread)) }
    }

    pub(super) fn is_made(&self) -> bool {
        self.made
    }

    pub(super) fn index(&self) -> usize {
        self.index
    }

    /// Its value and the spread of all, if they were asked for.
    pub(super) fn worth(&self) -> Option<(f32, f32)> {
        self.worth
    }
}
