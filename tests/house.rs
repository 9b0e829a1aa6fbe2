//! The rules of the map, held by reading the source: order of modules, packages, sizes, first lines.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The modules of `acies` in order of dependency: each uses only what stands before it.
const ORDER: &[&str] = &[
    "points", "geometry", "features", "surface", "mesh", "nominal", "inspect", "words", "report",
    "acquire", "store", "config", "cell", "web", "cli",
];

/// What may stand at the top level.
const TOP_LEVEL: &[&str] = &[
    ".ci",
    ".git",
    ".gitignore",
    "CHANGELOG.md",
    "Cargo.lock",
    "Cargo.toml",
    "LICENSE-APACHE",
    "LICENSE-MIT",
    "README.md",
    "benches",
    "configs",
    "drivers",
    "simulators",
    "src",
    "tests",
];

/// A file longer than this is two files.
const LINES_MAX: usize = 1_200;

/// A driver longer than this knows more than one device.
const DRIVER_LINES_MAX: usize = 1_200;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn rust_files(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    let Ok(entries) = fs::read_dir(folder) else {
        return found;
    };
    for entry in entries.map(|entry| entry.expect("a readable folder").path()) {
        if entry.is_dir() && !entry.ends_with("target") && !entry.ends_with("fuzz") {
            found.extend(rust_files(&entry));
        } else if entry.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&entry).expect("a readable file");
            found.push((entry, text));
        }
    }
    found.sort();
    found
}

fn all_rust_files() -> Vec<(PathBuf, String)> {
    ["src", "drivers", "simulators", "tests", "benches"]
        .iter()
        .flat_map(|f| rust_files(&root().join(f)))
        .collect()
}

/// The module of `acies` that a file below `src` belongs to.
fn module_of(file: &Path) -> Option<String> {
    let inside = file.strip_prefix(root().join("src")).ok()?;
    let first = Path::new(inside.components().next()?.as_os_str()).with_extension("");
    Some(first.to_string_lossy().into_owned())
}

/// The modules named right after `crate::`, also inside one level of braces.
fn uses_of(text: &str) -> Vec<String> {
    let code: Vec<&str> = text
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .collect();
    let code = code.join("\n");
    let mut found = Vec::new();
    for rest in code.split("crate::").skip(1) {
        let names = if let Some(group) = rest.strip_prefix('{') {
            group
        } else {
            rest
        };
        let end = if rest.starts_with('{') {
            names.find('}').unwrap_or(names.len())
        } else {
            names.len()
        };
        for name in names[..end].split(',') {
            let word: String = name
                .trim()
                .chars()
                .take_while(|c| c.is_alphanumeric() || *c == '_')
                .collect();
            found.push(word);
            if !rest.starts_with('{') {
                break;
            }
        }
    }
    found
}

#[test]
fn modules_use_only_what_stands_above_them() {
    let place: BTreeMap<&str, usize> = ORDER
        .iter()
        .enumerate()
        .map(|(i, name)| (*name, i))
        .collect();
    let mut wrong = Vec::new();
    for (file, text) in rust_files(&root().join("src")) {
        let module = module_of(&file).expect("below src");
        if module == "lib" || module == "main" {
            continue;
        }
        let Some(&own) = place.get(module.as_str()) else {
            wrong.push(format!(
                "{}: module {module} has no place in ORDER",
                file.display()
            ));
            continue;
        };
        for used in uses_of(&text) {
            match place.get(used.as_str()) {
                Some(&other) if other > own => {
                    wrong.push(format!(
                        "{}: {module} uses {used}, which stands below it",
                        file.display()
                    ));
                }
                _ => {}
            }
        }
    }
    assert!(wrong.is_empty(), "data goes one way:\n{}", wrong.join("\n"));
}

#[test]
fn the_reader_of_uses_sees_paths_and_groups() {
    let text = "use crate::points::PointCloud;\n// use crate::web\nuse crate::{cli, report::Report};\nlet x = crate::cell::run();";
    assert_eq!(uses_of(text), ["points", "cli", "report", "cell"]);
}

#[test]
fn modules_stand_in_order_in_the_library() {
    let text = fs::read_to_string(root().join("src/lib.rs")).expect("src/lib.rs");
    let declared: Vec<&str> = text
        .lines()
        .filter_map(|line| line.strip_prefix("pub mod ")?.strip_suffix(';'))
        .collect();
    let ordered: Vec<&str> = ORDER
        .iter()
        .copied()
        .filter(|name| declared.contains(name))
        .collect();
    assert_eq!(
        declared, ordered,
        "src/lib.rs lists the modules in the order of the map"
    );
}

#[test]
fn packages_depend_only_downwards() {
    let check = |package: &str, forbidden: &[&str]| {
        let manifest =
            fs::read_to_string(root().join(package).join("Cargo.toml")).expect("a manifest");
        let dependencies: toml::Table = manifest.parse().expect("a manifest in TOML");
        let names: Vec<String> = dependencies["dependencies"]
            .as_table()
            .expect("dependencies")
            .keys()
            .cloned()
            .collect();
        for name in forbidden {
            assert!(
                !names.iter().any(|n| n == name),
                "{package} must not depend on {name}"
            );
        }
    };
    check("drivers", &["acies", "acies-simulators"]);
    check("simulators", &["acies", "acies-drivers"]);
    for (file, text) in rust_files(&root().join("simulators")) {
        assert!(
            !text.contains("acies_drivers"),
            "{}: a simulator imports nothing of ours",
            file.display()
        );
    }
}

#[test]
fn nothing_else_stands_at_the_top() {
    let ignored = fs::read_to_string(root().join(".gitignore")).expect(".gitignore");
    for entry in fs::read_dir(root()).expect("the repository") {
        let name = entry
            .expect("an entry")
            .file_name()
            .to_string_lossy()
            .into_owned();
        if ignored.lines().any(|line| line == format!("/{name}")) {
            continue;
        }
        assert!(
            TOP_LEVEL.contains(&name.as_str()),
            "{name} does not belong at the top level"
        );
    }
}

#[test]
fn every_file_says_what_it_is_and_is_one_file() {
    for (file, text) in all_rust_files() {
        assert!(
            text.starts_with("//!"),
            "{}: the first line says what the file is, with //!",
            file.display()
        );
        let lines = text.lines().count();
        let driver = file.starts_with(root().join("drivers"));
        let limit = if driver { DRIVER_LINES_MAX } else { LINES_MAX };
        assert!(
            lines <= limit,
            "{}: {lines} lines, at most {limit}",
            file.display()
        );
    }
}

#[test]
fn nothing_is_ignored_and_nobody_sleeps_in_tests() {
    // Put together so that this file does not find itself.
    let ignored = ["#[", "ignore"].concat();
    let unfinished = [["todo", "!("].concat(), ["unimplemented", "!("].concat()];
    let sleeps = ["thread", "::sleep"].concat();
    for (file, text) in all_rust_files() {
        let test = file.components().any(|part| part.as_os_str() == "tests");
        assert!(
            !(test && text.contains(&sleeps)),
            "{}: wait for what is waited for, not for a while",
            file.display()
        );
        assert!(
            !text.contains(&ignored),
            "{}: a test that does not run proves nothing",
            file.display()
        );
        for word in &unfinished {
            assert!(
                !text.contains(word),
                "{}: {word} is not finished",
                file.display()
            );
        }
    }
}

#[test]
fn every_dependency_says_what_it_is_for() {
    for manifest in [
        "Cargo.toml",
        "drivers/Cargo.toml",
        "drivers/usb-queue/Cargo.toml",
        "simulators/Cargo.toml",
    ] {
        let text = fs::read_to_string(root().join(manifest)).expect("a manifest");
        let mut inside = false;
        for line in text.lines() {
            if line.starts_with('[') {
                inside = line.ends_with("dependencies]");
            } else if inside && line.contains('=') {
                let shared = line.contains("workspace = true") || line.contains("path =");
                assert!(
                    shared || line.contains('#'),
                    "{manifest}: {line:?} does not say what it is for"
                );
            }
        }
    }
}

/// One package may hold unsafe code, and says why it is sound; everywhere else the compiler forbids it.
#[test]
fn unsafe_code_stands_in_one_place() {
    for library in ["src/lib.rs", "drivers/src/lib.rs", "simulators/src/lib.rs"] {
        let text = fs::read_to_string(root().join(library)).expect("a library");
        assert!(text.contains("#![forbid(unsafe_code)]"), "{library}");
    }
    let text = fs::read_to_string(root().join("drivers/usb-queue/src/lib.rs")).expect("a library");
    let code = text
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"));
    let blocks: usize = code.map(|line| line.matches("unsafe {").count()).sum();
    let reasons = text.matches("// SAFETY: ").count();
    assert!(
        blocks <= 8,
        "{blocks} blocks: is it still small enough to be seen through?"
    );
    assert!(reasons >= blocks, "{reasons} reasons for {blocks} blocks");
    assert!(text.contains("# Why it is sound"));
}

#[test]
fn every_configuration_folder_has_its_cell() {
    for entry in fs::read_dir(root().join("configs")).expect("configs") {
        let folder = entry.expect("an entry").path();
        assert!(
            folder.join("cell.toml").is_file(),
            "{}: no cell.toml",
            folder.display()
        );
    }
}
