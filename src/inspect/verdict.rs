//! From values with uncertainty and limits to verdicts; the worst rules upward.
//!
//! Source: features-and-standards, section 4.10 (ISO 14253-1) and characteristic 25.

use super::recipe::{Limits, Rule};
use super::result::{Measured, Verdict};

/// The verdict on a value: within the limits, outside, or a limit inside the uncertainty zone; without limits `Undefined`.
pub fn judge(value: f64, u: f64, limits: Option<[f64; 2]>, rule: Rule) -> Verdict {
    let Some([lower, upper]) = limits else {
        return Verdict::Undefined;
    };
    if !value.is_finite() || !u.is_finite() {
        return Verdict::NotDecidable;
    }
    let zone = match rule {
        Rule::Simple => 0.0,
        Rule::GuardBand(k) => k * u,
    };
    if value - zone >= lower && value + zone <= upper {
        Verdict::Ok
    } else if value + zone < lower || value - zone > upper {
        Verdict::NotOk
    } else {
        Verdict::NotDecidable
    }
}

/// The worst verdict on the values of a station, and the reason where it is `NotDecidable`.
pub fn judge_station(
    measured: &Measured,
    nominal_angle_rad: f64,
    limits: &Limits,
    rule: Rule,
) -> (Verdict, String) {
    let deviation = measured.included_angle_rad - nominal_angle_rad;
    let values = [
        ("d1", measured.d_mm[0], measured.u_d_mm[0], limits.d_mm[0]),
        ("d2", measured.d_mm[1], measured.u_d_mm[1], limits.d_mm[1]),
        (
            "included angle",
            deviation,
            measured.u_included_angle_rad,
            limits.angle_rad,
        ),
    ];
    let mut worst = Verdict::Undefined;
    let mut reasons = Vec::new();
    for (name, value, u, limits) in values {
        let verdict = judge(value, u, limits, rule);
        if verdict == Verdict::NotDecidable {
            reasons.push(format!("a limit of {name} lies inside its uncertainty"));
        }
        worst = worst.max(verdict);
    }
    let reason = if worst == Verdict::NotDecidable {
        reasons.join("; ")
    } else {
        String::new()
    };
    (worst, reason)
}

/// The verdict on an edge: the worst of its stations, and `NotDecidable` where it has limits but too little was measured.
pub fn judge_edge(
    stations: impl Iterator<Item = Verdict>,
    coverage: f64,
    minimum_coverage: f64,
    limits: &Limits,
) -> Verdict {
    let worst = stations.fold(Verdict::Undefined, Verdict::max);
    if !limits.is_empty() && coverage < minimum_coverage {
        worst.max(Verdict::NotDecidable)
    } else {
        worst
    }
}

/// The verdict on the part: the worst edge; an alignment that is not decidable leaves nothing `Ok`, and values outside their
/// limits undecided, because the limits are counted from the wrong place.
pub fn judge_part(edges: impl Iterator<Item = Verdict>, alignment: Verdict) -> Verdict {
    let worst = edges.fold(Verdict::Undefined, Verdict::max);
    if alignment == Verdict::NotDecidable {
        Verdict::NotDecidable
    } else {
        worst
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_uncertainty_zone_decides_as_the_rule_says() {
        let limits = Some([-0.1, 0.1]);
        let guard = Rule::GuardBand(2.0);
        assert_eq!(judge(0.09, 0.01, limits, Rule::Simple), Verdict::Ok);
        assert_eq!(judge(0.09, 0.01, limits, guard), Verdict::NotDecidable);
        assert_eq!(judge(0.07, 0.01, limits, guard), Verdict::Ok);
        assert_eq!(judge(0.11, 0.01, limits, guard), Verdict::NotDecidable);
        assert_eq!(judge(-0.13, 0.01, limits, guard), Verdict::NotOk);
        assert_eq!(judge(0.11, 0.01, limits, Rule::Simple), Verdict::NotOk);
        assert_eq!(judge(5.0, 0.01, None, guard), Verdict::Undefined);
        assert_eq!(judge(f64::NAN, 0.01, limits, guard), Verdict::NotDecidable);
    }

    #[test]
    fn the_worst_rules_and_missing_data_decide_nothing() {
        let limits = Limits {
            d_mm: [Some([-0.1, 0.1]); 2],
            angle_rad: None,
        };
        let ok = || [Verdict::Ok, Verdict::Undefined].into_iter();
        assert_eq!(judge_edge(ok(), 0.95, 0.9, &limits), Verdict::Ok);
        assert_eq!(judge_edge(ok(), 0.5, 0.9, &limits), Verdict::NotDecidable);
        let none = Limits::default();
        assert_eq!(
            judge_edge(ok().skip(1), 0.5, 0.9, &none),
            Verdict::Undefined
        );
        let bad = [Verdict::Ok, Verdict::NotOk].into_iter();
        assert_eq!(judge_edge(bad.clone(), 0.5, 0.9, &limits), Verdict::NotOk);
        assert_eq!(judge_part(bad.clone(), Verdict::Ok), Verdict::NotOk);
        assert_eq!(
            judge_part(bad, Verdict::NotDecidable),
            Verdict::NotDecidable
        );
    }
}
