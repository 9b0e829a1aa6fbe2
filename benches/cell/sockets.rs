//! The demo's profilers over sockets, which carry more than pseudo-terminals and which a busy machine serves better.

use std::fs;
use std::net::SocketAddr;
use std::path::Path;

use acies_simulators::demo_cell::DemoCell;
use acies_simulators::grbl::SimulatedProbe;
use acies_simulators::open_profile::SimulatedProfiler;
use acies_simulators::wire::Wire;

/// The cell's devices, playing.
pub type Devices = ([SimulatedProfiler; 2], SimulatedProbe);

/// Plays the devices of the demo's cell in `folder`, whose `cell.toml` is given the profilers' addresses. The probe is played as fast as it
/// can on its pseudo-terminal: its moves in real time would only lengthen what comes before the scan.
pub fn play(mut demo: DemoCell, folder: &Path) -> Devices {
    let path = folder.join("cell.toml");
    let mut text = fs::read_to_string(&path).expect("the cell");
    let mut profiler = |which: usize, port: &str| {
        let wire = Wire::tcp(SocketAddr::from(([127, 0, 0, 1], 0))).expect("a port");
        let address = format!("address = {:?}", wire.name());
        text = text.replace(&format!("port = \"./dev/{port}\""), &address);
        demo.start_profiler(which, wire).expect("a profiler")
    };
    let profilers = [profiler(0, "ttyLEFT"), profiler(1, "ttyRIGHT")];
    fs::write(&path, text).expect("the cell");
    demo.options.paced = false;
    let wire = Wire::pty(&folder.join("dev/ttyPROBE")).expect("a pseudo-terminal");
    (profilers, demo.start_probe(wire).expect("the probe"))
}
