//! Errors as the API tells them: problem details (RFC 9457), each with what to do.

use axum::Json;
use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::extract::{FromRequest, FromRequestParts, Path, Query, Request};
use axum::http::header::{self, HeaderValue};
use axum::http::request::Parts;
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde::de::DeserializeOwned;
use utoipa::ToSchema;

pub(super) use crate::acquire::chain;
use crate::cell::{CellError, Refusal};
use crate::store::{Inspection, StoreError};

/// Why a request was not done, and what to do about it: RFC 9457, `application/problem+json`.
#[derive(Debug, Clone)]
pub(super) struct Problem(Box<Details>);

/// Why a request was not done, and what to do about it (RFC 9457).
#[derive(Debug, Clone, Serialize, ToSchema)]
#[schema(as = Problem)]
pub(super) struct Details {
    /// Which kind: `urn:acies:problem:` and a word.
    #[serde(rename = "type")]
    kind: String,
    /// The kind for people.
    title: &'static str,
    /// The status of the answer.
    status: u16,
    /// What was seen here, and what was expected.
    detail: String,
    /// What to do, in one sentence.
    what_to_do: String,
    /// The inspection that keeps the refusal, where one does.
    #[serde(skip_serializing_if = "Option::is_none")]
    inspection: Option<i64>,
    /// Seconds after which it may be tried again.
    #[serde(skip)]
    retry_after_s: Option<u64>,
    /// The methods that are answered there, where that is the question.
    #[serde(skip)]
    allow: Option<String>,
}

impl Problem {
    /// A problem of kind `word`.
    pub fn new(
        status: StatusCode,
        word: &str,
        title: &'static str,
        detail: impl Into<String>,
        what_to_do: impl Into<String>,
    ) -> Self {
        Self(Box::new(Details {
            kind: format!("urn:acies:problem:{word}"),
            title,
            status: status.as_u16(),
            detail: detail.into(),
            what_to_do: what_to_do.into(),
            inspection: None,
            retry_after_s: None,
            allow: None,
        }))
    }

    /// Tells when it may be tried again.
    pub fn retry_after(mut self, seconds: u64) -> Self {
        self.0.retry_after_s = Some(seconds);
        self
    }

    /// A value that cannot be taken.
    pub fn invalid(detail: impl Into<String>, what_to_do: impl Into<String>) -> Self {
        Self::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "invalid",
            "A value cannot be taken",
            detail,
            what_to_do,
        )
    }

    /// Something that is not there.
    pub fn missing(detail: impl Into<String>) -> Self {
        Self::new(
            StatusCode::NOT_FOUND,
            "missing",
            "There is nothing here",
            detail,
            "check the address or the number; /api/v1/openapi.json lists what there is",
        )
    }

    /// The address is there, the method is not; `allowed` are those that are.
    pub fn method(method: &Method, allowed: String) -> Self {
        // A method is any token the client likes; only the usual ones are shown back.
        let shown = match *method {
            Method::GET
            | Method::POST
            | Method::PUT
            | Method::DELETE
            | Method::PATCH
            | Method::HEAD => method.as_str(),
            _ => "this method",
        };
        let mut problem = Self::new(
            StatusCode::METHOD_NOT_ALLOWED,
            "method",
            "This cannot be done with this address",
            format!("{shown} is not answered here"),
            "the header Allow says what is",
        );
        problem.0.allow = Some(allowed);
        problem
    }

    /// Something that contradicts what is so.
    pub fn conflict(detail: impl Into<String>, what_to_do: impl Into<String>) -> Self {
        Self::new(
            StatusCode::CONFLICT,
            "conflict",
            "This contradicts what is so",
            detail,
            what_to_do,
        )
    }

    /// Our fault.
    pub fn fault(detail: impl Into<String>) -> Self {
        let detail = detail.into();
        tracing::error!(detail, "request failed");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "fault",
            "The program failed",
            detail,
            "try again; where it stays, the daemon's log has the place",
        )
    }

    /// Too much at a time.
    pub fn busy(detail: impl Into<String>, seconds: u64) -> Self {
        Self::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "busy",
            "Too much at a time",
            detail,
            format!("try again in {seconds} s"),
        )
        .retry_after(seconds)
    }

    /// A trigger or command that was refused, and the inspection that keeps it.
    pub fn refused(refusal: &Refusal, kept: Option<&Inspection>) -> Self {
        let detail = refusal.to_string();
        let title = "The cell does not take this now";
        let mut problem = match refusal {
            Refusal::NotReady { advice, .. } => {
                Self::new(StatusCode::CONFLICT, "not-ready", title, detail, advice)
            }
            Refusal::QueueFull { .. } => Self::new(
                StatusCode::TOO_MANY_REQUESTS,
                "queue-full",
                title,
                detail,
                "wait until a part is done",
            )
            .retry_after(5),
            Refusal::NoSerial => Self::new(
                StatusCode::UNPROCESSABLE_ENTITY,
                "no-serial",
                title,
                detail,
                "type or scan the part's serial number",
            ),
            Refusal::NothingToRepeat { .. } => Self::new(
                StatusCode::UNPROCESSABLE_ENTITY,
                "nothing-to-repeat",
                title,
                detail,
                "give the number of an inspection in the history, or none",
            ),
            Refusal::Store(_) => Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "store",
                title,
                detail,
                "check the disk, then press Reset",
            ),
            Refusal::Ending => Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "ending",
                title,
                detail,
                "start the part again when the daemon is back",
            )
            .retry_after(5),
        };
        problem.0.inspection = kept.map(|inspection| inspection.id);
        problem
    }

    /// The status of the answer.
    pub fn status(&self) -> StatusCode {
        StatusCode::from_u16(self.0.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR)
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut answer = (self.status(), Json(&self.0)).into_response();
        let headers = answer.headers_mut();
        headers.insert(
            header::CONTENT_TYPE,
            HeaderValue::from_static("application/problem+json"),
        );
        if let Some(seconds) = self.0.retry_after_s {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        let allow = self.0.allow.and_then(|allow| allow.try_into().ok());
        if let Some(allow) = allow {
            headers.insert(header::ALLOW, allow);
        }
        if self.0.status == StatusCode::UNAUTHORIZED.as_u16() {
            let bearer = HeaderValue::from_static("Bearer realm=\"acies\"");
            headers.insert(header::WWW_AUTHENTICATE, bearer);
        }
        answer
    }
}

impl From<StoreError> for Problem {
    fn from(error: StoreError) -> Self {
        match &error {
            StoreError::Missing { .. } => Self::missing(error.to_string()),
            StoreError::Exists { .. } => {
                Self::conflict(error.to_string(), "choose another name or change that one")
            }
            _ => Self::fault(chain(&error)),
        }
    }
}

impl From<CellError> for Problem {
    fn from(error: CellError) -> Self {
        match error {
            CellError::Store(error) => error.into(),
            CellError::Recipe { .. } | CellError::Nominal(_) => Self::new(
                StatusCode::UNPROCESSABLE_ENTITY,
                "recipe",
                "The recipe or its nominal cannot be read",
                chain(&error),
                "mend what the lines name; the active recipe stays active",
            ),
            other => Self::fault(chain(&other)),
        }
    }
}

/// A JSON body.
pub(super) struct Input<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for Input<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        let read = Json::<T>::from_request(request, state).await;
        read.map(|Json(value)| Input(value))
            .map_err(|rejection: JsonRejection| {
                let (title, what_to_do) = match rejection.status() {
                    StatusCode::PAYLOAD_TOO_LARGE => (
                        "The body is too large",
                        "send less; the limits are in the README",
                    ),
                    StatusCode::UNSUPPORTED_MEDIA_TYPE => {
                        ("The body is not JSON", "send it as application/json")
                    }
                    StatusCode::REQUEST_TIMEOUT => ("The body came too slowly", "send it at once"),
                    _ => (
                        "The body cannot be read",
                        "compare it with /api/v1/openapi.json",
                    ),
                };
                Problem::new(
                    rejection.status(),
                    "body",
                    title,
                    rejection.body_text(),
                    what_to_do,
                )
            })
    }
}

/// The query of an address.
pub(super) struct Asked<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for Asked<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let read = Query::<T>::from_request_parts(parts, state).await;
        read.map(|Query(value)| Asked(value))
            .map_err(|rejection: QueryRejection| {
                Problem::new(
                    StatusCode::BAD_REQUEST,
                    "query",
                    "The query cannot be read",
                    rejection.body_text(),
                    "compare it with /api/v1/openapi.json",
                )
            })
    }
}

/// A value in an address.
pub(super) struct Place<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for Place<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let read = Path::<T>::from_request_parts(parts, state).await;
        read.map(|Path(value)| Place(value))
            .map_err(|rejection: PathRejection| {
                Problem::new(
                    StatusCode::BAD_REQUEST,
                    "address",
                    "The address cannot be read",
                    rejection.body_text(),
                    "compare it with /api/v1/openapi.json",
                )
            })
    }
}

/// Nothing stands at this address.
pub(super) async fn unknown() -> Problem {
    Problem::missing("there is nothing at this address")
}
