//! Sharp edges: where two faces meet at an angle.

use glam::DVec3;

use super::path::Path;
use super::{EdgeKind, Face, Foot, Nominal, Station};
use crate::geometry::Curve;

/// Smallest turn angle of a sharp edge, 5 degrees.
///
/// Writers leave tangent-continuous faces within a few tenths of a degree of each other; machined edges turn by 10 degrees
/// and more. Where the angle of an edge falls below this on a part of its length, that part is left out.
pub const MIN_TURN_ANGLE_RAD: f64 = 5.0 * std::f64::consts::PI / 180.0;

/// Places at which the turn angle of an edge is looked at.
const PROBES: usize = 32;
/// Halvings that place the end of a sharp stretch.
const HALVINGS: usize = 30;

/// An edge, or the part of one, at which the outward normals of its two faces differ.
#[derive(Debug, Clone, PartialEq)]
pub struct SharpEdge {
    /// `e1`, `e2` ...
    pub id: String,
    /// Number of the EDGE_CURVE in the file.
    pub entity: u64,
    /// Indices of its faces.
    pub faces: [u32; 2],
    /// Convex or concave.
    pub kind: EdgeKind,
    /// In mm.
    pub length_mm: f64,
    /// Whether it ends where it starts.
    pub closed: bool,
    pub(super) path: Path,
    /// Sign that makes normal x tangent point into each face.
    pub(super) sides: [f64; 2],
}

/// An edge with the two faces that use it.
#[derive(Clone, Copy)]
pub(super) struct Joint<'a> {
    pub path: &'a Path,
    pub faces: [&'a Face; 2],
    pub sides: [f64; 2],
}

/// How the faces meet at a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Meeting {
    Smooth,
    Sharp(EdgeKind),
}

type Hints = [Option<(f64, f64)>; 2];

impl SharpEdge {
    /// The middles of equal parts of about `step_mm`, in order of arc length.
    ///
    /// The ends, where a third face begins, are no stations. At most 100,000 stations.
    pub fn stations(&self, nominal: &Nominal, step_mm: f64) -> Vec<Station> {
        let parts = (self.length_mm / step_mm).round();
        let parts = if parts.is_finite() {
            parts.clamp(1.0, 100_000.0) as usize
        } else {
            1
        };
        let part = self.length_mm / parts as f64;
        let mut hints = [None; 2];
        (0..parts)
            .map(|i| self.station_near(nominal, part * (i as f64 + 0.5), &mut hints))
            .collect()
    }

    /// The station at an arc length, clamped to the ends.
    pub fn station(&self, nominal: &Nominal, s_mm: f64) -> Station {
        self.station_near(nominal, s_mm, &mut [None; 2])
    }

    /// The whole curve under the edge.
    pub fn curve(&self) -> &Curve {
        self.path.curve()
    }

    /// Position at an arc length, clamped to the ends, mm.
    pub fn point(&self, s_mm: f64) -> DVec3 {
        self.path.at(s_mm).0
    }

    /// Arc length of the nearest place on the edge, and its distance, both mm.
    pub fn nearest(&self, p: DVec3) -> (f64, f64) {
        self.path.nearest(p)
    }

    /// Points along the edge, the chords between them at most `chord_mm` beside it.
    pub fn polyline(&self, chord_mm: f64) -> Vec<DVec3> {
        let points = self.path.polyline(chord_mm);
        points.into_iter().map(|(_, p)| p).collect()
    }

    /// Angle between the outward normals at an arc length, rad.
    pub fn turn_angle_rad(&self, nominal: &Nominal, s_mm: f64) -> f64 {
        let [a, b] = self.station(nominal, s_mm).normals;
        a.cross(b).length().atan2(a.dot(b))
    }

    fn station_near(&self, nominal: &Nominal, s_mm: f64, hints: &mut Hints) -> Station {
        let joint = Joint {
            path: &self.path,
            faces: self.faces.map(|f| &nominal.faces[f as usize]),
            sides: self.sides,
        };
        let s_mm = s_mm.clamp(0.0, self.length_mm);
        let inward = (0.5 * self.length_mm - s_mm) * 1e-6;
        joint
            .station(s_mm, hints)
            // At an end that is the apex of a cone the normals are those just before it.
            .or_else(|| joint.station(s_mm + inward, hints))
            .unwrap_or_else(|| {
                let (point, tangent) = self.path.at(s_mm);
                let n = tangent.any_orthonormal_vector();
                Station {
                    s_mm,
                    point,
                    tangent,
                    normals: [n, n],
                    into_face: [tangent.cross(n), n.cross(tangent)],
                }
            })
    }
}

impl Joint<'_> {
    /// The frame at an arc length; `None` where a face has no normal.
    fn station(&self, s_mm: f64, hints: &mut Hints) -> Option<Station> {
        let (point, tangent) = self.path.at(s_mm);
        let mut normals = [DVec3::ZERO; 2];
        let mut into_face = [DVec3::ZERO; 2];
        for i in 0..2 {
            let foot = self.foot(i, point, hints[i])?;
            hints[i] = Some(foot.uv);
            normals[i] = foot.normal;
            into_face[i] = (foot.normal.cross(tangent) * self.sides[i]).try_normalize()?;
        }
        Some(Station {
            s_mm,
            point,
            tangent,
            normals,
            into_face,
        })
    }

    /// The edge lies on the face, so a hint that ends elsewhere led astray.
    fn foot(&self, i: usize, point: DVec3, hint: Option<(f64, f64)>) -> Option<Foot> {
        let stray = 1e-3 * self.path.length_mm();
        if let Some(near) = hint {
            let foot = self.faces[i].foot(point, Some(near));
            if let Some(f) = foot.filter(|f| f.point.distance(point) <= stray) {
                return Some(f);
            }
        }
        self.faces[i].foot(point, None)
    }

    /// Turns the direction into a face where a step that way leaves it and the other way stays: loops of some files
    /// run against the sense of their faces.
    pub fn correct_sides(&mut self) {
        let length_mm = self.path.length_mm();
        let Some(at) = self.station(0.5 * length_mm, &mut [None; 2]) else {
            return;
        };
        for i in 0..2 {
            let inside = |step_mm: f64| {
                let p = at.point + at.into_face[i] * step_mm;
                let foot = self.faces[i].foot(p, None);
                foot.is_some_and(|f| self.faces[i].contains(f.uv))
            };
            // Longer than the chord of the borders, shorter than any face worth measuring.
            let step_mm = 2e-4 * length_mm;
            if !inside(step_mm) && inside(-step_mm) {
                self.sides[i] = -self.sides[i];
            }
        }
    }

    fn meeting(&self, s_mm: f64, hints: &mut Hints) -> Meeting {
        let Some(at) = self.station(s_mm, hints) else {
            return Meeting::Smooth;
        };
        let [a, b] = at.normals;
        if a.cross(b).length().atan2(a.dot(b)) < MIN_TURN_ANGLE_RAD {
            return Meeting::Smooth;
        }
        // Face 1 leaves the edge behind the plane of face 2: material inside the angle.
        let rise = at.into_face[0].dot(b) + at.into_face[1].dot(a);
        Meeting::Sharp(if rise <= 0.0 {
            EdgeKind::Convex
        } else {
            EdgeKind::Concave
        })
    }

    /// Stretches of the edge (arc lengths) that are sharp, each of one kind.
    pub fn sharp_stretches(&self) -> Vec<(f64, f64, EdgeKind)> {
        let length = self.path.length_mm();
        let at = |i: usize| length * (i as f64 + 0.5) / PROBES as f64;
        let mut hints = [None; 2];
        let meetings: Vec<Meeting> = (0..PROBES)
            .map(|i| self.meeting(at(i), &mut hints))
            .collect();
        let mut out = Vec::new();
        let mut i = 0;
        while i < PROBES {
            let mut end = i + 1;
            while end < PROBES && meetings[end] == meetings[i] {
                end += 1;
            }
            if let Meeting::Sharp(kind) = meetings[i] {
                let from = if i == 0 {
                    0.0
                } else {
                    self.border(at(i), at(i - 1), meetings[i])
                };
                let to = if end == PROBES {
                    length
                } else {
                    self.border(at(end - 1), at(end), meetings[i])
                };
                // One probe alone is the rounding of a nearly smooth edge.
                if end - i > 1 {
                    out.push((from, to, kind));
                }
            }
            i = end;
        }
        out
    }

    /// Where a stretch of `meeting` ends, between a place inside and one outside.
    fn border(&self, mut inside: f64, mut outside: f64, meeting: Meeting) -> f64 {
        for _ in 0..HALVINGS {
            let middle = 0.5 * (inside + outside);
            if self.meeting(middle, &mut [None; 2]) == meeting {
                inside = middle;
            } else {
                outside = middle;
            }
        }
        inside
    }
}
