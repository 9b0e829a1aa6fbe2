//! The net of faces and edges of a part while its file is read, whatever the format.

use std::collections::BTreeMap;

use glam::DVec3;

use super::face::Face;
use super::part21::{Read, refuse};
use super::path::Path;
use super::sharp::{Joint, SharpEdge};
use super::trim::{Trim, UvLoop};
use super::{Edge, Nominal, NominalError, Refused, Wire};
use crate::geometry::{Curve, Frame, Surface};

/// Faces that one nominal may have.
const MAX_FACES: usize = 200_000;
/// Points of the polylines and control points that the faces and curves of one nominal may take together, each time that one
/// of them is used: a small file could otherwise use a large curve without end.
const MAX_POINTS: usize = 20_000_000;
/// Chord of the polylines that bound a face, as a share of the edge's length.
const CHORD: f64 = 2e-6;
/// Ends of edges nearer than this share of the part's size are one corner: writers round coordinates to 1e-6 of it and worse.
const CORNER_GAP: f64 = 1e-5;

/// An edge under construction.
pub(super) struct BuiltEdge {
    pub entity: u64,
    pub body: usize,
    pub path: Path,
    /// Its polyline for trimming, from start to end.
    pub points: Vec<DVec3>,
    pub uses: Vec<Use>,
}

/// One face's use of an edge.
#[derive(Debug, Clone, Copy)]
pub(super) struct Use {
    pub face: u32,
    /// Sign that makes outward normal x tangent point into the face.
    pub side: f64,
}

/// Faces and edges so far.
#[derive(Default)]
pub(super) struct Net {
    pub faces: Vec<Face>,
    pub edges: Vec<BuiltEdge>,
    pub wires: Vec<Wire>,
    pub loose_points: Vec<DVec3>,
    pub refused: Vec<Refused>,
    pub refused_faces: usize,
    /// Points taken so far.
    pub points: usize,
}

/// How a face lies on its surface and in its shell.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sense {
    /// Whether its normal is that of the surface.
    pub along: bool,
    /// Whether its shell uses it the other way round.
    pub against: bool,
    /// Whether its loops may run either way, as in files that do not say.
    pub guess: bool,
}

/// A loop before it is laid into the parameter plane: edges with their direction.
pub(super) type EdgeLoop = Vec<(usize, bool)>;

impl Net {
    /// Whether no more fits into one nominal.
    pub fn is_full(&self) -> bool {
        self.faces.len() + self.refused_faces > MAX_FACES || self.points > MAX_POINTS
    }

    pub fn check_size(&self, name: &str) -> Result<(), NominalError> {
        let name = || name.into();
        if self.points > MAX_POINTS {
            return Err(NominalError::TooDetailed {
                name: name(),
                limit: MAX_POINTS,
            });
        }
        if self.is_full() {
            return Err(NominalError::TooManyFaces {
                name: name(),
                limit: MAX_FACES,
            });
        }
        Ok(())
    }

    /// A new edge, a piece of a curve; its index.
    pub fn edge(&mut self, id: u64, body: usize, curve: Curve, range: (f64, f64)) -> Read<usize> {
        if self.points > MAX_POINTS {
            // The whole file is refused after this face.
            return Err(refuse(id, "no room for its points"));
        }
        let path = Path::new(curve, range);
        if !path.length_mm().is_finite() {
            return Err(refuse(id, "an edge without a finite length"));
        }
        let points = path.polyline(CHORD * path.length_mm());
        self.points += points.len();
        let index = self.edges.len();
        self.edges.push(BuiltEdge {
            entity: id,
            body,
            path,
            points: points.into_iter().map(|(_, p)| p).collect(),
            uses: Vec::new(),
        });
        Ok(index)
    }

    /// A new face with its edges' uses.
    pub fn face(
        &mut self,
        id: u64,
        body: usize,
        shape: Surface,
        loops: &[EdgeLoop],
        sense: Sense,
    ) -> Read<()> {
        self.take_points(id, &shape, loops)?;
        let (shape, turned) = self.used_part(shape, loops);
        // Loops run around the face's normal, which may be against the surface's.
        let (along, against) = (sense.along ^ turned, sense.against);
        let uv = |flip: bool| -> Vec<UvLoop> {
            let lay = |l: &EdgeLoop| self.lay(&shape, l, flip);
            loops.iter().map(lay).filter(|l| l.len() > 1).collect()
        };
        let build = |flip: bool| {
            let trim = Trim::new(&uv(flip), shape.ranges());
            Face::new(id, body, shape.clone(), trim, along ^ against)
        };
        let mut face = build(!along);
        let flipped = !face.area_mm2().is_finite() || face.area_mm2() <= 0.0;
        if flipped {
            // Loops that leave the surface unbounded, or nothing of it, run the wrong way round.
            face = build(along);
        } else if sense.guess {
            // Either way may bound a part of the surface: a face is rather the smaller one.
            let other = build(along);
            if other.area_mm2() > 0.0 && other.area_mm2() < 0.999 * face.area_mm2() {
                face = other;
            }
        }
        if !face.area_mm2().is_finite() || face.area_mm2() <= 0.0 {
            return Err(refuse(
                id,
                format!(
                    "its {} loops enclose no area of its {}",
                    loops.len(),
                    shape.kind()
                ),
            ));
        }
        let index = self.faces.len() as u32;
        for (edge, forward) in loops.concat() {
            let side = if forward ^ against { 1.0 } else { -1.0 };
            self.edges[edge].uses.push(Use { face: index, side });
        }
        self.faces.push(face);
        Ok(())
    }

    /// Turns the faces from `first` on so that neighbours look the same way, and each closed set of them outward.
    pub fn turn_alike(&mut self, first: usize, first_edge: usize) {
        let count = self.faces.len() - first;
        let mut around: Vec<Vec<(usize, bool)>> = vec![Vec::new(); count];
        let mut open = vec![false; count];
        for i in first_edge..self.edges.len() {
            for k in 0..self.edges[i].uses.len() {
                let u = self.edges[i].uses[k];
                self.edges[i].uses[k].side = self.true_side(&self.edges[i].path, u);
            }
            match self.edges[i].uses[..] {
                [a, b] if a.face != b.face => {
                    let (f, g) = (a.face as usize - first, b.face as usize - first);
                    // Neighbours that look the same way have the edge on different sides.
                    let alike = a.side != b.side;
                    around[f].push((g, alike));
                    around[g].push((f, alike));
                }
                [a] => open[a.face as usize - first] = true,
                _ => {}
            }
        }
        let mut turned: Vec<Option<bool>> = vec![None; count];
        for start in 0..count {
            if turned[start].is_some() {
                continue;
            }
            turned[start] = Some(false);
            let mut set = vec![start];
            let mut next = 0;
            while let Some(f) = set.get(next).copied() {
                next += 1;
                for (g, alike) in &around[f] {
                    if turned[*g].is_none() {
                        turned[*g] = turned[f].map(|t| t ^ !alike);
                        set.push(*g);
                    }
                }
            }
            let sign = |f: usize| if turned[f] == Some(true) { -1.0 } else { 1.0 };
            let volume: f64 = set
                .iter()
                .map(|f| sign(*f) * self.faces[first + f].volume_mm3())
                .sum();
            // A few gaps leave the sign of a volume; an open skin has none.
            let gaps = set.iter().filter(|f| open[**f]).count();
            if volume < 0.0 && 4 * gaps <= set.len() {
                for f in set {
                    turned[f] = turned[f].map(|t| !t);
                }
            }
        }
        for (f, _) in turned.iter().enumerate().filter(|(_, t)| **t == Some(true)) {
            self.faces[first + f].turn_over();
        }
        for u in self.edges[first_edge..]
            .iter_mut()
            .flat_map(|e| &mut e.uses)
        {
            if turned[u.face as usize - first] == Some(true) {
                u.side = -u.side;
            }
        }
    }

    /// The side of an edge on which a face lies, by looking.
    fn true_side(&self, path: &Path, u: Use) -> f64 {
        let face = &self.faces[u.face as usize];
        let length_mm = path.length_mm();
        for (share, step) in [(0.5, 2e-4), (0.3, 1e-3), (0.7, 1e-2)] {
            let (point, tangent) = path.at(share * length_mm);
            let Some(foot) = face.foot(point, None) else {
                continue;
            };
            let into = foot.normal.cross(tangent);
            let inside = |step_mm: f64| {
                let foot = face.foot(point + into * step_mm, None);
                foot.is_some_and(|f| face.contains(f.uv))
            };
            match (inside(step * length_mm), inside(-step * length_mm)) {
                (true, false) => return 1.0,
                (false, true) => return -1.0,
                _ => {}
            }
        }
        u.side
    }

    /// A solid whose faces all look inward is turned over.
    pub fn turn_over(&mut self, first: usize, body: usize) {
        self.faces[first..].iter_mut().for_each(Face::turn_over);
        let edges = self.edges.iter_mut().filter(|e| e.body == body);
        for u in edges.flat_map(|e| &mut e.uses) {
            u.side = -u.side;
        }
    }

    /// Counts the points of a face; refuses loops that use one edge more than twice, which a seam does.
    fn take_points(&mut self, id: u64, surface: &Surface, loops: &[EdgeLoop]) -> Read<()> {
        let mut times: BTreeMap<usize, u32> = BTreeMap::new();
        for (edge, _) in loops.iter().flatten() {
            let built = &self.edges[*edge];
            let times = times.entry(*edge).or_default();
            *times += 1;
            if *times > 2 {
                let entity = built.entity;
                return Err(refuse(
                    id,
                    format!("its loops use edge #{entity} more than twice"),
                ));
            }
            self.points += built.points.len();
        }
        self.points += match surface {
            Surface::Nurbs(s) => s.control_points().len(),
            Surface::Swept(s) => match s.profile() {
                Curve::Nurbs(c) => c.control_points().len(),
                _ => 1,
            },
            _ => 1,
        };
        Ok(())
    }

    /// The part of a surface crossing itself on which the edges lie, and whether its normal is then turned.
    ///
    /// Files may use a cone beyond its apex and a torus inside its own tube, where the radius runs below zero.
    fn used_part(&self, surface: Surface, loops: &[EdgeLoop]) -> (Surface, bool) {
        let edges = loops.iter().flatten();
        let points = edges.flat_map(|(e, _)| &self.edges[*e].points);
        match surface {
            Surface::Cone {
                frame,
                radius_mm,
                half_angle_rad,
            } => {
                let apex = frame.origin - frame.z * (radius_mm / half_angle_rad.tan());
                let height: f64 = points.map(|p| (*p - apex).dot(frame.z)).sum();
                if height >= 0.0 {
                    return (surface, false);
                }
                let far_side = Surface::Cone {
                    frame: Frame {
                        origin: apex,
                        y: -frame.y,
                        z: -frame.z,
                        ..frame
                    },
                    radius_mm: 0.0,
                    half_angle_rad,
                };
                (far_side, false)
            }
            Surface::Torus {
                frame,
                major_mm,
                minor_mm,
            } if major_mm.abs() < minor_mm => {
                let inner = Surface::Torus {
                    frame,
                    major_mm: -major_mm,
                    minor_mm,
                };
                let miss = |s: &Surface, p: &DVec3| {
                    let (u, v) = s.nearest(*p, None);
                    s.point(u, v).distance(*p)
                };
                let lean: f64 = points.map(|p| miss(&surface, p) - miss(&inner, p)).sum();
                if lean > 0.0 {
                    (inner, true)
                } else {
                    (surface, false)
                }
            }
            other => (other, false),
        }
    }

    /// A loop in the parameters of a surface, material on the left; `flip` where it runs the other way.
    fn lay(&self, surface: &Surface, edges: &EdgeLoop, flip: bool) -> UvLoop {
        let mut points: Vec<DVec3> = Vec::new();
        for (edge, forward) in edges {
            let e = &self.edges[*edge];
            let thick = densify(&e.points, surface, &e.path);
            let way: Box<dyn Iterator<Item = &DVec3>> = if *forward {
                Box::new(thick.iter())
            } else {
                Box::new(thick.iter().rev())
            };
            // The first point is the last one of the edge before.
            let skip = usize::from(!points.is_empty());
            points.extend(way.skip(skip));
        }
        if flip {
            points.reverse();
        }
        super::unroll::unroll(surface, &points)
    }

    pub fn finish(self, name: &str, bodies: usize) -> Nominal {
        let mut sharp_edges = Vec::new();
        for e in &self.edges {
            sharp_edges.extend(sharp_of(e, &self.faces));
        }
        for (i, s) in sharp_edges.iter_mut().enumerate() {
            s.id = format!("e{}", i + 1);
        }
        let faces_box_mm = bounding_box(&self.faces, &self.edges);
        let size_mm = faces_box_mm[0].distance(faces_box_mm[1]);
        let corners = super::corner::corners(&sharp_edges, CORNER_GAP * size_mm);
        let wires = self.wires.iter();
        let wires = wires.flat_map(|w| Path::new(w.curve.clone(), w.range).extremes());
        let loose = wires.chain(self.loose_points);
        let bounding_box_mm = loose.fold(faces_box_mm, |[low, high], p| [low.min(p), high.max(p)]);
        let mut borders: Vec<Vec<u32>> = vec![Vec::new(); self.faces.len()];
        for (i, e) in self.edges.iter().enumerate() {
            for u in &e.uses {
                borders[u.face as usize].push(i as u32);
            }
        }
        let paths = self.edges.iter().map(|e| e.path.clone()).collect();
        let edges = self.edges.into_iter().map(|e| {
            let mut faces: Vec<u32> = e.uses.iter().map(|u| u.face).collect();
            faces.sort_unstable();
            Edge {
                entity: e.entity,
                body: e.body,
                curve: e.path.curve().clone(),
                range: e.path.range(),
                faces,
                length_mm: e.path.length_mm(),
            }
        });
        Nominal {
            name: name.into(),
            bodies,
            edges: edges.collect(),
            faces: self.faces,
            sharp_edges,
            refused: self.refused,
            wires: self.wires,
            bounding_box_mm,
            faces_box_mm,
            corners,
            pmi: Vec::new(),
            paths,
            borders,
        }
    }
}

/// A polyline with points enough for a surface on which straight lines are bent in the parameters.
fn densify(points: &[DVec3], surface: &Surface, path: &Path) -> Vec<DVec3> {
    let straight_in_uv = matches!(surface, Surface::Plane(_))
        || (matches!(surface, Surface::Cylinder { .. } | Surface::Cone { .. })
            && matches!(path.curve(), Curve::Line { .. }));
    const LEAST: usize = 33;
    if straight_in_uv || points.len() >= LEAST {
        return points.to_vec();
    }
    let at = |i: usize| path.at(path.length_mm() * i as f64 / (LEAST - 1) as f64).0;
    let mut dense: Vec<DVec3> = (0..LEAST).map(at).collect();
    // Ends stay the very same points as on the neighbours.
    dense[0] = points[0];
    dense[LEAST - 1] = points[points.len() - 1];
    dense
}

/// The sharp stretches of an edge between two different faces.
fn sharp_of(e: &BuiltEdge, faces: &[Face]) -> Vec<SharpEdge> {
    let [a, b] = e.uses[..] else {
        return Vec::new();
    };
    if a.face == b.face || e.path.length_mm() <= 0.0 {
        return Vec::new();
    }
    let mut joint = Joint {
        path: &e.path,
        faces: [&faces[a.face as usize], &faces[b.face as usize]],
        sides: [a.side, b.side],
    };
    joint.correct_sides();
    let sides = joint.sides;
    let whole = (0.0, e.path.length_mm());
    let stretches = joint.sharp_stretches();
    let cut = |(from, to, kind)| {
        let path = if (from, to) == whole {
            e.path.clone()
        } else {
            let range = (e.path.parameter(from), e.path.parameter(to));
            Path::new(e.path.curve().clone(), range)
        };
        SharpEdge {
            id: String::new(),
            entity: e.entity,
            faces: [a.face, b.face],
            kind,
            length_mm: path.length_mm(),
            closed: path.is_closed(),
            path,
            sides,
        }
    };
    stretches.into_iter().map(cut).collect()
}

/// Box of the edges and of what bulges beyond them.
fn bounding_box(faces: &[Face], edges: &[BuiltEdge]) -> [DVec3; 2] {
    let mut bounds = [DVec3::INFINITY, DVec3::NEG_INFINITY];
    let mut add = |p: DVec3| {
        bounds[0] = bounds[0].min(p);
        bounds[1] = bounds[1].max(p);
    };
    for e in edges.iter().filter(|e| !e.uses.is_empty()) {
        e.path.extremes().into_iter().for_each(&mut add);
    }
    for face in faces {
        for p in super::extremes::extremes(face) {
            add(p);
        }
    }
    bounds
}
