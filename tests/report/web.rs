//! The server as a client sees it that shares no code with it: bytes on a socket.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::thread::JoinHandle;
use std::time::Duration;

use acies::web::{self, Content, Publisher};
use tokio::sync::oneshot;

/// A server on a free port, stopped and joined by [`Server::stop`].
struct Server {
    address: SocketAddr,
    publisher: Publisher,
    stop: oneshot::Sender<()>,
    thread: JoinHandle<std::io::Result<()>>,
}

impl Server {
    fn start() -> Self {
        let (publisher, pages) = web::pages();
        let (stop, stopped) = oneshot::channel::<()>();
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("it is bound");
        listener
            .set_nonblocking(true)
            .expect("sockets can be set so");
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()?;
            runtime.block_on(async move {
                let listener = tokio::net::TcpListener::from_std(listener)?;
                web::serve(listener, pages, async { drop(stopped.await) }).await
            })
        });
        Server {
            address,
            publisher,
            stop,
            thread,
        }
    }

    fn stop(self) {
        self.stop
            .send(())
            .expect("the server still waits for the stop");
        self.thread
            .join()
            .expect("the server does not panic")
            .expect("the server ends well");
    }

    fn open(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).expect("the server listens");
        stream
            .set_read_timeout(Some(Duration::from_secs(20)))
            .expect("a timeout can be set");
        stream
    }

    /// Status line and headers in lower case, and the body.
    fn ask(&self, method: &str, path: &str) -> (String, Vec<u8>) {
        let mut stream = self.open();
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: test\r\nConnection: close\r\n\r\n"
        )
        .expect("the server reads");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("the server answers");
        let end = answer
            .windows(4)
            .position(|four| four == b"\r\n\r\n")
            .expect("headers end with an empty line");
        let body = answer.split_off(end + 4);
        (
            String::from_utf8(answer)
                .expect("headers are text")
                .to_lowercase(),
            body,
        )
    }
}

fn content() -> Content {
    Content::new(&super::report(), Some(b"ply\n".to_vec()))
}

#[test]
fn every_form_is_served_with_its_type_and_the_headers_that_protect_it() {
    let server = Server::start();
    server.publisher.publish(content());
    let report = super::report();
    for (path, kind, body) in [
        ("/report.json", "application/json", report.to_json()),
        ("/report.csv", "text/csv; charset=utf-8", report.to_csv()),
        ("/scan.ply", "application/octet-stream", "ply\n".to_owned()),
    ] {
        let (head, got) = server.ask("GET", path);
        assert!(head.starts_with("http/1.1 200"), "{path}: {head}");
        assert!(
            head.contains(&format!("content-type: {kind}\r\n")),
            "{path}: {head}"
        );
        assert!(
            head.contains("x-content-type-options: nosniff"),
            "{path}: {head}"
        );
        assert!(head.contains("frame-ancestors 'none'"), "{path}: {head}");
        assert_eq!(got, body.as_bytes(), "{path}");
    }
    let (head, page) = server.ask("GET", "/");
    assert!(
        head.contains("content-security-policy: default-src 'none'; style-src 'sha256-"),
        "{head}"
    );
    let page = String::from_utf8(page).expect("UTF-8");
    assert!(
        page.contains("href=\"/scan.ply\""),
        "the served page links its other forms"
    );
    server.stop();
}

#[test]
fn head_gives_the_headers_alone() {
    let server = Server::start();
    server.publisher.publish(content());
    let (head, body) = server.ask("HEAD", "/report.json");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    let length = format!("content-length: {}\r\n", super::report().to_json().len());
    assert!(head.contains(&length), "{head}");
    assert!(body.is_empty());
    server.stop();
}

#[test]
fn before_the_first_report_the_page_says_so_and_afterwards_shows_the_newest() {
    let server = Server::start();
    let (head, body) = server.ask("GET", "/");
    assert!(
        head.starts_with("http/1.1 503") && head.contains("retry-after: 2"),
        "{head}"
    );
    assert!(String::from_utf8_lossy(&body).contains("No report yet"));
    let (_, health) = server.ask("GET", "/healthz");
    let health: serde_json::Value = serde_json::from_slice(&health).expect("JSON");
    assert_eq!(
        (&health["status"], &health["report"]),
        (&"ok".into(), &serde_json::Value::Null)
    );

    let mut newer = super::report();
    server.publisher.publish(Content::new(&newer, None));
    newer.part = "the second part".to_owned();
    server.publisher.publish(Content::new(&newer, None));
    let (_, json) = server.ask("GET", "/report.json");
    assert!(String::from_utf8_lossy(&json).contains("the second part"));
    let (head, body) = server.ask("GET", "/scan.ply");
    assert!(head.starts_with("http/1.1 404"), "{head}");
    assert!(String::from_utf8_lossy(&body).contains("published without its scan"));
    server.stop();
}

#[test]
fn what_is_not_there_and_what_is_not_allowed_is_said_in_words() {
    let server = Server::start();
    let (head, body) = server.ask("GET", "/../etc/%3Cscript%3E");
    assert!(head.starts_with("http/1.1 404"), "{head}");
    let body = String::from_utf8_lossy(&body).into_owned();
    assert!(body.contains("There is nothing at this address") && body.contains("/report.json"));
    assert!(
        !body.contains("<script"),
        "the address asked for is not repeated"
    );
    let (head, body) = server.ask("DELETE", "/report.json");
    assert!(
        head.starts_with("http/1.1 405") && head.contains("allow: get, head"),
        "{head}"
    );
    assert!(String::from_utf8_lossy(&body).contains("DELETE was asked, only GET and HEAD"));
    server.stop();
}

#[test]
fn a_client_that_never_finishes_does_not_hold_the_stop() {
    let server = Server::start();
    let mut slow = server.open();
    slow.write_all(b"GET / HTTP/1.1\r\nHost:")
        .expect("the server reads");
    // An answered request proves that the server runs and has taken the connection before it.
    assert!(server.ask("GET", "/healthz").0.starts_with("http/1.1 200"));
    server.stop();
}
