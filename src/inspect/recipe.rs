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
//! [limits]                          # of every edge without its own; without limits a value is not evaluated
//! d_mm = [-0.1, 0.1]                # of d1 and d2; d1_mm and d2_mm name one
//! included_angle_deg = [-0.5, 0.5]  # of the deviation from the nominal included angle
//!
//! [[edge]]
//! entity = 123                      # the STEP entity of the edge, or: id = "e4"
//! name = "sealing lip"              # optional
//! d_mm = [-0.05, 0.02]
//! ```

use acies_drivers::device::Mistake;
use toml::Value;

/// What an inspection is asked to judge.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// How the uncertainty counts.
    pub rule: Rule,
    /// Limits of every edge that has none of its own.
    pub limits: Limits,
    /// Edges with a name or limits of their own.
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

/// Lower and upper limits of one edge; `None` = not evaluated.
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
    /// Its limits; those not given are not evaluated.
    pub limits: Limits,
}

impl Recipe {
    /// The recipe that `text` writes, or every mistake in it.
    ///
    /// # Errors
    /// All mistakes at once: text that is no TOML, unknown keys, wrong types, limits upside down.
    pub fn parse(text: &str) -> Result<Self, Vec<Mistake>> {
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let place = error.span().map_or(1, |span| line_of(text, span.start));
            vec![mistake(
                "recipe",
                &format!("line {place}: {}", error.message()),
                "TOML",
            )]
        })?;
        let mut reader = Reader {
            table,
            prefix: String::new(),
            mistakes: Vec::new(),
        };
        let recipe = reader.recipe();
        reader.leftovers(RECIPE_KEYS);
        if reader.mistakes.is_empty() {
            Ok(recipe)
        } else {
            Err(reader.mistakes)
        }
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

const RECIPE_KEYS: &str = "rule, limits, edge, datum_faces, minimum_coverage, station_step_mm, u_calibration_mm or u_calibration_rad";
const LIMIT_KEYS: &str = "d_mm, d1_mm, d2_mm or included_angle_deg";

fn mistake(key: &str, found: &str, expected: &str) -> Mistake {
    Mistake {
        key: key.to_string(),
        found: found.to_string(),
        expected: expected.to_string(),
    }
}

fn line_of(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|b| *b == b'\n').count()
}

/// Takes keys out of a table and notes what is wrong.
struct Reader {
    table: toml::Table,
    prefix: String,
    mistakes: Vec<Mistake>,
}

impl Reader {
    fn recipe(&mut self) -> Recipe {
        let default = Recipe::default();
        let limits = self.inner("limits", "a table");
        let edges = self.edges();
        Recipe {
            rule: self.rule(),
            limits: limits.map_or(Limits::default(), |mut inner| {
                let limits = inner.limits();
                inner.leftovers(LIMIT_KEYS);
                self.mistakes.append(&mut inner.mistakes);
                limits
            }),
            edges,
            datum_faces: self.entities("datum_faces"),
            minimum_coverage: self
                .number("minimum_coverage", 0.0, 1.0)
                .unwrap_or(default.minimum_coverage),
            station_step_mm: self.number("station_step_mm", 1e-3, 1e4),
            u_calibration_mm: self.number("u_calibration_mm", 0.0, 10.0).unwrap_or(0.0),
            u_calibration_rad: self.number("u_calibration_rad", 0.0, 1.0).unwrap_or(0.0),
        }
    }

    fn wrong(&mut self, key: &str, found: &str, expected: &str) {
        let key = format!("{}{key}", self.prefix);
        self.mistakes.push(mistake(&key, found, expected));
    }

    fn wrong_value(&mut self, key: &str, found: &Value, expected: &str) {
        let shown: String = found.to_string().chars().take(60).collect();
        self.wrong(key, &format!("{} {shown}", found.type_str()), expected);
    }

    fn leftovers(&mut self, allowed: &str) {
        let left: Vec<String> = self.table.keys().cloned().collect();
        for key in left {
            self.wrong(&key, "an unknown key", allowed);
        }
    }

    fn inner(&mut self, key: &str, expected: &str) -> Option<Reader> {
        match self.table.remove(key)? {
            Value::Table(table) => Some(Reader {
                table,
                prefix: format!("{}{key}.", self.prefix),
                mistakes: Vec::new(),
            }),
            other => {
                self.wrong_value(key, &other, expected);
                None
            }
        }
    }

    fn rule(&mut self) -> Rule {
        const EXPECTED: &str = "\"simple\" or { guard_band = k } with k from 0 to 10";
        match self.table.remove("rule") {
            None => return Rule::Simple,
            Some(Value::String(text)) if text == "simple" => return Rule::Simple,
            Some(Value::Table(table)) if table.len() == 1 => {
                let k = table.get("guard_band").and_then(as_number);
                match k {
                    Some(k) if (0.0..=10.0).contains(&k) => return Rule::GuardBand(k),
                    _ => self.wrong_value("rule", &Value::Table(table), EXPECTED),
                }
            }
            Some(other) => self.wrong_value("rule", &other, EXPECTED),
        }
        Rule::Simple
    }

    fn limits(&mut self) -> Limits {
        let both = self.pair("d_mm");
        let d1 = self.pair("d1_mm").or(both);
        let d2 = self.pair("d2_mm").or(both);
        let angle = self.pair("included_angle_deg");
        Limits {
            d_mm: [d1, d2],
            angle_rad: angle.map(|pair| pair.map(f64::to_radians)),
        }
    }

    fn edges(&mut self) -> Vec<EdgeRecipe> {
        let items = match self.table.remove("edge") {
            None => return Vec::new(),
            Some(Value::Array(items)) => items,
            Some(other) => {
                self.wrong_value("edge", &other, "tables, each under [[edge]]");
                return Vec::new();
            }
        };
        let mut edges: Vec<EdgeRecipe> = Vec::new();
        for (k, item) in items.into_iter().enumerate() {
            let Value::Table(table) = item else {
                self.wrong_value(&format!("edge[{k}]"), &item, "a table under [[edge]]");
                continue;
            };
            let mut inner = Reader {
                table,
                prefix: format!("{}edge[{k}].", self.prefix),
                mistakes: Vec::new(),
            };
            let edge = inner.edge();
            inner.leftovers(&format!("entity, id, name, {LIMIT_KEYS}"));
            self.mistakes.append(&mut inner.mistakes);
            let Some(edge) = edge else { continue };
            if edges.iter().any(|e| e.key == edge.key) {
                self.wrong(
                    &format!("edge[{k}]"),
                    "an edge that has an entry above",
                    "one entry an edge",
                );
            }
            edges.push(edge);
        }
        edges
    }

    fn edge(&mut self) -> Option<EdgeRecipe> {
        let entity = self.table.remove("entity");
        let id = self.text("id");
        let name = self.text("name");
        let limits = self.limits();
        let key = match (entity, id) {
            (Some(Value::Integer(n)), None) if n > 0 => EdgeKey::Entity(n as u64),
            (Some(other), None) => {
                self.wrong_value("entity", &other, "the number of a STEP entity");
                return None;
            }
            (None, Some(id)) => EdgeKey::Id(id),
            (None, None) => {
                self.wrong("entity", "nothing", "entity or id, to say which edge");
                return None;
            }
            (Some(_), Some(_)) => {
                self.wrong("entity", "entity and id", "one of the two");
                return None;
            }
        };
        Some(EdgeRecipe { key, name, limits })
    }

    fn text(&mut self, key: &str) -> Option<String> {
        match self.table.remove(key)? {
            Value::String(text) => Some(text),
            other => {
                self.wrong_value(key, &other, "a text");
                None
            }
        }
    }

    fn number(&mut self, key: &str, low: f64, high: f64) -> Option<f64> {
        let value = self.table.remove(key)?;
        let number = as_number(&value).filter(|n| (low..=high).contains(n));
        if number.is_none() {
            self.wrong_value(key, &value, &format!("a number from {low} to {high}"));
        }
        number
    }

    fn pair(&mut self, key: &str) -> Option<[f64; 2]> {
        let value = self.table.remove(key)?;
        let numbers: Option<Vec<f64>> = value
            .as_array()
            .and_then(|items| items.iter().map(as_number).collect());
        match numbers.as_deref() {
            Some([low, high]) if low <= high => Some([*low, *high]),
            _ => {
                self.wrong_value(key, &value, "two numbers, the lower limit then the upper");
                None
            }
        }
    }

    fn entities(&mut self, key: &str) -> Vec<u64> {
        let Some(value) = self.table.remove(key) else {
            return Vec::new();
        };
        let numbers: Option<Vec<u64>> = value.as_array().and_then(|items| {
            let entity = |item: &Value| item.as_integer().and_then(|n| u64::try_from(n).ok());
            items.iter().map(entity).collect()
        });
        numbers.unwrap_or_else(|| {
            self.wrong_value(key, &value, "numbers of STEP entities");
            Vec::new()
        })
    }
}

fn as_number(value: &Value) -> Option<f64> {
    let number = match value {
        Value::Float(x) => *x,
        Value::Integer(n) => *n as f64,
        _ => return None,
    };
    number.is_finite().then_some(number)
}

#[cfg(test)]
mod tests {
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
        assert_eq!(own.angle_rad, None);
    }

    #[test]
    fn all_mistakes_come_at_once() {
        let text = "rule = \"strict\"\nminimum_coverage = 2\ncolour = 1\ndatum_faces = [\"a\"]\n\
                    [limits]\nd_mm = [0.1, -0.1]\nwidth = 3\n\
                    [[edge]]\nname = 3\n[[edge]]\nid = \"e1\"\n[[edge]]\nid = \"e1\"\nd1_mm = nan\n";
        let mistakes = Recipe::parse(text).expect_err("nine mistakes");
        let lines: Vec<String> = mistakes.iter().map(Mistake::to_string).collect();
        for expected in [
            "rule: string \"strict\", expected \"simple\" or { guard_band = k } with k from 0 to 10",
            "minimum_coverage: integer 2, expected a number from 0 to 1",
            "colour: an unknown key, expected rule, limits",
            "datum_faces: array [\"a\"], expected numbers of STEP entities",
            "limits.d_mm: array [0.1, -0.1], expected two numbers, the lower limit then the upper",
            "limits.width: an unknown key, expected d_mm",
            "edge[0].name: integer 3, expected a text",
            "edge[0].entity: nothing, expected entity or id, to say which edge",
            "edge[2].d1_mm: float nan, expected two numbers",
            "edge[2]: an edge that has an entry above, expected one entry an edge",
        ] {
            assert!(
                lines.iter().any(|line| line.starts_with(expected)),
                "{expected}\nnot in {lines:#?}"
            );
        }
        assert_eq!(mistakes.len(), 10, "{lines:#?}");
    }

    #[test]
    fn text_that_is_no_toml_is_refused_with_its_line() {
        let mistakes = Recipe::parse("rule = \"simple\"\nlimits = [").expect_err("no TOML");
        assert!(mistakes[0].found.starts_with("line 2: "), "{mistakes:?}");
    }
}
