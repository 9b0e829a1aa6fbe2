//! The uncertainty of an edge break by drawing: new noise on its points and on its flanks, and the same shape fitted again.
//!
//! Source: JCGM 101:2008, 5.9. The points are drawn about the shape that was found, the flanks from their covariance. What shape it is is
//! kept from the measurement. Sizes that follow from a radius or from legs are scaled with these; those of an irregular or
//! undecided stretch keep their first-order uncertainty.

use super::fit::Fitted;
use super::{Analysis, Found, Quantified, Stretch, WedgePoint, Zone, larger};
use crate::inspect::monte_carlo::Draws;
use crate::inspect::result::{BreakShape, EdgeBreak};

/// A break with its uncertainties by drawing.
pub(in crate::inspect) struct DrawnBreak {
    pub(in crate::inspect) shape: EdgeBreak,
    /// Trials drawn.
    pub(in crate::inspect) trials: usize,
}

/// As [`super::measure_stretch`], with uncertainties from `trials` draws of `seed`.
pub(in crate::inspect) fn draw_stretch(
    stretch: &Stretch<'_>,
    seed: u64,
    trials: usize,
) -> Option<DrawnBreak> {
    let analysis = Analysis::new(stretch)?;
    let Found { shape, .. } = analysis.found()?;
    let mut drawn = DrawnBreak { shape, trials: 0 };
    let mut burrs = Vec::with_capacity(trials);
    let mut sizes: [Vec<f64>; 3] = Default::default();
    for t in 0..trials {
        let mut draws = Draws::new(seed, t as u64);
        if !analysis.irregular
            && let Some(values) = analysis.size_again(&mut draws)
        {
            for (list, value) in sizes.iter_mut().zip(values) {
                list.push(value);
            }
        }
        burrs.push(larger(analysis.profile.excess_again(&mut draws)).value);
        drawn.trials += 1;
    }
    let shape = &mut drawn.shape;
    if shape.burr_mm.value > 0.0 && stretch.convex {
        shape.burr_mm.u = shape.burr_mm.u.max(about(&burrs, shape.burr_mm.value));
    }
    if analysis.irregular || sizes[0].len() * 2 < trials {
        return Some(drawn);
    }
    let scaled = |q: Quantified, by: f64| Quantified { u: q.u * by, ..q };
    match &mut shape.shape {
        BreakShape::Round { radius_mm } => {
            let u = about(&sizes[0], radius_mm.value);
            let by = u / radius_mm.u;
            radius_mm.u = u;
            shape.detachment_mm = shape.detachment_mm.map(|q| scaled(q, by));
            shape.truncation_mm = scaled(shape.truncation_mm, by);
            if stretch.convex {
                shape.undercut_mm = shape.undercut_mm.map(|q| scaled(q, by));
            }
        }
        BreakShape::Chamfer { legs_mm, angle_rad } => {
            let by = [0, 1].map(|i| about(&sizes[i], legs_mm[i].value) / legs_mm[i].u);
            angle_rad.u = about(&sizes[2], angle_rad.value);
            for i in 0..2 {
                legs_mm[i] = scaled(legs_mm[i], by[i]);
                shape.detachment_mm[i] = scaled(shape.detachment_mm[i], by[i]);
                if stretch.convex {
                    // What flank 1 lacks is missing below flank 2.
                    shape.undercut_mm[1 - i] = scaled(shape.undercut_mm[1 - i], by[i]);
                }
            }
            shape.truncation_mm = scaled(shape.truncation_mm, by[0].max(by[1]));
        }
        BreakShape::Sharp { .. } | BreakShape::Undecided { .. } | BreakShape::Irregular => {}
    }
    Some(drawn)
}

/// Root mean square of the trials about the estimate: their spread and their bias.
fn about(values: &[f64], estimate: f64) -> f64 {
    let squares: f64 = values.iter().map(|v| (v - estimate).powi(2)).sum();
    (squares / values.len().max(1) as f64).sqrt()
}

impl Analysis<'_> {
    /// Radius, or legs and angle, of one trial.
    fn size_again(&self, draws: &mut Draws) -> Option<[f64; 3]> {
        match &self.fitted {
            Fitted::Sharp { .. } => None,
            Fitted::Undecided { .. } => None,
            Fitted::Round { radius } => {
                let [radius] = self.zone.again(self, draws).descend([radius.value])?;
                Some([radius, 0.0, 0.0])
            }
            Fitted::Chamfer { legs, .. } => {
                let zone = self.zone.again(self, draws);
                let [a, b] = zone.descend(*legs)?;
                let angle = super::chamfer_angle([a, b], std::f64::consts::PI - zone.turn);
                Some([a, b, angle])
            }
        }
    }
}

impl<'a> Zone<'a> {
    /// The zone with every point drawn about the shape that was found, and the flanks drawn from their covariance.
    fn again(&self, analysis: &Analysis<'_>, draws: &mut Draws) -> Zone<'a> {
        let shape = analysis.fitted.shape();
        let moves: Vec<[[f64; 2]; 2]> = self
            .stretch
            .wedges
            .iter()
            .map(|wedge| {
                [0, 1].map(|i| {
                    let scale = self.stretch.shared_factor[i].max(0.0).sqrt();
                    correlated(&wedge.flanks[i].covariance, draws).map(|x| scale * x)
                })
            })
            .collect();
        let turns: Vec<f64> = self
            .turns
            .iter()
            .zip(&moves)
            .map(|(turn, m)| turn - self.sign * (m[0][1] + m[1][1]))
            .collect();
        let points = self
            .points
            .iter()
            .map(|q| {
                let turn = self.turns[q.wedge];
                let noise = self.sigma * draws.normal();
                let shift = noise - shape.distance(q.d, turn);
                let step = 1e-6;
                let by = [0, 1].map(|i| {
                    let mut d = [q.d, q.d];
                    d[0][i] += step;
                    d[1][i] -= step;
                    (shape.distance(d[0], turn) - shape.distance(d[1], turn)) / (2.0 * step)
                });
                let along = move_of(by, turn, shift);
                let d = [0, 1].map(|i| {
                    let [offset, tilt] = moves[q.wedge][i];
                    q.d[i] + along[i] - self.sign * (offset + q.r[i] * tilt)
                });
                WedgePoint { d, ..*q }
            })
            .collect();
        Zone {
            points,
            stretch: self.stretch,
            turn: turns.iter().sum::<f64>() / turns.len() as f64,
            turns,
            reach: self.reach,
            sigma: self.sigma,
            sign: self.sign,
        }
    }
}

/// How the heights change where a point moves by `shift` along the gradient of a distance whose derivatives by the heights are `by`.
fn move_of(by: [f64; 2], turn: f64, shift: f64) -> [f64; 2] {
    // Heights are d_i = n_i . p with n_1 . n_2 = cos(turn); the gradient in space is by_1 n_1 + by_2 n_2, of length 1.
    let c = turn.cos();
    [shift * (by[0] + c * by[1]), shift * (c * by[0] + by[1])]
}

/// Two normal numbers with this covariance.
fn correlated(c: &[[f64; 2]; 2], draws: &mut Draws) -> [f64; 2] {
    let (x, y) = (draws.normal(), draws.normal());
    let a = c[0][0].max(0.0).sqrt();
    let b = if a > 0.0 { c[0][1] / a } else { 0.0 };
    let rest = (c[1][1] - b * b).max(0.0).sqrt();
    [a * x, b * x + rest * y]
}
