//! Why a nominal cannot be read at all.

use super::Refused;

/// A file that gives no nominal.
#[derive(Debug, thiserror::Error)]
pub enum NominalError {
    /// The file cannot be opened or read.
    #[error("{name}: cannot be read: {source}; check the path and its permissions")]
    Io {
        /// File.
        name: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is larger than we read.
    #[error(
        "{name}: {bytes} bytes, at most {limit} are read; export the part alone, without presentation data"
    )]
    TooLarge {
        /// File.
        name: String,
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// No bytes.
    #[error("{name}: the file is empty, expected a STEP file; export the part again")]
    Empty {
        /// File.
        name: String,
    },
    /// The first bytes are not those of a STEP file.
    #[error(
        "{name}: line 1: the file begins with {seen:?}, expected \"ISO-10303-21;\"; give a STEP file (.stp, .step)"
    )]
    NotStep {
        /// File.
        name: String,
        /// Its first characters.
        seen: String,
    },
    /// The end mark is missing.
    #[error(
        "{name}: line {line}: the file ends without \"END-ISO-10303-21;\", it was cut off; copy or export it again"
    )]
    Unfinished {
        /// File.
        name: String,
        /// Last line there is.
        line: usize,
    },
    /// The text breaks the grammar of ISO 10303-21.
    #[error("{name}: {what}; export the part again")]
    Syntax {
        /// File.
        name: String,
        /// Line, column, what was seen and expected.
        what: String,
    },
    /// The sections of an IGES file are broken.
    #[error("{name}: line {line}: {what}; export the part again")]
    Iges {
        /// File.
        name: String,
        /// Line of the file, from 1.
        line: usize,
        /// What was seen and expected.
        what: String,
    },
    /// The file holds no boundary representation.
    #[error(
        "{name}: no solid or surface model, but {found}; export the part as exact geometry (boundary representation: AP203, AP214 or AP242)"
    )]
    NoShape {
        /// File.
        name: String,
        /// What there is instead.
        found: String,
    },
    /// The assembly unfolds into more faces than we keep.
    #[error(
        "{name}: more than {limit} faces with all occurrences of its parts; export one part at a time"
    )]
    TooManyFaces {
        /// File.
        name: String,
        /// The limit.
        limit: usize,
    },
    /// The assembly unfolds into more parts than we place.
    #[error(
        "{name}: the assembly unfolds into more than {limit} occurrences of its parts; export one part at a time"
    )]
    TooManyPlaces {
        /// File.
        name: String,
        /// The limit.
        limit: usize,
    },
    /// The faces and curves together need more points than we keep.
    #[error(
        "{name}: its faces and curves take more than {limit} points; export the part alone, without copies of its faces"
    )]
    TooDetailed {
        /// File.
        name: String,
        /// The limit.
        limit: usize,
    },
    /// Bodies were found, but none of their faces can be used.
    #[error("{name}: none of its {faces} faces can be used, the first because #{}: {}; export the part again", first.entity, first.reason)]
    NothingUsable {
        /// File.
        name: String,
        /// Faces that were refused.
        faces: usize,
        /// The first of them.
        first: Refused,
    },
}
