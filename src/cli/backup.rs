//! `acies backup`, `acies restore`: everything a cell knows, into a folder and back.

use std::path::PathBuf;

use super::serve::read_cell;
use super::{Failure, Status, print_line};
use crate::store::{self, Store};

/// Writes the whole store of a cell (results, scans, recipes, people, audit log) into a new folder, while the daemon runs.
#[derive(Debug, clap::Args)]
pub struct Backup {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// A folder that is not there yet.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
}

/// Puts a backup in the place of a cell's store; the daemon must not run. What was there stays beside it.
#[derive(Debug, clap::Args)]
pub struct Restore {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// What `acies backup` wrote.
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
}

impl Backup {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the store cannot be read or the folder cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let store = Store::open(&cell.service.store).map_err(|error| Failure::Io(error.into()))?;
        store
            .backup(&self.folder)
            .map_err(|error| Failure::Io(error.into()))?;
        print_line(&format!("backup: {}", self.folder.display()))?;
        Ok(Status::Done)
    }
}

impl Restore {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the backup is damaged or the store's place cannot be written; the store is untouched then.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let target = &cell.service.store;
        store::restore(&self.folder, target).map_err(|error| Failure::Io(error.into()))?;
        print_line(&format!(
            "restored: {} (what was there: {}.before-restore)",
            target.display(),
            target.display()
        ))?;
        Ok(Status::Done)
    }
}
