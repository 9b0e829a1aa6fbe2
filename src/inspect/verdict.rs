//! From values with uncertainty and limits to verdicts; the worst rules upward.
//!
//! Source: features-and-standards, section 4.10 (ISO 14253-1) and characteristic 25.

use super::result::Verdict;

/// How the uncertainty of a value counts when it is compared with a limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rule {
    /// The value alone decides, as long as twice its standard uncertainty fits between the limits: beyond that the value says
    /// nothing about them.
    Simple,
    /// A limit within this many standard uncertainties of the value leaves it undecided.
    GuardBand(f64),
    /// In the manner of ISO 14253-1: conformity, or non-conformity, must be probable to at least this; between them nothing is decided.
    ///
    /// We differ from the guard band of the standard's default (1.65 u for 95 %, good where u is small beside the limits' width): the
    /// probability is that of the normal distribution about the value between both limits, which is right for any u.
    Conformance(f64),
}

/// The verdict on a value: within the limits, outside, or not decidable; without limits `Undefined`.
///
/// An infinite limit is none on that side. A value or uncertainty that is no number decides nothing.
pub fn judge(value: f64, u: f64, limits: Option<[f64; 2]>, rule: Rule) -> Verdict {
    let Some([lower, upper]) = limits else {
        return Verdict::Undefined;
    };
    if !value.is_finite() || !u.is_finite() {
        return Verdict::NotDecidable;
    }
    let zone = match rule {
        Rule::Simple if 2.0 * u > upper - lower => return Verdict::NotDecidable,
        Rule::Simple => 0.0,
        Rule::GuardBand(k) => k * u,
        Rule::Conformance(least) => {
            let inside = conformance(value, u, [lower, upper]);
            return if inside >= least {
                Verdict::Ok
            } else if 1.0 - inside >= least {
                Verdict::NotOk
            } else {
                Verdict::NotDecidable
            };
        }
    };
    if value - zone >= lower && value + zone <= upper {
        Verdict::Ok
    } else if value + zone < lower || value - zone > upper {
        Verdict::NotOk
    } else {
        Verdict::NotDecidable
    }
}

/// Probability that the true value lies within the limits, if it is spread normally about `value` with `u` (JCGM 106, 7.2).
pub fn conformance(value: f64, u: f64, [lower, upper]: [f64; 2]) -> f64 {
    if u <= 0.0 {
        return f64::from(value >= lower && value <= upper);
    }
    let below = |limit: f64| 0.5 * libm::erfc((value - limit) / (u * std::f64::consts::SQRT_2));
    // The smaller tails, so that neither is lost beside 1.
    1.0 - below(lower) - (1.0 - below(upper)).max(0.0)
}

/// The verdict on an edge: the worst of its values, and `NotDecidable` where it is judged but too little of it was measured.
pub fn judge_edge(
    values: impl Iterator<Item = Verdict>,
    coverage: f64,
    minimum_coverage: f64,
    judged: bool,
) -> Verdict {
    let worst = values.fold(Verdict::Undefined, Verdict::max);
    if judged && coverage < minimum_coverage {
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
        assert_eq!(
            judge(0.0, 0.11, limits, Rule::Simple),
            Verdict::NotDecidable
        );
    }

    /// Against tables of the normal distribution: 1.6449 standard deviations leave 5 % outside on one side.
    #[test]
    fn a_stated_probability_is_the_one_sided_guard_band_where_u_is_small() {
        let (limits, u) = ([-0.1, 0.1], 0.001);
        let rule = Rule::Conformance(0.95);
        let at = |value| judge(value, u, Some(limits), rule);
        assert_eq!(at(0.1 - 1.646 * u), Verdict::Ok);
        assert_eq!(at(0.1 - 1.643 * u), Verdict::NotDecidable);
        assert_eq!(at(0.1 + 1.643 * u), Verdict::NotDecidable);
        assert_eq!(at(0.1 + 1.646 * u), Verdict::NotOk);
        assert!((conformance(0.0, 0.05, [-0.1, 0.1]) - 0.954_499_736).abs() < 1e-9);
        assert!((conformance(0.1, 0.01, [f64::NEG_INFINITY, 0.1]) - 0.5).abs() < 1e-12);
        assert_eq!(judge(0.0, 1.0, Some(limits), rule), Verdict::NotDecidable);
        assert_eq!(conformance(0.2, 0.0, limits), 0.0);
        assert_eq!(conformance(0.1, 0.0, limits), 1.0);
    }

    #[test]
    fn a_side_without_a_limit_does_not_count() {
        let upper = Some([f64::NEG_INFINITY, 0.05]);
        for rule in [Rule::Simple, Rule::GuardBand(2.0), Rule::Conformance(0.95)] {
            assert_eq!(judge(0.0, 0.02, upper, rule), Verdict::Ok, "{rule:?}");
            assert_eq!(judge(0.2, 0.02, upper, rule), Verdict::NotOk, "{rule:?}");
        }
    }

    #[test]
    fn the_worst_rules_and_missing_data_decide_nothing() {
        let ok = || [Verdict::Ok, Verdict::Undefined].into_iter();
        assert_eq!(judge_edge(ok(), 0.95, 0.9, true), Verdict::Ok);
        assert_eq!(judge_edge(ok(), 0.5, 0.9, true), Verdict::NotDecidable);
        assert_eq!(
            judge_edge(ok().skip(1), 0.5, 0.9, false),
            Verdict::Undefined
        );
        let bad = [Verdict::Ok, Verdict::NotOk].into_iter();
        assert_eq!(judge_edge(bad.clone(), 0.5, 0.9, true), Verdict::NotOk);
        assert_eq!(judge_part(bad.clone(), Verdict::Ok), Verdict::NotOk);
        assert_eq!(
            judge_part(bad, Verdict::NotDecidable),
            Verdict::NotDecidable
        );
    }
}
