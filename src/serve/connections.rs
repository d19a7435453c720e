//! Places for connections, and what a connection does with its place: whoever only holds it loses it.
//!
//! A connection is busy while a request is on its way in or an answer on its way out. One that is not busy for long is asked to leave; one whose
//! answer is not taken for long, or whose unary request does not come, is cut. An ActStream or a WebSocket ends by itself when it has nothing to do for
//! long; a health watch may be silent for as long as it likes, but of those, as of all connections, an address has only so many.

use crate::serve::config::{Config, ServerConfig};
use axum::body::Body;
use http_body_util::BodyExt;
use parking_lot::Mutex;
use std::{
    collections::{BTreeMap, HashMap},
    net::IpAddr,
    sync::Arc,
    time::{Duration, Instant},
};

/// Who holds how many places.
#[derive(Debug)]
pub struct Places {
    held: Mutex<Held>,
    all_max: usize,
    address_max: usize,
}

#[derive(Debug, Default)]
struct Held {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
}

impl Places {
    /// As many as the settings allow.
    pub fn new(config: &ServerConfig) -> Arc<Self> {
        Arc::new(Self {
            held: Mutex::default(),
            all_max: config.connections_max,
            address_max: config.connections_per_address_max.min(config.connections_max),
        })
    }

    /// A place for a connection from this address, given back when it is dropped; None if there is none.
    pub fn take(self: &Arc<Self>, address: IpAddr) -> Option<Place> {
        // IPv4 by way of IPv6 is the same machine.
        let address = address.to_canonical();
        let mut held = self.held.lock();
        let of_address = held.by_address.get(&address).copied().unwrap_or(0);
        if held.all >= self.all_max || of_address >= self.address_max {
            return None;
        }
        held.all += 1;
        held.by_address.insert(address, of_address + 1);
        Some(Place { places: self.clone(), address })
    }
}

/// A place; dropping it gives it back.
#[derive(Debug)]
pub struct Place {
    places: Arc<Places>,
    address: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut held = self.places.held.lock();
        held.all -= 1;
        if let Some(count) = held.by_address.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                held.by_address.remove(&self.address);
            }
        }
    }
}

/// What a connection has in hand.
#[derive(Debug)]
pub struct Activity(Mutex<Doing>);

#[derive(Debug)]
struct Doing {
    number: u64,
    /// Requests that are not wholly answered, with the time until which their answer must be taken; None: a stream, which may take its time.
    open: BTreeMap<u64, Option<Instant>>,
    idle_since: Instant,
}

/// What is to become of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing.
    Stay,
    /// No new requests: it has been idle for long.
    Leave,
    /// An answer is not taken.
    Cut,
}

impl Activity {
    /// Of a connection that begins.
    pub fn new(now: Instant) -> Arc<Self> {
        Arc::new(Self(Mutex::new(Doing { number: 0, open: BTreeMap::new(), idle_since: now })))
    }

    /// A request has come; it is open until the guard is dropped.
    pub fn begin(self: &Arc<Self>) -> Open {
        let mut doing = self.0.lock();
        doing.number += 1;
        let number = doing.number;
        // While it is worked on the engine's own deadlines bound it.
        doing.open.insert(number, None);
        Open { activity: self.clone(), number }
    }

    /// What the clock says.
    pub fn verdict(&self, idle_max: Duration, now: Instant) -> Verdict {
        let doing = self.0.lock();
        if doing.open.values().flatten().any(|until| now >= *until) {
            return Verdict::Cut;
        }
        let is_idle = doing.open.is_empty() && now.saturating_duration_since(doing.idle_since) >= idle_max;
        if is_idle { Verdict::Leave } else { Verdict::Stay }
    }
}

/// A request that is not wholly answered.
#[derive(Debug)]
pub struct Open {
    activity: Arc<Activity>,
    number: u64,
}

impl Open {
    /// The answer's body, which must be taken until then, and holds the request open until it is.
    pub fn until_taken(self, body: Body, until: Option<Instant>) -> Body {
        if let Some(open) = self.activity.0.lock().open.get_mut(&self.number) {
            *open = until;
        }
        Body::new(body.map_frame(move |frame| {
            let _open = &self;
            frame
        }))
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        let mut doing = self.activity.0.lock();
        doing.open.remove(&self.number);
        doing.idle_since = Instant::now();
    }
}

/// How often connections are looked at.
pub fn look_interval(config: &Config) -> Duration {
    let shortest = config.connection.idle_timeout_ms.min(config.connection.write_timeout_ms);
    Duration::from_millis((shortest / 4).clamp(20, 5_000))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_its_share() {
        let places = Places::new(&ServerConfig { connections_max: 4, connections_per_address_max: 3, ..ServerConfig::default() });
        let [a, b, c]: [IpAddr; 3] = ["10.0.0.1", "10.0.0.2", "::ffff:10.0.0.1"].map(|text| text.parse().unwrap());
        let mut held = [a, a, c].map(|address| places.take(address)).into_iter().collect::<Vec<_>>();
        assert!(held.iter().all(Option::is_some));
        assert!(places.take(a).is_none() && places.take(c).is_none(), "one address has its share and no more");
        let other = places.take(b).expect("another has a place all the same");
        assert!(places.take(b).is_none(), "all together have so many");
        held[0] = None;
        assert!(places.take(b).is_some());
        drop((held, other));
        assert!(places.held.lock().by_address.is_empty() && places.held.lock().all == 0);
    }

    #[test]
    fn verdicts() {
        let (begin, idle) = (Instant::now(), Duration::from_secs(10));
        let after = |seconds| begin + Duration::from_secs(seconds);
        let activity = Activity::new(begin);
        let verdict = |seconds| activity.verdict(idle, after(seconds));
        assert_eq!([verdict(9), verdict(10)], [Verdict::Stay, Verdict::Leave]);
        let (first, second) = (activity.begin(), activity.begin());
        assert_eq!(verdict(1000), Verdict::Stay, "a request in work is none of ours");
        let answer = first.until_taken(Body::from("x"), Some(after(30)));
        let stream = second.until_taken(Body::from("x"), None);
        assert_eq!([verdict(29), verdict(30)], [Verdict::Stay, Verdict::Cut]);
        drop(answer);
        assert_eq!(verdict(1000), Verdict::Stay, "a stream may be silent");
        drop(stream);
        assert_eq!([verdict(5), verdict(1000)], [Verdict::Stay, Verdict::Leave]);
    }
}
