//! A bounded piece of a curve, measured by arc length.

use glam::DVec3;

use crate::geometry::Curve;
use crate::geometry::newton::{Range, nearest_on_curve};

/// From one parameter of a curve to another (which may be smaller), by arc length.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Path {
    curve: Curve,
    range: (f64, f64),
    nodes: Vec<Node>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    t: f64,
    s_mm: f64,
    point: DVec3,
}

/// Gauss - Legendre with five points on -1 to 1: nodes and weights.
const GAUSS: [(f64, f64); 5] = [
    (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
    (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (0.0, 0.568_888_888_888_888_9),
    (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (0.906_179_845_938_664, 0.236_926_885_056_189_1),
];
/// Most points of one polyline.
const MAX_POLYLINE: usize = 20_000;

impl Path {
    /// The piece of `curve` from `range.0` to `range.1`.
    pub fn new(curve: Curve, range: (f64, f64)) -> Self {
        let ts = node_parameters(&curve, range);
        let mut nodes = Vec::with_capacity(ts.len());
        let mut s_mm = 0.0;
        for (i, t) in ts.iter().enumerate() {
            if i > 0 {
                s_mm += arc_mm(&curve, ts[i - 1], *t);
            }
            nodes.push(Node {
                t: *t,
                s_mm,
                point: curve.point(*t),
            });
        }
        Self {
            curve,
            range,
            nodes,
        }
    }

    /// The curve.
    pub fn curve(&self) -> &Curve {
        &self.curve
    }

    /// Parameters of the start and the end.
    pub fn range(&self) -> (f64, f64) {
        self.range
    }

    /// Places at which it is evaluated once and for all.
    pub fn node_count(&self) -> usize {
        self.nodes.len()
    }

    /// In mm.
    pub fn length_mm(&self) -> f64 {
        self.nodes[self.nodes.len() - 1].s_mm
    }

    /// Whether it ends where it starts.
    pub fn is_closed(&self) -> bool {
        let ends = (self.nodes[0].point, self.nodes[self.nodes.len() - 1].point);
        self.length_mm() > 0.0 && ends.0.distance(ends.1) <= 1e-6 * self.length_mm()
    }

    /// Parameter at an arc length, clamped to the ends.
    pub fn parameter(&self, s_mm: f64) -> f64 {
        let s_mm = s_mm.clamp(0.0, self.length_mm());
        let after = self.nodes.partition_point(|n| n.s_mm <= s_mm);
        let i = after.clamp(1, self.nodes.len() - 1) - 1;
        let (a, b) = (self.nodes[i], self.nodes[i + 1]);
        if b.s_mm <= a.s_mm {
            return a.t;
        }
        let mut t = a.t + (b.t - a.t) * (s_mm - a.s_mm) / (b.s_mm - a.s_mm);
        let (low, high) = (a.t.min(b.t), a.t.max(b.t));
        let sign = (b.t - a.t).signum();
        // Four Newton steps on the arc length leave nothing of a smooth curve's error.
        for _ in 0..4 {
            let miss = a.s_mm + arc_mm(&self.curve, a.t, t) - s_mm;
            let speed = self.curve.derivatives(t)[1].length();
            if speed <= 0.0 || miss.abs() <= 1e-13 * self.length_mm() {
                break;
            }
            t = (t - sign * miss / speed).clamp(low, high);
        }
        t
    }

    /// Arc length at a parameter of the range.
    pub fn arc_length_mm(&self, t: f64) -> f64 {
        let forward = self.range.1 >= self.range.0;
        let passed = |n: &Node| if forward { n.t <= t } else { n.t >= t };
        let i = self
            .nodes
            .partition_point(passed)
            .clamp(1, self.nodes.len())
            - 1;
        let a = self.nodes[i];
        (a.s_mm + arc_mm(&self.curve, a.t, t)).clamp(0.0, self.length_mm())
    }

    /// Position and unit tangent (towards the end) at an arc length.
    pub fn at(&self, s_mm: f64) -> (DVec3, DVec3) {
        let t = self.parameter(s_mm);
        let [point, d, _] = self.curve.derivatives(t);
        let sign = (self.range.1 - self.range.0).signum();
        let tangent = (d * sign).try_normalize().unwrap_or_else(|| {
            // A cusp or a doubled control point: the direction of the way around it.
            let step = 1e-4 * (self.range.1 - self.range.0);
            let (from, to) = (self.curve.point(t - step), self.curve.point(t + step));
            (to - from).normalize_or(DVec3::X)
        });
        (point, tangent)
    }

    /// Arc length of the nearest place, and its distance, both mm.
    pub fn nearest(&self, p: DVec3) -> (f64, f64) {
        let (low, high) = (
            self.range.0.min(self.range.1),
            self.range.0.max(self.range.1),
        );
        let range = Range::open(low, high);
        let d2 = |i: usize| self.nodes[i].point.distance_squared(p);
        let last = self.nodes.len() - 1;
        let mut best = (self.nodes[0].t, f64::INFINITY);
        for i in 0..=last {
            let here = d2(i);
            if (i > 0 && d2(i - 1) < here) || (i < last && d2(i + 1) < here) {
                continue;
            }
            let found = nearest_on_curve(|t| self.curve.derivatives(t), p, self.nodes[i].t, range);
            if found.1 < best.1 {
                best = found;
            }
        }
        (self.arc_length_mm(best.0), best.1.sqrt())
    }

    /// Its ends, and its outermost points along each axis.
    pub fn extremes(&self) -> Vec<DVec3> {
        let mut out = vec![self.nodes[0].point, self.nodes[self.nodes.len() - 1].point];
        if let Curve::Line { .. } = self.curve {
            return out;
        }
        for w in self.nodes.windows(2) {
            let (a, b) = (w[0].t, w[1].t);
            let speed = |t: f64| self.curve.derivatives(t)[1];
            let (da, db) = (speed(a), speed(b));
            out.push(w[1].point);
            for k in (0..3).filter(|k| da[*k] * db[*k] < 0.0) {
                // Between two nodes the coordinate turns once: halve until rounding.
                let (mut low, mut high) = (a, b);
                for _ in 0..50 {
                    let middle = 0.5 * (low + high);
                    if speed(middle)[k] * da[k] > 0.0 {
                        low = middle;
                    } else {
                        high = middle;
                    }
                }
                out.push(self.curve.point(low));
            }
        }
        out
    }

    /// Parameters and points along the path, at most `chord_mm` beside it between two of them.
    pub fn polyline(&self, chord_mm: f64) -> Vec<(f64, DVec3)> {
        let mut out = vec![(self.nodes[0].t, self.nodes[0].point)];
        for w in self.nodes.windows(2) {
            let (a, b) = (w[0], w[1]);
            let middle = self.curve.point(0.5 * (a.t + b.t));
            let off = middle.distance((a.point + b.point) * 0.5);
            // The distance of a chord falls with the square of its length.
            let pieces = (off / chord_mm.max(1e-9)).sqrt().ceil().clamp(1.0, 256.0) as usize;
            for k in 1..pieces {
                let t = a.t + (b.t - a.t) * k as f64 / pieces as f64;
                out.push((t, self.curve.point(t)));
            }
            out.push((b.t, b.point));
            if out.len() > MAX_POLYLINE {
                break;
            }
        }
        let end = self.nodes[self.nodes.len() - 1];
        if out.last().is_some_and(|l| l.0 != end.t) {
            out.push((end.t, end.point));
        }
        out
    }
}

/// The parameters between which a curve bends little: knots of a spline and steps between them.
fn node_parameters(curve: &Curve, (from, to): (f64, f64)) -> Vec<f64> {
    let steps = |count: usize| -> Vec<f64> {
        let at = |i: usize| from + (to - from) * i as f64 / count as f64;
        (0..=count).map(at).collect()
    };
    match curve {
        Curve::Line { .. } => steps(1),
        Curve::Nurbs(c) => {
            let (low, high) = (from.min(to), from.max(to));
            let breaks = c.knots().breaks();
            let period = c.range().period().unwrap_or(0.0);
            let mut cuts = vec![low, high];
            // A range that passes the joint of a closed curve meets its knots one turn on.
            for shift in [-period, 0.0, period] {
                let inside = breaks.iter().map(|b| b + shift);
                cuts.extend(inside.filter(|b| *b > low && *b < high));
            }
            cuts.sort_unstable_by(f64::total_cmp);
            cuts.dedup_by(|a, b| (*a - *b).abs() <= 1e-12 * (high - low));
            let pieces = (24 / (cuts.len().max(2) - 1)).clamp(4, 24);
            let mut ts: Vec<f64> = cuts
                .windows(2)
                .flat_map(|w| {
                    let (a, b) = (w[0], w[1]);
                    (0..pieces).map(move |i| a + (b - a) * i as f64 / pieces as f64)
                })
                .collect();
            ts.push(high);
            if to < from {
                ts.reverse();
            }
            ts
        }
        _ => steps(((to - from).abs() / 0.2).ceil().clamp(4.0, 64.0) as usize),
    }
}

/// Unsigned arc length between two parameters.
fn arc_mm(curve: &Curve, from: f64, to: f64) -> f64 {
    let half = 0.5 * (to - from);
    if let Curve::Line { .. } = curve {
        return 2.0 * half.abs();
    }
    let speed = |x: f64| curve.derivatives(from + half * (1.0 + x))[1].length();
    half.abs() * GAUSS.iter().map(|(x, w)| w * speed(*x)).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Frame;
    use std::f64::consts::PI;

    #[test]
    fn a_backward_arc_is_measured_from_its_start() {
        let circle = Curve::Circle {
            frame: Frame::WORLD,
            radius_mm: 10.0,
        };
        let path = Path::new(circle, (PI, 0.0));
        // Five Gauss points on arcs of 0.2 rad are exact to rounding.
        assert!((path.length_mm() - 10.0 * PI).abs() < 1e-12);
        let (p, t) = path.at(5.0 * PI);
        assert!((p - DVec3::Y * 10.0).length() < 1e-12);
        assert!((t - DVec3::X).length() < 1e-12, "towards the end");
        let (s, d) = path.nearest(DVec3::new(0.0, 12.0, 0.0));
        assert!((s - 5.0 * PI).abs() < 1e-7 && (d - 2.0).abs() < 1e-12);
        let (s, d) = path.nearest(DVec3::new(8.0, -5.0, 0.0));
        assert!((s - 10.0 * PI).abs() < 1e-12, "held at the end");
        assert!((d - 29f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn an_ellipse_has_its_known_length() {
        let ellipse = Curve::Ellipse {
            frame: Frame::WORLD,
            semi_axes_mm: [2.0, 1.0],
        };
        let path = Path::new(ellipse, (0.0, 2.0 * PI));
        assert!(path.is_closed());
        // 8 E(sqrt(3)/2) = 9.688448220547675.
        assert!((path.length_mm() - 9.688_448_220_547_675).abs() < 1e-9);
        let half = path.parameter(0.5 * path.length_mm());
        assert!((half - PI).abs() < 1e-9);
        assert!((path.arc_length_mm(half) - 0.5 * path.length_mm()).abs() < 1e-9);
    }

    #[test]
    fn a_polyline_keeps_to_its_chord() {
        let circle = Curve::Circle {
            frame: Frame::WORLD,
            radius_mm: 10.0,
        };
        let line = Path::new(circle, (0.0, 2.0 * PI)).polyline(0.001);
        for w in line.windows(2) {
            let middle = (w[0].1 + w[1].1) * 0.5;
            assert!(
                10.0 - middle.length() <= 0.001_01,
                "measured at the middle of the chord"
            );
        }
    }
}
