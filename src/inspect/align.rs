//! How a scan lies in the part frame: a least-squares pose on the exact faces of the nominal, with its covariance and a
//! conclusion about itself.
//!
//! Points are paired with the foot of their perpendicular on the nearest face that is seen from the sensor's side; the
//! pose is the robust least-squares solution of the signed distances (Gauss-Newton with Tukey's weights), of points away
//! from edges. A start is found by a search over all poses that what is known leaves open. Then each face
//! and each patch of a face is asked whether it departs from its nominal by more than noise, and the covariance grows by
//! what is found. Directions that the data do not hold are left alone and named; a pose that another one rivals, that leaves
//! the scan off the nominal, or that fits a mirrored scan better is no answer. Where datum features are asked for, the pose then moves
//! onto them.

mod again;
mod check;
pub mod datum;
mod features;
mod form;
mod scene;
mod search;
mod twist;

use glam::{DMat3, DVec3};
use nalgebra::{Matrix6, SymmetricEigen, Vector6};
use rayon::prelude::*;

use super::assign::{NO_FACE, Surface, towards};
use super::body::Body;
use super::measure::pose_row;
use super::result::{Alignment, Method, Verdict};
use crate::geometry::RigidTransform;
use crate::geometry::fit::{mad_sigma, median};
use crate::points::{Neighbors, PointCloud, Spacing};
use form::{form, patch_of};
use scene::Scene;
use search::Pose;

pub(super) use again::{LaidPoint, align_again, settle};
pub use datum::{Datum, DatumPose, pose_from_datums, pose_from_ordered_datums};
pub use features::{DatumFeature, DatumPlace};
pub use twist::Twist;

/// Points of the last step: more do not make the pose better than anything else is known.
const FINAL_POINTS: usize = 1_000_000;

/// Points of the steps before.
const FINE_POINTS: usize = 20_000;

/// Points of the coarse steps.
const COARSE_POINTS: usize = 2_000;

/// A step over the noise after which a pose stands: 500,000 points leave ten times as much to chance.
const SETTLED: f64 = 5e-4;

/// Observations that one task adds up; fixed, so that the sums do not depend on the number of threads.
const BLOCK: usize = 8192;

/// Tukey's constant: 95 % efficient on normal noise.
const TUKEY: f64 = 4.685;

/// Points nearer to an edge than this many spacings along the line may be smeared over it.
const RIM_SPACINGS: f64 = 3.0;

/// A direction held by fewer than one in this many observations is held by chance.
const CHANCE: f64 = 1e5;

/// What a held degree of freedom counts over all observations.
const HELD: f64 = 1e12;

const TOO_FEW: &str = "alignment: fewer than 20 points lie near the nominal, expected most of the scan; give a better start";

/// What is known of the pose beforehand.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Start {
    /// The scan lies in the part frame already.
    None,
    /// Roughly: as far as [`AlignOptions::start_within`] says.
    Rough(RigidTransform),
    /// Nothing.
    #[default]
    Auto,
}

/// How far a rough start may be off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartWithin {
    /// Turned about the part's middle, rad.
    pub turn_rad: f64,
    /// Shifted, over the half-diagonal of the part.
    pub shift_share: f64,
}

impl Default for StartWithin {
    /// 20 degrees and half the part's size.
    fn default() -> Self {
        Self {
            turn_rad: 20f64.to_radians(),
            shift_share: 1.0,
        }
    }
}

/// One contact of a probe with the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touch {
    /// The place on the surface, tip radius taken off, mm, in the frame of the scan.
    pub point: DVec3,
    /// Its standard uncertainty along the surface's normal, mm.
    pub u_mm: f64,
}

/// What holds the pose.
#[derive(Debug, Clone, Copy, Default)]
pub struct AlignOptions<'a> {
    /// Indices of the faces that hold the pose; empty = all.
    pub datum_faces: &'a [u32],
    /// Features that the pose is to rest on; empty = the best fit stands.
    pub datums: &'a [DatumFeature],
    /// Contacts of a probe, as further observations.
    pub touches: &'a [Touch],
    /// How far a rough start may be off.
    pub start_within: StartWithin,
    /// Degrees of freedom that stay as the rough start has them: of the motion from there, the turns about x, y, z (components of
    /// the rotation vector about the part origin) and the shifts along x, y, z, in the part frame.
    pub held: [bool; 6],
}

/// What an alignment says of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Conclusion {
    /// The pose is the only one that fits, and the data hold it.
    Good,
    /// The scan was taken as it lies.
    AsGiven,
    /// Nothing fits, or there is nothing to fit.
    NotFound,
    /// The data leave a direction free that moves a sharp edge.
    Free,
    /// So many poses fit equally well: a symmetric part, or too little of it seen.
    Ambiguous(usize),
    /// Too much of the scan lies off the nominal: another part, another place, or mostly other things.
    Misfit,
    /// The mirrored scan fits better.
    Mirrored,
    /// A datum feature that was asked for could not be measured.
    NoDatum,
}

/// A pose with what is to be said of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    /// The pose and its covariance.
    pub alignment: Alignment,
    /// Why it is not decidable, and what was peculiar.
    pub findings: Vec<String>,
    /// The finding that rules, for a program.
    pub conclusion: Conclusion,
    /// Of the normal matrix, ascending: as many points straight on would hold each principal direction. Turns are counted by
    /// what they move at the half-diagonal of the part; a held degree of freedom counts as infinite.
    pub eigenvalues: [f64; 6],
}

/// The pose of `cloud` on the nominal, from `start`.
///
/// The result is `NotDecidable` for every [`Conclusion`] but `Good` and `AsGiven`.
pub fn align<B: Body>(
    scan: &Scan<'_>,
    surface: &Surface<'_, B>,
    start: Start,
    options: &AlignOptions<'_>,
) -> Aligned {
    align_keeping(scan, surface, start, options).0
}

/// Poses that a search ended at, best first, with what the data did not hold.
pub(super) type Candidates = Vec<(RigidTransform, Vec<Twist>)>;

/// As [`align`], with the poses that fitted, for [`align_again`].
pub(super) fn align_keeping<B: Body>(
    scan: &Scan<'_>,
    surface: &Surface<'_, B>,
    start: Start,
    options: &AlignOptions<'_>,
) -> (Aligned, Candidates) {
    let task = Task::new(scan, surface, start, options);
    let holds = options.held.contains(&true);
    match start {
        Start::None => (task.as_it_lies(), Vec::new()),
        Start::Auto if holds => {
            let aligned = task.failed(
                "alignment: held degrees of freedom but no start, expected the pose they are held at; give a rough start"
                    .to_string(),
            );
            (aligned, Vec::new())
        }
        _ => {
            let scene = Scene::new(scan);
            let poses = task.find(&scene, start, holds);
            let known = poses.iter().map(|p| (p.pose, p.weak.clone())).collect();
            (task.on_datums(task.follow(&scene, &poses, start)), known)
        }
    }
}

/// A scan with what is needed to look things up in it.
#[derive(Clone, Copy)]
pub struct Scan<'a> {
    /// The points.
    pub cloud: &'a PointCloud,
    /// Their neighbours.
    pub neighbors: &'a Neighbors,
    /// Their spacing.
    pub spacing: Spacing,
    /// Standard deviation of a point, mm.
    pub noise_mm: f64,
}

impl Scan<'_> {
    /// At most `count` points spread over the scan, always the same.
    pub(super) fn subset(&self, count: usize) -> Vec<u32> {
        let order = self.neighbors.order();
        let step = order.len().div_ceil(count.max(1)).max(1);
        order.iter().copied().step_by(step).collect()
    }
}

/// One observation: a place on a face, and how far the point lies off it.
#[derive(Debug, Clone, Copy)]
struct Observation {
    /// In the part frame.
    point: DVec3,
    normal: DVec3,
    residual_mm: f64,
    face: u32,
    /// Of a touch: its own standard deviation; of a scan point 0.
    u_mm: f64,
}

impl Observation {
    /// How the pose moves it, turns counted at the half-diagonal, so that all six unknowns are mm.
    fn scaled_row(&self, size_mm: f64) -> Vector6<f64> {
        let row = pose_row(self.point, self.normal);
        Vector6::from_fn(|k, _| if k < 3 { row[k] / size_mm } else { row[k] })
    }
}

/// A Gauss-Newton step.
struct Step {
    twist: Twist,
    sigma: f64,
    weights: Vec<f64>,
    /// Normal matrix in scaled unknowns.
    matrix: Matrix6<f64>,
    /// Its eigenvalues, ascending; those of held degrees of freedom infinite.
    eigenvalues: [f64; 6],
    /// Unit vectors, in scaled unknowns, that the data do not hold.
    weak: Vec<Vector6<f64>>,
}

struct Task<'a, B: Body> {
    scan: &'a Scan<'a>,
    surface: &'a Surface<'a, B>,
    options: &'a AlignOptions<'a>,
    size_mm: f64,
    /// The pose at which held degrees of freedom stay.
    origin: RigidTransform,
}

impl<'a, B: Body> Task<'a, B> {
    fn new(
        scan: &'a Scan<'a>,
        surface: &'a Surface<'a, B>,
        start: Start,
        options: &'a AlignOptions<'a>,
    ) -> Self {
        Self {
            scan,
            surface,
            options,
            size_mm: surface.size_mm(),
            origin: match start {
                Start::Rough(pose) => pose,
                _ => RigidTransform::IDENTITY,
            },
        }
    }

    /// A best fit on the faces asked for, without anything found.
    fn unexplained(&self) -> Alignment {
        let faces = self.options.datum_faces.iter();
        Alignment {
            faces: faces.map(|f| self.surface.body.face_entity(*f)).collect(),
            ..Alignment::default()
        }
    }

    fn failed(&self, finding: String) -> Aligned {
        let mut covariance = [[0.0; 6]; 6];
        for (i, row) in covariance.iter_mut().enumerate() {
            row[i] = if i < 3 { 1.0 } else { self.size_mm.powi(2) };
        }
        Aligned {
            alignment: Alignment {
                part_from_machine: RigidTransform::IDENTITY,
                rms_mm: 0.0,
                points: 0,
                covariance,
                weak_directions: Vec::new(),
                status: Verdict::NotDecidable,
                ..self.unexplained()
            },
            findings: vec![finding],
            conclusion: Conclusion::NotFound,
            eigenvalues: [0.0; 6],
        }
    }

    /// The identity, taken as exact, with the residuals it leaves.
    fn as_it_lies(&self) -> Aligned {
        let indices = self.scan.subset(FINE_POINTS);
        let observations =
            self.observe(&RigidTransform::IDENTITY, &indices, 0.1 * self.size_mm, 0.0);
        let sum: f64 = observations.iter().map(|o| o.residual_mm.powi(2)).sum();
        self.off_datums(Aligned {
            alignment: Alignment {
                part_from_machine: RigidTransform::IDENTITY,
                rms_mm: (sum / observations.len().max(1) as f64).sqrt(),
                points: observations.len(),
                covariance: [[0.0; 6]; 6],
                weak_directions: Vec::new(),
                status: Verdict::Ok,
                method: Method::AsGiven,
                ..self.unexplained()
            },
            findings: Vec::new(),
            conclusion: Conclusion::AsGiven,
            eigenvalues: [0.0; 6],
        })
    }

    /// The poses that the scene fits, best first; none where too few points lie near the nominal.
    fn find(&self, scene: &Scene, start: Start, holds: bool) -> Vec<Pose> {
        let mut poses = if holds {
            Vec::new()
        } else {
            search::search(self, scene, start)
        };
        if let Start::Rough(pose) = start
            && let Some((pose, weak)) = self.coarse(pose, COARSE_POINTS, 0.3 * self.size_mm)
        {
            let fit = scene.fit(&pose, self.surface, self.cap_mm());
            let better = poses
                .first()
                .is_some_and(|p| p.fit.is_better(&fit, self.scan.noise_mm));
            // Where several fit the start decides.
            let place = usize::from(better).min(poses.len());
            poses.insert(place, Pose { pose, fit, weak });
        }
        poses
    }

    /// From the first of `poses` down to all points; the others are its rivals.
    fn follow(&self, scene: &Scene, poses: &[Pose], start: Start) -> Aligned {
        let Some(best) = poses.first().map(|p| p.pose) else {
            return self.failed(match start {
                Start::Rough(_) => TOO_FEW.to_string(),
                _ => "alignment: no pose of the scan fits the nominal; give a rough start"
                    .to_string(),
            });
        };
        let Some((pose, _)) = self.coarse(best, COARSE_POINTS, 0.1 * self.size_mm) else {
            return self.failed(TOO_FEW.to_string());
        };
        let Some((pose, observations, step)) = self.fine(pose) else {
            return self.failed(TOO_FEW.to_string());
        };
        let mut aligned = self.described(pose, &observations, &step);
        self.check(scene, poses, start, &step, &mut aligned);
        aligned
    }

    /// Distance from the nominal within which points are looked at, and from an edge without which they are not, mm; `inner` tells how
    /// many points there are for both, and for the first alone.
    fn gates(&self, along_mm: f64, inner: impl Fn(f64, f64) -> usize) -> (f64, f64) {
        // Wide enough that a face which is off stays in sight and is counted as form.
        let gate = (0.05 * self.size_mm).max(10.0 * self.scan.noise_mm);
        let rim = (RIM_SPACINGS * along_mm).min(0.02 * self.size_mm);
        // A part of nothing but narrow faces is all rim.
        if inner(gate, rim) * 3 < inner(gate, 0.0) {
            (gate, 0.0)
        } else {
            (gate, rim)
        }
    }

    fn holds(&self, face: u32) -> bool {
        face != NO_FACE
            && (self.options.datum_faces.is_empty() || self.options.datum_faces.contains(&face))
    }

    /// The pose by some points until it stands, then by all.
    fn fine(&self, start: RigidTransform) -> Option<(RigidTransform, Vec<Observation>, Step)> {
        let mut pose = start;
        let some = self.scan.subset(FINE_POINTS);
        let along_mm = self.scan.spacing.along_mm;
        let (gate, rim) = self.gates(along_mm, |gate, rim| {
            self.observe(&pose, &some, gate, rim).len()
        });
        for _ in 0..12 {
            let step = self.solve(&self.observe(&pose, &some, gate, rim))?;
            pose = self.moved(&step.twist, pose);
            if step.twist.size(self.size_mm) < 0.05 * self.scan.noise_mm.max(1e-8 * self.size_mm) {
                break;
            }
        }
        let all = self.scan.subset(FINAL_POINTS);
        let mut last = None;
        for _ in 0..3 {
            let observations = self.observe(&pose, &all, gate, rim);
            let step = self.solve(&observations)?;
            pose = self.moved(&step.twist, pose);
            // For a smaller step no point changes its place on the nominal.
            let small = step.twist.size(self.size_mm) < self.scan.noise_mm.max(1e-7 * self.size_mm);
            last = Some((pose, observations, step));
            if small {
                break;
            }
        }
        let (mut pose, mut observations, mut step) = last?;
        self.take_off(&step, &mut observations);
        // Steps converge linearly, by an eighth each, as Tukey's weights follow the residuals.
        for _ in 0..8 {
            if step.twist.size(self.size_mm) < SETTLED * self.scan.noise_mm {
                break;
            }
            step = self.solve(&observations)?;
            pose = self.moved(&step.twist, pose);
            self.take_off(&step, &mut observations);
        }
        Some((pose, observations, step))
    }

    /// The residuals as `step` leaves them.
    fn take_off(&self, step: &Step, observations: &mut [Observation]) {
        let v = Vector6::from(step.twist.scaled(self.size_mm));
        observations
            .par_iter_mut()
            .for_each(|o| o.residual_mm += o.scaled_row(self.size_mm).dot(&v));
    }

    /// `pose` moved by `twist`, held degrees of freedom put back.
    fn moved(&self, twist: &Twist, pose: RigidTransform) -> RigidTransform {
        let pose = twist.transform() * pose;
        if !self.options.held.contains(&true) {
            return pose;
        }
        let motion = pose * self.origin.inverse();
        let mut free = Twist {
            turn: Twist::logarithm(&motion).turn,
            shift: motion.translation,
        }
        .to_array();
        for (x, held) in free.iter_mut().zip(self.options.held) {
            if held {
                *x = 0.0;
            }
        }
        Twist::from_array(free).transform() * self.origin
    }

    /// The scan points `indices` on the faces that hold the pose, away from edges by `rim_mm`, and the touches.
    fn observe(
        &self,
        pose: &RigidTransform,
        indices: &[u32],
        gate_mm: f64,
        rim_mm: f64,
    ) -> Vec<Observation> {
        let cloud = self.scan.cloud;
        let turn = DMat3::from_quat(pose.rotation);
        let of = |point: DVec3,
                  view: Option<DVec3>,
                  (u_mm, rim_mm): (f64, f64),
                  found: &mut Vec<(u32, f64)>| {
            let p = turn * point + pose.translation;
            let view = view.map(|v| turn * v);
            let (place, rim) = self.surface.place_and_rim(p, view, gate_mm, found);
            (self.holds(place.face) && rim >= rim_mm).then_some(Observation {
                point: p,
                normal: place.normal,
                residual_mm: place.deviation_mm,
                face: place.face,
                u_mm,
            })
        };
        let mut observations: Vec<Observation> = indices
            .par_chunks(BLOCK.min(512))
            .map_init(Vec::new, |found, block| {
                let mut out = Vec::with_capacity(block.len());
                for i in block {
                    let i = *i as usize;
                    let view = towards(cloud, i);
                    out.extend(of(cloud.positions[i], view, (0.0, rim_mm), found));
                }
                out
            })
            .flatten_iter()
            .collect();
        let mut found = Vec::new();
        for touch in self.options.touches {
            observations.extend(of(touch.point, None, (touch.u_mm, 0.0), &mut found));
        }
        observations
    }

    /// The pose that a few points settle on from `start`, and the directions that they do not hold.
    fn coarse(
        &self,
        start: RigidTransform,
        points: usize,
        gate_mm: f64,
    ) -> Option<(RigidTransform, Vec<Twist>)> {
        let few = self.scan.subset(points);
        self.descend(start, (gate_mm, 30), |pose, gate| {
            self.observe(pose, &few, gate, 0.0)
        })
    }

    /// As [`Task::coarse`] on points of the scene, of which the normals must agree; the start where too few lie near.
    fn on_scene(
        &self,
        scene: &Scene,
        start: RigidTransform,
        (points, steps): (usize, usize),
    ) -> (RigidTransform, Vec<Twist>) {
        let few = scene.few(points);
        let descended = self.descend(start, (0.15 * self.size_mm, steps), |pose, gate| {
            let turn = DMat3::from_quat(pose.rotation);
            let mut found = Vec::new();
            let mut observations = Vec::with_capacity(few.len());
            for o in &few {
                let p = turn * o.point + pose.translation;
                let view = o.towards.map(|t| turn * t);
                let place = self.surface.place(p, view, gate, &mut found);
                let cosine = place.normal.dot(turn * o.normal);
                let agrees = if view.is_some() { cosine } else { cosine.abs() } > 0.7;
                if place.face != NO_FACE && agrees {
                    observations.push(Observation {
                        point: p,
                        normal: place.normal,
                        residual_mm: place.deviation_mm,
                        face: place.face,
                        u_mm: 0.0,
                    });
                }
            }
            observations
        });
        descended.unwrap_or((start, Vec::new()))
    }

    /// Gauss-Newton steps while the gate narrows to where only the part itself is left: fixtures and reflections lie further away.
    fn descend(
        &self,
        start: RigidTransform,
        (gate_mm, steps): (f64, usize),
        observe: impl Fn(&RigidTransform, f64) -> Vec<Observation>,
    ) -> Option<(RigidTransform, Vec<Twist>)> {
        let mut pose = start;
        let mut weak = Vec::new();
        let mut gate = gate_mm;
        let noise = self.scan.noise_mm.max(1e-6 * self.size_mm);
        for _ in 0..steps {
            let step = self.solve(&observe(&pose, gate))?;
            pose = self.moved(&step.twist, pose);
            gate = (0.7 * gate)
                .max(6.0 * step.sigma)
                .max(10.0 * noise)
                .max(0.01 * self.size_mm)
                .min(gate_mm);
            weak = self.twists(&step);
            if step.twist.size(self.size_mm) < 0.2 * noise {
                break;
            }
        }
        Some((pose, weak))
    }

    fn twists(&self, step: &Step) -> Vec<Twist> {
        step.weak
            .iter()
            .map(|v| Twist::from_scaled(v, self.size_mm))
            .collect()
    }

    /// Distances count up to this when whole poses are compared, mm.
    fn cap_mm(&self) -> f64 {
        0.1 * self.size_mm
    }

    /// Spread of the residuals: about zero, or about their median where they are all off alike.
    fn scale(&self, observations: &[Observation]) -> f64 {
        let every = observations.len().div_ceil(50_000).max(1);
        let residuals: Vec<f64> = observations
            .iter()
            .step_by(every)
            .map(|o| o.residual_mm)
            .collect();
        let mut centred = residuals.clone();
        let middle = median(&mut centred);
        let spread: Vec<f64> = residuals.iter().map(|r| r - middle).collect();
        mad_sigma(&residuals)
            .min(2.0 * mad_sigma(&spread) + middle.abs())
            .max(self.scan.noise_mm)
            .max(1e-9 * self.size_mm)
    }

    /// One Gauss-Newton step; `None` for fewer than 20 observations.
    fn solve(&self, observations: &[Observation]) -> Option<Step> {
        if observations.len() < 20 {
            return None;
        }
        let scale = self.scale(observations);
        let weight = |o: &Observation| {
            let ratio = o.residual_mm / (TUKEY * scale);
            if o.u_mm > 0.0 {
                // A touch counts by its own uncertainty, in units of the scan's noise.
                (scale / o.u_mm).powi(2)
            } else if ratio.abs() < 1.0 {
                (1.0 - ratio * ratio).powi(2)
            } else {
                0.0
            }
        };
        let add = |block: &[Observation]| {
            let mut matrix = Matrix6::zeros();
            let mut right = Vector6::zeros();
            let mut weights = Vec::with_capacity(block.len());
            for o in block {
                let w = weight(o);
                let row = o.scaled_row(self.size_mm);
                matrix.ger(w, &row, &row, 1.0);
                right.axpy(-w * o.residual_mm, &row, 1.0);
                weights.push(w);
            }
            (matrix, right, weights)
        };
        let sums: Vec<_> = observations.par_chunks(BLOCK).map(add).collect();
        let mut matrix: Matrix6<f64> = Matrix6::zeros();
        let mut right = Vector6::zeros();
        let mut weights = Vec::with_capacity(observations.len());
        for (m, r, w) in sums {
            matrix += m;
            right += r;
            weights.extend(w);
        }
        let total: f64 = weights.iter().sum();
        for k in (0..6).filter(|k| self.options.held[*k]) {
            matrix.row_mut(k).fill(0.0);
            matrix.column_mut(k).fill(0.0);
            matrix[(k, k)] = HELD * total.max(1.0);
            right[k] = 0.0;
        }
        // All points together hold a weak direction no better than one point straight on would.
        let enough = (total / CHANCE).max(1.0);
        let eigen = SymmetricEigen::new(matrix);
        let mut move_by = Vector6::zeros();
        let mut weak = Vec::new();
        for k in 0..6 {
            let vector = eigen.eigenvectors.column(k).into_owned();
            if eigen.eigenvalues[k] < enough {
                weak.push(vector);
            } else {
                move_by += vector * (vector.dot(&right) / eigen.eigenvalues[k]);
            }
        }
        let mut eigenvalues: [f64; 6] = eigen.eigenvalues.into();
        for value in eigenvalues.iter_mut().filter(|v| **v > 0.5 * HELD * total) {
            *value = f64::INFINITY;
        }
        eigenvalues.sort_unstable_by(f64::total_cmp);
        Some(Step {
            twist: Twist::from_scaled(&move_by, self.size_mm),
            sigma: scale,
            weights,
            matrix,
            eigenvalues,
            weak,
        })
    }

    /// The pose with its covariance, good as far as the fit itself tells.
    fn described(
        &self,
        pose: RigidTransform,
        observations: &[Observation],
        step: &Step,
    ) -> Aligned {
        let (mut sum, mut count) = (0.0, 0);
        for (o, w) in observations.iter().zip(&step.weights) {
            if *w > 0.0 && o.u_mm == 0.0 {
                sum += o.residual_mm.powi(2);
                count += 1;
            }
        }
        Aligned {
            alignment: Alignment {
                part_from_machine: pose,
                rms_mm: (sum / f64::from(count.max(1) as u32)).sqrt(),
                points: count,
                covariance: self.covariance(observations, step),
                weak_directions: twist::words(&self.twists(step), self.size_mm),
                status: Verdict::Ok,
                ..self.unexplained()
            },
            findings: Vec::new(),
            conclusion: Conclusion::Good,
            eigenvalues: step.eigenvalues,
        }
    }

    /// Covariance about the part origin: noise, and what faces and patches of faces share beyond noise.
    fn covariance(&self, observations: &[Observation], step: &Step) -> [[f64; 6]; 6] {
        let mut held = step.matrix;
        for weak in &step.weak {
            // A weak direction is known to the size of the part, and is no part of the fit.
            held += weak * weak.transpose() * 1e12;
        }
        let Some(inverse) = held.try_inverse() else {
            return self.failed(String::new()).alignment.covariance;
        };
        let form_by = |group: fn(&Observation, f64) -> u64| {
            form(
                observations,
                (step, &inverse),
                |o| group(o, self.size_mm),
                self.size_mm,
            )
        };
        // Faces shift, and patches bend and tilt them: the first moves the part, the second turns it.
        let (faces, patches) =
            rayon::join(|| form_by(|o, _| u64::from(o.face)), || form_by(patch_of));
        let mut scaled = inverse * self.white_variance(observations, step) + faces + patches;
        for weak in &step.weak {
            scaled += weak * weak.transpose() * self.size_mm.powi(2);
        }
        let unit = |k: usize| if k < 3 { 1.0 / self.size_mm } else { 1.0 };
        let held = self.options.held;
        std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                if held[i] || held[j] {
                    0.0
                } else {
                    scaled[(i, j)] * unit(i) * unit(j)
                }
            })
        })
    }

    /// Variance of one observation of full weight; Tukey's weights cost 5 % of the information.
    fn white_variance(&self, observations: &[Observation], step: &Step) -> f64 {
        let (mut sum, mut weight) = (0.0, 0.0);
        for (o, w) in observations.iter().zip(&step.weights) {
            if o.u_mm == 0.0 {
                sum += w * o.residual_mm.powi(2);
                weight += w;
            }
        }
        // E[w e^2] / E[w] of Tukey's weights on normal noise is 0.80; the variance of the estimate over sigma^2 / sum(w) is 0.85.
        1.06 * sum / weight.max(1.0)
    }
}

/// Whether two poses differ by more than a motion that the data do not hold.
fn is_different(a: &RigidTransform, b: &RigidTransform, weak: &[Twist], size_mm: f64) -> bool {
    difference(a, b, weak, size_mm).size(size_mm) > 0.1 * size_mm
}

/// The motion from one pose to the other, without what the data do not hold.
fn difference(a: &RigidTransform, b: &RigidTransform, weak: &[Twist], size_mm: f64) -> Twist {
    let mut motion = Twist::logarithm(&(*b * a.inverse()));
    // Out of the motion goes its share along each weak direction; they are orthonormal with rotations counted at the rim.
    for w in weak {
        let dot = motion.turn.dot(w.turn) * size_mm * size_mm + motion.shift.dot(w.shift);
        let norm = w.turn.length_squared() * size_mm * size_mm + w.shift.length_squared();
        motion.turn -= dot / norm * w.turn;
        motion.shift -= dot / norm * w.shift;
    }
    motion
}
