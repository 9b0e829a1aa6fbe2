//! Numbers as PLY and PCD store them.

use glam::DVec3;

use super::error::Fault;
use super::read::Unit;

/// The type of a stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
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
    /// Bytes of one number.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }

    /// Whether it can hold fractions.
    pub fn is_float(self) -> bool {
        matches!(self, Scalar::F32 | Scalar::F64)
    }

    /// The number in the first `size()` bytes of `bytes`; exact save for 64-bit integers beyond 2^53.
    ///
    /// # Panics
    /// Where `bytes` is shorter.
    #[inline]
    pub fn get(self, bytes: &[u8], big_endian: bool) -> f64 {
        macro_rules! number {
            ($type:ty) => {{
                let mut raw = [0; size_of::<$type>()];
                raw.copy_from_slice(&bytes[..size_of::<$type>()]);
                if big_endian {
                    <$type>::from_be_bytes(raw) as f64
                } else {
                    <$type>::from_le_bytes(raw) as f64
                }
            }};
        }
        match self {
            Scalar::I8 => number!(i8),
            Scalar::U8 => number!(u8),
            Scalar::I16 => number!(i16),
            Scalar::U16 => number!(u16),
            Scalar::I32 => number!(i32),
            Scalar::U32 => number!(u32),
            Scalar::I64 => number!(i64),
            Scalar::U64 => number!(u64),
            Scalar::F32 => number!(f32),
            Scalar::F64 => number!(f64),
        }
    }
}

/// Names of the coordinates, for errors.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];

/// Largest coordinate accepted, mm: its cube is still finite, and no part is a million kilometres large.
pub(crate) const COORDINATE_LIMIT_MM: f64 = 1e12;

/// The position in mm of three raw coordinates.
///
/// # Errors
/// Where one of them is not finite or beyond [`COORDINATE_LIMIT_MM`].
#[inline]
pub(crate) fn position(raw: [f64; 3], unit: Unit) -> Result<DVec3, Fault> {
    let p = DVec3::new(unit.to_mm(raw[0]), unit.to_mm(raw[1]), unit.to_mm(raw[2]));
    if p.abs().max_element() < COORDINATE_LIMIT_MM && !p.is_nan() {
        return Ok(p);
    }
    Err(position_fault(raw, unit))
}

#[cold]
fn position_fault(raw: [f64; 3], unit: Unit) -> Fault {
    for (field, value) in AXES.into_iter().zip(raw) {
        if !value.is_finite() {
            return Fault::NotFinite {
                field,
                seen: value.to_string(),
            };
        }
    }
    let (field, seen_mm) = AXES
        .into_iter()
        .zip(raw.map(|v| unit.to_mm(v)))
        .find(|(_, v)| v.abs() >= COORDINATE_LIMIT_MM)
        .unwrap_or((AXES[0], f64::NAN));
    Fault::OutOfRange { field, seen_mm }
}
