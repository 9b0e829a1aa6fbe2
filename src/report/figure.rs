//! A value and its expanded uncertainty as people read them: µm or degrees, two significant digits of U.

use super::wire::Quantity;
use crate::inspect::quantity::Unit;
use crate::words::Language;

/// Coverage factor of the uncertainties shown to people: about 95 % of a normal distribution.
pub const COVERAGE_FACTOR: f64 = 2.0;

/// A value with its expanded uncertainty, rounded for reading.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Figure {
    /// Signed value.
    pub value: String,
    /// U = 2 u to two significant digits; `None` where unknown.
    pub expanded: Option<String>,
    /// `µm` or `°`.
    pub unit: &'static str,
}

impl Figure {
    /// `value` and `u` in the unit of the wire (mm or degrees) as a figure in µm or degrees.
    pub fn of(quantity: Quantity, value: f64, u: Option<f64>) -> Self {
        let (scale, unit, decimals_without_u) = match quantity.unit() {
            Unit::Length => (1e3, "µm", 0),
            Unit::Angle => (1.0, "°", 2),
        };
        let expanded = u
            .map(|u| COVERAGE_FACTOR * u * scale)
            .filter(|u| u.is_finite());
        let decimals = expanded.map_or(decimals_without_u, decimals_for_two_digits);
        Figure {
            value: signed(value * scale, decimals),
            expanded: expanded.map(|expanded| unsigned(expanded, decimals)),
            unit,
        }
    }

    /// The same with the decimal sign of a language.
    pub fn told(self, words: Language) -> Self {
        Figure {
            value: words.number(&self.value),
            expanded: self.expanded.map(|expanded| words.number(&expanded)),
            unit: self.unit,
        }
    }

    /// `+152 µm`.
    pub fn with_unit(&self) -> String {
        match self.unit {
            "°" => format!("{}°", self.value),
            unit => format!("{} {unit}", self.value),
        }
    }

    /// `+152 ± 12`, or the value alone where U is unknown.
    pub fn plus_minus(&self) -> String {
        match &self.expanded {
            Some(expanded) => format!("{} ± {expanded}", self.value),
            None => self.value.clone(),
        }
    }

    /// `+152 µm (U 12 µm)`.
    pub fn with_uncertainty(&self, words: Language) -> String {
        let space = if self.unit == "°" { "" } else { " " };
        let value = self.with_unit();
        match &self.expanded {
            Some(expanded) => {
                let u = format!("{expanded}{space}{}", self.unit);
                words.fill("because.with_u", &[("value", &value), ("u", &u)])
            }
            None => words.fill("because.without_u", &[("value", &value)]),
        }
    }
}

/// Decimals (negative: zeros before the point) that leave two significant digits of `value`.
fn decimals_for_two_digits(value: f64) -> i32 {
    if value <= 0.0 {
        return 1;
    }
    let decimals = 1 - value.log10().floor() as i32;
    // 9.96 rounds to 10.0 at two digits: one decimal less.
    let rounded = round_to(value, decimals);
    (1 - rounded.log10().floor() as i32).clamp(-9, 6)
}

fn round_to(value: f64, decimals: i32) -> f64 {
    let unit = 10f64.powi(decimals);
    (value * unit).round() / unit
}

fn unsigned(value: f64, decimals: i32) -> String {
    format!("{:.*}", decimals.max(0) as usize, round_to(value, decimals))
}

/// With a sign, save for what rounds to zero.
fn signed(value: f64, decimals: i32) -> String {
    let text = unsigned(value.abs(), decimals);
    if text.chars().all(|c| matches!(c, '0' | '.')) {
        text
    } else if value < 0.0 {
        format!("−{text}")
    } else {
        format!("+{text}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(value_mm: f64, u_mm: Option<f64>, expect: &str) {
        assert_eq!(
            Figure::of(Quantity::D1, value_mm, u_mm).plus_minus(),
            expect
        );
    }

    #[test]
    fn two_digits_of_u_decide_the_digits_of_the_value() {
        check(0.152_34, Some(0.006_1), "+152 ± 12");
        check(0.152_34, Some(0.000_61), "+152.3 ± 1.2");
        check(-0.001_23, Some(0.000_061), "−1.23 ± 0.12");
        check(1.523_4, Some(0.061), "+1520 ± 120");
        check(0.000_000_1, Some(0.004_98), "0 ± 10");
        check(0.000_4, Some(0.000_498), "+0.4 ± 1.0");
        check(0.0, Some(0.0), "0.0 ± 0.0");
        check(0.152_6, None, "+153");
    }

    #[test]
    fn angles_are_in_degrees() {
        let figure = Figure::of(Quantity::AngleDeviation, -0.204, Some(0.021));
        assert_eq!(figure.plus_minus(), "−0.204 ± 0.042");
        assert_eq!(figure.with_uncertainty(Language::En), "−0.204° (U 0.042°)");
    }
}
