//! Reconstruction on bodies whose surface is known: distances, normals and times, beside what other programs reach.
//!
//! `cargo bench --bench reconstruction` prints the tables; `-- quick` leaves out the large clouds.

#![allow(clippy::print_stdout)]

#[path = "../tests/surface/figures.rs"]
mod figures;
#[path = "../tests/surface/truth.rs"]
mod truth;

use acies::surface::Settings;
use figures::Trial;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let quick = arguments.iter().any(|a| a == "quick");
    let mut trials = vec![
        figures::cube_trial(52, 0.0),
        figures::cube_trial(52, 0.8),
        figures::cube_trial(52, 2.0),
        figures::block_trial(if quick { 60_000 } else { 500_000 }),
        figures::lines_trial(if quick { 1.5 } else { 0.6 }),
    ];
    if arguments.iter().any(|a| a == "hard") {
        trials.clear();
        trials.push(figures::cube_trial(30, 0.0));
        trials.push(figures::cube_trial(24, 0.0));
        for angle in [172.0, 165.0, 150.0, 120.0, 60.0, 40.0, 25.0] {
            trials.push(figures::body_trial(
                &format!("ridge {angle}"),
                truth::ridge(angle),
                8_000,
                0.1,
            ));
        }
        for gap in [0.3, 0.6, 1.0, 2.0] {
            let unit = (800.0f64 / 8_000.0).sqrt();
            trials.push(figures::body_trial(
                &format!("plates {gap}"),
                truth::plates(gap * unit),
                8_000,
                0.05,
            ));
        }
        for width in [2.0, 4.0, 6.0] {
            let unit = 0.25;
            trials.push(figures::body_trial(
                &format!("slot {width}"),
                truth::slot(width * unit, width * unit),
                8_000,
                0.1,
            ));
        }
        trials.push(figures::body_trial(
            "block clean",
            truth::stepped_block(),
            60_000,
            0.0,
        ));
        trials.push(figures::body_trial(
            "block 0.3",
            truth::stepped_block(),
            60_000,
            0.3,
        ));
        trials.push(figures::body_trial(
            "block coarse",
            truth::stepped_block(),
            4_000,
            0.1,
        ));
    }
    if let Some(only) = arguments.iter().find_map(|a| a.strip_prefix("only=")) {
        trials.retain(|t| t.name.contains(only));
    }
    println!(
        "{:<34}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>7}{:>7}{:>7}{:>8}{:>8}{:>7}{:>8}{:>7}",
        "cloud",
        "in flat",
        "in edge",
        "flat",
        "edge",
        "gap own",
        "gap",
        "worst",
        "proj",
        "n flat",
        "n edge",
        "n meas",
        "line",
        "l worst",
        "lines",
        "seconds",
        "ratio"
    );
    for trial in &trials {
        row(trial);
    }
}

fn row(trial: &Trial) {
    let cloud = figures::cloud_of(&trial.seen);
    let neighbors = acies::points::Neighbors::new(&cloud.positions);
    let search = neighbour_search(&cloud.positions, &neighbors, 20);
    let start = std::time::Instant::now();
    let result = acies::surface::reconstruct(&cloud, &neighbors, Settings::default())
        .expect("enough points");
    let seconds = start.elapsed().as_secs_f64();
    let search = 0.5 * (search + neighbour_search(&cloud.positions, &neighbors, 20));
    let f = trial.figures(&result);
    if std::env::var_os("DEBUG").is_some() {
        let mut by: std::collections::BTreeMap<(usize, usize), usize> = Default::default();
        for (i, p) in trial.seen.iter().enumerate() {
            if !result.projected[i] {
                *by.entry((
                    p.face,
                    (trial.body.edge_distance(p.clean) / trial.unit_mm).floor() as usize,
                ))
                .or_default() += 1;
            }
        }
        println!("{by:?}");
        for l in &result.lines {
            let d = trial.body.edge_distance(l.position) / trial.unit_mm;
            if d > 0.5 {
                println!(
                    "line {:?} {:?} {:.2} {:?}",
                    l.position, l.place, d, l.normals
                );
            }
        }
    }
    println!(
        "{:<34}{:>8.4}{:>8.4}{:>8.4}{:>8.4}{:>8.3}{:>8.3}{:>8.3}{:>8.4}{:>7.2}{:>7.2}{:>7.2}{:>8.4}{:>8.3}{:>7}{:>8.2}{:>7.1}",
        trial.name,
        f.input_flat,
        f.input_edge,
        f.flat,
        f.edge,
        f.edge_gap_own,
        f.edge_gap,
        f.worst,
        f.projected,
        f.normal_flat,
        f.normal_edge,
        f.normal_edge_measured,
        f.line_rms,
        f.line_worst,
        f.lines,
        seconds,
        seconds / search,
    );
}

/// Seconds for the `k` nearest neighbours of all points, the reference of all times here.
fn neighbour_search(
    positions: &[glam::DVec3],
    neighbors: &acies::points::Neighbors,
    k: usize,
) -> f64 {
    use rayon::prelude::*;
    let start = std::time::Instant::now();
    let far: f64 = neighbors
        .order()
        .par_chunks(256)
        .map_init(Vec::new, |found, part| {
            let mut far = 0.0f64;
            for &i in part {
                neighbors.nearest(positions[i as usize], k, found);
                far = far.max(found.last().map_or(0.0, |f| f.1));
            }
            far
        })
        .reduce(|| 0.0, f64::max);
    assert!(far > 0.0);
    start.elapsed().as_secs_f64()
}
