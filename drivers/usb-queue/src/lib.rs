//! Bulk reads of one USB endpoint, several of them in flight, in order.
//!
//! `rusb` has safe calls for one transfer at a time: between two of them nothing is queued, and a device with a small memory loses
//! what it measures. Several threads that read at once would keep transfers queued, but which of them was queued first is not to be
//! learned, and what they read could not be put in order. libusb's own queue is the way; it has no safe face in `rusb`, and this is one.
//!
//! # Why it is sound
//!
//! libusb and the kernel write into a transfer and its buffer from the moment it is submitted until its callback has run, on whichever
//! thread handles events. So, for every transfer in flight:
//!
//! 1. itself, its buffer and its flag are allocations of their own, which a [`Slot`] owns, so that the slot may be moved; none of them
//!    is read or freed, but for the flag, which is shared and atomic;
//! 2. the callback sets the flag (release) as the last thing that libusb's side does with the transfer; whoever saw it set (acquire)
//!    owns transfer and buffer again;
//! 3. a slot whose flag is not set is never dropped: [`Queue`] waits for all of them in its `Drop`, and leaks the slots of a system
//!    that does not give them back;
//! 4. the device's handle outlives the queue, which borrows it. A queue that is forgotten leaks its slots, which harms nothing: closing
//!    a handle takes its transfers out of libusb and ends them in the kernel.

#![expect(
    unsafe_code,
    reason = "libusb's queue of transfers has no safe face in rusb; the proof is above"
)]

use std::collections::VecDeque;
use std::ffi::c_int;
use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};
use std::time::{Duration, Instant};

use rusb::ffi::{self, constants};
use rusb::{Context, DeviceHandle, Error, Result, UsbContext};

/// How long the transfers of a queue that ends may take to come back.
const RETURN: Duration = Duration::from_secs(5);

/// A transfer with its buffer and its flag.
struct Slot {
    transfer: NonNull<ffi::libusb_transfer>,
    buffer: Vec<u8>,
    /// 1 where the transfer is not in flight.
    done: Arc<AtomicI32>,
}

impl Drop for Slot {
    fn drop(&mut self) {
        // SAFETY: by (3) it is not in flight, and nobody else frees it.
        unsafe { ffi::libusb_free_transfer(self.transfer.as_ptr()) }
    }
}

extern "system" fn completed(transfer: *mut ffi::libusb_transfer) {
    // SAFETY: libusb calls this once for a submitted transfer, which lives by (1), as does the flag that `user_data` points to. The
    // store is the last use of either on this side.
    unsafe {
        let flag: *const AtomicI32 = (*transfer).user_data.cast();
        (*flag).store(1, Ordering::Release);
    }
}

/// Reads of one endpoint of an open device.
pub struct Queue<'a> {
    handle: &'a DeviceHandle<Context>,
    endpoint: u8,
    /// Submitted, the oldest first.
    flying: VecDeque<Slot>,
    idle: Vec<Slot>,
}

impl<'a> Queue<'a> {
    /// With so many buffers of so many bytes each; nothing is asked for yet.
    ///
    /// # Errors
    /// [`Error::InvalidParam`] for no buffers or none of a size that libusb takes, [`Error::NoMem`].
    pub fn new(
        handle: &'a DeviceHandle<Context>,
        endpoint: u8,
        buffers: usize,
        bytes: usize,
    ) -> Result<Queue<'a>> {
        if buffers == 0 || bytes == 0 || c_int::try_from(bytes).is_err() {
            return Err(Error::InvalidParam);
        }
        let slot = || {
            // SAFETY: a plain allocation; the answer is checked.
            let transfer = NonNull::new(unsafe { ffi::libusb_alloc_transfer(0) });
            Ok(Slot {
                transfer: transfer.ok_or(Error::NoMem)?,
                buffer: vec![0; bytes],
                done: Arc::new(AtomicI32::new(1)),
            })
        };
        Ok(Queue {
            handle,
            endpoint,
            flying: VecDeque::with_capacity(buffers),
            idle: (0..buffers).map(|_| slot()).collect::<Result<_>>()?,
        })
    }

    /// Transfers in flight.
    pub fn in_flight(&self) -> usize {
        self.flying.len()
    }

    /// The bytes of the next transfer, in the order of the device, waiting for it until `deadline`; `None` when it passed. All other
    /// buffers are in flight meanwhile, and stay so when this returns.
    ///
    /// A system that refuses memory for some of the buffers gets fewer.
    ///
    /// # Errors
    /// What became of the transfer. Then nothing is in flight any more, so that a stall can be cleared; the next call begins again.
    pub fn next(&mut self, deadline: Instant) -> Result<Option<&[u8]>> {
        if let Err(error) = self.submit_all() {
            self.recall();
            return Err(error);
        }
        let Some(oldest) = self.flying.front() else {
            return Ok(None);
        };
        match self.wait(oldest, deadline) {
            Ok(true) => {}
            Ok(false) => return Ok(None),
            Err(error) => {
                self.recall();
                return Err(error);
            }
        }
        let Some(slot) = self.flying.pop_front() else {
            return Ok(None);
        };
        // SAFETY: its flag is set, so that it is ours by (2).
        let (status, n) = unsafe {
            let transfer = slot.transfer.as_ref();
            (transfer.status, transfer.actual_length)
        };
        self.idle.push(slot);
        let error = match status {
            constants::LIBUSB_TRANSFER_COMPLETED => {
                let n = usize::try_from(n).unwrap_or(0);
                return Ok(self.idle.last().and_then(|slot| slot.buffer.get(..n)));
            }
            constants::LIBUSB_TRANSFER_STALL => Error::Pipe,
            constants::LIBUSB_TRANSFER_NO_DEVICE => Error::NoDevice,
            constants::LIBUSB_TRANSFER_OVERFLOW => Error::Overflow,
            constants::LIBUSB_TRANSFER_CANCELLED => Error::Interrupted,
            constants::LIBUSB_TRANSFER_TIMED_OUT => Error::Timeout,
            _ => Error::Io,
        };
        self.recall();
        Err(error)
    }

    fn submit_all(&mut self) -> Result<()> {
        while let Some(mut slot) = self.idle.pop() {
            match self.submit(&mut slot) {
                Ok(()) => self.flying.push_back(slot),
                // The kernel bounds the memory of all transfers: fewer in flight is slower, and no failure. The buffer is given up.
                Err(Error::NoMem) if !self.flying.is_empty() => drop(slot),
                Err(error) => {
                    self.idle.push(slot);
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    fn submit(&self, slot: &mut Slot) -> Result<()> {
        slot.done.store(0, Ordering::Relaxed);
        // SAFETY: the transfer is not in flight, and is ours by (2). Buffer and flag stay where they are until it comes back by (1) and
        // (3); the handle is open by (4). `new` has seen that the length fits. Without a time limit: `recall` ends it.
        let code = unsafe {
            ffi::libusb_fill_bulk_transfer(
                slot.transfer.as_ptr(),
                self.handle.as_raw(),
                self.endpoint,
                slot.buffer.as_mut_ptr(),
                slot.buffer.len() as c_int,
                completed,
                Arc::as_ptr(&slot.done).cast_mut().cast(),
                0,
            );
            ffi::libusb_submit_transfer(slot.transfer.as_ptr())
        };
        if code != 0 {
            slot.done.store(1, Ordering::Relaxed);
        }
        result(code)
    }

    /// Handles events until a slot's transfer is over; false when the deadline passed before.
    fn wait(&self, slot: &Slot, deadline: Instant) -> Result<bool> {
        loop {
            if slot.done.load(Ordering::Acquire) != 0 {
                return Ok(true);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(false);
            }
            let time = libc::timeval {
                tv_sec: left.as_secs().try_into().unwrap_or(1),
                tv_usec: left.subsec_micros().max(1).into(),
            };
            // SAFETY: the context is that of an open handle. libusb reads the flag under its own lock, to see whether somebody else has
            // handled the event that is waited for; it does not write it.
            let code = unsafe {
                ffi::libusb_handle_events_timeout_completed(
                    self.handle.context().as_raw(),
                    &raw const time,
                    slot.done.as_ptr(),
                )
            };
            match result(code) {
                Ok(()) | Err(Error::Interrupted | Error::Timeout) => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Ends all transfers in flight and waits until they are back. What they had read is thrown away.
    pub fn recall(&mut self) {
        // The newest first: none of them takes what an older one would have.
        for slot in self.flying.iter().rev() {
            // SAFETY: the transfer is alive; one that is over is "not found", which says what we want.
            unsafe {
                ffi::libusb_cancel_transfer(slot.transfer.as_ptr());
            }
        }
        let deadline = Instant::now() + RETURN;
        while let Some(slot) = self.flying.pop_front() {
            match self.wait(&slot, deadline) {
                Ok(true) => self.idle.push(slot),
                // libusb or the kernel may still write to it.
                _ => std::mem::forget(slot),
            }
        }
    }
}

impl Drop for Queue<'_> {
    fn drop(&mut self) {
        self.recall();
    }
}

fn result(code: c_int) -> Result<()> {
    Err(match code {
        0.. => return Ok(()),
        constants::LIBUSB_ERROR_IO => Error::Io,
        constants::LIBUSB_ERROR_INVALID_PARAM => Error::InvalidParam,
        constants::LIBUSB_ERROR_ACCESS => Error::Access,
        constants::LIBUSB_ERROR_NO_DEVICE => Error::NoDevice,
        constants::LIBUSB_ERROR_NOT_FOUND => Error::NotFound,
        constants::LIBUSB_ERROR_BUSY => Error::Busy,
        constants::LIBUSB_ERROR_TIMEOUT => Error::Timeout,
        constants::LIBUSB_ERROR_OVERFLOW => Error::Overflow,
        constants::LIBUSB_ERROR_PIPE => Error::Pipe,
        constants::LIBUSB_ERROR_INTERRUPTED => Error::Interrupted,
        constants::LIBUSB_ERROR_NO_MEM => Error::NoMem,
        constants::LIBUSB_ERROR_NOT_SUPPORTED => Error::NotSupported,
        _ => Error::Other,
    })
}
