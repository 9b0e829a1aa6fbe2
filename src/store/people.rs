//! Who may use the cell, and the sessions and tokens they hold. Only hashes are kept: of passwords by the caller, of tokens here.

use std::time::{Duration, SystemTime};

use rusqlite::{OptionalExtension, Row, params};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

use super::{Store, StoreError, millis, rfc3339};

/// What somebody may do. Each may do what those before it may.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Starts, stops, looks.
    Operator,
    /// Prepares recipes, activates those that were in force before.
    Setter,
    /// Answers for limits, decision rule and uncertainty: puts them in force, and sees the audit log.
    Metrologist,
    /// Adds people, makes backups.
    Administrator,
}

impl Role {
    /// All, the least first.
    pub const ALL: [Role; 4] = [
        Role::Operator,
        Role::Setter,
        Role::Metrologist,
        Role::Administrator,
    ];

    /// As it stands in the database and in JSON.
    pub fn word(self) -> &'static str {
        match self {
            Role::Operator => "operator",
            Role::Setter => "setter",
            Role::Metrologist => "metrologist",
            Role::Administrator => "administrator",
        }
    }

    fn from_word(word: &str) -> Self {
        let found = Role::ALL.into_iter().find(|role| role.word() == word);
        found.unwrap_or(Role::Operator)
    }
}

/// Somebody who may use the cell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Person {
    /// The name to log in with.
    pub name: String,
    /// What they may do.
    pub role: Role,
    /// False where they may no longer log in.
    pub enabled: bool,
    /// When any of this was changed last: RFC 3339, UTC.
    pub changed: String,
}

/// What kind of key somebody holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SessionKind {
    /// A browser's, in a cookie.
    Session,
    /// A program's, in a header.
    Token,
}

/// A key that is held by somebody.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Session {
    /// The first 8 bytes of its hash in hexadecimal: names it and opens nothing.
    pub id: String,
    /// Whose.
    pub person: String,
    /// A browser's or a program's.
    pub kind: SessionKind,
    /// What it is for.
    pub label: String,
    /// When it was made.
    pub created: String,
    /// When it ends.
    pub expires: String,
}

impl Store {
    /// Adds somebody.
    ///
    /// # Errors
    /// [`StoreError::Exists`] and [`StoreError::Database`].
    pub fn add_person(
        &self,
        name: &str,
        role: Role,
        password_hash: &str,
        at: SystemTime,
    ) -> Result<(), StoreError> {
        let added = self.write(|connection| {
            connection.execute(
                "INSERT INTO people (name, role, password_hash, changed_ms) VALUES (?1, ?2, ?3, ?4) ON CONFLICT DO NOTHING",
                params![name, role.word(), password_hash, millis(at)],
            )
        })?;
        if added == 0 {
            return Err(StoreError::Exists {
                what: format!("a person {name:?}"),
            });
        }
        Ok(())
    }

    /// Changes what is given; whoever loses a role, a password or the right to log in loses every session and token too.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn change_person(
        &self,
        name: &str,
        role: Option<Role>,
        password_hash: Option<&str>,
        enabled: Option<bool>,
        at: SystemTime,
    ) -> Result<(), StoreError> {
        let changed = self.write(|connection| {
            let transaction = connection.transaction()?;
            let changed = transaction.execute(
                "UPDATE people SET role = coalesce(?2, role), password_hash = coalesce(?3, password_hash),
                 enabled = coalesce(?4, enabled), changed_ms = ?5 WHERE name = ?1",
                params![name, role.map(Role::word), password_hash, enabled, millis(at)],
            )?;
            transaction.execute("DELETE FROM sessions WHERE person = ?1", [name])?;
            transaction.commit()?;
            Ok(changed)
        })?;
        if changed == 0 {
            return Err(missing(name));
        }
        Ok(())
    }

    /// Everybody, by name.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn people(&self) -> Result<Vec<Person>, StoreError> {
        self.read(|connection| {
            let mut query = connection.prepare_cached(
                "SELECT name, role, enabled, changed_ms FROM people ORDER BY name",
            )?;
            let rows = query.query_map((), person)?;
            rows.collect()
        })
    }

    /// Somebody and the hash of their password, where they are known.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn person(&self, name: &str) -> Result<Option<(Person, String)>, StoreError> {
        self.read(|connection| {
            connection
                .query_row(
                    "SELECT name, role, enabled, changed_ms, password_hash FROM people WHERE name = ?1",
                    [name],
                    |row| Ok((person(row)?, row.get(4)?)),
                )
                .optional()
        })
    }

    /// Keeps the hash of a new key.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn add_session(
        &self,
        secret: &str,
        person: &str,
        kind: SessionKind,
        label: &str,
        at: SystemTime,
        lasts: Duration,
    ) -> Result<(), StoreError> {
        let kind = match kind {
            SessionKind::Session => "session",
            SessionKind::Token => "token",
        };
        self.write(|connection| {
            connection.execute("DELETE FROM sessions WHERE expires_ms <= ?1", [millis(at)])?;
            connection.execute(
                "INSERT INTO sessions (token_sha256, person, kind, label, created_ms, expires_ms) VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![digest(secret), person, kind, label, millis(at), millis(at + lasts)],
            )?;
            Ok(())
        })
    }

    /// Who holds this key, where it holds at `at` and they may log in.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn holder(&self, secret: &str, at: SystemTime) -> Result<Option<Person>, StoreError> {
        self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT p.name, p.role, p.enabled, p.changed_ms FROM sessions s JOIN people p ON p.name = s.person
                     WHERE s.token_sha256 = ?1 AND s.expires_ms > ?2 AND p.enabled",
                )?
                .query_row(params![digest(secret), millis(at)], person)
                .optional()
        })
    }

    /// Every session and token, newest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn sessions(&self) -> Result<Vec<Session>, StoreError> {
        self.read(|connection| {
            let mut query = connection.prepare_cached(
                "SELECT lower(hex(substr(token_sha256, 1, 8))), person, kind, label, created_ms, expires_ms FROM sessions
                 ORDER BY created_ms DESC",
            )?;
            let rows = query.query_map((), |row| {
                Ok(Session {
                    id: row.get(0)?,
                    person: row.get(1)?,
                    kind: match row.get::<_, String>(2)?.as_str() {
                        "token" => SessionKind::Token,
                        _ => SessionKind::Session,
                    },
                    label: row.get(3)?,
                    created: rfc3339(row.get(4)?),
                    expires: rfc3339(row.get(5)?),
                })
            })?;
            rows.collect()
        })
    }

    /// Ends the session or token with this secret.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn end_session(&self, secret: &str) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "DELETE FROM sessions WHERE token_sha256 = ?1",
                [digest(secret)],
            )?;
            Ok(())
        })
    }

    /// Ends the session or token that [`Session::id`] names.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn revoke_session(&self, id: &str) -> Result<(), StoreError> {
        let ended = self.write(|connection| {
            connection.execute(
                "DELETE FROM sessions WHERE lower(hex(substr(token_sha256, 1, 8))) = ?1",
                [id],
            )
        })?;
        if ended == 0 {
            return Err(StoreError::Missing {
                what: format!("session {id:?}"),
            });
        }
        Ok(())
    }
}

fn person(row: &Row<'_>) -> rusqlite::Result<Person> {
    Ok(Person {
        name: row.get(0)?,
        role: Role::from_word(&row.get::<_, String>(1)?),
        enabled: row.get(2)?,
        changed: rfc3339(row.get(3)?),
    })
}

/// The secrets are 32 random bytes: a plain hash cannot be searched backwards, and needs no salt.
fn digest(secret: &str) -> Vec<u8> {
    Sha256::digest(secret.as_bytes()).to_vec()
}

fn missing(name: &str) -> StoreError {
    StoreError::Missing {
        what: format!("person {name:?}"),
    }
}
