//! Pseudo-terminals that look like serial ports which can be plugged and pulled out.

use std::fs;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

/// A line on which nothing arrives for so long is taken to be empty.
const QUIET: Duration = Duration::from_millis(20);

/// The device's end of a serial port that appears under a path of one's choice.
///
/// The slave stays open here as well: the line is raw before anyone opens it, and the master sees no hang-up while the port is
/// closed on the other side.
#[derive(Debug)]
pub struct PtyDevice {
    link: PathBuf,
    ends: Option<Ends>,
}

#[derive(Debug)]
struct Ends {
    master: OwnedFd,
    slave: OwnedFd,
}

impl PtyDevice {
    /// Plugs a new device in under `link`.
    ///
    /// # Errors
    /// When the system has no pseudo-terminal left or the link cannot be made.
    pub fn plug(link: &Path) -> io::Result<PtyDevice> {
        let mut device = PtyDevice {
            link: link.to_owned(),
            ends: None,
        };
        device.replug()?;
        Ok(device)
    }

    /// Where the port appears.
    pub fn link(&self) -> &Path {
        &self.link
    }

    /// Whether it is plugged in.
    pub fn is_plugged(&self) -> bool {
        self.ends.is_some()
    }

    /// Plugs it in again, as a new port under the same link; nothing when it is in.
    ///
    /// # Errors
    /// As for [`PtyDevice::plug`].
    pub fn replug(&mut self) -> io::Result<()> {
        if self.ends.is_some() {
            return Ok(());
        }
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        let name = ptsname(&master, Vec::new())?;
        let path = PathBuf::from(std::ffi::OsString::from_vec(name.into_bytes()));
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
        let slave = rustix::fs::open(&path, flags, Mode::empty())?;
        let mut termios = tcgetattr(&slave)?;
        termios.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &termios)?;
        rustix::io::ioctl_fionbio(&master, true)?;
        // rename is atomic: who opens the link gets the old port or the new one, never none
        let mut staged = self.link.clone().into_os_string();
        staged.push(format!(".{}", std::process::id()));
        let staged = PathBuf::from(staged);
        let _ = fs::remove_file(&staged);
        symlink(&path, &staged)?;
        fs::rename(&staged, &self.link)?;
        self.ends = Some(Ends { master, slave });
        Ok(())
    }

    /// Pulls it out: first the link goes (the number of the port is given to the next one at once), then, when what was sent has
    /// been read or `patience` is over, the line hangs up. True when all was read.
    pub fn unplug(&mut self, patience: Duration) -> bool {
        if self.ends.is_none() {
            return true;
        }
        // a link that someone else replaced is not ours to remove, but nobody else uses this one
        let _ = fs::remove_file(&self.link);
        let read = self.drained(patience);
        self.ends = None;
        read
    }

    /// Waits until everything sent was read. Only what the kernel has moved on to the other end is visible, so it must stay at
    /// nothing for longer than a busy kernel takes to move more.
    fn drained(&self, patience: Duration) -> bool {
        let Some(ends) = &self.ends else { return true };
        let until = Instant::now() + patience;
        let mut empty_since: Option<Instant> = None;
        loop {
            let now = Instant::now();
            match rustix::io::ioctl_fionread(&ends.slave) {
                Ok(0) if empty_since.is_some_and(|since| now - since > QUIET) => return true,
                Ok(0) => {
                    empty_since.get_or_insert(now);
                }
                _ => empty_since = None,
            }
            if now > until {
                return false;
            }
            std::thread::sleep(Duration::from_micros(500));
        }
    }

    /// Lets the port be opened again after a holder died without closing it: the kernel keeps the exclusive mark of a
    /// pseudo-terminal as long as the device's own end is open.
    pub fn release_exclusive(&self) {
        if let Some(ends) = &self.ends {
            let _ = rustix::termios::ioctl_tiocnxcl(&ends.slave);
        }
    }

    /// Speed the host has set, in Bd; nothing when unplugged. A pseudo-terminal keeps it and does not heed it.
    pub fn baud(&self) -> Option<u32> {
        let ends = self.ends.as_ref()?;
        Some(tcgetattr(&ends.master).ok()?.output_speed())
    }

    /// What is there, without waiting; 0 when nothing is.
    ///
    /// # Errors
    /// Those of the system; `NotConnected` when unplugged.
    pub fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        let ends = self.ends.as_ref().ok_or(io::ErrorKind::NotConnected)?;
        none_is_zero(rustix::io::read(&ends.master, buffer))
    }

    /// As much as goes in, without waiting.
    ///
    /// # Errors
    /// Those of the system; `NotConnected` when unplugged.
    pub fn write(&self, bytes: &[u8]) -> io::Result<usize> {
        let ends = self.ends.as_ref().ok_or(io::ErrorKind::NotConnected)?;
        none_is_zero(rustix::io::write(&ends.master, bytes))
    }

    pub(crate) fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.ends.as_ref().map(|ends| ends.master.as_fd())
    }
}

impl Drop for PtyDevice {
    fn drop(&mut self) {
        self.unplug(Duration::ZERO);
    }
}

fn none_is_zero(result: rustix::io::Result<usize>) -> io::Result<usize> {
    match result {
        Ok(n) => Ok(n),
        Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(0),
        Err(error) => Err(error.into()),
    }
}

/// Waits until one of these can be read (or the first written, when asked), or time is over.
pub(crate) fn wait(line: Option<BorrowedFd<'_>>, write: bool, waker: &OwnedFd, timeout: Duration) {
    let flags = if write {
        PollFlags::IN | PollFlags::OUT
    } else {
        PollFlags::IN
    };
    let mut fds = smallvec::SmallVec::<[PollFd<'_>; 2]>::new();
    fds.push(PollFd::new(waker, PollFlags::IN));
    if let Some(line) = &line {
        fds.push(PollFd::new(line, flags));
    }
    let timeout = Timespec {
        tv_sec: timeout.as_secs() as i64,
        tv_nsec: timeout.subsec_nanos().into(),
    };
    // a signal or an error only wakes us early
    let _ = poll(&mut fds, Some(&timeout));
}

#[cfg(test)]
mod tests;
