//! The routes put together, and what holds for every answer.

use std::future::Future;
use std::io;
use std::sync::Arc;

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::Method;
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{DefaultPredicate, NotForContentType, Predicate};

use super::app::App;
use super::problem::unknown;
use super::{access, api, assets, metrics, server};
use crate::cell::Handle;
use crate::config::Service;

/// Largest body of a request, bytes; recipes, which carry a nominal, may have more.
const BODY_MAX: usize = 1 << 20;

/// What the page may load: its own files, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
    frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Serves the cell behind `handle` until `stop` is ready; requests under way then get 3 s to end.
///
/// # Errors
/// When certificate and key cannot be read.
pub async fn serve_cell(
    listener: TcpListener,
    handle: Handle,
    service: Service,
    stop: impl Future<Output = ()> + Send + 'static,
) -> io::Result<()> {
    let tls = match &service.tls {
        Some((certificate, key)) => Some(server::tls(certificate, key)?),
        None => None,
    };
    let loopback = listener.local_addr()?.ip().is_loopback();
    let (stopping, stopped) = watch::channel(false);
    let app = App::new(handle, service, loopback, stopped);
    server::run(listener, tls, router(app), stopping, stop).await
}

/// The description of the API as JSON text: OpenAPI 3.1.
pub fn openapi() -> String {
    api::routes().1
}

fn router(app: App) -> Router {
    let (api, description) = api::routes();
    let compressed =
        DefaultPredicate::new().and(NotForContentType::new("application/octet-stream"));
    Router::new()
        .route("/", get(assets::page))
        .route("/page/{*file}", get(assets::file))
        .route("/healthz", get(metrics::healthz))
        .route("/readyz", get(metrics::readyz))
        .route("/metrics", get(metrics::metrics))
        .route("/api/v1/openapi.json", get(described))
        .merge(api)
        .fallback(unknown)
        .layer(DefaultBodyLimit::max(BODY_MAX))
        .layer(from_fn_with_state(app.clone(), access::guard))
        .layer(CompressionLayer::new().compress_when(compressed))
        .layer(from_fn_with_state(app.clone(), everywhere))
        .layer(Extension(Description(description.into())))
        .with_state(app)
}

#[derive(Clone)]
struct Description(Arc<str>);

async fn described(Extension(Description(text)): Extension<Description>) -> Response {
    (
        [(header::CONTENT_TYPE, "application/json")],
        text.to_string(),
    )
        .into_response()
}

/// Headers that hold for every answer, and the count of answers.
async fn everywhere(State(app): State<App>, request: Request, next: Next) -> Response {
    let method = match *request.method() {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::PATCH => "PATCH",
        Method::DELETE => "DELETE",
        // A client may make up any word; each would be one more time series.
        _ => "other",
    };
    let mut answer = next.run(request).await;
    app.requests().count(method, answer.status());
    let headers = answer.headers_mut();
    let fixed = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
        (
            HeaderName::from_static("cross-origin-opener-policy"),
            "same-origin",
        ),
        (
            HeaderName::from_static("permissions-policy"),
            "camera=(), microphone=(), geolocation=()",
        ),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    // What a route says itself stays: the report has a policy of its own, the page's files may be kept.
    let policy = HeaderValue::from_static(POLICY);
    headers
        .entry(header::CONTENT_SECURITY_POLICY)
        .or_insert(policy);
    let fresh = HeaderValue::from_static("no-store");
    headers.entry(header::CACHE_CONTROL).or_insert(fresh);
    if app.service().tls.is_some() {
        // A browser that was here once never speaks plain HTTP to this name again, for a year.
        let year = HeaderValue::from_static("max-age=31536000");
        headers.insert(header::STRICT_TRANSPORT_SECURITY, year);
    }
    answer
}
