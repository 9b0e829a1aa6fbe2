//! The datum features of a recipe, looked up on the nominal.

use super::align::{DatumFeature, DatumPlace};
use super::body::Body;
use super::recipe::{DatumRecipe, DatumSource};
use crate::nominal::PmiKind;

/// The faces and places that the recipe's datums name, or for each that is not on the nominal its key, what was found and what was
/// expected.
pub fn datum_features<B: Body>(
    nominal: &B,
    datums: &[DatumRecipe],
) -> (Vec<DatumFeature>, Vec<Unknown>) {
    let (mut features, mut unknown) = (Vec::new(), Vec::new());
    for datum in datums {
        let place = match &datum.source {
            DatumSource::Point {
                nominal,
                direction,
                radius_mm,
            } => Ok(DatumPlace::Point {
                nominal: *nominal,
                direction: *direction,
                radius_mm: *radius_mm,
            }),
            DatumSource::Faces(entities) => faces(nominal, entities).map_err(|entity| {
                (
                    format!("#{entity}"),
                    "the STEP entity of a face of the nominal".to_owned(),
                )
            }),
            DatumSource::Pmi(letter) => of_letter(nominal, letter),
        };
        match place {
            Ok(place) => features.push(DatumFeature {
                name: datum.name.clone(),
                priority: datum.priority,
                place,
            }),
            Err((found, expected)) => unknown.push(Unknown {
                name: datum.name.clone(),
                found,
                expected,
            }),
        }
    }
    (features, unknown)
}

/// A datum of the recipe that the nominal does not have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unknown {
    /// Its name in the recipe.
    pub name: String,
    /// What the recipe gives.
    pub found: String,
    /// What it should give.
    pub expected: String,
}

/// Indices of the faces with these entities, or the first entity that is none.
fn faces<B: Body>(nominal: &B, entities: &[u64]) -> Result<DatumPlace, u64> {
    let index = |entity: &u64| {
        let mut all = 0..nominal.face_count() as u32;
        all.find(|face| nominal.face_entity(*face) == *entity)
            .ok_or(*entity)
    };
    let faces: Result<Vec<u32>, u64> = entities.iter().map(index).collect();
    faces.map(DatumPlace::Faces)
}

fn of_letter<B: Body>(nominal: &B, letter: &str) -> Result<DatumPlace, (String, String)> {
    let mut letters = Vec::new();
    for pmi in nominal.pmi() {
        let PmiKind::DatumFeature { letter: own } = &pmi.kind else {
            continue;
        };
        if own == letter && !pmi.faces.is_empty() {
            return faces(nominal, &pmi.faces).map_err(|entity| {
                (
                    format!("PMI datum {letter} on #{entity}"),
                    "a datum on faces that were read".to_owned(),
                )
            });
        }
        letters.push(own.clone());
    }
    letters.sort();
    letters.dedup();
    let expected = if letters.is_empty() {
        "a nominal with semantic datum features (AP242); it has none".to_owned()
    } else {
        format!("a letter among {} with faces", letters.join(", "))
    };
    Err((format!("PMI datum {letter}"), expected))
}
