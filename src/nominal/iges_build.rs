//! From the entities of an IGES file to faces and edges: trimmed surfaces paired by geometry, and solids by their topology.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use super::iges::{Entry, Iges, Values};
use super::iges_shapes::{IgesShapes, Piece};
use super::net::{EdgeLoop, Net, Sense};
use super::part21::{Read, refuse};
use super::path::Path;
use super::shapes::{Sensed, edge_range};
use super::{Nominal, NominalError, Wire};
use crate::geometry::{NurbsCurve, RigidTransform, Surface};

/// Occurrences of subfigures that one file may unfold into.
const MAX_OCCURRENCES: usize = 20_000;
/// Levels of subfigures.
const MAX_LEVELS: usize = 16;
/// Pieces of borders above which none is cut where others end.
const MAX_CUT: usize = 20_000;
/// Points along a border that is given in the parameters of its surface alone.
const TRACE: usize = 256;
/// Entity types that are curves.
const CURVES: [u32; 6] = [100, 102, 104, 110, 112, 126];
/// Surfaces with borders of their own.
const WHOLE: [u32; 3] = [114, 118, 128];
/// Geometry that is not read: refused by name where it stands by itself.
const UNREAD: [u32; 19] = [
    106, 125, 130, 132, 134, 136, 146, 148, 150, 152, 154, 156, 158, 160, 162, 164, 168, 180, 184,
];

/// A face before its edges are known.
struct Draft {
    id: u64,
    surface: Sensed<Surface>,
    loops: Vec<Vec<Piece>>,
    /// Whether its loops come from the file, where they may run either way.
    guess: bool,
}

struct Builder<'a> {
    file: &'a Iges<'a>,
    shapes: IgesShapes<'a>,
    net: Net,
    drafts: Vec<Draft>,
    bodies: usize,
    occurrences: usize,
}

/// Reads a nominal from the text of an IGES file.
pub(super) fn build(bytes: &[u8], name: &str) -> Result<Nominal, NominalError> {
    let file = Iges::parse(bytes, name)?;
    let mut b = Builder {
        shapes: IgesShapes { file: &file },
        file: &file,
        net: Net::default(),
        drafts: Vec::new(),
        bodies: 0,
        occurrences: 0,
    };
    let in_figures = b.parts_of_figures();
    // What depends on a group alone (2) stands by itself as well.
    let stands = |e: &&Entry| match e.dependence {
        0 => e.purpose != 2,
        2 => matches!(e.kind, 143 | 144 | 186 | 408),
        _ => false,
    };
    let independent: Vec<Entry> = (file.entries().iter())
        .filter(stands)
        .filter(|e| !in_figures.contains(&e.id))
        .copied()
        .collect();
    for e in &independent {
        b.item(e, &RigidTransform::IDENTITY, 0);
        b.net.check_size(name)?;
        if b.occurrences > MAX_OCCURRENCES {
            return Err(NominalError::TooManyPlaces {
                name: name.into(),
                limit: MAX_OCCURRENCES,
            });
        }
    }
    let solids = b.bodies;
    b.settle(name)?;
    b.net.check_size(name)?;
    if b.net.faces.is_empty() {
        if b.net.refused_faces == 0 {
            return Err(NominalError::NoShape {
                name: name.into(),
                found: what_instead(&file),
            });
        }
        let none = || refuse(1, "it has no faces");
        return Err(NominalError::NothingUsable {
            name: name.into(),
            faces: b.net.refused_faces,
            first: b.net.refused.first().cloned().unwrap_or_else(none),
        });
    }
    let bodies = b.bodies.max(solids);
    Ok(b.net.finish(name, bodies))
}

/// The types of a file without faces, in words.
fn what_instead(file: &Iges<'_>) -> String {
    let mut kinds: BTreeMap<u32, (usize, u64)> = BTreeMap::new();
    for e in file.entries() {
        kinds.entry(e.kind).or_insert((0, e.id)).0 += 1;
    }
    let words: Vec<String> = (kinds.iter().take(12))
        .map(|(kind, (count, first))| format!("{count} of type {kind} (first #{first})"))
        .collect();
    if words.is_empty() {
        "an empty directory".into()
    } else {
        words.join(", ")
    }
}

impl Builder<'_> {
    /// Entities that subfigure definitions (308) hold: they stand where these are used.
    fn parts_of_figures(&self) -> BTreeSet<u64> {
        let figures = self.file.entries().iter().filter(|e| e.kind == 308);
        let parts = figures.filter_map(|e| {
            let v = self.file.values(e.id).ok()?;
            v.pointers(3, v.count(2, v.len()).ok()?).ok()
        });
        parts.flatten().collect()
    }

    /// An entity that stands by itself, or in a subfigure.
    fn item(&mut self, e: &Entry, place: &RigidTransform, level: usize) {
        let done = match e.kind {
            143 | 144 => {
                let face = self.face(e);
                self.take_face(e.id, face, place)
            }
            186 => self.solid(e, place),
            408 => self.occurrence(e, place, level),
            kind if WHOLE.contains(&kind) => {
                let face = self.whole_surface(e.id);
                self.take_face(e.id, face, place)
            }
            kind if CURVES.contains(&kind) && e.purpose != 1 => self.wire(e, place),
            116 if e.purpose == 0 => self.loose_point(e, place),
            kind if UNREAD.contains(&kind) => Err(refuse(
                e.id,
                format!("an entity of type {kind} is not read"),
            )),
            // Colour, annotation, views, groups, attributes; construction geometry without borders.
            _ => Ok(()),
        };
        if let Err(why) = done {
            self.net.refused.push(if why.entity == e.id {
                why
            } else {
                refuse(e.id, format!("#{}: {}", why.entity, why.reason))
            });
        }
    }

    fn take_face(&mut self, id: u64, face: Read<Draft>, place: &RigidTransform) -> Read<()> {
        let mut draft = face.inspect_err(|_| self.net.refused_faces += 1)?;
        draft.id = id;
        draft.surface.shape = draft.surface.shape.transformed(place);
        for piece in draft.loops.iter_mut().flatten() {
            piece.curve = piece.curve.transformed(place);
        }
        self.drafts.push(draft);
        Ok(())
    }

    /// Type 408: the entities of a subfigure definition (308) once more, shifted.
    fn occurrence(&mut self, e: &Entry, place: &RigidTransform, level: usize) -> Read<()> {
        self.occurrences += 1;
        if level > MAX_LEVELS || self.occurrences > MAX_OCCURRENCES {
            return Err(refuse(
                e.id,
                "subfigures nested too deep, in a circle, or too many",
            ));
        }
        let v = self.file.values(e.id)?;
        if v.number(4).is_ok_and(|s| s != 1.0) {
            return Err(refuse(
                e.id,
                "a subfigure (type 408) with a scale is not read",
            ));
        }
        let shift = v.numbers(1, 3)?;
        let shift = DVec3::new(shift[0], shift[1], shift[2]) * self.file.unit_mm;
        let shift = RigidTransform::new(glam::DQuat::IDENTITY, shift);
        let here = *place * self.shapes.transform(e)? * shift;
        let definition = self.file.values(v.pointer(0)?)?;
        if definition.entry.kind != 308 {
            return Err(refuse(
                e.id,
                "a subfigure whose definition is not of type 308",
            ));
        }
        let count = definition.count(2, definition.len())?;
        for part in definition.pointers(3, count)? {
            let part = self.file.entry(part)?;
            self.item(&part, &here, level + 1);
        }
        Ok(())
    }

    fn wire(&mut self, e: &Entry, place: &RigidTransform) -> Read<()> {
        for piece in self.shapes.curve(e.id)? {
            let path = Path::new(piece.curve.transformed(place), piece.range);
            self.net.points += path.node_count();
            self.net.wires.push(Wire {
                entity: e.id,
                curve: path.curve().clone(),
                range: piece.range,
                length_mm: path.length_mm(),
            });
        }
        Ok(())
    }

    fn loose_point(&mut self, e: &Entry, place: &RigidTransform) -> Read<()> {
        let v = self.file.values(e.id)?;
        let p = v.numbers(0, 3)?;
        let p = DVec3::new(p[0], p[1], p[2]) * self.file.unit_mm;
        let by = self.shapes.transform(e)?;
        self.net.loose_points.push(place.point(by.point(p)));
        Ok(())
    }

    /// A trimmed (144) or bounded (143) surface.
    fn face(&self, e: &Entry) -> Read<Draft> {
        let v = self.file.values(e.id)?;
        let by = self.shapes.transform(e)?;
        let (surface_id, mut loops) = if e.kind == 144 {
            let holes = v.count(2, v.len())?;
            let outer = if v.or_zero(1)? == 0.0 {
                0
            } else {
                v.pointer(3)?
            };
            let surface = v.pointer(0)?;
            let mut loops = Vec::new();
            if outer == 0 {
                loops.extend(self.natural_border(surface)?);
            } else {
                loops.push(self.border(outer, surface)?);
            }
            for hole in v.pointers(4, holes)? {
                loops.push(self.border(hole, surface)?);
            }
            (surface, loops)
        } else {
            let count = v.count(2, v.len())?;
            let surface = v.pointer(1)?;
            let borders = v.pointers(3, count)?;
            let loops = borders.into_iter().map(|b| self.border(b, surface));
            (surface, loops.collect::<Read<_>>()?)
        };
        let mut surface = self.shapes.surface(surface_id)?;
        surface.shape = surface.shape.transformed(&by);
        for piece in loops.iter_mut().flatten() {
            piece.curve = piece.curve.transformed(&by);
        }
        Ok(Draft {
            id: e.id,
            guess: e.kind == 143 || v.or_zero(1)? != 0.0,
            surface,
            loops,
        })
    }

    /// A surface without trimming, between its own ends.
    fn whole_surface(&self, id: u64) -> Read<Draft> {
        Ok(Draft {
            id,
            surface: self.shapes.surface(id)?,
            loops: self.natural_border(id)?,
            guess: false,
        })
    }

    /// The ends of the domain of a spline surface; none in a direction that closes on itself.
    fn natural_border(&self, id: u64) -> Read<Vec<Vec<Piece>>> {
        let Surface::Nurbs(s) = self.shapes.surface(id)?.shape else {
            let kind = self.file.entry(id)?.kind;
            return Err(refuse(
                id,
                format!("a face bounded by the ends of a surface of type {kind} is not read"),
            ));
        };
        let [u, v] = s.ranges();
        let side = |along_v: bool, t: f64| -> Read<Vec<Piece>> {
            let curve = s.iso_curve(along_v, t);
            let curve = curve.ok_or_else(|| refuse(id, "a border that is no curve"))?;
            let (from, to) = curve.knots().domain();
            // A side that is a pole has no length.
            let size = (0..=8).map(|k| curve.point(from + (to - from) * f64::from(k) / 8.0));
            let size = size.fold(0.0, |m: f64, p| m.max(p.distance(curve.point(from))));
            if size < 1e-9 {
                return Ok(Vec::new());
            }
            Ok(vec![Piece {
                id,
                curve: crate::geometry::Curve::Nurbs(curve),
                range: (from, to),
            }])
        };
        let back = |p: Vec<Piece>| p.into_iter().map(Piece::reversed).collect::<Vec<_>>();
        let (low, right) = (side(false, v.from)?, side(true, u.to)?);
        let (high, left) = (back(side(false, v.to)?), back(side(true, u.from)?));
        Ok(match (u.closed, v.closed) {
            (false, false) => vec![[low, right, high, left].concat()],
            (true, false) => vec![low, high],
            (false, true) => vec![right, left],
            (true, true) => Vec::new(),
        })
    }

    /// A boundary (141) or a curve on a surface (142), its pieces end to start.
    fn border(&self, id: u64, surface: u64) -> Read<Vec<Piece>> {
        let v = self.file.values(id)?;
        let by = self.shapes.transform(&v.entry)?;
        let mut pieces = match v.entry.kind {
            142 => match v.pointer(3)? {
                0 => self.traced(v.pointer(2)?, surface)?,
                curve => self.shapes.curve(curve)?,
            },
            141 => self.boundary(&v)?,
            other => {
                let what = format!("is of type {other}, expected a boundary (141 or 142)");
                return Err(refuse(id, what));
            }
        };
        for piece in &mut pieces {
            piece.curve = piece.curve.transformed(&by);
        }
        Ok(chained(pieces))
    }

    fn boundary(&self, v: &Values) -> Read<Vec<Piece>> {
        let count = v.count(3, v.len())?;
        let mut at = 4;
        let mut out = Vec::new();
        for _ in 0..count {
            let (curve, sense) = (v.pointer(at)?, v.or_zero(at + 1)?);
            let mut pieces = self.shapes.curve(curve)?;
            if sense == 2.0 {
                pieces = pieces.into_iter().rev().map(Piece::reversed).collect();
            }
            out.extend(pieces);
            at = at
                .saturating_add(3)
                .saturating_add(v.count(at + 2, v.len())?);
        }
        Ok(out)
    }

    /// A border that is given in the parameters of its surface alone, traced in space.
    fn traced(&self, curve: u64, surface: u64) -> Read<Vec<Piece>> {
        let Surface::Nurbs(s) = self.shapes.surface(surface)?.shape else {
            let kind = self.file.entry(surface)?.kind;
            return Err(refuse(
                curve,
                format!("a border in the parameters of a surface of type {kind} alone is not read"),
            ));
        };
        let trace = |piece: Piece| -> Read<Piece> {
            let (a, b) = piece.range;
            let points: Vec<DVec3> = (0..=TRACE)
                .map(|k| {
                    let t = a + (b - a) * k as f64 / TRACE as f64;
                    // Parameters are numbers, not lengths: the unit comes off again.
                    let uv = piece.curve.point(t) / self.file.unit_mm;
                    s.point(uv.x, uv.y)
                })
                .collect();
            let knots: Vec<f64> = [0.0]
                .into_iter()
                .chain((0..=TRACE).map(|k| k as f64))
                .chain([TRACE as f64])
                .collect();
            let line = NurbsCurve::new(1, &points, None, knots);
            let line = line.map_err(|e| refuse(piece.id, e.to_string()))?;
            Ok(Piece {
                id: piece.id,
                curve: crate::geometry::Curve::Nurbs(line),
                range: (0.0, TRACE as f64),
            })
        };
        self.shapes.curve(curve)?.into_iter().map(trace).collect()
    }

    /// Type 186: the shells with their own topology.
    fn solid(&mut self, e: &Entry, place: &RigidTransform) -> Read<()> {
        let v = self.file.values(e.id)?;
        let here = *place * self.shapes.transform(e)?;
        let body = self.bodies;
        self.bodies += 1;
        let first = self.net.faces.len();
        let mut shells = vec![(v.pointer(0)?, v.or_zero(1)? == 0.0)];
        let voids = v.count(2, v.len())?;
        for k in 0..voids {
            shells.push((v.pointer(3 + 2 * k)?, v.or_zero(4 + 2 * k)? == 0.0));
        }
        let mut edges = BTreeMap::new();
        let mut seen = BTreeSet::new();
        for (shell, against) in shells {
            let v = self.file.values(shell)?;
            if v.entry.kind != 514 {
                return Err(refuse(
                    shell,
                    format!("is of type {}, expected a shell (514)", v.entry.kind),
                ));
            }
            let count = v.count(0, v.len())?;
            for k in 0..count {
                if self.net.is_full() {
                    return Ok(());
                }
                let face = v.pointer(1 + 2 * k)?;
                let against = against ^ (v.or_zero(2 + 2 * k)? == 0.0);
                let built = if seen.insert(face) {
                    self.solid_face(face, body, &here, against, &mut edges)
                } else {
                    Err(refuse(face, "the shells list it before"))
                };
                if let Err(why) = built {
                    self.net.refused_faces += 1;
                    self.net
                        .refused
                        .push(refuse(face, format!("#{}: {}", why.entity, why.reason)));
                }
            }
        }
        let volume: f64 = self.net.faces[first..].iter().map(|f| f.volume_mm3()).sum();
        if volume < 0.0 {
            self.net.turn_over(first, body);
        }
        Ok(())
    }

    /// Types 510, 508, 504 and 502.
    fn solid_face(
        &mut self,
        id: u64,
        body: usize,
        place: &RigidTransform,
        against: bool,
        edges: &mut BTreeMap<(u64, usize), usize>,
    ) -> Read<()> {
        let v = self.file.values(id)?;
        if v.entry.kind != 510 {
            return Err(refuse(
                id,
                format!("is of type {}, expected a face (510)", v.entry.kind),
            ));
        }
        let surface = self.shapes.surface(v.pointer(0)?)?;
        let count = v.count(1, v.len())?;
        let mut loops: Vec<EdgeLoop> = Vec::new();
        for l in v.pointers(3, count)? {
            let v = self.file.values(l)?;
            if v.entry.kind != 508 {
                return Err(refuse(
                    l,
                    format!("is of type {}, expected a loop (508)", v.entry.kind),
                ));
            }
            let mut out = EdgeLoop::new();
            let mut at = 1;
            for _ in 0..v.count(0, v.len())? {
                let is_vertex = v.or_zero(at)? == 1.0;
                let (list, index) = (v.pointer(at + 1)?, v.count(at + 2, 1 << 30)?);
                let forward = v.or_zero(at + 3)? != 0.0;
                let curves = v.count(at + 4, v.len())?;
                at = at.saturating_add(5).saturating_add(2 * curves);
                if !is_vertex {
                    let key = (list, index);
                    let edge = match edges.get(&key) {
                        Some(e) => *e,
                        None => self.solid_edge(list, index, body, place)?,
                    };
                    edges.insert(key, edge);
                    out.push((edge, forward));
                }
            }
            if !out.is_empty() {
                loops.push(out);
            }
        }
        let sense = Sense {
            along: !surface.reversed,
            against,
            guess: false,
        };
        let shape = surface.shape.transformed(place);
        self.net.face(id, body, shape, &loops, sense)
    }

    fn solid_edge(
        &mut self,
        list: u64,
        index: usize,
        body: usize,
        place: &RigidTransform,
    ) -> Read<usize> {
        let v = self.file.values(list)?;
        if v.entry.kind != 504 || index == 0 || index > v.count(0, v.len())? {
            return Err(refuse(list, format!("has no edge {index} (type 504)")));
        }
        let at = 1 + 5 * (index - 1);
        let mut pieces = self.shapes.curve(v.pointer(at)?)?;
        if pieces.len() != 1 {
            return Err(refuse(
                list,
                format!("edge {index} has {} pieces, expected one", pieces.len()),
            ));
        }
        let piece = pieces.remove(0);
        let vertex = |list: u64, index: usize| -> Read<DVec3> {
            let v = self.file.values(list)?;
            if v.entry.kind != 502 || index == 0 || index > v.count(0, v.len())? {
                return Err(refuse(list, format!("has no vertex {index} (type 502)")));
            }
            let n = v.numbers(1 + 3 * (index - 1), 3)?;
            Ok(DVec3::new(n[0], n[1], n[2]) * self.file.unit_mm)
        };
        let ends = [
            (v.pointer(at + 1)?, v.count(at + 2, 1 << 30)?),
            (v.pointer(at + 3)?, v.count(at + 4, 1 << 30)?),
        ];
        let (start, end) = (vertex(ends[0].0, ends[0].1)?, vertex(ends[1].0, ends[1].1)?);
        let forward = piece.range.1 > piece.range.0;
        let range = edge_range(&piece.curve, [start, end], ends[0] == ends[1], forward)
            .map_err(|reason| refuse(list, format!("edge {index}: {reason}")))?;
        self.net
            .edge(piece.id, body, piece.curve.transformed(place), range)
    }

    /// Cuts borders where others end, finds which are the same edge, and turns the faces the same way round.
    fn settle(&mut self, name: &str) -> Result<(), NominalError> {
        if self.drafts.is_empty() {
            return Ok(());
        }
        let body = self.bodies;
        self.bodies += 1;
        let drafts = std::mem::take(&mut self.drafts);
        let first_face = self.net.faces.len();
        let first_edge = self.net.edges.len();
        let ends: Vec<DVec3> = (drafts.iter().flat_map(|d| d.loops.iter().flatten()))
            .flat_map(|p| [p.start(), p.end()])
            .collect();
        let bounds = (ends.iter()).fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |b, p| {
            [b[0].min(*p), b[1].max(*p)]
        });
        let size = bounds[0].distance(bounds[1]);
        let size = if size.is_finite() { size } else { 1.0 };
        // What the sender says it tells apart, where that makes sense for the size.
        let gap_mm = self.file.resolution_mm.clamp(2e-6 * size, 1e-4 * size);
        let mut cuts = Cuts::new(ends, gap_mm);
        let mut pairs: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
        for draft in drafts {
            let mut loops: Vec<EdgeLoop> = Vec::new();
            let mut failed = None;
            for pieces in &draft.loops {
                let mut edges = EdgeLoop::new();
                for piece in pieces.iter().flat_map(|p| cuts.cut(p)) {
                    match self.paired(piece, body, gap_mm, &mut pairs) {
                        Ok(Some(edge)) => edges.push(edge),
                        Ok(None) => {}
                        Err(why) => failed = Some(why),
                    }
                }
                if !edges.is_empty() {
                    loops.push(edges);
                }
            }
            let sense = Sense {
                along: !draft.surface.reversed,
                against: false,
                guess: draft.guess,
            };
            let built = match failed {
                Some(why) => Err(why),
                None => self
                    .net
                    .face(draft.id, body, draft.surface.shape, &loops, sense),
            };
            if let Err(why) = built {
                self.net.refused_faces += 1;
                self.net.refused.push(if why.entity == draft.id {
                    why
                } else {
                    refuse(draft.id, format!("#{}: {}", why.entity, why.reason))
                });
            }
            self.net.check_size(name)?;
        }
        self.net.turn_alike(first_face, first_edge);
        Ok(())
    }

    /// The edge that a piece of a border is, and whether it runs along it; none where the piece has no length.
    fn paired(
        &mut self,
        piece: Piece,
        body: usize,
        gap_mm: f64,
        pairs: &mut BTreeMap<[i64; 3], Vec<usize>>,
    ) -> Read<Option<(usize, bool)>> {
        let path = Path::new(piece.curve.clone(), piece.range);
        let length = path.length_mm();
        if !length.is_finite() {
            return Err(refuse(piece.id, "an edge without a finite length"));
        }
        if length <= gap_mm && path.at(0.0).0.distance(path.at(length).0) < gap_mm {
            return Ok(None);
        }
        let (start, end, middle) = (path.at(0.0).0, path.at(length).0, path.at(0.5 * length).0);
        let cell = |p: DVec3| (p / (4.0 * gap_mm)).floor().as_i64vec3().to_array();
        let [x, y, z] = cell(middle);
        let reach = 2.0 * gap_mm;
        for k in 0..27i64 {
            let at = [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1];
            for e in pairs.get(&at).into_iter().flatten() {
                let other = &self.net.edges[*e].path;
                let l = other.length_mm();
                let near = other.at(0.5 * l).0.distance(middle) <= reach
                    && (l - length).abs() <= 2.0 * reach;
                if !near || self.net.edges[*e].uses.len() > 1 {
                    continue;
                }
                let (a, b) = (other.at(0.0).0, other.at(l).0);
                let same = a.distance(start) <= reach && b.distance(end) <= reach;
                let turned = a.distance(end) <= reach && b.distance(start) <= reach;
                if turned && same {
                    // A ring: the way it runs a quarter on tells.
                    let forward =
                        other.at(0.25 * l).0.distance(path.at(0.25 * length).0) <= 8.0 * reach;
                    return Ok(Some((*e, forward)));
                }
                if same || turned {
                    return Ok(Some((*e, same)));
                }
            }
        }
        let edge = self.net.edge(piece.id, body, piece.curve, piece.range)?;
        pairs.entry(cell(middle)).or_default().push(edge);
        Ok(Some((edge, true)))
    }
}

/// Pieces in the order and direction in which each begins where the last one ended.
fn chained(pieces: Vec<Piece>) -> Vec<Piece> {
    let mut out: Vec<Piece> = Vec::with_capacity(pieces.len());
    let count = pieces.len();
    for piece in pieces {
        let turned = match out.last() {
            Some(last) => {
                let at = last.end();
                piece.end().distance(at) < piece.start().distance(at)
            }
            None => false,
        };
        if out.len() == 1 && count > 1 {
            // The first piece may run the wrong way itself.
            let (first, other) = (&out[0], [piece.start(), piece.end()]);
            let to = |p: DVec3| {
                other
                    .iter()
                    .map(|o| o.distance(p))
                    .fold(f64::INFINITY, f64::min)
            };
            if to(first.start()) < to(first.end()) {
                let first = out.remove(0).reversed();
                let turned =
                    piece.end().distance(first.end()) < piece.start().distance(first.end());
                out.push(first);
                out.push(if turned { piece.reversed() } else { piece });
                continue;
            }
        }
        out.push(if turned { piece.reversed() } else { piece });
    }
    out
}

/// Places at which pieces of borders end, in order of x.
struct Cuts {
    ends: Vec<DVec3>,
    gap_mm: f64,
}

impl Cuts {
    fn new(mut ends: Vec<DVec3>, gap_mm: f64) -> Self {
        ends.retain(|p| p.is_finite());
        if ends.len() > MAX_CUT {
            ends.clear();
        }
        ends.sort_unstable_by(|a, b| a.x.total_cmp(&b.x));
        Self { ends, gap_mm }
    }

    /// A piece in parts, cut where others end on it.
    fn cut(&mut self, piece: &Piece) -> Vec<Piece> {
        let path = Path::new(piece.curve.clone(), piece.range);
        let length = path.length_mm();
        let line = path.polyline(self.gap_mm.max(1e-3 * length));
        let grow = DVec3::splat(2.0 * self.gap_mm.max(1e-3 * length));
        let [low, high] = line
            .iter()
            .fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |b, (_, p)| {
                [b[0].min(*p), b[1].max(*p)]
            });
        let (low, high) = (low - grow, high + grow);
        let from = self.ends.partition_point(|p| p.x < low.x);
        let inside = |p: &&DVec3| p.cmpge(low).all() && p.cmple(high).all();
        let margin = 3.0 * self.gap_mm;
        let mut at: Vec<f64> = (self.ends[from..].iter())
            .take_while(|p| p.x <= high.x)
            .filter(inside)
            .filter_map(|p| {
                let (s, d) = path.nearest(*p);
                (d <= self.gap_mm && s > margin && s < length - margin).then_some(s)
            })
            .collect();
        at.sort_unstable_by(f64::total_cmp);
        at.dedup_by(|a, b| (*a - *b).abs() <= margin);
        let mut borders = vec![piece.range.0];
        borders.extend(at.into_iter().map(|s| path.parameter(s)));
        borders.push(piece.range.1);
        let part = |w: &[f64]| Piece {
            range: (w[0], w[1]),
            ..piece.clone()
        };
        borders.windows(2).map(part).collect()
    }
}
