//! What an inspection is asked to judge: limits, decision rule, datums, calibration, environment. As plain values, and read from TOML.
//!
//! ```toml
//! rule = { guard_band = 2.0 }       # or "simple", the default, or { conformance = 0.95 }, in the manner of ISO 14253-1
//! datum_faces = [17, 45, 61]        # STEP entities; the faces of the best fit, without them all
//! limits_from_pmi = true            # tolerances in the nominal's PMI count before [limits] and after [[edge]]; the default is false
//! minimum_coverage = 0.9            # an edge measured over less is not decidable
//! missing_edges = "not_ok"          # of edges with limits, the default; or "report"
//! unexpected_edges = "report"       # the default; or "not_ok"
//! station_step_mm = 1.0             # without it derived from the data
//! flank_mm = 2.0                    # depth of the flanks; without it derived from the data
//! depth_mm = 0.5                    # depth at which the edge is given as well; without it only the virtual edge
//! hold = ["turn_z"]                 # directions in which the part stays as its fixture holds it: turn_x ... shift_z
//! direction_mm = 5.0                # length over which a direction is taken; without it five stations
//! u_calibration_mm = 0.002          # standard uncertainty of a flank's place from the sensor's calibration
//! u_calibration_rad = 0.0           # and of the included angle
//!
//! [[alignment.datum]]               # features that the pose rests on; without them the best fit stands
//! name = "A"                        # optional
//! faces = [17]                      # STEP entities: one plane, cylinder, cone or sphere
//! priority = 1                      # the default; 1 holds first, 2 and 3 what it leaves free
//!
//! [[alignment.datum]]               # a reference point (RPS)
//! name = "B1"
//! point_mm = [10.0, 0.0, 5.0]       # on the nominal, in the part frame
//! direction = [0.0, -1.0, 0.0]      # what it holds; without it the normal of the face there
//! radius_mm = 1.5                   # of the patch that is measured; without it some fifty points
//! priority = 2
//!
//! [[alignment.datum]]
//! pmi = "C"                         # the datum feature with this letter in the nominal's PMI
//! priority = 3
//!
//! [environment]
//! temperature_c = [18.0, 22.0]      # outside of it, or where nobody says the temperature, nothing is decided
//!
//! [expansion]                       # of the part; the scan is corrected to 20 degrees
//! coefficient_per_k = 11.5e-6
//! u_coefficient_per_k = 1.0e-6
//! u_temperature_k = 0.5
//!
//! [limits]                          # of every edge; without limits a value is not evaluated
//! d_mm = [-0.1, 0.1]                # of d1 and d2; d1_mm and d2_mm name one
//! included_angle_deg = [-0.5, 0.5]  # of the deviation from the nominal included angle
//! burr_mm = 0.05                    # one number: the upper limit of what cannot be negative
//! corner_mm = 0.1                   # of the distance of every corner from its nominal place
//!
//! [[edge]]                          # for all edges between these angles ...
//! turn_angle_deg = [80.0, 100.0]    # or kind = "convex", or box_mm = [[0, 0, 0], [50, 20, 5]] with the whole edge in it
//! radius_mm = [0.1, 0.3]
//!
//! [[edge]]                          # ... and more for one: what is given later counts
//! entity = 123                      # the STEP entity of the edge, or: id = "e4", or: faces = [17, 45], its two faces
//! name = "sealing lip"              # optional
//! station_step_mm = 0.5
//! d_mm = [-0.05, 0.02]              # what is not given here holds as above
//!
//! [[edge]]
//! id = "e7"
//! judged = false                    # nothing of it is evaluated; the default is true
//!
//! [[gap]]                           # between two edges
//! name = "door"
//! edges = ["e1", 123]               # ids or STEP entities
//! gap_mm = [2.8, 3.2]
//! flush_mm = [-0.2, 0.2]
//! ```

mod read;

use glam::DVec3;

pub use super::quantity::Limits;
pub use super::verdict::Rule;
use crate::nominal::EdgeKind;

/// What an inspection is asked to judge.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// SHA-256 of the text it was read from, in hexadecimal, as `sha256sum` prints it; empty for one that was not read.
    pub sha256: String,
    /// How the uncertainty counts.
    pub rule: Rule,
    /// Limits of every edge for which `edges` says nothing else.
    pub limits: Limits,
    /// Whether tolerances in the nominal's PMI count as limits, before those of every edge and after those of `edges`.
    pub limits_from_pmi: bool,
    /// Largest distance of a corner from its nominal place, mm; `None` = not evaluated.
    pub corner_mm: Option<f64>,
    /// Edges with a name, limits or a step of their own, or out of judgement. Later entries count over earlier ones.
    pub edges: Vec<EdgeRecipe>,
    /// Gaps between edges.
    pub gaps: Vec<GapRecipe>,
    /// STEP entities of the faces of the best fit; empty = all faces.
    pub datum_faces: Vec<u64>,
    /// Features that the pose rests on; empty = the best fit stands.
    pub datums: Vec<DatumRecipe>,
    /// Share of an edge's length that must be measured for the edge to be decidable, 0 to 1.
    pub minimum_coverage: f64,
    /// Whether a missing edge that has limits makes the part not OK.
    pub missing_edges_count: bool,
    /// Whether an edge that the nominal does not have makes the part not OK.
    pub unexpected_edges_count: bool,
    /// Distance of the stations, mm; `None` = derived from the data.
    pub station_step_mm: Option<f64>,
    /// Depth of the flanks, mm; `None` = derived from the data.
    pub flank_mm: Option<f64>,
    /// Depth at which the edge is given as well, mm; `None` = not.
    pub depth_mm: Option<f64>,
    /// Turns about x, y, z and shifts along x, y, z in which the start's pose stays.
    pub held: [bool; 6],
    /// Length over which the direction of an edge is taken, mm; `None` = five stations.
    pub direction_mm: Option<f64>,
    /// Standard uncertainty of d from the calibration of the sensor, mm.
    pub u_calibration_mm: f64,
    /// Standard uncertainty of the included angle from the calibration of the sensor, rad.
    pub u_calibration_rad: f64,
    /// Temperatures of the part at which it may be judged, degrees Celsius; `None` = any.
    pub temperature_c: Option<[f64; 2]>,
    /// Thermal expansion of the part; `None` = not corrected.
    pub expansion: Option<Expansion>,
}

/// Thermal expansion of the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expansion {
    /// Linear coefficient, 1/K.
    pub coefficient_per_k: f64,
    /// Its standard uncertainty, 1/K.
    pub u_coefficient_per_k: f64,
    /// Standard uncertainty of the part's temperature, K.
    pub u_temperature_k: f64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            sha256: String::new(),
            rule: Rule::Simple,
            limits: Limits::default(),
            limits_from_pmi: false,
            corner_mm: None,
            edges: Vec::new(),
            gaps: Vec::new(),
            datum_faces: Vec::new(),
            datums: Vec::new(),
            minimum_coverage: 0.9,
            missing_edges_count: true,
            unexpected_edges_count: false,
            station_step_mm: None,
            flank_mm: None,
            depth_mm: None,
            held: [false; 6],
            direction_mm: None,
            u_calibration_mm: 0.0,
            u_calibration_rad: 0.0,
            temperature_c: None,
            expansion: None,
        }
    }
}

/// Which edges an entry of the recipe means: those to which all that is given applies.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Select {
    /// Its STEP entity.
    pub entity: Option<u64>,
    /// Its id, `e1` ...
    pub id: Option<String>,
    /// The STEP entities of its two faces, in either order.
    pub faces: Option<[u64; 2]>,
    /// The whole edge lies in this box, mm: lowest and highest corner.
    pub box_mm: Option<[DVec3; 2]>,
    /// The turn angle lies between these along the whole edge, rad.
    pub turn_angle_rad: Option<[f64; 2]>,
    /// Convex or concave.
    pub kind: Option<EdgeKind>,
}

/// What an edge is selected by.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeFacts {
    /// Its id.
    pub id: String,
    /// Its STEP entity.
    pub entity: u64,
    /// The STEP entities of its faces.
    pub faces: [u64; 2],
    /// Convex or concave.
    pub kind: EdgeKind,
    /// Lowest and highest coordinates, mm.
    pub box_mm: [DVec3; 2],
    /// Smallest and largest turn angle along it, rad.
    pub turn_angle_rad: [f64; 2],
}

impl Select {
    /// Whether this means `edge`.
    pub fn means(&self, edge: &EdgeFacts) -> bool {
        let [low, high] = edge.box_mm;
        let [least, most] = edge.turn_angle_rad;
        self.entity.is_none_or(|entity| entity == edge.entity)
            && self.id.as_ref().is_none_or(|id| *id == edge.id)
            && self
                .faces
                .is_none_or(|[a, b]| [a, b] == edge.faces || [b, a] == edge.faces)
            && self
                .box_mm
                .is_none_or(|[l, h]| low.cmpge(l).all() && high.cmple(h).all())
            && self
                .turn_angle_rad
                .is_none_or(|[l, h]| least >= l && most <= h)
            && self.kind.is_none_or(|kind| kind == edge.kind)
    }

    /// In words, for a finding.
    pub fn words(&self) -> String {
        let mut words = Vec::new();
        words.extend(self.entity.map(|entity| format!("#{entity}")));
        words.extend(self.id.as_ref().map(|id| format!("{id:?}")));
        words.extend(
            self.faces
                .map(|[a, b]| format!("the edge of faces #{a} and #{b}")),
        );
        words.extend(
            self.box_mm
                .map(|[l, h]| format!("an edge in the box {} to {} mm", l, h)),
        );
        words.extend(self.turn_angle_rad.map(|[l, h]| {
            let (l, h) = (l.to_degrees(), h.to_degrees());
            format!("an edge that turns by {l:.1} to {h:.1} degrees")
        }));
        words.extend(self.kind.map(|kind| match kind {
            EdgeKind::Convex => "a convex edge".to_owned(),
            EdgeKind::Concave => "a concave edge".to_owned(),
        }));
        words.join(", ")
    }
}

/// What the recipe says of the edges that one entry means.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EdgeRecipe {
    /// Which edges.
    pub select: Select,
    /// The name in the report; where several edges have it, with their ids behind it.
    pub name: Option<String>,
    /// The limits it gives itself.
    pub limits: Limits,
    /// Whether anything of the edge is evaluated; `None` = as said before.
    pub judged: Option<bool>,
    /// Distance of its stations, mm; `None` = as said before.
    pub station_step_mm: Option<f64>,
}

/// All that the recipe says of one edge.
#[derive(Debug, Clone, PartialEq)]
pub struct Resolved {
    /// Its name, where it has one.
    pub name: Option<String>,
    /// Its limits; none where it is not judged.
    pub limits: Limits,
    /// Distance of its stations, mm; `None` = derived from the data.
    pub station_step_mm: Option<f64>,
}

/// An edge that an entry names.
#[derive(Debug, Clone, PartialEq)]
pub enum EdgeKey {
    /// By its STEP entity.
    Entity(u64),
    /// By its id, `e1` ...
    Id(String),
}

/// A feature that the pose rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct DatumRecipe {
    /// The name in the report.
    pub name: String,
    /// 1 holds before 2, 2 before 3.
    pub priority: u32,
    /// Where it is.
    pub source: DatumSource,
}

/// Where a datum feature is found.
#[derive(Debug, Clone, PartialEq)]
pub enum DatumSource {
    /// STEP entities of faces that are one plane, axis or sphere.
    Faces(Vec<u64>),
    /// A reference point on the nominal.
    Point {
        /// Its place, mm, part frame.
        nominal: DVec3,
        /// What it holds; `None` = along the normal of the face.
        direction: Option<DVec3>,
        /// Radius of the patch that is measured, mm; `None` = from the spacing.
        radius_mm: Option<f64>,
    },
    /// The datum feature with this letter in the nominal's PMI.
    Pmi(String),
}

/// Gap and flush between two edges.
#[derive(Debug, Clone, PartialEq)]
pub struct GapRecipe {
    /// The name in the report.
    pub name: String,
    /// The edge whose stations count, and the other.
    pub edges: [EdgeKey; 2],
    /// Limits of the gap, mm.
    pub gap_mm: Option<[f64; 2]>,
    /// Limits of the flush, mm.
    pub flush_mm: Option<[f64; 2]>,
}

impl Recipe {
    /// All that this says of `edge`.
    pub fn of(&self, edge: &EdgeFacts) -> Resolved {
        self.of_edge(edge, Limits::default())
    }

    /// All that holds for `edge`: what entries say of it, then the limits that come with the nominal, then those of every edge.
    pub fn of_edge(&self, edge: &EdgeFacts, by_nominal: Limits) -> Resolved {
        let mut limits = Limits::default();
        let (mut name, mut judged, mut step) = (None, true, self.station_step_mm);
        for entry in self.edges.iter().filter(|entry| entry.select.means(edge)) {
            name = entry.name.clone().or(name);
            judged = entry.judged.unwrap_or(judged);
            step = entry.station_step_mm.or(step);
            limits = entry.limits.or(limits);
        }
        Resolved {
            name,
            limits: if judged {
                limits.or(by_nominal).or(self.limits)
            } else {
                Limits::default()
            },
            station_step_mm: step,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use acies_drivers::device::Mistake;

    use super::*;
    use crate::inspect::quantity::Quantity;

    fn facts(id: &str, entity: u64) -> EdgeFacts {
        EdgeFacts {
            id: id.to_owned(),
            entity,
            faces: [17, 45],
            kind: EdgeKind::Convex,
            box_mm: [DVec3::ZERO, DVec3::new(10.0, 0.0, 0.0)],
            turn_angle_rad: [FRAC_PI_2; 2],
        }
    }

    #[test]
    fn the_example_of_the_documentation_is_read() {
        let text = include_str!("recipe.rs");
        let example: String = text
            .lines()
            .skip_while(|line| !line.starts_with("//! ```toml"))
            .skip(1)
            .take_while(|line| !line.starts_with("//! ```"))
            .map(|line| format!("{}\n", line.trim_start_matches("//!")))
            .collect();
        let recipe = Recipe::parse(&example).expect("the documented example is right");
        assert_eq!(recipe.rule, Rule::GuardBand(2.0));
        assert_eq!(recipe.datum_faces, [17, 45, 61]);
        let general = recipe.of(&facts("e9", 5)).limits;
        assert_eq!(general.of(Quantity::D1), Some([-0.1, 0.1]));
        assert_eq!(general.of(Quantity::Burr), Some([f64::NEG_INFINITY, 0.05]));
        // 90 degrees lies in the window of the first entry.
        assert_eq!(general.of(Quantity::BreakRadius), Some([0.1, 0.3]));
        let own = recipe.of(&facts("e9", 123));
        assert_eq!(own.limits.of(Quantity::D2), Some([-0.05, 0.02]));
        assert_eq!(
            own.limits.of(Quantity::AngleDeviation),
            Some([-0.5f64.to_radians(), 0.5f64.to_radians()])
        );
        assert_eq!(own.name.as_deref(), Some("sealing lip"));
        assert_eq!(own.station_step_mm, Some(0.5));
        assert!(recipe.of(&facts("e7", 5)).limits.is_empty());
        assert_eq!(recipe.gaps[0].edges[1], EdgeKey::Entity(123));
        assert_eq!(recipe.temperature_c, Some([18.0, 22.0]));
    }

    #[test]
    fn an_edge_keeps_the_general_limits_for_what_it_does_not_give() {
        let text = "[limits]\nd_mm = [-0.1, 0.1]\n\
                    [[edge]]\nid = \"e1\"\nname = \"lip\"\n\
                    [[edge]]\nid = \"e2\"\nd2_mm = [0, 1]\n\
                    [[edge]]\nid = \"e3\"\nincluded_angle_deg = [-180.0, 180.0]\njudged = true\n\
                    [[edge]]\nid = \"e4\"\njudged = false\n";
        let recipe = Recipe::parse(text).expect("a recipe");
        let general = Some([-0.1, 0.1]);
        let of = |id| recipe.of(&facts(id, 0)).limits;
        assert_eq!(of("e1"), recipe.limits);
        assert_eq!(of("e2").of(Quantity::D1), general);
        assert_eq!(of("e2").of(Quantity::D2), Some([0.0, 1.0]));
        assert_eq!(of("e3").of(Quantity::D1), general);
        assert_eq!(of("e3").of(Quantity::AngleDeviation), Some([-PI, PI]));
        assert_eq!(of("e4"), Limits::default());
        assert_eq!(of("e5"), recipe.limits);
    }

    #[test]
    fn edges_are_selected_by_faces_box_angle_and_kind() {
        let edge = facts("e1", 5);
        let means = |text: &str| {
            let text = format!("[[edge]]\n{text}");
            let recipe = Recipe::parse(&text).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
            recipe.edges[0].select.means(&edge)
        };
        assert!(means("faces = [45, 17]"));
        assert!(!means("faces = [45, 18]"));
        assert!(means("box_mm = [[0, 0, 0], [10, 1, 1]]"));
        assert!(!means("box_mm = [[0, 0, 0], [9, 1, 1]]"));
        assert!(means("turn_angle_deg = [80, 100]"));
        assert!(!means("turn_angle_deg = [100, 180]"));
        assert!(means("kind = \"convex\""));
        assert!(!means("kind = \"convex\"\nfaces = [1, 2]"));
    }

    #[test]
    fn a_recipe_is_known_by_the_hash_of_its_text() {
        // The digest of no bytes, as published (FIPS 180-4 example files).
        let empty = Recipe::parse("").expect("an empty recipe is the default");
        assert_eq!(
            empty.sha256,
            "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
        );
        assert_ne!(
            Recipe::parse("# a note").expect("a note").sha256,
            empty.sha256
        );
    }

    #[test]
    fn all_mistakes_come_at_once() {
        let text = "rule = \"strict\"\nminimum_coverage = 2\ncolour = 1\ndatum_faces = [\"a\"]\n\
                    [limits]\nd_mm = [0.1, -0.1]\nwidth = 3\n\
                    [[edge]]\nname = 3\n[[edge]]\nid = \"e1\"\n[[edge]]\nid = \"e1\"\nd1_mm = nan\n\
                    [[edge]]\nentity = 0\n[[edge]]\nentity = 5\nid = \"e5\"\n\
                    [[edge]]\nid = \"e6\"\njudged = false\nd_mm = [0, 1]\n";
        let mistakes = Recipe::parse(text).expect_err("thirteen mistakes");
        let lines: Vec<String> = mistakes.iter().map(Mistake::to_string).collect();
        for expected in [
            "rule: \"strict\", expected \"simple\", or a table of guard_band",
            "minimum_coverage: 2, expected a number of 0 to 1",
            "colour: an unknown key, expected one of limits, environment, alignment, expansion, rule, limits_from_pmi, edge",
            "datum_faces: [\"a\"], expected numbers of STEP entities",
            "limits.d_mm: [0.1, -0.1], expected two numbers, the lower limit then the upper",
            "limits.width: an unknown key, expected one of d_mm",
            "edge[0].name: 3, expected a text",
            "edge[0].entity: nothing, expected entity, id, faces, box_mm, turn_angle_deg or kind, to say which edges",
            "edge[2].d1_mm: nan, expected two numbers",
            "edge[2]: an edge that has an entry above, expected one entry an edge",
            "edge[3].entity: 0, expected the number of a STEP entity",
            "edge[4].entity: entity and id, expected one of the two",
            "edge[5].judged: false beside limits, expected one of the two",
        ] {
            assert!(
                lines.iter().any(|line| line.starts_with(expected)),
                "{expected}\nnot in {lines:#?}"
            );
        }
        assert_eq!(mistakes.len(), 13, "{lines:#?}");
    }

    #[test]
    fn text_that_is_no_toml_is_refused_with_its_line() {
        let mistakes = Recipe::parse("rule = \"simple\"\nlimits = [").expect_err("no TOML");
        assert!(mistakes[0].found.starts_with("line 2: "), "{mistakes:?}");
    }
}
