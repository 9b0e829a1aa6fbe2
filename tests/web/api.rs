//! The API with a part that was measured, and without devices.

use acies::store::Role;
use serde_json::json;

use super::bench::{Served, measured};

#[test]
fn an_inspection_is_found_with_its_report_in_every_form_and_its_scan() {
    let cell = measured();
    let one = cell.get("/api/v1/inspections/1").json();
    assert_eq!(one["phase"], "done");
    assert_eq!(one["part_serial"], "SN-1");
    assert_eq!(
        one["verdict"], "not_ok",
        "the demo's part is faulty on purpose"
    );
    let list = cell.get("/api/v1/inspections?order_number=PO-7").json();
    assert_eq!(list["items"][0], one);
    let base = "/api/v1/inspections/1";
    let report = cell.get(&format!("{base}/report.json"));
    assert_eq!(report.header("content-type"), "application/json");
    assert_eq!(report.json()["part"], "SN-1");
    assert_eq!(report.json()["reason"], one["reason"]);
    let page = cell.get(&format!("{base}/report.html"));
    let policy = page.header("content-security-policy");
    assert!(
        policy.contains("script-src 'sha256-"),
        "its own policy: {policy}"
    );
    assert!(policy.contains("frame-ancestors 'self'"), "{policy}");
    assert!(
        page.text()
            .contains("href=\"/api/v1/inspections/1/report.csv\"")
    );
    let german = cell.get(&format!("{base}/report.html?language=de"));
    assert!(german.text().contains("<html lang=\"de\">"));
    assert!(german.text().contains("NICHT OK"));
    let unknown = cell.get(&format!("{base}/report.html?language=xx"));
    assert_eq!(unknown.status, 400);
    let csv = cell.get(&format!("{base}/report.csv"));
    assert_eq!(csv.header("content-type"), "text/csv; charset=utf-8");
    assert!(
        csv.header("content-disposition")
            .contains("inspection-1.csv")
    );
    let ply = cell.get(&format!("{base}/scan.ply"));
    let head = String::from_utf8_lossy(&ply.body[..400]).into_owned();
    let points = one["points"].as_i64().expect("points");
    assert!(head.starts_with("ply\n"), "{head}");
    assert!(
        head.contains(&format!("element vertex {points}\n")),
        "{points}: {head}"
    );
    let raw = cell.get(&format!("{base}/scan.raw"));
    assert!(raw.body.starts_with(b"ACIESRAW\x01"));
    assert_eq!(
        raw.body.len() as i64,
        one["scan_bytes"].as_i64().expect("bytes")
    );
}

#[test]
fn the_same_trigger_twice_is_one_inspection_and_another_part_needs_another_key() {
    let cell = measured();
    let again = |serial: &str| {
        let order = json!({"part_serial": serial, "order_number": "PO-7"});
        let key = [("idempotency-key", "first")];
        cell.ask("POST", "/api/v1/inspections", Some(&order), &key)
    };
    let same = again("SN-1");
    assert_eq!(same.status, 200, "{}", same.text());
    assert_eq!(same.json()["id"], 1);
    again("SN-2").problem(422, "invalid");
    let long = "k".repeat(256);
    let order = json!({"part_serial": "SN-1"});
    let key = [("idempotency-key", long.as_str())];
    cell.ask("POST", "/api/v1/inspections", Some(&order), &key)
        .problem(400, "idempotency-key");
}

#[test]
fn the_scan_is_there_as_points_and_profiles_while_it_grows() {
    let cell = measured();
    let all = cell.get("/api/v1/live/points");
    let generation = all.header("acies-generation").to_owned();
    let count = all.body.len() / 12;
    assert!(count > 1000, "{count} points");
    let numbers: Vec<f32> = all
        .body
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes(bytes.try_into().expect("4 bytes")))
        .collect();
    // The part lies at 150, 120, 40 in the machine and is 100 mm large.
    let near = |point: &[f32]| {
        let d = [point[0] - 150.0, point[1] - 120.0, point[2] - 40.0];
        d.iter().all(|d| d.abs() < 200.0)
    };
    assert!(numbers.chunks_exact(3).all(near));
    let tail = cell.get(&format!(
        "/api/v1/live/points?generation={generation}&from={}",
        count - 10
    ));
    assert_eq!(tail.body, all.body[12 * (count - 10)..]);
    let other = cell.get("/api/v1/live/points?generation=0&from=10");
    assert_eq!(
        other.header("acies-from"),
        "0",
        "another scan is sent whole"
    );
    let profiles = cell.get("/api/v1/live/profiles").json();
    let names: Vec<_> = profiles
        .as_array()
        .expect("two")
        .iter()
        .map(|p| &p["device"])
        .collect();
    assert_eq!(names, [&json!("left"), &json!("right")]);
}

#[test]
fn trends_and_exports_hold_what_the_report_says() {
    let cell = measured();
    let report = cell.get("/api/v1/inspections/1/report.json").json();
    let edges = report["edges"].as_array().expect("edges");
    let characteristic = edges
        .iter()
        .flat_map(|edge| edge["characteristics"].as_array().expect("a list"))
        .find(|found| found["value"].is_f64())
        .expect("a value that was measured");
    let name = characteristic["id"].as_str().expect("a name");
    let names = cell.get("/api/v1/characteristics").json();
    assert!(names.as_array().expect("names").contains(&json!(name)));
    let path = name.replace(' ', "%20");
    let trend = cell
        .get(&format!("/api/v1/trends/{path}?everything=true"))
        .json();
    assert_eq!(trend["points"][0]["value"], characteristic["value"]);
    let counting = cell.get(&format!("/api/v1/trends/{path}")).json();
    assert_eq!(counting["points"], json!([]), "simulated parts never count");
    let csv = cell.get("/api/v1/export?form=csv&part_serial=SN-1").text();
    assert!(
        csv.lines()
            .any(|line| line.starts_with("1,SN-1,PO-7,series,anonymous,")),
        "{csv:.300}"
    );
    let lines = cell
        .get("/api/v1/export?form=jsonl&part_serial=SN-1")
        .text();
    let first = lines.lines().next().expect("one line an inspection");
    let line: serde_json::Value = serde_json::from_str(first).expect("JSON");
    assert_eq!(line["inspection"]["part_serial"], "SN-1");
    assert_eq!(line["report"]["schema"], "acies-report/1");
    cell.get("/api/v1/trends/nothing.d1")
        .problem(404, "missing");
}

#[test]
fn recipes_are_checked_kept_exported_imported_and_activated_with_a_reason() {
    let cell = Served::without_devices("recipes", |_| ());
    let bearer = format!("Bearer {}", cell.token(Role::Setter));
    let with = [("authorization", bearer.as_str())];
    let post = |path: &str, body| cell.ask("POST", path, Some(&body), &with);
    let first = cell.get("/api/v1/recipes/1").json();
    assert_eq!(first["active"], true);
    let text = first["text"]
        .as_str()
        .expect("TOML")
        .replace("-0.040, 0.040", "-0.050, 0.050");
    let checked = post(
        "/api/v1/recipes/check",
        json!({"text": text, "nominal_of": 1}),
    )
    .json();
    assert_eq!(checked["ok"], true, "{checked}");
    assert!(checked["sharp_edges"].as_u64().expect("a count") > 10);
    let wrong = json!({"text": "minimum_coverage = 7", "nominal_of": 1});
    let mistakes = post("/api/v1/recipes/check", wrong.clone()).json();
    assert_eq!(mistakes["ok"], false);
    assert!(
        mistakes["mistakes"][0]
            .as_str()
            .expect("a line")
            .contains("minimum_coverage")
    );
    let mut kept = wrong;
    kept["name"] = json!("part");
    kept["why"] = json!("a try");
    post("/api/v1/recipes", kept).problem(422, "recipe");
    let new = json!({"name": "part", "text": text, "nominal_of": 1, "why": "wider limits"});
    let version = post("/api/v1/recipes", new.clone()).json();
    assert_eq!(
        (&version["version"], &version["active"]),
        (&json!(2), &json!(false)),
        "{version}"
    );
    assert_eq!(
        post("/api/v1/recipes", new).json()["id"],
        version["id"],
        "the same content"
    );
    let id = version["id"].as_i64().expect("a number");
    let activate = format!("/api/v1/recipes/{id}/activate");
    post(&activate, json!({"why": "  "})).problem(422, "invalid");
    // Other limits are put in force by a metrologist; a setter may come back to them.
    let why = json!({"why": "customer's drawing B"});
    post(&activate, why.clone()).problem(403, "release");
    let metrologist = format!("Bearer {}", cell.token(Role::Metrologist));
    let with_metrologist = [("authorization", metrologist.as_str())];
    let active = cell.ask("POST", &activate, Some(&why), &with_metrologist);
    assert_eq!(active.json()["active"], true, "{}", active.text());
    let log = cell.store.audit_log(None, 1).expect("the log");
    assert_eq!(log[0].action, "recipe.activate");
    assert_eq!(log[0].why, "customer's drawing B");
    assert!(
        log[0].old.contains("v1") && log[0].new.contains("v2"),
        "{log:?}"
    );

    let back = json!({"why": "drawing A again"});
    for path in ["/api/v1/recipes/1/activate", activate.as_str()] {
        let answer = post(path, back.clone());
        assert_eq!(answer.status, 200, "{}", answer.text());
    }
    // Words, and how densely an edge is looked at, judge nothing.
    let denser = format!("# closer\nstation_step_mm = 0.5\n{text}");
    let new = json!({"name": "part", "text": denser, "nominal_of": 1, "why": "closer"});
    let denser = post("/api/v1/recipes", new).json();
    assert_eq!(denser["released"], false, "{denser}");
    let path = format!("/api/v1/recipes/{}/activate", denser["id"]);
    let answer = post(&path, json!({"why": "closer"}));
    assert_eq!(answer.status, 200, "{}", answer.text());
    assert_eq!(answer.json()["released"], true, "{}", answer.text());

    let file = cell.get(&format!("/api/v1/recipes/{id}/file")).json();
    let other = Served::without_devices("recipes-import", |service| {
        service.anonymous = Some(Role::Setter)
    });
    let imported = other
        .post("/api/v1/recipes/import?why=from%20cell%201", &file)
        .json();
    assert_eq!(
        imported["sha256"], version["sha256"],
        "the same content has the same hash everywhere"
    );
    let mut broken = file;
    broken["nominal_base64"] = json!("!");
    other
        .post("/api/v1/recipes/import", &broken)
        .problem(422, "invalid");
    let left = std::fs::read_dir(other.store.folder()).expect("the store");
    let left = left.filter(|entry| {
        let name = entry.as_ref().expect("an entry").file_name();
        name.to_string_lossy().starts_with("incoming")
    });
    assert_eq!(left.count(), 0, "what was only looked at is gone");
}

#[test]
fn a_cell_that_cannot_measure_says_why_and_keeps_the_refusal() {
    let cell = Served::without_devices("refused", |_| ());
    cell.wait("a device that is not there", |snapshot| {
        !snapshot.cause.is_empty() && snapshot.state == acies::cell::State::Error
    });
    assert_eq!(cell.get("/healthz").status, 200, "the daemon lives");
    let ready = cell.get("/readyz").problem(503, "not-ready");
    assert!(
        ready["detail"].as_str().expect("text").contains("device"),
        "{ready}"
    );
    let start = cell.post("/api/v1/inspections", &json!({"part_serial": "SN-9"}));
    let problem = start.problem(409, "not-ready");
    let id = problem["inspection"]
        .as_i64()
        .expect("the refused inspection");
    let kept = cell.get(&format!("/api/v1/inspections/{id}")).json();
    assert_eq!(
        (&kept["phase"], &kept["part_serial"]),
        (&json!("refused"), &json!("SN-9"))
    );
    for body in [
        json!({"part_serial": 7}),
        json!([]),
        json!({"part_serial": "A", "mode": "twice"}),
    ] {
        cell.post("/api/v1/inspections", &body).problem(422, "body");
    }
    let long = json!({"part_serial": "x".repeat(201)});
    cell.post("/api/v1/inspections", &long)
        .problem(422, "invalid");
}

#[test]
fn pages_of_a_list_follow_each_other_without_gap_or_repeat() {
    let cell = Served::without_devices("pages", |_| ());
    for number in 0..7 {
        let order = acies::store::Order {
            part_serial: format!("SN-{number}"),
            ..Default::default()
        };
        let trigger = acies::store::Trigger {
            order: &order,
            operator: "test",
            key: None,
            simulated: true,
        };
        let refused = cell
            .store
            .refuse(&trigger, "for the list", std::time::UNIX_EPOCH);
        refused.expect("a row");
    }
    let mut seen = Vec::new();
    let mut before = String::new();
    loop {
        let page = cell
            .get(&format!("/api/v1/inspections?limit=3{before}"))
            .json();
        let items = page["items"].as_array().expect("items");
        seen.extend(
            items
                .iter()
                .map(|item| item["part_serial"].as_str().expect("text").to_owned()),
        );
        match page["next"].as_i64() {
            Some(next) => before = format!("&before={next}"),
            None => break,
        }
    }
    let all: Vec<String> = (0..7).rev().map(|number| format!("SN-{number}")).collect();
    assert_eq!(seen, all);
    cell.get("/api/v1/inspections?limit=x")
        .problem(400, "query");
    cell.get("/api/v1/inspections/x").problem(400, "address");
    cell.get("/api/v1/inspections/99").problem(404, "missing");
}

#[test]
fn metrics_are_openmetrics_and_count_the_requests() {
    let cell = measured();
    cell.get("/api/v1/nothing").problem(404, "missing");
    let metrics = cell.get("/metrics");
    assert!(
        metrics
            .header("content-type")
            .starts_with("application/openmetrics-text")
    );
    let text = metrics.text();
    assert!(text.ends_with("# EOF\n"));
    for line in [
        "acies_cell_ready 1.0",
        "acies_device_ready{device=\"left\"} 1.0",
        "acies_last_verdict{verdict=\"not_ok\"} 1.0",
    ] {
        assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
    }
    assert!(
        text.contains("acies_http_requests_total{method=\"GET\",status=\"4xx\"}"),
        "{text}"
    );
}

#[test]
fn a_backup_is_a_store_like_this_one() {
    let cell = Served::without_devices("backup", |service| {
        service.anonymous = Some(Role::Administrator)
    });
    let made = cell.ask("POST", "/api/v1/backup", None, &[]);
    assert_eq!(made.status, 201, "{}", made.text());
    let body = made.json();
    let folder = std::path::Path::new(body["folder"].as_str().expect("a folder"));
    let copy = acies::store::Store::open(folder).expect("a store");
    assert_eq!(copy.recipes().expect("its recipes").len(), 1);
}

#[test]
fn commands_answer_with_nothing_and_stand_in_the_audit_log() {
    let cell = Served::without_devices("commands", |_| ());
    for (path, action) in [
        ("stop", "cell.stop"),
        ("abort", "cell.abort"),
        ("halt", "cell.halt"),
        ("reset", "cell.reset"),
    ] {
        let done = cell.ask("POST", &format!("/api/v1/{path}"), None, &[]);
        assert_eq!((done.status, done.body.len()), (204, 0), "{path}");
        let log = cell.store.audit_log(None, 1).expect("the log");
        assert_eq!(
            (log[0].action.as_str(), log[0].person.as_str()),
            (action, "anonymous")
        );
    }
}

#[test]
fn a_part_that_repeats_an_unknown_inspection_is_refused_and_the_refusal_kept() {
    let cell = measured();
    let again = |first: serde_json::Value| {
        let order = json!({"part_serial": "SN-R", "remeasure_of": first});
        cell.post("/api/v1/inspections", &order)
    };
    // To JSON Schema 999.0 is an integer.
    for first in [json!(999), json!(999.0)] {
        let problem = again(first).problem(422, "nothing-to-repeat");
        let kept = problem["inspection"].as_i64().expect("its number");
        let kept = cell.get(&format!("/api/v1/inspections/{kept}")).json();
        assert_eq!(kept["phase"], "refused");
        assert_eq!(kept["remeasure_of"], serde_json::Value::Null);
    }
    for first in [json!(1.5), json!(1e19), json!("1")] {
        again(first).problem(422, "body");
    }
}
