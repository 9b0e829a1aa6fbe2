//! A stream of poses (a robot's flange, a probe head) and the pose at any time within it.

use glam::DVec3;

use crate::geometry::RigidTransform;

/// Poses of one source by its own clock, joined by interpolation; nothing is made up across a gap.
#[derive(Debug, Clone, Default)]
pub struct PoseTrack {
    times_s: Vec<f64>,
    poses: Vec<RigidTransform>,
    refused: u64,
}

/// Why there is no pose at a time.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseGap {
    /// Before the first or after the last pose.
    #[error("{time_s:.4} s lies outside the poses, which go from {first_s:.4} to {last_s:.4} s")]
    Outside {
        /// The time asked for.
        time_s: f64,
        /// The first pose.
        first_s: f64,
        /// The last pose.
        last_s: f64,
    },
    /// Poses are missing there.
    #[error(
        "no pose between {from_s:.4} and {to_s:.4} s, expected one every {cycle_s:.4} s; {time_s:.4} s lies between"
    )]
    Missing {
        /// The time asked for.
        time_s: f64,
        /// The pose before.
        from_s: f64,
        /// The pose after.
        to_s: f64,
        /// The usual distance.
        cycle_s: f64,
    },
    /// There are fewer than two poses.
    #[error("{0} poses, expected at least 2")]
    Empty(usize),
}

/// Cycles that may be missing between two poses. A robot that moves a metre a second squared strays from a straight line by 2 um in two
/// cycles of 4 ms (a t^2 / 8).
const MISSING_MAX: f64 = 2.5;

impl PoseTrack {
    /// Adds a pose; one that is not later than the last, or no number, is counted and left out.
    pub fn push(&mut self, time_s: f64, pose: RigidTransform) {
        let later = self.times_s.last().is_none_or(|last| time_s > *last);
        if later && time_s.is_finite() && pose.translation.is_finite() && pose.rotation.is_finite()
        {
            self.times_s.push(time_s);
            self.poses.push(pose);
        } else {
            self.refused += 1;
        }
    }

    /// Poses left out.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Median distance of two poses, s; 0 for fewer than two.
    pub fn cycle_s(&self) -> f64 {
        let mut steps: Vec<f64> = self.times_s.windows(2).map(|t| t[1] - t[0]).collect();
        if steps.is_empty() {
            return 0.0;
        }
        let middle = steps.len() / 2;
        *steps.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// The poses at `times_s`: position along a straight line, rotation along a great circle between the neighbours.
    ///
    /// # Errors
    /// [`PoseGap`], for each time by itself.
    pub fn at(&self, times_s: &[f64]) -> Vec<Result<RigidTransform, PoseGap>> {
        let cycle_s = self.cycle_s();
        times_s.iter().map(|t| self.one(*t, cycle_s)).collect()
    }

    fn one(&self, time_s: f64, cycle_s: f64) -> Result<RigidTransform, PoseGap> {
        let (Some(first_s), Some(last_s)) = (self.times_s.first(), self.times_s.last()) else {
            return Err(PoseGap::Empty(0));
        };
        if self.times_s.len() < 2 {
            return Err(PoseGap::Empty(1));
        }
        if !(*first_s..=*last_s).contains(&time_s) {
            return Err(PoseGap::Outside {
                time_s,
                first_s: *first_s,
                last_s: *last_s,
            });
        }
        let after = self
            .times_s
            .partition_point(|t| *t < time_s)
            .clamp(1, self.times_s.len() - 1);
        let [from_s, to_s] = [self.times_s[after - 1], self.times_s[after]];
        if to_s - from_s > MISSING_MAX * cycle_s && time_s != from_s && time_s != to_s {
            return Err(PoseGap::Missing {
                time_s,
                from_s,
                to_s,
                cycle_s,
            });
        }
        let share = (time_s - from_s) / (to_s - from_s);
        let [a, b] = [self.poses[after - 1], self.poses[after]];
        let position: DVec3 = a.translation.lerp(b.translation, share);
        Ok(RigidTransform::new(
            a.rotation.slerp(b.rotation, share),
            position,
        ))
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    /// A robot on a circle of 200 mm in 4 s, turning with it, a pose every 8 ms.
    fn truth(t: f64) -> RigidTransform {
        let angle = t * std::f64::consts::FRAC_PI_2;
        let place = DVec3::new(200.0 * angle.cos(), 200.0 * angle.sin(), 50.0);
        RigidTransform::new(DQuat::from_rotation_z(angle), place)
    }

    fn track(skip: std::ops::Range<i32>) -> PoseTrack {
        let mut track = PoseTrack::default();
        for k in (0..500).filter(|k| !skip.contains(k)) {
            let t = 0.008 * f64::from(k);
            track.push(t, truth(t));
        }
        track
    }

    #[test]
    fn between_two_poses_lies_the_chord_and_the_turn_is_exact() {
        let track = track(0..0);
        let times: Vec<f64> = (0..200).map(|k| 0.003 + 0.0187 * f64::from(k)).collect();
        for (t, found) in times.iter().zip(track.at(&times)) {
            let (found, truth) = (found.expect("within"), truth(*t));
            // Sagitta of the chord: v^2 / r t^2 / 8 with v = 314 mm/s.
            let sagitta = 314.2f64.powi(2) / 200.0 * 0.008f64.powi(2) / 8.0;
            assert!(found.translation.distance(truth.translation) < 1.01 * sagitta);
            assert!(found.rotation.angle_between(truth.rotation) < 1e-7);
        }
    }

    #[test]
    fn nothing_is_made_up_across_a_gap_or_beyond_the_ends() {
        let track = track(100..110);
        let found = track.at(&[0.83, 0.78, -0.1, 9.0]);
        assert!(
            matches!(found[0], Err(PoseGap::Missing { .. })),
            "{:?}",
            found[0]
        );
        assert!(found[1].is_ok());
        assert!(matches!(found[2], Err(PoseGap::Outside { .. })));
        assert!(matches!(found[3], Err(PoseGap::Outside { .. })));
        assert_eq!(PoseTrack::default().at(&[0.0]), [Err(PoseGap::Empty(0))]);
    }

    #[test]
    fn poses_out_of_order_or_without_numbers_are_counted() {
        let mut track = track(0..0);
        track.push(0.1, truth(0.1));
        track.push(f64::NAN, truth(0.1));
        track.push(
            100.0,
            RigidTransform::new(DQuat::IDENTITY, DVec3::new(f64::NAN, 0.0, 0.0)),
        );
        assert_eq!(track.refused(), 3);
    }
}
