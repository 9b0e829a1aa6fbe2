//! Whether it lives, whether it is ready, and how it does in numbers: for supervisors, load balancers and Prometheus.

use std::sync::atomic::AtomicU64;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;
use serde::Serialize;

use super::app::App;
use super::problem::Problem;
use crate::cell::{DeviceState, Snapshot, State as CellState};

/// The loop goes round every second.
const STUCK: Duration = Duration::from_secs(10);

type Labels = Vec<(&'static str, String)>;

/// Requests by method and class of status.
#[derive(Debug, Default)]
pub(super) struct Requests(Family<Labels, Counter>);

impl Requests {
    /// Counts one.
    pub fn count(&self, method: &'static str, status: StatusCode) {
        let class = format!("{}xx", status.as_u16() / 100);
        let labels = vec![("method", method.to_owned()), ("status", class)];
        self.0.get_or_create(&labels).inc();
    }
}

/// A sign of life.
#[derive(Serialize)]
struct Health {
    status: &'static str,
    version: &'static str,
}

/// Whether the process and the cell's loop are alive.
pub(super) async fn healthz(State(app): State<App>) -> Response {
    let beat = app.handle().last_beat();
    if beat > STUCK {
        let detail = format!("the cell's loop last went round {} s ago", beat.as_secs());
        let what_to_do = "restart the daemon, and report its log";
        let title = "The daemon hangs";
        let status = StatusCode::SERVICE_UNAVAILABLE;
        return Problem::new(status, "stuck", title, detail, what_to_do).into_response();
    }
    let health = Health {
        status: "ok",
        version: env!("CARGO_PKG_VERSION"),
    };
    Json(health).into_response()
}

/// Whether a part could be measured now, or after the one that is being measured.
pub(super) async fn readyz(State(app): State<App>) -> Response {
    let snapshot = app.handle().snapshot();
    if snapshot.cause.is_empty() {
        let health = Health {
            status: "ready",
            version: env!("CARGO_PKG_VERSION"),
        };
        return Json(health).into_response();
    }
    let status = StatusCode::SERVICE_UNAVAILABLE;
    let title = "The cell is not ready";
    Problem::new(
        status,
        "not-ready",
        title,
        &snapshot.cause,
        &snapshot.advice,
    )
    .into_response()
}

/// The cell in numbers, as OpenMetrics.
pub(super) async fn metrics(State(app): State<App>) -> Result<Response, Problem> {
    let snapshot = app.handle().snapshot();
    let mut registry = Registry::with_prefix("acies");
    registry.register(
        "http_requests",
        "Requests answered",
        app.requests().0.clone(),
    );
    register(&mut registry, &snapshot, app.handle().last_beat());
    let mut text = String::new();
    encode(&mut text, &registry).map_err(|error| Problem::fault(format!("metrics: {error}")))?;
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    Ok(([(header::CONTENT_TYPE, kind)], text).into_response())
}

type Number = Gauge<f64, AtomicU64>;

fn register(registry: &mut Registry, snapshot: &Snapshot, beat: Duration) {
    let mut gauge = |name: &str, help: &str, values: Vec<(Labels, f64)>| {
        let family = Family::<Labels, Number>::default();
        for (labels, value) in values {
            family.get_or_create(&labels).set(value);
        }
        registry.register(name, help, family);
    };
    let one = |value: f64| vec![(Labels::new(), value)];
    let yes = |yes: bool| f64::from(u8::from(yes));
    let devices = |value: &dyn Fn(&crate::cell::DeviceStatus) -> f64| {
        let devices = snapshot.devices.iter();
        devices
            .map(|device| (vec![("device", device.name.clone())], value(device)))
            .collect()
    };
    let cell = vec![
        ("cell", snapshot.cell.clone()),
        ("version", snapshot.version.clone()),
    ];
    gauge("cell_info", "The cell and its version", vec![(cell, 1.0)]);
    gauge(
        "cell_state",
        "State of OPC 40100-1 by its number",
        one(f64::from(snapshot.state_number)),
    );
    gauge(
        "cell_ready",
        "Whether nothing keeps the cell from measuring",
        one(yes(
            snapshot.cause.is_empty() && snapshot.state != CellState::Halted
        )),
    );
    gauge(
        "loop_age_seconds",
        "Since the cell's loop last went round",
        one(beat.as_secs_f64()),
    );
    gauge(
        "queue_length",
        "Parts that wait",
        one(snapshot.queue.len() as f64),
    );
    gauge(
        "computing",
        "Results being computed",
        one(snapshot.computing.len() as f64),
    );
    gauge(
        "device_ready",
        "Whether the device is open",
        devices(&|device| {
            yes(matches!(
                device.state,
                DeviceState::Ready | DeviceState::Busy
            ))
        }),
    );
    gauge(
        "device_opened",
        "How often it was opened",
        devices(&|device| device.opened as f64),
    );
    gauge(
        "device_failures",
        "How often it could not be opened or was lost",
        devices(&|device| device.failures as f64),
    );
    gauge(
        "device_profiles_received",
        "Profiles received",
        devices(&|device| device.received as f64),
    );
    gauge(
        "device_profiles_lost",
        "Profiles lost on the link or in the device",
        devices(&|device| device.lost as f64),
    );
    gauge(
        "device_calibration_due",
        "Whether its calibration has run out",
        devices(&|device| yes(device.calibration_due)),
    );
    if let Some(usage) = &snapshot.storage {
        gauge(
            "store_inspections",
            "Inspections of all time",
            one(usage.inspections as f64),
        );
        gauge(
            "store_scan_bytes",
            "Size of the raw data",
            one(usage.scan_bytes as f64),
        );
        gauge(
            "store_database_bytes",
            "Size of the database",
            one(usage.database_bytes as f64),
        );
        if let Some(free) = usage.free_bytes {
            gauge(
                "store_free_bytes",
                "Free on the disk of the store",
                one(free as f64),
            );
        }
    }
    if let Some(last) = &snapshot.last {
        gauge(
            "last_inspection",
            "Number of the inspection that ended last",
            one(last.id as f64),
        );
        let verdict = last
            .verdict
            .map(|verdict| serde_json::to_value(verdict).unwrap_or_default());
        let verdict = verdict
            .as_ref()
            .and_then(|word| word.as_str())
            .unwrap_or("none");
        gauge(
            "last_verdict",
            "Its verdict",
            vec![(vec![("verdict", verdict.to_owned())], 1.0)],
        );
        let seconds = [
            ("scan", last.scan_seconds),
            ("verdict", last.verdict_seconds),
        ];
        let seconds = seconds
            .into_iter()
            .filter_map(|(stage, seconds)| Some((vec![("stage", stage.to_owned())], seconds?)));
        gauge(
            "last_inspection_seconds",
            "How long it took",
            seconds.collect(),
        );
    }
}
