//! Coordinate measuring machines whose controller is an I++ DME server.
//!
//! Manual: I++ DME Interface, release 1.4.3. Quirks, from the logs of the NIST test suite: items come in another order than the report list
//! asks for, so that they are read by name; scan lines are bare numbers, in an order that servers differ in; a point takes tens of seconds. The
//! specification leaves it to the server whether a point is the centre of the tip or lies on the surface.
//!
//! # Configuration
//!
//! ```toml
//! address = "10.0.0.7"            # port 1294 unless it says another
//! reports = "tip-centre"          # needed: what the server reports of a point, "tip-centre" or "surface"
//! tip_radius_mm = 1.0             # needed with "surface"
//! machine_class = "CartCMM"       # of the machine: another one is refused
//! coordinate_system = "MachineCsy" # of all points; "" leaves the server's
//! tool = "Probe1"                 # changed to at opening, which moves the machine; without it the tool stays
//! home = false                    # homes a machine that is not, which moves it; otherwise it is refused
//! safe_z_mm = 150.0               # between touches the tip goes up to here, across, and down; without it, straight
//! scan_order = "xyz"              # of the three numbers of a scan's point: servers differ
//! set_search = true               # tells the server approach and search of every point; false leaves the server's
//! ```

use std::time::{Duration, Instant};

use crate::capture::Touch;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Presence, Probe, Setup, same,
};
use crate::error::DeviceError;
use crate::link::{self, Links, Target};
use crate::settings::Keys;

pub mod line;
mod session;

pub use session::{Event, Session};

use line::{Item, numbers_of};
use session::SHORT;

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "ippdme",
    summary: "coordinate measuring machines with an I++ DME 1.4.3 server: TCP",
    configure,
};

/// Application port of the specification.
const PORT: u16 = 1294;
/// Time to change a tool or to home.
const LONG: Duration = Duration::from_secs(300);
/// A contact this far off the way, beyond the tip's radius, is no contact of this touch, mm.
const OFF_WAY_MM: f64 = 1.0;

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    target: Target,
    /// Added to a reported point along its normal to get the centre of the tip, mm.
    centre_above_mm: f64,
    machine_class: Option<String>,
    coordinate_system: String,
    tool: Option<String>,
    home: bool,
    safe_z_mm: Option<f64>,
    set_search: bool,
    scan_order: [usize; 3],
}

/// Places of X, Y and Z among three numbers in that order.
const ORDERS: [(&str, [usize; 3]); 6] = [
    ("xyz", [0, 1, 2]),
    ("xzy", [0, 2, 1]),
    ("yxz", [1, 0, 2]),
    ("yzx", [2, 0, 1]),
    ("zxy", [1, 2, 0]),
    ("zyx", [2, 1, 0]),
];
const REPORTS: [(&str, bool); 2] = [("tip-centre", false), ("surface", true)];

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let address = keys.host_and_port("address", PORT);
    let expected = "\"tip-centre\" or \"surface\"; the server's manual says which";
    let surface = keys.needed("reports", expected, |keys, key| keys.choice(key, &REPORTS));
    let radius_mm = keys.number("tip_radius_mm", 0.0..=100.0);
    if surface == Some(true) && radius_mm.is_none() {
        keys.wrong(
            "tip_radius_mm",
            "nothing",
            "the tip's radius, with reports = \"surface\"",
        );
    }
    let machine_class = keys.text("machine_class").filter(|text| quotable(text));
    let plain = |value: &toml::Value| {
        let text = value.as_str()?;
        text.bytes()
            .all(|b| b.is_ascii_alphanumeric())
            .then(|| text.to_owned())
    };
    let coordinate_system = keys.read("coordinate_system", "a name of letters and digits", plain);
    let quoted = |value: &toml::Value| {
        value
            .as_str()
            .filter(|text| quotable(text))
            .map(str::to_owned)
    };
    let tool = keys.read("tool", "a name without quotes", quoted);
    let home = keys.flag("home").unwrap_or(false);
    let safe_z_mm = keys.number("safe_z_mm", -1e5..=1e5);
    let set_search = keys.flag("set_search").unwrap_or(true);
    let scan_order = keys.choice("scan_order", &ORDERS).unwrap_or([0, 1, 2]);
    keys.finish()?;
    let (Some((host, port)), Some(surface)) = (address, surface) else {
        // Without a mistake both are there: `finish` has returned otherwise.
        return Err(Vec::new());
    };
    Ok(Box::new(Settings {
        target: Target::Tcp {
            address: format!("{host}:{port}"),
        },
        centre_above_mm: if surface {
            radius_mm.unwrap_or(0.0)
        } else {
            0.0
        },
        machine_class,
        coordinate_system: coordinate_system.unwrap_or_else(|| "MachineCsy".into()),
        tool,
        home,
        safe_z_mm,
        set_search,
        scan_order,
    }))
}

/// Fits into a line of the protocol between quotes.
fn quotable(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| (32..127).contains(&b) && b != b'"')
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let port = self.target.to_string();
        let link = links
            .open(&self.target)
            .map_err(|source| DeviceError::Link {
                port: port.clone(),
                source,
            })?;
        let mut session = Session::start(port.clone(), link)?;
        let identity = self.introduce(&port, &mut session)?;
        self.make_ready(&port, &mut session)?;
        Ok(Instrument::Probe(Box::new(IppDme {
            port,
            session,
            identity,
            centre_above_mm: self.centre_above_mm,
            safe_z_mm: self.safe_z_mm,
            set_search: self.set_search,
            scan_order: self.scan_order,
        })))
    }
}

impl Settings {
    fn introduce(&self, port: &str, session: &mut Session) -> Result<Identity, DeviceError> {
        let version = text_of(&session.ask("GetDMEVersion()", SHORT)?);
        let class = text_of(&session.ask("GetMachineClass()", SHORT)?);
        if let Some(expected) = self.machine_class.as_ref().filter(|name| **name != class) {
            return Err(DeviceError::WrongDevice {
                port: port.to_owned(),
                found: class,
                expected: expected.clone(),
            });
        }
        Ok(Identity {
            vendor: "I++ DME server".into(),
            model: class,
            serial: String::new(),
            firmware: version,
        })
    }

    fn make_ready(&self, port: &str, session: &mut Session) -> Result<(), DeviceError> {
        let homed = session.ask("IsHomed()", SHORT)?;
        let homed = homed
            .iter()
            .any(|items| numbers_of(items, "IsHomed") == Some([1.0]));
        if !homed && self.home {
            session.ask("Home()", LONG)?;
        } else if !homed {
            return Err(DeviceError::OutOfOrder {
                port: port.to_owned(),
                action: "open",
                needed: "a homed machine; home it, or set `home = true`",
            });
        }
        if let Some(tool) = &self.tool {
            session.ask(&format!("ChangeTool(\"{tool}\")"), LONG)?;
        }
        if !self.coordinate_system.is_empty() {
            session.ask(
                &format!("SetCoordSystem({})", self.coordinate_system),
                SHORT,
            )?;
        }
        session
            .ask("OnPtMeasReport(X(), Y(), Z(), IJK())", SHORT)
            .map(drop)
    }
}

/// The text in the first item of an answer, as in `DMEVersion("1.4.3")`.
fn text_of(data: &[Vec<Item>]) -> String {
    let first = data.iter().flatten().next();
    match first {
        Some(Item::Call(_, arguments)) => match arguments.first() {
            Some(Item::Text(text) | Item::Name(text)) => text.clone(),
            Some(Item::Number(number)) => number.to_string(),
            _ => String::new(),
        },
        Some(Item::Text(text) | Item::Name(text)) => text.clone(),
        _ => String::new(),
    }
}

/// An open machine.
struct IppDme {
    port: String,
    session: Session,
    identity: Identity,
    centre_above_mm: f64,
    safe_z_mm: Option<f64>,
    set_search: bool,
    scan_order: [usize; 3],
}

impl IppDme {
    /// Reads the answer of a point: the centre of the tip, mm.
    fn centre(&self, point: [f64; 3], normal: [f64; 3], reported: Option<[f64; 3]>) -> [f64; 3] {
        // The specification returns the normal normalised; one that is none is not used.
        let sound = reported.filter(|n| (length(*n) - 1.0).abs() < 1e-3);
        let normal = sound.unwrap_or(normal);
        std::array::from_fn(|i| point[i] + self.centre_above_mm * normal[i])
    }

    /// Goes to where a touch starts; over the safe height where there is one.
    fn go_to(&mut self, start_mm: [f64; 3], deadline: Instant) -> Result<(), DeviceError> {
        let [x, y, z] = start_mm.map(|mm| format!("{mm:.7}"));
        let moves = match self.safe_z_mm {
            None => vec![format!("GoTo(X({x}), Y({y}), Z({z}))")],
            Some(safe) => vec![
                format!("GoTo(Z({safe:.7}))"),
                format!("GoTo(X({x}), Y({y}))"),
                format!("GoTo(Z({z}))"),
            ],
        };
        for command in moves {
            self.session.ask(&command, link::left(deadline))?;
        }
        Ok(())
    }

    /// A move that met nothing leaves the machine well: the error is cleared. After others a person decides.
    fn after_error(&mut self, error: DeviceError) -> DeviceError {
        let missed = self
            .session
            .failed()
            .is_some_and(|report| matches!(report.number, 1003 | 1006));
        if !missed {
            return error;
        }
        match self.session.clear() {
            Ok(()) => error,
            Err(failure) => failure,
        }
    }
}

impl Probe for IppDme {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn touch(
        &mut self,
        start_mm: [f64; 3],
        target_mm: [f64; 3],
        timeout: Duration,
    ) -> Result<Touch, DeviceError> {
        let way: [f64; 3] = std::array::from_fn(|i| target_mm[i] - start_mm[i]);
        let way_mm = length(way);
        if !way_mm.is_finite() || way_mm < 1e-6 {
            return Err(DeviceError::Move {
                port: self.port.clone(),
                asked_mm: target_mm,
                allowed: "a way of some length, and finite".into(),
            });
        }
        let deadline = Instant::now() + timeout;
        let direction = way.map(|d| d / way_mm);
        let normal = direction.map(|d| -d);
        let half_mm = 0.5 * way_mm;
        // The nominal point is the middle of the way, so that approach and search are the way itself.
        let nominal: [f64; 3] = std::array::from_fn(|i| {
            0.5 * (start_mm[i] + target_mm[i]) - self.centre_above_mm * normal[i]
        });
        if self.set_search {
            for (name, mm) in [
                ("Approach", half_mm),
                ("Search", half_mm),
                ("Retract", half_mm),
            ] {
                let command = format!("SetProp(Tool.PtMeasPar.{name}({mm:.6}))");
                self.session.ask(&command, SHORT)?;
            }
        }
        self.go_to(start_mm, deadline)?;
        let measured = self.session.point(nominal, normal, link::left(deadline));
        let (point, reported) = match measured {
            Ok(found) => found,
            Err(error) => return Err(self.after_error(error)),
        };
        let tip_centre_mm = self.centre(point, normal, reported);
        let off_mm = off_way(start_mm, direction, tip_centre_mm);
        if off_mm > OFF_WAY_MM + self.centre_above_mm {
            return Err(DeviceError::OffWay {
                port: self.port.clone(),
                contact_mm: tip_centre_mm,
                off_mm,
            });
        }
        Ok(Touch {
            tip_centre_mm,
            direction,
            host_time: Instant::now(),
        })
    }

    fn scan_line(
        &mut self,
        start_mm: [f64; 3],
        end_mm: [f64; 3],
        normal: [f64; 3],
        step_mm: f64,
        timeout: Duration,
    ) -> Result<Vec<Touch>, DeviceError> {
        let long = length(normal);
        let way_mm = length(std::array::from_fn(|i| end_mm[i] - start_mm[i]));
        // `>` with a NaN is false, so that no number that is none passes.
        if !(long > 1e-6 && way_mm > 1e-6 && step_mm > 1e-6 && (long + way_mm).is_finite()) {
            return Err(DeviceError::Move {
                port: self.port.clone(),
                asked_mm: end_mm,
                allowed: "a way, a normal and a step of some length, and finite".into(),
            });
        }
        let normal = normal.map(|n| n / long);
        // The server takes and reports what its points are: with "surface" the surface, otherwise the tip's centre.
        let lowered =
            |p: [f64; 3]| std::array::from_fn(|i| p[i] - self.centre_above_mm * normal[i]);
        let (start, end) = (lowered(start_mm), lowered(end_mm));
        let found = self
            .session
            .scan_line(start, end, normal, step_mm, self.scan_order, timeout);
        let points = match found {
            Ok(points) => points,
            Err(error) => return Err(self.after_error(error)),
        };
        let touches = points.into_iter().map(|(point, host_time)| Touch {
            tip_centre_mm: self.centre(point, normal, None),
            direction: normal.map(|n| -n),
            host_time,
        });
        Ok(touches.collect())
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        let class = text_of(&self.session.ask("GetMachineClass()", SHORT)?);
        same(&self.port, &self.identity.model, &class)
    }
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// Distance of a point from the line through `start` along the unit vector `direction`.
fn off_way(start: [f64; 3], direction: [f64; 3], point: [f64; 3]) -> f64 {
    let from: [f64; 3] = std::array::from_fn(|i| point[i] - start[i]);
    let along: f64 = (0..3).map(|i| from[i] * direction[i]).sum();
    length(std::array::from_fn(|i| from[i] - along * direction[i]))
}
