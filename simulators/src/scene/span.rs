//! The parts of a ray that lie inside a region, and how two such sets join.

use glam::DVec3;
use smallvec::SmallVec;

use super::surface::SurfaceId;

/// A half-line; distances along it are in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it starts, mm.
    pub origin: DVec3,
    /// Unit vector.
    pub direction: DVec3,
    /// One over each component, for boxes; infinite where a component is zero.
    pub(crate) inverse: DVec3,
}

impl Ray {
    /// From `origin` towards `direction`, of any length but zero.
    pub fn new(origin: DVec3, direction: DVec3) -> Ray {
        Ray::along(origin, direction.normalize())
    }

    /// From `origin` along the unit vector `direction`.
    pub fn along(origin: DVec3, direction: DVec3) -> Ray {
        Ray {
            origin,
            direction,
            inverse: 1.0 / direction,
        }
    }

    /// The point at distance `t` mm.
    pub fn at(&self, t: f64) -> DVec3 {
        self.origin + self.direction * t
    }
}

/// Where a ray passes a surface, or the end of the window it is looked at in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crossing {
    pub t: f64,
    /// `None` at the end of a window.
    pub surface: Option<SurfaceId>,
    pub facet: u32,
}

impl Crossing {
    pub const OPEN_START: Crossing = Crossing {
        t: f64::NEG_INFINITY,
        surface: None,
        facet: 0,
    };
    pub const OPEN_END: Crossing = Crossing {
        t: f64::INFINITY,
        surface: None,
        facet: 0,
    };

    pub fn at(t: f64, surface: SurfaceId) -> Crossing {
        Crossing {
            t,
            surface: Some(surface),
            facet: 0,
        }
    }

    pub fn moved(self, t: f64) -> Crossing {
        Crossing { t, ..self }
    }
}

/// A part of a ray inside a region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Span {
    pub enter: Crossing,
    pub leave: Crossing,
}

impl Span {
    /// Keeps what lies below a plane; false when nothing is left.
    pub fn cut(&mut self, (normal, offset): (DVec3, f64), id: SurfaceId, ray: &Ray) -> bool {
        let speed = normal.dot(ray.direction);
        let height = normal.dot(ray.origin) - offset;
        if speed == 0.0 {
            return height <= 0.0;
        }
        let t = -height / speed;
        if speed < 0.0 && t >= self.enter.t {
            self.enter = Crossing::at(t, id);
        } else if speed > 0.0 && t <= self.leave.t {
            self.leave = Crossing::at(t, id);
        }
        self.enter.t < self.leave.t
    }
}

/// Ascending and disjoint.
pub(crate) type Spans = SmallVec<[Span; 4]>;

/// The part of the ray that is looked at, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Window {
    pub from: f64,
    pub to: f64,
}

impl Window {
    pub fn whole(self) -> Spans {
        self.keep(Crossing::OPEN_START, Crossing::OPEN_END)
    }

    /// What of one span lies in the window.
    pub fn keep(self, enter: Crossing, leave: Crossing) -> Spans {
        let enter = if enter.t < self.from {
            Crossing::OPEN_START.moved(self.from)
        } else {
            enter
        };
        let leave = if leave.t > self.to {
            Crossing::OPEN_END.moved(self.to)
        } else {
            leave
        };
        let mut spans = Spans::new();
        if enter.t < leave.t {
            spans.push(Span { enter, leave });
        }
        spans
    }

    pub fn narrowed(self, from: f64, to: f64) -> Option<Window> {
        let window = Window {
            from: self.from.max(from),
            to: self.to.min(to),
        };
        (window.from < window.to).then_some(window)
    }
}

/// Adds a span that begins where the last one ends, or later; where they meet without a surface they become one.
pub(crate) fn append(spans: &mut Spans, span: Span) {
    match spans.last_mut() {
        Some(last) if span.enter.t <= last.leave.t => {
            if span.leave.t > last.leave.t {
                last.leave = span.leave;
            }
        }
        _ => spans.push(span),
    }
}

/// Inside both.
pub(crate) fn both(a: &Spans, b: &Spans) -> Spans {
    let mut out = Spans::new();
    let (mut i, mut j) = (0, 0);
    while i < a.len() && j < b.len() {
        let enter = later(a[i].enter, b[j].enter);
        let leave = earlier(a[i].leave, b[j].leave);
        if enter.t < leave.t {
            out.push(Span { enter, leave });
        }
        if a[i].leave.t < b[j].leave.t {
            i += 1;
        } else {
            j += 1;
        }
    }
    out
}

/// Inside either; spans that touch are one.
pub(crate) fn either(a: &Spans, b: &Spans) -> Spans {
    let mut out = Spans::new();
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let take_a = j == b.len() || (i < a.len() && a[i].enter.t <= b[j].enter.t);
        let next = if take_a {
            i += 1;
            a[i - 1]
        } else {
            j += 1;
            b[j - 1]
        };
        append(&mut out, next);
    }
    out
}

/// Outside, within the window.
pub(crate) fn neither(a: &Spans, window: Window) -> Spans {
    let mut out = Spans::new();
    let mut enter = Crossing::OPEN_START.moved(window.from);
    for span in a {
        if enter.t < span.enter.t {
            out.push(Span {
                enter,
                leave: span.enter,
            });
        }
        enter = span.leave;
    }
    if enter.t < window.to {
        out.push(Span {
            enter,
            leave: Crossing::OPEN_END.moved(window.to),
        });
    }
    out
}

fn later(a: Crossing, b: Crossing) -> Crossing {
    // of two at the same place the one that is a surface
    if a.t > b.t || (a.t == b.t && a.surface.is_some()) {
        a
    } else {
        b
    }
}

fn earlier(a: Crossing, b: Crossing) -> Crossing {
    if a.t < b.t || (a.t == b.t && a.surface.is_some()) {
        a
    } else {
        b
    }
}
