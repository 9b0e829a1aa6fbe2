//! Versions of recipes by their content: what was judged by which limits can be read again a year later.

use std::path::PathBuf;
use std::time::SystemTime;

use rusqlite::{OptionalExtension, Row, params};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

use super::{Audit, Store, StoreError, audit, millis, rfc3339};

/// One version of a recipe: its text and the part's nominal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct RecipeVersion {
    /// Its number in the store.
    pub id: i64,
    /// What the line calls it.
    pub name: String,
    /// Counts the versions of this name from 1.
    pub version: i64,
    /// SHA-256 of the text, a zero byte and the nominal's bytes, hexadecimal: the same content has the same hash everywhere.
    pub sha256: String,
    /// File name of the nominal.
    pub nominal_name: String,
    /// SHA-256 of the nominal's bytes, hexadecimal.
    pub nominal_sha256: String,
    /// Who made this version.
    pub author: String,
    /// Why.
    pub why: String,
    /// When: RFC 3339, UTC.
    pub created: String,
    /// Whether parts are judged by it now.
    pub active: bool,
    /// Whether parts were judged by it before: then its limits were put in force by somebody who may.
    #[serde(default)]
    pub released: bool,
}

/// A version with its text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecipeContent {
    /// The version.
    pub version: RecipeVersion,
    /// The TOML text.
    pub text: String,
    /// The file of the nominal.
    pub nominal: PathBuf,
}

/// A version to be added.
#[derive(Debug, Clone, Copy)]
pub struct NewRecipe<'a> {
    /// What the line calls it.
    pub name: &'a str,
    /// The TOML text.
    pub text: &'a str,
    /// File name of the nominal, with its ending.
    pub nominal_name: &'a str,
    /// The nominal's bytes.
    pub nominal: &'a [u8],
    /// Who.
    pub author: &'a str,
    /// Why.
    pub why: &'a str,
}

impl NewRecipe<'_> {
    /// As [`RecipeVersion::sha256`].
    fn sha256(&self) -> String {
        let mut content = Sha256::new();
        content.update(self.text.as_bytes());
        content.update([0]);
        content.update(self.nominal);
        hex(&content.finalize())
    }
}

const COLUMNS: &str = "id, name, version, sha256, nominal_name, nominal_sha256, author, why, created_ms,
    id = coalesce((SELECT CAST(value AS INTEGER) FROM settings WHERE settings.name = 'active_recipe'), 0),
    released";

impl Store {
    /// Adds a version, or finds the one with the same content. The caller has checked that text and nominal can be read.
    ///
    /// # Errors
    /// [`StoreError::File`] and [`StoreError::Database`].
    pub fn add_recipe(
        &self,
        new: &NewRecipe<'_>,
        at: SystemTime,
    ) -> Result<RecipeVersion, StoreError> {
        let nominal_sha256 = hex(&Sha256::digest(new.nominal));
        let sha256 = new.sha256();
        let path = self.nominal_path(&nominal_sha256, new.nominal_name);
        if !path.is_file() {
            crate::points::write::write_atomically(&path, new.nominal).map_err(|error| {
                StoreError::File {
                    path: path.clone(),
                    source: std::io::Error::other(error),
                }
            })?;
        }
        self.write(|connection| {
            let transaction = connection.transaction()?;
            let known: Option<i64> = transaction
                .query_row(
                    "SELECT id FROM recipes WHERE name = ?1 AND sha256 = ?2",
                    [new.name, &sha256],
                    |row| row.get(0),
                )
                .optional()?;
            let id = if let Some(id) = known { id } else {
                transaction.execute(
                    "INSERT INTO recipes (name, version, sha256, text, nominal_name, nominal_sha256, author, why, created_ms)
                     SELECT ?1, coalesce(max(version), 0) + 1, ?2, ?3, ?4, ?5, ?6, ?7, ?8 FROM recipes WHERE name = ?1",
                    params![
                        new.name,
                        sha256,
                        new.text,
                        new.nominal_name,
                        nominal_sha256,
                        new.author,
                        new.why,
                        millis(at)
                    ],
                )?;
                let id = transaction.last_insert_rowid();
                let entry = Audit {
                    person: new.author,
                    action: "recipe.add",
                    subject: new.name,
                    old: "",
                    new: &sha256,
                    why: new.why,
                };
                audit(&transaction, &entry, at)?;
                id
            };
            let version = one(&transaction, id)?;
            transaction.commit()?;
            Ok(version.0)
        })
    }

    /// Whether this is the content that the configured files had when they were last taken.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn is_configured(&self, new: &NewRecipe<'_>) -> Result<bool, StoreError> {
        self.read(|connection| {
            connection.query_row(
                "SELECT EXISTS (SELECT 1 FROM settings WHERE name = 'configured_recipe' AND value = ?1)",
                [new.sha256()],
                |row| row.get(0),
            )
        })
    }

    /// Notes that the configured files have this content.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn note_configured(&self, new: &NewRecipe<'_>) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "INSERT INTO settings (name, value) VALUES ('configured_recipe', ?1)
                 ON CONFLICT (name) DO UPDATE SET value = excluded.value",
                [new.sha256()],
            )?;
            Ok(())
        })
    }

    /// Parts are judged by version `id` from now on, which is released by that. The caller has checked that this person may.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn activate_recipe(
        &self,
        id: i64,
        person: &str,
        why: &str,
        at: SystemTime,
    ) -> Result<RecipeVersion, StoreError> {
        let new = self.recipe(id)?.version;
        let old = self.active_recipe()?;
        if old.as_ref().is_some_and(|old| old.version.id == id) {
            return Ok(new);
        }
        let label = |version: &RecipeVersion| {
            format!("{} v{} {}", version.name, version.version, version.sha256)
        };
        self.write(|connection| {
            let transaction = connection.transaction()?;
            transaction.execute(
                "INSERT INTO settings (name, value) VALUES ('active_recipe', ?1)
                 ON CONFLICT (name) DO UPDATE SET value = excluded.value",
                [id.to_string()],
            )?;
            transaction.execute("UPDATE recipes SET released = 1 WHERE id = ?1", [id])?;
            let entry = Audit {
                person,
                action: "recipe.activate",
                subject: "active recipe",
                old: &old.map_or(String::new(), |old| label(&old.version)),
                new: &label(&new),
                why,
            };
            audit(&transaction, &entry, at)?;
            let version = one(&transaction, id)?;
            transaction.commit()?;
            Ok(version.0)
        })
    }

    /// The version by which parts are judged.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn active_recipe(&self) -> Result<Option<RecipeContent>, StoreError> {
        let found = self.read(|connection| {
            let sql = format!(
                "SELECT {COLUMNS}, text FROM recipes
                 WHERE id = (SELECT CAST(value AS INTEGER) FROM settings WHERE name = 'active_recipe')"
            );
            connection.query_row(&sql, (), whole).optional()
        })?;
        Ok(found.map(|found| self.content(found)))
    }

    /// One version with its text.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn recipe(&self, id: i64) -> Result<RecipeContent, StoreError> {
        let found = self.read(|connection| one(connection, id).optional())?;
        let found = found.ok_or_else(|| StoreError::Missing {
            what: format!("recipe {id}"),
        })?;
        Ok(self.content(found))
    }

    /// All versions, newest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn recipes(&self) -> Result<Vec<RecipeVersion>, StoreError> {
        self.read(|connection| {
            let sql = format!("SELECT {COLUMNS}, text FROM recipes ORDER BY id DESC");
            let mut query = connection.prepare_cached(&sql)?;
            let rows = query.query_map((), |row| Ok(whole(row)?.0))?;
            rows.collect()
        })
    }

    fn content(&self, (version, text): (RecipeVersion, String)) -> RecipeContent {
        let nominal = self.nominal_path(&version.nominal_sha256, &version.nominal_name);
        RecipeContent {
            version,
            text,
            nominal,
        }
    }

    /// Kept by content; the ending tells the reader which format it is.
    fn nominal_path(&self, sha256: &str, name: &str) -> PathBuf {
        let ending = std::path::Path::new(name)
            .extension()
            .and_then(|ending| ending.to_str())
            .filter(|ending| ending.chars().all(|c| c.is_ascii_alphanumeric()))
            .unwrap_or("step");
        self.folder
            .join("nominals")
            .join(format!("{sha256}.{}", ending.to_ascii_lowercase()))
    }
}

fn one(connection: &rusqlite::Connection, id: i64) -> rusqlite::Result<(RecipeVersion, String)> {
    let sql = format!("SELECT {COLUMNS}, text FROM recipes WHERE id = ?1");
    connection.query_row(&sql, [id], whole)
}

fn whole(row: &Row<'_>) -> rusqlite::Result<(RecipeVersion, String)> {
    let version = RecipeVersion {
        id: row.get(0)?,
        name: row.get(1)?,
        version: row.get(2)?,
        sha256: row.get(3)?,
        nominal_name: row.get(4)?,
        nominal_sha256: row.get(5)?,
        author: row.get(6)?,
        why: row.get(7)?,
        created: rfc3339(row.get(8)?),
        active: row.get(9)?,
        released: row.get(10)?,
    };
    Ok((version, row.get(11)?))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
