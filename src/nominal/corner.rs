//! Corners: where sharp edges end, and which of them meet there.

use std::collections::BTreeMap;

use glam::DVec3;

use super::SharpEdge;

/// Which end of an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum End {
    /// Arc length 0.
    Start,
    /// Arc length `length_mm`.
    End,
}

/// A node of the net of sharp edges: a place where one or more of them end.
///
/// Three and more edges make a corner of the part; two are one edge going on (a circle written as two arcs, a bend);
/// one is an edge that fades into a smooth joint or ends at a border. A closed edge ends nowhere, unless others end on its
/// start.
#[derive(Debug, Clone, PartialEq)]
pub struct Corner {
    /// Mean of the ends that meet here, mm.
    pub position: DVec3,
    /// Indices into [`super::Nominal::sharp_edges`] and the end that lies here, in ascending order.
    pub edges: Vec<(usize, End)>,
    /// Indices of the faces of those edges, in ascending order.
    pub faces: Vec<u32>,
}

impl Corner {
    /// Whether three or more sharp edges meet here.
    pub fn is_vertex(&self) -> bool {
        self.edges.len() >= 3
    }
}

/// The nodes of the sharp edges; ends nearer than `gap_mm` are one place.
pub(super) fn corners(edges: &[SharpEdge], gap_mm: f64) -> Vec<Corner> {
    let gap_mm = gap_mm.max(1e-9);
    let cell = |p: DVec3| (p / (2.0 * gap_mm)).floor().as_i64vec3().to_array();
    let mut ends: Vec<(usize, End, DVec3)> = Vec::with_capacity(2 * edges.len());
    for (i, e) in edges.iter().enumerate() {
        ends.push((i, End::Start, e.point(0.0)));
        ends.push((i, End::End, e.point(e.length_mm)));
    }
    let mut grid: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
    let mut nodes: Vec<Vec<usize>> = Vec::new();
    for (k, (_, _, p)) in ends.iter().enumerate() {
        let [x, y, z] = cell(*p);
        let near = (-1..=1)
            .flat_map(|i| (-1..=1).flat_map(move |j| (-1..=1).map(move |l| [x + i, y + j, z + l])))
            .filter_map(|c| grid.get(&c))
            .flatten()
            .copied()
            .find(|n| ends[nodes[*n][0]].2.distance(*p) <= gap_mm);
        match near {
            Some(n) => nodes[n].push(k),
            None => {
                grid.entry(cell(*p)).or_default().push(nodes.len());
                nodes.push(vec![k]);
            }
        }
    }
    let corner = |members: Vec<usize>| {
        let sum: DVec3 = members.iter().map(|k| ends[*k].2).sum();
        let mut faces: Vec<u32> = members
            .iter()
            .flat_map(|k| edges[ends[*k].0].faces)
            .collect();
        faces.sort_unstable();
        faces.dedup();
        Corner {
            position: sum / members.len() as f64,
            edges: members.iter().map(|k| (ends[*k].0, ends[*k].1)).collect(),
            faces,
        }
    };
    let ring = |c: &Corner| matches!(c.edges[..], [(a, _), (b, _)] if a == b);
    nodes.into_iter().map(corner).filter(|c| !ring(c)).collect()
}
