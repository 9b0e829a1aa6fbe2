//! The inspection that goes on while the devices scan, on a thread of its own.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use glam::DVec3;

use super::Part;
use super::job::JobWatch;
use crate::acquire::{Profiling, ScanEvent, ScanWatch};
use crate::config::Cell;
use crate::inspect::result::Inspection;
use crate::inspect::{EdgeSoFar, Growing, Request, Start, Touch};
use crate::nominal::Nominal;
use crate::points::{Frame, Origin, PointCloud, View};

/// Points that are handed over together: a tree over them pays, and little is left when the scan ends.
const PIECE: usize = 12_000;

/// How often edges are measured at most: as often as people can follow.
const MEASURE_EVERY: Duration = Duration::from_millis(1000);

/// How often at least, however many points wait: what is put off is measured in the end, when the verdict waits for it.
const MEASURE_AT_LEAST_EVERY: Duration = Duration::from_millis(2500);

/// When no points come for so long the scan is where there is none of the part: what is left to measure is measured at once.
const QUIET: Duration = Duration::from_millis(200);

/// Share of the scan after which the edges are not looked at before it has ended.
const LAST_LOOK: f64 = 0.96;

/// Who is shown the edges as they come.
pub(super) type Show = Box<dyn Fn(Vec<EdgeSoFar>) + Send>;

enum Message {
    /// Points, and what share of the scan has been done.
    Piece(PointCloud, f64),
    /// The scan has ended with so many points.
    End(usize),
}

/// An inspection under way. Dropping it gives it up.
pub(super) struct Meanwhile {
    sender: Sender<Message>,
    thread: JoinHandle<Option<Inspection>>,
}

impl Meanwhile {
    /// Begins to inspect what will come of `profilers`; `None` where the system gives no thread.
    fn start(cell: &Cell, part: &Arc<Part>, touches: &[Touch], show: Option<Show>) -> Option<Self> {
        let (sender, receiver) = channel();
        let (part, touches) = (part.clone(), touches.to_vec());
        let start = Start::Rough(cell.machine_from_part.inverse());
        let work = move || {
            let request = Request {
                touches: &touches,
                ..Request::new(&part.recipe, start)
            };
            follow(Growing::new(part.surface(), request), &receiver, show)
        };
        let thread = thread::Builder::new().name("meanwhile".to_owned());
        let thread = thread.spawn(work).ok()?;
        Some(Self { sender, thread })
    }

    /// The inspection of a scan that has ended with `points` points; `None` where not all of them came this way.
    pub(super) fn finish(self, points: usize) -> Option<Inspection> {
        self.sender.send(Message::End(points)).ok()?;
        self.thread.join().ok()?
    }
}

fn follow(
    mut growing: Growing<'_, Nominal>,
    receiver: &Receiver<Message>,
    show: Option<Show>,
) -> Option<Inspection> {
    let look = |growing: &mut Growing<'_, Nominal>| {
        let edges = growing.measure();
        if let Some(show) = &show {
            show(edges);
        }
        Some(Instant::now())
    };
    let mut looked: Option<Instant> = None;
    let mut fresh = false;
    loop {
        // While nothing waits there is time to look at the edges, if they are due or nothing comes for a while.
        let due = looked.map_or(Duration::ZERO, |at| {
            MEASURE_EVERY.saturating_sub(at.elapsed())
        });
        let wait = if fresh { due.min(QUIET) } else { MEASURE_EVERY };
        let message = match receiver.recv_timeout(wait) {
            Ok(message) => message,
            Err(RecvTimeoutError::Timeout) => {
                if fresh {
                    (looked, fresh) = (look(&mut growing), false);
                }
                continue;
            }
            Err(RecvTimeoutError::Disconnected) => return None,
        };
        match message {
            Message::Piece(piece, share) => {
                growing.push(piece);
                // What is looked at now would keep the verdict waiting.
                fresh = growing.is_placed() && share < LAST_LOOK;
                // As soon as anything can be seen, however much waits.
                let overdue = looked.is_none_or(|at| at.elapsed() >= MEASURE_AT_LEAST_EVERY);
                if fresh && overdue {
                    (looked, fresh) = (look(&mut growing), false);
                }
            }
            Message::End(points) => return (growing.len() == points).then(|| growing.finish()),
        }
    }
}

/// Hands the points of a scan over to an inspection, beside whoever else watches.
pub(super) struct Feeding<'a> {
    inner: &'a mut dyn JobWatch,
    meanwhile: Option<Meanwhile>,
    /// Of every view, what has not been handed over.
    waiting: Vec<PointCloud>,
    /// Share of the scan that is done.
    share: f64,
}

impl<'a> Feeding<'a> {
    /// Begins to inspect meanwhile. Points that a robot carries have no place before the scan has ended: they are inspected then.
    pub(super) fn new(
        cell: &Cell,
        part: &Arc<Part>,
        (profilers, touches): (&[Profiling], &[Touch]),
        inner: &'a mut dyn JobWatch,
    ) -> Self {
        let show = inner.show();
        let meanwhile = if cell.carrier.is_some() {
            None
        } else {
            Meanwhile::start(cell, part, touches, show)
        };
        let views: Vec<View> = profilers
            .iter()
            .map(|p| View {
                device: p.name.clone(),
                towards_sensor: p.calibration.machine_from_sensor.vector(DVec3::NEG_Z),
            })
            .collect();
        let empty = PointCloud {
            views,
            ..PointCloud::from_positions(Frame::Machine, Vec::new())
        };
        Self {
            inner,
            meanwhile,
            waiting: vec![empty; profilers.len()],
            share: 0.0,
        }
    }

    /// Hands over what is left; the inspection, for its end.
    pub(super) fn end(mut self) -> Option<Meanwhile> {
        for view in 0..self.waiting.len() {
            self.hand_over(view);
        }
        self.meanwhile
    }

    fn hand_over(&mut self, view: usize) {
        let Some(meanwhile) = &self.meanwhile else {
            return;
        };
        let waiting = &mut self.waiting[view];
        let piece = PointCloud {
            frame: Frame::Machine,
            positions: std::mem::take(&mut waiting.positions),
            origins: std::mem::take(&mut waiting.origins),
            views: waiting.views.clone(),
        };
        // Where its thread has ended the count of points tells.
        let _ = meanwhile.sender.send(Message::Piece(piece, self.share));
    }
}

impl ScanWatch for Feeding<'_> {
    fn event(&mut self, event: ScanEvent) {
        if let ScanEvent::Progress { share, .. } = &event {
            self.share = *share;
        }
        self.inner.event(event);
    }

    fn profile(&mut self, view: usize, profile: &Profile, points: &[DVec3]) {
        self.inner.profile(view, profile, points);
        if self.meanwhile.is_none() || points.is_empty() {
            return;
        }
        let number = profile.sequence.saturating_add(profile.dropped);
        let seen = profile
            .z_mm
            .iter()
            .enumerate()
            .filter(|(_, z)| z.is_finite());
        let origins = seen.map(|(column, _)| Origin {
            view: view as u16,
            column: column as u16,
            profile: number,
        });
        let waiting = &mut self.waiting[view];
        waiting.positions.extend_from_slice(points);
        waiting.origins.extend(origins);
        if waiting.len() >= PIECE {
            self.hand_over(view);
        }
    }

    fn pose(&mut self, pose: &Pose) {
        self.inner.pose(pose);
    }

    fn aborted(&mut self) -> bool {
        self.inner.aborted()
    }
}
