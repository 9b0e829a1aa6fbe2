//! Acceptance test of a scanner: how well it measures spheres, their distance, a plane, and an edge.
//!
//! The quantities are those of ISO 10360-8 and VDI/VDE 2634, in the wording of features-and-standards, section 4.9. No standard has an edge
//! artefact: the prism is ours, and said to be. Names are ours too, since the symbols of the standards are being fixed anew.

use glam::DVec3;
use serde::Serialize;

use crate::geometry::fit::fit_plane;
use crate::geometry::sphere::{SphereFit, find_sphere};

/// Share of the points that a form over 95 % leaves out, half on each side.
const LEFT_OUT: f64 = 0.05;

/// What a scan of one reference sphere shows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SphereFigures {
    /// Centre, mm.
    pub centre_mm: [f64; 3],
    /// Points on the sphere.
    pub points: usize,
    /// Diameter of the least-squares sphere less the certified one, mm.
    pub size_error_mm: f64,
    /// Its standard uncertainty from the points alone, mm.
    pub u_size_mm: f64,
    /// Largest less smallest radial residual of the 95 % of the points that are nearest to the sphere, mm.
    pub form_95_mm: f64,
    /// Largest less smallest radial residual of the means of 25 patches of the cap, mm: the probing form with averaging, less noise.
    pub form_25_mm: f64,
    /// Standard deviation of the residuals, mm.
    pub sigma_mm: f64,
}

/// What a scan of two spheres of a ball bar shows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DistanceFigures {
    /// Measured less certified distance of the centres, mm.
    pub distance_error_mm: f64,
    /// Its standard uncertainty from the points alone, mm.
    pub u_distance_mm: f64,
    /// Each sphere.
    pub spheres: [SphereFigures; 2],
}

/// What a scan of a flat shows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PlaneFigures {
    /// Points used.
    pub points: usize,
    /// Width of the slab parallel to the least-squares plane that holds 95 % of the points, mm.
    pub form_95_mm: f64,
    /// Standard deviation of the residuals, mm.
    pub sigma_mm: f64,
}

/// What a scan of our prism shows: one straight edge of certified angle between two flats.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EdgeFigures {
    /// Included angle less the certified one, degrees.
    pub angle_error_deg: f64,
    /// Distance from the intersection of the flats at which their points depart from them by three standard deviations, mm: the width of the
    /// zone that this scanner does not measure, edge break included.
    pub transition_mm: [f64; 2],
    /// Points used on each flat.
    pub points: [usize; 2],
}

/// Why a figure cannot be given.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AcceptanceError {
    /// No sphere of that size.
    #[error(
        "no sphere of radius {radius_mm} mm among {points} points, expected one; check radius and unit, and that the cap was scanned"
    )]
    NoSphere {
        /// Its radius.
        radius_mm: f64,
        /// Points looked at.
        points: usize,
    },
    /// Not enough of it.
    #[error("{found} {what}, expected at least {needed}; scan it more densely or from nearer")]
    TooFew {
        /// What is counted.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many it takes.
        needed: usize,
    },
    /// The two flats are not there.
    #[error(
        "{}",
        "no two flats that meet in an edge, expected the prism alone in the scan; cut it out and try again"
    )]
    NoEdge,
}

/// The figures of one sphere of certified `radius_mm` in `points`; `noise_mm` is the scanner's noise, for finding it.
///
/// # Errors
/// [`AcceptanceError::NoSphere`] and [`AcceptanceError::TooFew`].
pub fn sphere(
    points: &[DVec3],
    radius_mm: f64,
    noise_mm: f64,
) -> Result<SphereFigures, AcceptanceError> {
    sphere_and_fit(points, radius_mm, noise_mm).map(|(figures, _)| figures)
}

fn sphere_and_fit(
    points: &[DVec3],
    radius_mm: f64,
    noise_mm: f64,
) -> Result<(SphereFigures, SphereFit), AcceptanceError> {
    let tolerance = (5.0 * noise_mm).max(1e-3 * radius_mm);
    let fit = find_sphere(points, radius_mm, tolerance).ok_or(AcceptanceError::NoSphere {
        radius_mm,
        points: points.len(),
    })?;
    if fit.used.len() < 100 {
        return Err(AcceptanceError::TooFew {
            what: "points on the sphere",
            found: fit.used.len(),
            needed: 100,
        });
    }
    let on: Vec<DVec3> = fit.used.iter().map(|i| points[*i as usize]).collect();
    let residuals: Vec<f64> = on
        .iter()
        .map(|p| p.distance(fit.centre) - fit.radius_mm)
        .collect();
    let figures = SphereFigures {
        centre_mm: fit.centre.to_array(),
        points: on.len(),
        size_error_mm: 2.0 * (fit.radius_mm - radius_mm),
        u_size_mm: 2.0 * fit.covariance[3][3].sqrt(),
        form_95_mm: form_95(&residuals),
        form_25_mm: form_of_patches(&on, &residuals, fit.centre),
        sigma_mm: fit.sigma_mm,
    };
    Ok((figures, fit))
}

/// The figures of a ball bar: spheres of certified `radius_mm`, centres `distance_mm` apart.
///
/// # Errors
/// As [`sphere`], for either of the two.
pub fn distance(
    points: &[DVec3],
    radius_mm: f64,
    distance_mm: f64,
    noise_mm: f64,
) -> Result<DistanceFigures, AcceptanceError> {
    let (first, fit) = sphere_and_fit(points, radius_mm, noise_mm)?;
    let rest: Vec<DVec3> = points
        .iter()
        .copied()
        .filter(|p| p.distance(fit.centre) > 1.2 * radius_mm)
        .collect();
    let (second, other) = sphere_and_fit(&rest, radius_mm, noise_mm)?;
    let between = other.centre - fit.centre;
    let along = between.normalize_or_zero().to_array();
    let variance = |fit: &SphereFit| -> f64 {
        (0..3)
            .flat_map(|i| (0..3).map(move |j| (i, j)))
            .map(|(i, j)| along[i] * fit.covariance[i][j] * along[j])
            .sum()
    };
    Ok(DistanceFigures {
        distance_error_mm: between.length() - distance_mm,
        u_distance_mm: (variance(&fit) + variance(&other)).sqrt(),
        spheres: [first, second],
    })
}

/// The figures of a flat; the scan must show nothing else.
///
/// # Errors
/// [`AcceptanceError::TooFew`] for fewer than 100 points.
pub fn plane(points: &[DVec3]) -> Result<PlaneFigures, AcceptanceError> {
    let too_few = AcceptanceError::TooFew {
        what: "points on the flat",
        found: points.len(),
        needed: 100,
    };
    if points.len() < 100 {
        return Err(too_few);
    }
    let fit = fit_plane(points).ok_or(too_few)?;
    let residuals: Vec<f64> = points
        .iter()
        .map(|p| (*p - fit.centre).dot(fit.normal))
        .collect();
    let squares: f64 = residuals.iter().map(|r| r * r).sum();
    Ok(PlaneFigures {
        points: points.len(),
        form_95_mm: form_95(&residuals),
        sigma_mm: (squares / (points.len() as f64 - 3.0)).sqrt(),
    })
}

/// The figures of an edge between two flats of certified `included_angle_deg`; `noise_mm` is the scanner's noise.
///
/// Each flat is fitted to the points farther than `reach_mm` from the edge; what lies nearer shows the transition.
///
/// # Errors
/// [`AcceptanceError::NoEdge`] where the points do not lie on two flats.
pub fn edge(
    points: &[DVec3],
    included_angle_deg: f64,
    reach_mm: f64,
    noise_mm: f64,
) -> Result<EdgeFigures, AcceptanceError> {
    let flats = two_flats(points, noise_mm).ok_or(AcceptanceError::NoEdge)?;
    let [mut a, mut b] = flats;
    for _ in 0..3 {
        let along =
            a.1.cross(b.1)
                .try_normalize()
                .ok_or(AcceptanceError::NoEdge)?;
        let origin = meeting(&a, &b, along).ok_or(AcceptanceError::NoEdge)?;
        let far = |p: DVec3| {
            let v = p - origin;
            (v - along * v.dot(along)).length() > reach_mm
        };
        let near_to = |flat: &(DVec3, DVec3), other: &(DVec3, DVec3)| {
            let own = |p: &DVec3| (*p - flat.0).dot(flat.1).abs();
            let others = |p: &DVec3| (*p - other.0).dot(other.1).abs();
            points
                .iter()
                .copied()
                .filter(|p| far(*p) && own(p) < others(p))
                .collect::<Vec<DVec3>>()
        };
        let (of_a, of_b) = (near_to(&a, &b), near_to(&b, &a));
        let fitted = |of: &[DVec3]| (of.len() >= 50).then(|| fit_plane(of)).flatten();
        let (fa, fb) = (fitted(&of_a), fitted(&of_b));
        let (Some(fa), Some(fb)) = (fa, fb) else {
            return Err(AcceptanceError::NoEdge);
        };
        a = (fa.centre, fa.normal);
        b = (fb.centre, fb.normal);
    }
    let along =
        a.1.cross(b.1)
            .try_normalize()
            .ok_or(AcceptanceError::NoEdge)?;
    let origin = meeting(&a, &b, along).ok_or(AcceptanceError::NoEdge)?;
    let across = |centre: DVec3| {
        let v = centre - origin;
        (v - along * v.dot(along)).normalize_or_zero()
    };
    let into = [across(a.0), across(b.0)];
    let angle = into[0].angle_between(into[1]).to_degrees();
    let mut counts = [0; 2];
    let mut transition = [0.0f64; 2];
    for p in points {
        let v = *p - origin;
        let r = [v.dot(into[0]), v.dot(into[1])];
        let side = usize::from(r[1] > r[0]);
        let flat = [a, b][side];
        counts[side] += 1;
        if r[side] > 0.0 && r[side] < reach_mm && (*p - flat.0).dot(flat.1).abs() > 3.0 * noise_mm {
            transition[side] = transition[side].max(r[side]);
        }
    }
    Ok(EdgeFigures {
        angle_error_deg: angle - included_angle_deg,
        transition_mm: transition,
        points: counts,
    })
}

/// Two flats by majority: the plane of most points, then that of most of the others. (Place, unit normal) each.
fn two_flats(points: &[DVec3], noise_mm: f64) -> Option<[(DVec3, DVec3); 2]> {
    let first = majority(points, noise_mm)?;
    let rest: Vec<DVec3> = points
        .iter()
        .copied()
        .filter(|p| (*p - first.0).dot(first.1).abs() > 6.0 * noise_mm)
        .collect();
    let second = majority(&rest, noise_mm)?;
    let turned = first.1.dot(second.1).abs() < 5f64.to_radians().cos();
    turned.then_some([first, second])
}

/// The plane within three standard deviations of which most points lie, by a fixed sequence of triples.
fn majority(points: &[DVec3], noise_mm: f64) -> Option<(DVec3, DVec3)> {
    const TRIES: usize = 300;
    if points.len() < 50 {
        return None;
    }
    let step = points.len().div_ceil(3000).max(1);
    let few: Vec<DVec3> = points.iter().copied().step_by(step).collect();
    let mut best: Option<(usize, (DVec3, DVec3))> = None;
    for k in 0..TRIES {
        // Steps without a common factor spread the triples over the scan.
        let at = |shift: usize| few[(k * 7919 + shift * (few.len() / 3 + 1) + k * k) % few.len()];
        let (a, b, c) = (at(0), at(1), at(2));
        let Some(normal) = (b - a).cross(c - a).try_normalize() else {
            continue;
        };
        let close = |p: &&DVec3| (**p - a).dot(normal).abs() < 3.0 * noise_mm;
        let votes = few.iter().filter(close).count();
        if best.is_none_or(|(most, _)| votes > most) {
            best = Some((votes, (a, normal)));
        }
    }
    let (votes, plane) = best?;
    (votes * 10 > few.len()).then_some(plane)
}

/// A place on the line where two planes meet, nearest to their centres.
fn meeting(a: &(DVec3, DVec3), b: &(DVec3, DVec3), along: DVec3) -> Option<DVec3> {
    let middle = 0.5 * (a.0 + b.0);
    let matrix = glam::DMat3::from_cols(a.1, b.1, along).transpose();
    if matrix.determinant().abs() < 1e-3 {
        return None;
    }
    let right = DVec3::new(a.1.dot(a.0), b.1.dot(b.0), along.dot(middle));
    Some(matrix.inverse() * right)
}

/// Width of the range that holds all residuals but 2.5 % at either end.
fn form_95(residuals: &[f64]) -> f64 {
    let mut sorted = residuals.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cut = (0.5 * LEFT_OUT * sorted.len() as f64).floor() as usize;
    sorted[sorted.len() - 1 - cut] - sorted[cut]
}

/// Largest less smallest mean residual of 25 patches of equal population over the cap.
fn form_of_patches(on: &[DVec3], residuals: &[f64], centre: DVec3) -> f64 {
    const RINGS: usize = 5;
    let axis = (on.iter().sum::<DVec3>() / on.len() as f64 - centre)
        .try_normalize()
        .unwrap_or(DVec3::Z);
    let x = axis.any_orthonormal_vector();
    let y = axis.cross(x);
    let mut order: Vec<usize> = (0..on.len()).collect();
    let height = |i: &usize| (on[*i] - centre).dot(axis);
    order.sort_by(|i, j| height(j).total_cmp(&height(i)).then(i.cmp(j)));
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for ring in order.chunks(order.len().div_ceil(RINGS)) {
        let mut ring = ring.to_vec();
        let around = |i: &usize| {
            let v = on[*i] - centre;
            v.dot(y).atan2(v.dot(x))
        };
        ring.sort_by(|i, j| around(i).total_cmp(&around(j)).then(i.cmp(j)));
        for patch in ring.chunks(ring.len().div_ceil(RINGS)) {
            let mean = patch.iter().map(|i| residuals[*i]).sum::<f64>() / patch.len() as f64;
            low = low.min(mean);
            high = high.max(mean);
        }
    }
    high - low
}

#[cfg(test)]
mod tests {
    use super::*;

    /// SplitMix64, normal by twelve uniform numbers.
    struct Numbers(u64);

    impl Numbers {
        fn uniform(&mut self) -> f64 {
            self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
        }

        fn normal(&mut self) -> f64 {
            (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
        }
    }

    fn cap(centre: DVec3, radius: f64, count: usize, sigma: f64, n: &mut Numbers) -> Vec<DVec3> {
        let points = (0..count).map(|_| {
            let z = 0.35 + 0.65 * n.uniform();
            let around = std::f64::consts::TAU * n.uniform();
            let r = (1.0 - z * z).sqrt();
            let outward = DVec3::new(r * around.cos(), r * around.sin(), z);
            centre + outward * (radius + sigma * n.normal())
        });
        points.collect()
    }

    #[test]
    fn a_ball_bar_shows_its_errors_and_no_more() {
        let mut n = Numbers(3);
        let centre = DVec3::new(10.0, -4.0, 60.0);
        // Scanned 8 um too large in diameter, and 12 um too far apart.
        let far = centre + DVec3::new(100.012, 0.0, 0.0);
        let mut points = cap(centre, 12.504, 4000, 0.006, &mut n);
        points.extend(cap(far, 12.504, 3000, 0.006, &mut n));
        points.extend((0..2000).map(|_| DVec3::new(120.0 * n.uniform(), 0.0, 30.0 * n.uniform())));
        let figures = distance(&points, 12.5, 100.0, 0.006).expect("two spheres");
        let error = figures.distance_error_mm - 0.012;
        assert!(error.abs() < 4.0 * figures.u_distance_mm, "{figures:?}");
        assert!(figures.u_distance_mm < 0.001);
        for sphere in &figures.spheres {
            assert!((sphere.size_error_mm - 0.008).abs() < 4.0 * sphere.u_size_mm);
            // 95 % of a normal distribution lie within 3.92 standard deviations; stray points that lie on the sphere add a little.
            assert!(
                (sphere.form_95_mm / (3.92 * 0.006) - 1.0).abs() < 0.06,
                "{sphere:?}"
            );
            // The range of 25 means of 120 to 160 points is 3.9 standard deviations of a mean.
            assert!(
                sphere.form_25_mm < 6.0 * 0.006 / 120f64.sqrt(),
                "{sphere:?}"
            );
        }
    }

    #[test]
    fn a_flat_and_what_is_no_sphere() {
        let mut n = Numbers(4);
        let flat: Vec<DVec3> = (0..5000)
            .map(|_| DVec3::new(40.0 * n.uniform(), 30.0 * n.uniform(), 0.004 * n.normal()))
            .collect();
        let figures = plane(&flat).expect("a flat");
        assert!((figures.sigma_mm / 0.004 - 1.0).abs() < 0.05);
        assert!((figures.form_95_mm / (3.92 * 0.004) - 1.0).abs() < 0.06);
        assert!(matches!(
            sphere(&flat, 12.5, 0.004),
            Err(AcceptanceError::NoSphere { .. })
        ));
        assert!(plane(&flat[..10]).is_err());
        assert!(matches!(
            edge(&flat, 90.0, 1.0, 0.004),
            Err(AcceptanceError::NoEdge)
        ));
    }

    #[test]
    fn a_prism_shows_its_angle_and_how_near_to_the_edge_the_scanner_measures() {
        let mut n = Numbers(5);
        let angle = 60.2f64.to_radians();
        let mut points = Vec::new();
        for _ in 0..20_000 {
            let (r, s) = (8.0 * n.uniform(), 30.0 * n.uniform());
            let side = n.uniform() < 0.5;
            let half = if side { 0.5 * angle } else { -0.5 * angle };
            // The last 0.3 mm before the edge are smeared inward by up to 0.1 mm.
            let smear = (0.1 * (1.0 - r / 0.3)).max(0.0);
            let place = DVec3::new(r * half.cos(), r * half.sin(), s);
            let outward = DVec3::new(-half.sin(), half.cos(), 0.0) * half.signum();
            points.push(place + outward * (0.005 * n.normal() - smear));
        }
        let figures = edge(&points, 60.0, 1.5, 0.005).expect("an edge");
        assert!((figures.angle_error_deg - 0.2).abs() < 0.01, "{figures:?}");
        for (side, zone) in figures.transition_mm.iter().enumerate() {
            // A smear of three standard deviations (15 um) ends 0.255 mm from the edge; one normal point in 370 is farther than three.
            assert!((0.2..1.5).contains(zone), "{side}: {figures:?}");
        }
    }
}
