//! New points spread evenly over the surface, and along its feature lines.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::bulk::{Reconstruction, reconstruct};
use super::lines::Grid;
use super::{Place, Scale, Settings, Surface, SurfaceError};
use crate::points::spacing::widest_gap;
use crate::points::{Neighbors, PointCloud};

/// More new points than this are not made.
const MOST_POINTS: u64 = 200_000_000;

/// An even set of points on a surface.
#[derive(Debug, Clone)]
pub struct Resampled {
    /// M positions, mm.
    pub positions: Vec<DVec3>,
    /// M unit normals, signs arbitrary; on an edge that of one flank.
    pub normals: Vec<Vec3>,
    /// What each point lies on.
    pub places: Vec<Place>,
    /// The sizes that followed from the cloud.
    pub scale: Scale,
}

/// Spreads points over the surface through `cloud`: on faces no two nearer than about `spacing_mm` and none missing, and along feature lines
/// at half of it.
///
/// # Errors
/// [`SurfaceError::TooFewPoints`], [`SurfaceError::Spacing`].
pub fn resample(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    spacing_mm: f64,
) -> Result<Resampled, SurfaceError> {
    let settings = Settings::default();
    let surface = Surface::new(cloud, neighbors, settings)?;
    let area = surface.positions.len() as f64 * surface.scale.spacing_mm.powi(2);
    let points = area / (spacing_mm * spacing_mm);
    if !(spacing_mm > 0.0 && spacing_mm.is_finite() && points < MOST_POINTS as f64) {
        return Err(SurfaceError::Spacing {
            spacing_mm,
            points,
            most: MOST_POINTS,
        });
    }
    let first = reconstruct(cloud, neighbors, settings)?;
    let mut grid = Grid::new(spacing_mm);
    let mut out = Resampled {
        positions: Vec::new(),
        normals: Vec::new(),
        places: Vec::new(),
        scale: surface.scale,
    };
    add_lines(&first, spacing_mm, (&mut grid, &mut out));
    // Two points of one face are apart by this; it leaves a spacing of about what was asked for on average.
    let apart = 0.8 * spacing_mm;
    for index in 0..first.positions.len() {
        if first.projected[index] && grid.take(first.positions[index], apart) {
            out.push(first.positions[index], first.normals[index], Place::Face);
        }
    }
    fill(&surface, apart, (&mut grid, &mut out));
    Ok(out)
}

impl Resampled {
    fn push(&mut self, position: DVec3, normal: Vec3, place: Place) {
        self.positions.push(position);
        self.normals.push(normal);
        self.places.push(place);
    }
}

fn add_lines(
    first: &Reconstruction,
    spacing_mm: f64,
    (grid, out): (&mut Grid<()>, &mut Resampled),
) {
    for line in &first.lines {
        if grid.take(line.position, 0.4 * spacing_mm) {
            out.push(line.position, line.normals[0], line.place);
        }
    }
}

/// Grows the set outwards from its own points until none has room beside it.
fn fill(surface: &Surface, apart: f64, (grid, out): (&mut Grid<()>, &mut Resampled)) {
    let mut from = 0;
    while from < out.positions.len() && (out.positions.len() as u64) < MOST_POINTS {
        let until = out.positions.len().min(from + 65_536);
        let (positions, normals) = (&out.positions[from..until], &out.normals[from..until]);
        let candidates: Vec<(DVec3, Vec3, Place)> = (positions, normals)
            .into_par_iter()
            .flat_map_iter(|(p, n)| around(surface, *p, *n, apart))
            .collect();
        for (position, normal, place) in candidates {
            let distance = if place == Place::Face {
                apart
            } else {
                0.5 * apart
            };
            if grid.take(position, distance) {
                out.push(position, normal, place);
            }
        }
        from = until;
    }
}

/// Neighbours among which a new point must lie.
const AMONG: usize = 24;

/// The widest angle without data around a new point on a face, rad. On an edge half of the directions have none, and chance leaves more of
/// them empty; where a face runs on beyond its edge, by half a spacing or more, it is wider than this.
const GAP_MOST: f64 = 220.0 * std::f64::consts::PI / 180.0;

/// Whether the data that lies on the tangent plane at `at` surrounds it; a face is not believed to run on beyond its points.
fn is_among_data(surface: &Surface, at: DVec3, normal: DVec3) -> bool {
    let mut found = Vec::new();
    surface.neighbors.get().nearest(at, AMONG, &mut found);
    let (u, v) = normal.any_orthonormal_pair();
    let tolerance = 3.0 * surface.scale.noise_mm + surface.scale.floor_mm();
    let mut angles: Vec<f64> = (found.iter())
        .map(|(i, _)| surface.positions[*i as usize] - at)
        .filter(|d| d.dot(normal).abs() < tolerance + 0.15 * d.length())
        .map(|d| d.dot(v).atan2(d.dot(u)))
        .collect();
    angles.len() > 3 && widest_gap(&mut angles) < GAP_MOST
}

/// Six places around `p` on the surface.
fn around(surface: &Surface, p: DVec3, normal: Vec3, apart: f64) -> Vec<(DVec3, Vec3, Place)> {
    let (u, v) = normal
        .as_dvec3()
        .normalize_or(DVec3::Z)
        .any_orthonormal_pair();
    (0..6)
        .filter_map(|k| {
            let (sine, cosine) = (f64::from(k) * std::f64::consts::FRAC_PI_3).sin_cos();
            let start = p + (u * cosine + v * sine) * (1.05 * apart);
            let at = surface.project(start)?;
            let near = at.position.distance(start) < apart;
            let is_believed = near
                && (at.place != Place::Face || is_among_data(surface, at.position, at.normals[0]));
            is_believed.then(|| (at.position, at.normals[0].as_vec3(), at.place))
        })
        .collect()
}
