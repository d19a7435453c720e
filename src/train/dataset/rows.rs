//! The rows of a data set, in memory or, where they take more than that, in a file that is read piece by piece. Who draws from them
//! cannot tell which: the same numbers come, bit for bit.

use super::{Span, room::Room};
use crate::model::{
    normalizer::{Affine, hold_within},
    trajectory::Layout,
};
use std::{
    borrow::Cow,
    fs::{self, File},
    io::{self, BufWriter, Write},
    ops::Range,
    os::unix::fs::FileExt,
    sync::Arc,
};

/// Rows that a scan takes at a time.
const SCAN_ROWS: usize = 1 << 14;

/// One array of a data set: rows of `width` numbers.
#[derive(Debug)]
pub struct Field {
    width: usize,
    home: Home,
    /// What rows of a file still have to go through.
    units: Option<Map>,
}

/// From raw units to those of the networks.
#[derive(Debug)]
struct Map {
    affine: Affine,
    /// Where columns are held, raw units.
    bounds: Option<Bounds>,
}

/// Lower and upper bound of each column.
pub type Bounds = (Vec<f32>, Vec<f32>);

impl Map {
    fn apply(&self, rows: &mut [f32]) {
        if let Some((low, high)) = &self.bounds {
            hold_within(rows, low, high);
        }
        self.affine.normalize_in_place(rows);
    }
}

/// Where the rows are.
#[derive(Debug)]
enum Home {
    Memory(Vec<f32>),
    /// Little-endian numbers; the file has no name any more and goes with the process.
    File(File),
}

impl Field {
    /// Rows in memory.
    pub fn in_memory(width: usize, values: Vec<f32>) -> Self {
        Self { width, home: Home::Memory(values), units: None }
    }

    /// Numbers in a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The rows in `range`, `(len, width)`.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn rows(&self, range: Range<usize>) -> io::Result<Cow<'_, [f32]>> {
        let numbers = range.start * self.width..range.end * self.width;
        match &self.home {
            Home::Memory(values) => Ok(Cow::Borrowed(&values[numbers])),
            Home::File(file) => {
                let mut bytes = vec![0; 4 * numbers.len()];
                let read = file.read_exact_at(&mut bytes, 4 * numbers.start as u64);
                read.map_err(|error| io::Error::new(error.kind(), format!("rows of the data set that are kept in a file: {error}")))?;
                let mut values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
                if let Some(units) = &self.units {
                    units.apply(&mut values);
                }
                Ok(Cow::Owned(values))
            }
        }
    }

    /// The same rows held within `bounds`, if any, and in other units: at once in memory, on each read from a file.
    pub fn normalized(mut self, affine: Affine, bounds: Option<Bounds>) -> Self {
        let map = Map { affine, bounds };
        match &mut self.home {
            Home::Memory(values) => map.apply(values),
            Home::File(_) => self.units = Some(map),
        }
        self
    }

    /// Shows all rows of these ranges in order, some at a time.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn scan(&self, spans: impl Iterator<Item = Range<usize>>, visit: &mut dyn FnMut(&[f32])) -> io::Result<()> {
        spans.flat_map(|span| pieces(span, SCAN_ROWS)).try_for_each(|piece| {
            visit(&self.rows(piece)?);
            Ok(())
        })
    }

    /// Shows how each row differs from the one before it, within each range.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn scan_changes(&self, spans: impl Iterator<Item = Range<usize>>, visit: &mut dyn FnMut(&[f32])) -> io::Result<()> {
        let seconds = spans.map(|span| span.start + 1..span.end.max(span.start + 1));
        seconds.flat_map(|span| pieces(span, SCAN_ROWS)).try_for_each(|piece| {
            let rows = self.rows(piece.start - 1..piece.end)?;
            let changes: Vec<f32> = rows[self.width..].iter().zip(&*rows).map(|(next, now)| next - now).collect();
            visit(&changes);
            Ok(())
        })
    }
}

/// `span` in pieces of at most `len`.
pub fn pieces(span: Range<usize>, len: usize) -> impl Iterator<Item = Range<usize>> {
    span.clone().step_by(len).map(move |start| start..span.end.min(start + len))
}

/// A field under construction, row after row.
pub struct FieldWriter {
    width: usize,
    home: HomeWriter,
}

enum HomeWriter {
    Memory(Vec<f32>),
    File(BufWriter<File>),
}

impl FieldWriter {
    /// A field of `rows` rows, in memory or in a file in the room's scratch folder.
    ///
    /// # Errors
    /// If the file cannot be made.
    pub fn new(width: usize, rows: usize, room: &Room, in_file: bool) -> io::Result<Self> {
        if !in_file {
            return Ok(Self { width, home: HomeWriter::Memory(Vec::with_capacity(width * rows)) });
        }
        fs::create_dir_all(&room.scratch)?;
        Ok(Self { width, home: HomeWriter::File(BufWriter::new(tempfile::tempfile_in(&room.scratch)?)) })
    }

    /// Appends rows.
    ///
    /// # Errors
    /// If the disk is full.
    pub fn push(&mut self, values: &[f32]) -> io::Result<()> {
        match &mut self.home {
            HomeWriter::Memory(all) => all.extend_from_slice(values),
            HomeWriter::File(file) => values.iter().try_for_each(|value| file.write_all(&value.to_le_bytes()))?,
        }
        Ok(())
    }

    /// The field.
    ///
    /// # Errors
    /// If the disk is full.
    pub fn finish(self) -> io::Result<Field> {
        let home = match self.home {
            HomeWriter::Memory(values) => Home::Memory(values),
            HomeWriter::File(file) => Home::File(file.into_inner()?),
        };
        Ok(Field { width: self.width, home, units: None })
    }
}

/// The arrays of a data set, all with the same number of rows.
#[derive(Debug)]
pub struct Fields {
    /// `(N, state_dim)`.
    pub states: Field,
    /// `(N, action_dim)`.
    pub actions: Field,
    /// `(N, 1)`: reward of executing a_t in s_t.
    pub rewards: Field,
    /// `(N, context_dim)`: the hidden truth while a_t is executed; seen by the probe alone, never by training. Width 0 where there is none.
    pub context: Field,
}

impl Fields {
    /// Widths of states and actions.
    pub fn layout(&self) -> Layout {
        Layout { state_dim: self.states.width, action_dim: self.actions.width }
    }
}

/// One episode: consecutive rows. Beyond its first step lies, in a session, the episode that it follows, and a border between them: a step of
/// which nothing is known. So the steps before step 0 are -1, the border, and -2, -3, .., the last ones of that episode.
#[derive(Clone, Debug)]
pub struct Episode {
    /// Widths of states and actions.
    pub layout: Layout,
    /// Width of the context; 0 where the file has none.
    pub context_dim: usize,
    /// Whether it shows what comes of actions and is nothing to imitate.
    pub play: bool,
    /// Whether it ended by what happened, and not because time was up.
    pub ended: bool,
    fields: Arc<Fields>,
    /// How surprising each row of the fields is, where that was found out; see [`super::surprises`].
    surprises: Option<Arc<Field>>,
    rows: Range<usize>,
    before: Option<Range<usize>>,
}

impl Episode {
    /// The rows of `span`.
    pub fn new(fields: &Arc<Fields>, Span { rows, play, ended, before }: Span) -> Self {
        let (layout, context_dim) = (fields.layout(), fields.context.width);
        Self { layout, context_dim, play, ended, fields: fields.clone(), surprises: None, rows, before }
    }

    /// Other rows of the same data set.
    pub(super) fn of_rows(&self, span: Span) -> Self {
        Self::new(&self.fields, span)
    }

    /// The same episode, whose steps tell their surprises, which are rows beside those of the data set.
    pub(super) fn telling(&self, surprises: &Arc<Field>) -> Self {
        Self { surprises: Some(surprises.clone()), ..self.clone() }
    }

    /// Whether its steps tell their surprises.
    pub fn tells_surprises(&self) -> bool {
        self.surprises.is_some()
    }

    /// The row of the data set that follows its last.
    pub(super) fn end(&self) -> usize {
        self.rows.end
    }

    /// Numbers in a row of the data set.
    pub(super) fn columns(&self) -> usize {
        self.layout.dim() + 1 + self.context_dim
    }

    /// Whether rows of the data set are kept in a file.
    pub(super) fn in_file(&self) -> bool {
        matches!(self.fields.states.home, Home::File(_))
    }

    /// An episode of its own from states, actions, rewards and context.
    #[cfg(test)]
    pub fn of(layout: Layout, columns: [Vec<f32>; 4]) -> Self {
        let all = columns[2].len();
        Self::among(layout, columns, Span { rows: 0..all, play: false, ended: false, before: None })
    }

    /// An episode among others, whose rows are those of the columns.
    #[cfg(test)]
    pub fn among(layout: Layout, [states, actions, rewards, context]: [Vec<f32>; 4], span: Span) -> Self {
        let context_dim = context.len() / rewards.len();
        let fields = Fields {
            states: Field::in_memory(layout.state_dim, states),
            actions: Field::in_memory(layout.action_dim, actions),
            rewards: Field::in_memory(1, rewards),
            context: Field::in_memory(context_dim, context),
        };
        Self::new(&Arc::new(fields), span)
    }

    /// Number of steps.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there are no steps.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// How many steps lie before its first: the border and the episode that it follows.
    pub fn reach(&self) -> usize {
        self.before.as_ref().map_or(0, |before| 1 + before.len())
    }

    /// The same episode as the first of a session.
    pub fn alone(&self) -> Self {
        Self { before: None, ..self.clone() }
    }

    /// Where step t lies; none for a border, and where there is no such step.
    fn row(&self, t: isize) -> Option<usize> {
        match (usize::try_from(t), &self.before) {
            (Ok(t), _) => Some(self.rows.start + t).filter(|row| *row < self.rows.end),
            (Err(_), None) => None,
            (Err(_), Some(before)) => before.end.checked_sub(t.unsigned_abs() - 1).filter(|row| before.contains(row)),
        }
    }

    fn read<'a>(&self, field: &'a Field, t: usize) -> io::Result<Cow<'a, [f32]>> {
        assert!(t < self.len(), "a step outside of the episode: is a bug");
        field.rows(self.rows.start + t..self.rows.start + t + 1)
    }

    /// (s_t, a_t, r_t) of a step of this episode or of that before it; none for a border, and where there is no such step.
    ///
    /// # Errors
    /// If rows are kept in a file and it cannot be read.
    pub fn step(&self, t: isize) -> io::Result<Option<Step<'_>>> {
        let Some(row) = self.row(t) else { return Ok(None) };
        let Fields { states, actions, rewards, .. } = &*self.fields;
        Ok(Some(Step {
            state: states.rows(row..row + 1)?,
            action: actions.rows(row..row + 1)?,
            reward: rewards.rows(row..row + 1)?[0],
            surprise: self.surprises.as_ref().map(|surprises| surprises.rows(row..row + 1)).transpose()?,
        }))
    }

    /// s_t.
    ///
    /// # Errors
    /// If rows are kept in a file and it cannot be read.
    pub fn state(&self, t: usize) -> io::Result<Cow<'_, [f32]>> {
        self.read(&self.fields.states, t)
    }

    /// a_t.
    ///
    /// # Errors
    /// As of [`Self::state`].
    pub fn action(&self, t: usize) -> io::Result<Cow<'_, [f32]>> {
        self.read(&self.fields.actions, t)
    }

    /// r_t.
    ///
    /// # Errors
    /// As of [`Self::state`].
    pub fn reward(&self, t: usize) -> io::Result<f32> {
        Ok(self.read(&self.fields.rewards, t)?[0])
    }

    /// The context at t.
    ///
    /// # Errors
    /// As of [`Self::state`].
    pub fn context(&self, t: usize) -> io::Result<Cow<'_, [f32]>> {
        self.read(&self.fields.context, t)
    }
}

/// Columns of a step's surprises: state, action, reward.
pub(super) fn surprise_width(layout: Layout) -> usize {
    layout.dim() + 1
}

/// One step of an episode.
pub struct Step<'a> {
    /// s_t.
    pub state: Cow<'a, [f32]>,
    /// a_t.
    pub action: Cow<'a, [f32]>,
    /// r_t.
    pub reward: f32,
    /// How surprising state, action and reward are, side by side, where that was found out.
    pub surprise: Option<Cow<'a, [f32]>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The same rows in memory and in a file: pieces, changes and normalized numbers have the same bits, and the file has no name.
    #[test]
    fn a_file_is_read_as_memory_is() {
        let scratch = tempfile::tempdir().unwrap();
        let room = Room { memory_bytes: 0, scratch: scratch.path().join("deeper") };
        let values: Vec<f32> = (0..3 * 50_000).map(|i| (i as f32 * 0.37).sin() * 1e3).collect();
        let affine = Affine { mean: vec![0.1, -3.0, 7.0], std: vec![0.3, 11.0, 1e-3] };
        let field = |in_file: bool| {
            let mut writer = FieldWriter::new(3, 50_000, &room, in_file).unwrap();
            values.chunks(3 * 999).for_each(|rows| writer.push(rows).unwrap());
            writer.finish().unwrap()
        };
        let bits = |field: &Field| {
            let mut seen: Vec<u32> = field.rows(7..9).unwrap().iter().map(|value| value.to_bits()).collect();
            let mut visit = |rows: &[f32]| seen.extend(rows.iter().map(|value| value.to_bits()));
            let spans = [0..1, 3..40_000, 40_000..50_000];
            field.scan(spans.iter().cloned(), &mut visit).unwrap();
            field.scan_changes(spans.iter().cloned(), &mut visit).unwrap();
            seen
        };
        let (memory, file) = (field(false), field(true));
        assert_eq!(bits(&memory).len(), 3 * (2 + 49_998 + 49_998 - 3));
        assert!(bits(&memory) == bits(&file));
        let bounds = Some((vec![1.0; affine.dim()], vec![9.0; affine.dim()]));
        let (memory, file) = (memory.normalized(affine.clone(), bounds.clone()), file.normalized(affine, bounds));
        assert!(bits(&memory) == bits(&file));
        assert_eq!(fs::read_dir(&room.scratch).unwrap().count(), 0);
    }
}
