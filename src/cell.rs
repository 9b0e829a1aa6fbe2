//! One job of a cell: open the devices, touch, scan, find the pose, measure, conclude.
//!
//! Hides the order of things. What is announced is in the [`Outcome`]; what goes on meanwhile is told as [`State`]s.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use acies_drivers::capture::Touch;
use acies_drivers::device::{Identity, Instrument, Probe};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;

use crate::acquire::{Profiling, Scan, ScanError, ScanEvent, scan};
use crate::config::{Cell, ProbeConfig};
use crate::inspect::result::{Inspection, Verdict};
use crate::inspect::{Recipe, Start, TouchedPoint, inspect};
use crate::nominal::{Nominal, NominalError};

/// How long one touch may take: a machine that crosses a metre at 10 mm/s needs 100 s.
const TOUCH_TIMEOUT: Duration = Duration::from_secs(120);

/// What a job is doing.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Opening a device.
    Opening {
        /// Its name.
        device: String,
    },
    /// Touching the part.
    Touching {
        /// Touches done.
        done: usize,
        /// Touches planned.
        of: usize,
    },
    /// Scanning.
    Scanning {
        /// Profiles placed so far.
        profiles: u64,
        /// Share of the way, 0 to 1.
        share: f64,
    },
    /// A device was lost; the job goes on with the others.
    Lost {
        /// Its name.
        device: String,
        /// Why.
        error: String,
    },
    /// Working on the scan.
    Inspecting,
}

/// What a job brought.
#[derive(Debug)]
pub struct Outcome {
    /// The points and what happened on the way.
    pub scan: Scan,
    /// The nominal it was measured against.
    pub nominal: Nominal,
    /// The recipe it was judged by.
    pub recipe: Recipe,
    /// The probes, by name.
    pub probes: Vec<(String, Identity)>,
    /// What was found.
    pub inspection: Inspection,
    /// From the first profile's start to the last profile, s.
    pub scan_seconds: f64,
    /// From the last profile to the verdict, s.
    pub verdict_seconds: f64,
}

/// Why a job came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum CellError {
    /// The nominal cannot be read.
    #[error("the part's nominal")]
    Nominal(#[from] NominalError),
    /// The recipe cannot be read.
    #[error("{path}: {source}; check that the file may be read")]
    RecipeFile {
        /// The recipe.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The recipe has mistakes.
    #[error("{path}: {mistakes}")]
    Recipe {
        /// The recipe.
        path: PathBuf,
        /// All of them, a line each.
        mistakes: String,
    },
    /// A device would not open.
    #[error("device {device:?}")]
    Device {
        /// Its name.
        device: String,
        /// Its reason.
        #[source]
        source: DeviceError,
    },
    /// A device is of another kind than its tables say.
    #[error(
        "device {device:?} is a {found}, its tables are those of a {expected}; give it [device.{table}]"
    )]
    Kind {
        /// Its name.
        device: String,
        /// What the driver opened.
        found: &'static str,
        /// What the configuration takes it for.
        expected: &'static str,
        /// The table it needs.
        table: &'static str,
    },
    /// A touch failed.
    #[error("device {device:?}, touch {index}")]
    Touch {
        /// The probe.
        device: String,
        /// Which touch, from 1.
        index: usize,
        /// Its reason.
        #[source]
        source: DeviceError,
    },
    /// The scan did not start.
    #[error(transparent)]
    Scan(#[from] ScanError),
}
