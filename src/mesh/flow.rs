//! The least cut of a graph between two sides (Dinic 1970).

use std::collections::VecDeque;

const NONE: u32 = u32::MAX;

/// A graph of nodes, each joined to others and to one of the two sides.
pub(super) struct Flow {
    /// What a node still has for the first side when positive, for the second when negative.
    bias: Vec<f64>,
    heads: Vec<u32>,
    /// Node at the far end, next edge of the near end, room left; the way back is the edge beside.
    edges: Vec<(u32, u32, f64)>,
}

impl Flow {
    pub fn new(nodes: usize) -> Self {
        Self {
            bias: vec![0.0; nodes],
            heads: vec![NONE; nodes],
            edges: Vec::new(),
        }
    }

    /// What it costs to have two nodes on different sides.
    pub fn join(&mut self, a: u32, b: u32, cost: f64) {
        for (from, to) in [(a, b), (b, a)] {
            self.edges.push((to, self.heads[from as usize], cost));
            self.heads[from as usize] = self.edges.len() as u32 - 1;
        }
    }

    /// What it costs to have the node on the second side, when positive, or on the first.
    pub fn terminal(&mut self, node: u32, cost: f64) {
        self.bias[node as usize] += cost;
    }

    /// Which nodes are on the first side of the cheapest parting: as many as can be.
    pub fn cut(mut self) -> Vec<bool> {
        let count = self.bias.len();
        let mut depth = vec![NONE; count];
        let mut queue = VecDeque::new();
        let mut at = vec![NONE; count];
        loop {
            // Depths from the sinks, backwards.
            depth.fill(NONE);
            queue.clear();
            for v in 0..count as u32 {
                if self.bias[v as usize] < 0.0 {
                    depth[v as usize] = 0;
                    queue.push_back(v);
                }
            }
            let mut reached = false;
            while let Some(v) = queue.pop_front() {
                reached |= self.bias[v as usize] > 0.0;
                let mut e = self.heads[v as usize];
                while e != NONE {
                    let (u, next, _) = self.edges[e as usize];
                    if depth[u as usize] == NONE && self.edges[e as usize ^ 1].2 > 0.0 {
                        depth[u as usize] = depth[v as usize] + 1;
                        queue.push_back(u);
                    }
                    e = next;
                }
            }
            if !reached {
                return depth.into_iter().map(|d| d == NONE).collect();
            }
            at.copy_from_slice(&self.heads);
            for v in 0..count as u32 {
                while self.bias[v as usize] > 0.0 && depth[v as usize] != NONE {
                    if !self.push(v, &depth, &mut at) {
                        break;
                    }
                }
            }
        }
    }

    /// Pushes along one shortest way from `source`; whether there was one.
    fn push(&mut self, source: u32, depth: &[u32], at: &mut [u32]) -> bool {
        let mut way: Vec<u32> = Vec::new();
        let mut v = source;
        loop {
            if self.bias[v as usize] < 0.0 {
                let least = way.iter().map(|e| self.edges[*e as usize].2);
                let most = least.fold(self.bias[source as usize].min(-self.bias[v as usize]), f64::min);
                for e in &way {
                    self.edges[*e as usize].2 -= most;
                    self.edges[*e as usize ^ 1].2 += most;
                }
                self.bias[source as usize] -= most;
                self.bias[v as usize] += most;
                return true;
            }
            let e = at[v as usize];
            if e == NONE {
                // A blind alley: back, and past it.
                let Some(back) = way.pop() else { return false };
                v = self.edges[back as usize ^ 1].0;
                at[v as usize] = self.edges[back as usize].1;
                continue;
            }
            let (u, next, room) = self.edges[e as usize];
            if room > 0.0 && depth[u as usize] != NONE && depth[u as usize] + 1 == depth[v as usize] {
                way.push(e);
                v = u;
            } else {
                at[v as usize] = next;
            }
        }
    }
}
