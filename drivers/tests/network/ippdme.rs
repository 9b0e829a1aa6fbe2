//! The I++ DME driver against its simulated machine, and against the logs of the NIST test suite.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_drivers::device::{Instrument, Presence, Probe};
use acies_drivers::ippdme::Session;
use acies_drivers::ippdme::line::{Kind, Tag, response};
use acies_drivers::link::cable::Cable;
use acies_drivers::link::{Links, Target};
use acies_simulators::demo_cell::{DemoCell, TIP_RADIUS_MM};
use acies_simulators::ippdme::{Misdeeds, Setup, SimulatedCmm};
use glam::DVec3;

use crate::support::{Hostile, SOON, open, refusal, setup, text};

fn cmm(cell: &DemoCell, change: impl FnOnce(&mut Setup)) -> SimulatedCmm {
    let mut setup = Setup::new(
        Arc::clone(&cell.part.made),
        cell.machine_from_part,
        TIP_RADIUS_MM,
    );
    change(&mut setup);
    SimulatedCmm::start(setup).expect("a simulated machine")
}

fn table(device: &SimulatedCmm, more: &str) -> String {
    let reports = if more.contains("reports") {
        ""
    } else {
        "reports = 'tip-centre'"
    };
    format!(
        "address = '{}'\n{reports}\nsafe_z_mm = 150\n{more}",
        device.address()
    )
}

fn probe(device: &SimulatedCmm, more: &str) -> Box<dyn Probe> {
    match open("ippdme", &table(device, more)) {
        Ok(Instrument::Probe(probe)) => probe,
        Ok(_) => panic!("no probe"),
        Err(error) => panic!("{}", text(&error)),
    }
}

fn touch(probe: &mut dyn Probe, cell: &DemoCell, which: usize) -> Result<[f64; 3], String> {
    let way = &cell.touches[which];
    let touched = probe.touch(way.start.to_array(), way.target.to_array(), SOON);
    touched
        .map(|touch| touch.tip_centre_mm)
        .map_err(|error| text(&error))
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn every_touch_is_where_the_tip_was_however_the_server_reports_it() {
    let cell = DemoCell::new(3);
    for (compensated, more) in [
        (false, "tool = 'Probe1'\nmachine_class = 'CartCMM'"),
        (true, "reports = 'surface'\ntip_radius_mm = 1.0"),
    ] {
        for misdeeds in [
            Misdeeds::default(),
            Misdeeds {
                chatter: true,
                pieces: Some(3),
                ..Misdeeds::default()
            },
        ] {
            let device = cmm(&cell, |setup| {
                setup.compensated = compensated;
                setup.misdeeds = misdeeds;
            });
            let mut probe = probe(&device, more);
            assert_eq!(probe.identity().firmware, "1.4.3");
            for which in 0..cell.touches.len() {
                let centre = touch(probe.as_mut(), &cell, which).expect("a touch");
                let truth = device.truth().touches_mm[which].to_array();
                // Five digits behind the point, in position and normal.
                assert!(distance(centre, truth) < 3e-5, "{centre:?} {truth:?}");
            }
            drop(probe);
            let truth = device.truth();
            assert!(truth.ended == 1 && !truth.in_session);
        }
    }
}

#[test]
fn a_miss_is_told_and_the_next_touch_works() {
    let cell = DemoCell::new(3);
    let device = cmm(&cell, |_| ());
    let mut probe = probe(&device, "");
    let error = probe
        .touch([0.0, 0.0, 400.0], [0.0, 0.0, 390.0], SOON)
        .expect_err("a miss");
    assert_eq!(
        text(&error),
        format!(
            "{}: PtMeas is refused: error 1006, severity 2, \"Surface not found\" (\"00013 PtMeas(X(0.0000000), Y(0.0000000), Z(395.0000000), IJK(-0.0000000, -0.0000000, 1.0000000))\"); check that the part lies there and the probe is sound",
            device.address()
        )
    );
    touch(probe.as_mut(), &cell, 0).expect("a touch");
    let commands = device.truth().commands;
    assert_eq!(
        commands.iter().filter(|c| *c == "ClearAllErrors()").count(),
        1
    );
}

#[test]
fn after_other_errors_nothing_moves_until_it_is_reopened() {
    let cell = DemoCell::new(3);
    let device = cmm(&cell, |setup| setup.misdeeds.fail_point = Some((1, 2504)));
    let mut first = probe(&device, "");
    let error = touch(first.as_mut(), &cell, 0).expect_err("a collision");
    assert!(
        error.contains("PtMeas is refused: error 2504, severity 3"),
        "{error}"
    );
    let sent = device.truth().commands.len();
    let error = touch(first.as_mut(), &cell, 1).expect_err("no move after that");
    assert!(
        error.ends_with("needs somebody to look at the machine; then reopen it"),
        "{error}"
    );
    assert_eq!(device.truth().commands.len(), sent, "nothing was sent");
    drop(first);
    touch(probe(&device, "").as_mut(), &cell, 1).expect("a touch after reopening");
}

#[test]
fn what_ends_a_touch_is_told() {
    let cell = DemoCell::new(3);
    let told = |misdeeds: Misdeeds, timeout: Duration| {
        let device = cmm(&cell, |setup| setup.misdeeds = misdeeds);
        let mut probe = probe(&device, "");
        let way = &cell.touches[0];
        let error = probe.touch(way.start.to_array(), way.target.to_array(), timeout);
        let commands = device.truth().commands;
        (text(&error.expect_err("an end")), commands)
    };
    let (closed, _) = told(
        Misdeeds {
            close_in_point: Some(1),
            ..Misdeeds::default()
        },
        SOON,
    );
    assert!(
        closed.ends_with("it is gone: closed or unplugged; plug it in again and reopen"),
        "{closed}"
    );
    let (garbled, _) = told(
        Misdeeds {
            garble_point: Some(1),
            ..Misdeeds::default()
        },
        SOON,
    );
    assert!(
        garbled.contains("bad data from the device: the line \"000"),
        "{garbled}"
    );
    let hang = Misdeeds {
        hang_in_point: Some(1),
        ..Misdeeds::default()
    };
    let (hung, commands) = told(hang, Duration::from_millis(500));
    assert!(
        hung.contains("the move did not end within 0.") && hung.contains("and was held"),
        "{hung}"
    );
    assert!(
        commands.iter().any(|command| command == "AbortE()"),
        "{commands:?}"
    );
}

#[test]
fn a_late_server_is_waited_for_and_an_idle_one_asked() {
    let cell = DemoCell::new(3);
    let device = cmm(&cell, |setup| setup.misdeeds.late_ms = Some(300));
    let mut probe = probe(&device, "");
    touch(probe.as_mut(), &cell, 0).expect("a touch");
    let before = device.truth().touches_mm.len();
    assert_eq!(probe.check().ok(), Some(Presence::Answered));
    let truth = device.truth();
    assert_eq!(
        truth.commands.last().map(String::as_str),
        Some("GetMachineClass()")
    );
    assert_eq!(truth.touches_mm.len(), before, "a check moves nothing");
    drop(device);
    let error = probe.check().expect_err("nobody there");
    assert!(error.may_pass(), "{}", text(&error));
    // One that takes longer than the 5 s of an acknowledgement is silent: `mute` below.
}

#[test]
fn wrong_peers_are_told_apart() {
    let cell = DemoCell::new(3);
    let told = |misdeeds: Misdeeds, more: &str| {
        let device = cmm(&cell, |setup| {
            setup.homed = false;
            setup.misdeeds = misdeeds;
        });
        let text = refusal("ippdme", &table(&device, more));
        text.split_once(": ").expect("an address").1.to_owned()
    };
    assert_eq!(
        told(
            Misdeeds {
                mute: true,
                ..Misdeeds::default()
            },
            ""
        ),
        "no answer within 5 s; check power and cable, then retry"
    );
    assert_eq!(
        told(
            Misdeeds {
                babble: true,
                ..Misdeeds::default()
            },
            ""
        ),
        "bad data from the device: the line \"HTTP/1.1 400 Bad Request\" is none the controller may send"
    );
    assert_eq!(
        told(Misdeeds::default(), ""),
        "open needs a homed machine; home it, or set `home = true`"
    );
    assert_eq!(
        told(Misdeeds::default(), "machine_class = 'ANOTHER'"),
        "answers as \"CartCMM\", the configuration expects \"ANOTHER\"; check which device is plugged in where"
    );
    assert!(
        told(Misdeeds::default(), "home = true\ntool = 'Nothing'")
            .contains("error 1502, severity 3, \"Tool not found\"")
    );
    let endless = Hostile::new(vec![b'x'; 200_000], true);
    let text = refusal(
        "ippdme",
        &format!("address = '{}'\nreports = 'tip-centre'", endless.address),
    );
    assert!(
        text.contains("bytes came within 5 s, but no answer to StartSession"),
        "{text}"
    );
}

#[test]
fn a_second_client_waits_and_a_session_ends_with_its_driver() {
    let cell = DemoCell::new(3);
    let device = cmm(&cell, |_| ());
    for _ in 0..3 {
        drop(probe(&device, ""));
    }
    assert_eq!(device.truth().ended, 3);
}

#[test]
fn sessions_scan_and_report_moves() {
    let cell = DemoCell::new(3);
    for order in [[0, 1, 2], [2, 0, 1]] {
        let device = cmm(&cell, |setup| setup.scan_order = order);
        let address = device.address().to_string();
        let link = Cable
            .open(&Target::Tcp {
                address: address.clone(),
            })
            .expect("a link");
        let mut session = Session::start(address, link).expect("a session");
        let tag = session.report_moves(1.0).expect("reports");
        session
            .ask("GoTo(X(10), Y(20), Z(300))", SOON)
            .expect("a move");
        session.stop_reports(tag).expect("no more reports");
        assert_eq!(session.position().expect("a position"), [10.0, 20.0, 300.0]);
        let reports = session.events().filter(|event| event.tag == tag).count();
        // From (0, 0, 500) it is 201.2 mm.
        assert_eq!(reports, 201);
        // The plate's top, from above: its face is nearly level, its points lie on the scan's line across and near it in height.
        let way = cell.touches[0].start;
        let start = [way.x, way.y, way.z - 7.0];
        let end = [way.x + 10.0, way.y, way.z - 7.0];
        session
            .ask("SetProp(Tool.PtMeasPar.Approach(20))", SOON)
            .expect("a property");
        session
            .ask("SetProp(Tool.PtMeasPar.Search(20))", SOON)
            .expect("a property");
        let points = session
            .scan_line(start, end, [0.0, 0.0, 1.0], 0.25, order, SOON)
            .expect("a scan");
        assert_eq!(points.len(), 41);
        assert!(points.is_sorted_by_key(|(_, at)| *at));
        for (index, ([x, y, z], _)) in points.into_iter().enumerate() {
            assert!((x - (way.x + 0.25 * index as f64)).abs() < 2e-5);
            assert!((y - way.y).abs() < 2e-5);
            assert!((z - start[2]).abs() < 5.0, "{z}");
        }
    }
}

#[test]
fn a_probe_scans_along_a_line_in_whatever_order_its_server_writes() {
    let cell = DemoCell::new(3);
    let from_scene = cell.machine_from_part.inverse();
    for (order, word) in [([0, 1, 2], "xyz"), ([2, 0, 1], "yzx")] {
        let device = cmm(&cell, |setup| setup.scan_order = order);
        let table = format!(
            "address = \"{}\"\nreports = \"tip-centre\"\nscan_order = \"{word}\"",
            device.address()
        );
        let Ok(Instrument::Probe(mut probe)) = open("ippdme", &table) else {
            panic!("no probe");
        };
        let way = cell.touches[0].start;
        let start = [way.x, way.y, way.z - 7.0];
        let end = [way.x + 10.0, way.y, way.z - 7.0];
        let began = Instant::now();
        // A touch first, which tells the server how far from the surface to begin.
        let target = [way.x, way.y, way.z - 40.0];
        let touched = probe.touch(way.to_array(), target, SOON).expect("a touch");
        let scan = probe
            .scan_line(start, end, [0.0, 0.0, 2.0], 0.25, SOON)
            .expect("a scan");
        assert_eq!(scan.len(), 41);
        for (index, point) in scan.iter().enumerate() {
            let [x, y, z] = point.tip_centre_mm;
            assert!((x - (way.x + 0.25 * index as f64)).abs() < 2e-5 && (y - way.y).abs() < 2e-5);
            // The simulated server's scan reports where the axis through the tip meets the surface: the plate's top, plane in the part's
            // frame, to its five digits.
            let in_part = from_scene.point(DVec3::new(x, y, z));
            let first = from_scene.point(DVec3::from(scan[0].tip_centre_mm));
            assert!((in_part.z - first.z).abs() < 2e-5, "{in_part}");
            assert_eq!(point.direction, [0.0, 0.0, -1.0]);
        }
        assert!(scan.is_sorted_by_key(|point| point.host_time) && scan[0].host_time > began);
        let near = scan[0].tip_centre_mm[2] - touched.tip_centre_mm[2];
        assert!(near.abs() < 2.0, "{near}");
        let none = probe.scan_line(start, start, [0.0, 0.0, 1.0], 0.25, SOON);
        assert!(none.is_err_and(|error| error.to_string().contains("a way, a normal and a step")));
    }
}

#[test]
fn every_mistake_of_a_table_is_told() {
    let mistakes = setup("ippdme", "reports = 'surface'\ntool = 'a\"b'").expect_err("mistakes");
    let told: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
    assert_eq!(
        told,
        [
            "address: nothing, expected a host, or host:port, as in \"192.168.1.10\"",
            "tip_radius_mm: nothing, expected the tip's radius, with reports = \"surface\"",
            "tool: 'a\"b', expected a name without quotes",
        ]
    );
}

// ---- The NIST logs ----------------------------------------------------------------------------------------------------

/// What the server said in one log, as (line, understood).
fn said(path: &Path) -> Vec<(String, bool)> {
    let bytes = std::fs::read(path).expect("a readable log");
    let text = String::from_utf8_lossy(&bytes);
    // The client's log has what it received, the server's what it sent.
    let word = match path.to_string_lossy().ends_with("Client.log") {
        true => " Received: ",
        false => " Sent: ",
    };
    text.lines()
        .filter_map(|line| line.split_once(word))
        .map(|(_, line)| line.trim_end_matches(['\r', '\n']).to_owned())
        .map(|line| {
            let understood = response(&line).is_ok();
            (line, understood)
        })
        .collect()
}

#[test]
fn the_logs_of_the_nist_suite_are_understood() {
    let folder =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/cmm/ippdme-test-files");
    let Ok(entries) = std::fs::read_dir(&folder) else {
        eprintln!("skipped: no folder ../shared/data/cmm/ippdme-test-files beside the project");
        return;
    };
    let mut logs: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "log"))
        .collect();
    logs.sort();
    assert_eq!(logs.len(), 128);
    let (mut lines, mut understood, mut wrong) = (0, 0, Vec::new());
    let (mut acks, mut ends, mut errors, mut data, mut events) = (0, 0, 0, 0, 0);
    for log in &logs {
        for (line, sound) in said(log) {
            lines += 1;
            understood += usize::from(sound);
            match response(&line) {
                Ok(found) => {
                    events += usize::from(matches!(found.tag, Tag::Event(_)));
                    match found.kind {
                        Kind::Ack => acks += 1,
                        Kind::Complete => ends += 1,
                        Kind::Data(_) => data += 1,
                        Kind::Error(_) => errors += 1,
                    }
                }
                Err(_) => wrong.push(format!(
                    "{}: {line:?}",
                    log.file_name().unwrap_or_default().to_string_lossy()
                )),
            }
        }
    }
    eprintln!(
        "{lines} lines of 128 logs, {understood} understood: {acks} &, {ends} %, {data} #, {errors} !, {events} of them with an event tag"
    );
    for line in &wrong {
        eprintln!("not understood: {line}");
    }
    assert!(lines > 7_000, "{lines}");
    assert!(wrong.is_empty(), "{} lines", wrong.len());
}
