//! What the cell told last, in order: who was away for a moment gets what they missed.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::status::Snapshot;

/// Snapshots that are kept: a minute of a scan, which tells ten a second, and days of a quiet cell. Some kilobytes each.
const KEPT: usize = 512;

/// The writing end.
pub(super) struct Publisher {
    newest: watch::Sender<Arc<Snapshot>>,
    kept: Arc<Mutex<VecDeque<Arc<Snapshot>>>>,
}

/// The reading end; a clone is the same.
#[derive(Clone)]
pub(super) struct Feed {
    newest: watch::Receiver<Arc<Snapshot>>,
    kept: Arc<Mutex<VecDeque<Arc<Snapshot>>>>,
}

/// Both ends, with `first` told already.
pub(super) fn feed(first: Snapshot) -> (Publisher, Feed) {
    let first = Arc::new(first);
    let kept = Arc::new(Mutex::new(VecDeque::from([first.clone()])));
    let (sender, newest) = watch::channel(first);
    let publisher = Publisher {
        newest: sender,
        kept: kept.clone(),
    };
    (publisher, Feed { newest, kept })
}

impl Publisher {
    /// What was told last.
    pub fn last(&self) -> Arc<Snapshot> {
        self.newest.borrow().clone()
    }

    /// Tells `snapshot`, whose sequence is one more than that of the last one.
    pub fn tell(&self, snapshot: Snapshot) {
        let snapshot = Arc::new(snapshot);
        {
            let mut kept = lock(&self.kept);
            if kept.len() == KEPT {
                kept.pop_front();
            }
            kept.push_back(snapshot.clone());
        }
        // Kept before it is told: who hears of it finds it.
        self.newest.send_replace(snapshot);
    }
}

impl Feed {
    /// The newest, and word of the next ones.
    pub fn newest(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.newest.clone()
    }

    /// Everything told after `sequence`, oldest first; `None` where the first of it is no longer kept, or where `sequence` was
    /// never told.
    pub fn since(&self, sequence: u64) -> Option<Vec<Arc<Snapshot>>> {
        let kept = lock(&self.kept);
        let (first, last) = (kept.front()?.sequence, kept.back()?.sequence);
        // The one after it is the first that is owed.
        if sequence > last || sequence.saturating_add(1) < first {
            return None;
        }
        let missed = kept.iter().filter(|told| told.sequence > sequence);
        Some(missed.cloned().collect())
    }
}

fn lock(kept: &Mutex<VecDeque<Arc<Snapshot>>>) -> MutexGuard<'_, VecDeque<Arc<Snapshot>>> {
    kept.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_missed_is_owed_as_long_as_it_is_kept() {
        let (publisher, feed) = feed(Snapshot::default());
        let tell = |count: u64| {
            for _ in 0..count {
                let mut next = Snapshot::clone(&publisher.last());
                next.sequence += 1;
                publisher.tell(next);
            }
        };
        let numbers = |sequence| {
            let missed = feed.since(sequence)?;
            Some(missed.iter().map(|told| told.sequence).collect::<Vec<_>>())
        };
        tell(3);
        assert_eq!(numbers(0), Some(vec![1, 2, 3]));
        assert_eq!(numbers(3), Some(vec![]));
        assert_eq!(numbers(4), None, "never told");
        tell(KEPT as u64);
        assert_eq!(numbers(2), None, "too long ago");
        let all = numbers(3).expect("as many as are kept");
        assert_eq!((all.len(), all[0]), (KEPT, 4));
        assert_eq!(numbers(u64::MAX), None);
    }
}
