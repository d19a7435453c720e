//! One number of an array as h5py would read it: floats of 16, 32 and 64 bits, integers of any size and sign, enums as their integers.

use half::f16;
use hdf5_reader::{
    Datatype, H5Type,
    dataset::Dataset,
    dtype_element_size,
    error::{ByteOrder, Error, Result},
};

/// A number in both readings that are needed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Element {
    /// As a 32-bit number, rounded to the nearest.
    pub value: f32,
    /// As a flag: true unless it is 0.
    pub flag: bool,
}

impl H5Type for Element {
    fn hdf5_type() -> Datatype {
        f32::hdf5_type()
    }

    fn from_bytes(bytes: &[u8], dtype: &Datatype) -> Result<Self> {
        elements(bytes, dtype)?.pop().ok_or_else(|| Error::InvalidData("no element".into()))
    }

    fn element_size(dtype: &Datatype) -> usize {
        dtype_element_size(dtype).unwrap_or(0)
    }

    fn decode_vec(raw: &[u8], dtype: &Datatype, _count: usize) -> Option<Result<Vec<Self>>> {
        Some(elements(raw, dtype))
    }
}

fn elements(raw: &[u8], dtype: &Datatype) -> Result<Vec<Element>> {
    let float = |value: f32| Element { value, flag: value != 0.0 };
    match dtype {
        Datatype::FloatingPoint { size: 2, byte_order } => Ok(map(raw, *byte_order, |bytes| float(f16::from_le_bytes(bytes).to_f32()))),
        Datatype::FloatingPoint { size: 4, byte_order } => Ok(map(raw, *byte_order, |bytes| float(f32::from_le_bytes(bytes)))),
        Datatype::FloatingPoint { size: 8, byte_order } => Ok(map(raw, *byte_order, |bytes| {
            let value = f64::from_le_bytes(bytes);
            Element { value: value as f32, flag: value != 0.0 }
        })),
        Datatype::FixedPoint { size: size @ 1..=8, signed, byte_order } => {
            let integer = |chunk: &[u8]| integer(chunk, *byte_order, *signed);
            Ok(raw.chunks_exact(usize::from(*size)).map(integer).collect())
        }
        Datatype::Enum { base, .. } => elements(raw, base),
        other => Err(Error::TypeMismatch { expected: "numbers".into(), actual: describe(other) }),
    }
}

fn map<const N: usize>(raw: &[u8], order: ByteOrder, from_le: impl Fn([u8; N]) -> Element) -> Vec<Element> {
    let element = |chunk: &[u8; N]| {
        let mut bytes = *chunk;
        if order == ByteOrder::BigEndian {
            bytes.reverse();
        }
        from_le(bytes)
    };
    raw.as_chunks::<N>().0.iter().map(element).collect()
}

fn integer(chunk: &[u8], order: ByteOrder, signed: bool) -> Element {
    let mut bytes = [0; 8];
    bytes[..chunk.len()].copy_from_slice(chunk);
    if order == ByteOrder::BigEndian {
        bytes[..chunk.len()].reverse();
    }
    let (bits, unused) = (u64::from_le_bytes(bytes), 64 - 8 * chunk.len() as u32);
    let value = if signed { ((bits << unused) as i64 >> unused) as f32 } else { bits as f32 };
    Element { value, flag: bits != 0 }
}

/// Whether the numbers of an array are understood; else what they are.
///
/// # Errors
/// If the type cannot be read from the file.
pub fn unreadable(dataset: &Dataset) -> Result<Option<String>> {
    let base = match dataset.dtype() {
        Datatype::Enum { base, .. } => base,
        other => other,
    };
    let known = match base {
        Datatype::FloatingPoint { size, .. } => [2, 4, 8].contains(size),
        Datatype::FixedPoint { size, .. } => (1..=8).contains(size),
        _ => false,
    };
    let raw = dataset.raw_datatype()?;
    let raw = if matches!(dataset.dtype(), Datatype::Enum { .. }) { raw.get(8..).unwrap_or_default() } else { &raw[..] };
    if known && is_plain(raw) {
        return Ok(None);
    }
    let unusual = if known { " in an unusual format of bits" } else { "" };
    Ok(Some(describe(dataset.dtype()) + unusual))
}

/// Whether a stored type is the usual one of its size: IEEE 754, or an integer that fills its bytes. The reader keeps only size, sign and
/// order, so a bfloat16 would pass for a float16.
fn is_plain(raw: &[u8]) -> bool {
    let (Some(class), Some(size)) = (raw.first().map(|byte| byte & 0x0f), raw.get(4).map(|size| u16::from(*size))) else { return false };
    let whole = raw.get(8..12) == Some(&[0_u16.to_le_bytes(), (8 * size).to_le_bytes()].concat()[..]);
    let (exponent, mantissa) = match (class, size) {
        (0, _) => return whole,
        (1, 2) => (5, 10),
        (1, 4) => (8, 23),
        (1, 8) => (11, 52),
        _ => return false,
    };
    // Flags: not VAX order, mantissa without its leading 1; the sign is the last bit.
    let flags = raw[1] & 0b0111_0000 == 0b0010_0000 && u16::from(raw[2]) == 8 * size - 1;
    let bias = (1_u32 << (exponent - 1)) - 1;
    whole && flags && raw.get(12..16) == Some(&[mantissa, exponent, 0, mantissa]) && raw.get(16..20) == Some(&bias.to_le_bytes())
}

/// What a type is, in words.
fn describe(dtype: &Datatype) -> String {
    match dtype {
        Datatype::FloatingPoint { size, .. } => format!("{}-bit floats", 8 * u32::from(*size)),
        Datatype::FixedPoint { size, .. } => format!("{}-bit integers", 8 * u32::from(*size)),
        Datatype::Enum { base, .. } => format!("an enum of {}", describe(base)),
        Datatype::String { .. } => "strings".into(),
        Datatype::VarLen { base, .. } => format!("lists of their own length each, of {}", describe(base)),
        Datatype::Array { base, dims } => format!("arrays of {dims:?} {} within one array", describe(base)),
        Datatype::Compound { fields, .. } if fields.iter().map(|field| field.name.as_str()).eq(["r", "i"]) => "complex numbers".into(),
        Datatype::Compound { fields, .. } => {
            format!("records of {}", fields.iter().map(|field| field.name.as_str()).collect::<Vec<_>>().join(", "))
        }
        Datatype::Opaque { .. } => "opaque bytes".into(),
        Datatype::Reference { .. } => "references".into(),
        Datatype::Bitfield { .. } => "bit fields".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ByteOrder::{BigEndian, LittleEndian};

    #[test]
    fn integers_keep_sign_and_order() {
        let values = |raw: &[u8], size: u8, signed: bool, byte_order: ByteOrder| -> Vec<f32> {
            elements(raw, &Datatype::FixedPoint { size, signed, byte_order }).unwrap().iter().map(|element| element.value).collect()
        };
        assert_eq!(values(&[0x7f, 0x80, 0xff], 1, true, LittleEndian), [127.0, -128.0, -1.0]);
        assert_eq!(values(&[0x80, 0xff], 1, false, LittleEndian), [128.0, 255.0]);
        assert_eq!(values(&[0xff, 0xfe, 0x00, 0x03], 2, true, BigEndian), [-2.0, 3.0]);
        assert_eq!(values(&[0xff, 0xff, 0xff, 0x01, 0x00, 0x80], 3, true, LittleEndian), [-1.0, -8_388_607.0]);
        assert_eq!(values(&(-5_i64).to_be_bytes(), 8, true, BigEndian), [-5.0]);
        assert_eq!(values(&u64::MAX.to_le_bytes(), 8, false, LittleEndian), [u64::MAX as f32]);
    }

    /// A flag of 1e-300 is true, though it is 0 as a 32-bit number; minus zero is false, though not all of its bits are 0.
    #[test]
    fn flags_are_what_is_not_zero() {
        let flags = |values: &[f64]| -> Vec<bool> {
            let raw: Vec<u8> = values.iter().flat_map(|value| value.to_be_bytes()).collect();
            let dtype = Datatype::FloatingPoint { size: 8, byte_order: BigEndian };
            elements(&raw, &dtype).unwrap().iter().map(|element| element.flag).collect()
        };
        assert_eq!(flags(&[0.0, -0.0, 1e-300, 1.0]), [false, false, true, true]);
    }
}
