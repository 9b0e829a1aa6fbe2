//! Trends: values in the order of their parts, with the limits and the capability that follow from them.

use axum::Json;
use axum::extract::State;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use crate::store::{Store, Trend};
use crate::web::app::App;
use crate::web::problem::{Asked, Place, Problem};

/// Expected range of two values of a normal distribution with standard deviation 1: ISO 7870-2, table 2, n = 2 (also Montgomery,
/// Introduction to Statistical Quality Control, appendix VI).
const D2: f64 = 1.128;
/// Upper limit of the moving range, as a multiple of its mean: the same tables, D4 for n = 2.
const D4: f64 = 3.267;
/// A range needs two values.
const ENOUGH: usize = 2;
/// Below so many values capability is not given: its own spread would be larger than what it is to tell (Montgomery, 6.2, wants
/// 20 to 25 samples before limits are taken for those of the process).
const CAPABLE: usize = 20;

/// The characteristics that were ever measured, by name.
#[utoipa::path(get, path = "/api/v1/characteristics", tag = "trends",
    responses((status = 200, description = "names as in `/trends/{name}`", body = Vec<String>)))]
pub async fn characteristics(State(app): State<App>) -> Result<Json<Vec<String>>, Problem> {
    Ok(Json(app.store(Store::characteristics).await?))
}

/// Which values of a trend.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct TrendOf {
    /// The last so many, at most 500; 100 where nothing is said.
    #[param(value_type = Option<i64>, minimum = 0, maximum = 4_294_967_295_u32)]
    limit: Option<u32>,
    /// Also of setup, audit and master parts and of simulated instruments.
    everything: bool,
}

/// A trend with what follows from it.
#[derive(Debug, Serialize, ToSchema)]
pub struct Charted {
    #[serde(flatten)]
    trend: Trend,
    /// Null where fewer than two values were measured.
    statistics: Option<Statistics>,
}

/// Individuals chart (ISO 7870-2) and capability (ISO 22514-2) of the values shown.
///
/// The spread within is the mean moving range divided by 1.128; it does not see slow drift, the overall one does.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct Statistics {
    /// Values measured.
    count: usize,
    /// Their mean.
    mean: f64,
    /// Standard deviation from neighbour to neighbour: mean moving range / 1.128.
    sigma_within: f64,
    /// Standard deviation of all.
    sigma_overall: f64,
    /// Lower control limit of a value: mean - 3 sigma within.
    control_lower: f64,
    /// Upper control limit of a value.
    control_upper: f64,
    /// Upper control limit of a moving range: 3.267 times its mean.
    moving_range_upper: f64,
    /// Tolerance over six sigma within; null without both limits, without spread, or below 20 values.
    cp: Option<f64>,
    /// Distance of the mean to the nearer limit over three sigma within; null without any limit, without spread, or below 20 values.
    cpk: Option<f64>,
    /// As `cp`, with sigma overall.
    pp: Option<f64>,
    /// As `cpk`, with sigma overall.
    ppk: Option<f64>,
    /// How many values lie outside the control limits.
    outside: usize,
}

/// The last values of one characteristic, oldest first.
#[utoipa::path(get, path = "/api/v1/trends/{name}", tag = "trends",
    params(("name" = String, Path, description = "edge and quantity: `e1.d1`"), TrendOf),
    responses((status = 200, description = "values, limits, capability", body = Charted)))]
pub async fn trend(
    State(app): State<App>,
    Place(name): Place<String>,
    Asked(of): Asked<TrendOf>,
) -> Result<Json<Charted>, Problem> {
    let trend = app
        .store(move |store| store.trend(&name, of.limit.unwrap_or(100), of.everything))
        .await?;
    let values: Vec<f64> = trend
        .points
        .iter()
        .filter_map(|point| point.value)
        .collect();
    let statistics = statistics(&values, trend.lower, trend.upper);
    Ok(Json(Charted { trend, statistics }))
}

fn statistics(values: &[f64], lower: Option<f64>, upper: Option<f64>) -> Option<Statistics> {
    let count = values.len();
    if count < ENOUGH {
        return None;
    }
    let mean = values.iter().sum::<f64>() / count as f64;
    let ranges = values.windows(2).map(|pair| (pair[1] - pair[0]).abs());
    let mean_range = ranges.sum::<f64>() / (count - 1) as f64;
    let squares = values.iter().map(|value| (value - mean).powi(2));
    let sigma_overall = (squares.sum::<f64>() / (count - 1) as f64).sqrt();
    let sigma_within = mean_range / D2;
    let (control_lower, control_upper) = (mean - 3.0 * sigma_within, mean + 3.0 * sigma_within);
    let capable = count >= CAPABLE;
    let spread = |sigma: f64| {
        let (lower, upper) = (lower?, upper?);
        (capable && sigma > 0.0).then(|| (upper - lower) / (6.0 * sigma))
    };
    let nearer = |sigma: f64| {
        let below = lower.map(|lower| mean - lower);
        let above = upper.map(|upper| upper - mean);
        let nearest = below.into_iter().chain(above).min_by(f64::total_cmp)?;
        (capable && sigma > 0.0).then(|| nearest / (3.0 * sigma))
    };
    let inside = |value: &&f64| (control_lower..=control_upper).contains(*value);
    Some(Statistics {
        count,
        mean,
        sigma_within,
        sigma_overall,
        control_lower,
        control_upper,
        moving_range_upper: D4 * mean_range,
        cp: spread(sigma_within),
        cpk: nearer(sigma_within),
        pp: spread(sigma_overall),
        ppk: nearer(sigma_overall),
        outside: count - values.iter().filter(inside).count(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Montgomery, Introduction to Statistical Quality Control, 7th edition, example 6.5: cost of loan applications of 20 weeks.
    /// The book gives mean 300.5, mean moving range 7.79, limits 321.22 and 279.78 and an upper limit 25.45 of the moving range.
    #[test]
    fn the_individuals_chart_is_that_of_the_textbook() {
        let costs = [
            310.0, 288.0, 297.0, 298.0, 307.0, 303.0, 294.0, 297.0, 308.0, 306.0, 294.0, 299.0,
            297.0, 299.0, 314.0, 295.0, 293.0, 306.0, 301.0, 304.0,
        ];
        let found = statistics(&costs, Some(270.0), Some(330.0)).expect("20 values");
        // The book rounds to hundredths.
        let near = |value: f64, book: f64| (value - book).abs() < 0.011;
        assert!(near(found.mean, 300.5), "{found:?}");
        assert!(near(found.control_upper, 321.22), "{found:?}");
        assert!(near(found.control_lower, 279.78), "{found:?}");
        assert!(near(found.moving_range_upper, 25.45), "{found:?}");
        assert_eq!(found.outside, 0);
        let sigma = 7.79 / 1.128;
        let (cp, cpk) = (60.0 / (6.0 * sigma), 29.5 / (3.0 * sigma));
        assert!((found.cp.expect("both limits") - cp).abs() < 1e-3);
        assert!((found.cpk.expect("limits") - cpk).abs() < 1e-3);
    }

    #[test]
    fn without_spread_limits_or_enough_values_there_is_no_capability() {
        assert_eq!(statistics(&[1.0], None, None), None);
        let still = statistics(&[1.0; 30], Some(0.0), Some(2.0)).expect("30 values");
        assert_eq!((still.cp, still.cpk), (None, None));
        let few = statistics(&[1.0, 2.0, 1.0], Some(0.0), Some(4.0)).expect("3 values");
        assert_eq!((few.cp, few.cpk), (None, None));
        let many: Vec<f64> = (0..30).map(|index| f64::from(index % 3)).collect();
        let upper = statistics(&many, None, Some(4.0)).expect("30 values");
        assert_eq!(upper.cp, None);
        assert!(
            upper.cpk.is_some(),
            "one limit is enough for the nearer one"
        );
    }
}
