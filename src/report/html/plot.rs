//! One deviation along one edge as an SVG: value, band of U, limits, holes as gaps, the worst place marked.

use std::fmt::{self, Write};

use super::page::{Escaped, Paper, class};
use crate::inspect::quantity::Unit;
use crate::report::characteristic::sample;
use crate::report::figure::COVERAGE_FACTOR;
use crate::report::wire::{Characteristic, Edge, Judged, Quantity, Status};

const WIDTH: f64 = 480.0;
const HEIGHT: f64 = 190.0;
const LEFT: f64 = 50.0;
const RIGHT: f64 = 44.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 34.0;

/// A station in the units of the plot: mm along, µm or degrees up.
struct Dot {
    s_mm: f64,
    /// Value and expanded uncertainty; `None` = not measured.
    seen: Option<(f64, f64)>,
}

/// Where places and values lie on the paper.
struct Axes {
    length_mm: f64,
    low: f64,
    high: f64,
    /// From the unit of the wire to the one people read: mm to µm, degrees as they are.
    scale: f64,
}

impl Axes {
    fn x(&self, s_mm: f64) -> f64 {
        LEFT + (WIDTH - LEFT - RIGHT) * s_mm / self.length_mm
    }

    fn y(&self, value: f64) -> f64 {
        TOP + (HEIGHT - TOP - BOTTOM) * (self.high - value) / (self.high - self.low)
    }

    /// The part of the axis that shows `[low, high]`.
    fn band(&self, low: f64, high: f64) -> (f64, f64) {
        let (top, bottom) = (self.y(high.min(self.high)), self.y(low.max(self.low)));
        (top, (bottom - top).max(0.0))
    }
}

/// Writes the plot of one quantity; `shown` are the stations to draw.
pub fn write(out: &mut Paper, edge: &Edge, quantity: Quantity, shown: &[usize]) -> fmt::Result {
    let Some(characteristic) = edge.characteristics.iter().find(|c| c.quantity == quantity) else {
        return Ok(());
    };
    let scale = match quantity.unit() {
        Unit::Length => 1e3,
        Unit::Angle => 1.0,
    };
    let dots = dots(edge, (quantity, scale), shown);
    let axes = axes(edge, (&dots, scale), characteristic);
    writeln!(
        out,
        r#"<figure><svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{}">"#,
        Escaped(&spoken(out, edge, characteristic))
    )?;
    write_within(out, &axes, characteristic)?;
    write_grid(out, &axes)?;
    write_limits(out, &axes, characteristic)?;
    write_holes(out, &axes, &dots)?;
    write_band(out, &axes, &dots)?;
    write_line(out, &axes, &dots)?;
    write_worst(out, &axes, characteristic)?;
    let caption = match quantity {
        Quantity::D1 => out.t("plot.d1"),
        Quantity::D2 => out.t("plot.d2"),
        Quantity::AngleDeviation => out.t("plot.angle"),
        other => out.words.said(other.words()),
    };
    writeln!(
        out,
        r#"<text class="x" x="{:.0}" y="{:.0}">{}</text></svg><figcaption>{}</figcaption></figure>"#,
        (WIDTH + LEFT - RIGHT) / 2.0,
        HEIGHT - 3.0,
        Escaped(&out.t("plot.s")),
        Escaped(&caption)
    )
}

fn dots(edge: &Edge, (quantity, scale): (Quantity, f64), shown: &[usize]) -> Vec<Dot> {
    shown
        .iter()
        .map(|&index| Dot {
            s_mm: edge.stations[index].s_mm,
            seen: sample(&edge.stations[index], quantity).map(|seen| {
                let expanded = COVERAGE_FACTOR * seen.u.unwrap_or(0.0);
                (seen.value * scale, expanded * scale)
            }),
        })
        .collect()
}

/// Axes that hold every value with its U, zero, and the limits unless these are much farther out than the values.
fn axes(edge: &Edge, (dots, scale): (&[Dot], f64), characteristic: &Characteristic) -> Axes {
    let seen = || dots.iter().filter_map(|dot| dot.seen);
    // At least 1 µm or 0.001 degrees, so that values of zero still have an axis.
    let mut low = seen().map(|(d, u)| d - u).fold(-1e-3 * scale, f64::min);
    let mut high = seen().map(|(d, u)| d + u).fold(1e-3 * scale, f64::max);
    let reach = 8.0 * high.max(-low);
    for limit in [characteristic.lower, characteristic.upper]
        .into_iter()
        .flatten()
        .map(|limit| limit * scale)
        .filter(|limit| limit.abs() <= reach)
    {
        low = low.min(limit);
        high = high.max(limit);
    }
    let margin = 0.1 * (high - low);
    let last = edge.stations.last().map_or(0.0, |station| station.s_mm);
    Axes {
        length_mm: edge.length_mm.unwrap_or(last).max(last).max(1e-6),
        low: low - margin,
        high: high + margin,
        scale,
    }
}

fn spoken(out: &Paper, edge: &Edge, characteristic: &Characteristic) -> String {
    let judged = Judged::from(characteristic);
    out.with(
        "plot.said",
        &[
            ("edge", &edge.id),
            ("said", &judged.stated(&characteristic.reason, out.words)),
            ("measured", &edge.summary.measured.to_string()),
            ("stations", &edge.summary.stations.to_string()),
        ],
    )
}

/// The stripe within the limits.
fn write_within(out: &mut Paper, axes: &Axes, characteristic: &Characteristic) -> fmt::Result {
    let (Some(lower), Some(upper)) = (characteristic.lower, characteristic.upper) else {
        return Ok(());
    };
    let (top, height) = axes.band(lower * axes.scale, upper * axes.scale);
    writeln!(
        out,
        r#"<rect class="within" x="{LEFT:.1}" y="{top:.1}" width="{:.1}" height="{height:.1}"/>"#,
        WIDTH - LEFT - RIGHT
    )
}

/// A dashed line a limit, its value at the right.
fn write_limits(out: &mut Paper, axes: &Axes, characteristic: &Characteristic) -> fmt::Result {
    let x1 = WIDTH - RIGHT;
    for limit in [characteristic.upper, characteristic.lower]
        .into_iter()
        .flatten()
    {
        let value = limit * axes.scale;
        if (axes.low..=axes.high).contains(&value) {
            let y = axes.y(value);
            writeln!(
                out,
                r#"<path class="limit" d="M{LEFT:.1} {y:.1}H{x1:.1}"/><text class="limit-name" x="{:.1}" y="{:.1}">{}</text>"#,
                x1 + 5.0,
                y + 4.0,
                out.figure(characteristic.quantity, limit, None).value
            )?;
        }
    }
    Ok(())
}

fn write_grid(out: &mut Paper, axes: &Axes) -> fmt::Result {
    let (x0, x1) = (axes.x(0.0), axes.x(axes.length_mm));
    let step = nice_step((axes.high - axes.low) / 4.0);
    let first = (axes.low / step).ceil() as i64;
    let last = (axes.high / step).floor() as i64;
    for tick in first..=last {
        let y = axes.y(tick as f64 * step);
        let class = if tick == 0 { "zero" } else { "grid" };
        let label = out.words.number(&tick_label(tick as f64 * step, step));
        writeln!(
            out,
            r#"<path class="{class}" d="M{x0:.1} {y:.1}H{x1:.1}"/><text class="y" x="{:.1}" y="{:.1}">{label}</text>"#,
            x0 - 5.0,
            y + 4.0
        )?;
    }
    let (step, base) = (nice_step(axes.length_mm / 5.0), HEIGHT - BOTTOM);
    for tick in 0..=(axes.length_mm / step).floor() as i64 {
        let mm = tick as f64 * step;
        writeln!(
            out,
            r#"<path class="grid" d="M{x:.1} {base:.1}v4"/><text class="x" x="{x:.1}" y="{:.1}">{}</text>"#,
            base + 16.0,
            out.words
                .number(tick_label(mm, step).trim_start_matches('+')),
            x = axes.x(mm)
        )?;
    }
    writeln!(
        out,
        r#"<path class="grid" d="M{x0:.1} {base:.1}H{x1:.1}"/>"#
    )
}

/// 1, 2 or 5 times a power of ten, at least `least`.
pub fn nice_step(least: f64) -> f64 {
    let power = 10f64.powf(least.max(1e-9).log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * power)
        .find(|step| *step >= least * 0.999_999)
        .unwrap_or(10.0 * power)
}

fn tick_label(value: f64, step: f64) -> String {
    let decimals = (-step.log10().floor()).clamp(0.0, 9.0) as usize;
    match value {
        v if v.abs() < 0.5 * step => "0".to_owned(),
        v if v < 0.0 => format!("−{:.decimals$}", -v),
        v => format!("+{v:.decimals$}"),
    }
}

/// Hatches from the last measured station before a hole to the first behind it.
fn write_holes(out: &mut Paper, axes: &Axes, dots: &[Dot]) -> fmt::Result {
    let mut from_mm = Some(0.0);
    let mut hole = false;
    let ends = dots
        .iter()
        .map(|dot| (dot.s_mm, dot.seen.is_some()))
        .chain([(axes.length_mm, true)]);
    for (s_mm, seen) in ends {
        if !seen {
            hole = true;
            continue;
        }
        if let (true, Some(from_mm)) = (hole, from_mm) {
            let (x0, x1) = (axes.x(from_mm), axes.x(s_mm));
            writeln!(
                out,
                r#"<rect class="hole" x="{x0:.1}" y="{TOP:.1}" width="{:.1}" height="{:.1}"><title>{}</title></rect>"#,
                x1 - x0,
                HEIGHT - TOP - BOTTOM,
                Escaped(&out.t("not.measured"))
            )?;
            if x1 - x0 > 76.0 {
                writeln!(
                    out,
                    r#"<text class="x worst-name" x="{:.1}" y="{:.1}">{}</text>"#,
                    (x0 + x1) / 2.0,
                    TOP + 0.72 * (HEIGHT - TOP - BOTTOM),
                    Escaped(&out.t("not.measured"))
                )?;
            }
        }
        from_mm = Some(s_mm);
        hole = false;
    }
    Ok(())
}

/// Runs of measured stations.
fn runs(dots: &[Dot]) -> impl Iterator<Item = Vec<(f64, f64, f64)>> {
    dots.split(|dot| dot.seen.is_none())
        .map(|run| {
            run.iter()
                .filter_map(|dot| dot.seen.map(|(d, u)| (dot.s_mm, d, u)))
                .collect::<Vec<_>>()
        })
        .filter(|run| !run.is_empty())
}

fn write_band(out: &mut Paper, axes: &Axes, dots: &[Dot]) -> fmt::Result {
    for run in runs(dots) {
        out.write_str(r#"<path class="u" d=""#)?;
        let above = run.iter().map(|&(s, d, u)| (s, d + u));
        let below = run.iter().rev().map(|&(s, d, u)| (s, d - u));
        for (index, (s_mm, um)) in above.chain(below).enumerate() {
            let pen = if index == 0 { 'M' } else { 'L' };
            write!(out, "{pen}{:.1} {:.1}", axes.x(s_mm), axes.y(um))?;
        }
        out.write_str("Z\"/>\n")?;
    }
    Ok(())
}

fn write_line(out: &mut Paper, axes: &Axes, dots: &[Dot]) -> fmt::Result {
    for run in runs(dots) {
        if let [(s_mm, um, _)] = run[..] {
            writeln!(
                out,
                r#"<circle class="dot" cx="{:.1}" cy="{:.1}" r="2.5"/>"#,
                axes.x(s_mm),
                axes.y(um)
            )?;
            continue;
        }
        out.write_str(r#"<path class="d" d=""#)?;
        for (index, (s_mm, um, _)) in run.iter().enumerate() {
            let pen = if index == 0 { 'M' } else { 'L' };
            write!(out, "{pen}{:.1} {:.1}", axes.x(*s_mm), axes.y(*um))?;
        }
        out.write_str("\"/>\n")?;
    }
    Ok(())
}

fn write_worst(out: &mut Paper, axes: &Axes, characteristic: &Characteristic) -> fmt::Result {
    let (Some(value), Some(s_mm)) = (characteristic.value, characteristic.s_mm) else {
        return writeln!(
            out,
            r#"<text class="x" x="{:.0}" y="{:.0}">{}</text>"#,
            WIDTH / 2.0,
            HEIGHT / 2.0,
            Escaped(&out.t("not.measured"))
        );
    };
    let (x, y) = (axes.x(s_mm), axes.y(value * axes.scale));
    let status = match characteristic.verdict {
        Status::Undefined => "undefined",
        verdict => class(verdict),
    };
    let figure = out.figure(characteristic.quantity, value, characteristic.u);
    let below = y < TOP + 26.0 || (value < 0.0 && y < HEIGHT - BOTTOM - 24.0);
    let name_y = if below { y + 20.0 } else { y - 10.0 };
    let anchor = match x {
        x if x < LEFT + 50.0 => "start",
        x if x > WIDTH - RIGHT - 30.0 => "end",
        _ => "middle",
    };
    writeln!(
        out,
        r#"<path class="worst f-{status}" d="M{x:.1} {:.1}l6 6l-6 6l-6 -6z"/><text class="worst-name" text-anchor="{anchor}" x="{x:.1}" y="{name_y:.1}">{}</text>"#,
        y - 6.0,
        figure.plus_minus()
    )
}
