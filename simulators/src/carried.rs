//! A motion that several simulated devices share: a robot that says where its tool is, and sensors on the tool that see from there.

use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::DVec3;

use crate::pose::Pose;
use crate::wire::lock;

/// Where the tool is at a time since it set off, s. At 0 it rests, and after the end it rests again.
type Path = dyn Fn(f64) -> Pose + Send + Sync;

/// A tool that rests, sets off once, and rests again.
pub struct Motion {
    path: Arc<Path>,
    set_off: Mutex<Option<Instant>>,
}

impl fmt::Debug for Motion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Motion")
            .field("set_off", &*lock(&self.set_off))
            .finish_non_exhaustive()
    }
}

impl Motion {
    /// A tool on `path`, at rest.
    pub fn new(path: impl Fn(f64) -> Pose + Send + Sync + 'static) -> Motion {
        Motion {
            path: Arc::new(path),
            set_off: Mutex::new(None),
        }
    }

    /// From `from` along `way`, mm, at `speed_mm_s` in the middle, with a share of the time at both ends to gather and lose it.
    pub fn straight(from: Pose, way: DVec3, speed_mm_s: f64) -> Motion {
        let length = way.length();
        let seconds = 1.25 * length / speed_mm_s;
        Motion::new(move |time_s| Pose {
            rotation: from.rotation,
            translation: from.translation + way * eased(time_s / seconds),
        })
    }

    /// Sets off at `at`, if it has not done so before.
    pub fn go(&self, at: Instant) {
        lock(&self.set_off).get_or_insert(at);
    }

    /// Where the tool is.
    pub fn at(&self, at: Instant) -> Pose {
        let since =
            lock(&self.set_off).map_or(Duration::ZERO, |off| at.saturating_duration_since(off));
        (self.path)(since.as_secs_f64())
    }
}

/// Way done at a share of the time: constant speed of 1.25 in the middle three fifths, gathered and lost evenly at the ends.
pub fn eased(share: f64) -> f64 {
    const RAMP: f64 = 0.2;
    const SPEED: f64 = 1.25;
    let t = share.clamp(0.0, 1.0);
    if t < RAMP {
        0.5 * SPEED * t * t / RAMP
    } else if t > 1.0 - RAMP {
        1.0 - 0.5 * SPEED * (1.0 - t) * (1.0 - t) / RAMP
    } else {
        SPEED * (t - 0.5 * RAMP)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tool_rests_goes_and_rests() {
        let motion = Motion::straight(Pose::IDENTITY, DVec3::X * 100.0, 50.0);
        let now = Instant::now();
        assert_eq!(motion.at(now).translation.x, 0.0);
        motion.go(now);
        motion.go(now + Duration::from_secs(9));
        let at = |ms| motion.at(now + Duration::from_millis(ms)).translation.x;
        // 2.5 s in all: a fifth to gather speed is 12.5 mm, then 50 mm/s.
        assert!((at(500) - 12.5).abs() < 1e-9);
        assert!((at(1500) - 62.5).abs() < 1e-9);
        assert!((at(2000) - 87.5).abs() < 1e-9);
        assert_eq!(at(9000), 100.0);
    }
}
