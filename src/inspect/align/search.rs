//! A pose from nothing or from a rough start: a lattice of poses, of which the best are followed down.
//!
//! The lattice covers every turn and shift that the start leaves open, densely enough that the true pose lies in the basin of one of
//! its members. Each is judged by a few points through the cells of [`Surface`], each of the best hundreds is followed down on the
//! planes of the nearest samples, and the best of these on the exact faces. What fits as well as the best is kept beside it.
//!
//! Turns are spread evenly by super-Fibonacci spirals (Alexa, "Super-Fibonacci Spirals", CVPR 2022).

use glam::{DMat3, DQuat, DVec3, Vec3};
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;

use super::scene::{Fit, Oriented, Scene};
use super::twist::Twist;
use super::{Start, Task, is_different};
use crate::geometry::RigidTransform;
use crate::inspect::assign::{Near, Surface};
use crate::inspect::body::Body;

/// Points that judge a member of the lattice, and that it is followed down with.
const RATED_BY: usize = 48;
const SETTLED_BY: usize = 240;

/// Members that are followed down on samples, steps at most, and those of them that go on to the exact faces.
const SETTLED: usize = 400;
const SETTLE_STEPS: usize = 14;
const REFINED: usize = 20;

/// Turns of the lattice over all orientations: neighbours are 20 degrees apart.
const TURNS: usize = 1600;

/// Step of the lattice around a rough start, rad, and of its shifts over the half-diagonal.
const TURN_STEP_RAD: f64 = 0.2;
const SHIFT_STEP: f64 = 0.24;

/// Shifts of a turn that are followed down.
const SHIFTS: usize = 3;

/// Members of the lattice that are judged at most.
const MOST: usize = 400_000;

/// Distances count up to this share of the half-diagonal.
const CAP: f64 = 0.3;

/// Points and steps on the exact faces.
const REFINEMENT: (usize, usize) = (600, 12);

/// A pose that the search ended at.
pub(super) struct Pose {
    pub(super) pose: RigidTransform,
    pub(super) fit: Fit,
    /// What the data do not hold.
    pub(super) weak: Vec<Twist>,
}

/// Best first: the poses that the scene settles at, each different from the others.
///
/// With a rough start its own minimum comes first unless another is better: where several fit, the start decides.
pub(super) fn search<B: Body>(task: &Task<'_, B>, scene: &Scene, start: Start) -> Vec<Pose> {
    if scene.points.len() < 12 {
        return Vec::new();
    }
    let region = match start {
        Start::Auto => Region::everywhere(task),
        Start::Rough(pose) => Region::around(task, scene, pose),
        Start::None => return Vec::new(),
    };
    let few = scene.few(RATED_BY);
    let mut rated: Vec<(f64, RigidTransform)> = region
        .turns
        .par_iter()
        .flat_map_iter(|turn| region.best_shifts(task.surface, *turn, &few, scene.centre))
        .collect();
    rated.sort_by(|a, b| a.0.total_cmp(&b.0));
    rated.truncate(SETTLED);
    let settled_by = scene.few(SETTLED_BY);
    let mut settled: Vec<(f64, RigidTransform)> = rated
        .par_iter()
        .map(|(_, pose)| {
            let pose = settle(*pose, &settled_by, task.surface, task.size_mm);
            (
                rate(&pose, &settled_by, task.surface, 0.1 * task.size_mm),
                pose,
            )
        })
        .collect();
    settled.sort_by(|a, b| a.0.total_cmp(&b.0));
    let distinct = distinct(&settled, 0.08 * task.size_mm, task);
    refine(task, scene, distinct)
}

/// Those of `starts` that settle at a place which a few points rate hardly worse than `pose` of another scene, settled.
pub(super) fn promising<B: Body>(
    task: &Task<'_, B>,
    (scene, starts): (&Scene, Vec<RigidTransform>),
    (other, pose): (&Scene, &RigidTransform),
) -> Vec<RigidTransform> {
    let scale = 0.1 * task.size_mm;
    let own = rate(pose, &other.few(SETTLED_BY), task.surface, scale);
    let few = scene.few(SETTLED_BY);
    starts
        .into_iter()
        .map(|start| settle(start, &few, task.surface, task.size_mm))
        .filter(|settled| rate(settled, &few, task.surface, scale) < own + 0.05)
        .collect()
}

/// Follows every start down on the exact faces; best first.
pub(super) fn refine<B: Body>(
    task: &Task<'_, B>,
    scene: &Scene,
    starts: Vec<RigidTransform>,
) -> Vec<Pose> {
    let cap_mm = task.cap_mm();
    let mut refined: Vec<Pose> = starts
        .into_par_iter()
        .map(|start| {
            let (pose, weak) = task.on_scene(scene, start, REFINEMENT);
            Pose {
                pose,
                fit: scene.fit(&pose, task.surface, cap_mm),
                weak,
            }
        })
        .collect();
    refined.sort_by(|a, b| a.fit.rms_mm.total_cmp(&b.fit.rms_mm));
    let mut kept: Vec<Pose> = Vec::new();
    for pose in refined {
        let new = |k: &Pose| is_different(&k.pose, &pose.pose, &[], task.size_mm);
        if kept.iter().all(new) {
            kept.push(pose);
        }
    }
    kept
}

/// Turns, and places of the scene's centre in the part frame, that a start leaves open.
struct Region {
    turns: Vec<DQuat>,
    places: Vec<DVec3>,
    /// Distance of neighbouring places.
    step_mm: f64,
}

impl Region {
    fn everywhere<B: Body>(task: &Task<'_, B>) -> Self {
        let [low, high] = task.surface.body.bounds();
        // The middle of the points lies in the part's box.
        let step = SHIFT_STEP * task.size_mm;
        let inside = |p: &DVec3| p.cmpge(low).all() && p.cmple(high).all();
        let places: Vec<DVec3> = lattice(0.5 * (low + high), task.size_mm, step)
            .into_iter()
            .filter(inside)
            .collect();
        let turns = TURNS.min(MOST / places.len().max(1));
        Self {
            turns: (0..turns).map(|k| spiral(k, turns)).collect(),
            places,
            step_mm: step,
        }
    }

    fn around<B: Body>(task: &Task<'_, B>, scene: &Scene, start: RigidTransform) -> Self {
        let prior = task.options.start_within;
        let [low, high] = task.surface.body.bounds();
        let place = start.point(scene.centre);
        // A turn about the part's middle moves the middle of a partial scan.
        let lever = place.distance(0.5 * (low + high)).min(task.size_mm);
        let reach = prior.shift_share * task.size_mm + prior.turn_rad * lever;
        let turns = lattice(
            DVec3::ZERO,
            prior.turn_rad + 0.5 * TURN_STEP_RAD,
            TURN_STEP_RAD,
        )
        .into_iter()
        .map(|v| DQuat::from_scaled_axis(v) * start.rotation)
        .collect();
        Self {
            turns,
            places: lattice(place, reach, SHIFT_STEP * task.size_mm),
            step_mm: SHIFT_STEP * task.size_mm,
        }
    }

    /// The best shifts for a turn, with their ratings: none is a neighbour of a better one, so that they lie in basins of their own.
    fn best_shifts<B: Body>(
        &self,
        surface: &Surface<'_, B>,
        turn: DQuat,
        few: &[Oriented],
        centre: DVec3,
    ) -> Vec<(f64, RigidTransform)> {
        let matrix = DMat3::from_quat(turn);
        let turned: Vec<(DVec3, Vec3, bool)> = few
            .iter()
            .map(|o| {
                let normal = (matrix * o.normal).as_vec3();
                (matrix * (o.point - centre), normal, o.towards.is_some())
            })
            .collect();
        let scale = surface.size_mm() * CAP;
        let apart = self.step_mm * 1.1;
        let mut best: Vec<(f64, DVec3)> = Vec::with_capacity(SHIFTS + 1);
        let worst = |best: &[(f64, DVec3)]| match best.get(SHIFTS - 1) {
            Some(last) => last.0,
            None => f64::INFINITY,
        };
        for place in &self.places {
            let mut sum = 0.0;
            for (p, normal, signed) in &turned {
                let p = *p + *place;
                sum += miss(surface.rough(p), p, *normal, *signed, scale);
                if sum > worst(&best) {
                    break;
                }
            }
            let beside = |b: &(f64, DVec3)| b.1.distance(*place) < apart;
            if sum >= worst(&best) || best.iter().any(|b| b.0 <= sum && beside(b)) {
                continue;
            }
            best.retain(|b| !beside(b));
            let rank = best.partition_point(|b| b.0 <= sum);
            best.insert(rank, (sum, *place));
            best.truncate(SHIFTS);
        }
        best.into_iter()
            .map(|(sum, place)| (sum, RigidTransform::new(turn, place - matrix * centre)))
            .collect()
    }
}

/// Distance of a point from the sample of its cell over `scale`, 0 to 1; 1 where the normals disagree.
#[inline]
fn miss(near: Option<&Near>, p: DVec3, normal: Vec3, signed: bool, scale: f64) -> f64 {
    let Some(near) = near else {
        return 1.0;
    };
    let cosine = near.normal.dot(normal);
    if (if signed { cosine } else { cosine.abs() }) < 0.6 {
        return 1.0;
    }
    let offset = p.as_vec3() - near.point;
    (f64::from(offset.length()) / scale).min(1.0)
}

/// Mean miss of `points` under a pose.
fn rate<B: Body>(
    pose: &RigidTransform,
    points: &[Oriented],
    surface: &Surface<'_, B>,
    scale: f64,
) -> f64 {
    let matrix = DMat3::from_quat(pose.rotation);
    let sum: f64 = points
        .iter()
        .map(|o| {
            let p = matrix * o.point + pose.translation;
            let normal = (matrix * o.normal).as_vec3();
            miss(surface.near(p), p, normal, o.towards.is_some(), scale)
        })
        .sum();
    sum / points.len().max(1) as f64
}

/// Follows a pose down on the planes of the nearest samples.
fn settle<B: Body>(
    start: RigidTransform,
    points: &[Oriented],
    surface: &Surface<'_, B>,
    size_mm: f64,
) -> RigidTransform {
    let mut pose = start;
    let mut gate = 0.6 * size_mm;
    for _ in 0..SETTLE_STEPS {
        let matrix = DMat3::from_quat(pose.rotation);
        let mut normal_matrix = Matrix6::<f64>::zeros();
        let mut right = Vector6::<f64>::zeros();
        let mut count = 0.0;
        for o in points {
            let p = matrix * o.point + pose.translation;
            let Some(near) = surface.near(p) else {
                continue;
            };
            let cosine = f64::from(near.normal.dot((matrix * o.normal).as_vec3()));
            let cosine = if o.towards.is_some() {
                cosine
            } else {
                cosine.abs()
            };
            let offset = p - near.point.as_dvec3();
            let ratio = offset.length() / gate;
            if cosine < 0.3 || ratio > 1.0 {
                continue;
            }
            let n = near.normal.as_dvec3();
            let residual = offset.dot(n);
            let lever = p.cross(n) / size_mm;
            let row = Vector6::new(lever.x, lever.y, lever.z, n.x, n.y, n.z);
            let weight = cosine * (1.0 - ratio * ratio).powi(2);
            normal_matrix.ger(weight, &row, &row, 1.0);
            right.axpy(-weight * residual, &row, 1.0);
            count += weight;
        }
        // Damped, so that what the points do not hold stays where it is.
        for k in 0..6 {
            normal_matrix[(k, k)] += 1e-3 * count + 1e-9;
        }
        let Some(factor) = normal_matrix.cholesky() else {
            return pose;
        };
        let step = factor.solve(&right);
        let twist = Twist::from_array(std::array::from_fn(|k| {
            if k < 3 { step[k] / size_mm } else { step[k] }
        }));
        pose = twist.transform() * pose;
        gate = (0.75 * gate).max(0.05 * size_mm);
        if twist.size(size_mm) < 1e-3 * size_mm && gate <= 0.06 * size_mm {
            break;
        }
    }
    pose
}

/// The first poses that differ from each other by more than `apart_mm` at a corner of the part, at most [`REFINED`].
fn distinct<B: Body>(
    ranked: &[(f64, RigidTransform)],
    apart_mm: f64,
    task: &Task<'_, B>,
) -> Vec<RigidTransform> {
    let [low, high] = task.surface.body.bounds();
    let corner = |k: u32| {
        DVec3::new(
            if k & 1 == 0 { low.x } else { high.x },
            if k & 2 == 0 { low.y } else { high.y },
            if k & 4 == 0 { low.z } else { high.z },
        )
    };
    let mut kept: Vec<RigidTransform> = Vec::new();
    for (_, pose) in ranked {
        let far = |other: &RigidTransform| {
            let motion = *pose * other.inverse();
            (0..8).any(|k| motion.point(corner(k)).distance(corner(k)) > apart_mm)
        };
        if kept.iter().all(far) {
            kept.push(*pose);
        }
        if kept.len() == REFINED {
            break;
        }
    }
    kept
}

/// Places of a cubic lattice within `radius` of `centre`, which is one of them.
fn lattice(centre: DVec3, radius: f64, step: f64) -> Vec<DVec3> {
    let count = (radius / step).clamp(0.0, 20.0).floor() as i32;
    let mut places = Vec::new();
    for x in -count..=count {
        for y in -count..=count {
            for z in -count..=count {
                let offset = step * DVec3::new(f64::from(x), f64::from(y), f64::from(z));
                if offset.length() <= radius {
                    places.push(centre + offset);
                }
            }
        }
    }
    places
}

/// Turn `k` of `count` spread evenly over all orientations.
fn spiral(k: usize, count: usize) -> DQuat {
    let phi = std::f64::consts::SQRT_2;
    // The positive root of x^4 = x + 4.
    let psi = 1.533_751_168_755_204_3;
    let s = k as f64 + 0.5;
    let t = s / count as f64;
    let (r, rest) = (t.sqrt(), (1.0 - t).sqrt());
    let (alpha, beta) = (
        std::f64::consts::TAU * s / phi,
        std::f64::consts::TAU * s / psi,
    );
    DQuat::from_xyzw(
        r * alpha.sin(),
        r * alpha.cos(),
        rest * beta.sin(),
        rest * beta.cos(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_orientation_is_near_a_turn_of_the_lattice() {
        let turns: Vec<DQuat> = (0..TURNS).map(|k| spiral(k, TURNS)).collect();
        // Orientations off any regular pattern.
        for k in 0..397 {
            let wanted = spiral(k, 397) * DQuat::from_axis_angle(DVec3::X, 0.37);
            let nearest = turns
                .iter()
                .map(|t| t.angle_between(wanted))
                .fold(f64::INFINITY, f64::min);
            // The published covering radius of the spirals shrinks with the cube root of their number; the basin of a
            // pose is some 30 degrees wide.
            assert!(nearest < 0.45, "{nearest}");
        }
    }
}
