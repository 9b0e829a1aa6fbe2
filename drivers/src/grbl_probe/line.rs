//! Lines of a GRBL controller: an assembler of bytes into lines, and a strict reader of each.
//!
//! Source: Grbl 1.1, *Grbl Interface Basics* (response messages, push messages). Machines with 3 to 6 axes.

use crate::error::DecodeError;

/// Longest line kept. The longest that Grbl sends, a status report with all fields, has about 150 characters.
const LENGTH_MAX: usize = 256;

/// Most axes that a build reports.
const AXES_MAX: usize = 6;

/// What one line says.
#[derive(Debug, Clone, PartialEq)]
pub enum Line<'a> {
    /// `ok`: the command was taken.
    Ok,
    /// `error:N`: the command was refused.
    Error(u32),
    /// `ALARM:N`: the machine stopped and is locked.
    Alarm(u32),
    /// `[PRB:x,y,z:s]`: where a probe cycle ended.
    Probe(Probe),
    /// `[G54:x,y,z]` and its like: an offset, by its name.
    Offset(&'a str, [f64; 3]),
    /// `[TLO:z]`: the tool length offset.
    ToolLength(f64),
    /// `[GC:...]`: the words of the parser's state.
    ParserState(&'a str),
    /// `[VER:version:text]`: firmware and the text that its owner wrote with `$I=`.
    Version(&'a str, &'a str),
    /// `$n=value`: a setting.
    Setting(u32, &'a str),
    /// `<...>`: a status report.
    Status(&'a str),
    /// `Grbl 1.1h ['$' for help]`: the controller has just started.
    Banner(&'a str),
    /// `[MSG:...]`, another `[...]`, a start-up line or nothing: for people.
    Note(&'a str),
}

/// Where a probe cycle ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probe {
    /// First three axes, in the controller's report unit, machine axes.
    pub position: [f64; 3],
    /// The probe met something.
    pub contact: bool,
}

/// Reads one line, without its end.
///
/// # Errors
/// [`DecodeError::Line`] when it follows no form of the manual, such as one into which another was mixed.
pub fn line(text: &str) -> Result<Line<'_>, DecodeError> {
    read(text).ok_or_else(|| DecodeError::Line {
        line: text.chars().take(80).collect(),
    })
}

fn read(text: &str) -> Option<Line<'_>> {
    if let Some(inner) = enclosed(text, '[', ']') {
        return bracket(inner);
    }
    if let Some(inner) = enclosed(text, '<', '>') {
        return Some(Line::Status(inner));
    }
    if let Some(setting) = text.strip_prefix('$') {
        let (number, value) = setting.split_once('=')?;
        return match whole(number) {
            Some(number) => Some(Line::Setting(number, value)),
            None => number.starts_with('N').then_some(Line::Note(text)),
        };
    }
    match text {
        "ok" => Some(Line::Ok),
        "" => Some(Line::Note(text)),
        _ if text.starts_with('>') => Some(Line::Note(text)),
        _ if text.to_ascii_lowercase().starts_with("grbl") => Some(Line::Banner(text)),
        _ => {
            let (word, number) = text.split_once(':')?;
            match word {
                "error" => Some(Line::Error(whole(number)?)),
                "ALARM" => Some(Line::Alarm(whole(number)?)),
                _ => None,
            }
        }
    }
}

/// What stands between `open` at the start and `close` at the end, where neither occurs inside.
fn enclosed(text: &str, open: char, close: char) -> Option<&str> {
    let inner = text.strip_prefix(open)?.strip_suffix(close)?;
    (!inner.contains(open)).then_some(inner)
}

fn bracket(inner: &str) -> Option<Line<'_>> {
    let (word, rest) = inner.split_once(':')?;
    match word {
        "PRB" => {
            let (position, contact) = rest.split_once(':')?;
            let contact = match contact {
                "0" => false,
                "1" => true,
                _ => return None,
            };
            let position = coordinates(position)?;
            Some(Line::Probe(Probe { position, contact }))
        }
        "G54" | "G55" | "G56" | "G57" | "G58" | "G59" | "G28" | "G30" | "G92" => {
            Some(Line::Offset(word, coordinates(rest)?))
        }
        // grblHAL gives one value an axis; the third is the tool's length along z.
        "TLO" => match rest.split(',').count() {
            1 => decimal(rest).map(Line::ToolLength),
            _ => coordinates(rest).map(|axes| Line::ToolLength(axes[2])),
        },
        "GC" => Some(Line::ParserState(rest)),
        "VER" => {
            let (version, owner) = rest.split_once(':').unwrap_or((rest, ""));
            Some(Line::Version(version, owner))
        }
        _ => Some(Line::Note(inner)),
    }
}

/// The first three of 3 to 6 coordinates.
fn coordinates(text: &str) -> Option<[f64; 3]> {
    let axes: Vec<f64> = text
        .split(',')
        .take(AXES_MAX + 1)
        .map(decimal)
        .collect::<Option<_>>()?;
    match axes[..] {
        [x, y, z, ..] if axes.len() <= AXES_MAX => Some([x, y, z]),
        _ => None,
    }
}

/// `-12.345`: an optional minus, 1 to 7 digits, a point, 1 to 6 digits.
fn decimal(text: &str) -> Option<f64> {
    let (whole, part) = text.strip_prefix('-').unwrap_or(text).split_once('.')?;
    let digits = |digits: &str, most| {
        (1..=most).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit())
    };
    if digits(whole, 7) && digits(part, 6) {
        text.parse().ok()
    } else {
        None
    }
}

fn whole(text: &str) -> Option<u32> {
    let digits = (1..=5).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    digits.then(|| text.parse().ok()).flatten()
}

/// Cuts a stream of bytes into lines, whatever pieces it comes in. Holds one line.
#[derive(Debug, Default)]
pub struct Assembler {
    held: Vec<u8>,
    /// The line is too long or not ASCII: it is dropped at its end.
    bad: bool,
}

impl Assembler {
    /// Takes `bytes` and calls `each` with every line that ends in them; a line that no controller sends is an error.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Result<Line<'_>, DecodeError>)) {
        for &byte in bytes {
            match byte {
                b'\n' | b'\r' => self.end(&mut each),
                b' '..=b'~' if self.held.len() < LENGTH_MAX => self.held.push(byte),
                _ => self.bad = true,
            }
        }
    }

    fn end(&mut self, each: &mut impl FnMut(Result<Line<'_>, DecodeError>)) {
        let text = String::from_utf8_lossy(&self.held);
        if self.bad {
            each(Err(DecodeError::Line {
                line: text.chars().take(80).collect(),
            }));
        } else if !text.is_empty() {
            each(line(&text));
        }
        self.held.clear();
        self.bad = false;
    }

    /// Bytes of a line that has not ended yet.
    pub fn held_bytes(&self) -> usize {
        self.held.len()
    }
}

/// What an alarm means and what to do, from the manual's table.
pub fn alarm(code: u32) -> (&'static str, &'static str) {
    const HOME: &str = "free the axes, home the machine, then reopen it";
    const UNLOCK: &str =
        "see that the tip is free, then reopen with `unlock_on_open = true` or send $X";
    match code {
        1 => (
            "a limit switch was hit, the position is probably lost",
            HOME,
        ),
        2 => ("the target lies outside the machine's travel", UNLOCK),
        3 => ("it was reset while moving, the position is lost", HOME),
        4 => (
            "the probe was in contact before the move",
            "move the tip away from the part, check the probe's wiring and $6, then send $X and reopen it",
        ),
        5 => ("the probe met nothing", UNLOCK),
        6..=9 => (
            "homing failed",
            "check the limit switches, home the machine, then reopen it",
        ),
        10.. => (
            "an alarm this program does not know",
            "see the controller's manual, then reopen it",
        ),
        0 => (
            "no reason given",
            "see the controller's manual, then reopen it",
        ),
    }
}

/// What an error number means, from the manual's table.
pub fn error(code: u32) -> &'static str {
    match code {
        1 => "a letter was expected",
        2 => "a number is malformed",
        3 => "this $ command is unknown",
        4 => "a positive value was expected",
        5 => "homing is not enabled",
        7 => "its memory failed and was reset to defaults",
        8 => "only possible when idle",
        9 => "locked by an alarm",
        10 => "soft limits need homing",
        11 => "line too long",
        13 => "the safety door is open",
        15 => "the target is outside the machine's travel",
        20 => "this G-code is not supported",
        22 => "no feed rate",
        33 => "the target is invalid, or the tip is there already",
        36 => "words left over",
        _ => "see the controller's manual",
    }
}

/// What to do about an error number.
pub fn error_remedy(code: u32) -> &'static str {
    match code {
        9 => "remove the cause, then reopen with `unlock_on_open = true`, or send $H or $X",
        13 => "close the safety door, then start again",
        15 => "choose a target within the machine's travel",
        33 => "choose a target away from the start",
        _ => "check the controller's firmware and settings",
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn probe(x: f64, y: f64, z: f64, contact: bool) -> Line<'static> {
        Line::Probe(Probe {
            position: [x, y, z],
            contact,
        })
    }

    #[test]
    fn lines_of_the_manual() {
        let check = |text, expected| assert_eq!(line(text), Ok(expected), "{text}");
        check("ok", Line::Ok);
        check("error:9", Line::Error(9));
        check("ALARM:5", Line::Alarm(5));
        check("$13=0", Line::Setting(13, "0"));
        check("$110=500.000", Line::Setting(110, "500.000"));
        check("$N0=G54", Line::Note("$N0=G54"));
        check(">G54G20:ok", Line::Note(">G54G20:ok"));
        check(
            "[MSG:'$H'|'$X' to unlock]",
            Line::Note("MSG:'$H'|'$X' to unlock"),
        );
        check("[VER:1.1h.20190825:]", Line::Version("1.1h.20190825", ""));
        check(
            "[VER:1.1f.20170801:Some string]",
            Line::Version("1.1f.20170801", "Some string"),
        );
        check("[GC:G0 G54 G17]", Line::ParserState("G0 G54 G17"));
        check(
            "[G92:1.000,-2.000,0.500]",
            Line::Offset("G92", [1.0, -2.0, 0.5]),
        );
        check("[TLO:0.000]", Line::ToolLength(0.0));
        check("[TLO:0.000,0.000,3.500]", Line::ToolLength(3.5));
        check(
            "<Idle|MPos:0.000,0.000,0.000|FS:0,0>",
            Line::Status("Idle|MPos:0.000,0.000,0.000|FS:0,0"),
        );
        check(
            "Grbl 1.1h ['$' for help]",
            Line::Banner("Grbl 1.1h ['$' for help]"),
        );
        check(
            "GrblHAL 1.1f ['$' or '$HELP' for help]",
            Line::Banner("GrblHAL 1.1f ['$' or '$HELP' for help]"),
        );
        check("[PRB:0.000,0.000,1.492:1]", probe(0.0, 0.0, 1.492, true));
        // Six axes, as ioSender's users report them.
        check(
            "[PRB:87.504,13.055,-41.232,0.000,0.000,0.000:0]",
            probe(87.504, 13.055, -41.232, false),
        );
    }

    #[test]
    fn damaged_lines_are_refused() {
        for text in [
            // Seen by users of Universal G-code Sender: a status report fell into a result.
            "[PRB:-488.000,-498.000]>:-48",
            "[PRB:-488.000,<Idle|MPos:0.000,0.000,0.000>-498.000,1.000:1]",
            "[PRB:1.000,2.000:1]",
            "[PRB:1.000,2.000,3.000]",
            "[PRB:1.000,2.000,3.000:2]",
            "[PRB:1.000,2.000,3.000:1",
            "[PRB:1.000,2.000,3:1]",
            "[PRB:1.000,2.000,3.0e5:1]",
            "[PRB:1.000,2.000,nan:1]",
            "[PRB:1.000,2.000,+3.000:1]",
            "[PRB:1.000,,3.000:1]",
            "[PRB:1.000,2.000,3.000,4.0,5.0,6.0,7.0:1]",
            "[PRB:1.000,2.000,3.000:1[PRB:1.000,2.000,3.000:1]]",
            "[PRB:12345678.000,2.000,3.000:1]",
            "ALARM:",
            "error:-1",
            "error:123456",
            "okok",
            "o",
            "$13",
            "<Idle",
            "[]",
            "\u{17f}rbl",
        ] {
            assert!(line(text).is_err(), "{text}");
        }
        let error = line("[PRB:-488.000,-498.000]>:-48").expect_err("a damaged line");
        assert_eq!(
            error.to_string(),
            "the line \"[PRB:-488.000,-498.000]>:-48\" is none the controller may send"
        );
    }

    fn assemble(assembler: &mut Assembler, bytes: &[u8]) -> Vec<String> {
        let mut lines = Vec::new();
        assembler.take(bytes, |line| lines.push(format!("{line:?}")));
        lines
    }

    #[test]
    fn split_at_every_byte() {
        let stream = b"\r\nGrbl 1.1h ['$' for help]\r\n[PRB:1.000,2.000,3.000:1]\r\nok\r\n";
        let whole = assemble(&mut Assembler::default(), stream);
        assert_eq!(whole.len(), 3);
        for cut in 0..=stream.len() {
            let mut assembler = Assembler::default();
            let mut parts = assemble(&mut assembler, &stream[..cut]);
            parts.extend(assemble(&mut assembler, &stream[cut..]));
            assert_eq!(parts, whole, "cut at {cut}");
        }
    }

    #[test]
    fn a_line_without_end_is_dropped_whole() {
        let mut assembler = Assembler::default();
        assert!(assemble(&mut assembler, &[b'x'; 100_000]).is_empty());
        assert_eq!(assembler.held_bytes(), LENGTH_MAX);
        let lines = assemble(&mut assembler, b"ok\r\nok\r\n");
        assert_eq!(lines.len(), 2);
        assert!(lines[0].starts_with("Err("), "{}", lines[0]);
        assert_eq!(lines[1], "Ok(Ok)");
    }

    #[test]
    fn bytes_that_are_no_text_spoil_one_line() {
        let lines = assemble(&mut Assembler::default(), b"o\xFFk\nok\n");
        assert!(lines[0].starts_with("Err("));
        assert_eq!(lines[1], "Ok(Ok)");
    }

    #[test]
    fn alarms_and_errors_have_words() {
        for code in 0..12 {
            let (meaning, remedy) = alarm(code);
            assert!(!meaning.is_empty() && !remedy.is_empty());
        }
        assert_eq!(alarm(5).0, "the probe met nothing");
        assert_eq!(error(9), "locked by an alarm");
        assert_eq!(
            error_remedy(15),
            "choose a target within the machine's travel"
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(7),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn results_survive_the_round_trip(
            position in prop::array::uniform3(-9_999_999_i32..=9_999_999),
            more in 0_usize..=3,
            contact: bool,
        ) {
            let mm = position.map(|thousandths| f64::from(thousandths) / 1000.0);
            let mut text = format!("[PRB:{:.3},{:.3},{:.3}", mm[0], mm[1], mm[2]);
            text.push_str(&",0.000".repeat(more));
            text.push_str(&format!(":{}]", u8::from(contact)));
            prop_assert_eq!(line(&text), Ok(probe(mm[0], mm[1], mm[2], contact)));
        }

        #[test]
        fn any_bytes_never_panic_and_never_grow(bytes in prop::collection::vec(any::<u8>(), 0..3000)) {
            let mut assembler = Assembler::default();
            assembler.take(&bytes, |_| {});
            prop_assert!(assembler.held_bytes() <= LENGTH_MAX);
        }

        #[test]
        fn any_text_never_panics(text in "[\\[<$]?(PRB|ALARM|error|G54|ok|TLO)?[:.,0-9a-z\\]>-]{0,40}") {
            let _ = line(&text);
        }
    }
}
