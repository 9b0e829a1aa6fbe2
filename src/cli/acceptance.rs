//! `acies acceptance`: how well a scanner measures spheres, their distance, a flat and an edge; a record of it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use acies_drivers::device::{Identity, Instrument};
use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::Recording;
use acies_drivers::link::replay::Replay;
use anyhow::anyhow;
use glam::DVec3;
use serde::Serialize;
use serde_json::json;

use super::attached_device::{Configured, PLAYED, find, open, play, read_cell};
use super::{Failure, Status, print_line};
use crate::acquire::acceptance::{self, AcceptanceError};
use crate::acquire::{Assembler, Profiling, scan};
use crate::config::Cell;
use crate::points::write::write_atomically;
use crate::points::{PointCloud, Unit, read};

/// Measures reference artefacts with a scanner and says how far it is off: sphere form and size, sphere distance, flatness, and how near to
/// an edge it measures.
///
/// Each artefact is a scan (PLY, PCD, XYZ, CSV text), a recording (`*.aciesrec`, as `acies record` writes it, with --cell), or the word
/// `live`: then the device of the cell scans it now. The scan must show the artefact; other things in it are left out where a sphere is
/// looked for. Exit status 0 where every limit is kept, 1 where one is not, 2 where the uncertainty leaves it open.
#[derive(Debug, clap::Args)]
pub struct Acceptance {
    /// A scan of one sphere.
    #[arg(long, value_name = "SCAN", requires = "radius")]
    sphere: Vec<String>,
    /// A scan of a ball bar: two spheres.
    #[arg(long, value_name = "SCAN", requires_all = ["radius", "length"])]
    distance: Vec<String>,
    /// A scan of a flat, and of nothing else.
    #[arg(long, value_name = "SCAN")]
    plane: Vec<String>,
    /// A scan of a prism: one straight edge between two flats, and nothing else.
    #[arg(long, value_name = "SCAN", requires = "angle")]
    edge: Vec<String>,
    /// Certified radius of the spheres, mm.
    #[arg(long, value_name = "MM", value_parser = positive)]
    radius: Option<f64>,
    /// Certified distance of the centres of the ball bar, mm.
    #[arg(long, value_name = "MM", value_parser = positive)]
    length: Option<f64>,
    /// Certified included angle of the prism, degrees.
    #[arg(long, value_name = "DEG", value_parser = positive)]
    angle: Option<f64>,
    /// The flats of the prism are fitted to what lies farther from the edge than this, mm.
    #[arg(long, value_name = "MM", default_value_t = 1.0, value_parser = positive)]
    reach: f64,
    /// Standard uncertainty of the certified diameter and distance, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.001, value_parser = positive)]
    u_certified: f64,
    /// Noise of the scanner, standard deviation, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.01, value_parser = positive)]
    noise: f64,
    /// What may not be exceeded, as in distance=0.03; of sphere-size, sphere-form-95, sphere-form-25, distance, plane-form-95 (mm), edge-angle
    /// (degrees), edge-transition (mm). Several times.
    #[arg(long, value_name = "FIGURE=VALUE", value_parser = limit)]
    limit: Vec<(Figure, f64)>,
    /// Which artefact, and its certificate, for the record.
    #[arg(long, value_name = "TEXT", default_value = "")]
    artefact: String,
    /// The scanner's name and serial number, for the record, where no device tells them.
    #[arg(long, value_name = "TEXT", default_value = "")]
    scanner: String,
    /// The cell whose device scans, or made the recordings.
    #[arg(long, value_name = "CELL.toml")]
    cell: Option<PathBuf>,
    /// Which device of the cell, by its name; needed where there are several.
    #[arg(long, value_name = "NAME", requires = "cell")]
    device: Option<String>,
    /// Where to write the record, JSON.
    #[arg(short, long, value_name = "RECORD.json")]
    output: Option<PathBuf>,
    /// Print the record on standard output, in place of the table.
    #[arg(long)]
    json: bool,
}

/// What is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
enum Figure {
    SphereSize,
    #[value(name = "sphere-form-95")]
    SphereForm95,
    #[value(name = "sphere-form-25")]
    SphereForm25,
    Distance,
    #[value(name = "plane-form-95")]
    PlaneForm95,
    EdgeAngle,
    EdgeTransition,
}

impl Figure {
    /// Its word, its unit, and what in the standards it is nearest to.
    fn texts(self) -> [&'static str; 3] {
        match self {
            Figure::SphereSize => [
                "sphere-size",
                "mm",
                "as the probing size error over all points of ISO 10360-8",
            ],
            Figure::SphereForm95 => [
                "sphere-form-95",
                "mm",
                "as the probing dispersion over 95 % of the points of ISO 10360-8",
            ],
            Figure::SphereForm25 => [
                "sphere-form-25",
                "mm",
                "as the probing form error over 25 representative points of ISO 10360-8; here each is the mean of a patch",
            ],
            Figure::Distance => [
                "distance",
                "mm",
                "as the sphere-spacing error of VDI/VDE 2634-2",
            ],
            Figure::PlaneForm95 => [
                "plane-form-95",
                "mm",
                "as the flat form dispersion over 95 % of the points of ISO 10360-8",
            ],
            Figure::EdgeAngle => ["edge-angle", "deg", "of no standard: our own artefact"],
            Figure::EdgeTransition => [
                "edge-transition",
                "mm",
                "of no standard: width of the zone beside the edge that is not measured, edge break included",
            ],
        }
    }
}

/// What the record says of its own standing.
const CAVEATS: [&str; 4] = [
    "The figures are defined by this program. They are near to quantities of ISO 10360-8, ISO 10360-13 and VDI/VDE 2634, and no test to any of \
     them: number, size and places of the artefacts are the user's.",
    "No symbols are given: their spelling is being fixed anew by ISO 10360-102.",
    "VDI/VDE 2634-3 excludes sensors that are moved by the axes of a machine; a profiler on a stage or robot is such a sensor.",
    "No standard has an edge artefact. The prism is ours; its certificate must give the angle and the edge break.",
];

fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok();
    number
        .filter(|n| n.is_finite() && *n > 0.0)
        .ok_or_else(|| "expected a number above 0".to_owned())
}

fn limit(text: &str) -> Result<(Figure, f64), String> {
    let (name, value) = text
        .split_once('=')
        .ok_or_else(|| "expected a figure and a value, as in distance=0.03".to_owned())?;
    let figure = <Figure as clap::ValueEnum>::from_str(name, false).map_err(|_| {
        let known = <Figure as clap::ValueEnum>::value_variants().iter();
        let known: Vec<&str> = known.map(|figure| figure.texts()[0]).collect();
        format!(
            "no figure is called {name:?}, expected one of {}",
            known.join(", ")
        )
    })?;
    Ok((figure, positive(value)?))
}

/// How a figure stands to its limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    /// No limit was given.
    Undefined,
    Ok,
    NotDecidable,
    NotOk,
}

/// One line of the record.
#[derive(Debug, Serialize)]
struct Entry {
    figure: &'static str,
    source: String,
    value: f64,
    /// Standard uncertainty; of a form none is known but its own noise.
    u: f64,
    unit: &'static str,
    limit: Option<f64>,
    verdict: Verdict,
    counterpart: &'static str,
}

/// A scan of an artefact.
struct Scanned {
    source: String,
    points: Vec<DVec3>,
}

/// Collects what was measured.
struct Record<'a> {
    command: &'a Acceptance,
    entries: Vec<Entry>,
    details: Vec<serde_json::Value>,
    identity: Option<Identity>,
    findings: Vec<String>,
}

impl Acceptance {
    /// Carries the command out.
    ///
    /// # Errors
    /// Wrong usage without an artefact; bad input where a scan cannot be read or does not show its artefact; input or output where the
    /// device fails or the record cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let artefacts = [&self.sphere, &self.distance, &self.plane, &self.edge];
        if artefacts.iter().all(|scans| scans.is_empty()) {
            return Err(Failure::Usage(anyhow!(
                "no artefact, expected one of --sphere, --distance, --plane, --edge"
            )));
        }
        let cell = self.cell.as_deref().map(read_cell).transpose()?;
        let mut record = Record {
            command: &self,
            entries: Vec::new(),
            details: Vec::new(),
            identity: None,
            findings: Vec::new(),
        };
        record.measure(cell.as_ref())?;
        let verdict = record.verdict();
        let as_json = record.as_json(verdict);
        if let Some(path) = &self.output {
            let text = format!("{as_json:#}\n");
            write_atomically(path, text.as_bytes()).map_err(|error| Failure::Io(error.into()))?;
        }
        match self.json {
            true => print_line(&as_json.to_string())?,
            false => print_line(&record.as_table(&as_json))?,
        }
        Ok(match verdict {
            Verdict::NotOk => Status::NotOk,
            Verdict::NotDecidable => Status::NotDecidable,
            Verdict::Ok | Verdict::Undefined => Status::Done,
        })
    }
}

impl Record<'_> {
    fn measure(&mut self, cell: Option<&Cell>) -> Result<(), Failure> {
        let command = self.command;
        let (radius, noise) = (command.radius.unwrap_or(0.0), command.noise);
        let wrong = |scan: &Scanned, error: AcceptanceError| {
            Failure::BadInput(anyhow!("{}: {error}", scan.source))
        };
        for source in &command.sphere {
            let scan = self.scan(source, cell)?;
            let found =
                acceptance::sphere(&scan.points, radius, noise).map_err(|e| wrong(&scan, e))?;
            self.sphere(&scan.source, &found);
            self.detail("sphere", &scan, &found);
        }
        for source in &command.distance {
            let scan = self.scan(source, cell)?;
            let length = command.length.unwrap_or(0.0);
            let found = acceptance::distance(&scan.points, radius, length, noise)
                .map_err(|e| wrong(&scan, e))?;
            let u = found.u_distance_mm.hypot(command.u_certified);
            self.judge(Figure::Distance, &scan.source, found.distance_error_mm, u);
            for sphere in &found.spheres {
                self.sphere(&scan.source, sphere);
            }
            self.detail("distance", &scan, &found);
        }
        for source in &command.plane {
            let scan = self.scan(source, cell)?;
            let found = acceptance::plane(&scan.points).map_err(|e| wrong(&scan, e))?;
            self.judge(Figure::PlaneForm95, &scan.source, found.form_95_mm, 0.0);
            self.detail("plane", &scan, &found);
        }
        for source in &command.edge {
            let scan = self.scan(source, cell)?;
            let angle = command.angle.unwrap_or(0.0);
            let found = acceptance::edge(&scan.points, angle, command.reach, noise)
                .map_err(|e| wrong(&scan, e))?;
            self.judge(Figure::EdgeAngle, &scan.source, found.angle_error_deg, 0.0);
            let [a, b] = found.transition_mm;
            self.judge(Figure::EdgeTransition, &scan.source, a.max(b), 0.0);
            self.detail("edge", &scan, &found);
        }
        Ok(())
    }

    fn sphere(&mut self, source: &str, found: &acceptance::SphereFigures) {
        // Twice the radius: the certificate's is of the diameter.
        let u = found.u_size_mm.hypot(self.command.u_certified);
        self.judge(Figure::SphereSize, source, found.size_error_mm, u);
        self.judge(Figure::SphereForm95, source, found.form_95_mm, 0.0);
        self.judge(Figure::SphereForm25, source, found.form_25_mm, 0.0);
    }

    /// The simple rule of ISO 14253-1 with its zone of expanded uncertainty, coverage factor 2.
    fn judge(&mut self, figure: Figure, source: &str, value: f64, u: f64) {
        let limits = self.command.limit.iter();
        let limit = limits
            .filter(|(of, _)| *of == figure)
            .map(|(_, limit)| *limit)
            .reduce(f64::min);
        let verdict = match limit {
            None => Verdict::Undefined,
            Some(limit) if value.abs() + 2.0 * u <= limit => Verdict::Ok,
            Some(limit) if value.abs() - 2.0 * u > limit => Verdict::NotOk,
            Some(_) => Verdict::NotDecidable,
        };
        let [name, unit, counterpart] = figure.texts();
        self.entries.push(Entry {
            figure: name,
            source: source.to_owned(),
            value,
            u,
            unit,
            limit,
            verdict,
            counterpart,
        });
    }

    fn detail(&mut self, artefact: &str, scan: &Scanned, found: &impl Serialize) {
        self.details.push(json!({
            "artefact": artefact,
            "source": scan.source,
            "points_in_scan": scan.points.len(),
            "figures": found,
        }));
    }

    fn verdict(&self) -> Verdict {
        let verdicts = self.entries.iter().map(|entry| entry.verdict);
        verdicts.max().unwrap_or(Verdict::Undefined)
    }

    /// The points of one artefact: from a file, from a recording, or from the device now.
    fn scan(&mut self, source: &str, cell: Option<&Cell>) -> Result<Scanned, Failure> {
        let recorded = source.ends_with(".aciesrec");
        if source != "live" && !recorded {
            let found = read(Path::new(source), Unit::Millimetre)
                .map_err(|error| Failure::BadInput(error.into()))?;
            self.findings.extend(found.findings);
            return Ok(Scanned {
                source: source.to_owned(),
                points: found.cloud.positions,
            });
        }
        let Some(cell) = cell else {
            return Err(Failure::Usage(anyhow!(
                "{source}: no cell, expected --cell CELL.toml with the device"
            )));
        };
        let (_, device) = find(cell, self.command.device.as_deref())?;
        let cloud = match recorded {
            true => self.replay(&device, source)?,
            false => self.live(&device, cell)?,
        };
        Ok(Scanned {
            source: source.to_owned(),
            points: cloud.positions,
        })
    }

    fn replay(&mut self, device: &Configured<'_>, source: &str) -> Result<PointCloud, Failure> {
        let recording = Recording::read(Path::new(source));
        let recording = recording.map_err(|error| Failure::BadInput(error.into()))?;
        let links = Replay::new(recording, PLAYED);
        let mut profiling = profiling(device, &links)?;
        self.identity = Some(profiling.profiler.identity().clone());
        let run = play(profiling.profiler.as_mut())?;
        let mut assembler = Assembler::new(source, profiling.calibration);
        run.profiles
            .iter()
            .for_each(|profile| assembler.push(profile));
        let (cloud, findings) = assembler.finish();
        self.findings.extend(findings);
        Ok(cloud)
    }

    fn live(&mut self, device: &Configured<'_>, cell: &Cell) -> Result<PointCloud, Failure> {
        if cell.carrier.is_some() {
            return Err(Failure::Usage(anyhow!(
                "live: the cell has a robot, expected one with a stage; scan the artefact by a job of the cell and give its file"
            )));
        }
        let profiling = profiling(device, &Cable)?;
        self.identity = Some(profiling.profiler.identity().clone());
        let (scan, _) = scan(vec![profiling], cell.plan, &mut |_| {})
            .map_err(|error| Failure::Io(error.into()))?;
        self.findings
            .extend(scan.views.into_iter().flat_map(|view| view.findings));
        Ok(scan.cloud)
    }

    fn as_json(&self, verdict: Verdict) -> serde_json::Value {
        let command = self.command;
        let scanner = self.identity.as_ref().map(|identity| {
            json!({
                "vendor": identity.vendor,
                "model": identity.model,
                "serial": identity.serial,
                "firmware": identity.firmware,
            })
        });
        let stated = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        json!({
            "schema": "acies-acceptance/1",
            "date": humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
            "program": concat!("acies ", env!("CARGO_PKG_VERSION")),
            "scanner": scanner,
            "scanner_as_stated": stated(&command.scanner),
            "cell": command.cell,
            "artefact": stated(&command.artefact),
            "certified": {
                "radius_mm": command.radius,
                "length_mm": command.length,
                "angle_deg": command.angle,
                "u_mm": command.u_certified,
            },
            "noise_mm": command.noise,
            "rule": "ok: |value| + 2 u <= limit; not_ok: |value| - 2 u > limit; else not_decidable",
            "results": self.entries,
            "details": self.details,
            "findings": self.findings,
            "caveats": CAVEATS,
            "verdict": verdict,
        })
    }

    fn as_table(&self, record: &serde_json::Value) -> String {
        let who = match (&self.identity, self.command.scanner.as_str()) {
            (Some(identity), _) => super::attached_device::named(identity),
            (None, "") => "scanner not stated".to_owned(),
            (None, stated) => stated.to_owned(),
        };
        let artefact = match self.command.artefact.as_str() {
            "" => "artefact not stated",
            stated => stated,
        };
        let date = record["date"].as_str().unwrap_or_default();
        let mut lines = vec![
            format!("{who}; {artefact}; {date}"),
            format!(
                "{:<16} {:>11} {:>9} {:>9} {:<4} {:<14} of",
                "figure", "value", "u", "limit", "", "verdict"
            ),
        ];
        let mut told = BTreeMap::new();
        for entry in &self.entries {
            told.insert(entry.figure, entry.counterpart);
            let limit = entry
                .limit
                .map_or("none".to_owned(), |limit| format!("{limit:.4}"));
            let word = match entry.verdict {
                Verdict::Undefined => "",
                Verdict::Ok => "ok",
                Verdict::NotDecidable => "not decidable",
                Verdict::NotOk => "NOT OK",
            };
            lines.push(format!(
                "{:<16} {:>+11.4} {:>9.4} {limit:>9} {:<4} {word:<14} {}",
                entry.figure, entry.value, entry.u, entry.unit, entry.source
            ));
        }
        lines.extend(
            self.findings
                .iter()
                .map(|finding| format!("finding: {finding}")),
        );
        lines.extend(
            told.iter()
                .map(|(figure, counterpart)| format!("{figure}: {counterpart}")),
        );
        lines.extend(CAVEATS.iter().map(|caveat| format!("note: {caveat}")));
        lines.join("\n")
    }
}

fn profiling(device: &Configured<'_>, links: &dyn Links) -> Result<Profiling, Failure> {
    let (Instrument::Profiler(profiler), Some(calibration)) =
        (open(device, links)?, device.calibration)
    else {
        return Err(Failure::Usage(anyhow!(
            "--device: no profiler, expected one"
        )));
    };
    Ok(Profiling {
        name: "scanner".to_owned(),
        profiler,
        calibration,
    })
}
