//! Scan lines: as few places of them as lie equally densely along and across.

use std::f64::consts::PI;

use glam::DVec3;

use crate::points::Neighbors;

/// Distance of the places picked, as a share of the distance of the lines.
pub(super) const PICKED: f64 = 0.55;

/// Places of `all` (mm; `neighbors` ranks them in this order) no two of which are nearer than `apart_mm`, and none of which lies farther
/// than that from all of them; those that are `stray` aside.
pub(super) fn pick(
    all: &[DVec3],
    neighbors: &Neighbors,
    (apart_mm, stray): (f64, &dyn Fn(usize) -> bool),
) -> Vec<DVec3> {
    let mut covered = vec![false; all.len()];
    let mut picked = Vec::new();
    let mut found = Vec::new();
    for (rank, p) in all.iter().enumerate() {
        if covered[rank] || stray(rank) {
            continue;
        }
        picked.push(*p);
        neighbors.within_places(*p, apart_mm, &mut found);
        for (near, _) in &found {
            covered[*near as usize] = true;
        }
    }
    picked
}

/// Spacing of the places picked, mm: the median over them of what their neighbours say.
pub(super) fn picked_spacing_mm(positions: &[DVec3], neighbors: &Neighbors) -> f64 {
    const NEIGHBOURS: usize = 24;
    let step = (positions.len() / 3_000).max(1);
    let mut found = Vec::new();
    let mut spacings: Vec<f64> = positions
        .iter()
        .step_by(step)
        .map(|p| {
            neighbors.nearest_places(*p, NEIGHBOURS, &mut found);
            let last = found.last().map_or(0.0, |f| f.1);
            (PI * last / (found.len().max(2) - 1) as f64).sqrt()
        })
        .collect();
    if spacings.is_empty() {
        return 0.0;
    }
    let middle = spacings.len() / 2;
    *spacings.select_nth_unstable_by(middle, f64::total_cmp).1
}
