//! The figures of alignment: success over many starts, wrong poses called good, pose error, seconds.
//!
//! `cargo bench --bench alignment -- MODE...` with the modes `rough` (start off by 20 degrees and half the diagonal), `auto` (from nothing),
//! `side` (one side of the part only, rough and from nothing), `wrong` (scans of other and of mirrored parts) and `million` (1,000,000
//! points by stage); `rough auto` by default. `starts N` sets the starts of every part (10 by default; the figure has 100), `points N` the points.
//! Parts are nominals of the demo and of `../shared/data`; those that are absent are skipped, said aloud. Noise is a tenth of the spacing, and
//! errors are given as at a spacing of 0.26 mm beside those of the peers (small_gicp 0.00021 mm in 2.6 s, GICP 0.00013, Open3D 0.00017).

#![allow(clippy::print_stdout)]

use std::path::{Path, PathBuf};
use std::time::Instant;

use acies::geometry::RigidTransform;
use acies::inspect::align::{AlignOptions, Aligned, Conclusion, Scan, Start, align};
use acies::inspect::assign::Surface;
use acies::nominal::{Nominal, SurfaceSample};
use acies::points::{Frame, Neighbors, Origin, PointCloud, Spacing, View, noise_mm, spacing};
use glam::{DMat3, DVec3};
use nalgebra::{Matrix6, Vector6};

#[allow(dead_code, reason = "the scans of exact solids serve the tests")]
#[path = "../tests/inspect/solids.rs"]
mod solids;

use solids::Noise;

/// Plane and cylinder parts, castings with fillets and free-form faces, with and without near symmetries.
const PARTS: [&str; 6] = [
    "configs/demo/part.step",
    "../shared/data/step/nist_ctc_01_asme1_ap242-e1.stp",
    "../shared/data/step/nist_ctc_03_asme1_ap242-e2.stp",
    "../shared/data/step/nist_ftc_06_asme1_ap242-e2.stp",
    "../shared/data/step/netgen_frame.step",
    "../shared/data/step/pyocc_face_recognition_sample_part.stp",
];

/// The spacing of the peers' figures, mm.
const PEER_SPACING_MM: f64 = 0.26;

/// Starts that one cloud serves; then the noise is drawn anew: the error of the pose is that of the cloud, whatever the start.
const STARTS_OF_A_CLOUD: usize = 4;

struct Settings {
    starts: usize,
    points: usize,
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let number = |name: &str, otherwise: usize| {
        let at = words.iter().position(|w| w == name);
        at.and_then(|i| words.get(i + 1)?.parse().ok())
            .unwrap_or(otherwise)
    };
    let settings = Settings {
        starts: number("starts", 10),
        points: number("points", 500_000),
    };
    let only = words.iter().position(|w| w == "part");
    let only = only.and_then(|i| words.get(i + 1)).cloned();
    let modes = ["rough", "auto", "side", "wrong", "million"];
    let mut wanted: Vec<&str> = modes
        .into_iter()
        .filter(|m| words.iter().any(|w| w == m))
        .collect();
    if wanted.is_empty() {
        wanted = vec!["rough", "auto"];
    }
    let parts: Vec<(String, Nominal)> = PARTS
        .into_iter()
        .filter(|p| only.as_ref().is_none_or(|o| p.contains(o.as_str())))
        .filter_map(read)
        .collect();
    for mode in wanted {
        match mode {
            "wrong" => wrong(&parts, &settings),
            "million" => parts.iter().for_each(million),
            _ => {
                println!(
                    "\n{mode}: part, starts, good, wrong called good, rms error um (at 0.26 mm; as its covariance states it; no estimator is below the bound), s align, s tree + noise, others"
                );
                for (name, nominal) in &parts {
                    figure(mode, name, nominal, &settings);
                }
            }
        }
    }
}

fn read(name: &str) -> Option<(String, Nominal)> {
    let path: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join(name);
    match Nominal::read(&path) {
        Ok(nominal) => {
            let stem = path.file_stem()?.to_string_lossy().into_owned();
            Some((stem, nominal))
        }
        Err(error) => {
            println!("skipped: {error}");
            None
        }
    }
}

/// A noisy cloud, as good as `points` points, of what `seen` lets through; in the machine frame, with the truth.
struct Made {
    cloud: PointCloud,
    part_from_machine: RigidTransform,
    spacing_mm: f64,
    /// Root mean square displacement below which no estimator comes that uses all points, mm (Cramer and Rao, for the noise as drawn).
    bound_mm: f64,
}

fn make(nominal: &Nominal, points: usize, seed: u64, side: Option<DVec3>, mirrored: bool) -> Made {
    let mut noise = Noise(seed);
    let area: f64 = nominal.faces.iter().map(|f| f.area_mm2()).sum();
    let spacing_mm = (area / points as f64).sqrt();
    let sigma = 0.1 * spacing_mm;
    let kept = |s: &SurfaceSample| side.is_none_or(|d| s.normal.dot(d) > 0.3);
    let turn = 2.0 * noise.uniform();
    let machine_from_part = noise.motion(turn, 500.0);
    let flip = DMat3::from_diagonal(DVec3::new(if mirrored { -1.0 } else { 1.0 }, 1.0, 1.0));
    let mut positions = Vec::new();
    let mut information = Matrix6::zeros();
    for s in Nominal::samples(nominal, spacing_mm)
        .iter()
        .filter(|s| kept(s))
    {
        // Off the lattice of the samples, in the face's plane.
        let (a, b) = s.normal.any_orthonormal_pair();
        let shifted = s.point
            + 0.2 * spacing_mm * ((noise.uniform() - 0.5) * a + (noise.uniform() - 0.5) * b);
        let at = nominal.faces[s.face as usize]
            .foot(shifted, Some(s.uv))
            .map_or(s.point, |f| f.point);
        positions.push(machine_from_part.point(flip * (at + sigma * noise.normal() * s.normal)));
        let turn = at.cross(s.normal);
        let row = Vector6::new(turn.x, turn.y, turn.z, s.normal.x, s.normal.y, s.normal.z);
        information += row * row.transpose() / (sigma * sigma);
    }
    let mut cloud = PointCloud::from_positions(Frame::Machine, positions);
    if let Some(direction) = side {
        cloud.views.push(View {
            device: "bench".to_string(),
            towards_sensor: machine_from_part.vector(flip * direction),
        });
        cloud.origins = (0..cloud.positions.len())
            .map(|i| Origin {
                view: 0,
                column: 0,
                profile: i as u32,
            })
            .collect();
    }
    Made {
        cloud,
        part_from_machine: machine_from_part.inverse(),
        spacing_mm,
        bound_mm: information
            .try_inverse()
            .map_or(f64::INFINITY, |covariance| {
                displacement_of(&covariance, nominal)
            }),
    }
}

/// Root mean square displacement of the part's box under a pose of this covariance, mm.
fn displacement_of(covariance: &Matrix6<f64>, nominal: &Nominal) -> f64 {
    let variance = places(nominal).map(|c| {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|n| {
            let turn = c.cross(n);
            let row = Vector6::new(turn.x, turn.y, turn.z, n.x, n.y, n.z);
            (row.transpose() * covariance * row)[0]
        });
        axes.iter().sum::<f64>()
    });
    (variance.iter().sum::<f64>() / 8.0).sqrt()
}

/// Eight places that stand for the points of the part's box: half way to its corners, as far as their root mean square.
fn places(nominal: &Nominal) -> [DVec3; 8] {
    let [low, high] = nominal.faces_box_mm;
    std::array::from_fn(|k| {
        let pick = |bit: usize, a: f64, b: f64| if k & bit == 0 { a } else { b };
        let c = DVec3::new(
            pick(1, low.x, high.x),
            pick(2, low.y, high.y),
            pick(4, low.z, high.z),
        );
        0.5 * (low + high) + 0.577 * (c - 0.5 * (low + high))
    })
}

/// Root mean square displacement of the part's box that an error of the pose makes, mm.
fn displacement(found: &RigidTransform, truth: &RigidTransform, nominal: &Nominal) -> f64 {
    let motion = *found * truth.inverse();
    let moved = |c: &DVec3| (motion.point(*c) - *c).length_squared();
    let sum: f64 = places(nominal).iter().map(moved).sum();
    (sum / 8.0).sqrt()
}

/// Processor time of all threads so far: what other programs on the machine take is not in it.
fn cpu_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields = text.rsplit(')').next().unwrap_or_default();
    let ticks = fields.split_whitespace().skip(11).take(2);
    ticks.filter_map(|t| t.parse::<f64>().ok()).sum::<f64>() / 100.0
}

fn scan_of<'a>(made: &'a Made, neighbors: &'a Neighbors) -> Scan<'a> {
    let spacing = spacing(&made.cloud, neighbors);
    Scan {
        cloud: &made.cloud,
        neighbors,
        spacing,
        noise_mm: noise_mm(&made.cloud, neighbors, &spacing),
    }
}

/// A start off by 20 degrees about the middle and by half the diagonal.
fn off(truth: &RigidTransform, nominal: &Nominal, noise: &mut Noise) -> RigidTransform {
    let [low, high] = nominal.faces_box_mm;
    let middle = 0.5 * (low + high);
    let motion = noise.motion(20f64.to_radians(), 0.5 * (high - low).length());
    let about = RigidTransform::new(
        motion.rotation,
        middle - motion.rotation * middle + motion.translation,
    );
    about * *truth
}

fn figure(mode: &str, name: &str, nominal: &Nominal, settings: &Settings) {
    let surface = Surface::new(nominal);
    let starts = if mode == "side" {
        vec!["rough", "auto"]
    } else {
        vec![mode]
    };
    for start_mode in starts {
        let mut tally = Tally::default();
        let mut noise = Noise(77);
        let mut made: Option<(Made, Neighbors, Spacing, f64)> = None;
        for k in 0..settings.starts {
            if k % STARTS_OF_A_CLOUD == 0 {
                let side = (mode == "side").then(|| noise.direction());
                let new = make(nominal, settings.points, k as u64 + 1, side, false);
                let clock = Instant::now();
                let neighbors = Neighbors::new(&new.cloud.positions);
                let scan = scan_of(&new, &neighbors);
                tally.before.push(clock.elapsed().as_secs_f64());
                let (spacing, noise_mm) = (scan.spacing, scan.noise_mm);
                made = Some((new, neighbors, spacing, noise_mm));
            }
            let Some((made, neighbors, spacing, noise_mm)) = &made else {
                continue;
            };
            let scan = Scan {
                cloud: &made.cloud,
                neighbors,
                spacing: *spacing,
                noise_mm: *noise_mm,
            };
            let start = match start_mode {
                "auto" => Start::Auto,
                _ => Start::Rough(off(&made.part_from_machine, nominal, &mut noise)),
            };
            let clock = (Instant::now(), cpu_seconds());
            let aligned = align(&scan, &surface, start, &AlignOptions::default());
            tally.seconds.push(clock.0.elapsed().as_secs_f64());
            tally.cpu.push(cpu_seconds() - clock.1);
            tally.take_in(&aligned, made, nominal);
        }
        tally.print(&format!("{start_mode} {name}"));
    }
}

#[derive(Default)]
struct Tally {
    seconds: Vec<f64>,
    cpu: Vec<f64>,
    before: Vec<f64>,
    good: usize,
    wrong: usize,
    squares: f64,
    bounds: f64,
    stated: f64,
    used: f64,
    others: Vec<String>,
}

impl Tally {
    fn take_in(&mut self, aligned: &Aligned, made: &Made, nominal: &Nominal) {
        let pose = &aligned.alignment.part_from_machine;
        let error = displacement(pose, &made.part_from_machine, nominal);
        if aligned.conclusion == Conclusion::Good {
            // A tenth of the spacing: a hundred times the error that noise leaves.
            if error < 0.1 * made.spacing_mm {
                self.good += 1;
                self.squares += (error * PEER_SPACING_MM / made.spacing_mm).powi(2);
                let covariance = Matrix6::from_fn(|i, j| aligned.alignment.covariance[i][j]);
                let stated = displacement_of(&covariance, nominal);
                self.stated += (stated * PEER_SPACING_MM / made.spacing_mm).powi(2);
                self.used += aligned.alignment.points as f64 / made.cloud.positions.len() as f64;
                self.bounds += (made.bound_mm * PEER_SPACING_MM / made.spacing_mm).powi(2);
            } else {
                self.wrong += 1;
                self.others.push(format!("WRONG by {error:.3} mm"));
            }
        } else {
            self.others.push(format!(
                "{:?} (off {error:.4} mm): {}",
                aligned.conclusion,
                aligned.findings.join(" | ")
            ));
        }
    }

    fn print(&self, name: &str) {
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        println!(
            "{name}: {} starts, {} good, {} wrong, {:.3} um (stated {:.3}, bound {:.3}; {:.0} % of the points), {:.2} s (worst {:.2}; of a processor {:.2}), {:.2} s",
            self.seconds.len(),
            self.good,
            self.wrong,
            1e3 * (self.squares / self.good.max(1) as f64).sqrt(),
            1e3 * (self.stated / self.good.max(1) as f64).sqrt(),
            1e3 * (self.bounds / self.good.max(1) as f64).sqrt(),
            100.0 * self.used / self.good.max(1) as f64,
            mean(&self.seconds),
            self.seconds.iter().copied().fold(0.0, f64::max),
            mean(&self.cpu),
            mean(&self.before),
        );
        let mut seen: Vec<(&String, usize)> = Vec::new();
        for other in &self.others {
            match seen.iter_mut().find(|s| s.0 == other) {
                Some(s) => s.1 += 1,
                None => seen.push((other, 1)),
            }
        }
        for (text, count) in seen.iter().take(4) {
            println!("    {count} x {text}");
        }
    }
}

/// Scans of the mirrored part, and of the other parts, scaled to the same size by their own nominal.
fn wrong(parts: &[(String, Nominal)], settings: &Settings) {
    println!("\nwrong: nominal, scan, conclusion");
    for (k, (name, nominal)) in parts.iter().enumerate() {
        let surface = Surface::new(nominal);
        let size = |n: &Nominal| (n.faces_box_mm[1] - n.faces_box_mm[0]).length();
        for (j, (other_name, other)) in parts.iter().enumerate() {
            let mut made = make(other, settings.points.min(100_000), 5, None, j == k);
            let scale = size(nominal) / size(other);
            made.cloud.positions.iter_mut().for_each(|p| *p *= scale);
            let neighbors = Neighbors::new(&made.cloud.positions);
            let aligned = align(
                &scan_of(&made, &neighbors),
                &surface,
                Start::Auto,
                &AlignOptions::default(),
            );
            let what = if j == k {
                "its mirror image"
            } else {
                other_name
            };
            println!(
                "{name}, {what}: {:?}, {}",
                aligned.conclusion,
                aligned.findings.first().map_or("", String::as_str)
            );
        }
    }
}

/// Seconds by stage for a million points.
fn million((name, nominal): &(String, Nominal)) {
    let made = make(nominal, 1_000_000, 1, None, false);
    let clock = Instant::now();
    let neighbors = Neighbors::new(&made.cloud.positions);
    let tree = clock.elapsed().as_secs_f64();
    let clock = Instant::now();
    let scan = scan_of(&made, &neighbors);
    let noise = clock.elapsed().as_secs_f64();
    let clock = Instant::now();
    let surface = Surface::new(nominal);
    let ready = clock.elapsed().as_secs_f64();
    let start = off(&made.part_from_machine, nominal, &mut Noise(3));
    let clock = Instant::now();
    let aligned = align(
        &scan,
        &surface,
        Start::Rough(start),
        &AlignOptions::default(),
    );
    let seconds = clock.elapsed().as_secs_f64();
    let pose = aligned.alignment.part_from_machine;
    let part = made
        .cloud
        .map(Frame::Part, |p| pose.point(p), |v| pose.vector(v));
    let clock = Instant::now();
    let [low, high] = nominal.faces_box_mm;
    let places = surface.places(&part, 0.05 * (high - low).length());
    println!(
        "{name}: {} points, tree {tree:.2} s, spacing and noise {noise:.2} s, nominal's cells {ready:.2} s, align {seconds:.2} s, faces of all \
         points {:.2} s ({} on none)",
        part.positions.len(),
        clock.elapsed().as_secs_f64(),
        places
            .iter()
            .filter(|p| p.face == acies::inspect::assign::NO_FACE)
            .count()
    );
}
