//! A pose from datum features alone: reference points (RPS, 3-2-1), planes, axes and centres, each nominal with its measured one.
//!
//! ISO 5459 names what a datum feature holds; here every feature contributes the equations of what it holds, weighted by their
//! uncertainties, and the pose is their least-squares solution. Six reference points along three directions are the
//! classical 3-2-1; features may hold more than six equations together, or fewer, and then the free motions are named.
//! We differ: datums have no precedence; a primary datum is given it by a small uncertainty.

use glam::{DQuat, DVec3};
use nalgebra::{Matrix6, SymmetricEigen, Vector6};

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
    /// they leave free it is the square of the features' extent.
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

/// The pose that lays the measured features on the nominal ones, from `start`: right to some 60 degrees.
///
/// Residuals of the result tell which features contradict each other; with exactly six equations they are zero.
pub fn pose_from_datums(start: RigidTransform, datums: &[Datum]) -> Result<DatumPose, DatumError> {
    if let Some(bad) = datums.iter().position(|d| !d.is_usable()) {
        return Err(DatumError::Bad(bad));
    }
    let size_mm = extent_mm(datums);
    let mut pose = start;
    for _ in 0..STEPS {
        let system = System::new(&pose, datums, size_mm);
        let (step, _) = system.solve();
        let twist = Twist::from_scaled(&step, size_mm);
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
            return Ok(described(pose, datums, size_mm));
        }
    }
    // Rounding may keep the last steps at a few units of the last place.
    let system = System::new(&pose, datums, size_mm);
    if Twist::from_scaled(&system.solve().0, size_mm).size(size_mm) < 1e-9 * size_mm {
        return Ok(described(pose, datums, size_mm));
    }
    Err(DatumError::NoPose(STEPS))
}

fn described(pose: RigidTransform, datums: &[Datum], size_mm: f64) -> DatumPose {
    let system = System::new(&pose, datums, size_mm);
    let (_, weak) = system.solve();
    let mut matrix = system.matrix;
    for w in &weak {
        matrix += w * w.transpose() / size_mm.powi(2);
    }
    let inverse = matrix.try_inverse().unwrap_or_else(Matrix6::zeros);
    let unit = |k: usize| if k < 3 { 1.0 / size_mm } else { 1.0 };
    let twists: Vec<Twist> = weak
        .iter()
        .map(|w| Twist::from_scaled(w, size_mm))
        .collect();
    DatumPose {
        part_from_machine: pose,
        covariance: std::array::from_fn(|i| {
            std::array::from_fn(|j| inverse[(i, j)] * unit(i) * unit(j))
        }),
        weak_directions: words(&twists, size_mm),
        residuals: system.worst,
    }
}

/// Half the extent of the nominal places, at least 1 mm.
fn extent_mm(datums: &[Datum]) -> f64 {
    let places = || datums.iter().map(Datum::place);
    let low = places().reduce(DVec3::min).unwrap_or(DVec3::ZERO);
    let high = places().reduce(DVec3::max).unwrap_or(DVec3::ZERO);
    (0.5 * (high - low).length()).max(1.0)
}

/// Normal equations at a pose, in unknowns that are all mm.
struct System {
    matrix: Matrix6<f64>,
    right: Vector6<f64>,
    worst: Vec<f64>,
    size_mm: f64,
}

impl System {
    fn new(pose: &RigidTransform, datums: &[Datum], size_mm: f64) -> Self {
        let mut system = Self {
            matrix: Matrix6::zeros(),
            right: Vector6::zeros(),
            worst: Vec::with_capacity(datums.len()),
            size_mm,
        };
        for datum in datums {
            let mut worst: f64 = 0.0;
            datum.equations(pose, |turn, shift, residual, u| {
                let lever = turn / system.size_mm;
                let row = Vector6::new(lever.x, lever.y, lever.z, shift.x, shift.y, shift.z) / u;
                system.matrix.ger(1.0, &row, &row, 1.0);
                system.right.axpy(-residual / u, &row, 1.0);
                worst = worst.max((residual / u).abs());
            });
            system.worst.push(worst);
        }
        system
    }

    /// The step along what the features hold, and what they do not.
    fn solve(&self) -> (Vector6<f64>, Vec<Vector6<f64>>) {
        let eigen = SymmetricEigen::new(self.matrix);
        let largest = eigen.eigenvalues.max();
        let mut step = Vector6::zeros();
        let mut weak = Vec::new();
        for k in 0..6 {
            let vector = eigen.eigenvectors.column(k).into_owned();
            let value = eigen.eigenvalues[k];
            // Held a thousand times worse than anything sensible: rounding, or features too close together.
            if value <= 1e-9 * largest || value <= 0.0 {
                weak.push(vector);
            } else {
                step += vector * (vector.dot(&self.right) / value);
            }
        }
        (step, weak)
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
