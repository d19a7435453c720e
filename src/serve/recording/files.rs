//! The directory of recordings: names in the order of their age, and no more bytes than are wanted.

use super::format::{MAGIC, VERSION};
use crate::serve::store::unix_ms;
use std::{
    fs::{self, File, OpenOptions},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
};

/// Of a recording's name.
pub const EXTENSION: &str = "adar";
/// What has to be free for a recording to begin again: more than any few entries take.
const ROOM_LEN: usize = 64 << 10;

/// A recording that is being written.
pub struct Open {
    file: File,
    path: PathBuf,
    /// Of what is good.
    len: u64,
}

impl Open {
    /// Begins a file that is newer than all others by its name, and older ones go until there is room for `bytes` more within `bytes_max`.
    pub fn begin(dir: &Path, (bytes, bytes_max): (u64, u64), header: &[u8]) -> io::Result<Self> {
        make_room(dir, bytes_max.saturating_sub(bytes))?;
        let (file, path) = create(dir)?;
        let mut begun = Self { file, path, len: 0 };
        begun.append(&[&MAGIC[..], &[VERSION], header].concat()).inspect_err(|_| begun.take_back())?;
        Ok(begun)
    }

    /// Appends these bytes, or nothing.
    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        let written = self.file.write_all(bytes);
        match written {
            Ok(()) => self.len += bytes.len() as u64,
            // What was written of it is no entry; where this fails too the file ends within one, which readers know.
            Err(_) => drop(self.file.set_len(self.len)),
        }
        written
    }

    /// Whether there is room for more than a few entries: writes so much to a file without a name, which is gone with it.
    pub fn has_room(dir: &Path) -> io::Result<()> {
        tempfile::tempfile_in(dir)?.write_all(&[0; ROOM_LEN])
    }

    /// Bytes so far.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// As if it had never been.
    fn take_back(&self) {
        // It is small, and goes with the oldest.
        let _there = fs::remove_file(&self.path);
    }
}

/// A new file, whose name is its age; two servers may share a directory.
fn create(dir: &Path) -> io::Result<(File, PathBuf)> {
    let newest = recordings(dir)?.into_iter().filter_map(|(path, _)| number(&path)).max().unwrap_or(0);
    let mut number = unix_ms().max(newest + 1);
    loop {
        let path = dir.join(format!("{number:013}.{EXTENSION}"));
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((file, path)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error),
        }
    }
}

fn number(path: &Path) -> Option<u64> {
    path.file_stem()?.to_str()?.parse().ok()
}

/// Recordings with their lengths, oldest first.
fn recordings(dir: &Path) -> io::Result<Vec<(PathBuf, u64)>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == EXTENSION) && number(&path).is_some() {
            // One that is gone meanwhile takes no room.
            found.push((path.clone(), path.metadata().map_or(0, |metadata| metadata.len())));
        }
    }
    found.sort();
    Ok(found)
}

/// Removes the oldest until there are no more bytes than this.
fn make_room(dir: &Path, bytes_max: u64) -> io::Result<()> {
    let found = recordings(dir)?;
    let mut bytes: u64 = found.iter().map(|(_, len)| len).sum();
    for (path, len) in found {
        if bytes <= bytes_max {
            break;
        }
        fs::remove_file(&path)?;
        tracing::info!(path = %path.display(), "the oldest recording gave its place");
        bytes -= len;
    }
    Ok(())
}
