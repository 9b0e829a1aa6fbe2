//! B-spline basis functions and their derivatives on a knot vector, without allocation.

/// Highest degree that is evaluated; evaluation works in arrays of this size plus one.
pub const MAX_DEGREE: usize = 15;

/// Values of the non-zero basis functions, or of one of their derivatives: entries `0..=degree` count.
pub type Basis = [f64; MAX_DEGREE + 1];

/// A checked knot vector: finite, non-decreasing, as long as its control points and degree ask for.
#[derive(Debug, Clone, PartialEq)]
pub struct Knots {
    degree: usize,
    knots: Vec<f64>,
}

/// Why a knot vector cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum KnotError {
    /// The degree is zero or above [`MAX_DEGREE`].
    #[error("degree {degree}: expected 1 to {MAX_DEGREE}")]
    Degree {
        /// As given.
        degree: usize,
    },
    /// Fewer control points than the degree asks for.
    #[error("{points} control points for degree {degree}: expected at least {}", degree + 1)]
    TooFewPoints {
        /// As given.
        points: usize,
        /// As given.
        degree: usize,
    },
    /// The count of knots does not fit the control points.
    #[error("{knots} knots for {points} control points of degree {degree}: expected {}", points + degree + 1)]
    Count {
        /// As given, multiplicities expanded.
        knots: usize,
        /// As given.
        points: usize,
        /// As given.
        degree: usize,
    },
    /// A knot is not a finite number, or smaller than the one before.
    #[error("knot {index} is {value}: expected a finite number not below the one before")]
    Order {
        /// Position in the expanded vector.
        index: usize,
        /// As given.
        value: f64,
    },
    /// The domain has no length, or a knot repeats too often inside it.
    #[error("domain {from} to {to}: expected a domain with a length")]
    Domain {
        /// First parameter.
        from: f64,
        /// Last parameter.
        to: f64,
    },
}

impl Knots {
    /// A knot vector (multiplicities expanded) for `points` control points.
    pub fn new(degree: usize, points: usize, knots: Vec<f64>) -> Result<Self, KnotError> {
        if degree == 0 || degree > MAX_DEGREE {
            return Err(KnotError::Degree { degree });
        }
        if points <= degree {
            return Err(KnotError::TooFewPoints { points, degree });
        }
        if knots.len() != points + degree + 1 {
            return Err(KnotError::Count {
                knots: knots.len(),
                points,
                degree,
            });
        }
        let out_of_order =
            (0..knots.len()).find(|&i| !knots[i].is_finite() || (i > 0 && knots[i] < knots[i - 1]));
        if let Some(index) = out_of_order {
            return Err(KnotError::Order {
                index,
                value: knots[index],
            });
        }
        let (from, to) = (knots[degree], knots[points]);
        // A domain below the resolution of its own parameters cannot be divided.
        if to - from <= 1e-14 * from.abs().max(to.abs()) {
            return Err(KnotError::Domain { from, to });
        }
        Ok(Self { degree, knots })
    }

    /// Polynomial degree.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Count of control points.
    pub fn points(&self) -> usize {
        self.knots.len() - self.degree - 1
    }

    /// First and last parameter.
    pub fn domain(&self) -> (f64, f64) {
        (self.knots[self.degree], self.knots[self.points()])
    }

    /// All knots, multiplicities expanded.
    pub fn as_slice(&self) -> &[f64] {
        &self.knots
    }

    /// The borders of the polynomial pieces: distinct knots inside the domain and its two ends.
    pub fn breaks(&self) -> Vec<f64> {
        let mut breaks = self.knots[self.degree..=self.points()].to_vec();
        breaks.dedup();
        breaks
    }

    /// Index `i` of the piece with `knots[i] <= t < knots[i + 1]`; the first or last piece outside the domain.
    pub fn span(&self, t: f64) -> usize {
        let inside = &self.knots[self.degree + 1..self.points()];
        let span = self.degree + inside.partition_point(|&k| k <= t);
        // A knot of full multiplicity at the end of the domain leaves an empty last piece: step back to one with a length.
        let mut span = span;
        while span > self.degree && self.knots[span] >= self.knots[span + 1] {
            span -= 1;
        }
        span
    }

    /// Basis functions at `t` in the piece `span`; function `j` belongs to control point `span - degree + j`.
    pub fn values(&self, span: usize, t: f64) -> Basis {
        let mut row = [0.0; MAX_DEGREE + 1];
        row[0] = 1.0;
        for degree in 1..=self.degree {
            self.raise(span, t, degree, &mut row);
        }
        row
    }

    /// Basis functions with their first and second derivatives.
    pub fn derivatives(&self, span: usize, t: f64) -> [Basis; 3] {
        let p = self.degree;
        let mut row = [0.0; MAX_DEGREE + 1];
        let mut two_below = [0.0; MAX_DEGREE + 1];
        let mut one_below = [0.0; MAX_DEGREE + 1];
        row[0] = 1.0;
        if p == 1 {
            one_below = row;
        }
        if p == 2 {
            two_below = row;
        }
        for degree in 1..=p {
            self.raise(span, t, degree, &mut row);
            if degree + 2 == p {
                two_below = row;
            }
            if degree + 1 == p {
                one_below = row;
            }
        }
        let first = self.differentiate(span, p, &one_below);
        let second = if p < 2 {
            [0.0; MAX_DEGREE + 1]
        } else {
            self.differentiate(span, p, &self.differentiate(span, p - 1, &two_below))
        };
        [row, first, second]
    }

    /// Cox - de Boor: basis functions of `degree - 1` to those of `degree`, in place.
    #[inline]
    fn raise(&self, span: usize, t: f64, degree: usize, row: &mut Basis) {
        let mut saved = 0.0;
        for (j, value) in row.iter_mut().enumerate().take(degree) {
            let right = self.knots[span + 1 + j];
            let left = self.knots[span + 1 + j - degree];
            // right > left: both enclose the piece, which has a length.
            let share = *value / (right - left);
            *value = saved + (right - t) * share;
            saved = (t - left) * share;
        }
        row[degree] = saved;
    }

    /// Derivatives of the functions of `degree` from values (or derivatives) of those of `degree - 1`.
    #[inline]
    fn differentiate(&self, span: usize, degree: usize, below: &Basis) -> Basis {
        let mut out = [0.0; MAX_DEGREE + 1];
        let mut saved = 0.0;
        for j in 0..degree {
            let width = self.knots[span + 1 + j] - self.knots[span + 1 + j - degree];
            let share = degree as f64 * below[j] / width;
            out[j] = saved - share;
            saved = share;
        }
        out[degree] = saved;
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn basis_of_the_nurbs_book_example() {
        // Piegl and Tiller, The NURBS Book, example 2.3: p = 2, t = 5/2.
        let knots = vec![0., 0., 0., 1., 2., 3., 4., 4., 5., 5., 5.];
        let k = Knots::new(2, 8, knots).expect("valid");
        let span = k.span(2.5);
        assert_eq!(span, 4);
        let [n, d, dd] = k.derivatives(span, 2.5);
        assert_eq!(&n[..3], &[1.0 / 8.0, 6.0 / 8.0, 1.0 / 8.0]);
        assert_eq!(&d[..3], &[-0.5, 0.0, 0.5]);
        assert_eq!(&dd[..3], &[1.0, -2.0, 1.0]);
    }

    #[test]
    fn values_sum_to_one_and_derivatives_to_zero() {
        let knots = vec![0., 0., 0., 0., 0.3, 0.3, 0.7, 1.1, 1.1, 1.1, 1.1];
        let k = Knots::new(3, 7, knots).expect("valid");
        for i in 0..=22 {
            let t = f64::from(i) * 0.05;
            let span = k.span(t);
            let [n, d, dd] = k.derivatives(span, t);
            assert_eq!(n, k.values(span, t));
            assert!((n.iter().sum::<f64>() - 1.0).abs() < 1e-14);
            // Second derivatives reach 1e2 here: rounding 1e-13.
            assert!(d.iter().sum::<f64>().abs() < 1e-12);
            assert!(dd.iter().sum::<f64>().abs() < 1e-11);
        }
    }

    #[test]
    fn bad_knots_are_named() {
        let text = |degree, points, knots: &[f64]| {
            Knots::new(degree, points, knots.to_vec())
                .expect_err("must be refused")
                .to_string()
        };
        assert_eq!(text(16, 20, &[]), "degree 16: expected 1 to 15");
        assert_eq!(
            text(3, 3, &[]),
            "3 control points for degree 3: expected at least 4"
        );
        assert_eq!(
            text(1, 2, &[0.0, 1.0]),
            "2 knots for 2 control points of degree 1: expected 4"
        );
        assert_eq!(
            text(1, 2, &[0.0, 1.0, 0.5, 1.0]),
            "knot 2 is 0.5: expected a finite number not below the one before"
        );
        assert_eq!(
            text(1, 2, &[1.0; 4]),
            "domain 1 to 1: expected a domain with a length"
        );
    }
}
