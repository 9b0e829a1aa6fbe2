//! Exchanges alone, in blocks, and where something is in the way.

use proptest::prelude::*;

use super::*;

#[path = "../../../tests/mesh/embedded.rs"]
mod embedded;

#[test]
fn bends_of_a_flat_a_right_and_a_folded_edge() {
    let (a, b) = (DVec3::ZERO, DVec3::X * 2.0);
    let c = DVec3::new(1.0, 1.0, 0.0);
    assert_eq!(bend(a, b, c, DVec3::new(0.3, -2.0, 0.0)), 0.0);
    let right = bend(a, b, c, DVec3::new(1.0, 0.0, -1.0));
    assert!((right - 2.0 * std::f64::consts::FRAC_PI_2.sqrt()).abs() < 1e-12);
    let folded = bend(a, b, c, DVec3::new(1.0, 3.0, 0.0));
    assert!((folded - 2.0 * std::f64::consts::PI.sqrt()).abs() < 1e-12);
}

/// A roof of two triangles over a floor, the ridge across the valley: its diagonal gains.
fn roof(more: &[DVec3]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let corners = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
    let mut points: Vec<DVec3> = corners
        .iter()
        .map(|c| DVec3::new(c[0], c[1], -3.0))
        .collect();
    // Two opposite corners of the roof are higher.
    points.extend((0..4).map(|i| {
        let z = f64::from(i % 2);
        DVec3::new(corners[i as usize][0], corners[i as usize][1], z)
    }));
    points.extend(more);
    let mut triangles = vec![[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]];
    for i in 0..4 {
        let j = (i + 1) % 4;
        triangles.extend([[i, j, 4 + j], [i, 4 + j, 4 + i]]);
    }
    (points, triangles)
}

#[test]
fn a_diagonal_is_exchanged_and_steps_are_taken_back() {
    let (points, triangles) = roof(&[]);
    let mut surface = Surface::new(&points, triangles.clone(), 8);
    let half = 4 * 2 + 1;
    assert_eq!(surface.ends(half), (4, 6));
    assert!(surface.is_whole(half) && surface.is_free(half));
    let bends = [false, true].map(|other| surface.bends(half, other));
    let twins = surface.twins.clone();
    let step = surface.step(half);
    surface.swap(half);
    assert_eq!(surface.ends(half & !3), (5, 7));
    let turned = [true, false].map(|other| surface.bends(half & !3, other));
    // The same in another order.
    assert!((0..2).all(|i| (bends[i] - turned[i]).abs() < 1e-12));
    let made = crate::mesh::topology(8, &surface.triangles);
    assert!(made.is_watertight() && made.is_manifold());
    assert_eq!(super::twins(&surface.triangles), surface.twins);
    surface.take_back(&step);
    assert_eq!((surface.triangles, surface.twins), (triangles, twins));
}

#[test]
fn a_diagonal_stays_where_something_is_in_the_way() {
    let small = |at: DVec3, size: f64| {
        [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|way| at + way * size)
    };
    // Over the valley and under the ridge it may not pass: within the tetrahedron, through its upper face, and clear of it above and below.
    for (at, size, is_free) in [
        (DVec3::new(0.9, 0.9, 0.3), 0.1, false),
        (DVec3::new(0.9, 0.9, -0.5), 2.0, false),
        (DVec3::new(0.9, 0.9, 1.1), 0.1, true),
        (DVec3::new(0.9, 0.9, -0.3), 0.1, true),
    ] {
        let (points, mut triangles) = roof(&small(at, size));
        triangles.extend([[8, 10, 9], [8, 9, 11], [9, 10, 11], [10, 8, 11]]);
        let surface = Surface::new(&points, triangles, 8);
        assert_eq!(surface.is_free(4 * 2 + 1), is_free, "{at}, {size}");
    }
}

/// A closed box of `n` times `n` whole-numbered columns, high where `heights` says so.
fn columns(n: u32, heights: &[u8]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut points = Vec::new();
    for top in [false, true] {
        for (i, height) in heights.iter().enumerate() {
            let (x, y) = (i as u32 % n, i as u32 / n);
            let z = if top { f64::from(*height) } else { -9.0 };
            points.push(DVec3::new(f64::from(4 * x), f64::from(4 * y), z));
        }
    }
    let top = n * n;
    let mut triangles = Vec::new();
    let mut quad = |a, b, c, d| triangles.extend([[a, b, c], [a, c, d]]);
    for y in 0..n - 1 {
        for x in 0..n - 1 {
            let i = x + n * y;
            quad(top + i, top + i + 1, top + i + n + 1, top + i + n);
            quad(i, i + n, i + n + 1, i + 1);
        }
    }
    for i in 0..n - 1 {
        let (left, right, front, back) = (n * i, n * i + n - 1, i, i + n * (n - 1));
        quad(left, top + left, top + left + n, left + n);
        quad(right, right + n, top + right + n, top + right);
        quad(front, front + 1, top + front + 1, top + front);
        quad(back, top + back, top + back + 1, back + 1);
    }
    (points, triangles)
}

/// The cost of a mesh.
fn cost(points: &[DVec3], triangles: &[[u32; 3]]) -> f64 {
    let surface = Surface::new(points, triangles.to_vec(), points.len() as u32);
    let halves = (0..triangles.len() as u32).flat_map(|t| [4 * t, 4 * t + 1, 4 * t + 2]);
    halves
        .map(|h| {
            let [a, b, c, d] = surface.corners(h).map(|v| surface.at(v));
            0.5 * bend(a, b, c, d)
        })
        .sum()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn blocks_gain_as_much_as_the_whole_and_nothing_crosses(
        heights in proptest::collection::vec(0u8..7, 100),
        most in 12usize..60,
    ) {
        let (points, triangles) = columns(10, &heights);
        let before = crate::mesh::topology(200, &triangles);
        prop_assert!(before.is_watertight() && before.is_manifold());
        let (mut whole, mut blocks) = (triangles.clone(), triangles.clone());
        let flips = [flip(&points, &mut whole), flip_by(most, &points, &mut blocks)];
        prop_assert!(flips[0] > 0 && flips[1] > 0);
        let after = crate::mesh::topology(200, &blocks);
        prop_assert!(after.is_watertight() && after.is_manifold());
        prop_assert_eq!(after.genus(), before.genus());
        // Another order of the same exchanges ends elsewhere, but about as far down.
        let [first, one, many] = [&triangles, &whole, &blocks].map(|t| cost(&points, t));
        prop_assert!(many - one < 0.25 * (first - one), "{first} {one} {many}");
        let corner = |v: u32| points[v as usize].to_array().map(|x| x as i128);
        let made: Vec<[embedded::Point; 3]> = blocks.iter().map(|t| t.map(corner)).collect();
        for (i, s) in made.iter().enumerate() {
            for t in &made[..i] {
                prop_assert!(!embedded::cross_one_another(*s, *t), "{:?} and {:?}", s, t);
            }
        }
    }
}
