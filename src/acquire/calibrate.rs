//! Calibration: where a profiler stands, how the stage runs, how large a probe's tip is, how square the axes are.
//!
//! Reference spheres are the artefact, because they look the same from everywhere. A profiler scans spheres whose centres are known
//! in the machine (touched by the probe, or certified); what is sought makes every scanned point lie one radius from its centre.

use acies_drivers::capture::Profile;
use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};

use super::Calibration;
use crate::geometry::RigidTransform;
use crate::geometry::sphere::{SphereFit, find_sphere, fit_sphere};

/// A reference sphere as scanned by the profiler that is to be calibrated.
#[derive(Debug, Clone)]
pub struct SphereScan {
    /// The profiles, as delivered.
    pub profiles: Vec<Profile>,
    /// Centre in the machine, mm.
    pub centre_mm: DVec3,
    /// Standard uncertainty of each of its coordinates, mm.
    pub u_centre_mm: f64,
    /// Certified radius, mm.
    pub radius_mm: f64,
}

/// A profiler's calibration with what can be said for it.
#[derive(Debug, Clone, PartialEq)]
pub struct ProfilerCalibration {
    /// Pose and travel.
    pub calibration: Calibration,
    /// Covariance of (rotation vector in the machine's axes about the sensor's origin, rad; position, mm; travel, mm per 1000 counts).
    pub covariance: [[f64; 9]; 9],
    /// Root mean square of the radial residuals of the points, mm.
    pub rms_mm: f64,
    /// One a sphere: points used, mean and root mean square of their radial residuals, mm.
    pub spheres: Vec<SphereResidual>,
}

/// What one sphere leaves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SphereResidual {
    /// Points used.
    pub points: usize,
    /// Mean radial residual, mm: the size error of this sphere.
    pub mean_mm: f64,
    /// Root mean square, mm.
    pub rms_mm: f64,
}

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// The sphere is not in the scan.
    #[error(
        "sphere {sphere}: no sphere of radius {radius_mm} mm among {points} points, expected one; check the radius and that the scan shows its cap"
    )]
    NotFound {
        /// Number of the scan, from 1.
        sphere: usize,
        /// Its radius.
        radius_mm: f64,
        /// Points looked at.
        points: usize,
    },
    /// The scans leave a direction open.
    #[error(
        "{spheres} spheres leave {direction} open (standard uncertainty {u}); scan the sphere at more places, not on one line"
    )]
    Open {
        /// How many there were.
        spheres: usize,
        /// What is not held, in words.
        direction: String,
        /// Its standard uncertainty, with its unit.
        u: String,
    },
    /// The passes say nothing of the lag.
    #[error(
        "the lag stays open (standard uncertainty {u_s:.1e} s, at most {most_s} s is allowed); go over the sphere, or over a plate inclined to the path, to and fro"
    )]
    LagOpen {
        /// Standard uncertainty of a pass, s.
        u_s: f64,
        /// The most that is allowed, s.
        most_s: f64,
    },
    /// The iteration went nowhere.
    #[error(
        "the calibration does not settle: residuals of {rms_mm} mm, expected those of the sensor's noise; check that scans and centres belong together"
    )]
    Unsettled {
        /// What was left, mm.
        rms_mm: f64,
    },
    /// Too little was given.
    #[error("{found} {what}, expected at least {needed}")]
    TooFew {
        /// What is counted.
        what: &'static str,
        /// How many there were.
        found: usize,
        /// How many it takes.
        needed: usize,
    },
}

/// Least rotation and position that a calibration must hold: beyond a mrad or 50 um (standard uncertainties) no edge is measured to
/// a tenth of a millimetre over the depth of a sensor.
const OPEN_RAD: f64 = 1e-3;
const OPEN_MM: f64 = 0.05;

/// Unit of travel: a count is too little beside a millimetre.
const COUNTS: f64 = 1000.0;

/// Points of one sphere, as seen by the sensor.
struct Seen {
    /// In the sensor, with the encoder in thousands of counts.
    points: Vec<(DVec3, f64)>,
}

/// The calibration that puts every scanned point one radius from its sphere's centre, starting from `rough`.
///
/// Unknowns are the pose (6), the travel (3), and the centres, which are held by what is known of them. Gauss-Newton; the points of each
/// sphere are found with the rough calibration, which may be off by a quarter of the radius within a scan.
///
/// # Errors
/// [`CalibrateError`]: a sphere that is not in its scan, a direction that the spheres leave open, an iteration that does not settle.
pub fn calibrate_profiler(
    scans: &[SphereScan],
    rough: &Calibration,
    noise_mm: f64,
) -> Result<ProfilerCalibration, CalibrateError> {
    if scans.is_empty() {
        return Err(CalibrateError::TooFew {
            what: "scans of a sphere",
            found: 0,
            needed: 1,
        });
    }
    let seen: Vec<Seen> = scans
        .iter()
        .enumerate()
        .map(|(k, scan)| find_points(k, scan, rough, noise_mm))
        .collect::<Result<_, _>>()?;
    let mut state = State {
        calibration: *rough,
        centres: scans.iter().map(|scan| scan.centre_mm).collect(),
    };
    state.shift_onto(scans, &seen);
    let mut last = f64::INFINITY;
    for _ in 0..60 {
        let system = System::new(&state, scans, &seen, noise_mm);
        let Some(step) = system.solve() else { break };
        state.apply(&step);
        if (last - system.cost).abs() < 1e-12 * system.cost.max(1e-12) {
            break;
        }
        last = system.cost;
    }
    report(&state, scans, &seen, noise_mm)
}

fn find_points(
    index: usize,
    scan: &SphereScan,
    rough: &Calibration,
    noise_mm: f64,
) -> Result<Seen, CalibrateError> {
    let mut all = Vec::new();
    for profile in &scan.profiles {
        let Some(encoder) = profile.encoder else {
            continue;
        };
        for (x, z) in profile.x_mm.iter().zip(&profile.z_mm) {
            if x.is_finite() && z.is_finite() {
                all.push((DVec3::new(*x, 0.0, *z), encoder as f64 / COUNTS));
            }
        }
    }
    let placed: Vec<DVec3> = all.iter().map(|(p, e)| place(rough, *p, *e)).collect();
    // A rough pose makes an ellipsoid of the sphere: the tolerance is that of a turn of two degrees.
    let tolerance = (0.035 * scan.radius_mm).max(8.0 * noise_mm);
    let fit = find_sphere(&placed, scan.radius_mm, tolerance);
    let fit = fit.filter(|fit| fit.used.len() >= 30).ok_or({
        CalibrateError::NotFound {
            sphere: index + 1,
            radius_mm: scan.radius_mm,
            points: placed.len(),
        }
    })?;
    let points = fit.used.iter().map(|i| all[*i as usize]).collect();
    Ok(Seen { points })
}

fn place(calibration: &Calibration, in_sensor: DVec3, thousands: f64) -> DVec3 {
    calibration.machine_from_sensor.point(in_sensor)
        + calibration.travel_mm_per_count * (COUNTS * thousands)
}

/// Unknowns as they stand.
struct State {
    calibration: Calibration,
    centres: Vec<DVec3>,
}

impl State {
    /// Moves the sensor so that the scanned spheres lie at their centres on the average: the pose may be off by more than a radius.
    fn shift_onto(&mut self, scans: &[SphereScan], seen: &[Seen]) {
        let mut shift = DVec3::ZERO;
        for (scan, seen) in scans.iter().zip(seen) {
            let placed: Vec<DVec3> = seen
                .points
                .iter()
                .map(|(p, e)| place(&self.calibration, *p, *e))
                .collect();
            if let Some(fit) = fit_sphere(&placed) {
                shift += (scan.centre_mm - fit.centre) / scans.len() as f64;
            }
        }
        self.calibration.machine_from_sensor.translation += shift;
    }

    fn apply(&mut self, step: &DVector<f64>) {
        let at = |k: usize| DVec3::new(step[k], step[k + 1], step[k + 2]);
        let pose = self.calibration.machine_from_sensor;
        self.calibration.machine_from_sensor = RigidTransform::new(
            (DQuat::from_scaled_axis(at(0)) * pose.rotation).normalize(),
            pose.translation + at(3),
        );
        self.calibration.travel_mm_per_count += at(6) / COUNTS;
        for (k, centre) in self.centres.iter_mut().enumerate() {
            *centre += at(9 + 3 * k);
        }
    }
}

/// Normal equations at a state.
struct System {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    cost: f64,
}

impl System {
    fn new(state: &State, scans: &[SphereScan], seen: &[Seen], noise_mm: f64) -> Self {
        let size = 9 + 3 * scans.len();
        let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
        let mut cost = 0.0;
        let weight = noise_mm.max(1e-9).powi(-2);
        for (k, (scan, seen)) in scans.iter().zip(seen).enumerate() {
            for (p, thousands) in &seen.points {
                let placed = place(&state.calibration, *p, *thousands);
                let arm = state.calibration.machine_from_sensor.vector(*p);
                let outward = (placed - state.centres[k]).normalize_or_zero();
                let residual = placed.distance(state.centres[k]) - scan.radius_mm;
                let turn = arm.cross(outward);
                let travel = outward * *thousands;
                let row = [turn, outward, travel].map(|v| v.to_array());
                let columns = (0..9).chain(9 + 3 * k..12 + 3 * k);
                let entries: Vec<(usize, f64)> = columns
                    .zip(row.into_iter().flatten().chain((-outward).to_array()))
                    .collect();
                for (i, a) in &entries {
                    for (j, b) in &entries {
                        matrix[(*i, *j)] += weight * a * b;
                    }
                    right[*i] -= weight * a * residual;
                }
                cost += weight * residual * residual;
            }
            let known = scan.u_centre_mm.max(1e-6).powi(-2);
            let off = state.centres[k] - scan.centre_mm;
            for (axis, off) in off.to_array().into_iter().enumerate() {
                let i = 9 + 3 * k + axis;
                matrix[(i, i)] += known;
                right[i] -= known * off;
                cost += known * off * off;
            }
        }
        Self {
            matrix,
            right,
            cost,
        }
    }

    /// A little damping keeps what is open where it is.
    fn solve(&self) -> Option<DVector<f64>> {
        let mut damped = self.matrix.clone();
        for i in 0..damped.nrows() {
            damped[(i, i)] *= 1.0 + 1e-9;
        }
        Some(damped.cholesky()?.solve(&self.right))
    }
}

fn report(
    state: &State,
    scans: &[SphereScan],
    seen: &[Seen],
    noise_mm: f64,
) -> Result<ProfilerCalibration, CalibrateError> {
    let mut spheres = Vec::new();
    let (mut squares, mut count) = (0.0, 0.0);
    for (k, (scan, seen)) in scans.iter().zip(seen).enumerate() {
        let residuals: Vec<f64> = seen
            .points
            .iter()
            .map(|(p, e)| {
                place(&state.calibration, *p, *e).distance(state.centres[k]) - scan.radius_mm
            })
            .collect();
        let n = residuals.len() as f64;
        let sum: f64 = residuals.iter().map(|r| r * r).sum();
        squares += sum;
        count += n;
        spheres.push(SphereResidual {
            points: residuals.len(),
            mean_mm: residuals.iter().sum::<f64>() / n,
            rms_mm: (sum / n).sqrt(),
        });
    }
    let rms_mm = (squares / count).sqrt();
    let smallest = scans.iter().map(|s| s.radius_mm).fold(f64::MAX, f64::min);
    if !rms_mm.is_finite() || rms_mm > (5.0 * noise_mm).max(0.02 * smallest) {
        return Err(CalibrateError::Unsettled { rms_mm });
    }
    let noise = noise_mm.max(rms_mm);
    let system = System::new(state, scans, seen, noise);
    let open = |u: f64, direction: &str, unit: &str| CalibrateError::Open {
        spheres: scans.len(),
        direction: direction.to_owned(),
        u: format!("{u:.2e} {unit}"),
    };
    let all = system
        .matrix
        .try_inverse()
        .ok_or_else(|| open(f64::INFINITY, "the pose", ""))?;
    let covariance: [[f64; 9]; 9] = std::array::from_fn(|i| std::array::from_fn(|j| all[(i, j)]));
    // Worst direction of rotation and position: the largest eigenvalue of each block.
    let worst = |from: usize| {
        let block = nalgebra::Matrix3::from_fn(|i, j| covariance[from + i][from + j]);
        let eigen = block.symmetric_eigen();
        let k = eigen.eigenvalues.imax();
        let v = eigen.eigenvectors.column(k);
        let axis = DVec3::new(v[0], v[1], v[2]);
        (eigen.eigenvalues[k].max(0.0).sqrt(), axis)
    };
    let (u_turn, axis) = worst(0);
    if u_turn > OPEN_RAD || !u_turn.is_finite() {
        let words = format!("the rotation about {}", direction(axis));
        return Err(open(u_turn, &words, "rad"));
    }
    let (u_place, axis) = worst(3);
    if u_place > OPEN_MM || !u_place.is_finite() {
        let words = format!("the position along {}", direction(axis));
        return Err(open(u_place, &words, "mm"));
    }
    Ok(ProfilerCalibration {
        calibration: state.calibration,
        covariance,
        rms_mm,
        spheres,
    })
}

/// An axis of the machine where one is near, else the vector.
fn direction(v: DVec3) -> String {
    let named = [("x", v.x), ("y", v.y), ("z", v.z)];
    match named.iter().find(|(_, share)| share.abs() > 0.95) {
        Some((name, _)) => (*name).to_owned(),
        None => format!("({:.2}, {:.2}, {:.2})", v.x, v.y, v.z),
    }
}

/// The effective radius of a probe's tip and its standard uncertainty, mm, from tip centres at contact with a reference sphere of radius
/// `sphere_mm`; and the sphere's centre, with it the standard uncertainty of one touch.
///
/// # Errors
/// [`CalibrateError::TooFew`] for fewer than five touches or touches that hold no sphere.
pub fn tip_radius(tip_centres: &[DVec3], sphere_mm: f64) -> Result<TipRadius, CalibrateError> {
    let fit: SphereFit = fit_sphere(tip_centres).ok_or(CalibrateError::TooFew {
        what: "touches spread over the sphere",
        found: tip_centres.len(),
        needed: 5,
    })?;
    Ok(TipRadius {
        radius_mm: fit.radius_mm - sphere_mm,
        u_radius_mm: fit.covariance[3][3].sqrt(),
        sphere_centre_mm: fit.centre,
        u_centre_mm: (0..3)
            .map(|i| fit.covariance[i][i])
            .fold(0.0, f64::max)
            .sqrt(),
        u_touch_mm: fit.sigma_mm,
    })
}

/// A probe's tip as found on a reference sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipRadius {
    /// Effective radius, mm: it holds the mean pre-travel of the probe as well.
    pub radius_mm: f64,
    /// Its standard uncertainty, mm.
    pub u_radius_mm: f64,
    /// Where the sphere is, machine, mm.
    pub sphere_centre_mm: DVec3,
    /// Standard uncertainty of its worst coordinate, mm.
    pub u_centre_mm: f64,
    /// Standard deviation of one touch about the sphere, mm.
    pub u_touch_mm: f64,
}

/// Scale and squareness of three axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisErrors {
    /// True length over indicated length, less 1, of x, y, z.
    pub scale: [f64; 3],
    /// Angles by which y leans to x, z to x, z to y, rad: how much less than a right angle lies between them.
    pub squareness_rad: [f64; 3],
    /// Standard uncertainties, in this order.
    pub u: [f64; 6],
    /// Root mean square of the distances left, mm.
    pub rms_mm: f64,
}

impl AxisErrors {
    /// The place that axes at `indicated` (mm) really are at.
    pub fn corrected(&self, indicated: DVec3) -> DVec3 {
        let [x, y, z] = indicated.to_array();
        let [a, b, c] = self.scale;
        let [yx, zx, zy] = self.squareness_rad;
        DVec3::new(
            (1.0 + a) * x + yx * y + zx * z,
            (1.0 + b) * y + zy * z,
            (1.0 + c) * z,
        )
    }
}

/// Scale and squareness from pairs of places as indicated and their certified distance (a ball bar or ball plate in several positions), to
/// first order in the errors.
///
/// # Errors
/// [`CalibrateError::TooFew`] for fewer than six pairs; [`CalibrateError::Open`] where their directions leave an error open.
pub fn axis_errors(
    pairs: &[(DVec3, DVec3, f64)],
    u_distance_mm: f64,
) -> Result<AxisErrors, CalibrateError> {
    let too_few = CalibrateError::TooFew {
        what: "distances of spheres",
        found: pairs.len(),
        needed: 6,
    };
    if pairs.len() < 6 {
        return Err(too_few);
    }
    let rows: Vec<([f64; 6], f64)> = pairs
        .iter()
        .map(|(a, b, certified)| {
            let v = *b - *a;
            let [x, y, z] = v.to_array();
            let l = v.length();
            (
                [x * x, y * y, z * z, x * y, x * z, y * z].map(|e| e / l),
                certified - l,
            )
        })
        .collect();
    let mut matrix = nalgebra::Matrix6::zeros();
    let mut right = nalgebra::Vector6::zeros();
    for (row, value) in &rows {
        let row = nalgebra::Vector6::from_row_slice(row);
        matrix += row * row.transpose();
        right += row * *value;
    }
    let eigen = matrix.symmetric_eigenvalues();
    let inverse = matrix
        .try_inverse()
        .filter(|_| eigen.min() > 1e-6 * eigen.max())
        .ok_or_else(|| CalibrateError::Open {
            spheres: pairs.len(),
            direction: "an error of the axes".to_owned(),
            u: "infinite".to_owned(),
        })?;
    let solved = inverse * right;
    let left: f64 = rows
        .iter()
        .map(|(row, value)| {
            let seen: f64 = row.iter().zip(solved.iter()).map(|(r, s)| r * s).sum();
            (value - seen).powi(2)
        })
        .sum();
    let freedom = rows.len() as f64 - 6.0;
    let seen = if freedom > 0.0 {
        (left / freedom).sqrt()
    } else {
        0.0
    };
    let sigma = seen.max(u_distance_mm);
    Ok(AxisErrors {
        scale: [solved[0], solved[1], solved[2]],
        squareness_rad: [solved[3], solved[4], solved[5]],
        u: std::array::from_fn(|i| sigma * inverse[(i, i)].sqrt()),
        rms_mm: (left / rows.len() as f64).sqrt(),
    })
}

#[cfg(test)]
mod tests;
