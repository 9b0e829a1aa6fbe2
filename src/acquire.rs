//! Captures into a scan: calibration, encoder, poses, losses.
//!
//! A pose is joined by the encoder, or by device time where a robot carries the profiler; never by the host's clock. What is lost
//! stays a gap: nothing is interpolated across it.

pub mod acceptance;
mod assembler;
pub mod calibrate;
mod carried;
pub mod clock;
pub mod lag;
pub mod poses;
mod run;

use glam::DVec3;

use acies_drivers::device::{Identity, Losses};

use crate::geometry::RigidTransform;
use crate::points::PointCloud;

pub use assembler::Assembler;
pub use carried::{
    CarriedRecord, CarriedRun, CarriedView, Carrier, CarrierPlan, run_carried, scan_carried,
};
pub(crate) use run::chain;
pub use run::{Profiling, ScanError, ScanEvent, ScanPlan, ScanWatch, scan};

/// Where a profiler is, and how it moves relative to the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// Pose of the sensor in the machine when the encoder stands at 0.
    pub machine_from_sensor: RigidTransform,
    /// How far the sensor moves relative to the part with every encoder count, mm, in the machine's axes.
    pub travel_mm_per_count: DVec3,
}

/// One run over a part: the points of every view in the machine frame, and what happened on the way.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// All views, in the machine frame.
    pub cloud: PointCloud,
    /// One for every profiler, in the order of [`PointCloud::views`].
    pub views: Vec<ViewRecord>,
}

/// What one profiler did during a scan.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewRecord {
    /// The device's name in the cell's configuration.
    pub device: String,
    /// Who it says it is.
    pub identity: Identity,
    /// Profiles received and lost, by cause.
    pub losses: Losses,
    /// Profiles that could not be placed: no encoder, or an encoder that jumped.
    pub unplaced: u64,
    /// Columns in which nothing was seen.
    pub empty_columns: u64,
    /// Whether the run reached its end.
    pub complete: bool,
    /// What was wrong with the data, as sentences.
    pub findings: Vec<String>,
}
