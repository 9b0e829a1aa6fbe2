//! Semantic product and manufacturing information of AP242 files: dimensions, geometric tolerances and datum features with
//! the faces they apply to (ISO 10303-47, and -242's usage of it).

use std::collections::{BTreeMap, BTreeSet};

use super::bodies::si_factor;
use super::part21::{Part21, Read, Record, refuse};

/// Shape aspects that one may gather: files nest two or three.
const MAX_ASPECTS: usize = 10_000;
/// Faces listed over all entries of one file.
const MAX_LISTED: usize = 1_000_000;

/// One dimension, tolerance or datum feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Pmi {
    /// Its number in the file.
    pub entity: u64,
    /// The name the author gave it, often empty.
    pub name: String,
    /// What it says.
    pub kind: PmiKind,
    /// Numbers of the ADVANCED_FACEs that it applies to, ascending.
    pub faces: Vec<u64>,
    /// Numbers of the EDGE_CURVEs that it applies to, ascending.
    pub edges: Vec<u64>,
}

/// What a piece of PMI says.
#[derive(Debug, Clone, PartialEq)]
pub enum PmiKind {
    /// A size or a distance with its limits, where it has them.
    Dimension {
        /// `diameter`, `linear distance` ... as the file says it.
        what: String,
        /// Nominal value.
        value: Measure,
        /// Lower and upper deviation from it, in the same unit.
        deviations: Option<[f64; 2]>,
    },
    /// A geometric tolerance.
    Tolerance {
        /// `flatness`, `position`, `surface_profile` ...
        what: String,
        /// Width or diameter of its zone, mm.
        zone_mm: f64,
        /// Letters of its datums, in order.
        datums: Vec<String>,
        /// Whether its zone lies unevenly about the nominal.
        unequal: bool,
    },
    /// A feature that establishes a datum.
    DatumFeature {
        /// `A`, `B` ...
        letter: String,
    },
}

/// A length or an angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Measure {
    /// In mm.
    Length(f64),
    /// In rad.
    Angle(f64),
}

impl Measure {
    /// The number in mm or rad.
    pub fn value(self) -> f64 {
        match self {
            Self::Length(x) | Self::Angle(x) => x,
        }
    }
}

/// Faces and datums by shape aspect.
struct Aspects<'a> {
    file: &'a Part21,
    items: BTreeMap<u64, Vec<u64>>,
    related: BTreeMap<u64, Vec<u64>>,
    left: usize,
}

/// All PMI of a file in order of its entities; what cannot be read is left out.
pub(super) fn read(file: &Part21) -> Vec<Pmi> {
    let mut aspects = Aspects::new(file);
    let mut values: BTreeMap<u64, u64> = BTreeMap::new();
    for id in file.all(&["DIMENSIONAL_CHARACTERISTIC_REPRESENTATION"]) {
        if let Ok((dimension, value)) = pair(file, id, 0, 1) {
            values.insert(dimension, value);
        }
    }
    let mut limits: BTreeMap<u64, u64> = BTreeMap::new();
    for id in file.all(&["PLUS_MINUS_TOLERANCE"]) {
        if let Ok((range, dimension)) = pair(file, id, 0, 1) {
            limits.insert(dimension, range);
        }
    }
    let mut out: BTreeMap<u64, Pmi> = BTreeMap::new();
    let mut add = |p: Read<Pmi>| {
        if let Ok(p) = p {
            out.insert(p.entity, p);
        }
    };
    for id in dimensions(file) {
        add(dimension(
            &mut aspects,
            id,
            values.get(&id),
            limits.get(&id),
        ));
    }
    for id in tolerances(file) {
        add(tolerance(&mut aspects, id));
    }
    for id in file.all(&[
        "SHAPE_ASPECT_RELATIONSHIP",
        "FEATURE_FOR_DATUM_TARGET_RELATIONSHIP",
    ]) {
        if let Ok((feature, datum)) = pair(file, id, 2, 3)
            && file.is(datum, "DATUM")
        {
            add(datum_feature(&mut aspects, feature, datum));
        }
    }
    out.into_values().collect()
}

fn pair(file: &Part21, id: u64, first: usize, second: usize) -> Read<(u64, u64)> {
    let r = file.record(id)?;
    Ok((r.reference(first)?, r.reference(second)?))
}

fn dimensions(file: &Part21) -> Vec<u64> {
    let kinds = [
        "DIMENSIONAL_SIZE",
        "DIMENSIONAL_LOCATION",
        "DIRECTED_DIMENSIONAL_LOCATION",
        "ANGULAR_SIZE",
        "ANGULAR_LOCATION",
        "DIMENSIONAL_SIZE_WITH_PATH",
        "DIMENSIONAL_LOCATION_WITH_PATH",
    ];
    file.all(&kinds).collect()
}

/// Simple and complex entities whose type, or one of them, is a geometric tolerance of a kind.
fn tolerances(file: &Part21) -> Vec<u64> {
    let of_kind = |id: &u64| tolerance_kind(file, *id).is_some();
    file.entities().keys().copied().filter(of_kind).collect()
}

fn tolerance_kind(file: &Part21, id: u64) -> Option<String> {
    const KINDS: [&str; 14] = [
        "ANGULARITY",
        "CIRCULAR_RUNOUT",
        "COAXIALITY",
        "CONCENTRICITY",
        "CYLINDRICITY",
        "FLATNESS",
        "LINE_PROFILE",
        "PARALLELISM",
        "PERPENDICULARITY",
        "POSITION",
        "ROUNDNESS",
        "STRAIGHTNESS",
        "SURFACE_PROFILE",
        "TOTAL_RUNOUT",
    ];
    let types = file.type_of(id);
    let mut found = types
        .split('+')
        .filter_map(|t| t.strip_suffix("_TOLERANCE"));
    let kind = found.find(|t| KINDS.contains(t) || *t == "SYMMETRY")?;
    Some(kind.to_ascii_lowercase())
}

fn dimension(
    aspects: &mut Aspects<'_>,
    id: u64,
    value: Option<&u64>,
    limits: Option<&u64>,
) -> Read<Pmi> {
    let file = aspects.file;
    let r = file.record(id)?;
    let is_size = r.name.contains("SIZE");
    let (what, applies) = if is_size {
        (r.text(1), vec![r.reference(0)?])
    } else {
        (r.text(0), vec![r.reference(2)?, r.reference(3)?])
    };
    let value = value.ok_or_else(|| refuse(id, "a dimension without a value"))?;
    let items = file.record(*value)?.references(1)?;
    // The nominal value comes first; limits may stand beside it as values with names of their own.
    let mut measures = Vec::new();
    for item in items {
        if let Ok(m) = measure(file, item) {
            let name = file.part(item, "REPRESENTATION_ITEM", 0).map(|r| r.text(0));
            measures.push((name.unwrap_or_default(), m));
        }
    }
    let named = |n: &str| measures.iter().find(|m| m.0 == n).map(|m| m.1.value());
    let nominal = measures
        .iter()
        .find(|m| m.0 == "nominal value")
        .or(measures.first());
    let value = nominal
        .ok_or_else(|| refuse(id, "a dimension without a value"))?
        .1;
    let stated = named("lower limit")
        .zip(named("upper limit"))
        .map(|(a, b)| [a - value.value(), b - value.value()]);
    let given = limits.and_then(|range| {
        let (lower, upper) = pair(file, *range, 0, 1).ok()?;
        Some([
            measure(file, lower).ok()?.value(),
            measure(file, upper).ok()?.value(),
        ])
    });
    let (faces, edges) = aspects.faces_and_edges(&applies);
    Ok(Pmi {
        entity: id,
        name: String::new(),
        kind: PmiKind::Dimension {
            what,
            value,
            deviations: given.or(stated),
        },
        faces,
        edges,
    })
}

fn tolerance(aspects: &mut Aspects<'_>, id: u64) -> Read<Pmi> {
    let file = aspects.file;
    let r = match file.part(id, "GEOMETRIC_TOLERANCE", 0) {
        Some(part) => part,
        None => file.record(id)?,
    };
    let Measure::Length(zone_mm) = measure(file, r.reference(2)?)? else {
        return Err(refuse(id, "a tolerance that is an angle"));
    };
    let with_datums = match file.part(id, "GEOMETRIC_TOLERANCE_WITH_DATUM_REFERENCE", 0) {
        Some(part) => part.references(0).ok(),
        None => r.references(4).ok(),
    };
    let mut datums = Vec::new();
    for system in with_datums.unwrap_or_default() {
        datums.extend(datum_letters(file, system, 0));
    }
    let (faces, edges) = aspects.faces_and_edges(&[r.reference(3)?]);
    Ok(Pmi {
        entity: id,
        name: r.text(0),
        kind: PmiKind::Tolerance {
            what: tolerance_kind(file, id).unwrap_or_default(),
            zone_mm,
            datums,
            unequal: file.is(id, "UNEQUALLY_DISPOSED_GEOMETRIC_TOLERANCE"),
        },
        faces,
        edges,
    })
}

/// Letters of a DATUM_SYSTEM, its compartments, a DATUM_REFERENCE or a DATUM.
fn datum_letters(file: &Part21, id: u64, depth: usize) -> Vec<String> {
    let Ok(r) = file.record(id) else {
        return Vec::new();
    };
    let below = |id: Option<u64>| {
        id.map(|id| datum_letters(file, id, depth + 1))
            .unwrap_or_default()
    };
    match r.name {
        _ if depth > 4 => Vec::new(),
        "DATUM" | "COMMON_DATUM" => vec![r.text(4)],
        "DATUM_REFERENCE" => below(r.reference(1).ok()),
        "DATUM_SYSTEM" => {
            let parts = r.references(4).unwrap_or_default();
            parts.iter().flat_map(|p| below(Some(*p))).collect()
        }
        "DATUM_REFERENCE_COMPARTMENT" | "DATUM_REFERENCE_ELEMENT" => match r.reference(4) {
            Ok(base) => below(Some(base)),
            Err(_) => {
                let parts = r.references(4).unwrap_or_default();
                let letters: Vec<String> = parts.iter().flat_map(|p| below(Some(*p))).collect();
                vec![letters.join("-")]
            }
        },
        _ => Vec::new(),
    }
}

fn datum_feature(aspects: &mut Aspects<'_>, feature: u64, datum: u64) -> Read<Pmi> {
    let file = aspects.file;
    let name = match file.part(feature, "SHAPE_ASPECT", 0) {
        Some(part) => part.text(0),
        None => file.record(feature)?.text(0),
    };
    let (faces, edges) = aspects.faces_and_edges(&[feature]);
    Ok(Pmi {
        entity: feature,
        name,
        kind: PmiKind::DatumFeature {
            letter: file.record(datum)?.text(4),
        },
        faces,
        edges,
    })
}

/// A value with its unit, in mm or rad.
fn measure(file: &Part21, id: u64) -> Read<Measure> {
    let r = match file.part(id, "MEASURE_WITH_UNIT", 0) {
        Some(part) => part,
        None => file.record(id)?,
    };
    // MEASURE_REPRESENTATION_ITEM has a name before them.
    let first = usize::from(r.name == "MEASURE_REPRESENTATION_ITEM");
    let (value, unit): (f64, u64) = (r.number(first)?, r.reference(first + 1)?);
    let factor = si_factor(file, unit, 0)?;
    if file.is(unit, "LENGTH_UNIT") {
        Ok(Measure::Length(value * factor * 1000.0))
    } else if file.is(unit, "PLANE_ANGLE_UNIT") {
        Ok(Measure::Angle(value * factor))
    } else {
        Err(refuse(id, "a value that is neither a length nor an angle"))
    }
}

impl<'a> Aspects<'a> {
    fn new(file: &'a Part21) -> Self {
        let mut items: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
        // The first names one item, the second a set of them: a datum on both halves of a hole.
        for id in file.all(&[
            "GEOMETRIC_ITEM_SPECIFIC_USAGE",
            "ITEM_IDENTIFIED_REPRESENTATION_USAGE",
        ]) {
            let read =
                |r: Record<'_>| -> Read<(u64, Vec<u64>)> { Ok((r.reference(2)?, r.items(4))) };
            if let Ok((aspect, used)) = file.record(id).and_then(read) {
                items.entry(aspect).or_default().extend(used);
            }
        }
        let mut related: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
        for id in file.all(&["SHAPE_ASPECT_RELATIONSHIP"]) {
            if let Ok((whole, part)) = pair(file, id, 2, 3) {
                related.entry(whole).or_default().push(part);
            }
        }
        Self {
            file,
            items,
            related,
            left: MAX_LISTED,
        }
    }

    /// The faces and edges of some aspects and of those that they gather.
    fn faces_and_edges(&mut self, of: &[u64]) -> (Vec<u64>, Vec<u64>) {
        let mut seen: BTreeSet<u64> = of.iter().copied().collect();
        let mut open: Vec<u64> = of.to_vec();
        let (mut faces, mut edges) = (BTreeSet::new(), BTreeSet::new());
        while let Some(aspect) = open.pop() {
            for item in self.items.get(&aspect).into_iter().flatten() {
                let list = if self.file.is(*item, "ADVANCED_FACE") {
                    &mut faces
                } else if self.file.is(*item, "EDGE_CURVE") {
                    &mut edges
                } else {
                    continue;
                };
                if self.left > 0 && list.insert(*item) {
                    self.left -= 1;
                }
            }
            for part in self.related.get(&aspect).into_iter().flatten() {
                if seen.len() < MAX_ASPECTS && seen.insert(*part) {
                    open.push(*part);
                }
            }
        }
        (faces.into_iter().collect(), edges.into_iter().collect())
    }
}
