//! Characteristics of an edge on the wire: units changed, nothing that is not finite let through.

use super::build::{finite, status_from_verdict};
use super::wire::{self, Spread, Station};
use crate::inspect::characteristic::Characteristic;
use crate::inspect::quantity::{LimitSource, Quantity};
use crate::inspect::recipe::Rule;
use crate::inspect::result::Budget;
use crate::inspect::verdict::conformance;

/// One quantity of one station, in the unit of the wire.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// The value.
    pub value: f64,
    /// Its standard uncertainty.
    pub u: Option<f64>,
}

/// `quantity` at one station; `None` where it was not measured, or belongs to no station.
pub fn sample(station: &Station, quantity: Quantity) -> Option<Sample> {
    let of_boundary = |flank: usize| {
        let seen = station.boundary.filter(|seen| seen.flank == flank);
        seen.map_or((None, None), |seen| (seen.d_mm.value, seen.d_mm.u))
    };
    let (value, u) = match quantity {
        Quantity::D1 if station.boundary.is_some() => of_boundary(1),
        Quantity::D2 if station.boundary.is_some() => of_boundary(2),
        Quantity::D1 => (station.d1_mm, station.u_d1_mm),
        Quantity::D2 => (station.d2_mm, station.u_d2_mm),
        Quantity::AngleDeviation => (
            station
                .included_angle_deg
                .map(|angle| angle - station.nominal_included_angle_deg),
            station.u_included_angle_deg,
        ),
        Quantity::Total => match station.total_mm {
            Some(total) => (total.value, total.u),
            None => (None, None),
        },
        _ => (None, None),
    };
    value.map(|value| Sample { value, u })
}

/// `found` of edge `edge` as the wire shows it.
pub fn on_the_wire(
    edge: &str,
    found: &Characteristic,
    rule: Rule,
    budget: Option<Budget>,
) -> wire::Characteristic {
    let unit = found.quantity.unit();
    let outside = |value: f64| finite(unit.outside(value));
    let limit = |side: usize| found.limits.and_then(|limits| outside(limits[side]));
    let probability = match (found.value, found.limits) {
        (Some(value), Some(limits)) if value.value.is_finite() && value.u.is_finite() => {
            finite(conformance(value.value, value.u, limits))
        }
        _ => None,
    };
    wire::Characteristic {
        id: format!("{edge}.{}", found.quantity.id()),
        quantity: found.quantity,
        unit: unit.name().to_owned(),
        value: found.value.and_then(|value| outside(value.value)),
        u: found.value.and_then(|value| outside(value.u)),
        s_mm: found.s_mm.and_then(finite),
        lower: limit(0),
        upper: limit(1),
        limits_from: found.limits_from.map(|source| match source {
            LimitSource::Recipe => "recipe".to_owned(),
            LimitSource::Pmi(entity) => format!("#{entity}"),
        }),
        conformance: probability.filter(|_| rule != Rule::Simple),
        verdict: status_from_verdict(found.verdict),
        reason: found.reason.clone(),
        budget: budget.map(|budget| wire::Budget {
            points: outside(budget.points),
            alignment: outside(budget.alignment),
            calibration: outside(budget.calibration),
            temperature: outside(budget.temperature),
        }),
    }
}

/// How the values of `found` run along the edge; `None` where there are none.
pub fn spread(found: &Characteristic) -> Option<Spread> {
    let statistics = found.statistics?;
    let worst = found.value?;
    let unit = found.quantity.unit();
    let outside = |value: f64| finite(unit.outside(value));
    Some(Spread {
        worst: outside(worst.value)?,
        u_worst: outside(worst.u),
        s_worst_mm: finite(found.s_mm?)?,
        mean: outside(statistics.mean)?,
        min: outside(statistics.min)?,
        max: outside(statistics.max)?,
        standard_deviation: outside(statistics.standard_deviation),
        rms: outside(statistics.rms),
        percentile_2_5: outside(statistics.percentiles[0]),
        percentile_97_5: outside(statistics.percentiles[1]),
        outside_share: statistics.outside,
    })
}
