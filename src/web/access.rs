//! Who may do what: one table of routes and roles, and the one place that asks it.
//!
//! Every request passes [`guard`]: the name it was called by (DNS rebinding), where it comes from (requests forged across sites),
//! who sends it, and whether that role may. A route that does not stand in the table is closed, also where the router knows it:
//! what was forgotten here is found by who misses it, not by who should not have it.

use std::net::SocketAddr;
use std::time::SystemTime;

use axum::extract::{FromRequestParts, MatchedPath, Request, State};
use axum::http::header::{self, HeaderMap};
use axum::http::request::Parts;
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::app::App;
use super::problem::Problem;
use crate::store::Role;

/// Largest body that any route takes, bytes: a recipe with the nominal of a large part in base64.
pub(super) const LARGEST: u64 = 64 << 20;

/// The least that a route asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Need {
    /// Nothing: everybody who can reach the page.
    Nothing,
    /// This role or one above it; who has not logged in has the role that the configuration gives.
    AtLeast(Role),
}

use Need::{AtLeast, Nothing};
use Role::{Administrator, Metrologist, Operator, Setter};

/// Every route with the least that it asks for. HEAD counts as GET.
const ROUTES: &[(&str, &str, Need)] = &[
    ("GET", "/", Nothing),
    ("GET", "/page/{*file}", Nothing),
    ("GET", "/healthz", Nothing),
    ("GET", "/readyz", Nothing),
    ("GET", "/metrics", AtLeast(Operator)),
    ("GET", "/api/v1/openapi.json", Nothing),
    ("POST", "/api/v1/login", Nothing),
    ("POST", "/api/v1/logout", Nothing),
    ("GET", "/api/v1/me", Nothing),
    ("GET", "/api/v1/status", AtLeast(Operator)),
    ("GET", "/api/v1/events", AtLeast(Operator)),
    ("GET", "/api/v1/live/points", AtLeast(Operator)),
    ("GET", "/api/v1/live/profiles", AtLeast(Operator)),
    ("GET", "/api/v1/live/edges", AtLeast(Operator)),
    ("GET", "/api/v1/devices", AtLeast(Operator)),
    ("GET", "/api/v1/storage", AtLeast(Operator)),
    ("GET", "/api/v1/inspections", AtLeast(Operator)),
    ("POST", "/api/v1/inspections", AtLeast(Operator)),
    ("GET", "/api/v1/inspections/{id}", AtLeast(Operator)),
    (
        "GET",
        "/api/v1/inspections/{id}/report.json",
        AtLeast(Operator),
    ),
    (
        "GET",
        "/api/v1/inspections/{id}/report.html",
        AtLeast(Operator),
    ),
    (
        "GET",
        "/api/v1/inspections/{id}/report.csv",
        AtLeast(Operator),
    ),
    (
        "GET",
        "/api/v1/inspections/{id}/scan.ply",
        AtLeast(Operator),
    ),
    (
        "GET",
        "/api/v1/inspections/{id}/scan.raw",
        AtLeast(Operator),
    ),
    ("POST", "/api/v1/stop", AtLeast(Operator)),
    ("POST", "/api/v1/abort", AtLeast(Operator)),
    ("POST", "/api/v1/halt", AtLeast(Operator)),
    ("POST", "/api/v1/reset", AtLeast(Operator)),
    ("GET", "/api/v1/characteristics", AtLeast(Operator)),
    ("GET", "/api/v1/trends/{name}", AtLeast(Operator)),
    ("GET", "/api/v1/export", AtLeast(Operator)),
    ("GET", "/api/v1/recipes", AtLeast(Operator)),
    ("GET", "/api/v1/recipes/{id}", AtLeast(Operator)),
    ("GET", "/api/v1/recipes/{id}/file", AtLeast(Operator)),
    ("POST", "/api/v1/recipes", AtLeast(Setter)),
    ("POST", "/api/v1/recipes/check", AtLeast(Setter)),
    ("POST", "/api/v1/recipes/import", AtLeast(Setter)),
    ("POST", "/api/v1/recipes/{id}/activate", AtLeast(Setter)),
    ("POST", "/api/v1/reload", AtLeast(Setter)),
    ("GET", "/api/v1/audit", AtLeast(Metrologist)),
    ("GET", "/api/v1/people", AtLeast(Administrator)),
    ("POST", "/api/v1/people", AtLeast(Administrator)),
    ("PATCH", "/api/v1/people/{name}", AtLeast(Administrator)),
    ("GET", "/api/v1/sessions", AtLeast(Administrator)),
    ("DELETE", "/api/v1/sessions/{id}", AtLeast(Administrator)),
    ("POST", "/api/v1/tokens", AtLeast(Administrator)),
    ("POST", "/api/v1/backup", AtLeast(Administrator)),
];

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Who {
    /// Their name; `anonymous` where nobody has logged in.
    pub name: String,
    /// What they may do; `None` where the configuration lets nobody do anything without a login.
    pub role: Option<Role>,
    /// Whether they have logged in.
    pub known: bool,
    /// The session of their browser; a token is no session and is ended by the administrator.
    pub secret: Option<String>,
}

impl<S: Send + Sync> FromRequestParts<S> for Who {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let who = parts.extensions.get::<Who>().cloned();
        who.ok_or_else(|| Problem::fault("nobody asked who this is"))
    }
}

/// Where a request comes from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Peer(pub SocketAddr);

/// Lets a request through to its route, or says why not.
pub(super) async fn guard(State(app): State<App>, request: Request, next: Next) -> Response {
    let (mut parts, body) = request.into_parts();
    match admit(&app, &parts).await {
        Ok(who) => {
            parts.extensions.insert(who);
            next.run(Request::from_parts(parts, body)).await
        }
        Err(problem) => problem.into_response(),
    }
}

async fn admit(app: &App, request: &Parts) -> Result<Who, Problem> {
    called_by_its_name(app, &request.headers)?;
    let safe = [Method::GET, Method::HEAD].contains(&request.method);
    if !safe {
        from_here(&request.headers)?;
    }
    not_too_large(&request.headers)?;
    let who = who(app, &request.headers).await?;
    let Some(path) = request.extensions.get::<MatchedPath>() else {
        // Nothing stands there; the fallback says so.
        return Ok(who);
    };
    match (need(&request.method, path.as_str())?, who.role) {
        (Nothing, _) => Ok(who),
        (AtLeast(least), Some(role)) if role >= least => Ok(who),
        (AtLeast(least), _) => Err(not_allowed(&who, least)),
    }
}

/// The least that `method` asks for at `path`, a path of the router.
///
/// # Errors
/// Where the table has no such route.
fn need(method: &Method, path: &str) -> Result<Need, Problem> {
    let asked = match method.as_str() {
        "HEAD" => "GET",
        other => other,
    };
    let at_path: Vec<_> = ROUTES.iter().filter(|route| route.1 == path).collect();
    if let Some(route) = at_path.iter().find(|route| route.0 == asked) {
        return Ok(route.2);
    }
    if at_path.is_empty() {
        tracing::error!(path, "a route without a line in the table of roles");
        return Err(Problem::new(
            StatusCode::FORBIDDEN,
            "closed",
            "This is open to nobody",
            "the table of routes and roles does not know this address",
            "report it: the program forgot to say who may use it",
        ));
    }
    let mut allowed: Vec<&str> = at_path.iter().map(|route| route.0).collect();
    if allowed.contains(&"GET") {
        allowed.push("HEAD");
    }
    Err(Problem::method(method, allowed.join(",")))
}

fn not_allowed(who: &Who, least: Role) -> Problem {
    let least = least.word();
    if who.known {
        let role = who.role.map_or("nobody", Role::word);
        let detail = format!("{:?} is {role}, this asks for {least}", who.name);
        let what_to_do = format!("ask somebody who is {least} or above");
        let title = "This role may not do that";
        return Problem::new(StatusCode::FORBIDDEN, "role", title, detail, what_to_do);
    }
    Problem::new(
        StatusCode::UNAUTHORIZED,
        "login",
        "This asks for a login",
        format!("nobody has logged in, this asks for {least}"),
        "log in, or send a token in the header Authorization: Bearer",
    )
}

/// A body that says itself that no route takes so much is not read at all; the routes' own limits are below this one.
fn not_too_large(headers: &HeaderMap) -> Result<(), Problem> {
    let length = headers.get(header::CONTENT_LENGTH);
    let length = length.and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
    match length {
        Some(length) if length > LARGEST => Err(Problem::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "body",
            "The body is too large",
            format!("{length} bytes, expected at most {LARGEST}"),
            "send less; the limits are in the README",
        )),
        _ => Ok(()),
    }
}

/// On a loopback address the page is called by a loopback name only: a name of somebody else's that leads here is an attempt to
/// use this browser's reach (DNS rebinding).
fn called_by_its_name(app: &App, headers: &HeaderMap) -> Result<(), Problem> {
    if !app.loopback() {
        return Ok(());
    }
    let host = headers.get(header::HOST);
    let host = host.and_then(|host| host.to_str().ok()).unwrap_or_default();
    let name = host_name(host);
    if ["localhost", "127.0.0.1", "[::1]"].contains(&name.to_ascii_lowercase().as_str()) {
        return Ok(());
    }
    Err(Problem::new(
        StatusCode::MISDIRECTED_REQUEST,
        "host",
        "This page is called otherwise",
        "the request names another host than localhost, 127.0.0.1 or [::1]",
        "call the page by one of these names, or give it another address in [service]",
    ))
}

/// The host of `host:port`.
fn host_name(host: &str) -> &str {
    match host.rfind(':') {
        Some(colon) if !host[colon..].contains(']') => &host[..colon],
        _ => host,
    }
}

/// What changes something comes from our own page or from a program: a browser says from which site it sends.
fn from_here(headers: &HeaderMap) -> Result<(), Problem> {
    let text = |name| {
        let value = headers.get(name)?;
        // What is no text is no name of ours.
        Some(value.to_str().unwrap_or("?"))
    };
    let foreign = match (text("sec-fetch-site"), text(header::ORIGIN.as_str())) {
        (Some(site), _) if site != "same-origin" && site != "none" => true,
        (_, Some(origin)) => {
            let host = text(header::HOST.as_str()).unwrap_or_default();
            let origin = origin.split_once("://").map_or("", |(_, host)| host);
            origin.is_empty() || !origin.eq_ignore_ascii_case(host)
        }
        _ => false,
    };
    if foreign {
        return Err(Problem::new(
            StatusCode::FORBIDDEN,
            "foreign-origin",
            "This request comes from another site",
            "Origin or Sec-Fetch-Site name another site than this one",
            "send it from the cell's own page, or from a program without these headers",
        ));
    }
    Ok(())
}

/// Who holds the key that the request shows.
async fn who(app: &App, headers: &HeaderMap) -> Result<Who, Problem> {
    let anonymous = Who {
        name: "anonymous".to_owned(),
        role: app.service().anonymous,
        known: false,
        secret: None,
    };
    let bearer = headers.get(header::AUTHORIZATION).map(|value| {
        let text = value.to_str().unwrap_or_default();
        let secret = text
            .split_once(' ')
            .filter(|(kind, _)| kind.eq_ignore_ascii_case("bearer"));
        secret.map_or(String::new(), |(_, secret)| secret.trim().to_owned())
    });
    let from_header = bearer.is_some();
    let Some(secret) = bearer.or_else(|| cookie(headers, app.cookie_name())) else {
        return Ok(anonymous);
    };
    let shown = secret.clone();
    let holder = app
        .store(move |store| store.holder(&shown, SystemTime::now()))
        .await?;
    match holder {
        Some(person) => Ok(Who {
            name: person.name,
            role: Some(person.role),
            known: true,
            secret: (!from_header).then_some(secret),
        }),
        None if from_header => Err(Problem::new(
            StatusCode::UNAUTHORIZED,
            "token",
            "This token opens nothing",
            "the token in the header Authorization is unknown, has ended or was revoked",
            "ask the administrator for a new one",
        )),
        // A session that has ended is no session; the page then shows the login.
        None => Ok(anonymous),
    }
}

fn cookie(headers: &HeaderMap, name: &str) -> Option<String> {
    headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'))
        .filter_map(|pair| pair.trim().split_once('='))
        .find(|(key, _)| *key == name)
        .map(|(_, value)| value.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_port_is_no_part_of_the_name() {
        for (host, name) in [
            ("localhost:8370", "localhost"),
            ("127.0.0.1", "127.0.0.1"),
            ("[::1]:80", "[::1]"),
            ("[::1]", "[::1]"),
        ] {
            assert_eq!(host_name(host), name);
        }
    }

    #[test]
    fn what_does_not_stand_in_the_table_is_closed() {
        assert_eq!(
            need(&Method::HEAD, "/api/v1/status").expect("a route"),
            AtLeast(Operator)
        );
        let forgotten = need(&Method::GET, "/api/v1/forgotten").expect_err("closed");
        assert_eq!(forgotten.status(), StatusCode::FORBIDDEN);
        let other = need(&Method::DELETE, "/api/v1/status").expect_err("closed");
        assert_eq!(other.status(), StatusCode::METHOD_NOT_ALLOWED);
        assert_eq!(other.into_response().headers()["allow"], "GET,HEAD");
    }

    #[test]
    fn no_route_stands_twice_in_the_table() {
        for (index, route) in ROUTES.iter().enumerate() {
            let again = ROUTES[..index]
                .iter()
                .any(|other| (other.0, other.1) == (route.0, route.1));
            assert!(!again, "{} {}", route.0, route.1);
        }
    }
}
