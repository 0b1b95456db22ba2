// SPDX-License-Identifier: MIT OR Apache-2.0
//! Everything that a node tells of itself, in one answer.

use crate::api::Shared;
use crate::control::status::{NodeStatus, path};
use axum::Json;
use axum::extract::State;
use std::sync::atomic::Ordering;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(get_status))
}

/// The node's state: devices, disk, warnings, and the session in progress or the last one.
#[utoipa::path(get, path = path::STATUS, tag = "node", responses((status = 200, description = "The node's state.", body = NodeStatus)))]
async fn get_status(State(shared): State<Shared>) -> Json<NodeStatus> {
    let status = shared.status();
    if let Some(session) = status.session.as_ref().filter(|session| session.outcome.is_some()) {
        shared.node.read.store(session.session_id, Ordering::Release);
    }
    Json(status)
}
