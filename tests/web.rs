//! The cell over HTTP, as those see it who share no code with it: an HTTP client, bytes on a socket, a browser.

#[path = "web/access.rs"]
mod access;
#[path = "web/api.rs"]
mod api;
#[path = "web/bench.rs"]
mod bench;
#[path = "web/browser.rs"]
mod browser;
#[path = "web/document.rs"]
mod document;
#[path = "web/firefox.rs"]
mod firefox;
#[path = "../benches/cell/sockets.rs"]
mod sockets;
#[path = "web/wire.rs"]
mod wire;
