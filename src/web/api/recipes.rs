//! Recipes: versions by content, checked before they are kept, activated with a reason.

use std::path::PathBuf;
use std::time::SystemTime;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::file as as_file;
use crate::cell::{CellError, Handle, check_recipe, judge_alike};
use crate::nominal::Nominal;
use crate::store::{NewRecipe, RecipeContent, RecipeVersion, Role, Store};
use crate::web::access::Who;
use crate::web::app::App;
use crate::web::password::secret;
use crate::web::problem::{Asked, Input, Place, Problem, chain};

/// All versions, newest first.
#[utoipa::path(get, path = "/api/v1/recipes", tag = "recipes",
    responses((status = 200, description = "without their texts", body = Vec<RecipeVersion>)))]
pub async fn list(State(app): State<App>) -> Result<Json<Vec<RecipeVersion>>, Problem> {
    Ok(Json(app.store(Store::recipes).await?))
}

/// A version with its text.
#[derive(Debug, Serialize, ToSchema)]
pub struct WithText {
    #[serde(flatten)]
    version: RecipeVersion,
    /// TOML.
    text: String,
}

/// One version with its text.
#[utoipa::path(get, path = "/api/v1/recipes/{id}", tag = "recipes", params(("id" = i64, Path)),
    responses((status = 200, description = "the version", body = WithText)))]
pub async fn one(State(app): State<App>, Place(id): Place<i64>) -> Result<Json<WithText>, Problem> {
    let content = app.store(move |store| store.recipe(id)).await?;
    Ok(Json(WithText {
        version: content.version,
        text: content.text,
    }))
}

/// The word by which a file of ours is known.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub enum Format {
    /// The first version of the format.
    #[serde(rename = "acies-recipe/1")]
    First,
}

/// A recipe with its nominal in one file, to be taken from cell to cell.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct RecipeFile {
    /// `acies-recipe/1`.
    format: Format,
    /// What the line calls it.
    #[schema(min_length = 1, max_length = 100)]
    name: String,
    /// TOML.
    text: String,
    /// File name of the nominal, with its ending.
    #[schema(min_length = 1, max_length = 100)]
    nominal_name: String,
    /// The nominal's bytes in base64.
    nominal_base64: String,
}

/// One version with its nominal as one file.
#[utoipa::path(get, path = "/api/v1/recipes/{id}/file", tag = "recipes", params(("id" = i64, Path)),
    responses((status = 200, description = "the file", body = RecipeFile)))]
pub async fn file(State(app): State<App>, Place(id): Place<i64>) -> Result<Response, Problem> {
    let made = app.heavy(move |handle| {
        let content = handle.store().recipe(id)?;
        let file = RecipeFile {
            format: Format::First,
            name: content.version.name.clone(),
            nominal_name: content.version.nominal_name.clone(),
            nominal_base64: STANDARD.encode(nominal_of(&content)?),
            text: content.text,
        };
        Ok::<_, Problem>(serde_json::to_string_pretty(&file).unwrap_or_default())
    });
    let name = format!("recipe-{id}.json");
    Ok(as_file("application/json", &name, made.await?).into_response())
}

fn nominal_of(content: &RecipeContent) -> Result<Vec<u8>, Problem> {
    std::fs::read(&content.nominal)
        .map_err(|error| Problem::fault(format!("{}: {error}", content.nominal.display())))
}

/// A recipe's text and its nominal: either that of a version that is there, or one that is sent along.
#[derive(Debug, Deserialize, ToSchema)]
pub struct Draft {
    /// TOML.
    text: String,
    /// The version whose nominal it is for.
    nominal_of: Option<i64>,
    /// File name of a nominal that is sent along, with its ending.
    nominal_name: Option<String>,
    /// Its bytes in base64.
    nominal_base64: Option<String>,
}

/// A version that is to be kept.
#[derive(Debug, Deserialize, ToSchema)]
pub struct NewVersion {
    /// What the line calls it.
    #[schema(min_length = 1, max_length = 100)]
    name: String,
    #[serde(flatten)]
    draft: Draft,
    /// Why it is made.
    #[schema(min_length = 1, max_length = 500)]
    why: String,
}

/// What a check found.
#[derive(Debug, Serialize, ToSchema)]
pub struct Checked {
    /// Whether it could be kept and activated.
    ok: bool,
    /// Everything that is wrong, a line each.
    mistakes: Vec<String>,
    /// Sharp edges of the nominal; null where it cannot be read.
    sharp_edges: Option<usize>,
}

/// Check a recipe without keeping it.
#[utoipa::path(post, path = "/api/v1/recipes/check", tag = "recipes", request_body = Draft,
    responses((status = 200, description = "what is wrong with it, if anything", body = Checked)))]
pub async fn check(
    State(app): State<App>,
    Input(draft): Input<Draft>,
) -> Result<Json<Checked>, Problem> {
    let checked = app.heavy(move |handle| {
        let (name, bytes) = nominal_in(handle.store(), &draft)?;
        checked(handle, &draft.text, &name, &bytes)
    });
    Ok(Json(checked.await?))
}

/// Keep a new version. It is not active until it is activated.
#[utoipa::path(post, path = "/api/v1/recipes", tag = "recipes", request_body = NewVersion,
    responses((status = 201, description = "kept; the version that is there already where the content is the same", body = RecipeVersion)))]
pub async fn add(
    State(app): State<App>,
    who: Who,
    Input(new): Input<NewVersion>,
) -> Result<(StatusCode, Json<RecipeVersion>), Problem> {
    let version = app.heavy(move |handle| {
        let (nominal_name, nominal) = nominal_in(handle.store(), &new.draft)?;
        let new = NewRecipe {
            name: &new.name,
            text: &new.draft.text,
            nominal_name: &nominal_name,
            nominal: &nominal,
            author: &who.name,
            why: &new.why,
        };
        keep(handle, &new)
    });
    Ok((StatusCode::CREATED, Json(version.await?)))
}

/// Why a file is imported.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct Why {
    /// In a few words.
    why: String,
}

/// Keep a recipe and its nominal from one file.
#[utoipa::path(post, path = "/api/v1/recipes/import", tag = "recipes", params(Why), request_body = RecipeFile,
    responses((status = 201, description = "kept; not active yet", body = RecipeVersion)))]
pub async fn import(
    State(app): State<App>,
    who: Who,
    Asked(Why { why }): Asked<Why>,
    Input(file): Input<RecipeFile>,
) -> Result<(StatusCode, Json<RecipeVersion>), Problem> {
    let version = app.heavy(move |handle| {
        let nominal = decoded(&file.nominal_base64)?;
        let why = if why.is_empty() { "imported" } else { &why };
        let new = NewRecipe {
            name: &file.name,
            text: &file.text,
            nominal_name: &file.nominal_name,
            nominal: &nominal,
            author: &who.name,
            why,
        };
        keep(handle, &new)
    });
    Ok((StatusCode::CREATED, Json(version.await?)))
}

/// Why a version is activated.
#[derive(Debug, Deserialize, ToSchema)]
pub struct Activation {
    /// The reason, for the audit log.
    #[schema(min_length = 1, max_length = 500)]
    why: String,
}

/// Judge parts by this version from the next one on.
///
/// A setter may do so where it was in force before or judges as the one in force does; what changes the judgement is put in force
/// by a metrologist.
#[utoipa::path(post, path = "/api/v1/recipes/{id}/activate", tag = "recipes", params(("id" = i64, Path)), request_body = Activation,
    responses((status = 200, description = "active", body = RecipeVersion)))]
pub async fn activate(
    State(app): State<App>,
    who: Who,
    Place(id): Place<i64>,
    Input(Activation { why }): Input<Activation>,
) -> Result<Json<RecipeVersion>, Problem> {
    reason(&why)?;
    let version = app.heavy(move |handle| {
        if who.role < Some(Role::Metrologist) {
            was_released(handle.store(), id)?;
        }
        Ok::<_, Problem>(handle.activate_recipe(id, &who.name, why.trim())?)
    });
    Ok(Json(version.await?))
}

/// What a part is accepted by is a matter of who answers for the measurement, not of who sets the line up: ISO 14253-1 wants a
/// decision rule that is stated, ISO 10012 (5.1) a metrological function that answers for it, ISO 9001 (8.5.6) changes that are
/// authorised and kept. So a metrologist puts limits in force; a setter goes back and forth between what was in force, and may
/// change what judges nothing.
fn was_released(store: &Store, id: i64) -> Result<(), Problem> {
    let wanted = store.recipe(id)?;
    let alike = match store.active_recipe()? {
        Some(active) => judge_alike(&wanted, &active)?,
        None => false,
    };
    if wanted.version.released || alike {
        return Ok(());
    }
    Err(Problem::new(
        StatusCode::FORBIDDEN,
        "release",
        "This recipe has not been released",
        "its nominal, limits, decision rule, datums or uncertainties are others than those in force",
        "ask somebody who is metrologist or above to activate it; after that a setter may",
    ))
}

fn reason(why: &str) -> Result<(), Problem> {
    if !(1..=500).contains(&why.trim().chars().count()) {
        return Err(Problem::invalid(
            "the reason is empty or has more than 500 characters",
            "say in a few words why; it goes into the audit log",
        ));
    }
    Ok(())
}

fn nominal_in(store: &Store, draft: &Draft) -> Result<(String, Vec<u8>), Problem> {
    match (draft.nominal_of, &draft.nominal_name, &draft.nominal_base64) {
        (Some(id), None, None) => {
            let content = store.recipe(id)?;
            Ok((content.version.nominal_name.clone(), nominal_of(&content)?))
        }
        (None, Some(name), Some(base64)) => Ok((name.clone(), decoded(base64)?)),
        _ => Err(Problem::invalid(
            "the nominal is not said once",
            "give nominal_of, or nominal_name and nominal_base64",
        )),
    }
}

fn decoded(base64: &str) -> Result<Vec<u8>, Problem> {
    STANDARD.decode(base64).map_err(|error| {
        Problem::invalid(
            format!("nominal_base64: {error}"),
            "encode the file's bytes with the standard alphabet and padding",
        )
    })
}

fn keep(handle: &Handle, new: &NewRecipe<'_>) -> Result<RecipeVersion, Problem> {
    reason(new.why)?;
    for (what, text) in [("name", new.name), ("nominal_name", new.nominal_name)] {
        let length = text.chars().count();
        if !(1..=100).contains(&length) || text.chars().any(|c| c.is_control() || c == '/') {
            return Err(Problem::invalid(
                format!(
                    "{what} {text:?}, expected 1 to 100 characters without '/' and control characters"
                ),
                "choose a shorter or plainer name",
            ));
        }
    }
    let checked = checked(handle, new.text, new.nominal_name, new.nominal)?;
    if !checked.ok {
        return Err(Problem::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "recipe",
            "The recipe or its nominal cannot be read",
            checked.mistakes.join("\n"),
            "mend what the lines name",
        ));
    }
    Ok(handle.store().add_recipe(new, SystemTime::now())?)
}

/// Reads text and nominal as the cell would.
fn checked(handle: &Handle, text: &str, name: &str, nominal: &[u8]) -> Result<Checked, Problem> {
    let mut mistakes = Vec::new();
    if let Err(error) = check_recipe(text, "recipe") {
        let lines = match &error {
            CellError::Recipe { mistakes } => mistakes.clone(),
            other => chain(other),
        };
        mistakes.extend(lines.lines().map(str::to_owned));
    }
    let file = Incoming::write(handle.store(), name, nominal)?;
    let sharp_edges = match Nominal::read(&file.0) {
        Ok(nominal) => Some(nominal.sharp_edges.len()),
        Err(error) => {
            // The reader names our file for a moment; people know it by the name they gave.
            let text = chain(&error);
            mistakes.push(text.replace(&file.0.display().to_string(), name));
            None
        }
    };
    Ok(Checked {
        ok: mistakes.is_empty(),
        mistakes,
        sharp_edges,
    })
}

/// A nominal that is only looked at; the file goes when this does.
struct Incoming(PathBuf);

impl Incoming {
    fn write(store: &Store, name: &str, bytes: &[u8]) -> Result<Self, Problem> {
        let ending = std::path::Path::new(name)
            .extension()
            .and_then(|ending| ending.to_str())
            .filter(|ending| ending.chars().all(|c| c.is_ascii_alphanumeric()))
            .unwrap_or("step");
        let fault = |error: &dyn std::fmt::Display| Problem::fault(format!("a nominal: {error}"));
        let unique = secret().map_err(|error| fault(&error))?;
        let path = store.folder().join(format!("incoming-{unique}.{ending}"));
        let file = Self(path);
        std::fs::write(&file.0, bytes).map_err(|error| fault(&error))?;
        Ok(file)
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_file(&self.0) {
            tracing::warn!(path = %self.0.display(), %error, "cannot be removed");
        }
    }
}
