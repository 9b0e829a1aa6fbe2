//! The sections of an IGES 5.3 file in fixed 80-column form: directory and parameters by entity.
//!
//! Each line carries its section in column 73 and its number after it (chapter 2.2 of the specification). An entity is known
//! by the number of its first directory line, as CAD programs show it.

use std::cell::Cell;

use super::NominalError;
use super::part21::{Read, refuse};

/// Columns of data before the section letter.
const DATA: usize = 72;
/// Columns of parameters before the pointer back to the directory.
const PARAMETERS: usize = 64;
/// Parameters that one file may make us read, each time that an entity is looked at.
const MAX_VALUES: usize = 50_000_000;

/// One entity of the directory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    /// Number of its first directory line.
    pub id: u64,
    /// Entity type number.
    pub kind: u32,
    pub form: i64,
    /// Directory number of its transformation matrix, or 0.
    pub transform: u64,
    /// 0 independent, 1 physically, 2 logically dependent, 3 both.
    pub dependence: u8,
    /// 0 geometry, 1 annotation, 2 definition, 3 other, 4 logical, 5 in parameters, 6 construction.
    pub purpose: u8,
    /// First parameter line and how many there are.
    parameters: (usize, usize),
}

/// A file, ready to be asked for its entities.
pub(super) struct Iges<'a> {
    lines: Vec<&'a [u8]>,
    entries: Vec<Entry>,
    delimiters: [u8; 2],
    /// Length of one unit of the file.
    pub unit_mm: f64,
    /// Least distance of two points that the sender tells apart, mm.
    pub resolution_mm: f64,
    values_left: Cell<usize>,
}

/// The parameters of an entity after its type number; `None` where one is text or left out.
pub(super) struct Values {
    pub entry: Entry,
    line: usize,
    values: Vec<Option<f64>>,
}

/// Whether the first line has the letter of the start section where it belongs.
pub(super) fn is_iges(bytes: &[u8]) -> bool {
    let line = bytes.split(|b| *b == b'\n').next().unwrap_or_default();
    line.len() > DATA && matches!(line[DATA], b'S' | b'B' | b'C') && {
        let number = line[DATA + 1..].trim_ascii();
        !number.is_empty() && number.iter().all(|b| b.is_ascii_digit() || *b == b' ')
    }
}

fn broken(name: &str, line: usize, what: impl Into<String>) -> NominalError {
    NominalError::Iges {
        name: name.into(),
        line,
        what: what.into(),
    }
}

impl<'a> Iges<'a> {
    /// The sections of a file.
    ///
    /// # Errors
    /// [`NominalError::Iges`] with the line at which the file stops to be one.
    pub fn parse(bytes: &'a [u8], name: &str) -> Result<Self, NominalError> {
        let mut sections: [Vec<(usize, &[u8])>; 3] = Default::default();
        let mut last = b'S';
        let mut count = 0;
        let mut ended = false;
        for (i, line) in bytes.split(|b| *b == b'\n').enumerate() {
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            count = i + 1;
            if line.trim_ascii().is_empty() || ended {
                continue;
            }
            let Some(letter) = line.get(DATA) else {
                let seen = format!("{} columns, expected 80", line.len());
                return Err(broken(name, i + 1, seen));
            };
            let order = b"SGDPT";
            let place = |l: u8| order.iter().position(|o| *o == l);
            if matches!(letter, b'B' | b'C') && i == 0 {
                let seen = "a binary or compressed IGES file, expected one of 80 columns";
                return Err(broken(name, 1, seen));
            }
            let Some(here) = place(*letter).filter(|p| Some(*p) >= place(last)) else {
                let seen = String::from_utf8_lossy(&[*letter]).into_owned();
                let what = format!(
                    "section {seen:?} in column 73 after section {:?}, expected S, G, D, P, T in this order",
                    char::from(last)
                );
                return Err(broken(name, i + 1, what));
            };
            last = *letter;
            if let Some(section) = here.checked_sub(1).and_then(|k| sections.get_mut(k)) {
                section.push((i + 1, &line[..DATA]));
            }
            ended = here == 4;
        }
        if !ended {
            let what =
                "the file ends without its terminate section (T in column 73), it was cut off";
            return Err(broken(name, count, what));
        }
        let [global, directory, parameters] = sections;
        let (delimiters, unit_mm, resolution_mm) = read_global(&global, name)?;
        let first = parameters.first().map_or(1, |p| p.0);
        Ok(Self {
            entries: read_directory(&directory, first, name)?,
            lines: parameters.iter().map(|(_, l)| &l[..PARAMETERS]).collect(),
            delimiters,
            unit_mm,
            resolution_mm,
            values_left: Cell::new(MAX_VALUES),
        })
    }

    /// All entities in the order of the directory.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The entity with a directory number.
    pub fn entry(&self, id: u64) -> Read<Entry> {
        let index = (id as usize).wrapping_sub(1) / 2;
        match self.entries.get(index) {
            Some(e) if e.id == id => Ok(*e),
            _ => Err(refuse(
                id,
                "the file refers to it but its directory does not have it",
            )),
        }
    }

    /// The parameters of an entity.
    pub fn values(&self, id: u64) -> Read<Values> {
        let entry = self.entry(id)?;
        let (from, count) = entry.parameters;
        let lines = from
            .checked_add(count)
            .and_then(|to| self.lines.get(from..to));
        let lines = lines.filter(|l| !l.is_empty()).ok_or_else(|| {
            refuse(
                id,
                format!(
                    "its parameters are lines {} to {} of {} parameter lines",
                    from + 1,
                    from.saturating_add(count),
                    self.lines.len()
                ),
            )
        })?;
        let left = self.values_left.get();
        let text = lines.iter().flat_map(|l| l.iter().copied());
        let values = parse_values(text, self.delimiters, left).ok_or_else(|| {
            refuse(
                id,
                format!("from parameter line {}: no end of its parameters", from + 1),
            )
        })?;
        self.values_left.set(left - values.len());
        if values.first().copied().flatten() != Some(f64::from(entry.kind)) {
            return Err(refuse(
                id,
                format!(
                    "parameter line {} is not of an entity of type {}",
                    from + 1,
                    entry.kind
                ),
            ));
        }
        Ok(Values {
            entry,
            line: from + 1,
            values: values[1..].to_vec(),
        })
    }
}

impl Values {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// The number at a place, counted from 0 after the type.
    pub fn number(&self, i: usize) -> Read<f64> {
        let value = self.values.get(i).copied().flatten();
        value.filter(|x| x.is_finite()).ok_or_else(|| {
            refuse(
                self.entry.id,
                format!(
                    "parameter {} of type {} (parameter line {}) is not a finite number",
                    i + 1,
                    self.entry.kind,
                    self.line
                ),
            )
        })
    }

    /// The number at a place, or 0 where it is left out.
    pub fn or_zero(&self, i: usize) -> Read<f64> {
        match self.values.get(i) {
            None | Some(None) => Ok(0.0),
            Some(Some(_)) => self.number(i),
        }
    }

    /// A whole number from 0 to `most`.
    pub fn count(&self, i: usize, most: usize) -> Read<usize> {
        let x = self.or_zero(i)?;
        if x >= 0.0 && x <= most as f64 && x.fract() == 0.0 {
            return Ok(x as usize);
        }
        Err(refuse(
            self.entry.id,
            format!(
                "parameter {} of type {} (parameter line {}) is {x}, expected a whole number from 0 to {most}",
                i + 1,
                self.entry.kind,
                self.line
            ),
        ))
    }

    /// A directory number, 0 for none.
    pub fn pointer(&self, i: usize) -> Read<u64> {
        Ok(self.count(i, 1 << 40)? as u64)
    }

    /// `count` directory numbers.
    pub fn pointers(&self, from: usize, count: usize) -> Read<Vec<u64>> {
        self.holds(from, count)?;
        (from..from + count).map(|i| self.pointer(i)).collect()
    }

    /// `count` numbers.
    pub fn numbers(&self, from: usize, count: usize) -> Read<Vec<f64>> {
        self.holds(from, count)?;
        (from..from + count).map(|i| self.number(i)).collect()
    }

    /// Refuses a count beyond the parameters there are, before room is made for it.
    fn holds(&self, from: usize, count: usize) -> Read<()> {
        if from.checked_add(count).is_some_and(|to| to <= self.len()) {
            return Ok(());
        }
        Err(refuse(
            self.entry.id,
            format!(
                "type {} (parameter line {}) has {} parameters, expected {count} from the {}th",
                self.entry.kind,
                self.line,
                self.len(),
                from + 1
            ),
        ))
    }
}

/// Numbers up to the record delimiter; `None` where it does not come, or more than `most` come before it.
fn parse_values(
    text: impl Iterator<Item = u8>,
    [between, end]: [u8; 2],
    most: usize,
) -> Option<Vec<Option<f64>>> {
    let mut out = Vec::new();
    let mut word: Vec<u8> = Vec::new();
    let mut skip = 0usize;
    let mut is_text = false;
    for b in text {
        if skip > 0 {
            skip -= 1;
            continue;
        }
        if b == between || b == end {
            if out.len() >= most {
                return None;
            }
            out.push(if is_text { None } else { number(&word) });
            word.clear();
            is_text = false;
            if b == end {
                return Some(out);
            }
        } else if b == b'H' && !word.is_empty() && word.iter().all(u8::is_ascii_digit) {
            // A Hollerith string: so many characters follow, delimiters among them.
            skip = number(&word)? as usize;
            is_text = true;
        } else if b != b' ' && word.len() < 64 {
            word.push(b);
        }
    }
    None
}

/// A number as Fortran writes it.
fn number(word: &[u8]) -> Option<f64> {
    let text = std::str::from_utf8(word).ok()?;
    text.replace(['D', 'd'], "E").parse().ok()
}

/// The fields of the global section: delimiters, unit and resolution.
fn read_global(lines: &[(usize, &[u8])], name: &str) -> Result<([u8; 2], f64, f64), NominalError> {
    let line = lines.first().map_or(1, |l| l.0);
    let text: Vec<u8> = lines.iter().flat_map(|(_, l)| l.iter().copied()).collect();
    let mut rest = &text[..];
    let mut delimiters = [b',', b';'];
    for k in 0..2 {
        match rest {
            [b'1', b'H', d, tail @ ..] => {
                delimiters[k] = *d;
                rest = tail.strip_prefix(&[delimiters[0]]).unwrap_or(tail);
            }
            [d, tail @ ..] if *d == delimiters[0] => rest = tail,
            _ => {}
        }
    }
    let fields = fields(rest, delimiters);
    let field = |i: usize| fields.get(i - 3).map_or(&b""[..], |f| f.trim_ascii());
    let value = |i: usize| number(field(i)).filter(|x| x.is_finite());
    let unit_mm = match (value(14).unwrap_or(1.0) as i64, field(15)) {
        (1, _) | (3, b"IN" | b"INCH") => 25.4,
        (2, _) | (3, b"MM") => 1.0,
        (4, _) | (3, b"FT") => 304.8,
        (5, _) | (3, b"MI") => 1_609_344.0,
        (6, _) | (3, b"M") => 1000.0,
        (7, _) | (3, b"KM") => 1e6,
        (8, _) | (3, b"MIL") => 0.0254,
        (9, _) | (3, b"UM") => 1e-3,
        (10, _) | (3, b"CM") => 10.0,
        (11, _) | (3, b"UIN") => 2.54e-5,
        (flag, unit) => {
            let unit = String::from_utf8_lossy(unit).into_owned();
            let what = format!(
                "unit flag {flag} with unit {unit:?}, expected one of the specification's eleven"
            );
            return Err(broken(name, line, what));
        }
    };
    let scale = value(13).unwrap_or(1.0);
    if !(scale > 0.0 && scale < 1e9) {
        let what = format!("a model space scale of {scale}, expected a positive number");
        return Err(broken(name, line, what));
    }
    let unit_mm = unit_mm / scale;
    Ok((
        delimiters,
        unit_mm,
        value(19).unwrap_or(0.0).abs() * unit_mm,
    ))
}

/// Fields up to the record delimiter, strings without their count.
fn fields(text: &[u8], [between, end]: [u8; 2]) -> Vec<Vec<u8>> {
    let mut out = Vec::new();
    let mut field = Vec::new();
    let mut skip = 0usize;
    for b in text {
        if skip > 0 {
            skip -= 1;
            field.push(*b);
        } else if *b == end {
            break;
        } else if *b == between {
            out.push(std::mem::take(&mut field));
        } else if *b == b'H' && !field.is_empty() && field.iter().all(u8::is_ascii_digit) {
            skip = number(&field).unwrap_or(0.0) as usize;
            field.clear();
        } else {
            field.push(*b);
        }
    }
    out.push(field);
    out
}

fn read_directory(
    lines: &[(usize, &[u8])],
    first_parameter_line: usize,
    name: &str,
) -> Result<Vec<Entry>, NominalError> {
    let mut out = Vec::with_capacity(lines.len() / 2);
    for pair in lines.chunks(2) {
        let [(at, a), (_, b)] = pair else {
            let what = format!(
                "half a directory entry before the parameters at line {first_parameter_line}, expected two lines for each"
            );
            return Err(broken(name, pair[0].0, what));
        };
        let field = |line: &[u8], k: usize| -> Result<i64, NominalError> {
            let text = line[8 * (k - 1)..8 * k].trim_ascii();
            if text.is_empty() {
                return Ok(0);
            }
            let value = std::str::from_utf8(text).ok().and_then(|t| t.parse().ok());
            value.ok_or_else(|| {
                let seen = String::from_utf8_lossy(text).into_owned();
                broken(
                    name,
                    *at,
                    format!("field {k} of the directory is {seen:?}, expected a whole number"),
                )
            })
        };
        let status = &a[64..72];
        let digit = |i: usize| match status[i] {
            d @ b'0'..=b'9' => d - b'0',
            _ => 0,
        };
        let natural = |x: i64| usize::try_from(x).unwrap_or(0);
        out.push(Entry {
            id: 2 * out.len() as u64 + 1,
            kind: u32::try_from(field(a, 1)?).unwrap_or(0),
            transform: natural(field(a, 7)?) as u64,
            dependence: digit(3),
            purpose: digit(5),
            form: field(b, 5)?,
            parameters: (
                natural(field(a, 2)?).saturating_sub(1),
                natural(field(b, 4)?).max(1),
            ),
        });
    }
    Ok(out)
}
