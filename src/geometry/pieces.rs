//! B-spline basis functions as polynomials of each piece of a knot vector: fast evaluation at low degrees.

use super::basis::Knots;

/// Highest degree for which polynomials are kept: above it their coefficients cost digits.
pub(super) const MAX_DEGREE: usize = 5;

/// The pieces of a knot vector: quick search, and the basis functions on each in powers of x = -1 to 1.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pieces {
    /// Where each piece begins, and the end of the last.
    breaks: Vec<f64>,
    /// Index of the knot at which each piece begins.
    spans: Vec<usize>,
    /// First piece that may hold parameters of each equal part of the domain.
    buckets: Vec<u32>,
    buckets_per_unit: f64,
    /// Whether the domain ends, or the first derivative may jump, at each of the breaks.
    creases: Vec<bool>,
    /// Middle and inverse half width of each piece.
    scales: Vec<(f64, f64)>,
    /// Per piece `n * n` numbers, power by power: the coefficients of its `n` functions. Empty above the highest degree.
    coefficients: Vec<f64>,
}

/// Values, first and second derivatives of the `N` basis functions at a parameter.
pub(super) type Jet<const N: usize> = [[f64; N]; 3];

impl Pieces {
    pub fn new(knots: &Knots) -> Self {
        let breaks = knots.breaks();
        let count = breaks.len() - 1;
        let spans: Vec<usize> = breaks[..count].iter().map(|b| knots.span(*b)).collect();
        let (from, to) = knots.domain();
        let parts = (2 * count).min(1 << 16);
        let bucket = |k: usize| {
            let t = from + (to - from) * k as f64 / parts as f64;
            (breaks[1..count].partition_point(|b| *b <= t)) as u32
        };
        let halves = breaks.windows(2).map(|w| 0.5 * (w[1] - w[0]));
        let scales: Vec<(f64, f64)> = breaks
            .windows(2)
            .zip(halves)
            .map(|(w, half)| (0.5 * (w[0] + w[1]), half.recip()))
            .collect();
        let mut coefficients = Vec::new();
        if knots.degree() <= MAX_DEGREE {
            for (span, w) in spans.iter().zip(breaks.windows(2)) {
                push_polynomials(knots, *span, (w[0], w[1]), &mut coefficients);
            }
        }
        let k = knots.as_slice();
        let smooth = |b: &f64| {
            let first = k.partition_point(|t| t < b);
            k[first..].partition_point(|t| t <= b) < knots.degree()
        };
        let inner = |i: usize| i > 0 && i < count;
        let creases = breaks.iter().enumerate();
        Self {
            creases: creases.map(|(i, b)| !inner(i) || !smooth(b)).collect(),
            buckets: (0..=parts).map(bucket).collect(),
            buckets_per_unit: parts as f64 / (to - from),
            breaks,
            spans,
            scales,
            coefficients,
        }
    }

    /// The borders of the pieces.
    pub fn breaks(&self) -> &[f64] {
        &self.breaks
    }

    /// Index of the knot at which a piece begins.
    pub fn span_of(&self, piece: usize) -> usize {
        self.spans[piece]
    }

    /// Coefficients of a piece, power by power; empty above the highest degree.
    pub fn coefficients(&self, piece: usize) -> &[f64] {
        let per_piece = self.coefficients.len() / self.spans.len();
        &self.coefficients[piece * per_piece..][..per_piece]
    }

    /// Whether a piece ends, below and above, at an end of the domain or where the first derivative may jump.
    pub fn creases(&self, piece: usize) -> [bool; 2] {
        [self.creases[piece], self.creases[piece + 1]]
    }

    /// The piece that holds `t`, a parameter of the domain.
    #[inline]
    pub fn find(&self, t: f64) -> usize {
        let bucket = ((t - self.breaks[0]) * self.buckets_per_unit) as usize;
        let mut piece = self.buckets[bucket.min(self.buckets.len() - 1)] as usize;
        while piece + 1 < self.spans.len() && self.breaks[piece + 1] <= t {
            piece += 1;
        }
        while piece > 0 && self.breaks[piece] > t {
            piece -= 1;
        }
        piece
    }

    /// Values and first derivatives of the functions at `t`, and the first of their control points; `N` is degree + 1.
    #[inline]
    pub fn first<const N: usize>(&self, t: f64) -> (usize, [[f64; N]; 2]) {
        let (start, x, scale, c) = self.at::<N>(t);
        let (mut f, mut d) = ([0.0; N], [0.0; N]);
        for row in c.chunks_exact(N).rev() {
            for j in 0..N {
                d[j] = d[j] * x + f[j];
                f[j] = f[j] * x + row[j];
            }
        }
        (start, [f, d.map(|d| d * scale)])
    }

    /// The same with second derivatives.
    #[inline]
    pub fn second<const N: usize>(&self, t: f64) -> (usize, Jet<N>) {
        let (start, x, scale, c) = self.at::<N>(t);
        let (mut f, mut d, mut e) = ([0.0; N], [0.0; N], [0.0; N]);
        for row in c.chunks_exact(N).rev() {
            for j in 0..N {
                e[j] = e[j] * x + d[j];
                d[j] = d[j] * x + f[j];
                f[j] = f[j] * x + row[j];
            }
        }
        let twice = 2.0 * scale * scale;
        (start, [f, d.map(|d| d * scale), e.map(|e| e * twice)])
    }

    /// First control point, place in the piece, its scale and its coefficients.
    #[inline]
    fn at<const N: usize>(&self, t: f64) -> (usize, f64, f64, &[f64]) {
        let piece = self.find(t);
        let (middle, scale) = self.scales[piece];
        let c = &self.coefficients[piece * N * N..][..N * N];
        (self.spans[piece] + 1 - N, (t - middle) * scale, scale, c)
    }
}

/// Cox - de Boor on polynomials in x.
fn push_polynomials(knots: &Knots, span: usize, (from, to): (f64, f64), out: &mut Vec<f64>) {
    const N: usize = MAX_DEGREE + 1;
    let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
    let k = knots.as_slice();
    // (a + b x) times a polynomial.
    let times = |a: f64, b: f64, p: &[f64; N]| {
        let mut out = p.map(|c| c * a);
        for i in 1..N {
            out[i] += b * p[i - 1];
        }
        out
    };
    let mut row = [[0.0; N]; N];
    row[0][0] = 1.0;
    for degree in 1..=knots.degree() {
        let mut saved = [0.0; N];
        for j in 0..degree {
            let (right, left) = (k[span + 1 + j], k[span + 1 + j - degree]);
            let share = row[j].map(|c| c / (right - left));
            let falling = times(right - middle, -half, &share);
            for i in 0..N {
                row[j][i] = saved[i] + falling[i];
            }
            saved = times(middle - left, half, &share);
        }
        row[degree] = saved;
    }
    for power in 0..=knots.degree() {
        out.extend(row[..=knots.degree()].iter().map(|p| p[power]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_are_the_basis_functions() {
        let knots = vec![0., 0., 0., 0., 0.3, 0.3, 0.7, 1.1, 1.1, 1.1, 1.1];
        let knots = Knots::new(3, 7, knots).expect("valid");
        let pieces = Pieces::new(&knots);
        for i in 0..=110 {
            let t = f64::from(i) * 0.01;
            let span = knots.span(t);
            let (start, jet) = pieces.second::<4>(t);
            assert_eq!(start, span - 3, "{t}");
            let expected = knots.derivatives(span, t);
            let (_, first) = pieces.first::<4>(t);
            for order in 0..3 {
                for j in 0..4 {
                    // Second derivatives reach 1e2: a few roundings of that.
                    assert!((jet[order][j] - expected[order][j]).abs() < 1e-12);
                    assert!(order == 2 || first[order][j] == jet[order][j]);
                }
            }
        }
    }
}
