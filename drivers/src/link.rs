//! Bytes to and from a device: serial port, TCP, recorder and replay are one code path.
//!
//! A driver gets a [`Links`] and opens its [`Target`] through it; what comes back is a [`Link`]. [`cable`] opens the real
//! thing, [`recording`] writes down what passes through another [`Links`], and [`replay`] plays such a file back.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub use serialport::{DataBits, Parity, StopBits};

use crate::device::{Claim, Mistake};
use crate::error::LinkError;

pub mod cable;
pub mod recording;
pub mod replay;

/// Opens links, so that cable, recorder and replay are the same to a driver.
pub trait Links: Send + Sync {
    /// Opens the link to `target`.
    ///
    /// # Errors
    /// Not there, in use, not permitted or not answering: each is told apart.
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError>;
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

/// The keys of a device table that name its link; exactly one of the first three is given.
#[derive(Debug, Clone, Default)]
pub(crate) struct LinkKeys {
    pub port: Option<String>,
    pub usb_serial: Option<String>,
    pub usb_id: Option<String>,
    pub address: Option<String>,
    pub baud: Option<u32>,
}

impl LinkKeys {
    /// The target these keys name; mistakes are added to `mistakes`, and the target is then `None`.
    pub fn target(self, default_baud: u32, mistakes: &mut Vec<Mistake>) -> Option<Target> {
        let before = mistakes.len();
        let given = [
            ("port", &self.port),
            ("usb_serial", &self.usb_serial),
            ("usb_id", &self.usb_id),
            ("address", &self.address),
        ];
        let names: Vec<&str> = given
            .iter()
            .filter(|(_, value)| value.is_some())
            .map(|(name, _)| *name)
            .collect();
        if names.len() != 1 {
            mistakes.push(Mistake {
                key: "port".into(),
                found: match names.len() {
                    0 => "no link".into(),
                    _ => format!("{} together", names.join(" and ")),
                },
                expected: "exactly one of port, usb_serial, usb_id, address".into(),
            });
        }
        for (name, value) in given {
            if value.as_ref().is_some_and(|text| text.trim().is_empty()) {
                mistakes.push(mistake(name, "an empty text", "a name"));
            }
        }
        let baud = self.baud.unwrap_or(default_baud);
        if !(300..=12_000_000).contains(&baud) {
            mistakes.push(mistake("baud", baud, "300 to 12000000"));
        }
        if self.baud.is_some() && self.address.is_some() {
            mistakes.push(mistake("baud", baud, "no baud with an address"));
        }
        let target = self.named(Line::eight_n_one(baud), mistakes);
        target.filter(|_| mistakes.len() == before)
    }

    fn named(self, line: Line, mistakes: &mut Vec<Mistake>) -> Option<Target> {
        if let Some(address) = self.address {
            if !has_port_number(&address) {
                mistakes.push(mistake(
                    "address",
                    format!("{address:?}"),
                    "host:port, as in \"192.168.1.20:7450\"",
                ));
            }
            return Some(Target::Tcp { address });
        }
        let port = if let Some(path) = self.port {
            Port::Path(path)
        } else if let Some(serial) = self.usb_serial {
            Port::UsbSerial(serial)
        } else {
            let text = self.usb_id?;
            let Some((vendor, product)) = usb_id(&text) else {
                mistakes.push(mistake(
                    "usb_id",
                    format!("{text:?}"),
                    "vendor:product in hex, as in \"0403:6001\"",
                ));
                return None;
            };
            Port::UsbId { vendor, product }
        };
        Some(Target::Serial { port, line })
    }
}

fn has_port_number(address: &str) -> bool {
    address.rsplit_once(':').is_some_and(|(host, port)| {
        !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port != 0)
    })
}

fn usb_id(text: &str) -> Option<(u16, u16)> {
    let (vendor, product) = text.split_once(':')?;
    let number = |digits: &str| match digits.len() {
        1..=4 if digits.bytes().all(|b| b.is_ascii_hexdigit()) => {
            u16::from_str_radix(digits, 16).ok()
        }
        _ => None,
    };
    Some((number(vendor)?, number(product)?))
}

/// A [`Mistake`] of one key.
pub(crate) fn mistake(key: &str, found: impl fmt::Display, expected: &str) -> Mistake {
    Mistake {
        key: key.into(),
        found: found.to_string(),
        expected: expected.into(),
    }
}

/// Time left until `deadline`, zero when it has passed.
pub(crate) fn left(deadline: Instant) -> Duration {
    deadline.saturating_duration_since(Instant::now())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(keys: LinkKeys) -> Vec<String> {
        let mut mistakes = Vec::new();
        let target = keys.target(921_600, &mut mistakes);
        assert_eq!(target.is_none(), !mistakes.is_empty());
        mistakes.iter().map(Mistake::to_string).collect()
    }

    #[test]
    fn link_keys_name_one_target() {
        let mut mistakes = Vec::new();
        let keys = LinkKeys {
            usb_id: Some("0403:6001".into()),
            ..LinkKeys::default()
        };
        let target = keys.target(115_200, &mut mistakes);
        assert_eq!(mistakes, []);
        assert_eq!(
            target,
            Some(Target::Serial {
                port: Port::UsbId {
                    vendor: 0x0403,
                    product: 0x6001
                },
                line: Line::eight_n_one(115_200)
            })
        );
        assert_eq!(
            target.map(|t| t.claim()),
            Some(Claim::Port("usb:0403:6001".into()))
        );
    }

    #[test]
    fn every_mistake_of_the_link_keys_is_reported() {
        assert_eq!(
            texts(LinkKeys::default()),
            ["port: no link, expected exactly one of port, usb_serial, usb_id, address"]
        );
        assert_eq!(
            texts(LinkKeys {
                port: Some("/dev/ttyACM0".into()),
                address: Some("nowhere".into()),
                baud: Some(10),
                ..LinkKeys::default()
            }),
            [
                "port: port and address together, expected exactly one of port, usb_serial, usb_id, address",
                "baud: 10, expected 300 to 12000000",
                "baud: 10, expected no baud with an address",
                "address: \"nowhere\", expected host:port, as in \"192.168.1.20:7450\"",
            ]
        );
        assert_eq!(
            texts(LinkKeys {
                usb_id: Some("0403-6001".into()),
                ..LinkKeys::default()
            }),
            ["usb_id: \"0403-6001\", expected vendor:product in hex, as in \"0403:6001\""]
        );
        assert_eq!(
            texts(LinkKeys {
                usb_serial: Some(" ".into()),
                ..LinkKeys::default()
            }),
            ["usb_serial: an empty text, expected a name"]
        );
    }
}
