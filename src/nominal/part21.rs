//! The entities of a STEP file by number, read attribute by attribute.

use std::collections::BTreeMap;

use glam::DVec3;
use step_io::parser::{Attribute, Graph, RawEntity, parse};

use super::{NominalError, Refused};

/// A value of the file, or the entity that is to blame and why.
pub(super) type Read<T> = Result<T, Refused>;

/// Factors from the units of a representation to ours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Units {
    pub length_mm: f64,
    pub angle_rad: f64,
}

/// All entities of one file.
pub(super) struct Part21 {
    graph: Graph,
}

/// One entity, or one of the parts of an entity of several types.
#[derive(Clone, Copy)]
pub(super) struct Record<'a> {
    pub id: u64,
    pub name: &'a str,
    attributes: &'a [Attribute],
    /// Attributes that a part of a complex entity leaves out: those of the types above it.
    skipped: usize,
}

/// Coordinates beyond this are no part: 1,000 km in mm.
const MAX_COORDINATE_MM: f64 = 1e9;

impl Part21 {
    /// Parses the text of a STEP file.
    pub fn parse(bytes: &[u8], name: &str) -> Result<Self, NominalError> {
        check_ends(bytes, name)?;
        let graph = parse(bytes).map_err(|e| NominalError::Syntax {
            name: name.into(),
            what: e.to_string(),
        })?;
        Ok(Self { graph })
    }

    /// All entities in order of their numbers.
    pub fn entities(&self) -> &BTreeMap<u64, RawEntity> {
        &self.graph.entities
    }

    /// Numbers of the entities of these types (also as parts of complex ones), in order.
    pub fn all<'a>(&'a self, names: &'a [&str]) -> impl Iterator<Item = u64> + 'a {
        let wanted = move |n: &String| names.contains(&n.as_str());
        self.entities()
            .iter()
            .filter(move |(_, e)| match e {
                RawEntity::Simple { name, .. } => wanted(name),
                RawEntity::Complex { parts, .. } => parts.iter().any(|p| wanted(&p.name)),
            })
            .map(|(id, _)| *id)
    }

    /// The entity `id`, of one type.
    pub fn record(&self, id: u64) -> Read<Record<'_>> {
        match self.entities().get(&id) {
            Some(RawEntity::Simple {
                name, attributes, ..
            }) => Ok(Record {
                id,
                name,
                attributes,
                skipped: 0,
            }),
            Some(RawEntity::Complex { .. }) => Err(refuse(
                id,
                "an entity of several types where one of one type was expected",
            )),
            None => Err(refuse(id, "the file refers to it but does not contain it")),
        }
    }

    /// The part `name` of the complex entity `id`, counted as if the `skipped` inherited attributes were there.
    pub fn part(&self, id: u64, name: &str, skipped: usize) -> Option<Record<'_>> {
        let Some(RawEntity::Complex { parts, .. }) = self.entities().get(&id) else {
            return None;
        };
        let part = parts.iter().find(|p| p.name == name)?;
        Some(Record {
            id,
            name: &part.name,
            attributes: &part.attributes,
            skipped,
        })
    }

    /// Whether `id` is, or has a part, of type `name`.
    pub fn is(&self, id: u64, name: &str) -> bool {
        match self.entities().get(&id) {
            Some(RawEntity::Simple { name: n, .. }) => n == name,
            Some(RawEntity::Complex { parts, .. }) => parts.iter().any(|p| p.name == name),
            None => false,
        }
    }

    /// The type of `id` in words: its name, or those of its parts joined.
    pub fn type_of(&self, id: u64) -> String {
        match self.entities().get(&id) {
            Some(RawEntity::Simple { name, .. }) => name.clone(),
            Some(RawEntity::Complex { parts, .. }) => {
                let names: Vec<&str> = parts.iter().map(|p| p.name.as_str()).collect();
                names.join("+")
            }
            None => "nothing".into(),
        }
    }

    /// The entity `id`, which must be of type `name`.
    pub fn expect(&self, id: u64, name: &str) -> Read<Record<'_>> {
        let record = self.record(id)?;
        if record.name == name {
            Ok(record)
        } else {
            Err(refuse(id, format!("is {}, expected {name}", record.name)))
        }
    }

    /// The position of a CARTESIAN_POINT, mm.
    pub fn point(&self, id: u64, units: Units) -> Read<DVec3> {
        let p = self.expect(id, "CARTESIAN_POINT")?.triple(1)? * units.length_mm;
        if p.is_finite() && p.abs().max_element() <= MAX_COORDINATE_MM {
            Ok(p)
        } else {
            Err(refuse(
                id,
                format!(
                    "a coordinate of {:e} mm, expected at most {MAX_COORDINATE_MM:e}",
                    p.abs().max_element()
                ),
            ))
        }
    }

    /// A DIRECTION, as long as the file has it.
    pub fn direction(&self, id: u64) -> Read<DVec3> {
        let d = self.expect(id, "DIRECTION")?.triple(1)?;
        if d.is_finite() && d.length() > 1e-12 {
            Ok(d)
        } else {
            Err(refuse(id, "a direction without length"))
        }
    }
}

/// The mark at the start and at the end of the file.
fn check_ends(bytes: &[u8], name: &str) -> Result<(), NominalError> {
    let body = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let body = body.trim_ascii();
    if body.is_empty() {
        return Err(NominalError::Empty { name: name.into() });
    }
    let starts = |text: &[u8], with: &[u8]| {
        text.len() >= with.len() && text[..with.len()].eq_ignore_ascii_case(with)
    };
    // A comment may stand before the mark.
    if !starts(body, b"ISO-10303-21") && !body.starts_with(b"/*") {
        let seen = String::from_utf8_lossy(&body[..body.len().min(24)]).into_owned();
        return Err(NominalError::NotStep {
            name: name.into(),
            seen,
        });
    }
    let tail = &body[body.len().saturating_sub(4096)..];
    let mark = b"END-ISO-10303-21";
    if !tail
        .windows(mark.len())
        .any(|w| w.eq_ignore_ascii_case(mark))
    {
        return Err(NominalError::Unfinished {
            name: name.into(),
            line: bytes.iter().filter(|b| **b == b'\n').count() + 1,
        });
    }
    Ok(())
}

/// Blames an entity.
pub(super) fn refuse(entity: u64, reason: impl Into<String>) -> Refused {
    Refused {
        entity,
        reason: reason.into(),
    }
}

fn number(a: &Attribute) -> Option<f64> {
    match a {
        Attribute::Real(x) => Some(*x),
        Attribute::Integer(i) => Some(*i as f64),
        Attribute::Typed { value, .. } => number(value),
        _ => None,
    }
}

impl<'a> Record<'a> {
    /// The attribute at position `i` of the whole entity.
    pub fn attribute(&self, i: usize) -> Read<&'a Attribute> {
        let here = i.checked_sub(self.skipped);
        here.and_then(|k| self.attributes.get(k)).ok_or_else(|| {
            refuse(
                self.id,
                format!(
                    "{} has {} attributes, expected more than {i}",
                    self.name,
                    self.attributes.len()
                ),
            )
        })
    }

    fn wrong(&self, i: usize, expected: &str) -> Refused {
        refuse(
            self.id,
            format!("attribute {} of {} is not {expected}", i + 1, self.name),
        )
    }

    /// An entity's number.
    pub fn reference(&self, i: usize) -> Read<u64> {
        match self.attribute(i)? {
            Attribute::EntityRef(id) => Ok(*id),
            _ => Err(self.wrong(i, "a reference")),
        }
    }

    /// An entity's number, or none.
    pub fn optional(&self, i: usize) -> Read<Option<u64>> {
        match self.attribute(i)? {
            Attribute::EntityRef(id) => Ok(Some(*id)),
            Attribute::Unset | Attribute::Derived => Ok(None),
            _ => Err(self.wrong(i, "a reference or $")),
        }
    }

    /// A list.
    pub fn list(&self, i: usize) -> Read<&'a [Attribute]> {
        match self.attribute(i)? {
            Attribute::List(items) => Ok(items),
            _ => Err(self.wrong(i, "a list")),
        }
    }

    /// Numbers of the entities in a list.
    pub fn references(&self, i: usize) -> Read<Vec<u64>> {
        self.list(i)?
            .iter()
            .map(|a| match a {
                Attribute::EntityRef(id) => Ok(*id),
                _ => Err(self.wrong(i, "a list of references")),
            })
            .collect()
    }

    /// Numbers of the entities at position `i`: one, a list of them, or a typed list of them.
    pub fn items(&self, i: usize) -> Vec<u64> {
        let list = |items: &[Attribute]| -> Vec<u64> {
            let id = |a: &Attribute| match a {
                Attribute::EntityRef(id) => Some(*id),
                _ => None,
            };
            items.iter().filter_map(id).collect()
        };
        match self.attribute(i) {
            Ok(Attribute::EntityRef(id)) => vec![*id],
            Ok(Attribute::List(items)) => list(items),
            Ok(Attribute::Typed { value, .. }) => match &**value {
                Attribute::EntityRef(id) => vec![*id],
                Attribute::List(items) => list(items),
                _ => Vec::new(),
            },
            _ => Vec::new(),
        }
    }

    /// Rows of numbers of entities.
    pub fn reference_rows(&self, i: usize) -> Read<Vec<Vec<u64>>> {
        self.rows(i, |a| match a {
            Attribute::EntityRef(id) => Some(*id),
            _ => None,
        })
    }

    /// Rows of numbers.
    pub fn number_rows(&self, i: usize) -> Read<Vec<Vec<f64>>> {
        self.rows(i, number)
    }

    fn rows<T>(&self, i: usize, item: impl Fn(&Attribute) -> Option<T>) -> Read<Vec<Vec<T>>> {
        self.list(i)?
            .iter()
            .map(|row| match row {
                Attribute::List(items) => items.iter().map(&item).collect(),
                _ => None,
            })
            .collect::<Option<Vec<Vec<T>>>>()
            .ok_or_else(|| self.wrong(i, "a list of rows"))
    }

    /// A number.
    pub fn number(&self, i: usize) -> Read<f64> {
        number(self.attribute(i)?)
            .filter(|x| x.is_finite())
            .ok_or_else(|| self.wrong(i, "a finite number"))
    }

    /// The first reference in a list.
    pub fn first_reference(&self, i: usize) -> Option<u64> {
        self.list(i).ok()?.iter().find_map(|a| match a {
            Attribute::EntityRef(id) => Some(*id),
            _ => None,
        })
    }

    /// The first number in a list.
    pub fn first_number(&self, i: usize) -> Option<f64> {
        self.list(i).ok()?.iter().find_map(number)
    }

    /// A list of numbers.
    pub fn numbers(&self, i: usize) -> Read<Vec<f64>> {
        self.list(i)?
            .iter()
            .map(number)
            .collect::<Option<Vec<f64>>>()
            .ok_or_else(|| self.wrong(i, "a list of numbers"))
    }

    /// A count, up to 100 million.
    pub fn count(&self, i: usize) -> Read<usize> {
        match self.attribute(i)? {
            Attribute::Integer(n @ 0..=100_000_000) => Ok(*n as usize),
            _ => Err(self.wrong(i, "a count")),
        }
    }

    /// Up to three numbers.
    fn triple(&self, i: usize) -> Read<DVec3> {
        let n = self.numbers(i)?;
        if n.is_empty() || n.len() > 3 {
            return Err(self.wrong(i, "a list of three numbers"));
        }
        let at = |k: usize| n.get(k).copied().unwrap_or(0.0);
        Ok(DVec3::new(at(0), at(1), at(2)))
    }

    /// `.T.` or `.F.`.
    pub fn flag(&self, i: usize) -> Read<bool> {
        match self.attribute(i)? {
            Attribute::Enum(e) if e == "T" => Ok(true),
            Attribute::Enum(e) if e == "F" => Ok(false),
            _ => Err(self.wrong(i, ".T. or .F.")),
        }
    }

    /// A string; empty where it is none.
    pub fn text(&self, i: usize) -> String {
        match self.attribute(i) {
            Ok(Attribute::String(s)) => s.clone(),
            _ => String::new(),
        }
    }

    /// The word between dots, or nothing.
    pub fn word(&self, i: usize) -> Option<&'a str> {
        match self.attribute(i) {
            Ok(Attribute::Enum(e)) => Some(e),
            _ => None,
        }
    }
}
