//! A session as bytes: what is needed to go on with it elsewhere, or later, as if nothing had been between.
//!
//! `ADAS`, one byte of version, the CRC-32C of what follows (little-endian), then a [`Record`] as MessagePack with the names of its fields. A reader
//! takes its own version and the one before; what was damaged on its way is refused, never repaired. A checksum is no seal: whoever imports a
//! record may have written it by hand, so that everything in it is checked against the model ([`Agent::adopt`]).

use super::{Answer, Detail, Handle, Key, RESET_IDS_MAX, Session, Standing, Summary, Timings, is_request_id};
use crate::{
    model::agent::{Agent, Chunk, Episode},
    serve::{
        error::ServiceError,
        store::{HEAD_LEN as STORE_HEAD_LEN, Head, UnixMs, Version, unix_ms},
    },
};
use crc::{CRC_32_ISCSI, Crc};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{sync::Arc, time::Duration};
use uuid::Uuid;

const MAGIC_LEN: usize = 4;
/// Begins a record that travels.
const EXPORTED: &[u8; MAGIC_LEN] = b"ADAS";
/// Begins what a store keeps.
const KEPT: &[u8; MAGIC_LEN] = b"ADAK";
/// Of what is written.
const VERSION: u8 = 1;
/// Room for a usual one.
const USUAL_LEN: usize = 8 << 10;
/// Steps and episodes that are counted.
const COUNT_MAX: u64 = 1 << 53;
const HEAD_LEN: usize = MAGIC_LEN + 1 + size_of::<u32>();
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// What is written down of a session.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Name of the model.
    pub model: String,
    /// Its digest: the episode is of these weights and no others.
    pub model_digest: String,
    /// Idle time to live, in milliseconds.
    pub ttl_ms: u64,
    /// Acts committed in the running episode.
    pub step: u64,
    /// How often the session was reset.
    pub resets: u64,
    /// Names of the last requests that reset it.
    pub reset_ids: Vec<String>,
    /// The running episode.
    pub episode: Arc<Episode>,
    /// The last answer, for whoever lost it.
    pub last: Option<Last>,
}

/// The last answer, and the key of its question.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Last {
    /// See [`super::key_of`].
    pub key: Key,
    /// What the model said.
    pub chunk: Arc<Chunk>,
    /// Where the time went.
    pub timings: Timings,
}

/// Why bytes are no record that can be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unreadable {
    /// They begin with something else.
    #[error("is no session that was exported")]
    Foreign,
    /// A newer server wrote them.
    #[error("is of format {0}, and this server reads up to {VERSION}: import it into the server's version that wrote it, or a newer one")]
    Newer(u8),
    /// They are not what was written.
    #[error("is damaged: its checksum does not fit, or its end is missing")]
    Damaged,
    /// They were written so, but not by a server.
    #[error("cannot be read: {0}")]
    Malformed(String),
}

impl Record {
    /// Of a session, as it is committed at this moment.
    ///
    /// # Errors
    /// If the session has ended.
    pub fn of(session: &Session) -> Result<Self, ServiceError> {
        let (episode, Standing { step, resets, reset_ids, last }) = session.standing((None, None))?;
        let (model, model_digest) = (session.model.to_string(), session.agent.spec().digest.clone());
        let ttl_ms = session.ttl().as_millis() as u64;
        Ok(Self { model, model_digest, ttl_ms, step, resets, reset_ids, episode, last })
    }

    /// As bytes.
    ///
    /// # Errors
    /// If the format cannot express it, which is a defect.
    pub fn write(&self) -> Result<Vec<u8>, rmp_serde::encode::Error> {
        write(*EXPORTED, self)
    }

    /// From bytes.
    ///
    /// # Errors
    /// [`Unreadable`].
    pub fn read(bytes: &[u8]) -> Result<Self, Unreadable> {
        read(EXPORTED, bytes)
    }

    /// Where its session stood, if the model could have left it there; else what of it is wrong.
    ///
    /// # Errors
    /// `(field, reason)`.
    pub fn standing(self, agent: &Agent) -> Result<(Arc<Episode>, Standing), (String, String)> {
        let Self { model: _, model_digest: _, ttl_ms: _, step, resets, reset_ids, episode, last } = self;
        let misfit = |field: &str| (field.to_owned(), "is none of this session".to_owned());
        // Each step has an answer; the next one can be counted.
        if (step > 0) != last.is_some() || step.max(resets) > COUNT_MAX {
            return Err(misfit("step"));
        }
        if last.as_ref().is_some_and(|last| !last.chunk.fits(agent.spec())) {
            return Err(misfit("last"));
        }
        // The empty one would be the name of every reset that has none.
        if reset_ids.len() > RESET_IDS_MAX || !reset_ids.iter().all(|id| is_request_id(id)) {
            return Err(misfit("reset_ids"));
        }
        agent.adopt(&episode).map_err(|error| ("episode".to_owned(), error.to_string()))?;
        Ok((episode, Standing { step, resets, reset_ids, last }))
    }
}

/// What a store keeps of a session: its record, and what is told to nobody else.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kept {
    /// The session's id.
    pub id: Uuid,
    /// Name of the request that opened it; empty: none.
    pub request_id: String,
    /// When it was opened.
    pub opened: UnixMs,
    /// When it was touched, as far as commits tell.
    pub touched: UnixMs,
    /// Where it stands.
    pub record: Record,
}

impl Kept {
    /// As a store keeps it: the head, and what it was made of.
    ///
    /// # Errors
    /// If the format cannot express it, which is a defect.
    pub fn write(&self) -> Result<Vec<u8>, rmp_serde::encode::Error> {
        Ok([&self.head().bytes()[..], &write(*KEPT, self)?].concat())
    }

    /// From what a store has kept. The head has no checksum of its own: it has to be that of what follows.
    ///
    /// # Errors
    /// [`Unreadable`].
    pub fn read(bytes: &[u8]) -> Result<Self, Unreadable> {
        let kept: Self = read(KEPT, bytes.get(STORE_HEAD_LEN..).ok_or(Unreadable::Damaged)?)?;
        if Head::of(bytes) == Some(kept.head()) { Ok(kept) } else { Err(Unreadable::Damaged) }
    }

    /// What stands before it in a store.
    pub fn head(&self) -> Head {
        let Record { model_digest, ttl_ms, step, resets, .. } = &self.record;
        Head { version: Version::at(model_digest, *resets, *step), touched: self.touched, ttl_ms: *ttl_ms }
    }

    /// The session in numbers, as far as what is kept tells.
    pub fn summary(self, handle: Handle, in_full: bool) -> Summary {
        let Self { id: _, request_id: _, opened, touched, record } = self;
        let Record { model, model_digest, ttl_ms, step, resets, reset_ids: _, episode, last: _ } = record;
        let now = unix_ms();
        let since = |then: UnixMs| Duration::from_millis(now.saturating_sub(then));
        let detail = || Detail {
            model_digest,
            seed: episode.seed(),
            options: episode.options().clone(),
            latent: episode.latent().map(|(mean, log_var)| (mean.to_vec(), log_var.to_vec())),
        };
        Summary {
            id: None,
            handle,
            model: model.into(),
            committed_step: step,
            episode: resets,
            detail: in_full.then(detail),
            age: since(opened),
            idle: since(touched),
            ttl: Duration::from_millis(ttl_ms),
            state_bytes: episode.size_bytes(),
            busy: false,
        }
    }
}

fn write(magic: [u8; MAGIC_LEN], value: &impl Serialize) -> Result<Vec<u8>, rmp_serde::encode::Error> {
    let mut bytes = Vec::with_capacity(USUAL_LEN);
    bytes.extend_from_slice(&magic);
    bytes.push(VERSION);
    bytes.extend_from_slice(&[0; size_of::<u32>()]);
    value.serialize(&mut rmp_serde::Serializer::new(&mut bytes).with_struct_map())?;
    let sum = CRC.checksum(&bytes[HEAD_LEN..]);
    bytes[HEAD_LEN - size_of::<u32>()..HEAD_LEN].copy_from_slice(&sum.to_le_bytes());
    Ok(bytes)
}

fn read<T: DeserializeOwned>(magic: &[u8; MAGIC_LEN], bytes: &[u8]) -> Result<T, Unreadable> {
    let rest = bytes.strip_prefix(magic).ok_or(Unreadable::Foreign)?;
    let (version, rest) = rest.split_first().ok_or(Unreadable::Damaged)?;
    let (sum, body) = rest.split_first_chunk().ok_or(Unreadable::Damaged)?;
    if *version > VERSION {
        return Err(Unreadable::Newer(*version));
    }
    if *version < VERSION || u32::from_le_bytes(*sum) != CRC.checksum(body) {
        return Err(Unreadable::Damaged);
    }
    rmp_serde::from_slice(body).map_err(|error| Unreadable::Malformed(error.to_string()))
}

impl Last {
    /// Of a committed answer.
    pub fn of(key: Key, answer: &Answer) -> Self {
        let Answer { session: _, step: _, chunk, timings, model: _, model_digest: _ } = answer;
        Self { key, chunk: chunk.clone(), timings: *timings }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{agent::Observation, checkpoint},
        serve::session::key_of,
    };
    use std::path::Path;

    fn acted() -> (Arc<Agent>, Record) {
        let agent = Arc::new(checkpoint::load(Path::new("models/tiny")).unwrap());
        let seen = |i: usize| Observation { state: vec![0.1 * i as f32; 4], ..Observation::default() };
        let mut standing = (agent.open(1, &agent.config().defaults.sampler).unwrap(), None);
        for i in 0..3 {
            let (episode, chunk) = agent.act(&standing.0, &seen(i)).unwrap();
            standing = (episode, Some(Last { key: key_of(&seen(i)), chunk: Arc::new(chunk), timings: Timings::default() }));
        }
        let (episode, last) = (Arc::new(standing.0), standing.1);
        let (model, model_digest, reset_ids) = ("tiny".to_owned(), agent.spec().digest.clone(), vec!["a".to_owned()]);
        (agent, Record { model, model_digest, ttl_ms: 60_000, step: 3, resets: 1, reset_ids, episode, last })
    }

    #[test]
    fn what_is_written_is_read() {
        let (agent, record) = acted();
        let bytes = record.write().unwrap();
        assert!(bytes.len() < 6_000, "{} bytes", bytes.len());
        let again = Record::read(&bytes).unwrap();
        assert_eq!(again, record);
        let (episode, standing) = again.standing(&agent).unwrap();
        assert_eq!((&episode, standing.step, &standing.last), (&record.episode, 3, &record.last));
    }

    /// Every byte of it counts, and every cut is noticed.
    #[test]
    fn damage_is_noticed() {
        let bytes = acted().1.write().unwrap();
        for i in 0..bytes.len() {
            let mut flipped = bytes.clone();
            flipped[i] ^= 1 << (i % 8);
            Record::read(&flipped).unwrap_err();
            Record::read(&bytes[..i]).unwrap_err();
        }
        assert_eq!(Record::read(b"PK"), Err(Unreadable::Foreign));
        let newer = [&EXPORTED[..], &[VERSION + 1], &bytes[5..]].concat();
        assert_eq!(Record::read(&newer), Err(Unreadable::Newer(VERSION + 1)));
        assert_eq!(Record::read(&[&bytes[..], &[0]].concat()), Err(Unreadable::Damaged));
    }

    /// A checksum is no seal: of records that somebody changed and sealed again, none makes an act panic or go on for long.
    #[test]
    fn whatever_is_written_by_hand_does_no_harm() {
        let (agent, record) = acted();
        let bytes = record.write().unwrap();
        let (mut malformed, mut refused, mut acted) = (0, 0, 0);
        for i in HEAD_LEN..bytes.len() {
            for to in [0x00, 0x7f, 0xc0, 0xca, 0xff, bytes[i] ^ 1] {
                let mut changed = bytes.clone();
                changed[i] = to;
                let sum = CRC.checksum(&changed[HEAD_LEN..]);
                changed[HEAD_LEN - 4..HEAD_LEN].copy_from_slice(&sum.to_le_bytes());
                let Ok(read) = Record::read(&changed) else {
                    malformed += 1;
                    continue;
                };
                let Ok((episode, _)) = read.standing(&agent) else {
                    refused += 1;
                    continue;
                };
                acted += 1;
                if let Ok((_, chunk)) = agent.act(&episode, &Observation { state: vec![0.1; 4], ..Observation::default() }) {
                    assert!(chunk.fits(agent.spec()));
                }
            }
        }
        assert!(malformed > 1_000 && refused > 100 && acted > 1_000, "{malformed} {refused} {acted}");
    }

    #[test]
    fn a_record_hangs_together() {
        let (agent, record) = acted();
        let wrong = |change: fn(&mut Record)| {
            let mut changed = record.clone();
            change(&mut changed);
            changed.standing(&agent).unwrap_err().0
        };
        assert_eq!(wrong(|record| record.step = 0), "step");
        assert_eq!(wrong(|record| record.last = None), "step");
        assert_eq!(wrong(|record| record.resets = u64::MAX), "step");
        assert_eq!(wrong(|record| record.reset_ids = vec!["a".to_owned(); RESET_IDS_MAX + 1]), "reset_ids");
        assert_eq!(wrong(|record| record.reset_ids = vec![String::new()]), "reset_ids");
        assert_eq!(wrong(|record| record.reset_ids = vec!["a".repeat(65)]), "reset_ids");
        assert_eq!(wrong(|record| record.last.iter_mut().for_each(|last| Arc::make_mut(&mut last.chunk).actions[0].push(0.0))), "last");
        assert_eq!(
            wrong(|record| record.last.iter_mut().for_each(|last| Arc::make_mut(&mut last.chunk).latent_mean[0] = f32::NAN)),
            "last"
        );
    }
}
