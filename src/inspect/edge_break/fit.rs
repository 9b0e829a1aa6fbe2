//! Round, chamfer or sharp: signed distances to each shape, least squares in them, and the choice between them.

use nalgebra::{Matrix4, SMatrix, Vector4};

use super::{ONE_SIDED, Quantified, WedgePoint, Zone};
use crate::geometry::fit::{NormalSums, TRIM, mad_sigma};

/// A shape between two flank lines, sizes in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Shape {
    Sharp,
    /// Radius of the circle tangent to both.
    Round(f64),
    /// Legs of the line across both.
    Chamfer(f64, f64),
}

/// A shape with what is known of it.
pub(super) enum Fitted {
    Sharp {
        radius_below: f64,
    },
    Round {
        radius: Quantified,
    },
    Chamfer {
        legs: [f64; 2],
        covariance: [[f64; 2]; 2],
    },
    /// Broken, and either of the two; the one that fits better decides the sizes that every shape has.
    Undecided {
        radius: Quantified,
        legs: [f64; 2],
        covariance: [[f64; 2]; 2],
        round: bool,
    },
}

/// How much better one shape must be than another to be called decided: 2 ln of the Bayes factor, "strong" from 6 on (Kass and Raftery
/// 1995).
const DECIDED: f64 = 6.0;

/// Residuals are cut at this many standard deviations where shapes are compared.
const CLIP: f64 = 3.0;

impl Shape {
    /// Signed distance of the place with heights `d` over the flanks, which turn by `turn`; plus = outside.
    pub(super) fn distance(&self, d: [f64; 2], turn: f64) -> f64 {
        let (sin, cos) = (0.5 * turn).sin_cos();
        let wedge = d[0].max(d[1]);
        let x = (d[0] - d[1]) / (2.0 * sin);
        let y = (d[0] + d[1]) / (2.0 * cos);
        match *self {
            Self::Sharp => wedge,
            Self::Round(radius) => {
                let up = y + radius / cos;
                // Inside the angle between the normals at the tangent points it is the circle that is nearest.
                if up > 0.0 && x.abs() * cos <= up * sin {
                    x.hypot(up) - radius
                } else {
                    wedge
                }
            }
            Self::Chamfer(a, b) => {
                let run = cos * (a + b);
                let rise = sin * (b - a);
                let length = run.hypot(rise).max(1e-12);
                // The normal of the line from leg b on the left to leg a on the right.
                let (nx, ny) = (-rise / length, run / length);
                wedge.max((x - a * cos) * nx + (y + a * sin) * ny)
            }
        }
    }
}

/// Two numbers in which a shape can be moved: what a fit varies.
fn shape_of<const P: usize>(p: &[f64; P]) -> Shape {
    match p.as_slice() {
        [radius] => Shape::Round(*radius),
        [a, b] => Shape::Chamfer(*a, *b),
        _ => Shape::Sharp,
    }
}

/// The shape that the data choose, by the Bayesian information criterion with the flanks' noise (Schwarz 1978); a
/// radius below twice its uncertainty is none, with the upper bound of a score test. A radius and a chamfer that fit nearly alike are
/// not told apart.
pub(super) fn choose(zone: &Zone<'_>) -> Fitted {
    let penalty = (zone.points.len() as f64).ln();
    let sharp = zone.deviance(&Shape::Sharp);
    let round = zone.start_round().and_then(|start| zone.fit([start]));
    let of_round = round.map_or(f64::MAX, |r| zone.deviance(&Shape::Round(r.0[0])) + penalty);
    // Where a radius gains nothing over the sharp edge neither does a chamfer.
    let chamfer = (of_round < sharp)
        .then(|| zone.fit(zone.start_chamfer()))
        .flatten();
    let of_chamfer = chamfer.map_or(f64::MAX, |c| {
        zone.deviance(&Shape::Chamfer(c.0[0], c.0[1])) + 2.0 * penalty
    });
    let chamfer = chamfer.filter(|(legs, c)| (0..2).all(|i| legs[i] > 2.0 * c[i][i].sqrt()));
    let round = round
        .map(|([radius], c)| Quantified {
            value: radius,
            u: c[0][0].sqrt(),
        })
        .filter(|radius| of_round < sharp && radius.value > 2.0 * radius.u);
    let either = (of_round - of_chamfer).abs() < DECIDED;
    match (round, chamfer) {
        (Some(radius), Some((legs, covariance))) if either => {
            return Fitted::Undecided {
                radius,
                legs,
                covariance,
                round: of_round <= of_chamfer,
            };
        }
        (_, Some((legs, covariance))) if of_chamfer < of_round => {
            return Fitted::Chamfer { legs, covariance };
        }
        (Some(radius), _) => return Fitted::Round { radius },
        _ => {}
    }
    Fitted::Sharp {
        radius_below: zone.radius_below(),
    }
}

impl Zone<'_> {
    /// The largest radius whose tangent points lie in the zone.
    fn radius_max(&self) -> f64 {
        self.reach[0].max(self.reach[1]) / (0.5 * self.turn).tan()
    }

    /// Sum of clipped squares over the noise, of every `step`th point.
    fn misfit(&self, shape: &Shape, step: usize) -> f64 {
        self.points
            .iter()
            .step_by(step)
            .map(|p| {
                let e = shape.distance(p.d, self.turns[p.wedge]) / self.sigma;
                (e * e).min(CLIP * CLIP)
            })
            .sum()
    }

    /// The misfit that stays when the flanks move within their uncertainty to where it is least: what the flanks' errors add to the
    /// residuals speaks for no shape. Points that the flanks were fitted to have said what they know of them already.
    fn deviance(&self, shape: &Shape) -> f64 {
        let wedges = &self.stretch.wedges;
        let mut sums = vec![(Matrix4::<f64>::zeros(), Vector4::<f64>::zeros()); wedges.len()];
        let mut misfit = 0.0;
        for q in &self.points {
            let e = shape.distance(q.d, self.turns[q.wedge]) / self.sigma;
            misfit += (e * e).min(CLIP * CLIP);
            if q.free && e.abs() < CLIP {
                let row = Vector4::from(self.by_flanks(shape, q)) / self.sigma;
                let (matrix, right) = &mut sums[q.wedge];
                matrix.ger(1.0, &row, &row, 1.0);
                right.axpy(e, &row, 1.0);
            }
        }
        for (wedge, (matrix, right)) in wedges.iter().zip(&sums) {
            let prior = Matrix4::from_fn(|i, j| {
                let (f, g) = (i / 2, j / 2);
                if f == g {
                    self.stretch.shared_factor[f] * wedge.flanks[f].covariance[i % 2][j % 2]
                } else {
                    0.0
                }
            });
            if let Some(inverse) = (Matrix4::identity() + prior * matrix).try_inverse() {
                misfit -= right.dot(&(inverse * prior * right));
            }
        }
        misfit
    }

    fn start_round(&self) -> Option<f64> {
        let step = self.points.len().div_ceil(400);
        let largest = self.radius_max();
        (0..20)
            .map(|k| largest * 0.8f64.powi(k))
            .map(|r| (self.misfit(&Shape::Round(r), step), r))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|best| best.1)
    }

    fn start_chamfer(&self) -> [f64; 2] {
        let step = self.points.len().div_ceil(300);
        let leg = |i: usize, k: i32| self.reach[i] * 0.75f64.powi(k);
        let mut best = (f64::MAX, [leg(0, 0), leg(1, 0)]);
        for i in 0..10 {
            for j in 0..10 {
                let legs = [leg(0, i), leg(1, j)];
                let misfit = self.misfit(&Shape::Chamfer(legs[0], legs[1]), step);
                if misfit < best.0 {
                    best = (misfit, legs);
                }
            }
        }
        best.1
    }

    /// Gauss-Newton on the distances within [`TRIM`] standard deviations; the parameters and their covariance, the flanks' share
    /// included. `None` where the data do not hold them.
    fn fit<const P: usize>(&self, start: [f64; P]) -> Option<([f64; P], [[f64; P]; P])> {
        let p = self.descend(start)?;
        let e = self.residuals(&shape_of(&p));
        let covariance = self.covariance(&p, &e)?;
        Some((p, covariance))
    }

    fn residuals(&self, shape: &Shape) -> Vec<f64> {
        let of = |q: &WedgePoint| shape.distance(q.d, self.turns[q.wedge]);
        self.points.iter().map(of).collect()
    }

    /// The parameters alone.
    pub(super) fn descend<const P: usize>(&self, start: [f64; P]) -> Option<[f64; P]> {
        let mut p = start;
        for _ in 0..40 {
            let e = self.residuals(&shape_of(&p));
            let limit = TRIM * mad_sigma(&e).max(self.sigma);
            let mut sums = NormalSums::<P>::default();
            for (q, e) in self.points.iter().zip(&e) {
                if e.abs() <= limit {
                    sums.add(&self.gradient(&p, q), -e, 1.0);
                }
            }
            let (step, _) = sums.solve()?;
            let mut moved: f64 = 0.0;
            for (value, change) in p.iter_mut().zip(step) {
                let bounded = change.clamp(-0.5 * *value, *value);
                *value += bounded;
                moved = moved.max(bounded.abs());
            }
            if moved < 1e-7 {
                break;
            }
        }
        if p.iter().any(|x| {
            !x.is_finite() || *x > 4.0 * self.radius_max().max(self.reach[0] + self.reach[1])
        }) {
            return None;
        }
        Some(p)
    }

    fn gradient<const P: usize>(&self, p: &[f64; P], q: &WedgePoint) -> [f64; P] {
        let turn = self.turns[q.wedge];
        std::array::from_fn(|k| {
            let step = 1e-4 * p[k];
            let mut moved = *p;
            moved[k] = p[k] + step;
            let more = shape_of(&moved).distance(q.d, turn);
            moved[k] = p[k] - step;
            (more - shape_of(&moved).distance(q.d, turn)) / (2.0 * step)
        })
    }

    /// How the distance of `q` changes with (offset 1, tilt 1, offset 2, tilt 2) of its wedge.
    fn by_flanks(&self, shape: &Shape, q: &WedgePoint) -> [f64; 4] {
        let turn = self.turns[q.wedge];
        let step = 1e-6;
        let at = |d: [f64; 2], turn: f64| shape.distance(d, turn);
        let by_turn = (at(q.d, turn + step) - at(q.d, turn - step)) / (2.0 * step);
        let by = [
            (at([q.d[0] + step, q.d[1]], turn) - at([q.d[0] - step, q.d[1]], turn)) / (2.0 * step),
            (at([q.d[0], q.d[1] + step], turn) - at([q.d[0], q.d[1] - step], turn)) / (2.0 * step),
        ];
        // Raising a flank lowers the heights over it; tilting it outward opens the angle, which turns less where convex.
        let tilt = |i: usize| -self.sign * (by[i] * q.r[i] + by_turn);
        [-self.sign * by[0], tilt(0), -self.sign * by[1], tilt(1)]
    }

    fn covariance<const P: usize>(&self, p: &[f64; P], e: &[f64]) -> Option<[[f64; P]; P]> {
        let shape = shape_of(p);
        let scale = mad_sigma(e).max(self.sigma);
        let mut sums = NormalSums::<P>::default();
        let mut by_flanks = vec![[[0.0; 4]; P]; self.turns.len()];
        for (q, e) in self.points.iter().zip(e) {
            if e.abs() > TRIM * scale {
                continue;
            }
            let g = self.gradient(p, q);
            if g.iter().all(|g| *g == 0.0) {
                continue;
            }
            sums.add(&g, -e, 1.0);
            let of = self.by_flanks(&shape, q);
            for (row, g) in by_flanks[q.wedge].iter_mut().zip(g) {
                for (sum, x) in row.iter_mut().zip(of) {
                    *sum += g * x;
                }
            }
        }
        let (_, cofactor) = sums.solve()?;
        // Points near the end of a leg weigh most there, and noise takes them on and off it: what the parameters answer to is the
        // change of the whole score, not the sum of squared gradients.
        let cofactor = self.answer(p, TRIM * scale).unwrap_or(cofactor);
        let spread = sums.matrix();
        let noise = scale * scale;
        let shared = self.flank_scatter(&by_flanks);
        Some(std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let mut sum = 0.0;
                for a in 0..P {
                    for b in 0..P {
                        let score = noise * spread[a][b] + shared[a][b];
                        sum += cofactor[i][a] * score * cofactor[j][b];
                    }
                }
                sum
            })
        }))
    }

    /// How the parameters answer to the score, the sum of gradient times residual: the inverse of its change over a standard deviation
    /// of the points to either side.
    fn answer<const P: usize>(&self, p: &[f64; P], limit: f64) -> Option<[[f64; P]; P]> {
        let score = |p: &[f64; P]| -> [f64; P] {
            let shape = shape_of(p);
            let mut sum = [0.0; P];
            for q in &self.points {
                let e = shape.distance(q.d, self.turns[q.wedge]);
                if e.abs() <= limit {
                    for (sum, g) in sum.iter_mut().zip(self.gradient(p, q)) {
                        *sum += g * e;
                    }
                }
            }
            sum
        };
        let mut change = SMatrix::<f64, P, P>::zeros();
        for k in 0..P {
            let step = self.sigma.min(0.2 * p[k]);
            let mut moved = *p;
            moved[k] = p[k] + step;
            let more = score(&moved);
            moved[k] = p[k] - step;
            let less = score(&moved);
            for i in 0..P {
                change[(i, k)] = (more[i] - less[i]) / (2.0 * step);
            }
        }
        let inverse = change.try_inverse()?;
        Some(std::array::from_fn(|i| {
            std::array::from_fn(|j| inverse[(i, j)])
        }))
    }

    /// Sum over the wedges of J C J', C the covariance of both flanks.
    fn flank_scatter<const P: usize>(&self, by_flanks: &[[[f64; 4]; P]]) -> [[f64; P]; P] {
        let mut sum = [[0.0; P]; P];
        for (wedge, jacobian) in self.stretch.wedges.iter().zip(by_flanks) {
            for (f, flank) in wedge.flanks.iter().enumerate() {
                let c = &flank.covariance;
                let shared = self.stretch.shared_factor[f];
                for i in 0..P {
                    for j in 0..P {
                        for a in 0..2 {
                            for b in 0..2 {
                                sum[i][j] += shared
                                    * jacobian[i][2 * f + a]
                                    * c[a][b]
                                    * jacobian[j][2 * f + b];
                            }
                        }
                    }
                }
            }
        }
        sum
    }

    /// Score of the radius `r`: a standard normal number where r is true, above it where the edge is sharper.
    fn score(&self, r: f64) -> f64 {
        let shape = Shape::Round(r);
        let limit = TRIM * self.sigma;
        let (mut sum, mut squares) = (0.0, 0.0);
        let mut by_flanks = vec![[[0.0; 4]; 1]; self.turns.len()];
        for q in &self.points {
            let g = self.gradient(&[r], q)[0];
            if g == 0.0 {
                continue;
            }
            let e = shape
                .distance(q.d, self.turns[q.wedge])
                .clamp(-limit, limit);
            sum += g * e;
            squares += g * g;
            for (total, x) in by_flanks[q.wedge][0]
                .iter_mut()
                .zip(self.by_flanks(&shape, q))
            {
                *total += g * x;
            }
        }
        let variance = self.sigma.powi(2) * squares + self.flank_scatter(&by_flanks)[0][0];
        if variance > 0.0 {
            sum / variance.sqrt()
        } else {
            0.0
        }
    }

    /// The radius above which the data refuse every radius with 95 % probability, at most the largest that the zone holds.
    fn radius_below(&self) -> f64 {
        let largest = self.radius_max();
        // From the top, so that a range without points near zero does not end the search.
        let mut accepted = largest;
        let mut refused = largest;
        let mut found = false;
        // Noise takes points through the centre of a smaller circle, and which of them count then depends on their noise.
        let least = (3.0 * self.sigma * (0.5 * self.turn).cos()).min(largest);
        for k in 0..40 {
            let r = largest * 0.85f64.powi(k);
            if r < least {
                break;
            }
            if self.score(r) <= ONE_SIDED {
                accepted = r;
                found = true;
                break;
            }
            refused = r;
        }
        if !found {
            return refused.max(least);
        }
        for _ in 0..8 {
            let middle = 0.5 * (accepted + refused);
            if self.score(middle) <= ONE_SIDED {
                accepted = middle;
            } else {
                refused = middle;
            }
        }
        refused
    }
}
