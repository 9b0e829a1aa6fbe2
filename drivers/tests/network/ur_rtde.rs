//! The RTDE driver against the simulated controller.

use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_drivers::capture::Pose;
use acies_drivers::device::{Instrument, Presence, Robot};
use acies_drivers::error::DeviceError;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::{Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_simulators::carried::{Motion, eased};
use acies_simulators::pose;
use acies_simulators::ur_rtde::{Fate, Setup, SimulatedRobot};
use acies_simulators::wire::Wire;
use glam::DVec3;

use crate::support::{Hostile, SOON, open, refusal, setup, text};

/// Way and time of the motion.
const WAY_MM: f64 = 40.0;
const SECONDS: f64 = 0.5;

fn motion() -> Arc<Motion> {
    Arc::new(Motion::new(|t| {
        let turn = pose::Pose::turn_about(DVec3::ZERO, DVec3::Y, 0.2 * eased(t / SECONDS));
        pose::Pose {
            translation: DVec3::new(WAY_MM * eased(t / SECONDS), -200.0, 300.0),
            ..turn
        }
    }))
}

fn simulated(faults: &str) -> SimulatedRobot {
    let mut setup = Setup::new(motion(), 3);
    setup.faults = faults.parse().expect("the test's faults");
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    SimulatedRobot::start(wire, setup).expect("a simulated robot")
}

fn start(faults: &str) -> (SimulatedRobot, Box<dyn Robot>) {
    let device = simulated(faults);
    let table = format!("address = \"{}\"", device.port());
    match open("ur-rtde", &table) {
        Ok(Instrument::Robot(robot)) => (device, robot),
        Ok(_) => panic!("no robot"),
        Err(error) => panic!("{}", text(&error)),
    }
}

fn take(robot: &mut dyn Robot, n: usize) -> Result<Vec<Pose>, DeviceError> {
    robot.start()?;
    let mut poses = Vec::new();
    while poses.len() < n {
        poses.extend(robot.next(Instant::now() + SOON)?);
    }
    poses.extend(robot.stop()?);
    Ok(poses)
}

#[test]
fn poses_are_those_of_the_motion_at_the_robots_time() {
    let (device, mut robot) = start("");
    assert_eq!(robot.identity().firmware, "5.12.2.1101373");
    let poses = take(robot.as_mut(), 500).expect("500 poses");
    let truth = device.truth();
    assert!(!truth.running);
    let first = truth.cycles[0].0;
    // It sets off 300 ms after the start.
    let at = |time_s: f64| eased((time_s - first - 0.3) / SECONDS);
    for pose in &poses {
        let share = at(pose.device_time_s);
        // Half a nanosecond of rounding at 160 mm/s, and the metre's double.
        assert!((pose.position_mm[0] - WAY_MM * share).abs() < 1e-6);
        assert!((pose.position_mm[2] - 300.0).abs() < 1e-9);
        assert!((pose.rotation[1] - 0.2 * share).abs() < 1e-8);
    }
    assert_eq!(poses.last().map(|p| p.position_mm[0]), Some(WAY_MM));
    let losses = robot.losses();
    assert_eq!(
        (losses.received, losses.lost_on_link),
        (poses.len() as u64, 0)
    );
}

#[test]
fn skipped_damaged_and_doubled_packages_are_counted() {
    let faults = "drop=0.03,truncate=0.02,sentinel=0.02,duplicate=0.05,chatter=0.05,split";
    let (device, mut robot) = start(faults);
    let poses = take(robot.as_mut(), 400).expect("400 poses");
    let cycles = device.truth().cycles;
    let place = |time_s: f64| cycles.iter().position(|c| (c.0 - time_s).abs() < 1e-6);
    let places: Vec<usize> = poses
        .iter()
        .map(|pose| place(pose.device_time_s).expect("a cycle of the robot"))
        .collect();
    assert!(places.windows(2).all(|pair| pair[0] < pair[1]));
    assert!(places.iter().all(|&i| cycles[i].1 == Fate::Sent));
    let within = &cycles[places[0]..=places[places.len() - 1]];
    let missing = within.iter().filter(|c| c.1 != Fate::Sent).count() as u64;
    let losses = robot.losses();
    assert_eq!(
        (losses.received, losses.lost_on_link),
        (poses.len() as u64, missing)
    );
    assert!(missing > 0 && losses.rejected > 0);
}

#[test]
fn an_idle_robot_is_asked() {
    let (device, mut robot) = start("");
    assert_eq!(robot.check().ok(), Some(Presence::Answered));
    assert!(!device.truth().running);
    take(robot.as_mut(), 20).expect("20 poses");
    assert_eq!(robot.check().ok(), Some(Presence::Answered));
    robot.start().expect("a start");
    assert!(
        robot
            .check()
            .is_err_and(|error| error.to_string().contains("a device that streams"))
    );
    robot.stop().expect("a stop");
    device.unplug();
    let deadline = Instant::now() + SOON;
    while robot.check().is_ok() {
        assert!(Instant::now() < deadline, "nobody noticed");
    }
}

/// What is told when these faults end a run.
fn end_of_run(faults: &str) -> String {
    let (_device, mut robot) = start(faults);
    let error = take(robot.as_mut(), 5000).map(|poses| poses.len());
    let error = error.expect_err("an end");
    let text = text(&error);
    text.split_once(": ")
        .map_or(text.clone(), |(_, tail)| tail.to_owned())
}

#[test]
fn each_end_of_a_run_has_its_own_error() {
    assert_eq!(
        end_of_run("hot-unplug"),
        "cannot be used: it is gone: closed or unplugged; plug it in again and reopen"
    );
    assert_eq!(
        end_of_run("half-open"),
        "no answer within 3 s; check power and cable, then retry"
    );
    assert_eq!(
        end_of_run("reboot-after=50"),
        "the device ended the run: its clock went back: the controller was started anew; reopen it, then scan again"
    );
    let lie = end_of_run("lie=0.02");
    assert!(lie.starts_with("bad data from the device: "), "{lie}");
    // Numbers with the small end first are no poses: none is delivered.
    let (_device, mut robot) = start("swap-bytes");
    robot.start().expect("a start");
    let none = robot.next(Instant::now() + Duration::from_millis(200));
    assert!(matches!(none, Ok(None)));
    assert!(robot.losses().rejected > 10);
}

#[test]
fn refusals_are_told() {
    let told = |faults: &str, more: &str| {
        let device = simulated(faults);
        let text = refusal(
            "ur-rtde",
            &format!("address = \"{}\"\n{more}", device.port()),
        );
        let (_, tail) = text.split_once(": ").expect("an address");
        tail.to_owned()
    };
    assert_eq!(
        told("refuse=1", ""),
        "RTDE_REQUEST_PROTOCOL_VERSION is refused: version 2 is not spoken; update the robot's software to 3.4 or later"
    );
    assert_eq!(
        told("refuse=3", ""),
        "RTDE_CONTROL_PACKAGE_SETUP_OUTPUTS is refused: timestamp and actual_TCP_pose are DOUBLE and NOT_FOUND, expected DOUBLE and \
         VECTOR6D; update the robot's software"
    );
    assert_eq!(
        told("", "major_version = 3"),
        "answers as \"controller version 5.12\", the configuration expects \"version 3\"; check which device is plugged in where"
    );
    assert_eq!(
        told("silent-after=0", ""),
        "no answer within 3 s; check power and cable, then retry"
    );
    let web = Hostile::new(b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec(), true);
    let text = refusal("ur-rtde", &format!("address = '{}'", web.address));
    assert!(
        text.ends_with("bad data from the device: message type 0x54 is not one a device sends"),
        "{text}"
    );
    let (_device, mut robot) = start("refuse=4");
    let refused = robot.start().expect_err("a refusal").to_string();
    assert!(
        refused.ends_with(
            "RTDE_CONTROL_PACKAGE_START is refused: the controller says no; look at the robot's log"
        ),
        "{refused}"
    );
    // Another client's outputs are still on their way when we come: the session is set up all the same. Late answers too.
    for faults in ["autostart", "late-reply", "latency-lumps"] {
        let (_device, mut robot) = start(faults);
        assert!(take(robot.as_mut(), 20).is_ok(), "{faults}");
    }
}

#[test]
fn a_recording_plays_back_the_same_poses() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("rtde");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder");
    let device = simulated("drop=0.05");
    let setup = setup("ur-rtde", &format!("address = \"{}\"", device.port())).expect("a table");
    let poses_of = |opened: Result<Instrument, DeviceError>| {
        let Ok(Instrument::Robot(mut robot)) = opened else {
            panic!("no robot");
        };
        let poses = take(robot.as_mut(), 100).expect("100 poses");
        (poses, robot.losses())
    };
    let (poses, losses) = poses_of(setup.open(&Recorder::new(Cable, &folder, 1 << 20)));
    let file = std::fs::read_dir(&folder).expect("the folder").next();
    let file = file.expect("a recording").expect("an entry").path();
    let recording = Recording::read(&file).expect("a recording");
    let again = Replay::new(recording, Match::Loose(Duration::from_millis(20)));
    let (replayed, counted) = poses_of(setup.open(&again));
    let bare = |poses: &[Pose]| -> Vec<(f64, [f64; 3])> {
        poses
            .iter()
            .map(|p| (p.device_time_s, p.position_mm))
            .collect()
    };
    // The stop may fall a package earlier or later.
    let n = poses.len().min(replayed.len());
    assert!(n >= 100);
    assert_eq!(bare(&poses[..n]), bare(&replayed[..n]));
    assert!(losses.lost_on_link > 0 && counted.lost_on_link > 0);
}

#[test]
fn every_mistake_of_a_table_is_told() {
    let mistakes =
        setup("ur-rtde", "rate_hz = 1000\nmajor_version = 2\nport = 1").expect_err("mistakes");
    let told: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
    assert_eq!(
        told,
        [
            "address: nothing, expected a host, or host:port, as in \"192.168.1.10\"",
            "rate_hz: 1000, expected a number of 1 to 500",
            "major_version: 2, expected a whole number of 3 to 100",
            "port: an unknown key, expected one of address, rate_hz, major_version",
        ]
    );
}
