//! What the commands share that take one device of a cell in hand: finding it, running it, saying what came.

use std::path::Path;
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::{Identity, Instrument, Losses, Profiler, Robot, Setup};
use acies_drivers::link::Links;
use acies_drivers::link::replay::Match;
use anyhow::anyhow;

use super::Failure;
use crate::acquire::Calibration;
use crate::config::Cell;

/// A device of a cell's configuration.
pub struct Configured<'a> {
    /// Ready to open.
    pub setup: &'a dyn Setup,
    /// Where a profiler is; `None` for a probe or a robot.
    pub calibration: Option<Calibration>,
}

/// Reads the cell.
pub fn read_cell(path: &Path) -> Result<Cell, Failure> {
    Cell::read(path).map_err(|errors| Failure::BadInput(anyhow!("{errors}")))
}

/// All devices of the cell, by name.
pub fn all(cell: &Cell) -> Vec<(&str, Configured<'_>)> {
    let profilers = cell.profilers.iter().map(|p| {
        let configured = Configured {
            setup: &*p.setup,
            calibration: Some(p.calibration),
        };
        (p.name.as_str(), configured)
    });
    let probes = cell.probes.iter().map(|p| {
        let configured = Configured {
            setup: &*p.setup,
            calibration: None,
        };
        (p.name.as_str(), configured)
    });
    let carriers = cell.carrier.iter().map(|c| {
        let configured = Configured {
            setup: &*c.setup,
            calibration: None,
        };
        (c.name.as_str(), configured)
    });
    profilers.chain(probes).chain(carriers).collect()
}

/// The device called `name`; without a name the only one of the cell.
pub fn find<'a>(cell: &'a Cell, name: Option<&str>) -> Result<(&'a str, Configured<'a>), Failure> {
    let mut all = all(cell);
    let names: Vec<String> = all.iter().map(|(n, _)| format!("{n:?}")).collect();
    let place = match name {
        Some(name) => all.iter().position(|(n, _)| *n == name),
        None if all.len() == 1 => Some(0),
        None => None,
    };
    match place {
        Some(place) => Ok(all.swap_remove(place)),
        None => Err(Failure::Usage(anyhow!(
            "--device: {}, expected one of {}",
            name.map_or_else(|| "nothing".to_owned(), |name| format!("{name:?}")),
            names.join(", ")
        ))),
    }
}

/// Opens it.
pub fn open(configured: &Configured<'_>, links: &dyn Links) -> Result<Instrument, Failure> {
    configured
        .setup
        .open(links)
        .map_err(|error| Failure::Io(error.into()))
}

/// How recordings are played: a driver that writes at other moments than it did when recorded is waited for no longer than this.
pub const PLAYED: Match = Match::Loose(Duration::from_millis(20));

/// Longest time that a recording is played.
const PLAYED_FOR: Duration = Duration::from_secs(3600);

/// All that a recorded profiler saw.
pub fn play(profiler: &mut dyn Profiler) -> Result<Run, Failure> {
    run(profiler, usize::MAX, PLAYED_FOR, Duration::from_secs(1))
}

/// All poses of a recorded robot.
pub fn play_robot(robot: &mut dyn Robot) -> Result<RobotRun, Failure> {
    run_robot(robot, usize::MAX, PLAYED_FOR)
}

/// What a run of a profiler brought.
pub struct Run {
    /// In the order of receipt.
    pub profiles: Vec<Profile>,
    /// What was lost.
    pub losses: Losses,
    /// Why it ended before it should, where it did.
    pub ended: Option<String>,
}

/// Most profiles kept of one run: an hour at a kilohertz, some 30 GB of the largest; a run by hand is seconds.
const PROFILES_MAX: usize = 3_600_000;

/// Runs `profiler` until it has sent `count` profiles, `limit` has passed, or it is silent for `silence` or gone.
pub fn run(
    profiler: &mut dyn Profiler,
    count: usize,
    limit: Duration,
    silence: Duration,
) -> Result<Run, Failure> {
    profiler
        .start()
        .map_err(|error| Failure::Io(error.into()))?;
    let (began, mut heard) = (Instant::now(), Instant::now());
    let mut run = Run {
        profiles: Vec::new(),
        losses: Losses::default(),
        ended: None,
    };
    while run.profiles.len() < count.min(PROFILES_MAX) && began.elapsed() < limit {
        match profiler.next(Instant::now() + Duration::from_millis(100)) {
            Ok(Some(profile)) => {
                heard = Instant::now();
                run.profiles.push(profile);
            }
            Ok(None) if heard.elapsed() > silence => {
                run.ended = Some(format!("silent for {:.1} s", silence.as_secs_f64()));
                break;
            }
            Ok(None) => {}
            Err(error) => {
                run.ended = Some(error.to_string());
                break;
            }
        }
    }
    match profiler.stop() {
        Ok(under_way) => run.profiles.extend(under_way),
        Err(error) if run.ended.is_none() => run.ended = Some(error.to_string()),
        Err(_) => {}
    }
    run.losses = profiler.losses();
    Ok(run)
}

/// One line that names a device.
pub fn named(identity: &Identity) -> String {
    let Identity {
        vendor,
        model,
        serial,
        firmware,
    } = identity;
    let serial = if serial.is_empty() { "none" } else { serial };
    format!("{vendor} {model}, serial number {serial}, firmware {firmware}")
}

/// A run in a few lines: counts, losses, encoder, range.
pub fn summary(run: &Run) -> String {
    let points = |profile: &Profile| profile.z_mm.iter().filter(|z| z.is_finite()).count();
    let total: usize = run.profiles.iter().map(points).sum();
    let z = || {
        let all = run.profiles.iter().flat_map(|p| p.z_mm.iter().copied());
        all.filter(|z| z.is_finite())
    };
    let Losses {
        received,
        lost_on_link,
        dropped_by_device,
        rejected,
        skipped_bytes,
    } = run.losses;
    let mut lines = vec![format!(
        "{received} profiles, {total} points; lost on the link {lost_on_link}, dropped by the device {dropped_by_device}, rejected {rejected}, \
         bytes skipped {skipped_bytes}"
    )];
    if total > 0 {
        let (low, high) = z().fold((f64::MAX, f64::MIN), |(l, h), z| (l.min(z), h.max(z)));
        lines.push(format!("z from {low:.3} to {high:.3} mm"));
    }
    let mut encoders = run.profiles.iter().filter_map(|p| p.encoder);
    if let Some(first) = encoders.next() {
        let last = encoders.next_back().unwrap_or(first);
        lines.push(format!("encoder from {first} to {last}"));
    }
    if let Some(ended) = &run.ended {
        lines.push(format!("ended early: {ended}"));
    }
    lines.join("\n")
}

/// What a run of a robot brought.
pub struct RobotRun {
    /// In the order of receipt.
    pub poses: Vec<Pose>,
    /// What was lost.
    pub losses: Losses,
    /// Why it ended before it should, where it did.
    pub ended: Option<String>,
}

/// Takes `count` poses, or as many as come in `limit`.
pub fn run_robot(
    robot: &mut dyn Robot,
    count: usize,
    limit: Duration,
) -> Result<RobotRun, Failure> {
    let failed = |error: acies_drivers::error::DeviceError| Failure::Io(error.into());
    robot.start().map_err(failed)?;
    let until = Instant::now() + limit;
    let mut poses = Vec::new();
    let mut ended = None;
    while poses.len() < count.min(PROFILES_MAX) && Instant::now() < until {
        match robot.next(until) {
            Ok(pose) => poses.extend(pose),
            Err(error) => {
                ended = Some(error.to_string());
                break;
            }
        }
    }
    match robot.stop() {
        Ok(under_way) => poses.extend(under_way),
        Err(error) => ended = ended.or(Some(error.to_string())),
    }
    Ok(RobotRun {
        poses,
        losses: robot.losses(),
        ended,
    })
}

/// A run of a robot in a few lines: counts, losses, where it stands.
pub fn robot_summary(run: &RobotRun) -> String {
    let Losses {
        received,
        lost_on_link,
        rejected,
        ..
    } = run.losses;
    let mut lines = vec![format!(
        "{received} poses; missing by the robot's clock {lost_on_link}, rejected {rejected}"
    )];
    if let [first, .., last] = &run.poses[..] {
        let seconds = last.device_time_s - first.device_time_s;
        let [x, y, z] = last.position_mm;
        lines.push(format!(
            "{seconds:.3} s by its clock; the tool is at {x:.3}, {y:.3}, {z:.3} mm"
        ));
    }
    if let Some(ended) = &run.ended {
        lines.push(format!("ended early: {ended}"));
    }
    lines.join("\n")
}
