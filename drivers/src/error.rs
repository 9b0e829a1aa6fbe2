//! Errors of links, decoders and devices: where, what was seen, what was expected, what to do.

/// Why a device does not deliver.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// No answer in time.
    #[error("{port}: no answer within {deadline_s} s; check power and cable, then retry")]
    Silent {
        /// Port or address.
        port: String,
        /// How long was waited.
        deadline_s: f64,
    },
}
