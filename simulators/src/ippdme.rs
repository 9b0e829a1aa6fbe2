//! A coordinate measuring machine with an I++ DME server, release 1.4.3, played from the specification: session, error state, moves,
//! points, scans along a line, reports while moving.
//!
//! Where the specification leaves a choice, this server chooses as the one of the NIST logs does: items of a point come normal first, error
//! numbers have four digits, scan lines hold up to twelve points. Moves take no time.

use std::fmt::Write as _;
use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use glam::DVec3;

use crate::contact::Move;
use crate::pose::Pose;
use crate::scene::{Ray, Scene};
use crate::wire::lock;

/// Points in one line of a scan.
const POINTS_A_LINE: usize = 12;
/// Half the edge of the machine's volume, mm.
const VOLUME_MM: f64 = 10_000.0;

/// How the server plays.
#[derive(Debug, Clone)]
pub struct Setup {
    /// What is touched.
    pub scene: Arc<Scene>,
    /// Where it is.
    pub machine_from_scene: Pose,
    /// Of the tip, mm.
    pub tip_radius_mm: f64,
    /// Points are reported on the surface, by the commanded normal; otherwise where the centre of the tip is.
    pub compensated: bool,
    /// The machine is homed.
    pub homed: bool,
    /// Places of X, Y and Z among the numbers of a scan's points.
    pub scan_order: [usize; 3],
    /// What goes wrong.
    pub misdeeds: Misdeeds,
}

impl Setup {
    /// A server in good order.
    pub fn new(scene: Arc<Scene>, machine_from_scene: Pose, tip_radius_mm: f64) -> Setup {
        Setup {
            scene,
            machine_from_scene,
            tip_radius_mm,
            compensated: false,
            homed: true,
            scan_order: [0, 1, 2],
            misdeeds: Misdeeds::default(),
        }
    }
}

/// What goes wrong.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Misdeeds {
    /// Nothing is answered.
    pub mute: bool,
    /// A web server is there instead.
    pub babble: bool,
    /// Lines go out in pieces of so many characters.
    pub pieces: Option<usize>,
    /// Unsolicited lines and reports of a daemon that was stopped stand between `&` and `%`.
    pub chatter: bool,
    /// The server closes the connection in the middle of the n-th point.
    pub close_in_point: Option<u32>,
    /// The n-th point is acknowledged and never ends.
    pub hang_in_point: Option<u32>,
    /// The n-th point ends in this error.
    pub fail_point: Option<(u32, u32)>,
    /// A line of the n-th point has a character that is not allowed.
    pub garble_point: Option<u32>,
    /// Every acknowledgement comes so much later, ms.
    pub late_ms: Option<u32>,
}

/// What the server was asked, and did.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Truth {
    /// Every command that came, without its tag.
    pub commands: Vec<String>,
    /// True centre of the tip at each contact, mm, machine axes.
    pub touches_mm: Vec<DVec3>,
    /// Points that were asked for.
    pub points: u32,
    /// Sessions that ended in order.
    pub ended: u32,
    /// A session is open.
    pub in_session: bool,
}

/// A running server; dropping it closes its port.
#[derive(Debug)]
pub struct SimulatedCmm {
    address: SocketAddr,
    truth: Arc<Mutex<Truth>>,
    quit: Arc<Mutex<bool>>,
    thread: Option<JoinHandle<()>>,
}

impl SimulatedCmm {
    /// Starts a server on a free port of this computer.
    ///
    /// # Errors
    /// When the system gives no port or thread.
    pub fn start(setup: Setup) -> std::io::Result<SimulatedCmm> {
        SimulatedCmm::start_on(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), setup)
    }

    /// Starts a server on an address.
    ///
    /// # Errors
    /// When it is taken, or the system gives no thread.
    pub fn start_on(address: SocketAddr, setup: Setup) -> std::io::Result<SimulatedCmm> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (truth, quit) = (
            Arc::new(Mutex::new(Truth::default())),
            Arc::new(Mutex::new(false)),
        );
        let (seen, over) = (Arc::clone(&truth), Arc::clone(&quit));
        let thread = std::thread::Builder::new()
            .name("ippdme-sim".into())
            .spawn(move || {
                // One client at a time: after it closes, the server listens again.
                for stream in listener.incoming() {
                    if *lock(&over) {
                        return;
                    }
                    if let Ok(stream) = stream {
                        Server::new(&setup, &seen, &over, stream).serve();
                        lock(&seen).in_session = false;
                    }
                }
            })?;
        Ok(SimulatedCmm {
            address,
            truth,
            quit,
            thread: Some(thread),
        })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What it was asked, and did.
    pub fn truth(&self) -> Truth {
        lock(&self.truth).clone()
    }
}

impl Drop for SimulatedCmm {
    fn drop(&mut self) {
        *lock(&self.quit) = true;
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The connection is over.
struct Over;

type Done = Result<(), Over>;

/// An error to be reported: severity, number, text.
type Fault = (u32, u32, &'static str);

struct Server<'a> {
    setup: &'a Setup,
    truth: &'a Mutex<Truth>,
    quit: &'a Mutex<bool>,
    stream: TcpStream,
    session: bool,
    /// An error of severity 2 or more waits to be cleared.
    failed: bool,
    homed: bool,
    at: DVec3,
    approach: f64,
    search: f64,
    retract: f64,
    with_normal: bool,
    with_quality: bool,
    daemon: Option<(String, f64)>,
}

impl Server<'_> {
    fn new<'a>(
        setup: &'a Setup,
        truth: &'a Mutex<Truth>,
        quit: &'a Mutex<bool>,
        stream: TcpStream,
    ) -> Server<'a> {
        Server {
            setup,
            truth,
            quit,
            stream,
            session: false,
            failed: false,
            homed: setup.homed,
            at: DVec3::new(0.0, 0.0, 500.0),
            approach: 5.0,
            search: 5.0,
            retract: 5.0,
            with_normal: false,
            with_quality: true,
            daemon: None,
        }
    }

    fn serve(&mut self) {
        let _ = self.stream.set_nodelay(true);
        let _ = self
            .stream
            .set_read_timeout(Some(Duration::from_millis(20)));
        let mut held = Vec::new();
        let mut chunk = [0; 4096];
        loop {
            match self.stream.read(&mut chunk) {
                Ok(0) => return,
                Ok(n) => held.extend_from_slice(&chunk[..n]),
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return,
            }
            if *lock(self.quit) {
                return;
            }
            while let Some(end) = held.windows(2).position(|pair| pair == b"\r\n") {
                let line: Vec<u8> = held.drain(..end + 2).take(end).collect();
                let line = String::from_utf8_lossy(&line).into_owned();
                if self.line(&line).is_err() {
                    return;
                }
            }
        }
    }

    fn send(&mut self, text: &str) -> Done {
        let line = format!("{text}\r\n");
        let size = self.setup.misdeeds.pieces.unwrap_or(line.len());
        for piece in line.as_bytes().chunks(size.max(1)) {
            self.stream.write_all(piece).map_err(|_| Over)?;
        }
        Ok(())
    }

    fn error(&mut self, tag: &str, command: &str, (severity, number, text): Fault) -> Done {
        self.failed |= severity >= 2;
        let cause = command.replace('"', "#");
        self.send(&format!(
            "{tag} ! Error({severity}, {number:04}, \"{tag} {cause}\", \"{text}\")"
        ))
    }

    fn line(&mut self, line: &str) -> Done {
        if self.setup.misdeeds.mute {
            return Ok(());
        }
        if self.setup.misdeeds.babble {
            return self.send("HTTP/1.1 400 Bad Request");
        }
        let event = line.starts_with('E');
        let digits = &line[usize::from(event)..line.len().min(5)];
        if line.len() < 7 || !digits.bytes().all(|b| b.is_ascii_digit()) {
            return self.error("E0000", line, (2, 1, "Illegal tag"));
        }
        let (tag, rest) = line.split_at(5);
        let Some(command) = rest.strip_prefix(' ') else {
            return self.error(tag, rest, (2, 2, "No space at pos. 6"));
        };
        lock(self.truth).commands.push(command.to_owned());
        let (method, arguments) = command.split_once('(').unwrap_or((command, ""));
        let arguments = arguments.strip_suffix(')').unwrap_or(arguments);
        if self.failed
            && !matches!(
                method,
                "ClearAllErrors" | "EndSession" | "StartSession" | "GetErrStatusE" | "AbortE"
            )
        {
            return self.refuse(tag, command, (2, 514, "Use ClearAllErrors To Continue"));
        }
        let session = matches!(method, "StartSession" | "EndSession");
        if !session && !self.session || method == "StartSession" && self.session {
            return self.refuse(tag, command, (3, 8, "Protocol error"));
        }
        if let Some(ms) = self.setup.misdeeds.late_ms {
            std::thread::sleep(Duration::from_millis(ms.into()));
        }
        self.send(&format!("{tag} &"))?;
        if self.setup.misdeeds.chatter && !event {
            self.send("E0000 # KeyPress(\"Done\")")?;
            self.send("E0099 # X(1.00000), Y(2.00000), Z(3.00000)")?;
        }
        match self.carry_out(tag, method, arguments)? {
            Ok(()) => {}
            Err(fault) => self.error(tag, command, fault)?,
        }
        self.send(&format!("{tag} %"))
    }

    fn refuse(&mut self, tag: &str, command: &str, fault: Fault) -> Done {
        self.send(&format!("{tag} &"))?;
        self.error(tag, command, fault)?;
        self.send(&format!("{tag} %"))
    }

    fn carry_out(
        &mut self,
        tag: &str,
        method: &str,
        arguments: &str,
    ) -> Result<Result<(), Fault>, Over> {
        match method {
            "StartSession" => {
                self.session = true;
                self.failed = false;
                self.with_normal = false;
                self.with_quality = true;
                lock(self.truth).in_session = true;
            }
            "EndSession" => {
                self.session = false;
                let mut truth = lock(self.truth);
                truth.in_session = false;
                truth.ended += 1;
            }
            "ClearAllErrors" => self.failed = false,
            "AbortE" => {}
            "GetDMEVersion" => self.send(&format!("{tag} # DMEVersion(\"1.4.3\")"))?,
            "GetMachineClass" => self.send(&format!("{tag} # GetMachineClass(\"CartCMM\")"))?,
            "IsHomed" => self.send(&format!("{tag} # IsHomed({})", u8::from(self.homed)))?,
            "Home" => self.homed = true,
            "ChangeTool" if arguments == "\"Probe1\"" => {}
            "ChangeTool" => return Ok(Err((3, 1502, "Tool not found"))),
            "SetCoordSystem" if ["MachineCsy", "PartCsy"].contains(&arguments) => {}
            "OnPtMeasReport" => self.with_normal = arguments.contains("IJK"),
            "OnScanReport" => self.with_quality = arguments.contains("Q()"),
            "SetProp" => return Ok(self.set(arguments)),
            "Get" => {
                let [x, y, z] = self.at.to_array();
                self.send(&format!("{tag} # X({x:.5}), Y({y:.5}), Z({z:.5})"))?;
            }
            "GoTo" => return self.go_to(arguments),
            "PtMeas" => return self.point(tag, arguments),
            "ScanOnLine" => return self.scan(tag, arguments),
            "OnMoveReportE" => {
                let every = value(arguments, "Dis").unwrap_or(1.0);
                self.daemon = Some((tag.to_owned(), every));
            }
            "StopDaemon" => match self.daemon.take() {
                Some((running, _)) if running == arguments => {}
                _ => return Ok(Err((2, 513, "Daemon does not exist"))),
            },
            _ => return Ok(Err((3, 501, "Unsupported command"))),
        }
        Ok(Ok(()))
    }

    fn set(&mut self, arguments: &str) -> Result<(), Fault> {
        for (name, place) in [
            ("Tool.PtMeasPar.Approach", &mut self.approach),
            ("Tool.PtMeasPar.Search", &mut self.search),
            ("Tool.PtMeasPar.Retract", &mut self.retract),
        ] {
            if let Some(mm) = value(arguments, name) {
                if !(0.0..=1_000.0).contains(&mm) {
                    return Err((1, 504, "Argument out of range"));
                }
                *place = mm;
                return Ok(());
            }
        }
        Err((3, 509, "Bad argument"))
    }

    fn go_to(&mut self, arguments: &str) -> Result<Result<(), Fault>, Over> {
        let mut to = self.at;
        for (name, place) in [("X", &mut to.x), ("Y", &mut to.y), ("Z", &mut to.z)] {
            if let Some(mm) = value(arguments, name) {
                *place = mm;
            }
        }
        if to.abs().max_element() > VOLUME_MM {
            return Ok(Err((3, 1008, "Target position out of machine volume")));
        }
        self.report_way(to)?;
        if self.contact(self.at, to).is_some() {
            return Ok(Err((3, 2504, "Collision")));
        }
        self.at = to;
        Ok(Ok(()))
    }

    /// Sends the positions that a daemon asked for.
    fn report_way(&mut self, to: DVec3) -> Done {
        let Some((tag, every)) = self.daemon.clone() else {
            return Ok(());
        };
        let way = to - self.at;
        let steps = (way.length() / every).floor().min(1_000.0) as u32;
        for step in 1..=steps {
            let p = self.at + way.normalize_or_zero() * (f64::from(step) * every);
            self.send(&format!(
                "{tag} # X({:.5}), Y({:.5}), Z({:.5})",
                p.x, p.y, p.z
            ))?;
        }
        Ok(())
    }

    /// Centre of the tip at the first contact on a way of the machine.
    fn contact(&self, from: DVec3, to: DVec3) -> Option<DVec3> {
        let scene_from_machine = self.setup.machine_from_scene.inverse();
        let way = Move {
            from: scene_from_machine.point(from),
            to: scene_from_machine.point(to),
            radius: self.setup.tip_radius_mm,
        };
        let contact = way.first_contact(&self.setup.scene)?;
        (contact.travel > 0.0).then(|| from + (to - from).normalize() * contact.travel)
    }

    fn point(&mut self, tag: &str, arguments: &str) -> Result<Result<(), Fault>, Over> {
        let [Some(x), Some(y), Some(z)] = ["X", "Y", "Z"].map(|name| value(arguments, name)) else {
            return Ok(Err((3, 502, "Incorrect Arguments")));
        };
        let normal = match triple(arguments, "IJK") {
            Some(normal) if normal.length() > 0.0 => normal.normalize(),
            Some(_) => return Ok(Err((2, 1010, "Vector has no norm"))),
            None => DVec3::Z,
        };
        let number = {
            let mut truth = lock(self.truth);
            truth.points += 1;
            truth.points
        };
        let misdeeds = self.setup.misdeeds.clone();
        let now = |which: Option<u32>| which == Some(number);
        if now(misdeeds.close_in_point) {
            return Err(Over);
        }
        if now(misdeeds.hang_in_point) {
            self.wait_for_abort()?;
            return Ok(Err((2, 6, "Transaction aborted")));
        }
        if let Some((_, error)) = misdeeds.fail_point.filter(|(which, _)| *which == number) {
            return Ok(Err((3, error, "as asked for")));
        }
        if now(misdeeds.garble_point) {
            self.send(&format!("{tag} # X(1.0\u{7f}), Y(2)"))?;
        }
        // A server that compensates takes the nominal point for one on the surface.
        let lift = if self.setup.compensated {
            self.setup.tip_radius_mm
        } else {
            0.0
        };
        let nominal = DVec3::new(x, y, z) + normal * lift;
        let (from, to) = (
            nominal + normal * self.approach,
            nominal - normal * self.search,
        );
        self.report_way(from)?;
        self.at = from;
        let Some(centre) = self.contact(from, to) else {
            return Ok(Err((2, 1006, "Surface not found")));
        };
        lock(self.truth).touches_mm.push(centre);
        let p = centre - normal * lift;
        let n = normal;
        let mut text = String::new();
        if self.with_normal {
            let _ = write!(text, "IJK({:.5},{:.5},{:.5}), ", n.x, n.y, n.z);
        }
        let _ = write!(text, "X({:.5}), Y({:.5}), Z({:.5})", p.x, p.y, p.z);
        self.send(&format!("{tag} # {text}"))?;
        self.at = centre + normal * self.retract;
        Ok(Ok(()))
    }

    /// Does nothing until an abort comes, or the client goes.
    fn wait_for_abort(&mut self) -> Done {
        let mut held = Vec::new();
        let mut chunk = [0; 256];
        while !*lock(self.quit) {
            match self.stream.read(&mut chunk) {
                Ok(0) => return Err(Over),
                Ok(n) => held.extend_from_slice(&chunk[..n]),
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return Err(Over),
            }
            if let Some(end) = held.windows(2).position(|pair| pair == b"\r\n") {
                let line = String::from_utf8_lossy(&held[..end]).into_owned();
                lock(self.truth)
                    .commands
                    .push(line.get(6..).unwrap_or_default().to_owned());
                let tag = line.get(..5).unwrap_or("E0000").to_owned();
                self.send(&format!("{tag} &"))?;
                return self.send(&format!("{tag} %"));
            }
        }
        Err(Over)
    }

    fn scan(&mut self, tag: &str, arguments: &str) -> Result<Result<(), Fault>, Over> {
        let numbers: Vec<f64> = arguments
            .split(',')
            .filter_map(|n| n.trim().parse().ok())
            .collect();
        let &[sx, sy, sz, ex, ey, ez, i, j, k, step] = &numbers[..] else {
            return Ok(Err((3, 502, "Incorrect Arguments")));
        };
        let (start, end) = (DVec3::new(sx, sy, sz), DVec3::new(ex, ey, ez));
        let normal = DVec3::new(i, j, k);
        if step <= 0.0 || normal.length() == 0.0 || (end - start).length() / step > 1e5 {
            return Ok(Err((3, 509, "Bad Argument")));
        }
        let normal = normal.normalize();
        let steps = ((end - start).length() / step).floor() as usize;
        let scene_from_machine = self.setup.machine_from_scene.inverse();
        let mut values = Vec::new();
        for index in 0..=steps {
            let p = start + (end - start).normalize_or_zero() * (index as f64 * step);
            let origin = p + normal * self.approach;
            let ray = Ray::along(
                scene_from_machine.point(origin),
                scene_from_machine.direction(-normal),
            );
            let hit = self.setup.scene.cast(&ray);
            let Some(hit) = hit.filter(|hit| hit.distance <= self.approach + self.search) else {
                return Ok(Err((2, 1006, "Surface not found")));
            };
            let point = (origin - normal * hit.distance).to_array();
            let mut placed = [0.0; 3];
            for (axis, place) in self.setup.scan_order.iter().enumerate() {
                placed[*place] = point[axis];
            }
            if self.with_quality {
                values.push(0.0);
            }
            values.extend(placed);
        }
        let width = if self.with_quality { 4 } else { 3 };
        for line in values.chunks(width * POINTS_A_LINE) {
            let numbers: Vec<String> = line.iter().map(|n| format!("{n:.5}")).collect();
            self.send(&format!("{tag} # {}", numbers.join(",")))?;
        }
        Ok(Ok(()))
    }
}

/// What stands in the parentheses behind a name that is a whole word.
fn inside<'a>(arguments: &'a str, name: &str) -> Option<&'a str> {
    let mut from = 0;
    while let Some(place) = arguments[from..].find(&format!("{name}(")) {
        let at = from + place;
        let before = arguments[..at].chars().next_back();
        if before.is_none_or(|c| c == ' ' || c == ',') {
            let rest = &arguments[at + name.len() + 1..];
            return rest.split(')').next();
        }
        from = at + 1;
    }
    None
}

fn value(arguments: &str, name: &str) -> Option<f64> {
    inside(arguments, name)?.trim().parse().ok()
}

fn triple(arguments: &str, name: &str) -> Option<DVec3> {
    let numbers: Option<Vec<f64>> = inside(arguments, name)?
        .split(',')
        .map(|n| n.trim().parse().ok())
        .collect();
    let numbers: [f64; 3] = numbers?.try_into().ok()?;
    Some(DVec3::from_array(numbers))
}
