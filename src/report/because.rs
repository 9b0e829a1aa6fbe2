//! Why a verdict is what it is, in parts: codes and values of which the table of texts makes a sentence in either language.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::figure::Figure;
use super::wire::{Characteristic, Quantity};
use crate::words::Language;

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

    /// The reason in one sentence.
    pub fn reason(&self, words: Language) -> String {
        let judged = self.characteristic.as_ref();
        let said = judged.map_or(String::new(), |judged| judged.stated(&self.detail, words));
        let limits = judged.and_then(|judged| judged.limits(words));
        let limits = limits.map_or(String::new(), |limits| {
            words.fill("because.limits", &[("limits", &limits)])
        });
        let detail = match self.detail.as_str() {
            "" => String::new(),
            detail => words.fill("because.detail", &[("detail", &words.said(detail))]),
        };
        let count = self.count.to_string();
        let others = match self.count {
            0 => String::new(),
            1 => words.fill("because.other", &[]),
            _ => words.fill("because.others", &[("count", &count)]),
        };
        words.fill(
            &format!("because.{}", code(&self.code)),
            &[
                ("edge", self.edge.as_deref().unwrap_or_default()),
                ("said", &said),
                ("limits", &limits),
                ("detail", &detail),
                ("others", &others),
                ("names", &list(&self.names, words)),
                ("count", &count),
                (
                    "share",
                    &format!("{:.0}", self.coverage.unwrap_or(0.0) * 100.0),
                ),
            ],
        )
    }

    /// What to do next, in one sentence.
    pub fn advice(&self, words: Language) -> String {
        words.fill(&format!("advised.{}", code(&self.advice)), &[])
    }
}

impl Judged {
    /// `d1 is +152 µm (U 12 µm) at 12.4 mm along the edge`; without a value why there is none.
    pub fn stated(&self, detail: &str, words: Language) -> String {
        let quantity = words.said(self.quantity.words());
        let quantity = ("quantity", quantity.as_str());
        let Some(value) = self.value else {
            return match detail {
                "" => words.fill("because.unmeasured", &[quantity]),
                reason => {
                    let reason = words.said(reason);
                    words.fill("because.valueless", &[quantity, ("detail", &reason)])
                }
            };
        };
        let figure = Figure::of(self.quantity, value, self.u).told(words);
        let place = self.s_mm.map_or_else(String::new, |s| {
            let s = words.number(&format!("{s:.1}"));
            words.fill("because.place", &[("s", &s)])
        });
        let value = figure.with_uncertainty(words);
        words.fill(
            "because.stated",
            &[quantity, ("value", &value), ("place", &place)],
        )
    }

    /// `−100 to +100 µm`; `None` without limits.
    pub fn limits(&self, words: Language) -> Option<String> {
        limits_between(self.quantity, [self.lower, self.upper], words)
    }
}

/// `−100 to +100 µm`; `None` without limits.
pub fn limits_between(
    quantity: Quantity,
    limits: [Option<f64>; 2],
    words: Language,
) -> Option<String> {
    let figure = |limit| Figure::of(quantity, limit, None).told(words);
    let told = match limits {
        [Some(low), Some(high)] => {
            let (low, high) = (figure(low).value, figure(high).with_unit());
            words.fill("because.from_to", &[("lower", &low), ("upper", &high)])
        }
        [None, Some(high)] => {
            words.fill("because.at_most", &[("upper", &figure(high).with_unit())])
        }
        [Some(low), None] => words.fill("because.at_least", &[("lower", &figure(low).with_unit())]),
        [None, None] => return None,
    };
    Some(told)
}

/// The word by which the wire knows a case.
pub fn code(case: &impl Serialize) -> String {
    let word = serde_json::to_value(case).expect("a case without fields is a word");
    word.as_str().unwrap_or_default().to_owned()
}

/// At most five words of a list, then a count.
fn list(items: &[String], words: Language) -> String {
    const SHOWN: usize = 5;
    let shown: Vec<String> = items
        .iter()
        .take(SHOWN)
        .map(|item| words.said(item))
        .collect();
    let shown = shown.join(", ");
    match items.len().saturating_sub(SHOWN) {
        0 => shown,
        more => words.fill(
            "because.more",
            &[("names", &shown), ("count", &more.to_string())],
        ),
    }
}
