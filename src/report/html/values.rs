//! What an edge has beside its deviations: the characteristics of its shape and form, budgets, corners, gaps.

use std::fmt::{self, Write};

use super::facts::place;
use super::page::{Escaped, Paper, PlusMinus};
use crate::inspect::quantity::Quantity;
use crate::report::because::limits_between;
use crate::report::figure::COVERAGE_FACTOR;
use crate::report::wire::{Characteristic, Edge, Gap, Report, Shape, Status};

/// The shape of the edge in words, all characteristics as a table, and what the uncertainty of the worst values is made of.
pub fn write_edge(out: &mut Paper, edge: &Edge) -> fmt::Result {
    write_breaks(out, edge)?;
    let shown: Vec<&Characteristic> = edge
        .characteristics
        .iter()
        .filter(|c| c.value.is_some() || c.verdict != Status::Undefined)
        .collect();
    if shown.is_empty() {
        return Ok(());
    }
    out.put(
        "<details><summary>[[values]]</summary>\
         <div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"[[values.table]]\"><table><thead><tr>\
         <th scope=\"col\">[[value]]</th><th scope=\"col\" class=\"n\">[[worst]]</th><th scope=\"col\" class=\"n\">[[at]]</th>\
         <th scope=\"col\" class=\"n\">[[limit]]</th><th scope=\"col\">[[judged]]</th><th scope=\"col\" class=\"n\">[[conforms]]</th>\
         <th scope=\"col\" class=\"n\">[[budget.points]]</th><th scope=\"col\" class=\"n\">[[budget.alignment]]</th><th scope=\"col\" class=\"n\">[[budget.calibration]]</th>\
         <th scope=\"col\" class=\"n\">[[budget.temperature]]</th></tr></thead><tbody>\n",
    )?;
    for characteristic in shown {
        write_characteristic(out, characteristic)?;
    }
    out.write_str("</tbody></table></div></details>\n")
}

fn write_characteristic(out: &mut Paper, found: &Characteristic) -> fmt::Result {
    let name = out.words.said(found.quantity.words());
    write!(
        out,
        "<tr><th scope=\"row\">{}</th>",
        Escaped(name.strip_prefix("the ").unwrap_or(&name))
    )?;
    match found.value {
        Some(value) => {
            let figure = out.figure(found.quantity, value, found.u);
            write!(
                out,
                "<td class=\"n\">{} {}</td>",
                PlusMinus(&figure),
                figure.unit
            )?;
        }
        None => write!(
            out,
            "<td class=\"n soft\">{}</td>",
            Escaped(&out.words.said(&found.reason))
        )?,
    }
    let place = found.s_mm.map_or_else(String::new, |s| out.number(s, 1));
    let probable = found
        .conformance
        .map_or_else(String::new, |p| format!("{} %", out.number(100.0 * p, 1)));
    write!(
        out,
        "<td class=\"n\">{place}</td><td class=\"n\">{}</td><td>{}</td><td class=\"n\">{probable}</td>",
        Escaped(&limits(out, found)),
        out.state(found.verdict)
    )?;
    let parts = found.budget.map_or([None; 4], |b| {
        [b.points, b.alignment, b.calibration, b.temperature]
    });
    for part in parts {
        let text = part.map_or_else(String::new, |u| expanded(out, found.quantity, u));
        write!(out, "<td class=\"n\">{text}</td>")?;
    }
    out.write_str("</tr>\n")
}

/// U = 2 u of one contribution.
fn expanded(out: &Paper, quantity: Quantity, u: f64) -> String {
    if u <= 0.0 {
        return "0".to_owned();
    }
    let figure = out.figure(quantity, COVERAGE_FACTOR * u, Some(u));
    format!("{} {}", figure.expanded.unwrap_or_default(), figure.unit)
}

fn limits(out: &Paper, found: &Characteristic) -> String {
    let limits = [found.lower, found.upper];
    let Some(mut text) = limits_between(found.quantity, limits, out.words) else {
        return String::new();
    };
    if let Some(entity) = found.limits_from.as_deref().filter(|f| f.starts_with('#')) {
        text += &format!(" (PMI {entity})");
    }
    text
}

/// One line a kind of shape: over how much of the edge, and between which sizes.
fn write_breaks(out: &mut Paper, edge: &Edge) -> fmt::Result {
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
                let ends = [out.number(low, 3), out.number(high, 3)];
                out.with("from.to.mm", &[("from", &ends[0]), ("to", &ends[1])])
            } else {
                out.t("unknown")
            }
        };
        let words = match shape {
            Shape::Sharp => {
                let below = of_shape.iter().filter_map(|b| b.radius_below_mm);
                let most = below.fold(0.0, f64::max);
                out.with("sharp", &[("radius", &out.number(most, 3))])
            }
            Shape::Round => {
                let radii = of_shape.iter().filter_map(|b| b.radius_mm?.value);
                out.with("round", &[("range", &range(radii.collect()))])
            }
            Shape::Chamfer => {
                let legs = of_shape.iter().filter_map(|b| b.chamfer_legs_mm);
                let legs = legs.flatten().filter_map(|leg| leg.value);
                out.with("chamfer", &[("range", &range(legs.collect()))])
            }
            Shape::Undecided => {
                let radii = of_shape.iter().filter_map(|b| b.radius_mm?.value);
                let legs = of_shape.iter().filter_map(|b| b.chamfer_legs_mm);
                let legs = legs.flatten().filter_map(|leg| leg.value);
                let (radius, legs) = (range(radii.collect()), range(legs.collect()));
                out.with("undecided", &[("radius", &radius), ("legs", &legs)])
            }
            Shape::Irregular => {
                let burrs = of_shape.iter().filter_map(|b| b.burr_mm.value);
                out.with("irregular", &[("range", &range(burrs.collect()))])
            }
        };
        write!(
            out,
            "<li>{}</li>",
            Escaped(&out.with(
                "break",
                &[("share", &super::percent(share)), ("shape", &words)]
            ))
        )?;
    }
    out.write_str("</ul>\n")
}

/// Corners and gaps; nothing where there are none.
pub fn write_corners_and_gaps(out: &mut Paper, report: &Report) -> fmt::Result {
    if !report.corners.is_empty() {
        write_corners(out, report)?;
    }
    if !report.gaps.is_empty() {
        out.put(
            "<section class=\"card\"><h2>[[gaps]]</h2>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"[[gaps]]\"><table><thead><tr>\
             <th scope=\"col\">[[name]]</th><th scope=\"col\">[[judged]]</th><th scope=\"col\">[[between]]</th><th scope=\"col\" class=\"n\">[[stations]]</th>\
             <th scope=\"col\" class=\"n\">[[gap]]</th><th scope=\"col\" class=\"n\">[[flush]]</th><th scope=\"col\" class=\"n\">[[u.most]]</th></tr></thead><tbody>\n",
        )?;
        for gap in &report.gaps {
            write_gap(out, gap)?;
        }
        out.write_str("</tbody></table></div></section>\n")?;
    }
    Ok(())
}

fn write_gap(out: &mut Paper, gap: &Gap) -> fmt::Result {
    let range = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if low <= high {
            let ends = [out.number(low, 3), out.number(high, 3)];
            out.with("from.to", &[("from", &ends[0]), ("to", &ends[1])])
        } else {
            out.t("not.measured")
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
        "<tr><th scope=\"row\">{}</th><td>{}</td><td>{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td></tr>",
        Escaped(&gap.name),
        out.state(gap.verdict),
        Escaped(&out.with("and", &[("a", &gap.edges[0]), ("b", &gap.edges[1])])),
        stations.len(),
        range(stations.iter().filter_map(|s| s.gap_mm).collect()),
        range(stations.iter().filter_map(|s| s.flush_mm).collect()),
        out.number(COVERAGE_FACTOR * u, 4)
    )
}

fn write_corners(out: &mut Paper, report: &Report) -> fmt::Result {
    out.put(
        "<section class=\"card\"><h2>[[corners]]</h2>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"[[corners]]\"><table><thead><tr>\
         <th scope=\"col\">[[corner]]</th><th scope=\"col\">[[judged]]</th><th scope=\"col\" class=\"n\">[[corner.distance]]</th>\
         <th scope=\"col\">[[corner.place]]</th><th scope=\"col\">[[corner.edges]]</th></tr></thead><tbody>\n",
    )?;
    const LISTED: usize = 200;
    for corner in report.corners.iter().take(LISTED) {
        write!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{}</td>",
            Escaped(&corner.id),
            out.state(corner.verdict)
        )?;
        match corner.total_mm {
            Some(total) => write!(
                out,
                "<td class=\"n\">{}</td>",
                PlusMinus(&out.figure(Quantity::Total, total, corner.u_total_mm))
            )?,
            None => write!(
                out,
                "<td class=\"n soft\">{}</td>",
                Escaped(&out.words.said(&corner.reason))
            )?,
        }
        writeln!(
            out,
            "<td>{}</td><td>{}</td></tr>",
            place(out, corner.nominal, 3),
            Escaped(&corner.edges.join(", "))
        )?;
    }
    out.write_str("</tbody></table></div>")?;
    if report.corners.len() > LISTED {
        let more = (report.corners.len() - LISTED).to_string();
        write!(
            out,
            "<p class=\"small soft\">{}</p>",
            Escaped(&out.with("more", &[("count", &more)]))
        )?;
    }
    out.write_str("</section>\n")
}
