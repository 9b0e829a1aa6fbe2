//! Network drivers against simulated devices that were written from the same manuals by other eyes, and hostile peers.

mod cases;
mod configs;
mod conformance;
mod gocator;
mod ippdme;
mod support;
mod ur_rtde;
