//! A report on the disk, whole or not at all.

use std::path::{Path, PathBuf};

use super::Report;
use crate::points::PointsError;
use crate::points::write::write_atomically;
use crate::words::Language;

/// Why a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The name does not say which form is meant.
    #[error(
        "{path}: the ending is {found}, expected .json, .html or .csv; name the file after the form you want"
    )]
    UnknownForm {
        /// The file asked for.
        path: PathBuf,
        /// Its ending.
        found: String,
    },
    /// The disk refused; an older report of that name is as it was.
    #[error(transparent)]
    Write(#[from] PointsError),
}

impl Report {
    /// Writes the form that the ending of `path` names, the page in the language `words`, so that a power cut leaves the old file or the new one.
    ///
    /// # Errors
    /// [`ReportError::UnknownForm`] before anything is written; [`ReportError::Write`] when the disk refuses.
    pub fn write_atomically(&self, path: &Path, words: Language) -> Result<(), ReportError> {
        let ending = path.extension().map(|ending| ending.to_string_lossy());
        let text = match ending.as_deref().map(str::to_ascii_lowercase).as_deref() {
            Some("json") => self.to_json(),
            Some("html" | "htm") => self.to_html(words),
            Some("csv") => self.to_csv(),
            _ => {
                return Err(ReportError::UnknownForm {
                    path: path.to_owned(),
                    found: ending.map_or_else(|| "missing".to_owned(), |e| format!(".{e}")),
                });
            }
        };
        Ok(write_atomically(path, text.as_bytes())?)
    }
}
