//! Inspections: start, history, reports, scans, export.

use std::fs::File;
use std::io::{self, Write};

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt as _;
use serde::Deserialize;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use utoipa::{IntoParams, ToSchema};

use super::{Page, bytes, file};
use crate::cell::Mode;
use crate::points::write;
use crate::report::{Report, content_security_policy};
use crate::store::{Export, History, Inspection, Order, ScanFileError, ScanReader, Store};
use crate::web::access::Who;
use crate::web::app::{App, blocking};
use crate::web::problem::{Asked, Input, Place, Problem, chain};
use crate::words::Language;

/// Longest serial or order number; a data-matrix code holds at most 2335 characters, parts' codes far fewer.
const NAME_MAX: usize = 200;
/// Pieces of an answer that wait for a client.
const PIECES: usize = 4;
/// Their size, bytes.
const PIECE: usize = 64 << 10;

/// The history, newest first.
#[utoipa::path(get, path = "/api/v1/inspections", tag = "inspections", params(History),
    responses((status = 200, description = "one page", body = Page<Inspection>)))]
pub async fn list(
    State(app): State<App>,
    Asked(mut history): Asked<History>,
) -> Result<Json<Page<Inspection>>, Problem> {
    let wanted = Page::<Inspection>::wanted(history.limit);
    history.limit = u32::try_from(wanted).ok();
    let found = app.store(move |store| store.history(&history)).await?;
    Ok(Json(Page::new(found, wanted, |inspection| inspection.id)))
}

/// What a trigger says.
#[derive(Debug, Deserialize, ToSchema)]
pub struct Start {
    #[serde(flatten)]
    order: Order,
    /// One part, or part after part until somebody stops it.
    #[serde(default)]
    mode: Mode,
}

/// Start an inspection, or put it into the queue.
///
/// A trigger that is repeated with the same `Idempotency-Key` measures once and gets the same inspection again.
#[utoipa::path(post, path = "/api/v1/inspections", tag = "inspections", request_body = Start,
    params(("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, pattern = "^[!-~]+$", description = "chosen by the caller, another one for each part; up to 255 visible ASCII characters")),
    responses((status = 201, description = "taken", body = Inspection, headers(("Location" = String, description = "its address"))),
        (status = 200, description = "taken before, under the same key", body = Inspection)))]
pub async fn start(
    State(app): State<App>,
    who: Who,
    headers: HeaderMap,
    Input(Start { mut order, mode }): Input<Start>,
) -> Result<Response, Problem> {
    let key = headers
        .get("idempotency-key")
        .map(idempotency_key)
        .transpose()?;
    for (name, text) in [
        ("part_serial", &mut order.part_serial),
        ("order_number", &mut order.order_number),
    ] {
        *text = text.trim().to_owned();
        let length = text.chars().count();
        if length > NAME_MAX {
            return Err(Problem::invalid(
                format!("{name} has {length} characters, expected at most {NAME_MAX}"),
                "check what the scanner sends",
            ));
        }
    }
    let started = app
        .handle()
        .start(order.clone(), &who.name, key, mode)
        .await;
    let (inspection, new) =
        started.map_err(|(refusal, kept)| Problem::refused(&refusal, kept.as_deref()))?;
    if inspection.part_serial != order.part_serial || inspection.order_number != order.order_number
    {
        return Err(Problem::invalid(
            format!(
                "this Idempotency-Key belongs to inspection {} of part {:?}",
                inspection.id, inspection.part_serial
            ),
            "choose another key for another part",
        ));
    }
    if new {
        let subject = format!("inspection {}", inspection.id);
        let values = ["", &inspection.part_serial];
        app.audit(&who, "inspection.start", subject, values, "")
            .await?;
    }
    let status = if new {
        StatusCode::CREATED
    } else {
        StatusCode::OK
    };
    let location = HeaderValue::try_from(format!("/api/v1/inspections/{}", inspection.id));
    let mut answer = (status, Json(&inspection)).into_response();
    if let Ok(location) = location {
        answer.headers_mut().insert(header::LOCATION, location);
    }
    Ok(answer)
}

fn idempotency_key(value: &HeaderValue) -> Result<String, Problem> {
    let text = value.to_str().unwrap_or_default();
    if !(1..=255).contains(&text.len()) {
        return Err(Problem::new(
            StatusCode::BAD_REQUEST,
            "idempotency-key",
            "The Idempotency-Key cannot be used",
            format!("{} bytes", value.len()),
            "send 1 to 255 visible ASCII characters",
        ));
    }
    Ok(text.to_owned())
}

/// One inspection.
#[utoipa::path(get, path = "/api/v1/inspections/{id}", tag = "inspections", params(("id" = i64, Path)),
    responses((status = 200, description = "as the history knows it", body = Inspection)))]
pub async fn one(
    State(app): State<App>,
    Place(id): Place<i64>,
) -> Result<Json<Inspection>, Problem> {
    Ok(Json(app.store(move |store| store.inspection(id)).await?))
}

/// The report as JSON (`acies-report/1`).
#[utoipa::path(get, path = "/api/v1/inspections/{id}/report.json", tag = "inspections", params(("id" = i64, Path)),
    responses((status = 200, description = "the report", content_type = "application/json", body = Object)))]
pub async fn report_json(
    State(app): State<App>,
    Place(id): Place<i64>,
) -> Result<Response, Problem> {
    let json = app.store(move |store| store.report_json(id)).await?;
    Ok(bytes("application/json", json).into_response())
}

/// How a report is shown.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct Shown {
    /// Language of the page; English where none is said. What devices and people said stays as it is.
    #[param(inline)]
    language: Option<Language>,
}

/// The report as a page of its own.
#[utoipa::path(get, path = "/api/v1/inspections/{id}/report.html", tag = "inspections", params(("id" = i64, Path), Shown),
    responses((status = 200, description = "the page", content_type = "text/html", body = String)))]
pub async fn report_html(
    State(app): State<App>,
    Place(id): Place<i64>,
    Asked(shown): Asked<Shown>,
) -> Result<Response, Problem> {
    let words = shown.language.unwrap_or_default();
    let page = app.store(move |store| {
        let has_scan = store.scan_path(id).is_ok();
        Ok((store.report_json(id)?, has_scan))
    });
    let (json, has_scan) = page.await?;
    let html = blocking(move || {
        let base = format!("/api/v1/inspections/{id}");
        let scan_ply = words.text("report.scan.ply").to_owned();
        let mut links = vec![
            (format!("{base}/report.json"), "JSON"),
            (format!("{base}/report.csv"), "CSV"),
        ];
        if has_scan {
            links.push((format!("{base}/scan.ply"), scan_ply.as_str()));
        }
        let links: Vec<(&str, &str)> = links
            .iter()
            .map(|(to, name)| (to.as_str(), *name))
            .collect();
        read(&json).map(|report| report.to_html_with_links(words, &links))
    });
    let mut answer = bytes("text/html; charset=utf-8", html.await??).into_response();
    // Shown inside our own page, and nowhere else.
    let policy = format!("{}; frame-ancestors 'self'", content_security_policy());
    if let Ok(policy) = HeaderValue::try_from(policy) {
        answer
            .headers_mut()
            .insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    Ok(answer)
}

/// The report as a table.
#[utoipa::path(get, path = "/api/v1/inspections/{id}/report.csv", tag = "inspections", params(("id" = i64, Path)),
    responses((status = 200, description = "one line a station", content_type = "text/csv", body = String)))]
pub async fn report_csv(
    State(app): State<App>,
    Place(id): Place<i64>,
) -> Result<Response, Problem> {
    let json = app.store(move |store| store.report_json(id)).await?;
    let csv = blocking(move || read(&json).map(|report| report.to_csv())).await??;
    Ok(file(
        "text/csv; charset=utf-8",
        &format!("inspection-{id}.csv"),
        csv,
    )
    .into_response())
}

fn read(json: &str) -> Result<Report, Problem> {
    serde_json::from_str(json)
        .map_err(|error| Problem::fault(format!("a stored report cannot be read: {error}")))
}

/// The scan as a PLY file: every point with its device, profile and column.
#[utoipa::path(get, path = "/api/v1/inspections/{id}/scan.ply", tag = "inspections", params(("id" = i64, Path)),
    responses((status = 200, description = "binary PLY, machine frame, mm", content_type = "application/octet-stream", body = Vec<u8>)))]
pub async fn scan_ply(State(app): State<App>, Place(id): Place<i64>) -> Result<Response, Problem> {
    let ply = app
        .heavy(move |handle| assembled(handle.store(), id))
        .await?;
    let name = format!("inspection-{id}.ply");
    Ok(file("application/octet-stream", &name, ply).into_response())
}

fn assembled(store: &Store, id: i64) -> Result<Vec<u8>, Problem> {
    let path = store.scan_path(id)?;
    let fault = |error: &dyn std::error::Error| Problem::fault(chain(error));
    let cloud = ScanReader::open(&path)
        .and_then(ScanReader::into_cloud)
        .map_err(|error| match error {
            ScanFileError::Carried { .. } => Problem::missing(chain(&error)),
            _ => fault(&error),
        })?;
    write::scan_bytes(&cloud, write::Encoding::LittleEndian).map_err(|error| fault(&error))
}

/// The raw profiles as they are stored.
#[utoipa::path(get, path = "/api/v1/inspections/{id}/scan.raw", tag = "inspections", params(("id" = i64, Path)),
    responses((status = 200, description = "ACIESRAW, version 1", content_type = "application/octet-stream", body = Vec<u8>)))]
pub async fn scan_raw(State(app): State<App>, Place(id): Place<i64>) -> Result<Response, Problem> {
    let path = app.store(move |store| store.scan_path(id)).await?;
    let place = app.heavy_place()?;
    let opened = blocking(move || {
        File::open(&path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => {
                Problem::missing("the raw data were removed by the retention rule")
            }
            _ => Problem::fault(format!("{}: {error}", path.display())),
        })
    });
    let mut file_of_scan = opened.await??;
    let (sender, receiver) = mpsc::channel(PIECES);
    tokio::task::spawn_blocking(move || {
        let mut out = Pieces::new(sender);
        let copied = io::copy(&mut file_of_scan, &mut out).and_then(|_| out.flush());
        out.end(copied);
        drop(place);
    });
    let body = Body::from_stream(ReceiverStream::new(receiver));
    let name = format!("inspection-{id}.raw");
    Ok(file("application/octet-stream", &name, body).into_response())
}

/// In which form the history is exported.
#[derive(Debug, Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// A table: one line for each characteristic of each inspection.
    #[default]
    Csv,
    /// One inspection with its whole report a line.
    Jsonl,
}

/// The form of an export.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct ExportForm {
    /// `csv` or `jsonl`.
    #[param(inline)]
    form: Form,
}

/// All finished inspections that the query asks for, newest first, however many; `limit` does not count here.
#[utoipa::path(get, path = "/api/v1/export", tag = "inspections", params(ExportForm, History),
    responses((status = 200, description = "as it is read from the store",
        content((String = "text/csv"), (String = "application/x-ndjson")))))]
pub async fn export(
    State(app): State<App>,
    Asked(form): Asked<ExportForm>,
    Asked(history): Asked<History>,
) -> Result<Response, Problem> {
    let (export, kind, name) = match form.form {
        Form::Csv => (Export::Csv, "text/csv; charset=utf-8", "inspections.csv"),
        Form::Jsonl => (
            Export::JsonLines,
            "application/x-ndjson",
            "inspections.jsonl",
        ),
    };
    let place = app.heavy_place()?;
    let (sender, receiver) = mpsc::channel(PIECES);
    let handle = app.handle().clone();
    tokio::task::spawn_blocking(move || {
        let mut out = Pieces::new(sender);
        let exported = handle.store().export(export, &history, &mut out);
        out.end(exported);
        drop(place);
    });
    let stream = ReceiverStream::new(receiver).take_until(async move { app.stopped().await });
    Ok(file(kind, name, Body::from_stream(stream)).into_response())
}

/// Writes into a stream, and waits where the client is slow.
struct Pieces {
    sender: mpsc::Sender<io::Result<Bytes>>,
    piece: Vec<u8>,
}

impl Pieces {
    fn new(sender: mpsc::Sender<io::Result<Bytes>>) -> Self {
        Self {
            sender,
            piece: Vec::with_capacity(PIECE),
        }
    }

    /// Where `done` is a failure the connection breaks off, so that nobody takes what came for the whole.
    fn end<T, E: std::error::Error>(self, done: Result<T, E>) {
        if let Err(error) = done {
            tracing::info!(error = chain(&error), "an answer ended early");
            // The client may be what failed.
            let _ = self
                .sender
                .blocking_send(Err(io::Error::other("it failed on the way")));
        }
    }
}

impl Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.piece.extend_from_slice(bytes);
        if self.piece.len() >= PIECE {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.piece.is_empty() {
            return Ok(());
        }
        let piece = std::mem::replace(&mut self.piece, Vec::with_capacity(PIECE));
        let sent = self.sender.blocking_send(Ok(piece.into()));
        sent.map_err(|_| io::Error::new(io::ErrorKind::BrokenPipe, "the client is gone"))
    }
}
