//! Bytes of the sensor to words and replies, and words to measurements. Pure; memory is bounded by [`TEXT_MAX`].
//!
//! Words and text share the line. A word is L M H, and only H has bit 7; text has none. So everything is decided when a byte
//! with bit 7 comes: the two before it must be L and M. The prompt `->` is two bytes of class L in a row, which no word has, and
//! ends a reply.

/// Longest reply that is kept. PRINT, the longest, lists some sixty settings.
pub const TEXT_MAX: usize = 8192;

/// Bytes without bit 7 before an H that lost bytes of two words explain. More are text or rubbish, and its last two may then
/// belong to the rubbish as well.
const EXPLAINED: usize = 5;

/// What the decoder finds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item<'a> {
    /// One value of 18 bits.
    Word(Word),
    /// A reply, without its prompt.
    Reply(&'a [u8]),
}

/// One value of 18 bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Word {
    /// The first value of a measurement.
    pub first: bool,
    /// The value.
    pub value: u32,
    /// No byte was thrown away between it and the word before; a reply may stand there.
    pub clean: bool,
}

/// Finds words and replies in a stream that may begin anywhere and lose anything.
#[derive(Debug, Default)]
pub struct Decoder {
    /// Bytes without bit 7 since the last word or reply.
    pending: Vec<u8>,
    skipped_bytes: u64,
    /// As it stood at the last word.
    skipped_before: u64,
    doubted: u64,
}

fn is_low(byte: u8) -> bool {
    byte >> 6 == 0b00
}

fn is_middle(byte: u8) -> bool {
    byte >> 6 == 0b01
}

fn word(low: u8, middle: u8, high: u8, clean: bool) -> Word {
    let six = |byte: u8| u32::from(byte & 0x3F);
    Word {
        first: high & 0x40 == 0,
        value: six(low) | six(middle) << 6 | six(high) << 12,
        clean,
    }
}

/// Where a reply begins: behind the last byte that is no text, with a letter or an empty line. What stands before is left of
/// words that were damaged.
fn text_start(bytes: &[u8]) -> usize {
    let is_text = |b: &u8| (0x20..0x7F).contains(b) || matches!(b, b'\r' | b'\n' | b'\t');
    let behind = bytes
        .iter()
        .rposition(|b| !is_text(b))
        .map_or(0, |at| at + 1);
    let begins = |b: &u8| b.is_ascii_alphabetic() || matches!(b, b'\r' | b'\n');
    let first = bytes[behind..].iter().position(begins);
    first.map_or(bytes.len(), |first| behind + first)
}

impl Decoder {
    /// Takes bytes; `each` gets what they complete.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Item<'_>)) {
        let mut rest = bytes;
        while !rest.is_empty() {
            if self.pending.is_empty() {
                while let [low, middle, high, more @ ..] = rest
                    && is_low(*low)
                    && is_middle(*middle)
                    && *high & 0x80 != 0
                {
                    let clean = self.skipped_bytes == self.skipped_before;
                    self.skipped_before = self.skipped_bytes;
                    each(Item::Word(word(*low, *middle, *high, clean)));
                    rest = more;
                }
            }
            let Some((&byte, more)) = rest.split_first() else {
                return;
            };
            rest = more;
            self.byte(byte, &mut each);
        }
    }

    fn byte(&mut self, byte: u8, each: &mut impl FnMut(Item<'_>)) {
        let n = self.pending.len();
        if byte & 0x80 == 0 {
            self.pending.push(byte);
            if self.pending.ends_with(b"->") {
                let start = text_start(&self.pending[..n - 1]);
                self.skipped_bytes += start as u64;
                each(Item::Reply(&self.pending[start..n - 1]));
                self.pending.clear();
            } else if n + 1 == TEXT_MAX {
                self.skipped_bytes += TEXT_MAX as u64;
                self.pending.clear();
                // What follows is no word that begins here.
                self.pending.resize(EXPLAINED + 1, 0);
                self.skipped_bytes -= self.pending.len() as u64;
            }
            return;
        }
        match self.pending[..] {
            [.., low, middle] if is_low(low) && is_middle(middle) && n <= EXPLAINED => {
                self.skipped_bytes += n as u64 - 2;
                let clean = self.skipped_bytes == self.skipped_before;
                self.skipped_before = self.skipped_bytes;
                each(Item::Word(word(low, middle, byte, clean)));
            }
            [.., low, middle] if is_low(low) && is_middle(middle) => {
                self.doubted += 1;
                self.skipped_bytes += n as u64 + 1;
            }
            _ => self.skipped_bytes += n as u64 + 1,
        }
        self.pending.clear();
    }

    /// Bytes thrown away.
    pub fn skipped_bytes(&self) -> u64 {
        self.skipped_bytes
    }

    /// Words thrown away because rubbish stood before them.
    pub fn doubted(&self) -> u64 {
        self.doubted
    }

    /// Bytes kept for later.
    pub fn held_bytes(&self) -> usize {
        self.pending.len()
    }
}

/// Puts words into measurements of a known number of values.
#[derive(Debug)]
pub struct Assembly {
    values: usize,
    words: Vec<u32>,
    /// Words since the last first one, too many of them counted as well.
    seen: usize,
    /// The measurement under way may have begun with a word spliced from two.
    doubtful: bool,
    /// Measurements in a row of another number of values.
    misfits: u32,
    /// Measurements thrown away because values are missing or in doubt.
    pub rejected: u64,
    /// Of these, whole ones that may have been put together from two.
    pub doubted: u64,
}

/// Measurements in a row with the wrong number of values, after which it is no damage but the configuration.
const MISFITS: u32 = 100;

impl Assembly {
    /// For measurements of so many values, at least 1.
    pub fn new(values: usize) -> Assembly {
        Assembly {
            values: values.max(1),
            words: Vec::with_capacity(values),
            seen: 0,
            doubtful: false,
            misfits: 0,
            rejected: 0,
            doubted: 0,
        }
    }

    /// Takes a word; the values of the measurement that it completes, in order.
    ///
    /// Where the last word of a measurement is missing and the next one follows without a break, the two may be one word of
    /// halves: low bytes of the old, high byte of the new. The measurement that begins so is thrown away. So is one with rubbish
    /// inside: the rubbish may have been its true beginning.
    pub fn take(&mut self, word: Word) -> Option<&[u32]> {
        if word.first {
            let missing = self.values.saturating_sub(self.seen);
            if self.seen > 0 {
                self.rejected += u64::from(missing > 0);
                self.misfits = match self.seen == self.values {
                    true => 0,
                    false => self.misfits.saturating_add(1),
                };
            }
            self.doubtful = self.seen > 0 && missing == 1 && word.clean;
            self.words.clear();
            self.seen = 0;
        } else if self.seen == 0 {
            return None;
        } else {
            self.doubtful |= !word.clean;
        }
        self.seen = self.seen.saturating_add(1);
        if self.seen > self.values {
            return None;
        }
        self.words.push(word.value);
        if self.seen < self.values {
            return None;
        }
        if self.doubtful {
            self.rejected += 1;
            self.doubted += 1;
            return None;
        }
        Some(&self.words)
    }

    /// The number of values that the sensor sends instead, where it clearly sends another one.
    pub fn misfit(&self) -> Option<usize> {
        (self.misfits >= MISFITS).then_some(self.seen)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn encode(first: bool, value: u32) -> [u8; 3] {
        let six = |shift: u32| (value >> shift & 0x3F) as u8;
        [
            six(0),
            0x40 | six(6),
            if first { 0x80 } else { 0xC0 } | six(12),
        ]
    }

    /// Everything found, as text.
    fn decode(bytes: &[u8], piece: usize) -> Vec<String> {
        let mut decoder = Decoder::default();
        let mut found = Vec::new();
        for part in bytes.chunks(piece) {
            decoder.take(part, |item| {
                found.push(match item {
                    Item::Word(word) if word.first => format!("first {}", word.value),
                    Item::Word(word) => format!("further {}", word.value),
                    Item::Reply(text) => String::from_utf8_lossy(text).into_owned(),
                });
            });
        }
        found
    }

    #[test]
    fn golden_words() {
        for (bytes, value) in [
            ([0x03, 0x4A, 0x80], 643),
            ([0x38, 0x7F, 0x87], 32_760),
            ([0x2D, 0x75, 0x8F], 64_877),
            ([0x3B, 0x7E, 0xBF], 262_075),
            ([0x3C, 0x7E, 0xBF], 262_076),
            ([0x3D, 0x7E, 0xBF], 262_077),
            ([0x3E, 0x7E, 0xBF], 262_078),
            ([0x00, 0x7F, 0xBF], 262_080),
            ([0x01, 0x7F, 0xBF], 262_081),
            ([0x02, 0x7F, 0xBF], 262_082),
        ] {
            assert_eq!(decode(&bytes, 3), [format!("first {value}")]);
            assert_eq!(decode(&bytes, 1), [format!("first {value}")]);
            let further = [bytes[0], bytes[1], bytes[2] | 0x40];
            assert_eq!(decode(&further, 2), [format!("further {value}")]);
        }
    }

    #[test]
    fn a_reply_between_two_words_loses_neither() {
        let mut bytes = encode(true, 1000).to_vec();
        bytes.extend(b"GETINFO\r\nName: ILD1420-10\r\n->");
        bytes.extend(encode(false, 7));
        let expected = ["first 1000", "GETINFO\r\nName: ILD1420-10\r\n", "further 7"];
        for piece in 1..bytes.len() {
            assert_eq!(decode(&bytes, piece), expected, "in pieces of {piece}");
        }
    }

    #[test]
    fn a_lost_byte_costs_its_word_and_no_other() {
        let bytes: Vec<u8> = [100, 200_000, 300]
            .iter()
            .flat_map(|&v| encode(true, v))
            .collect();
        for lost in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged.remove(lost);
            let mut expected = vec!["first 100", "first 200000", "first 300"];
            expected.remove(lost / 3);
            assert_eq!(decode(&damaged, 100), expected, "byte {lost}");
        }
    }

    #[test]
    fn zeros_make_no_value_together_with_the_rest_of_a_word() {
        let mut bytes = encode(true, 5).to_vec();
        bytes.extend([0; 62]);
        bytes.extend(&encode(true, 200_000)[1..]);
        bytes.extend(encode(true, 6));
        assert_eq!(decode(&bytes, 7), ["first 5", "first 6"]);
    }

    #[test]
    fn a_word_of_two_halves_is_not_believed() {
        let words = |k: u32| [encode(true, 1000 + k), encode(false, k)].concat();
        let mut bytes: Vec<u8> = (0..3).flat_map(words).collect();
        // the last byte of the counter 0 and the first two of the distance 1
        bytes.drain(5..8);
        let mut decoder = Decoder::default();
        let mut assembly = Assembly::new(2);
        let mut found = Vec::new();
        decoder.take(&bytes, |item| {
            if let Item::Word(word) = item
                && let Some(values) = assembly.take(word)
            {
                found.push(values.to_vec());
            }
        });
        assert_eq!(found, [[1002, 2]]);
        assert_eq!((assembly.rejected, assembly.doubted), (2, 1));
    }

    #[test]
    fn rubbish_that_looks_like_a_distance_gets_no_counter() {
        let mut bytes = [encode(true, 1000), encode(false, 0)].concat();
        // A value out of nowhere, and so much before the next word that this is given up.
        bytes.extend(encode(true, 5555));
        bytes.extend([1; 9]);
        bytes.extend([encode(true, 1001), encode(false, 1)].concat());
        let mut decoder = Decoder::default();
        let mut assembly = Assembly::new(2);
        let mut found = Vec::new();
        decoder.take(&bytes, |item| {
            if let Item::Word(word) = item
                && let Some(values) = assembly.take(word)
            {
                found.push(values.to_vec());
            }
        });
        assert_eq!(found, [[1000, 0]]);
    }

    #[test]
    fn a_reply_behind_damaged_words_joins_no_distance_to_a_later_counter() {
        let mut bytes = encode(true, 1000).to_vec();
        // Zeros in place of the counter 0 and the distance 1, then a reply and the counter 1.
        bytes.extend([0; 6]);
        bytes.extend(b"W320 Temperature\r\n->");
        bytes.extend(encode(false, 1));
        let mut decoder = Decoder::default();
        let mut assembly = Assembly::new(2);
        decoder.take(&bytes, |item| match item {
            Item::Word(word) => assert_eq!(assembly.take(word), None),
            Item::Reply(text) => assert_eq!(text, b"W320 Temperature\r\n"),
        });
        assert_eq!(decoder.skipped_bytes(), 6);
    }

    #[test]
    fn another_number_of_values_is_told_after_a_while() {
        let mut assembly = Assembly::new(3);
        for k in 0..200 {
            for first in [true, false] {
                let word = Word {
                    first,
                    value: k,
                    clean: true,
                };
                assert_eq!(assembly.take(word), None);
            }
        }
        assert_eq!(assembly.misfit(), Some(2));
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(7),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_bytes_never_panic_never_grow_and_are_all_accounted_for(
            bytes in prop::collection::vec(any::<u8>(), 0..20_000), piece in 1_usize..200,
        ) {
            let mut decoder = Decoder::default();
            let mut assembly = Assembly::new(3);
            let mut used = 0;
            for part in bytes.chunks(piece) {
                decoder.take(part, |item| match item {
                    Item::Word(word) => {
                        used += 3;
                        let _ = assembly.take(word);
                    }
                    Item::Reply(text) => used += text.len() as u64 + 2,
                });
                prop_assert!(decoder.held_bytes() < TEXT_MAX);
            }
            let held = decoder.held_bytes() as u64;
            prop_assert_eq!(used + decoder.skipped_bytes() + held, bytes.len() as u64);
        }

        #[test]
        fn text_without_an_end_never_grows(byte in 0_u8..0x80) {
            let mut decoder = Decoder::default();
            decoder.take(&[byte; 100_000], |_| {});
            prop_assert!(decoder.held_bytes() < TEXT_MAX);
        }
    }
}
