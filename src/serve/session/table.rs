//! All sessions: a sharded table with a cap, a time to live, and a memory for how sessions ended.

use crate::serve::{
    config::SessionsConfig,
    error::ServiceError,
    session::{Opening, Session},
};
use parking_lot::Mutex;
use std::{
    collections::{HashMap, VecDeque},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};
use uuid::Uuid;

const SHARDS: usize = 16;

/// How a session ended without its client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    Expired,
    Evicted,
}

impl Ending {
    fn word(self) -> &'static str {
        match self {
            Ending::Expired => "expired",
            Ending::Evicted => "evicted",
        }
    }

    fn error(self) -> ServiceError {
        match self {
            Ending::Expired => ServiceError::SessionExpired,
            Ending::Evicted => ServiceError::SessionEvicted,
        }
    }
}

/// The table. Locks are taken in the order shard, slot, and held for moments.
pub struct Sessions {
    shards: [Mutex<Shard>; SHARDS],
    len: AtomicUsize,
    bytes: Arc<AtomicUsize>,
    config: SessionsConfig,
}

#[derive(Default)]
struct Shard {
    live: HashMap<Uuid, Arc<Session>>,
    ended: HashMap<Uuid, Ending>,
    /// The same, oldest first.
    endings: VecDeque<(Instant, Uuid)>,
}

impl Sessions {
    /// An empty table.
    pub fn new(config: SessionsConfig) -> Self {
        Self { shards: Default::default(), len: AtomicUsize::new(0), bytes: Arc::default(), config }
    }

    /// Live sessions.
    pub fn len(&self) -> usize {
        self.len.load(Ordering::Relaxed)
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory of all episodes.
    pub fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Adds a session, evicting an idle one where there is no room.
    ///
    /// # Errors
    /// `Quota` if there is no room and nobody idle for long enough.
    pub fn open(&self, opening: Opening, now: Instant) -> Result<Arc<Session>, ServiceError> {
        while self.bytes() + opening.episode.size_bytes() > self.config.bytes_max {
            self.evict(now)?;
        }
        while self.len.fetch_add(1, Ordering::Relaxed) >= self.config.len_max {
            self.len.fetch_sub(1, Ordering::Relaxed);
            self.evict(now)?;
        }
        let session = Arc::new(Session::new(opening, self.bytes.clone(), now));
        self.shard(session.id).lock().live.insert(session.id, session.clone());
        metrics::counter!("ada_sessions_created_total").increment(1);
        Ok(session)
    }

    /// A live session, touched.
    ///
    /// # Errors
    /// If there is none of this id, or if it ended by itself not long ago.
    pub fn get(&self, id: Uuid, now: Instant) -> Result<Arc<Session>, ServiceError> {
        let mut shard = self.shard(id).lock();
        if let Some(session) = shard.live.get(&id).cloned() {
            if session.end_if_idle(session.ttl, now) {
                self.bury(&mut shard, id, Ending::Expired, now);
                return Err(ServiceError::SessionExpired);
            }
            session.touch(now);
            return Ok(session);
        }
        Err(shard.ended.get(&id).map_or(ServiceError::SessionNotFound, |ending| ending.error()))
    }

    /// Ends a session; an act in flight is dropped.
    ///
    /// # Errors
    /// As [`Sessions::get`].
    pub fn close(&self, id: Uuid, now: Instant) -> Result<(), ServiceError> {
        let session = self.get(id, now)?;
        if self.shard(id).lock().live.remove(&id).is_none() {
            return Err(ServiceError::SessionNotFound);
        }
        self.len.fetch_sub(1, Ordering::Relaxed);
        session.end();
        metrics::counter!("ada_sessions_ended_total", "reason" => "closed").increment(1);
        Ok(())
    }

    /// Up to `len` sessions with ids above `after`, in order of id.
    pub fn page(&self, after: Option<Uuid>, model: Option<&str>, len: usize) -> Vec<Arc<Session>> {
        let wanted =
            |session: &&Arc<Session>| after.is_none_or(|after| session.id > after) && model.is_none_or(|model| *session.model == *model);
        let mut found: Vec<_> = Vec::new();
        for shard in &self.shards {
            found.extend(shard.lock().live.values().filter(wanted).cloned());
        }
        found.sort_unstable_by_key(|session| session.id);
        found.truncate(len);
        found
    }

    /// Ends what has expired, evicts while memory is short, forgets old endings.
    pub fn reap(&self, now: Instant) {
        for shard in &self.shards {
            let mut shard = shard.lock();
            let expired = |session: &&Arc<Session>| session.end_if_idle(session.ttl, now);
            let ids: Vec<_> = shard.live.values().filter(expired).map(|session| session.id).collect();
            for id in ids {
                self.bury(&mut shard, id, Ending::Expired, now);
            }
            shard.forget(Duration::from_millis(self.config.tombstone_ttl_ms), now);
        }
        while self.bytes() > self.config.bytes_max && self.evict(now).is_ok() {}
        metrics::gauge!("ada_sessions").set(self.len() as f64);
        metrics::gauge!("ada_session_state_bytes").set(self.bytes() as f64);
    }

    /// Evicts the session that is idle for longest.
    fn evict(&self, now: Instant) -> Result<(), ServiceError> {
        let idle_min = Duration::from_millis(self.config.evict_idle_ms);
        // A candidate may become busy between look and grasp: then look again, but not for ever.
        for _ in 0..4 {
            let Some((_, id)) = self.longest_idle() else { break };
            let mut shard = self.shard(id).lock();
            let Some(session) = shard.live.get(&id) else { continue };
            if session.end_if_idle(idle_min, now) {
                self.bury(&mut shard, id, Ending::Evicted, now);
                return Ok(());
            }
        }
        metrics::counter!("ada_shed_total", "reason" => "QUOTA").increment(1);
        Err(ServiceError::Quota { retry_after_ms: self.config.reap_interval_ms })
    }

    fn longest_idle(&self) -> Option<(Instant, Uuid)> {
        let oldest = |shard: &Mutex<Shard>| {
            let shard = shard.lock();
            shard.live.values().filter_map(|session| Some((session.idle_since()?, session.id))).min()
        };
        self.shards.iter().filter_map(oldest).min()
    }

    fn bury(&self, shard: &mut Shard, id: Uuid, ending: Ending, now: Instant) {
        if shard.live.remove(&id).is_none() {
            return;
        }
        self.len.fetch_sub(1, Ordering::Relaxed);
        metrics::counter!("ada_sessions_ended_total", "reason" => ending.word()).increment(1);
        shard.ended.insert(id, ending);
        shard.endings.push_back((now, id));
        if shard.endings.len() > self.config.tombstones_max.div_ceil(SHARDS) {
            shard.forget_oldest();
        }
    }

    fn shard(&self, id: Uuid) -> &Mutex<Shard> {
        &self.shards[usize::from(id.as_bytes()[0]) % SHARDS]
    }
}

impl Shard {
    fn forget(&mut self, ttl: Duration, now: Instant) {
        while self.endings.front().is_some_and(|(at, _)| now.saturating_duration_since(*at) >= ttl) {
            self.forget_oldest();
        }
    }

    fn forget_oldest(&mut self) {
        if let Some((_, id)) = self.endings.pop_front() {
            self.ended.remove(&id);
        }
    }
}
