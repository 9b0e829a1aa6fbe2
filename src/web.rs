//! The report over HTTP: the page, its data forms and the scan. What is shown can be replaced while people look at it.
//!
//! Hides the server. [`serve`] listens where the caller says and stops when the caller says; nothing can be changed from
//! outside through it.

mod service;

use std::convert::Infallible;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{Method, Response, StatusCode};
use axum::middleware::{self, Next};
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::{oneshot, watch};

use crate::report::{Report, content_security_policy};

pub use service::serve_cell;

/// Everything that is shown of one inspection, ready to be sent.
#[derive(Debug, Clone, Default)]
pub struct Content {
    html: Bytes,
    json: Bytes,
    csv: Bytes,
    ply: Option<Bytes>,
    made: String,
}

impl Content {
    /// The forms of `report`, made once, and beside them the scan as a PLY file where there is one.
    pub fn new(report: &Report, scan_ply: Option<Vec<u8>>) -> Self {
        let mut links = vec![("/report.json", "JSON"), ("/report.csv", "CSV")];
        if scan_ply.is_some() {
            links.push(("/scan.ply", "scan as PLY"));
        }
        Content {
            html: report.to_html_with_links(&links).into(),
            json: report.to_json().into(),
            csv: report.to_csv().into(),
            ply: scan_ply.map(Into::into),
            made: report.created.clone(),
        }
    }
}

/// What the server reads from: the newest content, or none before the first inspection.
#[derive(Debug, Clone)]
pub struct Pages {
    newest: watch::Receiver<Option<Arc<Content>>>,
}

/// Replaces what the server shows; requests under way end with what they began with.
#[derive(Debug, Clone)]
pub struct Publisher {
    newest: watch::Sender<Option<Arc<Content>>>,
}

impl Publisher {
    /// Shows `content` from the next request on.
    pub fn publish(&self, content: Content) {
        self.newest.send_replace(Some(Arc::new(content)));
    }
}

/// Pages without content yet, and the publisher that fills them.
pub fn pages() -> (Publisher, Pages) {
    let (sender, receiver) = watch::channel(None);
    (Publisher { newest: sender }, Pages { newest: receiver })
}

/// How long requests under way may take to end after the stop: a client that never finishes must not hold the daemon.
const GRACE: Duration = Duration::from_secs(3);

/// Serves `pages` on `listener` until `stop` is ready; requests under way then get 3 s to end.
///
/// `/` the page, `/report.json`, `/report.csv`, `/scan.ply`, `/healthz`. GET and HEAD only.
///
/// # Errors
/// When the listener fails for good.
pub async fn serve(
    listener: TcpListener,
    pages: Pages,
    stop: impl Future<Output = ()> + Send + 'static,
) -> std::io::Result<()> {
    let (stopping, stopped) = oneshot::channel();
    let served = axum::serve(listener, router(pages)).with_graceful_shutdown(async move {
        stop.await;
        // The receiver is gone only when the server has ended already.
        let _ = stopping.send(());
    });
    let patience = async {
        match stopped.await {
            Ok(()) => tokio::time::sleep(GRACE).await,
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        ended = served => ended,
        () = patience => Ok(()),
    }
}

type Answer = Response<Body>;

fn router(pages: Pages) -> Router {
    Router::new()
        .route("/", get(page))
        .route("/report.json", get(json))
        .route("/report.csv", get(csv))
        .route("/scan.ply", get(scan))
        .route("/healthz", get(health))
        .fallback(unknown)
        .method_not_allowed_fallback(refused)
        .layer(middleware::from_fn(secured))
        .with_state(pages)
}

/// Headers that hold for every answer.
async fn secured(request: Request, next: Next) -> Result<Answer, Infallible> {
    let mut answer = next.run(request).await;
    let policy = format!("{}; frame-ancestors 'none'", content_security_policy());
    let fixed = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_FRAME_OPTIONS, "DENY"),
        // What is shown changes with every part.
        (header::CACHE_CONTROL, "no-store"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    for (name, value) in fixed {
        answer
            .headers_mut()
            .insert(name, HeaderValue::from_static(value));
    }
    if let Ok(policy) = HeaderValue::try_from(policy) {
        answer
            .headers_mut()
            .insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    Ok(answer)
}

fn newest(pages: &Pages) -> Option<Arc<Content>> {
    pages.newest.borrow().clone()
}

async fn page(State(pages): State<Pages>) -> Answer {
    match newest(&pages) {
        Some(content) => answer_of(
            StatusCode::OK,
            "text/html; charset=utf-8",
            content.html.clone(),
        ),
        None => nothing_yet(),
    }
}

async fn json(State(pages): State<Pages>) -> Answer {
    match newest(&pages) {
        Some(content) => answer_of(StatusCode::OK, "application/json", content.json.clone()),
        None => nothing_yet(),
    }
}

async fn csv(State(pages): State<Pages>) -> Answer {
    match newest(&pages) {
        Some(content) => {
            let answer = answer_of(
                StatusCode::OK,
                "text/csv; charset=utf-8",
                content.csv.clone(),
            );
            named(answer, "attachment; filename=\"report.csv\"")
        }
        None => nothing_yet(),
    }
}

async fn scan(State(pages): State<Pages>) -> Answer {
    let Some(content) = newest(&pages) else {
        return nothing_yet();
    };
    match &content.ply {
        Some(ply) => {
            let answer = answer_of(StatusCode::OK, "application/octet-stream", ply.clone());
            named(answer, "attachment; filename=\"scan.ply\"")
        }
        None => page_of_words(
            StatusCode::NOT_FOUND,
            "No scan here",
            "This report was published without its scan.",
        ),
    }
}

async fn health(State(pages): State<Pages>) -> Answer {
    let report = newest(&pages).map(|content| content.made.clone());
    let body = serde_json::json!({
        "status": "ok",
        "version": env!("CARGO_PKG_VERSION"),
        "report": report,
    });
    answer_of(StatusCode::OK, "application/json", body.to_string())
}

async fn unknown() -> Answer {
    page_of_words(
        StatusCode::NOT_FOUND,
        "There is nothing at this address",
        "What there is: the report, and its data below.",
    )
}

async fn refused(method: Method) -> Answer {
    let mut answer = page_of_words(
        StatusCode::METHOD_NOT_ALLOWED,
        "This can only be read",
        &format!(
            "{} was asked, only GET and HEAD are answered.",
            shown(&method)
        ),
    );
    answer
        .headers_mut()
        .insert(header::ALLOW, HeaderValue::from_static("GET, HEAD"));
    answer
}

/// A method is any token the client likes; only the usual ones are shown back.
fn shown(method: &Method) -> &str {
    match *method {
        Method::POST | Method::PUT | Method::DELETE | Method::PATCH | Method::OPTIONS => {
            method.as_str()
        }
        _ => "Another method",
    }
}

fn nothing_yet() -> Answer {
    let mut answer = page_of_words(
        StatusCode::SERVICE_UNAVAILABLE,
        "No report yet",
        "The first inspection is still running; reload when it has ended.",
    );
    answer
        .headers_mut()
        .insert(header::RETRY_AFTER, HeaderValue::from_static("2"));
    answer
}

/// A plain page: a title, a sentence, and where to go. Both texts are ours.
fn page_of_words(status: StatusCode, title: &str, sentence: &str) -> Answer {
    let page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>{title}</title></head>\n\
         <body><h1>{title}</h1><p>{sentence}</p><ul><li><a href=\"/\">report</a></li>\
         <li><a href=\"/report.json\">report.json</a></li><li><a href=\"/report.csv\">report.csv</a></li>\
         <li><a href=\"/scan.ply\">scan.ply</a></li><li><a href=\"/healthz\">healthz</a></li></ul></body></html>\n"
    );
    answer_of(status, "text/html; charset=utf-8", page)
}

fn answer_of(status: StatusCode, kind: &'static str, body: impl Into<Body>) -> Answer {
    let mut answer = Response::new(body.into());
    *answer.status_mut() = status;
    answer
        .headers_mut()
        .insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    answer
}

fn named(mut answer: Answer, disposition: &'static str) -> Answer {
    answer.headers_mut().insert(
        header::CONTENT_DISPOSITION,
        HeaderValue::from_static(disposition),
    );
    answer
}
