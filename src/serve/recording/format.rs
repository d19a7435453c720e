//! What stands in a recording.
//!
//! `ADAR` and one byte of version; then entries: the length of the body (4 bytes, little-endian), the CRC-32C of these 4 bytes, the CRC-32C of the body,
//! and the body, an [`Entry`] as MessagePack with the names of its fields. The first one is a [`Header`]. A file that ends within an entry was cut
//! there, by the end of its process or of its disk; all before it is good.
//!
//! A reader takes its own version and the one before: [`read_body`] is the place where an old entry becomes one of today.

use crate::{
    model::{
        agent::{Chunk, Haste, Observation, Start},
        nn::Precision,
    },
    serve::{options::OptionsPatch, session::Handle, store::UnixMs},
};
use base64::{Engine, prelude::BASE64_STANDARD};
use crc::{CRC_32_ISCSI, Crc};
use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{self, Visitor},
};
use sha2::{Digest, Sha256};
use std::fmt;

/// Of what is written.
pub const VERSION: u8 = 1;
/// The oldest that is read.
pub const VERSION_MIN: u8 = 1;
/// Begins a recording; the version follows.
pub const MAGIC: &[u8; 4] = b"ADAR";
/// Bytes before a body.
pub const HEAD_LEN: usize = 12;
/// No entry is longer: one that says so is damaged.
pub const BODY_LEN_MAX: usize = 1 << 30;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// One entry.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Entry {
    /// Of the whole file.
    Header(Header),
    /// Where a session stands from which what follows goes on.
    Stands(Box<Stands>),
    /// An act that was committed.
    Act(Box<Act>),
    /// A new episode that was begun.
    Reset(Reset),
    /// Something is missing.
    Lost(Lost),
}

/// Of the whole file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Version of the server.
    pub server: String,
    /// When the file was begun.
    pub at: UnixMs,
    /// How it held the weights: answers depend on it, and the digest of a model does not tell.
    pub weights: Precision,
    /// Whether observations and answers are in it; else their digests.
    pub observations: bool,
}

/// Where a session stands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stands {
    /// The session's name in lists, which is no right to anything.
    pub session: Handle,
    /// Name of the model.
    pub model: String,
    /// Its digest.
    pub model_digest: String,
    /// Seed of the running episode.
    pub seed: u64,
    /// How its chunks are sampled.
    pub options: OptionsPatch,
    /// How often it was reset.
    pub episode: u64,
    /// Acts committed in the running episode.
    pub step: u64,
    /// Entries of this session that were left out before this one.
    pub lost: u64,
    /// The session as bytes ([`crate::serve::session::Record`]). None: it is new, and seed and options are all there is to it; or it is withheld.
    pub record: Option<Bytes>,
}

/// An act that was committed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Act {
    /// Whose.
    pub session: Handle,
    /// How often the session had been reset.
    pub episode: u64,
    /// The step that it committed.
    pub step: u64,
    /// Milliseconds since the file was begun.
    pub after_ms: u64,
    /// What was seen.
    pub seen: Seen,
    /// What a deadline made of it.
    pub haste: Option<Haste>,
    /// What was answered.
    pub answer: Answered,
    /// Where the time went.
    pub timings: Timings,
}

/// What was seen, or that something was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seen {
    /// As the server read it.
    Observation(Observation),
    /// Withheld.
    Shape(Shape),
}

/// What is told of an observation that is withheld.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shape {
    /// See [`crate::serve::session::key_of`].
    pub digest: Bytes,
    /// Values of the state.
    pub state_len: usize,
    /// Steps told of.
    pub executed_len: usize,
    /// Rows of the true context.
    pub context_len: Option<usize>,
}

/// What was answered, or that something was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answered {
    /// Bit for bit.
    Answer(Answer),
    /// Withheld.
    Outline(Outline),
}

/// A [`Chunk`], but for the planned states, of which there is a digest: they are most of it by far, and nobody drives by them. All else is there as it is,
/// so that a difference can be told by its number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Answer {
    /// See [`Chunk::actions`].
    pub actions: Vec<Vec<f32>>,
    /// See [`Chunk::latent_mean`].
    pub latent_mean: Vec<f32>,
    /// See [`Chunk::latent_log_var`].
    pub latent_log_var: Vec<f32>,
    /// See [`Chunk::predicted_state`].
    pub predicted_state: Vec<f32>,
    /// See [`Chunk::evaluations`].
    pub evaluations: u32,
    /// See [`Chunk::passes`].
    pub passes: u32,
    /// See [`Chunk::value`].
    pub value: Option<f32>,
    /// See [`Chunk::value_spread`].
    pub value_spread: Option<f32>,
    /// See [`Chunk::start`].
    pub start: Start,
    /// See [`Chunk::degraded`].
    pub degraded: bool,
    /// Rows of the planned states.
    pub planned_len: usize,
    /// SHA-256 of their values, little-endian, one row after the other.
    pub planned_digest: Bytes,
}

/// What is told of an answer that is withheld.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outline {
    /// SHA-256 of the [`Answer`] as it would stand here.
    pub digest: Bytes,
    /// See [`Chunk::evaluations`].
    pub evaluations: u32,
    /// See [`Chunk::passes`].
    pub passes: u32,
    /// See [`Chunk::start`].
    pub start: Start,
    /// See [`Chunk::degraded`].
    pub degraded: bool,
}

/// Where the time of an act went, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timings {
    /// Waiting for a worker.
    pub queue_us: u64,
    /// Network evaluations, those of batch mates included.
    pub compute_us: u64,
    /// From arrival to the answer.
    pub total_us: u64,
}

/// A new episode that was begun.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reset {
    /// Whose.
    pub session: Handle,
    /// Its number.
    pub episode: u64,
    /// Its seed.
    pub seed: u64,
    /// Whether the latent goes on looking back on the one before.
    pub keep_history: bool,
}

/// Something is missing: the sessions that it is of are written down anew before they go on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lost {
    /// Entries that were left out since the file was begun, or since the last of these.
    pub entries: u64,
}

impl Answer {
    /// Of a chunk.
    pub fn of(chunk: &Chunk) -> Self {
        let Chunk {
            actions,
            planned_states,
            latent_mean,
            latent_log_var,
            predicted_state,
            evaluations,
            passes,
            value,
            value_spread,
            start,
            degraded,
        } = chunk;
        let planned: Vec<u8> = planned_states.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        Self {
            actions: actions.clone(),
            latent_mean: latent_mean.clone(),
            latent_log_var: latent_log_var.clone(),
            predicted_state: predicted_state.clone(),
            evaluations: *evaluations,
            passes: *passes,
            value: *value,
            value_spread: *value_spread,
            start: *start,
            degraded: *degraded,
            planned_len: planned_states.len(),
            planned_digest: Bytes(Sha256::digest(planned).to_vec()),
        }
    }

    /// What is told of it where it is withheld.
    ///
    /// # Errors
    /// If the format cannot express it, which is a defect.
    pub fn outline(&self) -> Result<Outline, rmp_serde::encode::Error> {
        let Self { evaluations, passes, start, degraded, .. } = *self;
        let digest = Bytes(Sha256::digest(rmp_serde::to_vec_named(self)?).to_vec());
        Ok(Outline { digest, evaluations, passes, start, degraded })
    }
}

impl Shape {
    /// Of an observation with this key.
    pub fn of(observation: &Observation, key: &[u8]) -> Self {
        let Observation { state, executed, nothing_executed: _, context } = observation;
        let context_len = context.as_ref().map(Vec::len);
        Self { digest: Bytes(key.to_vec()), state_len: state.len(), executed_len: executed.len(), context_len }
    }
}

/// Appends an entry.
///
/// # Errors
/// If the format cannot express it, which is a defect; then nothing is appended.
pub fn write(entry: &Entry, to: &mut Vec<u8>) -> Result<(), rmp_serde::encode::Error> {
    let begin = to.len();
    to.extend_from_slice(&[0; HEAD_LEN]);
    let written = entry.serialize(&mut rmp_serde::Serializer::new(&mut *to).with_struct_map());
    if written.is_err() {
        to.truncate(begin);
        return written;
    }
    let len = (to.len() - begin - HEAD_LEN) as u32;
    let head = [len.to_le_bytes(), CRC.checksum(&len.to_le_bytes()).to_le_bytes(), CRC.checksum(&to[begin + HEAD_LEN..]).to_le_bytes()];
    to[begin..begin + HEAD_LEN].copy_from_slice(head.as_flattened());
    Ok(())
}

/// The length of a body and its checksum, of the bytes before it; None: they are damaged.
pub fn read_head(head: [u8; HEAD_LEN]) -> Option<(usize, u32)> {
    let (parts, _) = head.as_chunks::<4>();
    let [len, len_sum, sum] = [parts[0], parts[1], parts[2]].map(u32::from_le_bytes);
    (len_sum == CRC.checksum(&len.to_le_bytes()) && len as usize <= BODY_LEN_MAX).then_some((len as usize, sum))
}

/// The entry of a body, of a file of this version; None: it is damaged.
pub fn read_body(version: u8, body: &[u8], sum: u32) -> Option<Entry> {
    if CRC.checksum(body) != sum {
        return None;
    }
    match version {
        // The next version's reader turns entries of this one into its own here.
        VERSION => rmp_serde::from_slice(body).ok(),
        _ => None,
    }
}

/// Bytes: as they are in a recording, as base64 in text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bytes(pub Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.serialize_str(&BASE64_STANDARD.encode(&self.0))
        } else {
            serializer.serialize_bytes(&self.0)
        }
    }
}

impl<'de> Deserialize<'de> for Bytes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reads;

        impl Visitor<'_> for Reads {
            type Value = Bytes;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("bytes")
            }

            fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<Bytes, E> {
                Ok(Bytes(bytes.to_vec()))
            }
        }

        deserializer.deserialize_bytes(Reads)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lost(entries: u64) -> Entry {
        Entry::Lost(Lost { entries })
    }

    /// Every bit of it counts: of a length that is wrong nothing after it could be found.
    #[test]
    fn damage_is_noticed() {
        let mut bytes = Vec::new();
        write(&lost(7), &mut bytes).unwrap();
        let read = |bytes: &[u8]| {
            let (len, sum) = read_head(*bytes.first_chunk().unwrap())?;
            read_body(VERSION, bytes.get(HEAD_LEN..HEAD_LEN + len)?, sum)
        };
        assert_eq!(read(&bytes), Some(lost(7)));
        for i in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[i / 8] ^= 1 << (i % 8);
            assert_eq!(read(&flipped), None, "bit {i}");
        }
        assert_eq!(read_body(VERSION + 1, &bytes[HEAD_LEN..], read_head(*bytes.first_chunk().unwrap()).unwrap().1), None);
    }

    #[test]
    fn bytes_are_bytes_or_text() {
        let bytes = Bytes(vec![0, 255, 7]);
        assert_eq!(rmp_serde::from_slice::<Bytes>(&rmp_serde::to_vec(&bytes).unwrap()).unwrap(), bytes);
        assert_eq!(rmp_serde::to_vec(&bytes).unwrap().len(), 5);
    }
}
