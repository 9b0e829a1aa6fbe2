//! One TOML table, read key by key: what is missing, wrong or left over becomes a mistake.

use std::ops::RangeInclusive;

use acies_drivers::device::Mistake;
use glam::{DMat3, DVec3};
use toml::Value;
use toml::de::{DeTable, DeValue};

use super::mistake;
use crate::geometry::RigidTransform;

/// How far written axes may be from orthonormal: nine digits are written, six are asked for.
const AXES_TOLERANCE: f64 = 1e-6;

/// Takes values out of a table and notes every mistake on the way.
pub(super) struct TableReader {
    table: toml::Table,
    mistakes: Vec<Mistake>,
    taken: Vec<&'static str>,
}

impl TableReader {
    pub fn new(table: toml::Table) -> Self {
        Self {
            table,
            mistakes: Vec::new(),
            taken: Vec::new(),
        }
    }

    fn take(&mut self, key: &'static str) -> Option<Value> {
        self.taken.push(key);
        self.table.remove(key)
    }

    fn wrong(&mut self, key: &str, found: &str, expected: &str) {
        self.mistakes.push(mistake(key, found, expected));
    }

    fn wrong_type(&mut self, key: &str, found: &Value, expected: &str) {
        self.wrong(
            key,
            &format!("{} {}", found.type_str(), shortened(found)),
            expected,
        );
    }

    /// The value of a key that must be there.
    fn needed(&mut self, key: &'static str, expected: &str) -> Option<Value> {
        let value = self.take(key);
        if value.is_none() {
            self.wrong(key, "nothing", expected);
        }
        value
    }

    pub fn string(&mut self, key: &'static str) -> Option<String> {
        let value = self.needed(key, "a text")?;
        self.as_string(key, value)
    }

    pub fn optional_string(&mut self, key: &'static str) -> Option<String> {
        let value = self.take(key)?;
        self.as_string(key, value)
    }

    fn as_string(&mut self, key: &str, value: Value) -> Option<String> {
        match value {
            Value::String(text) if !text.trim().is_empty() => Some(text),
            other => {
                self.wrong_type(key, &other, "a text that is not empty");
                None
            }
        }
    }

    pub fn integer(&mut self, key: &'static str) -> Option<i64> {
        match self.needed(key, "a whole number")? {
            Value::Integer(number) => Some(number),
            other => {
                self.wrong_type(key, &other, "a whole number");
                None
            }
        }
    }

    pub fn number(&mut self, key: &'static str, range: RangeInclusive<f64>) -> Option<f64> {
        let expected = format!("a number from {} to {}", range.start(), range.end());
        let value = self.needed(key, &expected)?;
        self.as_number(key, &value, &range, &expected)
    }

    pub fn number_or(
        &mut self,
        key: &'static str,
        default: f64,
        range: RangeInclusive<f64>,
    ) -> f64 {
        let expected = format!("a number from {} to {}", range.start(), range.end());
        let value = self.take(key);
        value
            .and_then(|value| self.as_number(key, &value, &range, &expected))
            .unwrap_or(default)
    }

    fn as_number(
        &mut self,
        key: &str,
        value: &Value,
        range: &RangeInclusive<f64>,
        expected: &str,
    ) -> Option<f64> {
        let number = value
            .as_float()
            .or(value.as_integer().map(|number| number as f64));
        let number = number.filter(|number| range.contains(number));
        if number.is_none() {
            self.wrong_type(key, value, expected);
        }
        number
    }

    /// Three finite numbers.
    pub fn vector(&mut self, key: &'static str) -> Option<DVec3> {
        let value = self.needed(key, "three numbers")?;
        let numbers: Option<Vec<f64>> = value.as_array().and_then(|array| {
            array
                .iter()
                .map(|v| {
                    v.as_float()
                        .or(v.as_integer().map(|i| i as f64))
                        .filter(|x| x.is_finite())
                })
                .collect()
        });
        match numbers.as_deref() {
            Some(&[x, y, z]) => Some(DVec3::new(x, y, z)),
            _ => {
                self.wrong_type(key, &value, "three finite numbers");
                None
            }
        }
    }

    pub fn table(&mut self, key: &'static str) -> Option<toml::Table> {
        if !self.table.contains_key(key) {
            self.needed(key, &format!("a table [{key}]"));
            return None;
        }
        self.optional_table(key)
    }

    pub fn optional_table(&mut self, key: &'static str) -> Option<toml::Table> {
        match self.take(key)? {
            Value::Table(table) => Some(table),
            other => {
                self.wrong_type(key, &other, "a table");
                None
            }
        }
    }

    /// An array of tables; none where the key is absent.
    pub fn tables(&mut self, key: &'static str) -> Vec<toml::Table> {
        let Some(value) = self.take(key) else {
            return Vec::new();
        };
        let tables: Option<Vec<toml::Table>> = match &value {
            Value::Array(array) => array
                .iter()
                .map(|entry| entry.as_table().cloned())
                .collect(),
            _ => None,
        };
        tables.unwrap_or_else(|| {
            self.wrong_type(key, &value, &format!("tables, each under [[{key}]]"));
            Vec::new()
        })
    }

    /// A pose: `origin_mm`, and the directions `x_axis` and `z_axis`, all in the machine's axes.
    pub fn pose(&mut self, key: &'static str) -> Option<RigidTransform> {
        let table = self.table(key)?;
        self.as_pose(key, table)
    }

    /// `None` where there is no such table; `Some(None)` where there is one with mistakes.
    pub fn optional_pose(&mut self, key: &'static str) -> Option<Option<RigidTransform>> {
        let table = self.optional_table(key)?;
        Some(self.as_pose(key, table))
    }

    fn as_pose(&mut self, key: &str, table: toml::Table) -> Option<RigidTransform> {
        let mut reader = TableReader::new(table);
        let origin_mm = reader.vector("origin_mm");
        let x = reader.vector("x_axis");
        let z = reader.vector("z_axis");
        if let (Some(x), Some(z)) = (x, z) {
            let error = (x.length() - 1.0)
                .abs()
                .max((z.length() - 1.0).abs())
                .max(x.dot(z).abs());
            if error > AXES_TOLERANCE {
                let found = format!(
                    "lengths {} and {}, product {:e}",
                    x.length(),
                    z.length(),
                    x.dot(z)
                );
                reader.wrong(
                    "x_axis",
                    &found,
                    "unit vectors at right angles, to six digits",
                );
            }
        }
        let mistakes = reader.finish();
        let sound = mistakes.is_empty();
        self.mistakes
            .extend(mistakes.into_iter().map(|inner| Mistake {
                key: format!("{key}.{}", inner.key),
                ..inner
            }));
        let (origin_mm, x, z) = (origin_mm?, x?, z?);
        sound.then(|| RigidTransform::from_matrix(DMat3::from_cols(x, z.cross(x), z), origin_mm))
    }

    /// All mistakes, one for each key that nothing asked for among them.
    pub fn finish(mut self) -> Vec<Mistake> {
        let left: Vec<String> = self.table.keys().cloned().collect();
        let known = format!("one of {}", self.taken.join(", "));
        for key in left {
            self.wrong(&key, "an unknown key", &known);
        }
        self.mistakes
    }

    /// What nothing asked for, and the mistakes so far.
    pub fn into_rest(self) -> (toml::Table, Vec<Mistake>) {
        (self.table, self.mistakes)
    }
}

/// A value as written, at most 40 characters.
fn shortened(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
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
