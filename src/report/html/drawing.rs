//! The edges of the part as an axonometric SVG, with hair lines for the deviations, and the data of the 3D view.

use std::fmt::{self, Write};

use glam::{DVec2, DVec3};
use serde_json::{Value, json};

use super::page::{Escaped, Paper, class, word};
use super::plot::nice_step;
use crate::report::wire::{Edge, Quantity, Report, Station, Status, Xyz};

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 480.0;
const MARGIN: f64 = 34.0;

/// The eye stands in front of the part (towards -y), turned to its +x side and raised.
const YAW_RAD: f64 = 0.55;
const PITCH_RAD: f64 = 0.5;

/// What the script says.
const TOLD: [&str; 9] = [
    "view.keys",
    "view.point",
    "view.at",
    "view.values",
    "view.ok",
    "view.not_ok",
    "view.not_decidable",
    "view.undefined",
    "view.gap",
];

/// Longest hair as a share of the size of the part: longer ones hide the edges, shorter ones are not seen.
const HAIR_SHARE: f64 = 0.06;

/// The drawing of one report, ready to be written in either form.
pub struct Drawing<'a> {
    lines: Vec<Line<'a>>,
    centre: DVec3,
    radius_mm: f64,
    /// Edges that the nominal does not have, thinned.
    extra: Vec<Vec<DVec3>>,
    /// How much larger the deviations are drawn than the part.
    pub factor: f64,
}

/// One edge: its polyline, and the runs of equal state along it.
struct Line<'a> {
    edge: &'a Edge,
    stations: Vec<&'a Station>,
    /// Stations, and the ends of the edge before and after them where these are near.
    points: Vec<DVec3>,
    /// Index in `points` of the first station.
    first: usize,
    /// State, first and last index in `points`.
    runs: Vec<(&'static str, usize, usize)>,
}

impl<'a> Drawing<'a> {
    /// Lays out the edges; `shown` holds the stations to draw of each.
    pub fn new(report: &'a Report, shown: &[Vec<usize>]) -> Self {
        let lines: Vec<_> = report
            .edges
            .iter()
            .zip(shown)
            .filter(|(_, shown)| !shown.is_empty())
            .map(|(edge, shown)| line(edge, shown))
            .collect();
        let points = || lines.iter().flat_map(|line| line.points.iter().copied());
        let low = points().fold(DVec3::INFINITY, DVec3::min);
        let high = points().fold(DVec3::NEG_INFINITY, DVec3::max);
        let (centre, radius_mm) = if low.x <= high.x {
            ((low + high) / 2.0, ((high - low).length() / 2.0).max(1e-6))
        } else {
            (DVec3::ZERO, 1.0)
        };
        let largest = lines
            .iter()
            .flat_map(|line| &line.stations)
            .filter_map(|station| offset(station))
            .map(DVec3::length)
            .fold(0.0, f64::max);
        Drawing {
            extra: thinned(&report.unexpected_edges),
            factor: factor(2.0 * radius_mm, largest),
            lines,
            centre,
            radius_mm,
        }
    }

    /// True where there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// Writes the SVG.
    pub fn write_svg(&self, out: &mut Paper) -> fmt::Result {
        writeln!(
            out,
            r#"<svg class="drawing" id="drawing" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{}">"#,
            Escaped(&self.spoken(out))
        )?;
        let at = self.paper();
        let mut order: Vec<_> = self.lines.iter().collect();
        order.sort_by(|a, b| depth(b).total_cmp(&depth(a)));
        for line in &order {
            write_hairs(out, line, self.factor, &at)?;
            for &(state, from, to) in &line.runs {
                write!(out, r#"<path class="run s-{state}" d=""#)?;
                write_path(out, line.points[from..=to].iter().map(|p| at(*p)))?;
                out.write_str("\"/>\n")?;
            }
        }
        for extra in &self.extra {
            out.write_str(r#"<path class="extra" d=""#)?;
            write_path(out, extra.iter().map(|p| at(*p)))?;
            out.write_str("\"/>\n")?;
        }
        for line in &order {
            let p = at(line.points[line.points.len() / 2]);
            writeln!(
                out,
                r#"<text class="f-{}" text-anchor="middle" x="{:.1}" y="{:.1}">{}{}</text>"#,
                class(line.edge.verdict),
                p.x,
                p.y - 7.0,
                Escaped(&line.edge.id),
                sign(line.edge.verdict)
            )?;
        }
        write_axes(out)?;
        out.write_str("</svg>\n")
    }

    /// From mm in the part frame to the paper.
    fn paper(&self) -> impl Fn(DVec3) -> DVec2 {
        let flat = |p: DVec3| project(p - self.centre);
        let points = || {
            self.lines
                .iter()
                .flat_map(|line| &line.points)
                .map(|p| flat(*p))
        };
        let low = points().fold(DVec2::INFINITY, DVec2::min);
        let high = points().fold(DVec2::NEG_INFINITY, DVec2::max);
        let size = (high - low).max(DVec2::splat(1e-9));
        let scale = ((WIDTH - 2.0 * MARGIN) / size.x).min((HEIGHT - 2.0 * MARGIN) / size.y);
        let (middle, centre) = ((low + high) / 2.0, self.centre);
        move |p| DVec2::new(WIDTH, HEIGHT) / 2.0 + (project(p - centre) - middle) * scale
    }

    fn spoken(&self, out: &Paper) -> String {
        let states: Vec<_> = self
            .lines
            .iter()
            .map(|line| format!("{} {}", line.edge.id, word(out.words, line.edge.verdict)))
            .collect();
        out.with("seen", &[("edges", &states.join(", "))])
    }

    /// What the script draws from: as [`Drawing::write_svg`], in mm.
    pub fn data(&self, out: &Paper) -> Value {
        let round = |v: f64, unit: f64| (v / unit).round() * unit;
        let text = |v: DVec3, unit: f64| {
            let short = |v: f64| {
                json!(
                    format!("{:.5}", round(v, unit))
                        .parse::<f64>()
                        .unwrap_or(0.0)
                )
            };
            Value::from(v.to_array().map(short).to_vec())
        };
        let edges: Vec<_> = self
            .lines
            .iter()
            .map(|line| {
                json!({
                    "id": line.edge.id,
                    "name": format!("{}{}", line.edge.id, sign(line.edge.verdict)),
                    "verdict": class(line.edge.verdict),
                    "first": line.first,
                    "xyz": line.points.iter().map(|p| text(*p, 1e-3)).collect::<Vec<_>>(),
                    "off": line.stations.iter().map(|s| offset(s).map(|v| text(v, 1e-4))).collect::<Vec<_>>(),
                    "say": line.stations.iter().map(|s| say(out, s)).collect::<Vec<_>>(),
                    "runs": line.runs,
                })
            })
            .collect();
        let factors: Vec<f64> = (0..7)
            .map(|i| nice_step(self.factor / 10.0 * 10f64.powf(f64::from(i) / 3.0) * 0.8))
            .chain([self.factor])
            .collect();
        let told = TOLD.iter().map(|key| {
            let name = key.strip_prefix("view.").unwrap_or(key);
            (name.to_owned(), Value::from(out.t(key)))
        });
        json!({
            "words": told.collect::<serde_json::Map<_, _>>(),
            "yaw": YAW_RAD, "pitch": PITCH_RAD,
            "centre": self.centre.to_array(), "radius": self.radius_mm,
            "factor": self.factor, "factors": sorted(factors), "edges": edges,
            "unexpected": self.extra.iter()
                .map(|line| line.iter().map(|p| text(*p, 1e-3)).collect())
                .collect::<Vec<Vec<_>>>(),
        })
    }
}

/// Evenly fewer points where there are more than a page can carry; the ends stay.
fn thinned(lines: &[Vec<Xyz>]) -> Vec<Vec<DVec3>> {
    const POINTS_DRAWN: usize = 4000;
    let every = lines
        .iter()
        .map(Vec::len)
        .sum::<usize>()
        .div_ceil(POINTS_DRAWN)
        .max(1);
    let keep = |line: &Vec<Xyz>| {
        let last = line.len().saturating_sub(1);
        let kept = line.iter().enumerate();
        kept.filter(|(index, _)| index % every == 0 || *index == last)
            .map(|(_, p)| DVec3::from(*p))
            .collect()
    };
    lines.iter().take(POINTS_DRAWN).map(keep).collect()
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values.dedup();
    values
}

/// Arc length, and where measured d1 and d2 with their U, as people read them.
fn say(out: &Paper, station: &Station) -> Vec<String> {
    let mut words = vec![out.number(station.s_mm, 1)];
    if let (Some(d1), Some(d2)) = (station.d1_mm, station.d2_mm) {
        words.push(out.figure(Quantity::D1, d1, station.u_d1_mm).plus_minus());
        words.push(out.figure(Quantity::D2, d2, station.u_d2_mm).plus_minus());
    }
    words
}

/// 1, 2 or 5 times a power of ten, so that the largest deviation is drawn at most [`HAIR_SHARE`] of the part long.
fn factor(size_mm: f64, largest_mm: f64) -> f64 {
    if largest_mm <= 0.0 {
        return 1.0;
    }
    let most = (HAIR_SHARE * size_mm / largest_mm).clamp(1.0, 1e6);
    let step = nice_step(most);
    if step <= most * 1.000_001 {
        step
    } else {
        nice_step(step / 2.6)
    }
}

/// From the nominal place to the measured one, in the plane across the edge.
fn offset(station: &Station) -> Option<DVec3> {
    let measured: Xyz = station.measured?;
    let v = DVec3::from(measured) - DVec3::from(station.nominal);
    let t = DVec3::from(station.tangent);
    Some(v - t * v.dot(t))
}

fn state(station: &Station) -> &'static str {
    match station.measured {
        None => "gap",
        Some(_) => class(station.status),
    }
}

/// What stands behind the id of an edge that is not OK, so that colour is not alone.
fn sign(verdict: Status) -> &'static str {
    match verdict {
        Status::NotOk => " ×",
        Status::NotDecidable => " ?",
        Status::Ok | Status::Undefined => "",
    }
}

fn line<'a>(edge: &'a Edge, shown: &[usize]) -> Line<'a> {
    let stations: Vec<_> = shown.iter().map(|&index| &edge.stations[index]).collect();
    let mut points: Vec<_> = stations.iter().map(|s| DVec3::from(s.nominal)).collect();
    let (first, last) = (stations[0], stations[stations.len() - 1]);
    let step_mm = (last.s_mm - first.s_mm) / (stations.len().max(2) - 1) as f64;
    let near = |gap_mm: f64| gap_mm > 0.0 && gap_mm <= 1.5 * step_mm;
    let before = near(first.s_mm);
    if before {
        points.insert(0, points[0] - DVec3::from(first.tangent) * first.s_mm);
    }
    if let Some(after_mm) = edge
        .length_mm
        .map(|l| l - last.s_mm)
        .filter(|gap| near(*gap))
    {
        points.push(DVec3::from(last.nominal) + DVec3::from(last.tangent) * after_mm);
    }
    let first = usize::from(before);
    Line {
        runs: runs(&stations, first, points.len() - 1),
        edge,
        stations,
        points,
        first,
    }
}

/// Stretches of equal state; each reaches to the start of the next, so that the line has no breaks.
fn runs(stations: &[&Station], first: usize, end: usize) -> Vec<(&'static str, usize, usize)> {
    let mut runs: Vec<(&'static str, usize, usize)> = Vec::new();
    for (index, station) in stations.iter().enumerate() {
        let state = state(station);
        match runs.last_mut() {
            Some(run) if run.0 == state => run.2 = index + first,
            Some(run) => {
                run.2 = index + first;
                runs.push((state, index + first, index + first));
            }
            None => runs.push((state, 0, index + first)),
        }
    }
    if let Some(run) = runs.last_mut() {
        run.2 = end;
    }
    runs
}

/// Right and down on the paper.
fn project(p: DVec3) -> DVec2 {
    let (sin_yaw, cos_yaw) = YAW_RAD.sin_cos();
    let (sin_pitch, cos_pitch) = PITCH_RAD.sin_cos();
    let away = cos_yaw * p.y - sin_yaw * p.x;
    DVec2::new(
        cos_yaw * p.x + sin_yaw * p.y,
        -(cos_pitch * p.z + sin_pitch * away),
    )
}

/// Mean distance from the eye, up to a constant.
fn depth(line: &Line<'_>) -> f64 {
    let middle = line.points.iter().copied().sum::<DVec3>() / line.points.len() as f64;
    let away = YAW_RAD.cos() * middle.y - YAW_RAD.sin() * middle.x;
    PITCH_RAD.cos() * away - PITCH_RAD.sin() * middle.z
}

fn write_path(out: &mut Paper, points: impl Iterator<Item = DVec2>) -> fmt::Result {
    for (index, p) in points.enumerate() {
        let pen = if index == 0 { 'M' } else { 'L' };
        write!(out, "{pen}{:.1} {:.1}", p.x, p.y)?;
    }
    Ok(())
}

fn write_hairs(
    out: &mut Paper,
    line: &Line<'_>,
    factor: f64,
    at: &impl Fn(DVec3) -> DVec2,
) -> fmt::Result {
    let tip =
        |station: &Station| offset(station).map(|v| DVec3::from(station.nominal) + factor * v);
    out.write_str(r#"<path class="hair" d=""#)?;
    for (station, tip) in line
        .stations
        .iter()
        .filter_map(|s| tip(s).map(|tip| (s, tip)))
    {
        write_path(out, [at(DVec3::from(station.nominal)), at(tip)].into_iter())?;
    }
    out.write_str("\"/><path class=\"tips\" d=\"")?;
    for run in line.stations.split(|station| station.measured.is_none()) {
        write_path(out, run.iter().filter_map(|s| tip(s)).map(at))?;
    }
    out.write_str("\"/>\n")
}

fn write_axes(out: &mut Paper) -> fmt::Result {
    let origin = DVec2::new(38.0, HEIGHT - 38.0);
    for (name, axis) in [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)] {
        let (tip, text) = (origin + 26.0 * project(axis), origin + 35.0 * project(axis));
        writeln!(
            out,
            r#"<path class="axis" d="M{:.1} {:.1}L{:.1} {:.1}"/><text class="axis-name" text-anchor="middle" x="{:.1}" y="{:.1}">{name}</text>"#,
            origin.x,
            origin.y,
            tip.x,
            tip.y,
            text.x,
            text.y + 4.0
        )?;
    }
    Ok(())
}
