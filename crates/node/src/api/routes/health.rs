// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether the node can take a session, in one word, for monitors.

use crate::api::Shared;
use crate::control::status::{Health, NodeStatus, path};
use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(health))
}

/// Whether a session could start now, and why not.
#[utoipa::path(get, path = path::HEALTH, tag = "node", responses(
    (status = 200, description = "It could.", body = Health),
    (status = 503, description = "It could not.", body = Health),
))]
async fn health(State(shared): State<Shared>) -> (StatusCode, Json<Health>) {
    let reasons = reasons(&shared.status(), shared.config.reserve_bytes);
    let healthy = reasons.is_empty();
    let status = if healthy { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(Health { healthy, reasons }))
}

fn reasons(status: &NodeStatus, reserve_bytes: u64) -> Vec<String> {
    let mut reasons = status.problems();
    if status.free_bytes <= reserve_bytes {
        let (free, reserve) = (status.free_bytes >> 20, reserve_bytes >> 20);
        reasons.push(format!(
            "{free} MiB are free in {}, of which {reserve} MiB are kept free (storage.reserve_mib); delete or move sessions",
            status.sessions_dir.display()
        ));
    }
    reasons
}
