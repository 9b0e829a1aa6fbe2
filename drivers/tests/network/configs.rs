//! The example cells of network devices, each opened against its simulated device.

use std::path::Path;
use std::sync::Arc;

use acies_drivers::link::cable::Cable;
use acies_simulators::carried::Motion;
use acies_simulators::demo_cell::{DemoCell, TIP_RADIUS_MM};
use acies_simulators::gocator::{Setup, SimulatedGocator, Surface};
use acies_simulators::ippdme::{self, SimulatedCmm};
use acies_simulators::pose::Pose;
use acies_simulators::ur_rtde::{self, SimulatedRobot};
use acies_simulators::wire::Wire;
use glam::DVec3;

use crate::support::{setup, text};

/// Tables of the devices of a cell, without what is the cell's own.
fn devices(cell: &str) -> Vec<(String, toml::Table)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../configs/{cell}/cell.toml"));
    let read = std::fs::read_to_string(path).expect("an example cell");
    let table: toml::Table = read.parse().expect("TOML");
    let devices = table["device"].as_array().expect("devices");
    let own = ["name", "driver", "calibration", "tip", "touch", "carrier"];
    devices
        .iter()
        .map(|device| {
            let mut device = device.as_table().expect("a table").clone();
            let driver = device["driver"].as_str().expect("a word").to_owned();
            device.retain(|key, _| !own.contains(&key));
            (driver, device)
        })
        .collect()
}

fn identity(driver: &str, device: &toml::Table) -> String {
    let setup =
        setup(driver, &device.to_string()).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    match setup.open(&Cable) {
        Ok(instrument) => {
            let identity = instrument.identity();
            match identity.serial.is_empty() {
                true => identity.model.clone(),
                false => identity.serial.clone(),
            }
        }
        Err(error) => panic!("{}", text(&error)),
    }
}

#[test]
fn each_example_opens_its_device() {
    let sensor = SimulatedGocator::start(Setup::new(13_434, Surface::Wave(320))).expect("a sensor");
    let demo = DemoCell::new(1);
    let cmm = ippdme::Setup::new(
        Arc::clone(&demo.part.made),
        demo.machine_from_part,
        TIP_RADIUS_MM,
    );
    let cmm = SimulatedCmm::start(cmm).expect("a machine");
    let motion = Motion::straight(Pose::IDENTITY, DVec3::X, 1.0);
    let wire = Wire::tcp("127.0.0.1:0".parse().expect("an address")).expect("a socket");
    let robot = SimulatedRobot::start(wire, ur_rtde::Setup::new(Arc::new(motion), 1));
    let robot = robot.expect("a robot");
    let mut opened = Vec::new();
    for cell in ["gocator", "ippdme", "ur-rtde"] {
        for (driver, mut device) in devices(cell) {
            if driver == "gocator" {
                device.extend(sensor.keys().parse::<toml::Table>().expect("keys"));
            } else {
                let address = match driver.as_str() {
                    "ur-rtde" => robot.port().to_owned(),
                    _ => cmm.address().to_string(),
                };
                device.insert("address".into(), address.into());
            }
            opened.push(identity(&driver, &device));
        }
    }
    assert_eq!(
        opened,
        ["13434", "13434", "CartCMM", "e-Series or later", "13434"]
    );
}
