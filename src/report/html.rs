//! The report as one HTML file that needs nothing else: no network, no other file; it opens by a double click.
//!
//! For the operator first: the verdict with its reason, then the edges, then where they lie, then each edge in full, then
//! what the metrologist asks for. Without scripts everything is there save the turning of the part.

mod drawing;
mod facts;
mod page;
mod plot;
mod values;

use std::fmt::{self, Write};

use base64::Engine as _;
use sha2::{Digest, Sha256};

use super::conclusion::used_share;
use super::wire::{Characteristic, Edge, Kind, Quantity, Report, Status};
use crate::words::Language;
use drawing::Drawing;
use page::{Escaped, Paper, PlusMinus, SYMBOLS, class, word};

const STYLE: &str = include_str!("html/style.css");
const SCRIPT: &str = include_str!("html/viewer.js");

/// Stations drawn on one page. More make it larger than 1.5 MB; the JSON and the CSV hold all of them.
const STATIONS_DRAWN: usize = 6000;

impl Report {
    /// The report as a self-contained page.
    pub fn to_html(&self, words: Language) -> String {
        self.to_html_with_links(words, &[])
    }

    /// The page with links to the other forms, where a server has them: (address, name).
    pub fn to_html_with_links(&self, words: Language, links: &[(&str, &str)]) -> String {
        let mut out = Paper {
            text: String::with_capacity(1 << 18),
            words,
        };
        write_page(&mut out, self, links).expect("writing to a String cannot fail");
        out.text
    }
}

/// What the page may load: its own style and script, known by their hashes, and nothing else.
pub fn content_security_policy() -> String {
    format!(
        "default-src 'none'; style-src '{}'; script-src '{}'; base-uri 'none'; form-action 'none'",
        hash(STYLE),
        hash(SCRIPT)
    )
}

fn hash(text: &str) -> String {
    let digest = base64::engine::general_purpose::STANDARD.encode(Sha256::digest(text));
    format!("sha256-{digest}")
}

fn write_page(out: &mut Paper, report: &Report, links: &[(&str, &str)]) -> fmt::Result {
    let shown: Vec<_> = report
        .edges
        .iter()
        .map(|edge| stations_shown(edge, report.edges.len()))
        .collect();
    write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"{}\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{}\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"generator\" content=\"{} {}\">\n<title>{}: {}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{SYMBOLS}",
        out.words.code(),
        content_security_policy(),
        Escaped(&report.software.name),
        Escaped(&report.software.version),
        word(out.words, report.verdict),
        Escaped(&report.part)
    )?;
    write_header(out, report, links)?;
    out.write_str("<main>\n")?;
    write_table(out, report)?;
    let drawing = Drawing::new(report, &shown);
    if !drawing.is_empty() {
        write_view(out, &drawing)?;
    }
    write_edges(out, report, &shown)?;
    values::write_corners_and_gaps(out, report)?;
    facts::write(out, report)?;
    out.write_str("</main>\n")?;
    write_footer(out, report)?;
    if !drawing.is_empty() {
        // Inside a script element only `<` could end it early.
        let data = drawing.data(out).to_string().replace('<', "\\u003c");
        writeln!(
            out,
            r#"<script type="application/json" id="view-data">{data}</script>"#
        )?;
        writeln!(out, "<script>{SCRIPT}</script>")?;
    }
    out.write_str("</body>\n</html>\n")
}

/// The stations of `edge` that are drawn: all, or evenly thinned with the worst ones and the ends of holes kept.
fn stations_shown(edge: &Edge, edges: usize) -> Vec<usize> {
    let budget = (STATIONS_DRAWN / edges.max(1)).max(12);
    let all = edge.stations.len();
    if all <= budget {
        return (0..all).collect();
    }
    let measured = |index: usize| edge.stations[index].measured.is_some();
    let ends_of_holes: Vec<usize> = (1..all)
        .filter(|&index| measured(index) != measured(index - 1))
        .flat_map(|index| [index - 1, index])
        .take(budget)
        .collect();
    let worst = |s_mm: f64| edge.characteristics.iter().any(|c| c.s_mm == Some(s_mm));
    let mut shown: Vec<usize> = (0..all)
        .filter(|&index| {
            index % all.div_ceil(budget) == 0
                || index + 1 == all
                || worst(edge.stations[index].s_mm)
        })
        .chain(ends_of_holes)
        .collect();
    shown.sort_unstable();
    shown.dedup();
    shown
}

fn write_header(out: &mut Paper, report: &Report, links: &[(&str, &str)]) -> fmt::Result {
    let created = report.created.replace('T', " ").replace('Z', " UTC");
    write!(
        out,
        "<header>\n<a class=\"skip\" href=\"#edges\">{}</a>\n<h1>{}</h1>\n<p class=\"soft\">{}",
        Escaped(&out.t("skip")),
        Escaped(&report.part),
        Escaped(&out.with(
            "against",
            &[("created", &created), ("nominal", &report.nominal)]
        ))
    )?;
    if report.simulated {
        out.put(" <span class=\"tag\">[[simulated]]</span>")?;
    }
    out.write_str("</p>\n")?;
    if !links.is_empty() {
        out.put("<nav class=\"small\" aria-label=\"[[forms]]\">")?;
        for (address, name) in links {
            write!(
                out,
                "<a href=\"{}\">{}</a> ",
                Escaped(address),
                Escaped(name)
            )?;
        }
        out.write_str("</nav>\n")?;
    }
    let class = class(report.verdict);
    let words = out.words;
    let (reason, advice) = match &report.because {
        Some(because) => (because.reason(words), because.advice(words)),
        None => (words.said(&report.reason), words.said(&report.advice)),
    };
    writeln!(
        out,
        "<section class=\"verdict bg-{class}\" aria-label=\"{}\"><svg aria-hidden=\"true\" viewBox=\"0 0 24 24\"><use href=\"#i-{class}\"/></svg>\
         <div><strong>{}</strong><p>{}</p><p class=\"advice\">{}</p></div></section>\n</header>",
        Escaped(&out.t("verdict")),
        word(out.words, report.verdict),
        Escaped(&sentence(&reason)),
        Escaped(&sentence(&advice))
    )
}

/// With a capital (save for the id of an edge) and a dot.
fn sentence(text: &str) -> String {
    let word = text.split([' ', ':']).next().unwrap_or("");
    let is_name = word.chars().any(|c| !c.is_alphabetic()) || text[word.len()..].starts_with(':');
    let mut chars = text.chars();
    match chars.next() {
        Some(first) if !is_name => format!("{}{}.", first.to_uppercase(), chars.as_str()),
        Some(_) => format!("{text}."),
        None => String::new(),
    }
}

fn write_table(out: &mut Paper, report: &Report) -> fmt::Result {
    out.put(
        "<section class=\"card\" id=\"edges\"><h2>[[edges]]</h2>\n<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"[[edges.table]]\">\
         <table class=\"edges\"><thead><tr><th scope=\"col\">[[edge]]</th><th scope=\"col\">[[verdict]]</th>\
         <th scope=\"col\" class=\"n\">[[d1.worst]]<br>[[pm.um]]</th><th scope=\"col\" class=\"n\">[[d2.worst]]<br>[[pm.um]]</th>\
         <th scope=\"col\" class=\"n\">[[angle.deviation]]<br>[[worst.pm.deg]]</th><th scope=\"col\">[[measured]]</th>\
         <th scope=\"col\" class=\"n\">[[length]]<br>mm</th><th scope=\"col\">[[kind]]</th><th scope=\"col\" class=\"n\">STEP</th></tr></thead>\n<tbody>\n",
    )?;
    for index in worst_first(report) {
        write_row(out, index, &report.edges[index])?;
    }
    out.write_str("</tbody></table></div>\n")?;
    out.put("<p class=\"small soft\">[[edges.note]]</p></section>\n")
}

/// The edges by verdict, then by how much of their limits they use.
fn worst_first(report: &Report) -> Vec<usize> {
    let mut order: Vec<usize> = (0..report.edges.len()).collect();
    let used = |index: &usize| {
        let characteristics = report.edges[*index].characteristics.iter();
        characteristics.map(used_share).fold(0.0, f64::max)
    };
    order.sort_by(|a, b| {
        let verdict = |index: &usize| report.edges[*index].verdict;
        verdict(b)
            .cmp(&verdict(a))
            .then(used(b).total_cmp(&used(a)))
    });
    order
}

fn write_row(out: &mut Paper, index: usize, edge: &Edge) -> fmt::Result {
    write!(
        out,
        "<tr><th scope=\"row\"><a href=\"#edge-{index}\">{}</a></th><td>{}</td>",
        Escaped(&edge.id),
        out.state(edge.verdict)
    )?;
    for quantity in [Quantity::D1, Quantity::D2, Quantity::AngleDeviation] {
        let found = edge.characteristics.iter().find(|c| c.quantity == quantity);
        match found {
            Some(characteristic) => write_figure_cell(out, characteristic)?,
            None => out.put("<td class=\"n soft\">[[not.measured]]</td>")?,
        }
    }
    let share = edge.coverage.clamp(0.0, 1.0);
    writeln!(
        out,
        "<td>{}<svg class=\"bar\" viewBox=\"0 0 100 10\" preserveAspectRatio=\"none\" aria-hidden=\"true\"><rect class=\"all\" width=\"100\" height=\"10\"/>\
         <rect class=\"got\" width=\"{:.1}\" height=\"10\"/></svg></td><td class=\"n\">{}</td><td>{}</td><td class=\"n\">#{}</td></tr>",
        percent(share),
        100.0 * share,
        length(out, edge),
        kind(out, edge),
        edge.nominal_entity
    )
}

fn write_figure_cell(out: &mut Paper, characteristic: &Characteristic) -> fmt::Result {
    match characteristic.value {
        Some(value) => {
            let figure = out.figure(characteristic.quantity, value, characteristic.u);
            let bad = if characteristic.verdict == Status::NotOk {
                " bad"
            } else {
                ""
            };
            write!(out, "<td class=\"n{bad}\">{}</td>", PlusMinus(&figure))
        }
        None => out.put("<td class=\"n soft\">[[not.measured]]</td>"),
    }
}

/// Whole percent; what is not all never reads as 100, what is not nothing never as 0.
pub(super) fn percent(share: f64) -> String {
    match 100.0 * share {
        p if p >= 100.0 => "100 %".to_owned(),
        p if p > 0.0 => format!("{:.0} %", p.clamp(1.0, 99.0)),
        _ => "0 %".to_owned(),
    }
}

fn kind(out: &Paper, edge: &Edge) -> String {
    out.t(match edge.kind {
        Kind::Convex => "convex",
        Kind::Concave => "concave",
    })
}

fn length(out: &Paper, edge: &Edge) -> String {
    edge.length_mm
        .map_or_else(|| "–".to_owned(), |length| out.number(length, 1))
}

fn write_view(out: &mut Paper, drawing: &Drawing<'_>) -> fmt::Result {
    out.put("<section class=\"card\"><h2>[[where]]</h2>\n<div class=\"view\" id=\"view\">\n")?;
    drawing.write_svg(out)?;
    let factor = out.words.number(&drawing.factor.to_string());
    writeln!(
        out,
        "</div>\n<p class=\"small soft\" id=\"view-factor\">{}</p>",
        Escaped(&out.with("hairs", &[("factor", &factor)]))
    )?;
    out.put(
        "<div class=\"tools live\" id=\"view-tools\" hidden>\
         <button type=\"button\" data-view=\"home\">[[view.home]]</button><button type=\"button\" data-view=\"front\">[[view.front]]</button>\
         <button type=\"button\" data-view=\"side\">[[view.side]]</button><button type=\"button\" data-view=\"top\">[[view.top]]</button>\
         <button type=\"button\" data-zoom=\"1.25\" aria-label=\"[[view.in]]\">+</button><button type=\"button\" data-zoom=\"0.8\" aria-label=\"[[view.out]]\">−</button>\
         <label>[[view.deviations]] <input type=\"range\" id=\"view-scale\" min=\"0\" step=\"1\"> <output id=\"view-scale-shown\"></output></label></div>\n\
         <p class=\"readout live\" id=\"view-readout\" role=\"status\"></p>\n",
    )?;
    out.write_str("<ul class=\"legend drawing-legend\">")?;
    for (state, name) in [
        ("run s-ok", "legend.ok"),
        ("run s-not_ok", "legend.not_ok"),
        ("run s-not_decidable", "legend.not_decidable"),
        ("run s-undefined", "legend.undefined"),
        ("run s-gap", "legend.gap"),
        ("hair", "legend.hair"),
        ("extra", "legend.extra"),
    ] {
        write!(
            out,
            "<li><svg class=\"drawing\" viewBox=\"0 0 44 12\" aria-hidden=\"true\"><path class=\"{state}\" d=\"M3 6H41\"/></svg>{}</li>",
            Escaped(&out.t(name))
        )?;
    }
    out.write_str("</ul></section>\n")
}

/// `, 40 % boundary (one flank seen)`; nothing where both were seen.
fn boundary(out: &Paper, edge: &Edge) -> String {
    match edge.boundary_share {
        Some(share) if share > 0.0 => out.with("boundary", &[("share", &percent(share))]),
        _ => String::new(),
    }
}

fn write_edges(out: &mut Paper, report: &Report, shown: &[Vec<usize>]) -> fmt::Result {
    out.put(
        "<section class=\"card\"><h2>[[each]]</h2>\n<p class=\"small soft\">[[each.note]]</p>\n",
    )?;
    for (index, (edge, shown)) in report.edges.iter().zip(shown).enumerate() {
        writeln!(
            out,
            "<section class=\"edge\" id=\"edge-{index}\"><h3>{} {} <span class=\"soft small\">{}</span></h3>",
            Escaped(&edge.id),
            out.state(edge.verdict),
            Escaped(&out.with(
                "edge.head",
                &[
                    ("kind", &kind(out, edge)),
                    ("length", &length(out, edge)),
                    ("share", &percent(edge.coverage)),
                    ("boundary", &boundary(out, edge)),
                    ("entity", &edge.nominal_entity.to_string()),
                ],
            ))
        )?;
        write_reasons(out, edge)?;
        out.write_str("<div class=\"plots\">")?;
        plot::write(out, edge, Quantity::D1, shown)?;
        plot::write(out, edge, Quantity::D2, shown)?;
        if angle_matters(edge) {
            plot::write(out, edge, Quantity::AngleDeviation, shown)?;
        }
        out.write_str("</div>")?;
        values::write_edge(out, edge)?;
        if shown.len() < edge.stations.len() {
            let (drawn, all) = (shown.len().to_string(), edge.stations.len().to_string());
            write!(
                out,
                "<p class=\"small soft\">{}</p>",
                Escaped(&out.with("drawn", &[("shown", &drawn), ("all", &all)]))
            )?;
        }
        out.write_str("</section>\n")?;
    }
    out.write_str("</section>\n")
}

/// The angle is plotted where it keeps the edge from being OK.
fn angle_matters(edge: &Edge) -> bool {
    edge.characteristics
        .iter()
        .any(|c| c.quantity == Quantity::AngleDeviation && c.verdict > Status::Ok)
}

/// Where along the edge something was not measured or not decidable, and why.
fn write_reasons(out: &mut Paper, edge: &Edge) -> fmt::Result {
    const SHOWN: usize = 6;
    let mut runs: Vec<(f64, f64, &str)> = Vec::new();
    let mut open = false;
    for station in &edge.stations {
        let reason = station.reason.as_str();
        match runs.last_mut() {
            Some(run) if open && run.2 == reason => run.1 = station.s_mm,
            _ if !reason.is_empty() => runs.push((station.s_mm, station.s_mm, reason)),
            _ => {}
        }
        open = !reason.is_empty();
    }
    if runs.is_empty() {
        return Ok(());
    }
    out.write_str("<ul class=\"small\">")?;
    for (from, to, reason) in runs.iter().take(SHOWN) {
        let ends = [out.number(*from, 1), out.number(*to, 1)];
        let place = if from == to {
            format!("{} mm", ends[0])
        } else {
            out.with("from.to.mm", &[("from", &ends[0]), ("to", &ends[1])])
        };
        write!(
            out,
            "<li>{place}: {}</li>",
            Escaped(&out.words.said(reason))
        )?;
    }
    if runs.len() > SHOWN {
        let more = (runs.len() - SHOWN).to_string();
        write!(
            out,
            "<li>{}</li>",
            Escaped(&out.with("stretches", &[("count", &more)]))
        )?;
    }
    out.write_str("</ul>\n")
}

fn write_footer(out: &mut Paper, report: &Report) -> fmt::Result {
    writeln!(
        out,
        "<footer class=\"small soft\"><p>{}</p></footer>",
        Escaped(&out.with(
            "footer",
            &[
                ("name", &report.software.name),
                ("version", &report.software.version)
            ],
        ))
    )
}
