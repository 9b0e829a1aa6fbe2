//! A pose from datum features alone: reference points (RPS, 3-2-1), planes, axes and centres, each nominal with its measured one.
//!
//! ISO 5459 names what a datum feature holds; here every feature contributes the equations of what it holds, weighted by their
//! uncertainties, and the pose is their least-squares solution. Six reference points along three directions are the
//! classical 3-2-1; features may hold more than six equations together, or fewer, and then the free motions are named.
//! Features of a lower priority number hold first, and those after them only what is left free (ISO 5459: primary, secondary, tertiary);
//! features of one number share by their uncertainties.
//! We differ: a datum is the least-squares feature of its points, not the one that touches the material from outside.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, Matrix6, SymmetricEigen, Vector6};

use super::twist::{Twist, words};
use crate::geometry::RigidTransform;

/// A feature of the part, nominal (part frame) and measured (frame of the scan); all in mm, directions of any length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Datum {
    /// A reference point: holds one direction. The measured place may lie anywhere on the surface around it.
    Point {
        /// Nominal place.
        nominal: DVec3,
        /// The direction that it holds, in the part frame.
        direction: DVec3,
        /// Measured place.
        measured: DVec3,
        /// Standard uncertainty along the direction, mm.
        u_mm: f64,
    },
    /// A plane: holds two turns and a shift.
    Plane {
        /// Nominal place and outward normal.
        nominal: [DVec3; 2],
        /// Measured place and outward normal.
        measured: [DVec3; 2],
        /// Standard uncertainty of its place, mm, and of its normal, rad.
        u: [f64; 2],
    },
    /// The axis of a cylinder or cone: holds two turns and two shifts.
    Axis {
        /// Nominal place on it and direction.
        nominal: [DVec3; 2],
        /// Measured place on it and direction; which way it points does not matter.
        measured: [DVec3; 2],
        /// Standard uncertainty of its place, mm, and of its direction, rad.
        u: [f64; 2],
    },
    /// The centre of a sphere, or a corner: holds three shifts.
    Centre {
        /// Nominal place.
        nominal: DVec3,
        /// Measured place.
        measured: DVec3,
        /// Standard uncertainty in any direction, mm.
        u_mm: f64,
    },
}

/// A pose from datum features.
#[derive(Debug, Clone, PartialEq)]
pub struct DatumPose {
    /// The pose.
    pub part_from_machine: RigidTransform,
    /// Covariance of (rotation vector in rad about the part origin, translation in mm) from the features' uncertainties; along what
    /// they leave free it is that of the start, or where none was given the square of the features' extent.
    pub covariance: [[f64; 6]; 6],
    /// What the features leave free, in words; the pose keeps the start's there.
    pub weak_directions: Vec<String>,
    /// By feature: the largest of its residuals over its standard uncertainty.
    pub residuals: Vec<f64>,
}

/// Why datum features make no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DatumError {
    /// A number that is none, a direction without length, or an uncertainty that is not positive.
    #[error(
        "datum {0}: not finite, without a direction or without an uncertainty, expected finite numbers, a direction and an uncertainty above zero; measure it again"
    )]
    Bad(usize),
    /// The features contradict each other so much that no pose is found.
    #[error(
        "datums: no pose after {0} steps, expected features that fit together; check that each is the one it is taken for, and the start"
    )]
    NoPose(usize),
}

const STEPS: usize = 60;

/// The pose that lays the measured features on the nominal ones, all with one priority, from `start`: right to some 60 degrees.
///
/// Residuals of the result tell which features contradict each other; with exactly six equations they are zero.
pub fn pose_from_datums(start: RigidTransform, datums: &[Datum]) -> Result<DatumPose, DatumError> {
    let equal: Vec<(u32, Datum)> = datums.iter().map(|d| (1, *d)).collect();
    pose_from_ordered_datums(start, None, &equal)
}

/// As [`pose_from_datums`], every feature with its priority: 1 holds before 2. The covariance of the start, where it is known, is that of
/// the pose along what the features leave free.
pub fn pose_from_ordered_datums(
    start: RigidTransform,
    start_covariance: Option<&[[f64; 6]; 6]>,
    ordered: &[(u32, Datum)],
) -> Result<DatumPose, DatumError> {
    if let Some(bad) = ordered.iter().position(|(_, d)| !d.is_usable()) {
        return Err(DatumError::Bad(bad));
    }
    let size_mm = extent_mm(ordered);
    let solve = |pose: &RigidTransform| Systems::new(pose, ordered, size_mm).solve();
    let mut pose = start;
    for _ in 0..STEPS {
        let twist = Twist::from_scaled(&solve(&pose).step, size_mm);
        // A wild step of a far start must not turn the part over.
        let share = (0.7 / twist.turn.length().max(1e-30)).min(1.0);
        pose = Twist {
            turn: share * twist.turn,
            shift: if share < 1.0 {
                DVec3::ZERO
            } else {
                twist.shift
            },
        }
        .transform()
            * pose;
        if twist.size(size_mm) < 1e-13 * (size_mm + pose.translation.length()) {
            return Ok(described(pose, start_covariance, ordered, size_mm));
        }
    }
    // Rounding may keep the last steps at a few units of the last place.
    if Twist::from_scaled(&solve(&pose).step, size_mm).size(size_mm) < 1e-9 * size_mm {
        return Ok(described(pose, start_covariance, ordered, size_mm));
    }
    Err(DatumError::NoPose(STEPS))
}

fn described(
    pose: RigidTransform,
    start_covariance: Option<&[[f64; 6]; 6]>,
    ordered: &[(u32, Datum)],
    size_mm: f64,
) -> DatumPose {
    let systems = Systems::new(&pose, ordered, size_mm);
    let Solved {
        covariance, weak, ..
    } = systems.solve();
    let unit = |k: usize| if k < 3 { 1.0 / size_mm } else { 1.0 };
    let free: Matrix6<f64> = weak.iter().map(|w| w * w.transpose()).sum();
    let of_start = match start_covariance {
        Some(c) => Matrix6::from_fn(|i, j| c[i][j] / (unit(i) * unit(j))),
        None => Matrix6::identity() * size_mm.powi(2),
    };
    let scaled = covariance + free * of_start * free;
    let twists: Vec<Twist> = weak
        .iter()
        .map(|w| Twist::from_scaled(w, size_mm))
        .collect();
    DatumPose {
        part_from_machine: pose,
        covariance: std::array::from_fn(|i| {
            std::array::from_fn(|j| scaled[(i, j)] * unit(i) * unit(j))
        }),
        weak_directions: words(&twists, size_mm),
        residuals: systems.worst,
    }
}

/// Half the extent of the nominal places, at least 1 mm.
fn extent_mm(ordered: &[(u32, Datum)]) -> f64 {
    let places = || ordered.iter().map(|(_, d)| d.place());
    let low = places().reduce(DVec3::min).unwrap_or(DVec3::ZERO);
    let high = places().reduce(DVec3::max).unwrap_or(DVec3::ZERO);
    (0.5 * (high - low).length()).max(1.0)
}

/// Normal equations at a pose, in unknowns that are all mm: a matrix and a right side for every priority, the first in front.
struct Systems {
    groups: BTreeMap<u32, (Matrix6<f64>, Vector6<f64>)>,
    worst: Vec<f64>,
}

/// A step with what it is worth.
struct Solved {
    step: Vector6<f64>,
    /// Of the unknowns, without what is weak.
    covariance: Matrix6<f64>,
    /// Unit vectors that no group holds.
    weak: Vec<Vector6<f64>>,
}

impl Systems {
    fn new(pose: &RigidTransform, ordered: &[(u32, Datum)], size_mm: f64) -> Self {
        let mut groups: BTreeMap<u32, (Matrix6<f64>, Vector6<f64>)> = BTreeMap::new();
        let mut all = Vec::with_capacity(ordered.len());
        for (priority, datum) in ordered {
            let (matrix, right) = groups.entry(*priority).or_default();
            let mut worst: f64 = 0.0;
            datum.equations(pose, |turn, shift, residual, u| {
                let lever = turn / size_mm;
                let row = Vector6::new(lever.x, lever.y, lever.z, shift.x, shift.y, shift.z) / u;
                matrix.ger(1.0, &row, &row, 1.0);
                right.axpy(-residual / u, &row, 1.0);
                worst = worst.max((residual / u).abs());
            });
            all.push(worst);
        }
        Self { groups, worst: all }
    }

    /// Group by group: each moves what those before it left free.
    fn solve(&self) -> Solved {
        let mut step = Vector6::zeros();
        let mut covariance = Matrix6::zeros();
        let mut free: Vec<Vector6<f64>> = (0..6)
            .map(|k| Matrix6::identity().column(k).into_owned())
            .collect();
        for (matrix, right) in self.groups.values() {
            if free.is_empty() {
                break;
            }
            let basis = DMatrix::from_fn(6, free.len(), |i, k| free[k][i]);
            let inside = basis.transpose() * matrix * &basis;
            let largest = SymmetricEigen::new(*matrix).eigenvalues.max();
            let eigen = SymmetricEigen::new(inside);
            let mut held = Matrix6::zeros();
            let mut left = Vec::new();
            for k in 0..free.len() {
                let own = &basis * eigen.eigenvectors.column(k);
                let vector = Vector6::from_fn(|i, _| own[i]);
                let value = eigen.eigenvalues[k];
                // Held a thousand times worse than what else the group holds: rounding, or features too close together, or too parallel.
                if value <= 1e-6 * largest || value <= 0.0 {
                    left.push(vector);
                } else {
                    held += vector * vector.transpose() / value;
                }
            }
            step += held * (right - matrix * step);
            let kept = Matrix6::identity() - held * matrix;
            covariance = kept * covariance * kept.transpose() + held;
            free = left;
        }
        Solved {
            step,
            covariance,
            weak: free,
        }
    }
}

impl Datum {
    fn place(&self) -> DVec3 {
        match self {
            Self::Point { nominal, .. } | Self::Centre { nominal, .. } => *nominal,
            Self::Plane { nominal, .. } | Self::Axis { nominal, .. } => nominal[0],
        }
    }

    fn is_usable(&self) -> bool {
        let direction = |v: DVec3| v.is_finite() && v.length() > 1e-12;
        let positive = |u: f64| u.is_finite() && u > 0.0;
        match self {
            Self::Point {
                nominal,
                direction: d,
                measured,
                u_mm,
            } => nominal.is_finite() && measured.is_finite() && direction(*d) && positive(*u_mm),
            Self::Centre {
                nominal,
                measured,
                u_mm,
            } => nominal.is_finite() && measured.is_finite() && positive(*u_mm),
            Self::Plane {
                nominal,
                measured,
                u,
            }
            | Self::Axis {
                nominal,
                measured,
                u,
            } => {
                [nominal, measured]
                    .iter()
                    .all(|f| f[0].is_finite() && direction(f[1]))
                    && u.iter().all(|u| positive(*u))
            }
        }
    }

    /// How far the measured feature lies off the nominal one at `pose`: mm, and for a feature with a direction rad.
    pub fn off(&self, pose: &RigidTransform) -> (f64, Option<f64>) {
        let (mut squares, mut angles) = (0.0, 0.0);
        self.equations(pose, |_, shift, residual, _| {
            if shift == DVec3::ZERO {
                angles += residual * residual;
            } else {
                squares += residual * residual;
            }
        });
        let directed = matches!(self, Self::Plane { .. } | Self::Axis { .. });
        (f64::sqrt(squares), directed.then(|| f64::sqrt(angles)))
    }

    /// Gives every equation to `add`: how turn and shift of the scan change it, its residual, and its standard uncertainty.
    fn equations(&self, pose: &RigidTransform, mut add: impl FnMut(DVec3, DVec3, f64, f64)) {
        let mut along = |p: DVec3, direction: DVec3, target: DVec3, u: f64| {
            add(
                p.cross(direction),
                direction,
                (p - target).dot(direction),
                u,
            );
        };
        match self {
            Self::Point {
                nominal,
                direction,
                measured,
                u_mm,
            } => along(
                pose.point(*measured),
                direction.normalize(),
                *nominal,
                *u_mm,
            ),
            Self::Centre {
                nominal,
                measured,
                u_mm,
            } => {
                for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                    along(pose.point(*measured), axis, *nominal, *u_mm);
                }
            }
            Self::Plane {
                nominal,
                measured,
                u,
            } => {
                let normal = nominal[1].normalize();
                along(pose.point(measured[0]), normal, nominal[0], u[0]);
                let turned = pose.vector(measured[1]).normalize();
                direction_equations(turned, normal, u[1], &mut add);
            }
            Self::Axis {
                nominal,
                measured,
                u,
            } => {
                let axis = nominal[1].normalize();
                let turned = pose.vector(measured[1]).normalize();
                let turned = if turned.dot(axis) < 0.0 {
                    -turned
                } else {
                    turned
                };
                // The place of the measured axis that is level with the nominal one.
                let p = pose.point(measured[0]);
                let slope = turned.dot(axis).max(0.1);
                let p = p + turned * ((nominal[0] - p).dot(axis) / slope);
                let (a, b) = axis.any_orthonormal_pair();
                along(p, a, nominal[0], u[0]);
                along(p, b, nominal[0], u[0]);
                direction_equations(turned, axis, u[1], &mut add);
            }
        }
    }
}

/// Two equations that turn `turned` onto `wanted`.
fn direction_equations(
    turned: DVec3,
    wanted: DVec3,
    u_rad: f64,
    add: &mut impl FnMut(DVec3, DVec3, f64, f64),
) {
    let (a, b) = wanted.any_orthonormal_pair();
    let between = DQuat::from_rotation_arc(wanted, turned).to_scaled_axis();
    for axis in [a, b] {
        // Turning the scan about `axis` adds to the angle about it.
        add(axis, DVec3::ZERO, between.dot(axis), u_rad);
    }
}
