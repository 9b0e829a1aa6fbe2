//! The points of every flank, in the coordinates of its edge.

use glam::DVec3;
use rayon::prelude::*;

use super::assign::{NO_FACE, Place};
use super::body::{Body, BodyEdge};
use super::edge_break::ZonePoint;
use super::flank::{FlankPoint, FlankPoints, NO_LINE, Windows};
use crate::nominal::Station;
use crate::points::PointCloud;
use crate::points::neighbors::Neighbors;

/// Points that one task looks at.
const BLOCK: usize = 8192;

/// An edge with frames along it, close enough together that the nearest one gives the coordinates of a point.
pub(super) struct Track {
    frames: Vec<Station>,
    tree: Neighbors,
    half_step_mm: f64,
    low: DVec3,
    high: DVec3,
}

/// Where a point lies as seen from an edge.
#[derive(Debug, Clone, Copy)]
struct Seen {
    s: f64,
    r: f64,
    distance: f64,
}

impl Track {
    /// Frames at least two to a station along the edge with index `index`.
    pub(super) fn new<B: Body>(body: &B, index: usize, edge: &BodyEdge, windows: &Windows) -> Self {
        let count = (2 * windows.count).max(16);
        let step = edge.length_mm / count as f64;
        let frames: Vec<Station> = (0..count)
            .map(|k| body.station(index, (k as f64 + 0.5) * step))
            .collect();
        let points: Vec<DVec3> = frames.iter().map(|f| f.point).collect();
        let fold = |pick: fn(DVec3, DVec3) -> DVec3| points.iter().copied().reduce(pick);
        Self {
            tree: Neighbors::new(&points),
            half_step_mm: 0.5 * step,
            low: fold(DVec3::min).unwrap_or(DVec3::ZERO),
            high: fold(DVec3::max).unwrap_or(DVec3::ZERO),
            frames,
        }
    }

    /// The place of `p` on flank `side`, if it lies within `radius_mm` of the edge.
    fn seen(
        &self,
        p: DVec3,
        side: usize,
        radius_mm: f64,
        found: &mut Vec<(u32, f64)>,
    ) -> Option<Seen> {
        let beyond = (self.low - p).max(p - self.high).max(DVec3::ZERO);
        if beyond.length_squared() > (radius_mm + self.half_step_mm).powi(2) {
            return None;
        }
        self.tree.nearest(p, 1, found);
        let (index, _) = *found.first()?;
        let frame = &self.frames[index as usize];
        let offset = p - frame.point;
        let along = offset.dot(frame.tangent);
        let inside = along.clamp(-self.half_step_mm, self.half_step_mm);
        Some(Seen {
            s: frame.s_mm + along,
            r: offset.dot(frame.into_face[side]),
            distance: (offset - inside * frame.tangent).length(),
        })
    }

    /// Distances of `p` from the edge into the two faces.
    fn depths(&self, p: DVec3) -> [f64; 2] {
        let mut found = Vec::new();
        self.tree.nearest(p, 1, &mut found);
        match found.first() {
            Some((index, _)) => {
                let frame = &self.frames[*index as usize];
                frame.into_face.map(|b| (p - frame.point).dot(b))
            }
            None => [0.0; 2],
        }
    }

    /// Whether arc length `s` lies between the ends of the edge, a rounding error apart.
    fn covers(&self, s: f64) -> bool {
        let length = 2.0 * self.half_step_mm * self.frames.len() as f64;
        (0.0..=length).contains(&s)
    }
}

/// What [`flanks`] works on.
pub(super) struct Scene<'a> {
    pub(super) cloud: &'a PointCloud,
    pub(super) places: &'a [Place],
    pub(super) edges: &'a [BodyEdge],
    pub(super) tracks: &'a [Track],
    /// How far from an edge its flanks are collected, mm, by edge.
    pub(super) radius_mm: &'a [f64],
    /// Indices of the points by face.
    pub(super) by_face: &'a [Vec<u32>],
}

/// The points of every face: for face f the indices of its points.
pub(super) fn by_face(places: &[Place], faces: usize) -> Vec<Vec<u32>> {
    let mut lists = vec![Vec::new(); faces];
    for (i, place) in places.iter().enumerate() {
        if place.face != NO_FACE {
            lists[place.face as usize].push(i as u32);
        }
    }
    lists
}

/// The points of the two flanks of every edge of `wanted`, in that order.
///
/// A point within the transition zone of another edge of its face, `cuts_mm[edge][side]` wide, is left out.
pub(super) fn flanks(
    scene: &Scene<'_>,
    wanted: &[usize],
    cuts_mm: &[[f64; 2]],
) -> Vec<[FlankPoints; 2]> {
    let mut sides_of_face: Vec<Vec<(usize, usize)>> = vec![Vec::new(); scene.by_face.len()];
    for (e, edge) in scene.edges.iter().enumerate() {
        for (side, face) in edge.faces.iter().enumerate() {
            sides_of_face[*face as usize].push((e, side));
        }
    }
    let needed = |face: usize| sides_of_face[face].iter().any(|(e, _)| wanted.contains(e));
    let tasks: Vec<(usize, &[u32])> = (0..scene.by_face.len())
        .filter(|face| needed(*face))
        .flat_map(|face| scene.by_face[face].chunks(BLOCK).map(move |c| (face, c)))
        .collect();
    let blocks: Vec<Vec<(usize, usize, FlankPoint)>> = tasks
        .par_iter()
        .map(|(face, block)| block_of(scene, &sides_of_face[*face], block, cuts_mm))
        .collect();
    let mut place_of = vec![usize::MAX; scene.edges.len()];
    for (k, e) in wanted.iter().enumerate() {
        place_of[*e] = k;
    }
    let mut lists: Vec<[Vec<FlankPoint>; 2]> = vec![[Vec::new(), Vec::new()]; wanted.len()];
    for (edge, side, point) in blocks.into_iter().flatten() {
        if place_of[edge] != usize::MAX {
            lists[place_of[edge]][side].push(point);
        }
    }
    lists
        .into_par_iter()
        .map(|pair| pair.map(FlankPoints::new))
        .collect()
}

fn block_of(
    scene: &Scene<'_>,
    sides: &[(usize, usize)],
    block: &[u32],
    cuts_mm: &[[f64; 2]],
) -> Vec<(usize, usize, FlankPoint)> {
    let mut found = Vec::new();
    let mut seen: Vec<(usize, usize, Seen)> = Vec::new();
    let mut out = Vec::new();
    for &i in block {
        let p = scene.cloud.positions[i as usize];
        seen.clear();
        for &(edge, side) in sides {
            let radius = scene.radius_mm[edge];
            if let Some(s) = scene.tracks[edge].seen(p, side, radius, &mut found) {
                seen.push((edge, side, s));
            }
        }
        for (k, (edge, side, own)) in seen.iter().enumerate() {
            let usable = own.r >= 0.0
                && own.distance <= scene.radius_mm[*edge]
                && scene.tracks[*edge].covers(own.s);
            let disturbed = || {
                let mut others = seen.iter().enumerate().filter(|(j, _)| *j != k);
                others.any(|(_, (e, s, other))| other.distance < cuts_mm[*e][*s])
            };
            if usable && !disturbed() {
                let deviation = scene.places[i as usize].deviation_mm;
                out.push((*edge, *side, (own.s, own.r, deviation, line_of(scene, i))));
            }
        }
    }
    out
}

/// The points within `radius_mm[edge]` of every edge, on either of its faces, in order of arc length: at most `limit` a stretch of
/// `stretch_mm[edge]`, evenly chosen.
pub(super) fn zones<B: Body>(
    scene: &Scene<'_>,
    body: &B,
    radius_mm: &[f64],
    stretch_mm: &[f64],
    limit: usize,
) -> Vec<Vec<ZonePoint>> {
    let nearby = |e: usize| -> Vec<(f64, u32, usize)> {
        let mut found = Vec::new();
        let mut near = Vec::new();
        if radius_mm[e] <= 0.0 {
            return near;
        }
        let [first, second] = scene.edges[e].faces;
        let sides = if first == second { 1 } else { 2 };
        for side in 0..sides {
            for &i in &scene.by_face[scene.edges[e].faces[side] as usize] {
                let p = scene.cloud.positions[i as usize];
                if let Some(seen) = scene.tracks[e].seen(p, side, radius_mm[e], &mut found)
                    && seen.distance <= radius_mm[e]
                    && scene.tracks[e].covers(seen.s)
                {
                    near.push((seen.s, i, side));
                }
            }
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near
    };
    let place = |e: usize, (s, i, side): (f64, u32, usize)| -> Option<ZonePoint> {
        let p = scene.cloud.positions[i as usize];
        let own = scene.places[i as usize].deviation_mm;
        let foot = body.foot(scene.edges[e].faces[1 - side], p, None)?;
        let other = (p - foot.point).dot(foot.normal);
        Some(ZonePoint {
            s,
            r: scene.tracks[e].depths(p),
            deviation: if side == 0 {
                [own, other]
            } else {
                [other, own]
            },
        })
    };
    (0..scene.edges.len())
        .into_par_iter()
        .map(|e| {
            let near = nearby(e);
            let stretch = |s: f64| (s / stretch_mm[e]) as usize;
            let mut points = Vec::new();
            for group in near.chunk_by(|a, b| stretch(a.0) == stretch(b.0)) {
                let step = group.len().div_ceil(limit).max(1);
                points.extend(
                    group
                        .iter()
                        .step_by(step)
                        .filter_map(|found| place(e, *found)),
                );
            }
            points
        })
        .collect()
}

/// The scan line of a point, one number for a profile of a view.
fn line_of(scene: &Scene<'_>, i: u32) -> u32 {
    match scene.cloud.origins.get(i as usize) {
        Some(origin) => (u32::from(origin.view) << 24 ^ origin.profile).min(NO_LINE - 1),
        None => NO_LINE,
    }
}
