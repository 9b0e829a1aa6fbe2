//! What follows from the stations of whole edges - form, corners, gaps - on the same trials as the stations.
//!
//! A trial moves all stations together: the pose, the temperature, a face's calibration and what a scan line shares are one and the same for
//! all of them.

use rayon::prelude::*;

use crate::inspect::corner::{self, Corner, CornerSettings};
use crate::inspect::measure::shift_across;
use crate::inspect::recipe::{GapRecipe, Recipe};
use crate::inspect::result::{CornerResult, EdgeForm, EdgeResult, GapResult, Quantified};
use crate::inspect::verdict::Rule;
use crate::inspect::{Body, BodyEdge, form, gap};

/// Numbers that are kept of all stations together: 128 MB.
const KEPT_MAX: usize = 1 << 24;

/// Trials that one task adds up; fixed, so that sums do not depend on the number of threads.
const TASK: usize = 50;

/// d1 and d2 of every station in its first trials.
#[derive(Debug, Clone, Default)]
pub struct StationTrials {
    trials: usize,
    /// By edge and station, one pair a trial, mm; empty where the station was not measured.
    d_mm: Vec<Vec<Vec<[f64; 2]>>>,
}

/// What the derived values are made from, beside the stations.
pub(in crate::inspect) struct Derivation<'a, B: Body> {
    pub(in crate::inspect) body: &'a B,
    pub(in crate::inspect) edges: &'a [BodyEdge],
    pub(in crate::inspect) recipe: &'a Recipe,
    pub(in crate::inspect) corners: &'a [Corner],
    pub(in crate::inspect) corner_settings: CornerSettings<'a>,
    /// Every gap of the recipe that has two edges, with their indices.
    pub(in crate::inspect) gaps: &'a [(&'a GapRecipe, [usize; 2])],
}

impl StationTrials {
    /// How many trials are kept of each of `stations` where `wanted` are asked for.
    pub(super) fn count(wanted: usize, stations: usize) -> usize {
        wanted.min(KEPT_MAX / (2 * stations.max(1))).max(2)
    }

    pub(super) fn new(trials: usize) -> Self {
        Self {
            trials,
            d_mm: Vec::new(),
        }
    }

    pub(super) fn push(&mut self, edge: Vec<Vec<[f64; 2]>>) {
        self.d_mm.push(edge);
    }

    /// How many there are.
    pub fn trials(&self) -> usize {
        self.trials
    }

    /// Gives `forms`, `corners` and `gaps`, which follow from `results`, the uncertainties that the trials show.
    ///
    /// What cannot fall below zero is drawn to one side of its value where that is small: the uncertainty is that about the value.
    pub(in crate::inspect) fn take_over<B: Body>(
        &self,
        derivation: &Derivation<'_, B>,
        results: &[EdgeResult],
        (corners, gaps): (&mut [CornerResult], &mut [GapResult]),
    ) -> Vec<Option<EdgeForm>> {
        let tasks: Vec<usize> = (0..self.trials).step_by(TASK).collect();
        let sums: Vec<Sums> = tasks
            .into_par_iter()
            .map(|first| {
                let mut moved = results.to_vec();
                let mut sums = Sums::default();
                for t in first..(first + TASK).min(self.trials) {
                    self.put(t, results, &mut moved);
                    sums.add(&values(derivation, &moved));
                }
                sums
            })
            .collect();
        let sums = sums.into_iter().reduce(Sums::merge).unwrap_or_default();
        let mut forms: Vec<Option<EdgeForm>> = results.iter().map(|r| r.form).collect();
        let quantities = quantities(&mut forms, corners, gaps);
        for (quantity, sum) in quantities.into_iter().zip(sums.0) {
            if let Some(quantity) = quantity
                && let Some(u) = sum.u_about(quantity.value)
            {
                quantity.u = u;
            }
        }
        forms
    }

    /// Moves every station of `moved` to where trial `t` has it.
    fn put(&self, t: usize, results: &[EdgeResult], moved: &mut [EdgeResult]) {
        for ((drawn, own), to) in self.d_mm.iter().zip(results).zip(moved) {
            let stations = drawn.iter().zip(&own.stations).zip(&mut to.stations);
            for ((drawn, own), to) in stations {
                let (Some(d), Some(own), Some(measured)) =
                    (drawn.get(t), &own.measured, &mut to.measured)
                else {
                    continue;
                };
                let change = [d[0] - own.d_mm[0], d[1] - own.d_mm[1]];
                measured.d_mm = *d;
                measured.point = own.point + shift_across(&to.station, change);
            }
        }
    }
}

/// Every derived value, always as many and in the same order; `None` where one does not come about.
fn quantities<'q>(
    forms: &'q mut [Option<EdgeForm>],
    corners: &'q mut [CornerResult],
    gaps: &'q mut [GapResult],
) -> Vec<Option<&'q mut Quantified>> {
    let mut quantities = Vec::new();
    for form in forms {
        quantities.extend(match form {
            None => [None, None, None, None],
            Some(form) => [
                form.straightness_mm.as_mut(),
                Some(&mut form.line_profile_mm),
                form.line_form_mm.as_mut(),
                form.direction_rad.as_mut().map(|(value, _)| value),
            ],
        });
    }
    quantities.extend(corners.iter_mut().map(|corner| corner.total_mm.as_mut()));
    for station in gaps.iter_mut().flat_map(|gap| &mut gap.stations) {
        quantities.push(Some(&mut station.gap_mm));
        quantities.push(Some(&mut station.flush_mm));
    }
    quantities
}

/// The derived values of one trial.
fn values<B: Body>(derivation: &Derivation<'_, B>, moved: &[EdgeResult]) -> Vec<Option<f64>> {
    let form = |edge: &EdgeResult| form::form(&edge.stations, derivation.recipe.direction_mm);
    let mut forms: Vec<Option<EdgeForm>> = moved.iter().map(form).collect();
    let mut corners = corner::measure(
        derivation.body,
        derivation.corners,
        (derivation.edges, moved),
        &derivation.corner_settings,
    );
    let gap = |(recipe, [a, b]): &(&GapRecipe, [usize; 2])| {
        gap::measure(recipe, [&moved[*a], &moved[*b]], Rule::Simple)
    };
    let mut gaps: Vec<GapResult> = derivation.gaps.iter().map(gap).collect();
    let quantities = quantities(&mut forms, &mut corners, &mut gaps);
    quantities.into_iter().map(|q| q.map(|q| q.value)).collect()
}

/// Count, mean and sum of squared distances from it, of one value over trials.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    count: f64,
    mean: f64,
    squares: f64,
}

impl Sum {
    fn add(&mut self, value: f64) {
        self.count += 1.0;
        let off = value - self.mean;
        self.mean += off / self.count;
        self.squares += off * (value - self.mean);
    }

    fn merge(self, other: Self) -> Self {
        let count = self.count + other.count;
        if count == 0.0 {
            return self;
        }
        let off = other.mean - self.mean;
        Self {
            count,
            mean: self.mean + off * other.count / count,
            squares: self.squares + other.squares + off * off * self.count * other.count / count,
        }
    }

    /// Root mean square distance of the trials from `value`; `None` for fewer than two.
    fn u_about(&self, value: f64) -> Option<f64> {
        let variance = self.squares / (self.count - 1.0);
        (self.count > 1.0).then(|| variance.sqrt().hypot(self.mean - value))
    }
}

#[derive(Debug, Clone, Default)]
struct Sums(Vec<Sum>);

impl Sums {
    fn add(&mut self, values: &[Option<f64>]) {
        self.0
            .resize(values.len().max(self.0.len()), Sum::default());
        for (sum, value) in self.0.iter_mut().zip(values) {
            if let Some(value) = value.filter(|v| v.is_finite()) {
                sum.add(value);
            }
        }
    }

    fn merge(self, other: Self) -> Self {
        let pairs = self.0.into_iter().zip(other.0);
        Self(pairs.map(|(a, b)| a.merge(b)).collect())
    }
}
