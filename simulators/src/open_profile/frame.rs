//! Frames of section 2: encoding, and finding them again in a damaged stream.

use std::time::{Duration, Instant};

const MAGIC: [u8; 2] = [0xA5, 0x5A];
pub(super) const VERSION: u8 = 1;
const HEADER: usize = 16;
const LONGEST: usize = 65_536;

/// Waiting longer than this for the rest of a frame, the receiver drops one byte.
pub(super) const PATIENCE: Duration = Duration::from_millis(250);

/// CRC-32C by table, reflected.
pub(super) fn crc32c(bytes: &[u8]) -> u32 {
    static TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let mut c = i as u32;
            let mut bit = 0;
            while bit < 8 {
                c = if c & 1 == 1 {
                    c >> 1 ^ 0x82F6_3B78
                } else {
                    c >> 1
                };
                bit += 1;
            }
            table[i] = c;
            i += 1;
        }
        table
    };
    !bytes
        .iter()
        .fold(!0, |c: u32, &b| c >> 8 ^ table_entry(&TABLE, c, b))
}

fn table_entry(table: &[u32; 256], c: u32, b: u8) -> u32 {
    table[usize::from(c.to_le_bytes()[0] ^ b)]
}

/// A whole frame of version 1.
pub(super) fn encode(kind: u8, id: u32, payload: &[u8]) -> Vec<u8> {
    encode_with_length(kind, id, payload, payload.len() as u32)
}

/// A frame whose header states any length, under checks that are right for what is sent.
pub(super) fn encode_with_length(kind: u8, id: u32, payload: &[u8], stated: u32) -> Vec<u8> {
    let mut frame = Vec::with_capacity(HEADER + payload.len() + 4);
    frame.extend(MAGIC);
    frame.extend([VERSION, kind]);
    frame.extend(id.to_le_bytes());
    frame.extend(stated.to_le_bytes());
    frame.extend(crc32c(&frame).to_le_bytes());
    frame.extend(payload);
    frame.extend(crc32c(&frame).to_le_bytes());
    frame
}

/// A frame as received; its checks were right.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Frame {
    pub version: u8,
    pub kind: u8,
    pub id: u32,
    pub payload: Vec<u8>,
}

/// Finds frames in what arrives.
#[derive(Debug, Default)]
pub(super) struct Receiver {
    bytes: Vec<u8>,
    last: Option<Instant>,
}

impl Receiver {
    pub fn take(&mut self, bytes: &[u8], now: Instant) {
        self.bytes.extend_from_slice(bytes);
        self.last = Some(now);
    }

    /// When an unfinished frame is given up, if there is one.
    pub fn deadline(&self) -> Option<Instant> {
        (!self.bytes.is_empty()).then(|| self.last.map(|l| l + PATIENCE))?
    }

    /// The next whole frame; `None` when more bytes are needed.
    pub fn next(&mut self, now: Instant) -> Option<Frame> {
        loop {
            self.skip_to_magic();
            match self.whole() {
                Whole::Frame(frame, length) => {
                    self.bytes.drain(..length);
                    return Some(frame);
                }
                Whole::Bad => {
                    self.bytes.drain(..1);
                }
                Whole::NotYet => {
                    if self.deadline().is_none_or(|due| now < due) {
                        return None;
                    }
                    self.bytes.drain(..1);
                }
            }
        }
    }

    fn skip_to_magic(&mut self) {
        let start = (0..self.bytes.len()).find(|&i| {
            let rest = &self.bytes[i..];
            rest.starts_with(&MAGIC) || rest == &MAGIC[..1]
        });
        self.bytes.drain(..start.unwrap_or(self.bytes.len()));
    }

    fn whole(&self) -> Whole {
        let Some(header) = self.bytes.first_chunk::<HEADER>() else {
            return Whole::NotYet;
        };
        let word = |at: usize| u32_at(&self.bytes, at);
        let length = word(8) as usize;
        if crc32c(&header[..12]) != word(12) || length > LONGEST {
            return Whole::Bad;
        }
        let body = HEADER + length;
        if self.bytes.len() < body + 4 {
            return Whole::NotYet;
        }
        if crc32c(&self.bytes[..body]) != word(body) {
            return Whole::Bad;
        }
        let frame = Frame {
            version: header[2],
            kind: header[3],
            id: word(4),
            payload: self.bytes[HEADER..body].to_vec(),
        };
        Whole::Frame(frame, body + 4)
    }
}

enum Whole {
    Frame(Frame, usize),
    Bad,
    NotYet,
}

pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_check_is_castagnolis() {
        assert_eq!(crc32c(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn a_receiver_finds_frames_between_rubbish_and_after_a_lying_length() {
        let now = Instant::now();
        let mut receiver = Receiver::default();
        let mut stream = vec![0xA5, 0x00, 0xA5, 0x5A, 0x01];
        stream.extend(encode_with_length(5, 1, &[], 30));
        stream.extend(encode(1, 2, &[]));
        stream.extend(encode(6, 3, &[1, 2, 3, 4, 5, 6, 7, 8]));
        for byte in stream {
            receiver.take(&[byte], now);
        }
        let ids: Vec<u32> = std::iter::from_fn(|| receiver.next(now))
            .map(|f| f.id)
            .collect();
        assert_eq!(ids, [2, 3]);
        assert_eq!(receiver.deadline(), None);
    }

    #[test]
    fn an_unfinished_frame_is_given_up_after_the_stated_time() {
        let now = Instant::now();
        let mut receiver = Receiver::default();
        let frame = encode(1, 2, &[]);
        receiver.take(&encode_with_length(5, 1, &[], 60_000), now);
        receiver.take(&frame, now);
        assert_eq!(receiver.next(now + PATIENCE / 2), None);
        assert_eq!(receiver.next(now + PATIENCE).map(|f| f.id), Some(2));
    }
}
