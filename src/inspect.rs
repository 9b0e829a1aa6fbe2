//! Alignment of a scan to the nominal, measurement of every sharp edge, uncertainty, verdict.

pub mod assign;
pub mod body;
mod collect;
pub mod flank;
pub mod measure;
pub mod recipe;
pub mod result;
pub mod virtual_edge;
