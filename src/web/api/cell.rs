//! The cell as it is now: status, live events, live points, commands.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::{StreamExt as _, stream};
use serde::Deserialize;
use tokio::sync::watch;
use utoipa::{IntoParams, ToSchema};

use super::Whole;
use crate::cell::{Command, DeviceStatus, Handle, LiveEdges, LiveProfile, Snapshot};
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
/// The present one comes at once, then every one that follows. With `Last-Event-ID` those come first that were missed, in order;
/// where they are no longer kept (the last 512 are), or the daemon was started anew, an event `resync` with the reason comes
/// instead: what was read before may have changed without a word. A client that does not keep up gets the same.
#[utoipa::path(get, path = "/api/v1/events", tag = "cell",
    params(("Last-Event-ID" = Option<String>, Header, description = "the last event that was seen")),
    responses((status = 200, description = "events without end", content_type = "text/event-stream", body = LiveEvent)))]
pub async fn events(State(app): State<App>, headers: HeaderMap) -> Result<Response, Problem> {
    let place = app.stream_place()?;
    let follower = Follower::new(app.handle().clone(), headers.get("last-event-id"));
    let events = stream::unfold(follower, move |mut follower| {
        // A place is held for as long as the stream lives.
        let _ = &place;
        async move { Some((Ok::<_, Infallible>(follower.next().await?), follower)) }
    });
    let events = events.take_until(async move { app.stopped().await });
    let keep_alive = KeepAlive::new().interval(KEEP_ALIVE).text("alive");
    Ok(Sse::new(events).keep_alive(keep_alive).into_response())
}

/// One of the server-sent events, with the fields of its lines.
#[derive(ToSchema)]
#[expect(dead_code, reason = "describes what goes out line by line")]
struct LiveEvent {
    /// `snapshot` or `resync`.
    event: String,
    /// When the daemon was started and the event's number; a `resync` has none.
    id: Option<String>,
    /// JSON: of a `snapshot` what `/status` answers, of a `resync` an object with its `reason`.
    data: String,
}

/// One client of the events: what it has seen, and what it is still owed.
struct Follower {
    handle: Handle,
    newest: watch::Receiver<Arc<Snapshot>>,
    /// The number of the event that was sent last.
    seen: u64,
    owed: VecDeque<Event>,
}

impl Follower {
    /// For a client that has seen event `last`, or none.
    fn new(handle: Handle, last: Option<&HeaderValue>) -> Self {
        let mut newest = handle.follow();
        let now = newest.borrow_and_update().clone();
        let mut follower = Self {
            handle,
            newest,
            seen: now.sequence,
            owed: VecDeque::new(),
        };
        let Some(last) = last else {
            follower.owe(&now);
            return follower;
        };
        // A restarted daemon counts anew: its start is part of the name.
        let last = last.to_str().ok().and_then(|last| last.rsplit_once('/'));
        let last = last.filter(|(started, _)| *started == now.started);
        match last.and_then(|(_, sequence)| sequence.parse().ok()) {
            Some(sequence) => follower.catch_up(sequence, &now),
            None => follower.resync("the daemon was started since the last event", &now),
        }
        follower
    }

    async fn next(&mut self) -> Option<Event> {
        while self.owed.is_empty() {
            // An error means that the daemon has ended.
            self.newest.changed().await.ok()?;
            let now = self.newest.borrow_and_update().clone();
            self.catch_up(self.seen, &now);
        }
        self.owed.pop_front()
    }

    /// Owes everything after event `sequence`.
    fn catch_up(&mut self, sequence: u64, now: &Snapshot) {
        match self.handle.since(sequence) {
            Some(missed) => {
                self.seen = sequence;
                missed.iter().for_each(|snapshot| self.owe(snapshot));
            }
            None => self.resync("what followed the last event is no longer kept", now),
        }
    }

    fn resync(&mut self, reason: &str, now: &Snapshot) {
        let event = Event::default().event("resync");
        let reason = serde_json::json!({ "reason": reason });
        self.owed.extend(event.json_data(reason).ok());
        self.owe(now);
    }

    fn owe(&mut self, snapshot: &Snapshot) {
        let id = format!("{}/{}", snapshot.started, snapshot.sequence);
        let event = Event::default().event("snapshot").id(id);
        self.owed.extend(event.json_data(snapshot).ok());
        self.seen = snapshot.sequence;
    }
}

/// Which of the live points are wanted.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct From {
    /// The generation that is there already: header `Acies-Generation` of the last answer.
    #[param(value_type = i64, minimum = 0, maximum = 9_007_199_254_740_991_i64)]
    generation: Whole,
    /// How many points of it are there already.
    #[param(value_type = i64, minimum = 0, maximum = 9_007_199_254_740_991_i64)]
    from: Whole,
}

/// The points of the scan that runs, or ran last: x, y, z in mm as 32-bit floats, least significant byte first.
///
/// Where the generation is another one than the one asked with, all points are new: what was there before is dropped.
#[utoipa::path(get, path = "/api/v1/live/points", tag = "cell", params(From),
    responses((status = 200, description = "points from `Acies-From` on", content_type = "application/octet-stream", body = Vec<u8>,
        headers(("Acies-Inspection" = i64, description = "the inspection"), ("Acies-Generation" = u64, description = "the generation"),
                ("Acies-From" = u64, description = "index of the first point")))))]
pub async fn live_points(State(app): State<App>, Asked(asked): Asked<From>) -> Response {
    let from = usize::try_from(asked.from.0).unwrap_or(usize::MAX);
    let live = app.handle().live().points(asked.generation.0, from);
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
    #[param(value_type = i64, minimum = 0, maximum = 9_007_199_254_740_991_i64)]
    number: Whole,
}

/// The edges of the part that is being scanned, or was scanned last, as they are measured so far. Nothing is judged before the end.
///
/// Where they are those that are there already, none come.
#[utoipa::path(get, path = "/api/v1/live/edges", tag = "cell", params(Known),
    responses((status = 200, description = "the edges, if they have been measured since", body = LiveEdges)))]
pub async fn live_edges(State(app): State<App>, Asked(known): Asked<Known>) -> Json<LiveEdges> {
    let live = app.handle().live();
    Json(live.edges(known.inspection, known.number.0))
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
