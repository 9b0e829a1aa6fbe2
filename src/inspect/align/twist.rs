//! Small motions: a rotation vector about the part origin and a translation, and their names.

use glam::{DQuat, DVec3};

use crate::geometry::RigidTransform;

/// A motion by a rotation vector (rad, about the part origin) and a velocity (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Twist {
    /// Rotation vector, rad.
    pub turn: DVec3,
    /// Translation part, mm.
    pub shift: DVec3,
}

impl Twist {
    pub(super) fn from_array(v: [f64; 6]) -> Self {
        Self {
            turn: DVec3::new(v[0], v[1], v[2]),
            shift: DVec3::new(v[3], v[4], v[5]),
        }
    }

    pub(super) fn to_array(self) -> [f64; 6] {
        let (a, b) = (self.turn.to_array(), self.shift.to_array());
        [a[0], a[1], a[2], b[0], b[1], b[2]]
    }

    /// From unknowns that count turns by what they move at `size_mm`.
    pub(super) fn from_scaled(v: &nalgebra::Vector6<f64>, size_mm: f64) -> Self {
        Self::from_array(std::array::from_fn(|k| {
            if k < 3 { v[k] / size_mm } else { v[k] }
        }))
    }

    pub(super) fn scaled(&self, size_mm: f64) -> [f64; 6] {
        let v = self.to_array();
        std::array::from_fn(|k| if k < 3 { v[k] * size_mm } else { v[k] })
    }

    /// The motion that turns by `turn` and shifts by `shift`.
    pub fn transform(&self) -> RigidTransform {
        RigidTransform::new(DQuat::from_scaled_axis(self.turn), self.shift)
    }

    /// The screw motion whose exponential is `motion`.
    pub(in crate::inspect) fn logarithm(motion: &RigidTransform) -> Self {
        let q = motion.rotation;
        let q = if q.w < 0.0 { -q } else { q };
        let turn = q.to_scaled_axis();
        let angle = turn.length();
        let t = motion.translation;
        // V^-1 t, with V the integral of the rotation.
        let shift = if angle < 1e-6 {
            t - 0.5 * turn.cross(t)
        } else {
            let half = 0.5 * angle;
            let k = (1.0 - half / half.tan()) / (angle * angle);
            t - 0.5 * turn.cross(t) + k * turn.cross(turn.cross(t))
        };
        Self { turn, shift }
    }

    /// What it moves at most at the rim of a part of half-diagonal `size_mm`, roughly, mm.
    pub(in crate::inspect) fn size(&self, size_mm: f64) -> f64 {
        self.turn.length() * size_mm + self.shift.length()
    }

    /// Change of the observation with this row.
    pub(super) fn along(&self, row: &[f64; 6]) -> f64 {
        self.to_array().iter().zip(row).map(|(a, b)| a * b).sum()
    }
}

/// Names of the motions that span the same space as `twists`, the translations among them first.
pub(super) fn words(twists: &[Twist], size_mm: f64) -> Vec<String> {
    let mut rest: Vec<Twist> = twists.to_vec();
    let mut names = Vec::new();
    // Combinations without rotation are translations: eliminate the rotations one by one.
    let mut turning: Vec<Twist> = Vec::new();
    while let Some((k, _)) = rest
        .iter()
        .enumerate()
        .max_by(|a, b| a.1.turn.length().total_cmp(&b.1.turn.length()))
        .filter(|(_, t)| t.turn.length() * size_mm > 0.02)
    {
        let pivot = rest.swap_remove(k);
        let direction = pivot.turn.normalize();
        for other in &mut rest {
            let share = other.turn.dot(direction) / pivot.turn.length();
            other.turn -= share * pivot.turn;
            other.shift -= share * pivot.shift;
        }
        turning.push(pivot);
    }
    for t in &rest {
        names.push(format!("along {}", axis_name(t.shift)));
    }
    for t in &turning {
        names.push(format!("rotation about {}", axis_name(t.turn)));
    }
    names
}

/// `x`, `y`, `z` within two degrees of an axis, otherwise the direction.
pub(super) fn axis_name(direction: DVec3) -> String {
    let unit = direction.normalize_or_zero();
    for (axis, name) in [(DVec3::X, "x"), (DVec3::Y, "y"), (DVec3::Z, "z")] {
        if unit.dot(axis).abs() > 0.9994 {
            return name.to_string();
        }
    }
    format!("({:.2}, {:.2}, {:.2})", unit.x, unit.y, unit.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_screw_motion_is_found_again_from_its_transform() {
        let axis = DVec3::new(0.2, -0.5, 0.8).normalize();
        let place = DVec3::new(3.0, 1.0, -2.0);
        let turn = 1.1 * axis;
        // A turn about an axis through `place` and a shift along it.
        let rotation = DQuat::from_scaled_axis(turn);
        let motion = RigidTransform::new(rotation, place - rotation * place + 0.7 * axis);
        let twist = Twist::logarithm(&motion);
        assert!((twist.turn - turn).length() < 1e-12, "rounding");
        let expected = place.cross(turn) + 0.7 * axis;
        assert!((twist.shift - expected).length() < 1e-12, "rounding");
    }

    #[test]
    fn weak_directions_are_named() {
        let about_z = Twist {
            turn: DVec3::Z / 10.0,
            shift: DVec3::new(0.3, 0.0, 0.0),
        };
        let along_x = Twist {
            turn: DVec3::ZERO,
            shift: DVec3::X,
        };
        let names = words(&[about_z, along_x], 10.0);
        assert_eq!(names, ["along x", "rotation about z"]);
    }
}
