//! Frames of the open-profile protocol: bytes in, whole frames out, whatever was lost between them.
//!
//! Source: `drivers/open-profile.md`, version 1, section 2.

use crate::error::DecodeError;

/// Both CRC-32C, the fields' and the frame's.
pub(super) const CRC: crc::Crc<u32, crc::Table<16>> =
    crc::Crc::<u32, crc::Table<16>>::new(&crc::CRC_32_ISCSI);

const MAGIC: [u8; 2] = [0xA5, 0x5A];
pub(super) const VERSION: u8 = 1;
/// Bytes before the payload.
pub(super) const HEADER: usize = 16;
/// Bytes behind the payload.
pub(super) const TRAILER: usize = 4;
/// Most bytes in a payload.
pub const PAYLOAD_MAX: usize = 65_536;

/// Bytes taken in at once; with one frame it bounds the decoder's memory.
const BLOCK: usize = 65_536;

/// A whole frame whose checks hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Type of the message, section 3.
    pub kind: u8,
    /// Id of a command or its reply; sequence number of a profile.
    pub id: u32,
    /// The message's fields.
    pub payload: &'a [u8],
}

/// What the start of some bytes is.
#[derive(Debug, PartialEq)]
pub enum Step<'a> {
    /// A frame, and its length in all.
    Frame(Frame<'a>, usize),
    /// The start of a frame, or nothing.
    NeedMore,
    /// This many bytes that begin no frame.
    Skip(usize),
    /// A frame that cannot be: drop one byte and look again.
    Bad(DecodeError),
}

/// Says what `bytes` begin with. Looks at one frame's length at most.
pub fn step(bytes: &[u8]) -> Step<'_> {
    let start = magic(bytes);
    if start > 0 {
        return Step::Skip(start);
    }
    if bytes.len() < HEADER {
        return Step::NeedMore;
    }
    let computed = CRC.checksum(&bytes[..12]);
    let found = u32_at(bytes, 12);
    if found != computed {
        return Step::Bad(DecodeError::HeaderCheck { found, computed });
    }
    let length = u32_at(bytes, 8) as usize;
    if length > PAYLOAD_MAX {
        return Step::Bad(DecodeError::TooLong {
            claimed: length as u64,
            limit: PAYLOAD_MAX,
        });
    }
    let end = HEADER + length;
    if bytes.len() < end + TRAILER {
        return Step::NeedMore;
    }
    let computed = CRC.checksum(&bytes[..end]);
    let found = u32_at(bytes, end);
    if found != computed {
        return Step::Bad(DecodeError::FrameCheck {
            found,
            computed,
            length,
        });
    }
    if bytes[2] != VERSION {
        return Step::Bad(DecodeError::Version {
            found: bytes[2],
            known: VERSION,
        });
    }
    let frame = Frame {
        kind: bytes[3],
        id: u32_at(bytes, 4),
        payload: &bytes[HEADER..end],
    };
    Step::Frame(frame, end + TRAILER)
}

/// Where the first magic begins, or could begin at the last byte; the length where there is none.
fn magic(bytes: &[u8]) -> usize {
    let mut at = 0;
    while let Some(offset) = bytes[at..].iter().position(|&b| b == MAGIC[0]) {
        at += offset;
        match bytes.get(at + 1) {
            Some(&b) if b != MAGIC[1] => at += 1,
            _ => return at,
        }
    }
    bytes.len()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// One frame as bytes.
pub(super) fn encode(kind: u8, id: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + payload.len() + TRAILER);
    bytes.extend(MAGIC);
    bytes.extend([VERSION, kind]);
    bytes.extend(id.to_le_bytes());
    bytes.extend((payload.len() as u32).to_le_bytes());
    bytes.extend(CRC.checksum(&bytes).to_le_bytes());
    bytes.extend(payload);
    bytes.extend(CRC.checksum(&bytes).to_le_bytes());
    bytes
}

/// Finds the frames in a stream of bytes that comes in any pieces.
///
/// Holds at most one unfinished frame and one block of 64 KiB, whatever comes. Every byte that belongs to no frame is counted.
#[derive(Debug, Default)]
pub struct Decoder {
    held: Vec<u8>,
    skipped_bytes: u64,
}

impl Decoder {
    /// Takes `bytes` and calls `each` with every whole frame, and with every frame that had to be refused.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Result<Frame<'_>, DecodeError>)) {
        for block in bytes.chunks(BLOCK) {
            self.held.extend_from_slice(block);
            self.look(&mut each);
        }
    }

    /// Gives up what is waited for, after 250 ms without a byte: drops one byte and looks again, until nothing waits.
    pub fn stalled(&mut self, mut each: impl FnMut(Result<Frame<'_>, DecodeError>)) {
        while !self.held.is_empty() {
            self.drop_front(1);
            self.skipped_bytes += 1;
            self.look(&mut each);
        }
    }

    /// Bytes of a frame that is not whole yet.
    pub fn held_bytes(&self) -> usize {
        self.held.len()
    }

    /// Bytes thrown away so far.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    fn look(&mut self, each: &mut impl FnMut(Result<Frame<'_>, DecodeError>)) {
        let mut at = 0;
        while at < self.held.len() {
            match step(&self.held[at..]) {
                Step::Frame(frame, used) => {
                    each(Ok(frame));
                    at += used;
                }
                Step::NeedMore => break,
                Step::Skip(n) => {
                    at += n;
                    self.skipped_bytes += n as u64;
                }
                Step::Bad(error) => {
                    at += 1;
                    self.skipped_bytes += 1;
                    each(Err(error));
                }
            }
        }
        self.drop_front(at);
    }

    fn drop_front(&mut self, n: usize) {
        self.held.drain(..n);
    }
}
