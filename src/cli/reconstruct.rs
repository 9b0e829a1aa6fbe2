//! `acies reconstruct`: a scan's points on the surface they were measured from.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::anyhow;
use glam::{DVec3, Vec3};

use super::{Failure, Status, print_line};
use crate::points::{Column, Encoding, Neighbors, PointCloud, PointsError, Unit, read, write_ply};
use crate::surface::{
    Degree, Place, Scale, Settings, SmoothSurface, SurfaceError, reconstruct, resample,
};

/// Take the points of a scan onto the surface they were measured from, keeping edges and corners sharp.
///
/// Noise is averaged away along the surface but never across an edge; points within noise of an edge end on it. All sizes follow from the
/// spacing and the noise of the points. The result has the points in the order of the scan with their unit normals; `projected` is 0
/// where a point was left where it was because its surroundings say nothing certain.
#[derive(Debug, clap::Args)]
pub struct Reconstruct {
    /// PLY, PCD, XYZ or CSV text, STL or OBJ.
    scan: PathBuf,
    /// Where to write the result: PLY with x y z nx ny nz (double) and projected (uchar).
    #[arg(short = 'o', long = "output", value_name = "OUT.ply")]
    output: Option<PathBuf>,
    /// Smooth moving least squares, for comparison: rounds every edge.
    #[arg(long, conflicts_with = "resample")]
    smooth: bool,
    /// Instead of the scan's points, new ones this far apart (mm), with extra points along the edges; `feature` says 0 face, 1 edge, 2 corner.
    #[arg(long, value_name = "SPACING")]
    resample: Option<f64>,
    /// Unit of the scan's coordinates: um, mm, cm, m or inch.
    #[arg(long, default_value = "mm")]
    unit: Unit,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What the command says about its work.
#[derive(Debug, serde::Serialize)]
struct Summary {
    points: usize,
    points_out: usize,
    projected: usize,
    on_edges: usize,
    on_corners: usize,
    spacing_mm: f64,
    noise_mm: f64,
    /// Root mean square of the way the projected points went, mm.
    moved_rms_mm: f64,
    findings: Vec<String>,
    seconds: Seconds,
}

#[derive(Debug, Default, serde::Serialize)]
struct Seconds {
    read: f64,
    neighbours: f64,
    surface: f64,
    write: f64,
}

/// Points to be written.
struct Result {
    positions: Vec<DVec3>,
    normals: Vec<Vec3>,
    flag_name: &'static str,
    flags: Vec<u8>,
    counts: [usize; 2],
    projected: usize,
    scale: Scale,
}

impl Reconstruct {
    /// Carries the command out.
    ///
    /// # Errors
    /// [`Failure::BadInput`] for a scan that cannot be read or carries no surface, [`Failure::Usage`] for a spacing that is none,
    /// [`Failure::Io`] where the result cannot be written.
    pub fn run(self) -> std::result::Result<Status, Failure> {
        let mut seconds = Seconds::default();
        let mut clock = Instant::now();
        let mut lap = |into: &mut f64| {
            *into = clock.elapsed().as_secs_f64();
            clock = Instant::now();
        };
        let scan = read(&self.scan, self.unit).map_err(reading)?;
        lap(&mut seconds.read);
        let neighbors = Neighbors::new(&scan.cloud.positions);
        lap(&mut seconds.neighbours);
        let result = self.work(&scan.cloud, &neighbors)?;
        lap(&mut seconds.surface);
        if let Some(path) = &self.output {
            write(path, &result)?;
        }
        lap(&mut seconds.write);
        let same_points = self.resample.is_none();
        let summary = Summary {
            points: scan.cloud.positions.len(),
            points_out: result.positions.len(),
            projected: result.projected,
            on_edges: result.counts[0],
            on_corners: result.counts[1],
            spacing_mm: result.scale.spacing_mm,
            noise_mm: result.scale.noise_mm,
            moved_rms_mm: if same_points {
                moved_rms(&scan.cloud, &result)
            } else {
                0.0
            },
            findings: scan.findings,
            seconds,
        };
        self.say(&summary)
    }

    fn work(
        &self,
        cloud: &PointCloud,
        neighbors: &Neighbors,
    ) -> std::result::Result<Result, Failure> {
        if let Some(spacing_mm) = self.resample {
            resampled(cloud, neighbors, spacing_mm)
        } else if self.smooth {
            smooth(cloud, neighbors)
        } else {
            sharp(cloud, neighbors)
        }
        .map_err(|error| match error {
            SurfaceError::Spacing { .. } => Failure::Usage(error.into()),
            SurfaceError::TooFewPoints { .. } => {
                Failure::BadInput(anyhow!("{}: {error}", self.scan.display()))
            }
        })
    }

    fn say(&self, summary: &Summary) -> std::result::Result<Status, Failure> {
        if self.json {
            let text = serde_json::to_string(summary).map_err(|e| Failure::Internal(e.into()))?;
            print_line(&text)?;
        } else {
            print_line(&format!(
                "{} points, {} out, {} projected, {} on edges, {} on corners; spacing {:.4} mm, noise {:.4} mm",
                summary.points,
                summary.points_out,
                summary.projected,
                summary.on_edges,
                summary.on_corners,
                summary.spacing_mm,
                summary.noise_mm,
            ))?;
            for finding in &summary.findings {
                print_line(&format!("note: {finding}"))?;
            }
        }
        Ok(Status::Done)
    }
}

fn reading(error: PointsError) -> Failure {
    match error {
        PointsError::Read { .. } | PointsError::Write { .. } => Failure::Io(error.into()),
        _ => Failure::BadInput(error.into()),
    }
}

fn sharp(cloud: &PointCloud, neighbors: &Neighbors) -> std::result::Result<Result, SurfaceError> {
    let done = reconstruct(cloud, neighbors, Settings::default())?;
    let on = |place: Place| done.sharp.iter().filter(|s| s.place == place).count();
    Ok(Result {
        counts: [on(Place::Edge), on(Place::Corner)],
        projected: done.projected.iter().filter(|p| **p).count(),
        flags: done.projected.iter().map(|p| u8::from(*p)).collect(),
        flag_name: "projected",
        positions: done.positions,
        normals: done.normals,
        scale: done.scale,
    })
}

fn smooth(cloud: &PointCloud, neighbors: &Neighbors) -> std::result::Result<Result, SurfaceError> {
    let scale = Scale::of(cloud, neighbors);
    let surface = SmoothSurface::new(
        &cloud.positions,
        neighbors,
        Degree::Two,
        scale.smoothing_mm(),
    );
    let points = surface.project_all();
    Ok(Result {
        counts: [0, 0],
        projected: points.iter().flatten().count(),
        flags: points.iter().map(|p| u8::from(p.is_some())).collect(),
        flag_name: "projected",
        normals: points
            .iter()
            .map(|p| p.map_or(Vec3::ZERO, |p| p.1.as_vec3()))
            .collect(),
        positions: (points.iter().zip(&cloud.positions))
            .map(|(p, old)| p.map_or(*old, |p| p.0))
            .collect(),
        scale,
    })
}

fn resampled(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    spacing_mm: f64,
) -> std::result::Result<Result, SurfaceError> {
    let done = resample(cloud, neighbors, spacing_mm)?;
    let on = |place: Place| done.places.iter().filter(|p| **p == place).count();
    Ok(Result {
        counts: [on(Place::Edge), on(Place::Corner)],
        projected: done.positions.len(),
        flags: done.places.iter().map(|p| *p as u8).collect(),
        flag_name: "feature",
        positions: done.positions,
        normals: done.normals,
        scale: done.scale,
    })
}

fn moved_rms(cloud: &PointCloud, result: &Result) -> f64 {
    let ways = cloud.positions.iter().zip(&result.positions);
    let sum: f64 = ways.map(|(a, b)| a.distance_squared(*b)).sum();
    (sum / result.projected.max(1) as f64).sqrt()
}

fn write(path: &std::path::Path, result: &Result) -> std::result::Result<(), Failure> {
    let part =
        |axis: usize| -> Vec<f64> { result.normals.iter().map(|n| f64::from(n[axis])).collect() };
    let (nx, ny, nz) = (part(0), part(1), part(2));
    let columns = [
        Column::F64("nx", &nx),
        Column::F64("ny", &ny),
        Column::F64("nz", &nz),
        Column::U8(result.flag_name, &result.flags),
    ];
    write_ply(path, &result.positions, &columns, Encoding::LittleEndian)
        .map_err(|e| Failure::Io(e.into()))
}
