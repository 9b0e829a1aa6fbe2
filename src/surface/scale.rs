//! What the sizes of all neighbourhoods and tolerances follow from: spacing and noise of the points.

use glam::DVec3;

use crate::points::{Neighbors, PointCloud, noise_mm, spacing};

/// Sizes of neighbourhoods and tolerances, all derived from the points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    /// Square root of the area a supporting point has to itself, mm.
    pub spacing_mm: f64,
    /// Standard deviation of the points along the surface normal, mm.
    pub noise_mm: f64,
    /// Supporting points within the weights of one projection.
    pub points: usize,
    /// Points nearer than this to one taken already do not support the surface, mm; 0 where all do.
    pub thinning_mm: f64,
}

/// Supporting points that lie closer along a scan line than this part of the spacing across are thinned out.
const LINE_PART: f64 = 1.0 / 3.0;

impl Scale {
    /// The scale of `cloud`.
    ///
    /// In scan lines neighbourhoods of equal count would hold pieces of one or two lines only (Weber 2011, §4.4.6): there the surface
    /// rests on a part of the points that is at most three times as dense along the lines as across, and every point is still projected.
    pub fn of(cloud: &PointCloud, neighbors: &Neighbors) -> Self {
        let spacing = spacing(cloud, neighbors);
        let mut noise_mm = noise_mm(cloud, neighbors, &spacing);
        if !spacing.in_lines() {
            // Where two sheets lie closer than a neighbourhood everywhere, the distance between them passes for noise.
            noise_mm = noise_mm.min(1.5 * super::robust::noise_of_planes_mm(cloud, neighbors));
        }
        let thinning_mm = if spacing.along_mm < LINE_PART * spacing.across_mm {
            LINE_PART * spacing.across_mm
        } else {
            0.0
        };
        let along = spacing.along_mm.max(thinning_mm);
        let spacing_mm = if spacing.in_lines() {
            (along * spacing.across_mm).sqrt()
        } else {
            spacing.mean_mm
        };
        Self {
            spacing_mm,
            noise_mm,
            points: points_for(noise_mm / spacing_mm.max(f64::MIN_POSITIVE)),
            thinning_mm,
        }
    }

    /// h of the Gaussian weight exp(-d²/h²) where points lie evenly, mm.
    pub fn smoothing_mm(&self) -> f64 {
        self.spacing_mm * (self.points as f64 / std::f64::consts::PI).sqrt() / 1.5
    }

    /// Below this two lengths on the surface are the same, mm, even without any noise.
    pub(crate) fn floor_mm(&self) -> f64 {
        0.004 * self.spacing_mm
    }

    /// Supporting points of the small neighbourhoods that robust normals come from.
    pub(crate) fn points_near(&self) -> usize {
        (self.points * 3 / 5).max(16)
    }

    /// Supporting points among which the flanks around a point are told apart.
    pub(crate) fn points_wide(&self) -> usize {
        self.points * 9 / 5
    }
}

/// Points of one projection for a ratio of noise to spacing: enough that a quadric's height at the centre has a third of the noise at a
/// ratio of 0.1, more where there is more, fewer where nothing needs to be averaged. Above a ratio of 0.8 no edge is left to be seen.
fn points_for(ratio: f64) -> usize {
    let ratio = ratio.clamp(0.0, 0.8);
    (22.0 + 150.0 * ratio + 150.0 * (ratio - 0.15).max(0.0)) as usize
}

/// Indices of the points that support the surface, in the order of `neighbors`: no two closer than `distance_mm`.
pub(crate) fn thin(positions: &[DVec3], neighbors: &Neighbors, distance_mm: f64) -> Vec<u32> {
    let cell = |p: DVec3| (p / distance_mm).floor().as_i64vec3();
    let mut taken: std::collections::HashMap<glam::I64Vec3, Vec<u32>> =
        std::collections::HashMap::new();
    let mut kept = Vec::new();
    for &index in neighbors.order() {
        let p = positions[index as usize];
        let home = cell(p);
        let near =
            (-1..=1).flat_map(|x| (-1..=1).flat_map(move |y| (-1..=1).map(move |z| (x, y, z))));
        let mut others =
            near.filter_map(|(x, y, z)| taken.get(&(home + glam::I64Vec3::new(x, y, z))));
        let close =
            |i: &u32| positions[*i as usize].distance_squared(p) < distance_mm * distance_mm;
        if others.any(|cell| cell.iter().any(close)) {
            continue;
        }
        taken.entry(home).or_default().push(index);
        kept.push(index);
    }
    kept.sort_unstable();
    kept
}
