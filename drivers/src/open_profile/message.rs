//! Messages of the open-profile protocol, and the conversion of its profiles.
//!
//! Source: `drivers/open-profile.md`, version 1, sections 3 to 6. Names are the document's.

use std::time::Instant;

use super::frame::{self, Frame};
use crate::capture::Profile;
use crate::error::DecodeError;

/// What the host sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Asks who the device is.
    Hello,
    /// Changes a setting.
    Set {
        /// Which.
        key: Key,
        /// To what, in the key's unit.
        value: i64,
    },
    /// Reads a setting.
    Get {
        /// Which.
        key: Key,
    },
    /// Starts a run.
    Start {
        /// Its number.
        run: u32,
        /// Profiles to send; 0 is until STOP.
        count: u32,
        /// Longest time between two KEEPALIVE, ms.
        keepalive_ms: u32,
    },
    /// Ends the run.
    Stop,
    /// The host is there.
    Keepalive {
        /// Host time, ns, of any origin.
        host_time_ns: u64,
    },
}

impl Command {
    /// Its name in the document.
    pub fn name(self) -> &'static str {
        match self {
            Command::Hello => "HELLO",
            Command::Set { .. } => "SET",
            Command::Get { .. } => "GET",
            Command::Start { .. } => "START",
            Command::Stop => "STOP",
            Command::Keepalive { .. } => "KEEPALIVE",
        }
    }

    /// The whole frame of this command.
    pub fn encode(self, id: u32) -> Vec<u8> {
        let mut payload = Vec::with_capacity(12);
        let kind = match self {
            Command::Hello => 0x01,
            Command::Set { key, value } => {
                payload.extend((key as u16).to_le_bytes());
                payload.extend(value.to_le_bytes());
                0x02
            }
            Command::Get { key } => {
                payload.extend((key as u16).to_le_bytes());
                0x03
            }
            Command::Start {
                run,
                count,
                keepalive_ms,
            } => {
                for field in [run, count, keepalive_ms] {
                    payload.extend(field.to_le_bytes());
                }
                0x04
            }
            Command::Stop => 0x05,
            Command::Keepalive { host_time_ns } => {
                payload.extend(host_time_ns.to_le_bytes());
                0x06
            }
        };
        frame::encode(kind, id, &payload)
    }
}

/// Settings of section 5.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum Key {
    /// mHz.
    Rate = 1,
    /// ns.
    Exposure = 2,
    /// 0 time, 1 encoder, 2 external.
    Trigger = 3,
    /// Counts between profiles.
    EncoderStep = 4,
    /// Points in a profile.
    Columns = 5,
    /// Thousandths of full power.
    LaserPower = 6,
    /// Thousandths of a degree Celsius.
    Temperature = 7,
}

/// What the device sends.
#[derive(Debug, Clone, PartialEq)]
pub enum Message<'a> {
    /// One laser line.
    Profile(RawProfile<'a>),
    /// Anything else.
    Reply(Reply),
}

/// What the device sends, profiles apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// Reply to HELLO.
    Identity(Identity),
    /// Reply to SET and GET.
    Value(Value),
    /// Reply to START.
    Started {
        /// Section 3.
        status: u16,
        /// The run's number.
        run: u32,
        /// The device's boot number.
        boot: u32,
    },
    /// Reply to STOP, or the end of a run.
    Stopped(Stopped),
    /// Reply to KEEPALIVE.
    Alive {
        /// The device's boot number.
        boot: u32,
        /// Section 6.
        flags: u16,
    },
    /// Any command, refused.
    Refused {
        /// Section 3.
        status: u16,
        /// For people.
        text: String,
    },
}

/// IDENTITY, section 4.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Differs after every start.
    pub boot: u32,
    /// Most points in a profile.
    pub columns_max: u32,
    /// mHz.
    pub rate_max: u32,
    /// Bits of section 4.
    pub capabilities: u32,
    /// z of the near end of the range, um.
    pub near_um: i32,
    /// z of the far end, um.
    pub far_um: i32,
    /// Width in the middle of the range, um.
    pub width_um: u32,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Firmware.
    pub firmware: String,
}

impl Identity {
    /// It has an encoder.
    pub fn has_encoder(&self) -> bool {
        self.capabilities & 1 != 0
    }
    /// Its laser can be switched.
    pub fn has_laser_switch(&self) -> bool {
        self.capabilities & 1 << 4 != 0
    }
}

/// VALUE, section 5.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Value {
    /// Section 3.
    pub status: u16,
    /// Which setting.
    pub key: u16,
    /// What the device really took.
    pub value: i64,
    /// Least it takes.
    pub minimum: i64,
    /// Most it takes.
    pub maximum: i64,
}

/// STOPPED, section 7.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stopped {
    /// Why.
    pub reason: u16,
    /// Which run.
    pub run: u32,
    /// Profiles sent in it.
    pub sent: u32,
    /// Profiles taken but not sent.
    pub dropped: u32,
}

/// PROFILE, section 6, its samples still in bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct RawProfile<'a> {
    /// Counts from 0 in every run.
    pub sequence: u32,
    /// That of START.
    pub run: u32,
    /// The device's boot number.
    pub boot: u32,
    /// ns since the device started, at the centre of the exposure.
    pub device_time_ns: u64,
    /// Counts at the centre of the exposure.
    pub encoder: i64,
    /// Profiles of this run that the device took but could not send.
    pub dropped: u32,
    /// Bits of section 6.
    pub flags: u16,
    columns: usize,
    wide: bool,
    x_axis: Axis,
    z_axis: Axis,
    z: &'a [u8],
    /// Empty where x is implicit.
    x: &'a [u8],
    /// Empty where there is none.
    intensity: &'a [u8],
}

/// nm = offset + scale * sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Axis {
    scale_nm: u32,
    offset_nm: i64,
}

impl Axis {
    /// mm of one sample: the rounded quotient of exact nanometres, so that 100002000 nm are the number written 100.002. Exact
    /// while offset and product stay below 2^53 nm, 9 km.
    fn mm(self, sample: i32) -> f64 {
        (self.offset_nm as f64 + f64::from(self.scale_nm) * f64::from(sample)) / 1e6
    }
}

/// Bits of `flags` in PROFILE and ALIVE.
pub mod flag {
    /// Some column was saturated.
    pub const SATURATED: u16 = 1 << 1;
    /// A trigger came too fast.
    pub const TRIGGER_TOO_FAST: u16 = 1 << 3;
}

impl RawProfile<'_> {
    /// The profile in mm; `has_encoder` says whether the device's encoder field means anything.
    pub fn capture(&self, has_encoder: bool, host_time: Instant) -> Profile {
        Profile {
            sequence: self.sequence,
            boot: self.boot,
            device_time_ns: self.device_time_ns,
            encoder: has_encoder.then_some(self.encoder),
            host_time,
            dropped: self.dropped,
            saturated: self.flags & flag::SATURATED != 0,
            x_mm: self.x_mm(),
            z_mm: samples(self.z, self.wide, self.z_axis, Some(f64::NAN)),
            intensity: self
                .intensity
                .chunks_exact(2)
                .map(|b| u16::from_le_bytes([b[0], b[1]]))
                .collect(),
        }
    }

    fn x_mm(&self) -> Vec<f64> {
        if self.x.is_empty() {
            (0..self.columns as i32)
                .map(|i| self.x_axis.mm(i))
                .collect()
        } else {
            samples(self.x, self.wide, self.x_axis, None)
        }
    }
}

/// Samples in mm; the most negative one becomes `nothing`, where given.
fn samples(bytes: &[u8], wide: bool, axis: Axis, nothing: Option<f64>) -> Vec<f64> {
    let convert = |sample: i32, least: i32| match nothing {
        Some(value) if sample == least => value,
        _ => axis.mm(sample),
    };
    if wide {
        bytes
            .chunks_exact(4)
            .map(|b| convert(i32::from_le_bytes([b[0], b[1], b[2], b[3]]), i32::MIN))
            .collect()
    } else {
        bytes
            .chunks_exact(2)
            .map(|b| {
                let sample = i16::from_le_bytes([b[0], b[1]]);
                convert(sample.into(), i16::MIN.into())
            })
            .collect()
    }
}

/// What a frame says.
///
/// # Errors
/// [`DecodeError::UnknownType`], or a payload too short or with a field out of its range.
pub fn message<'a>(frame: &Frame<'a>) -> Result<Message<'a>, DecodeError> {
    let mut fields = Fields {
        message: name(frame.kind)?,
        payload: frame.payload,
        at: 0,
    };
    if frame.kind == PROFILE {
        return profile(&mut fields, frame.id).map(Message::Profile);
    }
    reply(&mut fields, frame.kind).map(Message::Reply)
}

const PROFILE: u8 = 0x90;

fn reply(fields: &mut Fields<'_>, kind: u8) -> Result<Reply, DecodeError> {
    Ok(match kind {
        0x81 => Reply::Identity(identity(fields)?),
        0x82 => Reply::Value(Value {
            status: fields.u16()?,
            key: fields.u16()?,
            value: fields.i64()?,
            minimum: fields.i64()?,
            maximum: fields.i64()?,
        }),
        0x84 => Reply::Started {
            status: fields.u16()?,
            run: fields.u32()?,
            boot: fields.u32()?,
        },
        0x85 => Reply::Stopped(Stopped {
            reason: fields.u16()?,
            run: fields.u32()?,
            sent: fields.u32()?,
            dropped: fields.u32()?,
        }),
        0x86 => {
            fields.take(16)?;
            Reply::Alive {
                boot: fields.u32()?,
                flags: fields.u16()?,
            }
        }
        _ => {
            let status = fields.u16()?;
            let length = fields.u16()?.into();
            Reply::Refused {
                status,
                text: fields.text(length)?,
            }
        }
    })
}

/// The document's name of a message to the host.
fn name(kind: u8) -> Result<&'static str, DecodeError> {
    Ok(match kind {
        0x81 => "IDENTITY",
        0x82 => "VALUE",
        0x84 => "STARTED",
        0x85 => "STOPPED",
        0x86 => "ALIVE",
        0x90 => "PROFILE",
        0x9F => "REFUSED",
        found => return Err(DecodeError::UnknownType { found }),
    })
}

fn identity(fields: &mut Fields<'_>) -> Result<Identity, DecodeError> {
    let boot = fields.u32()?;
    let columns_max = fields.u32()?;
    let rate_max = fields.u32()?;
    let capabilities = fields.u32()?;
    let near_um = fields.i32()?;
    let far_um = fields.i32()?;
    let width_um = fields.u32()?;
    fields.take(4)?;
    let mut text = || {
        let length = fields.take(1)?[0].into();
        fields.text(length)
    };
    Ok(Identity {
        boot,
        columns_max,
        rate_max,
        capabilities,
        near_um,
        far_um,
        width_um,
        vendor: text()?,
        model: text()?,
        serial: text()?,
        firmware: text()?,
    })
}

/// Least length of the header of a profile.
const PROFILE_HEADER: usize = 60;

fn profile<'a>(fields: &mut Fields<'a>, sequence: u32) -> Result<RawProfile<'a>, DecodeError> {
    let header_length = usize::from(fields.u16()?);
    if header_length < PROFILE_HEADER {
        return Err(DecodeError::Field {
            message: fields.message,
            field: "header_length",
            found: header_length as u64,
            allowed: "60 or more",
        });
    }
    let columns = usize::from(fields.u16()?);
    let run = fields.u32()?;
    let boot = fields.u32()?;
    let device_time_ns = fields.u64()?;
    let encoder = fields.i64()?;
    let dropped = fields.u32()?;
    let flags = fields.u16()?;
    let format = fields.u16()?;
    let x_axis = fields.axis()?;
    let z_axis = fields.axis()?;
    fields.take(header_length - fields.at)?;

    let [explicit_x, has_intensity, wide] = [0, 1, 2].map(|bit| format >> bit & 1 != 0);
    let size = columns * if wide { 4 } else { 2 };
    Ok(RawProfile {
        sequence,
        run,
        boot,
        device_time_ns,
        encoder,
        dropped,
        flags,
        columns,
        wide,
        x_axis,
        z_axis,
        z: fields.take(size)?,
        x: fields.take(if explicit_x { size } else { 0 })?,
        intensity: fields.take(if has_intensity { 2 * columns } else { 0 })?,
    })
}

/// Reads fields one behind the other, never past the payload's end.
struct Fields<'a> {
    message: &'static str,
    payload: &'a [u8],
    at: usize,
}

impl<'a> Fields<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8], DecodeError> {
        let end = self.at + n;
        let bytes = self
            .payload
            .get(self.at..end)
            .ok_or(DecodeError::TooShort {
                message: self.message,
                found: self.payload.len(),
                needed: end,
            })?;
        self.at = end;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    fn u16(&mut self) -> Result<u16, DecodeError> {
        self.array().map(u16::from_le_bytes)
    }
    fn u32(&mut self) -> Result<u32, DecodeError> {
        self.array().map(u32::from_le_bytes)
    }
    fn i32(&mut self) -> Result<i32, DecodeError> {
        self.array().map(i32::from_le_bytes)
    }
    fn u64(&mut self) -> Result<u64, DecodeError> {
        self.array().map(u64::from_le_bytes)
    }
    fn i64(&mut self) -> Result<i64, DecodeError> {
        self.array().map(i64::from_le_bytes)
    }

    fn axis(&mut self) -> Result<Axis, DecodeError> {
        Ok(Axis {
            scale_nm: self.u32()?,
            offset_nm: self.i64()?,
        })
    }

    fn text(&mut self, length: usize) -> Result<String, DecodeError> {
        let message = self.message;
        let bytes = self.take(length)?;
        let text = std::str::from_utf8(bytes).map_err(|_| DecodeError::Text { message })?;
        Ok(text.to_owned())
    }
}

/// What a status number means, for people.
pub fn status_text(status: u16) -> &'static str {
    match status {
        0 => "done",
        1 => "unknown key",
        2 => "value out of range",
        3 => "read-only",
        4 => "not while streaming",
        5 => "unknown command",
        6 => "payload too short",
        7 => "interlock open",
        8 => "hardware fault",
        _ => "a status this program does not know",
    }
}

#[cfg(test)]
mod tests {
    use super::super::frame::{Step, examples, step};
    use super::*;

    fn example(name: &str) -> Vec<u8> {
        let found = examples().into_iter().find(|(n, _)| *n == name);
        found.expect("an example of that name").1
    }

    fn frame(bytes: &[u8]) -> Frame<'_> {
        match step(bytes) {
            Step::Frame(frame, _) => frame,
            other => panic!("{other:?}"),
        }
    }

    fn reply(name: &str) -> (u32, Reply) {
        let bytes = example(name);
        let frame = frame(&bytes);
        match message(&frame) {
            Ok(Message::Reply(reply)) => (frame.id, reply),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn commands_are_the_documents_bytes() {
        let set_rate = Command::Set {
            key: Key::Rate,
            value: 500_000,
        };
        let start = Command::Start {
            run: 7,
            count: 0,
            keepalive_ms: 500,
        };
        let keepalive = Command::Keepalive {
            host_time_ns: 1_000_000,
        };
        assert_eq!(Command::Hello.encode(1), example("hello"));
        assert_eq!(set_rate.encode(2), example("set-rate"));
        assert_eq!(start.encode(4), example("start"));
        assert_eq!(keepalive.encode(5), example("keepalive"));
        assert_eq!(Command::Stop.encode(6), example("stop"));
    }

    #[test]
    fn replies_of_the_document() {
        let identity = Identity {
            boot: 0xC0FF_EE01,
            columns_max: 640,
            rate_max: 2_000_000,
            capabilities: 0b1_0111,
            near_um: 60_000,
            far_um: 140_000,
            width_um: 90_000,
            vendor: "Acies".into(),
            model: "open-1".into(),
            serial: "P-0042".into(),
            firmware: "1.0.0".into(),
        };
        assert!(identity.has_encoder() && identity.has_laser_switch());
        assert_eq!(reply("identity"), (1, Reply::Identity(identity)));
        let rate = Value {
            status: 0,
            key: 1,
            value: 500_000,
            minimum: 1000,
            maximum: 2_000_000,
        };
        assert_eq!(reply("value-rate"), (2, Reply::Value(rate)));
        let columns = Value {
            status: 2,
            key: 5,
            value: 640,
            minimum: 1,
            maximum: 640,
        };
        assert_eq!(reply("set-refused"), (3, Reply::Value(columns)));
        let started = Reply::Started {
            status: 0,
            run: 7,
            boot: 0xC0FF_EE01,
        };
        assert_eq!(reply("started"), (4, started));
        let alive = Reply::Alive {
            boot: 0xC0FF_EE01,
            flags: 1,
        };
        assert_eq!(reply("alive"), (5, alive));
        let stopped = Stopped {
            reason: 0,
            run: 7,
            sent: 2,
            dropped: 3,
        };
        assert_eq!(reply("stopped"), (6, Reply::Stopped(stopped)));
        let refused = Reply::Refused {
            status: 5,
            text: "type 0x42?".into(),
        };
        assert_eq!(reply("refused"), (9, refused));
    }

    fn capture(name: &str) -> (u32, Profile) {
        let bytes = example(name);
        let host_time = Instant::now();
        match message(&frame(&bytes)) {
            Ok(Message::Profile(raw)) => (raw.run, raw.capture(true, host_time)),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn profiles_of_the_document() {
        let (run, profile) = capture("profile-implicit");
        assert_eq!((run, profile.sequence, profile.boot), (7, 0, 0xC0FF_EE01));
        assert_eq!(profile.device_time_ns, 1_500_000);
        assert_eq!((profile.encoder, profile.dropped), (Some(-3), 0));
        assert_eq!(profile.x_mm, [-15.0, -5.0, 5.0, 15.0]);
        assert_eq!(profile.z_mm[..2], [100.0, 100.002]);
        assert!(profile.z_mm[2].is_nan() && !profile.saturated);
        assert_eq!(profile.z_mm[3], 99.998);
        assert!(profile.intensity.is_empty());

        let (_, profile) = capture("profile-explicit");
        assert_eq!((profile.sequence, profile.dropped), (1, 3));
        assert_eq!(profile.x_mm, [-1.25, 1.25]);
        assert_eq!(profile.z_mm, [80.5, 80.75]);
        assert_eq!(profile.intensity, [1000, 65_535]);
        assert_eq!(profile.encoder, Some(400));
        assert!(profile.saturated);
    }

    #[test]
    fn a_profile_without_an_encoder_has_none() {
        let bytes = example("profile-implicit");
        let Ok(Message::Profile(raw)) = message(&frame(&bytes)) else {
            panic!("no profile");
        };
        assert_eq!(raw.capture(false, Instant::now()).encoder, None);
    }

    fn told(kind: u8, payload: &[u8]) -> String {
        let frame = Frame {
            kind,
            id: 0,
            payload,
        };
        message(&frame).expect_err("a bad payload").to_string()
    }

    #[test]
    fn every_payload_cut_short_is_refused_and_a_longer_one_taken() {
        for (name, bytes) in examples() {
            let whole = frame(&bytes);
            if whole.kind < 0x80 {
                assert!(message(&whole).is_err(), "{name} is not for the host");
                continue;
            }
            for length in 0..whole.payload.len() {
                let payload = &whole.payload[..length];
                let cut = Frame { payload, ..whole };
                let error = message(&cut).expect_err(name);
                assert!(
                    matches!(error, DecodeError::TooShort { found, needed, .. } if found == length && needed > length),
                    "{name} cut to {length}: {error}"
                );
            }
            let mut longer = whole.payload.to_vec();
            longer.extend([0xEE; 9]);
            let payload = longer.as_slice();
            assert_eq!(message(&Frame { payload, ..whole }), message(&whole));
        }
    }

    #[test]
    fn errors_say_what_was_seen() {
        assert_eq!(
            told(0x42, &[]),
            "message type 0x42 is not one a device sends"
        );
        assert_eq!(told(0x84, &[0; 5]), "STARTED has 5 bytes, needs 6");
        assert_eq!(
            told(0x90, &[59, 0, 0, 0]),
            "header_length of PROFILE is 59, allowed is 60 or more"
        );
        assert_eq!(
            told(0x9F, &[5, 0, 1, 0, 0xFF]),
            "text of REFUSED is not UTF-8"
        );
        // 65535 columns of all three kinds do not fit in any frame.
        let mut profile = vec![0; 60];
        profile[..4].copy_from_slice(&[60, 0, 0xFF, 0xFF]);
        profile[34] = 7;
        assert_eq!(told(0x90, &profile), "PROFILE has 60 bytes, needs 262200");
    }

    #[test]
    fn a_longer_profile_header_is_skipped() {
        let bytes = example("profile-implicit");
        let whole = frame(&bytes);
        let mut payload = whole.payload.to_vec();
        payload[0] = 64;
        payload.splice(60..60, [0xEE; 4]);
        let longer = Frame {
            payload: &payload,
            ..whole
        };
        assert_eq!(message(&longer), message(&whole));
    }
}
