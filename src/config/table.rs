//! What a cell's tables hold beyond a driver's: poses; and the lines on which keys stand.

use std::time::Duration;

use acies_drivers::settings::Keys;
use glam::{DMat3, DVec3};
use toml::de::{DeTable, DeValue};

use super::Calibrated;
use crate::geometry::RigidTransform;

/// How far written axes may be from orthonormal: nine digits are written, six are asked for.
const AXES_TOLERANCE: f64 = 1e-6;

/// A pose under `key`: `origin_mm`, and the directions `x_axis` and `z_axis`, all in the machine's axes.
pub(super) fn pose(keys: &mut Keys, key: &'static str) -> Option<RigidTransform> {
    let pose = Keys::new(keys.table(key)?);
    adopt_pose(keys, key, pose)
}

/// A pose as in [`pose`], with `date` and `valid_days` of the calibration that found it.
pub(super) fn calibration(
    keys: &mut Keys,
    key: &'static str,
) -> Option<(RigidTransform, Option<Calibrated>)> {
    let mut table = Keys::new(keys.table(key)?);
    let calibrated = calibrated(&mut table);
    adopt_pose(keys, key, table).map(|pose| (pose, calibrated))
}

/// `date` and `valid_days`: when the calibration was made and how long it holds; without `valid_days` for ever.
pub(super) fn calibrated(keys: &mut Keys) -> Option<Calibrated> {
    let expected = "a time as in \"2026-11-26T08:30:00Z\"";
    let date = keys.read("date", expected, |value| {
        let text = match value {
            toml::Value::String(text) => text.clone(),
            toml::Value::Datetime(date) => date.to_string(),
            _ => return None,
        };
        humantime::parse_rfc3339_weak(&text).ok()
    });
    let valid_days = keys.number("valid_days", 0.01..=36_500.0);
    if valid_days.is_some() && !keys.contains("date") && date.is_none() {
        keys.wrong(
            "date",
            "nothing",
            "the time of the calibration beside valid_days",
        );
    }
    Some(Calibrated {
        date: date?,
        valid: valid_days.map(|days| Duration::from_secs_f64(86_400.0 * days)),
    })
}

fn adopt_pose(keys: &mut Keys, key: &'static str, mut pose: Keys) -> Option<RigidTransform> {
    let origin_mm = vector(&mut pose, "origin_mm");
    let x = vector(&mut pose, "x_axis");
    let z = vector(&mut pose, "z_axis");
    if let (Some(x), Some(z)) = (x, z) {
        let error = (x.length() - 1.0)
            .abs()
            .max((z.length() - 1.0).abs())
            .max(x.dot(z).abs());
        if error > AXES_TOLERANCE {
            let (x_length, z_length, product) = (x.length(), z.length(), x.dot(z));
            let found = format!("lengths {x_length} and {z_length}, product {product:e}");
            pose.wrong(
                "x_axis",
                found,
                "unit vectors at right angles, to six digits",
            );
        }
    }
    let sound = keys.adopt(key, pose);
    let (origin_mm, x, z) = (origin_mm?, x?, z?);
    sound.then(|| RigidTransform::from_matrix(DMat3::from_cols(x, z.cross(x), z), origin_mm))
}

/// Three finite numbers that must be there.
pub(super) fn vector(keys: &mut Keys, key: &'static str) -> Option<DVec3> {
    keys.needed(key, "three numbers", Keys::vector)
        .map(DVec3::from)
}

/// The line, from 1, of a byte of a text.
pub(super) fn line_at(text: &str, byte: usize) -> usize {
    1 + text
        .as_bytes()
        .iter()
        .take(byte)
        .filter(|&&b| b == b'\n')
        .count()
}

/// Where the keys of a text stand.
pub(super) struct Lines {
    text: String,
}

impl Lines {
    pub fn of(text: &str) -> Self {
        Self {
            text: text.to_owned(),
        }
    }

    /// The line of the key at `path`, or of the innermost table on the way to it that exists.
    pub fn find(&self, path: &[&str]) -> Option<usize> {
        let root = DeTable::parse(&self.text).ok()?;
        let mut found = None;
        let mut table = root.get_ref();
        let mut keys = path.iter();
        while let Some(key) = keys.next() {
            let Some((name, mut value)) = table.iter().find(|(name, _)| name.get_ref() == key)
            else {
                break;
            };
            found = Some(name.span().start);
            if let DeValue::Array(array) = value.get_ref() {
                let Some(entry) = keys
                    .next()
                    .and_then(|n| n.parse::<usize>().ok())
                    .and_then(|n| array.get(n))
                else {
                    break;
                };
                found = Some(entry.span().start);
                value = entry;
            }
            let DeValue::Table(inner) = value.get_ref() else {
                break;
            };
            table = inner;
        }
        found.map(|byte| line_at(&self.text, byte))
    }
}
