//! Sharp edges found on exact clouds: reduced forms of the rows of `benches/detection.rs`, with one default set for all of them.

use acies::features::{Class, Detection, Method, detect, thesis};
use acies::points::Neighbors;
use glam::{DQuat, DVec3};

mod clouds;

use clouds::score::{cloud, distance, oracle, score_classes};
use clouds::{Sampled, solids};

fn found(sampled: &Sampled) -> Detection {
    let cloud = cloud(&sampled.points);
    detect(&cloud, &Neighbors::new(&cloud.positions), Method::Adaptive)
}

/// Fails where F1 is below `goal`.
fn reaches(name: &str, sampled: &Sampled, goal: f64) {
    let score = score_classes(sampled, &found(sampled).classes);
    assert!(
        score.f1() >= goal,
        "{name}: F1 {:.3} (precision {:.3}, recall {:.3}), goal {goal}",
        score.f1(),
        score.precision,
        score.recall
    );
}

#[test]
fn the_cubes_of_the_thesis_are_found_whole() {
    reaches("cube", &solids::cube(10.0).even(10_250, 580), 0.995);
    let hole = || solids::cube_with_hole(10.0).even(17_400, 839);
    reaches("cube with hole", &hole(), 0.995);
    // Table 2 of the thesis: noise in percent of R = 8.5 at a spacing of 0.25.
    for (percent, goal) in [(0.4, 0.99), (0.8, 0.98), (1.2, 0.96), (2.0, 0.90)] {
        let clean = hole();
        let radius = percent / 100.0 * 8.5 / 0.25 * clean.spacing;
        reaches(
            &format!("{percent} % noise"),
            &clean.shaken(radius, 5),
            goal,
        );
    }
}

#[test]
fn angles_are_found_nearly_as_an_oracle_would() {
    for (degrees, goal) in [(60f64, 0.03), (90.0, 0.03), (120.0, 0.03), (150.0, 0.08)] {
        let sampled = solids::wedge(40.0, degrees.to_radians()).sample(3_200, 0.1, 11);
        let best = oracle(&sampled).f1();
        reaches(&format!("{degrees} degrees"), &sampled, best - goal);
    }
}

#[test]
fn random_samples_of_a_machined_block_are_found_with_and_without_outliers() {
    let block = || solids::block().sample(40_000, 0.1, 1);
    reaches("block", &block(), 0.95);
    reaches("with outliers", &block().with_outliers(0.01, 2), 0.93);
}

#[test]
fn scan_lines_are_found_in_one_view_and_in_several() {
    let view = DVec3::new(0.1, 0.05, 1.0).normalize();
    let side = DVec3::new(0.8, 0.3, 0.6).normalize();
    for ratio in [10.0, 20.0] {
        let across = 0.55 * f64::sqrt(ratio);
        let steps = (across / ratio, across);
        let noise = 0.1 * steps.0;
        let one = solids::block().scan(&[view], steps, noise, 3);
        reaches(&format!("1:{ratio}"), &one, 0.93);
        let two = solids::block().scan(&[view, side], steps, noise, 3);
        reaches(&format!("1:{ratio}, two views"), &two, 0.90);
    }
}

#[test]
fn open_borders_are_boundaries_and_never_edges() {
    let sampled = solids::wedge(40.0, 2.0).sample(3_200, 0.1, 4);
    let classes = found(&sampled).classes;
    let s = sampled.spacing;
    let (mut counts, mut marked, mut wrong) = ([0usize; 2], 0usize, 0usize);
    for (p, class) in sampled.points.iter().zip(&classes) {
        let to_border = distance(&sampled.borders, *p) / s;
        let to_edge = distance(&sampled.edges, *p) / s;
        if to_border < 0.5 && to_edge > 3.0 {
            counts[0] += 1;
            counts[1] += usize::from(*class == Class::Boundary);
            assert!(
                !clouds::score::is_edge(class),
                "an edge at the border, {p} is {to_edge} spacings from the edge"
            );
        }
        if *class == Class::Boundary {
            wrong += usize::from(to_border > 2.0);
            marked += 1;
        }
    }
    assert!(
        counts[1] as f64 > 0.8 * counts[0] as f64,
        "{} of {} border points found",
        counts[1],
        counts[0]
    );
    // Random samples leave holes of their own.
    assert!(wrong * 20 < marked, "{wrong} of {marked} are no border");
}

#[test]
fn the_corners_of_a_cube_are_corners() {
    let sampled = solids::cube(10.0).even(10_250, 580);
    let classes = found(&sampled).classes;
    for corner in 0..8 {
        let sign = |bit: i32| if corner & bit == 0 { -5.0 } else { 5.0 };
        let at = DVec3::new(sign(1), sign(2), sign(4));
        let near = (sampled.points.iter().zip(&classes))
            .filter(|(p, c)| **c == Class::Corner && p.distance(at) < 1.5 * sampled.spacing);
        assert!(near.count() > 0, "no corner at {at}");
    }
}

#[test]
fn corners_are_where_three_faces_meet_under_noise_too_and_not_along_round_edges() {
    let sampled = solids::cube(10.0).sample(10_000, 0.1, 5);
    let classes = found(&sampled).classes;
    let corners: Vec<DVec3> = (0..8)
        .map(|i| DVec3::new(sign(i & 1), sign(i & 2), sign(i & 4)))
        .collect();
    let marked: Vec<DVec3> = (sampled.points.iter().zip(&classes))
        .filter(|(_, c)| **c == Class::Corner)
        .map(|(p, _)| *p)
        .collect();
    let s = sampled.spacing;
    let seen = corners
        .iter()
        .filter(|c| marked.iter().any(|p| p.distance(**c) < 2.0 * s));
    // One corner may lie in a gap of the random sampling.
    assert!(seen.clone().count() >= 7, "{} of 8 corners", seen.count());
    for p in &marked {
        let near = corners.iter().any(|c| c.distance(*p) < 3.0 * s);
        assert!(near, "no corner within three spacings of {p}");
    }

    // Rims of five spacings' radius, as round as edges come that can be told.
    let solid = solids::cylinder(5.0, 15.0);
    let round = solid.sample(solid.area() as usize, 0.1, 7);
    let classes = found(&round);
    assert!(classes.count(Class::Edge) > 50, "the rims are found");
    assert_eq!(classes.count(Class::Corner), 0, "a rim has no corner");
}

/// Half a side of the cube of ten, on the side that the bit tells.
fn sign(bit: i32) -> f64 {
    if bit == 0 { -5.0 } else { 5.0 }
}

#[test]
fn cones_have_a_rim_and_a_tip_and_nothing_between() {
    let solid = solids::cone(20.0, 40.0);
    let sampled = solid.sample(solid.area() as usize, 0.1, 7);
    let classes = found(&sampled).classes;
    let tip = DVec3::Z * 20.0;
    let (mut between, mut at_tip) = (0, 0);
    for (p, class) in sampled.points.iter().zip(&classes) {
        let rim = distance(&sampled.edges, *p) < 2.0;
        if p.distance(tip) < 2.0 {
            at_tip += usize::from(*class == Class::Corner);
        } else if !rim && clouds::score::is_edge(class) {
            between += 1;
        }
    }
    assert!(at_tip > 0, "the tip is a corner");
    // Of 2,700 points on the mantle; within five spacings of the tip its radius of curvature is below two and a half.
    assert!(between <= 5, "{between} points between rim and tip");
    reaches("cone", &sampled, 0.95);
}

#[test]
fn order_and_place_of_the_points_do_not_change_the_answer() {
    let sampled = solids::block().sample(20_000, 0.1, 9);
    let classes = found(&sampled).classes;
    let reversed = Sampled {
        points: sampled.points.iter().rev().copied().collect(),
        ..sampled.clone()
    };
    let mut back = found(&reversed).classes;
    back.reverse();
    assert_eq!(classes, back, "order");

    let turn = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -1.0).normalize(), 1.1);
    let moved = Sampled {
        points: (sampled.points.iter())
            .map(|p| turn * *p * 3.0 + DVec3::new(50.0, -20.0, 7.0))
            .collect(),
        ..sampled.clone()
    };
    let other = found(&moved).classes;
    let same = classes.iter().zip(&other).filter(|(a, b)| a == b).count();
    // Rounding decides points exactly on a threshold, and which places the samples of spacing and noise take.
    assert!(
        same as f64 > 0.995 * classes.len() as f64,
        "{same} of {} keep their class when turned, scaled and moved",
        classes.len()
    );
}

#[test]
fn too_few_identical_and_not_finite_points_are_survived() {
    let few = found(&Sampled {
        points: vec![DVec3::ONE; 100_000],
        ..Sampled::default()
    });
    assert_eq!(few.count(Class::None), 100_000);
    assert_eq!(
        few.findings,
        ["points: fewer than 8 distinct places, no edge can be told"]
    );
    let mut odd = solids::cube(10.0).sample(2_000, 0.0, 3).points;
    odd[7] = DVec3::NAN;
    odd.extend((0..3_000).map(|i| DVec3::X * f64::from(i)));
    let odd = found(&Sampled {
        points: odd,
        ..Sampled::default()
    });
    assert_eq!(odd.classes.len(), 5_000);
    assert_eq!(odd.classes[7], Class::None);
}

#[test]
fn the_method_of_the_thesis_finds_the_edges_of_its_cube() {
    let sampled = solids::cube(10.0).even(2_400, 290);
    let cloud = cloud(&sampled.points);
    let neighbors = Neighbors::new(&cloud.positions);
    for settings in [
        thesis::Settings::global(),
        thesis::Settings::local_adaptive(),
    ] {
        let classes = thesis::detect_as_in_thesis(&cloud, &neighbors, &settings);
        let score = score_classes(&sampled, &classes);
        assert!(
            score.recall > 0.8 && score.precision > 0.6,
            "{settings:?}: precision {:.3}, recall {:.3}",
            score.precision,
            score.recall
        );
    }
}
