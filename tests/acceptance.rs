//! `acies acceptance` on artefacts whose errors are known exactly: from files, and live from a simulated profiler.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::Arc;

use acies_simulators::open_profile::{Setup, SimulatedProfiler};
use acies_simulators::pose::Pose;
use acies_simulators::scene::{Scene, Surfaces};
use acies_simulators::sensor::{Fan, Optics, Traverse, View};
use acies_simulators::wire::Wire;
use glam::DVec3;
use serde_json::Value;

/// SplitMix64, normal by twelve uniform numbers.
struct Numbers(u64);

impl Numbers {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn acies(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_acies"))
        .arg("acceptance")
        .args(arguments)
        .output()
        .expect("the program runs")
}

fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("acceptance")
        .join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder for the test");
    folder
}

fn normal(n: &mut Numbers) -> f64 {
    (0..12).map(|_| n.uniform()).sum::<f64>() - 6.0
}

const SIGMA_MM: f64 = 0.005;

fn cap(centre: DVec3, radius: f64, n: &mut Numbers) -> Vec<DVec3> {
    let points = (0..4000).map(|_| {
        let z = 0.35 + 0.65 * n.uniform();
        let around = std::f64::consts::TAU * n.uniform();
        let r = (1.0 - z * z).sqrt();
        centre + DVec3::new(r * around.cos(), r * around.sin(), z) * (radius + SIGMA_MM * normal(n))
    });
    points.collect()
}

fn write(path: &Path, points: &[DVec3]) -> String {
    let lines: Vec<String> = points
        .iter()
        .map(|p| format!("{} {} {}", p.x, p.y, p.z))
        .collect();
    fs::write(path, lines.join("\n") + "\n").expect("a file");
    path.display().to_string()
}

fn record(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)))
}

fn value(record: &Value, figure: &str) -> (f64, String) {
    let results = record["results"].as_array().expect("results");
    let of = results
        .iter()
        .find(|entry| entry["figure"] == figure)
        .expect("the figure");
    let number = of["value"].as_f64().expect("a number");
    (number, of["verdict"].as_str().expect("a word").to_owned())
}

#[test]
fn known_errors_come_out_and_are_judged() {
    let folder = folder("files");
    let mut n = Numbers(8);
    // Spheres 8 um too large in diameter, 30 um too far apart.
    let mut bar = cap(DVec3::ZERO, 12.504, &mut n);
    bar.extend(cap(DVec3::new(100.03, 0.0, 0.0), 12.504, &mut n));
    let bar = write(&folder.join("bar.xyz"), &bar);
    let mut flat_points = Vec::new();
    for _ in 0..4000 {
        let (x, y) = (40.0 * n.uniform(), 30.0 * n.uniform());
        // A flat that is bent by 20 um from the middle to the ends.
        let bent = 0.02 * ((x - 20.0) / 20.0).powi(2);
        flat_points.push(DVec3::new(x, y, bent + SIGMA_MM * 0.1 * normal(&mut n)));
    }
    let flat = write(&folder.join("flat.xyz"), &flat_points);
    let out = folder.join("record.json").display().to_string();
    let asked = |limit: &str, more: &[&str]| {
        let mut arguments = vec![
            "--distance",
            &bar,
            "--radius",
            "12.5",
            "--length",
            "100",
            "--plane",
            &flat,
            "--noise",
            "0.005",
            "--limit",
            limit,
            "--artefact",
            "ball bar 17, certificate of March",
            "--scanner",
            "left profiler",
        ];
        arguments.extend(more);
        acies(&arguments)
    };
    let output = asked("distance=0.05", &["--json", "-o", &out]);
    assert_eq!(output.status.code(), Some(0));
    let told = record(&output);
    let written: Value = serde_json::from_slice(&fs::read(&out).expect("a record")).expect("JSON");
    assert_eq!(written["results"], told["results"]);
    assert_eq!(told["schema"], "acies-acceptance/1");
    assert_eq!(told["scanner_as_stated"], "left profiler");
    let (distance, verdict) = value(&told, "distance");
    // Centres of 4000 points each of 5 um are known to 0.2 um along the bar; four of that.
    assert!(
        (distance - 0.03).abs() < 1e-3 && verdict == "ok",
        "{distance} {verdict}"
    );
    let (size, verdict) = value(&told, "sphere-size");
    assert!(
        (size - 0.008).abs() < 1e-3 && verdict == "undefined",
        "{size} {verdict}"
    );
    // A parabola of 20 um over a uniform x leaves 95 % of its height but for what the mean plane takes: the quantiles of u^2, u uniform
    // in -1..1, at 2.5 and 97.5 % are 0.0006 and 0.951; noise of 0.5 um adds next to nothing.
    let (form, _) = value(&told, "plane-form-95");
    assert!((form - 0.019).abs() < 1e-3, "{form}");
    assert_eq!(asked("distance=0.02", &[]).status.code(), Some(1));
    // Of a certificate good to 20 um nothing can be said about a limit of 40.
    assert_eq!(
        asked("distance=0.04", &["--u-certified", "0.02"])
            .status
            .code(),
        Some(2)
    );
    let table = String::from_utf8(asked("distance=0.02", &[]).stdout).expect("text");
    assert!(
        table.contains("left profiler; ball bar 17, certificate of March; "),
        "{table}"
    );
    let line = table
        .lines()
        .find(|line| line.starts_with("distance "))
        .expect("the line");
    assert!(line.contains("+0.0") && line.contains("NOT OK"), "{line}");
    assert!(table.contains("no test to any of them") && table.contains("ISO 10360-102"));
}

#[test]
fn what_makes_no_sense_is_told() {
    let folder = folder("wrong");
    let flat = write(&folder.join("flat.xyz"), &[DVec3::ZERO, DVec3::X, DVec3::Y]);
    let told = |arguments: &[&str]| {
        let output = acies(arguments);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code(), text)
    };
    let (code, text) = told(&[]);
    assert!(
        code == Some(64) && text.contains("no artefact, expected one of"),
        "{text}"
    );
    let (code, text) = told(&["--plane", &flat]);
    assert!(
        code == Some(65) && text.contains("3 points on the flat, expected at least 100"),
        "{text}"
    );
    let (code, text) = told(&["--sphere", &flat]);
    assert!(code == Some(64) && text.contains("--radius"), "{text}");
    let (code, text) = told(&["--sphere", "live", "--radius", "10"]);
    assert!(
        code == Some(64) && text.contains("expected --cell"),
        "{text}"
    );
    let (code, text) = told(&["--plane", &flat, "--limit", "roundness=1"]);
    assert!(
        code == Some(64) && text.contains("sphere-form-95"),
        "{text}"
    );
}

/// A sphere of 15 mm under a profiler that looks straight down.
fn view(centre: DVec3, radius_mm: f64) -> View {
    let mut surfaces = Surfaces::default();
    let (sphere, _) = surfaces.sphere("sphere", centre, radius_mm);
    let down = Pose::turn_about(DVec3::ZERO, DVec3::X, std::f64::consts::PI);
    View {
        scene: Arc::new(Scene::new(surfaces, sphere)),
        machine_from_scene: Pose::IDENTITY,
        machine_from_sensor: Pose::shift(DVec3::Z * 110.0).after(down),
        optics: Optics {
            near_mm: 60.0,
            far_mm: 140.0,
            width_mm: 40.0,
            fan: Fan::Parallel,
            camera_mm: DVec3::new(0.0, 40.0, 0.0),
            spot_mm: 0.0,
            blend_mm: 0.5,
            noise_mm: SIGMA_MM,
            drop_out: 0.0,
            incidence_limit_rad: 1.1,
            outliers: 0.0,
        },
        traverse: Traverse {
            axis: DVec3::Y,
            mm_per_count: 0.001,
            first_count: 0,
            step_counts: 200,
            profiles: 221,
        },
        columns: 200,
        seed: 3,
    }
}

const CELL: &str = r#"name = "artefact"
[part]
nominal = "part.step"
[part.machine_from_part]
origin_mm = [0, 0, 0]
x_axis = [1, 0, 0]
z_axis = [0, 0, 1]
[stage]
travel_mm_per_count = [0, 0.001, 0]
end_count = 43000
[[device]]
name = "left"
driver = "open-profile"
address = "ADDRESS"
columns = 200
[device.calibration]
origin_mm = [0, 0, 110]
x_axis = [1, 0, 0]
z_axis = [0, 0, -1]
"#;

#[test]
fn a_live_device_names_itself_in_the_record() {
    let folder = folder("live");
    fs::write(folder.join("part.step"), "ISO-10303-21;").expect("a file");
    // 12 um larger in diameter than its certificate says.
    let view = view(DVec3::new(1.0, 21.0, 5.0), 15.006);
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let device = SimulatedProfiler::start(wire, view, Setup::new("SIM-7", 2)).expect("a device");
    let cell = folder.join("cell.toml");
    fs::write(&cell, CELL.replace("ADDRESS", device.port())).expect("a cell");
    let cell = cell.display().to_string();
    let output = acies(&[
        "--sphere",
        "live",
        "--radius",
        "15",
        "--cell",
        &cell,
        "--noise",
        "0.005",
        "--limit",
        "sphere-size=0.05",
        "--json",
    ]);
    let told = record(&output);
    assert_eq!(output.status.code(), Some(0), "{told}");
    assert_eq!(told["scanner"]["serial"], "SIM-7");
    let (size, verdict) = value(&told, "sphere-size");
    let u = told["results"][0]["u"].as_f64().expect("a number");
    // Counts of 2 um and half a count of the encoder are far below the noise; noise along the ray at a slant adds a little to the form.
    assert!(
        (size - 0.012).abs() < 4.0 * u && u < 0.002 && verdict == "ok",
        "{size} {u} {verdict}"
    );
    let (form, _) = value(&told, "sphere-form-95");
    assert!((3.0 * SIGMA_MM..8.0 * SIGMA_MM).contains(&form), "{form}");
}
