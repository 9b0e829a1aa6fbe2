//! One flank of one edge: a local model of its deviation from the nominal face, at every station, with covariance.
//!
//! What is fitted is not a surface but the *signed distance to the nominal face*, as a function of the distance `r` from
//! the nominal edge into the face and of the arc length `s` along it: `offset + tilt r + slope s`. A curved face is
//! therefore measured as well as a plane one, and `r` and `s` need be known to a per cent only.
//!
//! Sources: features-and-standards, section 5, characteristics 5b (virtual edge), 8 (detachment point), 20 and 21.

mod memo;
mod transition;
mod variance;

use super::clusters::{Clusters, NO_GROUP};
use crate::geometry::fit::{LinearFit, fit_robust};

pub use memo::Memo;

/// Points of one flank in the coordinates of its edge, in order of arc length.
#[derive(Debug, Clone, Default)]
pub struct FlankPoints {
    /// Arc length of the foot on the edge, mm.
    pub s: Vec<f64>,
    /// Distance from the edge into the face, mm.
    pub r: Vec<f64>,
    /// Signed distance to the nominal face, mm: plus = outside the material.
    pub deviation: Vec<f64>,
    /// Which scan line measured the point; [`NO_LINE`] where that is unknown.
    pub line: Vec<u32>,
}

/// The scan line of a point of which nothing but its coordinates is known.
pub const NO_LINE: u32 = NO_GROUP;

/// One point for [`FlankPoints::new`]: (s, r, deviation, line).
pub type FlankPoint = (f64, f64, f64, u32);

impl FlankPoints {
    /// Sorts the points along the edge.
    pub fn new(mut points: Vec<FlankPoint>) -> Self {
        points.sort_by(|a, b| {
            let by_place = a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1));
            by_place.then(a.2.total_cmp(&b.2)).then(a.3.cmp(&b.3))
        });
        let mut flank = Self::default();
        for (s, r, deviation, line) in points {
            flank.s.push(s);
            flank.r.push(r);
            flank.deviation.push(deviation);
            flank.line.push(line);
        }
        flank
    }

    /// Indices of the points with `from <= s < to`.
    fn window(&self, from: f64, to: f64) -> std::ops::Range<usize> {
        self.s.partition_point(|s| *s < from)..self.s.partition_point(|s| *s < to)
    }
}

/// Where the stations of an edge lie: station k covers `[k, k + 1) * step_mm`, so that no point serves two of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Windows {
    /// Number of stations.
    pub count: usize,
    /// Length of each along the edge, mm.
    pub step_mm: f64,
}

impl Windows {
    /// Arc length of the middle of station `k`, mm.
    pub fn centre(&self, k: usize) -> f64 {
        (k as f64 + 0.5) * self.step_mm
    }
}

/// From where to where a flank is used, and what is known of the data beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlankSettings {
    /// Distance from the edge up to which points are used at first, mm.
    pub reach_mm: f64,
    /// The most that the reach may grow to where the edge break is wide, mm.
    pub reach_limit_mm: f64,
    /// Points nearer to the edge than this are never used, mm.
    pub cut_mm: f64,
    /// Spacing of the points across the edge, mm: the finest step of the search for the transition zone.
    pub spacing_mm: f64,
    /// Fewest points that count as a flank.
    pub min_points: usize,
    /// Whether the design of every fit is kept, for [`FlankSeries::designs`].
    pub keep_designs: bool,
}

/// What the deviation of a flank from its nominal face is modelled by; the data of the edge choose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FlankModel {
    /// Offset, tilt across and slope along the edge: of a plane face a plane, of any other the nominal face displaced.
    #[default]
    Displaced,
    /// A bend across the edge as well.
    Bent,
    /// Bend, twist and bow, all of the second order: of a plane face a quadric.
    Quadric,
}

/// The linear map from the points of one fit to (offset, tilt), for redrawing them: see [`super::monte_carlo`].
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Design {
    /// What one point moves (offset, tilt) by, per mm.
    pub influence: Vec<[f64; 2]>,
    /// Groups of points that share noise: (group, influence of the group).
    pub groups: Vec<(u32, [f64; 2])>,
    /// Whether the groups are scan lines, which go on beyond the station.
    pub groups_are_lines: bool,
    /// Standard deviations of a point's own and of its group's noise, mm.
    pub sigma_mm: [f64; 2],
}

/// The flank at one station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlankFit {
    /// Deviation at the nominal edge, mm.
    pub offset_mm: f64,
    /// Change of the deviation per mm into the face.
    pub tilt: f64,
    /// Change of the deviation per mm along the edge.
    pub slope: f64,
    /// Coefficients of r squared (bend), r s (twist) and s squared (bow), 1/mm; 0 where the model has none.
    pub second: [f64; 3],
    /// Covariance of (offset, tilt), all that the data show: noise, correlated noise, lack of fit.
    pub covariance: [[f64; 2]; 2],
    /// Standard deviation of one point, mm.
    pub sigma_mm: f64,
    /// Points used.
    pub points: usize,
    /// Inner end of the range used, mm: the transition zone lies inside.
    pub cut_mm: f64,
    /// Whether the residuals hold more than noise.
    pub lack_of_fit: bool,
}

impl FlankFit {
    /// Deviation from the nominal face at distance `r` into the face and `s` along the edge from the station, mm.
    pub fn deviation_mm(&self, r: f64, s: f64) -> f64 {
        let [bend, twist, bow] = self.second;
        self.offset_mm + (self.tilt + bend * r + twist * s) * r + (self.slope + bow * s) * s
    }
}

/// Why a flank was not measured at a station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FlankGap {
    /// No points at all.
    NoPoints,
    /// Fewer points than needed: (seen, needed).
    TooFew(usize, usize),
    /// All points on one scan line or bunched at one end of the window.
    BadlySpread,
    /// The points reach less far from the edge than the extrapolation to it: (first, last) distance, mm.
    ShortReach(f64, f64),
    /// The points lie on a plane turned by this angle (rad) against the face: an edge break, not the face.
    Turned(f64),
}

/// A flank turned by more than this against its nominal face is another surface: the steepest draft and the worst clamping we
/// know of stay below 5 degrees, while an edge break with a land of its own (a chamfer of 15 by 75 degrees is the flattest in use)
/// turns by 15 or more.
const TURN_MAX_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// One flank along a whole edge.
#[derive(Debug, Clone, PartialEq)]
pub struct FlankSeries {
    /// One a station.
    pub stations: Vec<Result<FlankFit, FlankGap>>,
    /// Distance from the edge up to which points were used, mm.
    pub reach_mm: f64,
    /// The model that the edge needed.
    pub model: FlankModel,
    /// Whether the transition zone takes more than half of the reach somewhere and the reach could grow no further.
    pub too_wide: bool,
    /// The design of every station's fit; empty unless asked for.
    pub designs: Vec<Design>,
    /// Variance of the mean offset over the stations, over what it would be if stations shared nothing. They share scan
    /// lines that run along the edge, and form deviation.
    pub shared_factor: f64,
}

/// Measures one flank at every station of its edge.
///
/// The transition zone (edge break, spot smear, mixed points) is found from the data by [`transition::find_cuts`]; where
/// it takes more than half of the reach, the reach is doubled up to its limit. Terms of the second order join the model where
/// the stations of the edge together demand them.
pub fn measure_flank(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
) -> FlankSeries {
    measure_flank_again(points, windows, settings, &mut Memo::default())
}

/// As [`measure_flank`], of a flank that has been measured before: windows whose points are still the same are not fitted again.
pub fn measure_flank_again(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
    memo: &mut Memo,
) -> FlankSeries {
    let settled = settle_cuts::<4>(points, windows, settings, memo);
    let bent = fit_series::<4>(points, windows, &settled, memo);
    if bend_is_significant(&bent) {
        let noise = variance::estimate(&bent);
        return quadric(points, windows, (&settled, &noise), memo).unwrap_or_else(|| {
            let richer = fit_series::<5>(points, windows, &settled, memo);
            finish((bent, noise), &richer, &settled, FlankModel::Bent)
        });
    }
    // A straight flank is extrapolated with less noise, so its transition zone is seen more sharply.
    let settled = settle_cuts::<3>(points, windows, settings, memo);
    let straight = fit_series::<3>(points, windows, &settled, memo);
    let noise = variance::estimate(&straight);
    quadric(points, windows, (&settled, &noise), memo).unwrap_or_else(|| {
        let richer = fit_series::<4>(points, windows, &settled, memo);
        finish((straight, noise), &richer, &settled, FlankModel::Displaced)
    })
}

/// The flank with all terms of the second order, where a poorer model with this `noise` leaves something and twist or bow explain it.
fn quadric(
    points: &FlankPoints,
    windows: &Windows,
    (settled, noise): (&Settled, &[variance::Noise]),
    memo: &mut Memo,
) -> Option<FlankSeries> {
    if !noise.iter().any(|n| n.lack_of_fit) {
        return None;
    }
    let second = fit_series::<6>(points, windows, settled, memo);
    let noise = variance::estimate(&second);
    if !twist_or_bow_is_significant(&second, &noise) {
        return None;
    }
    let richer = fit_series::<7>(points, windows, settled, memo);
    Some(finish(
        (second, noise),
        &richer,
        settled,
        FlankModel::Quadric,
    ))
}

/// The range that every station uses.
struct Settled {
    settings: FlankSettings,
    cuts: Vec<f64>,
    too_wide: bool,
}

/// The settings with the reach that the transition zone demands, and the cut of every station.
fn settle_cuts<const P: usize>(
    points: &FlankPoints,
    windows: &Windows,
    settings: &FlankSettings,
    memo: &mut Memo,
) -> Settled {
    let mut settings = *settings;
    loop {
        let cuts = transition::find_cuts::<P>(points, windows, &settings, memo);
        let wide = cuts.iter().flatten().any(|c| c.too_wide);
        if !wide || settings.reach_mm >= settings.reach_limit_mm {
            let cut_of = |c: &Option<transition::Cut>| c.map_or(settings.cut_mm, |c| c.cut_mm);
            return Settled {
                settings,
                cuts: cuts.iter().map(cut_of).collect(),
                too_wide: wide,
            };
        }
        settings.reach_mm = (2.0 * settings.reach_mm).min(settings.reach_limit_mm);
    }
}

/// The fit of one window in the P unknowns of [`row`], with what its variance is estimated from.
#[derive(Debug, Clone)]
struct WindowFit<const P: usize> {
    fit: LinearFit<P>,
    sigma: f64,
    cut_mm: f64,
    lines: Clusters<P>,
    cells: Clusters<P>,
    /// (row, line, cell) of every point kept; empty unless designs are wanted.
    used: Vec<([f64; P], u32, u32)>,
}

type Series<const P: usize> = Vec<Result<WindowFit<P>, FlankGap>>;

/// Offset, tilt, slope, bend; then of five unknowns the cubic across, of six twist and bow, of seven all three.
fn row<const P: usize>(r: f64, s: f64) -> [f64; P] {
    let terms = match P {
        5 => [1.0, r, s, r * r, r * r * r, 0.0, 0.0],
        _ => [1.0, r, s, r * r, r * s, s * s, r * r * r],
    };
    std::array::from_fn(|k| terms[k])
}

fn fit_series<const P: usize>(
    points: &FlankPoints,
    windows: &Windows,
    settled: &Settled,
    memo: &mut Memo,
) -> Series<P> {
    let settings = &settled.settings;
    (0..windows.count)
        .map(|k| {
            let range = Range {
                centre: windows.centre(k),
                width: windows.step_mm,
                cut_mm: settled.cuts[k],
                reach_mm: settings.reach_mm,
            };
            memo.fit(points, (windows, k), &range, settings)
        })
        .collect()
}

/// The patch of a flank that one station uses.
#[derive(Debug, Clone, Copy)]
struct Range {
    centre: f64,
    width: f64,
    cut_mm: f64,
    reach_mm: f64,
}

impl Range {
    fn indices(&self, points: &FlankPoints) -> Vec<usize> {
        points
            .window(
                self.centre - 0.5 * self.width,
                self.centre + 0.5 * self.width,
            )
            .filter(|i| points.r[*i] >= self.cut_mm && points.r[*i] <= self.reach_mm)
            .collect()
    }
}

fn fit_window<const P: usize>(
    points: &FlankPoints,
    range: &Range,
    settings: &FlankSettings,
) -> Result<WindowFit<P>, FlankGap> {
    let min_points = settings.min_points;
    let indices = range.indices(points);
    if indices.is_empty() {
        return Err(FlankGap::NoPoints);
    }
    if indices.len() < min_points {
        return Err(FlankGap::TooFew(indices.len(), min_points));
    }
    check_spread(points, &indices, range)?;
    let rows: Vec<[f64; P]> = indices
        .iter()
        .map(|i| row(points.r[*i], points.s[*i] - range.centre))
        .collect();
    let values: Vec<f64> = indices.iter().map(|i| points.deviation[*i]).collect();
    let robust = fit_robust(&rows, &values, 0.0).ok_or(FlankGap::BadlySpread)?;
    if robust.fit.used < min_points {
        return Err(FlankGap::TooFew(robust.fit.used, min_points));
    }
    let kept: Vec<usize> = (0..indices.len()).filter(|k| robust.kept[*k]).collect();
    let line = |k: usize| points.line[indices[k]];
    let cell = |k: usize| {
        let along = (points.s[indices[k]] - range.centre) / range.width + 0.5;
        let into = (points.r[indices[k]] - range.cut_mm) / (range.reach_mm - range.cut_mm);
        (3.0 * along).clamp(0.0, 2.0) as u32 + 3 * (5.0 * into).clamp(0.0, 4.0) as u32
    };
    let residual = |k: usize| values[k] - robust.fit.predict(&rows[k]);
    let sample = |k: &usize, group: u32| (group, rows[*k], residual(*k));
    let used = if settings.keep_designs {
        let of = |k: &usize| (rows[*k], line(*k), cell(*k));
        kept.iter().map(of).collect()
    } else {
        Vec::new()
    };
    Ok(WindowFit {
        used,
        lines: Clusters::new(kept.iter().map(|k| sample(k, line(*k))), &robust.fit),
        cells: Clusters::new(kept.iter().map(|k| sample(k, cell(*k))), &robust.fit),
        fit: robust.fit,
        sigma: robust.sigma,
        cut_mm: range.cut_mm,
    })
}

/// Refuses points that do not hold a plane: less than a tenth of the window's spread along the edge, or an
/// extrapolation to the edge longer than twice the range that carries it.
fn check_spread(points: &FlankPoints, indices: &[usize], range: &Range) -> Result<(), FlankGap> {
    let n = indices.len() as f64;
    let moments = |values: &[f64], origin: f64| {
        let mean = indices.iter().map(|i| values[*i] - origin).sum::<f64>() / n;
        let square = indices
            .iter()
            .map(|i| (values[*i] - origin - mean).powi(2))
            .sum::<f64>();
        (mean, (square / n).sqrt())
    };
    let (mean_s, sd_s) = moments(&points.s, range.centre);
    // A uniform spread over the window has a standard deviation of 0.29 of it.
    if sd_s < 0.05 * range.width || mean_s.abs() > 2.5 * sd_s {
        return Err(FlankGap::BadlySpread);
    }
    let (mean_r, sd_r) = moments(&points.r, 0.0);
    if mean_r > 6.0 * sd_r {
        let first = indices
            .iter()
            .map(|i| points.r[*i])
            .fold(f64::MAX, f64::min);
        let last = indices.iter().map(|i| points.r[*i]).fold(0.0, f64::max);
        return Err(FlankGap::ShortReach(first, last));
    }
    Ok(())
}

/// Whether the stations together show a term in r squared: chi-square of the term over its standard uncertainty, 4
/// standard deviations above what noise gives.
fn bend_is_significant(series: &Series<4>) -> bool {
    let (mut chi, mut count) = (0.0, 0.0);
    for window in series.iter().flatten() {
        let variance = window.fit.cofactor[3][3] * window.sigma.powi(2);
        if variance > 0.0 {
            // Bounded, so that one bad station does not speak for the edge.
            chi += (window.fit.coefficients[3].powi(2) / variance).min(25.0);
            count += 1.0;
        }
    }
    count > 0.0 && chi > count + 4.0 * (2.0f64 * count).sqrt()
}

/// Whether the stations together show twist or bow, as [`bend_is_significant`] asks for the bend. Noise that a scan line shares looks like bow,
/// so that it counts here.
fn twist_or_bow_is_significant(series: &Series<6>, noise: &[variance::Noise]) -> bool {
    [4, 5].into_iter().any(|term| {
        let (mut chi, mut count) = (0.0, 0.0);
        for (window, noise) in series.iter().zip(noise) {
            let Ok(window) = window else { continue };
            let variance = noise.full(window)[term][term];
            if variance > 0.0 {
                chi += (window.fit.coefficients[term].powi(2) / variance).min(25.0);
                count += 1.0;
            }
        }
        // What lines share is known from about as many freedoms as there are stations: a quotient of two such has twice the variance.
        count > 0.0 && chi > count + 4.0 * (4.0f64 * count).sqrt()
    })
}

/// Gives every station its covariance by the noise of its fit; `richer` is the same flank in a model of one unknown more.
fn finish<const P: usize, const Q: usize>(
    (series, noise): (Series<P>, Vec<variance::Noise>),
    richer: &Series<Q>,
    settled: &Settled,
    model: FlankModel,
) -> FlankSeries {
    let form = variance::form_factors(&series, richer, &noise);
    let shared_factor = variance::shared_factor(&series, &noise, &form);
    let designs = if settled.settings.keep_designs {
        let each = series.iter().zip(noise.iter().zip(&form));
        each.map(|(window, (noise, form))| match window {
            Ok(window) => noise.design(window, *form),
            Err(_) => Design::default(),
        })
        .collect()
    } else {
        Vec::new()
    };
    let stations = series
        .into_iter()
        .zip(noise.iter().zip(form))
        .map(|(window, (noise, form))| {
            let window = window?;
            let turn_rad = window.fit.coefficients[1].atan().abs();
            if turn_rad > TURN_MAX_RAD {
                return Err(FlankGap::Turned(turn_rad));
            }
            let covariance = noise.covariance(&window).map(|row| row.map(|v| v * form));
            let term = |k: usize| window.fit.coefficients.get(k).copied().unwrap_or(0.0);
            Ok(FlankFit {
                offset_mm: window.fit.coefficients[0],
                tilt: window.fit.coefficients[1],
                slope: window.fit.coefficients[2],
                second: match model {
                    FlankModel::Displaced => [0.0; 3],
                    FlankModel::Bent => [term(3), 0.0, 0.0],
                    FlankModel::Quadric => [term(3), term(4), term(5)],
                },
                covariance,
                sigma_mm: window.sigma,
                points: window.fit.used,
                cut_mm: window.cut_mm,
                lack_of_fit: noise.lack_of_fit || form > 1.0,
            })
        })
        .collect();
    FlankSeries {
        stations,
        reach_mm: settled.settings.reach_mm,
        model,
        too_wide: settled.too_wide,
        designs,
        shared_factor,
    }
}

#[cfg(test)]
#[allow(
    clippy::print_stdout,
    reason = "the figures are to be seen with --nocapture"
)]
mod tests;
