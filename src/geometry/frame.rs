//! Right-handed orthonormal placements: origin and three axes.

use glam::{DVec2, DVec3};

use super::RigidTransform;

/// Origin (mm) and right-handed orthonormal axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// In mm.
    pub origin: DVec3,
    /// First axis, unit.
    pub x: DVec3,
    /// Second axis, unit.
    pub y: DVec3,
    /// Third axis, unit: `x` cross `y`.
    pub z: DVec3,
}

impl Frame {
    /// The axes of the world.
    pub const WORLD: Self = Self {
        origin: DVec3::ZERO,
        x: DVec3::X,
        y: DVec3::Y,
        z: DVec3::Z,
    };

    /// The frame with third axis along `z` and first axis as near to `x` as that allows; any where `x` says nothing.
    ///
    /// `None` where `z` has no direction.
    pub fn new(origin: DVec3, z: DVec3, x: DVec3) -> Option<Self> {
        let z = z.try_normalize()?;
        let across = x - z * x.dot(z);
        let x = if across.length() > 1e-9 * x.length() {
            across.try_normalize()
        } else {
            None
        }
        .unwrap_or_else(|| z.any_orthonormal_vector());
        Some(Self {
            origin,
            x,
            y: z.cross(x),
            z,
        })
    }

    /// World position of local coordinates.
    #[inline]
    pub fn point(&self, local: DVec3) -> DVec3 {
        self.origin + self.vector(local)
    }

    /// World direction of a local direction.
    #[inline]
    pub fn vector(&self, local: DVec3) -> DVec3 {
        self.x * local.x + self.y * local.y + self.z * local.z
    }

    /// Local coordinates of a world position.
    #[inline]
    pub fn local(&self, p: DVec3) -> DVec3 {
        let d = p - self.origin;
        DVec3::new(d.dot(self.x), d.dot(self.y), d.dot(self.z))
    }

    /// The direction in the plane of `x` and `y` at `angle_rad` from `x`, and its derivative.
    #[inline]
    pub fn around(&self, angle_rad: f64) -> (DVec3, DVec3) {
        let (s, c) = angle_rad.sin_cos();
        (self.x * c + self.y * s, self.y * c - self.x * s)
    }

    /// The angle around `z` of local coordinates, 0 to 2 pi; 0 on the axis.
    #[inline]
    pub fn angle_of(local: DVec2) -> f64 {
        let angle = local.y.atan2(local.x);
        if angle < 0.0 {
            angle + std::f64::consts::TAU
        } else {
            angle
        }
    }

    /// The frame moved.
    pub fn transformed(&self, by: &RigidTransform) -> Self {
        Self {
            origin: by.point(self.origin),
            x: by.vector(self.x),
            y: by.vector(self.y),
            z: by.vector(self.z),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_and_world_are_inverse_and_axes_right_handed() {
        let f = Frame::new(
            DVec3::new(1.0, -2.0, 3.0),
            DVec3::new(1.0, 1.0, 1.0),
            DVec3::X,
        )
        .expect("has a direction");
        let p = DVec3::new(-4.0, 5.0, 0.25);
        // Coordinates of size 10 round at 1e-15 each.
        assert!((f.point(f.local(p)) - p).length() < 1e-13);
        assert!((f.x.cross(f.y) - f.z).length() < 1e-15);
        assert!(Frame::new(DVec3::ZERO, DVec3::ZERO, DVec3::X).is_none());
        let any = Frame::new(DVec3::ZERO, DVec3::Z, DVec3::Z).expect("x is chosen");
        assert!(any.x.dot(DVec3::Z).abs() < 1e-15);
    }
}
