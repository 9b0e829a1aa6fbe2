//! A cell's TOML as checked values, or all mistakes at once, each with its line, what was seen and what is allowed.
//!
//! Reading has no effects beyond reading the file: no device is touched. A path that begins with `./` or has no leading `/`
//! is taken from the folder of the configuration, a port only where it begins with `./`.

mod service;
mod table;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use acies_drivers::device::{Claim, Mistake, Setup};
use acies_drivers::settings::Keys;
use glam::DVec3;

use crate::acquire::{Calibration, CarrierPlan, ScanPlan};
use crate::geometry::RigidTransform;
pub use service::Service;
use table::{Lines, calibrated, calibration, pose, vector};

/// A profiler silent for this long has not reached the end of its scan: the slowest stages we know of trigger once a second.
const SILENCE_S: f64 = 5.0;

/// How near a robot must come to the end of its scan: more than its repeatability, less than any way.
const WITHIN_MM: f64 = 1.0;

/// Counts beyond which nobody's stage goes: a thousand kilometres at a micrometre a count.
const COUNTS_MAX: i64 = 1_000_000_000_000;

/// Of a cell without a stage.
const NO_STAGE: ScanPlan = ScanPlan {
    end_count: i64::MAX,
    silence: Duration::from_secs(5),
};

/// A checked cell, ready to start.
#[derive(Debug)]
pub struct Cell {
    /// What the cell is called in reports.
    pub name: String,
    /// The CAD file of the part.
    pub nominal: PathBuf,
    /// Limits and rules; without one nothing is judged.
    pub recipe: Option<PathBuf>,
    /// Where the fixture holds the part; the true pose is found from the data.
    pub machine_from_part: RigidTransform,
    /// When a scan by the stage ends.
    pub plan: ScanPlan,
    /// The robot that carries the profilers, where one does; there is no stage then.
    pub carrier: Option<CarrierConfig>,
    /// In the order of the file.
    pub profilers: Vec<ProfilerConfig>,
    /// In the order of the file.
    pub probes: Vec<ProbeConfig>,
    /// How the daemon serves it.
    pub service: Service,
}

/// A checked profiler.
#[derive(Debug)]
pub struct ProfilerConfig {
    /// Used in reports.
    pub name: String,
    /// Ready to open.
    pub setup: Box<dyn Setup>,
    /// Where it is and how it moves.
    pub calibration: Calibration,
    /// When that was found; `None` where nobody says.
    pub calibrated: Option<Calibrated>,
}

/// When a device was calibrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Calibrated {
    /// The time.
    pub date: SystemTime,
    /// How long it holds; `None` = for ever.
    pub valid: Option<Duration>,
}

impl Calibrated {
    /// The time at which it ran out, where it has at `now`.
    pub fn overdue(&self, now: SystemTime) -> Option<SystemTime> {
        let until = self.date.checked_add(self.valid?)?;
        (now > until).then_some(until)
    }
}

/// A checked robot that carries the profilers.
#[derive(Debug)]
pub struct CarrierConfig {
    /// Used in reports.
    pub name: String,
    /// Ready to open.
    pub setup: Box<dyn Setup>,
    /// When a scan ends, and where the robot stands.
    pub plan: CarrierPlan,
}

/// A checked probe.
#[derive(Debug)]
pub struct ProbeConfig {
    /// Used in reports.
    pub name: String,
    /// Ready to open.
    pub setup: Box<dyn Setup>,
    /// Radius of the tip, mm.
    pub tip_radius_mm: f64,
    /// Standard uncertainty of one touch, mm.
    pub u_touch_mm: f64,
    /// When these were found; `None` where nobody says.
    pub calibrated: Option<Calibrated>,
    /// What it touches before a scan.
    pub touches: Vec<PlannedTouch>,
}

/// One touch, in the part frame: the fixture's pose brings it to the machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedTouch {
    /// Where the tip goes first, mm.
    pub start_mm: DVec3,
    /// Where it goes towards; contact is expected on the way, mm.
    pub target_mm: DVec3,
}

/// Everything that is wrong with a configuration.
#[derive(Debug, PartialEq)]
pub struct ConfigErrors {
    /// At least one, in the order of the file.
    pub mistakes: Vec<LocatedMistake>,
}

/// One mistake and its place.
#[derive(Debug, Clone, PartialEq)]
pub struct LocatedMistake {
    /// The file.
    pub file: PathBuf,
    /// Line from 1, where it is known.
    pub line: Option<usize>,
    /// The table it stands in, in words; empty at the top of the file.
    pub place: String,
    /// Key, what was found, what is expected.
    pub mistake: Mistake,
}

impl fmt::Display for LocatedMistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if !self.place.is_empty() {
            write!(f, ": {}", self.place)?;
        }
        write!(f, ": {}", self.mistake)
    }
}

impl fmt::Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines: Vec<String> = self.mistakes.iter().map(ToString::to_string).collect();
        write!(f, "{}", lines.join("\n"))
    }
}

impl std::error::Error for ConfigErrors {}

impl Cell {
    /// Reads and checks a cell's configuration.
    ///
    /// # Errors
    /// All mistakes of the file at once.
    pub fn read(path: &Path) -> Result<Self, ConfigErrors> {
        let text = std::fs::read_to_string(path).map_err(|error| {
            let mistake = mistake("file", &error.to_string(), "a readable TOML file");
            ConfigErrors {
                mistakes: vec![LocatedMistake {
                    file: path.to_owned(),
                    line: None,
                    place: String::new(),
                    mistake,
                }],
            }
        })?;
        Self::parse(&text, path)
    }

    /// Checks the text of a cell's configuration; `path` is for messages and for the paths in it.
    ///
    /// # Errors
    /// All mistakes of the text at once.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigErrors> {
        let mut checker = Checker {
            file: path,
            lines: Lines::of(text),
            mistakes: Vec::new(),
        };
        let cell = match text.parse::<toml::Table>() {
            Ok(table) => checker.cell(table),
            Err(error) => {
                let line = error.span().map(|span| table::line_at(text, span.start));
                checker.add_at(line, "", mistake("syntax", error.message(), "TOML"));
                None
            }
        };
        match cell {
            Some(cell) if checker.mistakes.is_empty() => Ok(cell),
            _ => Err(ConfigErrors {
                mistakes: checker.mistakes,
            }),
        }
    }
}

/// The mistakes of a table that has been read.
fn problems(keys: Keys) -> Vec<Mistake> {
    keys.finish().err().unwrap_or_default()
}

/// A mistake from its three parts.
fn mistake(key: &str, found: &str, expected: &str) -> Mistake {
    Mistake {
        key: key.to_owned(),
        found: found.to_owned(),
        expected: expected.to_owned(),
    }
}

/// Collects mistakes while values are taken out of the tables.
struct Checker<'a> {
    file: &'a Path,
    lines: Lines,
    mistakes: Vec<LocatedMistake>,
}

/// What a `[[device]]` became.
enum DeviceConfig {
    Profiler(ProfilerConfig),
    Probe(ProbeConfig),
    Carrier(CarrierConfig),
}

impl Checker<'_> {
    fn add_at(&mut self, line: Option<usize>, place: &str, mistake: Mistake) {
        self.mistakes.push(LocatedMistake {
            file: self.file.to_owned(),
            line,
            place: place.to_owned(),
            mistake,
        });
    }

    /// Takes over the mistakes of one table, which stands at `path` in the file.
    fn add_all(&mut self, path: &[&str], place: &str, mistakes: Vec<Mistake>) {
        for mistake in mistakes {
            let keys: Vec<&str> = path.iter().copied().chain(mistake.key.split('.')).collect();
            let line = self.lines.find(&keys);
            self.add_at(line, place, mistake);
        }
    }

    fn cell(&mut self, table: toml::Table) -> Option<Cell> {
        let mut top = Keys::new(table);
        let name = top.needed("name", "a text", Keys::text);
        let part = top.needed("part", "a table [part]", Keys::table);
        let devices = top.tables("device");
        let service = top.table("service");
        let carried = devices.iter().any(|device| device.contains_key("carrier"));
        let stage = match carried {
            false => top.needed("stage", "a table [stage]", Keys::table),
            true => {
                if top.contains("stage") {
                    top.wrong("stage", "a table", "none beside [device.carrier]");
                }
                top.table("stage").and(None)
            }
        };
        self.add_all(&[], "", problems(top));
        let (service, mistakes) = service::service(service, &|path| self.beside(path));
        self.add_all(&["service"], "service", mistakes);
        let part = part.and_then(|part| self.part(part));
        let stage = match carried {
            // The robot's own plan says when a scan ends.
            true => Some((DVec3::ZERO, NO_STAGE)),
            false => stage.and_then(|stage| self.stage(stage)),
        };
        let travel_mm_per_count = stage.as_ref().map_or(DVec3::ZERO, |stage| stage.0);
        let mut profilers = Vec::new();
        let mut probes = Vec::new();
        let mut carriers = Vec::new();
        for (index, device) in devices.into_iter().enumerate() {
            match self.device(index, device, travel_mm_per_count) {
                Some(DeviceConfig::Profiler(profiler)) => profilers.push(profiler),
                Some(DeviceConfig::Probe(probe)) => probes.push(probe),
                Some(DeviceConfig::Carrier(carrier)) => carriers.push(carrier),
                None => {}
            }
        }
        self.names_and_claims(&profilers, &probes, &carriers);
        if profilers.is_empty() && self.mistakes.is_empty() {
            self.add_at(
                None,
                "",
                mistake(
                    "device",
                    "no profiler",
                    "at least one [[device]] with a calibration",
                ),
            );
        }
        let (nominal, recipe, machine_from_part) = part?;
        Some(Cell {
            name: name?,
            nominal,
            recipe,
            machine_from_part,
            plan: stage?.1,
            carrier: carriers.pop(),
            profilers,
            probes,
            service,
        })
    }

    fn part(&mut self, table: toml::Table) -> Option<(PathBuf, Option<PathBuf>, RigidTransform)> {
        let mut part = Keys::new(table);
        let nominal = part.needed("nominal", "the name of a CAD file", Keys::text);
        let recipe = part.text("recipe");
        let pose = part.needed(
            "machine_from_part",
            "a table [part.machine_from_part]",
            pose,
        );
        let mut mistakes = problems(part);
        let mut file = |key: &str, name: Option<String>| {
            let path = self.beside(&name?);
            if !path.is_file() {
                mistakes.push(mistake(
                    key,
                    &format!("no file {}", path.display()),
                    "a file that exists",
                ));
            }
            Some(path)
        };
        let nominal = file("nominal", nominal);
        let recipe = file("recipe", recipe);
        self.add_all(&["part"], "part", mistakes);
        Some((nominal?, recipe, pose?))
    }

    fn stage(&mut self, table: toml::Table) -> Option<(DVec3, ScanPlan)> {
        let mut stage = Keys::new(table);
        let travel = vector(&mut stage, "travel_mm_per_count");
        let end_count = stage.needed("end_count", "a whole number", |keys, key| {
            keys.integer(key, -COUNTS_MAX..=COUNTS_MAX)
        });
        let silence_s = stage.number("silence_s", 0.1..=600.0).unwrap_or(SILENCE_S);
        let mut mistakes = problems(stage);
        if let Some(travel) = travel.filter(|travel| !(1e-7..=10.0).contains(&travel.length())) {
            let found = format!("{} mm a count", travel.length());
            mistakes.push(mistake(
                "travel_mm_per_count",
                &found,
                "a length of 1e-7 to 10 mm a count",
            ));
        }
        self.add_all(&["stage"], "stage", mistakes);
        Some((
            travel?,
            ScanPlan {
                end_count: end_count?,
                silence: Duration::from_secs_f64(silence_s),
            },
        ))
    }

    fn device(
        &mut self,
        index: usize,
        table: toml::Table,
        travel_mm_per_count: DVec3,
    ) -> Option<DeviceConfig> {
        let mut device = Keys::new(table);
        let name = device.needed("name", "a text", Keys::text);
        let driver = device.needed("driver", "the word of a driver", Keys::text);
        let calibration = device
            .contains("calibration")
            .then(|| calibration(&mut device, "calibration"));
        let tip = device.table("tip");
        let carrier = device.table("carrier");
        let touches = device.tables("touch");
        let place = name
            .as_ref()
            .map_or(format!("device {}", index + 1), |name| {
                format!("device {name:?}")
            });
        let number = index.to_string();
        let at = ["device", number.as_str()];
        let (rest, mut mistakes) = device.into_rest();
        let setup = driver.and_then(|driver| self.setup(&driver, rest, &mut mistakes));
        let kinds = [calibration.is_some(), tip.is_some(), carrier.is_some()];
        if kinds.iter().filter(|given| **given).count() != 1 {
            let found = if kinds.contains(&true) {
                "several"
            } else {
                "none"
            };
            mistakes.push(mistake(
                "calibration",
                found,
                "one of [device.calibration] for a profiler, [device.tip] for a probe, [device.carrier] for a robot",
            ));
        }
        self.add_all(&at, &place, mistakes);
        let tip = tip.and_then(|tip| self.tip(&at, &place, tip));
        let carrier = carrier.and_then(|carrier| self.carrier(&at, &place, carrier));
        let touches = touches
            .into_iter()
            .enumerate()
            .filter_map(|(i, touch)| self.touch(&at, &place, i, touch));
        let touches: Vec<PlannedTouch> = touches.collect();
        let (name, setup) = (name?, setup?);
        if let Some(plan) = carrier {
            return Some(DeviceConfig::Carrier(CarrierConfig { name, setup, plan }));
        }
        match (calibration, tip) {
            (Some(found), None) => {
                let (machine_from_sensor, calibrated) = found?;
                let calibration = Calibration {
                    machine_from_sensor,
                    travel_mm_per_count,
                };
                Some(DeviceConfig::Profiler(ProfilerConfig {
                    name,
                    setup,
                    calibration,
                    calibrated,
                }))
            }
            (None, Some((tip_radius_mm, u_touch_mm, calibrated))) => {
                Some(DeviceConfig::Probe(ProbeConfig {
                    name,
                    setup,
                    tip_radius_mm,
                    u_touch_mm,
                    calibrated,
                    touches,
                }))
            }
            _ => None,
        }
    }

    /// The driver's own check of what the cell did not take for itself.
    fn setup(
        &self,
        driver: &str,
        mut table: toml::Table,
        mistakes: &mut Vec<Mistake>,
    ) -> Option<Box<dyn Setup>> {
        if let Some(toml::Value::String(port)) = table.get_mut("port")
            && port.starts_with("./")
        {
            *port = self.beside(port).display().to_string();
        }
        let Some(found) = acies_drivers::ALL.iter().find(|known| known.name == driver) else {
            let names: Vec<&str> = acies_drivers::ALL.iter().map(|known| known.name).collect();
            mistakes.push(mistake(
                "driver",
                &format!("{driver:?}"),
                &format!("one of {}", names.join(", ")),
            ));
            return None;
        };
        (found.configure)(table)
            .map_err(|found| mistakes.extend(found))
            .ok()
    }

    fn tip(
        &mut self,
        at: &[&str],
        place: &str,
        table: toml::Table,
    ) -> Option<(f64, f64, Option<Calibrated>)> {
        let mut tip = Keys::new(table);
        let calibrated = calibrated(&mut tip);
        let radius_mm = tip.needed("radius_mm", "a number, mm", |keys, key| {
            keys.number(key, 0.05..=25.0)
        });
        let u_touch_mm = tip.needed("u_touch_mm", "a number, mm", |keys, key| {
            keys.number(key, 1e-5..=1.0)
        });
        let path: Vec<&str> = at.iter().copied().chain(["tip"]).collect();
        self.add_all(&path, &format!("{place}, tip"), problems(tip));
        Some((radius_mm?, u_touch_mm?, calibrated))
    }

    fn carrier(&mut self, at: &[&str], place: &str, table: toml::Table) -> Option<CarrierPlan> {
        let mut carrier = Keys::new(table);
        let base = carrier.needed(
            "machine_from_base",
            "a table [device.carrier.machine_from_base]",
            pose,
        );
        let end_mm = vector(&mut carrier, "end_mm");
        let within_mm = carrier.number("within_mm", 0.01..=100.0);
        let lag_s = carrier.number("lag_s", -1.0..=1.0);
        let silence_s = carrier.number("silence_s", 0.1..=600.0);
        let path: Vec<&str> = at.iter().copied().chain(["carrier"]).collect();
        self.add_all(&path, &format!("{place}, carrier"), problems(carrier));
        Some(CarrierPlan {
            machine_from_base: base?,
            end_mm: end_mm?,
            within_mm: within_mm.unwrap_or(WITHIN_MM),
            lag_s: lag_s.unwrap_or(0.0),
            silence: Duration::from_secs_f64(silence_s.unwrap_or(SILENCE_S)),
        })
    }

    fn touch(
        &mut self,
        at: &[&str],
        place: &str,
        index: usize,
        table: toml::Table,
    ) -> Option<PlannedTouch> {
        let mut touch = Keys::new(table);
        let start_mm = vector(&mut touch, "start_mm");
        let target_mm = vector(&mut touch, "target_mm");
        let mut mistakes = problems(touch);
        if let (Some(start), Some(target)) = (start_mm, target_mm)
            && start.distance(target) < 0.1
        {
            mistakes.push(mistake(
                "target_mm",
                "less than 0.1 mm from start_mm",
                "a way on which contact happens",
            ));
        }
        let number = index.to_string();
        let path: Vec<&str> = at
            .iter()
            .copied()
            .chain(["touch", number.as_str()])
            .collect();
        self.add_all(&path, &format!("{place}, touch {}", index + 1), mistakes);
        Some(PlannedTouch {
            start_mm: start_mm?,
            target_mm: target_mm?,
        })
    }

    /// Names must differ, and no two devices may want the same thing.
    fn names_and_claims(
        &mut self,
        profilers: &[ProfilerConfig],
        probes: &[ProbeConfig],
        carriers: &[CarrierConfig],
    ) {
        let devices = (profilers.iter().map(|p| (&p.name, &p.setup)))
            .chain(probes.iter().map(|p| (&p.name, &p.setup)))
            .chain(carriers.iter().map(|c| (&c.name, &c.setup)));
        if carriers.len() > 1 {
            let found = format!("{} devices with [device.carrier]", carriers.len());
            self.add_at(None, "device", mistake("carrier", &found, "one robot"));
        }
        let mut names: BTreeMap<&str, usize> = BTreeMap::new();
        let mut claims: BTreeMap<Claim, Vec<String>> = BTreeMap::new();
        for (name, setup) in devices {
            *names.entry(name).or_default() += 1;
            for claim in setup.claims() {
                claims.entry(claim).or_default().push(format!("{name:?}"));
            }
        }
        for (name, _) in names.into_iter().filter(|(_, count)| *count > 1) {
            let found = format!("{name:?} more than once");
            self.add_at(
                None,
                "device",
                mistake("name", &found, "a name of its own for every device"),
            );
        }
        for (claim, wanted_by) in claims
            .into_iter()
            .filter(|(_, wanted_by)| wanted_by.len() > 1)
        {
            let found = format!("{claim} is wanted by {}", wanted_by.join(" and "));
            self.add_at(
                None,
                "device",
                mistake("port", &found, "one device on each port"),
            );
        }
    }

    /// A path of the file, taken from the file's own folder.
    fn beside(&self, path: &str) -> PathBuf {
        let folder = self.file.parent().unwrap_or(Path::new(""));
        folder.join(path.strip_prefix("./").unwrap_or(path))
    }
}
