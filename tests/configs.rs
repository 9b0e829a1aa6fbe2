//! Configurations: every mistake is told at once, with its line, what was seen and what is allowed.

use std::path::{Path, PathBuf};

use acies::config::Cell;

/// A sound cell; the tests break it.
const SOUND: &str = r#"name = "bench"

[part]
nominal = "part.step"
[part.machine_from_part]
origin_mm = [10, 20.5, 0]
x_axis = [0, 1, 0]
z_axis = [0, 0, 1]

[stage]
travel_mm_per_count = [0, 0.001, 0]
end_count = 60000

[[device]]
name = "left"
driver = "open-profile"
port = "./dev/left"
rate_hz = 500
[device.calibration]
origin_mm = [0, 0, 110]
x_axis = [1, 0, 0]
z_axis = [0, 0, -1]

[[device]]
name = "right"
driver = "open-profile"
address = "127.0.0.1:7450"
[device.calibration]
origin_mm = [0, 0, 110]
x_axis = [1, 0, 0]
z_axis = [0, 0, -1]
"#;

/// A folder of its own with a file `part.step` in it, and the path of a configuration beside it.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::create_dir_all(&folder).expect("a folder for the test");
    std::fs::write(folder.join("part.step"), "ISO-10303-21;").expect("a file for the test");
    folder.join("cell.toml")
}

/// The mistakes of `text` as lines, without the folder.
fn mistakes(name: &str, text: &str) -> Vec<String> {
    let path = folder(name);
    let folder = format!("{}/", path.parent().expect("a folder").display());
    let errors = Cell::parse(text, &path).expect_err("mistakes");
    errors
        .mistakes
        .iter()
        .map(|mistake| mistake.to_string().replace(&folder, ""))
        .collect()
}

#[test]
fn a_sound_cell_becomes_values() {
    let path = folder("sound");
    let cell = Cell::parse(SOUND, &path).expect("a sound cell");
    assert_eq!(
        (cell.name.as_str(), cell.profilers.len(), cell.probes.len()),
        ("bench", 2, 0)
    );
    assert_eq!(cell.plan.end_count, 60000);
    let x_in_machine = cell.machine_from_part.vector(glam::DVec3::X);
    assert!(
        (x_in_machine - glam::DVec3::Y).length() < 1e-12,
        "{x_in_machine}"
    );
    let claims: Vec<String> = cell
        .profilers
        .iter()
        .flat_map(|p| p.setup.claims())
        .map(|claim| claim.to_string())
        .collect();
    let folder = path.parent().expect("a folder");
    assert_eq!(
        claims,
        [
            format!("port {}/dev/left", folder.display()),
            "address 127.0.0.1:7450".to_owned()
        ]
    );
}

#[test]
fn unknown_keys_wrong_units_and_wrong_types_are_told_together() {
    let text = SOUND
        .replace("name = \"bench\"", "nmae = \"bench\"")
        .replace("rate_hz = 500", "rate_khz = 0.5\ncolumns = 0")
        .replace(
            "travel_mm_per_count = [0, 0.001, 0]",
            "travel_mm_per_count = [0, 1000, 0]",
        )
        .replace("end_count = 60000", "end_count = \"60 mm\"")
        .replace("nominal = \"part.step\"", "nominal = \"absent.step\"");
    assert_eq!(
        mistakes("together", &text),
        [
            "cell.toml: name: nothing, expected a text",
            "cell.toml:1: nmae: an unknown key, expected one of name, part, device, service, stage",
            "cell.toml:4: part: nominal: no file absent.step, expected a file that exists",
            "cell.toml:12: stage: end_count: \"60 mm\", expected a whole number of -1000000000000 to \
             1000000000000",
            "cell.toml:11: stage: travel_mm_per_count: 1000 mm a count, expected a length of 1e-7 to 10 mm a count",
            "cell.toml:19: device \"left\": columns: 0, expected a whole number of 1 to 32768",
            "cell.toml:18: device \"left\": rate_khz: an unknown key, expected one of baud, port, usb_serial, \
             usb_id, address, serial_number, trigger, encoder_step, columns, rate_hz, exposure_us, \
             laser_power_percent, keepalive_s",
        ]
    );
}

#[test]
fn two_devices_on_one_port_are_named() {
    let text = SOUND.replace("address = \"127.0.0.1:7450\"", "port = \"./dev/left\"");
    assert_eq!(
        mistakes("one-port", &text),
        [
            "cell.toml: device: port: port dev/left is wanted by \"left\" and \"right\", expected one device on each port"
        ]
    );
    let text = SOUND.replace("\"right\"", "\"left\"");
    assert_eq!(
        mistakes("one-name", &text),
        [
            "cell.toml: device: name: \"left\" more than once, expected a name of its own for every device"
        ]
    );
}

#[test]
fn a_pose_must_be_a_pose() {
    let text = SOUND.replacen("z_axis = [0, 0, -1]", "z_axis = [0.1, 0, -1]", 1);
    let told = mistakes("pose", &text);
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(
        told[0].starts_with(
            "cell.toml:21: device \"left\": calibration.x_axis: lengths 1 and 1.00498"
        ),
        "{told:?}"
    );
    assert!(
        told[0].ends_with("expected unit vectors at right angles, to six digits"),
        "{told:?}"
    );
}

#[test]
fn a_device_is_a_profiler_or_a_probe() {
    let text = SOUND.replace("[device.calibration]", "[device.calibratoin]");
    let told = mistakes("neither", &text);
    assert!(
        told.contains(
            &"cell.toml:14: device \"left\": calibration: none, expected one of [device.calibration] for a profiler, \
              [device.tip] for a probe, [device.carrier] for a robot"
                .to_owned()
        ),
        "{told:?}"
    );
    let text = SOUND.replacen("driver = \"open-profile\"", "driver = \"openprofile\"", 1);
    assert_eq!(
        mistakes("driver", &text)[0],
        format!(
            "cell.toml:16: device \"left\": driver: \"openprofile\", expected one of {}",
            acies_drivers::ALL
                .iter()
                .map(|driver| driver.name)
                .collect::<Vec<_>>()
                .join(", ")
        )
    );
}

#[test]
fn a_robot_takes_the_place_of_the_stage() {
    let carried = SOUND.replace(
        "[stage]\ntravel_mm_per_count = [0, 0.001, 0]\nend_count = 60000\n",
        "",
    ) + r#"
[[device]]
name = "arm"
driver = "ur-rtde"
address = "10.0.0.9"
[device.carrier]
end_mm = [1, 2, 3]
[device.carrier.machine_from_base]
origin_mm = [0, 0, 0]
x_axis = [1, 0, 0]
z_axis = [0, 0, 1]
"#;
    let cell = Cell::parse(&carried, &folder("carried")).expect("a sound cell");
    let carrier = cell.carrier.expect("a carrier");
    assert_eq!(
        (carrier.name.as_str(), carrier.plan.within_mm),
        ("arm", 1.0)
    );
    let both = carried.replace(
        "[[device]]\nname = \"left\"",
        "[stage]\nend_count = 1\n[[device]]\nname = \"left\"",
    );
    assert_eq!(
        mistakes("carried-stage", &both),
        ["cell.toml:11: stage: a table, expected none beside [device.carrier]"]
    );
    let bad = carried.replace("end_mm = [1, 2, 3]", "end = [1, 2, 3]\nlag_s = 3");
    assert_eq!(
        mistakes("carried-end", &bad),
        [
            "cell.toml:34: device \"arm\", carrier: end_mm: nothing, expected three numbers",
            "cell.toml:36: device \"arm\", carrier: lag_s: 3, expected a number of -1 to 1",
            "cell.toml:35: device \"arm\", carrier: end: an unknown key, expected one of machine_from_base, end_mm, \
             within_mm, lag_s, silence_s",
        ]
    );
    let two = carried.clone()
        + &carried[carried
            .find("[[device]]\nname = \"arm\"")
            .expect("the robot")..]
            .replace("arm", "other")
            .replace("10.0.0.9", "10.0.0.10");
    assert_eq!(
        mistakes("carried-two", &two),
        ["cell.toml: device: carrier: 2 devices with [device.carrier], expected one robot"]
    );
}

#[test]
fn text_that_is_no_toml_is_told_with_its_line() {
    let told = mistakes("syntax", "name = \"a\"\n[part\n");
    assert_eq!(told.len(), 1);
    assert!(told[0].starts_with("cell.toml:2: syntax: "), "{told:?}");
    let absent = Cell::read(Path::new("/nowhere/cell.toml"))
        .expect_err("no such file")
        .to_string();
    assert_eq!(
        absent,
        "/nowhere/cell.toml: file: No such file or directory (os error 2), expected a readable TOML file"
    );
}

#[test]
fn a_calibration_has_a_date_and_runs_out() {
    use std::time::{Duration, SystemTime};
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/cell.toml");
    let text = std::fs::read_to_string(&path).expect("the demo's cell");
    let with = |added: &str| {
        let text = text.replacen(
            "[device.calibration]",
            &format!("[device.calibration]\n{added}"),
            1,
        );
        acies::config::Cell::parse(&text, &path)
    };
    let cell = with("date = 2026-01-31T12:00:00Z\nvalid_days = 10").expect("a sound cell");
    let left = cell.profilers[0].calibrated.expect("it has a date");
    // 2026-01-31 12:00 UTC, by the calendar: 20484 days and a half after 1970.
    let made = SystemTime::UNIX_EPOCH + Duration::from_secs(20_484 * 86_400 + 43_200);
    let day = Duration::from_secs(86_400);
    assert_eq!(left.date, made);
    assert_eq!(left.overdue(made + 9 * day), None);
    assert_eq!(left.overdue(made + 11 * day), Some(made + 10 * day));
    assert_eq!(cell.profilers[1].calibrated, None);
    let undated = with("valid_days = 10").expect_err("no date");
    assert!(
        undated
            .to_string()
            .contains("the time of the calibration beside valid_days"),
        "{undated}"
    );
    let nonsense = with("date = \"yesterday\"").expect_err("no time");
    assert!(nonsense.to_string().contains("a time as in"), "{nonsense}");
}

/// The examples that stand in `configs/` for one driver each, with the devices of their tables simulated under the same names.
#[test]
fn every_example_of_a_driver_opens_its_simulated_devices() {
    use acies_drivers::device::Instrument;
    use acies_drivers::link::cable::Cable;
    use acies_simulators::devices::{self, Place};

    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let here = Path::new(env!("CARGO_TARGET_TMPDIR")).join("examples");
    std::fs::create_dir_all(here.join("demo")).expect("a folder");
    std::fs::copy(configs.join("demo/part.step"), here.join("demo/part.step")).expect("the part");
    for name in ["optoncdt", "rf60x", "serial-gauge"] {
        let folder = here.join(name);
        std::fs::create_dir_all(folder.join("dev")).expect("a folder");
        let file = folder.join("cell.toml");
        std::fs::copy(configs.join(name).join("cell.toml"), &file).expect("the example");
        let cell = Cell::read(&file).unwrap_or_else(|errors| panic!("{errors}"));
        assert!(!cell.profilers.is_empty());
        for profiler in &cell.profilers {
            let claim = profiler.setup.claims()[0].to_string();
            let port = claim.trim_start_matches("port ");
            let device = devices::start(&profiler.name, &Place::Pty(port.into()), 1, "");
            let device = device.expect("a simulated device");
            assert_eq!(device.port(), port);
            let opened = profiler.setup.open(&Cable);
            let Ok(Instrument::Profiler(mut open)) = opened else {
                panic!("{name}: {}: {:?}", profiler.name, opened.err());
            };
            open.start().expect("a start");
            let soon = std::time::Instant::now() + std::time::Duration::from_secs(20);
            let profile = open.next(soon).expect("a run").expect("a profile in time");
            assert!(profile.z_mm.iter().any(|z| z.is_finite()), "{name}");
            open.stop().expect("a stop");
        }
    }
}

#[test]
fn a_service_that_others_could_listen_to_is_refused_and_the_defaults_are_safe() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo/cell.toml");
    let text = std::fs::read_to_string(&path).expect("the demo's cell");
    let service = Cell::parse(&text, &path).expect("in order").service;
    assert!(service.address.ip().is_loopback() && service.tls.is_none());
    assert_eq!(service.store, path.with_file_name("store"));
    assert_eq!(service.anonymous, Some(acies::store::Role::Operator));
    assert!(!service.simulated);
    let told = |lines: &str| -> Vec<String> {
        let text = text.replacen("[part]", &format!("[service]\n{lines}\n[part]"), 1);
        match Cell::parse(&text, &path) {
            Ok(_) => Vec::new(),
            Err(errors) => errors
                .mistakes
                .iter()
                .map(|m| m.mistake.to_string())
                .collect(),
        }
    };
    assert_eq!(
        told("address = \"0.0.0.0:8370\""),
        [
            "address: 0.0.0.0:8370 without a certificate, expected certificate and private_key for an address that others can \
             reach: passwords would be readable on the way"
        ]
    );
    assert_eq!(
        told("address = \"0.0.0.0:8370\"\ncertificate = \"a.pem\"\nprivate_key = \"a.key\""),
        [""; 0]
    );
    assert_eq!(
        told("certificate = \"a.pem\"\nqueue_limit = -1"),
        [
            "queue_limit: -1, expected a whole number of 0 to 1000",
            "certificate: one of two, expected certificate and private_key, or neither"
        ]
    );
    assert_eq!(
        told("address = \"here\"\nanonymous = \"setter\""),
        [
            "anonymous: \"setter\", expected \"operator\" or \"nobody\"",
            "address: \"here\", expected an address and a port, as in \"127.0.0.1:8370\""
        ]
    );
}

#[test]
fn every_example_is_without_mistakes() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut cells = 0;
    for entry in std::fs::read_dir(folder).expect("the examples") {
        let path = entry.expect("an entry").path().join("cell.toml");
        let cell = Cell::read(&path).unwrap_or_else(|errors| panic!("{errors}"));
        assert!(!cell.profilers.is_empty(), "{}", path.display());
        cells += 1;
    }
    assert!(cells > 1, "{cells} examples");
}
