//! Rational B-spline curves.

use glam::{DVec3, DVec4};

use super::RigidTransform;
use super::basis::{KnotError, Knots};
use super::newton::{Range, nearest_on_curve};

/// A rational B-spline curve of any degree up to [`super::basis::MAX_DEGREE`], mm.
#[derive(Debug, Clone, PartialEq)]
pub struct NurbsCurve {
    knots: Knots,
    /// Control points times weight, and the weight.
    points: Vec<DVec4>,
    rational: bool,
    closed: bool,
    /// Pieces of the curve, each inside a ball, for the global search.
    cells: Vec<Cell>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Cell {
    centre: DVec3,
    radius: f64,
    t: f64,
}

/// Why control points, weights and knots make no curve or surface.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NurbsError {
    /// The knot vector cannot be used.
    #[error(transparent)]
    Knots(#[from] KnotError),
    /// Rows or weights do not fit the control points.
    #[error("{weights} weights for {points} control points: expected as many")]
    WeightCount {
        /// As given.
        weights: usize,
        /// As given.
        points: usize,
    },
    /// A weight is not a positive finite number.
    #[error("weight {index} is {value}: expected a positive finite number")]
    Weight {
        /// Position, row by row.
        index: usize,
        /// As given.
        value: f64,
    },
    /// A control point has a coordinate that is not finite.
    #[error("control point {index} is not finite: expected three finite coordinates")]
    Point {
        /// Position, row by row.
        index: usize,
    },
}

/// Control points and weights in homogeneous form, and whether the weights differ.
pub(super) fn homogeneous(
    points: &[DVec3],
    weights: Option<&[f64]>,
) -> Result<(Vec<DVec4>, bool), NurbsError> {
    if let Some(index) = points.iter().position(|p| !p.is_finite()) {
        return Err(NurbsError::Point { index });
    }
    let Some(weights) = weights else {
        return Ok((points.iter().map(|p| p.extend(1.0)).collect(), false));
    };
    if weights.len() != points.len() {
        return Err(NurbsError::WeightCount {
            weights: weights.len(),
            points: points.len(),
        });
    }
    let bad = weights.iter().position(|w| !(w.is_finite() && *w > 0.0));
    if let Some(index) = bad {
        return Err(NurbsError::Weight {
            index,
            value: weights[index],
        });
    }
    let rational = weights.iter().any(|w| *w != weights[0]);
    let scale = if rational { 1.0 } else { 1.0 / weights[0] };
    let points = points.iter().zip(weights);
    let points = points.map(|(p, w)| (*p * *w).extend(*w) * scale).collect();
    Ok((points, rational))
}

impl NurbsCurve {
    /// The curve of these control points; no `weights` means all equal. `knots` has its multiplicities expanded.
    pub fn new(
        degree: usize,
        points: &[DVec3],
        weights: Option<&[f64]>,
        knots: Vec<f64>,
    ) -> Result<Self, NurbsError> {
        let knots = Knots::new(degree, points.len(), knots)?;
        let (points, rational) = homogeneous(points, weights)?;
        let mut curve = Self {
            knots,
            points,
            rational,
            closed: false,
            cells: Vec::new(),
        };
        let (from, to) = curve.knots.domain();
        let (first, last) = (curve.point(from), curve.point(to));
        curve.cells = curve.search_cells();
        let size = curve
            .cells
            .iter()
            .map(|c| c.centre.distance(first))
            .fold(0.0, f64::max);
        // Writers round coordinates to 1e-7 of the size and worse.
        curve.closed = first.distance(last) <= 1e-6 * size;
        Ok(curve)
    }

    /// Knot vector.
    pub fn knots(&self) -> &Knots {
        &self.knots
    }

    /// Control points with their weights.
    pub fn control_points(&self) -> impl ExactSizeIterator<Item = (DVec3, f64)> + '_ {
        self.points.iter().map(|p| (p.truncate() / p.w, p.w))
    }

    /// First and last parameter, closed where the curve ends where it begins.
    pub fn range(&self) -> Range {
        let (from, to) = self.knots.domain();
        Range {
            from,
            to,
            closed: self.closed,
        }
    }

    /// Position at `t`, brought into the domain.
    pub fn point(&self, t: f64) -> DVec3 {
        let t = self.range().bring(t);
        let span = self.knots.span(t);
        let basis = self.knots.values(span, t);
        let mut sum = DVec4::ZERO;
        let p = self.knots.degree();
        for (b, point) in basis.iter().zip(&self.points[span - p..=span]) {
            sum += *point * *b;
        }
        if self.rational {
            sum.truncate() / sum.w
        } else {
            sum.truncate()
        }
    }

    /// Position, first and second derivative at `t`, brought into the domain.
    pub fn derivatives(&self, t: f64) -> [DVec3; 3] {
        let t = self.range().bring(t);
        let span = self.knots.span(t);
        let [n, dn, ddn] = self.knots.derivatives(span, t);
        let p = self.knots.degree();
        let (mut a, mut da, mut dda) = (DVec4::ZERO, DVec4::ZERO, DVec4::ZERO);
        for (j, point) in self.points[span - p..=span].iter().enumerate() {
            a += *point * n[j];
            da += *point * dn[j];
            dda += *point * ddn[j];
        }
        if !self.rational {
            return [a.truncate(), da.truncate(), dda.truncate()];
        }
        let c = a.truncate() / a.w;
        let dc = (da.truncate() - c * da.w) / a.w;
        let ddc = (dda.truncate() - dc * (2.0 * da.w) - c * dda.w) / a.w;
        [c, dc, ddc]
    }

    /// Parameter of the nearest point of the whole curve, and the distance.
    pub fn nearest(&self, p: DVec3) -> (f64, f64) {
        let range = self.range();
        let refine = |t| nearest_on_curve(|t| self.derivatives(t), p, t, range);
        let d2 = |i: usize| self.cells[i].centre.distance_squared(p);
        let first = (0..self.cells.len())
            .min_by(|a, b| d2(*a).total_cmp(&d2(*b)))
            .unwrap_or(0);
        let mut best = refine(self.cells[first].t);
        for (i, cell) in self.cells.iter().enumerate() {
            let reach = best.1.sqrt() + cell.radius;
            if i != first && d2(i) < reach * reach {
                let found = refine(cell.t);
                if found.1 < best.1 {
                    best = found;
                }
            }
        }
        (best.0, best.1.sqrt())
    }

    /// The curve moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        let mut moved = self.clone();
        for p in &mut moved.points {
            *p = (by.rotation * p.truncate() + by.translation * p.w).extend(p.w);
        }
        for c in &mut moved.cells {
            c.centre = by.point(c.centre);
        }
        moved
    }

    fn search_cells(&self) -> Vec<Cell> {
        let breaks = self.knots.breaks();
        let pieces = (24 / (breaks.len() - 1)).clamp(2, 12);
        let mut cells = Vec::with_capacity(pieces * (breaks.len() - 1));
        for w in breaks.windows(2) {
            let width = (w[1] - w[0]) / pieces as f64;
            for i in 0..pieces {
                let from = w[0] + width * i as f64;
                let t = from + 0.5 * width;
                let centre = self.point(t);
                let radius = (0..=8)
                    .map(|k| {
                        self.point(from + width * f64::from(k) / 8.0)
                            .distance(centre)
                    })
                    .fold(0.0, f64::max);
                // Between samples an eighth of a cell apart the curve bulges by a few per cent at most.
                cells.push(Cell {
                    centre,
                    radius: 1.1 * radius,
                    t,
                });
            }
        }
        cells
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::f64::consts::{FRAC_1_SQRT_2, TAU};

    /// The unit circle about z as nine rational control points (Piegl and Tiller, example 7.3).
    pub fn circle() -> NurbsCurve {
        let xy = [
            (1, 0),
            (1, 1),
            (0, 1),
            (-1, 1),
            (-1, 0),
            (-1, -1),
            (0, -1),
            (1, -1),
            (1, 0),
        ];
        let points: Vec<DVec3> = xy
            .iter()
            .map(|(x, y)| DVec3::new(f64::from(*x), f64::from(*y), 0.0))
            .collect();
        let weights: Vec<f64> = (0..9)
            .map(|i| if i % 2 == 0 { 1.0 } else { FRAC_1_SQRT_2 })
            .collect();
        let knots = vec![0., 0., 0., 1., 1., 2., 2., 3., 3., 4., 4., 4.];
        NurbsCurve::new(2, &points, Some(&weights), knots).expect("a circle")
    }

    #[test]
    fn the_rational_circle_is_a_circle() {
        let c = circle();
        assert!(c.range().closed);
        for i in 0..100 {
            let t = f64::from(i) * 0.0437;
            let [p, d, dd] = c.derivatives(t);
            assert!(
                (p.length() - 1.0).abs() < 4e-16 * 4.0,
                "unit distance at {t}"
            );
            assert!(p.dot(d).abs() < 1e-14, "the tangent is across the radius");
            // |p|^2 = 1 differentiated twice.
            assert!((p.dot(dd) + d.length_squared()).abs() < 1e-13);
            assert!((c.point(t) - p).length() < 1e-15);
        }
    }

    #[test]
    fn nearest_finds_the_global_minimum() {
        let c = circle();
        for i in 0..50 {
            let angle = TAU * f64::from(i) / 50.0 + 0.01;
            let radial = DVec3::new(angle.cos(), angle.sin(), 0.0);
            let p = radial * 0.3 + DVec3::Z * 0.4;
            let (t, d) = c.nearest(p);
            assert!(c.point(t).distance(radial) < 1e-9);
            assert!((d - (0.49f64 + 0.16).sqrt()).abs() < 1e-14);
        }
    }

    #[test]
    fn bad_weights_and_points_are_named() {
        let p = [DVec3::ZERO, DVec3::X];
        let knots = vec![0.0, 0.0, 1.0, 1.0];
        let text = |p: &[DVec3], w: &[f64]| {
            NurbsCurve::new(1, p, Some(w), knots.clone())
                .expect_err("must be refused")
                .to_string()
        };
        assert_eq!(
            text(&p, &[1.0, -1.0]),
            "weight 1 is -1: expected a positive finite number"
        );
        assert_eq!(
            text(&p, &[1.0]),
            "1 weights for 2 control points: expected as many"
        );
        assert_eq!(
            text(&[DVec3::ZERO, DVec3::NAN], &[1.0, 1.0]),
            "control point 1 is not finite: expected three finite coordinates"
        );
    }
}
