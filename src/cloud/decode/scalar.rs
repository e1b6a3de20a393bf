//! The scalar types of binary records, common to PLY and PCD.

use pcd_rs::metas::ValueKind;
use ply_rs_bw::ply::ScalarType;

/// A number as it is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Scalar {
    /// Bytes it takes.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// The value at `offset` of `record`; bytes past its end count as zero.
    pub fn read(self, record: &[u8], offset: usize, big_endian: bool) -> f64 {
        let bytes = record.get(offset..).unwrap_or_default();
        match self {
            Self::I8 => f64::from(i8::from_le_bytes(array(bytes, false))),
            Self::U8 => f64::from(u8::from_le_bytes(array(bytes, false))),
            Self::I16 => f64::from(i16::from_le_bytes(array(bytes, big_endian))),
            Self::U16 => f64::from(u16::from_le_bytes(array(bytes, big_endian))),
            Self::I32 => f64::from(i32::from_le_bytes(array(bytes, big_endian))),
            Self::U32 => f64::from(u32::from_le_bytes(array(bytes, big_endian))),
            Self::I64 => i64::from_le_bytes(array(bytes, big_endian)) as f64,
            Self::U64 => u64::from_le_bytes(array(bytes, big_endian)) as f64,
            Self::F32 => f64::from(f32::from_le_bytes(array(bytes, big_endian))),
            Self::F64 => f64::from_le_bytes(array(bytes, big_endian)),
        }
    }
}

/// The first `N` bytes in little-endian order.
pub(super) fn array<const N: usize>(bytes: &[u8], big_endian: bool) -> [u8; N] {
    let mut out = [0; N];
    for (to, from) in out.iter_mut().zip(bytes) {
        *to = *from;
    }
    if big_endian {
        out.reverse();
    }
    out
}

impl From<&ScalarType> for Scalar {
    fn from(kind: &ScalarType) -> Self {
        match kind {
            ScalarType::Char => Self::I8,
            ScalarType::UChar => Self::U8,
            ScalarType::Short => Self::I16,
            ScalarType::UShort => Self::U16,
            ScalarType::Int => Self::I32,
            ScalarType::UInt => Self::U32,
            ScalarType::Float => Self::F32,
            ScalarType::Double => Self::F64,
        }
    }
}

impl From<ValueKind> for Scalar {
    fn from(kind: ValueKind) -> Self {
        match kind {
            ValueKind::I8 => Self::I8,
            ValueKind::U8 => Self::U8,
            ValueKind::I16 => Self::I16,
            ValueKind::U16 => Self::U16,
            ValueKind::I32 => Self::I32,
            ValueKind::U32 => Self::U32,
            ValueKind::I64 => Self::I64,
            ValueKind::U64 => Self::U64,
            ValueKind::F32 => Self::F32,
            ValueKind::F64 => Self::F64,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_byte_orders_read_the_same_number() {
        assert_eq!(Scalar::F32.read(&1.5f32.to_be_bytes(), 0, true), 1.5);
        assert_eq!(Scalar::F64.read(&(-2.25f64).to_le_bytes(), 0, false), -2.25);
        assert_eq!(Scalar::I16.read(&[9, 0xff, 0xfe], 1, true), -2.0);
        assert_eq!(Scalar::U8.read(&[], 7, false), 0.0);
    }
}
