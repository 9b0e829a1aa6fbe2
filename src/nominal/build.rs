//! From entities to faces, edges and sharp edges.

use std::collections::{BTreeMap, BTreeSet};

use super::bodies::{BODIES, Placed, Places, placed_bodies};
use super::face::Face;
use super::net::{EdgeLoop, Net, Sense};
use super::part21::{Part21, Read, refuse};
use super::path::Path;
use super::shapes::{Shapes, edge_range};
use super::{Nominal, NominalError, Wire};
use crate::geometry::RigidTransform;

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
        net: Net {
            refused,
            ..Net::default()
        },
    };
    let bodies = places.len();
    for (body, place) in places.iter().enumerate() {
        if let Err(why) = b.body(body, place) {
            b.net.refused.push(why);
        }
        b.net.check_size(name)?;
    }
    if b.net.faces.is_empty() {
        let none = || refuse(places[0].body, "it has no faces");
        return Err(NominalError::NothingUsable {
            name: name.into(),
            faces: b.net.refused_faces,
            first: b.net.refused.first().cloned().unwrap_or_else(none),
        });
    }
    for place in &wireframes {
        b.wireframe(place);
        b.net.check_size(name)?;
    }
    let mut nominal = b.net.finish(name, bodies);
    nominal.pmi = super::pmi::read(&file);
    Ok(nominal)
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

struct Builder<'a> {
    file: &'a Part21,
    net: Net,
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

impl<'a> Builder<'a> {
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
        let first = self.net.faces.len();
        let mut seen = BTreeSet::new();
        for (face, against) in self.shell_faces(place.body)? {
            if self.net.is_full() {
                return Ok(());
            }
            let built = if seen.insert(face) {
                self.face(&mut cx, face, against)
            } else {
                Err(refuse(face, "the body lists it before"))
            };
            if let Err(why) = built {
                self.net.refused_faces += 1;
                self.net.refused.push(if why.entity == face {
                    why
                } else {
                    refuse(face, format!("#{}: {}", why.entity, why.reason))
                });
            }
        }
        let is_solid = !place_is_surface(self.file, place.body);
        let volume: f64 = self.net.faces[first..].iter().map(Face::volume_mm3).sum();
        if is_solid && volume < 0.0 {
            self.net.turn_over(first, index);
        }
        Ok(())
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
        let shape = surface.shape.transformed(&cx.place);
        let sense = Sense {
            along: r.flag(3)? ^ surface.reversed,
            against,
            guess: false,
        };
        self.net.face(id, cx.index, shape, &loops, sense)
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
        let r = self.file.expect(id, "EDGE_CURVE")?;
        let start = cx.shapes.vertex(r.reference(1)?)?;
        let end = cx.shapes.vertex(r.reference(2)?)?;
        let closed = r.reference(1)? == r.reference(2)?;
        let curve = cx.shapes.curve(r.reference(3)?)?;
        let forward = r.flag(4)? ^ curve.reversed;
        let range = edge_range(&curve.shape, [start, end], closed, forward)
            .map_err(|reason| refuse(id, reason))?;
        let curve = curve.shape.transformed(&cx.place);
        let index = self.net.edge(id, cx.index, curve, range)?;
        cx.edges.insert(id, index);
        Ok(index)
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
                self.net
                    .loose_points
                    .extend(point.map(|p| place.root_from_body.point(p)));
                continue;
            }
            match shapes.bounded_curves(item) {
                Ok(pieces) => {
                    for (curve, range) in pieces {
                        let path = Path::new(curve.transformed(&place.root_from_body), range);
                        self.net.points += path.node_count();
                        self.net.wires.push(Wire {
                            entity: item,
                            curve: path.curve().clone(),
                            range,
                            length_mm: path.length_mm(),
                        });
                    }
                }
                Err(why) => self.net.refused.push(why),
            }
        }
    }
}

fn place_is_surface(file: &Part21, body: u64) -> bool {
    BODIES[3..].iter().any(|b| file.is(body, b))
}
