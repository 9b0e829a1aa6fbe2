//! Simulated devices by name, for the command line and for tests: each looks at the demo's cell.

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;

use crate::carried::Motion;
use crate::demo_cell::{DemoCell, DemoOptions, TIP_RADIUS_MM};
use crate::faults::{FaultError, Faults};
use crate::gauge::{self, Dialect};
use crate::gocator::{self, SimulatedGocator};
use crate::grbl::SimulatedProbe;
use crate::ippdme::{self, SimulatedCmm};
use crate::open_profile::SimulatedProfiler;
use crate::optoncdt;
use crate::point::SimulatedSensor;
use crate::pose::Pose;
use crate::rf60x;
use crate::u3v;
use crate::ur_rtde::{self, SimulatedRobot};
use crate::usb::Socket;
use crate::usb::preload::Carrier;
use crate::usb_itn::InputTool;
use crate::wire::Wire;

/// A kind of device that can be started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kind {
    /// The word for it; that of its driver, where there is one kind of it.
    pub name: &'static str,
    /// What it is, for people.
    pub summary: &'static str,
}

/// Every kind.
pub const ALL: [Kind; 14] = [
    Kind {
        name: "open-profile",
        summary: "line-laser profiler of the open-profile protocol, looking from the left",
    },
    Kind {
        name: "open-profile-right",
        summary: "the same, looking from the right",
    },
    Kind {
        name: "grbl-probe",
        summary: "touch probe on a GRBL controller",
    },
    Kind {
        name: "optoncdt",
        summary: "laser distance sensor optoNCDT 1420 over RS-422",
    },
    Kind {
        name: "rf60x",
        summary: "two laser distance sensors RF603 on an RS-485 bus",
    },
    Kind {
        name: "heidenhain-nd",
        summary: "display of a length gauge, Heidenhain ND 281B",
    },
    Kind {
        name: "mitutoyo",
        summary: "two dial gauges on a Mitutoyo multiplexer",
    },
    Kind {
        name: "sylvac",
        summary: "dial gauge of the Sylvac Opto-RS interface",
    },
    Kind {
        name: "keyence",
        summary: "two laser distance sensors Keyence IL on a DL-RS1A",
    },
    Kind {
        name: "gocator",
        summary: "LMI Gocator looking from the left; data 6 and health 4 ports above the control port",
    },
    Kind {
        name: "ippdme",
        summary: "measuring machine with an I++ DME server",
    },
    Kind {
        name: "u3v-profiler",
        summary: "USB3 Vision line profiler looking from the left",
    },
    Kind {
        name: "usb-itn",
        summary: "Mitutoyo gauge on a USB-ITN",
    },
    Kind {
        name: "ur-rtde",
        summary: "robot with an RTDE interface, its tool passing over the part once",
    },
];

/// Where a device is to appear.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// A pseudo-terminal under this path.
    Pty(PathBuf),
    /// A listening socket; port 0 takes any that is free.
    Tcp(SocketAddr),
    /// A folder in which umockdev's preload library finds a USB device; see [`crate::usb::preload`].
    Usb(PathBuf),
}

/// A device that runs; dropping it takes its port away.
#[derive(Debug)]
pub enum Simulated {
    /// A profiler.
    Profiler(SimulatedProfiler),
    /// A probe.
    Probe(SimulatedProbe),
    /// A sensor of single points, or several of them.
    Sensor(SimulatedSensor),
    /// A Gocator, and where its control channel listens.
    Gocator(SimulatedGocator, String),
    /// A measuring machine, and where it listens.
    Cmm(SimulatedCmm, String),
    /// A USB device, and what to start a program with that is to see it.
    Usb(Usb, String),
    /// A robot.
    Robot(SimulatedRobot),
}

/// A USB device in a folder.
#[derive(Debug)]
pub enum Usb {
    /// A line profiler.
    U3v(Carrier<u3v::Profiler>),
    /// A gauge.
    Itn(Carrier<InputTool>),
}

impl Simulated {
    /// Where a host finds it: the path of the port, `address:port`, or the variables that show a USB device to a program.
    pub fn port(&self) -> &str {
        match self {
            Simulated::Profiler(profiler) => profiler.port(),
            Simulated::Probe(probe) => probe.port(),
            Simulated::Robot(robot) => robot.port(),
            Simulated::Sensor(sensor) => sensor.port(),
            Simulated::Gocator(_, port) | Simulated::Cmm(_, port) | Simulated::Usb(_, port) => port,
        }
    }
}

/// Why a device does not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// No such kind.
    #[error("simulator: no device is called {name:?}, expected one of {known}", known = ALL.map(|k| k.name).join(", "))]
    UnknownDevice {
        /// What was asked for.
        name: String,
    },
    /// Faults that cannot be read.
    #[error(transparent)]
    Faults(#[from] FaultError),
    /// A place where no such device can be, or faults that it has not.
    #[error("simulator: {name} {found}, expected {expected}")]
    Place {
        /// Which device.
        name: String,
        /// What was asked for.
        found: &'static str,
        /// What is possible.
        expected: &'static str,
    },
    /// The system refuses the port.
    #[error("{port}: {source}, expected a path or address that can be taken; choose another")]
    Port {
        /// Path or address.
        port: String,
        /// What the system says.
        source: io::Error,
    },
}

/// Starts a device by name at a place, with faults as [`Faults`] reads them. Paced in real time, since people watch it.
///
/// # Errors
/// An unknown name, unreadable faults, or a place that cannot be taken.
pub fn start(name: &str, place: &Place, seed: u64, faults: &str) -> Result<Simulated, StartError> {
    let faults: Faults = faults.parse()?;
    let of_sensor = faults.clone();
    let cell = DemoCell::with_options(DemoOptions {
        paced: true,
        faults: faults.clone(),
        probe_faults: faults,
        ..DemoOptions::new(seed)
    });
    if !ALL.iter().any(|kind| kind.name == name) {
        return Err(StartError::UnknownDevice { name: name.into() });
    }
    let port = match place {
        Place::Pty(path) | Place::Usb(path) => path.display().to_string(),
        Place::Tcp(address) => address.to_string(),
    };
    let started = match (name, place) {
        ("gocator" | "ippdme" | "u3v-profiler" | "usb-itn", _)
            if !faults_text(&cell).is_empty() =>
        {
            return Err(refused(
                name,
                "with faults",
                "none: its faults are for tests",
            ));
        }
        ("gocator", Place::Tcp(address)) => start_gocator(&cell, *address),
        ("ippdme", Place::Tcp(address)) => start_cmm(&cell, *address),
        ("ur-rtde", Place::Tcp(address)) => start_robot(*address, seed, &of_sensor),
        ("gocator" | "ippdme" | "ur-rtde", _) => {
            return Err(refused(
                name,
                "somewhere else",
                "an address for it to listen on",
            ));
        }
        ("u3v-profiler" | "usb-itn", Place::Usb(folder)) => start_usb(&cell, name, folder),
        ("u3v-profiler" | "usb-itn", _) => {
            return Err(refused(
                name,
                "somewhere else",
                "a folder for the USB device",
            ));
        }
        (_, Place::Usb(_)) => {
            return Err(refused(name, "on USB", "a pseudo-terminal or an address"));
        }
        (_, Place::Pty(path)) => {
            Wire::pty(path).and_then(|wire| start_on_wire(&cell, name, wire, (seed, &of_sensor)))
        }
        (_, Place::Tcp(address)) => Wire::tcp(*address)
            .and_then(|wire| start_on_wire(&cell, name, wire, (seed, &of_sensor))),
    };
    started.map_err(|source| StartError::Port { port, source })
}

fn refused(name: &str, found: &'static str, expected: &'static str) -> StartError {
    StartError::Place {
        name: name.to_owned(),
        found,
        expected,
    }
}

/// Something where the cell has faults.
fn faults_text(cell: &DemoCell) -> &'static str {
    match cell.options.faults == Faults::default() {
        true => "",
        false => "faults",
    }
}

fn start_on_wire(
    cell: &DemoCell,
    name: &str,
    wire: Wire,
    (seed, of_sensor): (u64, &Faults),
) -> io::Result<Simulated> {
    let gauge = |dialect, channels, wire| {
        let setup = gauge::Setup {
            channels,
            faults: of_sensor.clone(),
            ..gauge::Setup::new(dialect, seed)
        };
        gauge::start(wire, setup).map(Simulated::Sensor)
    };
    match name {
        "optoncdt" => {
            let mut setup = optoncdt::Setup::new("SIM-1420", seed);
            setup.faults.clone_from(of_sensor);
            optoncdt::start(wire, setup).map(Simulated::Sensor)
        }
        "rf60x" => {
            let mut setup = rf60x::Setup::new(&[17_185, 17_186], seed);
            setup.faults.clone_from(of_sensor);
            rf60x::start(wire, setup).map(Simulated::Sensor)
        }
        "heidenhain-nd" => gauge(Dialect::HeidenhainNd, 1, wire),
        "mitutoyo" => gauge(Dialect::Mitutoyo, 2, wire),
        "sylvac" => gauge(Dialect::Sylvac, 1, wire),
        "keyence" => gauge(Dialect::Keyence, 2, wire),
        "grbl-probe" => cell.start_probe(wire).map(Simulated::Probe),
        "open-profile-right" => cell.start_profiler(1, wire).map(Simulated::Profiler),
        _ => cell.start_profiler(0, wire).map(Simulated::Profiler),
    }
}

/// Lines a second of devices that people watch.
const RATE_HZ: f64 = 500.0;

fn start_gocator(cell: &DemoCell, address: SocketAddr) -> io::Result<Simulated> {
    let view = cell.sensors[0].view.clone();
    let setup = gocator::Setup {
        rate_hz: Some(RATE_HZ),
        frames: view.traverse.profiles.into(),
        ..gocator::Setup::new(13_434, gocator::Surface::View(Box::new(view)))
    };
    // Control 3190, data 3196, health 3194 on a real one.
    let ports = [0, 6, 4].map(|above| match address.port() {
        0 => address,
        port => SocketAddr::new(address.ip(), port.saturating_add(above)),
    });
    let device = SimulatedGocator::start_on(ports, setup)?;
    let port = device.address().to_string();
    Ok(Simulated::Gocator(device, port))
}

fn start_cmm(cell: &DemoCell, address: SocketAddr) -> io::Result<Simulated> {
    let setup = ippdme::Setup::new(
        Arc::clone(&cell.part.made),
        cell.machine_from_part,
        TIP_RADIUS_MM,
    );
    let device = SimulatedCmm::start_on(address, setup)?;
    let port = device.address().to_string();
    Ok(Simulated::Cmm(device, port))
}

/// The tool passes over the demo's part, at 50 mm/s, as soon as somebody listens.
fn start_robot(address: SocketAddr, seed: u64, faults: &Faults) -> io::Result<Simulated> {
    let down = Pose::turn_about(DVec3::ZERO, DVec3::X, std::f64::consts::PI);
    let from = Pose::shift(DVec3::new(400.0, 100.0, 300.0)).after(down);
    let motion = Motion::straight(from, DVec3::Y * 150.0, 50.0);
    let setup = ur_rtde::Setup {
        faults: faults.clone(),
        ..ur_rtde::Setup::new(Arc::new(motion), seed)
    };
    SimulatedRobot::start(Wire::tcp(address)?, setup).map(Simulated::Robot)
}

fn start_usb(cell: &DemoCell, name: &str, folder: &Path) -> io::Result<Simulated> {
    let shown = |variables: [(&str, String); 2]| {
        let pairs = variables.map(|(name, value)| format!("{name}={value}"));
        pairs.join(" ")
    };
    if name == "usb-itn" {
        let tool = InputTool::new("70412345", vec![-1234, -1230, -1229, -1233]);
        let carrier = Carrier::start(folder, Socket::new(tool))?;
        let port = shown(carrier.environment());
        return Ok(Simulated::Usb(Usb::Itn(carrier), port));
    }
    let view = cell.sensors[0].view.clone();
    let setup = u3v::Setup {
        rate_hz: Some(RATE_HZ),
        blocks: view.traverse.profiles.into(),
        ..u3v::Setup::new("SN-0042", u3v::Surface::View(Box::new(view)))
    };
    let carrier = Carrier::start(folder, Socket::new(u3v::Profiler::new(setup)))?;
    let port = shown(carrier.environment());
    Ok(Simulated::Usb(Usb::U3v(carrier), port))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mistakes_are_told() {
        let tcp = Place::Tcp(SocketAddr::from(([127, 0, 0, 1], 0)));
        let unknown = start("toaster", &tcp, 1, "").unwrap_err().to_string();
        assert_eq!(
            unknown,
            "simulator: no device is called \"toaster\", expected one of open-profile, open-profile-right, grbl-probe, \
             optoncdt, rf60x, heidenhain-nd, mitutoyo, sylvac, keyence, gocator, ippdme, u3v-profiler, usb-itn, ur-rtde"
        );
        let fault = start("grbl-probe", &tcp, 1, "drop=x")
            .unwrap_err()
            .to_string();
        assert_eq!(
            fault,
            "faults: drop is \"x\", expected a probability from 0 to 1"
        );
        let nowhere = Place::Pty("/nonexistent/ttyX".into());
        let port = start("open-profile", &nowhere, 1, "")
            .unwrap_err()
            .to_string();
        assert!(
            port.starts_with("/nonexistent/ttyX: No such file"),
            "{port}"
        );
    }

    #[test]
    fn each_kind_starts() {
        let tcp = Place::Tcp(SocketAddr::from(([127, 0, 0, 1], 0)));
        let folder = std::env::temp_dir().join(format!("acies-sim-{}", std::process::id()));
        for kind in ALL {
            let usb = ["u3v-profiler", "usb-itn"].contains(&kind.name);
            if usb {
                let folder = folder.join(kind.name);
                std::fs::create_dir_all(&folder).unwrap();
                let device = start(kind.name, &Place::Usb(folder), 1, "").unwrap();
                assert!(device.port().starts_with("LD_PRELOAD="));
                let error = start(kind.name, &tcp, 1, "").unwrap_err().to_string();
                assert!(
                    error.ends_with("expected a folder for the USB device"),
                    "{error}"
                );
            } else {
                let device = start(kind.name, &tcp, 1, "").unwrap();
                assert!(device.port().starts_with("127.0.0.1:"));
            }
        }
        std::fs::remove_dir_all(folder).unwrap();
    }
}
