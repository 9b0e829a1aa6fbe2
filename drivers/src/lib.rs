//! Line-laser profilers, touch probes and robots: bytes to captures. A driver knows no geometry.
//!
//! In reading order: [`capture`] (what instruments deliver), [`device`] (the driver contract), [`link`] (bytes to and from a
//! device, recorded and replayed), then one file a driver. To add one: write `<model>.rs`, add a line to [`ALL`].
//! [`point`] is what drivers of single-point sensors share; [`attached`] lists what is plugged in.

#![forbid(unsafe_code)]

pub mod attached;
pub mod capture;
pub mod device;
pub mod error;
pub mod gocator;
pub mod grbl_probe;
pub mod ippdme;
pub mod link;
pub mod open_profile;
pub mod optoncdt;
pub mod point;
pub mod rf60x;
pub mod serial_gauge;
pub mod settings;
pub mod u3v_profiler;
pub mod ur_rtde;
pub mod usb_itn;

/// Every driver, in the order shown to people.
pub static ALL: &[device::Driver] = &[
    open_profile::DRIVER,
    grbl_probe::DRIVER,
    optoncdt::DRIVER,
    rf60x::DRIVER,
    serial_gauge::DRIVER,
    gocator::DRIVER,
    ippdme::DRIVER,
    u3v_profiler::DRIVER,
    usb_itn::DRIVER,
    ur_rtde::DRIVER,
];
