//! One job: touch, scan, find the pose, measure, conclude.

use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use acies_drivers::capture::Touch;
use acies_drivers::device::{Identity, Instrument, Probe, Profiler, Setup};
use acies_drivers::link::Links;
use glam::DVec3;

use super::CellError;
use super::meanwhile::{Feeding, Meanwhile, Show};
use crate::acquire::{Carrier, Profiling, Scan, ScanEvent, ScanWatch, scan, scan_carried};
use crate::config::{CarrierConfig, Cell, ProbeConfig};
use crate::inspect::result::{Inspection, Verdict};
use crate::inspect::{self, Recipe, Request, Sampled, Start, Surface};
use crate::nominal::Nominal;
use crate::report::{DeviceFacts, Facts, Report, ScanFacts};

/// How long one touch may take: a machine that crosses a metre at 10 mm/s needs 100 s.
const TOUCH_TIMEOUT: Duration = Duration::from_secs(120);

/// What a job is doing.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
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

/// What parts are compared with and judged by.
#[derive(Debug)]
pub struct Part {
    /// The nominal.
    pub nominal: Nominal,
    /// File name of the nominal, for the report.
    pub nominal_name: String,
    /// Limits and rules.
    pub recipe: Recipe,
    sampled: OnceLock<Arc<Sampled>>,
}

impl Part {
    /// Of a nominal read from a file of this name.
    pub fn new(nominal: Nominal, nominal_name: String, recipe: Recipe) -> Self {
        Self {
            nominal,
            nominal_name,
            recipe,
            sampled: OnceLock::new(),
        }
    }

    /// The nominal ready for look-ups, sampled at the first time.
    pub fn surface(&self) -> Surface<'_, Nominal> {
        let sampled = self
            .sampled
            .get_or_init(|| Arc::new(Sampled::new(&self.nominal)));
        Surface::sampled(&self.nominal, sampled.clone())
    }
}

/// What a job brought.
#[derive(Debug)]
pub struct Outcome {
    /// The points and what happened on the way.
    pub scan: Scan,
    /// What it was compared with and judged by.
    pub part: Arc<Part>,
    /// The probes, by name.
    pub probes: Vec<(String, Identity)>,
    /// Contacts of the probes with the part, machine frame.
    pub touches: Vec<inspect::Touch>,
    /// What was found.
    pub inspection: Inspection,
    /// From the first profile's start to the last profile, s.
    pub scan_seconds: f64,
    /// From the last profile to the verdict, s.
    pub verdict_seconds: f64,
}

/// The open devices of a job.
pub(super) struct Instruments {
    pub carrier: Option<Carrier>,
    pub profilers: Vec<Profiling>,
    pub probes: Vec<(String, Box<dyn Probe>)>,
}

/// What the devices delivered.
pub(super) struct Acquired {
    pub scan: Scan,
    pub touches: Vec<inspect::Touch>,
    pub probes: Vec<(String, Identity)>,
    pub scan_seconds: f64,
    pub ended: Instant,
    /// What the part is compared with and judged by.
    pub part: Arc<Part>,
    /// The inspection that began with the scan.
    pub meanwhile: Option<Meanwhile>,
}

/// Who follows the part of a job that the devices do.
pub(super) trait JobWatch: ScanWatch {
    /// A step outside of the scan.
    fn step(&mut self, step: Step);

    /// Who is shown the edges while they are measured.
    fn show(&mut self) -> Option<Show> {
        None
    }
}

/// Lets a closure that takes [`Step`]s follow a job.
struct Told<'a>(&'a mut dyn FnMut(Step));

impl ScanWatch for Told<'_> {
    fn event(&mut self, event: ScanEvent) {
        self.0(step_of(event));
    }
}

impl JobWatch for Told<'_> {
    fn step(&mut self, step: Step) {
        self.0(step);
    }
}

/// A scan's event as a job's step.
pub(super) fn step_of(event: ScanEvent) -> Step {
    match event {
        ScanEvent::Progress { profiles, share } => Step::Scanning { profiles, share },
        ScanEvent::Lost { device, error } => Step::Lost { device, error },
    }
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
    check_recipe(&text, &path.display().to_string())
}

/// The recipe in `text`; `place` is for messages.
///
/// # Errors
/// [`CellError::Recipe`].
pub fn check_recipe(text: &str, place: &str) -> Result<Recipe, CellError> {
    Recipe::parse(text).map_err(|mistakes| {
        let lines: Vec<String> = mistakes
            .iter()
            .map(|mistake| format!("{place}: {mistake}"))
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
pub fn read_part(cell: &Cell) -> Result<Part, CellError> {
    let name = cell.nominal.file_name().unwrap_or_default();
    Ok(Part::new(
        read_nominal(&cell.nominal)?,
        name.to_string_lossy().into_owned(),
        read_recipe(cell.recipe.as_deref())?,
    ))
}

pub(super) fn read_nominal(path: &Path) -> Result<Nominal, CellError> {
    Nominal::read(path).map_err(|error| CellError::Nominal(Box::new(error)))
}

/// Runs one inspection of the part that lies in the cell.
///
/// # Errors
/// [`CellError`] when the job could not be begun or a touch failed. A device that is lost in mid-scan is no error: the
/// outcome then says that it is not decidable, and why.
pub fn run(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(Step),
) -> Result<Outcome, CellError> {
    let part = Arc::new(read_part(cell)?);
    let mut instruments = open_all(cell, links, watch)?;
    let acquired = acquire(cell, &part, &mut instruments, &mut Told(watch))?;
    drop(instruments);
    watch(Step::Inspecting);
    Ok(conclude(cell, acquired, SystemTime::now()))
}

fn open_all(
    cell: &Cell,
    links: &dyn Links,
    watch: &mut dyn FnMut(Step),
) -> Result<Instruments, CellError> {
    let mut instruments = Instruments {
        carrier: None,
        profilers: Vec::new(),
        probes: Vec::new(),
    };
    let mut open = |device: &str, setup: &dyn Setup| {
        watch(Step::Opening {
            device: device.to_owned(),
        });
        setup.open(links).map_err(|source| CellError::Device {
            device: device.to_owned(),
            source: Box::new(source),
        })
    };
    for config in &cell.profilers {
        let profiler = as_profiler(&config.name, open(&config.name, &*config.setup)?)?;
        instruments.profilers.push(Profiling {
            name: config.name.clone(),
            profiler,
            calibration: config.calibration,
        });
    }
    for config in &cell.probes {
        let probe = as_probe(&config.name, open(&config.name, &*config.setup)?)?;
        instruments.probes.push((config.name.clone(), probe));
    }
    if let Some(config) = &cell.carrier {
        instruments.carrier = Some(as_carrier(config, open(&config.name, &*config.setup)?)?);
    }
    Ok(instruments)
}

/// The profiler that an instrument is.
pub(super) fn as_profiler(
    device: &str,
    instrument: Instrument,
) -> Result<Box<dyn Profiler>, CellError> {
    match instrument {
        Instrument::Profiler(profiler) => Ok(profiler),
        other => Err(wrong_kind(device, &other, "profiler")),
    }
}

/// The probe that an instrument is.
pub(super) fn as_probe(device: &str, instrument: Instrument) -> Result<Box<dyn Probe>, CellError> {
    match instrument {
        Instrument::Probe(probe) => Ok(probe),
        other => Err(wrong_kind(device, &other, "probe")),
    }
}

/// The robot that an instrument is, as what carries the profilers.
pub(super) fn as_carrier(
    config: &CarrierConfig,
    instrument: Instrument,
) -> Result<Carrier, CellError> {
    match instrument {
        Instrument::Robot(robot) => Ok(Carrier {
            name: config.name.clone(),
            robot,
            plan: config.plan,
        }),
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

/// Touches and scans. The profilers are gone from `instruments` where the scan did not start.
///
/// # Errors
/// [`CellError::Touch`], [`CellError::Scan`], and [`CellError::GivenUp`] between two touches.
pub(super) fn acquire(
    cell: &Cell,
    part: &Arc<Part>,
    instruments: &mut Instruments,
    watch: &mut dyn JobWatch,
) -> Result<Acquired, CellError> {
    let touches = touch_all(cell, &mut instruments.probes, watch)?;
    let identity =
        |(name, probe): &(String, Box<dyn Probe>)| (name.clone(), probe.identity().clone());
    let probes = instruments.probes.iter().map(identity).collect();
    let began = Instant::now();
    let profilers = std::mem::take(&mut instruments.profilers);
    let mut feeding = Feeding::new(cell, part, (&profilers, &touches), watch);
    let (scan, profilers) = match &mut instruments.carrier {
        Some(carrier) => scan_carried(profilers, carrier, &mut feeding)?,
        None => scan(profilers, cell.plan, &mut feeding)?,
    };
    let meanwhile = feeding.end();
    let ended = Instant::now();
    instruments.profilers = profilers;
    Ok(Acquired {
        scan,
        touches,
        probes,
        scan_seconds: (ended - began).as_secs_f64(),
        ended,
        part: part.clone(),
        meanwhile,
    })
}

/// Finds the pose, measures and judges what was acquired, or ends what went on meanwhile. `now` tells whether calibrations still hold.
pub(super) fn conclude(cell: &Cell, mut acquired: Acquired, now: SystemTime) -> Outcome {
    let part = acquired.part.clone();
    let cloud = &acquired.scan.cloud;
    let meanwhile = acquired.meanwhile.take();
    let mut inspection = meanwhile
        .and_then(|meanwhile| meanwhile.finish(cloud.len()))
        .unwrap_or_else(|| {
            let start = Start::Rough(cell.machine_from_part.inverse());
            let request = Request {
                touches: &acquired.touches,
                ..Request::new(&part.recipe, start)
            };
            inspect::inspect_on(cloud, &part.surface(), &request)
        });
    judge_completeness(&acquired.scan, &mut inspection);
    judge_calibrations(cell, now, &mut inspection);
    Outcome {
        scan_seconds: acquired.scan_seconds,
        verdict_seconds: acquired.ended.elapsed().as_secs_f64(),
        scan: acquired.scan,
        part,
        probes: acquired.probes,
        touches: acquired.touches,
        inspection,
    }
}

/// Touches what the cell plans.
fn touch_all(
    cell: &Cell,
    probes: &mut [(String, Box<dyn Probe>)],
    watch: &mut dyn JobWatch,
) -> Result<Vec<inspect::Touch>, CellError> {
    let of = cell.probes.iter().map(|probe| probe.touches.len()).sum();
    let mut touched = Vec::new();
    for (config, (_, probe)) in cell.probes.iter().zip(probes) {
        for index in 0..config.touches.len() {
            watch.step(Step::Touching {
                done: touched.len(),
                of,
            });
            if watch.aborted() {
                return Err(CellError::GivenUp {
                    reason: "given up between two touches".to_owned(),
                });
            }
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
    }
    Ok(touched)
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

/// The report of an outcome. `part` names the part, `created` is when its scan ended.
pub fn report_of(
    outcome: &Outcome,
    part: &str,
    created: SystemTime,
    simulated_seed: Option<u64>,
) -> Report {
    let scan = outcome.inspection.scan.as_ref();
    let profilers = outcome.scan.views.iter().map(|view| DeviceFacts {
        name: view.device.clone(),
        identity: view.identity.clone(),
        losses: Some(view.losses),
    });
    let probes = outcome.probes.iter().map(|(name, identity)| DeviceFacts {
        name: name.clone(),
        identity: identity.clone(),
        losses: None,
    });
    let facts = Facts {
        with_budgets: false,
        part: part.to_owned(),
        nominal: outcome.part.nominal_name.clone(),
        created,
        simulated_seed,
        scan: ScanFacts {
            points: outcome.scan.cloud.len(),
            spacing_mm: scan.map(|scan| scan.spacing.mean_mm),
            spacing_along_line_mm: scan.map(|scan| scan.spacing.along_mm),
            spacing_across_lines_mm: scan.map(|scan| scan.spacing.across_mm),
            noise_mm: scan.map(|scan| scan.noise_mm),
        },
        devices: profilers.chain(probes).collect(),
        recipe: outcome.part.recipe.clone(),
    };
    Report::new(&outcome.inspection, &facts)
}
