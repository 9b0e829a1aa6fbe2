//! Alignment of a scan to the nominal, measurement of every sharp edge, uncertainty, verdict.

pub mod flank;
pub mod result;
pub mod virtual_edge;
