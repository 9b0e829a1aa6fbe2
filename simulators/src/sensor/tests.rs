//! What a sensor sees, against cases computed by hand.

use super::*;
use crate::scene::{Bounds, Solid, Surface, Surfaces};

/// Looks straight down from z = 100 on a scene in its own frame: machine z is 100 - sensor z, machine x is sensor x.
fn looking_down(scene: Scene, optics: Optics) -> View {
    let rotation = glam::DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
    View {
        scene: Arc::new(scene),
        machine_from_scene: Pose::IDENTITY,
        machine_from_sensor: Pose {
            rotation,
            translation: DVec3::Z * 100.0,
        },
        optics,
        traverse: Traverse {
            axis: DVec3::Y,
            mm_per_count: 0.01,
            first_count: -500,
            step_counts: 50,
            profiles: 40,
        },
        columns: 200,
        seed: 11,
    }
}

/// A perfect sensor: parallel rays 0.2 mm apart, no noise, camera 45 degrees off towards machine -y.
fn perfect() -> Optics {
    Optics {
        near_mm: 60.0,
        far_mm: 140.0,
        width_mm: 40.0,
        fan: Fan::Parallel,
        camera_mm: DVec3::new(0.0, 100.0, 0.0),
        spot_mm: 0.0,
        blend_mm: 0.5,
        noise_mm: 0.0,
        drop_out: 0.0,
        incidence_limit_rad: 1.5,
        outliers: 0.0,
    }
}

/// The same with the camera so high above the laser that it sees whatever the laser reaches.
fn from_above() -> Optics {
    Optics {
        camera_mm: DVec3::NEG_Z * 1e4,
        ..perfect()
    }
}

fn floor(s: &mut Surfaces) -> Solid {
    Solid::region(s.add(Surface::plane("floor", DVec3::ZERO, DVec3::Z)))
}

/// A floor at z = 0 and a block of height 5 over x -4..4, y 0..10.
fn step() -> Scene {
    let mut s = Surfaces::default();
    let floor = floor(&mut s);
    let (block, _) = s.cuboid(
        "block",
        DVec3::new(-4.0, 0.0, -1.0),
        DVec3::new(4.0, 10.0, 5.0),
    );
    Scene::new(s, Solid::any([floor, block]))
}

fn flat() -> Scene {
    let mut s = Surfaces::default();
    let floor = floor(&mut s);
    Scene::new(s, floor)
}

/// Profile at a y: the encoder's position there, to half a count.
fn at_y(view: &View, y: f64) -> Line {
    let index = (y / 0.01 - view.traverse.first_count as f64) / view.traverse.step_counts as f64;
    view.line(index.round() as u32)
}

#[test]
fn a_perfect_sensor_reports_the_profile() {
    let view = looking_down(step(), from_above());
    let line = at_y(&view, 5.0);
    assert_eq!(line.encoder, 500);
    for (x, z) in line.x_mm.iter().zip(&line.z_mm) {
        let expected = if x.abs() < 4.0 { 95.0 } else { 100.0 };
        assert!((z - expected).abs() < 1e-9, "{x}: {z}");
    }
    assert!((line.x_mm[0] + 19.9).abs() < 1e-12 && (line.x_mm[199] - 19.9).abs() < 1e-12);
}

#[test]
fn the_camera_does_not_see_behind_a_step() {
    // the camera looks along +y and down at 45 degrees: behind the back of the block (y = 10) it misses floor up to y = 15.
    // It stands 100 mm before the line, so from the floor the line of sight rises 1:1
    let view = looking_down(step(), perfect());
    let middle = |y: f64| at_y(&view, y).z_mm[100];
    assert!(middle(10.5).is_nan() && middle(14.5).is_nan());
    assert!((middle(15.5) - 100.0).abs() < 1e-9);
    assert!((middle(-0.5) - 100.0).abs() < 1e-9);
    // beside the block nothing is hidden
    assert!((at_y(&view, 12.0).z_mm[0] - 100.0).abs() < 1e-9);
}

#[test]
fn the_laser_does_not_reach_into_its_own_shadow() {
    // rays diverge from z = 0, x = 0: over the block's side x = 4 at height 5 the shadow on the floor ends at 4 * 100 / 95
    let optics = Optics {
        fan: Fan::Diverging(0.0),
        ..from_above()
    };
    let line = at_y(&looking_down(step(), optics), 5.0);
    let floor = line.x_mm.iter().zip(&line.z_mm).filter(|p| *p.1 > 99.0);
    let nearest = floor.map(|p| p.0.abs()).fold(f64::INFINITY, f64::min);
    assert!(
        (4.0 * 100.0 / 95.0..4.0 * 100.0 / 95.0 + 0.2).contains(&nearest),
        "{nearest}"
    );
}

#[test]
fn points_of_a_diverging_fan_lie_on_their_rays() {
    let optics = Optics {
        fan: Fan::Diverging(-50.0),
        ..perfect()
    };
    let line = at_y(&looking_down(step(), optics), 5.0);
    for (i, (x, z)) in line.x_mm.iter().zip(&line.z_mm).enumerate() {
        let in_the_middle = 40.0 * ((i as f64 + 0.5) / 200.0 - 0.5);
        assert!((x - in_the_middle * (z + 50.0) / 150.0).abs() < 1e-9);
    }
}

#[test]
fn a_spot_across_a_low_step_mixes_and_across_a_high_one_does_not() {
    // spot of 0.8 mm: parts of weight 1/8 at 0.4 mm to each side. The step's side x = 4 is 0.1 mm beside a column at 3.9
    let height = |z: f64| {
        let mut s = Surfaces::default();
        let floor = floor(&mut s);
        let (block, _) = s.cuboid("b", DVec3::new(-4.0, -9.0, -1.0), DVec3::new(4.0, 9.0, z));
        let scene = Scene::new(s, Solid::any([floor, block]));
        let optics = Optics {
            spot_mm: 0.8,
            ..perfect()
        };
        let line = at_y(&looking_down(scene, optics), 0.0);
        let column = line.x_mm.iter().position(|x| (x - 3.9).abs() < 1e-9);
        100.0 - line.z_mm[column.unwrap()]
    };
    assert!((height(0.4) - 0.4 * 7.0 / 8.0).abs() < 1e-9);
    assert!((height(5.0) - 5.0).abs() < 1e-9);
}

#[test]
fn noise_grows_with_the_incidence_and_is_normal() {
    let deviations = |tilt: f64| {
        let mut s = Surfaces::default();
        let normal = DVec3::new(0.0, -tilt.sin(), tilt.cos());
        let plane = Solid::region(s.add(Surface::plane("p", DVec3::ZERO, normal)));
        let optics = Optics {
            noise_mm: 0.02,
            ..perfect()
        };
        let view = looking_down(Scene::new(s, plane), optics);
        let lines = (0..40).map(|i| view.line(i));
        // along the ray; the true height changes with the position inside half a count, so only where the ground is level
        lines
            .flat_map(|line| {
                let mean = line.z_mm.iter().sum::<f64>() / 200.0;
                line.z_mm.into_iter().map(move |z| z - mean)
            })
            .collect::<Vec<f64>>()
    };
    for tilt in [0.0, 1.0_f64] {
        let d = deviations(tilt);
        let n = d.len() as f64;
        let variance = d.iter().map(|d| d * d).sum::<f64>() / (n * 199.0 / 200.0);
        let ratio = variance.sqrt() * tilt.cos() / 0.02;
        // 8000 draws: the standard deviation of a standard deviation is 0.8 %
        assert!((0.97..1.03).contains(&ratio), "{ratio}");
        let beyond = d.iter().filter(|d| d.abs() > 2.0 * variance.sqrt()).count() as f64 / n;
        assert!((0.037..0.054).contains(&beyond), "{beyond}");
    }
}

#[test]
fn nothing_comes_back_at_grazing_incidence_from_dark_places_or_beyond_the_range() {
    let steep = |limit: f64| {
        let mut s = Surfaces::default();
        let normal = DVec3::new(0.0, -1.2_f64.sin(), 1.2_f64.cos());
        let plane = Solid::region(s.add(Surface::plane("p", DVec3::ZERO, normal)));
        let optics = Optics {
            incidence_limit_rad: limit,
            ..perfect()
        };
        at_y(&looking_down(Scene::new(s, plane), optics), 0.0).z_mm[7]
    };
    assert!(steep(1.1).is_nan() && !steep(1.3).is_nan());

    let mut dark = flat();
    let corner = DVec3::new(3.0, 1.0, 1.0);
    dark.dark.push(Bounds::new(-corner, corner));
    let line = at_y(&looking_down(dark, perfect()), 0.0);
    for (x, z) in line.x_mm.iter().zip(&line.z_mm) {
        assert_eq!(z.is_nan(), x.abs() <= 3.0, "{x}");
    }

    let short = Optics {
        far_mm: 99.0,
        ..perfect()
    };
    let line = at_y(&looking_down(step(), short), 5.0);
    for (x, z) in line.x_mm.iter().zip(&line.z_mm) {
        assert_eq!(z.is_nan(), x.abs() > 4.0, "{x}");
        assert!(x.is_finite());
    }
}

#[test]
fn drop_outs_and_reflections_come_at_their_rates() {
    let optics = Optics {
        drop_out: 0.1,
        outliers: 0.05,
        ..perfect()
    };
    let view = looking_down(flat(), optics);
    let lines: Vec<Line> = (0..40).map(|i| view.line(i)).collect();
    let z: Vec<f64> = lines.into_iter().flat_map(|l| l.z_mm).collect();
    let lost = z.iter().filter(|z| z.is_nan()).count() as f64;
    let wrong = z.iter().filter(|z| (**z - 100.0).abs() > 1e-6).count() as f64;
    // 8000 points: standard deviations 27 and 18; reflections are drawn of what is left
    assert!((lost - 800.0).abs() < 110.0, "{lost}");
    assert!((wrong - 360.0).abs() < 75.0, "{wrong}");
}

#[test]
fn the_same_seed_gives_the_same_bits_in_any_order_on_any_number_of_threads() {
    use rayon::prelude::*;
    let optics = Optics {
        noise_mm: 0.01,
        drop_out: 0.1,
        spot_mm: 0.3,
        ..perfect()
    };
    let view = looking_down(step(), optics);
    let bits = |lines: Vec<Line>| -> Vec<u64> {
        let numbers = lines.iter().flat_map(|l| l.x_mm.iter().chain(&l.z_mm));
        numbers.map(|v| v.to_bits()).collect()
    };
    let alone = bits((0..40).map(|i| view.line(i)).collect());
    let mut backward: Vec<Line> = (0..40).rev().map(|i| view.line(i)).collect();
    backward.reverse();
    assert_eq!(alone, bits(backward));
    for threads in [1, 4] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let lines = pool.install(|| (0..40).into_par_iter().map(|i| view.line(i)).collect());
        assert_eq!(alone, bits(lines), "{threads} threads");
    }
    let other = View { seed: 12, ..view };
    assert_ne!(alone, bits((0..40).map(|i| other.line(i)).collect()));
}
