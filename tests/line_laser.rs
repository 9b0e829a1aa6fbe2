//! Single profiles through the path of a live scan: bytes of a recorded link, the driver, the scan with its lattice, a file of
//! it, and the analysis. Five of a real line laser, and a drawn one that needs no data.

#[path = "line_laser/device.rs"]
mod device;

use std::path::{Path, PathBuf};
use std::time::Duration;

use acies::acquire::{Calibration, Profiling, Scan, ScanPlan, scan};
use acies::features::profile::{ProfileAnalysis, analyse};
use acies::geometry::RigidTransform;
use acies::points::write::scan_bytes;
use acies::points::{Encoding, PointCloud, Unit, parse, read};
use glam::{DMat3, DQuat, DVec2, DVec3};

const REAL: [&str; 5] = [
    "add01.csv",
    "add02.csv",
    "basic.csv",
    "reconstructed_profile.csv",
    "test1.csv",
];

fn file(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared/data/line-laser")
        .join(name);
    if !path.exists() {
        eprintln!("skipped: {} is not here", path.display());
        return None;
    }
    Some(path)
}

// ---- The path of a live profile ---------------------------------------------------------------------------------------

/// Scans one profile, which a replayed device sends, keeps it as a file, and analyses what comes back.
///
/// `columns` holds a point or nothing for each column, x and z in the plane of the sensor.
fn scanned(
    name: &str,
    columns: &[Option<DVec2>],
    sensor: RigidTransform,
) -> (PointCloud, ProfileAnalysis) {
    let profiling = Profiling {
        name: "laser".into(),
        profiler: device::profiler(columns),
        calibration: Calibration {
            machine_from_sensor: sensor,
            travel_mm_per_count: sensor.vector(DVec3::Y) * 0.01,
        },
    };
    // The only profile is taken at count 0, which ends the scan.
    let plan = ScanPlan {
        end_count: 0,
        silence: Duration::from_secs(20),
    };
    let (scan, _) = scan(vec![profiling], plan, &mut |_| {}).unwrap();
    check_nothing_lost(&scan, columns);
    let bytes = scan_bytes(&scan.cloud, Encoding::LittleEndian).unwrap();
    let kept = parse(Path::new("scan.ply"), &bytes, Unit::Millimetre).unwrap();
    assert_eq!(kept.cloud, scan.cloud);
    let analysis = analyse(&kept.cloud.positions);
    print(name, &scan.cloud, &analysis);
    (scan.cloud, analysis)
}

/// Every point of every column came, at its place to half a count, and under its column.
fn check_nothing_lost(scan: &Scan, columns: &[Option<DVec2>]) {
    let [view] = &scan.views[..] else {
        panic!("{} views", scan.views.len());
    };
    assert_eq!(view.findings, [""; 0]);
    assert!(view.complete);
    assert_eq!((view.identity.serial.as_str(), view.unplaced), ("L-7", 0));
    let losses = view.losses;
    assert_eq!((losses.received, losses.lost_on_link), (1, 0));
    assert_eq!(
        (
            losses.dropped_by_device,
            losses.rejected,
            losses.skipped_bytes
        ),
        (0, 0, 0)
    );
    let seen = columns.iter().enumerate().filter(|(_, c)| c.is_some());
    let seen: Vec<usize> = seen.map(|(i, _)| i).collect();
    assert_eq!(view.empty_columns as usize, columns.len() - seen.len());
    scan.cloud.check_lattice().unwrap();
    let origins = scan.cloud.origins.iter();
    let origins: Vec<usize> = origins.map(|o| usize::from(o.column)).collect();
    assert_eq!(origins, seen);
}

/// Half a count in x and in z, and the rounding of the transforms.
const QUANTISATION_MM: f64 = 0.5 * std::f64::consts::SQRT_2 * device::COUNT_MM + 1e-10;

#[allow(
    clippy::print_stdout,
    reason = "the figures are to be seen with --nocapture"
)]
fn print(name: &str, cloud: &PointCloud, analysis: &ProfileAnalysis) {
    eprintln!(
        "{name}: {} points, spacing {:.4} mm, noise {:.2} um, {} outliers, {} breaks, {} corners",
        cloud.len(),
        analysis.spacing_mm,
        analysis.noise_mm * 1e3,
        analysis.outliers.len(),
        analysis.breaks.len(),
        analysis.corners.len()
    );
    for corner in &analysis.corners {
        eprintln!(
            "  turns by {:.2} +- {:.2} degrees at ({:.3}, {:.3}, {:.3}) +- {:.3} mm",
            corner.turn_angle_rad.to_degrees(),
            corner.turn_angle_sigma_rad.to_degrees(),
            corner.position.x,
            corner.position.y,
            corner.position.z,
            corner.position_sigma_mm
        );
    }
}

// ---- Real profiles ----------------------------------------------------------------------------------------------------

/// Pose of a sensor in the plane of the laser, which the calibration of the camera gives: x along the line, z down to the
/// table, whose normal is close to the camera's y.
fn sensor() -> Option<RigidTransform> {
    let bytes = std::fs::read(file("laser_plane_calibration.npz")?).unwrap();
    // An archive that is not compressed, of one array (NumPy's format 1.0): its header, then a, b, c, d of a x + b y + c z + d = 0.
    let at = bytes.windows(6).position(|w| w == b"\x93NUMPY").unwrap();
    let header = u16::from_le_bytes([bytes[at + 8], bytes[at + 9]]);
    let numbers: Vec<f64> = bytes[at + 10 + usize::from(header)..][..32]
        .chunks_exact(8)
        .map(|b| f64::from_le_bytes(b.try_into().unwrap()))
        .collect();
    let normal = DVec3::new(numbers[0], numbers[1], numbers[2]);
    let foot = normal * (-numbers[3] / normal.length_squared());
    let y = normal.normalize();
    let x = DVec3::X.reject_from_normalized(y).normalize();
    let z = x.cross(y);
    let rotation = DMat3::from_cols(x, y, z);
    Some(RigidTransform::from_matrix(rotation, foot - z * 100.0))
}

/// The columns of the camera that `points` came from: the file leaves those out in which nothing was seen.
///
/// A column is a ray of the camera at the origin, and rays are evenly apart in x / z.
fn columns_of(points: &[DVec3], sensor: RigidTransform) -> Vec<Option<DVec2>> {
    let steps = points.windows(2).map(|p| p[1].x / p[1].z - p[0].x / p[0].z);
    let steps: Vec<f64> = steps.collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let step = sorted[sorted.len() / 2];
    let sensor_from_machine = sensor.inverse();
    let mut columns = Vec::new();
    for (i, point) in points.iter().enumerate() {
        if i > 0 {
            let passed = (steps[i - 1] / step).round() as usize;
            columns.extend((1..passed).map(|_| None));
        }
        let p = sensor_from_machine.point(*point);
        assert!(p.y.abs() < 1e-9, "{point} is not in the plane of the laser");
        columns.push(Some(DVec2::new(p.x, p.z)));
    }
    columns
}

/// A real profile through the path of a live one; the points must come out as they are in the file.
fn analysed(name: &str) -> Option<(PointCloud, ProfileAnalysis)> {
    let sensor = sensor()?;
    let text = read(&file(name)?, Unit::Millimetre).unwrap();
    assert_eq!(text.findings, [""; 0], "{name}");
    let points = text.cloud.positions;
    let columns = columns_of(&points, sensor);
    // The camera has 5,472 columns.
    assert!(
        (5471..=5472).contains(&columns.len()),
        "{name}: {}",
        columns.len()
    );
    let (cloud, analysis) = scanned(name, &columns, sensor);
    assert_eq!(cloud.len(), points.len());
    for (found, point) in cloud.positions.iter().zip(&points) {
        assert!(
            found.distance(*point) <= QUANTISATION_MM,
            "{name}: {found} for {point}"
        );
    }
    Some((cloud, analysis))
}

/// The way over the link changes no figure beyond the last count.
fn check_against_text(name: &str, live: &ProfileAnalysis) {
    let Some(path) = file(name) else { return };
    let text = read(&path, Unit::Millimetre).unwrap();
    let direct = analyse(&text.cloud.positions);
    assert!(
        (live.noise_mm - direct.noise_mm).abs() < device::COUNT_MM,
        "{name}"
    );
    assert_eq!(live.corners.len(), direct.corners.len(), "{name}");
    for (a, b) in live.corners.iter().zip(&direct.corners) {
        // A corner is where lines over many points meet: it shares their rounding, over the sine of its angle.
        let allowed = device::COUNT_MM / b.turn_angle_rad.sin();
        assert_eq!(a.before, b.before, "{name}");
        assert!(
            a.position.distance(b.position) < allowed,
            "{name}: {a:?} {b:?}"
        );
    }
}

#[test]
fn spacing_and_noise_are_those_measured_by_hand() {
    // Columns are 0.0300 mm apart in x (by the first and last lines of the files). Second differences over one column
    // and over eight give 7 and 17 to 26 um by another program: neighbours share part of their noise, so the truth for
    // fits over some columns lies between.
    for name in REAL {
        let Some((_, analysis)) = analysed(name) else {
            continue;
        };
        check_against_text(name, &analysis);
        assert!(
            (0.0295..0.0315).contains(&analysis.spacing_mm),
            "{name}: {} mm",
            analysis.spacing_mm
        );
        assert!(
            (0.008..0.020).contains(&analysis.noise_mm),
            "{name}: {} mm",
            analysis.noise_mm
        );
    }
}

#[test]
fn a_bare_table_has_reflections_and_no_corner() {
    let Some((scan, analysis)) = analysed("basic.csv") else {
        return;
    };
    assert_eq!(analysis.corners, []);
    // The table's middle height near a point, by the median of 101: a reflection is one spacing off it at least.
    let heights: Vec<f64> = scan.positions.iter().map(|p| p.y).collect();
    let off = |i: usize| {
        let mut near = heights[i.saturating_sub(50)..heights.len().min(i + 51)].to_vec();
        near.sort_by(f64::total_cmp);
        (heights[i] - near[near.len() / 2]).abs()
    };
    assert!(
        analysis.outliers.iter().all(|&i| off(i) > 0.03),
        "{:?}",
        analysis.outliers
    );
    assert!(
        (20..100).contains(&analysis.outliers.len()),
        "{:?}",
        analysis.outliers
    );
}

#[test]
fn the_kink_of_a_curved_lid_is_its_only_corner() {
    let Some((_, analysis)) = analysed("reconstructed_profile.csv") else {
        return;
    };
    // An arch from x = -44 to 74 mm on a table, with a gap at either end; the arch
    // falls by 24 degrees over its last millimetre, the straight side after it by 12 (slopes by another program).
    let corners: Vec<f64> = analysis.corners.iter().map(|c| c.position.x).collect();
    assert!(
        corners.len() == 1 && (corners[0] - 28.8).abs() < 0.5,
        "{:?}",
        analysis.corners
    );
    let turn = analysis.corners[0].turn_angle_rad.to_degrees();
    assert!(
        (7.0..14.0).contains(&turn),
        "{turn} degrees; slopes over 1 and 2 mm on either side differ by 12 and 7"
    );
}

// ---- A drawn profile --------------------------------------------------------------------------------------------------

/// Noise of the drawn profile in x and in z.
const DRAWN_NOISE_MM: f64 = 0.005;
/// Corners of the drawn profile in the plane of the sensor: a gabled ridge on a table.
const DRAWN_CORNERS: [DVec2; 3] = [
    DVec2::new(-15.02, 150.0),
    DVec2::new(-0.02, 135.0),
    DVec2::new(14.98, 150.0),
];

/// 1,601 columns every 0.05 mm over a table with a ridge of 90 degrees, 5 um of noise, one column in 40 without a point.
fn drawn() -> Vec<Option<DVec2>> {
    let mut state = 20u64;
    // Knuth's congruential generator; the sum of twelve uniform numbers is normal enough within three sigma.
    let mut normal = || {
        let mut sum = -6.0;
        for _ in 0..12 {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            sum += (state >> 11) as f64 / (1u64 << 53) as f64;
        }
        sum
    };
    let ridge = DRAWN_CORNERS[1];
    let mut column = |i: usize| {
        let x = -40.0 + 0.05 * i as f64;
        let z = (ridge.y + (x - ridge.x).abs()).min(150.0);
        let noise = DVec2::new(normal(), normal()) * DRAWN_NOISE_MM;
        (i % 40 != 7).then_some(DVec2::new(x, z) + noise)
    };
    (0..1601).map(&mut column).collect()
}

#[test]
fn a_drawn_ridge_has_its_corners_and_its_noise() {
    let turned = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 2.0);
    let sensor = RigidTransform::new(turned, DVec3::new(-70.0, 35.0, 155.0));
    let columns = drawn();
    let (cloud, analysis) = scanned("drawn", &columns, sensor);
    for (found, flat) in cloud.positions.iter().zip(columns.iter().flatten()) {
        let expected = sensor.point(DVec3::new(flat.x, 0.0, flat.y));
        assert!(
            found.distance(expected) <= QUANTISATION_MM,
            "{found} for {expected}"
        );
    }
    // 1,560 residuals know their spread to 1 in 40; the median costs some of it.
    assert!(
        (analysis.noise_mm / DRAWN_NOISE_MM - 1.0).abs() < 0.1,
        "{} mm",
        analysis.noise_mm
    );
    assert_eq!(
        (&analysis.outliers[..], &analysis.breaks[..]),
        (&[][..], &[][..])
    );
    assert_eq!(analysis.corners.len(), 3, "{:?}", analysis.corners);
    for ((corner, flat), turn_deg) in analysis
        .corners
        .iter()
        .zip(DRAWN_CORNERS)
        .zip([45.0, 90.0, 45.0])
    {
        let error_mm = corner
            .position
            .distance(sensor.point(DVec3::new(flat.x, 0.0, flat.y)));
        let error_rad = (corner.turn_angle_rad - f64::to_radians(turn_deg)).abs();
        assert!(
            error_mm < 4.0 * corner.position_sigma_mm,
            "{error_mm} mm: {corner:?}"
        );
        assert!(
            error_rad < 4.0 * corner.turn_angle_sigma_rad,
            "{error_rad}: {corner:?}"
        );
    }
}
