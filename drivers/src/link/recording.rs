//! Recordings of what passed over a link: the file's form, its writer and its reader.
//!
//! # The file
//!
//! Numbers are little-endian. The file begins with the eight bytes `ACIESREC`, the format version u32 (1), the length u32 of the
//! target's name, that name in UTF-8, and the CRC-32C u32 of all that. Then follow records, each
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 1 | kind: 0 bytes from the device, 1 bytes to the device, 2 the link was gone, 3 the recording reached its size limit |
//! | 1 | 3 | 0 |
//! | 4 | 4 | length of the bytes, u32, at most 1 MiB |
//! | 8 | 8 | time, u64, ns since the link was opened, never decreasing |
//! | 16 | length | the bytes |
//! | 16 + length | 4 | CRC-32C of the record up to here |
//!
//! Each record is one write to the file, so that a program that dies leaves at most one torn record at the end. The reader
//! stops there and says so. The writer never makes the file longer than its limit; what passed after that is not in it.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::{Link, Links, Target};
use crate::error::LinkError;

const MAGIC: &[u8; 8] = b"ACIESREC";
const VERSION: u32 = 1;
const RECORD_HEADER: usize = 16;
/// Most bytes in one record; also bounds what a reader allocates for a lying length.
const LENGTH_MAX: usize = 1 << 20;
const NAME_MAX: usize = 4096;

const CRC: crc::Crc<u32, crc::Table<16>> = crc::Crc::<u32, crc::Table<16>>::new(&crc::CRC_32_ISCSI);

/// Why a recording cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be opened, created or read.
    #[error("{}: cannot be {action}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// Not a recording.
    #[error("{}: begins with {found:?}, a recording begins with \"ACIESREC\"", path.display())]
    NotARecording {
        /// The file.
        path: PathBuf,
        /// Its first bytes, as text.
        found: String,
    },
    /// A format of another version.
    #[error("{}: recording format {found}, this program reads {VERSION}; use the program that wrote it", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// As read.
        found: u32,
    },
    /// A header whose check fails or that is cut off.
    #[error("{}: the header is damaged at byte {byte}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// Where.
        byte: usize,
    },
}

/// What one record of a recording says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Bytes from the device.
    FromDevice,
    /// Bytes to the device.
    ToDevice,
    /// The link was gone.
    Gone,
    /// The recording reached its size limit; more passed than is in it.
    Limit,
}

impl Kind {
    fn number(self) -> u8 {
        match self {
            Kind::FromDevice => 0,
            Kind::ToDevice => 1,
            Kind::Gone => 2,
            Kind::Limit => 3,
        }
    }

    fn from_number(number: u8) -> Option<Kind> {
        [Kind::FromDevice, Kind::ToDevice, Kind::Gone, Kind::Limit]
            .into_iter()
            .find(|kind| kind.number() == number)
    }
}

/// One record: what passed at once, and when.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    /// Direction, or what happened.
    pub kind: Kind,
    /// Time since the link was opened.
    pub time: Duration,
    /// The bytes that passed.
    pub bytes: Vec<u8>,
}

/// A recording, read whole.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recording {
    /// What the recorded link led to, for people.
    pub target: String,
    /// What passed, in order of time.
    pub records: Vec<Record>,
    /// Byte at which a torn or damaged record begins; nothing after it was read. `None` where the file ends well.
    pub torn_at: Option<usize>,
}

impl Recording {
    /// Reads the recording in the file `path`.
    ///
    /// # Errors
    /// When it cannot be read, or its header says that it is no recording this program knows. A torn end is no error.
    pub fn read(path: &Path) -> Result<Recording, RecordingError> {
        let mut bytes = Vec::new();
        File::open(path)
            .and_then(|mut file| file.read_to_end(&mut bytes))
            .map_err(|source| RecordingError::File {
                path: path.into(),
                action: "read",
                source,
            })?;
        Recording::decode(&bytes, path)
    }

    /// Decodes the bytes of a recording; `path` appears in errors only.
    ///
    /// # Errors
    /// When the header says that it is no recording this program knows.
    pub fn decode(bytes: &[u8], path: &Path) -> Result<Recording, RecordingError> {
        let (target, mut at) = decode_header(bytes, path)?;
        let mut records = Vec::new();
        let mut last = Duration::ZERO;
        while let Some((record, used)) = decode_record(&bytes[at..]) {
            if record.time < last {
                break;
            }
            last = record.time;
            records.push(record);
            at += used;
        }
        Ok(Recording {
            target,
            records,
            torn_at: (at < bytes.len()).then_some(at),
        })
    }

    /// The recording as bytes of a file.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = encode_header(&self.target);
        for record in &self.records {
            encode_record(&mut bytes, record.kind, record.time, &record.bytes);
        }
        bytes
    }
}

fn encode_header(target: &str) -> Vec<u8> {
    let mut end = target.len().min(NAME_MAX);
    while !target.is_char_boundary(end) {
        end -= 1;
    }
    let mut bytes = MAGIC.to_vec();
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend((end as u32).to_le_bytes());
    bytes.extend(&target.as_bytes()[..end]);
    let check = CRC.checksum(&bytes);
    bytes.extend(check.to_le_bytes());
    bytes
}

fn decode_header(bytes: &[u8], path: &Path) -> Result<(String, usize), RecordingError> {
    if !bytes.starts_with(MAGIC) {
        let start = &bytes[..bytes.len().min(MAGIC.len())];
        return Err(RecordingError::NotARecording {
            path: path.into(),
            found: String::from_utf8_lossy(start).into_owned(),
        });
    }
    let damaged = |byte| RecordingError::Header {
        path: path.into(),
        byte,
    };
    let found = u32_at(bytes, 8).ok_or_else(|| damaged(8))?;
    if found != VERSION {
        return Err(RecordingError::Version {
            path: path.into(),
            found,
        });
    }
    let length = u32_at(bytes, 12).ok_or_else(|| damaged(12))? as usize;
    if length > NAME_MAX {
        return Err(damaged(12));
    }
    let end = 16 + length;
    let check = u32_at(bytes, end).ok_or_else(|| damaged(end))?;
    if check != CRC.checksum(&bytes[..end]) {
        return Err(damaged(end));
    }
    let target = std::str::from_utf8(&bytes[16..end]).map_err(|_| damaged(16))?;
    Ok((target.into(), end + 4))
}

fn encode_record(into: &mut Vec<u8>, kind: Kind, time: Duration, bytes: &[u8]) {
    let start = into.len();
    into.extend([kind.number(), 0, 0, 0]);
    into.extend((bytes.len() as u32).to_le_bytes());
    into.extend((time.as_nanos() as u64).to_le_bytes());
    into.extend(bytes);
    let check = CRC.checksum(&into[start..]);
    into.extend(check.to_le_bytes());
}

/// The record at the start of `bytes` and its length; `None` when it is torn or damaged.
fn decode_record(bytes: &[u8]) -> Option<(Record, usize)> {
    let kind = Kind::from_number(*bytes.first()?)?;
    let length = u32_at(bytes, 4)? as usize;
    if bytes[1..4] != [0; 3] || length > LENGTH_MAX {
        return None;
    }
    let time = u64::from_le_bytes(bytes.get(8..16)?.try_into().ok()?);
    let end = RECORD_HEADER + length;
    let check = u32_at(bytes, end)?;
    if check != CRC.checksum(&bytes[..end]) {
        return None;
    }
    let record = Record {
        kind,
        time: Duration::from_nanos(time),
        bytes: bytes[RECORD_HEADER..end].to_vec(),
    };
    Some((record, end + 4))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let four = bytes.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes(four.try_into().ok()?))
}

/// Opens links of `inner` and writes down what passes over each, one file a link.
///
/// A file that cannot be written ends the recording with one warning in the log, not the link.
pub struct Recorder<L> {
    inner: L,
    folder: PathBuf,
    limit_bytes: u64,
    opened: AtomicU32,
}

impl<L: Links> Recorder<L> {
    /// A recorder into `folder`, each file at most `limit_bytes` long.
    pub fn new(inner: L, folder: impl Into<PathBuf>, limit_bytes: u64) -> Recorder<L> {
        Recorder {
            inner,
            folder: folder.into(),
            limit_bytes,
            opened: AtomicU32::new(0),
        }
    }

    /// Creates the next file of this target that does not exist yet: `NAME-0.aciesrec`, `NAME-1.aciesrec`, …
    fn create(&self, target: &Target) -> Result<(PathBuf, File), RecordingError> {
        let name: String = target
            .to_string()
            .chars()
            .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
            .collect();
        loop {
            let number = self.opened.fetch_add(1, Ordering::Relaxed);
            let name = name.trim_matches('_');
            let path = self.folder.join(format!("{name}-{number}.aciesrec"));
            match File::create_new(&path) {
                Ok(file) => return Ok((path, file)),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(source) => {
                    return Err(RecordingError::File {
                        path,
                        action: "created",
                        source,
                    });
                }
            }
        }
    }
}

impl<L: Links> Links for Recorder<L> {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        let link = self.inner.open(target)?;
        let (path, mut file) = self.create(target)?;
        let header = encode_header(&target.to_string());
        file.write_all(&header)
            .map_err(|source| RecordingError::File {
                path: path.clone(),
                action: "written",
                source,
            })?;
        Ok(Arc::new(Recorded {
            link,
            opened: Instant::now(),
            writer: Mutex::new(Writer {
                path,
                file: Some(file),
                length: header.len() as u64,
                limit_bytes: self.limit_bytes,
                scratch: Vec::new(),
            }),
        }))
    }
}

/// The file of one link; `file` is `None` after the limit or a failure.
struct Writer {
    path: PathBuf,
    file: Option<File>,
    length: u64,
    limit_bytes: u64,
    scratch: Vec<u8>,
}

impl Writer {
    /// Room that is always kept for the record that says that the limit was reached.
    const LAST: u64 = RECORD_HEADER as u64 + 4;

    fn put(&mut self, kind: Kind, opened: Instant, bytes: &[u8]) {
        // The time is taken under the writer's lock, so that times in the file never decrease.
        let time = opened.elapsed();
        let Some(file) = &mut self.file else { return };
        self.scratch.clear();
        for part in bytes.chunks(LENGTH_MAX) {
            encode_record(&mut self.scratch, kind, time, part);
        }
        if bytes.is_empty() {
            encode_record(&mut self.scratch, kind, time, bytes);
        }
        let full = self.length + self.scratch.len() as u64 + Writer::LAST > self.limit_bytes;
        if full {
            self.scratch.clear();
            encode_record(&mut self.scratch, Kind::Limit, time, &[]);
        }
        self.length += self.scratch.len() as u64;
        match file.write_all(&self.scratch) {
            Ok(()) if !full => {}
            Ok(()) => {
                tracing::warn!(path = %self.path.display(), limit_bytes = self.limit_bytes, "recording reached its limit and ended");
                self.file = None;
            }
            Err(error) => {
                tracing::warn!(path = %self.path.display(), %error, "recording cannot be written and ended");
                self.file = None;
            }
        }
    }
}

struct Recorded {
    link: Arc<dyn Link>,
    opened: Instant,
    writer: Mutex<Writer>,
}

impl Recorded {
    fn put(&self, kind: Kind, bytes: &[u8]) {
        let mut writer = self.writer.lock().unwrap_or_else(PoisonError::into_inner);
        writer.put(kind, self.opened, bytes);
    }
}

impl Link for Recorded {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let answer = self.link.read(buffer, deadline);
        match &answer {
            Ok(0) => {}
            Ok(n) => self.put(Kind::FromDevice, &buffer[..*n]),
            Err(LinkError::Gone) => self.put(Kind::Gone, &[]),
            Err(_) => {}
        }
        answer
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        // Written down before it is sent: the device may answer before this thread goes on.
        self.put(Kind::ToDevice, bytes);
        self.link.write(bytes, deadline)
    }
}
