//! A recipe from TOML: every mistake at once, each with its key, what was found and what was expected.

use acies_drivers::device::Mistake;
use acies_drivers::settings::{Keys, number, numbers};
use glam::DVec3;
use sha2::{Digest, Sha256};
use toml::Value;

use super::{
    DatumRecipe, DatumSource, EdgeKey, EdgeRecipe, Expansion, GapRecipe, Limits, Recipe, Rule,
    Select,
};
use crate::inspect::quantity::{PAIRS, Quantity, Unit};
use crate::nominal::EdgeKind;

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
        let mut recipe = recipe(&mut keys);
        let digest = Sha256::digest(text.as_bytes());
        recipe.sha256 = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        keys.finish().map(|()| recipe)
    }
}

fn line_of(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|b| *b == b'\n').count()
}

fn recipe(keys: &mut Keys) -> Recipe {
    const COUNTS: [(&str, bool); 2] = [("not_ok", true), ("report", false)];
    let default = Recipe::default();
    let (mut limits, mut corner_mm) = (Limits::default(), None);
    inner(keys, "limits", |keys| {
        limits = own_limits(keys);
        corner_mm = keys.number("corner_mm", 0.0..=1e4);
    });
    let mut temperature_c = None;
    inner(keys, "environment", |keys| {
        temperature_c = pair(keys, "temperature_c");
    });
    let mut datums = Vec::new();
    inner(keys, "alignment", |keys| datums = read_datums(keys));
    let mut expansion = None;
    inner(keys, "expansion", |keys| expansion = read_expansion(keys));
    Recipe {
        sha256: String::new(),
        rule: rule(keys).unwrap_or(default.rule),
        limits,
        limits_from_pmi: keys.flag("limits_from_pmi").unwrap_or_default(),
        corner_mm,
        edges: edges(keys),
        gaps: gaps(keys),
        datum_faces: entities(keys, "datum_faces").unwrap_or_default(),
        datums,
        minimum_coverage: keys
            .number("minimum_coverage", 0.0..=1.0)
            .unwrap_or(default.minimum_coverage),
        missing_edges_count: keys
            .choice("missing_edges", &COUNTS)
            .unwrap_or(default.missing_edges_count),
        unexpected_edges_count: keys
            .choice("unexpected_edges", &COUNTS)
            .unwrap_or(default.unexpected_edges_count),
        station_step_mm: keys.number("station_step_mm", 1e-3..=1e4),
        flank_mm: keys.number("flank_mm", 1e-3..=1e4),
        depth_mm: keys.number("depth_mm", 0.0..=1e4),
        held: held(keys).unwrap_or_default(),
        direction_mm: keys.number("direction_mm", 1e-3..=1e4),
        u_calibration_mm: keys
            .number("u_calibration_mm", 0.0..=10.0)
            .unwrap_or(default.u_calibration_mm),
        u_calibration_rad: keys
            .number("u_calibration_rad", 0.0..=1.0)
            .unwrap_or(default.u_calibration_rad),
        temperature_c,
        expansion,
    }
}

/// Reads the table `key` with `read`, its mistakes among those of `keys`.
fn inner(keys: &mut Keys, key: &'static str, mut read: impl FnMut(&mut Keys)) {
    if let Some(table) = keys.table(key) {
        let mut inner = Keys::new(table);
        read(&mut inner);
        keys.adopt(key, inner);
    }
}

fn held(keys: &mut Keys) -> Option<[bool; 6]> {
    const NAMES: [&str; 6] = [
        "turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z",
    ];
    let expected = format!("names among {}", NAMES.join(", "));
    keys.read("hold", &expected, |value| {
        let mut held = [false; 6];
        for name in value.as_array()? {
            let place = NAMES.iter().position(|n| Some(*n) == name.as_str())?;
            held[place] = true;
        }
        Some(held)
    })
}

fn read_datums(keys: &mut Keys) -> Vec<DatumRecipe> {
    let mut datums: Vec<DatumRecipe> = Vec::new();
    for (k, table) in keys.tables("datum").into_iter().enumerate() {
        let mut inner = Keys::new(table);
        let datum = datum(&mut inner, k);
        keys.adopt(&format!("datum[{k}]"), inner);
        let Some(datum) = datum else { continue };
        if datums.iter().any(|above| above.name == datum.name) {
            let place = format!("datum[{k}].name");
            keys.wrong(
                &place,
                format!("{:?} again", datum.name),
                "one name a datum",
            );
        }
        datums.push(datum);
    }
    datums
}

fn datum(keys: &mut Keys, index: usize) -> Option<DatumRecipe> {
    const KEYS: [&str; 3] = ["faces", "point_mm", "pmi"];
    const OF_POINTS: [&str; 2] = ["direction", "radius_mm"];
    let given: Vec<&str> = KEYS.into_iter().filter(|key| keys.contains(key)).collect();
    let is_point = given == ["point_mm"];
    if given.len() != 1 {
        let found = if given.is_empty() {
            "nothing".to_owned()
        } else {
            given.join(" and ")
        };
        keys.wrong("faces", found, "one of faces, point_mm and pmi");
    }
    for key in OF_POINTS {
        if keys.contains(key) && !is_point {
            keys.wrong(
                key,
                "no point_mm beside it",
                "it with a reference point only",
            );
        }
    }
    let faces = keys.read("faces", "the STEP entities of its faces", |value| {
        let faces: Option<Vec<u64>> = value.as_array()?.iter().map(entity).collect();
        faces.filter(|faces| !faces.is_empty())
    });
    let point = keys.read("point_mm", "a place, as in [10, 0, 5]", |value| {
        numbers(value).map(DVec3::from)
    });
    let direction = keys.read("direction", "a direction, as in [0, 0, 1]", |value| {
        numbers(value)
            .map(DVec3::from)
            .filter(|d| d.length() > 1e-9)
    });
    let radius_mm = keys.number("radius_mm", 1e-3..=1e4);
    let pmi = keys.text("pmi");
    let name = keys.text("name").or_else(|| pmi.clone());
    let priority = keys.integer("priority", 1..=6).unwrap_or(1);
    let source = match (faces, point, pmi) {
        (Some(faces), None, None) => DatumSource::Faces(faces),
        (None, Some(nominal), None) => DatumSource::Point {
            nominal,
            direction,
            radius_mm,
        },
        (None, None, Some(letter)) => DatumSource::Pmi(letter),
        _ => return None,
    };
    Some(DatumRecipe {
        name: name.unwrap_or_else(|| format!("datum {}", index + 1)),
        priority: priority as u32,
        source,
    })
}

fn read_expansion(keys: &mut Keys) -> Option<Expansion> {
    let coefficient = keys.number("coefficient_per_k", -1e-3..=1e-3);
    if coefficient.is_none() && !keys.contains("coefficient_per_k") {
        keys.wrong(
            "coefficient_per_k",
            "nothing",
            "the linear coefficient, 1/K",
        );
    }
    let u_coefficient = keys.number("u_coefficient_per_k", 0.0..=1e-3);
    let u_temperature = keys.number("u_temperature_k", 0.0..=100.0);
    Some(Expansion {
        coefficient_per_k: coefficient?,
        u_coefficient_per_k: u_coefficient.unwrap_or(0.0),
        u_temperature_k: u_temperature.unwrap_or(0.0),
    })
}

fn rule(keys: &mut Keys) -> Option<Rule> {
    let expected =
        "\"simple\", or a table of guard_band, 0 to 10, or of conformance, 0.5 to 0.9999";
    keys.read("rule", expected, |value| match value {
        Value::String(word) if word == "simple" => Some(Rule::Simple),
        Value::Table(table) if table.len() == 1 => {
            let given = |key, range: std::ops::RangeInclusive<f64>| {
                let value = table.get(key).and_then(number)?;
                range.contains(&value).then_some(value)
            };
            given("guard_band", 0.0..=10.0)
                .map(Rule::GuardBand)
                .or_else(|| given("conformance", 0.5..=0.9999).map(Rule::Conformance))
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
    let mut limits = Limits::default();
    for (key, both) in PAIRS {
        if let Some(pair) = limits_of(keys, key, both[0]) {
            limits = both.iter().fold(limits, |l, q| l.with(*q, pair));
        }
    }
    for quantity in Quantity::all() {
        if let Some(pair) = limits_of(keys, quantity.key(), quantity) {
            limits = limits.with(quantity, pair);
        }
    }
    limits
}

/// A pair, or for what cannot be negative one number, the upper limit; 0 below such a quantity is no limit.
fn limits_of(keys: &mut Keys, key: &'static str, quantity: Quantity) -> Option<[f64; 2]> {
    let inside = |limit: f64| quantity.unit().inside(limit);
    if !quantity.one_sided() {
        return pair(keys, key).map(|pair| pair.map(inside));
    }
    let expected = "the upper limit, or two numbers, the lower limit then the upper";
    let pair = keys.read(key, expected, |value| {
        let pair = number(value).map(|upper| [0.0, upper]);
        pair.or_else(|| numbers(value))
            .filter(|[lower, upper]| lower <= upper && *lower >= 0.0)
    })?;
    let lower = if pair[0] == 0.0 {
        f64::NEG_INFINITY
    } else {
        inside(pair[0])
    };
    Some([lower, inside(pair[1])])
}

fn pair(keys: &mut Keys, key: &'static str) -> Option<[f64; 2]> {
    let expected = "two numbers, the lower limit then the upper";
    keys.read(key, expected, |value| {
        numbers(value).filter(|[lower, upper]| lower <= upper)
    })
}

fn edges(keys: &mut Keys) -> Vec<EdgeRecipe> {
    let mut edges: Vec<EdgeRecipe> = Vec::new();
    for (k, table) in keys.tables("edge").into_iter().enumerate() {
        let place = format!("edge[{k}]");
        let mut inner = Keys::new(table);
        let edge = edge(&mut inner);
        keys.adopt(&place, inner);
        let Some(edge) = edge else { continue };
        if edges.iter().any(|above| above.select == edge.select) {
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

fn edge(keys: &mut Keys) -> Option<EdgeRecipe> {
    let select = select(keys);
    let name = keys.text("name");
    let judged = keys.flag("judged");
    let limits = own_limits(keys);
    if judged == Some(false) && !limits.is_empty() {
        keys.wrong("judged", "false beside limits", "one of the two");
    }
    Some(EdgeRecipe {
        select: select?,
        name,
        limits,
        judged,
        station_step_mm: keys.number("station_step_mm", 1e-3..=1e4),
    })
}

fn select(keys: &mut Keys) -> Option<Select> {
    const KINDS: [(&str, EdgeKind); 2] =
        [("convex", EdgeKind::Convex), ("concave", EdgeKind::Concave)];
    const KEYS: [&str; 6] = ["entity", "id", "faces", "box_mm", "turn_angle_deg", "kind"];
    let given = KEYS.map(|key| keys.contains(key));
    let select = Select {
        entity: keys.read("entity", "the number of a STEP entity", entity),
        id: keys.text("id"),
        faces: keys.read("faces", "the STEP entities of two faces", |value| {
            let faces: Option<Vec<u64>> = value.as_array()?.iter().map(entity).collect();
            faces?.try_into().ok()
        }),
        box_mm: keys.read(
            "box_mm",
            "two corners, the lower then the upper, as in [[0, 0, 0], [50, 20, 5]]",
            corners,
        ),
        turn_angle_rad: pair(keys, "turn_angle_deg")
            .map(|pair| pair.map(|angle| Unit::Angle.inside(angle))),
        kind: keys.choice("kind", &KINDS),
    };
    if given[0] && given[1] {
        keys.wrong("entity", "entity and id", "one of the two");
    }
    if given.iter().all(|given| !given) {
        keys.wrong(
            "entity",
            "nothing",
            "entity, id, faces, box_mm, turn_angle_deg or kind, to say which edges",
        );
    }
    (select != Select::default()).then_some(select)
}

fn corners(value: &Value) -> Option<[DVec3; 2]> {
    let [low, high] = value.as_array()?.as_slice() else {
        return None;
    };
    let [low, high] = [numbers::<3>(low)?, numbers::<3>(high)?].map(DVec3::from);
    low.cmple(high).all().then_some([low, high])
}

fn gaps(keys: &mut Keys) -> Vec<GapRecipe> {
    let mut gaps = Vec::new();
    for (k, table) in keys.tables("gap").into_iter().enumerate() {
        let mut inner = Keys::new(table);
        let gap = gap(&mut inner, k);
        keys.adopt(&format!("gap[{k}]"), inner);
        gaps.extend(gap);
    }
    gaps
}

fn gap(keys: &mut Keys, index: usize) -> Option<GapRecipe> {
    let expected = "two edges by id or STEP entity, as in [\"e1\", 123]";
    if !keys.contains("edges") {
        keys.wrong("edges", "nothing", expected);
    }
    let edges = keys.read("edges", expected, |value| {
        let edges: Option<Vec<EdgeKey>> = value.as_array()?.iter().map(edge_key).collect();
        edges?.try_into().ok()
    });
    let name = keys
        .text("name")
        .unwrap_or_else(|| format!("gap {}", index + 1));
    let (gap_mm, flush_mm) = (pair(keys, "gap_mm"), pair(keys, "flush_mm"));
    Some(GapRecipe {
        name,
        edges: edges?,
        gap_mm,
        flush_mm,
    })
}

fn edge_key(value: &Value) -> Option<EdgeKey> {
    match value {
        Value::String(id) if !id.trim().is_empty() => Some(EdgeKey::Id(id.clone())),
        other => entity(other).map(EdgeKey::Entity),
    }
}
