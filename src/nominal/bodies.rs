//! Bodies of a file and where the assembly puts them.

use std::collections::{BTreeMap, BTreeSet};

use glam::DMat3;

use super::part21::{Part21, Read, Units, refuse};
use super::shapes::Shapes;
use super::{NominalError, Refused};
use crate::geometry::{Frame, RigidTransform};

/// A solid or surface model at one of its places.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placed {
    /// Its entity.
    pub body: u64,
    pub units: Units,
    /// From the body's own coordinates (mm) to those of the file's root.
    pub root_from_body: RigidTransform,
}

/// Entity types that are bodies.
pub(super) const BODIES: [&str; 5] = [
    "MANIFOLD_SOLID_BREP",
    "BREP_WITH_VOIDS",
    "FACETED_BREP",
    "SHELL_BASED_SURFACE_MODEL",
    "FACE_BASED_SURFACE_MODEL",
];
/// Entity type of a wireframe: curves that bound no face.
const WIREFRAME: &str = "GEOMETRIC_CURVE_SET";
/// Places of bodies that one file may unfold into.
const MAX_PLACES: usize = 20_000;
/// Representations that the assemblies of one file may unfold into, those without bodies too.
const MAX_VISITS: usize = 10 * MAX_PLACES;
/// Levels of an assembly.
const MAX_LEVELS: usize = 64;

/// A representation seen from one that contains it.
#[derive(Debug, Clone, Copy)]
struct Child {
    representation: u64,
    parent_from_child: RigidTransform,
}

/// The representations of a file and how they contain each other.
struct Assembly<'a> {
    file: &'a Part21,
    children: BTreeMap<u64, Vec<Child>>,
    /// Bodies and wireframes that each representation holds itself, where that has been asked.
    held: BTreeMap<u64, Vec<u64>>,
    /// What representations are read in whose context gives no units.
    default_units: Units,
    /// Representations unfolded so far.
    visits: usize,
    refused: Vec<Refused>,
}

/// Bodies and wireframes at their places, and what of the assembly could not be read.
pub(super) struct Places {
    pub bodies: Vec<Placed>,
    pub wireframes: Vec<Placed>,
    pub refused: Vec<Refused>,
}

/// Every body at every place it has; bodies that no representation holds stand where they are.
pub(super) fn placed_bodies(file: &Part21, name: &str) -> Result<Places, NominalError> {
    let mut assembly = Assembly {
        file,
        children: BTreeMap::new(),
        held: BTreeMap::new(),
        default_units: any_units(file),
        visits: 0,
        refused: Vec::new(),
    };
    assembly.link();
    let contained: BTreeSet<u64> = assembly
        .children
        .values()
        .flatten()
        .map(|c| c.representation)
        .collect();
    let mut out = Vec::new();
    // A body that also stands in a representation of its own, outside the assembly, is no second body.
    let roots = assembly.representations().into_iter();
    let (assemblies, alone): (Vec<u64>, Vec<u64>) = roots
        .filter(|r| !contained.contains(r))
        .partition(|r| assembly.children.contains_key(r));
    let mut seen = BTreeSet::new();
    for root in assemblies.into_iter().chain(alone) {
        let mut found = Vec::new();
        let is_assembly = assembly.children.contains_key(&root);
        if !assembly.walk(root, RigidTransform::IDENTITY, &mut Vec::new(), &mut found) {
            return Err(NominalError::TooManyPlaces {
                name: name.into(),
                limit: MAX_PLACES,
            });
        }
        found.retain(|p| is_assembly || !seen.contains(&p.body));
        seen.extend(found.iter().map(|p| p.body));
        out.extend(found);
    }
    let default = assembly.default_units;
    for body in file.all(&BODIES).filter(|b| !seen.contains(b)) {
        out.push(Placed {
            body,
            units: default,
            root_from_body: RigidTransform::IDENTITY,
        });
    }
    // The same body at the same place from two representations counts once.
    let mut unique: Vec<Placed> = Vec::with_capacity(out.len());
    let mut by_body: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for p in out {
        let same = by_body.entry(p.body).or_default();
        if !same
            .iter()
            .any(|i| same_place(&unique[*i].root_from_body, &p.root_from_body))
        {
            same.push(unique.len());
            unique.push(p);
        }
    }
    let (wireframes, bodies) = unique.into_iter().partition(|p| file.is(p.body, WIREFRAME));
    Ok(Places {
        bodies,
        wireframes,
        refused: assembly.refused,
    })
}

fn same_place(a: &RigidTransform, b: &RigidTransform) -> bool {
    a.rotation.dot(b.rotation).abs() > 1.0 - 1e-12 && a.translation.distance(b.translation) < 1e-6
}

impl Assembly<'_> {
    /// Entities that are representations: they have items and a context.
    fn representations(&self) -> Vec<u64> {
        let is_representation = |id: &u64| {
            let t = self.file.type_of(*id);
            t.ends_with("REPRESENTATION") && t.contains("SHAPE") && self.items(*id).is_ok()
        };
        self.file
            .entities()
            .keys()
            .copied()
            .filter(is_representation)
            .collect()
    }

    fn items(&self, representation: u64) -> Read<Vec<u64>> {
        match self.file.part(representation, "REPRESENTATION", 0) {
            Some(part) => part.references(1),
            None => self.file.record(representation)?.references(1),
        }
    }

    /// The bodies and wireframes among the items of a representation.
    fn held(&mut self, representation: u64) -> &[u64] {
        if !self.held.contains_key(&representation) {
            let items = self.items(representation).unwrap_or_default();
            let is_held =
                |i: &u64| self.file.is(*i, WIREFRAME) || BODIES.iter().any(|b| self.file.is(*i, b));
            let held = items.into_iter().filter(is_held).collect();
            self.held.insert(representation, held);
        }
        &self.held[&representation]
    }

    fn context(&self, representation: u64) -> Read<u64> {
        match self.file.part(representation, "REPRESENTATION", 0) {
            Some(part) => part.reference(2),
            None => self.file.record(representation)?.reference(2),
        }
    }

    fn units(&mut self, representation: u64) -> Units {
        let read = self
            .context(representation)
            .and_then(|c| units_of_context(self.file, c));
        match read {
            Ok(units) => units,
            Err(why) => {
                if !self.refused.contains(&why) {
                    self.refused.push(why);
                }
                self.default_units
            }
        }
    }

    /// Finds which representation contains which.
    fn link(&mut self) {
        let placements = self.placed_components();
        let relations = [
            "SHAPE_REPRESENTATION_RELATIONSHIP",
            "REPRESENTATION_RELATIONSHIP",
        ];
        for id in self.file.all(&relations) {
            if let Err(why) = self.link_relation(id, &placements) {
                self.refused.push(why);
            }
        }
        let reps = self.representations();
        for parent in reps {
            let items = self.items(parent).unwrap_or_default();
            for item in items {
                if self.file.is(item, "MAPPED_ITEM")
                    && let Err(why) = self.link_mapped(parent, item)
                {
                    self.refused.push(why);
                }
            }
        }
    }

    /// Relation -> representations of the component that its occurrence (NEXT_ASSEMBLY_USAGE_OCCURRENCE) names.
    fn placed_components(&self) -> BTreeMap<u64, BTreeSet<u64>> {
        let mut shapes_of: BTreeMap<u64, BTreeSet<u64>> = BTreeMap::new();
        for sdr in self.file.all(&["SHAPE_DEFINITION_REPRESENTATION"]) {
            let Ok(r) = self.file.record(sdr) else {
                continue;
            };
            let (Ok(shape), Ok(representation)) = (r.reference(0), r.reference(1)) else {
                continue;
            };
            if let Ok(definition) = self.file.record(shape).and_then(|s| s.reference(2)) {
                shapes_of
                    .entry(definition)
                    .or_default()
                    .insert(representation);
            }
        }
        let mut out = BTreeMap::new();
        for c in self.file.all(&["CONTEXT_DEPENDENT_SHAPE_REPRESENTATION"]) {
            let component = || -> Read<(u64, u64)> {
                let r = self.file.record(c)?;
                let usage = self.file.record(r.reference(1)?)?.reference(2)?;
                Ok((r.reference(0)?, self.file.record(usage)?.reference(4)?))
            };
            if let Ok((relation, definition)) = component()
                && let Some(shapes) = shapes_of.get(&definition)
            {
                out.insert(relation, shapes.clone());
            }
        }
        out
    }

    fn link_relation(&mut self, id: u64, components: &BTreeMap<u64, BTreeSet<u64>>) -> Read<()> {
        let relation = match self.file.part(id, "REPRESENTATION_RELATIONSHIP", 0) {
            Some(part) => part,
            None => self.file.record(id)?,
        };
        let (first, second) = (relation.reference(2)?, relation.reference(3)?);
        let transformed = "REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION";
        let Some(part) = self.file.part(id, transformed, 4) else {
            // Two representations of one thing: the one with the bodies belongs to the other.
            let mut has_bodies = |r: u64| {
                let file = self.file;
                let is_body = |i: &u64| !file.is(*i, WIREFRAME);
                self.held(r).iter().any(is_body)
            };
            let (parent, child) = if has_bodies(first) && !has_bodies(second) {
                (second, first)
            } else {
                (first, second)
            };
            self.contain(parent, child, RigidTransform::IDENTITY);
            return Ok(());
        };
        let item = self
            .file
            .expect(part.reference(4)?, "ITEM_DEFINED_TRANSFORMATION")?;
        let (from, to) = (item.reference(2)?, item.reference(3)?);
        // The standard puts the component first; some writers do not, and the occurrence tells.
        let swapped = components
            .get(&id)
            .is_some_and(|c| c.contains(&second) && !c.contains(&first));
        let (child, parent, from, to) = if swapped {
            (second, first, to, from)
        } else {
            (first, second, from, to)
        };
        let child_place = self.place(child, from)?;
        let parent_place = self.place(parent, to)?;
        self.contain(parent, child, parent_place * child_place.inverse());
        Ok(())
    }

    fn link_mapped(&mut self, parent: u64, item: u64) -> Read<()> {
        let r = self.file.record(item)?;
        let map = self.file.record(r.reference(1)?)?;
        let (origin, child) = (map.reference(0)?, map.reference(1)?);
        let target = r.reference(2)?;
        if !self.file.is(target, "AXIS2_PLACEMENT_3D")
            || !self.file.is(origin, "AXIS2_PLACEMENT_3D")
        {
            return Err(refuse(
                item,
                format!("a placement by {} is not read", self.file.type_of(target)),
            ));
        }
        let child_place = self.place(child, origin)?;
        let parent_place = self.place(parent, target)?;
        self.contain(parent, child, parent_place * child_place.inverse());
        Ok(())
    }

    fn contain(&mut self, parent: u64, representation: u64, parent_from_child: RigidTransform) {
        if parent != representation {
            self.children.entry(parent).or_default().push(Child {
                representation,
                parent_from_child,
            });
        }
    }

    fn place(&mut self, representation: u64, placement: u64) -> Read<RigidTransform> {
        let units = self.units(representation);
        let frame = Shapes {
            file: self.file,
            units,
        }
        .placement(placement)?;
        Ok(transform_of(&frame))
    }

    /// Collects the bodies of a representation and of those in it; false where there are too many.
    fn walk(
        &mut self,
        representation: u64,
        root_from_here: RigidTransform,
        trail: &mut Vec<u64>,
        out: &mut Vec<Placed>,
    ) -> bool {
        self.visits += 1;
        if self.visits > MAX_VISITS {
            return false;
        }
        if trail.contains(&representation) {
            return true;
        }
        if trail.len() >= MAX_LEVELS {
            self.refused.push(refuse(
                representation,
                format!("an assembly of more than {MAX_LEVELS} levels"),
            ));
            return true;
        }
        let bodies = self.held(representation).to_vec();
        if !bodies.is_empty() {
            let units = self.units(representation);
            out.extend(bodies.into_iter().map(|body| Placed {
                body,
                units,
                root_from_body: root_from_here,
            }));
        }
        if out.len() > MAX_PLACES {
            return false;
        }
        trail.push(representation);
        let children = self.children.get(&representation).cloned();
        for child in children.unwrap_or_default() {
            let root_from_child = root_from_here * child.parent_from_child;
            if !self.walk(child.representation, root_from_child, trail, out) {
                return false;
            }
        }
        trail.pop();
        true
    }
}

/// Units of the first context that has a length unit; mm and rad in a file without one.
fn any_units(file: &Part21) -> Units {
    file.all(&["GLOBAL_UNIT_ASSIGNED_CONTEXT"])
        .find_map(|c| units_of_context(file, c).ok())
        .unwrap_or(Units {
            length_mm: 1.0,
            angle_rad: 1.0,
        })
}

fn transform_of(frame: &Frame) -> RigidTransform {
    RigidTransform::from_matrix(DMat3::from_cols(frame.x, frame.y, frame.z), frame.origin)
}

/// Length and angle units of a representation context.
fn units_of_context(file: &Part21, context: u64) -> Read<Units> {
    let assigned = match file.part(context, "GLOBAL_UNIT_ASSIGNED_CONTEXT", 0) {
        Some(part) => part.references(0)?,
        None => {
            let r = file.record(context)?;
            if r.name != "GLOBAL_UNIT_ASSIGNED_CONTEXT" {
                return Err(refuse(context, "a context without units"));
            }
            r.references(2)?
        }
    };
    let (mut length_mm, mut angle_rad) = (None, None);
    for unit in assigned {
        if file.is(unit, "LENGTH_UNIT") {
            length_mm = Some(si_factor(file, unit, 0)? * 1000.0);
        } else if file.is(unit, "PLANE_ANGLE_UNIT") {
            angle_rad = Some(si_factor(file, unit, 0)?);
        }
    }
    Ok(Units {
        length_mm: length_mm.ok_or_else(|| refuse(context, "a context without a length unit"))?,
        angle_rad: angle_rad.unwrap_or(1.0),
    })
}

/// Factor from a unit to metre or radian.
pub(super) fn si_factor(file: &Part21, unit: u64, depth: usize) -> Read<f64> {
    if depth > 8 {
        return Err(refuse(unit, "a unit defined by itself"));
    }
    if let Some(si) = file.part(unit, "SI_UNIT", 0) {
        return prefix_factor(unit, si.word(0));
    }
    let conversion = file
        .part(unit, "CONVERSION_BASED_UNIT", 0)
        .ok_or_else(|| refuse(unit, format!("a unit of type {}", file.type_of(unit))))?;
    let measure = conversion.reference(1)?;
    let (value, base) = match file.part(measure, "MEASURE_WITH_UNIT", 0) {
        Some(part) => (part.number(0)?, part.reference(1)?),
        None => {
            let r = file.record(measure)?;
            (r.number(0)?, r.reference(1)?)
        }
    };
    let factor = value * si_factor(file, base, depth + 1)?;
    if factor.is_finite() && (1e-15..1e15).contains(&factor) {
        Ok(factor)
    } else {
        Err(refuse(unit, format!("a unit of {factor} m or rad")))
    }
}

fn prefix_factor(unit: u64, prefix: Option<&str>) -> Read<f64> {
    let power = match prefix {
        None => 0,
        Some("KILO") => 3,
        Some("HECTO") => 2,
        Some("DECA") => 1,
        Some("DECI") => -1,
        Some("CENTI") => -2,
        Some("MILLI") => -3,
        Some("MICRO") => -6,
        Some("NANO") => -9,
        Some(other) => return Err(refuse(unit, format!("a unit with prefix {other}"))),
    };
    Ok(10f64.powi(power))
}
