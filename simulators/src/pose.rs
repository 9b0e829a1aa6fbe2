//! Rigid poses, named to-from as `machine_from_part`.

use glam::{DMat3, DQuat, DVec3};
use rand::Rng;
use rand_distr::StandardNormal;

/// A rotation followed by a translation, in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Columns are the images of the axes of the source frame.
    pub rotation: DMat3,
    /// Image of the source frame's origin, mm.
    pub translation: DVec3,
}

impl Pose {
    /// Leaves everything where it is.
    pub const IDENTITY: Pose = Pose {
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };

    /// A shift alone, mm.
    pub fn shift(translation: DVec3) -> Pose {
        Pose {
            rotation: DMat3::IDENTITY,
            translation,
        }
    }

    /// A turn of `angle_rad` about the unit vector `axis` through the point `centre`.
    pub fn turn_about(centre: DVec3, axis: DVec3, angle_rad: f64) -> Pose {
        let rotation = DMat3::from_quat(DQuat::from_axis_angle(axis, angle_rad));
        Pose {
            rotation,
            translation: centre - rotation * centre,
        }
    }

    /// A frame at `origin` whose third axis is `axis` (any length but zero); the other two are arbitrary but fixed.
    pub fn along(origin: DVec3, axis: DVec3) -> Pose {
        let z = axis.normalize();
        let x = z.any_orthonormal_vector();
        Pose {
            rotation: DMat3::from_cols(x, z.cross(x), z),
            translation: origin,
        }
    }

    /// A deviation near [`Pose::IDENTITY`]: every component normal, with the stated standard deviations.
    pub fn normal_draw<R: Rng>(rng: &mut R, translation_mm: f64, rotation_rad: f64) -> Pose {
        let mut draw = || DVec3::from_array(std::array::from_fn(|_| rng.sample(StandardNormal)));
        let translation: DVec3 = draw() * translation_mm;
        let turn: DVec3 = draw() * rotation_rad;
        Pose {
            rotation: DMat3::from_quat(DQuat::from_scaled_axis(turn)),
            translation,
        }
    }

    /// The image of a point.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The image of a direction.
    pub fn direction(&self, direction: DVec3) -> DVec3 {
        self.rotation * direction
    }

    /// This pose after `first`: `a_from_b.after(b_from_c)` is `a_from_c`.
    pub fn after(&self, first: Pose) -> Pose {
        Pose {
            rotation: self.rotation * first.rotation,
            translation: self.rotation * first.translation + self.translation,
        }
    }

    /// The way back.
    pub fn inverse(&self) -> Pose {
        let rotation = self.rotation.transpose();
        Pose {
            rotation,
            translation: -(rotation * self.translation),
        }
    }

    /// Row-major 4x4 matrix, as configurations and reports write it.
    pub fn rows(&self) -> [[f64; 4]; 4] {
        let r = self.rotation.transpose();
        let t = self.translation;
        [
            [r.x_axis.x, r.x_axis.y, r.x_axis.z, t.x],
            [r.y_axis.x, r.y_axis.y, r.y_axis.z, t.y],
            [r.z_axis.x, r.z_axis.y, r.z_axis.z, t.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }
}
