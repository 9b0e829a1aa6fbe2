//! The methods of Weber's thesis on its own examples: Table 1 comes out, and nothing but the points' places decides the answer.
//!
//! `cargo bench --bench thesis` prints all of its tables and figures; here are those that ours must not lose.

use acies::features::{Class, thesis, variation};
use acies::points::Neighbors;
use glam::DVec3;

mod clouds;

use clouds::score::cloud;
use clouds::solids;
use clouds::thesis::{FIGURE_25, figures, hole_of_table_2, planes, table_1, wedge};

fn found(points: &[DVec3], settings: &thesis::Settings) -> Vec<Class> {
    let cloud = cloud(points);
    thesis::detect_as_in_thesis(&cloud, &Neighbors::new(&cloud.positions), settings)
}

fn local(points: &[DVec3]) -> Vec<Class> {
    found(points, &thesis::Settings::local_adaptive())
}

#[test]
fn the_clouds_have_the_numbers_of_the_thesis() {
    let clouds = table_1().map(|example| example.sampled);
    let expected = [(10_250, 580), (6_090, 256), (58_720, 1_350), (17_400, 839)];
    for (sampled, (count, on_edge)) in clouds.iter().chain([&hole_of_table_2()]).zip(expected) {
        assert_eq!(sampled.points.len(), count);
        assert_eq!(sampled.on_edge.iter().filter(|o| **o).count(), on_edge);
        for (p, on_edge) in sampled.points.iter().zip(&sampled.on_edge) {
            let distance = clouds::score::distance(&sampled.edges, *p);
            // Rows keep half a spacing away from edges; made on an edge is on it but for rounding.
            if *on_edge {
                assert!(distance < 1e-9 * count as f64);
            } else {
                assert!(distance > 0.45 * sampled.spacing, "{p}: {distance}");
            }
        }
    }
}

#[test]
fn the_angle_of_the_planes_runs_from_45_to_140_degrees() {
    let sampled = planes(6_090, 256);
    // The first and the last line across each strip: half a step from the ends, where the angle is within half a degree.
    for (y, degrees) in [(0.5, 45.0), (255.5, 140.0)] {
        let row = sampled.points.iter().filter(|p| (p.y - y).abs() < 0.4);
        let arm = |up: bool| {
            let mut side = row
                .clone()
                .filter(|p| if up { p.z > 0.1 } else { p.z < -0.1 });
            let p = side.next().expect("points on both strips");
            DVec3::new(p.x, 0.0, p.z)
        };
        let angle = arm(true).angle_between(arm(false)).to_degrees();
        assert!((angle - degrees).abs() < 0.5, "{angle} {degrees}");
    }
}

#[test]
fn table_1_comes_out() {
    for example in table_1() {
        let sampled = &example.sampled;
        let found = figures(sampled, sampled, &local(&sampled.points));
        // The thesis finds 99 percent of the cube and all of the others. It tells neither how its clouds were sampled nor how few points
        // are a few: one percent either way is what the row that a point more or less comes to lie in does.
        assert!(
            found.hits as f64 >= 0.99 * found.features as f64,
            "{}: {found:?}",
            example.name
        );
        let off = found.detected.abs_diff(example.detected);
        assert!(
            off as f64 <= 0.01 * example.detected as f64,
            "{}: {found:?}, the author detects {}",
            example.name,
            example.detected
        );
    }
}

#[test]
fn the_angles_of_figure_25_are_found_from_45_to_160_degrees() {
    for degrees in FIGURE_25 {
        let sampled = wedge(degrees);
        let found = figures(&sampled, &sampled, &local(&sampled.points));
        // The thesis: perfect above 45 degrees, not precise below, lost near 180, which ours are at 170.
        if (45.0..=160.0).contains(&degrees) {
            // The ends of the edge see half a neighbourhood.
            assert!(
                found.hits + 2 >= found.features && found.outliers() == 0,
                "{degrees}: {found:?}"
            );
        }
    }
}

#[test]
fn the_global_method_finds_all_of_the_cube_best_with_ten_neighbours() {
    // §3.7.3: k = 10 is best for the cube. The thesis has it perfect with a sensitivity of 0.6; on our rows their neighbours are found too.
    let sampled = &table_1()[0].sampled;
    let [ten, sixteen] = [10, 16].map(|neighbours| {
        let settings = thesis::Settings {
            neighbours,
            ..thesis::Settings::global()
        };
        figures(sampled, sampled, &found(&sampled.points, &settings))
    });
    assert!(ten.hits == ten.features && sixteen.hits == sixteen.features);
    assert!(ten.outliers() < sixteen.outliers());
    // No further from an edge than the next row and its irregularities.
    assert!(ten.largest < 1.2 * sampled.spacing, "{ten:?}");
}

#[test]
fn neither_the_order_of_the_points_nor_the_threads_change_the_answer() {
    let sampled = solids::block().sample(1_500, 0.1, 9);
    let classes = local(&sampled.points);
    assert!(classes.contains(&Class::Edge));
    let mut backwards: Vec<DVec3> = sampled.points.clone();
    backwards.reverse();
    let mut back = local(&backwards);
    back.reverse();
    assert_eq!(classes, back, "order");
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let again = pool.expect("threads").install(|| local(&sampled.points));
        assert_eq!(classes, again, "{threads} threads");
    }
}

#[test]
fn nothing_too_few_and_identical_points_are_survived() {
    for points in [
        Vec::new(),
        vec![DVec3::ONE; 50],
        vec![DVec3::X, DVec3::Y, DVec3::NAN],
    ] {
        assert!(local(&points).iter().all(|c| *c == Class::None));
        let cloud = cloud(&points);
        let neighbors = Neighbors::new(&cloud.positions);
        let classes =
            variation::detect_by_variation(&cloud, &neighbors, &variation::Settings::default());
        assert_eq!(classes.len(), points.len());
    }
}

#[test]
fn surface_variation_finds_right_edges_in_part() {
    let sampled = &table_1()[0].sampled;
    let cloud = cloud(&sampled.points);
    let neighbors = Neighbors::new(&cloud.positions);
    let classes =
        variation::detect_by_variation(&cloud, &neighbors, &variation::Settings::default());
    let found = figures(sampled, sampled, &classes);
    // Between regular rows a right edge varies by about the bound of 0.08 at every scale: which of its points pass is chance.
    assert!(
        found.hits > 100 && found.hits > 4 * found.outliers(),
        "{found:?}"
    );
}
