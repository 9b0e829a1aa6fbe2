//! One job of a cell: open the devices, touch, scan, find the pose, measure, conclude.
//!
//! Hides the order of things. What is announced is in the [`Outcome`]; what goes on meanwhile is told as [`State`]s.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use acies_drivers::capture::Touch;
use acies_drivers::device::{Identity, Instrument, Probe};
use acies_drivers::error::DeviceError;
use acies_drivers::link::Links;
use glam::DVec3;

use crate::acquire::{Carrier, Profiling, Scan, ScanError, ScanEvent, scan, scan_carried};
use crate::config::{Cell, ProbeConfig};
use crate::inspect::result::{Inspection, Verdict};
use crate::inspect::{self, Recipe, Request, Start};
use crate::nominal::{Nominal, NominalError};

/// How long one touch may take: a machine that crosses a metre at 10 mm/s needs 100 s.
const TOUCH_TIMEOUT: Duration = Duration::from_secs(120);

/// What a job is doing.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Opening a device.
    Opening {
        /// Its name.
        device: String,
    },
    /// Touching the part.
    Touching {
        /// Touches done.
        done: usize,
        /// Touches planned.
        of: usize,
    },
    /// Scanning.
    Scanning {
        /// Profiles placed so far.
        profiles: u64,
        /// Share of the way, 0 to 1.
        share: f64,
    },
    /// A device was lost; the job goes on with the others.
    Lost {
        /// Its name.
        device: String,
        /// Why.
        error: String,
    },
    /// Working on the scan.
    Inspecting,
}

/// What a job brought.
#[derive(Debug)]
pub struct Outcome {
    /// The points and what happened on the way.
    pub scan: Scan,
    /// The nominal it was measured against.
    pub nominal: Nominal,
    /// The recipe it was judged by.
    pub recipe: Recipe,
    /// The probes, by name.
    pub probes: Vec<(String, Identity)>,
    /// What was found.
    pub inspection: Inspection,
    /// From the first profile's start to the last profile, s.
    pub scan_seconds: f64,
    /// From the last profile to the verdict, s.
    pub verdict_seconds: f64,
}

/// Why a job came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum CellError {
    /// The nominal cannot be read.
    #[error("the part's nominal")]
    Nominal(#[source] Box<NominalError>),
    /// The recipe cannot be read.
    #[error("{path}: cannot be read: {source}; check the path and its permissions")]
    RecipeFile {
        /// The recipe.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: std::io::Error,
    },
    /// The recipe has mistakes.
    #[error("{mistakes}")]
    Recipe {
        /// All of them, a line each, which begins with the file.
        mistakes: String,
    },
    /// A device would not open.
    #[error("device {device:?}")]
    Device {
        /// Its name.
        device: String,
        /// Its reason.
        #[source]
        source: Box<DeviceError>,
    },
    /// A device is of another kind than its tables say.
    #[error(
        "device {device:?} is a {found}, its tables are those of a {expected}; give it [device.{table}]"
    )]
    Kind {
        /// Its name.
        device: String,
        /// What the driver opened.
        found: &'static str,
        /// What the configuration takes it for.
        expected: &'static str,
        /// The table it needs.
        table: &'static str,
    },
    /// A touch failed.
    #[error("device {device:?}, touch {index}")]
    Touch {
        /// The probe.
        device: String,
        /// Which touch, from 1.
        index: usize,
        /// Its reason.
        #[source]
        source: Box<DeviceError>,
    },
    /// The scan did not start.
    #[error(transparent)]
    Scan(#[from] ScanError),
}

/// The recipe in a file, or the default one where there is no file.
///
/// # Errors
/// [`CellError::RecipeFile`] and [`CellError::Recipe`].
pub fn read_recipe(path: Option<&Path>) -> Result<Recipe, CellError> {
    let Some(path) = path else {
        return Ok(Recipe::default());
    };
    let text = std::fs::read_to_string(path).map_err(|source| CellError::RecipeFile {
        path: path.to_owned(),
        source,
    })?;
    Recipe::parse(&text).map_err(|mistakes| {
        let lines: Vec<String> = mistakes
            .iter()
            .map(|mistake| format!("{}: {mistake}", path.display()))
            .collect();
        CellError::Recipe {
            mistakes: lines.join("\n"),
        }
    })
}

/// The part's nominal and the recipe it is judged by.
///
/// # Errors
/// [`CellError::Nominal`], [`CellError::RecipeFile`] and [`CellError::Recipe`].
pub fn read_part(cell: &Cell) -> Result<(Nominal, Recipe), CellError> {
    let nominal =
        Nominal::read(&cell.nominal).map_err(|error| CellError::Nominal(Box::new(error)))?;
    Ok((nominal, read_recipe(cell.recipe.as_deref())?))
}

/// Runs one inspection of the part that lies in the cell.
///
/// # Errors
/// [`CellError`] when the job could not be begun or a touch failed. A device that is lost in mid-scan is no error: the
/// outcome then says that it is not decidable, and why.
pub fn run(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(State),
) -> Result<Outcome, CellError> {
    let (nominal, recipe) = read_part(cell)?;
    let profilers = open_profilers(cell, links, watch)?;
    let carrier = open_carrier(cell, links, watch)?;
    let (probes, touches) = touch_all(cell, links, watch)?;
    let began = Instant::now();
    let mut tell = |event| {
        watch(match event {
            ScanEvent::Progress { profiles, share } => State::Scanning { profiles, share },
            ScanEvent::Lost { device, error } => State::Lost { device, error },
        });
    };
    let (scan, profilers) = match carrier {
        Some(carrier) => scan_carried(profilers, carrier, &mut tell)?,
        None => scan(profilers, cell.plan, &mut tell)?,
    };
    let scanned = Instant::now();
    drop(profilers);
    watch(State::Inspecting);
    let start = Start::Rough(cell.machine_from_part.inverse());
    let request = Request {
        touches: &touches,
        ..Request::new(&recipe, start)
    };
    let mut inspection = inspect::inspect(&scan.cloud, &nominal, &request);
    judge_completeness(&scan, &mut inspection);
    judge_calibrations(cell, SystemTime::now(), &mut inspection);
    Ok(Outcome {
        scan_seconds: (scanned - began).as_secs_f64(),
        verdict_seconds: scanned.elapsed().as_secs_f64(),
        scan,
        nominal,
        recipe,
        probes,
        inspection,
    })
}

fn open(
    device: &str,
    setup: &dyn acies_drivers::device::Setup,
    links: &dyn Links,
    watch: &mut dyn FnMut(State),
) -> Result<Instrument, CellError> {
    watch(State::Opening {
        device: device.to_owned(),
    });
    setup.open(links).map_err(|source| CellError::Device {
        device: device.to_owned(),
        source: Box::new(source),
    })
}

fn open_profilers(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(State),
) -> Result<Vec<Profiling>, CellError> {
    let mut opened = Vec::new();
    for config in &cell.profilers {
        let profiler = match open(&config.name, &*config.setup, links, watch)? {
            Instrument::Profiler(profiler) => profiler,
            other => return Err(wrong_kind(&config.name, &other, "profiler")),
        };
        let (name, calibration) = (config.name.clone(), config.calibration);
        opened.push(Profiling {
            name,
            profiler,
            calibration,
        });
    }
    Ok(opened)
}

fn open_carrier(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(State),
) -> Result<Option<Carrier>, CellError> {
    let Some(config) = &cell.carrier else {
        return Ok(None);
    };
    match open(&config.name, &*config.setup, links, watch)? {
        Instrument::Robot(robot) => Ok(Some(Carrier {
            name: config.name.clone(),
            robot,
            plan: config.plan,
        })),
        other => Err(wrong_kind(&config.name, &other, "robot")),
    }
}

fn wrong_kind(device: &str, found: &Instrument, expected: &'static str) -> CellError {
    CellError::Kind {
        device: device.to_owned(),
        found: found.kind(),
        expected,
        table: match found {
            Instrument::Profiler(_) => "calibration",
            Instrument::Probe(_) => "tip",
            Instrument::Robot(_) => "carrier",
        },
    }
}

/// The probes by name, and where they touched.
type Touched = (Vec<(String, Identity)>, Vec<inspect::Touch>);

/// Touches what the cell plans; the probes are closed again before the scan.
fn touch_all(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(State),
) -> Result<Touched, CellError> {
    let of = cell.probes.iter().map(|probe| probe.touches.len()).sum();
    let mut touched = Vec::new();
    let mut identities = Vec::new();
    for config in &cell.probes {
        let mut probe = match open(&config.name, &*config.setup, links, watch)? {
            Instrument::Probe(probe) => probe,
            other => return Err(wrong_kind(&config.name, &other, "probe")),
        };
        for index in 0..config.touches.len() {
            watch(State::Touching {
                done: touched.len(),
                of,
            });
            let touch = touch(cell, config, probe.as_mut(), index)?;
            // The tip's centre goes along the planned direction, which is the normal but for the fixture's error of a
            // degree or two: of a radius of 1 mm that leaves less than 0.5 um.
            let centre = DVec3::from(touch.tip_centre_mm);
            let point = centre + DVec3::from(touch.direction) * config.tip_radius_mm;
            touched.push(inspect::Touch {
                point,
                u_mm: config.u_touch_mm,
            });
        }
        identities.push((config.name.clone(), probe.identity().clone()));
    }
    Ok((identities, touched))
}

fn touch(
    cell: &Cell,
    config: &ProbeConfig,
    probe: &mut dyn Probe,
    index: usize,
) -> Result<Touch, CellError> {
    let planned = config.touches[index];
    let start = cell.machine_from_part.point(planned.start_mm);
    let target = cell.machine_from_part.point(planned.target_mm);
    probe
        .touch(start.into(), target.into(), TOUCH_TIMEOUT)
        .map_err(|source| CellError::Touch {
            device: config.name.clone(),
            index: index + 1,
            source: Box::new(source),
        })
}

/// A scan that is not whole decides nothing in the part's favour: what was measured may still prove it not OK.
fn judge_completeness(scan: &Scan, inspection: &mut Inspection) {
    for view in &scan.views {
        inspection.findings.extend(view.findings.iter().cloned());
        if !view.complete {
            inspection.verdict = inspection.verdict.max(Verdict::NotDecidable);
        }
    }
}

/// A device whose calibration has run out decides nothing.
fn judge_calibrations(cell: &Cell, now: SystemTime, inspection: &mut Inspection) {
    let profilers = cell.profilers.iter().map(|p| (&p.name, p.calibrated));
    let probes = cell.probes.iter().map(|p| (&p.name, p.calibrated));
    for (name, calibrated) in profilers.chain(probes) {
        let Some(until) = calibrated.and_then(|calibrated| calibrated.overdue(now)) else {
            continue;
        };
        inspection.findings.push(format!(
            "device {name:?}: its calibration held until {}, expected one that holds; calibrate it, then measure again",
            humantime::format_rfc3339_seconds(until)
        ));
        inspection.verdict = inspection.verdict.max(Verdict::NotDecidable);
    }
}
