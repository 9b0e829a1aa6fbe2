//! Drivers against scripted links: handshakes, faults, and the text of every error.

mod documents;
mod grbl_probe;
mod links;
mod open_profile;
mod script;
