//! The bytes of Gocator: commands and replies of the control channel, messages of the data and health channels.
//!
//! Source: LMI Gocator user manuals (2100, 2300 and 2500 series, firmware 4 to 6), chapter Protocols, "Gocator Protocol". All numbers are
//! little-endian.

use crate::error::DecodeError;

/// Most bytes in one data or health message. The widest profile sensors have about 4,000 points a line; this is a thousand such.
pub const MESSAGE_MAX: usize = 8 << 20;
/// Most bytes in one reply.
pub const REPLY_MAX: usize = 1 << 20;
/// Bytes before the body of a data message.
pub const HEADER: usize = 6;
/// Bytes of a reply before its payload.
pub const REPLY_HEADER: usize = 10;

/// Range or coordinate of a point where nothing was seen.
const INVALID: i16 = i16::MIN;

// ---- Control channel --------------------------------------------------------------------------------------------------

/// Identifiers of commands, in the manual's words.
pub mod id {
    /// Get Protocol Version.
    pub const PROTOCOL_VERSION: u16 = 0x4511;
    /// Get System Info.
    pub const SYSTEM_INFO: u16 = 0x4002;
    /// Start.
    pub const START: u16 = 0x100D;
    /// Stop.
    pub const STOP: u16 = 0x1001;
    /// Ping.
    pub const PING: u16 = 0x100E;
}

/// The name of a command in the manual.
pub fn command_name(id: u16) -> &'static str {
    match id {
        id::PROTOCOL_VERSION => "Get Protocol Version",
        id::SYSTEM_INFO => "Get System Info",
        id::START => "Start",
        id::STOP => "Stop",
        id::PING => "Ping",
        _ => "a command",
    }
}

/// A command: total length u32, id u16, payload.
pub fn command(id: u16, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + payload.len());
    bytes.extend(((HEADER + payload.len()) as u32).to_le_bytes());
    bytes.extend(id.to_le_bytes());
    bytes.extend(payload);
    bytes
}

/// A reply of the control channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply<'a> {
    /// That of the command.
    pub id: u16,
    /// 1 is done; see [`status_text`].
    pub status: i32,
    /// What follows.
    pub payload: &'a [u8],
}

/// The reply at the start of `bytes` and its length; `None` where it is not whole yet.
///
/// # Errors
/// A length that no reply has: what follows cannot be found.
pub fn reply(bytes: &[u8]) -> Result<Option<(Reply<'_>, usize)>, DecodeError> {
    let Some(length) = u32_at(bytes, 0) else {
        return Ok(None);
    };
    let length = bounded(length, "reply", REPLY_HEADER, REPLY_MAX)?;
    if bytes.len() < length {
        return Ok(None);
    }
    let reply = Reply {
        id: u16_at(bytes, 4).unwrap_or_default(),
        status: u32_at(bytes, 6).unwrap_or_default() as i32,
        payload: &bytes[REPLY_HEADER..length],
    };
    Ok(Some((reply, length)))
}

/// What a status of a reply means.
pub fn status_text(status: i32) -> &'static str {
    match status {
        1 => "done",
        0 => "it failed",
        -1000 => "the state of the sensor forbids it",
        -999 => "not found",
        -998 => "it does not know the command",
        -997 => "a parameter is wrong",
        -996 => "it does not support that",
        -992 => "its simulation buffer is empty",
        _ => "a status this program does not know",
    }
}

/// What a person can do about a status.
pub fn status_remedy(status: i32) -> &'static str {
    match status {
        -1000 => {
            "stop it from its web page, close other clients, check the laser's interlock, then retry"
        }
        -998 | -996 => "update the sensor's firmware or this program",
        _ => "look at the sensor's log on its web page, then retry",
    }
}

/// What Get System Info says of the sensor asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SensorInfo {
    /// Serial number.
    pub device_id: u32,
    /// Name of the model.
    pub model: String,
    /// Firmware version, most significant first.
    pub firmware: [u8; 4],
    /// -1 conflict, 0 ready, 1 running.
    pub state: i32,
}

/// Reads the payload of the reply to Get System Info.
///
/// # Errors
/// Fewer bytes than one sensor's information.
pub fn sensor_info(payload: &[u8]) -> Result<SensorInfo, DecodeError> {
    // Offsets of the manual count from the start of the reply, these from its payload.
    needs("Get System Info", payload, 48)?;
    let name = &payload[8..40];
    let name = &name[..name.iter().position(|&b| b == 0).unwrap_or(name.len())];
    Ok(SensorInfo {
        device_id: u32_at(payload, 0).unwrap_or_default(),
        model: String::from_utf8_lossy(name).trim().to_owned(),
        firmware: [payload[40], payload[41], payload[42], payload[43]],
        state: u32_at(payload, 44).unwrap_or_default() as i32,
    })
}

// ---- Data and health channels -----------------------------------------------------------------------------------------

/// One stamp: when and where a frame was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// Counts the frames.
    pub frame_index: u64,
    /// Device clock, us.
    pub timestamp_us: u64,
    /// Encoder, ticks.
    pub encoder: i64,
    /// Encoder at the last index pulse, ticks.
    pub encoder_at_z: i64,
    /// Bit 0 is the digital input.
    pub status: u64,
    /// Serial number of the sensor.
    pub serial: u32,
}

/// Bytes of a stamp that are read; its size field may say more.
const STAMP: usize = 44;

/// Stamps of a frame, one for each profile in the messages beside it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stamps<'a> {
    /// Which camera or sensor.
    pub source: u8,
    size: usize,
    bytes: &'a [u8],
}

impl Stamps<'_> {
    /// Every stamp.
    pub fn iter(&self) -> impl Iterator<Item = Stamp> + '_ {
        self.bytes.chunks_exact(self.size).map(|bytes| Stamp {
            frame_index: u64_at(bytes, 0),
            timestamp_us: u64_at(bytes, 8),
            encoder: u64_at(bytes, 16) as i64,
            encoder_at_z: u64_at(bytes, 24) as i64,
            status: u64_at(bytes, 32),
            serial: u32_at(bytes, 40).unwrap_or_default(),
        })
    }
}

/// How the points of a profile message are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Type 5, "profile point cloud": pairs of i16 x and z.
    PointCloud,
    /// Type 6, "uniform (resampled) profile": i16 z at equal steps of x.
    Uniform,
}

/// A message of profiles: `count` profiles of `width` points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profiles<'a> {
    /// How points are written.
    pub form: Form,
    /// Which camera or sensor.
    pub source: u8,
    /// Profiles in the message.
    pub count: usize,
    /// Points of each.
    pub width: usize,
    /// nm a count.
    pub x_scale_nm: u32,
    /// nm a count.
    pub z_scale_nm: u32,
    /// um.
    pub x_offset_um: i32,
    /// um.
    pub z_offset_um: i32,
    /// Exposure, ns.
    pub exposure_ns: u32,
    data: &'a [u8],
}

impl Profiles<'_> {
    /// Points of profile `index`, mm: x finite everywhere, z `NaN` where nothing was seen.
    ///
    /// A point cloud says no x of a point that was not seen: it gets that of the point before it, the first ones the x offset.
    pub fn points_mm(&self, index: usize) -> (Vec<f64>, Vec<f64>) {
        let [xs, zs] = [self.x_scale_nm, self.z_scale_nm].map(|nm| f64::from(nm) * 1e-6);
        let [x0, z0] = [self.x_offset_um, self.z_offset_um].map(|um| f64::from(um) * 1e-3);
        let z_of = |[low, high]: &[u8; 2]| {
            let raw = i16::from_le_bytes([*low, *high]);
            let z = z0 + f64::from(raw) * zs;
            if raw == INVALID { f64::NAN } else { z }
        };
        match self.form {
            Form::Uniform => {
                let row = self.row(index, 2 * self.width);
                let x = (0..self.width).map(|i| x0 + i as f64 * xs).collect();
                (x, row.as_chunks::<2>().0.iter().map(z_of).collect())
            }
            Form::PointCloud => {
                let row = self.row(index, 4 * self.width).as_chunks::<4>().0;
                let mut last = x0;
                // Filled in place: two growing lists cost more than the arithmetic.
                let (mut xs_mm, mut zs_mm) = (vec![0.0; row.len()], vec![0.0; row.len()]);
                for ((point, x_mm), z_mm) in row.iter().zip(&mut xs_mm).zip(&mut zs_mm) {
                    let x = i16::from_le_bytes([point[0], point[1]]);
                    let z = i16::from_le_bytes([point[2], point[3]]);
                    let seen = x != INVALID && z != INVALID;
                    last = if seen { x0 + f64::from(x) * xs } else { last };
                    *x_mm = last;
                    *z_mm = if seen {
                        z0 + f64::from(z) * zs
                    } else {
                        f64::NAN
                    };
                }
                (xs_mm, zs_mm)
            }
        }
    }

    fn row(&self, index: usize, length: usize) -> &[u8] {
        self.data
            .get(index * length..(index + 1) * length)
            .unwrap_or_default()
    }
}

/// A message of intensities, one byte a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intensities<'a> {
    /// Which camera or sensor.
    pub source: u8,
    /// Rows in the message.
    pub count: usize,
    /// Points of each.
    pub width: usize,
    data: &'a [u8],
}

impl Intensities<'_> {
    /// Row `index`.
    pub fn row(&self, index: usize) -> &[u8] {
        self.data
            .get(index * self.width..(index + 1) * self.width)
            .unwrap_or_default()
    }
}

/// One health indicator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Indicator {
    /// Which; the manual has a table.
    pub id: u32,
    /// Of several of a kind.
    pub instance: u32,
    /// Its meaning depends on the id.
    pub value: i64,
}

/// What the data and health channels carry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Content<'a> {
    /// Type 0: count and 16 bytes an indicator.
    Health(&'a [u8]),
    /// Type 1.
    Stamps(Stamps<'a>),
    /// Types 5 and 6.
    Profiles(Profiles<'a>),
    /// Type 7.
    Intensities(Intensities<'a>),
    /// Any other: measurements, surfaces, video. Its type.
    Other(u16),
}

/// A whole message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Message<'a> {
    /// It ends its group: all that belongs to one frame.
    pub last: bool,
    /// What it carries.
    pub content: Content<'a>,
}

/// Every indicator of a health message.
pub fn indicators(rows: &[u8]) -> impl Iterator<Item = Indicator> + '_ {
    rows.chunks_exact(16).map(|row| Indicator {
        id: u32_at(row, 0).unwrap_or_default(),
        instance: u32_at(row, 4).unwrap_or_default(),
        value: u64_at(row, 8) as i64,
    })
}

/// Reads one whole message, header and body.
///
/// # Errors
/// A body that is shorter than its own fields say. The next message begins all the same where this one's size says.
pub fn message(bytes: &[u8]) -> Result<Message<'_>, DecodeError> {
    needs("message", bytes, HEADER)?;
    let control = u16_at(bytes, 4).unwrap_or_default();
    let content = match control & 0x7FFF {
        0 => health(bytes)?,
        1 => stamps(bytes)?,
        5 => profiles(bytes, Form::PointCloud)?,
        6 => profiles(bytes, Form::Uniform)?,
        7 => intensities(bytes)?,
        other => Content::Other(other),
    };
    Ok(Message {
        last: control & 0x8000 != 0,
        content,
    })
}

/// Whether a message that cannot be read ends its group.
pub fn is_last(bytes: &[u8]) -> bool {
    u16_at(bytes, 4).is_some_and(|control| control & 0x8000 != 0)
}

fn health(bytes: &[u8]) -> Result<Content<'_>, DecodeError> {
    let rows = array("Health", bytes, 6, 14, 16, 1)?;
    Ok(Content::Health(rows))
}

fn stamps(bytes: &[u8]) -> Result<Content<'_>, DecodeError> {
    needs("Stamp", bytes, 14)?;
    let size = usize::from(u16_at(bytes, 10).unwrap_or_default());
    // The manual says 56 and lists fields of 52: what is needed is there, and more is passed over.
    if size < STAMP {
        return Err(DecodeError::TooShort {
            message: "Stamp",
            found: size,
            needed: STAMP,
        });
    }
    Ok(Content::Stamps(Stamps {
        source: bytes[12],
        size,
        bytes: array("Stamp", bytes, 6, 14, size, 1)?,
    }))
}

fn profiles(bytes: &[u8], form: Form) -> Result<Content<'_>, DecodeError> {
    let name = match form {
        Form::PointCloud => "Profile Point Cloud",
        Form::Uniform => "Uniform Profile",
    };
    let point = match form {
        Form::PointCloud => 4,
        Form::Uniform => 2,
    };
    needs(name, bytes, 37)?;
    let width = u32_at(bytes, 12).unwrap_or_default() as usize;
    let data = array(
        name,
        bytes,
        8,
        attributes_end(name, bytes, 29)?,
        point,
        width,
    )?;
    Ok(Content::Profiles(Profiles {
        form,
        source: bytes[32],
        count: u32_at(bytes, 8).unwrap_or_default() as usize,
        width,
        x_scale_nm: u32_at(bytes, 16).unwrap_or_default(),
        z_scale_nm: u32_at(bytes, 20).unwrap_or_default(),
        x_offset_um: u32_at(bytes, 24).unwrap_or_default() as i32,
        z_offset_um: u32_at(bytes, 28).unwrap_or_default() as i32,
        exposure_ns: u32_at(bytes, 33).unwrap_or_default(),
        data,
    }))
}

fn intensities(bytes: &[u8]) -> Result<Content<'_>, DecodeError> {
    const NAME: &str = "Profile Intensity";
    needs(NAME, bytes, 25)?;
    let width = u32_at(bytes, 12).unwrap_or_default() as usize;
    let data = array(NAME, bytes, 8, attributes_end(NAME, bytes, 17)?, 1, width)?;
    Ok(Content::Intensities(Intensities {
        source: bytes[24],
        count: u32_at(bytes, 8).unwrap_or_default() as usize,
        width,
        data,
    }))
}

/// Where the data begin: the size of the attributes counts from byte 8, and differs between chapters of the manual.
fn attributes_end(name: &'static str, bytes: &[u8], least: usize) -> Result<usize, DecodeError> {
    let size = usize::from(u16_at(bytes, 6).unwrap_or_default());
    if size < least {
        return Err(DecodeError::TooShort {
            message: name,
            found: size,
            needed: least,
        });
    }
    Ok(8 + size)
}

/// The bytes from `start` that hold as many items of `size * width` bytes as the u32 at `count_at` says; no more are looked at.
fn array<'a>(
    name: &'static str,
    bytes: &'a [u8],
    count_at: usize,
    start: usize,
    size: usize,
    width: usize,
) -> Result<&'a [u8], DecodeError> {
    let count = u32_at(bytes, count_at).unwrap_or_default() as usize;
    let needed = count
        .checked_mul(width)
        .and_then(|items| items.checked_mul(size))
        .and_then(|length| length.checked_add(start))
        .filter(|end| *end <= bytes.len());
    match needed {
        Some(end) if width > 0 => Ok(bytes.get(start..end).unwrap_or_default()),
        _ => Err(DecodeError::Field {
            message: name,
            field: "count or width",
            found: (count as u64).saturating_mul(width as u64),
            allowed: "as many as the message has bytes for",
        }),
    }
}

/// Finds the messages in a stream of bytes that comes in any pieces.
///
/// Holds at most one unfinished message of [`MESSAGE_MAX`] and what was read at once. There is no mark at which a message could be found
/// again: a size that cannot be ends the stream.
#[derive(Debug, Default)]
pub struct Decoder {
    held: Vec<u8>,
}

impl Decoder {
    /// Takes `bytes` and calls `each` with every whole message's bytes.
    ///
    /// # Errors
    /// A size that no message has. Nothing is held any more, and only a new connection helps.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(&[u8])) -> Result<(), DecodeError> {
        if self.held.is_empty() {
            let used = messages(bytes, &mut each)?;
            self.held.extend_from_slice(&bytes[used..]);
            return Ok(());
        }
        self.held.extend_from_slice(bytes);
        match messages(&self.held, &mut each) {
            Ok(used) => {
                self.held.drain(..used);
                Ok(())
            }
            Err(error) => {
                self.held.clear();
                Err(error)
            }
        }
    }

    /// Bytes of a message that is not whole yet.
    pub fn held_bytes(&self) -> usize {
        self.held.len()
    }
}

/// Calls `each` with every whole message at the start of `bytes`; the answer is how many bytes they have.
fn messages(bytes: &[u8], each: &mut impl FnMut(&[u8])) -> Result<usize, DecodeError> {
    let mut at = 0;
    while let Some(size) = u32_at(&bytes[at..], 0) {
        let size = bounded(size, "message", HEADER, MESSAGE_MAX)?;
        let Some(whole) = bytes.get(at..at + size) else {
            break;
        };
        each(whole);
        at += size;
    }
    Ok(at)
}

fn bounded(
    claimed: u32,
    message: &'static str,
    least: usize,
    limit: usize,
) -> Result<usize, DecodeError> {
    let length = claimed as usize;
    if length < least {
        return Err(DecodeError::TooShort {
            message,
            found: length,
            needed: least,
        });
    }
    if length > limit {
        return Err(DecodeError::TooLong {
            claimed: claimed.into(),
            limit,
        });
    }
    Ok(length)
}

fn needs(message: &'static str, bytes: &[u8], needed: usize) -> Result<(), DecodeError> {
    if bytes.len() < needed {
        return Err(DecodeError::TooShort {
            message,
            found: bytes.len(),
            needed,
        });
    }
    Ok(())
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    let eight = bytes.get(at..at + 8).and_then(|b| b.try_into().ok());
    eight.map_or(0, u64::from_le_bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|byte| u8::from_str_radix(byte, 16).expect("hex"))
            .collect()
    }

    #[test]
    fn vectors_of_the_control_channel() {
        assert_eq!(command(id::START, &[]), hex("06 00 00 00 0D 10"));
        assert_eq!(command(id::PROTOCOL_VERSION, &[]), hex("06 00 00 00 11 45"));
        let bytes = hex("0A 00 00 00 0D 10 01 00 00 00");
        let (reply, used) = reply(&bytes)
            .expect("a sound length")
            .expect("a whole reply");
        assert_eq!(
            (reply.id, reply.status, reply.payload.len(), used),
            (id::START, 1, 0, 10)
        );
    }

    /// A message of `width` points at the given attribute size, written field by field from the manual's table.
    fn uniform(attribute_size: u16, points: &[i16]) -> Vec<u8> {
        let mut bytes = vec![0; 4];
        bytes.extend(0x8006_u16.to_le_bytes());
        bytes.extend(attribute_size.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
        bytes.extend((points.len() as u32).to_le_bytes());
        bytes.extend(20_000_u32.to_le_bytes());
        bytes.extend(1_000_u32.to_le_bytes());
        bytes.extend((-10_000_i32).to_le_bytes());
        bytes.extend(5_000_i32.to_le_bytes());
        bytes.push(0);
        bytes.extend(80_000_u32.to_le_bytes());
        bytes.resize(8 + usize::from(attribute_size), 0);
        bytes.extend(points.iter().flat_map(|p| p.to_le_bytes()));
        let size = (bytes.len() as u32).to_le_bytes();
        bytes[..4].copy_from_slice(&size);
        bytes
    }

    #[test]
    fn both_attribute_sizes_of_the_manual_are_read() {
        for size in [32, 40, 57] {
            let bytes = uniform(size, &[0, i16::MIN, -1000]);
            let read = message(&bytes).expect("a profile");
            assert!(read.last);
            let Content::Profiles(profiles) = read.content else {
                panic!("{read:?}");
            };
            let (x, z) = profiles.points_mm(0);
            for (x, expected) in x.iter().zip([-10.0, -9.98, -9.96]) {
                assert!((x - expected).abs() < 1e-12, "{x}");
            }
            assert!(z[1].is_nan());
            assert!(
                (z[0] - 5.0).abs() < 1e-12 && (z[2] - 4.0).abs() < 1e-12,
                "{z:?}"
            );
        }
        let short = message(&uniform(28, &[0])).expect_err("too short");
        assert_eq!(short.to_string(), "Uniform Profile has 28 bytes, needs 29");
    }

    #[test]
    fn lying_counts_are_refused() {
        let mut bytes = uniform(40, &[1, 2, 3]);
        for lie in [4_u32, 0, u32::MAX] {
            bytes[12..16].copy_from_slice(&lie.to_le_bytes());
            let error = message(&bytes).expect_err("a lie").to_string();
            assert!(
                error.starts_with("count or width of Uniform Profile is "),
                "{error}"
            );
        }
    }

    #[test]
    fn split_at_every_byte() {
        let mut stream = uniform(32, &[1, 2, 3]);
        stream.extend(uniform(40, &[4; 40]));
        stream.extend(hex("06 00 00 00 0A 80"));
        for cut in 0..=stream.len() {
            let (mut decoder, mut sizes) = (Decoder::default(), Vec::new());
            for part in [&stream[..cut], &stream[cut..]] {
                let taken = decoder.take(part, |bytes| sizes.push(bytes.len()));
                taken.expect("sound sizes");
            }
            assert_eq!((sizes.len(), decoder.held_bytes()), (3, 0), "cut at {cut}");
        }
    }

    #[test]
    fn a_size_that_cannot_be_ends_the_stream() {
        let told = |size: u32| {
            let taken = Decoder::default().take(&size.to_le_bytes(), |_| ());
            taken.expect_err("a bad size").to_string()
        };
        assert_eq!(told(5), "message has 5 bytes, needs 6");
        assert_eq!(
            told(u32::MAX),
            "frame says 4294967295 bytes, at most 8388608 are allowed"
        );
        let error = reply(&u32::MAX.to_le_bytes()).expect_err("a bad length");
        assert_eq!(
            error.to_string(),
            "frame says 4294967295 bytes, at most 1048576 are allowed"
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(21),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_body_is_read_or_refused(
            kind in 0_u16..9,
            mut body in prop::collection::vec(prop_oneof![Just(0_u8), Just(1), any::<u8>()], 0..400),
        ) {
            let mut bytes = ((body.len() + HEADER) as u32).to_le_bytes().to_vec();
            bytes.extend(kind.to_le_bytes());
            bytes.append(&mut body);
            if let Ok(read) = message(&bytes) {
                match read.content {
                    Content::Profiles(profiles) => {
                        prop_assert!(profiles.count * profiles.width <= bytes.len());
                        for index in 0..=profiles.count {
                            let (x, z) = profiles.points_mm(index);
                            prop_assert!(x.iter().all(|x| x.is_finite()));
                            prop_assert!(index < profiles.count || z.is_empty());
                        }
                    }
                    Content::Stamps(stamps) => prop_assert!(stamps.iter().count() <= bytes.len()),
                    Content::Health(rows) => prop_assert!(indicators(rows).count() <= bytes.len()),
                    _ => {}
                }
            }
            let _ = reply(&bytes).map(|found| found.map(|(reply, _)| sensor_info(reply.payload)));
        }

        #[test]
        fn any_stream_is_held_within_bounds(bytes in prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>()], 0..3000)) {
            let mut decoder = Decoder::default();
            for part in bytes.chunks(97) {
                if decoder.take(part, |whole| { let _ = message(whole); }).is_err() {
                    break;
                }
                prop_assert!(decoder.held_bytes() <= bytes.len());
            }
        }
    }
}
