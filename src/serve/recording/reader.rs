//! A recording, read entry by entry.

use super::format::{Entry, HEAD_LEN, Header, MAGIC, VERSION, VERSION_MIN, read_body, read_head};
use std::{
    fs::File,
    io::{self, BufReader, Read},
    path::Path,
};

/// Why a file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum Unreadable {
    /// Not at all.
    #[error("{0}")]
    Io(io::Error),
    /// It begins with something else.
    #[error("is no recording of ada-server")]
    Foreign,
    /// A server of another time wrote it.
    #[error("is of format {0}, and this server reads {VERSION_MIN} to {VERSION}: replay it with the server's version that wrote it")]
    Version(u8),
    /// Its first entry is damaged, or missing.
    #[error("is damaged: it does not say how it was made")]
    Headless,
}

/// What is read.
#[derive(Debug)]
pub enum Piece {
    /// An entry, whole.
    Entry(Entry),
    /// An entry that is not what was written; the next one may be good.
    Damaged,
    /// The end, within an entry: its process was killed.
    Cut,
    /// Nothing more can be read: the length of an entry is damaged, or so is the medium.
    Broken,
}

/// A recording that is being read. As an iterator it gives its entries, the header aside.
pub struct Recording {
    file: BufReader<File>,
    version: u8,
    header: Header,
    /// Bytes read.
    at: u64,
    len: u64,
    ended: bool,
}

impl Recording {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// [`Unreadable`].
    pub fn open(path: &Path) -> Result<Self, Unreadable> {
        let file = File::open(path).map_err(Unreadable::Io)?;
        let len = file.metadata().map_err(Unreadable::Io)?.len();
        let mut file = BufReader::with_capacity(1 << 20, file);
        let mut begin = [0; MAGIC.len() + 1];
        file.read_exact(&mut begin).map_err(|error| if is_end(&error) { Unreadable::Foreign } else { Unreadable::Io(error) })?;
        let [magic @ .., version] = begin;
        if &magic != MAGIC {
            return Err(Unreadable::Foreign);
        }
        if !(VERSION_MIN..=VERSION).contains(&version) {
            return Err(Unreadable::Version(version));
        }
        match piece(&mut file, version).map_err(Unreadable::Io)? {
            Some((Piece::Entry(Entry::Header(header)), read)) => {
                Ok(Self { file, version, header, at: begin.len() as u64 + read, len, ended: false })
            }
            _ => Err(Unreadable::Headless),
        }
    }

    /// How it was made.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Bytes read so far, and all there are.
    pub fn progress(&self) -> (u64, u64) {
        (self.at, self.len)
    }
}

impl Iterator for Recording {
    type Item = Piece;

    fn next(&mut self) -> Option<Piece> {
        if self.ended {
            return None;
        }
        let (piece, read) = piece(&mut self.file, self.version).unwrap_or(Some((Piece::Broken, 0)))?;
        self.at += read;
        self.ended = matches!(piece, Piece::Cut | Piece::Broken);
        Some(piece)
    }
}

/// The next piece, and its bytes; None at the end.
fn piece(file: &mut impl Read, version: u8) -> io::Result<Option<(Piece, u64)>> {
    let mut head = Vec::with_capacity(HEAD_LEN);
    file.take(HEAD_LEN as u64).read_to_end(&mut head)?;
    let Some(head) = head.first_chunk::<HEAD_LEN>() else {
        return Ok((!head.is_empty()).then_some((Piece::Cut, head.len() as u64)));
    };
    let Some((len, sum)) = read_head(*head) else { return Ok(Some((Piece::Broken, HEAD_LEN as u64))) };
    let mut body = Vec::new();
    file.take(len as u64).read_to_end(&mut body)?;
    let piece = if body.len() < len { Piece::Cut } else { read_body(version, &body, sum).map_or(Piece::Damaged, Piece::Entry) };
    Ok(Some((piece, (HEAD_LEN + body.len()) as u64)))
}

fn is_end(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::UnexpectedEof
}
