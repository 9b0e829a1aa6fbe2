//! A nominal as one HTML page: the part, its sharp edges with their ids, and a list of them. It asks nothing of a network.

use glam::DVec3;
use serde::Serialize;

use crate::geometry::Curve;
use crate::nominal::{EdgeKind, Nominal};

/// The page, with a place for its data.
const PAGE: &str = include_str!("page.html");
/// Dots that show the faces.
const DOTS: f64 = 16_000.0;
/// Points of a drawn curve that bends.
const BENDS: usize = 48;

#[derive(Serialize)]
struct Data<'a> {
    name: &'a str,
    r#box: [[f64; 3]; 2],
    faces: usize,
    corners: usize,
    spacing: f64,
    /// Position and normal of each dot.
    points: Vec<f32>,
    smooth: Vec<Vec<[f32; 3]>>,
    edges: Vec<EdgeData<'a>>,
    refused: Vec<RefusedData<'a>>,
}

#[derive(Serialize)]
struct EdgeData<'a> {
    id: &'a str,
    entity: u64,
    kind: &'static str,
    length_mm: f64,
    turn_deg: f64,
    points: Vec<[f32; 3]>,
}

#[derive(Serialize)]
struct RefusedData<'a> {
    entity: u64,
    reason: &'a str,
}

/// The page of a part.
pub(super) fn page(nominal: &Nominal) -> Result<String, serde_json::Error> {
    let spacing = (nominal.area_mm2() / DOTS).sqrt();
    let small = |p: DVec3| p.as_vec3().to_array();
    let dots = nominal.samples(spacing).into_iter();
    let edges = nominal.sharp_edges.iter().map(|e| EdgeData {
        id: &e.id,
        entity: e.entity,
        kind: match e.kind {
            EdgeKind::Convex => "convex",
            EdgeKind::Concave => "concave",
        },
        length_mm: e.length_mm,
        turn_deg: e.turn_angle_rad(nominal, 0.5 * e.length_mm).to_degrees(),
        points: {
            let steps = if matches!(e.curve(), Curve::Line { .. }) {
                2
            } else {
                BENDS
            };
            let at = |k: usize| small(e.point(e.length_mm * k as f64 / steps as f64));
            (0..=steps).map(at).collect()
        },
    });
    // What is sharp is drawn as such.
    let smooth = nominal.edges.iter().filter(|e| {
        let sharp =
            |s: &crate::nominal::SharpEdge| s.entity == e.entity && s.faces[..] == e.faces[..];
        !nominal.sharp_edges.iter().any(sharp)
    });
    let data = Data {
        name: &nominal.name,
        r#box: nominal.faces_box_mm.map(|p| p.to_array()),
        faces: nominal.faces.len(),
        corners: nominal.corners().iter().filter(|c| c.is_vertex()).count(),
        spacing,
        points: dots
            .flat_map(|s| [small(s.point), small(s.normal)].concat())
            .collect(),
        smooth: smooth
            .map(|e| {
                let at = |k: usize| {
                    let share = k as f64 / BENDS as f64;
                    small(e.curve.point(e.range.0 + (e.range.1 - e.range.0) * share))
                };
                (0..=BENDS).map(at).collect()
            })
            .collect(),
        edges: edges.collect(),
        refused: (nominal.refused.iter())
            .map(|r| RefusedData {
                entity: r.entity,
                reason: &r.reason,
            })
            .collect(),
    };
    // Nothing in a name may end the script.
    let json = serde_json::to_string(&data)?.replace('<', "\\u003c");
    Ok(PAGE.replace("@DATA@", &json))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_holds_every_edge_and_no_foreign_address() {
        let text = include_str!("../../../tests/nominal/box.step");
        let mut nominal = Nominal::parse(text.as_bytes(), "part.step").expect("a box");
        nominal.name = "</script><b>".into();
        let page = page(&nominal).expect("a page");
        assert!(!page.contains("</script><b>") && !page.contains("@DATA@"));
        assert!(!page.contains("http"), "one file, no network");
        for e in &nominal.sharp_edges {
            assert!(page.contains(&format!("\"id\":\"{}\"", e.id)));
        }
        let start = page.find("{\"name\"").expect("the data");
        let end = start + page[start..].find("</script>").expect("its end");
        let data: serde_json::Value = serde_json::from_str(&page[start..end]).expect("JSON");
        assert_eq!(data["edges"].as_array().map(Vec::len), Some(12));
        assert_eq!(data["corners"], 8);
    }
}
