//! The stations as a table for spreadsheets: RFC 4180, decimal point, units in the header, empty where not measured.

use super::wire::{Edge, Kind, Report, Station, Status};

const HEADER: [&str; 37] = [
    "edge",
    "step_entity",
    "kind",
    "s_mm",
    "nominal_x_mm",
    "nominal_y_mm",
    "nominal_z_mm",
    "tangent_x",
    "tangent_y",
    "tangent_z",
    "n1_x",
    "n1_y",
    "n1_z",
    "n2_x",
    "n2_y",
    "n2_z",
    "measured_x_mm",
    "measured_y_mm",
    "measured_z_mm",
    "d1_mm",
    "u_d1_mm",
    "d2_mm",
    "u_d2_mm",
    "nominal_included_angle_deg",
    "included_angle_deg",
    "u_included_angle_deg",
    "residual_1_mm",
    "residual_2_mm",
    "points_1",
    "points_2",
    "status",
    "edge_verdict",
    "part_verdict",
    "reason",
    "boundary_flank",
    "boundary_d_mm",
    "u_boundary_d_mm",
];

impl Report {
    /// One row a station, in order of edges and arc length; `u_...` are standard uncertainties.
    pub fn to_csv(&self) -> String {
        let mut writer = csv::WriterBuilder::new()
            .terminator(csv::Terminator::CRLF)
            .from_writer(Vec::new());
        let mut write = |row: &[String]| {
            writer
                .write_record(row)
                .expect("writing equally long rows to memory cannot fail");
        };
        write(&HEADER.map(str::to_owned));
        for edge in &self.edges {
            for station in &edge.stations {
                write(&row(edge, station, self.verdict));
            }
        }
        let bytes = writer.into_inner().expect("flushing to memory cannot fail");
        String::from_utf8(bytes).expect("every field is UTF-8")
    }
}

fn row(edge: &Edge, station: &Station, part: Status) -> [String; HEADER.len()] {
    let [nx, ny, nz] = station.nominal.map(mm);
    let [tx, ty, tz] = station.tangent.map(direction);
    let [ax, ay, az] = station.n1.map(direction);
    let [bx, by, bz] = station.n2.map(direction);
    let [mx, my, mz] = match station.measured {
        Some(measured) => measured.map(mm),
        None => Default::default(),
    };
    let length = |value: Option<f64>| value.map_or_else(String::new, mm);
    let angle = |value: Option<f64>| value.map_or_else(String::new, |v| fixed(v, 5));
    let kind = match edge.kind {
        Kind::Convex => "convex",
        Kind::Concave => "concave",
    };
    [
        text(&edge.id),
        edge.nominal_entity.to_string(),
        kind.to_owned(),
        mm(station.s_mm),
        nx,
        ny,
        nz,
        tx,
        ty,
        tz,
        ax,
        ay,
        az,
        bx,
        by,
        bz,
        mx,
        my,
        mz,
        length(station.d1_mm),
        length(station.u_d1_mm),
        length(station.d2_mm),
        length(station.u_d2_mm),
        angle(Some(station.nominal_included_angle_deg)),
        angle(station.included_angle_deg),
        angle(station.u_included_angle_deg),
        length(station.residual_1_mm),
        length(station.residual_2_mm),
        station.points_1.to_string(),
        station.points_2.to_string(),
        word(station.status),
        word(edge.verdict),
        word(part),
        text(&station.reason),
        station
            .boundary
            .map_or_else(String::new, |seen| seen.flank.to_string()),
        length(station.boundary.and_then(|seen| seen.d_mm.value)),
        length(station.boundary.and_then(|seen| seen.d_mm.u)),
    ]
}

/// To 0.01 µm: finer than any instrument that comes near us.
fn mm(value: f64) -> String {
    fixed(value, 5)
}

fn direction(value: f64) -> String {
    fixed(value, 7)
}

/// Without the sign of what rounds to zero.
fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.bytes().all(|b| b == b'0' || b == b'.') => zero.to_owned(),
        _ => text,
    }
}

fn word(status: Status) -> String {
    match status {
        Status::Undefined => "undefined",
        Status::Ok => "ok",
        Status::NotDecidable => "not_decidable",
        Status::NotOk => "not_ok",
    }
    .to_owned()
}

/// Text from outside on one line, with a quote before what a spreadsheet would run as a formula.
fn text(value: &str) -> String {
    let line: String = value
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();
    if line.starts_with(['=', '+', '-', '@']) {
        format!("'{line}")
    } else {
        line
    }
}
