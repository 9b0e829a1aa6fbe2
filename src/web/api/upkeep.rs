//! The audit log, storage, backups.

use std::time::SystemTime;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::Page;
use crate::store::{AuditEntry, Store, Usage};
use crate::web::access::Who;
use crate::web::app::App;
use crate::web::problem::{Asked, Problem};

/// Which page of a list.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(default)]
pub struct Listed {
    /// Only entries with a smaller number.
    before: Option<i64>,
    /// How many, at most 500; 50 where nothing is said.
    #[param(value_type = Option<i64>, minimum = 0, maximum = 4_294_967_295_u32)]
    limit: Option<u32>,
}

/// The audit log, newest first: who did what, and what it was before.
#[utoipa::path(get, path = "/api/v1/audit", tag = "upkeep", params(Listed),
    responses((status = 200, description = "one page", body = Page<AuditEntry>)))]
pub async fn audit(
    State(app): State<App>,
    Asked(listed): Asked<Listed>,
) -> Result<Json<Page<AuditEntry>>, Problem> {
    let wanted = Page::<AuditEntry>::wanted(listed.limit);
    let entries = app
        .store(move |store| store.audit_log(listed.before, u32::try_from(wanted).unwrap_or(1)))
        .await?;
    Ok(Json(Page::new(entries, wanted, |entry| entry.id)))
}

/// How much the store holds, and how much the disk has free.
#[utoipa::path(get, path = "/api/v1/storage", tag = "upkeep", responses((status = 200, description = "now", body = Usage)))]
pub async fn storage(State(app): State<App>) -> Result<Json<Usage>, Problem> {
    Ok(Json(app.store(Store::usage).await?))
}

/// A backup that was made.
#[derive(Debug, Serialize, ToSchema)]
pub struct Backup {
    /// Its folder on the cell's machine: a store like the one in use.
    folder: String,
}

/// Write everything into a new folder `backups/TIME` beside the database, while the cell runs.
#[utoipa::path(post, path = "/api/v1/backup", tag = "upkeep", responses((status = 201, description = "made", body = Backup)))]
pub async fn backup(
    State(app): State<App>,
    who: Who,
) -> Result<(StatusCode, Json<Backup>), Problem> {
    let made = app.heavy(|handle| {
        let store = handle.store();
        let usage = store.usage()?;
        let needed = usage.database_bytes + usage.scan_bytes.max(0).unsigned_abs();
        if usage.free_bytes.is_some_and(|free| free < needed) {
            return Err(Problem::new(
                StatusCode::INSUFFICIENT_STORAGE,
                "disk",
                "The disk has too little free",
                format!(
                    "{needed} bytes are needed, {} are free",
                    usage.free_bytes.unwrap_or(0)
                ),
                "make room, or make the backup on another disk from the command line",
            ));
        }
        let time = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        let parent = store.folder().join("backups");
        std::fs::create_dir_all(&parent).map_err(|source| crate::store::StoreError::File {
            path: parent.clone(),
            source,
        })?;
        let folder = parent.join(time.replace(':', ""));
        store.backup(&folder)?;
        Ok(folder.display().to_string())
    });
    let folder = made.await?;
    app.audit(&who, "store.backup", "store", ["", &folder], "")
        .await?;
    Ok((StatusCode::CREATED, Json(Backup { folder })))
}
