//! Propagation of distributions by the Monte Carlo method: the check on the first-order uncertainties.
//!
//! Every trial redraws all inputs - each point's noise about its fitted flank, the noise that scan lines or form share, the pose, the
//! calibration, the part's temperature and expansion - and runs the measurement on them: the flank fits, the exact intersection with the
//! curved faces, the exact motion and growth. Trials are drawn in blocks until the results stand still.
//!
//! Edge breaks are drawn as well, in a tenth of the trials (see [`super::edge_break`]), and what follows from whole edges - form, corners,
//! gaps - from as many trials of all stations together.
//!
//! Source: JCGM 101:2008, 5.9 and 7.9 (adaptive procedure). We differ: which points a flank uses is kept from the measurement, and the
//! values stay those of the measurement: the trials give their uncertainty.

mod derived;

use glam::{DQuat, DVec3};
use nalgebra::{Matrix6, SymmetricEigen};
use rayon::prelude::*;

use super::assign::{Place, Surface};
use super::body::Body;
use super::collect::Layer;
use super::edge_break::draw_stretch;
use super::flank::{Design, FlankFit};
use super::measure::{EdgeContext, MeasureSettings, MeasuredEdge, shift_across};
use super::measuring::{Measuring, centre};
use super::result::Measured;
use crate::nominal::Station;
use crate::points::PointCloud;

pub(super) use derived::Derivation;
pub use derived::StationTrials;

/// How many trials, and from which numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MonteCarlo {
    /// Seed of all draws; the same seed gives the same bits for any number of threads.
    pub seed: u64,
    /// Trials of a block; JCGM 101 asks for at least 10,000.
    pub block: usize,
    /// Blocks after which it ends, stable or not; not before where it is not `adaptive`.
    pub blocks_max: usize,
    /// Whether it ends as soon as the values stand still.
    pub adaptive: bool,
    /// Significant digits of the standard uncertainty that must stand (JCGM 101, 7.9.2): 1 or 2.
    pub digits: u32,
    /// Probability of the interval.
    pub probability: f64,
}

impl Default for MonteCarlo {
    fn default() -> Self {
        Self {
            seed: 1,
            block: 10_000,
            blocks_max: 20,
            adaptive: true,
            digits: 2,
            probability: 0.95,
        }
    }
}

impl MonteCarlo {
    /// As many trials as asked for, stable or not.
    pub fn of_trials(trials: usize) -> Self {
        let blocks_max = 10;
        Self {
            block: trials.div_ceil(blocks_max),
            blocks_max,
            adaptive: false,
            ..Self::default()
        }
    }

    /// Trials of an edge break: each fits a shape to a thousand points.
    fn break_trials(&self) -> usize {
        (self.block * self.blocks_max / 10).clamp(200, 2000)
    }
}

/// What the trials of an inspection came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trials {
    /// Seed of all draws.
    pub seed: u64,
    /// Fewest and most trials of a station; 0 where none was measured.
    pub stations: [usize; 2],
    /// Stations whose values did not stand still to the digits asked for when the trials ended.
    pub unstable: usize,
    /// Most trials of an edge break.
    pub breaks: usize,
    /// Trials of form, corners and gaps.
    pub derived: usize,
}

/// A value as its trials show it, in the unit of the field that holds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drawn {
    /// Mean of the trials.
    pub mean: f64,
    /// Their standard deviation.
    pub u: f64,
    /// Probabilistically symmetric interval of the probability asked for.
    pub interval: [f64; 2],
}

/// One station.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawnStation {
    /// d1, d2, mm.
    pub d_mm: [Drawn; 2],
    /// Included angle, rad.
    pub included_angle_rad: Drawn,
    /// Distance across the tangent, mm.
    pub total_mm: Drawn,
    /// Trials drawn.
    pub trials: usize,
    /// Whether the values stand still to the digits asked for.
    pub stable: bool,
}

/// The stations of every edge, as [`super::measure::measure_edges`] gives them; `None` where a station was not measured.
pub fn measure_monte_carlo<B: Body>(
    cloud: &PointCloud,
    places: &[Place],
    surface: &Surface<'_, B>,
    settings: &MeasureSettings,
    how: &MonteCarlo,
) -> Vec<Vec<Option<DrawnStation>>> {
    let pose = root(&settings.pose_covariance);
    let layers = [Layer::new(cloud, places)];
    let flanks = with_designs(&layers, surface, (settings, &[]));
    let draw = |e: usize, k: usize| {
        let drawn = station(&flanks, settings, &pose, (how, 0), (e, k));
        drawn.map(|(drawn, _)| drawn)
    };
    (0..flanks.measuring.series().len())
        .map(|e| {
            (0..flanks.measuring.windows()[e].count)
                .into_par_iter()
                .map(|k| draw(e, k))
                .collect()
        })
        .collect()
}

/// The flanks of all edges with the designs of their fits.
struct Flanks<'a, B: Body> {
    measuring: Measuring<'a, B>,
    centre: DVec3,
}

fn with_designs<'a, B: Body>(
    layers: &[Layer<'_>; 1],
    surface: &Surface<'a, B>,
    (settings, steps_mm): (&MeasureSettings, &[Option<f64>]),
) -> Flanks<'a, B> {
    let mut measuring = Measuring::new(surface, settings, steps_mm, true);
    measuring.add(&layers[0]);
    measuring.measure(layers);
    Flanks {
        measuring,
        centre: centre(layers),
    }
}

/// As [`super::measure::measure_edges_stepped`], with the uncertainties of d1, d2, the total, the included angle and the edge breaks from
/// trials, and the first trials of every station. `told` hears how many edges of how many are done.
pub fn measure_edges_drawn<B: Body>(
    cloud: &PointCloud,
    places: &[Place],
    surface: &Surface<'_, B>,
    (settings, steps_mm): (&MeasureSettings, &[Option<f64>]),
    how: &MonteCarlo,
    told: &(dyn Fn(usize, usize) + Sync),
) -> (Vec<MeasuredEdge>, Trials, StationTrials) {
    let pose = root(&settings.pose_covariance);
    let layers = [Layer::new(cloud, places)];
    let mut flanks = with_designs(&layers, surface, (settings, steps_mm));
    let zones = flanks.measuring.zones(&layers);
    let breaks = flanks.measuring.breaks(&layers);
    let (flanks, measuring) = (&flanks, &flanks.measuring);
    let all: usize = measuring.windows().iter().map(|w| w.count).sum();
    let keep = StationTrials::count(how.break_trials(), all);
    let mut kept = StationTrials::new(keep);
    let mut trials = Trials {
        seed: how.seed,
        stations: [usize::MAX, 0],
        unstable: 0,
        breaks: 0,
        derived: keep,
    };
    let count = measuring.series().len();
    let mut edges = Vec::with_capacity(count);
    for (e, zone) in zones.iter().enumerate() {
        told(e, count);
        let context = measuring.context(e, settings, flanks.centre);
        let (windows, series) = (&measuring.windows()[e], &measuring.series()[e]);
        let mut edge = context.combine(windows, series, &breaks[e]);
        let drawn: Vec<Option<(DrawnStation, Vec<[f64; 2]>)>> = (0..windows.count)
            .into_par_iter()
            .map(|k| station(flanks, settings, &pose, (how, keep), (e, k)))
            .collect();
        let mut first = Vec::with_capacity(windows.count);
        for (station, drawn) in edge.stations.iter_mut().zip(drawn) {
            let (drawn, d_mm) = drawn.unzip();
            first.push(d_mm.unwrap_or_default());
            if let (Ok(measured), Some(drawn)) = (&mut station.outcome, drawn) {
                take_over(measured, &drawn);
                trials.stations[0] = trials.stations[0].min(drawn.trials);
                trials.stations[1] = trials.stations[1].max(drawn.trials);
                trials.unstable += usize::from(!drawn.stable);
            }
        }
        let virtual_edges = context.virtual_edges(windows, series);
        let stretches = context.stretches(windows, series, zone, &virtual_edges);
        let breaks: Vec<_> = stretches
            .par_iter()
            .map(|(range, stretch)| {
                let place = ((e as u64) << 32) ^ range.start as u64 ^ (1 << 63);
                draw_stretch(stretch, own_seed(how.seed, place), how.break_trials())
            })
            .collect();
        for (shape, drawn) in edge.breaks.iter_mut().zip(breaks.into_iter().flatten()) {
            *shape = drawn.shape;
            trials.breaks = trials.breaks.max(drawn.trials);
        }
        edges.push(edge);
        kept.push(first);
    }
    told(count, count);
    trials.stations[0] = trials.stations[0].min(trials.stations[1]);
    (edges, trials, kept)
}

/// The standard uncertainties of a station by its trials. That of the total is about its value: near zero, where a distance cannot fall
/// below, the trials lie on one side of it.
fn take_over(measured: &mut Measured, drawn: &DrawnStation) {
    measured.u_d_mm = drawn.d_mm.map(|d| d.u);
    measured.u_included_angle_rad = drawn.included_angle_rad.u;
    let bias = drawn.total_mm.mean - measured.total_mm.value;
    measured.total_mm.u = drawn.total_mm.u.hypot(bias);
}

/// Marks the seeds of draws that belong to a face, apart from those of stations and edge breaks.
const FACE: u64 = 1 << 62;

/// The seed of a place's own draws.
fn own_seed(seed: u64, place: u64) -> u64 {
    seed ^ place.wrapping_add(1).wrapping_mul(0x9FB2_1C65_1E98_DF25)
}

/// The symmetric square root of a covariance.
fn root(covariance: &[[f64; 6]; 6]) -> [[f64; 6]; 6] {
    let matrix = Matrix6::from_fn(|i, j| 0.5 * (covariance[i][j] + covariance[j][i]));
    let eigen = SymmetricEigen::new(matrix);
    let scaled = Matrix6::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0).sqrt()));
    let root = eigen.eigenvectors * scaled * eigen.eigenvectors.transpose();
    std::array::from_fn(|i| std::array::from_fn(|j| root[(i, j)]))
}

/// Station `k` of edge `e` by its trials, and d1 and d2 of the first `keep` of them, mm.
fn station<B: Body>(
    flanks: &Flanks<'_, B>,
    settings: &MeasureSettings,
    pose: &[[f64; 6]; 6],
    (how, keep): (&MonteCarlo, usize),
    (e, k): (usize, usize),
) -> Option<(DrawnStation, Vec<[f64; 2]>)> {
    let pair = &flanks.measuring.series()[e];
    let (Ok(first), Ok(second)) = (&pair[0].stations[k], &pair[1].stations[k]) else {
        return None;
    };
    let context = flanks.measuring.context(e, settings, flanks.centre);
    let faces = context.edge.faces;
    let model = Model {
        station: context.station(&flanks.measuring.windows()[e], k),
        context,
        fits: [first, second],
        designs: [pair[0].designs.get(k)?, pair[1].designs.get(k)?],
        settings,
        pose,
    };
    model.trial(&mut Inputs::none())?;
    let mut first = Vec::with_capacity(keep);
    let mut trials: [Vec<f64>; 4] = Default::default();
    let mut blocks: Vec<[Drawn; 4]> = Vec::new();
    let mut stable = false;
    let size = how.block.clamp(100, 1_000_000);
    while blocks.len() < how.blocks_max.clamp(2, 1000) && !(stable && how.adaptive) {
        let from = blocks.len() * size;
        for t in from..from + size {
            let place = ((e as u64) << 32) ^ k as u64;
            let mut inputs = Inputs {
                shared: Some(Draws::new(how.seed, t as u64)),
                own: Some(Draws::new(own_seed(how.seed, place), t as u64)),
                faces: faces
                    .map(|face| Some((own_seed(how.seed, FACE | u64::from(face)), t as u64))),
            };
            // Flanks that a draw makes parallel have no edge; one that was measured is far from it.
            if let Some(values) = model.trial(&mut inputs) {
                if t < keep {
                    first.push([values[0], values[1]]);
                }
                for (list, value) in trials.iter_mut().zip(values) {
                    list.push(value);
                }
            }
        }
        let of = |list: &Vec<f64>| summary(&list[from.min(list.len())..], how.probability);
        blocks.push(trials.each_ref().map(of));
        stable = stands_still(&blocks, how.digits);
    }
    let all = trials.each_ref().map(|list| summary(list, how.probability));
    let drawn = DrawnStation {
        d_mm: [all[0], all[1]],
        included_angle_rad: all[2],
        total_mm: all[3],
        trials: trials[0].len(),
        stable,
    };
    Some((drawn, first))
}

fn summary(values: &[f64], probability: f64) -> Drawn {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let tail = 0.5 * (1.0 - probability);
    let at = |share: f64| {
        let index = (share * n).round() as usize;
        sorted
            .get(index.min(sorted.len().saturating_sub(1)))
            .copied()
            .unwrap_or(mean)
    };
    Drawn {
        mean,
        u: (square / (n - 1.0).max(1.0)).sqrt(),
        interval: [at(tail), at(1.0 - tail)],
    }
}

/// JCGM 101, 7.9.4: twice the standard deviation of the mean of every result over the blocks is below half a unit of the last digit.
fn stands_still(blocks: &[[Drawn; 4]], digits: u32) -> bool {
    let h = blocks.len() as f64;
    if h < 2.0 {
        return false;
    }
    (0..4).all(|v| {
        let of = |pick: fn(&Drawn) -> f64| {
            let mean = blocks.iter().map(|b| pick(&b[v])).sum::<f64>() / h;
            let square = blocks
                .iter()
                .map(|b| (pick(&b[v]) - mean).powi(2))
                .sum::<f64>();
            (mean, (square / (h * (h - 1.0))).sqrt())
        };
        let (u, s_u) = of(|d| d.u);
        let tolerance =
            0.5 * 10f64.powf(u.max(1e-300).log10().floor() - f64::from(digits.clamp(1, 3) - 1));
        [
            s_u,
            of(|d| d.mean).1,
            of(|d| d.interval[0]).1,
            of(|d| d.interval[1]).1,
        ]
        .iter()
        .all(|s| 2.0 * s < tolerance)
    })
}

/// The measurement of one station as a function of its inputs.
struct Model<'a, B: Body> {
    context: EdgeContext<'a, B>,
    station: Station,
    fits: [&'a FlankFit; 2],
    designs: [&'a Design; 2],
    settings: &'a MeasureSettings,
    pose: &'a [[f64; 6]; 6],
}

/// What a trial draws from: the inputs that all stations share, the station's own, and by flank the seed and the trial of what the stations
/// on its face share: the calibration, which errs alike in one direction, and the noise of scan lines.
struct Inputs {
    shared: Option<Draws>,
    own: Option<Draws>,
    faces: [Option<(u64, u64)>; 2],
}

impl Inputs {
    /// Every input at its estimate.
    fn none() -> Self {
        Self {
            shared: None,
            own: None,
            faces: [None; 2],
        }
    }

    /// What all stations on the face of flank `i` share, by a number.
    fn of_face(&self, i: usize, what: u64) -> f64 {
        self.faces[i].map_or(0.0, |(seed, t)| {
            Draws::new(own_seed(seed, what), t).normal()
        })
    }

    fn shared(&mut self) -> f64 {
        self.shared.as_mut().map_or(0.0, Draws::normal)
    }

    /// What new noise on all points of the fit of flank `i` adds to (offset, tilt).
    fn redraw(&mut self, design: &Design, i: usize) -> [f64; 2] {
        let mut sum = [0.0; 2];
        let mut add = |influence: &[f64; 2], noise: f64| {
            sum[0] += influence[0] * noise;
            sum[1] += influence[1] * noise;
        };
        let [alone, together] = design.sigma_mm;
        let Some(own) = &mut self.own else { return sum };
        for influence in &design.influence {
            add(influence, alone * own.normal());
        }
        for (group, influence) in &design.groups {
            let noise = match design.groups_are_lines {
                true => self.faces[i].map_or(0.0, |(seed, t)| {
                    Draws::new(own_seed(seed, u64::from(*group)), t).normal()
                }),
                false => own.normal(),
            };
            add(influence, together * noise);
        }
        sum
    }
}

/// The calibration among what a face shares; scan lines have the smaller numbers.
const CALIBRATION: u64 = 1 << 33;

impl<B: Body> Model<'_, B> {
    /// d1, d2, the included angle and the total.
    fn trial(&self, inputs: &mut Inputs) -> Option<[f64; 4]> {
        let drawn: [FlankFit; 2] = std::array::from_fn(|i| {
            let [offset, tilt] = inputs.redraw(self.designs[i], i);
            FlankFit {
                offset_mm: self.fits[i].offset_mm + offset,
                tilt: self.fits[i].tilt + tilt,
                ..*self.fits[i]
            }
        });
        let edge = self
            .context
            .virtual_edge(&self.station, [&drawn[0], &drawn[1]])?;
        let unit: [f64; 6] = std::array::from_fn(|_| inputs.shared());
        let motion: [f64; 6] =
            std::array::from_fn(|i| (0..6).map(|j| self.pose[i][j] * unit[j]).sum());
        let turn = DQuat::from_scaled_axis(DVec3::new(motion[0], motion[1], motion[2]));
        let mut p = turn * edge.point + DVec3::new(motion[3], motion[4], motion[5]);
        if let Some(expansion) = &self.settings.expansion {
            let mut drawn = *expansion;
            drawn.coefficient_per_k += expansion.u_coefficient_per_k * inputs.shared();
            drawn.temperature_c += expansion.u_temperature_k * inputs.shared();
            let centre = self.context.shared.centre;
            p = centre + (p - centre) / (1.0 + drawn.strain());
        }
        let d = [0, 1].map(|i| {
            (p - self.station.point).dot(self.station.normals[i])
                + self.settings.u_calibration_mm * inputs.of_face(i, CALIBRATION)
        });
        let angle = edge.included_angle_rad + self.settings.u_calibration_rad * inputs.shared();
        Some([d[0], d[1], angle, shift_across(&self.station, d).length()])
    }
}

/// Normal numbers from a counter: SplitMix64 and the polar form of Box and Muller.
pub(super) struct Draws {
    state: u64,
    spare: Option<f64>,
}

impl Draws {
    pub(super) fn new(seed: u64, trial: u64) -> Self {
        let mut draws = Self {
            state: seed ^ trial.wrapping_mul(0xD6E8_FEB8_6659_FD93),
            spare: None,
        };
        // Neighbouring seeds start apart.
        draws.state = draws.bits();
        draws
    }

    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    pub(super) fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        loop {
            let [x, y] =
                [0; 2].map(|_| (self.bits() >> 11) as f64 * (2.0 / (1u64 << 53) as f64) - 1.0);
            let square = x * x + y * y;
            if square > 0.0 && square < 1.0 {
                let scale = (-2.0 * square.ln() / square).sqrt();
                self.spare = Some(y * scale);
                return x * scale;
            }
        }
    }
}
