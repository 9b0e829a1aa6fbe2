//! What can be wrong with a file of points, each with its place, what was seen, what was expected and what to do.

use std::fmt;
use std::io;
use std::path::PathBuf;

/// Why points could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PointsError {
    /// The operating system did not let us read.
    #[error("{path}: cannot be read: {source}; check the path and the permissions")]
    Read {
        /// The file asked for.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// The operating system did not let us write. Nothing stands under `path` that did not stand there before.
    #[error(
        "{path}: cannot be written: {source}; check that the folder exists, may be written to and has room"
    )]
    Write {
        /// The file asked for.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// The content is not what its format demands.
    #[error("{path}: {place}: {fault}")]
    Malformed {
        /// The file read.
        path: PathBuf,
        /// Where in it.
        place: Place,
        /// What is wrong there.
        fault: Fault,
    },
    /// A column to be written does not fit the points.
    #[error(
        "column `{name}`: {seen} values, expected {expected}, one for each point; give every point its value"
    )]
    ColumnLength {
        /// Name of the column.
        name: String,
        /// Its number of values.
        seen: usize,
        /// The number of points.
        expected: usize,
    },
    /// A column to be written has a name that a reader would misread.
    #[error(
        "column `{name}`: not a usable name, expected a word without blanks that no other column has; rename it"
    )]
    ColumnName {
        /// The name.
        name: String,
    },
    /// A cloud to be written or joined does not hold together.
    #[error("point cloud: {seen}, expected {expected}; build the cloud from one scan")]
    Inconsistent {
        /// What it is like.
        seen: String,
        /// What it should be like.
        expected: &'static str,
    },
}

/// Where in a file something is wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Line of a text, from 1.
    Line(u64),
    /// Byte, from 0.
    Byte(u64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Place::Line(line) => write!(f, "line {line}"),
            Place::Byte(byte) => write!(f, "byte {byte}"),
        }
    }
}

/// What is wrong at one place of a file of points.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Fault {
    /// Zero bytes.
    #[error("the file is empty, expected points; check that it was written to its end")]
    Empty,
    /// A sound file of nothing.
    #[error("the file holds no point, expected at least one; check what was exported")]
    NoPoints,
    /// None of the formats.
    #[error(
        "the file begins with `{seen}`, expected PLY, PCD, STL, OBJ or a text of x y z; convert it to one of these"
    )]
    UnknownFormat {
        /// Its first bytes.
        seen: String,
    },
    /// Known, and not a scan that we read.
    #[error("this is {seen}, expected PLY, PCD, STL, OBJ or a text of x y z; {remedy}")]
    ForeignFormat {
        /// What it is.
        seen: &'static str,
        /// What to do with it.
        remedy: &'static str,
    },
    /// A header that breaks the format's rules.
    #[error("`{seen}` in the header, expected {expected}; export the file again")]
    Header {
        /// The words seen.
        seen: String,
        /// What belongs there.
        expected: &'static str,
    },
    /// Points without one of their coordinates.
    #[error("the points have no `{missing}`, expected x, y and z; export the coordinates")]
    NoCoordinate {
        /// The coordinate's name.
        missing: &'static str,
    },
    /// A header line of a text that names no coordinates.
    #[error(
        "header `{seen}` does not name each of x, y and z once, expected it to; name the columns or remove the line"
    )]
    HeaderNames {
        /// The line.
        seen: String,
    },
    /// Words where a number belongs.
    #[error("{field} is `{seen}`, expected a number; correct or remove the line")]
    NotANumber {
        /// What the number would have been.
        field: &'static str,
        /// The word seen.
        seen: String,
    },
    /// NaN or infinite.
    #[error(
        "{field} is {seen}, expected a finite number; leave out points without a measurement when exporting"
    )]
    NotFinite {
        /// The coordinate.
        field: &'static str,
        /// The value seen.
        seen: String,
    },
    /// No part is so large.
    #[error(
        "{field} is {seen_mm:e} mm, expected less than 1e12 mm either way; check the unit and the byte order"
    )]
    OutOfRange {
        /// The coordinate.
        field: &'static str,
        /// The value, mm.
        seen_mm: f64,
    },
    /// `1,5` for one and a half.
    #[error(
        "`{seen}` has decimal commas, expected decimal points; export with points and with semicolons, tabs or blanks between columns"
    )]
    DecimalComma {
        /// The line.
        seen: String,
    },
    /// Fewer than three columns.
    #[error("{seen} columns, expected at least 3 (x y z); correct or remove the line")]
    TooFewColumns {
        /// Number of columns.
        seen: usize,
    },
    /// A line unlike the ones before.
    #[error(
        "{seen} columns, expected {expected} as declared or in the lines before; correct or remove the line"
    )]
    Columns {
        /// Number of columns.
        seen: usize,
        /// The number that the file began with.
        expected: usize,
    },
    /// Less in the file than it says itself.
    #[error("the file ends after {seen} of {expected} {what}; transfer or export it again")]
    Truncated {
        /// What is counted.
        what: &'static str,
        /// Number found.
        seen: u64,
        /// Number promised.
        expected: u64,
    },
    /// A line that does not belong to the format.
    #[error("`{seen}`, expected {expected}; correct or remove the line")]
    Statement {
        /// The line.
        seen: String,
        /// What belongs there.
        expected: &'static str,
    },
    /// A point of a view that the header does not describe.
    #[error(
        "view {seen} of a point, expected less than {views}, the number of `comment acies view` lines; restore the header"
    )]
    UnknownView {
        /// The view.
        seen: u64,
        /// Number of views described.
        views: usize,
    },
    /// A place in the lattice that is none.
    #[error("{field} is {seen}, expected a whole number up to {limit}; export the scan again")]
    LatticeValue {
        /// `view`, `profile` or `column`.
        field: &'static str,
        /// The value seen.
        seen: String,
        /// The largest value that it can have.
        limit: u32,
    },
    /// Compressed data that contradict themselves.
    #[error(
        "compressed data that do not unpack: {seen}, expected {expected}; transfer or export the file again"
    )]
    Compression {
        /// What is wrong.
        seen: String,
        /// What it should be.
        expected: String,
    },
}

/// A fault and its place, before the file's name is known.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Malformed {
    pub place: Place,
    pub fault: Fault,
}

impl Fault {
    /// The fault, found in a line counted from 1.
    pub(crate) fn at_line(self, line: u64) -> Malformed {
        Malformed {
            place: Place::Line(line),
            fault: self,
        }
    }

    /// The fault, found at a byte counted from 0.
    pub(crate) fn at_byte(self, byte: usize) -> Malformed {
        Malformed {
            place: Place::Byte(byte as u64),
            fault: self,
        }
    }
}

/// At most 40 characters of `bytes`, printable, for an error's text.
pub(crate) fn excerpt(bytes: &[u8]) -> String {
    const LONGEST: usize = 40;
    let head = &bytes[..bytes.len().min(4 * LONGEST)];
    let text = String::from_utf8_lossy(head);
    let mut shown: String = text
        .chars()
        .take(LONGEST)
        .map(|c| {
            if c.is_control() {
                char::REPLACEMENT_CHARACTER
            } else {
                c
            }
        })
        .collect();
    if text.chars().count() > LONGEST {
        shown.push('…');
    }
    shown
}
