//! Points to a file: PLY with chosen columns, XYZ, and our own scans, which come back bit for bit.
//!
//! Every file is written beside its place and moved there when it is complete and on the disk.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use glam::DVec3;

use super::error::PointsError;
use super::ply::escape;
use super::{Frame, PointCloud};

/// How the numbers of a PLY file stand in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Encoding {
    /// As text that reads back to the same bits.
    Ascii,
    /// Least significant byte first.
    #[default]
    LittleEndian,
    /// Most significant byte first.
    BigEndian,
}

/// A named column of N numbers beside the coordinates.
#[derive(Debug, Clone, Copy)]
pub enum Column<'a> {
    /// PLY `uchar`.
    U8(&'a str, &'a [u8]),
    /// PLY `ushort`.
    U16(&'a str, &'a [u16]),
    /// PLY `uint`.
    U32(&'a str, &'a [u32]),
    /// PLY `int`.
    I32(&'a str, &'a [i32]),
    /// PLY `float`.
    F32(&'a str, &'a [f32]),
    /// PLY `double`.
    F64(&'a str, &'a [f64]),
}

impl Column<'_> {
    fn name(&self) -> &str {
        match self {
            Column::U8(name, _)
            | Column::U16(name, _)
            | Column::U32(name, _)
            | Column::I32(name, _)
            | Column::F32(name, _)
            | Column::F64(name, _) => name,
        }
    }

    fn len(&self) -> usize {
        match self {
            Column::U8(_, values) => values.len(),
            Column::U16(_, values) => values.len(),
            Column::U32(_, values) => values.len(),
            Column::I32(_, values) => values.len(),
            Column::F32(_, values) => values.len(),
            Column::F64(_, values) => values.len(),
        }
    }

    fn ply_type(&self) -> &'static str {
        match self {
            Column::U8(..) => "uchar",
            Column::U16(..) => "ushort",
            Column::U32(..) => "uint",
            Column::I32(..) => "int",
            Column::F32(..) => "float",
            Column::F64(..) => "double",
        }
    }

    #[inline]
    fn put(&self, index: usize, encoding: Encoding, out: &mut Vec<u8>) {
        macro_rules! put {
            ($value:expr) => {
                match encoding {
                    Encoding::LittleEndian => out.extend_from_slice(&$value.to_le_bytes()),
                    Encoding::BigEndian => out.extend_from_slice(&$value.to_be_bytes()),
                    Encoding::Ascii => put_text($value, out),
                }
            };
        }
        match self {
            Column::U8(_, values) => put!(values[index]),
            Column::U16(_, values) => put!(values[index]),
            Column::U32(_, values) => put!(values[index]),
            Column::I32(_, values) => put!(values[index]),
            Column::F32(_, values) => put!(values[index]),
            Column::F64(_, values) => put!(values[index]),
        }
    }
}

/// The shortest text that reads back to the same bits, after a blank.
///
/// Debug rather than Display, which has no exponent and writes 300 zeros for 1e-300.
fn put_text(value: impl std::fmt::Debug, out: &mut Vec<u8>) {
    // Writing to memory cannot fail.
    let _ = write!(out, " {value:?}");
}

/// Refuses columns that a reader could not tell apart or that do not fit `points`.
fn check(points: usize, columns: &[Column]) -> Result<(), PointsError> {
    for (index, column) in columns.iter().enumerate() {
        let name = column.name();
        let is_word = !name.is_empty()
            && name
                .bytes()
                .all(|b| b.is_ascii_graphic() && b != b',' && b != b'#');
        let is_taken =
            ["x", "y", "z"].contains(&name) || columns[..index].iter().any(|c| c.name() == name);
        if !is_word || is_taken {
            return Err(PointsError::ColumnName { name: name.into() });
        }
        if column.len() != points {
            return Err(PointsError::ColumnLength {
                name: name.into(),
                seen: column.len(),
                expected: points,
            });
        }
    }
    Ok(())
}

/// The bytes of a PLY file: N vertices, `x y z` double, then `columns` in their order.
///
/// # Errors
/// [`PointsError::ColumnName`], [`PointsError::ColumnLength`].
pub fn ply_bytes(
    positions: &[DVec3],
    columns: &[Column],
    encoding: Encoding,
) -> Result<Vec<u8>, PointsError> {
    ply_with_comments(positions, columns, encoding, &[])
}

fn ply_with_comments(
    positions: &[DVec3],
    columns: &[Column],
    encoding: Encoding,
    comments: &[String],
) -> Result<Vec<u8>, PointsError> {
    check(positions.len(), columns)?;
    let format = match encoding {
        Encoding::Ascii => "ascii",
        Encoding::LittleEndian => "binary_little_endian",
        Encoding::BigEndian => "binary_big_endian",
    };
    let mut header = format!("ply\nformat {format} 1.0\n");
    for comment in comments {
        header += &format!("comment {comment}\n");
    }
    header += &format!("element vertex {}\n", positions.len());
    header += "property double x\nproperty double y\nproperty double z\n";
    for column in columns {
        header += &format!("property {} {}\n", column.ply_type(), column.name());
    }
    header += "end_header\n";
    let mut out = header.into_bytes();
    out.reserve(positions.len() * (24 + 8 * columns.len()));
    for (index, p) in positions.iter().enumerate() {
        match encoding {
            Encoding::LittleEndian => p
                .to_array()
                .iter()
                .for_each(|v| out.extend_from_slice(&v.to_le_bytes())),
            Encoding::BigEndian => p
                .to_array()
                .iter()
                .for_each(|v| out.extend_from_slice(&v.to_be_bytes())),
            Encoding::Ascii => put_coordinates(*p, &mut out),
        }
        for column in columns {
            column.put(index, encoding, &mut out);
        }
        if encoding == Encoding::Ascii {
            out.push(b'\n');
        }
    }
    Ok(out)
}

fn put_coordinates(p: DVec3, out: &mut Vec<u8>) {
    // Writing to memory cannot fail.
    let _ = write!(out, "{:?} {:?} {:?}", p.x, p.y, p.z);
}

/// The bytes of a text: where there are `columns`, first a line of names; then one line a point, parted by blanks.
///
/// # Errors
/// [`PointsError::ColumnName`], [`PointsError::ColumnLength`].
pub fn xyz_bytes(positions: &[DVec3], columns: &[Column]) -> Result<Vec<u8>, PointsError> {
    check(positions.len(), columns)?;
    let mut out = Vec::with_capacity(positions.len() * 40);
    if !columns.is_empty() {
        out.extend_from_slice(b"x y z");
        for column in columns {
            out.push(b' ');
            out.extend_from_slice(column.name().as_bytes());
        }
        out.push(b'\n');
    }
    for (index, p) in positions.iter().enumerate() {
        put_coordinates(*p, &mut out);
        for column in columns {
            column.put(index, Encoding::Ascii, &mut out);
        }
        out.push(b'\n');
    }
    Ok(out)
}

/// The bytes of a scan of ours: PLY with frame and views in comments, `view` ushort, `profile` uint, `column` ushort.
///
/// [`super::read()`] gives back the same cloud, bit for bit. A cloud without origins loses its views.
///
/// # Errors
/// [`PointsError::Inconsistent`] where origins or views do not fit.
pub fn scan_bytes(cloud: &PointCloud, encoding: Encoding) -> Result<Vec<u8>, PointsError> {
    cloud.check_lattice()?;
    let frame = match cloud.frame {
        Frame::Sensor => "sensor",
        Frame::Machine => "machine",
        Frame::Part => "part",
    };
    let mut comments = vec![format!("acies frame {frame}")];
    if cloud.origins.is_empty() {
        return ply_with_comments(&cloud.positions, &[], encoding, &comments);
    }
    for (index, view) in cloud.views.iter().enumerate() {
        let d = view.towards_sensor;
        comments.push(format!(
            "acies view {index} {} {} {} {}",
            escape(&view.device),
            d.x,
            d.y,
            d.z
        ));
    }
    let view: Vec<u16> = cloud.origins.iter().map(|o| o.view).collect();
    let profile: Vec<u32> = cloud.origins.iter().map(|o| o.profile).collect();
    let column: Vec<u16> = cloud.origins.iter().map(|o| o.column).collect();
    let columns = [
        Column::U16("view", &view),
        Column::U32("profile", &profile),
        Column::U16("column", &column),
    ];
    ply_with_comments(&cloud.positions, &columns, encoding, &comments)
}

/// Writes what [`ply_bytes`] gives.
///
/// # Errors
/// As [`ply_bytes`], and [`PointsError::Write`].
pub fn write_ply(
    path: &Path,
    positions: &[DVec3],
    columns: &[Column],
    encoding: Encoding,
) -> Result<(), PointsError> {
    write_atomically(path, &ply_bytes(positions, columns, encoding)?)
}

/// Writes what [`xyz_bytes`] gives.
///
/// # Errors
/// As [`xyz_bytes`], and [`PointsError::Write`].
pub fn write_xyz(path: &Path, positions: &[DVec3], columns: &[Column]) -> Result<(), PointsError> {
    write_atomically(path, &xyz_bytes(positions, columns)?)
}

/// Writes what [`scan_bytes`] gives, least significant byte first.
///
/// # Errors
/// As [`scan_bytes`], and [`PointsError::Write`].
pub fn write_scan(path: &Path, cloud: &PointCloud) -> Result<(), PointsError> {
    write_atomically(path, &scan_bytes(cloud, Encoding::LittleEndian)?)
}

/// Puts `bytes` at `path`: whole, on the disk, or not at all.
///
/// A `path` that is there and no regular file (a pipe, a terminal) is written to as it is.
///
/// # Errors
/// [`PointsError::Write`]; then `path` is as it was.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), PointsError> {
    let place = || -> io::Result<()> {
        if fs::metadata(path).is_ok_and(|m| !m.is_file()) {
            return fs::OpenOptions::new()
                .write(true)
                .open(path)?
                .write_all(bytes);
        }
        let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
        let mut beside = OsString::from(".");
        beside.push(name);
        beside.push(format!(".{}.part", std::process::id()));
        let beside = path.with_file_name(beside);
        let result = write_and_move(&beside, path, bytes);
        if result.is_err() {
            // The first error is the one to report.
            let _ = fs::remove_file(&beside);
        }
        result
    };
    place().map_err(|source| PointsError::Write {
        path: path.to_path_buf(),
        source,
    })
}

fn write_and_move(beside: &Path, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(beside)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(beside, path)?;
    // The name must be on the disk too; a file system that cannot sync a folder has said all it can.
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    if let Ok(folder) = File::open(folder.unwrap_or(Path::new("."))) {
        let _ = folder.sync_all();
    }
    Ok(())
}
