//! The page's files, inside the program.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use rust_embed::{Embed, EmbeddedFile};

use super::app::App;
use super::problem::{Place, Problem};

#[derive(Embed)]
#[folder = "src/web/page"]
struct Page;

/// The table of texts, which the report has too.
#[derive(Embed)]
#[folder = "src/words"]
struct Words;

/// The page.
pub(super) async fn page(State(_): State<App>, headers: HeaderMap) -> Response {
    match Page::get("index.html") {
        Some(file) => answer(&headers, "index.html", file),
        None => Problem::fault("the program has no page").into_response(),
    }
}

/// One of its files.
pub(super) async fn file(Place(path): Place<String>, headers: HeaderMap) -> Response {
    let found = match path.as_str() {
        "texts.json" => Words::get(&path),
        _ => Page::get(&path),
    };
    match found {
        Some(file) => answer(&headers, &path, file),
        None => Problem::missing("the page has no such file").into_response(),
    }
}

fn answer(headers: &HeaderMap, path: &str, file: EmbeddedFile) -> Response {
    let hash = file.metadata.sha256_hash();
    let tag: String = hash
        .iter()
        .take(16)
        .map(|byte| format!("{byte:02x}"))
        .collect();
    let tag = format!("\"{tag}\"");
    let known = headers.get(header::IF_NONE_MATCH);
    let known = known.and_then(|known| known.to_str().ok());
    // A compressed answer has a weak tag; the content is the same.
    let same = known.is_some_and(|known| {
        known
            .split(',')
            .any(|one| one.trim().trim_start_matches("W/") == tag)
    });
    let mut answer = if same {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        Body::from(file.data).into_response()
    };
    let headers = answer.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind(path)));
    // Asked for anew each time, and not sent where it is the same: a new version of the daemon is seen at once.
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Ok(tag) = HeaderValue::try_from(tag) {
        headers.insert(header::ETAG, tag);
    }
    answer
}

fn kind(path: &str) -> &'static str {
    match path.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("json") => "application/json",
        Some("svg") => "image/svg+xml",
        _ => "application/octet-stream",
    }
}
