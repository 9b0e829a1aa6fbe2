//! Every sharp edge of the nominal, measured station by station on an aligned scan.

use std::ops::Range;

use glam::DVec3;

use super::assign::{Place, Surface};
use super::body::{Body, BodyEdge};
use super::contributions::{Response, Shared};
use super::edge_break::{Found, STRETCH, Stretch, Wedge, ZonePoint};
use super::flank::{FlankFit, FlankGap, FlankModel, FlankSeries, Windows};
use super::measuring::{Breaks, measured};
use super::result::{
    Boundary, Budget, DepthPoint, EdgeBreak, EdgeMean, EdgePoint, Measured, Quantified,
};
use super::virtual_edge::{VirtualEdge, intersect};
use crate::nominal::{EdgeKind, Station};
use crate::points::PointCloud;

pub use super::contributions::Expansion;
pub(super) use super::contributions::pose_row;

/// The reason of a station where both flanks were measured and do not meet.
pub const PARALLEL: &str = "the two flanks are parallel";

/// What is known of the data, and what is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasureSettings {
    /// Distance of the points along a scan line, mm.
    pub along_mm: f64,
    /// Distance of the scan lines, mm.
    pub across_mm: f64,
    /// Standard deviation of a point, mm.
    pub noise_mm: f64,
    /// Distance of the stations, mm; `None` = derived from the spacing.
    pub station_step_mm: Option<f64>,
    /// Covariance of the alignment, as in [`super::result::Alignment`].
    pub pose_covariance: [[f64; 6]; 6],
    /// Standard uncertainty of d from the sensor's calibration, mm.
    pub u_calibration_mm: f64,
    /// Standard uncertainty of the included angle from the sensor's calibration, rad.
    pub u_calibration_rad: f64,
    /// Depth of the flanks that are used, mm; `None` = derived from the spacing and grown where the edge break is wide.
    pub flank_mm: Option<f64>,
    /// Depth at which the edge is to be given as well, mm.
    pub depth_mm: Option<f64>,
    /// Expansion of the part against its drawing; `None` = measured at 20 degrees, known exactly.
    pub expansion: Option<Expansion>,
}

/// One edge as measured, not judged yet.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredEdge {
    /// Every station with what was measured or why not.
    pub stations: Vec<MeasuredStation>,
    /// The shape of the edge itself, one a stretch.
    pub breaks: Vec<EdgeBreak>,
    /// What the deviation of each flank was modelled by.
    pub flank_model: [FlankModel; 2],
    /// Mean of d1 and d2 over the measured stations and their standard uncertainties, mm; `None` where none was measured.
    pub mean: Option<EdgeMean>,
    /// What was peculiar, for the findings.
    pub remarks: Vec<String>,
}

/// One station as measured.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredStation {
    /// The nominal place and its frame.
    pub station: Station,
    /// What was measured, or why not.
    pub outcome: Result<Measured, String>,
    /// The one flank that was seen, where only one was.
    pub boundary: Option<Boundary>,
    /// Points used on each flank.
    pub points: [usize; 2],
}

/// Measures every sharp edge of `surface` on `cloud`, which lies in the part frame; `places` as from [`Surface::places`].
pub fn measure_edges<B: Body>(
    cloud: &PointCloud,
    places: &[Place],
    surface: &Surface<'_, B>,
    settings: &MeasureSettings,
) -> Vec<MeasuredEdge> {
    measure_edges_stepped(cloud, places, surface, settings, &[])
}

/// As [`measure_edges`], with a distance of stations (mm) of its own for every edge that has one in `steps_mm`.
pub fn measure_edges_stepped<B: Body>(
    cloud: &PointCloud,
    places: &[Place],
    surface: &Surface<'_, B>,
    settings: &MeasureSettings,
    steps_mm: &[Option<f64>],
) -> Vec<MeasuredEdge> {
    measured(cloud, places, surface, (settings, steps_mm))
}

/// What is needed to combine the flanks of one edge.
pub(super) struct EdgeContext<'a, B: Body> {
    pub(super) body: &'a B,
    pub(super) index: usize,
    pub(super) edge: &'a BodyEdge,
    pub(super) settings: MeasureSettings,
    pub(super) shared: Shared,
}

impl<B: Body> EdgeContext<'_, B> {
    pub(super) fn combine(
        &self,
        windows: &Windows,
        series: &[FlankSeries; 2],
        breaks: &Breaks,
    ) -> MeasuredEdge {
        let mut stations = Vec::with_capacity(windows.count);
        let mut sum = MeanSum::default();
        for k in 0..windows.count {
            let station = self.station(windows, k);
            let flanks = [&series[0].stations[k], &series[1].stations[k]];
            let points = flanks.map(|f| match f {
                Ok(fit) => fit.points,
                Err(FlankGap::TooFew(seen, _)) => *seen,
                Err(_) => 0,
            });
            let outcome = match flanks {
                [Ok(first), Ok(second)] => {
                    let edge = self.virtual_edge(&station, [first, second]);
                    edge.map(|edge| {
                        let models = [series[0].model, series[1].model];
                        let reach = [series[0].reach_mm, series[1].reach_mm];
                        let measured =
                            self.measured(&station, &edge, [first, second], models, reach);
                        sum.add(&self.shared, &station, &edge, &measured);
                        measured
                    })
                    .ok_or_else(|| PARALLEL.to_string())
                }
                _ => Err(self.reason(flanks)),
            };
            let boundary = match flanks {
                [Ok(seen), Err(_)] => Some(self.boundary(&station, seen, 0)),
                [Err(_), Ok(seen)] => Some(self.boundary(&station, seen, 1)),
                _ => None,
            };
            stations.push(MeasuredStation {
                station,
                outcome,
                boundary,
                points,
            });
        }
        for (range, found) in breaks {
            for station in &mut stations[range.clone()] {
                add_ridge(station, found);
            }
        }
        MeasuredEdge {
            breaks: breaks
                .iter()
                .map(|(_, found)| found.shape.clone())
                .collect(),
            flank_model: [series[0].model, series[1].model],
            stations,
            mean: self.mean(&sum, series),
            remarks: self.remarks(series),
        }
    }

    pub(super) fn station(&self, windows: &Windows, k: usize) -> Station {
        self.body.station(self.index, windows.centre(k))
    }

    /// Where the flanks of every station meet.
    pub(super) fn virtual_edges(
        &self,
        windows: &Windows,
        series: &[FlankSeries; 2],
    ) -> Vec<Option<VirtualEdge>> {
        let of = |k: usize| match (&series[0].stations[k], &series[1].stations[k]) {
            (Ok(first), Ok(second)) => {
                self.virtual_edge(&self.station(windows, k), [first, second])
            }
            _ => None,
        };
        (0..windows.count).map(of).collect()
    }

    pub(super) fn virtual_edge(
        &self,
        station: &Station,
        flanks: [&FlankFit; 2],
    ) -> Option<VirtualEdge> {
        intersect(station, self.edge.kind, flanks, |i, p| {
            let bend = self.bend(station, i, p).or_else(|| {
                // Beyond the border of its surface a face goes on as it bends on this side of it.
                let b = station.into_face[i];
                let inward = p - 2.0 * (p - station.point).dot(b) * b;
                let [sag, slope] = self.bend(station, i, inward)?;
                Some([sag, -slope])
            });
            bend.unwrap_or([0.0; 2])
        })
    }

    /// Height of nominal face `i` under `p` over its tangent plane at the station, mm, and its slope there into the face; `None` where the
    /// face has no foot under it.
    fn bend(&self, station: &Station, i: usize, p: DVec3) -> Option<[f64; 2]> {
        let foot = self.body.foot(self.edge.faces[i], p, None)?;
        let off = p - foot.point;
        let distance = (p - station.point).length();
        if off.reject_from_normalized(foot.normal).length() > 0.01 * distance {
            return None;
        }
        let n = station.normals[i];
        let sag = (p - station.point).dot(n) - off.dot(foot.normal);
        let slope = -foot.normal.dot(station.into_face[i]) / foot.normal.dot(n);
        // A foot on another sheet of the surface says nothing about this place.
        (sag.abs() < 0.5 * distance && slope.abs() < 0.5).then_some([sag, slope])
    }

    fn measured(
        &self,
        station: &Station,
        edge: &VirtualEdge,
        flanks: [&FlankFit; 2],
        models: [FlankModel; 2],
        reach_mm: [f64; 2],
    ) -> Measured {
        let response = station.normals.map(|n| self.shared.response(edge.point, n));
        let calibration = self.shared.u_calibration_mm;
        let budget_d = [0, 1].map(|i| {
            let [alignment, temperature] = self.shared.u(&response[i]);
            Budget {
                points: edge.covariance[i][i].sqrt(),
                alignment,
                calibration,
                temperature,
            }
        });
        // Neither a rigid motion nor an even growth changes an angle.
        let budget_angle = Budget {
            points: edge.covariance[2][2].sqrt(),
            alignment: 0.0,
            calibration: self.settings.u_calibration_rad,
            temperature: 0.0,
        };
        let correction = self.shared.correction(edge.point);
        let d_mm = [0, 1].map(|i| edge.d_mm[i] + correction.dot(station.normals[i]));
        // The two flanks are calibrated in different directions, so that their errors count as independent.
        let shared: f64 = self
            .shared
            .covariance(&response[0], &response[1])
            .iter()
            .sum();
        let covariance_d_mm2 = edge.covariance[0][1] + shared;
        let u_d_mm = budget_d.map(|budget| budget.u());
        Measured {
            point: edge.point + correction,
            d_mm,
            u_d_mm,
            included_angle_rad: edge.included_angle_rad,
            u_included_angle_rad: budget_angle.u(),
            residual_mm: flanks.map(|f| f.sigma_mm),
            total_mm: total(station, d_mm, u_d_mm, covariance_d_mm2),
            budget_d,
            budget_angle,
            covariance_d_mm2,
            flank_model: models,
            ridge: None,
            at_depth: [0, 1].map(|i| self.at_depth(station, edge, flanks[i], i, reach_mm[i])),
        }
    }

    /// The deviation of the one flank that was seen, at the nominal edge.
    fn boundary(&self, station: &Station, seen: &FlankFit, flank: usize) -> Boundary {
        let n = station.normals[flank];
        let point = station.point + seen.offset_mm * n;
        let correction = self.shared.correction(point);
        let [alignment, temperature] = self.shared.u(&self.shared.response(point, n));
        let budget = Budget {
            points: seen.covariance[0][0].sqrt(),
            alignment,
            calibration: self.shared.u_calibration_mm,
            temperature,
        };
        Boundary {
            flank,
            point: point + correction,
            d_mm: Quantified {
                value: seen.offset_mm + correction.dot(n),
                u: budget.u(),
            },
            budget,
        }
    }

    /// The place on flank `i` at the depth asked for: from the virtual edge into the face.
    fn at_depth(
        &self,
        station: &Station,
        edge: &VirtualEdge,
        flank: &FlankFit,
        i: usize,
        reach_mm: f64,
    ) -> Option<DepthPoint> {
        let [n, b] = [station.normals[i], station.into_face[i]];
        let depth = self.settings.depth_mm?;
        let r = (edge.point - station.point).dot(b) + depth;
        if r < flank.cut_mm || r > reach_mm {
            return None;
        }
        let value = flank.deviation_mm(r, 0.0);
        let foot = self
            .body
            .foot(self.edge.faces[i], station.point + r * b, None)?;
        let point = foot.point + value * foot.normal;
        let correction = self.shared.correction(point);
        let c = &flank.covariance;
        let fit = c[0][0] + 2.0 * r * c[0][1] + r * r * c[1][1];
        let common = self.shared.u(&self.shared.response(point, n));
        let variance =
            fit + self.shared.u_calibration_mm.powi(2) + common.iter().map(|u| u * u).sum::<f64>();
        Some(DepthPoint {
            point: point + correction,
            d_mm: Quantified {
                value: value + correction.dot(n),
                u: variance.sqrt(),
            },
        })
    }

    /// The stretches of an edge in which some station was measured, each with its stations.
    pub(super) fn stretches<'s>(
        &self,
        windows: &Windows,
        series: &'s [FlankSeries; 2],
        zone: &'s [ZonePoint],
        edges: &[Option<VirtualEdge>],
    ) -> Vec<(Range<usize>, Stretch<'s>)> {
        let wedge = |k: usize| match (&series[0].stations[k], &series[1].stations[k], edges[k]) {
            (Ok(a), Ok(b), Some(edge)) => Some(Wedge {
                s: windows.centre(k),
                flanks: [a, b],
                included_angle_rad: edge.included_angle_rad,
            }),
            _ => None,
        };
        let mut stretches = Vec::new();
        for first in (0..windows.count).step_by(STRETCH) {
            let range = first..(first + STRETCH).min(windows.count);
            let from = first as f64 * windows.step_mm;
            let to = range.end as f64 * windows.step_mm;
            let points = zone.partition_point(|p| p.s < from)..zone.partition_point(|p| p.s < to);
            let stretch = Stretch {
                wedges: range.clone().filter_map(wedge).collect(),
                points: &zone[points],
                step_mm: windows.step_mm,
                spacing_mm: self.settings.along_mm,
                convex: self.edge.kind == EdgeKind::Convex,
                shared_factor: [series[0].shared_factor, series[1].shared_factor],
            };
            if !stretch.wedges.is_empty() {
                stretches.push((range, stretch));
            }
        }
        stretches
    }

    fn mean(&self, sum: &MeanSum, series: &[FlankSeries; 2]) -> Option<EdgeMean> {
        if sum.count == 0.0 {
            return None;
        }
        let n = sum.count;
        let u = |i: usize| {
            let common = self.shared.u(&sum.response[i].over(n));
            let fits = sum.variance[i] / (n * n) * series[i].shared_factor;
            let common = common.iter().map(|u| u * u).sum::<f64>();
            (fits + common + self.shared.u_calibration_mm.powi(2)).sqrt()
        };
        Some(EdgeMean {
            d_mm: sum.d.map(|d| d / n),
            u_d_mm: [u(0), u(1)],
        })
    }

    fn remarks(&self, series: &[FlankSeries; 2]) -> Vec<String> {
        let mut remarks = Vec::new();
        for (i, flank) in series.iter().enumerate() {
            let misfits = flank
                .stations
                .iter()
                .flatten()
                .filter(|f| f.lack_of_fit)
                .count();
            if misfits > 0 {
                remarks.push(format!(
                    "edge {}, flank {}: the face departs from its nominal shape by more than an offset and a tilt at {misfits} \
                     of {} stations; their uncertainty is enlarged",
                    self.edge.id,
                    i + 1,
                    flank.stations.len()
                ));
            }
        }
        remarks
    }

    fn reason(&self, flanks: [&Result<FlankFit, FlankGap>; 2]) -> String {
        let name = |i: usize| {
            let entity = self.body.face_entity(self.edge.faces[i]);
            format!("flank {} (face #{entity})", i + 1)
        };
        match flanks {
            [Err(FlankGap::NoPoints), Err(FlankGap::NoPoints)] => {
                "no points on either flank".to_string()
            }
            [Ok(_), Err(FlankGap::NoPoints)] => {
                format!(
                    "boundary: only {} was seen, no points on {}",
                    name(0),
                    name(1)
                )
            }
            [Err(FlankGap::NoPoints), Ok(_)] => {
                format!(
                    "boundary: only {} was seen, no points on {}",
                    name(1),
                    name(0)
                )
            }
            _ => {
                let gaps: Vec<String> = flanks
                    .iter()
                    .enumerate()
                    .filter_map(|(i, f)| {
                        Some(format!("{}: {}", name(i), gap_text(f.as_ref().err()?)))
                    })
                    .collect();
                gaps.join("; ")
            }
        }
    }
}

fn gap_text(gap: &FlankGap) -> String {
    match gap {
        FlankGap::NoPoints => "no points".to_string(),
        FlankGap::TooFew(seen, needed) => format!("{seen} points, {needed} needed"),
        FlankGap::BadlySpread => "points bunched along the edge".to_string(),
        FlankGap::ShortReach(first, last) => format!(
            "points only {first:.3} to {last:.3} mm from the edge, too short a reach to extrapolate"
        ),
        FlankGap::Turned(angle_rad) => format!(
            "turned by {:.0} degrees against the face: an edge break or another surface",
            angle_rad.to_degrees()
        ),
    }
}

/// The shift across the tangent whose components along the normals are `d`, mm.
pub(super) fn shift_across(station: &Station, d: [f64; 2]) -> DVec3 {
    let [first, second] = station.normals;
    let c = first.dot(second);
    ((d[0] - c * d[1]) * first + (d[1] - c * d[0]) * second) / (1.0 - c * c).max(1e-12)
}

/// Distance across the tangent from its two components along the normals, with first-order uncertainty; near zero, where the
/// distance has no derivative, that of the worse component.
fn total(station: &Station, d: [f64; 2], u: [f64; 2], covariance: f64) -> Quantified {
    let c = station.normals[0].dot(station.normals[1]);
    let sine = (1.0 - c * c).max(1e-12);
    let value = shift_across(station, d).length();
    let worst = u[0].max(u[1]) / sine.sqrt();
    let by = [d[0] - c * d[1], d[1] - c * d[0]].map(|x| x / (sine * value.max(1e-12)));
    let variance = by[0].powi(2) * u[0].powi(2)
        + by[1].powi(2) * u[1].powi(2)
        + 2.0 * by[0] * by[1] * covariance;
    Quantified {
        value,
        u: if value > worst {
            variance.max(0.0).sqrt()
        } else {
            worst
        },
    }
}

/// Gives a measured station the highest place of its stretch. Its uncertainty is that of the virtual edge and that of the
/// truncation together, which are no worse than independent: the truncation is measured from the virtual edge.
fn add_ridge(station: &mut MeasuredStation, found: &Found) {
    let place = &station.station;
    let [across, up] = [
        (place.normals[0] - place.normals[1]).normalize_or_zero(),
        (place.normals[0] + place.normals[1]).normalize_or_zero(),
    ];
    let Ok(measured) = &mut station.outcome else {
        return;
    };
    let shift = found.highest[0] * across + found.highest[1] * up;
    let d_mm = [0, 1].map(|i| Quantified {
        value: measured.d_mm[i] + shift.dot(place.normals[i]),
        u: measured.u_d_mm[i].hypot(found.shape.truncation_mm.u * up.dot(place.normals[i])),
    });
    measured.ridge = Some(EdgePoint {
        point: measured.point + shift,
        d_mm,
    });
}

/// Sums over the measured stations of an edge.
#[derive(Debug, Default)]
struct MeanSum {
    count: f64,
    d: [f64; 2],
    variance: [f64; 2],
    response: [Response; 2],
}

impl MeanSum {
    fn add(&mut self, shared: &Shared, station: &Station, edge: &VirtualEdge, measured: &Measured) {
        self.count += 1.0;
        for i in 0..2 {
            self.d[i] += measured.d_mm[i];
            self.variance[i] += edge.covariance[i][i];
            self.response[i].add(&shared.response(edge.point, station.normals[i]));
        }
    }
}
