//! Why the verdict is what it is, and what to do, for the operator.

use super::because::{AdviceCode, Because, ReasonCode};
use super::wire::{Characteristic, Edge, Report, Status};

/// Reason and advice.
pub fn conclude(report: &Report) -> Because {
    match report.verdict {
        Status::NotOk => not_ok(report),
        Status::NotDecidable => not_decidable(report),
        Status::Ok => ok(report),
        Status::Undefined => undefined(report),
    }
}

fn not_ok(report: &Report) -> Because {
    let bad = edges_with(report, Status::NotOk);
    let worst = characteristics_with(report, Status::NotOk).max_by(|a, b| {
        let excess = |(_, c): &(&Edge, &Characteristic)| excess_over_limit(c);
        excess(a).total_cmp(&excess(b))
    });
    let advice = AdviceCode::SetAside;
    match worst {
        Some(worst) => about(worst, ReasonCode::OutsideLimits, advice, bad.len()),
        None if !report.missing_edges.is_empty() => Because {
            names: report.missing_edges.clone(),
            ..Because::plain(ReasonCode::EdgesMissing, advice)
        },
        None if !bad.is_empty() => Because {
            names: bad,
            ..Because::plain(ReasonCode::EdgesOutside, advice)
        },
        None => Because::plain(ReasonCode::PartNotOk, advice),
    }
}

fn not_decidable(report: &Report) -> Because {
    if report.alignment.status >= Status::NotDecidable {
        let weak = &report.alignment.weak_directions;
        let code = if weak.is_empty() {
            ReasonCode::NotAligned
        } else {
            ReasonCode::HeldWeakly
        };
        return Because {
            names: weak.clone(),
            ..Because::plain(code, AdviceCode::FixDirections)
        };
    }
    let open = edges_with(report, Status::NotDecidable);
    let in_zone = characteristics_with(report, Status::NotDecidable).next();
    match in_zone {
        Some(found) => about(
            found,
            ReasonCode::LimitInsideUncertainty,
            AdviceCode::MorePoints,
            open.len(),
        ),
        None => gaps(report, &open),
    }
}

/// A reason that `edges` edges have, told at one of them. One without a value is not said to lie anywhere.
fn about(
    (edge, found): (&Edge, &Characteristic),
    code: ReasonCode,
    advice: AdviceCode,
    edges: usize,
) -> Because {
    let (code, detail) = match found.value {
        Some(_) => (code, String::new()),
        None => (ReasonCode::NoValue, found.reason.clone()),
    };
    Because {
        edge: Some(edge.id.clone()),
        characteristic: Some(found.into()),
        count: edges.saturating_sub(1),
        detail,
        ..Because::plain(code, advice)
    }
}

fn gaps(report: &Report, open: &[String]) -> Because {
    let least = report
        .edges
        .iter()
        .filter(|edge| edge.verdict == Status::NotDecidable)
        .min_by(|a, b| a.coverage.total_cmp(&b.coverage));
    let advice = AdviceCode::ScanAgain;
    match least {
        Some(edge) => Because {
            edge: Some(edge.id.clone()),
            coverage: Some(edge.coverage),
            count: open.len().saturating_sub(1),
            detail: first_reason(edge).unwrap_or_default().to_owned(),
            ..Because::plain(ReasonCode::PartlyMeasured, advice)
        },
        None => Because::plain(ReasonCode::DataInadequate, advice),
    }
}

fn first_reason(edge: &Edge) -> Option<&str> {
    edge.stations
        .iter()
        .map(|station| station.reason.as_str())
        .find(|reason| !reason.is_empty())
}

fn ok(report: &Report) -> Because {
    let judged = characteristics_with(report, Status::Ok).count();
    let tightest = characteristics_with(report, Status::Ok)
        .max_by(|a, b| used_share(a.1).total_cmp(&used_share(b.1)));
    match tightest {
        Some((edge, found)) => Because {
            edge: Some(edge.id.clone()),
            characteristic: Some(found.into()),
            count: judged,
            detail: found.reason.clone(),
            ..Because::plain(ReasonCode::AllWithin, AdviceCode::Pass)
        },
        None => Because::plain(ReasonCode::NoneOutside, AdviceCode::Pass),
    }
}

fn undefined(report: &Report) -> Because {
    if report.edges.is_empty() {
        Because::plain(ReasonCode::NoSharpEdge, AdviceCode::CheckNominal)
    } else if report.edges.iter().all(|edge| edge.summary.measured == 0) {
        Because::plain(ReasonCode::NothingMeasured, AdviceCode::CheckUnit)
    } else {
        Because::plain(ReasonCode::NoLimits, AdviceCode::GiveLimits)
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
