//! Profiles of a real line laser, read from text, kept as a scan of one profile and analysed like a live one.

use std::path::{Path, PathBuf};

use acies::features::profile::{ProfileAnalysis, analyse};
use acies::points::write::scan_bytes;
use acies::points::{Encoding, Origin, PointCloud, Unit, View, parse, read};
use glam::DVec3;

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

/// Reads a profile, keeps it as a scan with its lattice, and analyses what comes back.
fn analysed(name: &str) -> Option<(PointCloud, ProfileAnalysis)> {
    let read = read(&file(name)?, Unit::Millimetre).unwrap();
    assert_eq!(read.findings, [""; 0], "{name}");
    let mut scan = read.cloud;
    let column = |i: usize| Origin {
        view: 0,
        column: u16::try_from(i).unwrap(),
        profile: 0,
    };
    scan.origins = (0..scan.len()).map(column).collect();
    // The laser stands above the table, whose normal is close to y.
    scan.views = vec![View {
        device: "line laser".into(),
        towards_sensor: DVec3::Y,
    }];
    let bytes = scan_bytes(&scan, Encoding::LittleEndian).unwrap();
    let back = parse(Path::new("scan.ply"), &bytes, Unit::Millimetre).unwrap();
    assert_eq!(back.cloud, scan);
    let analysis = analyse(&back.cloud.positions);
    Some((scan, analysis))
}

#[test]
fn spacing_and_noise_are_those_measured_by_hand() {
    // Columns are 0.0300 mm apart in x (by the first and last lines of the files). Second differences over one column
    // and over eight give 7 and 17 to 26 um by another program: neighbours share part of their noise, so the truth for
    // fits over some columns lies between.
    for name in [
        "add01.csv",
        "add02.csv",
        "basic.csv",
        "reconstructed_profile.csv",
        "test1.csv",
    ] {
        let Some((_, analysis)) = analysed(name) else {
            continue;
        };
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
