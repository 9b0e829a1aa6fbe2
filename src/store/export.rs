//! The history for those who analyse elsewhere: CSV, JSON lines, and Parquet where it is built in.

use std::io::{self, Write};

use super::{History, Inspection, Phase, Store, StoreError};
use crate::report::Report;

/// In which form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// One line for each characteristic of each inspection.
    Csv,
    /// One inspection with its whole report a line.
    JsonLines,
    /// One Parquet table, a row for each station.
    #[cfg(feature = "parquet")]
    Parquet,
}

/// Why an export did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A stored report.
    #[error("the report of inspection {id}: {source}; it is damaged, restore it from a backup")]
    Report {
        /// Whose.
        id: i64,
        /// What is wrong with it.
        #[source]
        source: serde_json::Error,
    },
    /// Where it was to go.
    #[error("the export cannot be written: {0}")]
    Write(#[from] io::Error),
    /// Where it was to go, for a table.
    #[error("the export cannot be written: {0}")]
    Csv(#[from] csv::Error),
    /// Where it was to go, for Parquet.
    #[cfg(feature = "parquet")]
    #[error("the export cannot be written: {0}")]
    Parquet(#[from] ::parquet::errors::ParquetError),
}

/// Inspections read at a time.
const PAGE: u32 = 200;

impl Store {
    /// Writes all finished inspections that `history` asks for, newest first, to `out`. Memory does not grow with their number.
    ///
    /// # Errors
    /// [`ExportError`].
    pub fn export(
        &self,
        form: Export,
        history: &History,
        out: &mut (dyn Write + Send),
    ) -> Result<u64, ExportError> {
        let written = match form {
            Export::JsonLines => self.each_report(history, &mut |inspection, json| {
                let head = serde_json::to_string(inspection).unwrap_or_default();
                Ok(writeln!(
                    out,
                    "{{\"inspection\":{head},\"report\":{json}}}"
                )?)
            })?,
            Export::Csv => {
                let mut table = csv::Writer::from_writer(&mut *out);
                table.write_record(HEADINGS)?;
                let written = self.each_report(history, &mut |inspection, json| {
                    Ok(rows(&mut table, inspection, &parsed(inspection, json)?)?)
                })?;
                table.flush()?;
                written
            }
            #[cfg(feature = "parquet")]
            Export::Parquet => self.export_parquet(history, out)?,
        };
        out.flush()?;
        Ok(written)
    }

    /// Shows every inspection that has a report, and the report's JSON, to `show`; says how many there were.
    pub(super) fn each_report(
        &self,
        history: &History,
        show: &mut dyn FnMut(&Inspection, &str) -> Result<(), ExportError>,
    ) -> Result<u64, ExportError> {
        let mut page = History {
            limit: Some(PAGE),
            ..history.clone()
        };
        let mut shown = 0;
        loop {
            let inspections = self.history(&page)?;
            let Some(last) = inspections.last() else {
                return Ok(shown);
            };
            page.before = Some(last.id);
            for inspection in &inspections {
                // Only what is done has a result; one that cannot be read is an error and no gap.
                if inspection.phase == Phase::Done {
                    show(inspection, &self.report_json(inspection.id)?)?;
                    shown += 1;
                }
            }
        }
    }
}

/// The report in `json`, which belongs to `inspection`.
pub(super) fn parsed(inspection: &Inspection, json: &str) -> Result<Report, ExportError> {
    serde_json::from_str(json).map_err(|source| ExportError::Report {
        id: inspection.id,
        source,
    })
}

const HEADINGS: [&str; 16] = [
    "inspection",
    "part_serial",
    "order_number",
    "purpose",
    "operator",
    "ended",
    "simulated",
    "verdict",
    "recipe_sha256",
    "characteristic",
    "value",
    "unit",
    "u",
    "lower",
    "upper",
    "characteristic_verdict",
];

fn rows<W: Write>(
    table: &mut csv::Writer<W>,
    inspection: &Inspection,
    report: &Report,
) -> csv::Result<()> {
    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let purpose = serde_json::to_value(inspection.purpose).unwrap_or_default();
    for found in super::inspections::measured(report) {
        table.write_record([
            inspection.id.to_string(),
            inspection.part_serial.clone(),
            inspection.order_number.clone(),
            purpose.as_str().unwrap_or_default().to_owned(),
            inspection.operator.clone(),
            inspection.ended.clone().unwrap_or_default(),
            inspection.simulated.to_string(),
            super::inspections::status_word(report.verdict).to_owned(),
            report.recipe.sha256.clone(),
            found.name,
            number(found.value),
            found.unit,
            number(found.u),
            number(found.lower),
            number(found.upper),
            super::inspections::status_word(found.verdict).to_owned(),
        ])?;
    }
    Ok(())
}
