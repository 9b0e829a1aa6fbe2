//! The part of a surface that a face uses: loops in the parameter plane.
//!
//! One parameter, `along`, is the one that loops may wind around (the angle of a cylinder). Rays run in the other, `across`:
//! between two crossings with the loops lies inside or outside. Where no loop closes the region at one end (half a sphere),
//! the direction of the loops decides: the material lies to their left.

use crate::geometry::newton::Range;

/// Segments up to which each vertex gets a strip of its own: plates with a hundred holes have twenty thousand.
const MAX_EXACT: usize = 200_000;

/// A loop as a polyline of parameters, unwrapped: it may run on beyond the range of a closed direction.
pub(super) type UvLoop = Vec<(f64, f64)>;

/// Loops of a face, ready for queries.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Trim {
    /// Whether u and v change places: rays run in u because loops wind in v.
    swapped: bool,
    /// Ranges of `along` and `across`.
    ranges: [Range; 2],
    /// Extent of the loops in `along`, or the range where it is closed.
    extent: (f64, f64),
    segments: Vec<Segment>,
    /// Segments that touch each of the equal strips of the extent: starts into `order`, one more than strips.
    starts: Vec<u32>,
    order: Vec<u32>,
    /// Whether loops must be trusted to run with the material on their left.
    oriented: bool,
    /// No loop bounds anything: the whole surface.
    whole: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Segment {
    from: (f64, f64),
    to: (f64, f64),
}

/// Where a ray meets a loop, and whether the material lies beyond.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    at: f64,
    enters: bool,
}

impl Trim {
    /// From loops in (u, v) with the material on their left.
    pub fn new(loops: &[UvLoop], ranges: [Range; 2]) -> Self {
        let winds = |get: fn(&(f64, f64)) -> f64, r: Range| {
            r.period().is_some_and(|p| {
                loops.iter().any(|l| match (l.first(), l.last()) {
                    (Some(a), Some(b)) => (get(b) - get(a)).abs() > 0.5 * p,
                    _ => false,
                })
            })
        };
        let swapped = winds(|p| p.1, ranges[1]) && !winds(|p| p.0, ranges[0]);
        let turn = |p: &(f64, f64)| if swapped { (p.1, p.0) } else { *p };
        let ranges = if swapped {
            [ranges[1], ranges[0]]
        } else {
            ranges
        };
        let segments: Vec<Segment> = loops
            .iter()
            .flat_map(|l| l.windows(2))
            .map(|w| Segment {
                from: turn(&w[0]),
                to: turn(&w[1]),
            })
            .filter(|s| s.from.0 != s.to.0)
            .collect();
        let extent = if ranges[0].closed {
            (ranges[0].from, ranges[0].to)
        } else {
            segments
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |e, s| {
                    (e.0.min(s.from.0).min(s.to.0), e.1.max(s.from.0).max(s.to.0))
                })
        };
        let mut trim = Self {
            swapped,
            ranges,
            extent,
            segments,
            starts: Vec::new(),
            order: Vec::new(),
            oriented: false,
            whole: false,
        };
        trim.index();
        trim.judge();
        trim
    }

    /// Whether the parameters lie in the face.
    pub fn contains(&self, uv: (f64, f64)) -> bool {
        let (a, b) = if self.swapped { (uv.1, uv.0) } else { uv };
        let b = if self.ranges[1].closed {
            self.ranges[1].bring(b)
        } else {
            b
        };
        let inside = |b: f64| {
            self.intervals(a)
                .iter()
                .any(|(from, to)| b >= *from && b <= *to)
        };
        match self.ranges[1].period() {
            Some(p) => [b, b + p, b - p].into_iter().any(inside),
            None => inside(b),
        }
    }

    /// Strips between `breaks`: middle and width in `along`, and the stretches of `across` inside the face there.
    pub fn strips(&self, breaks: Vec<f64>) -> impl Iterator<Item = Strip> + '_ {
        (1..breaks.len()).map(move |i| {
            let along = 0.5 * (breaks[i - 1] + breaks[i]);
            Strip {
                along,
                width: breaks[i] - breaks[i - 1],
                across: self.intervals(along),
            }
        })
    }

    /// Borders of `count` equal strips; none where the extent has no length.
    pub fn even_breaks(&self, count: usize) -> Vec<f64> {
        let (from, to) = self.extent;
        if !((to - from).is_finite() && to > from) {
            return Vec::new();
        }
        let at = |i: usize| from + (to - from) * i as f64 / count as f64;
        (0..=count).map(at).collect()
    }

    /// Borders of strips on which every loop is straight, and short enough for a smooth surface.
    pub fn exact_breaks(&self) -> Vec<f64> {
        let mut breaks = self.even_breaks(64);
        if breaks.is_empty() || self.segments.len() > MAX_EXACT {
            return self.even_breaks(1024);
        }
        for s in &self.segments {
            breaks.push(self.ranges[0].bring(s.from.0));
            breaks.push(self.ranges[0].bring(s.to.0));
        }
        breaks.sort_unstable_by(f64::total_cmp);
        let resolution = 1e-12 * (self.extent.1 - self.extent.0);
        breaks.dedup_by(|a, b| (*a - *b).abs() <= resolution);
        breaks
    }

    /// Whether rays run in u.
    pub fn is_swapped(&self) -> bool {
        self.swapped
    }

    /// (u, v) of a place on a strip.
    pub fn uv(&self, along: f64, across: f64) -> (f64, f64) {
        let along = self.ranges[0].bring(along);
        let across = if self.ranges[1].closed {
            self.ranges[1].bring(across)
        } else {
            across
        };
        if self.swapped {
            (across, along)
        } else {
            (along, across)
        }
    }

    /// A length of `along` from the extent.
    pub fn extent(&self) -> (f64, f64) {
        self.extent
    }

    fn intervals(&self, along: f64) -> Vec<(f64, f64)> {
        let r = self.ranges[1];
        if self.whole {
            return vec![(r.from, r.to)];
        }
        let mut crossings = self.crossings(along);
        crossings.sort_unstable_by(|a, b| a.at.total_cmp(&b.at));
        if !self.oriented {
            return crossings
                .chunks_exact(2)
                .map(|c| (c[0].at, c[1].at))
                .collect();
        }
        match r.period() {
            Some(p) => around(&crossings, p),
            None => between(&crossings, r),
        }
    }

    fn crossings(&self, along: f64) -> Vec<Crossing> {
        let mut out = Vec::new();
        let period = self.ranges[0].period();
        let along = self.ranges[0].bring(along);
        let (from, to) = self.extent;
        if along < from || along > to || self.starts.len() < 2 {
            return out;
        }
        let strips = self.starts.len() - 1;
        let strip = (((along - from) / (to - from)) * strips as f64) as usize;
        let strip = strip.min(strips - 1);
        let range = self.starts[strip] as usize..self.starts[strip + 1] as usize;
        for k in &self.order[range] {
            let s = self.segments[*k as usize];
            let (low, high) = (s.from.0.min(s.to.0), s.from.0.max(s.to.0));
            let mut at = along;
            if let Some(p) = period {
                // The first image of the ray not below the segment.
                at += ((low - along) / p).ceil() * p;
            }
            // Half open: a vertex belongs to one of its two segments.
            while at >= low && at < high {
                let share = (at - s.from.0) / (s.to.0 - s.from.0);
                out.push(Crossing {
                    at: s.from.1 + share * (s.to.1 - s.from.1),
                    enters: (s.to.0 > s.from.0) != self.swapped,
                });
                match period {
                    Some(p) => at += p,
                    None => break,
                }
            }
        }
        out
    }

    /// Sorts the segments into strips.
    fn index(&mut self) {
        let (from, to) = self.extent;
        let strips = self.segments.len().clamp(1, 256);
        let width = (to - from) / strips as f64;
        if !(width.is_finite() && width > 0.0) {
            return;
        }
        let mut lists: Vec<Vec<u32>> = vec![Vec::new(); strips];
        for (k, s) in self.segments.iter().enumerate() {
            let (low, high) = (s.from.0.min(s.to.0), s.from.0.max(s.to.0));
            let first = ((low - from) / width).floor() as i64 - 1;
            let last = ((high - from) / width).floor() as i64 + 1;
            let closed = self.ranges[0].closed;
            if closed && last - first >= strips as i64 {
                lists.iter_mut().for_each(|l| l.push(k as u32));
                continue;
            }
            for i in first..=last {
                if closed {
                    lists[i.rem_euclid(strips as i64) as usize].push(k as u32);
                } else if i >= 0 && i < strips as i64 {
                    lists[i as usize].push(k as u32);
                }
            }
        }
        self.starts = vec![0];
        for l in lists {
            self.order.extend(l);
            self.starts.push(self.order.len() as u32);
        }
    }

    /// Finds out whether parity alone tells inside from outside.
    fn judge(&mut self) {
        let (from, to) = self.extent;
        // Segments that only rounding keeps from running along the rays bound nothing.
        let wide = |s: &&Segment| (s.to.0 - s.from.0).abs() > 1e-9 * (to - from);
        let wide: Vec<f64> = self
            .segments
            .iter()
            .filter(wide)
            .map(|s| s.from.0 + 0.4871 * (s.to.0 - s.from.0))
            .collect();
        let every = wide.len().div_ceil(64).max(1);
        let odd = wide
            .iter()
            .step_by(every)
            .filter(|a| self.crossings(**a).len() % 2 == 1)
            .count();
        self.whole = wide.is_empty();
        self.oriented = odd > 0 || self.ranges[1].closed;
    }
}

/// Stretches inside on an open ray: what the first crossing leaves began at the end of the range.
fn between(crossings: &[Crossing], range: Range) -> Vec<(f64, f64)> {
    let mut out = Vec::new();
    let mut from = crossings.first().filter(|c| !c.enters).map(|_| range.from);
    for c in crossings {
        match (c.enters, from) {
            (true, None) => from = Some(c.at),
            (false, Some(start)) => {
                out.push((start, c.at));
                from = None;
            }
            _ => {}
        }
    }
    if let Some(start) = from {
        out.push((start, range.to));
    }
    out
}

/// Stretches inside on a closed ray of one turn: the last to enter goes on to the first to leave, a turn later.
fn around(crossings: &[Crossing], period: f64) -> Vec<(f64, f64)> {
    let mut out = Vec::new();
    let mut open: Option<f64> = None;
    for c in crossings {
        match (c.enters, open) {
            (true, None) => open = Some(c.at),
            (false, Some(start)) => {
                out.push((start, c.at.min(start + period)));
                open = None;
            }
            _ => {}
        }
    }
    if let (Some(start), Some(first)) = (open, crossings.first()) {
        let end = if first.enters { start } else { first.at };
        let end = end + period * ((start - end) / period).floor() + period;
        out.push((start, end.min(start + period)));
    }
    out
}

/// One strip of a face.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Strip {
    /// Middle of the strip.
    pub along: f64,
    /// Its width.
    pub width: f64,
    /// Stretches inside the face, possibly beyond the range of a closed direction.
    pub across: Vec<(f64, f64)>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

    fn square(x: f64, y: f64, half: f64) -> UvLoop {
        vec![
            (x - half, y - half),
            (x + half, y - half),
            (x + half, y + half),
            (x - half, y + half),
            (x - half, y - half),
        ]
    }

    #[test]
    fn a_plane_with_a_hole_needs_no_orientation() {
        let mut hole = square(0.0, 0.0, 1.0);
        hole.reverse();
        for loops in [
            [square(0.0, 0.0, 3.0), hole],
            [square(0.0, 0.0, 3.0), square(0.0, 0.0, 1.0)],
        ] {
            let t = Trim::new(&loops, [Range::UNBOUNDED; 2]);
            assert!(t.contains((2.0, 0.5)) && t.contains((0.3, -2.0)));
            assert!(!t.contains((0.5, 0.5)) && !t.contains((3.5, 0.0)) && !t.contains((0.1, 9.0)));
        }
    }

    #[test]
    fn a_cylinder_between_two_circles_and_one_over_the_seam() {
        let ring = |v: f64, ccw: bool| -> UvLoop {
            (0..=8)
                .map(|i| if ccw { i } else { 8 - i })
                .map(|i| (1.0 + TAU * f64::from(i) / 8.0, v))
                .collect()
        };
        let ranges = [Range::TURN, Range::UNBOUNDED];
        let t = Trim::new(&[ring(0.0, true), ring(2.0, false)], ranges);
        assert!(t.contains((0.1, 1.0)) && t.contains((5.0, 0.1)));
        assert!(!t.contains((0.1, 2.5)) && !t.contains((0.1, -0.5)));
        let t = Trim::new(&[square(TAU, 0.0, 0.5)], ranges);
        assert!(t.contains((0.2, 0.0)) && t.contains((TAU - 0.2, 0.0)));
        assert!(!t.contains((1.0, 0.0)) && !t.contains((PI, 0.0)));
    }

    #[test]
    fn half_a_sphere_lies_to_the_left_of_its_equator() {
        let ranges = [Range::TURN, Range::open(-FRAC_PI_2, FRAC_PI_2)];
        let equator = vec![(0.0, 0.0), (PI, 0.0), (TAU, 0.0)];
        let north = Trim::new(std::slice::from_ref(&equator), ranges);
        assert!(north.contains((1.0, 0.5)) && !north.contains((1.0, -0.5)));
        let south = Trim::new(&[equator.into_iter().rev().collect()], ranges);
        assert!(!south.contains((1.0, 0.5)) && south.contains((1.0, -0.5)));
        assert!(Trim::new(&[], ranges).contains((1.0, 0.5)));
    }

    #[test]
    fn a_torus_between_two_circles_either_way_around_the_tube() {
        let ring = |v: f64, ccw: bool| -> UvLoop {
            let l = vec![(0.0, v), (PI, v), (TAU, v)];
            if ccw {
                l
            } else {
                l.into_iter().rev().collect()
            }
        };
        let t = Trim::new(&[ring(0.5, true), ring(1.5, false)], [Range::TURN; 2]);
        assert!(t.contains((1.0, 1.0)) && !t.contains((1.0, 2.0)) && !t.contains((1.0, 0.2)));
        let t = Trim::new(&[ring(0.5, false), ring(1.5, true)], [Range::TURN; 2]);
        assert!(!t.contains((1.0, 1.0)) && t.contains((1.0, 2.0)) && t.contains((1.0, 0.2)));
        // Cut across the tube: loops wind in v, rays run in u.
        let cut = |u: f64, up: bool| -> UvLoop {
            let l = vec![(u, 0.0), (u, PI), (u, TAU)];
            if up { l } else { l.into_iter().rev().collect() }
        };
        let t = Trim::new(&[cut(1.0, false), cut(2.0, true)], [Range::TURN; 2]);
        assert!(t.contains((1.5, 3.0)) && !t.contains((2.5, 3.0)) && !t.contains((0.5, 3.0)));
    }
}
