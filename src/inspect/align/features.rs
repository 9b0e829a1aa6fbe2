//! Datum features measured from the scan itself, and the pose that they make.
//!
//! From the pose of the best fit each feature is fitted to the points of its faces as a small motion of the nominal one - a plane by an
//! offset and two tilts, an axis by two shifts, two turns and a growth, a centre by three shifts and a growth, a reference point by
//! offset and tilts of the surface about it - and the pose is made of them, again and again until it stands. What the features leave
//! free stays as the best fit has it.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::datum::{Datum, pose_from_ordered_datums};
use super::{Aligned, Conclusion, RIM_SPACINGS, Task};
use crate::geometry::RigidTransform;
use crate::geometry::fit::{RobustFit, fit_robust};
use crate::inspect::assign::{NO_FACE, Place, towards};
use crate::inspect::body::{Body, DatumShape};
use crate::inspect::result::{DatumKind, DatumResult, Method, Verdict};

/// Points of the scan that are looked at: a face with one point in a hundred is then known to a fiftieth of the noise.
const POINTS: usize = 300_000;

/// Fewest points of a feature.
const FEWEST: usize = 20;

/// Points that a reference point should have around it, where the recipe names no radius.
const AROUND: f64 = 50.0;

/// Rounds after which features and pose stand still: each gains the digits of a Gauss-Newton step.
const ROUNDS: usize = 8;

/// A direction that meets the surface flatter than this (cosine of 78 degrees) is not held by it.
const STRAIGHT: f64 = 0.2;

/// A datum feature that the pose is to rest on.
#[derive(Debug, Clone, PartialEq)]
pub struct DatumFeature {
    /// What people call it.
    pub name: String,
    /// 1 holds before 2, 2 before 3.
    pub priority: u32,
    /// Where it is.
    pub place: DatumPlace,
}

/// Where a datum feature lies.
#[derive(Debug, Clone, PartialEq)]
pub enum DatumPlace {
    /// Indices of faces that are one plane, one axis or one sphere.
    Faces(Vec<u32>),
    /// A reference point.
    Point {
        /// Nominal place, mm, part frame.
        nominal: DVec3,
        /// Direction that it holds; `None` = the normal of the face there.
        direction: Option<DVec3>,
        /// Radius of the patch that is measured, mm; `None` = some fifty points.
        radius_mm: Option<f64>,
    },
}

/// A point of the scan on the nominal, at the pose that is being tried.
struct Seen {
    point: DVec3,
    place: Place,
}

/// A feature as measured, in the part frame of the pose it was measured at.
struct Found {
    datum: Datum,
    points: usize,
    form_mm: f64,
    u_mm: f64,
}

impl<B: Body> Task<'_, B> {
    /// Moves the pose of the best fit onto the datum features asked for; without any it stays.
    pub(super) fn on_datums(&self, mut aligned: Aligned) -> Aligned {
        let features = self.options.datums;
        let usable = matches!(aligned.conclusion, Conclusion::Good | Conclusion::Free);
        if features.is_empty() || !usable {
            return aligned;
        }
        let best_fit = aligned.alignment.covariance;
        let mut pose = aligned.alignment.part_from_machine;
        let mut failures = Vec::new();
        for _ in 0..ROUNDS {
            let seen = self.seen(&pose);
            let mut found = Vec::new();
            failures.clear();
            for feature in features {
                match self.measure(feature, &pose, &seen) {
                    Ok(one) => found.push((feature, one)),
                    Err(why) => failures.push(format!(
                        "alignment: datum {:?}: {why}; the pose is that of the best fit",
                        feature.name
                    )),
                }
            }
            if !failures.is_empty() {
                break;
            }
            let ordered: Vec<(u32, Datum)> = found
                .iter()
                .map(|(feature, one)| (feature.priority, one.datum))
                .collect();
            let made = match pose_from_ordered_datums(pose, Some(&best_fit), &ordered) {
                Ok(made) => made,
                Err(error) => {
                    failures.push(format!(
                        "alignment: {error}; the pose is that of the best fit"
                    ));
                    break;
                }
            };
            let moved = super::Twist::logarithm(&(made.part_from_machine * pose.inverse()));
            pose = made.part_from_machine;
            let alignment = &mut aligned.alignment;
            alignment.part_from_machine = pose;
            alignment.covariance = made.covariance;
            alignment.method = Method::Datums;
            alignment.datums = found
                .iter()
                .map(|(feature, one)| self.described_datum(feature, one, &pose))
                .collect();
            alignment.free_of_datums = made.weak_directions;
            if moved.size(self.size_mm) < 0.01 * self.scan.noise_mm.max(1e-7 * self.size_mm) {
                break;
            }
        }
        if failures.is_empty() {
            let free = &aligned.alignment.free_of_datums;
            if !free.is_empty() {
                aligned.findings.push(format!(
                    "alignment: the datums leave {} free; there the pose is that of the best fit",
                    free.join(", ")
                ));
            }
            self.remeasure_rms(&mut aligned);
        } else {
            aligned.findings.append(&mut failures);
            aligned.alignment.status = Verdict::NotDecidable;
            aligned.conclusion = Conclusion::NoDatum;
        }
        aligned
    }

    /// A scan that is taken as it lies, with how far each datum feature asked for lies off its nominal: they hold nothing.
    pub(super) fn off_datums(&self, mut aligned: Aligned) -> Aligned {
        let features = self.options.datums;
        if features.is_empty() {
            return aligned;
        }
        let pose = aligned.alignment.part_from_machine;
        let seen = self.seen(&pose);
        for feature in features {
            match self.measure(feature, &pose, &seen) {
                Ok(found) => {
                    let datum = self.described_datum(feature, &found, &pose);
                    aligned.alignment.datums.push(datum);
                }
                Err(why) => {
                    let finding = format!("alignment: datum {:?}: {why}", feature.name);
                    aligned.findings.push(finding);
                }
            }
        }
        aligned.findings.push(
            "alignment: the scan is taken as it lies: the recipe's datums hold nothing, and their residuals say how far they lie off; ask for an \
             alignment to rest on them"
                .to_owned(),
        );
        aligned
    }

    /// The points on faces, away from edges.
    fn seen(&self, pose: &RigidTransform) -> Vec<Seen> {
        let cloud = self.scan.cloud;
        let turn = DMat3::from_quat(pose.rotation);
        let gate_mm = (0.05 * self.size_mm).max(10.0 * self.scan.noise_mm);
        let rim_mm = (RIM_SPACINGS * self.scan.spacing.along_mm).min(0.02 * self.size_mm);
        let chosen = self.scan.subset(POINTS);
        let blocks: Vec<Vec<Seen>> = chosen
            .par_chunks(512)
            .map(|block| {
                let mut found = Vec::new();
                let mut out = Vec::with_capacity(block.len());
                for i in block {
                    let i = *i as usize;
                    let point = turn * cloud.positions[i] + pose.translation;
                    let view = towards(cloud, i).map(|v| turn * v);
                    let (place, rim) = self.surface.place_and_rim(point, view, gate_mm, &mut found);
                    if place.face != NO_FACE && rim >= rim_mm {
                        out.push(Seen { point, place });
                    }
                }
                out
            })
            .collect();
        blocks.into_iter().flatten().collect()
    }

    fn measure(
        &self,
        feature: &DatumFeature,
        pose: &RigidTransform,
        seen: &[Seen],
    ) -> Result<Found, String> {
        let back = pose.inverse();
        match &feature.place {
            DatumPlace::Point {
                nominal,
                direction,
                radius_mm,
            } => self.reference_point((*nominal, *direction, *radius_mm), &back, seen),
            DatumPlace::Faces(faces) => {
                let shape = self.shape_of(faces)?;
                let own: Vec<&Seen> = seen
                    .iter()
                    .filter(|s| faces.contains(&s.place.face))
                    .collect();
                if own.len() < FEWEST {
                    return Err(format!(
                        "{} points on its faces, expected at least {FEWEST}; scan them",
                        own.len()
                    ));
                }
                match shape {
                    DatumShape::Plane => self.plane(&own, &back),
                    DatumShape::Axis(origin, direction) => {
                        self.axis(&own, (origin, direction), &back)
                    }
                    DatumShape::Centre(centre) => self.centre(&own, centre, &back),
                }
            }
        }
    }

    /// The one shape of several faces.
    fn shape_of(&self, faces: &[u32]) -> Result<DatumShape, String> {
        let body = self.surface.body;
        let entity = |face: u32| format!("#{}", body.face_entity(face));
        let mut shared: Option<DatumShape> = None;
        for &face in faces {
            let Some(shape) = body.datum_shape(face) else {
                return Err(format!(
                    "{} is a free-form face, expected planes, cylinders, cones or spheres",
                    entity(face)
                ));
            };
            let near = 1e-6 * self.size_mm;
            let same = match (shared, shape) {
                (None, _) => true,
                (Some(DatumShape::Plane), DatumShape::Plane) => {
                    let normal = |f: u32| body.foot(f, DVec3::ZERO, None).map(|foot| foot.normal);
                    match (normal(faces[0]), normal(face)) {
                        (Some(a), Some(b)) => a.dot(b) > 1.0 - 1e-9,
                        _ => false,
                    }
                }
                (Some(DatumShape::Axis(p, d)), DatumShape::Axis(q, e)) => {
                    d.cross(e).length() < 1e-6 && (q - p).cross(d).length() < near
                }
                (Some(DatumShape::Centre(p)), DatumShape::Centre(q)) => p.distance(q) < near,
                _ => false,
            };
            if !same {
                return Err(format!(
                    "{} and {} are not one plane, axis or centre, expected faces that are",
                    entity(faces[0]),
                    entity(face)
                ));
            }
            shared = shared.or(Some(shape));
        }
        shared.ok_or_else(|| "no face, expected at least one".to_owned())
    }

    fn fit<const P: usize>(
        &self,
        rows: &[[f64; P]],
        values: &[f64],
    ) -> Result<RobustFit<P>, String> {
        let floor = self.scan.noise_mm.max(1e-9 * self.size_mm);
        fit_robust(rows, values, 0.5 * floor).ok_or_else(|| {
            format!(
                "{} points that do not hold it, expected points spread over the whole feature",
                rows.len()
            )
        })
    }

    fn plane(&self, own: &[&Seen], back: &RigidTransform) -> Result<Found, String> {
        let feet = || {
            own.iter()
                .map(|s| s.point - s.place.deviation_mm * s.place.normal)
        };
        let middle = feet().sum::<DVec3>() / own.len() as f64;
        let normal = own[0].place.normal;
        let (a, b) = normal.any_orthonormal_pair();
        let rows: Vec<[f64; 3]> = feet()
            .map(|p| [1.0, (p - middle).dot(a), (p - middle).dot(b)])
            .collect();
        let fitted = self.fit(&rows, &deviations(own))?;
        let [height, by_a, by_b] = fitted.fit.coefficients;
        let u = standard(&fitted);
        let measured = [
            back.point(middle + height * normal),
            back.vector((normal - by_a * a - by_b * b).normalize()),
        ];
        Ok(Found {
            datum: Datum::Plane {
                nominal: [middle, normal],
                measured,
                u: [u[0], u[1].max(u[2])],
            },
            points: used(&fitted),
            form_mm: fitted.sigma,
            u_mm: u[0],
        })
    }

    fn axis(
        &self,
        own: &[&Seen],
        (origin, direction): (DVec3, DVec3),
        back: &RigidTransform,
    ) -> Result<Found, String> {
        let along = own
            .iter()
            .map(|s| (s.point - origin).dot(direction))
            .sum::<f64>()
            / own.len() as f64;
        let middle = origin + along * direction;
        let (a, b) = direction.any_orthonormal_pair();
        // The growth takes up a radius that is off, and of a cone a shift along its axis.
        let rows: Vec<[f64; 5]> = own
            .iter()
            .map(|s| {
                let n = s.place.normal;
                let lever = (s.point - middle).cross(n);
                [n.dot(a), n.dot(b), lever.dot(a), lever.dot(b), 1.0]
            })
            .collect();
        let fitted = self.fit(&rows, &deviations(own))?;
        let c = fitted.fit.coefficients;
        let u = standard(&fitted);
        let turn = c[2] * a + c[3] * b;
        let measured = [
            back.point(middle + c[0] * a + c[1] * b),
            back.vector((direction + turn.cross(direction)).normalize()),
        ];
        Ok(Found {
            datum: Datum::Axis {
                nominal: [middle, direction],
                measured,
                u: [u[0].max(u[1]), u[2].max(u[3])],
            },
            points: used(&fitted),
            form_mm: fitted.sigma,
            u_mm: u[0].max(u[1]),
        })
    }

    fn centre(&self, own: &[&Seen], centre: DVec3, back: &RigidTransform) -> Result<Found, String> {
        let rows: Vec<[f64; 4]> = own
            .iter()
            .map(|s| {
                let n = s.place.normal;
                [n.x, n.y, n.z, 1.0]
            })
            .collect();
        let fitted = self.fit(&rows, &deviations(own))?;
        let [x, y, z, _] = fitted.fit.coefficients;
        let u = standard(&fitted);
        let u_mm = u[0].max(u[1]).max(u[2]);
        Ok(Found {
            datum: Datum::Centre {
                nominal: centre,
                measured: back.point(centre + DVec3::new(x, y, z)),
                u_mm,
            },
            points: used(&fitted),
            form_mm: fitted.sigma,
            u_mm,
        })
    }

    fn reference_point(
        &self,
        (nominal, direction, radius_mm): (DVec3, Option<DVec3>, Option<f64>),
        back: &RigidTransform,
        seen: &[Seen],
    ) -> Result<Found, String> {
        let spacing = self.scan.spacing;
        let area = spacing.along_mm * spacing.across_mm;
        let radius = radius_mm.unwrap_or_else(|| {
            let some = (AROUND * area / std::f64::consts::PI).sqrt();
            some.max(3.0 * spacing.across_mm)
        });
        let mut found = Vec::new();
        let on = self
            .surface
            .place(nominal, direction, self.size_mm, &mut found);
        if on.face == NO_FACE || on.distance_mm > radius {
            return Err(format!(
                "its nominal place lies {:.3} mm off the part, expected a place on it",
                on.distance_mm
            ));
        }
        let normal = on.normal;
        let direction = direction.unwrap_or(normal).normalize();
        let cosine = direction.dot(normal);
        if cosine.abs() < STRAIGHT {
            return Err(format!(
                "its direction meets the face under {:.0} degrees, expected at most {:.0}",
                cosine.abs().acos().to_degrees(),
                STRAIGHT.acos().to_degrees()
            ));
        }
        let own: Vec<&Seen> = seen
            .iter()
            .filter(|s| s.place.face == on.face && s.point.distance(nominal) <= radius)
            .collect();
        if own.len() < FEWEST {
            return Err(format!(
                "{} points within {radius:.3} mm of it on its face, expected at least {FEWEST}; scan it, or give radius_mm",
                own.len()
            ));
        }
        let (a, b) = normal.any_orthonormal_pair();
        let rows: Vec<[f64; 3]> = own
            .iter()
            .map(|s| [1.0, (s.point - nominal).dot(a), (s.point - nominal).dot(b)])
            .collect();
        let fitted = self.fit(&rows, &deviations(&own))?;
        let u_mm = standard(&fitted)[0] / cosine.abs();
        // Where the line through the nominal place meets the surface; a drawing's point a little off its face counts from there.
        let height = fitted.fit.coefficients[0] - on.deviation_mm;
        Ok(Found {
            datum: Datum::Point {
                nominal,
                direction,
                measured: back.point(nominal + height / cosine * direction),
                u_mm,
            },
            points: used(&fitted),
            form_mm: fitted.sigma,
            u_mm,
        })
    }

    fn described_datum(
        &self,
        feature: &DatumFeature,
        found: &Found,
        pose: &RigidTransform,
    ) -> DatumResult {
        let (residual_mm, residual_rad) = found.datum.off(pose);
        DatumResult {
            name: feature.name.clone(),
            kind: match found.datum {
                Datum::Point { .. } => DatumKind::Point,
                Datum::Plane { .. } => DatumKind::Plane,
                Datum::Axis { .. } => DatumKind::Axis,
                Datum::Centre { .. } => DatumKind::Centre,
            },
            priority: feature.priority,
            faces: match &feature.place {
                DatumPlace::Faces(faces) => faces
                    .iter()
                    .map(|face| self.surface.body.face_entity(*face))
                    .collect(),
                DatumPlace::Point { .. } => Vec::new(),
            },
            points: found.points,
            residual_mm,
            residual_rad,
            u_mm: found.u_mm,
            form_mm: found.form_mm,
        }
    }

    /// The residuals of all faces at the pose on the datums.
    fn remeasure_rms(&self, aligned: &mut Aligned) {
        let seen = self.seen(&aligned.alignment.part_from_machine);
        let squares: f64 = seen.iter().map(|s| s.place.deviation_mm.powi(2)).sum();
        aligned.alignment.rms_mm = (squares / seen.len().max(1) as f64).sqrt();
        aligned.alignment.points = seen.len();
    }
}

fn deviations(own: &[&Seen]) -> Vec<f64> {
    own.iter().map(|s| s.place.deviation_mm).collect()
}

fn used<const P: usize>(fitted: &RobustFit<P>) -> usize {
    fitted.kept.iter().filter(|kept| **kept).count()
}

/// Standard uncertainties of the coefficients.
fn standard<const P: usize>(fitted: &RobustFit<P>) -> [f64; P] {
    std::array::from_fn(|i| {
        let variance = fitted.sigma * fitted.sigma * fitted.fit.cofactor[i][i];
        // A scan without noise is known to rounding, which is not exactly.
        variance.sqrt().max(1e-9)
    })
}
