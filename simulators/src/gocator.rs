//! An LMI Gocator line profile sensor, played from the manual's chapter "Gocator Protocol" (firmware 4 to 6): control, data and health
//! channels on three listening sockets.
//!
//! Where the manual leaves a choice, this sensor chooses: frames count from 0 at every Start; a second client of the data channel takes
//! the first one's place; health is sent ten times a second; frames that find no data client are dropped.

mod wire;

pub(crate) use wire::{resample, shake};

use std::io;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::carried::Motion;
use crate::sensor::View;
use crate::wire::lock;

/// What the sensor looks at.
#[derive(Debug, Clone)]
pub enum Surface {
    /// A scene.
    View(Box<View>),
    /// A sine across and along, of so many points: cheap, for speed.
    Wave(u32),
    /// A scene, from a tool that something carries; the view's `machine_from_sensor` is where the sensor is on the tool. Needs a rate.
    Carried(Box<View>, Arc<Motion>),
}

/// What a profile message holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Message type 5.
    PointCloud,
    /// Message type 6.
    Uniform,
}

/// What goes wrong. Counts of frames are within a run, from 0.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Misdeeds {
    /// Share of frames that are taken and not sent: their index is missing.
    pub drop: f64,
    /// Share of frames whose profile message says more points than it has.
    pub lie: f64,
    /// Share of frames that are sent twice.
    pub duplicate: f64,
    /// Bytes are sent in pieces of at most so many.
    pub pieces: Option<usize>,
    /// From this frame on the message size is 4 GiB.
    pub bad_size_at: Option<u64>,
    /// In the middle of this frame the data connection is closed.
    pub cut_at: Option<u64>,
    /// From this frame on nothing is sent or answered, and no connection closed.
    pub silent_at: Option<u64>,
    /// At this frame the clock starts again from zero.
    pub clock_back_at: Option<u64>,
    /// Commands are not answered from the start.
    pub mute: bool,
    /// Rubbish instead of replies.
    pub babble: bool,
    /// Start is refused with this status.
    pub refuse_start: Option<i32>,
    /// Triggers dropped per frame that is taken.
    pub trigger_drops: u32,
    /// The encoder reads up to so many counts beside the truth.
    pub encoder_jitter: u32,
    /// Numbers of replies and messages come with the great end first.
    pub swap_bytes: bool,
    /// Replies come so much later.
    pub late: Option<Duration>,
    /// So many replies that nobody asked for come before each one.
    pub stray_replies: u32,
}

/// What the sensor says it is, and how it plays.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Serial number.
    pub serial: u32,
    /// Of everything drawn.
    pub seed: u64,
    /// What is looked at.
    pub surface: Surface,
    /// Points or ranges.
    pub form: Form,
    /// Size of a profile message's attributes: the manual says 32 and 40.
    pub attribute_size: u16,
    /// Intensities beside every profile.
    pub intensity: bool,
    /// Profiles in one message.
    pub batch: u32,
    /// Frames a second; without it as fast as the host takes them.
    pub rate_hz: Option<f64>,
    /// After so many frames the sensor waits: its stage stands still.
    pub frames: u64,
    /// Major version of the protocol.
    pub version: u8,
    /// What goes wrong.
    pub misdeeds: Misdeeds,
}

impl Setup {
    /// A faultless sensor, as fast as it is listened to.
    pub fn new(serial: u32, surface: Surface) -> Setup {
        Setup {
            serial,
            seed: 1,
            surface,
            form: Form::Uniform,
            attribute_size: 40,
            intensity: false,
            batch: 1,
            rate_hz: None,
            frames: u64::MAX,
            version: 1,
            misdeeds: Misdeeds::default(),
        }
    }
}

/// What the sensor does, and did in its last run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    /// Light comes out.
    pub laser_on: bool,
    /// Frames taken in the run: the next index.
    pub taken: u64,
    /// Frames that went out whole and well formed.
    pub sent: Vec<u64>,
    /// Number of frames that went out, however many are in the list (its first million).
    pub sent_count: u64,
    /// Triggers dropped in the run.
    pub trigger_drops: u64,
    /// Health messages sent since the start of the run.
    pub health_sent: u64,
    /// Pings received.
    pub pings: u64,
    /// A host that fell silent was shut out.
    pub shut_out: u64,
}

struct State {
    status: Status,
    running: bool,
    run: u64,
    quit: bool,
    silent: bool,
    data_clients: u64,
    ping_deadline: Option<Instant>,
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

/// A running sensor; dropping it closes its ports.
pub struct SimulatedGocator {
    ports: [SocketAddr; 3],
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl std::fmt::Debug for SimulatedGocator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SimulatedGocator")
            .field("ports", &self.ports)
            .finish_non_exhaustive()
    }
}

impl SimulatedGocator {
    /// Starts a sensor on three free ports of this computer.
    ///
    /// # Errors
    /// When the system gives no port or thread.
    pub fn start(setup: Setup) -> io::Result<SimulatedGocator> {
        SimulatedGocator::start_on(
            [0; 3].map(|port| SocketAddr::from((Ipv4Addr::LOCALHOST, port))),
            setup,
        )
    }

    /// Starts a sensor on these addresses: control, data, health.
    ///
    /// # Errors
    /// When one of them is taken, or the system gives no thread.
    pub fn start_on(addresses: [SocketAddr; 3], setup: Setup) -> io::Result<SimulatedGocator> {
        let listeners = addresses.map(TcpListener::bind);
        let [control, data, health] = listeners;
        let (control, data, health) = (control?, data?, health?);
        let ports = [
            control.local_addr()?,
            data.local_addr()?,
            health.local_addr()?,
        ];
        let shared = Arc::new(Shared {
            state: Mutex::new(State {
                status: Status::default(),
                running: false,
                run: 0,
                quit: false,
                silent: false,
                data_clients: 0,
                ping_deadline: None,
            }),
            changed: Condvar::new(),
        });
        let setup = Arc::new(setup);
        let mut device = SimulatedGocator {
            ports,
            shared,
            threads: Vec::new(),
        };
        device.listen(control, &setup, serve_control)?;
        device.listen(data, &setup, serve_data)?;
        device.listen(health, &setup, serve_health)?;
        Ok(device)
    }

    fn listen(
        &mut self,
        listener: TcpListener,
        setup: &Arc<Setup>,
        serve: fn(TcpStream, &Setup, &Shared),
    ) -> io::Result<()> {
        let (shared, setup) = (Arc::clone(&self.shared), Arc::clone(setup));
        let thread = std::thread::Builder::new()
            .name("gocator-sim".into())
            .spawn(move || {
                let mut clients: Vec<JoinHandle<()>> = Vec::new();
                for stream in listener.incoming() {
                    if lock(&shared.state).quit {
                        break;
                    }
                    let Ok(stream) = stream else { continue };
                    let (shared, setup) = (Arc::clone(&shared), Arc::clone(&setup));
                    clients.retain(|client| !client.is_finished());
                    let client = std::thread::Builder::new()
                        .name("gocator-client".into())
                        .spawn(move || serve(stream, &setup, &shared));
                    clients.extend(client);
                }
                for client in clients {
                    let _ = client.join();
                }
            })?;
        self.threads.push(thread);
        Ok(())
    }

    /// Keys of a configuration that lead to it: control, data and health ports.
    pub fn keys(&self) -> String {
        let [control, data, health] = self.ports;
        format!(
            "address = \"{control}\"\ndata_port = {}\nhealth_port = {}",
            data.port(),
            health.port()
        )
    }

    /// Where the control channel listens.
    pub fn address(&self) -> SocketAddr {
        self.ports[0]
    }

    /// What it does now.
    pub fn status(&self) -> Status {
        lock(&self.shared.state).status.clone()
    }

    /// Waits until the status is as wanted; false when `patience` is over before.
    pub fn wait_until(&self, patience: Duration, wanted: impl Fn(&Status) -> bool) -> bool {
        let until = Instant::now() + patience;
        let mut state = lock(&self.shared.state);
        while !wanted(&state.status) {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            let waited = self.shared.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(|e| e.into_inner()).0;
        }
        true
    }
}

impl Drop for SimulatedGocator {
    fn drop(&mut self) {
        lock(&self.shared.state).quit = true;
        self.shared.changed.notify_all();
        for port in self.ports {
            // Wakes the listener, which then sees that it is over.
            let _ = TcpStream::connect(port);
        }
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn update<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        let answer = change(&mut lock(&self.state));
        self.changed.notify_all();
        answer
    }

    fn quit(&self) -> bool {
        lock(&self.state).quit
    }
}

/// How long a blocked socket waits before it looks whether all is over.
const LOOK: Duration = Duration::from_millis(20);

// ---- Control channel --------------------------------------------------------------------------------------------------

fn serve_control(stream: TcpStream, setup: &Setup, shared: &Shared) {
    let _ = stream.set_nodelay(true);
    let _ = stream.set_read_timeout(Some(LOOK));
    // What the host of another connection had promised binds this one to nothing.
    shared.update(|state| state.ping_deadline = None);
    let mut held = Vec::new();
    loop {
        match wire::receive(&stream, &mut held) {
            wire::Received::Gone => return,
            wire::Received::Nothing | wire::Received::Bytes => {}
        }
        let overdue = |state: &State| state.ping_deadline.is_some_and(|at| Instant::now() > at);
        let over = shared.update(|state| {
            if state.quit {
                return true;
            }
            let overdue = overdue(state) && !state.silent;
            if overdue {
                // "The sensor closes the connection if no further ping arrives in time."
                state.ping_deadline = None;
                state.status.shut_out += 1;
            }
            overdue
        });
        if over {
            return;
        }
        while let Some((id, payload)) = wire::command(&mut held) {
            if setup.misdeeds.mute || lock(&shared.state).silent {
                continue;
            }
            let reply = match setup.misdeeds.babble {
                true => b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec(),
                false => answer(id, &payload, setup, shared),
            };
            let reply = wire::spoilt(reply, &setup.misdeeds);
            if let Some(late) = setup.misdeeds.late {
                let due = Instant::now() + late;
                let mut state = lock(&shared.state);
                while !state.quit && Instant::now() < due {
                    let left = due.saturating_duration_since(Instant::now());
                    let waited = shared.changed.wait_timeout(state, left);
                    state = waited.unwrap_or_else(|e| e.into_inner()).0;
                }
            }
            if wire::send(&stream, &reply, None, || shared.quit()).is_err() {
                return;
            }
        }
    }
}

fn answer(id: u16, payload: &[u8], setup: &Setup, shared: &Shared) -> Vec<u8> {
    match id {
        0x4511 => wire::reply(id, 1, &[setup.version, 0]),
        0x4002 => wire::reply(
            id,
            1,
            &wire::system_info(setup.serial, lock(&shared.state).running),
        ),
        0x100D => {
            if let Some(status) = setup.misdeeds.refuse_start {
                return wire::reply(id, status, &[]);
            }
            let status = shared.update(|state| {
                if state.running {
                    return -1000;
                }
                state.running = true;
                state.run += 1;
                state.status = Status {
                    laser_on: true,
                    pings: state.status.pings,
                    shut_out: state.status.shut_out,
                    ..Status::default()
                };
                1
            });
            wire::reply(id, status, &[])
        }
        0x1001 => {
            shared.update(|state| {
                state.running = false;
                state.status.laser_on = false;
            });
            wire::reply(id, 1, &[])
        }
        0x100E => {
            let timeout_us = payload.try_into().map_or(0, u64::from_le_bytes);
            shared.update(|state| {
                state.status.pings += 1;
                state.ping_deadline =
                    (timeout_us > 0).then(|| Instant::now() + Duration::from_micros(timeout_us));
            });
            wire::reply(id, 1, &[])
        }
        _ => wire::reply(id, -998, &[]),
    }
}

// ---- Data channel -----------------------------------------------------------------------------------------------------

fn serve_data(stream: TcpStream, setup: &Setup, shared: &Shared) {
    let _ = stream.set_nodelay(true);
    let _ = stream.set_write_timeout(Some(LOOK));
    let me = shared.update(|state| {
        state.data_clients += 1;
        state.data_clients
    });
    let replaced = || {
        let state = lock(&shared.state);
        state.quit || state.data_clients != me
    };
    let mut camera = wire::Camera::new(setup);
    let mut run = 0;
    loop {
        let mut state = lock(&shared.state);
        while !(state.quit
            || state.data_clients != me
            || state.running && state.status.taken < setup.frames)
            || state.silent
        {
            if state.quit || wire::closed(&stream) {
                return;
            }
            state = shared
                .changed
                .wait_timeout(state, LOOK)
                .unwrap_or_else(|e| e.into_inner())
                .0;
        }
        if state.quit || state.data_clients != me {
            return;
        }
        if state.run != run {
            run = state.run;
            camera.begin(setup, run);
        }
        let batch = u64::from(setup.batch).min(setup.frames - state.status.taken);
        let first = state.status.taken;
        state.status.taken += batch;
        state.status.trigger_drops += batch * u64::from(setup.misdeeds.trigger_drops);
        if setup
            .misdeeds
            .silent_at
            .is_some_and(|at| first + batch > at)
        {
            state.silent = true;
            continue;
        }
        drop(state);
        let shot = camera.shoot(setup, first, batch);
        let sent = wire::send(&stream, &shot.bytes, setup.misdeeds.pieces, replaced);
        if sent.is_err() || shot.cut {
            return;
        }
        shared.update(|state| {
            state.status.sent_count += shot.whole.len() as u64;
            if state.status.sent.len() < 1_000_000 {
                state.status.sent.extend(&shot.whole);
            }
        });
        camera.pace(setup, first + batch, || {
            let state = lock(&shared.state);
            state.quit || !state.running
        });
    }
}

// ---- Health channel ---------------------------------------------------------------------------------------------------

fn serve_health(stream: TcpStream, setup: &Setup, shared: &Shared) {
    const EVERY: Duration = Duration::from_millis(100);
    let _ = stream.set_write_timeout(Some(LOOK));
    let mut next = Instant::now();
    loop {
        let mut state = lock(&shared.state);
        while !state.quit && Instant::now() < next {
            let left = next.saturating_duration_since(Instant::now());
            let waited = shared.changed.wait_timeout(state, left.min(LOOK));
            state = waited.unwrap_or_else(|e| e.into_inner()).0;
        }
        if state.quit || wire::closed(&stream) {
            return;
        }
        next += EVERY;
        if state.silent || setup.misdeeds.mute {
            continue;
        }
        let drops = state.status.trigger_drops as i64;
        let running = state.running;
        drop(state);
        let message = wire::health(&[
            (1003, 0, 0),
            (20_000, 0, i64::from(running)),
            (21_010, 0, drops),
        ]);
        if wire::send(&stream, &message, setup.misdeeds.pieces, || shared.quit()).is_err() {
            return;
        }
        shared.update(|state| state.status.health_sent += 1);
    }
}
