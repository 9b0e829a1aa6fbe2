//! USB devices: transfers to and from the endpoints of a device that is found by its names, never by its address.
//!
//! [`UsbLink`] is what a driver sees; [`open`] gives one over libusb. Every opening takes a new libusb context: a context that lives on does not see a
//! device that was plugged in again where no udev runs. Where libusb cannot start (no USB in the kernel, no /dev/bus/usb in a container) that is
//! an error of the opening, tried again like any other.
//!
//! A read is one transfer into one buffer; between two reads nothing is queued, and the device holds what it has. [`UsbLink::stream`] keeps several
//! transfers in flight, so that a device with little memory loses nothing.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use acies_usb_queue::Queue;
use rusb::UsbContext;

use super::left;
use crate::device::Claim;
use crate::error::LinkError;

/// Which device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct UsbTarget {
    /// Vendor and product number.
    pub id: Option<(u16, u16)>,
    /// Serial number in its descriptors: the same wherever it is plugged in.
    pub serial: Option<String>,
    /// Class, subclass and protocol of an interface that it must have.
    pub interface: Option<[u8; 3]>,
}

impl UsbTarget {
    /// What the device must have for itself.
    pub fn claim(&self) -> Claim {
        Claim::Port(self.to_string())
    }
}

impl fmt::Display for UsbTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.serial, self.id) {
            (Some(serial), _) => write!(f, "usb:{serial}"),
            (None, Some((vendor, product))) => write!(f, "usb:{vendor:04x}:{product:04x}"),
            (None, None) => write!(f, "usb:any"),
        }
    }
}

/// An interface of a device, in its first setting.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct UsbInterface {
    /// Its number.
    pub number: u8,
    /// Class, subclass, protocol.
    pub class: [u8; 3],
    /// Its endpoints.
    pub endpoints: Vec<UsbEndpoint>,
}

/// An endpoint of an interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UsbEndpoint {
    /// Address; bit 7 is set for IN.
    pub address: u8,
    /// 2 bulk, 3 interrupt.
    pub kind: u8,
    /// Most bytes of one packet.
    pub packet: u16,
}

impl UsbInterface {
    /// The first endpoint of this kind and direction.
    pub fn endpoint(&self, kind: u8, input: bool) -> Option<UsbEndpoint> {
        let fits = |e: &&UsbEndpoint| e.kind == kind && (e.address & 0x80 != 0) == input;
        self.endpoints.iter().find(fits).copied()
    }
}

/// The interfaces that a configuration descriptor with all that belongs to it lists; what is cut off or makes no sense is passed over.
pub fn interfaces(configuration: &[u8]) -> Vec<UsbInterface> {
    let mut found: Vec<UsbInterface> = Vec::new();
    let mut first_setting = false;
    let mut rest = configuration;
    while let [length, kind, ..] = *rest {
        let Some(one) = rest.get(..usize::from(length)).filter(|one| one.len() >= 2) else {
            break;
        };
        match (kind, one.len()) {
            (4, 9..) => {
                first_setting = one[3] == 0;
                if first_setting {
                    found.push(UsbInterface {
                        number: one[2],
                        class: [one[5], one[6], one[7]],
                        endpoints: Vec::new(),
                    });
                }
            }
            (5, 7..) if first_setting => {
                if let Some(last) = found.last_mut() {
                    last.endpoints.push(UsbEndpoint {
                        address: one[2],
                        kind: one[3] & 3,
                        packet: u16::from_le_bytes([one[4], one[5]]) & 0x7FF,
                    });
                }
            }
            _ => {}
        }
        rest = &rest[one.len()..];
    }
    found
}

/// A request on the control endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request {
    /// bmRequestType; bit 7 is set for IN.
    pub kind: u8,
    /// bRequest.
    pub request: u8,
    /// wValue.
    pub value: u16,
    /// wIndex.
    pub index: u16,
}

impl Request {
    /// The eight bytes of the setup packet, for so many bytes of data.
    pub fn setup(&self, length: usize) -> [u8; 8] {
        let [v0, v1] = self.value.to_le_bytes();
        let [i0, i1] = self.index.to_le_bytes();
        let [l0, l1] = u16::try_from(length).unwrap_or(u16::MAX).to_le_bytes();
        [self.kind, self.request, v0, v1, i0, i1, l0, l1]
    }
}

/// Descriptors from which [`interfaces`] reads these again.
pub(crate) fn descriptors(interfaces: &[UsbInterface]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for interface in interfaces {
        let [a, b, c] = interface.class;
        // An interface has at most 30 endpoints.
        let count = interface.endpoints.len() as u8;
        bytes.extend([9, 4, interface.number, 0, count, a, b, c, 0]);
        for endpoint in &interface.endpoints {
            let [low, high] = endpoint.packet.to_le_bytes();
            bytes.extend([7, 5, endpoint.address, endpoint.kind, low, high, 0]);
        }
    }
    bytes
}

/// The channel of an endpoint in a recording whose control endpoint has `first`.
pub(crate) fn channel_of(endpoints: &[u8], first: u8, endpoint: u8) -> u8 {
    let place = endpoints.iter().position(|e| *e == endpoint);
    let place = place.and_then(|place| u8::try_from(place + 1).ok());
    first.saturating_add(place.unwrap_or(u8::MAX))
}

/// An open USB device. One thread may read an endpoint while others use others; dropping the last handle closes it.
///
/// All transfers answer `None` when nothing passed before the deadline. `Some(0)` is a packet of no bytes.
pub trait UsbLink: Send + Sync {
    /// Its interfaces.
    fn interfaces(&self) -> &[UsbInterface];
    /// Takes an interface for this program, from the kernel's driver where one has it.
    ///
    /// # Errors
    /// [`LinkError::Busy`] when another program has it.
    fn claim(&self, interface: u8) -> Result<(), LinkError>;
    /// A request that brings bytes.
    ///
    /// # Errors
    /// [`LinkError::Stalled`] when the device refuses, [`LinkError::Gone`] when it is not there any more.
    fn control_in(
        &self,
        request: Request,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError>;
    /// A request that takes bytes.
    ///
    /// # Errors
    /// As [`UsbLink::control_in`].
    fn control_out(
        &self,
        request: Request,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError>;
    /// One transfer from a bulk or interrupt endpoint. A transfer that the deadline cuts off answers what had come.
    ///
    /// # Errors
    /// [`LinkError::Stalled`]: nothing passes until [`UsbLink::clear_halt`]; [`LinkError::Overflow`]; [`LinkError::Gone`].
    fn read(
        &self,
        endpoint: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError>;
    /// When the last transfer from an endpoint came, asked by who read it: now, but where a recording is played back, which knows it.
    fn received(&self, endpoint: u8) -> Instant {
        let _ = endpoint;
        Instant::now()
    }
    /// One transfer to a bulk endpoint.
    ///
    /// # Errors
    /// As [`UsbLink::read`].
    fn write(
        &self,
        endpoint: u8,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError>;
    /// Transfers from a bulk endpoint one after the other, each of at most `bytes`, with so many in flight at once where the link can.
    ///
    /// # Errors
    /// [`LinkError::Io`] where there is no memory for the buffers.
    fn stream(
        &self,
        endpoint: u8,
        transfers: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError>;
    /// Ends a stall of an endpoint. Nothing may be in flight on it.
    ///
    /// # Errors
    /// [`LinkError::Gone`] when the device is not there any more.
    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError>;
}

/// Transfers that come from an endpoint; those in flight are ended when it is dropped, and what they had read is lost.
pub trait UsbStream {
    /// The bytes of the next transfer, as of [`UsbLink::read`].
    ///
    /// # Errors
    /// As [`UsbLink::read`]; after an error nothing is in flight until the next call.
    fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>, LinkError>;
    /// When the last transfer came, as of [`UsbLink::received`].
    fn received(&self) -> Instant {
        Instant::now()
    }
}

/// A stream of a link that has one transfer in flight at a time.
pub struct OneByOne<'a> {
    link: &'a dyn UsbLink,
    endpoint: u8,
    buffer: Vec<u8>,
}

impl<'a> OneByOne<'a> {
    /// Of transfers of at most so many bytes.
    pub fn new(link: &'a dyn UsbLink, endpoint: u8, bytes: usize) -> OneByOne<'a> {
        OneByOne {
            link,
            endpoint,
            buffer: vec![0; bytes],
        }
    }
}

impl UsbStream for OneByOne<'_> {
    fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>, LinkError> {
        let n = self.link.read(self.endpoint, &mut self.buffer, deadline)?;
        Ok(n.map(|n| &self.buffer[..n]))
    }

    fn received(&self) -> Instant {
        self.link.received(self.endpoint)
    }
}

/// The rule that lets a user at this computer open such a device, and the file it belongs in.
pub fn udev_rule(vendor: u16, product: u16) -> (&'static str, String) {
    let rule = format!(
        "SUBSYSTEM==\"usb\", ATTR{{idVendor}}==\"{vendor:04x}\", ATTR{{idProduct}}==\"{product:04x}\", MODE=\"0660\", GROUP=\"plugdev\", TAG+=\"uaccess\""
    );
    ("/etc/udev/rules.d/70-acies.rules", rule)
}

// ---- libusb -----------------------------------------------------------------------------------------------------------

/// Least wait that libusb can be told; zero would mean for ever.
const LEAST_WAIT: Duration = Duration::from_millis(1);
/// Most bytes of a configuration descriptor with all that belongs to it.
const CONFIGURATION_MAX: usize = 4096;
/// What failed, in errors of a stream.
const STREAMING: &str = "reading its stream";
/// How long descriptors are waited for.
const DESCRIPTORS: Duration = Duration::from_secs(1);

/// Opens the one device that `target` names.
///
/// # Errors
/// libusb cannot start; no such device, several, not permitted, in use: each is told apart.
pub fn open(target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
    let context = rusb::Context::new().map_err(|error| LinkError::NoUsb {
        reason: error.to_string(),
    })?;
    let devices = context.devices().map_err(|error| LinkError::NoUsb {
        reason: error.to_string(),
    })?;
    let mut found = Vec::new();
    let mut refused = None;
    for device in devices.iter() {
        match candidate(&device, target) {
            Ok(Some(handle)) => found.push((place(&device), handle)),
            Ok(None) => {}
            Err(error) => refused = refused.or(Some(error)),
        }
    }
    match found.len() {
        0 => Err(refused.unwrap_or(LinkError::NotFound)),
        1 => Ok(Arc::new(Device::new(found.remove(0).1)?)),
        _ => Err(LinkError::AmbiguousUsb {
            devices: found.into_iter().map(|(place, _)| place).collect(),
        }),
    }
}

type Handle = rusb::DeviceHandle<rusb::Context>;

fn place(device: &rusb::Device<rusb::Context>) -> String {
    format!("bus {} address {}", device.bus_number(), device.address())
}

/// The open device where it is the one; an error where it may be and cannot be opened.
fn candidate(
    device: &rusb::Device<rusb::Context>,
    target: &UsbTarget,
) -> Result<Option<Handle>, LinkError> {
    let Ok(descriptor) = device.device_descriptor() else {
        return Ok(None);
    };
    let id = (descriptor.vendor_id(), descriptor.product_id());
    let same_id = target.id.is_none_or(|wanted| wanted == id);
    if !same_id
        || !target
            .interface
            .is_none_or(|class| has_interface(device, class))
    {
        return Ok(None);
    }
    let handle = device.open().map_err(|error| match error {
        rusb::Error::Access => {
            let (file, rule) = udev_rule(id.0, id.1);
            LinkError::UsbDenied { file, rule }
        }
        error => failure(error, "opening the device").unwrap_or(LinkError::Gone),
    })?;
    let serial = handle.read_serial_number_string_ascii(&descriptor).ok();
    let same_serial = target.serial.is_none() || target.serial == serial;
    Ok(same_serial.then_some(handle))
}

fn has_interface(device: &rusb::Device<rusb::Context>, class: [u8; 3]) -> bool {
    let Ok(configuration) = device.config_descriptor(0) else {
        return false;
    };
    configuration.interfaces().any(|interface| {
        interface.descriptors().any(|setting| {
            let [a, b, c] = class;
            (
                setting.class_code(),
                setting.sub_class_code(),
                setting.protocol_code(),
            ) == (a, b, c)
        })
    })
}

/// What a failed transfer means: `None` is "not yet".
fn failure(error: rusb::Error, action: &'static str) -> Option<LinkError> {
    Some(match error {
        rusb::Error::Timeout | rusb::Error::Interrupted => return None,
        rusb::Error::Pipe => LinkError::Stalled,
        rusb::Error::NoDevice | rusb::Error::NotFound => LinkError::Gone,
        rusb::Error::Busy => LinkError::Busy,
        rusb::Error::Overflow => LinkError::Overflow,
        error => LinkError::Io {
            action,
            source: std::io::Error::other(error.to_string()),
        },
    })
}

/// A device over libusb.
struct Device {
    handle: Handle,
    interfaces: Vec<UsbInterface>,
}

impl Device {
    fn new(handle: Handle) -> Result<Device, LinkError> {
        // The kernel's driver of an interface steps aside while it is claimed; systems without such drivers do not know the call.
        let _ = handle.set_auto_detach_kernel_driver(true);
        let mut device = Device {
            handle,
            interfaces: Vec::new(),
        };
        let mut configuration = [0; CONFIGURATION_MAX];
        let get_descriptor = Request {
            kind: 0x80,
            request: 6,
            value: 0x0200,
            index: 0,
        };
        let deadline = Instant::now() + DESCRIPTORS;
        let n = device.control_in(get_descriptor, &mut configuration, deadline)?;
        device.interfaces = interfaces(&configuration[..n.unwrap_or(0)]);
        Ok(device)
    }

    fn is_interrupt(&self, endpoint: u8) -> bool {
        let all = self.interfaces.iter().flat_map(|i| &i.endpoints);
        all.clone().any(|e| e.address == endpoint && e.kind == 3)
    }
}

/// Time for one transfer.
fn wait(deadline: Instant) -> Duration {
    left(deadline).max(LEAST_WAIT)
}

fn passed(answer: rusb::Result<usize>, action: &'static str) -> Result<Option<usize>, LinkError> {
    match answer {
        Ok(n) => Ok(Some(n)),
        Err(error) => failure(error, action).map_or(Ok(None), Err),
    }
}

impl UsbLink for Device {
    fn interfaces(&self) -> &[UsbInterface] {
        &self.interfaces
    }

    fn claim(&self, interface: u8) -> Result<(), LinkError> {
        self.handle
            .claim_interface(interface)
            .map_err(|error| failure(error, "claiming an interface").unwrap_or(LinkError::Busy))
    }

    fn control_in(
        &self,
        request: Request,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let Request {
            kind,
            request,
            value,
            index,
        } = request;
        let wait = wait(deadline);
        let read = self
            .handle
            .read_control(kind, request, value, index, buffer, wait);
        passed(read, "a control transfer")
    }

    fn control_out(
        &self,
        request: Request,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let Request {
            kind,
            request,
            value,
            index,
        } = request;
        let wait = wait(deadline);
        let written = self
            .handle
            .write_control(kind, request, value, index, bytes, wait);
        passed(written, "a control transfer")
    }

    fn read(
        &self,
        endpoint: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let wait = wait(deadline);
        let read = match self.is_interrupt(endpoint) {
            true => self.handle.read_interrupt(endpoint, buffer, wait),
            false => self.handle.read_bulk(endpoint, buffer, wait),
        };
        passed(read, "reading")
    }

    fn write(
        &self,
        endpoint: u8,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        passed(
            self.handle.write_bulk(endpoint, bytes, wait(deadline)),
            "writing",
        )
    }

    fn stream(
        &self,
        endpoint: u8,
        transfers: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        let queue = Queue::new(&self.handle, endpoint, transfers, bytes);
        let queue = queue.map_err(|error| failure(error, STREAMING).unwrap_or(LinkError::Gone))?;
        Ok(Box::new(Queued(queue)))
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError> {
        self.handle
            .clear_halt(endpoint)
            .map_err(|error| failure(error, "clearing a stall").unwrap_or(LinkError::Gone))
    }
}

/// Transfers in flight over libusb.
struct Queued<'a>(Queue<'a>);

impl UsbStream for Queued<'_> {
    fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>, LinkError> {
        match self.0.next(deadline) {
            Ok(bytes) => Ok(bytes),
            Err(error) => failure(error, STREAMING).map_or(Ok(None), Err),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_read_as_far_as_they_make_sense() {
        let mut bytes = vec![9, 2, 41, 0, 1, 1, 0, 0x80, 50];
        bytes.extend([9, 4, 0, 0, 2, 0xEF, 5, 0, 0]);
        bytes.extend([7, 5, 0x81, 2, 0, 4, 0]);
        bytes.extend([
            20, 0x24, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        ]);
        bytes.extend([7, 5, 0x01, 2, 0, 2, 0]);
        bytes.extend([9, 4, 0, 1, 1, 0xEF, 5, 0, 0]);
        bytes.extend([7, 5, 0x83, 2, 0, 2, 0]);
        let found = interfaces(&bytes);
        assert_eq!(found.len(), 1, "other settings are passed over");
        assert_eq!(found[0].class, [0xEF, 5, 0]);
        assert_eq!(
            found[0].endpoint(2, true).map(|e| (e.address, e.packet)),
            Some((0x81, 1024))
        );
        assert_eq!(found[0].endpoint(2, false).map(|e| e.address), Some(1));
        assert_eq!(found[0].endpoint(3, true), None);
        for cut in 0..bytes.len() {
            assert!(interfaces(&bytes[..cut]).len() <= 1);
        }
        assert_eq!(interfaces(&[0, 0, 0]), []);
    }

    #[test]
    fn failures_are_told_apart() {
        let told = |error| failure(error, "reading").map(|error| error.to_string());
        assert_eq!(told(rusb::Error::Timeout), None);
        assert_eq!(
            told(rusb::Error::NoDevice).as_deref(),
            Some("it is gone: closed or unplugged; plug it in again and reopen")
        );
        assert_eq!(
            told(rusb::Error::Pipe).as_deref(),
            Some("the device refuses the transfer (stall); reopen it")
        );
        assert_eq!(told(rusb::Error::NoMem).as_deref(), Some("reading failed"));
        let (file, rule) = udev_rule(0x0fe7, 0x4001);
        assert_eq!(
            LinkError::UsbDenied { file, rule }.to_string(),
            "this user may not open it; put the line SUBSYSTEM==\"usb\", ATTR{idVendor}==\"0fe7\", ATTR{idProduct}==\"4001\", MODE=\"0660\", GROUP=\"plugdev\", TAG+=\"uaccess\" into /etc/udev/rules.d/70-acies.rules, then plug it in again"
        );
    }

    #[test]
    fn a_device_that_is_not_there_is_told_and_libusb_that_cannot_start_too() {
        let target = UsbTarget {
            serial: Some("no such device".into()),
            ..UsbTarget::default()
        };
        let error = open(&target).err().expect("no such device");
        assert!(
            matches!(error, LinkError::NotFound | LinkError::NoUsb { .. }),
            "{error}"
        );
        assert_eq!(target.to_string(), "usb:no such device");
    }
}
