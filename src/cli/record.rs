//! `acies record CELL.toml`: what passes between us and one device, into a file.

use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::Recorder;
use anyhow::Context;

use super::attached_device::{find, named, open, read_cell, run, run_robot, summary};
use super::{Failure, Status, print_line};

/// Opens one device of a cell, runs it, and writes every byte that passes into a recording with its time.
///
/// All connections of the device are in one file, a USB device's endpoints too. A recording plays back through the same driver (`acies replay`), calibrates a profiler (`acies calibrate`), and shows the maker
/// of a device what it did.
#[derive(Debug, clap::Args)]
pub struct Record {
    /// The cell's configuration.
    cell: PathBuf,
    /// Which device, by its name in the configuration; needed where there are several.
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Folder of the recording.
    #[arg(short, long, value_name = "FOLDER", default_value = ".")]
    output: PathBuf,
    /// End after so many profiles.
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
    /// Bad input where the configuration has mistakes; input or output where the device does not open or the folder cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let device = find(&cell, self.device.as_deref())?;
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("{}: cannot be created", self.output.display()))
            .map_err(Failure::Io)?;
        let limit = self.limit_mb.saturating_mul(1_000_000);
        let name = self.device.as_deref().unwrap_or("the only one");
        let notes = vec![
            format!(
                "recorded {} by acies {}",
                humantime::format_rfc3339_seconds(SystemTime::now()),
                env!("CARGO_PKG_VERSION")
            ),
            format!(
                "cell {:?} ({}), device {name}",
                cell.name,
                self.cell.display()
            ),
        ];
        let links = Recorder::of_device(Cable, &self.output, limit, notes);
        match open(&device, &links)? {
            Instrument::Profiler(mut profiler) => {
                print_line(&named(profiler.identity()))?;
                let limit = Duration::from_secs_f64(self.seconds);
                let run = run(profiler.as_mut(), self.profiles, limit, limit)?;
                print_line(&summary(&run))?;
            }
            Instrument::Robot(mut robot) => {
                print_line(&named(robot.identity()))?;
                let limit = Duration::from_secs_f64(self.seconds);
                print_line(&run_robot(robot.as_mut(), self.profiles, limit)?)?;
            }
            Instrument::Probe(probe) => print_line(&named(probe.identity()))?,
        }
        Ok(Status::Done)
    }
}
