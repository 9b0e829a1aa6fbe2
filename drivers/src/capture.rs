//! What instruments deliver: profiles, touches and poses, in the sensor's or the machine's own coordinates.

use std::time::Instant;

/// What a device delivers once. A new kind is a new variant, and the compiler shows every place to extend.
#[derive(Debug, Clone, PartialEq)]
pub enum Capture {
    /// One line of a laser profiler.
    Profile(Profile),
    /// One contact of a probe.
    Touch(Touch),
    /// Where a robot's tool was.
    Pose(Pose),
}

/// One laser line: N columns in the plane of the sensor, in mm.
///
/// Three clocks, never mixed: the device's own, the encoder, and the host's on receipt.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Counts the profiles the device sent in this run, from 0; a gap is loss on the link.
    pub sequence: u32,
    /// Differs after every start of the device; 0 where the device does not say.
    pub boot: u32,
    /// Device clock at the centre of the exposure, raw, in ns since the device started; 0 where it has no clock.
    pub device_time_ns: u64,
    /// Encoder counts at the centre of the exposure; `None` where the device has no encoder.
    pub encoder: Option<i64>,
    /// When the last byte arrived. Never used to find a pose.
    pub host_time: Instant,
    /// Profiles of this run that the device itself took but could not send.
    pub dropped: u32,
    /// Some column was saturated.
    pub saturated: bool,
    /// Across the laser's axis, mm, N values; finite also where nothing was seen.
    pub x_mm: Vec<f64>,
    /// Along the laser's axis away from the device, mm, N values; `NaN` where nothing was seen.
    pub z_mm: Vec<f64>,
    /// N intensities, or none where the device sends none.
    pub intensity: Vec<u16>,
}

/// One contact of a probe, latched by the controller.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// Centre of the tip at contact, mm, in the machine's axes.
    pub tip_centre_mm: [f64; 3],
    /// Unit direction of travel at contact, in the machine's axes: it points into the material.
    pub direction: [f64; 3],
    /// When the answer arrived.
    pub host_time: Instant,
}

/// Where a robot's tool was at one moment of the robot's own clock, in the robot's base frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// The robot's clock, raw, s since its controller was started.
    pub device_time_s: f64,
    /// Origin of the tool's frame, mm.
    pub position_mm: [f64; 3],
    /// Turn of the tool's frame: axis times angle, rad.
    pub rotation: [f64; 3],
    /// When the last byte arrived. Never used to find where the tool was, only to relate clocks.
    pub host_time: Instant,
}
