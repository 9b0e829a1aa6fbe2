//! A whole inspection beside its yardstick: seconds by stage from a loaded cloud to the verdict, and as a ratio to the search for
//! the 20 nearest neighbours of every point of the same cloud, in the same run.
//!
//! `cargo bench --bench inspection [-- POINTS]`. Aim for 1,000,000 points and 20 edges on two threads: 3 times the search.

#![allow(clippy::print_stdout, reason = "its table is what it is for")]

#[allow(dead_code, reason = "the tests use more of it")]
#[path = "../tests/inspect/solids.rs"]
mod solids;

use std::time::Instant;

use acies::inspect::body::Body;
use acies::inspect::{Recipe, Request, Start, inspect};
use acies::points::Neighbors;
use glam::DVec2;
use rayon::prelude::*;
use solids::{ACROSS, ALONG, Noise, Solid};

/// A U of 24 edges, its side lengths as shares of the size.
const OUTLINE: [(f64, f64); 8] = [
    (0.0, 0.0),
    (1.0, 0.0),
    (1.0, 0.4),
    (0.7, 0.4),
    (0.7, 0.2),
    (0.3, 0.2),
    (0.3, 0.4),
    (0.0, 0.35),
];

fn main() {
    let points: f64 = std::env::args()
        .skip(1)
        .find_map(|argument| argument.parse().ok())
        .unwrap_or(1e6);
    // Sides (3.2 by 1) and two ends of 0.32.
    let size = (points * ALONG * ACROSS / (3.2 + 2.0 * 0.32)).sqrt();
    let outline: Vec<DVec2> = OUTLINE.iter().map(|p| size * DVec2::from(*p)).collect();
    let solid = Solid::prism(&outline, size);
    let seen: Vec<u32> = (0..solid.face_count() as u32).collect();
    let mut noise = Noise(7);
    let mut cloud = solid.scan(&seen, 0.01, &mut noise);
    let moved = noise.motion(0.2, 0.2 * size);
    cloud = cloud.map(cloud.frame, |p| moved.point(p), |v| moved.vector(v));
    println!(
        "{} points, {} edges, {} threads",
        cloud.len(),
        solid.edges().len(),
        rayon::current_num_threads()
    );
    let recipe = Recipe::parse("rule = { guard_band = 2.0 }\n[limits]\nd_mm = [-0.1, 0.1]")
        .expect("a sound recipe");
    for round in 1..=3 {
        let search = neighbour_search(&cloud.positions);
        let began = Instant::now();
        let found = inspect(&cloud, &solid, &Request::new(&recipe, Start::Auto));
        let whole = began.elapsed().as_secs_f64();
        println!(
            "round {round}: {:?}, {whole:.2} s, search {search:.2} s, ratio {:.2}",
            found.verdict,
            whole / search
        );
        if round == 1 {
            found
                .findings
                .iter()
                .take(5)
                .for_each(|f| println!("    {f}"));
            let open = found
                .edges
                .iter()
                .filter(|e| e.verdict != acies::inspect::result::Verdict::Ok);
            open.take(3).for_each(|e| {
                println!(
                    "    {} {:?} {:?} {}",
                    e.id, e.verdict, e.coverage, e.stations[0].reason
                )
            });
        }
        for (stage, seconds) in found.seconds {
            println!("    {stage:<32} {seconds:>7.2} s {:>6.2}", seconds / search);
        }
    }
}

/// Seconds for the 20 nearest neighbours of every point, tree included.
fn neighbour_search(positions: &[glam::DVec3]) -> f64 {
    let began = Instant::now();
    let tree = Neighbors::new(positions);
    let sum: f64 = positions
        .par_chunks(4096)
        .map(|block| {
            let mut hits = Vec::new();
            let mut sum = 0.0;
            for p in block {
                tree.nearest(*p, 20, &mut hits);
                sum += hits.last().map_or(0.0, |hit| hit.1);
            }
            sum
        })
        .sum();
    assert!(sum.is_finite());
    began.elapsed().as_secs_f64()
}
