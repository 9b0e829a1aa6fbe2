//! Splits a neighbourhood into the smooth surfaces it is made of, and finds the creases between them.

use glam::DVec3;

use super::patch::{Fit, Plane, Surface, fit, foot, meeting, varying};
use crate::points::moments::Moments;

/// Most surfaces a neighbourhood is split into before those that join smoothly are merged.
const MOST_PLANES: usize = 5;
/// Most seeds among which the first two planes are chosen.
const MOST_SEEDS: usize = 16;
/// Label of a point that belongs to no surface.
const STRAY: u8 = u8::MAX;
/// A crease is believed where the criterion prefers it by this much.
const DECISIVE: f64 = 10.0;
/// A crease that ought to be preferred by this much shows: of chi-squared its standard deviation is 13.
const CLEAR: f64 = 45.0;
/// What remains of a crease |x| in the disc of radius one when the best quadric is taken out, root mean square; and what that quadric's
/// curvature is. (Least squares over the disc; of the best surface of fourth degree 0.037 remains.)
const DEPARTURE: f64 = 0.071;
const BENDING: f64 = 2.036;
/// Tangent of half a turn, 70 degrees, up to which both hold: beyond it a crease is no height function over its mean plane.
const STEEP: f64 = 0.7;
/// Share of the evidence due near a faint crease that must be there.
const LOCAL: f64 = 0.4;
/// Smallest turn angle, rad, that counts as sharp: 6 degrees.
pub(super) const LEAST_TURN: f64 = 0.105;
/// Farthest foot, in spacings, that is of interest.
const FAR: f64 = 2.6;

/// Largest turn angle, rad, that is an edge: 166 degrees. What is folded back farther is two sheets.
const MOST_TURN: f64 = 2.9;

/// An edge as one neighbourhood sees it, relative to its point, in spacings.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crease {
    /// Nearest point of the edge.
    pub foot: DVec3,
    /// Unit tangent there; its sign is arbitrary.
    pub tangent: DVec3,
    /// Angle between the normals, 0 to pi.
    pub turn: f64,
    /// Unit directions from the foot into each surface, across the edge.
    pub into: [DVec3; 2],
    /// Standard deviation of the foot across the edge.
    pub sd: f64,
    /// Bayes' criterion of all surfaces that the neighbourhood is split into.
    pub criterion: f64,
    /// Where three or more surfaces meet nearby.
    pub corner: Option<DVec3>,
}

/// What a neighbourhood is.
#[derive(Debug, Clone, Copy)]
pub(super) enum Verdict {
    /// One smooth surface, or an edge too far away to be of interest.
    Smooth,
    /// Neither can be excluded: a larger neighbourhood is needed.
    Unsure,
    /// An edge.
    Creased(Crease),
}

/// Working memory of the analysis; one a thread.
#[derive(Default)]
pub(super) struct Workshop {
    /// The points, relative to the one in question, in spacings; that one first.
    pub points: Vec<DVec3>,
    /// Plausible planes from outside.
    pub seeds: Vec<Plane>,
    /// Whether one smooth surface has explained a smaller neighbourhood of the same point: what more a larger one is made of does not
    /// matter then.
    pub was_smooth: bool,
    costs: Vec<f64>,
    labels: Vec<u8>,
    near: Vec<(f64, u32)>,
    parts: [Vec<DVec3>; 2],
    whole: Vec<DVec3>,
}

impl Workshop {
    /// What the neighbourhood in `points` is, at noise of variance `variance` (spacings squared).
    ///
    pub fn analyse(&mut self, variance: f64) -> Verdict {
        if self.points.len() < 8 {
            return Verdict::Smooth;
        }
        let Some(whole) = fit(&self.points, variance) else {
            return Verdict::Smooth;
        };
        if let Some(verdict) = self.at_a_glance(&whole, variance) {
            return verdict;
        }
        if let Some(verdict) = self.two_sided(&whole, variance) {
            return verdict;
        }
        let n = self.points.len() as f64;
        let plain =
            !whole.surface.is_curved() && whole.squares < variance * (n + 4.0 * (2.0 * n).sqrt());
        if plain || self.was_smooth {
            return Verdict::Unsure;
        }
        let all = Plane::through(self.points.iter().copied());
        self.add_small_planes();
        self.seeds.push(all);
        let mut planes = self.choose_planes(variance);
        if planes.len() < 2 {
            return Verdict::Unsure;
        }
        self.assign(&mut planes, variance);
        let fits = self.merge(planes.len() as u8, variance);
        self.nearest_crease(&fits, variance)
    }

    /// The verdict where one smooth surface explains all points so well that no crease could be decisive.
    fn at_a_glance(&mut self, whole: &Fit, variance: f64) -> Option<Verdict> {
        let n = self.points.len();
        let expected = (n - whole.parameters.min(n)) as f64;
        // A crease of turn a within the radius r bends the best quadric by 4.07 tan(a / 2) / r.
        let reach = self.points[n - 1].length();
        let half_turn = whole.surface.curvature() * reach / BENDING;
        let due = |tan: f64| n as f64 * (DEPARTURE * reach * tan).powi(2) / variance;
        if half_turn < STEEP {
            let squares: f64 = (self.points.iter())
                .map(|p| whole.surface.distance(*p).powi(2))
                .sum();
            let missing = due(half_turn) - (squares / variance - expected);
            if missing > 2.5 * (2.0 * n as f64 + 4.0 * due(half_turn)).sqrt() {
                return Some(Verdict::Smooth);
            }
        }
        if whole.squares > variance * (expected + 0.5 * DECISIVE) {
            return None;
        }
        self.was_smooth = true;
        let least = (0.5 * LEAST_TURN).tan();
        Some(if due(least) > CLEAR && half_turn < 0.7 * least {
            Verdict::Smooth
        } else {
            Verdict::Unsure
        })
    }

    /// The verdict where two surfaces side by side explain all points.
    ///
    /// The one quadric through all of them bends most across the crease; along that direction lies the cut that leaves the two flattest
    /// sides.
    fn two_sided(&mut self, whole: &Fit, variance: f64) -> Option<Verdict> {
        const CUTS: usize = 16;
        const FEWEST: f64 = 5.0;
        let across = whole.surface.bending()?;
        let cut_at = |i: usize| FAR * (2.0 * (i as f64 + 0.5) / CUTS as f64 - 1.0);
        let mut bins = [Moments::default(); CUTS + 1];
        for p in &self.points {
            let x = p.dot(across);
            let bin = ((x / FAR + 1.0) * 0.5 * CUTS as f64 + 0.5).clamp(0.0, CUTS as f64);
            bins[bin as usize].add(*p);
        }
        let mut above = [Moments::default(); CUTS + 1];
        for i in (0..CUTS).rev() {
            above[i] = above[i + 1];
            above[i].join(&bins[i + 1]);
        }
        let mut below = Moments::default();
        let mut best: Option<(f64, usize)> = None;
        for i in 0..CUTS {
            below.join(&bins[i]);
            if below.count() < FEWEST || above[i].count() < FEWEST {
                continue;
            }
            let cost = below.count() * below.plane().variances[2]
                + above[i].count() * above[i].plane().variances[2];
            if best.is_none_or(|b| cost < b.0) {
                best = Some((cost, i));
            }
        }
        let cut = cut_at(best?.1);
        self.labels.clear();
        self.labels
            .extend(self.points.iter().map(|p| u8::from(p.dot(across) > cut)));
        let [first, second] = &mut self.parts;
        first.clear();
        second.clear();
        for (p, label) in self.points.iter().zip(&self.labels) {
            if *label == 0 {
                &mut *first
            } else {
                &mut *second
            }
            .push(*p);
        }
        let fits = [(0, fit(first, variance)?), (1, fit(second, variance)?)];
        let parts = self.split(&fits[0], &fits[1], variance)?;
        let n = self.points.len() as f64;
        if parts[0].squares + parts[1].squares > variance * (n + 3.0 * (2.0 * n).sqrt()) {
            return None;
        }
        Some(self.crease(&fits, (0, 1), (parts, *whole), variance))
    }

    /// Seeds of their own: planes through the seven points nearest to each of eight points far apart.
    fn add_small_planes(&mut self) {
        const SMALL: usize = 7;
        let n = self.points.len();
        self.costs.clear();
        self.costs.resize(n, f64::INFINITY);
        let mut at = n - 1;
        for _ in 0..8 {
            if self.seeds.len() >= MOST_SEEDS - 1 {
                break;
            }
            let centre = self.points[at];
            self.near.clear();
            for (i, p) in self.points.iter().enumerate() {
                let d = p.distance_squared(centre);
                self.costs[i] = self.costs[i].min(d);
                self.near.push((d, i as u32));
            }
            let k = SMALL.min(n - 1);
            self.near
                .select_nth_unstable_by(k, |a, b| a.0.total_cmp(&b.0));
            let points = &self.points;
            self.seeds.push(Plane::through(
                self.near[..k].iter().map(|(_, i)| points[*i as usize]),
            ));
            at = (0..n).fold(0, |best, i| {
                if self.costs[i] > self.costs[best] {
                    i
                } else {
                    best
                }
            });
        }
    }

    /// The fewest seeds that explain the points: the best pair, then one after another as long as each explains enough.
    fn choose_planes(&mut self, variance: f64) -> Vec<Plane> {
        let n = self.points.len();
        let cap = 9.0 * variance;
        self.costs.clear();
        for seed in &self.seeds {
            self.costs.extend(
                self.points
                    .iter()
                    .map(|p| seed.distance(*p).powi(2).min(cap)),
            );
        }
        let row = |s: usize| &self.costs[s * n..(s + 1) * n];
        let single = (0..self.seeds.len())
            .map(|s| row(s).iter().sum::<f64>())
            .fold(f64::INFINITY, f64::min);
        let mut best = (f64::INFINITY, 0, 0);
        for i in 0..self.seeds.len() {
            for j in 0..i {
                let cost: f64 = row(i).iter().zip(row(j)).map(|(a, b)| a.min(*b)).sum();
                if cost < best.0 {
                    best = (cost, i, j);
                }
            }
        }
        // What a plane of pure chance gains: three parameters and the freedom of choice among the seeds.
        let worth = variance * 3.0 * (n as f64).ln();
        if single - best.0 < 0.5 * worth && best.0 < variance * n as f64 {
            return Vec::new();
        }
        let mut chosen = vec![self.seeds[best.1], self.seeds[best.2]];
        let mut so_far: Vec<f64> = row(best.1)
            .iter()
            .zip(row(best.2))
            .map(|(a, b)| a.min(*b))
            .collect();
        while chosen.len() < MOST_PLANES {
            let gain = |s: usize| -> f64 {
                row(s)
                    .iter()
                    .zip(&so_far)
                    .map(|(a, b)| (b - a).max(0.0))
                    .sum()
            };
            let (s, g) = (0..self.seeds.len())
                .map(|s| (s, gain(s)))
                .fold((0, 0.0), |a, b| if b.1 > a.1 { b } else { a });
            if g < 2.0 * worth {
                break;
            }
            chosen.push(self.seeds[s]);
            so_far = row(s).iter().zip(&so_far).map(|(a, b)| a.min(*b)).collect();
        }
        chosen
    }

    /// Gives every point to its nearest plane and fits the planes anew, a few times.
    fn assign(&mut self, planes: &mut [Plane], variance: f64) {
        let n = self.points.len();
        for round in 0..3 {
            let cap = variance * [25.0, 16.0, 9.0][round];
            self.labels.clear();
            for p in &self.points {
                let (label, d) = planes
                    .iter()
                    .enumerate()
                    .map(|(s, plane)| (s as u8, plane.distance(*p).powi(2)))
                    .fold((STRAY, f64::INFINITY), |a, b| if b.1 < a.1 { b } else { a });
                self.labels.push(if d < cap { label } else { STRAY });
            }
            if round == 2 {
                break;
            }
            for (s, plane) in planes.iter_mut().enumerate() {
                let members = (0..n).filter(|i| self.labels[*i] == s as u8);
                if members.clone().count() >= 4 {
                    *plane = Plane::through(members.map(|i| self.points[i]));
                }
            }
        }
    }

    /// Merges surfaces, best first, as long as one smooth surface explains two of them as well; what remains.
    fn merge(&mut self, count: u8, variance: f64) -> Vec<(u8, Fit)> {
        let mut fits: Vec<(u8, Fit)> = (0..count)
            .filter_map(|s| {
                let labelled = self.points.iter().zip(&self.labels);
                self.whole.clear();
                self.whole
                    .extend(labelled.filter(|(_, l)| **l == s).map(|(p, _)| *p));
                (self.whole.len() >= 4)
                    .then(|| fit(&self.whole, variance))?
                    .map(|f| (s, f))
            })
            .collect();
        while fits.len() > 1 {
            let mut best: Option<(f64, usize, usize, Fit)> = None;
            for i in 0..fits.len() {
                for j in 0..i {
                    let Some(parts) = self.split(&fits[i], &fits[j], variance) else {
                        continue;
                    };
                    let Some(whole) = fit(&self.whole, variance) else {
                        continue;
                    };
                    let change = whole.criterion(variance)
                        - parts[0].criterion(variance)
                        - parts[1].criterion(variance);
                    if best.as_ref().is_none_or(|x| change < x.0) {
                        best = Some((change, i, j, whole));
                    }
                }
            }
            let Some((change, i, j, union)) = best else {
                break;
            };
            if change > DECISIVE {
                break;
            }
            let (from, to) = (fits[i].0, fits[j].0);
            for label in self.labels.iter_mut().filter(|l| **l == from) {
                *label = to;
            }
            fits[j].1 = union;
            fits.remove(i);
        }
        fits
    }

    /// The two surfaces fitted anew after giving each of their points, which are left in `whole`, to the side of the crease on which it lies.
    ///
    /// The side is that of the surface which halves the angle: unlike the nearer of the two, it does not select by noise.
    fn split(&mut self, one: &(u8, Fit), other: &(u8, Fit), variance: f64) -> Option<[Fit; 2]> {
        let mut fits = [one.1, other.1];
        let labelled = self.points.iter().zip(&self.labels);
        self.whole.clear();
        self.whole.extend(
            labelled
                .filter(|(_, l)| **l == one.0 || **l == other.0)
                .map(|(p, _)| *p),
        );
        for _ in 0..2 {
            let [a, b] = [fits[0].surface, fits[1].surface];
            let facing = self.facing([one.0, other.0], &[a, b]);
            let [first, second] = &mut self.parts;
            first.clear();
            second.clear();
            for p in &self.whole {
                if facing[0] * b.distance(*p) < facing[1] * a.distance(*p) {
                    second.push(*p);
                } else {
                    first.push(*p);
                }
            }
            fits = [fit(first, variance)?, fit(second, variance)?];
        }
        Some(fits)
    }

    /// On which side of the other surface each one's points lie: their signs.
    fn facing(&self, labels: [u8; 2], surfaces: &[Surface; 2]) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (p, label) in self.points.iter().zip(&self.labels) {
            if *label == labels[0] {
                sums[0] += surfaces[1].distance(*p);
            } else if *label == labels[1] {
                sums[1] += surfaces[0].distance(*p);
            }
        }
        sums.map(f64::signum)
    }

    /// The nearest decisive crease between two of the surfaces.
    fn nearest_crease(&mut self, fits: &[(u8, Fit)], variance: f64) -> Verdict {
        let mut best: Option<Crease> = None;
        let mut explained = false;
        for i in 0..fits.len() {
            for j in 0..i {
                let Some(parts) = self.split(&fits[i], &fits[j], variance) else {
                    continue;
                };
                let Some(whole) = fit(&self.whole, variance) else {
                    continue;
                };
                match self.crease(fits, (i, j), (parts, whole), variance) {
                    Verdict::Unsure => {}
                    Verdict::Smooth => explained = true,
                    Verdict::Creased(crease) => {
                        let nearer =
                            |b: Crease| crease.foot.length_squared() < b.foot.length_squared();
                        if best.is_none_or(nearer) {
                            best = Some(crease);
                        }
                    }
                }
            }
        }
        let Some(mut crease) = best else {
            return if explained {
                Verdict::Smooth
            } else {
                Verdict::Unsure
            };
        };
        if fits.len() > 2 {
            crease.corner = self.corner(fits);
        }
        Verdict::Creased(crease)
    }

    /// The crease between two surfaces last split: their intersection, where both have points and the turn is beyond doubt.
    ///
    /// Smooth where two surfaces there are, but no crease between them near enough.
    fn crease(
        &mut self,
        all: &[(u8, Fit)],
        (i, j): (usize, usize),
        (fits, whole): ([Fit; 2], Fit),
        variance: f64,
    ) -> Verdict {
        let evidence =
            whole.criterion(variance) - fits[0].criterion(variance) - fits[1].criterion(variance);
        if evidence < DECISIVE {
            return Verdict::Unsure;
        }
        let elsewhere = if evidence > CLEAR {
            Verdict::Smooth
        } else {
            Verdict::Unsure
        };
        let surfaces = [fits[0].surface, fits[1].surface];
        let labels = [all[i].0, all[j].0];
        let Some((e, tangent)) = foot(&surfaces[0], &surfaces[1], DVec3::ZERO)
            .filter(|(e, _)| e.length_squared() < FAR * FAR && self.supported(labels, *e))
        else {
            return elsewhere;
        };
        let Some(across) = self.directions(labels, &surfaces, (e, tangent)) else {
            return elsewhere;
        };
        let turn = (-across[0].dot(across[1])).clamp(-1.0, 1.0).acos();
        // At the end of a stretch of length L with n points a line is good to 2 sigma / sqrt n and its slope to sqrt 12 sigma / (L sqrt n);
        // a parabola to 3 sigma / sqrt n and sqrt 192 sigma / (L sqrt n).
        let (mut place, mut slope) = (0.0, 0.0);
        for f in &fits {
            let n = f.count as f64;
            let length2 = (n / 1.5).max(1.0);
            let bent = f.surface.is_curved();
            place += if bent { 9.0 } else { 4.0 } / n;
            slope += if bent { 192.0 } else { 12.0 } / (n * length2);
        }
        if turn > MOST_TURN {
            return Verdict::Smooth;
        }
        if turn < LEAST_TURN.max(3.0 * (variance * slope).sqrt()) {
            return Verdict::Unsure;
        }
        match self.holds_nearby((all, labels), &fits, (e, turn), variance) {
            Some(true) => Verdict::Creased(Crease {
                foot: e,
                tangent,
                turn,
                into: across,
                criterion: self.criterion(all, labels, &fits, variance),
                sd: (variance * place).sqrt() / turn.sin(),
                corner: None,
            }),
            Some(false) => Verdict::Smooth,
            None => Verdict::Unsure,
        }
    }

    /// Bayes' criterion of all surfaces, the two of `labels` as in `fits`.
    fn criterion(&self, all: &[(u8, Fit)], labels: [u8; 2], fits: &[Fit; 2], variance: f64) -> f64 {
        let others = all.iter().filter(|f| !labels.contains(&f.0));
        let explained = fits.iter().chain(others.map(|f| &f.1));
        let (sum, count) = explained.fold((0.0, 0), |(sum, count), f| {
            (sum + f.criterion(variance), count + f.count)
        });
        sum + 9.0 * self.points.len().saturating_sub(count) as f64
    }

    /// Whether the crease last split shows near its foot `e` too, as strongly as its `turn` (rad) must there.
    ///
    /// A crease turns at once, a curved surface over a length: only the former beats one smooth surface in the smallest neighbourhood that
    /// could tell.
    fn holds_nearby(
        &mut self,
        (all, labels): (&[(u8, Fit)], [u8; 2]),
        fits: &[Fit; 2],
        (e, turn): (DVec3, f64),
        variance: f64,
    ) -> Option<bool> {
        const FEWEST: usize = 32;
        self.costs.clear();
        self.costs
            .extend(self.points.iter().map(|p| p.distance_squared(e)));
        self.costs.sort_unstable_by(f64::total_cmp);
        let expected = |(k, d2): (usize, &f64)| {
            (k + 1) as f64 * (DEPARTURE * (0.5 * turn).tan()).powi(2) * d2 / variance
        };
        let last = self.costs.len() - 1;
        let k = (FEWEST.min(last)..last)
            .find(|k| expected((*k, &self.costs[*k])) > 4.0 * DECISIVE)
            .unwrap_or(last);
        let (within, due) = (self.costs[k], expected((k, &self.costs[k])));
        let near = |p: &&DVec3| p.distance_squared(e) <= within;
        let cap = 9.0 * variance;
        let mut creased = 0.0;
        for (fit, part) in fits.iter().zip(&self.parts) {
            let mut count = 0;
            for p in part.iter().filter(near) {
                creased += fit.surface.distance(*p).powi(2).min(cap) / variance;
                count += 1;
            }
            creased += fit.parameters as f64 * f64::from(count.max(2)).ln();
        }
        self.whole.clear();
        self.whole.extend(self.points.iter().filter(near));
        let others = || {
            let labelled = self.points.iter().zip(&self.labels);
            labelled.filter(|(p, l)| near(p) && !labels.contains(l))
        };
        creased += 9.0
            * others()
                .filter(|(_, l)| all.iter().all(|f| f.0 != **l))
                .count() as f64;
        for (label, fit) in all {
            let mut count = 0;
            for (p, _) in others().filter(|(_, l)| *l == label) {
                creased += fit.surface.distance(*p).powi(2).min(cap) / variance;
                count += 1;
            }
            if count > 0 {
                creased += fit.parameters as f64 * f64::from(count.max(2)).ln();
            }
        }
        let whole = fit(&self.whole, variance)?;
        // A surface of fourth degree follows a crease so far that a quarter of the squares remain.
        let smooth = if due > 8.0 * CLEAR {
            whole.criterion(variance)
        } else {
            varying(&whole.surface, &self.whole, variance)
                .unwrap_or(f64::INFINITY)
                .min(whole.criterion(variance))
        };
        let evidence = smooth - creased;
        if evidence > (LOCAL * due).min(DECISIVE) {
            Some(true)
        } else {
            (due > CLEAR - 5.0).then_some(false)
        }
    }

    /// Unit directions from the foot into each surface, across the edge.
    fn directions(
        &self,
        labels: [u8; 2],
        surfaces: &[Surface; 2],
        (e, tangent): (DVec3, DVec3),
    ) -> Option<[DVec3; 2]> {
        let mut into = [DVec3::ZERO; 2];
        for s in 0..2 {
            let normal = surfaces[s].height(e).1.normalize();
            let direction = normal.cross(tangent).try_normalize()?;
            let lean: f64 = (0..self.points.len())
                .filter(|i| self.labels[*i] == labels[s])
                .map(|i| {
                    let d = self.points[i] - e;
                    d.dot(direction) / (1.0 + d.length_squared())
                })
                .sum();
            into[s] = direction * lean.signum();
        }
        Some(into)
    }

    /// Whether both surfaces have points near the foot: a crease is where surfaces meet, not where their continuations do.
    fn supported(&self, labels: [u8; 2], e: DVec3) -> bool {
        const NEAR: f64 = 2.6;
        labels.iter().all(|label| {
            let near = (0..self.points.len())
                .filter(|i| {
                    self.labels[*i] == *label && self.points[*i].distance_squared(e) < NEAR * NEAR
                })
                .count();
            near >= 2
        })
    }

    /// Where three of the surfaces meet, the nearest such place.
    fn corner(&self, fits: &[(u8, Fit)]) -> Option<DVec3> {
        let mut best: Option<DVec3> = None;
        for i in 0..fits.len() {
            for j in 0..i {
                for k in 0..j {
                    let three = [i, j, k].map(|s| &fits[s].1.surface);
                    let Some(c) = meeting(three, DVec3::ZERO) else {
                        continue;
                    };
                    let near = c.length_squared() < FAR * FAR
                        && self.supported([fits[i].0, fits[j].0], c)
                        && self.supported([fits[k].0, fits[k].0], c);
                    if near && best.is_none_or(|b| c.length_squared() < b.length_squared()) {
                        best = Some(c);
                    }
                }
            }
        }
        best
    }
}
