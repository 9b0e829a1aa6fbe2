//! `acies probe CELL.toml`: one device by hand.

use std::path::PathBuf;
use std::time::Duration;

use acies_drivers::device::Instrument;
use acies_drivers::link::cable::Cable;
use anyhow::anyhow;

use super::attached_device::{
    find, named, open, read_cell, robot_summary, run, run_robot, summary,
};
use super::{Failure, Status, print_line};

/// Opens one device of a cell, says who it is, and tries it: a profiler measures a few profiles, a probe touches once.
///
/// For the first hour with a new device, and for the day it will not answer.
#[derive(Debug, clap::Args)]
pub struct Probe {
    /// The cell's configuration.
    cell: PathBuf,
    /// Which device, by its name in the configuration; needed where there are several.
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Profiles that a profiler measures; 0 = none, the laser stays off.
    #[arg(long, value_name = "N", default_value_t = 10)]
    profiles: usize,
    /// Where a probe's tip goes first, mm, machine axes, as in 10,20,30. Without it nothing moves.
    #[arg(long, value_name = "X,Y,Z", requires = "target", allow_hyphen_values = true, value_parser = super::three_numbers)]
    start: Option<[f64; 3]>,
    /// Where it goes towards until it touches.
    #[arg(long, value_name = "X,Y,Z", requires = "start", allow_hyphen_values = true, value_parser = super::three_numbers)]
    target: Option<[f64; 3]>,
    /// Longest wait, seconds.
    #[arg(long, value_name = "S", default_value_t = 30.0, value_parser = super::positive_seconds)]
    seconds: f64,
}

impl Probe {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where the configuration has mistakes; input or output where the device does not open or fails.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let (_, device) = find(&cell, self.device.as_deref())?;
        let limit = Duration::from_secs_f64(self.seconds);
        match open(&device, &Cable)? {
            Instrument::Profiler(mut profiler) => {
                print_line(&named(profiler.identity()))?;
                if self.start.is_some() {
                    return Err(Failure::Usage(anyhow!(
                        "--start: a profiler touches nothing, expected a probe"
                    )));
                }
                if self.profiles > 0 {
                    let run = run(profiler.as_mut(), self.profiles, limit, limit)?;
                    print_line(&summary(&run))?;
                }
            }
            Instrument::Robot(mut robot) => {
                print_line(&named(robot.identity()))?;
                let run = run_robot(robot.as_mut(), self.profiles, limit)?;
                print_line(&robot_summary(&run))?;
            }
            Instrument::Probe(mut probe) => {
                print_line(&named(probe.identity()))?;
                if let (Some(start), Some(target)) = (self.start, self.target) {
                    let touch = probe
                        .touch(start, target, limit)
                        .map_err(|error| Failure::Io(error.into()))?;
                    let [x, y, z] = touch.tip_centre_mm;
                    print_line(&format!(
                        "touched with the tip's centre at {x:.4}, {y:.4}, {z:.4} mm"
                    ))?;
                }
            }
        }
        Ok(Status::Done)
    }
}
