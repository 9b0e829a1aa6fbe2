//! Files of points: what is read, what is refused and how it is said, and that what we write comes back.

use std::fs;
use std::path::{Path, PathBuf};

use acies::points::read::UnknownUnit;
use acies::points::write::{ply_bytes, scan_bytes, write_atomically, xyz_bytes};
use acies::points::{
    Column, Encoding, Format, Frame, Origin, PointCloud, PointsError, Read, Unit, View, parse,
    read, write_ply, write_scan, write_xyz,
};
use glam::DVec3;
use proptest::prelude::*;

fn parsed(name: &str, bytes: impl AsRef<[u8]>) -> Result<Read, PointsError> {
    parse(Path::new(name), bytes.as_ref(), Unit::Millimetre)
}

fn positions(name: &str, bytes: impl AsRef<[u8]>) -> Vec<[f64; 3]> {
    let read = parsed(name, bytes).unwrap_or_else(|e| panic!("{e}"));
    read.cloud.positions.iter().map(DVec3::to_array).collect()
}

fn refusal(name: &str, bytes: impl AsRef<[u8]>) -> String {
    match parsed(name, bytes) {
        Ok(read) => panic!("{name} was read as {} points", read.cloud.len()),
        Err(error) => error.to_string(),
    }
}

fn scratch(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("points");
    fs::create_dir_all(&folder).unwrap();
    folder.join(name)
}

const TWO: [[f64; 3]; 2] = [[1.0, 2.0, 3.0], [-4.5, 0.25, 1e-3]];

#[test]
fn text_is_read_in_every_dialect() {
    let dialects = [
        ("blanks.xyz", "1 2 3\n-4.5 0.25 1e-3\n"),
        ("no-end.xyz", "1 2 3\n-4.5 0.25 1e-3"),
        (
            "windows.txt",
            "\u{feff}1.0\t2.0\t3.0\r\n-4.5\t.25\t0.001\r\n",
        ),
        ("comma.csv", "x,y,z\n1,2,3\n-4.5,0.25,0.001\n"),
        ("comma-blank.csv", "1, 2, 3\n-4.5, 0.25, 0.001\n"),
        ("semicolon.csv", "1;2;3;\n-4.5;0.25;0.001;\n"),
        (
            "units.csv",
            "\"X (mm)\";\"Y (mm)\";\"Z (mm)\"\n1;2;3\n-4.5;0.25;0.001\n",
        ),
        (
            "tabs.txt",
            "label\tX [mm]\tY [mm]\tZ [mm]\nfirst one\t1\t2\t3\nsecond\t-4.5\t0.25\t0.001\n",
        ),
        ("order.csv", "time,z,y,x\n0,3,2,1\n1,0.001,0.25,-4.5\n"),
        (
            "comments.xyz",
            "# made by hand\n//X Y Z\n\n% note\n1 2 3\n# more\n-4.5 0.25 0.001\n\u{1a}",
        ),
        (
            "colours.pts",
            "2\n1 2 3 -100 255 0 0\n-4.5 0.25 0.001 7 0 0 0\n",
        ),
        ("sections.pts", "1\n1 2 3\n1\n-4.5 0.25 0.001\n"),
        (
            "normals.xyz",
            "x y z x_normal y_normal z_normal\n1 2 3 0 0 1\n-4.5 0.25 0.001 0 0 1\n",
        ),
    ];
    for (name, text) in dialects {
        let read = parsed(name, text).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(read.format, Format::Text, "{name}");
        assert_eq!(positions(name, text), TWO, "{name}");
        assert_eq!(read.findings, [""; 0], "{name}");
    }
}

#[test]
fn text_that_is_not_points_is_refused_with_its_line() {
    let comma = "export with points and with semicolons, tabs or blanks between columns";
    let cases = [
        ("a.xyz", "1 2 3\n4 five 6\n", "a.xyz: line 2: y is `five`, expected a number; correct or remove the line".into()),
        ("a.xyz", "1 2 3\n4 5\n", "a.xyz: line 2: 2 columns, expected at least 3 (x y z); correct or remove the line".into()),
        ("a.xyz", "1 2\n", "a.xyz: line 1: 2 columns, expected at least 3 (x y z); correct or remove the line".into()),
        (
            "a.csv",
            "x,y,z\n1,2,3\n4,5,6,7\n",
            "a.csv: line 3: 4 columns, expected 3 as declared or in the lines before; correct or remove the line".into(),
        ),
        (
            "a.csv",
            "1,2,3\n\n4,nan,6\n",
            "a.csv: line 3: y is NaN, expected a finite number; leave out points without a measurement when exporting".into(),
        ),
        (
            "a.csv",
            "1,2,3\n4,5,-1e999\n",
            "a.csv: line 2: z is -inf, expected a finite number; leave out points without a measurement when exporting".into(),
        ),
        (
            "a.csv",
            "1,2,3\n-2e12,5,6\n",
            "a.csv: line 2: x is -2e12 mm, expected less than 1e12 mm either way; check the unit and the byte order".into(),
        ),
        ("a.csv", "1,5;2,5;3,5\n", format!("a.csv: line 1: `1,5;2,5;3,5` has decimal commas, expected decimal points; {comma}")),
        ("a.csv", "x;y;z\n1;2;3\n1;2;3,5e1\n", format!("a.csv: line 3: `1;2;3,5e1` has decimal commas, expected decimal points; {comma}")),
        ("a.xyz", "1,5 -2,5 3,5\n", format!("a.xyz: line 1: `1,5 -2,5 3,5` has decimal commas, expected decimal points; {comma}")),
        ("a.xyz", "1,5, 2,5, 3,5\n", format!("a.xyz: line 1: `1,5, 2,5, 3,5` has decimal commas, expected decimal points; {comma}")),
        (
            "a.csv",
            "\na,b,c\n1,2,3\n",
            "a.csv: line 2: header `a,b,c` does not name each of x, y and z once, expected it to; name the columns or remove the line".into(),
        ),
        (
            "a.csv",
            "x,y,z,x\n1,2,3,4\n",
            "a.csv: line 1: header `x,y,z,x` does not name each of x, y and z once, expected it to; name the columns or remove the line".into(),
        ),
        ("a.pts", "3\n1 2 3\n4 5 6\n", "a.pts: line 3: the file ends after 2 of 3 points; transfer or export it again".into()),
        (
            "a.pts",
            "1\n1 2 3\n4 5 6\n",
            "a.pts: line 3: `2 points`, expected as many as the count at the beginning says; correct or remove the line".into(),
        ),
        ("a.xyz", "", "a.xyz: byte 0: the file is empty, expected points; check that it was written to its end".into()),
        ("a.xyz", "# nothing\n", "a.xyz: byte 10: the file holds no point, expected at least one; check what was exported".into()),
        ("a.csv", "x,y,z\n", "a.csv: byte 6: the file holds no point, expected at least one; check what was exported".into()),
    ];
    for (name, text, expected) in cases {
        assert_eq!(refusal(name, text), expected);
    }
}

#[test]
fn a_header_in_another_unit_is_a_finding() {
    let read = parsed("a.csv", "X(m),Y(m),Z(m)\n1,2,3\n").unwrap();
    assert_eq!(
        read.findings,
        ["the header gives the coordinates in m, they were read in mm"]
    );
    let read = parse(Path::new("a.csv"), b"X(m),Y(m),Z(m)\n1,2,3\n", Unit::Metre).unwrap();
    assert_eq!(read.cloud.positions, [DVec3::new(1000.0, 2000.0, 3000.0)]);
    assert_eq!(read.findings, [""; 0]);
}

#[test]
fn units_are_known_by_their_words() {
    // Lengths by definition: one inch is 25.4 mm exactly.
    for (word, mm) in [
        ("um", 0.001),
        ("mm", 1.0),
        ("cm", 10.0),
        ("m", 1000.0),
        ("inch", 25.4),
    ] {
        let unit: Unit = word.parse().unwrap();
        assert_eq!(unit.to_mm(1.0), mm);
        assert_eq!(unit.to_string(), word);
    }
    let unknown: Result<Unit, UnknownUnit> = "furlong".parse();
    assert_eq!(
        unknown.unwrap_err().to_string(),
        "unit `furlong`: not known, expected um, mm, cm, m or inch; name one of these"
    );
}

#[test]
fn other_kinds_of_file_are_named() {
    let formats = "expected PLY, PCD, STL, OBJ or a text of x y z";
    let cases: [(&[u8], &str); 5] = [
        (
            b"ISO-10303-21;\nHEADER;",
            "this is a STEP file, {}; give it as the nominal part, not as the scan",
        ),
        (
            b"\x1f\x8b\x08\0",
            "this is gzip-compressed, {}; unpack it first",
        ),
        (b"ASTM-E57\0\0", "this is an E57 file, {}; export as PLY"),
        (
            b"\xff\xfe1\x00 \x00",
            "this is UTF-16 text, {}; save it as UTF-8",
        ),
        (
            b"\x89PNG\r\n\x1a\n\0\0",
            "the file begins with `\u{fffd}PNG\u{fffd}\u{fffd}\u{fffd}\u{fffd}\u{fffd}\u{fffd}`, {}; convert it to one of these",
        ),
    ];
    for (bytes, expected) in cases {
        let expected = format!("scan.dat: byte 0: {}", expected.replace("{}", formats));
        assert_eq!(refusal("scan.dat", bytes), expected);
    }
}

/// A PLY file with properties of every type in an unusual order, other elements and lists before and after.
fn awkward_ply(big_endian: bool) -> Vec<u8> {
    let order = if big_endian { "big" } else { "little" };
    let mut bytes = format!(
        "ply\r\nformat binary_{order}_endian 1.0\r\ncomment by hand\r\nobj_info x\r\n\
         element face 2\r\nproperty list uchar int vertex_indices\r\n\
         element nothing 18446744073709551615\r\n\
         element vertex 2\r\nproperty uchar red\r\nproperty double z\r\nproperty float x\r\nproperty short y\r\nproperty int8 q\r\n\
         element edge 1\r\nproperty int32 a\r\nend_header\r\n"
    )
    .into_bytes();
    macro_rules! put {
        ($($value:expr),*) => { $( if big_endian { bytes.extend($value.to_be_bytes()) } else { bytes.extend($value.to_le_bytes()) } )* };
    }
    put!(3u8, 0i32, 1i32, 2i32, 1u8, 7i32);
    put!(9u8, 3.0f64, 1.0f32, 2i16, -1i8);
    put!(9u8, 0.001f64, -4.5f32, 0i16, -1i8);
    put!(5i32);
    bytes
}

#[test]
fn ply_is_read_whatever_its_properties() {
    let expected = [[1.0, 2.0, 3.0], [-4.5, 0.0, 0.001]];
    for big_endian in [false, true] {
        let read = parsed("a.ply", awkward_ply(big_endian)).unwrap();
        assert_eq!(read.format, Format::Ply);
        assert_eq!(positions("a.ply", awkward_ply(big_endian)), expected);
        assert_eq!(read.findings, [""; 0]);
        assert_eq!(read.cloud.frame, Frame::Machine);
    }
    let ascii = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 2\nproperty int id\n\
        property float z\nproperty float x\nproperty list uchar int neighbours\nproperty float y\nend_header\n3 0 1 2\n\n0 3 1 2 8 9 2\n1 0.001 -4.5 0 0.25\n";
    assert_eq!(positions("a.ply", ascii), TWO);
    let varying = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty list uchar uchar l\nproperty char x\nproperty char y\nproperty char z\nend_header\n\x02\x09\x09\x01\x02\x03\x00\x04\x05\x06";
    assert_eq!(positions("a", varying), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
}

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n";

#[test]
fn ply_that_breaks_its_rules_is_refused_with_line_or_byte() {
    let again = "in the header, expected";
    let replaced = |from: &str, to: &str| format!("{}1 2 3\n4 5 6\n", PLY.replace(from, to));
    let cases = [
        (format!("{PLY}1 2 3\n"), "line 8: the file ends after 1 of 2 points; transfer or export it again".into()),
        (format!("{PLY}1 2 3\n4 5\n"), "line 9: 2 columns, expected 3 as declared or in the lines before; correct or remove the line".into()),
        (format!("{PLY}1 2 3\n4 5 6 7\n"), "line 9: 4 columns, expected 3 as declared or in the lines before; correct or remove the line".into()),
        (format!("{PLY}1 2 3\n4 5 z\n"), "line 9: z is `z`, expected a number; correct or remove the line".into()),
        (
            format!("{PLY}1 2 3\n4 NaN 6\n"),
            "line 9: y is NaN, expected a finite number; leave out points without a measurement when exporting".into(),
        ),
        (replaced("ascii", "utf8"), format!("line 2: `format utf8 1.0` {again} ascii, binary_little_endian or binary_big_endian; export the file again")),
        (replaced("format ascii 1.0\n", ""), format!("line 6: `end_header` {again} a `format` line before it; export the file again")),
        (replaced("vertex 2", "vertex many"), format!("line 3: `element vertex many` {again} a number of elements; export the file again")),
        (replaced("vertex 2", "vortex 2"), format!("line 7: `end_header` {again} an `element vertex` line before it; export the file again")),
        (replaced("element vertex 2", "element vertex 2\nelement vertex 2"), format!("line 4: `element vertex 2` {again} the element vertex once; export the file again")),
        (replaced("element vertex 2\n", ""), format!("line 3: `property float x` {again} an `element` line before it; export the file again")),
        (replaced("float y", "half y"), format!("line 5: `property half y` {again} a type of PLY (char to double, int8 to float64); export the file again")),
        (replaced("float y", "y"), format!("line 5: `property y` {again} `property TYPE NAME`; export the file again")),
        (replaced("float y", "list float int y"), format!("line 5: `property list float int y` {again} a whole number as length of a list; export the file again")),
        (replaced("float y", "list uchar int y"), format!("line 7: `y` {again} one number of this name; export the file again")),
        (replaced("float y", "float x"), format!("line 7: `x` {again} one number of this name; export the file again")),
        (replaced("float z", "float w"), "line 7: the points have no `z`, expected x, y and z; export the coordinates".into()),
        (replaced("element", "elephant"), format!("line 3: `elephant vertex 2` {again} format, comment, obj_info, element, property or end_header; export the file again")),
        (PLY.replace("end_header\n", ""), format!("byte 89: `the end of the file` {again} `end_header`; export the file again")),
        ("plyx".into(), format!("line 1: `plyx` {again} `ply` on the first line; export the file again")),
        (PLY.replace("vertex 2", "vertex 0"), "byte 100: the file holds no point, expected at least one; check what was exported".into()),
    ];
    for (text, expected) in cases {
        assert_eq!(refusal("a.ply", text), format!("a.ply: {expected}"));
    }
    let whole = awkward_ply(false);
    assert_eq!(
        refusal("a.ply", &whole[..whole.len() - 5]),
        format!(
            "a.ply: byte {}: the file ends after 1 of 2 points; transfer or export it again",
            whole.len() - 5
        )
    );
    assert_eq!(
        refusal("a.ply", &whole[..whole.len() - 1]),
        format!(
            "a.ply: byte {}: the file ends after 0 of 1 elements beside the points; transfer or export it again",
            whole.len() - 1
        )
    );
    let mut nan = whole.clone();
    let point = whole.len() - 4 - 16;
    nan[point + 9..point + 13].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_eq!(
        refusal("a.ply", nan),
        format!(
            "a.ply: byte {point}: x is NaN, expected a finite number; leave out points without a measurement when exporting"
        )
    );
}

#[test]
fn what_follows_the_last_point_is_a_finding() {
    let read = parsed("a.ply", format!("{PLY}1 2 3\n4 5 6\n7 8 9\n")).unwrap();
    assert_eq!(
        read.findings,
        ["line 10 and what follows it belong to no element and were not read"]
    );
    let mut bytes = awkward_ply(true);
    bytes.extend([0; 3]);
    assert_eq!(
        parsed("a.ply", bytes).unwrap().findings,
        ["3 bytes after the last element were not read"]
    );
    let mut bytes = pcd(Packing::Binary, &TWO, (2, 1));
    bytes.extend([0; 3]);
    assert_eq!(
        parsed("a.pcd", bytes).unwrap().findings,
        ["3 bytes after the last point were not read"]
    );
    let mut bytes = pcd(Packing::Ascii, &TWO, (2, 1));
    bytes.extend(b"7 7 7 7 7\n");
    assert_eq!(
        parsed("a.pcd", bytes).unwrap().findings,
        ["line 14 and what follows it are beyond the last point and were not read"]
    );
    let mut bytes = binary_stl(&[TRIANGLE]);
    bytes.extend([0; 3]);
    assert_eq!(
        parsed("a.stl", bytes).unwrap().findings,
        ["3 bytes after the last facet were not read"]
    );
}

#[test]
fn a_lattice_that_does_not_hold_together_is_refused_or_a_finding() {
    let header = |comments: &str, view: &str| {
        format!(
            "ply\nformat ascii 1.0\n{comments}element vertex 1\nproperty double x\nproperty double y\nproperty double z\n\
             property {view} view\nproperty uint profile\nproperty ushort column\nend_header\n"
        )
    };
    let good = "comment acies frame part\ncomment acies view 0 left%20hand 0 0.6 0.8\n";
    let read = parsed("a.ply", header(good, "ushort") + "1 2 3 0 70000 5\n").unwrap();
    assert_eq!(read.cloud.frame, Frame::Part);
    assert_eq!(
        read.cloud.origins,
        [Origin {
            view: 0,
            column: 5,
            profile: 70000
        }]
    );
    assert_eq!(
        read.cloud.views,
        [View {
            device: "left hand".into(),
            towards_sensor: DVec3::new(0.0, 0.6, 0.8)
        }]
    );

    let unused = parsed("a.ply", header("", "ushort") + "1 2 3 0 7 5\n").unwrap();
    assert!(unused.cloud.origins.is_empty());
    assert_eq!(
        unused.findings,
        [
            "view, profile and column are not used: no `comment acies view` says where the sensor stood"
        ]
    );
    let unused = parsed("a.ply", header(good, "float") + "1 2 3 0 7 5\n").unwrap();
    assert!(unused.cloud.origins.is_empty() && unused.cloud.views.is_empty());
    assert_eq!(
        unused.findings,
        ["the lattice is not used: not all of view, profile and column are whole numbers"]
    );
    let metres = parse(
        Path::new("a.ply"),
        (header(good, "ushort") + "1 2 3 0 7 5\n").as_bytes(),
        Unit::Metre,
    )
    .unwrap();
    assert_eq!(metres.cloud.positions, [DVec3::new(1.0, 2.0, 3.0)]);
    assert_eq!(
        metres.findings,
        ["a scan of Acies is in mm, the unit m was not applied"]
    );

    let views =
        "the views in order: index, device, unit vector towards the sensor; export the file again";
    let cases = [
        (
            header(good, "ushort") + "1 2 3 1 7 5\n",
            "line 13: view 1 of a point, expected less than 1, the number of `comment acies view` lines; restore the header".into(),
        ),
        (header(good, "int") + "1 2 3 -1 7 5\n", "line 13: view is -1, expected a whole number up to 65535; export the scan again".into()),
        (header(good, "int") + "1 2 3 0 7.5 5\n", "line 13: profile is 7.5, expected a whole number up to 4294967295; export the scan again".into()),
        (header(good, "int") + "1 2 3 0 7 65536\n", "line 13: column is 65536, expected a whole number up to 65535; export the scan again".into()),
        (
            header("comment acies frame world\n", "int"),
            "line 3: `comment acies frame world` in the header, expected sensor, machine or part; export the file again".into(),
        ),
        (header("comment acies view 1 a 0 0 1\n", "int"), format!("line 3: `comment acies view 1 a 0 0 1` in the header, expected {views}")),
        (header("comment acies view 0 a 0 0 2\n", "int"), format!("line 3: `comment acies view 0 a 0 0 2` in the header, expected {views}")),
        (header("comment acies view 0 a 0 0\n", "int"), format!("line 3: `comment acies view 0 a 0 0` in the header, expected {views}")),
        (header("comment acies view 0 %2 0 0 1\n", "int"), format!("line 3: `comment acies view 0 %2 0 0 1` in the header, expected {views}")),
    ];
    for (text, expected) in cases {
        assert_eq!(refusal("a.ply", text), format!("a.ply: {expected}"));
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Packing {
    Ascii,
    Binary,
    Compressed,
}

/// PCD 0.7 by its documentation: a count of 2, double and float coordinates, in an unusual order.
fn pcd(packing: Packing, points: &[[f64; 3]], (width, height): (usize, usize)) -> Vec<u8> {
    let data = match packing {
        Packing::Ascii => "ascii",
        Packing::Binary => "binary",
        Packing::Compressed => "binary_compressed",
    };
    let mut bytes = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS y pair z x\nSIZE 8 2 8 8\nTYPE F U F F\nCOUNT 1 2 1 1\n\
         WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA {data}\n",
        width * height
    )
    .into_bytes();
    let pair = [7u8, 0, 8, 0];
    match packing {
        Packing::Ascii => {
            for [x, y, z] in points {
                bytes.extend(format!("{y} 7 8 {z} {x}\n").bytes());
            }
        }
        Packing::Binary => {
            for [x, y, z] in points {
                bytes.extend(y.to_le_bytes());
                bytes.extend(pair);
                bytes.extend(z.to_le_bytes());
                bytes.extend(x.to_le_bytes());
            }
        }
        Packing::Compressed => {
            let mut columns = Vec::new();
            points
                .iter()
                .for_each(|p| columns.extend(p[1].to_le_bytes()));
            points.iter().for_each(|_| columns.extend(pair));
            points
                .iter()
                .for_each(|p| columns.extend(p[2].to_le_bytes()));
            points
                .iter()
                .for_each(|p| columns.extend(p[0].to_le_bytes()));
            let packed = lzf(&columns);
            bytes.extend((packed.len() as u32).to_le_bytes());
            bytes.extend((columns.len() as u32).to_le_bytes());
            bytes.extend(packed);
        }
    }
    bytes
}

/// A plain LZF packer: looks for the last place of the next three bytes, at most 8,192 bytes back.
fn lzf(input: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut literals: Vec<u8> = Vec::new();
    let flush = |literals: &mut Vec<u8>, out: &mut Vec<u8>| {
        for run in literals.chunks(32) {
            out.push(run.len() as u8 - 1);
            out.extend(run);
        }
        literals.clear();
    };
    let mut at = 0;
    while at < input.len() {
        let window = at.saturating_sub(8192)..at;
        let longest = |start: usize| {
            input[start..]
                .iter()
                .zip(&input[at..])
                .take(264)
                .take_while(|(a, b)| a == b)
                .count()
        };
        let found = window.rev().find(|&start| longest(start) >= 3);
        let Some(start) = found else {
            literals.push(input[at]);
            at += 1;
            continue;
        };
        flush(&mut literals, &mut out);
        let (length, back) = (longest(start), at - start - 1);
        let high = (back >> 8) as u8;
        if length - 2 < 7 {
            out.push(((length - 2) as u8) << 5 | high);
        } else {
            out.push(7 << 5 | high);
            out.push((length - 9) as u8);
        }
        out.push(back as u8);
        at += length;
    }
    flush(&mut literals, &mut out);
    out
}

#[test]
fn pcd_is_read_in_all_three_packings() {
    for packing in [Packing::Ascii, Packing::Binary, Packing::Compressed] {
        let bytes = pcd(packing, &TWO, (2, 1));
        let read = parsed("cloud", &bytes).unwrap();
        assert_eq!(read.format, Format::Pcd, "{packing:?}");
        assert_eq!(positions("cloud", &bytes), TWO, "{packing:?}");
        assert_eq!(read.findings, [""; 0]);
    }
    let hand_packed = [
        &b"VERSION .7\nFIELDS x y z\nSIZE 1 1 1\nTYPE U U U\nWIDTH 4\nHEIGHT 1\nDATA binary_compressed\n"[..],
        // Ten `a` by the LZF stream's rules: a literal run of one, a reference one back of length 9, then "bc" as literals.
        b"\x08\0\0\0\x0c\0\0\0",
        b"\x00a\xe0\x00\x00\x01bc",
    ]
    .concat();
    assert_eq!(
        positions("cloud.pcd", hand_packed),
        [
            [97.0, 97.0, 97.0],
            [97.0, 97.0, 97.0],
            [97.0, 97.0, 98.0],
            [97.0, 97.0, 99.0]
        ]
    );
}

#[test]
fn pixels_without_return_are_left_out_of_an_organised_pcd_and_nowhere_else() {
    let nan = [f64::NAN; 3];
    let points = [TWO[0], nan, TWO[1], nan];
    for packing in [Packing::Ascii, Packing::Binary, Packing::Compressed] {
        let read = parsed("a.pcd", pcd(packing, &points, (2, 2))).unwrap();
        assert_eq!(read.cloud.len(), 2);
        assert_eq!(
            read.findings,
            ["2 of 4 pixels have no return and were left out"]
        );
        assert!(
            refusal("a.pcd", pcd(packing, &points, (4, 1)))
                .contains("x is NaN, expected a finite number")
        );
        let partly = [TWO[0], [1.0, f64::NAN, 2.0]];
        assert!(
            refusal("a.pcd", pcd(packing, &partly, (1, 2)))
                .contains("y is NaN, expected a finite number")
        );
    }
}

#[test]
fn pcd_that_breaks_its_rules_is_refused_with_line_or_byte() {
    let ascii = String::from_utf8(pcd(Packing::Ascii, &TWO, (2, 1))).unwrap();
    let replaced = |from: &str, to: &str| ascii.replace(from, to).into_bytes();
    let header = |line: u32, seen: &str, expected: &str| {
        format!("line {line}: `{seen}` in the header, expected {expected}; export the file again")
    };
    let compressed = pcd(Packing::Compressed, &TWO, (2, 1));
    let body = compressed
        .windows(11)
        .position(|w| w == b"compressed\n")
        .unwrap()
        + 11;
    let changed = |offset: usize, value: u32| {
        let mut bytes = compressed.clone();
        bytes[body + offset..body + offset + 4].copy_from_slice(&value.to_le_bytes());
        bytes
    };
    let packed = compressed.len() - body - 8;
    let spoilt = {
        let mut bytes = compressed.clone();
        bytes[body + 8] = 0xff;
        bytes
    };
    let binary = pcd(Packing::Binary, &TWO, (2, 1));
    let bomb = [
        &b"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 100000000\nDATA binary_compressed\n"[..],
        b"\x02\0\0\0\0\x18\x0d\x8f",
        b"\0\0",
    ]
    .concat();
    let cases: Vec<(Vec<u8>, String)> = vec![
        (replaced("SIZE 8", "SIZE 8 8"), header(11, "FIELDS", "as many FIELDS as SIZE, TYPE and COUNT")),
        (replaced("TYPE F U", "TYPE F C"), header(11, "C", "TYPE I, U or F with a SIZE that it has")),
        (replaced("POINTS 2", "POINTS 3"), header(11, "POINTS", "WIDTH times HEIGHT")),
        (replaced("WIDTH 2", "WIDTH two"), header(7, "WIDTH two", "a whole number")),
        (replaced("SIZE 8", "SIZE -8"), header(4, "SIZE -8 2 8 8", "whole numbers")),
        (replaced("VERSION", "VERMIN"), header(2, "VERMIN 0.7", "an entry of a PCD header")),
        (replaced("ascii", "zip"), header(11, "DATA zip", "ascii, binary or binary_compressed")),
        (replaced("COUNT 1 2", "COUNT 1 9999999"), header(11, "COUNT", "at most 100000 numbers a point")),
        (replaced("POINTS 2\n", "").split(|&b| b == b'W').next().unwrap().to_vec(), format!("byte {}: `the end of the file` in the header, expected a DATA line; export the file again", ascii.find('W').unwrap())),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nDATA ascii\n".to_vec(), header(4, "DATA", "WIDTH and HEIGHT or POINTS before it")),
        (replaced("y pair z x", "y pair w x"), "line 11: the points have no `z`, expected x, y and z; export the coordinates".into()),
        (replaced("-4.5\n", "-4.5 1\n"), "line 13: 6 columns, expected 5 as declared or in the lines before; correct or remove the line".into()),
        (replaced("-4.5\n", "a\n"), "line 13: x is `a`, expected a number; correct or remove the line".into()),
        (replaced("0.25 7 8 0.001 -4.5\n", ""), "line 12: the file ends after 1 of 2 points; transfer or export it again".into()),
        (binary[..binary.len() - 1].to_vec(), format!("byte {}: the file ends after 1 of 2 points; transfer or export it again", binary.len() - 1)),
        (
            compressed[..compressed.len() - 1].to_vec(),
            format!("byte {}: the file ends after {} of {packed} bytes of packed data; transfer or export it again", compressed.len() - 1, packed - 1),
        ),
        (compressed[..body + 4].to_vec(), format!("byte {}: the file ends after 0 of 2 points; transfer or export it again", body + 4)),
        (
            changed(4, 57),
            format!("byte {body}: compressed data that do not unpack: 57 bytes unpacked, expected 2 points of 28 bytes; transfer or export the file again"),
        ),
        (
            changed(0, packed as u32 - 1),
            format!("byte {body}: compressed data that do not unpack: the end of the data, expected the rest of a run; transfer or export the file again"),
        ),
        (
            spoilt,
            format!("byte {body}: compressed data that do not unpack: a reference 8065 bytes back at byte 0, expected one into the bytes before; transfer or export the file again"),
        ),
        (bomb, "byte 75: compressed data that do not unpack: 2 bytes packed, expected more for 2400000000 bytes; transfer or export the file again".into()),
    ];
    for (bytes, expected) in cases {
        assert_eq!(refusal("a.pcd", bytes), format!("a.pcd: {expected}"));
    }
}

const TRIANGLE: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]];
const NEIGHBOUR: [[f32; 3]; 3] = [[1.0, 0.0, 0.0], [-0.0, 0.0, 0.0], [0.0, -1.0, 0.5]];

fn binary_stl(facets: &[[[f32; 3]; 3]]) -> Vec<u8> {
    // Some programs begin the header of a binary file with `solid`.
    let mut bytes = b"solid but binary".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((facets.len() as u32).to_le_bytes());
    for facet in facets {
        bytes.extend([0; 12]);
        facet
            .iter()
            .flatten()
            .for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

fn ascii_stl(facets: &[[[f32; 3]; 3]]) -> String {
    let mut text = String::from("solid part\n");
    for facet in facets {
        text += "  facet normal 0 0 1\n    outer loop\n";
        for [x, y, z] in facet {
            text += &format!("      vertex {x} {y} {z}\n");
        }
        text += "    endloop\n  endfacet\n";
    }
    text + "endsolid part\n"
}

#[test]
fn corners_of_stl_facets_are_read_once_and_in_order() {
    let corners = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.5],
        [0.0, -1.0, 0.5],
    ];
    let facets = [TRIANGLE, NEIGHBOUR];
    for (name, bytes) in [
        ("binary", binary_stl(&facets)),
        ("ascii", ascii_stl(&facets).into_bytes()),
    ] {
        let read = parsed(name, &bytes).unwrap();
        assert_eq!(read.format, Format::Stl, "{name}");
        assert_eq!(positions(name, &bytes), corners, "{name}");
        assert_eq!(read.findings, [""; 0], "joined corners are no finding");
    }
}

#[test]
fn stl_that_breaks_its_rules_is_refused_with_line_or_byte() {
    let text = ascii_stl(&[TRIANGLE]);
    let statement = |line: u32, seen: &str, expected: &str| {
        format!("line {line}: `{seen}`, expected {expected}; correct or remove the line")
    };
    let binary = {
        let mut bytes = binary_stl(&[TRIANGLE, NEIGHBOUR]);
        bytes[..5].copy_from_slice(b"lidar");
        bytes
    };
    let mut infinite = binary.clone();
    infinite[84 + 50 + 28..84 + 50 + 32].copy_from_slice(&f32::INFINITY.to_le_bytes());
    let cases: Vec<(Vec<u8>, String)> = vec![
        (text.replace("endsolid part\n", "").into(), statement(8, "the end of the file", "facet normal or endsolid")),
        (text.replace("    endloop\n", "").into(), statement(7, "endfacet", "endloop")),
        (text.replace("outer loop", "loop").into(), statement(3, "loop", "outer loop")),
        (text.replace("vertex 1 0 0", "corner 1 0 0").into(), statement(5, "corner 1 0 0", "vertex x y z")),
        (text.replace("vertex 1 0 0", "vertex 1 0").into(), "line 5: z is ``, expected a number; correct or remove the line".into()),
        (text.replace("  endfacet\n", "  facet\n").into(), statement(8, "facet", "endfacet")),
        (format!("{text}1 2 3\n").into(), statement(10, "1 2 3", "solid")),
        (binary[..binary.len() - 1].to_vec(), "byte 183: the file ends after 1 of 2 facets; transfer or export it again".into()),
        (binary[..83].to_vec(), "byte 83: the file ends after 83 of 84 bytes of the header; transfer or export it again".into()),
        (
            infinite,
            "byte 158: y is inf, expected a finite number; leave out points without a measurement when exporting".into(),
        ),
    ];
    for (bytes, expected) in cases {
        assert_eq!(refusal("a.stl", bytes), format!("a.stl: {expected}"));
    }
}

#[test]
fn obj_vertices_and_hoppe_points_are_read() {
    let obj = "# by hand\nmtllib a.mtl\no part\nv 1 2 3\nv -4.5 0.25 0.001 1.0\nvn 0 0 1\nf 1 2 \\\n 1\ng\n";
    for name in ["a.obj", "no-extension"] {
        assert_eq!(parsed(name, obj).unwrap().format, Format::Obj);
        assert_eq!(positions(name, obj), TWO);
    }
    let hoppe = "# by hand\nd 0 0 0\ns 0 0 0\ng 1 0 0\np 1 2 3\np -4.5 .25 1e-3\n";
    assert_eq!(parsed("a.pts", hoppe).unwrap().format, Format::HoppePts);
    assert_eq!(positions("a.pts", hoppe), TWO);
    let cases = [
        (
            "a.obj",
            "v 1 2 3\nv 1 2\n",
            "line 2: 2 columns, expected at least 3 (x y z); correct or remove the line",
        ),
        (
            "a.obj",
            "v 1 2 three\n",
            "line 1: z is `three`, expected a number; correct or remove the line",
        ),
        (
            "a.obj",
            "v 1 inf 3\n",
            "line 1: y is inf, expected a finite number; leave out points without a measurement when exporting",
        ),
        (
            "a.obj",
            "v 1 2 3\nvertex 1\n",
            "line 2: `vertex 1`, expected a statement of Wavefront OBJ; correct or remove the line",
        ),
        (
            "a.pts",
            "p 1 2 3\nq 1 2 3\n",
            "line 2: `q 1 2 3`, expected a line of a point list (p, d, s or g); correct or remove the line",
        ),
        (
            "a.obj",
            "vn 1 2 3\n",
            "byte 9: the file holds no point, expected at least one; check what was exported",
        ),
    ];
    for (name, text, expected) in cases {
        assert_eq!(refusal(name, text), format!("{name}: {expected}"));
    }
}

#[test]
fn a_million_identical_points_are_read_and_are_a_finding() {
    let points = vec![DVec3::new(1.0, 2.0, 3.0); 1_000_000];
    let read = parsed(
        "same.ply",
        ply_bytes(&points, &[], Encoding::LittleEndian).unwrap(),
    )
    .unwrap();
    assert_eq!(read.cloud.positions, points);
    assert_eq!(
        read.findings,
        ["999999 of 1000000 points lie exactly on an earlier point"]
    );
}

#[test]
fn a_header_that_promises_too_much_is_refused_at_once() {
    let ply = "ply\nformat binary_little_endian 1.0\nelement vertex 18446744073709551615\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
    assert!(refusal("a.ply", ply).contains("the file ends after 0 of 18446744073709551615 points"));
    let list = "ply\nformat binary_little_endian 1.0\nelement vertex 99\nproperty double x\nproperty double y\nproperty double z\nproperty list uint double l\nend_header\n";
    let bytes = [list.as_bytes(), &[0; 24], &[255; 4], &[0; 64]].concat();
    assert!(refusal("a.ply", bytes).contains("the file ends after 0 of 99 points"));
    let pcd =
        "FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 4294967296\nHEIGHT 4294967295\nDATA binary\n";
    assert!(refusal("a.pcd", pcd).contains("the file ends after 0 of 18446744069414584320 points"));
    assert!(
        refusal("a.pts", "18446744073709551615\n1 2 3\n")
            .contains("the file ends after 1 of 18446744073709551615 points")
    );
    let mut stl = binary_stl(&[TRIANGLE]);
    stl[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    stl[..5].copy_from_slice(b"lidar");
    assert!(refusal("a.stl", stl).contains("the file ends after 1 of 4294967295 facets"));
}

#[test]
fn written_files_have_the_form_that_others_read() {
    let points = TWO.map(DVec3::from_array);
    let columns = [
        Column::U8("feature", &[1, 2]),
        Column::F32("height", &[0.5, -0.25]),
    ];
    assert_eq!(
        String::from_utf8(ply_bytes(&points, &columns, Encoding::Ascii).unwrap()).unwrap(),
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar feature\nproperty float height\nend_header\n1.0 2.0 3.0 1 0.5\n-4.5 0.25 0.001 2 -0.25\n"
    );
    assert_eq!(
        String::from_utf8(xyz_bytes(&points, &columns).unwrap()).unwrap(),
        "x y z feature height\n1.0 2.0 3.0 1 0.5\n-4.5 0.25 0.001 2 -0.25\n"
    );
    assert_eq!(
        String::from_utf8(xyz_bytes(&points[..1], &[]).unwrap()).unwrap(),
        "1.0 2.0 3.0\n"
    );
    let all = [
        Column::U16("a", &[258]),
        Column::U32("b", &[16_909_060]),
        Column::I32("c", &[-2]),
        Column::F64("d", &[1.0]),
    ];
    let big = ply_bytes(&[DVec3::ZERO], &all, Encoding::BigEndian).unwrap();
    let body = [
        &[0; 24][..],
        &[1, 2],
        &[1, 2, 3, 4],
        &[255, 255, 255, 254],
        &[0x3f, 0xf0, 0, 0, 0, 0, 0, 0],
    ]
    .concat();
    assert!(big.ends_with(&[b"\nend_header\n", body.as_slice()].concat()));
    let little = ply_bytes(&[DVec3::ZERO], &all[..1], Encoding::LittleEndian).unwrap();
    assert!(
        little.ends_with(b"end_header\n\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x02\x01")
    );
}

#[test]
fn what_cannot_be_written_is_said() {
    let two = TWO.map(DVec3::from_array);
    let refused = |columns: &[Column]| {
        ply_bytes(&two, columns, Encoding::Ascii)
            .unwrap_err()
            .to_string()
    };
    assert_eq!(
        refused(&[Column::U8("feature", &[1])]),
        "column `feature`: 1 values, expected 2, one for each point; give every point its value"
    );
    for (name, columns) in [
        ("x", vec![Column::U8("x", &[1, 2])]),
        ("two words", vec![Column::U8("two words", &[1, 2])]),
        ("", vec![Column::U8("", &[1, 2])]),
        (
            "a",
            vec![Column::U8("a", &[1, 2]), Column::U8("a", &[1, 2])],
        ),
    ] {
        assert_eq!(
            refused(&columns),
            format!(
                "column `{name}`: not a usable name, expected a word without blanks that no other column has; rename it"
            )
        );
    }
    let mut cloud = PointCloud::from_positions(Frame::Machine, two.to_vec());
    cloud.origins = vec![Origin {
        view: 0,
        column: 0,
        profile: 0,
    }];
    let scan = |cloud: &PointCloud| scan_bytes(cloud, Encoding::Ascii).unwrap_err().to_string();
    let build = "build the cloud from one scan";
    assert_eq!(
        scan(&cloud),
        format!(
            "point cloud: 1 origins for 2 points, expected one a point, or none at all; {build}"
        )
    );
    cloud.origins.push(Origin {
        view: 1,
        column: 0,
        profile: 0,
    });
    cloud.views = vec![View {
        device: "a".into(),
        towards_sensor: DVec3::Z,
    }];
    assert_eq!(
        scan(&cloud),
        format!(
            "point cloud: an origin of view 1 among 1 views, expected views that are there; {build}"
        )
    );
    cloud.views.push(View {
        device: "b".into(),
        towards_sensor: DVec3::ONE,
    });
    assert_eq!(
        scan(&cloud),
        format!("point cloud: view 1 points along [1, 1, 1], expected a unit vector; {build}")
    );
    cloud.views = vec![
        View {
            device: "a".into(),
            towards_sensor: DVec3::Z
        };
        65_537
    ];
    assert_eq!(
        scan(&cloud),
        format!("point cloud: 65537 views, expected at most 65536 views; {build}")
    );
}

#[test]
fn a_file_that_is_not_there_or_cannot_be_is_said() {
    let missing = scratch("missing.ply");
    assert_eq!(
        read(&missing, Unit::Millimetre).unwrap_err().to_string(),
        format!(
            "{}: cannot be read: No such file or directory (os error 2); check the path and the permissions",
            missing.display()
        )
    );
    let nowhere = scratch("no-folder/a.ply");
    assert_eq!(
        write_xyz(&nowhere, &[DVec3::ZERO], &[])
            .unwrap_err()
            .to_string(),
        format!(
            "{}: cannot be written: No such file or directory (os error 2); check that the folder exists, may be written to and has room",
            nowhere.display()
        )
    );
}

#[test]
fn a_write_replaces_the_file_whole_or_not_at_all() {
    let path = scratch("replaced.ply");
    write_ply(&path, &[DVec3::ZERO], &[], Encoding::Ascii).unwrap();
    let before = fs::read(&path).unwrap();
    write_ply(
        &path,
        &[DVec3::ZERO],
        &[Column::U8("a", &[])],
        Encoding::Ascii,
    )
    .unwrap_err();
    assert_eq!(fs::read(&path).unwrap(), before);
    write_scan(
        &path,
        &PointCloud::from_positions(Frame::Part, vec![DVec3::ONE]),
    )
    .unwrap();
    assert_eq!(
        read(&path, Unit::Millimetre).unwrap().cloud.positions,
        [DVec3::ONE]
    );
    let left: Vec<_> = fs::read_dir(path.parent().unwrap())
        .unwrap()
        .filter_map(|entry| entry.unwrap().file_name().into_string().ok())
        .filter(|name| name.ends_with(".part"))
        .collect();
    assert_eq!(left, [""; 0]);
    assert!(
        write_atomically(Path::new("/dev/null"), b"gone").is_ok(),
        "a device is written to as it is"
    );
}

/// Any coordinate that a file may hold, down to the smallest numbers there are.
fn coordinate() -> impl Strategy<Value = f64> {
    prop_oneof![
        -1e3..1e3,
        -1e11..1e11,
        Just(-0.0),
        Just(5e-324),
        Just(1.0 / 3.0),
        -1e-300..1e-300
    ]
}

fn points() -> impl Strategy<Value = Vec<DVec3>> {
    proptest::collection::vec(
        (coordinate(), coordinate(), coordinate()).prop_map(DVec3::from),
        1..40,
    )
}

fn scan() -> impl Strategy<Value = PointCloud> {
    let view =
        ("\\PC*", -3.0..3.0, -1.5..1.5).prop_map(|(device, a, b): (String, f64, f64)| View {
            device,
            towards_sensor: DVec3::new(a.cos() * b.cos(), a.sin() * b.cos(), b.sin()),
        });
    let frame = prop_oneof![Just(Frame::Sensor), Just(Frame::Machine), Just(Frame::Part)];
    let views = proptest::collection::vec(view, 1..4);
    (points(), views, frame, any::<(u16, u16, u32)>()).prop_map(
        |(positions, views, frame, (view, column, profile))| {
            let origin = |i: usize| Origin {
                view: (view as usize + i) as u16 % views.len() as u16,
                column: column.wrapping_add(i as u16),
                profile: profile.wrapping_mul(i as u32),
            };
            PointCloud {
                frame,
                origins: (0..positions.len()).map(origin).collect(),
                positions,
                views,
            }
        },
    )
}

fn bits(points: &[DVec3]) -> Vec<[u64; 3]> {
    points
        .iter()
        .map(|p| p.to_array().map(f64::to_bits))
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_scan_comes_back_bit_for_bit(cloud in scan()) {
        for encoding in [Encoding::Ascii, Encoding::LittleEndian, Encoding::BigEndian] {
            let read = parsed("scan.ply", scan_bytes(&cloud, encoding).unwrap()).unwrap();
            prop_assert_eq!(bits(&read.cloud.positions), bits(&cloud.positions));
            prop_assert_eq!(&read.cloud, &cloud);
        }
    }

    #[test]
    fn points_come_back_bit_for_bit_from_text(points in points(), values in any::<u8>()) {
        let values = vec![values; points.len()];
        for columns in [&[][..], &[Column::U8("feature", &values)]] {
            let read = parsed("a.xyz", xyz_bytes(&points, columns).unwrap()).unwrap();
            prop_assert_eq!(bits(&read.cloud.positions), bits(&points));
        }
    }

    #[test]
    fn points_come_back_bit_for_bit_from_pcd(points in points()) {
        let raw: Vec<[f64; 3]> = points.iter().map(|p| p.to_array()).collect();
        for packing in [Packing::Ascii, Packing::Binary, Packing::Compressed] {
            let read = parsed("a.pcd", pcd(packing, &raw, (raw.len(), 1))).unwrap();
            prop_assert_eq!(bits(&read.cloud.positions), bits(&points));
        }
    }

    #[test]
    fn corners_come_back_from_stl(corners in proptest::collection::vec(any::<[[i8; 3]; 3]>(), 1..40)) {
        let facets: Vec<[[f32; 3]; 3]> = corners.iter().map(|f| f.map(|c| c.map(f32::from))).collect();
        let mut expected: Vec<[f64; 3]> = Vec::new();
        for corner in facets.iter().flatten().map(|c| c.map(f64::from)) {
            if !expected.contains(&corner) {
                expected.push(corner);
            }
        }
        prop_assert_eq!(positions("a.stl", binary_stl(&facets)), expected.clone());
        prop_assert_eq!(positions("a.stl", ascii_stl(&facets)), expected);
    }

    #[test]
    fn spoilt_files_neither_panic_nor_take_memory_beyond_their_size(
        format in 0..9usize,
        changes in proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<proptest::sample::Index>(),
        is_cut in any::<bool>(),
    ) {
        let (name, mut bytes) = sound_file(format);
        for (index, value) in changes {
            let at = index.index(bytes.len());
            bytes[at] = value;
        }
        if is_cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let used = allocation_counter::measure(|| {
            let _ = parsed(name, &bytes);
        });
        // LZF expands up to 88 times, and a point of three bytes becomes one of 24.
        let factor = if format == 4 { 88 * 9 } else { 64 };
        let limit = (factor * bytes.len() + 4096) as u64;
        prop_assert!(used.bytes_max <= limit, "{} bytes for a file of {}", used.bytes_max, bytes.len());
    }
}

/// One sound file of each kind.
fn sound_file(format: usize) -> (&'static str, Vec<u8>) {
    match format {
        0 => ("a.ply", awkward_ply(false)),
        1 => ("a.ply", format!("{PLY}1 2 3\n4 5 6\n").into_bytes()),
        2 => ("a.pcd", pcd(Packing::Ascii, &TWO, (2, 1))),
        3 => ("a.pcd", pcd(Packing::Binary, &TWO, (2, 1))),
        4 => ("a.pcd", pcd(Packing::Compressed, &TWO, (2, 1))),
        5 => ("a.stl", binary_stl(&[TRIANGLE, NEIGHBOUR])),
        6 => ("a.stl", ascii_stl(&[TRIANGLE]).into_bytes()),
        7 => ("a.obj", b"v 1 2 3\nv 4 5 6\nf 1 2 1\n".to_vec()),
        _ => ("a.pts", b"2\n1.5,2,3\n4,5.25,6e1\n".to_vec()),
    }
}
