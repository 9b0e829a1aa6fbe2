//! How honest the demo's uncertainties are: reported minus true deviation over reported standard uncertainty, over many seeds.
//!
//! `cargo bench --bench honesty [-- SEEDS] [afterwards] [stations]`: as measured while the scan runs, or all points at once after it; with a
//! table of every station of every edge. The truth is the scene's, which the measuring side never sees. Aim: root mean square
//! 0.8 to 1.2, and 93 to 97 % within 2.

#![allow(clippy::print_stdout, reason = "its table is what it is for")]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use acies::cell::{self, Outcome};
use acies::config::Cell;
use acies::inspect::{Request, Start};
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::DemoCell;
use acies_simulators::scene;

/// Errors over uncertainties of one quantity.
#[derive(Default)]
struct Scores {
    z: Vec<f64>,
}

impl Scores {
    fn rms(&self) -> f64 {
        (self.z.iter().map(|z| z * z).sum::<f64>() / self.z.len() as f64).sqrt()
    }

    fn mean(&self) -> f64 {
        self.z.iter().sum::<f64>() / self.z.len() as f64
    }

    fn within_2(&self) -> f64 {
        100.0 * self.z.iter().filter(|z| z.abs() <= 2.0).count() as f64 / self.z.len() as f64
    }
}

/// d1, d2 and included angle of one edge.
type EdgeScores = [Scores; 3];

fn main() {
    let number = std::env::args()
        .skip(1)
        .find_map(|argument| argument.parse().ok());
    let seeds: u64 = number.unwrap_or(20);
    let mut stations: BTreeMap<(u64, usize), EdgeScores> = BTreeMap::new();
    let (mut profiles, mut scanning, mut deciding) = (0, 0.0, Vec::new());
    for seed in 1..=seeds {
        let part = DemoCell::new(seed);
        let outcome = inspect(&part, seed);
        profiles += outcome
            .scan
            .views
            .iter()
            .map(|view| view.losses.received)
            .sum::<u64>();
        scanning += outcome.scan_seconds;
        deciding.push(outcome.verdict_seconds);
        score(&part, &outcome, &mut stations);
    }
    if std::env::args().any(|argument| argument == "stations") {
        for ((entity, k), scores) in &stations {
            let columns = scores.each_ref().map(column);
            println!("#{entity} station {k:>3} {}", columns.join(" "));
        }
    }
    print(&stations, seeds);
    deciding.sort_by(f64::total_cmp);
    println!(
        "{:.0} profiles a second sustained, last profile to verdict {:.2} s (median)",
        profiles as f64 / scanning,
        deciding[deciding.len() / 2]
    );
}

/// Runs the demo's cell, from the bytes on its pseudo-terminals to the verdict.
fn inspect(part: &DemoCell, seed: u64) -> Outcome {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("honesty-{seed}"));
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
    std::fs::create_dir_all(folder.join("dev")).expect("a folder for the ports");
    for name in ["cell.toml", "recipe.toml", "part.step"] {
        std::fs::copy(demo.join(name), folder.join(name)).expect("a copy of the demo's files");
    }
    let _playing = part.start(&folder.join("dev")).expect("simulated devices");
    let cell = Cell::read(&folder.join("cell.toml")).expect("the demo's cell is sound");
    let began = Instant::now();
    let mut outcome = cell::run(&cell, &Cable, &mut |_| {}).expect("the demo's cell runs");
    if std::env::args().any(|argument| argument == "afterwards") {
        let start = Start::Rough(cell.machine_from_part.inverse());
        let request = Request {
            touches: &outcome.touches,
            ..Request::new(&outcome.part.recipe, start)
        };
        let (cloud, nominal) = (&outcome.scan.cloud, &outcome.part.nominal);
        outcome.inspection = acies::inspect::inspect(cloud, nominal, &request);
    }
    eprintln!("seed {seed}: {:.1} s", began.elapsed().as_secs_f64());
    outcome
}

fn score(part: &DemoCell, outcome: &Outcome, stations: &mut BTreeMap<(u64, usize), EdgeScores>) {
    for edge in &outcome.inspection.edges {
        for (k, station) in edge.stations.iter().enumerate() {
            let own = stations.entry((edge.nominal_entity, k)).or_default();
            let Some(measured) = &station.measured else {
                continue;
            };
            let nominal = &station.station;
            let place = scene::Station {
                point: nominal.point,
                tangent: nominal.tangent,
                normals: nominal.normals,
            };
            let truth = part
                .part
                .truth(&place)
                .expect("a nominal edge has a true one");
            let [u1, u2] = measured.u_d_mm;
            let angle_error = measured.included_angle_rad - truth.included_angle_rad;
            let z = [
                (measured.d_mm[0] - truth.d1_mm) / u1,
                (measured.d_mm[1] - truth.d2_mm) / u2,
                angle_error / measured.u_included_angle_rad,
            ];
            for (scores, z) in own.iter_mut().zip(z) {
                scores.z.push(z);
            }
        }
    }
}

fn print(stations: &BTreeMap<(u64, usize), EdgeScores>, seeds: u64) {
    println!(
        "{seeds} seeds; rms of error over u (and mean), and share within 2 u (aim 0.8 to 1.2, 93 to 97 %)"
    );
    println!(
        "{:>6} {:>8} {:>24} {:>24} {:>24}",
        "edge", "stations", "d1", "d2", "angle"
    );
    let mut edges: BTreeMap<u64, EdgeScores> = BTreeMap::new();
    let mut all = EdgeScores::default();
    for ((entity, _), scores) in stations {
        let edge = edges.entry(*entity).or_default();
        for (sum, one) in edge
            .iter_mut()
            .chain(&mut all)
            .zip(scores.iter().chain(scores))
        {
            sum.z.extend(&one.z);
        }
    }
    for (entity, scores) in &edges {
        let columns = scores.each_ref().map(column);
        println!(
            "{:>6} {:>8} {}",
            format!("#{entity}"),
            scores[0].z.len(),
            columns.join(" ")
        );
    }
    println!(
        "{:>6} {:>8} {}",
        "all",
        all[0].z.len(),
        all.each_ref().map(column).join(" ")
    );
}

fn column(scores: &Scores) -> String {
    if scores.z.is_empty() {
        return format!("{:>24}", "not measured");
    }
    format!(
        "{:>7.2} ({:>5.2}) {:>6.1} %",
        scores.rms(),
        scores.mean(),
        scores.within_2()
    )
}
