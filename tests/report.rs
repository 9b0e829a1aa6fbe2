//! The report and its forms, read as their readers read them.

#[path = "report/forms.rs"]
mod forms;
#[path = "report/part.rs"]
mod part;
#[path = "report/schema.rs"]
mod schema;

use acies::report::Report;
use acies::words::Language;

fn report() -> Report {
    Report::new(&part::inspection(40), &part::facts())
}

#[test]
fn json_has_every_key_of_the_contract() {
    let json: serde_json::Value = serde_json::from_str(&report().to_json()).expect("it is JSON");
    let has = |value: &serde_json::Value, keys: &[&str]| {
        for key in keys {
            assert!(value.get(key).is_some(), "{key} is missing in {value:.200}");
        }
    };
    assert_eq!(json["schema"], "acies-report/1");
    has(
        &json,
        &[
            "part",
            "scan",
            "alignment",
            "edges",
            "unexpected_edges",
            "missing_edges",
            "verdict",
            "seconds",
        ],
    );
    has(
        &json["scan"],
        &["points", "spacing_mm", "noise_mm", "losses"],
    );
    has(
        &json["alignment"],
        &["part_from_machine", "rms_mm", "weak_directions", "status"],
    );
    has(
        &json["edges"][0],
        &[
            "id",
            "nominal_entity",
            "kind",
            "length_mm",
            "coverage",
            "stations",
            "summary",
            "characteristics",
            "verdict",
        ],
    );
    has(
        &json["edges"][0]["stations"][0],
        &[
            "s_mm",
            "nominal",
            "tangent",
            "n1",
            "n2",
            "measured",
            "d1_mm",
            "d2_mm",
            "u_d1_mm",
            "u_d2_mm",
            "included_angle_deg",
            "u_included_angle_deg",
            "points_1",
            "points_2",
            "status",
            "reason",
        ],
    );
}

#[test]
fn json_comes_back_as_the_same_report() {
    let report = report();
    let back: Report = serde_json::from_str(&report.to_json()).expect("it is a report");
    assert_eq!(back, report);
    assert_eq!(back.to_json(), report.to_json());
}

#[test]
fn a_report_keeps_to_the_schema() {
    let schema = Report::json_schema();
    let json = serde_json::to_value(report()).expect("it is JSON");
    schema::check(&schema, &schema, &json).expect("the report keeps to its schema");
    let mut wrong = json;
    wrong["edges"][0]["verdict"] = "maybe".into();
    let error = schema::check(&schema, &schema, &wrong).expect_err("no such verdict");
    assert!(error.contains("/edges/0/verdict"), "{error}");
}

#[test]
fn the_schema_is_the_one_that_was_published() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/acies-report-1.schema.json"
    );
    let mut now = serde_json::to_string_pretty(&Report::json_schema()).expect("it is JSON");
    now.push('\n');
    if std::env::var_os("UPDATE").is_some() {
        std::fs::write(path, &now).expect("tests/ can be written");
    }
    let published = std::fs::read_to_string(path).expect("the schema is kept beside the tests");
    assert!(
        published == now,
        "the wire types no longer give tests/acies-report-1.schema.json; a change of the contract is a new version, \
         an added key is written with UPDATE=1"
    );
}

#[test]
fn a_page_of_fifty_edges_stays_below_one_and_a_half_megabytes() {
    let mut inspection = part::inspection(100);
    let edges = inspection.edges.clone();
    inspection.edges = edges.iter().cycle().take(50).cloned().collect();
    let page = Report::new(&inspection, &part::facts()).to_html(Language::En);
    assert!(page.len() < 1_500_000, "{} bytes", page.len());
    let edges = edges.iter().cycle().take(600).cloned().collect();
    inspection.edges = edges;
    let page = Report::new(&inspection, &part::facts()).to_html(Language::En);
    assert!(page.len() < 6_000_000, "{} bytes for 600 edges", page.len());
}

#[test]
fn a_page_stays_readable_whatever_the_number_of_stations_holes_and_findings() {
    let mut inspection = part::inspection(20_000);
    inspection.edges.truncate(2);
    for station in inspection.edges[0].stations.iter_mut().step_by(2) {
        station.measured = None;
        station.reason = "no points on either flank".to_owned();
    }
    inspection.findings = (0..9_000).map(|i| format!("finding {i}")).collect();
    inspection.unexpected_edges = vec![vec![glam::DVec3::ONE; 7]; 9_000];
    let report = Report::new(&inspection, &part::facts());
    let page = report.to_html(Language::En);
    assert!(page.len() < 2_500_000, "{} bytes", page.len());
    for said in [
        "drawn; the CSV and JSON forms hold all",
        "and 8960 more, in the JSON form",
        "more stretches",
    ] {
        assert!(page.contains(said), "{said}");
    }
    assert_eq!(
        report.to_csv().lines().count(),
        40_001,
        "the table holds all"
    );
}

#[test]
fn the_page_is_kept_for_people_to_look_at() {
    let path = concat!(env!("CARGO_TARGET_TMPDIR"), "/report.html");
    std::fs::write(path, report().to_html(Language::En)).expect("the target folder can be written");
    assert!(std::fs::metadata(path).expect("it was written").len() > 10_000);
}
