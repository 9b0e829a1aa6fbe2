//! CAD reading against Open CASCADE, as a markdown table: `cargo bench --bench cad`.
//!
//! Every file of `../shared/data/step` and `../shared/data/iges` is read; faces, area, edge length and box stand beside those
//! of `cad-oracle.json` as relative differences (the box by the largest of its six numbers over its diagonal).

use std::path::Path;
use std::time::Instant;

use acies::nominal::Nominal;
use serde_json::Value;

/// What may differ without a word: shares of length and of the box's diagonal, and of the area.
const LENGTH_SHARE: f64 = 1e-6;
const AREA_SHARE: f64 = 1e-4;

/// Why a file's answer differs, where it does.
const REASONS: &[(&str, &str)] = &[
    (
        "IPP_simple_AP203.stp",
        "length: Open CASCADE adds the seam of a closed face; the file has 14 edges, it counts 15",
    ),
    (
        "pyocc_as1_pe_203.stp",
        "length: Open CASCADE adds seams of closed faces that the file does not have",
    ),
    (
        "pyocc_face_recognition_sample_part.stp",
        "length: Open CASCADE adds seams of closed faces that the file does not have; the file has 56 edges, it counts 72 with wires",
    ),
    (
        "DCX_DaimlerChryslerTestPart.igs",
        "area: Open CASCADE itself gives the same part as a solid (AP214) 67,024 mm2, which is ours to 1e-4",
    ),
    (
        "stepcode_dm1-id-214.stp",
        "area: the oracle integrated on a fixed grid; Open CASCADE to 1e-9 gives 31,841.392627 mm2",
    ),
    (
        "nist_ftc_07_asme1_ap242-e2.stp",
        "length: the file has 871 edges and 7 wires, and so have we; Open CASCADE adds 31 degenerated edges at poles, of which it takes 15 for \
         0.04 to 0.06 mm long",
    ),
    (
        "occt_hammer.iges",
        "box: Open CASCADE's own edge reaches y = 21,343.141736, which is ours; its box ends 0.18 mm before",
    ),
    (
        "pyocc_surf114.igs",
        "length: a surface that closes on itself has no seam here, and two in Open CASCADE",
    ),
];

fn main() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let Ok(text) = std::fs::read(root.join("cad-oracle.json")) else {
        eprintln!("skipped: {} is not there", root.display());
        return;
    };
    let oracle: Value = serde_json::from_slice(&text).expect("the oracle is JSON");
    say("| file | faces | area, rel. | edge length, rel. | box, rel. | s | refused | note |");
    say("|---|---|---|---|---|---|---|---|");
    for folder in ["step", "iges"] {
        let entries = std::fs::read_dir(root.join(folder)).expect("the folder of the files");
        let mut files: Vec<_> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
        files.sort();
        for file in files {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            say(&row(&file, &name, &oracle[&*name]));
        }
    }
}

fn row(file: &Path, name: &str, o: &Value) -> String {
    let reason = REASONS.iter().find(|(n, _)| *n == name);
    let start = Instant::now();
    let n = match Nominal::read(file) {
        Ok(n) => n,
        Err(e) => {
            let said = e.to_string();
            let said = said
                .split_once(&format!("{name}: "))
                .map_or(&said[..], |s| s.1);
            return format!("| {name} | - | - | - | - | - | - | refused: {said} |");
        }
    };
    let seconds = start.elapsed().as_secs_f64();
    let number = |key: &str| o[key].as_f64().unwrap_or(f64::NAN);
    let wires: f64 = n.wires.iter().map(|w| w.length_mm).sum();
    let area = n.area_mm2() / number("area_mm2") - 1.0;
    // An IGES file bounds each face by itself: Open CASCADE counts an edge with each.
    let times = |faces: usize| {
        if name.contains(".ig") {
            faces as f64
        } else {
            1.0
        }
    };
    let edges = n.edges.iter().map(|e| times(e.faces.len()) * e.length_mm);
    let length = (edges.sum::<f64>() + wires) / number("edge_length_sum_mm") - 1.0;
    let [low, high] = n.bounding_box_mm;
    let mine = [low.to_array(), high.to_array()].concat();
    let theirs = o["bbox_mm"].as_array().cloned().unwrap_or_default();
    let off = mine.iter().zip(&theirs);
    let off = off.map(|(a, b)| (a - b.as_f64().unwrap_or(f64::NAN)).abs());
    let bounds = off.fold(0.0, f64::max) / low.distance(high);
    let faces = n.faces.len() as u64;
    let expected = o["faces"].as_u64().unwrap_or(0);
    let within = faces == expected
        && area.abs() <= AREA_SHARE
        && length.abs() <= LENGTH_SHARE
        && bounds <= LENGTH_SHARE
        && seconds < 2.0;
    let note = match (within, reason) {
        (true, _) => "agrees",
        (false, Some((_, why))) => why,
        (false, None) => "DIFFERS",
    };
    format!(
        "| {name} | {faces}/{expected} | {area:+.1e} | {length:+.1e} | {bounds:.1e} | {seconds:.2} | {} | {note} |",
        n.refused.len()
    )
}

/// A line of the table.
#[allow(clippy::print_stdout)]
fn say(line: &str) {
    println!("{line}");
}
