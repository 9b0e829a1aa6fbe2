//! Real roots of polynomials on an interval, all of them, by the variation diminishing property of Bernstein coefficients.

use std::sync::LazyLock;

use smallvec::SmallVec;

/// Roots in ascending order, as fractions of the interval.
pub(crate) type Roots = SmallVec<[f64; 6]>;

/// Halvings after which two roots count as one: they are then closer than 1e-12 of the interval.
const DEEPEST: u32 = 40;

/// Bernstein coefficients of the polynomial of degree `N - 1` that has these values at `N` equally spaced places.
pub(crate) fn bernstein_from_values<const N: usize>(values: &[f64; N]) -> [f64; N] {
    let inverse: &[[f64; 7]; 7] = match N {
        5 => &QUARTIC,
        7 => &SEXTIC,
        _ => unreachable!("only degrees 4 and 6 are used"),
    };
    std::array::from_fn(|i| (0..N).map(|j| inverse[i][j] * values[j]).sum())
}

static QUARTIC: LazyLock<[[f64; 7]; 7]> = LazyLock::new(|| collocation_inverse(5));
static SEXTIC: LazyLock<[[f64; 7]; 7]> = LazyLock::new(|| collocation_inverse(7));

/// Inverse of the matrix of Bernstein polynomials at `n` equally spaced places, by Gauss-Jordan elimination.
fn collocation_inverse(n: usize) -> [[f64; 7]; 7] {
    let binomial = |k: usize| (0..k).fold(1.0, |b, i| b * (n - 1 - i) as f64 / (i + 1) as f64);
    let mut left = [[0.0; 7]; 7];
    let mut right = [[0.0; 7]; 7];
    for i in 0..n {
        let t = i as f64 / (n - 1) as f64;
        right[i][i] = 1.0;
        for (j, entry) in left[i].iter_mut().enumerate().take(n) {
            *entry = binomial(j) * t.powi(j as i32) * (1.0 - t).powi((n - 1 - j) as i32);
        }
    }
    for column in 0..n {
        let pivot = (column..n)
            .max_by(|&a, &b| left[a][column].abs().total_cmp(&left[b][column].abs()))
            .unwrap_or(column);
        left.swap(column, pivot);
        right.swap(column, pivot);
        let scale = 1.0 / left[column][column];
        for k in 0..n {
            left[column][k] *= scale;
            right[column][k] *= scale;
        }
        for row in (0..n).filter(|&row| row != column) {
            let factor = left[row][column];
            for k in 0..n {
                left[row][k] -= factor * left[column][k];
                right[row][k] -= factor * right[column][k];
            }
        }
    }
    right
}

/// Every place in 0..1 where the polynomial changes its sign, ascending.
pub(crate) fn sign_changes<const N: usize>(coefficients: [f64; N]) -> Roots {
    let mut roots = Roots::new();
    // coefficients, from, to, depth
    type Piece<const N: usize> = ([f64; N], f64, f64, u32);
    let mut stack: SmallVec<[Piece<N>; 16]> = SmallVec::new();
    stack.push((coefficients, 0.0, 1.0, 0));
    while let Some((c, from, to, depth)) = stack.pop() {
        match variations(&c) {
            0 => {}
            1 => roots.push(from + (to - from) * only_root(&c)),
            _ if depth == DEEPEST => {
                if (c[0] < 0.0) != (c[N - 1] < 0.0) {
                    roots.push(0.5 * (from + to));
                }
            }
            _ => {
                let (first, second) = halves(&c);
                let middle = 0.5 * (from + to);
                stack.push((second, middle, to, depth + 1));
                stack.push((first, from, middle, depth + 1));
            }
        }
    }
    roots
}

fn variations<const N: usize>(c: &[f64; N]) -> usize {
    (1..N).filter(|&i| (c[i - 1] < 0.0) != (c[i] < 0.0)).count()
}

/// De Casteljau's subdivision in the middle.
fn halves<const N: usize>(c: &[f64; N]) -> ([f64; N], [f64; N]) {
    let mut work = *c;
    let mut first = [0.0; N];
    let mut second = [0.0; N];
    for level in 0..N {
        first[level] = work[0];
        second[N - 1 - level] = work[N - 1 - level];
        for i in 0..N - 1 - level {
            work[i] = 0.5 * (work[i] + work[i + 1]);
        }
    }
    (first, second)
}

/// Value and derivative by de Casteljau.
fn evaluate<const N: usize>(c: &[f64; N], t: f64) -> (f64, f64) {
    let mut work = *c;
    for level in 1..N - 1 {
        for i in 0..N - level {
            work[i] += t * (work[i + 1] - work[i]);
        }
    }
    let slope = work[1] - work[0];
    (work[0] + t * slope, slope * (N - 1) as f64)
}

/// The one sign change, by Newton's method kept inside a shrinking bracket.
fn only_root<const N: usize>(c: &[f64; N]) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    let rising = c[0] < 0.0;
    let mut t = 0.5;
    for _ in 0..60 {
        let (value, slope) = evaluate(c, t);
        if (value < 0.0) == rising {
            low = t;
        } else {
            high = t;
        }
        let newton = t - value / slope;
        let next = if newton > low && newton < high {
            newton
        } else {
            0.5 * (low + high)
        };
        if (next - t).abs() < 1e-15 || high - low < 1e-15 {
            return next;
        }
        t = next;
    }
    t
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from_roots<const N: usize>(roots: &[f64]) -> [f64; N] {
        bernstein_from_values(&std::array::from_fn(|i| {
            let t = i as f64 / (N - 1) as f64;
            roots.iter().map(|r| t - r).product()
        }))
    }

    #[test]
    fn six_known_roots_are_found() {
        let known = [0.05, 0.2, 0.21, 0.5, 0.77, 0.999];
        let found = sign_changes(from_roots::<7>(&known));
        assert_eq!(found.len(), 6);
        for (f, k) in found.iter().zip(known) {
            // 1e-17 of rounding in the coefficients over a derivative of 1e-4 or more at the close pair
            assert!((f - k).abs() < 1e-11, "{f} instead of {k}");
        }
    }

    #[test]
    fn touching_without_crossing_is_no_root() {
        assert!(sign_changes(from_roots::<5>(&[0.3, 0.3, 2.0, -1.0])).len() % 2 == 0);
        assert!(sign_changes(from_roots::<5>(&[-0.3, 1.3, 2.0, -1.0])).is_empty());
    }
}
