//! The store: what is committed survives, what is cut off is mended, what is damaged is said.

#[path = "report/part.rs"]
#[allow(dead_code)] // what the report's tests need beside it
mod part;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use acies::acquire::Calibration;
use acies::geometry::RigidTransform;
use acies::report::Report;
use acies::report::wire::Status;
use acies::store::{
    Audit, Export, Finished, History, NewRecipe, Order, Phase, Purpose, Retention, Role,
    ScanReader, ScanWriter, SessionKind, Store, StoreError, StoredView, Trigger, restore,
};
use acies_drivers::capture::Profile;
use acies_drivers::device::Identity;
use glam::{DQuat, DVec3};
use proptest::prelude::*;

/// A folder of its own for each test, empty at first and removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("acies-store-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        Self(path)
    }

    fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// 2026-01-01 and some seconds.
fn at(seconds: u64) -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(1_767_225_600 + seconds)
}

fn order(part_serial: &str) -> Order {
    Order {
        part_serial: part_serial.to_owned(),
        order_number: "4711".to_owned(),
        ..Order::default()
    }
}

/// A trigger of Anna's.
fn trigger<'a>(order: &'a Order, key: Option<&'a str>) -> Trigger<'a> {
    Trigger {
        order,
        operator: "anna",
        key,
        simulated: false,
    }
}

/// The report of the report's own tests, with another verdict.
fn report(verdict: Status) -> Report {
    let mut report = Report::new(&part::inspection(4), &part::facts());
    report.verdict = verdict;
    report.simulated = false;
    report
}

fn measure(store: &Store, serial: &str, verdict: Status, seconds: u64) -> i64 {
    let (inspection, _) = store
        .queue(&trigger(&order(serial), None), at(seconds))
        .expect("queued");
    let id = inspection.id;
    store
        .begin(id, None, &format!("{id:08}.raw"), at(seconds))
        .expect("begun");
    store.acquired(id, 1000, at(seconds + 1)).expect("acquired");
    let report = report(verdict);
    let finished = Finished {
        report: &report,
        scan_seconds: 1.0,
        verdict_seconds: 0.5,
    };
    store
        .finish(id, &finished, at(seconds + 2))
        .expect("finished");
    id
}

fn views() -> Vec<StoredView> {
    let view = |name: &str| StoredView {
        device: name.to_owned(),
        identity: Identity {
            vendor: "v".to_owned(),
            model: "m".to_owned(),
            serial: "1".to_owned(),
            firmware: "2".to_owned(),
        },
        calibration: Calibration {
            machine_from_sensor: RigidTransform::new(
                DQuat::from_axis_angle(DVec3::X, 3.0),
                DVec3::new(0.1, -0.2, 110.0),
            ),
            travel_mm_per_count: DVec3::new(0.0, 0.01, 1.0 / 3.0),
        },
        carried: false,
        carrier: None,
    };
    vec![view("left"), view("right")]
}

fn profile(sequence: u32, columns: usize) -> Profile {
    let z = |i: usize| {
        let height = 100.0 + (sequence as f64 * 0.1 + i as f64).sin();
        if i % 7 == 3 { f64::NAN } else { height }
    };
    Profile {
        sequence,
        boot: 7,
        device_time_ns: 1_000_000 * u64::from(sequence),
        encoder: (sequence % 5 != 4).then_some(i64::from(sequence) * 40 - 3),
        host_time: Instant::now(),
        dropped: sequence / 3,
        saturated: sequence % 2 == 1,
        x_mm: (0..columns).map(|i| i as f64 / 3.0).collect(),
        z_mm: (0..columns).map(z).collect(),
        intensity: (0..columns).map(|i| i as u16).collect(),
    }
}

/// Equal bit for bit, but for the host's clock.
fn same(a: &Profile, b: &Profile) -> bool {
    let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    bits(&a.x_mm) == bits(&b.x_mm)
        && bits(&a.z_mm) == bits(&b.z_mm)
        && a.intensity == b.intensity
        && (
            a.sequence,
            a.boot,
            a.device_time_ns,
            a.encoder,
            a.dropped,
            a.saturated,
        ) == (
            b.sequence,
            b.boot,
            b.device_time_ns,
            b.encoder,
            b.dropped,
            b.saturated,
        )
}

fn read_all(path: &Path) -> (Vec<(usize, Profile)>, bool) {
    let mut reader = ScanReader::open(path).expect("a scan");
    let mut all = Vec::new();
    while let Some((view, profiles)) = reader.profiles().expect("profiles") {
        all.extend(profiles.into_iter().map(|profile| (view, profile)));
    }
    (all, reader.whole())
}

#[test]
fn a_result_is_there_after_the_store_was_closed_and_opened() {
    let folder = Folder::new("reopened");
    let id = {
        let store = Store::open(&folder.0).expect("a store");
        measure(&store, "A-1", Status::NotOk, 10)
    };
    let store = Store::open(&folder.0).expect("the store again");
    let inspection = store.inspection(id).expect("the inspection");
    assert_eq!(inspection.phase, Phase::Done);
    assert_eq!(inspection.verdict, Some(Status::NotOk));
    assert_eq!(inspection.part_serial, "A-1");
    assert_eq!(inspection.purpose, Purpose::Series);
    assert_eq!(inspection.requested, "2026-01-01T00:00:10.000Z");
    assert_eq!(
        inspection.ended.as_deref(),
        Some("2026-01-01T00:00:12.000Z")
    );
    let stored: Report =
        serde_json::from_str(&store.report_json(id).expect("its report")).expect("JSON");
    assert_eq!(stored, report(Status::NotOk));
}

#[test]
fn a_trigger_that_is_repeated_measures_once() {
    let folder = Folder::new("idempotent");
    let store = Store::open(&folder.0).expect("a store");
    let (first, new) = store
        .queue(&trigger(&order("A"), Some("key-1")), at(0))
        .expect("queued");
    let (again, new_again) = store
        .queue(&trigger(&order("A"), Some("key-1")), at(9))
        .expect("queued");
    let (other, _) = store
        .queue(&trigger(&order("A"), None), at(9))
        .expect("queued");
    let (another, _) = store
        .queue(&trigger(&order("A"), None), at(9))
        .expect("queued");
    assert!(new && !new_again);
    assert_eq!(first, again);
    assert!(first.id < other.id && other.id < another.id);
}

#[test]
fn a_part_measured_again_keeps_its_first_result() {
    let folder = Folder::new("again");
    let store = Store::open(&folder.0).expect("a store");
    let first = measure(&store, "A", Status::NotOk, 0);
    let repeat = Order {
        remeasure_of: Some(first),
        ..order("A")
    };
    let (second, _) = store.queue(&trigger(&repeat, None), at(5)).expect("queued");
    assert_eq!(second.remeasure_of, Some(first));
    assert!(store.report_json(first).is_ok());
    let nothing = Order {
        remeasure_of: Some(999),
        ..order("A")
    };
    let refused = store
        .queue(&trigger(&nothing, None), at(6))
        .expect_err("no such inspection");
    assert!(matches!(refused, StoreError::Missing { .. }), "{refused}");
}

#[test]
fn pages_of_the_history_join_without_gap_or_overlap() {
    let folder = Folder::new("history");
    let store = Store::open(&folder.0).expect("a store");
    let verdicts = [Status::Ok, Status::NotOk, Status::NotDecidable];
    let all: Vec<(i64, Status)> = (0..31)
        .map(|i| {
            let verdict = verdicts[i % 3];
            (
                measure(&store, &format!("P-{}", i % 4), verdict, i as u64),
                verdict,
            )
        })
        .collect();
    for filter in [None, Some(Status::NotOk)] {
        let expected: Vec<i64> = all
            .iter()
            .rev()
            .filter(|(_, verdict)| filter.is_none_or(|wanted| *verdict == wanted))
            .map(|(id, _)| *id)
            .collect();
        let mut found = Vec::new();
        let mut page = History {
            limit: Some(4),
            verdict: filter,
            ..History::default()
        };
        loop {
            let inspections = store.history(&page).expect("a page");
            let Some(last) = inspections.last() else {
                break;
            };
            page.before = Some(last.id);
            found.extend(inspections.iter().map(|inspection| inspection.id));
        }
        assert_eq!(found, expected);
    }
    let of_part = History {
        part_serial: Some("P-2".to_owned()),
        ..History::default()
    };
    assert_eq!(store.history(&of_part).expect("a page").len(), 8);
    let found = |prefix: &str| {
        let history = History {
            serial_prefix: Some(prefix.to_owned()),
            ..History::default()
        };
        store.history(&history).expect("a page").len()
    };
    assert_eq!(
        [found("P-"), found("P-3"), found("P-4"), found("p")],
        [31, 7, 0, 0]
    );
}

#[test]
fn a_trend_holds_series_parts_on_real_instruments_only() {
    let folder = Folder::new("trend");
    let store = Store::open(&folder.0).expect("a store");
    let counted = measure(&store, "A", Status::Ok, 0);
    let (setup, _) = store
        .queue(
            &trigger(
                &Order {
                    purpose: Purpose::Setup,
                    ..order("B")
                },
                None,
            ),
            at(5),
        )
        .expect("queued");
    let finished = report(Status::Ok);
    let finished = Finished {
        report: &finished,
        scan_seconds: 1.0,
        verdict_seconds: 0.5,
    };
    store.finish(setup.id, &finished, at(6)).expect("finished");
    let (simulated, _) = store
        .queue(&trigger(&order("C"), None), at(7))
        .expect("queued");
    let mut played = report(Status::Ok);
    played.simulated = true;
    let finished = Finished {
        report: &played,
        ..finished
    };
    store
        .finish(simulated.id, &finished, at(8))
        .expect("finished");
    let names = store.characteristics().expect("names");
    let first = &names[0];
    let trend = store.trend(first, 100, false).expect("a trend");
    let ids = |everything| {
        let trend = store.trend(first, 100, everything).expect("a trend");
        trend
            .points
            .iter()
            .map(|point| point.id)
            .collect::<Vec<_>>()
    };
    assert_eq!(ids(false), [counted]);
    assert_eq!(ids(true), [counted, setup.id, simulated.id]);
    let found = report(Status::Ok);
    let found = found
        .edges
        .iter()
        .flat_map(|edge| &edge.characteristics)
        .find(|c| c.id == *first);
    let found = found.expect("the characteristic in the report");
    assert_eq!(
        (trend.points[0].value, trend.points[0].u),
        (found.value, found.u)
    );
    assert_eq!((trend.lower, trend.upper), (found.lower, found.upper));
    assert!(matches!(
        store.trend("nonsense", 1, true),
        Err(StoreError::Missing { .. })
    ));
}

#[test]
fn the_audit_log_cannot_be_changed_or_shortened() {
    let folder = Folder::new("audit");
    let store = Store::open(&folder.0).expect("a store");
    for number in 0..3 {
        let new = number.to_string();
        let entry = Audit {
            person: "berta",
            action: "test.change",
            subject: "a value",
            old: "",
            new: &new,
            why: "a test",
        };
        store.audit(&entry, at(number)).expect("written");
    }
    let entries = store.audit_log(None, 2).expect("entries");
    assert_eq!(
        entries.iter().map(|e| e.new.as_str()).collect::<Vec<_>>(),
        ["2", "1"]
    );
    let entries = store.audit_log(Some(entries[1].id), 2).expect("entries");
    assert_eq!(
        entries.iter().map(|e| e.new.as_str()).collect::<Vec<_>>(),
        ["0"]
    );
    let raw = rusqlite::Connection::open(folder.join("acies.db")).expect("the database");
    for sql in ["UPDATE audit SET why = 'nothing'", "DELETE FROM audit"] {
        let error = raw
            .execute(sql, ())
            .expect_err("refused by the database itself");
        assert!(
            error.to_string().contains("the audit log is never"),
            "{error}"
        );
    }
}

#[test]
fn recipes_are_known_by_their_content() {
    let folder = Folder::new("recipes");
    let store = Store::open(&folder.0).expect("a store");
    let new = |text: &'static str, why: &'static str| NewRecipe {
        name: "housing",
        text,
        nominal_name: "housing.STEP",
        nominal: b"ISO-10303-21;",
        author: "berta",
        why,
    };
    let first = store
        .add_recipe(&new("[limits]", "first"), at(0))
        .expect("added");
    let second = store
        .add_recipe(&new("[limits]\nd_mm = 1", "wider"), at(1))
        .expect("added");
    let again = store
        .add_recipe(&new("[limits]", "the same"), at(2))
        .expect("known");
    assert_eq!((first.version, second.version), (1, 2));
    assert_eq!(again, first);
    // printf '[limits]\0ISO-10303-21;' | sha256sum
    assert_eq!(
        first.sha256,
        "c2fe0199e77da78d5a97e641d9f2cd10ef81f9dd3f659ae092c634011d24e097"
    );
    assert_eq!(store.active_recipe().expect("read"), None);
    store
        .activate_recipe(first.id, "berta", "first", at(3))
        .expect("activated");
    store
        .activate_recipe(second.id, "berta", "wider", at(4))
        .expect("activated");
    let active = store.active_recipe().expect("read").expect("one");
    assert_eq!(active.version.id, second.id);
    assert!(active.version.active);
    assert_eq!(
        fs::read(&active.nominal).expect("the nominal"),
        b"ISO-10303-21;"
    );
    assert!(
        active
            .nominal
            .extension()
            .is_some_and(|ending| ending == "step")
    );
    let newest = store.audit_log(None, 1).expect("entries").remove(0);
    assert_eq!(newest.action, "recipe.activate");
    assert_eq!(newest.old, format!("housing v1 {}", first.sha256));
    assert_eq!(newest.new, format!("housing v2 {}", second.sha256));
    assert_eq!(newest.why, "wider");
}

#[test]
fn people_lose_their_sessions_with_their_role() {
    let folder = Folder::new("people");
    let store = Store::open(&folder.0).expect("a store");
    store
        .add_person("anna", Role::Operator, "hash", at(0))
        .expect("added");
    let twice = store
        .add_person("anna", Role::Setter, "hash", at(0))
        .expect_err("taken");
    assert!(matches!(twice, StoreError::Exists { .. }));
    let hour = Duration::from_secs(3600);
    store
        .add_session(
            "secret",
            "anna",
            SessionKind::Session,
            "browser",
            at(0),
            hour,
        )
        .expect("added");
    let role = |secret, seconds| {
        let holder = store.holder(secret, at(seconds)).expect("read");
        holder.map(|person| person.role)
    };
    assert_eq!(role("secret", 3599), Some(Role::Operator));
    assert_eq!(role("secret", 3600), None, "it has run out");
    assert_eq!(role("other", 1), None);
    store
        .change_person("anna", Some(Role::Setter), None, None, at(2))
        .expect("changed");
    assert_eq!(role("secret", 3), None, "a new role, a new session");
    store
        .add_session("token", "anna", SessionKind::Token, "plc", at(3), hour)
        .expect("added");
    assert_eq!(role("token", 4), Some(Role::Setter));
    let sessions = store.sessions().expect("read");
    store.revoke_session(&sessions[0].id).expect("revoked");
    assert_eq!(role("token", 5), None);
}

#[test]
fn a_scan_comes_back_bit_for_bit_and_small() {
    let folder = Folder::new("scan");
    fs::create_dir_all(&folder.0).expect("a folder");
    let path = folder.join("1.raw");
    let written: Vec<(usize, Profile)> = (0..400)
        .map(|i| (i % 2, profile(i as u32 / 2, 640)))
        .collect();
    let mut writer = ScanWriter::create(&path, &views()).expect("a writer");
    for (view, profile) in &written {
        writer.push(*view, profile).expect("written");
    }
    assert!(!path.exists(), "it has its name only when it is whole");
    let bytes = writer.finish(true).expect("finished");
    assert_eq!(bytes, fs::metadata(&path).expect("the file").len());
    let reader = ScanReader::open(&path).expect("a reader");
    assert_eq!(reader.views(), views());
    let (mut read, whole) = read_all(&path);
    assert!(whole);
    // Chunks are per view: within a view the order is kept.
    read.sort_by_key(|(view, profile)| (profile.sequence, *view));
    assert_eq!(read.len(), written.len());
    assert!(
        read.iter()
            .zip(&written)
            .all(|((a, p), (b, q))| a == b && same(p, q))
    );
    let coordinates = 400 * 640 * 16;
    assert!(
        bytes < coordinates / 2,
        "{bytes} bytes for {coordinates} bytes of coordinates"
    );
}

#[test]
fn a_scan_cut_off_anywhere_gives_what_came_before() {
    let folder = Folder::new("cut");
    fs::create_dir_all(&folder.0).expect("a folder");
    let path = folder.join("1.raw");
    let mut writer = ScanWriter::create(&path, &views()).expect("a writer");
    // Three chunks of one view: 70 profiles of 1000 columns fill one.
    let written: Vec<Profile> = (0..150).map(|i| profile(i, 1000)).collect();
    for profile in &written {
        writer.push(0, profile).expect("written");
    }
    writer.finish(true).expect("finished");
    let bytes = fs::read(&path).expect("the file");
    let cut = folder.join("cut.raw");
    let mut seen = std::collections::BTreeSet::new();
    for length in (0..bytes.len())
        .step_by(4_999)
        .chain(bytes.len() - 12..bytes.len())
    {
        fs::write(&cut, &bytes[..length]).expect("a cut file");
        match ScanReader::open(&cut) {
            Err(error) => assert!(length < 9, "{length}: {error}"),
            Ok(mut reader) => {
                let mut read = Vec::new();
                while let Some((_, profiles)) = reader.profiles().expect("cut off, not damaged") {
                    read.extend(profiles);
                }
                assert!(!reader.whole());
                assert!(read.iter().zip(&written).all(|(a, b)| same(a, b)));
                seen.insert(read.len());
            }
        }
    }
    assert!(
        seen.len() == 4,
        "each chunk counts as soon as it is there: {seen:?}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_damaged_scan_is_said_and_never_believed(flips in prop::collection::vec((0usize..4000, 1u8..=255), 1..4)) {
        let folder = Folder::new("damaged");
        fs::create_dir_all(&folder.0).expect("a folder");
        let path = folder.join("1.raw");
        let written: Vec<Profile> = (0..40).map(|i| profile(i, 50)).collect();
        let mut writer = ScanWriter::create(&path, &views()).expect("a writer");
        for profile in &written {
            writer.push(1, profile).expect("written");
        }
        writer.finish(true).expect("finished");
        let mut bytes = fs::read(&path).expect("the file");
        let length = bytes.len();
        for (place, flip) in flips {
            bytes[place % length] ^= flip;
        }
        fs::write(&path, &bytes).expect("a damaged file");
        if let Ok(mut reader) = ScanReader::open(&path) {
            while let Ok(Some((view, profiles))) = reader.profiles() {
                // What passes the checksum is what was written, or names another view that exists.
                prop_assert!(view < 2);
                prop_assert!(profiles.iter().zip(&written).all(|(a, b)| same(a, b)));
            }
        }
    }
}

#[test]
fn what_a_crash_left_is_aborted_with_its_raw_data() {
    let folder = Folder::new("crash");
    let store = Store::open(&folder.0).expect("a store");
    let done = measure(&store, "A", Status::Ok, 0);
    let begin = |serial: &str| {
        let (inspection, _) = store
            .queue(&trigger(&order(serial), None), at(10))
            .expect("queued");
        let name = format!("{:08}.raw", inspection.id);
        store
            .begin(inspection.id, None, &name, at(11))
            .expect("begun");
        (inspection.id, folder.join("scans").join(name))
    };
    let (scanning, scanning_path) = begin("B");
    let mut writer = ScanWriter::create(&scanning_path, &views()).expect("a writer");
    for sequence in 0..150 {
        writer.push(0, &profile(sequence, 1000)).expect("written");
    }
    // The process ends here: what is still in the writer's memory is gone.
    std::mem::forget(writer);
    let (placed, placed_path) = begin("C");
    let mut writer = ScanWriter::create(&placed_path, &views()).expect("a writer");
    writer.push(0, &profile(0, 10)).expect("written");
    writer
        .finish(true)
        .expect("placed, and the crash comes before that is noted");
    let (empty, _) = begin("D");
    let (waiting, _) = store
        .queue(&trigger(&order("E"), None), at(12))
        .expect("queued");
    drop(store);

    let store = Store::open(&folder.0).expect("the store again");
    let aborted = store.recover("the daemon ended", at(20)).expect("mended");
    assert_eq!(
        aborted
            .iter()
            .map(|inspection| inspection.id)
            .collect::<Vec<_>>(),
        [scanning, placed, empty, waiting.id]
    );
    assert!(
        aborted
            .iter()
            .all(|i| i.phase == Phase::Aborted && i.reason == "the daemon ended")
    );
    assert_eq!(
        store.inspection(done).expect("the done one").phase,
        Phase::Done
    );
    let of = |id: i64| store.inspection(id).expect("an inspection").scan_whole;
    assert_eq!(
        [of(scanning), of(placed), of(empty), of(waiting.id)],
        [Some(false), Some(true), None, None]
    );
    let (profiles, whole) = read_all(&store.scan_path(scanning).expect("its raw data"));
    assert!(!whole);
    assert_eq!(
        profiles.len(),
        132,
        "two chunks of 66 profiles had reached the disk"
    );
    let left: Vec<_> = fs::read_dir(folder.join("scans"))
        .expect("the folder")
        .flatten()
        .collect();
    assert_eq!(left.len(), 2, "no half file is left: {left:?}");
    assert_eq!(
        store
            .recover("again", at(30))
            .expect("nothing to mend")
            .len(),
        0
    );
}

#[test]
fn the_retention_rule_removes_the_oldest_raw_data_only() {
    let folder = Folder::new("retention");
    let store = Store::open(&folder.0).expect("a store");
    let ids: Vec<i64> = (0..6)
        .map(|i| {
            let verdict = if i % 2 == 0 {
                Status::Ok
            } else {
                Status::NotOk
            };
            let id = measure(&store, "A", verdict, 100 * i);
            fs::write(folder.join("scans").join(format!("{id:08}.raw")), [0; 1000])
                .expect("raw data");
            store.scan_kept(id, 1000, true).expect("noted");
            id
        })
        .collect();
    let kept = || -> Vec<i64> {
        ids.iter()
            .copied()
            .filter(|id| store.scan_path(*id).is_ok_and(|path| path.is_file()))
            .collect()
    };
    let rule = Retention {
        free_at_least: 0,
        ..Retention::default()
    };
    assert_eq!(store.sweep(&rule, at(600)).expect("swept").scans, 0);
    let ok_for_a_while = Retention {
        ok_scans_for: Some(Duration::from_secs(350)),
        ..rule
    };
    // At 600 s, those of the OK parts that ended at 2 s and at 202 s are older than 350 s.
    assert_eq!(
        store.sweep(&ok_for_a_while, at(600)).expect("swept").scans,
        2
    );
    assert_eq!(kept(), [ids[1], ids[3], ids[4], ids[5]]);
    let small = Retention {
        scans_at_most: 2500,
        ..rule
    };
    let swept = store.sweep(&small, at(600)).expect("swept");
    assert_eq!((swept.scans, swept.bytes), (2, 2000));
    assert_eq!(kept(), [ids[4], ids[5]]);
    let nothing = Retention {
        scans_at_most: 0,
        ..rule
    };
    store.sweep(&nothing, at(600)).expect("swept");
    assert_eq!(kept(), [ids[5]], "the newest stays");
    assert!(
        ids.iter().all(|id| store.report_json(*id).is_ok()),
        "results stay"
    );
}

#[test]
fn a_backup_taken_while_others_write_is_a_store() {
    let folder = Folder::new("backup");
    let store = Store::open(&folder.join("store")).expect("a store");
    let first = measure(&store, "A", Status::Ok, 0);
    std::thread::scope(|scope| {
        let writing = scope.spawn(|| {
            for number in 0..20 {
                measure(&store, "B", Status::Ok, number);
            }
        });
        store.backup(&folder.join("backup")).expect("a backup");
        writing.join().expect("the writer");
    });
    let exists = store
        .backup(&folder.join("backup"))
        .expect_err("it is there already");
    assert!(matches!(exists, StoreError::Exists { .. }));
    let last = measure(&store, "C", Status::NotOk, 50);
    let lock = store.lock().expect("a daemon's lock");
    assert!(matches!(store.lock(), Err(StoreError::InUse { .. })));
    let in_use = restore(&folder.join("backup"), &folder.join("store")).expect_err("a daemon runs");
    assert!(
        in_use.to_string().contains("stop that one first"),
        "{in_use}"
    );
    drop((lock, store));
    restore(&folder.join("backup"), &folder.join("store")).expect("restored");
    let store = Store::open(&folder.join("store")).expect("the restored store");
    assert_eq!(
        store.inspection(first).expect("there at the backup").phase,
        Phase::Done
    );
    assert!(store.inspection(last).is_err(), "made after the backup");
    let old = Store::open(&folder.join("store.before-restore")).expect("what was there before");
    assert!(old.inspection(last).is_ok());
    fs::write(folder.join("backup").join("acies.db"), b"nonsense").expect("damaged");
    let damaged = restore(&folder.join("backup"), &folder.join("other")).expect_err("damaged");
    assert!(damaged.to_string().contains("acies.db"), "{damaged}");
    assert!(!folder.join("other").exists());
}

#[test]
fn exports_hold_every_characteristic_of_every_result() {
    let folder = Folder::new("export");
    let store = Store::open(&folder.0).expect("a store");
    for number in 0..3 {
        measure(&store, &format!("A, \"{number}\""), Status::Ok, number);
    }
    store
        .refuse(&trigger(&order("B"), None), "not ready", at(9))
        .expect("kept");
    let report = report(Status::Ok);
    let values: Vec<_> = report
        .edges
        .iter()
        .flat_map(|edge| &edge.characteristics)
        .collect();
    let mut csv = Vec::new();
    let written = store
        .export(Export::Csv, &History::default(), &mut csv)
        .expect("exported");
    assert_eq!(written, 3);
    let mut table = csv::Reader::from_reader(csv.as_slice());
    let rows: Vec<csv::StringRecord> = table.records().map(|row| row.expect("a row")).collect();
    assert_eq!(rows.len(), 3 * values.len());
    assert_eq!(&rows[0][1], "A, \"2\"", "newest first, quoted as CSV does");
    for (row, value) in rows.iter().zip(&values) {
        assert_eq!(row[9], value.id);
        assert_eq!(row[10].parse::<f64>().ok(), value.value, "all digits");
    }
    let mut lines = Vec::new();
    store
        .export(Export::JsonLines, &History::default(), &mut lines)
        .expect("exported");
    let lines = String::from_utf8(lines).expect("text");
    let first: serde_json::Value =
        serde_json::from_str(lines.lines().next().expect("a line")).expect("JSON");
    assert_eq!(first["inspection"]["part_serial"], "A, \"2\"");
    assert_eq!(
        serde_json::from_value::<Report>(first["report"].clone()).expect("a report"),
        report
    );
}

#[test]
fn a_store_of_a_newer_program_or_of_another_is_refused() {
    let folder = Folder::new("newer");
    drop(Store::open(&folder.0).expect("a store"));
    let raw = rusqlite::Connection::open(folder.join("acies.db")).expect("the database");
    raw.pragma_update(None, "user_version", 99)
        .expect("a version");
    drop(raw);
    let error = Store::open(&folder.0).expect_err("too new");
    assert!(
        error.to_string().contains("a newer acies wrote it"),
        "{error}"
    );
    fs::write(
        folder.join("acies.db"),
        b"this is no database, it is a text",
    )
    .expect("a file");
    let error = Store::open(&folder.0).expect_err("no database");
    assert!(error.to_string().contains("acies.db"), "{error}");
}

#[cfg(feature = "parquet")]
#[test]
fn parquet_holds_every_station_of_every_result() {
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::RowAccessor;

    let folder = Folder::new("parquet");
    let store = Store::open(&folder.0).expect("a store");
    for number in 0..3 {
        measure(&store, &format!("A-{number}"), Status::Ok, number);
    }
    let path = folder.join("stations.parquet");
    let mut file = fs::File::create(&path).expect("a file");
    let written = store
        .export(Export::Parquet, &History::default(), &mut file)
        .expect("exported");
    assert_eq!(written, 3);
    let report = report(Status::Ok);
    let stations: Vec<_> = report
        .edges
        .iter()
        .flat_map(|edge| &edge.stations)
        .collect();
    let reader =
        SerializedFileReader::new(fs::File::open(&path).expect("the file")).expect("Parquet");
    let rows: Vec<_> = reader
        .get_row_iter(None)
        .expect("rows")
        .map(|row| row.expect("a row"))
        .collect();
    assert_eq!(rows.len(), 3 * stations.len());
    for (row, station) in rows.iter().zip(stations) {
        assert_eq!(row.get_long(0).expect("an inspection"), 3, "newest first");
        assert_eq!(row.get_string(1).expect("a part"), "A-2");
        assert_eq!(row.get_double(5).expect("a place"), station.s_mm);
        assert_eq!(
            row.get_double(9).ok(),
            station.d1_mm,
            "not measured is null"
        );
    }
}
