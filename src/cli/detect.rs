//! `acies detect`: which points of a scan lie on sharp edges, corners and boundaries.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::anyhow;
use clap::ValueEnum;

use super::{Failure, Status, print_line};
use crate::features::{Class, Detection, Method, detect};
use crate::points::picture::{self, ViewDirection, render};
use crate::points::write::write_atomically;
use crate::points::{Column, Encoding, Neighbors, PointCloud, PointsError, Unit, read, write_ply};

/// Find the points of a scan that lie on sharp edges, corners and boundaries.
///
/// Spacing and noise are measured from the points, and every threshold follows from them: there is nothing to set. What is found is thin:
/// points within about one spacing of the edge.
#[derive(Debug, clap::Args)]
pub struct Detect {
    /// PLY, PCD, XYZ or CSV text, STL or OBJ.
    scan: PathBuf,
    /// Where to write the result: PLY with x y z (double) and feature (uchar: 0 none, 1 edge, 2 corner, 3 boundary), or a PNG picture.
    #[arg(short = 'o', long = "output", value_name = "OUT.ply|.png")]
    output: Option<PathBuf>,
    /// How edges are looked for.
    #[arg(long, value_enum, default_value = "adaptive")]
    method: MethodName,
    /// Unit of the scan's coordinates: um, mm, cm, m or inch.
    #[arg(long, default_value = "mm")]
    unit: Unit,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// The methods by their names on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum MethodName {
    /// Surfaces fitted on both sides; for all data.
    Adaptive,
    /// Gauss-map clustering with one sensitivity (Weber 2011), for comparison.
    Global,
    /// Multi-scale surface variation (Pauly et al. 2003), for comparison.
    Variation,
}

/// What the command says about its work.
#[derive(Debug, serde::Serialize)]
struct Summary<'a> {
    points: usize,
    edges: usize,
    corners: usize,
    boundaries: usize,
    spacing_mm: f64,
    spacing_along_mm: f64,
    spacing_across_mm: f64,
    noise_mm: f64,
    findings: &'a [String],
    seconds: BTreeMap<&'a str, f64>,
}

enum Form {
    Ply,
    Png,
}

impl Detect {
    /// Carries the command out.
    ///
    /// # Errors
    /// [`Failure::BadInput`] for a scan that cannot be read, [`Failure::Usage`] for an output whose ending names no form, [`Failure::Io`]
    /// where the result cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let form = self.output.as_deref().map(form_of).transpose()?;
        let start = Instant::now();
        let scan = read(&self.scan, self.unit).map_err(reading)?;
        let read_seconds = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let neighbors = Neighbors::new(&scan.cloud.positions);
        let neighbour_seconds = start.elapsed().as_secs_f64();
        let method = match self.method {
            MethodName::Adaptive => Method::Adaptive,
            MethodName::Global => Method::Global,
            MethodName::Variation => Method::Variation,
        };
        let mut detection = detect(&scan.cloud, &neighbors, method);
        detection.findings.splice(0..0, scan.findings);
        detection
            .seconds
            .extend([("read", read_seconds), ("neighbours", neighbour_seconds)]);
        if let (Some(path), Some(form)) = (&self.output, form) {
            write(path, &form, &scan.cloud, &detection)?;
        }
        self.say(&detection)?;
        Ok(Status::Done)
    }

    fn say(&self, detection: &Detection) -> Result<(), Failure> {
        let summary = Summary {
            points: detection.classes.len(),
            edges: detection.count(Class::Edge),
            corners: detection.count(Class::Corner),
            boundaries: detection.count(Class::Boundary),
            spacing_mm: detection.spacing.mean_mm,
            spacing_along_mm: detection.spacing.along_mm,
            spacing_across_mm: detection.spacing.across_mm,
            noise_mm: detection.noise_mm,
            findings: &detection.findings,
            seconds: detection.seconds.iter().copied().collect(),
        };
        if self.json {
            let text = serde_json::to_string(&summary).map_err(|e| Failure::Internal(e.into()))?;
            return print_line(&text);
        }
        print_line(&format!(
            "{} points: {} on edges, {} on corners, {} on boundaries; spacing {:.4} mm, noise {:.4} mm",
            summary.points,
            summary.edges,
            summary.corners,
            summary.boundaries,
            summary.spacing_mm,
            summary.noise_mm,
        ))?;
        for finding in summary.findings {
            print_line(&format!("note: {finding}"))?;
        }
        Ok(())
    }
}

fn form_of(path: &Path) -> Result<Form, Failure> {
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    match ending.to_ascii_lowercase().as_str() {
        "ply" => Ok(Form::Ply),
        "png" => Ok(Form::Png),
        _ => Err(Failure::Usage(anyhow!(
            "{}: its ending is `{ending}`, expected ply or png; name the output so",
            path.display()
        ))),
    }
}

fn reading(error: PointsError) -> Failure {
    match error {
        PointsError::Read { .. } | PointsError::Write { .. } => Failure::Io(error.into()),
        _ => Failure::BadInput(error.into()),
    }
}

fn write(
    path: &Path,
    form: &Form,
    cloud: &PointCloud,
    detection: &Detection,
) -> Result<(), Failure> {
    let written = match form {
        Form::Ply => {
            let features: Vec<u8> = detection.classes.iter().map(|c| *c as u8).collect();
            let columns = [Column::U8("feature", &features)];
            write_ply(path, &cloud.positions, &columns, Encoding::LittleEndian)
        }
        Form::Png => {
            const SIZE_PX: (u32, u32) = (1600, 1200);
            let colours: Vec<[u8; 3]> = detection.classes.iter().map(colour).collect();
            let picture = render(&cloud.positions, &colours, ViewDirection::Auto, SIZE_PX);
            write_atomically(path, &picture)
        }
    };
    written.map_err(|e| Failure::Io(e.into()))
}

fn colour(class: &Class) -> [u8; 3] {
    match class {
        Class::None => picture::NONE,
        Class::Edge => picture::EDGE,
        Class::Corner => picture::CORNER,
        Class::Boundary => picture::BOUNDARY,
    }
}
