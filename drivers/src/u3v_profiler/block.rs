//! The stream of USB3 Vision: leader, payload and trailer of a block, its chunks, and points from its pixels.
//!
//! Source: USB3 Vision 1.0 as read by `aravis` and `cameleon`; PFNC for pixel formats; SFNC for coordinates. Little-endian. The size field of a leader
//! is not believed: implementations write 50 for 52 bytes.

use crate::error::DecodeError;

/// "U3VL".
const LEADER: u32 = 0x4C56_3355;
/// "U3VT".
const TRAILER: u32 = 0x5456_3355;
/// Most bytes of a block's payload: more is no block of a profiler.
pub const PAYLOAD_MAX: usize = 64 << 20;
/// Most chunks that are looked at in a block.
const CHUNKS_MAX: usize = 64;

/// Payload type: image.
const IMAGE: u16 = 0x0001;
/// Payload type: image with chunks.
const IMAGE_CHUNKS: u16 = 0x4001;
/// Payload type: chunks alone.
const CHUNKS: u16 = 0x4000;

/// What stands before a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Leader {
    /// Counts the blocks.
    pub block_id: u64,
    /// Chunks follow the image.
    pub has_chunks: bool,
    /// Device clock, ns.
    pub timestamp_ns: u64,
    /// PFNC number.
    pub pixel_format: u32,
    /// Columns.
    pub width: u32,
    /// Lines.
    pub height: u32,
    /// Column of the sensor at which the first one lies.
    pub x_offset: u32,
    /// Bytes behind each line.
    pub x_padding: u16,
}

/// What stands behind a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trailer {
    /// That of the leader.
    pub block_id: u64,
    /// 0 is sound; 0xA100 data discarded, 0xA101 data overrun.
    pub status: u16,
    /// Bytes of the payload that count.
    pub valid_payload: u64,
    /// Lines of the image that count; that of the leader where the trailer has none.
    pub height: Option<u32>,
}

/// Whether a transfer begins as a leader does.
pub fn is_leader(bytes: &[u8]) -> bool {
    u32_at(bytes, 0) == Some(LEADER)
}

/// Whether a transfer begins as a trailer does.
pub fn is_trailer(bytes: &[u8]) -> bool {
    u32_at(bytes, 0) == Some(TRAILER)
}

/// Reads a leader.
///
/// # Errors
/// Fewer bytes than its payload type needs, another magic, a payload type that is no image.
pub fn leader(bytes: &[u8]) -> Result<Leader, DecodeError> {
    needs("leader", bytes, 20)?;
    magic("leader", bytes, LEADER, "0x4c563355, \"U3VL\"")?;
    let kind = u16_at(bytes, 0x12).unwrap_or_default();
    if ![IMAGE, IMAGE_CHUNKS, CHUNKS].contains(&kind) {
        return Err(DecodeError::Field {
            message: "leader",
            field: "payload type",
            found: kind.into(),
            allowed: "0x0001, 0x4001 or 0x4000: image, image with chunks, chunks",
        });
    }
    let image = kind != CHUNKS;
    // The last two bytes of the standard's 52 are reserved and not read.
    needs("leader", bytes, if image { 50 } else { 28 })?;
    let field = |at: usize| {
        if image {
            u32_at(bytes, at).unwrap_or_default()
        } else {
            0
        }
    };
    Ok(Leader {
        block_id: u64_at(bytes, 8),
        has_chunks: kind != IMAGE,
        timestamp_ns: u64_at(bytes, 0x14),
        pixel_format: field(0x1C),
        width: field(0x20),
        height: field(0x24),
        x_offset: field(0x28),
        x_padding: if image {
            u16_at(bytes, 0x30).unwrap_or_default()
        } else {
            0
        },
    })
}

/// Reads a trailer.
///
/// # Errors
/// Fewer bytes than it needs, or another magic.
pub fn trailer(bytes: &[u8]) -> Result<Trailer, DecodeError> {
    needs("trailer", bytes, 28)?;
    magic("trailer", bytes, TRAILER, "0x54563355, \"U3VT\"")?;
    Ok(Trailer {
        block_id: u64_at(bytes, 8),
        status: u16_at(bytes, 0x10).unwrap_or_default(),
        valid_payload: u64_at(bytes, 0x14),
        height: u32_at(bytes, 0x1C),
    })
}

// ---- Chunks -----------------------------------------------------------------------------------------------------------

/// Byte order of chunk ids and lengths; implementations differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// As `aravis` reads USB3 Vision.
    Little,
    /// As `cameleon` 0.1.14 does.
    Big,
}

/// One chunk of a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// Which; the device's GenICam file says.
    pub id: u32,
    /// Its bytes.
    pub data: &'a [u8],
}

/// The chunks of a payload, last first. The first one in the payload, the last here, is the image.
///
/// # Errors
/// Lengths that do not add up to the payload, or more chunks than any device has.
pub fn chunks(payload: &[u8], order: Order) -> Result<Vec<Chunk<'_>>, DecodeError> {
    let number = |at: usize| {
        let raw = u32_at(payload, at).unwrap_or_default();
        match order {
            Order::Little => raw,
            Order::Big => raw.swap_bytes(),
        }
    };
    let mut found = Vec::new();
    let mut end = payload.len();
    while end > 0 && found.len() < CHUNKS_MAX {
        let start = (end.checked_sub(8)).and_then(|tail| {
            let length = number(tail + 4) as usize;
            Some((tail, tail.checked_sub(length)?))
        });
        let Some((tail, start)) = start else { break };
        found.push(Chunk {
            id: number(tail),
            data: &payload[start..tail],
        });
        end = start;
    }
    if end > 0 {
        return Err(DecodeError::Field {
            message: "chunk",
            field: "length",
            found: end as u64,
            allowed: "what adds up to the payload; check `chunk_order`",
        });
    }
    Ok(found)
}

// ---- Points -----------------------------------------------------------------------------------------------------------

/// What one pixel holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pixel {
    /// Components of a pixel.
    components: usize,
    /// Place of A (x) among them; without one x is the column.
    a: Option<usize>,
    /// Place of C (z) among them.
    c: usize,
    float: bool,
}

/// The pixel formats that are understood, by PFNC number.
///
/// # Errors
/// Any other format.
pub fn pixel(format: u32) -> Result<Pixel, DecodeError> {
    let of = |components, a, c, float| {
        Ok(Pixel {
            components,
            a,
            c,
            float,
        })
    };
    match format {
        0x0110_00B8 => of(1, None, 0, false),    // Coord3D_C16
        0x0120_00BF => of(1, None, 0, true),     // Coord3D_C32f
        0x0220_00BB => of(2, Some(0), 1, false), // Coord3D_AC16
        0x0240_00C2 => of(2, Some(0), 1, true),  // Coord3D_AC32f
        0x0230_00B9 => of(3, Some(0), 2, false), // Coord3D_ABC16
        0x0260_00C0 => of(3, Some(0), 2, true),  // Coord3D_ABC32f
        other => Err(DecodeError::Field {
            message: "leader",
            field: "pixel format",
            found: other.into(),
            allowed: "Coord3D_C16, C32f, AC16, AC32f, ABC16, ABC32f",
        }),
    }
}

impl Pixel {
    /// Bytes of a pixel.
    pub fn bytes(&self) -> usize {
        self.components * if self.float { 4 } else { 2 }
    }
}

/// How raw coordinates become mm: SFNC Scan3dCoordinateScale and Scan3dCoordinateOffset of A and C.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geometry {
    /// Of A, mm.
    pub a_scale: f64,
    /// Of A, mm.
    pub a_offset: f64,
    /// Of C, mm.
    pub c_scale: f64,
    /// Of C, mm.
    pub c_offset: f64,
    /// Raw value of C where nothing was seen.
    pub invalid: Option<f64>,
}

/// One line of pixels as points, mm: x finite everywhere, z `NaN` where nothing was seen.
///
/// Without A the x is that of the column, counted from `x_offset`. An A that is no number becomes that of the point before.
pub fn points_mm(
    line: &[u8],
    pixel: Pixel,
    geometry: &Geometry,
    x_offset: u32,
) -> (Vec<f64>, Vec<f64>) {
    // A number that nothing equals, where the device has none that means "nothing".
    let invalid = geometry.invalid.unwrap_or(f64::NAN);
    let z_of = |raw: f64| {
        let z = raw * geometry.c_scale + geometry.c_offset;
        match raw == invalid || !raw.is_finite() {
            true => f64::NAN,
            false => z,
        }
    };
    match pixel.float {
        true => {
            let of = |bytes: &[u8; 4]| f32::from_le_bytes(*bytes).into();
            points_of(line.as_chunks::<4>().0, of, pixel, geometry, x_offset, z_of)
        }
        false => {
            let of = |bytes: &[u8; 2]| u16::from_le_bytes(*bytes).into();
            points_of(line.as_chunks::<2>().0, of, pixel, geometry, x_offset, z_of)
        }
    }
}

/// [`points_mm`] for numbers of one kind.
fn points_of<N>(
    numbers: &[N],
    of: impl Fn(&N) -> f64,
    pixel: Pixel,
    geometry: &Geometry,
    x_offset: u32,
    z_of: impl Fn(f64) -> f64,
) -> (Vec<f64>, Vec<f64>) {
    let x_of = |raw: f64| raw * geometry.a_scale + geometry.a_offset;
    let Some(a) = pixel.a else {
        let x = |i: usize| x_of(i as f64 + f64::from(x_offset));
        let z = numbers.iter().map(|number| z_of(of(number)));
        return ((0..numbers.len()).map(x).collect(), z.collect());
    };
    let pixels = numbers.chunks_exact(pixel.bytes() / size_of::<N>());
    let mut last = geometry.a_offset;
    // Filled in place: two growing lists cost more than the arithmetic.
    let (mut xs_mm, mut zs_mm) = (vec![0.0; pixels.len()], vec![0.0; pixels.len()]);
    for ((numbers, x_mm), z_mm) in pixels.zip(&mut xs_mm).zip(&mut zs_mm) {
        let x = x_of(of(&numbers[a]));
        let seen = x.is_finite();
        last = if seen { x } else { last };
        *x_mm = last;
        *z_mm = if seen {
            z_of(of(&numbers[pixel.c]))
        } else {
            f64::NAN
        };
    }
    (xs_mm, zs_mm)
}

/// The lines of an image, each without its padding.
///
/// # Errors
/// Fewer bytes than `height` lines of `width` pixels have.
pub fn lines<'a>(
    image: &'a [u8],
    leader: &Leader,
    height: u32,
    pixel: Pixel,
) -> Result<impl Iterator<Item = &'a [u8]>, DecodeError> {
    let line = (leader.width as usize).saturating_mul(pixel.bytes());
    let step = line.saturating_add(leader.x_padding.into());
    let needed = step
        .saturating_mul(height as usize)
        .saturating_sub(leader.x_padding.into());
    if image.len() < needed || line == 0 {
        return Err(DecodeError::TooShort {
            message: "image",
            found: image.len(),
            needed: needed.max(1),
        });
    }
    Ok((0..height as usize).map(move |index| &image[index * step..index * step + line]))
}

fn needs(message: &'static str, bytes: &[u8], needed: usize) -> Result<(), DecodeError> {
    if bytes.len() < needed {
        return Err(DecodeError::TooShort {
            message,
            found: bytes.len(),
            needed,
        });
    }
    Ok(())
}

fn magic(
    message: &'static str,
    bytes: &[u8],
    expected: u32,
    allowed: &'static str,
) -> Result<(), DecodeError> {
    let found = u32_at(bytes, 0).unwrap_or_default();
    if found == expected {
        return Ok(());
    }
    Err(DecodeError::Field {
        message,
        field: "magic",
        found: found.into(),
        allowed,
    })
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    let eight = bytes.get(at..at + 8).and_then(|b| b.try_into().ok());
    eight.map_or(0, u64::from_le_bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|byte| u8::from_str_radix(byte, 16).expect("hex"))
            .collect()
    }

    const LEADER_VECTOR: &str = "55 33 56 4C 00 00 34 00 01 00 00 00 00 00 00 00 00 00 01 40 40 42 0F 00 00 00 00 00 \
        B8 00 10 01 08 00 00 00 01 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00";
    const TRAILER_VECTOR: &str = "55 33 56 54 00 00 24 00 01 00 00 00 00 00 00 00 00 00 00 00 28 00 00 00 00 00 00 00 \
        01 00 00 00 01 00 00 00";

    fn geometry() -> Geometry {
        Geometry {
            a_scale: 0.1,
            a_offset: -5.0,
            c_scale: 0.001,
            c_offset: 20.0,
            invalid: Some(0.0),
        }
    }

    #[test]
    fn vectors_of_leader_and_trailer() {
        let bytes = hex(LEADER_VECTOR);
        assert_eq!(bytes.len(), 52);
        let expected = Leader {
            block_id: 1,
            has_chunks: true,
            timestamp_ns: 1_000_000,
            pixel_format: 0x0110_00B8,
            width: 8,
            height: 1,
            x_offset: 0,
            x_padding: 0,
        };
        assert_eq!(leader(&bytes), Ok(expected));
        assert_eq!(leader(&bytes[..50]), Ok(expected), "as cameleon writes it");
        let bytes = hex(TRAILER_VECTOR);
        let found = trailer(&bytes).expect("a trailer");
        assert_eq!(
            (
                found.block_id,
                found.status,
                found.valid_payload,
                found.height
            ),
            (1, 0, 40, Some(1))
        );
        for cut in 0..28 {
            assert!(trailer(&bytes[..cut]).is_err() && leader(&hex(LEADER_VECTOR)[..cut]).is_err());
        }
    }

    #[test]
    fn chunks_are_found_from_the_end_in_either_order() {
        let image = [7; 16];
        let encoder = (-42_i64).to_le_bytes();
        for order in [Order::Little, Order::Big] {
            let number = |n: u32| match order {
                Order::Little => n.to_le_bytes(),
                Order::Big => n.to_be_bytes(),
            };
            let payload = [
                &image[..],
                &number(0xA),
                &number(16),
                &encoder,
                &number(0xB),
                &number(8),
            ]
            .concat();
            assert_eq!(payload.len(), 40, "the published trailer's valid size");
            let found = chunks(&payload, order).expect("chunks");
            assert_eq!(
                found[0],
                Chunk {
                    id: 0xB,
                    data: &encoder
                }
            );
            assert_eq!(
                found[1],
                Chunk {
                    id: 0xA,
                    data: &image
                }
            );
            let other = if order == Order::Big {
                Order::Little
            } else {
                Order::Big
            };
            let error = chunks(&payload, other)
                .expect_err("the wrong order")
                .to_string();
            assert!(error.contains("check `chunk_order`"), "{error}");
        }
    }

    #[test]
    fn pixels_become_points() {
        let c16 = pixel(0x0110_00B8).expect("a format");
        let line: Vec<u8> = [1000_u16, 0, 65_535]
            .iter()
            .flat_map(|raw| raw.to_le_bytes())
            .collect();
        let (x, z) = points_mm(&line, c16, &geometry(), 10);
        assert_eq!(x.len(), 3);
        assert!((x[0] + 4.0).abs() < 1e-12 && (x[2] + 3.8).abs() < 1e-12);
        assert!((z[0] - 21.0).abs() < 1e-12 && z[1].is_nan() && (z[2] - 85.535).abs() < 1e-12);
        let abc = pixel(0x0260_00C0).expect("a format");
        let raw = [1.0_f32, 9.0, 2.0, f32::NAN, 9.0, 3.0, 2.0, 9.0, f32::NAN];
        let line: Vec<u8> = raw.iter().flat_map(|raw| raw.to_le_bytes()).collect();
        let (x, z) = points_mm(
            &line,
            abc,
            &Geometry {
                invalid: None,
                ..geometry()
            },
            0,
        );
        assert!((x[0] + 4.9).abs() < 1e-12 && x[1] == x[0] && (x[2] + 4.8).abs() < 1e-12);
        assert!((z[0] - 20.002).abs() < 1e-12 && z[1].is_nan() && z[2].is_nan());
        let error = pixel(0x0108_0001).expect_err("Mono8").to_string();
        assert!(
            error.ends_with("allowed is Coord3D_C16, C32f, AC16, AC32f, ABC16, ABC32f"),
            "{error}"
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(23),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_bytes_are_read_or_refused(
            mut bytes in prop::collection::vec(prop_oneof![Just(0_u8), Just(1), any::<u8>()], 0..300),
            format in prop::sample::select(vec![0x0110_00B8_u32, 0x0120_00BF, 0x0220_00BB, 0x0240_00C2, 0x0230_00B9, 0x0260_00C0]),
        ) {
            let pixel = pixel(format).expect("a format");
            for order in [Order::Little, Order::Big] {
                if let Ok(found) = chunks(&bytes, order) {
                    let sum: usize = found.iter().map(|chunk| chunk.data.len() + 8).sum();
                    prop_assert_eq!(sum, bytes.len());
                }
            }
            let (x, z) = points_mm(&bytes, pixel, &geometry(), 3);
            prop_assert!(x.len() == z.len() && x.iter().all(|x| x.is_finite()));
            for magic in [LEADER, TRAILER] {
                if bytes.len() >= 4 {
                    bytes[..4].copy_from_slice(&magic.to_le_bytes());
                }
                if let Ok(leader) = leader(&bytes)
                    && let Ok(lines) = lines(&bytes, &leader, leader.height, pixel)
                {
                        prop_assert!(lines.take(1000).all(|line| line.len() <= bytes.len()));
                }
                let _ = trailer(&bytes);
            }
        }
    }
}
