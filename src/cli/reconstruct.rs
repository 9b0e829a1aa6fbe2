//! `acies reconstruct`: a scan's points on the surface they were measured from.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::anyhow;
use glam::{DVec3, Vec3};

use super::{Failure, Status, print_line};
use crate::features;
use crate::points::{Column, Encoding, Neighbors, PointCloud, PointsError, Unit, read, write_ply};
use crate::surface::{
    Degree, ImplicitKind, ImplicitSurface, Place, Scale, Settings, SmoothSurface, SurfaceError,
    ThesisSettings, ThesisSurface, plane_normals, reconstruct, resample, weighted_plane_normals,
};

/// Take the points of a scan onto the surface they were measured from, keeping edges and corners sharp.
///
/// Noise is averaged away along the surface but never across an edge; points within noise of an edge end on it. All sizes follow from the
/// spacing and the noise of the points. The result has the points in the order of the scan with their unit normals; `projected` is 0
/// where a point was left where it was because its surroundings say nothing certain, `feature` says 0 face, 1 edge, 2 corner.
#[derive(Debug, clap::Args)]
pub struct Reconstruct {
    /// PLY, PCD, XYZ or CSV text, STL or OBJ.
    scan: PathBuf,
    /// Where to write the result: PLY with x y z nx ny nz (double), projected and feature (uchar).
    #[arg(short = 'o', long = "output", value_name = "OUT.ply")]
    output: Option<PathBuf>,
    /// How the points find their surface; all but `sharp` are there for comparison.
    #[arg(long, value_enum, default_value = "sharp", conflicts_with_all = ["resample", "smooth"])]
    method: Method,
    /// The same as `--method smooth`.
    #[arg(long, conflicts_with = "resample")]
    smooth: bool,
    /// Degree of the local polynomials; the last four methods have none.
    #[arg(long, default_value = "2", value_parser = clap::value_parser!(u8).range(1..=3))]
    degree: u8,
    /// h of the Gaussian weight exp(-d²/h²), mm; by default it follows from noise and spacing.
    #[arg(long, value_name = "H")]
    smoothing: Option<f64>,
    /// After the scan's points also write samples of the edges and the corners; `mx my mz` is the normal of an edge's other side.
    #[arg(long, conflicts_with_all = ["resample", "smooth"])]
    edges: bool,
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

/// The ways to a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Method {
    /// Moving least squares that keeps edges and corners.
    Sharp,
    /// Moving least squares that rounds every edge (Levin).
    Smooth,
    /// Neighbourhoods cut along a Bézier curve through detected points (Weber 2011, §4.3).
    Thesis,
    /// Algebraic spheres (Guennebaud and Gross 2007).
    Apss,
    /// Robust implicit moving least squares (Öztireli et al. 2009).
    Rimls,
    /// No projection, only normals: planes through the 30 nearest points (Hoppe et al. 1992).
    Plane,
    /// The same with Gaussian weights (Pauly et al. 2003).
    WeightedPlane,
}

/// What the command says about its work.
#[derive(Debug, serde::Serialize)]
struct Summary {
    points: usize,
    points_out: usize,
    projected: usize,
    on_edges: usize,
    on_corners: usize,
    /// Samples of edges and corners after the scan's points.
    edge_samples: usize,
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

/// Neighbours of a plane (Ma 2011, §4.2.1).
const PLANE_NEIGHBOURS: usize = 30;

/// Points to be written.
struct Result {
    positions: Vec<DVec3>,
    normals: Vec<Vec3>,
    /// 1 where a point was taken onto the surface; none for new points.
    projected: Option<Vec<u8>>,
    features: Vec<u8>,
    /// Normals of the other sides of edges, where wanted.
    others: Option<Vec<Vec3>>,
    edge_samples: usize,
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
        if let Some(h) = self.smoothing.filter(|h| !(h.is_finite() && *h > 0.0)) {
            return Err(Failure::Usage(anyhow!(
                "--smoothing: {h}, expected a length above 0 mm"
            )));
        }
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
            projected: result.projected_count(),
            on_edges: result.count(Place::Edge),
            on_corners: result.count(Place::Corner),
            edge_samples: result.edge_samples,
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
        let method = if self.smooth {
            Method::Smooth
        } else {
            self.method
        };
        if let Some(spacing_mm) = self.resample {
            resampled(cloud, neighbors, spacing_mm)
        } else if method == Method::Sharp {
            self.sharp(cloud, neighbors)
        } else {
            self.baseline(method, cloud, neighbors)
        }
        .map_err(|error| match error {
            SurfaceError::Spacing { .. } => Failure::Usage(error.into()),
            SurfaceError::TooFewPoints { .. } => {
                Failure::BadInput(anyhow!("{}: {error}", self.scan.display()))
            }
        })
    }

    fn degree(&self) -> Degree {
        match self.degree {
            1 => Degree::One,
            3 => Degree::Three,
            _ => Degree::Two,
        }
    }

    fn sharp(
        &self,
        cloud: &PointCloud,
        neighbors: &Neighbors,
    ) -> std::result::Result<Result, SurfaceError> {
        let settings = Settings {
            degree: self.degree(),
            smoothing_mm: self.smoothing,
        };
        let done = reconstruct(cloud, neighbors, settings)?;
        let mut features = vec![Place::Face as u8; done.positions.len()];
        for sharp in &done.sharp {
            features[sharp.index as usize] = sharp.place as u8;
        }
        let mut result = Result {
            projected: Some(done.projected.iter().map(|p| u8::from(*p)).collect()),
            positions: done.positions,
            normals: done.normals,
            features,
            others: None,
            edge_samples: 0,
            scale: done.scale,
        };
        if self.edges {
            let mut others = vec![Vec3::ZERO; result.positions.len()];
            for sharp in &done.sharp {
                others[sharp.index as usize] = sharp.other_normals[0];
            }
            for line in &done.lines {
                result.positions.push(line.position);
                result.normals.push(line.normals[0]);
                result.features.push(line.place as u8);
                others.push(line.normals[1]);
            }
            let projected = result.projected.iter_mut();
            projected.for_each(|p| p.resize(result.positions.len(), 1));
            result.others = Some(others);
            result.edge_samples = done.lines.len();
        }
        Ok(result)
    }

    fn baseline(
        &self,
        method: Method,
        cloud: &PointCloud,
        neighbors: &Neighbors,
    ) -> std::result::Result<Result, SurfaceError> {
        let scale = Scale::of(cloud, neighbors);
        let positions = &cloud.positions;
        let h_mm = self.smoothing.unwrap_or(scale.smoothing_mm());
        let degree = self.degree();
        let points: Vec<Option<(DVec3, DVec3)>> = match method {
            Method::Plane | Method::WeightedPlane => {
                let normals = if method == Method::Plane {
                    plane_normals(positions, neighbors, PLANE_NEIGHBOURS)
                } else {
                    weighted_plane_normals(positions, neighbors, PLANE_NEIGHBOURS)
                };
                let found = |(p, n): (&DVec3, Vec3)| (n != Vec3::ZERO).then(|| (*p, n.as_dvec3()));
                positions.iter().zip(normals).map(found).collect()
            }
            Method::Thesis => {
                let classes =
                    features::detect(cloud, neighbors, features::Method::Adaptive).classes;
                let settings = ThesisSettings {
                    k: 20,
                    h_mm,
                    degree,
                };
                ThesisSurface::new(positions, neighbors, &classes, settings).project_all()
            }
            Method::Apss | Method::Rimls => {
                let kind = if method == Method::Apss {
                    ImplicitKind::Apss
                } else {
                    ImplicitKind::Rimls
                };
                // Their weight falls to 1/e at 0.47 of its support.
                ImplicitSurface::new(positions, neighbors, kind, h_mm / 0.47).project_all()
            }
            Method::Sharp | Method::Smooth => {
                SmoothSurface::new(positions, neighbors, degree, h_mm).project_all()
            }
        };
        Ok(Result {
            projected: Some(points.iter().map(|p| u8::from(p.is_some())).collect()),
            normals: points
                .iter()
                .map(|p| p.map_or(Vec3::ZERO, |p| p.1.as_vec3()))
                .collect(),
            positions: (points.iter().zip(positions))
                .map(|(p, old)| p.map_or(*old, |p| p.0))
                .collect(),
            features: vec![Place::Face as u8; points.len()],
            others: None,
            edge_samples: 0,
            scale,
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

impl Result {
    fn count(&self, place: Place) -> usize {
        let measured = self.features.len() - self.edge_samples;
        let on = self.features[..measured].iter();
        on.filter(|f| **f == place as u8).count()
    }

    fn projected_count(&self) -> usize {
        let all = self.positions.len() - self.edge_samples;
        let projected = self.projected.as_ref();
        projected.map_or(all, |p| p[..all].iter().filter(|p| **p == 1).count())
    }
}

fn resampled(
    cloud: &PointCloud,
    neighbors: &Neighbors,
    spacing_mm: f64,
) -> std::result::Result<Result, SurfaceError> {
    let done = resample(cloud, neighbors, spacing_mm)?;
    Ok(Result {
        projected: None,
        features: done.places.iter().map(|p| *p as u8).collect(),
        positions: done.positions,
        normals: done.normals,
        others: None,
        edge_samples: 0,
        scale: done.scale,
    })
}

fn moved_rms(cloud: &PointCloud, result: &Result) -> f64 {
    let ways = cloud.positions.iter().zip(&result.positions);
    let sum: f64 = ways.map(|(a, b)| a.distance_squared(*b)).sum();
    (sum / result.projected_count().max(1) as f64).sqrt()
}

fn write(path: &std::path::Path, result: &Result) -> std::result::Result<(), Failure> {
    let split = |normals: &[Vec3]| {
        [0, 1, 2].map(|axis| -> Vec<f64> { normals.iter().map(|n| f64::from(n[axis])).collect() })
    };
    let [nx, ny, nz] = split(&result.normals);
    let others = result.others.as_deref().map(split);
    let mut columns = vec![
        Column::F64("nx", &nx),
        Column::F64("ny", &ny),
        Column::F64("nz", &nz),
    ];
    if let Some([mx, my, mz]) = &others {
        columns.extend([
            Column::F64("mx", mx),
            Column::F64("my", my),
            Column::F64("mz", mz),
        ]);
    }
    if let Some(projected) = &result.projected {
        columns.push(Column::U8("projected", projected));
    }
    columns.push(Column::U8("feature", &result.features));
    write_ply(path, &result.positions, &columns, Encoding::LittleEndian)
        .map_err(|e| Failure::Io(e.into()))
}
