//! `acies detect SCAN`: which points of a scan lie on sharp edges, corners and boundaries.

use std::path::{Path, PathBuf};

use anyhow::anyhow;

use super::progress::Working;
use super::{Failure, Status, print_line};
use crate::features::{Class, Detection, Method, detect};
use crate::points::picture::{self, ViewDirection};
use crate::points::write::write_atomically;
use crate::points::{self, Column, Neighbors, PointsError, Unit, write_ply};

/// Size of a picture, pixels.
const PICTURE_PX: (u32, u32) = (1600, 1200);

/// Finds the points that lie on a sharp edge, on a corner or on the boundary of the data.
///
/// Needs nothing but coordinates; scale, noise and thresholds are estimated from the scan. Where the scan says which profile and
/// column a point comes from, that is used.
#[derive(Debug, clap::Args)]
pub struct Detect {
    /// The scan: PLY, PCD, STL, OBJ or text with columns x y z.
    scan: PathBuf,
    /// Write the points, in the order of the scan, with their class (.ply: `x y z` double, `feature` uchar: 0 none, 1 edge,
    /// 2 corner, 3 boundary), or a picture of them (.png). May be given several times.
    #[arg(short, long, value_name = "OUT")]
    output: Vec<PathBuf>,
    /// adaptive is the one to use; the other two are those of the literature, for comparison.
    #[arg(long, default_value = "adaptive")]
    method: MethodName,
    /// Unit of the scan: um, mm, cm, m or in. PLY, PCD and STL do not say.
    #[arg(long, default_value = "mm")]
    unit: Unit,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum MethodName {
    /// Surfaces fitted on both sides; every threshold follows from the data.
    Adaptive,
    /// Gauss-map clustering with one sensitivity for all points (Weber 2011).
    Global,
    /// Multi-scale surface variation (Pauly et al. 2003).
    Variation,
}

impl From<MethodName> for Method {
    fn from(name: MethodName) -> Self {
        match name {
            MethodName::Adaptive => Method::Adaptive,
            MethodName::Global => Method::Global,
            MethodName::Variation => Method::Variation,
        }
    }
}

impl Detect {
    /// Carries the command out.
    ///
    /// # Errors
    /// Bad input where the scan cannot be understood; input or output where a file cannot be read or written.
    pub fn run(self) -> Result<Status, Failure> {
        for path in &self.output {
            form_of(path)?;
        }
        let read = points::read(&self.scan, self.unit).map_err(|error| match error {
            PointsError::Read { .. } => Failure::Io(error.into()),
            _ => Failure::BadInput(error.into()),
        })?;
        let working = Working::begin("looking for edges");
        let neighbors = Neighbors::new(&read.cloud.positions);
        let detection = detect(&read.cloud, &neighbors, self.method.into());
        working.end();
        for path in &self.output {
            write(path, &read.cloud.positions, &detection.classes)?;
        }
        let findings: Vec<&String> = read.findings.iter().chain(&detection.findings).collect();
        if self.json {
            print_line(&as_json(&detection, &findings).to_string())?;
        } else {
            print_line(&in_words(&detection))?;
            for finding in findings {
                print_line(&format!("finding: {finding}"))?;
            }
        }
        Ok(Status::Done)
    }
}

enum Form {
    Ply,
    Png,
}

fn form_of(path: &Path) -> Result<Form, Failure> {
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("ply") => Ok(Form::Ply),
        Some("png") => Ok(Form::Png),
        _ => Err(Failure::Usage(anyhow!(
            "{}: the ending says in which form to write, expected .ply or .png",
            path.display()
        ))),
    }
}

fn write(path: &Path, positions: &[glam::DVec3], classes: &[Class]) -> Result<(), Failure> {
    let written = match form_of(path)? {
        Form::Ply => {
            let features: Vec<u8> = classes.iter().map(|&class| class as u8).collect();
            write_ply(
                path,
                positions,
                &[Column::U8("feature", &features)],
                points::Encoding::LittleEndian,
            )
        }
        Form::Png => {
            let colours: Vec<[u8; 3]> = classes.iter().map(|&class| colour(class)).collect();
            let png = picture::render(positions, &colours, ViewDirection::Auto, PICTURE_PX);
            write_atomically(path, &png)
        }
    };
    written.map_err(|error| Failure::Io(error.into()))
}

fn colour(class: Class) -> [u8; 3] {
    match class {
        Class::None => picture::NONE,
        Class::Edge => picture::EDGE,
        Class::Corner => picture::CORNER,
        Class::Boundary => picture::BOUNDARY,
    }
}

fn as_json(detection: &Detection, findings: &[&String]) -> serde_json::Value {
    let seconds: serde_json::Map<String, serde_json::Value> = detection
        .seconds
        .iter()
        .map(|(stage, seconds)| ((*stage).to_owned(), (*seconds).into()))
        .collect();
    serde_json::json!({
        "points": detection.classes.len(),
        "edges": detection.count(Class::Edge),
        "corners": detection.count(Class::Corner),
        "boundaries": detection.count(Class::Boundary),
        "spacing_mm": detection.spacing.mean_mm,
        "spacing_along_mm": detection.spacing.along_mm,
        "spacing_across_mm": detection.spacing.across_mm,
        "noise_mm": detection.noise_mm,
        "findings": findings,
        "seconds": seconds,
    })
}

fn in_words(detection: &Detection) -> String {
    format!(
        "{} points: {} on edges, {} on corners, {} on boundaries; spacing {:.4} mm, noise {:.4} mm, {:.2} s",
        detection.classes.len(),
        detection.count(Class::Edge),
        detection.count(Class::Corner),
        detection.count(Class::Boundary),
        detection.spacing.mean_mm,
        detection.noise_mm,
        detection
            .seconds
            .iter()
            .map(|(_, seconds)| seconds)
            .sum::<f64>()
    )
}
