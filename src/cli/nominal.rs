//! `acies nominal`: what a CAD file holds.

mod page;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use glam::DVec3;
use serde::Serialize;

use super::{Failure, Status, print_line};
use crate::nominal::{EdgeKind, Measure, Nominal, NominalError, Pmi, PmiKind, SharpEdge};

/// Show faces, edges and sharp edges of a CAD file as read, and what was refused and why.
///
/// Reads STEP (AP203, AP214, AP242) and IGES with exact geometry. A sharp edge is one whose two faces turn by 5 degrees or more;
/// it carries the number of its EDGE_CURVE in the file (IGES: of its curve in the directory). Lengths are in mm whatever the unit of the file.
#[derive(Debug, clap::Args)]
pub struct Nominals {
    /// The CAD file (.stp, .step, .igs, .iges)
    part: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// List every sharp edge
    #[arg(long)]
    edges: bool,
    /// Write a page that shows the part and its sharp edges (.html): one file, for any browser
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Debug, Serialize)]
struct Summary {
    part: String,
    bodies: usize,
    faces: usize,
    edges: usize,
    sharp_edges: usize,
    wires: usize,
    bounding_box_mm: [[f64; 3]; 2],
    faces_bounding_box_mm: [[f64; 3]; 2],
    area_mm2: f64,
    edge_length_mm: f64,
    refused: Vec<Refusal>,
    pmi: Vec<PmiRow>,
    seconds: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    sharp_edge_list: Option<Vec<EdgeRow>>,
}

#[derive(Debug, Serialize)]
struct Refusal {
    entity: u64,
    reason: String,
}

/// Semantic PMI as JSON: lengths in mm, angles in degrees.
#[derive(Debug, Serialize)]
struct PmiRow {
    entity: u64,
    #[serde(skip_serializing_if = "String::is_empty")]
    name: String,
    kind: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    what: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    unit: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    deviations: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    datums: Vec<String>,
    /// Only where its zone lies unevenly about the nominal.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    unequal: bool,
    faces: Vec<u64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    edges: Vec<u64>,
}

impl PmiRow {
    fn new(p: &Pmi) -> Self {
        let mut row = Self {
            entity: p.entity,
            name: p.name.clone(),
            kind: "datum_feature",
            what: None,
            value: None,
            unit: None,
            deviations: None,
            datums: Vec::new(),
            unequal: false,
            faces: p.faces.clone(),
            edges: p.edges.clone(),
        };
        match &p.kind {
            PmiKind::Dimension {
                what,
                value,
                deviations,
            } => {
                let (unit, factor) = match value {
                    Measure::Length(_) => ("mm", 1.0),
                    Measure::Angle(_) => ("deg", 1f64.to_degrees()),
                };
                row.kind = "dimension";
                row.what = Some(what.clone());
                row.value = Some(value.value() * factor);
                row.unit = Some(unit);
                row.deviations = deviations.map(|d| d.map(|x| x * factor));
            }
            PmiKind::Tolerance {
                what,
                zone_mm,
                datums,
                unequal,
            } => {
                row.unequal = *unequal;
                row.kind = "tolerance";
                row.what = Some(what.clone());
                row.value = Some(*zone_mm);
                row.unit = Some("mm");
                row.datums.clone_from(datums);
            }
            PmiKind::DatumFeature { letter } => row.datums.push(letter.clone()),
        }
        row
    }
}

#[derive(Debug, Serialize)]
struct EdgeRow {
    id: String,
    nominal_entity: u64,
    kind: &'static str,
    curve: &'static str,
    length_mm: f64,
    closed: bool,
    turn_angle_deg: f64,
    faces: [u64; 2],
    surfaces: [&'static str; 2],
    from_mm: [f64; 3],
    to_mm: [f64; 3],
}

impl Nominals {
    /// Reads the file and prints what it holds.
    ///
    /// # Errors
    /// [`Failure::Io`] where the file cannot be read, [`Failure::BadInput`] where it is no usable STEP file.
    pub fn run(self) -> Result<Status, Failure> {
        let start = Instant::now();
        let nominal = Nominal::read(&self.part).map_err(|e| match e {
            NominalError::Io { .. } => Failure::Io(e.into()),
            _ => Failure::BadInput(e.into()),
        })?;
        if let Some(path) = &self.output {
            write_page(&nominal, path)?;
        }
        let summary = summarise(&nominal, self.edges, start);
        if self.json {
            let text = serde_json::to_string(&summary)
                .context("the summary of the part")
                .map_err(Failure::Internal)?;
            print_line(&text)?;
        } else {
            print_line(&table(&summary))?;
        }
        Ok(Status::Done)
    }
}

fn write_page(nominal: &Nominal, path: &Path) -> Result<(), Failure> {
    if path
        .extension()
        .is_none_or(|e| !e.eq_ignore_ascii_case("html"))
    {
        return Err(Failure::Usage(anyhow::anyhow!(
            "{}: expected a name that ends in .html",
            path.display()
        )));
    }
    let text = page::page(nominal)
        .context("the page of the part")
        .map_err(Failure::Internal)?;
    std::fs::write(path, text)
        .with_context(|| format!("{}: cannot be written", path.display()))
        .map_err(Failure::Io)
}

fn triples(bounds: [DVec3; 2]) -> [[f64; 3]; 2] {
    bounds.map(|p| p.to_array())
}

fn summarise(nominal: &Nominal, edges: bool, start: Instant) -> Summary {
    let refused = nominal.refused.iter().map(|r| Refusal {
        entity: r.entity,
        reason: r.reason.clone(),
    });
    let rows = || nominal.sharp_edges.iter().map(|e| row(nominal, e));
    Summary {
        part: nominal.name.clone(),
        bodies: nominal.bodies,
        faces: nominal.faces.len(),
        edges: nominal.edges.len(),
        sharp_edges: nominal.sharp_edges.len(),
        wires: nominal.wires.len(),
        bounding_box_mm: triples(nominal.bounding_box_mm),
        faces_bounding_box_mm: triples(nominal.faces_box_mm),
        area_mm2: nominal.area_mm2(),
        edge_length_mm: nominal.edge_length_mm(),
        refused: refused.collect(),
        pmi: nominal.pmi().iter().map(PmiRow::new).collect(),
        sharp_edge_list: edges.then(|| rows().collect()),
        seconds: start.elapsed().as_secs_f64(),
    }
}

fn row(nominal: &Nominal, edge: &SharpEdge) -> EdgeRow {
    let face = |i: usize| &nominal.faces[edge.faces[i] as usize];
    let at = |s_mm: f64| edge.point(s_mm).to_array();
    EdgeRow {
        id: edge.id.clone(),
        nominal_entity: edge.entity,
        kind: match edge.kind {
            EdgeKind::Convex => "convex",
            EdgeKind::Concave => "concave",
        },
        curve: edge.curve().kind(),
        length_mm: edge.length_mm,
        closed: edge.closed,
        turn_angle_deg: edge
            .turn_angle_rad(nominal, 0.5 * edge.length_mm)
            .to_degrees(),
        faces: [face(0).entity, face(1).entity],
        surfaces: [face(0).surface.kind(), face(1).surface.kind()],
        from_mm: at(0.0),
        to_mm: at(edge.length_mm),
    }
}

fn table(s: &Summary) -> String {
    let [low, high] = s.bounding_box_mm;
    let mut out = vec![
        format!("part          {}", s.part),
        format!("bodies        {}", s.bodies),
        format!("faces         {}, {:.3} mm2", s.faces, s.area_mm2),
        format!("edges         {}, {:.3} mm", s.edges, s.edge_length_mm),
        format!("sharp edges   {}", s.sharp_edges),
        format!(
            "box           {:.3} {:.3} {:.3} to {:.3} {:.3} {:.3} mm",
            low[0], low[1], low[2], high[0], high[1], high[2]
        ),
    ];
    if s.wires > 0 {
        out.push(format!(
            "wires         {} (in the box, never measured)",
            s.wires
        ));
    }
    out.push(format!("refused       {}", s.refused.len()));
    out.extend(
        s.refused
            .iter()
            .map(|r| format!("  #{}: {}", r.entity, r.reason)),
    );
    for e in s.sharp_edge_list.iter().flatten() {
        out.push(format!(
            "{:<6} #{:<8} {:<8} {:<15} {:>12.4} mm {:>8.3} deg  {} / {}{}",
            e.id,
            e.nominal_entity,
            e.kind,
            e.curve,
            e.length_mm,
            e.turn_angle_deg,
            e.surfaces[0],
            e.surfaces[1],
            if e.closed { "  closed" } else { "" },
        ));
    }
    out.join("\n")
}
