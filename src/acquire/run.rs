//! A scan as it runs: one thread a profiler, one place where their profiles meet.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{self, Scope};
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::{Losses, Profiler};
use acies_drivers::error::DeviceError;
use glam::DVec3;

use super::{Assembler, Calibration, Scan, ViewRecord};
use crate::points::{Frame, PointCloud};

/// Profiles that wait between a device and the assembly. When it is full the device's thread waits, the link pushes back,
/// and what the device cannot keep it counts as dropped: nothing is lost silently.
const QUEUE_PROFILES: usize = 64;

/// How long one wait for a profile lasts before the thread looks whether it should stop.
pub(super) const POLL: Duration = Duration::from_millis(50);

/// One profiler of a scan.
pub struct Profiling {
    /// The device's name in the cell's configuration.
    pub name: String,
    /// The open device.
    pub profiler: Box<dyn Profiler>,
    /// Where it is.
    pub calibration: Calibration,
}

/// When a scan ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanPlan {
    /// Encoder count at which the stage has passed the part.
    pub end_count: i64,
    /// A profiler silent for this long has not reached the end: the scan is incomplete.
    pub silence: Duration,
}

/// What a watcher of a scan is told.
#[derive(Debug, Clone, PartialEq)]
pub enum ScanEvent {
    /// So many profiles of all views have been placed.
    Progress {
        /// Profiles placed so far, all views.
        profiles: u64,
        /// Share of the way of the view that is farthest behind, 0 to 1.
        share: f64,
    },
    /// A profiler is gone; the others go on.
    Lost {
        /// The device's name.
        device: String,
        /// The error, as text.
        error: String,
    },
}

/// Who follows a scan while it runs. Any closure that takes a [`ScanEvent`] does.
pub trait ScanWatch {
    /// Something happened.
    fn event(&mut self, event: ScanEvent);

    /// A profile of the view `view` came, and these points were made of it (machine, mm): none where it could not be placed.
    fn profile(&mut self, view: usize, profile: &Profile, points: &[DVec3]) {
        let _ = (view, profile, points);
    }

    /// A pose of the robot that carries the profilers came; a little later than the profiles around it.
    fn pose(&mut self, pose: &Pose) {
        let _ = pose;
    }

    /// Whether the scan should be given up; asked after every profile and 20 times a second.
    fn aborted(&mut self) -> bool {
        false
    }
}

impl<F: FnMut(ScanEvent)> ScanWatch for F {
    fn event(&mut self, event: ScanEvent) {
        self(event);
    }
}

/// Why a scan could not be started.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// A profiler would not start.
    #[error("{device} did not start")]
    Start {
        /// The device's name.
        device: String,
        /// Its reason.
        #[source]
        source: Box<DeviceError>,
    },
    /// No profilers were given.
    #[error(
        "the cell has no profiler; add a [[device]] with a profiler's driver to its configuration"
    )]
    NoProfiler,
}

/// What a device's thread sends.
pub(super) enum Message {
    Profile(usize, Box<Profile>),
    Ended {
        view: usize,
        losses: Losses,
        error: Option<DeviceError>,
    },
}

/// Scans once: starts every profiler, places their profiles as they arrive, stops them all.
///
/// A device that is lost in mid-scan makes its view incomplete, with what it delivered kept; it is never resumed, since a half
/// scanned part is not a whole one.
///
/// A scan that is given up ends with what came so far; its views are incomplete.
///
/// # Errors
/// [`ScanError`] when a profiler does not start; those already started are stopped.
pub fn scan(
    mut profilers: Vec<Profiling>,
    plan: ScanPlan,
    watch: &mut dyn ScanWatch,
) -> Result<(Scan, Vec<Profiling>), ScanError> {
    if profilers.is_empty() {
        return Err(ScanError::NoProfiler);
    }
    start_all(&mut profilers)?;
    let mut views = Views::new(&profilers, plan);
    let done: Vec<AtomicBool> = profilers.iter().map(|_| AtomicBool::new(false)).collect();
    thread::scope(|scope| {
        let receiver = deliver_all(scope, &mut profilers, plan.silence, &done);
        views.collect(&receiver, &done, watch);
    });
    Ok((views.finish(&profilers), profilers))
}

/// Starts every profiler; where one does not start, those that did are stopped.
pub(super) fn start_all(profilers: &mut [Profiling]) -> Result<(), ScanError> {
    for started in 0..profilers.len() {
        let Err(source) = profilers[started].profiler.start() else {
            continue;
        };
        for other in &mut profilers[..started] {
            if let Err(error) = other.profiler.stop() {
                tracing::warn!(device = other.name, %error, "did not confirm its stop; its laser goes off by its own keep-alive");
            }
        }
        return Err(ScanError::Start {
            device: profilers[started].name.clone(),
            source: Box::new(source),
        });
    }
    Ok(())
}

/// A thread for every profiler that was started; what they send comes together here, until each has ended.
pub(super) fn deliver_all<'scope, 'env>(
    scope: &'scope Scope<'scope, 'env>,
    profilers: &'env mut [Profiling],
    silence: Duration,
    done: &'env [AtomicBool],
) -> Receiver<Message> {
    let (sender, receiver) = sync_channel(QUEUE_PROFILES);
    for (view, (profiling, done)) in profilers.iter_mut().zip(done).enumerate() {
        let sender = sender.clone();
        scope.spawn(move || deliver(view, profiling.profiler.as_mut(), silence, &sender, done));
    }
    receiver
}

/// Reads one device until it is told that the view is done, it falls silent, or it is gone.
fn deliver(
    view: usize,
    profiler: &mut dyn Profiler,
    silence: Duration,
    sender: &SyncSender<Message>,
    done: &AtomicBool,
) {
    let mut heard = Instant::now();
    let mut error = None;
    while !done.load(Ordering::Acquire) && heard.elapsed() < silence {
        match profiler.next(Instant::now() + POLL) {
            Ok(Some(profile)) => {
                heard = Instant::now();
                if sender
                    .send(Message::Profile(view, Box::new(profile)))
                    .is_err()
                {
                    break;
                }
            }
            Ok(None) => {}
            Err(gone) => {
                error = Some(gone);
                break;
            }
        }
    }
    if error.is_none() {
        match profiler.stop() {
            Ok(under_way) => {
                for profile in under_way {
                    // The receiver is gone only when the scan itself has been given up.
                    let _ = sender.send(Message::Profile(view, Box::new(profile)));
                }
            }
            Err(gone) => error = Some(gone),
        }
    }
    let _ = sender.send(Message::Ended {
        view,
        losses: profiler.losses(),
        error,
    });
}

/// The views of a scan while it runs.
struct Views {
    plan: ScanPlan,
    assemblers: Vec<Assembler>,
    first_counts: Vec<Option<i64>>,
    ended: Vec<Option<(Losses, Option<DeviceError>)>>,
    aborted: bool,
}

impl Views {
    fn new(profilers: &[Profiling], plan: ScanPlan) -> Self {
        Self {
            plan,
            assemblers: profilers
                .iter()
                .map(|p| Assembler::new(&p.name, p.calibration))
                .collect(),
            first_counts: vec![None; profilers.len()],
            ended: profilers.iter().map(|_| None).collect(),
            aborted: false,
        }
    }

    fn collect(
        &mut self,
        receiver: &Receiver<Message>,
        done: &[AtomicBool],
        watch: &mut dyn ScanWatch,
    ) {
        loop {
            let message = match receiver.recv_timeout(POLL) {
                Ok(message) => Some(message),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => return,
            };
            match message {
                Some(Message::Profile(view, profile)) => self.place(view, &profile, done, watch),
                Some(Message::Ended {
                    view,
                    losses,
                    error,
                }) => {
                    if let Some(error) = &error {
                        let device = self.assemblers[view].device().to_owned();
                        watch.event(ScanEvent::Lost {
                            device,
                            error: chain(error),
                        });
                    }
                    self.ended[view] = Some((losses, error));
                }
                None => {}
            }
            if !self.aborted && watch.aborted() {
                self.aborted = true;
                for view in done {
                    view.store(true, Ordering::Release);
                }
            }
        }
    }

    fn place(
        &mut self,
        view: usize,
        profile: &Profile,
        done: &[AtomicBool],
        watch: &mut dyn ScanWatch,
    ) {
        let assembler = &mut self.assemblers[view];
        let before = assembler.positions().len();
        assembler.push(profile);
        watch.profile(view, profile, &assembler.positions()[before..]);
        let count = assembler.encoder();
        self.first_counts[view] = self.first_counts[view].or(count);
        if count.is_some_and(|count| count >= self.plan.end_count) {
            done[view].store(true, Ordering::Release);
        }
        let profiles = self.assemblers.iter().map(Assembler::profiles).sum();
        watch.event(ScanEvent::Progress {
            profiles,
            share: self.share(),
        });
    }

    /// Share of the way of the view that is farthest behind.
    fn share(&self) -> f64 {
        let share = |view: usize| {
            let (Some(first), Some(now)) =
                (self.first_counts[view], self.assemblers[view].encoder())
            else {
                return 0.0;
            };
            let way = (self.plan.end_count - first).max(1) as f64;
            ((now - first) as f64 / way).clamp(0.0, 1.0)
        };
        (0..self.assemblers.len()).map(share).fold(1.0, f64::min)
    }

    fn finish(self, profilers: &[Profiling]) -> Scan {
        let mut cloud = PointCloud {
            frame: Frame::Machine,
            positions: Vec::new(),
            origins: Vec::new(),
            views: Vec::new(),
        };
        let mut views = Vec::new();
        for ((assembler, ended), profiling) in
            self.assemblers.into_iter().zip(self.ended).zip(profilers)
        {
            let reached = assembler
                .encoder()
                .is_some_and(|count| count >= self.plan.end_count);
            let (unplaced, empty_columns) = (assembler.unplaced(), assembler.empty_columns());
            let stood_at = assembler.encoder();
            let (view, mut findings) = assembler.finish();
            let (losses, error) = ended.unwrap_or_default();
            if let Some(error) = &error {
                findings.push(format!(
                    "{}: lost during the scan: {}",
                    profiling.name,
                    chain(error)
                ));
            } else if !reached && self.aborted {
                findings.push(format!(
                    "{}: the scan was given up before its end",
                    profiling.name
                ));
            } else if !reached {
                findings.push(incomplete(&profiling.name, stood_at, self.plan));
            }
            append(&mut cloud, view, views.len() as u16);
            views.push(ViewRecord {
                device: profiling.name.clone(),
                identity: profiling.profiler.identity().clone(),
                losses,
                unplaced,
                empty_columns,
                complete: reached && error.is_none(),
                findings,
            });
        }
        Scan { cloud, views }
    }
}

fn incomplete(device: &str, stood_at: Option<i64>, plan: ScanPlan) -> String {
    let seen = stood_at.map_or("no profile".to_owned(), |count| {
        format!("the encoder stood at {count}")
    });
    format!(
        "{device}: silent for {} s before the end: {seen}, expected {}; check that the stage ran to its end",
        plan.silence.as_secs_f64(),
        plan.end_count
    )
}

pub(super) fn append(cloud: &mut PointCloud, view: PointCloud, index: u16) {
    cloud.positions.extend(view.positions);
    cloud.origins.extend(
        view.origins
            .into_iter()
            .map(|origin| crate::points::Origin {
                view: index,
                ..origin
            }),
    );
    cloud.views.extend(view.views);
}

/// An error with its causes, on one line.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        // Some errors say their cause themselves; once is enough.
        let more = inner.to_string();
        if !text.contains(&more) {
            text = format!("{text}: {more}");
        }
        cause = inner.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use acies_drivers::device::Identity;
    use glam::DVec3;

    use super::*;
    use crate::geometry::RigidTransform;

    /// Delivers `profiles` profiles 40 counts apart, then fails or falls silent.
    struct Scripted {
        identity: Identity,
        sent: u32,
        profiles: u32,
        fails: bool,
        refuses: bool,
        laser: std::sync::Arc<AtomicBool>,
    }

    impl Profiler for Scripted {
        fn identity(&self) -> &Identity {
            &self.identity
        }

        fn start(&mut self) -> Result<(), DeviceError> {
            if self.refuses {
                return Err(DeviceError::Silent {
                    port: "fake".to_owned(),
                    deadline_s: 1.0,
                });
            }
            self.laser.store(true, Ordering::Release);
            Ok(())
        }

        fn next(&mut self, _deadline: Instant) -> Result<Option<Profile>, DeviceError> {
            if self.sent == self.profiles {
                let gone = DeviceError::Silent {
                    port: "fake".to_owned(),
                    deadline_s: 0.5,
                };
                return if self.fails { Err(gone) } else { Ok(None) };
            }
            self.sent += 1;
            Ok(Some(Profile {
                sequence: self.sent - 1,
                boot: 1,
                device_time_ns: 0,
                encoder: Some(i64::from(self.sent - 1) * 40),
                host_time: Instant::now(),
                dropped: 0,
                saturated: false,
                x_mm: vec![0.0, 1.0],
                z_mm: vec![100.0, f64::NAN],
                intensity: Vec::new(),
            }))
        }

        fn stop(&mut self) -> Result<Vec<Profile>, DeviceError> {
            self.laser.store(false, Ordering::Release);
            Ok(Vec::new())
        }

        fn losses(&self) -> Losses {
            Losses {
                received: u64::from(self.sent),
                ..Losses::default()
            }
        }
    }

    fn profiling(
        name: &str,
        profiles: u32,
        change: impl FnOnce(&mut Scripted),
    ) -> (Profiling, std::sync::Arc<AtomicBool>) {
        let laser = std::sync::Arc::new(AtomicBool::new(false));
        let identity = Identity {
            vendor: "v".to_owned(),
            model: "m".to_owned(),
            serial: name.to_owned(),
            firmware: "1".to_owned(),
        };
        let mut scripted = Scripted {
            identity,
            sent: 0,
            profiles,
            fails: false,
            refuses: false,
            laser: laser.clone(),
        };
        change(&mut scripted);
        let calibration = Calibration {
            machine_from_sensor: RigidTransform::IDENTITY,
            travel_mm_per_count: DVec3::Y * 0.01,
        };
        (
            Profiling {
                name: name.to_owned(),
                profiler: Box::new(scripted),
                calibration,
            },
            laser,
        )
    }

    /// The last of 101 profiles stands at 4000.
    const PLAN: ScanPlan = ScanPlan {
        end_count: 4000,
        silence: Duration::from_millis(100),
    };

    #[test]
    fn two_views_are_scanned_to_their_end_and_both_lasers_go_off() {
        let (left, left_laser) = profiling("left", 500, |_| {});
        let (right, right_laser) = profiling("right", 500, |_| {});
        let mut last_share = 0.0;
        let mut watch = |event: ScanEvent| match event {
            ScanEvent::Progress { share, .. } => last_share = share,
            ScanEvent::Lost { device, error } => panic!("{device}: {error}"),
        };
        let (scan, _) = scan(vec![left, right], PLAN, &mut watch).unwrap();
        assert!(
            scan.views
                .iter()
                .all(|view| view.complete && view.findings.is_empty()),
            "{:?}",
            scan.views
        );
        assert!(scan.cloud.origins.iter().any(|origin| origin.view == 1));
        assert_eq!(scan.cloud.positions.len(), scan.cloud.origins.len());
        assert!(
            scan.cloud.positions.len() >= 202,
            "both views have every point up to the end"
        );
        assert!((last_share - 1.0).abs() < 1e-12, "{last_share}");
        assert!(!left_laser.load(Ordering::Acquire) && !right_laser.load(Ordering::Acquire));
    }

    #[test]
    fn a_device_lost_in_mid_scan_leaves_its_view_incomplete_and_the_other_whole() {
        let (left, _) = profiling("left", 30, |scripted| scripted.fails = true);
        let (right, _) = profiling("right", 500, |_| {});
        let mut lost = Vec::new();
        let mut watch = |event: ScanEvent| {
            if let ScanEvent::Lost { device, error } = event {
                lost.push((device, error));
            }
        };
        let (scan, _) = scan(vec![left, right], PLAN, &mut watch).unwrap();
        let text = "fake: no answer within 0.5 s; check power and cable, then retry";
        assert_eq!(lost, [("left".to_owned(), text.to_owned())]);
        assert!(!scan.views[0].complete && scan.views[1].complete);
        assert_eq!(
            scan.views[0].findings,
            [format!("left: lost during the scan: {text}")]
        );
        assert_eq!(scan.views[0].losses.received, 30);
    }

    #[test]
    fn a_stage_that_stops_early_is_said_with_where_it_stood() {
        let (left, _) = profiling("left", 30, |_| {});
        let (scan, _) = scan(vec![left], PLAN, &mut |_: ScanEvent| {}).unwrap();
        assert_eq!(
            scan.views[0].findings,
            [
                "left: silent for 0.1 s before the end: the encoder stood at 1160, expected 4000; \
              check that the stage ran to its end"
            ]
        );
    }

    #[test]
    fn a_device_that_does_not_start_stops_those_that_did() {
        let (left, left_laser) = profiling("left", 500, |_| {});
        let (right, _) = profiling("right", 500, |scripted| scripted.refuses = true);
        let error = scan(vec![left, right], PLAN, &mut |_: ScanEvent| {})
            .map(|_| ())
            .unwrap_err();
        assert_eq!(error.to_string(), "right did not start");
        assert!(!left_laser.load(Ordering::Acquire));
        let none = scan(Vec::new(), PLAN, &mut |_: ScanEvent| {})
            .map(|_| ())
            .unwrap_err();
        assert_eq!(
            none.to_string(),
            "the cell has no profiler; add a [[device]] with a profiler's driver to its configuration"
        );
    }
}
