//! Which points lie on a sharp edge, a corner or a boundary, and the curves through them.

use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;

use crate::points::{Neighbors, PointCloud, Spacing, noise_mm, spacing};

mod adaptive;
mod boundary;
mod cone;
mod curves;
mod flanks;
mod lattice;
mod lines;
mod patch;
pub mod profile;
mod tangent;
pub mod thesis;
pub mod variation;

use adaptive::{Places, Sights, THIN};
pub use curves::{Curve, curves};
use tangent::Tangents;

/// What a point lies on. The discriminants are the values of `feature` in files.
#[repr(u8)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Class {
    /// On a smooth surface.
    None = 0,
    /// Within about one spacing of an edge between two surfaces.
    Edge = 1,
    /// Within about one spacing of a place where three or more surfaces meet, or of the tip of a cone.
    Corner = 2,
    /// On the border of the data: an open edge or an occlusion.
    Boundary = 3,
}

/// How edges are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Surfaces fitted on both sides; every threshold follows from noise, spacing and number of points.
    Adaptive,
    /// Gauss-map clustering with one sensitivity for all points (Weber 2011, §3.4).
    Global,
    /// Multi-scale surface variation (Pauly et al. 2003, as in Weber 2011, §3.7.7).
    Variation,
}

/// The classes of N points and how they were found.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// N classes, in input order.
    pub classes: Vec<Class>,
    /// Spacing of the cloud.
    pub spacing: Spacing,
    /// Standard deviation of the points normal to the surface, mm.
    pub noise_mm: f64,
    /// Seconds by stage, in order.
    pub seconds: Vec<(&'static str, f64)>,
    /// What was wrong with the data; the result goes on.
    pub findings: Vec<String>,
}

impl Detection {
    /// Number of points of a class.
    pub fn count(&self, class: Class) -> usize {
        self.classes.iter().filter(|c| **c == class).count()
    }
}

/// The class of every point of `cloud`.
pub fn detect(cloud: &PointCloud, neighbors: &Neighbors, method: Method) -> Detection {
    let mut clock = Clock::new();
    let spacing = spacing(cloud, neighbors);
    let noise = noise_mm(cloud, neighbors, &spacing);
    clock.lap("spacing and noise");
    detect_within(cloud, neighbors, (spacing, noise), method, clock)
}

/// As [`detect`], for a cloud whose `spacing` and noise (mm) are known already.
pub fn detect_knowing(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    known: (Spacing, f64),
    method: Method,
) -> Detection {
    detect_within(cloud, neighbors, known, method, Clock::new())
}

fn detect_within(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    (spacing, noise): (Spacing, f64),
    method: Method,
    mut clock: Clock,
) -> Detection {
    let mut detection = Detection {
        classes: vec![Class::None; cloud.positions.len()],
        spacing,
        noise_mm: noise,
        seconds: Vec::new(),
        findings: Vec::new(),
    };
    if neighbors.places().len() < 8 || spacing.mean_mm <= 0.0 {
        detection
            .findings
            .push("points: fewer than 8 distinct places, no edge can be told".to_owned());
        return detection;
    }
    match method {
        Method::Adaptive => adaptive(cloud, neighbors, &mut detection, &mut clock),
        Method::Global => {
            let settings = thesis::Settings::global();
            detection.classes = thesis::detect_as_in_thesis(cloud, neighbors, &settings);
            clock.lap("clusters");
        }
        Method::Variation => {
            let settings = variation::Settings::default();
            detection.classes = variation::detect_by_variation(cloud, neighbors, &settings);
            clock.lap("variation");
        }
    }
    detection.seconds = clock.laps;
    detection
}

fn adaptive(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    detection: &mut Detection,
    clock: &mut Clock,
) {
    let all: Vec<DVec3> = neighbors
        .places()
        .iter()
        .map(|i| cloud.positions[*i as usize])
        .collect();
    let lattice = lattice::places(cloud, detection.noise_mm);
    let classes = if detection.spacing.in_lines() || lattice.is_some() {
        let stray = |rank: usize| {
            let at = |i: &u32| lattice.as_ref().map(|l| l[*i as usize]);
            let points = neighbors.points_at(rank);
            points.iter().all(|i| at(i) == Some(lattice::Place::Stray))
        };
        in_lines(&all, (neighbors, &stray), detection, clock)
    } else {
        evenly(all, neighbors, detection, clock)
    };
    for (rank, class) in classes.iter().enumerate() {
        for i in neighbors.points_at(rank) {
            let place = lattice.as_ref().map(|l| l[*i as usize]);
            detection.classes[*i as usize] = match (class, place) {
                (_, Some(lattice::Place::Stray)) => Class::None,
                (Class::None, Some(lattice::Place::Border)) => Class::Boundary,
                _ => *class,
            };
        }
    }
}

/// The classes of places that lie as densely in one direction as in the other.
fn evenly(
    all: Vec<DVec3>,
    neighbors: &Neighbors,
    detection: &Detection,
    clock: &mut Clock,
) -> Vec<Class> {
    let places = Places {
        positions: all,
        neighbors,
        spacing_mm: detection.spacing.mean_mm,
        noise_mm: detection.noise_mm,
        thin_mm: THIN * detection.spacing.mean_mm,
    };
    let tangents = Tangents::new(&places.positions, neighbors);
    clock.lap("tangent planes");
    let sights = Sights::new(&places, &tangents);
    clock.lap("flanks");
    let edges: Vec<Class> = (0..places.positions.len())
        .into_par_iter()
        .map(|rank| {
            let around = tangents.around(rank);
            let unit = places.unit_mm(f64::from(tangents.planes[rank].reach_mm), around.len());
            places
                .agree(&sights, places.positions[rank], (around, unit))
                .map_or(Class::None, |edge| edge.class())
        })
        .collect();
    clock.lap("agreement");
    let mut classes = boundary::mark(&places, &tangents, edges);
    clock.lap("boundaries");
    mark_tips(&sights.tips, (neighbors, places.thin_mm), &mut classes);
    classes
}

/// The classes of places in scan lines: looked for on places picked out of them as densely along as across, then told to all.
///
/// Places that are `stray` bear no witness.
fn in_lines(
    all: &[DVec3],
    (neighbors, stray): (&Neighbors, &dyn Fn(usize) -> bool),
    detection: &Detection,
    clock: &mut Clock,
) -> Vec<Class> {
    let across_mm = detection.spacing.across_mm;
    let picked = lines::pick(all, neighbors, (lines::PICKED * across_mm, stray));
    let few = Neighbors::new(&picked);
    let positions: Vec<DVec3> = few.places().iter().map(|i| picked[*i as usize]).collect();
    clock.lap("picking");
    let places = Places {
        spacing_mm: lines::picked_spacing_mm(&positions, &few),
        positions,
        neighbors: &few,
        noise_mm: detection.noise_mm,
        thin_mm: THIN * across_mm,
    };
    let tangents = Tangents::new(&places.positions, &few);
    clock.lap("tangent planes");
    let sights = Sights::new(&places, &tangents);
    clock.lap("flanks");
    let borders = boundary::mark(
        &places,
        &tangents,
        vec![Class::None; places.positions.len()],
    );
    clock.lap("boundaries");
    let sighted: Vec<bool> = (0..places.positions.len())
        .into_par_iter()
        .map(|rank| {
            let around = tangents.around(rank);
            around.iter().any(|j| sights.at(*j as usize).is_some())
        })
        .collect();
    let mut classes: Vec<Class> = all
        .par_iter()
        .map_init(Vec::new, |found, p| {
            few.nearest_places(*p, 1, found);
            if let Some((nearest, _)) = found.first()
                && !sighted[*nearest as usize]
            {
                return borders[*nearest as usize];
            }
            few.nearest_places(*p, tangent::NEAR, found);
            let mut around = [0; tangent::NEAR];
            for (slot, (rank, _)) in around.iter_mut().zip(found.iter()) {
                *slot = *rank;
            }
            let around = &around[..found.len()];
            let border = around.first().map_or(Class::None, |r| borders[*r as usize]);
            places
                .agree(&sights, *p, (around, places.spacing_mm))
                .map(|edge| edge.class())
                .filter(|class| *class != Class::None)
                .unwrap_or(border)
        })
        .collect();
    clock.lap("agreement");
    mark_tips(&sights.tips, (neighbors, places.thin_mm), &mut classes);
    classes
}

/// Makes corners of the places within `thin_mm` of the `tips` (mm) of cones.
fn mark_tips(tips: &[DVec3], (neighbors, thin_mm): (&Neighbors, f64), classes: &mut [Class]) {
    let mut found = Vec::new();
    for tip in tips {
        neighbors.within_places(*tip, thin_mm, &mut found);
        for (rank, _) in &found {
            classes[*rank as usize] = Class::Corner;
        }
    }
}

struct Clock {
    last: Instant,
    laps: Vec<(&'static str, f64)>,
}

impl Clock {
    fn new() -> Self {
        Self {
            last: Instant::now(),
            laps: Vec::new(),
        }
    }

    fn lap(&mut self, stage: &'static str) {
        let now = Instant::now();
        self.laps.push((stage, (now - self.last).as_secs_f64()));
        self.last = now;
    }
}
