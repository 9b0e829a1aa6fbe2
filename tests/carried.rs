//! Scans by a robot: what its poses make of the profiles, against scenes known exactly, and every pose that is missing accounted for.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use acies::acquire::lag::{Artefact, Lag, find_lag};
use acies::acquire::{
    Calibration, Carrier, CarrierPlan, Profiling, Scan, ScanEvent, ScanWatch, run_carried,
    scan_carried,
};
use acies::cell::{Daemon, DaemonOptions, Mode, Snapshot, State};
use acies::config::Cell;
use acies::geometry::RigidTransform;
use acies::points::PointCloud;
use acies::report::Report;
use acies::report::wire::Status;
use acies::store::{
    Order, Phase, ScanFileError, ScanReader, ScanWriter, Store, StoredCarrier, StoredView, Trigger,
};
use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::{Identity, Instrument, Losses, Profiler, Robot};
use acies_drivers::error::DeviceError;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::Recording;
use acies_simulators::carried::{Motion, eased};
use acies_simulators::demo_cell::DemoCell;
use acies_simulators::gocator::{Form, SimulatedGocator, Surface};
use acies_simulators::pose;
use acies_simulators::scene::{Scene, Solid, Surfaces};
use acies_simulators::sensor::{Fan, Optics, Traverse, View};
use acies_simulators::ur_rtde::SimulatedRobot;
use acies_simulators::wire::Wire;
use acies_simulators::{gocator, ur_rtde};
use glam::{DQuat, DVec3};

// ---- Devices that deliver what was worked out beforehand --------------------------------------------------------------

/// True motion of the tool in the robot's base, at true time: a curve, turning, looking down.
fn tool(t: f64) -> RigidTransform {
    let down = DQuat::from_rotation_x(std::f64::consts::PI);
    let turn = DQuat::from_rotation_y(0.15 * t) * DQuat::from_rotation_z(0.1 * t);
    RigidTransform::new(
        turn * down,
        DVec3::new(20.0 * (0.8 * t).sin(), 60.0 * t, 300.0 + 5.0 * t),
    )
}

const BASE: DVec3 = DVec3::new(-250.0, 30.0, 10.0);
const SECONDS: f64 = 2.0;

/// A clock of a device: what it shows at true time, s.
#[derive(Clone, Copy)]
struct Clock {
    offset_s: f64,
    ppm: f64,
}

impl Clock {
    fn at(self, true_s: f64) -> f64 {
        self.offset_s + true_s * (1.0 + 1e-6 * self.ppm)
    }
}

/// Delays that only ever add, with some next to nothing: a zigzag, and now and then a long one.
fn delay(k: usize) -> Duration {
    let us = match k % 7 {
        0 => 0,
        m => 90 * m as u64 * m as u64,
    };
    Duration::from_micros(us + if k % 97 == 11 { 60_000 } else { 0 })
}

fn identity() -> Identity {
    Identity {
        vendor: "v".into(),
        model: "m".into(),
        serial: "1".into(),
        firmware: "1".into(),
    }
}

struct Scripted<T> {
    items: std::vec::IntoIter<T>,
    identity: Identity,
    given: u64,
    lost: u64,
}

impl<T> Scripted<T> {
    fn new(items: Vec<T>, lost: u64) -> Scripted<T> {
        Scripted {
            items: items.into_iter(),
            identity: identity(),
            given: 0,
            lost,
        }
    }

    fn next_item(&mut self) -> Option<T> {
        let item = self.items.next();
        self.given += u64::from(item.is_some());
        item
    }

    fn account(&self) -> Losses {
        Losses {
            received: self.given,
            lost_on_link: self.lost,
            ..Losses::default()
        }
    }
}

impl Robot for Scripted<Pose> {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    fn next(&mut self, _: Instant) -> Result<Option<Pose>, DeviceError> {
        Ok(self.next_item())
    }

    fn stop(&mut self) -> Result<Vec<Pose>, DeviceError> {
        Ok(std::iter::from_fn(|| self.next_item()).collect())
    }

    fn losses(&self) -> Losses {
        self.account()
    }
}

impl Profiler for Scripted<Profile> {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    fn next(&mut self, _: Instant) -> Result<Option<Profile>, DeviceError> {
        Ok(self.next_item())
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        Ok(std::iter::from_fn(|| self.next_item()).collect())
    }

    fn losses(&self) -> Losses {
        self.account()
    }
}

/// Every 4 ms from before to after the profiles, without those in `skip`.
fn poses(clock: Clock, began: Instant, skip: std::ops::Range<usize>) -> Vec<Pose> {
    let n = (SECONDS / 0.004) as usize + 51;
    (0..n)
        .filter(|k| !skip.contains(k))
        .map(|k| {
            let true_s = 0.004 * k as f64;
            let pose = tool(true_s);
            Pose {
                device_time_s: clock.at(true_s),
                position_mm: pose.translation.into(),
                rotation: pose.rotation.to_scaled_axis().into(),
                host_time: began + Duration::from_secs_f64(true_s) + delay(k),
            }
        })
        .collect()
}

fn tool_from_sensor() -> RigidTransform {
    let turn = DQuat::from_rotation_z(0.3) * DQuat::from_rotation_x(0.1);
    RigidTransform::new(turn, DVec3::new(5.0, -12.0, 60.0))
}

/// Where a sensor's ray down its z, `x_mm` across, meets the machine's plane z = 0.
fn to_plane(machine_from_sensor: RigidTransform, x_mm: f64) -> f64 {
    let from = machine_from_sensor.point(DVec3::X * x_mm);
    let along = machine_from_sensor.vector(DVec3::Z);
    -from.z / along.z
}

/// A profile of the plane every 10 ms.
fn profiles(clock: Clock, began: Instant) -> Vec<Profile> {
    let base = RigidTransform::new(DQuat::IDENTITY, BASE);
    (0..(SECONDS / 0.01) as usize)
        .map(|k| {
            let true_s = 0.1 + 0.01 * k as f64;
            let machine_from_sensor = base * tool(true_s) * tool_from_sensor();
            let x_mm: Vec<f64> = (-20..=20).map(|i| 2.0 * f64::from(i)).collect();
            Profile {
                sequence: k as u32,
                boot: 0,
                device_time_ns: (clock.at(true_s) * 1e9).round() as u64,
                encoder: None,
                host_time: began + Duration::from_secs_f64(true_s) + delay(k + 3),
                dropped: 0,
                saturated: false,
                z_mm: x_mm
                    .iter()
                    .map(|x| to_plane(machine_from_sensor, *x))
                    .collect(),
                x_mm,
                intensity: Vec::new(),
            }
        })
        .collect()
}

fn plan() -> CarrierPlan {
    CarrierPlan {
        machine_from_base: RigidTransform::new(DQuat::IDENTITY, BASE),
        end_mm: tool(SECONDS + 0.15).translation,
        within_mm: 1.0,
        lag_s: 0.0,
        silence: Duration::from_millis(300),
    }
}

fn scripted(robot: Clock, sensor: Clock, skip: std::ops::Range<usize>) -> Scan {
    watched(robot, sensor, skip, &mut |_: ScanEvent| {})
}

fn watched(
    robot: Clock,
    sensor: Clock,
    skip: std::ops::Range<usize>,
    watch: &mut dyn ScanWatch,
) -> Scan {
    let began = Instant::now();
    let lost = skip.len() as u64;
    let calibration = Calibration {
        machine_from_sensor: tool_from_sensor(),
        travel_mm_per_count: DVec3::ZERO,
    };
    let profilers = vec![Profiling {
        name: "line".into(),
        profiler: Box::new(Scripted::new(profiles(sensor, began), 0)),
        calibration,
    }];
    let mut carrier = Carrier {
        name: "arm".into(),
        robot: Box::new(Scripted::new(poses(robot, began, skip), lost)),
        plan: plan(),
    };
    let (scan, _) = scan_carried(profilers, &mut carrier, watch).expect("a scan");
    scan
}

const ROBOT: Clock = Clock {
    offset_s: 4000.0,
    ppm: 40.0,
};
const SENSOR: Clock = Clock {
    offset_s: 77.0,
    ppm: -25.0,
};

#[test]
fn a_plane_seen_from_a_turning_tool_is_a_plane_in_the_machine() {
    let scan = scripted(ROBOT, SENSOR, 0..0);
    let view = &scan.views[0];
    assert!(view.complete && view.findings.is_empty(), "{view:?}");
    assert_eq!((view.unplaced, scan.cloud.positions.len()), (0, 200 * 41));
    // Between poses: the chord of a path that bends by a = 20 * 0.8^2 = 13 mm/s^2 leaves a t^2 / 8 = 26 nm, the same turning (0.18
    // rad/s, on a lever of 300 mm) 0.3 um; of time: both lines touch receipts without delay at both ends, which leaves the
    // nanoseconds of the stamps. The numbers of the profile are exact.
    for point in &scan.cloud.positions {
        assert!(point.z.abs() < 1e-3, "{point}");
    }
    assert!((scan.cloud.views[0].towards_sensor - DVec3::Z).length() < 0.35);
}

#[test]
fn profiles_where_poses_are_missing_are_left_out_and_counted() {
    let scan = scripted(ROBOT, SENSOR, 200..225);
    let view = &scan.views[0];
    // Poses 199 and 225 are there: times 0.796 and 0.900 s. Profiles from 0.80 to 0.89 s lie between; that at 0.90 s lies on a pose
    // or a rounding beside it.
    assert!((10..=11).contains(&view.unplaced), "{view:?}");
    assert!(view.complete);
    assert_eq!(view.findings.len(), 2);
    assert_eq!(
        view.findings[0],
        "arm: 25 poses missing by its clock, 0 rejected, 0 out of order, 526 used"
    );
    let left_out = format!(
        "line: {} profiles were left out where arm sent no poses; check its network and its load",
        view.unplaced
    );
    assert_eq!(view.findings[1], left_out);
    assert!(scan.cloud.positions.iter().all(|p| p.z.abs() < 1e-3));
    let placed = scan.cloud.positions.len() as u64 / 41;
    assert_eq!(placed + view.unplaced, view.losses.received);
}

#[test]
fn a_clock_that_is_none_places_nothing() {
    let stopped = Clock {
        offset_s: 0.0,
        ppm: -1e6,
    };
    let scan = scripted(ROBOT, stopped, 0..0);
    assert!(scan.cloud.positions.is_empty() && !scan.views[0].complete);
    assert_eq!(
        scan.views[0].findings,
        ["line: 200 profiles without a usable time were left out; check that line's clock is on"]
    );
}

/// Writes a run into its file.
struct Writing(ScanWriter);

impl ScanWatch for Writing {
    fn event(&mut self, _: ScanEvent) {}

    fn profile(&mut self, view: usize, profile: &Profile, _: &[DVec3]) {
        self.0.push(view, profile).expect("written");
    }

    fn pose(&mut self, pose: &Pose) {
        self.0.push_pose(pose).expect("written");
    }
}

#[test]
fn the_points_of_a_run_by_a_robot_come_back_from_its_file_to_the_bit() {
    let folder = std::env::temp_dir().join(format!("acies-poses-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    let store = Store::open(&folder).expect("a store");
    let order = Order::default();
    let trigger = Trigger {
        order: &order,
        operator: "anna",
        key: None,
        simulated: true,
    };
    let now = SystemTime::now();
    let (inspection, _) = store.queue(&trigger, now).expect("queued");
    let begun = store.begin(inspection.id, None, "1.raw", now);
    begun.expect("begun");
    let path = folder.join("scans/1.raw");
    let plan = plan();
    let view = StoredView {
        device: "line".into(),
        identity: identity(),
        calibration: Calibration {
            machine_from_sensor: tool_from_sensor(),
            travel_mm_per_count: DVec3::ZERO,
        },
        carried: true,
        carrier: Some(StoredCarrier {
            machine_from_base: plan.machine_from_base,
            lag_s: plan.lag_s,
        }),
    };
    let writer = ScanWriter::create(&path, std::slice::from_ref(&view)).expect("a file");
    let mut watch = Writing(writer);
    let scan = watched(ROBOT, SENSOR, 200..225, &mut watch);
    watch.0.finish(true).expect("finished");
    let bits = |cloud: &PointCloud| {
        let numbers = cloud.positions.iter().flat_map(|p| p.to_array());
        numbers.map(f64::to_bits).collect::<Vec<_>>()
    };
    let read = || {
        let reader = ScanReader::open(&path).expect("a reader");
        assert_eq!(reader.views(), std::slice::from_ref(&view));
        reader.into_cloud().expect("points")
    };
    let again = read();
    assert!(scan.cloud.positions.len() > 180 * 41);
    assert_eq!(bits(&again), bits(&scan.cloud));
    assert_eq!(
        (&again.origins, &again.views),
        (&scan.cloud.origins, &scan.cloud.views)
    );
    // A daemon that ended before it noted the file writes it anew.
    let mended = store.recover("the daemon ended", now).expect("mended");
    assert_eq!(mended[0].scan_whole, Some(true));
    assert_eq!(bits(&read()), bits(&scan.cloud));

    // A file of before has no poses, and says so.
    let old = StoredView {
        carrier: None,
        ..view
    };
    let path = folder.join("old.raw");
    let mut writer = ScanWriter::create(&path, &[old]).expect("a file");
    let profile = &profiles(SENSOR, Instant::now())[0];
    writer.push(0, profile).expect("written");
    writer.finish(true).expect("finished");
    let reader = ScanReader::open(&path).expect("a reader");
    let error = reader.into_cloud().expect_err("no poses");
    assert!(matches!(error, ScanFileError::Carried { .. }), "{error}");
    let _ = std::fs::remove_dir_all(&folder);
}

// ---- Simulated devices over the network -------------------------------------------------------------------------------

/// A plate and a block on it, in the machine: x and y as low and high corners, and the height of the top.
const PLATE: [DVec3; 2] = [DVec3::new(90.0, 60.0, 0.0), DVec3::new(210.0, 260.0, 40.0)];
const BLOCK: [DVec3; 2] = [
    DVec3::new(120.0, 110.0, 40.0),
    DVec3::new(180.0, 180.0, 65.0),
];

fn scene() -> Scene {
    let mut surfaces = Surfaces::default();
    let (plate, _) = surfaces.cuboid("plate", PLATE[0], PLATE[1]);
    let (block, _) = surfaces.cuboid("block", BLOCK[0], BLOCK[1]);
    Scene::new(surfaces, Solid::any([plate, block]))
}

/// Distance of a point from the surface of a box.
fn from_box([low, high]: [DVec3; 2], p: DVec3) -> f64 {
    let beyond = (low - p).max(p - high);
    let outside = beyond.max(DVec3::ZERO).length();
    outside + beyond.max_element().min(0.0)
}

/// Distance of a point from the surface of what is seen.
fn from_surface(p: DVec3) -> f64 {
    from_box(PLATE, p).min(from_box(BLOCK, p)).abs()
}

const SPEED_MM_S: f64 = 80.0;
const TURN_RAD: f64 = 0.1;

/// Along the machine's y over the block, looking down, turning a little; base of the robot as in the example cell.
fn motion() -> Motion {
    let seconds = 1.25 * 200.0 / SPEED_MM_S;
    Motion::new(move |t| {
        let share = eased(t / seconds);
        let down = pose::Pose::turn_about(DVec3::ZERO, DVec3::X, std::f64::consts::PI);
        let turn = pose::Pose::turn_about(DVec3::ZERO, DVec3::Y, TURN_RAD * (share - 0.5));
        let place = pose::Pose::shift(DVec3::new(400.0, 50.0 + 200.0 * share, 300.0));
        place.after(turn).after(down)
    })
}

fn view() -> View {
    View {
        scene: Arc::new(scene()),
        // The motion is in the base's frame, the scene in the machine's.
        machine_from_scene: pose::Pose::shift(DVec3::X * 250.0),
        machine_from_sensor: pose::Pose::shift(DVec3::Z * 60.0),
        optics: Optics {
            near_mm: 120.0,
            far_mm: 260.0,
            width_mm: 100.0,
            fan: Fan::Parallel,
            camera_mm: DVec3::new(0.0, 100.0, 0.0),
            spot_mm: 0.0,
            blend_mm: 0.5,
            noise_mm: 0.0,
            drop_out: 0.0,
            incidence_limit_rad: 1.4,
            outliers: 0.0,
        },
        traverse: Traverse {
            axis: DVec3::Y,
            mm_per_count: 1.0,
            first_count: 0,
            step_counts: 1,
            profiles: u32::MAX,
        },
        columns: 100,
        seed: 5,
    }
}

/// The example cell against simulated devices with these faults of the robot.
fn simulated(faults: &str) -> (Scan, ur_rtde::Truth) {
    let motion = Arc::new(motion());
    let mut robot = ur_rtde::Setup::new(Arc::clone(&motion), 9);
    robot.faults = faults.parse().expect("the test's faults");
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let robot = SimulatedRobot::start(wire, robot).expect("a robot");
    let line = gocator::Setup {
        form: Form::PointCloud,
        rate_hz: Some(100.0),
        ..gocator::Setup::new(13_434, Surface::Carried(Box::new(view()), motion))
    };
    let line = SimulatedGocator::start(line).expect("a sensor");
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/ur-rtde/cell.toml");
    let text = std::fs::read_to_string(&path).expect("the example cell");
    let text = text
        .replace("192.168.1.30", robot.port())
        .replace("address = \"192.168.1.10\"", &line.keys())
        .replace("silence_s = 5.0", "silence_s = 1.0");
    let cell = Cell::parse(&text, &path).unwrap_or_else(|errors| panic!("{errors}"));
    let profilers = cell.profilers.iter().map(|config| {
        let Ok(Instrument::Profiler(profiler)) = config.setup.open(&Cable) else {
            panic!("no profiler");
        };
        Profiling {
            name: config.name.clone(),
            profiler,
            calibration: config.calibration,
        }
    });
    let profilers = profilers.collect();
    let config = cell.carrier.as_ref().expect("a carrier");
    let Ok(Instrument::Robot(arm)) = config.setup.open(&Cable) else {
        panic!("no robot");
    };
    let mut carrier = Carrier {
        name: config.name.clone(),
        robot: arm,
        plan: config.plan,
    };
    let (scan, _) = scan_carried(profilers, &mut carrier, &mut |_: ScanEvent| {}).expect("a scan");
    (scan, robot.truth())
}

/// What the two links' least delays may differ by on a busy machine, s. It moves a point along the path by this much of the speed, and by
/// the turning on the lever from tool to part; 10 um are the sensor's counts and the chords.
const LEAST_DELAY_S: f64 = 2e-3;

fn tolerance_mm() -> f64 {
    let seconds = 1.25 * 200.0 / SPEED_MM_S;
    let turning = 1.25 * TURN_RAD / seconds * 260.0;
    LEAST_DELAY_S * (SPEED_MM_S + turning) + 0.01
}

#[test]
fn a_block_scanned_by_a_simulated_robot_stands_where_it_stands() {
    let (scan, truth) = simulated("drift-ppm=60");
    let view = &scan.views[0];
    assert!(view.complete, "{:?}", view.findings);
    let placed = view.losses.received - view.unplaced;
    assert!(placed > 200, "{view:?}");
    let far: Vec<f64> = scan
        .cloud
        .positions
        .iter()
        .map(|p| from_surface(*p))
        .collect();
    let worst = far.iter().copied().fold(0.0, f64::max);
    let rms = (far.iter().map(|d| d * d).sum::<f64>() / far.len() as f64).sqrt();
    assert!(
        worst < tolerance_mm(),
        "worst {worst:.4} mm, rms {rms:.4} mm"
    );
    assert!(far.len() > 10_000);
    // The block's far and near sides are seen only as edges of its top: the points on the top end where the block ends.
    let top = scan
        .cloud
        .positions
        .iter()
        .filter(|p| (p.z - 65.0).abs() < 0.05);
    let (low, high) = top.fold((f64::MAX, f64::MIN), |(l, h), p| (l.min(p.y), h.max(p.y)));
    // One profile at 100 Hz beside the tolerance.
    let step = SPEED_MM_S / 100.0;
    assert!((low - 110.0).abs() < step + tolerance_mm(), "{low}");
    assert!((high - 180.0).abs() < step + tolerance_mm(), "{high}");
    assert!(!truth.running, "the stream was paused");
}

#[test]
fn skipped_poses_leave_gaps_and_nothing_is_made_up() {
    // Of a third of the poses, one in nine gaps is three cycles and more.
    let (scan, truth) = simulated("drop=0.33");
    let view = &scan.views[0];
    assert!(view.complete, "{:?}", view.findings);
    assert!(view.unplaced > 5, "{view:?}");
    let skipped = truth
        .cycles
        .iter()
        .filter(|c| c.1 == ur_rtde::Fate::Skipped);
    assert!(skipped.count() > 300);
    let mut placed: Vec<u32> = scan.cloud.origins.iter().map(|o| o.profile).collect();
    placed.dedup();
    // Profiles in which nothing was seen have no points and are placed all the same.
    assert!(placed.len() as u64 + view.unplaced <= view.losses.received);
    for point in &scan.cloud.positions {
        assert!(from_surface(*point) < tolerance_mm(), "{point}");
    }
}

#[test]
fn a_robot_that_is_lost_leaves_the_scan_incomplete_with_what_came_before() {
    let (scan, _) = simulated("unplug-after=900");
    let view = &scan.views[0];
    assert!(!view.complete && !scan.cloud.positions.is_empty());
    assert!(
        view.findings[0].starts_with("arm: lost during the scan: ")
            && view.findings[0]
                .ends_with("it is gone: closed or unplugged; plug it in again and reopen"),
        "{:?}",
        view.findings
    );
}

// ---- The lag ----------------------------------------------------------------------------------------------------------

/// To and fro over 120 mm in four seconds, at up to 94 mm/s, or only there; the tool looks down.
fn to_and_fro(t: f64, back: bool) -> RigidTransform {
    let end = if back { 4.0 } else { 2.0 };
    let share = 0.5 - 0.5 * (std::f64::consts::PI * t.clamp(0.0, end) / 2.0).cos();
    let down = DQuat::from_rotation_x(std::f64::consts::PI);
    RigidTransform::new(down, DVec3::new(0.0, 120.0 * share, 300.0))
}

/// What a ray meets.
#[derive(Clone, Copy)]
enum Target {
    Sphere(DVec3, f64),
    /// A plane through a point.
    Plane(DVec3, DVec3),
}

fn meets(target: Target, from: DVec3, along: DVec3) -> f64 {
    match target {
        Target::Plane(point, normal) => (point - from).dot(normal) / along.dot(normal),
        Target::Sphere(centre, radius) => {
            let (to, half) = (centre - from, (centre - from).dot(along));
            let inside = radius * radius - (to.length_squared() - half * half);
            if inside < 0.0 {
                return f64::NAN;
            }
            half - inside.sqrt()
        }
    }
}

/// Noise of 10 um, the same every time.
fn noise_mm(k: usize) -> f64 {
    let mixed = (k as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (k as u64) << 17;
    let uniform = (mixed.wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 11) as f64 / (1_u64 << 53) as f64;
    0.010 * 12_f64.sqrt() * (uniform - 0.5)
}

/// The lag that is found where profiles reach the host `late` after they are taken, and poses at once.
fn lag_of(target: Target, artefact: Artefact, late: Duration, back: bool) -> Result<Lag, String> {
    let began = Instant::now();
    let base = RigidTransform::new(DQuat::IDENTITY, BASE);
    let seconds = if back { 4.0 } else { 2.0 };
    let poses = (0..(seconds / 0.004) as usize + 60).map(|k| {
        let true_s = 0.004 * k as f64;
        let pose = to_and_fro(true_s, back);
        Pose {
            device_time_s: ROBOT.at(true_s),
            position_mm: pose.translation.into(),
            rotation: pose.rotation.to_scaled_axis().into(),
            host_time: began + Duration::from_secs_f64(true_s) + delay(k),
        }
    });
    let profiles = (0..(seconds / 0.01) as usize - 20).map(|k| {
        let true_s = 0.1 + 0.01 * k as f64;
        let machine_from_sensor = base * to_and_fro(true_s, back) * tool_from_sensor();
        let along = machine_from_sensor.vector(DVec3::Z);
        let x_mm: Vec<f64> = (-20..=20).map(f64::from).collect();
        let z = |(i, x): (usize, &f64)| {
            let from = machine_from_sensor.point(DVec3::X * *x);
            meets(target, from, along) + noise_mm(41 * k + i)
        };
        Profile {
            sequence: k as u32,
            boot: 0,
            device_time_ns: (SENSOR.at(true_s) * 1e9).round() as u64,
            encoder: None,
            host_time: began + Duration::from_secs_f64(true_s) + delay(k + 3) + late,
            dropped: 0,
            saturated: false,
            z_mm: x_mm.iter().enumerate().map(z).collect(),
            x_mm,
            intensity: Vec::new(),
        }
    });
    let mut profilers = [Profiling {
        name: "line".into(),
        profiler: Box::new(Scripted::new(profiles.collect(), 0)),
        calibration: Calibration {
            machine_from_sensor: tool_from_sensor(),
            travel_mm_per_count: DVec3::ZERO,
        },
    }];
    let mut carrier = Carrier {
        name: "arm".into(),
        robot: Box::new(Scripted::new(poses.collect::<Vec<Pose>>(), 0)),
        plan: CarrierPlan {
            end_mm: to_and_fro(seconds, back).translation,
            ..plan()
        },
    };
    let run = run_carried(&mut profilers, &mut carrier, &mut |_: ScanEvent| {}).expect("a run");
    assert_eq!(run.broken(&profilers, &carrier), None);
    let pass = run.pass(0, &profilers[0], &carrier).expect("clocks");
    find_lag(&[pass], artefact).map_err(|error| error.to_string())
}

#[test]
fn the_lag_of_late_profiles_is_found_over_a_sphere_and_an_inclined_plate() {
    // Below the path's middle, seen from all sides of its cap; the plate leans along the path.
    let sphere = Target::Sphere(BASE + DVec3::new(0.0, 60.0, 40.0), 15.0);
    let lean = DVec3::new(0.05, 0.4, 1.0).normalize();
    let plate = Target::Plane(BASE + DVec3::new(0.0, 60.0, 40.0), lean);
    let of_15_mm = Artefact::Sphere { radius_mm: 14.5 };
    for late_us in [0, 700, 8_000, 45_000] {
        for (target, artefact) in [(sphere, of_15_mm), (plate, Artefact::Plate)] {
            let late = Duration::from_micros(late_us);
            let lag = lag_of(target, artefact, late, true).expect("a lag");
            let error_s = lag.lag_s + late.as_secs_f64();
            // Beside the noise: the chord between poses of 4 ms, a t^2 / 8 = 0.3 um at 148 mm/s^2, over 50 mm/s and more.
            let allowed_s = 3.0 * lag.u_s + 6e-6;
            assert!(
                error_s.abs() < allowed_s,
                "{late_us} us, {artefact:?}: {lag:?}"
            );
            assert!(lag.u_s < 2e-5 && lag.rms_mm < 0.012, "{lag:?}");
        }
    }
}

#[test]
fn a_lag_that_nothing_shows_is_said_to_be_open() {
    let sphere = Target::Sphere(BASE + DVec3::new(0.0, 60.0, 40.0), 15.0);
    let level = Target::Plane(BASE + DVec3::new(0.0, 60.0, 40.0), DVec3::Z);
    let told = lag_of(level, Artefact::Plate, Duration::ZERO, true).expect_err("nothing shows it");
    assert!(told.starts_with("the lag stays open"), "{told}");
    // One way only: a lag shows in no more than the form, by the speed that changes, and the uncertainty says so.
    let of_15_mm = Artefact::Sphere { radius_mm: 15.0 };
    let one_way = lag_of(sphere, of_15_mm, Duration::ZERO, false).expect("a lag");
    let both = lag_of(sphere, of_15_mm, Duration::ZERO, true).expect("a lag");
    assert!(one_way.lag_s.abs() < 3.0 * one_way.u_s, "{one_way:?}");
    assert!(one_way.u_s > 10.0 * both.u_s, "{one_way:?} {both:?}");
    let none = lag_of(
        level,
        Artefact::Sphere { radius_mm: 15.0 },
        Duration::ZERO,
        true,
    );
    let told = none.expect_err("no sphere");
    assert!(told.contains("no sphere of radius 15 mm among"), "{told}");
}

/// How old the sensor's picture is when it is stamped, s.
const OLD_S: f64 = 0.020;

/// A ball under a robot that first rests and then goes to and fro every six seconds, and a sensor whose picture of it is [`OLD_S`] old: the cell's file, and the devices
/// that must live.
fn lagging_cell(test: &str, rests_s: f64) -> (std::path::PathBuf, impl Sized) {
    let path = move |t: f64| {
        let within = (t - rests_s).max(0.0) % 6.0;
        let down = pose::Pose::turn_about(DVec3::ZERO, DVec3::X, std::f64::consts::PI);
        let there = eased(within / 2.0) - eased((within - 2.0) / 2.0);
        pose::Pose::shift(DVec3::new(400.0, 100.0 + 100.0 * there, 300.0)).after(down)
    };
    let (tool, seen) = (
        Arc::new(Motion::new(path)),
        Arc::new(Motion::new(move |t| path(t - OLD_S))),
    );
    let mut surfaces = Surfaces::default();
    let (ball, _) = surfaces.sphere("ball", DVec3::new(150.0, 150.0, 50.0), 20.0);
    let view = View {
        scene: Arc::new(Scene::new(surfaces, ball)),
        ..view()
    };
    let mut robot = ur_rtde::Setup::new(Arc::clone(&tool), 9);
    robot.go_after = None;
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let robot = SimulatedRobot::start(wire, robot).expect("a robot");
    let line = SimulatedGocator::start(gocator::Setup {
        form: Form::PointCloud,
        rate_hz: Some(200.0),
        ..gocator::Setup::new(13_434, Surface::Carried(Box::new(view), Arc::clone(&seen)))
    })
    .expect("a sensor");
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(test);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let example = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let text =
        std::fs::read_to_string(example.join("ur-rtde/cell.toml")).expect("the example cell");
    let nominal = example.join("demo/part.step").display().to_string();
    let text = text
        .replace("../demo/part.step", &nominal)
        .replace("192.168.1.30", robot.port())
        .replace("address = \"192.168.1.10\"", &line.keys())
        .replace(
            "end_mm = [400.0, 250.0, 300.0]",
            "end_mm = [400.0, 100.0, 300.0]",
        );
    let cell = folder.join("cell.toml");
    std::fs::write(&cell, text).expect("a cell");
    let now = Instant::now();
    tool.go(now);
    seen.go(now);
    (cell, (robot, line))
}

fn acies(arguments: &[&str]) -> std::process::Output {
    std::process::Command::new(env!("CARGO_BIN_EXE_acies"))
        .args(arguments)
        .output()
        .expect("the program")
}

/// The lag that the program printed, where it found one.
fn printed_lag(run: &std::process::Output) -> (f64, f64, usize) {
    let told = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{told}");
    let lag: serde_json::Value = serde_json::from_slice(&run.stdout).expect("JSON");
    let number = |key: &str| lag[key].as_f64().expect("a number");
    let passes = lag["passes"].as_array().expect("passes").len();
    (number("lag_s"), number("u_s"), passes)
}

/// Everything goes by the clock: where this machine is busy otherwise the program says that the lag stays open, and is asked again.
fn asked_again(mut ask: impl FnMut(usize) -> std::process::Output) -> std::process::Output {
    let open = |run: &std::process::Output| {
        String::from_utf8_lossy(&run.stderr).contains("the lag stays open")
    };
    let mut run = ask(0);
    for again in 1..3 {
        if open(&run) {
            run = ask(again);
        }
    }
    run
}

#[test]
fn the_command_finds_the_lag_of_simulated_devices() {
    // It rests until the program has opened the devices.
    let (cell, _devices) = lagging_cell("lag", 4.0);
    let cell = cell.display().to_string();
    let run =
        asked_again(|_| acies(&["calibrate", "--lag", "2", "--radius", "20", "--json", &cell]));
    let told = String::from_utf8_lossy(&run.stderr);
    assert!(
        told.contains("pass 2 of 2: start the robot's program"),
        "{told}"
    );
    let (lag_s, u_s, passes) = printed_lag(&run);
    // What the two links' least delays may differ by.
    assert!((lag_s + OLD_S).abs() < LEAST_DELAY_S, "{lag_s}");
    assert!(u_s < LEAST_DELAY_S && passes == 2, "{u_s}");
}

/// Recorded today, found tomorrow: from the files alone, the same bits every time, and only where both devices were recorded by one clock.
#[test]
fn the_command_finds_the_lag_in_recordings() {
    let (cell, devices) = lagging_cell("lag-recorded", 0.0);
    let folder = cell.parent().expect("its folder").to_owned();
    let cell = cell.display().to_string();
    let pass = |name: String| folder.join(name).display().to_string();
    let calibrate = |folders: &[&str]| {
        let mut arguments = vec!["calibrate", &cell, "--radius", "20", "--json"];
        let each = folders
            .iter()
            .flat_map(|folder| ["--lag-recording", folder]);
        arguments.extend(each);
        acies(&arguments)
    };
    let mut folders = Vec::new();
    let run = asked_again(|again| {
        folders = ["a", "b"].map(|of| pass(format!("{of}-{again}"))).to_vec();
        for folder in &folders {
            let run = acies(&["record", &cell, "--all", "--seconds", "6.5", "-o", folder]);
            let (said, told) = (
                String::from_utf8_lossy(&run.stdout),
                String::from_utf8_lossy(&run.stderr),
            );
            let whole = run.status.success() && said.contains(" poses; missing");
            assert!(whole, "{said}{told}");
        }
        calibrate(&[&folders[0], &folders[1]])
    });
    drop(devices);
    let (lag_s, u_s, passes) = printed_lag(&run);
    assert!((lag_s + OLD_S).abs() < LEAST_DELAY_S, "{lag_s}");
    assert!(u_s < LEAST_DELAY_S && passes == 2, "{u_s}");
    assert_eq!(calibrate(&[&folders[0], &folders[1]]).stdout, run.stdout);
    // The robot of the one pass and the profiler of the other.
    let mixed = pass("mixed".into());
    std::fs::create_dir_all(&mixed).expect("a folder");
    for (number, folder) in folders.iter().enumerate() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let recording = Recording::read(&path).expect("a recording");
            let of_robot = recording.note("device ").as_deref() == Some("arm");
            if of_robot == (number == 0) {
                let name = path.file_name().expect("a name");
                std::fs::copy(&path, std::path::Path::new(&mixed).join(name)).expect("a copy");
            }
        }
    }
    let told = calibrate(&[&mixed]);
    let told = String::from_utf8_lossy(&told.stderr).into_owned();
    assert!(told.contains("were not recorded at once"), "{told}");
    let empty = pass("empty".into());
    std::fs::create_dir_all(&empty).expect("a folder");
    let told = calibrate(&[&empty]);
    let told = String::from_utf8_lossy(&told.stderr).into_owned();
    assert!(told.contains("0 recordings of arm, expected one"), "{told}");
}

// ---- A whole inspection -----------------------------------------------------------------------------------------------

/// Of the robot over the part, mm/s: slow, so that what the links' delays differ by is little.
const CAREFUL_MM_S: f64 = 20.0;

/// The demo's part, its two sensors side by side on a robot's tool, and its probe: the cell, and the devices that must live.
fn robot_cell(folder: &std::path::Path) -> (Cell, impl Sized) {
    let demo = DemoCell::new(3);
    let way = DVec3::Y * 100.0;
    let motion = Arc::new(Motion::straight(pose::Pose::IDENTITY, way, CAREFUL_MM_S));
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let robot = SimulatedRobot::start(wire, ur_rtde::Setup::new(Arc::clone(&motion), 9));
    let robot = robot.expect("a robot");
    let lines = [0, 1].map(|which| {
        let view = Box::new(demo.sensors[which].view.clone());
        SimulatedGocator::start(gocator::Setup {
            form: Form::PointCloud,
            rate_hz: Some(50.0),
            ..gocator::Setup::new(
                100 + which as u32,
                Surface::Carried(view, Arc::clone(&motion)),
            )
        })
        .expect("a sensor")
    });
    let port = folder.join("ttyPROBE");
    let probe = demo
        .start_probe(Wire::pty(&port).expect("a port"))
        .expect("a probe");
    let configs = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["recipe.toml", "part.step"] {
        std::fs::copy(configs.join(file), folder.join(file)).expect("the demo's file");
    }
    let text = std::fs::read_to_string(configs.join("cell.toml")).expect("the demo's cell");
    let (head, _) = text
        .split_once("# How the profilers move")
        .expect("its stage");
    let (_, tail) = text.split_once("name = \"probe\"").expect("its probe");
    let tail = tail.replace("./dev/ttyPROBE", &port.display().to_string());
    let frame = |at: pose::Pose| {
        let pose::Pose {
            rotation: r,
            translation: t,
        } = at;
        format!(
            "origin_mm = {:?}\nx_axis = {:?}\nz_axis = {:?}\n",
            t.to_array(),
            r.x_axis.to_array(),
            r.z_axis.to_array()
        )
    };
    let mut cell = format!(
        "{head}[[device]]\nname = \"arm\"\ndriver = \"ur-rtde\"\naddress = \"{}\"\n[device.carrier]\nend_mm = {:?}\nwithin_mm = 0.5\n\
         silence_s = 5.0\n[device.carrier.machine_from_base]\n{}",
        robot.port(),
        way.to_array(),
        frame(pose::Pose::IDENTITY)
    );
    for (line, sensor) in lines.iter().zip(&demo.sensors) {
        cell += &format!(
            "[[device]]\nname = \"{}\"\ndriver = \"gocator\"\n{}\nfirst_frame = 0\n[device.calibration]\n{}",
            sensor.name,
            line.keys(),
            frame(sensor.stated_machine_from_sensor)
        );
    }
    cell += &format!("[[device]]\nname = \"probe\"{tail}");
    let path = folder.join("cell.toml");
    std::fs::write(&path, cell).expect("a cell");
    let cell = Cell::read(&path).unwrap_or_else(|errors| panic!("{errors}"));
    (cell, (robot, lines, probe))
}

#[test]
fn a_part_under_a_robot_is_inspected_from_touch_to_verdict() {
    let folder = std::env::temp_dir().join(format!("acies-carried-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let (cell, devices) = robot_cell(&folder);
    let store = Arc::new(Store::open(&folder.join("store")).expect("a store"));
    let options = DaemonOptions {
        simulated: true,
        ..DaemonOptions::default()
    };
    let daemon = Daemon::start(Arc::new(cell), store, Arc::new(Cable), options).expect("a daemon");
    let handle = daemon.handle();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let runtime = runtime.expect("a runtime");
    let until = |is_so: &dyn Fn(&Snapshot) -> bool| {
        let mut follow = handle.follow();
        let waited = runtime.block_on(async {
            let wait = follow.wait_for(|snapshot| is_so(snapshot));
            let limit = Duration::from_secs(300);
            tokio::time::timeout(limit, wait)
                .await
                .map(|found| drop(found.expect("a daemon")))
        });
        assert!(waited.is_ok(), "never so: {:#?}", handle.snapshot());
    };
    until(&|snapshot| snapshot.state == State::Ready);
    let order = Order {
        part_serial: "R-1".into(),
        ..Order::default()
    };
    let (asked, _) = runtime
        .block_on(handle.start(order, "anna", None, Mode::Single))
        .map_err(|(refusal, _)| refusal)
        .expect("taken");
    until(&|snapshot| {
        let work = snapshot
            .acquiring
            .iter()
            .chain(&snapshot.computing)
            .chain(&snapshot.queue);
        !work.into_iter().any(|job| job.id == asked.id)
    });
    let ended = handle
        .store()
        .inspection(asked.id)
        .expect("it is in the history");
    assert_eq!(ended.phase, Phase::Done, "{}", ended.reason);
    let raw = handle.store().scan_path(asked.id).expect("raw data");
    let reader = ScanReader::open(&raw).expect("a reader");
    let cloud = reader.into_cloud().expect("points");
    assert_eq!(ended.points, Some(cloud.positions.len() as i64));
    let report: Report =
        serde_json::from_str(&handle.store().report_json(asked.id).expect("a report"))
            .expect("JSON");
    // The defects that were made, found from a robot: the wall's offset of 60 um at both of its edges, a good edge where one was made.
    assert_eq!(report.verdict, Status::NotOk, "{}", report.reason);
    assert_eq!(report.alignment.status, Status::Ok, "{}", report.reason);
    assert!(
        report.missing_edges.is_empty(),
        "{:?}",
        report.missing_edges
    );
    let edge = |entity| {
        let found = report
            .edges
            .iter()
            .find(|edge| edge.nominal_entity == entity);
        &found.expect("an edge of the part").summary
    };
    // What the two views' times differ by, at this speed; 5 um are the demo's own.
    let allowed_mm = 0.005 + 0.5 * LEAST_DELAY_S * CAREFUL_MM_S;
    let near = |found: Option<acies::report::wire::Spread>, made_mm: f64| {
        let mean = found.expect("measured").mean;
        assert!(
            (mean - made_mm).abs() < allowed_mm,
            "{mean} mm, made {made_mm} mm"
        );
    };
    near(edge(237).d1_mm, 0.060);
    near(edge(181).d2_mm, 0.060);
    near(edge(237).d2_mm, 0.0);
    near(edge(337).d1_mm, 0.0);
    let names: Vec<&str> = report
        .devices
        .iter()
        .map(|device| device.name.as_str())
        .collect();
    assert!(
        names.contains(&"left") && names.contains(&"right"),
        "{names:?}"
    );
    drop((handle, daemon, devices));
    let _ = std::fs::remove_dir_all(&folder);
}
