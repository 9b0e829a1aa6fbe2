//! The state machine of OPC 40100-1 (VisionStateMachineType), as a value that follows from what is so: no state can be entered
//! by mistake, because none is stored.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The states of OPC 40100-1: the first three, and those inside Operational.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Starting: the devices have not all answered yet, one way or the other.
    #[default]
    Preoperational,
    /// Taken out of operation by somebody.
    Halted,
    /// Something keeps the cell from measuring; the cause says what, and what to do.
    Error,
    /// Operational without a part to compare with.
    Initialized,
    /// A trigger starts at once.
    Ready,
    /// One part is being acquired.
    SingleExecution,
    /// Parts are acquired one after the other, without a trigger each.
    ContinuousExecution,
}

impl State {
    /// The number of the state in OPC 40100-1.
    pub fn number(self) -> u8 {
        match self {
            State::Preoperational => 1,
            State::Halted => 2,
            State::Error => 3,
            State::Initialized => 5,
            State::Ready => 6,
            State::SingleExecution => 7,
            State::ContinuousExecution => 8,
        }
    }
}

/// How triggers are taken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// One part a trigger.
    #[default]
    Single,
    /// One trigger, part after part until somebody stops it.
    Continuous,
}

/// What the state follows from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Circumstances {
    /// Somebody halted the cell.
    pub halted: bool,
    /// Devices that have neither been opened nor failed yet.
    pub connecting: usize,
    /// Devices that failed.
    pub failed: usize,
    /// The store cannot be written, or another fault that stays until it is reset.
    pub fault: bool,
    /// There is a part to compare with.
    pub prepared: bool,
    /// An acquisition runs.
    pub acquiring: bool,
    /// How triggers are taken.
    pub mode: Mode,
}

impl Circumstances {
    /// The state. An acquisition under way is shown whatever else is so: it will end with its one answer.
    pub(super) fn state(&self) -> State {
        match self {
            Self {
                acquiring: true,
                mode: Mode::Continuous,
                ..
            } => State::ContinuousExecution,
            Self {
                acquiring: true, ..
            } => State::SingleExecution,
            Self { halted: true, .. } => State::Halted,
            Self { fault: true, .. } => State::Error,
            Self { failed: 1.., .. } => State::Error,
            Self {
                connecting: 1.., ..
            } => State::Preoperational,
            Self {
                prepared: false, ..
            } => State::Initialized,
            Self { .. } => State::Ready,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_follows_from_what_is_so() {
        let ready = Circumstances {
            prepared: true,
            ..Circumstances::default()
        };
        assert_eq!(ready.state(), State::Ready);
        let cases = [
            (
                Circumstances {
                    connecting: 1,
                    ..ready.clone()
                },
                State::Preoperational,
            ),
            (
                Circumstances {
                    connecting: 1,
                    failed: 1,
                    ..ready.clone()
                },
                State::Error,
            ),
            (
                Circumstances {
                    prepared: false,
                    ..ready.clone()
                },
                State::Initialized,
            ),
            (
                Circumstances {
                    halted: true,
                    failed: 1,
                    ..ready.clone()
                },
                State::Halted,
            ),
            (
                Circumstances {
                    fault: true,
                    ..ready.clone()
                },
                State::Error,
            ),
            (
                Circumstances {
                    acquiring: true,
                    failed: 1,
                    ..ready.clone()
                },
                State::SingleExecution,
            ),
            (
                Circumstances {
                    acquiring: true,
                    mode: Mode::Continuous,
                    ..ready.clone()
                },
                State::ContinuousExecution,
            ),
        ];
        for (circumstances, state) in cases {
            assert_eq!(circumstances.state(), state, "{circumstances:?}");
        }
    }

    #[test]
    fn the_numbers_are_those_of_opc_40100() {
        // OPC 40100-1, VisionStateMachineType and VisionAutomaticModeStateMachineType, StateNumber.
        let numbers = [
            (State::Preoperational, 1),
            (State::Halted, 2),
            (State::Error, 3),
            (State::Initialized, 5),
            (State::Ready, 6),
            (State::SingleExecution, 7),
            (State::ContinuousExecution, 8),
        ];
        for (state, number) in numbers {
            assert_eq!(state.number(), number);
        }
    }
}
