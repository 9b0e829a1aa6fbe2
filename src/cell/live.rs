//! The scan as it grows, thinned so that any number of watchers costs little.

use std::sync::{Mutex, MutexGuard, PoisonError};

use acies_drivers::capture::Profile;
use glam::DVec3;
use serde::Serialize;
use utoipa::ToSchema;

use crate::inspect::EdgeSoFar;

/// Points kept for showing. When there are as many, every second one goes and from then on half as many come.
const POINTS_KEPT: usize = 200_000;

/// Columns of a profile that are shown.
const COLUMNS_SHOWN: usize = 640;

/// The scan that runs, or ran last.
#[derive(Debug, Default)]
pub struct Live {
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    job: i64,
    generation: u64,
    points: Vec<[f32; 3]>,
    stride: usize,
    skipped: usize,
    profiles: Vec<LiveProfile>,
    edges: LiveEdges,
}

/// The edges of the part as they are measured so far: nothing is judged before the scan has ended.
#[derive(Debug, Clone, Default, PartialEq, Serialize, ToSchema)]
pub struct LiveEdges {
    /// The inspection.
    pub inspection: i64,
    /// How often they have been measured; 0 before the part's pose is found.
    pub number: u64,
    /// All of them; none where they are known already.
    pub edges: Vec<EdgeSoFar>,
}

/// A part of the points.
#[derive(Debug, Clone, PartialEq)]
pub struct LivePoints {
    /// The inspection.
    pub job: i64,
    /// Differs where the points were thinned or another scan began: what was fetched before no longer belongs to these.
    pub generation: u64,
    /// Index of the first one.
    pub from: usize,
    /// Machine frame, mm.
    pub points: Vec<[f32; 3]>,
}

/// The newest profile of one device in which anything was seen: past the end of the part a sensor looks into the void, and the
/// last of the part is what there is to show.
#[derive(Debug, Clone, Default, PartialEq, Serialize, ToSchema)]
pub struct LiveProfile {
    /// The device.
    pub device: String,
    /// Its number in the run.
    pub sequence: u32,
    /// Across the laser's axis, mm.
    pub x_mm: Vec<f32>,
    /// Along the laser's axis, mm; null where nothing was seen.
    pub z_mm: Vec<Option<f32>>,
}

impl Live {
    /// Begins to show inspection `job` with these devices.
    pub(super) fn begin(&self, job: i64, devices: &[String]) {
        let mut inner = self.lock();
        let generation = inner.generation + 1;
        let profile = |device: &String| LiveProfile {
            device: device.clone(),
            ..LiveProfile::default()
        };
        *inner = Inner {
            job,
            generation,
            points: Vec::new(),
            stride: 1,
            skipped: 0,
            profiles: devices.iter().map(profile).collect(),
            edges: LiveEdges {
                inspection: job,
                ..LiveEdges::default()
            },
        };
    }

    /// Takes the edges of inspection `job` as they are measured so far.
    pub(super) fn measured(&self, job: i64, edges: Vec<EdgeSoFar>) {
        let mut inner = self.lock();
        if inner.job == job {
            inner.edges.number += 1;
            inner.edges.edges = edges;
        }
    }

    /// Takes a profile of device `view` and the points made of it.
    pub(super) fn push(&self, view: usize, profile: &Profile, points: &[DVec3]) {
        let mut inner = self.lock();
        for point in points {
            inner.skipped += 1;
            if inner.skipped < inner.stride {
                continue;
            }
            inner.skipped = 0;
            inner.points.push(point.as_vec3().to_array());
            if inner.points.len() >= POINTS_KEPT {
                inner.thin();
            }
        }
        if !profile.z_mm.iter().any(|z| z.is_finite()) {
            return;
        }
        let stride = profile.x_mm.len().div_ceil(COLUMNS_SHOWN).max(1);
        if let Some(shown) = inner.profiles.get_mut(view) {
            shown.sequence = profile.sequence;
            let x = profile.x_mm.iter().step_by(stride);
            shown.x_mm = x.map(|&x| x as f32).collect();
            let z = profile.z_mm.iter().step_by(stride);
            shown.z_mm = z.map(|&z| z.is_finite().then_some(z as f32)).collect();
        }
    }

    /// The points from index `from` on; all of them where `generation` is not the present one.
    pub fn points(&self, generation: u64, from: usize) -> LivePoints {
        let inner = self.lock();
        let known = generation == inner.generation && from <= inner.points.len();
        let from = if known { from } else { 0 };
        LivePoints {
            job: inner.job,
            generation: inner.generation,
            from,
            points: inner.points[from..].to_vec(),
        }
    }

    /// The newest profile of every device in which anything was seen; an empty one before that.
    pub fn profiles(&self) -> Vec<LiveProfile> {
        self.lock().profiles.clone()
    }

    /// The edges as they are measured so far, where they are not those of `inspection` with the number `known`.
    pub fn edges(&self, inspection: i64, known: u64) -> LiveEdges {
        let inner = self.lock();
        let now = &inner.edges;
        if (now.inspection, now.number) == (inspection, known) {
            return LiveEdges {
                edges: Vec::new(),
                ..*now
            };
        }
        now.clone()
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn thin(&mut self) {
        let mut odd = false;
        self.points.retain(|_| {
            odd = !odd;
            odd
        });
        self.stride *= 2;
        self.generation += 1;
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn behind_the_part_the_last_profile_of_it_stays() {
        let profile = |sequence, z: f64| Profile {
            sequence,
            boot: 0,
            device_time_ns: 0,
            encoder: None,
            host_time: Instant::now(),
            dropped: 0,
            saturated: false,
            x_mm: vec![0.0, 1.0],
            z_mm: vec![z, f64::NAN],
            intensity: Vec::new(),
        };
        let live = Live::default();
        live.begin(1, &["left".to_owned()]);
        live.push(0, &profile(0, f64::NAN), &[]);
        assert_eq!(live.profiles()[0].z_mm, []);
        live.push(0, &profile(1, 5.0), &[]);
        live.push(0, &profile(2, f64::NAN), &[]);
        let shown = &live.profiles()[0];
        assert_eq!(
            (shown.sequence, &shown.z_mm[..]),
            (1, &[Some(5.0), None][..])
        );
    }
}
