//! The other end of every wire: exact scenes, a sensor model, and devices played from their manuals. Uses nothing of ours, so
//! that a misreading in a driver cannot repeat itself here.
//!
//! In reading order: [`scene`] (exact solids and their true edges), [`sensor`] (what a profiler sees of them), [`demo_part`] and
//! [`demo_cell`] (the demo's part and cell), [`pty`] (wires), [`faults`] (how a device misbehaves), [`point`] (what sensors of
//! single points share), then one file a device.

#![forbid(unsafe_code)]

pub mod pose;

pub mod scene;

pub mod sensor;

pub mod demo_part;

pub mod faults;

pub mod pty;

pub mod wire;

pub mod open_profile;

pub mod carried;

pub mod ur_rtde;

pub mod gocator;

pub mod ippdme;

pub mod usb;

pub mod u3v;

pub mod usb_itn;

pub mod contact;

pub mod grbl;

pub mod point;

pub mod optoncdt;

pub mod rf60x;

pub mod gauge;

pub mod demo_cell;

pub mod devices;
