//! The configuration that each driver's document shows: it is sound, and it shows every key.

use std::fs;
use std::path::Path;

use acies_drivers::ALL;

/// The TOML in the document at the head of a driver's file.
fn shown(source: &str) -> String {
    let (_, from_fence) = source.split_once("//! ```toml\n").expect("a block of TOML");
    let (block, _) = from_fence.split_once("//! ```").expect("its end");
    let lines = block.lines().map(|line| line.trim_start_matches("//! "));
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn the_shown_configuration_is_sound_and_whole() {
    for driver in ALL {
        let file = format!("src/{}.rs", driver.name.replace('-', "_"));
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
        let shown = shown(&fs::read_to_string(path).expect("the driver's file"));
        let table: toml::Table = toml::from_str(&shown).expect("TOML");
        if let Err(mistakes) = (driver.configure)(table) {
            panic!("{}: {mistakes:?}", driver.name);
        }
        let unknown = toml::from_str("port = 'x'\nno_such_key = 1").expect("TOML");
        let mistakes = (driver.configure)(unknown).expect_err("an unknown key");
        let unknown = mistakes.iter().find(|m| m.key == "no_such_key");
        let expected = &unknown.expect("it is told").expected;
        let keys = expected.trim_start_matches("one of ");
        for key in keys.split(", ") {
            let given = shown.lines().any(|line| {
                let line = line.trim_start_matches("# ");
                line.split_once(" = ").is_some_and(|(name, _)| name == key)
            });
            assert!(given, "{} does not show {key}", driver.name);
        }
    }
}
