//! Cable, recorder and replay: what a link must hold, on a real pseudo-terminal and a real socket.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use acies_drivers::error::LinkError;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::recording::{Kind, Record, Recorder, Recording};
use acies_drivers::link::replay::{Match, Replay};
use acies_drivers::link::{Line, Link, Links, Port, Target};
use serialport::{SerialPort, TTYPort};

use crate::script::{Device, SOON, Scripted, Wire};

fn port(path: &str) -> Target {
    Target::Serial {
        port: Port::Path(path.into()),
        line: Line::eight_n_one(921_600),
    }
}

fn soon() -> Instant {
    Instant::now() + SOON
}

fn refusal(target: &Target) -> String {
    match Cable.open(target) {
        Ok(_) => panic!("{target} opened"),
        Err(error) => error.to_string(),
    }
}

/// Reads exactly `n` bytes.
fn read_exact(link: &dyn Link, n: usize) -> Vec<u8> {
    let mut bytes = vec![0; n];
    let mut at = 0;
    while at < n {
        let got = link.read(&mut bytes[at..], soon()).expect("bytes");
        assert!(got > 0, "nothing within {SOON:?}");
        at += got;
    }
    bytes
}

/// A pseudo-terminal: the device's end, and a link to the other.
fn terminal() -> (TTYPort, Arc<dyn Link>, String) {
    let (device, host) = TTYPort::pair().expect("a pseudo-terminal");
    let path = host.name().expect("a name");
    // Both locks of the helper's own handle go with it; the terminal stays while the device's end is open.
    drop(host);
    let link = Cable.open(&port(&path)).expect("an open port");
    (device, link, path)
}

#[test]
fn a_serial_link_carries_bytes_both_ways() {
    let (mut device, link, _) = terminal();
    link.write(b"question", soon()).expect("a write");
    let mut heard = [0; 8];
    device.set_timeout(SOON).expect("a timeout");
    device.read_exact(&mut heard).expect("the question");
    assert_eq!(&heard, b"question");
    // Bytes that a terminal would treat in a special way unless it is raw.
    let special: Vec<u8> = (0..=255).collect();
    device.write_all(&special).expect("an answer");
    assert_eq!(read_exact(&*link, 256), special);
}

#[test]
fn a_read_waits_for_its_deadline_and_no_longer() {
    let (_device, link, _) = terminal();
    let began = Instant::now();
    let wait = Duration::from_millis(40);
    assert_eq!(link.read(&mut [0; 8], began + wait).expect("nothing"), 0);
    assert!(began.elapsed() >= wait);
    assert_eq!(link.read(&mut [0; 8], began).expect("nothing"), 0);
}

#[test]
fn a_serial_port_that_goes_away_is_gone() {
    let (device, link, path) = terminal();
    let reader = Arc::clone(&link);
    let blocked = thread::spawn(move || reader.read(&mut [0; 8], soon()));
    drop(device);
    let answer = blocked.join().expect("no panic");
    assert!(matches!(answer, Err(LinkError::Gone)), "{answer:?}");
    let answer = link.write(b"x", soon());
    assert!(matches!(answer, Err(LinkError::Gone)), "{answer:?}");
    drop(link);
    assert_eq!(
        refusal(&port(&path)),
        "nothing of this name is there; check cable, power and the name"
    );
}

#[test]
fn a_port_in_use_is_busy() {
    let (_device, _link, path) = terminal();
    assert_eq!(
        refusal(&port(&path)),
        "another program has it open; close that program, then retry"
    );
}

#[test]
fn a_device_that_takes_no_bytes_does_not_hold_us() {
    let (_device, link, _) = terminal();
    let flood = vec![0x55; 1 << 20];
    let began = Instant::now();
    let answer = link.write(&flood, began + Duration::from_millis(200));
    let Err(LinkError::Stuck { written, length }) = answer else {
        panic!("{answer:?}");
    };
    assert!(written < length && length == 1 << 20);
    let text = LinkError::Stuck { written: 5, length };
    assert_eq!(
        text.to_string(),
        "it takes no bytes: 5 of 1048576 written in time; check that the device runs"
    );
}

#[test]
fn names_that_cannot_be_opened_say_why() {
    assert_eq!(
        refusal(&port("/dev/no-such-port")),
        "nothing of this name is there; check cable, power and the name"
    );
    let file = folder("plain").join("file");
    fs::write(&file, "no port").expect("a file");
    assert_eq!(
        refusal(&port(file.to_str().expect("a UTF-8 path"))),
        "it is not a serial port; give the path of one, as in \"/dev/ttyACM0\""
    );
    let by_serial = Target::Serial {
        port: Port::UsbSerial("no such serial number".into()),
        line: Line::eight_n_one(9600),
    };
    assert!(matches!(Cable.open(&by_serial), Err(LinkError::NotFound)));
}

fn tcp() -> (TcpListener, Target) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("an address").to_string();
    (listener, Target::Tcp { address })
}

#[test]
fn a_tcp_link_carries_bytes_and_tells_a_closed_end() {
    let (listener, target) = tcp();
    let device = thread::spawn(move || {
        let (mut stream, _) = listener.accept().expect("a client");
        let mut heard = [0; 8];
        stream.read_exact(&mut heard).expect("the question");
        stream.write_all(&heard).expect("an answer");
    });
    let link = Cable.open(&target).expect("a connection");
    let began = Instant::now();
    let wait = Duration::from_millis(30);
    assert_eq!(link.read(&mut [0; 8], began + wait).expect("nothing"), 0);
    assert!(began.elapsed() >= wait);
    link.write(b"question", soon()).expect("a write");
    assert_eq!(read_exact(&*link, 8), b"question");
    let answer = link.read(&mut [0; 8], soon());
    assert!(matches!(answer, Err(LinkError::Gone)), "{answer:?}");
    device.join().expect("no panic");
}

#[test]
fn a_tcp_device_that_takes_no_bytes_does_not_hold_us() {
    let (listener, target) = tcp();
    let link = Cable.open(&target).expect("a connection");
    let _client = listener.accept().expect("a client");
    let flood = vec![0x55; 32 << 20];
    let answer = link.write(&flood, Instant::now() + Duration::from_millis(200));
    assert!(matches!(answer, Err(LinkError::Stuck { .. })), "{answer:?}");
}

#[test]
fn a_tcp_port_where_nobody_listens_is_refused() {
    let (listener, target) = tcp();
    drop(listener);
    assert_eq!(
        refusal(&target),
        "connection refused; check that the device listens there and has no other client"
    );
}

/// An empty folder of this test's own.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder");
    folder
}

/// Repeats what it hears.
struct Echo;

impl Device for Echo {
    fn hear(&mut self, written: &[u8]) -> Vec<u8> {
        written.to_vec()
    }
}

/// Asks twice and reads the answers, then reads the end.
fn talk(links: &dyn Links) -> Result<Vec<u8>, LinkError> {
    let link = links.open(&port("/dev/fake"))?;
    let mut heard = Vec::new();
    for question in [b"one".as_slice(), b"three"] {
        link.write(question, soon())?;
        heard.extend(read_exact(&*link, question.len()));
    }
    Ok(heard)
}

fn recorded(name: &str, limit_bytes: u64) -> (PathBuf, Recording) {
    let folder = folder(name);
    let fake = Scripted::new(Echo);
    let recorder = Recorder::new(Wire(Arc::clone(&fake)), &folder, limit_bytes);
    assert_eq!(talk(&recorder).expect("a talk"), b"onethree");
    let path = folder.join("dev_fake-0.aciesrec");
    let recording = Recording::read(&path).expect("a recording");
    (path, recording)
}

#[test]
fn what_passed_is_in_the_recording() {
    let (path, recording) = recorded("passed", 1 << 20);
    assert_eq!(recording.target, "/dev/fake");
    assert_eq!(recording.torn_at, None);
    let passed: Vec<(Kind, &[u8])> = recording
        .records
        .iter()
        .map(|record| (record.kind, record.bytes.as_slice()))
        .collect();
    assert_eq!(
        passed,
        [
            (Kind::ToDevice, b"one".as_slice()),
            (Kind::FromDevice, b"one"),
            (Kind::ToDevice, b"three"),
            (Kind::FromDevice, b"three"),
        ]
    );
    assert!(recording.records.is_sorted_by_key(|record| record.time));
    let bytes = fs::read(&path).expect("the file");
    assert_eq!(recording.encode(), bytes);
}

#[test]
fn a_recording_cut_anywhere_keeps_what_is_whole() {
    let (path, whole) = recorded("cut", 1 << 20);
    let bytes = whole.encode();
    let header = 8 + 4 + 4 + "/dev/fake".len() + 4;
    for length in header..bytes.len() {
        let cut = Recording::decode(&bytes[..length], &path).expect("a recording");
        let kept = cut.records.len();
        assert_eq!(cut.records, whole.records[..kept], "cut at {length}");
        let ends = header
            + whole.records[..kept]
                .iter()
                .map(|record| 20 + record.bytes.len())
                .sum::<usize>();
        assert_eq!(cut.torn_at, (ends < length).then_some(ends));
    }
    for at in header..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x10;
        let read = Recording::decode(&damaged, &path).expect("a recording");
        assert!(read.torn_at.is_some_and(|torn| torn <= at), "byte {at}");
    }
}

#[test]
fn a_recording_ends_at_its_limit_and_the_link_goes_on() {
    let (path, recording) = recorded("limit", 100);
    let last = recording.records.last().expect("records");
    assert_eq!(last.kind, Kind::Limit);
    assert!(fs::metadata(path).expect("the file").len() <= 100);
}

#[test]
fn bad_recordings_say_what_is_wrong() {
    let told = |bytes: &[u8]| {
        let error = Recording::decode(bytes, Path::new("x.aciesrec"));
        error.expect_err("a bad recording").to_string()
    };
    assert_eq!(
        told(b""),
        "x.aciesrec: begins with \"\", a recording begins with \"ACIESREC\""
    );
    assert_eq!(
        told(b"PK\x03\x04 something"),
        "x.aciesrec: begins with \"PK\\u{3}\\u{4} som\", a recording begins with \"ACIESREC\""
    );
    assert_eq!(
        told(b"ACIESREC\x03\0\0\0\0\0\0\0"),
        "x.aciesrec: recording format 3, this program reads 1 and 2; use the program that wrote it"
    );
    assert_eq!(
        told(b"ACIESREC\x01\0\0\0\xFF\xFF\xFF\xFF"),
        "x.aciesrec: the header is damaged at byte 12"
    );
    let mut header = Recording {
        target: "y".into(),
        records: Vec::new(),
        torn_at: None,
    }
    .encode();
    header[16] ^= 1;
    assert_eq!(
        told(&header),
        "x.aciesrec: the header is damaged at byte 17"
    );
    let missing = Recording::read(Path::new("/no/such/recording"));
    assert_eq!(
        missing.expect_err("no file").to_string(),
        "/no/such/recording: cannot be read"
    );
    let recorder = Recorder::new(Wire(Scripted::new(Echo)), "/no/such/folder", 1000);
    let Err(error) = recorder.open(&port("/dev/fake")) else {
        panic!("a recording in a folder that is not there");
    };
    assert_eq!(error.to_string(), "bad recording");
    let inner = std::error::Error::source(&error).expect("a source");
    assert_eq!(
        inner.to_string(),
        "/no/such/folder/dev_fake-0.aciesrec: cannot be created"
    );
}

#[test]
fn a_lying_length_allocates_nothing() {
    let mut bytes = Recording {
        target: String::new(),
        records: Vec::new(),
        torn_at: None,
    }
    .encode();
    let end = bytes.len();
    bytes.extend([0, 0, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF]);
    bytes.extend([0; 8]);
    let read = Recording::decode(&bytes, Path::new("x")).expect("a recording");
    assert_eq!((read.records.len(), read.torn_at), (0, Some(end)));
}

#[test]
fn a_recording_plays_back_to_the_same_talk() {
    let (_, recording) = recorded("replay", 1 << 20);
    for matching in [Match::Exact, Match::Loose(SOON)] {
        let replay = Replay::new(recording.clone(), matching);
        assert_eq!(talk(&replay).expect("the same talk"), b"onethree");
        assert!(matches!(talk(&replay), Err(LinkError::Busy)));
    }
}

#[test]
fn an_exact_replay_refuses_another_write() {
    let (_, recording) = recorded("departed", 1 << 20);
    let replay = Replay::new(recording.clone(), Match::Exact);
    let link = replay.open(&port("/dev/fake")).expect("a replay");
    let error = link.write(b"two", soon()).expect_err("another write");
    let text = error.to_string();
    assert!(
        text.starts_with("the host writes 74 77 6f, the recording has 6f 6e 65 at 0.0"),
        "{text}"
    );
    // No answer before its question, and no end of the wait but the deadline's.
    let brief = Instant::now() + Duration::from_millis(20);
    assert_eq!(link.read(&mut [0; 8], brief).expect("nothing"), 0);
}

#[test]
fn a_loose_replay_passes_over_writes_that_do_not_come() {
    let record = |kind, bytes: &[u8]| Record {
        kind,
        channel: 0,
        time: Duration::ZERO,
        bytes: bytes.into(),
    };
    let recording = Recording {
        target: "t".into(),
        records: vec![
            record(Kind::ToDevice, b"keep alive"),
            record(Kind::FromDevice, b"abc"),
            record(Kind::Gone, b""),
        ],
        torn_at: None,
    };
    let replay = Replay::new(recording, Match::Loose(Duration::from_millis(10)));
    let link = replay.open(&port("/dev/fake")).expect("a replay");
    assert_eq!(read_exact(&*link, 3), b"abc");
    assert!(matches!(
        link.read(&mut [0; 8], soon()),
        Err(LinkError::Gone)
    ));
}

/// Data on the one channel, pings on the other: the data do not wait for pings, no ping takes the answer of the stop, and one that is asked late, or
/// once more than it was, is answered too. What came keeps its time.
#[test]
fn data_do_not_wait_for_the_keep_alives_of_another_channel() {
    const PINGS: u64 = 200;
    let record = |kind, channel, ms: u64, bytes: &[u8]| Record {
        kind,
        channel,
        time: Duration::from_millis(ms),
        bytes: bytes.into(),
    };
    let mut records = vec![
        record(Kind::Opened, 0, 0, b"/dev/control"),
        record(Kind::Opened, 1, 0, b"/dev/data"),
        record(Kind::ToDevice, 0, 1, b"start"),
        record(Kind::FromDevice, 0, 2, b"started"),
    ];
    for ping in 1..=PINGS {
        let ms = 1000 * ping;
        records.push(record(Kind::FromDevice, 1, ms, b"data"));
        records.push(record(Kind::ToDevice, 0, ms + 1, b"ping"));
        records.push(record(Kind::FromDevice, 0, ms + 2, b"pong"));
    }
    records.push(record(Kind::ToDevice, 0, 300_000, b"stop"));
    records.push(record(Kind::FromDevice, 0, 300_001, b"stopped"));
    let recording = Recording {
        target: "t".into(),
        records,
        torn_at: None,
    };
    let began = Instant::now();
    let replay = Replay::of_run(recording, Match::Loose(Duration::from_micros(100)), began);
    let control = replay.open(&port("/dev/control")).expect("a replay");
    let data = replay.open(&port("/dev/data")).expect("a replay");
    control.write(b"start", soon()).expect("a write");
    assert_eq!(read_exact(&*control, 7), b"started");
    let mut came = Vec::new();
    for _ in 0..PINGS - 10 {
        assert_eq!(read_exact(&*data, 4), b"data");
        came.push(data.received());
    }
    let steps = came.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(steps.into_iter().all(|step| step == Duration::from_secs(1)));
    // The answer to one that was passed over, and one that is in its turn.
    for _ in 0..2 {
        control.write(b"ping", soon()).expect("a write");
        assert_eq!(read_exact(&*control, 4), b"pong");
    }
    for _ in 0..10 {
        assert_eq!(read_exact(&*data, 4), b"data");
    }
    control.write(b"ping", soon()).expect("a write");
    assert_eq!(read_exact(&*control, 4), b"pong");
    control.write(b"stop", soon()).expect("a write");
    // A few answers to pings may stand before it, as with a late device: not all of them.
    let mut rest = Vec::new();
    while !rest.ends_with(b"stopped") {
        rest.extend(read_exact(&*control, 1));
    }
    assert!(rest.len() <= 4 * 4 + 7, "{rest:?}");
}

#[test]
fn a_device_recorded_as_gone_is_gone_in_the_replay() {
    let folder = folder("gone");
    let fake = Scripted::new(Echo);
    let recorder = Recorder::new(Wire(Arc::clone(&fake)), &folder, 1 << 20);
    let link = recorder.open(&port("/dev/fake")).expect("a link");
    fake.unplug();
    assert!(link.read(&mut [0; 8], soon()).is_err());
    let recording = Recording::read(&folder.join("dev_fake-0.aciesrec")).expect("a recording");
    assert_eq!(recording.records.len(), 1);
    assert_eq!(recording.records[0].kind, Kind::Gone);
}
