//! One [`Report`] of an inspection and its forms: JSON, HTML, CSV, a terminal table, and the scan as a coloured PLY.
//!
//! Hides the formats. The wire types in [`wire`] are apart from the inner types, so that the contract `acies-report/1` changes
//! only on purpose. Inside the kernel angles are radians; here they are degrees. A number that is not finite never leaves:
//! it becomes `null`, with the reason beside it.

mod because;
mod build;
mod characteristic;
mod conclusion;
mod csv;
mod figure;
mod file;
mod html;
mod ply;
mod table;
pub mod wire;

use std::time::SystemTime;

use acies_drivers::device::{Identity, Losses};

use crate::inspect::recipe::Recipe;

pub use file::ReportError;
pub use html::content_security_policy;
pub use ply::to_ply;
pub use table::print_table;
pub use wire::Report;

/// What a report says beside what the inspection found.
#[derive(Debug, Clone)]
pub struct Facts {
    /// The part: a name for people.
    pub part: String,
    /// The nominal: usually the name of the CAD file.
    pub nominal: String,
    /// When the scan ended. The caller reads the clock.
    pub created: SystemTime,
    /// The seed, where the scan came from simulated instruments.
    pub simulated_seed: Option<u64>,
    /// What the scan is like.
    pub scan: ScanFacts,
    /// The instruments, in the order of the cell's configuration; none for a scan read from a file.
    pub devices: Vec<DeviceFacts>,
    /// What the values were judged by.
    pub recipe: Recipe,
    /// Whether every station says what its uncertainties are made of.
    pub with_budgets: bool,
}

/// Size, spacing and noise of the scan, as estimated from the data.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ScanFacts {
    /// Points measured.
    pub points: usize,
    /// Median distance to the nearest neighbour, mm.
    pub spacing_mm: Option<f64>,
    /// Typical distance of neighbours on one laser line, mm; `None` where no lattice is known.
    pub spacing_along_line_mm: Option<f64>,
    /// Typical distance of neighbouring laser lines, mm; `None` where no lattice is known.
    pub spacing_across_lines_mm: Option<f64>,
    /// Standard deviation of the measured points about the surface, mm.
    pub noise_mm: Option<f64>,
}

/// One instrument that took part.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceFacts {
    /// Its name in the cell's configuration.
    pub name: String,
    /// Who it said it is.
    pub identity: Identity,
    /// What was lost on the way; `None` for an instrument that cannot lose anything (a probe answers or fails).
    pub losses: Option<Losses>,
}
