//! Gap and flush between two edges.
//!
//! At a station of the first edge, in the plane across its tangent: *flush* is the offset of the second edge along the normal of
//! the face beside the gap, *gap* the distance in that face. Both edges as virtual edges, so that their breaks do not count.
//!
//! Source: features-and-standards, section 5, characteristic 16.

use glam::DVec3;

use super::recipe::GapRecipe;
use super::result::{
    Budget, EdgeResult, GapResult, GapStation, Quantified, StationResult, Verdict,
};
use super::verdict::{Rule, judge};

/// Gap and flush of `recipe` between two measured edges.
pub fn measure(recipe: &GapRecipe, edges: [&EdgeResult; 2], rule: Rule) -> GapResult {
    let stations: Vec<GapStation> = edges[0]
        .stations
        .iter()
        .filter_map(|a| at_station(a, &edges[1].stations))
        .collect();
    let mut gap = GapResult {
        name: recipe.name.clone(),
        edges: edges.map(|e| e.id.clone()),
        stations,
        gap_limits_mm: recipe.gap_mm,
        flush_limits_mm: recipe.flush_mm,
        verdict: Verdict::Undefined,
        reason: String::new(),
    };
    if gap.stations.is_empty() {
        gap.reason = "at no station both edges were measured opposite each other".to_owned();
    }
    judge_gap(&mut gap, rule);
    gap
}

/// The verdict on a gap as it stands: the worst of its stations'; limits of a gap that was nowhere measured are not decidable.
pub fn judge_gap(gap: &mut GapResult, rule: Rule) {
    let worst = |value: fn(&GapStation) -> Quantified, limits: Option<[f64; 2]>| {
        gap.stations
            .iter()
            .map(|s| judge(value(s).value, value(s).u, limits, rule))
            .fold(Verdict::Undefined, Verdict::max)
    };
    let [by_gap, by_flush] = [
        worst(|s| s.gap_mm, gap.gap_limits_mm),
        worst(|s| s.flush_mm, gap.flush_limits_mm),
    ];
    let limited = gap.gap_limits_mm.is_some() || gap.flush_limits_mm.is_some();
    gap.verdict = match gap.stations.is_empty() && limited {
        true => Verdict::NotDecidable,
        false => by_gap.max(by_flush),
    };
}

fn at_station(a: &StationResult, others: &[StationResult]) -> Option<GapStation> {
    let measured = a.measured.as_ref()?;
    let nominal = &a.station;
    let (b, share) = opposite(nominal.point, nominal.tangent, others)?;
    let [first, second] = [b[0].measured.as_ref()?, b[1].measured.as_ref()?];
    let between = |x: DVec3, y: DVec3| x + share * (y - x);
    let point = between(first.point, second.point);
    let opposite_nominal = between(b[0].station.point, b[1].station.point);
    // The faces beside the gap are those that look the same way.
    let pairs = [0, 1].map(|i| [0, 1].map(|j| (i, j)));
    let (side, other) = pairs.into_iter().flatten().max_by(|x, y| {
        let alike = |(i, j): &(usize, usize)| nominal.normals[*i].dot(b[0].station.normals[*j]);
        alike(x).total_cmp(&alike(y))
    })?;
    let up = nominal.normals[side];
    let mut across = nominal.tangent.cross(up).try_normalize()?;
    if across.dot(opposite_nominal - nominal.point) < 0.0 {
        across = -across;
    }
    let from_to = point - measured.point;
    let nominal_from_to = opposite_nominal - nominal.point;
    // A rigid motion moves both edges alike, so the alignment does not count.
    let local = |budget: &Budget| budget.points.hypot(budget.calibration);
    let u = |i: usize, j: usize| local(&measured.budget_d[i]).hypot(local(&first.budget_d[j]));
    Some(GapStation {
        s_mm: nominal.s_mm,
        gap_mm: Quantified {
            value: from_to.dot(across),
            u: u(1 - side, 1 - other),
        },
        flush_mm: Quantified {
            value: from_to.dot(up),
            u: u(side, other),
        },
        nominal_mm: [nominal_from_to.dot(across), nominal_from_to.dot(up)],
    })
}

/// The two neighbouring stations between which the other edge passes the plane across `tangent` at `point`, nearest to it, and the share
/// of the way between them.
fn opposite(
    point: DVec3,
    tangent: DVec3,
    others: &[StationResult],
) -> Option<([&StationResult; 2], f64)> {
    let height = |s: &StationResult| (s.station.point - point).dot(tangent);
    let place = |pair: &[StationResult], share: f64| {
        pair[0].station.point + share * (pair[1].station.point - pair[0].station.point)
    };
    others
        .windows(2)
        .filter_map(|pair| {
            let (h0, h1) = (height(&pair[0]), height(&pair[1]));
            let crosses = (h0 <= 0.0) != (h1 <= 0.0) || h0 == 0.0;
            let measured = pair.iter().all(|s| s.measured.is_some());
            let share = if h0 == h1 { 0.0 } else { h0 / (h0 - h1) };
            (crosses && measured && (0.0..=1.0).contains(&share)).then_some((pair, share))
        })
        .min_by(|x, y| {
            let distance = |(pair, share): &(&[StationResult], f64)| {
                place(pair, *share).distance_squared(point)
            };
            distance(x).total_cmp(&distance(y))
        })
        .map(|(pair, share)| ([&pair[0], &pair[1]], share))
}
