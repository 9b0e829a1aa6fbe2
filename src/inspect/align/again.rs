//! The pose of a scan that was laid on the nominal before: what was found then need not be found again.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::scene::Scene;
use super::search::Pose;
use super::{
    AlignOptions, Aligned, Candidates, Observation, SETTLED, Scan, Start, Step, TOO_FEW, Task,
};
use crate::geometry::RigidTransform;
use crate::inspect::assign::{Place, Surface};
use crate::inspect::body::Body;

/// A point that has been laid on the nominal.
#[derive(Debug, Clone, Copy)]
pub(in crate::inspect) struct LaidPoint {
    /// In the part frame, mm.
    pub(in crate::inspect) point: DVec3,
    pub(in crate::inspect) place: Place,
    /// Distance from the nearest edge of its face, mm, as far as is known.
    pub(in crate::inspect) rim_mm: f64,
}

/// The pose of a scan of which `laid` are points, laid on the nominal at the pose `base`, which is nearly right, and `sketch` is a
/// thinned copy; they lie `along_mm` apart along the lines. `known` are the poses that a part of the scan fitted: the whole fits no others.
pub(in crate::inspect) fn align_again<B: Body>(
    sketch: &Scan<'_>,
    surface: &Surface<'_, B>,
    start: Start,
    options: &AlignOptions<'_>,
    known: &Candidates,
    (base, laid, along_mm): (RigidTransform, &[LaidPoint], f64),
) -> Aligned {
    let task = Task::new(sketch, surface, start, options);
    if start == Start::None {
        return task.as_it_lies();
    }
    let Some((pose, observations, step)) = task.settled(base, laid, along_mm) else {
        return task.failed(TOO_FEW.to_string());
    };
    let scene = Scene::new(sketch);
    let poses: Vec<Pose> = known
        .iter()
        .map(|(pose, weak)| Pose {
            pose: *pose,
            fit: scene.fit(pose, surface, task.cap_mm()),
            weak: weak.clone(),
        })
        .collect();
    let mut aligned = task.described(pose, &observations, &step);
    task.check(&scene, &poses, start, &step, &mut aligned);
    task.on_datums(aligned)
}

/// The pose alone by points that were laid on the nominal at `base`, as [`align_again`] finds it; `None` where too few lie near.
pub(in crate::inspect) fn settle<B: Body>(
    sketch: &Scan<'_>,
    surface: &Surface<'_, B>,
    start: Start,
    options: &AlignOptions<'_>,
    (base, laid, along_mm): (RigidTransform, &[LaidPoint], f64),
) -> Option<RigidTransform> {
    let task = Task::new(sketch, surface, start, options);
    let (pose, ..) = task.settled(base, laid, along_mm)?;
    Some(pose)
}

impl<B: Body> Task<'_, B> {
    /// The pose by points that were laid on the nominal at `base`: the deviation from a face follows a small motion of its point along
    /// the normal, exactly where the face is plane.
    fn settled(
        &self,
        base: RigidTransform,
        laid: &[LaidPoint],
        along_mm: f64,
    ) -> Option<(RigidTransform, Vec<Observation>, Step)> {
        let holds = |p: &LaidPoint, gate: f64, rim: f64| {
            self.holds(p.place.face) && p.place.distance_mm <= gate && p.rim_mm >= rim
        };
        let count = |gate, rim| laid.iter().filter(|p| holds(p, gate, rim)).count();
        let (gate, rim) = self.gates(along_mm, count);
        let laid: Vec<&LaidPoint> = laid.iter().filter(|p| holds(p, gate, rim)).collect();
        let observed = |pose: &RigidTransform| {
            let motion = *pose * base.inverse();
            let turn = DMat3::from_quat(motion.rotation);
            let moved = |p: &&LaidPoint| {
                let point = turn * p.point + motion.translation;
                Observation {
                    point,
                    normal: p.place.normal,
                    residual_mm: p.place.deviation_mm + p.place.normal.dot(point - p.point),
                    face: p.place.face,
                    u_mm: 0.0,
                }
            };
            let mut observations: Vec<Observation> = laid.par_iter().map(moved).collect();
            observations.extend(self.observe(pose, &[], gate, 0.0));
            observations
        };
        let mut pose = base;
        let mut last = None;
        for _ in 0..12 {
            let step = self.solve(&observed(&pose))?;
            pose = self.moved(&step.twist, pose);
            let small = step.twist.size(self.size_mm)
                < SETTLED * self.scan.noise_mm.max(1e-8 * self.size_mm);
            last = Some(step);
            if small {
                break;
            }
        }
        Some((pose, observed(&pose), last?))
    }
}
