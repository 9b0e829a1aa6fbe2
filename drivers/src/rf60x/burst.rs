//! Bytes of the bus to answers. Pure; at most one answer is held.
//!
//! Every byte of an answer has bit 7, the same SB and the same CNT. There is no length and no check: an answer is as many equal
//! upper halves in a row as the request is known to bring.

/// Most bytes of an answer: that of *identify*.
pub const ANSWER_MAX: usize = 16;

/// One answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Answer {
    /// SB: the result was updated since the last transfer.
    pub fresh: bool,
    /// CNT, 0 to 3.
    pub counter: u8,
    payload: [u8; ANSWER_MAX / 2],
    length: usize,
}

impl Answer {
    /// Its bytes, put together from nibbles, low one first.
    pub fn payload(&self) -> &[u8] {
        &self.payload[..self.length]
    }

    /// The word of 16 bits at a place.
    pub fn word(&self, at: usize) -> Option<u16> {
        let bytes = self.payload().get(at..at + 2)?;
        Some(u16::from_le_bytes([bytes[0], bytes[1]]))
    }
}

/// Finds answers of a known length.
#[derive(Debug, Default)]
pub struct Decoder {
    wanted: usize,
    held: Vec<u8>,
    skipped_bytes: u64,
}

impl Decoder {
    /// Looks for answers of so many payload bytes from now on; what is held is thrown away.
    pub fn expect(&mut self, payload_bytes: usize) {
        self.wanted = (2 * payload_bytes).clamp(2, ANSWER_MAX);
        self.skipped_bytes += self.held.len() as u64;
        self.held.clear();
    }

    /// Takes bytes; `each` gets the answers that they complete, and how many bytes were thrown away so far.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Answer, u64)) {
        for &byte in bytes {
            if byte & 0x80 == 0 {
                self.skipped_bytes += self.held.len() as u64 + 1;
                self.held.clear();
                continue;
            }
            if self
                .held
                .first()
                .is_some_and(|first| (first ^ byte) & 0xF0 != 0)
            {
                self.skipped_bytes += self.held.len() as u64;
                self.held.clear();
            }
            self.held.push(byte);
            if self.held.len() >= self.wanted.max(2) {
                each(self.answer(), self.skipped_bytes);
                self.held.clear();
            }
        }
    }

    fn answer(&self) -> Answer {
        let mut payload = [0; ANSWER_MAX / 2];
        for (byte, pair) in payload.iter_mut().zip(self.held.chunks_exact(2)) {
            *byte = pair[0] & 15 | pair[1] << 4;
        }
        Answer {
            fresh: self.held[0] & 0x40 != 0,
            counter: self.held[0] >> 4 & 3,
            payload,
            length: self.held.len() / 2,
        }
    }

    /// Bytes thrown away.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// Bytes kept for later.
    pub fn held_bytes(&self) -> usize {
        self.held.len()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn answers(bytes: &[u8], payload_bytes: usize, piece: usize) -> Vec<Answer> {
        let mut decoder = Decoder::default();
        decoder.expect(payload_bytes);
        let mut found = Vec::new();
        for part in bytes.chunks(piece) {
            decoder.take(part, |answer, _| found.push(answer));
        }
        found
    }

    #[test]
    fn golden_answers() {
        let identify = [
            0x9F, 0x93, 0x90, 0x99, 0x91, 0x92, 0x93, 0x94, 0x90, 0x95, 0x90, 0x90, 0x92, 0x93,
            0x90, 0x90,
        ];
        for piece in 1..=16 {
            let found = answers(&identify, 8, piece);
            assert_eq!(found.len(), 1);
            assert_eq!(found[0].payload(), [0x3F, 0x90, 0x21, 0x43, 80, 0, 50, 0]);
            assert_eq!((found[0].counter, found[0].fresh), (1, false));
        }
        let read = answers(&[0xA4, 0xA0], 1, 1)[0];
        assert_eq!((read.payload(), read.counter), (&[4][..], 2));
        let result = answers(&[0xF5, 0xFA, 0xF2, 0xF0], 2, 3)[0];
        assert_eq!(
            (result.word(0), result.counter, result.fresh),
            (Some(0x02A5), 3, true)
        );
        let full = answers(&[0xC0, 0xC0, 0xC0, 0xC4, 0xD0, 0xD0, 0xD0, 0xD2], 2, 5);
        assert_eq!(full[0].word(0), Some(0x4000));
        assert_eq!((full[1].word(0), full[1].counter), (Some(0x2000), 1));
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(7),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_bytes_never_panic_never_grow_and_are_all_accounted_for(
            bytes in prop::collection::vec(any::<u8>(), 0..5000), payload in 0_usize..20,
        ) {
            let mut decoder = Decoder::default();
            decoder.expect(payload);
            let mut used = 0;
            decoder.take(&bytes, |answer, _| used += 2 * answer.payload().len() as u64);
            prop_assert!(decoder.held_bytes() < ANSWER_MAX);
            let all = used + decoder.skipped_bytes() + decoder.held_bytes() as u64;
            prop_assert_eq!(all, bytes.len() as u64);
        }
    }
}
