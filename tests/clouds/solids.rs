//! The solids: cube, planes, cube with a hole, machined block, wedges, ribs, cones.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, DVec3};

use super::{Face, Line, Solid};

/// A vertical hole: centre in x, y, radius, height of its mouth, height of its end, and whether it ends in a bottom.
#[derive(Debug, Clone, Copy)]
pub struct Hole {
    pub centre: DVec2,
    pub radius: f64,
    pub top: f64,
    pub bottom: f64,
    pub blind: bool,
}

/// The profile (x, z; counter-clockwise) pulled from y = 0 to y = `width`, with vertical holes in its horizontal faces.
pub fn extrusion(profile: &[DVec2], width: f64, holes: &[Hole]) -> Solid {
    let mut solid = Solid::default();
    let n = profile.len();
    let at = |p: DVec2, y: f64| DVec3::new(p.x, y, p.y);
    for y in [0.0, width] {
        solid.faces.push(Face::Flat {
            origin: DVec3::new(0.0, y, 0.0),
            u: DVec3::X,
            v: DVec3::Z,
            outline: profile.to_vec(),
            holes: Vec::new(),
        });
    }
    for i in 0..n {
        let (a, b) = (profile[i], profile[(i + 1) % n]);
        let u = (at(b, 0.0) - at(a, 0.0)).normalize();
        let length = a.distance(b);
        let mut discs = Vec::new();
        if a.y == b.y {
            for hole in holes {
                let inside = hole.centre.x > a.x.min(b.x) && hole.centre.x < a.x.max(b.x);
                let ends_here = a.y == hole.top || (a.y == hole.bottom && !hole.blind);
                if inside && ends_here {
                    discs.push((
                        DVec2::new((hole.centre.x - a.x) * u.x, hole.centre.y),
                        hole.radius,
                    ));
                }
            }
        }
        solid.faces.push(Face::Flat {
            origin: at(a, 0.0),
            u,
            v: DVec3::Y,
            outline: rectangle(length, width),
            holes: discs,
        });
        solid.edges.push(Line::Segment(at(a, 0.0), at(b, 0.0)));
        solid.edges.push(Line::Segment(at(a, width), at(b, width)));
        solid.edges.push(Line::Segment(at(a, 0.0), at(a, width)));
    }
    for hole in holes {
        add_hole(&mut solid, hole);
    }
    centred(solid)
}

fn add_hole(solid: &mut Solid, hole: &Hole) {
    let base = DVec3::new(hole.centre.x, hole.centre.y, hole.bottom);
    let axis = DVec3::Z * (hole.top - hole.bottom);
    solid.faces.push(Face::Round {
        base,
        axis,
        start: DVec3::X,
        radii: (hole.radius, hole.radius),
        sweep: TAU,
    });
    for centre in [base, base + axis] {
        solid
            .edges
            .push(Line::Arc(centre, DVec3::Z, DVec3::X * hole.radius, TAU));
    }
    if hole.blind {
        solid.faces.push(Face::Disc {
            centre: base,
            normal: DVec3::Z,
            radius: hole.radius,
        });
    }
}

fn rectangle(x: f64, y: f64) -> Vec<DVec2> {
    vec![
        DVec2::ZERO,
        DVec2::new(x, 0.0),
        DVec2::new(x, y),
        DVec2::new(0.0, y),
    ]
}

/// Moved so that the middle of its edges' bounding box is the origin.
fn centred(mut solid: Solid) -> Solid {
    let ends = solid.edges.iter().flat_map(|e| [e.at(0.0), e.at(0.5)]);
    let (low, high) = ends.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), p| {
        (l.min(p), h.max(p))
    });
    let shift = -(low + high) * 0.5;
    for face in &mut solid.faces {
        match face {
            Face::Flat { origin, .. } => *origin += shift,
            Face::Round { base, .. } => *base += shift,
            Face::Disc { centre, .. } => *centre += shift,
        }
    }
    for line in solid.edges.iter_mut().chain(&mut solid.borders) {
        match line {
            Line::Segment(a, b) => {
                *a += shift;
                *b += shift;
            }
            Line::Arc(c, ..) => *c += shift,
        }
    }
    solid
}

pub fn cube(side: f64) -> Solid {
    extrusion(&rectangle(side, side), side, &[])
}

/// A cube with a through hole of radius 0.3 of its side.
pub fn cube_with_hole(side: f64) -> Solid {
    let hole = Hole {
        centre: DVec2::splat(0.5 * side),
        radius: 0.3 * side,
        top: side,
        bottom: 0.0,
        blind: false,
    };
    extrusion(&rectangle(side, side), side, &[hole])
}

/// A machined block, about 120 x 80 x 30 mm: a step, a slot, a groove, two through holes, a blind hole and a small one.
pub fn block() -> Solid {
    let profile: Vec<DVec2> = [
        (0.0, 0.0),
        (120.0, 0.0),
        (120.0, 18.0),
        (92.0, 18.0),
        (88.0, 30.0),
        (52.0, 30.0),
        (52.0, 22.0),
        (40.0, 22.0),
        (40.0, 30.0),
        (12.0, 30.0),
        (0.0, 24.0),
    ]
    .iter()
    .map(|(x, z)| DVec2::new(*x, *z))
    .collect();
    let hole = |x: f64, y: f64, radius: f64, (top, bottom): (f64, f64)| Hole {
        centre: DVec2::new(x, y),
        radius,
        top,
        bottom,
        blind: bottom > 0.0,
    };
    let holes = [
        hole(70.0, 40.0, 12.0, (30.0, 0.0)),
        hole(106.0, 20.0, 5.0, (18.0, 0.0)),
        hole(106.0, 58.0, 7.0, (18.0, 8.0)),
        hole(26.0, 20.0, 3.0, (30.0, 15.0)),
        hole(26.0, 55.0, 8.0, (30.0, 20.0)),
    ];
    extrusion(&profile, 80.0, &holes)
}

/// Two square faces of side `side` that meet at the included angle `angle` (rad) along the y axis.
pub fn wedge(side: f64, angle: f64) -> Solid {
    let mut solid = Solid {
        edges: vec![Line::Segment(DVec3::Y * -0.5 * side, DVec3::Y * 0.5 * side)],
        ..Solid::default()
    };
    for a in [0.5 * angle, -0.5 * angle] {
        let u = DVec3::new(-a.cos(), 0.0, -a.sin());
        let origin = DVec3::Y * -0.5 * side;
        solid.faces.push(Face::Flat {
            origin,
            u,
            v: DVec3::Y,
            outline: rectangle(side, side),
            holes: Vec::new(),
        });
        let corner = [origin, origin + u * side];
        let far = corner.map(|c| c + DVec3::Y * side);
        solid.borders.push(Line::Segment(corner[0], corner[1]));
        solid.borders.push(Line::Segment(far[0], far[1]));
        solid.borders.push(Line::Segment(corner[1], far[1]));
    }
    solid
}

/// A plate with upright ribs of the given thicknesses and grooves of the same widths.
pub fn ribs(thicknesses: &[f64]) -> Solid {
    let mut profile = vec![DVec2::new(0.0, 0.0)];
    let gap = 20.0;
    let end = thicknesses.iter().map(|t| gap + 2.0 * t + gap).sum::<f64>() + gap;
    profile.push(DVec2::new(end, 0.0));
    profile.push(DVec2::new(end, 20.0));
    let mut x = end;
    for t in thicknesses {
        for (dx, z) in [
            (gap, 20.0),
            (0.0, 40.0),
            (*t, 40.0),
            (0.0, 20.0),
            (gap, 20.0),
            (0.0, 10.0),
            (*t, 10.0),
            (0.0, 20.0),
        ] {
            x -= dx;
            profile.push(DVec2::new(x, z));
        }
    }
    profile.push(DVec2::new(0.0, 20.0));
    extrusion(&profile, 40.0, &[])
}

/// A cone with base: a circular edge and a tip.
pub fn cone(radius: f64, height: f64) -> Solid {
    let base = DVec3::Z * (-0.5 * height);
    Solid {
        faces: vec![
            Face::Round {
                base,
                axis: DVec3::Z * height,
                start: DVec3::X,
                radii: (radius, 0.0),
                sweep: TAU,
            },
            Face::Disc {
                centre: base,
                normal: DVec3::Z,
                radius,
            },
        ],
        edges: vec![Line::Arc(base, DVec3::Z, DVec3::X * radius, TAU)],
        borders: Vec::new(),
    }
}

/// A closed cylinder: two circular edges.
pub fn cylinder(radius: f64, height: f64) -> Solid {
    let mut solid = cone(radius, height);
    solid.faces[0] = Face::Round {
        base: DVec3::Z * (-0.5 * height),
        axis: DVec3::Z * height,
        start: DVec3::X,
        radii: (radius, radius),
        sweep: TAU,
    };
    solid.faces.push(Face::Disc {
        centre: DVec3::Z * (0.5 * height),
        normal: DVec3::Z,
        radius,
    });
    solid.edges.push(Line::Arc(
        DVec3::Z * (0.5 * height),
        DVec3::Z,
        DVec3::X * radius,
        TAU,
    ));
    solid
}

/// A bar with rounded long edges of the given radius: only its ends have edges.
pub fn rounded_bar(radius: f64) -> Solid {
    let (w, length) = (40.0, 60.0);
    let mut solid = Solid::default();
    let inner = 0.5 * w;
    for quarter in 0..4 {
        let turn = f64::from(quarter) * 0.5 * PI;
        let x = DVec3::new(turn.cos(), turn.sin(), 0.0);
        let y = DVec3::Z.cross(x);
        let base = (x + y) * inner - DVec3::Z * 0.5 * length;
        solid.faces.push(Face::Round {
            base,
            axis: DVec3::Z * length,
            start: x,
            radii: (radius, radius),
            sweep: 0.5 * PI,
        });
        let origin = x * (inner + radius) - y * inner - DVec3::Z * 0.5 * length;
        solid.faces.push(Face::Flat {
            origin,
            u: y,
            v: DVec3::Z,
            outline: rectangle(w, length),
            holes: Vec::new(),
        });
        for z in [0.0, length] {
            let up = DVec3::Z * z;
            solid
                .borders
                .push(Line::Arc(base + up, DVec3::Z, x * radius, 0.5 * PI));
            solid
                .borders
                .push(Line::Segment(origin + up, origin + up + y * w));
        }
    }
    solid
}
