//! Points from PCD 0.7: ascii, binary and binary_compressed, any fields in any order.
//!
//! An organised cloud (HEIGHT > 1) has a place for every pixel; NaN in x, y and z there means "no return".

use super::error::{Fault, Malformed, excerpt};
use super::lzf;
use super::read::{Parsed, Unit};
use super::scalar::{AXES, Scalar, position};
use super::text::{Lines, number, words};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Data {
    Ascii,
    Binary,
    Compressed,
}

/// A field of the header: numbers of one type.
#[derive(Debug, Clone)]
struct Field {
    name: String,
    scalar: Scalar,
    count: usize,
}

struct Header {
    fields: Vec<Field>,
    points: u64,
    organised: bool,
    data: Data,
    /// Byte after the header.
    body: usize,
    /// Line after the header.
    body_line: u64,
}

/// Lines of the header as words, before they are put together.
#[derive(Default)]
struct Entries<'a> {
    fields: Vec<&'a [u8]>,
    sizes: Vec<u64>,
    types: Vec<&'a [u8]>,
    counts: Vec<u64>,
    width: Option<u64>,
    height: Option<u64>,
    points: Option<u64>,
}

fn fault(seen: &[u8], expected: &'static str) -> Fault {
    Fault::Header {
        seen: excerpt(seen),
        expected,
    }
}

fn whole(word: &[u8]) -> Option<u64> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

fn scalar(kind: &[u8], size: u64) -> Option<Scalar> {
    Some(match (kind, size) {
        (b"I", 1) => Scalar::I8,
        (b"I", 2) => Scalar::I16,
        (b"I", 4) => Scalar::I32,
        (b"I", 8) => Scalar::I64,
        (b"U", 1) => Scalar::U8,
        (b"U", 2) => Scalar::U16,
        (b"U", 4) => Scalar::U32,
        (b"U", 8) => Scalar::U64,
        (b"F", 4) => Scalar::F32,
        (b"F", 8) => Scalar::F64,
        _ => return None,
    })
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, Malformed> {
        let mut entries = Entries::default();
        let mut body = 0;
        for (at, raw) in (1..).zip(bytes.split_inclusive(|&b| b == b'\n')) {
            body += raw.len();
            let line = raw.trim_ascii();
            let data = entries.line(line).map_err(|f| f.at_line(at))?;
            if let Some(data) = data {
                let mut header = entries.finish(data).map_err(|f| f.at_line(at))?;
                header.body = body;
                header.body_line = at + 1;
                return Ok(header);
            }
        }
        Err(fault(b"the end of the file", "a DATA line").at_byte(bytes.len()))
    }

    /// Bytes of one point.
    fn stride(&self) -> usize {
        self.fields.iter().map(|f| f.scalar.size() * f.count).sum()
    }

    /// The fields of x, y and z, each with its number of columns (ascii) and bytes (binary) before it.
    fn axes(&self) -> Result<[(Scalar, usize, usize); 3], Fault> {
        let mut axes = [(Scalar::F32, 0, 0); 3];
        for (slot, name) in axes.iter_mut().zip(AXES) {
            let Some(index) = self
                .fields
                .iter()
                .position(|f| f.name == name && f.count > 0)
            else {
                return Err(Fault::NoCoordinate { missing: name });
            };
            let before = &self.fields[..index];
            *slot = (
                self.fields[index].scalar,
                before.iter().map(|f| f.count).sum(),
                before.iter().map(|f| f.scalar.size() * f.count).sum(),
            );
        }
        Ok(axes)
    }
}

impl<'a> Entries<'a> {
    /// Takes one line; says how the data follow where it is the last.
    fn line(&mut self, line: &'a [u8]) -> Result<Option<Data>, Fault> {
        let mut parts = words(line);
        let Some(key) = parts.next() else {
            return Ok(None);
        };
        let one = |word: Option<&[u8]>| {
            word.and_then(whole)
                .ok_or_else(|| fault(line, "a whole number"))
        };
        let all = |parts: &mut dyn Iterator<Item = &'a [u8]>| {
            parts
                .map(|w| whole(w).ok_or_else(|| fault(line, "whole numbers")))
                .collect::<Result<Vec<u64>, Fault>>()
        };
        match key {
            b"FIELDS" => self.fields = parts.collect(),
            b"TYPE" => self.types = parts.collect(),
            b"SIZE" => self.sizes = all(&mut parts)?,
            b"COUNT" => self.counts = all(&mut parts)?,
            b"WIDTH" => self.width = Some(one(parts.next())?),
            b"HEIGHT" => self.height = Some(one(parts.next())?),
            b"POINTS" => self.points = Some(one(parts.next())?),
            b"VERSION" | b"VIEWPOINT" => {}
            _ if key.starts_with(b"#") => {}
            b"DATA" => {
                return match parts.next() {
                    Some(b"ascii") => Ok(Some(Data::Ascii)),
                    Some(b"binary") => Ok(Some(Data::Binary)),
                    Some(b"binary_compressed") => Ok(Some(Data::Compressed)),
                    _ => Err(fault(line, "ascii, binary or binary_compressed")),
                };
            }
            _ => return Err(fault(line, "an entry of a PCD header")),
        }
        Ok(None)
    }

    fn finish(self, data: Data) -> Result<Header, Fault> {
        let number = self.fields.len();
        let counts = if self.counts.is_empty() {
            vec![1; number]
        } else {
            self.counts
        };
        if self.sizes.len() != number || self.types.len() != number || counts.len() != number {
            return Err(fault(b"FIELDS", "as many FIELDS as SIZE, TYPE and COUNT"));
        }
        let mut fields = Vec::with_capacity(number);
        let mut columns = 0u64;
        for (((name, kind), size), count) in self
            .fields
            .iter()
            .zip(&self.types)
            .zip(&self.sizes)
            .zip(counts)
        {
            let scalar = scalar(kind, *size)
                .ok_or_else(|| fault(kind, "TYPE I, U or F with a SIZE that it has"))?;
            columns = columns.saturating_add(count);
            // PCL's largest histograms have 1,344 columns.
            if columns > 100_000 {
                return Err(fault(b"COUNT", "at most 100000 numbers a point"));
            }
            fields.push(Field {
                name: String::from_utf8_lossy(name).into_owned(),
                scalar,
                count: count as usize,
            });
        }
        let height = self.height.unwrap_or(1);
        let area = self.width.and_then(|width| width.checked_mul(height));
        let points = match (self.points, area) {
            (Some(points), Some(area)) if points != area => {
                return Err(fault(b"POINTS", "WIDTH times HEIGHT"));
            }
            (Some(points), _) => points,
            (None, Some(area)) => area,
            (None, None) => return Err(fault(b"DATA", "WIDTH and HEIGHT or POINTS before it")),
        };
        Ok(Header {
            fields,
            points,
            organised: height > 1,
            data,
            body: 0,
            body_line: 0,
        })
    }
}

/// The points of a PCD file.
///
/// # Errors
/// With line (header, ascii) or byte (binary) of the first fault.
pub(crate) fn parse(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    let header = Header::parse(bytes)?;
    let mut sink = Sink {
        parsed: Parsed::default(),
        organised: header.organised,
        unit,
        no_return: 0,
    };
    match header.data {
        Data::Ascii => read_ascii(&header, bytes, &mut sink)?,
        Data::Binary => read_binary(&header, bytes, &mut sink)?,
        Data::Compressed => read_compressed(&header, bytes, &mut sink)?,
    }
    let mut parsed = sink.parsed;
    if sink.no_return > 0 {
        let note = format!(
            "{} of {} pixels have no return and were left out",
            sink.no_return, header.points
        );
        parsed.findings.push(note);
    }
    Ok(parsed)
}

struct Sink {
    parsed: Parsed,
    organised: bool,
    unit: Unit,
    no_return: u64,
}

impl Sink {
    #[inline]
    fn point(&mut self, raw: [f64; 3]) -> Result<(), Fault> {
        match position(raw, self.unit) {
            Ok(point) => self.parsed.positions.push(point),
            Err(_) if self.organised && raw.iter().all(|v| v.is_nan()) => self.no_return += 1,
            Err(fault) => return Err(fault),
        }
        Ok(())
    }
}

fn truncated(seen: u64, expected: u64) -> Fault {
    Fault::Truncated {
        what: "points",
        seen,
        expected,
    }
}

fn read_ascii(header: &Header, bytes: &[u8], sink: &mut Sink) -> Result<(), Malformed> {
    let axes = header.axes().map_err(|f| f.at_line(header.body_line - 1))?;
    let columns: usize = header.fields.iter().map(|f| f.count).sum();
    let body = &bytes[header.body..];
    let room = header.points.min((body.len() / 6) as u64) as usize;
    sink.parsed.positions.reserve(room);
    let mut lines = Lines::new(body, header.body_line);
    for index in 0..header.points {
        let Some((at, line)) = lines.find(|(_, line)| !line.is_empty()) else {
            return Err(truncated(index, header.points).at_line(lines.number()));
        };
        let mut raw = [None; 3];
        let mut seen = 0;
        for word in words(line) {
            for (value, (_, column, _)) in raw.iter_mut().zip(axes) {
                if column == seen {
                    *value = Some(word);
                }
            }
            seen += 1;
        }
        if seen != columns {
            return Err(Fault::Columns {
                seen,
                expected: columns,
            }
            .at_line(at));
        }
        let mut values = [0.0; 3];
        for axis in 0..3 {
            let word = raw[axis].unwrap_or_default();
            values[axis] = number(word).ok_or_else(|| {
                Fault::NotANumber {
                    field: AXES[axis],
                    seen: excerpt(word),
                }
                .at_line(at)
            })?;
        }
        sink.point(values).map_err(|f| f.at_line(at))?;
    }
    if let Some((at, _)) = lines.find(|(_, line)| !line.is_empty()) {
        let note =
            format!("line {at} and what follows it are beyond the last point and were not read");
        sink.parsed.findings.push(note);
    }
    Ok(())
}

fn read_binary(header: &Header, bytes: &[u8], sink: &mut Sink) -> Result<(), Malformed> {
    let axes = header.axes().map_err(|f| f.at_line(header.body_line - 1))?;
    // At least 3, as there are x, y and z.
    let stride = header.stride();
    let body = &bytes[header.body..];
    let present = (body.len() / stride) as u64;
    if present < header.points {
        return Err(truncated(present, header.points).at_byte(bytes.len()));
    }
    let count = header.points as usize;
    sink.parsed.positions.reserve(count);
    for (index, row) in body.chunks_exact(stride).take(count).enumerate() {
        let raw = axes.map(|(scalar, _, offset)| scalar.get(&row[offset..], false));
        sink.point(raw)
            .map_err(|f| f.at_byte(header.body + index * stride))?;
    }
    let extra = body.len() - count * stride;
    if extra > 0 {
        let note = format!("{extra} bytes after the last point were not read");
        sink.parsed.findings.push(note);
    }
    Ok(())
}

/// Compressed data hold one field of all points after the other.
fn read_compressed(header: &Header, bytes: &[u8], sink: &mut Sink) -> Result<(), Malformed> {
    let axes = header.axes().map_err(|f| f.at_line(header.body_line - 1))?;
    let at = |f: Fault| f.at_byte(header.body);
    let body = &bytes[header.body..];
    let Some((sizes, packed)) = body.split_at_checked(8) else {
        return Err(truncated(0, header.points).at_byte(bytes.len()));
    };
    let size = |at: usize| Scalar::U32.get(&sizes[at..], false) as usize;
    let (packed_size, unpacked_size) = (size(0), size(4));
    let Some(packed) = packed.get(..packed_size) else {
        return Err(Fault::Truncated {
            what: "bytes of packed data",
            seen: packed.len() as u64,
            expected: packed_size as u64,
        }
        .at_byte(bytes.len()));
    };
    let stride = header.stride();
    if (unpacked_size as u64) != header.points.saturating_mul(stride as u64) {
        return Err(at(Fault::Compression {
            seen: format!("{unpacked_size} bytes unpacked"),
            expected: format!("{} points of {stride} bytes", header.points),
        }));
    }
    let unpacked = lzf::unpack(packed, unpacked_size)
        .map_err(|(seen, expected)| at(Fault::Compression { seen, expected }))?;
    let count = header.points as usize;
    sink.parsed.positions.reserve(count);
    let numbers = axes.map(|(scalar, _, before)| {
        let field = header.fields.iter().scan(0, |offset, f| {
            let start = *offset;
            *offset += f.scalar.size() * f.count;
            Some((start, f.count))
        });
        let per_point = field
            .into_iter()
            .find(|&(start, _)| start == before)
            .map_or(1, |(_, count)| count);
        (
            scalar,
            &unpacked[before * count..],
            scalar.size() * per_point,
        )
    });
    for index in 0..count {
        let raw = numbers.map(|(scalar, field, step)| scalar.get(&field[index * step..], false));
        sink.point(raw).map_err(at)?;
    }
    Ok(())
}
