// SPDX-License-Identifier: MIT OR Apache-2.0
//! Metrics, as Prometheus reads them and as JSON.

use crate::api::Shared;
use crate::control::status::{Metrics, path};
use crate::telemetry::{Family, exposition};
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderName, header};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(metrics_text)).routes(routes!(metrics))
}

fn families(shared: &Shared) -> Vec<Family> {
    shared.node.telemetry.metrics(&shared.facts(&shared.status()))
}

/// All metrics in Prometheus' text format 0.0.4.
#[utoipa::path(get, path = path::METRICS, tag = "metrics", responses((status = 200, description = "Metrics.", body = String, content_type = "text/plain")))]
async fn metrics_text(State(shared): State<Shared>) -> ([(HeaderName, &'static str); 1], String) {
    (
        [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")],
        exposition::text(&families(&shared)),
    )
}

/// The same metrics as JSON.
#[utoipa::path(get, path = path::METRICS_JSON, tag = "metrics", responses((status = 200, description = "Metrics.", body = Metrics)))]
async fn metrics(State(shared): State<Shared>) -> Json<Metrics> {
    Json(Metrics { families: families(&shared) })
}
