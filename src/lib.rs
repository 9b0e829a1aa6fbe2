//! Acies finds the sharp edges of a scanned part and measures each against its nominal NURBS edge.
//!
//! The modules stand in order of dependency: each uses only those above it, and `tests/house.rs` holds them to that.

#![forbid(unsafe_code)]

pub mod points;

pub mod geometry;

pub mod features;

pub mod surface;

pub mod mesh;

pub mod nominal;

pub mod inspect;

pub mod words;

pub mod report;

pub mod acquire;

pub mod store;

pub mod config;

pub mod cell;

pub mod web;

pub mod cli;
