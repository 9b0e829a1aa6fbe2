//! A line-laser profiler: laser fan, camera at a triangulation angle, spot, noise, drop-outs, and the stage that moves it.
//!
//! The sensor frame is that of the open-profile protocol: x and z in the plane of the laser, z along its optical axis away from
//! the device, y along the direction of motion. Columns are rays of the laser fan, so that the x of a column grows with its z.

use std::f64::consts::FRAC_PI_2;
use std::sync::Arc;

use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::pose::Pose;
use crate::scene::{Hit, Ray, Scene};

/// A surface must be this far in front of another to shade it, mm: above rounding, below every other length here.
const CLEARANCE: f64 = 1e-6;

/// How a profiler sees.
#[derive(Debug, Clone, PartialEq)]
pub struct Optics {
    /// z of the near end of the range, mm.
    pub near_mm: f64,
    /// z of the far end, mm.
    pub far_mm: f64,
    /// Width of the field in the middle of the range, mm.
    pub width_mm: f64,
    /// How the rays of the columns run.
    pub fan: Fan,
    /// Centre of the camera's lens in the sensor frame, mm.
    pub camera_mm: DVec3,
    /// Diameter of the laser spot (four standard deviations of its brightness), mm.
    pub spot_mm: f64,
    /// Parts of a spot at depths that differ by more are two peaks on the camera, and the brighter one is reported, mm.
    pub blend_mm: f64,
    /// Noise along the ray at normal incidence, mm; it grows with 1/cos of the incidence.
    pub noise_mm: f64,
    /// Share of points that are lost at random.
    pub drop_out: f64,
    /// Beyond this angle between ray and normal nothing comes back, rad.
    pub incidence_limit_rad: f64,
    /// Share of points that are reflections, somewhere along the ray.
    pub outliers: f64,
}

/// How the rays of the columns run in the plane of the laser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fan {
    /// From one point at this z, mm (below the near end); columns are equally spaced in the middle of the range.
    Diverging(f64),
    /// All along z, equally spaced.
    Parallel,
}

/// A motion along one axis, and the encoder on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Traverse {
    /// Unit vector along which the sensor moves, in the machine.
    pub axis: DVec3,
    /// Travel of one encoder count, mm.
    pub mm_per_count: f64,
    /// Encoder at the first profile, counts.
    pub first_count: i64,
    /// Counts from one profile to the next.
    pub step_counts: i64,
    /// Profiles from one end to the other: then the stage stands still.
    pub profiles: u32,
}

/// A sensor somewhere, looking at a scene.
#[derive(Debug, Clone)]
pub struct View {
    /// What is looked at.
    pub scene: Arc<Scene>,
    /// Where the scene is.
    pub machine_from_scene: Pose,
    /// Where the sensor truly is when the encoder reads zero.
    pub machine_from_sensor: Pose,
    /// How it sees.
    pub optics: Optics,
    /// How it moves.
    pub traverse: Traverse,
    /// Columns in a profile.
    pub columns: u32,
    /// Draws of noise; every profile has a stream of its own, so the order of computing does not matter.
    pub seed: u64,
}

/// One laser line as measured, before any rounding to the wire's units.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Counts at the centre of the exposure: the true position, rounded.
    pub encoder: i64,
    /// Across, mm; where nothing was seen, that of the ray in the middle of the range.
    pub x_mm: Vec<f64>,
    /// Away from the device, mm; `NaN` where nothing was seen.
    pub z_mm: Vec<f64>,
    /// Brightness; 0 where nothing was seen.
    pub intensity: Vec<u16>,
    /// Some column was brighter than the camera can tell.
    pub saturated: bool,
}

/// Offsets in standard deviations and weights of a rule that has the spot's mean and second moments exactly.
const SPOT: [(f64, f64, f64); 5] = [
    (0.0, 0.0, 0.5),
    (2.0, 0.0, 0.125),
    (-2.0, 0.0, 0.125),
    (0.0, 2.0, 0.125),
    (0.0, -2.0, 0.125),
];

/// One part of the spot that came back.
#[derive(Clone, Copy)]
struct Return {
    depth: f64,
    weight: f64,
    cos_incidence: f64,
}

impl Optics {
    /// Camera centre for a triangulation angle seen from the middle of the range; a positive angle puts it at positive y.
    pub fn camera_at_angle(near_mm: f64, far_mm: f64, angle_rad: f64) -> DVec3 {
        DVec3::new(0.0, 0.5 * (near_mm + far_mm) * angle_rad.tan(), 0.0)
    }

    fn middle(&self) -> f64 {
        0.5 * (self.near_mm + self.far_mm)
    }

    /// Where the ray of a column starts and where it points, in the sensor frame; `across` shifts it, mm in the middle.
    fn ray(&self, column: f64, columns: u32, across: DVec3) -> Ray {
        let x = self.width_mm * ((column + 0.5) / f64::from(columns) - 0.5);
        let target = DVec3::new(x, 0.0, self.middle()) + across;
        match self.fan {
            Fan::Diverging(source) => {
                let origin = DVec3::Z * source;
                Ray::new(origin, target - origin)
            }
            Fan::Parallel => Ray::new(DVec3::new(target.x, target.y, 0.0), DVec3::Z),
        }
    }
}

impl View {
    /// Position of the stage when profile `index` is exposed, in counts: within half a count of the trigger.
    fn position_counts(&self, index: u32, rng: &mut ChaCha8Rng) -> f64 {
        let trigger = self.traverse.first_count + i64::from(index) * self.traverse.step_counts;
        trigger as f64 + rng.random_range(-0.5..0.5)
    }

    /// Profile `index` of the traverse. The same seed and index give the same numbers, whatever was computed before.
    pub fn line(&self, index: u32) -> Line {
        let mut rng = self.draws(index);
        let counts = self.position_counts(index, &mut rng);
        let travel = self.traverse.axis * (counts * self.traverse.mm_per_count);
        let machine_from_sensor = Pose::shift(travel).after(self.machine_from_sensor);
        self.seen_from(machine_from_sensor, counts.round() as i64, &mut rng)
    }

    /// Profile `index` from a sensor that something else carries; its encoder stands still.
    pub fn line_from(&self, index: u32, machine_from_sensor: Pose) -> Line {
        let mut rng = self.draws(index);
        self.seen_from(machine_from_sensor, self.traverse.first_count, &mut rng)
    }

    fn draws(&self, index: u32) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(u64::from(index));
        rng
    }

    fn seen_from(&self, machine_from_sensor: Pose, encoder: i64, rng: &mut ChaCha8Rng) -> Line {
        let scene_from_sensor = self.machine_from_scene.inverse().after(machine_from_sensor);
        let n = self.columns as usize;
        let mut line = Line {
            encoder,
            x_mm: Vec::with_capacity(n),
            z_mm: Vec::with_capacity(n),
            intensity: Vec::with_capacity(n),
            saturated: false,
        };
        for column in 0..self.columns {
            self.column(column, &scene_from_sensor, rng, &mut line);
        }
        line
    }

    /// Every column draws the same numbers whatever it sees, so that a change of the scene changes no noise elsewhere.
    fn column(&self, column: u32, scene_from_sensor: &Pose, rng: &mut ChaCha8Rng, line: &mut Line) {
        let optics = &self.optics;
        let noise: f64 = rng.sample(StandardNormal);
        let (lost, reflected, place): (f64, f64, f64) = rng.random();
        let ray = optics.ray(f64::from(column), self.columns, DVec3::ZERO);
        let seen = self.peak(f64::from(column), scene_from_sensor);
        let measured = seen.and_then(|peak| {
            if lost < optics.drop_out {
                None
            } else if reflected < optics.outliers {
                let z = optics.near_mm + place * (optics.far_mm - optics.near_mm);
                Some((z - ray.origin.z) / ray.direction.z)
            } else {
                Some(peak.depth + noise * optics.noise_mm / peak.cos_incidence)
            }
        });
        let point = measured.map(|depth| ray.at(depth));
        match point.filter(|p| (optics.near_mm..=optics.far_mm).contains(&p.z)) {
            Some(p) => {
                let light = seen.map_or(0.0, |s| s.weight * s.cos_incidence);
                line.x_mm.push(p.x);
                line.z_mm.push(p.z);
                line.intensity.push((light * 60_000.0) as u16);
                line.saturated |= light > 0.999;
            }
            None => {
                let t = (optics.middle() - ray.origin.z) / ray.direction.z;
                line.x_mm.push(ray.at(t).x);
                line.z_mm.push(f64::NAN);
                line.intensity.push(0);
            }
        }
    }

    /// What the camera takes for the peak of a column: the mean of the brightest group of returns at one depth.
    fn peak(&self, column: f64, scene_from_sensor: &Pose) -> Option<Return> {
        let sigma = 0.25 * self.optics.spot_mm;
        let mut returns = smallvec::SmallVec::<[Return; 5]>::new();
        let rays = if sigma > 0.0 { &SPOT[..] } else { &SPOT[..1] };
        for &(dx, dy, weight) in rays {
            let across = DVec3::new(dx * sigma, dy * sigma, 0.0);
            let ray = self.optics.ray(column, self.columns, across);
            let ray = Ray::along(
                scene_from_sensor.point(ray.origin),
                scene_from_sensor.direction(ray.direction),
            );
            if let Some(part) = self.part_of_spot(&ray, scene_from_sensor, weight) {
                returns.push(part);
            }
        }
        let near = |a: &Return, b: &Return| (a.depth - b.depth).abs() <= self.optics.blend_mm;
        let brightness = |a: &Return| -> f64 {
            let group = returns.iter().filter(|b| near(a, b));
            group.map(|b| b.weight).sum()
        };
        // the first of equals: the centre of the spot
        let mut best: Option<(f64, &Return)> = None;
        for part in &returns {
            let light = brightness(part);
            if best.is_none_or(|(most, _)| light > most) {
                best = Some((light, part));
            }
        }
        let (light, core) = best?;
        let mean = |of: fn(&Return) -> f64| {
            let group = returns.iter().filter(|b| near(core, b));
            group.map(|b| b.weight * of(b)).sum::<f64>() / light
        };
        Some(Return {
            depth: mean(|r| r.depth),
            cos_incidence: mean(|r| r.cos_incidence),
            weight: light,
        })
    }

    /// Follows one ray of the spot to the scene and back to the camera.
    fn part_of_spot(&self, ray: &Ray, scene_from_sensor: &Pose, weight: f64) -> Option<Return> {
        let hit = self.scene.cast(ray)?;
        let cos_incidence = -hit.normal.dot(ray.direction);
        if cos_incidence <= self.optics.incidence_limit_rad.min(FRAC_PI_2).cos()
            || self.scene.is_dark(hit.point)
            || self.hidden_from_camera(&hit, scene_from_sensor)
        {
            return None;
        }
        Some(Return {
            depth: hit.distance,
            weight,
            cos_incidence,
        })
    }

    fn hidden_from_camera(&self, hit: &Hit, scene_from_sensor: &Pose) -> bool {
        let camera = scene_from_sensor.point(self.optics.camera_mm);
        let origin = hit.point + hit.normal * CLEARANCE;
        let towards = camera - origin;
        if towards.dot(hit.normal) <= 0.0 {
            return true;
        }
        let ray = Ray::new(origin, towards);
        self.scene.blocks(&ray, towards.length())
    }
}

#[cfg(test)]
mod tests;
