//! The `acies` program.
fn main() {}
