//! The nearest point of a B-spline surface without a hint: branch and bound with proofs.
//!
//! A patch is known by its middle with derivatives to second order and by bounds on the third. These give a box that holds
//! it, and the Hessian of the squared distance over it. Patches whose box is farther than the best point so far are left;
//! on those where the distance is convex, Newton's method finds the one minimum there is; others are halved. What remains
//! in the end is the global minimum, up to the size of the smallest patch where the distance is the same along a whole curve.

use std::cell::OnceCell;

use glam::DVec3;

use super::NurbsSurface;
use super::nets::{Nets, Third};
use super::newton::{Range, SurfaceDerivatives, nearest_on_surface};

/// Patches of the tree of one surface.
const MAX_PATCHES: usize = 1 << 15;
/// Halvings of one piece for the tree.
const MAX_SPLITS: u32 = 4;
/// Patches that one search may halve: without it a point on the axis of a tube would look at all of it. The proof needs tens;
/// points at nearly the same distance from a long stretch need thousands.
const BUDGET: usize = 100_000;
/// Patches smaller than this share of the surface are not halved.
const SMALLEST: f64 = 1e-7;
/// Steps of Newton's method on a patch on which the distance is convex.
const STEPS: usize = 40;

/// The tree of one surface.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Search {
    patches: Vec<Patch>,
    nodes: Vec<Node>,
    size: f64,
}

/// Four boxes along the axes, and what is in them.
#[derive(Debug, Clone, PartialEq)]
struct Node {
    low: [[f64; 4]; 3],
    high: [[f64; 4]; 3],
    /// A node, or a patch above [`PATCH`]; boxes that are not used lie at infinity.
    child: [u32; 4],
}

const PATCH: u32 = 1 << 31;

/// A piece of the surface over a rectangle of its parameters.
#[derive(Debug, Clone, PartialEq)]
struct Patch {
    middle: [f64; 2],
    half: [f64; 2],
    /// At the middle, by parameters that run from -1 to 1.
    at: SurfaceDerivatives,
    third: Third,
    /// Whether it ends, below and above in u and in v, where the surface ends or has a crease.
    ends: [[bool; 2]; 2],
    /// Axes of its box, its middle and half extents.
    axes: [DVec3; 3],
    centre: DVec3,
    extent: DVec3,
    /// Largest distance of its points from the middle.
    reach: f64,
    /// How far the Hessian may be from that at the middle: uu, uv, vv, by itself and per mm of distance.
    drift: [[f64; 2]; 3],
}

impl Patch {
    /// From the derivatives at its middle by the surface's own parameters.
    fn new(
        middle: [f64; 2],
        half: [f64; 2],
        d: SurfaceDerivatives,
        third: Third,
        ends: [[bool; 2]; 2],
    ) -> Self {
        let [hu, hv] = half;
        let at = SurfaceDerivatives {
            point: d.point,
            du: d.du * hu,
            dv: d.dv * hv,
            duu: d.duu * (hu * hu),
            duv: d.duv * (hu * hv),
            dvv: d.dvv * (hv * hv),
        };
        let [uuu, uuv, uvv, vvv] = third;
        let rest = (uuu + 3.0 * uuv + 3.0 * uvv + vvv) / 6.0;
        let n = at.du.cross(at.dv);
        let x = at.du.try_normalize();
        let x = x.or_else(|| at.dv.try_normalize()).unwrap_or(DVec3::X);
        let z = (n - x * n.dot(x)).try_normalize();
        let z = z.unwrap_or_else(|| x.any_orthonormal_vector());
        let axes = [x, z.cross(x), z];
        let mut centre = at.point;
        let extent = axes.map(|axis| {
            let linear = at.du.dot(axis).abs() + at.dv.dot(axis).abs();
            let (a, b) = (0.5 * at.duu.dot(axis), 0.5 * at.dvv.dot(axis));
            let c = at.duv.dot(axis).abs();
            let (low, high) = (a.min(0.0) + b.min(0.0) - c, a.max(0.0) + b.max(0.0) + c);
            centre += axis * (0.5 * (low + high));
            linear + 0.5 * (high - low) + rest
        });
        let length = |d: DVec3| d.length();
        let (u, v) = (length(at.du), length(at.dv));
        let (uu, uv, vv) = (length(at.duu), length(at.duv), length(at.dvv));
        let reach = u + v + 0.5 * (uu + 2.0 * uv + vv) + rest;
        // Largest change of the first and second derivatives over the patch.
        let to_u = uu + uv + 0.5 * (uuu + 2.0 * uuv + uvv);
        let to_v = uv + vv + 0.5 * (uuv + 2.0 * uvv + vvv);
        let (to_uu, to_uv, to_vv) = (uuu + uuv, uuv + uvv, uvv + vvv);
        Self {
            middle,
            half,
            at,
            third,
            ends,
            axes,
            centre,
            extent: DVec3::from(extent),
            reach,
            drift: [
                [2.0 * u * to_u + to_u * to_u + reach * uu, to_uu],
                [u * to_v + v * to_u + to_u * to_v + reach * uv, to_uv],
                [2.0 * v * to_v + to_v * to_v + reach * vv, to_vv],
            ],
        }
    }

    /// The same patch with other bounds on its third derivatives.
    fn bounded(&self, third: Third) -> Self {
        let [hu, hv] = self.half;
        let at = &self.at;
        let d = SurfaceDerivatives {
            point: at.point,
            du: at.du / hu,
            dv: at.dv / hv,
            duu: at.duu / (hu * hu),
            duv: at.duv / (hu * hv),
            dvv: at.dvv / (hv * hv),
        };
        Self::new(self.middle, self.half, d, third, self.ends)
    }

    /// Squared distance of a point from the box: no point of the patch is nearer.
    #[inline]
    fn bound(&self, p: DVec3) -> f64 {
        let d = p - self.centre;
        let local = DVec3::new(
            d.dot(self.axes[0]),
            d.dot(self.axes[1]),
            d.dot(self.axes[2]),
        );
        (local.abs() - self.extent)
            .max(DVec3::ZERO)
            .length_squared()
    }

    /// Gradient and Hessian of half the squared distance at the middle, and what they say of the whole patch.
    #[inline]
    fn model(&self, p: DVec3) -> ([f64; 2], [f64; 3], Verdict) {
        let d = &self.at;
        let r = d.point - p;
        let gradient = [d.du.dot(r), d.dv.dot(r)];
        let hessian = [
            d.du.length_squared() + d.duu.dot(r),
            d.du.dot(d.dv) + d.duv.dot(r),
            d.dv.length_squared() + d.dvv.dot(r),
        ];
        let far = r.length() + self.reach;
        let [euu, euv, evv] = self.drift.map(|[own, per_mm]| own + per_mm * far);
        let (uu, vv) = (hessian[0] - euu, hessian[2] - evv);
        let uv = hessian[1].abs() + euv;
        let verdict = if uu > 0.0 && vv > 0.0 && uu * vv > uv * uv {
            Verdict::Convex
        } else if self.has_no_minimum(gradient, hessian, [euu, euv, evv]) {
            Verdict::Nothing
        } else {
            Verdict::Open
        };
        (gradient, hessian, verdict)
    }

    /// Whether the distance falls towards a neighbour, or is bent downwards, all over the patch.
    ///
    /// At a border on which nothing follows smoothly a falling distance has a minimum all the same, at that border.
    fn has_no_minimum(&self, g: [f64; 2], h: [f64; 3], drift: [f64; 3]) -> bool {
        let change = [
            h[0].abs() + h[1].abs() + drift[0] + drift[1],
            h[2].abs() + h[1].abs() + drift[2] + drift[1],
        ];
        let bent = [h[0] + drift[0] < 0.0, h[2] + drift[2] < 0.0];
        (0..2).any(|k| {
            let [below, above] = self.ends[k];
            (g[k] > change[k] && !below)
                || (-g[k] > change[k] && !above)
                || (bent[k] && !below && !above)
        })
    }

    fn ranges(&self) -> [Range; 2] {
        [0, 1].map(|k| Range::open(self.middle[k] - self.half[k], self.middle[k] + self.half[k]))
    }

    /// Its two halves, across the longer side.
    fn halves(&self, surface: &NurbsSurface) -> [Self; 2] {
        let k = usize::from(self.at.dv.length() > self.at.du.length());
        let k = if self.at.du.length().max(self.at.dv.length()) * 16.0 < self.reach {
            // Nearly no extent to first order: by what the second says.
            usize::from(self.at.dvv.length() > self.at.duu.length())
        } else {
            k
        };
        let mut half = self.half;
        half[k] *= 0.5;
        let mut third = self.third;
        for (i, t) in third.iter_mut().enumerate() {
            let order = if k == 0 { 3 - i } else { i };
            *t *= 0.5f64.powi(order as i32);
        }
        [0, 1].map(|side| {
            let mut middle = self.middle;
            middle[k] += [-half[k], half[k]][side];
            let mut ends = self.ends;
            ends[k][1 - side] = false;
            let d = surface.derivatives(middle[0], middle[1]);
            Self::new(middle, half, d, third, ends)
        })
    }

    /// Whether it is so flat and even that points as near as its own size meet a convex distance on it.
    fn is_simple(&self) -> bool {
        let [e, f, g] = [
            self.at.du.length_squared(),
            self.at.du.dot(self.at.dv),
            self.at.dv.length_squared(),
        ];
        let [euu, euv, evv] = self
            .drift
            .map(|[own, per_mm]| own + per_mm * 2.0 * self.reach);
        let (uu, vv) = (e - euu, g - evv);
        let uv = f.abs() + euv;
        uu > 0.0 && vv > 0.0 && uu * vv > uv * uv
    }
}

/// What bounds say of the distance over a whole patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// One minimum, which Newton's method finds.
    Convex,
    /// No minimum of the surface lies here.
    Nothing,
    /// Neither is sure.
    Open,
}

/// The best point so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Best {
    pub uv: (f64, f64),
    /// Squared distance; infinite where there is none yet.
    pub d2: f64,
}

impl Best {
    pub const NONE: Self = Self {
        uv: (0.0, 0.0),
        d2: f64::INFINITY,
    };
}

impl Search {
    /// The tree of a surface.
    pub fn new(surface: &NurbsSurface) -> Self {
        let nets = OnceCell::new();
        let nets = || {
            let new = || {
                Nets::new(
                    surface.knots(),
                    surface.homogeneous(),
                    surface.is_rational(),
                )
            };
            nets.get_or_init(new)
        };
        let [pu, pv] = surface.pieces();
        let mut patches = Vec::new();
        let count = (pu.breaks().len() - 1) * (pv.breaks().len() - 1);
        // Many pieces are many patches already.
        let splits = (MAX_PATCHES / count)
            .checked_ilog2()
            .unwrap_or(0)
            .min(MAX_SPLITS);
        for (i, u) in pu.breaks().windows(2).enumerate() {
            for (j, v) in pv.breaks().windows(2).enumerate() {
                let middle = [0.5 * (u[0] + u[1]), 0.5 * (v[0] + v[1])];
                let half = [0.5 * (u[1] - u[0]), 0.5 * (v[1] - v[0])];
                let d = surface.derivatives(middle[0], middle[1]);
                let powers = surface.powers(i, j);
                let third = |middle_of: [f64; 2], half_of: [f64; 2], centre: DVec3| match &powers {
                    Some(powers) => {
                        let at = |k: usize| (middle_of[k] - middle[k]) / half[k];
                        let part = |k: usize| half_of[k] / half[k];
                        powers.third([at(0), at(1)], [part(0), part(1)], centre)
                    }
                    None if middle_of == middle => {
                        nets().third([pu.span_of(i), pv.span_of(j)], half, centre)
                    }
                    None => [f64::INFINITY; 4],
                };
                let ends = [pu.creases(i), pv.creases(j)];
                let mut first = third(middle, half, d.point);
                if !first[0].is_finite() {
                    first = nets().third([pu.span_of(i), pv.span_of(j)], half, d.point);
                }
                let whole = Patch::new(middle, half, d, first, ends);
                split(surface, whole, splits, &third, &mut patches);
            }
        }
        let bounds = patches.iter().map(aabb);
        let size = bounds
            .clone()
            .fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |b, [low, high]| {
                [b[0].min(low), b[1].max(high)]
            });
        let mut search = Self {
            size: size[0].distance(size[1]),
            nodes: Vec::new(),
            patches,
        };
        let boxes: Vec<[DVec3; 2]> = search.patches.iter().map(aabb).collect();
        let mut all: Vec<u32> = (0..search.patches.len() as u32).collect();
        search.add_node(&boxes, &mut all);
        search
    }

    /// A node over these patches; its index.
    fn add_node(&mut self, boxes: &[[DVec3; 2]], patches: &mut [u32]) -> u32 {
        let index = self.nodes.len();
        self.nodes.push(Node {
            low: [[f64::INFINITY; 4]; 3],
            high: [[f64::INFINITY; 4]; 3],
            child: [PATCH; 4],
        });
        let (left, right) = halve(boxes, patches);
        let quarters = [halve(boxes, left), halve(boxes, right)];
        let quarters = quarters.into_iter().flat_map(|(a, b)| [a, b]);
        for (slot, group) in quarters.filter(|g| !g.is_empty()).enumerate() {
            let bounds = group.iter().map(|p| boxes[*p as usize]);
            let bounds = bounds.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
            let child = match group {
                [one] => PATCH | *one,
                _ => self.add_node(boxes, group),
            };
            let node = &mut self.nodes[index];
            for k in 0..3 {
                node.low[k][slot] = bounds.map_or(f64::INFINITY, |b| b[0][k]);
                node.high[k][slot] = bounds.map_or(f64::INFINITY, |b| b[1][k]);
            }
            node.child[slot] = child;
        }
        index as u32
    }

    /// The nearest point among those nearer than `best` that are accepted; `best` where there is none.
    ///
    /// A minimum that is not accepted is passed over: a caller who accepts only the inside of a region finds its nearest
    /// inner point, if that is nearer than its border.
    pub fn nearest(
        &self,
        surface: &NurbsSurface,
        p: DVec3,
        mut best: Best,
        accept: &impl Fn((f64, f64)) -> bool,
    ) -> Best {
        let mut stack = [(0u32, 0.0f64); 96];
        let mut top = 1;
        let mut left = BUDGET;
        while top > 0 {
            top -= 1;
            let (child, bound) = stack[top];
            if bound >= best.d2 {
                continue;
            }
            if child & PATCH != 0 {
                let patch = &self.patches[(child & !PATCH) as usize];
                if patch.bound(p) < best.d2 {
                    self.visit(surface, p, patch, &mut best, (&mut left, accept));
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let mut d2 = [0.0f64; 4];
            for k in 0..3 {
                for (i, d) in d2.iter_mut().enumerate() {
                    let out = (node.low[k][i] - p[k]).max(p[k] - node.high[k][i]).max(0.0);
                    *d += out * out;
                }
            }
            // Farthest first onto the stack.
            let mut order = [0usize, 1, 2, 3];
            for (a, b) in [(0, 1), (2, 3), (0, 2), (1, 3), (1, 2)] {
                if d2[order[a]] < d2[order[b]] {
                    order.swap(a, b);
                }
            }
            for i in order {
                if d2[i] < best.d2 && top < stack.len() {
                    stack[top] = (node.child[i], d2[i]);
                    top += 1;
                }
            }
        }
        best
    }

    /// One patch of the tree, halved as far as it needs.
    fn visit(
        &self,
        surface: &NurbsSurface,
        p: DVec3,
        patch: &Patch,
        best: &mut Best,
        (left, accept): (&mut usize, &impl Fn((f64, f64)) -> bool),
    ) {
        let take = |uv, d2, best: &mut Best| {
            if d2 < best.d2 && accept(uv) {
                *best = Best { uv, d2 };
            }
        };
        let middle = |patch: &Patch, best: &mut Best| {
            let uv = (patch.middle[0], patch.middle[1]);
            take(uv, patch.at.point.distance_squared(p), best);
        };
        let (gradient, hessian, verdict) = patch.model(p);
        match verdict {
            Verdict::Nothing => return,
            Verdict::Convex => {
                let (uv, d2) = descend(surface, p, patch, gradient, hessian);
                take(uv, d2, best);
                return;
            }
            Verdict::Open => {}
        }
        let from = |middle: [f64; 2]| {
            let start = (middle[0], middle[1]);
            let whole = surface.ranges();
            nearest_on_surface(|u, v| surface.derivatives(u, v), p, start, whole)
        };
        if best.d2.is_infinite() {
            let (uv, d2) = from(patch.middle);
            take(uv, d2, best);
        }
        middle(patch, best);
        let mut open: Vec<Patch> = patch.halves(surface).into();
        while let Some(patch) = open.pop() {
            // What rounding alone could gain is not worth a proof.
            if patch.bound(p) >= best.d2 * (1.0 - 1e-14) {
                continue;
            }
            let (gradient, hessian, verdict) = patch.model(p);
            match verdict {
                Verdict::Nothing => continue,
                Verdict::Convex => {
                    let (uv, d2) = descend(surface, p, &patch, gradient, hessian);
                    take(uv, d2, best);
                    continue;
                }
                Verdict::Open => {}
            }
            if *left == 0 || patch.reach < SMALLEST * self.size {
                let (uv, d2) = from(patch.middle);
                take(uv, d2, best);
                continue;
            }
            *left -= 1;
            middle(&patch, best);
            let [a, b] = patch.halves(surface);
            let (near, far) = if a.bound(p) < b.bound(p) {
                (a, b)
            } else {
                (b, a)
            };
            open.push(far);
            open.push(near);
        }
    }
}

/// The one minimum of the distance on a patch on which it is convex.
fn descend(
    surface: &NurbsSurface,
    p: DVec3,
    patch: &Patch,
    gradient: [f64; 2],
    hessian: [f64; 3],
) -> ((f64, f64), f64) {
    let [hu, hv] = patch.half;
    let place = |x: [f64; 2]| (patch.middle[0] + hu * x[0], patch.middle[1] + hv * x[1]);
    // In the patch's own parameters; the first step needs no evaluation.
    let mut from = [0.0f64; 2];
    let mut x = boxed_minimum(from, gradient, hessian);
    let mut least = patch.at.point.distance_squared(p);
    let resolution = 1e-8 * (patch.at.point.length() + p.length());
    for _ in 0..STEPS {
        let uv = place(x);
        let d = surface.derivatives(uv.0, uv.1);
        let r = d.point - p;
        let d2 = r.length_squared();
        let way = d.du * (hu * (x[0] - from[0])) + d.dv * (hv * (x[1] - from[1]));
        // After a step this short, what is left is its square.
        if way.length_squared() <= resolution * resolution {
            return (uv, d2);
        }
        if d2 > least {
            // Too far for the model: downhill lies on the way.
            x = [0.5 * (from[0] + x[0]), 0.5 * (from[1] + x[1])];
            continue;
        }
        least = d2;
        from = x;
        let g = [d.du.dot(r) * hu, d.dv.dot(r) * hv];
        let h = [
            (d.du.length_squared() + d.duu.dot(r)) * (hu * hu),
            (d.du.dot(d.dv) + d.duv.dot(r)) * (hu * hv),
            (d.dv.length_squared() + d.dvv.dot(r)) * (hv * hv),
        ];
        x = boxed_minimum(x, g, h);
    }
    let start = place(from);
    nearest_on_surface(|u, v| surface.derivatives(u, v), p, start, patch.ranges())
}

/// Where the quadratic model with this gradient and convex Hessian at `x` is least within -1 to 1.
#[inline]
fn boxed_minimum(x: [f64; 2], g: [f64; 2], [a, b, c]: [f64; 3]) -> [f64; 2] {
    let det = a * c - b * b;
    let free = [
        x[0] + (b * g[1] - c * g[0]) / det,
        x[1] + (b * g[0] - a * g[1]) / det,
    ];
    if free[0].abs() <= 1.0 && free[1].abs() <= 1.0 {
        return free;
    }
    let value = |y: [f64; 2]| {
        let d = [y[0] - x[0], y[1] - x[1]];
        g[0] * d[0] + g[1] * d[1] + 0.5 * (a * d[0] * d[0] + c * d[1] * d[1]) + b * d[0] * d[1]
    };
    let mut best = (f64::INFINITY, x);
    for side in [-1.0, 1.0] {
        let v = x[1] - (g[1] + b * (side - x[0])) / c;
        let u = x[0] - (g[0] + b * (side - x[1])) / a;
        for y in [[side, v.clamp(-1.0, 1.0)], [u.clamp(-1.0, 1.0), side]] {
            let here = value(y);
            if here < best.0 {
                best = (here, y);
            }
        }
    }
    best.1
}

/// Halves a patch until it is simple; `third` gives bounds over the parts.
fn split(
    surface: &NurbsSurface,
    patch: Patch,
    splits: u32,
    third: &impl Fn([f64; 2], [f64; 2], DVec3) -> Third,
    out: &mut Vec<Patch>,
) {
    if splits == 0 || patch.is_simple() {
        out.push(patch);
        return;
    }
    for half in patch.halves(surface) {
        let own = third(half.middle, half.half, half.at.point);
        let mut best = half.third;
        best.iter_mut().zip(own).for_each(|(a, b)| *a = a.min(b));
        split(surface, half.bounded(best), splits - 1, third, out);
    }
}

/// The box of a patch along the axes.
fn aabb(patch: &Patch) -> [DVec3; 2] {
    let [x, y, z] = patch.axes.map(DVec3::abs);
    let e = patch.extent;
    let half = x * e.x + y * e.y + z * e.z;
    // Rounding of the sum.
    let half = half + DVec3::splat(1e-15 * (patch.centre.length() + half.length()));
    [patch.centre - half, patch.centre + half]
}

/// Two halves along the axis in which their middles spread most.
fn halve<'a>(boxes: &[[DVec3; 2]], patches: &'a mut [u32]) -> (&'a mut [u32], &'a mut [u32]) {
    let middle = |p: u32| boxes[p as usize][0] + boxes[p as usize][1];
    let spread = patches
        .iter()
        .fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |b, p| {
            [b[0].min(middle(*p)), b[1].max(middle(*p))]
        });
    let size = (spread[1] - spread[0]).to_array();
    let axis = (0..3).fold(0, |a, k| if size[k] > size[a] { k } else { a });
    let half = patches.len() / 2;
    if half > 0 {
        let key = |p: &u32| (middle(*p)[axis], *p);
        patches.select_nth_unstable_by(half, |a, b| {
            let (a, b) = (key(a), key(b));
            a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
        });
    }
    patches.split_at_mut(half)
}
