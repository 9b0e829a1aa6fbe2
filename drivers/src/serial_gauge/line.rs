//! Bytes to lines, and lines to readings, each dialect by a strict grammar. Pure; a line is bounded by [`LINE_MAX`].

use crate::error::DecodeError;

/// Longest line: 15 amplifiers of 10 characters, and some.
pub const LINE_MAX: usize = 256;

/// Which device's lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dialect {
    /// Heidenhain ND 221B, 231B, 281B, 287, 52x.
    HeidenhainNd,
    /// Mitutoyo MUX-10, QM-Height, IT-016U.
    Mitutoyo,
    /// Sylvac Opto-RS, and IBR, Bowers, Kaefer.
    SylvacOptoRs,
    /// Keyence IL, IG, IB, GT2 on a DL-RS1A.
    KeyenceDlRs1a,
}

/// One value of a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reading {
    /// A number, in inches where the line says so or the device was configured so.
    Number {
        /// As written.
        value: f64,
        /// The line says that it is in inches.
        inches: bool,
    },
    /// A word that stands for no value, and what it means.
    Absent(&'static str),
}

/// What a line is.
#[derive(Debug, Clone, PartialEq)]
pub enum Line {
    /// One reading of a channel, from 0.
    One(usize, Reading),
    /// Readings of all channels.
    All(Vec<Reading>),
    /// The device refuses a command: its own words.
    Refused(String),
    /// The device has just been switched on.
    SwitchedOn,
    /// Something else that the manual knows, and that says nothing here.
    Aside(String),
}

/// Cuts bytes into lines at CR or LF. Empty lines are none.
#[derive(Debug, Default)]
pub struct Assembler {
    line: Vec<u8>,
    too_long: bool,
}

impl Assembler {
    /// Takes bytes; `each` gets every line that they complete, or why it is none.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Result<&str, DecodeError>)) {
        for &byte in bytes {
            match byte {
                b'\r' | b'\n' => {
                    if self.too_long {
                        each(Err(DecodeError::TooLong {
                            claimed: LINE_MAX as u64 + 1,
                            limit: LINE_MAX,
                        }));
                    } else if !self.line.is_empty() {
                        each(ascii(&self.line));
                    }
                    self.line.clear();
                    self.too_long = false;
                }
                _ if self.line.len() < LINE_MAX => self.line.push(byte),
                _ => self.too_long = true,
            }
        }
    }

    /// Bytes kept for later.
    pub fn held_bytes(&self) -> usize {
        self.line.len()
    }

    /// Forgets a line under way; how many bytes it had.
    pub fn forget(&mut self) -> usize {
        let n = self.line.len();
        self.line.clear();
        self.too_long = false;
        n
    }
}

fn ascii(line: &[u8]) -> Result<&str, DecodeError> {
    let printable = line
        .iter()
        .all(|&b| (0x20..0x7F).contains(&b) || is_control(b));
    match std::str::from_utf8(line) {
        Ok(text) if printable => Ok(text),
        _ => Err(unknown(&String::from_utf8_lossy(line))),
    }
}

/// STX begins some answers; ACK and NAK are answers.
fn is_control(byte: u8) -> bool {
    matches!(byte, 0x02 | 0x06 | 0x15)
}

fn unknown(line: &str) -> DecodeError {
    DecodeError::Line {
        line: line.chars().take(60).collect(),
    }
}

/// Reads one line, without its end.
///
/// # Errors
/// A line that follows no form of the dialect's manual.
pub fn line(dialect: Dialect, text: &str) -> Result<Line, DecodeError> {
    let read = match dialect {
        Dialect::HeidenhainNd => heidenhain(text),
        Dialect::Mitutoyo => mitutoyo(text),
        Dialect::SylvacOptoRs => sylvac(text),
        Dialect::KeyenceDlRs1a => keyence(text),
    };
    read.ok_or_else(|| unknown(text))
}

/// Digits, one point, digits; nothing else.
fn digits(text: &str) -> Option<f64> {
    let (whole, part) = text.split_once('.')?;
    let all = |s: &str| !s.is_empty() && s.bytes().all(|b| b.is_ascii_digit());
    let number = all(whole) && all(part) && text.len() <= 16;
    number.then(|| text.parse().ok()).flatten()
}

fn signed(sign: &str, text: &str) -> Option<f64> {
    let value = digits(text)?;
    match sign {
        "-" => Some(-value),
        "+" | " " => Some(value),
        _ => None,
    }
}

/// ND 2x1B: 15 characters and the end. ND 52x: `X=+  41.29 R`.
fn heidenhain(text: &str) -> Option<Line> {
    if !text.is_ascii() {
        return None;
    }
    match text {
        "\x06" => return Some(Line::Aside("ACK".into())),
        "\x15" => return Some(Line::Refused("NAK".into())),
        _ => {}
    }
    if let Some(said) = text.strip_prefix('\x02') {
        return Some(Line::Aside(said.trim().to_owned()));
    }
    if let [axis, b'='] = text.as_bytes().get(..2)?
        && axis.is_ascii_uppercase()
    {
        let sign = text.get(2..3)?;
        let (number, tail) = text[3..].split_at_checked(text.len().checked_sub(5)?)?;
        let value = signed(sign, number.trim_start_matches(' '))?;
        let inches = match tail.as_bytes() {
            [b' ', b'R' | b'D' | b'r' | b'd'] => false,
            [b'"', b'R' | b'D' | b'r' | b'd'] => true,
            _ => return None,
        };
        return Some(Line::One(0, Reading::Number { value, inches }));
    }
    if text.len() != 15 {
        return None;
    }
    let (sign, number) = (&text[..1], &text[1..11]);
    let [b' ', unit, sorting, series] = text.as_bytes()[11..] else {
        return None;
    };
    let known = b"<>=? ".contains(&sorting) && b"SAGD ".contains(&series);
    let reading = match unit {
        b'?' => Reading::Absent("fault of the measuring system"),
        b' ' | b'"' => Reading::Number {
            value: signed(sign, number.trim_start_matches(' '))?,
            inches: unit == b'"',
        },
        _ => return None,
    };
    known.then_some(Line::One(0, reading))
}

/// `0CA`, sign, eight characters with a point. An error line `91x` is reported by users and by no manual at hand: it is taken
/// for no value.
fn mitutoyo(text: &str) -> Option<Line> {
    if let [b'9', b'1', b'0'..=b'9'] = text.as_bytes() {
        let reading = Reading::Absent("error of the multiplexer or the gauge");
        return Some(Line::One(0, reading));
    }
    let (head, number) = text.split_at_checked(4)?;
    let [b'0', channel @ b'1'..=b'9', b'A', _] = *head.as_bytes() else {
        return None;
    };
    if number.len() != 8 {
        return None;
    }
    let value = signed(&head[3..], number)?;
    let reading = Reading::Number {
        value,
        inches: false,
    };
    Some(Line::One(usize::from(channel - b'1'), reading))
}

fn sylvac(text: &str) -> Option<Line> {
    let reading = match text {
        "OV" => Reading::Absent("out of range"),
        "ERR0" => Reading::Absent("sensor error: moved too fast"),
        "ERR1" | "ERR2" | "ERR3" => return Some(Line::Refused(text.to_owned())),
        _ if text.starts_with("SY") && text.len() == 5 => return Some(Line::SwitchedOn),
        _ if text.starts_with("SY") => return Some(Line::Aside(text.to_owned())),
        _ => {
            let sign = text.get(..1)?;
            let value = signed(sign, &text[1..])?;
            Reading::Number {
                value,
                inches: false,
            }
        }
    };
    Some(Line::One(0, reading))
}

fn keyence(text: &str) -> Option<Line> {
    let (name, rest) = text.split_once(',')?;
    match name {
        "M0" => {
            let readings = rest.split(',').map(keyence_value);
            Some(Line::All(readings.collect::<Option<_>>()?))
        }
        "ER" => Some(Line::Refused(rest.to_owned())),
        "SR" | "SW" | "AW" | "MS" | "DR" => Some(Line::Aside(text.to_owned())),
        _ => None,
    }
}

/// Sign, five digits and a point, wherever the amplifier has it; or a word of the same length.
fn keyence_value(text: &str) -> Option<Reading> {
    if text.len() != 7 && !text.ends_with("FFFFFFF") {
        return None;
    }
    Some(match text {
        "-99.998" | "-999.98" | "-9999.8" => Reading::Absent("not settled yet"),
        "+EE.EEE" | "+EEE.EE" | "+EEEE.E" => Reading::Absent("error of the amplifier"),
        "+FFFFFFF" | "-FFFFFFF" => Reading::Absent("out of range"),
        _ => Reading::Number {
            value: signed(text.get(..1)?, text.get(1..)?)?,
            inches: false,
        },
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn mm(value: f64) -> Reading {
        Reading::Number {
            value,
            inches: false,
        }
    }

    #[test]
    fn golden_lines() {
        let nd = [
            0x2D, 0x20, 0x20, 0x20, 0x20, 0x20, 0x20, 0x35, 0x2E, 0x32, 0x33, 0x20, 0x20, 0x3D,
            0x41, 0x0D, 0x0A,
        ];
        let mut found = Vec::new();
        for piece in 1..=nd.len() {
            let mut assembler = Assembler::default();
            for part in nd.chunks(piece) {
                assembler.take(part, |text| {
                    found.push(line(Dialect::HeidenhainNd, text.expect("text")))
                });
            }
        }
        assert_eq!(found.len(), nd.len());
        assert!(found.iter().all(|l| *l == Ok(Line::One(0, mm(-5.23)))));

        let one = |dialect, text: &str| match line(dialect, text) {
            Ok(Line::One(channel, reading)) => (channel, reading),
            other => panic!("{text:?}: {other:?}"),
        };
        assert_eq!(one(Dialect::HeidenhainNd, "X=+  41.29 R"), (0, mm(41.29)));
        let inches = Reading::Number {
            value: 1.5,
            inches: true,
        };
        assert_eq!(one(Dialect::HeidenhainNd, "+       1.5 \"  "), (0, inches));
        assert!(matches!(
            one(Dialect::HeidenhainNd, "+       1.5 ?  ").1,
            Reading::Absent(_)
        ));
        assert_eq!(one(Dialect::Mitutoyo, "01A-001.2340"), (0, mm(-1.234)));
        assert_eq!(one(Dialect::Mitutoyo, "03A+012.3450"), (2, mm(12.345)));
        assert_eq!(one(Dialect::SylvacOptoRs, "+012.3456"), (0, mm(12.3456)));
        assert!(matches!(
            one(Dialect::SylvacOptoRs, "OV").1,
            Reading::Absent(_)
        ));
        assert!(matches!(
            one(Dialect::SylvacOptoRs, "ERR0").1,
            Reading::Absent(_)
        ));
        assert_eq!(
            line(Dialect::SylvacOptoRs, "ERR1"),
            Ok(Line::Refused("ERR1".into()))
        );
        assert_eq!(line(Dialect::SylvacOptoRs, "SY235"), Ok(Line::SwitchedOn));
        let all = line(Dialect::KeyenceDlRs1a, "M0,+12.345,-99.998,+EE.EEE");
        let Ok(Line::All(all)) = all else {
            panic!("{all:?}");
        };
        assert_eq!(all[0], mm(12.345));
        assert!(all[1..].iter().all(|r| matches!(r, Reading::Absent(_))));
        assert_eq!(
            line(Dialect::KeyenceDlRs1a, "ER,M0,22"),
            Ok(Line::Refused("M0,22".into()))
        );
    }

    #[test]
    fn damaged_lines_are_no_values() {
        for (dialect, sound) in [
            (Dialect::HeidenhainNd, "-      5.23  =A"),
            (Dialect::Mitutoyo, "01A-001.2340"),
        ] {
            assert!(matches!(line(dialect, sound), Ok(Line::One(..))));
            for lost in 0..sound.len() {
                let mut damaged = sound.to_owned();
                damaged.remove(lost);
                assert!(line(dialect, &damaged).is_err(), "{damaged:?}");
            }
        }
        for text in [
            "", "+", "12.3", "+12,3", "+1.2.3", "+1e5", "inf", "NaN", "+.5", "+5.",
        ] {
            assert!(line(Dialect::SylvacOptoRs, text).is_err(), "{text:?}");
        }
        assert!(line(Dialect::KeyenceDlRs1a, "M0,+12.345,").is_err());
        assert!(line(Dialect::KeyenceDlRs1a, "M0,+2.345").is_err());
        assert!(line(Dialect::HeidenhainNd, "-      5.23 µ=").is_err());
    }

    #[test]
    fn a_line_without_end_is_dropped_whole() {
        let mut assembler = Assembler::default();
        assembler.take(&[b'1'; 10_000], |_| panic!("a line"));
        assert_eq!(assembler.held_bytes(), LINE_MAX);
        let mut told = Vec::new();
        assembler.take(b"\rOV\r", |text| told.push(text.map(str::to_owned)));
        assert!(matches!(told[0], Err(DecodeError::TooLong { .. })));
        assert_eq!(told[1].as_deref(), Ok("OV"));
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(7),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_bytes_never_panic_and_never_grow(bytes in prop::collection::vec(any::<u8>(), 0..3000)) {
            let mut assembler = Assembler::default();
            assembler.take(&bytes, |text| {
                for dialect in ALL {
                    if let Ok(text) = text.clone() {
                        let _ = line(dialect, text);
                    }
                }
            });
            prop_assert!(assembler.held_bytes() <= LINE_MAX);
        }

        #[test]
        fn any_text_never_panics(text in "(X=|01A|M0,|SY|ERR|\\+)?[-+ 0-9.,A-Z\"?=µ]{0,20}") {
            for dialect in ALL {
                let _ = line(dialect, &text);
            }
        }
    }

    const ALL: [Dialect; 4] = [
        Dialect::HeidenhainNd,
        Dialect::Mitutoyo,
        Dialect::SylvacOptoRs,
        Dialect::KeyenceDlRs1a,
    ];
}
