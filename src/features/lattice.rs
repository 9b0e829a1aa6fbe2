//! What the lattice of a profiler, where it is known, says of depth jumps: neighbours along a laser line that no surface joins.
//!
//! Behind a depth jump lies an occlusion shadow, and the last points before it are borders of what was seen, not edges. A spot that falls on
//! both sides of a jump gives a point between them, on neither: a mixed point.

use rayon::prelude::*;

use crate::points::{Origin, PointCloud};

/// What a point is to its neighbours along the laser line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// Joined to both.
    Inside,
    /// Joined to one: the last before a jump, a gap or the end of the line.
    Border,
    /// Joined to none: a mixed point or an outlier.
    Stray,
}

/// Steeper than this, depth over width, no surface returns light enough to be measured: 80 degrees from the line of sight.
const GRAZING: f64 = 5.67;
/// Usual steps from column to column that are still no gap.
const GAP: u16 = 4;

/// The place of every point of `cloud`, in input order; none where no lattice is known.
///
/// `noise_mm` is the standard deviation of the points: a step within six of that of a difference is none.
pub(super) fn places(cloud: &PointCloud, noise_mm: f64) -> Option<Vec<Place>> {
    if cloud.origins.is_empty() || cloud.check_lattice().is_err() {
        return None;
    }
    let mut order: Vec<u32> = (0..cloud.len() as u32).collect();
    let key = |i: &u32| {
        let Origin {
            view,
            profile,
            column,
        } = cloud.origins[*i as usize];
        (view, profile, column, *i)
    };
    order.par_sort_unstable_by_key(key);
    let columns = |a: u32, b: u32| {
        let (from, to) = (cloud.origins[a as usize], cloud.origins[b as usize]);
        let same_line = (from.view, from.profile) == (to.view, to.profile);
        same_line.then(|| to.column - from.column)
    };
    let mut steps: Vec<u16> = order
        .windows(2)
        .filter_map(|w| columns(w[0], w[1]))
        .collect();
    if steps.is_empty() {
        return None;
    }
    let middle = steps.len() / 2;
    let usual = *steps.select_nth_unstable(middle).1;
    let joined = |a: u32, b: u32| {
        if columns(a, b).is_none_or(|c| c > usual.saturating_mul(GAP)) {
            return false;
        }
        let from = cloud.origins[a as usize];
        let sight = cloud.views[usize::from(from.view)].towards_sensor;
        let step = cloud.positions[b as usize] - cloud.positions[a as usize];
        let depth = step.dot(sight).abs();
        let width = (step - sight * step.dot(sight)).length();
        depth <= GRAZING * width || depth <= 6.0 * std::f64::consts::SQRT_2 * noise_mm
    };
    let links: Vec<bool> = order.par_windows(2).map(|w| joined(w[0], w[1])).collect();
    let mut places = vec![Place::Stray; cloud.len()];
    for (at, i) in order.iter().enumerate() {
        let before = at > 0 && links[at - 1];
        let after = links.get(at).is_some_and(|l| *l);
        places[*i as usize] = match (before, after) {
            (true, true) => Place::Inside,
            (false, false) => Place::Stray,
            _ => Place::Border,
        };
    }
    Some(places)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::points::{Frame, View};

    #[test]
    fn a_step_leaves_borders_and_the_point_halfway_down_is_a_stray() {
        // Looking down on a step of 5 mm between the columns 4 and 6; column 5 saw both; columns 10 to 19 saw nothing.
        let heights = (0..25u16).filter(|c| !(10..20).contains(c)).map(|c| {
            let z = match c {
                0..=4 => 5.0,
                5 => 2.2,
                _ => 0.0,
            };
            (c, DVec3::new(0.1 * f64::from(c), 0.0, z))
        });
        let (columns, positions): (Vec<u16>, Vec<DVec3>) = heights.unzip();
        let origins = columns.iter().map(|column| Origin {
            view: 0,
            profile: 3,
            column: *column,
        });
        let cloud = PointCloud {
            frame: Frame::Machine,
            origins: origins.collect(),
            positions,
            views: vec![View {
                device: "top".into(),
                towards_sensor: DVec3::Z,
            }],
        };
        let found = places(&cloud, 0.01).unwrap();
        let at = |column: u16| found[columns.iter().position(|c| *c == column).unwrap()];
        for column in [0, 4, 6, 9, 20, 24] {
            assert_eq!(at(column), Place::Border, "column {column}");
        }
        assert_eq!(at(5), Place::Stray);
        for column in [1, 2, 3, 7, 8, 21, 22, 23] {
            assert_eq!(at(column), Place::Inside, "column {column}");
        }
        let bare = PointCloud::from_positions(Frame::Machine, cloud.positions);
        assert_eq!(places(&bare, 0.01), None);
    }
}
