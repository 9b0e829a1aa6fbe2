//! Surfaces through measured points: moving least squares that keeps edges and corners sharp.
//!
//! [`Surface`] is the surface through a cloud; [`Surface::project`] takes any point near it onto it, [`reconstruct`] all the cloud's own
//! points, [`resample()`] spreads new points over it. Where a neighbourhood is smooth the projection is Levin's (Weber 2011, §2.3.2.2);
//! where it is not, the neighbourhood is first cut into flanks, and the projection works on one of them (Weber 2011, §4.3).
//!
//! We differ from the thesis in how the neighbourhood is cut. It draws a cubic Bézier curve through at least four marked feature points and
//! decides the side of a neighbour by an angle; that needs points marked without error and lying on the edge. Here the flanks themselves
//! are estimated, each from its own neighbours, and the feature line is where two of them meet: it needs no point on the edge, and at a
//! corner all lines are there, not only the nearest. Nor does it wait for a detector: the points that one smooth surface does not explain
//! are the ones near a feature. His own way, with the features that a detector found, is [`ThesisSurface`]; it stands beside
//! [`SmoothSurface`], [`ImplicitSurface`], [`plane_normals()`] and [`weighted_plane_normals()`] for comparison.

mod baseline;
mod bulk;
mod flank;
mod implicit;
mod levin;
mod lines;
mod polynomial;
mod resample;
mod robust;
mod scale;
mod thesis;

use std::borrow::Cow;

use glam::{DMat3, DVec3, Vec3};

use crate::points::moments::Moments;
use crate::points::{Neighbors, PointCloud};

pub use baseline::{SmoothSurface, plane_normals, weighted_plane_normals};
pub use bulk::{LinePoint, Reconstruction, SharpPoint, reconstruct};
use flank::{Arrangement, Nearest, Neighborhood};
pub use implicit::{ImplicitKind, ImplicitSurface};
use levin::{LocalSurface, Smoothing};
pub use polynomial::Degree;
pub use resample::{Resampled, resample};
pub use scale::Scale;
pub use thesis::{LocalLine, ThesisSettings, ThesisSurface};

/// Why no surface can be laid through a cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SurfaceError {
    /// Too few distinct points.
    #[error(
        "surface: {seen} distinct points, at least {LEAST_POINTS} needed; scan more of the part"
    )]
    TooFewPoints {
        /// How many there are.
        seen: usize,
    },
    /// A spacing for new points that is no length, or so small that the points could not be held.
    #[error(
        "resampling: a spacing of {spacing_mm} mm would need {points:.0} points, at most {most} are made; choose a larger spacing"
    )]
    Spacing {
        /// What was asked for.
        spacing_mm: f64,
        /// Points it would take.
        points: f64,
        /// Points that are made at most.
        most: u64,
    },
}

/// Fewer distinct points than this carry no surface.
pub const LEAST_POINTS: usize = 16;

/// What a user may choose; the defaults hold for all data.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Settings {
    /// Degree of the local polynomials.
    pub degree: Degree,
    /// h of the Gaussian weight, mm; by default it follows from noise and spacing at every point. The neighbourhood's number of points does
    /// not change with it.
    pub smoothing_mm: Option<f64>,
}

/// What lies under a projected point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// One smooth piece of surface.
    Face,
    /// The line where two pieces meet.
    Edge,
    /// The point where three or more pieces meet.
    Corner,
}

/// A point of the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// The point, mm.
    pub position: DVec3,
    /// What it lies on.
    pub place: Place,
    /// Unit normals: one on a face, two on an edge, three at a corner; the rest repeat the last. Signs are arbitrary.
    pub normals: [DVec3; 3],
    /// Principal curvatures of the first face, 1/mm, the larger magnitude first; positive where it bends towards its normal.
    pub curvatures: [f64; 2],
    /// Covariance of the position, mm²: of rank one on a face (along its normal), two on an edge, three at a corner.
    pub covariance: DMat3,
}

/// The surface through a cloud of points.
///
/// Memory: 13 bytes a supporting point above the positions and their neighbours; in scan lines also those of the supporting points.
pub struct Surface<'a> {
    positions: Cow<'a, [DVec3]>,
    neighbors: Shared<'a>,
    normals: Vec<Vec3>,
    /// Part of a point's surroundings that lies on its tangent plane, in 255ths.
    trust: Vec<u8>,
    scale: Scale,
    settings: Settings,
}

enum Shared<'a> {
    Borrowed(&'a Neighbors),
    Owned(Box<Neighbors>),
}

impl Shared<'_> {
    fn get(&self) -> &Neighbors {
        match self {
            Shared::Borrowed(neighbors) => neighbors,
            Shared::Owned(neighbors) => neighbors,
        }
    }
}

/// Distance of samples along a feature line, in spacings of the points.
const LINE_SPACING: f64 = 0.35;

/// Places on feature lines near a query: the nearest, one to either side of it, and a corner.
type Meetings = [Option<Nearest>; 4];

/// Buffers of one worker.
#[derive(Default)]
struct Scratch {
    found: Vec<(u32, f64)>,
    hood: Neighborhood,
    members: Vec<DVec3>,
}

/// What became of a query: where it went, and which feature line or corner lies near it.
struct Outcome {
    nearest: Nearest,
    /// The local approximation it lies on first, and the points that made it, in the scratch's `members`.
    local: LocalSurface,
    meetings: Meetings,
}

impl<'a> Surface<'a> {
    /// The surface through `cloud`, whose `neighbors` are given.
    ///
    /// # Errors
    /// [`SurfaceError::TooFewPoints`].
    pub fn new(
        cloud: &'a PointCloud,
        neighbors: &'a Neighbors,
        settings: Settings,
    ) -> Result<Self, SurfaceError> {
        let mut surface = Self::unprepared(cloud, neighbors, settings)?;
        bulk::prepare(&mut surface, None);
        Ok(surface)
    }

    fn unprepared(
        cloud: &'a PointCloud,
        neighbors: &'a Neighbors,
        settings: Settings,
    ) -> Result<Self, SurfaceError> {
        let mut found = Vec::new();
        if let Some(&first) = neighbors.order().first() {
            neighbors.nearest(cloud.positions[first as usize], LEAST_POINTS, &mut found);
        }
        if found.len() < LEAST_POINTS {
            return Err(SurfaceError::TooFewPoints { seen: found.len() });
        }
        let scale = Scale::of(cloud, neighbors);
        let (positions, neighbors) = if scale.thinning_mm > 0.0 {
            let kept: Vec<DVec3> = scale::thin(&cloud.positions, neighbors, scale.thinning_mm)
                .into_iter()
                .map(|i| cloud.positions[i as usize])
                .collect();
            let own = Box::new(Neighbors::new(&kept));
            (Cow::Owned(kept), Shared::Owned(own))
        } else {
            (
                Cow::Borrowed(cloud.positions.as_slice()),
                Shared::Borrowed(neighbors),
            )
        };
        Ok(Self {
            normals: vec![Vec3::ZERO; positions.len()],
            trust: vec![u8::MAX; positions.len()],
            positions,
            neighbors,
            scale,
            settings,
        })
    }

    /// The sizes that everything follows from.
    pub fn scale(&self) -> &Scale {
        &self.scale
    }

    /// The point of the surface nearest to `p`; `None` where the points around say nothing certain about it: too few of them, or all of
    /// them farther away than a neighbourhood reaches.
    pub fn project(&self, p: DVec3) -> Option<Projected> {
        let mut scratch = Scratch::default();
        let outcome = self.outcome(p, &mut scratch)?;
        let smoothing = self.smoothing(scratch.hood.radius_mm());
        if outcome.nearest.position.length() > 0.75 * scratch.hood.radius_mm() {
            return None;
        }
        Some(self.describe(p, &outcome, (&scratch, &smoothing)))
    }

    fn describe(
        &self,
        p: DVec3,
        outcome: &Outcome,
        (scratch, smoothing): (&Scratch, &Smoothing),
    ) -> Projected {
        let nearest = &outcome.nearest;
        let foot = outcome
            .local
            .foot(nearest.position, 2.0 * smoothing.reach_mm);
        let variance = foot
            .and_then(|foot| outcome.local.variance(&scratch.members, &foot, smoothing))
            .unwrap_or(f64::INFINITY);
        Projected {
            position: p + nearest.position,
            place: match nearest.sheets {
                1 => Place::Face,
                2 => Place::Edge,
                _ => Place::Corner,
            },
            normals: nearest.normals,
            curvatures: foot.map_or([0.0; 2], |foot| foot.jet.curvatures()),
            covariance: covariance(nearest, variance),
        }
    }

    fn smoothing(&self, radius_mm: f64) -> Smoothing {
        Smoothing {
            degree: self.settings.degree,
            h_mm: self.settings.smoothing_mm.unwrap_or(radius_mm / 1.5),
            sigma_mm: self.scale.noise_mm,
            reach_mm: radius_mm,
        }
    }

    /// Gathers the places of the `k` nearest supporting points of `p` into the scratch.
    fn gather_places(&self, p: DVec3, k: usize, scratch: &mut Scratch) {
        self.neighbors.get().nearest(p, k, &mut scratch.found);
        scratch.hood.clear();
        let found = scratch.found.iter();
        scratch
            .hood
            .points
            .extend(found.map(|(index, _)| self.positions[*index as usize] - p));
    }

    /// Gathers the `k` nearest supporting points of `p` with their normals into the scratch.
    fn gather(&self, p: DVec3, k: usize, scratch: &mut Scratch) {
        self.neighbors.get().nearest(p, k, &mut scratch.found);
        scratch.hood.clear();
        for (index, _) in &scratch.found {
            let index = *index as usize;
            scratch.hood.push(
                self.positions[index] - p,
                self.normals[index].as_dvec3(),
                f64::from(self.trust[index]) / 255.0,
            );
        }
    }

    fn outcome(&self, p: DVec3, scratch: &mut Scratch) -> Option<Outcome> {
        if !p.is_finite() {
            return None;
        }
        self.gather_places(p, self.scale.points, scratch);
        self.smooth_outcome(scratch).or_else(|| {
            self.gather(p, self.scale.points_wide(), scratch);
            self.sharp_outcome(scratch)
        })
    }

    /// Projects the origin of the gathered neighbourhood, where one smooth surface explains it all.
    fn smooth_outcome(&self, scratch: &mut Scratch) -> Option<Outcome> {
        let hood = &scratch.hood;
        let smoothing = self.smoothing(hood.radius_mm());
        let mut moments = Moments::default();
        hood.points.iter().for_each(|p| moments.add(*p));
        let start = moments.plane().normal;
        let (local, foot) = levin::project(&hood.points, DVec3::ZERO, start, &smoothing)?;
        let limit = 1.35 * self.scale.noise_mm + 3.5 * self.scale.floor_mm();
        if local.polynomial.residual_mm > limit || foot.position.length() > 3.5 * limit {
            return None;
        }
        scratch.members.clear();
        scratch.members.extend_from_slice(&hood.points);
        Some(Outcome {
            nearest: Nearest {
                position: foot.position,
                flanks: [0; 3],
                normals: [foot.normal; 3],
                sheets: 1,
            },
            local,
            meetings: Meetings::default(),
        })
    }

    /// Projects the origin of the gathered neighbourhood onto the flanks around it.
    fn sharp_outcome(&self, scratch: &mut Scratch) -> Option<Outcome> {
        let hood = &mut scratch.hood;
        if hood.points.len() < LEAST_POINTS / 2 {
            return None;
        }
        let smoothing = self.smoothing(hood.radius_mm());
        let flanks = hood.split(&self.scale, &smoothing);
        let arrangement = Arrangement::new(hood, &flanks, &self.scale);
        let mut nearest = arrangement.nearest()?;
        let edge = arrangement.nearest_edge();
        let step = LINE_SPACING * self.scale.spacing_mm;
        let beside = |way: f64| edge.and_then(|e| arrangement.along(&e, way * step));
        let meetings = [
            edge,
            beside(1.0),
            beside(-1.0),
            arrangement.nearest_corner(),
        ];
        let mut local = flanks[nearest.flanks[0]].local.clone();
        scratch.members.clear();
        scratch.members.extend(hood.members(nearest.flanks[0]));
        if nearest.sheets == 1 {
            let own = levin::project(
                &scratch.members,
                DVec3::ZERO,
                local.frame.normal,
                &smoothing,
            );
            let near = self.scale.noise_mm + self.scale.floor_mm();
            if let Some((better, foot)) = own
                && foot.position.distance(nearest.position) < near
            {
                nearest.position = foot.position;
                nearest.normals = [foot.normal; 3];
                local = better;
            }
        }
        Some(Outcome {
            nearest,
            local,
            meetings,
        })
    }
}

/// Covariance of a point fixed by one, two or three surfaces whose heights each have `variance` and err independently.
fn covariance(nearest: &Nearest, variance: f64) -> DMat3 {
    let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    let [a, b, c] = nearest.normals;
    match nearest.sheets {
        1 => outer(a, a) * variance,
        2 => {
            // The duals of the two normals in the plane they span.
            let g = a.dot(b);
            let s = 1.0 / (1.0 - g * g);
            let (da, db) = ((a - b * g) * s, (b - a * g) * s);
            (outer(da, da) + outer(db, db)) * variance
        }
        _ => {
            let rows = DMat3::from_cols(a, b, c).transpose();
            let inverse = rows.inverse();
            inverse * inverse.transpose() * variance
        }
    }
}
