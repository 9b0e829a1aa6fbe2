//! The description of the API, and the page's texts.

use std::collections::BTreeSet;

use acies::web;
use serde_json::Value;

/// The whole contract in one readable file: a change of it is seen, and made on purpose.
#[test]
fn the_description_of_the_api_is_the_kept_one() {
    let document: Value = serde_json::from_str(&web::openapi()).expect("JSON");
    assert_eq!(document["openapi"], "3.1.0");
    let mut settings = insta::Settings::clone_current();
    settings.set_snapshot_path("snapshots");
    settings.set_prepend_module_to_snapshot(false);
    settings.bind(|| insta::assert_snapshot!("openapi", web::openapi()));
}

#[test]
fn every_reference_in_the_description_leads_somewhere() {
    let document: Value = serde_json::from_str(&web::openapi()).expect("JSON");
    let mut open = vec![&document];
    let mut seen = 0;
    while let Some(value) = open.pop() {
        if let Some(reference) = value.get("$ref").and_then(Value::as_str) {
            let pointer = reference.strip_prefix('#').expect("inside the document");
            assert!(document.pointer(pointer).is_some(), "{reference}");
            seen += 1;
        }
        match value {
            Value::Object(map) => open.extend(map.values()),
            Value::Array(list) => open.extend(list),
            _ => {}
        }
    }
    assert!(seen > 50, "{seen} references");
}

fn page() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/web/page")
}

fn texts() -> Value {
    let text = std::fs::read_to_string(page().join("texts.json")).expect("the texts");
    serde_json::from_str(&text).expect("JSON")
}

fn keys(language: &Value) -> BTreeSet<String> {
    language
        .as_object()
        .expect("texts by key")
        .keys()
        .cloned()
        .collect()
}

#[test]
fn both_languages_have_the_same_texts_with_the_same_places_to_fill() {
    let texts = texts();
    let (english, german) = (&texts["en"], &texts["de"]);
    assert_eq!(keys(english), keys(german));
    let places = |text: &Value| {
        let text = text.as_str().expect("a text");
        assert!(!text.is_empty());
        let places = text
            .split('{')
            .skip(1)
            .filter_map(|rest| rest.split_once('}'));
        places
            .map(|(name, _)| name.to_owned())
            .collect::<BTreeSet<_>>()
    };
    for key in keys(english) {
        assert_eq!(places(&english[&key]), places(&german[&key]), "{key}");
    }
}

#[test]
fn every_text_that_the_page_asks_for_is_there() {
    let known = keys(&texts()["en"]);
    let mut asked = 0;
    for folder in [page(), page().join("views")] {
        for entry in std::fs::read_dir(folder).expect("the page") {
            let path = entry.expect("a file").path();
            if path.extension().is_none_or(|ending| ending != "js") {
                continue;
            }
            let script = std::fs::read_to_string(&path).expect("a script");
            for key in calls(&script) {
                asked += 1;
                assert!(known.contains(key), "{key} in {}", path.display());
            }
        }
    }
    assert!(asked > 80, "{asked} texts");
}

/// The keys in calls `t("key")`; keys that are put together are seen by the browser's test.
fn calls(script: &str) -> impl Iterator<Item = &str> {
    let starts = script.match_indices("t(\"");
    // A function whose name ends in t is another one.
    let own = starts.filter(|(at, _)| !script[..*at].ends_with(|c: char| c.is_alphanumeric()));
    own.filter_map(|(at, start)| script[at + start.len()..].split('"').next())
}

#[test]
fn the_page_asks_nobody_else() {
    for folder in [page(), page().join("views")] {
        for entry in std::fs::read_dir(folder).expect("the page") {
            let path = entry.expect("a file").path();
            if path.is_dir() {
                continue;
            }
            let text = std::fs::read_to_string(&path).expect("a text");
            // The name of the drawing language is a name, not an address that is asked.
            let text = text.replace("http://www.w3.org/2000/svg", "");
            assert!(
                !text.contains("http://") && !text.contains("https://"),
                "{}",
                path.display()
            );
            assert!(
                !text.contains("innerHTML") && !text.contains("eval("),
                "{}",
                path.display()
            );
        }
    }
}
