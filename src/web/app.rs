//! What the routes share.

use std::sync::Arc;
use std::time::SystemTime;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::access::Who;
use super::metrics::Requests;
use super::password::Guesses;
use super::problem::Problem;
use crate::cell::Handle;
use crate::config::Service;
use crate::store::{Audit, Store, StoreError};

/// Streams of events at a time; each page that is open holds one.
const STREAMS: usize = 64;
/// Pieces of work at a time that take seconds or much memory: scans as PLY, backups, checks of nominals, exports.
const HEAVY: usize = 2;
/// Password hashes at a time: each takes 19 MiB and a core.
const HASHES: usize = 2;

/// What the routes share; a clone is the same.
#[derive(Clone)]
pub(super) struct App(Arc<Inner>);

struct Inner {
    handle: Handle,
    service: Service,
    loopback: bool,
    stopping: watch::Receiver<bool>,
    streams: Arc<Semaphore>,
    heavy: Arc<Semaphore>,
    hashes: Arc<Semaphore>,
    guesses: Guesses,
    requests: Requests,
}

impl App {
    /// For the cell behind `handle`; `stopping` becomes true when streams shall end.
    pub fn new(
        handle: Handle,
        service: Service,
        loopback: bool,
        stopping: watch::Receiver<bool>,
    ) -> Self {
        Self(Arc::new(Inner {
            handle,
            service,
            loopback,
            stopping,
            streams: Arc::new(Semaphore::new(STREAMS)),
            heavy: Arc::new(Semaphore::new(HEAVY)),
            hashes: Arc::new(Semaphore::new(HASHES)),
            guesses: Guesses::default(),
            requests: Requests::default(),
        }))
    }

    /// The cell.
    pub fn handle(&self) -> &Handle {
        &self.0.handle
    }

    /// How the cell is served.
    pub fn service(&self) -> &Service {
        &self.0.service
    }

    /// Whether only this machine can reach the page.
    pub fn loopback(&self) -> bool {
        self.0.loopback
    }

    /// The name of the session's cookie. The prefix makes a browser refuse it from anywhere but this host over TLS (RFC 6265bis).
    pub fn cookie_name(&self) -> &'static str {
        if self.0.service.tls.is_some() {
            "__Host-acies"
        } else {
            "acies"
        }
    }

    /// Failed logins.
    pub fn guesses(&self) -> &Guesses {
        &self.0.guesses
    }

    /// What was asked and answered so far.
    pub fn requests(&self) -> &Requests {
        &self.0.requests
    }

    /// Ends when the service stops.
    pub async fn stopped(&self) {
        let mut stopping = self.0.stopping.clone();
        // An error means that the server is gone, which is a stop too.
        let _ = stopping.wait_for(|stopping| *stopping).await;
    }

    /// A place for one stream of events.
    ///
    /// # Errors
    /// Where there is none.
    pub fn stream_place(&self) -> Result<OwnedSemaphorePermit, Problem> {
        let place = self.0.streams.clone().try_acquire_owned();
        place.map_err(|_| Problem::busy(format!("{STREAMS} pages follow the cell already"), 30))
    }

    /// A place for one heavy piece of work.
    ///
    /// # Errors
    /// Where there is none.
    pub fn heavy_place(&self) -> Result<OwnedSemaphorePermit, Problem> {
        let place = self.0.heavy.clone().try_acquire_owned();
        place.map_err(|_| Problem::busy(format!("{HEAVY} large pieces of work run already"), 10))
    }

    /// Runs what hashes a password, when its turn has come.
    ///
    /// # Errors
    /// When the work panicked.
    pub async fn hashing<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Problem> {
        let place = self.0.hashes.clone().acquire_owned().await;
        let place = place.map_err(|_| Problem::busy("the service stops", 5))?;
        blocking(move || {
            let done = work();
            drop(place);
            done
        })
        .await
    }

    /// Asks the store, which waits for the disk, beside the threads that answer.
    ///
    /// # Errors
    /// What the store says.
    pub async fn store<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Store) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, Problem> {
        let handle = self.0.handle.clone();
        Ok(blocking(move || work(handle.store())).await??)
    }

    /// Runs heavy work with the cell in hand.
    ///
    /// # Errors
    /// Where there is no place for it, and what it says.
    pub async fn heavy<T: Send + 'static, E: Into<Problem> + Send + 'static>(
        &self,
        work: impl FnOnce(&Handle) -> Result<T, E> + Send + 'static,
    ) -> Result<T, Problem> {
        let place = self.heavy_place()?;
        let handle = self.0.handle.clone();
        let done = blocking(move || {
            let done = work(&handle);
            drop(place);
            done
        });
        done.await?.map_err(Into::into)
    }

    /// Writes into the audit log.
    ///
    /// # Errors
    /// What the store says: an action that cannot be noted is not done without a word.
    pub async fn audit(
        &self,
        who: &Who,
        action: &'static str,
        subject: impl Into<String>,
        [old, new]: [&str; 2],
        why: &str,
    ) -> Result<(), Problem> {
        let (person, subject) = (who.name.clone(), subject.into());
        let (old, new, why) = (old.to_owned(), new.to_owned(), why.to_owned());
        self.store(move |store| {
            let entry = Audit {
                person: &person,
                action,
                subject: &subject,
                old: &old,
                new: &new,
                why: &why,
            };
            store.audit(&entry, SystemTime::now())
        })
        .await
    }
}

/// Runs `work` on a thread that may wait.
///
/// # Errors
/// When it panicked: one request fails, not the daemon.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Problem> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|error| Problem::fault(format!("the work was not ended: {error}")))
}
