//! Lines of I++ DME: bytes in, responses out, each with its tag, its kind and what it says.
//!
//! Source: I++ DME Interface, release 1.4.3, chapters 4 (tags and lines), 6 (methods) and 8 (errors).

use crate::error::DecodeError;

/// Most characters of a line.
pub const LINE_MAX: usize = 65_536;
/// Most levels of parentheses that are followed.
const DEPTH_MAX: usize = 8;

/// Which command or event a line belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tag {
    /// `00001` to `99999`; `00000` stands for none.
    Command(u32),
    /// `E0001` to `E9999`; `E0000` is the server's own.
    Event(u32),
}

impl std::fmt::Display for Tag {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Tag::Command(number) => write!(f, "{number:05}"),
            Tag::Event(number) => write!(f, "E{number:04}"),
        }
    }
}

/// One thing that a data line says.
#[derive(Debug, Clone, PartialEq)]
pub enum Item {
    /// A bare number.
    Number(f64),
    /// A text in quotes, without them.
    Text(String),
    /// A name alone.
    Name(String),
    /// A name, or none, with arguments in parentheses.
    Call(String, Vec<Item>),
}

/// What a server reports as an error.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// 0 information, 1 warning, 2 error, 3 a person is needed, 9 fatal.
    pub severity: u32,
    /// Number of the error.
    pub number: u32,
    /// What caused it.
    pub cause: String,
    /// What it means.
    pub text: String,
}

/// What a line says.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// `&`: the command was taken.
    Ack,
    /// `%`: all that belongs to it was sent.
    Complete,
    /// `#`
    Data(Vec<Item>),
    /// `!`
    Error(Report),
}

/// A line of the server.
#[derive(Debug, Clone, PartialEq)]
pub struct Response {
    /// Which command or event it belongs to.
    pub tag: Tag,
    /// What it says.
    pub kind: Kind,
}

/// Reads one line, without its end.
///
/// # Errors
/// A line that follows no form of the specification.
pub fn response(line: &str) -> Result<Response, DecodeError> {
    read(line).ok_or_else(|| refused(line))
}

fn read(line: &str) -> Option<Response> {
    let tag = tag(line.get(..5)?)?;
    let rest = line.get(5..)?.strip_prefix(' ')?;
    let kind = match (rest.get(..1)?, rest.get(1..)?.trim_end_matches(' ')) {
        ("&", "") => Kind::Ack,
        ("%", "") => Kind::Complete,
        ("#", data) => Kind::Data(items(data.strip_prefix(' ').unwrap_or(data))?),
        ("!", error) => Kind::Error(report(error.trim_start_matches(' '))?),
        _ => return None,
    };
    Some(Response { tag, kind })
}

fn tag(text: &str) -> Option<Tag> {
    let number = |digits: &str| {
        let decimal = digits.bytes().all(|b| b.is_ascii_digit());
        decimal.then(|| digits.parse().ok()).flatten()
    };
    match text.strip_prefix('E') {
        Some(digits) => number(digits).map(Tag::Event),
        None => number(text).map(Tag::Command),
    }
}

/// `Error(F1, F2, F3, Text)`: the last two in quotes.
fn report(text: &str) -> Option<Report> {
    let [Item::Call(name, fields)] = &items(text)?[..] else {
        return None;
    };
    let [Item::Number(severity), Item::Number(number), cause, text] = &fields[..] else {
        return None;
    };
    let whole = |number: f64| {
        let fits = (0.0..=1e6).contains(&number) && number.fract() == 0.0;
        fits.then_some(number as u32)
    };
    Some(Report {
        severity: whole(*severity).filter(|_| name == "Error")?,
        number: whole(*number)?,
        cause: shown(cause),
        text: shown(text),
    })
}

fn shown(item: &Item) -> String {
    match item {
        Item::Number(number) => number.to_string(),
        Item::Text(text) | Item::Name(text) => text.clone(),
        Item::Call(name, _) => name.clone(),
    }
}

/// The items of a list, separated by commas.
fn items(text: &str) -> Option<Vec<Item>> {
    let mut reader = Reader { rest: text };
    let items = reader.list(0)?;
    reader.rest.is_empty().then_some(items)
}

struct Reader<'a> {
    rest: &'a str,
}

impl<'a> Reader<'a> {
    fn spaces(&mut self) {
        self.rest = self.rest.trim_start_matches(' ');
    }

    fn takes(&mut self, sign: char) -> bool {
        self.spaces();
        match self.rest.strip_prefix(sign) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    fn list(&mut self, depth: usize) -> Option<Vec<Item>> {
        let mut items = Vec::new();
        self.spaces();
        if self.rest.is_empty() || self.rest.starts_with(')') {
            return Some(items);
        }
        loop {
            items.push(self.item(depth)?);
            if !self.takes(',') {
                return Some(items);
            }
        }
    }

    fn item(&mut self, depth: usize) -> Option<Item> {
        if self.takes('"') {
            let (text, rest) = self.rest.split_once('"')?;
            self.rest = rest;
            return Some(Item::Text(text.to_owned()));
        }
        let word = self.word();
        if self.rest.starts_with('(') && depth < DEPTH_MAX {
            self.rest = &self.rest[1..];
            let arguments = self.list(depth + 1)?;
            return self
                .takes(')')
                .then(|| Item::Call(word.to_owned(), arguments));
        }
        match word.bytes().next()? {
            b'0'..=b'9' | b'+' | b'-' | b'.' => {
                let number: f64 = word.parse().ok()?;
                number.is_finite().then_some(Item::Number(number))
            }
            b'A'..=b'Z' | b'a'..=b'z' => Some(Item::Name(word.to_owned())),
            _ => None,
        }
    }

    fn word(&mut self) -> &'a str {
        let ends = |c: char| !(c.is_ascii_alphanumeric() || "._+-".contains(c));
        let end = self.rest.find(ends).unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest;
        word
    }
}

/// The numbers in the parentheses of the item of this name, as in `IJK(0,0,1)`.
pub fn numbers_of<const N: usize>(items: &[Item], name: &str) -> Option<[f64; N]> {
    let arguments = items.iter().find_map(|item| match item {
        Item::Call(found, arguments) if found == name => Some(arguments),
        _ => None,
    })?;
    let numbers: Option<Vec<f64>> = arguments.iter().map(number).collect();
    numbers?.try_into().ok()
}

/// The number an item is.
pub fn number(item: &Item) -> Option<f64> {
    match item {
        Item::Number(number) => Some(*number),
        _ => None,
    }
}

fn refused(line: &str) -> DecodeError {
    const SHOWN: usize = 120;
    DecodeError::Line {
        line: line.chars().take(SHOWN).collect(),
    }
}

/// Finds the lines in a stream of bytes that comes in any pieces.
///
/// Holds at most one line of [`LINE_MAX`] characters. A longer one, and one with characters other than 32 to 126, is refused whole.
#[derive(Debug, Default)]
pub struct Decoder {
    held: Vec<u8>,
    /// The line is too long, and what comes up to its end is thrown away.
    overlong: bool,
}

impl Decoder {
    /// Takes `bytes` and calls `each` with every whole line, without its end, and with every line that had to be refused.
    pub fn take(&mut self, bytes: &[u8], mut each: impl FnMut(Result<&str, DecodeError>)) {
        for part in bytes.split_inclusive(|&byte| byte == b'\n') {
            let ends = part.ends_with(b"\n");
            if !self.overlong {
                let room = (LINE_MAX + 2).saturating_sub(self.held.len());
                self.overlong = part.len() > room;
                self.held.extend_from_slice(&part[..part.len().min(room)]);
            }
            if ends {
                each(self.line());
                self.held.clear();
                self.overlong = false;
            }
        }
    }

    fn line(&self) -> Result<&str, DecodeError> {
        if self.overlong {
            return Err(DecodeError::TooLong {
                claimed: self.held.len() as u64 + 1,
                limit: LINE_MAX,
            });
        }
        let line = self.held.strip_suffix(b"\n").unwrap_or(&self.held);
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        match std::str::from_utf8(line) {
            Ok(text) if line.iter().all(|byte| (32..127).contains(byte)) => Ok(text),
            _ => Err(refused(&String::from_utf8_lossy(line))),
        }
    }

    /// Characters of a line that has not ended.
    pub fn held_bytes(&self) -> usize {
        self.held.len()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    use super::*;

    fn data(line: &str) -> Vec<Item> {
        match response(line).expect("a response").kind {
            Kind::Data(items) => items,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn golden_lines_of_the_logs() {
        assert_eq!(response("00080 &").expect("an ack").kind, Kind::Ack);
        assert_eq!(response("E0060 %").expect("an end").tag, Tag::Event(60));
        let items =
            data("00080 # IJK(0.00000,0.00000,1.00000), X(3.06205), Y(-24.26795), Z(32.73005)");
        assert_eq!(numbers_of(&items, "IJK"), Some([0.0, 0.0, 1.0]));
        assert_eq!(numbers_of(&items, "Y"), Some([-24.26795]));
        let items = data("E0060 # X(0.35011), Y(0.70022), Z(1.05034)");
        assert_eq!(numbers_of(&items, "Z"), Some([1.05034]));
        let items = data("00010 # 0.00000,2.00385,2.00385,2.00385,0.00000,2.03464");
        let numbers: Vec<f64> = items.iter().filter_map(number).collect();
        assert_eq!(numbers, [0.0, 2.00385, 2.00385, 2.00385, 0.0, 2.03464]);
        let error = response(
            "00010 ! Error(3, 1008, \"00010 GoTo(X(10000000)) : GoTo: TARGET POINT OUT OF WORK VOLUME\", \"Target position out of machine volume\")",
        );
        let Kind::Error(report) = error.expect("an error").kind else {
            panic!("no error");
        };
        assert_eq!((report.severity, report.number), (3, 1008));
        assert_eq!(report.text, "Target position out of machine volume");
    }

    #[test]
    fn other_forms_of_the_specification() {
        assert_eq!(data("00002 # \"Speed.Min\", \"Number\"").len(), 2);
        assert_eq!(
            data("00002 # (1, 2, 3)"),
            [Item::Call(
                String::new(),
                vec![Item::Number(1.0), Item::Number(2.0), Item::Number(3.0)]
            )]
        );
        let items = data("00002 # CoordSystem(PartCsy)");
        assert_eq!(
            items,
            [Item::Call(
                "CoordSystem".into(),
                vec![Item::Name("PartCsy".into())]
            )]
        );
        assert_eq!(data("00002 #"), []);
        assert_eq!(
            data("00002 # X(-2.6E01)"),
            [Item::Call("X".into(), vec![Item::Number(-26.0)])]
        );
        for wrong in [
            "",
            "0001",
            "00001",
            "00001&",
            "00001 ",
            "00001 ?",
            "0000A &",
            "E00001 &",
            "00001 & x",
            "00001 # X(",
            "00001 # X(1))",
            "00001 # \"open",
            "00001 # 1,",
            "00001 # 1e999",
            "00001 ! Error(1)",
            "00001 ! Fault(1, 2, \"\", \"\")",
            "00001 # ((((((((((1))))))))))",
        ] {
            let error = response(wrong).expect_err("no response").to_string();
            assert!(
                error.ends_with("is none the controller may send"),
                "{error}"
            );
        }
    }

    #[test]
    fn split_at_every_byte_and_overlong() {
        let mut stream = b"00080 &\r\n00080 # X(1)\r\n\x07\r\n".to_vec();
        stream.extend(vec![b'x'; LINE_MAX + 9]);
        stream.extend(b"\r\n00080 %\r\n");
        for cut in (0..40).chain([LINE_MAX, LINE_MAX + 30, stream.len() - 3]) {
            let (mut decoder, mut lines) = (Decoder::default(), Vec::new());
            for part in [&stream[..cut], &stream[cut..]] {
                decoder.take(part, |line| {
                    lines.push(line.map(str::to_owned).map_err(|e| e.to_string()))
                });
                assert!(decoder.held_bytes() <= LINE_MAX + 2);
            }
            assert_eq!(lines.len(), 5, "cut at {cut}");
            assert_eq!(lines[1].as_deref(), Ok("00080 # X(1)"));
            assert!(lines[2].is_err());
            let told = lines[3].as_ref().expect_err("an overlong line");
            assert_eq!(told, "frame says 65539 bytes, at most 65536 are allowed");
            assert_eq!(lines[4].as_deref(), Ok("00080 %"));
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            rng_seed: RngSeed::Fixed(22),
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        #[test]
        fn any_line_is_read_or_refused(rest in "[ -~]{0,200}", kind in "[&%#!]") {
            let _ = response(&format!("00001 {kind} {rest}"));
            let _ = response(&rest);
        }

        #[test]
        fn lists_come_back(numbers in prop::collection::vec(-1e6..1e6_f64, 1..50)) {
            let text: Vec<String> = numbers.iter().map(|n| format!("{n:.5}")).collect();
            let found = data(&format!("00001 # {}", text.join(", ")));
            prop_assert_eq!(found.len(), numbers.len());
            for (item, expected) in found.iter().zip(&numbers) {
                // Five digits behind the point were written.
                prop_assert!((number(item).expect("a number") - expected).abs() <= 0.5e-5 + 1e-9);
            }
        }
    }
}
