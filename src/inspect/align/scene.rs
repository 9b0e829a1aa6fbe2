//! A few hundred points of the scan with normals, and how well a pose lays them onto the nominal.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::Scan;
use crate::geometry::RigidTransform;
use crate::geometry::fit::fit_plane;
use crate::inspect::assign::{NO_FACE, Surface, towards};
use crate::inspect::body::Body;
use crate::points::PointCloud;

/// Points of the scene: a feature that bears one in a hundred points is seen by some twenty.
const POINTS: usize = 2400;

/// A normal of the scan that is off by more than this cosine (26 degrees) belongs to another face.
const AGREES: f64 = 0.9;

/// Standard deviations of a difference of counts at which it is believed.
const DECISIVE: f64 = 4.0;

/// A pose with this many times the residuals fits worse: below it the part's own deviations may hide the difference.
const WORSE: f64 = 1.6;

/// A point of the scan with its normal.
#[derive(Debug, Clone, Copy)]
pub(super) struct Oriented {
    pub(super) point: DVec3,
    pub(super) normal: DVec3,
    /// Where it was seen from, where that is known; only then the sign of the normal means something.
    pub(super) towards: Option<DVec3>,
}

/// Points with normals, those on edges left out.
pub(super) struct Scene {
    pub(super) points: Vec<Oriented>,
    /// Mean of the points.
    pub(super) centre: DVec3,
}

impl Scene {
    pub(super) fn new(scan: &Scan<'_>) -> Self {
        let cloud = scan.cloud;
        let radius = 3.0 * scan.spacing.across_mm.max(scan.spacing.along_mm);
        let points: Vec<Oriented> = scan
            .subset(POINTS)
            .par_iter()
            .map_init(
                || (Vec::new(), Vec::new()),
                |(found, near), i| {
                    let i = *i as usize;
                    let p = cloud.positions[i];
                    scan.neighbors.within(p, radius, found);
                    if of_one_line(cloud, found) {
                        return None;
                    }
                    near.clear();
                    let some = found.iter().step_by(found.len().div_ceil(100).max(1));
                    near.extend(some.map(|(j, _)| cloud.positions[*j as usize]));
                    let plane = fit_plane(near)?;
                    // On an edge there is no normal.
                    if plane.rms > 3.0 * scan.noise_mm + 0.02 * radius {
                        return None;
                    }
                    let towards = towards(cloud, i);
                    let backward = towards.is_some_and(|t| t.dot(plane.normal) < 0.0);
                    Some(Oriented {
                        point: p,
                        normal: if backward {
                            -plane.normal
                        } else {
                            plane.normal
                        },
                        towards,
                    })
                },
            )
            .flatten()
            .collect();
        Self::of(points)
    }

    fn of(points: Vec<Oriented>) -> Self {
        let sum: DVec3 = points.iter().map(|o| o.point).sum();
        Self {
            centre: sum / points.len().max(1) as f64,
            points,
        }
    }

    /// The scene in a mirror at x = 0.
    pub(super) fn mirrored(&self) -> Self {
        let turn = |v: DVec3| DVec3::new(-v.x, v.y, v.z);
        let points = self.points.iter().map(|o| Oriented {
            point: turn(o.point),
            normal: turn(o.normal),
            towards: o.towards.map(turn),
        });
        Self::of(points.collect())
    }

    /// At most `count` of the points, spread over the scene.
    pub(super) fn few(&self, count: usize) -> Vec<Oriented> {
        let step = self.points.len().div_ceil(count.max(1)).max(1);
        self.points.iter().copied().step_by(step).collect()
    }

    /// How `pose` lays every point onto the faces: distances up to `cap_mm`; a point on a face of another direction
    /// counts as that far away.
    pub(super) fn fit<B: Body>(
        &self,
        pose: &RigidTransform,
        surface: &Surface<'_, B>,
        cap_mm: f64,
    ) -> Fit {
        let turn = DMat3::from_quat(pose.rotation);
        let [low, high] = surface.body.bounds();
        let places: Vec<(bool, f64, bool)> = self
            .points
            .par_iter()
            .with_min_len(64)
            .map_init(Vec::new, |found, o| {
                let p = turn * o.point + pose.translation;
                let view = o.towards.map(|t| turn * t);
                let place = surface.place(p, view, cap_mm, found);
                let cosine = place.normal.dot(turn * o.normal);
                let agrees = match o.towards {
                    Some(_) => cosine > AGREES,
                    None => cosine.abs() > AGREES,
                };
                let near = place.face != NO_FACE;
                (
                    near,
                    if near && agrees {
                        place.distance_mm
                    } else {
                        cap_mm
                    },
                    !near && p.cmpgt(low).all() && p.cmplt(high).all(),
                )
            })
            .collect();
        let distances: Vec<f64> = places.iter().map(|p| p.1.min(cap_mm)).collect();
        let squares: f64 = distances.iter().map(|d| d * d).sum();
        Fit {
            rms_mm: (squares / distances.len().max(1) as f64).sqrt(),
            near: places.iter().filter(|p| p.0).count(),
            stray: places.iter().filter(|p| p.2).count(),
            distances,
        }
    }
}

/// Whether `found` are points of one scan line, as on walls that fall off steeply: their plane is the laser's, not the part's.
fn of_one_line(cloud: &PointCloud, found: &[(u32, f64)]) -> bool {
    let line = |(i, _): &(u32, f64)| {
        let origin = cloud.origins.get(*i as usize)?;
        Some((origin.view, origin.profile))
    };
    let mut lines = found.iter().map(line);
    match lines.next() {
        Some(Some(first)) => lines.all(|line| line == Some(first)),
        _ => false,
    }
}

/// How a pose lays the scene onto the nominal.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    /// Of every point, capped, mm.
    pub(super) distances: Vec<f64>,
    /// Root mean square of the capped distances, mm.
    pub(super) rms_mm: f64,
    /// Points within the cap of any face.
    pub(super) near: usize,
    /// Points farther than the cap from every face, and yet within the nominal's box.
    pub(super) stray: usize,
}

impl Fit {
    /// Share of the points within `limit_mm`.
    pub(super) fn share(&self, limit_mm: f64) -> f64 {
        let within = self.distances.iter().filter(|d| **d < limit_mm).count();
        within as f64 / self.distances.len().max(1) as f64
    }

    /// The limit below which the points of this fit count as lying on the nominal: six times the spread of its better half.
    pub(super) fn limit_mm(&self, noise_mm: f64) -> f64 {
        let mut sorted = self.distances.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let middle = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        // The median of |x| of normal noise is 0.674 of its standard deviation.
        6.0 * (middle / 0.674).max(noise_mm)
    }

    /// Whether `self` lays the scene onto the nominal better than `other` by more than chance and small deviations explain.
    ///
    /// Either its distances are smaller by a factor, or significantly more points lie on the nominal here and not there
    /// than the other way round: a feature of a few percent of the points tells two poses apart.
    pub(super) fn is_better(&self, other: &Self, noise_mm: f64) -> bool {
        if self.rms_mm.max(noise_mm) * WORSE < other.rms_mm {
            return true;
        }
        let limit_mm = self.limit_mm(noise_mm);
        let (mut here, mut there) = (0.0, 0.0);
        for (a, b) in self.distances.iter().zip(&other.distances) {
            match (*a < limit_mm, *b < limit_mm) {
                (true, false) => here += 1.0,
                (false, true) => there += 1.0,
                _ => {}
            }
        }
        // Neighbouring points share their luck: a handful is chance whatever the ratio.
        here - there > DECISIVE * f64::sqrt(here + there).max(2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::{Frame, Neighbors, Origin, Spacing, View};

    #[test]
    fn a_wall_of_lines_far_apart_has_the_wall_s_normal_or_none() {
        // Lines every 1 mm of travel along x, on a wall that falls off as 1 in 6: there they lie 6 mm apart.
        let wall = DVec3::new(6.0, 0.0, 1.0).normalize();
        let mut cloud = PointCloud::from_positions(Frame::Machine, Vec::new());
        cloud.views.push(View {
            device: "above".to_owned(),
            towards_sensor: DVec3::Z,
        });
        for profile in 0..40u32 {
            for column in 0..200u16 {
                let x = f64::from(profile) - 20.0;
                let y = 0.1 * f64::from(column);
                // A ripple of 5 um stands for noise.
                let ripple = 0.005 * f64::from(i32::from(column * 7 % 5) - 2) / 2.0;
                let on = DVec3::new(x, y, -6.0 * x.max(0.0));
                let normal = if x > 0.0 { wall } else { DVec3::Z };
                cloud.positions.push(on + ripple * normal);
                cloud.origins.push(Origin {
                    view: 0,
                    column,
                    profile,
                });
            }
        }
        let neighbors = Neighbors::new(&cloud.positions);
        let scene = Scene::new(&Scan {
            cloud: &cloud,
            neighbors: &neighbors,
            spacing: Spacing {
                along_mm: 0.1,
                across_mm: 1.0,
                mean_mm: 0.3,
            },
            noise_mm: 0.005,
        });
        assert!(scene.points.len() > 500, "{}", scene.points.len());
        for o in &scene.points {
            let of_face = if o.point.x > 0.5 { wall } else { DVec3::Z };
            assert!(o.normal.dot(of_face) > AGREES, "{o:?}");
        }
    }
}
