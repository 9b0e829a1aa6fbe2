//! The controller from the host's side of the wire.

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::*;
use crate::scene::Surfaces;

/// A block 100 x 100 with its top at z = 20, and a wall x = 100.
fn probe(name: &str, faults: &str, sigma: f64) -> SimulatedProbe {
    let mut s = Surfaces::default();
    let (solid, _) = s.cuboid("block", DVec3::ZERO, DVec3::new(100.0, 100.0, 20.0));
    let setup = Setup {
        scene: Arc::new(Scene::new(s, solid)),
        machine_from_scene: Pose::IDENTITY,
        tip_radius_mm: 1.0,
        repeatability_mm: sigma,
        seed: 2,
        paced: false,
        faults: faults.parse().unwrap(),
    };
    SimulatedProbe::start(Wire::pty(&port(name)).unwrap(), setup).unwrap()
}

fn port(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("acies-grbl-{}-{name}", std::process::id()))
}

struct Host {
    write: File,
    read: BufReader<File>,
}

impl Host {
    /// Opens the port and reads the banner.
    fn open(probe: &SimulatedProbe) -> Host {
        let write = File::options().read(true).write(true).open(probe.port());
        let write = write.unwrap();
        let read = BufReader::new(write.try_clone().unwrap());
        let mut host = Host { write, read };
        assert_eq!(host.line(), "Grbl 1.1h ['$' for help]");
        host
    }

    /// The next line that is not empty.
    fn line(&mut self) -> String {
        loop {
            let mut line = String::new();
            self.read.read_line(&mut line).unwrap();
            if !line.trim().is_empty() {
                return line.trim().to_owned();
            }
        }
    }

    /// All lines up to `ok` or an error.
    fn ask(&mut self, text: &str) -> Vec<String> {
        writeln!(self.write, "{text}").unwrap();
        let mut lines = Vec::new();
        loop {
            lines.push(self.line());
            let last = lines.last().unwrap();
            if last == "ok" || last.starts_with("error") {
                return lines;
            }
        }
    }

    fn realtime(&mut self, byte: u8) {
        self.write.write_all(&[byte]).unwrap();
    }
}

#[test]
fn a_probing_move_reports_the_latched_centre_and_stops_a_little_later() {
    let probe = probe("touch", "", 0.0);
    let mut host = Host::open(&probe);
    assert_eq!(host.ask("G21 G90"), ["ok"]);
    assert_eq!(host.ask("G0 X30 Y40 Z50"), ["ok"]);
    assert_eq!(
        host.ask("G38.2 Z10 F600"),
        ["[PRB:30.000,40.000,21.000:1]", "ok"]
    );
    // 10 mm/s for 5 ms
    host.realtime(b'?');
    assert_eq!(host.line(), "<Idle|MPos:30.000,40.000,20.950|FS:0,0>");
    assert_eq!(host.ask("G0 Z50"), ["ok"]);
    assert_eq!(host.ask("G0 X120"), ["ok"]);
    assert_eq!(host.ask("G0 Z12.3456"), ["ok"]);
    assert_eq!(
        host.ask("G38.3 X90 F100")[0],
        "[PRB:101.000,40.000,12.346:1]"
    );
    let parameters = host.ask("$#");
    assert!(parameters.contains(&"[PRB:101.000,40.000,12.346:1]".to_owned()));
    let truth = probe.truth();
    assert_eq!((truth.touches.len(), truth.crashes), (2, 0));
    assert!((truth.touches[0].contact - DVec3::new(30.0, 40.0, 21.0)).length() < 1e-12);
    assert_eq!(truth.touches[1].direction, DVec3::NEG_X);
}

#[test]
fn no_contact_is_an_alarm_that_locks_until_it_is_cleared() {
    let probe = probe("alarm", "", 0.0);
    let mut host = Host::open(&probe);
    assert_eq!(host.ask("G0 X30 Y40 Z50"), ["ok"]);
    let lines = host.ask("G38.2 Z30 F100");
    assert_eq!(lines, ["ALARM:5", "[PRB:30.000,40.000,30.000:0]", "ok"]);
    assert_eq!(host.ask("G0 Z50"), ["error:9"]);
    host.realtime(b'?');
    assert!(host.line().starts_with("<Alarm|"));
    assert_eq!(host.ask("$X"), ["[MSG:Caution: Unlocked]", "ok"]);
    // the kind that does not mind
    assert_eq!(
        host.ask("G38.3 Z25 F100"),
        ["[PRB:30.000,40.000,25.000:0]", "ok"]
    );
    assert_eq!(
        host.ask("G38.2 Z10 F100")[0],
        "[PRB:30.000,40.000,21.000:1]"
    );
    // touching already
    assert_eq!(host.ask("G38.2 Z10 F100"), ["ALARM:4", "ok"]);
    host.realtime(0x18);
    assert_eq!(host.line(), "Grbl 1.1h ['$' for help]");
    // and away again
    assert_eq!(
        host.ask("G38.4 Z30 F100"),
        ["[PRB:30.000,40.000,21.000:1]", "ok"]
    );
}

#[test]
fn system_commands_answer_and_what_it_does_not_know_is_an_error() {
    let probe = probe("system", "", 0.0);
    let mut host = Host::open(&probe);
    assert_eq!(
        host.ask("$I"),
        ["[VER:1.1h.20190830:]", "[OPT:V,15,128]", "ok"]
    );
    assert!(host.ask("$$").contains(&"$13=0".to_owned()));
    assert_eq!(host.ask("$H"), ["error:5"]);
    assert_eq!(host.ask("$nonsense"), ["error:3"]);
    assert_eq!(host.ask("G2 X1"), ["error:20"]);
    assert_eq!(host.ask("G38.2 Z1 F10 G90 G1"), ["error:21"]);
    assert_eq!(host.ask(&"X".repeat(200)), ["error:14"]);
    assert_eq!(host.ask(""), ["ok"]);
    // in inches, and by increments
    assert_eq!(host.ask("G20 G91 G0 X1 Z-2"), ["ok"]);
    host.realtime(b'?');
    assert_eq!(host.line(), "<Idle|MPos:25.400,0.000,149.200|FS:0,0>");
}

#[test]
fn faults_come_when_asked_for() {
    let locked = probe("locked", "alarm", 0.0);
    let mut host = Host::open(&locked);
    assert_eq!(host.line(), "[MSG:'$H'|'$X' to unlock]");
    assert_eq!(host.ask("G0 X1"), ["error:9"]);

    let torn = probe("torn", "damage-prb=1", 0.0);
    let mut host = Host::open(&torn);
    host.ask("G0 X30 Y40 Z50");
    let lines = host.ask("G38.2 Z10 F600");
    assert_eq!(
        lines[0],
        "[PRB:30.000,40<Idle|MPos:30.000,40.000,20.950|FS:0,0>"
    );
    assert_eq!(lines[1], ".000,21.000:1]");
    assert!(
        host.ask("$#")
            .contains(&"[PRB:30.000,40.000,21.000:1]".to_owned())
    );

    let never = probe("never", "no-contact", 0.0);
    let mut host = Host::open(&never);
    assert_eq!(host.ask("G38.2 Z10 F600")[0], "ALARM:5");

    let reset = probe("reset", "reset-in-move=1", 0.0);
    let mut host = Host::open(&reset);
    writeln!(host.write, "G38.2 Z10 F600").unwrap();
    assert_eq!(host.line(), "Grbl 1.1h ['$' for help]");
    assert_eq!(host.line(), "[MSG:'$H'|'$X' to unlock]");
    assert_eq!(reset.truth().starts, 2);
}

#[test]
fn repeated_touches_scatter_as_stated() {
    let probe = probe("scatter", "", 0.05);
    let mut host = Host::open(&probe);
    host.ask("G0 X30 Y40 Z25");
    for _ in 0..200 {
        host.ask("G38.2 Z10 F100");
        host.ask("G0 Z25");
    }
    let touches = probe.truth().touches;
    assert_eq!(touches.len(), 200);
    let squares = touches.iter().map(|t| (t.latched.z - 21.0).powi(2));
    let sigma = (squares.sum::<f64>() / 200.0).sqrt();
    // one standard deviation of it is 5 %
    assert!((0.0425..0.0575).contains(&sigma), "{sigma}");
}

#[test]
fn running_into_the_part_is_noticed() {
    let probe = probe("crash", "", 0.0);
    let mut host = Host::open(&probe);
    assert_eq!(host.ask("G0 X30 Y40"), ["ok"]);
    assert_eq!(host.ask("G0 Z10"), ["ok"]);
    assert_eq!(probe.truth().crashes, 1);
}

#[test]
fn a_paced_move_takes_its_time_and_answers_questions_meanwhile() {
    let mut s = Surfaces::default();
    let (solid, _) = s.cuboid("block", DVec3::ZERO, DVec3::splat(20.0));
    let setup = Setup {
        scene: Arc::new(Scene::new(s, solid)),
        machine_from_scene: Pose::IDENTITY,
        tip_radius_mm: 1.0,
        repeatability_mm: 0.0,
        seed: 2,
        paced: true,
        faults: Faults::default(),
    };
    let probe = SimulatedProbe::start(Wire::pty(&port("paced")).unwrap(), setup).unwrap();
    let mut host = Host::open(&probe);
    let began = Instant::now();
    // 20 mm at 6000 mm a minute
    write!(host.write, "G0 X20\n?").unwrap();
    assert!(host.line().starts_with("<Run|"));
    assert_eq!(host.line(), "ok");
    assert!(began.elapsed() >= Duration::from_millis(200));
}
