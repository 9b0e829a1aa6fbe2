//! Spacing, noise, outliers and corners of a single profile: a curve in the plane of the laser.
//!
//! The points come in the order of the sensor's columns; lost columns are simply absent. Everything is derived from the
//! profile itself: lengths from its spacing, thresholds from its noise.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix4, SymmetricEigen, Vector4};

/// What a single profile of N points tells about itself.
#[derive(Debug, Clone, PartialEq)]
pub struct ProfileAnalysis {
    /// Median distance from point to point along the curve, mm.
    pub spacing_mm: f64,
    /// Standard deviation of the points across the curve, mm, robust against outliers.
    pub noise_mm: f64,
    /// Indices of points that lie on neither side's continuation, rising.
    pub outliers: Vec<usize>,
    /// Indices of the last points before a gap or a step, rising; outliers are passed over.
    pub breaks: Vec<usize>,
    /// Places where the curve turns sharply, in the profile's order.
    pub corners: Vec<ProfileCorner>,
}

/// A place where two straight pieces of a profile meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfileCorner {
    /// Where the two lines meet, which no measured point need do.
    pub position: DVec3,
    /// Angle between the directions of the two lines, 0 (smooth) to pi.
    pub turn_angle_rad: f64,
    /// Standard uncertainty of the position along its least certain direction, from the noise, mm.
    pub position_sigma_mm: f64,
    /// Standard uncertainty of the angle, from the noise.
    pub turn_angle_sigma_rad: f64,
    /// Largest index of a point before the corner.
    pub before: usize,
}

/// Fewest points that can be analysed: a line needs some on both sides.
const FEWEST: usize = 2 * SHORTEST_FLANK + 1;
/// Fewest points of one of the two lines.
const SHORTEST_FLANK: usize = 6;
/// Most points of one of the two lines: beyond it, a scan is too noisy for the smallest turn.
const LONGEST_FLANK: usize = 200;
/// Points on either side of a point in whose line its noise is measured: few enough for any curvature that a profiler resolves.
const NOISE_REACH: usize = 8;
/// Points beside a point that say whether it is an outlier.
const OUTLIER_REACH: usize = 10;
/// Standard deviations beyond which chance is ruled out, for a million points still.
const SURE: f64 = 6.0;
/// An extrapolated robust line adds to the noise of a point: factor on [`SURE`] (variance 1 + 0.47 for the line by least
/// squares over ten points, 1.6 times that for one by medians).
const EXTRAPOLATION: f64 = 1.35;
/// Smallest turn that is called sharp, rad (10 degrees): the flanks are made as long as the noise needs to see it.
const SMALLEST_TURN: f64 = 10.0 * std::f64::consts::PI / 180.0;
/// A distance of this many spacings is a gap.
const GAP: f64 = 5.0;
/// Standard deviation of a normal distribution over its median absolute deviation.
const SIGMA_PER_MAD: f64 = 1.4826;

/// What `profile`, N points in the order of the sensor's columns, tells about itself; nothing is found in fewer than 13.
///
/// Corners are where two straight pieces describe the points better than one cubic curve does by the F statistic, where they
/// turn by more than 10 degrees and six standard deviations, and where they meet between the points on either side.
/// A step or gap is a break and no corner: what lies in it was not seen.
pub fn analyse(profile: &[DVec3]) -> ProfileAnalysis {
    let mut analysis = ProfileAnalysis {
        spacing_mm: 0.0,
        noise_mm: 0.0,
        outliers: Vec::new(),
        breaks: Vec::new(),
        corners: Vec::new(),
    };
    if profile.len() < FEWEST || profile.iter().any(|p| !p.is_finite()) {
        return analysis;
    }
    let plane = Plane::of(profile);
    let points: Vec<DVec2> = profile.iter().map(|&p| plane.flat(p)).collect();
    analysis.spacing_mm = spacing(&points);
    let is_outlier = outliers(&points, noise(&points), analysis.spacing_mm);
    analysis.outliers = (0..points.len()).filter(|&i| is_outlier[i]).collect();
    let kept: Vec<usize> = (0..points.len()).filter(|&i| !is_outlier[i]).collect();
    let points: Vec<DVec2> = kept.iter().map(|&i| points[i]).collect();
    if points.len() < FEWEST {
        return analysis;
    }
    analysis.noise_mm = noise(&points);
    let curve = Curve {
        points,
        spacing_mm: analysis.spacing_mm,
        // Drawn profiles have no noise but that of rounding.
        noise_mm: analysis.noise_mm.max(1e-6 * analysis.spacing_mm),
    };
    let mut start = 0;
    for run in curve.runs() {
        start += run;
        if start < kept.len() {
            analysis.breaks.push(kept[start - 1]);
        }
        for corner in curve.corners(start - run..start) {
            analysis.corners.push(ProfileCorner {
                position: plane.solid(corner.position),
                turn_angle_rad: corner.turn_rad,
                position_sigma_mm: corner.position_sigma_mm,
                turn_angle_sigma_rad: corner.turn_sigma_rad,
                before: kept[corner.before],
            });
        }
    }
    analysis
}

/// The plane of the laser: the points' principal plane.
struct Plane {
    origin: DVec3,
    /// Columns: along the profile, across it, normal to the plane.
    axes: DMat3,
}

impl Plane {
    fn of(points: &[DVec3]) -> Self {
        let origin = points.iter().sum::<DVec3>() / points.len() as f64;
        let mut moments = Matrix3::zeros();
        for p in points {
            let d = nalgebra::Vector3::from((*p - origin).to_array());
            moments += d * d.transpose();
        }
        let eigen = SymmetricEigen::new(moments);
        let axis = |i: usize| DVec3::from_array(eigen.eigenvectors.column(i).into_owned().into());
        let (low, high) = (eigen.eigenvalues.imin(), eigen.eigenvalues.imax());
        let along = if high == low { DVec3::X } else { axis(high) };
        let normal = if high == low { DVec3::Z } else { axis(low) };
        Self {
            origin,
            axes: DMat3::from_cols(along, normal.cross(along), normal),
        }
    }

    fn flat(&self, p: DVec3) -> DVec2 {
        let d = p - self.origin;
        DVec2::new(d.dot(self.axes.x_axis), d.dot(self.axes.y_axis))
    }

    fn solid(&self, p: DVec2) -> DVec3 {
        self.origin + self.axes.x_axis * p.x + self.axes.y_axis * p.y
    }
}

fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Median chord over eight steps, by step: noise lengthens one step, but hardly eight.
fn spacing(points: &[DVec2]) -> f64 {
    let steps = NOISE_REACH.min(points.len() - 1);
    let mut chords: Vec<f64> = points
        .windows(steps + 1)
        .map(|w| w[steps].distance(w[0]) / steps as f64)
        .collect();
    median(&mut chords)
}

/// Spread of the points across parabolas through their neighbours.
fn noise(points: &[DVec2]) -> f64 {
    let reach = NOISE_REACH.min((points.len() - 1) / 2);
    // Least squares of a + b j + c j^2 over j = -reach..-1, 1..reach: weights of the neighbours in a.
    let (mut squares, mut fourths) = (0.0, 0.0);
    for j in 1..=reach {
        let square = (j * j) as f64;
        squares += 2.0 * square;
        fourths += 2.0 * square * square;
    }
    let determinant = 2.0 * reach as f64 * fourths - squares * squares;
    let weight = |j: usize| (fourths - squares * (j * j) as f64) / determinant;
    let mut residuals: Vec<f64> = (reach..points.len() - reach)
        .map(|i| {
            let neighbours = points[i - reach..i]
                .iter()
                .chain(&points[i + 1..=i + reach]);
            let line = Line::through(neighbours.copied());
            let expected: f64 = (1..=reach)
                .map(|j| weight(j) * (line.distance(points[i - j]) + line.distance(points[i + j])))
                .sum();
            (line.distance(points[i]) - expected).abs()
        })
        .collect();
    // The parabola is uncertain itself: in its middle by this share of a point's variance.
    let own = fourths / determinant;
    SIGMA_PER_MAD * median(&mut residuals) / (1.0 + own).sqrt()
}

/// A straight line by total least squares.
#[derive(Debug, Clone, Copy)]
struct Line {
    centre: DVec2,
    /// Unit vector, in the order of the points.
    along: DVec2,
    count: f64,
    /// Sum of squares along the line about the centre, mm^2.
    squares_along: f64,
    /// Sum of squares across it, mm^2.
    squares_across: f64,
}

impl Line {
    fn through(points: impl Iterator<Item = DVec2> + Clone) -> Self {
        let (sum, count) = points
            .clone()
            .fold((DVec2::ZERO, 0.0), |(s, n), p| (s + p, n + 1.0));
        let centre = sum / count;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        let (mut first, mut last) = (None, centre);
        for p in points {
            let d = p - centre;
            xx += d.x * d.x;
            xy += d.x * d.y;
            yy += d.y * d.y;
            first.get_or_insert(p);
            last = p;
        }
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let along = DVec2::from_angle(angle);
        let travel = last - first.unwrap_or(centre);
        let half_difference = (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        Self {
            centre,
            along: if along.dot(travel) < 0.0 {
                -along
            } else {
                along
            },
            count,
            squares_along: 0.5 * (xx + yy) + half_difference,
            squares_across: (0.5 * (xx + yy) - half_difference).max(0.0),
        }
    }

    /// Signed distance, plus to the left.
    fn distance(&self, p: DVec2) -> f64 {
        self.along.perp_dot(p - self.centre)
    }

    /// Variance of the line's offset at `p` and of its angle, for points of variance 1.
    fn variance(&self, p: DVec2) -> (f64, f64) {
        let lever = self.along.dot(p - self.centre);
        let angle = 1.0 / self.squares_along;
        (1.0 / self.count + lever * lever * angle, angle)
    }

    /// Where two lines meet, if they are not parallel.
    fn meet(&self, other: &Self) -> Option<DVec2> {
        let sine = self.along.perp_dot(other.along);
        let t = (other.centre - self.centre).perp_dot(other.along) / sine;
        (sine.abs() > 1e-6).then(|| self.centre + self.along * t)
    }
}

/// For each point whether it lies on the continuation of neither side, nor between the two.
///
/// What is nearer than a spacing harms no fit, and a curved piece departs from its continuation by no more.
fn outliers(points: &[DVec2], noise_mm: f64, spacing_mm: f64) -> Vec<bool> {
    let departs = |i: usize, from: usize, to: usize, factor: f64| {
        to - from < OUTLIER_REACH / 2
            || departure(&points[from..to], i as f64 - from as f64, points[i])
                > (factor * SURE * noise_mm).max(spacing_mm)
    };
    let half = OUTLIER_REACH / 2;
    (0..points.len())
        .map(|i| {
            let (before, after) = (
                i.saturating_sub(OUTLIER_REACH),
                points.len().min(i + 1 + OUTLIER_REACH),
            );
            departs(i, before, i, EXTRAPOLATION)
                && departs(i, i + 1, after, EXTRAPOLATION)
                && departs(
                    i,
                    i.saturating_sub(half),
                    points.len().min(i + 1 + half),
                    1.0,
                )
        })
        .collect()
}

/// Distance of `p`, at `index` of the window's count, from the line that the medians of the window's slopes give (Theil-Sen,
/// by coordinate over the index, so that any direction is as good as another).
fn departure(window: &[DVec2], index: f64, p: DVec2) -> f64 {
    const PAIRS: usize = (OUTLIER_REACH + 1) * OUTLIER_REACH / 2;
    let coordinate = |pick: fn(DVec2) -> f64| {
        let mut slopes = [0.0; PAIRS];
        let mut count = 0;
        for (j, b) in window.iter().enumerate() {
            for (i, a) in window[..j].iter().enumerate() {
                slopes[count] = (pick(*b) - pick(*a)) / (j - i) as f64;
                count += 1;
            }
        }
        let slope = median(&mut slopes[..count]);
        let mut levels = [0.0; OUTLIER_REACH + 1];
        for (j, q) in window.iter().enumerate() {
            levels[j] = pick(*q) + slope * (index - j as f64);
        }
        (slope, median(&mut levels[..window.len()]))
    };
    let (slope_x, x) = coordinate(|q| q.x);
    let (slope_y, y) = coordinate(|q| q.y);
    let along = DVec2::new(slope_x, slope_y).normalize_or_zero();
    let d = p - DVec2::new(x, y);
    if along == DVec2::ZERO {
        d.length()
    } else {
        along.perp_dot(d).abs()
    }
}

/// A profile without its outliers.
struct Curve {
    points: Vec<DVec2>,
    spacing_mm: f64,
    noise_mm: f64,
}

/// A corner in the plane.
#[derive(Debug, Clone, Copy)]
struct FlatCorner {
    before: usize,
    position: DVec2,
    turn_rad: f64,
    turn_sigma_rad: f64,
    position_sigma_mm: f64,
    /// How much better two lines are than one cubic curve, by the F statistic.
    gain: f64,
}

impl Curve {
    /// Lengths, in points, of the pieces between gaps and steps.
    fn runs(&self) -> Vec<usize> {
        let gap = (GAP * self.spacing_mm).max(SURE * std::f64::consts::SQRT_2 * self.noise_mm);
        let mut runs = Vec::new();
        let mut length = 1;
        for pair in self.points.windows(2) {
            if pair[1].distance(pair[0]) > gap {
                runs.push(length);
                length = 0;
            }
            length += 1;
        }
        runs.push(length);
        runs
    }

    /// Points of a line so long that the smallest turn shows.
    ///
    /// Two lines of n points each, turning by a, depart from the cubic that fits them best by the root mean square
    /// 0.072 n spacing tan(a/2) (the distance of |x| from the cubics over -1..1); 2n squares of that must make a gain of
    /// [`SURE`]^2 in units of the noise.
    fn flank(&self) -> usize {
        let departure = 0.072 * (SMALLEST_TURN / 2.0).tan() * self.spacing_mm;
        let ratio = SURE * self.noise_mm / departure.max(f64::MIN_POSITIVE);
        let length = (0.5 * ratio * ratio).cbrt().ceil();
        (length as usize).clamp(SHORTEST_FLANK + 2, LONGEST_FLANK)
    }

    /// The corners of one run: of candidates within a flank of one another the one with the largest gain.
    fn corners(&self, run: std::ops::Range<usize>) -> Vec<FlatCorner> {
        let flank = self.flank();
        let mut found: Vec<FlatCorner> = Vec::new();
        for before in run.clone() {
            let Some(corner) = self.corner(before, &run, flank) else {
                continue;
            };
            match found.last_mut() {
                Some(last) if before - last.before < flank => {
                    if corner.gain > last.gain {
                        *last = corner;
                    }
                }
                _ => found.push(corner),
            }
        }
        found
    }

    /// The corner between a point and the next one, if there is one.
    fn corner(
        &self,
        before: usize,
        run: &std::ops::Range<usize>,
        flank: usize,
    ) -> Option<FlatCorner> {
        let left = &self.points[run.start.max((before + 1).saturating_sub(flank))..=before];
        let right = &self.points[before + 1..run.end.min(before + 1 + flank)];
        // Where the run ends sooner, half a flank does.
        if left.len().min(right.len()) < (flank / 2).max(SHORTEST_FLANK) {
            return None;
        }
        let first = Line::through(left.iter().copied());
        let second = Line::through(right.iter().copied());
        let turn_rad = first.along.angle_to(second.along).abs();
        let position = first.meet(&second)?;
        if turn_rad < SMALLEST_TURN {
            return None;
        }
        let squares = first.squares_across + second.squares_across;
        let freedom = (left.len() + right.len() - 4) as f64;
        // Where the surface is rougher than the profile at large, its own scatter counts.
        let variance = (self.noise_mm * self.noise_mm).max(squares / freedom);
        let ((offset_1, angle_1), (offset_2, angle_2)) =
            (first.variance(position), second.variance(position));
        let turn_sigma_rad = (variance * (angle_1 + angle_2)).sqrt();
        let position_sigma_mm = least_certain(turn_rad, variance * offset_1, variance * offset_2);
        let ends = (self.points[before], self.points[before + 1]);
        let miss = distance_to_segment(position, ends);
        if turn_rad < SURE * turn_sigma_rad || miss > self.spacing_mm + SURE * position_sigma_mm {
            return None;
        }
        let smooth = cubic_squares((left, right), first.along + second.along)?;
        let gain = (smooth - squares) / variance.max(f64::MIN_POSITIVE);
        (gain > SURE * SURE).then_some(FlatCorner {
            before,
            position,
            turn_rad,
            turn_sigma_rad,
            position_sigma_mm,
            gain,
        })
    }
}

/// Standard deviation along the least certain direction of the point where two lines meet at an angle, from the variances
/// of their offsets: the square root of the larger eigenvalue of its covariance.
fn least_certain(turn_rad: f64, offset_1: f64, offset_2: f64) -> f64 {
    let (sine, cosine) = turn_rad.sin_cos();
    // In axes along and across the first line: across by its own offset, along by both.
    let along = (offset_2 + cosine * cosine * offset_1) / (sine * sine);
    let across = offset_1;
    let mixed = cosine / sine * offset_1;
    let half = 0.5 * (along - across);
    (0.5 * (along + across) + (half * half + mixed * mixed).sqrt()).sqrt()
}

fn distance_to_segment(p: DVec2, (a, b): (DVec2, DVec2)) -> f64 {
    let span = b - a;
    let squared = span.length_squared();
    let t = if squared > 0.0 {
        ((p - a).dot(span) / squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    p.distance(a + span * t)
}

/// Sum of squares, mm^2, about the cubic across `axis` that fits the points best; none where they double back.
fn cubic_squares((left, right): (&[DVec2], &[DVec2]), axis: DVec2) -> Option<f64> {
    let axis = axis.try_normalize()?;
    let (origin, end) = (*left.last()?, *right.last()?);
    let scale = axis
        .dot(end - origin)
        .abs()
        .max(axis.dot(origin - left[0]).abs());
    if scale == 0.0 {
        return None;
    }
    let mut normal = Matrix4::zeros();
    let mut sides = Vector4::zeros();
    let mut squares = 0.0;
    for p in left.iter().chain(right) {
        let d = *p - origin;
        let (u, v) = (axis.dot(d) / scale, axis.perp_dot(d));
        let row = Vector4::new(1.0, u, u * u, u * u * u);
        normal += row * row.transpose();
        sides += row * v;
        squares += v * v;
    }
    let coefficients = normal.cholesky()?.solve(&sides);
    Some((squares - coefficients.dot(&sides)).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Normal numbers by Box and Muller over a 64-bit congruential generator (Knuth's constants).
    struct Normal(u64);

    impl Normal {
        fn uniform(&mut self) -> f64 {
            self.0 = self
                .0
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
        }

        fn next(&mut self) -> f64 {
            let (a, b) = (self.uniform(), self.uniform());
            (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
        }
    }

    const PITCH_MM: f64 = 0.03;
    /// The corners of the drawn curve before it bends and steps: turns of 45, 60 and 15 degrees.
    const TURNS_DEG: [f64; 3] = [45.0, -60.0, 15.0];
    const FLANK_MM: f64 = 10.0;

    /// Straight pieces with sharp turns, then a quarter circle of 5 mm without a corner, then a step sideways of 2 mm and a
    /// straight end. In a plane askew in space, with noise in both directions of the plane.
    fn drawn(noise_mm: f64, seed: u64) -> (Vec<DVec3>, Vec<DVec3>) {
        let plane = |p: DVec2| {
            let (a, b) = (
                DVec3::new(2.0, 1.0, 2.0) / 3.0,
                DVec3::new(-2.0, 2.0, 1.0) / 3.0,
            );
            DVec3::new(-70.0, -35.0, 155.0) + a * p.x + b * p.y
        };
        let mut random = Normal(seed);
        let (mut at, mut heading) = (DVec2::ZERO, 0.2f64);
        let (mut points, mut corners) = (Vec::new(), Vec::new());
        let mut put = |p: DVec2| {
            let noise = DVec2::new(random.next(), random.next()) * noise_mm;
            points.push(plane(p + noise));
        };
        for turn in TURNS_DEG.into_iter().map(Some).chain([None]) {
            // The corner lies somewhere between two points.
            for i in 0..(FLANK_MM / PITCH_MM) as usize {
                put(at + DVec2::from_angle(heading) * (PITCH_MM * (i as f64 + 0.3)));
            }
            at += DVec2::from_angle(heading) * FLANK_MM;
            if let Some(turn) = turn {
                corners.push(plane(at));
                heading += turn.to_radians();
            }
        }
        let (radius, centre) = (5.0, at + DVec2::from_angle(heading).perp() * 5.0);
        let end = std::f64::consts::FRAC_PI_2;
        for i in 0..(radius * end / PITCH_MM) as usize {
            let angle = heading - end + (i as f64 + 0.3) * PITCH_MM / radius;
            put(centre + DVec2::from_angle(angle) * radius);
        }
        heading += end;
        at = centre
            + DVec2::from_angle(heading - end) * radius
            + DVec2::from_angle(heading).perp() * 2.0;
        for i in 0..300 {
            put(at + DVec2::from_angle(heading) * (PITCH_MM * (f64::from(i) + 0.3)));
        }
        (points, corners)
    }

    #[test]
    fn a_drawn_profile_is_told_as_it_was_drawn() {
        for noise_mm in [0.0, 0.001, 0.014] {
            let (points, corners) = drawn(noise_mm, 7);
            let got = analyse(&points);
            assert_eq!(
                got.corners.len(),
                corners.len(),
                "{noise_mm} mm: {:?}",
                got.corners
            );
            assert!(
                (got.spacing_mm / PITCH_MM - 1.0).abs() < 0.05,
                "{} mm",
                got.spacing_mm
            );
            // 1,600 residuals know their spread to 1 in 40; the median costs some of it.
            assert!(
                (got.noise_mm - noise_mm).abs() <= 0.08 * noise_mm + 1e-4,
                "{} mm",
                got.noise_mm
            );
            assert_eq!(
                got.breaks.len(),
                1,
                "the step at {noise_mm} mm: {:?}",
                got.breaks
            );
            assert!(got.outliers.is_empty(), "{:?}", got.outliers);
            for ((corner, truth), turn) in got.corners.iter().zip(&corners).zip(TURNS_DEG) {
                let error = corner.position.distance(*truth);
                assert!(
                    error <= 4.0 * corner.position_sigma_mm + 1e-6,
                    "{noise_mm} mm: {error} {corner:?}"
                );
                let error = (corner.turn_angle_rad - turn.abs().to_radians()).abs();
                assert!(
                    error <= 4.0 * corner.turn_angle_sigma_rad + 1e-6,
                    "{noise_mm} mm: {error} {corner:?}"
                );
            }
        }
    }

    #[test]
    fn stated_sigmas_are_those_of_repeated_profiles() {
        let (mut angle, mut position, mut count) = (0.0, 0.0, 0.0);
        for seed in 0..60 {
            let (points, corners) = drawn(0.01, seed);
            let got = analyse(&points);
            assert_eq!(got.corners.len(), corners.len(), "seed {seed}");
            for ((corner, truth), turn) in got.corners.iter().zip(&corners).zip(TURNS_DEG) {
                let z =
                    (corner.turn_angle_rad - turn.abs().to_radians()) / corner.turn_angle_sigma_rad;
                angle += z * z;
                position += (corner.position.distance(*truth) / corner.position_sigma_mm).powi(2);
                count += 1.0;
            }
        }
        // 180 values know their root mean square to 5 %; the corner's index is chosen on the same data, which adds some.
        let (angle, position) = (f64::sqrt(angle / count), f64::sqrt(position / count));
        assert!(
            (0.8..1.25).contains(&angle),
            "angle errors over their sigma: {angle}"
        );
        // The second direction, across the least certain one, adds a little to the distance.
        assert!(
            (0.8..1.35).contains(&position),
            "position errors over their sigma: {position}"
        );
    }

    #[test]
    fn gross_reflections_are_outliers_and_change_nothing_else() {
        let (mut points, corners) = drawn(0.01, 3);
        let before = analyse(&points);
        let normal = DVec3::new(2.0, 1.0, 2.0)
            .cross(DVec3::new(-2.0, 2.0, 1.0))
            .normalize();
        let struck: Vec<usize> = (40..points.len() - 20)
            .step_by(97)
            .flat_map(|i| [i, i + 1, i + 2])
            .collect();
        for (k, &i) in struck.iter().enumerate() {
            let along = (points[i + 3] - points[i - 3]).normalize();
            points[i] +=
                normal.cross(along) * (3.0 + 0.7 * k as f64) * if k % 2 == 0 { 1.0 } else { -1.0 };
        }
        let got = analyse(&points);
        assert_eq!(got.outliers, struck);
        assert_eq!(got.corners.len(), corners.len());
        assert!(
            (got.noise_mm / before.noise_mm - 1.0).abs() < 0.2,
            "a fifth of all lines hold a reflection"
        );
    }

    #[test]
    fn nothing_is_found_where_there_is_nothing() {
        assert!(analyse(&[]).corners.is_empty());
        assert!(analyse(&[DVec3::ONE; 100]).corners.is_empty());
        assert!(analyse(&[DVec3::NAN; 100]).corners.is_empty());
        for count in 0..40 {
            let line: Vec<DVec3> = (0..count).map(|i| DVec3::X * f64::from(i)).collect();
            let got = analyse(&line);
            assert!(got.corners.is_empty() && got.breaks.is_empty() && got.outliers.is_empty());
        }
        // Circles down to a radius of ten spacings are smooth.
        for radius in [0.3, 1.0, 10.0] {
            let circle = |i: i32| {
                DVec3::new(
                    0.0,
                    radius * (f64::from(i) * 0.03 / radius).cos(),
                    radius * (f64::from(i) * 0.03 / radius).sin(),
                )
            };
            let got = analyse(&(0..60).map(circle).collect::<Vec<_>>());
            assert!(got.corners.is_empty(), "radius {radius}: {:?}", got.corners);
        }
    }
}
