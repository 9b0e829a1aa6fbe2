//! The routes below `/api/v1`, and their description as OpenAPI 3.1, made from the same functions.

mod cell;
mod inspections;
mod people;
mod recipes;
mod session;
mod trends;
mod upkeep;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::header;
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use utoipa::openapi::path::Operation;
use utoipa::openapi::security::{ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::openapi::{
    ComponentsBuilder, ContentBuilder, Info, License, OpenApi, Ref, ResponseBuilder,
};
use utoipa::{PartialSchema, ToSchema};
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouterExt as _};
use utoipa_axum::routes;

use super::access::LARGEST;
use super::app::App;
use super::problem::Details;

/// One page of a list; newest first.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Page<T> {
    /// What is on it.
    items: Vec<T>,
    /// What `before` of the next page is; null where this is the last one.
    next: Option<i64>,
}

/// A whole number that every reader of JSON holds exactly, 0 to 2^53 - 1 (RFC 8259, section 6); others are refused.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(try_from = "u64")]
struct Whole(u64);

/// The largest [`Whole`].
const WHOLE_MAX: u64 = (1 << 53) - 1;

impl TryFrom<u64> for Whole {
    type Error = String;

    fn try_from(number: u64) -> Result<Self, String> {
        if number > WHOLE_MAX {
            return Err(format!("{number}, expected at most {WHOLE_MAX}"));
        }
        Ok(Self(number))
    }
}

/// How many items a page holds where nothing is said, and at most.
const PAGE: u32 = 50;
const PAGE_MAX: u32 = 500;

impl<T> Page<T> {
    /// `limit` as asked for, plus one to know whether there is more.
    fn wanted(limit: Option<u32>) -> usize {
        limit.unwrap_or(PAGE).clamp(1, PAGE_MAX) as usize
    }

    fn new(items: Vec<T>, wanted: usize, id: impl Fn(&T) -> i64) -> Self {
        let full = items.len() >= wanted;
        let next = items.last().filter(|_| full).map(id);
        Self { items, next }
    }
}

/// The routes, and beside them their description as JSON text.
pub(super) fn routes() -> (Router<App>, String) {
    let info = Info::builder()
        .title("acies")
        .version(env!("CARGO_PKG_VERSION"))
        .description(Some(
            "One cell that measures sharp edges. Errors are problem details (RFC 9457) with `what_to_do`. Lists are read page by \
             page: `next` of one page is `before` of the next. Times are RFC 3339 in UTC, lengths mm, angles degrees.",
        ))
        .license(Some(License::builder().name("MIT OR Apache-2.0").identifier(Some("MIT OR Apache-2.0")).build()))
        .build();
    let schemes = [
        (
            "session",
            SecurityScheme::ApiKey(ApiKey::Cookie(ApiKeyValue::with_description(
                "acies",
                "from /api/v1/login; `__Host-acies` over TLS",
            ))),
        ),
        (
            "token",
            SecurityScheme::Http(
                HttpBuilder::new()
                    .scheme(HttpAuthScheme::Bearer)
                    .description(Some("from /api/v1/tokens"))
                    .build(),
            ),
        ),
    ];
    let components = schemes
        .into_iter()
        .fold(ComponentsBuilder::new(), |all, (name, scheme)| {
            all.security_scheme(name, scheme)
        })
        .schema(Details::name(), Details::schema())
        .build();
    let mut document = OpenApi::new(info, utoipa::openapi::Paths::new());
    document.components = Some(components);
    let (router, mut document) = OpenApiRouter::with_openapi(document)
        .routes(routes!(session::login))
        .routes(routes!(session::logout))
        .routes(routes!(session::me))
        .routes(routes!(cell::status))
        .routes(routes!(cell::events))
        .routes(routes!(cell::devices))
        .routes(routes!(cell::live_points))
        .routes(routes!(cell::live_profiles))
        .routes(routes!(cell::live_edges))
        .routes(routes!(cell::stop))
        .routes(routes!(cell::abort))
        .routes(routes!(cell::halt))
        .routes(routes!(cell::reset))
        .routes(routes!(cell::reload))
        .routes(routes!(inspections::list, inspections::start))
        .routes(routes!(inspections::one))
        .routes(routes!(inspections::report_json))
        .routes(routes!(inspections::report_html))
        .routes(routes!(inspections::report_csv))
        .routes(routes!(inspections::scan_ply))
        .routes(routes!(inspections::scan_raw))
        .routes(routes!(inspections::export))
        .routes(routes!(trends::characteristics))
        .routes(routes!(trends::trend))
        .routes(routes!(recipes::list, recipes::add).layer(large()))
        .routes(routes!(recipes::check).layer(large()))
        .routes(routes!(recipes::import).layer(large()))
        .routes(routes!(recipes::one))
        .routes(routes!(recipes::file))
        .routes(routes!(recipes::activate))
        .routes(routes!(people::list, people::add))
        .routes(routes!(people::change))
        .routes(routes!(people::sessions))
        .routes(routes!(people::revoke))
        .routes(routes!(people::token))
        .routes(routes!(upkeep::audit))
        .routes(routes!(upkeep::storage))
        .routes(routes!(upkeep::backup))
        .split_for_parts();
    tell_of_problems(&mut document);
    let text = document.to_pretty_json().unwrap_or_default();
    (router, text)
}

/// For bodies that carry the nominal of a large part in base64.
fn large() -> DefaultBodyLimit {
    DefaultBodyLimit::max(LARGEST as usize)
}

/// Every operation may answer with a problem; said once here, not at each.
fn tell_of_problems(document: &mut OpenApi) {
    let problem = ResponseBuilder::new()
        .description("why it was not done, and what to do")
        .content(
            "application/problem+json",
            ContentBuilder::new()
                .schema(Some(Ref::from_schema_name(Details::name())))
                .build(),
        )
        .build();
    for item in document.paths.paths.values_mut() {
        let operations: [&mut Option<Operation>; 5] = [
            &mut item.get,
            &mut item.post,
            &mut item.put,
            &mut item.patch,
            &mut item.delete,
        ];
        for operation in operations.into_iter().flatten() {
            let responses = &mut operation.responses.responses;
            responses.insert("default".to_owned(), problem.clone().into());
        }
    }
}

/// Bytes of one kind.
fn bytes(kind: &'static str, body: impl IntoResponse) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, kind)], body)
}

/// Bytes of one kind that a browser keeps as a file called `name`.
fn file(kind: &'static str, name: &str, body: impl IntoResponse) -> impl IntoResponse {
    // Our names are made of digits and words of ours: nothing in them needs to be escaped.
    let disposition = format!("attachment; filename=\"{name}\"");
    let headers = [
        (header::CONTENT_TYPE, kind.to_owned()),
        (header::CONTENT_DISPOSITION, disposition),
    ];
    (headers, body)
}
