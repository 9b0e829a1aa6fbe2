//! First and second moments of a handful of points, and the plane through them.

use glam::DVec3;

/// Sums over n points; the plane of least squares comes out of them.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Moments {
    n: f64,
    sum: DVec3,
    /// xx, yy, zz.
    square: DVec3,
    /// yz, zx, xy.
    mixed: DVec3,
}

/// A plane of least orthogonal squares with the spread of its points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlaneFit {
    /// Mean of the points.
    pub centre: DVec3,
    /// Unit normal; its sign is arbitrary.
    pub normal: DVec3,
    /// Unit direction of the largest spread.
    pub major: DVec3,
    /// Variances along major, minor and normal direction, descending.
    pub variances: [f64; 3],
}

impl Moments {
    /// Takes in a point. Points should lie near the origin: sums of squares lose what the distance to it takes.
    pub fn add(&mut self, p: DVec3) {
        self.n += 1.0;
        self.sum += p;
        self.square += p * p;
        self.mixed += DVec3::new(p.y * p.z, p.z * p.x, p.x * p.y);
    }

    /// Takes in all points of `other`.
    pub fn join(&mut self, other: &Self) {
        self.n += other.n;
        self.sum += other.sum;
        self.square += other.square;
        self.mixed += other.mixed;
    }

    /// Number of points.
    pub fn count(&self) -> f64 {
        self.n
    }

    /// The plane; for fewer than three points its normal is one of many.
    pub fn plane(&self) -> PlaneFit {
        let n = self.n.max(1.0);
        let centre = self.sum / n;
        let s = self.square / n - centre * centre;
        let m = self.mixed / n
            - DVec3::new(
                centre.y * centre.z,
                centre.z * centre.x,
                centre.x * centre.y,
            );
        let (values, vectors) = eigen([[s.x, m.z, m.y], [m.z, s.y, m.x], [m.y, m.x, s.z]]);
        PlaneFit {
            centre,
            normal: vectors[2],
            major: vectors[0],
            variances: values.map(|v| v.max(0.0)),
        }
    }
}

/// Eigenvalues, descending, and unit eigenvectors of a symmetric matrix, by cyclic Jacobi rotations.
pub(crate) fn eigen(mut a: [[f64; 3]; 3]) -> ([f64; 3], [DVec3; 3]) {
    let mut v = [DVec3::X, DVec3::Y, DVec3::Z];
    for _ in 0..12 {
        let off = a[0][1].abs() + a[0][2].abs() + a[1][2].abs();
        if off <= 1e-15 * (a[0][0].abs() + a[1][1].abs() + a[2][2].abs()) {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            rotate(&mut a, &mut v, p, q);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[j][j].total_cmp(&a[i][i]));
    (order.map(|i| a[i][i]), order.map(|i| v[i]))
}

/// One Jacobi rotation: makes `a[p][q]` zero.
fn rotate(a: &mut [[f64; 3]; 3], v: &mut [DVec3; 3], p: usize, q: usize) {
    if a[p][q] == 0.0 {
        return;
    }
    let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    let r = 3 - p - q;
    let (arp, arq) = (a[r][p], a[r][q]);
    a[p][p] -= t * a[p][q];
    a[q][q] += t * a[p][q];
    a[p][q] = 0.0;
    a[q][p] = 0.0;
    a[r][p] = c * arp - s * arq;
    a[p][r] = a[r][p];
    a[r][q] = s * arp + c * arq;
    a[q][r] = a[r][q];
    let (vp, vq) = (v[p], v[q]);
    v[p] = c * vp - s * vq;
    v[q] = s * vp + c * vq;
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn eigenvectors_are_stretched_by_their_eigenvalues(e in proptest::array::uniform6(-5.0f64..5.0)) {
            let a = [[e[0], e[1], e[2]], [e[1], e[3], e[4]], [e[2], e[4], e[5]]];
            let (values, vectors) = eigen(a);
            for (value, x) in values.iter().zip(vectors) {
                let row = |r: [f64; 3]| DVec3::from_array(r).dot(x);
                let ax = DVec3::new(row(a[0]), row(a[1]), row(a[2]));
                prop_assert!((ax - *value * x).length() < 1e-12, "Jacobi ends at rounding");
                prop_assert!((x.length() - 1.0).abs() < 1e-12);
            }
            prop_assert!(values[0] >= values[1] && values[1] >= values[2]);
        }
    }
}
