//! Places for connections, and what a connection does with its place: whoever only holds it loses it.
//!
//! A connection is busy while a request is on its way in or an answer on its way out, until its last byte has left. One that is not busy for long
//! is asked to leave; one whose answer is not taken for long, or whose request does not come, is cut. What all of them make the server hold is
//! counted, and has a bound. An ActStream or a WebSocket ends by itself when it has nothing to do for long; a health watch may be silent for as long
//! as it likes, but of those, as of all connections, an address has only so many.

mod activity;
mod bodies;

pub use activity::{Activity, Held, Open, Verdict};
pub use bodies::{Asked, Given, Kind};

use crate::serve::config::{Config, ServerConfig};
use parking_lot::Mutex;
use std::{collections::HashMap, net::IpAddr, sync::Arc, time::Duration};

/// Who holds how many places.
#[derive(Debug)]
pub struct Places {
    held: Mutex<Count>,
    all_max: usize,
    address_max: usize,
}

#[derive(Debug, Default)]
struct Count {
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

impl Place {
    /// Whose it is.
    pub fn address(&self) -> IpAddr {
        self.address
    }
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

/// How often connections are looked at.
pub fn look_interval(config: &Config) -> Duration {
    let shortest = config.connection.idle_timeout_ms.min(config.connection.write_timeout_ms).min(config.connection.keepalive_timeout_ms);
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
}
