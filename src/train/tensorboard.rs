//! TensorBoard event files: protocol buffers of a few fields, written by hand, in TFRecord frames with masked CRC-32C.
//!
//! Formats: tensorflow `core/util/event.proto`, `core/framework/summary.proto`, `core/lib/io/record_writer.cc`.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::Path,
};

/// What the name of an event file begins with.
const NAME: &str = "events.out.tfevents.";

/// CRC-32C (Castagnoli), reflected polynomial.
const POLYNOMIAL: u32 = 0x82F6_3B78;
const TABLE: [u32; 256] = table();

const fn table() -> [u32; 256] {
    let mut table = [0; 256];
    let mut index = 0;
    while index < 256 {
        let (mut crc, mut bit) = (index as u32, 0);
        while bit < 8 {
            crc = if crc & 1 == 1 { (crc >> 1) ^ POLYNOMIAL } else { crc >> 1 };
            bit += 1;
        }
        table[index] = crc;
        index += 1;
    }
    table
}

fn crc32c(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc: u32, byte| (crc >> 8) ^ TABLE[((crc ^ u32::from(*byte)) & 0xFF) as usize])
}

/// TFRecord stores checksums rotated and offset, so that a file of checksums still checks well.
fn masked(bytes: &[u8]) -> [u8; 4] {
    crc32c(bytes).rotate_right(15).wrapping_add(0xA282_EAD8).to_le_bytes()
}

/// Length, its checksum, the record, its checksum.
fn frame(record: &[u8]) -> Vec<u8> {
    let length = (record.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), record, &masked(record)].concat()
}

/// A protocol buffer message under construction.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn integer(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    fn double(mut self, field: u64, value: f64) -> Self {
        self.varint(field << 3 | 1);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.varint(field << 3 | 5);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.0.extend(value);
        self
    }
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
        writer.write(&Message::default().double(1, seconds).bytes(3, b"brain.Event:2"))?;
        let start = Message::default().integer(1, 1);
        writer.write(&Message::default().double(1, seconds).integer(2, done + 1).bytes(7, &start.0))?;
        Ok(writer)
    }

    /// Scalars of one step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn scalars<'a>(&mut self, step: u64, seconds: f64, values: impl Iterator<Item = (&'a str, f64)>) -> io::Result<()> {
        let summary = values.fold(Message::default(), |summary, (tag, value)| {
            let value = Message::default().bytes(1, tag.as_bytes()).float(2, value as f32);
            summary.bytes(1, &value.0)
        });
        self.write(&Message::default().double(1, seconds).integer(2, step).bytes(5, &summary.0))
    }

    fn write(&mut self, event: &Message) -> io::Result<()> {
        self.file.write_all(&frame(&event.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check value of CRC-32C (RFC 3720, B.4, and the catalogue of parametrised CRC algorithms).
    #[test]
    fn crc32c_known_answers() {
        assert_eq!(crc32c(b"123456789"), 0xE306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8A91_36AA);
        assert_eq!(crc32c(&[0xFF; 32]), 0x62A8_AB43);
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
