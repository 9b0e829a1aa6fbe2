//! Bytes on a socket: heads, limits, slow clients, events, TLS, the end.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;

use serde_json::{Value, json};

use super::bench::{LONG, Served};

fn open(cell: &Served) -> TcpStream {
    let stream = TcpStream::connect(cell.address).expect("the server listens");
    stream
        .set_read_timeout(Some(LONG))
        .expect("a timeout can be set");
    stream
}

/// Sends `bytes` and reads to the end; head in lower case, and body.
fn speak(cell: &Served, bytes: &[u8]) -> (String, String) {
    let mut stream = open(cell);
    stream.write_all(bytes).expect("the server reads");
    let mut answer = Vec::new();
    // A server that has seen enough may reset the connection behind its answer.
    let _ = stream.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer).into_owned();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
    (head.to_lowercase(), body.to_owned())
}

fn ask(cell: &Served, method: &str, path: &str) -> (String, String) {
    let request = format!(
        "{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
        cell.address
    );
    speak(cell, request.as_bytes())
}

#[test]
fn every_answer_has_the_headers_that_protect_it() {
    let cell = Served::without_devices("headers", |_| ());
    for path in [
        "/",
        "/page/app.js",
        "/api/v1/status",
        "/api/v1/nothing",
        "/healthz",
    ] {
        let (head, _) = ask(&cell, "GET", path);
        for needed in [
            "x-content-type-options: nosniff",
            "referrer-policy: no-referrer",
            "cross-origin-resource-policy: same-origin",
            "content-security-policy: default-src 'none'; script-src 'self'; style-src 'self';",
            "frame-ancestors 'none'",
            "cache-control: no-",
        ] {
            assert!(head.contains(needed), "{path}: {needed} in\n{head}");
        }
        assert!(
            !head.contains("unsafe-inline") && !head.contains("unsafe-eval"),
            "{head}"
        );
    }
    let (_, page) = ask(&cell, "GET", "/");
    assert!(
        !page.contains("<script>") && !page.contains("<style") && !page.contains(" onclick="),
        "{page}"
    );
}

#[test]
fn head_gives_the_headers_alone_and_other_methods_are_told_what_is_there() {
    let cell = Served::without_devices("methods", |_| ());
    let (head, body) = ask(&cell, "HEAD", "/api/v1/status");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    assert!(body.is_empty(), "{body}");
    let (head, body) = ask(&cell, "PUT", "/api/v1/status");
    assert!(head.starts_with("http/1.1 405"), "{head}");
    assert!(head.contains("\r\nallow: get,head"), "{head}");
    assert!(body.contains("urn:acies:problem:method"), "{body}");
    let (head, body) = ask(&cell, "<SCRIPT>", "/api/v1/status");
    assert!(
        head.starts_with("http/1.1 400") && !body.contains("SCRIPT"),
        "{head} {body}"
    );
    let (head, _) = ask(&cell, "GET", "/page/..%2f..%2fCargo.toml");
    assert!(head.starts_with("http/1.1 404"), "{head}");
}

#[test]
fn a_file_that_is_known_is_not_sent_again() {
    let cell = Served::without_devices("etag", |_| ());
    let first = cell.get("/page/style.css");
    assert_eq!(first.header("content-type"), "text/css; charset=utf-8");
    let tag = first.header("etag");
    let again = cell.ask("GET", "/page/style.css", None, &[("if-none-match", tag)]);
    assert_eq!((again.status, again.body.len()), (304, 0));
}

#[test]
fn a_body_that_is_too_large_is_refused_before_it_is_read() {
    let cell = Served::without_devices("large", |_| ());
    let request = format!(
        "POST /api/v1/inspections HTTP/1.1\r\nHost: {}\r\nContent-Type: application/json\r\nContent-Length: 2000000000\r\n\r\n",
        cell.address
    );
    let (head, body) = speak(&cell, request.as_bytes());
    assert!(head.starts_with("http/1.1 413"), "{head}");
    assert!(body.contains("urn:acies:problem:body"), "{body}");
    // One byte more than is taken: all of it is read before the answer, so that closing the connection does not overtake it.
    let order = |length: usize| json!({"part_serial": "A", "order_number": "x".repeat(length)});
    let around = order(0).to_string().len();
    let many = order((1 << 20) + 1 - around);
    cell.post("/api/v1/inspections", &many).problem(413, "body");
}

#[test]
fn slow_clients_are_let_go_and_others_served_meanwhile() {
    let cell = Served::without_devices("slow", |_| ());
    let started = std::time::Instant::now();
    let mut head = open(&cell);
    head.write_all(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        .expect("the server reads");
    let mut body = open(&cell);
    let request = "POST /api/v1/inspections HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 50\r\n\r\n{";
    body.write_all(request.as_bytes())
        .expect("the server reads");
    assert_eq!(cell.get("/healthz").status, 200, "others are served");
    let mut answer = Vec::new();
    head.read_to_end(&mut answer)
        .expect("the connection is closed");
    let mut answer = Vec::new();
    // Whether the refusal is still read depends on who closes first; that it ends is what counts.
    let _ = body.read_to_end(&mut answer);
    assert!(started.elapsed() < LONG, "the server ended both");
}

/// Names, ids and data of the first `count` events after event `last`.
fn events_after(cell: &Served, last: &str, count: usize) -> Vec<(String, String, Value)> {
    let mut stream = open(cell);
    let request = format!(
        "GET /api/v1/events HTTP/1.1\r\nHost: {}\r\nLast-Event-ID: {last}\r\n\r\n",
        cell.address
    );
    let sent = stream.write_all(request.as_bytes());
    sent.expect("the server reads");
    let mut seen = Vec::new();
    let mut bytes = [0; 4096];
    // The lines between are heads and lengths of the pieces in which it comes: no event's data ends in the middle of one.
    while seen.windows(2).filter(|end| end == b"\n\n").count() < count {
        let read = stream.read(&mut bytes).expect("more events");
        assert!(read > 0, "{}", String::from_utf8_lossy(&seen));
        seen.extend_from_slice(&bytes[..read]);
    }
    let text = String::from_utf8_lossy(&seen);
    let line = |event: &str, word: &str| {
        let found = event.lines().find_map(|line| line.strip_prefix(word));
        found.unwrap_or_default().to_owned()
    };
    let events = text.split("\n\n").take(count).map(|event| {
        let data = serde_json::from_str(&line(event, "data: ")).expect("JSON");
        (line(event, "event: "), line(event, "id: "), data)
    });
    events.collect()
}

#[test]
fn who_comes_back_to_the_events_gets_what_was_missed() {
    let cell = Served::without_devices("missed", |_| ());
    cell.wait("a cause", |snapshot| {
        snapshot.state == acies::cell::State::Error
    });
    let before = cell.handle().snapshot();
    for command in ["halt", "reset", "halt"] {
        let done = cell.ask("POST", &format!("/api/v1/{command}"), None, &[]);
        assert_eq!(done.status, 204, "{command}");
    }
    let count = (cell.handle().snapshot().sequence - before.sequence) as usize;
    let last = format!("{}/{}", before.started, before.sequence);
    let missed = events_after(&cell, &last, count);
    for (index, (name, id, snapshot)) in missed.iter().enumerate() {
        let sequence = before.sequence + 1 + index as u64;
        assert_eq!(name, "snapshot");
        assert_eq!(id, &format!("{}/{sequence}", before.started));
        assert_eq!(snapshot["sequence"], sequence);
    }
    // Devices that are not there change something now and then too, before the first command as well.
    let mut states: Vec<&Value> = missed.iter().map(|(.., told)| &told["state"]).collect();
    states.dedup();
    let halted = states.iter().filter(|state| **state == "halted");
    assert_eq!(halted.count(), 2, "{states:?}");
    assert_eq!(states[states.len() - 1], "halted", "{states:?}");
    let lost = [
        format!("{}/{}", before.started, u64::MAX),
        format!("1999-01-01T00:00:00.000Z/{}", before.sequence),
        "nonsense".to_owned(),
    ];
    for last in lost {
        let [first, second] = events_after(&cell, &last, 2).try_into().expect("two");
        assert_eq!((first.0.as_str(), first.1.as_str()), ("resync", ""));
        let reason = first.2["reason"].as_str().expect("a reason");
        assert!(reason.contains("last event"), "{reason}");
        assert_eq!(second.0, "snapshot");
        assert_eq!(second.2["state"], "halted");
    }
}

#[test]
fn events_begin_with_what_is_so_and_follow_every_change() {
    let mut cell = Served::without_devices("events", |_| ());
    cell.wait("a cause", |snapshot| {
        snapshot.state == acies::cell::State::Error
    });
    let mut stream = open(&cell);
    let request = format!(
        "GET /api/v1/events HTTP/1.1\r\nHost: {}\r\n\r\n",
        cell.address
    );
    stream
        .write_all(request.as_bytes())
        .expect("the server reads");
    let mut seen = String::new();
    let mut until = |stream: &mut TcpStream, wanted: &str| {
        let mut bytes = [0; 4096];
        while !seen.contains(wanted) {
            let count = stream.read(&mut bytes).expect("more events");
            assert!(count > 0, "{wanted} did not come: {seen}");
            seen.push_str(&String::from_utf8_lossy(&bytes[..count]));
        }
        seen.clone()
    };
    let first = until(&mut stream, "\n\n");
    assert!(first.contains("text/event-stream"), "{first}");
    until(&mut stream, "event: snapshot");
    assert_eq!(cell.ask("POST", "/api/v1/halt", None, &[]).status, 204);
    let halted = until(&mut stream, "\"state\":\"halted\"");
    let id = halted
        .rsplit("id: ")
        .next()
        .and_then(|rest| rest.lines().next())
        .expect("an id")
        .to_owned();
    assert!(id.contains('/'), "the daemon's start is part of it: {id}");
    // The stop ends the stream, which has no end of its own.
    cell.stop();
    let mut rest = Vec::new();
    stream.read_to_end(&mut rest).expect("a regular end");
}

#[test]
fn more_watchers_than_there_are_places_are_told_to_come_back() {
    let cell = Served::without_devices("watchers", |_| ());
    let request = format!(
        "GET /api/v1/events HTTP/1.1\r\nHost: {}\r\n\r\n",
        cell.address
    );
    let watchers: Vec<TcpStream> = (0..64)
        .map(|_| {
            let mut stream = open(&cell);
            stream
                .write_all(request.as_bytes())
                .expect("the server reads");
            let mut first = [0; 15];
            stream.read_exact(&mut first).expect("an answer");
            assert_eq!(&first, b"HTTP/1.1 200 OK");
            stream
        })
        .collect();
    let refused = cell.get("/api/v1/events");
    refused.problem(503, "busy");
    assert_eq!(refused.header("retry-after"), "30");
    assert_eq!(cell.get("/api/v1/status").status, 200, "others are served");
    drop(watchers);
}

#[test]
fn a_client_that_never_finishes_does_not_hold_the_stop() {
    let mut cell = Served::without_devices("stop", |_| ());
    let mut stuck = open(&cell);
    stuck
        .write_all(b"GET / HTTP/1.1\r\n")
        .expect("the server reads");
    // An answered request proves that the server runs and has taken the connection before it.
    assert_eq!(cell.get("/healthz").status, 200);
    cell.stop();
}

#[test]
fn over_tls_the_cookie_is_for_this_host_alone() {
    let made =
        rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).expect("a certificate");
    let cell = Served::without_devices("tls", |service| {
        let folder = service
            .store
            .parent()
            .expect("the cell's folder")
            .to_owned();
        let (certificate, key) = (folder.join("cell.pem"), folder.join("cell.key"));
        std::fs::write(&certificate, made.cert.pem()).expect("a file");
        std::fs::write(&key, made.signing_key.serialize_pem()).expect("a file");
        service.tls = Some((certificate, key));
    });
    let hash = acies::web::hash_password("a long sentence").expect("a good password");
    let added = cell.store.add_person(
        "ada",
        acies::store::Role::Operator,
        &hash,
        std::time::SystemTime::now(),
    );
    added.expect("somebody new");
    let certificate = ureq::tls::Certificate::from_pem(made.cert.pem().as_bytes()).expect("PEM");
    let roots = ureq::tls::RootCerts::Specific(Arc::new(vec![certificate]));
    let tls = ureq::tls::TlsConfig::builder().root_certs(roots).build();
    let agent: ureq::Agent = ureq::Agent::config_builder()
        .tls_config(tls)
        .timeout_global(Some(LONG))
        .build()
        .into();
    let url = format!("https://localhost:{}/api/v1/login", cell.address.port());
    let answer = agent
        .post(&url)
        .send_json(json!({"name": "ada", "password": "a long sentence"}));
    let answer = answer.expect("an answer over TLS");
    let cookie = answer.headers()["set-cookie"]
        .to_str()
        .expect("text")
        .to_owned();
    assert!(
        cookie.starts_with("__Host-acies=") && cookie.contains("; Secure"),
        "{cookie}"
    );
    assert!(answer.headers().contains_key("strict-transport-security"));
    let (plain, _) = ask(&cell, "GET", "/healthz");
    assert!(
        !plain.contains("200 ok"),
        "plain HTTP is not answered: {plain}"
    );
}
