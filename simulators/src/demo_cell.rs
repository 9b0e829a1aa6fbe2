//! The demo's cell: two profilers on one stage, a touch probe, and the part lying a little off where the fixture should hold it.

use std::f64::consts::FRAC_PI_2;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, UnitSphere};

use crate::demo_part::{Defects, DemoPart, PLATE_MM, PLATE_TOP_MM, TOP};
use crate::faults::Faults;
use crate::grbl::{self, SimulatedProbe};
use crate::open_profile::{self, SimulatedProfiler};
use crate::pose::Pose;
use crate::sensor::{Fan, Optics, Traverse, View};
use crate::wire::Wire;

/// The stage's axis in the machine.
pub const AXIS: DVec3 = DVec3::Y;
/// Travel of one encoder count, mm.
pub const MM_PER_COUNT: f64 = 0.002;
/// Counts from profile to profile: 0.4 mm.
pub const STEP_COUNTS: i64 = 200;
/// Columns of a profile: 0.096 mm apart in the middle of the range.
pub const COLUMNS: u32 = 1000;
/// Radius of the probe's tip, mm.
pub const TIP_RADIUS_MM: f64 = 1.0;
/// Where the fixture should hold the part: parallel to the machine's axes.
pub const FIXTURE_MM: DVec3 = DVec3::new(150.0, 120.0, 40.0);
/// The part is off by at most this much, mm.
pub const MISPLACED_MM: f64 = 2.0;
/// And turned by at most this much, rad.
pub const MISTURNED_RAD: f64 = 1.5 * std::f64::consts::PI / 180.0;

/// From a sensor to the middle of its range, mm: far enough that a camera over the middle of the line looks onto the sides at its ends.
const STANDOFF_MM: f64 = 200.0;
/// The stage runs this far beyond the part at both ends, mm: more than the part can be off.
const MARGIN_MM: f64 = 5.0;
/// The sides of the part are in the field down from here, mm.
const LOWEST_SEEN_MM: f64 = 1.0;

/// What to vary.
#[derive(Debug, Clone, PartialEq)]
pub struct DemoOptions {
    /// Of everything drawn: pose, noise, boot numbers, faults.
    pub seed: u64,
    /// How the part departs from its nominal.
    pub defects: Defects,
    /// Standard deviations by which the sensors' true poses differ from what the configuration says, per component: mm, rad.
    pub calibration_error: [f64; 2],
    /// Real time, at 500 profiles a second; otherwise as fast as they are taken.
    pub paced: bool,
    /// Of both profilers.
    pub faults: Faults,
    /// Of the probe.
    pub probe_faults: Faults,
}

impl DemoOptions {
    /// The demo as it is shown: its defects, no calibration error, no faults, no waiting.
    pub fn new(seed: u64) -> DemoOptions {
        DemoOptions {
            seed,
            defects: Defects::demo(),
            calibration_error: [0.0; 2],
            paced: false,
            faults: Faults::default(),
            probe_faults: Faults::default(),
        }
    }
}

/// One profiler of the cell.
#[derive(Debug, Clone)]
pub struct DemoSensor {
    /// `left` or `right`.
    pub name: &'static str,
    /// Serial number it answers with.
    pub serial: &'static str,
    /// Where the configuration says it is at encoder 0; [`View::machine_from_sensor`] is where it truly is.
    pub stated_machine_from_sensor: Pose,
    /// What it sees.
    pub view: View,
}

/// One probing move, in the machine, for a part exactly where the fixture should hold it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NominalTouch {
    /// The datum face: `plate top`, `back` or `right`.
    pub face: &'static str,
    /// Nominal contact in the part frame, mm.
    pub point_in_part: DVec3,
    /// Outward normal of the face in the part frame.
    pub normal_in_part: DVec3,
    /// Centre of the tip where the move starts, mm, machine.
    pub start: DVec3,
    /// Where it ends at the latest, mm, machine.
    pub target: DVec3,
}

/// The cell with everything that is true about it.
#[derive(Debug, Clone)]
pub struct DemoCell {
    /// As asked for.
    pub options: DemoOptions,
    /// The part, nominal and made.
    pub part: DemoPart,
    /// Where the part truly lies.
    pub machine_from_part: Pose,
    /// Where the fixture should hold it.
    pub machine_from_fixture: Pose,
    /// Both profilers.
    pub sensors: [DemoSensor; 2],
    /// Six touches: three on the plate's top, two on the back, one on the right.
    pub touches: Vec<NominalTouch>,
}

/// The cell's devices, running; dropping it takes their ports away.
#[derive(Debug)]
pub struct RunningCell {
    /// Looks from the left and the front.
    pub left: SimulatedProfiler,
    /// Looks from the right and the back.
    pub right: SimulatedProfiler,
    /// The touch probe.
    pub probe: SimulatedProbe,
}

impl DemoCell {
    /// The cell as the demo shows it.
    pub fn new(seed: u64) -> DemoCell {
        DemoCell::with_options(DemoOptions::new(seed))
    }

    /// The cell, varied.
    pub fn with_options(options: DemoOptions) -> DemoCell {
        let part = DemoPart::new(&options.defects);
        let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
        let machine_from_fixture = Pose::shift(FIXTURE_MM);
        let machine_from_part = machine_from_fixture.after(misplacement(&mut rng));
        let sensors = [
            ("left", "SIM-LEFT", DVec3::new(-0.55, -0.45, 0.70), -1.0),
            ("right", "SIM-RIGHT", DVec3::new(0.55, 0.45, 0.70), 1.0),
        ];
        // Both are on one stage, which runs until the slower of them has passed the part.
        let profiles = sensors.map(|(_, _, from, _)| stand(from.normalize()).1);
        let profiles = profiles[0].max(profiles[1]);
        let sensors = sensors.map(|(name, serial, from, camera_side)| {
            let (stated, _) = stand(from.normalize());
            let [translation_mm, rotation_rad] = options.calibration_error;
            let error = Pose::normal_draw(&mut rng, translation_mm, rotation_rad);
            DemoSensor {
                name,
                serial,
                stated_machine_from_sensor: stated,
                view: View {
                    scene: part.made.clone(),
                    machine_from_scene: machine_from_part,
                    machine_from_sensor: stated.after(error),
                    optics: optics(camera_side),
                    traverse: Traverse {
                        axis: AXIS,
                        mm_per_count: MM_PER_COUNT,
                        first_count: 0,
                        step_counts: STEP_COUNTS,
                        profiles,
                    },
                    columns: COLUMNS,
                    seed: rng.random(),
                },
            }
        });
        DemoCell {
            part,
            machine_from_part,
            machine_from_fixture,
            sensors,
            touches: touches(&machine_from_fixture),
            options,
        }
    }

    /// Ports of the cell in a folder: left, right, probe.
    pub fn ports(folder: &Path) -> [PathBuf; 3] {
        ["ttyLEFT", "ttyRIGHT", "ttyPROBE"].map(|name| folder.join(name))
    }

    /// Starts the devices on pseudo-terminals in a folder that exists; see [`DemoCell::ports`].
    ///
    /// # Errors
    /// When the system gives no pseudo-terminal or thread.
    pub fn start(&self, folder: &Path) -> io::Result<RunningCell> {
        let [left, right, probe] = DemoCell::ports(folder);
        Ok(RunningCell {
            left: self.start_profiler(0, Wire::pty(&left)?)?,
            right: self.start_profiler(1, Wire::pty(&right)?)?,
            probe: self.start_probe(Wire::pty(&probe)?)?,
        })
    }

    /// Starts one profiler on any wire: 0 is left, 1 is right.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start_profiler(&self, which: usize, wire: Wire) -> io::Result<SimulatedProfiler> {
        let sensor = &self.sensors[which];
        let setup = open_profile::Setup {
            paced: self.options.paced,
            faults: self.options.faults.clone(),
            ..open_profile::Setup::new(sensor.serial, sensor.view.seed)
        };
        SimulatedProfiler::start(wire, sensor.view.clone(), setup)
    }

    /// Starts the probe on any wire.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start_probe(&self, wire: Wire) -> io::Result<SimulatedProbe> {
        let setup = grbl::Setup {
            scene: Arc::clone(&self.part.made),
            machine_from_scene: self.machine_from_part,
            tip_radius_mm: TIP_RADIUS_MM,
            repeatability_mm: 0.001,
            seed: self.options.seed,
            paced: self.options.paced,
            faults: self.options.probe_faults.clone(),
        };
        SimulatedProbe::start(wire, setup)
    }
}

/// Up to the stated amounts, in any direction, about the middle of the part.
fn misplacement(rng: &mut ChaCha8Rng) -> Pose {
    let mut unit = || DVec3::from_array(UnitSphere.sample(rng));
    let (shift, axis) = (unit(), unit());
    let [distance, angle]: [f64; 2] = rng.random();
    let centre = DVec3::new(0.5 * PLATE_MM[0], 0.5 * PLATE_MM[1], PLATE_TOP_MM);
    Pose::shift(shift * distance * MISPLACED_MM).after(Pose::turn_about(
        centre,
        axis,
        angle * MISTURNED_RAD,
    ))
}

fn optics(camera_side: f64) -> Optics {
    let (near_mm, far_mm) = (STANDOFF_MM - 45.0, STANDOFF_MM + 45.0);
    Optics {
        near_mm,
        far_mm,
        width_mm: 96.0,
        // Nearly parallel, so that faces at the rim of the field are not seen at grazing incidence.
        fan: Fan::Diverging(-250.0),
        camera_mm: Optics::camera_at_angle(near_mm, far_mm, camera_side * 20_f64.to_radians()),
        spot_mm: 0.06,
        blend_mm: 0.5,
        noise_mm: 0.010,
        drop_out: 0.002,
        incidence_limit_rad: FRAC_PI_2 * 0.9,
        outliers: 0.0,
    }
}

/// Where a sensor that looks from a direction stands at encoder 0, and how many profiles it takes to pass the part.
///
/// The middle of the part comes to the middle of the field. The origin is rounded to 0.001 mm, so that a configuration can state it.
fn stand(from: DVec3) -> (Pose, u32) {
    let z = -from;
    let y = (AXIS - z * z.dot(AXIS)).normalize();
    let rotation = DMat3::from_cols(y.cross(z), y, z);
    // a part's point comes into the plane of the laser at (across, depth) after some travel
    let plane = DMat3::from_cols(rotation.x_axis, z, AXIS).inverse();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let heights = [LOWEST_SEEN_MM, PLATE_TOP_MM, TOP.range()[1]];
    for (i, z) in heights.into_iter().enumerate() {
        let length = if i == 2 { TOP.x[1] } else { PLATE_MM[0] };
        for (x, y) in [
            (0.0, 0.0),
            (length, 0.0),
            (0.0, PLATE_MM[1]),
            (length, PLATE_MM[1]),
        ] {
            let seen = plane * (FIXTURE_MM + DVec3::new(x, y, z));
            low = low.min(seen);
            high = high.max(seen);
        }
    }
    let middle = 0.5 * (low + high);
    let origin =
        rotation.x_axis * middle.x + z * (middle.y - STANDOFF_MM) + AXIS * (low.z - MARGIN_MM);
    let travel = high.z - low.z + 2.0 * MARGIN_MM;
    let profiles = (travel / (MM_PER_COUNT * STEP_COUNTS as f64)).ceil() as u32;
    let translation = (origin * 1000.0).round() / 1000.0;
    let pose = Pose {
        rotation,
        translation,
    };
    (pose, profiles)
}

fn touches(machine_from_fixture: &Pose) -> Vec<NominalTouch> {
    let [length, width] = PLATE_MM;
    // the tip starts this far from the face and may go as far beyond: more than the part can be off
    let reach = 6.0;
    [
        ("plate top", [42.0, 9.0, PLATE_TOP_MM], DVec3::Z),
        ("plate top", [72.0, 9.0, PLATE_TOP_MM], DVec3::Z),
        ("plate top", [56.0, 41.0, PLATE_TOP_MM], DVec3::Z),
        ("back", [44.0, width, 6.0], DVec3::Y),
        ("back", [70.0, width, 6.0], DVec3::Y),
        ("right", [length, 25.0, 6.0], DVec3::X),
    ]
    .map(|(face, point, normal)| {
        let point = DVec3::from(point);
        NominalTouch {
            face,
            point_in_part: point,
            normal_in_part: normal,
            start: machine_from_fixture.point(point + normal * (TIP_RADIUS_MM + reach)),
            target: machine_from_fixture.point(point + normal * (TIP_RADIUS_MM - reach)),
        }
    })
    .to_vec()
}

#[cfg(test)]
mod tests;
