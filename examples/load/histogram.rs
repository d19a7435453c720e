//! Times in log-linear buckets, as in HdrHistogram (Gil Tene): each power of two is cut into the same number of equal parts, so that every
//! time is kept to better than one part in a thousand, in a table that grows with the logarithm of the longest.

use std::time::Duration;

/// Parts of a power of two: three significant figures need 1000.
const PARTS: u64 = 1 << PARTS_LOG2;
const PARTS_LOG2: u32 = 10;

/// Counts of times, in nanoseconds.
#[derive(Clone, Debug, Default)]
pub struct Histogram {
    buckets: Vec<u64>,
    count: u64,
    sum: u128,
    min: u64,
    max: u64,
}

impl Histogram {
    /// Counts one time.
    pub fn record(&mut self, time: Duration) {
        let nanos = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let index = index(nanos);
        if index >= self.buckets.len() {
            self.buckets.resize(index + 1, 0);
        }
        self.buckets[index] += 1;
        self.min = if self.count == 0 { nanos } else { self.min.min(nanos) };
        self.max = self.max.max(nanos);
        self.sum += u128::from(nanos);
        self.count += 1;
    }

    /// How many were counted.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The smallest time that at least this share (0 to 1) of all times does not exceed, in ms; 0 if there are none.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        let wanted = ((share * self.count as f64).ceil() as u64).clamp(1, self.count.max(1));
        let mut seen = 0;
        let reaches = |count: &u64| {
            seen += count;
            seen >= wanted
        };
        let index = self.buckets.iter().position(reaches);
        // The upper edge: no time is said to be shorter than it was.
        index.map_or(0.0, |index| ms(last(index).clamp(self.min, self.max)))
    }

    /// Mean in ms; 0 if there are none.
    pub fn mean_ms(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum as f64 / self.count as f64 / 1e6 }
    }

    /// The longest in ms.
    pub fn max_ms(&self) -> f64 {
        ms(self.max)
    }

    /// Counts over at most `rows` spans whose edges grow by the same factor, from the shortest to the longest time: `(upper edge in ms, count)`.
    pub fn spans(&self, rows: usize) -> Vec<(f64, u64)> {
        if self.count == 0 || rows == 0 {
            return Vec::new();
        }
        let (low, high) = ((self.min.max(1) as f64).ln(), (self.max.max(1) as f64).ln());
        let edge = |row: usize| (low + (high - low) * (row + 1) as f64 / rows as f64).exp();
        let mut spans: Vec<(f64, u64)> = (0..rows).map(|row| (edge(row) / 1e6, 0)).collect();
        for (index, count) in self.buckets.iter().enumerate().filter(|(_, count)| **count > 0) {
            let time = ms(last(index).clamp(self.min, self.max));
            let row = spans.iter().position(|(edge, _)| time <= *edge).unwrap_or(rows - 1);
            spans[row].1 += count;
        }
        spans
    }
}

fn ms(nanos: u64) -> f64 {
    nanos as f64 / 1e6
}

/// Bucket of a time. The first `2 * PARTS` buckets hold one nanosecond each; from there every `PARTS` buckets span the next power of two.
fn index(nanos: u64) -> usize {
    let shift = (nanos | PARTS).ilog2() - PARTS_LOG2;
    (u64::from(shift) * PARTS + (nanos >> shift)) as usize
}

/// The longest time of a bucket.
fn last(index: usize) -> u64 {
    let index = index as u64;
    let shift = (index / PARTS).saturating_sub(1);
    let next = u128::from(index - shift * PARTS + 1) << shift;
    u64::try_from(next - 1).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(times: impl IntoIterator<Item = u64>) -> Histogram {
        let mut histogram = Histogram::default();
        times.into_iter().for_each(|nanos| histogram.record(Duration::from_nanos(nanos)));
        histogram
    }

    #[test]
    fn every_time_lies_in_its_bucket() {
        let near = |power: u32| [-1_i64, 0, 1].map(|step| (1_u64 << power).wrapping_add_signed(step));
        for nanos in (0..64).flat_map(near).chain((0..5000).map(|i| i * 977)) {
            let bucket = index(nanos);
            assert!(nanos <= last(bucket), "{nanos}");
            assert!(bucket == 0 || nanos > last(bucket - 1), "{nanos}");
            assert!((last(bucket) - nanos) as f64 <= nanos as f64 / 1000.0, "three figures: {nanos}");
        }
        assert_eq!(last(index(u64::MAX)), u64::MAX);
    }

    #[test]
    fn quantiles_agree_with_the_sorted_list() {
        let times: Vec<u64> = (0..10_000_u64).map(|i| 50_000 + (i * 7919 % 10_007).pow(2)).collect();
        let histogram = of(times.iter().copied());
        let mut sorted = times.clone();
        sorted.sort_unstable();
        for share in [0.001, 0.5, 0.9, 0.99, 0.999, 1.0] {
            let exact = sorted[(share * 10_000.0) as usize - 1] as f64 / 1e6;
            let found = histogram.quantile_ms(share);
            assert!(found >= exact && found <= exact * 1.001, "{share}: {found} and {exact}");
        }
        let mean = times.iter().sum::<u64>() as f64 / 10_000.0 / 1e6;
        assert!((histogram.mean_ms() - mean).abs() < 1e-9);
        assert_eq!(histogram.max_ms(), *sorted.last().unwrap() as f64 / 1e6);
    }

    #[test]
    fn one_and_none() {
        let one = of([1_234_567]);
        assert_eq!((one.quantile_ms(0.0), one.quantile_ms(0.5), one.quantile_ms(1.0)), (1.234_567, 1.234_567, 1.234_567));
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
