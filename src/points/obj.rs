//! Points from lines that begin with a keyword: Wavefront OBJ (`v x y z`) and Hoppe's point lists (`p x y z`).

use super::error::{Fault, Malformed, excerpt};
use super::read::{Parsed, Unit};
use super::scalar::{AXES, position};
use super::text::{Lines, number, words};

/// Which of the two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Dialect {
    Wavefront,
    Hoppe,
}

/// Statements of Wavefront OBJ, 3.0, that may stand in a file of vertices.
const WAVEFRONT: [&[u8]; 38] = [
    b"v",
    b"vn",
    b"vt",
    b"vp",
    b"f",
    b"l",
    b"p",
    b"o",
    b"g",
    b"s",
    b"mg",
    b"mtllib",
    b"usemtl",
    b"usemap",
    b"maplib",
    b"cstype",
    b"deg",
    b"bmat",
    b"step",
    b"curv",
    b"curv2",
    b"surf",
    b"parm",
    b"trim",
    b"hole",
    b"scrv",
    b"sp",
    b"end",
    b"con",
    b"bevel",
    b"c_interp",
    b"d_interp",
    b"lod",
    b"shadow_obj",
    b"trace_obj",
    b"ctech",
    b"stech",
    b"fo",
];

/// Statements of Hoppe's point lists.
const HOPPE: [&[u8]; 4] = [b"p", b"d", b"s", b"g"];

/// Whether a Wavefront file can begin with `word`.
pub(crate) fn is_keyword(word: &[u8]) -> bool {
    WAVEFRONT.contains(&word)
}

/// The points of `bytes`; every other statement is skipped, and a word that is none is refused.
///
/// # Errors
/// With the line of the first fault.
pub(crate) fn parse(bytes: &[u8], dialect: Dialect, unit: Unit) -> Result<Parsed, Malformed> {
    let (tag, known, expected): (&[u8], &[&[u8]], _) = match dialect {
        Dialect::Wavefront => (b"v", &WAVEFRONT, "a statement of Wavefront OBJ"),
        Dialect::Hoppe => (b"p", &HOPPE, "a line of a point list (p, d, s or g)"),
    };
    let mut parsed = Parsed::default();
    let mut continued = false;
    for (at, line) in Lines::new(bytes, 1) {
        let continues = std::mem::replace(&mut continued, line.ends_with(b"\\"));
        let mut columns = words(line);
        let Some(word) = columns.next() else { continue };
        if continues || word.starts_with(b"#") {
            continue;
        }
        if word == tag {
            let mut raw = [0.0; 3];
            for (axis, value) in raw.iter_mut().enumerate() {
                let Some(word) = columns.next() else {
                    return Err(Fault::TooFewColumns { seen: axis }.at_line(at));
                };
                *value = number(word).ok_or_else(|| {
                    Fault::NotANumber {
                        field: AXES[axis],
                        seen: excerpt(word),
                    }
                    .at_line(at)
                })?;
            }
            let point = position(raw, unit).map_err(|f| f.at_line(at))?;
            parsed.positions.push(point);
        } else if !known.contains(&word) {
            return Err(Fault::Statement {
                seen: excerpt(line),
                expected,
            }
            .at_line(at));
        }
    }
    Ok(parsed)
}
