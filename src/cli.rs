//! The command line: one file a subcommand. Argument parsing only; the work is done by the modules above.

mod acceptance;
mod attached_device;
mod backup;
mod calibrate;
mod check;
mod demo;
mod detect;
mod devices;
mod export;
mod inspect;
mod mesh;
mod nominal;
mod normals;
mod person;
mod probe;
mod progress;
mod reconstruct;
mod record;
mod replay;
mod serve;
mod simulate;
mod support_bundle;

use std::process::ExitCode;

use crate::report::Report;
use crate::report::wire;

/// What `acies` can be asked to do.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Play a simulated cell: scan a part with known defects, measure its edges, report.
    Demo(demo::Demo),
    /// Run a cell: the daemon with its page and API.
    Serve(serve::Serve),
    /// Write everything a cell knows into a folder, while it runs.
    Backup(backup::Backup),
    /// Put a backup in the place of a cell's store.
    Restore(backup::Restore),
    /// Write every result of a cell for those who analyse elsewhere.
    Export(export::Export),
    /// Collect what somebody who is to help needs, in one file.
    SupportBundle(support_bundle::SupportBundle),
    /// Measure every sharp edge of a scan against its nominal.
    Inspect(inspect::Inspect),
    /// Find the points of a scan that lie on sharp edges, corners and boundaries.
    Detect(detect::Detect),
    /// Project a scan onto its surface, keeping edges sharp.
    Reconstruct(reconstruct::Reconstruct),
    /// Mesh a scan: watertight, manifold, through every point.
    Mesh(mesh::Mesh),
    /// Find the outward normal at every point of a scan.
    Normals(normals::NormalsCommand),
    /// Say what a CAD file holds: faces, edges, sharp edges, and what was refused.
    Nominal(nominal::Nominals),
    /// Say everything that is wrong with a cell's configuration, touching no device.
    Check(check::Check),
    /// Try one device of a cell by hand.
    Probe(probe::Probe),
    /// Write what passes between us and one device into a file.
    Record(record::Record),
    /// Play a recording back through its driver.
    Replay(replay::ReplayCommand),
    /// Find where a profiler stands from recordings of a reference sphere.
    Calibrate(calibrate::Calibrate),
    /// Measure reference artefacts with a scanner: form, size, distance, flatness, edge; write a record.
    Acceptance(acceptance::Acceptance),
    /// Add, list or disable those who may use a cell's page.
    Person(person::People),
    /// List what is attached, who may open it, and why not.
    Devices(devices::Devices),
    /// Play one simulated device on a pseudo-terminal or a socket.
    Simulate(simulate::Simulate),
}

impl Command {
    /// Carries the command out.
    ///
    /// # Errors
    /// [`Failure`], whose variant is the exit status.
    pub fn run(self) -> Result<Status, Failure> {
        match self {
            Command::Demo(command) => command.run(),
            Command::Serve(command) => command.run(),
            Command::Backup(command) => command.run(),
            Command::Restore(command) => command.run(),
            Command::Export(command) => command.run(),
            Command::SupportBundle(command) => command.run(),
            Command::Inspect(command) => command.run(),
            Command::Detect(command) => command.run(),
            Command::Reconstruct(command) => command.run(),
            Command::Mesh(command) => command.run(),
            Command::Normals(command) => command.run(),
            Command::Nominal(command) => command.run(),
            Command::Check(command) => command.run(),
            Command::Probe(command) => command.run(),
            Command::Record(command) => command.run(),
            Command::Replay(command) => command.run(),
            Command::Calibrate(command) => command.run(),
            Command::Acceptance(command) => command.run(),
            Command::Person(command) => command.run(),
            Command::Devices(command) => command.run(),
            Command::Simulate(command) => command.run(),
        }
    }
}

/// How a command that was carried out ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Done, and OK where there is a verdict.
    Done,
    /// Done, and the part is not OK.
    NotOk,
    /// Done, and the data do not allow a verdict.
    NotDecidable,
}

/// Why a command could not be carried out. The variant decides the exit status.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// Wrong usage: arguments that make no sense together.
    #[error(transparent)]
    Usage(anyhow::Error),
    /// Bad input: a file or configuration that cannot be understood.
    #[error(transparent)]
    BadInput(anyhow::Error),
    /// Our fault.
    #[error(transparent)]
    Internal(anyhow::Error),
    /// Reading, writing or a device failed.
    #[error(transparent)]
    Io(anyhow::Error),
}

impl From<Status> for ExitCode {
    fn from(status: Status) -> Self {
        ExitCode::from(match status {
            Status::Done => 0,
            Status::NotOk => 1,
            Status::NotDecidable => 2,
        })
    }
}

impl Failure {
    /// The exit status: 64 wrong usage, 65 bad input, 70 our fault, 74 input or output failed.
    pub fn exit_status(&self) -> u8 {
        match self {
            Failure::Usage(_) => 64,
            Failure::BadInput(_) => 65,
            Failure::Internal(_) => 70,
            Failure::Io(_) => 74,
        }
    }
}

/// A number of seconds above 0, for clap.
fn positive_seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok();
    seconds
        .filter(|s| *s > 0.0 && *s <= 1e6)
        .ok_or_else(|| "expected seconds, above 0 and at most 1000000".to_owned())
}

/// Three finite numbers between commas, for clap.
fn three_numbers(text: &str) -> Result<[f64; 3], String> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|n| n.trim().parse().ok().filter(|n: &f64| n.is_finite()))
        .collect();
    numbers
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| "expected three numbers between commas, as in 10,20.5,30".to_owned())
}

/// Prints one line on standard output; a closed pipe ends the program quietly, as other tools do.
pub(crate) fn print_line(text: &str) -> Result<(), Failure> {
    use std::io::Write;
    match writeln!(std::io::stdout().lock(), "{text}") {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => std::process::exit(0),
        other => {
            other.map_err(|error| Failure::Io(anyhow::Error::new(error).context("standard output")))
        }
    }
}

/// The exit status that a report's verdict asks for. Where nothing was evaluated, there is nothing that is not OK.
pub(crate) fn status_of(report: &Report) -> Status {
    match report.verdict {
        wire::Status::Ok | wire::Status::Undefined => Status::Done,
        wire::Status::NotOk => Status::NotOk,
        wire::Status::NotDecidable => Status::NotDecidable,
    }
}

/// Ends when the program is interrupted (Ctrl-C) or told to end (SIGTERM), so that ports and pages are given back.
pub(crate) async fn interrupted() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        if let Ok(mut terminate) = signal(SignalKind::terminate()) {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
            return;
        }
    }
    // Where signals cannot be watched the program still ends by them, only less gently.
    let _ = tokio::signal::ctrl_c().await;
}
