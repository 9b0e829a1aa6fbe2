//! The real thing: serial ports and TCP connections of this computer.
//!
//! Hides how an operating system says that a port is absent, held, forbidden or gone. A pseudo-terminal is served like a
//! port: it has no modem lines, and reads its format back as 8N whatever was set, so neither is relied upon.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serialport::{SerialPort, SerialPortInfo, SerialPortType, TTYPort};

use super::usb::{self, UsbLink, UsbTarget};
use super::{Line, Link, Links, Port, Target, left};
use crate::error::LinkError;

/// Longest wait for one address of a TCP host. 2 s is two lost SYN packets; a local network needs a millisecond.
const CONNECT: Duration = Duration::from_secs(2);

/// Silence after which the system asks whether a TCP peer is still there; with [`PROBES`] a pulled cable shows within 4 s. The system counts
/// these times in whole seconds.
const PROBE_AFTER: Duration = Duration::from_secs(1);
const PROBE_EVERY: Duration = Duration::from_secs(1);
const PROBES: u32 = 3;

/// Most bytes given to a serial port at once. The Linux tty layer calls a port writable only when fewer than 256 bytes wait
/// in it and its driver has room, so that a write of this size does not block.
const SERIAL_WRITE: usize = 256;

/// Least wait that a socket can be told; zero would mean for ever.
const LEAST_WAIT: Duration = Duration::from_micros(100);

/// The ports and the network of this computer.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cable;

impl Links for Cable {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        match target {
            Target::Serial { port, line } => {
                let path = match port {
                    Port::Path(path) => path.clone(),
                    named => pick(&ports()?, named)?,
                };
                Ok(Arc::new(Serial::open(&path, *line)?))
            }
            Target::Tcp { address } => Ok(Arc::new(Tcp::open(address)?)),
        }
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        usb::open(target)
    }
}

/// The serial ports of this computer; none where the system keeps no list of them.
pub(crate) fn ports() -> Result<Vec<SerialPortInfo>, LinkError> {
    if cfg!(target_os = "linux") && !Path::new("/sys/class/tty").is_dir() {
        return Ok(Vec::new());
    }
    serialport::available_ports().map_err(|error| LinkError::Io {
        action: "listing the serial ports",
        source: error.into(),
    })
}

/// The path of the one port among `ports` that bears the name.
fn pick(ports: &[SerialPortInfo], name: &Port) -> Result<String, LinkError> {
    let bears = |info: &&SerialPortInfo| match (&info.port_type, name) {
        (_, Port::Path(path)) => info.port_name == *path,
        (SerialPortType::UsbPort(usb), Port::UsbSerial(serial)) => {
            usb.serial_number.as_deref() == Some(serial)
        }
        (SerialPortType::UsbPort(usb), Port::UsbId { vendor, product }) => {
            (usb.vid, usb.pid) == (*vendor, *product)
        }
        _ => false,
    };
    let mut found: Vec<String> = ports
        .iter()
        .filter(bears)
        .map(|info| info.port_name.clone())
        .collect();
    match found.len() {
        0 => Err(LinkError::NotFound),
        1 => Ok(found.remove(0)),
        _ => {
            found.sort();
            Err(LinkError::Ambiguous { ports: found })
        }
    }
}

/// A serial port, opened for this program alone. Two handles of it, so that reading does not hold up writing.
struct Serial {
    reader: Mutex<TTYPort>,
    writer: Mutex<TTYPort>,
}

impl Serial {
    fn open(path: &str, line: Line) -> Result<Serial, LinkError> {
        let writer = serialport::new(path, line.baud)
            .data_bits(line.data_bits)
            .parity(line.parity)
            .stop_bits(line.stop_bits)
            .dtr_on_open(true)
            .open_native()
            .map_err(|error| open_error(&error, path))?;
        let reader = writer.try_clone_native().map_err(|error| LinkError::Io {
            action: "opening the port a second time",
            source: error.into(),
        })?;
        Ok(Serial {
            reader: Mutex::new(reader),
            writer: Mutex::new(writer),
        })
    }
}

/// What the failure to open a port means. `NoDevice` is how the serialport crate reports both kinds of lock on Linux.
fn open_error(error: &serialport::Error, path: &str) -> LinkError {
    use serialport::ErrorKind as Kind;
    match error.kind() {
        Kind::NoDevice => LinkError::Busy,
        Kind::Io(ErrorKind::NotFound) => LinkError::NotFound,
        Kind::Io(ErrorKind::PermissionDenied) => LinkError::Denied {
            group: owning_group(path),
        },
        _ if !is_character_device(path) => LinkError::NotSerial,
        _ => LinkError::Io {
            action: "opening the port",
            source: io::Error::other(error.to_string()),
        },
    }
}

fn is_character_device(path: &str) -> bool {
    use std::os::unix::fs::FileTypeExt;
    std::fs::metadata(path).is_ok_and(|meta| meta.file_type().is_char_device())
}

/// The group that owns `path`, by name where /etc/group has one, else by number; `dialout` where nothing can be learnt.
pub(crate) fn owning_group(path: &str) -> String {
    use std::os::unix::fs::MetadataExt;
    let Ok(meta) = std::fs::metadata(path) else {
        return "dialout".into();
    };
    let number = meta.gid().to_string();
    let groups = std::fs::read_to_string("/etc/group").unwrap_or_default();
    groups
        .lines()
        .map(|line| line.split(':').collect::<Vec<_>>())
        .find(|fields| fields.get(2) == Some(&number.as_str()))
        .map_or(number.clone(), |fields| fields[0].to_owned())
}

/// What a failed read or write on an open port means: `None` is "not yet".
///
/// The serialport crate folds EIO, ENODEV and ENXIO into `Other`; on a port that was open all of them mean that it went away.
fn serial_failure(error: &io::Error) -> Option<LinkError> {
    match error.kind() {
        ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => None,
        _ => {
            tracing::debug!(%error, "serial port gone");
            Some(LinkError::Gone)
        }
    }
}

impl Link for Serial {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let mut port = self.reader.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let wait = left(deadline);
            // Setting the wait of an open port only stores a number.
            let _ = port.set_timeout(wait);
            match port.read(buffer) {
                Ok(0) => return Err(LinkError::Gone),
                Ok(n) => return Ok(n),
                Err(error) => match serial_failure(&error) {
                    Some(failure) => return Err(failure),
                    None if wait.is_zero() => return Ok(0),
                    None => {}
                },
            }
        }
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        let mut port = self.writer.lock().unwrap_or_else(PoisonError::into_inner);
        let mut written = 0;
        while written < bytes.len() {
            let wait = left(deadline);
            let _ = port.set_timeout(wait);
            let end = bytes.len().min(written + SERIAL_WRITE);
            match port.write(&bytes[written..end]) {
                Ok(n) => written += n,
                Err(error) => match serial_failure(&error) {
                    Some(failure) => return Err(failure),
                    None if wait.is_zero() => {
                        return Err(LinkError::Stuck {
                            written,
                            length: bytes.len(),
                        });
                    }
                    None => {}
                },
            }
        }
        Ok(())
    }
}

/// A TCP connection without delay for small packets, watched by the system's keep-alive.
struct Tcp {
    stream: TcpStream,
}

impl Tcp {
    fn open(address: &str) -> Result<Tcp, LinkError> {
        // The resolver has its own limit, a few seconds; a numeric address needs none.
        let resolved: Vec<SocketAddr> = address
            .to_socket_addrs()
            .map_err(|_| LinkError::NotFound)?
            .collect();
        let mut last = LinkError::NotFound;
        for one in resolved {
            match TcpStream::connect_timeout(&one, CONNECT) {
                Ok(stream) => {
                    watch(&stream).map_err(|source| LinkError::Io {
                        action: "setting up the connection",
                        source,
                    })?;
                    return Ok(Tcp { stream });
                }
                Err(error) => last = connect_error(error),
            }
        }
        Err(last)
    }
}

/// Sets what lets a pulled cable show although nobody says so.
fn watch(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let keepalive = socket2::TcpKeepalive::new()
        .with_time(PROBE_AFTER)
        .with_interval(PROBE_EVERY)
        .with_retries(PROBES);
    socket2::SockRef::from(stream).set_tcp_keepalive(&keepalive)
}

fn connect_error(error: io::Error) -> LinkError {
    match error.kind() {
        ErrorKind::ConnectionRefused | ErrorKind::ConnectionReset => LinkError::Refused,
        ErrorKind::TimedOut
        | ErrorKind::WouldBlock
        | ErrorKind::HostUnreachable
        | ErrorKind::NetworkUnreachable => LinkError::Unreachable {
            deadline_s: CONNECT.as_secs_f64(),
        },
        _ => LinkError::Io {
            action: "connecting",
            source: error,
        },
    }
}

/// What a failed read or write on a connection means: `None` is "not yet".
fn tcp_failure(error: io::Error, action: &'static str) -> Option<LinkError> {
    match error.kind() {
        ErrorKind::TimedOut if error.raw_os_error() == Some(TIMED_OUT) => Some(LinkError::Gone),
        ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => None,
        ErrorKind::ConnectionReset
        | ErrorKind::ConnectionAborted
        | ErrorKind::BrokenPipe
        | ErrorKind::NotConnected
        | ErrorKind::HostUnreachable
        | ErrorKind::NetworkUnreachable
        | ErrorKind::NetworkDown => Some(LinkError::Gone),
        _ => Some(LinkError::Io {
            action,
            source: error,
        }),
    }
}

/// ETIMEDOUT on Linux: keep-alive gave the peer up. A read that merely waited long enough reports EAGAIN instead.
const TIMED_OUT: i32 = 110;

impl Link for Tcp {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        loop {
            let wait = left(deadline);
            let set = self.stream.set_read_timeout(Some(wait.max(LEAST_WAIT)));
            match set.and_then(|()| (&self.stream).read(buffer)) {
                Ok(0) => return Err(LinkError::Gone),
                Ok(n) => return Ok(n),
                Err(error) => match tcp_failure(error, "reading") {
                    Some(failure) => return Err(failure),
                    None if wait.is_zero() => return Ok(0),
                    None => {}
                },
            }
        }
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        let mut written = 0;
        while written < bytes.len() {
            let wait = left(deadline);
            let set = self.stream.set_write_timeout(Some(wait.max(LEAST_WAIT)));
            match set.and_then(|()| (&self.stream).write(&bytes[written..])) {
                Ok(n) => written += n,
                Err(error) => match tcp_failure(error, "writing") {
                    Some(failure) => return Err(failure),
                    None if wait.is_zero() => {
                        return Err(LinkError::Stuck {
                            written,
                            length: bytes.len(),
                        });
                    }
                    None => {}
                },
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use serialport::UsbPortInfo;

    use super::*;

    fn usb(path: &str, vendor: u16, serial: Option<&str>) -> SerialPortInfo {
        SerialPortInfo {
            port_name: path.into(),
            port_type: SerialPortType::UsbPort(UsbPortInfo {
                vid: vendor,
                pid: 0x6001,
                serial_number: serial.map(str::to_owned),
                manufacturer: None,
                product: None,
            }),
        }
    }

    #[test]
    fn a_port_is_found_by_its_usb_name_wherever_it_was_plugged_in() {
        let ports = [
            usb("/dev/ttyUSB2", 0x0403, Some("P-42")),
            usb("/dev/ttyUSB1", 0x0403, None),
            usb("/dev/ttyACM0", 0x0483, Some("P-43")),
            SerialPortInfo {
                port_name: "/dev/ttyS0".into(),
                port_type: SerialPortType::Unknown,
            },
        ];
        let find = |port: Port| match pick(&ports, &port) {
            Ok(path) => path,
            Err(error) => error.to_string(),
        };
        let id = |vendor| Port::UsbId {
            vendor,
            product: 0x6001,
        };
        assert_eq!(find(Port::UsbSerial("P-42".into())), "/dev/ttyUSB2");
        assert_eq!(find(id(0x0483)), "/dev/ttyACM0");
        assert_eq!(find(Port::Path("/dev/ttyS0".into())), "/dev/ttyS0");
        assert_eq!(
            find(id(0x0403)),
            "it may be any of [\"/dev/ttyUSB1\", \"/dev/ttyUSB2\"]; name one of these by `port`"
        );
        assert_eq!(
            find(Port::UsbSerial("P-44".into())),
            "nothing of this name is there; check cable, power and the name"
        );
    }

    #[test]
    fn failures_to_open_are_told_apart() {
        let told = |kind, path: &str| {
            open_error(&serialport::Error::new(kind, "reason"), path).to_string()
        };
        use serialport::ErrorKind as Kind;
        let denied = Kind::Io(ErrorKind::PermissionDenied);
        assert_eq!(
            told(denied, "/no/such/path"),
            "this user may not open it; add the user to the group \"dialout\" (usermod -aG dialout USER) and log in again"
        );
        // The first user of every system owns its null device.
        assert!(told(denied, "/dev/null").contains("the group \"root\""));
        assert_eq!(told(Kind::Unknown, "/dev/null"), "opening the port failed");
        assert_eq!(
            told(Kind::Unknown, "/"),
            "it is not a serial port; give the path of one, as in \"/dev/ttyACM0\""
        );
    }

    #[test]
    fn failures_to_connect_are_told_apart() {
        let told = |kind: ErrorKind| connect_error(kind.into()).to_string();
        assert_eq!(
            told(ErrorKind::TimedOut),
            "no connection within 2 s; check cable, power and the address"
        );
        assert_eq!(told(ErrorKind::HostUnreachable), told(ErrorKind::TimedOut));
        assert_eq!(told(ErrorKind::InvalidInput), "connecting failed");
    }

    #[test]
    fn a_peer_that_keep_alive_gave_up_is_gone_and_a_wait_that_ended_is_not() {
        let given_up = io::Error::from_raw_os_error(TIMED_OUT);
        assert!(matches!(
            tcp_failure(given_up, "reading"),
            Some(LinkError::Gone)
        ));
        for waited in [ErrorKind::WouldBlock, ErrorKind::TimedOut] {
            assert!(tcp_failure(waited.into(), "reading").is_none());
        }
    }
}
