//! The page in Firefox, by WebDriver BiDi over its WebSocket: that it works there too. What it does in full is tested in Chromium.
//!
//! Where no Firefox is installed this test says so and is passed by.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::channel;

use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

use super::bench::{LONG, Served};
use super::browser::waiting;

/// The key Enter, as WebDriver writes it.
const ENTER: &str = "\u{E007}";

/// A browser with one page.
struct Firefox {
    process: Child,
    profile: PathBuf,
    socket: WebSocket<TcpStream>,
    number: u64,
    context: String,
}

impl Firefox {
    /// Starts one, or nothing where none is installed.
    fn start() -> Option<Self> {
        if !installed() {
            eprintln!("no Firefox here: the page is not tested in it");
            return None;
        }
        let profile = std::env::temp_dir().join(format!("acies-firefox-{}", std::process::id()));
        let _ = fs::remove_dir_all(&profile);
        fs::create_dir_all(&profile).expect("a folder for the profile");
        let preferences = "user_pref(\"intl.accept_languages\", \"en\");\n\
            user_pref(\"browser.shell.checkDefaultBrowser\", false);\n\
            user_pref(\"datareporting.policy.dataSubmissionEnabled\", false);\n\
            user_pref(\"app.update.enabled\", false);\n";
        fs::write(profile.join("user.js"), preferences).expect("preferences");
        let started = Command::new("firefox")
            .args([
                "--headless",
                "--no-remote",
                "--remote-debugging-port=0",
                "--profile",
            ])
            .arg(&profile)
            .arg("about:blank")
            .env("HOME", &profile)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let mut process = started.expect("the browser starts");
        let told = process.stderr.take().expect("a pipe");
        let (sender, address) = channel();
        // Read to the end: a full pipe would stop the browser.
        std::thread::spawn(move || {
            for line in BufReader::new(told).lines().map_while(Result::ok) {
                if let Some((_, address)) = line.split_once("WebDriver BiDi listening on ws://") {
                    let _ = sender.send(address.trim().to_owned());
                }
            }
        });
        let address = address.recv_timeout(LONG).expect("where it listens");
        let stream = TcpStream::connect(&address).expect("it listens");
        stream.set_read_timeout(Some(LONG)).expect("a timeout");
        let socket = tungstenite::client(format!("ws://{address}/session"), stream);
        let (socket, _) = socket.expect("a WebSocket");
        let mut firefox = Self {
            process,
            profile,
            socket,
            number: 0,
            context: String::new(),
        };
        firefox.ask("session.new", json!({ "capabilities": {} }));
        let tree = firefox.ask("browsingContext.getTree", json!({}));
        let context = tree["contexts"][0]["context"].as_str();
        firefox.context = context.expect("a page").to_owned();
        Some(firefox)
    }

    /// One command and its result.
    fn ask(&mut self, method: &str, params: Value) -> Value {
        self.number += 1;
        let command = json!({ "id": self.number, "method": method, "params": params });
        let sent = self.socket.send(Message::text(command.to_string()));
        sent.expect("it listens");
        loop {
            let message = self.socket.read().expect("an answer");
            let Message::Text(text) = message else {
                continue;
            };
            let mut answer: Value = serde_json::from_str(&text).expect("JSON");
            if answer["id"] == self.number {
                assert_eq!(answer["type"], "success", "{method}: {answer}");
                return answer["result"].take();
            }
        }
    }

    fn open(&mut self, address: &str) {
        let params = json!({ "context": self.context, "url": address, "wait": "complete" });
        self.ask("browsingContext.navigate", params);
    }

    fn value(&mut self, expression: &str) -> String {
        let params = json!({ "expression": expression, "awaitPromise": true, "target": { "context": self.context } });
        let found = self.ask("script.evaluate", params);
        let value = found["result"]["value"].as_str();
        value
            .unwrap_or_else(|| panic!("{expression}: {found}"))
            .to_owned()
    }

    fn until(&mut self, condition: &str) {
        let found = self.value(&waiting(condition));
        assert_eq!(found, "yes", "waited for: {condition}");
    }

    /// Keys as a barcode scanner sends them.
    fn typed(&mut self, text: &str) {
        let keys = text.chars().flat_map(|key| {
            ["keyDown", "keyUp"].map(|way| json!({ "type": way, "value": key.to_string() }))
        });
        let keys: Vec<Value> = keys.collect();
        let actions = json!([{ "type": "key", "id": "scanner", "actions": keys }]);
        let params = json!({ "context": self.context, "actions": actions });
        self.ask("input.performActions", params);
    }
}

impl Drop for Firefox {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
        let _ = fs::remove_dir_all(&self.profile);
    }
}

#[test]
fn a_part_is_started_watched_judged_and_found_again_in_firefox() {
    let Some(mut page) = Firefox::start() else {
        return;
    };
    let cell = Served::with_devices("firefox");
    page.open(&format!("http://{}/", cell.address));
    let word = "document.querySelector('#verdict').textContent";
    let mut verdict = String::new();
    // On a machine that is far too busy a simulated device may answer too late, and is then rightly taken for lost.
    for serial in ["SN-1", "SN-2", "SN-3"] {
        page.until(
            "!document.querySelector('#start').disabled && document.activeElement.id === 'serial'",
        );
        page.typed(&format!("{serial}{ENTER}"));
        page.until(&format!("{word} === 'Scanning'"));
        page.until("Number(document.querySelector('#live-points').textContent.replace(/[^0-9]/g, '')) > 1000");
        page.until(&format!(
            "document.querySelector('#verdict-part').textContent === '{serial}' && ['NOT OK', 'Aborted'].includes({word})"
        ));
        verdict = page.value(word);
        if verdict == "NOT OK" {
            break;
        }
    }
    assert_eq!(verdict, "NOT OK");
    page.until("document.querySelector('#reason').textContent.includes('outside its limits')");
    page.until("document.querySelector('#result li .badge').dataset.verdict === 'not_ok'");
    page.value("location.hash = '#/history'");
    page.until("document.querySelector('#list tbody tr .badge')?.textContent.includes('not OK')");
    page.value("(() => { document.querySelector('#list tbody a').click(); return ''; })()");
    page.until("document.querySelector('#report')?.contentDocument?.querySelector('h1, header')");
}

fn installed() -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| Path::new(&folder).join("firefox").is_file())
}
