//! Bivariate polynomials over a local frame: weighted least squares, derivatives, the nearest point on their graph.

use glam::{DVec2, DVec3};

/// Terms of the largest polynomial: degree three.
pub(crate) const TERMS_MAX: usize = 10;

/// Degree of the local polynomial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Degree {
    /// A plane.
    One,
    /// A paraboloid.
    #[default]
    Two,
    /// A cubic.
    Three,
}

impl Degree {
    /// Number of coefficients.
    pub(crate) fn terms(self) -> usize {
        match self {
            Degree::One => 3,
            Degree::Two => 6,
            Degree::Three => 10,
        }
    }
}

/// A right-handed orthonormal frame on the part: the polynomial's heights run along `normal`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LocalFrame {
    pub origin: DVec3,
    pub u: DVec3,
    pub v: DVec3,
    pub normal: DVec3,
}

impl LocalFrame {
    /// The frame at `origin` whose third axis is the unit vector `normal`.
    pub fn new(origin: DVec3, normal: DVec3) -> Self {
        let (u, v) = normal.any_orthonormal_pair();
        Self {
            origin,
            u,
            v,
            normal,
        }
    }

    pub fn inside(&self, p: DVec3) -> DVec3 {
        let d = p - self.origin;
        DVec3::new(d.dot(self.u), d.dot(self.v), d.dot(self.normal))
    }

    pub fn outside(&self, p: DVec3) -> DVec3 {
        self.origin + self.direction(p)
    }

    pub fn direction(&self, d: DVec3) -> DVec3 {
        self.u * d.x + self.v * d.y + self.normal * d.z
    }
}

/// The monomials up to degree three at (x, y), lower degrees first.
pub(crate) fn monomials(x: f64, y: f64) -> [f64; TERMS_MAX] {
    let (xx, xy, yy) = (x * x, x * y, y * y);
    [1.0, x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y]
}

/// Normal equations of a weighted fit, in coordinates divided by `scale_mm` so that their condition does not depend on the unit.
#[derive(Debug, Clone)]
pub(crate) struct Equations {
    terms: usize,
    scale_mm: f64,
    matrix: [[f64; TERMS_MAX]; TERMS_MAX],
    right: [f64; TERMS_MAX],
    heights: f64,
    weights: f64,
    weights_squared: f64,
    count: usize,
}

impl Equations {
    /// The equations of no points yet.
    pub fn new(degree: Degree, scale_mm: f64) -> Self {
        Self {
            terms: degree.terms(),
            scale_mm,
            matrix: [[0.0; TERMS_MAX]; TERMS_MAX],
            right: [0.0; TERMS_MAX],
            heights: 0.0,
            weights: 0.0,
            weights_squared: 0.0,
            count: 0,
        }
    }

    /// Adds points given in the local frame, with weights.
    pub fn add_all(&mut self, points: impl Iterator<Item = (DVec3, f64)>) {
        match self.terms {
            3 => self.add_terms::<3>(points),
            6 => self.add_terms::<6>(points),
            _ => self.add_terms::<10>(points),
        }
    }

    #[inline]
    fn add_terms<const T: usize>(&mut self, points: impl Iterator<Item = (DVec3, f64)>) {
        let inverse = 1.0 / self.scale_mm;
        let mut matrix = [[0.0; T]; T];
        let mut right = [0.0; T];
        for (at, weight) in points {
            let phi = monomials(at.x * inverse, at.y * inverse);
            // All of the square rather than half: the compiler works on two columns at once.
            for i in 0..T {
                let row = weight * phi[i];
                for j in 0..T {
                    matrix[i][j] += row * phi[j];
                }
            }
            let height = weight * at.z;
            for i in 0..T {
                right[i] += height * phi[i];
            }
            self.heights += height * at.z;
            self.weights += weight;
            self.weights_squared += weight * weight;
            self.count += 1;
        }
        for (sums, row) in self.matrix.iter_mut().zip(&matrix) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += value;
            }
        }
        for (sum, value) in self.right.iter_mut().zip(&right) {
            *sum += value;
        }
    }

    /// The polynomial of least squares, its higher degrees shrunk as far as noise of `sigma_mm` would make them.
    ///
    /// The part of a degree above one is multiplied by 1 - 2 (n - 2) s² / q (not below 0), with n its number of terms, s² the noise and q
    /// what it takes off the sum of squares: positive-part James-Stein, as strong as it may be without ever being worse than no
    /// shrinking. On a plane the fit so becomes more like that of a plane, with its small variance; where the surface curves, little changes. Degrees that the points cannot determine are left out; `None` where
    /// they do not even determine a plane.
    pub fn solve(&self, sigma_mm: f64) -> Option<Polynomial> {
        let mut terms = self.terms;
        let lower = loop {
            if self.count >= terms
                && let Some(lower) = self.cholesky(terms)
            {
                break lower;
            }
            terms = match terms {
                10 => 6,
                6 => 3,
                _ => return None,
            };
        };
        let mut y = [0.0; TERMS_MAX];
        for i in 0..terms {
            let mut sum = self.right[i];
            for j in 0..i {
                sum -= lower[i][j] * y[j];
            }
            y[i] = sum / lower[i][i];
        }
        let explained: f64 = y[..terms].iter().map(|v| v * v).sum();
        let mean_weight = self.weights_squared / self.weights;
        let residual_squares = (self.heights - explained).max(0.0);
        let freedom = (self.weights - terms as f64 * mean_weight).max(0.0);
        shrink(&mut y[..terms], sigma_mm * sigma_mm * mean_weight);

        let mut coefficients = [0.0; TERMS_MAX];
        for i in (0..terms).rev() {
            let mut sum = y[i];
            for j in i + 1..terms {
                sum -= lower[j][i] * coefficients[j];
            }
            coefficients[i] = sum / lower[i][i];
        }
        let residual_mm = if freedom > 1e-9 * self.weights && self.count > terms {
            (residual_squares / freedom).sqrt()
        } else {
            0.0
        };
        Some(Polynomial {
            terms,
            scale_mm: self.scale_mm,
            coefficients,
            residual_mm,
        })
    }

    /// Weighted sum of the squared residuals of the solution `polynomial`, nothing shrunk, mm².
    pub fn residual_squares(&self, polynomial: &Polynomial) -> f64 {
        let explained: f64 = (polynomial.coefficients.iter().zip(&self.right))
            .map(|(c, r)| c * r)
            .sum();
        (self.heights - explained).max(0.0)
    }

    fn cholesky(&self, terms: usize) -> Option<[[f64; TERMS_MAX]; TERMS_MAX]> {
        let mut lower = [[0.0; TERMS_MAX]; TERMS_MAX];
        for i in 0..terms {
            for j in 0..=i {
                let mut sum = self.matrix[i][j];
                for (a, b) in lower[i].iter().zip(&lower[j]).take(j) {
                    sum -= a * b;
                }
                if i == j {
                    // A column that others explain to one part in 10^7 carries nothing but rounding and noise.
                    if sum <= 1e-7 * self.matrix[i][i] {
                        return None;
                    }
                    lower[i][i] = sum.sqrt();
                } else {
                    lower[i][j] = sum / lower[j][j];
                }
            }
        }
        Some(lower)
    }

    /// The inverse of the normal matrix of `terms` terms, by columns.
    pub fn inverse(&self, terms: usize) -> Option<[[f64; TERMS_MAX]; TERMS_MAX]> {
        let lower = self.cholesky(terms)?;
        let mut inverse = [[0.0; TERMS_MAX]; TERMS_MAX];
        for (column, out) in inverse.iter_mut().enumerate().take(terms) {
            let mut y = [0.0; TERMS_MAX];
            for i in 0..terms {
                let mut sum = if i == column { 1.0 } else { 0.0 };
                for j in 0..i {
                    sum -= lower[i][j] * y[j];
                }
                y[i] = sum / lower[i][i];
            }
            for i in (0..terms).rev() {
                let mut sum = y[i];
                for j in i + 1..terms {
                    sum -= lower[j][i] * out[j];
                }
                out[i] = sum / lower[i][i];
            }
        }
        Some(inverse)
    }
}

fn shrink(y: &mut [f64], variance: f64) {
    for group in [3..6, 6..10] {
        let Some(part) = y.get_mut(group) else { return };
        let taken: f64 = part.iter().map(|v| v * v).sum();
        let factor = if taken > 0.0 {
            (1.0 - 2.0 * (part.len() as f64 - 2.0) * variance / taken).max(0.0)
        } else {
            0.0
        };
        part.iter_mut().for_each(|v| *v *= factor);
    }
}

/// Heights over a local frame, mm, as a polynomial of the frame's two coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Polynomial {
    terms: usize,
    scale_mm: f64,
    coefficients: [f64; TERMS_MAX],
    /// Weighted root mean square of the residuals, by the degrees of freedom left, before any shrinking; 0 where none is left.
    pub residual_mm: f64,
}

/// Value and derivatives of a height field at one place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Jet {
    pub height: f64,
    pub gradient: DVec2,
    /// Second derivatives xx, xy, yy, 1/mm.
    pub second: [f64; 3],
}

impl Polynomial {
    /// The plane `height = 0`.
    pub fn flat() -> Self {
        Self {
            terms: 3,
            scale_mm: 1.0,
            coefficients: [0.0; TERMS_MAX],
            residual_mm: 0.0,
        }
    }

    pub fn terms(&self) -> usize {
        self.terms
    }

    /// Height at (x, y), mm.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let s = 1.0 / self.scale_mm;
        let (x, y) = (x * s, y * s);
        let c = &self.coefficients;
        let low = c[0] + x * (c[1] + x * c[3] + y * c[4]) + y * (c[2] + y * c[5]);
        if self.terms < 10 {
            return low;
        }
        low + x * x * (x * c[6] + y * c[7]) + y * y * (x * c[8] + y * c[9])
    }

    /// Value and derivatives at (x, y).
    pub fn jet(&self, x: f64, y: f64) -> Jet {
        let s = 1.0 / self.scale_mm;
        let height = self.height(x, y);
        let (x, y) = (x * s, y * s);
        let c = &self.coefficients;
        let gradient = DVec2::new(
            c[1] + 2.0 * c[3] * x
                + c[4] * y
                + 3.0 * c[6] * x * x
                + 2.0 * c[7] * x * y
                + c[8] * y * y,
            c[2] + c[4] * x
                + 2.0 * c[5] * y
                + c[7] * x * x
                + 2.0 * c[8] * x * y
                + 3.0 * c[9] * y * y,
        );
        let second = [
            2.0 * c[3] + 6.0 * c[6] * x + 2.0 * c[7] * y,
            c[4] + 2.0 * c[7] * x + 2.0 * c[8] * y,
            2.0 * c[5] + 2.0 * c[8] * x + 6.0 * c[9] * y,
        ];
        Jet {
            height,
            gradient: gradient * s,
            second: second.map(|v| v * s * s),
        }
    }

    /// The point of the graph nearest to `p` (all in the local frame), reached from p's own place by Newton steps.
    ///
    /// `None` where the steps leave the disc of `reach_mm` around the origin of the frame.
    pub fn foot(&self, p: DVec3, reach_mm: f64) -> Option<(DVec3, Jet)> {
        let (mut x, mut y) = (p.x, p.y);
        for _ in 0..12 {
            let jet = self.jet(x, y);
            let (gx, gy) = (jet.gradient.x, jet.gradient.y);
            let rise = jet.height - p.z;
            let (fx, fy) = (x - p.x + rise * gx, y - p.y + rise * gy);
            let mut a = [
                1.0 + gx * gx + rise * jet.second[0],
                gx * gy + rise * jet.second[1],
                1.0 + gy * gy + rise * jet.second[2],
            ];
            if a[0] * a[2] - a[1] * a[1] < 0.25 || a[0] < 0.25 {
                a = [1.0 + gx * gx, gx * gy, 1.0 + gy * gy];
            }
            let determinant = a[0] * a[2] - a[1] * a[1];
            let dx = (a[2] * fx - a[1] * fy) / determinant;
            let dy = (a[0] * fy - a[1] * fx) / determinant;
            x -= dx;
            y -= dy;
            let square = x * x + y * y;
            if square.is_nan() || square > reach_mm * reach_mm {
                return None;
            }
            if dx * dx + dy * dy < 1e-18 * reach_mm * reach_mm {
                break;
            }
        }
        let jet = self.jet(x, y);
        Some((DVec3::new(x, y, jet.height), jet))
    }
}

impl Jet {
    /// Unit normal of the graph, in the local frame, on the side of its third axis.
    pub fn normal(&self) -> DVec3 {
        DVec3::new(-self.gradient.x, -self.gradient.y, 1.0).normalize()
    }

    /// Unit direction, in the frame's plane, in which the second derivative is largest in magnitude.
    pub fn steepest_bend(&self) -> DVec2 {
        let [a, b, c] = self.second;
        let angle = 0.5 * (2.0 * b).atan2(a - c);
        let first = DVec2::from_angle(angle);
        let bend = |d: DVec2| (a * d.x * d.x + 2.0 * b * d.x * d.y + c * d.y * d.y).abs();
        if bend(first) >= bend(first.perp()) {
            first
        } else {
            first.perp()
        }
    }

    /// Principal curvatures, 1/mm, the larger magnitude first; positive where the surface bends towards its normal.
    pub fn curvatures(&self) -> [f64; 2] {
        let (fx, fy) = (self.gradient.x, self.gradient.y);
        let [fxx, fxy, fyy] = self.second;
        let w2 = 1.0 + fx * fx + fy * fy;
        let w = w2.sqrt();
        let mean =
            ((1.0 + fy * fy) * fxx - 2.0 * fx * fy * fxy + (1.0 + fx * fx) * fyy) / (2.0 * w2 * w);
        let gauss = (fxx * fyy - fxy * fxy) / (w2 * w2);
        let root = (mean * mean - gauss).max(0.0).sqrt();
        if mean >= 0.0 {
            [mean + root, mean - root]
        } else {
            [mean - root, mean + root]
        }
    }
}
