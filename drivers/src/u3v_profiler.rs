//! Line profilers that speak USB3 Vision: GenCP over USB bulk, a GenICam file, Coord3D pixels.
//!
//! Manual: USB3 Vision 1.0, GenCP 1.0, PFNC 2.1, SFNC 2.4. Quirks: the leader's own size field is wrong in the field and not used; the byte order of
//! chunk ids and lengths differs between implementations, so that it is a setting. We know no line profiler that is sold with USB3 Vision: this
//! driver was tried against our simulated one only.
//!
//! # Configuration
//!
//! ```toml
//! usb_serial = "SN-1"            # USB serial number; without it and the next, the only device of this kind
//! # usb_id = "1ab2:0001"         # instead: vendor and product number
//! serial_number = "SN-1"         # in the device's own registers: another one is refused
//! features = [                   # GenICam features that are set at opening, in this order
//!     ["PixelFormat", "Coord3D_C16"],
//!     ["ChunkModeActive", true],
//! ]
//! encoder = "ChunkEncoderValue"  # chunk with the encoder; "" for none
//! time = "ChunkTimestamp"        # chunk with the time; without it that of the block
//! encoder_step = 20              # counts from line to line, where blocks have several lines
//! chunk_order = "little"         # byte order of chunk ids and lengths: "little" or "big"
//! first_block = 0                # number of a run's first block; without it the first that comes is the first
//! ```

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::capture::Profile;
use crate::device::{
    Claim, Configured, Driver, Identity, Instrument, Losses, Presence, Profiler, Setup,
    checked_in_a_run, same,
};
use crate::error::{DecodeError, DeviceError, LinkError};
use crate::link::Links;
use crate::link::usb::{UsbLink, UsbTarget};
use crate::settings::{Keys, number};

pub mod block;
pub mod gencp;
pub mod genicam;
mod stream;

use block::{Geometry, Order};
use gencp::Control;
use genicam::{FILE_MAX, Features, Memory, Place, Register};
use stream::{Reading, Shared};

/// The line in [`crate::ALL`].
pub const DRIVER: Driver = Driver {
    name: "u3v-profiler",
    summary: "line profilers with USB3 Vision and Coord3D pixels: USB",
    configure,
};

/// Class, subclass and protocol of the control and the stream interface.
const CONTROL: [u8; 3] = [0xEF, 0x05, 0x00];
const STREAM: [u8; 3] = [0xEF, 0x05, 0x02];
/// Silence after which everything that was under way has come.
const QUIET: Duration = Duration::from_millis(250);
/// Longest time for what is under way when the device is stopped.
const EMPTYING: Duration = Duration::from_secs(10);
/// Most bytes asked for in one transfer of the stream. Linux lets 16 MiB of USB transfers wait in all.
const TRANSFER_MAX: u32 = 4 << 20;
/// Most bytes of a leader or a trailer that a device may ask for.
const ENVELOPE_MAX: u32 = 64 << 10;

// ---- Settings ---------------------------------------------------------------------------------------------------------

/// What a feature is set to.
#[derive(Debug, Clone, PartialEq)]
enum Value {
    Number(f64),
    Word(String),
    Flag(bool),
}

/// A checked table of this driver.
#[derive(Debug, Clone)]
struct Settings {
    target: UsbTarget,
    serial_number: Option<String>,
    features: Vec<(String, Value)>,
    encoder: String,
    time: String,
    encoder_step: Option<i64>,
    order: Order,
    first_block: Option<u64>,
}

const ORDERS: [(&str, Order); 2] = [("little", Order::Little), ("big", Order::Big)];

fn configure(table: toml::Table) -> Configured {
    let mut keys = Keys::new(table);
    let (serial, id) = (keys.text("usb_serial"), keys.usb_id_under("usb_id"));
    let serial_number = keys.text("serial_number");
    let expected = "pairs of a feature and its value, as in [[\"PixelFormat\", \"Coord3D_C16\"]]";
    let features = keys.read("features", expected, |value| {
        value.as_array()?.iter().map(feature).collect()
    });
    let word = |value: &toml::Value| value.as_str().map(str::to_owned);
    let encoder = keys.read("encoder", "a feature's name, or \"\"", word);
    let time = keys.read("time", "a feature's name, or \"\"", word);
    let encoder_step = keys.integer("encoder_step", -i64::from(i32::MAX)..=i64::from(i32::MAX));
    let order = keys.choice("chunk_order", &ORDERS);
    let first_block = keys.integer("first_block", 0..=i64::MAX);
    keys.finish()?;
    Ok(Box::new(Settings {
        target: UsbTarget {
            id,
            serial,
            interface: Some(CONTROL),
        },
        serial_number,
        features: features.unwrap_or_default(),
        encoder: encoder.unwrap_or_else(|| "ChunkEncoderValue".into()),
        time: time.unwrap_or_else(|| "ChunkTimestamp".into()),
        encoder_step,
        order: order.unwrap_or(Order::Little),
        first_block: first_block.map(|block| block as u64),
    }))
}

fn feature(pair: &toml::Value) -> Option<(String, Value)> {
    let [name, value] = &pair.as_array()?[..] else {
        return None;
    };
    let value = match value {
        toml::Value::String(word) => Value::Word(word.clone()),
        toml::Value::Boolean(flag) => Value::Flag(*flag),
        other => Value::Number(number(other)?),
    };
    Some((name.as_str()?.to_owned(), value))
}

impl Setup for Settings {
    fn claims(&self) -> Vec<Claim> {
        vec![self.target.claim()]
    }

    fn open(&self, links: &dyn Links) -> Result<Instrument, DeviceError> {
        let port = self.target.to_string();
        let gone = |source| DeviceError::Link {
            port: port.clone(),
            source,
        };
        let link = links.open_usb(&self.target).map_err(gone)?;
        let of_class = |class| link.interfaces().iter().find(|i| i.class == class);
        let lacks = |capability| DeviceError::Lacks {
            port: port.clone(),
            capability,
            key: "usb_serial",
        };
        let control = of_class(CONTROL).ok_or_else(|| lacks("USB3 Vision control interface"))?;
        let stream = of_class(STREAM).ok_or_else(|| lacks("USB3 Vision stream interface"))?;
        let ends = (
            control.endpoint(2, true),
            control.endpoint(2, false),
            stream.endpoint(2, true),
        );
        let (Some(input), Some(output), Some(blocks)) = ends else {
            return Err(lacks("bulk endpoints of its interfaces"));
        };
        link.claim(control.number).map_err(gone)?;
        link.claim(stream.number).map_err(gone)?;
        let control = Control::new(
            port.clone(),
            Arc::clone(&link),
            input.address,
            output.address,
        );
        let registers = Registers::find(port, control)?;
        let device = self.make_ready(registers, link, blocks.address)?;
        Ok(Instrument::Profiler(Box::new(device)))
    }
}

impl Settings {
    fn make_ready(
        &self,
        mut device: Registers,
        link: Arc<dyn UsbLink>,
        endpoint: u8,
    ) -> Result<U3vProfiler, DeviceError> {
        if let Some(expected) = self
            .serial_number
            .as_ref()
            .filter(|s| **s != device.identity.serial)
        {
            return Err(DeviceError::WrongDevice {
                port: device.port.clone(),
                found: device.identity.serial.clone(),
                expected: expected.clone(),
            });
        }
        // A host before us may have left it streaming; a halt it left is cleared too.
        device.stop()?;
        link.clear_halt(endpoint)
            .map_err(|source| DeviceError::Link {
                port: device.port.clone(),
                source,
            })?;
        drain(&link, endpoint);
        for (name, value) in &self.features {
            device.set(name, value)?;
        }
        let geometry = device.geometry()?;
        let mut chunk = |name: &str, needed: bool| match device.features.contains(name) {
            true => match device.place(name)? {
                Place::Register(register) if register.chunk.is_some() => Ok(Some(register)),
                _ => Err(device.lacks(
                    "chunk of this name",
                    if needed { "encoder" } else { "time" },
                )),
            },
            false => Ok(None),
        };
        let encoder = chunk(&self.encoder, true)?;
        let time = chunk(&self.time, false)?;
        let sizes = device.sizes()?;
        let reading = Reading {
            endpoint,
            geometry,
            order: self.order,
            encoder,
            time,
            encoder_step: self.encoder_step,
            first_block: self.first_block,
            leader_max: sizes.leader,
            trailer_max: sizes.trailer,
            transfer: sizes.transfer,
        };
        U3vProfiler::start_thread(device, link, reading)
    }
}

/// Throws away what an earlier run left.
fn drain(link: &Arc<dyn UsbLink>, endpoint: u8) {
    let mut buffer = vec![0; 1 << 20];
    let last = Instant::now() + EMPTYING;
    let wait = Duration::from_millis(20);
    while Instant::now() < last
        && link
            .read(endpoint, &mut buffer, Instant::now() + wait)
            .is_ok_and(|read| read.is_some())
    {}
}

// ---- Registers --------------------------------------------------------------------------------------------------------

/// Addresses in the technology-agnostic bootstrap registers (ABRM).
mod abrm {
    pub const MANUFACTURER: u64 = 0x0004;
    pub const MODEL: u64 = 0x0044;
    pub const VERSION: u64 = 0x00C4;
    pub const SERIAL: u64 = 0x0144;
    pub const RESPONSE_MS: u64 = 0x01CC;
    pub const MANIFEST: u64 = 0x01D0;
    pub const SBRM: u64 = 0x01D8;
    pub const TEXT: usize = 64;
}

/// Offsets in the stream's registers (SIRM).
mod sirm {
    pub const INFO: u64 = 0x00;
    pub const CONTROL: u64 = 0x04;
    pub const NEEDED_PAYLOAD: u64 = 0x08;
    pub const NEEDED_LEADER: u64 = 0x10;
    pub const NEEDED_TRAILER: u64 = 0x14;
    pub const LEADER: u64 = 0x18;
    pub const PAYLOAD_SIZE: u64 = 0x1C;
    pub const PAYLOAD_COUNT: u64 = 0x20;
    pub const FINAL_1: u64 = 0x24;
    pub const FINAL_2: u64 = 0x28;
    pub const TRAILER: u64 = 0x2C;
}

/// Transfers of the stream, bytes.
struct Sizes {
    leader: usize,
    trailer: usize,
    transfer: usize,
}

/// The device by its registers and features.
struct Registers {
    port: String,
    control: Control,
    identity: Identity,
    features: Features,
    sirm: u64,
}

impl Memory for Registers {
    type Error = DeviceError;

    fn integer(&mut self, register: &Register) -> Result<i64, DeviceError> {
        let bytes = self.control.read(register.address, register.length)?;
        Ok(register.integer(&bytes))
    }
}

impl From<DecodeError> for DeviceError {
    /// The port is filled in by [`Registers::named`].
    fn from(source: DecodeError) -> DeviceError {
        DeviceError::Decode {
            port: String::new(),
            source,
        }
    }
}

impl Registers {
    fn find(port: String, mut control: Control) -> Result<Registers, DeviceError> {
        let mut text = |address| control.read_text(address, 48);
        let _ = text(abrm::MANUFACTURER)?;
        let response_ms = control.read_u32(abrm::RESPONSE_MS)?;
        let sbrm = control.read_u64(abrm::SBRM)?;
        let command_max = control.read_u32(sbrm.wrapping_add(0x14))?;
        let ack_max = control.read_u32(sbrm.wrapping_add(0x18))?;
        let sirm = control.read_u64(sbrm.wrapping_add(0x20))?;
        control.limit(
            Duration::from_millis(response_ms.into()),
            command_max,
            ack_max,
        );
        let mut text = |address| control.read_text(address, abrm::TEXT);
        let identity = Identity {
            vendor: text(abrm::MANUFACTURER)?,
            model: text(abrm::MODEL)?,
            serial: text(abrm::SERIAL)?,
            firmware: text(abrm::VERSION)?,
        };
        let file = read_file(&port, &mut control)?;
        let features = Features::read(&file).map_err(|source| DeviceError::Decode {
            port: port.clone(),
            source,
        })?;
        Ok(Registers {
            port,
            control,
            identity,
            features,
            sirm,
        })
    }

    /// Names the port in an error that was made without it.
    fn named(&self, error: DeviceError) -> DeviceError {
        match error {
            DeviceError::Decode { source, .. } => DeviceError::Decode {
                port: self.port.clone(),
                source,
            },
            other => other,
        }
    }

    fn lacks(&self, capability: &'static str, key: &'static str) -> DeviceError {
        DeviceError::Lacks {
            port: self.port.clone(),
            capability,
            key,
        }
    }

    fn place(&mut self, name: &str) -> Result<Place, DeviceError> {
        let features = std::mem::take(&mut self.features);
        let place = features.place(name, self);
        self.features = features;
        place.map_err(|error| self.named(error))
    }

    fn get(&mut self, name: &str) -> Result<f64, DeviceError> {
        match self.place(name)? {
            Place::Constant(value) => Ok(value),
            Place::Register(register) => {
                let bytes = self.control.read(register.address, register.length)?;
                Ok(register.number(&bytes))
            }
        }
    }

    fn put(&mut self, name: &str, number: f64) -> Result<(), DeviceError> {
        let Place::Register(register) = self.place(name)? else {
            return Err(DeviceError::Refused {
                port: self.port.clone(),
                command: format!("setting {name}"),
                reason: "its value is fixed in the GenICam file".into(),
                remedy: "take it out of `features`",
            });
        };
        let before = match register.bits {
            Some(_) => self.control.read(register.address, register.length)?,
            None => Vec::new(),
        };
        self.control
            .write(register.address, &register.encode(number, &before))
    }

    fn set(&mut self, name: &str, value: &Value) -> Result<(), DeviceError> {
        let number = match value {
            Value::Number(number) => Some(*number),
            Value::Flag(flag) => {
                let field = if *flag { "OnValue" } else { "OffValue" };
                let number = self.features.number(name, field);
                Some(number.map_or(f64::from(u8::from(*flag)), |n| n as f64))
            }
            Value::Word(word) => self.features.entry(name, word).map(|n| n as f64),
        };
        let Some(number) = number else {
            return Err(DeviceError::Refused {
                port: self.port.clone(),
                command: format!("setting {name}"),
                reason: format!("it has no value {value:?}"),
                remedy: "look the values up in the device's manual and change `features`",
            });
        };
        self.put(name, number)
    }

    fn carry_out(&mut self, command: &str) -> Result<(), DeviceError> {
        let value = self.features.number(command, "CommandValue").unwrap_or(1);
        self.put(command, value as f64)
    }

    /// Scale and offset of A and C, mm.
    fn geometry(&mut self) -> Result<Geometry, DeviceError> {
        let mut of = |axis: &str| {
            if self.features.contains("Scan3dCoordinateSelector") {
                self.set("Scan3dCoordinateSelector", &Value::Word(axis.into()))?;
            }
            Ok::<_, DeviceError>((
                self.get("Scan3dCoordinateScale")?,
                self.get("Scan3dCoordinateOffset")?,
            ))
        };
        let (a_scale, a_offset) = of("CoordinateA")?;
        let (c_scale, c_offset) = of("CoordinateC")?;
        let flag = self.features.contains("Scan3dInvalidDataFlag");
        let flagged = flag && self.get("Scan3dInvalidDataFlag")? != 0.0;
        let invalid = match flagged {
            true => Some(self.get("Scan3dInvalidDataValue")?),
            false => None,
        };
        let geometry = Geometry {
            a_scale,
            a_offset,
            c_scale,
            c_offset,
            invalid,
        };
        let sound = [a_scale, a_offset, c_scale, c_offset]
            .iter()
            .all(|n| n.is_finite());
        match sound && a_scale != 0.0 && c_scale != 0.0 {
            true => Ok(geometry),
            false => Err(self.lacks("finite scales of its coordinates", "features")),
        }
    }

    /// Tells the device how its blocks are cut into transfers.
    fn sizes(&mut self) -> Result<Sizes, DeviceError> {
        let mut read = |offset| self.control.read_u32(self.sirm.wrapping_add(offset));
        // Sizes are multiples of two to the power of the highest byte; a page at most is believed.
        let align = 1_u64 << (read(sirm::INFO)? >> 24).min(12);
        let (leader, trailer) = (read(sirm::NEEDED_LEADER)?, read(sirm::NEEDED_TRAILER)?);
        let payload = self
            .control
            .read_u64(self.sirm.wrapping_add(sirm::NEEDED_PAYLOAD))?;
        let aligned = |size: u64| size.div_ceil(align) * align;
        let possible = payload > 0
            && payload <= block::PAYLOAD_MAX as u64
            && (52..=ENVELOPE_MAX).contains(&leader)
            && (28..=ENVELOPE_MAX).contains(&trailer);
        if !possible {
            return Err(DeviceError::Decode {
                port: self.port.clone(),
                source: DecodeError::Field {
                    message: "stream registers",
                    field: "required sizes",
                    found: payload,
                    allowed: "1 to 67108864 bytes of payload, and what leader and trailer need",
                },
            });
        }
        let transfer = aligned(payload).min(TRANSFER_MAX.into());
        let count = payload / transfer;
        let rest = aligned(payload - count * transfer);
        let (leader, trailer) = (aligned(leader.into()), aligned(trailer.into()));
        for (offset, size) in [
            (sirm::LEADER, leader),
            (sirm::TRAILER, trailer),
            (sirm::PAYLOAD_SIZE, transfer),
            (sirm::PAYLOAD_COUNT, count),
            (sirm::FINAL_1, rest),
            (sirm::FINAL_2, 0),
        ] {
            // All are far below 4 GiB.
            let bytes = (size as u32).to_le_bytes();
            self.control.write(self.sirm.wrapping_add(offset), &bytes)?;
        }
        Ok(Sizes {
            leader: leader as usize,
            trailer: trailer as usize,
            transfer: transfer as usize,
        })
    }

    fn stream(&mut self, on: bool) -> Result<(), DeviceError> {
        let address = self.sirm.wrapping_add(sirm::CONTROL);
        self.control.write(address, &u32::from(on).to_le_bytes())
    }

    fn stop(&mut self) -> Result<(), DeviceError> {
        self.carry_out("AcquisitionStop")?;
        self.stream(false)
    }
}

/// The GenICam file that the manifest lists first.
fn read_file(port: &str, control: &mut Control) -> Result<Vec<u8>, DeviceError> {
    let table = control.read_u64(abrm::MANIFEST)?;
    let count = control.read_u64(table)?;
    let entry = table.wrapping_add(8);
    let address = control.read_u64(entry.wrapping_add(8))?;
    let size = control.read_u64(entry.wrapping_add(16))?;
    if count == 0 || size == 0 || size > FILE_MAX as u64 {
        return Err(DeviceError::Decode {
            port: port.to_owned(),
            source: DecodeError::Field {
                message: "manifest",
                field: "size of the GenICam file",
                found: size,
                allowed: "1 to 16777216 bytes",
            },
        });
    }
    control.read(address, size as usize)
}

// ---- Device -----------------------------------------------------------------------------------------------------------

/// An open device.
struct U3vProfiler {
    port: String,
    registers: Mutex<Registers>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    identity: Identity,
    first_block: Option<u64>,
}

impl U3vProfiler {
    fn start_thread(
        registers: Registers,
        link: Arc<dyn UsbLink>,
        reading: Reading,
    ) -> Result<U3vProfiler, DeviceError> {
        let shared = Arc::new(Shared::new());
        let first_block = reading.first_block;
        let thread = {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new()
                .name("u3v-profiler".into())
                .spawn(move || stream::run(&link, &shared, &reading))
        };
        let thread = thread.map_err(|source| DeviceError::Link {
            port: registers.port.clone(),
            source: LinkError::Io {
                action: "starting its thread",
                source,
            },
        })?;
        Ok(U3vProfiler {
            port: registers.port.clone(),
            identity: registers.identity.clone(),
            registers: Mutex::new(registers),
            shared,
            thread: Some(thread),
            first_block,
        })
    }

    fn registers(&mut self) -> &mut Registers {
        self.registers
            .get_mut()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn out_of_order(&self, action: &'static str, needed: &'static str) -> DeviceError {
        DeviceError::OutOfOrder {
            port: self.port.clone(),
            action,
            needed,
        }
    }
}

impl Profiler for U3vProfiler {
    fn identity(&self) -> &Identity {
        &self.identity
    }

    fn start(&mut self) -> Result<(), DeviceError> {
        if self.shared.lock().running {
            return Err(self.out_of_order("start", "the run before to be stopped"));
        }
        let first_block = self.first_block;
        self.shared.lock().begin(first_block);
        self.shared.taken.notify_all();
        let registers = self.registers();
        let started = registers
            .stream(true)
            .and_then(|()| registers.carry_out("AcquisitionStart"));
        if started.is_err() {
            let _ = self.registers().stop();
            self.shared.lock().running = false;
        }
        started
    }

    fn next(&mut self, deadline: Instant) -> Result<Option<Profile>, DeviceError> {
        let mut inbox = self.shared.lock();
        loop {
            if let Some(profile) = inbox.pop() {
                self.shared.taken.notify_all();
                return Ok(Some(profile));
            }
            if let Some(over) = &mut inbox.over {
                return Err(over.error(&self.port));
            }
            if !inbox.running {
                return Err(self.out_of_order("next", "a run that was started"));
            }
            if Instant::now() >= deadline {
                return Ok(None);
            }
            inbox = self.shared.wait(inbox, deadline);
        }
    }

    fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
        {
            let mut inbox = self.shared.lock();
            if !inbox.running {
                return Ok(Vec::new());
            }
            inbox.stopping = true;
        }
        self.shared.taken.notify_all();
        // The stream stays open until what was taken has come.
        let stopped = self.registers().carry_out("AcquisitionStop");
        let began = Instant::now();
        let mut inbox = self.shared.lock();
        while stopped.is_ok() && inbox.over.is_none() && began.elapsed() < EMPTYING {
            let quiet_at = inbox.heard.max(began) + QUIET;
            if Instant::now() >= quiet_at {
                break;
            }
            inbox = self.shared.wait(inbox, quiet_at);
        }
        inbox.running = false;
        inbox.stopping = false;
        let profiles = std::iter::from_fn(|| inbox.pop()).collect();
        drop(inbox);
        let closed = self.registers().stream(false);
        stopped.and(closed).map(|()| profiles)
    }

    fn losses(&self) -> Losses {
        self.shared.lock().losses
    }

    fn check(&mut self) -> Result<Presence, DeviceError> {
        if self.shared.lock().running {
            return Err(checked_in_a_run(&self.port));
        }
        let control = &mut self.registers().control;
        let serial = control.read_text(abrm::SERIAL, abrm::TEXT)?;
        same(&self.port, &self.identity.serial, &serial)
    }
}

impl Drop for U3vProfiler {
    /// Switches the laser off, then ends the thread.
    fn drop(&mut self) {
        let over = self.shared.lock().over.is_some();
        if !over && let Err(error) = self.registers().stop() {
            tracing::warn!(port = self.port, %error, "not confirmed that the laser is off");
        }
        self.shared.lock().quit = true;
        self.shared.taken.notify_all();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so already.
            let _ = thread.join();
        }
    }
}
