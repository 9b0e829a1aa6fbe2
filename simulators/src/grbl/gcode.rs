//! One block of G-code: words, modes, and GRBL's error numbers for what it cannot read.

/// GRBL's numbers of the errors played here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum GrblError {
    ExpectedLetter = 1,
    BadNumber = 2,
    UnknownSystemCommand = 3,
    HomingNotEnabled = 5,
    Locked = 9,
    LineTooLong = 14,
    UnsupportedCommand = 20,
    ModalConflict = 21,
    NoFeedRate = 22,
    NoAxisWords = 26,
    UnusedWords = 36,
    InvalidTarget = 33,
}

/// What a block asks the machine to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    Rapid,
    Feed,
    Probe { must_touch: bool, away: bool },
}

/// Modes that stay from block to block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Modes {
    pub motion: Motion,
    pub inch: bool,
    pub incremental: bool,
    /// mm a minute.
    pub feed: f64,
}

impl Default for Modes {
    fn default() -> Modes {
        Modes {
            motion: Motion::Rapid,
            inch: false,
            incremental: false,
            feed: 0.0,
        }
    }
}

/// A block that can be run: new modes, and axis words in mm where there are any.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Block {
    pub modes: Modes,
    pub axes: [Option<f64>; 3],
}

/// Reads a block.
pub(super) fn parse(line: &str, modes: Modes) -> Result<Block, GrblError> {
    let mut block = Block {
        modes,
        axes: [None; 3],
    };
    let mut motion_given = false;
    for (letter, number) in words(line)? {
        let scale = |inch: bool| if inch { 25.4 } else { 1.0 };
        match letter {
            'G' => match (number * 10.0).round() as i32 {
                200 => block.modes.inch = true,
                210 => block.modes.inch = false,
                900 => block.modes.incremental = false,
                910 => block.modes.incremental = true,
                // plane, work offset, feed per minute, exact path, machine coordinates: what it does anyway
                170 | 540 | 940 | 610 | 530 | 400 | 490 => {}
                code => {
                    if motion_given {
                        return Err(GrblError::ModalConflict);
                    }
                    motion_given = true;
                    block.modes.motion = match code {
                        0 => Motion::Rapid,
                        10 => Motion::Feed,
                        382..=385 => Motion::Probe {
                            must_touch: code % 2 == 0,
                            away: code >= 384,
                        },
                        _ => return Err(GrblError::UnsupportedCommand),
                    };
                }
            },
            'X' | 'Y' | 'Z' => block.axes[letter as usize - 'X' as usize] = Some(number),
            'F' => block.modes.feed = number * scale(block.modes.inch),
            'M' if [3.0, 5.0, 9.0].contains(&number) => {}
            'N' | 'S' | 'T' => {}
            'M' => return Err(GrblError::UnsupportedCommand),
            _ => return Err(GrblError::UnusedWords),
        }
    }
    if block.modes.inch {
        block.axes = block.axes.map(|a| a.map(|a| a * 25.4));
    }
    let moves = block.axes.iter().any(Option::is_some);
    let probes = matches!(block.modes.motion, Motion::Probe { .. });
    if probes && motion_given && !moves {
        return Err(GrblError::NoAxisWords);
    }
    if moves && block.modes.motion != Motion::Rapid && block.modes.feed <= 0.0 {
        return Err(GrblError::NoFeedRate);
    }
    Ok(block)
}

/// Letters with their numbers; comments and blanks are no part of it.
fn words(line: &str) -> Result<Vec<(char, f64)>, GrblError> {
    let mut plain = String::new();
    let mut comment = false;
    for c in line.chars() {
        match c {
            ';' => break,
            '(' => comment = true,
            ')' => comment = false,
            c if !comment && !c.is_whitespace() => plain.push(c.to_ascii_uppercase()),
            _ => {}
        }
    }
    let mut words = Vec::new();
    let mut rest = plain.as_str();
    while let Some(letter) = rest.chars().next() {
        if !letter.is_ascii_uppercase() {
            return Err(GrblError::ExpectedLetter);
        }
        let tail = &rest[1..];
        let end = tail
            .find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c)))
            .unwrap_or(tail.len());
        let number = tail[..end].parse().map_err(|_| GrblError::BadNumber)?;
        words.push((letter, number));
        rest = &tail[end..];
    }
    Ok(words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_set_modes_and_targets() {
        let block = parse("g21 G90 (fast) G38.2 Z-10.5 F100 ; down", Modes::default()).unwrap();
        assert_eq!(block.axes, [None, None, Some(-10.5)]);
        let probing = Motion::Probe {
            must_touch: true,
            away: false,
        };
        assert_eq!(block.modes.motion, probing);
        assert_eq!(block.modes.feed, 100.0);
        let inch = parse("G20G0X1Y-2", Modes::default()).unwrap();
        assert_eq!(inch.axes, [Some(25.4), Some(-50.8), None]);
    }

    #[test]
    fn what_cannot_be_read_has_grbls_number() {
        let error = |line: &str| parse(line, Modes::default()).unwrap_err() as u8;
        assert_eq!(error("10X"), 1);
        assert_eq!(error("GX"), 2);
        assert_eq!(error("G2 X1"), 20);
        assert_eq!(error("G0 G1 X1"), 21);
        assert_eq!(error("G38.2 Z-1"), 22);
        assert_eq!(error("G38.2 F10"), 26);
        assert_eq!(error("Q5"), 36);
    }
}
