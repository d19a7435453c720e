//! Sessions: opened, exported, imported, forked, reset, shown, closed.

use super::{Service, parse_id};
use crate::{
    model::agent::Episode,
    serve::{
        error::ServiceError,
        registry::Model,
        request::{ForkRequest, ImportRequest, ListRequest, OpenRequest, Opened, Page, ResetRequest},
        session::{Handle, Opening, Record, Renewal, Sealed, Standing, Summary, is_request_id},
        store::unix_ms,
    },
};
use std::{sync::Arc, time::Duration};
use tokio::time::Instant;
use uuid::Uuid;

/// Seeds drawn by the server stay below 2^53, so that every JSON reader keeps them exactly.
const DRAWN_SEED_BITS: u32 = 53;
const PAGE_LEN: usize = 100;
const PAGE_LEN_MAX: usize = 100;

impl Service {
    /// OpenSession.
    ///
    /// # Errors
    /// `ModelNotFound`, `Invalid`, `TooLarge`, `Quota`, `NotReady`, `Draining`.
    pub async fn open(&self, request: OpenRequest) -> Result<Opened, ServiceError> {
        let OpenRequest { model, seed, options, ttl_ms, request_id, history } = request;
        check_request_id(&request_id)?;
        self.check_steps_told(history.len(), "number of steps of the history")?;
        let model = self.model(&model)?;
        let ttl = self.ttl(ttl_ms)?;
        let options = options.onto(&model.agent.spec().sampler);
        let episode = model.agent.recall(seed.unwrap_or_else(draw_seed), &options, &history).map_err(ServiceError::from_agent)?;
        self.begin(model, (Arc::new(episode), Standing::default()), ttl, request_id).await
    }

    /// ExportSession: what is committed at this moment, as bytes for [`Service::import`] here or elsewhere.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin. It goes on while the server drains, as that is when a session may have to leave.
    pub async fn export(&self, session_id: &str) -> Result<Vec<u8>, ServiceError> {
        let session = self.session(session_id).await?;
        Record::of(&session)?.write().map_err(|error| ServiceError::internal(&error))
    }

    /// ImportSession: another session, which goes on from where the exported one stood, with the same answers.
    ///
    /// # Errors
    /// `Invalid` naming what is wrong with the record, `ModelGone`, and those of [`Service::open`].
    pub async fn import(&self, request: ImportRequest) -> Result<Opened, ServiceError> {
        let ImportRequest { record, ttl_ms, request_id } = request;
        let registry = self.registry()?;
        check_request_id(&request_id)?;
        let record = Record::read(&record).map_err(|error| ServiceError::invalid("record", error.to_string()))?;
        let model = registry.pinned(&record.model, &record.model_digest)?.clone();
        let ttl = self.ttl(ttl_ms.or(Some(record.ttl_ms.clamp(1, self.config.sessions.ttl_ms_max))))?;
        let wrong = |(field, reason): (String, String)| ServiceError::invalid(format!("record.{field}"), reason);
        let (episode, standing) = record.standing(&model.agent).map_err(wrong)?;
        self.check_steps_told(episode.unread_len(), "number of steps that are yet to be read")?;
        self.begin(model, (episode, standing), ttl, request_id).await
    }

    /// ForkSession: another session that goes on from where this one stands.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin, `EpisodeOver` and `StepOutOfOrder` where it stands elsewhere, and those of [`Service::open`].
    pub async fn fork(&self, request: ForkRequest) -> Result<Opened, ServiceError> {
        let ForkRequest { session_id, seed, ttl_ms, request_id, step, episode } = request;
        let registry = self.registry()?;
        check_request_id(&request_id)?;
        let session = self.session(&session_id).await?;
        let ttl = ttl_ms.map_or(Ok(session.ttl()), |ttl_ms| self.ttl(Some(ttl_ms)))?;
        let (parent, standing) = session.standing((episode, step))?;
        let model = registry.pinned(&session.model, &session.agent.spec().digest)?.clone();
        let (own, forked) = (parent.seed(), (*parent).clone());
        self.begin(model, (Arc::new(forked.with_seed(seed.unwrap_or(own))), standing), ttl, request_id).await
    }

    /// SealSession: what is committed at this moment, for [`Service::resume`] here or elsewhere, and how long that holds, in milliseconds.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin, `Invalid` where there is no key. It goes on while the server drains.
    pub async fn seal(&self, session_id: &str) -> Result<(Vec<u8>, u64), ServiceError> {
        let sealer = self.sealer.as_ref().ok_or_else(|| no_key("session_id"))?;
        let kept = self.session(session_id).await?.as_kept()?.write().map_err(|error| ServiceError::internal(&error))?;
        Ok(sealer.seal(&kept, unix_ms()))
    }

    /// ResumeSession: the session itself, unless it has gone on since.
    ///
    /// # Errors
    /// `Invalid`, `TokenExpired`, `TokenStale`, `ModelGone`, and those of [`Service::open`].
    pub async fn resume(&self, token: &[u8]) -> Result<Opened, ServiceError> {
        let sealer = self.sealer.as_ref().ok_or_else(|| no_key("token"))?;
        let registry = self.registry()?;
        let kept = sealer.open(token, unix_ms()).map_err(|error| match error {
            Sealed::Expired => ServiceError::TokenExpired,
            error @ (Sealed::Foreign | Sealed::Newer(_) | Sealed::Unreadable(_)) => ServiceError::invalid("token", error.to_string()),
        })?;
        let model = registry.pinned(&kept.record.model, &kept.record.model_digest)?.clone();
        let session = self.keeper.resume(kept, registry).await?;
        // Its client knows its id: it is not undone when it hears nothing.
        Ok(Opened { session: session.summary(Instant::now()), model, untold: None })
    }

    /// A session that goes on from here.
    async fn begin(
        &self,
        model: Model,
        (episode, standing): (Arc<Episode>, Standing),
        ttl: Duration,
        request_id: String,
    ) -> Result<Opened, ServiceError> {
        let opening = Opening { model: model.name.clone(), agent: model.agent.clone(), episode, standing, ttl, request_id, known: None };
        let (session, untold) = self.keeper.open(opening, self.registry()?).await?;
        Ok(Opened { session: session.summary(Instant::now()), model, untold })
    }

    /// ResetSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin, `SessionBusy`, `EpisodeOver`, `Invalid`, `Draining`.
    pub async fn reset(&self, request: ResetRequest) -> Result<Summary, ServiceError> {
        let ResetRequest { session_id, seed, keep_history, request_id, episode } = request;
        self.registry()?;
        check_request_id(&request_id)?;
        let session = self.session(&session_id).await?;
        let renewal = Renewal { seed: seed.unwrap_or_else(draw_seed), keep_history };
        self.keeper.reset(&session, renewal, episode, request_id).await?;
        Ok(session.summary(Instant::now()))
    }

    /// GetSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin.
    pub async fn get(&self, session_id: &str) -> Result<Summary, ServiceError> {
        Ok(self.session(session_id).await?.summary(Instant::now()))
    }

    /// ListSessions.
    ///
    /// # Errors
    /// `Invalid` if the page token is none of ours.
    pub async fn list(&self, request: &ListRequest) -> Result<Page, ServiceError> {
        let token = request.page_token.as_str();
        let not_ours = || ServiceError::invalid("page_token", "is not a token of a page before");
        let after = if token.is_empty() { None } else { Some(Handle::parse(token).ok_or_else(not_ours)?) };
        let model = (!request.model.is_empty()).then_some(request.model.as_str());
        let len = if request.page_size == 0 { PAGE_LEN } else { request.page_size.min(PAGE_LEN_MAX) };
        let (sessions, next) = self.keeper.page(after, model, (len, request.in_full)).await?;
        Ok(Page { sessions, next_page_token: next.map_or_else(String::new, |handle| handle.to_string()) })
    }

    /// CloseSession.
    ///
    /// # Errors
    /// `SessionNotFound` and its kin.
    pub async fn close(&self, session_id: &str) -> Result<(), ServiceError> {
        self.keeper.close(parse_id(session_id)?, self.loaded()?).await
    }

    fn ttl(&self, ttl_ms: Option<u64>) -> Result<Duration, ServiceError> {
        let config = &self.config.sessions;
        let ttl_ms = ttl_ms.unwrap_or(config.ttl_ms);
        if !(1..=config.ttl_ms_max).contains(&ttl_ms) {
            return Err(ServiceError::invalid("ttl_ms", format!("must be 1 to {}", config.ttl_ms_max)));
        }
        Ok(Duration::from_millis(ttl_ms))
    }
}

fn no_key(field: &str) -> ServiceError {
    ServiceError::invalid(field, "this server has no key to seal sessions with: tokens.key_file is not set")
}

fn check_request_id(id: &str) -> Result<(), ServiceError> {
    if id.is_empty() || is_request_id(id) {
        Ok(())
    } else {
        Err(ServiceError::invalid("request_id", "must be 1 to 64 visible ASCII characters"))
    }
}

fn draw_seed() -> u64 {
    let random_low_bits = Uuid::new_v4().as_u128() as u64;
    random_low_bits & ((1 << DRAWN_SEED_BITS) - 1)
}
