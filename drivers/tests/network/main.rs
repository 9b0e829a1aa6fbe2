//! Network drivers against simulated devices that were written from the same manuals by other eyes, and hostile peers.

mod gocator;
mod ippdme;
mod support;
