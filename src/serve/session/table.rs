//! All sessions: a sharded table with a cap, a time to live, and a memory for how sessions ended.

use crate::serve::{
    config::SessionsConfig,
    error::ServiceError,
    session::{Handle, Opening, Session},
    store::{Ending, Refused, Store},
};
use parking_lot::Mutex;
use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    ops::Bound,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tokio::time::Instant;
use uuid::Uuid;

const SHARDS: usize = 16;
/// Sessions that one eviction looks at: a refusal must not cost more than an act.
const LOOKS_MAX: usize = 64;

/// The table. Locks are taken in the order shard, slot; those of `idle`, `unused` and `opened` come last, and hold nothing
/// else. All are held for moments.
pub struct Sessions {
    shards: [Mutex<Shard>; SHARDS],
    /// Those that were asked for.
    idle: Mutex<Idle>,
    /// Those that nobody has asked for since they were opened.
    unused: Mutex<Idle>,
    /// Live sessions by the name of the request that opened them.
    opened: Mutex<HashMap<String, Uuid>>,
    len: AtomicUsize,
    bytes: Arc<AtomicUsize>,
    config: SessionsConfig,
    /// Where they are kept as well; None: they are here alone.
    store: Option<Arc<Store>>,
}

#[derive(Default)]
struct Shard {
    live: BTreeMap<Handle, Arc<Session>>,
    ended: HashMap<Handle, Ending>,
    /// The same, oldest first.
    endings: VecDeque<(Instant, Handle)>,
}

/// Live sessions by a time since which each may have been idle: not later than its last touch, so that an act need not come here. The first
/// one is looked at before it is evicted, and filed anew if it was touched since.
#[derive(Default)]
struct Idle {
    order: BTreeSet<(Instant, Handle)>,
    filed: HashMap<Handle, Instant>,
}

impl Idle {
    fn file(&mut self, handle: Handle, since: Instant) {
        self.forget(handle);
        self.filed.insert(handle, since);
        self.order.insert((since, handle));
    }

    fn forget(&mut self, handle: Handle) {
        if let Some(since) = self.filed.remove(&handle) {
            self.order.remove(&(since, handle));
        }
    }

    /// The one that may have been idle for longest, if it may have been for so long.
    fn first(&self, idle_min: Duration, now: Instant) -> Option<(Instant, Handle)> {
        self.order.first().filter(|(since, _)| now.saturating_duration_since(*since) >= idle_min).copied()
    }
}

impl Sessions {
    /// An empty table.
    pub fn new(config: SessionsConfig, store: Option<Arc<Store>>) -> Self {
        Self {
            shards: Default::default(),
            idle: Mutex::default(),
            unused: Mutex::default(),
            opened: Mutex::default(),
            len: AtomicUsize::new(0),
            bytes: Arc::default(),
            config,
            store,
        }
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

    /// Adds a session, evicting an idle one where there is no room; or gives that which a request of this name has opened.
    ///
    /// # Errors
    /// `Quota` if there is no room and nobody idle for long enough; `Invalid` if the name opened a session of another model.
    pub fn open(&self, opening: Opening, now: Instant) -> Result<Arc<Session>, ServiceError> {
        let (name, model) = (opening.request_id.clone(), opening.model.clone());
        if name.is_empty() {
            return self.add(opening, now);
        }
        if let Some(session) = self.opened(&name, now) {
            return same_model(session, &model);
        }
        let session = self.add(opening, now)?;
        // Of two that came at the same time the first one's session is that of both.
        let first = *self.opened.lock().entry(name.clone()).or_insert(session.id);
        if first == session.id {
            return Ok(session);
        }
        let Ok(other) = self.get(first, now) else {
            // It has ended, and is about to be forgotten.
            self.opened.lock().insert(name, session.id);
            return Ok(session);
        };
        self.close(session.id, now)?;
        same_model(other, &model)
    }

    /// Takes in a session that comes back from the store, unless it is here already.
    ///
    /// # Errors
    /// `Quota` if there is no room.
    pub fn revive(&self, opening: Opening, now: Instant) -> Result<Arc<Session>, ServiceError> {
        self.make_room(opening.episode.size_bytes(), now)?;
        let session = Arc::new(Session::new(opening, self.bytes.clone(), now));
        let live = self.shard(session.handle).lock().live.entry(session.handle).or_insert_with(|| session.clone()).clone();
        if !Arc::ptr_eq(&live, &session) {
            self.len.fetch_sub(1, Ordering::Relaxed);
            session.end();
            return Ok(live);
        }
        self.unused.lock().file(session.handle, now);
        if !session.request_id.is_empty() {
            self.opened.lock().insert(session.request_id.clone(), session.id);
        }
        metrics::counter!("ada_sessions_revived_total").increment(1);
        Ok(session)
    }

    fn opened(&self, name: &str, now: Instant) -> Option<Arc<Session>> {
        let id = *self.opened.lock().get(name)?;
        self.get(id, now).ok()
    }

    fn add(&self, opening: Opening, now: Instant) -> Result<Arc<Session>, ServiceError> {
        self.make_room(opening.episode.size_bytes(), now)?;
        let session = Arc::new(Session::new(opening, self.bytes.clone(), now));
        self.shard(session.handle).lock().live.insert(session.handle, session.clone());
        self.unused.lock().file(session.handle, now);
        metrics::counter!("ada_sessions_created_total").increment(1);
        Ok(session)
    }

    /// Takes a place, evicting idle sessions where there is none.
    fn make_room(&self, bytes: usize, now: Instant) -> Result<(), ServiceError> {
        while self.bytes() + bytes > self.config.bytes_max {
            self.evict(now)?;
        }
        while self.len.fetch_add(1, Ordering::Relaxed) >= self.config.len_max {
            self.len.fetch_sub(1, Ordering::Relaxed);
            self.evict(now)?;
        }
        Ok(())
    }

    /// A live session, touched.
    ///
    /// # Errors
    /// If there is none of this id, or if it ended by itself not long ago.
    pub fn get(&self, id: Uuid, now: Instant) -> Result<Arc<Session>, ServiceError> {
        let handle = Handle::of(id);
        let mut shard = self.shard(handle).lock();
        if let Some(session) = shard.live.get(&handle).cloned() {
            if session.is_over() {
                // Overtaken: it is to be found in the store.
                self.remove(&mut shard, handle);
                return Err(ServiceError::SessionNotFound);
            }
            if session.end_if_idle(session.ttl, now) {
                self.bury(&mut shard, handle, Ending::Expired, now);
                return Err(ServiceError::SessionExpired);
            }
            if session.touch(now) {
                self.unused.lock().forget(handle);
                self.idle.lock().file(handle, now);
            }
            return Ok(session);
        }
        Err(shard.ended.get(&handle).map_or(ServiceError::SessionNotFound, |ending| ServiceError::ended(*ending)))
    }

    /// Ends a session; an act in flight is dropped.
    ///
    /// # Errors
    /// As [`Sessions::get`].
    pub fn close(&self, id: Uuid, now: Instant) -> Result<Arc<Session>, ServiceError> {
        let session = self.get(id, now)?;
        if self.shard(session.handle).lock().live.remove(&session.handle).is_none() {
            return Err(ServiceError::SessionNotFound);
        }
        self.forget(&session);
        session.end();
        metrics::counter!("ada_sessions_ended_total", "reason" => "closed").increment(1);
        Ok(session)
    }

    /// Ends a session, unless somebody has asked for it since it was opened: then its id is known.
    pub fn undo(&self, session: &Session) {
        let mut shard = self.shard(session.handle).lock();
        if session.is_unused() && shard.live.remove(&session.handle).is_some() {
            self.forget(session);
            session.end();
            self.free(session, None);
            metrics::counter!("ada_sessions_ended_total", "reason" => "undone").increment(1);
        }
    }

    /// Lets a session go, in whose place another state of it comes: who has an act in flight, or holds on to it, is told to ask again.
    pub fn let_go(&self, session: &Session) {
        if self.shard(session.handle).lock().live.remove(&session.handle).is_some() {
            self.forget(session);
            session.overtaken(Refused::Conflict);
        }
    }

    /// One that is in memory, as it is.
    pub fn live(&self, handle: Handle) -> Option<Arc<Session>> {
        self.shard(handle).lock().live.get(&handle).filter(|session| !session.is_over()).cloned()
    }

    /// Up to `len` sessions with handles above `after`, in order of handle.
    pub fn page(&self, after: Option<Handle>, model: Option<&str>, len: usize) -> Vec<Arc<Session>> {
        let behind = after.map_or(Bound::Unbounded, Bound::Excluded);
        let mut found: Vec<_> = Vec::new();
        for shard in &self.shards {
            let shard = shard.lock();
            let sessions = shard.live.range((behind, Bound::Unbounded)).map(|(_, session)| session);
            found.extend(sessions.filter(|session| model.is_none_or(|model| *session.model == *model)).take(len).cloned());
        }
        found.sort_unstable_by_key(|session| session.handle);
        found.truncate(len);
        found
    }

    /// Ends what has expired, evicts while memory is short, forgets old endings.
    pub fn reap(&self, now: Instant) {
        for shard in &self.shards {
            let mut shard = shard.lock();
            let expired = |session: &&Arc<Session>| session.end_if_idle(session.ttl, now);
            let handles: Vec<_> = shard.live.values().filter(expired).map(|session| session.handle).collect();
            for handle in handles {
                self.bury(&mut shard, handle, Ending::Expired, now);
            }
            shard.forget(Duration::from_millis(self.config.tombstone_ttl_ms), now);
        }
        while self.bytes() > self.config.bytes_max && self.evict(now).is_ok() {}
        metrics::gauge!("ada_sessions").set(self.len() as f64);
        metrics::gauge!("ada_session_state_bytes").set(self.bytes() as f64);
    }

    /// Evicts a session that nobody has asked for, else the one that is idle for longest. Whether it finds one or not, it looks at a few
    /// sessions only.
    fn evict(&self, now: Instant) -> Result<(), ServiceError> {
        if self.evict_unused(now) {
            return Ok(());
        }
        let idle_min = self.evict_idle();
        for _ in 0..LOOKS_MAX {
            let Some((filed, handle)) = self.idle.lock().first(idle_min, now) else { break };
            let mut shard = self.shard(handle).lock();
            let Some(session) = shard.live.get(&handle).cloned() else {
                self.idle.lock().forget(handle);
                continue;
            };
            let since = session.idle_since().unwrap_or(now);
            if self.is_first(filed, since, now) && self.is_ours(&session) && session.end_if_idle(idle_min, now) {
                self.make_go(&mut shard, handle, now);
                return Ok(());
            }
            // Touched since: another one may have been idle for longer.
            self.idle.lock().file(handle, since);
        }
        metrics::counter!("ada_shed_total", "reason" => "QUOTA").increment(1);
        Err(ServiceError::Quota { retry_after_ms: self.config.reap_interval_ms })
    }

    /// Evicts the oldest of those that nobody has asked for; says whether there was one. Whoever opens without end takes places from its own
    /// like.
    fn evict_unused(&self, now: Instant) -> bool {
        let idle_min = Duration::from_millis(self.config.unused_idle_ms.min(self.config.evict_idle_ms));
        for _ in 0..LOOKS_MAX {
            let Some((_, handle)) = self.unused.lock().first(idle_min, now) else { break };
            let mut shard = self.shard(handle).lock();
            let Some(session) = shard.live.get(&handle).cloned().filter(|session| session.is_unused()) else {
                // It has ended, or was asked for, a moment ago.
                self.unused.lock().forget(handle);
                continue;
            };
            if self.is_ours(&session) && session.end_if_idle(idle_min, now) {
                self.make_go(&mut shard, handle, now);
                return true;
            }
            // Somebody has it in hand, and may never ask for it: forgotten here it would hold its place until its time to live is over.
            self.unused.lock().file(handle, now);
        }
        false
    }

    /// Whether one that is filed as idle since `filed`, and was touched at `since`, is to go before those behind it. Where it comes back it need not be the very
    /// first, and sessions that were all touched a moment after they were filed are not looked at one by one.
    fn is_first(&self, filed: Instant, since: Instant, now: Instant) -> bool {
        let [filed_for, idle_for] = [filed, since].map(|time| now.saturating_duration_since(time));
        since == filed || self.store.is_some() && idle_for * 2 >= filed_for
    }

    /// Who comes back from the store loses nothing by leaving memory.
    fn evict_idle(&self) -> Duration {
        if self.store.is_some() { Duration::ZERO } else { Duration::from_millis(self.config.evict_idle_ms) }
    }

    /// Whether nobody is about to use a session that will come back from the store as another value: to be asked with its shard locked, and one hold of
    /// one's own on it.
    fn is_ours(&self, session: &Arc<Session>) -> bool {
        self.store.is_none() || Arc::strong_count(session) <= 2
    }

    /// Takes the place of a session: where it is kept elsewhere it comes back when somebody asks for it, else it ends.
    fn make_go(&self, shard: &mut Shard, handle: Handle, now: Instant) {
        if self.store.is_none() {
            return self.bury(shard, handle, Ending::Evicted, now);
        }
        self.remove(shard, handle);
    }

    /// It is in the store alone.
    fn remove(&self, shard: &mut Shard, handle: Handle) {
        if let Some(session) = shard.live.remove(&handle) {
            self.forget(&session);
            metrics::counter!("ada_sessions_spilled_total").increment(1);
        }
    }

    /// Its place in the store, if it has one. Nobody waits for that: until it is done, what is asked finds the session as it was.
    fn free(&self, session: &Session, ending: Option<Ending>) {
        if let Some(store) = &self.store {
            store.submit(session.freed(ending), |_freed| ());
        }
    }

    /// What is known of a session beside its shard.
    fn forget(&self, session: &Session) {
        self.len.fetch_sub(1, Ordering::Relaxed);
        self.idle.lock().forget(session.handle);
        self.unused.lock().forget(session.handle);
        if !session.request_id.is_empty() {
            let mut opened = self.opened.lock();
            if opened.get(&session.request_id) == Some(&session.id) {
                opened.remove(&session.request_id);
            }
        }
    }

    fn bury(&self, shard: &mut Shard, handle: Handle, ending: Ending, now: Instant) {
        let Some(session) = shard.live.remove(&handle) else { return };
        self.forget(&session);
        self.free(&session, Some(ending));
        metrics::counter!("ada_sessions_ended_total", "reason" => ending.word()).increment(1);
        shard.ended.insert(handle, ending);
        shard.endings.push_back((now, handle));
        if shard.endings.len() > self.config.tombstones_max.div_ceil(SHARDS) {
            shard.forget_oldest();
        }
    }

    fn shard(&self, handle: Handle) -> &Mutex<Shard> {
        &self.shards[usize::from(handle.first_byte()) % SHARDS]
    }
}

fn same_model(session: Arc<Session>, model: &str) -> Result<Arc<Session>, ServiceError> {
    let other = || ServiceError::invalid("request_id", format!("has opened a session of {}: a name stands for one request", session.model));
    if *session.model == *model { Ok(session) } else { Err(other()) }
}

impl Shard {
    fn forget(&mut self, ttl: Duration, now: Instant) {
        while self.endings.front().is_some_and(|(at, _)| now.saturating_duration_since(*at) >= ttl) {
            self.forget_oldest();
        }
    }

    fn forget_oldest(&mut self) {
        if let Some((_, handle)) = self.endings.pop_front() {
            self.ended.remove(&handle);
        }
    }
}

#[cfg(test)]
#[path = "table_tests.rs"]
mod tests;
