//! Simulated devices by name, for the command line and for tests: each looks at the demo's cell.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

use crate::demo_cell::{DemoCell, DemoOptions};
use crate::faults::{FaultError, Faults};
use crate::gauge::{self, Dialect};
use crate::grbl::SimulatedProbe;
use crate::open_profile::SimulatedProfiler;
use crate::optoncdt;
use crate::point::SimulatedSensor;
use crate::rf60x;
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
pub const ALL: [Kind; 9] = [
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
];

/// Where a device is to appear.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// A pseudo-terminal under this path.
    Pty(PathBuf),
    /// A listening socket; port 0 takes any that is free.
    Tcp(SocketAddr),
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
}

impl Simulated {
    /// Where a host finds it: the path of the port, or `address:port`.
    pub fn port(&self) -> &str {
        match self {
            Simulated::Profiler(profiler) => profiler.port(),
            Simulated::Probe(probe) => probe.port(),
            Simulated::Sensor(sensor) => sensor.port(),
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
    let wire = match place {
        Place::Pty(path) => Wire::pty(path),
        Place::Tcp(address) => Wire::tcp(*address),
    };
    let port = match place {
        Place::Pty(path) => path.display().to_string(),
        Place::Tcp(address) => address.to_string(),
    };
    let gauge = |dialect, channels, wire| {
        let setup = gauge::Setup {
            channels,
            faults: of_sensor.clone(),
            ..gauge::Setup::new(dialect, seed)
        };
        gauge::start(wire, setup).map(Simulated::Sensor)
    };
    let started = wire.and_then(|wire| match name {
        "optoncdt" => {
            let mut setup = optoncdt::Setup::new("SIM-1420", seed);
            setup.faults.clone_from(&of_sensor);
            optoncdt::start(wire, setup).map(Simulated::Sensor)
        }
        "rf60x" => {
            let mut setup = rf60x::Setup::new(&[17_185, 17_186], seed);
            setup.faults.clone_from(&of_sensor);
            rf60x::start(wire, setup).map(Simulated::Sensor)
        }
        "heidenhain-nd" => gauge(Dialect::HeidenhainNd, 1, wire),
        "mitutoyo" => gauge(Dialect::Mitutoyo, 2, wire),
        "sylvac" => gauge(Dialect::Sylvac, 1, wire),
        "keyence" => gauge(Dialect::Keyence, 2, wire),
        "grbl-probe" => cell.start_probe(wire).map(Simulated::Probe),
        "open-profile-right" => cell.start_profiler(1, wire).map(Simulated::Profiler),
        _ => cell.start_profiler(0, wire).map(Simulated::Profiler),
    });
    started.map_err(|source| StartError::Port { port, source })
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
             optoncdt, rf60x, heidenhain-nd, mitutoyo, sylvac, keyence"
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
        for kind in ALL {
            let device = start(kind.name, &tcp, 1, "").unwrap();
            assert!(device.port().starts_with("127.0.0.1:"));
        }
    }
}
