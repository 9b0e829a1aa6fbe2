//! The control channel of USB3 Vision: GenCP commands and acknowledgements, and memory that is read and written by them.
//!
//! Source: USB3 Vision 1.0 and GenCP 1.0 as read by `aravis` and `cameleon`. All numbers are little-endian.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::usb::UsbLink;

/// "U3VC".
const MAGIC: u32 = 0x4356_3355;
/// Bytes before the payload.
pub const HEADER: usize = 12;
/// Bytes of an acknowledgement that are taken at most, whatever the device says it can send.
pub const ACK_MAX: usize = 64 << 10;
/// Flag of a command: an acknowledgement is wanted.
const REQUEST_ACK: u16 = 1 << 14;
/// How often a command is sent before the device counts as silent.
const TRIES: u32 = 3;
/// Longest wait that a device may ask for at once by a pending acknowledgement, and in all.
const PENDING_MAX: Duration = Duration::from_secs(30);
/// Answers to others that are passed over before the right one.
const STRAY: u32 = 64;

/// Numbers of commands; an acknowledgement has the next one.
pub mod command {
    /// ReadMem.
    pub const READ: u16 = 0x0800;
    /// WriteMem.
    pub const WRITE: u16 = 0x0802;
    /// PendingAck.
    pub const PENDING_ACK: u16 = 0x0805;
}

/// A command as bytes.
pub fn encode(command: u16, id: u16, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + payload.len());
    bytes.extend(MAGIC.to_le_bytes());
    for field in [REQUEST_ACK, command, payload.len() as u16, id] {
        bytes.extend(field.to_le_bytes());
    }
    bytes.extend(payload);
    bytes
}

/// Payload of ReadMem.
pub fn read_mem(address: u64, count: u16) -> Vec<u8> {
    let mut payload = address.to_le_bytes().to_vec();
    payload.extend([0; 2]);
    payload.extend(count.to_le_bytes());
    payload
}

/// Payload of WriteMem.
pub fn write_mem(address: u64, data: &[u8]) -> Vec<u8> {
    [&address.to_le_bytes(), data].concat()
}

/// An acknowledgement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ack<'a> {
    /// 0 is done; see [`status_text`].
    pub status: u16,
    /// That of the command, plus one.
    pub command: u16,
    /// That of the command.
    pub id: u16,
    /// What follows.
    pub payload: &'a [u8],
}

/// Reads one acknowledgement: one transfer.
///
/// # Errors
/// Another magic, or fewer bytes than it says.
pub fn ack(bytes: &[u8]) -> Result<Ack<'_>, DecodeError> {
    let short = |needed| DecodeError::TooShort {
        message: "acknowledgement",
        found: bytes.len(),
        needed,
    };
    let header = bytes.get(..HEADER).ok_or_else(|| short(HEADER))?;
    let u16_at = |at: usize| u16::from_le_bytes([header[at], header[at + 1]]);
    let magic = u32::from_le_bytes([header[0], header[1], header[2], header[3]]);
    if magic != MAGIC {
        return Err(DecodeError::Field {
            message: "acknowledgement",
            field: "magic",
            found: magic.into(),
            allowed: "0x43563355, \"U3VC\"",
        });
    }
    let end = HEADER + usize::from(u16_at(8));
    Ok(Ack {
        status: u16_at(4),
        command: u16_at(6),
        id: u16_at(10),
        payload: bytes.get(HEADER..end).ok_or_else(|| short(end))?,
    })
}

/// What a status means.
pub fn status_text(status: u16) -> &'static str {
    match status {
        0x0000 => "done",
        0x8001 => "not implemented",
        0x8002 => "invalid parameter",
        0x8003 => "invalid address",
        0x8004 => "write-protected",
        0x8005 => "bad alignment",
        0x8006 => "access denied",
        0x8007 => "busy",
        0x800B => "message timeout",
        0x800E => "invalid header",
        0x800F => "wrong configuration",
        0x8FFF => "generic error",
        0xA001 => "resend is not supported",
        0xA002 => "the stream endpoint is halted",
        0xA003 => "the payload size is not aligned",
        0xA004 => "the stream registers are inconsistent",
        _ => "a status this program does not know",
    }
}

/// The control channel of an open device.
pub struct Control {
    port: String,
    link: Arc<dyn UsbLink>,
    input: u8,
    output: u8,
    last_id: u16,
    /// How long an acknowledgement is waited for.
    patience: Duration,
    /// Most bytes of a command and of an acknowledgement.
    command_max: usize,
    ack_max: usize,
    buffer: Vec<u8>,
}

impl Control {
    /// A channel over these endpoints; how much fits into a transfer is set by [`Control::limit`].
    pub fn new(port: String, link: Arc<dyn UsbLink>, input: u8, output: u8) -> Control {
        Control {
            port,
            link,
            input,
            output,
            last_id: 0,
            patience: Duration::from_millis(500),
            command_max: 64,
            ack_max: 64,
            buffer: vec![0; ACK_MAX],
        }
    }

    /// Takes over what the device says of itself: response time and largest transfers. Less than a register is not believed.
    pub fn limit(&mut self, response_time: Duration, command_max: u32, ack_max: u32) {
        let bounded = |bytes: u32| (bytes as usize).clamp(64, ACK_MAX);
        self.patience = self.patience.max(response_time.min(PENDING_MAX));
        self.command_max = bounded(command_max);
        self.ack_max = bounded(ack_max);
    }

    /// Reads `count` bytes of the device's memory.
    ///
    /// # Errors
    /// A device that refuses, is silent or gone.
    pub fn read(&mut self, address: u64, count: usize) -> Result<Vec<u8>, DeviceError> {
        let step = (self.ack_max - HEADER) & !3;
        let mut data = Vec::new();
        while data.len() < count {
            let part = step.min(count - data.len());
            // A step fits into 16 bits: an acknowledgement has 64 KiB at most.
            let payload = read_mem(address.wrapping_add(data.len() as u64), part as u16);
            let answer = self.ask(command::READ, &payload)?;
            if answer.len() != part {
                return Err(self.decode(DecodeError::TooShort {
                    message: "ReadMem",
                    found: answer.len(),
                    needed: part,
                }));
            }
            data.extend(answer);
        }
        Ok(data)
    }

    /// Reads a number of 4 bytes.
    ///
    /// # Errors
    /// As [`Control::read`].
    pub fn read_u32(&mut self, address: u64) -> Result<u32, DeviceError> {
        let bytes = self.read(address, 4)?;
        Ok(bytes.try_into().map_or(0, u32::from_le_bytes))
    }

    /// Reads a number of 8 bytes.
    ///
    /// # Errors
    /// As [`Control::read`].
    pub fn read_u64(&mut self, address: u64) -> Result<u64, DeviceError> {
        let bytes = self.read(address, 8)?;
        Ok(bytes.try_into().map_or(0, u64::from_le_bytes))
    }

    /// Reads a text that a zero ends.
    ///
    /// # Errors
    /// As [`Control::read`].
    pub fn read_text(&mut self, address: u64, size: usize) -> Result<String, DeviceError> {
        let bytes = self.read(address, size)?;
        let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
        Ok(String::from_utf8_lossy(&bytes[..end]).trim().to_owned())
    }

    /// Writes into the device's memory.
    ///
    /// # Errors
    /// As [`Control::read`].
    pub fn write(&mut self, address: u64, data: &[u8]) -> Result<(), DeviceError> {
        let step = (self.command_max - HEADER - 8) & !3;
        for (index, part) in data.chunks(step).enumerate() {
            let at = address.wrapping_add((index * step) as u64);
            self.ask(command::WRITE, &write_mem(at, part))?;
        }
        Ok(())
    }

    /// Sends a command until it is acknowledged; the answer is the payload.
    fn ask(&mut self, command: u16, payload: &[u8]) -> Result<Vec<u8>, DeviceError> {
        let began = Instant::now();
        let mut heard = 0;
        for _ in 0..TRIES {
            self.last_id = self.last_id % 0xFFFE + 1;
            let bytes = encode(command, self.last_id, payload);
            let deadline = Instant::now() + self.patience;
            match self.link.write(self.output, &bytes, deadline) {
                Ok(Some(n)) if n == bytes.len() => {}
                Ok(_) => continue,
                Err(LinkError::Stalled) => {
                    self.clear_halt(self.output)?;
                    continue;
                }
                Err(source) => return Err(self.gone(source)),
            }
            if let Some(answer) = self.answer(command, &mut heard)? {
                return Ok(answer);
            }
        }
        let deadline_s = (began.elapsed().as_secs_f64() * 10.0).round() / 10.0;
        let port = self.port.clone();
        Err(match heard {
            0 => DeviceError::Silent { port, deadline_s },
            bytes => DeviceError::Babble {
                port,
                bytes,
                command: name(command),
                deadline_s,
            },
        })
    }

    /// Waits for the acknowledgement of the last command; `None` when it does not come.
    fn answer(&mut self, command: u16, heard: &mut u64) -> Result<Option<Vec<u8>>, DeviceError> {
        let last = Instant::now() + PENDING_MAX;
        let mut deadline = Instant::now() + self.patience;
        for _ in 0..STRAY {
            let size = self.ack_max;
            let read = self
                .link
                .read(self.input, &mut self.buffer[..size], deadline);
            let n = match read {
                Ok(Some(n)) => n,
                Ok(None) => return Ok(None),
                Err(LinkError::Stalled) => {
                    self.clear_halt(self.input)?;
                    return Ok(None);
                }
                Err(source) => return Err(self.gone(source)),
            };
            *heard += n as u64;
            let Ok(ack) = ack(&self.buffer[..n]) else {
                continue;
            };
            if ack.id != self.last_id {
                // Late, of a command that was given up.
                continue;
            }
            if ack.command == command::PENDING_ACK {
                let asked = ack
                    .payload
                    .get(2..4)
                    .map_or(0, |b| u16::from_le_bytes([b[0], b[1]]));
                deadline = (Instant::now() + Duration::from_millis(asked.into())).min(last);
                continue;
            }
            if ack.command != command + 1 {
                continue;
            }
            if ack.status != 0 {
                return Err(DeviceError::Refused {
                    port: self.port.clone(),
                    command: name(command).into(),
                    reason: format!("{} ({:#06x})", status_text(ack.status), ack.status),
                    remedy: "check the configuration against the device's manual, then reopen it",
                });
            }
            return Ok(Some(ack.payload.to_vec()));
        }
        Ok(None)
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), DeviceError> {
        self.link
            .clear_halt(endpoint)
            .map_err(|source| self.gone(source))
    }

    fn decode(&self, source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: self.port.clone(),
            source,
        }
    }

    fn gone(&self, source: LinkError) -> DeviceError {
        DeviceError::Link {
            port: self.port.clone(),
            source,
        }
    }
}

fn name(command: u16) -> &'static str {
    match command {
        command::READ => "ReadMem",
        command::WRITE => "WriteMem",
        _ => "a command",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|byte| u8::from_str_radix(byte, 16).expect("hex"))
            .collect()
    }

    #[test]
    fn vectors_of_commands() {
        assert_eq!(
            encode(command::READ, 1, &read_mem(0x1D8, 8)),
            hex("55 33 56 43 00 40 00 08 0C 00 01 00 D8 01 00 00 00 00 00 00 00 00 08 00")
        );
        assert_eq!(
            encode(command::WRITE, 2, &write_mem(0x20004, &1_u32.to_le_bytes())),
            hex("55 33 56 43 00 40 02 08 0C 00 02 00 04 00 02 00 00 00 00 00 01 00 00 00")
        );
    }

    #[test]
    fn vectors_of_acknowledgements() {
        let bytes = hex("55 33 56 43 00 00 01 08 08 00 01 00 00 00 01 00 00 00 00 00");
        let read = ack(&bytes).expect("an acknowledgement");
        assert_eq!((read.status, read.command, read.id), (0, 0x0801, 1));
        assert_eq!(read.payload, 0x10000_u64.to_le_bytes());
        let bytes = hex("55 33 56 43 00 00 03 08 04 00 02 00 00 00 04 00");
        assert_eq!(
            ack(&bytes).expect("an acknowledgement").payload,
            [0, 0, 4, 0]
        );
        let bytes = hex("55 33 56 43 00 00 05 08 04 00 02 00 00 00 2C 01");
        let pending = ack(&bytes).expect("an acknowledgement");
        assert_eq!(
            (pending.command, pending.payload),
            (command::PENDING_ACK, &[0, 0, 0x2C, 1][..])
        );
        for cut in 0..bytes.len() {
            assert!(ack(&bytes[..cut]).is_err(), "cut at {cut}");
        }
        let error = ack(&[0; 20]).expect_err("no magic").to_string();
        assert_eq!(
            error,
            "magic of acknowledgement is 0, allowed is 0x43563355, \"U3VC\""
        );
    }
}
