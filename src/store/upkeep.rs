//! Backup, restore, retention, and what is left by a crash.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rusqlite::{Connection, OpenFlags};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Inspection, ScanReader, ScanWriter, Store, StoreError, millis};

/// Which raw data are kept. Results, recipes and the audit log are kept for ever.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Retention {
    /// Raw data are removed at this age; never where it is `None`.
    pub scans_for: Option<Duration>,
    /// Raw data of parts that were OK are removed at this age.
    pub ok_scans_for: Option<Duration>,
    /// The oldest raw data are removed while they take more than this, bytes.
    pub scans_at_most: u64,
    /// And while the disk has less free than this, bytes.
    pub free_at_least: u64,
}

impl Default for Retention {
    /// 50 GB of scans, and 2 GB of the disk left free.
    fn default() -> Self {
        Self {
            scans_for: None,
            ok_scans_for: None,
            scans_at_most: 50_000_000_000,
            free_at_least: 2_000_000_000,
        }
    }
}

/// How much the store holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Usage {
    /// Inspections of all time.
    pub inspections: i64,
    /// Scans whose raw data are there.
    pub scans: i64,
    /// Their size, bytes.
    pub scan_bytes: i64,
    /// Size of the database, bytes.
    pub database_bytes: u64,
    /// Free on its disk, bytes; null where the system does not say.
    pub free_bytes: Option<u64>,
}

/// What one sweep removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Swept {
    /// Scans.
    pub scans: u64,
    /// Their size, bytes.
    pub bytes: u64,
}

impl Store {
    /// How much the store holds.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn usage(&self) -> Result<Usage, StoreError> {
        let (inspections, scans, scan_bytes) = self.read(|connection| {
            connection.query_row(
                // The largest number stands for the count, which would read every row: numbers are never used again and no
                // row is ever removed.
                "SELECT coalesce((SELECT max(id) FROM inspections), 0), count(*), coalesce(sum(scan_bytes), 0)
                 FROM inspections WHERE scan_bytes IS NOT NULL",
                (),
                |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)),
            )
        })?;
        let database_bytes = ["acies.db", "acies.db-wal"]
            .iter()
            .filter_map(|name| fs::metadata(self.folder.join(name)).ok())
            .map(|metadata| metadata.len())
            .sum();
        Ok(Usage {
            inspections,
            scans,
            scan_bytes,
            database_bytes,
            free_bytes: fs4::available_space(&self.folder).ok(),
        })
    }

    /// Ends what a crash left unfinished: each such inspection is aborted with `reason`, its raw data up to there are kept.
    ///
    /// # Errors
    /// [`StoreError`]; what has been mended so far stays mended.
    pub fn recover(&self, reason: &str, at: SystemTime) -> Result<Vec<Inspection>, StoreError> {
        let scans = self.read(|connection| {
            let mut query = connection.prepare(
                "SELECT id, scan_file FROM inspections WHERE scan_file IS NOT NULL AND scan_bytes IS NULL",
            )?;
            let rows = query.query_map((), |row| Ok((row.get(0)?, row.get(1)?)))?;
            rows.collect::<rusqlite::Result<Vec<(i64, String)>>>()
        })?;
        for (id, name) in scans {
            self.recover_scan(id, &name)?;
        }
        let unfinished = self.unfinished()?;
        let aborted = unfinished
            .into_iter()
            .map(|inspection| self.abort(inspection.id, reason, at));
        aborted.collect()
    }

    /// Makes the raw data of an interrupted run a whole file of what came, where anything came.
    fn recover_scan(&self, id: i64, name: &str) -> Result<(), StoreError> {
        let path = self.folder.join("scans").join(name);
        let part = path.with_file_name(format!("{name}.part"));
        let there = [&path, &part].into_iter().find(|path| path.is_file());
        let Some(Ok(mut reader)) = there.map(|path| ScanReader::open(path)) else {
            self.remove(&part);
            return self.forget_scan(id);
        };
        let cut = path.with_file_name(format!("{name}.cut"));
        let mut writer = ScanWriter::create(&cut, reader.views())?;
        // What is damaged behind the last whole chunk is what the crash cut off.
        loop {
            let read = reader.profiles();
            for pose in reader.take_poses() {
                writer.push_pose(&pose)?;
            }
            let Ok(Some((view, profiles))) = read else {
                break;
            };
            for profile in &profiles {
                writer.push(view, profile)?;
            }
        }
        let whole = reader.whole();
        let bytes = writer.finish(whole)?;
        self.remove(&part);
        if bytes == 0 {
            return self.forget_scan(id);
        }
        fs::rename(&cut, &path).map_err(|source| StoreError::File { path, source })?;
        self.scan_kept(id, bytes, whole)
    }

    /// An inspection without raw data.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn forget_scan(&self, id: i64) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "UPDATE inspections SET scan_file = NULL, scan_bytes = NULL, scan_whole = NULL WHERE id = ?1",
                [id],
            )?;
            Ok(())
        })
    }

    /// Removes raw data as `retention` says, the oldest first; the newest scan always stays.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn sweep(&self, retention: &Retention, at: SystemTime) -> Result<Swept, StoreError> {
        let mut swept = Swept::default();
        let mut usage = self.usage()?;
        while let Some((id, name, bytes)) = self.oldest_to_go(retention, &usage, at)? {
            self.remove(&self.folder.join("scans").join(&name));
            self.forget_scan(id)?;
            swept.scans += 1;
            swept.bytes += bytes.max(0) as u64;
            usage.scan_bytes -= bytes;
            usage.free_bytes = fs4::available_space(&self.folder).ok();
        }
        Ok(swept)
    }

    /// The oldest scan that the rule no longer keeps.
    fn oldest_to_go(
        &self,
        retention: &Retention,
        usage: &Usage,
        at: SystemTime,
    ) -> Result<Option<(i64, String, i64)>, StoreError> {
        use rusqlite::OptionalExtension;
        let full = usage.scan_bytes.max(0) as u64 > retention.scans_at_most
            || usage
                .free_bytes
                .is_some_and(|free| free < retention.free_at_least);
        let before = |age: Option<Duration>| {
            let limit = age.and_then(|age| at.checked_sub(age));
            limit.map_or(-1, millis)
        };
        let (any, ok) = (before(retention.scans_for), before(retention.ok_scans_for));
        self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, scan_file, scan_bytes FROM inspections
                     WHERE scan_bytes IS NOT NULL
                       AND id < (SELECT max(id) FROM inspections WHERE scan_bytes IS NOT NULL)
                       AND (?1 OR ended_ms < ?2 OR (verdict = 'ok' AND ended_ms < ?3))
                     ORDER BY id LIMIT 1",
                )?
                .query_row((full, any, ok), |row| {
                    Ok((row.get(0)?, row.get(1)?, row.get(2)?))
                })
                .optional()
        })
    }

    /// Writes everything into the new folder `target`, while the cell runs. It is a store like this one.
    ///
    /// # Errors
    /// [`StoreError::Exists`] where `target` is there already, and what else keeps it from being written.
    pub fn backup(&self, target: &Path) -> Result<(), StoreError> {
        if target.exists() {
            return Err(StoreError::Exists {
                what: format!("a file or folder {}", target.display()),
            });
        }
        for part in ["scans", "nominals"] {
            let folder = target.join(part);
            fs::create_dir_all(&folder).map_err(|source| StoreError::File {
                path: folder.clone(),
                source,
            })?;
        }
        // The database first: every file it names is whole already, and files only ever come to it.
        let copied = self.read(|connection| {
            let mut copy = Connection::open(target.join("acies.db"))?;
            let backup = rusqlite::backup::Backup::new(connection, &mut copy)?;
            backup.run_to_completion(1024, Duration::ZERO, None)
        });
        copied?;
        for part in ["nominals", "scans"] {
            copy_files(&self.folder.join(part), &target.join(part))?;
        }
        Ok(())
    }

    fn remove(&self, path: &Path) {
        if let Err(error) = fs::remove_file(path)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            tracing::warn!(path = %path.display(), %error, "cannot be removed; it takes space until it is");
        }
    }
}

fn copy_files(from: &Path, to: &Path) -> Result<(), StoreError> {
    let at = |path: PathBuf| move |source| StoreError::File { path, source };
    for entry in fs::read_dir(from).map_err(at(from.to_owned()))? {
        let path = entry.map_err(at(from.to_owned()))?.path();
        let unfinished = path.extension().is_some_and(|ending| ending == "part");
        let Some(name) = path.file_name().filter(|_| path.is_file() && !unfinished) else {
            continue;
        };
        let copied = fs::copy(&path, to.join(name));
        // The retention rule may remove a scan meanwhile.
        if let Err(source) = copied
            && path.exists()
        {
            return Err(StoreError::File { path, source });
        }
    }
    Ok(())
}

/// Puts the backup in `backup` where the store in `target` was; the old one stays beside it as `NAME.before-restore`.
///
/// # Errors
/// [`StoreError::InUse`] where a daemon runs on `target`, and what else keeps it from being done; `target` is untouched where the backup cannot be read.
pub fn restore(backup: &Path, target: &Path) -> Result<(), StoreError> {
    let database = backup.join("acies.db");
    let checked = Connection::open_with_flags(&database, OpenFlags::SQLITE_OPEN_READ_ONLY)
        .and_then(|connection| {
            connection.query_row("PRAGMA integrity_check", (), |row| row.get::<_, String>(0))
        });
    match checked {
        Ok(answer) if answer == "ok" => {}
        Ok(answer) => {
            return Err(StoreError::Missing {
                what: format!("a whole database in {} ({answer})", database.display()),
            });
        }
        Err(source) => {
            return Err(StoreError::Database {
                path: database,
                source,
            });
        }
    }
    let taken = if target.is_dir() {
        Some(super::lock_folder(target)?)
    } else {
        None
    };
    let mut coming = target.as_os_str().to_owned();
    coming.push(".restoring");
    let coming = PathBuf::from(coming);
    let mut before = target.as_os_str().to_owned();
    before.push(".before-restore");
    let before = PathBuf::from(before);
    let at = |path: &Path| {
        let path = path.to_owned();
        move |source| StoreError::File { path, source }
    };
    for taken in [&coming, &before] {
        if taken.exists() {
            return Err(StoreError::Exists {
                what: format!("a folder {}", taken.display()),
            });
        }
    }
    for part in ["scans", "nominals"] {
        fs::create_dir_all(coming.join(part)).map_err(at(&coming))?;
        copy_files(&backup.join(part), &coming.join(part))?;
    }
    fs::copy(&database, coming.join("acies.db")).map_err(at(&coming))?;
    if target.exists() {
        fs::rename(target, &before).map_err(at(target))?;
    }
    fs::rename(&coming, target).map_err(at(target))?;
    drop(taken);
    Ok(())
}
