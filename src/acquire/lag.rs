//! The lag between a robot's poses and a profiler on it, from passes to and fro over something of known form.
//!
//! A lag moves all points along the path by lag times speed: one way going, the other way coming back. What is sought makes both ways one
//! sphere, or one plane. The form is free in place and size, so that neither where it stands nor a scale of the sensor matters; a lag
//! shows only where the motion has a part across the surface, which a sphere has everywhere and a plate where it is inclined to the path.
//!
//! The uncertainty has two parts: that of the fit, by the noise that the points show about the form; and that of the clocks, whose
//! relation is found anew in every run ([`super::clock`]) and which only the scatter of several passes shows.

use glam::DVec3;
use nalgebra::{DMatrix, DVector};

use super::calibrate::CalibrateError;
use super::poses::PoseTrack;
use crate::geometry::fit::{fit_plane, mad_sigma};
use crate::geometry::sphere::{find_sphere, fit_sphere};

/// One pass to and fro, as it came.
pub struct Pass {
    /// Poses of the tool in the machine, by the robot's clock.
    pub(super) track: PoseTrack,
    /// Time of a profile by the robot's clock without any lag, s, and its points in the tool, mm.
    pub(super) profiles: Vec<(f64, Vec<DVec3>)>,
}

/// What the passes go over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Artefact {
    /// A sphere of about this radius, mm; other things may be seen beside it.
    Sphere {
        /// Its radius.
        radius_mm: f64,
    },
    /// A plate inclined to the path; most of what is seen is on it.
    Plate,
}

/// A lag that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Lag {
    /// To be added to the time of a profile, s: [`super::CarrierPlan::lag_s`].
    pub lag_s: f64,
    /// Standard uncertainty, s. Of one pass it is that of the fit alone.
    pub u_s: f64,
    /// Lag and standard uncertainty of the fit of each pass, s.
    pub passes: Vec<(f64, f64)>,
    /// Root mean square distance of the points used from the form, worst pass, mm.
    pub rms_mm: f64,
}

/// Where the search begins, s: a shift by one of these leaves most of the artefact together.
const STARTS_S: [f64; 11] = [
    0.0, -0.01, 0.01, -0.02, 0.02, -0.04, 0.04, -0.08, 0.08, -0.16, 0.16,
];
/// Rounds of Gauss-Newton.
const ROUNDS: usize = 40;
/// A step that changes nothing, s: the stamps of a profiler are microseconds.
const SETTLED_S: f64 = 1e-8;
/// Most points of a pass that are looked at.
const LOOKED_AT: usize = 40_000;
/// Points farther from the form than so many standard deviations belong to something else.
const OUTLIER: f64 = 5.0;
/// Uncertainty of a pass beyond which it says nothing, s: at a tenth of a metre a second it is a tenth of a millimetre.
const OPEN_S: f64 = 1e-3;

/// The lag that makes the two ways of each pass one.
///
/// # Errors
/// [`CalibrateError`]: no passes, an artefact that is not seen, passes in one direction only or over a surface along the path.
pub fn find_lag(passes: &[Pass], artefact: Artefact) -> Result<Lag, CalibrateError> {
    let too_few = CalibrateError::TooFew {
        what: "passes",
        found: 0,
        needed: 1,
    };
    let found: Vec<PassLag> = passes
        .iter()
        .enumerate()
        .map(|(index, pass)| of_pass(index, pass, artefact))
        .collect::<Result<_, _>>()?;
    let n = found.len() as f64;
    if found.is_empty() {
        return Err(too_few);
    }
    let lag_s = found.iter().map(|pass| pass.lag_s).sum::<f64>() / n;
    let fits = found.iter().map(|pass| pass.u_s.powi(2)).sum::<f64>() / n;
    let scatter = found.iter().map(|pass| (pass.lag_s - lag_s).powi(2));
    let scatter = scatter.sum::<f64>() / (n - 1.0).max(1.0);
    Ok(Lag {
        lag_s,
        u_s: (fits.max(scatter) / n).sqrt(),
        passes: found.iter().map(|pass| (pass.lag_s, pass.u_s)).collect(),
        rms_mm: found.iter().map(|pass| pass.rms_mm).fold(0.0, f64::max),
    })
}

struct PassLag {
    lag_s: f64,
    u_s: f64,
    rms_mm: f64,
}

/// A point in the machine, and how it moves with the lag, mm/s.
struct Placed {
    point: DVec3,
    velocity: DVec3,
}

impl Pass {
    /// Every `step`-th point where the poses put it at a lag. Points whose pose is missing are left out.
    fn placed(&self, lag_s: f64, step: usize) -> Vec<Placed> {
        // Over a cycle the path is straight, as it is between two poses anyhow.
        let half_s = 0.5 * self.track.cycle_s();
        let at = |shift_s: f64| {
            let times: Vec<f64> = self.profiles.iter().map(|p| p.0 + shift_s).collect();
            self.track.at(&times)
        };
        let (now, before, after) = (at(lag_s), at(lag_s - half_s), at(lag_s + half_s));
        let mut placed = Vec::new();
        let mut count = 0;
        for (k, (_, points)) in self.profiles.iter().enumerate() {
            let (Ok(now), Ok(before), Ok(after)) = (&now[k], &before[k], &after[k]) else {
                count += points.len();
                continue;
            };
            for point in points {
                count += 1;
                if count % step == 0 {
                    placed.push(Placed {
                        point: now.point(*point),
                        velocity: (after.point(*point) - before.point(*point)) / (2.0 * half_s),
                    });
                }
            }
        }
        placed
    }
}

/// A form through points: residual and its derivatives by the form's own numbers.
enum Form {
    Sphere {
        centre: DVec3,
        radius_mm: f64,
    },
    Plane {
        origin: DVec3,
        normal: DVec3,
        across: [DVec3; 2],
        size_mm: f64,
    },
}

impl Form {
    fn through(points: &[DVec3], artefact: Artefact) -> Option<Form> {
        match artefact {
            Artefact::Sphere { .. } => fit_sphere(points).map(|fit| Form::Sphere {
                centre: fit.centre,
                radius_mm: fit.radius_mm,
            }),
            Artefact::Plate => {
                let fit = fit_plane(points)?;
                let reach = points.iter().map(|p| p.distance(fit.centre));
                Some(Form::Plane {
                    origin: fit.centre,
                    normal: fit.normal,
                    across: fit.axes,
                    size_mm: reach.fold(0.0, f64::max).max(f64::MIN_POSITIVE),
                })
            }
        }
    }

    fn residual(&self, p: DVec3) -> f64 {
        match self {
            Form::Sphere { centre, radius_mm } => p.distance(*centre) - radius_mm,
            Form::Plane { origin, normal, .. } => (p - origin).dot(*normal),
        }
    }

    /// Derivatives of the residual: by the lag, then by what is free in the form.
    fn row(&self, placed: &Placed) -> Vec<f64> {
        match self {
            Form::Sphere { centre, .. } => {
                let out = (placed.point - centre).normalize_or_zero();
                let by_centre = (-out).to_array();
                [out.dot(placed.velocity)]
                    .into_iter()
                    .chain(by_centre)
                    .chain([-1.0])
                    .collect()
            }
            Form::Plane {
                origin,
                normal,
                across,
                size_mm,
            } => {
                let arm = (placed.point - origin) / *size_mm;
                vec![
                    normal.dot(placed.velocity),
                    -1.0,
                    arm.dot(across[0]),
                    arm.dot(across[1]),
                ]
            }
        }
    }
}

fn of_pass(index: usize, pass: &Pass, artefact: Artefact) -> Result<PassLag, CalibrateError> {
    let all: usize = pass.profiles.iter().map(|p| p.1.len()).sum();
    let step = all.div_ceil(LOOKED_AT).max(1);
    let (mut lag_s, mut chosen) = begin(pass, artefact, step).ok_or(CalibrateError::NotFound {
        sphere: index + 1,
        radius_mm: match artefact {
            Artefact::Sphere { radius_mm } => radius_mm,
            Artefact::Plate => f64::INFINITY,
        },
        points: all,
    })?;
    for _ in 0..ROUNDS {
        let placed = pass.placed(lag_s, step);
        let points: Vec<DVec3> = placed.iter().map(|p| p.point).collect();
        let limit = OUTLIER * noise(&chosen, &points);
        let close = |p: &&DVec3| chosen.residual(**p).abs() < limit;
        let used: Vec<DVec3> = points.iter().filter(close).copied().collect();
        let Some(form) = Form::through(&used, artefact) else {
            break;
        };
        let solved = solve(&placed, &form);
        chosen = form;
        let open = |u_s: f64| CalibrateError::LagOpen {
            u_s,
            most_s: OPEN_S,
        };
        let (change_s, u_s, rms_mm) = solved.ok_or_else(|| open(f64::INFINITY))?;
        if u_s.is_nan() || u_s >= OPEN_S {
            return Err(open(u_s));
        }
        lag_s += change_s;
        if change_s.abs() < SETTLED_S {
            return Ok(PassLag { lag_s, u_s, rms_mm });
        }
    }
    let points: Vec<DVec3> = pass.placed(lag_s, step).iter().map(|p| p.point).collect();
    Err(CalibrateError::Unsettled {
        rms_mm: noise(&chosen, &points),
    })
}

/// The start at which most points agree on the form.
fn begin(pass: &Pass, artefact: Artefact, step: usize) -> Option<(f64, Form)> {
    let mut best: Option<(f64, f64, Form)> = None;
    for start_s in STARTS_S {
        let placed = pass.placed(start_s, step);
        let points: Vec<DVec3> = placed.iter().map(|p| p.point).collect();
        let found = match artefact {
            Artefact::Sphere { radius_mm } => {
                let fit = find_sphere(&points, radius_mm, 0.05 * radius_mm);
                let fit = fit.filter(|fit| fit.used.len() >= 30);
                fit.map(|fit| {
                    let form = Form::Sphere {
                        centre: fit.centre,
                        radius_mm: fit.radius_mm,
                    };
                    // As many as possible, as near as possible.
                    (fit.used.len() as f64 / fit.sigma_mm.max(1e-6), form)
                })
            }
            Artefact::Plate => Form::through(&points, artefact)
                .map(|form| (1.0 / noise(&form, &points).max(1e-6), form)),
        };
        if let Some((score, form)) = found
            && best.as_ref().is_none_or(|(most, ..)| score > *most)
        {
            best = Some((score, start_s, form));
        }
    }
    best.map(|(_, start_s, form)| (start_s, form))
}

/// Scatter of the points that are near the form, mm: those beyond three times the middle distance are something else.
fn noise(form: &Form, points: &[DVec3]) -> f64 {
    let mut near: Vec<f64> = points.iter().map(|p| form.residual(*p)).collect();
    if let Form::Sphere { radius_mm, .. } = form {
        near.retain(|r| r.abs() < 0.15 * radius_mm);
    }
    // Never zero: computed numbers without noise agree to a nanometre.
    mad_sigma(&near).max(1e-6)
}

/// Change of the lag, its standard uncertainty, and the root mean square of the residuals used.
fn solve(placed: &[Placed], form: &Form) -> Option<(f64, f64, f64)> {
    let points: Vec<DVec3> = placed.iter().map(|p| p.point).collect();
    let limit = OUTLIER * noise(form, &points);
    let size = form.row(placed.first()?).len();
    let (mut matrix, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
    let (mut squares, mut n) = (0.0, 0_usize);
    for one in placed {
        let residual = form.residual(one.point);
        if residual.abs() > limit {
            continue;
        }
        let row = DVector::from_vec(form.row(one));
        matrix += &row * row.transpose();
        right -= &row * residual;
        squares += residual * residual;
        n += 1;
    }
    if n <= size {
        return None;
    }
    let inverse = matrix.cholesky()?.inverse();
    let step = &inverse * right;
    let variance = squares / (n - size) as f64;
    let u_s = (variance * inverse[(0, 0)]).sqrt();
    Some((step[0], u_s, (squares / n as f64).sqrt()))
}
