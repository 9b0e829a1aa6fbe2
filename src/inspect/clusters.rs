//! Variance components: how much of the residuals of a fit is shared within groups of observations.

use std::collections::BTreeMap;

use crate::geometry::fit::LinearFit;

/// The group of an observation that belongs to none.
pub(crate) const NO_GROUP: u32 = u32::MAX;

/// Standard deviations above its expectation at which a component is believed.
pub(crate) const SIGNIFICANT: f64 = 3.0;

/// Moments of the residuals of one fit, grouped.
#[derive(Debug, Clone)]
pub(crate) struct Clusters<const P: usize> {
    /// The groups with the influence of each on the offset: what a common shift of its points moves.
    pub(crate) influence: Vec<(u32, f64)>,
    /// Sum over the groups of (sum of residuals)^2 / n.
    between: f64,
    /// Sum of squared residuals.
    total: f64,
    /// Expectation of `between` for white noise of unit variance, and for a group component of unit variance.
    between_of: [f64; 2],
    /// The same of `total`.
    total_of: [f64; 2],
    /// Sum over the groups of s s', s the sum of the group's rows.
    pub(crate) scatter: [[f64; P]; P],
}

impl<const P: usize> Clusters<P> {
    /// Groups `samples` (group, row, residual) of `fit`.
    pub(crate) fn new(
        samples: impl Iterator<Item = (u32, [f64; P], f64)>,
        fit: &LinearFit<P>,
    ) -> Self {
        let mut groups: BTreeMap<u32, (f64, [f64; P], f64)> = BTreeMap::new();
        let (mut total, mut n) = (0.0, 0.0);
        for (group, row, residual) in samples {
            let entry = groups.entry(group).or_insert((0.0, [0.0; P], 0.0));
            entry.0 += 1.0;
            for (sum, x) in entry.1.iter_mut().zip(row) {
                *sum += x;
            }
            entry.2 += residual;
            total += residual * residual;
            n += 1.0;
        }
        groups.remove(&NO_GROUP);
        let mut unit = [0.0; P];
        unit[0] = 1.0;
        let influence = groups
            .iter()
            .map(|(id, (_, sum, _))| (*id, product(&unit, &fit.cofactor, sum)))
            .collect();
        let groups: Vec<(f64, [f64; P], f64)> = groups.into_values().collect();
        Self {
            influence,
            ..Self::from_sums(&groups, (n, total), fit)
        }
    }

    fn from_sums(groups: &[(f64, [f64; P], f64)], all: (f64, f64), fit: &LinearFit<P>) -> Self {
        let (n, total) = all;
        let mut clusters = Self {
            influence: Vec::new(),
            between: 0.0,
            total,
            between_of: [0.0; 2],
            total_of: [n - P as f64, 0.0],
            scatter: [[0.0; P]; P],
        };
        for (count, sum, residual) in groups {
            clusters.between += residual * residual / count;
            clusters.between_of[0] += 1.0 - fit.leverage(sum) / count;
            clusters.total_of[1] += count - fit.leverage(sum);
            for i in 0..P {
                for j in 0..P {
                    clusters.scatter[i][j] += sum[i] * sum[j];
                }
            }
        }
        for (g, (count_g, sum_g, _)) in groups.iter().enumerate() {
            for (h, (count_h, sum_h, _)) in groups.iter().enumerate() {
                let own = if g == h { *count_g } else { 0.0 };
                let shared = own - product(sum_h, &fit.cofactor, sum_g);
                clusters.between_of[1] += shared * shared / count_h;
            }
        }
        clusters
    }

    /// Takes in the residuals of another fit.
    pub(crate) fn merge(&mut self, other: &Self) {
        self.between += other.between;
        self.total += other.total;
        for k in 0..2 {
            self.between_of[k] += other.between_of[k];
            self.total_of[k] += other.total_of[k];
        }
    }

    /// (white variance, group variance) where the group component is significant.
    pub(crate) fn components(&self) -> Option<(f64, f64)> {
        let [b0, b1] = self.between_of;
        let [t0, t1] = self.total_of;
        let determinant = b1 * t0 - b0 * t1;
        if b0 < 1.0 || determinant <= 1e-9 * b1 * t0 {
            return None;
        }
        let white = (self.total * b1 - self.between * t1) / determinant;
        let group = (self.between * t0 - self.total * b0) / determinant;
        if white <= 0.0 || group <= 0.0 {
            return None;
        }
        let excess = self.between / white - b0;
        (excess > SIGNIFICANT * (2.0 * b0).sqrt()).then_some((white, group))
    }
}

/// a' M b.
pub(crate) fn product<const P: usize>(a: &[f64; P], matrix: &[[f64; P]; P], b: &[f64; P]) -> f64 {
    (0..P)
        .map(|i| a[i] * (0..P).map(|j| matrix[i][j] * b[j]).sum::<f64>())
        .sum()
}
