//! Bytes to and from a device: serial port, TCP, recorder and replay are one code path.

/// Opens links, so that cable, recorder and replay are the same to a driver.
pub trait Links: Send + Sync {}
