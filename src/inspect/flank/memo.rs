//! Fits of windows, kept while their points stay the same: an edge is measured again and again while the scan grows.

use std::any::Any;
use std::collections::HashMap;

use foldhash::fast::FixedState;

use crate::inspect::measuring::OTHER;

use super::{FlankGap, FlankPoints, FlankSettings, Range, WindowFit, Windows, fit_window};

/// What makes a fit another one, beside its points: station, inner and outer end of the range, and the choice of points.
type Key = (usize, u64, u64, u64);

/// The fits of the same number of unknowns, each with the number of points its window held.
type Fits<const P: usize> = HashMap<Key, (usize, Result<WindowFit<P>, FlankGap>), FixedState>;

/// The fits of one flank. Points only ever join a window, so that a window of as many points holds the same ones.
#[derive(Default)]
pub struct Memo {
    three: Fits<3>,
    four: Fits<4>,
    five: Fits<5>,
    six: Fits<6>,
    seven: Fits<7>,
    choice: u64,
}

fn is_of(key: &Key, choice: u64) -> bool {
    key.3 == choice || key.3 & OTHER == 0
}

impl Memo {
    /// From here on points are chosen otherwise: fits of another choice are not used, and dropped but for those of the named choices.
    pub(in crate::inspect) fn choose(&mut self, choice: u64) {
        self.choice = choice;
        if choice & OTHER != 0 {
            self.three.retain(|key, _| is_of(key, choice));
            self.four.retain(|key, _| is_of(key, choice));
            self.five.retain(|key, _| is_of(key, choice));
            self.six.retain(|key, _| is_of(key, choice));
            self.seven.retain(|key, _| is_of(key, choice));
        }
    }

    /// As [`fit_window`], of the window of station `k`.
    pub(super) fn fit<const P: usize>(
        &mut self,
        points: &FlankPoints,
        (windows, k): (&Windows, usize),
        range: &Range,
        settings: &FlankSettings,
    ) -> Result<WindowFit<P>, FlankGap> {
        let from = k as f64 * windows.step_mm;
        let count = points.window(from, from + windows.step_mm).len();
        // What is refused at once is not worth keeping: there may be a hundred thousand empty windows.
        if count < settings.min_points {
            return fit_window(points, range, settings);
        }
        let (cut, reach) = (range.cut_mm.to_bits(), range.reach_mm.to_bits());
        let key = (k, cut, reach, self.choice);
        let Some(fits) = self.fits::<P>() else {
            return fit_window(points, range, settings);
        };
        if let Some((known, fit)) = fits.get(&key)
            && *known == count
        {
            return fit.clone();
        }
        let fit = fit_window(points, range, settings);
        fits.insert(key, (count, fit.clone()));
        fit
    }

    fn fits<const P: usize>(&mut self) -> Option<&mut Fits<P>> {
        let fits: &mut dyn Any = match P {
            3 => &mut self.three,
            4 => &mut self.four,
            5 => &mut self.five,
            6 => &mut self.six,
            _ => &mut self.seven,
        };
        fits.downcast_mut()
    }
}
