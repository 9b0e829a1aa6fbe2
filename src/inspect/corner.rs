//! Corners: where three or more faces meet, measured as the intersection of their flanks.
//!
//! Source: features-and-standards, section 5, characteristic 17.

use glam::{DMat3, DVec3};

use super::body::{Body, BodyEdge};
use super::contributions::quadratic;
use super::measure::pose_row;
use super::result::{CornerResult, EdgeResult, Quantified, StationResult, Verdict};
use super::verdict::{Rule, judge};

/// Edges whose ends lie within this share of the part's size meet in one corner: CAD files leave gaps of a micrometre.
const SAME_PLACE: f64 = 1e-6;

/// Stations next to a corner from which the deviation of a face is extrapolated to it.
const STATIONS: usize = 6;

/// Distances of the nearest measured station, in steps, beyond which a corner is not measured.
const REACH: f64 = 3.0;

/// A corner of the nominal.
#[derive(Debug, Clone, PartialEq)]
pub struct Corner {
    /// Position, mm.
    pub point: DVec3,
    /// Edges that end here, and whether with their start (0) or their end (1).
    pub edges: Vec<(usize, usize)>,
    /// Faces that meet here and their outward normals.
    pub faces: Vec<(u32, DVec3)>,
}

/// The corners of `body`: ends of sharp edges that meet with three faces or more, whose normals span space.
pub fn corners<B: Body>(body: &B, edges: &[BodyEdge]) -> Vec<Corner> {
    let [low, high] = body.bounds();
    let near = SAME_PLACE * (high - low).length();
    let mut corners: Vec<Corner> = Vec::new();
    for (index, edge) in edges.iter().enumerate().filter(|(_, e)| !e.closed) {
        for end in 0..2 {
            let station = body.station(index, end as f64 * edge.length_mm);
            let known = corners
                .iter()
                .position(|c| c.point.distance(station.point) <= near);
            let corner = match known {
                Some(known) => &mut corners[known],
                None => {
                    corners.push(Corner {
                        point: station.point,
                        edges: Vec::new(),
                        faces: Vec::new(),
                    });
                    corners.last_mut().expect("one was pushed")
                }
            };
            corner.edges.push((index, end));
            for (face, normal) in edge.faces.into_iter().zip(station.normals) {
                if corner.faces.iter().all(|(f, _)| *f != face) {
                    corner.faces.push((face, normal));
                }
            }
        }
    }
    corners.retain(|corner| {
        let mut sum = DMat3::ZERO;
        for (_, n) in &corner.faces {
            sum += DMat3::from_cols(*n * n.x, *n * n.y, *n * n.z);
        }
        // Three normals in a plane within half a degree meet in a line, not in a point.
        corner.faces.len() >= 3 && sum.determinant() > 1e-4
    });
    corners
}

/// What a corner is judged by and what is common to all values.
#[derive(Debug, Clone, Copy)]
pub struct CornerSettings<'a> {
    /// Largest total deviation, mm.
    pub limit_mm: Option<f64>,
    /// How the uncertainty counts.
    pub rule: Rule,
    /// Covariance of the alignment.
    pub pose_covariance: &'a [[f64; 6]; 6],
    /// Standard uncertainty of d from the calibration, mm.
    pub u_calibration_mm: f64,
}

/// Measures every corner of `corners` from the edges that meet in it; `results` in the order of the edges.
pub fn measure<B: Body>(
    body: &B,
    corners: &[Corner],
    (edges, results): (&[BodyEdge], &[EdgeResult]),
    settings: &CornerSettings<'_>,
) -> Vec<CornerResult> {
    corners
        .iter()
        .enumerate()
        .map(|(index, corner)| {
            let mut result = CornerResult {
                id: format!("c{}", index + 1),
                nominal: corner.point,
                faces: corner
                    .faces
                    .iter()
                    .map(|(face, _)| body.face_entity(*face))
                    .collect(),
                edges: corner
                    .edges
                    .iter()
                    .map(|(e, _)| results[*e].id.clone())
                    .collect(),
                measured: None,
                total_mm: None,
                residual_mm: None,
                limit_mm: settings.limit_mm,
                verdict: Verdict::Undefined,
                reason: String::new(),
            };
            let deviations: Vec<Option<Quantified>> = corner
                .faces
                .iter()
                .map(|(face, _)| of_face(*face, corner, edges, results))
                .collect();
            match intersect(corner, &deviations, settings) {
                Ok((shift, u, residual)) => {
                    let total = Quantified {
                        value: shift.length(),
                        u,
                    };
                    result.measured = Some(corner.point + shift);
                    result.total_mm = Some(total);
                    result.residual_mm = residual;
                }
                Err(reason) => result.reason = reason,
            }
            judge_corner(&mut result, settings.rule);
            result
        })
        .collect()
}

/// The verdict on a corner as it stands: one that was not measured keeps no limit.
pub fn judge_corner(corner: &mut CornerResult, rule: Rule) {
    let unknown = Quantified {
        value: f64::NAN,
        u: 0.0,
    };
    let total = corner.total_mm.unwrap_or(unknown);
    let limits = corner.limit_mm.map(|limit| [f64::NEG_INFINITY, limit]);
    corner.verdict = judge(total.value, total.u, limits, rule);
}

/// The deviation of `face` at the corner: from each edge on it that ends here, a line through d over its nearest stations; their mean by
/// weight.
fn of_face(
    face: u32,
    corner: &Corner,
    edges: &[BodyEdge],
    results: &[EdgeResult],
) -> Option<Quantified> {
    let (mut sum, mut weight) = (0.0, 0.0);
    for (e, end) in &corner.edges {
        let Some(side) = edges[*e].faces.iter().position(|f| *f == face) else {
            continue;
        };
        if let Some(d) = extrapolated(&results[*e].stations, side, *end, edges[*e].length_mm) {
            let w = d.u.max(1e-9).powi(-2);
            sum += w * d.value;
            weight += w;
        }
    }
    (weight > 0.0).then(|| Quantified {
        value: sum / weight,
        u: weight.powf(-0.5),
    })
}

/// d of flank `side` at one end of an edge.
fn extrapolated(
    stations: &[StationResult],
    side: usize,
    end: usize,
    length_mm: f64,
) -> Option<Quantified> {
    let step = length_mm / stations.len() as f64;
    let from_end = |station: &StationResult| match end {
        0 => station.station.s_mm,
        _ => length_mm - station.station.s_mm,
    };
    let measured = |station: &StationResult| {
        let m = station.measured.as_ref()?;
        Some((from_end(station), m.d_mm[side], m.budget_d[side].points))
    };
    let near: Vec<(f64, f64, f64)> = match end {
        0 => stations
            .iter()
            .filter_map(measured)
            .take(STATIONS)
            .collect(),
        _ => stations
            .iter()
            .rev()
            .filter_map(measured)
            .take(STATIONS)
            .collect(),
    };
    if near.first()?.0 > REACH * step {
        return None;
    }
    let n = near.len() as f64;
    let mean = near.iter().map(|p| p.0).sum::<f64>() / n;
    let ss: f64 = near.iter().map(|p| (p.0 - mean).powi(2)).sum();
    let (mut value, mut variance) = (0.0, 0.0);
    for (s, d, u) in &near {
        let slope = if near.len() > 2 {
            (mean / ss) * (s - mean)
        } else {
            0.0
        };
        let weight = 1.0 / n - slope;
        value += weight * d;
        variance += (weight * u).powi(2);
    }
    Some(Quantified {
        value,
        u: variance.sqrt(),
    })
}

/// Shift of the corner, standard uncertainty along it, and root mean square of what more than three faces leave.
fn intersect(
    corner: &Corner,
    deviations: &[Option<Quantified>],
    settings: &CornerSettings<'_>,
) -> Result<(DVec3, f64, Option<f64>), String> {
    let mut matrix = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    let mut seen = Vec::new();
    for ((_, n), d) in corner.faces.iter().zip(deviations) {
        let Some(d) = d else { continue };
        let w = d.u.max(1e-9).powi(-2);
        matrix += DMat3::from_cols(*n * n.x, *n * n.y, *n * n.z) * w;
        right += w * d.value * *n;
        seen.push((*n, *d, w));
    }
    let missing = corner.faces.len() - seen.len();
    if seen.len() < 3 {
        return Err(format!(
            "{missing} of the {} faces not measured near the corner, three needed",
            corner.faces.len()
        ));
    }
    let inverse = matrix.inverse();
    if !inverse.is_finite() {
        return Err("the faces measured near the corner do not meet in a point".to_owned());
    }
    let shift = inverse * right;
    let along = shift.try_normalize().unwrap_or(seen[0].0);
    let pose = pose_row(corner.point, along);
    let points = along.dot(inverse * along);
    let calibration: f64 = seen
        .iter()
        .map(|(n, _, w)| (w * along.dot(inverse * *n) * settings.u_calibration_mm).powi(2))
        .sum();
    let u = (points + calibration + quadratic(&pose, settings.pose_covariance, &pose)).sqrt();
    let residual = (seen.len() > 3).then(|| {
        let sum: f64 = seen
            .iter()
            .map(|(n, d, _)| (n.dot(shift) - d.value).powi(2))
            .sum();
        (sum / seen.len() as f64).sqrt()
    });
    Ok((shift, u, residual))
}
