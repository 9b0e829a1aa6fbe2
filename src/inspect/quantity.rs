//! What can be measured at an edge and given limits: one table of names, units and the keys of a recipe.
//!
//! Source: features-and-standards, section 5; the number of the definition stands beside each.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One thing that is measured at an edge.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Deviation along n1 (3).
    D1,
    /// Deviation along n2 (3).
    D2,
    /// Distance of the measured edge from the nominal one across the tangent (4).
    Total,
    /// Included angle minus the nominal one (13).
    AngleDeviation,
    /// Direction of the measured edge against the nominal tangent (15).
    Direction,
    /// Radius of the edge break (6).
    BreakRadius,
    /// Leg of a chamfer along the first flank (7).
    ChamferLeg1,
    /// Leg of a chamfer along the second flank (7).
    ChamferLeg2,
    /// Angle of a chamfer to the first flank (7).
    ChamferAngle,
    /// Distance from the virtual edge to the highest place of the real profile (10).
    Truncation,
    /// Largest excess outside the ideal sharp edge (12).
    Burr,
    /// Largest depth missing inside the ideal sharp edge, along n1 (11).
    Undercut1,
    /// Largest depth missing inside the ideal sharp edge, along n2 (11).
    Undercut2,
    /// Diameter of the smallest cylinder around a measured straight edge (14).
    Straightness,
    /// Twice the largest distance from the nominal edge where the alignment puts it (14, with datums).
    LineProfile,
    /// The same after the edge alone has been moved to where it fits best (14, without datums).
    LineForm,
}

/// Over what a quantity has one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// A station.
    Station,
    /// A stretch of stations.
    Stretch,
    /// The whole edge.
    Edge,
}

/// The unit of a quantity inside; outside angles are in degrees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// mm.
    Length,
    /// rad; degrees outside.
    Angle,
}

impl Unit {
    /// From the inside to the outside: mm as they are, rad to degrees.
    pub fn outside(self, value: f64) -> f64 {
        match self {
            Unit::Length => value,
            Unit::Angle => value.to_degrees(),
        }
    }

    /// From the outside to the inside.
    pub fn inside(self, value: f64) -> f64 {
        match self {
            Unit::Length => value,
            Unit::Angle => value.to_radians(),
        }
    }

    /// `mm` or `deg`.
    pub fn name(self) -> &'static str {
        match self {
            Unit::Length => "mm",
            Unit::Angle => "deg",
        }
    }
}

/// One row of the table.
struct Row {
    quantity: Quantity,
    /// In ids: `e1.d1`.
    id: &'static str,
    /// What people call it.
    words: &'static str,
    /// The key of its limits in a recipe.
    key: &'static str,
    unit: Unit,
    extent: Extent,
    /// Cannot be negative: one number in the recipe is its upper limit.
    one_sided: bool,
}

const fn row(
    quantity: Quantity,
    (id, words, key): (&'static str, &'static str, &'static str),
    unit: Unit,
    extent: Extent,
    one_sided: bool,
) -> Row {
    Row {
        quantity,
        id,
        words,
        key,
        unit,
        extent,
        one_sided,
    }
}

use Extent::{Edge, Station, Stretch};
use Unit::{Angle, Length};

/// In the order of [`Quantity`].
#[rustfmt::skip]
const TABLE: [Row; Quantity::COUNT] = [
    row(Quantity::D1, ("d1", "d1", "d1_mm"), Length, Station, false),
    row(Quantity::D2, ("d2", "d2", "d2_mm"), Length, Station, false),
    row(Quantity::Total, ("total", "the total deviation", "total_mm"), Length, Station, true),
    row(Quantity::AngleDeviation, ("angle", "the angle deviation", "included_angle_deg"), Angle, Station, false),
    row(Quantity::Direction, ("direction", "the deviation of its direction", "direction_deg"), Angle, Edge, true),
    row(Quantity::BreakRadius, ("radius", "the edge radius", "radius_mm"), Length, Stretch, true),
    row(Quantity::ChamferLeg1, ("leg1", "the chamfer leg on flank 1", "chamfer_leg1_mm"), Length, Stretch, true),
    row(Quantity::ChamferLeg2, ("leg2", "the chamfer leg on flank 2", "chamfer_leg2_mm"), Length, Stretch, true),
    row(Quantity::ChamferAngle, ("chamfer_angle", "the chamfer angle", "chamfer_angle_deg"), Angle, Stretch, false),
    row(Quantity::Truncation, ("truncation", "the truncation", "truncation_mm"), Length, Stretch, true),
    row(Quantity::Burr, ("burr", "the burr", "burr_mm"), Length, Stretch, true),
    row(Quantity::Undercut1, ("undercut1", "the undercut along n1", "undercut1_mm"), Length, Stretch, true),
    row(Quantity::Undercut2, ("undercut2", "the undercut along n2", "undercut2_mm"), Length, Stretch, true),
    row(Quantity::Straightness, ("straightness", "the straightness", "straightness_mm"), Length, Edge, true),
    row(Quantity::LineProfile, ("line_profile", "the line profile", "line_profile_mm"), Length, Edge, true),
    row(Quantity::LineForm, ("line_form", "the line profile without datums", "line_form_mm"), Length, Edge, true),
];

/// Keys that give two quantities the same limits.
pub const PAIRS: [(&str, [Quantity; 2]); 3] = [
    ("d_mm", [Quantity::D1, Quantity::D2]),
    (
        "chamfer_leg_mm",
        [Quantity::ChamferLeg1, Quantity::ChamferLeg2],
    ),
    ("undercut_mm", [Quantity::Undercut1, Quantity::Undercut2]),
];

impl Quantity {
    /// How many there are.
    pub const COUNT: usize = 16;

    /// All, in order.
    pub fn all() -> impl Iterator<Item = Quantity> {
        TABLE.iter().map(|row| row.quantity)
    }

    fn row(self) -> &'static Row {
        &TABLE[self as usize]
    }

    /// In ids: `d1` of `e1.d1`.
    pub fn id(self) -> &'static str {
        self.row().id
    }

    /// What people call it, fit for a sentence.
    pub fn words(self) -> &'static str {
        self.row().words
    }

    /// The key of its limits in a recipe.
    pub fn key(self) -> &'static str {
        self.row().key
    }

    /// Its unit.
    pub fn unit(self) -> Unit {
        self.row().unit
    }

    /// Over what it has one value.
    pub fn extent(self) -> Extent {
        self.row().extent
    }

    /// Whether it cannot be negative, so that 0 is a natural bound and no limit.
    pub fn one_sided(self) -> bool {
        self.row().one_sided
    }
}

/// Where a limit comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitSource {
    /// The recipe.
    Recipe,
    /// The entity with this number in the nominal's PMI.
    Pmi(u64),
}

/// Lower and upper limit of every quantity, in mm and rad; `None` = not evaluated, an infinite one = no limit on that side.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Limits([Option<([f64; 2], LimitSource)>; Quantity::COUNT]);

impl Limits {
    /// Of one quantity.
    pub fn of(&self, quantity: Quantity) -> Option<[f64; 2]> {
        self.0[quantity as usize].map(|(limits, _)| limits)
    }

    /// Where those of one quantity come from.
    pub fn source(&self, quantity: Quantity) -> Option<LimitSource> {
        self.0[quantity as usize].map(|(_, source)| source)
    }

    /// These with `limits` of the recipe for one quantity.
    #[must_use]
    pub fn with(mut self, quantity: Quantity, limits: [f64; 2]) -> Self {
        self.0[quantity as usize] = Some((limits, LimitSource::Recipe));
        self
    }

    /// These with `limits` from the PMI entity `entity` for one quantity, where they leave less room than what is there.
    #[must_use]
    pub fn tightened(mut self, quantity: Quantity, limits: [f64; 2], entity: u64) -> Self {
        let width = |limits: [f64; 2]| limits[1] - limits[0];
        let tighter = self
            .of(quantity)
            .is_none_or(|own| width(limits) < width(own) || limits[1] < own[1]);
        if tighter {
            self.0[quantity as usize] = Some((limits, LimitSource::Pmi(entity)));
        }
        self
    }

    /// Whether nothing is evaluated.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(Option::is_none)
    }

    /// These, and those of `general` where there are none.
    #[must_use]
    pub fn or(self, general: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i].or(general.0[i])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_stands_in_the_order_of_the_quantities_and_names_none_twice() {
        for (index, row) in TABLE.iter().enumerate() {
            assert_eq!(row.quantity as usize, index);
            for other in &TABLE[..index] {
                assert_ne!((row.id, row.key), (other.id, other.key));
            }
        }
    }

    #[test]
    fn limits_fall_back_on_the_general_ones() {
        let general = Limits::default().with(Quantity::D1, [-1.0, 1.0]);
        let own = Limits::default().with(Quantity::Burr, [f64::NEG_INFINITY, 0.1]);
        let both = own.or(general);
        assert_eq!(both.of(Quantity::D1), Some([-1.0, 1.0]));
        assert_eq!(both.of(Quantity::Burr), Some([f64::NEG_INFINITY, 0.1]));
        assert_eq!(both.of(Quantity::D2), None);
        assert!(Limits::default().is_empty() && !both.is_empty());
    }
}
