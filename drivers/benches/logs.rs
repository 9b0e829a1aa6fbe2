//! Logs of real I++ DME sessions through the reader of responses: how many lines of the server are understood, and which are not.
//!
//! `cargo bench -p acies-drivers --bench logs -- FOLDER`: every `*.log` below the folder, as client (`…Client.log`) and server of the NIST test
//! suite write them: `TIME Sent: LINE`, `TIME Received: LINE`. The suite is US Government work and no part of this project.

#![allow(clippy::print_stdout)] // what a bench is for

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use acies_drivers::error::DecodeError;
use acies_drivers::ippdme::line::{Decoder, Kind, response};

fn main() {
    // `cargo test` runs benches too, without this word.
    if !std::env::args().any(|word| word == "--bench") {
        return;
    }
    let folder = std::env::args().skip(1).find(|word| !word.starts_with('-'));
    let folder = PathBuf::from(folder.expect("a folder with logs"));
    let mut logs = Vec::new();
    find_logs(&folder, &mut logs);
    logs.sort();
    let mut kinds: BTreeMap<&str, usize> = BTreeMap::new();
    let mut refused: BTreeMap<String, usize> = BTreeMap::new();
    let (mut lines, mut understood, mut untouched) = (0, 0, 0);
    for log in &logs {
        let bytes = std::fs::read(log).expect("a log");
        let text = String::from_utf8_lossy(&bytes);
        let before = refused.values().sum::<usize>();
        // Both ends have logged: the client what it received, the server what it sent.
        let of_client = log.to_string_lossy().contains("Client.log");
        let mark = if of_client { " Received: " } else { " Sent: " };
        let of_server = |line| Some(str::trim_end(line).split_once(mark)?.1);
        for sent in text.lines().filter_map(of_server) {
            lines += 1;
            match read(sent) {
                Ok(kind) => {
                    understood += 1;
                    *kinds.entry(kind).or_default() += 1;
                }
                Err(_) => *refused.entry(sent.to_owned()).or_default() += 1,
            }
        }
        untouched += usize::from(refused.values().sum::<usize>() == before);
    }
    println!(
        "{} logs, {lines} lines of the server, {understood} understood, {} not; {untouched} logs understood whole",
        logs.len(),
        lines - understood
    );
    for (kind, count) in kinds {
        println!("  {count:>6} {kind}");
    }
    for (line, count) in refused {
        println!("  not understood, {count} times: {line}");
    }
}

fn find_logs(folder: &Path, logs: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            find_logs(&path, logs);
        } else if path.extension().is_some_and(|of| of == "log") {
            logs.push(path);
        }
    }
}

/// Through the decoder as from the network, and what it is.
fn read(line: &str) -> Result<&'static str, DecodeError> {
    let mut found = Vec::new();
    Decoder::default().take(format!("{line}\r\n").as_bytes(), |line| {
        found.push(line.and_then(response).map(|response| match response.kind {
            Kind::Ack => "acknowledgements",
            Kind::Complete => "completions",
            Kind::Data(_) => "data",
            Kind::Error(_) => "errors",
        }));
    });
    found.swap_remove(0)
}
