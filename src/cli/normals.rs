//! `acies normals`: the outward normal at every point of a scan.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::anyhow;
use clap::ValueEnum;
use glam::Vec3;
use indexmap::IndexMap;

use super::{Failure, Status, print_line};
use crate::mesh::{Body, Rings, Settings, normals, orient_normals};
use crate::points::{Column, Encoding, Neighbors, PointsError, Unit, read, write_ply};
use crate::surface::{plane_normals, weighted_plane_normals};

/// Find the normal at every point of a scan, all to one side of the surface.
///
/// The result has the points in the order of the scan with their unit normals; a normal of zero says that nothing is known there.
#[derive(Debug, clap::Args)]
pub struct NormalsCommand {
    /// PLY, PCD, XYZ or CSV text, STL or OBJ.
    scan: PathBuf,
    /// Where to write the result: PLY with x y z nx ny nz (double).
    #[arg(short = 'o', long = "output", value_name = "OUT.ply")]
    output: Option<PathBuf>,
    /// Where normals come from.
    #[arg(long, value_enum, default_value = "umbrella")]
    method: MethodName,
    /// Unit of the scan's coordinates: um, mm, cm, m or inch.
    #[arg(long, default_value = "mm")]
    unit: Unit,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// The methods by their names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
enum MethodName {
    /// The triangles of the mesh through the points; keeps both sides of an edge apart.
    Umbrella,
    /// Planes through 30 neighbours (Hoppe et al. 1992), for comparison.
    Plane,
    /// Weighted planes through 40 neighbours (Pauly et al. 2003), for comparison.
    WeightedPlane,
}

/// What the command says about its work.
#[derive(Debug, serde::Serialize)]
struct Summary {
    points: usize,
    method: MethodName,
    /// Rings of triangles looked at, chosen by the noise; none for planes.
    rings: Option<u8>,
    /// Normals that come from a weighted plane for want of triangles.
    by_plane: usize,
    /// Points without a normal.
    without: usize,
    findings: Vec<String>,
    seconds: IndexMap<&'static str, f64>,
}

impl NormalsCommand {
    /// Carries the command out.
    ///
    /// # Errors
    /// [`Failure::BadInput`] for a scan that cannot be read or has no surface, [`Failure::Usage`] for an output that is no PLY,
    /// [`Failure::Io`] where the result cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        if let Some(path) = &self.output {
            let ending = path.extension().unwrap_or_default().to_string_lossy();
            if !ending.eq_ignore_ascii_case("ply") {
                let text = format!("its ending is `{ending}`, expected ply; name the output so");
                return Err(Failure::Usage(anyhow!("{}: {text}", path.display())));
            }
        }
        let mut seconds = IndexMap::new();
        let start = Instant::now();
        let scan = read(&self.scan, self.unit).map_err(reading)?;
        seconds.insert("read", start.elapsed().as_secs_f64());
        let start = Instant::now();
        let neighbors = Neighbors::new(&scan.cloud.positions);
        seconds.insert("neighbours", start.elapsed().as_secs_f64());
        let positions = &scan.cloud.positions;
        let (mut rings, mut by_plane) = (None, 0);
        let start = Instant::now();
        let found = match self.method {
            MethodName::Umbrella => {
                let body = Body::new(positions, Settings::default()).map_err(|error| {
                    Failure::BadInput(anyhow!("{}: {error}", self.scan.display()))
                })?;
                seconds.extend(body.seconds.iter().copied());
                let found = normals(&body, &scan.cloud, &neighbors, Rings::Auto);
                rings = Some(match found.rings {
                    Rings::Two => 2,
                    Rings::Three => 3,
                    _ => 1,
                });
                by_plane = found.by_plane;
                found.normals
            }
            MethodName::Plane | MethodName::WeightedPlane => {
                let mut found = if self.method == MethodName::Plane {
                    plane_normals(positions, &neighbors, 30)
                } else {
                    weighted_plane_normals(positions, &neighbors, 40)
                };
                orient_normals(positions, &neighbors, &mut found);
                found
            }
        };
        seconds.insert("normals", start.elapsed().as_secs_f64());
        if let Some(path) = &self.output {
            let part = |axis: usize| found.iter().map(|n| f64::from(n[axis])).collect();
            let [nx, ny, nz]: [Vec<f64>; 3] = [part(0), part(1), part(2)];
            let columns = [
                Column::F64("nx", &nx),
                Column::F64("ny", &ny),
                Column::F64("nz", &nz),
            ];
            write_ply(path, positions, &columns, Encoding::LittleEndian)
                .map_err(|e| Failure::Io(e.into()))?;
        }
        let summary = Summary {
            points: positions.len(),
            method: self.method,
            rings,
            by_plane,
            without: found.iter().filter(|n| **n == Vec3::ZERO).count(),
            findings: scan.findings,
            seconds,
        };
        self.say(&summary)?;
        Ok(Status::Done)
    }

    fn say(&self, summary: &Summary) -> Result<(), Failure> {
        if self.json {
            let text = serde_json::to_string(summary).map_err(|e| Failure::Internal(e.into()))?;
            return print_line(&text);
        }
        print_line(&format!(
            "{} points, {} without a normal, {} by a plane",
            summary.points, summary.without, summary.by_plane
        ))?;
        for finding in &summary.findings {
            print_line(&format!("note: {finding}"))?;
        }
        Ok(())
    }
}

fn reading(error: PointsError) -> Failure {
    match error {
        PointsError::Read { .. } | PointsError::Write { .. } => Failure::Io(error.into()),
        _ => Failure::BadInput(error.into()),
    }
}
