//! Which face of the nominal every point of an aligned scan belongs to, and how far from it it lies.

use glam::DVec3;
use rayon::prelude::*;

use super::body::{Body, BodySample};
use crate::points::PointCloud;
use crate::points::neighbors::Neighbors;

/// The face of a point that belongs to none.
pub const NO_FACE: u32 = u32::MAX;

/// Nearest samples among which the face is sought: where three faces meet, each has some.
const CANDIDATES: usize = 8;

/// A surface seen at less than this cosine is not seen: 3 degrees behind the horizon, for tilted faces and wide lines.
const HORIZON: f64 = -0.05;

/// A nominal made ready for look-ups.
pub struct Surface<'a, B: Body> {
    /// The nominal.
    pub body: &'a B,
    samples: Vec<BodySample>,
    tree: Neighbors,
    spacing_mm: f64,
}

/// The place of a point on the nominal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Index of the face, or [`NO_FACE`].
    pub face: u32,
    /// Signed distance to the face, mm: plus = outside the material.
    pub deviation_mm: f64,
    /// Outward normal at the foot.
    pub normal: DVec3,
    /// Distance to the face within its boundary, mm; beyond the boundary good to the sampling.
    pub distance_mm: f64,
}

const NOWHERE: Place = Place {
    face: NO_FACE,
    deviation_mm: 0.0,
    normal: DVec3::ZERO,
    distance_mm: f64::INFINITY,
};

impl<'a, B: Body> Surface<'a, B> {
    /// Samples `body` finely enough that the nearest sample tells the nearest face: 1/200 of its diagonal.
    pub fn new(body: &'a B) -> Self {
        let [low, high] = body.bounds();
        let spacing_mm = ((high - low).length() / 200.0).max(1e-9);
        let samples = body.samples(spacing_mm);
        let points: Vec<DVec3> = samples.iter().map(|s| s.point).collect();
        Self {
            body,
            tree: Neighbors::new(&points),
            samples,
            spacing_mm,
        }
    }

    /// The samples of the nominal.
    pub fn samples(&self) -> &[BodySample] {
        &self.samples
    }

    /// Distance of the samples, mm.
    pub fn spacing_mm(&self) -> f64 {
        self.spacing_mm
    }

    /// The place of `p` on the nearest face whose outside is seen from `towards` (unit vector, where it is known), if it
    /// is not further away than `gate_mm`. `found` is scratch.
    pub fn place(
        &self,
        p: DVec3,
        towards: Option<DVec3>,
        gate_mm: f64,
        found: &mut Vec<(u32, f64)>,
    ) -> Place {
        self.tree.nearest(p, CANDIDATES, found);
        let mut best = (f64::INFINITY, NOWHERE);
        let mut faces = [NO_FACE; CANDIDATES];
        for (k, (index, squared)) in found.iter().enumerate() {
            let sample = &self.samples[*index as usize];
            if faces[..k].contains(&sample.face) {
                continue;
            }
            faces[k] = sample.face;
            // No place of this face is nearer than its nearest sample less the sampling.
            if squared.sqrt() - 2.0 * self.spacing_mm > best.0.min(gate_mm) {
                continue;
            }
            if let Some((distance, place)) = self.candidate(p, sample, towards)
                && distance < best.0
                && distance <= gate_mm
            {
                best = (distance, place);
            }
        }
        best.1
    }

    /// The place of `p` on the face of `sample`, with the distance that ranks it: to the trimmed face.
    fn candidate(
        &self,
        p: DVec3,
        sample: &BodySample,
        towards: Option<DVec3>,
    ) -> Option<(f64, Place)> {
        let foot = self.body.foot(sample.face, p, Some(sample.uv))?;
        if towards.is_some_and(|t| t.dot(foot.normal) < HORIZON) {
            return None;
        }
        let deviation_mm = (p - foot.point).dot(foot.normal);
        let distance = if self.body.contains(sample.face, foot.uv) {
            (p - foot.point).length()
        } else {
            // Beyond the boundary: the nearest sample stands for the nearest place.
            p.distance(sample.point).max(deviation_mm.abs())
        };
        let place = Place {
            face: sample.face,
            deviation_mm,
            normal: foot.normal,
            distance_mm: distance,
        };
        distance.is_finite().then_some((distance, place))
    }

    /// The places of all points of `cloud`, which lies in the part frame.
    pub fn places(&self, cloud: &PointCloud, gate_mm: f64) -> Vec<Place> {
        let positions = &cloud.positions;
        (0..positions.len())
            .into_par_iter()
            .map_init(Vec::new, |found, i| {
                self.place(positions[i], towards(cloud, i), gate_mm, found)
            })
            .collect()
    }
}

/// The direction from which point `i` was seen, where it is known.
pub fn towards(cloud: &PointCloud, i: usize) -> Option<DVec3> {
    let origin = cloud.origins.get(i)?;
    let view = cloud.views.get(origin.view as usize)?;
    (view.towards_sensor != DVec3::ZERO).then_some(view.towards_sensor)
}
