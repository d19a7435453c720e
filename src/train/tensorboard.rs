//! TensorBoard event files: protocol buffers of a few fields in TFRecord frames with masked CRC-32C.
//!
//! Formats: tensorflow `core/util/event.proto`, `core/framework/summary.proto`, `core/lib/io/record_writer.cc`.

use prost::Message;
use std::{
    fs::{self, File},
    io::{self, Write},
    path::Path,
};

/// What the name of an event file begins with.
const NAME: &str = "events.out.tfevents.";

/// iSCSI's checksum is CRC-32C.
const CRC32C: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);

/// `tensorflow.Event`, as far as it is written. Its `oneof` looks on the wire like optional fields of which one is there.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, required, tag = "1")]
    wall_time: f64,
    #[prost(uint64, optional, tag = "2")]
    step: Option<u64>,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Scalar>,
}

/// `tensorflow.Summary.Value` with a `simple_value`.
#[derive(Clone, PartialEq, Message)]
struct Scalar {
    #[prost(string, required, tag = "1")]
    tag: String,
    #[prost(float, required, tag = "2")]
    simple_value: f32,
}

/// `tensorflow.SessionLog`; status 1: START.
#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, required, tag = "1")]
    status: i32,
}

/// TFRecord stores checksums rotated and offset, so that a file of checksums still checks well.
fn masked(bytes: &[u8]) -> [u8; 4] {
    CRC32C.checksum(bytes).rotate_right(15).wrapping_add(0xA282_EAD8).to_le_bytes()
}

/// Length, its checksum, the record, its checksum.
fn frame(record: &[u8]) -> Vec<u8> {
    let length = (record.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), record, &masked(record)].concat()
}

/// Microseconds in the name of an event file.
fn time_of(name: &str) -> Option<u64> {
    let (seconds, micros) = name.strip_prefix(NAME)?.strip_suffix(".ada")?.split_once('.')?;
    Some(seconds.parse::<u64>().ok()? * 1_000_000 + micros.parse::<u64>().ok()?)
}

/// An event file being written.
pub struct EventWriter {
    file: File,
}

impl EventWriter {
    /// A new file `events.out.tfevents.TIME` in `dir` that goes on after step `done`: readers drop what older files say of later steps, of
    /// every curve, so steps must never fall within a directory. `seconds` is the wall clock since 1970.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(dir: &Path, done: u64, seconds: f64) -> io::Result<Self> {
        // Readers take files in the order of their names, which must be that of their making even where a clock was set back.
        let newest = fs::read_dir(dir)?.filter_map(|entry| time_of(&entry.ok()?.file_name().to_string_lossy())).max();
        let micros = newest.map_or(0, |newest| newest + 1).max((seconds * 1e6) as u64);
        let mut writer = Self { file: File::create(dir.join(format!("{NAME}{:010}.{:06}.ada", micros / 1_000_000, micros % 1_000_000)))? };
        let event = Event { wall_time: seconds, ..Event::default() };
        writer.write(&Event { file_version: Some("brain.Event:2".to_owned()), ..event.clone() })?;
        writer.write(&Event { step: Some(done + 1), session_log: Some(SessionLog { status: 1 }), ..event })?;
        Ok(writer)
    }

    /// Scalars of one step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn scalars<'a>(&mut self, step: u64, seconds: f64, values: impl Iterator<Item = (&'a str, f64)>) -> io::Result<()> {
        let value = values.map(|(tag, value)| Scalar { tag: tag.to_owned(), simple_value: value as f32 }).collect();
        self.write(&Event { wall_time: seconds, step: Some(step), summary: Some(Summary { value }), ..Event::default() })
    }

    fn write(&mut self, event: &Event) -> io::Result<()> {
        self.file.write_all(&frame(&event.encode_to_vec()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CRC-32C of 32 zeros is 0x8A91_36AA (RFC 3720, B.4).
    #[test]
    fn checksums_are_masked() {
        assert_eq!(masked(&[0; 32]), 0x8A91_36AA_u32.rotate_right(15).wrapping_add(0xA282_EAD8).to_le_bytes());
    }

    /// The first frame of every TensorBoard file of version 2, as `tf.summary` writes it (wall time 0).
    #[test]
    fn frames_have_length_and_checksums() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(dir.path(), 7, 0.0).unwrap();
        writer.scalars(300, 1.5, [("loss", 0.25)].into_iter()).unwrap();
        let path = std::fs::read_dir(dir.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(path).unwrap();
        let mut records = Vec::new();
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            assert_eq!(rest[8..12], masked(&rest[..8]));
            let record = &rest[12..12 + length];
            assert_eq!(rest[12 + length..16 + length], masked(record));
            records.push(record.to_vec());
            rest = &rest[16 + length..];
        }
        assert_eq!(records[0], [&[0x09, 0, 0, 0, 0, 0, 0, 0, 0, 0x1A, 13][..], b"brain.Event:2"].concat());
        assert_eq!(records[1][9..], [0x10, 8, 0x3A, 2, 0x08, 1]);
        let value = [&[0x0A, 11, 0x0A, 4][..], b"loss", &[0x15], &0.25_f32.to_le_bytes()].concat();
        assert_eq!(records[2][9..], [&[0x10, 0xAC, 0x02, 0x2A, 13][..], &value].concat());
    }
}
