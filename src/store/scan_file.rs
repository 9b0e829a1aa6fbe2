//! The raw profiles of one run in a file: bit for bit, compact, whole or not at all.
//!
//! ```text
//! "ACIESRAW" 1   then chunks:   kind u8 | length u32 | CRC-32C u32 | payload
//! ```
//!
//! Little-endian throughout. A chunk of kind 0 names a view (JSON), one of kind 1 holds profiles (zstd), one of kind 2 is the
//! end of a run that was not cut short. While the run lasts the file is called `NAME.part`; each chunk is handed to the system as
//! soon as it is full, so that after a crash everything up to the last whole chunk can be read. A chunk of profiles holds the
//! numbers of each profile as the difference (exclusive or) to the profile before, one byte plane after the other: a sensor's
//! grid stands still and its heights change little, so that most planes are zeros.
//!
//! Where a robot carried the profilers there is more, for the points follow from poses and clocks: a chunk of kind 3 holds poses
//! (zstd; time of the robot's clock, position, turn: seven f64; receipt), one of kind 4 stands before the profiles of a view and
//! says when each was received (zstd; view u16, receipts). A receipt is an i64: nanoseconds of the host's clock from the first
//! receipt in the file on.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use acies_drivers::capture::{Pose, Profile};
use acies_drivers::device::Identity;
use crc::{CRC_32_ISCSI, Crc};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::acquire::{Assembler, Calibration, CarriedRecord, CarriedView};
use crate::geometry::RigidTransform;
use crate::points::PointCloud;

const MAGIC: &[u8; 9] = b"ACIESRAW\x01";
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
/// A chunk is closed when it holds so many columns: 1 MiB of numbers.
const COLUMNS_A_CHUNK: usize = 1 << 16;
/// No chunk of ours is larger, packed or not; a file that says so is damaged.
const CHUNK_MAX: usize = 64 << 20;
/// Columns of one profile.
const COLUMNS_MAX: usize = 1 << 16;

const VIEW: u8 = 0;
const PROFILES: u8 = 1;
const END: u8 = 2;
const POSES: u8 = 3;
const RECEIPTS: u8 = 4;
/// Poses that are kept back at most: a second of a robot that sends every 2 ms.
const POSES_A_CHUNK: usize = 500;
/// Bytes of a pose: eight numbers.
const POSE: usize = 64;

/// Why a scan's file could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ScanFileError {
    /// The file.
    #[error("{path}: {source}; check that the disk is not full and that the folder may be written")]
    File {
        /// Which.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// What stands in it.
    #[error(
        "{path}, byte {byte}: {found}, expected {expected}; the file is damaged, restore it from a backup"
    )]
    Damaged {
        /// Which.
        path: PathBuf,
        /// Where.
        byte: u64,
        /// What was seen.
        found: String,
        /// What belongs there.
        expected: &'static str,
    },
    /// The points of a run by a robot, in a file of a version that did not keep poses.
    #[error(
        "{path}: a robot carried the profilers, and its poses are not in this old file: the profiles can be read, the points cannot be placed again"
    )]
    Carried {
        /// Which.
        path: PathBuf,
    },
}

/// One profiler of a stored run.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredView {
    /// The device's name in the cell's configuration.
    pub device: String,
    /// Who it said it is.
    pub identity: Identity,
    /// Where it was.
    pub calibration: Calibration,
    /// Whether a robot carried it.
    pub carried: bool,
    /// That robot; `None` also in files of versions that did not keep its poses.
    pub carrier: Option<StoredCarrier>,
}

/// The robot that carried the profilers of a stored run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoredCarrier {
    /// Where its base stood.
    pub machine_from_base: RigidTransform,
    /// Added to the time of a profile before its pose is looked up, s.
    pub lag_s: f64,
}

/// [`StoredView`] in JSON.
#[derive(Serialize, Deserialize)]
struct WireView {
    device: String,
    vendor: String,
    model: String,
    serial: String,
    firmware: String,
    /// x, y, z, w.
    rotation: [f64; 4],
    translation_mm: [f64; 3],
    travel_mm_per_count: [f64; 3],
    #[serde(default)]
    carried: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    carrier: Option<WireCarrier>,
}

/// [`StoredCarrier`] in JSON.
#[derive(Serialize, Deserialize)]
struct WireCarrier {
    /// x, y, z, w.
    rotation: [f64; 4],
    translation_mm: [f64; 3],
    lag_s: f64,
}

/// Writes the profiles of a run while it lasts.
#[derive(Debug)]
pub struct ScanWriter {
    path: PathBuf,
    part: PathBuf,
    file: BufWriter<File>,
    pending: Vec<Chunk>,
    poses: Vec<u8>,
    /// The first receipt, where a robot carries the profilers.
    first: Option<Instant>,
    carried: bool,
    bytes: u64,
    profiles: u64,
}

/// Profiles of one view that are not yet written.
#[derive(Debug, Default)]
struct Chunk {
    profiles: Vec<u8>,
    numbers: Vec<u64>,
    before: Vec<u64>,
    receipts: Vec<u8>,
}

impl ScanWriter {
    /// Begins the file that will be called `path`.
    ///
    /// # Errors
    /// [`ScanFileError::File`].
    pub fn create(path: &Path, views: &[StoredView]) -> Result<Self, ScanFileError> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        let file = File::create(&part).map_err(|source| ScanFileError::File {
            path: part.clone(),
            source,
        })?;
        let mut writer = Self {
            path: path.to_owned(),
            part,
            file: BufWriter::new(file),
            pending: views.iter().map(|_| Chunk::default()).collect(),
            poses: Vec::new(),
            first: None,
            carried: views.iter().any(|view| view.carrier.is_some()),
            bytes: MAGIC.len() as u64,
            profiles: 0,
        };
        let begun = writer.file.write_all(MAGIC);
        writer.io(begun)?;
        for view in views {
            let json = serde_json::to_vec(&wire(view)).unwrap_or_default();
            writer.chunk(VIEW, &json)?;
        }
        Ok(writer)
    }

    /// Takes one profile of `view`.
    ///
    /// # Errors
    /// [`ScanFileError::File`]; the run may go on, its file is lost.
    pub fn push(&mut self, view: usize, profile: &Profile) -> Result<(), ScanFileError> {
        if self.carried {
            let receipt = self.receipt(profile.host_time);
            self.pending[view].receipts.extend(receipt.to_le_bytes());
        }
        self.pending[view].push(profile);
        self.profiles += 1;
        if self.pending[view].numbers.len() >= 2 * COLUMNS_A_CHUNK {
            self.flush(view)?;
        }
        Ok(())
    }

    /// Takes one pose of the robot.
    ///
    /// # Errors
    /// As [`ScanWriter::push`].
    pub fn push_pose(&mut self, pose: &Pose) -> Result<(), ScanFileError> {
        let numbers = [pose.device_time_s].into_iter();
        let numbers = numbers.chain(pose.position_mm).chain(pose.rotation);
        let receipt = self.receipt(pose.host_time);
        for number in numbers {
            self.poses.extend(number.to_le_bytes());
        }
        self.poses.extend(receipt.to_le_bytes());
        if self.poses.len() >= POSES_A_CHUNK * POSE {
            self.flush_poses()?;
        }
        Ok(())
    }

    /// Nanoseconds from the first receipt to `at`.
    fn receipt(&mut self, at: Instant) -> i64 {
        let first = *self.first.get_or_insert(at);
        let nanos = |time: Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
        match at.checked_duration_since(first) {
            Some(later) => nanos(later),
            None => -nanos(first.duration_since(at)),
        }
    }

    /// Ends the file, brings it onto the disk and gives it its name. Returns its size, bytes; 0 where there was no profile,
    /// and then no file either. `whole` says whether the run came to its end.
    ///
    /// # Errors
    /// [`ScanFileError::File`]; the file then still is called `.part`.
    pub fn finish(mut self, whole: bool) -> Result<u64, ScanFileError> {
        if self.profiles == 0 {
            let removed = fs::remove_file(&self.part);
            return self.io(removed).map(|()| 0);
        }
        for view in 0..self.pending.len() {
            self.flush(view)?;
        }
        self.flush_poses()?;
        if whole {
            self.chunk(END, &[])?;
        }
        let placed = self
            .file
            .flush()
            .and_then(|()| self.file.get_ref().sync_all())
            .and_then(|()| fs::rename(&self.part, &self.path))
            .and_then(|()| sync_folder(&self.path));
        self.io(placed)?;
        Ok(self.bytes)
    }

    fn flush(&mut self, view: usize) -> Result<(), ScanFileError> {
        let chunk = std::mem::take(&mut self.pending[view]);
        if chunk.profiles.is_empty() {
            return Ok(());
        }
        self.flush_poses()?;
        if !chunk.receipts.is_empty() {
            let mut plain = (view as u16).to_le_bytes().to_vec();
            plain.extend(&chunk.receipts);
            self.chunk(RECEIPTS, &packed(&plain))?;
        }
        self.chunk(PROFILES, &packed(&chunk.plain(view)))?;
        let flushed = self.file.flush();
        self.io(flushed)
    }

    fn flush_poses(&mut self) -> Result<(), ScanFileError> {
        let poses = std::mem::take(&mut self.poses);
        if poses.is_empty() {
            return Ok(());
        }
        self.chunk(POSES, &packed(&poses))
    }

    fn chunk(&mut self, kind: u8, payload: &[u8]) -> Result<(), ScanFileError> {
        let mut head = vec![kind];
        head.extend((payload.len() as u32).to_le_bytes());
        head.extend(CRC.checksum(payload).to_le_bytes());
        let written = self
            .file
            .write_all(&head)
            .and_then(|()| self.file.write_all(payload));
        self.bytes += (head.len() + payload.len()) as u64;
        self.io(written)
    }

    fn io<T>(&self, result: io::Result<T>) -> Result<T, ScanFileError> {
        result.map_err(|source| ScanFileError::File {
            path: self.part.clone(),
            source,
        })
    }
}

/// A renamed file is only safe once its folder is on the disk.
fn sync_folder(path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(folder) if cfg!(unix) => File::open(folder)?.sync_all(),
        _ => Ok(()),
    }
}

impl Chunk {
    fn push(&mut self, profile: &Profile) {
        let columns = profile.x_mm.len().min(profile.z_mm.len()).min(COLUMNS_MAX);
        let flags = u8::from(profile.saturated) | u8::from(profile.encoder.is_some()) << 1;
        let intensities = profile.intensity.len().min(COLUMNS_MAX);
        self.profiles.extend(profile.sequence.to_le_bytes());
        self.profiles.extend(profile.boot.to_le_bytes());
        self.profiles.extend(profile.device_time_ns.to_le_bytes());
        self.profiles
            .extend(profile.encoder.unwrap_or(0).to_le_bytes());
        self.profiles.extend(profile.dropped.to_le_bytes());
        self.profiles.push(flags);
        self.profiles.extend((columns as u32).to_le_bytes());
        self.profiles.extend((intensities as u32).to_le_bytes());
        for value in &profile.intensity[..intensities] {
            self.profiles.extend(value.to_le_bytes());
        }
        let numbers = profile.x_mm[..columns]
            .iter()
            .chain(&profile.z_mm[..columns]);
        let numbers: Vec<u64> = numbers.map(|number| number.to_bits()).collect();
        let before = std::mem::take(&mut self.before);
        let changed = numbers.iter().enumerate();
        self.numbers
            .extend(changed.map(|(i, &n)| n ^ before.get(i).copied().unwrap_or(0)));
        self.before = numbers;
    }

    fn plain(&self, view: usize) -> Vec<u8> {
        let mut plain = Vec::with_capacity(10 + self.profiles.len() + 8 * self.numbers.len());
        plain.extend((view as u16).to_le_bytes());
        plain.extend((self.profiles.len() as u32).to_le_bytes());
        plain.extend((self.numbers.len() as u32).to_le_bytes());
        plain.extend(&self.profiles);
        for plane in 0..8 {
            plain.extend(
                self.numbers
                    .iter()
                    .map(|number| (number >> (8 * plane)) as u8),
            );
        }
        plain
    }
}

fn packed(plain: &[u8]) -> Vec<u8> {
    // Level 1: the byte planes do most of the work, and the run waits for us. Memory is read and written: that cannot fail.
    zstd::encode_all(plain, 1).unwrap_or_default()
}

/// Reads the profiles of a run, one chunk at a time.
#[derive(Debug)]
pub struct ScanReader<R = BufReader<File>> {
    path: PathBuf,
    file: R,
    at: u64,
    views: Vec<StoredView>,
    /// A chunk that was read while looking for the last view.
    ahead: Option<(u8, Vec<u8>)>,
    /// What receipts are told from.
    first: Instant,
    poses: Vec<Pose>,
    /// Receipts of profiles that are still to come, by view.
    receipts: Vec<VecDeque<i64>>,
    ended: bool,
}

impl ScanReader {
    /// Opens a file that is whole, or the `.part` of a run that a crash cut off.
    ///
    /// # Errors
    /// [`ScanFileError`].
    pub fn open(path: &Path) -> Result<Self, ScanFileError> {
        let file = File::open(path).map_err(|source| ScanFileError::File {
            path: path.to_owned(),
            source,
        })?;
        Self::read(BufReader::new(file), path)
    }
}

impl<R: Read> ScanReader<R> {
    /// Reads from `file`, which errors call `path`.
    ///
    /// # Errors
    /// [`ScanFileError`].
    pub fn read(file: R, path: &Path) -> Result<Self, ScanFileError> {
        let mut reader = Self {
            path: path.to_owned(),
            file,
            at: 0,
            views: Vec::new(),
            ahead: None,
            first: Instant::now(),
            poses: Vec::new(),
            receipts: Vec::new(),
            ended: false,
        };
        let mut magic = [0; MAGIC.len()];
        if reader.file.read_exact(&mut magic).is_err() || magic != *MAGIC {
            return Err(reader.damaged(
                format!("{:?}", magic.escape_ascii().to_string()),
                "ACIESRAW, version 1",
            ));
        }
        reader.at = MAGIC.len() as u64;
        while let Some((kind, payload)) = reader.chunk()? {
            if kind != VIEW {
                reader.ahead = Some((kind, payload));
                break;
            }
            let wire = serde_json::from_slice::<WireView>(&payload);
            let wire = wire.map_err(|error| reader.damaged(error.to_string(), "a view in JSON"))?;
            reader.views.push(unwire(wire));
            reader.receipts.push(VecDeque::new());
        }
        Ok(reader)
    }

    /// The profilers of the run.
    pub fn views(&self) -> &[StoredView] {
        &self.views
    }

    /// Whether the end of the run was reached; known once [`ScanReader::profiles`] gave `None`.
    pub fn whole(&self) -> bool {
        self.ended
    }

    /// The points of the whole run in the machine frame, placed as they were when it was measured: the same bits.
    ///
    /// # Errors
    /// As [`ScanReader::profiles`].
    pub fn into_cloud(mut self) -> Result<PointCloud, ScanFileError> {
        if self.views.iter().any(|view| view.carried) {
            return self.carried_cloud();
        }
        let views = self.views.iter();
        let mut assemblers: Vec<Assembler> = views
            .map(|view| Assembler::new(&view.device, view.calibration))
            .collect();
        while let Some((view, profiles)) = self.profiles()? {
            for profile in &profiles {
                assemblers[view].push(profile);
            }
        }
        let clouds: Vec<PointCloud> = assemblers.into_iter().map(|a| a.finish().0).collect();
        PointCloud::merge(&clouds)
            .map_err(|error| self.damaged(error.to_string(), "at least one view"))
    }

    /// The points of a run by a robot: as its profiles came together, so they are placed.
    fn carried_cloud(mut self) -> Result<PointCloud, ScanFileError> {
        let Some(carrier) = self.views.iter().find_map(|view| view.carrier) else {
            return Err(ScanFileError::Carried { path: self.path });
        };
        let mut taken: Vec<Vec<Profile>> = self.views.iter().map(|_| Vec::new()).collect();
        while let Some((view, profiles)) = self.profiles()? {
            taken[view].extend(profiles);
        }
        let views = self.views.iter().zip(&taken);
        let record = CarriedRecord {
            views: views
                .map(|(view, profiles)| CarriedView {
                    device: &view.device,
                    tool_from_sensor: view.calibration.machine_from_sensor,
                    profiles,
                })
                .collect(),
            poses: &self.poses,
            machine_from_base: carrier.machine_from_base,
            lag_s: carrier.lag_s,
        };
        Ok(record.cloud())
    }

    /// The robot's poses that were read since this was last asked, in order.
    pub fn take_poses(&mut self) -> Vec<Pose> {
        std::mem::take(&mut self.poses)
    }

    /// The profiles of the next chunk, each with the index of its view; `None` at the end, or where a crash cut the file off.
    ///
    /// # Errors
    /// [`ScanFileError`] where what stands there is damaged and not merely missing.
    pub fn profiles(&mut self) -> Result<Option<(usize, Vec<Profile>)>, ScanFileError> {
        loop {
            let next = match self.ahead.take() {
                Some(chunk) => Some(chunk),
                None => self.chunk()?,
            };
            match next {
                Some((PROFILES, payload)) => return self.unpack(&payload).map(Some),
                Some((POSES, payload)) => self.unpack_poses(&payload)?,
                Some((RECEIPTS, payload)) => self.unpack_receipts(&payload)?,
                Some((END, _)) => {
                    self.ended = true;
                    return Ok(None);
                }
                Some((kind, _)) => {
                    let found = format!("a chunk of kind {kind}");
                    return Err(self.damaged(found, "profiles, poses or the end"));
                }
                None => return Ok(None),
            }
        }
    }

    /// The next chunk; `None` where the file ends, be it in the middle of one.
    fn chunk(&mut self) -> Result<Option<(u8, Vec<u8>)>, ScanFileError> {
        let mut head = [0; 9];
        if !self.fill(&mut head)? {
            return Ok(None);
        }
        let length = u32::from_le_bytes([head[1], head[2], head[3], head[4]]) as usize;
        let crc = u32::from_le_bytes([head[5], head[6], head[7], head[8]]);
        if length > CHUNK_MAX {
            return Err(self.damaged(format!("a chunk of {length} bytes"), "at most 64 MiB"));
        }
        let mut payload = Vec::new();
        let mut limited = (&mut self.file).take(length as u64);
        let read = limited.read_to_end(&mut payload);
        read.map_err(|source| ScanFileError::File {
            path: self.path.clone(),
            source,
        })?;
        if payload.len() < length {
            return Ok(None);
        }
        if CRC.checksum(&payload) != crc {
            return Err(self.damaged("a wrong checksum".to_owned(), "the CRC-32C of the chunk"));
        }
        self.at += (head.len() + length) as u64;
        Ok(Some((head[0], payload)))
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<bool, ScanFileError> {
        match self.file.read_exact(bytes) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
            Err(source) => Err(ScanFileError::File {
                path: self.path.clone(),
                source,
            }),
        }
    }

    fn plain(&self, payload: &[u8]) -> Result<Vec<u8>, ScanFileError> {
        zstd::bulk::decompress(payload, CHUNK_MAX)
            .map_err(|error| self.damaged(error.to_string(), "a chunk packed by zstd"))
    }

    fn unpack_poses(&mut self, payload: &[u8]) -> Result<(), ScanFileError> {
        let plain = self.plain(payload)?;
        let (poses, []) = plain.as_chunks::<POSE>() else {
            return Err(self.damaged(format!("{} bytes", plain.len()), "poses of 64 bytes"));
        };
        for pose in poses {
            let (numbers, _) = pose.as_chunks::<8>();
            let number = |index: usize| f64::from_le_bytes(numbers[index]);
            let receipt = i64::from_le_bytes(numbers[7]);
            self.poses.push(Pose {
                device_time_s: number(0),
                position_mm: [number(1), number(2), number(3)],
                rotation: [number(4), number(5), number(6)],
                host_time: self.received(receipt)?,
            });
        }
        Ok(())
    }

    fn unpack_receipts(&mut self, payload: &[u8]) -> Result<(), ScanFileError> {
        let plain = self.plain(payload)?;
        let mut bytes = Bytes(&plain);
        let view = bytes.u16().map_or(usize::MAX, usize::from);
        let (receipts, []) = bytes.0.as_chunks::<8>() else {
            return Err(self.damaged(format!("{} bytes", plain.len()), "receipts of 8 bytes"));
        };
        let Some(waiting) = self.receipts.get_mut(view) else {
            return Err(self.damaged(format!("view {view}"), "a view that the file names"));
        };
        waiting.extend(receipts.iter().map(|bytes| i64::from_le_bytes(*bytes)));
        Ok(())
    }

    /// The moment of a receipt; where it stands says nothing, only how far it is from the others.
    fn received(&self, receipt: i64) -> Result<Instant, ScanFileError> {
        let apart = Duration::from_nanos(receipt.unsigned_abs());
        let at = if receipt < 0 {
            self.first.checked_sub(apart)
        } else {
            self.first.checked_add(apart)
        };
        at.ok_or_else(|| self.damaged(format!("a receipt at {receipt} ns"), "a moment of the run"))
    }

    fn unpack(&mut self, payload: &[u8]) -> Result<(usize, Vec<Profile>), ScanFileError> {
        let plain = self.plain(payload)?;
        let short = || {
            self.damaged(
                "too few bytes".to_owned(),
                "the profiles that the chunk announces",
            )
        };
        let mut bytes = Bytes(&plain);
        let view = usize::from(bytes.u16().ok_or_else(short)?);
        if view >= self.views.len() {
            return Err(self.damaged(format!("view {view}"), "a view that the file names"));
        }
        let head = bytes.u32().ok_or_else(short)? as usize;
        let count = bytes.u32().ok_or_else(short)? as usize;
        let mut heads = Bytes(bytes.take(head).ok_or_else(short)?);
        let planes = bytes.take(8 * count).ok_or_else(short)?;
        let number = |index: usize| {
            let byte = |plane: usize| u64::from(planes[plane * count + index]) << (8 * plane);
            (0..8).map(byte).sum::<u64>()
        };
        let mut profiles = Vec::new();
        let mut before: Vec<u64> = Vec::new();
        let mut next = 0;
        while !heads.0.is_empty() {
            let (mut profile, columns) = profile_head(&mut heads).ok_or_else(short)?;
            if next + 2 * columns > count {
                return Err(short());
            }
            let numbers: Vec<u64> = (0..2 * columns)
                .map(|i| number(next + i) ^ before.get(i).copied().unwrap_or(0))
                .collect();
            next += 2 * columns;
            profile.x_mm = numbers[..columns]
                .iter()
                .map(|&n| f64::from_bits(n))
                .collect();
            profile.z_mm = numbers[columns..]
                .iter()
                .map(|&n| f64::from_bits(n))
                .collect();
            before = numbers;
            profiles.push(profile);
        }
        for profile in &mut profiles {
            if let Some(receipt) = self.receipts[view].pop_front() {
                profile.host_time = self.received(receipt)?;
            }
        }
        Ok((view, profiles))
    }

    fn damaged(&self, found: String, expected: &'static str) -> ScanFileError {
        ScanFileError::Damaged {
            path: self.path.clone(),
            byte: self.at,
            found,
            expected,
        }
    }
}

fn profile_head(bytes: &mut Bytes<'_>) -> Option<(Profile, usize)> {
    let sequence = bytes.u32()?;
    let boot = bytes.u32()?;
    let device_time_ns = bytes.u64()?;
    let encoder = bytes.u64()? as i64;
    let dropped = bytes.u32()?;
    let flags = bytes.take(1)?[0];
    let columns = bytes.u32()? as usize;
    let intensities = bytes.u32()? as usize;
    let intensity = bytes.take(2 * intensities)?;
    let pairs = intensity.as_chunks::<2>().0;
    let profile = Profile {
        sequence,
        boot,
        device_time_ns,
        encoder: (flags & 2 != 0).then_some(encoder),
        // The host's clock of a run that is over says nothing any more, but where a robot carried: then it is set behind this.
        host_time: Instant::now(),
        dropped,
        saturated: flags & 1 != 0,
        x_mm: Vec::new(),
        z_mm: Vec::new(),
        intensity: pairs.iter().map(|pair| u16::from_le_bytes(*pair)).collect(),
    };
    (columns <= COLUMNS_MAX).then_some((profile, columns))
}

/// What is left of some bytes.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    fn u16(&mut self) -> Option<u16> {
        Some(u16::from_le_bytes(*self.take(2)?.first_chunk()?))
    }

    fn u32(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(*self.take(4)?.first_chunk()?))
    }

    fn u64(&mut self) -> Option<u64> {
        Some(u64::from_le_bytes(*self.take(8)?.first_chunk()?))
    }
}

fn wire(view: &StoredView) -> WireView {
    let pose = view.calibration.machine_from_sensor;
    WireView {
        device: view.device.clone(),
        vendor: view.identity.vendor.clone(),
        model: view.identity.model.clone(),
        serial: view.identity.serial.clone(),
        firmware: view.identity.firmware.clone(),
        rotation: pose.rotation.to_array(),
        translation_mm: pose.translation.to_array(),
        travel_mm_per_count: view.calibration.travel_mm_per_count.to_array(),
        carried: view.carried,
        carrier: view.carrier.map(|carrier| WireCarrier {
            rotation: carrier.machine_from_base.rotation.to_array(),
            translation_mm: carrier.machine_from_base.translation.to_array(),
            lag_s: carrier.lag_s,
        }),
    }
}

fn unwire(wire: WireView) -> StoredView {
    StoredView {
        device: wire.device,
        identity: Identity {
            vendor: wire.vendor,
            model: wire.model,
            serial: wire.serial,
            firmware: wire.firmware,
        },
        calibration: Calibration {
            machine_from_sensor: RigidTransform {
                rotation: DQuat::from_array(wire.rotation),
                translation: DVec3::from_array(wire.translation_mm),
            },
            travel_mm_per_count: DVec3::from_array(wire.travel_mm_per_count),
        },
        carried: wire.carried,
        carrier: wire.carrier.map(|carrier| StoredCarrier {
            machine_from_base: RigidTransform {
                rotation: DQuat::from_array(carrier.rotation),
                translation: DVec3::from_array(carrier.translation_mm),
            },
            lag_s: carrier.lag_s,
        }),
    }
}
