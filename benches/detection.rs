//! Sharp edges: our scores on exact clouds beside the goal and the best others reach with a threshold tuned per cloud.
//!
//! `cargo bench --bench detection [-- NAME]` runs all clouds, or those whose name contains NAME; `-- speed [MOST]` times the
//! detector beside our own search for the 20 nearest neighbours of the same points, in turn, for clouds of at most MOST points.

#![allow(clippy::print_stdout)]

use acies::features::{Class, Method, detect};
use acies::points::Neighbors;
use acies::points::picture::{self, ViewDirection, render};
use glam::DVec3;
use rayon::prelude::*;

#[path = "../tests/clouds/mod.rs"]
mod clouds;

use clouds::Sampled;
use clouds::models::fandisk;
use clouds::score::{cloud, oracle, score_classes};
use clouds::solids;

struct Row {
    name: String,
    goal: f64,
    make: Box<dyn Fn() -> Sampled>,
}

fn row(name: impl Into<String>, goal: f64, make: impl Fn() -> Sampled + 'static) -> Row {
    Row {
        name: name.into(),
        goal,
        make: Box::new(make),
    }
}

fn views() -> Vec<DVec3> {
    [
        (0.1, 0.05, 1.0),
        (0.8, 0.3, 0.6),
        (-0.8, 0.35, 0.6),
        (0.25, 0.8, 0.6),
        (-0.3, -0.85, 0.6),
    ]
    .iter()
    .map(|(x, y, z)| DVec3::new(*x, *y, *z).normalize())
    .collect()
}

fn rows() -> Vec<Row> {
    let mut rows = vec![
        row("cube", 0.995, || solids::cube(10.0).even(10_250, 580)),
        row("planes", 0.995, || clouds::thesis::planes(6_090, 256)),
        row("hole58k", 0.995, || {
            solids::cube_with_hole(10.0).even(58_720, 1_350)
        }),
        row("hole17k", 0.995, || {
            solids::cube_with_hole(10.0).even(17_400, 839)
        }),
    ];
    for (percent, goal) in [
        (0.4, 0.99),
        (0.8, 0.98),
        (1.2, 0.96),
        (1.6, 0.93),
        (2.0, 0.90),
    ] {
        rows.push(row(format!("hole17k noise {percent} %"), goal, move || {
            let sampled = solids::cube_with_hole(10.0).even(17_400, 839);
            // Weber's spacing is 0.25 at R = 8.5.
            let radius = percent / 100.0 * 8.5 / 0.25 * sampled.spacing;
            sampled.shaken(radius, 5)
        }));
    }
    if fandisk(10).is_some() {
        rows.push(row("fandisk41k", 0.98, || {
            fandisk(41_250).unwrap_or_default()
        }));
    } else {
        println!("skipped: fandisk, ../shared/data is absent");
    }
    rows.push(row("part500k", 0.96, || {
        solids::block().sample(500_000, 0.1, 1)
    }));
    rows.push(row("part500k clean", 0.96, || {
        solids::block().sample(500_000, 0.0, 1)
    }));
    rows.push(row("part500k outliers", 0.94, || {
        solids::block()
            .sample(500_000, 0.1, 1)
            .with_outliers(0.01, 2)
    }));
    rows.push(row("part100k", 0.96, || {
        solids::block().sample(100_000, 0.1, 1)
    }));
    for (ratio, goal) in [(5.0, 0.96), (10.0, 0.95), (20.0, 0.93)] {
        for (what, many) in [("one view", false), ("views", true)] {
            rows.push(row(format!("lines 1:{ratio} {what}"), goal, move || {
                let across = 0.12 * ratio_f(ratio) * if many { 2.0 } else { 1.0 };
                let along = across / ratio;
                let all = views();
                let used = if many { &all[..] } else { &all[..1] };
                solids::block().scan(used, (along, across), 0.1 * along, 3)
            }));
        }
    }
    for degrees in [20, 25, 30, 40, 60, 90, 120, 140, 150, 160, 165, 170, 172] {
        let angle = f64::from(degrees).to_radians();
        let goal = if (40..=165).contains(&degrees) {
            -0.02
        } else {
            -0.08
        };
        rows.push(row(format!("angle {degrees}"), goal, move || {
            solids::wedge(60.0, angle).sample(7_200, 0.1, 11)
        }));
    }
    rows.push(row("ribs 3 4 6", 0.96, || {
        let solid = solids::ribs(&[1.5, 2.0, 3.0]);
        let count = (solid.area() / 0.25) as usize;
        solid.sample(count, 0.1, 7)
    }));
    for r in [5.0, 10.0, 20.0] {
        rows.push(row(format!("cylinder radius {r} s"), 0.96, move || {
            let solid = solids::cylinder(r, 3.0 * r);
            let count = solid.area() as usize;
            solid.sample(count, 0.1, 7)
        }));
        rows.push(row(format!("cone radius {r} s"), 0.96, move || {
            let solid = solids::cone(r, 2.0 * r);
            let count = solid.area() as usize;
            solid.sample(count, 0.1, 7)
        }));
    }
    for r in [3.0, 5.0, 10.0] {
        rows.push(row(format!("fillet radius {r} s: none"), 0.0, move || {
            let solid = solids::rounded_bar(r);
            let count = solid.area() as usize;
            solid.sample(count, 0.1, 7)
        }));
    }
    rows
}

/// Keeps the number of points near the same for all ratios.
fn ratio_f(ratio: f64) -> f64 {
    ratio.sqrt() * 1.2
}

fn colour(class: &Class) -> [u8; 3] {
    match class {
        Class::None => picture::NONE,
        Class::Edge => picture::EDGE,
        Class::Corner => picture::CORNER,
        Class::Boundary => picture::BOUNDARY,
    }
}

/// Seconds of `work`.
fn seconds(work: impl FnOnce()) -> f64 {
    let start = std::time::Instant::now();
    work();
    start.elapsed().as_secs_f64()
}

/// The middle of `values`.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Resident memory now and at its highest since the last call, bytes; zero where the system does not tell.
fn memory() -> (f64, f64) {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let bytes = |key: &str| {
        let line = text.lines().find(|l| l.starts_with(key));
        let number = line.and_then(|l| l.split_whitespace().nth(1)?.parse::<f64>().ok());
        number.unwrap_or(0.0) * 1024.0
    };
    let seen = (bytes("VmRSS:"), bytes("VmHWM:"));
    // Five resets the high-water mark (proc(5)).
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    seen
}

/// Time and memory on the block, as ratios to the neighbour search.
fn speed(most: Option<usize>) {
    println!(
        "{:>9} {:>7} {:>9} {:>8} {:>6} {:>13}",
        "points", "threads", "search s", "detect s", "ratio", "bytes a point"
    );
    for count in [500_000, 2_000_000] {
        if let Some(most) = most
            && count > most
        {
            continue;
        }
        let cloud = cloud(&solids::block().sample(count, 0.1, 1).points);
        let neighbors = Neighbors::new(&cloud.positions);
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let Ok(pool) = pool else { continue };
            let (mut searches, mut detections, mut ratios) = (vec![], vec![], vec![]);
            let mut bytes = 0.0;
            for _ in 0..3 {
                let search = pool.install(|| {
                    seconds(|| {
                        let order = neighbors.order();
                        let far: f64 = order
                            .par_iter()
                            .map_init(Vec::new, |found, i| {
                                neighbors.nearest(cloud.positions[*i as usize], 20, found);
                                found[found.len() - 1].1
                            })
                            .sum();
                        assert!(far > 0.0, "neighbours are apart");
                    })
                });
                let (before, _) = memory();
                let found = pool.install(|| {
                    seconds(|| {
                        let found = detect(&cloud, &neighbors, Method::Adaptive);
                        assert!(found.count(Class::Edge) > 0, "the block has edges");
                    })
                });
                bytes = (memory().1 - before) / count as f64;
                searches.push(search);
                detections.push(found);
                ratios.push(found / search);
            }
            println!(
                "{count:9} {threads:7} {:9.2} {:8.2} {:6.2} {bytes:13.0}",
                median(searches),
                median(detections),
                median(ratios)
            );
        }
    }
}

fn main() {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| !a.starts_with("--"))
        .collect();
    if wanted.iter().any(|w| w == "speed") {
        return speed(wanted.iter().find_map(|w| w.parse().ok()));
    }
    println!(
        "{:26} {:>8} {:>6} {:>6} {:>6} {:>6} {:>6} {:>7} {:>7} {:>6}",
        "cloud", "points", "goal", "F1", "prec", "recall", "oracle", "s est", "noise/s", "time"
    );
    for row in rows() {
        if !wanted.is_empty() && !wanted.iter().any(|w| row.name.contains(w.as_str())) {
            continue;
        }
        let sampled = (row.make)();
        let cloud = cloud(&sampled.points);
        let neighbors = Neighbors::new(&cloud.positions);
        let start = std::time::Instant::now();
        let found = detect(&cloud, &neighbors, Method::Adaptive);
        let seconds = start.elapsed().as_secs_f64();
        let best = oracle(&sampled);
        let goal = if row.goal < 0.0 {
            best.f1() + row.goal
        } else {
            row.goal
        };
        let score = score_classes(&sampled, &found.classes);
        println!(
            "{:26} {:8} {:6.3} {:6.3} {:6.3} {:6.3} {:6.3} {:7.3} {:7.3} {:6.2} {}",
            row.name,
            sampled.points.len(),
            goal,
            score.f1(),
            score.precision,
            score.recall,
            best.f1(),
            found.spacing.across_mm / sampled.spacing,
            found.noise_mm / sampled.spacing,
            seconds,
            if score.f1() >= goal { "" } else { "<" },
        );
        if let Ok(folder) = std::env::var("PICTURES") {
            let name = row.name.replace([' ', ':', '%'], "-");
            let colours: Vec<[u8; 3]> = found.classes.iter().map(colour).collect();
            let view = ViewDirection::Along(DVec3::new(0.5, 0.7, -0.8));
            let picture = render(&sampled.points, &colours, view, (1400, 1000));
            let written = std::fs::write(format!("{folder}/{name}.png"), picture);
            println!("    picture {name}.png {written:?}");
        }
        if std::env::var_os("WRONG").is_some() {
            let mut bins = [0usize; 9];
            for (p, c) in sampled.points.iter().zip(&found.classes) {
                let d = clouds::score::distance(&sampled.edges, *p) / sampled.spacing;
                if clouds::score::is_edge(c) && d > 1.0 {
                    bins[((d * 2.0) as usize).min(8)] += 1;
                }
            }
            println!("    false by distance in half spacings: {bins:?}");
        }
        if std::env::var_os("STAGES").is_some() {
            for (stage, s) in &found.seconds {
                println!("    {stage:24} {s:.3}");
            }
        }
    }
}
