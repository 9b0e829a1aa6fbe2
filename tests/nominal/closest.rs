//! The nearest point of a trimmed face, against samples of it.

use acies::nominal::Nominal;
use glam::DVec3;

use super::data;

/// No sample of any face is nearer than its closest point, from places all around the part.
fn check(n: &Nominal, spacing_mm: f64, places: usize) {
    let mut of_face: Vec<Vec<DVec3>> = vec![Vec::new(); n.faces.len()];
    for s in n.samples(spacing_mm) {
        of_face[s.face as usize].push(s.point);
    }
    let [low, high] = n.faces_box_mm;
    let (centre, half) = ((low + high) * 0.5, (high - low) * 0.7);
    for k in 0..places {
        let a = k as f64;
        let p = centre + half * DVec3::new((1.7 * a).sin(), (2.3 * a).cos(), (0.9 * a).sin());
        for (i, samples) in of_face.iter().enumerate() {
            let foot = n.closest(i as u32, p).expect("a face with a normal");
            let d = foot.point.distance(p);
            let sampled = samples
                .iter()
                .map(|q| q.distance(p))
                .fold(f64::INFINITY, f64::min);
            // Samples may lie outside the exact border by the chord of its polyline.
            assert!(
                d <= sampled + 1e-4 * spacing_mm,
                "face {i}: {d}, but a sample at {sampled}"
            );
            // And it is on the face: no farther from a sample than those are from each other.
            let near = samples
                .iter()
                .map(|q| q.distance(foot.point))
                .fold(f64::INFINITY, f64::min);
            assert!(
                near < 6.0 * spacing_mm,
                "face {i}: {near} mm from the nearest sample"
            );
        }
    }
}

#[test]
fn no_sample_of_a_face_is_nearer() {
    check(&super::parse(super::BOX), 0.5, 40);
    check(&super::parse(super::CYLINDER), 1.0, 40);
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/part.step");
    let n = Nominal::read(&path).unwrap_or_else(|e| panic!("{e}"));
    check(&n, 0.7, 20);
}

#[test]
fn nor_of_a_free_form_part() {
    let Some(root) = data() else { return };
    let n =
        Nominal::read(&root.join("step/stepcode_dm1-id-214.stp")).unwrap_or_else(|e| panic!("{e}"));
    check(&n, 2.0, 6);
}
