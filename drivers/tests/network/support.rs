//! What the tests of network drivers share.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use acies_drivers::ALL;
use acies_drivers::device::{Instrument, Mistake, Setup};
use acies_drivers::error::DeviceError;
use acies_drivers::link::cable::Cable;

/// Longest wait for something that must happen; long because the machine may be busy.
pub const SOON: Duration = Duration::from_secs(30);

/// A checked table of a driver.
pub fn setup(driver: &str, table: &str) -> Result<Box<dyn Setup>, Vec<Mistake>> {
    let driver = ALL.iter().find(|known| known.name == driver);
    let driver = driver.expect("a driver of this name");
    (driver.configure)(toml::from_str(table).expect("the test's TOML"))
}

/// Opens over the network of this computer.
pub fn open(driver: &str, table: &str) -> Result<Instrument, DeviceError> {
    let setup = setup(driver, table).unwrap_or_else(|mistakes| panic!("{mistakes:?}"));
    setup.open(&Cable)
}

/// The text of why it does not open.
pub fn refusal(driver: &str, table: &str) -> String {
    match open(driver, table) {
        Ok(_) => panic!("it opened"),
        Err(error) => text(&error),
    }
}

/// An error with its sources.
pub fn text(error: &DeviceError) -> String {
    let mut text = error.to_string();
    let mut inner = std::error::Error::source(error);
    while let Some(source) = inner {
        text = format!("{text}: {source}");
        inner = source.source();
    }
    text
}

/// A peer that listens and sends what it was told to whoever comes, then either stays or closes.
pub struct Hostile {
    pub address: SocketAddr,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Hostile {
    pub fn new(bytes: Vec<u8>, stays: bool) -> Hostile {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a listener");
        let address = listener.local_addr().expect("an address");
        let over = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&over);
        let thread = std::thread::spawn(move || {
            let mut clients = Vec::new();
            for stream in listener.incoming() {
                if seen.load(Ordering::SeqCst) {
                    return;
                }
                let Ok(mut stream) = stream else { continue };
                // Waits for the first question, so that the client cannot have closed before.
                let _ = stream.read(&mut [0; 64]);
                let _ = stream.write_all(&bytes);
                if stays {
                    clients.push(stream);
                }
            }
        });
        Hostile {
            address,
            over,
            thread: Some(thread),
        }
    }
}

impl Drop for Hostile {
    fn drop(&mut self) {
        self.over.store(true, Ordering::SeqCst);
        let _ = std::net::TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("the hostile peer");
        }
    }
}
