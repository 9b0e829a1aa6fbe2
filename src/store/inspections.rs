//! The life of an inspection: asked for, queued, acquiring, computing, done; or refused, or aborted. One row each, for ever.

use std::time::SystemTime;

use rusqlite::{Connection, OptionalExtension, Row, params};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::{Store, StoreError, millis, pack, rfc3339, unpack};
use crate::report::Report;
use crate::report::wire::{Because, Status};

/// Why a part is measured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// Production: counts in the statistics.
    #[default]
    Series,
    /// A part for setting up; does not count.
    Setup,
    /// An audit of the process; does not count.
    Audit,
    /// A calibrated part that checks the cell; does not count.
    Master,
}

/// What a trigger asks for.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Order {
    /// Serial number or data-matrix code of the part. A judged result needs one.
    pub part_serial: String,
    /// Production order or batch; may be empty.
    #[serde(default)]
    pub order_number: String,
    /// Why the part is measured.
    #[serde(default)]
    pub purpose: Purpose,
    /// The inspection of the same part that this one repeats; its result is kept.
    #[serde(default, deserialize_with = "whole")]
    pub remeasure_of: Option<i64>,
}

/// A whole number or null. `4.0` is an integer to JSON Schema, and some clients write all numbers so.
fn whole<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<i64>, D::Error> {
    let Some(number) = Option::<serde_json::Number>::deserialize(deserializer)? else {
        return Ok(None);
    };
    // Beyond 2^53 a float no longer says which whole number it is.
    let of_float = |x: f64| (x.fract() == 0.0 && x.abs() < 9e15).then_some(x as i64);
    let whole = number
        .as_i64()
        .or_else(|| number.as_f64().and_then(of_float));
    whole
        .map(Some)
        .ok_or_else(|| D::Error::custom(format!("{number} is not a whole number of 64 bits")))
}

/// Somebody's press on Start.
#[derive(Debug, Clone, Copy)]
pub struct Trigger<'a> {
    /// What is asked for.
    pub order: &'a Order,
    /// Who asks.
    pub operator: &'a str,
    /// Names the trigger: when it is repeated with the same key, the same inspection is meant.
    pub key: Option<&'a str>,
    /// Whether the instruments are simulated.
    pub simulated: bool,
}

/// Where an inspection stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Waits for its turn.
    Queued,
    /// The devices are at work.
    Acquiring,
    /// The part may leave; the result is being computed.
    Computing,
    /// There is a result.
    Done,
    /// It was never begun; the reason says why.
    Refused,
    /// It was begun and not finished; the reason says why. The raw data up to there are kept.
    Aborted,
}

impl Phase {
    /// As it stands in the database and in JSON.
    pub fn word(self) -> &'static str {
        match self {
            Phase::Queued => "queued",
            Phase::Acquiring => "acquiring",
            Phase::Computing => "computing",
            Phase::Done => "done",
            Phase::Refused => "refused",
            Phase::Aborted => "aborted",
        }
    }

    fn from_word(word: &str) -> Self {
        match word {
            "queued" => Phase::Queued,
            "acquiring" => Phase::Acquiring,
            "computing" => Phase::Computing,
            "done" => Phase::Done,
            "refused" => Phase::Refused,
            _ => Phase::Aborted,
        }
    }
}

/// One inspection as the history knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Inspection {
    /// Its number, from 1, never used again.
    pub id: i64,
    /// Where it stands.
    pub phase: Phase,
    /// Serial number of the part.
    pub part_serial: String,
    /// Production order or batch.
    pub order_number: String,
    /// Why it was measured.
    pub purpose: Purpose,
    /// Who pressed Start.
    pub operator: String,
    /// The recipe's version; null where it never came to one.
    pub recipe_id: Option<i64>,
    /// The inspection that this one repeats.
    pub remeasure_of: Option<i64>,
    /// True where the instruments were simulated: never part of the statistics.
    pub simulated: bool,
    /// When it was asked for: RFC 3339, UTC.
    pub requested: String,
    /// When the devices began.
    pub started: Option<String>,
    /// When the last profile was there.
    pub acquired: Option<String>,
    /// When it ended, in whatever way.
    pub ended: Option<String>,
    /// The verdict, where there is a result.
    pub verdict: Option<Status>,
    /// Why the verdict is what it is, or why there is none, in one sentence.
    pub reason: String,
    /// The verdict's reason in parts, for other languages; null where there is no verdict, or an older one.
    #[serde(default)]
    pub because: Option<Because>,
    /// Points measured.
    pub points: Option<i64>,
    /// From the first profile to the last, s.
    pub scan_seconds: Option<f64>,
    /// From the last profile to the verdict, s.
    pub verdict_seconds: Option<f64>,
    /// Size of the raw data, bytes; null where they were removed or never taken.
    pub scan_bytes: Option<i64>,
    /// Whether the raw data are of the whole run.
    pub scan_whole: Option<bool>,
}

/// What of the history is asked for. Newest first; a page ends where `before` of the next one begins.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct History {
    /// Only inspections with a smaller number.
    pub before: Option<i64>,
    /// How many, at most 500; 50 where nothing is said.
    #[param(value_type = Option<i64>, minimum = 0, maximum = 4_294_967_295_u32)]
    pub limit: Option<u32>,
    /// Only of this part.
    pub part_serial: Option<String>,
    /// Only of parts whose serial number begins so.
    pub serial_prefix: Option<String>,
    /// Only of this production order.
    pub order_number: Option<String>,
    /// Only with this verdict: ok, not_ok, not_decidable, undefined.
    pub verdict: Option<Status>,
}

/// One measured characteristic, as it is kept for trends.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Edge and quantity: `e1.d1`.
    pub name: String,
    /// `mm` or `deg`.
    pub unit: String,
    /// The worst station's value.
    pub value: Option<f64>,
    /// Its standard uncertainty.
    pub u: Option<f64>,
    /// Lower limit.
    pub lower: Option<f64>,
    /// Upper limit.
    pub upper: Option<f64>,
    /// Its verdict.
    pub verdict: Status,
}

/// The result of an inspection, ready to be committed.
#[derive(Debug, Clone)]
pub struct Finished<'a> {
    /// The report.
    pub report: &'a Report,
    /// From the first profile to the last, s.
    pub scan_seconds: f64,
    /// From the last profile to the verdict, s.
    pub verdict_seconds: f64,
}

/// One value of a trend.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrendPoint {
    /// The inspection.
    pub id: i64,
    /// Its part.
    pub part_serial: String,
    /// When it ended: RFC 3339, UTC.
    pub ended: String,
    /// The value; null = not measured.
    pub value: Option<f64>,
    /// Its standard uncertainty.
    pub u: Option<f64>,
    /// Its verdict.
    pub verdict: Status,
}

/// The last values of one characteristic, oldest first, of parts that count in the statistics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Trend {
    /// Edge and quantity: `e1.d1`.
    pub name: String,
    /// `mm` or `deg`.
    pub unit: String,
    /// The limits that hold for the newest value.
    pub lower: Option<f64>,
    /// As above.
    pub upper: Option<f64>,
    /// The values.
    pub points: Vec<TrendPoint>,
}

const COLUMNS: &str = "id, phase, part_serial, order_number, purpose, operator, recipe_id, remeasure_of, simulated, requested_ms,
    started_ms, acquired_ms, ended_ms, verdict, reason, points, scan_seconds, verdict_seconds, scan_bytes, scan_whole, because";

/// Largest page of a history or a trend.
const PAGE_MAX: u32 = 500;

impl Store {
    /// Takes an order into the queue, and says whether it is new: a trigger that was repeated because its answer got lost
    /// measures once.
    ///
    /// # Errors
    /// [`StoreError::Database`]; [`StoreError::Missing`] where it repeats an inspection that is not there.
    pub fn queue(
        &self,
        trigger: &Trigger<'_>,
        at: SystemTime,
    ) -> Result<(Inspection, bool), StoreError> {
        self.ask(trigger, Phase::Queued, "", at)
    }

    /// Keeps an order that could not be taken, with the reason; or finds the one that was taken under the same key.
    ///
    /// # Errors
    /// As [`Store::queue`].
    pub fn refuse(
        &self,
        trigger: &Trigger<'_>,
        reason: &str,
        at: SystemTime,
    ) -> Result<Inspection, StoreError> {
        Ok(self.ask(trigger, Phase::Refused, reason, at)?.0)
    }

    fn ask(
        &self,
        trigger: &Trigger<'_>,
        phase: Phase,
        reason: &str,
        at: SystemTime,
    ) -> Result<(Inspection, bool), StoreError> {
        let order = trigger.order;
        if let Some(first) = order.remeasure_of {
            self.inspection(first)?;
        }
        self.write(|connection| {
            let transaction = connection.transaction()?;
            let known: Option<i64> = transaction
                .query_row(
                    "SELECT id FROM inspections WHERE idempotency_key = ?1",
                    [trigger.key],
                    |row| row.get(0),
                )
                .optional()?;
            let id = match known {
                Some(id) => id,
                None => {
                    let ended = (phase == Phase::Refused).then(|| millis(at));
                    transaction.execute(
                        "INSERT INTO inspections (phase, part_serial, order_number, purpose, operator, idempotency_key,
                         remeasure_of, simulated, requested_ms, ended_ms, reason)
                         VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11)",
                        params![
                            phase.word(),
                            order.part_serial,
                            order.order_number,
                            purpose_word(order.purpose),
                            trigger.operator,
                            trigger.key,
                            order.remeasure_of,
                            trigger.simulated,
                            millis(at),
                            ended,
                            reason
                        ],
                    )?;
                    transaction.last_insert_rowid()
                }
            };
            let inspection = one(&transaction, id)?;
            transaction.commit()?;
            Ok((inspection, known.is_none()))
        })
    }

    /// The devices begin; `recipe_id` is what the part will be judged by, `scan_file` where its raw data go.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn begin(
        &self,
        id: i64,
        recipe_id: Option<i64>,
        scan_file: &str,
        at: SystemTime,
    ) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "UPDATE inspections SET phase = 'acquiring', started_ms = ?2, recipe_id = ?3, scan_file = ?4 WHERE id = ?1",
                params![id, millis(at), recipe_id, scan_file],
            )?;
            Ok(())
        })
    }

    /// The last profile is there; the part may leave.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn acquired(&self, id: i64, points: u64, at: SystemTime) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "UPDATE inspections SET phase = 'computing', acquired_ms = ?2, points = ?3 WHERE id = ?1",
                params![id, millis(at), i64::try_from(points).unwrap_or(i64::MAX)],
            )?;
            Ok(())
        })
    }

    /// The raw data of an inspection are whole on the disk.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn scan_kept(&self, id: i64, bytes: u64, whole: bool) -> Result<(), StoreError> {
        self.write(|connection| {
            connection.execute(
                "UPDATE inspections SET scan_bytes = ?2, scan_whole = ?3 WHERE id = ?1",
                params![id, i64::try_from(bytes).unwrap_or(i64::MAX), whole],
            )?;
            Ok(())
        })
    }

    /// Commits a result. When this returns it is on the disk and may be announced.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn finish(
        &self,
        id: i64,
        finished: &Finished<'_>,
        at: SystemTime,
    ) -> Result<Inspection, StoreError> {
        let json = pack(&serde_json::to_string(finished.report).unwrap_or_default());
        let because = finished.report.because.as_ref();
        let because = because.and_then(|because| serde_json::to_string(because).ok());
        let measured = measured(finished.report);
        self.write(|connection| {
            let transaction = connection.transaction()?;
            transaction.execute(
                "INSERT INTO reports (inspection, json_zstd) VALUES (?1, ?2)",
                params![id, json],
            )?;
            for value in &measured {
                insert(&transaction, id, value)?;
            }
            transaction.execute(
                "UPDATE inspections SET phase = 'done', ended_ms = ?2, verdict = ?3, reason = ?4, simulated = ?5,
                 scan_seconds = ?6, verdict_seconds = ?7, because = ?8 WHERE id = ?1",
                params![
                    id,
                    millis(at),
                    status_word(finished.report.verdict),
                    finished.report.reason,
                    finished.report.simulated,
                    finished.scan_seconds,
                    finished.verdict_seconds,
                    because,
                ],
            )?;
            let inspection = one(&transaction, id)?;
            transaction.commit()?;
            Ok(inspection)
        })
    }

    /// Ends an inspection without a result.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn abort(&self, id: i64, reason: &str, at: SystemTime) -> Result<Inspection, StoreError> {
        self.write(|connection| {
            connection.execute(
                "UPDATE inspections SET phase = 'aborted', ended_ms = ?2, reason = ?3 WHERE id = ?1",
                params![id, millis(at), reason],
            )?;
            one(connection, id)
        })
    }

    /// The inspections that were neither finished, refused nor aborted, oldest first.
    pub(super) fn unfinished(&self) -> Result<Vec<Inspection>, StoreError> {
        self.read(|connection| {
            let sql = format!(
                "SELECT {COLUMNS} FROM inspections WHERE phase IN ('queued', 'acquiring', 'computing') ORDER BY id"
            );
            let mut query = connection.prepare_cached(&sql)?;
            let rows = query.query_map((), inspection)?;
            rows.collect()
        })
    }

    /// One inspection.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn inspection(&self, id: i64) -> Result<Inspection, StoreError> {
        self.read(|connection| one(connection, id).optional())?
            .ok_or_else(|| missing(id))
    }

    /// A page of the history, newest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn history(&self, history: &History) -> Result<Vec<Inspection>, StoreError> {
        let limit = history.limit.unwrap_or(50).clamp(1, PAGE_MAX);
        // One condition for each index, so that a page costs the same at the millionth inspection as at the first.
        let mut conditions = vec!["id < ?1".to_owned()];
        let mut values: Vec<Box<dyn rusqlite::ToSql>> =
            vec![Box::new(history.before.unwrap_or(i64::MAX))];
        let mut equal = |column: &str, value: Option<String>| {
            if let Some(value) = value {
                values.push(Box::new(value));
                conditions.push(format!("{column} = ?{}", values.len()));
            }
        };
        equal("part_serial", history.part_serial.clone());
        equal("order_number", history.order_number.clone());
        equal(
            "verdict",
            history.verdict.map(|v| status_word(v).to_owned()),
        );
        if let Some(prefix) = &history.serial_prefix {
            values.push(Box::new(prefix.clone()));
            let n = values.len();
            // The serial numbers stand beside each other in their index.
            conditions.push(format!(
                "id IN (SELECT id FROM inspections INDEXED BY inspections_by_serial WHERE part_serial >= ?{n}
                 AND part_serial < ?{n} || char(1114111) AND id < ?1)"
            ));
        }
        let sql = format!(
            "SELECT {COLUMNS} FROM inspections WHERE {} ORDER BY id DESC LIMIT {limit}",
            conditions.join(" AND ")
        );
        self.read(|connection| {
            let mut query = connection.prepare_cached(&sql)?;
            let rows = query.query_map(rusqlite::params_from_iter(values), inspection)?;
            rows.collect()
        })
    }

    /// The report of an inspection, as JSON text.
    ///
    /// # Errors
    /// [`StoreError::Missing`] where it has none, and [`StoreError::Database`].
    pub fn report_json(&self, id: i64) -> Result<String, StoreError> {
        let packed: Option<Vec<u8>> = self.read(|connection| {
            connection
                .query_row(
                    "SELECT json_zstd FROM reports WHERE inspection = ?1",
                    [id],
                    |row| row.get(0),
                )
                .optional()
        })?;
        let what = || format!("the report of inspection {id}");
        let packed = packed.ok_or_else(|| StoreError::Missing { what: what() })?;
        unpack(&packed).ok_or_else(|| StoreError::Damaged { what: what() })
    }

    /// The file of an inspection's raw data.
    ///
    /// # Errors
    /// [`StoreError::Missing`] where it has none, and [`StoreError::Database`].
    pub fn scan_path(&self, id: i64) -> Result<std::path::PathBuf, StoreError> {
        let name: Option<Option<String>> = self.read(|connection| {
            connection
                .query_row(
                    "SELECT scan_file FROM inspections WHERE id = ?1 AND scan_bytes IS NOT NULL",
                    [id],
                    |row| row.get(0),
                )
                .optional()
        })?;
        name.flatten()
            .map(|name| self.folder.join("scans").join(name))
            .ok_or_else(|| StoreError::Missing {
                what: format!("the scan of inspection {id}"),
            })
    }

    /// The characteristics that were ever measured, by name.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub fn characteristics(&self) -> Result<Vec<String>, StoreError> {
        self.read(|connection| {
            let mut query =
                connection.prepare_cached("SELECT name FROM characteristics ORDER BY name")?;
            let rows = query.query_map((), |row| row.get(0))?;
            rows.collect()
        })
    }

    /// The last `limit` values of one characteristic: of series parts on real instruments, or of all with `everything`.
    ///
    /// # Errors
    /// [`StoreError::Missing`] and [`StoreError::Database`].
    pub fn trend(&self, name: &str, limit: u32, everything: bool) -> Result<Trend, StoreError> {
        let limit = limit.clamp(1, PAGE_MAX);
        let found = self.read(|connection| {
            let known: Option<(i64, String)> = connection
                .query_row(
                    "SELECT id, unit FROM characteristics WHERE name = ?1",
                    [name],
                    |row| Ok((row.get(0)?, row.get(1)?)),
                )
                .optional()?;
            let Some((characteristic, unit)) = known else {
                return Ok(None);
            };
            let mut query = connection.prepare_cached(
                "SELECT m.inspection, i.part_serial, i.ended_ms, m.value, m.u, m.verdict, m.lower, m.upper
                 FROM measured m JOIN inspections i ON i.id = m.inspection
                 WHERE m.characteristic = ?1 AND (?3 OR (i.purpose = 'series' AND NOT i.simulated))
                 ORDER BY m.inspection DESC LIMIT ?2",
            )?;
            let rows = query.query_map((characteristic, limit, everything), |row| {
                let point = TrendPoint {
                    id: row.get(0)?,
                    part_serial: row.get(1)?,
                    ended: rfc3339(row.get::<_, Option<i64>>(2)?.unwrap_or(0)),
                    value: row.get(3)?,
                    u: row.get(4)?,
                    verdict: status_from(&row.get::<_, String>(5)?),
                };
                Ok((point, row.get(6)?, row.get(7)?))
            })?;
            let mut points = rows.collect::<rusqlite::Result<Vec<(TrendPoint, Option<f64>, Option<f64>)>>>()?;
            let (lower, upper) = points.first().map_or((None, None), |first| (first.1, first.2));
            points.reverse();
            Ok(Some(Trend {
                name: name.to_owned(),
                unit,
                lower,
                upper,
                points: points.into_iter().map(|(point, _, _)| point).collect(),
            }))
        })?;
        found.ok_or_else(|| StoreError::Missing {
            what: format!("characteristic {name:?}"),
        })
    }
}

/// What of a report is kept value by value.
pub(super) fn measured(report: &Report) -> Vec<Measured> {
    let all = report.edges.iter().flat_map(|edge| &edge.characteristics);
    all.map(|found| Measured {
        name: found.id.clone(),
        unit: found.unit.clone(),
        value: found.value,
        u: found.u,
        lower: found.lower,
        upper: found.upper,
        verdict: found.verdict,
    })
    .collect()
}

fn insert(connection: &Connection, inspection: i64, value: &Measured) -> rusqlite::Result<()> {
    connection
        .prepare_cached("INSERT INTO characteristics (name, unit) VALUES (?1, ?2) ON CONFLICT (name) DO NOTHING")?
        .execute((&value.name, &value.unit))?;
    connection
        .prepare_cached(
            "INSERT INTO measured (characteristic, inspection, value, u, lower, upper, verdict)
             SELECT id, ?2, ?3, ?4, ?5, ?6, ?7 FROM characteristics WHERE name = ?1 ON CONFLICT DO NOTHING",
        )?
        .execute(params![
            value.name,
            inspection,
            value.value,
            value.u,
            value.lower,
            value.upper,
            status_word(value.verdict)
        ])?;
    Ok(())
}

fn one(connection: &Connection, id: i64) -> rusqlite::Result<Inspection> {
    let sql = format!("SELECT {COLUMNS} FROM inspections WHERE id = ?1");
    connection.prepare_cached(&sql)?.query_row([id], inspection)
}

fn inspection(row: &Row<'_>) -> rusqlite::Result<Inspection> {
    let time =
        |index: usize| Ok::<_, rusqlite::Error>(row.get::<_, Option<i64>>(index)?.map(rfc3339));
    Ok(Inspection {
        id: row.get(0)?,
        phase: Phase::from_word(&row.get::<_, String>(1)?),
        part_serial: row.get(2)?,
        order_number: row.get(3)?,
        purpose: purpose_from(&row.get::<_, String>(4)?),
        operator: row.get(5)?,
        recipe_id: row.get(6)?,
        remeasure_of: row.get(7)?,
        simulated: row.get(8)?,
        requested: rfc3339(row.get(9)?),
        started: time(10)?,
        acquired: time(11)?,
        ended: time(12)?,
        verdict: row
            .get::<_, Option<String>>(13)?
            .map(|word| status_from(&word)),
        reason: row.get(14)?,
        points: row.get(15)?,
        scan_seconds: row.get(16)?,
        verdict_seconds: row.get(17)?,
        scan_bytes: row.get(18)?,
        scan_whole: row.get(19)?,
        because: row
            .get::<_, Option<String>>(20)?
            .and_then(|json| serde_json::from_str(&json).ok()),
    })
}

fn missing(id: i64) -> StoreError {
    StoreError::Missing {
        what: format!("inspection {id}"),
    }
}

pub(super) fn status_word(status: Status) -> &'static str {
    match status {
        Status::Undefined => "undefined",
        Status::Ok => "ok",
        Status::NotDecidable => "not_decidable",
        Status::NotOk => "not_ok",
    }
}

fn status_from(word: &str) -> Status {
    match word {
        "ok" => Status::Ok,
        "not_decidable" => Status::NotDecidable,
        "not_ok" => Status::NotOk,
        _ => Status::Undefined,
    }
}

fn purpose_word(purpose: Purpose) -> &'static str {
    match purpose {
        Purpose::Series => "series",
        Purpose::Setup => "setup",
        Purpose::Audit => "audit",
        Purpose::Master => "master",
    }
}

fn purpose_from(word: &str) -> Purpose {
    match word {
        "setup" => Purpose::Setup,
        "audit" => Purpose::Audit,
        "master" => Purpose::Master,
        _ => Purpose::Series,
    }
}
