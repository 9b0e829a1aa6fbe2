//! The points of every flank, in the coordinates of its edge.

use glam::DVec3;
use rayon::prelude::*;

use super::assign::{NO_FACE, Place};
use super::body::{Body, BodyEdge};
use super::edge_break::ZonePoint;
use super::flank::{FlankPoint, FlankPoints, NO_LINE, Windows};
use crate::nominal::Station;
use crate::points::neighbors::Neighbors;
use crate::points::{Origin, PointCloud};

/// Points that one task looks at.
const BLOCK: usize = 8192;

/// Departure from a line, over the length, below which an edge is straight: rounding.
const STRAIGHT: f64 = 1e-10;

/// An edge with frames along it, close enough together that the nearest one gives the coordinates of a point.
pub(super) struct Track {
    frames: Vec<Station>,
    /// Finds the nearest frame; none along a straight edge, where a projection does.
    tree: Option<Neighbors>,
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
        let straight = frames.iter().all(|f| {
            let expected = frames[0].point + (f.s_mm - frames[0].s_mm) * frames[0].tangent;
            f.point.distance(expected) <= STRAIGHT * edge.length_mm
        });
        Self {
            tree: (!straight).then(|| Neighbors::new(&points)),
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
        let frame = self.nearest(p, found)?;
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
        match self.nearest(p, &mut Vec::new()) {
            Some(frame) => frame.into_face.map(|b| (p - frame.point).dot(b)),
            None => [0.0; 2],
        }
    }

    /// The frame nearest to `p`; `found` is scratch.
    fn nearest(&self, p: DVec3, found: &mut Vec<(u32, f64)>) -> Option<&Station> {
        let Some(tree) = &self.tree else {
            let first = self.frames.first()?;
            let along = (p - first.point).dot(first.tangent) / (2.0 * self.half_step_mm);
            let last = (self.frames.len() - 1) as f64;
            return self.frames.get(along.round().clamp(0.0, last) as usize);
        };
        tree.nearest(p, 1, found);
        self.frames.get(found.first()?.0 as usize)
    }

    /// Whether arc length `s` lies between the ends of the edge, a rounding error apart.
    fn covers(&self, s: f64) -> bool {
        let length = 2.0 * self.half_step_mm * self.frames.len() as f64;
        (0.0..=length).contains(&s)
    }
}

/// The tracks of all edges, and which of them border a face.
pub(super) struct Tracks {
    tracks: Vec<Track>,
    /// By face: (edge, side).
    of_face: Vec<Vec<(usize, usize)>>,
}

impl Tracks {
    pub(super) fn new<B: Body>(body: &B, edges: &[BodyEdge], windows: &[Windows]) -> Self {
        let mut of_face: Vec<Vec<(usize, usize)>> = vec![Vec::new(); body.face_count()];
        for (e, edge) in edges.iter().enumerate() {
            for (side, face) in edge.faces.iter().enumerate() {
                of_face[*face as usize].push((e, side));
            }
        }
        let track = |e: usize| Track::new(body, e, &edges[e], &windows[e]);
        Self {
            tracks: (0..edges.len()).into_par_iter().map(track).collect(),
            of_face,
        }
    }
}

/// A point as seen from an edge in whose reach it lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    /// Index of the point in its layer.
    point: u32,
    edge: u32,
    /// Which of the edge's faces the point is on.
    side: u8,
    /// Whether it lies beside the edge, not beyond an end of it.
    beside: bool,
    line: u32,
    s: f64,
    r: f64,
    /// Distance from the edge, mm.
    distance: f64,
    /// From the face, mm.
    deviation: f64,
}

/// Aligned points with what is known of each.
pub(super) struct Layer<'a> {
    /// In the part frame, mm.
    pub(super) positions: &'a [DVec3],
    pub(super) origins: &'a [Origin],
    pub(super) places: &'a [Place],
}

impl Sight {
    pub(super) fn edge(&self) -> usize {
        self.edge as usize
    }
}

impl<'a> Layer<'a> {
    pub(super) fn new(cloud: &'a PointCloud, places: &'a [Place]) -> Self {
        Self {
            positions: &cloud.positions,
            origins: &cloud.origins,
            places,
        }
    }

    /// How the points are seen from every edge within `radius_mm[edge]` of them: a point after the other.
    pub(super) fn sights(&self, tracks: &Tracks, radius_mm: &[f64]) -> Vec<Sight> {
        let block = |first: usize| {
            let last = (first + BLOCK).min(self.places.len());
            let (mut found, mut sights) = (Vec::new(), Vec::new());
            for i in first..last {
                let place = &self.places[i];
                if place.face == NO_FACE {
                    continue;
                }
                let p = self.positions[i];
                for &(edge, side) in &tracks.of_face[place.face as usize] {
                    let track = &tracks.tracks[edge];
                    let radius = radius_mm[edge];
                    let Some(seen) = track.seen(p, side, radius, &mut found) else {
                        continue;
                    };
                    if seen.distance > radius {
                        continue;
                    }
                    sights.push(Sight {
                        point: i as u32,
                        edge: edge as u32,
                        side: side as u8,
                        beside: track.covers(seen.s),
                        line: self.line(i),
                        s: seen.s,
                        r: seen.r,
                        distance: seen.distance,
                        deviation: place.deviation_mm,
                    });
                }
            }
            sights
        };
        let firsts: Vec<usize> = (0..self.places.len()).step_by(BLOCK).collect();
        let blocks: Vec<Vec<Sight>> = firsts.into_par_iter().map(block).collect();
        blocks.concat()
    }

    /// The scan line of a point, one number for a profile of a view.
    fn line(&self, i: usize) -> u32 {
        match self.origins.get(i) {
            Some(origin) => (u32::from(origin.view) << 24 ^ origin.profile).min(NO_LINE - 1),
            None => NO_LINE,
        }
    }
}

/// The points of the two flanks of every edge of `wanted`, in that order, within `radius_mm[edge]`, from the sights of all layers.
///
/// A point within the transition zone of another edge of its face, `cuts_mm[edge][side]` wide, is left out.
pub(super) fn flanks(
    layers: &[&[Sight]],
    wanted: &[usize],
    cuts_mm: &[[f64; 2]],
    radius_mm: &[f64],
) -> Vec<[FlankPoints; 2]> {
    let mut place_of = vec![usize::MAX; cuts_mm.len()];
    for (k, e) in wanted.iter().enumerate() {
        place_of[*e] = k;
    }
    let usable_of = |layer: &&[Sight]| {
        let mut out: Vec<(usize, usize, FlankPoint)> = Vec::new();
        for seen in layer.chunk_by(|a, b| a.point == b.point) {
            for (k, own) in seen.iter().enumerate() {
                let place = place_of[own.edge as usize];
                let within = own.distance <= radius_mm[own.edge as usize];
                if place == usize::MAX || own.r < 0.0 || !own.beside || !within {
                    continue;
                }
                let disturbed = seen.iter().enumerate().any(|(j, other)| {
                    j != k && other.distance < cuts_mm[other.edge as usize][other.side as usize]
                });
                if !disturbed {
                    let point = (own.s, own.r, own.deviation, own.line);
                    out.push((place, own.side as usize, point));
                }
            }
        }
        out
    };
    let pieces: Vec<&[Sight]> = layers.iter().flat_map(|layer| split(layer)).collect();
    let found: Vec<Vec<(usize, usize, FlankPoint)>> = pieces.par_iter().map(usable_of).collect();
    let mut lists: Vec<[Vec<FlankPoint>; 2]> = vec![[Vec::new(), Vec::new()]; wanted.len()];
    for (edge, side, point) in found.into_iter().flatten() {
        lists[edge][side].push(point);
    }
    lists
        .into_par_iter()
        .map(|pair| pair.map(FlankPoints::new))
        .collect()
}

/// Pieces of about a block, none of which ends in the middle of a point.
fn split(mut layer: &[Sight]) -> Vec<&[Sight]> {
    let mut pieces = Vec::new();
    while layer.len() > BLOCK {
        let point = layer[BLOCK].point;
        let at = layer.partition_point(|sight| sight.point < point);
        if at == 0 {
            break;
        }
        let (piece, rest) = layer.split_at(at);
        pieces.push(piece);
        layer = rest;
    }
    pieces.push(layer);
    pieces
}

/// A point near an edge: (arc length, layer, point, side).
pub(super) type Near = (f64, u32, u32, u8);

/// The points within `radius_mm[edge]` of every edge, on either of its faces, in order of arc length: at most `limit` a stretch of
/// `stretch_mm[edge]`, evenly chosen.
pub(super) fn near(
    layers: &[&[Sight]],
    edges: &[BodyEdge],
    radius_mm: &[f64],
    stretch_mm: &[f64],
    limit: usize,
) -> Vec<Vec<Near>> {
    let near_of = |(index, layer): (usize, &&[Sight])| {
        let is_near = |sight: &&Sight| {
            let edge = sight.edge as usize;
            // Of an edge between a face and itself both sides see every point.
            let [first, second] = edges[edge].faces;
            let once = first != second || sight.side == 0;
            sight.distance <= radius_mm[edge] && sight.beside && once
        };
        let name = |sight: &Sight| {
            let near = (sight.s, index as u32, sight.point, sight.side);
            (sight.edge as usize, near)
        };
        layer.iter().filter(is_near).map(name).collect::<Vec<_>>()
    };
    let found: Vec<Vec<(usize, Near)>> = layers.par_iter().enumerate().map(near_of).collect();
    let mut lists: Vec<Vec<Near>> = vec![Vec::new(); edges.len()];
    for (edge, near) in found.into_iter().flatten() {
        lists[edge].push(near);
    }
    lists
        .into_par_iter()
        .zip(stretch_mm)
        .map(|(mut list, stretch_mm)| {
            list.sort_by(|a, b| {
                a.0.total_cmp(&b.0)
                    .then((a.1, a.2, a.3).cmp(&(b.1, b.2, b.3)))
            });
            let stretch = |near: &Near| (near.0 / stretch_mm) as usize;
            let groups = list.chunk_by(|a, b| stretch(a) == stretch(b));
            groups
                .flat_map(|group| {
                    let step = group.len().div_ceil(limit).max(1);
                    group.iter().step_by(step).copied()
                })
                .collect()
        })
        .collect()
}

/// A point near edge `e` in the coordinates of its section; `None` where it has no foot on the other face.
pub(super) fn zone_point<B: Body>(
    body: &B,
    tracks: &Tracks,
    (e, edge): (usize, &BodyEdge),
    layers: &[Layer<'_>],
    (s, layer, point, side): Near,
) -> Option<ZonePoint> {
    let (layer, side) = (&layers[layer as usize], side as usize);
    let p = layer.positions[point as usize];
    let own = layer.places[point as usize].deviation_mm;
    let foot = body.foot(edge.faces[1 - side], p, None)?;
    let other = (p - foot.point).dot(foot.normal);
    Some(ZonePoint {
        s,
        r: tracks.tracks[e].depths(p),
        deviation: if side == 0 {
            [own, other]
        } else {
            [other, own]
        },
    })
}
