//! Closed triangle meshes: the inside of a body known only by facets.

use glam::DVec3;
use smallvec::SmallVec;

use super::bounds::Bounds;
use super::span::{Crossing, Ray, Span, Spans, Window};
use super::surface::SurfaceId;

/// Why a mesh is no body.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// A triangle names a vertex that is not there.
    #[error("mesh: triangle {triangle} refers to vertex {vertex}, expected less than {vertices}")]
    NoSuchVertex {
        /// Index of the triangle.
        triangle: usize,
        /// The vertex it names.
        vertex: u32,
        /// How many there are.
        vertices: usize,
    },
    /// An edge without exactly one neighbour of opposite direction.
    #[error(
        "mesh: edge {from} to {to} is used {forward} times forward and {backward} backward, expected once each; close the mesh"
    )]
    Open {
        /// First vertex.
        from: u32,
        /// Second vertex.
        to: u32,
        /// Uses from the first to the second.
        forward: usize,
        /// Uses the other way.
        backward: usize,
    },
}

/// Triangles of a closed mesh with a tree of boxes over them.
#[derive(Debug, Clone)]
pub(super) struct Facets {
    corners: Vec<[DVec3; 3]>,
    normals: Vec<DVec3>,
    /// Index of each triangle as the caller numbered it.
    order: Vec<u32>,
    nodes: Vec<Node>,
}

#[derive(Debug, Clone)]
struct Node {
    bounds: Bounds,
    /// Of a leaf the range of triangles; of an inner node the second child in `from` (the first follows the node) and `to` 0.
    from: u32,
    to: u32,
}

const LEAF: usize = 4;

impl Facets {
    /// Checks that the mesh is closed and consistently oriented (counter-clockwise seen from outside).
    pub(super) fn new(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Result<Facets, MeshError> {
        check(vertices, triangles)?;
        let mut order: Vec<u32> = (0..triangles.len() as u32).collect();
        let all: Vec<[DVec3; 3]> = triangles
            .iter()
            .map(|t| t.map(|v| vertices[v as usize]))
            .collect();
        let mut nodes = Vec::new();
        build(&all, &mut order, 0, &mut nodes);
        let corners: Vec<[DVec3; 3]> = order.iter().map(|&i| all[i as usize]).collect();
        let mut normals = vec![DVec3::ZERO; all.len()];
        for (normal, [a, b, c]) in normals.iter_mut().zip(&all) {
            *normal = (*b - *a).cross(*c - *a).normalize_or_zero();
        }
        Ok(Facets {
            corners,
            normals,
            order,
            nodes,
        })
    }

    pub(super) fn bounds(&self) -> Bounds {
        self.nodes.first().map_or(Bounds::EMPTY, |n| n.bounds)
    }

    pub(super) fn normal(&self, facet: u32) -> DVec3 {
        self.normals[facet as usize]
    }

    /// Spans of the ray inside the mesh.
    pub(super) fn spans(&self, id: SurfaceId, ray: &Ray, window: Window) -> Spans {
        let mut crossings = self.crossings(ray);
        crossings.sort_by(|a, b| a.t.total_cmp(&b.t));
        let mut spans = Spans::new();
        let mut depth = 0;
        let mut enter = Crossing::OPEN_START;
        for c in crossings {
            let crossing = Crossing {
                t: c.t,
                surface: Some(id),
                facet: c.facet,
            };
            if c.entering {
                if depth == 0 {
                    enter = crossing;
                }
                depth += 1;
            } else {
                depth -= 1;
                if depth == 0 {
                    for span in window.keep(enter, crossing) {
                        push(&mut spans, span);
                    }
                }
            }
        }
        spans
    }

    /// Every crossing of the whole line; one that passes an edge or a vertex belongs to exactly one facet each way.
    fn crossings(&self, ray: &Ray) -> SmallVec<[FacetCrossing; 8]> {
        let mut found = SmallVec::new();
        let line = Window {
            from: f64::NEG_INFINITY,
            to: f64::INFINITY,
        };
        let frame = Shear::new(ray.direction);
        let mut stack: SmallVec<[u32; 64]> = SmallVec::new();
        if !self.nodes.is_empty() {
            stack.push(0);
        }
        while let Some(index) = stack.pop() {
            let node = &self.nodes[index as usize];
            if node.bounds.clip(ray, line).is_none() {
                continue;
            }
            if node.to == 0 {
                stack.push(node.from);
                stack.push(index + 1);
                continue;
            }
            for slot in node.from..node.to {
                let [a, b, c] = self.corners[slot as usize].map(|p| frame.apply(p - ray.origin));
                if let Some((t, entering)) = pierce(a, b, c) {
                    found.push(FacetCrossing {
                        t,
                        facet: self.order[slot as usize],
                        entering,
                    });
                }
            }
        }
        found
    }
}

struct FacetCrossing {
    t: f64,
    facet: u32,
    entering: bool,
}

/// Two spans that share a place are one: the ray ran through a shared edge.
fn push(spans: &mut Spans, span: Span) {
    super::span::append(spans, span);
}

/// Coordinates in which the ray is the positive third axis and keeps its length.
struct Shear {
    x: DVec3,
    y: DVec3,
    z: DVec3,
}

impl Shear {
    fn new(d: DVec3) -> Shear {
        let x = d.any_orthonormal_vector();
        Shear {
            x,
            y: d.cross(x),
            z: d,
        }
    }

    fn apply(&self, p: DVec3) -> DVec3 {
        DVec3::new(self.x.dot(p), self.y.dot(p), self.z.dot(p))
    }
}

/// Where the third axis pierces a triangle, and whether from its outer side. A point on an edge counts for the triangle on one
/// side only: the edge functions of the two neighbours are exact negatives of each other, and zero is given to one sign.
fn pierce(a: DVec3, b: DVec3, c: DVec3) -> Option<(f64, bool)> {
    let edge = |p: DVec3, q: DVec3| {
        // in one order for both neighbours, so that rounding is the same
        let forward = (p.x, p.y) <= (q.x, q.y);
        let (s, e) = if forward { (p, q) } else { (q, p) };
        let value = s.x * e.y - s.y * e.x;
        let left = value >= 0.0;
        (
            if forward { value } else { -value },
            if forward { left } else { !left },
        )
    };
    let (u, v, w) = (edge(b, c), edge(c, a), edge(a, b));
    if u.1 != v.1 || v.1 != w.1 {
        return None;
    }
    let area = u.0 + v.0 + w.0;
    if area == 0.0 {
        return None;
    }
    let t = (u.0 * a.z + v.0 * b.z + w.0 * c.z) / area;
    // counter-clockwise seen along the ray is seen from inside
    Some((t, area < 0.0))
}

fn check(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Result<(), MeshError> {
    let mut edges = std::collections::BTreeMap::<(u32, u32), (usize, usize)>::new();
    for (index, t) in triangles.iter().enumerate() {
        if let Some(&vertex) = t.iter().find(|&&v| v as usize >= vertices.len()) {
            return Err(MeshError::NoSuchVertex {
                triangle: index,
                vertex,
                vertices: vertices.len(),
            });
        }
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            let uses = edges.entry((a.min(b), a.max(b))).or_default();
            if a < b {
                uses.0 += 1;
            } else {
                uses.1 += 1;
            }
        }
    }
    for ((from, to), (forward, backward)) in edges {
        if (forward, backward) != (1, 1) {
            return Err(MeshError::Open {
                from,
                to,
                forward,
                backward,
            });
        }
    }
    Ok(())
}

/// Splits at the middle triangle along the longest side of the centres' box.
fn build(all: &[[DVec3; 3]], order: &mut [u32], first: usize, nodes: &mut Vec<Node>) {
    let mut bounds = Bounds::EMPTY;
    let mut centres = Bounds::EMPTY;
    for &i in order.iter() {
        let t = all[i as usize];
        for p in t {
            bounds.include(p);
        }
        centres.include((t[0] + t[1] + t[2]) / 3.0);
    }
    bounds.pad(1e-6);
    let own = nodes.len();
    nodes.push(Node {
        bounds,
        from: first as u32,
        to: (first + order.len()) as u32,
    });
    if order.len() <= LEAF {
        return;
    }
    let axis = (centres.high - centres.low).max_position();
    let key = |i: &u32| all[*i as usize].iter().map(|p| p[axis]).sum::<f64>();
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
    let (low, high) = order.split_at_mut(middle);
    build(all, low, first, nodes);
    nodes[own].from = nodes.len() as u32;
    nodes[own].to = 0;
    build(all, high, first + middle, nodes);
}
