//! `acies serve`: the daemon.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use acies_drivers::link::Links;
use acies_drivers::link::cable::Cable;
use anyhow::{Context, anyhow};

use super::{Failure, Status, interrupted};
use crate::cell::{Daemon, DaemonOptions, Handle, Mode};
use crate::config::Cell;
use crate::store::{Order, Store};
use crate::web;

/// The loop goes round every second; three seconds without a round are a fault.
const STUCK: Duration = Duration::from_secs(10);

/// Runs the cell: keeps its devices open, takes triggers from the page and the API, keeps every result.
///
/// It starts without any device, and tries each again until it is there. SIGTERM and Ctrl-C end it: a scan under way is given up
/// as aborted, results under way are still computed and kept. SIGHUP reads the configured recipe and nominal again.
#[derive(Debug, clap::Args)]
pub struct Serve {
    /// The cell's configuration.
    #[arg(value_name = "CELL.toml")]
    cell: PathBuf,
}

impl Serve {
    /// Carries the command out.
    ///
    /// # Errors
    /// When the configuration has mistakes, the store cannot be opened, or nobody may listen on the address.
    pub fn run(self) -> Result<Status, Failure> {
        let cell = read_cell(&self.cell)?;
        serve(cell, Arc::new(Cable), None)
    }
}

/// The cell in a file.
///
/// # Errors
/// All its mistakes at once.
pub(super) fn read_cell(path: &Path) -> Result<Cell, Failure> {
    Cell::read(path).map_err(|errors| Failure::BadInput(errors.into()))
}

/// Serves `cell` until the program is told to end; `first` is started as soon as the cell is ready.
///
/// # Errors
/// As [`Serve::run`].
pub(super) fn serve(
    cell: Cell,
    links: Arc<dyn Links + Send + Sync>,
    first: Option<Order>,
) -> Result<Status, Failure> {
    let cell = Arc::new(cell);
    let service = cell.service.clone();
    let store = Store::open(&service.store).map_err(|error| Failure::Io(error.into()))?;
    let options = DaemonOptions {
        queue_limit: service.queue_limit,
        retention: service.retention,
        simulated: service.simulated,
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("the page's runtime")
        .map_err(Failure::Internal)?;
    let address = service.address;
    let listener = runtime.block_on(tokio::net::TcpListener::bind(address));
    let listener = listener
        .with_context(|| format!("{address}: cannot listen; choose another address in [service]"))
        .map_err(Failure::Io)?;
    let local = listener.local_addr().unwrap_or(address);
    let daemon = Daemon::start(cell, Arc::new(store), links, options)
        .map_err(|error| Failure::Io(anyhow!(error)))?;
    let handle = daemon.handle();
    let scheme = if service.tls.is_some() {
        "https"
    } else {
        "http"
    };
    eprintln!("page: {scheme}://{local}/  (stop with Ctrl-C)");
    let served = runtime.block_on(async {
        tokio::spawn(keep_systemd_informed(handle.clone()));
        tokio::spawn(reload_on_hangup(handle.clone()));
        if let Some(order) = first {
            tokio::spawn(start_when_ready(handle.clone(), order));
        }
        web::serve_cell(listener, handle, service, interrupted()).await
    });
    tell_systemd(&[sd_notify::NotifyState::Stopping]);
    drop(daemon);
    served.context("the page").map_err(Failure::Io)?;
    Ok(Status::Done)
}

async fn start_when_ready(handle: Handle, order: Order) {
    let mut follow = handle.follow();
    if follow.wait_for(|snapshot| snapshot.accepts).await.is_err() {
        return;
    }
    if let Err((refusal, _)) = handle.start(order, "demo", None, Mode::Single).await {
        tracing::warn!(%refusal, "the first part was not started");
    }
}

/// Ready once, then a sign of life for as long as the cell's loop goes round: where it hangs, systemd starts the daemon anew.
async fn keep_systemd_informed(handle: Handle) {
    tell_systemd(&[sd_notify::NotifyState::Ready]);
    let watchdog = sd_notify::watchdog_enabled();
    let every = watchdog.map_or(Duration::from_secs(10), |limit| limit / 3);
    let mut told = String::new();
    loop {
        if handle.last_beat() < STUCK {
            tell_systemd(&[sd_notify::NotifyState::Watchdog]);
        } else {
            tracing::error!("the cell's loop hangs");
        }
        let snapshot = handle.snapshot();
        let text = match snapshot.cause.as_str() {
            "" => format!("{:?}", snapshot.state),
            cause => format!("{:?}: {cause}", snapshot.state),
        };
        if text != told {
            tell_systemd(&[sd_notify::NotifyState::Status(&text)]);
            told = text;
        }
        tokio::time::sleep(every).await;
    }
}

fn tell_systemd(state: &[sd_notify::NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "systemd cannot be told");
    }
}

/// SIGHUP, which is what `systemctl reload` sends.
async fn reload_on_hangup(handle: Handle) {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let Ok(mut hangup) = signal(SignalKind::hangup()) else {
            return;
        };
        while hangup.recv().await.is_some() {
            let handle = handle.clone();
            let reloaded = tokio::task::spawn_blocking(move || handle.reload()).await;
            match reloaded {
                Ok(Ok(())) => tracing::info!("reloaded"),
                Ok(Err(error)) => {
                    tracing::error!(%error, "not reloaded; the last good recipe stays active")
                }
                Err(error) => tracing::error!(%error, "not reloaded"),
            }
        }
    }
    #[cfg(not(unix))]
    let _ = handle;
}
