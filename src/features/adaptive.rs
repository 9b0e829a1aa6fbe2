//! The detector as users get it.
//!
//! Weber's idea is kept: near a sharp edge the Gauss map of a neighbourhood falls into clusters (Weber 2011, §3.4). We differ:
//!
//! - Clusters are surfaces, planes or quadrics, fitted to the points, not bundles of triangle normals, which noise spreads over the whole
//!   sphere (§3.7.5). How many there are is settled by Bayes' criterion with the noise measured, not by a linkage distance.
//! - The flatness test rejects what is a plane within noise and whose normals do not turn from neighbour to neighbour by more than chance.
//! - An edge is where two surfaces meet between the points, not a point: no point need lie on it, and what is marked is what lies within
//!   about one spacing.
//! - A crease turns at once, a curved surface over a length. Every neighbourhood's answer is therefore checked in the smallest one that could
//!   tell (see `flanks`), against a quadric, a surface of fourth degree and a cone; what is open is looked at with more points.
//! - In scan lines all this is done on places picked out of them as densely along as across; where the lattice is known, depth jumps are
//!   borders and mixed points bear no witness.
//! - An edge counts when the neighbours that ought to see it do, so that no point is marked for what it alone has seen. The thesis thins
//!   its candidates to a share of each neighbourhood instead (§3.6).

use glam::DVec3;
use rayon::prelude::*;

use super::Class;
use super::cone::Cone;
use super::flanks::{Crease, LEAST_TURN, Verdict, Workshop};
use super::patch::Plane;
use super::tangent::{Tangents, drop_ties};
use crate::points::Neighbors;

/// Points looked at around a candidate, one level after the other as long as the answer is open.
const LEVELS: [usize; 3] = [40, 100, 220];
/// Flanks are allowed to depart from a quadric by this many spacings beside the noise: in squares, what a crease of the least turn leaves
/// of its best quadric in the smallest neighbourhood (0.071 times 3.57 spacings times tan 3 degrees, 0.013), and what a cylinder of five
/// spacings' radius leaves of it there (0.012).
const MODEL_ERROR: f64 = 0.018;
/// A point is marked when the edge passes within this many spacings, less the standard deviation of its place: the spacing itself is known
/// to some four percent, and what lies a whole one away in a regular grid is the next row.
pub(super) const THIN: f64 = 0.93;
/// Farthest tip of a cone, in spacings, of which a place bears witness.
const TIP_REACH: f64 = 4.0;
/// Largest turn, rad (20 degrees), of a crease that may be but the first step of a curved surface.
const FAINT: f64 = 0.35;
/// Standard deviations of a neighbourhood's bend from which on it is a candidate.
const SURE: f64 = 3.0;
/// Witnesses in turn taken as reference for all.
const REFERENCES: usize = 8;
/// Farthest foot, in spacings, of an edge that may cross another at a place; an edge of five spacings' radius turns by 28 degrees from one
/// such foot to the other.
const CROSSING_REACH: f64 = 1.2;
/// Cosine of the angle, 37 degrees, from which on two edges cross.
const PARALLEL: f64 = 0.8;
/// Share of the neighbours that must see an edge for it to be believed.
const AGREEMENT: f64 = 0.45;

/// What the detector works on: distinct places in Morton order.
pub(super) struct Places<'a> {
    /// Coordinates by rank, mm.
    pub positions: Vec<DVec3>,
    /// Ranks them in the same order.
    pub neighbors: &'a Neighbors,
    /// Spacing, mm.
    pub spacing_mm: f64,
    /// Noise, mm.
    pub noise_mm: f64,
    /// A point is marked when the edge passes nearer than this, mm; for places of the cloud's spacing.
    pub thin_mm: f64,
}

/// The edge near a place, relative to it, mm.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    pub foot: DVec3,
    pub tangent: DVec3,
    pub sd_mm: f64,
    pub corner: Option<DVec3>,
}

/// What is seen from a place.
pub(super) enum Seen {
    /// An edge.
    Edge(Sight),
    /// The tip of a cone, at these coordinates, mm.
    Tip(DVec3),
}

/// An edge that several neighbourhoods agree upon, as seen from one place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Agreed {
    /// From the place to the edge, as a share of the distance at which it is marked.
    pub distance: f64,
    /// The same for the corner.
    pub corner_distance: Option<f64>,
}

impl Agreed {
    /// The class of the place.
    pub fn class(&self) -> Class {
        if self.distance >= 1.0 {
            Class::None
        } else if self.corner_distance.is_some_and(|d| d < 1.0) {
            Class::Corner
        } else {
            Class::Edge
        }
    }
}

impl Places<'_> {
    /// Noise variance in squares of `unit_mm`, with what a flank may depart from its model.
    fn variance(&self, unit_mm: f64) -> f64 {
        (self.noise_mm / unit_mm).powi(2) + MODEL_ERROR * MODEL_ERROR
    }

    /// The unit of length at a place: the cloud's spacing, or the local one where that is very different.
    pub fn unit_mm(&self, reach_mm: f64, count: usize) -> f64 {
        let local = reach_mm * (std::f64::consts::PI / (count.max(2) - 1) as f64).sqrt();
        if local > 1.7 * self.spacing_mm || local < 0.6 * self.spacing_mm {
            local
        } else {
            self.spacing_mm
        }
    }

    /// Whether the neighbourhood departs from its plane by no more than noise does.
    fn is_flat(&self, tangents: &Tangents, rank: usize) -> bool {
        let plane = &tangents.planes[rank];
        let n = f64::from(plane.count);
        let unit = self.unit_mm(f64::from(plane.reach_mm), plane.count as usize);
        let seen = f64::from(plane.variance_mm2) / (unit * unit);
        let freedom = n - 3.0;
        seen * n <= self.variance(unit) * (freedom + 3.0 * (2.0 * freedom).sqrt())
    }

    /// Flatness test: whether an edge may be near, because the neighbourhood is no plane, or because planes in it change their
    /// direction.
    pub fn is_candidate(&self, tangents: &Tangents, rank: usize) -> bool {
        let plane = &tangents.planes[rank];
        if plane.count < 8 {
            return false;
        }
        if !self.is_flat(tangents, rank) {
            return true;
        }
        // A normal over n points within radius r is good to 2 sigma / (r sqrt n) about either axis, and of the normals within such a
        // neighbourhood about four are independent. Where a neighbour's plane is none, a sharp edge is near that one, not this.
        let flat = |j: usize| self.is_flat(tangents, j);
        let Some((bend, spread)) = tangents.curvature(&self.positions, rank, flat) else {
            return false;
        };
        let unit = self.unit_mm(f64::from(plane.reach_mm), plane.count as usize);
        let reach = f64::from(plane.reach_mm) / unit;
        let sd = (self.variance(unit) / spread).sqrt() * unit / reach;
        bend * unit > SURE * sd && bend * unit * 2.0 * reach > LEAST_TURN
    }

    /// What is seen from the candidate `rank`, by growing its neighbourhood until the answer is clear.
    pub fn look(&self, tangents: &Tangents, rank: usize, shop: &mut Bench) -> Option<Seen> {
        let p = self.positions[rank];
        // What is flat within noise hides only what more points than that show.
        shop.flanks.was_smooth = self.is_flat(tangents, rank);
        for level in &LEVELS[usize::from(shop.flanks.was_smooth)..] {
            self.neighbors.nearest_places(p, *level, &mut shop.found);
            drop_ties(&mut shop.found);
            let reach = shop.found.last().map_or(0.0, |f| f.1.sqrt());
            let unit = self.unit_mm(reach, shop.found.len());
            self.fill(tangents, p, unit, shop);
            let variance = self.variance(unit);
            match shop.flanks.analyse(variance) {
                Verdict::Smooth => return None,
                Verdict::Creased(crease) => {
                    let flanks = &shop.flanks;
                    let cone = Cone::through(&flanks.points, &flanks.seeds, variance);
                    if let Some((cone, criterion)) = cone
                        && criterion < crease.criterion
                    {
                        let near = cone.tip.length() < TIP_REACH;
                        return near.then(|| Seen::Tip(p + cone.tip * unit));
                    }
                    let stays = !self.goes_on(tangents, (p, unit), &crease, shop);
                    return stays.then(|| Seen::Edge(in_mm(crease, unit)));
                }
                Verdict::Unsure => {}
            }
        }
        None
    }

    /// Whether a faint crease is but the first step of a surface that goes on turning: where a fillet, or the facets of one, begins.
    ///
    /// The tangent planes from three to six spacings beside the crease have turned farther from the flank than the crease turns.
    fn goes_on(
        &self,
        tangents: &Tangents,
        (p, unit): (DVec3, f64),
        crease: &Crease,
        shop: &mut Bench,
    ) -> bool {
        if crease.turn > FAINT {
            return false;
        }
        self.neighbors.nearest_places(p, LEVELS[1], &mut shop.found);
        let inward = (crease.into[0] - crease.into[1]).normalize_or_zero();
        (0..2).any(|side| {
            let flank = crease.into[side].cross(crease.tangent);
            let mut turns = [0f64; LEVELS[1]];
            let mut count = 0;
            for (rank, _) in &shop.found {
                let d = (self.positions[*rank as usize] - p) / unit - crease.foot;
                let across = d.dot(inward) * [1.0, -1.0][side];
                if d.dot(crease.tangent).abs() < 2.0 && (3.0..6.0).contains(&across) {
                    let normal = tangents.planes[*rank as usize].normal();
                    turns[count] = normal.dot(flank).abs().min(1.0).acos();
                    count += 1;
                }
            }
            let turns = &mut turns[..count];
            count >= 5 && *turns.select_nth_unstable_by(count / 2, f64::total_cmp).1 > crease.turn
        })
    }

    /// Puts the neighbourhood and the best tangent planes in it on the bench.
    fn fill(&self, tangents: &Tangents, p: DVec3, unit: f64, shop: &mut Bench) {
        const APART: f64 = 1.3;
        const SEEDS: usize = 8;
        let points = &mut shop.flanks.points;
        points.clear();
        points.extend(
            shop.found
                .iter()
                .map(|(r, _)| (self.positions[*r as usize] - p) / unit),
        );
        shop.ranked.clear();
        shop.ranked.extend(
            shop.found
                .iter()
                .enumerate()
                .map(|(i, (r, _))| (tangents.planes[*r as usize].variance_mm2, i as u32)),
        );
        shop.ranked
            .sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        shop.taken.clear();
        shop.flanks.seeds.clear();
        let reach = points[points.len() - 1].length().max(3.0);
        let apart = APART * reach / 3.57;
        for (_, i) in &shop.ranked {
            let at = shop.flanks.points[*i as usize];
            if shop
                .taken
                .iter()
                .all(|t: &DVec3| t.distance_squared(at) > apart * apart)
            {
                shop.taken.push(at);
                let plane = &tangents.planes[shop.found[*i as usize].0 as usize];
                let normal = plane.normal();
                shop.flanks.seeds.push(Plane {
                    normal,
                    offset: normal.dot(at) - f64::from(plane.height_mm) / unit,
                });
                if shop.taken.len() == SEEDS {
                    break;
                }
            }
        }
    }

    /// The edge near `p` that the places `around` it agree upon; `unit` is the spacing there, mm.
    pub fn agree(
        &self,
        sights: &Sights,
        p: DVec3,
        (around, unit): (&[u32], f64),
    ) -> Option<Agreed> {
        let mut witnesses = [Witness::default(); super::tangent::NEAR];
        let mut seeing = 0;
        for (witness, j) in witnesses.iter_mut().zip(around) {
            let at = (self.positions[*j as usize] - p) / unit;
            let sight = sights.at(*j as usize).map(|s| (at + s.foot / unit, *s));
            seeing += usize::from(sight.is_some());
            *witness = Witness { at, sight };
        }
        if seeing < 3 {
            return None;
        }
        let thin = self.thin_mm / self.spacing_mm;
        let witnesses = &witnesses[..around.len()];
        let mut best: Option<Agreed> = None;
        let (mut passing, mut passes) = ([DVec3::ZERO; REFERENCES], 0);
        let mut crossing: Option<f64> = None;
        for (foot, sight) in witnesses.iter().filter_map(|w| w.sight).take(REFERENCES) {
            let (share, at) = fit_feet(witnesses, (foot, sight.tangent), unit);
            let distance = at.length() / (thin - (sight.sd_mm / unit).min(0.2));
            // An edge that ends at a corner is seen from one side of it only.
            if share >= 0.6 * AGREEMENT && distance < 1.0 && foot.length() < CROSSING_REACH {
                let others = &passing[..passes];
                if others.iter().any(|t| t.dot(sight.tangent).abs() < PARALLEL) {
                    crossing = Some(crossing.map_or(distance, |c| c.min(distance)));
                }
                passing[passes] = sight.tangent;
                passes += 1;
            }
            if share >= AGREEMENT && best.is_none_or(|b| distance < b.distance) {
                best = Some(Agreed {
                    distance,
                    corner_distance: None,
                });
            }
        }
        let mut agreed = best?;
        let seen = self.corner(around, sights, (p, unit)).map(|d| d / thin);
        agreed.corner_distance = seen.or(crossing);
        Some(agreed)
    }

    fn corner(&self, around: &[u32], sights: &Sights, (p, unit): (DVec3, f64)) -> Option<f64> {
        let corners = around.iter().filter_map(|j| {
            let c = sights.at(*j as usize)?.corner?;
            Some((self.positions[*j as usize] + c - p) / unit)
        });
        let (mut sum, mut n) = (DVec3::ZERO, 0);
        let nearest =
            corners.clone().fold(
                DVec3::INFINITY,
                |a, b| if b.length() < a.length() { b } else { a },
            );
        for c in corners.filter(|c| c.distance_squared(nearest) < 1.5) {
            sum += c;
            n += 1;
        }
        (n >= 4).then(|| (sum / f64::from(n)).length())
    }
}

/// A neighbour and the edge it sees, both relative to the place in question, in spacings; the sight itself in mm.
#[derive(Clone, Copy, Default)]
struct Witness {
    at: DVec3,
    sight: Option<(DVec3, Sight)>,
}

/// The share of the witnesses who see the reference edge among those near enough to it, and where it passes: quadratic in the way along
/// the tangent.
fn fit_feet(witnesses: &[Witness], (foot, tangent): (DVec3, DVec3), unit: f64) -> (f64, DVec3) {
    const NEAR: f64 = 1.8;
    let mut a = [[0.0; 3]; 3];
    let mut b = [DVec3::ZERO; 3];
    let (mut votes, mut expected) = (0u32, 0u32);
    for witness in witnesses {
        let to_edge = witness.at - foot;
        let across = to_edge - tangent * to_edge.dot(tangent);
        let near = across.length_squared() < NEAR * NEAR;
        expected += u32::from(near);
        let Some((f, s)) = witness.sight else {
            continue;
        };
        let d = f - foot;
        let off = d - tangent * d.dot(tangent);
        if s.tangent.dot(tangent).abs() < 0.8 || off.length_squared() > 1.0 {
            continue;
        }
        votes += u32::from(near);
        let x = f.dot(tangent);
        let sd = s.sd_mm / unit;
        let w = (-0.25 * x * x).exp() / (sd * sd + 0.05 * 0.05);
        let row = [1.0, x, x * x];
        for i in 0..3 {
            b[i] += (f - tangent * x) * (w * row[i]);
            for j in 0..3 {
                a[i][j] += w * row[i] * row[j];
            }
        }
    }
    let share = if votes < 3 {
        0.0
    } else {
        f64::from(votes) / f64::from(expected)
    };
    // Bending is held back a little, so that few feet give a straight line.
    a[1][1] += 0.02 * a[0][0];
    a[2][2] += 0.1 * a[0][0];
    let m = glam::DMat3::from_cols_array_2d(&a);
    if m.determinant() <= 1e-12 * a[0][0].powi(3) {
        return (share, b[0] / a[0][0]);
    }
    let first = m.inverse().row(0);
    (share, b[0] * first.x + b[1] * first.y + b[2] * first.z)
}

/// What each candidate sees.
pub(super) struct Sights {
    /// Index into `seen` by rank, or `u32::MAX`.
    index: Vec<u32>,
    seen: Vec<Sight>,
    /// Tips of cones that several places see, mm.
    pub tips: Vec<DVec3>,
}

/// The means of those `tips` (mm) that lie together.
fn agreed_tips(tips: &[DVec3], spacing_mm: f64) -> Vec<DVec3> {
    const WITNESSES: usize = 4;
    let neighbors = Neighbors::new(tips);
    let mut taken = vec![false; tips.len()];
    let mut agreed = Vec::new();
    let mut found = Vec::new();
    for &i in neighbors.order() {
        if taken[i as usize] {
            continue;
        }
        neighbors.within(tips[i as usize], spacing_mm, &mut found);
        found.retain(|f| !taken[f.0 as usize]);
        if found.len() < WITNESSES {
            continue;
        }
        let sum: DVec3 = found.iter().map(|f| tips[f.0 as usize]).sum();
        found.iter().for_each(|f| taken[f.0 as usize] = true);
        agreed.push(sum / found.len() as f64);
    }
    agreed
}

impl Sights {
    pub fn new(places: &Places, tangents: &Tangents) -> Self {
        let all: Vec<(u32, Seen)> = (0..places.positions.len())
            .into_par_iter()
            .map_init(Bench::default, |bench, rank| {
                if !places.is_candidate(tangents, rank) {
                    return None;
                }
                places.look(tangents, rank, bench).map(|s| (rank as u32, s))
            })
            .flatten_iter()
            .collect();
        let mut index = vec![u32::MAX; places.positions.len()];
        let mut seen = Vec::with_capacity(all.len());
        let mut tips = Vec::new();
        for (rank, sight) in all {
            match sight {
                Seen::Edge(sight) => {
                    index[rank as usize] = seen.len() as u32;
                    seen.push(sight);
                }
                Seen::Tip(tip) => tips.push(tip),
            }
        }
        Self {
            index,
            seen,
            tips: agreed_tips(&tips, places.spacing_mm),
        }
    }

    pub fn at(&self, rank: usize) -> Option<&Sight> {
        self.seen.get(self.index[rank] as usize)
    }
}

/// Working memory of one thread.
#[derive(Default)]
pub(super) struct Bench {
    found: Vec<(u32, f64)>,
    ranked: Vec<(f32, u32)>,
    taken: Vec<DVec3>,
    flanks: Workshop,
}

fn in_mm(crease: Crease, unit: f64) -> Sight {
    Sight {
        foot: crease.foot * unit,
        tangent: crease.tangent,
        sd_mm: crease.sd * unit,
        corner: crease.corner.map(|c| c * unit),
    }
}
