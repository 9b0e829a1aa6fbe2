//! Two ways to a simulated device: calls in this process, and libusb in a child that takes orders to the simulator over its standard streams.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use acies_drivers::error::LinkError;
use acies_drivers::link::cable::Cable;
use acies_drivers::link::usb::{
    OneByOne, Request, UsbInterface, UsbLink, UsbStream, UsbTarget, interfaces,
};
use acies_drivers::link::{Link, Links, Target};
use acies_simulators::u3v::{self, Profiler};
use acies_simulators::usb::preload::Carrier;
use acies_simulators::usb::{Model, Passed, Socket};
use acies_simulators::usb_itn::InputTool;

/// Longest wait for something that must happen; long because the machine may be busy.
pub const SOON: Duration = Duration::from_secs(30);

/// A device before it is plugged in.
#[derive(Clone)]
pub enum Device {
    U3v(Box<u3v::Setup>),
    Itn(InputTool),
}

/// What a case is run with.
pub trait Rig {
    /// The way to the device.
    fn links(&self) -> &dyn Links;
    /// Has something done to the device, or asks it.
    fn order(&self, order: &str) -> String;
    /// Whether these links keep several transfers in flight.
    fn overlaps(&self) -> bool;

    /// What the device says of itself, by name.
    fn truth(&self) -> BTreeMap<String, String> {
        let text = self.order("truth");
        let pairs = text.split(' ').filter_map(|pair| pair.split_once('='));
        pairs
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .collect()
    }

    /// A number of the truth.
    fn number(&self, key: &str) -> u64 {
        self.truth()[key].parse().expect("a number")
    }
}

// ---- In this process --------------------------------------------------------------------------------------------------

/// A socket of either device.
#[derive(Clone)]
pub enum Plug {
    U3v(Socket<Profiler>),
    Itn(Socket<InputTool>),
}

impl Plug {
    pub fn new(device: Device) -> Plug {
        match device {
            Device::U3v(setup) => Plug::U3v(Socket::new(Profiler::new(*setup))),
            Device::Itn(tool) => Plug::Itn(Socket::new(tool)),
        }
    }

    fn truth(&self) -> String {
        match self {
            Plug::U3v(socket) => socket.with(|device| {
                let truth = device.truth();
                let sent: Vec<String> = truth.sent.iter().map(u64::to_string).collect();
                format!(
                    "laser={} sent_count={} taken={} discarded={} overrun={} commands={} starts={} sent={}",
                    u8::from(device.laser_on()),
                    truth.sent_count,
                    truth.taken,
                    truth.discarded,
                    truth.overrun.len(),
                    truth.commands,
                    truth.starts,
                    sent.join(",")
                )
            }),
            Plug::Itn(socket) => {
                socket.with(|tool| format!("raw={} asked={}", u8::from(tool.raw), tool.asked))
            }
        }
    }

    pub fn unplug(&self) {
        match self {
            Plug::U3v(socket) => socket.unplug(),
            Plug::Itn(socket) => socket.unplug(),
        }
    }

    pub fn replug(&self) {
        match self {
            Plug::U3v(socket) => socket.replug(),
            Plug::Itn(socket) => socket.replug(),
        }
    }

    /// Has so many blocks exposed, one after the other, and what waits for them answered in between.
    fn trigger(&self, blocks: &str, offer: impl Fn()) {
        let Plug::U3v(socket) = self else { return };
        for _ in 0..blocks.parse().expect("a number") {
            socket.with(Profiler::trigger);
            offer();
        }
    }

    /// Does what needs no carrier; `offer` has it answer what waits at once.
    pub fn carry_out(&self, order: &str, offer: impl Fn()) -> String {
        if let Some(blocks) = order.strip_prefix("trigger ") {
            self.trigger(blocks, offer);
            return String::new();
        }
        match order {
            "truth" => return self.truth(),
            "press" => self.press(),
            "another" => self.change(),
            _ => panic!("no order {order}"),
        }
        String::new()
    }

    /// Makes a gauge another one of its kind.
    fn change(&self) {
        if let Plug::Itn(socket) = self {
            socket.with(|tool| tool.serial = "ANOTHER".into());
        }
    }

    fn press(&self) {
        if let Plug::Itn(socket) = self {
            socket.with(InputTool::press);
        }
    }
}

/// The device, called.
pub struct InProcess {
    links: SocketLinks,
}

struct SocketLinks(Plug);

impl InProcess {
    pub fn new(device: Device) -> InProcess {
        InProcess {
            links: SocketLinks(Plug::new(device)),
        }
    }
}

impl Rig for InProcess {
    fn links(&self) -> &dyn Links {
        &self.links
    }

    fn order(&self, order: &str) -> String {
        let plug = &self.links.0;
        match order {
            "unplug" => plug.unplug(),
            "replug" => plug.replug(),
            order if order.starts_with("memory") => return "no system".into(),
            order => return plug.carry_out(order, || {}),
        }
        String::new()
    }

    fn overlaps(&self) -> bool {
        false
    }
}

impl Links for SocketLinks {
    fn open(&self, _: &Target) -> Result<Arc<dyn Link>, LinkError> {
        Err(LinkError::NotFound)
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        fn open<M: Model + 'static>(
            socket: &Socket<M>,
            target: &UsbTarget,
        ) -> Result<Arc<dyn UsbLink>, LinkError> {
            let (vendor, product, serial) = socket.names();
            let interfaces = interfaces(&socket.configuration());
            let fits = socket.present()
                && target.id.is_none_or(|id| id == (vendor, product))
                && target
                    .serial
                    .as_ref()
                    .is_none_or(|wanted| *wanted == serial)
                && target
                    .interface
                    .is_none_or(|class| interfaces.iter().any(|i| i.class == class));
            if !fits {
                return Err(LinkError::NotFound);
            }
            Ok(Arc::new(Called {
                socket: socket.clone(),
                interfaces,
            }))
        }
        match &self.0 {
            Plug::U3v(socket) => open(socket, target),
            Plug::Itn(socket) => open(socket, target),
        }
    }
}

/// An open device in this process.
struct Called<M: Model> {
    socket: Socket<M>,
    interfaces: Vec<UsbInterface>,
}

impl<M: Model> Drop for Called<M> {
    fn drop(&mut self) {
        self.socket.close();
    }
}

fn setup(request: Request, length: usize) -> [u8; 8] {
    let [v0, v1] = request.value.to_le_bytes();
    let [i0, i1] = request.index.to_le_bytes();
    let [l0, l1] = (length as u16).to_le_bytes();
    [request.kind, request.request, v0, v1, i0, i1, l0, l1]
}

fn answered(passed: Passed, buffer: &mut [u8]) -> Result<Option<usize>, LinkError> {
    match passed {
        Passed::Bytes(bytes) if bytes.len() > buffer.len() => Err(LinkError::Overflow),
        Passed::Bytes(bytes) => {
            buffer[..bytes.len()].copy_from_slice(&bytes);
            Ok(Some(bytes.len()))
        }
        Passed::Taken(n) => Ok(Some(n)),
        Passed::Stall => Err(LinkError::Stalled),
        Passed::Late => Ok(None),
        Passed::Gone => Err(LinkError::Gone),
    }
}

impl<M: Model> UsbLink for Called<M> {
    fn interfaces(&self) -> &[UsbInterface] {
        &self.interfaces
    }

    fn claim(&self, _: u8) -> Result<(), LinkError> {
        Ok(())
    }

    fn control_in(
        &self,
        request: Request,
        buffer: &mut [u8],
        _: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let passed = self.socket.control(setup(request, buffer.len()), &[]);
        answered(passed, buffer)
    }

    fn control_out(
        &self,
        request: Request,
        bytes: &[u8],
        _: Instant,
    ) -> Result<Option<usize>, LinkError> {
        answered(
            self.socket.control(setup(request, bytes.len()), bytes),
            &mut [],
        )
    }

    fn read(
        &self,
        endpoint: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let passed = self.socket.input(endpoint, buffer.len(), deadline);
        answered(passed, buffer)
    }

    fn write(&self, endpoint: u8, bytes: &[u8], _: Instant) -> Result<Option<usize>, LinkError> {
        answered(self.socket.output(endpoint, bytes), &mut [])
    }

    fn stream(
        &self,
        endpoint: u8,
        _: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        Ok(Box::new(OneByOne::new(self, endpoint, bytes)))
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError> {
        self.socket.clear_halt(endpoint);
        Ok(())
    }
}

// ---- Over libusb ------------------------------------------------------------------------------------------------------

const CASE: &str = "ACIES_USB_CASE";
/// Begins a line with which the child asks for something.
pub const ORDER: &str = "ORDER ";

/// The case and variant that this process is the child of.
pub fn child_of_a_case() -> Option<(String, usize)> {
    let text = std::env::var(CASE).ok()?;
    let (case, variant) = text.split_once(' ')?;
    Some((case.to_owned(), variant.parse().ok()?))
}

/// The child's side: real links, and orders over standard output and input.
pub struct Child {
    lines: RefCell<std::io::Lines<std::io::StdinLock<'static>>>,
}

impl Child {
    pub fn new() -> Child {
        Child {
            lines: RefCell::new(std::io::stdin().lines()),
        }
    }
}

impl Rig for Child {
    fn links(&self) -> &dyn Links {
        &Cable
    }

    fn order(&self, order: &str) -> String {
        crate::say(&format!("{ORDER}{order}"));
        let line = self.lines.borrow_mut().next();
        line.expect("the simulator").expect("an answer")
    }

    fn overlaps(&self) -> bool {
        true
    }
}

enum AnyCarrier {
    U3v(Carrier<Profiler>),
    Itn(Carrier<InputTool>),
}

/// A folder that goes when it is dropped.
struct Folder(PathBuf);

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The parent's side. The carrier goes before its folder does.
pub struct OverLibusb {
    carrier: AnyCarrier,
    plug: Plug,
    _folder: Folder,
}

impl OverLibusb {
    pub fn new(device: Device) -> OverLibusb {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        // Short: the path of a socket has a hundred characters at most.
        let folder =
            std::env::temp_dir().join(format!("acies-usb-{}-{number}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let plug = Plug::new(device);
        let carrier = match &plug {
            Plug::U3v(socket) => Carrier::start(&folder, socket.clone()).map(AnyCarrier::U3v),
            Plug::Itn(socket) => Carrier::start(&folder, socket.clone()).map(AnyCarrier::Itn),
        };
        OverLibusb {
            carrier: carrier.expect("a carrier"),
            plug,
            _folder: Folder(folder),
        }
    }

    /// Runs a case in a child and serves its orders; true where it passed.
    pub fn run(&self, case: &str, variant: usize) -> bool {
        let environment = match &self.carrier {
            AnyCarrier::U3v(carrier) => carrier.environment(),
            AnyCarrier::Itn(carrier) => carrier.environment(),
        };
        let mut child = Command::new(std::env::current_exe().expect("this program"))
            .envs(environment)
            .env(CASE, format!("{case} {variant}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a child");
        let mut input = child.stdin.take().expect("its input");
        let output = BufReader::new(child.stdout.take().expect("its output"));
        for line in output.lines().map_while(Result::ok) {
            let Some(order) = line.strip_prefix(ORDER) else {
                crate::say(&line);
                continue;
            };
            let answer = self.carry_out(order);
            let _ = writeln!(input, "{answer}");
        }
        child.wait().is_ok_and(|status| status.success())
    }

    fn carry_out(&self, order: &str) -> String {
        match (order, &self.carrier) {
            (order, AnyCarrier::U3v(carrier)) if order.starts_with("memory ") => {
                let bytes = order["memory ".len()..].parse();
                carrier.limit_memory(bytes.expect("a number"));
            }
            ("unplug", AnyCarrier::U3v(carrier)) => carrier.unplug(),
            ("unplug", AnyCarrier::Itn(carrier)) => carrier.unplug(),
            ("replug", AnyCarrier::U3v(carrier)) => carrier.replug().expect("a tree"),
            ("replug", AnyCarrier::Itn(carrier)) => carrier.replug().expect("a tree"),
            (order, AnyCarrier::U3v(carrier)) => {
                return self.plug.carry_out(order, || carrier.offer());
            }
            (order, AnyCarrier::Itn(carrier)) => {
                return self.plug.carry_out(order, || carrier.offer());
            }
        }
        String::new()
    }
}
