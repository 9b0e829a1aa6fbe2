//! `acies demo`: a simulated cell scans a part with known defects, reports, and serves the page where asked.

use std::fs;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions, RunningCell};
use acies_simulators::demo_part::Defects;
use acies_simulators::faults::Faults;
use anyhow::{Context, anyhow};

use super::progress::CellProgress;
use super::{Failure, Status, print_line, status_of};
use crate::cell::{self, CellError, Outcome};
use crate::config::Cell;
use crate::features::{self, Method};
use crate::points::{Neighbors, write_scan};
use crate::report::{Report, print_table, to_ply};
use crate::store::Order;
use crate::words::Language;

/// What the demo's folder holds before the first scan.
const FILES: [(&str, &str); 3] = [
    ("cell.toml", include_str!("../../configs/demo/cell.toml")),
    (
        "recipe.toml",
        include_str!("../../configs/demo/recipe.toml"),
    ),
    ("part.step", include_str!("../../configs/demo/part.step")),
];

/// Plays a whole cell: two laser profilers on a stage, a touch probe, and a part with known defects.
///
/// The devices speak their real protocols on pseudo-terminals; everything in the report follows from their bytes. The part is
/// faulty on purpose (a wall 60 um off, a face tilted by 0.25 degrees, a boss 30 um too large, a chamfer of 0.4 mm, a stretch the
/// lasers cannot see), so the verdict is not OK and the exit status 1.
#[derive(Debug, clap::Args)]
pub struct Demo {
    /// Folder for the cell's files and the report.
    #[arg(short, long, value_name = "FOLDER", default_value = "acies-demo")]
    output: PathBuf,
    /// Seed of the part's place, the noise and the faults: the same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Language of the report's page.
    #[arg(long, value_name = "LANGUAGE", default_value = "en")]
    language: Language,
    /// A part as drawn, without defects.
    #[arg(long)]
    perfect: bool,
    /// What goes wrong at the profilers, as in "unplug-after=100": see `acies simulate --help`.
    #[arg(long, value_name = "FAULTS")]
    faults: Option<Faults>,
    /// Scan in real time, as the instruments would.
    #[arg(long)]
    paced: bool,
    /// Stay as the daemon of the simulated cell, with its page on this address.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8370")]
    serve: Option<SocketAddr>,
    /// Print the report as one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Demo {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the folder cannot be written or a simulated device does not start.
    pub fn run(self) -> Result<Status, Failure> {
        let (_playing, cell) = self.set_up()?;
        if let Some(address) = self.serve {
            return self.serve_cell(cell, address);
        }
        let (outcome, report) = self.inspect(&cell)?;
        self.write(&outcome, &report)?;
        if self.json {
            print_line(&report.to_json())?;
        } else {
            self.show(&outcome, &report)?;
        }
        Ok(status_of(&report))
    }

    /// Stays, as the daemon of the simulated cell; a first part is started at once.
    fn serve_cell(&self, mut cell: Cell, address: SocketAddr) -> Result<Status, Failure> {
        cell.service.address = address;
        cell.service.simulated = true;
        let first = Order {
            part_serial: "DEMO-1".to_owned(),
            ..Order::default()
        };
        super::serve::serve(cell, Arc::new(Cable), Some(first))
    }

    /// Sets the cell up in its folder and plays its devices for as long as the first value lives.
    fn set_up(&self) -> Result<(RunningCell, Cell), Failure> {
        let ports = self.output.join("dev");
        fs::create_dir_all(&ports).map_err(|error| writing(error, &ports))?;
        for (name, text) in FILES {
            let path = self.output.join(name);
            fs::write(&path, text).map_err(|error| writing(error, &path))?;
        }
        let mut options = DemoOptions {
            paced: self.paced,
            ..DemoOptions::new(self.seed)
        };
        if self.perfect {
            options.defects = Defects::none();
        }
        options.faults = self.faults.clone().unwrap_or_default();
        let playing = DemoCell::with_options(options).start(&ports);
        let playing = playing
            .context("the simulated devices")
            .map_err(Failure::Io)?;
        let cell = Cell::read(&self.output.join("cell.toml"))
            .map_err(|errors| Failure::Internal(anyhow!("the demo's own cell\n{errors}")))?;
        Ok((playing, cell))
    }

    fn inspect(&self, cell: &Cell) -> Result<(Outcome, Report), Failure> {
        let mut progress = CellProgress::new();
        let outcome = cell::run(cell, &Cable, &mut |step| progress.tell(&step));
        progress.finish();
        let outcome = outcome.map_err(failure_of)?;
        let report = cell::report_of(
            &outcome,
            "acies-demo-part",
            SystemTime::now(),
            Some(self.seed),
        );
        Ok((outcome, report))
    }

    /// The report in its forms and the scan.
    fn write(&self, outcome: &Outcome, report: &Report) -> Result<(), Failure> {
        for name in ["report.json", "report.html", "report.csv"] {
            let written = report.write_atomically(&self.output.join(name), self.language);
            written.map_err(|error| Failure::Io(error.into()))?;
        }
        let cloud = &outcome.scan.cloud;
        write_scan(&self.output.join("scan.ply"), cloud)
            .map_err(|error| Failure::Io(error.into()))?;
        let neighbors = Neighbors::new(&cloud.positions);
        let classes = features::detect(cloud, &neighbors, Method::Adaptive).classes;
        let features: Vec<u8> = classes.iter().map(|&class| class as u8).collect();
        let coloured = to_ply(cloud, &features).map_err(|error| Failure::Internal(error.into()))?;
        let path = self.output.join("edges.ply");
        crate::points::write::write_atomically(&path, &coloured)
            .map_err(|error| Failure::Io(error.into()))
    }

    fn show(&self, outcome: &Outcome, report: &Report) -> Result<(), Failure> {
        print_line(&print_table(report, std::io::stdout().is_terminal()))?;
        let views = &outcome.scan.views;
        let profiles: u64 = views.iter().map(|view| view.losses.received).sum();
        let lost: u64 = views
            .iter()
            .map(|view| view.losses.lost_on_link + view.losses.dropped_by_device)
            .sum();
        print_line(&format!(
            "{profiles} profiles in {:.2} s ({:.0} a second), {lost} lost; verdict {:.2} s after the last profile",
            outcome.scan_seconds,
            profiles as f64 / outcome.scan_seconds,
            outcome.verdict_seconds
        ))?;
        let folder = self.output.display();
        print_line(&format!(
            "report: {folder}/report.html  (also .json, .csv; scan.ply, edges.ply)"
        ))
    }
}

fn writing(error: std::io::Error, path: &Path) -> Failure {
    let what = format!(
        "{}: cannot be written; choose another folder with --output",
        path.display()
    );
    Failure::Io(anyhow::Error::new(error).context(what))
}

fn failure_of(error: CellError) -> Failure {
    match &error {
        CellError::Nominal(_) | CellError::Recipe { .. } => Failure::BadInput(error.into()),
        CellError::Kind { .. } => Failure::BadInput(error.into()),
        _ => Failure::Io(error.into()),
    }
}
