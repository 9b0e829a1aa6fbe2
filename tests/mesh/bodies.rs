//! Bodies for meshing, beside the solids of the tests of detection: torus, ellipsoid, sphere, and a block of genus three.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

use crate::clouds::solids::{Hole, extrusion};
use crate::clouds::{Random, Solid};

/// Points with their true outward normals.
pub struct Known {
    pub points: Vec<DVec3>,
    pub normals: Vec<DVec3>,
}

/// `around` times `across` points on a torus of radii 10 and 4, evenly in both angles, every second ring by half a step.
pub fn torus(around: usize, across: usize) -> Known {
    let mut known = Known {
        points: Vec::new(),
        normals: Vec::new(),
    };
    for i in 0..around {
        for j in 0..across {
            let u = TAU * i as f64 / around as f64;
            let v = TAU * (j as f64 + 0.5 * (i % 2) as f64) / across as f64;
            let out = DVec3::new(u.cos(), u.sin(), 0.0);
            let normal = out * v.cos() + DVec3::Z * v.sin();
            known.points.push(out * 10.0 + normal * 4.0);
            known.normals.push(normal);
        }
    }
    known
}

/// `count` points along a spiral on an ellipsoid with these half axes.
pub fn ellipsoid(count: usize, axes: DVec3) -> Known {
    let golden = TAU * (1.0 - 1.0 / 1.618_033_988_749_895);
    let on_sphere = (0..count).map(|i| {
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    });
    let (points, normals) = on_sphere
        .map(|p| (p * axes, (p / axes).normalize()))
        .unzip();
    Known { points, normals }
}

/// A block with three through holes.
pub fn three_holes() -> Solid {
    let hole = |x: f64| Hole {
        centre: DVec2::new(x, 10.0),
        radius: 5.0,
        top: 8.0,
        bottom: 0.0,
        blind: false,
    };
    let profile = [(0.0, 0.0), (60.0, 0.0), (60.0, 8.0), (0.0, 8.0)].map(|(x, z)| DVec2::new(x, z));
    extrusion(&profile, 20.0, &[hole(10.0), hole(30.0), hole(50.0)])
}

/// The points each moved within a cube of half width `reach`.
pub fn shaken(points: &[DVec3], reach: f64, seed: u64) -> Vec<DVec3> {
    let mut random = Random::new(seed);
    let mut way = || random.between(-reach, reach);
    points
        .iter()
        .map(|p| *p + DVec3::new(way(), way(), way()))
        .collect()
}

/// Mean, root mean square and standard deviation of the angles, rad, between normals and the true ones, whatever their signs.
pub fn errors(found: &[glam::Vec3], truth: &[DVec3]) -> [f64; 3] {
    let angles: Vec<f64> = (found.iter().zip(truth))
        .map(|(n, t)| {
            let n = n.as_dvec3();
            n.cross(*t).length().atan2(n.dot(*t).abs())
        })
        .collect();
    let count = angles.len() as f64;
    let mean = angles.iter().sum::<f64>() / count;
    let square = angles.iter().map(|a| a * a).sum::<f64>() / count;
    [mean, square.sqrt(), (square - mean * mean).max(0.0).sqrt()]
}
