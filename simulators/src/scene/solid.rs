//! Solids: regions of surfaces, prisms, and their unions, intersections and complements.

use glam::{DVec2, DVec3};

use super::bounds::Bounds;
use super::mesh::{Facets, MeshError};
use super::span::{Crossing, Ray, Span, Spans, Window, both, either, neither};
use super::surface::{HeightField, Shape, Surface, SurfaceId};
use crate::pose::Pose;

/// Boxes are wider than what they hold by this much, so that a ray never starts a window on a surface, mm.
const MARGIN: f64 = 1e-3;

/// The surfaces of a scene, each with its number. Solids refer to them, so that two solids may share one.
#[derive(Debug, Clone, Default)]
pub struct Surfaces(Vec<Surface>);

/// A body of a scene, or a part of one.
#[derive(Debug, Clone)]
pub struct Solid {
    bounds: Bounds,
    node: Node,
}

#[derive(Debug, Clone)]
enum Node {
    Region(SurfaceId),
    Prism(Box<Prism>),
    All(Vec<Solid>),
    Any(Vec<Solid>),
    Not(Box<Solid>),
}

/// A polygon of any shape, extruded along its z.
#[derive(Debug, Clone)]
struct Prism {
    pose: Pose,
    polygon: Vec<DVec2>,
    z: [f64; 2],
    /// Bottom, top, then the sides; side i goes from corner i to the next.
    surfaces: Vec<SurfaceId>,
}

/// What a ray meets first.
pub(super) enum First {
    Nothing,
    /// It starts inside.
    Inside,
    At(Crossing),
}

impl Surfaces {
    /// Keeps a surface and numbers it.
    pub fn add(&mut self, surface: Surface) -> SurfaceId {
        self.0.push(surface);
        SurfaceId(self.0.len() as u32 - 1)
    }

    /// The surface with this number.
    pub fn get(&self, id: SurfaceId) -> &Surface {
        &self.0[id.0 as usize]
    }

    /// All of them with their numbers.
    pub fn iter(&self) -> impl Iterator<Item = (SurfaceId, &Surface)> {
        self.0
            .iter()
            .enumerate()
            .map(|(i, s)| (SurfaceId(i as u32), s))
    }

    /// A box between two corners, with the numbers of its sides: -x, +x, -y, +y, -z, +z.
    pub fn cuboid(&mut self, name: &str, low: DVec3, high: DVec3) -> (Solid, [SurfaceId; 6]) {
        let ids = [
            ("-x", low, DVec3::NEG_X),
            ("+x", high, DVec3::X),
            ("-y", low, DVec3::NEG_Y),
            ("+y", high, DVec3::Y),
            ("-z", low, DVec3::NEG_Z),
            ("+z", high, DVec3::Z),
        ]
        .map(|(side, point, normal)| {
            self.add(Surface::plane(&format!("{name} {side}"), point, normal))
        });
        let solid = Solid::all(ids.map(Solid::region)).within(Bounds::new(low, high));
        (solid, ids)
    }

    /// A cylinder from `base` along `axis` (its length is the height), with the numbers of side, base and top.
    pub fn cylinder(
        &mut self,
        name: &str,
        base: DVec3,
        axis: DVec3,
        radius: f64,
    ) -> (Solid, [SurfaceId; 3]) {
        let ids = [
            self.add(Surface::cylinder(
                &format!("{name} side"),
                base,
                axis,
                radius,
            )),
            self.add(Surface::plane(&format!("{name} base"), base, -axis)),
            self.add(Surface::plane(&format!("{name} top"), base + axis, axis)),
        ];
        let solid = Solid::all(ids.map(Solid::region)).within(swept(base, axis, radius));
        (solid, ids)
    }

    /// A cone from `apex` along `axis` (its length is the height), with the numbers of side and base.
    pub fn cone(
        &mut self,
        name: &str,
        apex: DVec3,
        axis: DVec3,
        half_angle_rad: f64,
    ) -> (Solid, [SurfaceId; 2]) {
        let ids = [
            self.add(Surface::cone(
                &format!("{name} side"),
                apex,
                axis,
                half_angle_rad,
            )),
            self.add(Surface::plane(&format!("{name} base"), apex + axis, axis)),
        ];
        let radius = axis.length() * half_angle_rad.tan();
        let solid = Solid::all(ids.map(Solid::region)).within(swept(apex, axis, radius));
        (solid, ids)
    }

    /// A ball.
    pub fn sphere(&mut self, name: &str, centre: DVec3, radius: f64) -> (Solid, SurfaceId) {
        let id = self.add(Surface::sphere(name, centre, radius));
        let reach = DVec3::splat(radius);
        let bounds = Bounds::new(centre - reach, centre + reach);
        (Solid::region(id).within(bounds), id)
    }

    /// A ring: `radii` are those of its circle and of its section.
    pub fn torus(
        &mut self,
        name: &str,
        centre: DVec3,
        axis: DVec3,
        radii: [f64; 2],
    ) -> (Solid, SurfaceId) {
        let id = self.add(Surface::torus(name, centre, axis, radii));
        let reach = DVec3::splat(radii[0] + radii[1]);
        let bounds = Bounds::new(centre - reach, centre + reach);
        (Solid::region(id).within(bounds), id)
    }

    /// A polygon (counter-clockwise, any shape that does not cross itself) between two heights; with the numbers of bottom,
    /// top and the sides, side i from corner i to the next.
    pub fn prism(&mut self, name: &str, polygon: &[DVec2], z: [f64; 2]) -> (Solid, Vec<SurfaceId>) {
        let mut surfaces = vec![
            self.add(Surface::plane(
                &format!("{name} bottom"),
                DVec3::Z * z[0],
                DVec3::NEG_Z,
            )),
            self.add(Surface::plane(
                &format!("{name} top"),
                DVec3::Z * z[1],
                DVec3::Z,
            )),
        ];
        let mut bounds = Bounds::EMPTY;
        for (i, &a) in polygon.iter().enumerate() {
            let along = polygon[(i + 1) % polygon.len()] - a;
            let normal = DVec3::new(along.y, -along.x, 0.0);
            let side = Surface::plane(&format!("{name} side {i}"), a.extend(0.0), normal);
            surfaces.push(self.add(side));
            bounds.include(a.extend(z[0]));
            bounds.include(a.extend(z[1]));
        }
        let prism = Prism {
            pose: Pose::IDENTITY,
            polygon: polygon.to_vec(),
            z,
            surfaces: surfaces.clone(),
        };
        let solid = Solid {
            bounds: Bounds::ALL,
            node: Node::Prism(Box::new(prism)),
        };
        (solid.within(bounds), surfaces)
    }

    /// What lies over a rectangle between `bottom` and a height field, with the numbers of the sides -x, +x, -y, +y, the
    /// bottom and the field.
    pub fn below_field(
        &mut self,
        name: &str,
        field: HeightField,
        bottom: f64,
    ) -> (Solid, [SurfaceId; 6]) {
        let low = DVec3::new(field.x[0], field.y[0], bottom);
        let high = DVec3::new(field.x[1], field.y[1], field.range()[1]);
        let (_, mut ids) = self.cuboid(name, low, high);
        ids[5] = self.add(Surface::height_field(&format!("{name} field"), field));
        let solid = Solid::all(ids.map(Solid::region)).within(Bounds::new(low, high));
        (solid, ids)
    }

    /// The inside of a closed mesh, triangles counter-clockwise seen from outside.
    ///
    /// # Errors
    /// When it is not closed, or refers to vertices that are not there.
    pub fn mesh(
        &mut self,
        name: &str,
        vertices: &[DVec3],
        triangles: &[[u32; 3]],
    ) -> Result<(Solid, SurfaceId), MeshError> {
        let facets = Facets::new(vertices, triangles)?;
        let bounds = facets.bounds();
        let id = self.add(Surface::facets(name, facets));
        Ok((Solid::region(id).within(bounds), id))
    }

    /// Moves a solid, and with it every surface it refers to (also for other solids that share them).
    pub fn place(&mut self, solid: &mut Solid, pose: &Pose) {
        let mut ids = Vec::new();
        solid.surfaces(&mut ids);
        ids.sort_unstable();
        ids.dedup();
        for id in ids {
            self.0[id.0 as usize].place(pose);
        }
        solid.place(pose);
    }
}

fn swept(base: DVec3, axis: DVec3, radius: f64) -> Bounds {
    let reach = DVec3::splat(radius);
    let top = base + axis;
    Bounds::new(base.min(top) - reach, base.max(top) + reach)
}

impl Solid {
    /// The region of one surface, unbounded where the surface is.
    pub fn region(surface: SurfaceId) -> Solid {
        Solid {
            bounds: Bounds::ALL,
            node: Node::Region(surface),
        }
    }

    /// Inside all of them.
    pub fn all(solids: impl IntoIterator<Item = Solid>) -> Solid {
        let solids: Vec<Solid> = solids.into_iter().collect();
        let bounds = solids.iter().fold(Bounds::ALL, |b, s| b.common(&s.bounds));
        Solid {
            bounds,
            node: Node::All(solids),
        }
    }

    /// Inside any of them.
    pub fn any(solids: impl IntoIterator<Item = Solid>) -> Solid {
        let solids: Vec<Solid> = solids.into_iter().collect();
        let bounds = solids
            .iter()
            .fold(Bounds::EMPTY, |b, s| b.joined(&s.bounds));
        Solid {
            bounds,
            node: Node::Any(solids),
        }
    }

    /// Outside.
    pub fn complement(self) -> Solid {
        Solid {
            bounds: Bounds::ALL,
            node: Node::Not(Box::new(self)),
        }
    }

    /// What `other` leaves of this solid.
    pub fn minus(self, other: Solid) -> Solid {
        Solid::all([self, other.complement()])
    }

    /// The same solid, told that it lies within these bounds: makes casting fast, and must be true.
    pub fn within(mut self, bounds: Bounds) -> Solid {
        let mut bounds = bounds;
        bounds.pad(MARGIN);
        self.bounds = self.bounds.common(&bounds);
        self
    }

    /// A box around the solid.
    pub fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Whether the point is inside, by the signs of the surfaces (of a mesh by counting its crossings along a ray).
    pub(super) fn contains(&self, surfaces: &Surfaces, p: DVec3) -> bool {
        match &self.node {
            Node::Region(id) => {
                let surface = surfaces.get(*id);
                match &surface.shape {
                    Shape::Facets { .. } => {
                        // a direction along no axis, so that faces of boxes are not grazed
                        let ray = Ray::new(p, DVec3::new(0.577, 0.211, 0.789));
                        let window = Window {
                            from: -1e-9,
                            to: 1e-9,
                        };
                        !surface.spans(*id, &ray, window).is_empty()
                    }
                    Shape::Cone { pose, .. } => {
                        surface.value(p) <= 0.0
                            && pose.direction(DVec3::Z).dot(p - pose.translation) >= 0.0
                    }
                    _ => surface.value(p) <= 0.0,
                }
            }
            Node::Prism(prism) => prism.contains(p),
            Node::All(solids) => solids.iter().all(|s| s.contains(surfaces, p)),
            Node::Any(solids) => solids.iter().any(|s| s.contains(surfaces, p)),
            Node::Not(solid) => !solid.contains(surfaces, p),
        }
    }

    /// The parts of the ray inside the solid.
    pub(super) fn spans(&self, surfaces: &Surfaces, ray: &Ray, window: Window) -> Spans {
        let Some(window) = self.bounds.clip(ray, window) else {
            return Spans::new();
        };
        match &self.node {
            Node::Region(id) => surfaces.get(*id).spans(*id, ray, window),
            Node::Prism(prism) => prism.spans(ray, window),
            Node::All(solids) => common_spans(solids, surfaces, ray, window),
            Node::Any(solids) => solids.iter().fold(Spans::new(), |spans, solid| {
                either(&spans, &solid.spans(surfaces, ray, window))
            }),
            Node::Not(solid) => neither(&solid.spans(surfaces, ray, window), window),
        }
    }

    /// The first surface the ray enters through.
    pub(super) fn first(&self, surfaces: &Surfaces, ray: &Ray, window: Window) -> First {
        if let Node::Any(solids) = &self.node {
            let mut best: Option<Crossing> = None;
            for solid in solids {
                let to = best.map_or(window.to, |b| b.t);
                match solid.first(surfaces, ray, Window { to, ..window }) {
                    First::Nothing => {}
                    First::Inside => return First::Inside,
                    First::At(crossing) => best = Some(crossing),
                }
            }
            return best.map_or(First::Nothing, First::At);
        }
        match self.spans(surfaces, ray, window).first() {
            None => First::Nothing,
            Some(span) if span.enter.surface.is_none() => First::Inside,
            Some(span) => First::At(span.enter),
        }
    }

    fn surfaces(&self, ids: &mut Vec<SurfaceId>) {
        match &self.node {
            Node::Region(id) => ids.push(*id),
            Node::Prism(prism) => ids.extend(&prism.surfaces),
            Node::All(solids) | Node::Any(solids) => {
                solids.iter().for_each(|s| s.surfaces(ids));
            }
            Node::Not(solid) => solid.surfaces(ids),
        }
    }

    fn place(&mut self, pose: &Pose) {
        self.bounds = self.bounds.placed(pose);
        match &mut self.node {
            Node::Region(_) => {}
            Node::Prism(prism) => prism.pose = pose.after(prism.pose),
            Node::All(solids) | Node::Any(solids) => {
                solids.iter_mut().for_each(|s| s.place(pose));
            }
            Node::Not(solid) => solid.place(pose),
        }
    }
}

/// Spans inside all of them. The planes among them, and mostly all are, only move the two ends of one span.
fn common_spans(solids: &[Solid], surfaces: &Surfaces, ray: &Ray, window: Window) -> Spans {
    let mut one = Span {
        enter: Crossing::OPEN_START.moved(window.from),
        leave: Crossing::OPEN_END.moved(window.to),
    };
    let mut others = smallvec::SmallVec::<[&Solid; 8]>::new();
    for solid in solids {
        match &solid.node {
            Node::Region(id) => match &surfaces.get(*id).shape {
                Shape::Plane { normal, offset } => {
                    if !one.cut((*normal, *offset), *id, ray) {
                        return Spans::new();
                    }
                }
                _ => others.push(solid),
            },
            _ => others.push(solid),
        }
    }
    let mut spans = Spans::new();
    spans.push(one);
    for solid in others {
        let (Some(first), Some(last)) = (spans.first(), spans.last()) else {
            break;
        };
        let hull = Window {
            from: first.enter.t,
            to: last.leave.t,
        };
        spans = both(&spans, &solid.spans(surfaces, ray, hull));
    }
    spans
}

impl Prism {
    fn contains(&self, p: DVec3) -> bool {
        let p = self.pose.inverse().point(p);
        self.z[0] <= p.z && p.z <= self.z[1] && self.holds(DVec2::new(p.x, p.y))
    }

    /// Whether the polygon holds a point: an odd number of sides lies to its right.
    fn holds(&self, p: DVec2) -> bool {
        let n = self.polygon.len();
        (0..n).fold(false, |inside, i| {
            let (a, b) = (self.polygon[i], self.polygon[(i + 1) % n]);
            let crosses =
                (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x);
            inside != crosses
        })
    }

    fn spans(&self, ray: &Ray, window: Window) -> Spans {
        let back = self.pose.inverse();
        let (o, d) = (back.point(ray.origin), back.direction(ray.direction));
        let across = self.between_caps(o, d, window);
        let (Some(first), Some(last)) = (across.first(), across.last()) else {
            return across;
        };
        let mut crossings = self.side_crossings(o, d);
        crossings.sort_by(|a, b| a.t.total_cmp(&b.t));
        let (from, to) = (first.enter.t, last.leave.t);
        // the ray is inside the polygon or not where it starts; each side it passes changes that
        let passed = crossings.iter().take_while(|c| c.t < from).count();
        let mut inside = if crossings.is_empty() {
            self.holds(DVec2::new(o.x, o.y))
        } else {
            passed % 2 == 1
        };
        let mut enter = Crossing::OPEN_START.moved(from);
        let mut spans = Spans::new();
        for &crossing in crossings[passed..].iter().take_while(|c| c.t < to) {
            if inside {
                spans.push(Span {
                    enter,
                    leave: crossing,
                });
            }
            inside = !inside;
            enter = crossing;
        }
        if inside {
            spans.push(Span {
                enter,
                leave: Crossing::OPEN_END.moved(to),
            });
        }
        both(&across, &spans)
    }

    fn between_caps(&self, o: DVec3, d: DVec3, window: Window) -> Spans {
        if d.z == 0.0 {
            return if self.z[0] <= o.z && o.z <= self.z[1] {
                window.whole()
            } else {
                Spans::new()
            };
        }
        let bottom = Crossing::at((self.z[0] - o.z) / d.z, self.surfaces[0]);
        let top = Crossing::at((self.z[1] - o.z) / d.z, self.surfaces[1]);
        if d.z > 0.0 {
            window.keep(bottom, top)
        } else {
            window.keep(top, bottom)
        }
    }

    /// Where the whole line, seen along the axis, passes sides; a corner counts for one of its two sides.
    fn side_crossings(&self, o: DVec3, d: DVec3) -> smallvec::SmallVec<[Crossing; 8]> {
        let (o, d) = (DVec2::new(o.x, o.y), DVec2::new(d.x, d.y));
        let mut found = smallvec::SmallVec::new();
        if d.length_squared() < 1e-24 {
            return found;
        }
        let n = self.polygon.len();
        let side_of = |p: DVec2| d.perp_dot(p - o) > 0.0;
        for i in 0..n {
            let (a, b) = (self.polygon[i], self.polygon[(i + 1) % n]);
            if side_of(a) != side_of(b) {
                let along = b - a;
                let t = (a - o).perp_dot(along) / d.perp_dot(along);
                found.push(Crossing::at(t, self.surfaces[2 + i]));
            }
        }
        found
    }
}
