//! Why a verdict is what it is, in parts: codes and values of which every language makes its own sentence.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::figure::Figure;
use super::wire::{Characteristic, Quantity};

/// Which reason a verdict has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReasonCode {
    /// The characteristic lies outside its limits.
    OutsideLimits,
    /// The characteristic has limits and no value.
    NoValue,
    /// The scan lacks edges of the nominal: `names`.
    EdgesMissing,
    /// Edges are outside their limits without a characteristic that says so: `names`.
    EdgesOutside,
    /// The inspection found the part not OK.
    PartNotOk,
    /// The scan could not be aligned to the nominal well enough.
    NotAligned,
    /// The scan holds the part only weakly in the directions `names`.
    HeldWeakly,
    /// A limit of the characteristic lies inside its uncertainty.
    LimitInsideUncertainty,
    /// Only the share `coverage` of the edge was measured.
    PartlyMeasured,
    /// The data do not allow a verdict.
    DataInadequate,
    /// All `count` values are within their limits; the characteristic is nearest to one.
    AllWithin,
    /// Nothing is outside its limits.
    NoneOutside,
    /// The nominal has no sharp edge.
    NoSharpEdge,
    /// No edge was measured.
    NothingMeasured,
    /// No limits were given.
    NoLimits,
}

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum AdviceCode {
    /// Set the part aside.
    SetAside,
    /// Scan what fixes the weak directions.
    FixDirections,
    /// Measure again with more points.
    MorePoints,
    /// Scan the missing stretches again.
    ScanAgain,
    /// The part may pass.
    Pass,
    /// Check that the nominal is the right one.
    CheckNominal,
    /// Check that scan and nominal are the same part in the same unit.
    CheckUnit,
    /// Give limits.
    GiveLimits,
}

/// The characteristic that a reason is about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, ToSchema)]
pub struct Judged {
    /// What is compared.
    #[schema(value_type = String)]
    pub quantity: Quantity,
    /// `mm` or `deg`.
    pub unit: String,
    /// The worst station's value; null = not measured.
    pub value: Option<f64>,
    /// Its standard uncertainty.
    pub u: Option<f64>,
    /// Where: arc length.
    pub s_mm: Option<f64>,
    /// Lower limit; null = none on this side.
    pub lower: Option<f64>,
    /// Upper limit; null = none on this side.
    pub upper: Option<f64>,
}

/// Why a verdict is what it is, for programs and for other languages than that of `reason` and `advice`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, ToSchema)]
pub struct Because {
    /// Which reason.
    pub code: ReasonCode,
    /// What to do next.
    pub advice: AdviceCode,
    /// The edge where it is seen best; null where it is about none.
    pub edge: Option<String>,
    /// The characteristic of that edge; null where it is about none.
    pub characteristic: Option<Judged>,
    /// Measured share of that edge, 0 to 1; null where that is not the reason.
    pub coverage: Option<f64>,
    /// Edges or directions.
    pub names: Vec<String>,
    /// Values that were judged, for `all_within`; elsewhere how many other edges are likewise.
    pub count: usize,
    /// Why there is no value, as the measurement says it, in English; empty otherwise.
    pub detail: String,
}

impl From<&Characteristic> for Judged {
    fn from(found: &Characteristic) -> Self {
        Self {
            quantity: found.quantity,
            unit: found.unit.clone(),
            value: found.value,
            u: found.u,
            s_mm: found.s_mm,
            lower: found.lower,
            upper: found.upper,
        }
    }
}

impl Because {
    /// A reason that is about nothing in particular.
    pub fn plain(code: ReasonCode, advice: AdviceCode) -> Self {
        Self {
            code,
            advice,
            edge: None,
            characteristic: None,
            coverage: None,
            names: Vec::new(),
            count: 0,
            detail: String::new(),
        }
    }

    /// The reason in one English sentence.
    pub fn reason(&self) -> String {
        let edge = self.edge.as_deref().unwrap_or_default();
        let judged = self.characteristic.as_ref();
        let said = judged.map_or(String::new(), |judged| judged.stated(&self.detail));
        let limits = judged.map_or(String::new(), Judged::limits);
        let others = others(self.count);
        match self.code {
            ReasonCode::OutsideLimits => {
                format!("{edge}: {said}, outside its limits{limits}{others}")
            }
            ReasonCode::NoValue => format!("{edge}: {said}{limits}{others}"),
            ReasonCode::EdgesMissing => format!(
                "the scan has no edge where the nominal has {}",
                list(&self.names)
            ),
            ReasonCode::EdgesOutside => format!("outside the limits: {}", list(&self.names)),
            ReasonCode::PartNotOk => "the inspection found the part not OK".to_owned(),
            ReasonCode::NotAligned => {
                "the scan could not be aligned to the nominal well enough".to_owned()
            }
            ReasonCode::HeldWeakly => {
                format!("the scan holds the part only weakly: {}", list(&self.names))
            }
            ReasonCode::LimitInsideUncertainty => {
                format!("{edge}: {said}; a limit lies inside this uncertainty{limits}{others}")
            }
            ReasonCode::PartlyMeasured => {
                let share = self.coverage.unwrap_or(0.0) * 100.0;
                let detail = match self.detail.as_str() {
                    "" => String::new(),
                    detail => format!(" ({detail})"),
                };
                format!("{edge}: {share:.0} % of the edge was measured{detail}{others}")
            }
            ReasonCode::DataInadequate => "the data do not allow a verdict".to_owned(),
            ReasonCode::AllWithin => format!(
                "all {} values are within their limits; nearest to one is {edge}, where {said}{limits}",
                self.count
            ),
            ReasonCode::NoneOutside => "nothing is outside its limits".to_owned(),
            ReasonCode::NoSharpEdge => "the nominal has no sharp edge to measure".to_owned(),
            ReasonCode::NothingMeasured => "no edge was measured".to_owned(),
            ReasonCode::NoLimits => {
                "no limits were given, so the values are stated and not judged".to_owned()
            }
        }
    }

    /// What to do next, in one English sentence.
    pub fn advice(&self) -> &'static str {
        match self.advice {
            AdviceCode::SetAside => {
                "set the part aside; look at the marked place before anything is reworked"
            }
            AdviceCode::FixDirections => {
                "scan surfaces that fix these directions, or touch datum faces, then measure again"
            }
            AdviceCode::MorePoints => {
                "measure again with more points on both sides of the edge, so that the uncertainty shrinks"
            }
            AdviceCode::ScanAgain => {
                "scan the missing stretches again, from a direction that sees both sides of the edge"
            }
            AdviceCode::Pass => "the part may pass",
            AdviceCode::CheckNominal => "check that the right nominal was given",
            AdviceCode::CheckUnit => {
                "check that scan and nominal are the same part, in the same unit"
            }
            AdviceCode::GiveLimits => "give limits in a recipe to get a verdict",
        }
    }
}

impl Judged {
    /// `d1 is +152 µm (U 12 µm) at 12.4 mm along the edge`; without a value why there is none.
    pub fn stated(&self, detail: &str) -> String {
        let name = self.quantity.words();
        let Some(value) = self.value else {
            return match detail {
                "" => format!("{name} was not measured"),
                reason => format!("{name} has no value: {reason}"),
            };
        };
        let figure = Figure::of(self.quantity, value, self.u);
        let place = self
            .s_mm
            .map_or_else(String::new, |s| format!(" at {s:.1} mm along the edge"));
        format!("{name} is {}{place}", figure.with_uncertainty())
    }

    /// ` (−100 to +100 µm)`.
    fn limits(&self) -> String {
        let figure = |limit| Figure::of(self.quantity, limit, None);
        match (self.lower, self.upper) {
            (Some(lower), Some(upper)) => {
                format!(
                    " ({} to {})",
                    figure(lower).value,
                    figure(upper).with_unit()
                )
            }
            (None, Some(upper)) => format!(" (at most {})", figure(upper).with_unit()),
            (Some(lower), None) => format!(" (at least {})", figure(lower).with_unit()),
            (None, None) => String::new(),
        }
    }
}

fn others(count: usize) -> String {
    match count {
        0 => String::new(),
        1 => "; one more edge likewise".to_owned(),
        more => format!("; {more} more edges likewise"),
    }
}

/// At most five words of a list, then a count.
fn list(items: &[String]) -> String {
    const SHOWN: usize = 5;
    let shown = items
        .iter()
        .take(SHOWN)
        .cloned()
        .collect::<Vec<_>>()
        .join(", ");
    match items.len().saturating_sub(SHOWN) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}
