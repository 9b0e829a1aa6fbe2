//! The description of the API, and the page's texts.

use std::collections::BTreeSet;

use acies::store::Role;
use acies::web;
use serde_json::Value;

use super::bench::Served;

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

/// Whoever reads the description knows which numbers are taken; what is beyond them is refused with a reason.
#[test]
fn numbers_beyond_those_of_the_description_are_refused() {
    let cell = Served::without_devices("bounds", |service| {
        service.anonymous = Some(Role::Administrator);
    });
    let document: Value = serde_json::from_str(&web::openapi()).expect("JSON");
    let mut asked = 0;
    for (path, item) in document["paths"].as_object().expect("paths") {
        for parameter in item["get"]["parameters"].as_array().into_iter().flatten() {
            let schema = &parameter["schema"];
            if schema["type"] != "integer" {
                continue;
            }
            let name = parameter["name"].as_str().expect("a name");
            assert_eq!(schema["format"], "int64", "{name} of {path}");
            let bound =
                |word: &str, otherwise: i64| i128::from(schema[word].as_i64().unwrap_or(otherwise));
            let (low, high) = (bound("minimum", i64::MIN), bound("maximum", i64::MAX));
            for number in [low - 1, high + 1] {
                let (address, kind) = if parameter["in"] == "path" {
                    let address = path.replace(&format!("{{{name}}}"), &number.to_string());
                    (address, "address")
                } else {
                    let path = path.replace("{name}", "e1.d1");
                    (format!("{path}?{name}={number}"), "query")
                };
                cell.get(&address).problem(400, kind);
                asked += 1;
            }
        }
    }
    assert!(asked >= 20, "{asked} numbers");
}

fn page() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/web/page")
}

fn texts() -> Value {
    let text = std::fs::read_to_string(page().join("../../words/texts.json")).expect("the texts");
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
