//! `acies record CELL.toml`: what passes between us and the devices of a cell, into a file each.

use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::Recorder;
use anyhow::{Context, anyhow};

use super::attached_device::{
    Configured, all, find, named, open, read_cell, robot_summary, run, run_robot, summary,
};
use super::{Failure, Status, print_line};
use crate::config::Cell;

/// Opens a device of a cell, or all, runs it, and writes every byte that passes into a recording with its time.
///
/// All connections of a device are in one file, a USB device's endpoints too. A recording plays back through the same driver (`acies replay`),
/// calibrates a profiler (`acies calibrate`), and shows the maker of a device what it did. The times of devices that are recorded together are by
/// one clock.
#[derive(Debug, clap::Args)]
pub struct Record {
    /// The cell's configuration.
    cell: PathBuf,
    /// Which device, by its name in the configuration; needed where there are several.
    #[arg(long, value_name = "NAME", conflicts_with = "all")]
    device: Option<String>,
    /// All profilers and the robot of the cell at once, a file each.
    #[arg(long)]
    all: bool,
    /// Folder of the recordings.
    #[arg(short, long, value_name = "FOLDER", default_value = ".")]
    output: PathBuf,
    /// End a device after so many profiles or poses.
    #[arg(long, value_name = "N", default_value_t = usize::MAX, hide_default_value = true)]
    profiles: usize,
    /// End after so many seconds.
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = super::positive_seconds)]
    seconds: f64,
    /// Let no file grow beyond this, megabytes.
    #[arg(long, value_name = "MB", default_value_t = 1000)]
    limit_mb: u64,
}

impl Record {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where the configuration has mistakes; input or output where a device does not open or the folder cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let devices = match self.all {
            true => streaming(&cell),
            false => vec![find(&cell, self.device.as_deref())?],
        };
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("{}: cannot be created", self.output.display()))
            .map_err(Failure::Io)?;
        let limit = self.limit_mb.saturating_mul(1_000_000);
        let (began, now) = (Instant::now(), SystemTime::now());
        // Every device is open before the first one runs: what one of them sees the others are to see too.
        let mut opened = Vec::new();
        for (name, device) in &devices {
            let notes = vec![
                format!(
                    "recorded {} by acies {}",
                    humantime::format_rfc3339_seconds(now),
                    env!("CARGO_PKG_VERSION")
                ),
                format!("cell {:?} ({})", cell.name, self.cell.display()),
                format!("device {name}"),
                format!("run {}", humantime::format_rfc3339_nanos(now)),
            ];
            let links = Recorder::of_device(Cable, &self.output, limit, notes);
            opened.push(open(device, &links.counting_from(began))?);
        }
        let told: Vec<Result<String, Failure>> = thread::scope(|scope| {
            let running: Vec<_> = opened
                .iter_mut()
                .map(|instrument| scope.spawn(|| self.take(instrument)))
                .collect();
            let joined = running.into_iter().map(|thread| {
                let panicked = |_| Err(Failure::Io(anyhow!("its thread panicked")));
                thread.join().unwrap_or_else(panicked)
            });
            joined.collect()
        });
        for told in told {
            print_line(&told?)?;
        }
        Ok(Status::Done)
    }

    /// Runs one device; who it is and what came.
    fn take(&self, instrument: &mut Instrument) -> Result<String, Failure> {
        let limit = Duration::from_secs_f64(self.seconds);
        let name = named(instrument.identity());
        let came = match instrument {
            Instrument::Profiler(profiler) => {
                summary(&run(profiler.as_mut(), self.profiles, limit, limit)?)
            }
            Instrument::Robot(robot) => {
                robot_summary(&run_robot(robot.as_mut(), self.profiles, limit)?)
            }
            Instrument::Probe(_) => return Ok(name),
        };
        Ok(format!("{name}\n{came}"))
    }
}

/// The devices of the cell that send by themselves.
fn streaming(cell: &Cell) -> Vec<(&str, Configured<'_>)> {
    let is_probe = |name: &str| cell.probes.iter().any(|probe| probe.name == name);
    let devices = all(cell).into_iter();
    devices.filter(|(name, _)| !is_probe(name)).collect()
}
