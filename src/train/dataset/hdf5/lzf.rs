//! LZF, the compression that h5py calls "lzf": literal runs, and copies from up to 8 KiB back.

use hdf5_reader::{
    error::{Error, Result},
    messages::filter_pipeline::FilterDescription,
};

/// Number under which the HDF Group lists the filter.
pub const FILTER_LZF: u16 = 32000;
/// Bytes of a chunk where the file does not say.
const CHUNK_BYTES: usize = 256 << 20;

/// One chunk as it was before compression; h5py notes its size as the filter's third parameter.
pub fn decode(filter: &FilterDescription, data: &[u8], _element_size: usize) -> Result<Vec<u8>> {
    let len_max = filter.client_data.get(2).map_or(CHUNK_BYTES, |len| *len as usize);
    decompress(data, len_max).ok_or_else(|| Error::DecompressionError("lzf: the chunk is damaged".into()))
}

fn decompress(data: &[u8], len_max: usize) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(len_max.min(CHUNK_BYTES));
    let mut bytes = data.iter().copied();
    while let Some(control) = bytes.next() {
        let control = usize::from(control);
        if control < 32 {
            let before = out.len();
            out.extend(bytes.by_ref().take(control + 1));
            if out.len() != before + control + 1 {
                return None;
            }
        } else {
            let mut len = control >> 5;
            if len == 7 {
                len += usize::from(bytes.next()?);
            }
            let back = ((control & 31) << 8 | usize::from(bytes.next()?)) + 1;
            let from = out.len().checked_sub(back)?;
            // A copy may reach into what it has just written.
            (from..from + len + 2).for_each(|at| out.push(out[at]));
        }
        if out.len() > len_max {
            return None;
        }
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_copies() {
        let literal = [2, b'a', b'b', b'c'];
        assert_eq!(decompress(&literal, 9).unwrap(), b"abc");
        let overlapping = [0, b'a', 0b010_00000, 0, 0, b'b'];
        assert_eq!(decompress(&overlapping, 9).unwrap(), b"aaaaab");
        let long = [1, b'x', b'y', 0b111_00000, 3, 1];
        assert_eq!(decompress(&long, 99).unwrap(), b"xyxyxyxyxyxyxy");
    }

    #[test]
    fn damage_is_an_error() {
        for damaged in [&[5, b'a'][..], &[0b001_00000, 0], &[0, b'a', 0b001_00000, 9], &[0b111_00000], &[0, b'a', 0b111_00000, 255, 0]] {
            assert_eq!(decompress(damaged, 100), None, "{damaged:?}");
        }
    }
}
