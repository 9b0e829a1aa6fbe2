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

/// Takes the configured recipe and nominal into the store where the files have changed, and reads the active version.
///
/// Files that are as they were when they were last taken change nothing: somebody may have activated another version since.
///
/// # Errors
/// [`CellError::Store`] only; a recipe that cannot be read is [`Prepared::problem`].
pub(super) fn prepare(cell: &Cell, store: &Store, now: SystemTime) -> Result<Prepared, CellError> {
    let mut problem = String::new();
    let mut taken = None;
    match take(cell, store, now) {
        Ok(read) => taken = read,
        Err(CellError::Store(error)) => return Err(error.into()),
        Err(error) => {
            problem = chain(&error);
            tracing::error!(
                error = problem,
                "the configured recipe; the last good one stays active"
            );
        }
    }
    let active = match (store.active_recipe()?, taken) {
        (None, _) => None,
        // A nominal takes a while to read: once is enough.
        (Some(content), Some((id, part))) if content.version.id == id => {
            Some((Arc::new(part), content.version))
        }
        (Some(content), _) => match load(&content) {
            Ok(part) => Some((Arc::new(part), content.version)),
            Err(error) => {
                problem = chain(&error);
                None
            }
        },
    };
    Ok(Prepared { active, problem })
}

/// Takes the configured files into the store and activates them where they have changed; then they have been read as well.
fn take(cell: &Cell, store: &Store, now: SystemTime) -> Result<Option<(i64, Part)>, CellError> {
    let read = |path: &std::path::Path| {
        std::fs::read(path).map_err(|source| CellError::RecipeFile {
            path: path.to_owned(),
            source,
        })
    };
    let nominal = read(&cell.nominal)?;
    let (text, place) = match &cell.recipe {
        None => (String::new(), String::new()),
        Some(path) => (
            String::from_utf8_lossy(&read(path)?).into_owned(),
            path.display().to_string(),
        ),
    };
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
    if store.is_configured(&new)? && store.active_recipe()?.is_some() {
        return Ok(None);
    }
    // Checked before it is taken: what the store holds can be read.
    let recipe = check_recipe(&text, &place)?;
    let nominal = read_nominal(&cell.nominal)?;
    let part = Part::new(nominal, nominal_name.to_string(), recipe);
    let version = store.add_recipe(&new, now)?;
    store.activate_recipe(version.id, new.author, new.why, now)?;
    store.note_configured(&new)?;
    Ok(Some((version.id, part)))
}

/// Whether two versions judge alike: the same nominal, limits, decision rule, datums and uncertainties. They may differ in words, and
/// in how densely and how deeply an edge is looked at.
///
/// # Errors
/// [`CellError::Recipe`].
pub fn judge_alike(one: &RecipeContent, other: &RecipeContent) -> Result<bool, CellError> {
    let judging = |content: &RecipeContent| {
        let mut recipe = check_recipe(&content.text, &content.version.name)?;
        recipe.sha256.clear();
        (recipe.station_step_mm, recipe.flank_mm) = (None, None);
        for edge in &mut recipe.edges {
            edge.station_step_mm = None;
        }
        Ok::<_, CellError>(recipe)
    };
    let same_part = one.version.nominal_sha256 == other.version.nominal_sha256;
    Ok(same_part && judging(one)? == judging(other)?)
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
    Ok(Part::new(
        read_nominal(&content.nominal)?,
        content.version.nominal_name.clone(),
        check_recipe(&content.text, &place)?,
    ))
}
