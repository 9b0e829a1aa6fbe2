//! Points from a file: the format is told by the content first and by the extension second.
//!
//! No reader allocates more than a fixed multiple of the file's size, whatever a header promises.

use std::fmt;
use std::fs;
use std::path::Path;
use std::str::FromStr;

use glam::DVec3;

use super::error::{Fault, Malformed, PointsError, excerpt};
use super::{Frame, Origin, PointCloud, View};
use super::{obj, pcd, ply, stl, text};

/// What one unit of a file's coordinates is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Unit {
    /// 0.001 mm.
    Micrometre,
    /// 1 mm, unless something else is said.
    #[default]
    Millimetre,
    /// 10 mm.
    Centimetre,
    /// 1000 mm.
    Metre,
    /// 25.4 mm.
    Inch,
}

impl Unit {
    /// The length in mm.
    #[inline]
    pub fn to_mm(self, length: f64) -> f64 {
        match self {
            Unit::Micrometre => length / 1000.0,
            Unit::Millimetre => length,
            Unit::Centimetre => length * 10.0,
            Unit::Metre => length * 1000.0,
            Unit::Inch => length * 25.4,
        }
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Unit::Micrometre => "um",
            Unit::Millimetre => "mm",
            Unit::Centimetre => "cm",
            Unit::Metre => "m",
            Unit::Inch => "inch",
        })
    }
}

/// A word that names no unit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unit `{seen}`: not known, expected um, mm, cm, m or inch; name one of these")]
pub struct UnknownUnit {
    /// The word.
    pub seen: String,
}

impl FromStr for Unit {
    type Err = UnknownUnit;

    fn from_str(word: &str) -> Result<Self, UnknownUnit> {
        match word {
            "um" | "µm" | "μm" => Ok(Unit::Micrometre),
            "mm" => Ok(Unit::Millimetre),
            "cm" => Ok(Unit::Centimetre),
            "m" => Ok(Unit::Metre),
            "inch" | "in" => Ok(Unit::Inch),
            _ => Err(UnknownUnit {
                seen: excerpt(word.as_bytes()),
            }),
        }
    }
}

/// The formats that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Polygon file format, ascii or binary of either byte order.
    Ply,
    /// Point cloud data of PCL, ascii, binary or binary_compressed.
    Pcd,
    /// Facets; their corners are the points, each once.
    Stl,
    /// Wavefront; its `v` lines are the points.
    Obj,
    /// Hoppe's point list; its `p` lines are the points.
    HoppePts,
    /// Columns of numbers: XYZ, CSV, TXT, PTS.
    Text,
}

/// A file of points as read.
#[derive(Debug, Clone, PartialEq)]
pub struct Read {
    /// N > 0 points in the file's order. A file that does not name its frame is taken to be in machine coordinates.
    pub cloud: PointCloud,
    /// What the file was.
    pub format: Format,
    /// What is odd about it, one sentence each.
    pub findings: Vec<String>,
}

/// What a format's reader hands over.
#[derive(Debug, Default)]
pub(crate) struct Parsed {
    /// In mm.
    pub positions: Vec<DVec3>,
    /// As many as positions, or none.
    pub origins: Vec<Origin>,
    pub views: Vec<View>,
    pub frame: Option<Frame>,
    pub findings: Vec<String>,
}

/// The points of a file, with what is odd about it.
///
/// Points that lie exactly on one another are kept and are a finding (corners of STL facets are joined without one).
/// A coordinate that is NaN or infinite refuses the file, with one exception: an organised PCD (HEIGHT > 1) has a place
/// for every pixel and marks "no return" by NaN in x, y and z; these are left out and counted in a finding.
///
/// # Errors
/// [`PointsError::Read`] where the operating system refuses, else [`PointsError::Malformed`] with line or byte.
pub fn read(path: &Path, unit: Unit) -> Result<Read, PointsError> {
    let bytes = fs::read(path).map_err(|source| PointsError::Read {
        path: path.to_path_buf(),
        source,
    })?;
    parse(path, &bytes, unit)
}

/// The points in `bytes`, the content of a file named `path`, which is not opened.
///
/// # Errors
/// [`PointsError::Malformed`] with line or byte.
pub fn parse(path: &Path, bytes: &[u8], unit: Unit) -> Result<Read, PointsError> {
    read_bytes(path, bytes, unit).map_err(|Malformed { place, fault }| PointsError::Malformed {
        path: path.to_path_buf(),
        place,
        fault,
    })
}

fn read_bytes(path: &Path, bytes: &[u8], unit: Unit) -> Result<Read, Malformed> {
    let format = recognise(path, bytes)?;
    let parsed = match format {
        Format::Ply => ply::parse(bytes, unit),
        Format::Pcd => pcd::parse(bytes, unit),
        Format::Stl => stl::parse(bytes, unit),
        Format::Obj => obj::parse(bytes, obj::Dialect::Wavefront, unit),
        Format::HoppePts => obj::parse(bytes, obj::Dialect::Hoppe, unit),
        Format::Text => text::parse(bytes, unit),
    }?;
    if parsed.positions.is_empty() {
        return Err(Fault::NoPoints.at_byte(bytes.len()));
    }
    let cloud = PointCloud {
        frame: parsed.frame.unwrap_or(Frame::Machine),
        positions: parsed.positions,
        origins: parsed.origins,
        views: parsed.views,
    };
    let mut findings = parsed.findings;
    findings.extend(cloud.duplicates_finding());
    Ok(Read {
        cloud,
        format,
        findings,
    })
}

/// Formats that people hand in by mistake: their first bytes, what they are, and what to do.
const FOREIGN: [(&[u8], &str, &str); 9] = [
    (b"ASTM-E57", "an E57 file", "export as PLY"),
    (b"\x1f\x8b", "gzip-compressed", "unpack it first"),
    (
        b"PK\x03\x04",
        "a ZIP archive or a spreadsheet",
        "unpack it or export as CSV",
    ),
    (b"\x28\xb5\x2f\xfd", "zstd-compressed", "unpack it first"),
    (b"LASF", "a LAS or LAZ file", "convert it to PLY"),
    (
        b"ISO-10303-21",
        "a STEP file",
        "give it as the nominal part, not as the scan",
    ),
    (b"glTF", "a glTF file", "convert it to PLY"),
    (b"\xff\xfe", "UTF-16 text", "save it as UTF-8"),
    (b"\xfe\xff", "UTF-16 text", "save it as UTF-8"),
];

/// The format by content, else by extension.
fn recognise(path: &Path, bytes: &[u8]) -> Result<Format, Malformed> {
    if bytes.is_empty() {
        return Err(Fault::Empty.at_byte(0));
    }
    if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        return Ok(Format::Ply);
    }
    for (magic, seen, remedy) in FOREIGN {
        if bytes.starts_with(magic) {
            return Err(Fault::ForeignFormat { seen, remedy }.at_byte(0));
        }
    }
    let extension = path
        .extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase())
        .unwrap_or_default();
    if stl::is_binary(bytes) {
        return Ok(Format::Stl);
    }
    match (extension.as_str(), text::first_word(bytes)) {
        ("ply", _) => Ok(Format::Ply),
        ("pcd", _) => Ok(Format::Pcd),
        ("stl", _) => Ok(Format::Stl),
        ("obj", _) => Ok(Format::Obj),
        ("pts", b"d" | b"s" | b"g" | b"p") => Ok(Format::HoppePts),
        (_, b"VERSION" | b"FIELDS")
            if bytes.starts_with(b"# .PCD") || bytes.starts_with(b"VERSION") =>
        {
            Ok(Format::Pcd)
        }
        (_, b"solid") => Ok(Format::Stl),
        (_, word) if obj::is_keyword(word) => Ok(Format::Obj),
        _ if looks_like_text(bytes) => Ok(Format::Text),
        _ => Err(Fault::UnknownFormat {
            seen: excerpt(&bytes[..bytes.len().min(16)]),
        }
        .at_byte(0)),
    }
}

/// Whether the first 4 kB are free of the control characters that no text has.
fn looks_like_text(bytes: &[u8]) -> bool {
    bytes
        .iter()
        .take(4096)
        .all(|&b| b >= 0x20 || matches!(b, b'\t' | b'\n' | b'\r' | 0x0c | 0x1a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn real_files_have_the_points_that_their_makers_state() {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
        // Counts by the papers (Fandisk, Bunny) and by counting distinct vertex lines with another program.
        let files = [
            ("models/fandisk.obj", Format::Obj, 6_475),
            ("models/stanford-bunny.obj", Format::Obj, 35_947),
            ("models/distcap.pts", Format::HoppePts, 12_745),
            ("models/octa-flower.stl", Format::Stl, 17_641),
            ("line-laser/basic.csv", Format::Text, 5_472),
        ];
        for (name, format, points) in files {
            let path = data.join(name);
            if !path.exists() {
                eprintln!("skipped: {} is not here", path.display());
                continue;
            }
            let got = read(&path, Unit::Millimetre).unwrap();
            assert_eq!((got.format, got.cloud.len()), (format, points), "{name}");
        }
    }
}
