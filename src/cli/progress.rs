//! Progress on standard error, for anything longer than a second.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::cell::Step;

/// How long a command works before it says so.
const QUIET: Duration = Duration::from_secs(1);

/// A line that tells what a job of a cell is doing. Silent where standard error is no terminal.
pub(super) struct CellProgress {
    bar: ProgressBar,
    began: Instant,
}

impl CellProgress {
    /// Begins, hidden at first.
    pub fn new() -> Self {
        let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::hidden());
        let style = ProgressStyle::with_template("{bar:30} {percent:>3} %  {msg}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        Self {
            bar,
            began: Instant::now(),
        }
    }

    /// Shows `step`.
    pub fn tell(&mut self, step: &Step) {
        if self.bar.is_hidden() && self.began.elapsed() > QUIET {
            self.bar.set_draw_target(ProgressDrawTarget::stderr());
        }
        let message = match step {
            Step::Opening { device } => format!("opening {device}"),
            Step::Touching { done, of } => {
                self.bar.set_position((1000 * done / of.max(&1)) as u64);
                format!("touch {} of {of}", done + 1)
            }
            Step::Scanning { profiles, share } => {
                self.bar.set_position((1000.0 * share) as u64);
                format!("scanning, {profiles} profiles")
            }
            Step::Lost { device, error } => {
                tracing::error!(device, error, "lost during the scan");
                return;
            }
            Step::Inspecting => "finding the pose and measuring the edges".to_owned(),
        };
        self.bar.set_message(message);
    }

    /// Takes the line away.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}
