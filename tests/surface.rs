//! The surface through measured points, against bodies that are known exactly.

#[path = "surface/command.rs"]
mod command;
#[path = "surface/figures.rs"]
mod figures;
#[path = "surface/truth.rs"]
mod truth;

use acies::features::Class;
use acies::points::{Frame, Neighbors, PointCloud};
use acies::surface::{
    Degree, Place, Settings, SmoothSurface, Surface, SurfaceError, ThesisSettings, ThesisSurface,
    plane_normals, reconstruct, resample, weighted_plane_normals,
};
use glam::DVec3;
use truth::Dice;

fn cloud(positions: Vec<DVec3>) -> PointCloud {
    PointCloud {
        frame: Frame::Part,
        positions,
        origins: Vec::new(),
        views: Vec::new(),
    }
}

/// `count` points of a sphere of radius 10 with noise `sigma` along the normal.
fn sphere(count: usize, sigma: f64) -> PointCloud {
    let mut dice = Dice(5);
    cloud(
        (0..count)
            .map(|_| {
                let n = dice.cloud().normalize();
                n * (10.0 + sigma * dice.normal())
            })
            .collect(),
    )
}

// The limits are the figures that the bench prints for the full clouds, and where the smaller clouds here do worse, theirs with a
// tenth to spare. What others reach is in the bench's table: nothing below 0.072 within three spacings of an edge of the block.

#[test]
fn a_clean_cube_with_hole_stays_where_it_is() {
    let (f, result) = figures::cube_trial(30, 0.0).run(Settings::default());
    assert!(
        f.flat < 0.005 && f.edge < 0.02 && f.edge_gap < 0.10,
        "{f:?}"
    );
    assert!(f.projected == 1.0 && f.worst < 0.05, "{f:?}");
    let corners = result
        .lines
        .iter()
        .filter(|l| l.place == Place::Corner)
        .count();
    assert_eq!(corners, 8, "a cube has eight corners");
}

#[test]
fn noise_on_the_cube_is_reduced_as_well_at_the_edge() {
    let (f, _) = figures::cube_trial(52, 0.8).run(Settings::default());
    assert!(f.flat < 0.05 && f.edge < 0.06 && f.edge_gap < 0.15, "{f:?}");
    let (f, _) = figures::cube_trial(52, 2.0).run(Settings::default());
    assert!(f.flat < 0.11 && f.edge < 0.15 && f.edge_gap < 0.25, "{f:?}");
    assert!(f.projected > 0.999, "{f:?}");
}

#[test]
fn the_block_is_sharp_and_its_normals_are_right_up_to_the_edge() {
    let (f, _) = figures::block_trial(60_000).run(Settings::default());
    assert!(
        f.flat < 0.032 && f.edge < 0.04 && f.edge_gap < 0.20,
        "{f:?}"
    );
    assert!(f.normal_flat < 1.0 && f.normal_edge < 2.0, "{f:?}");
    assert!(f.projected > 0.999 && f.worst < 0.6, "{f:?}");
}

#[test]
fn scan_lines_ten_to_one_do_not_matter() {
    let (f, _) = figures::lines_trial(1.2).run(Settings::default());
    assert!(
        f.flat < 0.004 && f.edge < 0.008 && f.edge_gap < 0.25,
        "{f:?}"
    );
    assert!(f.projected > 0.98, "{f:?}");
}

#[test]
fn blunt_and_acute_edges_are_kept() {
    for (angle, limit) in [(150.0, 0.075), (120.0, 0.045), (60.0, 0.04), (30.0, 0.05)] {
        let (f, _) =
            figures::body_trial("ridge", truth::ridge(angle), 8_000, 0.1).run(Settings::default());
        assert!(f.edge < limit, "{angle} degrees: {f:?}");
    }
}

#[test]
fn thin_walls_do_not_merge() {
    let unit = (800.0f64 / 8_000.0).sqrt();
    for gap in [1.0, 2.0] {
        let trial = figures::body_trial("plates", truth::plates(gap * unit), 8_000, 0.05);
        let (f, _) = trial.run(Settings::default());
        assert!(f.flat < 0.02, "{gap} spacings apart, input 0.05: {f:?}");
    }
}

#[test]
fn what_cannot_be_projected_is_left_alone() {
    let ball = sphere(4_000, 0.0);
    let neighbors = Neighbors::new(&ball.positions);
    let surface = Surface::new(&ball, &neighbors, Settings::default()).expect("a surface");
    assert!(
        surface.project(DVec3::new(0.0, 0.0, 30.0)).is_none(),
        "far outside"
    );
    assert!(
        surface.project(DVec3::ZERO).is_none(),
        "the centre is as near to everything"
    );
    assert!(surface.project(DVec3::NAN).is_none());

    let mut positions = ball.positions.clone();
    positions[17] *= 1.3;
    positions[18] = DVec3::new(f64::NAN, 0.0, 0.0);
    let broken = cloud(positions);
    let neighbors = Neighbors::new(&broken.positions);
    let result = reconstruct(&broken, &neighbors, Settings::default()).expect("a surface");
    for odd in [17, 18] {
        assert!(!result.projected[odd]);
        let kept = result.positions[odd].to_array().map(f64::to_bits);
        assert_eq!(kept, broken.positions[odd].to_array().map(f64::to_bits));
    }
    assert_eq!(result.projected.iter().filter(|p| !**p).count(), 2);
}

#[test]
fn too_few_points_are_refused_with_their_number() {
    let few = cloud((0..9).map(|i| DVec3::splat(f64::from(i))).collect());
    let neighbors = Neighbors::new(&few.positions);
    let error =
        reconstruct(&few, &neighbors, Settings::default()).expect_err("nine points are no surface");
    assert_eq!(error, SurfaceError::TooFewPoints { seen: 9 });
    assert_eq!(
        error.to_string(),
        "surface: 9 distinct points, at least 16 needed; scan more of the part"
    );
}

#[test]
fn curvature_and_covariance_of_a_sphere_are_honest() {
    let sigma = 0.02;
    let ball = sphere(20_000, sigma);
    let neighbors = Neighbors::new(&ball.positions);
    let surface = Surface::new(&ball, &neighbors, Settings::default()).expect("a surface");
    let mut dice = Dice(99);
    let (mut normalised, mut bends, mut count) = (0.0, 0.0, 0.0);
    for _ in 0..400 {
        let query = dice.cloud().normalize() * 10.0;
        let at = surface.project(query).expect("on the sphere");
        let n = at.normals[0];
        let variance = (at.covariance * n).dot(n);
        normalised += (at.position.length() - 10.0).powi(2) / variance;
        bends += at.curvatures[0].abs();
        count += 1.0;
    }
    // 400 nearly independent squares of mean one scatter by 0.07; neighbourhoods overlap, so twice that and the shrinking's bias.
    let ratio = normalised / count;
    assert!(
        (0.7..1.3).contains(&ratio),
        "squared error over variance {ratio}"
    );
    // A radius of 10 bends by 0.1; the larger of two noisy curvatures is above it on average.
    assert!(
        (bends / count - 0.1).abs() < 0.05,
        "mean curvature {}",
        bends / count
    );
}

#[test]
fn an_edge_and_a_corner_carry_their_normals_and_covariance() {
    let trial = figures::cube_trial(30, 0.3);
    let points = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&points.positions);
    let surface = Surface::new(&points, &neighbors, Settings::default()).expect("a surface");
    let at = surface
        .project(DVec3::new(5.02, 5.01, 1.0))
        .expect("near the edge");
    assert_eq!(at.place, Place::Edge);
    assert!(
        (at.position - DVec3::new(5.0, 5.0, 1.0))
            .truncate()
            .length()
            < 0.03,
        "{at:?}"
    );
    // One-sided slopes under this noise scatter by 0.03 each.
    assert!(at.normals[0].dot(at.normals[1]).abs() < 0.12, "{at:?}");
    assert!(
        (at.covariance * DVec3::Z).dot(DVec3::Z) < 0.1 * (at.covariance * DVec3::X).dot(DVec3::X)
    );
    let at = surface
        .project(DVec3::new(5.02, 5.01, 5.02))
        .expect("near the corner");
    assert_eq!(at.place, Place::Corner);
    assert!(at.position.distance(DVec3::splat(5.0)) < 0.04, "{at:?}");
}

#[test]
fn the_surface_goes_over_an_edge_without_a_jump_and_has_two_normals_there() {
    for (percent, jump, tilt_deg) in [(0.0, 0.01, 0.5), (0.4, 0.2, 6.0)] {
        let trial = figures::cube_trial(40, percent);
        let points = figures::cloud_of(&trial.seen);
        let neighbors = Neighbors::new(&points.positions);
        let surface = Surface::new(&points, &neighbors, Settings::default()).expect("a surface");
        // From one face around the edge x = y = 5 to the other, 0.1 mm outside.
        let step = 0.01;
        let walk = (-50..=50).map(|k| {
            let s = f64::from(k) * step;
            DVec3::new(5.1 - s.max(0.0), 5.1 + s.min(0.0), 0.37)
        });
        let mut last: Option<DVec3> = None;
        let mut on_edge = 0;
        for query in walk {
            let at = surface.project(query).expect("near the surface");
            if let Some(last) = last {
                let moved = at.position.distance(last);
                assert!(
                    moved < step + jump * trial.unit_mm,
                    "{percent} %: {moved} mm"
                );
            }
            last = Some(at.position);
            if at.place == Place::Edge {
                on_edge += 1;
                let angle = |n: DVec3, m: DVec3| n.dot(m).abs().min(1.0).acos().to_degrees();
                let [a, b, _] = at.normals;
                let off = (angle(a, DVec3::X).max(angle(b, DVec3::Y)))
                    .min(angle(a, DVec3::Y).max(angle(b, DVec3::X)));
                assert!(off < tilt_deg, "{percent} %: {off} degrees");
            }
        }
        // Queries beyond both faces have the edge itself as their nearest point: 0.1 mm to either side.
        assert!(on_edge >= 15, "{percent} %: {on_edge}");
    }
}

#[test]
fn every_line_reaches_the_corner() {
    for percent in [0.0, 0.4] {
        let trial = figures::cube_trial(40, percent);
        let (_, result) = trial.run(Settings::default());
        let s = trial.unit_mm;
        for corner in 0..8 {
            let sign = |bit: usize| if corner >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let at = DVec3::new(sign(0), sign(1), sign(2)) * 5.0;
            for axis in 0..3 {
                // The first spacing and a half of each of the three edges.
                let near = result.lines.iter().filter(|l| {
                    let d = l.position - at;
                    let along = d[axis].abs();
                    let off = (d.length_squared() - along * along).max(0.0).sqrt();
                    along > 0.1 * s && along < 1.5 * s && off < (0.02 + percent) * s
                });
                assert!(near.count() >= 1, "{percent} %: axis {axis} at {at}");
            }
        }
    }
}

#[test]
fn memory_above_the_input_is_small() {
    let count = 20_000;
    let trial = figures::block_trial(count);
    let points = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&points.positions);
    // The counter counts by thread: all work on this one.
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .use_current_thread()
        .build()
        .expect("a pool");
    let counted = pool.install(|| {
        allocation_counter::measure(|| {
            let result = reconstruct(&points, &neighbors, Settings::default());
            drop(result.expect("a surface"));
        })
    });
    // 37 bytes a point are the result, one more the trust; 4 MB hold a block of points and what this small cloud's edges take. The bench
    // counts at 500,000, where less than 60 bytes a point must do.
    let most = 45 * count as u64 + 4_000_000;
    assert!(counted.bytes_max < most, "{} bytes", counted.bytes_max);
}

#[test]
fn the_thesis_rounds_nothing_where_its_features_lie_on_the_edge() {
    let trial = figures::cube_trial(40, 0.0);
    let points = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&points.positions);
    let on_edge = |p: &DVec3| trial.body.edge_distance(*p) < 1e-9;
    let classes: Vec<Class> = (points.positions.iter())
        .map(|p| if on_edge(p) { Class::Edge } else { Class::None })
        .collect();
    let settings = ThesisSettings {
        k: 20,
        h_mm: 0.8 * trial.unit_mm,
        degree: Degree::Two,
    };
    let surface = ThesisSurface::new(&points.positions, &neighbors, &classes, settings);
    let smooth = SmoothSurface::new(
        &points.positions,
        &neighbors,
        Degree::Two,
        1.5 * trial.unit_mm,
    );
    let rms = |out: Vec<Option<(DVec3, DVec3)>>| {
        let off: Vec<f64> = out
            .iter()
            .flatten()
            .map(|p| trial.body.distance(p.0))
            .collect();
        (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt() / trial.unit_mm
    };
    let (sharp, round) = (rms(surface.project_all()), rms(smooth.project_all()));
    assert!(sharp < 0.5 * round, "{sharp} {round} spacings");
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let trial = figures::block_trial(8_000);
    let points = figures::cloud_of(&trial.seen);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("a pool");
        pool.install(|| {
            let neighbors = Neighbors::new(&points.positions);
            reconstruct(&points, &neighbors, Settings::default()).expect("a surface")
        })
    };
    let (one, three) = (run(1), run(3));
    assert_eq!(one.positions, three.positions);
    assert_eq!(one.normals, three.normals);
    assert_eq!(one.lines, three.lines);
    assert_eq!(one.sharp, three.sharp);
}

#[test]
fn new_points_are_even_complete_and_on_the_surface() {
    let trial = figures::cube_trial(52, 0.0);
    let points = figures::cloud_of(&trial.seen);
    let neighbors = Neighbors::new(&points.positions);
    let spacing_mm = 0.25;
    let out = resample(&points, &neighbors, spacing_mm).expect("a surface");
    let expected = trial.body.area() / (spacing_mm * spacing_mm);
    let share = out.positions.len() as f64 / expected;
    assert!(
        (0.8..1.3).contains(&share),
        "{share} points a square of the spacing"
    );
    let mut off: Vec<f64> = (out.positions.iter())
        .map(|p| trial.body.distance(*p) / trial.unit_mm)
        .collect();
    off.sort_by(f64::total_cmp);
    // Beside the rim of the hole a face may run on by up to a spacing before its other flank is believed; that concerns few points.
    assert!(
        off[off.len() * 99 / 100] < 0.02,
        "{}",
        off[off.len() * 99 / 100]
    );
    assert!(off[off.len() - 1] < 1.5, "{}", off[off.len() - 1]);
    let near = Neighbors::new(&out.positions);
    let mut found = Vec::new();
    for seen in &trial.seen {
        near.nearest(seen.clean, 1, &mut found);
        assert!(found[0].1.sqrt() < spacing_mm, "a hole at {}", seen.clean);
    }
    let corners = out.places.iter().filter(|p| **p == Place::Corner).count();
    assert_eq!(corners, 8, "a cube has eight corners");
    let error = resample(&points, &neighbors, 0.0).expect_err("no spacing");
    let text = error.to_string();
    assert!(
        text.starts_with("resampling: a spacing of 0 mm would need inf points"),
        "{text}"
    );
}

#[test]
fn the_smooth_surface_reproduces_what_its_degree_can() {
    // Levin's projection of degree m reproduces polynomials of degree m in the plane's frame; here z = x²/40 - y²/60 on a grid.
    let height = |x: f64, y: f64| x * x / 40.0 - y * y / 60.0;
    let mut positions = Vec::new();
    for i in -20..=20 {
        for j in -20..=20 {
            let (x, y) = (f64::from(i) * 0.2, f64::from(j) * 0.2);
            positions.push(DVec3::new(x, y, height(x, y)));
        }
    }
    let neighbors = Neighbors::new(&positions);
    let query = DVec3::new(0.3, -0.2, height(0.3, -0.2) + 0.1);
    let off = |degree| {
        let surface = SmoothSurface::new(&positions, &neighbors, degree, 0.6);
        let (at, _) = surface.project(query).expect("inside");
        (at.z - height(at.x, at.y)).abs()
    };
    // In the tilted frame the quadric is not quite one: what is left is of third and fourth order.
    assert!(
        off(Degree::Two) < 1e-4 && off(Degree::Three) < 1e-4,
        "{} {}",
        off(Degree::Two),
        off(Degree::Three)
    );
    assert!(off(Degree::One) > 1e-4, "a plane cannot");
}

#[test]
fn baseline_normals_are_right_where_it_is_flat_and_wrong_at_edges() {
    let trial = figures::cube_trial(30, 0.0);
    let positions: Vec<DVec3> = trial.seen.iter().map(|s| s.noisy).collect();
    let neighbors = Neighbors::new(&positions);
    for normals in [
        plane_normals(&positions, &neighbors, 16),
        weighted_plane_normals(&positions, &neighbors, 16),
    ] {
        let (mut flat, mut edge): (f64, f64) = (0.0, 0.0);
        for (seen, normal) in trial.seen.iter().zip(&normals) {
            let truth = trial.body.faces[seen.face].nearest(seen.clean).1;
            let angle = normal
                .as_dvec3()
                .dot(truth)
                .abs()
                .min(1.0)
                .acos()
                .to_degrees();
            let from_edge = trial.body.edge_distance(seen.clean) / trial.unit_mm;
            if from_edge > 4.0 && seen.face < 6 {
                flat = flat.max(angle);
            } else if from_edge < 0.5 {
                edge = edge.max(angle);
            }
        }
        assert!(flat < 1e-3, "{flat} degrees");
        assert!(
            edge > 20.0,
            "{edge} degrees: these are the methods that round edges"
        );
    }
}
