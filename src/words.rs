//! The one table of texts, German and English: what people read of what the program says.
//!
//! The table is `words/texts.json`; the page reads the same file. Sentences that travel inside results and messages are English,
//! in their stable form; a sentence is told in another language by the row `said.*` that it was made from, so that results
//! that were stored long ago are read in either language too. What the table does not know came from outside (a device, the
//! system, a person) and stays as it is.
//!
//! In a row `said.*` a place `{said.name}` holds a sentence or its part, which is told in its turn, `{number.name}` a number, and
//! `{name}` what is the same in every language: names, paths.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

/// The table: language, key, text.
type Texts = BTreeMap<String, BTreeMap<String, String>>;

static TEXTS: LazyLock<Texts> = LazyLock::new(|| {
    serde_json::from_str(include_str!("words/texts.json")).expect("texts by language and key")
});

static SENTENCES: LazyLock<Vec<Sentence>> = LazyLock::new(|| {
    let rows = TEXTS["en"].iter();
    let mut all: Vec<Sentence> = rows
        .filter(|(key, _)| key.starts_with("said."))
        .map(|(key, text)| Sentence::new(key, text))
        .collect();
    // The row that says most of itself is the one that was meant.
    all.sort_by(|a, b| b.own.cmp(&a.own).then(a.key.cmp(b.key)));
    all
});

/// Longer than any sentence of the program: what is longer came from outside.
const LONGEST: usize = 2_000;

/// A language that the table has.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    Serialize,
    Deserialize,
    clap::ValueEnum,
    utoipa::ToSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Language {
    /// English.
    #[default]
    En,
    /// German.
    De,
}

impl Language {
    /// All of them.
    pub const ALL: [Language; 2] = [Language::En, Language::De];

    /// Its code of ISO 639-1, as the attribute `lang` has it.
    pub fn code(self) -> &'static str {
        match self {
            Language::En => "en",
            Language::De => "de",
        }
    }

    /// The text of `key`; the key itself where there is none, which a test forbids.
    pub fn text(self, key: &str) -> &str {
        TEXTS[self.code()].get(key).map_or(key, String::as_str)
    }

    /// The text of `key` with its {names} filled in.
    pub fn fill(self, key: &str, values: &[(&str, &str)]) -> String {
        filled(self.text(key), |name| {
            let mut given = values.iter().filter(|(known, _)| *known == name);
            given.next().map_or("", |(_, value)| value)
        })
    }

    /// A number that was written with a decimal point, with the decimal sign of the language.
    pub fn number(self, text: &str) -> String {
        text.replace('.', self.text("decimal"))
    }

    /// What the program says in English, in this language, line by line; what is not the program's stays as it is.
    pub fn said(self, english: &str) -> String {
        if self == Language::En {
            return english.to_owned();
        }
        let lines = english.split('\n').map(|line| {
            let told = (line.len() <= LONGEST).then(|| self.told(line)).flatten();
            told.unwrap_or_else(|| line.to_owned())
        });
        lines.collect::<Vec<_>>().join("\n")
    }

    /// `None` where nothing of it is known. Every part is looked at once: no text makes this slow.
    fn told(self, text: &str) -> Option<String> {
        if let Some(sentences) = joined(text) {
            let told: Vec<String> = sentences.iter().map(|known| self.retold(known)).collect();
            return Some(told.join("; "));
        }
        match Known::of(text) {
            Some(known) => Some(self.retold(&known)),
            None => self.pieces(text),
        }
    }

    fn retold(self, known: &Known<'_>) -> String {
        filled(self.text(known.sentence.key), |name| {
            let names = &known.sentence.names;
            let index = names.iter().position(|own| *own == name);
            let value = index.map_or("", |index| known.values[index]);
            if name.starts_with("said.") {
                self.told(value).unwrap_or_else(|| value.to_owned())
            } else if name.starts_with("number.") {
                self.number(value)
            } else {
                value.to_owned()
            }
        })
    }

    /// Of a text of which only parts are known: first where its front is, then where only its rest is.
    fn pieces(self, text: &str) -> Option<String> {
        let cuts = || {
            let all = text.char_indices();
            all.filter_map(|(at, _)| {
                let mut known = SEPARATORS.iter();
                known
                    .find(|separator| text[at..].starts_with(**separator))
                    .map(|separator| (&text[..at], *separator, &text[at + separator.len()..]))
            })
        };
        for (front, separator, rest) in cuts() {
            if let Some(front) = Known::of(front) {
                let rest = self.told(rest).unwrap_or_else(|| rest.to_owned());
                return Some(self.retold(&front) + separator + &rest);
            }
        }
        let (front, separator, rest) = cuts().next()?;
        Some(front.to_owned() + separator + &self.told(rest)?)
    }
}

/// Two sentences or more with semicolons between them, all of them known.
fn joined(text: &str) -> Option<Vec<Known<'_>>> {
    let mut sentences = Vec::new();
    let mut rest = text;
    while let Some((known, after)) = rest
        .match_indices("; ")
        .find_map(|(at, between)| Some((Known::of(&rest[..at])?, &rest[at + between.len()..])))
    {
        sentences.push(known);
        rest = after;
    }
    if sentences.is_empty() {
        return None;
    }
    sentences.push(Known::of(rest)?);
    Some(sentences)
}

/// A sentence of the table, and what stands in its places.
struct Known<'a> {
    sentence: &'static Sentence,
    values: Vec<&'a str>,
}

impl<'a> Known<'a> {
    fn of(text: &'a str) -> Option<Self> {
        SENTENCES.iter().find_map(|sentence| {
            let values = sentence.values(text)?;
            Some(Self { sentence, values })
        })
    }
}

/// What stands between sentences that were joined.
const SEPARATORS: [&str; 3] = ["; ", ": ", ", "];

fn filled<S: AsRef<str>>(text: &str, mut value: impl FnMut(&str) -> S) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('{') {
        let Some((name, after)) = after.split_once('}') else {
            break;
        };
        out.push_str(before);
        out.push_str(value(name).as_ref());
        rest = after;
    }
    out + rest
}

/// A row of the table that is recognised.
struct Sentence {
    key: &'static str,
    /// What stands before, between and behind the places to fill: one more than these.
    parts: Vec<&'static str>,
    names: Vec<&'static str>,
    /// Length of the parts together.
    own: usize,
}

impl Sentence {
    fn new(key: &'static str, text: &'static str) -> Self {
        let mut pieces = text.split('{');
        let mut parts = vec![pieces.next().unwrap_or_default()];
        let mut names = Vec::new();
        for piece in pieces {
            let (name, part) = piece.split_once('}').unwrap_or((piece, ""));
            names.push(name);
            parts.push(part);
        }
        let own = parts.iter().map(|part| part.len()).sum();
        Self {
            key,
            parts,
            names,
            own,
        }
    }

    /// What stands in the places to fill, where `text` is this sentence.
    fn values<'a>(&self, text: &'a str) -> Option<Vec<&'a str>> {
        let rest = text.strip_prefix(self.parts[0])?;
        let mut values = Vec::with_capacity(self.names.len());
        taken(&self.names, &self.parts[1..], rest, &mut values).then_some(values)
    }
}

/// Takes from `text` the shortest values, none of them empty, between the parts; a number is one.
fn taken<'a>(names: &[&str], parts: &[&str], text: &'a str, values: &mut Vec<&'a str>) -> bool {
    let (Some((name, names)), Some((part, parts))) = (names.split_first(), parts.split_first())
    else {
        return text.is_empty();
    };
    let fits =
        |value: &str| !value.is_empty() && (!name.starts_with("number.") || is_number(value));
    if parts.is_empty() {
        let value = text.strip_suffix(part).filter(|value| fits(value));
        values.extend(value);
        return value.is_some();
    }
    for (at, _) in text.match_indices(part) {
        if !fits(&text[..at]) {
            continue;
        }
        values.push(&text[..at]);
        if taken(names, parts, &text[at + part.len()..], values) {
            return true;
        }
        values.pop();
    }
    false
}

/// Digits with or without a sign and a decimal point.
fn is_number(text: &str) -> bool {
    let digits = text.strip_prefix(['-', '+', '−']).unwrap_or(text);
    let mut parts = digits.splitn(2, '.');
    let whole = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    parts.all(whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sentence_is_told_in_german_with_what_was_filled_in() {
        let told = |english: &str| Language::De.said(english);
        assert_eq!(
            told("no points on either flank"),
            "keine Punkte auf beiden Flanken"
        );
        assert_eq!(
            told("boundary: only flank 1 (face #12) was seen, no points on flank 2 (face #7)"),
            "Rand: nur Flanke 1 (Fläche #12) wurde erfasst, keine Punkte auf Flanke 2 (Fläche #7)"
        );
        assert_eq!(
            told("flank 1 (face #12): no points; flank 2 (face #7): 3 points, 8 needed"),
            "Flanke 1 (Fläche #12): keine Punkte; Flanke 2 (Fläche #7): 3 Punkte, nötig sind 8"
        );
        assert_eq!(
            told(
                "flank 2 (face #7): points only 0.120 to 0.480 mm from the edge, too short a reach to extrapolate"
            ),
            "Flanke 2 (Fläche #7): Punkte nur 0,120 bis 0,480 mm von der Kante, zu kurz zum Extrapolieren"
        );
        assert_eq!(
            told(
                "a limit of the edge radius lies inside its uncertainty; a limit of d1 lies inside its uncertainty"
            ),
            "eine Grenze liegt innerhalb der Messunsicherheit: Kantenradius; eine Grenze liegt innerhalb der Messunsicherheit: d1"
        );
    }

    #[test]
    fn what_came_from_outside_stays() {
        let told = |english: &str| Language::De.said(english);
        assert_eq!(told("Ober: unter; wasser"), "Ober: unter; wasser");
        assert_eq!(
            told("device \"left\": /dev/ttyUSB0: no such file; look at the cable"),
            "Gerät „left“: /dev/ttyUSB0: no such file; look at the cable"
        );
        assert_eq!(
            told("the cell is not ready: halted by Ada; Bob: 3.5"),
            "die Zelle ist nicht bereit: stillgesetzt von Ada; Bob: 3.5"
        );
        assert_eq!(
            told("this Idempotency-Key belongs to inspection 4 of part \"1.5 edges\""),
            "dieser Idempotency-Key gehört zu Prüfung 4 des Teils „1.5 edges“"
        );
        let long = "no points; ".repeat(400);
        assert_eq!(told(&long), long);
        assert_eq!(Language::En.said("no points"), "no points");
    }

    #[test]
    fn mistakes_of_a_recipe_are_told_line_by_line() {
        assert_eq!(
            Language::De.said(
                "recipe: edge[0].judged: false beside limits, expected one of the two\n\
                 recipe: limits.d1_mm: [0.5, -0.5], expected two numbers, the lower limit then the upper\n\
                 recipe: datum[1].name: \"A\" again, expected one name a datum"
            ),
            "recipe: edge[0].judged: false neben Grenzen, erwartet eines von beiden\n\
             recipe: limits.d1_mm: [0.5, -0.5], erwartet zwei Zahlen, erst die untere, dann die obere Grenze\n\
             recipe: datum[1].name: „A“ erneut, erwartet ein Name je Bezug"
        );
    }

    #[test]
    fn numbers_have_the_decimal_sign_of_the_language() {
        assert_eq!(Language::De.number("−1.25"), "−1,25");
        assert_eq!(Language::En.number("−1.25"), "−1.25");
    }
}
