//! The shape of the real edge between two flanks that are known: round, chamfered, sharp as far as the data tell, or irregular.
//!
//! Everything happens in the section across the tangent, in *wedge coordinates*: the heights of a point over the two fitted
//! flanks. They straighten curved faces and tilted flanks, and a concave edge is a convex one with both heights negated. All
//! sections of a stretch are fitted as one (the cylinder of D1, D2 in the reference: less variation than single traces).
//!
//! Source: features-and-standards, section 5, characteristics 6 to 12.

mod draw;
mod fit;
mod profile;

use super::flank::FlankFit;
use super::result::{BreakShape, EdgeBreak, Quantified};
pub(super) use draw::draw_stretch;
use fit::{Fitted, Shape, choose};
use profile::Profile;

/// Stations that are fitted as one.
pub(super) const STRETCH: usize = 5;

/// Points of a stretch that are looked at: more do not make a radius better than the flanks allow.
pub(super) const POINTS_MAX: usize = 1500;

/// Fewest points in the zone of a stretch from which anything is said.
const POINTS_MIN: usize = 12;

/// One-sided 95 % quantile of the normal distribution.
const ONE_SIDED: f64 = 1.645;

/// A point near an edge, as seen from one nominal station of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ZonePoint {
    /// Arc length, mm.
    pub(super) s: f64,
    /// Distances into the two faces, mm.
    pub(super) r: [f64; 2],
    /// Signed distances to the two nominal faces, mm.
    pub(super) deviation: [f64; 2],
}

/// The two flanks at one station of a stretch.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wedge<'a> {
    /// Arc length of the station, mm.
    pub(super) s: f64,
    /// The fits of the flanks.
    pub(super) flanks: [&'a FlankFit; 2],
    /// Included angle through the material, rad.
    pub(super) included_angle_rad: f64,
}

impl Wedge<'_> {
    /// Angle between the two outward normals, rad.
    fn turn(&self) -> f64 {
        (std::f64::consts::PI - self.included_angle_rad).abs()
    }
}

/// What a stretch is made of.
pub(super) struct Stretch<'a> {
    /// Stations that were measured, in order.
    pub(super) wedges: Vec<Wedge<'a>>,
    /// Points near the edge.
    pub(super) points: &'a [ZonePoint],
    /// Length of a station, mm.
    pub(super) step_mm: f64,
    /// Spacing of the points across the edge, mm.
    pub(super) spacing_mm: f64,
    /// Whether the edge is convex.
    pub(super) convex: bool,
    /// Variance of a mean of flanks over what it were if stations shared nothing.
    pub(super) shared_factor: [f64; 2],
}

/// A break with what the ridge of its stations needs.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub(super) shape: EdgeBreak,
    /// The highest place of the profile in the section: along (n1 - n2) and along the bisector, mm, from the virtual edge.
    pub(super) highest: [f64; 2],
}

/// A point in wedge coordinates.
#[derive(Debug, Clone, Copy)]
struct WedgePoint {
    /// Heights over the flanks, negated where the edge is concave.
    d: [f64; 2],
    /// Distances into the faces.
    r: [f64; 2],
    /// Index of its wedge.
    wedge: usize,
    /// Whether it lies in the transition zone, so that no flank was fitted to it.
    free: bool,
}

/// A stretch in wedge coordinates.
struct Zone<'a> {
    points: Vec<WedgePoint>,
    stretch: &'a Stretch<'a>,
    turns: Vec<f64>,
    /// Mean turn.
    turn: f64,
    /// Depth of the zone on each flank, mm.
    reach: [f64; 2],
    /// Standard deviation of a point, mm.
    sigma: f64,
    /// 1 for convex, -1 for concave.
    sign: f64,
}

impl Stretch<'_> {
    /// How far from the virtual edge the zone of these cuts reaches on a flank, mm.
    pub(super) fn reach_of(cut_mm: f64, spacing_mm: f64) -> f64 {
        1.25 * cut_mm + 3.0 * spacing_mm
    }

    fn zone(&self) -> Option<Zone<'_>> {
        let n = self.wedges.len() as f64;
        let turns: Vec<f64> = self.wedges.iter().map(Wedge::turn).collect();
        let turn = turns.iter().sum::<f64>() / n;
        // Flanks within half a degree of one plane have no edge.
        if !(8e-3..=3.0).contains(&turn) {
            return None;
        }
        let reach = [0, 1].map(|i| {
            let cut = self
                .wedges
                .iter()
                .map(|w| w.flanks[i].cut_mm)
                .fold(0.0, f64::max);
            Self::reach_of(cut, self.spacing_mm)
        });
        let squares: f64 = self
            .wedges
            .iter()
            .flat_map(|w| w.flanks)
            .map(|f| f.sigma_mm.powi(2))
            .sum();
        let mut zone = Zone {
            points: Vec::new(),
            stretch: self,
            turns,
            turn,
            reach,
            sigma: (squares / (2.0 * n)).sqrt().max(1e-9),
            sign: if self.convex { 1.0 } else { -1.0 },
        };
        zone.points = self.points.iter().filter_map(|p| zone.seen(p)).collect();
        (zone.points.len() >= POINTS_MIN).then_some(zone)
    }
}

impl Zone<'_> {
    fn seen(&self, p: &ZonePoint) -> Option<WedgePoint> {
        let half = 0.5 * self.stretch.step_mm * (1.0 + 1e-9);
        let wedge = self
            .stretch
            .wedges
            .iter()
            .position(|w| (p.s - w.s).abs() <= half)?;
        let own = &self.stretch.wedges[wedge];
        let d = [0, 1].map(|i| {
            let flank = own.flanks[i].deviation_mm(p.r[i], p.s - own.s);
            self.sign * (p.deviation[i] - flank)
        });
        let along = [0, 1].map(|i| -d[1 - i] / self.turns[wedge].sin());
        let side = usize::from(d[1] > d[0]);
        // A point this far off the edge's own size belongs to something else.
        let near =
            d[side].abs() <= self.reach[0].max(self.reach[1]) && along[side] <= self.reach[side];
        near.then_some(WedgePoint {
            d,
            r: p.r,
            wedge,
            free: p.r[side] < own.flanks[side].cut_mm,
        })
    }
}

/// A stretch with the shape that was chosen for it.
struct Analysis<'a> {
    zone: Zone<'a>,
    fitted: Fitted,
    profile: Profile,
    /// Whether the profile refuses the shape.
    irregular: bool,
}

impl<'a> Analysis<'a> {
    /// `None` where too few points lie near the edge, or the flanks are one plane.
    fn new(stretch: &'a Stretch<'a>) -> Option<Self> {
        let zone = stretch.zone()?;
        let fitted = choose(&zone);
        let profile = Profile::new(&zone);
        let irregular = profile.departs_from(&zone, &fitted.shape());
        Some(Self {
            zone,
            fitted,
            profile,
            irregular,
        })
    }

    fn found(&self) -> Option<Found> {
        let stretch = self.zone.stretch;
        let first = stretch.wedges.first()?;
        let last = stretch.wedges.last()?;
        let mut form = if self.irregular {
            self.profile.form()
        } else {
            of_model(&self.zone, &self.fitted)
        };
        if !self.irregular {
            // An excess beside a shape that fits otherwise.
            form.excess = self.profile.excess();
        }
        let passing = larger(form.excess);
        let largest = if form.missing[0].value >= form.missing[1].value {
            form.missing[0]
        } else {
            form.missing[1]
        };
        let shape = EdgeBreak {
            s_mm: [
                first.s - 0.5 * stretch.step_mm,
                last.s + 0.5 * stretch.step_mm,
            ],
            shape: if self.irregular {
                BreakShape::Irregular
            } else {
                self.fitted.outer(&self.zone)
            },
            detachment_mm: form.detachment,
            truncation_mm: form.truncation,
            // A concave edge has its excess where a convex one misses material.
            burr_mm: if stretch.convex { passing } else { largest },
            undercut_mm: if stretch.convex {
                form.missing
            } else {
                form.excess
            },
            points: self.zone.points.len(),
        };
        Some(Found {
            shape,
            highest: form.highest.map(|x| self.zone.sign * x),
        })
    }
}

/// The larger of two excesses; where there is none, none with the uncertainty of the first.
fn larger(excess: [Quantified; 2]) -> Quantified {
    let nothing = Quantified {
        value: 0.0,
        u: excess[0].u,
    };
    excess
        .into_iter()
        .fold(nothing, |a, b| if b.value > a.value { b } else { a })
}

/// The shape of one stretch; `None` where too few points lie near the edge, or the flanks are one plane.
pub(super) fn measure_stretch(stretch: &Stretch<'_>) -> Option<Found> {
    Analysis::new(stretch)?.found()
}

/// The sizes that every shape has, for a convex edge.
struct Form {
    detachment: [Quantified; 2],
    truncation: Quantified,
    excess: [Quantified; 2],
    missing: [Quantified; 2],
    highest: [f64; 2],
}

/// Sizes of a shape that was fitted, by its geometry; uncertainties by numerical derivatives.
fn of_model(zone: &Zone<'_>, fitted: &Fitted) -> Form {
    let (sin, cos) = (0.5 * zone.turn).sin_cos();
    let legs = fitted.legs(zone.turn);
    let full = zone.turn.sin();
    let missing = [legs[1], legs[0]].map(|q| Quantified {
        value: q.value * full,
        u: q.u * full,
    });
    let (truncation, highest) = match fitted {
        Fitted::Round { radius }
        | Fitted::Undecided {
            radius,
            round: true,
            ..
        } => {
            let per = 1.0 / cos - 1.0;
            let depth = Quantified {
                value: per * radius.value,
                u: per * radius.u,
            };
            (depth, [0.0, -depth.value])
        }
        Fitted::Sharp { radius_below } => {
            let u = (1.0 / cos - 1.0) * radius_below / ONE_SIDED;
            (Quantified { value: 0.0, u }, [0.0, 0.0])
        }
        Fitted::Chamfer {
            legs: [a, b],
            covariance,
        }
        | Fitted::Undecided {
            legs: [a, b],
            covariance,
            ..
        } => {
            let tell = (covariance[0][0] + covariance[1][1] - 2.0 * covariance[0][1])
                .max(0.0)
                .sqrt();
            if (a - b).abs() > 2.0 * tell {
                let i = usize::from(b < a);
                let side = if i == 0 { 1.0 } else { -1.0 };
                let depth = Quantified {
                    value: legs[i].value * sin,
                    u: legs[i].u * sin,
                };
                (depth, [side * legs[i].value * cos, -depth.value])
            } else {
                // As high everywhere: where it crosses the bisector, which no choice between its ends biases.
                let by = [b, a].map(|x| 2.0 * sin * (x / (a + b)).powi(2));
                let variance = by[0] * by[0] * covariance[0][0]
                    + 2.0 * by[0] * by[1] * covariance[0][1]
                    + by[1] * by[1] * covariance[1][1];
                let depth = Quantified {
                    value: 2.0 * sin * a * b / (a + b),
                    u: variance.max(0.0).sqrt(),
                };
                (depth, [0.0, -depth.value])
            }
        }
    };
    Form {
        detachment: legs,
        truncation,
        excess: [Quantified { value: 0.0, u: 0.0 }; 2],
        missing,
        highest,
    }
}

/// Legs with their uncertainties.
fn legs_of(legs: &[f64; 2], covariance: &[[f64; 2]; 2]) -> [Quantified; 2] {
    [0, 1].map(|i| Quantified {
        value: legs[i],
        u: covariance[i][i].max(0.0).sqrt(),
    })
}

/// Angle of a chamfer's plane to the first flank, rad, from its legs and the included angle.
fn chamfer_angle([a, b]: [f64; 2], included_rad: f64) -> f64 {
    let (sin, cos) = included_rad.sin_cos();
    (b * sin).atan2(a - b * cos)
}

impl Fitted {
    fn outer(&self, zone: &Zone<'_>) -> BreakShape {
        match self {
            Self::Sharp { radius_below } => BreakShape::Sharp {
                radius_below_mm: *radius_below,
            },
            Self::Round { radius } => BreakShape::Round { radius_mm: *radius },
            Self::Undecided {
                radius,
                legs,
                covariance,
                ..
            } => BreakShape::Undecided {
                radius_mm: *radius,
                legs_mm: legs_of(legs, covariance),
            },
            Self::Chamfer { legs, covariance } => {
                let included = std::f64::consts::PI - zone.turn;
                let angle = |a: f64, b: f64| chamfer_angle([a, b], included);
                let [a, b] = *legs;
                let step = 1e-4 * a.min(b);
                let by = [
                    (angle(a + step, b) - angle(a - step, b)) / (2.0 * step),
                    (angle(a, b + step) - angle(a, b - step)) / (2.0 * step),
                ];
                let variance = (0..2)
                    .map(|i| {
                        (0..2)
                            .map(|j| by[i] * covariance[i][j] * by[j])
                            .sum::<f64>()
                    })
                    .sum::<f64>();
                BreakShape::Chamfer {
                    legs_mm: self.legs(zone.turn),
                    angle_rad: Quantified {
                        value: angle(a, b),
                        u: variance.max(0.0).sqrt(),
                    },
                }
            }
        }
    }

    /// Distances from the virtual edge to where the shape meets the flanks, mm.
    fn legs(&self, turn: f64) -> [Quantified; 2] {
        let tangent = (0.5 * turn).tan();
        match self {
            Self::Sharp { radius_below } => {
                [Quantified {
                    value: 0.0,
                    u: radius_below * tangent / ONE_SIDED,
                }; 2]
            }
            Self::Round { radius }
            | Self::Undecided {
                radius,
                round: true,
                ..
            } => {
                [Quantified {
                    value: radius.value * tangent,
                    u: radius.u * tangent,
                }; 2]
            }
            Self::Chamfer { legs, covariance }
            | Self::Undecided {
                legs, covariance, ..
            } => legs_of(legs, covariance),
        }
    }

    fn shape(&self) -> Shape {
        match self {
            Self::Sharp { .. } => Shape::Sharp,
            Self::Round { radius }
            | Self::Undecided {
                radius,
                round: true,
                ..
            } => Shape::Round(radius.value),
            Self::Chamfer { legs, .. } | Self::Undecided { legs, .. } => {
                Shape::Chamfer(legs[0], legs[1])
            }
        }
    }
}

#[cfg(test)]
mod tests;
