//! Uncertainties by trials against those of first order, where the measurement is nearly linear in its inputs, for every kind of value.

use acies::inspect::assign::Surface;
use acies::inspect::measure::{MeasureSettings, MeasuredEdge, measure_edges};
use acies::inspect::monte_carlo::{MonteCarlo, Trials, measure_edges_drawn};
use acies::inspect::result::{BreakShape, EdgeBreak};
use glam::DVec3;

use super::part::{Break, Made};
use super::{SETTINGS, UPRIGHT, cuboid, scan};

/// Both faces are off, so that the total is far from zero, where it has no derivative.
fn off(side: usize, _: DVec3) -> f64 {
    [0.06, -0.05][side]
}

/// Trials of a station; a tenth of them of a break.
const TRIALS: usize = 4000;

/// Four standard deviations of a standard deviation shown by n trials: 1 / sqrt(2 n) each.
fn within(trials: usize) -> f64 {
    4.0 / f64::sqrt(2.0 * trials as f64)
}

fn both(shape: Break) -> (MeasuredEdge, MeasuredEdge, Trials) {
    let solid = cuboid();
    let made = Made::new(&solid, UPRIGHT, &off, shape);
    let cloud = scan(&made, 10.0, 61);
    let mut settings: MeasureSettings = SETTINGS;
    for k in 3..6 {
        settings.pose_covariance[k][k] = 0.001f64.powi(2);
    }
    let surface = Surface::new(&solid);
    let places = surface.places(&cloud, 2.0);
    let how = MonteCarlo::of_trials(TRIALS);
    let given = (&settings, &[][..]);
    let (mut drawn, trials, _) =
        measure_edges_drawn(&cloud, &places, &surface, given, &how, &|_, _| {});
    let mut first = measure_edges(&cloud, &places, &surface, &settings);
    (
        first.swap_remove(UPRIGHT),
        drawn.swap_remove(UPRIGHT),
        trials,
    )
}

fn agree(what: &str, drawn: f64, first: f64, share: f64) {
    let ratio = drawn / first;
    assert!((ratio - 1.0).abs() < share, "{what}: {ratio}");
}

fn breaks<'a>(
    a: &'a MeasuredEdge,
    b: &'a MeasuredEdge,
) -> impl Iterator<Item = (&'a EdgeBreak, &'a EdgeBreak)> {
    assert_eq!(a.breaks.len(), b.breaks.len());
    assert!(!a.breaks.is_empty());
    a.breaks.iter().zip(&b.breaks)
}

#[test]
fn stations_by_trials_have_the_uncertainties_of_first_order() {
    let (first, drawn, trials) = both(Break::Sharp);
    assert_eq!(trials.stations, [TRIALS; 2]);
    let mut seen = 0;
    for (a, b) in first.stations.iter().zip(&drawn.stations) {
        let (Ok(a), Ok(b)) = (&a.outcome, &b.outcome) else {
            continue;
        };
        seen += 1;
        assert_eq!(a.d_mm, b.d_mm, "the values stay");
        let share = within(TRIALS);
        agree("d1", b.u_d_mm[0], a.u_d_mm[0], share);
        agree("d2", b.u_d_mm[1], a.u_d_mm[1], share);
        agree("total", b.total_mm.u, a.total_mm.u, share);
        let (x, y) = (b.u_included_angle_rad, a.u_included_angle_rad);
        agree("angle", x, y, share);
    }
    assert!(seen >= 8, "{seen}");
}

/// 0.3 mm is thirty times the noise: the fit is nearly linear there. The trials redraw points, which first order weighs by their
/// actual residuals: on top of the trials' own scatter the two may differ by the scatter of the noise estimate, 3 % of 600 points.
#[test]
fn a_radius_by_trials_has_the_uncertainty_of_first_order() {
    let (first, drawn, trials) = both(Break::Round(0.3));
    assert_eq!(trials.breaks, TRIALS / 10);
    for (a, b) in breaks(&first, &drawn) {
        let (BreakShape::Round { radius_mm: r }, BreakShape::Round { radius_mm: s }) =
            (a.shape, b.shape)
        else {
            panic!("{a:?} {b:?}")
        };
        assert_eq!(r.value, s.value);
        let share = within(TRIALS / 10) + 0.05;
        agree("radius", s.u, r.u, share);
        let (x, y) = (b.truncation_mm.u, a.truncation_mm.u);
        agree("truncation", x, y, share);
    }
}

#[test]
fn a_chamfer_by_trials_has_the_uncertainties_of_first_order() {
    let (first, drawn, _) = both(Break::Chamfer(0.4, 0.3));
    for (a, b) in breaks(&first, &drawn) {
        let (
            BreakShape::Chamfer {
                legs_mm: legs,
                angle_rad: angle,
            },
            BreakShape::Chamfer {
                legs_mm: again,
                angle_rad: turned,
            },
        ) = (a.shape, b.shape)
        else {
            panic!("{a:?} {b:?}")
        };
        let share = within(TRIALS / 10) + 0.05;
        agree("leg 1", again[0].u, legs[0].u, share);
        agree("leg 2", again[1].u, legs[1].u, share);
        agree("angle", turned.u, angle.u, share);
    }
}

/// The largest of several bins is no linear function of them: the trials may find more, and not less.
#[test]
fn a_burr_by_trials_is_never_surer_than_by_first_order() {
    let (first, drawn, _) = both(Break::Burr(0.15, 0.1));
    for (a, b) in breaks(&first, &drawn) {
        assert!(a.burr_mm.value > 0.1, "{a:?}");
        assert!(b.burr_mm.u >= a.burr_mm.u);
        assert!(
            b.burr_mm.u < 3.0 * a.burr_mm.u,
            "{} {}",
            b.burr_mm.u,
            a.burr_mm.u
        );
    }
}
