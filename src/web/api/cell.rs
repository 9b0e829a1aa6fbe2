//! The cell as it is now: status, live events, live points, commands.

use std::convert::Infallible;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt as _;
use serde::Deserialize;
use tokio_stream::wrappers::WatchStream;
use utoipa::IntoParams;

use crate::cell::{Command, DeviceStatus, LiveEdges, LiveProfile, Snapshot};
use crate::web::access::Who;
use crate::web::app::{App, blocking};
use crate::web::problem::{Asked, Problem};

/// A comment so often keeps proxies and sockets from taking a quiet stream for a dead one.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// What is so now.
#[utoipa::path(get, path = "/api/v1/status", tag = "cell", responses((status = 200, description = "the cell", body = Snapshot)))]
pub async fn status(State(app): State<App>) -> Json<Snapshot> {
    Json(Snapshot::clone(&app.handle().snapshot()))
}

/// Every device.
#[utoipa::path(get, path = "/api/v1/devices", tag = "cell",
    responses((status = 200, description = "in the order of the configuration", body = Vec<DeviceStatus>)))]
pub async fn devices(State(app): State<App>) -> Json<Vec<DeviceStatus>> {
    Json(app.handle().snapshot().devices.clone())
}

/// The cell as it changes: server-sent events named `snapshot`, each with the whole of `/status`.
///
/// The first one comes at once. With `Last-Event-ID` it comes only where something has changed since; between two events the
/// newest counts, none is owed.
#[utoipa::path(get, path = "/api/v1/events", tag = "cell",
    params(("Last-Event-ID" = Option<String>, Header, description = "the last event that was seen")),
    responses((status = 200, description = "events without end", content_type = "text/event-stream", body = String)))]
pub async fn events(State(app): State<App>, headers: HeaderMap) -> Result<Response, Problem> {
    let place = app.stream_place()?;
    let seen = headers.get("last-event-id");
    let mut seen = seen.and_then(|id| id.to_str().ok()).map(str::to_owned);
    let snapshots = WatchStream::new(app.handle().follow());
    let events = snapshots.filter_map(move |snapshot| {
        // A place is held for as long as the stream lives.
        let _ = &place;
        // A restarted daemon counts anew: its start is part of the name.
        let id = format!("{}/{}", snapshot.started, snapshot.sequence);
        let known = seen.take().is_some_and(|seen| seen == id);
        let event = Event::default().event("snapshot").id(id);
        let event = (!known).then(|| event.json_data(&*snapshot).ok()).flatten();
        std::future::ready(event.map(Ok::<_, Infallible>))
    });
    let events = events.take_until(async move { app.stopped().await });
    let keep_alive = KeepAlive::new().interval(KEEP_ALIVE).text("alive");
    Ok(Sse::new(events).keep_alive(keep_alive).into_response())
}

/// Which of the live points are wanted.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct From {
    /// The generation that is there already: header `Acies-Generation` of the last answer.
    generation: u64,
    /// How many points of it are there already.
    from: usize,
}

/// The points of the scan that runs, or ran last: x, y, z in mm as 32-bit floats, least significant byte first.
///
/// Where the generation is another one than the one asked with, all points are new: what was there before is dropped.
#[utoipa::path(get, path = "/api/v1/live/points", tag = "cell", params(From),
    responses((status = 200, description = "points from `Acies-From` on", content_type = "application/octet-stream", body = Vec<u8>,
        headers(("Acies-Inspection" = i64, description = "the inspection"), ("Acies-Generation" = u64, description = "the generation"),
                ("Acies-From" = u64, description = "index of the first point")))))]
pub async fn live_points(State(app): State<App>, Asked(asked): Asked<From>) -> Response {
    let live = app.handle().live().points(asked.generation, asked.from);
    let mut body = Vec::with_capacity(live.points.len() * 12);
    for number in live.points.iter().flatten() {
        body.extend_from_slice(&number.to_le_bytes());
    }
    let mut answer = super::bytes("application/octet-stream", body).into_response();
    let headers = answer.headers_mut();
    headers.insert("acies-inspection", HeaderValue::from(live.job));
    headers.insert("acies-generation", HeaderValue::from(live.generation));
    headers.insert("acies-from", HeaderValue::from(live.from));
    answer
}

/// The newest profile of every device.
#[utoipa::path(get, path = "/api/v1/live/profiles", tag = "cell",
    responses((status = 200, description = "thinned to what a picture shows", body = Vec<LiveProfile>)))]
pub async fn live_profiles(State(app): State<App>) -> Json<Vec<LiveProfile>> {
    Json(app.handle().live().profiles())
}

/// Which of the live edges are there already.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct Known {
    /// The inspection of the last answer.
    inspection: i64,
    /// Its number.
    number: u64,
}

/// The edges of the part that is being scanned, or was scanned last, as they are measured so far. Nothing is judged before the end.
///
/// Where they are those that are there already, none come.
#[utoipa::path(get, path = "/api/v1/live/edges", tag = "cell", params(Known),
    responses((status = 200, description = "the edges, if they have been measured since", body = LiveEdges)))]
pub async fn live_edges(State(app): State<App>, Asked(known): Asked<Known>) -> Json<LiveEdges> {
    let live = app.handle().live();
    Json(live.edges(known.inspection, known.number))
}

/// End regularly: the part under way is finished, those that wait are not begun.
#[utoipa::path(post, path = "/api/v1/stop", tag = "cell", responses((status = 204, description = "done")))]
pub async fn stop(app: State<App>, who: Who) -> Result<StatusCode, Problem> {
    command(&app, &who, Command::Stop, "cell.stop").await
}

/// Drop the part under way too.
#[utoipa::path(post, path = "/api/v1/abort", tag = "cell", responses((status = 204, description = "done")))]
pub async fn abort(app: State<App>, who: Who) -> Result<StatusCode, Problem> {
    command(&app, &who, Command::Abort, "cell.abort").await
}

/// Take the cell out of operation, aborting what runs.
#[utoipa::path(post, path = "/api/v1/halt", tag = "cell", responses((status = 204, description = "done")))]
pub async fn halt(app: State<App>, who: Who) -> Result<StatusCode, Problem> {
    command(&app, &who, Command::Halt, "cell.halt").await
}

/// Put it back, clear faults, try every device at once.
#[utoipa::path(post, path = "/api/v1/reset", tag = "cell", responses((status = 204, description = "done")))]
pub async fn reset(app: State<App>, who: Who) -> Result<StatusCode, Problem> {
    command(&app, &who, Command::Reset, "cell.reset").await
}

async fn command(
    app: &App,
    who: &Who,
    command: Command,
    action: &'static str,
) -> Result<StatusCode, Problem> {
    let before = word(&app.handle().snapshot());
    let done = app.handle().command(command, &who.name).await;
    done.map_err(|refusal| Problem::refused(&refusal, None))?;
    let after = word(&app.handle().snapshot());
    app.audit(who, action, "cell", [&before, &after], "")
        .await?;
    Ok(StatusCode::NO_CONTENT)
}

fn word(snapshot: &Snapshot) -> String {
    let word = serde_json::to_value(snapshot.state).unwrap_or_default();
    word.as_str().unwrap_or_default().to_owned()
}

/// Read the configured recipe and nominal again, and activate them where they have changed and can be read.
#[utoipa::path(post, path = "/api/v1/reload", tag = "recipes", responses((status = 204, description = "done")))]
pub async fn reload(State(app): State<App>, who: Who) -> Result<StatusCode, Problem> {
    let handle = app.handle().clone();
    let done = blocking(move || {
        let before = handle.store().active_recipe()?;
        handle.reload()?;
        let after = handle.store().active_recipe()?;
        let hash = |content: Option<crate::store::RecipeContent>| {
            content.map_or(String::new(), |content| content.version.sha256)
        };
        Ok::<_, crate::cell::CellError>([hash(before), hash(after)])
    });
    let [before, after] = done.await??;
    app.audit(
        &who,
        "recipe.reload",
        "configured recipe",
        [&before, &after],
        "",
    )
    .await?;
    Ok(StatusCode::NO_CONTENT)
}
