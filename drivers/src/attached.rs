//! What is attached to this computer, and who may open it.

use std::path::Path;

use serde::Serialize;
use serialport::SerialPortType;

use crate::error::LinkError;
use crate::link::cable;
use crate::link::usb::udev_rule;

/// Everything found, and what kept us from looking.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Attached {
    /// Serial ports, by path.
    pub serial: Vec<SerialDevice>,
    /// USB devices, by bus and address.
    pub usb: Vec<UsbDevice>,
    /// What could not be searched, and why; not an error.
    pub notes: Vec<String>,
}

/// A serial port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SerialDevice {
    /// Path to open it by.
    pub path: String,
    /// The USB converter behind it, where there is one.
    pub usb: Option<UsbName>,
    /// Whether this program may open it now.
    pub access: Access,
}

/// A USB device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct UsbDevice {
    /// Bus number.
    pub bus: u8,
    /// Address on the bus; changes when it is plugged in again.
    pub address: u8,
    /// Who it says it is.
    pub name: UsbName,
    /// Whether this program may open it now.
    pub access: Access,
    /// The udev rule that is missing, and the file it belongs in, where that is what keeps this user out.
    pub missing_rule: Option<MissingRule>,
}

/// A udev rule that would let this user open a device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct MissingRule {
    /// Where it belongs.
    pub file: &'static str,
    /// The line.
    pub rule: String,
}

/// Who a USB device says it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct UsbName {
    /// Vendor number.
    pub vendor_id: u16,
    /// Product number.
    pub product_id: u16,
    /// Serial number, for `usb_serial =` in a configuration.
    pub serial: Option<String>,
    /// Maker's name.
    pub manufacturer: Option<String>,
    /// Product's name.
    pub product: Option<String>,
}

/// Whether this program may open a device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "state", content = "why")]
pub enum Access {
    /// It may.
    Open,
    /// It may not: why, and what to do.
    Refused(String),
}

/// Looks for serial ports and USB devices. No port is opened; a USB device is, for its names, but sent nothing that changes it.
///
/// A search that the system does not allow is a note in the answer, never an error.
pub fn attached() -> Attached {
    let mut found = Attached::default();
    match cable::ports() {
        Ok(ports) => found.serial = ports.into_iter().map(serial_device).collect(),
        Err(error) => found.notes.push(format!("serial ports: {}", chain(&error))),
    }
    found.serial.sort_by(|a, b| a.path.cmp(&b.path));
    match usb_devices() {
        Ok(devices) => found.usb = devices,
        Err(error) => found.notes.push(format!(
            "USB cannot be searched ({error}); serial ports over USB are listed all the same"
        )),
    }
    found
}

fn serial_device(info: serialport::SerialPortInfo) -> SerialDevice {
    let usb = match info.port_type {
        SerialPortType::UsbPort(usb) => Some(UsbName {
            vendor_id: usb.vid,
            product_id: usb.pid,
            serial: usb.serial_number,
            manufacturer: usb.manufacturer,
            product: usb.product,
        }),
        _ => None,
    };
    SerialDevice {
        access: access(&info.port_name),
        path: info.port_name,
        usb,
    }
}

/// Whether this program may open the port, learnt without opening it: opening raises DTR, which resets many boards.
fn access(path: &str) -> Access {
    use rustix::fs::{Access as Mode, AtFlags, CWD};
    let asked = rustix::fs::accessat(CWD, path, Mode::READ_OK | Mode::WRITE_OK, AtFlags::EACCESS);
    let refused = match asked {
        Ok(()) => match holder(Path::new("/proc"), Path::new(path)) {
            None => return Access::Open,
            Some(holder) => {
                return Access::Refused(format!(
                    "{holder} has it open; close that program, then retry"
                ));
            }
        },
        Err(rustix::io::Errno::ACCESS | rustix::io::Errno::PERM) => LinkError::Denied {
            group: cable::owning_group(path),
        },
        Err(rustix::io::Errno::NOENT) => LinkError::NotFound,
        Err(errno) => LinkError::Io {
            action: "asking for access",
            source: errno.into(),
        },
    };
    Access::Refused(chain(&refused))
}

/// The process that holds `path` open, as far as this user may see; itself not counted.
fn holder(proc: &Path, path: &Path) -> Option<String> {
    let own = std::process::id().to_string();
    for process in std::fs::read_dir(proc).ok()?.flatten() {
        let number = process.file_name().to_string_lossy().into_owned();
        if number == own || !number.bytes().all(|b| b.is_ascii_digit()) {
            continue;
        }
        let Ok(files) = std::fs::read_dir(process.path().join("fd")) else {
            continue;
        };
        let holds = |file: std::fs::DirEntry| {
            std::fs::read_link(file.path()).is_ok_and(|target| target == path)
        };
        if files.flatten().any(holds) {
            let name = std::fs::read_to_string(process.path().join("comm")).unwrap_or_default();
            return Some(format!("{} (process {number})", name.trim()));
        }
    }
    None
}

fn chain(error: &LinkError) -> String {
    let mut text = error.to_string();
    let mut inner = std::error::Error::source(error);
    while let Some(source) = inner {
        text = format!("{text}: {source}");
        inner = source.source();
    }
    text
}

fn usb_devices() -> Result<Vec<UsbDevice>, rusb::Error> {
    use rusb::UsbContext;
    let context = rusb::Context::new()?;
    let mut found = Vec::new();
    for device in context.devices()?.iter() {
        let Ok(descriptor) = device.device_descriptor() else {
            continue;
        };
        let opened = device.open();
        let text = |read: fn(
            &rusb::DeviceHandle<rusb::Context>,
            &rusb::DeviceDescriptor,
        ) -> rusb::Result<String>| {
            let handle = opened.as_ref().ok()?;
            read(handle, &descriptor).ok()
        };
        let name = UsbName {
            vendor_id: descriptor.vendor_id(),
            product_id: descriptor.product_id(),
            serial: text(|h, d| h.read_serial_number_string_ascii(d)),
            manufacturer: text(|h, d| h.read_manufacturer_string_ascii(d)),
            product: text(|h, d| h.read_product_string_ascii(d)),
        };
        let refused = opened.err();
        found.push(UsbDevice {
            bus: device.bus_number(),
            address: device.address(),
            missing_rule: missing_rule(refused, &name),
            name,
            access: usb_access(refused),
        });
    }
    found.sort_by_key(|device| (device.bus, device.address));
    Ok(found)
}

/// The rule to add, where permission is what is lacking.
fn missing_rule(error: Option<rusb::Error>, name: &UsbName) -> Option<MissingRule> {
    let denied = error == Some(rusb::Error::Access);
    denied.then(|| {
        let (file, rule) = udev_rule(name.vendor_id, name.product_id);
        MissingRule { file, rule }
    })
}

/// What a failure to open a USB device means to a person.
fn usb_access(error: Option<rusb::Error>) -> Access {
    let why = match error {
        None => return Access::Open,
        Some(rusb::Error::Access) => {
            "this user may not open it; add a udev rule that gives it to a group of this user, then plug it in again"
        }
        Some(rusb::Error::Busy) => "another program has it open; close that program, then retry",
        Some(rusb::Error::NoDevice | rusb::Error::NotFound) => "it is gone: unplugged a moment ago",
        Some(other) => return Access::Refused(format!("opening failed: {other}")),
    };
    Access::Refused(why.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looking_never_fails_and_says_what_it_could_not_search() {
        let found = attached();
        assert!(found.serial.is_sorted_by(|a, b| a.path <= b.path));
        for note in &found.notes {
            assert!(
                note.starts_with("USB cannot be searched (") || note.starts_with("serial ports: "),
                "{note}"
            );
        }
    }

    #[test]
    fn a_port_that_is_not_there_is_refused() {
        let why = "nothing of this name is there; check cable, power and the name";
        assert_eq!(access("/dev/no-such-port"), Access::Refused(why.into()));
        let file = std::env::temp_dir().join(format!("acies-access-{}", std::process::id()));
        std::fs::write(&file, "").expect("a file");
        let found = access(file.to_str().expect("a UTF-8 path"));
        std::fs::remove_file(&file).expect("the file removed");
        assert_eq!(found, Access::Open);
    }

    #[test]
    fn the_process_that_holds_a_port_is_named() {
        let proc = std::env::temp_dir().join(format!("acies-proc-{}", std::process::id()));
        let process = proc.join("4711");
        std::fs::create_dir_all(process.join("fd")).expect("a folder");
        std::fs::create_dir_all(proc.join("self/fd")).expect("a folder");
        std::fs::write(process.join("comm"), "ModemManager\n").expect("a file");
        std::os::unix::fs::symlink("/dev/ttyUSB7", process.join("fd/5")).expect("a link");
        let found = holder(&proc, Path::new("/dev/ttyUSB7"));
        let other = holder(&proc, Path::new("/dev/ttyUSB8"));
        std::fs::remove_dir_all(&proc).expect("the folder removed");
        assert_eq!(found.as_deref(), Some("ModemManager (process 4711)"));
        assert_eq!(other, None);
    }

    #[test]
    fn usb_refusals_say_what_to_do() {
        let told = |error| match usb_access(Some(error)) {
            Access::Open => "open".to_owned(),
            Access::Refused(why) => why,
        };
        assert_eq!(usb_access(None), Access::Open);
        assert_eq!(
            told(rusb::Error::Access),
            "this user may not open it; add a udev rule that gives it to a group of this user, then plug it in again"
        );
        let name = UsbName {
            vendor_id: 0x0fe7,
            product_id: 0x4001,
            serial: None,
            manufacturer: None,
            product: None,
        };
        let missing = missing_rule(Some(rusb::Error::Access), &name).expect("a rule");
        assert_eq!(missing.file, "/etc/udev/rules.d/70-acies.rules");
        assert!(
            missing
                .rule
                .contains("ATTR{idVendor}==\"0fe7\", ATTR{idProduct}==\"4001\"")
        );
        assert_eq!(missing_rule(Some(rusb::Error::Busy), &name), None);
        assert_eq!(
            told(rusb::Error::Busy),
            "another program has it open; close that program, then retry"
        );
        assert_eq!(
            told(rusb::Error::NoDevice),
            "it is gone: unplugged a moment ago"
        );
        assert!(told(rusb::Error::NoMem).starts_with("opening failed: "));
    }
}
