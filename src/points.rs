//! Measured points in one named frame, each traceable to its raw sample.
//!
//! Hides the memory layout, the k-d tree, the estimates of spacing and noise, and the file formats.

use glam::DVec3;

pub(crate) mod moments;
pub mod neighbors;
pub mod spacing;

pub use neighbors::Neighbors;
pub use spacing::{Spacing, noise_mm, spacing};

/// The frame that coordinates are given in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    /// As a sensor delivered them.
    Sensor,
    /// Axes, robot or conveyor applied.
    Machine,
    /// Aligned to the nominal.
    Part,
}

/// Where a point comes from: its place in the lattice that a profiler measures.
///
/// Neighbours on the surface are neighbours in (profile, column) of one view, save at depth jumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Origin {
    /// Index into [`PointCloud::views`].
    pub view: u16,
    /// Column on the sensor's line.
    pub column: u16,
    /// Profile of the view, counted with the lost ones, so that a gap in it is a gap on the part.
    pub profile: u32,
}

/// One direction from which a part was scanned.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The device's name in the cell's configuration.
    pub device: String,
    /// Unit vector from the part towards the sensor, in the cloud's frame.
    pub towards_sensor: DVec3,
}

/// N measured points, mm, all finite.
///
/// Memory: 24 bytes a point, and 8 more where the lattice is known.
#[derive(Debug, Clone, PartialEq)]
pub struct PointCloud {
    /// What frame the positions are in.
    pub frame: Frame,
    /// N positions, mm.
    pub positions: Vec<DVec3>,
    /// N origins, or none where nothing but coordinates is known.
    pub origins: Vec<Origin>,
    /// The views that `origins` speaks of.
    pub views: Vec<View>,
}
