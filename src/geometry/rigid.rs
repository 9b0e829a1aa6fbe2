//! Rigid transforms, named to-from: `part_from_machine * machine_from_sensor`.

use std::ops::Mul;

use glam::{DMat3, DMat4, DQuat, DVec3};

/// A rotation followed by a translation (mm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidTransform {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// In mm.
    pub translation: DVec3,
}

impl RigidTransform {
    /// Leaves everything where it is.
    pub const IDENTITY: Self = Self {
        rotation: DQuat::IDENTITY,
        translation: DVec3::ZERO,
    };

    /// A rotation by `rotation` followed by a shift by `translation`.
    pub fn new(rotation: DQuat, translation: DVec3) -> Self {
        Self {
            rotation: rotation.normalize(),
            translation,
        }
    }

    /// From a proper rotation matrix and a shift.
    pub fn from_matrix(rotation: DMat3, translation: DVec3) -> Self {
        Self::new(DQuat::from_mat3(&rotation), translation)
    }

    /// The position of `p` in the other frame.
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }

    /// The direction `v` in the other frame.
    pub fn vector(&self, v: DVec3) -> DVec3 {
        self.rotation * v
    }

    /// The transform back.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self {
            rotation,
            translation: -(rotation * self.translation),
        }
    }

    /// The homogeneous matrix.
    pub fn matrix(&self) -> DMat4 {
        DMat4::from_rotation_translation(self.rotation, self.translation)
    }
}

impl Mul for RigidTransform {
    type Output = Self;

    /// Applies `other` first.
    fn mul(self, other: Self) -> Self {
        Self::new(
            self.rotation * other.rotation,
            self.rotation * other.translation + self.translation,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transform_and_its_inverse_cancel() {
        let t = RigidTransform::new(
            DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7),
            DVec3::new(4.0, -5.0, 6.0),
        );
        let p = DVec3::new(7.0, 8.0, -9.0);
        assert!(
            ((t.inverse() * t).point(p) - p).length() < 1e-13,
            "two rotations of a 14 mm vector round at 1e-15"
        );
    }
}
