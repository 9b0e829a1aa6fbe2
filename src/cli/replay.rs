//! `acies replay CELL.toml RECORDING`: a recording through the same driver, as if the device were there.

use std::path::PathBuf;

use acies_drivers::device::Instrument;
use acies_drivers::link::recording::Recording;
use acies_drivers::link::replay::Replay;

use super::attached_device::{
    PLAYED, find, named, open, play, play_robot, read_cell, robot_summary, summary,
};
use super::{Failure, Status, print_line};
use crate::acquire::Assembler;
use crate::points::write_scan;

/// Plays a recording back through the driver of one device, and says what it holds; the points go into a PLY file if asked.
#[derive(Debug, clap::Args)]
pub struct ReplayCommand {
    /// The cell's configuration that the recording was made with.
    cell: PathBuf,
    /// The recording, as `acies record` writes it.
    recording: PathBuf,
    /// Which device, by its name in the configuration; needed where there are several.
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Write the points, placed by encoder and calibration in the machine's axes, as PLY.
    #[arg(short, long, value_name = "OUT.ply")]
    output: Option<PathBuf>,
}

impl ReplayCommand {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where configuration or recording cannot be understood; input or output where a file cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let (_, device) = find(&cell, self.device.as_deref())?;
        let recording =
            Recording::read(&self.recording).map_err(|error| Failure::BadInput(error.into()))?;
        for note in recording.notes() {
            print_line(&note)?;
        }
        let links = Replay::new(recording, PLAYED);
        match open(&device, &links)? {
            Instrument::Profiler(mut profiler) => {
                print_line(&named(profiler.identity()))?;
                let run = play(profiler.as_mut())?;
                print_line(&summary(&run))?;
                if let (Some(path), Some(calibration)) = (&self.output, device.calibration) {
                    let mut assembler = Assembler::new("replay", calibration);
                    run.profiles.iter().for_each(|p| assembler.push(p));
                    let (cloud, findings) = assembler.finish();
                    for finding in findings {
                        print_line(&finding)?;
                    }
                    write_scan(path, &cloud).map_err(|error| Failure::Io(error.into()))?;
                }
            }
            Instrument::Robot(mut robot) => {
                print_line(&named(robot.identity()))?;
                print_line(&robot_summary(&play_robot(robot.as_mut())?))?;
            }
            Instrument::Probe(probe) => print_line(&named(probe.identity()))?,
        }
        Ok(Status::Done)
    }
}
