//! How often the 95 % intervals of breaks hold the truth, and which shapes are chosen, on sections whose flanks are off by what their
//! covariance says.

use super::*;
use crate::inspect::flank::{
    FlankFit, FlankPoint, FlankPoints, FlankSettings, NO_LINE, Windows, measure_flank,
};
use crate::inspect::monte_carlo::Draws;

const SIGMA: f64 = 0.010;
/// Points a mm2.
const DENSITY: f64 = 100.0;
const FLANK: f64 = 2.0;

/// A made edge of 90 degrees: places of its section from flank 1 to flank 2, straight pieces in (height over 1, height over 2).
enum Section {
    /// Corners between which the section is straight.
    Corners(Vec<[f64; 2]>),
    Round(f64),
}

/// In wedge coordinates of a right angle the heights are Cartesian: flank 1 is d1 = 0, d2 < 0.
fn section_point(section: &Section, share: f64) -> ([f64; 2], [f64; 2]) {
    let end = FLANK;
    match section {
        Section::Corners(inner) => {
            let mut places = vec![[0.0, -end]];
            places.extend(inner.iter().copied());
            places.push([-end, 0.0]);
            let length = |w: &[[f64; 2]]| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]);
            let total: f64 = places.windows(2).map(length).sum();
            let mut rest = share * total;
            for w in places.windows(2) {
                let own = length(w);
                if rest <= own || w[1] == [-end, 0.0] {
                    let unit = [(w[1][0] - w[0][0]) / own, (w[1][1] - w[0][1]) / own];
                    let p = [w[0][0] + rest * unit[0], w[0][1] + rest * unit[1]];
                    // Outward lies on the right of the way from flank 1 to flank 2.
                    return (p, [unit[1], -unit[0]]);
                }
                rest -= own;
            }
            unreachable!("a share of the length lies on it")
        }
        Section::Round(r) => {
            let flat = end - r;
            let arc = std::f64::consts::FRAC_PI_2 * r;
            let at = share * (2.0 * flat + arc);
            if at < flat {
                ([0.0, -end + at], [1.0, 0.0])
            } else if at < flat + arc {
                let angle = (at - flat) / r;
                let out = [angle.cos(), angle.sin()];
                ([-r + r * out[0], -r + r * out[1]], out)
            } else {
                ([-r - (at - flat - arc), 0.0], [0.0, 1.0])
            }
        }
    }
}

fn total_length(section: &Section) -> f64 {
    match section {
        Section::Corners(inner) => {
            let mut places = vec![[0.0, -FLANK]];
            places.extend(inner.iter().copied());
            places.push([-FLANK, 0.0]);
            places
                .windows(2)
                .map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]))
                .sum()
        }
        Section::Round(r) => 2.0 * (FLANK - r) + std::f64::consts::FRAC_PI_2 * r,
    }
}

/// Covariance of offset and tilt of a flank of one station with its points from `cut` to its end.
fn flank_covariance(cut: f64) -> [[f64; 2]; 2] {
    let n = DENSITY * (FLANK - cut);
    let mean = 0.5 * (FLANK + cut);
    let spread = (FLANK - cut).powi(2) / 12.0;
    let tilt = SIGMA * SIGMA / (n * spread);
    let offset = SIGMA * SIGMA / n + tilt * mean * mean;
    [[offset, -mean * tilt], [-mean * tilt, tilt]]
}

/// Five stations of 1 mm.
fn found(section: &Section, cut: f64, seed: u64) -> Option<EdgeBreak> {
    let mut draws = Draws::new(seed, 0);
    let covariance = flank_covariance(cut);
    let flanks: Vec<[FlankFit; 2]> = (0..STRETCH)
        .map(|_| {
            [0, 1].map(|_| {
                let a = covariance[0][0].sqrt();
                let b = covariance[0][1] / a;
                let (x, y) = (draws.normal(), draws.normal());
                FlankFit {
                    offset_mm: a * x,
                    tilt: b * x + (covariance[1][1] - b * b).sqrt() * y,
                    slope: 0.0,
                    second: [0.0; 3],
                    covariance,
                    sigma_mm: SIGMA,
                    points: 100,
                    cut_mm: cut,
                    lack_of_fit: false,
                }
            })
        })
        .collect();
    let count = (DENSITY * total_length(section) * STRETCH as f64) as usize;
    let mut points: Vec<ZonePoint> = (0..count)
        .map(|k| {
            let share = (k as f64 + 0.5) / count as f64;
            // Places along the edge that have nothing to do with those across.
            let s = (STRETCH as f64 * (k as f64 * 0.618_033_988_75)).rem_euclid(STRETCH as f64);
            let (p, out) = section_point(section, share);
            let e = SIGMA * draws.normal();
            let d = [p[0] + e * out[0], p[1] + e * out[1]];
            ZonePoint {
                s,
                r: [-d[1], -d[0]],
                deviation: d,
            }
        })
        .collect();
    points.sort_by(|a, b| a.s.total_cmp(&b.s));
    let stretch = Stretch {
        wedges: flanks
            .iter()
            .enumerate()
            .map(|(k, pair)| Wedge {
                s: k as f64 + 0.5,
                flanks: [&pair[0], &pair[1]],
                included_angle_rad: std::f64::consts::FRAC_PI_2
                    + pair[0].tilt.atan()
                    + pair[1].tilt.atan(),
            })
            .collect(),
        points: &points,
        step_mm: 1.0,
        spacing_mm: 0.1,
        convex: true,
        shared_factor: [1.0; 2],
    };
    measure_stretch(&stretch).map(|found| found.shape)
}

#[derive(Default, Debug)]
struct Tally {
    n: f64,
    bias: f64,
    z: f64,
    inside: f64,
    u: f64,
}

impl Tally {
    fn add(&mut self, q: Quantified, truth: f64) {
        let e = q.value - truth;
        self.n += 1.0;
        self.bias += e;
        self.u += q.u;
        self.z += (e / q.u).powi(2);
        self.inside += f64::from(e.abs() <= 1.96 * q.u);
    }

    fn words(&self) -> String {
        format!(
            "n {} bias {:.5} u {:.5} z {:.3} inside {:.3}",
            self.n,
            self.bias / self.n,
            self.u / self.n,
            (self.z / self.n).sqrt(),
            self.inside / self.n
        )
    }
}

/// What 400 stretches made with `section` were taken for, and how far the value that `of` takes from them is honest.
fn seen(
    section: &Section,
    cut: f64,
    truth: f64,
    of: impl Fn(&EdgeBreak) -> Option<Quantified>,
) -> ([usize; 5], Tally) {
    let (mut kinds, mut tally) = ([0; 5], Tally::default());
    for seed in 0..400 {
        let Some(shape) = found(section, cut, 1000 + seed) else {
            continue;
        };
        let kind = match shape.shape {
            BreakShape::Sharp { .. } => 0,
            BreakShape::Round { .. } => 1,
            BreakShape::Chamfer { .. } => 2,
            BreakShape::Undecided { .. } => 3,
            BreakShape::Irregular => 4,
        };
        kinds[kind] += 1;
        if let Some(value) = of(&shape) {
            tally.add(value, truth);
        }
    }
    eprintln!("{kinds:?} {}", tally.words());
    (kinds, tally)
}

/// Four standard deviations of a share of 95 % among n: of 400 0.044; and a hundredth for uncertainties that are themselves estimates.
fn assert_honest(tally: &Tally) {
    let chance = 4.0 * f64::sqrt(0.95 * 0.05 / tally.n) + 0.01;
    let share = tally.inside / tally.n;
    assert!(share > 0.95 - chance, "{}", tally.words());
}

#[test]
fn a_chamfer_is_one_and_its_sizes_are_honest() {
    let chamfer = Section::Corners(vec![[0.0, -0.3], [-0.3, 0.0]]);
    for side in 0..2 {
        let (kinds, leg) = seen(&chamfer, 0.45, 0.3, |b| match b.shape {
            BreakShape::Chamfer { legs_mm, .. } => Some(legs_mm[side]),
            _ => None,
        });
        assert_eq!(kinds, [0, 0, 400, 0, 0]);
        assert_honest(&leg);
    }
    let (_, angle) = seen(&chamfer, 0.45, std::f64::consts::FRAC_PI_4, |b| {
        match b.shape {
            BreakShape::Chamfer { angle_rad, .. } => Some(angle_rad),
            _ => None,
        }
    });
    assert_honest(&angle);
}

/// Ten times the noise is told from a chamfer; five times is told from a sharp edge at best, and is never called a chamfer for sure.
#[test]
fn a_small_radius_is_no_chamfer_and_its_size_is_honest() {
    let radius = |b: &EdgeBreak| match b.shape {
        BreakShape::Round { radius_mm } | BreakShape::Undecided { radius_mm, .. } => {
            Some(radius_mm)
        }
        _ => None,
    };
    for (r, cut, wrong_at_most) in [(0.2, 0.3, 0), (0.1, 0.2, 8), (0.05, 0.15, 8)] {
        let (kinds, tally) = seen(&Section::Round(r), cut, r, radius);
        assert!(kinds[2] <= wrong_at_most, "radius {r}: {kinds:?}");
        assert_honest(&tally);
    }
}

#[test]
fn the_height_of_a_burr_is_honest() {
    for (height, thick) in [(0.05, 0.1), (0.1, 0.1), (0.05, 0.2), (0.03, 0.1)] {
        let burr = Section::Corners(vec![[0.0, -thick], [height, -thick], [height, 0.0]]);
        let (_, tally) = seen(&burr, 0.2, height, |b| {
            (b.burr_mm.value > 0.0).then_some(b.burr_mm)
        });
        assert!(tally.n > 390.0, "{height}");
        assert_honest(&tally);
    }
}

#[test]
fn a_chamfer_between_flanks_that_were_fitted_is_honest() {
    let section = Section::Corners(vec![[0.0, -0.3], [-0.3, 0.0]]);
    let mut t: [Tally; 6] = Default::default();
    for seed in 0..30 {
        let mut draws = Draws::new(7000 + seed, 0);
        let length = 30.0;
        let count = (DENSITY * total_length(&section) * length) as usize;
        let mut points = Vec::new();
        let mut lists: [Vec<FlankPoint>; 2] = Default::default();
        for k in 0..count {
            let share = (k as f64 + 0.5) / count as f64;
            let s = (length * (k as f64 * 0.618_033_988_75)).rem_euclid(length);
            let (p, out) = section_point(&section, share);
            let e = SIGMA * draws.normal();
            let d = [p[0] + e * out[0], p[1] + e * out[1]];
            let side = usize::from(d[1] > d[0]);
            let r = [-d[1], -d[0]];
            lists[side].push((s, r[side], d[side], NO_LINE));
            points.push(ZonePoint { s, r, deviation: d });
        }
        points.sort_by(|a, b| a.s.total_cmp(&b.s));
        let windows = Windows {
            count: 30,
            step_mm: 1.0,
        };
        let settings = FlankSettings {
            reach_mm: 2.0,
            reach_limit_mm: 2.0,
            cut_mm: 0.1,
            spacing_mm: 0.1,
            min_points: 12,
            keep_designs: false,
        };
        let series = lists.map(|l| measure_flank(&FlankPoints::new(l), &windows, &settings));
        for flank in &series {
            for f in flank.stations.iter().flatten() {
                t[0].add(
                    Quantified {
                        value: f.offset_mm,
                        u: f.covariance[0][0].sqrt(),
                    },
                    0.0,
                );
                t[1].add(
                    Quantified {
                        value: f.tilt,
                        u: f.covariance[1][1].sqrt(),
                    },
                    0.0,
                );
            }
        }
        for first in (0..30).step_by(5) {
            let fits: Vec<_> = (first..first + 5)
                .filter_map(|k| match (&series[0].stations[k], &series[1].stations[k]) {
                    (Ok(a), Ok(b)) => Some((k, a, b)),
                    _ => None,
                })
                .collect();
            let (from, to) = (first as f64, first as f64 + 5.0);
            let range =
                points.partition_point(|p| p.s < from)..points.partition_point(|p| p.s < to);
            let stretch = Stretch {
                wedges: fits
                    .iter()
                    .map(|(k, a, b)| Wedge {
                        s: *k as f64 + 0.5,
                        flanks: [*a, *b],
                        included_angle_rad: std::f64::consts::FRAC_PI_2
                            + a.tilt.atan()
                            + b.tilt.atan(),
                    })
                    .collect(),
                points: &points[range],
                step_mm: 1.0,
                spacing_mm: 0.1,
                convex: true,
                shared_factor: [series[0].shared_factor, series[1].shared_factor],
            };
            if let Some(f) = measure_stretch(&stretch)
                && let BreakShape::Chamfer { legs_mm, angle_rad } = f.shape.shape
            {
                t[2].add(legs_mm[0], 0.3);
                t[3].add(legs_mm[1], 0.3);
                t[4].add(angle_rad, std::f64::consts::FRAC_PI_4);
                t[5].add(f.shape.truncation_mm, 0.3 * 0.5f64.sqrt());
            }
        }
    }
    for tally in &t {
        eprintln!("{}", tally.words());
        assert_honest(tally);
    }
}
