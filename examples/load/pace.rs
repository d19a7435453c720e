//! When acts are due.

use super::{
    flags::Arrivals,
    tally::{Tally, Window},
};
use ada_diffuser::model::noise::Philox;
use std::{
    cmp::Reverse,
    collections::BinaryHeap,
    thread,
    time::{Duration, Instant},
};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

/// What tells a client when its next act is due.
pub enum Pace {
    /// When the last one is answered.
    Closed,
    /// At these times.
    Open(UnboundedReceiver<Instant>),
}

impl Pace {
    /// When the next act was due, as soon as that is past; `None` when the time is over.
    pub async fn next(&mut self, tally: &Tally) -> Option<Instant> {
        match self {
            Self::Closed => Some(Instant::now()).filter(|now| *now < tally.window.end),
            Self::Open(times) => {
                while let Some(due) = times.recv().await {
                    if Instant::now() < tally.window.end {
                        return Some(due);
                    }
                    tally.give_up(due);
                }
                None
            }
        }
    }

    /// Waits before an act that failed is tried again: an open loop has its own times.
    pub async fn pause(&self, retry_after: Option<Duration>) {
        const PAUSE: Duration = Duration::from_millis(10);
        if matches!(self, Self::Closed) {
            tokio::time::sleep(retry_after.unwrap_or(PAUSE)).await;
        }
    }
}

/// The times of one client.
struct Arrival {
    arrivals: Arrivals,
    /// Mean time between two acts.
    period: f64,
    noise: Philox,
    sink: UnboundedSender<Instant>,
}

impl Arrival {
    /// Time until the next act.
    fn gap(&mut self) -> Duration {
        Duration::from_secs_f64(match self.arrivals {
            Arrivals::Even => self.period,
            Arrivals::Poisson => -self.period * (1.0 - f64::from(self.noise.uniform())).max(1e-9).ln(),
        })
    }
}

/// An open loop: `len` clients with an act every `period` seconds each, on average. The times come from a thread, since the timers of the
/// runtime are no finer than a millisecond.
pub fn open(len: usize, period: f64, arrivals: Arrivals, seed: u64, window: Window) -> Vec<Pace> {
    let (sinks, paces): (Vec<_>, Vec<_>) = (0..len).map(|_| unbounded_channel()).map(|(sink, times)| (sink, Pace::Open(times))).unzip();
    let with_noise = |(i, sink)| Arrival { arrivals, period, noise: Philox::named(seed, &format!("arrivals.{i}")), sink };
    let clients = sinks.into_iter().enumerate().map(with_noise).collect();
    thread::spawn(move || call(clients, window));
    paces
}

fn call(mut clients: Vec<Arrival>, window: Window) {
    let phase = |client: &mut Arrival| window.start + Duration::from_secs_f64(client.period * f64::from(client.noise.uniform()));
    let mut due: BinaryHeap<_> = clients.iter_mut().enumerate().map(|(i, client)| Reverse((phase(client), i))).collect();
    while let Some(Reverse((time, i))) = due.pop().filter(|Reverse((time, _))| *time < window.end) {
        thread::sleep(time.saturating_duration_since(Instant::now()));
        // A client that has ended needs no more times.
        if clients[i].sink.send(time).is_ok() {
            due.push(Reverse((time + clients[i].gap(), i)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Times in seconds from the start, of each client.
    fn times(len: usize, period: f64, arrivals: Arrivals, seed: u64) -> Vec<Vec<f64>> {
        let window = Window::from_now(Duration::ZERO, Duration::from_millis(300));
        let since_start = |pace: Pace| {
            let Pace::Open(mut times) = pace else { panic!("an open loop has times") };
            std::iter::from_fn(|| times.blocking_recv()).map(|due| (due - window.start).as_secs_f64()).collect()
        };
        open(len, period, arrivals, seed, window).into_iter().map(since_start).collect()
    }

    #[test]
    fn even_times_have_one_period_and_phases_of_their_own() {
        let all = times(3, 0.01, Arrivals::Even, 1);
        for client in &all {
            assert!((29..=30).contains(&client.len()) && client[0] < 0.01, "{client:?}");
            assert!(client.windows(2).all(|pair| (pair[1] - pair[0] - 0.01).abs() < 1e-6), "{client:?}");
        }
        assert!(all[0][0] != all[1][0] && all[1][0] != all[2][0]);
        assert_eq!(all, times(3, 0.01, Arrivals::Even, 1), "the seed decides");
    }

    #[test]
    fn poisson_times_scatter_around_the_period() {
        let all = times(20, 0.002, Arrivals::Poisson, 2);
        let gaps: Vec<f64> = all.iter().flat_map(|client| client.windows(2).map(|pair| pair[1] - pair[0])).collect();
        let mean = gaps.iter().sum::<f64>() / gaps.len() as f64;
        let spread = (gaps.iter().map(|gap| (gap - mean).powi(2)).sum::<f64>() / gaps.len() as f64).sqrt();
        // About 3000 gaps: the mean of an exponential is known to 2 %, its spread (equal to the mean) to 3 %.
        assert!((mean / 0.002 - 1.0).abs() < 0.08 && (spread / mean - 1.0).abs() < 0.12, "{mean} {spread}");
    }
}
