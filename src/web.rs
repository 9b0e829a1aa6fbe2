//! The cell over HTTP: the operator's page, the API under `/api/v1`, live events, metrics. One more client of the cell.
//!
//! [`serve_cell`] listens where the caller says and stops when the caller says. Hides the server, who may do what, and the
//! page. Nothing is done through it that does not stand in the audit log.

mod access;
mod api;
mod app;
mod assets;
mod metrics;
mod password;
mod problem;
mod server;
mod service;

pub use password::{PasswordError, check_name, hash_password};
pub use service::{openapi, serve_cell};
