//! The table of texts against the sentences in the source: what the program says has its row, and a row is what the program says.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use acies::words::Language;
use serde_json::Value;

/// Files whose every sentence is read by people on the page or in a report.
const TOLD: &[&str] = &[
    "drivers/src/settings.rs",
    "src/inspect.rs",
    "src/inspect",
    "src/nominal",
    "src/acquire/assembler.rs",
    "src/acquire/carried.rs",
    "src/acquire/run.rs",
    "src/cell",
    "src/web/access.rs",
    "src/web/app.rs",
    "src/web/problem.rs",
    "src/web/password.rs",
    "src/web/api/session.rs",
];

/// Sentences in these files that nobody reads there, each with where it goes.
const NOT_TOLD: &[(&str, &str)] = &[
    ("one was pushed", "a panic"),
    ("the figures are to be seen with --nocapture", "a lint"),
    (
        "the pose has moved too far: all points are laid again",
        "the log",
    ),
    ("acquisition {id}", "the name of a thread"),
    ("raw data not kept", "the log"),
    ("no result", "the log"),
    ("device ready", "the log"),
    ("device failed", "the log"),
    ("raw data removed by the retention rule", "the log"),
    ("the cell's thread", "a panic"),
    ("an index below the count", "a panic"),
    ("request failed", "the log"),
    ("Bearer realm=\"acies\"", "a header"),
    ("command line", "the audit log"),
    ("nobody has this", "a password that is none"),
    ("address {address}", "the key of a counter"),
    ("name {}", "the key of a counter"),
    ("logged in", "the API's description"),
    ("logged out", "the API's description"),
    ("who asks", "the API's description"),
    ("login failed", "the log"),
    (
        "{}={secret}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}",
        "a header",
    ),
];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn texts() -> BTreeMap<String, BTreeMap<String, String>> {
    let text = fs::read_to_string(root().join("src/words/texts.json")).expect("the table");
    serde_json::from_str(&text).expect("texts by language and key")
}

fn files(place: &Path) -> Vec<PathBuf> {
    if place.is_file() {
        return vec![place.to_owned()];
    }
    let entries = fs::read_dir(place).expect("a folder of the source");
    let mut found: Vec<PathBuf> = entries
        .flat_map(|entry| files(&entry.expect("a readable folder").path()))
        .filter(|path| path.extension().is_some_and(|ending| ending == "rs"))
        .collect();
    found.sort();
    found
}

/// The string literals of a file outside its tests and comments, as the compiler reads them.
fn literals(path: &Path) -> Vec<String> {
    let text = fs::read_to_string(path).expect("a readable file");
    let text = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let code: Vec<&str> = text
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .collect();
    let code = code.join("\n");
    let mut found = Vec::new();
    let mut chars = code.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            // A quote as a character is none of a text.
            '\'' if chars.peek() == Some(&'"') => {
                chars.next();
            }
            '"' => {
                let mut literal = String::new();
                while let Some(c) = chars.next() {
                    match c {
                        '"' => break,
                        '\\' => match chars.next() {
                            Some('\n') => while chars.next_if(|c| c.is_whitespace()).is_some() {},
                            Some('n') => literal.push('\n'),
                            Some(other) => literal.push(other),
                            None => break,
                        },
                        other => literal.push(other),
                    }
                }
                found.push(literal);
            }
            _ => {}
        }
    }
    found
}

/// A text with every place to fill the same: `{name:?}` of the source is quoted in the table.
fn shape(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('{') {
        let Some((_, after)) = after.split_once('}') else {
            break;
        };
        out.push_str(before);
        out.push_str("{}");
        rest = after;
    }
    (out + rest).replace("\"{}\"", "{}").replace("{}{}", "{}")
}

fn sentences(language: Language) -> BTreeMap<String, String> {
    let rows = texts().remove(language.code()).expect("the language");
    rows.into_iter()
        .filter(|(key, _)| key.starts_with("said."))
        .collect()
}

#[test]
fn every_row_is_a_sentence_of_the_program() {
    let known: BTreeSet<String> = ["src", "drivers/src"]
        .iter()
        .flat_map(|folder| files(&root().join(folder)))
        .flat_map(|path| literals(&path))
        .map(|literal| shape(&literal))
        .collect();
    let lost: Vec<String> = sentences(Language::En)
        .into_iter()
        .filter(|(_, text)| {
            let shape = shape(text);
            // What is written behind another sentence has that in front of it in the table.
            let behind = shape.strip_prefix("{}").unwrap_or(&shape);
            !known.contains(&shape) && !known.contains(behind)
        })
        .map(|(key, text)| format!("{key}: {text}"))
        .collect();
    assert_eq!(lost, Vec::<String>::new(), "no such sentence in the source");
}

#[test]
fn every_sentence_has_its_row() {
    let known: BTreeSet<String> = sentences(Language::En)
        .values()
        .map(|text| shape(text))
        .collect();
    let mut missing = Vec::new();
    let mut seen = 0;
    for path in TOLD.iter().flat_map(|place| files(&root().join(place))) {
        let place = path.strip_prefix(root()).expect("below the root");
        if place.ends_with("tests.rs") {
            continue;
        }
        for literal in literals(&path) {
            let own = shape(&literal);
            let words = own
                .split(' ')
                .filter(|word| word.chars().any(char::is_alphabetic));
            if words.count() < 2 || NOT_TOLD.iter().any(|(text, _)| *text == literal) {
                continue;
            }
            seen += 1;
            if !known.contains(&own) && !known.contains(&format!("{{}}{own}")) {
                missing.push(format!("{}: {literal}", place.display()));
            }
        }
    }
    assert!(seen > 150, "{seen} sentences");
    assert_eq!(
        missing,
        Vec::<String>::new(),
        "no row said.* in src/words/texts.json"
    );
}

#[test]
fn every_row_is_recognised_in_its_own_words() {
    let german = sentences(Language::De);
    for (key, english) in sentences(Language::En) {
        let sample = |text: &str| {
            let mut out = String::new();
            let mut rest = text;
            while let Some((before, after)) = rest.split_once('{') {
                let (name, after) = after.split_once('}').expect("a place to fill");
                out += before;
                out += if name.starts_with("number.") {
                    "12"
                } else {
                    "Q7"
                };
                rest = after;
            }
            out + rest
        };
        assert_eq!(
            Language::De.said(&sample(&english)),
            sample(&german[&key]),
            "{key}"
        );
    }
}

#[test]
fn both_languages_have_the_same_texts_with_the_same_places_to_fill() {
    let texts = texts();
    let (english, german) = (&texts["en"], &texts["de"]);
    let keys = |texts: &BTreeMap<String, String>| texts.keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(english), keys(german));
    let places = |text: &str| {
        let pieces = text.split('{').skip(1);
        let names = pieces.filter_map(|piece| piece.split_once('}'));
        names
            .map(|(name, _)| name.to_owned())
            .collect::<BTreeSet<_>>()
    };
    for (key, text) in english {
        assert!(!text.is_empty() && !german[key].is_empty(), "{key}");
        assert_eq!(places(text), places(&german[key]), "{key}");
    }
}

/// The words of an enumeration in the report's schema.
fn codes(schema: &Value, name: &str) -> Vec<String> {
    let definition = &schema["$defs"][name];
    let cases = definition["oneOf"]
        .as_array()
        .or(definition["enum"].as_array());
    let cases = cases.unwrap_or_else(|| panic!("{name} has cases"));
    let word = |case: &Value| {
        case["const"]
            .as_str()
            .or(case.as_str())
            .expect("a word")
            .to_owned()
    };
    cases.iter().map(word).collect()
}

#[test]
fn every_code_of_a_report_has_its_text_in_both_languages() {
    let schema = acies::report::Report::json_schema();
    let texts = texts();
    let sets = [
        ("ReasonCode", "because", 15),
        ("AdviceCode", "advised", 8),
        ("Status", "verdict", 4),
        ("Status", "verdict.report", 4),
        ("Quantity", "quantity", 16),
    ];
    for (name, prefix, least) in sets {
        let codes = codes(&schema, name);
        assert!(codes.len() >= least, "{name}");
        for key in codes.iter().map(|code| format!("{prefix}.{code}")) {
            for language in ["en", "de"] {
                assert!(texts[language].contains_key(&key), "{key} in {language}");
            }
        }
    }
}
