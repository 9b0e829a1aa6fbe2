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

/// The examples of the document's section 8: name and bytes.
#[cfg(test)]
pub(super) fn examples() -> Vec<(&'static str, Vec<u8>)> {
    let document = include_str!("../../open-profile.md");
    let (_, section) = document
        .split_once("## 8. Examples")
        .expect("the document has a section of examples");
    let quoted = |line: &'static str| line.trim().trim_start_matches("- ").split('`').nth(1);
    let lines: Vec<&str> = section.lines().filter(|line| line.contains('`')).collect();
    let pairs = lines.chunks_exact(2);
    pairs
        .map(|pair| {
            let name = quoted(pair[0]).expect("a name in back ticks");
            let hex = quoted(pair[1]).expect("bytes in back ticks");
            let bytes = hex.split(' ').map(|b| u8::from_str_radix(b, 16));
            (name, bytes.collect::<Result<_, _>>().expect("hex bytes"))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    /// Type, id and payload of a frame.
    type Parts = (u8, u32, Vec<u8>);

    /// Every frame that comes out, and the errors.
    fn decode(decoder: &mut Decoder, bytes: &[u8]) -> (Vec<Parts>, Vec<DecodeError>) {
        let (mut frames, mut errors) = (Vec::new(), Vec::new());
        decoder.take(bytes, |frame| match frame {
            Ok(frame) => frames.push((frame.kind, frame.id, frame.payload.to_vec())),
            Err(error) => errors.push(error),
        });
        (frames, errors)
    }

    fn stream() -> Vec<u8> {
        examples()
            .into_iter()
            .flat_map(|(_, bytes)| bytes)
            .collect()
    }

    #[test]
    fn check_value_of_the_document() {
        assert_eq!(CRC.checksum(b"123456789"), 0xE306_9283);
    }

    #[test]
    fn every_example_is_one_whole_frame() {
        let examples = examples();
        assert_eq!(examples.len(), 14);
        for (name, bytes) in examples {
            let Step::Frame(frame, used) = step(&bytes) else {
                panic!("{name} is no frame");
            };
            assert_eq!(used, bytes.len(), "{name}");
            assert_eq!(encode(frame.kind, frame.id, frame.payload), bytes, "{name}");
        }
    }

    #[test]
    fn split_at_every_byte() {
        let stream = stream();
        let (whole, errors) = decode(&mut Decoder::default(), &stream);
        assert_eq!((whole.len(), errors), (14, Vec::new()));
        for cut in 0..=stream.len() {
            let mut decoder = Decoder::default();
            let mut parts = decode(&mut decoder, &stream[..cut]).0;
            parts.extend(decode(&mut decoder, &stream[cut..]).0);
            assert_eq!(parts, whole, "cut at {cut}");
            assert_eq!((decoder.skipped_bytes(), decoder.held_bytes()), (0, 0));
        }
        let mut decoder = Decoder::default();
        let single: Vec<_> = stream
            .iter()
            .flat_map(|&byte| decode(&mut decoder, &[byte]).0)
            .collect();
        assert_eq!(single, whole);
    }

    #[test]
    fn garbage_between_frames_is_counted() {
        let garbage = [0xA5, 0xA5, 0x00, 0x5A, 0xFF, 0xA5];
        let mut stream = garbage.to_vec();
        for (_, bytes) in examples() {
            stream.extend(bytes);
            stream.extend(garbage);
        }
        let mut decoder = Decoder::default();
        let (frames, errors) = decode(&mut decoder, &stream);
        assert_eq!((frames.len(), errors.len()), (14, 0));
        // The last byte may begin a magic and is still held.
        assert_eq!(decoder.skipped_bytes(), 15 * 6 - 1);
        assert_eq!(decoder.held_bytes(), 1);
        decoder.stalled(|_| panic!("one byte is no frame"));
        assert_eq!((decoder.skipped_bytes(), decoder.held_bytes()), (90, 0));
    }

    #[test]
    fn one_lost_byte_costs_one_frame() {
        let (first, second) = (&examples()[7].1, &examples()[8].1);
        for lost in 0..first.len() {
            let mut stream = first.clone();
            stream.remove(lost);
            let damaged = stream.len() as u64;
            stream.extend(second);
            stream.extend(second);
            let mut decoder = Decoder::default();
            let (frames, _) = decode(&mut decoder, &stream);
            let ids: Vec<u32> = frames.iter().map(|frame| frame.1).collect();
            assert_eq!(ids, [1, 1], "byte {lost} lost");
            assert_eq!(decoder.skipped_bytes(), damaged, "byte {lost} lost");
        }
    }

    #[test]
    fn one_flipped_bit_costs_one_frame() {
        let (first, second) = (&examples()[7].1, &examples()[8].1);
        for bit in 0..8 * first.len() {
            let mut stream = first.clone();
            stream[bit / 8] ^= 1 << (bit % 8);
            stream.extend(second);
            let (frames, _) = decode(&mut Decoder::default(), &stream);
            assert_eq!(frames.len(), 1, "bit {bit}");
            assert_eq!(frames[0].1, 1, "bit {bit}");
        }
    }

    #[test]
    fn a_lying_length_with_a_good_header_check_hides_nothing() {
        let (first, second) = (&examples()[7].1, &examples()[8].1);
        let mut liar = first.clone();
        liar[8..12].copy_from_slice(&100_u32.to_le_bytes());
        let check = CRC.checksum(&liar[..12]).to_le_bytes();
        liar[12..16].copy_from_slice(&check);
        let mut stream = liar.clone();
        stream.extend(second);
        let mut decoder = Decoder::default();
        let (frames, errors) = decode(&mut decoder, &stream);
        assert_eq!(frames.len(), 1, "the frame inside the claimed length");
        assert_eq!(decoder.skipped_bytes(), liar.len() as u64);
        assert!(matches!(
            errors[0],
            DecodeError::FrameCheck { length: 100, .. }
        ));
    }

    #[test]
    fn errors_say_what_was_seen() {
        let hello = examples()[0].1.clone();
        let told = |bytes: &[u8]| match step(bytes) {
            Step::Bad(error) => error.to_string(),
            other => panic!("{other:?}"),
        };
        let mut header = hello.clone();
        header[12] ^= 1;
        assert_eq!(
            told(&header),
            "header check is 0xfb90535b, the bytes give 0xfb90535a"
        );
        let mut body = hello.clone();
        body[16] ^= 0xFF;
        assert_eq!(
            told(&body),
            "frame check is 0x48674b38, the bytes give 0x48674bc7 (payload of 0 bytes)"
        );
        let with_check = |mut bytes: Vec<u8>| {
            let check = CRC.checksum(&bytes[..12]).to_le_bytes();
            bytes[12..16].copy_from_slice(&check);
            let check = CRC.checksum(&bytes[..16]).to_le_bytes();
            bytes[16..].copy_from_slice(&check);
            bytes
        };
        let mut long = hello.clone();
        long[8..12].copy_from_slice(&65_537_u32.to_le_bytes());
        assert_eq!(
            told(&with_check(long)),
            "frame says 65537 bytes, at most 65536 are allowed"
        );
        let mut newer = hello;
        newer[2] = 2;
        assert_eq!(
            told(&with_check(newer)),
            "protocol version 2, this program knows 1; update the one that is older"
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(7),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_frames_in_any_pieces_come_out(
            frames in prop::collection::vec((any::<u8>(), any::<u32>(), prop::collection::vec(any::<u8>(), 0..300)), 0..8),
            piece in 1_usize..400,
        ) {
            let stream: Vec<u8> = frames.iter().flat_map(|(kind, id, payload)| encode(*kind, *id, payload)).collect();
            let mut decoder = Decoder::default();
            let found: Vec<_> = stream.chunks(piece).flat_map(|part| decode(&mut decoder, part).0).collect();
            prop_assert_eq!(found, frames);
            prop_assert_eq!(decoder.skipped_bytes(), 0);
        }

        #[test]
        fn any_bytes_are_consumed_or_held(
            bytes in prop::collection::vec(prop_oneof![Just(0xA5_u8), Just(0x5A), Just(1), any::<u8>()], 0..2000),
            piece in 1_usize..400,
        ) {
            let mut decoder = Decoder::default();
            for part in bytes.chunks(piece) {
                decoder.take(part, |_| {});
                prop_assert!(decoder.held_bytes() <= HEADER + PAYLOAD_MAX + TRAILER);
            }
            let before = decoder.skipped_bytes();
            let held = decoder.held_bytes() as u64;
            decoder.stalled(|_| {});
            prop_assert_eq!(decoder.held_bytes(), 0);
            prop_assert!(decoder.skipped_bytes() <= before + held);
        }
    }
}
