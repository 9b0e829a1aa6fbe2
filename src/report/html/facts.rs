//! The lower part of the page: limits, alignment, scan, losses, findings.

use std::fmt::{self, Write};

use super::page::{Escaped, State};
use super::percent;
use crate::report::figure::{COVERAGE_FACTOR, Figure};
use crate::report::wire::{
    Alignment, AlignmentMethod, Datum, DatumKind, Losses, Quantity, Recipe, Report, Rule,
    Uncertainty, UncertaintyMethod,
};

/// Items of a list that a page shows; more are read by nobody.
const LISTED: usize = 40;

/// Says how many items of a list are not shown.
fn write_more(out: &mut String, items: usize) -> fmt::Result {
    match items.saturating_sub(LISTED) {
        0 => Ok(()),
        more => write!(out, "<li>and {more} more, in the JSON form</li>"),
    }
}

/// Writes everything that stands below the edges.
pub fn write(out: &mut String, report: &Report) -> fmt::Result {
    write_unmatched(out, report)?;
    out.write_str(
        "<section class=\"card\"><h2>How it was measured</h2>\n<div class=\"columns\"><div>\n",
    )?;
    write_recipe(out, &report.recipe)?;
    write_uncertainty(out, &report.uncertainty)?;
    write_alignment(out, &report.alignment)?;
    out.write_str("</div><div>\n")?;
    write_scan(out, report)?;
    write_times(out, report)?;
    out.write_str("</div></div>\n")?;
    write_devices(out, report)?;
    write_list(
        out,
        "Findings about the data",
        &report.findings,
        "Nothing was found wrong with the data.",
    )?;
    out.write_str("</section>\n")
}

/// Missing and unexpected edges; nothing where there are none.
fn write_unmatched(out: &mut String, report: &Report) -> fmt::Result {
    if report.missing_edges.is_empty() && report.unexpected_edges.is_empty() {
        return Ok(());
    }
    out.write_str("<section class=\"card\"><h2>Edges without a partner</h2>\n<ul>")?;
    for id in &report.missing_edges {
        write!(
            out,
            "<li>{} is missing: the data are good there, and no edge was found</li>",
            Escaped(id)
        )?;
    }
    for line in report.unexpected_edges.iter().take(LISTED) {
        if let (Some(a), Some(b)) = (line.first(), line.last()) {
            write!(
                out,
                "<li>an edge that the nominal does not have, from ({:.1}, {:.1}, {:.1}) to ({:.1}, {:.1}, {:.1}) mm: a scratch, a burr, or a wrong nominal</li>",
                a[0], a[1], a[2], b[0], b[1], b[2]
            )?;
        }
    }
    write_more(out, report.unexpected_edges.len())?;
    out.write_str("</ul></section>\n")
}

fn row(out: &mut String, name: &str, value: &str) -> fmt::Result {
    writeln!(
        out,
        "<tr><th scope=\"row\">{}</th><td>{}</td></tr>",
        Escaped(name),
        Escaped(value)
    )
}

fn um(value_mm: Option<f64>) -> String {
    value_mm.map_or_else(
        || "not known".to_owned(),
        |value| format!("{:.1} µm", value * 1e3),
    )
}

fn mm(value_mm: Option<f64>) -> String {
    value_mm.map_or_else(|| "not known".to_owned(), |value| format!("{value:.3} mm"))
}

fn write_recipe(out: &mut String, recipe: &Recipe) -> fmt::Result {
    out.write_str("<h4>Limits</h4><table class=\"facts\">")?;
    let limits = [
        ("d1", Quantity::D1, recipe.limits.d1_mm),
        ("d2", Quantity::D2, recipe.limits.d2_mm),
        (
            "angle deviation",
            Quantity::AngleDeviation,
            recipe.limits.angle_deviation_deg,
        ),
    ];
    for (name, quantity, limits) in limits {
        let text = limits.map_or_else(
            || "none".to_owned(),
            |[lower, upper]| {
                format!(
                    "{} to {}",
                    Figure::of(quantity, lower, None).value,
                    Figure::of(quantity, upper, None).with_unit()
                )
            },
        );
        row(out, name, &text)?;
    }
    if recipe.limits_from_pmi {
        row(
            out,
            "of the nominal",
            "tolerances of its PMI, named beside the values",
        )?;
    }
    let rule = match (recipe.rule, recipe.guard_band_k) {
        (Rule::Simple, _) => "the value alone decides".to_owned(),
        (Rule::GuardBand, k) => format!(
            "a value within {} standard uncertainties of a limit is not decidable",
            k.unwrap_or(COVERAGE_FACTOR)
        ),
        (Rule::Conformance, _) => format!(
            "conformity or non-conformity must be probable to {} %",
            100.0 * recipe.conformance_probability.unwrap_or(0.95)
        ),
    };
    row(out, "rule", &rule)?;
    if let Some(share) = recipe.minimum_coverage {
        let text = format!("{} of an edge, or it is not decidable", percent(share));
        row(out, "must be measured", &text)?;
    }
    row(
        out,
        "u of d from the calibration",
        &um(recipe.u_calibration_mm),
    )?;
    if !recipe.sha256.is_empty() {
        row(out, "SHA-256 of the recipe", &recipe.sha256)?;
    }
    out.write_str("</table>\n")
}

fn write_uncertainty(out: &mut String, used: &Uncertainty) -> fmt::Result {
    out.write_str("<h4>Uncertainty</h4><table class=\"facts\">")?;
    match (used.method, used.trials) {
        (UncertaintyMethod::MonteCarlo, Some([least, most])) => {
            row(out, "propagated by", "trials (Monte Carlo, JCGM 101)")?;
            let (least, most) = (grouped(least as u64), grouped(most as u64));
            let each = if least == most {
                most
            } else {
                format!("{least} to {most}")
            };
            row(out, "trials of a station", &each)?;
            if let Some(trials) = used.break_trials {
                row(out, "trials of an edge break", &grouped(trials as u64))?;
            }
            if let Some(trials) = used.derived_trials {
                row(
                    out,
                    "trials of form, corners, gaps",
                    &grouped(trials as u64),
                )?;
            }
            if let Some(seed) = used.seed {
                row(out, "seed", &seed.to_string())?;
            }
            if let Some(unstable) = used.unstable_stations.filter(|n| *n > 0) {
                row(
                    out,
                    "stations that did not stand still",
                    &unstable.to_string(),
                )?;
            }
        }
        _ => row(out, "propagated by", "first derivatives (JCGM 100)")?,
    }
    out.write_str("</table>\n")
}

/// `datums A, B, C`, or the faces of the best fit.
fn found_by(alignment: &Alignment) -> String {
    match alignment.method {
        AlignmentMethod::AsGiven => "nothing: the scan is taken as it lies".to_owned(),
        AlignmentMethod::Datums => {
            let names: Vec<&str> = alignment.datums.iter().map(|d| d.name.as_str()).collect();
            let mut text = format!("datums {}", names.join(", "));
            if !alignment.free_of_datums.is_empty() {
                text += "; best fit in what they leave free: ";
                text += &alignment.free_of_datums.join(", ");
            }
            text
        }
        AlignmentMethod::BestFit if alignment.faces.is_empty() => {
            "best fit of all faces".to_owned()
        }
        AlignmentMethod::BestFit => {
            let faces: Vec<String> = alignment.faces.iter().map(|f| format!("#{f}")).collect();
            format!("best fit of the faces {}", faces.join(", "))
        }
    }
}

/// One row a datum feature; nothing where there are none.
fn write_datums(out: &mut String, datums: &[Datum]) -> fmt::Result {
    if datums.is_empty() {
        return Ok(());
    }
    out.write_str(
        "<table class=\"facts\"><thead><tr><th>datum</th><th>holds</th><th>priority</th><th>off by</th><th>U of its place</th><th>form and noise</th></tr></thead><tbody>",
    )?;
    for datum in datums {
        let holds = match datum.kind {
            DatumKind::Point => "a point",
            DatumKind::Plane => "a plane",
            DatumKind::Axis => "an axis",
            DatumKind::Centre => "a centre",
        };
        let turned = datum
            .residual_deg
            .map_or_else(String::new, |angle| format!(", {angle:.4} °"));
        writeln!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{holds}</td><td>{}</td><td>{}{turned}</td><td>{}</td><td>{}</td></tr>",
            Escaped(&datum.name),
            datum.priority,
            um(datum.residual_mm),
            um(datum.u_mm.map(|u| COVERAGE_FACTOR * u)),
            um(datum.form_mm),
        )?;
    }
    out.write_str("</tbody></table>\n")
}

fn write_alignment(out: &mut String, alignment: &Alignment) -> fmt::Result {
    writeln!(
        out,
        "<h4>Alignment to the nominal {}</h4><table class=\"facts\">",
        State(alignment.status)
    )?;
    row(out, "found by", &found_by(alignment))?;
    row(out, "residuals, root mean square", &um(alignment.rms_mm))?;
    row(out, "points used", &grouped(alignment.points as u64))?;
    let weak = if alignment.weak_directions.is_empty() {
        "none".to_owned()
    } else {
        alignment.weak_directions.join(", ")
    };
    row(out, "directions held weakly", &weak)?;
    if let Some(covariance) = alignment.covariance {
        let expanded = |i: usize| COVERAGE_FACTOR * covariance[i][i].max(0.0).sqrt();
        let translation = [3, 4, 5]
            .map(|i| format!("{:.2}", expanded(i) * 1e3))
            .join(", ");
        let rotation = [0, 1, 2]
            .map(|i| format!("{:.4}", expanded(i).to_degrees()))
            .join(", ");
        row(
            out,
            "U of the position x, y, z",
            &format!("{translation} µm"),
        )?;
        row(
            out,
            "U of the rotation about x, y, z",
            &format!("{rotation} °"),
        )?;
    }
    out.write_str("</table>\n")?;
    write_datums(out, &alignment.datums)?;
    let Some(matrix) = alignment.part_from_machine else {
        return out.write_str("<p>No pose was found.</p>\n");
    };
    out.write_str(
        "<details><summary>Pose: part from machine, mm</summary><table class=\"matrix\">",
    )?;
    for line in matrix {
        out.write_str("<tr>")?;
        for entry in line {
            write!(out, "<td>{entry:.6}</td>")?;
        }
        out.write_str("</tr>")?;
    }
    out.write_str("</table></details>\n")
}

fn write_scan(out: &mut String, report: &Report) -> fmt::Result {
    let scan = &report.scan;
    out.write_str("<h4>Scan</h4><table class=\"facts\">")?;
    row(out, "points", &grouped(scan.points as u64))?;
    row(
        out,
        "distance to the nearest point, median",
        &mm(scan.spacing_mm),
    )?;
    if scan.spacing_along_line_mm.is_some() || scan.spacing_across_lines_mm.is_some() {
        row(out, "spacing along a line", &mm(scan.spacing_along_line_mm))?;
        row(
            out,
            "spacing of the lines",
            &mm(scan.spacing_across_lines_mm),
        )?;
    }
    row(out, "noise, standard deviation", &um(scan.noise_mm))?;
    if report.simulated {
        let seed = report
            .seed
            .map_or_else(|| "not known".to_owned(), |seed| seed.to_string());
        row(out, "instruments", &format!("simulated, seed {seed}"))?;
    }
    out.write_str("</table>\n")
}

fn write_times(out: &mut String, report: &Report) -> fmt::Result {
    if report.seconds.is_empty() {
        return Ok(());
    }
    out.write_str("<h4>Time</h4><table class=\"facts\">")?;
    for (stage, seconds) in &report.seconds {
        row(out, stage, &format!("{seconds:.2} s"))?;
    }
    out.write_str("</table>\n")
}

fn write_devices(out: &mut String, report: &Report) -> fmt::Result {
    if report.devices.is_empty() {
        return Ok(());
    }
    out.write_str(
        "<h4>Instruments and what was lost on the way</h4><div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"Instruments\">\
         <table><thead><tr><th scope=\"col\">name</th><th scope=\"col\">model</th><th scope=\"col\">serial</th><th scope=\"col\">firmware</th>\
         <th scope=\"col\" class=\"n\">profiles received</th><th scope=\"col\" class=\"n\">lost on the link</th><th scope=\"col\" class=\"n\">dropped by the device</th>\
         <th scope=\"col\" class=\"n\">rejected</th><th scope=\"col\" class=\"n\">bytes skipped</th></tr></thead><tbody>\n",
    )?;
    for device in &report.devices {
        let serial = if device.serial.is_empty() {
            "–"
        } else {
            &device.serial
        };
        write!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{} {}</td><td>{}</td><td>{}</td>",
            Escaped(&device.name),
            Escaped(&device.vendor),
            Escaped(&device.model),
            Escaped(serial),
            Escaped(&device.firmware)
        )?;
        match device.losses {
            Some(losses) => write_losses(out, &losses)?,
            None => out.write_str(
                "<td class=\"soft\" colspan=\"5\">touches one at a time, cannot lose</td>",
            )?,
        }
        out.write_str("</tr>\n")?;
    }
    out.write_str("</tbody></table></div>\n")
}

fn write_losses(out: &mut String, losses: &Losses) -> fmt::Result {
    write!(out, "<td class=\"n\">{}</td>", grouped(losses.received))?;
    for count in [
        losses.lost_on_link,
        losses.dropped_by_device,
        losses.rejected,
        losses.skipped_bytes,
    ] {
        let bad = if count > 0 { " bad" } else { "" };
        write!(out, "<td class=\"n{bad}\">{}</td>", grouped(count))?;
    }
    Ok(())
}

fn write_list(out: &mut String, title: &str, items: &[String], none: &str) -> fmt::Result {
    write!(out, "<h4>{}</h4>", Escaped(title))?;
    if items.is_empty() {
        return writeln!(out, "<p>{}</p>", Escaped(none));
    }
    out.write_str("<ul>")?;
    for item in items.iter().take(LISTED) {
        write!(out, "<li>{}</li>", Escaped(item))?;
    }
    write_more(out, items.len())?;
    out.write_str("</ul>\n")
}

/// `412 480`, with narrow no-break spaces.
fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() * 2);
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}
