//! `acies calibrate CELL.toml`: a profiler's pose and travel from recordings of a reference sphere.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use acies_drivers::device::{Identity, Instrument};
use acies_drivers::link::recording::Recording;
use acies_drivers::link::replay::{Match, Replay};
use anyhow::anyhow;
use glam::DVec3;
use serde_json::json;

use super::attached_device::{Configured, find, open, read_cell, run};
use super::{Failure, Status, print_line};
use crate::acquire::calibrate::{ProfilerCalibration, SphereScan, calibrate_profiler};

/// Finds where a profiler stands and how the stage runs, from recordings of a reference sphere at known places.
///
/// Three places, not on one line, hold everything. Prints the table for the cell's configuration, with date, residuals and standard
/// uncertainties; `--json` prints the whole covariance.
#[derive(Debug, clap::Args)]
pub struct Calibrate {
    /// The cell's configuration; its present calibration is the start.
    cell: PathBuf,
    /// Which profiler, by its name in the configuration; needed where there are several devices.
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// A recording of the sphere and the sphere's centre in the machine, mm: "sphere-0.aciesrec=120.5,30.1,42.0". Several times.
    #[arg(long, value_name = "RECORDING=X,Y,Z", required = true)]
    sphere: Vec<String>,
    /// Certified radius of the sphere, mm.
    #[arg(long, value_name = "MM")]
    radius: f64,
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
        let device = find(&cell, self.device.as_deref())?;
        let rough = device
            .calibration
            .ok_or_else(|| Failure::Usage(anyhow!("--device: a probe, expected a profiler")))?;
        let positive = |value: f64| value.is_finite() && value > 0.0;
        if !positive(self.radius) || !positive(self.u_centre) || !positive(self.noise) {
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
                radius_mm: self.radius,
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
    let links = Replay::new(recording, Match::Loose(Duration::from_millis(20)));
    let Instrument::Profiler(mut profiler) = open(device, &links)? else {
        return Err(Failure::Usage(anyhow!(
            "--device: a probe, expected a profiler"
        )));
    };
    let hour = Duration::from_secs(3600);
    let run = run(profiler.as_mut(), usize::MAX, hour, Duration::from_secs(1))?;
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
