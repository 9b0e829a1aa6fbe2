//! `cargo bench --bench disasters`: what the daemon does when its surroundings fail: a full disk, a read-only disk, a locked database,
//! floods of nonsense, slow clients, a huge body, a clock that goes back. One line each: what was done, what was seen.
//!
//! The daemon is the program itself with the demo's simulated devices, on a small disk in a file. Needs Linux and root for that disk, and
//! libfaketime for the clock; what is not there is said and left out.

#![allow(clippy::print_stdout)] // what a bench is for

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

const PORT: u16 = 18_371;
const DISK_MB: u64 = 120;
/// Longer than anything here may take.
const LONG: Duration = Duration::from_secs(60);
const CLOCK: &str = "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1";

fn main() {
    let folder = std::env::temp_dir().join(format!("acies-disasters-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let image = folder.with_extension("img");
    let disk = mounted(&image, &folder);
    let cell = folder.join("cell");
    let daemon = Daemon::start(&cell, None);
    until("ready", &|| state().contains("\"accepts\":true"));
    println!("start: {}", measured("before"));
    if disk {
        disk_full(&cell);
    }
    locked(&cell);
    nonsense();
    slow_clients();
    huge_body();
    println!("afterwards: {}; {}", measured("after"), daemon.process());
    drop(daemon);
    if Path::new(CLOCK).exists() {
        clock_back(&cell, &folder.join("clock"));
    } else {
        println!("clock back a day: left out, no libfaketime");
    }
    if disk {
        read_only(&cell, &folder);
        run("umount", &["-l", &text(&folder)]);
    } else {
        println!("disk full, read-only disk: left out, no image of a disk can be mounted (root?)");
    }
    let _ = std::fs::remove_file(&image);
    let _ = std::fs::remove_dir_all(&folder);
}

/// A small disk in a file.
fn mounted(image: &Path, folder: &Path) -> bool {
    let made = std::fs::File::create(image).and_then(|file| file.set_len(DISK_MB << 20));
    made.is_ok()
        && run("mkfs.ext4", &["-q", &text(image)])
        && run("mount", &["-o", "loop", &text(image), &text(folder)])
}

fn disk_full(cell: &Path) {
    let ballast = cell.join("ballast");
    let mut file = std::fs::File::create(&ballast).expect("a file");
    while file.write_all(&[0; 4096]).is_ok() {}
    drop(file);
    let during = measured("disk full");
    let said = field(&state(), "cause");
    std::fs::remove_file(&ballast).expect("removed");
    let (status, _) = ask("POST", "/api/v1/reset", "");
    until("ready", &|| state().contains("\"accepts\":true"));
    println!(
        "disk full: {during}; cause {said:?}; reset after making room: {status}; then {}",
        measured("room again")
    );
}

/// What the kernel does with a disk that fails. It stays so: this comes last.
fn read_only(cell: &Path, folder: &Path) {
    let daemon = Daemon::start(cell, None);
    until("ready", &|| state().contains("\"accepts\":true"));
    run("mount", &["-o", "remount,abort", &text(folder)]);
    let during = measured("read-only");
    let said = field(&state(), "cause");
    println!(
        "read-only disk: {during}; cause {said:?}; status answered {}; {}",
        ask("GET", "/api/v1/status", "").0,
        daemon.process()
    );
}

fn locked(cell: &Path) {
    let script = "import sqlite3,sys,time\nc=sqlite3.connect(sys.argv[1],isolation_level=None)\nc.execute('BEGIN EXCLUSIVE')\nprint('held',flush=True)\nsys.stdin.read()";
    let database = database(cell);
    let holder = Command::new("python3")
        .args(["-c", script, &text(&database)])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn();
    let Ok(mut holder) = holder else {
        println!("database locked: left out, no python3");
        return;
    };
    let mut line = [0; 5];
    let held = holder
        .stdout
        .take()
        .is_some_and(|mut out| out.read_exact(&mut line).is_ok());
    assert!(held, "the database is held");
    let began = Instant::now();
    let during = measured("locked");
    let waited = began.elapsed().as_secs_f64();
    let said = field(&state(), "cause");
    drop(holder.stdin.take());
    holder.wait().expect("its end");
    let (status, _) = ask("POST", "/api/v1/reset", "");
    until("ready", &|| state().contains("\"accepts\":true"));
    println!(
        "database locked by another program: answered after {waited:.1} s: {during}; cause {said:?}; reset after: {status}; then {}",
        measured("free again")
    );
}

fn clock_back(cell: &Path, clock: &Path) {
    std::fs::write(clock, "+0").expect("the clock");
    let daemon = Daemon::start(cell, Some(clock));
    until("ready", &|| state().contains("\"accepts\":true"));
    let today = measured("today");
    std::fs::write(clock, "-1d").expect("the clock");
    let earlier = measured("a day earlier");
    let (_, newest) = ask("GET", "/api/v1/inspections?limit=2", "");
    let order = newest.find("a day earlier").zip(newest.find("today"));
    std::fs::write(clock, "+0").expect("the clock");
    println!(
        "clock back a day: {today}, {earlier}; newest first in the history: {}; then {}",
        order.is_some_and(|(a, b)| a < b),
        measured("the right day")
    );
    drop(daemon);
}

/// As many requests as go through in five seconds, of bytes that are no HTTP, unknown paths, wrong bodies.
fn nonsense() {
    let (stop, sent) = (AtomicBool::new(false), AtomicUsize::new(0));
    let mut random = 7_u64;
    let bodies: Vec<Vec<u8>> = (0..64)
        .map(|k: usize| {
            random = random.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(1);
            match k % 4 {
                0 => random.to_le_bytes().repeat(20),
                1 => format!("GET /{random:x}/../..//%00 HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\n\r\n").into_bytes(),
                2 => format!("POST /api/v1/inspections HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{{\"a\":{k:>3}}}").into_bytes(),
                _ => format!("PATCH /api/v1/status HTTP/9.{k}\r\nHost: x\r\nX: {random}\r\n\r\n").into_bytes(),
            }
        })
        .collect();
    let (during, worst) = std::thread::scope(|scope| {
        for thread in 0..8 {
            let (stop, sent, bodies) = (&stop, &sent, &bodies);
            scope.spawn(move || {
                let mut at = thread;
                while !stop.load(Ordering::Relaxed) {
                    let Ok(mut stream) = TcpStream::connect(("127.0.0.1", PORT)) else {
                        continue;
                    };
                    let _ = stream.set_read_timeout(Some(Duration::from_secs(5)));
                    // A connection that stays open takes fifty of them.
                    for _ in 0..50 {
                        at += 1;
                        let mut answer = [0; 1024];
                        if stream.write_all(&bodies[at % bodies.len()]).is_err()
                            || !matches!(stream.read(&mut answer), Ok(1..))
                        {
                            break;
                        }
                        sent.fetch_add(1, Ordering::Relaxed);
                    }
                }
            });
        }
        let began = Instant::now();
        let during = measured("nonsense");
        let mut worst: f64 = 0.0;
        while began.elapsed() < Duration::from_secs(5) {
            let asked = Instant::now();
            state();
            worst = worst.max(asked.elapsed().as_secs_f64());
        }
        stop.store(true, Ordering::Relaxed);
        (
            format!(
                "{during}; {:.0} answered a second",
                sent.load(Ordering::Relaxed) as f64 / began.elapsed().as_secs_f64()
            ),
            worst,
        )
    });
    println!(
        "nonsense from eight clients without pause: {during}; status answered within {:.0} ms; then {}",
        1e3 * worst,
        measured("quiet again")
    );
}

/// Clients that begin a request and never end it.
fn slow_clients() {
    let mut held: Vec<TcpStream> = Vec::new();
    for _ in 0..600 {
        let Ok(mut stream) = TcpStream::connect(("127.0.0.1", PORT)) else {
            break;
        };
        if stream
            .write_all(b"GET /api/v1/status HTTP/1.1\r\nHost: 127")
            .is_err()
        {
            break;
        }
        held.push(stream);
    }
    let asked = Instant::now();
    let during = measured("slow clients");
    let took = asked.elapsed().as_secs_f64();
    println!(
        "{} clients that never end their request: {during} ({took:.1} s); then {}",
        held.len(),
        {
            drop(held);
            measured("without them")
        }
    );
}

fn huge_body() {
    let head = format!(
        "POST /api/v1/recipes/import HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\nContent-Type: application/octet-stream\r\nContent-Length: 1000000000\r\n\r\n"
    );
    let mut stream = TcpStream::connect(("127.0.0.1", PORT)).expect("connected");
    stream.set_read_timeout(Some(LONG)).expect("a time-out");
    stream.write_all(head.as_bytes()).expect("sent");
    let (block, mut taken) = (vec![b'x'; 1 << 20], 0);
    while taken < 1000 && stream.write_all(&block).is_ok() {
        taken += 1;
    }
    let mut answer = [0; 256];
    let read = stream.read(&mut answer).unwrap_or(0);
    let first = String::from_utf8_lossy(&answer[..read])
        .lines()
        .next()
        .unwrap_or("connection closed")
        .to_owned();
    println!(
        "a body of 1 GB: {first:?} after {taken} MB; then {}",
        measured("after the body")
    );
}

/// Starts a part and says how it ended.
fn measured(serial: &str) -> String {
    let order = format!("{{\"part_serial\":\"{serial}\"}}");
    let (status, body) = ask("POST", "/api/v1/inspections", &order);
    if status != 201 {
        return format!("start answered {status}: {}", field(&body, "detail"));
    }
    let id: i64 = body
        .split("\"id\":")
        .nth(1)
        .and_then(|rest| {
            rest.split(|c: char| !c.is_ascii_digit())
                .next()?
                .parse()
                .ok()
        })
        .unwrap_or(0);
    let path = format!("/api/v1/inspections/{id}");
    let ended = |body: &str| {
        ["done", "aborted", "refused"]
            .iter()
            .any(|phase| body.contains(&format!("\"phase\":\"{phase}\"")))
    };
    let began = Instant::now();
    loop {
        let (_, body) = ask("GET", &path, "");
        if ended(&body) {
            let phase = field(&body, "phase");
            let reason = field(&body, "reason");
            return if phase == "done" {
                "measured".to_owned()
            } else {
                format!("{phase}: {reason}")
            };
        }
        if began.elapsed() > LONG {
            return format!("not ended within {LONG:?}: {}", field(&state(), "cause"));
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}

fn state() -> String {
    ask("GET", "/api/v1/status", "").1
}

fn until(what: &str, is_so: &dyn Fn() -> bool) {
    let began = Instant::now();
    while !is_so() {
        assert!(began.elapsed() < LONG, "{what}: {}", state());
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Status and body; status 0 where there was no answer.
fn ask(method: &str, path: &str, body: &str) -> (u16, String) {
    let answer = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect(("127.0.0.1", PORT))?;
        stream.set_read_timeout(Some(LONG))?;
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{PORT}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        )?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    };
    let Ok(answer) = answer() else {
        return (0, String::new());
    };
    let status = answer
        .split(' ')
        .nth(1)
        .and_then(|s| s.parse().ok())
        .unwrap_or(0);
    let body = answer.split_once("\r\n\r\n").map_or("", |(_, body)| body);
    (status, body.to_owned())
}

/// The text of the first field of this name.
fn field(json: &str, name: &str) -> String {
    let rest = json
        .split(&format!("\"{name}\":\""))
        .nth(1)
        .unwrap_or_default();
    rest.split('"').next().unwrap_or_default().to_owned()
}

struct Daemon(Child);

impl Daemon {
    fn start(cell: &Path, clock: Option<&Path>) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_acies"));
        command.args([
            "demo",
            "--output",
            &text(cell),
            "--serve",
            &format!("127.0.0.1:{PORT}"),
        ]);
        if let Some(clock) = clock {
            command.env("LD_PRELOAD", CLOCK);
            command.env("FAKETIME_TIMESTAMP_FILE", clock);
            command.env("FAKETIME_NO_CACHE", "1");
            command.env("DONT_FAKE_MONOTONIC", "1");
        }
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        Self(child.expect("the daemon"))
    }

    fn process(&self) -> String {
        let status =
            std::fs::read_to_string(format!("/proc/{}/status", self.0.id())).unwrap_or_default();
        let resident = status
            .lines()
            .find(|line| line.starts_with("VmRSS"))
            .unwrap_or("gone");
        resident.split_whitespace().collect::<Vec<_>>().join(" ")
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn database(cell: &Path) -> PathBuf {
    let files = std::fs::read_dir(cell.join("store")).expect("the store");
    let mut paths = files.filter_map(|entry| Some(entry.ok()?.path()));
    paths
        .find(|path| path.extension().is_some_and(|e| e == "sqlite" || e == "db"))
        .expect("the database")
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

fn run(program: &str, arguments: &[&str]) -> bool {
    Command::new(program)
        .args(arguments)
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}
