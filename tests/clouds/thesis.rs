//! The clouds of Weber's thesis, chapter 3, and the measures of its Table 2.
//!
//! The thesis calls its clouds uniformly sampled, with one distance between neighbouring points (§3.7.5), and gives the number of points
//! in all and on edges (§3.7.2). Ours lie in rows, one step apart, on edges and faces; where a number leaves no regular sample, rows have
//! a point more or less than their neighbours.

use std::f64::consts::TAU;

use acies::features::Class;
use acies::points::Neighbors;
use glam::{DVec2, DVec3};

use super::score::is_edge;
use super::{Face, Line, Sampled, Solid, solids};

/// Radius of the ball that all points of the cube with hole lie in (§3.7.5).
pub const RADIUS: f64 = 8.5;

/// A cloud of Table 1 with what the author found in it by the local-adaptive method.
pub struct Example {
    pub name: &'static str,
    pub sampled: Sampled,
    pub detected: usize,
    pub outliers: Option<usize>,
}

/// The three clouds of Table 1.
pub fn table_1() -> [Example; 3] {
    let example = |name, sampled, detected, outliers| Example {
        name,
        sampled,
        detected,
        outliers,
    };
    [
        example("cube", lattice(&solids::cube(10.0), 10_250, 580), 575, None),
        example("planes", planes(6_090, 256), 257, Some(1)),
        example("hole", lattice(&hole(), 58_720, 1_350), 1_398, Some(48)),
    ]
}

/// The rows of Table 2: noise in percent of [`RADIUS`], largest and mean distance, features.
pub const TABLE_2: [(f64, f64, f64, usize); 6] = [
    (0.0, 0.0, 0.0, 839),
    (0.4, 0.25, 0.02, 862),
    (0.8, 0.26, 0.03, 875),
    (1.2, 0.31, 0.08, 984),
    (1.6, 0.75, 0.19, 1_245),
    (2.0, 0.93, 0.21, 1_255),
];

/// The included angles, degrees, of Fig. 25.
pub const FIGURE_25: [f64; 8] = [25.0, 45.0, 60.0, 90.0, 110.0, 140.0, 160.0, 170.0];

/// The cube with hole whose corners lie [`RADIUS`] from its middle.
pub fn hole() -> Solid {
    solids::cube_with_hole(2.0 * RADIUS / 3f64.sqrt())
}

/// The cloud of Table 2 without noise.
pub fn hole_of_table_2() -> Sampled {
    lattice(&hole(), 17_400, 839)
}

/// Two planes at an included angle (degrees), with the spacing and size of the cloud of varying angle.
pub fn wedge(degrees: f64) -> Sampled {
    lattice(&solids::wedge(40.0, degrees.to_radians()), 3_240, 40)
}

/// Two bilinear strips that meet in a straight edge at 45 degrees at its one end and at 140 at the other; one apart along the edge.
pub fn planes(count: usize, on_edge: usize) -> Sampled {
    let length = on_edge as f64;
    let width = (count - on_edge) as f64 / (2.0 * length);
    let end = |y: f64, degrees: f64, side: f64| {
        let half = 0.5 * degrees.to_radians();
        DVec3::new(-half.cos(), 0.0, side * half.sin()) * (width + 0.5) + DVec3::Y * y
    };
    let (a, b) = (DVec3::ZERO, DVec3::Y * length);
    let mut points: Vec<DVec3> = (0..on_edge)
        .map(|i| a.lerp(b, (i as f64 + 0.5) / length))
        .collect();
    let mut borders = Vec::new();
    for (side, owed) in [
        (1.0, (count - on_edge) / 2),
        (-1.0, (count - on_edge).div_ceil(2)),
    ] {
        let (c, d) = (end(0.0, 45.0, side), end(length, 140.0, side));
        // Lines across the strip, a point's place on it counted from the edge in steps of one.
        for i in 0..on_edge {
            let s = (i as f64 + 0.5) / length;
            let (foot, head) = (a.lerp(b, s), c.lerp(d, s));
            let many = (i + 1) * owed / on_edge - i * owed / on_edge;
            points.extend((1..=many).map(|k| foot + (head - foot).normalize() * k as f64));
        }
        borders.extend([
            Line::Segment(a, c),
            Line::Segment(b, d),
            Line::Segment(c, d),
        ]);
    }
    Sampled {
        on_edge: (0..points.len()).map(|i| i < on_edge).collect(),
        points,
        spacing: 1.0,
        edges: vec![Line::Segment(a, b)],
        borders,
        ..Sampled::default()
    }
}

/// `count` points in rows on the faces and edges of a solid, `on_edges` of them on the edges, a corner counted once.
pub fn lattice(solid: &Solid, count: usize, on_edges: usize) -> Sampled {
    let area = solid.area();
    let spacing = (area / count as f64).sqrt();
    let mut points = on_lines(&solid.edges, on_edges);
    let mut owed = 0.0;
    let mut made = points.len();
    for face in &solid.faces {
        owed += face.area() / area * (count - on_edges) as f64;
        let many = (on_edges as f64 + owed).round() as usize - made;
        made += many;
        in_rows(&mut points, &rows(face, spacing), many);
    }
    Sampled {
        on_edge: (0..points.len()).map(|i| i < on_edges).collect(),
        points,
        spacing,
        edges: solid.edges.clone(),
        borders: solid.borders.clone(),
        ..Sampled::default()
    }
}

/// `count` points on lines: their ends once each, the rest evenly inside.
fn on_lines(lines: &[Line], count: usize) -> Vec<DVec3> {
    let mut points: Vec<DVec3> = Vec::with_capacity(count);
    for end in lines.iter().flat_map(|l| [l.at(0.0), l.at(1.0)]) {
        if points.iter().all(|p| p.distance(end) > 1e-9) {
            points.push(end);
        }
    }
    let total: f64 = lines.iter().map(Line::length).sum();
    let inside = count - points.len();
    let (mut walked, mut made) = (0.0, 0);
    for line in lines {
        walked += line.length();
        let many = (walked / total * inside as f64).round() as usize - made;
        made += many;
        points.extend((1..=many).map(|k| line.at(k as f64 / (many + 1) as f64)));
    }
    points
}

/// Parts of a row of a face in which points may lie: the row's points from shares of its part.
type Row<'a> = (f64, Box<dyn Fn(f64) -> DVec3 + 'a>);

/// `many` points in the rows, in proportion to the rows' lengths.
fn in_rows(points: &mut Vec<DVec3>, rows: &[Row<'_>], many: usize) {
    let total: f64 = rows.iter().map(|r| r.0).sum();
    let (mut walked, mut made) = (0.0, 0);
    for (length, at) in rows {
        walked += length;
        let here = (walked / total * many as f64).round() as usize - made;
        made += here;
        points.extend((0..here).map(|k| at((k as f64 + 0.5) / here as f64)));
    }
}

/// Rows a spacing apart, their parts shortened so that the first point comes to lie one spacing from the edge.
fn rows(face: &Face, spacing: f64) -> Vec<Row<'_>> {
    let mut rows: Vec<Row<'_>> = Vec::new();
    match face {
        Face::Flat {
            origin,
            u,
            v,
            outline,
            holes,
        } => {
            let low = outline.iter().copied().reduce(DVec2::min).unwrap();
            let high = outline.iter().copied().reduce(DVec2::max).unwrap();
            let many = ((high.y - low.y) / spacing).round() as usize;
            for row in 1..many {
                let y = low.y + (high.y - low.y) * row as f64 / many as f64;
                let mut ends = vec![low.x + 0.5 * spacing, high.x - 0.5 * spacing];
                for (centre, radius) in holes {
                    let half = (radius + 0.5 * spacing).powi(2) - (y - centre.y).powi(2);
                    if half > 0.0 {
                        ends.extend([centre.x - half.sqrt(), centre.x + half.sqrt()]);
                    }
                }
                ends.sort_by(f64::total_cmp);
                for part in ends.chunks_exact(2) {
                    let (from, to) = (part[0], part[1]);
                    let at = move |t: f64| *origin + *u * (from + (to - from) * t) + *v * y;
                    rows.push((to - from, Box::new(at)));
                }
            }
        }
        Face::Round {
            base,
            axis,
            start,
            radii: (low, _),
            sweep,
        } => {
            let many = (axis.length() / spacing).round() as usize;
            for row in 1..many {
                let foot = *base + *axis * (row as f64 / many as f64);
                let circle = Line::Arc(foot, axis.normalize(), *start * *low, *sweep);
                rows.push((circle.length(), Box::new(move |t| circle.at(t))));
            }
        }
        Face::Disc {
            centre,
            normal,
            radius,
        } => {
            let many = (radius / spacing).round() as usize;
            for row in 1..many {
                let radius = radius * row as f64 / many as f64;
                let start = normal.any_orthonormal_vector() * radius;
                let circle = Line::Arc(*centre, *normal, start, TAU);
                rows.push((circle.length(), Box::new(move |t| circle.at(t))));
            }
        }
    }
    rows
}

/// What Tables 1 and 2 say of a detection.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Figures {
    /// Estimated feature points.
    pub detected: usize,
    /// Feature points there are: those made on edges.
    pub features: usize,
    /// Those of them that are detected.
    pub hits: usize,
    /// Mean distance from an estimated feature point to the nearest feature point of the cloud before it was shaken (§3.7.5), in the
    /// unit of the cloud.
    pub mean: f64,
    /// The largest of these distances.
    pub largest: f64,
}

impl Figures {
    /// Detected points that were not made on an edge: the false features.
    pub fn outliers(&self) -> usize {
        self.detected - self.hits
    }
}

/// Compares the classes of `shaken` (or of `exact` itself) with the feature points of `exact`.
pub fn figures(exact: &Sampled, shaken: &Sampled, classes: &[Class]) -> Figures {
    let truth = exact.points.iter().zip(&exact.on_edge).filter(|(_, o)| **o);
    let truth: Vec<DVec3> = truth.map(|(p, _)| *p).collect();
    let near = Neighbors::new(&truth);
    let mut figures = Figures {
        features: truth.len(),
        ..Figures::default()
    };
    let mut found = Vec::new();
    let mut sum = 0.0;
    for ((p, class), on_edge) in shaken.points.iter().zip(classes).zip(&exact.on_edge) {
        if is_edge(class) {
            near.nearest(*p, 1, &mut found);
            let distance = found.first().map_or(f64::INFINITY, |f| f.1.sqrt());
            figures.detected += 1;
            figures.hits += usize::from(*on_edge);
            figures.largest = figures.largest.max(distance);
            sum += distance;
        }
    }
    figures.mean = sum / figures.detected.max(1) as f64;
    figures
}
