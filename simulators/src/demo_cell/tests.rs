//! The cell: everything in reach and in the field, whatever the seed.

use super::*;
use crate::contact::Move;

#[test]
fn the_part_is_off_by_no_more_than_stated_and_seldom_by_nothing() {
    let centre = DVec3::new(40.0, 25.0, PLATE_TOP_MM);
    let mut sum = 0.0;
    for seed in 0..50 {
        let cell = DemoCell::new(seed);
        let off = cell
            .machine_from_fixture
            .inverse()
            .after(cell.machine_from_part);
        let shift = (off.point(centre) - centre).length();
        let cos =
            0.5 * (off.rotation.x_axis.x + off.rotation.y_axis.y + off.rotation.z_axis.z - 1.0);
        assert!(shift <= MISPLACED_MM && cos.acos() <= MISTURNED_RAD + 1e-12);
        sum += shift;
    }
    // 50 draws of the mean 1: standard deviation 0.08
    assert!((0.7..1.3).contains(&(sum / 50.0)), "{sum}");
}

#[test]
fn calibration_errors_have_the_stated_size_and_are_none_by_default() {
    let cell = DemoCell::new(3);
    for sensor in &cell.sensors {
        assert_eq!(
            sensor.stated_machine_from_sensor,
            sensor.view.machine_from_sensor
        );
    }
    let mut squares = 0.0;
    for seed in 0..40 {
        let cell = DemoCell::with_options(DemoOptions {
            calibration_error: [0.05, 0.0],
            ..DemoOptions::new(seed)
        });
        for sensor in &cell.sensors {
            let stated = sensor.stated_machine_from_sensor.inverse();
            squares += stated
                .after(sensor.view.machine_from_sensor)
                .translation
                .length_squared();
        }
    }
    // 240 draws: the mean square is within 9 % (one standard deviation)
    let sigma = (squares / 240.0).sqrt();
    assert!((0.043..0.057).contains(&sigma), "{sigma}");
}

#[test]
fn frames_are_right_handed_and_move_forward() {
    for sensor in DemoCell::new(1).sensors {
        let r = sensor.stated_machine_from_sensor.rotation;
        assert!((r.determinant() - 1.0).abs() < 1e-12);
        assert!(
            r.y_axis.dot(AXIS) > 0.8,
            "the plane of the laser must not contain the motion"
        );
        assert!(r.z_axis.z < -0.6, "looks down");
    }
}

#[test]
fn both_sensors_see_the_whole_part_whatever_the_pose() {
    for seed in 0..20 {
        let cell = DemoCell::new(seed);
        for sensor in &cell.sensors {
            let view = &sensor.view;
            let optics = &view.optics;
            let rotation = view.machine_from_sensor.rotation;
            let plane = DMat3::from_cols(rotation.x_axis, rotation.z_axis, AXIS).inverse();
            let travel = f64::from(view.traverse.profiles) * 0.4;
            let heights = [(2.0, 80.0), (12.0, 80.0), (25.0, 32.0)];
            for (z, length) in heights {
                for (x, y) in [(0.0, 0.0), (length, 0.0), (0.0, 50.0), (length, 50.0)] {
                    let p = cell.machine_from_part.point(DVec3::new(x, y, z));
                    let seen = plane * (p - view.machine_from_sensor.translation);
                    let half = 0.5 * optics.width_mm * (seen.y + 50.0) / 150.0;
                    assert!(
                        seen.x.abs() < half,
                        "{seed} {}: {x} {y} {z} at {seen}",
                        sensor.name
                    );
                    assert!((optics.near_mm..optics.far_mm).contains(&seen.y), "{seen}");
                    assert!((0.0..travel).contains(&seen.z), "{seen} of {travel}");
                }
            }
        }
    }
}

#[test]
fn every_touch_meets_its_face_whatever_the_pose() {
    for seed in 0..50 {
        let cell = DemoCell::new(seed);
        let part_from_machine = cell.machine_from_part.inverse();
        assert_eq!(cell.touches.len(), 6);
        for touch in &cell.touches {
            let ball = Move {
                from: part_from_machine.point(touch.start),
                to: part_from_machine.point(touch.target),
                radius: TIP_RADIUS_MM,
            };
            let contact = ball.first_contact(&cell.part.made).unwrap();
            let face = &cell.part.made.surfaces.get(contact.surface).name;
            assert!(contact.travel > 0.5, "seed {seed}: starts too near {face}");
            assert_eq!(face, touch.face, "seed {seed}");
        }
    }
}

#[test]
fn a_profile_of_the_cell_lies_on_the_part() {
    let cell = DemoCell::with_options(DemoOptions {
        defects: Defects::none(),
        ..DemoOptions::new(4)
    });
    let part_from_machine = cell.machine_from_part.inverse();
    for sensor in &cell.sensors {
        let mut view = sensor.view.clone();
        view.optics.noise_mm = 0.0;
        view.optics.spot_mm = 0.0;
        let line = view.line(view.traverse.profiles / 2);
        let travel = AXIS * (line.encoder as f64 * MM_PER_COUNT);
        let mut seen = 0;
        for (&x, &z) in line.x_mm.iter().zip(&line.z_mm).filter(|p| !p.1.is_nan()) {
            let machine = sensor
                .stated_machine_from_sensor
                .point(DVec3::new(x, 0.0, z))
                + travel;
            let p = part_from_machine.point(machine);
            let surfaces = cell.part.nominal.surfaces.iter();
            let off = surfaces
                .map(|(_, s)| s.value(p).abs())
                .fold(f64::INFINITY, f64::min);
            // the encoder is rounded to counts of 2 um
            assert!(off < 0.0011, "{off}");
            seen += 1;
        }
        assert!(seen > 400, "{} sees {seen}", sensor.name);
    }
}

#[test]
fn the_configuration_states_the_poses_of_the_sensors() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/demo/cell.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let sections = text.split("[device.calibration]").skip(1);
    let cell = DemoCell::new(1);
    let mut compared = 0;
    for (section, sensor) in sections.zip(&cell.sensors) {
        let vector = |key: &str| {
            let start = section.find(&format!("{key} = [")).unwrap() + key.len() + 4;
            let inner = &section[start..start + section[start..].find(']').unwrap()];
            let numbers: Vec<f64> = inner
                .split(',')
                .map(|n| n.trim().parse().unwrap())
                .collect();
            DVec3::from_slice(&numbers)
        };
        let stated = sensor.stated_machine_from_sensor;
        assert_eq!(vector("origin_mm"), stated.translation);
        assert!(vector("x_axis").distance(stated.rotation.x_axis) < 1e-15);
        assert!(vector("z_axis").distance(stated.rotation.z_axis) < 1e-15);
        compared += 1;
    }
    assert_eq!(compared, 2);
}
