//! Times, each kept to better than one part in a thousand.

use std::time::Duration;

/// Counts of times, in nanoseconds.
#[derive(Clone, Debug)]
pub struct Histogram(hdrhistogram::Histogram<u64>);

impl Default for Histogram {
    fn default() -> Self {
        Self(hdrhistogram::Histogram::new_with_max(u64::MAX, 3).expect("three figures of 64 bits: or it is a bug"))
    }
}

impl Histogram {
    /// Counts one time.
    pub fn record(&mut self, time: Duration) {
        self.0.saturating_record(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX));
    }

    /// How many were counted.
    pub fn count(&self) -> u64 {
        self.0.len()
    }

    /// The smallest time that at least this share (0 to 1) of all times does not exceed, in ms; 0 if there are none.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        ms(self.0.value_at_quantile(share))
    }

    /// Mean in ms; 0 if there are none.
    pub fn mean_ms(&self) -> f64 {
        self.0.mean() / 1e6
    }

    /// The longest in ms.
    pub fn max_ms(&self) -> f64 {
        ms(self.0.max())
    }

    /// Counts over at most `rows` spans whose edges grow by the same factor, from the shortest to the longest time: `(upper edge in ms, count)`.
    pub fn spans(&self, rows: usize) -> Vec<(f64, u64)> {
        if self.0.is_empty() || rows == 0 {
            return Vec::new();
        }
        let (low, high) = ((self.0.min().max(1) as f64).ln(), (self.0.max().max(1) as f64).ln());
        let edge = |row: usize| (low + (high - low) * (row + 1) as f64 / rows as f64).exp();
        let mut spans: Vec<(f64, u64)> = (0..rows).map(|row| (edge(row) / 1e6, 0)).collect();
        for times in self.0.iter_recorded() {
            let time = ms(times.value_iterated_to());
            let row = spans.iter().position(|(edge, _)| time <= *edge).unwrap_or(rows - 1);
            spans[row].1 += times.count_since_last_iteration();
        }
        spans
    }
}

fn ms(nanos: u64) -> f64 {
    nanos as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(times: impl IntoIterator<Item = u64>) -> Histogram {
        let mut histogram = Histogram::default();
        times.into_iter().for_each(|nanos| histogram.record(Duration::from_nanos(nanos)));
        histogram
    }

    /// As the crate has it, a time stands for those of its bucket, by the upper edge; the mean goes by their middles.
    #[test]
    fn figures_are_of_the_times_in_ms() {
        let times = of((1..=1000).map(|ms| ms * 1_000_000));
        let near = |found: f64, exact: f64| (found / exact - 1.0).abs() < 1e-3;
        for share in [0.001, 0.5, 0.9, 0.99, 0.999, 1.0] {
            assert!(near(times.quantile_ms(share), share * 1000.0), "{share}: {}", times.quantile_ms(share));
        }
        assert!(near(times.mean_ms(), 500.5) && near(times.max_ms(), 1000.0) && times.count() == 1000);
        let none = Histogram::default();
        assert_eq!((none.count(), none.quantile_ms(0.99), none.mean_ms(), none.max_ms()), (0, 0.0, 0.0, 0.0));
        assert!(none.spans(5).is_empty());
    }

    #[test]
    fn spans_hold_every_time_once() {
        let histogram = of((1..=1000).map(|i| i * i * 1000));
        let spans = histogram.spans(12);
        assert_eq!(spans.iter().map(|(_, count)| count).sum::<u64>(), 1000);
        assert!(spans.windows(2).all(|pair| pair[0].0 < pair[1].0));
        assert_eq!(of([5, 5, 5]).spans(4).iter().map(|(_, count)| count).sum::<u64>(), 3);
    }
}
