//! A pseudo-terminal as a host meets it.

use std::io::{Read, Write};
use std::thread;

use super::*;

fn link(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("acies-pty-{}-{name}", std::process::id()))
}

fn open(device: &PtyDevice) -> fs::File {
    let options = fs::File::options()
        .read(true)
        .write(true)
        .open(device.link());
    options.unwrap()
}

/// Reads on the device's side until so many bytes are there.
fn take(device: &PtyDevice, n: usize) -> Vec<u8> {
    let mut all = Vec::new();
    let until = Instant::now() + Duration::from_secs(20);
    while all.len() < n && Instant::now() < until {
        let mut buffer = [0; 4096];
        let got = device.read(&mut buffer).unwrap();
        all.extend(&buffer[..got]);
        if got == 0 {
            thread::yield_now();
        }
    }
    all
}

#[test]
fn every_byte_passes_unchanged_both_ways_and_nothing_is_echoed() {
    let device = PtyDevice::plug(&link("raw")).unwrap();
    let bytes: Vec<u8> = (0..=255).collect();
    // before anybody opens it
    assert_eq!(device.write(&bytes).unwrap(), 256);
    assert_eq!(device.read(&mut [0; 16]).unwrap(), 0);
    let mut host = open(&device);
    let mut read = [0; 256];
    host.read_exact(&mut read).unwrap();
    assert_eq!(read[..], bytes[..]);
    host.write_all(&bytes).unwrap();
    assert_eq!(take(&device, 256), bytes);
}

#[test]
fn closing_and_opening_the_port_is_no_unplugging() {
    let device = PtyDevice::plug(&link("reopen")).unwrap();
    for round in 0..3 {
        let mut host = open(&device);
        host.write_all(&[round]).unwrap();
        drop(host);
        assert_eq!(take(&device, 1), [round]);
        assert_eq!(device.read(&mut [0; 4]).unwrap(), 0);
    }
}

#[test]
fn unplugging_waits_until_all_is_read_then_hangs_up() {
    let mut device = PtyDevice::plug(&link("drain")).unwrap();
    let mut host = open(&device);
    let sent = vec![0x5A; 10_000];
    assert_eq!(device.write(&sent).unwrap(), sent.len());
    let reader = thread::spawn(move || {
        let mut all = Vec::<u8>::new();
        let mut buffer = [0_u8; 512];
        // a hang-up is the end, or an error
        while let Ok(n) = host.read(&mut buffer) {
            if n == 0 {
                break;
            }
            all.extend(&buffer[..n]);
        }
        all
    });
    assert!(device.unplug(Duration::from_secs(20)));
    assert_eq!(reader.join().unwrap(), sent);
    assert!(!device.is_plugged());
    assert_eq!(
        device.write(&[1]).unwrap_err().kind(),
        io::ErrorKind::NotConnected
    );
}

#[test]
fn unread_bytes_do_not_hold_an_unplugging_for_ever() {
    let mut device = PtyDevice::plug(&link("impatient")).unwrap();
    device.write(&[1; 100]).unwrap();
    assert!(!device.unplug(Duration::from_millis(30)));
    assert!(fs::symlink_metadata(device.link()).is_err());
}

#[test]
fn it_comes_back_under_the_same_link_as_another_port() {
    let mut device = PtyDevice::plug(&link("back")).unwrap();
    let old = open(&device);
    device.unplug(Duration::ZERO);
    assert!(fs::symlink_metadata(device.link()).is_err());
    device.replug().unwrap();
    let mut host = open(&device);
    device.write(b"again").unwrap();
    let mut read = [0; 5];
    host.read_exact(&mut read).unwrap();
    assert_eq!(&read, b"again");
    // the old handle is dead
    let dead = (&old).read(&mut [0; 4]);
    assert!(matches!(dead, Ok(0) | Err(_)), "{dead:?}");
}

#[test]
fn a_link_left_behind_is_replaced_and_a_folder_that_is_not_there_is_told() {
    let path = link("stale");
    symlink("/dev/null", &path).unwrap();
    let device = PtyDevice::plug(&path).unwrap();
    assert!(fs::read_link(&path).unwrap().starts_with("/dev/pts"));
    drop(device);
    assert!(fs::symlink_metadata(&path).is_err());
    let nowhere = PtyDevice::plug(Path::new("/nonexistent/ttyX")).unwrap_err();
    assert_eq!(nowhere.kind(), io::ErrorKind::NotFound);
}
