//! IGES files: written here column by column, and real ones against Open CASCADE.

use acies::nominal::{EdgeKind, Nominal};
use glam::DVec3;

use super::data;

/// An IGES file under construction.
#[derive(Default)]
struct Writer {
    directory: String,
    parameters: String,
    entities: usize,
    lines: usize,
}

impl Writer {
    /// Adds an entity; its directory number. `dependent` where another holds it.
    fn add(&mut self, kind: u32, form: u32, dependent: bool, parameters: &str) -> usize {
        let id = 2 * self.entities + 1;
        let text = format!("{kind},{parameters};");
        let words: Vec<&str> = text.split_inclusive(',').collect();
        let mut rows = vec![String::new()];
        for word in words {
            if rows[rows.len() - 1].len() + word.len() > 64 {
                rows.push(String::new());
            }
            let last = rows.len() - 1;
            rows[last] += word;
        }
        let first = self.lines + 1;
        let status = if dependent { "00010000" } else { "00000000" };
        let zero = "       0";
        self.directory +=
            &format!("{kind:8}{first:8}{zero}{zero}{zero}{zero}{zero}{zero}{status}D{id:7}\n");
        let count = rows.len();
        let blank = "        ";
        self.directory += &format!(
            "{kind:8}{zero}{zero}{count:8}{form:8}{blank}{blank}{blank}{zero}D{:7}\n",
            id + 1
        );
        for row in rows {
            self.lines += 1;
            self.parameters += &format!("{row:<64}{id:8}P{:7}\n", self.lines);
        }
        self.entities += 1;
        id
    }

    /// The whole file; `unit` is the flag of the global section.
    fn file(&self, unit: u32) -> String {
        let global = format!(
            "1H,,1H;,4HPART,8Hpart.igs,5HAcies,1H1,32,38,6,308,15,4HPART,1.0,{unit},4H    ,1,1.0,1H1,1.0E-6,10.0;"
        );
        let mut rows = String::new();
        for (i, chunk) in global.as_bytes().chunks(72).enumerate() {
            rows += &format!("{:<72}G{:7}\n", String::from_utf8_lossy(chunk), i + 1);
        }
        let end = format!(
            "S      1G{:7}D{:7}P{:7}",
            rows.lines().count(),
            2 * self.entities,
            self.lines
        );
        format!(
            "{:<72}S      1\n{rows}{}{}{end:<72}T      1\n",
            "a part", self.directory, self.parameters
        )
    }
}

/// Corners of a box of 3 x 2 x 1, and its faces as corners in order around the outward normal.
const CORNERS: [[f64; 3]; 8] = [
    [0., 0., 0.],
    [3., 0., 0.],
    [3., 2., 0.],
    [0., 2., 0.],
    [0., 0., 1.],
    [3., 0., 1.],
    [3., 2., 1.],
    [0., 2., 1.],
];
const SIDES: [[usize; 4]; 6] = [
    [0, 3, 2, 1],
    [4, 5, 6, 7],
    [0, 1, 5, 4],
    [1, 2, 6, 5],
    [2, 3, 7, 6],
    [3, 0, 4, 7],
];

fn line(w: &mut Writer, a: usize, b: usize) -> usize {
    let [p, q] = [CORNERS[a], CORNERS[b]];
    w.add(
        110,
        0,
        true,
        &format!(
            "{:?},{:?},{:?},{:?},{:?},{:?}",
            p[0], p[1], p[2], q[0], q[1], q[2]
        ),
    )
}

/// Normal and distance of a side's plane; every second one looks inward, as trimmed surfaces may.
fn plane(side: usize, inward: bool) -> [f64; 4] {
    let [a, b, c] = [0, 1, 2].map(|k| DVec3::from(CORNERS[SIDES[side][k]]));
    let n = (b - a).cross(c - b).normalize() * if inward { -1.0 } else { 1.0 };
    [n.x, n.y, n.z, n.dot(a)]
}

/// The box as six trimmed planes (144) that share nothing.
fn trimmed_box() -> Writer {
    let mut w = Writer::default();
    for (i, side) in SIDES.iter().enumerate() {
        let [a, b, c, d] = plane(i, i % 2 == 1);
        let surface = w.add(
            108,
            0,
            true,
            &format!("{a:?},{b:?},{c:?},{d:?},0,0.,0.,0.,0."),
        );
        let mut lines: Vec<String> = Vec::new();
        for k in 0..4 {
            // Some pieces run backwards, and on one side the longest is cut in two.
            let (from, to) = (side[k], side[(k + 1) % 4]);
            lines.push(
                if k == 2 {
                    line(&mut w, to, from)
                } else {
                    line(&mut w, from, to)
                }
                .to_string(),
            );
        }
        let border = w.add(102, 0, true, &format!("4,{}", lines.join(",")));
        let on = w.add(142, 0, true, &format!("0,{surface},0,{border},2"));
        w.add(144, 0, false, &format!("{surface},1,0,{on}"));
    }
    w
}

/// The box as a solid (186) with vertices, edges, loops and a shell.
fn solid_box() -> Writer {
    let mut w = Writer::default();
    let points: Vec<String> = CORNERS
        .iter()
        .map(|p| format!("{:?},{:?},{:?}", p[0], p[1], p[2]))
        .collect();
    let vertices = w.add(502, 1, true, &format!("8,{}", points.join(",")));
    let mut edges: Vec<(usize, usize)> = Vec::new();
    for side in SIDES {
        for k in 0..4 {
            let (a, b) = (side[k], side[(k + 1) % 4]);
            if !edges.contains(&(a, b)) && !edges.contains(&(b, a)) {
                edges.push((a, b));
            }
        }
    }
    let mut list = format!("{}", edges.len());
    for (a, b) in &edges {
        let curve = line(&mut w, *a, *b);
        list += &format!(",{curve},{vertices},{},{vertices},{}", a + 1, b + 1);
    }
    let list = w.add(504, 1, true, &list);
    let mut shell = String::from("6");
    for (i, side) in SIDES.iter().enumerate() {
        let [a, b, c, _] = plane(i, false);
        let p = CORNERS[side[0]];
        let point = w.add(116, 0, true, &format!("{:?},{:?},{:?},0", p[0], p[1], p[2]));
        let normal = w.add(123, 0, true, &format!("{a:?},{b:?},{c:?}"));
        let surface = w.add(190, 0, true, &format!("{point},{normal}"));
        let mut text = String::from("4");
        for k in 0..4 {
            let ends = (side[k], side[(k + 1) % 4]);
            let along = edges.iter().position(|e| *e == ends);
            let index = along.or_else(|| edges.iter().position(|e| *e == (ends.1, ends.0)));
            let index = index.expect("an edge of the box") + 1;
            text += &format!(",0,{list},{index},{},0", u8::from(along.is_some()));
        }
        let border = w.add(508, 1, true, &text);
        let face = w.add(510, 1, true, &format!("{surface},1,1,{border}"));
        shell += &format!(",{face},1");
    }
    let shell = w.add(514, 1, true, &shell);
    w.add(186, 0, false, &format!("{shell},1,0"));
    w
}

fn parse(text: &str) -> Nominal {
    Nominal::parse(text.as_bytes(), "part.igs").expect("a readable part")
}

fn refusal(text: &str) -> String {
    Nominal::parse(text.as_bytes(), "part.igs")
        .expect_err("must be refused")
        .to_string()
}

#[test]
fn a_box_is_read_from_trimmed_surfaces_and_from_a_solid() {
    for file in [trimmed_box().file(1), solid_box().file(1)] {
        let n = parse(&file);
        assert_eq!(n.refused, []);
        assert_eq!(
            (n.bodies, n.faces.len(), n.edges.len(), n.corners().len()),
            (1, 6, 12, 8)
        );
        let inch = 25.4f64;
        assert!(
            (n.volume_mm3() / (6.0 * inch.powi(3)) - 1.0).abs() < 1e-12,
            "outward, in mm"
        );
        assert!((n.area_mm2() / (22.0 * inch.powi(2)) - 1.0).abs() < 1e-12);
        assert!((n.bounding_box_mm[1] - DVec3::new(3.0, 2.0, 1.0) * inch).length() < 1e-12);
        assert_eq!(n.sharp_edges.len(), 12);
        for e in &n.sharp_edges {
            assert_eq!(e.kind, EdgeKind::Convex);
            let s = e.station(&n, 0.5 * e.length_mm);
            let centre = DVec3::new(1.5, 1.0, 0.5) * inch;
            assert!(s.normals.iter().all(|n| n.dot(s.point - centre) > 0.0));
        }
    }
}

#[test]
fn broken_sections_are_named_with_their_line() {
    let file = trimmed_box().file(2);
    let lines = file.lines().count();
    let cut: String = file
        .lines()
        .take(lines - 1)
        .map(|l| format!("{l}\n"))
        .collect();
    assert_eq!(
        refusal(&cut),
        format!(
            "part.igs: line {lines}: the file ends without its terminate section (T in column 73), it was cut off; export \
             the part again"
        )
    );
    let short = file.replacen("     144       ", "144", 1);
    assert!(
        refusal(&short).contains(" columns, expected 80; "),
        "{}",
        refusal(&short)
    );
    let order = file.replacen("D      1\n", "T      1\n", 1);
    assert!(
        refusal(&order).starts_with("part.igs: no solid or surface model, but an empty directory")
    );
    let compressed = file.replacen("S      1", "C      1", 1);
    assert_eq!(
        refusal(&compressed),
        "part.igs: line 1: a binary or compressed IGES file, expected one of 80 columns; export the part again"
    );
    let unit = trimmed_box().file(77);
    assert!(
        refusal(&unit).starts_with("part.igs: line 2: unit flag 77 with unit"),
        "{}",
        refusal(&unit)
    );
}

#[test]
fn entities_that_are_not_read_are_refused_by_name() {
    let mut w = trimmed_box();
    let id = w.add(150, 0, false, "1.,1.,1.,0.,0.,0.,1.,0.,0.,0.,0.,1.");
    let n = parse(&w.file(2));
    assert_eq!(n.faces.len(), 6);
    let said: Vec<(u64, &str)> = n
        .refused
        .iter()
        .map(|r| (r.entity, &r.reason[..]))
        .collect();
    assert_eq!(said, [(id as u64, "an entity of type 150 is not read")]);
    let mut w = Writer::default();
    let surface = w.add(130, 0, true, "0");
    let face = w.add(144, 0, false, &format!("{surface},1,0,{surface}"));
    assert_eq!(
        refusal(&w.file(2)),
        format!(
            "part.igs: none of its 1 faces can be used, the first because #{face}: #{surface}: is of type 130, expected a \
             boundary (141 or 142); export the part again"
        )
    );
}

#[test]
fn circles_of_pointers_end() {
    // A composite curve that holds itself, and a subfigure that uses itself twice.
    let mut w = Writer::default();
    let surface = w.add(108, 0, true, "0.,0.,1.,0.,0,0.,0.,0.,0.");
    w.add(102, 0, true, "2,3,3");
    let on = w.add(142, 0, true, &format!("0,{surface},0,3,2"));
    w.add(144, 0, false, &format!("{surface},1,0,{on}"));
    let text = refusal(&w.file(2));
    assert!(
        text.contains("curves nested too deep, in a circle, or too many"),
        "{text}"
    );
    let mut w = Writer::default();
    w.add(308, 0, true, "0,1HA,2,3,5");
    w.add(408, 0, false, "1,0.,0.,0.,1.");
    w.add(408, 0, false, "1,0.,0.,0.,1.");
    let text = refusal(&w.file(2));
    assert!(text.starts_with("part.igs: "), "{text}");
}

#[test]
fn counts_and_pointers_that_lie_are_refused() {
    for (from, to) in [
        ("102,4,", "102,999999999,"),
        ("144,1,1,0,", "144,1,1,99999999,"),
        ("142,0,1,0,", "142,0,1,0,77"),
    ] {
        let file = trimmed_box().file(2);
        assert!(file.contains(from), "{from}");
        let broken: String = file
            .lines()
            .map(|l| {
                let at = l.len() - 16;
                // Columns stay where they are.
                let data = if l.ends_with(|c: char| c.is_ascii_digit()) && l.as_bytes()[72] == b'P'
                {
                    format!("{:<64}", l[..at].trim_end().replace(from, to))
                } else {
                    l[..at].to_owned()
                };
                format!("{}{}\n", data, &l[at..])
            })
            .collect();
        match Nominal::parse(broken.as_bytes(), "part.igs") {
            Ok(n) => assert!(n.faces.len() < 6 && !n.refused.is_empty(), "{from}"),
            Err(e) => assert!(e.to_string().contains("can be used"), "{e}"),
        }
    }
}

#[test]
fn damaged_bytes_are_read_or_refused() {
    let file = solid_box().file(2).into_bytes();
    let other = trimmed_box().file(2).into_bytes();
    // Every 7th place takes digits, delimiters and letters in turn: a few thousand files.
    for (bytes, start) in [(&file, 3), (&other, 5)] {
        for (i, place) in (start..bytes.len()).step_by(17).enumerate() {
            let mut damaged = bytes.clone();
            damaged[place] = b"0,9;H-. 5D"[i % 10];
            if let Ok(n) = Nominal::parse(&damaged, "part.igs") {
                assert!(n.area_mm2().is_finite());
                for e in &n.sharp_edges {
                    assert!(e.station(&n, 0.5 * e.length_mm).point.is_finite());
                }
            }
        }
    }
}

#[test]
fn real_files_agree_with_open_cascade() {
    let Some(root) = data() else { return };
    let text = std::fs::read(root.join("cad-oracle.json")).expect("the oracle");
    let oracle: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    for name in ["IPP_simple.igs", "occt_hammer.iges", "pyocc_surf114.igs"] {
        let n = Nominal::read(&root.join("iges").join(name)).unwrap_or_else(|e| panic!("{e}"));
        let o = &oracle[name];
        assert_eq!(n.refused, [], "{name}");
        assert_eq!(
            n.faces.len() as u64,
            o["faces"].as_u64().expect("a count"),
            "{name}"
        );
        let area = n.area_mm2() / o["area_mm2"].as_f64().expect("a number");
        // Borders are polylines; Open CASCADE integrates by its own tolerance.
        assert!((area - 1.0).abs() < 1e-4, "{name}: area {area}");
    }
    // The same part as a STEP file: the solid is the truth of the trimmed surfaces.
    let iges = Nominal::read(&root.join("iges/IPP_simple.igs")).unwrap_or_else(|e| panic!("{e}"));
    let step =
        Nominal::read(&root.join("step/IPP_simple_AP203.stp")).unwrap_or_else(|e| panic!("{e}"));
    let volume = iges.volume_mm3() / step.volume_mm3();
    assert!((volume - 1.0).abs() < 1e-5, "turned outward: {volume}");
    let corners = |n: &Nominal| n.corners().iter().filter(|c| c.is_vertex()).count();
    assert_eq!(corners(&iges), corners(&step));
}
