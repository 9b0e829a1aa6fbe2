//! From entities to faces, edges and sharp edges.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use super::bodies::{BODIES, Placed, Places, placed_bodies};
use super::face::Face;
use super::part21::{Part21, Read, refuse};
use super::path::Path;
use super::shapes::{Shapes, edge_range};
use super::sharp::{Joint, SharpEdge};
use super::trim::{Trim, UvLoop};
use super::{Edge, Nominal, NominalError, Refused, Wire};
use crate::geometry::{Curve, Frame, RigidTransform, Surface};

/// Faces that one nominal may have.
const MAX_FACES: usize = 200_000;
/// Points of the polylines and control points that the faces and curves of one nominal may take together, each time that one
/// of them is used: a small file could otherwise use a large curve without end.
const MAX_POINTS: usize = 20_000_000;
/// Chord of the polylines that bound a face, as a share of the edge's length.
const CHORD: f64 = 8e-6;
/// Ends of edges nearer than this share of the part's size are one corner: writers round coordinates to 1e-6 of it and worse.
const CORNER_GAP: f64 = 1e-5;

/// Reads a nominal from the text of a STEP file.
pub(super) fn build(bytes: &[u8], name: &str) -> Result<Nominal, NominalError> {
    let file = Part21::parse(bytes, name)?;
    let Places {
        bodies: places,
        wireframes,
        refused,
    } = placed_bodies(&file, name)?;
    if places.is_empty() {
        return Err(NominalError::NoShape {
            name: name.into(),
            found: what_instead(&file),
        });
    }
    let mut b = Builder {
        file: &file,
        faces: Vec::new(),
        edges: Vec::new(),
        wires: Vec::new(),
        loose_points: Vec::new(),
        refused,
        refused_faces: 0,
        points: 0,
    };
    let bodies = places.len();
    for (body, place) in places.iter().enumerate() {
        if let Err(why) = b.body(body, place) {
            b.refused.push(why);
        }
        b.check_size(name)?;
    }
    if b.faces.is_empty() {
        let none = || refuse(places[0].body, "it has no faces");
        return Err(NominalError::NothingUsable {
            name: name.into(),
            faces: b.refused_faces,
            first: b.refused.first().cloned().unwrap_or_else(none),
        });
    }
    for place in &wireframes {
        b.wireframe(place);
        b.check_size(name)?;
    }
    Ok(b.finish(name, bodies))
}

/// What a file without bodies holds instead, in words.
fn what_instead(file: &Part21) -> String {
    let kinds = [
        ("TESSELLATED_SOLID", "tessellated solid"),
        ("TESSELLATED_SHELL", "tessellated shell"),
        ("COMPLEX_TRIANGULATED_FACE", "tessellated face"),
        ("TRIANGULATED_FACE", "tessellated face"),
        ("COMPLEX_TRIANGULATED_SURFACE_SET", "tessellated surface"),
        ("GEOMETRIC_CURVE_SET", "wireframe"),
        ("GEOMETRIC_SET", "geometric set"),
        ("CSG_SOLID", "CSG solid"),
        ("ADVANCED_FACE", "loose face"),
    ];
    let found: Vec<String> = kinds
        .iter()
        .filter_map(|(entity, word)| {
            let ids: Vec<u64> = file.all(&[entity]).collect();
            let first = ids.first()?;
            let s = if ids.len() == 1 { "" } else { "s" };
            Some(format!("{} {word}{s} (#{first} {entity})", ids.len()))
        })
        .collect();
    if found.is_empty() {
        format!("{} entities of other kinds", file.entities().len())
    } else {
        found.join(", ")
    }
}

/// An edge under construction.
struct BuiltEdge {
    entity: u64,
    body: usize,
    path: Path,
    /// Its polyline for trimming, from start to end.
    points: Vec<DVec3>,
    uses: Vec<Use>,
}

/// One face's use of an edge.
#[derive(Debug, Clone, Copy)]
struct Use {
    face: u32,
    /// Sign that makes outward normal x tangent point into the face.
    side: f64,
}

struct Builder<'a> {
    file: &'a Part21,
    faces: Vec<Face>,
    edges: Vec<BuiltEdge>,
    wires: Vec<Wire>,
    loose_points: Vec<DVec3>,
    refused: Vec<Refused>,
    refused_faces: usize,
    /// Points taken so far.
    points: usize,
}

/// What stays the same within one body.
struct BodyCx<'a> {
    index: usize,
    shapes: Shapes<'a>,
    place: RigidTransform,
    /// Entity of an edge to its index.
    edges: BTreeMap<u64, usize>,
}

/// A face of a shell, and whether it is used against its own sense.
type ShellFace = (u64, bool);

/// A loop before it is laid into the parameter plane: edges with their direction.
type EdgeLoop = Vec<(usize, bool)>;

impl<'a> Builder<'a> {
    /// Whether no more fits into one nominal.
    fn is_full(&self) -> bool {
        self.faces.len() + self.refused_faces > MAX_FACES || self.points > MAX_POINTS
    }

    fn check_size(&self, name: &str) -> Result<(), NominalError> {
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

    fn body(&mut self, index: usize, place: &Placed) -> Read<()> {
        let mut cx = BodyCx {
            index,
            shapes: Shapes {
                file: self.file,
                units: place.units,
            },
            place: place.root_from_body,
            edges: BTreeMap::new(),
        };
        let first = self.faces.len();
        let mut seen = BTreeSet::new();
        for (face, against) in self.shell_faces(place.body)? {
            if self.is_full() {
                return Ok(());
            }
            let built = if seen.insert(face) {
                self.face(&mut cx, face, against)
            } else {
                Err(refuse(face, "the body lists it before"))
            };
            if let Err(why) = built {
                self.refused_faces += 1;
                self.refused.push(if why.entity == face {
                    why
                } else {
                    refuse(face, format!("#{}: {}", why.entity, why.reason))
                });
            }
        }
        let is_solid = !place_is_surface(self.file, place.body);
        let volume: f64 = self.faces[first..].iter().map(Face::volume_mm3).sum();
        if is_solid && volume < 0.0 {
            self.turn_over(first, index);
        }
        Ok(())
    }

    /// A solid whose faces all look inward is turned over.
    fn turn_over(&mut self, first: usize, body: usize) {
        self.faces[first..].iter_mut().for_each(Face::turn_over);
        let edges = self.edges.iter_mut().filter(|e| e.body == body);
        for u in edges.flat_map(|e| &mut e.uses) {
            u.side = -u.side;
        }
    }

    /// Faces of all shells of a body.
    fn shell_faces(&self, body: u64) -> Read<Vec<ShellFace>> {
        let record = self.file.record(body)?;
        let mut shells = match record.name {
            "SHELL_BASED_SURFACE_MODEL" | "FACE_BASED_SURFACE_MODEL" => record.references(1)?,
            _ => vec![record.reference(1)?],
        };
        if record.name == "BREP_WITH_VOIDS" {
            shells.extend(record.references(2)?);
        }
        let mut out = Vec::new();
        for shell in shells {
            let (shell, against) = self.unwrap_oriented(shell, "SHELL", 3)?;
            let faces = self.file.record(shell)?.references(1)?;
            for face in faces {
                let (face, turned) = self.unwrap_oriented(face, "ORIENTED_FACE", 3)?;
                out.push((face, against ^ turned));
            }
        }
        Ok(out)
    }

    /// Follows ORIENTED_... wrappers (element at position 2) to the thing itself.
    fn unwrap_oriented(&self, mut id: u64, what: &str, flag: usize) -> Read<(u64, bool)> {
        let mut against = false;
        for _ in 0..8 {
            let r = self.file.record(id)?;
            if !(r.name.starts_with("ORIENTED_") && r.name.ends_with(what)) {
                return Ok((id, against));
            }
            against ^= !r.flag(flag)?;
            id = r.reference(2)?;
        }
        Err(refuse(id, "orientations nested too deep"))
    }

    fn face(&mut self, cx: &mut BodyCx<'a>, id: u64, against: bool) -> Read<()> {
        let r = self.file.record(id)?;
        if r.name != "ADVANCED_FACE" && r.name != "FACE_SURFACE" {
            return Err(refuse(id, format!("a face of type {} is not read", r.name)));
        }
        let surface = cx.shapes.surface(r.reference(2)?)?;
        let mut loops = Vec::new();
        for bound in r.references(1)? {
            loops.extend(self.bound(cx, bound)?);
        }
        self.take_points(id, &surface.shape, &loops)?;
        let shape = surface.shape.transformed(&cx.place);
        let (shape, turned) = self.used_part(shape, &loops);
        // Loops run around the face's normal, which may be against the surface's.
        let along = r.flag(3)? ^ surface.reversed ^ turned;
        let uv = |flip: bool| -> Vec<UvLoop> {
            let lay = |l: &EdgeLoop| self.lay(&shape, l, flip);
            loops.iter().map(lay).filter(|l| l.len() > 1).collect()
        };
        let build = |flip: bool| {
            let trim = Trim::new(&uv(flip), shape.ranges());
            Face::new(id, cx.index, shape.clone(), trim, along ^ against)
        };
        let mut face = build(!along);
        if !face.area_mm2().is_finite() {
            // Loops that leave the surface unbounded run the wrong way round.
            face = build(along);
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

    /// The edges of one bound in the order and direction in which the face has them on its left; none for a vertex.
    fn bound(&mut self, cx: &mut BodyCx<'a>, id: u64) -> Read<Option<EdgeLoop>> {
        let r = self.file.record(id)?;
        if !matches!(r.name, "FACE_BOUND" | "FACE_OUTER_BOUND") {
            return Err(refuse(
                id,
                format!("a bound of type {} is not read", r.name),
            ));
        }
        let (inner, as_is) = (self.file.record(r.reference(1)?)?, r.flag(2)?);
        match inner.name {
            "VERTEX_LOOP" => return Ok(None),
            "EDGE_LOOP" => {}
            other => {
                return Err(refuse(
                    inner.id,
                    format!("a loop of type {other} is not read"),
                ));
            }
        }
        let mut out = EdgeLoop::new();
        for oriented in inner.references(1)? {
            let o = self.file.expect(oriented, "ORIENTED_EDGE")?;
            let edge = self.edge(cx, o.reference(3)?)?;
            out.push((edge, o.flag(4)? == as_is));
        }
        if !as_is {
            out.reverse();
        }
        Ok(Some(out))
    }

    /// Index of the edge of an EDGE_CURVE, built where it is new.
    fn edge(&mut self, cx: &mut BodyCx<'a>, id: u64) -> Read<usize> {
        if let Some(i) = cx.edges.get(&id) {
            return Ok(*i);
        }
        if self.points > MAX_POINTS {
            // The whole file is refused after this face.
            return Err(refuse(id, "no room for its points"));
        }
        let r = self.file.expect(id, "EDGE_CURVE")?;
        let start = cx.shapes.vertex(r.reference(1)?)?;
        let end = cx.shapes.vertex(r.reference(2)?)?;
        let closed = r.reference(1)? == r.reference(2)?;
        let curve = cx.shapes.curve(r.reference(3)?)?;
        let forward = r.flag(4)? ^ curve.reversed;
        let range = edge_range(&curve.shape, [start, end], closed, forward)
            .map_err(|reason| refuse(id, reason))?;
        let path = Path::new(curve.shape.transformed(&cx.place), range);
        if !path.length_mm().is_finite() {
            return Err(refuse(id, "an edge without a finite length"));
        }
        let points = path.polyline(CHORD * path.length_mm());
        self.points += points.len();
        let index = self.edges.len();
        self.edges.push(BuiltEdge {
            entity: id,
            body: cx.index,
            path,
            points: points.into_iter().map(|(_, p)| p).collect(),
            uses: Vec::new(),
        });
        cx.edges.insert(id, index);
        Ok(index)
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

    /// The curves of a GEOMETRIC_CURVE_SET; its points count in the box alone.
    fn wireframe(&mut self, place: &Placed) {
        let shapes = Shapes {
            file: self.file,
            units: place.units,
        };
        let items = self.file.record(place.body).and_then(|r| r.references(1));
        for item in items.unwrap_or_default() {
            if self.file.is(item, "CARTESIAN_POINT") {
                let point = self.file.point(item, place.units);
                self.loose_points
                    .extend(point.map(|p| place.root_from_body.point(p)));
                continue;
            }
            match shapes.bounded_curves(item) {
                Ok(pieces) => {
                    for (curve, range) in pieces {
                        let path = Path::new(curve.transformed(&place.root_from_body), range);
                        self.points += path.node_count();
                        self.wires.push(Wire {
                            entity: item,
                            curve: path.curve().clone(),
                            range,
                            length_mm: path.length_mm(),
                        });
                    }
                }
                Err(why) => self.refused.push(why),
            }
        }
    }

    fn finish(self, name: &str, bodies: usize) -> Nominal {
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
        let wires = self.wires.iter().flat_map(|w| {
            let path = Path::new(w.curve.clone(), w.range);
            path.polyline(CHORD * w.length_mm)
        });
        let loose = wires.map(|(_, p)| p).chain(self.loose_points);
        let bounding_box_mm = loose.fold(faces_box_mm, |[low, high], p| [low.min(p), high.max(p)]);
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
        }
    }
}

fn place_is_surface(file: &Part21, body: u64) -> bool {
    BODIES[3..].iter().any(|b| file.is(body, b))
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
    edges
        .iter()
        .filter(|e| !e.uses.is_empty())
        .flat_map(|e| &e.points)
        .for_each(|p| add(*p));
    for face in faces {
        for p in super::extremes::extremes(face) {
            add(p);
        }
    }
    bounds
}
