//! Measured points in one named frame, each traceable to its raw sample.
//!
//! Hides the memory layout, the k-d tree, the estimates of spacing and noise, and the file formats.

mod duplicates;
pub mod error;
mod lzf;
pub(crate) mod moments;
pub mod neighbors;
mod obj;
mod pcd;
pub mod picture;
mod ply;
pub mod read;
mod scalar;
pub mod spacing;
mod stl;
mod text;
pub mod write;

use glam::DVec3;

pub use error::{Fault, Place, PointsError};
pub use neighbors::Neighbors;
pub use read::{Format, Read, Unit, parse, read};
pub use spacing::{Spacing, noise_mm, spacing};
pub use write::{Column, Encoding, write_ply, write_scan, write_xyz};

/// The frame that coordinates are given in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    /// As a sensor delivered them.
    Sensor,
    /// Axes, robot or conveyor applied.
    Machine,
    /// Aligned to the nominal.
    Part,
}

/// Where a point comes from: its place in the lattice that a profiler measures.
///
/// Neighbours on the surface are neighbours in (profile, column) of one view, save at depth jumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Origin {
    /// Index into [`PointCloud::views`].
    pub view: u16,
    /// Column on the sensor's line.
    pub column: u16,
    /// Profile of the view, counted with the lost ones, so that a gap in it is a gap on the part.
    pub profile: u32,
}

/// One direction from which a part was scanned.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The device's name in the cell's configuration.
    pub device: String,
    /// Unit vector from the part towards the sensor, in the cloud's frame.
    pub towards_sensor: DVec3,
}

/// N measured points, mm, all finite.
///
/// Memory: 24 bytes a point, and 8 more where the lattice is known.
#[derive(Debug, Clone, PartialEq)]
pub struct PointCloud {
    /// What frame the positions are in.
    pub frame: Frame,
    /// N positions, mm.
    pub positions: Vec<DVec3>,
    /// N origins, or none where nothing but coordinates is known.
    pub origins: Vec<Origin>,
    /// The views that `origins` speaks of.
    pub views: Vec<View>,
}

impl PointCloud {
    /// A cloud of which nothing but coordinates is known.
    pub fn from_positions(frame: Frame, positions: Vec<DVec3>) -> Self {
        Self {
            frame,
            positions,
            origins: Vec::new(),
            views: Vec::new(),
        }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The smallest and largest coordinates, mm, or none for no points.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let first = *self.positions.first()?;
        let bounds = |(low, high): (DVec3, DVec3), &p: &DVec3| (low.min(p), high.max(p));
        Some(self.positions.iter().fold((first, first), bounds))
    }

    /// The cloud in another frame: `point` moves the positions, `direction` turns the views' directions.
    pub fn map(
        &self,
        frame: Frame,
        point: impl Fn(DVec3) -> DVec3,
        direction: impl Fn(DVec3) -> DVec3,
    ) -> Self {
        let turned = |view: &View| View {
            device: view.device.clone(),
            towards_sensor: direction(view.towards_sensor),
        };
        Self {
            frame,
            positions: self.positions.iter().map(|&p| point(p)).collect(),
            origins: self.origins.clone(),
            views: self.views.iter().map(turned).collect(),
        }
    }

    /// The points at `indices`, in that order; views are kept all.
    ///
    /// # Panics
    /// Where an index is not below [`PointCloud::len`].
    pub fn subset(&self, indices: &[usize]) -> Self {
        let origins = if self.origins.is_empty() {
            Vec::new()
        } else {
            indices.iter().map(|&i| self.origins[i]).collect()
        };
        Self {
            frame: self.frame,
            positions: indices.iter().map(|&i| self.positions[i]).collect(),
            origins,
            views: self.views.clone(),
        }
    }

    /// All points of `clouds`, one cloud after the other, the views numbered on.
    ///
    /// The lattice is kept where every cloud that has points has one.
    ///
    /// # Errors
    /// [`PointsError::Inconsistent`] where the frames differ, there is no cloud, or there are more than 65,536 views.
    pub fn merge(clouds: &[PointCloud]) -> Result<PointCloud, PointsError> {
        let Some(first) = clouds.first() else {
            return Err(inconsistent("no cloud to join".into(), "at least one"));
        };
        let mut merged = Self::from_positions(first.frame, Vec::new());
        let has_lattice = clouds.iter().all(|c| c.is_empty() || !c.origins.is_empty());
        for cloud in clouds {
            if cloud.frame != first.frame {
                let seen = format!(
                    "points in the {:?} and the {:?} frame",
                    first.frame, cloud.frame
                );
                return Err(inconsistent(seen, "one frame"));
            }
            cloud.check_lattice()?;
            merged.positions.extend_from_slice(&cloud.positions);
            if !has_lattice {
                continue;
            }
            let before = merged.views.len();
            merged.views.extend_from_slice(&cloud.views);
            if merged.views.len() > MOST_VIEWS {
                let seen = format!("{} views", merged.views.len());
                return Err(inconsistent(seen, "at most 65536 views"));
            }
            // Below MOST_VIEWS, so the sum fits.
            let renumbered = |o: &Origin| Origin {
                view: o.view + before as u16,
                ..*o
            };
            merged.origins.extend(cloud.origins.iter().map(renumbered));
        }
        Ok(merged)
    }

    /// The cloud without points that are NaN or infinite, and the finding that says how many there were.
    pub fn remove_non_finite(self) -> (Self, Option<String>) {
        let finite: Vec<usize> = (0..self.len())
            .filter(|&i| self.positions[i].is_finite())
            .collect();
        let removed = self.len() - finite.len();
        if removed == 0 {
            return (self, None);
        }
        let finding = format!(
            "{removed} of {} points were not finite and were left out",
            self.len()
        );
        (self.subset(&finite), Some(finding))
    }

    /// How many points lie exactly on an earlier one, where there are any.
    pub fn duplicates_finding(&self) -> Option<String> {
        let first = duplicates::first_occurrences(&self.positions);
        let repeated = first.iter().filter(|&&is_first| !is_first).count();
        (repeated > 0).then(|| {
            format!(
                "{repeated} of {} points lie exactly on an earlier point",
                self.len()
            )
        })
    }

    /// Whether origins and views fit the points.
    ///
    /// # Errors
    /// [`PointsError::Inconsistent`].
    pub fn check_lattice(&self) -> Result<(), PointsError> {
        if self.origins.is_empty() {
            return Ok(());
        }
        if self.origins.len() != self.len() {
            let seen = format!("{} origins for {} points", self.origins.len(), self.len());
            return Err(inconsistent(seen, "one a point, or none at all"));
        }
        if self.views.len() > MOST_VIEWS {
            let seen = format!("{} views", self.views.len());
            return Err(inconsistent(seen, "at most 65536 views"));
        }
        if let Some(view) = self
            .views
            .iter()
            .position(|v| !v.towards_sensor.is_normalized())
        {
            let seen = format!(
                "view {view} points along {}",
                self.views[view].towards_sensor
            );
            return Err(inconsistent(seen, "a unit vector"));
        }
        let highest = self.origins.iter().map(|o| o.view).max().unwrap_or(0);
        if usize::from(highest) >= self.views.len() {
            let seen = format!(
                "an origin of view {highest} among {} views",
                self.views.len()
            );
            return Err(inconsistent(seen, "views that are there"));
        }
        Ok(())
    }
}

/// As many as an origin can name.
const MOST_VIEWS: usize = 1 << 16;

fn inconsistent(seen: String, expected: &'static str) -> PointsError {
    PointsError::Inconsistent { seen, expected }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn clouds_are_joined_with_their_views_numbered_on() {
        let view = |name: &str| View {
            device: name.into(),
            towards_sensor: DVec3::Z,
        };
        let cloud = |x: f64, views: &[&str]| PointCloud {
            frame: Frame::Machine,
            positions: vec![DVec3::X * x; views.len()],
            origins: (0..views.len() as u16)
                .map(|view| Origin {
                    view,
                    column: 7,
                    profile: 9,
                })
                .collect(),
            views: views.iter().map(|v| view(v)).collect(),
        };
        let merged = PointCloud::merge(&[cloud(1.0, &["a", "b"]), cloud(2.0, &["c"])]).unwrap();
        assert_eq!(merged.views, ["a", "b", "c"].map(view));
        assert_eq!(
            merged.origins.iter().map(|o| o.view).collect::<Vec<_>>(),
            [0, 1, 2]
        );
        assert_eq!(merged.positions, [DVec3::X, DVec3::X, DVec3::X * 2.0]);

        let bare = PointCloud::from_positions(Frame::Machine, vec![DVec3::ZERO]);
        let mixed = PointCloud::merge(&[cloud(1.0, &["a"]), bare]).unwrap();
        assert_eq!(
            (mixed.len(), mixed.origins.len(), mixed.views.len()),
            (2, 0, 0)
        );

        let other = PointCloud::from_positions(Frame::Part, vec![DVec3::ZERO]);
        assert_eq!(
            PointCloud::merge(&[cloud(1.0, &["a"]), other])
                .unwrap_err()
                .to_string(),
            "point cloud: points in the Machine and the Part frame, expected one frame; build the cloud from one scan"
        );
        assert_eq!(
            PointCloud::merge(&[]).unwrap_err().to_string(),
            "point cloud: no cloud to join, expected at least one; build the cloud from one scan"
        );
        let many = PointCloud {
            views: vec![view("a"); 65_536],
            ..cloud(1.0, &["a"])
        };
        assert_eq!(
            PointCloud::merge(&[many, cloud(1.0, &["a"])])
                .unwrap_err()
                .to_string(),
            "point cloud: 65537 views, expected at most 65536 views; build the cloud from one scan"
        );
    }

    #[test]
    fn a_cloud_is_moved_bounded_and_cut() {
        let cloud = PointCloud {
            frame: Frame::Sensor,
            positions: vec![
                DVec3::new(1.0, 5.0, -2.0),
                DVec3::new(3.0, -1.0, 0.0),
                DVec3::new(f64::NAN, 0.0, 0.0),
            ],
            origins: (0..3)
                .map(|column| Origin {
                    view: 0,
                    column,
                    profile: 0,
                })
                .collect(),
            views: vec![View {
                device: "a".into(),
                towards_sensor: DVec3::X,
            }],
        };
        let (finite, finding) = cloud.remove_non_finite();
        assert_eq!(
            finding.as_deref(),
            Some("1 of 3 points were not finite and were left out")
        );
        assert_eq!(finite.origins.len(), 2);
        assert_eq!(
            finite.bounds(),
            Some((DVec3::new(1.0, -1.0, -2.0), DVec3::new(3.0, 5.0, 0.0)))
        );
        assert_eq!(
            PointCloud::from_positions(Frame::Part, vec![]).bounds(),
            None
        );

        let quarter = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let moved = finite.map(Frame::Machine, |p| quarter * p + DVec3::Z, |d| quarter * d);
        assert_eq!(moved.frame, Frame::Machine);
        assert!(
            (moved.positions[0] - DVec3::new(-5.0, 1.0, -1.0)).length() < 1e-14,
            "rounding of one rotation"
        );
        assert!(
            (moved.views[0].towards_sensor - DVec3::Y).length() < 1e-15,
            "rounding of one rotation"
        );

        let cut = finite.subset(&[1, 1, 0]);
        assert_eq!(cut.positions[2], finite.positions[0]);
        assert_eq!(
            cut.origins.iter().map(|o| o.column).collect::<Vec<_>>(),
            [1, 1, 0]
        );
        assert_eq!(
            cut.duplicates_finding().as_deref(),
            Some("1 of 3 points lie exactly on an earlier point")
        );
    }
}
