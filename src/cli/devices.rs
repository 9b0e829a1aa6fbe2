//! `acies devices`: what is attached, who may open it, and why not.

use acies_drivers::attached::{Access, Attached, UsbName, attached};
use anyhow::Context;

use super::{Failure, Status, print_line};

/// Lists serial ports and USB devices, whether this user may open them, and what to do where not.
///
/// No port is opened. The serial number listed is what `usb_serial = "..."` in a configuration takes, so that a device
/// is found again under whatever name it gets when it is plugged in.
#[derive(Debug, clap::Args)]
pub struct Devices {
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

impl Devices {
    /// Carries the command out.
    ///
    /// # Errors
    /// When standard output cannot be written.
    pub fn run(self) -> Result<Status, Failure> {
        let found = attached();
        let text = if self.json {
            serde_json::to_string(&found)
                .context("devices as JSON")
                .map_err(Failure::Internal)?
        } else {
            lines(&found).join("\n")
        };
        print_line(&text)?;
        Ok(Status::Done)
    }
}

fn lines(found: &Attached) -> Vec<String> {
    let mut lines = Vec::new();
    for port in &found.serial {
        let name = port.usb.as_ref().map(usb_name).unwrap_or_default();
        lines.push(format!("{}  {}{}", port.path, access(&port.access), name));
    }
    for device in &found.usb {
        let place = format!("usb {:03}:{:03}", device.bus, device.address);
        lines.push(format!(
            "{place}  {}{}",
            access(&device.access),
            usb_name(&device.name)
        ));
        if let Some(missing) = &device.missing_rule {
            lines.push(format!("  put into {}:", missing.file));
            lines.push(format!("  {}", missing.rule));
        }
    }
    if lines.is_empty() {
        lines.push("no serial port and no USB device found".to_owned());
    }
    lines.extend(found.notes.iter().map(|note| format!("note: {note}")));
    let drivers: Vec<String> = acies_drivers::ALL
        .iter()
        .map(|driver| format!("  {}  {}", driver.name, driver.summary))
        .collect();
    lines.push(format!("drivers:\n{}", drivers.join("\n")));
    lines
}

fn access(access: &Access) -> String {
    match access {
        Access::Open => "may be opened".to_owned(),
        Access::Refused(why) => format!("may not be opened: {why}"),
    }
}

fn usb_name(name: &UsbName) -> String {
    let mut text = format!("  {:04x}:{:04x}", name.vendor_id, name.product_id);
    for part in [&name.manufacturer, &name.product].into_iter().flatten() {
        text = format!("{text} {part}");
    }
    match &name.serial {
        Some(serial) => format!("{text}, usb_serial = {serial:?}"),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use acies_drivers::attached::{MissingRule, SerialDevice, UsbDevice};

    use super::*;

    #[test]
    fn a_port_is_listed_with_its_converter_and_the_reason_it_is_closed_to_us() {
        let usb = UsbName {
            vendor_id: 0x0403,
            product_id: 0x6001,
            serial: Some("A50285BI".to_owned()),
            manufacturer: Some("FTDI".to_owned()),
            product: None,
        };
        let refused = Access::Refused("no permission; join the group dialout".to_owned());
        let found = Attached {
            serial: vec![SerialDevice {
                path: "/dev/ttyUSB0".to_owned(),
                usb: Some(usb),
                access: refused,
            }],
            ..Attached::default()
        };
        assert_eq!(
            lines(&found)[0],
            "/dev/ttyUSB0  may not be opened: no permission; join the group dialout  0403:6001 FTDI, \
             usb_serial = \"A50285BI\""
        );
        let denied = UsbDevice {
            bus: 1,
            address: 7,
            name: UsbName {
                vendor_id: 0x0fe7,
                product_id: 0x4001,
                serial: None,
                manufacturer: None,
                product: None,
            },
            access: Access::Refused("this user may not open it".to_owned()),
            missing_rule: Some(MissingRule {
                file: "/etc/udev/rules.d/70-acies.rules",
                rule: "SUBSYSTEM==\"usb\"".to_owned(),
            }),
        };
        let found = Attached {
            usb: vec![denied],
            ..Attached::default()
        };
        assert_eq!(
            lines(&found)[..3],
            [
                "usb 001:007  may not be opened: this user may not open it  0fe7:4001",
                "  put into /etc/udev/rules.d/70-acies.rules:",
                "  SUBSYSTEM==\"usb\"",
            ]
        );
        assert_eq!(
            lines(&Attached::default())[0],
            "no serial port and no USB device found"
        );
    }
}
