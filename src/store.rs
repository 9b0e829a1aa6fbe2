//! Inspections, scans, recipes, people and the audit log: what survives a power cut.
//!
//! One folder: `acies.db` (SQLite, write-ahead log, every commit on the disk before the call returns), `scans/` (the raw
//! profiles of every run, one file each, whole or not at all) and `nominals/` (CAD files by their SHA-256). Hides SQL,
//! compression and the file formats. The store reads no clock: who calls says what time it is, in UTC.

mod export;
mod inspections;
#[cfg(feature = "parquet")]
mod parquet;
mod people;
mod recipes;
mod scan_file;
mod schema;
mod upkeep;

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rusqlite::{Connection, OpenFlags, TransactionBehavior};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use export::{Export, ExportError};
pub use inspections::{
    Finished, History, Inspection, Measured, Order, Phase, Purpose, Trend, TrendPoint, Trigger,
};
pub use people::{Person, Role, Session, SessionKind};
pub use recipes::{NewRecipe, RecipeContent, RecipeVersion};
pub use scan_file::{ScanFileError, ScanReader, ScanWriter, StoredCarrier, StoredView};
pub use upkeep::{Retention, Swept, Usage, restore};

/// How long one connection waits for another before it gives up.
const BUSY: Duration = Duration::from_secs(5);

/// Reading connections that are kept open.
const READERS_KEPT: usize = 4;

/// Why the store could not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The folder or a file in it.
    #[error("{path}: {source}; check that the disk is not full and that the folder may be written")]
    File {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The database.
    #[error("{path}: {source}; {}", causes(source))]
    Database {
        /// The database.
        path: PathBuf,
        /// What SQLite said.
        #[source]
        source: rusqlite::Error,
    },
    /// The database's version.
    #[error("{path}: {source}; a newer acies wrote it, or it is no database of acies")]
    Version {
        /// The database.
        path: PathBuf,
        /// What is wrong with its version.
        #[source]
        source: rusqlite_migration::Error,
    },
    /// What was asked for is not there.
    #[error("{what}: there is none; it may have been removed by the retention rule")]
    Missing {
        /// What was asked for.
        what: String,
    },
    /// What is there cannot be read.
    #[error("{what}: damaged; restore it from a backup")]
    Damaged {
        /// What was asked for.
        what: String,
    },
    /// Something of the same name is there already.
    #[error("{what} is there already; choose another name")]
    Exists {
        /// What was to be added.
        what: String,
    },
    /// Somebody else has it.
    #[error("{path}: another acies serves this store; stop that one first")]
    InUse {
        /// The file that is locked.
        path: PathBuf,
    },
    /// A scan's file.
    #[error(transparent)]
    Scan(#[from] ScanFileError),
}

/// One line of the audit log: who did what, and what it was before.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// Counts the entries from 1; a gap does not occur.
    pub id: i64,
    /// When: RFC 3339, UTC.
    pub at: String,
    /// Who; `system` for the daemon itself.
    pub person: String,
    /// What was done: `recipe.activate`, `person.add` and so on.
    pub action: String,
    /// To what.
    pub subject: String,
    /// The value before; empty where there was none.
    pub old: String,
    /// The value after; empty where there is none.
    pub new: String,
    /// The reason given; empty where none is asked for.
    pub why: String,
}

/// What is to be written into the audit log.
#[derive(Debug, Clone, Copy)]
pub struct Audit<'a> {
    /// Who.
    pub person: &'a str,
    /// What was done.
    pub action: &'a str,
    /// To what.
    pub subject: &'a str,
    /// The value before.
    pub old: &'a str,
    /// The value after.
    pub new: &'a str,
    /// The reason given.
    pub why: &'a str,
}

/// The store of one cell. Shared between threads by reference.
#[derive(Debug)]
pub struct Store {
    folder: PathBuf,
    writer: Mutex<Connection>,
    readers: Mutex<Vec<Connection>>,
}

impl Store {
    /// Opens the store in `folder`, which is made where it is not there, and brings its database to this version.
    ///
    /// # Errors
    /// [`StoreError::File`], [`StoreError::Database`] and [`StoreError::Version`].
    pub fn open(folder: &Path) -> Result<Self, StoreError> {
        for part in [
            folder.to_owned(),
            folder.join("scans"),
            folder.join("nominals"),
        ] {
            std::fs::create_dir_all(&part)
                .map_err(|source| StoreError::File { path: part, source })?;
        }
        let path = folder.join("acies.db");
        let at = |source| StoreError::Database {
            path: path.clone(),
            source,
        };
        let mut writer = Connection::open(&path).map_err(at)?;
        writer.busy_timeout(BUSY).map_err(at)?;
        // A transaction that begins by reading does not wait for another program when it comes to write.
        writer.set_transaction_behavior(TransactionBehavior::Immediate);
        // FULL: a commit is on the disk before it returns, also in the write-ahead log.
        writer
            .execute_batch(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON;",
            )
            .map_err(at)?;
        schema::migrations()
            .to_latest(&mut writer)
            .map_err(|source| StoreError::Version {
                path: path.clone(),
                source,
            })?;
        Ok(Self {
            folder: folder.to_owned(),
            writer: Mutex::new(writer),
            readers: Mutex::new(Vec::new()),
        })
    }

    /// Takes the store for one daemon alone, for as long as the value lives; the system gives it back after a crash.
    ///
    /// # Errors
    /// [`StoreError::InUse`] and [`StoreError::File`].
    pub fn lock(&self) -> Result<StoreLock, StoreError> {
        lock_folder(&self.folder)
    }

    /// The folder it lies in.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Whether the database can be read and written now.
    ///
    /// # Errors
    /// What keeps it from that.
    pub fn check(&self) -> Result<(), StoreError> {
        self.write(|connection| {
            let transaction = connection.transaction()?;
            transaction.execute(
                "INSERT INTO settings (name, value) VALUES ('checked', '') ON CONFLICT (name) DO UPDATE SET value = value",
                (),
            )?;
            transaction.commit()
        })
    }

    /// Writes an entry into the audit log, which nothing ever changes or removes.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn audit(&self, entry: &Audit<'_>, at: SystemTime) -> Result<(), StoreError> {
        self.write(|connection| audit(connection, entry, at))
    }

    /// At most `limit` entries of the audit log before entry `before`, newest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn audit_log(
        &self,
        before: Option<i64>,
        limit: u32,
    ) -> Result<Vec<AuditEntry>, StoreError> {
        self.read(|connection| {
            let mut query = connection.prepare_cached(
                "SELECT id, at_ms, person, action, subject, old, new, why FROM audit
                 WHERE id < ?1 ORDER BY id DESC LIMIT ?2",
            )?;
            let rows = query.query_map((before.unwrap_or(i64::MAX), limit), |row| {
                Ok(AuditEntry {
                    id: row.get(0)?,
                    at: rfc3339(row.get(1)?),
                    person: row.get(2)?,
                    action: row.get(3)?,
                    subject: row.get(4)?,
                    old: row.get(5)?,
                    new: row.get(6)?,
                    why: row.get(7)?,
                })
            })?;
            rows.collect()
        })
    }

    /// Runs `work` on the one connection that writes.
    fn write<T>(
        &self,
        work: impl FnOnce(&mut Connection) -> rusqlite::Result<T>,
    ) -> Result<T, StoreError> {
        let mut connection = lock(&self.writer);
        work(&mut connection).map_err(|source| self.failed(source))
    }

    /// Runs `work` on a connection that only reads, beside the one that writes.
    fn read<T>(
        &self,
        work: impl FnOnce(&Connection) -> rusqlite::Result<T>,
    ) -> Result<T, StoreError> {
        let kept = lock(&self.readers).pop();
        let connection = match kept {
            Some(connection) => connection,
            None => self.reader().map_err(|source| self.failed(source))?,
        };
        let result = work(&connection).map_err(|source| self.failed(source));
        let mut readers = lock(&self.readers);
        if readers.len() < READERS_KEPT {
            readers.push(connection);
        }
        result
    }

    fn reader(&self) -> rusqlite::Result<Connection> {
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(self.database(), flags)?;
        connection.busy_timeout(BUSY)?;
        Ok(connection)
    }

    fn database(&self) -> PathBuf {
        self.folder.join("acies.db")
    }

    fn failed(&self, source: rusqlite::Error) -> StoreError {
        StoreError::Database {
            path: self.database(),
            source,
        }
    }
}

/// A store that is taken. Others may still read it and make backups.
#[derive(Debug)]
pub struct StoreLock {
    _file: std::fs::File,
}

fn lock_folder(folder: &Path) -> Result<StoreLock, StoreError> {
    let path = folder.join("lock");
    let file = std::fs::File::create(&path).map_err(|source| StoreError::File {
        path: path.clone(),
        source,
    })?;
    match file.try_lock() {
        Ok(()) => Ok(StoreLock { _file: file }),
        Err(std::fs::TryLockError::WouldBlock) => Err(StoreError::InUse { path }),
        Err(std::fs::TryLockError::Error(source)) => Err(StoreError::File { path, source }),
    }
}

fn audit(connection: &Connection, entry: &Audit<'_>, at: SystemTime) -> rusqlite::Result<()> {
    connection
        .prepare_cached(
            "INSERT INTO audit (at_ms, person, action, subject, old, new, why) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
        )?
        .execute((
            millis(at),
            entry.person,
            entry.action,
            entry.subject,
            entry.old,
            entry.new,
            entry.why,
        ))?;
    Ok(())
}

/// What usually lies behind an error of the database, and what to do.
fn causes(error: &rusqlite::Error) -> &'static str {
    use rusqlite::ErrorCode::{DatabaseBusy, DatabaseLocked, DiskFull, ReadOnly};
    match error.sqlite_error_code() {
        Some(DatabaseBusy | DatabaseLocked) => {
            "another program holds it: close that program, use `acies export` and `acies backup` instead"
        }
        Some(DiskFull) => "make room on its disk",
        Some(ReadOnly) => {
            "its disk is read-only: look at the system's log, mount it writable again"
        }
        _ => "a full disk, a read-only disk and a file on a network drive are the usual causes",
    }
}

/// A thread that panicked inside a call left a transaction that SQLite rolled back: what is behind the lock is whole.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Milliseconds since 1970 in UTC; times before that are 0.
fn millis(at: SystemTime) -> i64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}

/// Milliseconds since 1970 as RFC 3339; a time beyond the year 9999 is written as the last one before.
fn rfc3339(millis: i64) -> String {
    const LAST: u64 = 253_402_300_799_999;
    let millis = u64::try_from(millis).unwrap_or(0).min(LAST);
    humantime::format_rfc3339_millis(UNIX_EPOCH + Duration::from_millis(millis)).to_string()
}

/// Compresses text that is stored once and read seldom.
fn pack(text: &str) -> Vec<u8> {
    // Level 3 is the library's default; reading into memory cannot fail.
    zstd::encode_all(text.as_bytes(), 3).unwrap_or_default()
}

/// The text behind [`pack`]; `None` where the bytes are damaged.
fn unpack(bytes: &[u8]) -> Option<String> {
    String::from_utf8(zstd::decode_all(bytes).ok()?).ok()
}
