//! The three files on disk, replaced in one step.
//!
//! New files are written beside the old ones (`NAME.next`) and verified. Then the manifest is renamed, and that is the step: it names the
//! other two by their digests, and a reader takes `NAME` or `NAME.next`, whichever it means. The two renames after it only tidy up. So a
//! kill at any moment leaves the old checkpoint or the new one, and `NAME` itself is a whole file at all times.

use super::{CONFIG, CheckpointError, HEADER_BYTES_MAX, MANIFEST, Manifest, WEIGHT_BYTES_MAX, WEIGHTS, invalid, io, sha256};
use std::{
    fs::{self, File},
    io::{Read, Write},
    path::{Path, PathBuf},
};

/// What is in a checkpoint's directory.
pub(super) struct Files {
    pub(super) config: Vec<u8>,
    pub(super) weights: Vec<u8>,
    pub(super) manifest: Vec<u8>,
}

/// One change of a directory; after each of them, and in the middle of a `Write`, the process may be killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Gives `NAME` what an interrupted switch had left in `NAME.next`.
    Settle,
    /// Writes `NAME.next`.
    Write(&'static str),
    /// Loads what is written.
    Verify,
    /// `NAME.next` becomes `NAME`; of the manifest, this is the switch.
    Rename(&'static str),
}

/// All that a replacement does, in order.
pub(super) const STEPS: [Step; 8] = [
    Step::Settle,
    Step::Write(CONFIG),
    Step::Write(WEIGHTS),
    Step::Write(MANIFEST),
    Step::Verify,
    Step::Rename(MANIFEST),
    Step::Rename(CONFIG),
    Step::Rename(WEIGHTS),
];

impl Files {
    /// The files of a directory; config and weights have the digests of the manifest.
    pub(super) fn read(dir: &Path) -> Result<Self, CheckpointError> {
        let manifest = read(&dir.join(MANIFEST), HEADER_BYTES_MAX)?;
        let parsed = Manifest::parse(&dir.join(MANIFEST), &manifest)?;
        let part = |name, bytes_max| {
            let path = dir.join(name);
            let found = |from: &Path| read(from, bytes_max).and_then(|bytes| parsed.check_digest(name, &path, bytes));
            // `NAME.next` may have become `NAME` in between. Only the reason why `NAME` was not it is told: `NAME.next` is hardly ever there.
            found(&path).or_else(|error| found(&next(dir, name)).or_else(|_| found(&path)).map_err(|_| error))
        };
        Ok(Self { config: part(CONFIG, HEADER_BYTES_MAX)?, weights: part(WEIGHTS, parsed.weight_bytes_max())?, manifest })
    }

    /// Makes these the checkpoint of `dir` once `verify` has accepted what is on disk; otherwise the directory is as it was.
    pub(super) fn replace(&self, dir: &Path, verify: impl Fn(&Self) -> Result<(), CheckpointError>) -> Result<(), CheckpointError> {
        fs::create_dir_all(dir).map_err(|error| io(dir, &error))?;
        let (first, rest) = STEPS.split_first().expect("a constant: is a bug");
        self.take(*first, dir, &verify)?;
        rest.iter().try_for_each(|step| self.take(*step, dir, &verify)).inspect_err(|_| {
            // Before the switch nothing needs the next files: what the old manifest may have meant by them is settled.
            if !self.is_at(dir) {
                [CONFIG, WEIGHTS, MANIFEST].iter().for_each(|name| drop(fs::remove_file(next(dir, name))));
            }
        })
    }

    /// One step of [`STEPS`].
    pub(super) fn take(
        &self,
        step: Step,
        dir: &Path,
        verify: impl Fn(&Self) -> Result<(), CheckpointError>,
    ) -> Result<(), CheckpointError> {
        match step {
            Step::Settle => settle(dir),
            Step::Write(name) => write(&next(dir, name), self.of(name)),
            Step::Verify => {
                let written = |name, bytes_max| read(&next(dir, name), bytes_max);
                let [config, weights] = [written(CONFIG, HEADER_BYTES_MAX)?, written(WEIGHTS, WEIGHT_BYTES_MAX)?];
                verify(&Self { config, weights, manifest: written(MANIFEST, HEADER_BYTES_MAX)? })
            }
            Step::Rename(name) => rename(dir, name),
        }
    }

    fn of(&self, name: &str) -> &[u8] {
        match name {
            CONFIG => &self.config,
            WEIGHTS => &self.weights,
            _ => &self.manifest,
        }
    }

    /// Whether the switch to these files is done.
    fn is_at(&self, dir: &Path) -> bool {
        read(&dir.join(MANIFEST), HEADER_BYTES_MAX).is_ok_and(|manifest| manifest == self.manifest)
    }
}

/// Ends a switch that was interrupted after its manifest: what the manifest means by `NAME` may lie in `NAME.next`, which is about to be
/// written anew.
fn settle(dir: &Path) -> Result<(), CheckpointError> {
    let path = dir.join(MANIFEST);
    let Some(manifest) = read(&path, HEADER_BYTES_MAX).ok().and_then(|bytes| Manifest::parse(&path, &bytes).ok()) else { return Ok(()) };
    for (name, bytes_max) in [(CONFIG, HEADER_BYTES_MAX), (WEIGHTS, WEIGHT_BYTES_MAX)] {
        let is_meant = |path: &Path| read(path, bytes_max).is_ok_and(|bytes| manifest.files.get(name) == Some(&sha256(&bytes)));
        if !is_meant(&dir.join(name)) && is_meant(&next(dir, name)) {
            rename(dir, name)?;
        }
    }
    Ok(())
}

fn next(dir: &Path, name: &str) -> PathBuf {
    dir.join(format!("{name}.next"))
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let written = || {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    written().map_err(|error: std::io::Error| io(path, &error))
}

/// Puts `NAME.next` in the place of `NAME`, and has the disk remember it before anything that comes after.
fn rename(dir: &Path, name: &str) -> Result<(), CheckpointError> {
    let renamed = fs::rename(next(dir, name), dir.join(name)).and_then(|()| File::open(dir)?.sync_all());
    renamed.map_err(|error| io(&dir.join(name), &error))
}

/// A file of at most this size. Only a regular one is opened: a pipe would keep the reader for as long as nobody writes.
pub(super) fn read(path: &Path, bytes_max: u64) -> Result<Vec<u8>, CheckpointError> {
    let metadata = fs::metadata(path).map_err(|error| io(path, &error))?;
    if !metadata.is_file() {
        return Err(invalid(path, "is no regular file"));
    }
    let too_large = || invalid(path, format!("larger than {bytes_max} bytes"));
    if metadata.len() > bytes_max {
        return Err(too_large());
    }
    let file = File::open(path).map_err(|error| io(path, &error))?;
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    // It may grow meanwhile.
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(|error| io(path, &error))?;
    if bytes.len() as u64 > bytes_max { Err(too_large()) } else { Ok(bytes) }
}
