//! The lower part of the page: limits, alignment, scan, losses, findings.

use std::fmt::{self, Write};

use super::page::{Escaped, Paper};
use super::percent;
use crate::report::because::{code, limits_between};
use crate::report::figure::COVERAGE_FACTOR;
use crate::report::wire::{
    Alignment, AlignmentMethod, Datum, Losses, Quantity, Recipe, Report, Rule, Uncertainty,
    UncertaintyMethod,
};

/// Items of a list that a page shows; more are read by nobody.
const LISTED: usize = 40;

/// Says how many items of a list are not shown.
fn write_more(out: &mut Paper, items: usize) -> fmt::Result {
    match items.saturating_sub(LISTED) {
        0 => Ok(()),
        more => {
            let more = out.with("more", &[("count", &more.to_string())]);
            write!(out, "<li>{}</li>", Escaped(&more))
        }
    }
}

/// Writes everything that stands below the edges.
pub fn write(out: &mut Paper, report: &Report) -> fmt::Result {
    write_unmatched(out, report)?;
    out.put("<section class=\"card\"><h2>[[how]]</h2>\n<div class=\"columns\"><div>\n")?;
    write_recipe(out, &report.recipe)?;
    write_uncertainty(out, &report.uncertainty)?;
    write_alignment(out, &report.alignment)?;
    out.write_str("</div><div>\n")?;
    write_scan(out, report)?;
    write_times(out, report)?;
    out.write_str("</div></div>\n")?;
    write_devices(out, report)?;
    write_findings(out, &report.findings)?;
    out.write_str("</section>\n")
}

/// Missing and unexpected edges; nothing where there are none.
fn write_unmatched(out: &mut Paper, report: &Report) -> fmt::Result {
    if report.missing_edges.is_empty() && report.unexpected_edges.is_empty() {
        return Ok(());
    }
    out.put("<section class=\"card\"><h2>[[unmatched]]</h2>\n<ul>")?;
    for id in &report.missing_edges {
        write!(
            out,
            "<li>{}</li>",
            Escaped(&out.with("missing", &[("edge", id)]))
        )?;
    }
    for line in report.unexpected_edges.iter().take(LISTED) {
        if let (Some(a), Some(b)) = (line.first(), line.last()) {
            let [from, to] = [place(out, *a, 1), place(out, *b, 1)];
            let found = out.with("unexpected", &[("from", &from), ("to", &to)]);
            write!(out, "<li>{}</li>", Escaped(&found))?;
        }
    }
    write_more(out, report.unexpected_edges.len())?;
    out.write_str("</ul></section>\n")
}

/// Coordinates with commas between them, or semicolons where the comma is the decimal sign.
pub(super) fn place(out: &Paper, xyz: [f64; 3], digits: usize) -> String {
    listed(out, &xyz.map(|value| out.number(value, digits)))
}

fn listed(out: &Paper, numbers: &[String]) -> String {
    let between = if out.words.text("decimal") == "," {
        "; "
    } else {
        ", "
    };
    numbers.join(between)
}

/// A row with the name `report.{key}`.
fn row(out: &mut Paper, key: &str, value: &str) -> fmt::Result {
    let name = out.t(key);
    named_row(out, &name, value)
}

fn named_row(out: &mut Paper, name: &str, value: &str) -> fmt::Result {
    writeln!(
        out,
        "<tr><th scope=\"row\">{}</th><td>{}</td></tr>",
        Escaped(name),
        Escaped(value)
    )
}

fn um(out: &Paper, value_mm: Option<f64>) -> String {
    value_mm.map_or_else(
        || out.t("unknown"),
        |value| format!("{} µm", out.number(value * 1e3, 1)),
    )
}

fn mm(out: &Paper, value_mm: Option<f64>) -> String {
    value_mm.map_or_else(
        || out.t("unknown"),
        |value| format!("{} mm", out.number(value, 3)),
    )
}

fn write_recipe(out: &mut Paper, recipe: &Recipe) -> fmt::Result {
    out.put("<h4>[[limits]]</h4><table class=\"facts\">")?;
    let limits = [
        ("d1", Quantity::D1, recipe.limits.d1_mm),
        ("d2", Quantity::D2, recipe.limits.d2_mm),
        (
            "",
            Quantity::AngleDeviation,
            recipe.limits.angle_deviation_deg,
        ),
    ];
    for (name, quantity, limits) in limits {
        let limits = limits.map_or([None; 2], |limits| limits.map(Some));
        let text = limits_between(quantity, limits, out.words).unwrap_or_else(|| out.t("none"));
        match name {
            "" => row(out, "angle.deviation", &text)?,
            name => named_row(out, name, &text)?,
        }
    }
    if recipe.limits_from_pmi {
        let from = out.t("pmi.value");
        row(out, "pmi", &from)?;
    }
    let rule = match (recipe.rule, recipe.guard_band_k) {
        (Rule::Simple, _) => out.t("rule.simple"),
        (Rule::GuardBand, k) => {
            let k = k.unwrap_or(COVERAGE_FACTOR).to_string();
            out.with("rule.guard_band", &[("k", &out.words.number(&k))])
        }
        (Rule::Conformance, _) => {
            let share = 100.0 * recipe.conformance_probability.unwrap_or(0.95);
            let share = out.words.number(&share.to_string());
            out.with("rule.conformance", &[("share", &share)])
        }
    };
    row(out, "rule", &rule)?;
    if let Some(share) = recipe.minimum_coverage {
        let text = out.with("coverage.value", &[("share", &percent(share))]);
        row(out, "coverage", &text)?;
    }
    let u = um(out, recipe.u_calibration_mm);
    row(out, "u.calibration", &u)?;
    if !recipe.sha256.is_empty() {
        row(out, "sha256", &recipe.sha256)?;
    }
    out.write_str("</table>\n")
}

fn write_uncertainty(out: &mut Paper, used: &Uncertainty) -> fmt::Result {
    out.put("<h4>[[uncertainty]]</h4><table class=\"facts\">")?;
    match (used.method, used.trials) {
        (UncertaintyMethod::MonteCarlo, Some([least, most])) => {
            let by = out.t("propagated.monte_carlo");
            row(out, "propagated", &by)?;
            let (least, most) = (grouped(least as u64), grouped(most as u64));
            let each = if least == most {
                most
            } else {
                out.with("from.to", &[("from", &least), ("to", &most)])
            };
            row(out, "trials", &each)?;
            if let Some(trials) = used.break_trials {
                row(out, "trials.break", &grouped(trials as u64))?;
            }
            if let Some(trials) = used.derived_trials {
                row(out, "trials.derived", &grouped(trials as u64))?;
            }
            if let Some(seed) = used.seed {
                row(out, "seed", &seed.to_string())?;
            }
            if let Some(unstable) = used.unstable_stations.filter(|n| *n > 0) {
                row(out, "unstable", &unstable.to_string())?;
            }
        }
        _ => {
            let by = out.t("propagated.first_order");
            row(out, "propagated", &by)?;
        }
    }
    out.write_str("</table>\n")
}

/// `datums A, B, C`, or the faces of the best fit.
fn found_by(out: &Paper, alignment: &Alignment) -> String {
    match alignment.method {
        AlignmentMethod::AsGiven => out.t("found.as_given"),
        AlignmentMethod::Datums => {
            let names: Vec<&str> = alignment.datums.iter().map(|d| d.name.as_str()).collect();
            let mut text = out.with("found.datums", &[("names", &names.join(", "))]);
            if !alignment.free_of_datums.is_empty() {
                let free = directions(out, &alignment.free_of_datums);
                text += &out.with("found.free", &[("directions", &free)]);
            }
            text
        }
        AlignmentMethod::BestFit if alignment.faces.is_empty() => out.t("found.all"),
        AlignmentMethod::BestFit => {
            let faces: Vec<String> = alignment.faces.iter().map(|f| format!("#{f}")).collect();
            out.with("found.faces", &[("faces", &faces.join(", "))])
        }
    }
}

fn directions(out: &Paper, english: &[String]) -> String {
    let told: Vec<String> = english.iter().map(|one| out.words.said(one)).collect();
    told.join(", ")
}

/// One row a datum feature; nothing where there are none.
fn write_datums(out: &mut Paper, datums: &[Datum]) -> fmt::Result {
    if datums.is_empty() {
        return Ok(());
    }
    out.put(
        "<table class=\"facts\"><thead><tr><th>[[datum]]</th><th>[[datum.holds]]</th><th>[[datum.priority]]</th><th>[[datum.off]]</th><th>[[datum.u]]</th><th>[[datum.form]]</th></tr></thead><tbody>",
    )?;
    for datum in datums {
        let holds = out.t(&format!("holds.{}", code(&datum.kind)));
        let turned = datum
            .residual_deg
            .map_or_else(String::new, |angle| format!(", {} °", out.number(angle, 4)));
        writeln!(
            out,
            "<tr><th scope=\"row\">{}</th><td>{holds}</td><td>{}</td><td>{}{turned}</td><td>{}</td><td>{}</td></tr>",
            Escaped(&datum.name),
            datum.priority,
            um(out, datum.residual_mm),
            um(out, datum.u_mm.map(|u| COVERAGE_FACTOR * u)),
            um(out, datum.form_mm),
        )?;
    }
    out.write_str("</tbody></table>\n")
}

fn write_alignment(out: &mut Paper, alignment: &Alignment) -> fmt::Result {
    writeln!(
        out,
        "<h4>{} {}</h4><table class=\"facts\">",
        Escaped(&out.t("alignment")),
        out.state(alignment.status)
    )?;
    let found = found_by(out, alignment);
    row(out, "found", &found)?;
    let rms = um(out, alignment.rms_mm);
    row(out, "residuals", &rms)?;
    row(out, "points.used", &grouped(alignment.points as u64))?;
    let weak = if alignment.weak_directions.is_empty() {
        out.t("weak.none")
    } else {
        directions(out, &alignment.weak_directions)
    };
    row(out, "weak", &weak)?;
    if let Some(covariance) = alignment.covariance {
        let expanded = |i: usize| COVERAGE_FACTOR * covariance[i][i].max(0.0).sqrt();
        let translation = place(out, [3, 4, 5].map(|i| expanded(i) * 1e3), 2);
        let rotation = place(out, [0, 1, 2].map(|i| expanded(i).to_degrees()), 4);
        row(out, "u.position", &format!("{translation} µm"))?;
        row(out, "u.rotation", &format!("{rotation} °"))?;
    }
    out.write_str("</table>\n")?;
    write_datums(out, &alignment.datums)?;
    let Some(matrix) = alignment.part_from_machine else {
        return out.put("<p>[[no.pose]]</p>\n");
    };
    out.put("<details><summary>[[pose]]</summary><table class=\"matrix\">")?;
    for line in matrix {
        out.write_str("<tr>")?;
        for entry in line {
            let entry = out.number(entry, 6);
            write!(out, "<td>{entry}</td>")?;
        }
        out.write_str("</tr>")?;
    }
    out.write_str("</table></details>\n")
}

fn write_scan(out: &mut Paper, report: &Report) -> fmt::Result {
    let scan = &report.scan;
    out.put("<h4>[[scan]]</h4><table class=\"facts\">")?;
    row(out, "points", &grouped(scan.points as u64))?;
    let spacing = mm(out, scan.spacing_mm);
    row(out, "spacing", &spacing)?;
    if scan.spacing_along_line_mm.is_some() || scan.spacing_across_lines_mm.is_some() {
        let along = mm(out, scan.spacing_along_line_mm);
        row(out, "spacing.along", &along)?;
        let across = mm(out, scan.spacing_across_lines_mm);
        row(out, "spacing.across", &across)?;
    }
    let noise = um(out, scan.noise_mm);
    row(out, "noise", &noise)?;
    if report.simulated {
        let seed = report
            .seed
            .map_or_else(|| out.t("unknown"), |seed| seed.to_string());
        let simulated = out.with("instruments.simulated", &[("seed", &seed)]);
        row(out, "instruments", &simulated)?;
    }
    out.write_str("</table>\n")
}

fn write_times(out: &mut Paper, report: &Report) -> fmt::Result {
    if report.seconds.is_empty() {
        return Ok(());
    }
    out.put("<h4>[[time]]</h4><table class=\"facts\">")?;
    for (stage, seconds) in &report.seconds {
        let (stage, seconds) = (out.words.said(stage), out.number(*seconds, 2));
        named_row(out, &stage, &format!("{seconds} s"))?;
    }
    out.write_str("</table>\n")
}

fn write_devices(out: &mut Paper, report: &Report) -> fmt::Result {
    if report.devices.is_empty() {
        return Ok(());
    }
    out.put(
        "<h4>[[devices]]</h4><div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"[[devices.table]]\">\
         <table><thead><tr><th scope=\"col\">[[name]]</th><th scope=\"col\">[[model]]</th><th scope=\"col\">[[serial]]</th><th scope=\"col\">[[firmware]]</th>\
         <th scope=\"col\" class=\"n\">[[received]]</th><th scope=\"col\" class=\"n\">[[lost]]</th><th scope=\"col\" class=\"n\">[[dropped]]</th>\
         <th scope=\"col\" class=\"n\">[[rejected]]</th><th scope=\"col\" class=\"n\">[[skipped]]</th></tr></thead><tbody>\n",
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
            None => out.put("<td class=\"soft\" colspan=\"5\">[[touches]]</td>")?,
        }
        out.write_str("</tr>\n")?;
    }
    out.write_str("</tbody></table></div>\n")
}

fn write_losses(out: &mut Paper, losses: &Losses) -> fmt::Result {
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

fn write_findings(out: &mut Paper, items: &[String]) -> fmt::Result {
    out.put("<h4>[[findings]]</h4>")?;
    if items.is_empty() {
        return out.put("<p>[[findings.none]]</p>\n");
    }
    out.write_str("<ul>")?;
    for item in items.iter().take(LISTED) {
        write!(out, "<li>{}</li>", Escaped(&out.words.said(item)))?;
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
