//! What one connection has in hand, and what all of them make the server hold.

use crate::serve::config::ServerConfig;
use metrics::Gauge;
use parking_lot::Mutex;
use std::{
    collections::{BTreeMap, HashMap},
    net::IpAddr,
    sync::{
        Arc, Weak,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// The bytes that the server holds because of its clients: requests that are on their way in or in work, answers that are not taken. Beyond
/// `server.held_bytes_max` whoever holds most, for longest, is cut; a refusal would hit whoever comes next, and those are the honest ones.
pub struct Held {
    bytes: AtomicUsize,
    bytes_max: usize,
    gauge: Gauge,
    connections: Mutex<HashMap<u64, Weak<Activity>>>,
    number: AtomicU64,
}

impl Held {
    /// As much as the settings allow.
    pub fn new(config: &ServerConfig) -> Arc<Self> {
        Arc::new(Self {
            bytes: AtomicUsize::new(0),
            bytes_max: config.held_bytes_max,
            gauge: metrics::gauge!("ada_held_bytes"),
            connections: Mutex::default(),
            number: AtomicU64::new(0),
        })
    }

    /// A connection that begins.
    pub fn begin(self: &Arc<Self>, address: IpAddr, now: Instant) -> Arc<Activity> {
        let number = self.number.fetch_add(1, Ordering::Relaxed);
        let doing = Mutex::new(Doing { number: 0, open: BTreeMap::new(), idle_since: now });
        let activity = Arc::new(Activity { held: self.clone(), address, number, cut: CancellationToken::new(), doing });
        self.connections.lock().insert(number, Arc::downgrade(&activity));
        activity
    }

    fn change(&self, old: usize, new: usize) {
        let before = self.bytes.fetch_add(new, Ordering::Relaxed);
        self.bytes.fetch_sub(old, Ordering::Relaxed);
        self.gauge.increment(new as f64 - old as f64);
        if new > old && before + new - old > self.bytes_max {
            self.relieve(Instant::now());
        }
    }

    /// Cuts connections until the others hold no more than there is room for: of the address with the largest burden the one with the largest.
    fn relieve(&self, now: Instant) {
        // An activity that ends here, for this was the last to know of it, takes the lock itself.
        let all: Vec<_> = self.connections.lock().values().filter_map(Weak::upgrade).collect();
        let weigh = |activity: Arc<Activity>| (activity.burden(now), activity);
        let mut holding: Vec<_> = all.into_iter().filter(|activity| !activity.cut.is_cancelled()).map(weigh).collect();
        let mut bytes: usize = holding.iter().map(|(burden, _)| burden.bytes).sum();
        while bytes > self.bytes_max {
            let mut by_address: HashMap<IpAddr, u128> = HashMap::new();
            holding.iter().for_each(|(burden, activity)| *by_address.entry(activity.address).or_default() += burden.byte_us);
            let heaviest = |(_, (burden, activity)): &(usize, &(Burden, Arc<Activity>))| (by_address[&activity.address], burden.byte_us);
            let Some((i, _)) = holding.iter().enumerate().max_by_key(heaviest) else { return };
            let (burden, activity) = holding.swap_remove(i);
            bytes -= burden.bytes;
            activity.cut.cancel();
            metrics::counter!("ada_shed_total", "reason" => "HELD_BYTES").increment(1);
            tracing::warn!(address = %activity.address, bytes = burden.bytes, "a connection is cut: it makes the server hold too much");
        }
    }
}

/// What a connection has in hand.
pub struct Activity {
    held: Arc<Held>,
    address: IpAddr,
    /// Counts the connections of the server.
    pub number: u64,
    /// Cancelled when it has to go at once.
    pub cut: CancellationToken,
    doing: Mutex<Doing>,
}

struct Doing {
    number: u64,
    /// Requests that are not wholly answered.
    open: BTreeMap<u64, InHand>,
    idle_since: Instant,
}

struct InHand {
    since: Instant,
    /// Until when its answer must be taken; None: a stream, which may take its time, or it is still worked on.
    until: Option<Instant>,
    bytes: usize,
}

struct Burden {
    bytes: usize,
    /// Bytes times the time for which their request is in hand: of a megabyte that comes and goes it is little, of one that stays it grows.
    byte_us: u128,
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
    /// A request has come; it is open until the last that belongs to it is dropped.
    pub fn open(self: &Arc<Self>) -> Arc<Open> {
        let mut doing = self.doing.lock();
        doing.number += 1;
        let number = doing.number;
        // While it is worked on the engine's own deadlines bound it.
        doing.open.insert(number, InHand { since: Instant::now(), until: None, bytes: 0 });
        Arc::new(Open { activity: self.clone(), number })
    }

    /// What the clock says.
    pub fn verdict(&self, idle_max: Duration, now: Instant) -> Verdict {
        let doing = self.doing.lock();
        if doing.open.values().any(|in_hand| in_hand.until.is_some_and(|until| now >= until)) {
            return Verdict::Cut;
        }
        let is_idle = doing.open.is_empty() && now.saturating_duration_since(doing.idle_since) >= idle_max;
        if is_idle { Verdict::Leave } else { Verdict::Stay }
    }

    fn burden(&self, now: Instant) -> Burden {
        let doing = self.doing.lock();
        let weight = |in_hand: &InHand| in_hand.bytes as u128 * (1 + now.saturating_duration_since(in_hand.since).as_micros());
        let bytes = doing.open.values().map(|in_hand| in_hand.bytes).sum();
        Burden { bytes, byte_us: doing.open.values().map(weight).sum() }
    }
}

impl Drop for Activity {
    fn drop(&mut self) {
        self.held.connections.lock().remove(&self.number);
    }
}

/// A request that is not wholly answered.
pub struct Open {
    activity: Arc<Activity>,
    number: u64,
}

impl Open {
    /// Until when the answer must be taken.
    pub fn must_be_taken(&self, until: Option<Instant>) {
        if let Some(in_hand) = self.activity.doing.lock().open.get_mut(&self.number) {
            in_hand.until = until;
        }
    }

    fn change(&self, old: usize, new: usize) {
        if let Some(in_hand) = self.activity.doing.lock().open.get_mut(&self.number) {
            in_hand.bytes = in_hand.bytes + new - old;
        }
        self.activity.held.change(old, new);
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        let mut doing = self.activity.doing.lock();
        doing.open.remove(&self.number);
        doing.idle_since = Instant::now();
    }
}

/// Bytes that are held for a request; let go when it is dropped.
pub struct Hold {
    open: Arc<Open>,
    bytes: usize,
}

impl Hold {
    /// So many.
    pub fn new(open: Arc<Open>, bytes: usize) -> Self {
        open.change(0, bytes);
        Self { open, bytes }
    }

    /// Now it is so many.
    pub fn set(&mut self, bytes: usize) {
        self.open.change(self.bytes, bytes);
        self.bytes = bytes;
    }

    /// How many.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        self.open.change(self.bytes, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    #[test]
    fn verdicts() {
        let (begin, idle) = (Instant::now(), Duration::from_secs(10));
        let after = |seconds| begin + Duration::from_secs(seconds);
        let activity = Held::new(&ServerConfig::default()).begin(address(1), begin);
        let verdict = |seconds| activity.verdict(idle, after(seconds));
        assert_eq!([verdict(9), verdict(10)], [Verdict::Stay, Verdict::Leave]);
        let (first, second) = (activity.open(), activity.open());
        assert_eq!(verdict(1000), Verdict::Stay, "a request in work is none of ours");
        first.must_be_taken(Some(after(30)));
        second.must_be_taken(None);
        assert_eq!([verdict(29), verdict(30)], [Verdict::Stay, Verdict::Cut]);
        drop(first);
        assert_eq!(verdict(1000), Verdict::Stay, "a stream may be silent");
        drop(second);
        assert_eq!([verdict(5), verdict(1000)], [Verdict::Stay, Verdict::Leave]);
    }

    /// Whoever holds much for long goes, and not whoever comes last, nor whoever has many small things in hand.
    #[test]
    fn the_heaviest_is_cut() {
        let held = Held::new(&ServerConfig { held_bytes_max: 1000, ..ServerConfig::default() });
        let begin = Instant::now();
        let [greedy, greedier, honest] = [1, 1, 2].map(|last| held.begin(address(last), begin));
        let small = Hold::new(honest.open(), 300);
        let mut holds = vec![Hold::new(greedy.open(), 300), Hold::new(greedier.open(), 350)];
        let is_cut = || [&greedy, &greedier, &honest].map(|activity| activity.cut.is_cancelled());
        assert_eq!(is_cut(), [false; 3]);
        std::thread::sleep(Duration::from_millis(20));
        let newcomer = Hold::new(honest.open(), 200);
        assert_eq!(is_cut(), [false, true, false], "one is enough, and what is cut counts no longer");
        holds[0].set(900);
        assert_eq!(is_cut(), [true, true, false]);
        drop((holds, small, newcomer));
        assert_eq!(held.bytes.load(Ordering::Relaxed), 0);
        drop((greedy, greedier, honest));
        assert!(held.connections.lock().is_empty());
    }
}
