//! D4RL's HDF5 layout: flat arrays at the root, episodes one after the other (no libhdf5 needed). Of a file only the arrays that are
//! asked for are read, some rows at a time.
mod element;
mod kind;
mod links;
mod lzf;

use super::{
    Dataset, DatasetError, Span,
    room::Room,
    rows::{Field, FieldWriter, Fields, pieces},
};
use element::Element;
use hdf5_reader::{
    FilterRegistry, Hdf5File, OpenOptions, SliceInfo, SliceInfoElem,
    error::Error,
    group::Group,
    messages::{HdfMessage, link::LinkTarget},
};
use links::Links;
use sha2::{Digest, Sha256};
use std::{
    fs::File,
    io::{self, Read as _},
    ops::Range,
    path::Path,
};

/// Arrays whose flags say that the task ended, and that the clock ended the episode: D4RL's name and Gymnasium's. Any flag in any of
/// them is the last step of an episode.
const TERMINALS: [&str; 2] = ["terminals", "terminations"];
const TIMEOUTS: [&str; 2] = ["timeouts", "truncations"];
/// The hidden truth, where it was recorded.
const CONTEXT: &str = "infos/context";
/// Whether an episode shows what comes of actions and is nothing to imitate.
const PLAY: &str = "infos/play";
/// Number of the session of an episode: consecutive episodes of one follow one another.
const SESSION: &str = "infos/session";
/// Whole numbers below it are exact in 32 bits; a time stamp is not.
const SESSION_MAX: f32 = 16_777_216.0;
/// Bytes of a piece that is read at once, or one row of chunks where that is more: so every chunk is unpacked once.
const PIECE_BYTES: usize = 1 << 20;
/// Layout class of a virtual data set.
const VIRTUAL: u8 = 3;

/// Reads and checks the file: `observations (N, d_s)`, `actions (N, d_a)`, `rewards (N,)`, `terminals (N,)` or `terminations (N,)`, and
/// where there are any `timeouts (N,)`, `truncations (N,)`, `infos/context (N, d_c)`, the hidden truth that only the probe looks at, and
/// `infos/play (N,)` and `infos/session (N,)`, the same in all steps of an episode.
///
/// # Errors
/// If the file cannot be read, an array is missing, present but unreadable, of another shape or type, or holds a value that is not finite.
pub fn read(path: &Path, room: &Room) -> Result<Dataset, DatasetError> {
    let arrays = Arrays::open(path)?;
    let observations = arrays.require("observations")?;
    let rows = observations.rows;
    let [actions, rewards] = [arrays.require("actions")?, arrays.require("rewards")?];
    let [context, play, session] = [arrays.find(CONTEXT)?, arrays.find(PLAY)?, arrays.find(SESSION)?];
    let [terminals, timeouts] = [arrays.all(TERMINALS)?, arrays.all(TIMEOUTS)?];
    if terminals.is_empty() {
        arrays.require(TERMINALS[0])?;
    }
    let optional = context.iter().chain(&play).chain(&session);
    for array in [&observations, &actions, &rewards].into_iter().chain(optional).chain(&terminals).chain(&timeouts) {
        arrays.check(array, rows)?;
    }
    let [ended, timed_out] = [arrays.flags(terminals.iter(), rows)?, arrays.flags(timeouts.iter(), rows)?];
    let rows_of = spans(&ended.iter().zip(&timed_out).map(|(ended, timed_out)| *ended || *timed_out).collect::<Vec<_>>());
    let mut notes = Vec::new();
    if timeouts.is_empty() {
        let longest = rows_of.iter().map(Range::len).max().unwrap_or(0);
        let ends = terminals.iter().map(|array| format!("`{}`", array.field)).collect::<Vec<_>>().join(" and ");
        notes.push(format!(
            "{}: no `timeouts` or `truncations`, so episodes end at {ends} only; the longest of {} has {longest} steps",
            arrays.path,
            rows_of.len()
        ));
    }
    let of_episodes = |array: &Option<Array>| array.as_ref().map(|array| arrays.of_episodes(array, &rows_of)).transpose();
    let (play, session) = (of_episodes(&play)?, of_episodes(&session)?);
    if let Some(number) = session.iter().flatten().find(|number| number.abs() >= SESSION_MAX) {
        let reason =
            format!("has the number {number}, but from {SESSION_MAX} on numbers are rounded and may look alike: count sessions from 0");
        return Err(arrays.invalid(SESSION, reason));
    }
    let follows = |index: usize| session.as_ref().is_some_and(|session| index > 0 && session[index - 1] == session[index]);
    let episode = |(index, rows): (usize, &Range<usize>)| Span {
        rows: rows.clone(),
        play: play.as_ref().is_some_and(|play| play[index] != 0.0),
        // Where a file says both, time was up.
        ended: ended[rows.end - 1] && !timed_out[rows.end - 1],
        // What came of an episode's last act no other act tells.
        before: follows(index).then(|| rows_of[index - 1].start..rows_of[index - 1].end - 1).filter(|before| !before.is_empty()),
    };
    let episodes = rows_of.iter().enumerate().map(episode).collect();
    let columns: usize = [&observations, &actions, &rewards].into_iter().chain(&context).map(|array| array.width).sum();
    let bytes = 4 * (rows * columns) as u64;
    let in_file = bytes > room.memory_bytes;
    if in_file {
        let [bytes, limit] = [bytes, room.memory_bytes].map(|bytes| bytes.div_ceil(1 << 20));
        notes.push(format!(
            "rows take {bytes} MiB, more than --data-memory-mib allows ({limit}): kept in a file in {}",
            room.scratch.display()
        ));
    }
    let store = |array: &Array| arrays.store(array, room, in_file);
    let fields = Fields {
        states: store(&observations)?,
        actions: store(&actions)?,
        rewards: store(&rewards)?,
        context: context.as_ref().map_or_else(|| Ok(Field::in_memory(0, Vec::new())), store)?,
    };
    Ok(Dataset { digest: digest(path).map_err(|error| arrays.unreadable(error))?, path: arrays.path, fields, episodes, notes })
}

/// Half-open ranges of the episodes; rows after the last end flag are an episode of their own.
fn spans(ends: &[bool]) -> Vec<Range<usize>> {
    let mut from = 0;
    let mut spans = Vec::new();
    for (row, end) in ends.iter().enumerate() {
        if *end || row + 1 == ends.len() {
            spans.push(from..row + 1);
            from = row + 1;
        }
    }
    spans
}

/// One array of the file: `(rows, width)` numbers.
struct Array {
    field: &'static str,
    dataset: hdf5_reader::Dataset,
    rows: usize,
    width: usize,
}

struct Arrays {
    file: Hdf5File,
    root: Group,
    links: Links,
    path: String,
}

impl Arrays {
    fn open(path: &Path) -> Result<Self, DatasetError> {
        let name = path.display().to_string();
        let unreadable = |error: Error| {
            let reason = kind::not_hdf5(path).unwrap_or_else(|| error.to_string());
            DatasetError::Unreadable { path: name.clone(), reason }
        };
        let mut filters = FilterRegistry::new();
        filters.register(lzf::FILTER_LZF, Box::new(lzf::decode));
        // Nothing is read twice, so nothing needs to be kept.
        let options = OpenOptions::default().with_filter_registry(filters).with_chunk_cache_bytes(0);
        let file = Hdf5File::open_with_options(path, options).map_err(unreadable)?;
        let root = file.root_group().map_err(unreadable)?;
        let links = links::links(&file, &root).map_err(unreadable)?;
        Ok(Self { file, root, links, path: name })
    }

    fn invalid(&self, field: &str, reason: impl Into<String>) -> DatasetError {
        DatasetError::Invalid { path: self.path.clone(), field: field.into(), reason: reason.into() }
    }

    fn unreadable(&self, error: io::Error) -> DatasetError {
        DatasetError::Unreadable { path: self.path.clone(), reason: error.to_string() }
    }

    /// The array, or what the file is that lacks it.
    fn require(&self, field: &'static str) -> Result<Array, DatasetError> {
        if let Some(array) = self.find(field)? {
            return Ok(array);
        }
        let data = self.root.group("data").and_then(|group| links::links(&self.file, &group)).unwrap_or_default();
        let other = kind::other_layout(&self.links, &data);
        let missing = || format!("is missing; the file has {}", kind::names(&self.links));
        Err(self.invalid(field, other.unwrap_or_else(missing)))
    }

    /// Those of these arrays that are there.
    fn all(&self, fields: [&'static str; 2]) -> Result<Vec<Array>, DatasetError> {
        fields.into_iter().filter_map(|field| self.find(field).transpose()).collect()
    }

    /// The array; none only if no such name is in the file.
    fn find(&self, field: &'static str) -> Result<Option<Array>, DatasetError> {
        let damaged = |error: Error| self.invalid(field, format!("is there, but cannot be read: {}", explain(&error)));
        let (mut group, mut links, mut name) = (self.root.clone(), self.links.clone(), field);
        while let Some((parent, rest)) = name.split_once('/') {
            let Some(link) = links.get(parent) else { return Ok(None) };
            group = match group.group(parent) {
                Ok(group) => group,
                // An array has no names inside of it.
                Err(_) if group.dataset(parent).is_ok() => return Ok(None),
                Err(error) => return Err(self.invalid(parent, broken(link, &error))),
            };
            links = links::links(&self.file, &group).map_err(damaged)?;
            name = rest;
        }
        let Some(link) = links.get(name) else { return Ok(None) };
        let dataset = match group.dataset(name) {
            Ok(dataset) => dataset,
            Err(_) if group.group(name).is_ok() => return Err(self.invalid(field, "is a group, expected an array")),
            Err(error) => return Err(self.invalid(field, broken(link, &error))),
        };
        let width = match *dataset.shape() {
            [_] => 1,
            [_, width] if width > 0 => width as usize,
            ref shape => return Err(self.invalid(field, format!("shape {shape:?}, expected (N,) or (N, columns)"))),
        };
        if let Some(dtype) = element::unreadable(&dataset).map_err(damaged)? {
            let known = "expected floats of 16, 32 or 64 bits, integers or booleans";
            return Err(self.invalid(field, format!("holds {dtype}, {known}")));
        }
        self.refuse_other_files(field, &dataset)?;
        Ok(Some(Array { field, rows: dataset.shape()[0] as usize, width, dataset }))
    }

    /// Values in another file are none of this one, whose digest says what was trained on.
    fn refuse_other_files(&self, field: &str, dataset: &hdf5_reader::Dataset) -> Result<(), DatasetError> {
        let header = self.file.get_or_parse_header(dataset.address()).map_err(|error| self.invalid(field, error.to_string()))?;
        if header.messages.iter().any(|message| matches!(message, HdfMessage::ExternalFiles(_))) {
            return Err(self.invalid(field, "has its values in other files; copy them into this one"));
        }
        Ok(())
    }

    /// As many rows as `observations`, and one column where one is meant.
    fn check(&self, array: &Array, rows: usize) -> Result<(), DatasetError> {
        if array.rows != rows || rows == 0 {
            return Err(self.invalid(array.field, format!("{} rows, but `observations` has {rows}", array.rows)));
        }
        if array.width != 1 && !["observations", "actions", CONTEXT].contains(&array.field) {
            return Err(self.invalid(array.field, format!("{} columns, expected 1", array.width)));
        }
        Ok(())
    }

    /// Shows the numbers of an array in order, some rows at a time; every one finite.
    fn visit(&self, array: &Array, mut visit: impl FnMut(usize, &[Element]) -> io::Result<()>) -> Result<(), DatasetError> {
        let row_bytes = (array.width * array.dataset.raw_element_size().unwrap_or(8)).max(1);
        let chunk = array.dataset.chunks().and_then(|chunk| chunk.first().copied()).map_or(1, |rows| rows.max(1) as usize);
        for rows in pieces(0..array.rows, (PIECE_BYTES / row_bytes).div_ceil(chunk).max(1) * chunk) {
            let all = |count: usize| SliceInfoElem::Slice { start: 0, end: count as u64, step: 1 };
            let range = SliceInfoElem::Slice { start: rows.start as u64, end: rows.end as u64, step: 1 };
            let selections = std::iter::once(range).chain((1..array.dataset.ndim()).map(|_| all(array.width))).collect();
            let values = array.dataset.read_slice::<Element>(&SliceInfo { selections });
            let values = values.map_err(|error| self.invalid(array.field, explain(&error)))?.into_raw_vec_and_offset().0;
            if let Some(at) = values.iter().position(|element| !element.value.is_finite()) {
                let (row, column) = (rows.start + at / array.width, at % array.width);
                return Err(self.invalid(array.field, format!("{} at row {row}, column {column}", values[at].value)));
            }
            visit(rows.start, &values).map_err(|error| self.unreadable(error))?;
        }
        Ok(())
    }

    /// Flags that are set in any of the arrays: booleans, which h5py writes as an enum, or numbers, of which all but 0 are true.
    fn flags<'a>(&self, arrays: impl Iterator<Item = &'a Array>, rows: usize) -> Result<Vec<bool>, DatasetError> {
        let mut flags = vec![false; rows];
        for array in arrays {
            self.visit(array, |row, elements| {
                flags[row..].iter_mut().zip(elements).for_each(|(flag, element)| *flag |= element.flag);
                Ok(())
            })?;
        }
        Ok(flags)
    }

    /// The number that an array has in all rows of each episode.
    fn of_episodes(&self, array: &Array, spans: &[Range<usize>]) -> Result<Vec<f32>, DatasetError> {
        let mut rows = Vec::with_capacity(array.rows);
        self.visit(array, |_, elements| {
            rows.extend(elements.iter().map(|element| element.value));
            Ok(())
        })?;
        let number = |span: &Range<usize>| match span.clone().find(|row| rows[*row] != rows[span.start]) {
            None => Ok(rows[span.start]),
            Some(row) => {
                Err(self.invalid(array.field, format!("changes at row {row}, within the episode that begins at row {}", span.start)))
            }
        };
        spans.iter().map(number).collect()
    }

    fn store(&self, array: &Array, room: &Room, in_file: bool) -> Result<Field, DatasetError> {
        let kept = |error: io::Error| self.unreadable(io::Error::new(error.kind(), format!("{}: {error}", room.scratch.display())));
        let mut writer = FieldWriter::new(array.width, array.rows, room, in_file).map_err(kept)?;
        self.visit(array, |_, elements| {
            let values: Vec<f32> = elements.iter().map(|element| element.value).collect();
            writer.push(&values)
        })?;
        writer.finish().map_err(kept)
    }
}

/// Why a name that is there does not lead to what was looked for.
fn broken(link: &LinkTarget, error: &Error) -> String {
    match link {
        LinkTarget::Hard { .. } if matches!(error, Error::DatasetNotFound(_)) => "is there, but is no array".into(),
        LinkTarget::Hard { .. } => format!("is there, but cannot be read: {}", explain(error)),
        LinkTarget::Soft { path } => format!("is a link to `{path}`, which cannot be opened: {}", explain(error)),
        LinkTarget::External { filename, path } => format!("is a link to `{path}` in another file, {filename}; copy it into this one"),
    }
}

/// What the reader says, and in words where it says a number.
fn explain(error: &Error) -> String {
    match error {
        Error::Context { source, .. } => explain(source),
        Error::UnsupportedLayoutClass(VIRTUAL) => {
            "a virtual data set, whose values lie in other arrays or files; copy them into an array of their own".into()
        }
        Error::UnsupportedFilter(filter) => {
            format!("compressed in a way that is not understood ({filter}); gzip, lzf, szip or no compression are")
        }
        other => other.to_string(),
    }
}

/// SHA-256 of a file, which may be larger than memory.
fn digest(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let (mut sha, mut piece) = (Sha256::new(), vec![0; PIECE_BYTES]);
    loop {
        match file.read(&mut piece)? {
            0 => return Ok(sha.finalize().iter().map(|byte| format!("{byte:02x}")).collect()),
            len => sha.update(&piece[..len]),
        }
    }
}
