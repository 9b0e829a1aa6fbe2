//! What the cell tells about itself. The API sends these values as they are: keys may be added, none is renamed or removed.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Mode, State};
use crate::store::{Inspection, RecipeVersion, Usage};

/// Everything that is so at one moment.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Snapshot {
    /// Rises with every change.
    pub sequence: u64,
    /// Version of the program.
    pub version: String,
    /// The cell's name.
    pub cell: String,
    /// Whether the instruments are simulated.
    pub simulated: bool,
    /// The state of OPC 40100-1.
    pub state: State,
    /// Its number there.
    pub state_number: u8,
    /// How triggers are taken.
    pub mode: Mode,
    /// Why the cell is not ready, in one sentence; empty where it is.
    pub cause: String,
    /// What to do about it, in one sentence.
    pub advice: String,
    /// Whether a trigger would be taken now, be it into the queue.
    pub accepts: bool,
    /// What parts are judged by.
    pub recipe: Option<RecipeVersion>,
    /// What is wrong with the recipe that was to be activated last; empty where nothing is.
    pub recipe_problem: String,
    /// Every device, in the order of the configuration.
    pub devices: Vec<DeviceStatus>,
    /// The inspection that the devices work for.
    pub acquiring: Option<JobStatus>,
    /// The inspections whose results are being computed.
    pub computing: Vec<JobStatus>,
    /// Those that wait, the next one first.
    pub queue: Vec<JobStatus>,
    /// How many may wait.
    pub queue_limit: usize,
    /// The inspection that ended last, in whatever way.
    pub last: Option<Inspection>,
    /// What the store holds; null before it was first looked at.
    pub storage: Option<Usage>,
    /// Since when the daemon runs: RFC 3339, UTC.
    pub started: String,
}

/// What a device is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceState {
    /// Being opened for the first time.
    Connecting,
    /// Open, with the identity that was asked for.
    Ready,
    /// At work.
    Busy,
    /// Not there; it is tried again and again.
    Failed,
}

/// One device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct DeviceStatus {
    /// Its name in the configuration.
    pub name: String,
    /// `profiler`, `probe` or `robot`.
    pub kind: String,
    /// What it is doing.
    pub state: DeviceState,
    /// Maker, model, serial number and firmware, as it said when it was last open.
    pub identity: Option<String>,
    /// Why it failed, and what to do; empty where it did not.
    pub error: String,
    /// Since when it is in this state: RFC 3339, UTC.
    pub since: String,
    /// How often it was opened since the daemon started.
    pub opened: u64,
    /// How often it could not be opened or was lost.
    pub failures: u64,
    /// Profiles received in all runs.
    pub received: u64,
    /// Profiles lost in all runs, on the link or in the device.
    pub lost: u64,
    /// When it was calibrated; null where nobody says.
    pub calibrated: Option<String>,
    /// Until when that holds; null where it holds for ever or nobody says.
    pub calibrated_until: Option<String>,
    /// Whether that has passed.
    pub calibration_due: bool,
}

/// An inspection under way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobStatus {
    /// Its number.
    pub id: i64,
    /// Its part.
    pub part_serial: String,
    /// Its production order.
    pub order_number: String,
    /// What is being done: `waiting`, `touching`, `scanning`, `inspecting`.
    pub step: String,
    /// Touches done, while touching.
    pub touches: Option<[usize; 2]>,
    /// Profiles placed.
    pub profiles: u64,
    /// Share of the way, 0 to 1.
    pub share: f64,
    /// What went wrong so far; the job goes on.
    pub findings: Vec<String>,
}
