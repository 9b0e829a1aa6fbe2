//! The open-profile driver against a small model of the protocol's document.

use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_drivers::device::{Instrument, Losses, Profiler};
use acies_drivers::error::DeviceError;

use crate::script::{Device, SOON, Scripted, Wire, mistakes, refusal, setup, text};

const BOOT: u32 = 0xB007;
const TABLE: &str = "port = '/dev/fake'\nkeepalive_s = 0.1";

/// A device as section 7 of the document describes it, and the ways in which it fails here.
#[derive(Default)]
struct Model {
    laser: bool,
    run: u32,
    sent: u32,
    starts: u32,
    keepalives: u32,
    commands: Vec<(u8, Vec<u8>)>,
    /// Replies to START that get lost.
    lose_started: u32,
    /// Status of STARTED.
    start_status: u16,
    /// Does not answer at all.
    mute: bool,
    /// Sends noise all the time and answers nothing.
    babbles: bool,
    /// No encoder.
    plain: bool,
    /// What SET takes of a value: (status, value).
    takes: Option<(u16, i64)>,
    /// Boot number in ALIVE.
    boot: u32,
    /// Sent with STOPPED as `dropped`.
    dropped: u32,
    /// Profiles that come between STOP and STOPPED.
    queued: u32,
    /// Answers this type by REFUSED.
    refuses: Option<u8>,
    /// Answers HELLO by STOPPED.
    confused: bool,
}

fn frame(kind: u8, id: u32, payload: &[u8]) -> Vec<u8> {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);
    let mut bytes = vec![0xA5, 0x5A, 1, kind];
    bytes.extend(id.to_le_bytes());
    bytes.extend((payload.len() as u32).to_le_bytes());
    bytes.extend(crc.checksum(&bytes).to_le_bytes());
    bytes.extend(payload);
    bytes.extend(crc.checksum(&bytes).to_le_bytes());
    bytes
}

fn stopped(id: u32, reason: u16, run: u32, sent: u32, dropped: u32) -> Vec<u8> {
    let mut payload = reason.to_le_bytes().to_vec();
    for field in [run, sent, dropped] {
        payload.extend(field.to_le_bytes());
    }
    frame(0x85, id, &payload)
}

/// A profile of `columns` columns of 16 bits at z = 100 mm.
fn profile(sequence: u32, run: u32, boot: u32, columns: u16) -> Vec<u8> {
    let mut payload = 60_u16.to_le_bytes().to_vec();
    payload.extend(columns.to_le_bytes());
    payload.extend(run.to_le_bytes());
    payload.extend(boot.to_le_bytes());
    payload.extend(u64::from(sequence).to_le_bytes());
    payload.extend([0; 8 + 4 + 4]);
    payload.extend(1000_u32.to_le_bytes());
    payload.extend(0_i64.to_le_bytes());
    payload.extend(1000_u32.to_le_bytes());
    payload.extend(100_000_000_i64.to_le_bytes());
    payload.resize(60 + 2 * usize::from(columns), 0);
    frame(0x90, sequence, &payload)
}

impl Model {
    fn identity(&self) -> Vec<u8> {
        let mut payload = Vec::new();
        let capabilities = if self.plain { 0b1_0010 } else { 0b1_0011 };
        for field in [BOOT, 640, 2_000_000, capabilities, 0, 0, 0, 0] {
            payload.extend(field.to_le_bytes());
        }
        for text in ["Acies", "open-1", "P-1", "1.0"] {
            payload.push(text.len() as u8);
            payload.extend(text.as_bytes());
        }
        payload
    }

    fn start(&mut self, id: u32, payload: &[u8]) -> Vec<u8> {
        self.starts += 1;
        let run = u32::from_le_bytes(payload[..4].try_into().expect("4 bytes"));
        if run != self.run {
            self.run = run;
            self.sent = 0;
        }
        self.laser = self.start_status == 0;
        if self.lose_started > 0 {
            self.lose_started -= 1;
            return Vec::new();
        }
        let mut payload = self.start_status.to_le_bytes().to_vec();
        payload.extend(run.to_le_bytes());
        payload.extend(BOOT.to_le_bytes());
        frame(0x84, id, &payload)
    }

    fn stop(&mut self, id: u32) -> Vec<u8> {
        self.laser = false;
        let mut bytes = Vec::new();
        for _ in 0..std::mem::take(&mut self.queued) {
            bytes.extend(profile(self.sent, self.run, BOOT, 4));
            self.sent += 1;
        }
        bytes.extend(stopped(id, 0, self.run, self.sent, self.dropped));
        bytes
    }
}

impl Device for Model {
    fn hear(&mut self, written: &[u8]) -> Vec<u8> {
        let kind = written[3];
        let id = u32::from_le_bytes(written[4..8].try_into().expect("4 bytes"));
        let payload = &written[16..written.len() - 4];
        self.keepalives += u32::from(kind == 6);
        if kind != 6 {
            self.commands.push((kind, payload.to_vec()));
        }
        if self.mute || self.babbles {
            return Vec::new();
        }
        if self.refuses == Some(kind) {
            return frame(0x9F, id, b"\x08\x00\x04\x00oops");
        }
        match kind {
            1 if self.confused => stopped(id, 0, 0, 0, 0),
            1 => frame(0x81, id, &self.identity()),
            2 => {
                let asked = i64::from_le_bytes(payload[2..10].try_into().expect("8 bytes"));
                let (status, value) = self.takes.unwrap_or((0, asked));
                let mut reply = status.to_le_bytes().to_vec();
                reply.extend(&payload[..2]);
                for field in [value, 1, 2_000_000] {
                    reply.extend(field.to_le_bytes());
                }
                frame(0x82, id, &reply)
            }
            4 => self.start(id, payload),
            5 => self.stop(id),
            _ => {
                let mut reply = payload.to_vec();
                reply.extend([0; 8]);
                let boot = if self.boot == 0 { BOOT } else { self.boot };
                reply.extend(boot.to_le_bytes());
                reply.extend([0; 2]);
                frame(0x86, id, &reply)
            }
        }
    }

    fn idle(&mut self) -> Vec<u8> {
        match self.babbles {
            true => b"\xA5\x5A\x01\x90 wrong baud rate".to_vec(),
            false => Vec::new(),
        }
    }
}

type Fake = Arc<Scripted<Model>>;

fn open(fake: &Fake, table: &str) -> Box<dyn Profiler> {
    let opened = setup("open-profile", table).open(&Wire(Arc::clone(fake)));
    match opened {
        Ok(Instrument::Profiler(profiler)) => profiler,
        Ok(_) => panic!("no profiler"),
        Err(error) => panic!("{}", text(&error)),
    }
}

fn refused(model: Model, table: &str) -> String {
    let fake = Scripted::new(model);
    refusal(setup("open-profile", table).open(&Wire(fake)))
}

/// An open device with a run that was started, and the run's number.
fn running(model: Model) -> (Fake, Box<dyn Profiler>, u32) {
    let fake = Scripted::new(model);
    let mut profiler = open(&fake, TABLE);
    profiler.start().expect("a start");
    let run = fake.lock().device.run;
    (fake, profiler, run)
}

fn next(profiler: &mut Box<dyn Profiler>) -> Result<u32, DeviceError> {
    let profile = profiler.next(Instant::now() + SOON)?;
    Ok(profile.expect("a profile in time").sequence)
}

#[test]
fn opens_with_the_laser_off() {
    let fake = Scripted::new(Model {
        laser: true,
        run: 41,
        ..Model::default()
    });
    let table = format!(
        "{TABLE}\nrate_hz = 500\ntrigger = 'encoder'\nencoder_step = 20\nserial_number = 'P-1'"
    );
    let mut profiler = open(&fake, &table);
    assert_eq!(profiler.identity().serial, "P-1");
    assert_eq!(profiler.identity().firmware, "1.0");
    {
        let device = &fake.lock().device;
        assert!(!device.laser);
        let kinds: Vec<u8> = device.commands.iter().map(|(kind, _)| *kind).collect();
        assert_eq!(kinds, [5, 1, 2, 2, 2], "STOP, HELLO, three SET");
        let keys: Vec<u8> = device.commands[2..].iter().map(|(_, p)| p[0]).collect();
        assert_eq!(keys, [3, 4, 1], "trigger, encoder step, rate");
        assert_eq!(device.commands[4].1[2..10], 500_000_i64.to_le_bytes());
    }
    profiler.start().expect("a start");
    assert_eq!(
        fake.lock().device.run,
        42,
        "another number than the last run's"
    );
}

#[test]
fn a_silent_device_is_told_as_silent() {
    let model = Model {
        mute: true,
        ..Model::default()
    };
    assert_eq!(
        refused(model, TABLE),
        "/dev/fake: no answer within 3 s; check power and cable, then retry"
    );
}

#[test]
fn a_babbling_device_is_told_as_babbling() {
    let model = Model {
        babbles: true,
        ..Model::default()
    };
    let text = refused(model, TABLE);
    assert!(
        text.starts_with("/dev/fake: ")
            && text.ends_with(
                " bytes came within 3 s, but no answer to STOP; check `driver` and `baud`"
            ),
        "{text}"
    );
}

#[test]
fn another_device_is_refused() {
    assert_eq!(
        refused(Model::default(), &format!("{TABLE}\nserial_number = 'P-2'")),
        "/dev/fake: answers as \"P-1\", the configuration expects \"P-2\"; check which device is plugged in where"
    );
}

#[test]
fn settings_are_held_to_what_the_device_takes() {
    let with = |takes, line: &str| {
        let model = Model {
            takes: Some(takes),
            ..Model::default()
        };
        refused(model, &format!("{TABLE}\n{line}"))
    };
    assert_eq!(
        with((2, 640), "columns = 641"),
        "/dev/fake: columns = 641 is refused (value out of range), it stays 640 of 1 to 2000000; change `columns`"
    );
    assert_eq!(
        with((0, 490_000), "rate_hz = 500"),
        "/dev/fake: rate_hz = 500000 is refused (it rounds too far), it stays 490000 of 1 to 2000000; change `rate_hz`"
    );
    let fake = Scripted::new(Model {
        takes: Some((0, 499_001)),
        ..Model::default()
    });
    open(&fake, &format!("{TABLE}\nrate_hz = 500"));
    let plain = Model {
        plain: true,
        ..Model::default()
    };
    assert_eq!(
        refused(
            plain,
            &format!("{TABLE}\ntrigger = 'encoder'\nencoder_step = 5")
        ),
        "/dev/fake: the device has no encoder, which `trigger` needs; change `trigger`"
    );
}

#[test]
fn a_refused_command_says_why() {
    let model = Model {
        refuses: Some(1),
        ..Model::default()
    };
    assert_eq!(
        refused(model, TABLE),
        "/dev/fake: HELLO is refused: hardware fault, \"oops\"; switch the device off and on; if it comes back, have it repaired"
    );
}

#[test]
fn an_answer_to_another_question_is_told() {
    let model = Model {
        confused: true,
        ..Model::default()
    };
    assert_eq!(
        refused(model, TABLE),
        "/dev/fake: bad data from the device: HELLO was answered by a message of another kind"
    );
}

#[test]
fn an_open_interlock_keeps_the_laser_off() {
    let fake = Scripted::new(Model {
        start_status: 7,
        ..Model::default()
    });
    let mut profiler = open(&fake, TABLE);
    let error = profiler.start().expect_err("an open interlock");
    assert_eq!(
        text(&error),
        "/dev/fake: START is refused: interlock open; close the interlock, then start again"
    );
    let last = fake.lock().device.commands.last().map(|(kind, _)| *kind);
    assert_eq!(last, Some(5), "STOP, to be sure");
    fake.lock().device.start_status = 0;
    profiler.start().expect("a start with the interlock closed");
}

#[test]
fn a_lost_started_is_asked_for_again_and_loses_nothing() {
    let fake = Scripted::new(Model {
        lose_started: 1,
        ..Model::default()
    });
    let mut profiler = open(&fake, TABLE);
    profiler.start().expect("a start");
    let run = fake.lock().device.run;
    assert_eq!(
        (run, fake.lock().device.starts),
        (1, 2),
        "one run, asked for twice"
    );
    fake.send(&profile(0, run, BOOT, 4));
    assert_eq!(next(&mut profiler).expect("a profile"), 0);
}

#[test]
fn keepalives_go_on_while_the_caller_is_busy() {
    let (fake, mut profiler, _) = running(Model::default());
    fake.wait_until(|state| state.device.keepalives >= 4);
    profiler.stop().expect("a stop");
    let after = fake.lock().device.keepalives;
    assert!(profiler.next(Instant::now()).is_err(), "no run any more");
    assert!(fake.lock().device.keepalives <= after + 1);
}

#[test]
fn a_slow_caller_loses_nothing() {
    let (fake, mut profiler, run) = running(Model::default());
    for sequence in 0..2000 {
        fake.send(&profile(sequence, run, BOOT, 4));
    }
    let keepalives = fake.lock().device.keepalives;
    fake.wait_until(|state| state.device.keepalives >= keepalives + 3);
    for sequence in 0..2000 {
        assert_eq!(next(&mut profiler).expect("a profile"), sequence);
    }
    assert_eq!(profiler.losses().received, 2000);
    assert_eq!(profiler.losses().lost_on_link, 0);
}

#[test]
fn a_full_queue_stops_reading_and_stop_still_works() {
    // Each takes 0.5 MiB in the queue of 64 MiB, so that 300 do not fit.
    const COLUMNS: u16 = 32_700;
    let (fake, mut profiler, run) = running(Model::default());
    for sequence in 0..300 {
        fake.send(&profile(sequence, run, BOOT, COLUMNS));
    }
    fake.lock().device.sent = 300;
    // The keep-alives prove that the thread had time to read all, if it would.
    let keepalives = fake.lock().device.keepalives;
    fake.wait_until(|state| state.device.keepalives >= keepalives + 10);
    assert!(fake.unread() > 0, "it reads on with a full queue");
    for sequence in 0..100 {
        assert_eq!(next(&mut profiler).expect("a profile"), sequence);
    }
    let rest = profiler.stop().expect("a stop");
    assert_eq!(rest.len(), 200);
    assert_eq!(profiler.losses().lost_on_link, 0);
}

#[test]
fn losses_are_counted_by_cause() {
    let (fake, mut profiler, run) = running(Model {
        dropped: 7,
        ..Model::default()
    });
    let mut damaged = profile(2, run, BOOT, 4);
    damaged[30] ^= 1;
    for bytes in [
        profile(0, run, BOOT, 4),
        damaged,
        profile(3, run, BOOT, 4),
        profile(3, run, BOOT, 4),
        profile(9, run + 1, BOOT, 4),
        b"noise".to_vec(),
        profile(4, run, BOOT, 4),
    ] {
        fake.send(&bytes);
    }
    for sequence in [0, 3, 4] {
        assert_eq!(next(&mut profiler).expect("a profile"), sequence);
    }
    // The device sent 5 and 6 as well, which never came, and 7 and 8 while it was being stopped.
    fake.lock().device.sent = 7;
    fake.lock().device.queued = 2;
    let rest = profiler.stop().expect("a stop");
    let sequences: Vec<u32> = rest.iter().map(|profile| profile.sequence).collect();
    assert_eq!(sequences, [7, 8]);
    let frame_bytes = 16 + 60 + 8 + 4;
    assert_eq!(
        profiler.losses(),
        Losses {
            received: 5,
            lost_on_link: 4,
            dropped_by_device: 7,
            // The damaged frame and the repeated one.
            rejected: 2,
            skipped_bytes: frame_bytes + 5,
        }
    );
}

#[test]
fn profiles_missing_at_the_end_are_found_by_stopped() {
    let (fake, mut profiler, run) = running(Model::default());
    fake.send(&profile(0, run, BOOT, 4));
    fake.lock().device.sent = 5;
    let rest = profiler.stop().expect("a stop");
    assert_eq!(rest.len(), 1);
    assert_eq!(profiler.losses().lost_on_link, 4);
    assert_eq!(profiler.stop().expect("a second stop"), []);
}

#[test]
fn a_stop_that_is_not_confirmed_leaves_the_profiles_to_next() {
    let (fake, mut profiler, run) = running(Model::default());
    fake.lock().device.mute = true;
    for sequence in 0..2 {
        fake.send(&profile(sequence, run, BOOT, 4));
    }
    let error = profiler.stop().expect_err("silence");
    assert!(
        text(&error).contains("no answer within"),
        "{}",
        text(&error)
    );
    assert_eq!(next(&mut profiler).expect("a profile"), 0);
    assert_eq!(next(&mut profiler).expect("a profile"), 1);
    assert!(next(&mut profiler).is_err());
}

#[test]
fn a_device_gone_in_the_middle_of_a_run_is_told_after_its_last_profile() {
    let (fake, mut profiler, run) = running(Model::default());
    fake.send(&profile(0, run, BOOT, 4));
    fake.unplug();
    assert_eq!(next(&mut profiler).expect("a profile"), 0);
    for _ in 0..2 {
        let error = next(&mut profiler).expect_err("a device that is gone");
        assert!(error.may_pass());
        assert_eq!(
            text(&error),
            "/dev/fake: cannot be used: it is gone: closed or unplugged; plug it in again and reopen"
        );
    }
    assert!(profiler.stop().is_err());
}

#[test]
fn a_device_that_started_anew_is_told() {
    let (fake, mut profiler, _) = running(Model::default());
    fake.lock().device.boot = 0xB008;
    let error = next(&mut profiler).expect_err("another boot number");
    assert_eq!(
        text(&error),
        "/dev/fake: the device started anew (boot 0x0000b008, was 0x0000b007); check its supply, then reopen it"
    );
    let (fake, mut profiler, run) = running(Model::default());
    fake.send(&profile(0, run, 0xB009, 4));
    let error = next(&mut profiler).expect_err("another boot number");
    assert!(text(&error).contains("boot 0x0000b009"));
}

#[test]
fn a_device_that_falls_silent_in_a_run_is_told() {
    let (fake, mut profiler, _) = running(Model::default());
    fake.lock().device.mute = true;
    let error = next(&mut profiler).expect_err("silence");
    assert_eq!(
        text(&error),
        "/dev/fake: no answer within 0.3 s; check power and cable, then retry"
    );
}

#[test]
fn a_run_that_the_device_ends_is_told_after_its_last_profile() {
    let (fake, mut profiler, run) = running(Model::default());
    fake.send(&profile(0, run, BOOT, 4));
    fake.send(&stopped(0, 3, run, 1, 0));
    assert_eq!(next(&mut profiler).expect("a profile"), 0);
    for _ in 0..2 {
        let error = next(&mut profiler).expect_err("an opened interlock");
        assert_eq!(
            text(&error),
            "/dev/fake: the device ended the run: the interlock was opened; close the interlock, then start again"
        );
    }
    fake.lock().device.sent = 1;
    assert_eq!(profiler.stop().expect("a stop"), []);
    profiler.start().expect("a start with the interlock closed");
}

#[test]
fn no_profile_by_the_deadline_is_none() {
    let (_fake, mut profiler, _) = running(Model::default());
    let deadline = Instant::now() + Duration::from_millis(30);
    assert_eq!(profiler.next(deadline).expect("no error"), None);
    assert!(Instant::now() >= deadline);
}

#[test]
fn dropping_switches_the_laser_off() {
    let (fake, profiler, _) = running(Model::default());
    assert!(fake.lock().device.laser);
    drop(profiler);
    assert!(!fake.lock().device.laser);
}

#[test]
fn start_twice_and_next_without_start_are_refused() {
    let (_fake, mut profiler, _) = running(Model::default());
    let error = profiler.start().expect_err("a run is on");
    assert_eq!(
        text(&error),
        "/dev/fake: start needs the run before to be stopped"
    );
    profiler.stop().expect("a stop");
    let error = profiler.next(Instant::now()).expect_err("no run");
    assert_eq!(text(&error), "/dev/fake: next needs a run that was started");
}

#[test]
fn all_mistakes_of_a_table_are_told_at_once() {
    assert_eq!(
        mistakes(
            "open-profile",
            "usb_serial = 'X'\nrate_hz = 0\nexposure_us = nan\ntrigger = 'sound'\nencoder_step = 2\n\
             columns = 3.5\nlaser_power_percent = 120\nkeepalive_s = 60\nspeed = 9"
        ),
        [
            "trigger: \"sound\", expected \"time\" or \"encoder\" or \"external\"",
            "encoder_step: given, expected trigger = \"encoder\" beside it",
            "columns: 3.5, expected a whole number of 1 to 32768",
            "rate_hz: 0, expected a number of 0.001 to 1000000",
            "exposure_us: nan, expected a number of 0.001 to 10000000",
            "laser_power_percent: 120, expected a number of 0 to 100",
            "keepalive_s: 60, expected a number of 0.1 to 10",
            "speed: an unknown key, expected one of baud, port, usb_serial, usb_id, address, serial_number, \
             trigger, encoder_step, columns, rate_hz, exposure_us, laser_power_percent, keepalive_s",
        ]
    );
    assert_eq!(
        mistakes("open-profile", "port = '/dev/x'\ntrigger = 'encoder'"),
        ["trigger: \"encoder\", expected encoder_step beside it"]
    );
}
