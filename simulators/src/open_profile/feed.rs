//! Profiles computed ahead of the wire, in blocks on all cores, at most a few blocks at a time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread::JoinHandle;

use rayon::prelude::*;

use crate::sensor::{Line, View};
use crate::wire::Waker;

/// Profiles in a block.
const BLOCK: u32 = 16;
/// Finished blocks that may wait.
const AHEAD: usize = 2;

/// The lines of one run, in order.
#[derive(Debug)]
pub(super) struct Feed {
    blocks: Option<Receiver<Vec<Line>>>,
    current: std::vec::IntoIter<Line>,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// What the feed has.
pub(super) enum Fed {
    Line(Box<Line>),
    /// Still computing; the waker says when.
    NotYet,
    /// The stage stands still.
    Over,
}

impl Feed {
    /// Starts to compute. Without a thread of its own it computes nothing, and the run is over at once.
    pub fn start(view: Arc<View>, waker: Waker) -> Feed {
        let (sender, blocks) = sync_channel(AHEAD);
        let end = Arc::new(AtomicBool::new(false));
        let ended = end.clone();
        let compute = move || {
            let n = view.traverse.profiles;
            for first in (0..n).step_by(BLOCK as usize) {
                let last = n.min(first.saturating_add(BLOCK));
                let block: Vec<Line> = (first..last)
                    .into_par_iter()
                    .map(|index| view.line(index))
                    .collect();
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
                return Fed::Line(Box::new(line));
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
