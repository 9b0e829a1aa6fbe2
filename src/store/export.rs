//! The history for those who analyse elsewhere: CSV, JSON lines.

use std::io::{self, Write};

use super::{History, Store, StoreError};
use crate::report::Report;

/// In which form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Export {
    /// One line for each characteristic of each inspection.
    Csv,
    /// One inspection with its whole report a line.
    JsonLines,
}

/// Why an export did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Where it was to go.
    #[error("the export cannot be written: {0}")]
    Write(#[from] io::Error),
    /// Where it was to go, for a table.
    #[error("the export cannot be written: {0}")]
    Csv(#[from] csv::Error),
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
        out: &mut dyn Write,
    ) -> Result<u64, ExportError> {
        let mut table = csv::Writer::from_writer(Vec::new());
        if form == Export::Csv {
            table.write_record(HEADINGS)?;
        }
        let mut page = History {
            limit: Some(PAGE),
            ..history.clone()
        };
        let mut written = 0;
        loop {
            let inspections = self.history(&page)?;
            let Some(last) = inspections.last() else {
                break;
            };
            page.before = Some(last.id);
            for inspection in &inspections {
                // An inspection without a result has no report.
                let Ok(json) = self.report_json(inspection.id) else {
                    continue;
                };
                written += 1;
                match form {
                    Export::JsonLines => {
                        let head = serde_json::to_string(inspection).unwrap_or_default();
                        writeln!(out, "{{\"inspection\":{head},\"report\":{json}}}")?;
                    }
                    Export::Csv => {
                        let Ok(report) = serde_json::from_str::<Report>(&json) else {
                            continue;
                        };
                        rows(&mut table, inspection, &report)?;
                        table.flush()?;
                        out.write_all(table.get_ref())?;
                        table = csv::Writer::from_writer(Vec::new());
                    }
                }
            }
        }
        table.flush()?;
        out.write_all(table.get_ref())?;
        out.flush()?;
        Ok(written)
    }
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

fn rows(
    table: &mut csv::Writer<Vec<u8>>,
    inspection: &super::Inspection,
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
