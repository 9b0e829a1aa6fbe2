//! Every sharp edge of the nominal, measured station by station on an aligned scan.

use glam::DVec3;
use rayon::prelude::*;

use super::assign::{Place, Surface};
use super::body::{Body, BodyEdge};
use super::collect::{self, Scene, Track};
use super::flank::{FlankFit, FlankGap, FlankSeries, FlankSettings, Windows, measure_flank};
use super::result::{Budget, EdgeBreak, EdgeMean, Measured};
use super::virtual_edge::{VirtualEdge, intersect};
use crate::nominal::Station;
use crate::points::PointCloud;

/// Points that a flank of a station aims at: its offset is then known to a seventh of the noise.
const WANTED_POINTS: f64 = 200.0;

/// Depth of a flank in stations: deep enough that the tilt does not spoil the offset, shallow enough to stay near the edge.
const DEPTH: f64 = 3.0;

/// Scan lines that a station must hold: three hold a slope, one more to see its noise.
const LINES: f64 = 4.0;

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
}

/// One edge as measured, not judged yet.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredEdge {
    /// Every station with what was measured or why not.
    pub stations: Vec<MeasuredStation>,
    /// The shape of the edge itself, one a stretch.
    pub breaks: Vec<EdgeBreak>,
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
    let edges = surface.body.edges();
    let windows: Vec<Windows> = edges.iter().map(|e| windows_of(e, settings)).collect();
    let flank_settings: Vec<FlankSettings> = windows
        .iter()
        .map(|w| flank_settings(w, settings))
        .collect();
    let tracks: Vec<Track> = (0..edges.len())
        .into_par_iter()
        .map(|e| Track::new(surface.body, e, &edges[e], &windows[e]))
        .collect();
    let radius: Vec<f64> = flank_settings.iter().map(|s| s.reach_limit_mm).collect();
    let scene = Scene {
        cloud,
        places,
        edges: &edges,
        tracks: &tracks,
        radius_mm: &radius,
        by_face: &collect::by_face(places, surface.body.face_count()),
    };
    let series = all_flanks(&scene, &windows, &flank_settings);
    (0..edges.len())
        .into_par_iter()
        .map(|e| {
            let context = EdgeContext {
                body: surface.body,
                index: e,
                edge: &edges[e],
                settings,
            };
            context.combine(&windows[e], &series[e])
        })
        .collect()
}

/// Stations about as long as needed for [`WANTED_POINTS`] and [`LINES`], a whole number of them on the edge.
fn windows_of(edge: &BodyEdge, settings: &MeasureSettings) -> Windows {
    let area = settings.along_mm * settings.across_mm;
    let derived = (WANTED_POINTS * area / DEPTH)
        .sqrt()
        .max(LINES * settings.across_mm);
    let step = settings.station_step_mm.unwrap_or(derived).max(1e-9);
    // No more than a hundred thousand stations, whatever the step.
    let count = (edge.length_mm / step).round().clamp(1.0, 1e5);
    Windows {
        count: count as usize,
        step_mm: edge.length_mm / count,
    }
}

fn flank_settings(windows: &Windows, settings: &MeasureSettings) -> FlankSettings {
    let area = settings.along_mm * settings.across_mm;
    // A short edge or a given step makes the window narrow; the reach then makes up for the points.
    let reach_mm = (DEPTH * windows.step_mm)
        .max(WANTED_POINTS * area / windows.step_mm)
        .min(
            DEPTH
                * (WANTED_POINTS * area / DEPTH)
                    .sqrt()
                    .max(LINES * settings.across_mm),
        );
    // Points nearer than this may be mixed with, or belong to, the other flank.
    let cut_mm = (2.0 * settings.along_mm)
        .max(4.0 * settings.noise_mm)
        .min(0.2 * reach_mm);
    FlankSettings {
        reach_mm,
        reach_limit_mm: 4.0 * reach_mm,
        cut_mm,
        spacing_mm: settings.along_mm.max(1e-9),
        min_points: 12,
    }
}

/// Both flanks of all edges. Where the transition zone of an edge turns out wider than assumed, the edges that share a
/// face with it are measured again without the points in it.
fn all_flanks(
    scene: &Scene<'_>,
    windows: &[Windows],
    settings: &[FlankSettings],
) -> Vec<[FlankSeries; 2]> {
    let measure = |wanted: &[usize], cuts: &[[f64; 2]]| -> Vec<[FlankSeries; 2]> {
        let points = collect::flanks(scene, wanted, cuts);
        wanted
            .par_iter()
            .zip(points.par_iter())
            .map(|(e, pair)| [0, 1].map(|i| measure_flank(&pair[i], &windows[*e], &settings[*e])))
            .collect()
    };
    let assumed: Vec<[f64; 2]> = settings.iter().map(|s| [2.0 * s.cut_mm; 2]).collect();
    let all: Vec<usize> = (0..settings.len()).collect();
    let mut series = measure(&all, &assumed);
    let widest = |s: &FlankSeries| {
        s.stations
            .iter()
            .flatten()
            .map(|f| f.cut_mm)
            .fold(0.0, f64::max)
    };
    let seen: Vec<[f64; 2]> = series
        .iter()
        .zip(&assumed)
        .map(|(pair, least)| [0, 1].map(|i| widest(&pair[i]).max(least[i])))
        .collect();
    let mut disturbed = vec![false; scene.by_face.len()];
    for (e, edge) in scene.edges.iter().enumerate() {
        for side in 0..2 {
            disturbed[edge.faces[side] as usize] |= seen[e][side] > assumed[e][side];
        }
    }
    let again: Vec<usize> = all
        .into_iter()
        .filter(|e| scene.edges[*e].faces.iter().any(|f| disturbed[*f as usize]))
        .collect();
    for (e, pair) in again.iter().zip(measure(&again, &seen)) {
        series[*e] = pair;
    }
    series
}

/// What is needed to combine the flanks of one edge.
struct EdgeContext<'a, B: Body> {
    body: &'a B,
    index: usize,
    edge: &'a BodyEdge,
    settings: &'a MeasureSettings,
}

impl<B: Body> EdgeContext<'_, B> {
    fn combine(&self, windows: &Windows, series: &[FlankSeries; 2]) -> MeasuredEdge {
        let mut stations = Vec::with_capacity(windows.count);
        let mut sum = MeanSum::default();
        for k in 0..windows.count {
            let station = self.body.station(self.index, windows.centre(k));
            let flanks = [&series[0].stations[k], &series[1].stations[k]];
            let points = flanks.map(|f| match f {
                Ok(fit) => fit.points,
                Err(FlankGap::TooFew(seen, _)) => *seen,
                Err(_) => 0,
            });
            let outcome = match flanks {
                [Ok(first), Ok(second)] => self
                    .virtual_edge(&station, [first, second])
                    .map(|edge| {
                        sum.add(&station, &edge);
                        self.measured(&station, &edge, [first, second])
                    })
                    .ok_or_else(|| PARALLEL.to_string()),
                _ => Err(self.reason(flanks)),
            };
            stations.push(MeasuredStation {
                station,
                outcome,
                points,
            });
        }
        MeasuredEdge {
            stations,
            breaks: Vec::new(),
            mean: self.mean(&sum, series),
            remarks: self.remarks(series),
        }
    }

    fn virtual_edge(&self, station: &Station, flanks: [&FlankFit; 2]) -> Option<VirtualEdge> {
        intersect(station, self.edge.kind, flanks, |i, p| {
            let height = (p - station.point).dot(station.normals[i]);
            let Some(foot) = self.body.foot(self.edge.faces[i], p, None) else {
                return 0.0;
            };
            let sag = height - (p - foot.point).dot(foot.normal);
            // A foot on another sheet of the surface says nothing about this place.
            if sag.abs() < 0.5 * (p - station.point).length() {
                sag
            } else {
                0.0
            }
        })
    }

    fn measured(&self, station: &Station, edge: &VirtualEdge, flanks: [&FlankFit; 2]) -> Measured {
        let pose = [0, 1].map(|i| {
            let row = pose_row(edge.point, station.normals[i]);
            quadratic(&row, &self.settings.pose_covariance, &row)
        });
        let budget_d = [0, 1].map(|i| Budget {
            points: edge.covariance[i][i].sqrt(),
            alignment: pose[i].max(0.0).sqrt(),
            calibration: self.settings.u_calibration_mm,
            temperature: 0.0,
        });
        // A rigid motion changes no angle.
        let budget_angle = Budget {
            points: edge.covariance[2][2].sqrt(),
            alignment: 0.0,
            calibration: self.settings.u_calibration_rad,
            temperature: 0.0,
        };
        Measured {
            point: edge.point,
            d_mm: edge.d_mm,
            u_d_mm: budget_d.map(|budget| budget.u()),
            included_angle_rad: edge.included_angle_rad,
            u_included_angle_rad: budget_angle.u(),
            residual_mm: flanks.map(|f| f.sigma_mm),
            budget_d,
            budget_angle,
        }
    }

    fn mean(&self, sum: &MeanSum, series: &[FlankSeries; 2]) -> Option<EdgeMean> {
        if sum.count == 0.0 {
            return None;
        }
        let n = sum.count;
        let u = |i: usize| {
            let row = sum.pose_rows[i].map(|x| x / n);
            let pose = quadratic(&row, &self.settings.pose_covariance, &row);
            let fits = sum.variance[i] / (n * n) * series[i].shared_factor;
            (fits + pose + self.settings.u_calibration_mm.powi(2)).sqrt()
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

/// Sums over the measured stations of an edge.
#[derive(Debug, Default)]
struct MeanSum {
    count: f64,
    d: [f64; 2],
    variance: [f64; 2],
    pose_rows: [[f64; 6]; 2],
}

impl MeanSum {
    fn add(&mut self, station: &Station, edge: &VirtualEdge) {
        self.count += 1.0;
        for i in 0..2 {
            self.d[i] += edge.d_mm[i];
            self.variance[i] += edge.covariance[i][i];
            let row = pose_row(edge.point, station.normals[i]);
            for (sum, x) in self.pose_rows[i].iter_mut().zip(row) {
                *sum += x;
            }
        }
    }
}

/// How d along `normal` of a place `p` changes with (rotation vector about the origin, translation) of the scan.
pub(super) fn pose_row(p: DVec3, normal: DVec3) -> [f64; 6] {
    let turn = p.cross(normal);
    [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z]
}

/// a' C b.
pub(super) fn quadratic(a: &[f64; 6], c: &[[f64; 6]; 6], b: &[f64; 6]) -> f64 {
    (0..6)
        .map(|i| a[i] * (0..6).map(|j| c[i][j] * b[j]).sum::<f64>())
        .sum()
}
