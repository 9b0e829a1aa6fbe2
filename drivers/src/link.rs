//! Bytes to and from a device: serial port, TCP, recorder and replay are one code path.
//!
//! A driver gets a [`Links`] and opens its [`Target`] through it; what comes back is a [`Link`]. [`cable`] opens the real
//! thing, [`recording`] writes down what passes through another [`Links`], and [`replay`] plays such a file back.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub use serialport::{DataBits, Parity, StopBits};

use crate::device::Claim;
use crate::error::LinkError;

pub mod cable;
pub(crate) mod pump;
pub mod recording;
pub mod replay;
pub mod usb;

/// Opens links, so that cable, recorder and replay are the same to a driver.
pub trait Links: Send + Sync {
    /// Opens the link to `target`.
    ///
    /// # Errors
    /// Not there, in use, not permitted or not answering: each is told apart.
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError>;

    /// Opens a USB device.
    ///
    /// # Errors
    /// As [`Links::open`]; [`LinkError::NoUsb`] where these links carry none.
    fn open_usb(&self, target: &usb::UsbTarget) -> Result<Arc<dyn usb::UsbLink>, LinkError> {
        Err(LinkError::NoUsb {
            reason: format!("these links do not lead to {target}"),
        })
    }
}

impl<L: Links + ?Sized> Links for &L {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        (**self).open(target)
    }

    fn open_usb(&self, target: &usb::UsbTarget) -> Result<Arc<dyn usb::UsbLink>, LinkError> {
        (**self).open_usb(target)
    }
}

/// An open link. One thread may read while another writes; dropping the last handle closes it.
pub trait Link: Send + Sync {
    /// Reads what is there into `buffer`, waiting for the first byte until `deadline`.
    ///
    /// The answer is the number of bytes read. 0 means that nothing came before the deadline, and nothing else: a link whose
    /// other end is closed answers [`LinkError::Gone`].
    ///
    /// # Errors
    /// [`LinkError::Gone`] when the other end closed or was unplugged.
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError>;

    /// When the bytes of the last read came, asked by who read them: now, but where a recording is played back, which knows it.
    fn received(&self) -> Instant {
        Instant::now()
    }

    /// Writes all of `bytes`, or fails at `deadline`.
    ///
    /// # Errors
    /// [`LinkError::Stuck`] when the other end takes no more bytes, [`LinkError::Gone`] when it is not there any more.
    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError>;
}

/// Where a link leads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// A serial port, or a USB device that behaves as one.
    Serial {
        /// Which port.
        port: Port,
        /// How characters travel on it.
        line: Line,
    },
    /// A device that listens on a TCP port.
    Tcp {
        /// Host and port, as in `192.168.1.20:7450`.
        address: String,
    },
}

/// How a serial port is named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Port {
    /// By its path, which may change when it is plugged in again.
    Path(String),
    /// By the serial number of its USB converter: the same after plugging in again.
    UsbSerial(String),
    /// By the converter's USB vendor and product number, where it has no serial number and is the only one of its kind.
    UsbId {
        /// USB vendor number.
        vendor: u16,
        /// USB product number.
        product: u16,
    },
}

/// How characters travel on a serial line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Line {
    /// Symbols a second.
    pub baud: u32,
    /// Bits of a character.
    pub data_bits: DataBits,
    /// Parity of a character.
    pub parity: Parity,
    /// Stop bits of a character.
    pub stop_bits: StopBits,
}

impl Line {
    /// 8 data bits, no parity, 1 stop bit.
    pub fn eight_n_one(baud: u32) -> Line {
        Line {
            baud,
            data_bits: DataBits::Eight,
            parity: Parity::None,
            stop_bits: StopBits::One,
        }
    }
}

impl Target {
    /// What a device at this target must have for itself.
    pub fn claim(&self) -> Claim {
        match self {
            Target::Serial { port, .. } => Claim::Port(port.to_string()),
            Target::Tcp { address } => Claim::Address(address.clone()),
        }
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Target::Serial { port, .. } => write!(f, "{port}"),
            Target::Tcp { address } => write!(f, "{address}"),
        }
    }
}

impl fmt::Display for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Port::Path(path) => write!(f, "{path}"),
            Port::UsbSerial(serial) => write!(f, "usb:{serial}"),
            Port::UsbId { vendor, product } => write!(f, "usb:{vendor:04x}:{product:04x}"),
        }
    }
}

/// Time left until `deadline`, zero when it has passed.
pub(crate) fn left(deadline: Instant) -> Duration {
    deadline.saturating_duration_since(Instant::now())
}
