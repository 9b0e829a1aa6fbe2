//! A cell with its daemon and its page, on a free port, and a client.

use std::fs;
use std::io::Read;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use acies::cell::{Daemon, DaemonOptions, Handle};
use acies::config::{Cell, Service};
use acies::store::{Phase, Role, SessionKind, Store};
use acies::web;
use acies_drivers::link::cable::Cable;
use acies_simulators::demo_cell::{DemoCell, DemoOptions};
use serde_json::{Value, json};
use tokio::sync::oneshot;

use super::sockets::{self, Devices};

const FILES: [&str; 3] = ["cell.toml", "recipe.toml", "part.step"];

/// Longer than anything here takes, also on a machine with ten times as much to do as it has cores.
pub const LONG: Duration = Duration::from_secs(300);

/// A cell that is served until it is dropped.
pub struct Served {
    pub address: SocketAddr,
    pub folder: PathBuf,
    pub store: Arc<Store>,
    service: Service,
    running: Option<Running>,
    _devices: Option<Devices>,
}

struct Running {
    daemon: Daemon,
    stop: oneshot::Sender<()>,
    thread: JoinHandle<std::io::Result<()>>,
}

/// What came back.
#[derive(Debug)]
pub struct Answer {
    pub status: u16,
    pub headers: Vec<(String, String)>,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn header(&self, name: &str) -> &str {
        let found = self.headers.iter().find(|(key, _)| key == name);
        found.map_or("", |(_, value)| value)
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body)
            .unwrap_or_else(|error| panic!("{error}: {} {}", self.status, self.text()))
    }

    /// A problem as RFC 9457 wants it, of this kind.
    pub fn problem(&self, status: u16, kind: &str) -> Value {
        assert_eq!(self.status, status, "{}", self.text());
        assert_eq!(self.header("content-type"), "application/problem+json");
        let problem = self.json();
        assert_eq!(problem["status"], status);
        assert_eq!(problem["type"], format!("urn:acies:problem:{kind}"));
        for key in ["title", "detail", "what_to_do"] {
            let text = problem[key].as_str().unwrap_or_default();
            assert!(!text.is_empty(), "{key} is missing in {problem}");
        }
        problem
    }
}

/// A new, empty folder.
fn folder(name: &str) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("web")
        .join(format!("{name}-{number}"));
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(folder.join("dev")).expect("a folder for the test");
    folder
}

impl Served {
    /// The demo's cell with its simulated devices, which scan in real time.
    pub fn with_devices(name: &str) -> Self {
        Self::start(name, true, |_| ())
    }

    /// The demo's cell while none of its devices is there.
    pub fn without_devices(name: &str, change: impl FnOnce(&mut Service)) -> Self {
        Self::start(name, false, change)
    }

    fn start(name: &str, devices: bool, change: impl FnOnce(&mut Service)) -> Self {
        let folder = folder(name);
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/demo");
        for file in FILES {
            let text = fs::read_to_string(configs.join(file)).expect("the demo's files");
            // Fewer profiles than the demo takes: the page is tested here, not the measurement.
            let text = text
                .replace("encoder_step = 200", "encoder_step = 400")
                .replace("end_count = 47200", "end_count = 46800");
            fs::write(folder.join(file), text).expect("a copy of them");
        }
        let playing = devices.then(|| play(&folder));
        let mut service = read(&folder).service;
        service.simulated = true;
        change(&mut service);
        let store = Arc::new(Store::open(&service.store).expect("a store"));
        let mut served = Self {
            address: SocketAddr::from(([127, 0, 0, 1], 0)),
            folder,
            store,
            service,
            running: None,
            _devices: playing,
        };
        served.run();
        served
    }

    /// Starts the daemon and its page, on the same port as before where there was one.
    pub fn run(&mut self) {
        let listener = TcpListener::bind(self.address).expect("a free port");
        self.address = listener.local_addr().expect("it is bound");
        listener
            .set_nonblocking(true)
            .expect("sockets can be set so");
        let options = DaemonOptions {
            queue_limit: self.service.queue_limit,
            retention: self.service.retention,
            simulated: true,
        };
        let cell = Arc::new(read(&self.folder));
        let daemon = Daemon::start(cell, self.store.clone(), Arc::new(Cable), options)
            .expect("the daemon starts");
        let (stop, stopped) = oneshot::channel::<()>();
        let (handle, service) = (daemon.handle(), self.service.clone());
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread()
                .worker_threads(2)
                .enable_all()
                .build()?;
            runtime.block_on(async move {
                let listener = tokio::net::TcpListener::from_std(listener)?;
                web::serve_cell(listener, handle, service, async { drop(stopped.await) }).await
            })
        });
        self.running = Some(Running {
            daemon,
            stop,
            thread,
        });
    }

    /// Ends the page and the daemon.
    pub fn stop(&mut self) {
        let Some(running) = self.running.take() else {
            return;
        };
        // The server may have failed already; the join says so.
        let _ = running.stop.send(());
        let ended = running.thread.join().expect("the server does not panic");
        ended.expect("the server ends well");
        drop(running.daemon);
    }

    pub fn handle(&self) -> Handle {
        self.running.as_ref().expect("it runs").daemon.handle()
    }

    /// A token with the rights of a new person of this role.
    pub fn token(&self, role: Role) -> String {
        let now = SystemTime::now();
        let name = format!("{}-person", role.word());
        let token = format!("token-of-{name}");
        if self.store.add_person(&name, role, "no hash", now).is_ok() {
            self.store
                .add_session(&token, &name, SessionKind::Token, "test", now, LONG)
                .expect("a token");
        }
        token
    }

    pub fn get(&self, path: &str) -> Answer {
        self.ask("GET", path, None, &[])
    }

    pub fn post(&self, path: &str, body: &Value) -> Answer {
        self.ask("POST", path, Some(body), &[])
    }

    pub fn ask(
        &self,
        method: &str,
        path: &str,
        body: Option<&Value>,
        headers: &[(&str, &str)],
    ) -> Answer {
        let mut response = self.open(method, path, body, headers);
        let status = response.status().as_u16();
        let headers = response
            .headers()
            .iter()
            .map(|(name, value)| {
                let value = value.to_str().expect("headers are text").to_owned();
                (name.as_str().to_owned(), value)
            })
            .collect();
        let mut body = Vec::new();
        let mut reader = response.body_mut().as_reader();
        reader.read_to_end(&mut body).expect("a whole body");
        Answer {
            status,
            headers,
            body,
        }
    }

    /// The answer before its body is read.
    pub fn open(
        &self,
        method: &str,
        path: &str,
        body: Option<&Value>,
        headers: &[(&str, &str)],
    ) -> ureq::http::Response<ureq::Body> {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(LONG))
            .max_redirects(0)
            .build()
            .into();
        let mut request = ureq::http::Request::builder()
            .method(method)
            .uri(format!("http://{}{path}", self.address));
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let asked = match body {
            Some(body) => {
                let request = request.header("content-type", "application/json");
                agent.run(request.body(body.to_string()).expect("a request"))
            }
            None => agent.run(request.body(()).expect("a request")),
        };
        asked.unwrap_or_else(|error| panic!("{method} {path}: {error}"))
    }

    /// Waits until the cell is as `wanted`.
    pub fn wait(&self, what: &str, wanted: impl FnMut(&Arc<acies::cell::Snapshot>) -> bool) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .expect("a runtime");
        let mut follow = self.handle().follow();
        let waited = runtime.block_on(async {
            tokio::time::timeout(LONG, follow.wait_for(wanted))
                .await
                .map(|found| found.is_ok())
        });
        assert_eq!(
            waited,
            Ok(true),
            "{what} did not come: {:?}",
            self.handle().snapshot()
        );
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.stop();
        }
    }
}

fn read(folder: &Path) -> Cell {
    Cell::read(&folder.join("cell.toml")).expect("the demo's configuration has no mistakes")
}

/// One cell for all tests that look at a part that was measured; its first inspection is done.
pub fn measured() -> &'static Served {
    static MEASURED: OnceLock<Served> = OnceLock::new();
    MEASURED.get_or_init(|| {
        // On a machine that is far too busy a simulated device may answer too late, and is then rightly taken for lost.
        for _ in 0..3 {
            let cell = Served::with_devices("measured");
            cell.wait("ready", |snapshot| snapshot.accepts);
            let started = cell.ask(
                "POST",
                "/api/v1/inspections",
                Some(&json!({"part_serial": "SN-1", "order_number": "PO-7"})),
                &[("idempotency-key", "first")],
            );
            assert_eq!(started.status, 201, "{}", started.text());
            assert_eq!(started.header("location"), "/api/v1/inspections/1");
            let mut phase = None;
            cell.wait("an end", |snapshot| {
                phase = snapshot.last.as_ref().map(|last| last.phase);
                phase.is_some()
            });
            if phase == Some(Phase::Done) {
                return cell;
            }
        }
        panic!("three times a device was lost");
    })
}

/// Plays the devices: the profilers in real time, so that there is something to watch.
fn play(folder: &Path) -> Devices {
    let demo = DemoCell::with_options(DemoOptions {
        paced: true,
        ..DemoOptions::new(1)
    });
    sockets::play(demo, folder)
}
