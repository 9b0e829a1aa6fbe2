//! Gauss-map clustering as Weber's thesis has it, with one sensitivity for all points or a local one, to repeat its experiments.
//!
//! Sections are those of Weber 2011. Where the thesis leaves something open, what reproduces its Table 1 was taken, and is said so.

use std::f64::consts::FRAC_PI_2;

use glam::DVec3;
use rayon::prelude::*;

use super::Class;
use crate::points::moments::eigen;
use crate::points::{Neighbors, PointCloud};

mod linkage;

use linkage::{Lines, Linkage};

/// Neighbours of a point: 16 performs best (§3.5.1).
const NEIGHBOURS: usize = 16;
/// Fewest and most neighbours: 8 and 32 "were kind of lower and upper bounds" (§3.5.1).
const NEIGHBOURS_FROM_TO: (usize, usize) = (8, 32);
/// Sensitivity, rad, of the global method: a mean value of 0.6 detects all features of the planes and all of the cube (§3.5.2, §3.7.3).
const SENSITIVITY_RAD: f64 = 0.6;
/// Largest sensitivity, rad (§3.4.3: σ from 0 to pi / 2).
const SENSITIVITY_MAX_RAD: f64 = FRAC_PI_2;
/// Deviation of the normals below which a neighbourhood is flat: 15 percent of a right angle, "about 13°" (§3.4.3).
const FLATNESS_RAD: f64 = 0.15 * FRAC_PI_2;
/// Numbers of clusters that make a feature (§3.4.3).
const CLUSTERS: std::ops::RangeInclusive<usize> = 2..=4;
/// Share of the triangles that a cluster needs not to be noise.
///
/// The thesis discards clusters "containing only a few points" (§3.4.3) and says no number. At 10 percent its Table 1 comes out within one
/// percent of what is printed; at 5 percent 149 of the 256 points of the planes are left, for regular neighbourhoods have many equal
/// triangles across an edge; from 15 percent on there is none of the outliers that the thesis has.
const FEW: f64 = 0.1;
/// Neighbours the local-adaptive method begins with (§3.7.4).
const NEIGHBOURS_FIRST: usize = 20;
/// Sensitivity, rad, the local-adaptive method begins with (§3.7.4).
const SENSITIVITY_FIRST_RAD: f64 = 0.1;
/// Factor on the sensitivity at each step (§3.6: raised by 10 percent).
const RAISE: f64 = 1.1;
/// Share of features in a neighbourhood from which on it is crowded (§3.6: 30 percent).
const CROWDED: f64 = 0.3;
/// Largest sensitivity, rad, of the local-adaptive method (§3.6).
const SENSITIVITY_LAST_RAD: f64 = 1.2;
/// Fewest neighbours of the local-adaptive method (§3.6).
const NEIGHBOURS_LAST: usize = 8;
/// A feature with so many fellows in its neighbourhood, or fewer, is an outlier (§3.6: "only one or no other").
const LONELY: usize = 1;
/// Steps at most: one bit of a word each. §3.6 names a largest number of steps and gives none; no settings here need more than 24.
const STEPS: usize = 64;
/// Sine of the smallest angle at the point of a triangle that has a normal.
///
/// We differ: points on one line, of which every regular sample is full, span no triangle; rounding would give them any normal.
const SLIVER: f64 = 1e-6;
/// Steps towards the median direction at most.
const MEDIAN_STEPS: usize = 8;

/// The constants of the thesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Neighbours of a point, 8 to 32.
    pub neighbours: usize,
    /// Distance, rad, at which clusters are no longer merged, 0 to pi / 2 (§3.5.2).
    pub sensitivity_rad: f64,
    /// Deviation, rad, of the normals from their median direction below which a neighbourhood is flat (§3.4.3).
    pub flatness_rad: f64,
    /// Makes neighbourhood and sensitivity local (§3.6).
    pub adaptation: Option<Adaptation>,
}

/// The iteration of §3.6.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adaptation {
    /// Factor on the sensitivity at each step.
    pub raise: f64,
    /// Share of features in a neighbourhood below which it ends.
    pub share: f64,
    /// Largest sensitivity, rad.
    pub most_sensitivity_rad: f64,
    /// Fewest neighbours.
    pub fewest_neighbours: usize,
}

impl Settings {
    /// The global method (§3.4, §3.5).
    pub fn global() -> Self {
        Self {
            neighbours: NEIGHBOURS,
            sensitivity_rad: SENSITIVITY_RAD,
            flatness_rad: FLATNESS_RAD,
            adaptation: None,
        }
    }

    /// The local-adaptive method (§3.6, §3.7.4).
    pub fn local_adaptive() -> Self {
        Self {
            neighbours: NEIGHBOURS_FIRST,
            sensitivity_rad: SENSITIVITY_FIRST_RAD,
            adaptation: Some(Adaptation {
                raise: RAISE,
                share: CROWDED,
                most_sensitivity_rad: SENSITIVITY_LAST_RAD,
                fewest_neighbours: NEIGHBOURS_LAST,
            }),
            ..Self::global()
        }
    }
}

impl Adaptation {
    /// Neighbours and sensitivity (rad) of each step after the first, until one of them reaches its end.
    ///
    /// The thesis lets the end be chosen among the largest sensitivity, the fewest neighbours and a number of steps. Its own constants
    /// come to 8 neighbours after twelve steps, at a sensitivity of 0.31; going on from there with 8 neighbours to 1.2 loses the corners
    /// of cubes.
    fn steps(&self, settings: &Settings) -> Vec<(usize, f64)> {
        let (mut count, mut sensitivity_rad) = (settings.neighbours, settings.sensitivity_rad);
        let mut steps = Vec::new();
        while steps.len() < STEPS
            && count > self.fewest_neighbours
            && sensitivity_rad < self.most_sensitivity_rad
        {
            count -= 1;
            sensitivity_rad *= self.raise;
            steps.push((count, sensitivity_rad.min(self.most_sensitivity_rad)));
        }
        steps
    }
}

/// The classes of N points, [`Class::Edge`] or [`Class::None`], in input order.
///
/// Neither the order of the points nor the number of threads changes them.
pub fn detect_as_in_thesis(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    settings: &Settings,
) -> Vec<Class> {
    let (few, many) = NEIGHBOURS_FROM_TO;
    let settings = Settings {
        neighbours: settings.neighbours.clamp(few, many),
        sensitivity_rad: settings.sensitivity_rad.min(SENSITIVITY_MAX_RAD),
        ..*settings
    };
    let hoods = Hoods { cloud, neighbors };
    let candidates = hoods.candidates(&settings);
    let features = match &settings.adaptation {
        None => candidates,
        Some(adaptation) => hoods.adapt(candidates, &settings, adaptation),
    };
    let mut classes = vec![Class::None; cloud.positions.len()];
    for rank in features {
        for i in neighbors.points_at(rank as usize) {
            classes[*i as usize] = Class::Edge;
        }
    }
    classes
}

/// The neighbourhoods of the places of a cloud; places go by their rank in [`Neighbors::places`].
struct Hoods<'a> {
    cloud: &'a PointCloud,
    neighbors: &'a Neighbors,
}

impl Hoods<'_> {
    fn position(&self, rank: u32) -> DVec3 {
        self.cloud.positions[self.neighbors.places()[rank as usize] as usize]
    }

    /// The `count` places nearest to `rank`, itself left out, nearest first.
    fn around(&self, rank: u32, count: usize, scratch: &mut Scratch) {
        let found = &mut scratch.found;
        let p = self.position(rank);
        self.neighbors.nearest_places(p, count + 1, found);
        found.retain(|f| f.0 != rank);
        scratch.arms.clear();
        let arms = found.iter().map(|f| self.position(f.0) - p);
        scratch.arms.extend(arms);
    }

    /// The ranks, ascending, of places whose neighbourhood is not flat and has as many clusters as a feature.
    fn candidates(&self, settings: &Settings) -> Vec<u32> {
        (0..self.neighbors.places().len() as u32)
            .into_par_iter()
            .map_init(Scratch::default, |scratch, rank| {
                self.around(rank, settings.neighbours, scratch);
                scratch.map(settings.neighbours);
                let feature = !scratch.is_flat(settings.flatness_rad) && {
                    scratch.linkage.start(&scratch.normals);
                    scratch.is_feature(settings.sensitivity_rad)
                };
                feature.then_some(rank)
            })
            .flatten_iter()
            .collect()
    }

    /// Those of the candidates that remain when crowded neighbourhoods have been thinned, less the lonely ones (§3.6).
    ///
    /// What the test of a candidate says depends on the step alone and not on whose neighbourhood is being thinned: sensitivity and number
    /// of neighbours start from the same values for each. So all tests are made beforehand, in parallel, and only the thinning itself goes
    /// from candidate to candidate. That it is done in the order of [`Neighbors::places`], which the points' places alone decide, and in
    /// one thread, makes the result independent of the order of the points and of the number of threads.
    ///
    /// The outer loop of the pseudo-code needs one pass: a neighbourhood still crowded after it has only features that passed every step.
    fn adapt(
        &self,
        candidates: Vec<u32>,
        settings: &Settings,
        adaptation: &Adaptation,
    ) -> Vec<u32> {
        let width = settings.neighbours;
        let mut index = vec![u32::MAX; self.neighbors.places().len()];
        for (i, rank) in candidates.iter().enumerate() {
            index[*rank as usize] = i as u32;
        }
        let steps = adaptation.steps(settings);
        // Of each candidate, the candidates around it with how near they come, and the steps it passes.
        let mut around = vec![u32::MAX; candidates.len() * width];
        let passed: Vec<u64> = around
            .par_chunks_mut(width)
            .zip(&candidates)
            .map_init(Scratch::default, |scratch, (row, rank)| {
                self.around(*rank, width, scratch);
                for (slot, found) in row.iter_mut().zip(&scratch.found) {
                    *slot = index[found.0 as usize];
                }
                scratch.passed(&steps)
            })
            .collect();
        let mut features = vec![true; candidates.len()];
        for (candidate, row) in around.chunks_exact(width).enumerate() {
            if !features[candidate] {
                continue;
            }
            for step in 0..steps.len() {
                let inside = row.iter().filter(|i| is_in(&features, **i)).count();
                if (inside as f64) < adaptation.share * width as f64 {
                    break;
                }
                for i in row.iter().copied().chain([candidate as u32]) {
                    if is_in(&features, i) {
                        features[i as usize] = passed[i as usize] >> step & 1 == 1;
                    }
                }
            }
        }
        (candidates
            .iter()
            .zip(around.chunks_exact(width))
            .enumerate())
        .filter(|(i, (_, row))| {
            let fellows = row.iter().filter(|j| is_in(&features, **j)).count();
            features[*i] && fellows > LONELY
        })
        .map(|(_, (rank, _))| *rank)
        .collect()
    }
}

/// Whether `i` is one of the candidates and still a feature.
fn is_in(features: &[bool], i: u32) -> bool {
    features.get(i as usize).is_some_and(|f| *f)
}

/// What one thread needs to judge one place after the other.
#[derive(Default)]
struct Scratch {
    found: Vec<(u32, f64)>,
    /// From the place to its neighbours, nearest first, mm.
    arms: Vec<DVec3>,
    /// The discrete Gauss map (§3.4.3): unoriented normals of all triangles of the place with two of its neighbours.
    normals: Lines,
    angles: Vec<f32>,
    linkage: Linkage,
}

impl Scratch {
    /// Maps the triangles with the `count` nearest neighbours.
    ///
    /// Each two neighbours give one normal: that of the other orientation is the same line (§3.4.3: opposite clusters count as one).
    fn map(&mut self, count: usize) {
        self.normals.clear();
        let arms = &self.arms[..self.arms.len().min(count)];
        for (i, a) in arms.iter().enumerate() {
            for b in &arms[i + 1..] {
                let n = a.cross(*b);
                let square = n.length_squared();
                if square > SLIVER * SLIVER * a.length_squared() * b.length_squared() {
                    self.normals.push(n / square.sqrt());
                }
            }
        }
    }

    /// Whether the normals deviate from their median direction by less than `flatness_rad` (§3.4.3).
    ///
    /// We differ: the deviation is the mean of the angles, not the root of the mean of their squares, which a few slivers rule: three
    /// points in a row around the wall of a hole span a triangle across it. By the standard deviation the local-adaptive method has 526 false
    /// features on the cloud of Table 2 without noise, by the mean 23 and in the thesis none. What it costs is that edges of 170° are flat.
    ///
    /// The median direction is the one with the least sum of angles. No neighbourhood is less flat about it than about the axis of the
    /// normals, which comes cheaper and is tried first.
    fn is_flat(&mut self, flatness_rad: f64) -> bool {
        self.angles.clear();
        self.angles.resize(self.normals.len(), 0.0);
        let mut direction = self.axis(|_| 1.0);
        for _ in 0..MEDIAN_STEPS {
            if self.deviation(direction) < flatness_rad {
                return true;
            }
            // Weights that make the sum of squared sines the sum of angles.
            direction = self.axis(|angle| angle / angle.sin().powi(2).max(1e-9));
        }
        self.deviation(direction) < flatness_rad
    }

    /// The direction with the least sum of weighted squared sines to the normals; weights from `angles`.
    fn axis(&self, weight: impl Fn(f64) -> f64) -> DVec3 {
        let mut m = [[0.0; 3]; 3];
        for (i, angle) in self.angles.iter().enumerate() {
            let n = self.normals.get(i);
            let weighted = n * weight(f64::from(*angle));
            let (n, weighted) = (n.to_array(), weighted.to_array());
            for i in 0..3 {
                for j in 0..=i {
                    m[i][j] += weighted[i] * n[j];
                }
            }
        }
        m[0][1] = m[1][0];
        m[0][2] = m[2][0];
        m[1][2] = m[2][1];
        eigen(m).1[0]
    }

    /// Mean, rad, of the angles of the normals to `direction`, which are left in `angles`; zero without normals.
    fn deviation(&mut self, direction: DVec3) -> f64 {
        self.normals.angles(direction, 0, &mut self.angles);
        let sum: f32 = self.angles.iter().sum();
        f64::from(sum) / self.angles.len().max(1) as f64
    }

    /// Whether the clusters left at `sensitivity_rad` (rad) that are more than noise are as many as a feature has.
    fn is_feature(&mut self, sensitivity_rad: f64) -> bool {
        self.linkage.merge_until(sensitivity_rad as f32);
        let few = FEW * self.normals.len() as f64;
        let clusters = self.linkage.sizes().iter();
        CLUSTERS.contains(&clusters.filter(|s| f64::from(**s) >= few).count())
    }

    /// The steps, one bit each, at which the place is a feature. Steps of the same neighbourhood go on with its clusters.
    fn passed(&mut self, steps: &[(usize, f64)]) -> u64 {
        let mut mapped = None;
        let mut passed = 0;
        for (step, (count, sensitivity)) in steps.iter().enumerate() {
            if mapped != Some(count) {
                mapped = Some(count);
                self.map(*count);
                self.linkage.start(&self.normals);
            }
            passed |= u64::from(self.is_feature(*sensitivity)) << step;
        }
        passed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Judges a place from the arms to its neighbours.
    fn at(arms: impl IntoIterator<Item = DVec3>) -> Scratch {
        let mut scratch = Scratch {
            arms: arms.into_iter().collect(),
            ..Scratch::default()
        };
        scratch.map(scratch.arms.len());
        scratch
    }

    /// Neighbours up to `reach` steps away in rows, bent by `bend`, the place itself left out.
    fn rows(reach: i32, bend: impl Fn(f64, f64) -> DVec3) -> Vec<DVec3> {
        (-reach..=reach)
            .flat_map(|i| (-reach..=reach).map(move |j| (f64::from(i), f64::from(j))))
            .filter(|at| *at != (0.0, 0.0))
            .map(|(x, y)| bend(x, y))
            .collect()
    }

    /// A place on an edge that turns by `turn` rad.
    fn edge(turn: f64) -> Scratch {
        let (sin, cos) = turn.sin_cos();
        at(rows(2, |x, y| {
            if x > 0.0 {
                DVec3::new(x * cos, y, x * sin)
            } else {
                DVec3::new(x, y, 0.0)
            }
        }))
    }

    fn is_feature(scratch: &mut Scratch, sensitivity_rad: f64) -> bool {
        scratch.linkage.start(&scratch.normals);
        scratch.is_feature(sensitivity_rad)
    }

    #[test]
    fn planes_and_gentle_curves_are_flat_and_edges_are_not() {
        assert!(at(rows(2, |x, y| DVec3::new(x, y, 0.0))).is_flat(1e-6));
        // A ball of 40 steps, whose normals turn by 2/40 rad at the end of the neighbourhood, and slivers by more.
        let ball =
            |r: f64| move |x: f64, y: f64| DVec3::new(x, y, r - (r * r - x * x - y * y).sqrt());
        assert!(at(rows(2, ball(40.0))).is_flat(FLATNESS_RAD));
        assert!(!at(rows(2, ball(3.0))).is_flat(FLATNESS_RAD));
        for degrees in [45f64, 90.0, 135.0] {
            assert!(
                !edge(degrees.to_radians()).is_flat(FLATNESS_RAD),
                "{degrees}"
            );
        }
        // Of an edge that turns by 6 degrees, a hundred and seventy four, every normal is nearly that of both planes.
        assert!(edge(6f64.to_radians()).is_flat(FLATNESS_RAD));
    }

    #[test]
    fn the_deviation_is_the_mean_angle_to_the_median_direction() {
        let turned = |angle: f64| DVec3::new(angle.sin(), 0.0, angle.cos());
        let turn = 40f64.to_radians();
        // Thirty one way and ten another: the median is the thirty's own, and the mean angle to it a quarter of what is between.
        for (many, few, share) in [(30, 10, 0.25), (20, 20, 0.5)] {
            let mut scratch = Scratch::default();
            for i in 0..many + few {
                let n = turned(if i < many { 0.0 } else { turn });
                scratch.normals.push(if i % 2 == 0 { n } else { -n });
            }
            // The steps towards the median end within 2 percent of it.
            assert!(scratch.is_flat(1.02 * share * turn));
            assert!(!scratch.is_flat(0.98 * share * turn));
        }
    }

    #[test]
    fn an_edge_has_two_clusters_a_corner_three_a_plane_one() {
        for degrees in [60f64, 90.0, 120.0] {
            assert!(
                is_feature(&mut edge(degrees.to_radians()), 0.3),
                "{degrees}"
            );
        }
        let mut corner = Vec::new();
        for i in 0..3 {
            for j in 0..3 {
                let (a, b) = (f64::from(i), f64::from(j));
                corner.extend([
                    DVec3::new(a, b, 0.0),
                    DVec3::new(0.0, a, b),
                    DVec3::new(b, 0.0, a),
                ]);
            }
        }
        corner.retain(|p| *p != DVec3::ZERO);
        corner.sort_by(|a, b| a.to_array().partial_cmp(&b.to_array()).unwrap());
        corner.dedup();
        assert_eq!(corner.len(), 18);
        let mut corner = at(corner);
        assert!(is_feature(&mut corner, 0.3));
        let large = |s: &&u32| f64::from(**s) >= FEW * corner.normals.len() as f64;
        assert_eq!(corner.linkage.sizes().iter().filter(large).count(), 3);
        assert!(!is_feature(
            &mut at(rows(2, |x, y| DVec3::new(x, y, 0.0))),
            0.3
        ));
    }

    #[test]
    fn neighbours_in_one_line_have_no_normals_and_are_flat() {
        let mut line = at((1..9).map(|i| DVec3::new(1.0, 0.1, 0.3) * f64::from(i)));
        assert_eq!(line.normals.len(), 0);
        assert!(line.is_flat(FLATNESS_RAD));
        assert!(!is_feature(&mut line, 0.3));
    }

    #[test]
    fn the_steps_of_the_thesis_end_at_eight_neighbours() {
        let settings = Settings::local_adaptive();
        let steps = settings.adaptation.unwrap().steps(&settings);
        assert_eq!(steps.len(), 12);
        assert_eq!(steps[0], (19, 0.1 * 1.1));
        let last = steps[11];
        assert!(last.0 == 8 && (last.1 - 0.1 * 1.1f64.powi(12)).abs() < 1e-12);
    }

    #[test]
    fn lonely_candidates_go_and_crowded_ones_are_tested_again() {
        let points: Vec<DVec3> = (0..1_600)
            .map(|i| DVec3::new(f64::from(i % 40), f64::from(i / 40), 0.0))
            .collect();
        let cloud = PointCloud::from_positions(crate::points::Frame::Part, points);
        let neighbors = Neighbors::new(&cloud.positions);
        let hoods = Hoods {
            cloud: &cloud,
            neighbors: &neighbors,
        };
        // Three in a row, a pair, one alone; and a block of nine, which a plane does not have.
        let three = [(5, 5), (6, 5), (7, 5)];
        let mut named = vec![(5, 20), (6, 20), (20, 5)];
        named.extend((0..9).map(|i| (20 + i % 3, 20 + i / 3)));
        named.extend(three);
        let is_named = |rank: &u32| {
            let p = hoods.position(*rank);
            named.contains(&(p.x as i32, p.y as i32))
        };
        let candidates: Vec<u32> = (0..1_600).filter(is_named).collect();
        assert_eq!(candidates.len(), 15);
        let settings = Settings::local_adaptive();
        let kept = hoods.adapt(candidates, &settings, &settings.adaptation.unwrap());
        let mut kept: Vec<(i32, i32)> = (kept.iter().map(|rank| hoods.position(*rank)))
            .map(|p| (p.x as i32, p.y as i32))
            .collect();
        kept.sort_unstable();
        assert_eq!(kept, three);
    }
}
