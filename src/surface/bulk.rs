//! All points of a cloud at once.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::flank::Nearest;
use super::lines::{self, Sightings};
use super::robust::robust_normal;
use super::{
    LINE_SPACING, Meetings, Outcome, Place, Scale, Scratch, Settings, Surface, SurfaceError,
};
use crate::points::{Neighbors, PointCloud};

/// Points whose results are held at once, before they go to their places.
const BLOCK: usize = 16_384;

/// Points a worker takes at a time.
const GRAIN: usize = 256;

/// The same where flanks are told apart: each takes twenty times as long, and its result ten times the memory.
const SHARP_BLOCK: usize = 2_048;
const SHARP_GRAIN: usize = 32;

/// A cloud's points on its surface, in input order.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// N positions, mm; where `projected` is false, those of the input.
    pub positions: Vec<DVec3>,
    /// N unit normals, signs arbitrary; zero where `projected` is false. On an edge, that of one of the two flanks.
    pub normals: Vec<Vec3>,
    /// Whether a point was taken onto the surface, or left where it was.
    pub projected: Vec<bool>,
    /// Points whose place is on an edge or at a corner, ascending, with the normals of the other flanks.
    pub sharp: Vec<SharpPoint>,
    /// The feature lines and corners, sampled at `line_spacing_mm`.
    pub lines: Vec<LinePoint>,
    /// Distance of samples along a feature line, mm.
    pub line_spacing_mm: f64,
    /// The sizes that everything followed from.
    pub scale: Scale,
}

/// A point of the cloud that ended on an edge or at a corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharpPoint {
    /// Index of the point.
    pub index: u32,
    /// On an edge or at a corner.
    pub place: Place,
    /// Unit normals of the other flanks; at an edge both entries are equal.
    pub other_normals: [Vec3; 2],
}

/// A sample of a feature line, or a corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinePoint {
    /// The sample, mm.
    pub position: DVec3,
    /// Unit normals of the flanks that meet: two, or three at a corner; the rest repeat the last.
    pub normals: [Vec3; 3],
    /// On an edge or at a corner.
    pub place: Place,
}

/// Result for one point, until it goes to its place.
#[derive(Clone, Copy)]
struct Landed {
    index: u32,
    position: DVec3,
    normal: Vec3,
    /// As [`Surface`] keeps it.
    trust: u8,
    state: State,
}

#[derive(Clone, Copy, PartialEq)]
enum State {
    Smooth,
    Suspicious,
    Lost,
}

/// What the first pass hands to a reconstruction.
pub(super) struct Sink<'s> {
    positions: &'s mut [DVec3],
    projected: &'s mut [bool],
}

/// Takes every point of `cloud` onto the surface through it.
///
/// The result does not depend on the number of threads. Memory above the cloud and its neighbours: 38 bytes a point and what the feature
/// lines take; in scan lines also 90 for every supporting point.
///
/// # Errors
/// [`SurfaceError::TooFewPoints`].
pub fn reconstruct(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    settings: Settings,
) -> Result<Reconstruction, SurfaceError> {
    let mut surface = Surface::unprepared(cloud, neighbors, settings)?;
    let mut positions = cloud.positions.clone();
    let mut projected = vec![false; positions.len()];
    let line_spacing_mm = LINE_SPACING * surface.scale.spacing_mm;
    let mut features = Features {
        sharp: Vec::new(),
        lines: Sightings::new(line_spacing_mm),
    };
    let normals = if surface.scale.thinning_mm > 0.0 {
        prepare(&mut surface, None);
        let mut normals = vec![Vec3::ZERO; positions.len()];
        let all = neighbors.order();
        features.land(&surface, cloud, (all, true), |landed| {
            let index = landed.index as usize;
            normals[index] = landed.normal;
            positions[index] = landed.position;
            projected[index] = landed.state == State::Smooth;
        });
        normals
    } else {
        let sink = Sink {
            positions: &mut positions,
            projected: &mut projected,
        };
        let suspicious = prepare(&mut surface, Some(sink));
        // The first normals are looked at until the last point has landed.
        let mut later = Vec::with_capacity(suspicious.len());
        features.land(&surface, cloud, (&suspicious, false), |landed| {
            let index = landed.index as usize;
            positions[index] = landed.position;
            projected[index] = landed.state == State::Smooth;
            later.push(landed.normal);
        });
        let mut normals = std::mem::take(&mut surface.normals);
        for (&index, normal) in suspicious.iter().zip(later) {
            normals[index as usize] = normal;
        }
        normals
    };
    let scale = surface.scale;
    drop(surface);
    features.sharp.sort_unstable_by_key(|s| s.index);
    Ok(Reconstruction {
        positions,
        normals,
        projected,
        sharp: features.sharp,
        lines: lines::agree(features.lines),
        line_spacing_mm,
        scale,
    })
}

/// First normals and trust of all supporting points: where the surroundings are smooth the surface's own, elsewhere those of a plane
/// that neighbouring flanks do not tilt. Returns the indices of the latter, neighbours together; the positions of the former go to `sink`.
pub(super) fn prepare(surface: &mut Surface, mut sink: Option<Sink>) -> Vec<u32> {
    let mut normals = std::mem::take(&mut surface.normals);
    let mut trust = std::mem::take(&mut surface.trust);
    let mut suspicious = Vec::new();
    for block in surface.neighbors.get().order().chunks(BLOCK) {
        let look = |index, scratch: &mut Scratch| surface.first_look(index, scratch);
        for point in in_parallel(block, GRAIN, look).into_iter().flatten() {
            let index = point.index as usize;
            normals[index] = point.normal;
            trust[index] = point.trust;
            if point.state == State::Suspicious {
                suspicious.push(point.index);
            } else if let Some(sink) = &mut sink {
                sink.positions[index] = point.position;
                sink.projected[index] = true;
            }
        }
    }
    surface.normals = normals;
    surface.trust = trust;
    suspicious
}

/// Results of `work` for a block of points, in parts of `grain`.
fn in_parallel<T: Send>(
    block: &[u32],
    grain: usize,
    work: impl Fn(u32, &mut Scratch) -> T + Sync,
) -> Vec<Vec<T>> {
    block
        .par_chunks(grain)
        .map_init(Scratch::default, |scratch, part| {
            part.iter().map(|&index| work(index, scratch)).collect()
        })
        .collect()
}

impl Surface<'_> {
    fn first_look(&self, index: u32, scratch: &mut Scratch) -> Landed {
        let p = self.positions[index as usize];
        self.gather_places(p, self.scale.points, scratch);
        if let Some(outcome) = self.smooth_outcome(scratch) {
            return Landed {
                index,
                position: p + outcome.nearest.position,
                normal: outcome.nearest.normals[0].as_vec3(),
                trust: u8::MAX,
                state: State::Smooth,
            };
        }
        let near = scratch.hood.points.len().min(self.scale.points_near());
        // Where scan lines lie far apart the nearest points are all on one of them: then all have their say.
        let found = robust_normal(&scratch.hood.points[..near], &self.scale)
            .filter(|(_, trust)| *trust > 0.25)
            .or_else(|| robust_normal(&scratch.hood.points, &self.scale));
        let (normal, trust) = found.map_or((Vec3::Z, 0), |(n, t)| (n.as_vec3(), (t * 255.0) as u8));
        Landed {
            index,
            position: p,
            normal,
            trust,
            state: State::Suspicious,
        }
    }

    /// Longest way a point of the cloud itself may go, mm: beyond it, it is an outlier and stays.
    fn longest_way_mm(&self) -> f64 {
        6.0 * self.scale.noise_mm + 0.5 * self.scale.spacing_mm
    }
}

/// Edges and corners met on the way.
struct Features {
    sharp: Vec<SharpPoint>,
    lines: Sightings,
}

impl Features {
    fn land(
        &mut self,
        surface: &Surface,
        cloud: &PointCloud,
        (indices, try_smooth): (&[u32], bool),
        mut put: impl FnMut(Landed),
    ) {
        for block in indices.chunks(SHARP_BLOCK) {
            let landed = in_parallel(block, SHARP_GRAIN, |index, scratch| {
                land_one(
                    surface,
                    cloud.positions[index as usize],
                    try_smooth,
                    scratch,
                )
            });
            for (&index, (nearest, meetings)) in block.iter().zip(landed.into_iter().flatten()) {
                let p = cloud.positions[index as usize];
                for met in meetings.iter().flatten() {
                    let distance = met.position.length() / surface.scale.spacing_mm;
                    self.lines.add(line_point(p, met), distance);
                }
                let Some(nearest) = nearest else {
                    put(Landed {
                        index,
                        position: p,
                        normal: Vec3::ZERO,
                        trust: 0,
                        state: State::Lost,
                    });
                    continue;
                };
                if nearest.sheets > 1 {
                    self.sharp.push(SharpPoint {
                        index,
                        place: place(nearest.sheets),
                        other_normals: [nearest.normals[1].as_vec3(), nearest.normals[2].as_vec3()],
                    });
                }
                put(Landed {
                    index,
                    position: p + nearest.position,
                    normal: nearest.normals[0].as_vec3(),
                    trust: u8::MAX,
                    state: State::Smooth,
                });
            }
        }
    }
}

fn place(sheets: usize) -> Place {
    match sheets {
        1 => Place::Face,
        2 => Place::Edge,
        _ => Place::Corner,
    }
}

fn line_point(p: DVec3, nearest: &Nearest) -> LinePoint {
    LinePoint {
        position: p + nearest.position,
        normals: nearest.normals.map(|n| n.as_vec3()),
        place: place(nearest.sheets),
    }
}

fn land_one(
    surface: &Surface,
    p: DVec3,
    try_smooth: bool,
    scratch: &mut Scratch,
) -> (Option<Nearest>, Meetings) {
    let outcome = if try_smooth {
        surface.outcome(p, scratch)
    } else {
        surface.gather(p, surface.scale.points_wide(), scratch);
        surface.sharp_outcome(scratch)
    };
    let longest = surface.longest_way_mm();
    let fits = |outcome: &Outcome| outcome.nearest.position.length() <= longest;
    // On a face that the rays graze the scan lines lie several times farther apart than elsewhere: then a wider look helps.
    let outcome = outcome.filter(fits).or_else(|| {
        surface.gather(p, 3 * surface.scale.points_wide(), scratch);
        surface.sharp_outcome(scratch).filter(fits)
    });
    let Some(outcome) = outcome else {
        return (None, Meetings::default());
    };
    // Lines are sampled from as far as the flanks' own points reach beyond doubt.
    let near = longest + 1.5 * surface.scale.spacing_mm;
    let meetings = outcome
        .meetings
        .map(|m| m.filter(|m| m.position.length() < near));
    (Some(outcome.nearest), meetings)
}
