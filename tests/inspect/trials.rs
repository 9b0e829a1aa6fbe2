//! Form, corners and gaps by trials against first order, where these values are linear in their inputs.

use acies::inspect::monte_carlo::MonteCarlo;
use acies::inspect::result::{Inspection, Quantified};
use acies::inspect::{Recipe, Request, Start, Uncertainty, inspect};
use acies::points::PointCloud;
use glam::{DVec2, DVec3};

use super::SIGMA;
use super::solids::{Made, Noise, Solid};
use super::whole::{SLOT, slot_edge};

const TRIALS: usize = 4000;

/// Five standard deviations of a standard deviation shown by a tenth of the trials: 1 / sqrt(2 n) each.
const WITHIN: f64 = 0.18;

/// The slotted block of which every face is out by 0.1 mm, far from where a distance has no derivative.
fn slot() -> (Solid, PointCloud) {
    let outline: Vec<DVec2> = SLOT.iter().copied().map(DVec2::from).collect();
    let mut solid = Solid::prism(&outline, 25.0);
    for made in &mut solid.made {
        *made = Made {
            offset: 0.1,
            gradient: DVec3::ZERO,
        };
    }
    let seen: Vec<u32> = (1..10).collect();
    let cloud = solid.scan(&seen, SIGMA, &mut Noise(71));
    (solid, cloud)
}

fn both(solid: &Solid, cloud: &PointCloud, text: &str) -> [Inspection; 2] {
    let recipe = Recipe::parse(text).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    let ways = [
        Uncertainty::FirstOrder,
        Uncertainty::MonteCarlo(MonteCarlo::of_trials(TRIALS)),
    ];
    ways.map(|uncertainty| {
        let request = Request {
            uncertainty,
            ..Request::new(&recipe, Start::None)
        };
        inspect(cloud, solid, &request)
    })
}

fn agree(what: &str, first: Quantified, drawn: Quantified) {
    assert_eq!(first.value, drawn.value, "{what}: the values stay");
    let ratio = drawn.u / first.u;
    assert!((ratio - 1.0).abs() < WITHIN, "{what}: {ratio}");
}

#[test]
fn corners_gaps_and_profiles_by_trials_have_the_uncertainties_of_first_order() {
    let (solid, cloud) = slot();
    // A calibration that outweighs the noise: the worst of many stations is then none of many, but what they share.
    let text = format!(
        "u_calibration_mm = 0.02\n[[gap]]\nname = \"slot\"\nedges = [\"{}\", \"{}\"]\ngap_mm = [9.0, 11.0]\n",
        slot_edge(&solid, 10.0),
        slot_edge(&solid, 20.0)
    );
    let [first, drawn] = both(&solid, &cloud, &text);
    assert_eq!(drawn.trials.expect("trials").derived, TRIALS / 10);
    let mut seen = [0; 3];
    for (a, b) in first.corners.iter().zip(&drawn.corners) {
        let (Some(a), Some(b)) = (a.total_mm, b.total_mm) else {
            continue;
        };
        agree("corner", a, b);
        seen[0] += 1;
    }
    assert_eq!((first.gaps.len(), drawn.gaps.len()), (1, 1));
    assert_eq!(drawn.gaps[0].verdict, first.gaps[0].verdict);
    for (a, b) in first.gaps[0].stations.iter().zip(&drawn.gaps[0].stations) {
        agree("gap", a.gap_mm, b.gap_mm);
        agree("flush", a.flush_mm, b.flush_mm);
        seen[1] += 1;
    }
    for (a, b) in first.edges.iter().zip(&drawn.edges) {
        let (Some(a), Some(b)) = (&a.form, &b.form) else {
            continue;
        };
        agree("line profile", a.line_profile_mm, b.line_profile_mm);
        seen[2] += 1;
    }
    assert!(seen[0] >= 8 && seen[1] >= 10 && seen[2] >= 8, "{seen:?}");
}

/// The made edges are straight: what is measured of them is noise, which only trials see for what it is.
#[test]
fn the_straightness_of_a_straight_edge_is_within_its_uncertainty_of_zero() {
    let (solid, cloud) = slot();
    let [first, drawn] = both(&solid, &cloud, "");
    let straightness = |inspection: &Inspection| -> Vec<Quantified> {
        let forms = inspection.edges.iter().filter_map(|e| e.form);
        forms.filter_map(|form| form.straightness_mm).collect()
    };
    let [first, drawn] = [straightness(&first), straightness(&drawn)];
    assert!(drawn.len() >= 8 && first.len() == drawn.len());
    for (a, b) in first.iter().zip(&drawn) {
        assert_eq!(a.value, b.value);
        assert!(b.u >= a.u * (1.0 - WITHIN), "{a:?} {b:?}");
        assert!(b.value < 3.0 * b.u, "{b:?}");
    }
}
