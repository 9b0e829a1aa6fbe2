//! `acies mesh`: a watertight mesh through every point of a scan.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::anyhow;
use indexmap::IndexMap;

use super::{Failure, Status, print_line};
use crate::mesh::{DelaunayError, MeshForm, Settings, mesh, mesh_bytes, picture};
use crate::points::write::write_atomically;
use crate::points::{PointsError, Unit, read};

/// Mesh a scan: a watertight, manifold surface of triangles through every point.
///
/// Spacing, noise and sharpness follow from the points: there is nothing to set. Points that lie exactly on one another are one vertex. A
/// scan that saw only part of its part is closed all the same; --open leaves out what bridges the unseen.
#[derive(Debug, clap::Args)]
pub struct Mesh {
    /// PLY, PCD, XYZ or CSV text, STL or OBJ.
    scan: PathBuf,
    /// Where to write the mesh: PLY, STL or OBJ, or a PNG picture of it.
    #[arg(short = 'o', long = "output", value_name = "OUT.ply|.stl|.obj|.png")]
    output: Option<PathBuf>,
    /// Leave out triangles that bridge what was never seen: the mesh has borders where the scan has.
    #[arg(long)]
    open: bool,
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
    vertices: usize,
    triangles: usize,
    /// Vertices with one closed ring of triangles.
    matched_percent: f64,
    /// Vertices matched by their umbrellas alone, before cells were turned.
    matched_by_umbrellas_percent: f64,
    watertight: bool,
    manifold: bool,
    /// Null where the mesh is open or no manifold.
    genus: Option<i64>,
    pieces: usize,
    open_edges: usize,
    delta_f: u64,
    findings: Vec<String>,
    seconds: IndexMap<&'static str, f64>,
}

/// Where fewer than this, in percent, agree with their neighbours, what most points say is no surface. The noisiest body of
/// the bench has 73, random points within a volume 9 to 11; plates thinner than their spacing have anything.
const MOST_AGREE: f64 = 50.0;

enum Form {
    Mesh(MeshForm),
    Picture,
}

impl Mesh {
    /// Carries the command out.
    ///
    /// # Errors
    /// [`Failure::BadInput`] for a scan that cannot be read or whose points span no body, [`Failure::Usage`] for an output whose ending
    /// names no form, [`Failure::Io`] where the result cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let form = self.output.as_deref().map(form_of).transpose()?;
        let mut seconds = IndexMap::new();
        let start = Instant::now();
        let scan = read(&self.scan, self.unit).map_err(reading)?;
        seconds.insert("read", start.elapsed().as_secs_f64());
        let settings = Settings {
            open: self.open,
            ..Settings::default()
        };
        let positions = &scan.cloud.positions;
        let made = mesh(positions, settings).map_err(|error| refusing(&self.scan, error))?;
        seconds.extend(made.seconds.iter().copied());
        let start = Instant::now();
        if let (Some(path), Some(form)) = (&self.output, form) {
            write(path, form, &made)?;
            seconds.insert("write", start.elapsed().as_secs_f64());
        }
        let topology = made.topology;
        let mut findings = scan.findings;
        let unused = made.positions.len() - topology.vertices;
        if unused > 0 {
            findings.push(format!("{unused} points have no triangle"));
        }
        if made.mending.after > 0 && !self.open {
            findings.push(format!(
                "at {} points the surface comes together more than once, where it is parted and the point twice a vertex, or misses them: too noisy or too sparse there, or seen from one side only, which \
                 --open is for",
                made.mending.after
            ));
        }
        if topology.pieces > 1 && !self.open {
            findings.push(format!(
                "{} closed pieces: bodies apart or voids, points far from all others, or walls thinner than the spacing of points",
                topology.pieces
            ));
        }
        findings.extend(far_from_all(&made));
        // An exact plane is triangulated without umbrellas.
        let chose = !made.matching.matched.is_empty();
        if chose && made.matched_by_umbrellas_percent() < MOST_AGREE {
            findings.push(format!(
                "only {:.1} % of the points choose the same triangles as all their neighbours: the points do not lie on a surface, or its walls are \
                 thinner than the spacing of points",
                made.matched_by_umbrellas_percent()
            ));
        }
        let summary = Summary {
            points: positions.len(),
            vertices: made.positions.len(),
            triangles: topology.triangles,
            matched_percent: made.matched_percent(),
            matched_by_umbrellas_percent: made.matched_by_umbrellas_percent(),
            watertight: topology.is_watertight(),
            manifold: topology.is_manifold(),
            genus: topology.genus(),
            pieces: topology.pieces,
            open_edges: topology.open_edges,
            delta_f: made.delta_f(),
            findings,
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
        let yes = |is: bool, what: &str| {
            if is {
                what.to_owned()
            } else {
                format!("not {what}")
            }
        };
        print_line(&format!(
            "{} vertices, {} triangles in {} pieces: {}, {}, {:.2} % matched",
            summary.vertices,
            summary.triangles,
            summary.pieces,
            yes(summary.watertight, "watertight"),
            yes(summary.manifold, "manifold"),
            summary.matched_percent,
        ))?;
        for finding in &summary.findings {
            print_line(&format!("note: {finding}"))?;
        }
        Ok(())
    }
}

/// Points that stand so far from all others that they may be no part of the surface, in words.
fn far_from_all(made: &crate::mesh::Mesh) -> Option<String> {
    /// So many times the spacing of three points in four: where a surface is sampled at all, its points vary less.
    const FAR: f64 = 4.0;
    let mut nearest = vec![f64::INFINITY; made.positions.len()];
    for t in &made.triangles {
        for k in 0..3 {
            let [a, b] = [t[k], t[(k + 1) % 3]].map(|v| v as usize);
            let length = made.positions[a].distance(made.positions[b]);
            nearest[a] = nearest[a].min(length);
            nearest[b] = nearest[b].min(length);
        }
    }
    nearest.retain(|d| d.is_finite());
    nearest.sort_unstable_by(f64::total_cmp);
    let usual = *nearest.get(nearest.len() * 3 / 4)?;
    let far = nearest.len() - nearest.partition_point(|d| *d <= FAR * usual);
    (far > 0).then(|| {
        format!(
            "{far} points lie more than {:.3e} mm from all others, three in four within {usual:.3e}: remove them first if they are none of the surface",
            FAR * usual
        )
    })
}

fn refusing(scan: &Path, error: DelaunayError) -> Failure {
    let hint = match error {
        DelaunayError::Flat { dimension: 2, .. } => ", or mesh the plane with --open",
        _ => "",
    };
    Failure::BadInput(anyhow!("{}: {error}{hint}", scan.display()))
}

fn form_of(path: &Path) -> Result<Form, Failure> {
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    match ending.to_ascii_lowercase().as_str() {
        "ply" => Ok(Form::Mesh(MeshForm::Ply)),
        "stl" => Ok(Form::Mesh(MeshForm::Stl)),
        "obj" => Ok(Form::Mesh(MeshForm::Obj)),
        "png" => Ok(Form::Picture),
        _ => Err(Failure::Usage(anyhow!(
            "{}: its ending is `{ending}`, expected ply, stl, obj or png; name the output so",
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

fn write(path: &Path, form: Form, made: &crate::mesh::Mesh) -> Result<(), Failure> {
    const SIZE_PX: (u32, u32) = (1600, 1200);
    let bytes = match form {
        Form::Mesh(form) => mesh_bytes(&made.positions, &made.triangles, form),
        Form::Picture => picture::render(
            &made.positions,
            &made.triangles,
            glam::DVec3::new(0.5, 0.7, -0.6),
            SIZE_PX,
        ),
    };
    write_atomically(path, &bytes).map_err(|e| Failure::Io(e.into()))
}
