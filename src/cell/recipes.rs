//! From the configured files and the store to the part that is compared with: the last good one stays.

use std::sync::Arc;
use std::time::SystemTime;

use super::CellError;
use super::devices::chain;
use super::job::{Part, check_recipe, read_nominal};
use crate::config::Cell;
use crate::store::{NewRecipe, RecipeContent, RecipeVersion, Store};

/// What there is to compare parts with.
pub(super) struct Prepared {
    /// The active version, read.
    pub active: Option<(Arc<Part>, RecipeVersion)>,
    /// What is wrong with the configured files or the active version; empty where nothing is.
    pub problem: String,
}

/// Takes the configured recipe and nominal into the store where their content is new there, and reads the active version.
///
/// Content that the store has already is not activated again: somebody may have activated another version since.
///
/// # Errors
/// [`CellError::Store`] only; a recipe that cannot be read is [`Prepared::problem`].
pub(super) fn prepare(cell: &Cell, store: &Store, now: SystemTime) -> Result<Prepared, CellError> {
    let mut problem = String::new();
    if let Err(error) = take(cell, store, now) {
        if let CellError::Store(_) = error {
            return Err(error);
        }
        problem = chain(&error);
        tracing::error!(
            error = problem,
            "the configured recipe; the last good one stays active"
        );
    }
    let active = match store.active_recipe()? {
        None => None,
        Some(content) => match load(&content) {
            Ok(part) => Some((Arc::new(part), content.version)),
            Err(error) => {
                problem = chain(&error);
                None
            }
        },
    };
    Ok(Prepared { active, problem })
}

fn take(cell: &Cell, store: &Store, now: SystemTime) -> Result<(), CellError> {
    let read = |path: &std::path::Path| {
        std::fs::read(path).map_err(|source| CellError::RecipeFile {
            path: path.to_owned(),
            source,
        })
    };
    let nominal = read(&cell.nominal)?;
    let (text, place) = match &cell.recipe {
        None => (String::new(), String::new()),
        Some(path) => {
            let bytes = read(path)?;
            (
                String::from_utf8_lossy(&bytes).into_owned(),
                path.display().to_string(),
            )
        }
    };
    let known = store.recipes()?.len();
    // Checked before it is taken: what the store holds can be read.
    check_recipe(&text, &place)?;
    read_nominal(&cell.nominal)?;
    let name = cell
        .nominal
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy();
    let nominal_name = cell
        .nominal
        .file_name()
        .unwrap_or_default()
        .to_string_lossy();
    let new = NewRecipe {
        name: &name,
        text: &text,
        nominal_name: &nominal_name,
        nominal: &nominal,
        author: "configuration",
        why: "the configured files",
    };
    let version = store.add_recipe(&new, now)?;
    let is_new = store.recipes()?.len() > known;
    if is_new || store.active_recipe()?.is_none() {
        store.activate_recipe(version.id, "configuration", "the configured files", now)?;
    }
    Ok(())
}

/// Reads a version.
///
/// # Errors
/// [`CellError::Nominal`] and [`CellError::Recipe`].
pub(super) fn load(content: &RecipeContent) -> Result<Part, CellError> {
    let place = format!(
        "recipe {} v{}",
        content.version.name, content.version.version
    );
    Ok(Part {
        nominal: read_nominal(&content.nominal)?,
        nominal_name: content.version.nominal_name.clone(),
        recipe: check_recipe(&content.text, &place)?,
    })
}
