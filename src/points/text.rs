//! Points from columns of numbers: XYZ, CSV, TXT and PTS.
//!
//! Columns are parted by semicolons, by commas, or by tabs and blanks, as the first line of numbers shows. A header line may name
//! the columns (`X(mm),Y(mm),Z(mm)`); without one the first three columns are x, y and z. Lines that are blank or begin with
//! `#`, `//` or `%` are skipped. PTS begins each section with the number of its points on a line alone.

use glam::DVec3;

use super::error::{Fault, Malformed, excerpt};
use super::read::{Parsed, Unit};
use super::scalar::{AXES, position};

/// The lines of a text with their numbers from 1, without their ends and without blanks on either side.
pub(crate) struct Lines<'a> {
    rest: &'a [u8],
    number: u64,
}

impl<'a> Lines<'a> {
    /// Over `bytes`, the first line having `first_number`; a UTF-8 mark at the beginning is skipped.
    pub fn new(bytes: &'a [u8], first_number: u64) -> Self {
        Self {
            rest: bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes),
            number: first_number - 1,
        }
    }

    /// Number of the line handed out last.
    pub fn number(&self) -> u64 {
        self.number
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = (u64, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let end = self.rest.iter().position(|&b| b == b'\n');
        let line = &self.rest[..end.unwrap_or(self.rest.len())];
        self.rest = end.map_or(&[], |end| &self.rest[end + 1..]);
        self.number += 1;
        Some((self.number, line.trim_ascii()))
    }
}

/// The words of a line, parted by blanks.
pub(crate) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace)
        .filter(|w| !w.is_empty())
}

/// The first word of the first line that is neither blank nor a comment.
pub(crate) fn first_word(bytes: &[u8]) -> &[u8] {
    Lines::new(bytes, 1)
        .map(|(_, line)| line)
        .find(|line| !is_skipped(line))
        .and_then(|line| words(line).next())
        .unwrap_or_default()
}

/// The number that `word` is.
pub(crate) fn number(word: &[u8]) -> Option<f64> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

fn is_skipped(line: &[u8]) -> bool {
    // 0x1a is the end-of-file mark of old programs.
    line.is_empty()
        || line.starts_with(b"#")
        || line.starts_with(b"//")
        || line.starts_with(b"%")
        || line == b"\x1a"
}

/// What parts the columns.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Separator {
    Blanks,
    Byte(u8),
}

impl Separator {
    fn of(line: &[u8]) -> Self {
        if line.contains(&b';') {
            Separator::Byte(b';')
        } else if line.contains(&b',') && !has_decimal_commas(line) {
            Separator::Byte(b',')
        } else {
            Separator::Blanks
        }
    }

    /// Calls `take` with each column and its index, and returns the number of columns.
    #[inline]
    fn columns<'a>(self, line: &'a [u8], mut take: impl FnMut(usize, &'a [u8])) -> usize {
        let mut count = 0;
        match self {
            Separator::Blanks => {
                for word in words(line) {
                    take(count, word);
                    count += 1;
                }
            }
            Separator::Byte(separator) => {
                // Some programs end every line with a separator.
                let line = line.strip_suffix(&[separator]).unwrap_or(line);
                for field in line.split(|&b| b == separator) {
                    take(count, field.trim_ascii());
                    count += 1;
                }
            }
        }
        count
    }
}

/// Whether the words of a line, once a comma at their end is taken off, are numbers with a comma for a point.
fn has_decimal_commas(line: &[u8]) -> bool {
    let mut seen = 0;
    for word in line.split(|&b| b == b';' || b.is_ascii_whitespace()) {
        let word = word.strip_suffix(b",").unwrap_or(word);
        let Some(comma) = word.iter().position(|&b| b == b',') else {
            continue;
        };
        let (before, after) = (&word[..comma], &word[comma + 1..]);
        let digits = |s: &[u8]| !s.is_empty() && s.iter().all(u8::is_ascii_digit);
        let after = after
            .split(|b| matches!(b, b'e' | b'E'))
            .next()
            .unwrap_or_default();
        if !digits(before.trim_prefix_sign()) || !digits(after) {
            return false;
        }
        seen += 1;
    }
    // One pair of digits parted by a comma is two columns; several words of such pairs are decimal commas.
    seen > 1 || (seen == 1 && line.contains(&b';'))
}

trait TrimSign {
    fn trim_prefix_sign(&self) -> &[u8];
}

impl TrimSign for [u8] {
    fn trim_prefix_sign(&self) -> &[u8] {
        match self {
            [b'+' | b'-', rest @ ..] => rest,
            _ => self,
        }
    }
}

/// How the lines of points are laid out.
struct Layout {
    separator: Separator,
    /// Columns of x, y and z.
    axes: [usize; 3],
    columns: usize,
}

impl Layout {
    /// From a line that begins with words instead of numbers.
    fn from_header(line: &[u8], unit: Unit, findings: &mut Vec<String>) -> Result<Self, Fault> {
        // A name may have blanks in it, as in `X [mm]`.
        let separator = if line.contains(&b'\t') {
            Separator::Byte(b'\t')
        } else {
            Separator::of(line)
        };
        let mut axes: [Option<usize>; 3] = [None; 3];
        let mut twice = false;
        let mut said_unit = None;
        let columns = separator.columns(line, |index, name| {
            let (axis, column_unit) = column_name(name);
            if let Some(slot) = axis.map(|axis| &mut axes[axis]) {
                twice |= slot.replace(index).is_some();
                said_unit = said_unit.or(column_unit);
            }
        });
        let [Some(x), Some(y), Some(z)] = axes else {
            return Err(Fault::HeaderNames {
                seen: excerpt(line),
            });
        };
        if twice {
            return Err(Fault::HeaderNames {
                seen: excerpt(line),
            });
        }
        if let Some(said) = said_unit.filter(|&said| said != unit) {
            findings.push(format!(
                "the header gives the coordinates in {said}, they were read in {unit}"
            ));
        }
        Ok(Self {
            separator,
            axes: [x, y, z],
            columns,
        })
    }

    /// From the first line of numbers.
    fn from_numbers(line: &[u8]) -> Result<Self, Fault> {
        if has_decimal_commas(line) {
            return Err(Fault::DecimalComma {
                seen: excerpt(line),
            });
        }
        let separator = Separator::of(line);
        match separator.columns(line, |_, _| ()) {
            seen @ 0..3 => Err(Fault::TooFewColumns { seen }),
            columns => Ok(Self {
                separator,
                axes: [0, 1, 2],
                columns,
            }),
        }
    }

    #[inline]
    fn point(&self, line: &[u8], unit: Unit) -> Result<DVec3, Fault> {
        let mut fields: [&[u8]; 3] = [&[]; 3];
        let [x, y, z] = self.axes;
        let columns = self.separator.columns(line, |index, field| {
            if index == x {
                fields[0] = field;
            } else if index == y {
                fields[1] = field;
            } else if index == z {
                fields[2] = field;
            }
        });
        if columns != self.columns {
            return Err(self.column_fault(line, columns));
        }
        let mut raw = [0.0; 3];
        for axis in 0..3 {
            raw[axis] =
                number(fields[axis]).ok_or_else(|| number_fault(AXES[axis], fields[axis], line))?;
        }
        position(raw, unit)
    }

    #[cold]
    fn column_fault(&self, line: &[u8], seen: usize) -> Fault {
        if has_decimal_commas(line) {
            Fault::DecimalComma {
                seen: excerpt(line),
            }
        } else if seen < 3 {
            Fault::TooFewColumns { seen }
        } else {
            Fault::Columns {
                seen,
                expected: self.columns,
            }
        }
    }
}

#[cold]
fn number_fault(field: &'static str, word: &[u8], line: &[u8]) -> Fault {
    if has_decimal_commas(line) {
        return Fault::DecimalComma {
            seen: excerpt(line),
        };
    }
    Fault::NotANumber {
        field,
        seen: excerpt(word),
    }
}

/// Which coordinate a column's name means, and the unit that it states: `X(mm)`, `"y [m]"`, `z_mm`.
fn column_name(name: &[u8]) -> (Option<usize>, Option<Unit>) {
    let name = String::from_utf8_lossy(name).to_ascii_lowercase();
    let mut parts = name
        .split(|c: char| !(c.is_alphanumeric() || c == 'µ'))
        .filter(|p| !p.is_empty());
    let axis = match parts.next() {
        Some("x") => 0,
        Some("y") => 1,
        Some("z") => 2,
        _ => return (None, None),
    };
    match (parts.next(), parts.next()) {
        (None, _) => (Some(axis), None),
        (Some(unit), None) => match unit.parse() {
            Ok(unit) => (Some(axis), Some(unit)),
            // A name such as `x_normal` is another quantity.
            Err(_) => (None, None),
        },
        _ => (None, None),
    }
}

/// The points of a text.
///
/// # Errors
/// With the line of the first fault.
pub(crate) fn parse(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    let mut parsed = Parsed::default();
    let mut layout: Option<Layout> = None;
    let mut sections = Sections::default();
    let mut lines = Lines::new(bytes, 1);
    for (at, line) in lines.by_ref() {
        if is_skipped(line) {
            continue;
        }
        if sections.begins_with(line, parsed.positions.len(), layout.is_none()) {
            continue;
        }
        let layout = match &layout {
            Some(layout) => layout,
            None if begins_with_number(line) => {
                let found = Layout::from_numbers(line).map_err(|f| f.at_line(at))?;
                // A short line holds at least "0 0 0" and its end: the length of the first is a fair guess at the others'.
                parsed
                    .positions
                    .reserve(bytes.len() / (line.len() + 1).max(6));
                layout.insert(found)
            }
            None => {
                let found = Layout::from_header(line, unit, &mut parsed.findings);
                layout = Some(found.map_err(|f| f.at_line(at))?);
                continue;
            }
        };
        let point = layout.point(line, unit).map_err(|f| f.at_line(at))?;
        parsed.positions.push(point);
    }
    sections.end(parsed.positions.len(), lines.number())?;
    Ok(parsed)
}

fn begins_with_number(line: &[u8]) -> bool {
    let first = line
        .split(|b| b.is_ascii_whitespace() || matches!(b, b',' | b';'))
        .next()
        .unwrap_or_default();
    number(first).is_some()
}

/// The counts that PTS files write before each section of points.
#[derive(Default)]
struct Sections {
    /// Number of points promised by all counts so far.
    promised: Option<u64>,
}

impl Sections {
    /// Whether `line` is a count, which only stands where a section may begin.
    fn begins_with(&mut self, line: &[u8], points: usize, at_start: bool) -> bool {
        let may_begin = match self.promised {
            None => at_start && points == 0,
            Some(promised) => promised == points as u64,
        };
        if !may_begin || !line.iter().all(u8::is_ascii_digit) {
            return false;
        }
        let Some(count) = std::str::from_utf8(line)
            .ok()
            .and_then(|l| l.parse::<u64>().ok())
        else {
            return false;
        };
        self.promised = Some(self.promised.unwrap_or(0).saturating_add(count));
        true
    }

    fn end(&self, points: usize, line: u64) -> Result<(), Malformed> {
        match self.promised {
            Some(promised) if promised > points as u64 => Err(Fault::Truncated {
                what: "points",
                seen: points as u64,
                expected: promised,
            }
            .at_line(line)),
            Some(promised) if promised < points as u64 => Err(Fault::Statement {
                seen: format!("{points} points"),
                expected: "as many as the count at the beginning says",
            }
            .at_line(line)),
            _ => Ok(()),
        }
    }
}
