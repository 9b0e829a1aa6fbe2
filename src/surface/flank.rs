//! The flanks around a point: which of its neighbours lie on which smooth piece of the surface, and where the pieces meet.

use glam::{DMat3, DVec3};

use super::levin::{Foot, LocalSurface, Smoothing, fit, gaussian, weighted_normal};
use super::polynomial::{Degree, Equations, LocalFrame};
use super::scale::Scale;

/// More flanks than this around one point are not told apart.
pub(crate) const FLANKS_MAX: usize = 6;

/// Label of a neighbour on no flank.
const NONE: u8 = u8::MAX;

/// The supporting points around a query, relative to it, nearest first.
#[derive(Debug, Default)]
pub(crate) struct Neighborhood {
    pub points: Vec<DVec3>,
    /// Unit normals of the neighbours, signs arbitrary.
    pub normals: Vec<DVec3>,
    /// How much of a neighbour's own surroundings lies on its tangent plane, 0 to 1.
    pub trust: Vec<f64>,
    labels: Vec<u8>,
    members: Vec<DVec3>,
}

/// One smooth piece of the surface near the query.
#[derive(Debug, Clone)]
pub(crate) struct Flank {
    pub local: LocalSurface,
}

/// Where the query's nearest point lies on the trimmed flanks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Nearest {
    pub position: DVec3,
    /// Flanks it lies on, and their unit normals there.
    pub flanks: [usize; 3],
    pub normals: [DVec3; 3],
    pub sheets: usize,
}

impl Neighborhood {
    pub fn clear(&mut self) {
        self.points.clear();
        self.normals.clear();
        self.trust.clear();
    }

    pub fn push(&mut self, point: DVec3, normal: DVec3, trust: f64) {
        self.points.push(point);
        self.normals.push(normal);
        self.trust.push(trust);
    }

    /// Distance to the farthest neighbour, mm.
    pub fn radius_mm(&self) -> f64 {
        self.points.last().map_or(0.0, |p| p.length())
    }

    /// Square root of the area a neighbour has to itself, mm.
    pub fn spacing_mm(&self) -> f64 {
        self.radius_mm() * (std::f64::consts::PI / self.points.len().max(1) as f64).sqrt()
    }

    /// The neighbours on flank `label`.
    pub fn members(&self, label: usize) -> impl Iterator<Item = DVec3> + '_ {
        self.points
            .iter()
            .zip(&self.labels)
            .filter(move |(_, l)| **l == label as u8)
            .map(|(p, _)| *p)
    }

    /// Splits the neighbours into flanks.
    ///
    /// Flanks grow one after the other from the neighbours whose normals are surest, each through those that its polynomial explains; then
    /// all neighbours choose the flank that explains them best, and the flanks are fitted anew around the query.
    pub fn split(&mut self, scale: &Scale, smoothing: &Smoothing) -> Vec<Flank> {
        self.labels.clear();
        self.labels.resize(self.points.len(), NONE);
        let mut tried = vec![false; self.points.len()];
        let mut flanks: Vec<Flank> = Vec::new();
        let least = (self.points.len() / 16).max(5);
        while flanks.len() < FLANKS_MAX {
            let left = self.labels.iter().filter(|l| **l == NONE).count();
            if left < least {
                break;
            }
            let Some(seed) = self.seed(&tried) else { break };
            tried[seed] = true;
            if let Some(flank) = self.grow(seed, flanks.len() as u8, (scale, smoothing)) {
                flanks.push(flank);
            }
        }
        for round in 0..2 {
            self.choose(&flanks, scale);
            flanks = self.refit(flanks, (scale, smoothing));
            if round == 0 {
                self.crease(&mut flanks, scale);
            }
        }
        self.choose(&flanks, scale);
        flanks
    }

    fn seed(&self, tried: &[bool]) -> Option<usize> {
        let radius = self.radius_mm().max(f64::MIN_POSITIVE);
        let badness = |i: usize| self.points[i].length() / radius + 2.0 * (1.0 - self.trust[i]);
        (0..self.points.len())
            .filter(|&i| self.labels[i] == NONE && !tried[i])
            .min_by(|&a, &b| badness(a).total_cmp(&badness(b)))
    }

    /// Grows a flank from a seed in three strides; labels its members. `None`, and nothing labelled, where it finds too few.
    fn grow(
        &mut self,
        seed: usize,
        label: u8,
        (scale, smoothing): (&Scale, &Smoothing),
    ) -> Option<Flank> {
        let start = self.points[seed];
        let radius = self.radius_mm();
        let frame = LocalFrame::new(start, self.normals[seed]);
        let mut local = LocalSurface {
            frame,
            polynomial: super::polynomial::Polynomial::flat(),
        };
        let mut wide = *smoothing;
        let mut flank = None;
        for (stride, bend) in [(0.5, 0.1), (0.9, 0.03), (2.0, 0.01)] {
            let reach = stride * radius;
            self.members.clear();
            let mut last = Vec::new();
            for i in 0..self.points.len() {
                let far = self.points[i].distance(start);
                let tolerance =
                    3.0 * scale.noise_mm + scale.floor_mm() + bend * far * far / scale.spacing_mm;
                if self.labels[i] != NONE || far >= reach {
                    continue;
                }
                let most = tolerance.min(3.0 * scale.noise_mm + 0.4 * scale.spacing_mm);
                let (off, normal) = local.look(self.points[i]);
                if off.abs() < most && self.agrees(i, normal) {
                    self.members.push(self.points[i]);
                    last.push(i);
                }
            }
            if self.members.len() < 5 {
                break;
            }
            wide.h_mm = reach.min(radius);
            let centre = self.members.iter().sum::<DVec3>() / self.members.len() as f64;
            let normal = weighted_normal(&self.members, centre, wide.h_mm)?;
            let frame = LocalFrame::new(centre, normal);
            let Some(polynomial) = fit(&self.members, &frame, &wide) else {
                break;
            };
            local = LocalSurface { frame, polynomial };
            flank = Some((local.clone(), last));
        }
        let (local, last) = flank?;
        for i in last {
            self.labels[i] = label;
        }
        Some(Flank { local })
    }

    /// Whether neighbour `i`'s own normal speaks for a surface of this `normal`, or says nothing.
    fn agrees(&self, i: usize, normal: DVec3) -> bool {
        const COS_35_DEGREES: f64 = 0.82;
        self.trust[i] < 0.4 || self.normals[i].dot(normal).abs() > COS_35_DEGREES
    }

    /// Splits every flank whose points two planes explain better than one quadric does, which has as many coefficients.
    ///
    /// Blunt edges grow into one flank, the more easily the more noise there is; this finds them again.
    fn crease(&mut self, flanks: &mut Vec<Flank>, scale: &Scale) {
        let sigma = scale.noise_mm + scale.floor_mm();
        for label in 0..flanks.len() {
            if flanks.len() == FLANKS_MAX
                || flanks[label].local.polynomial.residual_mm < 1.15 * sigma
            {
                continue;
            }
            self.choose(flanks, scale);
            let members: Vec<DVec3> = self.members(label).collect();
            if let Some([one, other]) = roof(&members, &flanks[label].local.frame, sigma) {
                flanks[label].local = one;
                flanks.push(Flank { local: other });
            }
        }
    }

    /// Gives every neighbour to the flank that explains its position and its normal best.
    fn choose(&mut self, flanks: &[Flank], scale: &Scale) {
        let width = scale.noise_mm + 3.0 * scale.floor_mm();
        for i in 0..self.points.len() {
            let mut best = (NONE, 16.0);
            for (label, flank) in flanks.iter().enumerate() {
                let (off, normal) = flank.local.look(self.points[i]);
                let off = off / width;
                let cosine = self.normals[i].dot(normal).abs();
                // An angle of 30 degrees counts as much as a distance of one sigma, as far as the normal is trusted.
                let turn = self.trust[i] * (1.0 - cosine.min(1.0)) / 0.134;
                let cost = off * off + turn;
                if cost < best.1 {
                    best = (label as u8, cost);
                }
            }
            self.labels[i] = best.0;
        }
    }

    /// Fits every flank to its neighbours, weighted around the query; flanks that too few determine are dropped.
    fn refit(
        &mut self,
        flanks: Vec<Flank>,
        (scale, smoothing): (&Scale, &Smoothing),
    ) -> Vec<Flank> {
        let mut kept = Vec::with_capacity(flanks.len());
        for (label, old) in flanks.into_iter().enumerate() {
            self.members.clear();
            self.members.extend(
                self.points
                    .iter()
                    .zip(&self.labels)
                    .filter(|(_, l)| **l == label as u8)
                    .map(|(p, _)| *p),
            );
            if self.members.len() < 5 {
                continue;
            }
            if let Some(local) = self.fit_members(&old, (scale, smoothing)) {
                kept.push(Flank { local });
            }
        }
        kept
    }

    fn fit_members(
        &self,
        old: &Flank,
        (scale, smoothing): (&Scale, &Smoothing),
    ) -> Option<LocalSurface> {
        let reach = self.radius_mm() * 2.0;
        let nearest = old
            .local
            .foot(DVec3::ZERO, reach)
            .map_or(DVec3::ZERO, |f| f.position);
        let middle = self.members.iter().sum::<DVec3>() / self.members.len() as f64;
        // The weights stand around the query's place on the flank, but not so far out that none of its points has any.
        let out = nearest - middle;
        let spread = smoothing.h_mm;
        let centre = middle + out * (spread / out.length().max(spread));
        let normal = weighted_normal(&self.members, centre, smoothing.h_mm)?;
        if !determined(&self.members, normal, scale) {
            return None;
        }
        let frame = LocalFrame::new(centre, normal);
        let frame = LocalFrame::new(
            centre + normal * plane_offset(&self.members, &frame, smoothing.h_mm),
            normal,
        );
        let polynomial = fit(&self.members, &frame, smoothing)?;
        Some(LocalSurface { frame, polynomial })
    }
}

/// The two planes that explain the points better than a quadric over `frame`, by more than chance would under noise of `sigma_mm`.
fn roof(points: &[DVec3], frame: &LocalFrame, sigma_mm: f64) -> Option<[LocalSurface; 2]> {
    /// Residual squares, in squares of sigma, that two planes must take away: chance does so once in hundreds of neighbourhoods.
    const GAIN: f64 = 14.0;
    const LEAST: usize = 6;
    if points.len() < 3 * LEAST {
        return None;
    }
    let inside: Vec<DVec3> = points.iter().map(|p| frame.inside(*p)).collect();
    let scale_mm = inside
        .iter()
        .map(|p| p.truncate().length())
        .fold(f64::MIN_POSITIVE, f64::max);
    let fit_all = |degree: Degree, pick: &dyn Fn(&DVec3) -> bool| {
        let mut equations = Equations::new(degree, scale_mm);
        equations.add_all(inside.iter().filter(|p| pick(p)).map(|p| (*p, 1.0)));
        equations
            .solve(0.0)
            .map(|polynomial| (polynomial, equations.residual_squares(&polynomial)))
    };
    let (quadric, quadric_squares) = fit_all(Degree::Two, &|_| true)?;
    let across = quadric.jet(0.0, 0.0).steepest_bend();
    let mut places: Vec<f64> = inside.iter().map(|p| p.truncate().dot(across)).collect();
    places.sort_unstable_by(f64::total_cmp);
    let mut best = (quadric_squares - GAIN * sigma_mm * sigma_mm, None);
    for eighth in 1..8 {
        let cut = places[places.len() * eighth / 8];
        let below = |p: &DVec3| p.truncate().dot(across) < cut;
        let few = places.iter().filter(|x| **x < cut).count();
        if few < LEAST || places.len() - few < LEAST {
            continue;
        }
        let (Some(one), Some(other)) = (
            fit_all(Degree::One, &below),
            fit_all(Degree::One, &|p| !below(p)),
        ) else {
            continue;
        };
        if one.1 + other.1 < best.0 {
            best = (one.1 + other.1, Some([one.0, other.0]));
        }
    }
    // Planes that do not explain the points down to the noise are no better than facets of a curved surface.
    let limit = 1.3 * sigma_mm;
    if best.0 > points.len() as f64 * limit * limit {
        return None;
    }
    best.1.map(|planes| {
        planes.map(|polynomial| LocalSurface {
            frame: *frame,
            polynomial,
        })
    })
}

/// Weighted mean height of the points over the frame, mm.
fn plane_offset(points: &[DVec3], frame: &LocalFrame, h_mm: f64) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for p in points {
        let at = frame.inside(*p);
        let w = gaussian(at.length_squared(), h_mm);
        sum += w * at.z;
        weights += w;
    }
    sum / weights.max(f64::MIN_POSITIVE)
}

/// Whether the points fix the plane's slope in every direction to better than 0.2 rad under the noise.
fn determined(points: &[DVec3], normal: DVec3, scale: &Scale) -> bool {
    let mean = points.iter().sum::<DVec3>() / points.len() as f64;
    let (u, v) = normal.any_orthonormal_pair();
    let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
    for p in points {
        let (a, b) = ((*p - mean).dot(u), (*p - mean).dot(v));
        uu += a * a;
        uv += a * b;
        vv += b * b;
    }
    let least = 0.5 * (uu + vv) - (0.25 * (uu - vv) * (uu - vv) + uv * uv).sqrt();
    let sigma = scale.noise_mm + scale.floor_mm();
    least > 25.0 * sigma * sigma
        && least > 0.05 * scale.spacing_mm * scale.spacing_mm * points.len() as f64
}

/// The flanks around a query with their relations: which trims which.
pub(crate) struct Arrangement<'a> {
    hood: &'a Neighborhood,
    flanks: &'a [Flank],
    scale: &'a Scale,
    feet: Vec<Option<Foot>>,
    /// Side of flank b on which the points of flank a lie, for pairs that trim each other; else 0.
    sides: [[f64; FLANKS_MAX]; FLANKS_MAX],
    gap_mm: f64,
    reach_mm: f64,
}

impl<'a> Arrangement<'a> {
    /// The arrangement of `flanks`, as `hood.split` returned them.
    pub fn new(hood: &'a Neighborhood, flanks: &'a [Flank], scale: &'a Scale) -> Self {
        let reach_mm = 1.5 * hood.radius_mm();
        let mut arrangement = Self {
            hood,
            flanks,
            scale,
            feet: flanks
                .iter()
                .map(|f| f.local.foot(DVec3::ZERO, reach_mm))
                .collect(),
            sides: [[0.0; FLANKS_MAX]; FLANKS_MAX],
            gap_mm: 2.0 * hood.spacing_mm().max(scale.spacing_mm) + scale.noise_mm,
            reach_mm,
        };
        for a in 0..flanks.len() {
            for b in 0..flanks.len() {
                if a != b {
                    arrangement.sides[a][b] = arrangement.side(a, b);
                }
            }
        }
        for a in 0..flanks.len() {
            for b in 0..a {
                if arrangement.sides[a][b] == 0.0 || arrangement.sides[b][a] == 0.0 {
                    arrangement.sides[a][b] = 0.0;
                    arrangement.sides[b][a] = 0.0;
                }
            }
        }
        arrangement
    }

    /// On which side of flank `b` the points of flank `a` near the query lie: 1, -1, or 0 where on both.
    fn side(&self, a: usize, b: usize) -> f64 {
        let dead = 2.0 * self.scale.noise_mm + self.scale.floor_mm();
        let h = 0.6 * self.hood.radius_mm();
        let (mut sum, mut weights) = (0.0, 0.0);
        for p in self.hood.members(a) {
            let off = self.flanks[b].local.distance(p);
            if off.abs() > dead {
                let w = gaussian(p.length_squared(), h);
                sum += w * off.signum();
                weights += w;
            }
        }
        let mean = if weights > 0.0 { sum / weights } else { 0.0 };
        if mean.abs() > 0.7 { mean.signum() } else { 0.0 }
    }

    /// Whether flank `a` has points of its own around `x`.
    fn present(&self, a: usize, x: DVec3) -> bool {
        let limit = self.gap_mm * self.gap_mm;
        self.hood.members(a).any(|p| p.distance_squared(x) < limit)
    }

    /// Whether `x`, on the flanks `on`, lies on the part of each that the others leave over.
    fn inside(&self, x: DVec3, on: &[usize]) -> bool {
        let slack = 0.5 * self.scale.floor_mm() + 0.1 * self.scale.noise_mm;
        (0..self.flanks.len()).filter(|b| !on.contains(b)).all(|b| {
            on.iter().all(|&a| {
                let side = self.sides[a][b];
                side == 0.0
                    || !self.present(b, x)
                    || side * self.flanks[b].local.distance(x) > -slack
            })
        })
    }

    /// The nearest point of the trimmed flanks; `None` where none of them reaches the query's surroundings.
    pub fn nearest(&self) -> Option<Nearest> {
        let face = self.nearest_face();
        let edge = self.nearest_edge();
        let corner = self.nearest_corner();
        let length = |n: &Option<Nearest>| n.map_or(f64::INFINITY, |n| n.position.length());
        let mut best = if length(&edge) < length(&face) {
            edge
        } else {
            face
        };
        let snap = 1.5 * self.scale.noise_mm + 5.0 * self.scale.floor_mm();
        if let (Some(at), Some(on_edge)) = (best, edge)
            && at.position.distance(on_edge.position) < snap
        {
            best = edge;
        }
        if let Some(at) = corner {
            let near = best.is_none_or(|b| b.sheets > 1 && b.position.distance(at.position) < snap);
            if near || length(&corner) < length(&best) {
                best = corner;
            }
        }
        best
    }

    fn nearest_face(&self) -> Option<Nearest> {
        let mut best: Option<Nearest> = None;
        for (a, foot) in self.feet.iter().enumerate() {
            let Some(foot) = foot else { continue };
            if best.is_some_and(|b| b.position.length() <= foot.position.length())
                || !self.present(a, foot.position)
                || !self.inside(foot.position, &[a])
            {
                continue;
            }
            best = Some(Nearest {
                position: foot.position,
                flanks: [a, a, a],
                normals: [foot.normal; 3],
                sheets: 1,
            });
        }
        best
    }

    /// The nearest place where two flanks that trim each other meet.
    pub fn nearest_edge(&self) -> Option<Nearest> {
        let mut best: Option<Nearest> = None;
        for a in 0..self.flanks.len() {
            for b in 0..a {
                if self.sides[a][b] == 0.0 {
                    continue;
                }
                let Some(met) = self.meeting([a, b], DVec3::ZERO) else {
                    continue;
                };
                if best.is_none_or(|e| e.position.length() > met.position.length()) {
                    best = Some(met);
                }
            }
        }
        best
    }

    /// The place nearest to `start` where two flanks meet, if it lies on the parts of them that are there.
    fn meeting(&self, [a, b]: [usize; 2], start: DVec3) -> Option<Nearest> {
        let (x, na, nb) = self.meet_two([a, b], start)?;
        let there = self.present(a, x) && self.present(b, x) && self.inside(x, &[a, b]);
        there.then_some(Nearest {
            position: x,
            flanks: [a, b, b],
            normals: [na, nb, nb],
            sheets: 2,
        })
    }

    /// The place on the same feature line as `edge`, `step_mm` along it.
    pub fn along(&self, edge: &Nearest, step_mm: f64) -> Option<Nearest> {
        let tangent = edge.normals[0].cross(edge.normals[1]).normalize_or_zero();
        self.meeting(
            [edge.flanks[0], edge.flanks[1]],
            edge.position + tangent * step_mm,
        )
    }

    /// The nearest place where three flanks meet, of which at least two pairs trim each other.
    pub fn nearest_corner(&self) -> Option<Nearest> {
        let mut best: Option<Nearest> = None;
        let n = self.flanks.len();
        for a in 0..n {
            for b in 0..a {
                for c in 0..b {
                    let related = [(a, b), (b, c), (c, a)]
                        .iter()
                        .filter(|(i, j)| self.sides[*i][*j] != 0.0)
                        .count();
                    if related < 2 {
                        continue;
                    }
                    let Some((x, normals)) = self.meet_three([a, b, c]) else {
                        continue;
                    };
                    if best.is_some_and(|e| e.position.length() <= x.length())
                        || [a, b, c].iter().any(|&f| !self.present(f, x))
                    {
                        continue;
                    }
                    best = Some(Nearest {
                        position: x,
                        flanks: [a, b, c],
                        normals,
                        sheets: 3,
                    });
                }
            }
        }
        best
    }

    /// The point of the intersection curve of two flanks nearest to `start`, with both normals.
    fn meet_two(&self, [a, b]: [usize; 2], start: DVec3) -> Option<(DVec3, DVec3, DVec3)> {
        let mut x = start;
        let mut normals = (DVec3::Z, DVec3::Z);
        for _ in 0..6 {
            let fa = self.flanks[a].local.foot(x, self.reach_mm)?;
            let fb = self.flanks[b].local.foot(x, self.reach_mm)?;
            let (na, nb) = (fa.normal, fb.normal);
            let g = na.dot(nb);
            let sine_squared = 1.0 - g * g;
            // Below three degrees the flanks have no line in common that the points could fix.
            if sine_squared < 0.0027 {
                return None;
            }
            let (ca, cb) = (na.dot(fa.position - start), nb.dot(fb.position - start));
            let next =
                start + na * ((ca - g * cb) / sine_squared) + nb * ((cb - g * ca) / sine_squared);
            normals = (na, nb);
            let moved = next.distance(x);
            x = next;
            if x.length().is_nan() || x.length() >= self.reach_mm {
                return None;
            }
            if moved < 1e-3 * self.scale.floor_mm() {
                break;
            }
        }
        Some((x, normals.0, normals.1))
    }

    fn meet_three(&self, of: [usize; 3]) -> Option<(DVec3, [DVec3; 3])> {
        let mut x = DVec3::ZERO;
        let mut normals = [DVec3::Z; 3];
        for _ in 0..6 {
            let mut right = [0.0; 3];
            for k in 0..3 {
                let foot = self.flanks[of[k]].local.foot(x, self.reach_mm)?;
                normals[k] = foot.normal;
                right[k] = foot.normal.dot(foot.position);
            }
            let rows = DMat3::from_cols(normals[0], normals[1], normals[2]).transpose();
            if rows.determinant().abs() < 0.02 {
                return None;
            }
            let next = rows.inverse() * DVec3::from_array(right);
            let moved = next.distance(x);
            x = next;
            if x.length().is_nan() || x.length() >= self.reach_mm {
                return None;
            }
            if moved < 1e-3 * self.scale.floor_mm() {
                break;
            }
        }
        Some((x, normals))
    }
}
