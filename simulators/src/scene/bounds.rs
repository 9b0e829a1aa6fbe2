//! Boxes along the axes.

use glam::DVec3;

use super::span::{Ray, Window};
use crate::pose::Pose;

/// A box along the axes of its frame; unbounded sides are infinite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Least coordinates, mm.
    pub low: DVec3,
    /// Greatest coordinates, mm.
    pub high: DVec3,
}

impl Bounds {
    pub(super) const EMPTY: Bounds = Bounds {
        low: DVec3::INFINITY,
        high: DVec3::NEG_INFINITY,
    };
    pub(super) const ALL: Bounds = Bounds {
        low: DVec3::NEG_INFINITY,
        high: DVec3::INFINITY,
    };

    /// The box between two corners, mm.
    pub fn new(low: DVec3, high: DVec3) -> Bounds {
        Bounds { low, high }
    }

    /// Whether the point lies in the box or on its sides.
    pub fn contains(&self, p: DVec3) -> bool {
        self.low.cmple(p).all() && p.cmple(self.high).all()
    }

    pub(super) fn include(&mut self, p: DVec3) {
        self.low = self.low.min(p);
        self.high = self.high.max(p);
    }

    pub(super) fn pad(&mut self, by: f64) {
        self.low -= DVec3::splat(by);
        self.high += DVec3::splat(by);
    }

    pub(super) fn common(&self, other: &Bounds) -> Bounds {
        Bounds {
            low: self.low.max(other.low),
            high: self.high.min(other.high),
        }
    }

    pub(super) fn joined(&self, other: &Bounds) -> Bounds {
        Bounds {
            low: self.low.min(other.low),
            high: self.high.max(other.high),
        }
    }

    /// A box around the placed box; unbounded when it is.
    pub(super) fn placed(&self, pose: &Pose) -> Bounds {
        if !(self.low.is_finite() && self.high.is_finite()) {
            return Bounds::ALL;
        }
        let mut bounds = Bounds::EMPTY;
        for corner in 0..8 {
            let pick = |axis: usize| {
                if corner >> axis & 1 == 0 {
                    self.low[axis]
                } else {
                    self.high[axis]
                }
            };
            bounds.include(pose.point(DVec3::new(pick(0), pick(1), pick(2))));
        }
        bounds
    }

    /// The part of the window in which the ray is in the box.
    pub(super) fn clip(&self, ray: &Ray, window: Window) -> Option<Window> {
        // where a component is zero this is infinite, or NaN on the very side of the box: boxes are wider than what they hold
        let a = (self.low - ray.origin) * ray.inverse;
        let b = (self.high - ray.origin) * ray.inverse;
        let from = window.from.max(a.min(b).max_element());
        let to = window.to.min(a.max(b).min_element());
        (from < to).then_some(Window { from, to })
    }
}
