//! What an edge has beside its deviations: the characteristics of its shape and form, budgets, corners, gaps.

use std::fmt::{self, Write};

use super::page::{Escaped, PlusMinus, State};
use crate::inspect::quantity::Quantity;
use crate::report::figure::{COVERAGE_FACTOR, Figure};
use crate::report::wire::{Characteristic, Edge, Gap, Report, Shape, Status};

/// The shape of the edge in words, all characteristics as a table, and what the uncertainty of the worst values is made of.
pub fn write_edge(out: &mut String, edge: &Edge) -> fmt::Result {
    write_breaks(out, edge)?;
    let shown: Vec<&Characteristic> = edge
        .characteristics
        .iter()
        .filter(|c| c.value.is_some() || c.verdict != Status::Undefined)
        .collect();
    if shown.is_empty() {
        return Ok(());
    }
    out.write_str(
        "<details><summary>All values and what their uncertainty is made of</summary>\
         <div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"All values of the edge\"><table><thead><tr>\
         <th scope=\"col\">value</th><th scope=\"col\" class=\"n\">worst ± U</th><th scope=\"col\" class=\"n\">at, mm</th>\
         <th scope=\"col\" class=\"n\">limits</th><th scope=\"col\">verdict</th><th scope=\"col\" class=\"n\">conforms</th>\
         <th scope=\"col\" class=\"n\">U of points</th><th scope=\"col\" class=\"n\">alignment</th><th scope=\"col\" class=\"n\">calibration</th>\
         <th scope=\"col\" class=\"n\">temperature</th></tr></thead><tbody>\n",
    )?;
    for characteristic in shown {
        write_characteristic(out, characteristic)?;
    }
    out.write_str("</tbody></table></div></details>\n")
}

fn write_characteristic(out: &mut String, found: &Characteristic) -> fmt::Result {
    let words = found.quantity.words();
    write!(
        out,
        "<tr><th scope=\"row\">{}</th>",
        Escaped(words.strip_prefix("the ").unwrap_or(words))
    )?;
    match found.value {
        Some(value) => {
            let figure = Figure::of(found.quantity, value, found.u);
            write!(
                out,
                "<td class=\"n\">{} {}</td>",
                PlusMinus(&figure),
                figure.unit
            )?;
        }
        None => write!(out, "<td class=\"n soft\">{}</td>", Escaped(&found.reason))?,
    }
    let place = found.s_mm.map_or_else(String::new, |s| format!("{s:.1}"));
    let probable = found
        .conformance
        .map_or_else(String::new, |p| format!("{:.1} %", 100.0 * p));
    write!(
        out,
        "<td class=\"n\">{place}</td><td class=\"n\">{}</td><td>{}</td><td class=\"n\">{probable}</td>",
        Escaped(&limits(found)),
        State(found.verdict)
    )?;
    let parts = found.budget.map_or([None; 4], |b| {
        [b.points, b.alignment, b.calibration, b.temperature]
    });
    for part in parts {
        let text = part.map_or_else(String::new, |u| expanded(found.quantity, u));
        write!(out, "<td class=\"n\">{text}</td>")?;
    }
    out.write_str("</tr>\n")
}

/// U = 2 u of one contribution.
fn expanded(quantity: Quantity, u: f64) -> String {
    if u <= 0.0 {
        return "0".to_owned();
    }
    let figure = Figure::of(quantity, COVERAGE_FACTOR * u, Some(u));
    format!("{} {}", figure.expanded.unwrap_or_default(), figure.unit)
}

fn limits(found: &Characteristic) -> String {
    let figure = |limit| Figure::of(found.quantity, limit, None);
    let mut text = match (found.lower, found.upper) {
        (Some(lower), Some(upper)) => {
            format!("{} to {}", figure(lower).value, figure(upper).with_unit())
        }
        (None, Some(upper)) => format!("at most {}", figure(upper).with_unit()),
        (Some(lower), None) => format!("at least {}", figure(lower).with_unit()),
        (None, None) => return String::new(),
    };
    if let Some(entity) = found.limits_from.as_deref().filter(|f| f.starts_with('#')) {
        text += &format!(" (PMI {entity})");
    }
    text
}

/// One line a kind of shape: over how much of the edge, and between which sizes.
fn write_breaks(out: &mut String, edge: &Edge) -> fmt::Result {
    let all: f64 = edge.breaks.iter().map(|b| b.s_mm[1] - b.s_mm[0]).sum();
    if edge.breaks.is_empty() || all <= 0.0 {
        return Ok(());
    }
    out.write_str("<ul class=\"small\">")?;
    for shape in [
        Shape::Sharp,
        Shape::Round,
        Shape::Chamfer,
        Shape::Undecided,
        Shape::Irregular,
    ] {
        let of_shape: Vec<_> = edge.breaks.iter().filter(|b| b.shape == shape).collect();
        if of_shape.is_empty() {
            continue;
        }
        let share = of_shape.iter().map(|b| b.s_mm[1] - b.s_mm[0]).sum::<f64>() / all;
        let range = |values: Vec<f64>| {
            let low = values.iter().copied().fold(f64::INFINITY, f64::min);
            let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            if low <= high {
                format!("{low:.3} to {high:.3} mm")
            } else {
                "not known".to_owned()
            }
        };
        let words = match shape {
            Shape::Sharp => {
                let below = of_shape.iter().filter_map(|b| b.radius_below_mm);
                let most = below.fold(0.0, f64::max);
                format!("sharp: no radius above {most:.3} mm")
            }
            Shape::Round => {
                let radii = of_shape.iter().filter_map(|b| b.radius_mm?.value);
                format!("round: radius {}", range(radii.collect()))
            }
            Shape::Chamfer => {
                let legs = of_shape.iter().filter_map(|b| b.chamfer_legs_mm);
                let legs = legs.flatten().filter_map(|leg| leg.value);
                format!("chamfer: legs {}", range(legs.collect()))
            }
            Shape::Undecided => {
                let radii = of_shape.iter().filter_map(|b| b.radius_mm?.value);
                let legs = of_shape.iter().filter_map(|b| b.chamfer_legs_mm);
                let legs = legs.flatten().filter_map(|leg| leg.value);
                format!(
                    "broken, round or chamfer not to be told: radius {} or legs {}",
                    range(radii.collect()),
                    range(legs.collect())
                )
            }
            Shape::Irregular => {
                let burrs = of_shape.iter().filter_map(|b| b.burr_mm.value);
                format!("irregular: burr {}", range(burrs.collect()))
            }
        };
        write!(
            out,
            "<li>{} of the edge is {}</li>",
            super::percent(share),
            Escaped(&words)
        )?;
    }
    out.write_str("</ul>\n")
}

/// Corners and gaps; nothing where there are none.
pub fn write_corners_and_gaps(out: &mut String, report: &Report) -> fmt::Result {
    if !report.corners.is_empty() {
        write_corners(out, report)?;
    }
    if !report.gaps.is_empty() {
        out.write_str(
            "<section class=\"card\"><h2>Gap and flush</h2>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Gap and flush\"><table><thead><tr>\
             <th scope=\"col\">name</th><th scope=\"col\">verdict</th><th scope=\"col\">between</th><th scope=\"col\" class=\"n\">stations</th>\
             <th scope=\"col\" class=\"n\">gap, mm</th><th scope=\"col\" class=\"n\">flush, mm</th><th scope=\"col\" class=\"n\">U at most, mm</th></tr></thead><tbody>\n",
        )?;
        for gap in &report.gaps {
            write_gap(out, gap)?;
        }
        out.write_str("</tbody></table></div></section>\n")?;
    }
    Ok(())
}

fn write_gap(out: &mut String, gap: &Gap) -> fmt::Result {
    let range = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if low <= high {
            format!("{low:.3} to {high:.3}")
        } else {
            "not measured".to_owned()
        }
    };
    let stations = &gap.stations;
    let u = stations
        .iter()
        .flat_map(|s| [s.u_gap_mm, s.u_flush_mm])
        .flatten()
        .fold(0.0, f64::max);
    writeln!(
        out,
        "<tr><th scope=\"row\">{}</th><td>{}</td><td>{} and {}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{:.4}</td></tr>",
        Escaped(&gap.name),
        State(gap.verdict),
        Escaped(&gap.edges[0]),
        Escaped(&gap.edges[1]),
        stations.len(),
        range(stations.iter().filter_map(|s| s.gap_mm).collect()),
        range(stations.iter().filter_map(|s| s.flush_mm).collect()),
        COVERAGE_FACTOR * u
    )
}

fn write_corners(out: &mut String, report: &Report) -> fmt::Result {
    out.write_str(
        "<section class=\"card\"><h2>Corners</h2>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Corners\"><table><thead><tr>\
         <th scope=\"col\">corner</th><th scope=\"col\">verdict</th><th scope=\"col\" class=\"n\">distance from nominal ± U, µm</th>\
         <th scope=\"col\">nominal place, mm</th><th scope=\"col\">edges</th></tr></thead><tbody>\n",
    )?;
    const LISTED: usize = 200;
    for corner in report.corners.iter().take(LISTED) {
        write!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{}</td>",
            Escaped(&corner.id),
            State(corner.verdict)
        )?;
        match corner.total_mm {
            Some(total) => write!(
                out,
                "<td class=\"n\">{}</td>",
                PlusMinus(&Figure::of(Quantity::Total, total, corner.u_total_mm))
            )?,
            None => write!(out, "<td class=\"n soft\">{}</td>", Escaped(&corner.reason))?,
        }
        let [x, y, z] = corner.nominal;
        writeln!(
            out,
            "<td>{x:.3}, {y:.3}, {z:.3}</td><td>{}</td></tr>",
            Escaped(&corner.edges.join(", "))
        )?;
    }
    out.write_str("</tbody></table></div>")?;
    if report.corners.len() > LISTED {
        write!(
            out,
            "<p class=\"small soft\">and {} more, in the JSON form</p>",
            report.corners.len() - LISTED
        )?;
    }
    out.write_str("</section>\n")
}
