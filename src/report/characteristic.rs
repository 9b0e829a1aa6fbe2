//! Values along an edge put together: spread, worst station, verdict against limits.

use super::wire::{Characteristic, Quantity, Spread, Station, Status};
use crate::inspect::recipe::Rule;

/// One quantity of one station, in the unit of the wire.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Arc length, mm.
    pub s_mm: f64,
    /// The value.
    pub value: f64,
    /// Its standard uncertainty.
    pub u: Option<f64>,
}

/// What a value is judged by.
#[derive(Debug, Clone, Copy)]
pub struct Criterion {
    /// Lower and upper limit; `None` = not evaluated.
    pub limits: Option<[f64; 2]>,
    /// How the uncertainty counts.
    pub rule: Rule,
}

/// `quantity` at one station; `None` where it was not measured.
pub fn sample(station: &Station, quantity: Quantity) -> Option<Sample> {
    let (value, u) = match quantity {
        Quantity::D1 => (station.d1_mm, station.u_d1_mm),
        Quantity::D2 => (station.d2_mm, station.u_d2_mm),
        Quantity::AngleDeviation => (
            station
                .included_angle_deg
                .map(|angle| angle - station.nominal_included_angle_deg),
            station.u_included_angle_deg,
        ),
    };
    value.map(|value| Sample {
        s_mm: station.s_mm,
        value,
        u,
    })
}

/// The measured values of `quantity` along the edge, in order.
pub fn samples(stations: &[Station], quantity: Quantity) -> Vec<Sample> {
    stations
        .iter()
        .filter_map(|station| sample(station, quantity))
        .collect()
}

/// The verdict of one value against its limits.
///
/// # Source
/// ISO 14253-1:2017: conformity and non-conformity are both proven only outside the uncertainty zone of the limits.
pub fn judge(value: f64, u: Option<f64>, criterion: Criterion) -> Status {
    let Some([lower, upper]) = criterion.limits else {
        return Status::Undefined;
    };
    let zone = match (criterion.rule, u) {
        (Rule::Simple, _) => 0.0,
        (Rule::GuardBand(k), Some(u)) => k * u,
        (Rule::GuardBand(_), None) => return Status::NotDecidable,
    };
    if value - zone > upper || value + zone < lower {
        Status::NotOk
    } else if value - zone >= lower && value + zone <= upper {
        Status::Ok
    } else {
        Status::NotDecidable
    }
}

/// How the values run along the edge; `None` where there are none.
pub fn spread(samples: &[Sample], limits: Option<[f64; 2]>) -> Option<Spread> {
    let worst = samples.iter().copied().reduce(|a, b| {
        if badness(&b, limits) > badness(&a, limits) {
            b
        } else {
            a
        }
    })?;
    let values = || samples.iter().map(|sample| sample.value);
    Some(Spread {
        worst: worst.value,
        u_worst: worst.u,
        s_worst_mm: worst.s_mm,
        mean: values().sum::<f64>() / samples.len() as f64,
        min: values().fold(f64::INFINITY, f64::min),
        max: values().fold(f64::NEG_INFINITY, f64::max),
    })
}

/// The larger, the nearer to a limit or the farther outside.
fn badness(sample: &Sample, limits: Option<[f64; 2]>) -> f64 {
    match limits {
        Some([lower, upper]) => (sample.value - upper).max(lower - sample.value),
        None => sample.value.abs(),
    }
}

/// The characteristic of `quantity` on edge `edge`: its worst value and the worst verdict of its stations.
pub fn characteristic(
    edge: &str,
    quantity: Quantity,
    samples: &[Sample],
    criterion: Criterion,
) -> Characteristic {
    let (name, unit) = match quantity {
        Quantity::D1 => ("d1", "mm"),
        Quantity::D2 => ("d2", "mm"),
        Quantity::AngleDeviation => ("angle", "deg"),
    };
    let limits = criterion.limits;
    let worst = spread(samples, limits);
    let verdicts = samples
        .iter()
        .map(|sample| judge(sample.value, sample.u, criterion));
    Characteristic {
        id: format!("{edge}.{name}"),
        quantity,
        unit: unit.to_owned(),
        value: worst.map(|worst| worst.worst),
        u: worst.and_then(|worst| worst.u_worst),
        s_mm: worst.map(|worst| worst.s_worst_mm),
        lower: limits.map(|limits| limits[0]),
        upper: limits.map(|limits| limits[1]),
        verdict: verdicts.max().unwrap_or(Status::Undefined),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn within(limits: Option<[f64; 2]>, rule: Rule) -> Criterion {
        Criterion { limits, rule }
    }

    const BAND: Rule = Rule::GuardBand(2.0);

    #[test]
    fn the_guard_band_splits_the_line_into_five() {
        let verdict = |value| judge(value, Some(0.01), within(Some([-0.1, 0.1]), BAND));
        assert_eq!(verdict(-0.13), Status::NotOk);
        assert_eq!(verdict(-0.11), Status::NotDecidable);
        assert_eq!(verdict(-0.09), Status::NotDecidable);
        assert_eq!(verdict(0.0), Status::Ok);
        assert_eq!(verdict(0.07), Status::Ok);
        assert_eq!(verdict(0.09), Status::NotDecidable);
        assert_eq!(verdict(0.13), Status::NotOk);
    }

    #[test]
    fn an_uncertainty_zone_wider_than_the_limits_decides_nothing() {
        assert_eq!(
            judge(0.0, Some(1.0), within(Some([-0.1, 0.1]), BAND)),
            Status::NotDecidable
        );
        assert_eq!(
            judge(0.0, None, within(Some([-0.1, 0.1]), BAND)),
            Status::NotDecidable
        );
    }

    #[test]
    fn without_limits_nothing_is_evaluated_and_the_simple_rule_needs_no_uncertainty() {
        assert_eq!(judge(5.0, Some(0.1), within(None, BAND)), Status::Undefined);
        assert_eq!(
            judge(0.1, None, within(Some([-0.1, 0.1]), Rule::Simple)),
            Status::Ok
        );
        assert_eq!(
            judge(0.2, None, within(Some([-0.1, 0.1]), Rule::Simple)),
            Status::NotOk
        );
    }

    #[test]
    fn the_worst_value_is_the_one_nearest_to_its_limit() {
        let at = |s_mm, value| Sample {
            s_mm,
            value,
            u: None,
        };
        let values = [at(0.0, -0.05), at(1.0, 0.04), at(2.0, 0.0)];
        let one_sided = spread(&values, Some([-1.0, 0.05])).expect("three values");
        assert_eq!((one_sided.worst, one_sided.s_worst_mm), (0.04, 1.0));
        let free = spread(&values, None).expect("three values");
        assert_eq!((free.worst, free.s_worst_mm), (-0.05, 0.0));
        assert_eq!(spread(&[], None), None);
    }
}
