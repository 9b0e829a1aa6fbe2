//! A scan by a robot: profiles and poses each by the clock of their own device, joined when the run is over.
//!
//! Neither clock is the host's, and no receipt is taken for a pose. Receipts only relate the clocks: the line under all of them
//! ([`fit_clock`]) is the relation with the least delay. What it cannot tell is the difference of the two least delays; it moves all points
//! of a view along the robot's path by one and the same time. A network's are some tens of microseconds, that of a sensor which sends a
//! profile some exposures later is as many exposures: a calibration finds it ([`CarrierPlan::lag_s`]).
//!
//! Memory: 18 bytes a column until the run is over, 32 bytes a point after it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::{Losses, Robot};
use acies_drivers::error::DeviceError;
use glam::{DQuat, DVec3};

use super::clock::fit_clock;
use super::lag::Pass;
use super::poses::{PoseGap, PoseTrack};
use super::run::{Message, POLL, append, chain, deliver_all, start_all};
use super::{Profiling, Scan, ScanError, ScanEvent, ScanWatch, ViewRecord};
use crate::geometry::RigidTransform;
use crate::points::{Frame, Origin, PointCloud, View};

/// A robot that carries the profilers of a scan.
pub struct Carrier {
    /// The device's name in the cell's configuration.
    pub name: String,
    /// The open robot.
    pub robot: Box<dyn Robot>,
    /// When the scan ends, and where the robot stands.
    pub plan: CarrierPlan,
}

/// When a scan by a robot ends, and where the robot stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarrierPlan {
    /// Where the robot's base stands.
    pub machine_from_base: RigidTransform,
    /// Place of the tool's origin at which the scan is over, mm, in the robot's base frame; it must have been elsewhere before.
    pub end_mm: DVec3,
    /// How near it must come, mm.
    pub within_mm: f64,
    /// Added to the time of a profile before its pose is looked up, s: minus where the profiler's least delay is the longer one.
    pub lag_s: f64,
    /// A profiler or robot silent for this long, or a tool at rest for this long, has not reached the end: the scan is incomplete.
    pub silence: Duration,
}

/// After the end the robot is listened to for this long at most, so that the last profiles lie between two poses.
const AFTERWARDS: Duration = Duration::from_millis(500);

/// A tool within this of where it was rests, mm: a robot that holds its place trembles by some hundredths.
const REST_MM: f64 = 0.1;

/// What the robot's thread brought.
#[derive(Default)]
struct Poses {
    poses: Vec<Pose>,
    reached: bool,
    losses: Losses,
    error: Option<DeviceError>,
}

/// What came of one profiler.
#[derive(Default)]
struct Took {
    profiles: Vec<Profile>,
    losses: Losses,
    error: Option<DeviceError>,
    /// Ended before it was told to.
    fell_silent: bool,
}

/// Scans once: starts the robot's stream and every profiler, waits until the robot is at its end, places the profiles.
///
/// The calibration of a profiler here is where it is on the tool (`tool_from_sensor`); travel and encoder are not used.
///
/// # Errors
/// [`ScanError`] when a device does not start; those already started are stopped.
pub fn scan_carried(
    mut profilers: Vec<Profiling>,
    carrier: &mut Carrier,
    watch: &mut dyn ScanWatch,
) -> Result<(Scan, Vec<Profiling>), ScanError> {
    let run = run_carried(&mut profilers, carrier, watch)?;
    let scan = place(&profilers, run, carrier);
    Ok((scan, profilers))
}

/// What a run by a robot brought, before anything of it is placed.
pub struct CarriedRun {
    took: Vec<Took>,
    poses: Poses,
}

/// What was recorded of a run by a robot: enough to place its profiles, when it is over or a year later, to the same bits.
#[derive(Debug, Clone)]
pub struct CarriedRecord<'a> {
    /// The profilers.
    pub views: Vec<CarriedView<'a>>,
    /// The robot's poses, as they came.
    pub poses: &'a [Pose],
    /// Where the robot's base stood.
    pub machine_from_base: RigidTransform,
    /// As [`CarrierPlan::lag_s`].
    pub lag_s: f64,
}

/// One profiler of a [`CarriedRecord`].
#[derive(Debug, Clone, Copy)]
pub struct CarriedView<'a> {
    /// The device's name in the cell's configuration.
    pub device: &'a str,
    /// Where it was on the tool.
    pub tool_from_sensor: RigidTransform,
    /// What it took, in order.
    pub profiles: &'a [Profile],
}

/// Runs once as [`scan_carried`] does, and places nothing.
///
/// # Errors
/// As [`scan_carried`].
pub fn run_carried(
    profilers: &mut [Profiling],
    carrier: &mut Carrier,
    watch: &mut dyn ScanWatch,
) -> Result<CarriedRun, ScanError> {
    if profilers.is_empty() {
        return Err(ScanError::NoProfiler);
    }
    carrier.robot.start().map_err(|source| ScanError::Start {
        device: carrier.name.clone(),
        source: Box::new(source),
    })?;
    if let Err(error) = start_all(profilers) {
        let _ = carrier.robot.stop();
        return Err(error);
    }
    let done: Vec<AtomicBool> = profilers.iter().map(|_| AtomicBool::new(false)).collect();
    let over = AtomicBool::new(false);
    let (sender, moves) = channel();
    let plan = carrier.plan;
    let (took, poses) = thread::scope(|scope| {
        let receiver = deliver_all(scope, profilers, plan.silence, &done);
        let (robot, done, over_now) = (carrier.robot.as_mut(), &done, &over);
        let follower = scope.spawn(move || follow(robot, plan, &sender, done, over_now));
        let (took, told) = collect(&receiver, &moves, done, watch);
        over.store(true, Ordering::Release);
        // A panic there has said so already; the scan then has no poses, and says that.
        let poses = follower.join().unwrap_or_default();
        poses
            .poses
            .iter()
            .skip(told)
            .for_each(|pose| watch.pose(pose));
        (took, poses)
    });
    for (profiling, took) in profilers.iter().zip(&took) {
        lost(&profiling.name, took.error.as_ref(), watch);
    }
    lost(&carrier.name, poses.error.as_ref(), watch);
    Ok(CarriedRun { took, poses })
}

impl CarriedRun {
    /// Why the run is no whole one, in words; nothing where it is.
    pub fn broken(&self, profilers: &[Profiling], carrier: &Carrier) -> Option<String> {
        let track = track_of(&self.poses.poses, carrier.plan.machine_from_base);
        let of_profilers = profilers.iter().zip(&self.took).find_map(|(p, took)| {
            let error = took.error.as_ref().map(|error| chain(error));
            let silent = took.fell_silent.then(|| "it fell silent".to_owned());
            Some(format!("{}: {}", p.name, error.or(silent)?))
        });
        let sound = self.poses.reached && self.poses.error.is_none();
        of_profilers.or_else(|| match sound {
            true => None,
            false => Some(robot_findings(carrier, &self.poses, &track).swap_remove(0)),
        })
    }

    fn record<'a>(&'a self, profilers: &'a [Profiling], plan: &CarrierPlan) -> CarriedRecord<'a> {
        let views = profilers.iter().zip(&self.took);
        let views = views.map(|(profiling, took)| CarriedView {
            device: &profiling.name,
            tool_from_sensor: profiling.calibration.machine_from_sensor,
            profiles: &took.profiles,
        });
        CarriedRecord {
            views: views.collect(),
            poses: &self.poses.poses,
            machine_from_base: plan.machine_from_base,
            lag_s: plan.lag_s,
        }
    }

    /// What the profiler `view` saw, in the tool by the robot's clock, to find the lag with. `None` where a clock is none.
    pub fn pass(&self, view: usize, profiling: &Profiling, carrier: &Carrier) -> Option<Pass> {
        CarriedRecord {
            // The others tell nothing of this one's clock.
            views: vec![CarriedView {
                device: &profiling.name,
                tool_from_sensor: profiling.calibration.machine_from_sensor,
                profiles: &self.took[view].profiles,
            }],
            ..self.record(&[], &carrier.plan)
        }
        .pass()
    }
}

fn lost(device: &str, error: Option<&DeviceError>, watch: &mut dyn ScanWatch) {
    if let Some(error) = error {
        watch.event(ScanEvent::Lost {
            device: device.to_owned(),
            error: chain(error),
        });
    }
}

/// Reads the robot until the profilers have ended; tells them to when it is at its end, or gone.
fn follow(
    robot: &mut dyn Robot,
    plan: CarrierPlan,
    moves: &Sender<(Pose, f64)>,
    done: &[AtomicBool],
    over: &AtomicBool,
) -> Poses {
    let mut brought = Poses::default();
    let mut farthest_mm: f64 = 0.0;
    let mut moved = Instant::now();
    let mut rests_at: Option<DVec3> = None;
    let mut ended: Option<Instant> = None;
    let finish = || done.iter().for_each(|d| d.store(true, Ordering::Release));
    loop {
        if over.load(Ordering::Acquire) {
            // One more pose, so that the last profile has one behind it.
            let since = *ended.get_or_insert_with(Instant::now);
            let behind = brought.poses.last().is_some_and(|p| p.host_time > since);
            if behind || since.elapsed() > AFTERWARDS || brought.error.is_some() {
                break;
            }
        }
        if brought.error.is_some() {
            // Nothing more comes; the profilers are ending.
            thread::park_timeout(POLL);
            continue;
        }
        match robot.next(Instant::now() + POLL) {
            Ok(Some(pose)) => {
                let stands = DVec3::from(pose.position_mm);
                if rests_at.is_none_or(|rest| rest.distance(stands) > REST_MM) {
                    rests_at = Some(stands);
                    moved = Instant::now();
                } else if moved.elapsed() > plan.silence {
                    finish();
                }
                let from_end = stands.distance(plan.end_mm);
                farthest_mm = farthest_mm.max(from_end);
                let mut share = 0.0;
                if farthest_mm > plan.within_mm {
                    share = 1.0 - from_end / farthest_mm;
                    if from_end <= plan.within_mm && !brought.reached {
                        brought.reached = true;
                        finish();
                    }
                }
                // The watcher may have gone; that ends no scan.
                let _ = moves.send((pose, share));
                brought.poses.push(pose);
            }
            Ok(None) if moved.elapsed() > plan.silence => finish(),
            Ok(None) => {}
            Err(error) => {
                brought.error = Some(error);
                finish();
            }
        }
    }
    if brought.error.is_none() {
        match robot.stop() {
            Ok(under_way) => brought.poses.extend(under_way),
            Err(error) => brought.error = Some(error),
        }
    }
    brought.losses = robot.losses();
    brought
}

/// What came of the profilers, and how many poses the watcher was told of.
fn collect(
    receiver: &Receiver<Message>,
    moves: &Receiver<(Pose, f64)>,
    done: &[AtomicBool],
    watch: &mut dyn ScanWatch,
) -> (Vec<Took>, usize) {
    let mut took: Vec<Took> = done.iter().map(|_| Took::default()).collect();
    let (mut profiles, mut share, mut told) = (0, 0.0, 0);
    loop {
        let message = receiver.recv_timeout(POLL);
        for (pose, now) in moves.try_iter() {
            watch.pose(&pose);
            (share, told) = (now, told + 1);
        }
        match message {
            Ok(Message::Profile(view, profile)) => {
                // Where it lies is known when the run is over.
                watch.profile(view, &profile, &[]);
                took[view].profiles.push(*profile);
                profiles += 1;
                watch.event(ScanEvent::Progress { profiles, share });
            }
            Ok(Message::Ended {
                view,
                losses,
                error,
            }) => {
                took[view].losses = losses;
                took[view].fell_silent = error.is_none() && !done[view].load(Ordering::Acquire);
                took[view].error = error;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if watch.aborted() {
            done.iter()
                .for_each(|view| view.store(true, Ordering::Release));
        }
    }
    (took, told)
}

// ---- Placing ----------------------------------------------------------------------------------------------------------

/// Why profiles of a view have no pose.
#[derive(Default)]
struct Unplaced {
    outside: u64,
    missing: u64,
    no_clock: u64,
}

impl Unplaced {
    fn sum(&self) -> u64 {
        self.outside + self.missing + self.no_clock
    }

    fn findings(&self, device: &str, robot: &str) -> Vec<String> {
        let [no_clock, missing, outside] = [self.no_clock, self.missing, self.outside];
        let told = [
            (
                no_clock,
                format!(
                    "{device}: {no_clock} profiles without a usable time were left out; check that {device}'s clock is on"
                ),
            ),
            (
                missing,
                format!(
                    "{device}: {missing} profiles were left out where {robot} sent no poses; check its network and its load"
                ),
            ),
            (
                outside,
                format!(
                    "{device}: {outside} profiles lie before the first or after the last pose of {robot} and were left out"
                ),
            ),
        ];
        let told = told.into_iter().filter(|(count, _)| *count > 0);
        told.map(|(_, sentence)| sentence).collect()
    }
}

impl CarriedRecord<'_> {
    /// The points of all views in the machine frame.
    pub fn cloud(&self) -> PointCloud {
        let mut cloud = empty_cloud();
        for (index, placed) in self.place().1.into_iter().enumerate() {
            append(&mut cloud, placed.cloud, index as u16);
        }
        cloud
    }

    /// What its only profiler saw, in the tool by the robot's clock, to find the lag with. `None` where a clock is none, or of several profilers.
    pub fn pass(&self) -> Option<Pass> {
        let [view] = &self.views[..] else {
            return None;
        };
        let times = self.times().pop()??;
        let seen = view.profiles.iter().zip(times).map(|(profile, time_s)| {
            let columns = profile.x_mm.iter().zip(&profile.z_mm);
            let seen = columns.filter(|(x, z)| x.is_finite() && z.is_finite());
            let in_tool = seen.map(|(x, z)| view.tool_from_sensor.point(DVec3::new(*x, 0.0, *z)));
            (time_s, in_tool.collect())
        });
        Some(Pass {
            track: track_of(self.poses, self.machine_from_base),
            profiles: seen.collect(),
        })
    }

    fn place(&self) -> (PoseTrack, Vec<PlacedView>) {
        let track = track_of(self.poses, self.machine_from_base);
        let views = self.views.iter().zip(self.times());
        let placed = views.map(|(view, times)| {
            let times = times.map(|times| times.iter().map(|t| t + self.lag_s).collect());
            place_view(view, times, &track)
        });
        let placed = placed.collect();
        (track, placed)
    }

    /// Times of the profiles of every view by the robot's clock, no lag added; `None` where a clock is none.
    fn times(&self) -> Vec<Option<Vec<f64>>> {
        let received = self.poses.iter().map(|pose| pose.host_time);
        let profiles = self.views.iter().flat_map(|view| view.profiles);
        let received = received.chain(profiles.map(|profile| profile.host_time));
        // Any moment would do; this one is told by the record itself.
        let Some(began) = received.min() else {
            return self.views.iter().map(|_| None).collect();
        };
        let poses = self.poses.iter().map(|p| (p.device_time_s, p.host_time));
        let robot_clock = fit_clock(&receipts(poses, began));
        let time_s = |profile: &Profile| profile.device_time_ns as f64 * 1e-9;
        let times = self.views.iter().map(|view| {
            let received = view.profiles.iter().map(|p| (time_s(p), p.host_time));
            let clock = fit_clock(&receipts(received, began))?;
            let robot_clock = robot_clock?;
            let times = view.profiles.iter().map(time_s);
            Some(times.map(|t| robot_clock.device(clock.host(t))).collect())
        });
        times.collect()
    }
}

/// The poses of the tool in the machine, by the robot's clock.
fn track_of(poses: &[Pose], machine_from_base: RigidTransform) -> PoseTrack {
    let mut track = PoseTrack::default();
    for pose in poses {
        let turn = DQuat::from_scaled_axis(pose.rotation.into());
        let base_from_tool = RigidTransform::new(turn, pose.position_mm.into());
        track.push(pose.device_time_s, machine_from_base * base_from_tool);
    }
    track
}

fn empty_cloud() -> PointCloud {
    PointCloud {
        frame: Frame::Machine,
        positions: Vec::new(),
        origins: Vec::new(),
        views: Vec::new(),
    }
}

fn place(profilers: &[Profiling], run: CarriedRun, carrier: &Carrier) -> Scan {
    let (track, placed) = run.record(profilers, &carrier.plan).place();
    let poses = &run.poses;
    let of_robot = robot_findings(carrier, poses, &track);
    let sound = poses.reached && poses.error.is_none();
    let mut cloud = empty_cloud();
    let mut views = Vec::new();
    for ((profiling, took), placed) in profilers.iter().zip(&run.took).zip(placed) {
        let mut findings = if views.is_empty() {
            of_robot.clone()
        } else {
            Vec::new()
        };
        findings.extend(placed.unplaced.findings(&profiling.name, &carrier.name));
        if let Some(error) = &took.error {
            findings.push(format!(
                "{}: lost during the scan: {}",
                profiling.name,
                chain(error)
            ));
        }
        if took.fell_silent {
            findings.push(format!(
                "{}: silent for {} s before {} was at its end",
                profiling.name,
                carrier.plan.silence.as_secs_f64(),
                carrier.name
            ));
        }
        append(&mut cloud, placed.cloud, views.len() as u16);
        views.push(ViewRecord {
            device: profiling.name.clone(),
            identity: profiling.profiler.identity().clone(),
            losses: took.losses,
            unplaced: placed.unplaced.sum(),
            empty_columns: placed.empty_columns,
            // A gap in the poses is a gap in the scan, as a lost profile is: what was left out is counted.
            complete: sound && took.error.is_none() && !took.fell_silent && placed.profiles > 0,
            findings,
        });
    }
    Scan { cloud, views }
}

fn robot_findings(carrier: &Carrier, poses: &Poses, track: &PoseTrack) -> Vec<String> {
    let (name, plan) = (&carrier.name, &carrier.plan);
    let mut findings = Vec::new();
    if let Some(error) = &poses.error {
        findings.push(format!("{name}: lost during the scan: {}", chain(error)));
    } else if !poses.reached {
        let stood = poses.poses.last().map_or("no pose".to_owned(), |pose| {
            let [x, y, z] = pose.position_mm;
            format!("the tool stood at {x:.1}, {y:.1}, {z:.1} mm")
        });
        let DVec3 { x, y, z } = plan.end_mm;
        findings.push(format!(
            "{name}: the scan ended before the robot was at its end: {stood}, expected {x:.1}, {y:.1}, {z:.1} mm; check that its \
             program ran to its end"
        ));
    }
    let Losses {
        lost_on_link,
        rejected,
        ..
    } = poses.losses;
    if lost_on_link + rejected + track.refused() > 0 {
        findings.push(format!(
            "{name}: {lost_on_link} poses missing by its clock, {rejected} rejected, {} out of order, {} used",
            track.refused(),
            poses.losses.received.saturating_sub(track.refused())
        ));
    }
    findings
}

fn receipts(of: impl Iterator<Item = (f64, Instant)>, began: Instant) -> Vec<(f64, f64)> {
    of.map(|(device_s, at)| (device_s, at.saturating_duration_since(began).as_secs_f64()))
        .collect()
}

struct PlacedView {
    cloud: PointCloud,
    unplaced: Unplaced,
    empty_columns: u64,
    profiles: u64,
}

fn place_view(view: &CarriedView<'_>, times_s: Option<Vec<f64>>, track: &PoseTrack) -> PlacedView {
    let mut placed = PlacedView {
        cloud: empty_cloud(),
        unplaced: Unplaced::default(),
        empty_columns: 0,
        profiles: 0,
    };
    let mut towards_sensor = DVec3::ZERO;
    if let Some(times) = times_s {
        for (profile, pose) in view.profiles.iter().zip(track.at(&times)) {
            match pose {
                Ok(machine_from_tool) => {
                    let machine_from_sensor = machine_from_tool * view.tool_from_sensor;
                    towards_sensor += machine_from_sensor.vector(DVec3::NEG_Z);
                    placed.add(profile, machine_from_sensor);
                }
                Err(PoseGap::Missing { .. }) => placed.unplaced.missing += 1,
                Err(PoseGap::Outside { .. } | PoseGap::Empty(_)) => placed.unplaced.outside += 1,
            }
        }
    } else {
        placed.unplaced.no_clock = view.profiles.len() as u64;
    }
    placed.cloud.views.push(View {
        device: view.device.to_owned(),
        // The mean over the run: a robot that turns by less than a right angle leaves it on the sensor's side.
        towards_sensor: towards_sensor.try_normalize().unwrap_or(DVec3::Z),
    });
    placed
}

impl PlacedView {
    fn add(&mut self, profile: &Profile, machine_from_sensor: RigidTransform) {
        self.profiles += 1;
        let index = profile.sequence.saturating_add(profile.dropped);
        for (column, (&x_mm, &z_mm)) in profile.x_mm.iter().zip(&profile.z_mm).enumerate() {
            if !z_mm.is_finite() {
                self.empty_columns += 1;
                continue;
            }
            let in_sensor = DVec3::new(x_mm, 0.0, z_mm);
            self.cloud
                .positions
                .push(machine_from_sensor.point(in_sensor));
            self.cloud.origins.push(Origin {
                view: 0,
                column: column as u16,
                profile: index,
            });
        }
    }
}
