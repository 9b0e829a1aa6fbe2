//! One [`Report`] of an inspection and its forms: JSON, HTML, CSV, a terminal table, and the scan as a coloured PLY.
//!
//! Hides the formats. The wire types in [`wire`] are apart from the inner types, so that the contract `acies-report/1` changes
//! only on purpose. Inside the kernel angles are radians; here they are degrees. A number that is not finite never leaves:
//! it becomes `null`, with the reason beside it.

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

use std::collections::BTreeMap;
use std::time::SystemTime;

use acies_drivers::device::{Identity, Losses};

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
    pub limits: LimitFacts,
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

/// Limits of the deviations and the rule that judges them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LimitFacts {
    /// How the uncertainty counts.
    pub rule: Rule,
    /// The limits of every edge that has none of its own.
    pub all: EdgeLimits,
    /// Limits of single edges, by id.
    pub by_edge: BTreeMap<String, EdgeLimits>,
}

/// Lower and upper limits of one edge; `None` = not evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct EdgeLimits {
    /// Of d1, mm.
    pub d1_mm: Option<[f64; 2]>,
    /// Of d2, mm.
    pub d2_mm: Option<[f64; 2]>,
    /// Of the included angle minus the nominal one, rad.
    pub angle_deviation_rad: Option<[f64; 2]>,
}

/// How the uncertainty of a value counts when it is compared with a limit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Rule {
    /// The value alone decides.
    #[default]
    Simple,
    /// A limit within `k` standard uncertainties of the value leaves it undecided (ISO 14253-1:2017 with k = 2 and 95 %).
    GuardBand {
        /// Half the width of the uncertainty zone in standard uncertainties.
        k: f64,
    },
}

impl LimitFacts {
    /// The limits that hold for the edge `id`.
    pub fn of(&self, id: &str) -> EdgeLimits {
        self.by_edge.get(id).copied().unwrap_or(self.all)
    }
}
