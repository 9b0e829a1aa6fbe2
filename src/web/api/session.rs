//! Log in, log out, and who one is.

use std::time::{Duration, Instant, SystemTime};

use axum::extract::State;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::store::{Role, SessionKind};
use crate::web::access::{Peer, Who};
use crate::web::app::App;
use crate::web::password::{secret, verify};
use crate::web::problem::{Input, Problem};

/// A session lasts a shift and a handover.
const LASTS: Duration = Duration::from_secs(12 * 3600);

/// A name and its password.
#[derive(Deserialize, ToSchema)]
pub struct Login {
    /// The name.
    name: String,
    /// The password.
    #[schema(format = Password)]
    password: String,
}

/// Who one is.
#[derive(Debug, Serialize, ToSchema)]
pub struct Me {
    /// The name; `anonymous` where nobody has logged in.
    name: String,
    /// What they may do; null where nobody may do anything without a login.
    role: Option<Role>,
    /// Whether they have logged in.
    logged_in: bool,
}

/// Log in. The answer sets the session's cookie.
#[utoipa::path(post, path = "/api/v1/login", tag = "people", request_body = Login,
    responses((status = 200, description = "logged in", body = Me)))]
pub async fn login(
    State(app): State<App>,
    Extension(Peer(peer)): Extension<Peer>,
    Input(Login { name, password }): Input<Login>,
) -> Result<Response, Problem> {
    let address = peer.ip();
    if let Some(wait) = app.guesses().wait(&name, address, Instant::now()) {
        let seconds = wait.as_secs() + 1;
        return Err(Problem::new(
            StatusCode::TOO_MANY_REQUESTS,
            "guesses",
            "Too many failed logins",
            "this name or this address failed to log in five times",
            format!("try again in {seconds} s"),
        )
        .retry_after(seconds));
    }
    app.guesses().note(&name, address, Instant::now());
    let asked = name.clone();
    let person = app.store(move |store| store.person(&asked)).await?;
    let (person, hash) = person.filter(|(person, _)| person.enabled).unzip();
    let right = app
        .hashing(move || verify(&password, hash.as_deref()))
        .await?;
    let Some(person) = person.filter(|_| right) else {
        tracing::warn!(name, %address, "login failed");
        return Err(Problem::new(
            StatusCode::UNAUTHORIZED,
            "login",
            "Name or password is wrong",
            "no enabled person has this name and this password",
            "type both again, or ask the administrator for a new password",
        ));
    };
    app.guesses().forget(&name, address);
    let secret = secret().map_err(|error| Problem::fault(format!("no random numbers: {error}")))?;
    let (kept, who) = (secret.clone(), person.name.clone());
    app.store(move |store| {
        let now = SystemTime::now();
        store.add_session(&kept, &who, SessionKind::Session, "browser", now, LASTS)
    })
    .await?;
    let who = Who {
        name: person.name.clone(),
        role: Some(person.role),
        known: true,
        secret: None,
    };
    let from = address.to_string();
    app.audit(&who, "session.login", person.name.as_str(), ["", &from], "")
        .await?;
    let me = Me {
        name: person.name,
        role: Some(person.role),
        logged_in: true,
    };
    Ok(with_cookie(&app, &secret, LASTS.as_secs(), Json(me)))
}

/// Log out: the session ends, also where its cookie was copied.
#[utoipa::path(post, path = "/api/v1/logout", tag = "people", responses((status = 204, description = "logged out")))]
pub async fn logout(State(app): State<App>, who: Who) -> Result<Response, Problem> {
    if let Some(secret) = who.secret.clone() {
        app.store(move |store| store.end_session(&secret)).await?;
        app.audit(&who, "session.logout", who.name.as_str(), ["", ""], "")
            .await?;
    }
    Ok(with_cookie(&app, "", 0, StatusCode::NO_CONTENT))
}

/// Who one is.
#[utoipa::path(get, path = "/api/v1/me", tag = "people", responses((status = 200, description = "who asks", body = Me)))]
pub async fn me(who: Who) -> Json<Me> {
    Json(Me {
        name: who.name,
        role: who.role,
        logged_in: who.known,
    })
}

fn with_cookie(app: &App, secret: &str, seconds: u64, answer: impl IntoResponse) -> Response {
    let secure = if app.service().tls.is_some() {
        "; Secure"
    } else {
        ""
    };
    let cookie = format!(
        "{}={secret}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}",
        app.cookie_name()
    );
    let mut answer = answer.into_response();
    if let Ok(cookie) = HeaderValue::try_from(cookie) {
        answer.headers_mut().insert(header::SET_COOKIE, cookie);
    }
    answer
}
