//! Who may do what: every route with every role, logins, forged requests.

use acies::store::Role;
use acies::web;
use serde_json::{Value, json};
use std::time::SystemTime;

use super::bench::Served;

/// What the roles are meant to allow, written down apart from the program: who is the least that may use a route.
const EVERYBODY: [&str; 9] = [
    "GET /",
    "GET /page/app.js",
    "GET /healthz",
    "GET /readyz",
    "GET /api/v1/openapi.json",
    "GET /api/v1/me",
    "POST /api/v1/login",
    "POST /api/v1/logout",
    "GET /page/nothing.js",
];
const OPERATOR: [&str; 29] = [
    "GET /metrics",
    "GET /api/v1/status",
    "GET /api/v1/events",
    "GET /api/v1/live/points",
    "GET /api/v1/live/profiles",
    "GET /api/v1/live/edges",
    "GET /api/v1/devices",
    "GET /api/v1/storage",
    "GET /api/v1/inspections",
    "POST /api/v1/inspections",
    "GET /api/v1/inspections/{id}",
    "GET /api/v1/inspections/{id}/report.json",
    "GET /api/v1/inspections/{id}/report.html",
    "GET /api/v1/inspections/{id}/report.csv",
    "GET /api/v1/inspections/{id}/scan.ply",
    "GET /api/v1/inspections/{id}/scan.raw",
    "POST /api/v1/stop",
    "POST /api/v1/abort",
    "POST /api/v1/halt",
    "POST /api/v1/reset",
    "GET /api/v1/characteristics",
    "GET /api/v1/trends/{name}",
    "GET /api/v1/export",
    "GET /api/v1/recipes",
    "GET /api/v1/recipes/{id}",
    "GET /api/v1/recipes/{id}/file",
    "HEAD /api/v1/status",
    "HEAD /api/v1/inspections",
    "HEAD /metrics",
];
const SETTER: [&str; 5] = [
    "POST /api/v1/recipes",
    "POST /api/v1/recipes/check",
    "POST /api/v1/recipes/import",
    "POST /api/v1/recipes/{id}/activate",
    "POST /api/v1/reload",
];
const METROLOGIST: [&str; 1] = ["GET /api/v1/audit"];
const ADMINISTRATOR: [&str; 7] = [
    "GET /api/v1/people",
    "POST /api/v1/people",
    "PATCH /api/v1/people/{name}",
    "GET /api/v1/sessions",
    "DELETE /api/v1/sessions/{id}",
    "POST /api/v1/tokens",
    "POST /api/v1/backup",
];

fn matrix() -> Vec<(&'static str, Option<Role>)> {
    let of = |routes: &[&'static str], role| {
        routes
            .iter()
            .map(|route| (*route, role))
            .collect::<Vec<_>>()
    };
    [
        of(&EVERYBODY, None),
        of(&OPERATOR, Some(Role::Operator)),
        of(&SETTER, Some(Role::Setter)),
        of(&METROLOGIST, Some(Role::Metrologist)),
        of(&ADMINISTRATOR, Some(Role::Administrator)),
    ]
    .concat()
}

#[test]
fn every_route_is_open_to_its_role_and_those_above_and_closed_to_all_others() {
    let cell = Served::without_devices("matrix", |service| service.anonymous = None);
    let empty = json!({});
    for (route, least) in matrix() {
        let (method, path) = route.split_once(' ').expect("method and path");
        let path = path.replace("{id}", "4711").replace("{name}", "e1.d1");
        let body = ["POST", "PATCH"].contains(&method).then_some(&empty);
        let ask = |role: Option<Role>| {
            let token = role.map(|role| format!("Bearer {}", cell.token(role)));
            let headers: Vec<(&str, &str)> = token
                .iter()
                .map(|token| ("authorization", token.as_str()))
                .collect();
            cell.open(method, &path, body, &headers).status().as_u16()
        };
        let nobody = ask(None);
        // A login without name and password is a bad request; it is none for want of a role.
        assert_eq!(
            nobody == 401,
            least.is_some(),
            "{route} without a login: {nobody}"
        );
        for role in Role::ALL {
            let status = ask(Some(role));
            let may = least.is_none_or(|least| role >= least);
            assert_eq!(status != 403, may, "{route} as {role:?}: {status}");
            assert_ne!(status, 401, "{route} as {role:?}");
            assert_ne!(status, 405, "{route} as {role:?}");
        }
    }
}

#[test]
fn the_matrix_above_has_every_operation_of_the_api() {
    let document: Value = serde_json::from_str(&web::openapi()).expect("JSON");
    let paths = document["paths"].as_object().expect("paths");
    let known = matrix();
    for (path, item) in paths {
        for method in item.as_object().expect("operations").keys() {
            let route = format!("{} {path}", method.to_uppercase());
            assert!(
                known.iter().any(|(known, _)| *known == route),
                "{route} has no least role"
            );
        }
    }
    assert!(paths.len() > 30, "{} paths", paths.len());
}

fn person(cell: &Served, name: &str, role: Role, password: &str) {
    let hash = web::hash_password(password).expect("a good password");
    let added = cell.store.add_person(name, role, &hash, SystemTime::now());
    added.expect("somebody new");
}

#[test]
fn a_session_opens_with_the_password_and_ends_with_the_logout() {
    let cell = Served::without_devices("session", |_| ());
    person(&cell, "ada", Role::Setter, "a long sentence");
    let me = cell.get("/api/v1/me").json();
    assert_eq!(
        me,
        json!({"name": "anonymous", "role": "operator", "logged_in": false})
    );
    let login = cell.post(
        "/api/v1/login",
        &json!({"name": "ada", "password": "a long sentence"}),
    );
    assert_eq!(login.status, 200, "{}", login.text());
    let cookie = login.header("set-cookie");
    for needed in [
        "acies=",
        "HttpOnly",
        "SameSite=Strict",
        "Path=/",
        "Max-Age=43200",
    ] {
        assert!(cookie.contains(needed), "{needed} in {cookie}");
    }
    assert!(
        !cookie.contains("Secure"),
        "plain HTTP on loopback: {cookie}"
    );
    let cookie = cookie.split(';').next().expect("a cookie").to_owned();
    let with = [("cookie", cookie.as_str())];
    let me = cell.ask("GET", "/api/v1/me", None, &with).json();
    assert_eq!(
        me,
        json!({"name": "ada", "role": "setter", "logged_in": true})
    );
    assert_eq!(cell.ask("POST", "/api/v1/logout", None, &with).status, 204);
    // The cookie was copied before; it opens nothing any more.
    let me = cell.ask("GET", "/api/v1/me", None, &with).json();
    assert_eq!(me["logged_in"], false);
    let log = cell.store.audit_log(None, 10).expect("the log");
    let actions: Vec<&str> = log.iter().map(|entry| entry.action.as_str()).collect();
    assert_eq!(actions[..2], ["session.logout", "session.login"]);
}

#[test]
fn guessing_is_slowed_down_and_unknown_names_look_like_known_ones() {
    let cell = Served::without_devices("guesses", |_| ());
    person(&cell, "ada", Role::Operator, "a long sentence");
    let try_as = |name: &str| {
        cell.post(
            "/api/v1/login",
            &json!({"name": name, "password": "wrong wrong"}),
        )
    };
    let known = try_as("ada").problem(401, "login");
    let unknown = try_as("nobody").problem(401, "login");
    assert_eq!(known, unknown, "no word tells which names there are");
    for _ in 0..3 {
        try_as("ada").problem(401, "login");
    }
    let limited = cell.post(
        "/api/v1/login",
        &json!({"name": "ada", "password": "a long sentence"}),
    );
    limited.problem(429, "guesses");
    let seconds: u64 = limited.header("retry-after").parse().expect("seconds");
    assert!((1..=61).contains(&seconds), "{seconds}");
}

#[test]
fn a_person_who_is_disabled_loses_every_key_and_the_last_administrator_stays() {
    let cell = Served::without_devices("people", |_| ());
    let bearer = format!("Bearer {}", cell.token(Role::Administrator));
    let with = [("authorization", bearer.as_str())];
    let new = json!({"name": "bob", "role": "operator", "password": "a long sentence"});
    let added = cell.ask("POST", "/api/v1/people", Some(&new), &with);
    assert_eq!(added.status, 201, "{}", added.text());
    cell.ask("POST", "/api/v1/people", Some(&new), &with)
        .problem(409, "conflict");
    let short = json!({"name": "eve", "role": "operator", "password": "short"});
    cell.ask("POST", "/api/v1/people", Some(&short), &with)
        .problem(422, "invalid");
    let token = json!({"person": "bob", "label": "gauge", "days": 1});
    let made = cell.ask("POST", "/api/v1/tokens", Some(&token), &with);
    assert_eq!(made.status, 201, "{}", made.text());
    let secret = made.json()["secret"].as_str().expect("a secret").to_owned();
    let bobs = format!("Bearer {secret}");
    let as_bob = [("authorization", bobs.as_str())];
    assert_eq!(
        cell.ask("GET", "/api/v1/me", None, &as_bob).json()["name"],
        "bob"
    );
    let listed = cell.ask("GET", "/api/v1/sessions", None, &with).text();
    assert!(
        listed.contains("gauge") && !listed.contains(&secret),
        "{listed}"
    );
    let off = json!({"enabled": false});
    let changed = cell.ask("PATCH", "/api/v1/people/bob", Some(&off), &with);
    assert_eq!(changed.json()["enabled"], false, "{}", changed.text());
    cell.ask("GET", "/api/v1/me", None, &as_bob)
        .problem(401, "token");
    let problem = cell.ask(
        "PATCH",
        "/api/v1/people/administrator-person",
        Some(&off),
        &with,
    );
    problem.problem(409, "conflict");
    let log = cell.ask("GET", "/api/v1/audit", None, &with).json();
    let entry = |action: &str| {
        let items = log["items"].as_array().expect("entries");
        let found = items.iter().find(|entry| entry["action"] == action);
        found
            .cloned()
            .unwrap_or_else(|| panic!("{action} in {log}"))
    };
    let change = entry("person.change");
    assert_eq!(change["person"], "administrator-person");
    assert_eq!(
        (&change["old"], &change["new"]),
        (&json!("operator"), &json!("operator, disabled"))
    );
    assert_eq!(entry("person.add")["subject"], "bob");
    assert_eq!(entry("token.add")["subject"], "gauge of bob");
}

#[test]
fn what_another_site_sends_changes_nothing() {
    let cell = Served::without_devices("forged", |_| ());
    let own = format!("http://{}", cell.address);
    let halt = |headers: &[(&str, &str)]| cell.ask("POST", "/api/v1/halt", None, headers);
    for forged in [
        [("origin", "https://evil.example"), ("accept", "*/*")],
        [("sec-fetch-site", "cross-site"), ("accept", "*/*")],
        [("sec-fetch-site", "same-site"), ("origin", own.as_str())],
        [("origin", "null"), ("accept", "*/*")],
    ] {
        halt(&forged).problem(403, "foreign-origin");
    }
    assert_ne!(cell.get("/api/v1/status").json()["state"], "halted");
    let own = [("origin", own.as_str()), ("sec-fetch-site", "same-origin")];
    assert_eq!(halt(&own).status, 204);
    assert_eq!(cell.get("/api/v1/status").json()["state"], "halted");
}

#[test]
fn a_name_of_somebody_elses_that_leads_here_is_not_answered() {
    let cell = Served::without_devices("rebinding", |_| ());
    let as_host = |host: &str| cell.ask("GET", "/api/v1/status", None, &[("host", host)]);
    as_host("evil.example").problem(421, "host");
    as_host("127.0.0.1.evil.example:8370").problem(421, "host");
    for host in ["localhost", "LOCALHOST:8370", "127.0.0.1:1", "[::1]:8370"] {
        assert_eq!(as_host(host).status, 200, "{host}");
    }
}
