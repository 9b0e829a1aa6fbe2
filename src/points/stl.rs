//! Points from the corners of STL facets, ascii or binary, each corner once and in the order of its first facet.

use super::duplicates::first_occurrences;
use super::error::{Fault, Malformed, excerpt};
use super::read::{Parsed, Unit};
use super::scalar::{AXES, Scalar, position};
use super::text::{Lines, number, words};

const HEADER: usize = 84;
const FACET: usize = 50;

/// Whether `bytes` has exactly the length that its facet count demands.
pub(crate) fn is_binary(bytes: &[u8]) -> bool {
    facet_count(bytes).is_some_and(|count| count > 0 && bytes.len() as u64 == length(count))
}

fn facet_count(bytes: &[u8]) -> Option<u32> {
    let raw = bytes.get(HEADER - 4..HEADER)?;
    Some(u32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]]))
}

fn length(facets: u32) -> u64 {
    HEADER as u64 + FACET as u64 * u64::from(facets)
}

/// The corners of `bytes`.
///
/// # Errors
/// With the line (ascii) or byte (binary) of the first fault.
pub(crate) fn parse(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    // Some programs begin a binary file with `solid` too; its count of facets shows as a control character.
    let head = &bytes[..bytes.len().min(HEADER)];
    let is_ascii = bytes.trim_ascii_start().starts_with(b"solid") && !head.contains(&0);
    let mut parsed = if is_ascii {
        parse_ascii(bytes, unit)
    } else {
        parse_binary(bytes, unit)
    }?;
    let first = first_occurrences(&parsed.positions);
    let mut keep = first.iter();
    parsed.positions.retain(|_| *keep.next().unwrap_or(&true));
    Ok(parsed)
}

fn parse_binary(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    let Some(count) = facet_count(bytes) else {
        return Err(Fault::Truncated {
            what: "bytes of the header",
            seen: bytes.len() as u64,
            expected: HEADER as u64,
        }
        .at_byte(bytes.len()));
    };
    let facets = bytes[HEADER..].chunks_exact(FACET);
    let present = facets.len() as u64;
    if present < u64::from(count) {
        return Err(Fault::Truncated {
            what: "facets",
            seen: present,
            expected: u64::from(count),
        }
        .at_byte(bytes.len()));
    }
    let mut parsed = Parsed::default();
    parsed.positions.reserve(3 * count as usize);
    for (index, facet) in facets.take(count as usize).enumerate() {
        for corner in 1..4 {
            let offset = 12 * corner;
            let raw = [0, 4, 8].map(|axis| Scalar::F32.get(&facet[offset + axis..], false));
            let point =
                position(raw, unit).map_err(|f| f.at_byte(HEADER + FACET * index + offset))?;
            parsed.positions.push(point);
        }
    }
    let extra = bytes.len() as u64 - length(count);
    if extra > 0 {
        parsed
            .findings
            .push(format!("{extra} bytes after the last facet were not read"));
    }
    Ok(parsed)
}

/// What the line after this one may be.
#[derive(Clone, Copy, PartialEq)]
enum Expect {
    Solid,
    Facet,
    Loop,
    Vertex(u8),
    EndLoop,
    EndFacet,
}

impl Expect {
    fn text(self) -> &'static str {
        match self {
            Expect::Solid => "solid",
            Expect::Facet => "facet normal or endsolid",
            Expect::Loop => "outer loop",
            Expect::Vertex(_) => "vertex x y z",
            Expect::EndLoop => "endloop",
            Expect::EndFacet => "endfacet",
        }
    }

    /// What follows a line that begins with `word`, if it may stand here.
    fn after(self, word: &[u8]) -> Option<Self> {
        let word = word.to_ascii_lowercase();
        match (self, word.as_slice()) {
            (Expect::Solid, b"solid") => Some(Expect::Facet),
            (Expect::Facet, b"facet") => Some(Expect::Loop),
            (Expect::Facet, b"endsolid") => Some(Expect::Solid),
            (Expect::Loop, b"outer") => Some(Expect::Vertex(0)),
            (Expect::Vertex(2), b"vertex") => Some(Expect::EndLoop),
            (Expect::Vertex(n), b"vertex") => Some(Expect::Vertex(n + 1)),
            (Expect::EndLoop, b"endloop") => Some(Expect::EndFacet),
            (Expect::EndFacet, b"endfacet") => Some(Expect::Facet),
            _ => None,
        }
    }
}

fn parse_ascii(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    let mut parsed = Parsed::default();
    let mut expect = Expect::Solid;
    let mut lines = Lines::new(bytes, 1);
    for (at, line) in lines.by_ref() {
        let mut columns = words(line);
        let Some(word) = columns.next() else { continue };
        let is_vertex = matches!(expect, Expect::Vertex(_));
        let Some(next) = expect.after(word) else {
            return Err(Fault::Statement {
                seen: excerpt(line),
                expected: expect.text(),
            }
            .at_line(at));
        };
        expect = next;
        if !is_vertex {
            continue;
        }
        let mut raw = [0.0; 3];
        for (axis, value) in raw.iter_mut().enumerate() {
            let word = columns.next().unwrap_or_default();
            *value = number(word).ok_or_else(|| {
                Fault::NotANumber {
                    field: AXES[axis],
                    seen: excerpt(word),
                }
                .at_line(at)
            })?;
        }
        parsed
            .positions
            .push(position(raw, unit).map_err(|f| f.at_line(at))?);
    }
    if expect != Expect::Solid {
        return Err(Fault::Statement {
            seen: "the end of the file".into(),
            expected: expect.text(),
        }
        .at_line(lines.number()));
    }
    Ok(parsed)
}
