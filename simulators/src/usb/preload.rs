//! A simulated device for an unmodified program that uses libusb: a folder that looks like /sys and /dev, and a server for the ioctl protocol of
//! umockdev's preload library (Debian package `umockdev`), which shows that folder to a program in place of the real ones.
//!
//! The protocol is private to umockdev; numbers were read off version 0.17. Nothing is linked: start the program with [`Carrier::environment`]. A program
//! whose simulator goes away first is aborted by the library, so end the program first.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::symlink;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;

use super::{Model, Outcome, Socket, TICK};
use crate::wire::lock;

/// The library.
pub const LIBRARY: &str = "libumockdev-preload.so.0";

/// The library's path where it is installed.
pub fn library() -> Option<PathBuf> {
    let folders = [
        "/usr/lib/x86_64-linux-gnu",
        "/usr/lib/aarch64-linux-gnu",
        "/usr/lib64",
        "/usr/lib",
        "/usr/local/lib",
    ];
    let paths = folders.iter().map(|folder| Path::new(folder).join(LIBRARY));
    paths.into_iter().find(|path| path.exists())
}

/// Numbers of Linux.
mod errno {
    pub const NOENT: i32 = 2;
    pub const AGAIN: i32 = 11;
    pub const NOMEM: i32 = 12;
    pub const NODEV: i32 = 19;
    pub const INVAL: i32 = 22;
    pub const NOTTY: i32 = 25;
    pub const PIPE: i32 = 32;
    pub const NODATA: i32 = 61;
    pub const OVERFLOW: i32 = 75;
    pub const SHUTDOWN: i32 = 108;
}

/// Of <linux/usbdevice_fs.h>, 64 bits: direction, number, size of the argument.
const fn ioctl(direction: u64, number: u64, size: u64) -> u64 {
    direction << 30 | size << 16 | 0x55 << 8 | number
}

const SUBMIT: u64 = ioctl(2, 10, 56);
const DISCARD: u64 = ioctl(0, 11, 0);
const REAP: u64 = ioctl(1, 12, 8);
const REAP_NO_DELAY: u64 = ioctl(1, 13, 8);
const CAPABILITIES: u64 = ioctl(2, 26, 4);
const CLEAR_HALT: u64 = ioctl(2, 21, 4);
const GET_DRIVER: u64 = ioctl(1, 8, 260);
/// To the kernel's driver of an interface: there is none.
const TO_DRIVER: u64 = ioctl(3, 18, 16);
/// CLAIMINTERFACE, RELEASEINTERFACE, SETCONFIGURATION, SETINTERFACE, RESETEP, RESET: done without anything to do.
const DONE: [u64; 6] = [
    ioctl(2, 15, 4),
    ioctl(2, 16, 4),
    ioctl(2, 5, 4),
    ioctl(2, 4, 8),
    ioctl(2, 3, 4),
    ioctl(0, 20, 0),
];
/// Zero packets, no limit of size, scatter and gather, reaping after it went: libusb makes one URB of a transfer.
const ABILITIES: u32 = 0x1D;

/// A transfer of the host that waits.
struct Urb {
    /// Whose it is: addresses are those of one handle.
    client: u64,
    address: u64,
    endpoint: u8,
    control: bool,
    buffer: u64,
    length: usize,
}

/// One that is over.
struct Reaped {
    urb: Urb,
    status: i32,
    actual: i32,
    data: Vec<u8>,
}

#[derive(Default)]
struct Queue {
    /// Most bytes of all transfers that wait, where the system has a limit.
    memory: Option<usize>,
    waiting: VecDeque<Urb>,
    over: VecDeque<Reaped>,
    /// The node says that something is to be reaped.
    armed: bool,
    quit: bool,
}

struct Shared<M> {
    socket: Socket<M>,
    queue: Mutex<Queue>,
    changed: Condvar,
    /// Poll for writing on the node answers whether a URB can be reaped: a pipe of one page that holds a byte is not writable.
    node: OwnedFd,
    folder: PathBuf,
}

/// A device in a folder.
pub struct Carrier<M: Model + 'static> {
    shared: Arc<Shared<M>>,
    server: PathBuf,
    threads: Vec<JoinHandle<()>>,
}

/// Where the device is on the bus.
const PORT: &str = "1-1";
const SYSTEM_PATH: &str = "/devices/pci0000:00/0000:00:14.0/usb1/1-1";

impl<M: Model + 'static> std::fmt::Debug for Carrier<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Carrier")
            .field("folder", &self.shared.folder)
            .finish_non_exhaustive()
    }
}

impl<M: Model + 'static> Carrier<M> {
    /// Shows the device of a socket in a folder, which must be empty.
    ///
    /// # Errors
    /// When files, pipe or socket cannot be made.
    pub fn start(folder: &Path, socket: Socket<M>) -> io::Result<Carrier<M>> {
        use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat, open};
        let node = folder.join("dev/bus/usb/001/002");
        std::fs::create_dir_all(folder.join("dev/bus/usb/001"))?;
        std::fs::create_dir_all(folder.join("dev/.node"))?;
        std::fs::create_dir_all(folder.join("ioctl/dev/bus/usb/001"))?;
        mknodat(CWD, &node, FileType::Fifo, Mode::from_raw_mode(0o666), 0)?;
        let pipe = open(
            &node,
            OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC,
            Mode::empty(),
        )?;
        rustix::pipe::fcntl_setpipe_size(&pipe, 4096)?;
        rustix::io::write(&pipe, &[0])?;
        symlink("189:1", folder.join("dev/.node/bus_usb_001_002"))?;
        let server = folder.join("ioctl/dev/bus/usb/001/002");
        let listener = UnixListener::bind(&server)?;
        let shared = Arc::new(Shared {
            socket,
            queue: Mutex::new(Queue::default()),
            changed: Condvar::new(),
            node: pipe,
            folder: folder.to_owned(),
        });
        shared.write_tree()?;
        let mut carrier = Carrier {
            shared,
            server,
            threads: Vec::new(),
        };
        let shared = Arc::clone(&carrier.shared);
        carrier.spawn(move || {
            for (id, client) in (0..).zip(listener.incoming()) {
                if lock(&shared.queue).quit {
                    return;
                }
                let Ok(stream) = client else { continue };
                let shared = Arc::clone(&shared);
                std::thread::spawn(move || {
                    let _ = Client { stream, id }.serve(&shared);
                    shared.closed(id);
                });
            }
        })?;
        let shared = Arc::clone(&carrier.shared);
        carrier.spawn(move || shared.tick())?;
        Ok(carrier)
    }

    fn spawn(&mut self, run: impl FnOnce() + Send + 'static) -> io::Result<()> {
        let thread = std::thread::Builder::new()
            .name("usb-sim".into())
            .spawn(run)?;
        self.threads.push(thread);
        Ok(())
    }

    /// Variables of the program that is to see the device.
    pub fn environment(&self) -> [(&'static str, String); 2] {
        let library = library().unwrap_or_else(|| LIBRARY.into());
        [
            ("LD_PRELOAD", library.display().to_string()),
            ("UMOCKDEV_DIR", self.shared.folder.display().to_string()),
        ]
    }

    /// Lets transfers of at most so many bytes wait in all, as the kernel does (16 MiB where nobody has changed it).
    pub fn limit_memory(&self, bytes: usize) {
        lock(&self.shared.queue).memory = Some(bytes);
    }

    /// Offers what waits to the device at once, as the host controller would; otherwise that happens every millisecond.
    pub fn offer(&self) {
        self.shared.offer(&mut lock(&self.shared.queue));
    }

    /// Pulls the device out: what waits ends, and the device leaves the tree.
    pub fn unplug(&self) {
        self.shared.socket.unplug();
        let mut queue = lock(&self.shared.queue);
        while let Some(urb) = queue.waiting.pop_front() {
            queue.over.push_back(Reaped {
                urb,
                status: -errno::SHUTDOWN,
                actual: 0,
                data: Vec::new(),
            });
        }
        self.shared.arm(&mut queue);
        drop(queue);
        let folder = &self.shared.folder;
        let _ = std::fs::remove_file(folder.join("sys/bus/usb/devices").join(PORT));
        let _ = std::fs::remove_dir_all(folder.join("sys").join(&SYSTEM_PATH[1..]));
    }

    /// Puts it back in.
    ///
    /// # Errors
    /// When the tree cannot be written.
    pub fn replug(&self) -> io::Result<()> {
        let mut queue = lock(&self.shared.queue);
        queue.over.clear();
        self.shared.socket.replug();
        self.shared.arm(&mut queue);
        drop(queue);
        self.shared.write_tree()
    }
}

impl<M: Model + 'static> Drop for Carrier<M> {
    fn drop(&mut self) {
        lock(&self.shared.queue).quit = true;
        self.shared.changed.notify_all();
        let _ = UnixStream::connect(&self.server);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl<M: Model + 'static> Shared<M> {
    /// The device as the kernel would show it.
    fn write_tree(&self) -> io::Result<()> {
        let (device, configuration, strings) = {
            let plugged = self.socket.lock();
            let model = &plugged.model;
            (
                model.device_descriptor(),
                model.configuration_descriptor(),
                model.strings(),
            )
        };
        let folder = self.folder.join("sys").join(&SYSTEM_PATH[1..]);
        std::fs::create_dir_all(&folder)?;
        for more in ["bus/usb/devices", "dev/char", "class"] {
            std::fs::create_dir_all(self.folder.join("sys").join(more))?;
        }
        let hex = |at: usize| format!("{:02x}{:02x}\n", device[at + 1], device[at]);
        let mut files = vec![
            ("busnum", "1\n".to_owned()),
            ("devnum", "2\n".to_owned()),
            ("devpath", "1\n".to_owned()),
            ("dev", "189:1\n".to_owned()),
            ("speed", "5000\n".to_owned()),
            ("bConfigurationValue", format!("{}\n", configuration[5])),
            ("idVendor", hex(8)),
            ("idProduct", hex(10)),
            ("bcdDevice", hex(12)),
            ("bNumConfigurations", "1\n".to_owned()),
            ("bNumInterfaces", format!(" {}\n", configuration[4])),
            ("bDeviceClass", format!("{:02x}\n", device[4])),
            (
                "uevent",
                "MAJOR=189\nMINOR=1\nDEVNAME=bus/usb/001/002\nDEVTYPE=usb_device\nDRIVER=usb\nBUSNUM=001\nDEVNUM=002\n".to_owned(),
            ),
        ];
        for (name, text) in ["manufacturer", "product", "serial"]
            .into_iter()
            .zip(strings)
        {
            files.push((name, format!("{text}\n")));
        }
        for (name, text) in files {
            std::fs::write(folder.join(name), text)?;
        }
        std::fs::write(folder.join("descriptors"), [device, configuration].concat())?;
        let link = |to: &str, at: PathBuf| match symlink(to, at) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
            _ => Ok(()),
        };
        link("../../../../../bus/usb", folder.join("subsystem"))?;
        let devices = self.folder.join("sys/bus/usb/devices").join(PORT);
        link(&format!("../../..{SYSTEM_PATH}"), devices)?;
        link(
            &format!("../..{SYSTEM_PATH}"),
            self.folder.join("sys/dev/char/189:1"),
        )
    }

    /// Makes the node writable where something can be reaped, and only then.
    fn arm(&self, queue: &mut Queue) {
        let wanted = !queue.over.is_empty() || !self.socket.present();
        if wanted && !queue.armed {
            let _ = rustix::io::read(&self.node, &mut [0; 1][..]);
        } else if !wanted && queue.armed {
            let _ = rustix::io::write(&self.node, &[0]);
        }
        queue.armed = wanted;
    }

    /// Offers what waits to the device, the first of each endpoint first.
    fn offer(&self, queue: &mut Queue) {
        let mut blocked = Vec::new();
        let mut at = 0;
        while at < queue.waiting.len() {
            let urb = &queue.waiting[at];
            if blocked.contains(&urb.endpoint) {
                at += 1;
                continue;
            }
            match self.socket.lock().input(urb.endpoint, urb.length) {
                Outcome::Nak => {
                    blocked.push(urb.endpoint);
                    at += 1;
                }
                outcome => {
                    let urb = queue.waiting.remove(at);
                    queue.over.extend(urb.map(|urb| finish(urb, outcome)));
                }
            }
        }
        self.arm(queue);
    }

    fn tick(&self) {
        let mut queue = lock(&self.queue);
        while !queue.quit {
            if self.socket.present() && !queue.waiting.is_empty() {
                self.offer(&mut queue);
            }
            queue = if queue.waiting.is_empty() {
                self.changed.wait(queue).unwrap_or_else(|e| e.into_inner())
            } else {
                let waited = self.changed.wait_timeout(queue, TICK);
                waited.unwrap_or_else(|e| e.into_inner()).0
            };
        }
    }

    /// The kernel ends the transfers of a handle that closes.
    fn closed(&self, client: u64) {
        let mut queue = lock(&self.queue);
        queue.waiting.retain(|urb| urb.client != client);
        queue.over.retain(|reaped| reaped.urb.client != client);
        self.arm(&mut queue);
        drop(queue);
        self.socket.close();
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        lock(&self.queue)
    }
}

fn finish(urb: Urb, outcome: Outcome) -> Reaped {
    let head = if urb.control { 8 } else { 0 };
    let (status, data, actual) = match outcome {
        Outcome::Data(mut data) => {
            let room = urb.length.saturating_sub(head);
            let status = if data.len() > room {
                -errno::OVERFLOW
            } else {
                0
            };
            data.truncate(room);
            let n = data.len();
            (status, data, n)
        }
        Outcome::Accepted(n) => (0, Vec::new(), n),
        Outcome::Stall | Outcome::Nak => (-errno::PIPE, Vec::new(), 0),
    };
    Reaped {
        urb,
        status,
        actual: actual as i32,
        data,
    }
}

/// One program that has the device open.
struct Client {
    stream: UnixStream,
    id: u64,
}

impl Client {
    fn send(&mut self, words: [u64; 3], tail: &[u8]) -> io::Result<()> {
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_ne_bytes()).collect();
        bytes.extend_from_slice(tail);
        self.stream.write_all(&bytes)
    }

    fn read_memory(&mut self, address: u64, length: usize) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; length];
        if length > 0 {
            self.send([5, address, length as u64], &[])?;
            self.stream.read_exact(&mut bytes)?;
        }
        Ok(bytes)
    }

    fn write_memory(&mut self, address: u64, bytes: &[u8]) -> io::Result<()> {
        if bytes.is_empty() {
            return Ok(());
        }
        self.send([6, address, bytes.len() as u64], bytes)
    }

    fn done(&mut self, result: i64, errno: i32) -> io::Result<()> {
        self.send([3, result as u64, errno as u64], &[])
    }

    fn serve<M: Model + 'static>(mut self, shared: &Shared<M>) -> io::Result<()> {
        loop {
            let mut head = [0; 24];
            self.stream.read_exact(&mut head)?;
            let word = |at: usize| {
                let eight = head[8 * at..8 * at + 8].try_into();
                eight.map_or(0, u64::from_ne_bytes)
            };
            let (kind, request, argument) = (word(0), word(1), word(2));
            if kind != 1 {
                self.done(-1, errno::INVAL)?;
            } else if request == REAP || request == REAP_NO_DELAY {
                self.reap(shared, argument)?;
            } else if !shared.socket.present() {
                self.done(-1, errno::NODEV)?;
            } else if request == SUBMIT {
                self.submit(shared, argument)?;
            } else if request == DISCARD {
                self.discard(shared, argument)?;
            } else if request == CAPABILITIES {
                self.write_memory(argument, &ABILITIES.to_ne_bytes())?;
                self.done(0, 0)?;
            } else if request == CLEAR_HALT {
                let endpoint = self.read_memory(argument, 4)?;
                shared.socket.clear_halt(endpoint[0]);
                self.done(0, 0)?;
            } else if DONE.contains(&request) {
                self.done(0, 0)?;
            } else if request == GET_DRIVER || request == TO_DRIVER {
                self.done(-1, errno::NODATA)?;
            } else {
                self.done(-1, errno::NOTTY)?;
            }
        }
    }

    fn submit<M: Model + 'static>(&mut self, shared: &Shared<M>, address: u64) -> io::Result<()> {
        let raw = self.read_memory(address, 56)?;
        let u32_at = |at: usize| raw[at..at + 4].try_into().map_or(0, u32::from_ne_bytes);
        let urb = Urb {
            client: self.id,
            address,
            control: raw[0] == 2,
            endpoint: raw[1],
            buffer: raw[16..24].try_into().map_or(0, u64::from_ne_bytes),
            length: u32_at(24) as usize,
        };
        if !urb.control && urb.endpoint & 0x80 != 0 {
            let mut queue = shared.queue();
            let held: usize = queue.waiting.iter().map(|urb| urb.length).sum();
            let full = |most: usize| held + urb.length > most;
            if queue.memory.is_some_and(full) {
                drop(queue);
                return self.done(-1, errno::NOMEM);
            }
            queue.waiting.push_back(urb);
            shared.offer(&mut queue);
            drop(queue);
            shared.changed.notify_all();
            return self.done(0, 0);
        }
        let data = self.read_memory(urb.buffer, urb.length)?;
        let outcome = if urb.control {
            let (setup, data) = data.split_at(data.len().min(8));
            match setup.try_into() {
                Ok(setup) => shared.socket.lock().control(setup, data),
                Err(_) => Outcome::Stall,
            }
        } else {
            shared.socket.lock().output(urb.endpoint, &data)
        };
        shared.socket.wake();
        let mut queue = shared.queue();
        queue.over.push_back(finish(urb, outcome));
        // What was asked for may be there now.
        shared.offer(&mut queue);
        drop(queue);
        self.done(0, 0)
    }

    fn reap<M: Model + 'static>(&mut self, shared: &Shared<M>, argument: u64) -> io::Result<()> {
        let reaped = {
            let mut queue = shared.queue();
            let place = queue.over.iter().position(|r| r.urb.client == self.id);
            let reaped = place.and_then(|place| queue.over.remove(place));
            shared.arm(&mut queue);
            reaped
        };
        let Some(reaped) = reaped else {
            let gone = !shared.socket.present();
            return self.done(-1, if gone { errno::NODEV } else { errno::AGAIN });
        };
        let head = if reaped.urb.control { 8 } else { 0 };
        self.write_memory(reaped.urb.buffer + head, &reaped.data)?;
        self.write_memory(reaped.urb.address + 4, &reaped.status.to_ne_bytes())?;
        self.write_memory(reaped.urb.address + 28, &reaped.actual.to_ne_bytes())?;
        self.write_memory(argument, &reaped.urb.address.to_ne_bytes())?;
        self.done(0, 0)
    }

    fn discard<M: Model + 'static>(&mut self, shared: &Shared<M>, address: u64) -> io::Result<()> {
        let found = {
            let mut queue = shared.queue();
            let place = queue
                .waiting
                .iter()
                .position(|urb| (urb.client, urb.address) == (self.id, address));
            let urb = place.and_then(|place| queue.waiting.remove(place));
            let found = urb.is_some();
            queue.over.extend(urb.map(|urb| Reaped {
                urb,
                status: -errno::NOENT,
                actual: 0,
                data: Vec::new(),
            }));
            shared.arm(&mut queue);
            found
        };
        match found {
            true => self.done(0, 0),
            false => self.done(-1, errno::INVAL),
        }
    }
}
