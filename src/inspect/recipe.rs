//! What an inspection is asked to judge: limits, decision rule, datums, calibration. As plain values, and read from TOML.
//!
//! ```toml
//! rule = { guard_band = 2.0 }       # or "simple", the default
//! datum_faces = [17, 45, 61]        # STEP entities; without them all faces hold the alignment
//! minimum_coverage = 0.9            # an edge measured over less is not decidable
//! station_step_mm = 1.0             # without it derived from the data
//! u_calibration_mm = 0.002          # standard uncertainty of a flank's place from the sensor's calibration
//! u_calibration_rad = 0.0           # and of the included angle
//!
//! [limits]                          # of every edge; without limits a value is not evaluated
//! d_mm = [-0.1, 0.1]                # of d1 and d2; d1_mm and d2_mm name one
//! included_angle_deg = [-0.5, 0.5]  # of the deviation from the nominal included angle
//!
//! [[edge]]
//! entity = 123                      # the STEP entity of the edge, or: id = "e4"
//! name = "sealing lip"              # optional
//! d_mm = [-0.05, 0.02]              # what is not given here holds as in [limits]
//!
//! [[edge]]
//! id = "e7"
//! judged = false                    # nothing of it is evaluated; the default is true
//! ```

use acies_drivers::device::Mistake;
use acies_drivers::settings::{Keys, number, numbers};
use toml::Value;

/// What an inspection is asked to judge.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// How the uncertainty counts.
    pub rule: Rule,
    /// Limits of every edge for which `edges` says nothing else.
    pub limits: Limits,
    /// Edges with a name or limits of their own, or out of judgement.
    pub edges: Vec<EdgeRecipe>,
    /// STEP entities of the faces that hold the alignment; empty = all faces.
    pub datum_faces: Vec<u64>,
    /// Share of an edge's length that must be measured for the edge to be decidable, 0 to 1.
    pub minimum_coverage: f64,
    /// Distance of the stations, mm; `None` = derived from the data.
    pub station_step_mm: Option<f64>,
    /// Standard uncertainty of d from the calibration of the sensor, mm.
    pub u_calibration_mm: f64,
    /// Standard uncertainty of the included angle from the calibration of the sensor, rad.
    pub u_calibration_rad: f64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            rule: Rule::Simple,
            limits: Limits::default(),
            edges: Vec::new(),
            datum_faces: Vec::new(),
            minimum_coverage: 0.9,
            station_step_mm: None,
            u_calibration_mm: 0.0,
            u_calibration_rad: 0.0,
        }
    }
}

/// How the uncertainty of a value counts when it is compared with a limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rule {
    /// The value alone decides.
    Simple,
    /// A limit within this many standard uncertainties of the value leaves it undecided (ISO 14253-1).
    GuardBand(f64),
}

/// Lower and upper limits that hold for one edge; `None` = not evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Limits {
    /// Of d1 and d2, mm.
    pub d_mm: [Option<[f64; 2]>; 2],
    /// Of the included angle minus the nominal one, rad.
    pub angle_rad: Option<[f64; 2]>,
}

impl Limits {
    /// Whether nothing is evaluated.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// These, and those of `general` where there are none.
    fn or(self, general: Self) -> Self {
        Self {
            d_mm: [0, 1].map(|i| self.d_mm[i].or(general.d_mm[i])),
            angle_rad: self.angle_rad.or(general.angle_rad),
        }
    }
}

/// Which edge an entry of the recipe means.
#[derive(Debug, Clone, PartialEq)]
pub enum EdgeKey {
    /// By its STEP entity.
    Entity(u64),
    /// By its id, `e1` ...
    Id(String),
}

/// What the recipe says of one edge.
#[derive(Debug, Clone, PartialEq)]
pub struct EdgeRecipe {
    /// Which edge.
    pub key: EdgeKey,
    /// The name it gets in the report.
    pub name: Option<String>,
    /// All that hold for it: its own, and those of the recipe for what it does not give; none where it is not judged.
    pub limits: Limits,
}

impl Recipe {
    /// The recipe that `text` writes, or every mistake in it.
    ///
    /// # Errors
    /// All mistakes at once: text that is no TOML, unknown keys, wrong types, limits upside down.
    pub fn parse(text: &str) -> Result<Self, Vec<Mistake>> {
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let line = error.span().map_or(1, |span| line_of(text, span.start));
            vec![Mistake {
                key: "recipe".to_owned(),
                found: format!("line {line}: {}", error.message()),
                expected: "TOML".to_owned(),
            }]
        })?;
        let mut keys = Keys::new(table);
        let recipe = recipe(&mut keys);
        keys.finish().map(|()| recipe)
    }

    /// What the recipe says of the edge with this id and entity.
    pub fn edge(&self, id: &str, entity: u64) -> Option<&EdgeRecipe> {
        self.edges.iter().find(|edge| match &edge.key {
            EdgeKey::Entity(e) => *e == entity,
            EdgeKey::Id(i) => i == id,
        })
    }

    /// The limits of the edge with this id and entity.
    pub fn limits(&self, id: &str, entity: u64) -> Limits {
        self.edge(id, entity)
            .map_or(self.limits, |edge| edge.limits)
    }
}

fn line_of(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|b| *b == b'\n').count()
}

fn recipe(keys: &mut Keys) -> Recipe {
    let default = Recipe::default();
    let mut limits = Limits::default();
    if let Some(table) = keys.table("limits") {
        let mut inner = Keys::new(table);
        limits = own_limits(&mut inner);
        keys.adopt("limits", inner);
    }
    Recipe {
        rule: rule(keys).unwrap_or(default.rule),
        limits,
        edges: edges(keys, limits),
        datum_faces: entities(keys, "datum_faces").unwrap_or_default(),
        minimum_coverage: keys
            .number("minimum_coverage", 0.0..=1.0)
            .unwrap_or(default.minimum_coverage),
        station_step_mm: keys.number("station_step_mm", 1e-3..=1e4),
        u_calibration_mm: keys
            .number("u_calibration_mm", 0.0..=10.0)
            .unwrap_or(default.u_calibration_mm),
        u_calibration_rad: keys
            .number("u_calibration_rad", 0.0..=1.0)
            .unwrap_or(default.u_calibration_rad),
    }
}

fn rule(keys: &mut Keys) -> Option<Rule> {
    let expected = "\"simple\" or { guard_band = k } with k of 0 to 10";
    keys.read("rule", expected, |value| match value {
        Value::String(word) if word == "simple" => Some(Rule::Simple),
        Value::Table(table) if table.len() == 1 => {
            let k = table.get("guard_band").and_then(number);
            k.filter(|k| (0.0..=10.0).contains(k)).map(Rule::GuardBand)
        }
        _ => None,
    })
}

fn entities(keys: &mut Keys, key: &'static str) -> Option<Vec<u64>> {
    keys.read(key, "numbers of STEP entities", |value| {
        value.as_array()?.iter().map(entity).collect()
    })
}

/// STEP counts its entities from 1.
fn entity(value: &Value) -> Option<u64> {
    let entity = u64::try_from(value.as_integer()?).ok()?;
    (entity > 0).then_some(entity)
}

/// The limits that the table itself gives.
fn own_limits(keys: &mut Keys) -> Limits {
    let both = pair(keys, "d_mm");
    let d1 = pair(keys, "d1_mm").or(both);
    let d2 = pair(keys, "d2_mm").or(both);
    let angle = pair(keys, "included_angle_deg");
    Limits {
        d_mm: [d1, d2],
        angle_rad: angle.map(|pair| pair.map(f64::to_radians)),
    }
}

fn pair(keys: &mut Keys, key: &'static str) -> Option<[f64; 2]> {
    let expected = "two numbers, the lower limit then the upper";
    keys.read(key, expected, |value| {
        numbers(value).filter(|[lower, upper]| lower <= upper)
    })
}

fn edges(keys: &mut Keys, general: Limits) -> Vec<EdgeRecipe> {
    let mut edges: Vec<EdgeRecipe> = Vec::new();
    for (k, table) in keys.tables("edge").into_iter().enumerate() {
        let place = format!("edge[{k}]");
        let mut inner = Keys::new(table);
        let edge = edge(&mut inner, general);
        keys.adopt(&place, inner);
        let Some(edge) = edge else { continue };
        if edges.iter().any(|above| above.key == edge.key) {
            keys.wrong(
                &place,
                "an edge that has an entry above",
                "one entry an edge",
            );
        }
        edges.push(edge);
    }
    edges
}

fn edge(keys: &mut Keys, general: Limits) -> Option<EdgeRecipe> {
    let key = edge_key(keys);
    let name = keys.text("name");
    let judged = keys.flag("judged").unwrap_or(true);
    let own = own_limits(keys);
    if !judged && !own.is_empty() {
        keys.wrong("judged", "false beside limits", "one of the two");
    }
    let limits = if judged {
        own.or(general)
    } else {
        Limits::default()
    };
    Some(EdgeRecipe {
        key: key?,
        name,
        limits,
    })
}

fn edge_key(keys: &mut Keys) -> Option<EdgeKey> {
    let given = (keys.contains("entity"), keys.contains("id"));
    let by_entity = keys.read("entity", "the number of a STEP entity", entity);
    let by_id = keys.text("id");
    match given {
        (true, true) => keys.wrong("entity", "entity and id", "one of the two"),
        (false, false) => keys.wrong("entity", "nothing", "entity or id, to say which edge"),
        _ => {}
    }
    by_entity.map(EdgeKey::Entity).or(by_id.map(EdgeKey::Id))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

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
        assert_eq!(recipe.limits("e9", 5).d_mm, [Some([-0.1, 0.1]); 2]);
        let own = recipe.limits("e9", 123);
        assert_eq!(own.d_mm, [Some([-0.05, 0.02]); 2]);
        assert_eq!(own.angle_rad, recipe.limits.angle_rad);
        assert!(own.angle_rad.is_some());
        assert!(recipe.limits("e7", 5).is_empty());
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
        let of = |id| recipe.limits(id, 0);
        assert_eq!(of("e1"), recipe.limits);
        assert_eq!(of("e2").d_mm, [general, Some([0.0, 1.0])]);
        assert_eq!(of("e3").d_mm, [general; 2]);
        assert_eq!(of("e3").angle_rad, Some([-PI, PI]));
        assert_eq!(of("e4"), Limits::default());
        assert_eq!(of("e5"), recipe.limits);
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
            "rule: \"strict\", expected \"simple\" or { guard_band = k } with k of 0 to 10",
            "minimum_coverage: 2, expected a number of 0 to 1",
            "colour: an unknown key, expected one of limits, rule, edge",
            "datum_faces: [\"a\"], expected numbers of STEP entities",
            "limits.d_mm: [0.1, -0.1], expected two numbers, the lower limit then the upper",
            "limits.width: an unknown key, expected one of d_mm",
            "edge[0].name: 3, expected a text",
            "edge[0].entity: nothing, expected entity or id, to say which edge",
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
