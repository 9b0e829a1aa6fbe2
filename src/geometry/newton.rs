//! Nearest parameter by Newton's method kept inside bounds and never going uphill.

use glam::{DVec2, DVec3};

/// One parameter direction: its ends, and whether leaving at one end enters at the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// First parameter; may be minus infinity.
    pub from: f64,
    /// Last parameter; may be infinity.
    pub to: f64,
    /// Whether `to` is the same place as `from`.
    pub closed: bool,
}

impl Range {
    /// From end to end, open.
    pub fn open(from: f64, to: f64) -> Self {
        Self {
            from,
            to,
            closed: false,
        }
    }

    /// All reals.
    pub const UNBOUNDED: Self = Self {
        from: f64::NEG_INFINITY,
        to: f64::INFINITY,
        closed: false,
    };

    /// 0 to 2 pi, closed.
    pub const TURN: Self = Self {
        from: 0.0,
        to: std::f64::consts::TAU,
        closed: true,
    };

    /// The parameter brought into the range: wrapped where it is closed, clamped where not.
    #[inline]
    pub fn bring(&self, t: f64) -> f64 {
        if !self.closed {
            return t.clamp(self.from, self.to);
        }
        if t >= self.from && t <= self.to {
            return t;
        }
        (self.from + (t - self.from).rem_euclid(self.to - self.from)).clamp(self.from, self.to)
    }

    /// Length of one turn where the direction is closed.
    pub fn period(&self) -> Option<f64> {
        self.closed.then_some(self.to - self.from)
    }

    /// Whether a step downhill is blocked: at an open end and pointing out.
    #[inline]
    fn blocks(&self, t: f64, step: f64) -> bool {
        !self.closed && ((t <= self.from && step < 0.0) || (t >= self.to && step > 0.0))
    }
}

/// A surface point with its partial derivatives to second order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceDerivatives {
    /// Position, mm.
    pub point: DVec3,
    /// By u.
    pub du: DVec3,
    /// By v.
    pub dv: DVec3,
    /// By u twice.
    pub duu: DVec3,
    /// By u and v.
    pub duv: DVec3,
    /// By v twice.
    pub dvv: DVec3,
}

/// Steps after which the best place so far stands.
const MAX_STEPS: usize = 40;
/// Halvings of a step that leads uphill before it is given up.
const MAX_HALVINGS: usize = 12;
/// A step shorter than this share of the coordinates is rounding.
const ROUNDING: f64 = 1e-14;

/// After a Newton step shorter than this share of the coordinates, what is left is its square: rounding.
const LAST_STEP: f64 = 1e-8;

/// The parameter of a local nearest point of a curve, reached downhill from `start`, and its squared distance.
pub fn nearest_on_curve(
    curve: impl Fn(f64) -> [DVec3; 3],
    p: DVec3,
    start: f64,
    range: Range,
) -> (f64, f64) {
    let mut t = range.bring(start);
    let mut at = curve(t);
    let mut d2 = at[0].distance_squared(p);
    for _ in 0..MAX_STEPS {
        let r = at[0] - p;
        let gradient = at[1].dot(r);
        let speed2 = at[1].length_squared();
        let bend = speed2 + at[2].dot(r);
        // Where the distance is not convex, the first-order model still points downhill.
        let curvature = if bend > 0.1 * speed2 { bend } else { speed2 };
        let mut step = -gradient / curvature;
        let resolution = ROUNDING * (at[0].length() + p.length());
        if !step.is_finite()
            || step * step * speed2 <= resolution * resolution
            || range.blocks(t, step)
        {
            break;
        }
        if step * step * speed2 <= (resolution * (LAST_STEP / ROUNDING)).powi(2) {
            let next = range.bring(t + step);
            let last = curve(next)[0].distance_squared(p);
            if level(last, d2) {
                (t, d2) = (next, last.min(d2));
            }
            break;
        }
        let mut moved = false;
        for _ in 0..MAX_HALVINGS {
            let next = range.bring(t + step);
            let candidate = curve(next);
            let next_d2 = candidate[0].distance_squared(p);
            let slope = |c: &[DVec3; 3]| c[1].dot(c[0] - p).abs();
            if next_d2 < d2 || (level(next_d2, d2) && slope(&candidate) < 0.5 * slope(&at)) {
                (t, at, d2, moved) = (next, candidate, next_d2, true);
                break;
            }
            step *= 0.5;
        }
        if !moved {
            break;
        }
    }
    (t, d2)
}

/// The parameters of a local nearest point of a surface, reached downhill from `start`, and its squared distance.
pub fn nearest_on_surface(
    surface: impl Fn(f64, f64) -> SurfaceDerivatives,
    p: DVec3,
    start: (f64, f64),
    ranges: [Range; 2],
) -> ((f64, f64), f64) {
    let mut uv = (ranges[0].bring(start.0), ranges[1].bring(start.1));
    let mut at = surface(uv.0, uv.1);
    let mut d2 = at.point.distance_squared(p);
    for _ in 0..MAX_STEPS {
        let step = newton_step(&at, p, uv, ranges);
        let resolution = ROUNDING * (at.point.length() + p.length());
        let length = at.du.length() * step.x.abs() + at.dv.length() * step.y.abs();
        if !step.is_finite() || length <= resolution {
            break;
        }
        if length <= resolution * (LAST_STEP / ROUNDING) {
            let next = (
                ranges[0].bring(uv.0 + step.x),
                ranges[1].bring(uv.1 + step.y),
            );
            let last = surface(next.0, next.1).point.distance_squared(p);
            if level(last, d2) {
                (uv, d2) = (next, last.min(d2));
            }
            break;
        }
        // A coupled step that is cut at an end may lead uphill; down the slope, each parameter by itself, never does.
        let moved = descend(&surface, p, (uv, &at, d2), step, ranges).or_else(|| {
            descend(
                &surface,
                p,
                (uv, &at, d2),
                slope_step(&at, p, uv, ranges),
                ranges,
            )
        });
        let Some(moved) = moved else { break };
        (uv, at, d2) = moved;
    }
    (uv, d2)
}

type Place = ((f64, f64), SurfaceDerivatives, f64);

/// The place at the end of a step, halved until it is nearer.
fn descend(
    surface: &impl Fn(f64, f64) -> SurfaceDerivatives,
    p: DVec3,
    (uv, at, d2): ((f64, f64), &SurfaceDerivatives, f64),
    mut step: DVec2,
    ranges: [Range; 2],
) -> Option<Place> {
    let slope = |s: &SurfaceDerivatives| {
        let r = s.point - p;
        s.du.dot(r).abs() / s.du.length().max(f64::MIN_POSITIVE)
            + s.dv.dot(r).abs() / s.dv.length().max(f64::MIN_POSITIVE)
    };
    for _ in 0..MAX_HALVINGS {
        let next = (
            ranges[0].bring(uv.0 + step.x),
            ranges[1].bring(uv.1 + step.y),
        );
        let candidate = surface(next.0, next.1);
        let next_d2 = candidate.point.distance_squared(p);
        if next_d2 < d2 || (level(next_d2, d2) && slope(&candidate) < 0.5 * slope(at)) {
            return Some((next, candidate, next_d2));
        }
        step *= 0.5;
    }
    None
}

/// Whether two squared distances differ by rounding alone: there the slope tells which place is the nearer.
fn level(next_d2: f64, d2: f64) -> bool {
    next_d2 <= d2 * (1.0 + 8.0 * f64::EPSILON)
}

/// Down the slope, each free parameter by itself.
fn slope_step(at: &SurfaceDerivatives, p: DVec3, uv: (f64, f64), ranges: [Range; 2]) -> DVec2 {
    let r = at.point - p;
    let alone = |derivative: DVec3, t: f64, range: Range| {
        let step = -derivative.dot(r) / derivative.length_squared();
        if step.is_finite() && !range.blocks(t, step) {
            step
        } else {
            0.0
        }
    };
    DVec2::new(alone(at.du, uv.0, ranges[0]), alone(at.dv, uv.1, ranges[1]))
}

/// A descent step in the parameters that are free: those not held at an open end.
fn newton_step(at: &SurfaceDerivatives, p: DVec3, uv: (f64, f64), ranges: [Range; 2]) -> DVec2 {
    let r = at.point - p;
    let gradient = DVec2::new(at.du.dot(r), at.dv.dot(r));
    let (e, f, g) = (
        at.du.length_squared(),
        at.du.dot(at.dv),
        at.dv.length_squared(),
    );
    let free = [
        !ranges[0].blocks(uv.0, -gradient.x),
        !ranges[1].blocks(uv.1, -gradient.y),
    ];
    let (huu, huv, hvv) = (e + at.duu.dot(r), f + at.duv.dot(r), g + at.dvv.dot(r));
    match free {
        [false, false] => DVec2::ZERO,
        [true, false] => DVec2::new(-gradient.x / convex(huu, e), 0.0),
        [false, true] => DVec2::new(0.0, -gradient.y / convex(hvv, g)),
        [true, true] => {
            let step = solve(huu, huv, hvv, gradient)
                // Not convex here: the first-order model, and where that is singular too, each direction alone.
                .or_else(|| solve(e, f, g, gradient))
                .unwrap_or_else(|| {
                    DVec2::new(
                        if e > 0.0 { -gradient.x / e } else { 0.0 },
                        if g > 0.0 { -gradient.y / g } else { 0.0 },
                    )
                });
            hold_at_ends(step, uv, ranges, at, gradient)
        }
    }
}

/// Keeps a coupled step from pushing out of an open end: the other parameter then goes alone.
fn hold_at_ends(
    step: DVec2,
    uv: (f64, f64),
    ranges: [Range; 2],
    at: &SurfaceDerivatives,
    gradient: DVec2,
) -> DVec2 {
    match [
        ranges[0].blocks(uv.0, step.x),
        ranges[1].blocks(uv.1, step.y),
    ] {
        [false, false] => step,
        [true, false] => DVec2::new(0.0, -gradient.y / at.dv.length_squared()),
        [false, true] => DVec2::new(-gradient.x / at.du.length_squared(), 0.0),
        [true, true] => DVec2::ZERO,
    }
}

fn convex(second: f64, first: f64) -> f64 {
    if second > 0.1 * first { second } else { first }
}

/// Solves the 2 x 2 system for minus the gradient where its matrix is safely positive definite.
fn solve(a: f64, b: f64, c: f64, gradient: DVec2) -> Option<DVec2> {
    let det = a * c - b * b;
    (a > 0.0 && c > 0.0 && det > 1e-9 * a * c).then(|| {
        DVec2::new(
            (b * gradient.y - c * gradient.x) / det,
            (b * gradient.x - a * gradient.y) / det,
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_wrap_where_closed_and_clamp_where_open() {
        let turn = Range {
            from: 1.0,
            to: 3.0,
            closed: true,
        };
        assert_eq!(turn.bring(3.5), 1.5);
        assert_eq!(turn.bring(0.5), 2.5);
        assert_eq!(turn.period(), Some(2.0));
        assert_eq!(Range::open(1.0, 3.0).bring(3.5), 3.0);
        assert_eq!(Range::UNBOUNDED.bring(-1e300), -1e300);
    }

    #[test]
    fn the_parabola_has_its_known_nearest_points() {
        let curve = |t: f64| {
            [
                DVec3::new(t, t * t, 0.0),
                DVec3::new(1.0, 2.0 * t, 0.0),
                DVec3::new(0.0, 2.0, 0.0),
            ]
        };
        // From (0, 5/2): 2 t^3 - 4 t = 0, nearest at t = sqrt 2, squared distance 2 + 1/4.
        let p = DVec3::new(0.0, 2.5, 0.0);
        let (t, d2) = nearest_on_curve(curve, p, 0.3, Range::UNBOUNDED);
        assert!((t - 2f64.sqrt()).abs() < 1e-9, "{t}");
        assert!((d2 - 2.25).abs() < 1e-14);
        let (t, _) = nearest_on_curve(curve, p, 0.3, Range::open(-1.0, 1.0));
        assert_eq!(t, 1.0, "held at the end");
    }
}
