//! Cones: the one smooth surface that neither a plane nor a quadric describes near its tip (Weber 2011, §3.8, leaves them out).

use glam::DVec3;

use super::patch::{Plane, solve};
use crate::points::moments::Moments;

/// A circular cone.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cone {
    /// Its tip.
    pub tip: DVec3,
    /// Unit vector from the tip into the cone.
    axis: DVec3,
    /// Angle between axis and surface, rad.
    half_angle: f64,
}

/// Parameters of a cone.
const PARAMETERS: usize = 6;
/// Half angle, rad, of the bluntest cone that is looked for: beyond 75 degrees its tip turns by less than 30, and a quadric describes it.
const BLUNTEST: f64 = 1.31;
/// Fewest tangent planes from which a cone is guessed.
const FEWEST: usize = 5;

impl Cone {
    /// Signed distance from the cone's surface, plus outside; of the half space ahead of the tip.
    fn distance(&self, p: DVec3) -> f64 {
        let d = p - self.tip;
        let ahead = d.dot(self.axis);
        let aside = (d - self.axis * ahead).length();
        aside * self.half_angle.cos() - ahead * self.half_angle.sin()
    }

    /// The cone through `points` by least squares, begun at the one that `planes` touch, with Bayes' criterion at noise of `variance`.
    pub fn through(points: &[DVec3], planes: &[Plane], variance: f64) -> Option<(Self, f64)> {
        let mut cone = Self::touching(points, planes)?;
        for _ in 0..6 {
            cone = cone.better(points)?;
        }
        let cap = 9.0 * variance;
        let squares: f64 = points
            .iter()
            .map(|p| cone.distance(*p).powi(2).min(cap))
            .sum();
        let count = points.len().max(2) as f64;
        Some((cone, squares / variance + PARAMETERS as f64 * count.ln()))
    }

    /// All tangent planes of a cone pass through its tip, and their normals lean by the same angle against its axis.
    fn touching(points: &[DVec3], planes: &[Plane]) -> Option<Self> {
        if planes.len() < FEWEST || points.is_empty() {
            return None;
        }
        let middle = points.iter().sum::<DVec3>() / points.len() as f64;
        let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
        let mut normals = Moments::default();
        let mut sum = DVec3::ZERO;
        for plane in planes {
            let n = plane.normal.to_array();
            for i in 0..3 {
                b[i] += n[i] * plane.offset;
                for j in i..3 {
                    a[i][j] += n[i] * n[j];
                }
            }
            // Away from the middle of the points, which lies on the hollow side.
            let outward = plane.normal * -plane.distance(middle).signum();
            normals.add(outward);
            sum += outward;
        }
        let tip = DVec3::from_array(solve(a, b)?);
        let direction = normals.plane().normal;
        let axis = direction * -direction.dot(sum).signum();
        let sine = -axis.dot(sum) / planes.len() as f64;
        let half_angle = sine.clamp(-1.0, 1.0).asin();
        (half_angle > 0.0 && half_angle < BLUNTEST).then_some(Self {
            tip,
            axis,
            half_angle,
        })
    }

    /// One step of Gauss and Newton.
    fn better(&self, points: &[DVec3]) -> Option<Self> {
        let (sin, cos) = self.half_angle.sin_cos();
        let u = self.axis.any_orthonormal_vector();
        let v = self.axis.cross(u);
        let (mut a, mut b) = ([[0.0; PARAMETERS]; PARAMETERS], [0.0; PARAMETERS]);
        for p in points {
            let d = *p - self.tip;
            let ahead = d.dot(self.axis);
            let flat = d - self.axis * ahead;
            let aside = flat.length().max(1e-6);
            let normal = flat / aside * cos - self.axis * sin;
            let tilt = -(ahead / aside * cos + sin);
            let row = [
                -normal.x,
                -normal.y,
                -normal.z,
                tilt * d.dot(u),
                tilt * d.dot(v),
                -aside * sin - ahead * cos,
            ];
            let rest = aside * cos - ahead * sin;
            for i in 0..PARAMETERS {
                b[i] -= row[i] * rest;
                for j in i..PARAMETERS {
                    a[i][j] += row[i] * row[j];
                }
            }
        }
        let [x, y, z, du, dv, angle] = solve(a, b)?;
        let cone = Self {
            tip: self.tip + DVec3::new(x, y, z),
            axis: (self.axis + u * du + v * dv).try_normalize()?,
            half_angle: self.half_angle + angle,
        };
        (cone.half_angle > 0.0 && cone.half_angle < BLUNTEST).then_some(cone)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on a cone of half angle 0.6 with its tip at (0.3, -0.2, 2), axis down and leaning, and its tangent planes there.
    fn exact() -> (Cone, Vec<DVec3>, Vec<Plane>) {
        let cone = Cone {
            tip: DVec3::new(0.3, -0.2, 2.0),
            axis: DVec3::new(0.2, 0.1, -1.0).normalize(),
            half_angle: 0.6,
        };
        let u = cone.axis.any_orthonormal_vector();
        let v = cone.axis.cross(u);
        let (mut points, mut planes) = (Vec::new(), Vec::new());
        for i in 0..60 {
            let (turn, along) = (0.7 * f64::from(i), 0.4 + 0.05 * f64::from(i));
            let out = u * turn.cos() + v * turn.sin();
            let p = cone.tip + (cone.axis * 0.6f64.cos() + out * 0.6f64.sin()) * along;
            let normal = out * 0.6f64.cos() - cone.axis * 0.6f64.sin();
            points.push(p);
            if i % 7 == 0 {
                planes.push(Plane {
                    normal,
                    offset: normal.dot(p),
                });
            }
        }
        (cone, points, planes)
    }

    #[test]
    fn an_exact_cone_is_found_from_disturbed_tangent_planes() {
        let (truth, points, mut planes) = exact();
        for (i, plane) in planes.iter_mut().enumerate() {
            plane.offset += 0.05 * if i % 2 == 0 { 1.0 } else { -1.0 };
        }
        let (cone, _) = Cone::through(&points, &planes, 1e-4).unwrap();
        assert!(
            cone.tip.distance(truth.tip) < 1e-6,
            "the squares of exact points vanish at the truth only: {cone:?}"
        );
        assert!(
            (cone.half_angle - truth.half_angle).abs() < 1e-6,
            "{cone:?}"
        );
    }

    #[test]
    fn two_planes_are_no_cone() {
        let planes: Vec<Plane> = (0..8)
            .map(|i| Plane {
                normal: if i % 2 == 0 { DVec3::X } else { DVec3::Z },
                offset: 0.0,
            })
            .collect();
        assert!(Cone::through(&[DVec3::ONE; 9], &planes, 1e-4).is_none());
    }
}
