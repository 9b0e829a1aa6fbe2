//! Against spheres cut exactly by the laser plane of a sensor whose pose is known.

use std::time::Instant;

use super::*;

/// SplitMix64, and normal numbers from twelve uniform ones.
struct Numbers(u64);

impl Numbers {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    fn vector(&mut self, size: f64) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal()) * size
    }
}

fn truth() -> Calibration {
    let down = DQuat::from_axis_angle(DVec3::X, std::f64::consts::PI);
    let tilted = DQuat::from_scaled_axis(DVec3::new(0.3, -0.1, 0.05)) * down;
    Calibration {
        machine_from_sensor: RigidTransform::new(tilted, DVec3::new(100.0, 20.0, 250.0)),
        travel_mm_per_count: DVec3::new(0.000_01, 0.002, -0.000_02),
    }
}

/// Where the sensor sees a sphere of radius 12.7 about `centre`, from straight along its z at 200 columns, every 200 counts; at most to
/// 60 degrees of incidence.
fn scan(centre: DVec3, sigma: f64, numbers: &mut Numbers) -> SphereScan {
    const RADIUS: f64 = 12.7;
    let at = truth();
    let mut profiles = Vec::new();
    for sequence in 0..400u32 {
        let encoder = i64::from(sequence) * 200 - 20_000;
        let shift = at.travel_mm_per_count * encoder as f64;
        let (mut x_mm, mut z_mm) = (Vec::new(), Vec::new());
        for column in 0..200 {
            let x = 0.25 * (f64::from(column) - 100.0);
            let from = at.machine_from_sensor.point(DVec3::new(x, 0.0, 0.0)) + shift - centre;
            let along = at.machine_from_sensor.vector(DVec3::Z);
            let half = from.dot(along);
            let root = half * half - from.length_squared() + RADIUS * RADIUS;
            let z = -half - root.max(0.0).sqrt();
            let incidence = -(from + along * z).dot(along) / RADIUS;
            x_mm.push(x);
            // Noise along the normal is noise / cos(incidence) along the ray.
            z_mm.push(if root > 0.0 && incidence > 0.5 {
                z + sigma * numbers.normal() / incidence
            } else {
                f64::NAN
            });
        }
        profiles.push(Profile {
            sequence,
            boot: 1,
            device_time_ns: 0,
            encoder: Some(encoder),
            host_time: Instant::now(),
            dropped: 0,
            saturated: false,
            x_mm,
            z_mm,
            intensity: Vec::new(),
        });
    }
    SphereScan {
        profiles,
        centre_mm: centre,
        u_centre_mm: 0.001,
        radius_mm: RADIUS,
    }
}

/// Three places within the field, not on one line.
fn places() -> [DVec3; 3] {
    let at = truth();
    [(-8.0, -10.0, 0.0), (10.0, 12.0, 15.0), (-6.0, 25.0, -14.0)].map(|(x, y, z)| {
        let middle = at.machine_from_sensor.point(DVec3::new(x, 0.0, 190.0 + z));
        middle + DVec3::new(0.0, y, 0.0)
    })
}

fn rough(numbers: &mut Numbers) -> Calibration {
    let pose = truth().machine_from_sensor;
    let turn = DQuat::from_scaled_axis(numbers.vector(0.01));
    Calibration {
        machine_from_sensor: RigidTransform::new(
            turn * pose.rotation,
            pose.translation + numbers.vector(1.0),
        ),
        travel_mm_per_count: DVec3::new(0.0, 0.002, 0.0),
    }
}

#[test]
fn three_touched_spheres_give_pose_and_travel_within_their_uncertainty() {
    let mut z2 = Vec::new();
    for seed in 0..8u64 {
        let mut numbers = Numbers(1000 + seed);
        let scans: Vec<SphereScan> = places()
            .iter()
            .map(|place| {
                let mut scan = scan(*place, 0.01, &mut numbers);
                scan.centre_mm += numbers.vector(scan.u_centre_mm);
                scan
            })
            .collect();
        let found = calibrate_profiler(&scans, &rough(&mut numbers), 0.01).expect("a calibration");
        assert!((found.rms_mm / 0.01 - 1.0).abs() < 0.05, "{}", found.rms_mm);
        let (at, was) = (found.calibration, truth());
        let turn = (at.machine_from_sensor.rotation * was.machine_from_sensor.rotation.inverse())
            .to_scaled_axis();
        let shift = at.machine_from_sensor.translation - was.machine_from_sensor.translation;
        let travel = (at.travel_mm_per_count - was.travel_mm_per_count) * COUNTS;
        let errors = [turn, shift, travel].map(|v| v.to_array());
        for (i, error) in errors.into_iter().flatten().enumerate() {
            z2.push(error * error / found.covariance[i][i]);
        }
        for sphere in &found.spheres {
            assert!(sphere.points > 1000);
        }
    }
    // 72 numbers of which the nine of one seed hang together: as good as 24 free ones, 4 standard deviations.
    let mean = z2.iter().sum::<f64>() / z2.len() as f64;
    assert!((mean - 1.0).abs() < 4.0 * (2.0f64 / 24.0).sqrt(), "{mean}");
}

#[test]
fn one_sphere_leaves_a_rotation_open_and_the_error_says_which() {
    let mut numbers = Numbers(7);
    let scans = [scan(places()[0], 0.01, &mut numbers)];
    let error = calibrate_profiler(&scans, &rough(&mut numbers), 0.01).expect_err("one sphere");
    assert!(
        matches!(error, CalibrateError::Open { spheres: 1, .. }),
        "{error}"
    );
    assert!(
        error.to_string().contains("scan the sphere at more places"),
        "{error}"
    );
}

#[test]
fn a_scan_without_a_sphere_is_refused() {
    let mut numbers = Numbers(8);
    let mut empty = scan(places()[0], 0.01, &mut numbers);
    for profile in &mut empty.profiles {
        profile.z_mm.fill(200.0);
    }
    let error = calibrate_profiler(&[empty], &truth(), 0.01).expect_err("a plane is no sphere");
    assert!(
        matches!(error, CalibrateError::NotFound { sphere: 1, .. }),
        "{error}"
    );
    assert!(calibrate_profiler(&[], &truth(), 0.01).is_err());
}

#[test]
fn the_tip_is_as_large_as_the_touched_sphere_is_too_large() {
    let mut numbers = Numbers(9);
    let centre = DVec3::new(10.0, 20.0, 30.0);
    let mut z2 = 0.0;
    for _ in 0..200 {
        let touches: Vec<DVec3> = (0..25)
            .map(|k| {
                // Five rings of five down to the equator.
                let polar = f64::from(k / 5) * std::f64::consts::FRAC_PI_8;
                let around = f64::from(k % 5) * std::f64::consts::TAU / 5.0 + f64::from(k / 5);
                let n = DVec3::new(
                    polar.sin() * around.cos(),
                    polar.sin() * around.sin(),
                    polar.cos(),
                );
                centre + n * (15.0 + 1.001 + 0.001 * numbers.normal())
            })
            .collect();
        let tip = tip_radius(&touches, 15.0).expect("twenty-five touches");
        z2 += ((tip.radius_mm - 1.001) / tip.u_radius_mm).powi(2) / 200.0;
        assert!(tip.sphere_centre_mm.distance(centre) < 0.005);
    }
    // Student's t with 21 degrees of freedom has variance 21 / 19; 4 standard deviations of a mean of 200.
    assert!((z2 - 21.0 / 19.0).abs() < 4.0 * 1.15 * 0.11, "{z2}");
    assert!(tip_radius(&[DVec3::ZERO; 3], 15.0).is_err());
}

#[test]
fn a_ball_bar_in_many_directions_shows_scale_and_squareness() {
    let mut numbers = Numbers(10);
    let made = AxisErrors {
        scale: [3e-5, -5e-5, 8e-5],
        squareness_rad: [1e-4, -6e-5, 4e-5],
        u: [0.0; 6],
        rms_mm: 0.0,
    };
    let pairs: Vec<(DVec3, DVec3, f64)> = (0..40)
        .map(|_| {
            let a = numbers.vector(100.0);
            let b = a + numbers.vector(1.0).normalize() * 300.0;
            let certified = made.corrected(a).distance(made.corrected(b));
            (a, b, certified + 0.0005 * numbers.normal())
        })
        .collect();
    let found = axis_errors(&pairs, 0.0005).expect("forty distances");
    let both = |e: &AxisErrors| [e.scale, e.squareness_rad].concat();
    for ((f, m), u) in both(&found).iter().zip(both(&made)).zip(found.u) {
        assert!((f - m).abs() < 4.0 * u, "{found:?}");
        assert!(u < 1e-5, "{u}");
    }
    let along_x: Vec<_> = pairs
        .iter()
        .map(|(a, _, l)| (*a, *a + DVec3::X * *l, *l))
        .collect();
    assert!(matches!(
        axis_errors(&along_x, 0.001),
        Err(CalibrateError::Open { .. })
    ));
    assert!(axis_errors(&pairs[..5], 0.001).is_err());
}
