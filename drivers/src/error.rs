//! Errors of links, decoders and devices: where, what was seen, what was expected, what to do.
//!
//! The inner error never repeats what the outer one knows: [`LinkError`] and [`DecodeError`] speak of no port, [`DeviceError`]
//! names it once. Print the chain of sources at the edge of the program.

use std::io;

/// Why bytes do not pass.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// No such port or host.
    #[error("nothing of this name is there; check cable, power and the name")]
    NotFound,
    /// Another program holds it.
    #[error("another program has it open; close that program, then retry")]
    Busy,
    /// The system does not let this user open it.
    #[error(
        "this user may not open it; add the user to the group {group:?} (usermod -aG {group} USER) and log in again"
    )]
    Denied {
        /// The group that may.
        group: String,
    },
    /// A path that is not a serial port.
    #[error("it is not a serial port; give the path of one, as in \"/dev/ttyACM0\"")]
    NotSerial,
    /// A USB name that several ports bear.
    #[error("it may be any of {ports:?}; name one of these by `port`")]
    Ambiguous {
        /// The ports that match.
        ports: Vec<String>,
    },
    /// A USB device that several are.
    #[error("it may be any of {devices:?}; name one of these by `usb_serial`")]
    AmbiguousUsb {
        /// Where they are.
        devices: Vec<String>,
    },
    /// The system does not let this user open a USB device.
    #[error("this user may not open it; put the line {rule} into {file}, then plug it in again")]
    UsbDenied {
        /// Where the rule belongs.
        file: &'static str,
        /// The udev rule.
        rule: String,
    },
    /// USB cannot be used at all.
    #[error("USB cannot be used here ({reason}); check that /dev/bus/usb is there")]
    NoUsb {
        /// What libusb or the link says.
        reason: String,
    },
    /// A USB endpoint that halted.
    #[error("the device refuses the transfer (stall); reopen it")]
    Stalled,
    /// A USB device that sent more than was asked for.
    #[error("the device sent more than was asked for; reopen it")]
    Overflow,
    /// Nothing listens on the TCP port, or it has a client already.
    #[error("connection refused; check that the device listens there and has no other client")]
    Refused,
    /// No TCP connection in time.
    #[error("no connection within {deadline_s} s; check cable, power and the address")]
    Unreachable {
        /// How long was tried.
        deadline_s: f64,
    },
    /// The other end closed, or was unplugged.
    #[error("it is gone: closed or unplugged; plug it in again and reopen")]
    Gone,
    /// The other end takes no bytes.
    #[error("it takes no bytes: {written} of {length} written in time; check that the device runs")]
    Stuck {
        /// Bytes taken.
        written: usize,
        /// Bytes to write.
        length: usize,
    },
    /// A replayed driver wrote something else than was recorded.
    #[error("the host writes {found}, the recording has {recorded} at {at_s:.3} s")]
    Departed {
        /// What was written, in hex, shortened.
        found: String,
        /// What was recorded, in hex, shortened.
        recorded: String,
        /// Time in the recording, s.
        at_s: f64,
    },
    /// A recording that cannot be read or written.
    #[error("bad recording")]
    Recording(#[from] crate::link::recording::RecordingError),
    /// Something the system reported that has no name above.
    #[error("{action} failed")]
    Io {
        /// What was tried.
        action: &'static str,
        /// What the system said.
        #[source]
        source: io::Error,
    },
}

/// Why bytes from the device could not be understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The check of a frame's header.
    #[error("header check is {found:#010x}, the bytes give {computed:#010x}")]
    HeaderCheck {
        /// As received.
        found: u32,
        /// As computed.
        computed: u32,
    },
    /// The check of a whole frame.
    #[error(
        "frame check is {found:#010x}, the bytes give {computed:#010x} (payload of {length} bytes)"
    )]
    FrameCheck {
        /// As received.
        found: u32,
        /// As computed.
        computed: u32,
        /// Payload bytes.
        length: usize,
    },
    /// A frame longer than the protocol allows.
    #[error("frame says {claimed} bytes, at most {limit} are allowed")]
    TooLong {
        /// Bytes claimed.
        claimed: u64,
        /// Bytes allowed.
        limit: usize,
    },
    /// A protocol version this program does not know.
    #[error("protocol version {found}, this program knows {known}; update the one that is older")]
    Version {
        /// As received.
        found: u8,
        /// The one known.
        known: u8,
    },
    /// A payload that lacks fields.
    #[error("{message} has {found} bytes, needs {needed}")]
    TooShort {
        /// The message's name in the manual.
        message: &'static str,
        /// Bytes received.
        found: usize,
        /// Bytes needed.
        needed: usize,
    },
    /// A type of message this program does not know.
    #[error("message type {found:#04x} is not one a device sends")]
    UnknownType {
        /// As received.
        found: u8,
    },
    /// A field whose value the manual forbids.
    #[error("{field} of {message} is {found}, allowed is {allowed}")]
    Field {
        /// The message's name in the manual.
        message: &'static str,
        /// The field's name in the manual.
        field: &'static str,
        /// As received.
        found: u64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A text that is not UTF-8.
    #[error("text of {message} is not UTF-8")]
    Text {
        /// The message's name in the manual.
        message: &'static str,
    },
    /// A reply of another kind than the command's.
    #[error("{command} was answered by a message of another kind")]
    WrongReply {
        /// The command's name in the manual.
        command: &'static str,
    },
    /// A line that follows no form of the manual.
    #[error("the line {line:?} is none the controller may send")]
    Line {
        /// As received, shortened.
        line: String,
    },
}

/// Why a device does not deliver.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceError {
    /// The link does not pass bytes.
    #[error("{port}: cannot be used")]
    Link {
        /// Port or address.
        port: String,
        /// Why.
        #[source]
        source: LinkError,
    },
    /// No answer in time.
    #[error("{port}: no answer within {deadline_s} s; check power and cable, then retry")]
    Silent {
        /// Port or address.
        port: String,
        /// How long was waited.
        deadline_s: f64,
    },
    /// Bytes come, but none that make sense.
    #[error(
        "{port}: {bytes} bytes came within {deadline_s} s, but no answer to {command}; check `driver` and `baud`"
    )]
    Babble {
        /// Port or address.
        port: String,
        /// Bytes that came.
        bytes: u64,
        /// What was asked.
        command: &'static str,
        /// How long was waited.
        deadline_s: f64,
    },
    /// Another device than the configured one.
    #[error(
        "{port}: answers as {found:?}, the configuration expects {expected:?}; check which device is plugged in where"
    )]
    WrongDevice {
        /// Port or address.
        port: String,
        /// What answered.
        found: String,
        /// What was configured.
        expected: String,
    },
    /// A setting that the device does not take.
    #[error(
        "{port}: {key} = {wanted} is refused ({reason}), it stays {actual} of {minimum} to {maximum}; change `{key}`"
    )]
    Setting {
        /// Port or address.
        port: String,
        /// The key in the configuration.
        key: &'static str,
        /// As configured, in the device's unit.
        wanted: i64,
        /// The device's reason.
        reason: &'static str,
        /// As it stays.
        actual: i64,
        /// Least the device takes.
        minimum: i64,
        /// Most the device takes.
        maximum: i64,
    },
    /// A capability that the configuration needs and the device lacks.
    #[error("{port}: the device has no {capability}, which `{key}` needs; change `{key}`")]
    Lacks {
        /// Port or address.
        port: String,
        /// What it lacks.
        capability: &'static str,
        /// The key in the configuration.
        key: &'static str,
    },
    /// A command that the device refuses.
    #[error("{port}: {command} is refused: {reason}; {remedy}")]
    Refused {
        /// Port or address.
        port: String,
        /// The command's name in the manual.
        command: String,
        /// The device's reason.
        reason: String,
        /// What a person can do.
        remedy: &'static str,
    },
    /// The device ended the run by itself.
    #[error("{port}: the device ended the run: {reason}; {remedy}")]
    Ended {
        /// Port or address.
        port: String,
        /// The device's reason.
        reason: &'static str,
        /// What a person can do.
        remedy: &'static str,
    },
    /// The device started anew, so that run and settings are lost.
    #[error(
        "{port}: the device started anew (boot {found:#010x}, was {before:#010x}); check its supply, then reopen it"
    )]
    Restarted {
        /// Port or address.
        port: String,
        /// Boot number now.
        found: u32,
        /// Boot number when it was opened.
        before: u32,
    },
    /// The driver was asked for something that the state of the device forbids.
    #[error("{port}: {action} needs {needed}")]
    OutOfOrder {
        /// Port or address.
        port: String,
        /// What was asked.
        action: &'static str,
        /// What must hold first.
        needed: &'static str,
    },
    /// Bytes that cannot be understood.
    #[error("{port}: bad data from the device")]
    Decode {
        /// Port or address.
        port: String,
        /// Why.
        #[source]
        source: DecodeError,
    },
    /// The controller stopped with an alarm.
    #[error("{port}: alarm {code}: {meaning}; {remedy}")]
    Alarm {
        /// Port or address.
        port: String,
        /// The controller's number.
        code: u32,
        /// What it means, from the controller's manual.
        meaning: &'static str,
        /// What a person can do.
        remedy: &'static str,
    },
    /// The probe met nothing on its way.
    #[error(
        "{port}: no contact between {start_mm:?} and {target_mm:?} mm; check that the part lies there and the probe is wired, then reopen with `unlock_on_open = true` or send $X"
    )]
    NoContact {
        /// Port or address.
        port: String,
        /// Where the move began, mm, machine axes.
        start_mm: [f64; 3],
        /// Where it ended, mm, machine axes.
        target_mm: [f64; 3],
    },
    /// A contact away from the way that was commanded.
    #[error(
        "{port}: contact is reported at {contact_mm:?} mm, {off_mm:.3} mm off the way; check for lost steps and a changed work offset, then home and reopen it"
    )]
    OffWay {
        /// Port or address.
        port: String,
        /// As reported, mm, machine axes.
        contact_mm: [f64; 3],
        /// Distance from the way, mm.
        off_mm: f64,
    },
    /// A probe cycle that ended without a result.
    #[error(
        "{port}: the move ended, but no result came, nor was there one in $#; check the controller's firmware"
    )]
    NoResult {
        /// Port or address.
        port: String,
    },
    /// The controller started anew, so that its position is lost.
    #[error(
        "{port}: the controller reset itself; check its supply, home the machine, then reopen it"
    )]
    ControllerReset {
        /// Port or address.
        port: String,
    },
    /// A move that leaves the permitted box, or makes no sense.
    #[error("{port}: a move to {asked_mm:?} mm is not permitted, allowed is {allowed}")]
    Move {
        /// Port or address.
        port: String,
        /// Where to, mm, machine axes.
        asked_mm: [f64; 3],
        /// What is allowed.
        allowed: String,
    },
    /// A move that did not end in time; it was held.
    #[error(
        "{port}: the move did not end within {deadline_s} s and was held; look at the machine, then reopen it"
    )]
    Overdue {
        /// Port or address.
        port: String,
        /// How long was waited.
        deadline_s: f64,
    },
}

impl DeviceError {
    /// Reopening the same device may help, without a change by a person.
    pub fn may_pass(&self) -> bool {
        match self {
            DeviceError::Link { source, .. } => !matches!(
                source,
                LinkError::Denied { .. }
                    | LinkError::NotSerial
                    | LinkError::Ambiguous { .. }
                    | LinkError::AmbiguousUsb { .. }
                    | LinkError::UsbDenied { .. }
                    | LinkError::Departed { .. }
                    | LinkError::Recording(_)
            ),
            DeviceError::Silent { .. }
            | DeviceError::Babble { .. }
            | DeviceError::Restarted { .. }
            | DeviceError::Decode { .. } => true,
            _ => false,
        }
    }
}
