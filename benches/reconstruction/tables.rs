//! Tables 3 to 6 of Weber 2011 by his measures: his numbers, his method as it stands here, and ours.
//!
//! Tables 3 and 4: distance of the feature line to the true edge. He looks at one neighbourhood, here all of them count: five places on the
//! curve of every neighbourhood that has one, and all samples of our lines. Tables 5 and 6: distance of every output point to the nearest
//! data point; it rewards staying on the noise. His lengths are divided by his spacing of 0.125, ours by ours. His noise is uniform in a
//! ball whose radius is a part of the size of the data; which size he means the text leaves open, here it is half of the diagonal.

use acies::features::{Method, detect};
use acies::points::{Frame, Neighbors, PointCloud};
use acies::surface::{Degree, Settings, ThesisSettings, ThesisSurface, reconstruct};
use glam::DVec3;

use super::truth::{Dice, Edge};
use super::{fandisk_samples, figures};

/// Unit of his lengths.
const HIS_SPACING: f64 = 0.125;

/// What is measured of a cloud.
struct Measured {
    /// Errors of the feature lines, his method and ours, straight edges and curved ones.
    lines: [[Vec<f64>; 2]; 2],
    /// Distance of the output to the data, his method and ours.
    to_data: [Vec<f64>; 2],
}

/// Distance to the nearest true edge, and whether that is curved.
type EdgeDistance<'a> = &'a dyn Fn(DVec3) -> (f64, bool);

fn measure(positions: Vec<DVec3>, unit_mm: f64, edge: EdgeDistance) -> Measured {
    let neighbors = Neighbors::new(&positions);
    let cloud = PointCloud::from_positions(Frame::Part, positions);
    let result = reconstruct(&cloud, &neighbors, Settings::default()).expect("enough points");
    let classes = detect(&cloud, &neighbors, Method::Adaptive).classes;
    // His k, and his h of 0.1 at a spacing of 0.125.
    let settings = ThesisSettings {
        k: 20,
        h_mm: 0.8 * unit_mm,
        degree: Degree::Two,
    };
    let thesis = ThesisSurface::new(&cloud.positions, &neighbors, &classes, settings);
    let mut lines: [[Vec<f64>; 2]; 2] = Default::default();
    let mut add = |method: usize, p: DVec3| {
        let (distance, is_curved) = edge(p);
        lines[method][usize::from(is_curved)].push(distance / unit_mm);
    };
    for line in cloud
        .positions
        .iter()
        .filter_map(|p| thesis.feature_line(*p))
    {
        (0..5).for_each(|k| add(0, line.at(f64::from(k) / 4.0)));
    }
    result.lines.iter().for_each(|l| add(1, l.position));
    let his: Vec<DVec3> = thesis.project_all().iter().flatten().map(|p| p.0).collect();
    let to_data = [&his, &result.positions].map(|output| to_data(output, &neighbors, unit_mm));
    Measured { lines, to_data }
}

/// Distance of each output point to the nearest data point, in units.
pub fn to_data(output: &[DVec3], data: &Neighbors, unit_mm: f64) -> Vec<f64> {
    let mut found = Vec::new();
    let nearest = |p: &DVec3| {
        data.nearest(*p, 1, &mut found);
        found[0].1.sqrt() / unit_mm
    };
    output.iter().map(nearest).collect()
}

/// The cube with hole of 60,000 points with points on its edges and noise in percent.
fn cube(percent: f64) -> Measured {
    let trial = figures::cube_trial(96, percent);
    let edge = |p: DVec3| {
        let of = |e: &Edge| (e.distance(p), matches!(e, Edge::Circle(..)));
        let all = trial.body.edges.iter().map(of);
        all.min_by(|a, b| a.0.total_cmp(&b.0)).expect("edges")
    };
    let positions = trial.seen.iter().map(|s| s.noisy).collect();
    measure(positions, trial.unit_mm, &edge)
}

/// Two bilinear strips of 22,350 points that meet along the y axis at 45° to 140°, with points on the edge and noise in percent.
fn planes(percent: f64) -> Measured {
    let mut dice = Dice(17);
    let (along, across) = (150i32, 74i32);
    let length = f64::from(along - 1) * HIS_SPACING;
    let width = f64::from(across) * HIS_SPACING;
    let radius = 0.5 * (length * length + 2.0 * width * width).sqrt() * percent / 100.0;
    let mut positions = Vec::new();
    for i in 0..along {
        let t = f64::from(i) / f64::from(along - 1);
        for j in -across..=across {
            let down = |included: f64| {
                let half = (0.5 * included).to_radians();
                DVec3::new(half.sin() * f64::from(j.signum()), 0.0, -half.cos())
            };
            let off = down(45.0).lerp(down(140.0), t) * (f64::from(j.abs()) * HIS_SPACING);
            positions.push(DVec3::Y * (t * length) + off + dice.ball() * radius);
        }
    }
    let edge = |p: DVec3| (p.distance(DVec3::Y * p.y.clamp(0.0, length)), false);
    measure(positions, HIS_SPACING, &edge)
}

fn print(name: &str, his: (f64, f64), [thesis, ours]: [&[f64]; 2]) {
    let pair = |v: &[f64]| {
        if v.is_empty() {
            return "none".to_owned();
        }
        let worst = v.iter().copied().fold(0.0, f64::max);
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        format!("{worst:.3} / {mean:.3}")
    };
    let his = format!("{:.3} / {:.3}", his.0 / HIS_SPACING, his.1 / HIS_SPACING);
    println!("{name:<40}{his:>18}{:>18}{:>18}", pair(thesis), pair(ours));
}

/// Prints the tables; those of the fandisk where the text of its mesh is given.
pub fn print_all(fandisk: Option<&str>) {
    println!();
    println!("Weber 2011, largest / mean in spacings of the points");
    println!(
        "{:<40}{:>18}{:>18}{:>18}",
        "table, cloud", "his", "his method here", "ours"
    );
    let cubes = [0.0, 0.5, 1.0, 2.0].map(cube);
    let strips = [0.0, 0.5, 1.0, 2.0].map(planes);
    let fandisk = fandisk.map(|mesh| {
        let (positions, unit_mm, creases) = fandisk_samples(mesh, 39_569, 0.0);
        let edge = |p: DVec3| {
            let all = creases.iter().map(|e| e.distance(p));
            (all.fold(f64::INFINITY, f64::min), false)
        };
        measure(positions, unit_mm, &edge)
    });
    let lines =
        |m: &Measured, curved: usize| [m.lines[0][curved].clone(), m.lines[1][curved].clone()];
    let line_row = |name: &str, his, m: &Measured, curved| {
        let [thesis, ours] = lines(m, curved);
        print(name, his, [&thesis, &ours]);
    };
    let data_row = |name: &str, his, m: &Measured| print(name, his, [&m.to_data[0], &m.to_data[1]]);
    line_row("3  line, cube, straight edge", (0.0, 0.0), &cubes[0], 0);
    if let Some(m) = &fandisk {
        line_row("3  line, fandisk", (0.0740, 0.0318), m, 0);
    }
    line_row(
        "3  line, cube with hole, in the hole",
        (0.0447, 0.0206),
        &cubes[0],
        1,
    );
    let of_noise = [
        ("0.5 %", (0.0457, 0.0185), (0.0667, 0.0474)),
        ("1 %", (0.0880, 0.0363), (0.0712, 0.0644)),
        ("2 %", (0.0785, 0.0591), (0.1042, 0.0752)),
    ];
    for (i, (noise, his, _)) in of_noise.iter().enumerate() {
        line_row(
            &format!("4  line, in the hole, noise {noise}"),
            *his,
            &cubes[i + 1],
            1,
        );
    }
    line_row("4  line, planes", (0.0620, 0.0310), &strips[0], 0);
    for (i, (noise, _, his)) in of_noise.iter().enumerate() {
        line_row(
            &format!("4  line, planes, noise {noise}"),
            *his,
            &strips[i + 1],
            0,
        );
    }
    data_row("5  to data, cube with hole", (0.17, 0.018), &cubes[0]);
    data_row("5  to data, planes", (0.203, 0.008), &strips[0]);
    if let Some(m) = &fandisk {
        data_row("5  to data, fandisk", (0.204, 0.003), m);
    }
    data_row(
        "6  to data, cube with hole, noise 1 %",
        (0.43, 0.0307),
        &cubes[2],
    );
    data_row(
        "6  to data, planes, noise 0.5 %",
        (0.205, 0.0088),
        &strips[1],
    );
    data_row("6  to data, planes, noise 1 %", (0.22, 0.0168), &strips[2]);
    data_row("6  to data, planes, noise 2 %", (0.23, 0.0307), &strips[3]);
}
