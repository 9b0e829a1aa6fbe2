//! Which face of the nominal every point of an aligned scan belongs to, and how far from it it lies.

pub(in crate::inspect) mod grid;

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use super::body::{Body, BodySample};
use crate::nominal::Foot;
use crate::points::PointCloud;
use crate::points::neighbors::Neighbors;

pub(super) use grid::Near;
use grid::{Grid, sample_of};

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
    sampled: Arc<Sampled>,
}

/// Samples of a nominal and what finds them: some tenths of a second of work, so that who inspects many parts keeps it.
pub struct Sampled {
    samples: Vec<BodySample>,
    tree: Neighbors,
    grid: Grid,
    /// See [`Body::smooth_pairs`].
    smooth: Vec<[u32; 2]>,
    spacing_mm: f64,
    size_mm: f64,
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

impl Sampled {
    /// Samples `body` finely enough that the nearest sample tells the nearest face: 1/200 of its diagonal.
    pub fn new<B: Body>(body: &B) -> Self {
        let [low, high] = body.bounds();
        let spacing_mm = ((high - low).length() / 200.0).max(1e-9);
        let samples = body.samples(spacing_mm);
        let points: Vec<DVec3> = samples.iter().map(|s| s.point).collect();
        let tree = Neighbors::new(&points);
        Self {
            grid: Grid::new(body, &samples, &tree, spacing_mm),
            tree,
            samples,
            smooth: body.smooth_pairs(),
            spacing_mm,
            size_mm: (0.5 * (high - low).length()).max(1e-9),
        }
    }
}

impl std::fmt::Debug for Sampled {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Sampled")
            .field("samples", &self.samples.len())
            .field("spacing_mm", &self.spacing_mm)
            .finish_non_exhaustive()
    }
}

impl<'a, B: Body> Surface<'a, B> {
    /// Samples `body`.
    pub fn new(body: &'a B) -> Self {
        Self::sampled(body, Arc::new(Sampled::new(body)))
    }

    /// With the samples that were made of `body`.
    pub fn sampled(body: &'a B, sampled: Arc<Sampled>) -> Self {
        Self { body, sampled }
    }

    /// The samples of the nominal.
    pub fn samples(&self) -> &[BodySample] {
        &self.sampled.samples
    }

    /// Half the diagonal of the nominal's bounds, mm.
    pub(super) fn size_mm(&self) -> f64 {
        self.sampled.size_mm
    }

    /// Distance of the samples, mm.
    pub fn spacing_mm(&self) -> f64 {
        self.sampled.spacing_mm
    }

    /// The sample nearest to `p` within a few spacings, seen from the nominal's box where `p` lies outside of it.
    pub(super) fn near(&self, p: DVec3) -> Option<&Near> {
        self.sampled.grid.near(p)
    }

    /// As [`Surface::near`], three times as rough and faster.
    pub(super) fn rough(&self, p: DVec3) -> Option<&Near> {
        self.sampled.grid.rough(p)
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
        let mut best = Candidate::NONE;
        for candidate in self.sampled.grid.candidates(p) {
            let (index, middle) = sample_of(*candidate);
            let limit = (best.place.distance_mm, middle);
            if let Some(new) = self.candidate(p, &self.sampled.samples[index], towards, limit)
                && new.place.distance_mm < best.place.distance_mm
            {
                best = new;
            }
        }
        if best.inside && best.place.distance_mm <= gate_mm {
            return best.place;
        }
        self.nearest_of_samples(p, towards, gate_mm, found)
    }

    /// As [`Surface::place`], with the distance of the foot from the nearest edge between its face and another one into which it
    /// does not pass smoothly, mm, as far as faces near the foot tell: infinite in the middle of a face.
    ///
    /// All is asked of the foot, nothing of the point: what is chosen by the noise of the points is no longer free of bias.
    pub(super) fn place_and_rim(
        &self,
        p: DVec3,
        towards: Option<DVec3>,
        gate_mm: f64,
        found: &mut Vec<(u32, f64)>,
    ) -> (Place, f64) {
        let place = self.place(p, towards, gate_mm, found);
        let mut rim = f64::INFINITY;
        if place.face == NO_FACE {
            return (place, rim);
        }
        let on = p - place.deviation_mm * place.normal;
        for candidate in self.sampled.grid.candidates(on) {
            let sample = &self.sampled.samples[sample_of(*candidate).0];
            if sample.face == place.face || self.pass_smoothly(sample.face, place.face) {
                continue;
            }
            let Some(foot) = self.body.foot(sample.face, on, Some(sample.uv)) else {
                continue;
            };
            if towards.is_none_or(|t| t.dot(foot.normal) >= HORIZON) {
                rim = rim.min(distance_of_edge(place.normal, on, &foot));
            }
        }
        (place, rim)
    }

    fn pass_smoothly(&self, a: u32, b: u32) -> bool {
        let pair = [a.min(b), a.max(b)];
        self.sampled.smooth.binary_search(&pair).is_ok()
    }

    /// The place by the nearest samples: wherever the cells do not tell.
    fn nearest_of_samples(
        &self,
        p: DVec3,
        towards: Option<DVec3>,
        gate_mm: f64,
        found: &mut Vec<(u32, f64)>,
    ) -> Place {
        // No place of a face is nearer than its nearest sample less the sampling.
        let reach_mm = gate_mm + 2.0 * self.sampled.spacing_mm;
        self.sampled
            .tree
            .nearest_within(p, CANDIDATES, reach_mm, found);
        let mut best = Candidate::NONE;
        let mut faces = [NO_FACE; CANDIDATES];
        for (k, (index, squared)) in found.iter().enumerate() {
            let sample = &self.sampled.samples[*index as usize];
            if faces[..k].contains(&sample.face) {
                continue;
            }
            faces[k] = sample.face;
            if squared.sqrt() - 2.0 * self.sampled.spacing_mm > best.place.distance_mm {
                continue;
            }
            if let Some(new) = self.candidate(p, sample, towards, (f64::INFINITY, false))
                && new.place.distance_mm < best.place.distance_mm
                && new.place.distance_mm <= gate_mm
            {
                best = new;
            }
        }
        best.place
    }

    /// The place of `p` on the face of `sample`, with the distance that ranks it: to the trimmed face. A face that lies
    /// further away than `limit_mm`, or is known to have `p` in its middle, is not asked for its boundary.
    fn candidate(
        &self,
        p: DVec3,
        sample: &BodySample,
        towards: Option<DVec3>,
        (limit_mm, middle): (f64, bool),
    ) -> Option<Candidate> {
        let foot = self.body.foot(sample.face, p, Some(sample.uv))?;
        if towards.is_some_and(|t| t.dot(foot.normal) < HORIZON) {
            return None;
        }
        let deviation_mm = (p - foot.point).dot(foot.normal);
        let straight_mm = (p - foot.point).length();
        let inside = straight_mm < limit_mm && (middle || self.body.contains(sample.face, foot.uv));
        let distance_mm = if inside {
            straight_mm
        } else {
            // Beyond the boundary: the nearest sample stands for the nearest place.
            p.distance(sample.point).max(straight_mm)
        };
        let place = Place {
            face: sample.face,
            deviation_mm,
            normal: foot.normal,
            distance_mm,
        };
        distance_mm
            .is_finite()
            .then_some(Candidate { place, inside })
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

/// A face that may be the nearest.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    place: Place,
    /// Whether the foot lies inside the face's boundary.
    inside: bool,
}

impl Candidate {
    const NONE: Self = Self {
        place: NOWHERE,
        inside: false,
    };
}

/// Distance of the place `on` of one face, of this normal there, from where its plane meets the plane of another face at the foot
/// of `on`; infinite where they are tangent to each other.
fn distance_of_edge(normal: DVec3, on: DVec3, other: &Foot) -> f64 {
    let sine = normal.cross(other.normal).length();
    // Below 5 degrees an edge is none: see the nominal's sharp edges.
    if sine < 0.0872 {
        return f64::INFINITY;
    }
    (on - other.point).dot(other.normal).abs() / sine
}

/// The direction from which point `i` was seen, where it is known.
pub fn towards(cloud: &PointCloud, i: usize) -> Option<DVec3> {
    let origin = cloud.origins.get(i)?;
    let view = cloud.views.get(origin.view as usize)?;
    (view.towards_sensor != DVec3::ZERO).then_some(view.towards_sensor)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::nominal::Nominal;

    #[test]
    fn noise_does_not_move_a_point_to_or_from_an_edge() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
        let nominal = Nominal::read(&path).expect("the demo's part");
        let surface = Surface::new(&nominal);
        let mut found = Vec::new();
        let mut near_an_edge = 0;
        for sample in Nominal::samples(&nominal, 0.7) {
            let [above, below] = [0.01, -0.01].map(|noise_mm| {
                let p = sample.point + noise_mm * sample.normal;
                surface.place_and_rim(p, None, 1.0, &mut found)
            });
            if above.0.face != below.0.face || above.1 > 2.0 {
                continue;
            }
            near_an_edge += 1;
            // Feet are found to far less.
            assert!((above.1 - below.1).abs() < 1e-6, "{above:?}, {below:?}");
        }
        assert!(near_an_edge > 1_000, "{near_an_edge}");
    }
}
