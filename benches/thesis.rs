//! The experiments of Weber's thesis, chapter 3, repeated: our tables and figures beside the author's.
//!
//! `cargo bench --bench thesis [-- tables | figures | models]`. `global` and `local` are the two methods of the thesis; `global 10` has the ten
//! neighbours that §3.7.3 finds best for the cube, `local 0.5` begins as the other example of Fig. 24 does. `adaptive` is what users get,
//! `variation` the baseline of §3.7.7.

#![allow(clippy::print_stdout)]

use std::time::Instant;

use acies::features::{Class, Method, detect, thesis, variation};
use acies::points::Neighbors;

#[path = "../tests/clouds/mod.rs"]
mod clouds;

use clouds::score::{cloud, score_classes};
use clouds::thesis::{
    FIGURE_25, Figures, RADIUS, TABLE_2, figures, hole_of_table_2, table_1, wedge,
};
use clouds::{Sampled, models};

/// The methods by name.
const METHODS: [&str; 6] = [
    "global",
    "global 10",
    "local",
    "local 0.5",
    "adaptive",
    "variation",
];
/// Seconds the author's local-adaptive method takes for the fandisk (§3.7.6).
const AUTHORS_SECONDS: f64 = 19.0;

/// The classes a method finds, and its seconds: neighbours, which the author counts apart, not included.
fn run(method: &str, sampled: &Sampled) -> (Vec<Class>, f64) {
    let cloud = cloud(&sampled.points);
    let neighbors = Neighbors::new(&cloud.positions);
    let start = Instant::now();
    let local = thesis::Settings::local_adaptive();
    let of_thesis = |s| thesis::detect_as_in_thesis(&cloud, &neighbors, &s);
    let classes = match method {
        "global" => of_thesis(thesis::Settings::global()),
        "global 10" => of_thesis(thesis::Settings {
            neighbours: 10,
            ..thesis::Settings::global()
        }),
        "local" => of_thesis(local),
        "local 0.5" => of_thesis(thesis::Settings {
            neighbours: 16,
            sensitivity_rad: 0.5,
            ..local
        }),
        "adaptive" => detect(&cloud, &neighbors, Method::Adaptive).classes,
        _ => variation::detect_by_variation(&cloud, &neighbors, &variation::Settings::default()),
    };
    (classes, start.elapsed().as_secs_f64())
}

fn print(name: &str, found: &Figures) {
    println!(
        "{name:10} {:8} {:8} {:8} {:8} {:10.3} {:8.2}",
        found.detected,
        found.features,
        found.hits,
        found.outliers(),
        found.mean,
        found.largest
    );
}

fn heading(what: &str) {
    println!("\n{what}");
    println!(
        "{:10} {:>8} {:>8} {:>8} {:>8} {:>10} {:>8}",
        "method", "detected", "true", "of these", "outliers", "delta_avg", "delta_inf"
    );
}

fn tables() {
    for example in table_1() {
        let sampled = &example.sampled;
        heading(&format!(
            "Table 1: {}, {} points, spacing {:.3}",
            example.name,
            sampled.points.len(),
            sampled.spacing
        ));
        let outliers = example.outliers.map_or("-".to_owned(), |o| o.to_string());
        let features = sampled.on_edge.iter().filter(|o| **o).count();
        println!(
            "{:10} {:8} {features:8} {:>8} {outliers:>8}",
            "author", example.detected, "-"
        );
        for method in &METHODS[..5] {
            print(method, &figures(sampled, sampled, &run(method, sampled).0));
        }
    }
    let exact = hole_of_table_2();
    for (ball, share) in [("radius", 1.0), ("diameter", 0.5)] {
        for (percent, largest, mean, features) in TABLE_2 {
            let radius = share * percent / 100.0 * RADIUS;
            let shaken = exact.clone().shaken(radius, 5);
            heading(&format!(
                "Table 2: noise {percent} % of R = {RADIUS} as {ball} of the ball, that is up to {:.2} of the spacing {:.3}",
                radius / exact.spacing,
                exact.spacing
            ));
            println!(
                "{:10} {features:8} {:8} {:>8} {:8} {mean:10.3} {largest:8.2}",
                "author",
                839,
                "-",
                features - 839
            );
            for method in &METHODS[..5] {
                print(method, &figures(&exact, &shaken, &run(method, &shaken).0));
            }
        }
    }
}

fn angles_and_variation() {
    for degrees in FIGURE_25 {
        let sampled = wedge(degrees);
        heading(&format!("Fig. 25: {degrees} degrees"));
        for method in &METHODS[..5] {
            print(
                method,
                &figures(&sampled, &sampled, &run(method, &sampled).0),
            );
        }
    }
    let exact = hole_of_table_2();
    for percent in [0.0, 1.2] {
        let shaken = exact.clone().shaken(0.5 * percent / 100.0 * RADIUS, 5);
        heading(&format!(
            "Fig. 34: cube with hole, noise {percent} % of R as diameter of the ball"
        ));
        for method in ["variation", "local", "adaptive"] {
            print(method, &figures(&exact, &shaken, &run(method, &shaken).0));
        }
    }
}

fn score_all(name: &str, sampled: &Sampled, resolved: usize) {
    let counted = Sampled {
        edges: sampled.edges[..resolved].to_vec(),
        ..sampled.clone()
    };
    println!("\n{name}: {} points", sampled.points.len());
    for method in METHODS {
        let (classes, seconds) = run(method, sampled);
        let score = score_classes(sampled, &classes);
        println!(
            "{method:10} found {:6}, precision {:.3}, recall {:.3}, {seconds:.2} s",
            score.detected,
            score.precision,
            score_classes(&counted, &classes).recall,
        );
    }
}

fn models_of_others() {
    match models::fandisk(41_250) {
        Some(fandisk) => {
            let all = fandisk.edges.len();
            let name =
                format!("fandisk, area samples (author's local method: {AUTHORS_SECONDS} s)");
            score_all(&name, &fandisk, all);
        }
        None => println!("\nskipped: fandisk, ../shared/data is absent"),
    }
    for name in ["mechpart.recon.m", "standingblob.orig.m"] {
        match models::labelled(name) {
            Some(model) => score_all(name, &model, model.edges.len()),
            None => println!("\nskipped: {name}, ../shared/data is absent"),
        }
    }
    match models::abc(40_000) {
        Some((model, resolved)) => score_all(
            "abc, area samples; its other curves than circles count as false",
            &model,
            resolved,
        ),
        None => println!("\nskipped: abc, ../shared/data is absent"),
    }
}

fn main() {
    let wanted: Vec<String> = (std::env::args().skip(1))
        .filter(|a| !a.starts_with("--"))
        .collect();
    println!("{} threads", rayon::current_num_threads());
    let parts: [(&str, fn()); 3] = [
        ("tables", tables),
        ("figures", angles_and_variation),
        ("models", models_of_others),
    ];
    for (name, part) in parts {
        if wanted.is_empty() || wanted.iter().any(|w| w == name) {
            part();
        }
    }
}
