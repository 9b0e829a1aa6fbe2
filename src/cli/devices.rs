//! `acies devices`: what is attached, who may open it, and why not.

use super::{Failure, Status};

/// Lists serial ports and USB devices, whether this user may open them, and what to do where not.
#[derive(Debug, clap::Args)]
pub struct Devices {
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Devices {
    /// Carries the command out.
    ///
    /// # Errors
    /// When standard output cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let _ = self.json;
        Ok(Status::Done)
    }
}
