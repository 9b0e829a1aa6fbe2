//! `acies check CELL.toml`: everything wrong with a configuration, touching no device.

use std::path::{Path, PathBuf};

use acies_drivers::device::Mistake;
use anyhow::anyhow;

use super::{Failure, Status, print_line};
use crate::cell::{self, CellError};
use crate::config::{Cell, ConfigErrors, LocatedMistake};

/// Reads a cell's configuration, its part and its recipe, and lists every mistake with its line.
#[derive(Debug, clap::Args)]
pub struct Check {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Check {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input when the configuration has a mistake.
    pub fn run(self) -> Result<Status, Failure> {
        let checked = Cell::read(&self.cell).map_err(|errors| errors.mistakes);
        let checked = checked.and_then(|cell| check_part(&cell).map(|()| cell));
        if self.json {
            let mistakes = checked.as_ref().err().into_iter().flatten();
            let mistakes: Vec<serde_json::Value> = mistakes.map(as_json).collect();
            let told = serde_json::json!({ "cell": self.cell, "mistakes": mistakes });
            print_line(&told.to_string())?;
        }
        let cell = checked.map_err(|mistakes| {
            let n = mistakes.len();
            let errors = ConfigErrors { mistakes };
            Failure::BadInput(anyhow!(
                "{n} mistake{} in the configuration\n{errors}",
                if n == 1 { "" } else { "s" }
            ))
        })?;
        if !self.json {
            let (profilers, probes) = (cell.profilers.len(), cell.probes.len());
            let file = self.cell.display();
            print_line(&format!(
                "{file}: cell {:?} is in order: profilers {profilers}, probes {probes}",
                cell.name
            ))?;
        }
        Ok(Status::Done)
    }
}

/// Reads the part and its recipe, and looks for the faces and edges that the recipe names.
fn check_part(cell: &Cell) -> Result<(), Vec<LocatedMistake>> {
    let told = |file: &Path, key: &str, found: String, expected: &str| LocatedMistake {
        file: file.to_owned(),
        line: None,
        place: String::new(),
        mistake: Mistake {
            key: key.to_owned(),
            found,
            expected: expected.to_owned(),
        },
    };
    let recipe_file = cell.recipe.as_deref().unwrap_or(Path::new("recipe"));
    let part = cell::read_part(cell).map_err(|error| match error {
        CellError::Nominal(error) => {
            vec![told(
                &cell.nominal,
                "nominal",
                error.to_string(),
                "a CAD file that can be read",
            )]
        }
        other => vec![told(
            recipe_file,
            "recipe",
            other.to_string(),
            "a recipe without mistakes",
        )],
    })?;
    let (nominal, recipe) = (part.nominal, part.recipe);
    let is_face = |entity: &u64| nominal.faces.iter().any(|face| face.entity == *entity);
    let facts = crate::inspect::all_edge_facts(&nominal);
    let faces = recipe
        .datum_faces
        .iter()
        .filter(|entity| !is_face(entity))
        .map(|entity| {
            told(
                recipe_file,
                "datum_faces",
                format!("#{entity}"),
                "a face of the nominal",
            )
        });
    let (_, unknown) = crate::inspect::datums::datum_features(&nominal, &recipe.datums);
    let datums = unknown.into_iter().map(|datum| {
        let key = format!("alignment.datum {:?}", datum.name);
        told(recipe_file, &key, datum.found, &datum.expected)
    });
    let edges = recipe
        .edges
        .iter()
        .filter(|edge| !facts.iter().any(|facts| edge.select.means(facts)))
        .map(|edge| {
            told(
                recipe_file,
                "edge",
                edge.select.words(),
                "a sharp edge of the nominal",
            )
        });
    let mistakes: Vec<LocatedMistake> = faces.chain(datums).chain(edges).collect();
    if mistakes.is_empty() {
        Ok(())
    } else {
        Err(mistakes)
    }
}

fn as_json(mistake: &LocatedMistake) -> serde_json::Value {
    serde_json::json!({
        "line": mistake.line,
        "place": mistake.place,
        "key": mistake.mistake.key,
        "found": mistake.mistake.found,
        "expected": mistake.mistake.expected,
    })
}
