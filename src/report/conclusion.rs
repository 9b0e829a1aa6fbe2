//! Why the verdict is what it is, and what to do, in two sentences for the operator.

use super::figure::Figure;
use super::wire::{Characteristic, Edge, Report, Status};

/// Reason and advice.
pub fn conclude(report: &Report) -> (String, String) {
    match report.verdict {
        Status::NotOk => not_ok(report),
        Status::NotDecidable => not_decidable(report),
        Status::Ok => ok(report),
        Status::Undefined => undefined(report),
    }
}

fn not_ok(report: &Report) -> (String, String) {
    let bad = edges_with(report, Status::NotOk);
    let worst = characteristics_with(report, Status::NotOk).max_by(|a, b| {
        let excess = |(_, c): &(&Edge, &Characteristic)| excess_over_limit(c);
        excess(a).total_cmp(&excess(b))
    });
    let reason = match worst {
        Some((edge, characteristic)) => format!(
            "{}: {}{}",
            edge.id,
            outside(characteristic),
            others(bad.len())
        ),
        None if !report.missing_edges.is_empty() => format!(
            "the scan has no edge where the nominal has {}",
            list(&report.missing_edges)
        ),
        None if !bad.is_empty() => format!("outside the limits: {}", list(&bad)),
        None => "the inspection found the part not OK".to_owned(),
    };
    let advice = "set the part aside; look at the marked place before anything is reworked";
    (reason, advice.to_owned())
}

fn not_decidable(report: &Report) -> (String, String) {
    if report.alignment.status >= Status::NotDecidable {
        let weak = &report.alignment.weak_directions;
        let reason = if weak.is_empty() {
            "the scan could not be aligned to the nominal well enough".to_owned()
        } else {
            format!("the scan holds the part only weakly: {}", list(weak))
        };
        let advice =
            "scan surfaces that fix these directions, or touch datum faces, then measure again";
        return (reason, advice.to_owned());
    }
    let open = edges_with(report, Status::NotDecidable);
    let in_zone = characteristics_with(report, Status::NotDecidable).next();
    match in_zone {
        Some((edge, characteristic)) => (
            format!(
                "{}: {}{}",
                edge.id,
                inside_zone(characteristic),
                others(open.len())
            ),
            "measure again with more points on both sides of the edge, so that the uncertainty shrinks"
                .to_owned(),
        ),
        None => (
            gaps(report, &open),
            "scan the missing stretches again, from a direction that sees both sides of the edge"
                .to_owned(),
        ),
    }
}

fn gaps(report: &Report, open: &[String]) -> String {
    let least = report
        .edges
        .iter()
        .filter(|edge| edge.verdict == Status::NotDecidable)
        .min_by(|a, b| a.coverage.total_cmp(&b.coverage));
    match least {
        Some(edge) => format!(
            "{}: {:.0} % of the edge was measured{}{}",
            edge.id,
            edge.coverage * 100.0,
            first_reason(edge).map_or_else(String::new, |reason| format!(" ({reason})")),
            others(open.len())
        ),
        None => "the data do not allow a verdict".to_owned(),
    }
}

fn first_reason(edge: &Edge) -> Option<&str> {
    edge.stations
        .iter()
        .map(|station| station.reason.as_str())
        .find(|reason| !reason.is_empty())
}

fn ok(report: &Report) -> (String, String) {
    let judged = characteristics_with(report, Status::Ok).count();
    let tightest = characteristics_with(report, Status::Ok)
        .max_by(|a, b| used_share(a.1).total_cmp(&used_share(b.1)));
    let reason = match tightest {
        Some((edge, characteristic)) => format!(
            "all {judged} values are within their limits; nearest to one is {}, where {}{}",
            edge.id,
            stated(characteristic),
            limits(characteristic)
        ),
        None => "nothing is outside its limits".to_owned(),
    };
    (reason, "the part may pass".to_owned())
}

fn undefined(report: &Report) -> (String, String) {
    if report.edges.is_empty() {
        (
            "the nominal has no sharp edge to measure".to_owned(),
            "check that the right nominal was given".to_owned(),
        )
    } else if report.edges.iter().all(|edge| edge.summary.measured == 0) {
        (
            "no edge was measured".to_owned(),
            "check that scan and nominal are the same part, in the same unit".to_owned(),
        )
    } else {
        (
            "no limits were given, so the values are stated and not judged".to_owned(),
            "give limits in a recipe to get a verdict".to_owned(),
        )
    }
}

fn edges_with(report: &Report, status: Status) -> Vec<String> {
    report
        .edges
        .iter()
        .filter(|edge| edge.verdict == status)
        .map(|edge| edge.id.clone())
        .collect()
}

fn characteristics_with(
    report: &Report,
    status: Status,
) -> impl Iterator<Item = (&Edge, &Characteristic)> {
    report
        .edges
        .iter()
        .flat_map(|edge| edge.characteristics.iter().map(move |c| (edge, c)))
        .filter(move |(_, characteristic)| characteristic.verdict == status)
}

/// How far outside its limits, as a share of their width, so that mm and degrees compare.
fn excess_over_limit(characteristic: &Characteristic) -> f64 {
    used_share(characteristic) - 1.0
}

/// 0 in the middle of the limits, 1 at a limit, more outside.
pub fn used_share(characteristic: &Characteristic) -> f64 {
    match (
        characteristic.value,
        characteristic.lower,
        characteristic.upper,
    ) {
        (Some(value), Some(lower), Some(upper)) if upper > lower => {
            (value - 0.5 * (lower + upper)).abs() / (0.5 * (upper - lower))
        }
        (Some(value), None, Some(upper)) if upper > 0.0 => value / upper,
        (Some(value), Some(lower), None) if value > 0.0 => lower / value,
        (Some(_), None, None) | (None, ..) => 0.0,
        (Some(_), ..) => f64::MAX,
    }
}

fn outside(characteristic: &Characteristic) -> String {
    if characteristic.value.is_none() {
        return format!("{}{}", stated(characteristic), limits(characteristic));
    }
    format!(
        "{}, outside its limits{}",
        stated(characteristic),
        limits(characteristic)
    )
}

fn inside_zone(characteristic: &Characteristic) -> String {
    if characteristic.value.is_none() {
        return format!("{}{}", stated(characteristic), limits(characteristic));
    }
    format!(
        "{}; a limit lies inside this uncertainty{}",
        stated(characteristic),
        limits(characteristic)
    )
}

/// ` (−100 to +100 µm)`.
fn limits(characteristic: &Characteristic) -> String {
    let figure = |limit| Figure::of(characteristic.quantity, limit, None);
    match (characteristic.lower, characteristic.upper) {
        (Some(lower), Some(upper)) => {
            format!(
                " ({} to {})",
                figure(lower).value,
                figure(upper).with_unit()
            )
        }
        (None, Some(upper)) => format!(" (at most {})", figure(upper).with_unit()),
        (Some(lower), None) => format!(" (at least {})", figure(lower).with_unit()),
        (None, None) => String::new(),
    }
}

/// `d1 is +152 µm (U 12 µm) at 12.4 mm along the edge`.
pub fn stated(characteristic: &Characteristic) -> String {
    let name = characteristic.quantity.words();
    let Some(value) = characteristic.value else {
        return match characteristic.reason.as_str() {
            "" => format!("{name} was not measured"),
            reason => format!("{name} has no value: {reason}"),
        };
    };
    let figure = Figure::of(characteristic.quantity, value, characteristic.u);
    let place = characteristic
        .s_mm
        .map_or_else(String::new, |s| format!(" at {s:.1} mm along the edge"));
    format!("{name} is {}{place}", figure.with_uncertainty())
}

fn others(count: usize) -> String {
    match count {
        0 | 1 => String::new(),
        2 => "; one more edge likewise".to_owned(),
        more => format!("; {} more edges likewise", more - 1),
    }
}

/// At most five words of a list, then a count.
fn list(items: &[String]) -> String {
    const SHOWN: usize = 5;
    let shown = items
        .iter()
        .take(SHOWN)
        .cloned()
        .collect::<Vec<_>>()
        .join(", ");
    match items.len().saturating_sub(SHOWN) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}
