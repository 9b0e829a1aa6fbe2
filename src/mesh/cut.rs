//! The cheapest parting of a graph into two sides: its least cut, which is its greatest flow (Dinic, *Algorithm for solution of a problem of maximum
//! flow in networks with power estimation*, 1970).

use std::collections::VecDeque;

const NONE: u32 = u32::MAX;

/// Nodes that prefer one of the two sides, and what it costs to part them from one another.
pub(super) struct Cut {
    /// For every node how much more the second side costs it than the first; less where it is negative.
    bias: Vec<f64>,
    /// For every node its last edge.
    heads: Vec<u32>,
    edges: Vec<Edge>,
}

/// One way of an edge; the way back stands beside it.
struct Edge {
    to: u32,
    /// The edge before of the same node.
    next: u32,
    room: f64,
}

impl Cut {
    pub fn new(nodes: usize) -> Self {
        Self {
            bias: vec![0.0; nodes],
            heads: vec![NONE; nodes],
            edges: Vec::new(),
        }
    }

    /// What it costs to have `a` and `b` on different sides; not negative.
    pub fn join(&mut self, a: u32, b: u32, cost: f64) {
        for (from, to) in [(a, b), (b, a)] {
            let next = self.heads[from as usize];
            self.heads[from as usize] = self.edges.len() as u32;
            self.edges.push(Edge {
                to,
                next,
                room: cost,
            });
        }
    }

    /// What the node costs more on the second side than on the first.
    pub fn prefer(&mut self, node: u32, cost: f64) {
        self.bias[node as usize] += cost;
    }

    /// Which nodes are on the first side of the cheapest parting; of equals, the one with the most there.
    pub fn cheapest(mut self) -> Vec<bool> {
        let mut depth = vec![NONE; self.bias.len()];
        while self.measure(&mut depth) {
            let mut at = self.heads.clone();
            for v in 0..self.bias.len() as u32 {
                while self.bias[v as usize] > 0.0 && self.push(v, &depth, &mut at) {}
            }
        }
        depth.into_iter().map(|d| d == NONE).collect()
    }

    /// How many edges each node is from one that has room on the second side; whether one with flow to spare is among them.
    fn measure(&self, depth: &mut [u32]) -> bool {
        depth.fill(NONE);
        let mut queue: VecDeque<u32> = VecDeque::new();
        for (v, bias) in self.bias.iter().enumerate() {
            if *bias < 0.0 {
                depth[v] = 0;
                queue.push_back(v as u32);
            }
        }
        let mut is_reached = false;
        while let Some(v) = queue.pop_front() {
            is_reached |= self.bias[v as usize] > 0.0;
            let mut e = self.heads[v as usize];
            while e != NONE {
                let edge = &self.edges[e as usize];
                let back = &self.edges[e as usize ^ 1];
                if depth[edge.to as usize] == NONE && back.room > 0.0 {
                    depth[edge.to as usize] = depth[v as usize] + 1;
                    queue.push_back(edge.to);
                }
                e = edge.next;
            }
        }
        is_reached
    }

    /// Sends what fits along a shortest way from `source`; whether there was one. `at` is the edge of each node that is looked at next.
    fn push(&mut self, source: u32, depth: &[u32], at: &mut [u32]) -> bool {
        let mut way: Vec<u32> = Vec::new();
        let mut v = source;
        while self.bias[v as usize] >= 0.0 {
            let e = at[v as usize];
            if e == NONE {
                // A blind alley: back, and past it.
                let Some(last) = way.pop() else { return false };
                v = self.edges[last as usize ^ 1].to;
                at[v as usize] = self.edges[last as usize].next;
                continue;
            }
            let Edge { to, next, room } = self.edges[e as usize];
            let below = depth[to as usize];
            let is_down = below != NONE && below + 1 == depth[v as usize];
            if room > 0.0 && is_down {
                way.push(e);
                v = to;
            } else {
                at[v as usize] = next;
            }
        }
        let most = self.bias[source as usize].min(-self.bias[v as usize]);
        let most = way
            .iter()
            .fold(most, |m, e| m.min(self.edges[*e as usize].room));
        for e in way {
            self.edges[e as usize].room -= most;
            self.edges[e as usize ^ 1].room += most;
        }
        self.bias[source as usize] -= most;
        self.bias[v as usize] += most;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_parting_of_small_graphs_is_cheaper() {
        const NODES: usize = 8;
        let mut state = 7u64;
        // Numerical Recipes' generator; small whole numbers, so that costs are exact and ties common.
        let mut random = |below: u64| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below
        };
        for _ in 0..200 {
            let bias: Vec<f64> = (0..NODES).map(|_| random(13) as f64 - 6.0).collect();
            let edges: Vec<(usize, usize, f64)> = (0..14)
                .map(|_| (random(8) as usize, random(8) as usize, random(6) as f64))
                .filter(|(a, b, _)| a != b)
                .collect();
            let cost = |is_first: &dyn Fn(usize) -> bool| -> f64 {
                let own = (0..NODES).map(|v| if is_first(v) { -bias[v] } else { bias[v] } / 2.0);
                let cuts = edges
                    .iter()
                    .filter(|(a, b, _)| is_first(*a) != is_first(*b));
                own.sum::<f64>() + cuts.map(|e| e.2).sum::<f64>()
            };
            let least = (0..1u32 << NODES)
                .map(|set| cost(&|v| set >> v & 1 == 1))
                .fold(f64::INFINITY, f64::min);
            let mut graph = Cut::new(NODES);
            for (v, b) in bias.iter().enumerate() {
                graph.prefer(v as u32, *b);
            }
            for (a, b, c) in &edges {
                graph.join(*a as u32, *b as u32, *c);
            }
            let found = graph.cheapest();
            assert_eq!(cost(&|v| found[v]), least, "{bias:?} {edges:?}");
        }
    }
}
