//! The edges as a table for the terminal, at most 110 columns wide, and one line of conclusion.

use std::fmt::Write as _;

use super::figure::Figure;
use super::wire::{Edge, Kind, Quantity, Report, Status};

/// Longest id shown whole.
const ID_WIDTH: usize = 14;

const GREEN: &str = "\x1b[32m";
const RED: &str = "\x1b[1;31m";
const YELLOW: &str = "\x1b[33m";
const DIM: &str = "\x1b[2m";
const PLAIN: &str = "\x1b[0m";

/// Lines up to 110 columns: a head, one row an edge, and the verdict with its reason and what to do.
///
/// Deviations and their U = 2 u in µm, angle deviations in degrees. `colour` adds ANSI colours; the words say the same.
pub fn print_table(report: &Report, colour: bool) -> String {
    let head = [
        "edge",
        "STEP",
        "kind",
        "length mm",
        "measured",
        "d1 worst µm",
        "d2 worst µm",
        "angle dev °",
        "verdict",
    ]
    .map(str::to_owned);
    let rows: Vec<_> = report.edges.iter().map(row).collect();
    let mut widths = head.each_ref().map(|cell| cell.chars().count());
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let mut out = String::new();
    line(&mut out, (&head, &widths), colour.then_some(DIM));
    for (row, edge) in rows.iter().zip(&report.edges) {
        line(&mut out, (row, &widths), colour.then(|| ink(edge.verdict)));
    }
    conclusion(&mut out, report, colour);
    out
}

fn row(edge: &Edge) -> [String; 9] {
    let figure = |quantity| {
        edge.characteristics
            .iter()
            .find(|c| c.quantity == quantity)
            .and_then(|c| Some(Figure::of(quantity, c.value?, c.u).plus_minus()))
            .unwrap_or_else(|| "not measured".to_owned())
    };
    [
        short(&edge.id),
        format!("#{}", edge.nominal_entity),
        match edge.kind {
            Kind::Convex => "convex".to_owned(),
            Kind::Concave => "concave".to_owned(),
        },
        edge.length_mm
            .map_or_else(|| "-".to_owned(), |length| format!("{length:.1}")),
        super::html::percent(edge.coverage),
        figure(Quantity::D1),
        figure(Quantity::D2),
        figure(Quantity::AngleDeviation),
        word(edge.verdict).to_owned(),
    ]
}

/// One line, control characters out, cut with an ellipsis.
fn short(id: &str) -> String {
    let clean = |c: char| if c.is_control() { ' ' } else { c };
    if id.chars().count() <= ID_WIDTH {
        return id.chars().map(clean).collect();
    }
    id.chars()
        .take(ID_WIDTH - 1)
        .map(clean)
        .chain(['…'])
        .collect()
}

/// Numbers to the right, words to the left; only the last cell, the verdict, is coloured, or all of the head.
fn line(out: &mut String, (cells, widths): (&[String; 9], &[usize; 9]), ink: Option<&str>) {
    const RIGHT: [bool; 9] = [false, true, false, true, true, true, true, true, false];
    let whole = ink == Some(DIM);
    if whole {
        out.push_str(DIM);
    }
    for (index, (cell, width)) in cells.iter().zip(widths).enumerate() {
        let gap = " ".repeat(width - cell.chars().count());
        match (index, ink) {
            (8, Some(ink)) if !whole => {
                let _ = write!(out, "{ink}{cell}{PLAIN}");
            }
            (8, _) => out.push_str(cell),
            _ if RIGHT[index] => {
                let _ = write!(out, "{gap}{cell}  ");
            }
            _ => {
                let _ = write!(out, "{cell}{gap}  ");
            }
        }
    }
    if whole {
        out.push_str(PLAIN);
    }
    out.push('\n');
}

fn conclusion(out: &mut String, report: &Report, colour: bool) {
    let (ink, plain) = if colour {
        (ink(report.verdict), PLAIN)
    } else {
        ("", "")
    };
    let clean = |text: &str| text.replace(|c: char| c.is_control(), " ");
    let _ = write!(
        out,
        "\n{ink}{}{plain}: {}; {}\n",
        word(report.verdict),
        clean(&report.reason),
        clean(&report.advice)
    );
}

fn word(status: Status) -> &'static str {
    match status {
        Status::Ok => "OK",
        Status::NotOk => "NOT OK",
        Status::NotDecidable => "NOT DECIDABLE",
        Status::Undefined => "not judged",
    }
}

fn ink(status: Status) -> &'static str {
    match status {
        Status::Ok => GREEN,
        Status::NotOk => RED,
        Status::NotDecidable => YELLOW,
        Status::Undefined => DIM,
    }
}
