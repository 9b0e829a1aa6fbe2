//! What speaks against a pose: rivals, a misfit, a mirrored part, directions that nothing holds.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::scene::{Fit, Scene};
use super::search::{self, Pose};
use super::twist::axis_name;
use super::{Aligned, Conclusion, Start, Step, Task, Twist, is_different};
use crate::geometry::RigidTransform;
use crate::inspect::body::Body;
use crate::inspect::measure::pose_row;
use crate::inspect::result::Verdict;

/// Share of the points near the nominal that must lie on it; the rest may be burrs, reflections, the foot of a clamp, and places so narrow
/// that their normal is that of no face.
const ON_NOMINAL: f64 = 0.9;

/// Share of the points within the nominal's box that may lie far from every face: what holds the part stands outside of it, so that surfaces
/// where the nominal has material, or nothing, are those of another part.
const STRAY: f64 = 0.1;

/// Share of the half-diagonal that a face of the right part may be off: 0.2 mm of a part of 10 mm. What lies on a face of its direction and
/// further off was not made by shifting a face.
const FORM: f64 = 0.04;

/// Points with a normal without which nothing can be said of a pose.
const ENOUGH: usize = 50;

/// Starts of the second and third try: a turn at the half-diagonal, and a shift over it.
const SECOND_START: f64 = 0.05;

/// How many symmetries a finding names.
const NAMED: usize = 4;

impl<B: Body> Task<'_, B> {
    /// Lowers the status of `aligned` to what the pose deserves, with the reasons.
    pub(super) fn check(
        &self,
        scene: &Scene,
        poses: &[Pose],
        start: Start,
        step: &Step,
        aligned: &mut Aligned,
    ) {
        let pose = aligned.alignment.part_from_machine;
        let weak = self.twists(step);
        let mut against = Vec::new();
        if scene.points.len() < ENOUGH {
            against.push((
                Conclusion::Misfit,
                format!(
                    "alignment: only {} points of the scan have a neighbourhood that shows a normal, expected at least {ENOUGH}; scan more",
                    scene.points.len()
                ),
            ));
        } else {
            let fit = scene.fit(&pose, self.surface, self.cap_mm());
            let misfit = self.misfit(&fit);
            against.extend(self.mirror(scene, (&pose, &fit), misfit.is_some()));
            against.extend(misfit);
            against.extend(self.rivals(scene, (&pose, &fit), poses, (start, &weak)));
        }
        if let Some(id) = self.moved_edge(&weak) {
            against.push((
                Conclusion::Free,
                format!(
                    "alignment: the data do not hold {}, which moves edge {id}; scan another face",
                    aligned.alignment.weak_directions.join(", ")
                ),
            ));
        }
        if let Some((conclusion, _)) = against.first() {
            aligned.conclusion = *conclusion;
            aligned.alignment.status = Verdict::NotDecidable;
        }
        aligned.findings.extend(against.into_iter().map(|a| a.1));
    }

    /// Too many points near the nominal that do not lie on it, or too few near it.
    fn misfit(&self, fit: &Fit) -> Option<(Conclusion, String)> {
        let total = fit.distances.len();
        if fit.near * 2 < total {
            let finding = format!(
                "alignment: only {} of {total} points lie near the nominal, expected more than half; check part and start",
                fit.near
            );
            return Some((Conclusion::Misfit, finding));
        }
        let within = fit.near + fit.stray;
        if fit.stray as f64 > STRAY * within as f64 {
            let finding = format!(
                "alignment: {:.0} % of the points within the nominal's box lie far from every face, expected at most {:.0} %; check part and start",
                100.0 * fit.stray as f64 / within as f64,
                100.0 * STRAY
            );
            return Some((Conclusion::Misfit, finding));
        }
        let limit_mm = self.on_nominal_mm();
        let on = fit.share(limit_mm) * total as f64 / fit.near as f64;
        (on < ON_NOMINAL).then(|| {
            let finding = format!(
                "alignment: {:.0} % of the points near the nominal lie on a face of its direction to {limit_mm:.3} mm, expected {:.0} %; \
                 check part and start",
                100.0 * on,
                100.0 * ON_NOMINAL
            );
            (Conclusion::Misfit, finding)
        })
    }

    fn on_nominal_mm(&self) -> f64 {
        (6.0 * self.scan.noise_mm).max(FORM * self.size_mm)
    }

    /// Whether the mirrored scan fits better: looked for where mirrored parts nearly coincide with the nominal, and everywhere if the
    /// scan does not fit.
    fn mirror(
        &self,
        scene: &Scene,
        (pose, fit): (&RigidTransform, &Fit),
        everywhere: bool,
    ) -> Option<(Conclusion, String)> {
        let mirrored = scene.mirrored();
        let found = if everywhere {
            search::search(self, &mirrored, Start::Auto)
        } else {
            let starts = (&mirrored, self.mirrored_poses(pose));
            let promising = search::promising(self, starts, (scene, pose));
            search::refine(self, &mirrored, promising)
        };
        let better = found.first()?.fit.is_better(fit, self.scan.noise_mm);
        better.then(|| {
            let finding = "alignment: the mirror image of the scan fits the nominal better than the scan; check whether it is the mirrored \
                 part, or the axes of the scan"
                .to_string();
            (Conclusion::Mirrored, finding)
        })
    }

    /// Poses of the mirrored scan that follow from `pose` if the nominal nearly has a plane of symmetry through its middle.
    fn mirrored_poses(&self, pose: &RigidTransform) -> Vec<RigidTransform> {
        let [low, high] = self.surface.body.bounds();
        let middle = 0.5 * (low + high);
        let turn = DMat3::from_quat(pose.rotation);
        // The scene is mirrored at x = 0.
        let scene = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let diagonals = (0..3).flat_map(|k| {
            let (a, b) = (axes[k], axes[(k + 1) % 3]);
            [(a + b).normalize(), (a - b).normalize()]
        });
        axes.into_iter()
            .chain(diagonals)
            .map(|n| {
                let plane = DMat3::IDENTITY - 2.0 * DMat3::from_cols(n * n.x, n * n.y, n * n.z);
                let shift = plane * (pose.translation - middle) + middle;
                RigidTransform::from_matrix(plane * turn * scene, shift)
            })
            .collect()
    }

    /// Other poses that fit as well: those that the search found, and where a second and a third start end.
    fn rivals(
        &self,
        scene: &Scene,
        (pose, fit): (&RigidTransform, &Fit),
        poses: &[Pose],
        (start, weak): (Start, &[Twist]),
    ) -> Option<(Conclusion, String)> {
        let again = self
            .second_starts(pose)
            .into_par_iter()
            .filter_map(|start| {
                let (pose, weak) = self.coarse(start, super::COARSE_POINTS, 0.2 * self.size_mm)?;
                let fit = scene.fit(&pose, self.surface, self.cap_mm());
                Some(Pose { pose, fit, weak })
            });
        let again: Vec<Pose> = again.collect();
        let mut rivals: Vec<RigidTransform> = Vec::new();
        for other in poses.iter().chain(&again) {
            let possible = match start {
                Start::Rough(start) => self.is_within(&start, &other.pose),
                _ => true,
            };
            // Only what all points leave open makes two poses one: a few points miss what narrow faces hold.
            let new = |p: &RigidTransform| is_different(p, &other.pose, weak, self.size_mm);
            let fits = |other: &Fit| !fit.is_better(other, self.scan.noise_mm);
            if !(possible && new(pose) && rivals.iter().all(new) && fits(&other.fit)) {
                continue;
            }
            if other.weak.is_empty() {
                rivals.push(other.pose);
                continue;
            }
            // What a few points leave open, all of them may hold: then it ends at a pose that is known, or fits no more.
            let Some((settled, ..)) = self.fine(other.pose) else {
                continue;
            };
            let new = |p: &RigidTransform| is_different(p, &settled, weak, self.size_mm);
            let settled_fit = scene.fit(&settled, self.surface, self.cap_mm());
            if new(pose) && rivals.iter().all(new) && fits(&settled_fit) {
                rivals.push(settled);
            }
        }
        if rivals.is_empty() {
            return None;
        }
        let names: Vec<String> = rivals
            .iter()
            .take(NAMED)
            .map(|r| motion_name(&(*r * pose.inverse()), self.size_mm))
            .collect();
        let finding = format!(
            "alignment: {} poses fit the scan equally well, expected one; the part looks the same after {}{}, or too little of it was \
             scanned: give a rough start",
            rivals.len() + 1,
            names.join(", "),
            if rivals.len() > NAMED {
                " and others"
            } else {
                ""
            }
        );
        Some((Conclusion::Ambiguous(rivals.len() + 1), finding))
    }

    /// Two starts beside the pose, on opposite sides.
    fn second_starts(&self, pose: &RigidTransform) -> [RigidTransform; 2] {
        let [low, high] = self.surface.body.bounds();
        let middle = 0.5 * (low + high);
        [1.0, -1.0].map(|sign| {
            let turn = sign * SECOND_START * DVec3::new(0.58, 0.58, 0.58);
            let shift = sign * SECOND_START * self.size_mm * DVec3::new(0.67, -0.67, 0.33);
            let about_middle = Twist {
                turn,
                shift: middle.cross(turn) + shift,
            };
            self.moved(&about_middle, *pose)
        })
    }

    /// Whether a pose is one that a rough start allows, some slack included.
    fn is_within(&self, start: &RigidTransform, pose: &RigidTransform) -> bool {
        let prior = self.options.start_within;
        let motion = *pose * start.inverse();
        let [low, high] = self.surface.body.bounds();
        let middle = 0.5 * (low + high);
        let turned = Twist::logarithm(&motion).turn.length();
        let shifted = motion.point(middle).distance(middle);
        turned < 1.2 * prior.turn_rad + 0.05
            && shifted < (1.2 * prior.shift_share + 0.05) * self.size_mm
    }

    /// A sharp edge that a motion of one mm at the rim along a weak direction moves by more than 0.02 mm across.
    fn moved_edge(&self, weak: &[Twist]) -> Option<String> {
        if weak.is_empty() {
            return None;
        }
        let edges = self.surface.body.edges();
        for (e, edge) in edges.iter().enumerate() {
            for share in [0.1, 0.5, 0.9] {
                let station = self.surface.body.station(e, share * edge.length_mm);
                for normal in station.normals {
                    let row = pose_row(station.point, normal);
                    if weak.iter().any(|w| w.along(&row).abs() > 0.02) {
                        return Some(edge.id.clone());
                    }
                }
            }
        }
        None
    }
}

/// `a turn by 180 degrees about z`, `a shift by 3.0 mm along x`.
fn motion_name(motion: &RigidTransform, size_mm: f64) -> String {
    let twist = Twist::logarithm(motion);
    if twist.turn.length() < 0.02 {
        return format!(
            "a shift by {:.1} mm along {}",
            twist.shift.length(),
            axis_name(twist.shift)
        );
    }
    let mut text = format!(
        "a turn by {:.0} degrees about {}",
        twist.turn.length().to_degrees(),
        axis_name(twist.turn)
    );
    let along = twist.shift.dot(twist.turn.normalize());
    if along.abs() > 0.05 * size_mm {
        text += &format!(" with a shift by {:.1} mm", along.abs());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn symmetries_are_named() {
        let half = RigidTransform::new(
            DQuat::from_rotation_z(std::f64::consts::PI),
            DVec3::new(20.0, 14.0, 0.0),
        );
        assert_eq!(motion_name(&half, 10.0), "a turn by 180 degrees about z");
        let shift = RigidTransform::new(DQuat::IDENTITY, DVec3::new(0.0, 5.0, 0.0));
        assert_eq!(motion_name(&shift, 10.0), "a shift by 5.0 mm along y");
    }
}
