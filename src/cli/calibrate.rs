//! `acies calibrate CELL.toml`: a profiler's pose and travel from recordings of a reference sphere, or the lag of a robot that carries it, live or
//! from recordings.

use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

use acies_drivers::device::{Identity, Instrument, Profiler, Robot};
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::Recording;
use acies_drivers::link::replay::Replay;
use anyhow::anyhow;
use glam::DVec3;
use serde_json::json;

use super::attached_device::{Configured, PLAYED, find, open, play, play_robot, read_cell};
use super::{Failure, Status, print_line};
use crate::acquire::calibrate::{ProfilerCalibration, SphereScan, calibrate_profiler};
use crate::acquire::lag::{Artefact, Lag, Pass, find_lag};
use crate::acquire::{CarriedRecord, CarriedView, Carrier, Profiling, ScanEvent, run_carried};
use crate::config::{CarrierConfig, Cell, ProfilerConfig};

/// Finds where a profiler stands and how the stage runs, from recordings of a reference sphere at known places.
///
/// Three places, not on one line, hold everything. Prints the table for the cell's configuration, with date, residuals and standard
/// uncertainties; `--json` prints the whole covariance.
///
/// With `--lag` it finds the lag between a robot's poses and a profiler on it instead, with the devices of the cell: so many times the
/// robot's program goes over a sphere of about `--radius`, or without it over a plate inclined to the path, and back; a pass is over where
/// a scan is (`end_mm` of the robot), so that end and start are one place. Of several passes the scatter of the clocks is in the
/// uncertainty too. With `--lag-recording` it finds it in passes that were recorded by `acies record --all`, each in a folder of its own.
#[derive(Debug, clap::Args)]
pub struct Calibrate {
    /// The cell's configuration; its present calibration is the start.
    cell: PathBuf,
    /// Which profiler, by its name in the configuration; needed where there are several devices.
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// A recording of the sphere and the sphere's centre in the machine, mm: "sphere-0.aciesrec=120.5,30.1,42.0". Several times.
    #[arg(long, value_name = "RECORDING=X,Y,Z", required_unless_present_any = ["lag", "lag_recording"])]
    sphere: Vec<String>,
    /// Radius of the sphere, mm: certified for a pose, about right for a lag.
    #[arg(long, value_name = "MM", required_unless_present_any = ["lag", "lag_recording"])]
    radius: Option<f64>,
    /// Find the lag of the cell's robot from so many passes to and fro.
    #[arg(long, value_name = "PASSES", conflicts_with = "sphere", value_parser = clap::value_parser!(u32).range(1..=100))]
    lag: Option<u32>,
    /// Find it in a pass that was recorded: the folder with the recordings of robot and profiler. Several times.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["lag", "sphere"])]
    lag_recording: Vec<PathBuf>,
    /// Standard uncertainty of each coordinate of a centre, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.002)]
    u_centre: f64,
    /// Noise of the sensor, standard deviation, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.01)]
    noise: f64,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Calibrate {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where configuration, recordings or places cannot be understood or do not hold the calibration.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        if self.lag.is_some() || !self.lag_recording.is_empty() {
            return self.find_lag(&cell);
        }
        let (_, device) = find(&cell, self.device.as_deref())?;
        let rough = device
            .calibration
            .ok_or_else(|| Failure::Usage(anyhow!("--device: a probe, expected a profiler")))?;
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let radius_mm = self.radius.unwrap_or(f64::NAN);
        if !positive(radius_mm) || !positive(self.u_centre) || !positive(self.noise) {
            return Err(Failure::Usage(anyhow!(
                "--radius, --u-centre and --noise: expected numbers above 0"
            )));
        }
        let mut scans = Vec::new();
        let mut identity = None;
        for sphere in &self.sphere {
            let (path, centre_mm) = parse_sphere(sphere)?;
            let (who, profiles) = replay(&device, &path)?;
            identity = Some(who);
            scans.push(SphereScan {
                profiles,
                centre_mm,
                u_centre_mm: self.u_centre,
                radius_mm,
            });
        }
        let found = calibrate_profiler(&scans, &rough, self.noise)
            .map_err(|error| Failure::BadInput(error.into()))?;
        let now = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        print_line(&if self.json {
            as_json(&found, identity.as_ref(), &now).to_string()
        } else {
            as_toml(&found, identity.as_ref(), &now)
        })?;
        Ok(Status::Done)
    }
}

/// The robot and the profiler on it whose lag is sought.
struct LagDevices<'a> {
    robot: &'a CarrierConfig,
    profiler: &'a ProfilerConfig,
}

impl Calibrate {
    fn find_lag(&self, cell: &Cell) -> Result<Status, Failure> {
        let artefact = match self.radius {
            None => Artefact::Plate,
            Some(radius_mm) if radius_mm.is_finite() && radius_mm > 0.0 => {
                Artefact::Sphere { radius_mm }
            }
            Some(_) => {
                return Err(Failure::Usage(anyhow!(
                    "--radius: expected a number above 0"
                )));
            }
        };
        let devices = self.lag_devices(cell)?;
        let taken = match self.lag {
            Some(passes) => devices.run(passes)?,
            None => {
                let folders = self.lag_recording.iter();
                folders
                    .map(|folder| devices.replay(folder))
                    .collect::<Result<_, _>>()?
            }
        };
        let lag = find_lag(&taken, artefact).map_err(|error| Failure::BadInput(error.into()))?;
        print_line(&if self.json {
            lag_as_json(&lag, &devices.profiler.name).to_string()
        } else {
            lag_as_toml(&lag)
        })?;
        Ok(Status::Done)
    }

    fn lag_devices<'a>(&self, cell: &'a Cell) -> Result<LagDevices<'a>, Failure> {
        let robot = cell.carrier.as_ref().ok_or_else(|| {
            Failure::BadInput(anyhow!(
                "the cell has no robot: no device with [device.carrier]"
            ))
        })?;
        let named = |name: &str| self.device.as_deref().is_none_or(|wanted| wanted == name);
        let of_name: Vec<_> = cell.profilers.iter().filter(|p| named(&p.name)).collect();
        let [profiler] = of_name[..] else {
            let names: Vec<String> = cell
                .profilers
                .iter()
                .map(|p| format!("{:?}", p.name))
                .collect();
            return Err(Failure::Usage(anyhow!(
                "--device: expected one of {}",
                names.join(", ")
            )));
        };
        Ok(LagDevices { robot, profiler })
    }
}

impl LagDevices<'_> {
    fn open_robot(&self, links: &dyn Links) -> Result<Box<dyn Robot>, Failure> {
        match self.robot.setup.open(links) {
            Ok(Instrument::Robot(robot)) => Ok(robot),
            Ok(_) => Err(Failure::BadInput(anyhow!(
                "{}: expected a robot",
                self.robot.name
            ))),
            Err(error) => Err(Failure::Io(error.into())),
        }
    }

    fn open_profiler(&self, links: &dyn Links) -> Result<Box<dyn Profiler>, Failure> {
        match self.profiler.setup.open(links) {
            Ok(Instrument::Profiler(profiler)) => Ok(profiler),
            Ok(_) => Err(Failure::BadInput(anyhow!(
                "{}: expected a profiler",
                self.profiler.name
            ))),
            Err(error) => Err(Failure::Io(error.into())),
        }
    }

    /// Passes with the devices themselves.
    fn run(&self, passes: u32) -> Result<Vec<Pass>, Failure> {
        let mut carrier = Carrier {
            name: self.robot.name.clone(),
            robot: self.open_robot(&Cable)?,
            plan: self.robot.plan,
        };
        let mut profilers = [Profiling {
            name: self.profiler.name.clone(),
            profiler: self.open_profiler(&Cable)?,
            calibration: self.profiler.calibration,
        }];
        let mut taken = Vec::new();
        for number in 1..=passes {
            eprintln!("pass {number} of {passes}: start the robot's program");
            let run = run_carried(&mut profilers, &mut carrier, &mut |_: ScanEvent| {})
                .map_err(|error| Failure::Io(error.into()))?;
            if let Some(why) = run.broken(&profilers, &carrier) {
                return Err(Failure::Io(anyhow!("pass {number}: {why}")));
            }
            let pass = run.pass(0, &profilers[0], &carrier);
            taken.push(pass.ok_or_else(|| no_clock(&format!("pass {number}")))?);
        }
        Ok(taken)
    }

    /// A pass of which both recordings are in `folder`, through the same drivers.
    fn replay(&self, folder: &Path) -> Result<Pass, Failure> {
        let arm = recording_of(folder, &self.robot.name)?;
        let line = recording_of(folder, &self.profiler.name)?;
        let run_of = |recording: &Recording| recording.note("run ");
        if run_of(&arm).is_none() || run_of(&arm) != run_of(&line) {
            return Err(Failure::BadInput(anyhow!(
                "{}: {} and {} were not recorded at once, so that their times are by different clocks; record both with `acies record --all`",
                folder.display(),
                self.robot.name,
                self.profiler.name
            )));
        }
        let began = Instant::now();
        let played = |recording| Replay::of_run(recording, PLAYED, began);
        let mut robot = self.open_robot(&played(arm))?;
        let poses = play_robot(robot.as_mut())?.poses;
        let mut profiler = self.open_profiler(&played(line))?;
        let profiles = play(profiler.as_mut())?.profiles;
        CarriedRecord {
            views: vec![CarriedView {
                device: &self.profiler.name,
                tool_from_sensor: self.profiler.calibration.machine_from_sensor,
                profiles: &profiles,
            }],
            poses: &poses,
            machine_from_base: self.robot.plan.machine_from_base,
            lag_s: 0.0,
        }
        .pass()
        .ok_or_else(|| no_clock(&folder.display().to_string()))
    }
}

fn no_clock(pass: &str) -> Failure {
    Failure::BadInput(anyhow!(
        "{pass}: a device's times are no clock; check that its clock is on"
    ))
}

/// The one recording of a device in a folder, by what is noted in it.
fn recording_of(folder: &Path, device: &str) -> Result<Recording, Failure> {
    let failed = |error: std::io::Error| {
        let context = format!("{}: cannot be read", folder.display());
        Failure::BadInput(anyhow::Error::from(error).context(context))
    };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.extension().is_none_or(|of| of != "aciesrec") {
            continue;
        }
        let recording = Recording::read(&path).map_err(|error| Failure::BadInput(error.into()))?;
        if recording.note("device ").as_deref() == Some(device) {
            found.push(recording);
        }
    }
    match found.len() {
        1 => Ok(found.remove(0)),
        n => Err(Failure::BadInput(anyhow!(
            "{}: {n} recordings of {device}, expected one",
            folder.display()
        ))),
    }
}

fn lag_as_toml(lag: &Lag) -> String {
    let passes = lag.passes.iter().map(|(lag_s, u_s)| {
        format!(
            "#   {:+.3} ms, standard uncertainty of the fit {:.3} ms\n",
            1e3 * lag_s,
            1e3 * u_s
        )
    });
    let alone = match lag.passes.len() {
        1 => "# one pass: what the clocks differ by from run to run is not in it\n",
        _ => "",
    };
    format!(
        "# residuals: rms {:.2} um; passes:\n{}# standard uncertainty {:.3} ms\n{alone}[device.carrier]\nlag_s = {:.6}",
        1e3 * lag.rms_mm,
        passes.collect::<String>(),
        1e3 * lag.u_s,
        lag.lag_s
    )
}

fn lag_as_json(lag: &Lag, device: &str) -> serde_json::Value {
    let passes: Vec<_> = lag
        .passes
        .iter()
        .map(|(lag_s, u_s)| json!({"lag_s": lag_s, "u_fit_s": u_s}))
        .collect();
    json!({
        "schema": "acies-lag/1",
        "device": device,
        "lag_s": lag.lag_s,
        "u_s": lag.u_s,
        "rms_mm": lag.rms_mm,
        "passes": passes,
    })
}

fn parse_sphere(text: &str) -> Result<(PathBuf, DVec3), Failure> {
    let parsed = text.rsplit_once('=').and_then(|(path, place)| {
        let place = super::three_numbers(place).ok()?;
        Some((PathBuf::from(path), DVec3::from(place)))
    });
    parsed.ok_or_else(|| {
        Failure::Usage(anyhow!(
            "--sphere: {text:?}, expected a recording and a place, as in sphere-0.aciesrec=120.5,30.1,42.0"
        ))
    })
}

fn replay(
    device: &Configured<'_>,
    path: &Path,
) -> Result<(Identity, Vec<acies_drivers::capture::Profile>), Failure> {
    let recording = Recording::read(path).map_err(|error| Failure::BadInput(error.into()))?;
    let links = Replay::new(recording, PLAYED);
    let Instrument::Profiler(mut profiler) = open(device, &links)? else {
        return Err(Failure::Usage(anyhow!(
            "--device: a probe, expected a profiler"
        )));
    };
    let run = play(profiler.as_mut())?;
    Ok((profiler.identity().clone(), run.profiles))
}

fn as_toml(found: &ProfilerCalibration, identity: Option<&Identity>, date: &str) -> String {
    let at = &found.calibration;
    let pose = at.machine_from_sensor;
    let line = |v: DVec3| format!("[{:.9}, {:.9}, {:.9}]", v.x, v.y, v.z);
    let u = |i: usize| found.covariance[i][i].max(0.0).sqrt();
    let spheres: Vec<String> = found
        .spheres
        .iter()
        .map(|s| {
            format!(
                "#   {} points, mean {:+.2} um, rms {:.2} um\n",
                s.points,
                1e3 * s.mean_mm,
                1e3 * s.rms_mm
            )
        })
        .collect();
    format!(
        "# {}\n# residuals: rms {:.2} um; by sphere:\n{}\
         # standard uncertainties: position {:.1}, {:.1}, {:.1} um; rotation {:.1}, {:.1}, {:.1} urad\n\
         [stage]\ntravel_mm_per_count = {}\n\n[device.calibration]\norigin_mm = {}\nx_axis = {}\nz_axis = {}\ndate = \"{date}\"",
        identity.map_or_else(String::new, super::attached_device::named),
        1e3 * found.rms_mm,
        spheres.concat(),
        1e3 * u(3),
        1e3 * u(4),
        1e3 * u(5),
        1e6 * u(0),
        1e6 * u(1),
        1e6 * u(2),
        line(at.travel_mm_per_count),
        line(pose.translation),
        line(pose.vector(DVec3::X)),
        line(pose.vector(DVec3::Z)),
    )
}

fn as_json(
    found: &ProfilerCalibration,
    identity: Option<&Identity>,
    date: &str,
) -> serde_json::Value {
    let at = &found.calibration;
    let rows = at
        .machine_from_sensor
        .matrix()
        .transpose()
        .to_cols_array_2d();
    let spheres: Vec<_> = found
        .spheres
        .iter()
        .map(|s| json!({"points": s.points, "mean_mm": s.mean_mm, "rms_mm": s.rms_mm}))
        .collect();
    json!({
        "schema": "acies-calibration/1",
        "date": date,
        "device": identity.map(|i| json!({
            "vendor": i.vendor, "model": i.model, "serial": i.serial, "firmware": i.firmware,
        })),
        "machine_from_sensor": rows,
        "travel_mm_per_count": at.travel_mm_per_count.to_array(),
        "covariance": found.covariance,
        "rms_mm": found.rms_mm,
        "spheres": spheres,
    })
}
