//! Bounds on the derivatives of a B-spline surface over its pieces, from the control nets of its derivatives.

use glam::{DVec3, DVec4};

use super::basis::Knots;

/// Highest order that is bounded.
const ORDER: usize = 3;
/// Orders (a in u, b in v) with a + b up to [`ORDER`]: entry `a * 4 + b`.
type Orders<T> = [T; 16];

/// The control nets of all derivatives up to the third order, homogeneous.
pub(super) struct Nets<'a> {
    knots: [&'a Knots; 2],
    rational: bool,
    nets: Orders<Vec<DVec4>>,
}

/// Bounds on the lengths of the third derivatives over a patch, in parameters that run from -1 to 1 on it:
/// uuu, uuv, uvv, vvv.
pub(super) type Third = [f64; 4];

impl<'a> Nets<'a> {
    /// From control points times weight, and weight, v running fastest.
    pub fn new(knots: [&'a Knots; 2], points: &[DVec4], rational: bool) -> Self {
        let mut nets: Orders<Vec<DVec4>> = Default::default();
        nets[0] = points.to_vec();
        for a in 0..=ORDER {
            for b in 0..=ORDER - a {
                if b > 0 {
                    let below = &nets[a * 4 + b - 1];
                    nets[a * 4 + b] = differentiated(below, knots, [a, b - 1], 1);
                } else if a > 0 {
                    let below = &nets[(a - 1) * 4];
                    nets[a * 4] = differentiated(below, knots, [a - 1, 0], 0);
                }
            }
        }
        Self {
            knots,
            rational,
            nets,
        }
    }

    /// Bounds over the piece that begins at the knots `spans`, of half widths `halves`; `centre` is a point near the piece.
    pub fn third(&self, spans: [usize; 2], halves: [f64; 2], centre: DVec3) -> Third {
        let scale = |a: usize, b: usize| halves[0].powi(a as i32) * halves[1].powi(b as i32);
        let of = |a: usize, b: usize| {
            let (length, weight) = self.largest([a, b], spans, centre);
            (length * scale(a, b), weight * scale(a, b))
        };
        let thirds = [(3, 0), (2, 1), (1, 2), (0, 3)];
        if !self.rational {
            return thirds.map(|(a, b)| of(a, b).0);
        }
        leibniz(self.least_weight(spans), of)
    }

    /// Largest length of A - centre w, and of w, over the control points that a piece uses.
    fn largest(&self, [a, b]: [usize; 2], spans: [usize; 2], centre: DVec3) -> (f64, f64) {
        let mut out = (0.0f64, 0.0f64);
        for p in self.used([a, b], spans) {
            out.0 = out.0.max((p.truncate() - centre * p.w).length_squared());
            out.1 = out.1.max(p.w.abs());
        }
        (out.0.sqrt(), out.1)
    }

    fn least_weight(&self, spans: [usize; 2]) -> f64 {
        self.used([0, 0], spans)
            .map(|p| p.w)
            .fold(f64::INFINITY, f64::min)
    }

    /// The control points of a derivative that a piece uses.
    fn used(&self, [a, b]: [usize; 2], spans: [usize; 2]) -> impl Iterator<Item = DVec4> + '_ {
        let net = &self.nets[a * 4 + b];
        let [ku, kv] = self.knots;
        let stride = kv.points().saturating_sub(b);
        let (u, v) = (spans[0] - ku.degree(), spans[1] - kv.degree());
        let rows = (ku.degree() + 1).saturating_sub(a);
        let columns = (kv.degree() + 1).saturating_sub(b);
        (u..u + rows).flat_map(move |i| {
            net[i * stride + v..i * stride + v + columns]
                .iter()
                .copied()
        })
    }
}

/// Bounds on the third derivatives of T = S - centre, where A = w T: w T_ab is A_ab less the lower orders of T.
///
/// `of` gives bounds on the lengths of the derivatives of A and of w, `least` is the smallest weight.
fn leibniz(least: f64, of: impl Fn(usize, usize) -> (f64, f64)) -> Third {
    let mut bounds: Orders<(f64, f64)> = [(0.0, 0.0); 16];
    let mut t: Orders<f64> = [0.0; 16];
    for order in 0..=ORDER {
        for a in 0..=order {
            let b = order - a;
            bounds[a * 4 + b] = of(a, b);
            let mut sum = bounds[a * 4 + b].0;
            for i in 0..=a {
                for j in 0..=b {
                    if (i, j) != (a, b) {
                        let weight = bounds[(a - i) * 4 + b - j].1;
                        sum += choose(a, i) * choose(b, j) * weight * t[i * 4 + j];
                    }
                }
            }
            t[a * 4 + b] = sum / least;
        }
    }
    [(3, 0), (2, 1), (1, 2), (0, 3)].map(|(a, b)| t[a * 4 + b])
}

/// One polynomial piece of a surface in powers of x and y from -1 to 1, homogeneous: bounds over any part of it.
pub(super) struct Powers {
    /// x^i y^j at `i * SIDE + j`.
    coefficients: [DVec4; SIDE * SIDE],
    rational: bool,
}

/// Powers of each parameter.
const SIDE: usize = super::pieces::MAX_DEGREE + 1;

impl Powers {
    /// The coefficients of a piece.
    pub fn new(coefficients: [DVec4; SIDE * SIDE], rational: bool) -> Self {
        Self {
            coefficients,
            rational,
        }
    }

    /// Bounds over the part with this middle and half widths (of -1 to 1), in parameters that run from -1 to 1 on it.
    pub fn third(&self, middle: [f64; 2], half: [f64; 2], centre: DVec3) -> Third {
        // Taylor's series about the middle; it ends with the degree, so its sum of lengths is a bound.
        let mut q = self.coefficients;
        for line in 0..SIDE {
            shift(&mut q, line * SIDE, 1, middle[1], half[1]);
        }
        for line in 0..SIDE {
            shift(&mut q, line, SIDE, middle[0], half[0]);
        }
        let falling = |n: usize, k: usize| ((n + 1 - k)..=n).product::<usize>() as f64;
        let of = |a: usize, b: usize| {
            let mut out = (0.0, 0.0);
            for i in a..SIDE {
                for j in b..SIDE {
                    let c = q[i * SIDE + j];
                    let times = falling(i, a) * falling(j, b);
                    out.0 += times * (c.truncate() - centre * c.w).length();
                    out.1 += times * c.w.abs();
                }
            }
            out
        };
        if !self.rational {
            return [(3, 0), (2, 1), (1, 2), (0, 3)].map(|(a, b)| of(a, b).0);
        }
        let spread: f64 = q[1..].iter().map(|c| c.w.abs()).sum();
        let least = q[0].w - spread;
        if least <= 0.0 {
            return [f64::INFINITY; 4];
        }
        leibniz(least, of)
    }
}

/// A polynomial in x as one in y, where x = middle + half y.
fn shift(q: &mut [DVec4], start: usize, stride: usize, middle: f64, half: f64) {
    for first in 0..SIDE {
        for i in (first..SIDE - 1).rev() {
            let above = q[start + (i + 1) * stride];
            q[start + i * stride] += above * middle;
        }
    }
    let mut scale = 1.0;
    for i in 0..SIDE {
        q[start + i * stride] *= scale;
        scale *= half;
    }
}

/// The net one order higher in direction `by`, from one of `orders`; empty where the degree leaves none.
fn differentiated(net: &[DVec4], knots: [&Knots; 2], orders: [usize; 2], by: usize) -> Vec<DVec4> {
    let [nu, nv] = [0, 1].map(|k| knots[k].points().saturating_sub(orders[k]));
    let k = knots[by].as_slice();
    let Some(degree) = knots[by].degree().checked_sub(orders[by]) else {
        return Vec::new();
    };
    if degree == 0 || net.is_empty() {
        return Vec::new();
    }
    // The knots of a derivative are the same without the outermost.
    let factor = |i: usize| {
        let width = k[i + orders[by] + degree + 1] - k[i + orders[by] + 1];
        if width > 0.0 {
            degree as f64 / width
        } else {
            0.0
        }
    };
    let mut out = Vec::with_capacity(net.len());
    if by == 0 {
        for i in 0..nu - 1 {
            let f = factor(i);
            out.extend((0..nv).map(|j| (net[(i + 1) * nv + j] - net[i * nv + j]) * f));
        }
    } else {
        let factors: Vec<f64> = (0..nv - 1).map(factor).collect();
        for row in net.chunks_exact(nv) {
            out.extend((0..nv - 1).map(|j| (row[j + 1] - row[j]) * factors[j]));
        }
    }
    out
}

fn choose(n: usize, k: usize) -> f64 {
    const PASCAL: [[f64; 4]; 4] = [
        [1.0, 0.0, 0.0, 0.0],
        [1.0, 1.0, 0.0, 0.0],
        [1.0, 2.0, 1.0, 0.0],
        [1.0, 3.0, 3.0, 1.0],
    ];
    PASCAL[n][k]
}
