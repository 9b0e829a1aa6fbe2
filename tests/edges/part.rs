//! Edges as made: any body, its faces displaced, its edges broken, and scans of them with known truth.

use acies::inspect::body::Body;
use acies::nominal::{EdgeKind, Station};
use acies::points::{Frame, Origin, PointCloud, View};
use glam::{DMat2, DVec2, DVec3};

use super::solids::Noise;

/// What the edge itself looks like, sizes in mm, in the section across the tangent.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Break {
    Sharp,
    Round(f64),
    /// Legs on flank 1 and 2.
    Chamfer(f64, f64),
    /// Stands on flank 1 in line with flank 2: height, thickness.
    Burr(f64, f64),
    /// A step cut out of flank 1: depth along n1, width along the flank.
    Undercut(f64, f64),
}

/// How the points lie.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Layout {
    /// At random, points a mm2.
    Random(f64),
    /// In scan lines across the edge: distance along and across them, and a width next to the edge, where the points are wrong.
    Lines { along: f64, across: f64, smear: f64 },
}

/// One edge of a body as made.
pub struct Made<'a, B: Body> {
    pub body: &'a B,
    pub edge: usize,
    /// Displacement of the two faces at a place, mm.
    pub deviation: &'a dyn Fn(usize, DVec3) -> f64,
    pub shape: Break,
    /// Length of each flank, mm.
    pub flank_mm: f64,
    pub sigma_mm: f64,
    faces: [u32; 2],
    kind: EdgeKind,
}

impl<'a, B: Body> Made<'a, B> {
    pub fn new(
        body: &'a B,
        edge: usize,
        deviation: &'a dyn Fn(usize, DVec3) -> f64,
        shape: Break,
    ) -> Self {
        let of = &body.edges()[edge];
        Self {
            body,
            edge,
            deviation,
            shape,
            flank_mm: 2.5,
            sigma_mm: 0.010,
            faces: of.faces,
            kind: of.kind,
        }
    }

    /// The place in the plane across t at these heights over the two made faces.
    pub fn at(&self, station: &Station, heights: [f64; 2]) -> DVec3 {
        let faces = self.faces;
        let x_axis = station.normals[0];
        let y_axis = station.tangent.cross(x_axis).normalize();
        let flat = |v: DVec3| DVec2::new(v.dot(x_axis), v.dot(y_axis));
        let mut p = station.point;
        for _ in 0..12 {
            let mut rows = [DVec2::ZERO; 2];
            let mut off = [0.0; 2];
            for i in 0..2 {
                let foot = self.body.foot(faces[i], p, None).expect("a foot");
                rows[i] = flat(foot.normal);
                off[i] = heights[i] - (p - foot.point).dot(foot.normal) + (self.deviation)(i, p);
            }
            let step = DMat2::from_cols(rows[0], rows[1]).transpose().inverse() * DVec2::from(off);
            p += step.x * x_axis + step.y * y_axis;
            if step.length() < 1e-12 {
                break;
            }
        }
        p
    }

    /// True d1, d2.
    pub fn true_d(&self, station: &Station) -> [f64; 2] {
        let p = self.at(station, [0.0; 2]);
        station.normals.map(|n| (p - station.point).dot(n))
    }

    /// True included angle: between the made flanks' directions at the edge.
    pub fn true_angle(&self, station: &Station) -> f64 {
        let v = self.at(station, [0.0; 2]);
        let across = |i: usize| {
            let normal = self
                .body
                .foot(self.faces[i], v, None)
                .expect("a foot")
                .normal;
            normal.reject_from_normalized(station.tangent)
        };
        let turn = across(0).angle_between(across(1));
        let nominal = match self.kind {
            EdgeKind::Convex => std::f64::consts::PI - turn,
            EdgeKind::Concave => std::f64::consts::PI + turn,
        };
        let step = 1e-3;
        let turned = [0, 1].map(|i| {
            let b = station.into_face[i];
            let at = |r: f64| (self.deviation)(i, v + r * b);
            ((at(step) - at(-step)) / (2.0 * step)).atan()
        });
        nominal + turned[0] + turned[1]
    }

    /// Pieces of the section in wedge coordinates: (start, end) or an arc, from flank 1 to flank 2.
    fn pieces(&self, turn: f64) -> Vec<Piece> {
        let (sin, cos) = (0.5 * turn).sin_cos();
        let f1 = DVec2::new(cos, -sin);
        let f2 = DVec2::new(-cos, -sin);
        let m1 = DVec2::new(sin, cos);
        let end = self.flank_mm;
        match self.shape {
            Break::Sharp => vec![
                Piece::line(end * f1, DVec2::ZERO),
                Piece::line(DVec2::ZERO, end * f2),
            ],
            Break::Round(r) => {
                let t = r * sin / cos;
                vec![
                    Piece::line(end * f1, t * f1),
                    Piece::Arc {
                        centre: DVec2::new(0.0, -r / cos),
                        radius: r,
                        half: 0.5 * turn,
                    },
                    Piece::line(t * f2, end * f2),
                ]
            }
            Break::Chamfer(a, b) => vec![
                Piece::line(end * f1, a * f1),
                Piece::line(a * f1, b * f2),
                Piece::line(b * f2, end * f2),
            ],
            Break::Burr(height, thick) => {
                // In line with flank 2: its top is cut parallel to flank 1.
                let top = -height / turn.sin() * f2;
                vec![
                    Piece::line(end * f1, thick * f1),
                    Piece::line(thick * f1, thick * f1 + height * m1),
                    Piece::line(thick * f1 + height * m1, top),
                    Piece::line(top, DVec2::ZERO),
                    Piece::line(DVec2::ZERO, end * f2),
                ]
            }
            Break::Undercut(depth, width) => {
                let low = depth / turn.sin() * f2;
                vec![
                    Piece::line(end * f1, width * f1),
                    Piece::line(width * f1, width * f1 - depth * m1),
                    Piece::line(width * f1 - depth * m1, low),
                    Piece::line(low, end * f2),
                ]
            }
        }
    }

    /// Adds a scan of the arc lengths `from..to` to `cloud`.
    pub fn scan(
        &self,
        layout: Layout,
        (from, to): (f64, f64),
        cloud: &mut PointCloud,
        noise: &mut Noise,
    ) {
        let stations: Vec<Station> = match layout {
            Layout::Random(_) => Vec::new(),
            Layout::Lines { across, .. } => {
                let count = ((to - from) / across) as usize;
                let phase = noise.uniform();
                (0..count)
                    .map(|k| {
                        self.body
                            .station(self.edge, from + (k as f64 + phase) * across)
                    })
                    .collect()
            }
        };
        let kind = self.kind;
        let turn = turn_at(&self.body.station(self.edge, 0.5 * (from + to)));
        let total: f64 = self.pieces(turn).iter().map(Piece::length).sum();
        match layout {
            Layout::Random(density) => {
                let count = (density * total * (to - from)).round() as usize;
                for _ in 0..count {
                    let s = from + (to - from) * noise.uniform();
                    let station = self.body.station(self.edge, s);
                    let along = total * noise.uniform();
                    let p = self.point(&station, kind, along, None, noise);
                    cloud.positions.push(p);
                }
            }
            Layout::Lines { along, smear, .. } => {
                let view = cloud.views.len() as u16;
                cloud.views.push(View {
                    device: "test".to_string(),
                    towards_sensor: DVec3::ZERO,
                });
                let base = cloud.positions.len() as u32;
                for (profile, station) in stations.iter().enumerate() {
                    let mut at = along * noise.uniform();
                    let mut column = 0;
                    while at < total {
                        let p = self.point(station, kind, at, Some(smear), noise);
                        cloud.positions.push(p);
                        cloud.origins.push(Origin {
                            view,
                            column,
                            profile: base + profile as u32,
                        });
                        column += 1;
                        at += along;
                    }
                }
            }
        }
    }

    fn point(
        &self,
        station: &Station,
        kind: EdgeKind,
        along: f64,
        smear: Option<f64>,
        noise: &mut Noise,
    ) -> DVec3 {
        // The turn of the made faces; their tilts turn it by a per mille, which the heights carry.
        let turn = turn_at(station);
        let mut rest = along;
        let pieces = self.pieces(turn);
        let mut found = None;
        for piece in &pieces {
            let length = piece.length();
            if rest <= length {
                found = Some(piece.at(rest));
                break;
            }
            rest -= length;
        }
        let (mut q, normal) =
            found.unwrap_or_else(|| pieces[pieces.len() - 1].at(pieces[pieces.len() - 1].length()));
        if let Some(width) = smear
            && q.length() < width
        {
            // The spot sees both flanks: the point sinks towards the chord.
            q -= normal * 0.3 * (width - q.length()) * noise.uniform();
        }
        q += self.sigma_mm * noise.normal() * normal;
        let (sin, cos) = (0.5 * turn).sin_cos();
        let mut heights = [q.dot(DVec2::new(sin, cos)), q.dot(DVec2::new(-sin, cos))];
        if kind == EdgeKind::Concave {
            heights = heights.map(|h| -h);
        }
        self.at(station, heights)
    }
}

pub fn turn_at(station: &Station) -> f64 {
    station.normals[0].angle_between(station.normals[1])
}

enum Piece {
    Line {
        start: DVec2,
        end: DVec2,
    },
    Arc {
        centre: DVec2,
        radius: f64,
        half: f64,
    },
}

impl Piece {
    fn line(start: DVec2, end: DVec2) -> Self {
        Self::Line { start, end }
    }

    fn length(&self) -> f64 {
        match self {
            Self::Line { start, end } => start.distance(*end),
            Self::Arc { radius, half, .. } => 2.0 * radius * half,
        }
    }

    /// Place and outward normal. The material lies on the right of the way from flank 1 (at the right) to flank 2.
    fn at(&self, along: f64) -> (DVec2, DVec2) {
        match self {
            Self::Line { start, end } => {
                let direction = (*end - *start).normalize_or_zero();
                (*start + along * direction, -direction.perp())
            }
            Self::Arc {
                centre,
                radius,
                half,
            } => {
                let angle = half - along / radius;
                let out = DVec2::new(angle.sin(), angle.cos());
                (*centre + *radius * out, out)
            }
        }
    }
}

pub fn empty_cloud() -> PointCloud {
    PointCloud {
        frame: Frame::Part,
        positions: Vec::new(),
        origins: Vec::new(),
        views: Vec::new(),
    }
}
