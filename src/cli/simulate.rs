//! `acies simulate DEVICE`: one simulated device on a pseudo-terminal or a socket.

use std::net::SocketAddr;
use std::path::PathBuf;

use acies_simulators::devices::{self, Place, StartError};
use anyhow::Context;

use super::{Failure, Status, print_line};

/// Plays one device of the demo's cell until it is interrupted, so that a host can be tried without hardware.
///
/// It speaks its real protocol, in real time, about the demo's part. The port is printed on standard output once it is there.
#[derive(Debug, clap::Args)]
#[command(after_help = AFTER)]
pub struct Simulate {
    /// Which device: open-profile, open-profile-right, grbl-probe, optoncdt, rf60x, heidenhain-nd, mitutoyo, sylvac, keyence, gocator,
    /// ippdme, u3v-profiler, usb-itn or ur-rtde.
    device: String,
    /// Path under which the pseudo-terminal appears.
    #[arg(long, value_name = "PATH", conflicts_with = "tcp")]
    port: Option<PathBuf>,
    /// Listen on this address instead, as in 127.0.0.1:7450.
    #[arg(long, value_name = "ADDRESS")]
    tcp: Option<SocketAddr>,
    /// Make a USB device in this new folder; what is printed goes before the command of the program that is to see it.
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["tcp", "port"])]
    usb: Option<PathBuf>,
    /// Seed of noise, place and faults.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// What goes wrong, as in "lose=1e-4,unplug-after=100,replug-ms=500".
    #[arg(long, default_value = "", value_name = "FAULTS")]
    faults: String,
}

const AFTER: &str =
    "Faults, separated by commas (P is a probability, N counts profiles or probing moves):
  lose=P lose-frame=P flip=P lie=P babble=P split lumps baud=N   on the wire
  drop=P duplicate=P jump=N:COUNTS                        profiles dropped or doubled, encoder jumps
  silent-after=N reboot-after=N unplug-after=N replug-ms=M
  no-contact damage-prb=N alarm reset-in-move=N           the probe's
  burst=P wrong-parity chatter=P sentinel=P overrun=P truncate=P near-wrap late-ms=M autostart refuse=N
  drift-ppm=X other-identity swap-bytes                   the serial sensors'
  or the name of a case, as in byte-loss or hot-unplug    all that belongs to it";

impl Simulate {
    /// Carries the command out.
    ///
    /// # Errors
    /// Wrong usage where device or faults are unknown; input or output where the port cannot be taken.
    pub fn run(self) -> Result<Status, Failure> {
        let default_port = || PathBuf::from(format!("tty-{}", self.device));
        if let Some(folder) = &self.usb {
            std::fs::create_dir(folder)
                .with_context(|| format!("{}: cannot be made", folder.display()))
                .map_err(Failure::Io)?;
        }
        let place = match (self.usb.clone(), self.tcp) {
            (Some(folder), _) => Place::Usb(folder),
            (_, Some(address)) => Place::Tcp(address),
            _ => Place::Pty(self.port.clone().unwrap_or_else(default_port)),
        };
        let device = devices::start(&self.device, &place, self.seed, &self.faults);
        let device = device.map_err(|error| match error {
            StartError::Port { .. } => Failure::Io(error.into()),
            _ => Failure::Usage(error.into()),
        })?;
        print_line(device.port())?;
        eprintln!(
            "{} plays on {} (stop with Ctrl-C)",
            self.device,
            device.port()
        );
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let runtime = runtime
            .context("the simulator's runtime")
            .map_err(Failure::Internal)?;
        runtime.block_on(super::interrupted());
        Ok(Status::Done)
    }
}
