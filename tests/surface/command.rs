//! `acies reconstruct` from outside: its file, its JSON, its refusals.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use acies::points::{Unit, read, write_xyz};
use serde_json::Value;

use super::figures;

fn folder() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("surface");
    std::fs::create_dir_all(&folder).expect("a folder");
    folder
}

/// A clean cube with hole of about 2,600 points, as a file.
fn scan(name: &str) -> (PathBuf, figures::Trial) {
    let trial = figures::cube_trial(20, 0.0);
    let path = folder().join(name);
    write_xyz(&path, &figures::cloud_of(&trial.seen).positions, &[]).expect("a written scan");
    (path, trial)
}

fn run(scan: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_acies"));
    command.arg("reconstruct").arg(scan).arg("--json");
    command.args(arguments).output().expect("the program runs")
}

fn json(output: &Output) -> Value {
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{text}");
    serde_json::from_slice(&output.stdout).expect("one JSON object")
}

#[test]
fn the_file_has_the_scans_points_in_order_and_then_the_edges() {
    let (path, trial) = scan("edges.xyz");
    let out = folder().join("edges.ply");
    let said = json(&run(
        &path,
        &["-o", out.to_str().expect("a name"), "--edges"],
    ));
    let samples = said["edge_samples"].as_u64().expect("a count") as usize;
    assert!(samples > 100, "{said}");
    assert_eq!(said["projected"], trial.seen.len(), "{said}");
    let back = read(&out, Unit::Millimetre)
        .expect("our own file")
        .cloud
        .positions;
    assert_eq!(back.len(), trial.seen.len() + samples);
    for (seen, at) in trial.seen.iter().zip(&back) {
        // Text keeps all digits; so coarse a cube moves by a hundredth of the spacing in its hole.
        assert!(seen.clean.distance(*at) < 0.05 * trial.unit_mm, "{at}");
    }
    for line in &back[trial.seen.len()..] {
        assert!(
            trial.body.edge_distance(*line) < 0.1 * trial.unit_mm,
            "{line}"
        );
    }
    let bytes = std::fs::read(&out).expect("our own file");
    let header = String::from_utf8_lossy(&bytes[..600]).into_owned();
    let names: Vec<&str> = (header.lines())
        .take_while(|l| *l != "end_header")
        .filter_map(|l| l.strip_prefix("property "))
        .collect();
    let expected =
        ["x", "y", "z", "nx", "ny", "nz", "mx", "my", "mz"].map(|n| format!("double {n}"));
    assert_eq!(names[..9], expected);
    assert_eq!(names[9..], ["uchar projected", "uchar feature"]);
}

#[test]
fn every_method_runs_and_only_ours_knows_edges() {
    let (path, trial) = scan("methods.xyz");
    for method in [
        "sharp",
        "smooth",
        "thesis",
        "apss",
        "rimls",
        "plane",
        "weighted-plane",
    ] {
        let said = json(&run(&path, &["--method", method]));
        assert_eq!(said["points_out"], trial.seen.len(), "{method}: {said}");
        let part = said["projected"].as_f64().expect("a count") / trial.seen.len() as f64;
        assert!(part > 0.95, "{method}: {said}");
        let on_edges = said["on_edges"].as_u64().expect("a count");
        assert_eq!(on_edges > 0, method == "sharp", "{method}: {said}");
    }
    let smooth = json(&run(&path, &["--smooth"]));
    let moved = |v: &Value| v["moved_rms_mm"].as_f64().expect("a length");
    let named = json(&run(&path, &["--method", "smooth"]));
    assert_eq!(moved(&smooth), moved(&named));
    let plane = json(&run(&path, &["--method", "smooth", "--degree", "1"]));
    assert!(
        moved(&plane) > 0.0 && moved(&plane) != moved(&smooth),
        "the degree counts"
    );
}

#[test]
fn a_smoothing_that_is_no_length_is_refused_as_usage() {
    let (path, _) = scan("refused.xyz");
    let output = run(&path, &["--smoothing", "0"]);
    assert_eq!(output.status.code(), Some(64));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        text.contains("--smoothing: 0, expected a length above 0 mm"),
        "{text}"
    );
}
