//! The demo's part, nominal and as manufactured with stated defects. Part frame, mm.
//!
//! A plate of 80 x 50 x 12 with a raised block under a free-form top at its left, and a round boss at its right.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use crate::scene::{
    Bounds, EdgeKind, EdgeTruth, HeightField, Scene, Solid, Station, Surface, SurfaceId, Surfaces,
};

/// Height of the plate's top.
pub const PLATE_TOP_MM: f64 = 12.0;
/// Length, width of the plate.
pub const PLATE_MM: [f64; 2] = [80.0, 50.0];
/// x of the block's wall.
pub const WALL_MM: f64 = 32.0;
/// Axis of the boss.
pub const BOSS_CENTRE_MM: DVec2 = DVec2::new(56.0, 25.0);
/// Radius of the boss.
pub const BOSS_RADIUS_MM: f64 = 9.0;
/// Height of the boss's top.
pub const BOSS_TOP_MM: f64 = 20.0;
/// The block's top: a bicubic Bezier height field, gently curved both ways.
pub const TOP: HeightField = HeightField {
    x: [0.0, 32.0],
    y: [0.0, 50.0],
    z: [
        [23.0, 24.0, 23.5, 22.5],
        [24.0, 25.5, 25.0, 23.5],
        [24.5, 25.0, 25.5, 24.0],
        [23.5, 24.5, 24.0, 23.0],
    ],
};

/// How the manufactured part departs from the nominal one.
#[derive(Debug, Clone, PartialEq)]
pub struct Defects {
    /// The block's wall lies this far outward (+x), mm.
    pub wall_offset_mm: f64,
    /// The front face is turned about the line y = 0, z = 12, so that material is missing below it, rad.
    pub front_tilt_rad: f64,
    /// The boss is this much larger in radius, mm.
    pub boss_radius_mm: f64,
    /// Legs of the chamfer on the edge x = 80, z = 12, mm; 0 is a sharp edge.
    pub chamfer_mm: f64,
    /// Where light does not come back from.
    pub dark: Vec<Bounds>,
}

impl Defects {
    /// A part as drawn.
    pub fn none() -> Defects {
        Defects {
            wall_offset_mm: 0.0,
            front_tilt_rad: 0.0,
            boss_radius_mm: 0.0,
            chamfer_mm: 0.0,
            dark: Vec::new(),
        }
    }

    /// The demo's: wall 0.060 mm outward, front tilted by 0.25 degrees, boss 0.030 mm larger in radius, a chamfer of 0.4 mm,
    /// and a dark stretch of the front edge from x = 50 to 56.
    pub fn demo() -> Defects {
        Defects {
            wall_offset_mm: 0.060,
            front_tilt_rad: 0.25_f64.to_radians(),
            boss_radius_mm: 0.030,
            chamfer_mm: 0.4,
            dark: vec![Bounds::new(
                DVec3::new(50.0, -2.0, 6.0),
                DVec3::new(56.0, 5.0, 14.0),
            )],
        }
    }
}

/// Surfaces of the part by what they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub struct Faces {
    pub left: SurfaceId,
    pub right: SurfaceId,
    pub front: SurfaceId,
    pub back: SurfaceId,
    pub bottom: SurfaceId,
    pub plate_top: SurfaceId,
    pub wall: SurfaceId,
    pub block_top: SurfaceId,
    pub boss_side: SurfaceId,
    pub boss_top: SurfaceId,
}

/// An edge of the nominal part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NominalEdge {
    /// For people.
    pub name: &'static str,
    /// The two faces that meet.
    pub faces: [SurfaceId; 2],
    /// Convex or concave.
    pub kind: EdgeKind,
    curve: Curve,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Curve {
    Line(DVec3, DVec3),
    /// About the boss, at this height.
    Circle(f64),
    /// Over this line of the xy plane, on the block's top.
    OnTop(DVec2, DVec2),
}

/// The part twice, nominal and manufactured, with the same numbers for the same faces.
#[derive(Debug, Clone)]
pub struct DemoPart {
    /// As drawn.
    pub nominal: Scene,
    /// As made.
    pub made: Arc<Scene>,
    /// Numbers of the faces in both.
    pub faces: Faces,
    /// Every edge of the nominal part.
    pub edges: Vec<NominalEdge>,
}

impl DemoPart {
    /// The part with these defects.
    pub fn new(defects: &Defects) -> DemoPart {
        let (nominal, faces) = build(&Defects::none());
        let (made, _) = build(defects);
        DemoPart {
            nominal,
            made: Arc::new(made),
            faces,
            edges: edges(&faces),
        }
    }

    /// What a perfect measurement would say at a station of a nominal edge, given as a report gives it: point, tangent and the
    /// outward normals of the faces there. `None` where the station lies on no edge of the nominal part within 0.01 mm.
    pub fn truth(&self, station: &Station) -> Option<EdgeTruth> {
        let face = |normal: DVec3| {
            let surfaces = self.nominal.surfaces.iter();
            surfaces
                .map(|(id, s)| (id, s.value(station.point).abs(), s.normal(station.point, 0)))
                .filter(|(_, off, n)| *off < 0.01 && n.dot(normal) > 0.999)
                .min_by(|a, b| b.2.dot(normal).total_cmp(&a.2.dot(normal)))
                .map(|(id, ..)| id)
        };
        let pair = [face(station.normals[0])?, face(station.normals[1])?];
        let edge = self
            .edges
            .iter()
            .find(|e| e.faces == pair || e.faces == [pair[1], pair[0]])?;
        self.made.surfaces.edge_truth(station, pair, edge.kind)
    }

    /// Stations every `spacing_mm` or a little less along an edge, both ends left out.
    pub fn stations(&self, edge: &NominalEdge, spacing_mm: f64) -> Vec<Station> {
        let length = edge.curve.chord_mm();
        let n = (length / spacing_mm).ceil().max(1.0) as usize;
        (0..n)
            .map(|i| {
                let (point, tangent) = edge.curve.at((i as f64 + 0.5) / n as f64);
                let normals = edge
                    .faces
                    .map(|face| self.nominal.surfaces.get(face).normal(point, 0));
                Station {
                    point,
                    tangent,
                    normals,
                }
            })
            .collect()
    }
}

impl Curve {
    /// Length, or for a curved one in space that of its ground line.
    fn chord_mm(&self) -> f64 {
        match self {
            Curve::Line(a, b) => a.distance(*b),
            Curve::Circle(_) => std::f64::consts::TAU * BOSS_RADIUS_MM,
            Curve::OnTop(a, b) => a.distance(*b),
        }
    }

    fn at(&self, t: f64) -> (DVec3, DVec3) {
        match *self {
            Curve::Line(a, b) => (a.lerp(b, t), (b - a).normalize()),
            Curve::Circle(z) => {
                let out = DVec2::from_angle(t * std::f64::consts::TAU);
                let p = BOSS_CENTRE_MM + out * BOSS_RADIUS_MM;
                (p.extend(z), out.perp().extend(0.0))
            }
            Curve::OnTop(a, b) => {
                let p = a.lerp(b, t);
                let along = (b - a).normalize();
                let [sx, sy] = TOP.slopes(p.x, p.y);
                let rise = DVec2::new(sx, sy).dot(along);
                (
                    p.extend(TOP.height(p.x, p.y)),
                    along.extend(rise).normalize(),
                )
            }
        }
    }
}

fn build(defects: &Defects) -> (Scene, Faces) {
    let mut s = Surfaces::default();
    let [length, width] = PLATE_MM;
    let front_turn = glam::DMat3::from_rotation_x(defects.front_tilt_rad);
    let wall_x = WALL_MM + defects.wall_offset_mm;
    let faces = Faces {
        left: s.add(Surface::plane("left", DVec3::ZERO, DVec3::NEG_X)),
        right: s.add(Surface::plane("right", DVec3::X * length, DVec3::X)),
        front: s.add(Surface::plane(
            "front",
            DVec3::Z * PLATE_TOP_MM,
            front_turn * DVec3::NEG_Y,
        )),
        back: s.add(Surface::plane("back", DVec3::Y * width, DVec3::Y)),
        bottom: s.add(Surface::plane("bottom", DVec3::ZERO, DVec3::NEG_Z)),
        plate_top: s.add(Surface::plane(
            "plate top",
            DVec3::Z * PLATE_TOP_MM,
            DVec3::Z,
        )),
        wall: s.add(Surface::plane("wall", DVec3::X * wall_x, DVec3::X)),
        block_top: s.add(Surface::height_field("block top", TOP)),
        boss_side: s.add(Surface::cylinder(
            "boss side",
            BOSS_CENTRE_MM.extend(0.0),
            DVec3::Z,
            BOSS_RADIUS_MM + defects.boss_radius_mm,
        )),
        boss_top: s.add(Surface::plane("boss top", DVec3::Z * BOSS_TOP_MM, DVec3::Z)),
    };
    let chamfer = s.add(Surface::plane(
        "chamfer",
        DVec3::new(length - defects.chamfer_mm, 0.0, PLATE_TOP_MM),
        DVec3::new(1.0, 0.0, 1.0),
    ));
    let mut scene = Scene::new(s, body(&faces, chamfer, defects));
    scene.dark = defects.dark.clone();
    (scene, faces)
}

/// Plate, block and boss; the latter two reach into the plate, so that nothing depends on faces that only touch.
fn body(f: &Faces, chamfer: SurfaceId, defects: &Defects) -> Solid {
    let [length, width] = PLATE_MM;
    let slack = 0.5;
    let over = |low: DVec3, high: DVec3| {
        Bounds::new(low - DVec3::splat(slack), high + DVec3::splat(slack))
    };
    let plate = [f.plate_top, f.front, f.right, f.back, f.left, f.bottom];
    let mut plate: Vec<Solid> = plate.map(Solid::region).to_vec();
    if defects.chamfer_mm > 0.0 {
        plate.push(Solid::region(chamfer));
    }
    let plate =
        Solid::all(plate).within(over(DVec3::ZERO, DVec3::new(length, width, PLATE_TOP_MM)));
    let block = [f.left, f.wall, f.front, f.back, f.bottom, f.block_top];
    let block = Solid::all(block.map(Solid::region)).within(over(
        DVec3::ZERO,
        DVec3::new(WALL_MM + defects.wall_offset_mm, width, TOP.range()[1]),
    ));
    let reach = (BOSS_RADIUS_MM + defects.boss_radius_mm) * DVec2::ONE;
    let boss = [f.boss_top, f.boss_side, f.bottom];
    let boss = Solid::all(boss.map(Solid::region)).within(over(
        (BOSS_CENTRE_MM - reach).extend(0.0),
        (BOSS_CENTRE_MM + reach).extend(BOSS_TOP_MM),
    ));
    Solid::any([plate, block, boss])
}

fn edges(f: &Faces) -> Vec<NominalEdge> {
    use EdgeKind::{Concave, Convex};
    let [l, w] = PLATE_MM;
    let (top, wall) = (PLATE_TOP_MM, WALL_MM);
    let edge = |name, faces, kind, curve| NominalEdge {
        name,
        faces,
        kind,
        curve,
    };
    let line = |a: [f64; 3], b: [f64; 3]| Curve::Line(a.into(), b.into());
    let on_top = |a: [f64; 2], b: [f64; 2]| Curve::OnTop(a.into(), b.into());
    let at = |x: f64, y: f64| TOP.height(x, y);
    let upright = |x, y| line([x, y, 0.0], [x, y, top]);
    let block_upright = |x, y| line([x, y, 0.0], [x, y, at(x, y)]);
    let wall_upright = |y| line([wall, y, top], [wall, y, at(wall, y)]);
    vec![
        edge(
            "front",
            [f.front, f.plate_top],
            Convex,
            line([wall, 0.0, top], [l, 0.0, top]),
        ),
        edge(
            "back",
            [f.back, f.plate_top],
            Convex,
            line([wall, w, top], [l, w, top]),
        ),
        edge(
            "right",
            [f.right, f.plate_top],
            Convex,
            line([l, 0.0, top], [l, w, top]),
        ),
        edge(
            "wall foot",
            [f.wall, f.plate_top],
            Concave,
            line([wall, 0.0, top], [wall, w, top]),
        ),
        edge(
            "boss top",
            [f.boss_side, f.boss_top],
            Convex,
            Curve::Circle(BOSS_TOP_MM),
        ),
        edge(
            "boss foot",
            [f.boss_side, f.plate_top],
            Concave,
            Curve::Circle(top),
        ),
        edge(
            "wall top",
            [f.wall, f.block_top],
            Convex,
            on_top([wall, 0.0], [wall, w]),
        ),
        edge(
            "left top",
            [f.left, f.block_top],
            Convex,
            on_top([0.0, 0.0], [0.0, w]),
        ),
        edge(
            "front top",
            [f.front, f.block_top],
            Convex,
            on_top([0.0, 0.0], [wall, 0.0]),
        ),
        edge(
            "back top",
            [f.back, f.block_top],
            Convex,
            on_top([0.0, w], [wall, w]),
        ),
        edge("wall front", [f.wall, f.front], Convex, wall_upright(0.0)),
        edge("wall back", [f.wall, f.back], Convex, wall_upright(w)),
        edge("right front", [f.right, f.front], Convex, upright(l, 0.0)),
        edge("right back", [f.right, f.back], Convex, upright(l, w)),
        edge(
            "left front",
            [f.left, f.front],
            Convex,
            block_upright(0.0, 0.0),
        ),
        edge("left back", [f.left, f.back], Convex, block_upright(0.0, w)),
        edge(
            "bottom front",
            [f.bottom, f.front],
            Convex,
            line([0.0; 3], [l, 0.0, 0.0]),
        ),
        edge(
            "bottom back",
            [f.bottom, f.back],
            Convex,
            line([0.0, w, 0.0], [l, w, 0.0]),
        ),
        edge(
            "bottom left",
            [f.bottom, f.left],
            Convex,
            line([0.0; 3], [0.0, w, 0.0]),
        ),
        edge(
            "bottom right",
            [f.bottom, f.right],
            Convex,
            line([l, 0.0, 0.0], [l, w, 0.0]),
        ),
    ]
}

#[cfg(test)]
mod tests;
