//! What the values of all stations share: the pose, the calibration, the temperature. Each as the change that it makes in d.
//!
//! Source: features-and-standards, section 5, characteristic 21; JCGM 100, 5.2 (correlated inputs).

use glam::DVec3;

/// The expansion of the part between the temperature of the scan and the 20 degrees of its drawing (ISO 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expansion {
    /// Coefficient of linear expansion, 1/K.
    pub coefficient_per_k: f64,
    /// Its standard uncertainty, 1/K.
    pub u_coefficient_per_k: f64,
    /// Temperature of the part during the scan, degrees Celsius.
    pub temperature_c: f64,
    /// Its standard uncertainty, K.
    pub u_temperature_k: f64,
}

/// Temperature to which sizes refer (ISO 1), degrees Celsius.
const REFERENCE_C: f64 = 20.0;

impl Expansion {
    /// Relative growth of the part.
    pub fn strain(&self) -> f64 {
        self.coefficient_per_k * (self.temperature_c - REFERENCE_C)
    }

    /// Standard uncertainty of the growth.
    pub fn u_strain(&self) -> f64 {
        let by_coefficient = (self.temperature_c - REFERENCE_C) * self.u_coefficient_per_k;
        by_coefficient.hypot(self.coefficient_per_k * self.u_temperature_k)
    }
}

/// The shared contributions, ready to be asked for any place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shared {
    pub(super) pose_covariance: [[f64; 6]; 6],
    pub(super) u_calibration_mm: f64,
    pub(super) expansion: Option<Expansion>,
    /// The place that the part grows about: where the alignment holds it.
    pub(super) centre: DVec3,
}

/// How one value answers to the shared inputs: d along a normal at a place, or a mean of such.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Response {
    /// To (rotation vector about the origin, translation).
    pose: [f64; 6],
    /// To the strain of the part, mm.
    strain_mm: f64,
}

impl Response {
    /// Adds another, for a mean.
    pub(super) fn add(&mut self, other: &Self) {
        for (sum, x) in self.pose.iter_mut().zip(other.pose) {
            *sum += x;
        }
        self.strain_mm += other.strain_mm;
    }

    /// Divided by `n`.
    pub(super) fn over(&self, n: f64) -> Self {
        Self {
            pose: self.pose.map(|x| x / n),
            strain_mm: self.strain_mm / n,
        }
    }
}

impl Shared {
    /// How d along `normal` at `p` answers.
    pub(super) fn response(&self, p: DVec3, normal: DVec3) -> Response {
        Response {
            pose: pose_row(p, normal),
            strain_mm: -(p - self.centre).dot(normal),
        }
    }

    /// What takes the expansion out of a place, mm.
    pub(super) fn correction(&self, p: DVec3) -> DVec3 {
        self.expansion.map_or(DVec3::ZERO, |e| {
            -e.strain() / (1.0 + e.strain()) * (p - self.centre)
        })
    }

    /// Covariances of two values by (alignment, temperature).
    pub(super) fn covariance(&self, a: &Response, b: &Response) -> [f64; 2] {
        let strain = self.expansion.map_or(0.0, |e| e.u_strain().powi(2));
        [
            quadratic(&a.pose, &self.pose_covariance, &b.pose),
            a.strain_mm * strain * b.strain_mm,
        ]
    }

    /// Standard uncertainties of a value by (alignment, temperature).
    pub(super) fn u(&self, response: &Response) -> [f64; 2] {
        self.covariance(response, response)
            .map(|v| v.max(0.0).sqrt())
    }
}

/// How d along `normal` of a place `p` changes with (rotation vector about the origin, translation) of the scan.
pub(super) fn pose_row(p: DVec3, normal: DVec3) -> [f64; 6] {
    let turn = p.cross(normal);
    [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z]
}

/// a' C b.
pub(super) fn quadratic(a: &[f64; 6], c: &[[f64; 6]; 6], b: &[f64; 6]) -> f64 {
    (0..6)
        .map(|i| a[i] * (0..6).map(|j| c[i][j] * b[j]).sum::<f64>())
        .sum()
}
