//! A touch probe on a GRBL 1.1 controller: text lines over serial, `G38.x` probing, alarms, reset.
//!
//! Motion takes no real time unless paced; what the tip meets is a scene.

mod controller;
mod gcode;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::{Arc, Mutex};

use glam::DVec3;

use crate::faults::Faults;
use crate::pose::Pose;
use crate::scene::{Scene, SurfaceId};
use crate::wire::{Runner, Wire, lock};

use controller::Controller;

/// What the probe touches and how well.
#[derive(Debug, Clone)]
pub struct Setup {
    /// What is there.
    pub scene: Arc<Scene>,
    /// Where it is.
    pub machine_from_scene: Pose,
    /// Of the tip's ball, mm.
    pub tip_radius_mm: f64,
    /// Standard deviation of the trigger along the motion, mm.
    pub repeatability_mm: f64,
    /// Of the trigger and the faults.
    pub seed: u64,
    /// Moves take their time.
    pub paced: bool,
    /// What goes wrong.
    pub faults: Faults,
}

/// One contact as it truly was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueTouch {
    /// Centre of the tip at the exact contact, mm, machine.
    pub contact: DVec3,
    /// What was latched: with the trigger's noise, before rounding to the report's 0.001 mm.
    pub latched: DVec3,
    /// Unit direction of travel.
    pub direction: DVec3,
    /// What was touched.
    pub surface: SurfaceId,
}

/// Everything the controller did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Truth {
    /// Contacts, in order.
    pub touches: Vec<TrueTouch>,
    /// Positioning moves that ran the tip into the part.
    pub crashes: u32,
    /// Resets, with the first start.
    pub starts: u32,
}

/// A running simulated probe; dropping it takes its port away.
#[derive(Debug)]
pub struct SimulatedProbe {
    runner: Runner,
    truth: Arc<Mutex<Truth>>,
}

impl SimulatedProbe {
    /// Starts a controller with the tip at the machine's origin, raised by 200 mm.
    ///
    /// # Errors
    /// When the system gives no thread or event.
    pub fn start(wire: Wire, setup: Setup) -> io::Result<SimulatedProbe> {
        let truth = Arc::new(Mutex::new(Truth::default()));
        let seen = truth.clone();
        let (faults, seed) = (setup.faults.clone(), setup.seed);
        let runner = Runner::start(wire, &faults, seed, |_| Controller::new(setup, seen))?;
        Ok(SimulatedProbe { runner, truth })
    }

    /// Where a host finds it: the path of the port, or `address:port`.
    pub fn port(&self) -> &str {
        self.runner.name()
    }

    /// Everything it did.
    pub fn truth(&self) -> Truth {
        lock(&self.truth).clone()
    }

    /// Pulls the cable out, as soon as what was sent is read.
    pub fn unplug(&self) {
        self.runner.plug(false);
    }

    /// Puts it back in.
    pub fn replug(&self) {
        self.runner.plug(true);
    }
}
