//! Recordings of what passed over a link: the file's form, its writer and its reader.
//!
//! # The file
//!
//! Numbers are little-endian. The file begins with the eight bytes `ACIESREC`, the format version u32 (1: one link; 2: several), the length
//! u32 of the target's name, that name in UTF-8, and the CRC-32C u32 of all that. Then follow records, each
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 1 | kind: 0 bytes from the device, 1 bytes to the device, 2 the link was gone, 3 the recording reached its size limit; in version 2 also 4 a channel is opened (its name in UTF-8), 5 a note on where the recording comes from (UTF-8), 6 a transfer failed (one byte: 1 stalled, 2 overflow), 7 a USB device's configuration descriptors |
//! | 1 | 1 | channel; 0 in version 1 |
//! | 2 | 2 | 0 |
//! | 4 | 4 | length of the bytes, u32, at most 1 MiB |
//! | 8 | 8 | time, u64, ns since the link was opened, or since a moment that several files share; never decreasing |
//! | 16 | length | the bytes |
//! | 16 + length | 4 | CRC-32C of the record up to here |
//!
//! Each record is one write to the file, so that a program that dies leaves at most one torn record at the end. The reader
//! stops there and says so. A network device with several connections has a channel for each. Of a USB device every endpoint is a channel; a
//! record from it is one transfer, so that short packets stay short; a request on the control endpoint is a record to it, its eight bytes of
//! setup first, and what it brings a record from it. The writer never makes the file longer than its limit; what passed after that is not in it.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::usb::{self, Request, UsbInterface, UsbLink, UsbStream, UsbTarget};
use super::{Link, Links, Target};
use crate::error::LinkError;

const MAGIC: &[u8; 8] = b"ACIESREC";
const VERSION: u32 = 1;
/// Of a file with several channels.
const VERSION_OF_SEVERAL: u32 = 2;
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
    #[error("{}: recording format {found}, this program reads {VERSION} and {VERSION_OF_SEVERAL}; use the program that wrote it", path.display())]
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
    /// A channel is opened; its name.
    Opened,
    /// Where the recording comes from.
    Note,
    /// A USB transfer failed.
    Failed,
    /// The configuration of a USB device, as its descriptors.
    Configuration,
}

impl Kind {
    fn number(self) -> u8 {
        match self {
            Kind::FromDevice => 0,
            Kind::ToDevice => 1,
            Kind::Gone => 2,
            Kind::Limit => 3,
            Kind::Opened => 4,
            Kind::Note => 5,
            Kind::Failed => 6,
            Kind::Configuration => 7,
        }
    }

    fn from_number(number: u8) -> Option<Kind> {
        let all = [
            Kind::FromDevice,
            Kind::ToDevice,
            Kind::Gone,
            Kind::Limit,
            Kind::Opened,
            Kind::Note,
            Kind::Failed,
            Kind::Configuration,
        ];
        all.into_iter().find(|kind| kind.number() == number)
    }
}

/// One record: what passed at once, and when.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    /// Direction, or what happened.
    pub kind: Kind,
    /// Which of the links it passed over, from 0 in the order of their opening.
    pub channel: u8,
    /// Time since the link was opened, or since the moment that [`Recorder::counting_from`] was told.
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
        let several = |record: &Record| record.channel > 0 || record.kind.number() > 3;
        let version = match self.records.iter().any(several) {
            true => VERSION_OF_SEVERAL,
            false => VERSION,
        };
        let mut bytes = encode_header(&self.target, version);
        for record in &self.records {
            let place = (record.kind, record.channel);
            encode_record(&mut bytes, place, record.time, &record.bytes);
        }
        bytes
    }

    /// The note that begins with this word, without it.
    pub fn note(&self, word: &str) -> Option<String> {
        let notes = self.notes();
        let found = notes.iter().find_map(|note| note.strip_prefix(word));
        found.map(|rest| rest.trim_start().to_owned())
    }

    /// Where it comes from, as was written down.
    pub fn notes(&self) -> Vec<String> {
        let notes = self.records.iter().filter(|r| r.kind == Kind::Note);
        notes
            .map(|r| String::from_utf8_lossy(&r.bytes).into_owned())
            .collect()
    }
}

fn encode_header(target: &str, version: u32) -> Vec<u8> {
    let mut end = target.len().min(NAME_MAX);
    while !target.is_char_boundary(end) {
        end -= 1;
    }
    let mut bytes = MAGIC.to_vec();
    bytes.extend(version.to_le_bytes());
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
    if ![VERSION, VERSION_OF_SEVERAL].contains(&found) {
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

fn encode_record(into: &mut Vec<u8>, (kind, channel): (Kind, u8), time: Duration, bytes: &[u8]) {
    let start = into.len();
    into.extend([kind.number(), channel, 0, 0]);
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
    if *bytes.get(2..4)? != [0; 2] || length > LENGTH_MAX {
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
        channel: bytes[1],
        time: Duration::from_nanos(time),
        bytes: bytes[RECORD_HEADER..end].to_vec(),
    };
    Some((record, end + 4))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let four = bytes.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes(four.try_into().ok()?))
}

/// Opens links of `inner` and writes down what passes over them.
///
/// A file that cannot be written ends the recording with one warning in the log, not the link.
pub struct Recorder<L> {
    inner: L,
    folder: PathBuf,
    limit_bytes: u64,
    opened: AtomicU32,
    /// What times are counted from; otherwise from the opening of each file's first link.
    began: Option<Instant>,
    /// The one file of all links, where there is only one.
    whole: Option<Mutex<Whole>>,
}

/// A file of several channels.
struct Whole {
    notes: Vec<String>,
    tape: Option<Arc<Tape>>,
    channels: u8,
}

impl<L> Recorder<L> {
    /// A recorder into `folder`, one file a link, each at most `limit_bytes` long.
    pub fn new(inner: L, folder: impl Into<PathBuf>, limit_bytes: u64) -> Recorder<L> {
        Recorder {
            inner,
            folder: folder.into(),
            limit_bytes,
            opened: AtomicU32::new(0),
            began: None,
            whole: None,
        }
    }

    /// Counts all times from this moment: recorders of several devices that run together then write by one clock.
    pub fn counting_from(self, began: Instant) -> Recorder<L> {
        Recorder {
            began: Some(began),
            ..self
        }
    }

    /// A recorder of one device, with all its links in one file, and where it comes from.
    pub fn of_device(
        inner: L,
        folder: impl Into<PathBuf>,
        limit_bytes: u64,
        notes: Vec<String>,
    ) -> Recorder<L> {
        let whole = Whole {
            notes,
            tape: None,
            channels: 0,
        };
        Recorder {
            whole: Some(Mutex::new(whole)),
            ..Recorder::new(inner, folder, limit_bytes)
        }
    }

    /// Creates the next file of this target that does not exist yet: `NAME-0.aciesrec`, `NAME-1.aciesrec`, …
    fn create(&self, target: &str) -> Result<(PathBuf, File), RecordingError> {
        let name: String = target
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

    fn start(&self, target: &str, version: u32) -> Result<Arc<Tape>, RecordingError> {
        let (path, mut file) = self.create(target)?;
        let header = encode_header(target, version);
        file.write_all(&header)
            .map_err(|source| RecordingError::File {
                path: path.clone(),
                action: "written",
                source,
            })?;
        Ok(Arc::new(Tape {
            opened: self.began.unwrap_or_else(Instant::now),
            writer: Mutex::new(Writer {
                path,
                file: Some(file),
                length: header.len() as u64,
                limit_bytes: self.limit_bytes,
                scratch: Vec::new(),
            }),
        }))
    }

    /// Where the records of a link to `target` go: tape and channel. A link may take several channels, the first of which this is.
    fn channel(&self, target: &str, width: u8) -> Result<(Arc<Tape>, u8), RecordingError> {
        let Some(whole) = &self.whole else {
            return Ok((self.start(target, VERSION)?, 0));
        };
        let mut whole = whole.lock().unwrap_or_else(PoisonError::into_inner);
        let tape = match &whole.tape {
            Some(tape) => Arc::clone(tape),
            None => {
                let tape = self.start(target, VERSION_OF_SEVERAL)?;
                for note in &whole.notes {
                    tape.put(Kind::Note, 0, note.as_bytes());
                }
                whole.tape = Some(Arc::clone(&tape));
                tape
            }
        };
        let channel = whole.channels;
        // 250 openings of one device: those after that share the last channel, and the recording is of no use.
        whole.channels = whole.channels.saturating_add(width);
        tape.put(Kind::Opened, channel, target.as_bytes());
        Ok((tape, channel))
    }
}

impl<L: Links> Links for Recorder<L> {
    fn open(&self, target: &Target) -> Result<Arc<dyn Link>, LinkError> {
        let link = self.inner.open(target)?;
        let (tape, channel) = self.channel(&target.to_string(), 1)?;
        Ok(Arc::new(Recorded {
            link,
            tape,
            channel,
        }))
    }

    fn open_usb(&self, target: &UsbTarget) -> Result<Arc<dyn UsbLink>, LinkError> {
        let link = self.inner.open_usb(target)?;
        if self.whole.is_none() {
            return Err(LinkError::NoUsb {
                reason: "a recording of one link each holds no USB device".into(),
            });
        }
        let endpoints = link.interfaces().iter().flat_map(|i| &i.endpoints);
        let endpoints: Vec<u8> = endpoints.map(|e| e.address).collect();
        let width = u8::try_from(1 + endpoints.len()).unwrap_or(u8::MAX);
        let (tape, channel) = self.channel(&target.to_string(), width)?;
        tape.put(
            Kind::Configuration,
            channel,
            &usb::descriptors(link.interfaces()),
        );
        Ok(Arc::new(RecordedUsb {
            link,
            tape,
            channel,
            endpoints,
        }))
    }
}

/// A file; `file` is `None` after the limit or a failure.
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

    fn put(&mut self, place: (Kind, u8), opened: Instant, bytes: &[u8]) {
        // The time is taken under the writer's lock, so that times in the file never decrease.
        let time = opened.elapsed();
        let Some(file) = &mut self.file else { return };
        self.scratch.clear();
        for part in bytes.chunks(LENGTH_MAX) {
            encode_record(&mut self.scratch, place, time, part);
        }
        if bytes.is_empty() {
            encode_record(&mut self.scratch, place, time, bytes);
        }
        let full = self.length + self.scratch.len() as u64 + Writer::LAST > self.limit_bytes;
        if full {
            self.scratch.clear();
            encode_record(&mut self.scratch, (Kind::Limit, 0), time, &[]);
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

/// A file that several links write to.
struct Tape {
    opened: Instant,
    writer: Mutex<Writer>,
}

impl Tape {
    fn put(&self, kind: Kind, channel: u8, bytes: &[u8]) {
        let mut writer = self.writer.lock().unwrap_or_else(PoisonError::into_inner);
        writer.put((kind, channel), self.opened, bytes);
    }
}

struct Recorded {
    link: Arc<dyn Link>,
    tape: Arc<Tape>,
    channel: u8,
}

impl Link for Recorded {
    fn read(&self, buffer: &mut [u8], deadline: Instant) -> Result<usize, LinkError> {
        let answer = self.link.read(buffer, deadline);
        match &answer {
            Ok(0) => {}
            Ok(n) => self.tape.put(Kind::FromDevice, self.channel, &buffer[..*n]),
            Err(LinkError::Gone) => self.tape.put(Kind::Gone, self.channel, &[]),
            Err(_) => {}
        }
        answer
    }

    fn received(&self) -> Instant {
        self.link.received()
    }

    fn write(&self, bytes: &[u8], deadline: Instant) -> Result<(), LinkError> {
        // Written down before it is sent: the device may answer before this thread goes on.
        self.tape.put(Kind::ToDevice, self.channel, bytes);
        self.link.write(bytes, deadline)
    }
}

/// Its control endpoint is the first channel, the others follow in the order of the descriptors.
struct RecordedUsb {
    link: Arc<dyn UsbLink>,
    tape: Arc<Tape>,
    channel: u8,
    endpoints: Vec<u8>,
}

impl RecordedUsb {
    fn channel_of(&self, endpoint: u8) -> u8 {
        usb::channel_of(&self.endpoints, self.channel, endpoint)
    }

    /// Writes down what a transfer from the device brought.
    fn note(&self, channel: u8, answer: &Result<Option<usize>, LinkError>, buffer: &[u8]) {
        match answer {
            Ok(Some(n)) => self.tape.put(Kind::FromDevice, channel, &buffer[..*n]),
            Ok(None) => {}
            Err(error) => self.note_failure(channel, error),
        }
    }

    fn note_failure(&self, channel: u8, error: &LinkError) {
        match error {
            LinkError::Gone => self.tape.put(Kind::Gone, channel, &[]),
            LinkError::Stalled => self.tape.put(Kind::Failed, channel, &[1]),
            LinkError::Overflow => self.tape.put(Kind::Failed, channel, &[2]),
            _ => {}
        }
    }
}

impl UsbLink for RecordedUsb {
    fn interfaces(&self) -> &[UsbInterface] {
        self.link.interfaces()
    }

    fn claim(&self, interface: u8) -> Result<(), LinkError> {
        self.link.claim(interface)
    }

    fn control_in(
        &self,
        request: Request,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let setup = request.setup(buffer.len());
        self.tape.put(Kind::ToDevice, self.channel, &setup);
        let answer = self.link.control_in(request, buffer, deadline);
        self.note(self.channel, &answer, buffer);
        answer
    }

    fn control_out(
        &self,
        request: Request,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let mut setup = request.setup(bytes.len()).to_vec();
        setup.extend(bytes);
        self.tape.put(Kind::ToDevice, self.channel, &setup);
        let answer = self.link.control_out(request, bytes, deadline);
        if let Err(error) = &answer {
            self.note_failure(self.channel, error);
        }
        answer
    }

    fn read(
        &self,
        endpoint: u8,
        buffer: &mut [u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let answer = self.link.read(endpoint, buffer, deadline);
        self.note(self.channel_of(endpoint), &answer, buffer);
        answer
    }

    fn received(&self, endpoint: u8) -> Instant {
        self.link.received(endpoint)
    }

    fn write(
        &self,
        endpoint: u8,
        bytes: &[u8],
        deadline: Instant,
    ) -> Result<Option<usize>, LinkError> {
        let channel = self.channel_of(endpoint);
        self.tape.put(Kind::ToDevice, channel, bytes);
        let answer = self.link.write(endpoint, bytes, deadline);
        if let Err(error) = &answer {
            self.note_failure(channel, error);
        }
        answer
    }

    fn stream(
        &self,
        endpoint: u8,
        transfers: usize,
        bytes: usize,
    ) -> Result<Box<dyn UsbStream + '_>, LinkError> {
        Ok(Box::new(RecordedStream {
            stream: self.link.stream(endpoint, transfers, bytes)?,
            usb: self,
            channel: self.channel_of(endpoint),
        }))
    }

    fn clear_halt(&self, endpoint: u8) -> Result<(), LinkError> {
        self.link.clear_halt(endpoint)
    }
}

struct RecordedStream<'a> {
    stream: Box<dyn UsbStream + 'a>,
    usb: &'a RecordedUsb,
    channel: u8,
}

impl UsbStream for RecordedStream<'_> {
    fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>, LinkError> {
        let answer = self.stream.next(deadline);
        match &answer {
            Ok(Some(bytes)) => self.usb.tape.put(Kind::FromDevice, self.channel, bytes),
            Ok(None) => {}
            Err(error) => self.usb.note_failure(self.channel, error),
        }
        answer
    }

    fn received(&self) -> Instant {
        self.stream.received()
    }
}
