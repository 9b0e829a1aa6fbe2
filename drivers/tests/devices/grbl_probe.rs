//! The grbl-probe driver against a small model of a Grbl controller.

use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_drivers::capture::Touch;
use acies_drivers::device::{Instrument, Probe};
use acies_drivers::error::DeviceError;

use crate::script::{Device, Scripted, Wire, mistakes, refusal, setup, text};

const TABLE: &str = "port = '/dev/fake'";
const SOON: Duration = Duration::from_secs(20);

/// A machine over a plate at z = -30 mm in machine axes, and the ways in which it fails here.
struct Model {
    /// Commands as they came, realtime characters too.
    heard: Vec<String>,
    /// Where the tip is, machine axes, mm.
    at: [f64; 3],
    work_offset: [f64; 3],
    inches: bool,
    locked: bool,
    mute: bool,
    no_banner: bool,
    owner: &'static str,
    /// The result line is damaged by a status report.
    damage: bool,
    /// Not even `$#` has the result.
    forgets: bool,
    /// Lines before the result.
    chatter: &'static str,
    /// Answers this to G38.2 in place of the truth.
    answer: Option<&'static str>,
    /// Answers nothing to G38.2.
    hangs: bool,
    last: String,
}

impl Default for Model {
    fn default() -> Model {
        Model {
            heard: Vec::new(),
            at: [0.0; 3],
            work_offset: [0.0; 3],
            inches: false,
            locked: false,
            mute: false,
            no_banner: false,
            owner: "",
            damage: false,
            forgets: false,
            chatter: "",
            answer: None,
            hangs: false,
            last: "[PRB:0.000,0.000,0.000:0]".into(),
        }
    }
}

const PLATE_Z: f64 = -30.0;

impl Model {
    fn triple(&self, mm: [f64; 3]) -> String {
        let [x, y, z] = mm;
        match self.inches {
            true => format!("{:.4},{:.4},{:.4}", x / 25.4, y / 25.4, z / 25.4),
            false => format!("{x:.3},{y:.3},{z:.3}"),
        }
    }

    /// The machine position that the words of a line ask for.
    fn asked(&self, line: &str) -> [f64; 3] {
        let mut to = self.at;
        for word in line.split(' ') {
            let axis = match word.as_bytes().first() {
                Some(b'X') => 0,
                Some(b'Y') => 1,
                Some(b'Z') => 2,
                _ => continue,
            };
            let value: f64 = word[1..].parse().expect("a number");
            to[axis] = value + self.work_offset[axis];
        }
        to
    }

    fn probe(&mut self, line: &str) -> String {
        if self.hangs {
            return String::new();
        }
        if let Some(answer) = self.answer {
            return answer.into();
        }
        let to = self.asked(line);
        if self.at[2] <= PLATE_Z {
            self.locked = true;
            return "ALARM:4\r\nok\r\n".into();
        }
        let part = (PLATE_Z - self.at[2]) / (to[2] - self.at[2]);
        if !(0.0..=1.0).contains(&part) {
            self.locked = true;
            self.at = to;
            return "ALARM:5\r\n[PRB:0.000,0.000,0.000:0]\r\nok\r\n".into();
        }
        self.at = [0, 1, 2].map(|axis| self.at[axis] + part * (to[axis] - self.at[axis]));
        let result = format!("[PRB:{}:1]", self.triple(self.at));
        if !self.forgets {
            self.last.clone_from(&result);
        }
        match self.damage {
            true => format!(
                "{}<Run|MPos:0.000,0.000,0.000>{}\r\nok\r\n",
                &result[..9],
                &result[9..]
            ),
            false => format!("{}{result}\r\nok\r\n", self.chatter),
        }
    }
}

impl Device for Model {
    fn hear(&mut self, written: &[u8]) -> Vec<u8> {
        let line = std::str::from_utf8(written).expect("ASCII").trim_end();
        self.heard.push(line.into());
        if self.mute {
            return Vec::new();
        }
        let answer = match line {
            "\x18" if self.no_banner => String::new(),
            "\x18" => {
                "\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n>G54:ok\r\n".into()
            }
            "!" => String::new(),
            "$I" => format!(
                "[VER:1.1h.20190825:{}]\r\n[OPT:V,15,128]\r\nok\r\n",
                self.owner
            ),
            "$$" => format!(
                "$0=10\r\n$13={}\r\n$110=500.000\r\nok\r\n",
                u8::from(self.inches)
            ),
            "$X" => {
                self.locked = false;
                "[MSG:Caution: Unlocked]\r\nok\r\n".into()
            }
            "$G" => "[GC:G0 G55 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\nok\r\n".into(),
            "$#" => format!(
                "[G54:9.000,9.000,9.000]\r\n[G55:{}]\r\n[G92:0.000,0.000,0.000]\r\n[TLO:0.000]\r\n{}\r\nok\r\n",
                self.triple(self.work_offset),
                self.last
            ),
            _ if self.locked => "error:9\r\n".into(),
            _ if line.starts_with("G38.2") => self.probe(line),
            _ => {
                self.at = self.asked(line);
                "ok\r\n".into()
            }
        };
        answer.into_bytes()
    }
}

type Fake = Arc<Scripted<Model>>;

fn open(model: Model, table: &str) -> (Fake, Box<dyn Probe>) {
    let fake = Scripted::new(model);
    let opened = setup("grbl-probe", table).open(&Wire(Arc::clone(&fake)));
    match opened {
        Ok(Instrument::Probe(probe)) => (fake, probe),
        Ok(_) => panic!("no probe"),
        Err(error) => panic!("{}", text(&error)),
    }
}

fn refused(model: Model, table: &str) -> String {
    let fake = Scripted::new(model);
    refusal(setup("grbl-probe", table).open(&Wire(fake)))
}

/// Touches the plate from above at (10, 20).
fn touch(probe: &mut Box<dyn Probe>) -> Result<Touch, DeviceError> {
    probe.touch([10.0, 20.0, -5.0], [10.0, 20.0, -40.0], SOON)
}

fn touch_text(model: Model) -> String {
    let (_fake, mut probe) = open(model, TABLE);
    text(&touch(&mut probe).expect_err("a failure"))
}

#[test]
fn touches_where_the_controller_latched() {
    let model = Model {
        owner: "probe-7",
        work_offset: [100.0, -50.0, 12.5],
        chatter: "<Run|MPos:1.000,2.000,3.000|FS:100,0>\r\n[MSG:Found]\r\n",
        ..Model::default()
    };
    let (fake, mut probe) = open(
        model,
        &format!("{TABLE}\nbuild_info = 'probe-7'\nfeed_mm_min = 50"),
    );
    assert_eq!(probe.identity().firmware, "1.1h.20190825");
    assert_eq!(probe.identity().serial, "probe-7");
    let before = Instant::now();
    let touch = touch(&mut probe).expect("a touch");
    assert_eq!(touch.tip_centre_mm, [10.0, 20.0, PLATE_Z]);
    assert_eq!(touch.direction, [0.0, 0.0, -1.0]);
    assert!(touch.host_time >= before);
    let state = fake.lock();
    assert_eq!(
        state.device.heard,
        [
            "\x18",
            "$I",
            "$$",
            "G21 G90 G94",
            "$G",
            "$#",
            "G0 X-90.0000 Y70.0000 Z-17.5000",
            "G38.2 X-90.0000 Y70.0000 Z-52.5000 F50.0",
            "G0 X-90.0000 Y70.0000 Z-40.5000",
        ]
    );
    assert_eq!(state.device.at, [10.0, 20.0, -28.0], "2 mm back");
}

#[test]
fn inches_are_converted() {
    let (_fake, mut probe) = open(
        Model {
            inches: true,
            work_offset: [25.4, 0.0, 0.0],
            ..Model::default()
        },
        TABLE,
    );
    let touch = touch(&mut probe).expect("a touch");
    // Four decimals of an inch are 0.0025 mm; half of that is the rounding.
    for (found, true_mm) in touch.tip_centre_mm.into_iter().zip([10.0, 20.0, PLATE_Z]) {
        assert!((found - true_mm).abs() <= 0.001_28, "{found} for {true_mm}");
    }
}

#[test]
fn a_damaged_result_is_asked_for_again() {
    let (fake, mut probe) = open(
        Model {
            damage: true,
            ..Model::default()
        },
        TABLE,
    );
    let touch = touch(&mut probe).expect("a touch");
    assert_eq!(touch.tip_centre_mm, [10.0, 20.0, PLATE_Z]);
    let asked = fake
        .lock()
        .device
        .heard
        .iter()
        .filter(|h| *h == "$#")
        .count();
    assert_eq!(asked, 2);
}

#[test]
fn a_result_of_another_move_is_not_taken() {
    let text = touch_text(Model {
        damage: true,
        forgets: true,
        last: "[PRB:1.000,2.000,-30.000:1]".into(),
        ..Model::default()
    });
    assert_eq!(
        text,
        "/dev/fake: contact is reported at [1.0, 2.0, -30.0] mm, 20.125 mm off the way; \
         check for lost steps and a changed work offset, then home and reopen it"
    );
}

#[test]
fn no_result_is_told() {
    let text = touch_text(Model {
        damage: true,
        forgets: true,
        last: "[PRB:1.000,2.0".into(),
        ..Model::default()
    });
    assert_eq!(
        text,
        "/dev/fake: the move ended, but no result came, nor was there one in $#; check the controller's firmware"
    );
}

#[test]
fn no_contact_locks_and_reopening_unlocks_where_configured() {
    let (fake, mut probe) = open(Model::default(), TABLE);
    let error = probe
        .touch([10.0, 20.0, -5.0], [10.0, 20.0, -20.0], SOON)
        .expect_err("nothing is there");
    assert_eq!(
        text(&error),
        "/dev/fake: no contact between [10.0, 20.0, -5.0] and [10.0, 20.0, -20.0] mm; check that the part lies there \
         and the probe is wired, then reopen with `unlock_on_open = true` or send $X"
    );
    let error = touch(&mut probe).expect_err("it is locked");
    assert_eq!(
        text(&error),
        "/dev/fake: G0 is refused: error 9, locked by an alarm; remove the cause, \
         then reopen with `unlock_on_open = true`, or send $H or $X"
    );
    drop(probe);
    let locked = refusal(setup("grbl-probe", TABLE).open(&Wire(Arc::clone(&fake))));
    assert!(
        locked.starts_with("/dev/fake: G21 G90 G94 is refused: error 9, locked by an alarm;"),
        "{locked}"
    );
    let unlocking = setup("grbl-probe", &format!("{TABLE}\nunlock_on_open = true"));
    let Ok(Instrument::Probe(mut probe)) = unlocking.open(&Wire(fake)) else {
        panic!("it stays locked");
    };
    assert!(touch(&mut probe).is_ok());
}

#[test]
fn a_result_without_contact_is_no_contact() {
    let text = touch_text(Model {
        answer: Some("[PRB:10.000,20.000,-40.000:0]\r\nok\r\n"),
        ..Model::default()
    });
    assert!(text.starts_with("/dev/fake: no contact between"), "{text}");
}

#[test]
fn alarms_say_what_they_mean() {
    let text = touch_text(Model {
        answer: Some("ALARM:4\r\nok\r\n"),
        ..Model::default()
    });
    assert_eq!(
        text,
        "/dev/fake: alarm 4: the probe was in contact before the move; move the tip away from the part, \
         check the probe's wiring and $6, then send $X and reopen it"
    );
    let text = touch_text(Model {
        answer: Some("ALARM:1\r\n[MSG:Reset to continue]\r\n"),
        ..Model::default()
    });
    assert_eq!(
        text,
        "/dev/fake: alarm 1: a limit switch was hit, the position is probably lost; \
         free the axes, home the machine, then reopen it"
    );
}

#[test]
fn a_controller_that_resets_itself_is_told() {
    let text = touch_text(Model {
        answer: Some("\r\nGrbl 1.1h ['$' for help]\r\n"),
        ..Model::default()
    });
    assert_eq!(
        text,
        "/dev/fake: the controller reset itself; check its supply, home the machine, then reopen it"
    );
}

#[test]
fn a_move_that_does_not_end_is_held() {
    let (fake, mut probe) = open(
        Model {
            hangs: true,
            ..Model::default()
        },
        TABLE,
    );
    let error = probe
        .touch([0.0; 3], [0.0, 0.0, -40.0], Duration::from_millis(200))
        .expect_err("a late answer");
    assert_eq!(
        text(&error),
        "/dev/fake: the move did not end within 0.2 s and was held; look at the machine, then reopen it"
    );
    assert_eq!(
        fake.lock().device.heard.last().map(String::as_str),
        Some("!")
    );
    let error = touch(&mut probe).expect_err("a held machine");
    assert_eq!(
        text(&error),
        "/dev/fake: touch needs the machine to be looked at and reopened, since a move did not end"
    );
}

#[test]
fn a_device_gone_in_a_move_is_told() {
    let (fake, mut probe) = open(Model::default(), TABLE);
    fake.unplug();
    let error = touch(&mut probe).expect_err("a device that is gone");
    assert!(error.may_pass());
    assert!(text(&error).starts_with("/dev/fake: cannot be used: it is gone"));
}

#[test]
fn moves_out_of_the_box_or_without_direction_are_not_made() {
    let table =
        format!("{TABLE}\nlimits_min_mm = [0, 0, -50]\nlimits_max_mm = [100.0, 100.0, 0.0]");
    let (fake, mut probe) = open(Model::default(), &table);
    let commands = fake.lock().device.heard.len();
    let mut told = |start, target| {
        text(
            &probe
                .touch(start, target, SOON)
                .expect_err("a forbidden move"),
        )
    };
    assert_eq!(
        told([10.0, 10.0, 0.0], [10.0, 10.0, -51.0]),
        "/dev/fake: a move to [10.0, 10.0, -51.0] mm is not permitted, allowed is [0.0, 0.0, -50.0] to [100.0, 100.0, 0.0] mm"
    );
    assert_eq!(
        told([10.0, f64::NAN, 0.0], [10.0, 10.0, -5.0]),
        "/dev/fake: a move to [10.0, NaN, 0.0] mm is not permitted, allowed is finite numbers"
    );
    assert_eq!(
        told([10.0, 10.0, -5.0], [10.0, 10.0, -5.0]),
        "/dev/fake: a move to [10.0, 10.0, -5.0] mm is not permitted, allowed is 0.1 mm or more from the start"
    );
    assert_eq!(fake.lock().device.heard.len(), commands, "nothing was sent");
}

#[test]
fn a_slow_way_and_no_retraction() {
    let table = format!("{TABLE}\nrapid = false\nretract_mm = 0");
    let (fake, mut probe) = open(Model::default(), &table);
    touch(&mut probe).expect("a touch");
    let heard = &fake.lock().device.heard;
    assert_eq!(
        heard[heard.len() - 2..],
        [
            "G1 X10.0000 Y20.0000 Z-5.0000 F100.0",
            "G38.2 X10.0000 Y20.0000 Z-40.0000 F100.0"
        ]
    );
}

#[test]
fn a_safe_height_is_gone_over() {
    let model = Model {
        work_offset: [1.0, 2.0, 3.0],
        ..Model::default()
    };
    let (fake, mut probe) = open(model, &format!("{TABLE}\nsafe_z_mm = 40"));
    touch(&mut probe).expect("a touch");
    let heard = &fake.lock().device.heard;
    assert_eq!(
        heard[heard.len() - 5..heard.len() - 2],
        ["G0 Z37.0000", "G0 X9.0000 Y18.0000", "G0 Z-8.0000"]
    );
}

#[test]
fn retraction_ends_at_the_start() {
    let (fake, mut probe) = open(Model::default(), &format!("{TABLE}\nretract_mm = 50"));
    touch(&mut probe).expect("a touch");
    assert_eq!(fake.lock().device.at, [10.0, 20.0, -5.0]);
}

#[test]
fn a_controller_without_banner_opens_all_the_same() {
    let (_fake, mut probe) = open(
        Model {
            no_banner: true,
            ..Model::default()
        },
        TABLE,
    );
    assert!(touch(&mut probe).is_ok());
}

#[test]
fn silence_and_the_wrong_controller_are_told() {
    let mute = Model {
        mute: true,
        ..Model::default()
    };
    assert_eq!(
        refused(mute, TABLE),
        "/dev/fake: no answer within 3 s; check power and cable, then retry"
    );
    assert_eq!(
        refused(
            Model::default(),
            &format!("{TABLE}\nbuild_info = 'probe-7'")
        ),
        "/dev/fake: answers as \"\", the configuration expects \"probe-7\"; check which device is plugged in where"
    );
}

#[test]
fn all_mistakes_of_a_table_are_told_at_once() {
    assert_eq!(
        mistakes(
            "grbl-probe",
            "feed_mm_min = 0\nrapid = 1\nretract_mm = -1\nlimits_min_mm = [0, 0, 0]\nlimits_max_mm = [1, 1, 0]\n\
             unlock_on_open = 'no'\nfeed = 3"
        ),
        [
            "port: no link, expected exactly one of port, usb_serial, usb_id, address",
            "limits_max_mm: [1.0, 1.0, 0.0], expected more than limits_min_mm on every axis",
            "feed_mm_min: 0, expected a number of 1 to 5000",
            "rapid: 1, expected true or false",
            "retract_mm: -1, expected a number of 0 to 100",
            "unlock_on_open: \"no\", expected true or false",
            "feed: an unknown key, expected one of baud, port, usb_serial, usb_id, address, build_info, limits_min_mm, \
             limits_max_mm, feed_mm_min, rapid, safe_z_mm, retract_mm, unlock_on_open",
        ]
    );
    assert_eq!(
        mistakes(
            "grbl-probe",
            "port = '/dev/x'\nlimits_min_mm = [0, 0, 0]\nlimits_max_mm = [1, 1, 1]\nsafe_z_mm = 2"
        ),
        ["safe_z_mm: 2, expected 0 to 1, the limits of z"]
    );
    assert_eq!(
        mistakes("grbl-probe", "port = '/dev/x'\nlimits_min_mm = [0, 0]"),
        ["limits_min_mm: [0, 0], expected three numbers, as in [0.0, 0.0, -50.0]"]
    );
    assert_eq!(
        mistakes("grbl-probe", "port = '/dev/x'\nlimits_max_mm = [0, 0, 0]"),
        ["limits_max_mm: given, expected limits_min_mm beside it"]
    );
}
