//! A session as a token that its client holds and cannot read or write: whatever server has the key goes on with it, under its own id, with no store at all.
//!
//! `ADAT`, one byte of version, which key (8 bytes), until when it holds (milliseconds since 1970, little-endian), a nonce (24 bytes), then what a store
//! would keep of the session ([`Kept`]), sealed by XChaCha20-Poly1305 with everything before it.

use super::{Kept, Unreadable};
use crate::serve::{config::TokensConfig, store::UnixMs};
use base64::{Engine, prelude::BASE64_STANDARD};
use chacha20poly1305::{
    Key, KeyInit, XChaCha20Poly1305, XNonce,
    aead::{Aead, Payload},
};
use sha2::{Digest, Sha256};
use std::{fs, io, os::unix::fs::PermissionsExt, path::Path};
use uuid::Uuid;

const MAGIC: &[u8; 4] = b"ADAT";
/// Of what is sealed.
const VERSION: u8 = 1;
const KEY_LEN: usize = 32;
const NONCE_LEN: usize = 24;
/// Which key, and until when.
const HEAD_LEN: usize = MAGIC.len() + 1 + size_of::<KeyId>() + size_of::<UnixMs>();
/// Clocks of servers may differ by so much.
const SKEW_MS: u64 = 60_000;
/// Bits that others may not have: reading, writing, running.
const OTHERS: u32 = 0o077;

/// The beginning of a key's digest.
type KeyId = [u8; 8];

/// Seals sessions, and opens what it or another server of the same keys has sealed.
pub struct Sealer {
    /// The first one seals.
    keys: Vec<(KeyId, XChaCha20Poly1305)>,
    ttl_ms: u64,
}

/// Why there are no keys.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file cannot be read.
    #[error("tokens.key_file {0}: {1}")]
    Io(String, io::Error),
    /// Others could read it.
    #[error("tokens.key_file {0}: others may read or write it: chmod 600 {0}")]
    Open(String),
    /// What stands there is no key.
    #[error("tokens.key_file {0}, line {1}: is not 32 bytes in base64; head -c 32 /dev/urandom | base64 makes a key")]
    NoKey(String, usize),
    /// Nothing stands there.
    #[error("tokens.key_file {0}: has no key; head -c 32 /dev/urandom | base64 makes one")]
    Empty(String),
}

/// Why a token opens nothing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Sealed {
    /// It is something else, or was changed, or is of another key.
    #[error("is none that this server's keys have sealed, or was changed since")]
    Foreign,
    /// A newer server made it.
    #[error("is of format {0}, and this server reads up to {VERSION}")]
    Newer(u8),
    /// It is too old.
    #[error("has expired")]
    Expired,
    /// What it holds cannot be read.
    #[error(transparent)]
    Unreadable(Unreadable),
}

impl Sealer {
    /// With the keys that the settings name; none where they name no file.
    ///
    /// # Errors
    /// [`KeyError`].
    pub fn of(config: &TokensConfig) -> Result<Option<Self>, KeyError> {
        if config.key_file.as_os_str().is_empty() {
            return Ok(None);
        }
        let (path, name) = (config.key_file.as_path(), config.key_file.display().to_string());
        let text = read(path).map_err(|error| KeyError::Io(name.clone(), error))?.ok_or_else(|| KeyError::Open(name.clone()))?;
        let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let keys =
            lines.map(|(i, line)| key(line.trim()).ok_or_else(|| KeyError::NoKey(name.clone(), i + 1))).collect::<Result<Vec<_>, _>>()?;
        if keys.is_empty() {
            return Err(KeyError::Empty(name));
        }
        Ok(Some(Self { keys, ttl_ms: config.ttl_ms }))
    }

    /// The token of a session, as [`Kept::write`] has it, and how long it holds, in milliseconds.
    pub fn seal(&self, kept: &[u8], now: UnixMs) -> (Vec<u8>, u64) {
        let (id, cipher) = &self.keys[0];
        let head = [&MAGIC[..], &[VERSION], id, &now.saturating_add(self.ttl_ms).to_le_bytes()].concat();
        let nonce = nonce();
        let sealed = cipher.encrypt(&XNonce::from(nonce), Payload { msg: kept, aad: &head });
        let sealed = sealed.expect("a session is shorter than what a cipher takes: is a bug");
        ([&head[..], &nonce, &sealed].concat(), self.ttl_ms)
    }

    /// What a token holds.
    ///
    /// # Errors
    /// [`Sealed`]. That it has expired is said only of one that is ours.
    pub fn open(&self, token: &[u8], now: UnixMs) -> Result<Kept, Sealed> {
        let rest = token.strip_prefix(MAGIC).ok_or(Sealed::Foreign)?;
        match rest.first() {
            Some(&VERSION) => {}
            Some(&version) if version > VERSION => return Err(Sealed::Newer(version)),
            _ => return Err(Sealed::Foreign),
        }
        let (head, sealed) = token.split_at_checked(HEAD_LEN).ok_or(Sealed::Foreign)?;
        let (nonce, sealed) = sealed.split_first_chunk::<NONCE_LEN>().ok_or(Sealed::Foreign)?;
        let (id, until) = head[MAGIC.len() + 1..].split_first_chunk::<8>().ok_or(Sealed::Foreign)?;
        let until = until.try_into().map(u64::from_le_bytes).map_err(|_| Sealed::Foreign)?;
        let (_, cipher) = self.keys.iter().find(|(of, _)| of == id).ok_or(Sealed::Foreign)?;
        let plain = cipher.decrypt(&XNonce::from(*nonce), Payload { msg: sealed, aad: head }).map_err(|_| Sealed::Foreign)?;
        if now >= until.saturating_add(SKEW_MS) {
            return Err(Sealed::Expired);
        }
        Kept::read(&plain).map_err(Sealed::Unreadable)
    }
}

/// The text of the file; None where others may read it.
fn read(path: &Path) -> io::Result<Option<String>> {
    let open = fs::metadata(path)?.permissions().mode() & OTHERS != 0;
    if open { Ok(None) } else { fs::read_to_string(path).map(Some) }
}

fn key(line: &str) -> Option<(KeyId, XChaCha20Poly1305)> {
    let bytes: [u8; KEY_LEN] = BASE64_STANDARD.decode(line).ok()?.try_into().ok()?;
    let digest = Sha256::digest(bytes);
    Some((std::array::from_fn(|i| digest[i]), XChaCha20Poly1305::new(&Key::from(bytes))))
}

/// One that never comes again: of 244 random bits 192.
fn nonce() -> [u8; NONCE_LEN] {
    let digest = Sha256::new().chain_update(Uuid::new_v4()).chain_update(Uuid::new_v4()).finalize();
    std::array::from_fn(|i| digest[i])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::checkpoint,
        serve::session::{Record, record::Kept},
    };
    use std::sync::Arc;

    const NOW: UnixMs = 1_700_000_000_000;

    fn kept() -> Kept {
        let agent = checkpoint::load(Path::new("models/tiny")).unwrap();
        let episode = Arc::new(agent.open(1, &agent.config().defaults.sampler).unwrap());
        let (model, model_digest) = ("tiny".to_owned(), agent.spec().digest.clone());
        let record = Record { model, model_digest, ttl_ms: 60_000, step: 0, resets: 1, reset_ids: vec![], episode, last: None };
        Kept { id: Uuid::new_v4(), request_id: "a".into(), opened: NOW, touched: NOW, record }
    }

    fn sealer(dir: &Path, keys: &[u8]) -> Sealer {
        let path = dir.join(format!("keys{keys:?}"));
        let lines: Vec<String> = keys.iter().map(|key| BASE64_STANDARD.encode([*key; KEY_LEN])).collect();
        fs::write(&path, lines.join("\n")).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        Sealer::of(&TokensConfig { key_file: path, ttl_ms: 1_000 }).unwrap().unwrap()
    }

    #[test]
    fn what_is_sealed_is_opened_by_who_has_the_key() {
        let (dir, kept) = (tempfile::tempdir().unwrap(), kept());
        let [old, both, new] = [&[1][..], &[2, 1], &[2]].map(|keys| sealer(dir.path(), keys));
        let (token, ttl_ms) = old.seal(&kept.write().unwrap(), NOW);
        assert_eq!((ttl_ms, old.open(&token, NOW), both.open(&token, NOW)), (1_000, Ok(kept.clone()), Ok(kept.clone())));
        assert_eq!(new.open(&token, NOW), Err(Sealed::Foreign));
        assert_eq!(new.open(&both.seal(&kept.write().unwrap(), NOW).0, NOW), Ok(kept.clone()), "the first one seals");
        assert_ne!(old.seal(&kept.write().unwrap(), NOW).0, token, "no nonce comes again");
        let id = kept.id.as_bytes();
        assert!(!token.windows(id.len()).any(|part| part == id), "who finds a token learns no id from it");
    }

    #[test]
    fn every_byte_is_sealed() {
        let dir = tempfile::tempdir().unwrap();
        let sealer = sealer(dir.path(), &[1]);
        let token = sealer.seal(&kept().write().unwrap(), NOW).0;
        for i in 0..token.len() {
            let mut changed = token.clone();
            changed[i] ^= 1 << (i % 8);
            sealer.open(&changed, NOW).unwrap_err();
            assert_eq!(sealer.open(&token[..i], NOW), Err(Sealed::Foreign));
        }
        assert_eq!(sealer.open(&[&token[..], &[0]].concat(), NOW), Err(Sealed::Foreign));
        let newer = [&token[..4], &[VERSION + 1], &token[5..]].concat();
        assert_eq!(sealer.open(&newer, NOW), Err(Sealed::Newer(VERSION + 1)));
    }

    #[test]
    fn a_token_holds_for_its_time_whatever_clocks_say() {
        let dir = tempfile::tempdir().unwrap();
        let sealer = sealer(dir.path(), &[1]);
        let token = sealer.seal(&kept().write().unwrap(), NOW).0;
        let at = |now| sealer.open(&token, now).map(|_| ());
        assert_eq!([at(0), at(NOW + 1_000 + SKEW_MS - 1)], [Ok(()), Ok(())]);
        assert_eq!([at(NOW + 1_000 + SKEW_MS), at(UnixMs::MAX)], [Err(Sealed::Expired), Err(Sealed::Expired)]);
    }

    #[test]
    fn a_key_file_is_checked() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys");
        let with = |text: &str, mode: u32| {
            fs::write(&path, text).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            Sealer::of(&TokensConfig { key_file: path.clone(), ttl_ms: 1 })
                .map(|sealer| sealer.map(|_| ()))
                .map_err(|error| error.to_string())
        };
        let good = BASE64_STANDARD.encode([7; KEY_LEN]);
        assert_eq!(with(&format!("{good}\n\n {good} \n"), 0o600), Ok(Some(())));
        for (text, mode, says) in [
            (good.as_str(), 0o640, "chmod 600"),
            (&format!("{good}\nsecret"), 0o600, "line 2"),
            (&BASE64_STANDARD.encode([7; 31]), 0o600, "line 1"),
            ("\n", 0o600, "has no key"),
        ] {
            let error = with(text, mode).unwrap_err();
            assert!(error.contains(says) && !error.contains(&good), "{error}");
        }
        assert!(Sealer::of(&TokensConfig { key_file: dir.path().join("none"), ttl_ms: 1 }).is_err());
        assert!(Sealer::of(&TokensConfig::default()).unwrap().is_none());
    }
}
