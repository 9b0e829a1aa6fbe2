//! Statistics of flank fits on synthetic flanks whose truth is known by construction.

use super::*;

/// Seeded normal numbers (SplitMix64 and Box-Muller).
pub(crate) struct Noise(pub u64);

impl Noise {
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub(crate) fn normal(&mut self) -> f64 {
        let u = 1.0 - self.uniform();
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

const OFFSET: f64 = 0.12;
const TILT: f64 = -0.004;
const SIGMA: f64 = 0.010;
const LENGTH: f64 = 20.0;

struct Scene {
    seed: u64,
    /// Shared by all points of one line, mm.
    line_sigma: f64,
    /// Deviation that the linear model does not know: (r, s) to mm.
    extra: fn(f64, f64, &mut Noise) -> f64,
}

/// A flank 6 mm deep, lines 0.25 mm apart across the edge's direction, points each 0.05 mm.
fn scan(scene: &Scene) -> FlankPoints {
    let mut noise = Noise(scene.seed);
    let mut points = Vec::new();
    for line in 0..(LENGTH / 0.25) as u32 {
        let s = 0.25 * f64::from(line) + 0.1;
        let shared = scene.line_sigma * noise.normal();
        for k in 0..120 {
            let r = 0.05 * f64::from(k) + 0.05 * noise.uniform();
            let extra = (scene.extra)(r, s, &mut noise);
            let deviation = OFFSET + TILT * r + SIGMA * noise.normal() + shared + extra;
            points.push((s, r, deviation, line));
        }
    }
    FlankPoints::new(points)
}

const WINDOWS: Windows = Windows {
    count: 20,
    step_mm: 1.0,
};

const SETTINGS: FlankSettings = FlankSettings {
    reach_mm: 3.0,
    reach_limit_mm: 6.0,
    cut_mm: 0.1,
    spacing_mm: 0.05,
    min_points: 12,
    keep_designs: false,
};

/// (rms of z, share of |z| < 2, mean offset uncertainty, mean points) over 20 seeds of 20 stations.
fn z_scores(line_sigma: f64, extra: fn(f64, f64, &mut Noise) -> f64) -> (f64, f64, f64, f64) {
    let (mut square, mut inside, mut u_sum, mut n_sum, mut count) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for seed in 1..=20 {
        let points = scan(&Scene {
            seed,
            line_sigma,
            extra,
        });
        for station in measure_flank(&points, &WINDOWS, &SETTINGS).stations {
            let station = station.expect("a full flank is measured everywhere");
            let u = station.covariance[0][0].sqrt();
            let z = (station.offset_mm - OFFSET) / u;
            square += z * z;
            inside += f64::from(z.abs() < 2.0);
            u_sum += u;
            n_sum += station.points as f64;
            count += 1.0;
        }
    }
    (
        (square / count).sqrt(),
        inside / count,
        u_sum / count,
        n_sum / count,
    )
}

/// 400 squared normal variables: their mean has standard deviation sqrt(2 / 400) = 0.071, so the rms lies in
/// 1 +- 3 * 0.035; the share within 2, 0.954, has standard deviation 0.0105.
fn assert_honest(name: &str, (rms, share, u, n): (f64, f64, f64, f64)) {
    println!("{name}: z rms {rms:.3}, within two {share:.3}, u {u:.5} mm, {n:.0} points");
    assert!((0.89..1.11).contains(&rms), "{name}: z rms {rms}");
    assert!((0.922..0.986).contains(&share), "{name}: share {share}");
}

#[test]
fn white_noise_gives_honest_offsets_close_to_the_bound() {
    let z = z_scores(0.0, |_, _, _| 0.0);
    assert_honest("white", z);
    let bound = 2.0 * SIGMA / z.3.sqrt();
    assert!(z.2 < 1.2 * bound, "u {} against the bound {bound}", z.2);
}

#[test]
fn outliers_and_mixed_points_leave_the_offset_honest() {
    let z = z_scores(0.0, |_, _, noise| {
        if noise.uniform() < 0.01 {
            2.0 * (noise.uniform() - 0.5)
        } else {
            0.0
        }
    });
    assert_honest("one per cent of outliers", z);
}

#[test]
fn a_rounded_edge_is_found_and_left_out() {
    // Radius 0.4 mm on a 90 degree edge: the flank sinks by 0.4 - sqrt(0.4^2 - (0.4 - r)^2).
    let z = z_scores(0.0, |r, _, _| {
        if r < 0.4 {
            (0.16 - (0.4 - r).powi(2)).max(0.0).sqrt() - 0.4
        } else {
            0.0
        }
    });
    assert_honest("edge break", z);
}

#[test]
fn smeared_points_near_the_edge_are_left_out() {
    let z = z_scores(0.0, |r, _, noise| {
        if r < 0.15 {
            -0.1 * noise.uniform()
        } else {
            0.0
        }
    });
    assert_honest("spot smear", z);
}

#[test]
fn noise_shared_by_a_scan_line_is_seen() {
    assert_honest("shared by lines", z_scores(0.008, |_, _, _| 0.0));
}

#[test]
fn a_bent_flank_is_measured_with_a_bend() {
    // A sagitta of 35 micrometres over the reach.
    assert_honest("bent", z_scores(0.0, |r, _, _| 0.004 * r * r));
}

#[test]
fn form_deviation_that_no_model_holds_makes_the_uncertainty_grow() {
    let flat = z_scores(0.0, |_, _, _| 0.0);
    let wavy = z_scores(0.0, |r, s, _| 0.02 * (2.5 * r).sin() * (2.0 * s).cos());
    println!("wavy: z rms {:.3}, u {:.5} mm", wavy.0, wavy.2);
    assert!(wavy.2 > 1.5 * flat.2, "u {} against {}", wavy.2, flat.2);
    assert!(wavy.0 < 2.0, "z rms {}", wavy.0);
}

#[test]
fn flanks_without_enough_data_say_why() {
    let full = scan(&Scene {
        seed: 1,
        line_sigma: 0.0,
        extra: |_, _, _| 0.0,
    });
    let only = |keep: &dyn Fn(f64, f64) -> bool| {
        let points = (0..full.s.len())
            .filter(|i| keep(full.s[*i], full.r[*i]))
            .map(|i| (full.s[i], full.r[i], full.deviation[i], full.line[i]))
            .collect();
        measure_flank(&FlankPoints::new(points), &WINDOWS, &SETTINGS).stations
    };
    let missing = only(&|s, _| !(5.0..7.0).contains(&s));
    assert_eq!(missing[5], Err(FlankGap::NoPoints));
    assert!(missing[4].is_ok() && missing[7].is_ok());
    let bunched = only(&|s, _| s.fract() < 0.2);
    assert_eq!(bunched[3], Err(FlankGap::BadlySpread));
    let far = only(&|_, r| r > 2.6);
    assert!(matches!(far[3], Err(FlankGap::ShortReach(a, b)) if a > 2.59 && b < 3.01));
    let few = only(&|s, r| (s * 7.0 + r * 11.0).fract() < 0.02);
    assert!(
        few.iter()
            .any(|f| matches!(f, Err(FlankGap::TooFew(n, 12)) if *n < 12))
    );
}

/// Twist and bow of a face that a plane and a bend do not hold; the offset is that at the middle of the station, which a mean over the
/// window would miss by 0.2 * 1 / 12 = 17 micrometres.
#[test]
fn a_twisted_and_bowed_flank_is_measured_as_a_quadric() {
    let quadric = |r: f64, s: f64, _: &mut Noise| {
        let along = s - s.floor() - 0.5;
        0.01 * r * along + 0.2 * along * along
    };
    let points = scan(&Scene {
        seed: 1,
        line_sigma: 0.0,
        extra: quadric,
    });
    let flank = measure_flank(&points, &WINDOWS, &SETTINGS);
    assert_eq!(flank.model, FlankModel::Quadric);
    let fit = flank.stations[7].expect("a full flank");
    assert!((fit.second[2] - 0.2).abs() < 0.02, "{:?}", fit.second);
    assert_honest("quadric", z_scores(0.0, quadric));
}

#[test]
fn noise_shared_by_a_scan_line_is_no_quadric() {
    let shared = |line_sigma| {
        let points = |seed| {
            let extra = |_, _, _: &mut Noise| 0.0;
            scan(&Scene {
                seed,
                line_sigma,
                extra,
            })
        };
        let model = |seed| measure_flank(&points(seed), &WINDOWS, &SETTINGS).model;
        (1..=20)
            .filter(|seed| model(*seed) == FlankModel::Quadric)
            .count()
    };
    assert_eq!((shared(0.0), shared(0.008)), (0, 0));
}
