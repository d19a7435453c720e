//! Sessions wherever they are: in memory, and in the store behind it. What changes one of them is kept before it is told; one that is not in memory comes
//! back when somebody asks for it.

use crate::serve::{
    config::{SessionsConfig, StoreConfig},
    error::ServiceError,
    recording::Recorder,
    registry::Registry,
    session::{Handle, Kept, Opening, Renewal, Session, Sessions, Summary, Untold, name_of},
    store::{
        Change, Durability, Embedded, Ending, Head, Options, Outcome, Place, Refused, Store, StoreError, UnixMs, Version, Write, unix_ms,
    },
};
use parking_lot::Mutex;
use std::{cmp::Ordering, io, sync::Arc, time::Duration};
use tokio::{sync::oneshot, task::spawn_blocking, time::Instant};
use uuid::Uuid;

/// Pages of the store that one page of a list looks at: a list of one model among many must not take for ever.
const PAGES_MAX: usize = 8;

/// Why there is no place for sessions.
#[derive(Debug, thiserror::Error)]
pub enum KeeperError {
    /// The store cannot be opened.
    #[error("store.dir {dir}: {reason}")]
    Store {
        /// The setting.
        dir: String,
        /// Why not.
        reason: StoreError,
    },
    /// No thread for it.
    #[error("store: {0}")]
    Thread(io::Error),
}

/// See the module.
pub struct Keeper {
    table: Arc<Sessions>,
    store: Option<Arc<Store>>,
    config: StoreConfig,
    tombstone_ttl: Duration,
    /// See [`Head::has_expired`].
    began: UnixMs,
    /// Where acts and resets are recorded, if they are.
    recorder: Option<Arc<Recorder>>,
    /// Where the search for expired sessions stands.
    swept: Mutex<Option<Handle>>,
}

impl Keeper {
    /// Opens the store, if the settings name one.
    ///
    /// # Errors
    /// If it cannot be opened.
    pub fn open_store(sessions: &SessionsConfig, config: &StoreConfig) -> Result<Self, KeeperError> {
        let in_memory = config.dir.as_os_str().is_empty() || config.durability == Durability::Memory;
        Ok(Self::over(sessions, config, if in_memory { None } else { Some(Arc::new(start(config)?)) }))
    }

    /// Over this store.
    pub fn over(sessions: &SessionsConfig, config: &StoreConfig, store: Option<Arc<Store>>) -> Self {
        Self {
            table: Arc::new(Sessions::new(sessions.clone(), store.clone())),
            store,
            config: config.clone(),
            tombstone_ttl: Duration::from_millis(sessions.tombstone_ttl_ms),
            began: unix_ms(),
            recorder: None,
            swept: Mutex::default(),
        }
    }

    /// With a recording of what happens to them.
    #[must_use]
    pub fn recorded_by(self, recorder: Option<Arc<Recorder>>) -> Self {
        Self { recorder, ..self }
    }

    /// Where acts are recorded.
    pub fn recorder(&self) -> Option<Arc<Recorder>> {
        self.recorder.clone()
    }

    /// Those in memory.
    pub fn table(&self) -> &Arc<Sessions> {
        &self.table
    }

    /// Where commits go first.
    pub fn store(&self) -> Option<Arc<Store>> {
        self.store.clone()
    }

    /// A session, touched, from memory or from the store.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin; of one in the store `ModelGone`, `StateCorrupt`, `StoreUnavailable`, `Quota`.
    pub async fn find(&self, id: Uuid, registry: &Registry) -> Result<Arc<Session>, ServiceError> {
        let found = self.table.get(id, Instant::now());
        match (&found, &self.store) {
            (Err(ServiceError::SessionNotFound), Some(_)) => {}
            _ => return found,
        }
        self.bring_back(Handle::of(id), registry).await?;
        self.table.get(id, Instant::now())
    }

    async fn bring_back(&self, handle: Handle, registry: &Registry) -> Result<Arc<Session>, ServiceError> {
        let Some(store) = self.store.clone() else { return Err(ServiceError::SessionNotFound) };
        let read = spawn_blocking(move || store.read(handle)).await.map_err(|error| ServiceError::internal(&error))?;
        match read.map_err(|error| ServiceError::from_store(&error))? {
            Place::Empty => Err(ServiceError::SessionNotFound),
            Place::Ended(ending) => Err(ServiceError::ended(ending)),
            Place::Kept(bytes) => self.revive(handle, &bytes, registry),
        }
    }

    fn revive(&self, handle: Handle, bytes: &[u8], registry: &Registry) -> Result<Arc<Session>, ServiceError> {
        let kept = read(bytes)?;
        if self.expire(handle, bytes, &kept) {
            return Err(ServiceError::SessionExpired);
        }
        self.table.revive(opening_of(kept, registry)?, Instant::now())
    }

    /// Opens a session, and what ends it if its client is never told, as one that named its request need not be; or gives that which a request of this
    /// name has opened, before a restart too.
    ///
    /// # Errors
    /// Those of [`Sessions::open`]; `StoreFull`, `StoreUnavailable`.
    pub async fn open(&self, opening: Opening, registry: &Registry) -> Result<(Arc<Session>, Option<Arc<Untold>>), ServiceError> {
        let name = name_of(&opening.request_id);
        if let (Some(name), Some(store)) = (name, &self.store) {
            let home = store.home().clone();
            let named = spawn_blocking(move || home.named(name)).await.map_err(|error| ServiceError::internal(&error))?;
            if let Some(handle) = named.map_err(|error| ServiceError::from_store(&error))? {
                // It has come back, or is there, or is gone: the table tells.
                let _gone = self.bring_back(handle, registry).await;
            }
        }
        let session = self.table.open(opening, Instant::now())?;
        // Before it is waited for: whoever asks may be gone by then.
        let untold = name.is_none().then(|| Untold::new(self.table.clone(), session.clone()));
        if self.store.is_none() {
            return Ok((session, untold));
        }
        let kept = self.keep(session.opened()?, |_| ()).await;
        let error = match kept {
            // Another request of its name has kept it.
            Ok(Ok(()) | Err(Refused::Conflict)) => return Ok((session, untold)),
            Ok(Err(Refused::Full)) => ServiceError::StoreFull,
            Err(error) => ServiceError::from_store(&error),
        };
        self.table.undo(&session);
        Err(error)
    }

    /// The session that a token was made of, as the token has it, unless it is known here as it is there. It was ended or is damaged here, or is behind (a
    /// server that lost its store, or to which the session comes back from another one): then the token is all there is of it.
    ///
    /// # Errors
    /// `TokenStale` where more is known here, `ModelGone`, `Quota`, `StoreFull`, `StoreUnavailable`.
    pub async fn resume(&self, kept: Kept, registry: &Registry) -> Result<Arc<Session>, ServiceError> {
        let (told, write) = ((kept.record.resets, kept.record.step), |from| kept_anew(&kept, from));
        // Before anything is let go: what does not fit the model costs nobody's session.
        let opening = opening_of(kept.clone(), registry)?;
        let from = match self.find(kept.id, registry).await {
            Ok(session) => {
                let (_, standing) = session.standing((None, None))?;
                let here = (standing.resets, standing.step);
                match told.cmp(&here) {
                    Ordering::Equal => return Ok(session),
                    Ordering::Less => {
                        let ((episode, step), (running, committed)) = (told, here);
                        return Err(ServiceError::TokenStale { step, episode, running, committed });
                    }
                    Ordering::Greater => {}
                }
                self.table.let_go(&session);
                Some(Version::at(&session.agent.spec().digest, here.0, here.1))
            }
            Err(ServiceError::StateCorrupt { .. }) => {
                let change = Change::Free { from: None, ending: None, name: None };
                let freed = self.keep(Write { handle: Handle::of(kept.id), change }, |_| ()).await;
                freed.map_err(|error| ServiceError::from_store(&error)).map(|_freed| None)?
            }
            Err(ServiceError::SessionNotFound | ServiceError::SessionExpired | ServiceError::SessionEvicted) => None,
            Err(error) => return Err(error),
        };
        let write = write(from)?;
        let session = self.table.revive(opening, Instant::now())?;
        if from.is_none() {
            metrics::counter!("ada_sessions_created_total").increment(1);
        }
        let error = match self.keep(write, |_| ()).await {
            Ok(Ok(())) => return Ok(session),
            Ok(Err(refused)) => ServiceError::from_refused(refused),
            Err(error) => ServiceError::from_store(&error),
        };
        // What is kept is what holds: whoever asks again is told by it.
        self.table.let_go(&session);
        Err(error)
    }

    /// A new episode.
    ///
    /// # Errors
    /// Those of [`Session::begin_reset`]; `StoreFull`, `StoreUnavailable`.
    pub async fn reset(&self, session: &Arc<Session>, renewal: Renewal, ends: Option<u64>, request_id: String) -> Result<(), ServiceError> {
        let Some(reset) = session.begin_reset(renewal, ends, request_id, Instant::now())? else { return Ok(()) };
        if self.store.is_none() {
            session.finish_reset(Some(reset), self.recorder.as_deref());
            return Ok(());
        }
        let write = match session.about_to_reset(&reset) {
            Ok(write) => write,
            Err(error) => {
                session.finish_reset(None, None);
                return Err(error);
            }
        };
        let (its, recorder) = (session.clone(), self.recorder.clone());
        // Whoever asked may be gone by then: the writer finishes it.
        let kept = self
            .keep(write, move |outcome| its.finish_reset(Some(reset).filter(|_| matches!(outcome, Ok(Ok(())))), recorder.as_deref()))
            .await;
        match kept {
            Ok(Ok(())) => Ok(()),
            Ok(Err(refused)) => {
                session.overtaken(refused);
                Err(ServiceError::from_refused(refused))
            }
            Err(error) => Err(ServiceError::from_store(&error)),
        }
    }

    /// Ends a session.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin; `StoreUnavailable`, after which it may be closed again.
    pub async fn close(&self, id: Uuid, registry: &Registry) -> Result<(), ServiceError> {
        let freed = match self.find(id, registry).await {
            Ok(_) => self.table.close(id, Instant::now())?.freed(None),
            // Nobody can go on with it here, and its client may let it go all the same.
            Err(ServiceError::ModelGone { .. } | ServiceError::StateCorrupt { .. }) => {
                metrics::counter!("ada_sessions_ended_total", "reason" => "closed").increment(1);
                Write { handle: Handle::of(id), change: Change::Free { from: None, ending: None, name: None } }
            }
            Err(error) => return Err(error),
        };
        self.keep(freed, |_| ()).await.map_err(|error| ServiceError::from_store(&error)).map(|_freed| ())
    }

    /// Whether commits are kept.
    ///
    /// # Errors
    /// Why not.
    pub fn is_sound(&self) -> Result<(), StoreError> {
        self.store.as_ref().map_or(Ok(()), |store| store.is_sound())
    }

    /// Keeps what is on its way, and nothing more. Blocks for that time.
    pub fn stop(&self) {
        if let Some(store) = &self.store {
            store.close();
        }
    }

    /// Writes, and waits; `then` is called on the writer's thread, whether or not anybody still waits here.
    async fn keep(&self, write: Write, then: impl FnOnce(&Outcome) + Send + 'static) -> Outcome {
        let Some(store) = &self.store else { return Ok(Ok(())) };
        let (told, outcome) = oneshot::channel();
        store.submit(write, move |outcome| {
            then(&outcome);
            // Whoever asked may be gone.
            let _gone = told.send(outcome);
        });
        outcome.await.unwrap_or_else(|_| Err(StoreError::Unavailable("its thread has ended".into())))
    }

    /// Up to `len` sessions with handles above `after`, in order of handle, and where the next page begins.
    ///
    /// # Errors
    /// `StoreUnavailable`.
    pub async fn page(
        &self,
        after: Option<Handle>,
        model: Option<&str>,
        (len, in_full): (usize, bool),
    ) -> Result<(Vec<Summary>, Option<Handle>), ServiceError> {
        let now = Instant::now();
        let Some(store) = &self.store else {
            let mut found = self.table.page(after, model, len + 1);
            let more = found.len() > len;
            found.truncate(len);
            let next = found.last().filter(|_| more).map(|session| session.handle);
            return Ok((found.iter().map(|session| session.listed(in_full, now)).collect(), next));
        };
        let (mut summaries, mut after) = (Vec::new(), after);
        for _ in 0..PAGES_MAX {
            let (home, from) = (store.home().clone(), after);
            let page = spawn_blocking(move || home.page(from, len + 1)).await.map_err(|error| ServiceError::internal(&error))?;
            let page = page.map_err(|error| ServiceError::from_store(&error))?;
            let more = page.len() > len;
            for (handle, bytes) in page.into_iter().take(len) {
                after = Some(handle);
                let Some(summary) = self.summary(handle, &bytes, in_full, now) else { continue };
                if model.is_none_or(|model| *summary.model == *model) {
                    summaries.push(summary);
                }
                if summaries.len() == len {
                    return Ok((summaries, after));
                }
            }
            if !more {
                return Ok((summaries, None));
            }
        }
        Ok((summaries, after))
    }

    /// Of a session in the store; None of one that is damaged or has expired.
    fn summary(&self, handle: Handle, bytes: &[u8], in_full: bool, now: Instant) -> Option<Summary> {
        if let Some(live) = self.table.live(handle) {
            return Some(live.listed(in_full, now));
        }
        let kept = read(bytes).ok()?;
        (!Head::of(bytes)?.has_expired(self.began, unix_ms())).then(|| kept.summary(handle, in_full))
    }

    /// Ends one in the store if it has expired, unless it goes on meanwhile; says whether it has.
    fn expire(&self, handle: Handle, bytes: &[u8], kept: &Kept) -> bool {
        let (Some(store), Some(head), now) = (&self.store, Head::of(bytes), unix_ms()) else { return false };
        if !head.has_expired(self.began, now) {
            return false;
        }
        let change = Change::Free { from: Some(head.version), ending: Some((Ending::Expired, now)), name: name_of(&kept.request_id) };
        store.submit(Write { handle, change }, |freed| {
            if let Ok(Ok(())) = freed {
                metrics::counter!("ada_sessions_ended_total", "reason" => Ending::Expired.word()).increment(1);
            }
        });
        true
    }

    /// Ends what has expired, in memory and, a few at a time, in the store. Blocks, for as long as a failing disk likes.
    pub fn reap(&self) {
        self.table.reap(Instant::now());
        let Some(store) = &self.store else { return };
        store.upkeep();
        let mut swept = self.swept.lock();
        let Ok(heads) = store.home().heads(*swept, self.config.sweep_len) else { return };
        *swept = heads.last().filter(|_| heads.len() == self.config.sweep_len).map(|(handle, _)| *handle);
        let now = unix_ms();
        for (handle, _) in heads.into_iter().filter(|(_, head)| head.has_expired(self.began, now)) {
            // A head has no checksum: what ends is what is whole.
            if self.table.live(handle).is_none()
                && let Ok(Place::Kept(bytes)) = store.home().read(handle)
                && let Ok(kept) = read(&bytes)
            {
                self.expire(handle, &bytes, &kept);
            }
        }
        if swept.is_none() {
            let before = unix_ms().saturating_sub(self.tombstone_ttl.as_millis() as UnixMs);
            // What is not forgotten now is forgotten in the next round.
            let _forgotten = store.home().forget_endings(before);
        }
    }
}

/// As it was kept, if the model could have left it so.
fn opening_of(kept: Kept, registry: &Registry) -> Result<Opening, ServiceError> {
    let Kept { id, request_id, opened, touched: _, record } = kept;
    let model = registry.pinned(&record.model, &record.model_digest)?.clone();
    let ttl = Duration::from_millis(record.ttl_ms);
    let damaged = |(field, reason): (String, String)| ServiceError::corrupt(&format!("{field}: {reason}"));
    let (episode, standing) = record.standing(&model.agent).map_err(damaged)?;
    Ok(Opening { model: model.name, agent: model.agent, episode, standing, ttl, request_id, known: Some((id, opened)) })
}

/// What takes the place of what is there.
fn kept_anew(kept: &Kept, from: Option<Version>) -> Result<Write, ServiceError> {
    let bytes = Kept { touched: unix_ms(), ..kept.clone() }.write().map_err(|error| ServiceError::internal(&error))?;
    let name = name_of(&kept.request_id).filter(|_| from.is_none());
    Ok(Write { handle: Handle::of(kept.id), change: Change::Keep { from, bytes, name } })
}

fn start(config: &StoreConfig) -> Result<Store, KeeperError> {
    let StoreConfig { dir: _, durability, len_max, bytes_max, cache_bytes, queue_len_max: _, sweep_len: _ } = *config;
    let home = Embedded::open(&config.dir, Options { durability, cache_bytes, len_max, bytes_max });
    let home = home.map_err(|reason| KeeperError::Store { dir: config.dir.display().to_string(), reason })?;
    Store::start(Arc::new(home), config.queue_len_max).map_err(KeeperError::Thread)
}

fn read(bytes: &[u8]) -> Result<Kept, ServiceError> {
    Kept::read(bytes).map_err(|error| ServiceError::corrupt(&error))
}

#[cfg(test)]
#[path = "keeper_tests.rs"]
mod tests;
