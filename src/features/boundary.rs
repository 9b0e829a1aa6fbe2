//! Points on the border of the data: open edges and occlusions.

use glam::DVec3;
use rayon::prelude::*;

use super::Class;
use super::adaptive::Places;
use super::tangent::Tangents;
use crate::points::spacing::widest_gap;

/// Widest angle without a neighbour, degrees, from which on a point is on a border: a straight border 1.1 spacings away leaves 130 degrees
/// of the circle of 24 neighbours free; inside, chance does so for fewer than one point in a thousand.
const GAP_DEG: f64 = 130.0;
/// Other border points that must be among the neighbours.
const FELLOWS: usize = 3;

/// `classes` with [`Class::Boundary`] where there was none and the point is on a border.
///
/// The neighbours' directions are counted in the tangent plane of the whole neighbourhood, which near a crease lies between the flanks:
/// both project to their own side of it, so that a crease leaves no gap.
pub(super) fn mark(places: &Places, tangents: &Tangents, mut classes: Vec<Class>) -> Vec<Class> {
    let open: Vec<bool> = (0..places.positions.len())
        .into_par_iter()
        .map_init(Vec::new, |angles, rank| {
            is_open(places, tangents, rank, angles)
        })
        .collect();
    classes
        .par_iter_mut()
        .enumerate()
        .for_each(|(rank, class)| {
            if *class == Class::None && open[rank] {
                let around = tangents.around(rank);
                let fellows = around.iter().filter(|j| open[**j as usize]).count();
                if fellows > FELLOWS {
                    *class = Class::Boundary;
                }
            }
        });
    classes
}

fn is_open(places: &Places, tangents: &Tangents, rank: usize, angles: &mut Vec<f64>) -> bool {
    let plane = &tangents.planes[rank];
    let around = tangents.around(rank);
    let reach = f64::from(plane.reach_mm);
    let unit = places.unit_mm(reach, around.len());
    // A stray point off the surface sees all of it in one direction.
    let stray =
        f64::from(plane.height_mm).abs() > unit || reach > 6.0 * unit.min(places.spacing_mm);
    if stray || around.len() < 8 {
        return false;
    }
    let normal: DVec3 = plane.normal();
    let u = normal.any_orthonormal_vector();
    let v = normal.cross(u);
    let p = places.positions[rank];
    angles.clear();
    angles.extend(around[1..].iter().map(|j| {
        let d = places.positions[*j as usize] - p;
        d.dot(v).atan2(d.dot(u))
    }));
    widest_gap(angles) > GAP_DEG.to_radians()
}
