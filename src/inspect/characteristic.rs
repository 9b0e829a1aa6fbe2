//! The values of an edge that can be judged: the worst of a quantity along the edge, its statistics, its verdict.
//!
//! Source: features-and-standards, section 5, characteristics 22 (worst point), 24 (statistics), 25 (verdict).

use super::quantity::{Extent, LimitSource, Limits, Quantity};
use super::recipe::Rule;
use super::result::{BreakShape, EdgeBreak, EdgeForm, Quantified, StationResult, Verdict};
use super::verdict::judge;
use super::virtual_edge::nominal_angle;
use crate::nominal::EdgeKind;

/// A quantity of an edge, with its limits and its verdict. Lengths in mm, angles in rad.
#[derive(Debug, Clone, PartialEq)]
pub struct Characteristic {
    /// What it is.
    pub quantity: Quantity,
    /// The value nearest to a limit or farthest outside, without limits the one farthest from zero; `None` = not measured.
    pub value: Option<Quantified>,
    /// Arc length of that value, or the middle of its stretch, mm; `None` for a quantity of the whole edge.
    pub s_mm: Option<f64>,
    /// Lower and upper limit.
    pub limits: Option<[f64; 2]>,
    /// Where they come from.
    pub limits_from: Option<LimitSource>,
    /// Worst verdict of all its values.
    pub verdict: Verdict,
    /// Why it has no value, or why it is not decidable; empty otherwise.
    pub reason: String,
    /// How the values run along the edge; `None` where there are none.
    pub statistics: Option<Statistics>,
}

/// Values along an edge in a few numbers, in the unit of the quantity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Statistics {
    /// How many.
    pub count: usize,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (n - 1); 0 of a single value.
    pub standard_deviation: f64,
    /// Root mean square.
    pub rms: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// 2.5 and 97.5 per cent of the values lie below these, linear between order statistics.
    pub percentiles: [f64; 2],
    /// Share outside the limits, by the value alone; `None` without limits.
    pub outside: Option<f64>,
}

/// One value at a place of the edge.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Sample {
    s_mm: Option<f64>,
    value: Quantified,
}

/// What was measured of one edge.
#[derive(Debug, Clone, Copy)]
pub struct EdgeValues<'a> {
    /// Convex or concave.
    pub kind: EdgeKind,
    /// Its stations.
    pub stations: &'a [StationResult],
    /// The shape of the edge itself.
    pub breaks: &'a [EdgeBreak],
    /// The edge as a curve.
    pub form: Option<&'a EdgeForm>,
}

/// All characteristics of an edge: every quantity of a station, and of the others those that were measured or have limits.
pub fn characteristics(edge: &EdgeValues<'_>, limits: &Limits, rule: Rule) -> Vec<Characteristic> {
    Quantity::all()
        .filter_map(|quantity| {
            let source = limits.source(quantity);
            let limits = limits.of(quantity);
            let samples = samples(edge, quantity);
            let wanted = always(quantity) || !samples.is_empty() || limits.is_some();
            wanted.then(|| Characteristic {
                limits_from: source,
                ..of_samples(edge, quantity, &samples, limits, rule)
            })
        })
        .collect()
}

/// The three that every edge answers for, measured or not.
fn always(quantity: Quantity) -> bool {
    matches!(
        quantity,
        Quantity::D1 | Quantity::D2 | Quantity::AngleDeviation
    )
}

/// `quantity` at one station; `None` where it was not measured, or belongs to no station. A boundary has the d of the flank that was seen.
pub fn at_station(
    station: &StationResult,
    kind: EdgeKind,
    quantity: Quantity,
) -> Option<Quantified> {
    if let Some(boundary) = &station.boundary {
        let own = [Quantity::D1, Quantity::D2][boundary.flank];
        return (quantity == own).then_some(boundary.d_mm);
    }
    let measured = station.measured.as_ref()?;
    let d = |i: usize| Quantified {
        value: measured.d_mm[i],
        u: measured.u_d_mm[i],
    };
    match quantity {
        Quantity::Total => Some(measured.total_mm),
        Quantity::D1 => Some(d(0)),
        Quantity::D2 => Some(d(1)),
        Quantity::AngleDeviation => Some(Quantified {
            value: measured.included_angle_rad - nominal_angle(&station.station, kind),
            u: measured.u_included_angle_rad,
        }),
        _ => None,
    }
}

fn samples(edge: &EdgeValues<'_>, quantity: Quantity) -> Vec<Sample> {
    match quantity.extent() {
        Extent::Station => edge
            .stations
            .iter()
            .filter_map(|station| {
                Some(Sample {
                    s_mm: Some(station.station.s_mm),
                    value: at_station(station, edge.kind, quantity)?,
                })
            })
            .collect(),
        Extent::Stretch => edge
            .breaks
            .iter()
            .filter_map(|stretch| {
                Some(Sample {
                    s_mm: Some(0.5 * (stretch.s_mm[0] + stretch.s_mm[1])),
                    value: of_break(stretch, quantity)?,
                })
            })
            .collect(),
        Extent::Edge => edge
            .form
            .and_then(|form| of_form(form, quantity))
            .map(|(value, s_mm)| Sample { s_mm, value })
            .into_iter()
            .collect(),
    }
}

fn of_break(stretch: &EdgeBreak, quantity: Quantity) -> Option<Quantified> {
    match (quantity, stretch.shape) {
        (Quantity::BreakRadius, BreakShape::Round { radius_mm }) => Some(radius_mm),
        (Quantity::ChamferLeg1, BreakShape::Chamfer { legs_mm, .. }) => Some(legs_mm[0]),
        (Quantity::ChamferLeg2, BreakShape::Chamfer { legs_mm, .. }) => Some(legs_mm[1]),
        (Quantity::ChamferAngle, BreakShape::Chamfer { angle_rad, .. }) => Some(angle_rad),
        (Quantity::Truncation, _) => Some(stretch.truncation_mm),
        (Quantity::Burr, _) => Some(stretch.burr_mm),
        (Quantity::Undercut1, _) => Some(stretch.undercut_mm[0]),
        (Quantity::Undercut2, _) => Some(stretch.undercut_mm[1]),
        _ => None,
    }
}

fn of_form(form: &EdgeForm, quantity: Quantity) -> Option<(Quantified, Option<f64>)> {
    match quantity {
        Quantity::Straightness => Some((form.straightness_mm?, None)),
        Quantity::LineProfile => Some((form.line_profile_mm, Some(form.s_worst_mm))),
        Quantity::LineForm => Some((form.line_form_mm?, None)),
        Quantity::Direction => form.direction_rad.map(|(value, s_mm)| (value, Some(s_mm))),
        _ => None,
    }
}

fn of_samples(
    edge: &EdgeValues<'_>,
    quantity: Quantity,
    samples: &[Sample],
    limits: Option<[f64; 2]>,
    rule: Rule,
) -> Characteristic {
    let worst = samples.iter().copied().reduce(|a, b| {
        if badness(b.value.value, limits) > badness(a.value.value, limits) {
            b
        } else {
            a
        }
    });
    let mut verdict = samples
        .iter()
        .map(|sample| judge(sample.value.value, sample.value.u, limits, rule))
        .fold(Verdict::Undefined, Verdict::max);
    let mut reason = String::new();
    if verdict == Verdict::NotDecidable {
        reason = "a limit lies inside the uncertainty".to_owned();
    }
    if let Some(limits) = limits {
        let (bounded, why) = without_value(edge, quantity, limits);
        if !why.is_empty() && bounded >= verdict {
            reason = why;
        }
        verdict = verdict.max(bounded);
    }
    Characteristic {
        quantity,
        value: worst.map(|worst| worst.value),
        s_mm: worst.and_then(|worst| worst.s_mm),
        limits,
        limits_from: None,
        verdict,
        reason,
        statistics: statistics(samples.iter().map(|s| s.value.value), limits),
    }
}

/// What the stretches say whose shape has no value of `quantity`: a radius is known to be below a bound where the edge is sharp, and a
/// chamfer is no radius.
fn without_value(
    edge: &EdgeValues<'_>,
    quantity: Quantity,
    [lower, upper]: [f64; 2],
) -> (Verdict, String) {
    let mut worst = (Verdict::Undefined, String::new());
    if quantity.extent() != Extent::Stretch {
        return worst;
    }
    if edge.breaks.is_empty() {
        return (
            Verdict::NotDecidable,
            "the edge itself was not seen".to_owned(),
        );
    }
    for stretch in edge.breaks {
        if of_break(stretch, quantity).is_some() {
            continue;
        }
        let found = match (quantity, stretch.shape) {
            (Quantity::BreakRadius, BreakShape::Sharp { radius_below_mm }) => {
                let verdict = if radius_below_mm <= upper && lower <= 0.0 {
                    Verdict::Ok
                } else if radius_below_mm < lower {
                    Verdict::NotOk
                } else {
                    Verdict::NotDecidable
                };
                (
                    verdict,
                    format!("the radius is below {radius_below_mm:.3} mm"),
                )
            }
            (_, BreakShape::Undecided { radius_mm, legs_mm }) => (
                undecided(quantity, radius_mm, legs_mm, [lower, upper]),
                "the data do not tell a radius from a chamfer".to_owned(),
            ),
            (_, BreakShape::Sharp { .. }) => (Verdict::NotOk, "the edge is sharp".to_owned()),
            (_, BreakShape::Round { .. }) => (Verdict::NotOk, "the edge is round".to_owned()),
            (_, BreakShape::Chamfer { .. }) => {
                (Verdict::NotOk, "the edge has a chamfer".to_owned())
            }
            (_, BreakShape::Irregular) => (
                Verdict::NotOk,
                "the edge has neither a radius nor a chamfer".to_owned(),
            ),
        };
        if found.0 > worst.0 {
            worst = found;
        }
    }
    worst
}

/// Where the shape is not decided an upper limit alone may still be kept, whichever it is: an edge that is broken by little enough.
fn undecided(
    quantity: Quantity,
    radius: Quantified,
    legs: [Quantified; 2],
    [lower, upper]: [f64; 2],
) -> Verdict {
    let size = match quantity {
        Quantity::BreakRadius => radius,
        Quantity::ChamferLeg1 => legs[0],
        Quantity::ChamferLeg2 => legs[1],
        _ => return Verdict::NotDecidable,
    };
    if lower <= 0.0 && size.value + 2.0 * size.u <= upper {
        Verdict::Ok
    } else {
        Verdict::NotDecidable
    }
}

/// The larger, the nearer to a limit or the farther outside.
fn badness(value: f64, limits: Option<[f64; 2]>) -> f64 {
    match limits {
        Some([lower, upper]) => (value - upper).max(lower - value),
        None => value.abs(),
    }
}

/// Of the finite ones of `values`; `None` where there is none.
pub fn statistics(
    values: impl Iterator<Item = f64>,
    limits: Option<[f64; 2]>,
) -> Option<Statistics> {
    let mut sorted: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let (min, max) = (*sorted.first()?, *sorted.last()?);
    let n = sorted.len() as f64;
    let mean = sorted.iter().sum::<f64>() / n;
    let spread = sorted.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    let percentile = |share: f64| {
        let at = share * (n - 1.0);
        let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
        below + (above - below) * at.fract()
    };
    let outside = limits.map(|[lower, upper]| {
        let outside = sorted.iter().filter(|v| **v < lower || **v > upper);
        outside.count() as f64 / n
    });
    Some(Statistics {
        count: sorted.len(),
        mean,
        standard_deviation: (spread / (n - 1.0).max(1.0)).sqrt(),
        rms: (sorted.iter().map(|v| v * v).sum::<f64>() / n).sqrt(),
        min,
        max,
        percentiles: [percentile(0.025), percentile(0.975)],
        outside,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(s_mm: f64, value: f64) -> Sample {
        Sample {
            s_mm: Some(s_mm),
            value: Quantified { value, u: 0.001 },
        }
    }

    fn edge<'a>(breaks: &'a [EdgeBreak]) -> EdgeValues<'a> {
        EdgeValues {
            kind: EdgeKind::Convex,
            stations: &[],
            breaks,
            form: None,
        }
    }

    fn stretch(shape: BreakShape) -> EdgeBreak {
        let zero = Quantified {
            value: 0.0,
            u: 0.01,
        };
        EdgeBreak {
            s_mm: [0.0, 10.0],
            shape,
            detachment_mm: [zero; 2],
            truncation_mm: zero,
            burr_mm: zero,
            undercut_mm: [zero; 2],
            points: 100,
        }
    }

    #[test]
    fn the_worst_value_is_the_one_nearest_to_its_limit() {
        let values = [at(0.0, -0.05), at(1.0, 0.04), at(2.0, 0.0)];
        let of = |limits| of_samples(&edge(&[]), Quantity::D1, &values, limits, Rule::Simple);
        let one_sided = of(Some([-1.0, 0.05]));
        assert_eq!(one_sided.s_mm, Some(1.0));
        assert_eq!(one_sided.verdict, Verdict::Ok);
        assert_eq!(of(None).s_mm, Some(0.0));
        assert_eq!(of(None).verdict, Verdict::Undefined);
    }

    /// Against values worked by hand: 1, 2, 3, 4.
    #[test]
    fn statistics_are_those_of_the_textbook() {
        let s = statistics([4.0, 2.0, f64::NAN, 1.0, 3.0].into_iter(), Some([1.5, 9.0]))
            .expect("four values");
        assert_eq!((s.count, s.mean, s.min, s.max), (4, 2.5, 1.0, 4.0));
        assert!((s.standard_deviation - (5.0f64 / 3.0).sqrt()).abs() < 1e-15);
        assert!((s.rms - 7.5f64.sqrt()).abs() < 1e-15);
        assert!((s.percentiles[0] - 1.075).abs() < 1e-12);
        assert_eq!(s.outside, Some(0.25));
        assert_eq!(statistics([f64::NAN].into_iter(), None), None);
    }

    #[test]
    fn a_radius_that_the_data_cannot_tell_is_judged_by_its_bound() {
        let sharp = [stretch(BreakShape::Sharp {
            radius_below_mm: 0.05,
        })];
        let judged = |limits| {
            let limits = Limits::default().with(Quantity::BreakRadius, limits);
            let all = characteristics(&edge(&sharp), &limits, Rule::GuardBand(2.0));
            let radius = all.iter().find(|c| c.quantity == Quantity::BreakRadius);
            radius.expect("it has limits").clone()
        };
        assert_eq!(judged([0.0, 0.1]).verdict, Verdict::Ok);
        assert_eq!(judged([0.1, 0.3]).verdict, Verdict::NotOk);
        let open = judged([0.02, 0.3]);
        assert_eq!(open.verdict, Verdict::NotDecidable);
        assert_eq!(open.reason, "the radius is below 0.050 mm");
        assert_eq!(open.value, None);
    }

    #[test]
    fn a_shape_that_is_not_decided_keeps_an_upper_limit_or_decides_nothing() {
        let size = |value| Quantified { value, u: 0.005 };
        let either = [stretch(BreakShape::Undecided {
            radius_mm: size(0.05),
            legs_mm: [size(0.04); 2],
        })];
        let judged = |quantity, limits| {
            let limits = Limits::default().with(quantity, limits);
            let all = characteristics(&edge(&either), &limits, Rule::Simple);
            let found = all.iter().find(|c| c.quantity == quantity);
            found.map(|c| c.verdict)
        };
        let none = f64::NEG_INFINITY;
        let radius = Quantity::BreakRadius;
        assert_eq!(judged(radius, [none, 0.2]), Some(Verdict::Ok));
        assert_eq!(judged(radius, [none, 0.055]), Some(Verdict::NotDecidable));
        assert_eq!(judged(radius, [0.02, 0.2]), Some(Verdict::NotDecidable));
        let leg = Quantity::ChamferLeg2;
        assert_eq!(judged(leg, [none, 0.2]), Some(Verdict::Ok));
    }

    #[test]
    fn another_shape_than_the_one_with_limits_is_not_ok_and_nothing_seen_decides_nothing() {
        let limits = Limits::default().with(Quantity::ChamferLeg1, [0.2, 0.4]);
        let leg = |breaks: &[EdgeBreak]| {
            let all = characteristics(&edge(breaks), &limits, Rule::Simple);
            let leg = all.iter().find(|c| c.quantity == Quantity::ChamferLeg1);
            leg.map(|c| (c.verdict, c.reason.clone()))
                .expect("it has limits")
        };
        let round = [stretch(BreakShape::Round {
            radius_mm: Quantified {
                value: 0.2,
                u: 0.01,
            },
        })];
        assert_eq!(
            leg(&round),
            (Verdict::NotOk, "the edge is round".to_owned())
        );
        assert_eq!(leg(&[]).0, Verdict::NotDecidable);
    }
}
