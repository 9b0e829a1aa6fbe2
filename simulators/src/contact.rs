//! Where a moving ball first touches a scene.

use std::f64::consts::TAU;

use glam::DVec3;

use crate::scene::{Hit, Ray, Scene, SurfaceId};

/// A ball that moves straight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Centre at the start, mm.
    pub from: DVec3,
    /// Centre at the end, mm.
    pub to: DVec3,
    /// Of the ball, mm.
    pub radius: f64,
}

/// A first contact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// Travel of the centre until contact, mm; not positive when the ball touches where it starts.
    pub travel: f64,
    /// What was touched.
    pub surface: SurfaceId,
}

/// Rings of rays, and rays in a ring, of the first look.
const RINGS: u32 = 8;
const SPOKES: u32 = 24;

impl Move {
    /// The first contact on the way, or nothing.
    ///
    /// Every ray through the ball along the motion meets the scene after a travel of its own; the ball does at the least of them.
    /// A bundle finds where about, golden sections where exactly, and on a smooth surface whose distance is known the answer
    /// is then exact to rounding.
    pub fn first_contact(&self, scene: &Scene) -> Option<Contact> {
        let way = self.to - self.from;
        let length = way.length();
        if length == 0.0 {
            return None;
        }
        let direction = way / length;
        let (u, v) = direction.any_orthonormal_pair();
        let bundle = Bundle {
            ball: self,
            scene,
            direction,
            u,
            v,
            length,
        };
        let mut best = bundle.travel([0.0, 0.0]).map(|(t, hit)| (t, hit, [0.0; 2]));
        for ring in 1..=RINGS {
            // the outermost ring just inside the rim
            let rho = self.radius * (f64::from(ring) / f64::from(RINGS)).min(0.9999);
            for spoke in 0..SPOKES {
                let (sin, cos) = (TAU * f64::from(spoke) / f64::from(SPOKES)).sin_cos();
                bundle.improve(&mut best, [rho * cos, rho * sin]);
            }
        }
        bundle.refine(&mut best);
        let (travel, hit, _) = best?;
        let travel = bundle.exact(travel, &hit);
        (travel <= length).then_some(Contact {
            travel,
            surface: hit.surface,
        })
    }
}

impl Move {
    /// Whether the ball touches where it starts, before or behind it.
    pub fn touches_at_start(&self, scene: &Scene) -> bool {
        let back = Move {
            to: 2.0 * self.from - self.to,
            ..*self
        };
        [*self, back]
            .iter()
            .any(|way| way.first_contact(scene).is_some_and(|c| c.travel <= 0.0))
    }
}

type Best = Option<(f64, Hit, [f64; 2])>;

struct Bundle<'a> {
    ball: &'a Move,
    scene: &'a Scene,
    direction: DVec3,
    u: DVec3,
    v: DVec3,
    length: f64,
}

impl Bundle<'_> {
    /// Travel until the ray at this place across the motion touches; rays start at the back of the ball.
    fn travel(&self, [a, b]: [f64; 2]) -> Option<(f64, Hit)> {
        let squared = self.ball.radius * self.ball.radius - a * a - b * b;
        if squared <= 0.0 {
            return None;
        }
        let half = squared.sqrt();
        let origin = self.ball.from + self.u * a + self.v * b - self.direction * half;
        let ray = Ray::along(origin, self.direction);
        let hit = self.scene.cast(&ray)?;
        let travel = if self.scene.contains(origin) {
            -2.0 * half
        } else {
            hit.distance - 2.0 * half
        };
        (travel <= self.length + self.ball.radius).then_some((travel, hit))
    }

    fn improve(&self, best: &mut Best, at: [f64; 2]) -> bool {
        match self.travel(at) {
            Some((travel, hit)) if best.is_none_or(|(least, ..)| travel < least) => {
                *best = Some((travel, hit, at));
                true
            }
            _ => false,
        }
    }

    /// Golden sections within golden sections about the best ray: the travel is convex there when the body is.
    fn refine(&self, best: &mut Best) {
        let Some((_, _, around)) = *best else { return };
        let reach = 1.5 * self.ball.radius / f64::from(RINGS);
        let mut least = *best;
        let at = |a: f64, b: f64, least: &mut Best| match self.travel([a, b]) {
            Some((travel, _)) => {
                self.improve(least, [a, b]);
                travel
            }
            // no contact there: worse than any, and worse the farther away, so that the search comes back
            None => 1e9 + (a - around[0]).hypot(b - around[1]),
        };
        section([around[0] - reach, around[0] + reach], |a| {
            section([around[1] - reach, around[1] + reach], |b| {
                at(a, b, &mut least)
            })
        });
        *best = least;
    }

    /// Newton's method on the distance of the centre, taken when it agrees with what the bundle found.
    fn exact(&self, found: f64, hit: &Hit) -> f64 {
        let surface = self.scene.surfaces.get(hit.surface);
        let mut travel = found;
        for _ in 0..20 {
            let centre = self.ball.from + self.direction * travel;
            let gap = surface.value(centre) - self.ball.radius;
            let speed = surface.gradient(centre).dot(self.direction);
            let next = travel - gap / speed;
            if !next.is_finite() || (next - found).abs() > 1e-4 * self.ball.radius {
                return found;
            }
            if (next - travel).abs() < 1e-13 {
                return next;
            }
            travel = next;
        }
        travel
    }
}

/// Least value of a convex function, by golden section down to 1e-12 of the interval.
fn section([mut low, mut high]: [f64; 2], mut f: impl FnMut(f64) -> f64) -> f64 {
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let (mut a, mut b) = (high - golden * (high - low), low + golden * (high - low));
    let (mut fa, mut fb) = (f(a), f(b));
    for _ in 0..58 {
        if fa < fb {
            (high, b, fb) = (b, a, fa);
            a = high - golden * (high - low);
            fa = f(a);
        } else {
            (low, a, fa) = (a, b, fb);
            b = low + golden * (high - low);
            fb = f(b);
        }
    }
    fa.min(fb)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Scene, Surfaces};

    fn block() -> Scene {
        let mut s = Surfaces::default();
        let (solid, _) = s.cuboid("block", DVec3::ZERO, DVec3::new(10.0, 20.0, 5.0));
        Scene::new(s, solid)
    }

    fn travel(from: [f64; 3], to: [f64; 3]) -> Option<f64> {
        let ball = Move {
            from: from.into(),
            to: to.into(),
            radius: 1.5,
        };
        ball.first_contact(&block()).map(|c| c.travel)
    }

    #[test]
    fn a_ball_on_a_plane_stops_one_radius_above_it() {
        let straight = travel([4.0, 9.0, 12.0], [4.0, 9.0, 0.0]).unwrap();
        assert!((straight - 5.5).abs() < 1e-12, "{straight}");
        // slanted by 3:4, the centre still stops at z = 6.5
        let slanted = travel([3.0, 9.0, 10.5], [6.0, 9.0, 6.0]).unwrap();
        assert!(
            (slanted - 4.0 * 5.408_326_913_195_984 / 4.5).abs() < 1e-12,
            "{slanted}"
        );
    }

    #[test]
    fn a_ball_on_an_edge_and_a_corner_stops_one_radius_from_it() {
        // centre passes 0.9 beside the edge x = 10, z = 5: it stops 1.2 above it
        let edge = travel([10.9, 9.0, 12.0], [10.9, 9.0, 0.0]).unwrap();
        assert!((edge - (12.0 - 6.2)).abs() < 1e-7, "{edge}");
        // 0.8 beside the corner in both directions: sqrt(2.25 - 1.28) above it
        let corner = travel([10.8, 20.8, 12.0], [10.8, 20.8, 0.0]).unwrap();
        let expected = 12.0 - 5.0 - (2.25_f64 - 1.28).sqrt();
        assert!((corner - expected).abs() < 1e-6, "{corner} {expected}");
    }

    #[test]
    fn passing_by_is_no_contact_and_starting_in_contact_is_told() {
        assert_eq!(travel([11.51, 9.0, 12.0], [11.51, 9.0, 0.0]), None);
        assert_eq!(travel([4.0, 9.0, 12.0], [4.0, 9.0, 6.6]), None);
        let touches = |z: f64, to: f64| {
            let ball = Move {
                from: DVec3::new(4.0, 9.0, z),
                to: DVec3::new(4.0, 9.0, to),
                radius: 1.5,
            };
            ball.touches_at_start(&block())
        };
        assert!(touches(6.4, 0.0) && touches(6.4, 9.0));
        assert!(!touches(6.6, 0.0) && !touches(6.6, 9.0));
    }
}
