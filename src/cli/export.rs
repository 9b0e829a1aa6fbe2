//! `acies export`: the history for those who analyse elsewhere.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::serve::read_cell;
use super::{Failure, Status};
use crate::store::{self, ExportError, History, Store};

/// Writes every result of a cell's store, newest first.
#[derive(Debug, clap::Args)]
pub struct Export {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// csv: a line for each characteristic; json-lines: a whole report a line; parquet: a row for each station.
    #[arg(long, value_enum, default_value_t = Form::Csv)]
    form: Form,
    /// Where to; standard output where nothing is said.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Only of this part.
    #[arg(long, value_name = "SERIAL")]
    part: Option<String>,
    /// Only of this production order.
    #[arg(long, value_name = "ORDER")]
    order: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Form {
    Csv,
    JsonLines,
    #[cfg(feature = "parquet")]
    Parquet,
}

impl Export {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the store cannot be read or the file cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        let store = Store::open(&cell.service.store).map_err(|error| Failure::Io(error.into()))?;
        let form = match self.form {
            Form::Csv => store::Export::Csv,
            Form::JsonLines => store::Export::JsonLines,
            #[cfg(feature = "parquet")]
            Form::Parquet => store::Export::Parquet,
        };
        let history = History {
            part_serial: self.part,
            order_number: self.order,
            ..History::default()
        };
        let written = match &self.output {
            None => store
                .export(form, &history, &mut std::io::stdout())
                .map_err(|error| Failure::Io(error.into()))?,
            Some(path) => {
                into_file(path, |out| store.export(form, &history, out)).map_err(Failure::Io)?
            }
        };
        tracing::info!(inspections = written, "exported");
        Ok(Status::Done)
    }
}

/// Writes a file that has its name only when it is whole; nothing is left of one that failed.
fn into_file(
    path: &Path,
    write: impl FnOnce(&mut (dyn Write + Send)) -> Result<u64, ExportError>,
) -> anyhow::Result<u64> {
    let place = || {
        format!(
            "{}: cannot be written; choose another file with --output",
            path.display()
        )
    };
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let file = File::create(&part).with_context(place)?;
    let written = write(&mut BufWriter::new(file)).map_err(anyhow::Error::from);
    let placed = written.and_then(|count| {
        fs::rename(&part, path).with_context(place)?;
        Ok(count)
    });
    if placed.is_err() {
        // It failed already; that is what is told.
        let _ = fs::remove_file(&part);
    }
    placed
}
