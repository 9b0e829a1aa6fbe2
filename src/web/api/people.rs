//! People, their sessions and tokens: the administrator's.

use std::time::{Duration, SystemTime};

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::store::{Person, Role, Session, SessionKind, Store, StoreError};
use crate::web::access::Who;
use crate::web::app::App;
use crate::web::password::{PasswordError, check_name, hash_password, secret};
use crate::web::problem::{Input, Place, Problem};

const DAY: Duration = Duration::from_secs(86_400);

/// Everybody, by name.
#[utoipa::path(get, path = "/api/v1/people", tag = "people", responses((status = 200, description = "everybody", body = Vec<Person>)))]
pub async fn list(State(app): State<App>) -> Result<Json<Vec<Person>>, Problem> {
    Ok(Json(app.store(Store::people).await?))
}

/// Somebody new.
#[derive(Deserialize, ToSchema)]
pub struct NewPerson {
    /// The name to log in with: 1 to 64 characters.
    #[schema(min_length = 1, max_length = 64)]
    name: String,
    /// What they may do.
    role: Role,
    /// 8 to 256 bytes.
    #[schema(format = Password, min_length = 8, max_length = 256)]
    password: String,
}

/// Add somebody.
#[utoipa::path(post, path = "/api/v1/people", tag = "people", request_body = NewPerson,
    responses((status = 201, description = "added", body = Person)))]
pub async fn add(
    State(app): State<App>,
    who: Who,
    Input(new): Input<NewPerson>,
) -> Result<(StatusCode, Json<Person>), Problem> {
    check_name(&new.name).map_err(refused)?;
    let (name, role) = (new.name, new.role);
    let hash = hashed(&app, new.password).await?;
    let added = name.clone();
    app.store(move |store| store.add_person(&added, role, &hash, SystemTime::now()))
        .await?;
    app.audit(&who, "person.add", name.as_str(), ["", role.word()], "")
        .await?;
    Ok((StatusCode::CREATED, Json(person(&app, name).await?)))
}

/// What is to be changed of somebody; what is not given stays.
#[derive(Deserialize, ToSchema)]
pub struct ChangedPerson {
    /// What they may do.
    role: Option<Role>,
    /// A new password.
    #[schema(format = Password, min_length = 8, max_length = 256)]
    password: Option<String>,
    /// Whether they may log in.
    enabled: Option<bool>,
}

/// Change somebody; all their sessions and tokens end.
#[utoipa::path(patch, path = "/api/v1/people/{name}", tag = "people", params(("name" = String, Path)), request_body = ChangedPerson,
    responses((status = 200, description = "changed", body = Person)))]
pub async fn change(
    State(app): State<App>,
    who: Who,
    Place(name): Place<String>,
    Input(change): Input<ChangedPerson>,
) -> Result<Json<Person>, Problem> {
    let old = person(&app, name.clone()).await?;
    let stays = change.role.unwrap_or(old.role) == Role::Administrator
        && change.enabled.unwrap_or(old.enabled);
    if old.role == Role::Administrator && old.enabled && !stays {
        let others = app.store(Store::people).await?;
        let other = |person: &Person| {
            person.name != name && person.enabled && person.role == Role::Administrator
        };
        if !others.iter().any(other) {
            return Err(Problem::conflict(
                format!("{name:?} is the last administrator"),
                "make somebody else administrator first",
            ));
        }
    }
    let password_changed = change.password.is_some();
    let hash = match change.password {
        Some(password) => Some(hashed(&app, password).await?),
        None => None,
    };
    let changed = name.clone();
    app.store(move |store| {
        let now = SystemTime::now();
        store.change_person(&changed, change.role, hash.as_deref(), change.enabled, now)
    })
    .await?;
    let new = person(&app, name.clone()).await?;
    let values = [described(&old, false), described(&new, password_changed)];
    app.audit(&who, "person.change", name, [&values[0], &values[1]], "")
        .await?;
    Ok(Json(new))
}

fn described(person: &Person, new_password: bool) -> String {
    let enabled = if person.enabled { "" } else { ", disabled" };
    let password = if new_password { ", new password" } else { "" };
    format!("{}{enabled}{password}", person.role.word())
}

/// Every session and token that has not ended, newest first.
#[utoipa::path(get, path = "/api/v1/sessions", tag = "people",
    responses((status = 200, description = "no secret is among it", body = Vec<Session>)))]
pub async fn sessions(State(app): State<App>) -> Result<Json<Vec<Session>>, Problem> {
    Ok(Json(app.store(Store::sessions).await?))
}

/// End a session or a token.
#[utoipa::path(delete, path = "/api/v1/sessions/{id}", tag = "people", params(("id" = String, Path)),
    responses((status = 204, description = "ended")))]
pub async fn revoke(
    State(app): State<App>,
    who: Who,
    Place(id): Place<String>,
) -> Result<StatusCode, Problem> {
    let asked = id.clone();
    let old = app.store(move |store| {
        let sessions = store.sessions()?;
        store.revoke_session(&asked)?;
        Ok(sessions.into_iter().find(|session| session.id == asked))
    });
    let old = old.await?.map_or(String::new(), |old| {
        format!("{} of {}", old.label, old.person)
    });
    app.audit(&who, "session.revoke", id, [&old, ""], "")
        .await?;
    Ok(StatusCode::NO_CONTENT)
}

/// A token for a program.
#[derive(Deserialize, ToSchema)]
pub struct NewToken {
    /// Whose rights it has.
    person: String,
    /// What it is for.
    #[schema(min_length = 1, max_length = 100)]
    label: String,
    /// After how many days it ends: 1 to 3650.
    #[schema(minimum = 1, maximum = 3650)]
    days: u32,
}

/// A token that was made.
#[derive(Serialize, ToSchema)]
pub struct Token {
    /// The secret, shown this once: it goes into the header `Authorization: Bearer`.
    secret: String,
}

/// Make a token.
#[utoipa::path(post, path = "/api/v1/tokens", tag = "people", request_body = NewToken,
    responses((status = 201, description = "made", body = Token)))]
pub async fn token(
    State(app): State<App>,
    who: Who,
    Input(new): Input<NewToken>,
) -> Result<(StatusCode, Json<Token>), Problem> {
    if !(1..=3650).contains(&new.days) {
        return Err(Problem::invalid(
            format!("{} days, expected 1 to 3650", new.days),
            "choose how long the token holds",
        ));
    }
    if !(1..=100).contains(&new.label.chars().count()) {
        return Err(Problem::invalid(
            "the label is empty or has more than 100 characters",
            "say in a few words what the token is for",
        ));
    }
    let holder = person(&app, new.person.clone()).await?;
    let secret = secret().map_err(|error| Problem::fault(format!("no random numbers: {error}")))?;
    let kept = secret.clone();
    let subject = format!("{} of {}", new.label, holder.name);
    app.store(move |store| {
        let (now, lasts) = (SystemTime::now(), DAY * new.days);
        store.add_session(
            &kept,
            &holder.name,
            SessionKind::Token,
            &new.label,
            now,
            lasts,
        )
    })
    .await?;
    let days = format!("{} days", new.days);
    app.audit(&who, "token.add", subject, ["", &days], "")
        .await?;
    Ok((StatusCode::CREATED, Json(Token { secret })))
}

async fn person(app: &App, name: String) -> Result<Person, Problem> {
    let found = app.store(move |store| {
        let found = store.person(&name)?;
        found.map(|(person, _)| person).ok_or(StoreError::Missing {
            what: format!("a person {name:?}"),
        })
    });
    found.await
}

async fn hashed(app: &App, password: String) -> Result<String, Problem> {
    let hash = app.hashing(move || hash_password(&password)).await?;
    hash.map_err(refused)
}

fn refused(error: PasswordError) -> Problem {
    match error {
        PasswordError::Hash(_) => Problem::fault(error.to_string()),
        _ => Problem::invalid(error.to_string(), "choose another one"),
    }
}
