//! The database's tables, one migration a version: a released migration is never changed, only followed by another.

use rusqlite_migration::{M, Migrations};

/// Every version, in order.
pub(super) fn migrations() -> Migrations<'static> {
    Migrations::new(vec![M::up(FIRST), M::up(BECAUSE), M::up(RELEASED)])
}

const FIRST: &str = "
CREATE TABLE settings (name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID;

CREATE TABLE recipes (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    name TEXT NOT NULL,
    version INTEGER NOT NULL,
    sha256 TEXT NOT NULL,
    text TEXT NOT NULL,
    nominal_name TEXT NOT NULL,
    nominal_sha256 TEXT NOT NULL,
    author TEXT NOT NULL,
    why TEXT NOT NULL,
    created_ms INTEGER NOT NULL,
    UNIQUE (name, version),
    UNIQUE (name, sha256)
) STRICT;

CREATE TABLE inspections (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    phase TEXT NOT NULL CHECK (phase IN ('queued', 'acquiring', 'computing', 'done', 'refused', 'aborted')),
    part_serial TEXT NOT NULL,
    order_number TEXT NOT NULL,
    purpose TEXT NOT NULL,
    operator TEXT NOT NULL,
    recipe_id INTEGER REFERENCES recipes (id),
    idempotency_key TEXT UNIQUE,
    remeasure_of INTEGER REFERENCES inspections (id),
    simulated INTEGER NOT NULL DEFAULT 0,
    requested_ms INTEGER NOT NULL,
    started_ms INTEGER,
    acquired_ms INTEGER,
    ended_ms INTEGER,
    verdict TEXT CHECK (verdict IN ('undefined', 'ok', 'not_decidable', 'not_ok')),
    reason TEXT NOT NULL DEFAULT '',
    points INTEGER,
    scan_seconds REAL,
    verdict_seconds REAL,
    scan_file TEXT,
    scan_bytes INTEGER,
    scan_whole INTEGER
) STRICT;
CREATE INDEX inspections_by_serial ON inspections (part_serial, id);
CREATE INDEX inspections_by_verdict ON inspections (verdict, id);
CREATE INDEX inspections_by_order ON inspections (order_number, id);
CREATE INDEX inspections_by_time ON inspections (requested_ms, id);
CREATE INDEX inspections_unfinished ON inspections (phase) WHERE phase IN ('queued', 'acquiring', 'computing');
CREATE INDEX inspections_with_scan ON inspections (id, scan_bytes) WHERE scan_bytes IS NOT NULL;
CREATE INDEX inspections_with_open_scan ON inspections (id) WHERE scan_file IS NOT NULL AND scan_bytes IS NULL;

CREATE TABLE reports (
    inspection INTEGER PRIMARY KEY REFERENCES inspections (id) ON DELETE CASCADE,
    json_zstd BLOB NOT NULL
) STRICT;

CREATE TABLE characteristics (
    id INTEGER PRIMARY KEY,
    name TEXT NOT NULL UNIQUE,
    unit TEXT NOT NULL
) STRICT;

CREATE TABLE measured (
    characteristic INTEGER NOT NULL REFERENCES characteristics (id),
    inspection INTEGER NOT NULL REFERENCES inspections (id) ON DELETE CASCADE,
    value REAL,
    u REAL,
    lower REAL,
    upper REAL,
    verdict TEXT NOT NULL,
    PRIMARY KEY (characteristic, inspection)
) STRICT, WITHOUT ROWID;
CREATE INDEX measured_by_inspection ON measured (inspection);

CREATE TABLE people (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL CHECK (role IN ('operator', 'setter', 'metrologist', 'administrator')),
    password_hash TEXT NOT NULL,
    enabled INTEGER NOT NULL DEFAULT 1,
    changed_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE sessions (
    token_sha256 BLOB PRIMARY KEY,
    person TEXT NOT NULL REFERENCES people (name) ON DELETE CASCADE,
    kind TEXT NOT NULL CHECK (kind IN ('session', 'token')),
    label TEXT NOT NULL,
    created_ms INTEGER NOT NULL,
    expires_ms INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE audit (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    at_ms INTEGER NOT NULL,
    person TEXT NOT NULL,
    action TEXT NOT NULL,
    subject TEXT NOT NULL,
    old TEXT NOT NULL,
    new TEXT NOT NULL,
    why TEXT NOT NULL
) STRICT;
CREATE TRIGGER audit_is_not_changed BEFORE UPDATE ON audit BEGIN SELECT RAISE (ABORT, 'the audit log is never changed'); END;
CREATE TRIGGER audit_is_not_removed BEFORE DELETE ON audit BEGIN SELECT RAISE (ABORT, 'the audit log is never shortened'); END;
";

/// The reason of a verdict in parts, JSON; null where there is no result, or an older one.
const BECAUSE: &str = "ALTER TABLE inspections ADD COLUMN because TEXT";

/// Which recipes somebody who may has put in force once; those that were active before there was this column count.
const RELEASED: &str = "
ALTER TABLE recipes ADD COLUMN released INTEGER NOT NULL DEFAULT 0;
UPDATE recipes SET released = 1 WHERE EXISTS (SELECT 1 FROM audit WHERE action = 'recipe.activate' AND instr(new, sha256) > 0);
";

#[cfg(test)]
mod tests {
    #[test]
    fn every_migration_can_be_applied() {
        assert_eq!(super::migrations().validate(), Ok(()));
    }
}
