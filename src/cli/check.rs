//! `acies check CELL.toml`: everything wrong with a configuration, touching no device.

use std::path::PathBuf;

use anyhow::anyhow;

use super::{Failure, Status, print_line};
use crate::config::Cell;

/// Reads a cell's configuration, its part and its recipe, and lists every mistake with its line.
#[derive(Debug, clap::Args)]
pub struct Check {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Check {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input when the configuration has a mistake.
    pub fn run(self) -> Result<Status, Failure> {
        let checked = Cell::read(&self.cell);
        if self.json {
            let mistakes: Vec<serde_json::Value> = match &checked {
                Ok(_) => Vec::new(),
                Err(errors) => errors.mistakes.iter().map(as_json).collect(),
            };
            print_line(
                &serde_json::json!({ "cell": self.cell, "mistakes": mistakes }).to_string(),
            )?;
        }
        let cell = checked.map_err(|errors| {
            let n = errors.mistakes.len();
            Failure::BadInput(anyhow!(
                "{n} mistake{} in the configuration\n{errors}",
                if n == 1 { "" } else { "s" }
            ))
        })?;
        if !self.json {
            let (profilers, probes) = (cell.profilers.len(), cell.probes.len());
            let file = self.cell.display();
            print_line(&format!(
                "{file}: cell {:?} is in order: profilers {profilers}, probes {probes}",
                cell.name
            ))?;
        }
        Ok(Status::Done)
    }
}

fn as_json(mistake: &crate::config::LocatedMistake) -> serde_json::Value {
    serde_json::json!({
        "line": mistake.line,
        "place": mistake.place,
        "key": mistake.mistake.key,
        "found": mistake.mistake.found,
        "expected": mistake.mistake.expected,
    })
}
