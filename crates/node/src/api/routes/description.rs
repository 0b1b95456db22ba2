// SPDX-License-Identifier: MIT OR Apache-2.0
//! The description of the API itself.

use crate::api::{Shared, description};
use crate::control::status::path;
use axum::Json;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(get_description))
}

/// This description.
#[utoipa::path(get, path = path::OPENAPI, tag = "node", responses((status = 200, description = "OpenAPI 3.1", body = serde_json::Value)))]
async fn get_description() -> Json<utoipa::openapi::OpenApi> {
    Json(description())
}
