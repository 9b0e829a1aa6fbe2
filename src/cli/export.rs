//! `acies export`: the history for those who analyse elsewhere.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;

use anyhow::Context;

use super::serve::read_cell;
use super::{Failure, Status};
use crate::store::{self, History, Store};

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
        let mut out: Box<dyn Write + Send> = match &self.output {
            None => Box::new(std::io::stdout()),
            Some(path) => {
                let file = File::create(path)
                    .with_context(|| {
                        format!(
                            "{}: cannot be written; choose another file with --output",
                            path.display()
                        )
                    })
                    .map_err(Failure::Io)?;
                Box::new(BufWriter::new(file))
            }
        };
        let written = store
            .export(form, &history, &mut out)
            .map_err(|error| Failure::Io(error.into()))?;
        tracing::info!(inspections = written, "exported");
        Ok(Status::Done)
    }
}
