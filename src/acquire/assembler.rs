//! Live assembly: one profile after the other becomes points in the machine frame.

use acies_drivers::capture::Profile;
use glam::DVec3;

use super::Calibration;
use crate::points::{Frame, Origin, PointCloud, View};

/// An encoder step this many times larger than the median of those before it is a jump, not motion.
///
/// Lost profiles multiply a step by their number, which the sequence tells; what is left of a real stage is its change of
/// speed, a factor of a few. A wrapped or glitching counter is off by thousands.
const JUMP_FACTOR: f64 = 50.0;

/// Steps that are kept for the median.
const STEPS_KEPT: usize = 64;

/// Turns the profiles of one view into points while the scan runs.
///
/// Memory: 32 bytes a point, and nothing that grows otherwise.
#[derive(Debug)]
pub struct Assembler {
    calibration: Calibration,
    cloud: PointCloud,
    last: Option<Placed>,
    steps: Vec<f64>,
    reversals: u64,
    repeats: u64,
    jumps: u64,
    without_encoder: u64,
    empty_columns: u64,
    profiles: u64,
}

/// The profile placed last.
#[derive(Debug, Clone, Copy)]
struct Placed {
    index: u32,
    encoder: i64,
    forward: bool,
}

impl Assembler {
    /// An empty view of `device`.
    pub fn new(device: &str, calibration: Calibration) -> Self {
        let towards_sensor = calibration.machine_from_sensor.vector(DVec3::NEG_Z);
        let view = View {
            device: device.to_owned(),
            towards_sensor,
        };
        Self {
            calibration,
            cloud: PointCloud {
                frame: Frame::Machine,
                positions: Vec::new(),
                origins: Vec::new(),
                views: vec![view],
            },
            last: None,
            steps: Vec::with_capacity(STEPS_KEPT),
            reversals: 0,
            repeats: 0,
            jumps: 0,
            without_encoder: 0,
            empty_columns: 0,
            profiles: 0,
        }
    }

    /// Places one profile by its encoder. A profile without encoder, or with one that jumped, is counted and left out.
    pub fn push(&mut self, profile: &Profile) {
        let Some(encoder) = profile.encoder else {
            self.without_encoder += 1;
            return;
        };
        let index = profile.sequence.saturating_add(profile.dropped);
        if !self.accept(index, encoder) {
            self.jumps += 1;
            return;
        }
        self.profiles += 1;
        let shift = self.calibration.travel_mm_per_count * encoder as f64;
        for (column, (&x_mm, &z_mm)) in profile.x_mm.iter().zip(&profile.z_mm).enumerate() {
            if !z_mm.is_finite() {
                self.empty_columns += 1;
                continue;
            }
            let in_sensor = DVec3::new(x_mm, 0.0, z_mm);
            self.cloud
                .positions
                .push(self.calibration.machine_from_sensor.point(in_sensor) + shift);
            self.cloud.origins.push(Origin {
                view: 0,
                column: column as u16,
                profile: index,
            });
        }
    }

    /// Whether `encoder` can be where the stage is at the profile `index`; remembers it if so.
    fn accept(&mut self, index: u32, encoder: i64) -> bool {
        let Some(last) = self.last else {
            self.last = Some(Placed {
                index,
                encoder,
                forward: true,
            });
            return true;
        };
        let profiles = f64::from(index.saturating_sub(last.index).max(1));
        let delta = encoder.wrapping_sub(last.encoder);
        let step = (delta as f64).abs() / profiles;
        if self.steps.len() >= 8 && step > JUMP_FACTOR * median(&self.steps).max(1.0) {
            return false;
        }
        let forward = if delta == 0 { last.forward } else { delta > 0 };
        self.repeats += u64::from(delta == 0);
        self.reversals += u64::from(forward != last.forward && !self.steps.is_empty());
        if self.steps.len() == STEPS_KEPT {
            self.steps.remove(0);
        }
        self.steps.push(step);
        self.last = Some(Placed {
            index,
            encoder,
            forward,
        });
        true
    }

    /// Encoder counts of the profile placed last.
    pub fn encoder(&self) -> Option<i64> {
        self.last.map(|last| last.encoder)
    }

    /// The points placed so far, in the machine frame.
    pub fn positions(&self) -> &[DVec3] {
        &self.cloud.positions
    }

    /// The device's name.
    pub fn device(&self) -> &str {
        &self.cloud.views[0].device
    }

    /// Profiles placed so far.
    pub fn profiles(&self) -> u64 {
        self.profiles
    }

    /// Profiles left out so far.
    pub fn unplaced(&self) -> u64 {
        self.jumps + self.without_encoder
    }

    /// Columns so far in which nothing was seen.
    pub fn empty_columns(&self) -> u64 {
        self.empty_columns
    }

    /// The points of the view, and what was wrong with them as sentences.
    pub fn finish(self) -> (PointCloud, Vec<String>) {
        let device = &self.cloud.views[0].device;
        let mut findings = Vec::new();
        let mut find = |count: u64, sentence: String| {
            if count > 0 {
                findings.push(sentence);
            }
        };
        let count = self.without_encoder;
        find(
            count,
            format!("{device}: {count} profiles without an encoder value were left out"),
        );
        let count = self.jumps;
        find(
            count,
            format!(
                "{device}: {count} profiles whose encoder jumped were left out; check the encoder's cable"
            ),
        );
        let count = self.reversals;
        find(
            count,
            format!("{device}: {count} reversals of the stage during the scan"),
        );
        let count = self.repeats;
        find(
            count,
            format!("{device}: {count} profiles at the encoder count of the one before"),
        );
        (self.cloud, findings)
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    let middle = sorted.len() / 2;
    *sorted.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use glam::DQuat;

    use super::*;
    use crate::geometry::RigidTransform;

    fn profile(sequence: u32, encoder: Option<i64>) -> Profile {
        Profile {
            sequence,
            boot: 1,
            device_time_ns: 0,
            encoder,
            host_time: Instant::now(),
            dropped: 0,
            saturated: false,
            x_mm: vec![-1.0, 0.0, 1.0],
            z_mm: vec![100.0, f64::NAN, 101.0],
            intensity: Vec::new(),
        }
    }

    fn calibration() -> Calibration {
        // A sensor 110 mm above the machine's origin that looks straight down: its z is the machine's -z.
        let down = DQuat::from_axis_angle(DVec3::X, std::f64::consts::PI);
        Calibration {
            machine_from_sensor: RigidTransform::new(down, DVec3::new(0.0, 0.0, 110.0)),
            travel_mm_per_count: DVec3::new(0.0, 0.01, 0.0),
        }
    }

    #[test]
    fn a_profile_lies_where_calibration_and_encoder_put_it() {
        let mut assembler = Assembler::new("left", calibration());
        assembler.push(&profile(0, Some(250)));
        let (cloud, findings) = assembler.finish();
        let expected = [DVec3::new(-1.0, 2.5, 10.0), DVec3::new(1.0, 2.5, 9.0)];
        for (found, expected) in cloud.positions.iter().zip(expected) {
            assert!(
                (*found - expected).length() < 1e-12,
                "{found} is not {expected}"
            );
        }
        assert_eq!(
            cloud.origins[1],
            Origin {
                view: 0,
                column: 2,
                profile: 0
            }
        );
        assert!((cloud.views[0].towards_sensor - DVec3::Z).length() < 1e-12);
        assert_eq!(findings, Vec::<String>::new());
    }

    #[test]
    fn lost_profiles_leave_a_gap_and_no_jump() {
        let mut assembler = Assembler::new("left", calibration());
        for sequence in (0..20).chain(100..120) {
            assembler.push(&profile(sequence, Some(i64::from(sequence) * 40)));
        }
        assert_eq!(assembler.profiles(), 40);
        let (cloud, findings) = assembler.finish();
        assert_eq!(cloud.origins[40].profile, 100);
        assert_eq!(findings, Vec::<String>::new());
    }

    #[test]
    fn an_encoder_that_jumps_back_and_forth_is_left_out_and_said() {
        let mut assembler = Assembler::new("left", calibration());
        for sequence in 0..40u32 {
            let glitch = if sequence == 25 { 1 << 32 } else { 0 };
            assembler.push(&profile(sequence, Some(i64::from(sequence) * 40 + glitch)));
        }
        assembler.push(&profile(40, None));
        assert_eq!(assembler.unplaced(), 2);
        assert_eq!(
            assembler.finish().1,
            [
                "left: 1 profiles without an encoder value were left out",
                "left: 1 profiles whose encoder jumped were left out; check the encoder's cable"
            ]
        );
    }

    #[test]
    fn a_stage_that_turns_round_or_stands_still_is_said() {
        let mut assembler = Assembler::new("left", calibration());
        for (sequence, encoder) in [0, 40, 80, 80, 40, 80].into_iter().enumerate() {
            assembler.push(&profile(sequence as u32, Some(encoder)));
        }
        assert_eq!(
            assembler.finish().1,
            [
                "left: 2 reversals of the stage during the scan",
                "left: 1 profiles at the encoder count of the one before"
            ]
        );
    }
}
