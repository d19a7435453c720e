//! D4RL's HDF5 layout: flat arrays at the root, episodes one after the other (no libhdf5 needed).

use super::{Dataset, DatasetError, Episode};
use crate::model::trajectory::Layout;
use hdf5_reader::{Datatype, Hdf5File, error::ByteOrder};
use sha2::{Digest, Sha256};
use std::{fmt::Write, path::Path};

/// Arrays that a trainable file must have; `timeouts` and `infos/context` are optional.
const REQUIRED: [&str; 4] = ["observations", "actions", "rewards", "terminals"];

/// Rows of numbers, `width` columns each.
struct Matrix {
    width: usize,
    values: Vec<f32>,
}

impl Matrix {
    fn rows(&self) -> usize {
        self.values.len() / self.width.max(1)
    }
}

/// Reads and checks the file: `observations (N, d_s)`, `actions (N, d_a)`, `rewards (N,)`, `terminals (N,)`, and where there are any
/// `timeouts (N,)` and `infos/context (N, d_c)`, the hidden truth that only the probe looks at.
///
/// # Errors
/// If the file cannot be read, an array is missing, of another shape or type, or holds a value that is not finite.
pub fn read(path: &Path) -> Result<Dataset, DatasetError> {
    let name = path.display().to_string();
    let bytes = std::fs::read(path).map_err(|error| DatasetError::Unreadable { path: name.clone(), reason: error.to_string() })?;
    let digest = hex(&Sha256::digest(&bytes));
    let file = Hdf5File::from_vec(bytes).map_err(|error| DatasetError::Unreadable { path: name.clone(), reason: error.to_string() })?;
    let arrays = Arrays { file, path: name };
    for field in REQUIRED {
        arrays.require(field)?;
    }
    let [observations, actions, rewards] = [arrays.matrix("observations")?, arrays.matrix("actions")?, arrays.matrix("rewards")?];
    let context = if arrays.has("infos/context") { Some(arrays.matrix("infos/context")?) } else { None };
    let rows = observations.rows();
    let optional = context.iter().map(|matrix| ("infos/context", matrix));
    for (field, matrix) in [("actions", &actions), ("rewards", &rewards)].into_iter().chain(optional) {
        arrays.expect_rows(field, matrix.rows(), rows)?;
    }
    if rewards.width != 1 {
        return Err(arrays.invalid("rewards", format!("{} columns, expected 1", rewards.width)));
    }
    let mut ends = arrays.flags("terminals", rows)?;
    if arrays.has("timeouts") {
        let timeouts = arrays.flags("timeouts", rows)?;
        ends.iter_mut().zip(timeouts).for_each(|(end, timeout)| *end |= timeout);
    }
    let layout = Layout { state_dim: observations.width, action_dim: actions.width };
    let context_dim = context.as_ref().map_or(0, |matrix| matrix.width);
    let cut = |matrix: &Matrix, from: usize, to: usize| matrix.values[from * matrix.width..to * matrix.width].to_vec();
    let episode = |(from, to): (usize, usize)| Episode {
        layout,
        context_dim,
        states: cut(&observations, from, to),
        actions: cut(&actions, from, to),
        rewards: cut(&rewards, from, to),
        context: context.as_ref().map_or_else(Vec::new, |matrix| cut(matrix, from, to)),
    };
    let episodes = spans(&ends).into_iter().map(episode).collect();
    Ok(Dataset { path: arrays.path, digest, layout, context_dim, episodes })
}

/// Half-open ranges of the episodes; rows after the last end flag are an episode of their own.
fn spans(ends: &[bool]) -> Vec<(usize, usize)> {
    let mut from = 0;
    let mut spans = Vec::new();
    for (row, end) in ends.iter().enumerate() {
        if *end || row + 1 == ends.len() {
            spans.push((from, row + 1));
            from = row + 1;
        }
    }
    spans
}

struct Arrays {
    file: Hdf5File,
    path: String,
}

impl Arrays {
    fn invalid(&self, field: &str, reason: impl Into<String>) -> DatasetError {
        DatasetError::Invalid { path: self.path.clone(), field: field.into(), reason: reason.into() }
    }

    fn has(&self, field: &str) -> bool {
        self.file.dataset(field).is_ok()
    }

    fn require(&self, field: &str) -> Result<(), DatasetError> {
        self.file.dataset(field).map(|_| ()).map_err(|error| self.invalid(field, error.to_string()))
    }

    fn expect_rows(&self, field: &str, rows: usize, expected: usize) -> Result<(), DatasetError> {
        if rows == expected && rows > 0 {
            return Ok(());
        }
        Err(self.invalid(field, format!("{rows} rows, but `observations` has {expected}")))
    }

    /// A float array of one or two dimensions; every value finite.
    fn matrix(&self, field: &str) -> Result<Matrix, DatasetError> {
        let array = self.file.dataset(field).map_err(|error| self.invalid(field, error.to_string()))?;
        let width = match array.shape() {
            [_] => 1,
            [_, width] if *width > 0 => *width as usize,
            shape => return Err(self.invalid(field, format!("shape {shape:?}, expected (N,) or (N, columns)"))),
        };
        let bytes = array.read_raw_bytes().map_err(|error| self.invalid(field, error.to_string()))?;
        let values: Vec<f32> = match array.dtype() {
            Datatype::FloatingPoint { size: 4, byte_order } => decode(&bytes, *byte_order, f32::from_le_bytes),
            Datatype::FloatingPoint { size: 8, byte_order } => decode(&bytes, *byte_order, |bytes| f64::from_le_bytes(bytes) as f32),
            other => return Err(self.invalid(field, format!("type {other:?}, expected 32- or 64-bit floats"))),
        };
        if let Some(at) = values.iter().position(|value| !value.is_finite()) {
            return Err(self.invalid(field, format!("{} at row {}, column {}", values[at], at / width, at % width)));
        }
        Ok(Matrix { width, values })
    }

    /// A boolean array: h5py writes an enum of one byte, other tools integers; anything but zero is true.
    fn flags(&self, field: &str, rows: usize) -> Result<Vec<bool>, DatasetError> {
        let array = self.file.dataset(field).map_err(|error| self.invalid(field, error.to_string()))?;
        if let Datatype::FloatingPoint { .. } = array.dtype() {
            let matrix = self.matrix(field)?;
            self.expect_rows(field, matrix.values.len(), rows)?;
            return Ok(matrix.values.into_iter().map(|value| value != 0.0).collect());
        }
        let bytes = array.read_raw_bytes().map_err(|error| self.invalid(field, error.to_string()))?;
        let size = array.raw_element_size().map_err(|error| self.invalid(field, error.to_string()))?.max(1);
        self.expect_rows(field, bytes.len() / size, rows)?;
        Ok(bytes.chunks(size).map(|element| element.iter().any(|byte| *byte != 0)).collect())
    }
}

fn decode<const N: usize>(bytes: &[u8], order: ByteOrder, from_le: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let element = |chunk: &[u8; N]| {
        let mut bytes = *chunk;
        if order == ByteOrder::BigEndian {
            bytes.reverse();
        }
        from_le(bytes)
    };
    bytes.as_chunks::<N>().0.iter().map(element).collect()
}

/// Lower-case hexadecimal.
pub(in crate::train) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("writing to a string cannot fail: is a bug");
        text
    })
}
