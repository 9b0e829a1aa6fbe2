//! Jobs in the loop: begun in order, followed, ended in one answer each.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::SystemTime;

use super::computing::Work;
use super::running::Running;
use crate::cell::CellError;
use crate::cell::acquisition::{Acquisition, acquire_for};
use crate::cell::devices::chain;
use crate::cell::job::{Acquired, Step};
use crate::cell::state::Mode;
use crate::cell::status::{DeviceState, JobStatus};
use crate::store::{Inspection, Order, Trigger};

/// Results that may be computing while the devices already work for the next part.
const COMPUTING_MAX: usize = 2;

/// A job that waits or runs.
pub(super) struct Job {
    pub(super) status: JobStatus,
    findings: Vec<String>,
}

impl Running {
    /// Ends the continuous mode and what waits.
    pub(super) fn drop_waiting(&mut self, reason: &str) {
        self.continuous = None;
        if self.acquiring.is_none() {
            self.snapshot.mode = Mode::Single;
        }
        for job in std::mem::take(&mut self.queue) {
            self.abort(job.status.id, reason);
        }
    }

    /// Gives the acquisition under way up.
    pub(super) fn give_up(&mut self) {
        if let Some((_, abort)) = &self.acquiring {
            abort.store(true, Ordering::Release);
        }
    }

    fn abort(&mut self, job: i64, reason: &str) {
        match self.store.abort(job, reason, SystemTime::now()) {
            Ok(inspection) => self.snapshot.last = Some(inspection),
            Err(error) => self.fault = Some(chain(&error)),
        }
    }

    /// Begins the next job where the devices are free and results do not pile up.
    pub(super) fn begin_next(&mut self) {
        let computing = self.computing.len();
        if self.acquiring.is_some() || computing >= COMPUTING_MAX || self.ending {
            return;
        }
        if !self.cause().0.is_empty() {
            if !self.queue.is_empty() {
                let cause = self.cause().0;
                self.drop_waiting(&format!("not begun: {cause}"));
            }
            return;
        }
        self.continue_order();
        let (Some(part), Some(mut job)) = (self.part.clone(), self.queue.pop_front()) else {
            self.snapshot.mode = Mode::Single;
            return;
        };
        let id = job.status.id;
        let scan_file = format!("{id:08}.raw");
        let recipe = self.snapshot.recipe.as_ref().map(|recipe| recipe.id);
        if let Err(error) = self.store.begin(id, recipe, &scan_file, SystemTime::now()) {
            self.fault = Some(chain(&error));
            self.abort(id, &chain(&error));
            return;
        }
        job.status.step = "touching".to_owned();
        let abort = Arc::new(AtomicBool::new(false));
        let acquisition = Acquisition {
            job: id,
            cell: self.cell.clone(),
            part,
            supervisors: self.supervisors.clone(),
            live: self.live.clone(),
            events: self.events.clone(),
            abort: abort.clone(),
            scan_path: self.store.folder().join("scans").join(scan_file),
        };
        for device in &mut self.snapshot.devices {
            device.state = DeviceState::Busy;
        }
        self.acquiring = Some((job, abort));
        let begun = thread::Builder::new()
            .name(format!("acquisition {id}"))
            .spawn(move || acquire_for(acquisition));
        if let Err(error) = begun {
            let result = Err(CellError::GivenUp {
                reason: format!("no thread could be started: {error}"),
            });
            self.acquired(id, result);
        }
    }

    /// In continuous mode the next part follows by itself.
    fn continue_order(&mut self) {
        if !self.queue.is_empty() {
            return;
        }
        let Some((order, operator, count)) = &mut self.continuous else {
            return;
        };
        *count += 1;
        let next = Order {
            part_serial: format!("{}-{count}", order.part_serial),
            ..order.clone()
        };
        let trigger = Trigger {
            order: &next,
            operator,
            key: None,
            simulated: self.options.simulated,
        };
        match self.store.queue(&trigger, SystemTime::now()) {
            Ok((inspection, _)) => self.queue.push_back(Job::new(&inspection)),
            Err(error) => self.fault = Some(chain(&error)),
        }
    }

    pub(super) fn step(&mut self, id: i64, step: Step) {
        let Some((job, _)) = self
            .acquiring
            .as_mut()
            .filter(|(job, _)| job.status.id == id)
        else {
            return;
        };
        let status = &mut job.status;
        match step {
            Step::Opening { .. } | Step::Inspecting => {}
            Step::Touching { done, of } => {
                status.step = "touching".to_owned();
                status.touches = Some([done, of]);
            }
            Step::Scanning { profiles, share } => {
                status.step = "scanning".to_owned();
                (status.profiles, status.share) = (profiles, share);
            }
            Step::Lost { device, error } => {
                let finding = format!("{device}: {error}");
                status.findings.push(finding.clone());
                job.findings.push(finding);
                if let Some(device) = self.snapshot.devices.iter_mut().find(|d| d.name == device) {
                    device.error = error;
                }
            }
        }
    }

    pub(super) fn acquired(&mut self, id: i64, result: Result<Box<Acquired>, CellError>) {
        let Some((mut job, _)) = self.acquiring.take() else {
            return;
        };
        for device in &mut self.snapshot.devices {
            // A device that was lost says so itself in a moment; until then it is not ready.
            if device.state == DeviceState::Busy {
                let lost = !device.error.is_empty();
                device.state = if lost {
                    DeviceState::Connecting
                } else {
                    DeviceState::Ready
                };
            }
        }
        let failed = result.is_err();
        match result {
            Ok(acquired) => {
                self.count(&acquired);
                let now = SystemTime::now();
                if let Err(error) = self
                    .store
                    .acquired(id, acquired.scan.cloud.len() as u64, now)
                {
                    self.fault = Some(chain(&error));
                }
                job.status.step = "inspecting".to_owned();
                job.status.share = 1.0;
                let work = Work {
                    job: id,
                    part_name: job.status.part_serial.clone(),
                    acquired: *acquired,
                    findings: std::mem::take(&mut job.findings),
                    created: now,
                };
                let sent = self
                    .work
                    .as_ref()
                    .is_some_and(|sender| sender.send(work).is_ok());
                if sent {
                    self.computing.push(job);
                } else {
                    self.abort(id, "the computing thread is gone; restart the daemon");
                }
            }
            Err(error) => self.abort(id, &chain(&error)),
        }
        if failed {
            // Part after part without anybody watching ends with the first one that fails.
            self.drop_waiting("the part before could not be measured");
        }
    }

    fn count(&mut self, acquired: &Acquired) {
        for view in &acquired.scan.views {
            if let Some(device) = self
                .snapshot
                .devices
                .iter_mut()
                .find(|d| d.name == view.device)
            {
                device.received += view.losses.received;
                device.lost += view.losses.lost_on_link + view.losses.dropped_by_device;
            }
        }
    }

    pub(super) fn kept(&mut self, job: i64, kept: Result<(u64, bool), String>) {
        let noted = match kept {
            Ok((0, _)) => self.store.forget_scan(job),
            Ok((bytes, whole)) => self.store.scan_kept(job, bytes, whole),
            Err(error) => {
                tracing::error!(inspection = job, error, "raw data not kept");
                Ok(())
            }
        };
        if let Err(error) = noted {
            self.fault = Some(chain(&error));
        }
        self.look_at_disk();
    }

    pub(super) fn concluded(&mut self, id: i64, result: Result<Box<Inspection>, String>) {
        self.computing.retain(|job| job.status.id != id);
        self.look_at_disk();
        match result {
            Ok(inspection) => {
                tracing::info!(
                    inspection = id,
                    part = inspection.part_serial,
                    verdict = ?inspection.verdict,
                    reason = inspection.reason,
                    "inspected"
                );
                self.snapshot.last = Some(*inspection);
            }
            Err(reason) => {
                tracing::error!(inspection = id, reason, "no result");
                self.abort(id, &reason);
            }
        }
    }
}

impl Job {
    pub(super) fn new(inspection: &Inspection) -> Self {
        Self {
            status: JobStatus {
                id: inspection.id,
                part_serial: inspection.part_serial.clone(),
                order_number: inspection.order_number.clone(),
                step: "waiting".to_owned(),
                touches: None,
                profiles: 0,
                share: 0.0,
                findings: Vec::new(),
            },
            findings: Vec::new(),
        }
    }
}
