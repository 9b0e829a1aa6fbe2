//! The measured edge as a curve: straightness, line profile with and without datums, direction.
//!
//! Source: features-and-standards, section 5, characteristics 14 and 15.

use glam::{DMat2, DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};

use super::measure::pose_row;
use super::result::{Budget, EdgeForm, Measured, Quantified, StationResult};

/// Fewest measured stations that are a curve: three lie in a plane whatever they do.
const FEWEST: usize = 4;

/// A nominal edge whose tangents all lie within this of their mean is straight.
const STRAIGHT_RAD: f64 = 1e-6;

/// Stations that a direction is smoothed over where nothing else is asked for.
const SMOOTHED_STATIONS: f64 = 5.0;

/// The form of an edge from its stations; `None` where fewer than four were measured. `smoothing_mm` is the length over
/// which a direction is taken; `None` = five stations.
pub fn form(stations: &[StationResult], smoothing_mm: Option<f64>) -> Option<EdgeForm> {
    let places: Vec<Place> = stations.iter().filter_map(Place::new).collect();
    if places.len() < FEWEST {
        return None;
    }
    let step = {
        let (first, last) = (&stations[0].station, &stations[stations.len() - 1].station);
        (last.s_mm - first.s_mm) / (stations.len() - 1) as f64
    };
    let worst = places.iter().reduce(|a, b| {
        if b.shift.length() > a.shift.length() {
            b
        } else {
            a
        }
    })?;
    Some(EdgeForm {
        straightness_mm: is_straight(&places).then(|| straightness(&places)),
        line_profile_mm: Quantified {
            value: 2.0 * worst.shift.length(),
            u: 2.0 * worst.u_along(worst.shift, Budget::u),
        },
        s_worst_mm: worst.s_mm,
        line_form_mm: line_form(&places),
        direction_rad: direction(&places, smoothing_mm.unwrap_or(SMOOTHED_STATIONS * step)),
    })
}

/// One measured station in its plane across the tangent.
struct Place {
    s_mm: f64,
    nominal: DVec3,
    point: DVec3,
    tangent: DVec3,
    normals: [DVec3; 2],
    /// Axes of the plane across the tangent.
    axes: [DVec3; 2],
    /// From d1, d2 to a shift in that plane.
    shift_of_d: DMat2,
    d_mm: DVec2,
    shift: DVec2,
    budget: [Budget; 2],
}

impl Place {
    fn new(station: &StationResult) -> Option<Self> {
        let measured: &Measured = station.measured.as_ref()?;
        let nominal = &station.station;
        let x = nominal.normals[0];
        let y = nominal.tangent.cross(x).try_normalize()?;
        let rows = nominal.normals.map(|n| DVec2::new(n.dot(x), n.dot(y)));
        let shift_of_d = DMat2::from_cols(rows[0], rows[1]).transpose();
        if shift_of_d.determinant().abs() < 8e-3 || !measured.point.is_finite() {
            return None;
        }
        let shift_of_d = shift_of_d.inverse();
        let d_mm = DVec2::from(measured.d_mm);
        Some(Self {
            s_mm: nominal.s_mm,
            nominal: nominal.point,
            point: measured.point,
            tangent: nominal.tangent,
            normals: nominal.normals,
            axes: [x, y],
            shift_of_d,
            d_mm,
            shift: shift_of_d * d_mm,
            budget: measured.budget_d,
        })
    }

    /// Standard uncertainty of the shift along `direction` (any length; without one the larger of d1 and d2).
    fn u_along(&self, direction: DVec2, u: impl Fn(&Budget) -> f64) -> f64 {
        let u = DVec2::new(u(&self.budget[0]), u(&self.budget[1]));
        match direction.try_normalize() {
            Some(unit) => (self.shift_of_d.transpose() * unit * u).length(),
            None => u.max_element(),
        }
    }

    fn in_space(&self, shift: DVec2) -> DVec3 {
        shift.x * self.axes[0] + shift.y * self.axes[1]
    }
}

fn is_straight(places: &[Place]) -> bool {
    let sum: DVec3 = places.iter().map(|p| p.tangent).sum();
    sum.try_normalize().is_some_and(|mean| {
        places
            .iter()
            .all(|p| p.tangent.cross(mean).length() < STRAIGHT_RAD)
    })
}

/// Diameter of the smallest cylinder around the measured points, by Lawson's iteration: least squares with weights that grow
/// where the distance is large. At the optimum the radius is the weighted mean of the distances, which gives its uncertainty.
fn straightness(places: &[Place]) -> Quantified {
    let axis = places[0].tangent;
    let (x, y) = (places[0].axes[0], places[0].axes[1]);
    let origin = places[0].nominal;
    let at: Vec<(f64, DVec2)> = places
        .iter()
        .map(|p| {
            let v = p.point - origin;
            (v.dot(axis), DVec2::new(v.dot(x), v.dot(y)))
        })
        .collect();
    let mut weights = vec![1.0 / at.len() as f64; at.len()];
    let mut best = (f64::INFINITY, weights.clone(), vec![DVec2::ZERO; at.len()]);
    for _ in 0..2000 {
        let residuals = about_line(&at, &weights);
        let largest = residuals.iter().map(|r| r.length()).fold(0.0, f64::max);
        let bound = residuals
            .iter()
            .zip(&weights)
            .map(|(r, w)| w * r.length_squared())
            .sum::<f64>()
            .sqrt();
        if largest < best.0 {
            best = (largest, weights.clone(), residuals.clone());
        }
        // The weighted mean square never exceeds the smallest radius squared: the two enclose it.
        if largest <= 0.0 || best.0 - bound < 1e-6 * best.0 {
            break;
        }
        let sum: f64 = residuals
            .iter()
            .zip(&weights)
            .map(|(r, w)| w * r.length())
            .sum();
        for (w, r) in weights.iter_mut().zip(&residuals) {
            *w *= r.length() / sum;
        }
    }
    let (radius, weights, residuals) = best;
    let variance: f64 = places
        .iter()
        .zip(weights.iter().zip(&residuals))
        .map(|(p, (w, r))| (w * p.u_along(*r, |b| b.points)).powi(2))
        .sum();
    Quantified {
        value: 2.0 * radius,
        u: 2.0 * variance.sqrt(),
    }
}

/// Residuals of `at` (place along, place across) about their weighted least-squares line.
fn about_line(at: &[(f64, DVec2)], weights: &[f64]) -> Vec<DVec2> {
    let total: f64 = weights.iter().sum();
    let (mut s, mut v) = (0.0, DVec2::ZERO);
    for ((si, vi), w) in at.iter().zip(weights) {
        s += w * si;
        v += *w * *vi;
    }
    let (s, v) = (s / total, v / total);
    let (mut ss, mut sv) = (0.0, DVec2::ZERO);
    for ((si, vi), w) in at.iter().zip(weights) {
        ss += w * (si - s).powi(2);
        sv += *w * (si - s) * (*vi - v);
    }
    let slope = if ss > 0.0 { sv / ss } else { DVec2::ZERO };
    at.iter()
        .map(|(si, vi)| *vi - v - slope * (si - s))
        .collect()
}

/// Twice the largest distance that stays after the rigid motion that fits d1 and d2 best in least squares; what the edge alone does not
/// hold (a straight edge: along and about itself) is left where it is.
fn line_form(places: &[Place]) -> Option<Quantified> {
    let n = places.len() as f64;
    let centre = places.iter().map(|p| p.nominal).sum::<DVec3>() / n;
    let size = places
        .iter()
        .map(|p| p.nominal.distance(centre))
        .fold(0.0, f64::max);
    // In units of the edge's size, so that turns and shifts weigh alike.
    let row = |p: &Place, i: usize| {
        let [a, b, c, d, e, f] = pose_row((p.nominal - centre) / size, p.normals[i]);
        Vector6::new(a, b, c, d, e, f)
    };
    let (mut matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for p in places {
        for i in 0..2 {
            let row = row(p, i);
            matrix += row * row.transpose();
            right += row * p.d_mm[i];
        }
    }
    let motion = matrix.pseudo_inverse(1e-9 * n).ok()? * right;
    let residual = |p: &Place| {
        let d = DVec2::new(
            p.d_mm[0] - row(p, 0).dot(&motion),
            p.d_mm[1] - row(p, 1).dot(&motion),
        );
        p.shift_of_d * d
    };
    let (worst, shift) = places
        .iter()
        .map(|p| (p, residual(p)))
        .reduce(|a, b| if b.1.length() > a.1.length() { b } else { a })?;
    Some(Quantified {
        value: 2.0 * shift.length(),
        u: 2.0 * worst.u_along(shift, |b| b.points),
    })
}

/// The largest angle between the measured edge and the nominal tangent, and where: slope of a line through the shifts within half of
/// `smoothing_mm` on either side.
fn direction(places: &[Place], smoothing_mm: f64) -> Option<(Quantified, f64)> {
    let mut worst: Option<(Quantified, f64)> = None;
    let mut first = 0;
    for middle in places {
        while places[first].s_mm < middle.s_mm - 0.5 * smoothing_mm {
            first += 1;
        }
        let window: Vec<&Place> = places[first..]
            .iter()
            .take_while(|p| p.s_mm <= middle.s_mm + 0.5 * smoothing_mm)
            .collect();
        let Some(found) = slope(&window, smoothing_mm) else {
            continue;
        };
        if worst.is_none_or(|(seen, _)| found.value > seen.value) {
            worst = Some((found, middle.s_mm));
        }
    }
    worst
}

/// `None` where the stations fill less than half of the window: a direction needs its length.
fn slope(window: &[&Place], smoothing_mm: f64) -> Option<Quantified> {
    let (first, last) = (window.first()?, window.last()?);
    if window.len() < 3 || last.s_mm - first.s_mm < 0.5 * smoothing_mm {
        return None;
    }
    let n = window.len() as f64;
    let s = window.iter().map(|p| p.s_mm).sum::<f64>() / n;
    let ss: f64 = window.iter().map(|p| (p.s_mm - s).powi(2)).sum();
    let weight = |p: &Place| (p.s_mm - s) / ss;
    let slope: DVec3 = window.iter().map(|p| weight(p) * p.in_space(p.shift)).sum();
    let variance: f64 = window
        .iter()
        .map(|p| {
            let along = DVec2::new(slope.dot(p.axes[0]), slope.dot(p.axes[1]));
            (weight(p) * p.u_along(along, |b| b.points)).powi(2)
        })
        .sum();
    let tangent = slope.length();
    Some(Quantified {
        value: tangent.atan(),
        u: variance.sqrt() / (1.0 + tangent * tangent),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inspect::result::Verdict;
    use crate::nominal::Station;

    /// Stations of 1 mm along x, faces with outward normals y and z, the measured edge at `shift(x)`.
    fn straight(count: usize, shift: impl Fn(f64) -> [f64; 2]) -> Vec<StationResult> {
        let stations = (0..count).map(|k| {
            let x = k as f64 + 0.5;
            let d = shift(x);
            place(
                x,
                [DVec3::new(x, 0.0, 0.0), DVec3::X],
                [DVec3::Y, DVec3::Z],
                d,
            )
        });
        stations.collect()
    }

    fn place(s_mm: f64, [point, tangent]: [DVec3; 2], n: [DVec3; 2], d: [f64; 2]) -> StationResult {
        let budget = Budget {
            points: 0.003,
            alignment: 0.004,
            ..Budget::default()
        };
        StationResult {
            station: Station {
                s_mm,
                point,
                tangent,
                normals: n,
                into_face: [-n[1], -n[0]],
            },
            measured: Some(Measured {
                point: point + d[0] * n[0] + d[1] * n[1],
                d_mm: d,
                u_d_mm: [0.005; 2],
                included_angle_rad: 1.5,
                u_included_angle_rad: 0.01,
                residual_mm: [0.01; 2],
                budget_d: [budget; 2],
                budget_angle: budget,
                covariance_d_mm2: 0.0,
                total_mm: Quantified {
                    value: d[0].hypot(d[1]),
                    u: 0.005,
                },
                flank_model: Default::default(),
                ridge: None,
                at_depth: [None; 2],
            }),
            boundary: None,
            points: [100; 2],
            verdict: Verdict::Undefined,
            reason: String::new(),
        }
    }

    /// A helix of radius r about a tilted, shifted line lies on the cylinder of diameter 2r about it, and in no smaller one.
    #[test]
    fn straightness_is_the_smallest_cylinder() {
        let helix = |x: f64| {
            let (sin, cos) = (0.7 * x).sin_cos();
            [0.02 * cos + 0.3 + 0.004 * x, 0.02 * sin - 0.1 - 0.002 * x]
        };
        let form = form(&straight(60, helix), None).expect("sixty stations");
        let straightness = form.straightness_mm.expect("a straight nominal");
        // The line is tilted by 0.0045: the cylinder is oblique by that, squared 2e-5.
        assert!(
            (straightness.value - 0.04).abs() < 0.04 * 5e-3,
            "{straightness:?}"
        );
        assert!(straightness.u > 0.0 && straightness.u < 2.0 * 0.003);
    }

    /// In a plane the smallest zone of three points has the middle one on one side: half the sagitta on each.
    #[test]
    fn one_point_out_of_line_is_seen_whole_by_the_zone_and_shared_by_both_sides() {
        let bump = |x: f64| [if (x - 10.5).abs() < 0.1 { 0.03 } else { 0.0 }, 0.0];
        let form = form(&straight(21, bump), None).expect("stations");
        let straightness = form.straightness_mm.expect("straight").value;
        assert!((straightness - 0.03).abs() < 1e-5, "{straightness}");
        assert!((form.line_profile_mm.value - 0.06).abs() < 1e-12);
        assert!((form.line_profile_mm.u - 2.0 * 0.005).abs() < 1e-12);
        assert_eq!(form.s_worst_mm, 10.5);
    }

    #[test]
    fn an_edge_moved_as_a_whole_has_a_profile_but_no_form() {
        let turned = |x: f64| [0.05 + 0.002 * x, -0.03];
        let form = form(&straight(30, turned), None).expect("stations");
        assert!(form.line_profile_mm.value > 0.2);
        assert!(form.line_form_mm.expect("stations").value < 1e-9);
        let (direction, _) = form.direction_rad.expect("stations");
        assert!((direction.value - 0.002f64.atan()).abs() < 1e-9);
    }

    #[test]
    fn a_ring_moved_sideways_keeps_its_form_and_is_not_straight() {
        let ring: Vec<StationResult> = (0..90)
            .map(|k| {
                let angle = (k as f64 * 4.0).to_radians();
                let radial = DVec3::new(angle.cos(), angle.sin(), 0.0);
                let along = DVec3::new(-angle.sin(), angle.cos(), 0.0);
                let shift = DVec3::new(0.04, 0.0, 0.01);
                let n = [radial, DVec3::Z];
                let d = n.map(|n| shift.dot(n));
                place(10.0 * angle, [10.0 * radial, along], n, d)
            })
            .collect();
        let form = form(&ring, None).expect("stations");
        assert!(form.straightness_mm.is_none());
        assert!(form.line_form_mm.expect("stations").value < 1e-9);
        assert!((form.line_profile_mm.value - 2.0 * 0.04f64.hypot(0.01)).abs() < 1e-6);
    }

    #[test]
    fn three_stations_are_no_curve() {
        assert_eq!(form(&straight(3, |_| [0.0; 2]), None), None);
    }
}
