//! Profiles computed ahead of the wire, in blocks on all cores, at most a few blocks at a time, and kept for the next run.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;

use rayon::prelude::*;

use crate::sensor::{Line, View};
use crate::wire::Waker;

/// Profiles in a block.
const BLOCK: u32 = 16;
/// Finished blocks that may wait.
const AHEAD: usize = 2;
/// Points that are kept, of 18 bytes each: a traverse of more is computed anew in every run.
const KEPT: u64 = 4_000_000;

type Block = Vec<Arc<Line>>;

/// A traverse and what was computed of it. Every run over it gives the same lines, and following rays is most of a device's work.
#[derive(Debug)]
pub(super) struct Traversed {
    view: View,
    kept: Vec<OnceLock<Block>>,
}

impl Traversed {
    pub fn new(view: View) -> Traversed {
        let points = u64::from(view.traverse.profiles) * u64::from(view.columns);
        let blocks = match points {
            0..=KEPT => view.traverse.profiles.div_ceil(BLOCK),
            _ => 0,
        };
        let kept = (0..blocks).map(|_| OnceLock::new()).collect();
        Traversed { view, kept }
    }

    pub fn is_of(&self, view: &View) -> bool {
        self.view.traverse == view.traverse && self.view.columns == view.columns
    }

    /// Lines from `number` times 16 on.
    pub fn block(&self, number: u32) -> Block {
        let compute = || {
            let first = number * BLOCK;
            let last = first.saturating_add(BLOCK).min(self.view.traverse.profiles);
            let lines = (first..last).into_par_iter();
            lines.map(|index| Arc::new(self.view.line(index))).collect()
        };
        match self.kept.get(number as usize) {
            Some(kept) => kept.get_or_init(compute).clone(),
            None => compute(),
        }
    }
}

/// The lines of one run, in order.
#[derive(Debug)]
pub(super) struct Feed {
    blocks: Option<Receiver<Block>>,
    current: std::vec::IntoIter<Arc<Line>>,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// What the feed has.
pub(super) enum Fed {
    Line(Arc<Line>),
    /// Still computing; the waker says when.
    NotYet,
    /// The stage stands still.
    Over,
}

impl Feed {
    /// Starts to compute. Without a thread of its own it computes nothing, and the run is over at once.
    pub fn start(traversed: Arc<Traversed>, waker: Waker) -> Feed {
        let (sender, blocks) = sync_channel(AHEAD);
        let end = Arc::new(AtomicBool::new(false));
        let ended = end.clone();
        let compute = move || {
            for number in 0..traversed.view.traverse.profiles.div_ceil(BLOCK) {
                let block = traversed.block(number);
                if ended.load(Ordering::Acquire) || sender.send(block).is_err() {
                    break;
                }
                waker.wake();
            }
            drop(sender);
            waker.wake();
        };
        let thread = std::thread::Builder::new()
            .name("simulator profiles".to_owned())
            .spawn(compute);
        if let Err(error) = &thread {
            tracing::error!(%error, "no thread to compute profiles");
        }
        Feed {
            blocks: Some(blocks),
            current: Vec::new().into_iter(),
            end,
            thread: thread.ok(),
        }
    }

    pub fn next(&mut self) -> Fed {
        loop {
            if let Some(line) = self.current.next() {
                return Fed::Line(line);
            }
            let Some(blocks) = &self.blocks else {
                return Fed::Over;
            };
            match blocks.try_recv() {
                Ok(block) => self.current = block.into_iter(),
                Err(TryRecvError::Empty) => return Fed::NotYet,
                Err(TryRecvError::Disconnected) => return Fed::Over,
            }
        }
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Release);
        // a sender that waits for room must see that nobody takes any more
        self.blocks = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
