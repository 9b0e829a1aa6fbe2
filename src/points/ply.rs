//! Points from PLY: ascii or binary of either byte order, any properties in any order, any elements.
//!
//! Our own scans carry `view`, `profile` and `column` beside x, y and z, and in comments the frame and the views:
//! `comment acies frame machine`, `comment acies view 0 left 0.1 0.2 0.9`.

use glam::DVec3;

use super::error::{Fault, Malformed, excerpt};
use super::read::{Parsed, Unit};
use super::scalar::{AXES, Scalar, position};
use super::text::{Lines, number, words};
use super::{Frame, Origin, View};

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Binary { big_endian: bool },
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Scalar(Scalar),
    List { length: Scalar, item: Scalar },
}

#[derive(Debug)]
struct Property {
    name: String,
    kind: Kind,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
    /// Bytes of one in a binary file, where all are of one size.
    stride: Option<usize>,
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    frame: Option<Frame>,
    views: Vec<View>,
    /// Byte after the header.
    body: usize,
    /// Line after the header.
    body_line: u64,
}

fn fault(seen: &[u8], expected: &'static str) -> Fault {
    Fault::Header {
        seen: excerpt(seen),
        expected,
    }
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, Malformed> {
        let mut encoding = None;
        let mut header = Header {
            encoding: Encoding::Ascii,
            elements: Vec::new(),
            frame: None,
            views: Vec::new(),
            body: 0,
            body_line: 0,
        };
        for (at, raw) in (1..).zip(bytes.split_inclusive(|&b| b == b'\n')) {
            header.body += raw.len();
            let line = raw.trim_ascii();
            if at == 1 {
                if line != b"ply" {
                    return Err(fault(line, "`ply` on the first line").at_line(at));
                }
                continue;
            }
            if line == b"end_header" {
                header.encoding =
                    encoding.ok_or_else(|| fault(line, "a `format` line before it").at_line(at))?;
                header.body_line = at + 1;
                return Ok(header);
            }
            header
                .line(line, &mut encoding)
                .map_err(|f| f.at_line(at))?;
        }
        Err(fault(b"the end of the file", "`end_header`").at_byte(bytes.len()))
    }

    fn line(&mut self, line: &[u8], encoding: &mut Option<Encoding>) -> Result<(), Fault> {
        let parts: Vec<&[u8]> = words(line).collect();
        match parts.as_slice() {
            [] | [b"obj_info", ..] => Ok(()),
            [b"comment", b"acies", rest @ ..] => self.own_comment(line, rest),
            [b"comment", ..] => Ok(()),
            [b"format", kind, _] => {
                *encoding = Some(match *kind {
                    b"ascii" => Encoding::Ascii,
                    b"binary_little_endian" => Encoding::Binary { big_endian: false },
                    b"binary_big_endian" => Encoding::Binary { big_endian: true },
                    _ => {
                        let expected = "ascii, binary_little_endian or binary_big_endian";
                        return Err(fault(line, expected));
                    }
                });
                Ok(())
            }
            [b"element", name, count] => {
                let count = std::str::from_utf8(count).ok().and_then(|c| c.parse().ok());
                let count = count.ok_or_else(|| fault(line, "a number of elements"))?;
                let is_vertex = |e: &Element| e.name == "vertex";
                if *name == b"vertex" && self.elements.iter().any(is_vertex) {
                    return Err(fault(line, "the element vertex once"));
                }
                self.elements.push(Element {
                    name: String::from_utf8_lossy(name).into_owned(),
                    count,
                    properties: Vec::new(),
                    stride: Some(0),
                });
                Ok(())
            }
            [b"property", rest @ ..] => self.property(line, rest),
            _ => Err(fault(
                line,
                "format, comment, obj_info, element, property or end_header",
            )),
        }
    }

    fn property(&mut self, line: &[u8], rest: &[&[u8]]) -> Result<(), Fault> {
        let unknown = || fault(line, "a type of PLY (char to double, int8 to float64)");
        let (kind, name) = match rest {
            [b"list", length, item, name] => {
                let length = scalar(length).ok_or_else(unknown)?;
                let item = scalar(item).ok_or_else(unknown)?;
                if length.is_float() {
                    return Err(fault(line, "a whole number as length of a list"));
                }
                (Kind::List { length, item }, name)
            }
            [kind, name] => (Kind::Scalar(scalar(kind).ok_or_else(unknown)?), name),
            _ => return Err(fault(line, "`property TYPE NAME`")),
        };
        let Some(element) = self.elements.last_mut() else {
            return Err(fault(line, "an `element` line before it"));
        };
        element.stride = match (element.stride, kind) {
            (Some(stride), Kind::Scalar(scalar)) => Some(stride + scalar.size()),
            _ => None,
        };
        element.properties.push(Property {
            name: String::from_utf8_lossy(name).into_owned(),
            kind,
        });
        Ok(())
    }

    fn own_comment(&mut self, line: &[u8], rest: &[&[u8]]) -> Result<(), Fault> {
        match rest {
            [b"frame", name] => {
                self.frame = Some(match *name {
                    b"sensor" => Frame::Sensor,
                    b"machine" => Frame::Machine,
                    b"part" => Frame::Part,
                    _ => return Err(fault(line, "sensor, machine or part")),
                });
                Ok(())
            }
            [b"view", index, device, direction @ ..] => {
                let expected = "the views in order: index, device, unit vector towards the sensor";
                let components: Vec<f64> = direction.iter().filter_map(|w| number(w)).collect();
                let (&[x, y, z], 3) = (components.as_slice(), direction.len()) else {
                    return Err(fault(line, expected));
                };
                let towards_sensor = DVec3::new(x, y, z);
                if index != &self.views.len().to_string().as_bytes()
                    || !towards_sensor.is_normalized()
                {
                    return Err(fault(line, expected));
                }
                let device = unescape(device).ok_or_else(|| fault(line, expected))?;
                self.views.push(View {
                    device,
                    towards_sensor,
                });
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

fn scalar(name: &[u8]) -> Option<Scalar> {
    Some(match name {
        b"char" | b"int8" => Scalar::I8,
        b"uchar" | b"uint8" => Scalar::U8,
        b"short" | b"int16" => Scalar::I16,
        b"ushort" | b"uint16" => Scalar::U16,
        b"int" | b"int32" => Scalar::I32,
        b"uint" | b"uint32" => Scalar::U32,
        b"float" | b"float32" => Scalar::F32,
        b"double" | b"float64" => Scalar::F64,
        _ => return None,
    })
}

/// A device's name as one word: everything but printable ASCII, and `%` and `-`, as `%xx`; no name at all as `-`.
pub(crate) fn escape(name: &str) -> String {
    if name.is_empty() {
        return "-".into();
    }
    let mut word = String::with_capacity(name.len());
    for byte in name.bytes() {
        if byte.is_ascii_graphic() && byte != b'%' && (byte != b'-' || name.len() > 1) {
            word.push(char::from(byte));
        } else {
            word.push_str(&format!("%{byte:02x}"));
        }
    }
    word
}

fn unescape(word: &[u8]) -> Option<String> {
    if word == b"-" {
        return Some(String::new());
    }
    let mut name = Vec::with_capacity(word.len());
    let mut rest = word;
    while let Some((&first, tail)) = rest.split_first() {
        if first == b'%' {
            let (digits, tail) = tail.split_at_checked(2)?;
            let digits = std::str::from_utf8(digits).ok()?;
            name.push(u8::from_str_radix(digits, 16).ok()?);
            rest = tail;
        } else {
            name.push(first);
            rest = tail;
        }
    }
    String::from_utf8(name).ok()
}

/// Which properties of a vertex we read: x, y, z, then view, profile, column where the lattice is there.
struct Wanted {
    axes: [usize; 3],
    lattice: Option<[usize; 3]>,
}

impl Wanted {
    fn of(vertex: &Element, views: usize, findings: &mut Vec<String>) -> Result<Self, Fault> {
        let mut axes = [0; 3];
        for (slot, name) in axes.iter_mut().zip(AXES) {
            let mut named = vertex
                .properties
                .iter()
                .enumerate()
                .filter(|(_, p)| p.name == name);
            let Some((index, property)) = named.next() else {
                return Err(Fault::NoCoordinate { missing: name });
            };
            if named.next().is_some() || !matches!(property.kind, Kind::Scalar(_)) {
                return Err(fault(name.as_bytes(), "one number of this name"));
            }
            *slot = index;
        }
        let lattice = ["view", "profile", "column"].map(|name| {
            let whole = |p: &Property| matches!(p.kind, Kind::Scalar(s) if !s.is_float());
            vertex
                .properties
                .iter()
                .position(|p| p.name == name && whole(p))
        });
        let lattice = match lattice {
            [None, None, None] => None,
            [Some(view), Some(profile), Some(column)] if views > 0 => Some([view, profile, column]),
            [Some(_), Some(_), Some(_)] => {
                findings.push("view, profile and column are not used: no `comment acies view` says where the sensor stood".into());
                None
            }
            _ => {
                findings.push("the lattice is not used: not all of view, profile and column are whole numbers".into());
                None
            }
        };
        Ok(Self { axes, lattice })
    }
}

/// The vertices of a PLY file.
///
/// # Errors
/// With line (header, ascii) or byte (binary) of the first fault.
pub(crate) fn parse(bytes: &[u8], unit: Unit) -> Result<Parsed, Malformed> {
    let header = Header::parse(bytes)?;
    let mut parsed = Parsed::default();
    let vertex = header.elements.iter().find(|e| e.name == "vertex");
    let header_end = |f: Fault| f.at_line(header.body_line - 1);
    let vertex = vertex
        .ok_or_else(|| header_end(fault(b"end_header", "an `element vertex` line before it")))?;
    let wanted =
        Wanted::of(vertex, header.views.len(), &mut parsed.findings).map_err(header_end)?;
    let mut unit = unit;
    if header.frame.is_some() && unit != Unit::Millimetre {
        parsed.findings.push(format!(
            "a scan of Acies is in mm, the unit {unit} was not applied"
        ));
        unit = Unit::Millimetre;
    }
    let mut sink = Sink {
        parsed: &mut parsed,
        wanted,
        unit,
        views: header.views.len(),
    };
    match header.encoding {
        Encoding::Ascii => read_ascii(&header, bytes, &mut sink)?,
        Encoding::Binary { big_endian } => read_binary(&header, bytes, big_endian, &mut sink)?,
    }
    parsed.frame = header.frame;
    if !parsed.origins.is_empty() {
        parsed.views = header.views;
    }
    Ok(parsed)
}

/// Takes the wanted numbers of one vertex after the other.
struct Sink<'a> {
    parsed: &'a mut Parsed,
    wanted: Wanted,
    unit: Unit,
    views: usize,
}

impl Sink<'_> {
    fn reserve(&mut self, points: u64, smallest: usize, bytes: usize) {
        let points = points.min((bytes / smallest.max(1)) as u64) as usize;
        self.parsed.positions.reserve(points);
        if self.wanted.lattice.is_some() {
            self.parsed.origins.reserve(points);
        }
    }

    #[inline]
    fn vertex(&mut self, value: impl Fn(usize) -> f64) -> Result<(), Fault> {
        let point = position(self.wanted.axes.map(&value), self.unit)?;
        if let Some(lattice) = self.wanted.lattice {
            self.parsed
                .origins
                .push(origin(lattice.map(&value), self.views)?);
        }
        self.parsed.positions.push(point);
        Ok(())
    }
}

fn origin([view, profile, column]: [f64; 3], views: usize) -> Result<Origin, Fault> {
    let whole = |field, value: f64, limit: u32| {
        if value >= 0.0 && value <= f64::from(limit) && value.fract() == 0.0 {
            Ok(value as u32)
        } else {
            Err(Fault::LatticeValue {
                field,
                seen: value.to_string(),
                limit,
            })
        }
    };
    let view = whole("view", view, u32::from(u16::MAX))?;
    if view as usize >= views {
        return Err(Fault::UnknownView {
            seen: u64::from(view),
            views,
        });
    }
    Ok(Origin {
        view: view as u16,
        profile: whole("profile", profile, u32::MAX)?,
        column: whole("column", column, u32::from(u16::MAX))? as u16,
    })
}

fn element_truncated(name: &str, seen: u64, expected: u64) -> Fault {
    Fault::Truncated {
        what: if name == "vertex" {
            "points"
        } else {
            "elements beside the points"
        },
        seen,
        expected,
    }
}

fn read_ascii(header: &Header, bytes: &[u8], sink: &mut Sink) -> Result<(), Malformed> {
    let body = &bytes[header.body..];
    let mut lines = Lines::new(body, header.body_line);
    let mut values = Vec::new();
    for element in header.elements.iter().filter(|e| !e.properties.is_empty()) {
        let is_vertex = element.name == "vertex";
        if is_vertex {
            sink.reserve(element.count, 2 * element.properties.len(), body.len());
        }
        for index in 0..element.count {
            let Some((at, line)) = lines.find(|(_, line)| !line.is_empty()) else {
                let fault = element_truncated(&element.name, index, element.count);
                return Err(fault.at_line(lines.number()));
            };
            if is_vertex {
                ascii_row(element, line, &mut values).map_err(|f| f.at_line(at))?;
                sink.vertex(|i| values[i]).map_err(|f| f.at_line(at))?;
            }
        }
    }
    if let Some((at, _)) = lines.find(|(_, line)| !line.is_empty()) {
        let note = format!("line {at} and what follows it belong to no element and were not read");
        sink.parsed.findings.push(note);
    }
    Ok(())
}

/// The numbers of one line, one for each property; a list counts as its length.
fn ascii_row(element: &Element, line: &[u8], values: &mut Vec<f64>) -> Result<(), Fault> {
    values.clear();
    let mut columns = words(line);
    for property in &element.properties {
        let field = match property.name.as_str() {
            "x" => AXES[0],
            "y" => AXES[1],
            "z" => AXES[2],
            _ => "a property",
        };
        let Some(word) = columns.next() else {
            return Err(Fault::Columns {
                seen: words(line).count(),
                expected: element.properties.len(),
            });
        };
        let value = number(word).ok_or_else(|| Fault::NotANumber {
            field,
            seen: excerpt(word),
        })?;
        values.push(value);
        if let Kind::List { .. } = property.kind {
            // A lying length ends with the line.
            let mut left = value;
            while left >= 1.0 && columns.next().is_some() {
                left -= 1.0;
            }
        }
    }
    if columns.next().is_some() {
        return Err(Fault::Columns {
            seen: words(line).count(),
            expected: element.properties.len(),
        });
    }
    Ok(())
}

fn read_binary(
    header: &Header,
    bytes: &[u8],
    big_endian: bool,
    sink: &mut Sink,
) -> Result<(), Malformed> {
    let mut at = header.body;
    // An element without properties takes no bytes, however many there are said to be.
    for element in header.elements.iter().filter(|e| !e.properties.is_empty()) {
        at = match element.stride {
            Some(stride) => read_fixed(element, stride, (bytes, at, big_endian), sink)?,
            None => read_varying(element, (bytes, at, big_endian), sink)?,
        };
    }
    if at < bytes.len() {
        let extra = bytes.len() - at;
        let note = format!("{extra} bytes after the last element were not read");
        sink.parsed.findings.push(note);
    }
    Ok(())
}

/// Reads elements that all have one size, and returns the byte after them.
fn read_fixed(
    element: &Element,
    stride: usize,
    (bytes, at, big_endian): (&[u8], usize, bool),
    sink: &mut Sink,
) -> Result<usize, Malformed> {
    let body = &bytes[at..];
    let present = (body.len() / stride) as u64;
    if present < element.count {
        return Err(element_truncated(&element.name, present, element.count).at_byte(bytes.len()));
    }
    // No more than `present`, so it fits.
    let count = element.count as usize;
    if element.name == "vertex" {
        sink.reserve(element.count, stride, body.len());
        let mut offset = 0;
        let slots: Vec<(Scalar, usize)> = element
            .properties
            .iter()
            .filter_map(|property| match property.kind {
                Kind::Scalar(scalar) => {
                    offset += scalar.size();
                    Some((scalar, offset - scalar.size()))
                }
                Kind::List { .. } => None,
            })
            .collect();
        for (index, row) in body.chunks_exact(stride).take(count).enumerate() {
            sink.vertex(|i| slots[i].0.get(&row[slots[i].1..], big_endian))
                .map_err(|f| f.at_byte(at + index * stride))?;
        }
    }
    Ok(at + count * stride)
}

/// Reads elements with lists, and returns the byte after them.
fn read_varying(
    element: &Element,
    (bytes, start, big_endian): (&[u8], usize, bool),
    sink: &mut Sink,
) -> Result<usize, Malformed> {
    let is_vertex = element.name == "vertex";
    let mut at = start;
    let mut values = vec![0.0; element.properties.len()];
    for index in 0..element.count {
        let row = at;
        for (value, property) in values.iter_mut().zip(&element.properties) {
            let truncated =
                || element_truncated(&element.name, index, element.count).at_byte(bytes.len());
            let first = match property.kind {
                Kind::Scalar(scalar) => scalar,
                Kind::List { length, .. } => length,
            };
            let raw = bytes.get(at..at + first.size()).ok_or_else(truncated)?;
            *value = first.get(raw, big_endian);
            at += first.size();
            if let Kind::List { item, .. } = property.kind {
                // A negative length counts as none.
                let length = (*value as usize).saturating_mul(item.size());
                if bytes.len() - at < length {
                    return Err(truncated());
                }
                at += length;
            }
        }
        if is_vertex {
            sink.vertex(|i| values[i]).map_err(|f| f.at_byte(row))?;
        }
    }
    Ok(at)
}
