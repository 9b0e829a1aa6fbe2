//! How a scan lies in the part frame: a least-squares pose on the exact faces of the nominal, with its covariance.
//!
//! Points are paired with the foot of their perpendicular on the nearest face that is seen from the sensor's side; the
//! pose is the robust least-squares solution of the signed distances (Gauss-Newton with Tukey's weights). Then each face
//! and each patch of a face is asked whether it departs from its nominal by more than noise, and the covariance grows by
//! what is found. Directions that the data do not hold are left alone and named.

mod search;
mod twist;

use glam::DVec3;
use nalgebra::{Matrix6, SymmetricEigen, Vector6};
use rayon::prelude::*;

use super::assign::{NO_FACE, Surface, towards};
use super::body::Body;
use super::clusters::Clusters;
use super::measure::pose_row;
use super::result::{Alignment, Verdict};
use crate::geometry::RigidTransform;
use crate::geometry::fit::{LinearFit, mad_sigma, median};
use crate::points::{Neighbors, PointCloud, Spacing};

pub use twist::Twist;

/// Points of the final fit: more do not make the pose better than the form of the faces allows.
const FINAL_POINTS: usize = 40_000;

/// Points of the coarse steps.
const COARSE_POINTS: usize = 2_000;

/// Tukey's constant: 95 % efficient on normal noise.
const TUKEY: f64 = 4.685;

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
        let coarse = self.scan.subset(COARSE_POINTS);
        let fine = self.scan.subset(FINAL_POINTS);
        let mut pose = start;
        let mut gate = 0.3 * self.size_mm;
        // The gate narrows to where only the part itself is left: fixtures and reflections lie further away.
        for _ in 0..30 {
            let observations = self.observe(&pose, &coarse, gate);
            let Some(step) = self.solve(&observations) else {
                return self.failed(
                    "alignment: too few points near the nominal; give a better start".to_string(),
                );
            };
            pose = step.twist.transform() * pose;
            let wanted = (6.0 * step.sigma).max(10.0 * self.scan.noise_mm);
            gate = (0.7 * gate).max(wanted.max(0.01 * self.size_mm));
            if step.twist.size(self.size_mm) < 0.1 * self.scan.noise_mm.max(1e-6 * self.size_mm) {
                break;
            }
        }
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
            if moved < 1e-3 * self.scan.noise_mm.max(1e-9 * self.size_mm) {
                break;
            }
        }
        match last {
            Some((observations, step)) => self.judge(pose, &observations, &step, findings),
            None => self.failed("alignment: no step was made".to_string()),
        }
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
        let scaling = self.scaling();
        let twists: Vec<Twist> = step
            .weak
            .iter()
            .map(|v| Twist::from_array(std::array::from_fn(|k| v[k] * scaling[k])))
            .collect();
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
        let cofactor: [[f64; 6]; 6] =
            std::array::from_fn(|i| std::array::from_fn(|j| inverse[(i, j)]));
        let fit = LinearFit {
            coefficients: [0.0; 6],
            cofactor,
            residual_sum: 0.0,
            used: observations.len(),
        };
        let patch_mm = self.size_mm / 3.0;
        let groups = |by_patch: bool| {
            let samples = observations
                .iter()
                .zip(&step.weights)
                .filter_map(move |(o, w)| {
                    if *w <= 0.0 || o.u_mm > 0.0 {
                        return None;
                    }
                    let cell = (o.point / patch_mm).floor().as_i64vec3();
                    let patch = (cell.x * 31 + cell.y) * 31 + cell.z;
                    let group = if by_patch {
                        o.face.wrapping_mul(100_003).wrapping_add(patch as u32) >> 1
                    } else {
                        o.face
                    };
                    let root = w.sqrt();
                    let row = std::array::from_fn(|k| root * o.row[k] * scaling[k]);
                    Some((group, row, root * o.residual_mm))
                });
            Clusters::<6>::new(samples, &fit)
        };
        let faces = groups(false);
        let patches = groups(true);
        let component = |c: &Clusters<6>| c.components().map_or(0.0, |(_, shared)| shared);
        let grown = |c: &Clusters<6>| {
            let scatter = Matrix6::from_fn(|i, j| c.scatter[i][j]);
            component(c) * inverse * scatter * inverse
        };
        let (by_face, by_patch) = (grown(&faces), grown(&patches));
        let form = if by_face.trace() > by_patch.trace() {
            by_face
        } else {
            by_patch
        };
        let white = self.white_variance(observations, step);
        let mut scaled = inverse * white + form;
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
