//! An inspection that goes on while the scan runs, so that little is left to do when it ends.
//!
//! The scan comes in pieces. When enough of it is there the pose is found and every piece is laid on the nominal: places, sights from
//! edges, patches. Flanks and shapes are measured as the points come, and again only where points have joined. At the end the pose is
//! solved for by all points; the values follow the small motion to it by first order, which for plane faces is exact. Where the motion
//! is not small, everything is laid again: better on the way than at the end, so that the pose is asked for on the way as well.

use std::collections::HashSet;

use foldhash::fast::FixedState;
use glam::{DMat3, IVec3};
use rayon::prelude::*;
use serde::Serialize;

use super::align::{
    Aligned, Candidates, Conclusion, LaidPoint, Scan, Twist, align_again, align_keeping, settle,
};
use super::assign::{Place, Surface, towards};
use super::attention::{CellSet, Outline, Patches};
use super::body::Body;
use super::collect::Layer;
use super::compare::{self, Scanned};
use super::measure::{MeasureSettings, MeasuredEdge};
use super::measuring::{Measuring, centre};
use super::recipe::Resolved;
use super::result::{Inspection, ScanEstimate, Verdict};
use super::{
    Datums, GATE, Request, Stages, Start, Taken, all_edge_facts, judge_all, measure_settings,
    resolve,
};
use crate::geometry::RigidTransform;
use crate::points::spacing::Estimator;
use crate::points::{Frame, Neighbors, PointCloud, Spacing};

/// Cells of the sketch over the half-diagonal of the part: some ten thousand of its points lie on a part.
const SKETCH: f64 = 100.0;

/// Points of the sketch without which no pose is looked for.
const SKETCH_ENOUGH: usize = 1500;

/// The pose is found anew when this many times as many points are there: half of the scan is then laid twice.
const AGAIN: f64 = 2.2;

/// Whether the base still holds is asked when this many times as many points are there.
const ASK_AGAIN: f64 = 1.2;

/// Points that say on the way whether the pose has moved.
const ASKED_POINTS: usize = 30_000;

/// Points that solve for the last pose at most: what that leaves open adds less than a hundredth to the variance of a station.
const POSE_POINTS: usize = 200_000;

/// Relative changes of spacing and noise, as estimated by a part of the scan and by all of it, for which nothing is measured anew: windows are
/// as wide as so many points, and a point more or less among sixteen changes their uncertainty by 3 %. Slanting faces that come into view
/// move the spacing by 4 % on the demo's part.
const SAME_SPACING: f64 = 0.06;
const SAME_NOISE: f64 = 0.15;

/// Motion over the noise, at the half-diagonal, that values follow by first order: on a face of 5 mm radius 20 um leave 0.04 um.
const SMALL_MOTION: f64 = 2.0;

/// Motion on the way up to which points stay where they were laid: half of what would be too far at the end, as it may go on.
const NEAR_ENOUGH: f64 = 0.5 * SMALL_MOTION;

/// The first pieces, in which more places are looked at than in all of a scan that comes at once, tell of spacing and noise; then one of so many.
const ESTIMATED_ALL: usize = 24;
const ESTIMATED_EVERY: usize = 4;

/// A part that is being scanned and measured.
pub struct Growing<'a, B: Body> {
    nominal: &'a B,
    request: Request<'a>,
    surface: Surface<'a, B>,
    datums: Datums,
    resolved: Vec<Resolved>,
    /// What the recipe had wrong.
    findings: Vec<String>,
    pieces: Vec<Piece>,
    points: usize,
    estimator: Estimator,
    sketch: PointCloud,
    cells: HashSet<IVec3, FixedState>,
    base: Option<Base<'a, B>>,
}

/// Points of consecutive profiles.
struct Piece {
    machine: PointCloud,
    /// The same in the part frame of the base.
    part: PointCloud,
    places: Vec<Place>,
    rims: Vec<f32>,
    /// Where its points lie.
    cells: CellSet,
}

impl Piece {
    /// Finds the places of its points, of a part at `pose`.
    fn place<B: Body>(&mut self, surface: &Surface<'_, B>, pose: RigidTransform) {
        let turn = DMat3::from_quat(pose.rotation);
        self.part = self.machine.map(
            Frame::Part,
            |p| turn * p + pose.translation,
            |v| pose.vector(v),
        );
        let gate_mm = GATE * surface.size_mm();
        let part = &self.part;
        let laid: Vec<(Place, f32)> = (0..part.len())
            .into_par_iter()
            .with_min_len(512)
            .map_init(Vec::new, |found, i| {
                let p = part.positions[i];
                let (place, rim) = surface.place_and_rim(p, towards(part, i), gate_mm, found);
                (place, rim as f32)
            })
            .collect();
        (self.places, self.rims) = laid.into_iter().unzip();
    }

    fn layer(&self) -> Layer<'_> {
        Layer::new(&self.part, &self.places)
    }
}

/// What all pieces are laid by.
struct Base<'a, B: Body> {
    pose: RigidTransform,
    spacing: Spacing,
    noise_mm: f64,
    searched: Searched,
    outline: Outline,
    patches: Patches,
    measuring: Measuring<'a, B>,
    /// Points of the scan when it was last asked whether the pose holds.
    asked: usize,
}

impl<B: Body> Base<'_, B> {
    /// Whether the points were laid as those of a scan of this spacing and noise, mm.
    fn is_of(&self, (spacing, noise_mm): (Spacing, f64)) -> bool {
        let is_same = |a: f64, b: f64, by: f64| (a - b).abs() <= by * b.abs();
        is_same(self.spacing.along_mm, spacing.along_mm, SAME_SPACING)
            && is_same(self.spacing.across_mm, spacing.across_mm, SAME_SPACING)
            && is_same(self.noise_mm, noise_mm, SAME_NOISE)
    }

    /// Whether a body of half-diagonal `size_mm` moves from here to `pose` by no more than `far` times the noise.
    fn is_near(&self, pose: &RigidTransform, far: f64, size_mm: f64) -> bool {
        let motion = *pose * self.pose.inverse();
        Twist::logarithm(&motion).size(size_mm) <= far * self.noise_mm
    }
}

/// What the search for the pose ended at.
#[derive(Default)]
struct Searched {
    candidates: Candidates,
    /// Points of the scan then.
    points: usize,
}

/// What is known of an edge while the scan runs. Nothing is judged before its end.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct EdgeSoFar {
    /// Id, or name in the recipe.
    pub id: String,
    /// Share of its stations that were measured.
    pub coverage: f64,
    /// Means of d1 and d2 over them, mm; none before the first.
    pub mean_d_mm: Option<[f64; 2]>,
    /// The d of all stations that is farthest from zero, mm.
    pub worst_d_mm: Option<f64>,
    /// Places of the measured stations, machine frame, mm, and the d that is farthest from zero.
    pub stations: Vec<[f32; 4]>,
}

impl<'a, B: Body> Growing<'a, B> {
    /// Without points.
    pub fn new(surface: Surface<'a, B>, request: Request<'a>) -> Self {
        let nominal = surface.body;
        let mut findings = Vec::new();
        let datums = Datums::of(nominal, request.recipe, &mut findings);
        let facts = all_edge_facts(nominal);
        let (resolved, of_recipe) = resolve(nominal, &facts, request.recipe);
        findings.extend(of_recipe);
        Self {
            nominal,
            request,
            surface,
            datums,
            resolved,
            findings,
            pieces: Vec::new(),
            points: 0,
            estimator: Estimator::default(),
            sketch: PointCloud::from_positions(Frame::Machine, Vec::new()),
            cells: HashSet::default(),
            base: None,
        }
    }

    /// Number of points so far.
    pub fn len(&self) -> usize {
        self.points
    }

    /// Whether there is no point yet.
    pub fn is_empty(&self) -> bool {
        self.points == 0
    }

    /// Whether the pose of the part has been found, so that edges can be measured.
    pub fn is_placed(&self) -> bool {
        self.base.is_some()
    }

    /// Takes the points of consecutive profiles of one view, some ten thousand at a time, with the lattice; all pieces name the same views.
    pub fn push(&mut self, piece: PointCloud) {
        if piece.is_empty() {
            return;
        }
        self.points += piece.len();
        if self.pieces.len() < ESTIMATED_ALL || self.pieces.len().is_multiple_of(ESTIMATED_EVERY) {
            let neighbors = Neighbors::new(&piece.positions);
            self.estimator.add(&piece, &neighbors);
        }
        self.draw(&piece);
        self.pieces.push(Piece {
            machine: piece,
            part: PointCloud::from_positions(Frame::Part, Vec::new()),
            places: Vec::new(),
            rims: Vec::new(),
            cells: CellSet::default(),
        });
        let last = self.pieces.len() - 1;
        let due = |base: &Base<'_, B>| self.points as f64 > AGAIN * base.searched.points as f64;
        if self.base.as_ref().is_none_or(due) && self.find_base() {
            return;
        }
        self.lay(last);
    }

    /// Measures what has been laid; the edges as they are now.
    pub fn measure(&mut self) -> Vec<EdgeSoFar> {
        self.ask_base();
        let Some(base) = &mut self.base else {
            return Vec::new();
        };
        let edges = measured(&mut base.measuring, &self.pieces, None);
        let machine = base.pose.inverse();
        let named = edges.iter().zip(self.nominal.edges()).zip(&self.resolved);
        named
            .map(|((edge, nominal), asked)| {
                let id = asked.name.clone().unwrap_or(nominal.id);
                so_far(id, edge, &machine)
            })
            .collect()
    }

    /// The inspection, as [`super::inspect`] makes it of the same points: values agree to a fraction of their uncertainty, not in every bit.
    pub fn finish(mut self) -> Inspection {
        let progress = self.request.progress;
        let mut stages = Stages::new(progress);
        stages.begin("alignment");
        self.renew_base();
        let Some(aligned) = self.aligned() else {
            return self.all_at_once();
        };
        let Aligned {
            mut alignment,
            findings: of_alignment,
            conclusion,
            ..
        } = aligned;
        // What a part of the scan suggested may be another pose than what all of it would.
        if !matches!(conclusion, Conclusion::Good | Conclusion::AsGiven) {
            return self.all_at_once();
        }
        if self.datums.unknown {
            alignment.status = Verdict::NotDecidable;
        }
        stages.begin("faces of the points");
        let motion = self.follow(alignment.part_from_machine);
        stages.begin("edges");
        let mut findings = std::mem::take(&mut self.findings);
        findings.extend(of_alignment);
        let Some(base) = &mut self.base else {
            return self.all_at_once();
        };
        let estimate = ScanEstimate {
            spacing: base.spacing,
            noise_mm: base.noise_mm,
        };
        let settings = MeasureSettings {
            pose_covariance: alignment.covariance,
            ..measure_settings(&base.spacing, base.noise_mm, &self.request, &mut findings)
        };
        let pieces = self.pieces.iter();
        let clouds: Vec<(&PointCloud, Option<&CellSet>)> = pieces
            .map(|piece| (&piece.part, Some(&piece.cells)))
            .collect();
        let scanned = Scanned {
            clouds: &clouds,
            patches: &base.patches,
            outline: &base.outline,
            spacing: base.spacing,
            noise_mm: base.noise_mm,
        };
        // Neither keeps both cores busy all the time.
        let (measured, found) = rayon::join(
            || {
                measured(
                    &mut base.measuring,
                    &self.pieces,
                    Some((&motion, &settings)),
                )
            },
            || compare::look(&scanned),
        );
        stages.begin("comparison of edges found");
        let edges = base.measuring.edges();
        let compared = compare::compare(&scanned, found, (edges, &measured));
        let taken = Taken {
            alignment,
            findings,
            measured,
            compared,
            trials: None,
            estimate,
        };
        judge_all(
            self.nominal,
            &self.request,
            (edges, &self.resolved),
            taken,
            stages,
        )
    }

    /// As if all points had come at once: for scans of which the pieces say too little.
    fn all_at_once(&self) -> Inspection {
        let clouds = self.pieces.iter().map(|piece| &piece.machine);
        let mut all = PointCloud {
            frame: Frame::Machine,
            views: self.sketch.views.clone(),
            ..PointCloud::from_positions(Frame::Machine, Vec::new())
        };
        for cloud in clouds {
            all.positions.extend(&cloud.positions);
            all.origins.extend(&cloud.origins);
        }
        super::inspect_on(&all, &self.surface, &self.request)
    }

    fn sketch_cell_mm(&self) -> f64 {
        self.surface.size_mm() / SKETCH
    }

    /// The sketch as a scan of its own, spaced as its cells are, or as the scan is where that is wider.
    fn sketch_scan<'s>(
        &'s self,
        neighbors: &'s Neighbors,
        (spacing, noise_mm): (Spacing, f64),
    ) -> Scan<'s> {
        let cell_mm = self.sketch_cell_mm();
        Scan {
            cloud: &self.sketch,
            neighbors,
            spacing: Spacing {
                along_mm: spacing.along_mm.max(cell_mm),
                across_mm: spacing.across_mm.max(cell_mm),
                mean_mm: spacing.mean_mm.max(cell_mm),
            },
            noise_mm,
        }
    }

    /// Adds to the sketch one point of every cell that has none.
    fn draw(&mut self, piece: &PointCloud) {
        let cell_mm = self.sketch_cell_mm();
        if self.sketch.views.is_empty() {
            self.sketch.views.clone_from(&piece.views);
        }
        for (i, p) in piece.positions.iter().enumerate() {
            if p.is_finite() && self.cells.insert((*p / cell_mm).floor().as_ivec3()) {
                self.sketch.positions.push(*p);
                self.sketch.origins.extend(piece.origins.get(i));
            }
        }
    }

    /// Searches for the pose by the points so far, and lays them all where they do not lie at it already; whether it did.
    fn find_base(&mut self) -> bool {
        let Some(known) = self.estimator.estimate() else {
            return false;
        };
        if self.sketch.len() < SKETCH_ENOUGH {
            return false;
        }
        let neighbors = Neighbors::new(&self.sketch.positions);
        let scan = self.sketch_scan(&neighbors, known);
        let options = self.datums.options(&self.request);
        let (aligned, candidates) =
            align_keeping(&scan, &self.surface, self.request.start, &options);
        let pose = aligned.alignment.part_from_machine;
        let searched = Searched {
            candidates,
            points: self.points,
        };
        let size_mm = self.surface.size_mm();
        if let Some(base) = &mut self.base
            && base.is_near(&pose, NEAR_ENOUGH, size_mm)
        {
            if base.is_of(known) {
                base.searched = searched;
                return false;
            }
            let pose = base.pose;
            self.set_base(pose, known, searched);
            return true;
        }
        self.set_base(pose, known, searched);
        true
    }

    /// Lays all points at `pose`, for a scan of this spacing and noise. Those that lie there already keep their places.
    fn set_base(&mut self, pose: RigidTransform, known: (Spacing, f64), searched: Searched) {
        let (spacing, noise_mm) = known;
        let settings = measure_settings(&spacing, noise_mm, &self.request, &mut Vec::new());
        let steps: Vec<Option<f64>> = self.resolved.iter().map(|r| r.station_step_mm).collect();
        let measuring = Measuring::new(&self.surface, &settings, &steps, false);
        let near_mm = compare::near_mm(&spacing);
        let has_moved = self.base.as_ref().is_none_or(|base| base.pose != pose);
        self.base = Some(Base {
            pose,
            spacing,
            noise_mm,
            searched,
            outline: Outline::new(self.nominal, measuring.edges(), near_mm),
            patches: Patches::default(),
            measuring,
            asked: self.points,
        });
        for piece in 0..self.pieces.len() {
            if has_moved {
                self.pieces[piece].places.clear();
            }
            self.lay(piece);
        }
    }

    /// Lays one piece on the nominal, if it has no places yet, and measures by it: pieces are laid in their order.
    fn lay(&mut self, piece: usize) {
        let Some(base) = &mut self.base else {
            return;
        };
        let piece = &mut self.pieces[piece];
        if piece.places.is_empty() {
            piece.place(&self.surface, base.pose);
        }
        piece.cells = base.outline.cells_of(&piece.part.positions);
        base.patches
            .add(&piece.part.positions, &piece.places, &base.outline);
        base.measuring.add(&piece.layer());
    }

    /// Lays everything anew now where it would have to be at the end.
    fn ask_base(&mut self) {
        let due = |base: &Base<'_, B>| self.points as f64 > ASK_AGAIN * base.asked as f64;
        if self.request.start == Start::None || !self.base.as_ref().is_some_and(due) {
            return;
        }
        self.renew_base();
        // On datum features the pose is not the best fit, which is what is asked for here.
        if !self.datums.features.is_empty() {
            return;
        }
        let laid = self.laid(ASKED_POINTS);
        let Some(base) = &mut self.base else { return };
        base.asked = self.points;
        let known = (base.pose, &laid[..], base.spacing.along_mm);
        let estimate = (base.spacing, base.noise_mm);
        let neighbors = Neighbors::new(&self.sketch.positions);
        let scan = self.sketch_scan(&neighbors, estimate);
        let options = self.datums.options(&self.request);
        let settled = settle(&scan, &self.surface, self.request.start, &options, known);
        if let Some(pose) = settled {
            self.lay_again(pose, NEAR_ENOUGH);
        }
    }

    /// Finds a base where there is none, and lays all again where spacing or noise have turned out otherwise.
    fn renew_base(&mut self) {
        let Some((spacing, noise_mm)) = self.estimator.estimate() else {
            return;
        };
        let Some(base) = self.base.as_mut() else {
            self.find_base();
            return;
        };
        if !base.is_of((spacing, noise_mm)) {
            let searched = std::mem::take(&mut base.searched);
            let pose = base.pose;
            self.set_base(pose, (spacing, noise_mm), searched);
        }
    }

    /// The pose by all points.
    fn aligned(&self) -> Option<Aligned> {
        let base = self.base.as_ref()?;
        let neighbors = Neighbors::new(&self.sketch.positions);
        let scan = self.sketch_scan(&neighbors, (base.spacing, base.noise_mm));
        let laid = self.laid(POSE_POINTS);
        let options = self.datums.options(&self.request);
        Some(align_again(
            &scan,
            &self.surface,
            self.request.start,
            &options,
            &base.searched.candidates,
            (base.pose, &laid, base.spacing.along_mm),
        ))
    }

    /// At most `count` of the points that have been laid, spread over the scan.
    fn laid(&self, count: usize) -> Vec<LaidPoint> {
        let step = self.points.div_ceil(count).max(1);
        let of = |piece: &Piece| {
            (0..piece.places.len())
                .step_by(step)
                .map(|i| LaidPoint {
                    point: piece.part.positions[i],
                    place: piece.places[i],
                    rim_mm: f64::from(piece.rims[i]),
                })
                .collect::<Vec<_>>()
        };
        self.pieces.par_iter().flat_map_iter(of).collect()
    }

    /// The motion from the base to `pose` if values can follow it; otherwise everything is laid at `pose`.
    fn follow(&mut self, pose: RigidTransform) -> RigidTransform {
        let Some(base) = &self.base else {
            return RigidTransform::IDENTITY;
        };
        let motion = pose * base.pose.inverse();
        if self.lay_again(pose, SMALL_MOTION) {
            return RigidTransform::IDENTITY;
        }
        motion
    }

    /// Lays everything at `pose` where it is farther from the base than `far` times the noise; whether it was.
    fn lay_again(&mut self, pose: RigidTransform, far: f64) -> bool {
        let Some(base) = &mut self.base else {
            return false;
        };
        if base.is_near(&pose, far, self.surface.size_mm()) {
            return false;
        }
        tracing::debug!(
            points = self.points,
            "the pose has moved too far: all points are laid again"
        );
        let known = (base.spacing, base.noise_mm);
        let searched = std::mem::take(&mut base.searched);
        self.set_base(pose, known, searched);
        true
    }
}

/// All edges, as the flanks and shapes are now; after a motion, with the settings that hold at the end.
fn measured<B: Body>(
    measuring: &mut Measuring<'_, B>,
    pieces: &[Piece],
    end: Option<(&RigidTransform, &MeasureSettings)>,
) -> Vec<MeasuredEdge> {
    let layers: Vec<Layer<'_>> = pieces.iter().map(Piece::layer).collect();
    measuring.measure(&layers);
    let breaks = measuring.breaks(&layers);
    let own = *measuring.settings();
    let (motion, settings) = end.unwrap_or((&RigidTransform::IDENTITY, &own));
    let centre = motion.point(centre(&layers));
    measuring.combined(&breaks, motion, settings, centre)
}

fn so_far(id: String, edge: &MeasuredEdge, machine: &RigidTransform) -> EdgeSoFar {
    let total = edge.stations.len().max(1) as f64;
    let values = edge.stations.iter().filter_map(|s| s.outcome.as_ref().ok());
    let stations: Vec<[f32; 4]> = values
        .map(|m| {
            let [a, b] = m.d_mm;
            let worse = if a.abs() > b.abs() { a } else { b };
            let p = machine.point(m.point);
            [p.x, p.y, p.z, worse].map(|x| x as f32)
        })
        .collect();
    let farther = |a: f64, b: f64| if b.abs() > a.abs() { b } else { a };
    EdgeSoFar {
        id,
        coverage: stations.len() as f64 / total,
        mean_d_mm: edge.mean.map(|mean| mean.d_mm),
        worst_d_mm: stations.iter().map(|s| f64::from(s[3])).reduce(farther),
        stations,
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::DVec3;

    use super::*;
    use crate::inspect::Recipe;
    use crate::nominal::Nominal;
    use crate::points::{Origin, View};

    /// Lines 0.8 mm apart over the demo's part, seen from aslant above, in pieces of ten lines; noise of 10 um.
    fn coarse_lines(nominal: &Nominal) -> Vec<PointCloud> {
        const APART_MM: f64 = 0.8;
        let towards_sensor = DVec3::new(0.48, 0.36, 0.8);
        let views = vec![View {
            device: "aslant".to_owned(),
            towards_sensor,
        }];
        let mut pieces: Vec<PointCloud> = Vec::new();
        let mut state = 1u64;
        for sample in Nominal::samples(nominal, 0.12) {
            let line = (sample.point.x / APART_MM).round();
            let beside_mm = line * APART_MM - sample.point.x;
            let (n, flat) = (sample.normal, 1.0 - sample.normal.x.powi(2));
            if n.dot(towards_sensor) < 0.2 || beside_mm.abs() > 0.07 || flat < 0.05 {
                continue;
            }
            // Along the surface onto the line.
            let on_line = sample.point + beside_mm / flat * (DVec3::X - n.x * n);
            // Sums of twelve numbers from a congruential generator are near enough to normal.
            let mut uniform = || {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1);
                (state >> 33) as f64 / (1u64 << 31) as f64
            };
            let noise_mm = 0.01 * ((0..12).map(|_| uniform()).sum::<f64>() - 6.0);
            let profile = (line + 1000.0) as u32;
            let piece = (profile - 1000) as usize / 10;
            pieces.resize_with(pieces.len().max(piece + 1), || PointCloud {
                views: views.clone(),
                ..PointCloud::from_positions(Frame::Machine, Vec::new())
            });
            pieces[piece].positions.push(on_line + noise_mm * n);
            pieces[piece].origins.push(Origin {
                view: 0,
                column: (sample.point.y.max(0.0) / 0.12) as u16,
                profile,
            });
        }
        pieces
    }

    fn demo_part() -> Nominal {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
        Nominal::read(&path).expect("the demo's part")
    }

    fn growing<'a>(nominal: &'a Nominal, recipe: &'a Recipe) -> Growing<'a, Nominal> {
        let start = Start::Rough(RigidTransform::IDENTITY);
        Growing::new(Surface::new(nominal), Request::new(recipe, start))
    }

    #[test]
    fn coarse_lines_are_aligned_as_they_come() {
        let (nominal, recipe) = (demo_part(), Recipe::default());
        let mut growing = growing(&nominal, &recipe);
        for piece in coarse_lines(&nominal) {
            growing.push(piece);
        }
        let aligned = growing.aligned().expect("a pose");
        assert_eq!(
            aligned.conclusion,
            Conclusion::Good,
            "{:?}",
            aligned.findings
        );
    }

    #[test]
    fn a_pose_that_turns_out_otherwise_on_the_way_is_left() {
        let (nominal, recipe) = (demo_part(), Recipe::default());
        let mut growing = growing(&nominal, &recipe);
        let pieces = coarse_lines(&nominal);
        let (first, rest) = pieces.split_at(pieces.len() * 2 / 3);
        first.iter().for_each(|piece| growing.push(piece.clone()));
        // As if what was seen so far had misled: ten times the noise.
        let away = RigidTransform::new(glam::DQuat::IDENTITY, DVec3::new(0.0, 0.0, 0.1));
        let base = growing.base.take().expect("a base");
        growing.set_base(
            away * base.pose,
            (base.spacing, base.noise_mm),
            base.searched,
        );
        for piece in rest {
            growing.push(piece.clone());
            growing.measure();
        }
        let base = growing.base.as_ref().expect("a base");
        let off = Twist::logarithm(&base.pose).size(growing.surface.size_mm());
        assert!(off < SMALL_MOTION * base.noise_mm, "{off}");
    }
}
