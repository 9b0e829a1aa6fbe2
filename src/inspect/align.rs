//! How a scan lies in the part frame: a least-squares pose on the exact faces of the nominal, with its covariance.
//!
//! Points are paired with the foot of their perpendicular on the nearest face that is seen from the sensor's side; the
//! pose is the robust least-squares solution of the signed distances (Gauss-Newton with Tukey's weights). Then each face
//! and each patch of a face is asked whether it departs from its nominal by more than noise, and the covariance grows by
//! what is found. Directions that the data do not hold are left alone and named.

mod search;
mod twist;

use std::collections::BTreeMap;

use glam::DVec3;
use nalgebra::{Matrix6, SymmetricEigen, Vector6};
use rayon::prelude::*;

use super::assign::{NO_FACE, Surface, towards};
use super::body::Body;
use super::clusters::SIGNIFICANT;
use super::measure::pose_row;
use super::result::{Alignment, Verdict};
use crate::geometry::RigidTransform;
use crate::geometry::fit::{mad_sigma, median};
use crate::points::{Neighbors, PointCloud, Spacing};

pub use twist::Twist;

/// Points of the final fit: more do not make the pose better than the form of the faces allows.
const FINAL_POINTS: usize = 20_000;

/// Points of the coarse steps.
const COARSE_POINTS: usize = 2_000;

/// Tukey's constant: 95 % efficient on normal noise.
const TUKEY: f64 = 4.685;

const TOO_FEW: &str = "alignment: fewer than 20 points lie near the nominal, expected most of the scan; give a better start";

/// What is known of the pose beforehand.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Start {
    /// The scan lies in the part frame already.
    None,
    /// Roughly: right to a tenth of the part's size and some 20 degrees.
    Rough(RigidTransform),
    /// Nothing.
    #[default]
    Auto,
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
    /// Contacts of a probe, as further observations.
    pub touches: &'a [Touch],
}

/// A pose with what is to be said of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    /// The pose and its covariance.
    pub alignment: Alignment,
    /// Why it is not decidable, and what was peculiar.
    pub findings: Vec<String>,
}

/// The pose of `cloud` on the nominal, from `start`.
///
/// The result is `NotDecidable` where the search failed, where several poses fit equally well, or where the data leave a
/// direction free that moves a sharp edge.
pub fn align<B: Body>(
    scan: &Scan<'_>,
    surface: &Surface<'_, B>,
    start: Start,
    options: &AlignOptions<'_>,
) -> Aligned {
    let task = Task {
        scan,
        surface,
        options,
        size_mm: size(surface.body),
    };
    match start {
        Start::None => task.as_it_lies(),
        Start::Rough(pose) => task.refine_and_judge(pose, Vec::new()),
        Start::Auto => match search::search(scan, surface) {
            Some(found) => {
                let mut aligned = task.refine_and_judge(found.pose, found.findings);
                if found.ambiguous {
                    aligned.alignment.status = Verdict::NotDecidable;
                }
                aligned
            }
            None => task.failed(
                "alignment: no pose of the scan fits the nominal; give a rough start".to_string(),
            ),
        },
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

fn size<B: Body>(body: &B) -> f64 {
    let [low, high] = body.bounds();
    (0.5 * (high - low).length()).max(1e-9)
}

/// One observation: the direction in which the pose moves it, its residual and weight, and which face it lies on.
#[derive(Debug, Clone, Copy)]
struct Observation {
    row: [f64; 6],
    residual_mm: f64,
    face: u32,
    point: DVec3,
    /// Of a touch: its own standard deviation; of a scan point 0.
    u_mm: f64,
}

struct Task<'a, B: Body> {
    scan: &'a Scan<'a>,
    surface: &'a Surface<'a, B>,
    options: &'a AlignOptions<'a>,
    size_mm: f64,
}

impl<B: Body> Task<'_, B> {
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
            },
            findings: vec![finding],
        }
    }

    /// The identity, taken as exact, with the residuals it leaves.
    fn as_it_lies(&self) -> Aligned {
        let indices = self.scan.subset(FINAL_POINTS);
        let observations = self.observe(&RigidTransform::IDENTITY, &indices, 0.1 * self.size_mm);
        let sum: f64 = observations.iter().map(|o| o.residual_mm.powi(2)).sum();
        Aligned {
            alignment: Alignment {
                part_from_machine: RigidTransform::IDENTITY,
                rms_mm: (sum / observations.len().max(1) as f64).sqrt(),
                points: observations.len(),
                covariance: [[0.0; 6]; 6],
                weak_directions: Vec::new(),
                status: Verdict::Ok,
            },
            findings: Vec::new(),
        }
    }

    /// The scan points `indices` on the faces that hold the pose, and the touches.
    fn observe(&self, pose: &RigidTransform, indices: &[u32], gate_mm: f64) -> Vec<Observation> {
        let cloud = self.scan.cloud;
        let holds = |face: u32| {
            face != NO_FACE
                && (self.options.datum_faces.is_empty() || self.options.datum_faces.contains(&face))
        };
        let of = |point: DVec3, view: Option<DVec3>, u_mm: f64, found: &mut Vec<(u32, f64)>| {
            let p = pose.point(point);
            let view = view.map(|v| pose.vector(v));
            let place = self.surface.place(p, view, gate_mm, found);
            holds(place.face).then(|| Observation {
                row: pose_row(p, place.normal),
                residual_mm: place.deviation_mm,
                face: place.face,
                point: p,
                u_mm,
            })
        };
        let mut observations: Vec<Observation> = indices
            .par_iter()
            .map_init(Vec::new, |found, i| {
                let i = *i as usize;
                of(cloud.positions[i], towards(cloud, i), 0.0, found)
            })
            .flatten_iter()
            .collect();
        let mut found = Vec::new();
        for touch in self.options.touches {
            observations.extend(of(touch.point, None, touch.u_mm, &mut found));
        }
        observations
    }

    /// Follows the pose down, coarse to fine, and says how well it is known.
    fn refine_and_judge(&self, start: RigidTransform, findings: Vec<String>) -> Aligned {
        let Some((mut pose, _)) = self.coarse(start, (COARSE_POINTS, 30)) else {
            return self.failed(TOO_FEW.to_string());
        };
        let fine = self.scan.subset(FINAL_POINTS);
        // Wide enough that a face which is off stays in sight and is counted as form.
        let gate = (0.05 * self.size_mm).max(10.0 * self.scan.noise_mm);
        let mut last = None;
        for _ in 0..12 {
            let observations = self.observe(&pose, &fine, gate);
            let Some(step) = self.solve(&observations) else {
                return self.failed(
                    "alignment: too few points near the nominal; give a better start".to_string(),
                );
            };
            pose = step.twist.transform() * pose;
            let moved = step.twist.size(self.size_mm);
            last = Some((observations, step));
            if moved < 5e-3 * self.scan.noise_mm.max(1e-9 * self.size_mm) {
                break;
            }
        }
        match last {
            Some((observations, step)) => self.judge(pose, &observations, &step, findings),
            None => self.failed("alignment: no step was made".to_string()),
        }
    }

    /// The pose that a few points settle on from `start`, and the directions that they do not hold.
    ///
    /// `effort` is the number of points and of steps at most.
    fn coarse(
        &self,
        start: RigidTransform,
        effort: (usize, usize),
    ) -> Option<(RigidTransform, Vec<Twist>)> {
        let few = self.scan.subset(effort.0);
        let mut pose = start;
        let mut weak = Vec::new();
        let mut gate = 0.3 * self.size_mm;
        let noise = self.scan.noise_mm.max(1e-6 * self.size_mm);
        // The gate narrows to where only the part itself is left: fixtures and reflections lie further away.
        for _ in 0..effort.1 {
            let step = self.solve(&self.observe(&pose, &few, gate))?;
            pose = step.twist.transform() * pose;
            gate = (0.7 * gate)
                .max(6.0 * step.sigma)
                .max(10.0 * noise)
                .max(0.01 * self.size_mm);
            weak = self.twists(&step);
            if step.twist.size(self.size_mm) < 0.1 * noise {
                break;
            }
        }
        Some((pose, weak))
    }

    fn twists(&self, step: &Step) -> Vec<Twist> {
        let scaling = self.scaling();
        step.weak
            .iter()
            .map(|v| Twist::from_array(std::array::from_fn(|k| v[k] * scaling[k])))
            .collect()
    }

    /// One Gauss-Newton step; `None` for fewer than 20 observations.
    fn solve(&self, observations: &[Observation]) -> Option<Step> {
        if observations.len() < 20 {
            return None;
        }
        let residuals: Vec<f64> = observations.iter().map(|o| o.residual_mm).collect();
        let mut centred = residuals.clone();
        let middle = median(&mut centred);
        let spread: Vec<f64> = residuals.iter().map(|r| r - middle).collect();
        let scale = mad_sigma(&residuals)
            .min(2.0 * mad_sigma(&spread) + middle.abs())
            .max(self.scan.noise_mm)
            .max(1e-9 * self.size_mm);
        let weight = |o: &Observation| {
            let ratio = o.residual_mm / (TUKEY * scale);
            let robust = if ratio.abs() < 1.0 {
                (1.0 - ratio * ratio).powi(2)
            } else {
                0.0
            };
            if o.u_mm > 0.0 {
                // A touch counts by its own uncertainty, in units of the scan's noise.
                (scale / o.u_mm).powi(2)
            } else {
                robust
            }
        };
        let weights: Vec<f64> = observations.iter().map(weight).collect();
        let mut matrix = Matrix6::zeros();
        let mut right = Vector6::zeros();
        let scaling = self.scaling();
        for (o, w) in observations.iter().zip(&weights) {
            let row = Vector6::from_fn(|k, _| o.row[k] * scaling[k]);
            matrix += *w * row * row.transpose();
            right -= *w * o.residual_mm * row;
        }
        let eigen = SymmetricEigen::new(matrix);
        let mut move_by = Vector6::zeros();
        let mut weak = Vec::new();
        for k in 0..6 {
            let vector = eigen.eigenvectors.column(k).into_owned();
            // All points together hold this direction no better than one point straight on would.
            if eigen.eigenvalues[k] < 1.0 {
                weak.push(vector);
            } else {
                move_by += vector * (vector.dot(&right) / eigen.eigenvalues[k]);
            }
        }
        let unscaled: [f64; 6] = std::array::from_fn(|k| move_by[k] * scaling[k]);
        Some(Step {
            twist: Twist::from_array(unscaled),
            sigma: scale,
            weights,
            matrix,
            weak,
        })
    }

    /// Rotations are counted by what they move at the rim of the part, so that all six unknowns are mm.
    fn scaling(&self) -> [f64; 6] {
        std::array::from_fn(|k| if k < 3 { 1.0 / self.size_mm } else { 1.0 })
    }

    fn judge(
        &self,
        pose: RigidTransform,
        observations: &[Observation],
        step: &Step,
        mut findings: Vec<String>,
    ) -> Aligned {
        let covariance = self.covariance(observations, step);
        let twists = self.twists(step);
        let weak_directions: Vec<String> = twist::words(&twists, self.size_mm);
        let mut status = Verdict::Ok;
        if let Some(id) = self.moved_edge(&twists) {
            status = Verdict::NotDecidable;
            findings.push(format!(
                "alignment: the data do not hold {}, which moves edge {id}; scan another face",
                weak_directions.join(", ")
            ));
        }
        let used = |o: &&(usize, &Observation)| step.weights[o.0] > 0.0 && o.1.u_mm == 0.0;
        let (mut sum, mut count) = (0.0, 0);
        for (_, o) in observations.iter().enumerate().filter(|o| used(&o)) {
            sum += o.residual_mm.powi(2);
            count += 1;
        }
        // Half of the scan lies elsewhere: what was found is not this part, or not this place.
        if count * 2 < self.scan.subset(FINAL_POINTS).len() && self.options.datum_faces.is_empty() {
            status = Verdict::NotDecidable;
            findings.push(format!(
                "alignment: only {count} of {} points lie near the nominal, expected more than half; check part and start",
                self.scan.subset(FINAL_POINTS).len()
            ));
        }
        Aligned {
            alignment: Alignment {
                part_from_machine: pose,
                rms_mm: (sum / f64::from(count.max(1) as u32)).sqrt(),
                points: count,
                covariance,
                weak_directions,
                status,
            },
            findings,
        }
    }

    /// A sharp edge that a motion of one mm at the rim along a weak direction moves by more than 0.02 mm across.
    fn moved_edge(&self, weak: &[Twist]) -> Option<String> {
        let edges = self.surface.body.edges();
        for (e, edge) in edges.iter().enumerate() {
            for share in [0.1, 0.5, 0.9] {
                let station = self.surface.body.station(e, share * edge.length_mm);
                for normal in station.normals {
                    let row = pose_row(station.point, normal);
                    if weak.iter().any(|w| w.along(&row).abs() > 0.02) {
                        return Some(edge.id.clone());
                    }
                }
            }
        }
        None
    }

    /// Covariance about the part origin: noise, and what faces and patches of faces share beyond noise.
    fn covariance(&self, observations: &[Observation], step: &Step) -> [[f64; 6]; 6] {
        let scaling = self.scaling();
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
                &scaling,
            )
        };
        // Faces shift, and patches bend and tilt them: the first moves the part, the second turns it.
        let faces = form_by(|o, _| u64::from(o.face));
        let patches = form_by(patch_of);
        let mut scaled = inverse * self.white_variance(observations, step) + faces + patches;
        for weak in &step.weak {
            scaled += weak * weak.transpose() * self.size_mm.powi(2);
        }
        std::array::from_fn(|i| std::array::from_fn(|j| scaled[(i, j)] * scaling[i] * scaling[j]))
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

/// The patch of its face that an observation lies on, a third of the part's half-diagonal wide.
fn patch_of(o: &Observation, size_mm: f64) -> u64 {
    let foot = o.point - o.residual_mm * DVec3::new(o.row[3], o.row[4], o.row[5]);
    // Shifted off the planes through the origin, on which the foot's rounding would choose the cell.
    let cell = (3.0 * foot / size_mm + 0.377).floor().as_i64vec3();
    let place = (cell.x.wrapping_mul(0x1F_FFF7) ^ cell.y.wrapping_mul(0x3F_FF1D)) ^ cell.z;
    u64::from(o.face) << 40 | (place as u64 & 0xFF_FFFF_FFFF)
}

/// Variance of the median of normal noise over that of the mean: pi / 2.
const MEDIAN_VARIANCE: f64 = std::f64::consts::FRAC_PI_2;

/// What the pose may be off because faces, or patches of them, depart from the nominal by amounts that nobody knows.
///
/// Every group is taken to be shifted at random; the variance of the shifts is estimated from the median residuals of *all*
/// groups, those that the robust fit turned down included: which of two opposite faces is off cannot be told from the scan.
/// The median, because the points of an edge break or of the spot's smear at a face's rim are no shift of the face.
/// Where no group is redundant (three datum faces) the shifts cannot be seen, and the groups define the frame.
fn form(
    observations: &[Observation],
    (step, inverse): (&Step, &Matrix6<f64>),
    group: impl Fn(&Observation) -> u64,
    scaling: &[f64; 6],
) -> Matrix6<f64> {
    // By group: weighted sum of rows, sum of weights, residuals.
    let mut groups: BTreeMap<u64, (Vector6<f64>, f64, Vec<f64>)> = BTreeMap::new();
    for (o, w) in observations.iter().zip(&step.weights) {
        if o.u_mm > 0.0 {
            continue;
        }
        let entry = groups.entry(group(o)).or_default();
        entry.0 += *w * Vector6::from_fn(|k, _| o.row[k] * scaling[k]);
        entry.1 += w;
        entry.2.push(o.residual_mm);
    }
    let total = observations.len() as f64;
    let (mut square, mut expected, mut freedom) = (0.0, 0.0, 0.0);
    let mut scatter = Matrix6::zeros();
    for (rows, weight, residuals) in groups.values_mut() {
        scatter += *rows * rows.transpose();
        let count = residuals.len() as f64;
        // A handful of stray points is no face.
        if count < 20.0f64.max(0.002 * total) {
            continue;
        }
        let middle = median(residuals);
        let sigma = mad_sigma(residuals);
        let leverage = (rows.transpose() * inverse * *rows)[0] / weight.max(1e-9);
        let left = (1.0 - leverage).clamp(0.0, 1.0);
        square += middle * middle;
        expected += left * MEDIAN_VARIANCE * sigma * sigma / count;
        freedom += left;
    }
    let excess = square - expected;
    if freedom < 0.5 || excess < SIGNIFICANT * expected * (2.0 / freedom).sqrt() {
        return Matrix6::zeros();
    }
    inverse * scatter * inverse * (excess / freedom)
}

/// A Gauss-Newton step.
struct Step {
    twist: Twist,
    sigma: f64,
    weights: Vec<f64>,
    /// Normal matrix in scaled unknowns.
    matrix: Matrix6<f64>,
    /// Unit vectors, in scaled unknowns, that the data do not hold.
    weak: Vec<Vector6<f64>>,
}
