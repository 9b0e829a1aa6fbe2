//! `acies support-bundle`: what somebody who is to help needs, in one file, and nothing that is secret.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use anyhow::Context;
use flate2::Compression;
use flate2::write::GzEncoder;

use super::serve::read_cell;
use super::{Failure, Status, print_line};
use crate::store::{History, Store};

/// Newest inspections of which everything is taken along.
const INSPECTIONS: u32 = 200;
/// Lines of the system's log.
const LOG_LINES: &str = "5000";

/// Writes configuration, recipes, history, audit log and the system's log of a cell into one `.tar.gz`.
///
/// Passwords, tokens and scans are not in it. Look at it before you send it: part numbers, names and nominals are.
#[derive(Debug, clap::Args)]
pub struct SupportBundle {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// Where to.
    #[arg(
        short,
        long,
        value_name = "FILE",
        default_value = "acies-support.tar.gz"
    )]
    output: PathBuf,
}

impl SupportBundle {
    /// Carries the command out. What cannot be had is said in the bundle and left out.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let mut bundle = Bundle::create(&self.output).map_err(Failure::Io)?;
        let filled = self.fill(&mut bundle).and_then(|()| bundle.finish());
        filled
            .with_context(|| format!("{}: cannot be written", self.output.display()))
            .map_err(Failure::Io)?;
        print_line(&format!("support bundle: {}", self.output.display()))?;
        Ok(Status::Done)
    }

    fn fill(&self, bundle: &mut Bundle) -> anyhow::Result<()> {
        let mut about = format!(
            "acies {}\nwritten {}\n",
            env!("CARGO_PKG_VERSION"),
            humantime::format_rfc3339_seconds(SystemTime::now())
        );
        for (what, command, arguments) in [
            ("system", "uname", &["-a"][..]),
            ("disk", "df", &["-h"]),
            ("memory", "free", &["-m"]),
        ] {
            let _ = writeln!(about, "\n{what}:\n{}", output_of(command, arguments));
        }
        bundle.add("about.txt", about.as_bytes())?;
        let log = [
            "-u",
            "acies",
            "-n",
            LOG_LINES,
            "--no-pager",
            "-o",
            "short-iso-precise",
        ];
        bundle.add("log.txt", output_of("journalctl", &log).as_bytes())?;
        let configuration =
            fs::read(&self.cell).unwrap_or_else(|error| error.to_string().into_bytes());
        bundle.add("cell.toml", &configuration)?;
        match read_cell(&self.cell) {
            Ok(cell) => match Store::open(&cell.service.store) {
                Ok(store) => from_store(&store, bundle),
                Err(error) => bundle.add("store.txt", error.to_string().as_bytes()),
            },
            Err(failure) => bundle.add("mistakes.txt", failure.to_string().as_bytes()),
        }
    }
}

fn from_store(store: &Store, bundle: &mut Bundle) -> anyhow::Result<()> {
    let newest = History {
        limit: Some(INSPECTIONS),
        ..History::default()
    };
    bundle.json("store.json", &store.usage()?)?;
    bundle.json("history.json", &store.history(&newest)?)?;
    bundle.json("audit.json", &store.audit_log(None, 2000)?)?;
    bundle.json("people.json", &store.people()?)?;
    for version in store.recipes()? {
        let text = store.recipe(version.id)?.text;
        let name = format!("recipes/{}-v{}.toml", safe(&version.name), version.version);
        bundle.add(&name, text.as_bytes())?;
    }
    for inspection in store.history(&newest)? {
        if let Ok(report) = store.report_json(inspection.id) {
            bundle.add(
                &format!("reports/{}.json", inspection.id),
                report.as_bytes(),
            )?;
        }
    }
    Ok(())
}

/// What a program prints, or why it cannot be had.
fn output_of(command: &str, arguments: &[&str]) -> String {
    match Command::new(command).args(arguments).output() {
        Ok(output) => String::from_utf8_lossy(&output.stdout).into_owned(),
        Err(error) => format!("{command}: {error}"),
    }
}

/// A name that is one part of a path, whatever somebody called the recipe.
fn safe(name: &str) -> String {
    name.chars()
        .map(|c| {
            if c.is_alphanumeric() || c == '-' {
                c
            } else {
                '_'
            }
        })
        .collect()
}

/// A `.tar.gz` that grows.
struct Bundle {
    archive: tar::Builder<GzEncoder<File>>,
    at: u64,
}

impl Bundle {
    fn create(path: &Path) -> anyhow::Result<Self> {
        let file = File::create(path).with_context(|| {
            format!(
                "{}: cannot be written; choose another file with --output",
                path.display()
            )
        })?;
        let now = SystemTime::now()
            .duration_since(SystemTime::UNIX_EPOCH)
            .unwrap_or_default();
        Ok(Self {
            archive: tar::Builder::new(GzEncoder::new(file, Compression::default())),
            at: now.as_secs(),
        })
    }

    fn add(&mut self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o600);
        header.set_mtime(self.at);
        let path = format!("acies-support/{name}");
        Ok(self.archive.append_data(&mut header, path, bytes)?)
    }

    fn json(&mut self, name: &str, value: &impl serde::Serialize) -> anyhow::Result<()> {
        self.add(name, &serde_json::to_vec_pretty(value)?)
    }

    fn finish(&mut self) -> anyhow::Result<()> {
        self.archive.finish()?;
        Ok(self.archive.get_mut().try_finish()?)
    }
}
