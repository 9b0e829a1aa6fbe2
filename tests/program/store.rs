//! The commands about a cell's store: people, exports, support bundles, backups.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, SystemTime};

use acies::config::Cell;
use acies::report::Report;
use acies::store::{Finished, Order, SessionKind, Store, Trigger};
use flate2::read::GzDecoder;
use serde_json::Value;

use super::part;
use super::{acies, status, text};

const SENTENCE: &str = "a long sentence";

/// A cell's configuration and its store.
struct Stored {
    folder: PathBuf,
    cell: String,
    store: Store,
}

impl Stored {
    fn new(name: &str) -> Self {
        let folder = super::folder(name);
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
        for file in ["cell.toml", "recipe.toml", "part.step"] {
            fs::copy(demo.join(file), folder.join(file)).expect("a copy of the demo's files");
        }
        let path = folder.join("cell.toml");
        let service = Cell::read(&path).expect("a sound cell").service;
        Self {
            store: Store::open(&service.store).expect("a store"),
            cell: path.display().to_string(),
            folder,
        }
    }

    /// A part that was measured.
    fn measure(&self, serial: &str) -> i64 {
        let order = Order {
            part_serial: serial.to_owned(),
            ..Order::default()
        };
        let trigger = Trigger {
            order: &order,
            operator: "anna",
            key: None,
            simulated: false,
        };
        let now = SystemTime::now();
        let (inspection, _) = self.store.queue(&trigger, now).expect("queued");
        let id = inspection.id;
        self.store.begin(id, None, "1.raw", now).expect("begun");
        let report = Report::new(&part::inspection(4), &part::facts());
        let finished = Finished {
            report: &report,
            scan_seconds: 1.0,
            verdict_seconds: 0.5,
        };
        self.store.finish(id, &finished, now).expect("finished");
        id
    }

    /// `acies person ...` with this typed into it.
    fn person(&self, arguments: &[&str], typed: &str) -> Output {
        let mut child = Command::new(env!("CARGO_BIN_EXE_acies"))
            .arg("person")
            .args(arguments)
            .args(["--cell", &self.cell])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program runs");
        // A command that wants no password may have ended already.
        let mut stdin = child.stdin.take().expect("a pipe");
        let _ = stdin.write_all(format!("{typed}\n").as_bytes());
        drop(stdin);
        child.wait_with_output().expect("the program ends")
    }

    fn people(&self) -> Vec<(String, String, bool)> {
        let listed = self.person(&["list", "--json"], "");
        assert_eq!(status(&listed), 0, "{}", text(&listed.stderr));
        let listed: Value = serde_json::from_slice(&listed.stdout).expect("JSON");
        let people = listed["people"].as_array().expect("people").iter();
        let word = |value: &Value| value.as_str().expect("a text").to_owned();
        people
            .map(|one| {
                (
                    word(&one["name"]),
                    word(&one["role"]),
                    one["enabled"] == true,
                )
            })
            .collect()
    }
}

#[test]
fn people_are_added_listed_and_shut_out_from_the_command_line() {
    let cell = Stored::new("people");
    let nobody = cell.person(&["list"], "");
    assert!(text(&nobody.stdout).starts_with("nobody; add the first administrator"));
    let add = ["add", "ada", "--role", "administrator"];
    let short = cell.person(&add, "short");
    assert_eq!(status(&short), 64);
    assert!(
        text(&short.stderr).contains("expected 8 to 256"),
        "{short:?}"
    );
    assert_eq!(cell.people(), []);
    let added = cell.person(&add, SENTENCE);
    assert_eq!(status(&added), 0, "{}", text(&added.stderr));
    assert_eq!(text(&added.stdout), "ada is administrator now\n");
    let again = cell.person(&add, SENTENCE);
    assert_eq!(status(&again), 64);
    assert!(
        text(&again.stderr).contains("is there already"),
        "{again:?}"
    );
    assert_eq!(
        cell.people(),
        [("ada".into(), "administrator".into(), true)]
    );

    // What changes somebody ends what they had open.
    let now = SystemTime::now();
    let open = || {
        let kind = SessionKind::Session;
        let hour = Duration::from_secs(3600);
        let opened = cell
            .store
            .add_session("key", "ada", kind, "browser", now, hour);
        opened.expect("a session");
    };
    let holds = || cell.store.holder("key", now).expect("an answer").is_some();
    let hash = || cell.store.person("ada").expect("an answer").expect("ada").1;
    let first = hash();
    open();
    assert!(holds());
    let changed = cell.person(&["password", "ada"], "another long sentence");
    assert_eq!(status(&changed), 0, "{}", text(&changed.stderr));
    assert!(!holds() && hash() != first && hash().starts_with("$argon2id$"));
    open();
    let disabled = cell.person(&["disable", "ada"], "");
    assert_eq!(text(&disabled.stdout), "ada is disabled now\n");
    assert!(!holds());
    assert_eq!(
        cell.people(),
        [("ada".into(), "administrator".into(), false)]
    );
    assert!(text(&cell.person(&["list"], "").stdout).contains("disabled"));
    let enabled = cell.person(&["enable", "ada"], "");
    assert_eq!(text(&enabled.stdout), "ada is enabled now\n");
    assert_eq!(
        cell.people(),
        [("ada".into(), "administrator".into(), true)]
    );
    for unknown in [["disable", "eve"], ["enable", "eve"], ["password", "eve"]] {
        let refused = cell.person(&unknown, SENTENCE);
        assert_eq!(status(&refused), 64, "{unknown:?}");
        assert!(text(&refused.stderr).contains("eve"), "{refused:?}");
    }
    let log = cell.store.audit_log(None, 10).expect("the log");
    let log: Vec<_> = log
        .iter()
        .map(|entry| {
            (
                entry.person.as_str(),
                entry.action.as_str(),
                entry.new.as_str(),
            )
        })
        .collect();
    let by = "command line";
    assert_eq!(
        log,
        [
            (by, "person.change", "enabled"),
            (by, "person.change", "disabled"),
            (by, "person.change", "new password"),
            (by, "person.add", "administrator"),
        ]
    );
    let output = Command::new(env!("CARGO_BIN_EXE_acies"))
        .args(["person", "list", "--cell", "nothing.toml"])
        .output();
    assert_eq!(status(&output.expect("the program runs")), 65);
}

/// The files of a bundle by name.
fn unpacked(path: &Path) -> BTreeMap<String, String> {
    let file = File::open(path).expect("a bundle");
    let mut archive = tar::Archive::new(GzDecoder::new(file));
    let entries = archive.entries().expect("entries");
    let entries = entries.map(|entry| {
        let mut entry = entry.expect("an entry");
        let name = entry.path().expect("a name").display().to_string();
        let mut content = String::new();
        entry.read_to_string(&mut content).expect("text");
        let name = name.strip_prefix("acies-support/").expect("one folder");
        (name.to_owned(), content)
    });
    entries.collect()
}

#[test]
fn a_support_bundle_has_what_helps_and_nothing_secret() {
    let cell = Stored::new("support");
    let id = cell.measure("SN-7");
    let added = cell.person(&["add", "ada", "--role", "setter"], SENTENCE);
    assert_eq!(status(&added), 0);
    let hour = Duration::from_secs(3600);
    let (kind, now) = (SessionKind::Token, SystemTime::now());
    let opened = cell
        .store
        .add_session("the-secret-key", "ada", kind, "plc", now, hour);
    opened.expect("a token");
    let path = cell.folder.join("bundle.tar.gz");
    let output = path.display().to_string();
    let made = acies(&["support-bundle", &cell.cell, "-o", &output]);
    assert_eq!(status(&made), 0, "{}", text(&made.stderr));
    assert_eq!(text(&made.stdout), format!("support bundle: {output}\n"));
    let files = unpacked(&path);
    let names: Vec<&str> = files.keys().map(String::as_str).collect();
    let report = format!("reports/{id}.json");
    let expected = [
        "about.txt",
        "audit.json",
        "cell.toml",
        "history.json",
        "log.txt",
        "people.json",
        report.as_str(),
        "store.json",
    ];
    assert_eq!(names, expected);
    assert_eq!(
        files["cell.toml"],
        fs::read_to_string(&cell.cell).expect("the cell")
    );
    assert!(files["history.json"].contains("SN-7") && files["people.json"].contains("ada"));
    assert!(files[&report].contains("acies-report/1"));
    for (name, content) in &files {
        for secret in ["argon2id", SENTENCE, "the-secret-key"] {
            assert!(!content.contains(secret), "{secret} in {name}");
        }
    }

    // A cell that cannot be read is just the one that needs help.
    fs::write(&cell.cell, "name = 7\n").expect("a wrong cell");
    let made = acies(&["support-bundle", &cell.cell, "-o", &output]);
    assert_eq!(status(&made), 0, "{}", text(&made.stderr));
    let files = unpacked(&path);
    assert!(
        files["mistakes.txt"].contains("name"),
        "{}",
        files["mistakes.txt"]
    );
    let nowhere = cell.folder.join("no/where.tar.gz").display().to_string();
    let failed = acies(&["support-bundle", &cell.cell, "-o", &nowhere]);
    assert_eq!(status(&failed), 74);
    assert!(text(&failed.stderr).contains("choose another file with --output"));
}

#[test]
fn an_export_is_whole_or_says_what_is_wrong_and_leaves_nothing() {
    let cell = Stored::new("export");
    let id = cell.measure("SN-1");
    cell.measure("SN-2");
    let out = cell.folder.join("all.csv");
    let path = out.display().to_string();
    let made = acies(&["export", &cell.cell, "-o", &path, "--part", "SN-1"]);
    assert_eq!(status(&made), 0, "{}", text(&made.stderr));
    let table = fs::read_to_string(&out).expect("a table");
    assert!(table.starts_with("inspection,part_serial,") && table.contains("\n1,SN-1,"));
    assert!(!table.contains("SN-2"));
    let lines = acies(&["export", &cell.cell, "--form", "json-lines"]);
    assert_eq!(text(&lines.stdout).lines().count(), 2);

    let nowhere = cell.folder.join("no/where.csv").display().to_string();
    let failed = acies(&["export", &cell.cell, "-o", &nowhere]);
    assert_eq!(status(&failed), 74);
    assert!(text(&failed.stderr).contains("choose another file with --output"));
    assert_eq!(status(&acies(&["export", "nothing.toml"])), 65);
    assert_eq!(
        status(&acies(&["export", &cell.cell, "--form", "xlsx"])),
        64
    );

    let database = cell.store.folder().join("acies.db");
    let database = rusqlite::Connection::open(database).expect("the database");
    let damage = database.execute(
        "UPDATE reports SET json_zstd = x'00' WHERE inspection = ?1",
        [id],
    );
    assert_eq!(damage.expect("damaged"), 1);
    let new = cell.folder.join("new.csv");
    let failed = acies(&["export", &cell.cell, "-o", &new.display().to_string()]);
    assert_eq!(status(&failed), 74);
    let told = text(&failed.stderr);
    assert!(
        told.contains("report of inspection 1") && told.contains("backup"),
        "{told}"
    );
    let left = fs::read_dir(&cell.folder).expect("the folder").flatten();
    let left: Vec<String> = left
        .map(|entry| entry.file_name().display().to_string())
        .collect();
    assert!(!left.iter().any(|name| name.starts_with("new")), "{left:?}");
}

#[test]
fn a_backup_is_put_back_where_the_store_was() {
    let cell = Stored::new("restore");
    cell.measure("SN-1");
    let backup = cell.folder.join("backup").display().to_string();
    let made = acies(&["backup", &cell.cell, &backup]);
    assert_eq!(status(&made), 0, "{}", text(&made.stderr));
    assert_eq!(
        status(&acies(&["backup", &cell.cell, &backup])),
        74,
        "it is there already"
    );
    cell.measure("SN-2");
    let folder = cell.store.folder().to_owned();
    let (name, root) = (cell.cell.clone(), cell.folder.clone());
    drop(cell);
    let nothing = root.join("nothing").display().to_string();
    assert_eq!(status(&acies(&["restore", &name, &nothing])), 74);
    let restored = acies(&["restore", &name, &backup]);
    assert_eq!(status(&restored), 0, "{}", text(&restored.stderr));
    let parts = |folder: &Path| {
        let store = Store::open(folder).expect("a store");
        let found = store.history(&Default::default()).expect("a history");
        found
            .into_iter()
            .map(|one| one.part_serial)
            .collect::<Vec<_>>()
    };
    assert_eq!(parts(&folder), ["SN-1"]);
    let before = format!("{}.before-restore", folder.display());
    assert_eq!(parts(Path::new(&before)), ["SN-2", "SN-1"]);
}
