//! The program as people use it: the demo end to end, its files taken up by the other commands, exit statuses and errors.

#[path = "report/part.rs"]
#[allow(dead_code)] // what the report's tests need beside it
mod part;
#[path = "program/store.rs"]
mod store;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use acies::words::Language;
use serde_json::Value;

fn acies(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_acies"))
        .args(arguments)
        .output()
        .expect("the program runs")
}

/// A new, empty folder.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("program")
        .join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder for the test");
    folder
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn status(output: &Output) -> i32 {
    output.status.code().expect("the program ends by itself")
}

/// The demo, run once for all tests that look at what it leaves.
fn demo() -> &'static (PathBuf, Value) {
    static DEMO: OnceLock<(PathBuf, Value)> = OnceLock::new();
    DEMO.get_or_init(|| {
        let folder = folder("demo");
        let output = acies(&[
            "demo",
            "--seed",
            "3",
            "--json",
            "-o",
            &folder.display().to_string(),
        ]);
        assert_eq!(
            status(&output),
            1,
            "the demo's part is not OK: {}",
            text(&output.stderr)
        );
        let report =
            serde_json::from_slice(&output.stdout).expect("one JSON object on standard output");
        (folder, report)
    })
}

fn edge(report: &Value, entity: u64) -> &Value {
    let edges = report["edges"].as_array().expect("edges");
    edges
        .iter()
        .find(|edge| edge["nominal_entity"] == entity)
        .expect("the edge of the nominal")
}

/// Mean over the measured stations of an edge of one key.
fn mean(edge: &Value, key: &str) -> f64 {
    let stations = edge["stations"].as_array().expect("stations");
    let values: Vec<f64> = stations
        .iter()
        .filter_map(|station| station[key].as_f64())
        .collect();
    assert!(
        values.len() >= 5,
        "{key}: {} stations measured",
        values.len()
    );
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn the_demo_finds_the_defects_that_were_made() {
    let (_, report) = demo();
    assert_eq!(report["schema"], "acies-report/1");
    assert_eq!(report["verdict"], "not_ok");
    assert_eq!(report["alignment"]["status"], "ok");
    // Means over an edge of some thirty stations are good to 2 um; 5 um leaves room for the alignment's own 2 um.
    let near = |found: f64, made_mm: f64, what: &str| {
        assert!(
            (found - made_mm).abs() < 0.005,
            "{what}: {found} mm, made {made_mm} mm"
        );
    };
    near(
        mean(edge(report, 237), "d1_mm"),
        0.060,
        "the wall's offset at its foot",
    );
    near(
        mean(edge(report, 181), "d2_mm"),
        0.060,
        "the wall's offset at its free-form edge",
    );
    near(mean(edge(report, 237), "d2_mm"), 0.0, "the plate's top");
    near(
        mean(edge(report, 420), "d1_mm"),
        0.030,
        "the boss's radius at its rim",
    );
    // The chamfered edge: the virtual edge of its flanks is where the drawing has it.
    near(
        mean(edge(report, 337), "d1_mm"),
        0.0,
        "the chamfered edge, top",
    );
    near(
        mean(edge(report, 337), "d2_mm"),
        0.0,
        "the chamfered edge, side",
    );
    assert_eq!(edge(report, 237)["kind"], "concave");
    let front = edge(report, 314)["coverage"].as_f64().expect("coverage");
    assert!(
        (0.8..0.95).contains(&front),
        "6 mm of 48 were dark: {front}"
    );
    let bottom = edge(report, 580);
    assert_eq!(bottom["coverage"], 0.0, "no profiler sees the table side");
    assert!(bottom["stations"][0]["measured"].is_null());
}

#[test]
fn nothing_was_lost_and_the_instruments_are_named() {
    let (_, report) = demo();
    let losses = &report["scan"]["losses"];
    for cause in [
        "lost_on_link",
        "dropped_by_device",
        "rejected",
        "skipped_bytes",
    ] {
        assert_eq!(losses[cause], 0, "{cause}");
    }
    let devices = report["devices"].as_array().expect("devices");
    let serials: Vec<&str> = devices
        .iter()
        .filter_map(|device| device["serial"].as_str())
        .collect();
    assert_eq!(serials[..2], ["SIM-LEFT", "SIM-RIGHT"]);
    assert_eq!(
        (devices.len(), &report["simulated"], &report["seed"]),
        (3, &true.into(), &3.into())
    );
}

#[test]
fn the_edges_are_found_without_a_nominal_too() {
    let (_, report) = demo();
    assert_eq!(report["missing_edges"], Value::Array(Vec::new()));
    let noise = report["scan"]["noise_mm"].as_f64().expect("noise");
    // Made with 10 um at normal incidence; the faces are seen at up to 60 degrees.
    assert!((0.008..0.020).contains(&noise), "{noise}");
}

#[test]
fn the_demos_files_are_whole() {
    let (folder, _) = demo();
    let html = fs::read_to_string(folder.join("report.html")).expect("the page");
    assert!(html.contains("NOT OK") && !html.contains("http-equiv=\"refresh\""));
    let csv = fs::read_to_string(folder.join("report.csv")).expect("the table");
    assert!(
        csv.lines().count() > 300,
        "a line a station: {}",
        csv.lines().count()
    );
    let scan = fs::read(folder.join("scan.ply")).expect("the scan");
    assert!(scan.starts_with(b"ply\nformat binary_little_endian 1.0\n"));
}

#[test]
fn nothing_of_the_demos_report_is_left_in_english() {
    let (folder, _) = demo();
    let json = fs::read_to_string(folder.join("report.json")).expect("the report");
    let report: acies::report::Report = serde_json::from_str(&json).expect("a report");
    let stations = report.edges.iter().flat_map(|edge| &edge.stations);
    let values = report.edges.iter().flat_map(|edge| &edge.characteristics);
    let said = stations
        .map(|station| &station.reason)
        .chain(values.map(|value| &value.reason))
        .chain(report.corners.iter().map(|corner| &corner.reason))
        .chain(report.gaps.iter().map(|gap| &gap.reason))
        .chain(&report.alignment.weak_directions)
        .chain(&report.findings)
        .chain(report.seconds.keys())
        .filter(|text| !text.is_empty());
    let mut seen = 0;
    for english in said {
        seen += 1;
        let german = Language::De.said(english);
        assert_ne!(&german, english);
        for word in [" the ", " of ", " not ", " and ", " is ", "points"] {
            assert!(!german.contains(word), "{german}");
        }
    }
    assert!(seen > 50, "{seen} sentences");
    let page = report.to_html(Language::De);
    assert!(page.contains("<html lang=\"de\">") && page.contains("Deckungsgrad"));
}

#[test]
fn inspect_finds_the_pose_of_the_demos_scan_from_nothing_and_agrees() {
    let (folder, report) = demo();
    let path = |name: &str| folder.join(name).display().to_string();
    let recipe = path("recipe.toml");
    let arguments = [
        "inspect",
        &path("scan.ply"),
        "--nominal",
        &path("part.step"),
        "--recipe",
        &recipe,
        "--json",
    ];
    let output = acies(&arguments);
    assert_eq!(status(&output), 1, "{}", text(&output.stderr));
    let again: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let wall = (
        mean(edge(&again, 237), "d1_mm"),
        mean(edge(report, 237), "d1_mm"),
    );
    // Without the touches, which weigh little against thousands of points.
    assert!((wall.0 - wall.1).abs() < 0.003, "{wall:?}");
}

#[test]
fn a_device_pulled_out_in_mid_scan_decides_nothing_in_the_parts_favour() {
    let folder = folder("unplugged");
    let output_folder = folder.display().to_string();
    let faults = "unplug-after=60,replug-ms=50";
    let output = acies(&[
        "demo",
        "--perfect",
        "--faults",
        faults,
        "--json",
        "-o",
        &output_folder,
    ]);
    assert_eq!(status(&output), 2, "{}", text(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(report["verdict"], "not_decidable");
    let findings = text(report["findings"].to_string().as_bytes());
    assert!(
        findings.contains("left: lost during the scan"),
        "{findings}"
    );
    assert!(
        text(&output.stderr).contains("lost during the scan"),
        "{}",
        text(&output.stderr)
    );
}

#[test]
fn a_silent_device_is_told_with_what_to_do() {
    let folder = folder("silent");
    let output = acies(&[
        "demo",
        "--faults",
        "silent-after=0",
        "-o",
        &folder.display().to_string(),
    ]);
    assert_eq!(status(&output), 74);
    let told = text(&output.stderr);
    assert!(told.starts_with("acies: device \"left\": "), "{told}");
    assert!(
        told.contains("no answer within") && told.contains("check power and cable"),
        "{told}"
    );
}

/// The exit status and the error of a command on a file with this content.
fn refused(command: &[&str], name: &str, content: &[u8]) -> (i32, String) {
    let path = folder(name).join(name);
    fs::write(&path, content).expect("a file for the test");
    let path = path.display().to_string();
    let arguments: Vec<&str> = command
        .iter()
        .map(|word| if *word == "FILE" { &path } else { *word })
        .collect();
    let output = acies(&arguments);
    (status(&output), text(&output.stderr).replace(&path, name))
}

#[test]
fn scans_that_cannot_be_read_are_refused_with_their_place() {
    let detect = ["detect", "FILE"];
    let (code, told) = refused(&detect, "empty.xyz", b"");
    assert_eq!(code, 65);
    assert!(told.starts_with("acies: empty.xyz: "), "{told}");
    let (code, told) = refused(&detect, "nan.xyz", b"0 0 0\n1 NaN 0\n");
    assert_eq!(code, 65);
    assert!(told.contains("line 2") && told.contains("NaN"), "{told}");
    let header =
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty double x\n\
        property double y\nproperty double z\nend_header\n12345678";
    let (code, told) = refused(&detect, "short.ply", header);
    assert_eq!(code, 65);
    assert!(
        told.contains("1000000000") || told.contains("24000000000"),
        "{told}"
    );
    let (code, told) = refused(&["detect", "FILE", "-o", "out.doc"], "fine.xyz", b"0 0 0\n");
    assert_eq!(code, 64, "{told}");
}

#[test]
fn a_million_identical_points_are_a_finding() {
    let line = "1.5 2.5 3.5\n".repeat(1_000_000);
    let path = folder("same").join("same.xyz");
    fs::write(&path, line).expect("a file for the test");
    let output = acies(&["detect", &path.display().to_string(), "--json"]);
    assert_eq!(status(&output), 0, "{}", text(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(
        (&found["points"], &found["edges"]),
        (&1_000_000.into(), &0.into())
    );
    let findings = found["findings"].to_string();
    assert!(findings.contains("999999"), "{findings}");
}

#[test]
fn nominals_that_cannot_be_read_are_refused_with_the_reason() {
    let step = fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step"))
        .expect("the part");
    let nominal = ["nominal", "FILE"];
    let (code, told) = refused(&nominal, "text.step", b"this is no STEP file\n");
    assert_eq!(code, 65);
    assert!(told.starts_with("acies: text.step: "), "{told}");
    let (code, told) = refused(&nominal, "short.step", &step[..step.len() / 2]);
    assert_eq!(code, 65);
    assert!(told.starts_with("acies: short.step: "), "{told}");
    let missing = text(&step).replacen("#32 = PLANE('',#33)", "#32 = PLANE('',#99999)", 1);
    // One face that refers to nothing is refused by name; the rest of the part is still there.
    let path = folder("missing").join("missing.step");
    fs::write(&path, missing).expect("a file for the test");
    let output = acies(&["nominal", &path.display().to_string(), "--json"]);
    assert_eq!(status(&output), 0, "{}", text(&output.stderr));
    let read: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(
        (&read["faces"], &read["refused"][0]["entity"]),
        (&9.into(), &17.into())
    );
    let reason = read["refused"][0]["reason"].as_str().expect("a reason");
    assert!(reason.contains("#99999"), "{reason}");
}

#[test]
fn devices_and_check_answer_in_json() {
    let output = acies(&["devices", "--json"]);
    assert_eq!(status(&output), 0);
    let found: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert!(
        found["serial"].is_array() && found["usb"].is_array(),
        "{found}"
    );
    let (folder, _) = demo();
    let output = acies(&[
        "check",
        &folder.join("cell.toml").display().to_string(),
        "--json",
    ]);
    assert_eq!(status(&output), 0, "{}", text(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(told["mistakes"], Value::Array(Vec::new()));
    let other = self::folder("check");
    for name in ["cell.toml", "part.step"] {
        fs::copy(folder.join(name), other.join(name)).expect("a copy");
    }
    let recipe = "datum_faces = [5]\n[[edge]]\nentity = 7\nname = \"x\"\n";
    fs::write(other.join("recipe.toml"), recipe).expect("a recipe");
    let output = acies(&["check", &other.join("cell.toml").display().to_string()]);
    assert_eq!(status(&output), 65);
    let told = text(&output.stderr);
    assert!(
        told.contains("datum_faces: #5, expected a face of the nominal"),
        "{told}"
    );
    assert!(
        told.contains("edge: #7, expected a sharp edge of the nominal"),
        "{told}"
    );
    assert_eq!(status(&acies(&["chekc"])), 64);
    assert_eq!(status(&acies(&["--help"])), 0);
}

/// The left profiler of the demo's cell, played under a port of a copy of its configuration.
fn left_profiler(name: &str) -> (PathBuf, acies_simulators::devices::Simulated) {
    let folder = folder(name);
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    for file in ["cell.toml", "recipe.toml", "part.step"] {
        fs::copy(demo.join(file), folder.join(file)).expect("a copy of the demo's files");
    }
    fs::create_dir_all(folder.join("dev")).expect("a folder for the port");
    let place = acies_simulators::devices::Place::Pty(folder.join("dev/ttyLEFT"));
    let device = acies_simulators::devices::start("open-profile", &place, 5, "");
    (folder, device.expect("the simulated profiler starts"))
}

#[test]
fn a_device_is_tried_by_hand_recorded_and_played_back() {
    let (folder, device) = left_profiler("by-hand");
    let cell = folder.join("cell.toml").display().to_string();
    let tried = acies(&["probe", &cell, "--device", "left", "--profiles", "5"]);
    assert_eq!(status(&tried), 0, "{}", text(&tried.stderr));
    assert!(text(&tried.stdout).contains("serial number SIM-LEFT"));
    let output = folder.join("recorded");
    let recorded = acies(&[
        "record",
        &cell,
        "--device",
        "left",
        "--profiles",
        "40",
        "-o",
        &output.display().to_string(),
    ]);
    assert_eq!(status(&recorded), 0, "{}", text(&recorded.stderr));
    let said = text(&recorded.stdout);
    assert!(said.contains("lost on the link 0,"), "{said}");
    // From here on nobody answers: the recording does.
    drop(device);
    let file = fs::read_dir(&output)
        .expect("the folder was made")
        .map(|entry| entry.expect("an entry").path())
        .next()
        .expect("one recording");
    let points = folder.join("points.ply");
    let replayed = acies(&[
        "replay",
        &cell,
        &file.display().to_string(),
        "--device",
        "left",
        "-o",
        &points.display().to_string(),
    ]);
    assert_eq!(status(&replayed), 0, "{}", text(&replayed.stderr));
    let counts = |line: &&str| line.contains("lost on the link");
    let counted = |output: &str| output.lines().find(counts).map(str::to_owned);
    assert!(
        text(&replayed.stdout).starts_with("recorded 20"),
        "it says where it comes from"
    );
    assert_eq!(
        counted(&text(&replayed.stdout)),
        counted(&said),
        "what was recorded is what is played"
    );
    let detected = acies(&["detect", &points.display().to_string(), "--json"]);
    assert_eq!(status(&detected), 0, "{}", text(&detected.stderr));

    let nobody = acies(&["probe", &cell, "--device", "middle"]);
    assert_eq!(status(&nobody), 64);
    assert!(
        text(&nobody.stderr).contains("\"middle\", expected one of \"left\", \"right\", \"probe\"")
    );
    let no_sphere = acies(&[
        "calibrate",
        &cell,
        "--device",
        "left",
        "--radius",
        "12.7",
        "--sphere",
        &format!("{}=1,2,3", file.display()),
    ]);
    assert_eq!(status(&no_sphere), 65);
    assert!(
        text(&no_sphere.stderr).contains("no sphere of radius 12.7 mm"),
        "{}",
        text(&no_sphere.stderr)
    );
}
