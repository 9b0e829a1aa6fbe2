//! All edges of a nominal on layers of aligned points: their flanks and the shapes between them, kept while the points stay the same.

use std::collections::HashMap;
use std::hash::{BuildHasher, Hash, Hasher};
use std::ops::Range;

use foldhash::fast::FixedState;
use glam::DVec3;
use rayon::prelude::*;

use super::assign::{NO_FACE, Place, Surface};
use super::body::{Body, BodyEdge};
use super::collect::{self, Layer, Near, Sight, Tracks};
use super::contributions::Shared;
use super::edge_break::{self, Found, POINTS_MAX, STRETCH, Stretch, ZonePoint};
use super::flank::{FlankSeries, FlankSettings, Memo, Windows, measure_flank_again};
use super::measure::{EdgeContext, MeasureSettings, MeasuredEdge};
use super::virtual_edge::nominal_angle;
use crate::geometry::RigidTransform;
use crate::points::PointCloud;

/// Points that a flank of a station aims at: its offset is then known to a seventh of the noise.
const WANTED_POINTS: f64 = 200.0;

/// Depth of a flank in stations: deep enough that the tilt does not spoil the offset, shallow enough to stay near the edge.
const DEPTH: f64 = 3.0;

/// Scan lines that a station must hold: three hold a slope, one more to see its noise.
const LINES: f64 = 4.0;

/// Names of choices of points: within the reach, within the most that it may grow to, and others by a number with this bit set. Of the
/// others only the last one is kept.
const NARROW: u64 = 0;
const WIDE: u64 = 1;
pub(super) const OTHER: u64 = 1 << 63;

/// The shapes of an edge's stretches: by the first station, what they were found from and what was found.
type Shapes = HashMap<usize, (u64, Option<Found>), FixedState>;

/// The flanks of an edge by the choice of its points: number of points seen, how far, and what was measured.
type Kept = HashMap<u64, ((usize, u64), [FlankSeries; 2]), FixedState>;

/// The shapes found along an edge, each with its stations.
pub(super) type Breaks = Vec<(Range<usize>, Found)>;

/// Every edge of a nominal, measured on points that may still grow in number, all in one pose.
pub(super) struct Measuring<'a, B: Body> {
    body: &'a B,
    edges: Vec<BodyEdge>,
    windows: Vec<Windows>,
    settings: MeasureSettings,
    flanks: Vec<FlankSettings>,
    tracks: Tracks,
    /// How far from every edge points are seen, mm.
    room_mm: Vec<f64>,
    /// By layer.
    sights: Vec<Vec<Sight>>,
    /// Points seen, by edge.
    counts: Vec<usize>,
    kept: Vec<Kept>,
    memos: Vec<[Memo; 2]>,
    shapes: Vec<Shapes>,
    series: Vec<[FlankSeries; 2]>,
}

impl<'a, B: Body> Measuring<'a, B> {
    /// Without points; edges with a step of their own in `steps_mm` have stations of that length.
    pub(super) fn new(
        surface: &Surface<'a, B>,
        settings: &MeasureSettings,
        steps_mm: &[Option<f64>],
        keep_designs: bool,
    ) -> Self {
        let body = surface.body;
        let edges = body.edges();
        let windows: Vec<Windows> = edges
            .iter()
            .enumerate()
            .map(|(e, edge)| windows_of(edge, steps_mm.get(e).copied().flatten(), settings))
            .collect();
        let flanks: Vec<FlankSettings> = (0..edges.len())
            .map(|e| {
                let middle = body.station(e, 0.5 * edges[e].length_mm);
                let angle = nominal_angle(&middle, edges[e].kind);
                FlankSettings {
                    keep_designs,
                    ..flank_settings(&windows[e], angle, settings)
                }
            })
            .collect();
        Self {
            body,
            tracks: Tracks::new(body, &edges, &windows),
            room_mm: flanks.iter().map(|s| s.reach_mm).collect(),
            sights: Vec::new(),
            counts: vec![0; edges.len()],
            kept: vec![Kept::default(); edges.len()],
            memos: edges.iter().map(|_| Default::default()).collect(),
            shapes: vec![Shapes::default(); edges.len()],
            series: Vec::new(),
            edges,
            windows,
            settings: *settings,
            flanks,
        }
    }

    /// Takes one more layer.
    pub(super) fn add(&mut self, layer: &Layer<'_>) {
        let sights = layer.sights(&self.tracks, &self.room_mm);
        for sight in &sights {
            self.counts[sight.edge()] += 1;
        }
        self.sights.push(sights);
    }

    /// Sees at least as far as `radius_mm`.
    fn widen(&mut self, layers: &[Layer<'_>], radius_mm: &[f64]) {
        let wider = |(room, radius): (&f64, &f64)| radius > room;
        if !self.room_mm.iter().zip(radius_mm).any(wider) {
            return;
        }
        for (room, radius) in self.room_mm.iter_mut().zip(radius_mm) {
            *room = room.max(*radius);
        }
        self.sights.clear();
        self.counts.fill(0);
        for layer in layers {
            self.add(layer);
        }
    }

    fn all_sights(&self) -> Vec<&[Sight]> {
        self.sights.iter().map(Vec::as_slice).collect()
    }

    /// Measures both flanks of all edges. Where the transition zone of an edge turns out wider than assumed, the edges that share a
    /// face with it are measured again without the points in it.
    pub(super) fn measure(&mut self, layers: &[Layer<'_>]) {
        let settings = self.flanks.clone();
        // First without room to grow: few edges need it.
        let narrow: Vec<FlankSettings> = settings
            .iter()
            .map(|s| FlankSettings {
                reach_limit_mm: s.reach_mm,
                ..*s
            })
            .collect();
        // Of the other edges of a face more is left out than of the own: a displaced face moves its neighbour's edge.
        let assumed: Vec<[f64; 2]> = settings
            .iter()
            .map(|s| [2.0 * s.cut_mm.max(2.0 * s.spacing_mm); 2])
            .collect();
        let all: Vec<usize> = (0..settings.len()).collect();
        let reach: Vec<f64> = settings.iter().map(|s| s.reach_mm).collect();
        let first = vec![NARROW; all.len()];
        let mut series = self.fit((&all, &first), &assumed, &reach, &narrow);
        let wide: Vec<bool> = series
            .iter()
            .map(|pair| pair.iter().any(|s| s.too_wide))
            .collect();
        let room: Vec<f64> = (0..settings.len())
            .map(|e| {
                let s = &settings[e];
                if wide[e] {
                    s.reach_limit_mm
                } else {
                    s.reach_mm
                }
            })
            .collect();
        self.widen(layers, &room);
        let ample: Vec<FlankSettings> = (0..settings.len())
            .map(|e| FlankSettings {
                reach_limit_mm: room[e],
                ..settings[e]
            })
            .collect();
        let grow: Vec<usize> = all
            .iter()
            .copied()
            .filter(|e| wide[*e] && room[*e] > settings[*e].reach_mm)
            .collect();
        let wider = vec![WIDE; grow.len()];
        let grown = self.fit((&grow, &wider), &assumed, &room, &ample);
        for (e, pair) in grow.iter().zip(grown) {
            series[*e] = pair;
        }
        let seen: Vec<[f64; 2]> = series
            .iter()
            .zip(&assumed)
            .map(|(pair, least)| [0, 1].map(|i| widest_cut(&pair[i]).max(least[i])))
            .collect();
        let mut disturbed = vec![false; self.body.face_count()];
        for (e, edge) in self.edges.iter().enumerate() {
            for side in 0..2 {
                disturbed[edge.faces[side] as usize] |= seen[e][side] > assumed[e][side];
            }
        }
        let again: Vec<usize> = all
            .into_iter()
            .filter(|e| self.edges[*e].faces.iter().any(|f| disturbed[*f as usize]))
            .collect();
        // Points are left out by the edges of the same faces only.
        let beside = |e: usize, other: &BodyEdge| {
            let faces = self.edges[e].faces;
            other.faces.iter().any(|face| faces.contains(face))
        };
        let choices: Vec<u64> = again
            .iter()
            .map(|e| {
                let cuts = self.edges.iter().zip(&seen);
                let cuts = cuts.filter(|(other, _)| beside(*e, other));
                let cuts: Vec<[u64; 2]> = cuts.map(|(_, c)| c.map(f64::to_bits)).collect();
                FixedState::default().hash_one(cuts) | OTHER
            })
            .collect();
        let measured = self.fit((&again, &choices), &seen, &room, &ample);
        for (e, pair) in again.iter().zip(measured) {
            series[*e] = pair;
        }
        self.series = series;
    }

    /// The flanks of the edges `wanted`; `choices` name the choice of points that `cuts` make for each.
    fn fit(
        &mut self,
        (wanted, choices): (&[usize], &[u64]),
        cuts: &[[f64; 2]],
        radius_mm: &[f64],
        settings: &[FlankSettings],
    ) -> Vec<[FlankSeries; 2]> {
        let state = |e: usize| (self.counts[e], radius_mm[e].to_bits());
        let is_known = |(e, choice): (&usize, &u64)| {
            let known = self.kept[*e].get(choice);
            known.is_some_and(|(known, _)| *known == state(*e))
        };
        let (changed, chosen): (Vec<usize>, Vec<u64>) = wanted
            .iter()
            .zip(choices)
            .filter(|named| !is_known(*named))
            .unzip();
        if !changed.is_empty() {
            let points = collect::flanks(&self.all_sights(), &changed, cuts, radius_mm);
            let windows = &self.windows;
            let memos = self.memos.iter_mut().enumerate();
            let memos: Vec<(usize, &mut [Memo; 2])> =
                memos.filter(|(e, _)| changed.contains(e)).collect();
            let measured: Vec<[FlankSeries; 2]> = memos
                .into_par_iter()
                .zip(points)
                .zip(&chosen)
                .map(|(((e, [first, second]), pair), choice)| {
                    let measure = |memo: &mut Memo, i: usize| {
                        memo.choose(*choice);
                        measure_flank_again(&pair[i], &windows[e], &settings[e], memo)
                    };
                    let (a, b) = rayon::join(|| measure(first, 0), || measure(second, 1));
                    [a, b]
                })
                .collect();
            for ((e, choice), pair) in changed.iter().zip(chosen).zip(measured) {
                let state = (self.counts[*e], radius_mm[*e].to_bits());
                let kept = &mut self.kept[*e];
                kept.retain(|other, _| *other == choice || (*other & OTHER) == 0);
                kept.insert(choice, (state, pair));
            }
        }
        let kept = |(e, choice): (&usize, &u64)| self.kept[*e].get(choice).map(|(_, p)| p.clone());
        wanted.iter().zip(choices).filter_map(kept).collect()
    }

    /// What combines the flanks of edge `e` into values.
    pub(super) fn context(
        &self,
        e: usize,
        settings: &MeasureSettings,
        centre: DVec3,
    ) -> EdgeContext<'_, B> {
        EdgeContext {
            body: self.body,
            index: e,
            edge: &self.edges[e],
            settings: *settings,
            shared: Shared {
                pose_covariance: settings.pose_covariance,
                u_calibration_mm: settings.u_calibration_mm,
                expansion: settings.expansion,
                centre,
            },
        }
    }

    /// The points of every edge's transition zone, by name.
    fn near(&mut self, layers: &[Layer<'_>]) -> Vec<Vec<Near>> {
        let spacing_mm = self.settings.along_mm;
        let radius = |pair: &[FlankSeries; 2]| {
            let fits = || pair.iter().flat_map(|s| s.stations.iter().flatten());
            let cut = fits().map(|f| f.cut_mm).fold(0.0, f64::max);
            let off = fits().map(|f| f.offset_mm.abs()).fold(0.0, f64::max);
            let seen = pair.iter().all(|s| s.stations.iter().any(Result::is_ok));
            let reach = Stretch::reach_of(cut, spacing_mm);
            if seen {
                reach + 2.0 * off.min(reach)
            } else {
                0.0
            }
        };
        let radius: Vec<f64> = self.series.iter().map(radius).collect();
        self.widen(layers, &radius);
        let stretch: Vec<f64> = self
            .windows
            .iter()
            .map(|w| STRETCH as f64 * w.step_mm)
            .collect();
        collect::near(
            &self.all_sights(),
            &self.edges,
            &radius,
            &stretch,
            POINTS_MAX,
        )
    }

    /// The points of every edge's transition zone.
    pub(super) fn zones(&mut self, layers: &[Layer<'_>]) -> Vec<Vec<ZonePoint>> {
        let near = self.near(layers);
        let zone = |(e, near): (usize, Vec<Near>)| self.zone(layers, e, &near);
        near.into_par_iter().enumerate().map(zone).collect()
    }

    fn zone(&self, layers: &[Layer<'_>], e: usize, near: &[Near]) -> Vec<ZonePoint> {
        let edge = (e, &self.edges[e]);
        let point = |near: &Near| collect::zone_point(self.body, &self.tracks, edge, layers, *near);
        near.iter().filter_map(point).collect()
    }

    /// The shapes between the flanks, by edge.
    pub(super) fn breaks(&mut self, layers: &[Layer<'_>]) -> Vec<Breaks> {
        let near = self.near(layers);
        let mut shapes = std::mem::take(&mut self.shapes);
        let this = &*self;
        let found = shapes
            .par_iter_mut()
            .zip(&near)
            .enumerate()
            .map(|(e, (shapes, near))| this.breaks_of(layers, e, near, shapes))
            .collect();
        self.shapes = shapes;
        found
    }

    fn breaks_of(
        &self,
        layers: &[Layer<'_>],
        e: usize,
        near: &[Near],
        shapes: &mut Shapes,
    ) -> Breaks {
        let (windows, series) = (&self.windows[e], &self.series[e]);
        let context = self.context(e, &self.settings, DVec3::ZERO);
        let edges = context.virtual_edges(windows, series);
        let mut breaks = Vec::new();
        for (range, mut stretch) in context.stretches(windows, series, &[], &edges) {
            let from = range.start as f64 * windows.step_mm;
            let to = range.end as f64 * windows.step_mm;
            let own = near.partition_point(|n| n.0 < from)..near.partition_point(|n| n.0 < to);
            let near = &near[own];
            let name = name_of(&stretch, near);
            let known = shapes.get(&range.start).filter(|known| known.0 == name);
            let found = match known {
                Some((_, found)) => found.clone(),
                None => {
                    let points = self.zone(layers, e, near);
                    stretch.points = &points;
                    let found = edge_break::measure_stretch(&stretch);
                    shapes.insert(range.start, (name, found.clone()));
                    found
                }
            };
            breaks.extend(found.map(|found| (range, found)));
        }
        breaks
    }

    /// Values of all edges, of the flanks and breaks as they are, moved by `motion` of the points since.
    pub(super) fn combined(
        &self,
        breaks: &[Breaks],
        motion: &RigidTransform,
        settings: &MeasureSettings,
        centre: DVec3,
    ) -> Vec<MeasuredEdge> {
        (0..self.edges.len())
            .into_par_iter()
            .map(|e| {
                let context = self.context(e, settings, centre);
                let series = self.moved(e, motion);
                context.combine(&self.windows[e], &series, &breaks[e])
            })
            .collect()
    }

    /// The flanks of edge `e` after a small motion of the points: exact where the face is plane, elsewhere to first order.
    fn moved(&self, e: usize, motion: &RigidTransform) -> [FlankSeries; 2] {
        let mut series = self.series[e].clone();
        if *motion == RigidTransform::IDENTITY {
            return series;
        }
        for k in 0..self.windows[e].count {
            let station = self.body.station(e, self.windows[e].centre(k));
            for (i, flank) in series.iter_mut().enumerate() {
                let Ok(fit) = &mut flank.stations[k] else {
                    continue;
                };
                let [n, b] = [station.normals[i], station.into_face[i]];
                fit.offset_mm += n.dot(motion.point(station.point) - station.point);
                fit.tilt += n.dot(motion.vector(b));
                fit.slope += n.dot(motion.vector(station.tangent));
            }
        }
        series
    }

    pub(super) fn edges(&self) -> &[BodyEdge] {
        &self.edges
    }

    /// What is measured with.
    pub(super) fn settings(&self) -> &MeasureSettings {
        &self.settings
    }

    pub(super) fn windows(&self) -> &[Windows] {
        &self.windows
    }

    pub(super) fn series(&self) -> &[[FlankSeries; 2]] {
        &self.series
    }
}

fn widest_cut(series: &FlankSeries) -> f64 {
    let cuts = series.stations.iter().flatten().map(|f| f.cut_mm);
    cuts.fold(0.0, f64::max)
}

/// A number for what a shape is found from: the flanks and the points.
fn name_of(stretch: &Stretch<'_>, near: &[Near]) -> u64 {
    let mut hasher = FixedState::default().build_hasher();
    for wedge in &stretch.wedges {
        wedge.s.to_bits().hash(&mut hasher);
        for fit in wedge.flanks {
            let values = [
                fit.offset_mm,
                fit.tilt,
                fit.slope,
                fit.second[0],
                fit.second[1],
                fit.second[2],
                fit.cut_mm,
                fit.sigma_mm,
            ];
            values.map(f64::to_bits).hash(&mut hasher);
            fit.covariance
                .as_flattened()
                .iter()
                .for_each(|c| c.to_bits().hash(&mut hasher));
        }
    }
    stretch.shared_factor.map(f64::to_bits).hash(&mut hasher);
    for (_, layer, point, side) in near {
        (layer, point, side).hash(&mut hasher);
    }
    hasher.finish()
}

/// The mean of the points that lie on the part: what a least-squares pose holds.
pub(super) fn centre(layers: &[Layer<'_>]) -> DVec3 {
    let (mut sum, mut count) = (DVec3::ZERO, 0.0);
    for layer in layers {
        for (p, place) in layer.positions.iter().zip(layer.places) {
            if place.face != NO_FACE {
                sum += *p;
                count += 1.0;
            }
        }
    }
    sum / f64::max(count, 1.0)
}

/// Every sharp edge of `surface` on `cloud`, measured at once.
pub(super) fn measured<B: Body>(
    cloud: &PointCloud,
    places: &[Place],
    surface: &Surface<'_, B>,
    (settings, steps_mm): (&MeasureSettings, &[Option<f64>]),
) -> Vec<MeasuredEdge> {
    let layers = [Layer::new(cloud, places)];
    let mut measuring = Measuring::new(surface, settings, steps_mm, false);
    measuring.add(&layers[0]);
    measuring.measure(&layers);
    let breaks = measuring.breaks(&layers);
    measuring.combined(
        &breaks,
        &RigidTransform::IDENTITY,
        settings,
        centre(&layers),
    )
}

/// Stations about as long as needed for [`WANTED_POINTS`] and [`LINES`], a whole number of them on the edge.
fn windows_of(edge: &BodyEdge, step_mm: Option<f64>, settings: &MeasureSettings) -> Windows {
    let area = settings.along_mm * settings.across_mm;
    let derived = (WANTED_POINTS * area / DEPTH)
        .sqrt()
        .max(LINES * settings.across_mm);
    let step = step_mm
        .or(settings.station_step_mm)
        .unwrap_or(derived)
        .max(1e-9);
    // No more than a hundred thousand stations, whatever the step.
    let count = (edge.length_mm / step).round().clamp(1.0, 1e5);
    Windows {
        count: count as usize,
        step_mm: edge.length_mm / count,
    }
}

fn flank_settings(
    windows: &Windows,
    included_angle_rad: f64,
    settings: &MeasureSettings,
) -> FlankSettings {
    let area = settings.along_mm * settings.across_mm;
    // A short edge or a given step makes the window narrow; the reach then makes up for the points.
    let derived = (DEPTH * windows.step_mm)
        .max(WANTED_POINTS * area / windows.step_mm)
        .min(
            DEPTH
                * (WANTED_POINTS * area / DEPTH)
                    .sqrt()
                    .max(LINES * settings.across_mm),
        );
    let reach_mm = settings.flank_mm.unwrap_or(derived).max(1e-9);
    // Noise takes points nearer than this over the bisector to the other flank; the search for the transition zone does the rest.
    let half = 0.5 * included_angle_rad.min(std::f64::consts::TAU - included_angle_rad);
    let mixed = 4.0 * settings.noise_mm / half.tan().clamp(0.1, 1.0);
    FlankSettings {
        reach_mm,
        reach_limit_mm: settings.flank_mm.unwrap_or(4.0 * reach_mm),
        cut_mm: mixed
            .max(settings.along_mm)
            .clamp(1e-3 * reach_mm, 0.2 * reach_mm),
        spacing_mm: settings.along_mm.max(1e-9),
        min_points: 12,
        keep_designs: false,
    }
}
