//! `acies inspect SCAN --nominal PART`: how far every sharp edge of a scan lies from its nominal.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, SystemTime};

use anyhow::anyhow;
use indicatif::ProgressBar;

use super::{Failure, Status, print_line, status_of};
use crate::cell::{CellError, read_recipe};
use crate::inspect::{self, Inspection, MonteCarlo, Recipe, Request, Start, Uncertainty};
use crate::nominal::{Nominal, NominalError};
use crate::points::{self, PointsError, Read, Unit};
use crate::report::{Facts, Report, ScanFacts, print_table};
use crate::words::Language;

/// Measures every sharp edge of a scanned part against its CAD model.
///
/// Aligns the scan to the model, fits both flanks of every sharp edge outside its edge break, intersects them, and says how far the edge
/// lies from nominal along each face's normal, with standard uncertainties. Without a recipe nothing is judged and the
/// verdict is `undefined`. Exit status: 0 done (and OK), 1 not OK, 2 not decidable.
#[derive(Debug, clap::Args)]
pub struct Inspect {
    /// The scan: PLY, PCD, STL, OBJ or text with columns x y z.
    scan: PathBuf,
    /// The part's model: a STEP file.
    #[arg(long, value_name = "PART")]
    nominal: PathBuf,
    /// Limits, decision rule, datum faces, calibration, as TOML.
    #[arg(long, value_name = "R.toml")]
    recipe: Option<PathBuf>,
    /// Where the scan lies: `auto` finds its pose from nothing, `none` takes it as lying in the part frame already.
    #[arg(long, value_name = "HOW", default_value = "auto")]
    align: Alignment,
    /// Unit of the scan: um, mm, cm, m or in. PLY, PCD and STL do not say.
    #[arg(long, default_value = "mm")]
    unit: Unit,
    /// Temperature of the part when it was scanned, degrees Celsius. A recipe may ask for it.
    #[arg(long, value_name = "CELSIUS", allow_negative_numbers = true)]
    temperature: Option<f64>,
    /// How uncertainties are propagated: `first-order`, or `monte-carlo[=N]` by trials (JCGM 101), N of them or until they stand still.
    #[arg(long, value_name = "HOW", default_value = "first-order", value_parser = uncertainty)]
    uncertainty: Uncertainty,
    /// Seed of the trials: the same seed gives the same numbers.
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    seed: u64,
    /// Say of every station what its uncertainties are made of.
    #[arg(long)]
    budget: bool,
    /// Write the report; the ending .json, .html or .csv says in which form. May be given several times.
    #[arg(short, long, value_name = "REPORT")]
    output: Vec<PathBuf>,
    /// Language of the .html form. Data forms and the terminal are in English.
    #[arg(long, value_name = "LANGUAGE", default_value = "en")]
    language: Language,
    /// Print the report as one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// JCGM 101 asks for 10,000 trials for a 95 % interval with two digits; a hundred show a standard deviation to 7 %.
const TRIALS: std::ops::RangeInclusive<usize> = 100..=10_000_000;

fn uncertainty(text: &str) -> Result<Uncertainty, String> {
    let expected = || {
        format!(
            "{text:?}, expected first-order, monte-carlo or monte-carlo=N with N of {} to {}",
            TRIALS.start(),
            TRIALS.end()
        )
    };
    match text.split_once('=') {
        None if text == "first-order" => Ok(Uncertainty::FirstOrder),
        None if text == "monte-carlo" => Ok(Uncertainty::MonteCarlo(MonteCarlo::default())),
        Some(("monte-carlo", trials)) => trials
            .parse()
            .ok()
            .filter(|trials| TRIALS.contains(trials))
            .map(|trials| Uncertainty::MonteCarlo(MonteCarlo::of_trials(trials)))
            .ok_or_else(expected),
        _ => Err(expected()),
    }
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Alignment {
    /// The pose is found from nothing.
    Auto,
    /// The scan lies in the part frame already.
    None,
}

impl Inspect {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where scan, model or recipe cannot be understood; input or output where a file cannot be read or written.
    pub fn run(self) -> Result<Status, Failure> {
        let recipe = read_recipe(self.recipe.as_deref()).map_err(|error| match error {
            CellError::RecipeFile { .. } => Failure::Io(error.into()),
            _ => Failure::BadInput(error.into()),
        })?;
        let nominal = Nominal::read(&self.nominal).map_err(|error| match error {
            NominalError::Io { .. } => Failure::Io(error.into()),
            _ => Failure::BadInput(error.into()),
        })?;
        if nominal.sharp_edges.is_empty() {
            return Err(Failure::BadInput(anyhow!(
                "{}: no sharp edge, expected at least one; nothing can be measured",
                self.nominal.display()
            )));
        }
        let scan = points::read(&self.scan, self.unit).map_err(|error| match error {
            PointsError::Read { .. } => Failure::Io(error.into()),
            _ => Failure::BadInput(error.into()),
        })?;
        let mut inspection = self.inspect(&scan, &nominal, &recipe);
        inspection.findings.extend(scan.findings.iter().cloned());
        let facts = self.facts(&scan, recipe, &inspection);
        let report = Report::new(&inspection, &facts);
        for path in &self.output {
            report
                .write_atomically(path, self.language)
                .map_err(|error| match error {
                    crate::report::ReportError::UnknownForm { .. } => Failure::Usage(error.into()),
                    crate::report::ReportError::Write(_) => Failure::Io(error.into()),
                })?;
        }
        if self.json {
            print_line(&report.to_json())?;
        } else {
            print_line(&print_table(&report, std::io::stdout().is_terminal()))?;
        }
        Ok(status_of(&report))
    }

    fn inspect(&self, scan: &Read, nominal: &Nominal, recipe: &Recipe) -> Inspection {
        let line = Mutex::new(ProgressBar::hidden());
        let began = std::time::Instant::now();
        let tell = |stage: &'static str| {
            let Ok(mut line) = line.lock() else { return };
            // Nothing is said of what takes less than a second.
            if line.is_hidden() && began.elapsed() > Duration::from_secs(1) {
                *line = ProgressBar::new_spinner();
                line.enable_steady_tick(Duration::from_millis(120));
            }
            line.set_message(stage);
        };
        let start = match self.align {
            Alignment::Auto => Start::Auto,
            Alignment::None => Start::None,
        };
        let told = |done: usize, of: usize| {
            if let Ok(line) = line.lock() {
                line.set_message(format!("edges: trials of {done} of {of}"));
            }
        };
        let uncertainty = match self.uncertainty {
            Uncertainty::MonteCarlo(how) => Uncertainty::MonteCarlo(MonteCarlo {
                seed: self.seed,
                ..how
            }),
            first_order => first_order,
        };
        let request = Request {
            uncertainty,
            trials_done: &told,
            progress: &tell,
            temperature_c: self.temperature,
            ..Request::new(recipe, start)
        };
        let inspection = inspect::inspect(&scan.cloud, nominal, &request);
        if let Ok(line) = line.lock() {
            line.finish_and_clear();
        }
        inspection
    }

    fn facts(&self, scan: &Read, recipe: Recipe, inspection: &Inspection) -> Facts {
        let estimate = inspection.scan.as_ref();
        let lines = estimate.filter(|e| e.spacing.in_lines());
        Facts {
            with_budgets: self.budget,
            part: part_name(&self.nominal),
            nominal: file_name(&self.nominal),
            // The file's time is as near as a file can say when it was scanned.
            created: std::fs::metadata(&self.scan)
                .and_then(|data| data.modified())
                .unwrap_or_else(|_| SystemTime::now()),
            simulated_seed: None,
            scan: ScanFacts {
                points: scan.cloud.len(),
                spacing_mm: estimate.map(|e| e.spacing.mean_mm),
                spacing_along_line_mm: lines.map(|e| e.spacing.along_mm),
                spacing_across_lines_mm: lines.map(|e| e.spacing.across_mm),
                noise_mm: estimate.map(|e| e.noise_mm),
            },
            devices: Vec::new(),
            recipe,
        }
    }
}

/// What people call the part: the model's file without its ending.
fn part_name(path: &Path) -> String {
    path.file_stem()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
        .into_owned()
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or(path.as_os_str())
        .to_string_lossy()
        .into_owned()
}
