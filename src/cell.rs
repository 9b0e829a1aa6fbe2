//! The cell at work: its devices, its jobs, one event loop.
//!
//! [`run`] does one inspection and ends. [`Daemon`] stays: it keeps the devices open, takes triggers, and answers each of them
//! once. Hides threads, retries and the order of things.

mod acquisition;
mod daemon;
mod devices;
mod feed;
mod job;
mod live;
mod meanwhile;
mod recipes;
mod state;
mod status;

use std::path::PathBuf;

use acies_drivers::error::DeviceError;

use crate::acquire::ScanError;
use crate::nominal::NominalError;
use crate::store::StoreError;

pub use daemon::{Command, Daemon, DaemonOptions, Handle, Refusal, Started};
pub use job::{Outcome, Part, Step, check_recipe, read_part, read_recipe, report_of, run};
pub use live::{Live, LiveEdges, LivePoints, LiveProfile};
pub use recipes::judge_alike;
pub use state::{Mode, State};
pub use status::{DeviceState, DeviceStatus, JobStatus, Snapshot};

/// Why a job came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum CellError {
    /// The nominal cannot be read.
    #[error("the part's nominal")]
    Nominal(#[source] Box<NominalError>),
    /// The recipe cannot be read.
    #[error("{path}: cannot be read: {source}; check the path and its permissions")]
    RecipeFile {
        /// The recipe.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The recipe has mistakes.
    #[error("{mistakes}")]
    Recipe {
        /// All of them, a line each, which begins with the file.
        mistakes: String,
    },
    /// A device would not open.
    #[error("device {device:?}")]
    Device {
        /// Its name.
        device: String,
        /// Its reason.
        #[source]
        source: Box<DeviceError>,
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
        source: Box<DeviceError>,
    },
    /// The scan did not start.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// The scan was given up.
    #[error("{reason}")]
    GivenUp {
        /// By whom or what.
        reason: String,
    },
    /// The store.
    #[error("the store")]
    Store(#[from] StoreError),
}
